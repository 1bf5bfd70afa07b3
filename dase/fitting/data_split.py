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
from dase.fitting.compared_time import ComparedTime, choose_compared_time
from dase.fitting.contradictions import contradiction_of_rest
from dase.fitting.frame_steps import ticks_are_of_frames
from dase.fitting.measurement import Measurement
from dase.fitting.pixels_of_parts import PARTS, PixelsOfParts, choose_pixels
from dase.fitting.subset import Array, CalibratedSubset, PixelSubset
from dase.fitting.time_window import outside_gaps
from dase.formatting import format_count, format_seconds
from dase.kernels import event_probes as kernels
from dase.kernels import launch
from dase.probes.accumulators import ProbeSums, StatisticsFrame
from dase.probes.statistics import RatePeak, peak_of, refine_frequency, ring_of_pixels
from dase.probes.stimulus import MASKED, Grid, Stimulus, band_edges, light_of, sort_into_cells
from dase.probes.timestamp_patterns import TimestampStructure, find_structure
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

    more_pixels: float = 10.0
    """Times as many pixels as were asked for that are compared where these have too few events, at most: the
    light of more takes more memory than whoever asked expects."""

    large: float = 0.25
    """Share of the pixels' time at rest, or not at rest, that the later part of the time must have for the
    fitted part to lack it."""

    small: float = 0.25
    """What the fitted part has of it at most, in units of that."""

    all_time: bool = False
    """Whether all of the time is fitted, not its first part alone. What judges are other pixels in the later
    part all the same, but no other time."""

    plenty: float = math.inf
    """Events of the pixels of one part from which on a longer time is not compared."""

    burst: float = 2e-3
    """Events are counted for so long to see how fast they come at most [s]: long enough for many of them,
    and short enough for a bus to be full all the time."""


SPLIT = SplitSettings()

ROWS = 512
"""Pixels whose steps are sorted into cells at a time, for the memory that takes."""


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
        double_gap: Mean time from an event to its double [s] where pixels are seen to send twice, else 0.
        double_spread: How far these times are apart, evenly [s]; 0 where they hardly differ.
        double_opposite: Whether the double has the other polarity.
        unlike_poles: Two that events are seen to be behind, see `Observations`; empty where they are not.
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
    double_gap: float = 0.0
    double_spread: float = 0.0
    double_opposite: bool = False
    unlike_poles: tuple[float, ...] = ()

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
            least_bus_rate=self.bus.rate,
            bus_loss=self.bus.loss,
            bus_load=self.bus.load,
            row_load=self.bus.row_load,
            column_load=self.bus.column_load,
            stamped_again=self.bus.stamped_again,
            idle_bus=idle_bus,
            frame_interval=frames.interval if frames else 0.0,
            frame_begin=frames.begin if frames else 0.0,
            frame_exposure=frames.exposure if frames else 0.0,
            clip_step=self.frame_step,
            clip_frames=self.clip_frames,
            double_gap=self.double_gap,
            double_spread=self.double_spread,
            double_opposite=self.double_opposite,
            unlike_poles=self.unlike_poles,
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


@dataclass(frozen=True, eq=False)
class LeftOut:
    """What of a measurement is compared with no model.

    Args:
        times: Tells which times [s], shape (T,), are left out; None for none.
        pixels: Row-major indices of pixels that are left out, shape (K,); None for none.
    """

    times: Callable[[Array], NDArray[np.bool_]] | None = None
    pixels: NDArray[np.int64] | None = None


@dataclass(frozen=True, eq=False)
class ModelPremises:
    """What the models that are compared are told before they run, and what they need of the time.

    Args:
        log_eps: Added to intensities before the logarithm.
        lamp: Frequency of light that flickers [Hz] where all events have told it; None to look for it here.
        frames: When the bursts come that are in step with frames; None where there are none, or left out.
        unbroken: Whether a long recording is compared in one window, not in several over its length, as
            models with a clock of their own need it, see `Sensor.unbroken`; so it is where there is a lamp
            or bursts with frames, where times are left out, and where time stamps follow a regularity.
    """

    log_eps: float = 1e-3
    lamp: float | None = None
    frames: BurstTimes | None = None
    unbroken: bool = False


