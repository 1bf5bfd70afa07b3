"""How sure a diagnosis is: grades, a part that chooses nothing, and what the events show by themselves."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from helpers.brief_diagnosis import NO_LIMITS

import dase
from dase.diagnosis import grading, seen_effects
from dase.diagnosis.diagnose import diagnose
from dase.diagnosis.explain_effect import moving_bars
from dase.diagnosis.grading import (
    _rivals_to_try,
    grade_of,
    is_below_black,
    is_between_samples,
    is_strained,
    is_too_small,
)
from dase.diagnosis.seen_effects import (
    SeenEffects,
    find_seen_effects,
    shows_in,
    slowest_image,
    without_the_explained,
    without_the_scene,
)
from dase.diagnosis.settings import DEFAULTS, GradeSettings
from dase.diagnosis.state import SearchPath
from dase.effects import EFFECTS
from dase.fitting.data_split import split_measurement
from dase.fitting.measurement import Measurement
from dase.fitting.model import model_of
from dase.probes.distance import Judgement
from dase.results import Estimate, Finding, Grade
from dase.scenes.between_frames import CameraScene
from dase.scenes.grey_steps import grey_step_of
from dase.scenes.video import VideoScene
from dase.signatures.result import Answer, Signature
from dase.simulation.sensor import Sensor

LIBRARY = {name: EFFECTS[name] for name in ("threshold", "leak", "shot")}


@pytest.fixture(scope="module")
def scene() -> VideoScene:
    return moving_bars()


def judged(error: float, *, level: float = 0.25, reach: float = 0.4) -> Judgement:
    return Judgement(error, 1.15, reach, level, {}, {}, np.zeros(1), 1.0)


@pytest.mark.parametrize(
    ("start", "without", "last", "deviation", "rivals", "grade", "unknown"),
    [
        # at the floor
        (8.0, 8.0, 0.3, 6.0, False, Grade.SUPPORTED, False),
        (8.0, 8.0, 0.3, 6.0, True, Grade.EITHER, False),
        # before a slightly wrong world: 4 % are left, and far more without the effect
        (40.0, 30.0, 1.9, 6.0, False, Grade.SUPPORTED, False),
        # ... between 4.5 and 10 %: shot noise in the place of voltage noise
        (40.0, 30.0, 2.2, 6.0, False, Grade.EITHER, True),
        (40.0, 30.0, 3.2, 6.0, False, Grade.EITHER, True),
        (40.0, 30.0, 5.5, 6.0, False, Grade.EITHER, True),
        # ... one that helps a little may explain the wrong world
        (40.0, 3.0, 1.9, 6.0, False, Grade.STAND_IN, False),
        # a stand-in for something strong
        (40.0, 40.0, 8.0, 20.0, False, Grade.STAND_IN, False),
        # it does not hold where nothing was chosen
        (8.0, 1.1, 0.3, 1.0, False, Grade.STAND_IN, False),
        # ... but no single statistic may decide along a way, and nothing is left of 8
        (8.0, 8.0, 0.3, 1.0, False, Grade.EITHER, True),
        (8.0, 8.0, 0.3, 3.9, False, Grade.EITHER, True),
        (8.0, 8.0, 1.7, 1.0, False, Grade.STAND_IN, False),
        (8.0, 0.2, 0.3, 6.0, False, Grade.STAND_IN, False),
        # so little that something unknown may look like it
        (0.7, 0.7, 0.3, 6.0, False, Grade.EITHER, True),
        (0.94, 0.85, 0.3, 6.0, False, Grade.EITHER, True),
        (0.94, 0.94, 0.3, 6.0, False, Grade.SUPPORTED, False),
        # ... less is enough where not even what chance leaves in the mean is left with it
        (0.6, 0.6, 0.23, 6.0, False, Grade.SUPPORTED, False),
        (0.6, 0.6, 0.24, 6.0, False, Grade.EITHER, True),
        (0.6, 0.6, 0.23, 3.9, False, Grade.EITHER, True),
        (0.54, 0.54, 0.23, 6.0, False, Grade.EITHER, True),
        # at the floor, but neither within chance nor near to nothing of what there was
        (4.0, 4.0, 1.0, 6.0, False, Grade.EITHER, True),
    ],
)
def test_grades(start, without, last, deviation, rivals, grade, unknown):
    # repeats that are far apart, as among hot pixels, are no excuse for what is left
    last_one = judged(last, reach=1.5)
    found = grade_of(
        judged(start), judged(without), last_one, deviation, has_rivals=rivals, settings=GradeSettings()
    )
    assert found == (grade, unknown)


def test_what_leaves_little_is_in_doubt_where_something_is_seen_that_no_effect_of_the_library_makes():
    """A lamp was seen that the library had not: noise of the voltage left 4 %, and was supported."""
    for complete, last, grade in (
        (True, 1.9, Grade.SUPPORTED), (False, 1.9, Grade.EITHER), (False, 0.3, Grade.SUPPORTED),
    ):  # fmt: skip
        found = grade_of(
            judged(40.0), judged(30.0), judged(last, reach=1.5), 6.0, has_rivals=False, complete=complete,
            settings=GradeSettings(),
        )  # fmt: skip
        assert found[0] is grade
    lamp = Signature(name="flicker", answer=Answer.FOUND, details={"frequency": 100.0})
    rows = Signature(name="grouping", answer=Answer.FOUND)
    less = {name: one for name, one in EFFECTS.items() if name != "flicker"}
    assert not SeenEffects((lamp, rows)).of_no_effect
    assert SeenEffects((lamp, rows), library=less).of_no_effect
    assert not SeenEffects((rows,), library=less).of_no_effect
    own = type("Own", (EFFECTS["shot"],), {"name": "own", "signatures": None})
    assert not SeenEffects((lamp, rows), library={**less, "own": own}).of_no_effect


@pytest.mark.parametrize(
    ("low", "value", "high", "strained"),
    [
        (0.95, 1.0, 1.0, True),  # all ON: that is a leak
        (0.0, 0.0, 0.1, True),
        (0.7, 1.0, 1.0, False),  # might be as usual
        (0.85, 0.9, 0.95, False),  # unusual, and still shot noise
        (0.48, 0.5, 0.52, False),
    ],
)
def test_an_effect_at_the_end_of_what_it_can_be_is_strained(low, value, high, strained):
    model = model_of(Sensor().with_effect(EFFECTS["shot"]()))
    assert is_strained(model, "shot.balance", Estimate(value, low, high)) is strained


@pytest.mark.parametrize(
    ("effect", "value", "short"),
    [
        ("refractory.period", 5e-5, True),  # the half of a tenth of a step
        ("refractory.period", 5e-4, False),
        ("latency.delay", 1e-4, True),
        ("refractory.after_off", 0.05, False),  # no time
    ],
)
def test_a_time_far_shorter_than_a_step_of_light_may_be_a_memory_set_later(effect, value, short):
    model = model_of(Sensor().with_effect(EFFECTS[effect.split(".")[0]]()), free=(effect,))
    estimate = Estimate(value, 0.9 * value, 1.1 * value)
    told = is_between_samples(model, effect, estimate, shortest=GradeSettings().shortest_time * 1e-3)
    assert told is short


def test_what_reports_has_pixels_of_its_own_at_the_later_time(scene):
    events = dase.simulate(scene, Sensor(), seed=1)
    evidence = split_measurement(Measurement(events, scene), pixels=700)
    parts = [evidence.train, evidence.held, evidence.report]
    pixels = [set(part.trials.stimulus.pixels.tolist()) for part in parts]
    assert [len(some) for some in pixels] == [700] * 3
    assert len(set.union(*pixels)) == 2100
    assert evidence.report.frame.first == evidence.held.frame.first > 0


@pytest.fixture(scope="module")
def events(scene) -> dase.Events:
    return dase.simulate(scene, Sensor().with_effect(EFFECTS["leak"](rate=4.0)), seed=3)


@pytest.fixture(scope="module")
def found(scene, events) -> dase.Diagnosis:
    return diagnose(events, scene=scene, effects=LIBRARY, pixels=250, most=1)


def test_what_reports_chooses_nothing(scene, events, found):
    """The search goes the same way whatever the pixels saw that report; what is said of its end differs."""
    apart = split_measurement(Measurement(events, scene), pixels=250).report.trials.stimulus.pixels
    rng = np.random.default_rng(0)
    mine = np.isin(events.y.astype(np.int64) * scene.width + events.x, apart)
    # at the time that reports; what comes before tells how fast a lamp flickers, wherever it is seen
    others = events.select(~mine | (events.t < 0.5) | (rng.random(len(events)) < 0.7))
    other = diagnose(others, scene=scene, effects=LIBRARY, pixels=250, most=1, settings=NO_LIMITS)
    ways = [[(r.effect, r.error) for s in one.history for r in s.ranking] for one in (found, other)]
    assert ways[0]
    assert repr(ways[0]) == repr(ways[1])
    assert other.errors[-1] > found.errors[-1] + 1


def test_each_model_has_one_error(found):
    # pixels whose light rests show a leak
    assert [one.grade for one in found.findings] == [Grade.CERTAIN]
    assert "all of them ON" in found.findings[0].seen
    assert found.history[0].error == found.errors[0]
    assert found.findings[0].error_without == found.errors[0]
    assert found.findings[0].error_with == found.errors[1]
    assert found.finding() == "missing: leak (certain)"
    assert found.to_json()["findings"][0]["grade"] == "certain"


def test_nothing_is_fitted_between_frames_to_grade_effects_of_a_model_that_leaves_too_much(monkeypatch):
    """A guess at the light may be as wrong as a model, so what is left without an effect tells nothing."""
    monkeypatch.setattr(grading, "_models_without", lambda *args: pytest.fail("it was fitted"))

    bare = SimpleNamespace(judgement=judged(8.0))
    task = task_with_doubt(np.ones(1))
    # 0.2 of the first error is left above what chance makes
    told = grading.grade_effects(
        task, SearchPath(), None, ["leak", "shot"], {frozenset({"shot"}): bare},
        SimpleNamespace(judgement=judged(10.25)), judged(2.25), report=None, values={}, at_bounds=(),
    )  # fmt: skip
    assert [one.grade for one in told.values()] == [Grade.STAND_IN] * 2
    assert told["leak"].error_without == 8.0
    assert np.isnan(told["shot"].error_without)
    assert grading.leaves_little(judged(10.25), judged(1.74), DEFAULTS.grades)
    assert not grading.leaves_little(judged(10.25), judged(1.76), DEFAULTS.grades)


def test_what_explains_half_of_what_is_left_is_in_doubt_and_no_stand_in():
    """Above the usual 0.25 the last model leaves 3; 6 and more without an effect is twice that."""
    left = {"leak": 6.3, "shot": 6.2, "dark": 20.0, "hot": float("nan"), "jitter": 20.0}
    said = {n: Finding(n, Grade.STAND_IN, error_without=one, error_with=3.25) for n, one in left.items()}
    said["leak"] = replace(said["leak"], grade=Grade.SUPPORTED)
    bounds = ["jitter.spread = 1, the end of its search"]

    def offered(last: float, task: SimpleNamespace) -> dict[str, Grade]:
        found = grading.offer_what_halves(task, said, judged(last), bounds)
        assert all(one.unknown for name, one in found.items() if one.grade is Grade.EITHER)
        return {name: one.grade for name, one in found.items() if one.grade is not Grade.STAND_IN}

    exact = task_with_doubt(None)
    assert offered(3.25, exact) == {"leak": Grade.SUPPORTED, "dark": Grade.EITHER}
    assert offered(3.2, exact) == {"leak": Grade.SUPPORTED, "dark": Grade.EITHER, "shot": Grade.EITHER}
    # at the floor chance does that, and between a camera's frames a guess
    assert offered(0.3, exact) == offered(3.2, task_with_doubt(np.ones(1))) == {"leak": Grade.SUPPORTED}


def task_with_doubt(doubt: np.ndarray | None) -> SimpleNamespace:
    """What grading asks of a task: its settings, and whether the scene is in doubt."""
    return SimpleNamespace(settings=DEFAULTS, evidence=SimpleNamespace(report=SimpleNamespace(doubt=doubt)))


def late(kind: str) -> Signature:
    return Signature(name="late events", answer=Answer.FOUND, sentence=f"a {kind}", details={kind: 1.0})


@pytest.mark.parametrize(
    ("delay", "details", "grade"),
    [
        (3.0e-3, {"step": 3e-3}, Grade.EITHER),
        (9e-3, {"step": 3e-3}, Grade.SUPPORTED),
        (3e-3, {}, Grade.SUPPORTED),
    ],
)
def test_a_latency_no_longer_than_a_tick_may_wait_for_it(delay, details, grade):
    stamps = Signature(name="time stamps", answer=Answer.FOUND, sentence="ticks", details=details)
    found = Finding("latency", Grade.SUPPORTED, parameters={"latency.delay": Estimate(delay, delay, delay)})
    said = next(one for one in SeenEffects((stamps,)).findings([found], ()) if one.effect == "latency")
    assert said.grade is grade
    # light between events tells of the same
    late = Signature(name="late events", answer=Answer.FOUND, sentence="late", details={"delay": delay})
    seen = SeenEffects((stamps, late))
    said = next(one for one in seen.findings([found], ()) if one.effect == "latency")
    assert said.grade is (Grade.EITHER if grade is Grade.EITHER else Grade.CERTAIN)
    assert said.parameters == found.parameters


def test_a_latency_of_nothing_waits_for_no_clock():
    found = Finding("latency", Grade.SUPPORTED, parameters={"latency.delay": Estimate(0.0, 0.0, 0.0)})
    assert SeenEffects(()).findings([found], ()) == [found]


def test_a_pole_and_a_delay_may_be_two_poles_that_a_fit_has_beside():
    """A bandwidth and a latency were certain, and wrong, for poles of 9 and 20 Hz."""
    seen = SeenEffects((late("pole"), late("delay")))
    pole = Finding("bandwidth", Grade.SUPPORTED)
    two = Finding("second_order", Grade.EITHER, unknown=True)
    grades = {one.effect: (one.grade, one.alternatives) for one in seen.findings([pole, two], ())}
    assert grades["bandwidth"] == grades["latency"] == (Grade.EITHER, ("second_order",))
    for beside in ([pole], [pole, replace(two, grade=Grade.STAND_IN)]):
        grades = {one.effect: one.grade for one in seen.findings(beside, ())}
        assert grades["bandwidth"] is grades["latency"] is Grade.CERTAIN


def test_a_ceiling_of_the_rate_is_no_bus_that_is_much_faster():
    """A fan sent 2.2 million events per second for a quarter of the time."""
    entry = Signature(name="full bus", answer=Answer.FOUND, details={"rate": 2.2e6})
    seen = SeenEffects((entry,))
    for mode, rate, is_bus in (
        ("delay", 5e7, False),
        ("delay", 3e6, True),
        ("drop", 5e7, False),
        ("drop", 3e6, True),
    ):
        bus = Sensor().with_effect(EFFECTS["readout"](rate=rate, mode=mode))
        assert seen.without_ceiling_of_light(bus).full_bus is is_bus
    lines = Sensor().with_effect(EFFECTS["readout"](rate=5e7, line=2e-7, mode="rows"))
    assert seen.without_ceiling_of_light(lines).full_bus
    assert seen.without_ceiling_of_light(Sensor()).full_bus


def test_an_effect_is_not_needed_where_the_last_model_does_as_well_once_it_is_taken_out(monkeypatch):
    """The model of the search without it had half of the hot pixels, by chance: an error of 1.7."""

    def model_with(*effects):
        return model_of(Sensor(effects=(*Sensor().effects, *effects)))

    fast = EFFECTS["bandwidth"](cutoff=2e4)
    few, many = (EFFECTS["hot"](share=share) for share in (0.005, 0.01))

    def error_of(sensor):
        return 4.0 if "hot" not in sensor else 1.7 if sensor["hot"].share < 0.0075 else 0.5

    def judged_by_share(task, models, *, repeats):
        return [grading.ModelOnReport(m, judged(error_of(m.sensor))) for m in models]

    monkeypatch.setattr(grading, "judge_on_report", judged_by_share)
    ways = ((), (few,), (fast,))
    models = [model_with(*some) for some in ways]
    way = {
        frozenset(e.name for e in some): one
        for some, one in zip(ways, judged_by_share(None, models, repeats=1), strict=True)
    }
    task = SimpleNamespace(settings=DEFAULTS, evidence=None, seed=0)
    without = grading._models_without(task, model_with(many, fast), ["hot", "bandwidth"], way)
    assert without["bandwidth"].judgement.error == 0.5
    assert without["hot"].judgement.error == 4.0


def test_what_the_last_model_shows_as_well_is_explained(scene):
    """Noise of the voltage sends opposite pairs, and does not tell by them which noise it is."""
    noisy = Sensor().with_effect(EFFECTS["voltage_noise"](sigma=0.065, cutoff=300.0))
    pairs = Signature(name="opposite pairs", answer=Answer.FOUND)
    measurement = Measurement(dase.simulate(scene, noisy, seed=3), scene)
    seen = SeenEffects((pairs, lamp({"frequency": 100.0})))
    bare = Sensor()
    assert without_the_explained(seen, measurement, noisy, 5, before=bare).entries == seen.entries[1:]
    late = bare.with_effect(EFFECTS["latency"](delay=1e-3))
    assert without_the_explained(seen, measurement, late, 5, before=bare).entries == seen.entries


def test_what_a_search_did_not_add_explains_nothing(scene, monkeypatch):
    """The model before the search was asked already, and a lamp is the same for all pixels."""
    pairs = Signature(name="opposite pairs", answer=Answer.FOUND)
    measurement = Measurement(dase.simulate(scene, Sensor(), seed=3), scene)
    seen = SeenEffects((pairs,))
    monkeypatch.setattr(seen_effects, "simulate", lambda *args, **more: pytest.fail("it was simulated"))
    lit = Sensor().with_effect(EFFECTS["flicker"](frequency=100.0, depth=0.3))
    for after in (Sensor(), lit):
        assert without_the_explained(seen, measurement, after, 5, before=Sensor()) == seen


def lamp(details: dict[str, float]) -> Signature:
    return Signature(name="flicker", answer=Answer.FOUND, sentence="light at 100 Hz", details=details)


def test_a_lamp_has_the_slowest_frequency_that_looks_alike_to_frames():
    """At frames of 500 Hz 400 and 600 Hz are what 100 Hz is."""
    for seen, step, meant in (
        (400, 2e-3, 100),
        (600, 2e-3, 100),
        (100, 2e-3, 100),
        (400, 0.0, 400),
        (120, 0.01, 120),
    ):
        details = {"frequency": float(seen), "frequency_low": seen - 0.1, "frequency_high": seen + 0.1}
        entry = replace(lamp(details), sentence=f"light at {seen:.2f} Hz, swing 0.1 of the rate")
        found = slowest_image(entry, step)
        low, high = found.details["frequency_low"], found.details["frequency_high"]
        assert (found.details["frequency"], low, high) == pytest.approx((meant, meant - 0.1, meant + 0.1))
        assert found.sentence == f"light at {meant:.2f} Hz, swing 0.1 of the rate"


def test_what_the_events_show_is_certain_whatever_the_search_says():
    seen = SeenEffects((lamp({"frequency": 100.0}), replace(lamp({}), name="frame coupling")))
    weak = Finding("flicker", Grade.STAND_IN, error_without=3.0, error_with=2.0, deviation=1.0)
    leak = Finding("leak", Grade.SUPPORTED)
    found = {one.effect: one for one in seen.findings([weak, leak], ())}
    assert found["flicker"].grade is Grade.CERTAIN
    assert found["flicker"].error_with == 2.0
    assert found["flicker"].seen == "light at 100 Hz"
    assert found["leak"] == leak
    assert found["exposure"].grade is Grade.CERTAIN
    # what the sensor has is not missing
    assert [one.effect for one in seen.findings([], ("flicker",))] == ["exposure"]


@pytest.fixture(scope="module")
def lit_by_a_lamp(scene) -> tuple[Measurement, SeenEffects]:
    """Events of a sensor beneath a lamp of 100 Hz, and what is seen of them."""
    lit = Sensor().with_effect(EFFECTS["flicker"](frequency=100.0, depth=0.3))
    measurement = Measurement(dase.simulate(scene, lit, seed=1), scene)
    return measurement, find_seen_effects(measurement, EFFECTS)


@pytest.mark.slow
def test_light_that_flickers_in_the_clip_is_not_of_the_camera(scene, lit_by_a_lamp):
    """The events show it, but the sensor without any effect would show it as well."""
    times = scene.sample_times()
    swing = 1 + 0.5 * np.sin(2 * np.pi * 100 * times)
    waving = VideoScene((scene.frames(times) * swing[:, None, None]).astype(np.float32), times)
    of_scene = Measurement(dase.simulate(waving, Sensor(), seed=1), waving)
    for measurement, seen, left in (
        (of_scene, find_seen_effects(of_scene, EFFECTS), False),
        (*lit_by_a_lamp, True),
    ):
        assert seen.lamp == pytest.approx(100.0, abs=0.3)
        kept = without_the_scene(seen, measurement, Sensor(), 5)
        assert ("flicker" in kept.effects) == left


@pytest.mark.slow
def test_a_lamp_is_asked_of_a_model_with_the_least_thresholds(lit_by_a_lamp):
    """It is asked with lower thresholds, too; a sensor cannot have a quarter of the least that there are."""
    measurement, seen = lit_by_a_lamp
    least = Sensor().with_effect(EFFECTS["threshold"](on=0.02, off=0.01))
    kept = without_the_scene(seen, measurement, least, 5)
    assert "flicker" in kept.effects


@pytest.fixture(scope="module")
def unlike() -> tuple[Sensor, Measurement, SeenEffects]:
    """Pixels that are unlike before a scene of which few frames are known, and what is seen of them."""
    rng = np.random.default_rng(1)
    texture = cv2.GaussianBlur(rng.random((64, 808)), (0, 0), 1.2)
    texture = np.clip((texture - texture.min()) / np.ptp(texture), 0.03, 1)
    times = np.arange(0, 0.401, 0.001)
    frames = np.stack(
        [
            cv2.warpAffine(texture, np.array([[1.0, 0, 600 * (t - 0.5) - 330], [0, 1.0, 0]]), (96, 64))
            for t in times
        ]
    ).astype(np.float32)
    sensor = Sensor().with_effect(EFFECTS["mismatch"](spread=0.25))
    events = dase.simulate(VideoScene(frames, times), sensor, seed=2)
    known = CameraScene(np.rint(255 * frames[::10]).astype(np.uint8), times[::10])
    measurement = Measurement(events, known)
    return sensor, measurement, find_seen_effects(measurement, EFFECTS)


@pytest.mark.slow
@pytest.mark.parametrize("given", [False, True])
def test_a_pattern_that_the_model_makes_is_explained_over_a_guessed_scene(unlike, given):
    """How ON and OFF events balance is the pixels', however badly light is known between frames."""
    sensor, measurement, seen = unlike
    assert "fixed pattern" in [one.name for one in seen.entries]
    model = sensor if given else Sensor().with_effect(EFFECTS["leak"](rate=0.1))
    kept = without_the_explained(seen, measurement, model, 5, before=Sensor())
    assert ("fixed pattern" in [one.name for one in kept.entries]) == (not given)


