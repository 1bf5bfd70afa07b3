"""The voltage of a pixel: a photoreceptor of second order, and noise of the voltage."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from helpers.event_comparison import KS, by_pixel, distance
from helpers.sensors import counts, every
from helpers.small_scenes import ramp, still
from reference import effects as reference_effects
from scipy.linalg import expm
from scipy.stats import norm

import dase
from dase.effects import second_order, voltage_noise
from dase.effects.bandwidth import Bandwidth
from dase.effects.refractory import Refractory
from dase.effects.second_order import SecondOrder
from dase.effects.threshold import Threshold
from dase.effects.voltage_noise import VoltageNoise
from perf.experiments.noise.rice import CUTOFFS, LEVELS, apart_rate, fine_rates, rice_rate, simulated_rate


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
    h, dh = second_order.impulse_response(x[i], damping[i])
    behind, speed = second_order.ramp_lag(x[i], damping[i], h, dh + 2.0 * damping[i] * h)
    out[i, 0] = h
    out[i, 1] = dh
    out[i, 2] = behind
    out[i, 3] = speed


def test_closed_forms_keep_their_digits(device):
    x, damping = np.meshgrid(
        np.geomspace(1e-4, 50, 60), [0.05, 0.4, 0.999, 1.0, 1.0001, 1.05, 1.5, 3.0, 20.0, 200.0, 2000.0]
    )
    x, damping = x.ravel().astype(np.float32), damping.ravel().astype(np.float32)
    out = wp.empty((len(x), 4), dtype=float, device=device)
    inputs = [wp.array(a, dtype=float, device=device) for a in (x, damping)]
    wp.launch(answers, len(x), inputs=[*inputs, out], device=device)
    for got, at, zeta in zip(out.numpy().astype(float), x.astype(float), damping.astype(float), strict=True):
        # displacement, its speed, the time integral of the displacement
        flow = expm(at * np.array([[0, 1, 0], [-1, -2 * zeta, 0], [1, 0, 0]]))
        want = [flow[0, 1], flow[1, 1], flow[2, 0] / at, (1 - flow[0, 0]) / at]
        # float32 rounds shares of a step of 1 after a division by x
        slack = 3e-6 + 3e-7 * (2 * zeta / at if zeta < 1.5 and 2 * zeta * at > 0.09 else 1)
        np.testing.assert_allclose(got, want, atol=slack)


@wp.kernel(enable_backward=False)
def variances(x: wp.array[float], damping: wp.array[float], out: wp.array2d[float]):
    i = wp.tid()
    h, dh = second_order.impulse_response(x[i], damping[i])
    var, mixed, speed = voltage_noise.fresh_variance_of_poles(x[i], damping[i], h, dh)
    out[i, 0] = var
    out[i, 1] = mixed
    out[i, 2] = speed


def test_variances_of_noise_keep_their_digits(device):
    x, damping = np.meshgrid(np.geomspace(1e-3, 50, 50), [0.05, 0.4, 1.0, 1.2, 3.0, 20.0, 50.0])
    x, damping = x.ravel().astype(np.float32), damping.ravel().astype(np.float32)
    out = wp.empty((len(x), 3), dtype=float, device=device)
    inputs = [wp.array(a, dtype=float, device=device) for a in (x, damping)]
    wp.launch(variances, len(x), inputs=[*inputs, out], device=device)
    for got, at, zeta in zip(out.numpy().astype(float), x.astype(float), damping.astype(float), strict=True):
        flow = expm(at * np.array([[0, 1], [-1, -2 * zeta]]))
        fresh = np.eye(2) - flow @ flow.T
        np.testing.assert_allclose(got, [fresh[0, 0], fresh[0, 1], fresh[1, 1]], rtol=2e-3, atol=1e-9)


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
    cosine, sine = voltage_noise.cosine_and_sine(turn[i])
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


def test_noise_of_one_pole_is_that_of_a_simulator_which_draws_it_once_a_frame(device):
    # v2e's loop: noise, low-pass, whole thresholds since the memory, all of it once a frame
    pixels, frames, step, sigma, cutoff, on, off = 3000, 400, 1e-3, 0.08, 120.0, 0.2, 0.25
    rng, kept = np.random.default_rng(5), 1 - 2 * np.pi * cutoff * step
    noise, memory, want = np.zeros(pixels), np.zeros(pixels), np.zeros(2)
    for _ in range(frames):
        noise = kept * noise + sigma * np.sqrt(1 - kept**2) * rng.standard_normal(pixels)
        up, down = np.maximum(noise - memory, 0) // on, np.maximum(memory - noise, 0) // off
        memory += up * on - down * off
        want += down.sum(), up.sum()
    sensor = every(
        Threshold(on=on, off=off, phase=0.0), VoltageNoise(sigma=sigma, cutoff=cutoff, poles="one")
    )
    scene = still(np.full(pixels, 0.3), frames * step, frames + 1)
    got = counts(scene, sensor, frames * step, device).sum(-1)
    np.testing.assert_allclose(got, want, rtol=0.06)
    # the same in all light
    dark = counts(still(np.full(pixels, 0.01), frames * step, frames + 1), sensor, frames * step, device).sum(
        -1
    )
    np.testing.assert_allclose(dark, got, rtol=0.06)


def first_passages(logs, spread, on, off, rng):
    """Return OFF and ON events of DVS-Voltmeter's rule and the time of each in its frame, in float64.

    In each frame it is drawn which threshold Brownian motion with drift passes first, and when; an event
    begins it anew, and the rest of the frame goes straight. `logs` (K, N) are log intensities at the frames,
    `spread` the standard deviation that a walk has after one.
    """
    above, counts, times = np.zeros(logs.shape[1]), np.zeros(2), []
    for drift in np.diff(logs, axis=0):
        left, going = np.ones(len(drift)), np.arange(len(drift))
        while len(going):
            m, a, b = drift[going], on - above[going], off + above[going]
            rate = np.where(m == 0, 1.0, 2 * m / spread**2)
            with np.errstate(over="ignore", invalid="ignore"):
                up = np.where(rate > 0, -np.expm1(-rate * b), np.expm1(rate * b) * np.exp(rate * a))
                up = up / np.where(rate > 0, -np.expm1(-rate * (a + b)), np.expm1(rate * (a + b)))
            up = rng.random(len(going)) < np.where(m == 0, 0.5, np.nan_to_num(up))
            way = np.where(up, a, b)
            # without drift its times are of a Lévy law, in its code of twice the scale
            still = 2 * (way / spread) ** 2 / rng.standard_normal(len(going)) ** 2
            moving = rng.wald(way / np.maximum(np.abs(m), 1e-12), (way / spread) ** 2)
            took = np.where(m == 0, still, moving)
            sent = took < left[going]
            counts += (~up & sent).sum(), (up & sent).sum()
            times.append(1 - left[going][sent] + took[sent])
            above[going[~sent]] += (np.where(up, way, -way) * left[going] / took)[~sent]
            above[going[sent]] = 0.0
            left[going[sent]] -= took[sent]
            going = going[sent]
    return counts, np.concatenate(times)


@pytest.mark.parametrize(("spread", "swing"), [(0.02, 0.2), (0.05, 0.2), (0.05, 1.0), (0.1, 0.0), (0.1, 0.5)])
def test_a_walk_is_that_of_a_simulator_of_brownian_motion(spread, swing, device):
    pixels, frames, step, on, off = 2000, 121, 0.005, 0.25, 0.2
    phase = np.random.default_rng(1).uniform(0, 2 * np.pi, pixels)
    logs = np.log(0.3) + swing * np.sin(2 * np.pi * np.arange(frames)[:, None] / 40 + phase)
    want, times = first_passages(logs, spread, on, off, np.random.default_rng(5))
    scene = dase.VideoScene(np.exp(logs).astype(np.float32).reshape(frames, 40, 50), np.arange(frames) * step)
    walk = VoltageNoise(poles="none", sigma=spread, period=step, floor=1.0)
    events = dase.simulate(scene, every(Threshold(on=on, off=off, phase=0.0), walk), device=device)
    got = np.bincount(events.p.astype(int), minlength=2)
    assert want.sum() > 500
    np.testing.assert_allclose(got, want, rtol=0.05, atol=4 * np.sqrt(want.max()))
    # without it another number, unless the change of light makes most of them
    if swing < 1.0:
        bare = dase.simulate(scene, every(Threshold(on=on, off=off, phase=0.0)), device=device)
        assert len(bare.t) < 0.93 * want.sum()
    shares = np.histogram((events.t / step) % 1.0, 4, (0, 1))[0] / len(events.t)
    np.testing.assert_allclose(shares, np.histogram(times, 4, (0, 1))[0] / len(times), atol=0.06)


def test_a_walk_falls_with_the_light_to_a_floor(device):
    pixels, frames, step, sigma, knee, floor = 4000, 101, 0.01, 0.12, 0.05, 0.2
    for light in (0.02, 0.3):
        share = floor + (1 - floor) * knee / (light + 0.003 + knee)
        walk = VoltageNoise(poles="none", sigma=sigma, knee=knee, floor=floor, period=step)
        alike = VoltageNoise(poles="none", sigma=sigma * np.sqrt(share), floor=1.0, period=step)
        scene = still(np.full(pixels, light), (frames - 1) * step, frames)
        got, want = (counts(scene, every(one), (frames - 1) * step, device).sum() for one in (walk, alike))
        assert want > 1000
        assert got == pytest.approx(want, rel=0.05)


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


@wp.kernel(enable_backward=False)
def noise_paths(step: float, sigma: float, samples: int, out: wp.array2d[float]):
    """Noise at light far above nothing and a knee far above the light, (samples, pixels)."""
    i = wp.tid()
    noise, speed, voltage = float(0.0), float(0.0), float(0.0)
    key = wp.rand_init(7, i)
    for k in range(samples):
        dt = step
        if k == 0:
            dt = 1.0e30
        first, second = wp.randf(key), wp.randf(key)
        voltage, noise, speed = voltage_noise.noisy_voltage(
            0.0, 1.0, dt, sigma, 1.0, 1.0e6, 999999.0, 0.0, noise, speed, first, second
        )
        out[k, i] = voltage


@pytest.mark.parametrize("per_period", [20, 30, 40, 60, 100])
def test_levels_are_passed_as_often_as_rice_says(device, per_period):
    # half of the variance and of the corner, as dark current and knee are alike
    samples, pixels, sigma = 100 * per_period, 1000, 0.3
    out = wp.empty((samples, pixels), dtype=float, device=device)
    wp.launch(noise_paths, pixels, inputs=[2.0 / per_period, sigma, samples, out], device=device)
    voltage, deviation = out.numpy(), sigma * np.sqrt(0.5)
    for level in (2.0, 2.5, 3.0):
        above = voltage > level * deviation
        passed = np.count_nonzero(above[1:] & ~above[:-1])
        # coarser steps miss that a voltage comes back at once, which makes no event.
        # E|speed| / 2 times the density there: the speed's deviation is that of the noise times the pole
        pole = 2 * np.pi / np.sqrt(np.sqrt(2) - 1)
        want = pole / (2 * np.pi) * np.exp(-0.5 * level**2) * 100 * pixels
        assert passed == pytest.approx(want, rel=0.03 + 3 / np.sqrt(want))


def noise_events(
    thresholds: np.ndarray, time: float, rng: np.random.Generator, before: float = 0.0
) -> np.ndarray:
    """Return events per time constant of a change detector under noise of deviation 1, in small steps.

    Args:
        thresholds: Shape (P,).
        time: Looked at [time constants].
        rng: Draws the noise and where the memories begin.
        before: Not looked at, in which memories find their places [time constants].
    """
    fine = 0.05
    step = expm(np.array([[0, 1], [-1, -2]]) * fine)
    fresh = np.linalg.cholesky(np.eye(2) - step @ step.T)
    state = rng.standard_normal((2, len(thresholds)))
    memory, events = state[0] - rng.uniform(-1, 1, len(thresholds)) * thresholds, np.zeros(len(thresholds))
    for k in range(-round(before / fine), round(time / fine)):
        state = step @ state + fresh @ rng.standard_normal(state.shape)
        crossed = np.trunc((state[0] - memory) / thresholds)
        memory += crossed * thresholds
        events += np.abs(crossed) * (k >= 0)
    return events / time


def test_events_of_noise_are_those_of_small_steps(device, rng):
    pixels, time, light = 4000, 60.0, 0.1
    effect = VoltageNoise(sigma=0.2, cutoff=100.0, knee=0.1, dark=1e-6)
    deviation, pole = 0.2 * np.sqrt(0.5), 50.0 * 2 * np.pi / np.sqrt(np.sqrt(2) - 1)
    for ratio in (1.0, 2.0, 3.0):
        want = noise_events(np.full(pixels, ratio), time, rng)
        sensor = every(Threshold(on=ratio * deviation, off=ratio * deviation), effect)
        scene = still(np.full(pixels, light), time / pole, 2)
        got = counts(scene, sensor, time / pole, device).sum(0) / time
        error = np.hypot(got.std(), want.std()) / np.sqrt(pixels)
        assert got.mean() == pytest.approx(want.mean(), rel=0.03, abs=3 * error)


@pytest.mark.slow
def test_rates_are_those_of_rice_where_thresholds_are_far_above_the_noise(device, rng):
    """Nearer ones are passed again before the voltage forgets: there small steps tell the rate."""
    pole = 2 * np.pi / np.sqrt(np.sqrt(2) - 1)
    small_steps = pole * noise_events(np.full(3000, 3.0), 100.0, rng, before=50.0).mean()
    for ratio in (3.0, 5.0, 6.0):
        seen = [simulated_rate(cutoff, ratio, pixels=4000, device=device) for cutoff in CUTOFFS]
        rates, errors = np.array(seen).T / (0.5 * np.array(CUTOFFS))
        # a noise twice as fast sends twice as much
        np.testing.assert_allclose(rates, rates[0], rtol=0.01)
        want, slack = (small_steps, 0.03) if ratio < 5 else (rice_rate(1.0, ratio), 0.1)
        assert rates[0] == pytest.approx(want, rel=slack, abs=3 * errors[0])


def likeness_of_halves(sensor: dase.Sensor, device: str) -> float:
    """Return how the events of pixels that are alike correlate between two halves of the time."""
    scene = still(np.full(300, 0.05), 12.0, 2)
    return float(np.corrcoef(dase.count(scene, sensor, [0, 6, 12], device=device)[0].sum(1))[0, 1])


def test_a_pixel_held_in_reset_forgets_its_phase(device):
    noisy = every(Threshold(on=0.35, off=0.35), VoltageNoise(sigma=0.15, cutoff=60.0))
    assert likeness_of_halves(noisy, device) > 0.7
    # a time constant
    assert likeness_of_halves(noisy.with_effect(Refractory(period=5e-3)), device) < 0.3


@pytest.mark.parametrize(
    ("ratio", "gain"),
    [
        *((0.1, 0.0), (1.0, 0.0), (0.02, 50.0), (0.2, 50.0)),
        *(pytest.param(ratio, 0.0, marks=pytest.mark.slow) for ratio in (10.0, 30.0)),
    ],
)
def test_the_photoreceptors_noise_sends_as_often_as_finely_sampled_noise(device, ratio, gain, rng):
    """In light of ten times the knee 0.57 of the events were left at eight samples per period."""
    span = dict(pixels=2500, periods=12.0, before=8.0)
    wanted, errors = fine_rates(ratio, rng, gain=gain, **span)
    for level, want, error in zip(LEVELS, wanted, errors, strict=True):
        got, spread = apart_rate(ratio, level, gain=gain, device=device, **span)
        assert got == pytest.approx(want, rel=0.03, abs=3 * np.hypot(error, spread))


def test_the_fixed_pole_sets_the_pace_of_the_photoreceptors_noise(device):
    rates = [
        apart_rate(10.0, 2.0, cutoff=cutoff, pixels=1500, periods=12.0, before=4.0, device=device)[0]
        for cutoff in CUTOFFS
    ]
    np.testing.assert_allclose(rates, rates[0], rtol=0.01)


@pytest.mark.parametrize("dark", [0.02, 0.5])
def test_noise_of_a_photoreceptor_has_its_pole(dark):
    pole = Bandwidth(cutoff=150.0, dark=dark)
    noise = VoltageNoise.of_photoreceptor(pole, sigma=0.05, cutoff=800.0)
    light = np.array([0.0, 0.01, 0.3, 1.0])
    expected = pole.cutoff * (pole.dark + (1 - pole.dark) * light)
    np.testing.assert_allclose(noise.cutoff * (light + noise.dark) / noise.knee, expected, rtol=1e-12)
    assert (noise.sigma, noise.cutoff, noise.poles) == (0.05, 800.0, "apart")
