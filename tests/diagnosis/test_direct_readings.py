"""What each event of a held clip tells is certain, however little of the error it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.brief_diagnosis import NO_LIMITS
from helpers.frame_simulator import HEIGHT, WIDTH, shaken_texture
from helpers.held_pixels import held_with_low_pass

import dase
from dase.diagnosis.direct_readings import READINGS, _effects_of, _with_certain, with_jitter_of_events
from dase.effects import EFFECTS
from dase.fitting.delays_after_frames import DelaysAfterFrames
from dase.results import Diagnosis, Finding, Grade
from dase.scenes.video import VideoScene

TRIED = {
    name: EFFECTS[name]
    for name in ("bandwidth", "latency", "jitter", "timestamp", "mismatch", "voltage_noise")
}


@pytest.fixture(scope="module")
def scene() -> VideoScene:
    return shaken_texture(gap=2e-3)


def diagnosed(events: dase.Events, scene: VideoScene) -> Diagnosis:
    return dase.diagnose(events, scene=scene, effects=TRIED, most=1, pixels=200, settings=NO_LIMITS)


@pytest.mark.parametrize("late", [0.0, 4e-5, 1e-3])
def test_stamps_are_read_off_late_events_where_none_can_be_early(late, rng):
    """IEBCS draws latencies about a mean and takes 0 for any below: stamps off by 245 us were not told."""
    way, group = rng.uniform(0.0, 1e-6, 8000), np.arange(8000) % 8
    drawn = np.maximum(rng.normal(late, 0.25e-3, 8000), 0.0)
    delays = DelaysAfterFrames(way, drawn, np.zeros(8000), 5e-3, group, np.zeros(8000))
    said = {effect.name: mine for effect, _, mine in _effects_of(delays, READINGS)}
    assert said["timestamp"]["timestamp.jitter"].value == pytest.approx(0.25e-3, rel=0.1)
    assert ("latency" in said) is (late > READINGS.latency)


@pytest.mark.slow
def test_latency_stamps_and_jitter_are_certain(scene):
    events = held_with_low_pass(scene, cutoff=4e4, late=0.4e-3, stamps=0.06e-3, spread=0.15)
    found = diagnosed(events, scene)
    assert {one.effect: one.grade for one in found.findings} == {
        "jitter": Grade.CERTAIN, "latency": Grade.CERTAIN, "timestamp": Grade.CERTAIN,
    }  # fmt: skip
    truth = {"latency.delay": 0.4e-3, "timestamp.jitter": 0.06e-3, "jitter.spread": 0.15}
    for name, value in truth.items():
        assert found.parameters[name].value == pytest.approx(value, rel=0.1)
    assert len(found.errors) == len(found.selected) + 1


@pytest.mark.parametrize(
    ("spread", "noisy", "said"),
    [
        (0.15, False, (Grade.CERTAIN, ())),
        (0.15, True, (Grade.EITHER, ("voltage_noise",))),
        (0.03, True, None),
    ],
)
def test_a_jitter_beside_noise_that_returns_may_be_that(spread, noisy, said):
    model = dase.Sensor().with_effect(EFFECTS["jitter"](spread=spread))
    bare = Diagnosis(model, (), (1.0,), 1.0, 1.0, 1.15, {}, None, ())
    found = with_jitter_of_events(bare, model, noisy=noisy)
    grades = {one.effect: (one.grade, one.alternatives) for one in found.findings}
    assert grades == ({"jitter": said} if said else {})


@pytest.mark.parametrize("name", ["bandwidth", "second_order"])
def test_a_jitter_behind_a_low_pass_that_was_found_may_be_something_else(name):
    model = dase.Sensor().with_effect(EFFECTS["jitter"](spread=0.3))
    bare = Diagnosis(model, (), (1.0,), 1.0, 1.0, 1.15, {}, None, ())
    bare = replace(bare, findings=(Finding(name, Grade.SUPPORTED),))
    one = next(one for one in with_jitter_of_events(bare, model).findings if one.effect == "jitter")
    assert (one.grade, one.alternatives, one.unknown) == (Grade.EITHER, (), True)


def test_a_reading_that_a_fit_of_a_wrong_model_contradicts_is_in_doubt():
    """A low-pass of 589 Hz was read off a clip that was no held one, whose fit had one of 410 Hz."""
    model = dase.Sensor().with_effect(EFFECTS["bandwidth"](cutoff=410.0))
    fitted = Finding("bandwidth", Grade.STAND_IN, error_with=1.3)
    bare = Diagnosis(model, (), (1.3,), 5.8, 1.0, 1.15, {}, None, (), stand_ins=(fitted,))
    read = _with_certain(bare, EFFECTS["bandwidth"](cutoff=589.0), "later the farther", {})
    assert [(one.effect, one.grade, one.unknown) for one in read.findings] == [
        ("bandwidth", Grade.EITHER, True)
    ]
    assert (read.stand_ins, read.selected, read.sensor) == ((), (), model)
    sure = _with_certain(replace(bare, stand_ins=()), EFFECTS["bandwidth"](cutoff=589.0), "so", {})
    assert [one.grade for one in sure.findings] == [Grade.CERTAIN]


@pytest.mark.slow
def test_a_habit_of_the_simulator_is_in_the_model_and_no_finding(scene):
    """Thresholds that differ by 3 % were taken for a noise of the voltage."""
    events = held_with_low_pass(scene, cutoff=4e4, late=0.1e-3, stamps=0.01e-3, spread=0.03)
    found = diagnosed(events, scene)
    assert found.findings == ()
    assert found.errors[-1] < 0.5
    assert any("from event to event" in note for note in found.notes)
    assert found.parameters["threshold.on"].value == pytest.approx(0.2, rel=0.01)


@pytest.mark.slow
def test_pixels_of_a_slow_scene_have_the_frame_for_their_memory():
    """No pixel asks for more than an event in several frames: that is no dead time of several frames."""
    scene = shaken_texture(gap=0.5e-3, length=0.4)
    slow = VideoScene(scene.frames(scene.sample_times()), 4 * scene.sample_times())
    found = diagnosed(held_with_low_pass(slow, spread=0.02), slow)
    assert found.findings == ()
    assert found.errors[-1] < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("loss", [0.5, 0.0])
def test_pixels_that_are_slower_in_the_corners_tell_of_vignetting(scene, loss):
    """A low-pass so fast that it is no finding by itself; the clip is the one before the lens."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    square = (x - (WIDTH - 1) / 2) ** 2 + (y - (HEIGHT - 1) / 2) ** 2
    light = np.cos(np.arctan(np.sqrt(((1 - loss) ** -0.5 - 1) * square / square.max()))) ** 4
    times = scene.sample_times()
    darker = VideoScene((scene.frames(times) * light).astype(np.float32), times)
    events = held_with_low_pass(darker, cutoff=2e4, late=0.1e-3, stamps=0.01e-3, spread=0.02)
    found = dase.diagnose(
        events, scene=scene, effects={**TRIED, "vignetting": EFFECTS["vignetting"]}, most=1, pixels=200,
        settings=NO_LIMITS,
    )  # fmt: skip
    grades = {one.effect: one.grade for one in found.findings}
    if loss == 0.0:
        assert "vignetting" not in grades
    else:
        assert grades["vignetting"] is Grade.CERTAIN
        estimate = found.parameters["vignetting.loss"]
        assert estimate.value == pytest.approx(loss, abs=0.12)
        assert estimate.low < loss < estimate.high


