"""Which searches go on, which candidates are followed, judged and fitted in full."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

import dase
from dase.diagnosis.candidates import (
    Candidate,
    calibrate_split,
    refit_and_judge_far_off,
    try_effects,
    worth_descending,
)
from dase.diagnosis.explain_effect import moving_bars
from dase.diagnosis.pruning import _keep_near_models
from dase.diagnosis.settings import DEFAULTS
from dase.diagnosis.state import DiagnosisTask, SearchPath
from dase.effects import EFFECTS
from dase.fitting.data_split import split_measurement
from dase.fitting.descent import descent_work
from dase.fitting.early_stopping import CandidateRace, stop_unless_below
from dase.fitting.measurement import Measurement
from dase.fitting.model import model_of
from dase.fitting.scheduler import run_work
from dase.results import Rank, Step
from dase.simulation.sensor import Sensor

THRESHOLD = EFFECTS["threshold"](on=0.18, off=0.2)
TRUE = Sensor((THRESHOLD,)).with_effect(EFFECTS["mismatch"](spread=0.2))
LIBRARY = {name: EFFECTS[name] for name in ("threshold", "mismatch", "leak", "hot")}


def test_what_will_not_come_to_the_front_stops():
    race = CandidateRace(2)
    a, b, c = (race.over(name, unit=2.0) for name in "abc")
    assert not any(over(loss, np.inf) for over, loss in ((a, 1.0), (b, 1.6), (c, 8.0)))  # not after the first
    assert not c(4.0, 8.0)  # falls by half: at 1 after two more
    assert c(3.8, 4.0)  # would be at 3.4, the second is at 1.6
    assert not b(1.6, 1.6)  # among those that go on
    assert race.best == {"a": 0.5, "b": 0.8, "c": 1.9}


def test_of_two_searches_of_a_candidate_the_one_behind_stops():
    race = CandidateRace(2)
    one, other = race.over("a"), race.over("a")
    assert not one(1.0, 1.05)
    assert not other(1.4, np.inf)
    assert other(1.3, 1.4)
    assert not one(0.99, 1.0)


def test_what_comes_to_the_front_stops_where_even_that_is_not_enough():
    over = CandidateRace(1, goal=2.0).over("a")
    assert not over(9.0, np.inf)
    assert not over(4.0, 8.0)  # at 1 after two more
    assert over(3.9, 4.0)


def test_a_goal_out_of_reach():
    over = stop_unless_below(1.0)
    assert not over(9.0, np.inf)
    assert not over(3.0, 9.0)  # a third each time
    assert over(2.9, 3.0)


def look(name: str, share: float, streams: bool = False) -> SimpleNamespace:
    half = SimpleNamespace(streams=lambda space: streams)
    return SimpleNamespace(
        effect=SimpleNamespace(name=name), relative_loss=share, half=half, model=model_of(TRUE)
    )


def test_where_one_is_clearly_ahead_the_turn_of_others_comes():
    others = [look(f"e{n}", 0.9 + 0.01 * n) for n in range(12)]
    buses = [look("bus", 0.95, True), look("late", 1.5, True)]
    got = [one.effect.name for one in worth_descending([*others, *buses, look("best", 0.3)])]
    assert sorted(got) == sorted(["best", "bus", *(f"e{n}" for n in range(6))])
    assert len(got) == DEFAULTS.candidates.followed
    got = [one.effect.name for one in worth_descending([*others, *buses, look("best", 0.8)])]
    assert set(got) == {"best", "bus", *(f"e{n}" for n in range(12))}  # only the bus far behind is left out


@pytest.fixture(scope="module")
def search(device) -> DiagnosisTask:
    scene = moving_bars()
    events = dase.simulate(scene, TRUE, seed=4, device=device)
    evidence = split_measurement(Measurement(events, scene), pixels=600, seed=1, device=device)
    return DiagnosisTask(evidence, LIBRARY, 1, lambda text, share, error: None, frozenset({"threshold"}))


@pytest.mark.parametrize("lacks", [True, False], ids=["lacks mismatch", "lacks nothing"])
def test_what_chance_does_as_well_is_not_judged(search, lacks):
    model, evidence = model_of(Sensor((THRESHOLD,)) if lacks else TRUE), search.evidence
    present = calibrate_split(evidence, model, repeats=60, scout_repeats=16, seed=0)
    names = ["mismatch", "leak", "hot"] if lacks else ["leak", "hot"]
    tried = try_effects(present, model, LIBRARY, names, worst=(), seed=1, report=lambda text, share: None)
    assert {t.name for t in tried} == set(names)
    for one in tried:
        assert one.judgement is None or one.p_value <= DEFAULTS.candidates.significant
    if lacks:
        assert tried[0].name == "mismatch"
        assert tried[0].judgement is not None
        assert tried[0].p_value == pytest.approx(1 / 61)
        assert tried[0].error < 0.8
    else:
        assert all(t.judgement is None for t in tried)


def test_beside_a_model_far_off_only_what_comes_near_the_floor_is_fitted_to_all_pixels(search):
    train = search.evidence.train.trials
    wrong = Sensor((EFFECTS["threshold"](on=0.5, off=0.5),)).with_effect(EFFECTS["leak"](rate=1.0))
    far = Candidate("leak", model_of(wrong, ["leak.rate"]), 1.0)
    near = Candidate("mismatch", model_of(TRUE), 1.0)
    before = train.evaluations
    (judged,) = refit_and_judge_far_off(search.evidence, [far], seed=1)
    assert judged.error > DEFAULTS.candidates.far
    assert train.evaluations == before
    judged = refit_and_judge_far_off(search.evidence, [far, near], seed=1)
    assert {one.name for one in judged} == {"leak", "mismatch"}
    assert min(one.error for one in judged if one.judgement) < 0.8
    assert train.evaluations > before
    assert refit_and_judge_far_off(search.evidence, [], seed=1) == []


def test_all_effects_are_tried_once_beside_the_same_ones():
    def tried(*names: str) -> Step:
        ranking = tuple(Rank(name, 1.0, 0.5, 0.5, 0.01, {}, True) for name in names)
        return Step(("threshold", "mismatch"), 1.5, 1.15, {}, ranking, None, (), ())

    for history, asked in (
        ((), False),
        ((tried(),), False),
        ((tried("hot"),), False),
        ((tried("leak"),), True),
    ):
        path = SearchPath(history, certain=frozenset({"hot"}))
        assert path.has_asked(model_of(TRUE)) is asked
        assert not path.has_asked(model_of(Sensor((THRESHOLD,))))


def test_only_what_one_descent_takes_near_is_fitted_in_full(search):
    slow = TRUE.with_effect(EFFECTS["bandwidth"](cutoff=10.0))
    ways = {"far": model_of(slow, ["threshold"]), "near": model_of(TRUE)}
    assert list(_keep_near_models(search, ways, 1.15)) == ["near"]
    assert _keep_near_models(search, {}, 1.15) == {}


def test_a_search_that_is_over_stops(search):
    model = model_of(TRUE)
    half = model.calibrate(search.evidence.scout, repeats=16, seed=200)
    asked: list[float] = []

    def over(loss: float, before: float) -> bool:
        asked.append(loss)
        return len(asked) == 2

    found = run_work(descent_work(half, model.space, model.place + 0.2, seed=1, iterations=6, over=over))
    population = 2 * len(model.place) + 3
    assert len(found.places) == 2 * population + 1
    assert found.loss <= asked[-1] + 0.01
