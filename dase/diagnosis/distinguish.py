"""Which recording would tell two models of a camera apart: standard stimuli, simulated with both."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dase.diagnosis.standard_stimuli import STANDARD_STIMULI, StandardStimulus
from dase.errors import InputError, checked_seed
from dase.fitting.batch_simulator import BatchSimulator, SimulationOrder
from dase.fitting.data_split import SPLIT, typical_changes
from dase.fitting.trial_sampling import samples_per_step
from dase.kernels import launch
from dase.probes.accumulators import ProbeSums, StatisticsFrame
from dase.probes.random_streams import Draw, SimulationStream
from dase.probes.statistics import (
    FAMILY_WORDS,
    LAYOUT,
    compute_statistics,
    is_compared,
    peak_of,
    ring_of_pixels,
    tolerance_of,
)
from dase.probes.stimulus import MASKED, Grid, Stimulus, band_edges, sort_into_cells
from dase.probes.timestamp_patterns import PATTERNS, TimestampStructure
from dase.results import Answer, Distinction
from dase.simulation.sensor import Sensor

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DistinctionSettings:
    """Which recordings are tried, and when two models count as told apart."""

    durations: tuple[float, ...] = (0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 60.0)
    """Durations that are tried [s]."""

    alarm_deviations: float = 1.6448536269514722
    """Standard deviations above which 5 % of a normal distribution lie: so many recordings of A may be taken
    for B's."""

    power: float = 0.95
    """Two models are told apart when so many recordings of B are known."""

    clear: float = 3.0
    """Only statistics that differ by more standard errors have a say; the others would add noise."""

    samples_at_once: float = 6e6
    """Samples of light held at once, pixels times steps."""

    steps_at_once: float = 2e7
    """Steps of all parts of recordings that are simulated at once: their clocks take memory."""


DEFAULTS = DistinctionSettings()
"""What `distinguish` decides by unless it is told otherwise."""


def distinguish(
    a: Sensor,
    b: Sensor,
    *,
    names: tuple[str, str] | None = None,
    longest: float = 60.0,
    pixels: int = SPLIT.pixels,
    repeats: int = 24,
    seed: int = 0,
    device: str = "cpu",
    progress: Callable[[str, float, float, bool], None] = lambda stimulus, seconds, power, last: None,
    settings: DistinctionSettings = DEFAULTS,
) -> Distinction:
    """Find the shortest standard recording that tells two models apart.

    Recordings of growing duration are simulated with both models. Half of them teach a linear rule which
    model a recording is of, by the statistics that a diagnosis uses; it is judged by the other half.

    Args:
        a: One model.
        b: The other one.
        names: What to call the models; their own names if None.
        longest: Longest duration to try [s].
        pixels: Of a recording that are looked at.
        repeats: Recordings of each model and duration that are simulated.
        seed: Of everything random.
        device: Where kernels run.
        progress: Called after each step with stimulus, duration [s], power, and whether the stimulus is done.
        settings: Numbers by which models are told apart.

    Raises:
        InputError: The models are of cameras that differ in size, or a number is out of range.
    """
    shortest = settings.durations[0]
    size = _check_arguments(a, b, (shortest, longest), pixels, repeats)
    durations = [t for t in settings.durations if t < longest] + [longest]
    checked_seed(seed, 1 << 30)
    answers = []
    for number, standard in enumerate(STANDARD_STIMULI):
        tried: list[tuple[float, float]] = []
        for seconds in durations:
            bench = _StimulusTest(
                standard,
                seconds,
                size,
                pixels,
                (a, b),
                SimulationStream.STIMULUS.seed(seed, number),
                device,
                settings,
            )
            answer = bench.judge(repeats)
            tried.append((seconds, answer.power))
            last = answer.seconds is not None or seconds == longest
            progress(standard.name, seconds, answer.power, last)
            if last:
                break
        answers.append(replace(answer, tried=tuple(tried)))
    known = [answer for answer in answers if answer.seconds is not None]
    best = min(known, key=lambda answer: answer.seconds or 0.0, default=None)
    sentence = _advice_sentence(best, longest, pixels, *(names or (a.name, b.name)))
    return Distinction(tuple(answers), best, sentence, pixels, longest)


