"""A search that does not reach the floor begins once more with what came next in its first step."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from helpers.search_models import GATE, judged, model_with

from dase.diagnosis import effect_search
from dase.diagnosis.effect_search import _go_the_other_way
from dase.diagnosis.state import DiagnosisState, DiagnosisTask, SearchPath
from dase.effects import EFFECTS
from dase.fitting.model import model_of
from dase.results import Step
from dase.simulation.sensor import Sensor


def tried(name: str, loss: float) -> Any:
    return SimpleNamespace(
        name=name, screened_loss=loss, error=loss, judgement=judged(loss), model=model_with(name)
    )


def step(chosen: str | None, *effects: str) -> Step:
    return Step(("threshold", *effects), 5.0, GATE, {}, (), chosen, (), ())


@pytest.fixture
def state(monkeypatch) -> DiagnosisState:
    """A search that took `linlog` first, beside which nothing helps; `dark` came next."""
    monkeypatch.setattr(effect_search, "refit_model", lambda evidence, model, **how: model)
    monkeypatch.setattr(DiagnosisTask, "judge", lambda self, model, **how: judged(5.0))
    first = (tried("linlog", 0.60), tried("dark", 0.62), tried("leak", 0.95), tried("shot", 0.99))
    path = SearchPath(
        history=(step("linlog"), step(None, "linlog")),
        models=(model_with(), model_with("linlog")),
        alternatives={"linlog": first[1:]},
        first=first,
    )
    evidence = SimpleNamespace(samples=1e9, evaluations=100)
    task = DiagnosisTask(evidence, EFFECTS, 0, lambda *told: None, frozenset({"threshold"}))
    return DiagnosisState(task, path=path)


def searched(monkeypatch, state: DiagnosisState, end: float) -> tuple[list[tuple[str, ...]], tuple[Any, Any]]:
    """Return from which effects the search began once more, and its result, if a leak beside leaves `end`."""
    begun = []

    def add_leak(state, compared, model, most):
        begun.append((state.task.added_to(model), most))
        for one in (model, model_with("dark", "leak")):
            state.add_model(one)
        for one in (step("leak", "dark"), step(None, "dark", "leak")):
            state.add_step(one)
        return state.path.models[-1], judged(end)

    monkeypatch.setattr(effect_search, "_add_one_by_one", add_leak)
    return begun, _go_the_other_way(state, None, model_with("linlog"), judged(2.0), 4)


def test_the_better_way_is_taken(monkeypatch, state):
    begun, (model, judgement) = searched(monkeypatch, state, 1.1)
    assert begun == [(("dark",), 3)]
    assert state.task.added_to(model) == ("dark", "leak")
    assert judgement.error == 1.1
    assert [one.chosen for one in state.path.history] == ["dark", "leak", None]
    assert [state.task.added_to(one) for one in state.path.models] == [(), ("dark",), ("dark", "leak")]
    assert [one.name for one in state.path.alternatives["dark"]] == ["linlog", "leak", "shot"]


@pytest.mark.parametrize("end", [1.9, 3.0])
def test_a_way_that_gains_little_is_forgotten(monkeypatch, state, end):
    before = state.path
    _, (model, judgement) = searched(monkeypatch, state, end)
    assert state.task.added_to(model) == ("linlog",)
    assert judgement.error == 2.0
    assert state.path is before


@pytest.mark.parametrize("loss", [0.91, 0.985])
def test_what_explains_far_less_begins_no_other_way(monkeypatch, state, loss):
    first = (state.path.first[0], tried("dark", loss), *state.path.first[2:])
    state.path = replace(state.path, first=first)
    begun, (model, _) = searched(monkeypatch, state, 1.1)
    assert not begun
    assert state.task.added_to(model) == ("linlog",)


def test_a_long_way_begins_no_other(monkeypatch, state):
    state.samples_before = int(6e9)
    begun, (model, _) = searched(monkeypatch, state, 1.1)
    assert not begun
    assert state.task.added_to(model) == ("linlog",)


def test_what_the_first_way_found_begins_no_other(monkeypatch, state):
    begun = []
    monkeypatch.setattr(effect_search, "_add_one_by_one", lambda *given: begun.append(given))
    both = model_with("linlog", "dark")
    assert _go_the_other_way(state, None, both, judged(2.0), 4)[0] is both
    assert not begun


def test_a_search_that_goes_back_takes_as_certain_what_was_but_asks_for_what_is_put_off(state):
    state.begin_path(certain=frozenset({"refractory"}), shown=frozenset(), noise=0.0)
    before = state.path
    state.put_off("refractory")
    state.make_certain("jitter")
    assert state.path.certain == {"jitter"}
    state.go_back(before)
    assert state.path.certain == {"refractory"}
    assert state.events_alone.put_off == {"refractory"}


def test_what_was_simulated_before_a_measurement_is_split_anew_counts(state):
    state.split_anew(SimpleNamespace(samples=10, evaluations=2))
    state.split_anew(SimpleNamespace(samples=20, evaluations=3))
    assert (state.samples, state.evaluations) == (1e9 + 30, 105)
    assert state.task.all_time


def began_as_given(monkeypatch, state, *, error=1.7, as_given=8.3, base=("bandwidth",)) -> Any:
    """Return the values that effects were tried beside, and the result, if a lin-log response is missing.

    Fitted, a base of its own leaves `error` and 350 Hz; as it was given, with 460 Hz, `as_given`.
    """
    beside = []

    def of_given(model) -> bool:
        return "bandwidth" in model.sensor and model.sensor["bandwidth"].cutoff > 400

    def try_all(present, model, *rest, **how):
        beside.append(model.sensor)
        sensor = model.sensor.with_effect(EFFECTS["linlog"]())
        found = {**vars(tried("linlog", 0.5)), "model": model_of(sensor), "p_value": 0.03, "includes": ()}
        return [SimpleNamespace(**found)]

    monkeypatch.setattr(effect_search, "try_effects", try_all)
    monkeypatch.setattr(effect_search, "calibrate_split", lambda evidence, *given, **how: evidence)
    monkeypatch.setattr(effect_search, "worst_families", lambda judgement: ())
    monkeypatch.setattr(effect_search, "rank_of", lambda one, without: SimpleNamespace(fall=1.2, share=1.0))
    monkeypatch.setattr(
        DiagnosisTask, "judge", lambda self, model, **how: judged(as_given if of_given(model) else error)
    )
    monkeypatch.setattr(
        effect_search, "_add_one_by_one", lambda state, compared, model, most: (model, judged(0.4))
    )
    given, fitted = Sensor(), Sensor()
    for name in base:
        given = given.with_effect(EFFECTS[name](**({"cutoff": 460.0} if name == "bandwidth" else {})))
        fitted = fitted.with_effect(EFFECTS[name](**({"cutoff": 350.0} if name == "bandwidth" else {})))
    start = model_of(fitted, ["bandwidth.cutoff"] if "bandwidth" in base else None)
    state.path = SearchPath(history=(step(None, *base),), models=(start,), first=(tried("linlog", 1.6),))
    state.task = replace(state.task, given=frozenset({"threshold", *base}))
    compared = SimpleNamespace(given=given)
    return beside, effect_search._begin_as_given(state, compared, start, start, judged(error), 3)


def test_a_search_begins_again_from_what_was_given_of_a_base_that_stands_in(monkeypatch, state):
    """A low-pass, mismatch and thresholds had taken most of a lin-log response, and it was not found."""
    beside, (model, judgement) = began_as_given(monkeypatch, state)
    assert [one["bandwidth"].cutoff for one in beside] == [pytest.approx(460.0)]
    assert (state.task.added_to(model), judgement.error) == (("linlog",), 0.4)
    assert [one.chosen for one in state.path.history] == ["linlog"]


@pytest.mark.parametrize("how", [{"as_given": 1.8}, {"error": 4.0}, {"base": ()}])
def test_it_does_not_where_the_base_has_taken_nothing_or_there_is_none(monkeypatch, state, how):
    before, _ = began_as_given(monkeypatch, state, **how)
    assert not before
