"""Candidates that need many samples in time: how they are fitted."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.brief_diagnosis import NO_LIMITS

import dase
from dase.diagnosis import candidates
from dase.diagnosis.candidates import Candidate, calibrate_split, finalists_of, screen_and_descend
from dase.diagnosis.explain_effect import moving_bars
from dase.diagnosis.settings import DEFAULTS
from dase.effects import EFFECTS
from dase.effects.leak import Leak
from dase.effects.threshold import Threshold
from dase.effects.voltage_noise import VoltageNoise
from dase.fitting.data_split import split_measurement
from dase.fitting.measurement import as_measurement
from dase.fitting.model import fit_present_model
from dase.fitting.trial_sampling import SAMPLES, samples_of_screening
from dase.simulation.sensor import Sensor
from perf.experiments.signatures.run import draw_scene

STEP = 1e-3
COARSE_LOSS = {"leak": 5.0, "near": 6.0, "far": 100.0}
"""Of each candidate where it is sampled coarsely; only `near` is worth being sampled finely."""


@pytest.mark.parametrize(
    ("least", "fitted"),
    [
        (0.2, ["leak", "leak", "dark", "jitter", "shot", "mismatch"]),
        (0.6, ["leak", "leak", "dark", "jitter", "shot"]),
    ],
)
def test_candidates_near_one_that_explains_most_are_fitted_too(least, fitted):
    """Four effects are, however many variants; beside one that explains little so are no others near it."""
    names = ["leak", "leak", "dark", "jitter", "shot", "mismatch", "hot"]
    losses = least * np.array([1.0, 1.02, 1.1, 1.2, 1.25, 1.29, 1.31])
    order = [Candidate(name, SimpleNamespace(), 1.0, loss) for name, loss in zip(names, losses, strict=True)]
    assert [one.name for one in finalists_of(order)] == fitted
    assert finalists_of([]) == []


def test_what_a_coarse_fit_takes_near_the_best_is_fitted_again_from_where_screening_left_it(monkeypatch):
    """A coarse fit makes up for events that are lost between samples: it is no place to begin from."""
    fast = VoltageNoise(cutoff=2500.0)
    effects = {"leak": Leak(), "near": fast, "far": fast}
    chosen = [
        Candidate(name, SimpleNamespace(sensor=Sensor((Threshold(), effect)), place="screened"), 50.0)
        for name, effect in effects.items()
    ]
    begun = []

    def fit(evidence, tried, race, *, seed, most):
        begun.append((tried.name, tried.model.place, most))
        ended = SimpleNamespace(sensor=tried.model.sensor, place=f"fitted with {most}")
        return replace(tried, model=ended, training_loss=COARSE_LOSS[tried.name])
        yield

    monkeypatch.setattr(candidates, "refine_candidate", fit)
    evidence = SimpleNamespace(train=SimpleNamespace(frame=SimpleNamespace(step=STEP)))
    present = SimpleNamespace(sensor=Sensor((Threshold(),)))
    coarse = samples_of_screening(present.sensor, STEP)
    refined, behind = candidates._refine_candidates(
        evidence, present, chosen, seed=0, settings=DEFAULTS.candidates
    )
    assert sorted(begun[:3]) == sorted((name, "screened", coarse) for name in effects)
    assert begun[3:] == [("near", "screened", SAMPLES[-1])]
    assert [(one.name, one.model.place) for one in refined] == [
        ("leak", f"fitted with {coarse}"),
        ("near", f"fitted with {SAMPLES[-1]}"),
    ]
    assert [one.name for one in behind] == ["far"]


@pytest.mark.slow
def test_a_diagnosis_finds_noise_that_is_faster_than_screening_samples():
    """Sampled four times a step at most, its cutoff comes out at 5 kHz; once, nothing is found at all."""
    truth = VoltageNoise(sigma=0.08, cutoff=2500.0)
    scene = moving_bars(duration=0.3)
    events = dase.simulate(scene, Sensor().with_effect(truth), seed=6)
    library = {name: EFFECTS[name] for name in ("threshold", "voltage_noise", "shot")}
    found = dase.diagnose(events, scene=scene, effects=library, pixels=120, settings=NO_LIMITS)
    assert found.selected == ("voltage_noise",)
    assert found.unexplained is None
    assert found.errors[1] < 2 < 20 < found.errors[0]
    cutoff, sigma = found.parameters["voltage_noise.cutoff"], found.parameters["voltage_noise.sigma"]
    assert 500 < cutoff.low < truth.cutoff < cutoff.high < 2 * truth.cutoff
    assert sigma.value == pytest.approx(truth.sigma, rel=0.1)


def test_the_shape_of_a_lamp_is_told_though_its_phase_was_found_beside_wrong_thresholds():
    """A fit without the lamp has thresholds far too low, and the other shape's best phase is near."""
    lamp = EFFECTS["flicker"](frequency=120.0, depth=0.132, phase=0.567)
    sensor = Sensor((Threshold(on=0.23, off=0.28),)).with_effect(lamp)
    scene = draw_scene(np.random.default_rng(16), "shake", 0.6)
    measurement = as_measurement(dase.simulate(scene, sensor, seed=16), scene)
    evidence = split_measurement(measurement, pixels=300, seed=0)
    present = fit_present_model(evidence, Sensor(), None, seed=0)
    split = calibrate_split(evidence, present, repeats=12, scout_repeats=12, seed=0)
    sine, rectified = (
        screen_and_descend(split, present, EFFECTS["flicker"](frequency=120.0, shape=shape), seed=0)
        for shape in ("sine", "rectified")
    )
    assert sine.screened_loss < 0.9 * rectified.screened_loss
    assert sine.model.sensor["flicker"].phase % 1.0 == pytest.approx(0.567, abs=0.03)
