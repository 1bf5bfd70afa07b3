"""Where searches begin, and when their last steps are taken back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import dase
from dase.diagnosis.explain_effect import moving_bars
from dase.effects import EFFECTS
from dase.fitting import confidence_intervals
from dase.fitting import model as model_module
from dase.fitting.confidence_intervals import estimate_parameters
from dase.fitting.data_split import split_measurement
from dase.fitting.model import (
    model_of,
    refit_model,
    refit_work,
    shift_periodic_effects,
    starting_places,
    with_effect_added,
    with_phase,
)
from dase.fitting.scheduler import run_work
from dase.simulation.sensor import Sensor

LAMP = EFFECTS["flicker"](frequency=100.0, depth=0.2, phase=0.05)


@pytest.fixture(scope="module")
def lit() -> Sensor:
    return Sensor().with_effect(LAMP)


def phases(models) -> np.ndarray:
    return np.array([model.sensor["flicker"].phase for model in models])


def test_a_lamp_is_also_looked_for_one_step_earlier_and_later(lit):
    got = phases(shift_periodic_effects(model_of(lit), 1e-3)) % 1.0
    np.testing.assert_allclose(got, [0.05, 0.95, 0.15], atol=1e-6)
    bare = model_of(Sensor())
    assert shift_periodic_effects(bare, 1e-3) == [bare]


def test_a_lamp_at_the_end_of_the_range_of_phases_stays_within(lit):
    end = lit.with_effect(replace(LAMP, phase=0.95))
    got = phases(shift_periodic_effects(model_of(end), 1e-3))
    assert np.all(np.abs(got) <= 1.0)
    np.testing.assert_allclose(got % 1.0, [0.95, 0.85, 0.05], atol=1e-6)


def test_starts_go_once_round_the_lamp():
    model = with_effect_added(model_of(Sensor()), LAMP)
    n = [axis.name for axis in model.space.axes].index("flicker.phase")
    tried = np.unique(model.space.axes[n].to_value(starting_places(model, LAMP)[:, n]).round(6))
    np.testing.assert_allclose(tried, np.arange(8) / 8)


def test_thresholds_are_tried_on_both_sides_of_the_present_ones():
    present = model_of(Sensor())
    model = with_effect_added(present, EFFECTS["linlog"]())
    n = [axis.name for axis in model.space.axes].index("threshold.on")
    tried = starting_places(model, EFFECTS["linlog"]())[:, n] - model.place[n]
    assert tried.min() < -0.5
    assert tried.max() > 0.3


def test_a_phase_that_looks_no_better_at_the_same_place_is_found(device, monkeypatch):
    """One descent goes from it although nothing speaks for it there."""

    def never(*args, **options):
        yield from ()
        return False

    monkeypatch.setattr(model_module, "_as_good_work", never)
    scene, true = moving_bars(), Sensor().with_effect(EFFECTS["threshold"](on=0.2, off=0.2, phase=0.0))
    events = dase.simulate(scene, true, seed=4, device=device)
    found = split_measurement(events, scene, pixels=200, seed=1, device=device)
    start = with_phase(model_of(true), 1.0)
    assert run_work(refit_work(found, start, seed=0, rounds=1)).sensor["threshold"].phase == 1
    assert refit_model(found, start, seed=0, rounds=1).sensor["threshold"].phase == 0


@pytest.fixture(scope="module")
def evidence(lit, device):
    scene = moving_bars()
    return split_measurement(
        dase.simulate(scene, lit, seed=4, device=device), scene, pixels=200, seed=1, device=device
    )


def test_a_last_step_that_leads_astray_is_taken_back(evidence, lit, monkeypatch):
    model = model_of(lit, ["threshold", "flicker.depth", "flicker.phase"])
    gain = confidence_intervals._parameters_per_statistic

    def wrong(half, model, repeats, *, seed):
        out = gain(half, model, repeats, seed=seed)
        return -40.0 * out

    monkeypatch.setattr(confidence_intervals, "_parameters_per_statistic", wrong)
    stays, values = estimate_parameters(evidence, model, seed=0)
    np.testing.assert_array_equal(stays.place, model.place)
    assert values["flicker.phase"].value == pytest.approx(0.05, abs=1e-6)


def test_a_last_step_that_helps_is_taken(evidence, lit):
    off = lit.with_effect(replace(lit["threshold"], on=0.215, off=0.19))
    model = model_of(off, ["threshold"])
    moved, values = estimate_parameters(evidence, model, seed=0)
    assert values["threshold.on"].value == pytest.approx(lit["threshold"].on, rel=0.03)
    assert values["threshold.off"].value == pytest.approx(lit["threshold"].off, rel=0.03)
    assert not np.array_equal(moved.place, model.place)
