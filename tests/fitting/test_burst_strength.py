"""How strongly frames couple, and when, told by the bursts of a recording."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.brief_diagnosis import NO_LIMITS

import dase
from dase.diagnosis.seen_effects import find_seen_effects
from dase.effects import EFFECTS
from dase.effects.exposure import Exposure
from dase.events import Events
from dase.fitting.burst_strength import fit_bursts, follows_frames, put_in_step
from dase.fitting.data_split import ModelPremises, split_measurement
from dase.fitting.measurement import Measurement
from dase.results import Grade
from dase.scenes import image_sources, random_scenes
from dase.signatures.burst_times import BurstTimes, find_burst_times
from dase.signatures.find import find_signatures

FRAMES = Exposure(amplitude=0.25, spread=0.3, period=0.1, exposure=0.031, begin=0.0223)
TIMES = BurstTimes(0.1, 0.0223, 0.031)
LIKE_BURSTS = ("mismatch", "refractory", "voltage_noise", "high_pass")


def bursts(rng, begins: np.ndarray, exposure: float, *, each: int = 60, noise: int = 20_000) -> Events:
    """Return bursts of a millisecond, ON at the begins and OFF an exposure later, among other events."""
    at = np.concatenate([np.repeat(begins, each), np.repeat(begins + exposure, each)])
    t = at + rng.uniform(-5e-4, 5e-4, len(at))
    p = np.arange(len(at)) < len(at) // 2
    t = np.concatenate([t, rng.uniform(begins[0], begins[-1], noise)])
    p = np.concatenate([p, rng.random(noise) < 0.5])
    order = np.argsort(t, kind="stable")
    x, y = (rng.integers(0, 32, len(t)) for _ in range(2))
    return Events(t[order], x, y, p[order], width=32, height=32)


def details(begins: np.ndarray, phases: dict[str, float]) -> dict:
    return {"begins": begins, "interval": float(np.median(np.diff(begins))), "phases": phases}


def test_times_of_bursts_are_known_better_than_the_steps_of_the_signature(rng):
    """Over a minute of frames 50.963 ms apart, 30 of them dropped, no edge is more than 0.1 ms off."""
    begins = 3.0 + 0.050963 * np.delete(np.arange(1200), rng.choice(np.arange(1, 1199), 30, replace=False))
    events = bursts(rng, begins, 0.0371)
    # the signature tells the phases to half a millisecond, and the interval is of whole microseconds
    found = find_burst_times(events, details(begins - 0.01, {"ON": 0.00975, "OFF": 0.04725}))
    assert found is not None
    off = (begins - found.begin + 0.02) % found.interval - 0.02
    assert np.abs(off).max() < 1e-4
    assert found.exposure == pytest.approx(0.0371, abs=1e-4)


def test_one_edge_needs_the_exposure_of_the_file(rng):
    begins = 1.0 + 0.05 * np.arange(40)
    events = bursts(rng, begins, 0.02, noise=100)
    dark = events.select(~events.p)
    seen = details(begins, {"OFF": 0.02})
    assert find_burst_times(dark, seen) is None
    found = find_burst_times(dark, seen, 0.02)
    assert found is not None
    assert (found.begin - 1.0) % 0.05 == pytest.approx(0.0, abs=2e-4)


@pytest.mark.parametrize("exposure", [0.0, 2e-5, 0.04998])
def test_bursts_of_both_polarities_at_one_time_are_an_exposure_of_half_a_millisecond(rng, exposure):
    """No more is known: half as long would be simulated at twice as many times."""
    begins = 1.0 + 0.05 * np.arange(40)
    phases = {"ON": 0.01, "OFF": (0.01 + exposure) % 0.05}
    found = find_burst_times(bursts(rng, begins, exposure), details(begins - 0.01, phases))
    assert found is not None
    assert min(found.exposure, found.interval - found.exposure) == pytest.approx(5e-4, abs=1e-4)
    off = (found.begin + 0.5 * found.exposure - 1.0 - 0.5 * exposure) % 0.05
    assert min(off, 0.05 - off) < 2e-4


def test_frames_without_a_period_have_no_even_times(rng):
    begins = np.cumsum(rng.uniform(0.03, 0.07, 60))
    assert find_burst_times(bursts(rng, begins, 0.01), details(begins, {"ON": 0.0, "OFF": 0.01})) is None


@pytest.fixture(scope="module")
def scene():
    rng = np.random.default_rng(3)
    images = image_sources.open_images("builtin")
    return random_scenes.draw_scene(rng, images, "medium", width=64, height=64, duration=2.0)


@pytest.mark.parametrize(("amplitude", "spread"), [(0.15, 0.5), (0.25, 0.3)])
def test_the_strength_is_that_of_the_sensor(scene, device, amplitude, spread):
    """With thresholds known: a step comes out 4 to 10 % low, its spread over pixels within a third."""
    true = replace(FRAMES, amplitude=amplitude, spread=spread)
    events = dase.simulate(scene, dase.Sensor().with_effect(true), seed=1, device=device)
    measured = Measurement(events, scene)
    found = fit_bursts(measured, dase.Sensor(), Exposure, TIMES, pixels=300, device=device)
    assert found is not None
    assert found.error_with < 0.5 * found.error_without
    got = found.effect
    assert isinstance(got, Exposure)
    assert got.amplitude == pytest.approx(amplitude, rel=0.15)
    assert got.spread == pytest.approx(spread, rel=0.34)


@pytest.mark.slow
@pytest.mark.parametrize("times", [0.7, 1.3])
def test_last_steps_find_the_strength_from_near_it(scene, device, times):
    """Beside other effects a strength is another one; it is not looked for from afar again."""
    events = dase.simulate(scene, dase.Sensor().with_effect(FRAMES), seed=1, device=device)
    begin = replace(FRAMES, amplitude=times * FRAMES.amplitude)
    found = fit_bursts(
        Measurement(events, scene), dase.Sensor(), Exposure, TIMES, begin, pixels=300, device=device
    )
    assert found is not None
    got = found.effect
    assert isinstance(got, Exposure)
    assert got.amplitude == pytest.approx(FRAMES.amplitude, rel=0.15)


def test_a_sensor_takes_the_times_of_the_measurement(scene, device):
    """Of a sensor file the strength counts: its clock is that of other frames."""
    wrong = dase.Sensor().with_effect(Exposure(amplitude=0.4, period=0.04, exposure=0.01, begin=0.003))
    events = dase.simulate(scene, dase.Sensor(), seed=1, device=device)
    assert follows_frames(wrong)
    assert not follows_frames(dase.Sensor())
    evidence = split_measurement(Measurement(events, scene), models=ModelPremises(frames=TIMES), pixels=100)
    moved = put_in_step(wrong, evidence)["exposure"]
    assert moved == replace(FRAMES, amplitude=0.4)
    without = split_measurement(Measurement(events, scene), pixels=100)
    assert put_in_step(wrong, without) == wrong


@pytest.mark.slow
def test_a_diagnosis_finds_and_measures_the_coupling(scene):
    """Without the effect in the model, what pixels remember of the bursts looked like other effects."""
    sensor = dase.Sensor().with_effect(EFFECTS["bandwidth"](cutoff=100.0))
    events = dase.simulate(scene, sensor.with_effect(FRAMES), seed=1)
    assert any(entry.name == "frame coupling" for entry in find_signatures(events).found)
    # those that come nearest to it in a diagnosis which is not told of the bursts
    library = {name: EFFECTS[name] for name in ("exposure", *LIKE_BURSTS)}
    found = dase.diagnose(
        events, sensor, scene=scene, effects=library, pixels=300, most=1, settings=NO_LIMITS
    )
    assert found.selected == ("exposure",)
    assert [one.grade for one in found.findings] == [Grade.CERTAIN]
    got = found.sensor["exposure"]
    assert isinstance(got, Exposure)
    assert got.amplitude == pytest.approx(0.25, rel=0.15)
    assert got.period == pytest.approx(0.1, abs=1e-4)
    assert "nan" not in found.findings[0].sentence()
    again = dase.fit(events, sensor.with_effect(Exposure()), scene=scene, pixels=300)
    interval = again.parameters["exposure.amplitude"]
    assert interval.low < 0.25 * 1.03
    assert interval.high > 0.25 * 0.97


def test_a_simulator_that_sends_at_the_frames_of_its_clip_alone_has_no_coupling():
    """All of its events are bursts in step with frames; without them nothing was left to compare."""
    y, x = np.mgrid[:48, :64]
    times = np.arange(75) / 25
    logs = np.array(
        [0.8 * np.sin(0.15 * x - 2 * t) + 0.6 * np.sin(0.12 * y + 1.5 * t) for t in times], np.float32
    )
    # events of a pixel so far: as many thresholds as its light has changed by, to the last that was crossed
    level = [np.zeros((48, 64))]
    for change in (logs[1:] - logs[0]) / 0.2:
        level.append(np.minimum(np.maximum(level[-1], np.floor(change)), np.ceil(change)))
    steps = np.diff(level, axis=0).astype(np.int64)
    frame, row, column = np.nonzero(steps)
    count, on = np.abs(steps[frame, row, column]), steps[frame, row, column] > 0
    events = dase.Events(*(np.repeat(v, count) for v in (times[frame + 1], column, row, on)), 64, 48)
    assert any(entry.name == "frame coupling" for entry in find_signatures(events).found)
    seen = find_seen_effects(Measurement(events, dase.VideoScene(0.4 * np.exp(logs), times)), EFFECTS)
    assert not seen.entries
    assert seen.bursts is None
    found = dase.fit(events, "ideal", scene=dase.VideoScene(0.4 * np.exp(logs), times), pixels=300)
    assert found.sensor["threshold"].on == pytest.approx(0.2, rel=0.05)