@pytest.mark.slow
def test_a_latency_of_more_than_a_frame_is_told_by_what_pixels_remember(scene):
    """After which frame an event is late its delay alone does not tell."""
    gap = float(np.diff(scene.sample_times())[0])
    events = held_with_low_pass(scene, late=2.3 * gap, stamps=0.1 * gap)
    found = diagnosed(events, scene)
    assert {one.effect: one.grade for one in found.findings} == {
        "latency": Grade.CERTAIN, "timestamp": Grade.CERTAIN,
    }  # fmt: skip
    assert found.parameters["latency.delay"].value == pytest.approx(2.3 * gap, rel=0.02)
    assert found.parameters["timestamp.jitter"].value == pytest.approx(0.1 * gap, rel=0.2)
    assert found.errors[-1] < 0.5


@pytest.mark.parametrize(
    ("late", "apart", "names"),
    [(1e-3, 5e-6, []), (0.7e-3, 5e-6, ["latency"]), (1e-3, 8e-5, ["latency", "timestamp"])],
)
def test_single_events_in_the_middle_of_their_frames_are_not_late(late, apart, names):
    rng, count = np.random.default_rng(0), 8000
    delays = DelaysAfterFrames(
        way=rng.uniform(0.02, 1.0, count), late=late + apart * rng.standard_normal(count),
        level=np.zeros(count), gap=2e-3, group=np.arange(count) % 8, square=rng.uniform(0, 1, count),
    )  # fmt: skip
    assert [effect.name for effect, _, _ in _effects_of(delays, READINGS)] == names


@pytest.mark.parametrize("parts", [1, 3, 5])
def test_light_that_goes_on_in_parts_of_a_frame_shows_no_low_pass(parts):
    """What has further to go is sent in a later part, as a slow pixel would."""
    rng, count = np.random.default_rng(0), 8000
    part = rng.uniform(0.02, 0.95, count)
    way = -np.log(1 - part)
    late = np.floor(part * parts) / parts * 2e-3 + 2e-4 if parts > 1 else 2e-4 * (1 + way)
    delays = DelaysAfterFrames(
        way=way, late=late + 5e-6 * rng.standard_normal(count), level=np.zeros(count), gap=2e-3,
        group=np.arange(count) % 8, square=rng.uniform(0, 1, count),
    )  # fmt: skip
    assert delays.slope_in_errors() > READINGS.errors
    assert delays.come_in_parts() == (parts > 1)
    names = [effect.name for effect, _, _ in _effects_of(delays, READINGS)]
    assert ("bandwidth" in names) == (parts == 1)
