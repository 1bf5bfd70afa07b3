"""Where searches begin, and when their last steps are taken back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import dase
from dase.diagnosis.explain_effect import moving_bars
from dase.effects import EFFECTS
from dase.effects.base import Observations
from dase.fitting import confidence_intervals
from dase.fitting import model as model_module
from dase.fitting.confidence_intervals import estimate_parameters
from dase.fitting.data_split import split_measurement
from dase.fitting.fit import with_phase_given
from dase.fitting.measurement import Measurement
from dase.fitting.model import (
    model_of,
    places_around,
    places_between,
    places_of_as_many_events,
    refit_model,
    refit_work,
    shift_periodic_effects,
    starting_places,
    ways_otherwise,
    with_effect_added,
    with_phase,
)
from dase.fitting.scheduler import run_work
from dase.probes.distance import ErrorScale
from dase.probes.statistics import SIZE
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
    present = model_of(lit)
    assert shift_periodic_effects(present, 1e-3, ["bandwidth"]) == [present]
    assert len(shift_periodic_effects(present, 1e-3, ["flicker"])) == 3


def test_a_lamp_at_the_end_of_the_range_of_phases_stays_within(lit):
    end = lit.with_effect(replace(LAMP, phase=0.95))
    got = phases(shift_periodic_effects(model_of(end), 1e-3))
    assert np.all(np.abs(got) <= 1.0)
    np.testing.assert_allclose(got % 1.0, [0.95, 0.85, 0.05], atol=1e-6)


def test_starts_go_once_round_the_lamp():
    model = with_effect_added(model_of(Sensor()), LAMP)
    n = [axis.name for axis in model.space.axes].index("flicker.phase")
    tried = np.unique(model.space.axes[n].to_value(starting_places(model, LAMP)[:, n]).round(6))
    np.testing.assert_allclose(tried, np.arange(8) / 8 - 0.5)


def test_what_repeats_is_tried_at_phases_all_round_and_nothing_else_is():
    model = with_effect_added(with_effect_added(model_of(Sensor()), LAMP), EFFECTS["bandwidth"]())
    n = [axis.name for axis in model.space.axes].index("flicker.phase")
    around = places_around(model, "flicker")
    turns = np.sort(model.space.axes[n].to_value(around[:, n]))
    assert np.diff(turns).max() <= 1 / 32 + 1e-6
    assert turns[-1] - turns[0] >= 30 / 32
    others = np.delete(np.arange(len(model.place)), n)
    assert (around[:, others] == model.place[others]).all()
    assert places_around(model, "bandwidth").shape == (0, len(model.place))


def test_thresholds_are_tried_on_both_sides_of_the_present_ones():
    present = model_of(Sensor())
    model = with_effect_added(present, EFFECTS["linlog"]())
    n = [axis.name for axis in model.space.axes].index("threshold.on")
    tried = starting_places(model, EFFECTS["linlog"]())[:, n] - model.place[n]
    assert tried.min() < -0.5
    assert tried.max() > 0.3


def test_the_best_start_has_places_half_way_to_its_neighbours():
    """A dark current makes thresholds lower: between the steps of both its narrow valley would be missed."""
    effect = EFFECTS["dark"]()
    model = with_effect_added(model_of(Sensor()), effect)
    names = [axis.name for axis in model.space.axes]
    current, on, off = (names.index(n) for n in ("dark.current", "threshold.on", "threshold.off"))
    starts = starting_places(model, effect)
    place = starts[len(starts) // 2]
    between = places_between(model, effect, place)
    steps = np.diff(np.unique(starts[:, current].round(9)))
    away = between - place
    assert {abs(x) for x in away[:, current].round(6)} == {0.0, round(float(steps[0]) / 2, 6)}
    assert np.all(away[:, on] == away[:, off])
    assert {*np.sign(away[:, on])} == {-1, 1}
    shifts = np.diff(np.unique(starts[:, on].round(9)))
    assert np.all(np.abs(away[:, on]) < shifts.max())
    still = np.delete(away, [current, on, off], axis=1)
    assert not still.any()
    # the phase of a lamp goes round, and a bus is seen: neither has a strength along a range
    lit = with_effect_added(model_of(Sensor()), EFFECTS["readout"]())
    assert not len(places_between(lit, EFFECTS["readout"](), lit.place))


@pytest.mark.parametrize("seed", [4, 5])
def test_a_dark_current_is_tried_at_thresholds_with_which_as_many_events_come(seed):
    """Along the valley that steps of thresholds miss, to the end of what is plausible."""
    random, times = np.random.default_rng(seed), 1e-3 * np.arange(600)
    waves = np.sin(2 * np.pi * random.uniform(3, 9, (20, 30, 1)) * times + random.uniform(0, 6, (20, 30, 1)))
    light = np.exp(waves - random.uniform(0, 3, (20, 30, 1)))
    scene = dase.VideoScene(np.moveaxis(0.3 * light, -1, 0).astype(np.float32), times)
    present = model_of(Sensor())
    sent = len(dase.simulate(scene, present.sensor))
    effect = EFFECTS["dark"]()
    model = with_effect_added(present, effect)
    places = places_of_as_many_events(model, effect, 0.3 * light.reshape(600, -1) + present.sensor.log_eps)
    made = [model.space.at(place) for place in places]
    most = max(made, key=lambda one: one["dark"].current)
    assert most["dark"].current == pytest.approx(0.1)
    assert most["threshold"].on < 0.8 * present.sensor["threshold"].on
    for one in made:
        assert len(dase.simulate(scene, one)) == pytest.approx(sent, rel=0.1)
    assert len(dase.simulate(scene, most.with_effect(present.sensor["threshold"]))) < 0.8 * sent
    # what leaves all of the swing has no such places
    lamp = EFFECTS["flicker"]()
    assert not len(places_of_as_many_events(with_effect_added(present, lamp), lamp, light.reshape(600, -1)))


def test_a_phase_that_looks_no_better_at_the_same_place_is_found(device, monkeypatch):
    """One descent goes from it although nothing speaks for it there."""

    def never(*args, **options):
        yield from ()
        return False

    monkeypatch.setattr(model_module, "_as_good_work", never)
    scene, true = moving_bars(), Sensor().with_effect(EFFECTS["threshold"](on=0.2, off=0.2, phase=0.0))
    events = dase.simulate(scene, true, seed=4, device=device)
    found = split_measurement(Measurement(events, scene), pixels=200, seed=1, device=device)
    start = with_phase(model_of(true), 1.0)
    assert run_work(refit_work(found, start, seed=0, rounds=1)).sensor["threshold"].phase == 1
    assert refit_model(found, start, seed=0, rounds=1).sensor["threshold"].phase == 0


def test_a_rule_that_was_left_before_it_was_fitted_is_tried_from_the_end(device):
    """Far from the truth the other phase looks better, and all else is bent to make up for it."""
    scene, true = moving_bars(), Sensor().with_effect(EFFECTS["leak"](rate=5.0, spread=0.1))
    events = dase.simulate(scene, true, seed=4, device=device)
    found = split_measurement(Measurement(events, scene), pixels=300, seed=1, device=device)
    start = model_of(Sensor().with_effect(EFFECTS["leak"](rate=5.75, spread=0.1, light=3.0)))
    fitted = refit_model(found, start, seed=0).sensor
    assert fitted["threshold"].phase == 1
    assert fitted["leak"].rate == pytest.approx(5.0, rel=0.1)


@pytest.mark.parametrize(
    ("others", "found", "given", "kept"), [((), 0.0, 1.0, 0.0), (("mismatch", "shot"), 0.0, 1.0, 1.0),
                                           (("mismatch", "shot"), 1.0, 0.0, 0.0)]
)  # fmt: skip
def test_a_phase_stays_as_it_was_given_where_nothing_tells_another(device, others, found, given, kept):
    """Pixels that all begin at the light are told where they are alike; not beside mismatch and noise."""
    scene, true = moving_bars(), Sensor().with_effect(EFFECTS["threshold"](phase=0.0))
    for name, value in (("mismatch", {"spread": 0.15}), ("shot", {"rate": 2.0})):
        true = true.with_effect(EFFECTS[name](**value)) if name in others else true
    events = dase.simulate(scene, true, seed=4, device=device)
    evidence = split_measurement(Measurement(events, scene), pixels=300, seed=1, device=device)
    end, start = with_phase(model_of(true), found), with_phase(model_of(true), given).sensor
    assert with_phase_given(evidence, end, start, seed=0).sensor["threshold"].phase == kept


@pytest.mark.slow
def test_a_fit_says_that_the_phase_is_the_recordings(device):
    scene, true = moving_bars(), Sensor().with_effect(EFFECTS["threshold"](phase=0.0))
    events = dase.simulate(scene, true, seed=4, device=device)
    found = dase.fit(events, Sensor(), scene=scene, pixels=150, device=device)
    assert found.sensor["threshold"].phase == 0
    assert any(note.startswith("threshold.phase is 0 instead of 1") for note in found.notes)
    assert not any("phase" in note for note in dase.fit(events, true, scene=scene, pixels=150).notes)


@pytest.mark.parametrize(("rule", "other"), [("drop", "delay"), ("delay", "drop"), ("reset", "delay")])
def test_another_rule_of_a_dead_time_is_found(device, rule, other):
    scene, dead = moving_bars(), EFFECTS["refractory"](period=6e-3, mode=rule)
    events = dase.simulate(scene, Sensor().with_effect(dead), seed=4, device=device)
    found = split_measurement(Measurement(events, scene), pixels=300, seed=1, device=device)
    start = model_of(Sensor().with_effect(replace(dead, mode=other)))
    assert refit_model(found, start, seed=0, rounds=1).sensor["refractory"].mode == rule


@pytest.mark.slow
def test_a_fit_says_which_rule_it_has_changed(device):
    scene, dead = moving_bars(), EFFECTS["refractory"](period=6e-3, mode="drop")
    events = dase.simulate(scene, Sensor().with_effect(dead), seed=4, device=device)
    given = Sensor().with_effect(replace(dead, mode="delay"))
    found = dase.fit(events, given, scene=scene, pixels=150, device=device)
    assert found.sensor["refractory"].mode == "drop"
    assert any(note.startswith("refractory.mode is drop instead of delay") for note in found.notes)
    kept = dase.fit(events, given, scene=scene, free=["threshold"], pixels=150, device=device)
    assert kept.sensor["refractory"].mode == "delay"


@pytest.mark.slow
def test_noise_passes_the_dead_time_of_a_fit_where_it_does(device):
    scene, noise = moving_bars(), EFFECTS["shot"](rate=30.0)
    dead = EFFECTS["refractory"](period=1e-2, mode="delay", noise="passes")
    events = dase.simulate(scene, Sensor().with_effect(noise).with_effect(dead), seed=4, device=device)
    found = split_measurement(Measurement(events, scene), pixels=300, seed=1, device=device)
    start = model_of(Sensor().with_effect(noise).with_effect(replace(dead, noise="held")))
    assert refit_model(found, start, seed=0, rounds=1).sensor["refractory"].noise == "passes"
    # without noise it is no question
    modes = {(one.mode, one.noise) for one in dead.otherwise([EFFECTS["bandwidth"]()])}
    assert modes == {("reset", "passes"), ("drop", "passes")}


def test_a_fit_tells_offsets_of_comparators_from_shares_of_thresholds(device):
    scene, base = moving_bars(), Sensor().with_effect(EFFECTS["threshold"](on=0.15, off=0.45))
    true = EFFECTS["mismatch"](spread=0.2, relative_to="mean")
    events = dase.simulate(scene, base.with_effect(true), seed=4, device=device)
    found = split_measurement(Measurement(events, scene), pixels=300, seed=1, device=device)
    start = model_of(base.with_effect(replace(true, relative_to="own")))
    assert refit_model(found, start, seed=0, rounds=1).sensor["mismatch"].relative_to == "mean"
    # with thresholds alike it is no question
    assert not true.otherwise([EFFECTS["threshold"](on=0.2, off=0.21)])


def test_a_fit_leaves_a_low_pass_in_steps_where_it_is_none(device):
    scene = moving_bars()
    step = float(np.median(np.diff(scene.sample_times())))
    true = EFFECTS["bandwidth"](cutoff=0.12 / step, dark=0.1)
    for signal in ("small", "steps"):
        sensor = Sensor().with_effect(replace(true, signal=signal))
        events = dase.simulate(scene, sensor, seed=4, device=device)
        found = split_measurement(Measurement(events, scene), pixels=300, seed=1, device=device)
        start = model_of(Sensor().with_effect(replace(true, signal="steps")))
        fitted = refit_model(found, start, seed=0, rounds=1).sensor["bandwidth"]
        assert fitted.signal == signal
        assert fitted.cutoff == pytest.approx(true.cutoff, rel=0.15)


@pytest.mark.parametrize(
    ("clip_step", "signal", "poles", "phase"), [(0.0, "small", "alike", 1.0), (1e-3, "steps", "one", 0.0)]
)
def test_what_a_simulator_does_frame_by_frame_is_tried_where_events_show_one(clip_step, signal, poles, phase):
    seen = Observations(100.0, 0.0, 0.0, "down", 1e5, 0.1, 0.1, clip_step=clip_step)
    (slow,), noises = (EFFECTS[name].candidates(seen) for name in ("bandwidth", "voltage_noise"))
    assert slow.signal == signal
    assert {noise.poles for noise in noises} == {poles}
    # a descent that begins with a fast corner ends with white noise
    assert (min(noise.cutoff for noise in noises) < 50.0) == (clip_step > 0)
    for noise in noises:
        assert with_effect_added(model_of(Sensor()), noise).sensor["threshold"].phase == phase


@pytest.mark.parametrize(
    ("effect", "slow"),
    [
        (EFFECTS["bandwidth"](), False),
        (EFFECTS["bandwidth"](signal="steps"), False),
        (EFFECTS["voltage_noise"](poles="one"), False),
        (EFFECTS["voltage_noise"](cutoff=3000.0), True),
    ],
    ids=["low-pass", "low-pass in steps", "noise at each frame", "fast noise"],
)
def test_what_is_looked_at_once_a_step_is_not_slow(evidence, effect, slow):
    """Slow ones are tried from few places; what other simulators do at each frame was taken for them."""
    assert evidence.train.slow(model_of(Sensor().with_effect(effect)).space) == slow


def test_noise_is_drawn_at_each_frame_beside_what_goes_in_steps():
    """A low-pass of another simulator is seen beside its noise, not beside one that looks like both."""
    noise = EFFECTS["voltage_noise"](sigma=0.05, cutoff=60.0, knee=0.1)
    present = model_of(Sensor().with_effect(noise))
    added = with_effect_added(present, EFFECTS["bandwidth"](cutoff=50.0)).sensor
    assert added["voltage_noise"].poles == "alike"
    added = with_effect_added(present, EFFECTS["bandwidth"](cutoff=50.0, signal="steps")).sensor
    assert added["voltage_noise"].poles == "one"
    (back,) = added["voltage_noise"].otherwise([])
    assert (back.sigma, back.cutoff, back.poles) == (pytest.approx(0.05), pytest.approx(60.0), "alike")
    assert added["threshold"].phase == 0.0


def test_a_walk_from_frame_to_frame_is_tried_beside_clips_of_other_simulators():
    seen = Observations(100.0, 0.0, 0.0, "down", 1e5, 0.1, 0.1, clip_frames=4e-3)
    own, *walks = EFFECTS["voltage_noise"].candidates(seen)
    assert own == EFFECTS["voltage_noise"]()
    assert {(walk.poles, walk.period) for walk in walks} == {("none", 4e-3)}
    added = with_effect_added(model_of(Sensor()), walks[0])
    assert added.sensor["threshold"].phase == 0.0
    assert {"voltage_noise.sigma", "voltage_noise.floor", "voltage_noise.knee"} <= set(added.space.names)
    assert not {"voltage_noise.cutoff", "voltage_noise.period"} & set(added.space.names)
    for none in (0.0, 1e-4, 2.0):  # another scene, frames as close as samples, pictures of a slide show
        assert EFFECTS["voltage_noise"].candidates(replace(seen, clip_frames=none)) == [own]


def test_what_is_idle_by_another_rule_is_not_free_there():
    sensor = Sensor().with_effect(EFFECTS["voltage_noise"](sigma=0.05, cutoff=60.0, poles="one"))
    model = model_of(sensor)
    assert "voltage_noise.knee" not in model.space.names
    (other,) = (one for one in ways_otherwise(model) if one.sensor["voltage_noise"].poles == "alike")
    assert set(other.space.names) - set(model.space.names) == {"voltage_noise.knee"}
    noise, light = other.sensor["voltage_noise"], 0.2
    assert noise.sigma**2 * noise.knee / (light + noise.knee) == pytest.approx(0.05**2)
    assert noise.cutoff * light / (light + noise.knee) == pytest.approx(60.0)
    # of what is named no more is free than was
    few = model_of(sensor, ["voltage_noise.sigma"])
    assert all(len(one.place) == 1 for one in ways_otherwise(few))


def test_rules_of_what_is_not_free_are_left_alone():
    sensor = Sensor().with_effect(EFFECTS["refractory"](period=6e-3, mode="reset"))

    def rules(free):
        return {
            (one.sensor["threshold"].phase, one.sensor["refractory"].mode)
            for one in ways_otherwise(model_of(sensor, free))
        }

    assert rules(["threshold.on"]) == {(0.0, "reset")}
    assert rules(None) == {(0.0, "reset"), (1.0, "drop"), (1.0, "delay")}
    # nor of what is off
    off = Sensor().with_effect(EFFECTS["refractory"](period=0.0))
    assert len(ways_otherwise(model_of(off))) == 1


@pytest.fixture(scope="module")
def evidence(lit, device):
    scene = moving_bars()
    return split_measurement(
        Measurement(dase.simulate(scene, lit, seed=4, device=device), scene),
        pixels=200,
        seed=1,
        device=device,
    )


def test_a_last_step_that_leads_astray_is_taken_back(evidence, lit, monkeypatch):
    model = model_of(lit, ["threshold", "flicker.depth", "flicker.phase"])
    estimator = confidence_intervals._linear_estimator

    def wrong(half, model, way, *, seed):
        out = estimator(half, model, way, seed=seed)
        return replace(out, gain=-40.0 * out.gain)

    monkeypatch.setattr(confidence_intervals, "_linear_estimator", wrong)
    stays, values = estimate_parameters(evidence, model, seed=0)
    names = [axis.name for axis in stays.space.axes]
    stayed = [stays.place[names.index(axis.name)] for axis in model.space.axes]
    np.testing.assert_allclose(stayed, model.place, rtol=1e-12)
    assert values["flicker.phase"].value == pytest.approx(0.05, abs=1e-6)


def test_a_last_step_that_helps_is_taken(evidence, lit):
    off = lit.with_effect(replace(lit["threshold"], on=0.215, off=0.19))
    model = model_of(off, ["threshold"])
    moved, values = estimate_parameters(evidence, model, seed=0)
    assert values["threshold.on"].value == pytest.approx(lit["threshold"].on, rel=0.03)
    assert values["threshold.off"].value == pytest.approx(lit["threshold"].off, rel=0.03)
    assert not np.array_equal(moved.place, model.place)


class LinearHalf:
    """Pixels whose statistics run along straight lines with normal errors; two columns are nearly alike."""

    doubt = drift = None
    groups = 2

    def __init__(self, model, statistics, rng):
        self.rng, self.model = rng, model
        self.lines = rng.standard_normal((statistics, len(model.place)))
        self.lines[:, 1] = self.lines[:, 0] + 0.4 * self.lines[:, 1]
        true = model.place + rng.uniform(-0.05, 0.05, len(model.place))
        target = self.run(None, true[None], seed=0)[0]
        # with all of what chance does in each
        self.scale = ErrorScale(target, np.ones(len(target)), np.ones(len(target), np.bool_))
        self.repeats = self.run(None, np.repeat(model.place[None], 60, 0), seed=0)
        self.left_out = np.zeros((2, len(target)))
        self.true = true

    def run(self, space, places, *, seed):
        return (places - self.model.place) @ self.lines.T + self.rng.standard_normal(
            (len(places), len(self.lines))
        )

    run_repeats = run


def test_intervals_hold_where_slopes_are_noisy_and_parameters_make_up_for_each_other(lit):
    """Slopes of few simulations of many statistics fall short along that way; the interval knows it."""
    model = model_of(lit, ["threshold", "flicker.depth"])
    rng, inside, falls_short, width = np.random.default_rng(1), [], [], []
    for seed in range(100):
        half = LinearHalf(model, SIZE, rng)
        way = np.diag([0.3, 0.3, 0.3])
        found = confidence_intervals._linear_estimator(half, model, way, seed=seed)
        deviation = confidence_intervals._standard_deviations(half, found)
        estimate = model.place + found.gain @ (half.scale.target - half.repeats.mean(0))
        inside.append(np.abs(estimate - half.true) < 1.645 * deviation)
        weighed = half.lines.T * half.scale.weights()  # families alike, however many statistics they have
        exact = np.linalg.solve(weighed @ half.lines, weighed)
        width.append(deviation / np.sqrt((exact**2).sum(1)))
        raw = way @ confidence_intervals._steps_per_statistic(half, model, way, seed=seed)
        falls_short.append(np.linalg.eigvals(raw @ half.lines).real.min())
    assert np.median(falls_short) < 0.7  # else the test would show nothing
    assert np.all(np.mean(inside, axis=0) > 0.8)
    # and is not much wider than it must be
    assert np.all(np.median(width, axis=0) < 2)


def test_thresholds_of_light_that_never_changes_are_no_claim():
    """Noise alone fitted them to 0.24 and 0.78 (0.42 to 0.94) where both were 0.2."""
    light = np.linspace(0.05, 0.9, 32 * 24, dtype=np.float32).reshape(24, 32)
    scene = dase.VideoScene(np.broadcast_to(light, (600, 24, 32)), np.arange(600) * 2e-3)
    true = Sensor().with_effect(EFFECTS["shot"](rate=8.0))
    found = dase.fit(dase.simulate(scene, true, seed=1), true, scene=scene, pixels=200)
    assert {"shot.rate", "shot.balance"} <= set(found.parameters)
    assert not any(name.startswith("threshold") for name in found.parameters)
    assert found.sensor["threshold"] == true["threshold"]
    assert any("thresholds are not fitted" in note for note in found.notes)
    asked = dase.fit(dase.simulate(scene, true, seed=1), true, scene=scene, free=["threshold.on"], pixels=200)
    assert set(asked.parameters) == {"threshold.on"}
