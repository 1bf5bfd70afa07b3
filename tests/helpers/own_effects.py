"""Effects of a user's own that do nothing: only what they say of themselves matters."""

from __future__ import annotations

from dataclasses import dataclass

from dase.effects import Effect, Makes


def effect_that_makes(name: str, signatures: tuple[Makes, ...] | None = None) -> type[Effect]:
    """Return an effect that says which signatures it makes; None for one that does not say."""
    said = {"name": name, "source": "a test", "stages": {}, "signatures": signatures}
    return dataclass(frozen=True, kw_only=True)(type(name.capitalize(), (Effect,), said))
