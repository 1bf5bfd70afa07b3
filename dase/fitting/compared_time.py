"""Which time of a measurement is compared, and the measurement on the clock of that time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.events import Events
from dase.fitting.frame_steps import clip_step_of, frame_step_of, is_held, is_too_slow
from dase.fitting.measurement import Measurement
from dase.fitting.pixel_selection import find_trusted_parts
from dase.fitting.spliced_time import SplicedScene, SplicedTime
from dase.fitting.time_window import (
    WindowSettings,
    choose_windows,
    is_constant,
    repeated_gaps,
    sentence_of_windows,
    within_span,
)
from dase.probes.stimulus import STIMULUS, Grid, Trust
from dase.probes.timestamp_patterns import TimestampStructure, find_structure
from dase.scenes.between_frames import CameraScene
from dase.scenes.scene import Scene
from dase.scenes.screen_scene import ScreenScene
from dase.scenes.video import VideoScene

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ComparedTime:
    """The time of a measurement that is compared, and the measurement on the clock of that time.

    Args:
        events: Of that time.
        scene: What the camera saw.
        trust: Where and when the scene is to be trusted; None for everywhere.
        grid: Points of that time.
        still: Whether the light is known not to change; then it is not stored step by step.
        gaps: Begin and end of gaps in which data are missing [s], shape (G, 2).
        frame_step: Time from frame to frame of a clip in step with which all events come [s], 0 if they do
            not, see `frame_step_of`.
        clip_frames: Time from frame to frame of a clip [s], 0 of another scene.
        held: Whether the frames of a clip are held, see `VideoScene.held`.
        by_frames: Whether it is known that nobody knows the light between them, see `VideoScene`.
        asked: All time that was asked for, on the clock of the recording.
        windows: Those of it that are compared, in order.
        spliced: The windows laid end to end; None where there is one, and the clock is the recording's.
    """

    events: Events
    scene: Scene
    trust: Trust | None
    grid: Grid
    still: bool
    gaps: Array
    frame_step: float
    clip_frames: float
    held: bool
    by_frames: bool
    asked: Grid
    windows: tuple[Grid, ...]
    spliced: SplicedTime | None

    @cached_property
    def times(self) -> Array:
        """Times of the points of the grid [s], shape (T,)."""
        return times_of_grid(self.scene, self.grid)

    @property
    def when(self) -> Array:
        """Times of the points of the grid on the clock of the recording [s], shape (T,)."""
        return self.times if self.spliced is None else self.spliced.moments

    @property
    def has_holes(self) -> bool:
        """Whether parts of it are not compared: gaps, and what comes after a leap to another window."""
        return len(self.gaps) > 0 or self.spliced is not None

    def notes(self) -> list[str]:
        """Return what is said of frames and windows."""
        out = []
        if is_too_slow(self.frame_step) and not self.by_frames:
            out.append(
                "events come in step with the frames of the clip, as a simulator makes them that knows these "
                "frames alone: compared is from frame to frame"
            )
        if self.windows != (self.asked,):
            out.append(sentence_of_windows(self.asked, self.windows))
        return out

    def notes_on_gaps(self) -> list[str]:
        """Return what is said of missing data."""
        if not len(self.gaps):
            return []
        length = 1e3 * float(np.median(np.diff(self.gaps, axis=1)))
        count = len(self.gaps)
        return [f"{count} gaps of {length:.3g} ms without any event: data are missing, and left out"]


def choose_compared_time(
    measurement: Measurement, *, unbroken: bool, pixels: int, plenty: float = math.inf
) -> ComparedTime:
    """Return the time of a measurement that is compared: of a long one some windows, laid end to end.

    Args:
        measurement: Events and scene.
        unbroken: Whether time must go on without a break, so that there is one window.
        pixels: That are looked at, in each part.
        plenty: Events of the pixels of one part from which on a longer time is not compared.

    Raises:
        InputError: Different sizes, or no common time.
    """
    events, scene, trust = measurement.events, measurement.scene, measurement.trust
    if trust is None and isinstance(scene, CameraScene):
        trust = scene.is_trusted
    whole = common_grid(events, scene)
    frame_step, clip_frames = frame_step_of(events, scene) or 0.0, clip_step_of(scene)
    asked = within_span(whole, measurement.span)
    shorter = partial(
        choose_windows, events, scene, asked, pixels, plenty=plenty,
        compared=_share_compared(events, scene, asked, trust) if plenty < math.inf else 1.0,
    )  # fmt: skip
    windows = shorter(unbroken=unbroken)
    if len(windows) > 1 and find_structure(_within(events, windows[0])) != TimestampStructure():
        windows = shorter(unbroken=True)
    still = is_constant(scene)
    # a stimulus pauses by the clock
    pauses = isinstance(scene, ScreenScene)
    grid, spliced = windows[0], None
    if len(windows) > 1:
        spliced = _splice(scene, windows, still=still)
        events, scene, grid = spliced.events(events), SplicedScene(scene, spliced), spliced.grid
        if trust is not None:
            trust = partial(_trust_on_clock, trust, spliced)
    elif grid is not whole:
        events = _within(events, grid)
    # a simulator by frames loses nothing: it waits for a frame, or all of its pixels for their dead time
    held = is_held(measurement.scene)
    in_step = frame_step or held
    gaps = np.zeros((0, 2)) if pauses or in_step else repeated_gaps(events.t)
    by_frames = isinstance(measurement.scene, VideoScene) and measurement.scene.by_frames
    return ComparedTime(
        events, scene, trust, grid, still, gaps, frame_step, clip_frames, held, by_frames, asked, windows,
        spliced,
    )  # fmt: skip


def _splice(scene: Scene, windows: tuple[Grid, ...], *, still: bool) -> SplicedTime:
    """Return windows of a scene's time laid end to end."""
    settle = 2 if still else round(WindowSettings.settle / windows[0].step)
    return SplicedTime(windows, np.concatenate([times_of_grid(scene, one) for one in windows]), settle)