def split_measurement(
    measurement: Measurement,
    *,
    left_out: LeftOut = LeftOut(),
    models: ModelPremises = ModelPremises(),
    pixels: int = SPLIT.pixels,
    seed: int = 0,
    device: str = "cpu",
    settings: SplitSettings = SPLIT,
) -> SplitMeasurement:
    """Split a measurement into what is fitted, what chooses between models, and what reports.

    Args:
        measurement: Events and scene, where that is trusted, and which time is compared: None for all, and
            everywhere but where a `CameraScene` does not trust itself. Of a long time windows are chosen, see
            `choose_windows`.
        left_out: What is not compared.
        models: What is known of the models beforehand.
        pixels: In each part; more where so many have too few events and more of them help.
        seed: Of the choice of pixels.
        device: Where kernels run.
        settings: How it is split.

    Raises:
        InputError: Different sizes, no common time, or too few events.
    """
    # offsets are added for further random numbers, and batches count in 30 bits
    checked_seed(seed, 1 << 30)
    split = partial(
        _split_of_pixels, measurement, left_out, models, seed=seed, device=device, settings=settings
    )
    # who has a recording should not have to find out how many pixels it takes
    try:
        return split(pixels)
    except _TooFewPixelsError as error:
        # fewer than were asked for were there, or so many take more memory than is expected
        if not pixels < error.wanted <= settings.more_pixels * pixels:
            raise
        out = split(error.wanted)
        looked = format_count(len(out.train.trials.stimulus.pixels))
        note = f"{looked} pixels are compared: {format_count(pixels)} had too few events"
        return replace(out, notes=(*out.notes, note))


class _TooFewPixelsError(InputError):
    """Pixels that are compared have too few events, and more pixels help.

    Args:
        message: What is wrong.
        wanted: Pixels that help.
    """

    def __init__(self, message: str, wanted: int):
        super().__init__(message)
        self.wanted = wanted


def _split_of_pixels(
    measurement: Measurement,
    left_out: LeftOut,
    models: ModelPremises,
    pixels: int,
    *,
    seed: int,
    device: str,
    settings: SplitSettings,
) -> SplitMeasurement:
    """Return the parts of a measurement with so many pixels in each, see `split_measurement`."""
    plan = _plan_split(measurement, left_out, models, pixels=pixels, seed=seed, settings=settings)
    time, to = plan.time, _found_device(device)
    light = _light_of_pixels(plan)
    good = _compared_steps(plan)
    bands = _bands_of_all_parts(plan, light, good)
    cells, found = _cells_and_structure(plan, light, bands, models.log_eps)
    _mask_cells(cells, good, plan.cut)
    stimuli = _stimuli_of_parts(plan, light, cells, models.log_eps, to, all_time=settings.all_time)
    del cells, good  # large, and no longer needed
    structure, ticks = _structure_of_a_clock(found, time)
    # in the order of the steps, which an error for too few events repeats
    notes = [*time.notes(), *plan.pixels.notes, *time.notes_on_gaps(), *ticks]
    highest = highest_event_rate(time.events, settings.burst)
    # those that judge and report are compared from the cut on
    parts = [
        make_subset(stimulus, time.events, first, structure, highest_rate=highest)
        for stimulus, first in zip(stimuli, (0, plan.cut, plan.cut), strict=True)
    ]
    _require_enough_events(parts, time.events, time.grid, notes, settings.least_events)
    # the scout sees what is fitted, never what judges
    few = stimuli[0].part(settings.scouts)
    parts.append(make_subset(few, time.events, 0, structure, highest_rate=highest))
    peak = _peak_of(plan, parts[0], models.lamp)
    train, held, report, scout = (_with_surroundings(plan, one, peak, seed, device) for one in parts)
    # all pixels share it: those that are compared would leave it idle
    bus = BusUse.of(time.events, structure, span=settings.burst)
    contradiction = contradiction_of_rest(time.events, light[:, :1] if time.still else light)
    out = SplitMeasurement(
        train, held, report, scout, bands, structure, peak, highest, bus, time.when, (), contradiction,
        models.frames, time.frame_step, time.clip_frames,
    )  # fmt: skip
    return replace(out, notes=(*_notes_before(out), *notes, *_notes_after(out)))


