"""Plain twins of the effects between light and change detector: float64, written from the physics."""

from __future__ import annotations

import numpy as np
from reference import pixel as reference
from reference.pixel import Stream, setting
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline
from scipy.linalg import cholesky, expm, solve_continuous_lyapunov

import dase


def light(sensor: dase.Sensor, times: np.ndarray, frames: np.ndarray, seed: int) -> np.ndarray:
    """Return what reaches the photodiodes, dark current included, shape (K, N).

    Args:
        sensor: Its built-in effects.
        times: Samples [s], shape (K,).
        frames: Linear intensity, shape (K, H, W).
        seed: Of every random number.
    """
    _, height, width = frames.shape
    out = frames.astype(np.float64)
    if "flicker" in sensor:
        lamp = sensor["flicker"]
        for row in range(height):
            for column in range(width):
                number = row // lamp.region + column // lamp.region
                turns = lamp.frequency * times + lamp.phase + lamp.apart * number
                out[:, row, column] *= 1 + lamp.depth * waveform(lamp, shown_turns(lamp, turns))
    y, x = np.mgrid[:height, :width]
    square = ((2 * x - width + 1) ** 2 + (2 * y - height + 1) ** 2) / (width**2 + height**2)
    corner = np.arccos((1 - setting(sensor, "vignetting", "loss", 0.0)) ** 0.25)
    out = out * np.cos(np.arctan(np.tan(corner) * np.sqrt(square))) ** 4
    out = out.reshape(len(times), -1)
    current, spread = (setting(sensor, "dark", name, 0.0) for name in ("current", "spread"))
    normal = [Stream("dark_current_pixel_normal", seed, i).normal() for i in range(width * height)]
    return out + current * np.exp(spread * np.array(normal))


def shown_turns(lamp: dase.Effect, turns: np.ndarray) -> np.ndarray:
    """Return the turns that samples show: an extreme of the light within half the step before them.

    The first sample shows its own moment, and so do samples of which a period has fewer than two.
    """
    half = np.diff(turns, prepend=-np.inf) / 2
    brightest = {"sine": 0.25, "rectified": 0.5, "pwm": 0.5 * lamp.duty}[lamp.shape]
    extreme = brightest + np.round(2 * (turns - brightest)) / 2
    return np.where((np.abs(turns - extreme) <= half) & (half <= 0.25), extreme, turns)


def waveform(lamp: dase.Effect, turns: np.ndarray) -> np.ndarray:
    """Return how the flux of a lamp swings, -1 to 1."""
    if lamp.shape == "rectified":
        return 2 * np.abs(np.sin(np.pi * turns)) - 1
    if lamp.shape == "pwm":
        return np.where(turns % 1 < lamp.duty, 1.0, -1.0)
    return np.sin(2 * np.pi * turns)


def linlog(voltage: np.ndarray, knee: float, slope: float, eps: float) -> np.ndarray:
    """Return log(I + eps) above the knee, below it the line of this slope [1 / (knee + eps)]."""
    line = np.log(knee + eps) + slope * (np.exp(voltage) - eps - knee) / (knee + eps)
    return np.where(np.exp(voltage) - eps < knee, line, voltage)


def second_order(
    times: np.ndarray, level: np.ndarray, omega: np.ndarray, damping: float | np.ndarray
) -> np.ndarray:
    """Return level behind ω² / (s² + 2 damping ω s + ω²), settled at the first sample.

    Args:
        times: Samples [s], shape (K,).
        level: Straight between samples, shape (K, N).
        omega: Natural frequency during the step that ends at each sample [rad/s], shape (K, N).
        damping: Of the filter during the step that ends at each sample, shape (K, N) or the same for all.
    """
    out = np.array(level, np.float64)
    damping = np.broadcast_to(damping, level.shape)
    for i in range(level.shape[1]):
        state = np.array([level[0, i], 0.0, level[0, i], 0.0])  # output, its slope, input, its slope
        for k in range(1, len(times)):
            dt, w = times[k] - times[k - 1], omega[k, i]
            state[2:] = level[k - 1, i], (level[k, i] - level[k - 1, i]) / dt
            flow = np.zeros((4, 4))
            flow[0, 1] = flow[2, 3] = 1
            flow[1] = [-w * w, -2 * damping[k, i] * w, w * w, 0]
            state = expm(flow * dt) @ state
            out[k, i] = state[0]
    return out


