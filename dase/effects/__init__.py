"""Physical effects, one per file.

To add one: its file with its dataclass and its Warp functions, its line in `EFFECTS`, its twin and its test.
"""

from __future__ import annotations

from collections.abc import Mapping

from dase.effects.anti_flicker import AntiFlicker
from dase.effects.bandwidth import Bandwidth
from dase.effects.base import Effect as Effect
from dase.effects.base import Observations as Observations
from dase.effects.base import Parameter as Parameter
from dase.effects.base import choice as choice
from dase.effects.base import parameter as parameter
from dase.effects.bayer import Bayer
from dase.effects.dark import Dark
from dase.effects.dead import Dead
from dase.effects.double_events import DoubleEvents
from dase.effects.exposure import Exposure
from dase.effects.flicker import Flicker
from dase.effects.high_pass import HighPass
from dase.effects.hot import Hot
from dase.effects.jitter import Jitter
from dase.effects.latency import Latency
from dase.effects.leak import Leak
from dase.effects.learned_threshold import LearnedThreshold
from dase.effects.linlog import Linlog
from dase.effects.made_signatures import Makes as Makes
from dase.effects.mismatch import Mismatch
from dase.effects.optics import SceneEffect as SceneEffect
from dase.effects.optics_blur import OpticsBlur
from dase.effects.rate_control import RateControl
from dase.effects.readout import Readout
from dase.effects.refractory import Refractory
from dase.effects.row_scan import RowScan
from dase.effects.second_order import SecondOrder
from dase.effects.shot import Shot
from dase.effects.stream import Reader as Reader
from dase.effects.stream import StreamEffect as StreamEffect
from dase.effects.threshold import Threshold
from dase.effects.timestamp import Timestamp
from dase.effects.trail_filter import TrailFilter
from dase.effects.vignetting import Vignetting
from dase.effects.voltage_noise import VoltageNoise
from dase.errors import InputError, nearest

_ORDER = (
    # light
    OpticsBlur,
    Bayer,
    Flicker,
    Vignetting,
    Dark,
    # photoreceptor
    Linlog,
    Bandwidth,
    SecondOrder,
    VoltageNoise,
    Exposure,
    HighPass,
    # change detector
    Threshold,
    LearnedThreshold,
    Mismatch,
    Jitter,
    Leak,
    Shot,
    Hot,
    Refractory,
    Dead,
    # readout
    Latency,
    RowScan,
    Readout,
    DoubleEvents,
    Timestamp,
    # filters of the camera's own logic, on stamped events
    AntiFlicker,
    TrailFilter,
    RateControl,
)

EFFECTS: dict[str, type[Effect]] = {effect.name: effect for effect in _ORDER}
"""Name in sensor files to class, in the order in which they act."""


def find_effect(name: str, effects: Mapping[str, type[Effect]] = EFFECTS) -> type[Effect]:
    """Return the effect of this name; raises InputError with the nearest known name."""
    if name not in effects:
        raise InputError(
            f"there is no effect '{name}': {nearest(name, effects)} (your own needs its file)",
            argument="effects",
        )
    return effects[name]