@dataclass(frozen=True, eq=False)
class SplitPlan:
    """Which time and which pixels of a measurement are in which part.

    Args:
        time: That is compared.
        pixels: Of all parts.
        cut: The step at which the time begins that judges.
        left_out: What is not compared.
    """

    time: ComparedTime
    pixels: PixelsOfParts
    cut: int
    left_out: LeftOut

    @property
    def trusts_all(self) -> bool:
        """Whether the scene is trusted everywhere."""
        return self.pixels.trust is None

    @property
    def has_holes(self) -> bool:
        """Whether parts of the time of some pixels are not compared, and others after them are."""
        return self.time.has_holes or not self.trusts_all or self.left_out.times is not None


def _plan_split(
    measurement: Measurement,
    left_out: LeftOut,
    models: ModelPremises,
    *,
    pixels: int,
    seed: int,
    settings: SplitSettings,
) -> SplitPlan:
    """Choose time and pixels; arguments and errors are those of `split_measurement`."""
    time = choose_compared_time(
        measurement, unbroken=_is_unbroken(models, left_out), pixels=pixels, plenty=settings.plenty
    )
    # time is cut, not drawn: moments between fitted ones would be known from these
    cut = max(2, round(settings.fitted_share * time.grid.steps))
    chosen = choose_pixels(
        time, cut, odd_pixels=left_out.pixels, most=pixels, least=settings.least_pixels, seed=seed
    )
    return SplitPlan(time, chosen, cut, left_out)


def _is_unbroken(models: ModelPremises, left_out: LeftOut) -> bool:
    """Return whether time must go on without a break."""
    # the phase of what goes by a clock of its own would not go on from window to window
    told = models.lamp is not None or models.frames is not None or left_out.times is not None
    return models.unbroken or told


def _found_device(name: str) -> Any:
    """Return a Warp device; raises InputError where there is none of that name."""
    try:
        return launch.find_device(name)
    except ValueError as error:
        raise InputError(str(error)) from error


def _light_of_pixels(plan: SplitPlan) -> NDArray[np.float32]:
    """Return the light of all parts, shape (PARTS N, T), where it never changes as a view of one column."""
    # from the begin of the scene also for the parts that judge: filters and memories are settled there
    time, times, numbers = plan.time, plan.time.times, plan.pixels.numbers
    light = light_of(time.scene, times[:1] if time.still else times, numbers)
    if not np.all(np.isfinite(light)) or light.min() < 0:
        raise InputError("scene: intensities must be finite and >= 0")
    return np.broadcast_to(light, (len(numbers), len(times))) if time.still else light


def _compared_steps(plan: SplitPlan) -> NDArray[np.bool_]:
    """Return which steps of pixels are compared, shape (N, T), or (1, T) where those of all are alike."""
    time, times, trust = plan.time, plan.time.times, plan.pixels.trust
    # a row for all pixels where all are trusted alike
    good: NDArray[np.bool_] = (
        np.ones((1, len(times)), np.bool_) if trust is None else trust(times, plan.pixels.numbers).T.copy()
    )
    if len(time.gaps):
        good &= outside_gaps(time.gaps)(times)
    if plan.left_out.times is not None:
        good &= ~plan.left_out.times(times)
    if time.spliced is not None:
        good &= time.spliced.settled(times)
    good[:, 1:] &= good[:, :-1]  # a step is what lies between two points of the grid
    return good


def _bands_of_all_parts(plan: SplitPlan, light: NDArray[np.float32], good: NDArray[np.bool_]) -> Array:
    """Return the edges of the bands, shape (BANDS - 1,), from light and compared steps of pixels (N, T)."""
    # all parts have the same bands, or a cell would mean another brightness in each; what reports has no say
    count = 2 * plan.pixels.each
    several = light[:count]
    return band_edges(several, np.broadcast_to(good[:count], several.shape))


def _cells_and_structure(
    plan: SplitPlan, light: NDArray[np.float32], bands: Array, log_eps: float
) -> tuple[list[NDArray[np.uint8]], TimestampStructure]:
    """Return the cells of the steps of each part, shape (N, T), and the regularities of time stamps."""
    time, each, steps = plan.time, plan.pixels.each, light.shape[1]
    sorting = partial(sort_into_cells, step=time.grid.step, bands=bands, log_eps=log_eps)
    # filters over time go pixel by pixel, so parts of the pixels give the same as all of them
    cells = [np.empty((each, steps), np.uint8) for _ in range(PARTS)]
    works: list[Callable[[], Any]] = [
        partial(_sort_into, of_part[n : n + ROWS], light[part * each + n :], sorting)
        for part, of_part in enumerate(cells)
        for n in range(0, each, ROWS)
    ]
    # beside them, for all events are gone through and no pixel is waited for
    works.append(partial(find_structure, time.events))
    *_, structure = launch.run_concurrently(works)
    return cells, structure