def current_left(sensor: dase.Sensor, effect: dase.Effect, intensity: np.ndarray) -> np.ndarray:
    """Return the current of a photodiode relative to a median one at intensity 1, at most 1, (K, N).

    Args:
        sensor: Whose dark current is in the intensity.
        effect: The pole, whose own dark current flows where the sensor has none.
        intensity: Shape (K, N).
    """
    if shares_dark_current(sensor):
        most = 1 + sensor["dark"].current
        return np.minimum(np.maximum(intensity, 1e-6 * most), most) / most
    return effect.dark + (1 - effect.dark) * np.clip(intensity, 0, 1)


def shares_dark_current(sensor: dase.Sensor) -> bool:
    """Return whether one dark current reaches light and speed."""
    return setting(sensor, "dark", "current", 0.0) > 0 and sensor["dark"].speed == "shared"


def own_speed(slow: dase.Effect, pixels: int, seed: int) -> np.ndarray:
    """Return the cutoff of each pixel relative to the nominal one, shape (N,)."""
    name = f"{slow.name}_respond_pixel_normal"
    normal = np.array([Stream(name, seed, i).normal() for i in range(pixels)])
    return np.maximum(1 + slow.spread * normal, 0.1)


def follower(times: np.ndarray, level: np.ndarray, cutoff: np.ndarray) -> np.ndarray:
    """Return the voltage v of dv/dt = ω (1 - e^(v - level)), by integrating that, shape (K, N).

    Args:
        times: Samples [s], shape (K,).
        level: Straight between samples, shape (K, N).
        cutoff: During the step that ends at each sample [Hz], shape (K, N).
    """
    out = np.array(level, np.float64)
    for k in range(1, len(times)):
        rate = 2 * np.pi * cutoff[k] * (times[k] - times[k - 1])
        before, change = level[k - 1], level[k] - level[k - 1]

        def speed(share, v, rate=rate, before=before, change=change):
            return rate * (1 - np.exp(v - before - share * change))

        def slopes(share, v, rate=rate, before=before, change=change):
            return np.diag(-rate * np.exp(v - before - share * change))

        # all pixels in one go, which a Python function asks for; errors are bounded in their mean
        way = solve_ivp(speed, (0, 1), out[k - 1], method="Radau", jac=slopes, rtol=1e-9, atol=1e-9)
        out[k] = way.y[:, -1]
    return out


def stepped(times: np.ndarray, level: np.ndarray, cutoff: np.ndarray) -> np.ndarray:
    """Return a low-pass by Euler's method, no step beyond its end; arguments as those of `follower`."""
    share = np.minimum(2 * np.pi * cutoff[1:] * np.diff(times)[:, None], 1.0)
    out = np.array(level, np.float64)
    for k, part in enumerate(share, 1):
        out[k] = (1 - part) * out[k - 1] + part * level[k]
    return out