def _check_arguments(
    a: Sensor, b: Sensor, durations: tuple[float, float], pixels: int, repeats: int
) -> tuple[int, int]:
    """Return columns and rows of the cameras; raises InputError where a number is out of range."""
    shortest, longest = durations
    if not (shortest <= longest <= 600):
        raise InputError(f"longest must lie in [{shortest:g}, 600] s, got {longest:g}")
    if pixels < 16:
        raise InputError(f"pixels must be >= 16, got {pixels}")
    if repeats < 8:
        raise InputError(f"repeats must be >= 8, got {repeats}")
    if a.size and b.size and a.size != b.size:
        sizes = " and ".join(f"{s.size[0]}x{s.size[1]}" for s in (a, b) if s.size)
        raise InputError(f"the models must be of one camera, their sizes are {sizes}")
    if a.log_eps != b.log_eps:
        raise InputError(f"log_eps must be the same in both models, got {a.log_eps:g} and {b.log_eps:g}")
    return a.size or b.size or (346, 260)


def _timestamp_structure(models: tuple[Sensor, Sensor]) -> TimestampStructure:
    """Return the regularity of time stamps that a readout of the models makes, if a file could show it."""
    for model in models:
        for effect in model.readout_effects():
            pattern = effect.stamp_pattern()
            # shorter ticks cannot be told from those of the file
            if pattern is not None and (not pattern.period or pattern.period >= PATTERNS.shortest):
                return TimestampStructure(pattern.period, pattern.line_time, pattern.direction)
    return TimestampStructure()