def test_a_hint_of_a_far_smaller_size_explains_nothing():
    """A model whose thresholds are too low sends events that hint at much."""
    small = replace(lamp({"frequency": 100.0}), p=0.01, size=0.024, least=0.02, answer=Answer.CANNOT_SAY)
    for size, frequency, left in ((0.81, 100.0, 1), (0.05, 100.0, 0), (0.05, 120.0, 1)):
        seen = SeenEffects((replace(lamp({"frequency": frequency}), size=size),))
        entries = tuple(one for one in seen.entries if not shows_in([small], one))
        assert len(entries) == left


@pytest.mark.parametrize(("name", "spread", "period", "in_doubt"), [
    ("jitter", 0.05, 5e-3, True), ("jitter", 0.2, 5e-3, False), ("jitter", 0.05, 0.0, False),
    ("jitter", 0.05, None, False), ("mismatch", 0.03, 1e-4, True), ("mismatch", 0.08, 1e-4, False),
    ("mismatch", 0.03, None, False), ("mismatch", 0.019, None, True), ("jitter", 0.009, None, True),
])  # fmt: skip
def test_little_that_differs_beside_a_dead_time_is_in_doubt(name, spread, period, in_doubt):
    sensor = Sensor().with_effect(EFFECTS[name](spread=spread))
    if period is not None:
        sensor = sensor.with_effect(EFFECTS["refractory"](period=period))
    model = model_of(sensor)
    got = is_too_small(model, f"{name}.spread", Estimate(spread, 0.9 * spread, 1.1 * spread))
    assert got == in_doubt
    assert not is_too_small(model, "threshold.on", Estimate(0.1, 0.1, 0.1))


