"""All knobs of a training run in one value, and the file `recipe.json` that keeps them."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal, Self

from dase.learning.adversarial import AdversarialSettings, PatchHash
from dase.learning.moment_matching import MomentSettings
from dase.learning.training import TrainingSettings
from dase.networks.threshold_network import NetworkShape


@dataclass(frozen=True, kw_only=True)
class Recipe(TrainingSettings):
    """Everything about a training run but its data.

    Args:
        objective: `wgan`, the paper's bank of critics, or `moments`.
        adversarial: Knobs of `wgan`.
        moments: Knobs of `moments`.
    """

    objective: Literal["wgan", "moments"] = "wgan"
    adversarial: AdversarialSettings = field(default_factory=AdversarialSettings)
    moments: MomentSettings = field(default_factory=MomentSettings)

    @classmethod
    def from_names(cls, **named: Any) -> Self:
        """Return a recipe by the names in `recipe.json`, where the settings of all parts are one table.

        Raises:
            TypeError: A name is unknown.
        """
        parts: dict[str, Any] = {}
        for part, kind in (("adversarial", AdversarialSettings), ("moments", MomentSettings)):
            own = {f.name for f in fields(kind)} & named.keys()
            parts[part] = kind(**{name: named.pop(name) for name in own})
        return cls(**named, **parts)

    def table(self) -> dict[str, Any]:
        """Return all settings by their names in `recipe.json`, those of both objectives among them."""
        table = asdict(self)
        adversarial, moments = table.pop("adversarial"), table.pop("moments")
        last = {name: table.pop(name) for name in ("network", "seed")}
        return {"objective": table.pop("objective"), **table, **adversarial, **moments, **last}

    def text(self) -> str:
        """Return the recipe as JSON."""
        return json.dumps(self.table(), indent=1)

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the recipe of a JSON text; names that are not known any more are left out."""
        table = json.loads(text)
        known = cls().table()
        table = {name: value for name, value in table.items() if name in known}
        table["hash"] = PatchHash(**table["hash"])
        # JSON knows lists only
        network: dict[str, Any] = {
            n: tuple(v) if isinstance(v, list) else v for n, v in table["network"].items()
        }
        table["network"] = NetworkShape(**network)
        table["cells"] = tuple(table["cells"])
        return cls.from_names(**table)