class _StimulusTest:
    """Both models on one stimulus of one duration."""

    def __init__(
        self,
        standard: StandardStimulus,
        seconds: float,
        size: tuple[int, int],
        pixels: int,
        models: tuple[Sensor, Sensor],
        seed: int,
        device: str,
        settings: DistinctionSettings,
    ):
        self.settings = settings
        self.standard, self.models, self.seed = standard, models, seed
        step, (width, height) = standard.step, size
        steps = round(seconds / step) + 1
        finer = max(samples_per_step(model, step) for model in models)
        # a recording is put together of parts, for light takes memory
        self.parts = max(1, math.ceil(pixels * steps / settings.samples_at_once))
        count = math.ceil(pixels / self.parts)
        rng = Draw.PIXELS.generator(seed)
        chosen = np.sort(rng.choice(width * height, count, replace=count > width * height)).astype(np.int32)
        grid = Grid(0.0, step, steps)
        try:
            to = launch.find_device(device)
        except ValueError as error:
            raise InputError(str(error)) from error
        light = standard.light(rng, count, grid.times)
        log_eps = models[0].log_eps
        some = light[:, :: max(1, steps // 1000)]
        bands = band_edges(some, np.ones(some.shape, np.bool_))
        cell = sort_into_cells(light, step, bands, log_eps)
        cell[:, 0] = MASKED
        self.finer = finer
        # a readout that both have tells nothing
        self.readout = set(models[0].readout_effects()) != set(models[1].readout_effects())
        structure = _timestamp_structure(models) if self.readout else TimestampStructure()
        stimulus = Stimulus(chosen, width, height, grid, light, cell, log_eps, to)
        self.trials = BatchSimulator(stimulus, structure=structure)
        self.regular = structure != TimestampStructure()
        self.seconds = step * (steps - 1)
        self.zone = np.tile(ring_of_pixels(chosen, width, height), self.parts)

    def judge(self, repeats: int) -> Answer:
        """Say how well recordings of the two models are told apart."""
        first = self.trials.run(self.models[0], self.models[0].parameters()[None], finer=self.finer)
        self.trials = self.trials.with_middle(typical_changes(first))
        found = [self._recordings(number, repeats) for number in range(2)]
        expected = sum(sums.halves.mean(0, dtype=np.float64) for sums in found) / 2
        step = self.standard.step
        peak = peak_of(sum(sums.clock.sum(0) for sums in found), step).frequency
        frame = StatisticsFrame(np.asarray(expected), self.zone, self.seconds, 0, step, peak, self.regular)
        (a, events), (b, more) = (compute_statistics(sums, frame) for sums in found)
        used = is_compared(a.mean(0), events.mean(0)) | is_compared(b.mean(0), more.mean(0))
        off = tolerance_of(a.mean(0), np.maximum(events.mean(0), more.mean(0)))
        power, share = separating_power(a * used, b * used, off, self.settings)
        told = power >= self.settings.power
        says = {name: float(share[part].sum()) for name, part in LAYOUT.items()}
        # the plainest of those that say about as much
        family = next(name for name, say in says.items() if say >= 0.5 * max(says.values()))
        clear = says[family] > 0 and power > 0.5
        rates = [sums.halves.reshape(-1, 2).mean(0, dtype=np.float64) * 4 / self.seconds for sums in found]
        return Answer(
            self.standard.name,
            self.standard.how,
            self.seconds if told else None,
            power,
            FAMILY_WORDS[family] if clear else "",
            (float(rates[0][0]), float(rates[0][1]), float(rates[1][0]), float(rates[1][1])),
        )

    def _recordings(self, number: int, repeats: int) -> ProbeSums:
        """Return what recordings of a model sum up to, one per row."""
        seed = SimulationStream.RECORDING.seed(self.seed, number)
        # rows that are simulated at once: their clocks take memory
        at_once = max(1, int(self.settings.steps_at_once / (self.trials.stimulus.grid.steps * self.parts)))
        done = []
        for first in range(0, repeats, at_once):
            rows = min(at_once, repeats - first) * self.parts
            done.append(self._joined(self._simulated(self.models[number], rows, seed + first * self.parts)))
        return ProbeSums.join(done)

    def _simulated(self, model: Sensor, rows: int, seed: int) -> ProbeSums:
        vector = model.parameters()
        if not self.readout:
            vectors = np.repeat(vector[None], rows, 0)
            return self.trials.run(model, vectors, seed=seed, reseed=True, finer=self.finer)
        order = SimulationOrder(model, np.repeat(vector[None], rows, 0), seed, reseed=True)
        return self.trials.simulate_streams(order, [model.readout_effects()] * rows)

    def _joined(self, sums: ProbeSums) -> ProbeSums:
        """Return recordings put together of their parts, whose pixels do not know of each other."""

        def by(a: NDArray[Any]) -> NDArray[Any]:
            return a.reshape(-1, self.parts, *a.shape[1:])

        return ProbeSums(
            by(sums.sums).sum(1),
            sums.pixels.reshape((len(sums.sums) // self.parts, -1, sums.pixels.shape[2])),
            by(sums.clock).sum(1),
            by(sums.stamps).mean(1),
        )


def separating_power(
    a: Array, b: Array, tolerance: Array, settings: DistinctionSettings = DEFAULTS
) -> tuple[float, Array]:
    """Return how well a linear rule tells two kinds of recordings apart that it has not seen.

    Args:
        a: Statistics of recordings of one kind, shape (R, J).
        b: Of the other kind, shape (R, J).
        tolerance: What each statistic may be off by without it meaning anything, shape (J,).
        settings: Of which the share of alarms is taken, and what differs clearly.

    Returns:
        Share of recordings of B that are known when 5 % of A's are taken for B's, and the say of each
        statistic, shape (J,).
    """
    powers, say = [], np.zeros(a.shape[1])
    for taught, judged in ((slice(0, None, 2), slice(1, None, 2)), (slice(1, None, 2), slice(0, None, 2))):
        x, y = a[taught], b[taught]
        difference = y.mean(0) - x.mean(0)
        variance = 0.5 * (x.var(0, ddof=1) + y.var(0, ddof=1)) + tolerance**2
        clear = np.abs(difference) > settings.clear * np.sqrt(2 * variance / len(x))
        weight = np.divide(difference, variance, out=np.zeros_like(variance), where=clear)
        say += weight * difference
        powers.append(
            _power_of_scores(
                a[judged] @ weight,
                b[judged] @ weight,
                float(np.sum((weight * tolerance) ** 2)),
                settings.alarm_deviations,
            )
        )
    return float(np.mean(powers)), say


def _power_of_scores(a: Array, b: Array, blur: float, deviations: float) -> float:
    """Return the share of scores of B above what 5 % of A's are above, both taken as normal."""
    wide, high = (math.sqrt(s.var(ddof=1) + blur) for s in (a, b))
    if wide == 0 or high == 0:
        return 0.05  # by chance
    above = (b.mean() - a.mean() - deviations * wide) / high
    return 0.5 * math.erfc(-above / math.sqrt(2))


def _advice_sentence(best: Answer | None, longest: float, pixels: int, a: str, b: str) -> str:
    if best is None:
        return (
            f"{a} and {b} are indistinguishable in any of these recordings up to {longest:g} s "
            f"({pixels} pixels): none of them is worth making."
        )
    command = next(s.command for s in STANDARD_STIMULI if s.name == best.stimulus)
    return (
        f"Record {best.stimulus} for {best.seconds:g} s, {best.how}: {a} and {b} differ in {best.differs}. "
        f"What to show, or how: {command}"
    )


def table_rows(found: Distinction, a: str, b: str) -> Iterator[tuple[str, ...]]:
    """Yield the rows of a table of the answers, its head first."""
    yield "recording", "tells apart in", "power", f"events of {a} [1/(px s)]", f"of {b}", "they differ in"
    for answer in found.answers:
        seconds = "-" if answer.seconds is None else f"{answer.seconds:g} s"
        off_a, on_a, off_b, on_b = answer.rates
        rates = (f"{on:.3g} ON, {off:.3g} OFF" for on, off in ((on_a, off_a), (on_b, off_b)))
        yield answer.stimulus, seconds, f"{100 * answer.power:.0f} %", *rates, answer.differs or "-"