def voltage_noise(
    times: np.ndarray, intensity: np.ndarray, sensor: dase.Sensor, normals: np.ndarray
) -> np.ndarray:
    """Return the noise of two equal poles from its covariance, shape (K, N).

    A step that turns ends at its turn, which is that of the cubic through its ends, and a little beyond.

    Args:
        times: Samples [s], shape (K,).
        intensity: Linear, shape (K, N).
        sensor: Has the effect.
        normals: Standard normal, shape (2, K, N).
    """
    effect = sensor["voltage_noise"]
    if effect.poles == "apart":
        own = 0.0 if shares_dark_current(sensor) else effect.dark
        return photoreceptor_noise(times, intensity + own, effect, normals)
    if effect.poles == "one":
        # an autoregressive process of first order, once a sample, from nothing
        kept = np.maximum(1 - 2 * np.pi * effect.cutoff * np.diff(times), -0.9)
        out = effect.sigma * normals[0]
        out[0] = 0
        for k, share in enumerate(kept, 1):
            out[k] = share * out[k - 1] + np.sqrt(1 - share**2) * out[k]
        return out
    total = intensity + (0.0 if shares_dark_current(sensor) else effect.dark)
    corner = effect.cutoff * total / (total + effect.knee)
    sigma = effect.sigma * np.sqrt(effect.knee / (total + effect.knee))
    pole = 2 * np.pi * corner / np.sqrt(np.sqrt(2) - 1)
    out = np.zeros_like(intensity)
    for i in range(intensity.shape[1]):
        state = sigma[0, i] * normals[:, 0, i]
        out[0, i] = state[0]
        for k in range(1, len(times)):
            # noise and its slope over the pole; d²n = -2 λ dn - λ² n + white noise
            step = expm(np.array([[0, 1], [-1, -2]]) * pole[k, i] * (times[k] - times[k - 1]))
            fresh = np.eye(2) - step @ step.T
            before, constants = state, min(pole[k, i] * (times[k] - times[k - 1]), 2.0)
            state = step @ state + sigma[k, i] * cholesky(fresh, lower=True) @ normals[:, k, i]
            out[k, i] = state[0]
            if before[1] * state[1] < 0:
                slopes = constants * before[1], constants * state[1]
                way = CubicHermiteSpline([0.0, 1.0], [before[0], state[0]], slopes)
                (turn,) = (t for t in way.derivative().roots() if 0 <= t <= 1)
                out[k, i] = way(turn) + np.sign(before[1]) * 0.05 * constants**1.5 * sigma[k, i]
    return out


def photoreceptor_noise(
    times: np.ndarray, current: np.ndarray, effect: dase.Effect, normals: np.ndarray
) -> np.ndarray:
    """Return the noise of a node whose pole follows the light, in a loop with a fixed pole.

    Turns are those of `voltage_noise`. The covariance after a step is from Van Loan's matrix exponential, in
    the order voltage, slope.
    """
    out, fixed, more = np.zeros_like(current), 2 * np.pi * effect.cutoff, 1 + effect.gain
    for i in range(current.shape[1]):
        for k in range(len(times)):
            moving = fixed * current[k, i] / effect.knee
            # of the voltage, and of its slope over the fixed pole
            drift = np.array([[0.0, fixed], [-more * moving, -(moving + fixed)]])
            white = np.diag([0.0, 2 * more * moving])
            if k == 0:
                spread = solve_continuous_lyapunov(drift, -white)
                state = effect.sigma * cholesky(spread, lower=True) @ normals[:, k, i]
                out[k, i] = state[0]
                continue
            dt, before = times[k] - times[k - 1], state
            block = expm(np.block([[-drift, white], [np.zeros((2, 2)), drift.T]]) * dt)
            step = block[2:, 2:].T
            spread = step @ block[:2, 2:]
            state = step @ state + effect.sigma * cholesky(spread, lower=True) @ normals[:, k, i]
            out[k, i] = state[0]
            slopes = [fixed * dt * s[1] for s in (before, state)]
            if slopes[0] * slopes[1] < 0:
                near = min(1.0, 2.0 / (dt * max(moving, fixed, np.sqrt(more * moving * fixed))))
                way = CubicHermiteSpline([0.0, 1.0], [before[0], state[0]], np.multiply(slopes, near))
                (turn,) = (t for t in way.derivative().roots() if 0 <= t <= 1)
                pace = np.sqrt(more * moving * fixed**2 / 2 * (near * dt) ** 3)
                out[k, i] = way(turn) + np.sign(slopes[0]) * 0.05 * pace * effect.sigma
    return out