@pytest.mark.parametrize(("sigma", "in_doubt"), [(4e-3, True), (0.024, False)])
def test_noise_of_the_voltage_of_which_any_chance_is_as_good_is_in_doubt(sigma, in_doubt):
    """Beside a limit of the rate, where little decides what is sent: one of 0.004 was supported."""
    model = model_of(Sensor().with_effect(EFFECTS["voltage_noise"](sigma=sigma)))
    value = Estimate(sigma, 0.9 * sigma, 1.1 * sigma)
    assert is_too_small(model, "voltage_noise.sigma", value) is in_doubt


@pytest.mark.parametrize("beside", ["bandwidth", "second_order"])
@pytest.mark.parametrize("name", ["jitter", "mismatch"])
def test_little_that_differs_beside_a_low_pass_is_in_doubt(name, beside):
    """Other simulators filter step by step: thresholds that differ by 3 to 5 % make up for that."""
    both = Sensor().with_effect(EFFECTS[name](spread=0.04)).with_effect(EFFECTS[beside](cutoff=100.0))
    for sensor, in_doubt in ((both, True), (both.without(beside), False)):
        for spread, small in ((0.04, True), (0.08, False)):
            value = Estimate(spread, 0.9 * spread, 1.1 * spread)
            got = is_too_small(model_of(sensor), f"{name}.spread", value)
            assert got == (in_doubt and small)


