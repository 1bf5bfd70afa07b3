"""Plain twins of scene and pixel: slow, float64, written from the physics, no code of the kernels."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

import dase
from dase.kernels import pixel_stages as composer

WORD = 0xFFFFFFFF


def hashed(number: int) -> int:
    """Return the PCG hash of 32 bits (Jarzynski, Olano: Hash functions for GPU rendering, 2020)."""
    state = (number * 747796405 + 2891336453) & WORD
    word = (((state >> ((state >> 28) + 4)) ^ state) * 277803737) & WORD
    return (word >> 22) ^ word


def keyed(seed: int, offset: int) -> int:
    """Return the state of a generator, as wp.rand_init does."""
    return hashed((seed + hashed(offset & WORD)) & WORD)


@dataclass(frozen=True)
class Stream:
    """Random numbers of one effect at one pixel, by index."""

    name: str
    seed: int
    pixel: int

    def state(self, index: int) -> int:
        return keyed(keyed(self.seed ^ (zlib.crc32(self.name.encode()) & 0x7FFFFFFF), self.pixel), index)

    def uniform(self, index: int = 0) -> float:
        return (hashed(self.state(index)) >> 8) / 2**24

    def normal(self, index: int = 0) -> float:
        first = hashed(self.state(index))
        radius, turn = (first >> 8) / 2**24 + 5.96e-8, (hashed(first) >> 8) / 2**24
        return float(np.sqrt(-2 * np.log(radius)) * np.cos(2 * np.pi * turn))

    def waiting(self, index: int) -> float:
        """Exponential with mean 1."""
        return float(-np.log1p(-self.uniform(index)))


def lowpass(times: np.ndarray, level: np.ndarray, cutoff: np.ndarray) -> np.ndarray:
    """Return a first-order low-pass of straight lines between samples, settled at the first of them.

    Solves dy/dt = (u - y)/τ for u(t) = u0 + a t: y(t) = u(t) - a τ + (y0 - u0 + a τ) exp(-t/τ).

    Args:
        times: Samples [s], shape (K,).
        level: Input at the samples, shape (K, ...).
        cutoff: -3 dB frequency [Hz] during the step that ends at each sample, shape (K, ...).
    """
    out = np.array(level, np.float64)
    for k in range(1, len(times)):
        dt = times[k] - times[k - 1]
        tau = 1 / (2 * np.pi * cutoff[k])
        lag = (level[k] - level[k - 1]) / dt * tau
        out[k] = level[k] - lag + (out[k - 1] - level[k - 1] + lag) * np.exp(-dt / tau)
    return out


@dataclass(frozen=True)
class Detector:
    """One pixel behind its photoreceptor.

    Args:
        on: Threshold [log intensity].
        off: Threshold [log intensity].
        lead: Share of a threshold by which the first change is ahead.
        falls: Whether a first change of exactly 0 counts as one towards OFF.
        leak: Drift towards ON [log intensity/s].
        period: Dead time [s].
        delays: Whether a dead pixel looks again when the dead time ends; else its memory goes on.
        resets: Whether it memorises the signal of that moment.
        spares_noise: Whether noise comes in the dead time, too, and begins none.
        after_off: Dead time after an OFF event, relative to that after an ON event.
        waiting: Hazard before noise event n.
        bright: Uniform number that decides the polarity of noise event n >= 1.
        anew: Factors of the OFF and ON thresholds after the memory was set n times.
    """

    on: float
    off: float
    lead: float = 0.0
    falls: bool = False
    leak: float = 0.0
    period: float = 0.0
    delays: bool = False
    resets: bool = False
    spares_noise: bool = False
    after_off: float = 1.0
    waiting: Callable[[int], float] = lambda n: np.inf
    bright: Callable[[int], float] = lambda n: 0.0
    anew: Callable[[int], tuple[float, float]] = lambda n: (1.0, 1.0)

    def thresholds(self, memorised: int) -> tuple[float, float]:
        """Return the OFF and ON thresholds after the memory was set so many times."""
        off, on = self.anew(memorised)
        return max(self.off * off, 0.01), max(self.on * on, 0.01)

    def start(self, first: float, second: float) -> float:
        """Return what the pixel remembers at the first sample."""
        off, on = self.thresholds(0)
        if second < first or (second == first and self.falls):
            return first + self.lead * off
        return first - self.lead * on

    def crossing(self, begin: float, change: float, slope: float, memorised: int) -> tuple[float, float]:
        """Return when the change passes a threshold, at `begin` or later, and the signed threshold."""
        off, on = self.thresholds(memorised)
        if change >= on:
            return begin, on
        if change <= -off:
            return begin, -off
        if slope > 0:
            return begin + (on - change) / slope, on
        if slope < 0:
            return begin + (off + change) / -slope, -off
        return np.inf, 0.0

    def run(self, times: np.ndarray, signal: np.ndarray, rates: np.ndarray) -> np.ndarray:
        """Return the events of one pixel: rows of step, time [s], polarity, slope [1/s] (inf for noise).

        Args:
            times: Samples [s], shape (K,).
            signal: Log intensity at the samples, shape (K,); runs straight between them.
            rates: OFF and ON noise rates during the step that ends at a sample [Hz], shape (K, 2), at the
                pixel's mean thresholds; they follow those that it has when the step begins.
        """
        level = signal + self.leak * (times - times[0])
        memory = self.start(level[0], level[1])
        alive_from, held, hazard, drawn, memorised = -np.inf, False, self.waiting(0), 1, 0
        out: list[tuple[float, ...]] = []
        for k in range(1, len(times)):
            now, end = times[k - 1], times[k]
            low, high = self.thresholds(memorised)
            off_rate, on_rate = rates[k, 0] * self.off / low, rates[k, 1] * self.on / high
            total = off_rate + on_rate
            slope = (level[k] - level[k - 1]) / (end - now)
            noise = now + hazard / total if total > 0 else np.inf
            while True:
                if held and alive_from <= min(end, noise):
                    memory, held, now = level[k] + slope * (alive_from - end), False, alive_from
                look = max(now, alive_from) if self.delays else now
                change = level[k] + slope * (look - end) - memory
                crossing, theta = (np.inf, 0.0) if held else self.crossing(look, change, slope, memorised)
                now = min(crossing, noise)
                if now > end:
                    break
                alive = self.delays * (now == crossing) or now >= alive_from
                is_noise = now != crossing
                # of noise that is spared the dead time, what is held in reset memorises nothing
                sees = not held if self.spares_noise else alive
                if is_noise:
                    row = (k, now, float(self.bright(drawn) * total < on_rate), np.inf)
                    memory = level[k] + slope * (now - end) if sees else memory
                    noise, drawn = now + self.waiting(drawn) / total, drawn + 1
                else:
                    memory += theta
                    row = (k, now, float(theta > 0), abs(slope))
                memorised += not is_noise or sees
                if is_noise and self.spares_noise:
                    out.append(row)
                elif alive:
                    out.append(row)
                    alive_from = now + self.period * (1.0 if row[2] else self.after_off)
                    held = self.resets and alive_from > now
            hazard = (noise - end) * total if total > 0 else hazard
        return np.array(out, np.float64).reshape(-1, 4)


def thresholds(sensor: dase.Sensor, index: int, seed: int) -> tuple[float, float]:
    """Return the OFF and ON thresholds of a pixel [log intensity]."""
    spread = setting(sensor, "mismatch", "spread", 0.0)
    name = "mismatch_threshold_pixel_normal"
    on, off = (Stream(n, seed, index).normal() for n in (name, f"{name}_2"))
    nominal = np.array([sensor["threshold"].off, sensor["threshold"].on])
    if setting(sensor, "learned_threshold", "bound", None) is not None:
        learned = sensor["learned_threshold"]
        factor, scatter = learned.bound.reshape(2, -1)[:, index].astype(float)
        own = factor * (
            1 + scatter * Stream("learned_threshold_threshold_pixel_normal", seed, index).normal()
        )
        # so much of the way from 1 to what was learned
        nominal = np.maximum(nominal * ((1 - learned.strength) + learned.strength * own), 0.01)
    unit = nominal.mean() if setting(sensor, "mismatch", "relative_to", "own") == "mean" else nominal
    low, high = np.maximum(nominal + unit * spread * np.array([off, on]), 0.01).tolist()
    return low, high


def setting(sensor: dase.Sensor, effect: str, name: str, missing: Any) -> Any:
    """Return a parameter of an effect the sensor may lack."""
    return getattr(sensor[effect], name) if effect in sensor else missing


def detector(sensor: dase.Sensor, index: int, seed: int) -> Detector:
    """Return the change detector of one pixel."""
    off, on = thresholds(sensor, index, seed)
    names = (
        "initial_phase", "shot_noise", "shot_polarity", "leak_drift_pixel_normal",
        "refractory_gate_pixel_normal",
    )  # fmt: skip
    start, noise, polarity, leak, dead = (Stream(name, seed, index) for name in names)
    dead_spread = setting(sensor, "refractory", "spread", 0.0)
    rate, nominal_on = setting(sensor, "leak", "rate", 0.0), sensor["threshold"].on
    leaks = max(rate * (1 + setting(sensor, "leak", "spread", 0.0) * leak.normal()), 0.0) * nominal_on
    if setting(sensor, "hot", "mode", "noise") == "leak":
        hot = sensor["hot"]
        drawn, way, size = (
            Stream(f"hot_drift_pixel_{name}", seed, index) for name in ("uniform", "uniform_2", "normal")
        )
        if drawn.uniform(0) < hot.share:
            toward = nominal_on if way.uniform(0) < hot.balance else -sensor["threshold"].off
            leaks += hot.rate * np.exp(hot.spread * size.normal()) * toward
    jitter = setting(sensor, "jitter", "spread", 0.0)
    redraw = [Stream(f"jitter_redraw_{name}", seed, index) for name in ("normal_2", "normal")]
    return Detector(
        on=on,
        off=off,
        lead=sensor["threshold"].phase * start.uniform(0),
        falls=start.uniform(1) < 0.5,
        leak=leaks,
        period=setting(sensor, "refractory", "period", 0.0) * max(1 + dead.normal() * dead_spread, 0.0),
        after_off=setting(sensor, "refractory", "after_off", 1.0),
        delays=setting(sensor, "refractory", "mode", "drop") == "delay",
        resets=setting(sensor, "refractory", "mode", "drop") == "reset",
        spares_noise=setting(sensor, "refractory", "noise", "held") == "passes",
        waiting=noise.waiting,
        bright=polarity.uniform,
        anew=lambda n: tuple(1 + jitter * stream.normal(n) for stream in redraw) if jitter else (1.0, 1.0),
    )


def events(sensor: dase.Sensor, times: np.ndarray, intensity: np.ndarray, seed: int = 0) -> list[np.ndarray]:
    """Return the events of every pixel as `Detector.run` does.

    Args:
        sensor: Its built-in effects.
        times: Samples [s], shape (K,).
        intensity: Linear intensity, shape (K, N).
        seed: Of every random number.
    """
    intensity = np.asarray(intensity, np.float64)
    light = np.clip(intensity, 0, 1)
    level = np.log(intensity + sensor.log_eps)
    cutoff, dark = (setting(sensor, "bandwidth", name, np.inf) for name in ("cutoff", "dark"))
    if np.isfinite(cutoff):
        level = lowpass(times, level, cutoff * (dark + (1 - dark) * light))
    rate, bright = (setting(sensor, "shot", name, 0.0) for name in ("rate", "bright"))
    balance = setting(sensor, "shot", "balance", 0.5)
    knee = setting(sensor, "shot", "knee", np.inf)
    total = rate * (bright + (1 - bright) * (1 - light) / (1 + light / knee) ** 2)
    rates = np.stack([total * (1 - balance), total * balance], -1)
    spread = setting(sensor, "shot", "spread", 0.0)
    drawn = [Stream("shot_noise_pixel_normal", seed, i).normal() for i in range(intensity.shape[1])]
    rates *= np.exp(spread * (np.array(drawn) - spread / 2))[:, None]
    nominal = np.array([sensor["threshold"].off, sensor["threshold"].on])
    own = np.array([thresholds(sensor, i, seed) for i in range(intensity.shape[1])])
    rates *= nominal / own
    return [detector(sensor, i, seed).run(times, level[:, i], rates[:, i]) for i in range(intensity.shape[1])]


def only(*effects: dase.Effect, mode: str = "reset", log_eps: float = 1e-3) -> dase.Sensor:
    """Return a sensor with these effects and the common ones switched off: one kernel serves many tests."""
    every = {name: dase.EFFECTS[name].identity() for name in COMMON}
    every["refractory"] = dase.EFFECTS["refractory"](period=0.0, mode=mode)
    every |= {effect.name: effect for effect in effects}
    return dase.Sensor(effects=tuple(every[name] for name in dase.EFFECTS if name in every), log_eps=log_eps)


COMMON = ("threshold", "mismatch", "bandwidth", "leak", "shot", "refractory")
"""Effects that the twin knows."""


class LogScene(dase.Scene):
    """Log intensities at given times, so that a test need not care how a logarithm is rounded."""

    def __init__(self, values: np.ndarray, times: np.ndarray):
        self.values, self.times = np.asarray(values, np.float32), np.asarray(times, np.float64)
        self.height, self.width = self.values.shape[1:]
        self.duration = float(self.times[-1] - self.times[0])

    def sample_times(self) -> np.ndarray:
        return self.times

    def source(self, times: np.ndarray, pixels: np.ndarray, device: Any) -> tuple[str, Any]:
        source = composer.Frames()
        rows = self.values[np.searchsorted(self.times, times)].reshape(len(times), -1)
        source.values = wp.array(np.ascontiguousarray(rows[:, pixels]), dtype=float, device=device)
        return "log", source

    def frames(self, times: np.ndarray, device: str = "cpu") -> np.ndarray:
        return np.exp(self.values[np.searchsorted(self.times, times)])


def quantities(motion: dase.Motion, time: float, duration: float) -> dict[str, float]:
    """Return x, y, angle and scales of a motion at a time, pauses taken out of it."""
    awake = time
    for begin, end in motion.pauses:
        awake -= max(min(time, end) - begin, 0.0)
    share = awake / duration
    pairs = {name: getattr(motion, name) for name in ("x", "y", "angle", "scale_x", "scale_y")}
    at = {name: (1 - share) * pair[0] + share * pair[1] for name, pair in pairs.items()}
    for wave in motion.waves:
        turns = wave.frequency * awake + wave.phase / (2 * np.pi)
        at[wave.quantity] += wave.amplitude * np.sin(2 * np.pi * turns)
    return at


def turned(at: dict[str, float]) -> np.ndarray:
    """Return the linear part of a motion: scaled, then rotated."""
    turn = np.array([[np.cos(at["angle"]), -np.sin(at["angle"])], [np.sin(at["angle"]), np.cos(at["angle"])]])
    return turn @ np.diag([at["scale_x"], at["scale_y"]])


def pose(scene: dase.LayerScene, number: int, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return linear part [px/texel], centre on the sensor [px] and centre of the texture [texel]."""
    layer = scene.layers[number]
    at = quantities(layer.motion, time, scene.duration)
    h, w = layer.picture.grey.shape
    unit = max(w, h) if number else min(w, h * scene.width / scene.height)
    linear = scene.width / unit * turned(at)
    middle = np.array([scene.width - 1, scene.height - 1]) / 2
    centre = middle + scene.width * np.array([at["x"], at["y"]])
    if scene.camera is not None:
        view = quantities(scene.camera, time, scene.duration)
        centre = middle + turned(view) @ (centre - middle) + scene.width * np.array([view["x"], view["y"]])
        linear = turned(view) @ linear
    return linear, centre, np.array([w - 1, h - 1]) / 2


