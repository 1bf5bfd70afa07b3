"""The further effects do their physics, off changes nothing, and together they do what each says."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import reference
import reference_effects
import warp as wp
from scipy.linalg import expm
from scipy.stats import norm
from test_effects import KS, distance, ramp, static, tracks
from test_pixel import by_pixel, flicker, rows, same

import dase
from dase.config import load_sensor, parse_sensor, presets
from dase.effects import second_order, voltage_noise
from dase.effects.bandwidth import Bandwidth
from dase.effects.dark import Dark
from dase.effects.dead import Dead
from dase.effects.flicker import Flicker
from dase.effects.hot import Hot
from dase.effects.jitter import Jitter
from dase.effects.leak import Leak
from dase.effects.linlog import Linlog
from dase.effects.mismatch import Mismatch
from dase.effects.refractory import Refractory
from dase.effects.second_order import SecondOrder
from dase.effects.shot import Shot
from dase.effects.threshold import Threshold
from dase.effects.vignetting import Vignetting
from dase.effects.voltage_noise import VoltageNoise
from dase.kernels import launch
from dase.pixels import Pixels
from dase.sensor import sample_times

FURTHER = (Flicker, Vignetting, Dark, Linlog, SecondOrder, VoltageNoise, Jitter, Hot, Dead)
STRONG = {
    "flicker": Flicker(frequency=40.0, depth=0.5),
    "vignetting": Vignetting(loss=0.6),
    "dark": Dark(current=0.02, spread=0.5),
    "linlog": Linlog(knee=0.08, slope=1.5),
    "second_order": SecondOrder(cutoff=60.0, damping=0.4, dark=0.3),
    "voltage_noise": VoltageNoise(sigma=0.3, cutoff=300.0),
    "jitter": Jitter(spread=0.3),
    "hot": Hot(share=0.2, rate=300.0),
    "dead": Dead(share=0.3),
}


def every(*effects: dase.Effect, mode: str = "drop", log_eps: float = 1e-3) -> dase.Sensor:
    """Return a sensor that has every effect, those not given switched off: one kernel serves many tests."""
    off = [effect.identity() for effect in dase.EFFECTS.values() if effect is not Refractory]
    known = {effect.name: effect for effect in (*off, Refractory(period=0.0, mode=mode), *effects)}
    return dase.Sensor(tuple(known[name] for name in dase.EFFECTS), log_eps=log_eps)


def still(light: np.ndarray, seconds: float, samples: int, start: float = 0.0) -> dase.VideoScene:
    """Return pixels of constant light, one row, sampled evenly."""
    frames = np.broadcast_to(np.asarray(light, np.float32), (samples, 1, np.size(light)))
    return dase.VideoScene(frames, start + np.linspace(0, seconds, samples))


def counts(scene: dase.Scene, sensor: dase.Sensor, seconds: float, device: str, **options) -> np.ndarray:
    """Return events of every pixel in (0, seconds], shape (2, N): OFF, ON."""
    return dase.count(scene, sensor, [0, seconds], device=device, **options)[0, 0]


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


@pytest.mark.parametrize("mode", ["drop", "delay"])
def test_all_effects_switched_off_change_nothing(device, rng, mode):
    scene = flicker(rng)
    ideal = dase.simulate(scene, dase.Sensor((Threshold(),)), device=device)
    same(dase.simulate(scene, every(Threshold(), mode=mode), device=device), ideal)
    # among effects that are on, the others are off all the same
    busy = (Shot(rate=60.0), Leak(rate=8.0), Mismatch(), Refractory(period=3e-3, mode=mode), Bandwidth())
    few = dase.simulate(scene, reference.only(Threshold(), *busy, mode=mode), device=device)
    same(dase.simulate(scene, every(Threshold(), *busy, mode=mode), device=device), few)


@pytest.mark.parametrize("mode", ["drop", "delay"])
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
    source = scene.source(times, everywhere, launch.device(device))[1]
    return source.values.numpy().reshape(len(times), scene.height, scene.width)


TWINS = {
    "light": (Flicker(frequency=37.0, depth=0.6), Vignetting(loss=0.7), Dark(current=0.03, spread=0.8)),
    "linlog": (Linlog(knee=0.2, slope=1.7), Bandwidth(cutoff=200.0)),
    "underdamped": (SecondOrder(cutoff=50.0, damping=0.2),),
    "critical": (SecondOrder(cutoff=50.0, damping=1.0),),
    "overdamped": (SecondOrder(cutoff=200.0, damping=6.0),),
    "noise": (VoltageNoise(sigma=0.2, cutoff=30.0),),
    "all": (*(STRONG[n] for n in ("flicker", "vignetting", "dark", "linlog", "second_order")), Mismatch()),
}


@pytest.mark.parametrize("name", TWINS)
def test_photoreceptors_match_their_twins(device, rng, name):
    scene = flicker(rng, size=(5, 6), step=0.5)
    times = scene.sample_times()
    sensor = every(Threshold(on=0.17, off=0.23), *TWINS[name])
    array = Pixels(sensor, 6, 5, seed=11, device=device)
    got = by_pixel(array.emit(scene, times)[0])
    want = reference_effects.events(sensor, times, scene.frames(times), 11)
    equal = [np.array_equal(g[:, 1], w[:, 2]) for g, w in zip(got, want, strict=True)]
    assert np.mean(equal) >= 0.9
    assert np.mean([len(w) for w in want]) > 5
    for g, w, alike in zip(got, want, equal, strict=True):
        if alike:
            np.testing.assert_array_less(np.abs(g[:, 0] - w[:, 1]) * w[:, 3], 5e-5 + 3e-9 * w[:, 3])


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
    assert np.diff(sample_times(scene, noisy)).max() <= 1 / 800 + 1e-9


def test_between_frames_the_log_intensity_runs_straight(device):
    frames = np.array([0.0, 0.2, 0.9, 0.9], np.float32)[:, None, None]
    scene = dase.VideoScene(frames, [0.0, 1.0, 3.0, 4.0])
    times = np.array([0.0, 0.25, 1.0, 2.0, 2.5, 4.0])
    got = np.log(_between(scene, times, device)[:, 0, 0] + 1e-3)
    want = np.interp(times, [0, 1, 3, 4], np.log(frames[:, 0, 0] + 1e-3))
    np.testing.assert_allclose(got, want, rtol=1e-5)
    for outside in (-0.1, 4.1):
        with pytest.raises(dase.InputError, match="outside"):
            scene.source(np.array([outside]), np.array([0], np.int32), launch.device("cpu"))


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
    scene = dase.VideoScene(np.array([0.0, 1e4], np.float32)[:, None, None] * np.ones((1, 900)), [0.0, 1.0])
    sensor = every(Threshold(on=0.02, off=0.02, phase=0.0), Dark(current=0.05, spread=0.6), log_eps=1e-6)
    dark = np.log(1e4) - 0.02 * counts(scene, sensor, 1.0, device)[1]
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


@pytest.mark.parametrize("damping", [0.2, 0.5, 1.0, 3.0])
def test_a_step_overshoots_by_the_damping(device, damping):
    step, theta, cutoff = 1.0, 0.01, 20.0
    times = np.concatenate([[-1e-7], np.linspace(0, 1.0, 4001)])
    frames = np.exp(np.r_[-1.5 - step, np.full(4001, -1.5)])[:, None, None] - 1e-3
    quiet = Threshold(on=theta, off=theta, phase=0.0)
    sensor = every(quiet, SecondOrder(cutoff=cutoff, damping=damping, dark=1.0))
    events = dase.simulate(dase.VideoScene(frames, times), sensor, device=device)
    first_off = np.append(np.flatnonzero(~events.p), len(events))[0]
    peak = first_off * theta
    if damping < 1:
        ring = np.sqrt(1 - damping**2)
        assert peak == pytest.approx(step * (1 + np.exp(-np.pi * damping / ring)), abs=1.5 * theta)
        # the highest voltage comes half a ringing period after the step
        assert events.t[first_off - 1] < 0.5 / (cutoff * ring) < events.t[first_off]
    else:
        assert len(events) == first_off
        assert peak == pytest.approx(step, abs=1.5 * theta)


@pytest.mark.parametrize(("damping", "light"), [(0.2, 0.9), (1.0, 0.9), (2.0, 0.9), (0.7, 0.1)])
def test_a_sine_at_the_natural_frequency_gains_by_the_quality(device, damping, light):
    dark, swings, cutoff = 0.25, 40, 50.0
    frequency = cutoff * (dark + (1 - dark) * light)
    times = np.linspace(0, swings / frequency, 100 * swings + 1)
    # a swing so small that the light is the same throughout
    frames = ((light + 1e-3) * np.exp(0.1 * np.sin(2 * np.pi * frequency * times)) - 1e-3)[:, None, None]
    sensor = every(
        Threshold(on=0.01, off=0.01, phase=0.0), SecondOrder(cutoff=cutoff, damping=damping, dark=dark)
    )
    edges = np.array([swings / 2, swings]) / frequency
    got = dase.count(dase.VideoScene(frames, times), sensor, edges, device=device).sum()
    # 4 amplitudes per period, of which hysteresis takes a threshold at each turn
    amplitude = (got / (swings / 2) / 2 + 0.5) * 0.01 / 2
    assert amplitude == pytest.approx(0.1 / (2 * damping), abs=0.006)


@pytest.mark.parametrize("damping", [0.1, 1.0, 15.0])
def test_the_second_order_does_not_depend_on_sampling(device, damping):
    quiet = Threshold(on=0.01, off=0.01, phase=0.0)
    sensor = every(quiet, SecondOrder(cutoff=1.5, damping=damping, dark=1.0))
    totals = [counts(ramp(5.0, 0.3, 1, n), sensor, 0.3, device)[1].sum() for n in (2, 9, 1025)]
    want = reference_effects.second_order(
        np.array([0.0, 0.3]), np.array([[0.0], [5.0]]), np.full((2, 1), 3 * np.pi), damping
    )[1, 0]
    np.testing.assert_allclose(totals, want / 0.01, atol=1.5)
    assert want > 0.1


@wp.kernel(enable_backward=False)
def answers(x: wp.array[float], damping: wp.array[float], out: wp.array2d[float]):
    i = wp.tid()
    h, dh = second_order.impulse(x[i], damping[i])
    behind, speed = second_order.lag(x[i], damping[i], h, dh + 2.0 * damping[i] * h)
    out[i, 0] = h
    out[i, 1] = dh
    out[i, 2] = behind
    out[i, 3] = speed


def test_closed_forms_keep_their_digits(device):
    x, damping = np.meshgrid(np.geomspace(1e-4, 50, 60), [0.05, 0.4, 0.999, 1.0, 1.0001, 1.05, 3.0, 20.0])
    x, damping = x.ravel().astype(np.float32), damping.ravel().astype(np.float32)
    out = wp.empty((len(x), 4), dtype=float, device=device)
    inputs = [wp.array(a, dtype=float, device=device) for a in (x, damping)]
    wp.launch(answers, len(x), inputs=[*inputs, out], device=device)
    for got, at, zeta in zip(out.numpy().astype(float), x.astype(float), damping.astype(float), strict=True):
        # displacement, its speed, the time integral of the displacement
        flow = expm(at * np.array([[0, 1, 0], [-1, -2 * zeta, 0], [1, 0, 0]]))
        want = [flow[0, 1], flow[1, 1], flow[2, 0] / at, (1 - flow[0, 0]) / at]
        # float32 rounds shares of a step of 1 after a division by x
        slack = 3e-6 + 3e-7 * (2 * zeta / at if 2 * zeta * at > 0.09 else 1)
        np.testing.assert_allclose(got, want, atol=slack)


@pytest.mark.parametrize("damping", [0.05, 1.0, 20.0])
def test_a_second_order_pixel_starts_settled(device, damping):
    sensor = every(Threshold(on=0.01, off=0.01), SecondOrder(cutoff=0.01, damping=damping, dark=1e-4))
    assert counts(still([0.0, 0.1, 1.0], 5.0, 50), sensor, 5.0, device).sum() == 0


@pytest.mark.parametrize("dark", [0.1, 1.0])
def test_a_strongly_damped_second_order_is_a_bandwidth(device, dark):
    assert SecondOrder.includes == ("bandwidth",)
    quiet = Threshold(on=0.01, off=0.01, phase=0.0)
    larger = SecondOrder(cutoff=2 * 20.0 * 1.5, damping=20.0, dark=dark)
    scene = ramp(5.0, 0.3, 3, 65)
    got, want = (
        counts(scene, every(quiet, effect), 0.3, device)[1]
        for effect in (larger, Bandwidth(cutoff=1.5, dark=dark))
    )
    np.testing.assert_allclose(got, want, atol=1.5)
    assert want.min() > 10
    assert counts(scene, every(quiet), 0.3, device)[1].min() > 1.4 * want.max()


def noise_rates(
    device: str, light: list[float], effect: VoltageNoise, *others: dase.Effect, samples: int = 2
) -> np.ndarray:
    """Return OFF and ON rates [Hz] of static pixels, 400 of each light, shape (2, lights)."""
    scene = still(np.repeat(light, 400), 2.0, samples)
    sensor = every(effect, *others)
    return counts(scene, sensor, 2.0, device).reshape(2, len(light), 400).mean(-1) / 2.0


@wp.kernel(enable_backward=False)
def points(turn: wp.array[float], out: wp.array2d[float]):
    i = wp.tid()
    cosine, sine = voltage_noise.circle(turn[i])
    out[i, 0] = cosine
    out[i, 1] = sine


def test_points_of_the_circle(device):
    near = np.arange(9) / 8
    turn = np.r_[np.linspace(0, 1, 4097), near[:-1] + 1e-7, near[1:] - 1e-7].astype(np.float32)
    out = wp.empty((len(turn), 2), dtype=float, device=device)
    wp.launch(points, len(turn), inputs=[wp.array(turn, dtype=float, device=device), out], device=device)
    angle = 2 * np.pi * turn.astype(float)
    np.testing.assert_allclose(out.numpy(), np.stack([np.cos(angle), np.sin(angle)], -1), atol=4e-7)


def test_voltage_noise_is_normal(device):
    # thresholds so small that the events tell where the voltage is; it begins settled, and half a second is
    # 24 time constants, so its change is that of two independent values of variance 2
    pixels, fine = 4000, 0.01
    effect = VoltageNoise(sigma=2.0, cutoff=10.0, knee=1.0, dark=1e-6)
    sensor = every(Threshold(on=fine, off=fine, phase=0.0), effect)
    off, on = counts(still(np.ones(pixels), 0.5, 2), sensor, 0.5, device).astype(float)
    moved = np.sort(fine * (on - off)) / 2
    assert distance(moved, norm.cdf(moved)) < KS
    assert moved.std() == pytest.approx(1, rel=4 / np.sqrt(2 * pixels))


def test_voltage_noise_has_the_speed_of_its_spectrum(device):
    # far below the amplitude a threshold is passed |dn/dt| / θ times a second, and E|dn/dt| = σ λ √(2/π)
    sigma, cutoff, knee, light = 2.0, 40.0, 0.5, 0.5
    effect = VoltageNoise(sigma=sigma, cutoff=cutoff, knee=knee, dark=1e-6)
    fine = Threshold(on=0.01, off=0.01)
    off, on = noise_rates(device, [light], effect, fine, samples=8001)[:, 0]
    pole = 2 * np.pi * cutoff / 2 / np.sqrt(np.sqrt(2) - 1)
    want = sigma * np.sqrt(0.5) * pole * np.sqrt(2 / np.pi) / 0.01
    assert on + off == pytest.approx(want, rel=0.05)
    assert on == pytest.approx(off, rel=0.01)


def test_voltage_noise_events_rise_as_light_falls(device):
    # and with the photoreceptor's own low-pass, which shares the light
    noisy = VoltageNoise(sigma=0.2, cutoff=100.0, knee=0.03, dark=1e-3)
    light = [0.6, 0.3, 0.15, 0.06]
    for others in ((), (Bandwidth(cutoff=100.0),)):
        total = noise_rates(device, light, noisy, *others).sum(0)
        assert np.all(np.diff(total) > 0.5)
        assert total[-1] > 20 * total[0]
    # where the photocurrent limits the bandwidth, less light means slower noise of the same amplitude
    dim = noise_rates(device, [0.01, 0.003, 0.001, 0.0], noisy).sum(0)
    assert np.all(np.diff(dim) < -0.5)


def test_voltage_noise_is_stationary_and_returns(device):
    effect = VoltageNoise(sigma=0.12, cutoff=50.0, knee=0.1)
    sensor = every(effect)
    scene = still(np.full(3000, 0.05), 1.2, 2)
    windows = dase.count(scene, sensor, np.arange(7) * 0.2, device=device)[0].sum((1, 2)).astype(float)
    assert abs(windows[0] / windows[1:].mean() - 1) < 4 / np.sqrt(windows[0])
    events = by_pixel(dase.simulate(still(np.full(200, 0.05), 5.0, 2), sensor, device=device))
    flips = np.concatenate([np.diff(e[:, 1]) != 0 for e in events])
    assert flips.mean() > 0.6  # of shot noise it would be a half
    assert len(flips) > 2000


def test_the_rate_of_voltage_noise_does_not_depend_on_sampling(device):
    effect = VoltageNoise(sigma=0.12, cutoff=60.0, knee=0.1, dark=1e-3)
    asked, finer = (
        counts(still(np.full(2000, 0.1), 2.0, samples), every(effect), 2.0, device).sum()
        for samples in (2, 8001)
    )
    assert asked == pytest.approx(finer, rel=0.06)


@pytest.mark.parametrize("mode", ["drop", "delay"])
def test_thresholds_are_drawn_anew_after_each_event(device, mode):
    spread, pixels = 0.25, 60
    sensor = every(Threshold(on=0.3, off=0.1, phase=0.0), Jitter(spread=spread), mode=mode)
    for sign, theta, name in ((1, 0.3, "normal"), (-1, 0.1, "normal_2")):
        events = dase.simulate(ramp(sign * 6.0, 1.0, pixels, samples=7), sensor, seed=5, device=device)
        for pixel, times in enumerate(tracks(events)):
            stream = reference.Stream(f"jitter_redraw_{name}", 5, pixel)
            want = [theta * (1 + spread * stream.normal(n)) for n in range(len(times))]
            np.testing.assert_allclose(6.0 * times, np.cumsum(want), atol=2e-5)
    got = counts(ramp(-6.0, 1.0, pixels, samples=7), sensor, 1.0, device, seed=5)[0]
    np.testing.assert_array_equal(got, [len(t) for t in tracks(events)])


def test_jitter_averages_out_and_mismatch_does_not(device):
    scene = ramp(9.0, 1.0, 500)
    quiet = Threshold(on=0.1, off=0.1, phase=0.0)
    spreads = []
    for effect in (Jitter(spread=0.2), Mismatch(spread=0.2)):
        on = counts(scene, every(quiet, effect), 1.0, device)[1]
        spreads.append(on.std() / on.mean())
    # a sum of 90 intervals varies by 0.2 / √90
    assert spreads[0] == pytest.approx(0.2 / np.sqrt(90), rel=0.15)
    assert spreads[1] > 0.15


def test_noise_events_draw_new_thresholds_too(device):
    # a memory reset by a noise event waits for the next threshold, not for the one it had
    sensor = every(Threshold(on=1.0, off=1.0, phase=0.0), Jitter(spread=0.3), Shot(rate=5.0, bright=1.0))
    array = Pixels(sensor, 50, 1, seed=2, device=device)
    times = np.linspace(0, 2.0, 9)
    array.emit(still(np.full(50, 0.2), 2.0, 9), times)
    from dase.kernels import pixel

    redraws = array._state.numpy()[pixel.states(array.stages).index("redraws"), 0]
    assert redraws.sum() == counts(still(np.full(50, 0.2), 2.0, 9), sensor, 2.0, device, seed=2).sum()
    assert redraws.sum() > 300


def test_leak_grows_with_light(device):
    light = np.array([0.0, 0.25, 1.0])
    sensor = every(Leak(rate=0.5, spread=0.0, light=8.0))
    off, on = counts(still(np.repeat(light, 50), 40.0, 41), sensor, 40.0, device).reshape(2, 3, 50)
    assert off.sum() == 0
    np.testing.assert_allclose(on.mean(1) / 40.0, 0.5 * (1 + 8.0 * light), atol=0.03)


def test_leak_follows_the_inverse_of_a_pixels_threshold(device):
    sensor = every(Threshold(on=0.2, off=0.4), Leak(rate=2.0, spread=0.0), Mismatch(spread=0.2))
    theta = Pixels(sensor, 40, 1, device=device).thresholds()[0, 1]
    on = counts(still(np.full(40, 0.1), 100.0, 101), sensor, 100.0, device)[1]
    np.testing.assert_allclose(on, 200 * 0.2 / theta, atol=1.5)
    assert on.max() > 1.5 * on.min()


def test_pixels_of_low_threshold_have_more_shot_noise(device):
    sensor = every(Shot(rate=20.0, balance=0.3), Mismatch(spread=0.2))
    theta = Pixels(sensor, 300, 1, device=device).thresholds()[0].astype(float)
    got = counts(still(np.zeros(300), 20.0, 21), sensor, 20.0, device)
    for polarity, share in ((0, 0.7), (1, 0.3)):
        want = 20.0 * 20.0 * share * 0.2 / theta[polarity]
        deviation = (got[polarity] - want) / np.sqrt(want)
        assert abs(deviation.mean()) < 3 / np.sqrt(300)
        assert deviation.std() == pytest.approx(1, abs=3 / np.sqrt(600))


def test_leak_and_shot_superpose(device):
    rate, seconds, pixels = 0.5, 30.0, 900
    scene = still(np.zeros(pixels), seconds, 31)
    shot = Shot(rate=rate, balance=0.3)
    off, on = counts(scene, every(shot, Leak(rate=2.0, spread=0.0)), seconds, device).sum(1)
    alone_off, alone_on = counts(scene, every(shot), seconds, device).sum(1)
    leak = counts(scene, every(Leak(rate=2.0, spread=0.0)), seconds, device)[1].sum()
    assert off == alone_off  # the same random numbers
    # a shot event makes the memory anew, and the leak starts over: on average r / (e^(r T) - 1) remain
    total = rate * 0.5
    want = pixels * seconds * rate / np.expm1(total)
    assert on - alone_on == pytest.approx(want, rel=0.02)
    assert on - alone_on < leak


def test_hot_pixels_are_few_and_log_normal(device):
    share, rate, spread, seconds, pixels = 0.05, 30.0, 0.8, 40.0, 20_000
    sensor = every(Hot(share=share, rate=rate, spread=spread, balance=0.8))
    off, on = counts(still(np.full(pixels, 0.3), seconds, 3), sensor, seconds, device)
    hot = np.flatnonzero(on + off)
    assert len(hot) == pytest.approx(share * pixels, abs=3 * np.sqrt(share * pixels))
    assert on.sum() / (on + off).sum() == pytest.approx(0.8, abs=0.01)
    log_rate = np.log((on + off)[hot] / seconds)
    assert log_rate.mean() == pytest.approx(np.log(rate), abs=3 * spread / np.sqrt(len(hot)))
    assert log_rate.std() == pytest.approx(spread, rel=3 / np.sqrt(2 * len(hot)))
    assert abs(np.corrcoef(hot[:-1], hot[1:] - hot[:-1])[0, 1]) < 0.15  # scattered evenly


def test_hot_intervals_are_exponential(device):
    sensor = every(Hot(share=1.0, rate=100.0, spread=0.0))
    events = dase.simulate(still(np.full(100, 0.3), 2.0, 3), sensor, device=device)
    waits = np.sort(np.concatenate([np.diff(np.r_[0, t[:40]]) for t in tracks(events)]))
    assert distance(waits, 1 - np.exp(-100.0 * waits)) < KS


@pytest.mark.parametrize("mode", ["drop", "delay"])
def test_dead_pixels_never_fire(device, mode):
    share, pixels = 0.2, 5000
    scene = ramp(3.0, 0.1, pixels, samples=5)
    loud = (Shot(rate=100.0), Hot(share=1.0, rate=100.0), Leak(rate=100.0))
    got = counts(scene, every(Dead(share=share), *loud, mode=mode), 0.1, device).sum(0)
    alive = counts(scene, every(*loud, mode=mode), 0.1, device).sum(0)
    assert np.mean(got == 0) == pytest.approx(share, abs=3 * np.sqrt(share * (1 - share) / pixels))
    np.testing.assert_array_equal(got[got > 0], alive[got > 0])
    dead = counts(scene, every(Dead(share=1.0), *loud, mode=mode), 0.1, device)
    assert dead.sum() == 0


@pytest.mark.parametrize("spread", [0.0, 0.3])
def test_a_dead_time_that_delays_loses_nothing_and_one_that_drops_does(device, spread):
    # a fast rise, then rest: long enough for all crossings to be sent one dead time after the other
    level = np.r_[np.linspace(0, 4.0, 11), np.full(40, 4.0)] - 4.5
    times = np.r_[np.linspace(0, 0.01, 11), 0.01 + 0.01 * np.arange(1, 41)]
    scene = dase.VideoScene((np.exp(level) - 1e-3)[:, None, None] * np.ones((1, 30)), times)
    quiet = Threshold(on=0.19, off=0.19, phase=0.0), Jitter(spread=spread)
    ideal, late, lost = (
        counts(scene, every(*quiet, *others, mode=mode), 1.0, device)[1]
        for mode, others in (
            ("drop", ()),
            ("delay", (Refractory(period=4e-3, mode="delay"),)),
            ("drop", (Refractory(period=4e-3),)),
        )
    )
    assert np.all(ideal == 21) if spread == 0 else len(np.unique(ideal)) > 3
    np.testing.assert_array_equal(late, ideal)
    assert np.all(lost <= 4)


def test_an_effect_is_added_where_it_acts():
    sensor = dase.Sensor((Threshold(), Bandwidth(), Leak()))
    order = [e.name for e in sensor.with_effect(Linlog()).with_effect(Dead()).with_effect(Jitter()).effects]
    assert order == ["linlog", "threshold", "bandwidth", "jitter", "leak", "dead"]


@pytest.mark.parametrize("name", presets())
def test_every_preset_simulates(device, rng, name):
    sensor = load_sensor(name)
    assert sensor.name == name
    frames = np.exp(np.cumsum(rng.normal(0, 0.1, (11, 8, 9)), 0) - 1.5)
    scene = dase.VideoScene(np.minimum(frames, 1.0), np.linspace(0, 0.05, 11))
    events = dase.simulate(scene, sensor, device=device)
    assert len(events) > 20
    assert 0.2 < events.p.mean() < 0.8


def script(path: str):
    """Return a script of the checkout as a module."""
    file = Path(__file__).parents[1] / path
    spec = importlib.util.spec_from_file_location(file.stem, file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_of_effects_is_that_of_the_code():
    page = (Path(__file__).parents[1] / "docs" / "effects.md").read_text("utf-8")
    assert page == script("docs/effects.py").page(), "run python docs/effects.py"


@pytest.mark.parametrize(("level", "pixels"), [("0.1lux", 600), ("161lux", 900), ("3klux", 900)])
def test_noise_is_like_that_of_a_camera(shared, level, pixels):
    noise = script("perf/noise.py")
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