def _sort_into(
    cells: NDArray[np.uint8],
    light: NDArray[np.float32],
    sorting: Callable[[NDArray[np.float32]], NDArray[np.uint8]],
) -> None:
    """Sort the steps of pixels into cells, shape (N, T), by their light, at least as many rows."""
    cells[:] = sorting(light[: len(cells)])


def _structure_of_a_clock(
    found: TimestampStructure, time: ComparedTime
) -> tuple[TimestampStructure, tuple[str, ...]]:
    """Return the regularities of time stamps that a camera's clock makes, and what is said of others."""
    # of frames that are held all events come so long after one
    structure = TimestampStructure() if time.held else found
    # a clock would show the tick before each event of a model, often in the frame before
    if not ticks_are_of_frames(structure.step, time.frame_step, time.events, time.scene):
        return structure, ()
    return TimestampStructure(), (
        f"time stamps are multiples of {format_seconds(structure.step)} in step with the frames of the "
        "clip: times between frames are made by a simulator that knows these frames alone, and are not "
        "compared",
    )


def _mask_cells(cells: list[NDArray[np.uint8]], good: NDArray[np.bool_], cut: int) -> None:
    """Mask the steps of each part, shape (N, T), that are not compared.

    Args:
        cells: Of each part, shape (N, T).
        good: Which steps are compared, shape (PARTS N, T), or (1, T) for all pixels.
        cut: Step at which the time begins that judges.
    """
    for n, of_part in enumerate(cells):
        if len(good) == 1:
            of_part[:, ~good[0]] = MASKED
        else:
            of_part[~good[n * len(of_part) : (n + 1) * len(of_part)]] = MASKED
        of_part[:, 0] = MASKED  # no step ends at the first point
        # what judges is simulated over all of the time and compared in the later part only
        if n > 0:
            of_part[:, :cut] = MASKED


def _stimuli_of_parts(
    plan: SplitPlan,
    light: NDArray[np.float32],
    cells: list[NDArray[np.uint8]],
    log_eps: float,
    device: Any,
    *,
    all_time: bool,
) -> list[Stimulus]:
    """Return what the pixels of each part see, over the time for which they are simulated.

    Args:
        plan: Which time and pixels.
        light: Of all parts, shape (PARTS N, T).
        cells: Of each part, shape (N, T).
        log_eps: Added to intensities before the logarithm.
        device: Where kernels run.
        all_time: Whether all of the time is fitted.
    """
    grid, scene = plan.time.grid, plan.time.scene
    fitted = grid if all_time else replace(grid, steps=plan.cut)
    # a copy of the cells that are fitted, as a view would keep the others in memory
    stretches = [(fitted, cells[0][:, : fitted.steps].copy()), *((grid, of_part) for of_part in cells[1:])]
    return [
        Stimulus(
            plan.pixels.numbers[part], scene.width, scene.height, stretch, light[part, : stretch.steps],
            of_part, log_eps, device, plan.has_holes,
        )
        for part, (stretch, of_part) in zip(plan.pixels.parts(), stretches, strict=True)
    ]  # fmt: skip


def _peak_of(plan: SplitPlan, train: PixelSubset, lamp: float | None) -> RatePeak:
    """Return the frequency at which the rate swings most.

    Args:
        plan: Which time and pixels.
        train: What is fitted.
        lamp: The frequency [Hz] where all events have told it.
    """
    if lamp is not None:
        return RatePeak(lamp, 0.0)
    grid = plan.time.grid
    # seen in the fitted part: what judges must not choose
    peak = peak_of(train.found.clock[0], grid.step)
    # most events are where the scene is not known, or no frequency is to be seen
    if not plan.trusts_all or not peak.frequency:
        return peak
    end = grid.begin + plan.cut * grid.step
    return peak._replace(frequency=refine_frequency(plan.time.events, grid.begin, end, peak.frequency))


