"""ON events in the dark and at rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import warp as wp

from dase.effects.base import Effect, parameter
from dase.effects.made_signatures import Makes


@wp.func
def leak_drift(
    illumination: float,
    nominal_on: float,
    rate: float,
    spread: float,
    light: float,
    threshold: float,
    pixel_normal: float,
):
    """Speed at which the pixel's memory leaks away, towards ON [log intensity/s]."""
    way = wp.where(threshold > 0.0, threshold, nominal_on)
    return wp.max(rate * (1.0 + spread * pixel_normal), 0.0) * way * (1.0 + light * illumination)


@dataclass(frozen=True, kw_only=True)
class Leak(Effect):
    """ON events of pixels that see no change.

    A pixel keeps its memory on a capacitor whose reset switch leaks. The memory drifts down, so even in a
    static scene a pixel sends ON events at a regular, low rate, and moving scenes have slightly more ON than
    OFF events. The leak differs from pixel to pixel.

    Two currents leak: that of the switch's junction, and a parasitic photocurrent, since light also falls on
    the switch. The latter grows with the light on it, so bright scenes leak more; the photodiode's dark
    current is none of it. Both move the memory at a speed of their own; a pixel of low ON threshold sends
    more leak events, in proportion to 1 / threshold. (v2e gives every pixel the same rate whatever its
    threshold.) So does a camera whose biases lower all thresholds, if `threshold` says at which one `rate`
    was measured: the speed is rate · threshold. Without it the rate is that of the sensor's own threshold.
    """

    name: ClassVar[str] = "leak"
    source: ClassVar[str] = (
        "Nozaki, Delbruck: Temperature and parasitic photocurrent effects in dynamic vision sensors, 2017"
    )
    stages: ClassVar = {"drift": leak_drift}
    signatures: ClassVar = (Makes("leak events", tells=True), Makes("drifting memory", tells=True))
    screen_limits: ClassVar = {
        "rate": "a leak wants minutes at rest, in even light or under a lens cap",
        "light": "how leak grows with light wants more light than a screen has: an LED or daylight, at rest",
    }

    rate: float = parameter(
        0.1,
        unit="Hz",
        off=0.0,
        bounds=(0.0, 1e5),
        plausible=(0.01, 20.0),
        about="ON events per second of a pixel of nominal ON threshold, in the dark",
    )
    spread: float = parameter(
        0.1,
        unit="1",
        bounds=(0.0, 1.0),
        plausible=(0.0, 0.5),
        about="standard deviation of the current over pixels, relative to it",
    )
    light: float = parameter(
        0.0,
        unit="1",
        bounds=(0.0, 1e4),
        plausible=(0.0, 30.0),
        about="parasitic photocurrent at intensity 1, relative to the leak in the dark",
    )
    threshold: float = parameter(
        0.0,
        unit="log intensity",
        bounds=(0.0, 10.0),
        plausible=(0.0, 1.0),
        about="ON threshold at which `rate` was measured; 0 for the sensor's own",
        fitted=False,  # events show the product of the two
    )
