"""Work that asks for simulations, done side by side: what is asked for at the same time runs in one launch.

A search, a fit, a judgement is a generator: it yields what it wants simulated, gets the answers, and goes on.
`run_side_by_side` runs as many of them as there are, step by step. Rows of a launch do not know of each
other, so the sums are those that each would get alone, to the bit, and the statistics but for rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from dase.fitting.batch_simulator import BatchSimulator, SimulationOrder
from dase.fitting.parameter_space import ParameterSpace
from dase.fitting.trial_sampling import SAMPLES
from dase.probes.accumulators import ProbeSums, ProbeTotals, compute_totals
from dase.probes.statistics import compute_statistics

if TYPE_CHECKING:
    from dase.fitting.subset import PixelSubset

Array = NDArray[np.float64]

Result = TypeVar("Result")


@dataclass(frozen=True, eq=False)
class SimulationRequest:
    """Models that are to be simulated.

    Args:
        half: The pixels and the time.
        space: The models' free parameters.
        places: Where they are, shape (B, P).
        seed: Of the random numbers.
        repeats: Whether each model gets random numbers of its own. Then the answer is sums, else statistics,
            shape (B, J).
        most: Samples per step that no model exceeds, whatever it needs.
        finer: Samples per step of all models; None for as many as each needs.
    """

    half: PixelSubset
    space: ParameterSpace
    places: Array
    seed: int
    repeats: bool = False
    most: int = SAMPLES[-1]
    finer: int | None = None


Work = Generator[list[SimulationRequest], list[Any], Result]
"""Yields lists of what it asks for, and gets a list of the answers."""


def run_side_by_side(
    works: Sequence[Work[Result]], report: Callable[[float], None] | None = None
) -> list[Result]:
    """Do all works side by side and return their results; `report` is told the share that is done."""
    work = side_by_side_work(works, report)
    try:
        asks = next(work)
        while True:
            asks = work.send(answer_requests(asks))
    except StopIteration as stop:
        return list(stop.value)


def side_by_side_work(
    works: Sequence[Work[Result]], report: Callable[[float], None] | None = None
) -> Work[list[Result]]:
    """Do all works side by side within another work, and return their results."""
    results: dict[int, Result] = {}
    # a work is asked with its last answers; None begins it, as generators want it
    answers: dict[int, list[Any] | None] = dict.fromkeys(range(len(works)))
    while answers:
        # works keep step: the requests of all go out as one list, whose launches are as wide as can be
        asked: dict[int, list[SimulationRequest]] = {}
        for n, answer in answers.items():
            try:
                asked[n] = next(works[n]) if answer is None else works[n].send(answer)
            except StopIteration as stop:
                results[n] = stop.value
        # answers come in the order of the requests, whoever runs them, so works may lie within works
        if asked:
            found = iter((yield [ask for asks in asked.values() for ask in asks]))
            answers = {n: [next(found) for _ in asks] for n, asks in asked.items()}
        answers = answers if asked else {}
        if report is not None:
            report(len(results) / max(len(works), 1))
    return [results[n] for n in range(len(works))]


def run_work(work: Work[Result]) -> Result:
    """Do one work."""
    return run_side_by_side([work])[0]


def answer_requests(asks: Sequence[SimulationRequest]) -> list[Any]:
    """Return the answer to each: statistics, shape (B, J), or sums where repeats are asked for."""
    # by simulator: pixels and time are those of a launch
    orders: dict[int, tuple[BatchSimulator, list[int], list[SimulationOrder]]] = {}
    sums: dict[int, ProbeSums] = {}
    for n, ask in enumerate(asks):
        trials, frame = ask.half.trials, None if ask.repeats else ask.half.frame
        ticks = trials.ticks(ask.space.sensor)
        # a kernel has one clock for all rows of an order: where the fit changes it, events are stored instead
        if ticks and trials.has_free_readout(ask.space.sensor, ask.space.axes):
            ticks = None
        vectors = ask.space.vectors(ask.places)
        sensor, clock = ask.space.sensor, ticks or 0.0
        order = SimulationOrder(sensor, vectors, ask.seed, ask.repeats, ask.finer, frame, clock, ask.most)
        # events have to go through a readout, which takes ten times as long
        if ticks is None:
            effects = [trials.noticeable_effects(ask.space.at(place)) for place in np.atleast_2d(ask.places)]
            sums[n] = trials.simulate_streams(order, effects, ask.half.load)
        else:
            _, members, mine = orders.setdefault(id(trials), (trials, [], []))
            members.append(n)
            mine.append(order)
    for trials, members, mine in orders.values():
        sums.update(zip(members, trials.run_all(mine), strict=True))
    values = _statistics_of_requests(
        [(n, ask.half, sums[n]) for n, ask in enumerate(asks) if not ask.repeats]
    )
    return [sums[n] if ask.repeats else values[n] for n, ask in enumerate(asks)]


def _statistics_of_requests(found: Sequence[tuple[int, PixelSubset, ProbeSums]]) -> dict[int, Array]:
    """Return the statistics of models, those that refer to the same worked out at once."""
    # one call for all that share a frame: many rows at once take less time than row by row
    groups: dict[int, list[tuple[int, PixelSubset, ProbeSums]]] = {}
    for one in found:
        groups.setdefault(id(one[1].frame), []).append(one)
    out: dict[int, Array] = {}
    for members in groups.values():
        # expectations are the frame's, so those of the first stand for all
        frame = members[0][1].frame
        parts = [compute_totals(sums, frame) for _, _, sums in members]
        names = ("sums", "folded", "clock", "stamps")
        joined = [np.concatenate([getattr(p, n) for p in parts]) for n in names]
        both = ProbeTotals(joined[0], joined[1], joined[2], joined[3], parts[0].expected)
        ends = np.cumsum([len(p.sums) for p in parts])[:-1]
        values = np.split(compute_statistics(both, frame)[0], ends)
        out.update(zip([n for n, _, _ in members], values, strict=True))
    return out