def to_texture(scene: dase.LayerScene, number: int, time: float, points: np.ndarray) -> np.ndarray:
    """Return texel coordinates of sensor points, shape (..., 2)."""
    linear, centre, middle = pose(scene, number, time)
    return (points - centre) @ np.linalg.inv(linear).T + middle


def to_sensor(scene: dase.LayerScene, number: int, time: float, texels: np.ndarray) -> np.ndarray:
    """Return sensor coordinates of texels, shape (..., 2)."""
    linear, centre, middle = pose(scene, number, time)
    return (texels - middle) @ linear.T + centre


def bilinear(texture: np.ndarray, at: np.ndarray, *, reflects: bool) -> np.ndarray:
    """Return texture values between texels; outside reflected about the outermost texels, or 0."""
    h, w = texture.shape
    corner = np.floor(at).astype(int)
    part = at - corner
    out = np.zeros(at.shape[:-1])
    for right in (0, 1):
        for below in (0, 1):
            u, v = corner[..., 0] + right, corner[..., 1] + below
            weight = np.abs(1 - right - part[..., 0]) * np.abs(1 - below - part[..., 1])
            inside = (u >= 0) & (v >= 0) & (u < w) & (v < h) | reflects
            out += weight * inside * texture[mirrored(v, h), mirrored(u, w)]
    return out