def test_a_dark_current_below_what_the_logarithm_adds_is_in_doubt():
    """IEBCS adds one of 10,000 grey values before its logarithm: a dark current of 0.00018 was supported."""
    model = model_of(Sensor().with_effect(EFFECTS["dark"](current=2e-4)))
    little, more = Estimate(2e-4, 1.8e-4, 2.2e-4), Estimate(9e-4, 8e-4, 1.1e-3)
    assert is_below_black(model, "dark.current", little)
    assert not is_below_black(model, "dark.current", more)
    assert not is_below_black(model, "dark.spread", little)
    assert not is_below_black(model, "threshold.on", little)
    assert is_below_black(model, "dark.current", more, grey=2e-3)


def test_a_clip_of_few_greys_says_so():
    light = np.linspace(0, 1, 5 * 40).reshape(5, 8, 5).astype(np.float32)
    times = np.arange(5) * 1e-3
    assert grey_step_of(VideoScene(np.rint(255 * light).astype(np.float32) / 255, times)) == pytest.approx(
        1 / 255, rel=1e-3
    )
    many = np.random.default_rng(0).random((5, 16, 24)).astype(np.float32)
    assert grey_step_of(VideoScene(many, times)) == 0
    assert grey_step_of(VideoScene(np.full((5, 4, 4), 0.5, np.float32), times)) == 0


