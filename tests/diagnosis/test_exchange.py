"""All others are tried in the place of an effect that was added beside other ones than are left."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from helpers.search_models import GATE, judged, model_with

from dase.diagnosis import exchange
from dase.diagnosis.exchange import exchange_effects
from dase.diagnosis.state import DiagnosisState, DiagnosisTask, SearchPath
from dase.effects import EFFECTS
from dase.fitting.model import FittedModel
from dase.results import Rank, Step


def tried(name: str, error: float, *beside: str) -> Any:
    return SimpleNamespace(name=name, error=error, judgement=judged(error), model=model_with(name, *beside))


@pytest.fixture
def state(monkeypatch) -> DiagnosisState:
    """A search that took a mismatch, a response linear in the dark beside it, and a jitter beside both.

    The mismatch was dropped in the end: of the response it is not known what does as well beside the jitter.
    """
    monkeypatch.setattr(exchange, "refit_model", lambda evidence, model, **how: model)
    monkeypatch.setattr(exchange, "worst_cells", lambda evidence, judgement: ())
    monkeypatch.setattr(
        exchange, "rank_of", lambda one, without: Rank(one.name, one.error, 0, 0, (), {}, 0.0)
    )
    steps = [
        Step(("threshold", *beside), 2.0, GATE, {}, (), chosen, (), ())
        for chosen, *beside in (
            ("mismatch",), ("linlog", "mismatch"), ("jitter", "mismatch", "linlog"),
            (None, "mismatch", "linlog", "jitter"),
        )
    ]  # fmt: skip
    path = SearchPath(
        history=tuple(steps), models=(model_with(),), alternatives={"linlog": ()}, error_of={"linlog": 0.4}
    )
    task = DiagnosisTask(SimpleNamespace(), EFFECTS, 0, lambda *told: None, frozenset({"threshold"}))
    return DiagnosisState(task, path=path)


def exchanged(
    monkeypatch, state: DiagnosisState, others: dict[str, list[Any]], error: float, swapped: float = 0.3
) -> tuple[list[str], FittedModel, Any]:
    """Return which effects others were tried for, the model, and its error, if `others` come near each."""
    asked = []

    def in_its_place(task, model, bare, name, judgement):
        asked.append(name)
        assert name not in bare.sensor
        return others.get(name, [])

    monkeypatch.setattr(exchange, "_in_its_place", in_its_place)
    monkeypatch.setattr(DiagnosisTask, "judge", lambda self, model, **how: judged(swapped))
    model, judgement = exchange_effects(state, model_with("linlog", "jitter"), judged(error))
    return asked, model, judgement


def test_what_does_as_well_beside_all_else_becomes_a_rival(monkeypatch, state):
    near = [tried("dark", 0.31, "jitter"), tried("latency", 0.6, "jitter")]
    asked, model, judgement = exchanged(monkeypatch, state, {"linlog": near}, 0.33)
    assert asked == ["linlog", "jitter"]
    assert state.task.added_to(model) == ("linlog", "jitter")
    assert judgement.error == 0.33
    assert [one.name for one in state.path.alternatives["linlog"]] == ["dark", "latency"]
    assert state.path.error_of["linlog"] == 0.33


@pytest.mark.parametrize(("swapped", "taken"), [(0.3, True), (2.5, False)])
def test_what_does_clearly_better_takes_its_place(monkeypatch, state, swapped, taken):
    near = [tried("dark", 0.3, "jitter")]
    _, model, judgement = exchanged(monkeypatch, state, {"linlog": near}, 2.0, swapped)
    assert set(state.task.added_to(model)) == ({"dark", "jitter"} if taken else {"linlog", "jitter"})
    assert judgement.error == (0.3 if taken else 2.0)
    chosen = [one.chosen for one in state.path.history]
    assert chosen[4:] == (["dark"] if taken else [])
    if taken:
        assert state.path.history[-1].model == ("threshold", "jitter")


def test_what_is_certain_or_was_added_to_all_the_others_is_not_asked_for(monkeypatch, state):
    state.make_certain("jitter")
    asked, *_ = exchanged(monkeypatch, state, {}, 0.33)
    assert asked == ["linlog"]
    state.add_step(Step(("threshold", "jitter"), 2.0, GATE, {}, (), "linlog", (), ()))
    asked, *_ = exchanged(monkeypatch, state, {}, 0.33)
    assert asked == []


def test_nothing_is_exchanged_far_from_the_floor(monkeypatch, state):
    asked, *_ = exchanged(monkeypatch, state, {}, 3.1 * GATE)
    assert asked == []
