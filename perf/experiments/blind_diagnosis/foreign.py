"""Small simulators in NumPy whose habits differ from dase's: a development set of worlds slightly off.

Three kinds of them, after what other simulators do, and habits that are drawn for each:

- *frames* (as v2e): from frame to frame; several events of a pixel between two frames are spread evenly, and
  each takes its turn at the dead time; intensities may be linear below a knee; a low-pass goes in steps of a
  frame and may follow the light; leak moves the memory once a frame, and noise is drawn once a frame.
- *lines* (as ESIM): the logarithm goes in straight lines between frames, crossings are exact on them, and
  events in the dead time are lost while the memory follows.
- *circuit*: a tenth of a frame at a time; the low-pass works on the light before the logarithm; an event sets
  the memory to the level of the moment, as does the end of the dead time.

The clips may be of fewer frames, with a lamp in them. Nothing of it is shared with dase's kernels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Part = tuple[Array, Array, Array, Array]

HIDEABLE: dict[str, tuple[float, float]] = {
    "bandwidth": (25.0, 150.0), "leak": (0.5, 6.0), "shot": (2.0, 30.0), "mismatch": (0.08, 0.3),
    "refractory": (2e-3, 15e-3),
}  # fmt: skip
"""Effects that all have, and the ends of their strengths: cutoff, rates [Hz], share of a threshold, [s]."""


@dataclass(frozen=True)
class Habits:
    """What a world does otherwise.

    Args:
        style: `frames`, `lines` or `circuit`.
        knee: Intensity below which the response is linear; 0 for none.
        even: Whether events between two frames are spread evenly; else their times are interpolated.
        follows: Whether the cutoff of the low-pass is proportional to the light.
        tick: Of the time stamps [s].
        floor: Added to intensities before the logarithm.
        waits: Whether a crossing in the dead time comes later; else it is lost.
        lamp: Swing of the light in the middle of a lamp's spot in the clip, at 100 or 120 Hz; 0 for none.
        every: Which of the frames of a clip are simulated: each, every second one.
    """

    style: str
    knee: float
    even: bool
    follows: bool
    tick: float
    floor: float
    waits: bool
    lamp: float
    every: int

    def named(self) -> set[str]:
        """Return the effects of dase that this world does have by habit, and that may be named."""
        out = {"timestamp"} if self.style != "lines" or self.tick > 1e-6 else set[str]()
        if self.knee:
            out |= {"linlog"}
        return out | {"linlog", "dark"} if self.floor > 2e-3 else out


def draw_habits(rng: np.random.Generator) -> Habits:
    """Draw the habits of one world."""
    style = str(rng.choice(["frames", "frames", "lines", "circuit"]))
    return Habits(
        style=style,
        knee=float(rng.choice([0.0, 10 / 255, 20 / 255])) if style == "frames" else 0.0,
        even=bool(rng.integers(2)),
        follows=bool(rng.integers(2)),
        tick=float(rng.choice([1e-6, 1e-5])),
        floor=float(rng.choice([1e-3, 4e-3])),
        waits=bool(rng.integers(2)) and style == "frames",
        lamp=float(rng.choice([0.0, 0.0, 0.15, 0.3])),
        every=int(rng.choice([1, 1, 2])),
    )


def clip_of(frames: Array, times: Array, habits: Habits, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return the clip that is simulated and handed over: frames of 8 bits, (T, H, W), and their times."""
    wave = np.sin(2 * np.pi * (rng.choice([100.0, 120.0]) * times + rng.uniform()))
    rows, columns = np.mgrid[: frames.shape[1], : frames.shape[2]] / frames.shape[2]
    x, y, width = rng.uniform((0.2, 0.2, 0.1), (0.8, 0.6, 0.3))
    spot = np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * width**2))
    lit = frames * (1 + habits.lamp * wave[:, None, None] * spot)
    lit, times = lit[:: habits.every], times[:: habits.every]
    return np.rint(255 * lit / lit.max()) / 255, times


def simulate(
    frames: Array, times: Array, on: float, off: float, effects: dict[str, float], habits: Habits, seed: int
) -> Any:
    """Return the events of frames of light.

    Args:
        frames: Linear intensities, shape (T, H, W).
        times: Of the frames [s], shape (T,).
        on: ON threshold [log intensity].
        off: OFF threshold.
        effects: Name to strength, of `HIDEABLE`.
        habits: Of this world.
        seed: Of all random numbers.
    """
    import dase

    rng = np.random.default_rng([seed, 77])
    size = frames.shape[1:]
    spread = effects.get("mismatch", 0.0)
    high, low = (np.maximum(th * (1 + spread * rng.standard_normal(size)), 0.02) for th in (on, off))
    run = {"frames": _in_frames, "lines": _in_lines, "circuit": _as_circuit}[habits.style]
    parts = run(frames, times, high, low, effects, habits, rng)
    t, x, y, p = (np.concatenate(part) for part in zip(*parts, strict=True))
    t = np.round(t / habits.tick) * habits.tick
    order = np.argsort(t, kind="stable")
    t, x, y, p = (part[order] for part in (t, x, y, p))
    return dase.Events(t, x.astype(np.uint16), y.astype(np.uint16), p, size[1], size[0])


