"""Some pixels of a measurement over some time, on which models are run and compared."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from dase.fitting.batch_simulator import BatchSimulator, samples_per_step
from dase.fitting.bus_load import BusLoad, WholeSensor
from dase.fitting.parameter_space import ParameterSpace
from dase.fitting.scheduler import SimulationRequest, Work, answer_requests, run_work
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

FEW_REPEATS = 24
"""Repeats of a model that needs many samples, or whose events go through a readout: both take longer."""


Array = NDArray[np.float64]


@dataclass(eq=False)
class PixelSubset:
    """Some pixels over some time: models are run, and compared with what was measured there.

    Args:
        trials: Runs models.
        found: What was measured.
        frame: What statistics refer to.
        around: What all pixels see; None where that is not known.
        load: What the pixels that are not looked at send in the present model.
        scale: What differences are measured by in a fit: sampling errors as they are seen between groups of
            pixels, also where the model is wrong.
        chance: What differences are measured by in a test: sampling errors of the present model.
        seen: As `scale`, for the mean of many repeats of the present model.
        off: What each statistic may be off by.
        simulated: Statistics of the present model, the mean over its repeats.
        left: Statistics of the measurement less a repeat of the present model, without one group of pixels
            after the other, shape (G, J).
    """

    trials: BatchSimulator
    found: ProbeSums
    frame: StatisticsFrame
    around: WholeSensor | None = None
    load: BusLoad | None = None
    scale: ErrorScale = field(init=False)
    chance: ErrorScale = field(init=False)
    seen: ErrorScale = field(init=False)
    off: Array = field(init=False)
    answer_requests: Array = field(init=False)
    left: Array = field(init=False)

    def view(self) -> PixelSubset:
        """Return the same half, which may have another present model."""
        return copy(self)

    def loaded(self, space: ParameterSpace, place: Array) -> PixelSubset:
        """Return the same half, where the pixels that are not looked at send what they do in some model."""
        out = self.view()
        if self.around is not None:
            out.load = self.around.load(space.at(place), self.trials.stimulus)
        return out

    def run(self, space: ParameterSpace, places: Array, *, seed: int) -> Array:
        """Return the statistics of the models at some places, shape (B, J)."""
        found: Array = answer_requests([SimulationRequest(self, space, np.atleast_2d(places), seed)])[0]
        return found

    def streams(self, space: ParameterSpace) -> bool:
        """Whether the events of models go through a readout."""
        return self.trials.ticks(space.sensor) is None

    def slow(self, space: ParameterSpace) -> bool:
        """Whether models take many samples, or their events go through a readout."""
        return self.streams(space) or samples_per_step(space.sensor, self.frame.step) > 0

    def rebase(self, space: ParameterSpace, place: Array, *, repeats: int, seed: int) -> Array:
        """Make a model the present one: expectations and sampling errors are its own.

        Returns:
            Statistics of `repeats` simulations of it with other seeds, shape (repeats, J).
        """
        return run_work(self.rebasing(space, place, repeats=repeats, seed=seed))

    def rebasing(self, space: ParameterSpace, place: Array, *, repeats: int, seed: int) -> Work[Array]:
        """Do what `rebase` does, see `together`."""
        repeats = min(repeats, FEW_REPEATS) if self.slow(space) else repeats
        self.load = self.loaded(space, place).load
        sums = yield [
            SimulationRequest(self, space, np.repeat(np.atleast_2d(place), repeats, 0), seed, repeats=True)
        ]
        return self.take(sums[0])

    def take(self, sums: ProbeSums) -> Array:
        """Make the model with these repeats the present one; return their statistics."""
        bare = replace(self.frame, expected=sums.halves.mean(0, dtype=np.float64), measured=None)
        target, events = compute_statistics(self.found, bare)
        self.frame = replace(bare, measured=target[0])
        values, sent = compute_statistics(sums, self.frame)
        off = np.maximum(tolerance_of(target[0], events[0]), 1e-9) ** 2
        repeats = 2.0 * values.var(0, ddof=1)
        counted, here = events[0].copy(), sent.mean(0)
        # the weight of these is what the model sends
        counted[LAYOUT["spread"]] = events_of_spread(self.found.halves.sum(1, dtype=np.float64))[0]
        least = shortfall_of(counted, here)
        used = is_compared(target[0], events[0]) | (least > 0)
        self.off = np.sqrt(off)
        self.chance = ErrorScale(target[0], np.sqrt((0.5 + 0.5 / len(values)) * repeats + off), used)
        self.simulated = values.mean(0)
        measured, present = (
            compute_statistics(leave_groups_out(one, self.frame), self.frame)[0] for one in (self.found, sums)
        )
        self.left = measured - present
        scatter = (len(self.left) - 1) * self.left.var(0)
        self.scale = ErrorScale(target[0], np.sqrt(np.maximum(repeats, scatter) + off), used)
        # of the difference from the mean of the repeats, which has nearly no sampling error of its own
        seen = np.maximum((0.5 + 0.5 / len(values)) * repeats, scatter - (0.5 - 0.5 / len(values)) * repeats)
        # by the scatter of a model that sends too few, it would be close to everything
        own = sampling_variance(measured, counted)
        seen = np.where(lacks_events(counted, here), np.minimum(seen, own), seen)
        self.seen = ErrorScale(target[0], np.sqrt(seen + off), used, least)
        return values

    @property
    def groups(self) -> int:
        """Number of groups of pixels."""
        return len(self.left)

    def judge(self, repeats: Array, *, seed: int) -> Judgement:
        """Return the error of the present model, whose repeats are given."""
        return judge_model(repeats, self.seen, self.chance, self.off, seed=seed)