def _share_compared(events: Events, scene: Scene, grid: Grid, trust: Trust | None, looks: int = 40) -> float:
    """Return about which share of the events lies where a scene is trusted."""
    if trust is None:
        return 1.0
    return find_trusted_parts(events, scene, times_of_grid(scene, grid), 0, trust, most=looks).events


def _within(events: Events, grid: Grid) -> Events:
    """Return the events of a stretch of time."""
    inside = (events.t >= grid.begin) & (events.t <= grid.begin + grid.step * (grid.steps + 1))
    return events.select(inside)


def _trust_on_clock(
    trust: Trust, clock: SplicedTime, times: Array, pixels: NDArray[np.int32]
) -> NDArray[np.bool_]:
    """Return where a scene is trusted, shape (K, N), at times of the spliced clock [s], shape (K,)."""
    return trust(clock.real(times), pixels)


def common_grid(events: Events, scene: Scene) -> Grid:
    """Return the time that scene and events have in common, in equal steps [s].

    Raises:
        InputError: Different sizes, no events, or no time in common.
    """
    if (events.width, events.height) != (scene.width, scene.height):
        raise InputError(
            f"recording and scene must have one size, got {events.width}x{events.height} "
            f"and {scene.width}x{scene.height}"
        )
    times = scene.sample_times()
    if len(events) == 0:
        raise InputError("the recording has no events, so there is nothing to compare")
    begin, end = float(times[0]), float(times[-1])
    if events.t[-1] < begin or events.t[0] > end:
        raise InputError(
            f"recording and scene must overlap in time, got events from {events.t[0]:.6g} s to "
            f"{events.t[-1]:.6g} s and a scene from {begin:.6g} s to {end:.6g} s"
        )
    # steps of the scene itself need no interpolation, which would smooth what happens between them
    step = np.diff(times)
    even = len(step) > 0 and np.ptp(step) < 1e-3 * step.mean()
    own = even and STIMULUS.finest_step <= step.mean() <= STIMULUS.coarsest_step
    # nor does a simulator that knows its frames alone show anything between them
    own = own or (frame_step_of(events, scene) is not None and is_too_slow(float(step.mean())))
    h = float(step.mean()) if own else STIMULUS.common_step
    # after the last event a step or two of silence count, not minutes: the recording may have ended there
    last = min(end, float(events.t[-1]) + 2 * h)
    steps = int(np.floor((last - begin) / h + 1e-6)) + 1
    return Grid(begin, h, max(steps, 2))


def times_of_grid(scene: Scene, grid: Grid) -> NDArray[np.float64]:
    """Return the times of the grid [s], shape (T,), the scene's own where they differ by rounding only."""
    own = scene.sample_times()
    first = int(np.searchsorted(own, grid.begin - 0.5 * grid.step))
    own = own[first : first + grid.steps]
    if len(own) == grid.steps and np.allclose(own, grid.times, rtol=0, atol=1e-3 * grid.step):
        return own
    # the last point may lie beyond the scene by a rounding
    begin, end = (float(time) for time in scene.sample_times()[[0, -1]])
    inside: NDArray[np.float64] = np.clip(grid.times, begin, end)
    return inside