def high_pass(times: np.ndarray, level: np.ndarray, cutoff: float) -> np.ndarray:
    """Return level behind s / (s + 2π cutoff), settled at the first sample, by integrating its equation."""
    out, rate = np.zeros_like(level), 2 * np.pi * cutoff
    for k in range(1, len(times)):
        dt = times[k] - times[k - 1]
        slope = (level[k] - level[k - 1]) / dt
        # dv/dt = slope - rate v has the solution v = slope / rate + (v0 - slope / rate) e^(-rate t)
        out[k] = slope / rate + (out[k - 1] - slope / rate) * np.exp(-rate * dt)
    return out


def exposed(times: np.ndarray, period: float, exposure: float, begin: float) -> np.ndarray:
    """Return at which samples a frame is exposed, frame by frame, shape (K,)."""
    out = np.zeros(len(times), bool)
    for n in range(int((times[0] - begin) // period) - 1, int((times[-1] - begin) // period) + 2):
        out |= (times > begin + n * period) & (times <= begin + n * period + min(exposure, period))
    return out


def voltage(sensor: dase.Sensor, times: np.ndarray, intensity: np.ndarray, seed: int) -> np.ndarray:
    """Return the voltage at the change detector, shape (K, N), of the intensity at the photodiode."""
    level = np.log(intensity + sensor.log_eps)
    if "linlog" in sensor:
        level = linlog(level, sensor["linlog"].knee, sensor["linlog"].slope, sensor.log_eps)
    if np.isfinite(setting(sensor, "bandwidth", "cutoff", np.inf)):
        slow = sensor["bandwidth"]
        cutoff = slow.cutoff * current_left(sensor, slow, intensity)
        cutoff = cutoff * own_speed(slow, intensity.shape[1], seed)
        equations = {"small": reference.lowpass, "large": follower, "steps": stepped}
        level = equations[slow.signal](times, level, cutoff)
    if np.isfinite(setting(sensor, "second_order", "cutoff", np.inf)):
        slow = sensor["second_order"]
        current = current_left(sensor, slow, intensity)
        omega = 2 * np.pi * slow.cutoff * own_speed(slow, intensity.shape[1], seed)
        if slow.poles == "apart":
            damping = slow.damping * (slow.fixed / np.sqrt(current) + (1 - slow.fixed) * np.sqrt(current))
            level = second_order(times, level, omega * np.sqrt(current), damping)
        elif slow.poles == "steps":
            for _ in range(2):
                level = stepped(times, level, omega * current / (2 * np.pi))
        else:
            level = second_order(times, level, omega * current, slow.damping)
    if setting(sensor, "voltage_noise", "sigma", 0.0) > 0:
        streams = ("voltage_noise_respond_uniform", "voltage_noise_respond_uniform_2")
        pixels = range(intensity.shape[1])
        first, second = np.array(
            [[[Stream(s, seed, i).uniform(k) for i in pixels] for k in range(len(times))] for s in streams]
        )
        radius, angle = np.sqrt(-2 * np.log(1 - first)), 2 * np.pi * second
        normals = radius * np.cos(angle), radius * np.sin(angle)
        level = level + voltage_noise(times, intensity, sensor, np.array(normals))
    if setting(sensor, "exposure", "amplitude", 0.0) != 0:
        frames = sensor["exposure"]
        normal = np.array(
            [Stream("exposure_respond_pixel_normal", seed, i).normal() for i in range(intensity.shape[1])]
        )
        high = exposed(times, frames.period, frames.exposure, frames.begin)
        level = level + high[:, None] * frames.amplitude * (1 + frames.spread * normal)
    if setting(sensor, "high_pass", "cutoff", 0.0) > 0:
        level = high_pass(times, level, sensor["high_pass"].cutoff)
    return level


def events(sensor: dase.Sensor, times: np.ndarray, frames: np.ndarray, seed: int) -> list[np.ndarray]:
    """Return the events of every pixel as `Detector.run` does, of a sensor without noise events."""
    intensity = light(sensor, times, frames, seed)
    level = voltage(sensor, times, intensity, seed)
    none = np.zeros((len(times), 2))
    return [
        reference.detector(sensor, i, seed).run(times, level[:, i], none) for i in range(intensity.shape[1])
    ]
