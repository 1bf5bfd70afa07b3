"""The time from a change of light to the event."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import warp as wp

from dase.effects.base import Effect, parameter
from dase.effects.made_signatures import Makes
from dase.effects.photocurrent import dark_share, idle_beside, relative_photocurrent


@wp.func
def event_delay(intensity: float, delay: float, light: float, dark: float, dark_current: float):
    """Time from a crossing to its event's leaving the pixel [s]."""
    return delay * (1.0 - light + light / relative_photocurrent(intensity, dark, dark_current))


@dataclass(frozen=True, kw_only=True)
class Latency(Effect):
    """Events come later than the change they tell of, most of all in the dark.

    Photoreceptor, comparator and the pixel's request to be read all take time. The photoreceptor's share of
    it is the longer the smaller the photocurrent: it grows as 1/intensity, until the dark current takes over.
    Unlike a limited bandwidth, a latency does not smooth: every event comes, only later.

    At intensity 1 (white) an event leaves its pixel `delay` after the crossing, at intensity 0 `delay * (1 -
    light + light / dark)`, never more than 1 s. Of a sensor with the effect `dark` the dark current is that
    one: 1 / dark is then (1 + median current) / current there. The intensity is that of the sample which ends
    the step of the crossing. The events of one pixel do not overtake each other: one that is due before the
    last one has left leaves at the same time as that. A readout by lines sends one of those that leave at the
    same time, as a pixel asks once.
    """

    name: ClassVar[str] = "latency"
    source: ClassVar[str] = (
        "Lichtsteiner, Posch, Delbruck: A 128x128 120 dB 15 us latency asynchronous "
        "temporal contrast vision sensor, 2008 (latency over illumination)"
    )
    stages: ClassVar = {"delay": event_delay}
    signatures: ClassVar = (Makes("late events", tells=True, by="delay", absence=False),)
    screen_limits: ClassVar = {
        "": (
            "the delay is not told by a screen: its own lag cannot be known apart; an LED beside a trigger "
            "input tells it"
        ),
    }

    delay: float = parameter(
        1e-4,
        unit="s",
        off=0.0,
        bounds=(0.0, 0.1),
        plausible=(3e-6, 1e-2),
        about="from a crossing to its event at intensity 1",
        between_samples=True,
    )
    light: float = parameter(
        0.5,
        unit="1",
        bounds=(0.0, 1.0),
        plausible=(0.0, 1.0),
        about="share of the delay at intensity 1 that grows as 1/intensity",
    )
    dark: float = dark_share(
        "photocurrent at intensity 0 relative to that at intensity 1; 1 makes the delay constant"
    )

    def idle(self, beside: Sequence[Effect]) -> tuple[str, ...]:
        """Return the names of the parameters that change nothing."""
        return idle_beside(beside)