def mirrored(index: np.ndarray, length: int) -> np.ndarray:
    """Return indices reflected as in 2 1 0 1 2 1 0: the outermost is not repeated."""
    cycle = [*range(length), *range(length - 2, 0, -1)]
    return np.array(cycle)[index % len(cycle)]


def grid(scene: dase.LayerScene) -> np.ndarray:
    """Return the pixel centres, shape (H, W, 2) of x, y."""
    return np.stack(np.meshgrid(np.arange(scene.width), np.arange(scene.height)), -1).astype(float)


def covers(scene: dase.LayerScene, number: int, time: float) -> np.ndarray:
    """Return the opacity of a layer at every pixel."""
    grey, alpha = scene.layers[number].picture.grey, scene.layers[number].picture.alpha
    if number == 0:
        return np.ones((scene.height, scene.width))
    opacity = np.ones_like(grey) if alpha is None else alpha
    return bilinear(opacity, to_texture(scene, number, time, grid(scene)), reflects=False)


def frame(scene: dase.LayerScene, time: float) -> np.ndarray:
    """Return the picture at a time, layers painted back to front."""
    out = np.zeros((scene.height, scene.width))
    for number, layer in enumerate(scene.layers):
        grey, alpha = layer.picture.grey, layer.picture.alpha
        paint = grey if alpha is None or number == 0 else grey * alpha
        light = bilinear(paint, to_texture(scene, number, time, grid(scene)), reflects=number == 0)
        out = light + (1 - covers(scene, number, time)) * out
    return out if scene.lighting is None else out * brightness(scene.lighting, time)


def brightness(lighting: dase.Lighting, time: float) -> float:
    """Return the factor of a light that sways and drops."""
    stops = -0.5 * lighting.stops * (1 + np.sin(2 * np.pi * lighting.frequency * time + lighting.phase))
    stops += sum(drop for at, drop in lighting.drops if time >= at)
    return float(2.0**stops)


def flow(scene: dase.LayerScene, time: float, step: float = 1e-6) -> np.ndarray:
    """Return the velocity of the foremost visible layer by central differences [px/s], shape (2, H, W)."""
    out = np.zeros((scene.height, scene.width, 2))
    for number in range(len(scene.layers)):
        texels = to_texture(scene, number, time, grid(scene))
        later, sooner = (to_sensor(scene, number, time + s, texels) for s in (step, -step))
        seen = covers(scene, number, time) > 0
        out[seen] = ((later - sooner) / (2 * step))[seen]
    return np.moveaxis(out, -1, 0)
