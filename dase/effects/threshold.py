"""The change detector's thresholds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

from dase.effects.base import Effect, parameter


@dataclass(frozen=True, kw_only=True)
class Threshold(Effect):
    """The change of log intensity that makes an event.

    A pixel remembers the log intensity of its last event. When the present one is higher by the ON threshold
    it sends an ON event, when it is lower by the OFF threshold an OFF event, and remembers anew. Low
    thresholds make many events. Every sensor has this effect; alone it is the ideal event camera.

    When a recording begins, a real pixel is somewhere between its last event and its next. `phase` spreads
    the pixels over that range, evenly, as if the first change had been going on before; at 0 all of them
    start at their first intensity, which makes too few events in short windows.
    """

    name: ClassVar[str] = "threshold"
    source: ClassVar[str] = (
        "Lichtsteiner, Posch, Delbruck: A 128x128 120 dB 15 us latency asynchronous "
        "temporal contrast vision sensor, 2008"
    )
    stages: ClassVar = {}
    signatures: ClassVar = ()

    on: float = parameter(
        0.2,
        unit="log intensity",
        bounds=(0.01, 10.0),
        plausible=(0.05, 1.0),
        about="change that makes an ON event",
    )
    off: float = parameter(
        0.2,
        unit="log intensity",
        bounds=(0.01, 10.0),
        plausible=(0.05, 1.0),
        about="change that makes an OFF event",
    )
    phase: float = parameter(
        1.0,
        unit="1",
        off=0.0,
        bounds=(0.0, 1.0),
        plausible=(0.0, 1.0),
        about="spread of the pixels' memories at the start, as a share of the threshold",
        fitted=False,  # both ends are tried instead
    )

    def otherwise(self, beside: Sequence[Effect]) -> list[Self]:
        """Return the thresholds with the other end of the phase."""
        return [replace(self, phase=1.0 - self.phase)]