def _in_frames(
    frames: Array, times: Array, high: Array, low: Array, effects: dict[str, float], habits: Habits,
    rng: np.random.Generator,
) -> list[Part]:  # fmt: skip
    level = _response(frames[0], habits)
    memory, filtered, ready = level.copy(), level.copy(), np.full(level.shape, -1.0)
    dead, out = effects.get("refractory", 0.0), list[Part]()
    for begin, end, frame in zip(times[:-1], times[1:], frames[1:], strict=True):
        step = end - begin
        before, target = filtered, _response(frame, habits)
        filtered = target
        if "bandwidth" in effects:
            cutoff = effects["bandwidth"] * ((frame + 0.05) / 1.05 if habits.follows else 1.0)
            filtered = before + (target - before) * (1 - np.exp(-2 * np.pi * cutoff * step))
        memory -= effects.get("leak", 0.0) * high * step
        for sign, threshold in ((1, high), (-1, low)):
            count = np.floor(np.maximum(sign * (filtered - memory), 0) / threshold).astype(int)
            most, start = int(count.max(initial=0)), memory.copy()
            for n in range(most):
                y, x = np.nonzero(count > n)
                share = (n + 1) / (count[y, x] + 1)
                if not habits.even:
                    change = filtered[y, x] - before[y, x]
                    way = start[y, x] + (n + 1) * sign * threshold[y, x] - before[y, x]
                    share = np.clip(np.divide(way, change, out=share, where=np.abs(change) > 1e-9), 0, 1)
                when = begin + share * step
                sent = when >= ready[y, x]
                moved = sent if habits.waits else np.ones_like(sent)
                memory[y[moved], x[moved]] += sign * threshold[y[moved], x[moved]]
                when, x, y = when[sent], x[sent], y[sent]
                ready[y, x] = when + dead
                out.append((when, x, y, np.full(len(x), sign > 0)))
        if "shot" in effects:
            out.append(_shot(effects["shot"] * step, begin, step, memory, filtered, rng))
    return out


def _in_lines(
    frames: Array, times: Array, high: Array, low: Array, effects: dict[str, float], habits: Habits,
    rng: np.random.Generator,
) -> list[Part]:  # fmt: skip
    # a hundredth of a line at a time would be the same: crossings are exact, and the dead time knows them
    straight = Habits(**{**habits.__dict__, "even": False, "waits": False, "knee": 0.0})
    return _in_frames(frames, times, high, low, effects, straight, rng)


def _as_circuit(
    frames: Array, times: Array, high: Array, low: Array, effects: dict[str, float], habits: Habits,
    rng: np.random.Generator, steps: int = 10,
) -> list[Part]:  # fmt: skip
    light = frames[0].copy()
    memory, ready = np.log(light + habits.floor), np.full(light.shape, -1.0)
    held, out = np.zeros(light.shape, bool), list[Part]()
    dead = max(effects.get("refractory", 0.0), 1e-6)
    for n in range((len(times) - 1) * steps):
        k, part = divmod(n, steps)
        step = (times[k + 1] - times[k]) / steps
        now = times[k] + (part + 1) * step
        target = frames[k] + (frames[k + 1] - frames[k]) * ((part + 1) / steps)
        if "bandwidth" in effects:
            cutoff = effects["bandwidth"] * ((light + 0.05) / 1.05 if habits.follows else 1.0)
            light = light + (target - light) * (1 - np.exp(-2 * np.pi * cutoff * step))
        else:
            light = target
        volts = np.log(light + habits.floor)
        memory -= effects.get("leak", 0.0) * high * step
        freed = held & (now >= ready)
        memory[freed], held[freed] = volts[freed], False
        for sign, threshold in ((1, high), (-1, low)):
            y, x = np.nonzero((sign * (volts - memory) >= threshold) & ~held)
            memory[y, x], ready[y, x], held[y, x] = volts[y, x], now + dead, "refractory" in effects
            out.append((now - step * rng.random(len(x)), x, y, np.full(len(x), sign > 0)))
        if "shot" in effects:
            out.append(_shot(effects["shot"] * step, now - step, step, memory, volts, rng))
    return out


def _shot(
    chance: float, begin: float, step: float, memory: Array, level: Array, rng: np.random.Generator
) -> Part:
    """Return events at random, after which the memory is where the level is."""
    y, x = np.nonzero(rng.random(level.shape) < chance)
    memory[y, x] = level[y, x]
    return begin + rng.random(len(x)) * step, x, y, rng.random(len(x)) < 0.5


def _response(frame: Array, habits: Habits) -> Array:
    light = np.asarray(frame, np.float64)
    if not habits.knee:
        return np.log(light + habits.floor)
    return np.where(
        light < habits.knee,
        light / habits.knee * np.log(255 * habits.knee),
        np.log(255 * np.maximum(light, 1e-9)),
    )