def _with_surroundings(
    plan: SplitPlan, part: PixelSubset, peak: RatePeak, seed: int, device: str
) -> PixelSubset:
    """Return the same pixels, told where the rate of events swings and what all pixels see."""
    time = plan.time
    # where the scene is trusted here and there only, nobody knows what all pixels send; no two parts share
    # one, for it keeps what is beside the pixels of one of them
    around = WholeSensor(time.scene, time.times, seed, device) if plan.trusts_all else None
    return replace(part, frame=replace(part.frame, peak=peak.frequency), around=around)


def _notes_before(split: SplitMeasurement) -> list[str]:
    """Return what is to be read before all other notes."""
    return [split.contradiction] if split.contradiction else []


def _notes_after(split: SplitMeasurement) -> list[str]:
    """Return what is to be read after all other notes."""
    if not split.light_never_changes:
        return []
    return [
        "the light never changes: nothing tells how much change an event takes, and thresholds are not fitted"
    ]


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
    few = [n for n, count in enumerate(counts) if count < least]
    if not few:
        return
    first, name = few[0], ("fitting", "judging", "reporting")[few[0]]
    # parts are of other times, so each may need another number
    each = [_pixels_that_help(halves[n], counts[n], events, grid, least) for n in few]
    wanted = max(each) if all(each) else 0
    if wanted:
        looked = len(halves[first].trials.stimulus.pixels)
        helps = f"looking at more pixels helps, {wanted} instead of {looked} (pixels)"
    else:
        helps = _what_helps(halves[first], counts[first], max(counts), events, grid, least)
    said = (
        f"too few events to say anything: {counts[first]} of the {len(events)} lie in the part for {name}, "
        f"at least {least} are needed; {helps}" + "".join(f"; {note}" for note in notes)
    )
    raise _TooFewPixelsError(said, wanted) if wanted else InputError(said)


def _pixels_that_help(half: PixelSubset, count: int, events: Events, grid: Grid, least: int) -> int:
    """Return how many pixels would have enough events; 0 where more of them do not help."""
    size, looked = half.trials.stimulus.width * half.trials.stimulus.height, len(half.trials.stimulus.pixels)
    # as many more would lie where nothing is compared
    if _lacks_the_scene(half, events, grid, least):
        return 0
    # twice as many as are missing on the average: pixels differ
    wanted = int(np.ceil(2 * least / max(count, 1) * looked / 100) * 100)
    return (
        wanted if count and wanted <= size // PARTS and _events_inside(half, events, grid) >= 2 * least else 0
    )


def _lacks_the_scene(half: PixelSubset, events: Events, grid: Grid, least: int) -> bool:
    """Return whether most events lie where the scene is not known."""
    stimulus = half.trials.stimulus
    looked, size = len(stimulus.pixels), stimulus.width * stimulus.height
    # by their share of the array these pixels would have enough
    return bool(stimulus.holes) and _events_inside(half, events, grid) * looked >= 2 * least * size


def _events_inside(half: PixelSubset, events: Events, grid: Grid) -> int:
    """Return how many events of all pixels come in the time of a part."""
    begin, end = (grid.begin + grid.step * n for n in (half.frame.first, half.trials.stimulus.grid.steps))
    return int(np.count_nonzero((events.t >= begin) & (events.t < end)))


def _what_helps(half: PixelSubset, count: int, other: int, events: Events, grid: Grid, least: int) -> str:
    """Return what would give a part of a measurement enough events, beside more pixels."""
    stimulus, first = half.trials.stimulus, half.frame.first
    begin, end = (grid.begin + grid.step * n for n in (first, stimulus.grid.steps))
    inside = _events_inside(half, events, grid)
    if _lacks_the_scene(half, events, grid, least):
        return "most lie where the scene is not known: frames more often or less motion help"
    span = f"{begin:.3g} s to {end:.3g} s"
    if inside < len(events) // 20 and other >= least:
        return f"nearly all others come before or after {span}: record what goes on over the whole time"
    times = max(2.0, np.ceil(least / max(count, 1)))
    if count * times < least or times > 50:
        return f"from {span} the camera saw next to nothing: record more motion or more light"
    length = grid.step * (grid.steps - 1)
    return f"record about {times:.0f} times as long as these {length:.3g} s, or more motion"
