"""Dead time after each event."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import warp as wp

from dase.effects.base import Effect, choice, parameter


@wp.func
def dead_time_left(age: float, period: float):
    """Time the pixel stays dead [s]; none when not positive."""
    return period - age


@dataclass(frozen=True, kw_only=True)
class Refractory(Effect):
    """Dead time after each event.

    After an event a pixel is held in reset for a while and cannot send another. Fast, strong edges lose
    events, and no two events of a pixel are closer than the dead time.

    With `mode = "drop"`, crossings during the dead time are lost although the memory follows them (ESIM).
    With `mode = "delay"`, the pixel sends a crossing that still stands when the dead time ends.
    """

    name: ClassVar[str] = "refractory"
    source: ClassVar[str] = (
        "Rebecq, Gehrig, Scaramuzza: ESIM, an open event camera simulator, 2018; "
        "Lichtsteiner, Posch, Delbruck: A 128x128 120 dB 15 us latency asynchronous "
        "temporal contrast vision sensor, 2008"
    )
    stages: ClassVar = {"gate": dead_time_left}

    period: float = parameter(
        1e-3,
        unit="s",
        off=0.0,
        bounds=(0.0, 1.0),
        plausible=(1e-5, 2e-2),
        about="dead time",
    )
    mode: str = choice("drop", among=("drop", "delay"), about="what becomes of crossings in the dead time")

    def delays(self) -> bool:
        """Whether crossings in the dead time come later instead of being lost."""
        return self.mode == "delay"
