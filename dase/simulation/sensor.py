"""The sensor: an ordered list of effects, and the main path from a scene to events."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from dase.effects import EFFECTS
from dase.effects.base import ANY_SAMPLES, Effect
from dase.effects.optics import SceneEffect
from dase.effects.stream import StreamEffect
from dase.effects.threshold import Threshold
from dase.errors import InputError
from dase.events import LARGEST_SIDE
from dase.kernels import pixel_stages
from dase.scenes.scene import Scene
from dase.scenes.video import LOG_EPS
from dase.simulation.sensor_history import HistoryEntry


def _readable(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True, repr=False)
class Sensor:
    """An event camera: a threshold and any further effects, in the order in which they act.

    Args:
        effects: At most one of each kind; a `Threshold` among them.
        name: For the user.
        size: Columns and rows of the camera [px], for work that has no size of its own; a scene brings its
            own size. None leaves it open.
        log_eps: Added to intensities before the logarithm, so that black is finite (ESIM: 0.001).
        history: How the sensor came to be; changes nothing.
    """

    effects: tuple[Effect, ...] = (Threshold(),)
    name: str = "ideal"
    size: tuple[int, int] | None = None
    log_eps: float = LOG_EPS
    history: tuple[HistoryEntry, ...] = field(default=(), compare=False)

    def __post_init__(self) -> None:
        names = [effect.name for effect in self.effects]
        if len(set(names)) != len(names):
            raise InputError(f"sensor '{self.name}': each effect may appear once, got {', '.join(names)}")
        if "threshold" not in names:
            raise InputError(
                f"sensor '{self.name}' needs the effect 'threshold', got {', '.join(names) or 'none'}"
            )
        if not 0 < self.log_eps < 1:
            raise InputError(f"sensor '{self.name}': log_eps must lie in (0, 1), got {self.log_eps:g}")
        if self.size is not None and not 1 <= min(self.size) <= max(self.size) <= LARGEST_SIDE:
            size, most = f"{self.size[0]}x{self.size[1]}", f"{LARGEST_SIDE}x{LARGEST_SIDE}"
            raise InputError(f"sensor '{self.name}': size must lie between 1x1 and {most}, got {size}")

    def __repr__(self) -> str:
        """Return a table with a line for each effect; `dump_sensor` writes all of it."""
        size = "" if self.size is None else f", {self.size[0]}x{self.size[1]}"
        rows = [
            (e.name, ", ".join(f"{n} {_readable(getattr(e, n))}" for n in e.settings())) for e in self.effects
        ]
        width = max(len(name) for name, _ in rows)
        lines = [
            f"Sensor '{self.name}'{size}",
            *(f"  {name:<{width}}  {text}".rstrip() for name, text in rows),
        ]
        if self.history:
            lines.append(f"  {len(self.history)} entries in .history")
        return "\n".join(line if len(line) <= 100 else f"{line[:99]}…" for line in lines)

    def __getitem__(self, name: str) -> Effect:
        for effect in self.effects:
            if effect.name == name:
                return effect
        has = ", ".join(effect.name for effect in self.effects)
        raise KeyError(f"sensor '{self.name}' has no effect '{name}', it has {has}")

    def __contains__(self, name: str) -> bool:
        return any(effect.name == name for effect in self.effects)

    def with_effect(self, effect: Effect) -> Sensor:
        """Return the sensor with `effect` added where it acts, or in place of the one of the same name.

        Raises:
            InputError: It is no effect.
        """
        if not isinstance(effect, Effect):
            raise InputError(f"effect: must be one, such as EFFECTS['leak'](rate=0.1), got {effect!r}")
        if effect.name in self:
            return replace(self, effects=tuple(effect if e.name == effect.name else e for e in self.effects))
        place = {name: i for i, name in enumerate(EFFECTS)}
        later = [place.get(e.name, 0) > place.get(effect.name, len(place)) for e in self.effects]
        at = later.index(True) if True in later else len(later)
        return replace(self, effects=(*self.effects[:at], effect, *self.effects[at:]))

    def without(self, name: str) -> Sensor:
        """Return the sensor without the effect `name`."""
        return replace(self, effects=tuple(e for e in self.effects if e.name != name))

    @property
    def unbroken(self) -> bool:
        """Whether some effect needs time to go on without a break, see `Effect.unbroken`."""
        return any(effect.unbroken for effect in self.effects)

    def longest_step(self) -> float:
        """Return the longest time between samples that still shows all effects [s].

        Where a simulator by frames forgets from one to the next, nothing of it goes on between them.
        """
        if self.knows_samples_alone:
            return ANY_SAMPLES
        return min(effect.longest_step() for effect in self.effects)

    @property
    def knows_samples_alone(self) -> bool:
        """Whether some effect knows the samples of a scene alone, see `Effect.knows_samples_alone`."""
        return any(effect.knows_samples_alone() for effect in self.effects)

    def stages(self) -> tuple[pixel_stages.EffectStages, ...]:
        """Return the pixels' effects as the kernel composer sees them; the threshold is part of its core."""
        apart = (Threshold, SceneEffect, StreamEffect)
        return tuple(effect.compiled() for effect in self.effects if not isinstance(effect, apart))

    def through_optics(self, scene: Scene) -> Scene:
        """Return what the pixels see of `scene`."""
        for effect in self.effects:
            scene = effect.seen(scene) if isinstance(effect, SceneEffect) else scene
        return scene

    def in_frames(self, scene: Scene) -> Scene:
        """Return what frames show of `scene` that are taken beside the events."""
        for effect in self.effects:
            if isinstance(effect, SceneEffect) and effect.in_frames:
                scene = effect.seen(scene)
        return scene

    def sees_colour(self) -> bool:
        """Whether it matters to the pixels what colour light has."""
        return any(isinstance(e, SceneEffect) and e.needs_colour and not e.is_off() for e in self.effects)

    def readout_effects(self) -> tuple[StreamEffect, ...]:
        """Return the effects behind the pixels that are not off."""
        return tuple(e for e in self.effects if isinstance(e, StreamEffect) and not e.is_off())

    def located(self, folder: Path) -> Sensor:
        """Return the sensor with the files of its effects found from `folder`, in which its own file lies."""
        return replace(self, effects=tuple(effect.located(folder) for effect in self.effects))

    def bound_to(self, scene: Scene) -> Sensor:
        """Return the sensor with whatever its pixels owe to the scene worked out."""
        if not any(effect.maps for effect in self.effects):
            return self
        return replace(self, effects=tuple(effect.bound_to(scene) for effect in self.effects))

    def maps(self, pixels: NDArray[np.int32], device: Any) -> list[Any]:
        """Return what kernels get beside parameters: an array (M, N) of maps where effects have any."""
        values = [effect.map_values(pixels) for effect in self.effects if effect.maps]
        return [wp.array(np.concatenate(values), dtype=float, device=device)] if values else []

    def by_single_pixels(self) -> Sensor:
        """Return the sensor as each pixel by itself counts its events.

        That is without effects in which what becomes of an event depends on other pixels, such as a bus, and
        without a clock, which moves no event by more than a tick.
        """
        left_out = [e.name for e in self.readout_effects() if not e.per_pixel or e.clock_period() is not None]
        return replace(self, effects=tuple(e for e in self.effects if e.name not in left_out))

    def changes_event_stream(self) -> bool:
        """Whether events leave at other times than their crossings', or not all of them leave."""
        late = (e for e in self.effects if isinstance(e, StreamEffect) or "delay" in e.stages)
        return not all(effect.is_off() for effect in late)

    def parameter_names(self) -> list[str]:
        """Return `effect.parameter` for every place of a parameter vector."""
        core = ["threshold.on", "threshold.off", "threshold.phase", "sensor.log_eps"]
        return core + [f"{s.name}.{p}" for s in self.stages() for p in s.parameters]

    def idle_parameters(self) -> set[str]:
        """Return `effect.parameter` of all that changes nothing, by an effect's words or beside another."""
        return {f"{effect.name}.{name}" for effect in self.effects for name in effect.idle(self.effects)}

    def doubled_effects(self) -> dict[str, str]:
        """Return effects that do what another one of the sensor does as well, each to that one.

        Both act, one behind the other: a `bandwidth` beside a `second_order` is a third pole.
        """
        on = [effect for effect in self.effects if not effect.is_off()]
        names = {effect.name for effect in on}
        return {part: effect.name for effect in on for part in effect.includes if part in names}

    def parameters(self) -> NDArray[np.float32]:
        """Return the parameter vector of this sensor, shape (P,)."""
        values = [
            self.log_eps if n == "sensor.log_eps" else getattr(self[n.split(".")[0]], n.split(".")[1])
            for n in self.parameter_names()
        ]
        return np.array(values, np.float32)

    def to_table(self) -> dict[str, Any]:
        """Return the sensor as it stands in a sensor file."""
        out: dict[str, Any] = {"name": self.name}
        if self.size is not None:
            out["size"] = list(self.size)
        out["log_eps"] = self.log_eps
        for effect in self.effects:
            out[effect.name] = {name: getattr(effect, name) for name in effect.settings()}
        return out
