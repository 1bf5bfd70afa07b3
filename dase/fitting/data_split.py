"""A measurement, split in three: what is fitted, what chooses between models, and what reports."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dase.effects.base import Observations
from dase.errors import InputError, checked_seed
from dase.events import Events
from dase.fitting.batch_simulator import BatchSimulator
from dase.fitting.bus_load import WholeSensor
from dase.fitting.bus_use import BusUse, highest_event_rate
from dase.fitting.contradictions import contradiction_of_rest
from dase.fitting.frame_steps import clip_step_of, frame_step_of, is_held, is_too_slow, ticks_are_of_frames
from dase.fitting.pixel_selection import choose_trusted_pixels, find_trusted_parts
from dase.fitting.spliced_time import SplicedScene, SplicedTime
from dase.fitting.subset import Array, CalibratedSubset, PixelSubset
from dase.fitting.time_window import (
    WindowSettings,
    choose_windows,
    is_constant,
    outside_gaps,
    repeated_gaps,
    sentence_of_windows,
    within_span,
)
from dase.formatting import format_seconds
from dase.kernels import event_probes as kernels
from dase.kernels import launch
from dase.probes.accumulators import ProbeSums, StatisticsFrame
from dase.probes.random_streams import Draw
from dase.probes.statistics import RatePeak, peak_of, refine_frequency, ring_of_pixels
from dase.probes.stimulus import (
    MASKED,
    STIMULUS,
    Grid,
    Stimulus,
    Trust,
    band_edges,
    light_of,
    sort_into_cells,
)
from dase.probes.timestamp_patterns import TimestampStructure, find_structure
from dase.scenes.between_frames import CameraScene
from dase.scenes.scene import Scene
from dase.scenes.screen_scene import ScreenScene
from dase.scenes.video import VideoScene
from dase.signatures.burst_times import BurstTimes


@dataclass(frozen=True)
class SplitSettings:
    """How a measurement is split, and what there must be of it."""

    pixels: int = 1500
    """Pixels in each part of the measurement."""

    scouts: int = 500
    """Pixels of the scout, a third of those that are fitted: sampling errors are larger by less than 2."""

    fitted_share: float = 0.6
    """Share of the time that is fitted; the rest is held out. What judges needs less than what is fitted."""

    least_pixels: int = 16
    """Pixels without which a part says nothing."""

    least_events: int = 300
    """Events that a part must have for anything to be said."""

    large: float = 0.25
    """Share of the pixels' time at rest, or not at rest, that the later part of the time must have for the
    fitted part to lack it."""

    small: float = 0.25
    """What the fitted part has of it at most, in units of that."""

    burst: float = 2e-3
    """Events are counted for so long to see how fast they come at most [s]: long enough for many of them,
    and short enough for a bus to be full all the time."""


SPLIT = SplitSettings()

ROWS = 512
"""Pixels whose steps are sorted into cells at a time, for the memory that takes."""

PARTS = 3
"""Groups of pixels: those that are fitted, that choose between models, and that report."""


@dataclass(frozen=True, eq=False)
class SplitMeasurement:
    """A measurement and the scene it is of.

    Args:
        train: Pixels and time that are fitted.
        held: Other pixels, at a later time, which choose between models; with `all_time`, that time is
            fitted, too.
        report: Again other pixels, at that later time: nothing is chosen by them, so what they say of the
            chosen model is not better than it is.
        scout: Some of the pixels that are fitted, for what need not be exact.
        bands: Intensities between the bands, shape (BANDS - 1,).
        structure: Regularities of the time stamps.
        peak: Frequency at which the rate swings most [Hz], and what chance says of it.
        highest_event_rate: Most events per second of all pixels [Hz].
        bus: How busy a bus, if there is one, can have been.
        when: Times of the points of the grid on the clock of the scene [s], shape (T,): windows of a long
            recording are laid end to end.
        notes: What the data cannot show.
        contradiction: Why the events cannot be of the scene, in a sentence; empty where they may.
        frames: When the bursts come that are in step with frames, where they are compared.
        frame_step: Time from frame to frame of a clip in step with which all events come [s], 0 if they do
            not, see `frame_step_of`.
        clip_frames: Time from frame to frame of a clip [s], 0 of another scene.
    """

    train: PixelSubset
    held: PixelSubset
    report: PixelSubset
    scout: PixelSubset
    bands: Array
    structure: TimestampStructure
    peak: RatePeak
    highest_event_rate: float
    bus: BusUse
    when: Array
    notes: tuple[str, ...] = ()
    contradiction: str = ""
    frames: BurstTimes | None = None
    frame_step: float = 0.0
    clip_frames: float = 0.0

    def observe(self, *, idle_bus: float) -> Observations:
        """Return what effects may choose their candidates by, see `Observations`."""
        frames = self.frames
        return Observations(
            peak_frequency=self.peak.frequency,
            peak_chance=self.peak.chance,
            clock_period=self.structure.step,
            line_time=self.structure.line,
            scan_direction=self.structure.direction,
            highest_event_rate=self.highest_event_rate,
            bus_loss=self.bus.loss,
            bus_load=self.bus.load,
            row_load=self.bus.row_load,
            column_load=self.bus.column_load,
            idle_bus=idle_bus,
            frame_interval=frames.interval if frames else 0.0,
            frame_begin=frames.begin if frames else 0.0,
            frame_exposure=frames.exposure if frames else 0.0,
            clip_step=self.frame_step,
            clip_frames=self.clip_frames,
        )

    @property
    def light_never_changes(self) -> bool:
        """Whether no pixel sees a change of light, so that nothing tells how much change an event takes."""
        return all(half.trials.stimulus.never_changes for half in (self.train, self.held, self.report))

    @property
    def parts_differ(self) -> bool:
        """Whether the time that is fitted hardly has the rest, or the change, of light that the later has.

        What a sensor sends at rest cannot be fitted where nothing rests.
        """
        fitted, later = (half.trials.stimulus.share_at_rest() for half in (self.train, self.held))
        return any(
            there > SPLIT.large and here < SPLIT.small * there
            for here, there in ((fitted, later), (1.0 - fitted, 1.0 - later))
        )

    @property
    def evaluations(self) -> int:
        """Models run so far."""
        return sum(half.trials.evaluations for half in (self.train, self.held, self.report, self.scout))

    @property
    def samples(self) -> int:
        """Pixels times samples of all models run so far."""
        return sum(half.trials.samples for half in (self.train, self.held, self.report, self.scout))


@dataclass(frozen=True, eq=False)
class CalibratedSplit(SplitMeasurement):
    """A measurement with a present model on its training half and its scout, for comparing candidates."""

    train: CalibratedSubset
    scout: CalibratedSubset


def split_measurement(
    events: Events,
    scene: Scene,
    *,
    log_eps: float = 1e-3,
    trust: Trust | None = None,
    span: tuple[float, float] | None = None,
    left_out: Callable[[Array], NDArray[np.bool_]] | None = None,
    odd_pixels: NDArray[np.int64] | None = None,
    lamp: float | None = None,
    frames: BurstTimes | None = None,
    unbroken: bool = False,
    all_time: bool = False,
    plenty: float = math.inf,
    pixels: int = SPLIT.pixels,
    seed: int = 0,
    device: str = "cpu",
    settings: SplitSettings = SPLIT,
) -> SplitMeasurement:
    """Split a measurement into what is fitted, what chooses between models, and what reports.

    Args:
        events: What was measured.
        scene: What the camera saw, on the clock of the events.
        log_eps: Added to intensities before the logarithm.
        trust: Where and when the scene is to be trusted, all else is left out; None for everywhere, and for
            what a `CameraScene` trusts of itself.
        span: First and last time that is compared [s]; None for all. Of a long time windows are chosen, see
            `choose_windows`.
        left_out: Tells which times [s], shape (T,), are left out; None for none.
        odd_pixels: Row-major indices of pixels that are left out, shape (K,); None for none.
        lamp: Frequency of light that flickers [Hz] where all events have told it; None to look for it here.
        frames: When the bursts come that are in step with frames; None where there are none, or left out.
        unbroken: Whether a long recording is compared in one window, not in several over its length, as
            models with a clock of their own need it, see `Sensor.unbroken`; so it is where there is a lamp
            or bursts with frames, where times are left out, and where time stamps follow a regularity.
        all_time: Whether all of the time is fitted, not its first part alone. What judges are other pixels
            in the later part all the same, but no other time.
        plenty: Events of the pixels of one part from which on a longer time is not compared.
        pixels: In each part.
        seed: Of the choice of pixels.
        device: Where kernels run.
        settings: How it is split.

    Raises:
        InputError: Different sizes, no common time, or too few events.
    """
    # offsets are added for further random numbers, and batches count in 30 bits
    checked_seed(seed, 1 << 30)
    if trust is None and isinstance(scene, CameraScene):
        trust = scene.is_trusted
    whole = common_grid(events, scene)
    frame_step, clip_frames = frame_step_of(events, scene) or 0.0, clip_step_of(scene)
    driven = is_too_slow(frame_step)
    asked = within_span(whole, span)
    # the phase of what goes by a clock of its own would not go on from window to window
    unbroken = unbroken or lamp is not None or left_out is not None or frames is not None
    shorter = partial(
        choose_windows, events, scene, asked, pixels, plenty=plenty,
        compared=_share_compared(events, scene, asked, trust) if plenty < math.inf else 1.0,
    )  # fmt: skip
    windows = shorter(unbroken=unbroken)
    if len(windows) > 1 and find_structure(_within(events, windows[0])) != TimestampStructure():
        windows = shorter(unbroken=True)
    grid = windows[0]
    when = times_of_grid(scene, grid)
    # light that does not change is not stored step by step
    still = is_constant(scene)
    # a stimulus pauses by the clock
    pauses = isinstance(scene, ScreenScene)
    settled = None
    if len(windows) > 1:
        when = np.concatenate([times_of_grid(scene, one) for one in windows])
        settle = 2 if still else round(WindowSettings.settle / grid.step)
        spliced = SplicedTime(windows, when, settle)
        events, scene, grid = spliced.events(events), SplicedScene(scene, spliced), spliced.grid
        settled = spliced.settled
        if trust is not None:
            trust = partial(_trust_on_clock, trust, spliced)
    elif grid is not whole:
        events = _within(events, grid)
    # a simulator by frames loses nothing: it waits for a frame, or all of its pixels for their dead time
    in_step = frame_step or is_held(scene)
    gaps = np.zeros((0, 2)) if pauses or in_step else repeated_gaps(events.t)
    try:
        to = launch.find_device(device)
    except ValueError as error:
        raise InputError(str(error)) from error
    size = scene.width * scene.height
    each = min(pixels, (size - (0 if odd_pixels is None else len(odd_pixels))) // PARTS)
    if each < settings.least_pixels:
        raise InputError(
            f"a diagnosis needs at least {settings.least_pixels} pixels to fit, as many to choose by and as "
            f"many to report by, got {pixels} of {scene.width}x{scene.height}"
        )
    # a stream of its own: the same pixels are chosen whatever else is drawn from the seed
    rng, notes = Draw.PIXELS.generator(seed), list[str]()
    if driven and not (isinstance(scene, VideoScene) and scene.by_frames):
        notes.append(
            "events come in step with the frames of the clip, as a simulator makes them that knows these "
            "frames alone: compared is from frame to frame"
        )
    if windows != (asked,):
        notes.append(sentence_of_windows(asked, windows))
    # time is cut, not drawn: moments between fitted ones would be known from these
    cut = max(2, round(settings.fitted_share * grid.steps))
    if trust is None:
        # other pixels judge: fixed patterns, such as mismatch, would be known from the fitted ones
        order = rng.permutation(size)
        if odd_pixels is not None:
            order = order[~np.isin(order, odd_pixels)]
        chosen = order[: PARTS * each].astype(np.int32)
    else:
        if odd_pixels is not None:
            trust = partial(_trust_but_in, odd_pixels, trust)
        looks = find_trusted_parts(events, scene, times_of_grid(scene, grid), cut, trust)
        chosen = choose_trusted_pixels(looks, each, rng, least=settings.least_pixels)
        each = len(chosen) // PARTS
        notes.append(looks.sentence())
    # from the begin of the scene also for the half that judges: filters and memories are settled there
    times = times_of_grid(scene, grid)
    light = light_of(scene, times[:1] if still else times, chosen)
    if not np.all(np.isfinite(light)) or light.min() < 0:
        raise InputError("scene: intensities must be finite and >= 0")
    light = np.broadcast_to(light, (len(chosen), len(times))) if still else light
    # a row for all pixels where all are trusted alike
    good = np.ones((1, len(times)), np.bool_) if trust is None else trust(times, chosen).T.copy()
    if len(gaps):
        good &= outside_gaps(gaps)(times)
        length = 1e3 * float(np.median(np.diff(gaps, axis=1)))
        notes.append(f"{len(gaps)} gaps of {length:.3g} ms without any event: data are missing, and left out")
    if left_out is not None:
        good &= ~left_out(times)
    if settled is not None:
        good &= settled(times)
    good[:, 1:] &= good[:, :-1]  # a step is what lies between two points of the grid
    # all parts have the same bands, or a cell would mean another brightness in each; what reports has no say
    several = light[: 2 * each]
    bands = band_edges(several, np.broadcast_to(good[: 2 * each], several.shape))
    sorting = partial(sort_into_cells, step=grid.step, bands=bands, log_eps=log_eps)
    first, *last = (slice(n * each, (n + 1) * each) for n in range(PARTS))
    # filters over time go pixel by pixel, so parts of the pixels give the same as all of them
    cell = [np.empty((each, len(times)), np.uint8) for _ in range(PARTS)]

    works: list[Callable[[], Any]] = [
        partial(_sort_into, cells[n : n + ROWS], light[part * each + n :], sorting)
        for part, cells in enumerate(cell)
        for n in range(0, each, ROWS)
    ]
    works.append(partial(find_structure, events))
    *_, structure = launch.run_concurrently(works)
    # of frames that are held all events come so long after one
    structure = TimestampStructure() if is_held(scene) else structure
    # a clock would show the tick before each event of a model, often in the frame before
    if ticks_are_of_frames(structure.step, frame_step, events, scene):
        notes.append(
            f"time stamps are multiples of {format_seconds(structure.step)} in step with the frames of the "
            "clip: times between frames are made by a simulator that knows these frames alone, and are not "
            "compared"
        )
        structure = TimestampStructure()
    for n, cells in enumerate(cell):
        if len(good) == 1:
            cells[:, ~good[0]] = MASKED
        else:
            cells[~good[n * each : (n + 1) * each]] = MASKED
        cells[:, 0] = MASKED  # no step ends at the first point
        # what judges is simulated over all of the time and compared in the later part only
        if n > 0:
            cells[:, :cut] = MASKED
    fitted = grid if all_time else replace(grid, steps=cut)
    pieces = [(first, fitted, cell[0][:, : fitted.steps].copy(), 0)]
    pieces += [(part, grid, cells, cut) for part, cells in zip(last, cell[1:], strict=True)]
    del cell, cells, works, good  # large, and no longer needed
    highest = highest_event_rate(events, SPLIT.burst)
    halves: list[PixelSubset] = []
    for part, stretch, cells, begins in pieces:
        stimulus = Stimulus(
            chosen[part], scene.width, scene.height, stretch, light[part, : stretch.steps], cells, log_eps,
            to, trust is not None or len(gaps) > 0 or left_out is not None or settled is not None,
        )  # fmt: skip
        halves.append(make_subset(stimulus, events, begins, structure, highest_rate=highest))
    _require_enough_events(halves, events, grid, notes, settings.least_events)
    few = halves[0].trials.stimulus.part(settings.scouts)
    halves.append(make_subset(few, events, 0, structure, highest_rate=highest))
    # seen in the fitted half: what judges must not choose
    peak = peak_of(halves[0].found.clock[0], grid.step)
    if lamp is not None:
        peak = RatePeak(lamp, 0.0)
    elif trust is None:  # else most events are where the scene is not known
        end = grid.begin + cut * grid.step
        peak = peak._replace(frequency=refine_frequency(events, grid.begin, end, peak.frequency))
    train, held, last_part, scout = (
        replace(
            half,
            frame=replace(half.frame, peak=peak.frequency),
            # where the scene is trusted here and there only, nobody knows what all pixels send
            around=WholeSensor(scene, times_of_grid(scene, grid), seed, device) if trust is None else None,
        )
        for half in halves
    )
    bus = BusUse.of(events, structure, span=SPLIT.burst)
    contradiction = contradiction_of_rest(events, light[:, :1] if still else light)
    if contradiction:
        notes.insert(0, contradiction)
    out = SplitMeasurement(
        train, held, last_part, scout, bands, structure, peak, highest, bus, when,
        tuple(notes), contradiction, frames, frame_step, clip_frames,
    )  # fmt: skip
    if out.light_never_changes:
        notes.append(
            "the light never changes: nothing tells how much change an event takes, and thresholds are not "
            "fitted"
        )
    return replace(out, notes=tuple(notes))


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


def _trust_but_in(
    odd_pixels: NDArray[np.int64], trust: Trust, times: Array, pixels: NDArray[np.int32]
) -> NDArray[np.bool_]:
    """Return what a trust says, and that some pixels are not to be trusted, shape (T, N)."""
    return trust(times, pixels) & ~np.isin(pixels, odd_pixels)


def _sort_into(
    cells: NDArray[np.uint8],
    light: NDArray[np.float32],
    sorting: Callable[[NDArray[np.float32]], NDArray[np.uint8]],
) -> None:
    """Sort the steps of pixels into cells, shape (N, T), by their light, at least as many rows."""
    cells[:] = sorting(light[: len(cells)])


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


def make_subset(
    stimulus: Stimulus, events: Events, first: int, structure: TimestampStructure, *, highest_rate: float
) -> PixelSubset:
    """Return what was measured of some pixels.

    Args:
        stimulus: Their light.
        events: Of the whole sensor, or of these pixels.
        first: Step from which on they are compared.
        structure: Regularities of the time stamps.
        highest_rate: Most events per second of the whole sensor [Hz].
    """
    trials = BatchSimulator(stimulus, structure=structure, highest_rate=highest_rate)
    # looked at twice: sums of deviations from the typical change need that change, which the first look tells
    trials = trials.with_middle(typical_changes(trials.look(events)))
    found = trials.look(events)
    seconds = stimulus.grid.step * (stimulus.grid.steps - first)
    # no model has been run yet; `calibrate` puts what the present one expects in place of these zeros
    expected = np.zeros((len(stimulus.pixels), kernels.HALVES))
    zone = ring_of_pixels(stimulus.pixels, stimulus.width, stimulus.height)
    regular = structure.step > 0 or structure.line > 0
    frame = StatisticsFrame(expected, zone, seconds, first, stimulus.grid.step, regular=regular)
    return PixelSubset(trials, found, frame)


def typical_changes(sums: ProbeSums) -> NDArray[np.float32]:
    """Return the mean change of the light between two events by polarities and interval, (4 CLASSES,)."""
    pairs = sums.sums[0, kernels.SumPlace.CHANGE : kernels.SumPlace.CHANGE + 12 * kernels.CLASSES].reshape(
        -1, 3
    )
    return (pairs[:, 1] / np.maximum(pairs[:, 0], 1)).astype(np.float32)


def _require_enough_events(
    halves: list[PixelSubset], events: Events, grid: Grid, notes: list[str], least: int
) -> None:
    counts = [int(half.found.halves.sum()) for half in halves]
    for half, count, name in zip(halves, counts, ("fitting", "judging", "reporting"), strict=True):
        if count < least:
            helps = _what_helps(half, count, max(counts), events, grid, least)
            raise InputError(
                f"too few events to say anything: {count} of the {len(events)} lie in the part for {name}, "
                f"at least {least} are needed; {helps}" + "".join(f"; {note}" for note in notes)
            )


def _what_helps(half: PixelSubset, count: int, other: int, events: Events, grid: Grid, least: int) -> str:
    """Return what would give a part of a measurement enough events."""
    stimulus, first = half.trials.stimulus, half.frame.first
    begin, end = (grid.begin + grid.step * n for n in (first, stimulus.grid.steps))
    inside = int(np.count_nonzero((events.t >= begin) & (events.t < end)))
    size, looked = stimulus.width * stimulus.height, len(stimulus.pixels)
    # twice as many as are missing on the average: pixels differ
    wanted = int(np.ceil(2 * least / max(count, 1) * looked / 100) * 100)
    if stimulus.holes and inside * looked >= 2 * least * size:
        return "most lie where the scene is not known: frames more often or less motion help"
    if count and wanted <= size // PARTS and inside >= 2 * least:
        return f"looking at more pixels helps, {wanted} instead of {looked} (pixels)"
    span = f"{begin:.3g} s to {end:.3g} s"
    if inside < len(events) // 20 and other >= least:
        return f"nearly all others come before or after {span}: record what goes on over the whole time"
    times = max(2.0, np.ceil(least / max(count, 1)))
    if count * times < least or times > 50:
        return f"from {span} the camera saw next to nothing: record more motion or more light"
    length = grid.step * (grid.steps - 1)
    return f"record about {times:.0f} times as long as these {length:.3g} s, or more motion"
