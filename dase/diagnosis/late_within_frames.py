"""Delays within the frames of a clip, beside a clock, a scan of the rows or a lens.

A simulator that knows frames alone sends the events of one at its end, or evenly in it, up to a frame late.
That shows in the times of its events (`dase.fitting.frame_steps`), unless a scan of the rows has moved
them, or a clock has rounded them: then it looks like a latency or a low-pass. Nor is it known whether the
clock of a simulator shows the tick before an event, as a camera's does, or the one after it, a tick later.
Behind a lens, whose width is known to some per cent, light goes from frame to frame in a way that is not
quite known, and a fast low-pass makes up for some of that.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from dase.effects import Effect
from dase.effects.bandwidth import Bandwidth
from dase.effects.latency import Latency
from dase.effects.optics_blur import OpticsBlur
from dase.effects.row_scan import RowScan
from dase.effects.second_order import SecondOrder
from dase.effects.timestamp import Timestamp
from dase.fitting.frame_steps import clip_step_of
from dase.results import Finding, Grade
from dase.scenes.scene import Scene
from dase.simulation.sensor import Sensor

COARSE_CLOCK = 0.25
"""Share of a frame from which on the steps of a clock hide when in it a simulator sends."""


def doubt_delays_within_frames(
    findings: Mapping[str, Finding], sensor: Sensor, scene: Scene
) -> dict[str, Finding]:
    """Return findings in which delays shorter than a frame or a tick of the clock may be something unknown.

    Those shorter than a frame may where rows are scanned, the clock is coarse, or the clip is seen through a
    lens.

    Args:
        findings: Effect to what the search says of it.
        sensor: The last model, with the lens through which a clip is seen.
        scene: The light.
    """
    gap = clip_step_of(scene)
    if not gap:
        return dict(findings)
    tick = max((one.step for one in sensor.effects if isinstance(one, Timestamp)), default=0.0)
    hidden = gap if any(_hides_frames(one, gap) for one in sensor.effects) else 0.0
    shortest = max(hidden, tick)
    late = {one.name: _delay_of(one) for one in sensor.effects}
    return {
        name: replace(one, grade=Grade.EITHER, unknown=True)
        if one.grade is Grade.SUPPORTED and 0 < late.get(name, 0.0) < shortest
        else one
        for name, one in findings.items()
    }


def _hides_frames(effect: Effect, gap: float) -> bool:
    """Return whether beside an effect it does not show how late events of frames a time apart [s] are."""
    if isinstance(effect, Timestamp):
        return effect.step >= COARSE_CLOCK * gap
    return isinstance(effect, RowScan | OpticsBlur)


def _delay_of(effect: Effect) -> float:
    """Return about how late an effect makes events in bright light [s]; 0 of others."""
    if isinstance(effect, Latency):
        return effect.delay
    if isinstance(effect, Bandwidth):
        return 1 / (2 * math.pi * effect.cutoff)
    return 2 * effect.damping / (2 * math.pi * effect.cutoff) if isinstance(effect, SecondOrder) else 0.0
