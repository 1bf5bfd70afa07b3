"""Some pixels of a measurement over some time, on which models are run and compared."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from dase.fitting.batch_simulator import BatchSimulator
from dase.fitting.bus_load import BusLoad, WholeSensor
from dase.fitting.parameter_space import ParameterSpace
from dase.fitting.scheduler import SimulationRequest, Work, answer_requests
from dase.fitting.trial_sampling import samples_per_step
from dase.probes.accumulators import ProbeSums, StatisticsFrame, leave_groups_out
from dase.probes.distance import ErrorScale, Judgement, judge_model
from dase.probes.statistics import (
    LAYOUT,
    compute_statistics,
    events_of_spread,
    is_compared,
    lacks_events,
    sampling_variance,
    shortfall_of,
    tolerance_of,
)

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PixelSubset:
    """Some pixels over some time: models are run, and compared with what was measured there.

    Args:
        trials: Runs models.
        found: What was measured.
        frame: What statistics refer to.
        around: What all pixels see; None where that is not known.
        load: What the pixels that are not looked at send in some model; None where no model was named.
        doubt: What each statistic may be off by because the scene is only guessed, shape (J,); None for 0.
        drift: The same as one way that all of them go together, with signs, shape (J,); None for 0.
    """

    trials: BatchSimulator
    found: ProbeSums
    frame: StatisticsFrame
    around: WholeSensor | None = None
    load: BusLoad | None = None
    doubt: Array | None = None
    drift: Array | None = None

    def loaded(self, space: ParameterSpace, place: Array) -> Self:
        """Return the same pixels, where those that are not looked at send what they do in some model.

        Args:
            space: The model's free parameters.
            place: Where they are, shape (P,).
        """
        if self.around is None:
            return self
        return replace(self, load=self.around.load(space.at(place), self.trials.stimulus))

    def run(self, space: ParameterSpace, places: Array, *, seed: int) -> Array:
        """Return the statistics of the models at some places (B, P), shape (B, J)."""
        found: Array = answer_requests([SimulationRequest(self, space, np.atleast_2d(places), seed)])[0]
        return found

    def run_repeats(self, space: ParameterSpace, places: Array, *, seed: int) -> Array:
        """Do what `run` does, shape (B, J), where each model has random numbers of its own."""
        request = SimulationRequest(self, space, np.atleast_2d(places), seed, repeats=True)
        found: Array = compute_statistics(answer_requests([request])[0], self.frame)[0]
        return found

    def streams(self, space: ParameterSpace) -> bool:
        """Whether the events of models go through a readout."""
        return self.trials.ticks(space.sensor) is None

    def slow(self, space: ParameterSpace) -> bool:
        """Whether models take several samples per step, or their events go through a readout."""
        return self.streams(space) or samples_per_step(space.sensor, self.frame.step) > 1

    def calibration_work(
        self, space: ParameterSpace, place: Array, *, repeats: int, seed: int, few_repeats: int = 24
    ) -> Work[CalibratedSubset]:
        """Calibrate by a model: expectations and sampling errors are its own.

        Args:
            space: The model's free parameters.
            place: Where they are, shape (P,).
            repeats: Simulations of it with seeds of their own.
            seed: Of the first of them.
            few_repeats: Simulations at most of a model that needs many samples, or whose events go through a
                readout: both take longer.
        """
        repeats = min(repeats, few_repeats) if self.slow(space) else repeats
        # the load is the model's own: beside another model's its bus would be too full or too free
        loaded = self.loaded(space, place)
        places = np.repeat(np.atleast_2d(place), repeats, 0)
        (sums,) = yield [SimulationRequest(loaded, space, places, seed, repeats=True)]
        return _calibrate_by_repeats(loaded, sums)


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibratedSubset(PixelSubset):
    """Pixels with a present model, by whose expectations and sampling errors others are measured.

    Args:
        scale: What differences are measured by in a fit: sampling errors as they are seen between groups of
            pixels, also where the model is wrong.
        chance: What differences are measured by in a test: sampling errors of the present model.
        seen: As `scale`, for the mean of many repeats of the present model.
        tolerance: What each statistic may be off by, shape (J,).
        repeats: Statistics of simulations of the present model with other seeds, shape (R, J).
        left_out: Statistics of the measurement less a repeat of the present model, without one group of
            pixels after the other, shape (G, J).
    """

    scale: ErrorScale
    chance: ErrorScale
    seen: ErrorScale
    tolerance: Array
    repeats: Array
    left_out: Array

    @property
    def groups(self) -> int:
        """Number of groups of pixels."""
        return len(self.left_out)

    def judge(self, seed: int) -> Judgement:
        """Return the error of the present model; `seed` draws the random part of the tolerance."""
        return judge_model(self.repeats, self.seen, self.chance, self.tolerance, seed=seed)


def _calibrate_by_repeats(subset: PixelSubset, sums: ProbeSums) -> CalibratedSubset:
    """Return a subset whose present model is the one with these repeats, R of them."""
    # also where the subset is calibrated already: nothing of the model before is left
    expected = sums.halves.mean(0, dtype=np.float64)
    bare = replace(subset.frame, expected=expected, measured=None)
    target, events = compute_statistics(subset.found, bare)
    # means of models with few events are drawn to those of the measurement, so these come first
    frame = replace(bare, measured=target[0])
    values, sent = compute_statistics(sums, frame)
    # variances add up: that of chance, and the square of what is of no concern
    square = np.maximum(tolerance_of(target[0], events[0]), 1e-9) ** 2
    if subset.doubt is not None:
        square = square + subset.doubt**2
    # two single simulations differ by twice the variance of one
    between = 2.0 * values.var(0, ddof=1)
    counted, here = events[0].copy(), sent.mean(0)
    # the weight of these is what the model sends
    counted[LAYOUT["spread"]] = events_of_spread(subset.found.halves.sum(1, dtype=np.float64))[0]
    least = shortfall_of(counted, here)
    used = is_compared(target[0], events[0]) | (least > 0)
    # sums over groups exist of the first repeat only, so one simulation stands against the measurement
    measured, present = (
        compute_statistics(leave_groups_out(one, frame), frame)[0] for one in (subset.found, sums)
    )
    left_out = measured - present
    # the jackknife: it sees what the measurement's own pixels make of a statistic
    scatter = (len(left_out) - 1) * left_out.var(0)
    # a measurement against the mean of R repeats has the variance of one and the R-th part of one
    share = 0.5 + 0.5 / len(values)
    # the mean of the repeats has nearly no sampling error of its own, which the jackknife of one repeat has
    seen = np.maximum(share * between, scatter - (0.5 - 0.5 / len(values)) * between)
    # by the scatter of a model that sends too few, it would be close to everything
    own = sampling_variance(measured, counted)
    seen = np.where(lacks_events(counted, here), np.minimum(seen, own), seen)
    return CalibratedSubset(
        subset.trials,
        subset.found,
        frame,
        subset.around,
        subset.load,
        subset.doubt,
        subset.drift,
        scale=ErrorScale(target[0], np.sqrt(np.maximum(between, scatter) + square), used),
        chance=ErrorScale(target[0], np.sqrt(share * between + square), used),
        seen=ErrorScale(target[0], np.sqrt(seen + square), used, least),
        tolerance=np.sqrt(square),
        repeats=values,
        left_out=left_out,
    )
