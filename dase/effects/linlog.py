"""A photoreceptor that is linear in the dark."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import warp as wp

from dase.effects.base import Effect, parameter
from dase.effects.made_signatures import Makes
from dase.kernels.vector_math import exponential, logarithm


@wp.func
def linlog_voltage(voltage: float, log_eps: float, knee: float, slope: float):
    """Voltage that falls linearly with the intensity below the knee."""
    out = voltage
    if knee > 0.0:
        top = logarithm(knee + log_eps)
        if voltage < top:
            out = top + slope * (exponential(voltage - top) - 1.0)
    return out


@dataclass(frozen=True, kw_only=True)
class Linlog(Effect):
    """A photoreceptor that is linear in the dark.

    The photoreceptor takes the logarithm of the light, but not down to nothing: below a knee its voltage
    follows the light itself. Relative changes of very dark parts then make fewer events. Simulators use it
    also so that the noise of dark 8-bit pixels does not become large in the logarithm.

    Above `knee` the voltage is log(intensity), below it a straight line in the intensity that meets it there.
    With `slope` 1 (the default) the two have the same slope at the knee: the response is smooth. v2e draws
    the line through log(1 / 255) at intensity 0, with the knee at 20 / 255: slope log(20) = 3, a kink.
    """

    name: ClassVar[str] = "linlog"
    source: ClassVar[str] = (
        "Hu, Liu, Delbruck: v2e, from video frames to realistic DVS events, 2021 (lin-log mapping)"
    )
    stages: ClassVar = {"respond": linlog_voltage}
    signatures: ClassVar = (
        Makes("larger steps in the dark", tells=True, by="knee", absence=False),
        Makes("kinked response", tells=True, absence=False),
    )
    screen_limits: ClassVar = {
        "": "the knee wants light far below a screen's black: a lamp and grey filters over four decades",
    }

    knee: float = parameter(
        20 / 255,
        unit="intensity",
        off=0.0,
        bounds=(0.0, 1.0),
        plausible=(1e-3, 0.3),
        about="below it the response is linear",
    )
    slope: float = parameter(
        1.0,
        unit="1",
        bounds=(0.0, 10.0),
        plausible=(0.5, 3.5),
        about="of the linear part at the knee, relative to that of the logarithm; 1 is smooth",
        starts="ends",
    )
