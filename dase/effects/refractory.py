"""Dead time after each event."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Self

import warp as wp

from dase.effects.base import Effect, Observations, choice, parameter
from dase.effects.made_signatures import Makes


@wp.func
def dead_time_left(
    age: float, fired_on: float, period: float, after_off: float, spread: float, pixel_normal: float
):
    """Time the pixel stays dead [s]; none when not positive."""
    own = period * wp.max(1.0 + spread * pixel_normal, 0.0)
    return own * (after_off + (1.0 - after_off) * fired_on) - age


@dataclass(frozen=True, kw_only=True)
class Refractory(Effect):
    """Dead time after each event.

    After an event a pixel is held in reset for a while and cannot send another. Fast, strong edges lose
    events, and no two events of a pixel are closer than the dead time. It differs from pixel to pixel, and
    may be longer or shorter after an OFF event than after an ON event.

    With `mode = "reset"`, as in real pixels, the change detector is held meanwhile: when the dead time ends,
    it memorises the light of that moment, and what has changed before is forgotten. On a ramp whose log
    intensity rises by s per second, an event comes every threshold / s + period seconds.

    Two rules of other simulators send more events. With `mode = "drop"`, crossings during the dead time are
    lost although the memory follows them, one threshold each (ESIM): the ramp has an event at the first
    crossing after the dead time, whatever was left of the way. With `mode = "delay"`, the pixel sends a
    crossing that still stands when the dead time ends: every max(threshold / s, period).

    Random events of `shot` and hot pixels are held back, too, and begin a dead time. Other simulators add
    them on top (v2e, OpenEB): with `noise = "passes"` they come in the dead time as at any other, set the
    memory, and begin no dead time.
    """

    name: ClassVar[str] = "refractory"
    source: ClassVar[str] = (
        "Lichtsteiner, Posch, Delbruck: A 128x128 120 dB 15 us latency asynchronous "
        "temporal contrast vision sensor, 2008 (reset); "
        "Rebecq, Gehrig, Scaramuzza: ESIM, an open event camera simulator, 2018 (drop); "
        "Hu, Liu, Delbruck: v2e, from video frames to realistic DVS events, 2021 (noise on top)"
    )
    stages: ClassVar = {"gate": dead_time_left}
    signatures: ClassVar = (Makes("dead time", tells=True),)
    screen_limits: ClassVar = {
        "period": (
            "a dead time wants steps that are fast and large: an LED, or the edge of a print that is "
            "moved fast"
        ),
    }

    period: float = parameter(
        1e-3,
        unit="s",
        off=0.0,
        bounds=(0.0, 1.0),
        plausible=(1e-5, 2e-2),
        about="dead time after an ON event",
        between_samples=True,
    )
    after_off: float = parameter(
        1.0,
        unit="1",
        bounds=(0.01, 100.0),
        plausible=(0.3, 3.0),
        about="dead time after an OFF event, relative to that after an ON event",
        fitted=False,  # two recordings do not tell it by the error of a fit: docs/effects.md
    )
    spread: float = parameter(
        0.0,
        unit="1",
        bounds=(0.0, 1.0),
        plausible=(0.0, 0.3),
        about="standard deviation of the dead time over pixels, relative to it",
        fitted=False,
    )
    mode: str = choice(
        "reset", among=("reset", "drop", "delay"), about="what becomes of changes in the dead time"
    )

    noise: str = choice(
        "held", among=("held", "passes"), about="what becomes of random events in the dead time"
    )

    @classmethod
    def candidates(cls, observed: Observations) -> list[Self]:
        """Return the three rules; whether noise passes is asked once there is noise."""
        return [effect for effect in cls.variants() if effect.noise == "held"]

    def otherwise(self, beside: Sequence[Effect]) -> list[Self]:
        """Return the other rules for changes in the dead time, and for noise where there is any."""
        modes = [dataclasses.replace(self, mode=mode) for mode in self.choices()["mode"] if mode != self.mode]
        if not any("noise" in effect.stages for effect in beside):
            return modes
        return [*modes, dataclasses.replace(self, noise="held" if self.noise == "passes" else "passes")]

    def spares_noise(self) -> bool:
        """Whether random events come in the dead time, too."""
        return self.noise == "passes"

    def delays(self) -> bool:
        """Whether crossings in the dead time come later instead of being lost."""
        return self.mode == "delay"

    def resets(self) -> bool:
        """Whether the pixel is held in reset."""
        return self.mode == "reset"
