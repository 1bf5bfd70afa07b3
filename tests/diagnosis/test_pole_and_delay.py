"""A pole and a delay take the place of two poles where they leave far less."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from helpers.search_models import judged, model_with

from dase.diagnosis import pole_and_delay
from dase.diagnosis.pole_and_delay import put_pole_and_delay
from dase.diagnosis.state import DiagnosisState, DiagnosisTask, SearchPath
from dase.effects import EFFECTS
from dase.effects.bandwidth import Bandwidth
from dase.effects.latency import Latency
from dase.effects.second_order import SecondOrder


@pytest.fixture
def begins(monkeypatch) -> list:
    """Models from which fits begin, none of which goes anywhere."""
    out = []

    def fitted(works, *told):
        out.extend(works)
        return works

    monkeypatch.setattr(pole_and_delay, "run_side_by_side", fitted)
    monkeypatch.setattr(pole_and_delay, "refit_work", lambda evidence, model, **how: model)
    monkeypatch.setattr(pole_and_delay, "refit_model", lambda evidence, model, **how: model)
    monkeypatch.setattr(pole_and_delay, "worst_cells", lambda evidence, judgement: ())
    return out


def state_of(effects=EFFECTS) -> DiagnosisState:
    task = DiagnosisTask(SimpleNamespace(), effects, 0, lambda *told: None, frozenset({"threshold"}))
    return DiagnosisState(task, path=SearchPath(history=(), models=(model_with(),)))


def asked(monkeypatch, state, model, *, now=0.8, then=0.3):
    """Ask of a model with an error whether it is another with another error."""
    monkeypatch.setattr(DiagnosisTask, "judge", lambda self, other, **how: judged(then))
    return put_pole_and_delay(state, model, judged(now))


@pytest.mark.parametrize(("then", "taken"), [(0.3, True), (0.7, False), (2.5, False)])
def test_they_take_the_place_of_two_poles_if_they_leave_far_less(monkeypatch, begins, then, taken):
    state, model = state_of(), model_with("second_order", "jitter")
    model, judgement = asked(monkeypatch, state, model, then=then)
    wanted = {"bandwidth", "latency", "jitter"} if taken else {"second_order", "jitter"}
    assert set(state.task.added_to(model)) == wanted
    assert judgement.error == (then if taken else 0.8)
    assert [one.chosen for one in state.path.history] == (["bandwidth + latency"] if taken else [])


def test_fits_begin_as_late_as_the_poles_are(monkeypatch, begins):
    model = model_with("second_order")
    two = model.sensor["second_order"]
    assert isinstance(two, SecondOrder)
    asked(monkeypatch, state_of(), model)
    assert len(begins) == 2
    for one in begins:
        pole, late = one.sensor["bandwidth"], one.sensor["latency"]
        assert isinstance(pole, Bandwidth)
        assert isinstance(late, Latency)
        # a ramp comes out as late: by twice the damping over the angular frequency
        total = late.delay + 1 / (2 * 3.141592653589793 * pole.cutoff)
        assert total == pytest.approx(2 * two.damping / (2 * 3.141592653589793 * two.cutoff), rel=1e-6)


def test_what_is_certain_or_has_no_others_stays(monkeypatch, begins):
    state = state_of()
    state.make_certain("second_order")
    model = model_with("second_order")
    assert asked(monkeypatch, state, model)[0] is model
    fewer = {name: effect for name, effect in EFFECTS.items() if name != "latency"}
    assert asked(monkeypatch, state_of(fewer), model)[0] is model
    beside = model_with("second_order", "latency")
    assert asked(monkeypatch, state_of(), beside)[0] is beside
    assert begins == []