def test_what_includes_an_effect_is_its_rival_where_something_unknown_may_look_like_it():
    """Two poles of another simulator were told as one pole or something that is not in the library."""

    def tried(name: str, error: float):
        return SimpleNamespace(name=name, error=error, judgement=judged(error), model=None)

    candidates = [tried("second_order", 3.0), tried("latency", 3.2), tried("linlog", 9.0)]
    task = SimpleNamespace(settings=DEFAULTS, effects=EFFECTS)
    path = SearchPath(alternatives={"bandwidth": candidates}, error_of={"bandwidth": 3.1})
    model = model_of(Sensor().with_effect(EFFECTS["bandwidth"]()))
    for doubtful, names in ((False, ["latency"]), (True, ["second_order", "latency"])):
        assert [
            one.name for one in _rivals_to_try(task, path, model, "bandwidth", doubtful=doubtful)
        ] == names


@pytest.mark.parametrize(("left", "names"), [(0.40, ["second_order"]), (0.55, [])])
def test_what_includes_an_effect_and_left_clearly_less_is_its_rival(left, names):
    """Two poles of ESIM left 0.41, the low-pass that was announced for them 0.64."""
    other = SimpleNamespace(name="second_order", error=left, judgement=judged(left), model=None)
    task = SimpleNamespace(settings=DEFAULTS, effects=EFFECTS)
    path = SearchPath(alternatives={"bandwidth": [other]}, error_of={"bandwidth": 0.64})
    model = model_of(Sensor().with_effect(EFFECTS["bandwidth"]()))
    found = _rivals_to_try(task, path, model, "bandwidth", doubtful=False)
    assert [one.name for one in found] == names
