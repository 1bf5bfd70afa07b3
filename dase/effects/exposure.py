"""Frames that disturb the pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import warp as wp

from dase.effects.base import Effect, Observations, parameter
from dase.effects.made_signatures import Makes

BURST = 1e-3
"""Longest time between samples at an edge [s]: bursts of recorded cameras last 1 to 3 ms."""


@wp.func
def coupled(
    voltage: float,
    t64: wp.float64,
    amplitude: float,
    spread: float,
    period: float,
    exposure: float,
    begin: float,
    pixel_normal: float,
):
    """Voltage with a square wave on it, high while a frame is exposed."""
    # float32 resolves no more than a quarter of a millisecond after an hour
    since = t64 - wp.float64(begin)
    frames = since / wp.float64(period)
    into = float((frames - wp.floor(frames)) * wp.float64(period))
    # what float32 may have rounded off the period, in every frame so far, and off the other times; far less
    # than the time between samples, as after hours it would itself put the edges out of step
    slack = wp.min(7.0e-8 * (float(wp.abs(since)) + wp.abs(begin) + period + exposure), 2.0e-5)
    # the edges lie between two samples: a sample at the very begin of an exposure is of the frame before
    if into <= slack:
        into += period
    if into <= exposure + slack:
        voltage += amplitude * (1.0 + spread * pixel_normal)
    return voltage


@dataclass(frozen=True, kw_only=True)
class Exposure(Effect):
    """Frames that disturb the pixels.

    A DAVIS has frames and events from the same photodiode. When an exposure begins and when it ends, its
    shutter's wires couple onto the voltage of every pixel: a burst of ON events over the whole array at the
    one, of OFF events at the other, in step with the frames, also where nothing moves. Two recordings of
    DAVIS240 cameras have 8 and 18 % of their events from this.

    The log voltage is higher by `amplitude` from `begin + n · period` on, for `exposure` seconds. The
    coupling differs from pixel to pixel, so only some reach a threshold. Nothing filters it: it acts behind
    the photoreceptor.
    """

    name: ClassVar[str] = "exposure"
    unbroken: ClassVar[bool] = True
    source: ClassVar[str] = (
        "Brandli, Berner, Yang, Liu, Delbruck: A 240x180 130 dB 3 us latency global shutter spatiotemporal "
        "vision sensor, 2014 (frames and events of one photodiode); seen in recordings of DAVIS240B and 240C"
    )
    stages: ClassVar = {"respond": coupled}
    signatures: ClassVar = (Makes("frame coupling", tells=True),)

    amplitude: float = parameter(
        0.15,
        unit="log intensity",
        off=0.0,
        bounds=(-5.0, 5.0),
        plausible=(0.02, 1.0),
        about="mean over pixels of the step at the begin of an exposure, taken back at its end",
    )
    spread: float = parameter(
        0.3,
        unit="1",
        bounds=(0.0, 3.0),
        plausible=(0.05, 1.0),
        about="standard deviation of the step over pixels, relative to its mean",
    )
    period: float = parameter(
        0.04,
        unit="s",
        bounds=(1e-4, 100.0),
        plausible=(0.01, 0.2),
        about="from the begin of one frame to that of the next",
        fitted=False,  # frames of any other period soon are out of step with the measured ones
    )
    exposure: float = parameter(
        0.01,
        unit="s",
        bounds=(0.0, 100.0),
        plausible=(1e-3, 0.15),
        about="duration of an exposure; beyond the period it never ends",
        fitted=False,  # the bursts are sharp: a step of the search would leave them
    )
    begin: float = parameter(
        0.0,
        unit="s",
        bounds=(-1e6, 1e6),
        plausible=(0.0, 0.2),
        about="begin of an exposure, on the clock of the events",
        fitted=False,
    )

    @classmethod
    def candidates(cls, observed: Observations) -> list[Self]:
        """Return the frames whose bursts are seen, if any are."""
        if not observed.frame_interval:
            return []
        # a wave that is high outside of exposures is one that is high for the rest of the period
        begin = observed.frame_begin % observed.frame_interval
        return [cls(period=observed.frame_interval, exposure=observed.frame_exposure, begin=begin)]

    def in_step(self, observed: Observations) -> Exposure:
        """Return the same coupling at the times of the frames that are seen; as it is where none are."""
        for seen in type(self).candidates(observed):
            return self.at_frames(seen.period, seen.exposure, seen.begin)
        return self

    def at_frames(self, period: float, exposure: float, begin: float) -> Exposure:
        """Return the same coupling at frames [s] that begin at `begin` and every `period` behind it."""
        return replace(self, period=period, exposure=exposure, begin=begin)

    def shifted(self, seconds: float) -> Exposure:
        """Return the frames on a clock that shows `seconds` less."""
        return replace(self, begin=(self.begin - seconds) % self.period)

    def longest_step(self) -> float:
        """Return the longest time between samples that still shows the effect [s]."""
        if not self.amplitude:
            return math.inf
        lasts = [span for span in (self.exposure, self.period - self.exposure) if span > 0]
        # two samples at least lie inside, so both edges are met; more would only make the bursts sharper
        return min(min(lasts, default=self.period) / 3, BURST)
