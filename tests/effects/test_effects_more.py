"""The further effects do their physics, off changes nothing, and together they do what each says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.event_comparison import by_pixel, rows, same
from helpers.scripts import load_script
from helpers.sensors import FURTHER, STRONG, counts, every
from helpers.small_scenes import flicker, static, still
from reference import effects as reference_effects
from reference import pixel as reference

import dase
from dase.effects.bandwidth import Bandwidth
from dase.effects.dark import Dark
from dase.effects.dead import Dead
from dase.effects.exposure import Exposure
from dase.effects.flicker import Flicker
from dase.effects.high_pass import HighPass
from dase.effects.jitter import Jitter
from dase.effects.leak import Leak
from dase.effects.learned_threshold import LearnedThreshold
from dase.effects.linlog import Linlog
from dase.effects.mismatch import Mismatch
from dase.effects.refractory import Refractory
from dase.effects.second_order import SecondOrder
from dase.effects.shot import Shot
from dase.effects.threshold import Threshold
from dase.effects.vignetting import Vignetting
from dase.effects.voltage_noise import VoltageNoise
from dase.kernels import launch
from dase.simulation.pixel_array import PixelArray
from dase.simulation.sensor_file import load_sensor, parse_sensor, read_presets
from dase.simulation.sensor_run import sample_times


@pytest.mark.parametrize("effect", FURTHER, ids=lambda effect: effect.name)
def test_an_effect_switched_off_changes_nothing(device, rng, effect):
    scene, plain = flicker(rng), dase.Sensor((Threshold(),))
    off = plain.with_effect(effect.identity())
    want = dase.simulate(scene, plain, device=device)
    same(dase.simulate(scene, off, device=device), want)
    got = counts(scene, off, 9.0, device)
    np.testing.assert_array_equal(got, counts(scene, plain, 9.0, device))
    on = dase.simulate(scene, plain.with_effect(STRONG[effect.name]), device=device)
    assert len(on) != len(want) or not np.array_equal(on.t, want.t)


@pytest.mark.parametrize("mode", ["reset", "drop", "delay"])
def test_all_effects_switched_off_change_nothing(device, rng, mode):
    scene = flicker(rng)
    ideal = dase.simulate(scene, dase.Sensor((Threshold(),)), device=device)
    same(dase.simulate(scene, every(Threshold(), mode=mode), device=device), ideal)
    # among effects that are on, the others are off all the same
    busy = (Shot(rate=60.0), Leak(rate=8.0), Mismatch(), Refractory(period=3e-3, mode=mode), Bandwidth())
    few = dase.simulate(scene, reference.only(Threshold(), *busy, mode=mode), device=device)
    same(dase.simulate(scene, every(Threshold(), *busy, mode=mode), device=device), few)


@pytest.mark.parametrize("mode", ["reset", "drop", "delay"])
def test_all_effects_in_chunks_and_counts(device, rng, mode):
    scene = flicker(rng)
    busy = (*STRONG.values(), Shot(rate=60.0), Leak(rate=8.0, light=3.0), Mismatch(), Bandwidth())
    sensor = every(*busy, Refractory(period=3e-3, mode=mode), mode=mode)
    times = sample_times(scene, sensor)
    whole = dase.Events.concatenate(dase.stream(scene, sensor, seed=3, device=device, chunk=10**6))
    for chunk in (1, 5, 64):
        same(dase.Events.concatenate(dase.stream(scene, sensor, seed=3, device=device, chunk=chunk)), whole)
    fine = dase.VideoScene(_between(scene, times, device), times)
    part = dase.simulate(fine, sensor, seed=3, device=device, pixels=[5, 17, 60])
    assert {tuple(row) for row in rows(part)} <= {tuple(row) for row in rows(whole)}
    got = counts(scene, sensor, 9.0, device, seed=3)
    place = whole.y.astype(int) * whole.width + whole.x
    for p in (0, 1):
        np.testing.assert_array_equal(got[p], np.bincount(place[whole.p == p], minlength=80))


def _between(scene: dase.VideoScene, times: np.ndarray, device: str) -> np.ndarray:
    everywhere = np.arange(scene.width * scene.height, dtype=np.int32)
    source = scene.source(times, everywhere, launch.find_device(device))[1]
    return source.values.numpy().reshape(len(times), scene.height, scene.width)


TWINS = {
    "light": (Flicker(frequency=37.0, depth=0.6), Vignetting(loss=0.7), Dark(current=0.03, spread=0.8)),
    "linlog": (Linlog(knee=0.2, slope=1.7), Bandwidth(cutoff=200.0)),
    "underdamped": (SecondOrder(cutoff=50.0, damping=0.2),),
    "critical": (SecondOrder(cutoff=50.0, damping=1.0),),
    "overdamped": (SecondOrder(cutoff=200.0, damping=6.0),),
    "damping by light": (
        Bandwidth(cutoff=300.0),
        SecondOrder(cutoff=120.0, damping=0.3, dark=0.01, fixed=0.8, spread=0.2, poles="apart"),
        VoltageNoise(sigma=0.2, cutoff=30.0, poles="apart"),
    ),
    "noise": (VoltageNoise(sigma=0.2, cutoff=30.0),),
    "noise of two poles": (VoltageNoise(sigma=0.2, cutoff=30.0, poles="apart"),),
    "steps": (Bandwidth(cutoff=60.0, dark=0.02, spread=0.2, signal="steps"),),
    "steps of two poles": (SecondOrder(cutoff=60.0, dark=0.02, spread=0.2, poles="steps"),),
    "noise of one pole": (Bandwidth(cutoff=60.0), VoltageNoise(sigma=0.2, cutoff=30.0, poles="one")),
    "noise of a loop": (VoltageNoise(sigma=0.2, cutoff=20.0, gain=15.0, poles="apart"),),
    "uneven": (Bandwidth(cutoff=60.0, spread=0.4), SecondOrder(cutoff=90.0, spread=0.3)),
    "follower": (Bandwidth(cutoff=200.0, dark=0.02, signal="large"),),
    "noisy follower": (
        Bandwidth(cutoff=30.0, spread=0.3, signal="large"),
        VoltageNoise(sigma=0.2, cutoff=30.0),
    ),
    "two dark currents": (
        Dark(current=0.02, spread=0.5, speed="own"),
        Bandwidth(cutoff=200.0, dark=0.1),
        VoltageNoise(sigma=0.2, cutoff=30.0, dark=0.02),
    ),
    "all": (*(STRONG[n] for n in ("flicker", "vignetting", "dark", "linlog", "second_order")), Mismatch()),
}


def match_twin(scene: dase.Scene, sensor: dase.Sensor, device: str) -> list[np.ndarray]:
    """Assert that events of nearly all pixels are those of the twin, and return those of the twin."""
    times = scene.sample_times()
    array = PixelArray(sensor, scene.width, scene.height, seed=11, device=device)
    got = by_pixel(array.emit(scene, times)[0])
    want = reference_effects.events(sensor, times, scene.frames(times), 11)
    equal = [np.array_equal(g[:, 1], w[:, 2]) for g, w in zip(got, want, strict=True)]
    assert np.mean(equal) >= 0.9
    for g, w, alike in zip(got, want, equal, strict=True):
        if alike:
            np.testing.assert_array_less(np.abs(g[:, 0] - w[:, 1]) * w[:, 3], 5e-5 + 3e-9 * w[:, 3])
    return want


@pytest.mark.parametrize("name", TWINS)
def test_photoreceptors_match_their_twins(device, rng, name):
    scene = flicker(rng, size=(5, 6), step=0.5)
    want = match_twin(scene, every(Threshold(on=0.17, off=0.23), *TWINS[name]), device)
    assert np.mean([len(w) for w in want]) > 5


def learned(strength: float) -> LearnedThreshold:
    """Return thresholds that grow from column to column, as a network might tell."""
    maps = np.stack([np.tile(np.linspace(0.6, 1.8, 6), (5, 1)), np.full((5, 6), 0.3)])
    return LearnedThreshold(strength=strength, weights="stands for a file", bound=maps.astype(np.float32))


STRENGTHS = (
    Flicker(frequency=23.0, depth=0.2, phase=0.3), Flicker(frequency=60.0, depth=0.9, region=2, apart=0.2),
    Vignetting(loss=0.3), Vignetting(loss=0.95),
    Linlog(knee=0.1, slope=1.2), Linlog(knee=0.5, slope=2.0),
    HighPass(cutoff=2.0), HighPass(cutoff=40.0),
    Exposure(amplitude=0.3, spread=0.5, period=0.031, exposure=0.011, begin=0.004),
    Exposure(amplitude=-1.2, spread=0.2, period=0.05, exposure=0.03, begin=-0.013),
    Jitter(spread=0.1), Jitter(spread=0.5),
    learned(0.4), learned(1.0),
)  # fmt: skip
BUSY = (Bandwidth(cutoff=90.0, spread=0.2), VoltageNoise(sigma=0.2, cutoff=30.0), Mismatch(spread=0.1))


@pytest.mark.parametrize("others", [(), BUSY], ids=["alone", "with bandwidth and noise"])
@pytest.mark.parametrize("effect", STRENGTHS, ids=repr)
def test_each_strength_matches_its_twin(device, rng, effect, others):
    scene = flicker(rng, size=(5, 6), step=0.5)
    want = match_twin(scene, every(Threshold(on=0.17, off=0.23), *others, effect), device)
    off = every(Threshold(on=0.17, off=0.23), *others)
    plain = reference_effects.events(off, scene.sample_times(), scene.frames(scene.sample_times()), 11)
    # had the effect none of its strength, the twin would send other events
    alike = [len(w) == len(p) and np.allclose(w[:, :3], p[:, :3]) for w, p in zip(want, plain, strict=True)]
    assert np.mean(alike) < 0.3


def test_a_lamp_makes_events_of_both_polarities_in_turns(device):
    frequency, depth, theta, periods = 100.0, 0.4, 0.1, 20
    scene = still(np.repeat([0.05, 0.9], 800), periods / frequency, 64 * periods + 1)
    sensor = every(Threshold(on=theta, off=theta), Flicker(frequency=frequency, depth=depth))
    edges = np.array([2, periods]) / frequency
    got = dase.count(scene, sensor, edges, device=device)[0, 0].reshape(2, 2, 800).mean(-1)
    # from darkest to brightest and back, in every period, less a threshold at each turn
    for light, off, on in zip((0.05, 0.9), *got, strict=True):
        swing = np.log((light * (1 + depth) + 1e-3) / (light * (1 - depth) + 1e-3))
        assert on == pytest.approx((periods - 2) * (swing / theta - 1), abs=3 * (periods - 2) * 0.5 / 28)
        assert on == off


def test_a_lamp_keeps_its_phase_for_hours(device):
    lamp = every(Threshold(phase=0.0), Flicker(frequency=120.0, depth=0.5, phase=0.1))
    at = [
        dase.simulate(still([0.5], 0.1, 513, start), lamp, device=device).t - start
        for start in (0.0, 36000.0)
    ]
    assert len(at[0]) > 50
    # float32 time resolves 4 ms after ten hours; whole nanoseconds, and doubles of 36000 s
    np.testing.assert_allclose(at[0], at[1], atol=3e-8)


def test_scenes_are_sampled_often_enough(device):
    lamp = dase.Sensor((Threshold(phase=0.0), Flicker(frequency=100.0, depth=0.5)))
    for scene in (still([0.2], 1.0, 2), still([0.2], 1.0, 31)):
        times = sample_times(scene, lamp)
        assert np.diff(times).max() <= 1 / 1600 + 1e-9
        assert set(scene.sample_times()) <= set(times)
        assert counts(scene, lamp, 1.0, device).sum() == pytest.approx(100 * 2 * 5, rel=0.05)
    assert len(sample_times(scene, dase.Sensor((Threshold(), Flicker.identity())))) == 31
    noisy = dase.Sensor((Threshold(), VoltageNoise(cutoff=50.0)))
    assert np.diff(sample_times(scene, noisy)).max() <= 1 / 400 + 1e-9


def test_between_frames_the_log_intensity_runs_straight(device):
    frames = np.array([0.0, 0.2, 0.9, 0.9], np.float32)[:, None, None]
    scene = dase.VideoScene(frames, [0.0, 1.0, 3.0, 4.0])
    times = np.array([0.0, 0.25, 1.0, 2.0, 2.5, 4.0])
    got = np.log(_between(scene, times, device)[:, 0, 0] + 1e-3)
    want = np.interp(times, [0, 1, 3, 4], np.log(frames[:, 0, 0] + 1e-3))
    np.testing.assert_allclose(got, want, rtol=1e-5)
    for outside in (-0.1, 4.1):
        with pytest.raises(dase.InputError, match="outside"):
            scene.source(np.array([outside]), np.array([0], np.int32), launch.find_device("cpu"))


@pytest.mark.parametrize("loss", [0.3, 0.8])
def test_corners_lose_light(device, loss):
    # leak events whose rate is that of the light
    scene = static(np.full((31, 41), 0.5), 1.0, 3)
    sensor = every(Leak(rate=1.0, spread=0.0, light=1e4), Vignetting(loss=loss))
    light = counts(scene, sensor, 1.0, device)[1].reshape(31, 41) / 5000
    assert light[15, 20] == pytest.approx(1, rel=1e-3)
    # cos⁴ of an angle whose tangent grows with the distance; the pixel lies half a pixel inside the corner
    corner = np.tan(np.arccos((1 - loss) ** 0.25)) * np.hypot(40, 30) / np.hypot(41, 31)
    assert light[0, 0] == pytest.approx(np.cos(np.arctan(corner)) ** 4, rel=2e-3)
    assert light[0, 0] == pytest.approx(1 - loss, rel=0.1)
    np.testing.assert_allclose(light, light[::-1, ::-1], atol=1e-3)
    np.testing.assert_allclose(light[15, 40], light[15, 0], atol=1e-3)
    assert light[0, 0] < light[15, 0] < light[0, 20] < light[15, 20]


@pytest.mark.parametrize("current", [0.01, 0.1])
def test_dark_current_takes_contrast_from_the_dark(device, current):
    theta, pairs = 0.02, ((0.0, 0.1), (0.05, 0.1), (0.5, 1.0))
    frames = np.array(pairs, np.float32).T[:, None, :]
    scene = dase.VideoScene(frames, [0.0, 1.0])
    sensor = every(Threshold(on=theta, off=theta, phase=0.0), Dark(current=current))
    on = counts(scene, sensor, 1.0, device)[1]
    want = [np.log((b + current + 1e-3) / (a + current + 1e-3)) / theta for a, b in pairs]
    np.testing.assert_array_equal(on, np.floor(want))


def test_dark_current_is_log_normal_over_pixels(device):
    scene = dase.VideoScene(np.array([0.0, 1.0], np.float32)[:, None, None] * np.ones((1, 900)), [0.0, 1.0])
    sensor = every(Threshold(on=0.02, off=0.02, phase=0.0), Dark(current=0.05, spread=0.6), log_eps=1e-6)
    # from the dark current alone to white and the dark current
    dark = -np.log(np.expm1(0.02 * counts(scene, sensor, 1.0, device)[1]))
    assert dark.mean() == pytest.approx(np.log(0.05), abs=3 * 0.6 / 30 + 0.02)
    assert dark.std() == pytest.approx(0.6, abs=3 * 0.6 / np.sqrt(1800))


def test_linlog_is_linear_below_and_logarithmic_above_the_knee(device):
    knee, theta = 0.2, 0.05
    level = np.linspace(0, 1, 2001)
    scene = dase.VideoScene(level.astype(np.float32)[:, None, None], level)
    quiet = Threshold(on=theta, off=theta, phase=0.0)
    sensor = every(quiet, Linlog(knee=knee), log_eps=1e-6)
    light = dase.simulate(scene, sensor, device=device).t  # the intensity at the events
    low = light[light < knee]
    np.testing.assert_allclose(np.diff(low), theta * knee, rtol=1e-3)
    assert len(low) in (19, 20)
    np.testing.assert_allclose(np.diff(np.log(light[light > knee])), theta, rtol=1e-3)
    # smooth: the spacing on both sides of the knee is the same
    near = np.searchsorted(light, knee)
    assert light[near + 1] - light[near] == pytest.approx(light[near - 1] - light[near - 2], rel=0.1)


@pytest.mark.parametrize("pair", [(0, 5), (3, 18), (10, 40), (0, 255), (30, 200)])
def test_linlog_of_v2e(device, pair):
    # Hu, Liu, Delbruck 2021: ln(x) above 20 of 255, below it x ln(20) / 20
    low, high = (x * np.log(20) / 20 if x <= 20 else np.log(x) for x in pair)
    frames = np.array(pair, np.float32)[:, None, None] / 255
    sensor = every(
        Threshold(on=0.01, off=0.01, phase=0.0), Linlog(knee=20 / 255, slope=np.log(20)), log_eps=1e-6
    )
    got = counts(dase.VideoScene(frames, [0.0, 1.0]), sensor, 1.0, device)[1].sum()
    assert got == pytest.approx((high - low) / 0.01, abs=1.05)


def test_an_effect_is_added_where_it_acts():
    sensor = dase.Sensor((Threshold(), Bandwidth(), Leak()))
    order = [e.name for e in sensor.with_effect(Linlog()).with_effect(Dead()).with_effect(Jitter()).effects]
    assert order == ["linlog", "threshold", "bandwidth", "jitter", "leak", "dead"]


@pytest.mark.parametrize("name", read_presets())
def test_every_preset_simulates(device, rng, name):
    sensor = load_sensor(name)
    assert sensor.name == name
    frames = np.exp(np.cumsum(rng.normal(0, 0.1, (11, 8, 9)), 0) - 1.5)
    scene = dase.VideoScene(np.minimum(frames, 1.0), np.linspace(0, 0.05, 11))
    events = dase.simulate(scene, sensor, device=device)
    assert len(events) > 20
    assert 0.2 < events.p.mean() < 0.8


def test_the_page_of_effects_is_that_of_the_code():
    page = (Path(__file__).parents[2] / "docs" / "effects.md").read_text("utf-8")
    assert page == load_script("docs/effects.py").page(), "run python docs/effects.py"


@pytest.mark.parametrize(("level", "pixels"), [("0.1lux", 600), ("161lux", 900), ("3klux", 900)])
def test_noise_is_like_that_of_a_camera(shared, level, pixels):
    noise = load_script("perf/experiments/noise/run.py")
    sensor = parse_sensor(noise.SENSOR, "sensor")
    want = noise.measured(shared / "recordings" / "noise_iebcs.npz")[level]
    got = noise.simulated(sensor, level, pixels=pixels)
    measured, simulated = noise.summary(want), noise.summary(got)
    assert simulated["ON share"] == pytest.approx(measured["ON share"], abs=0.06)
    for polarity in ("ON", "OFF"):
        share = f"pixels with {polarity} intervals"
        assert simulated[share] == pytest.approx(measured[share], abs=0.2)
        rate = f"{polarity} rate, 90 % of pixels below [Hz]"
        assert simulated[rate] == pytest.approx(measured[rate], rel=0.5)
    if level == "0.1lux":  # without what makes noise in the dark, there is next to none
        quiet = noise.simulated(sensor.without("voltage_noise"), level, pixels=pixels)
        assert quiet.sum() < 0.05 * got.sum()


@pytest.mark.parametrize("effect", [e for e in dase.EFFECTS.values() if e.includes], ids=lambda e: e.name)
def test_what_an_effect_includes_is_what_it_gives_as_simpler(effect):
    assert tuple(simple.name for simple in effect().simpler()) == effect.includes


def test_a_strongly_damped_second_order_is_the_low_pass_that_it_gives(device):
    """The events of both come at the same times but for the faster pole's delay."""
    slow = SecondOrder(cutoff=120.0, damping=6.0, dark=1.0)
    (simple,) = slow.simpler()
    assert simple == Bandwidth(cutoff=10.0, dark=1.0)
    times = np.linspace(0, 0.3, 1201)
    light = np.where(times > 0.02, 0.9, 0.1).astype(np.float32)
    scene = dase.VideoScene(np.repeat(light[:, None, None], 4, axis=2), times)
    plain = dase.Sensor((Threshold(on=0.1, off=0.1, phase=0.0),))
    first, second = (dase.simulate(scene, plain.with_effect(one), device=device).t for one in (slow, simple))
    assert len(first) == len(second) > 20
    # 1 / (2π 2 damping cutoff) s for the other pole
    assert np.max(np.abs(first - second)) < 4 * 1 / (2 * np.pi * 2 * 6.0 * 120.0)
