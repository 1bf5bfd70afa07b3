"""A small simulator in NumPy whose habits differ from dase's: a development set of worlds slightly off.

It goes from frame to frame: several events of a pixel between two frames may be spread evenly; intensities
may be mapped linearly below a knee; time stamps are rounded; a low-pass is taken in steps of a frame and may
follow the light; leak moves the memory once a frame, and noise is drawn once a frame. Nothing of it is shared
with dase's kernels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

HIDEABLE: dict[str, tuple[float, float]] = {
    "bandwidth": (25.0, 150.0), "leak": (0.5, 6.0), "shot": (2.0, 30.0), "mismatch": (0.08, 0.3),
    "refractory": (2e-3, 15e-3),
}  # fmt: skip
"""Effects that it has and the ends of their strengths: cutoff, rates [Hz], share of a threshold, time [s]."""


@dataclass(frozen=True)
class Habits:
    """What it does otherwise.

    Args:
        knee: Intensity below which the response is linear; 0 for none.
        even: Whether events between two frames are spread evenly; else their times are interpolated.
        follows: Whether the cutoff of the low-pass is proportional to the light.
        tick: Of the time stamps [s].
        floor: Added to intensities before the logarithm.
    """

    knee: float
    even: bool
    follows: bool
    tick: float
    floor: float


def draw_habits(rng: np.random.Generator) -> Habits:
    """Draw the habits of one world."""
    return Habits(
        knee=float(rng.choice([0.0, 10 / 255, 20 / 255])),
        even=bool(rng.integers(2)),
        follows=bool(rng.integers(2)),
        tick=float(rng.choice([1e-6, 1e-5])),
        floor=float(rng.choice([1e-3, 4e-3])),
    )


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
    level = _response(frames[0], habits)
    memory, filtered, ready = level.copy(), level.copy(), np.zeros(size)
    out: list[tuple[Array, Array, Array, Array]] = []
    for begin, end, frame in zip(times[:-1], times[1:], frames[1:], strict=True):
        step = end - begin
        before, target = filtered.copy(), _response(frame, habits)
        if "bandwidth" in effects:
            cutoff = effects["bandwidth"] * ((frame + 0.05) / 1.05 if habits.follows else 1.0)
            filtered = filtered + (target - filtered) * (1 - np.exp(-2 * np.pi * cutoff * step))
        else:
            filtered = target
        memory -= effects.get("leak", 0.0) * on * step
        for sign, threshold in ((1, high), (-1, low)):
            count = np.floor(np.maximum(sign * (filtered - memory), 0) / threshold).astype(int)
            for n in range(int(count.max(initial=0))):
                y, x = np.nonzero(count > n)
                share = (n + 1) / (count[y, x] + 1)
                if not habits.even:
                    change = filtered[y, x] - before[y, x]
                    level_there = memory[y, x] + sign * threshold[y, x]
                    usable = np.abs(change) > 1e-9
                    exact = np.divide(level_there - before[y, x], change, out=share.copy(), where=usable)
                    share = np.clip(exact, 0, 1)
                memory[y, x] += sign * threshold[y, x]
                out.append((begin + share * step, x, y, np.full(len(x), sign > 0)))
        if "shot" in effects:
            y, x = np.nonzero(rng.random(size) < effects["shot"] * step)
            out.append((begin + rng.random(len(x)) * step, x, y, rng.random(len(x)) < 0.5))
            memory[y, x] = filtered[y, x]
    t, x, y, p = (np.concatenate(part) for part in zip(*out, strict=True))
    t = np.round(t / habits.tick) * habits.tick
    order = np.argsort(t, kind="stable")
    t, x, y, p = (part[order] for part in (t, x, y, p))
    if "refractory" in effects:
        kept = np.zeros(len(t), bool)
        for n, (when, row, column) in enumerate(zip(t, y, x, strict=True)):
            kept[n] = when >= ready[row, column]
            if kept[n]:
                ready[row, column] = when + effects["refractory"]
        t, x, y, p = (part[kept] for part in (t, x, y, p))
    return dase.Events(t, x.astype(np.uint16), y.astype(np.uint16), p, size[1], size[0])


def _response(frame: Array, habits: Habits) -> Array:
    light = np.asarray(frame, np.float64)
    if not habits.knee:
        return np.log(light + habits.floor)
    return np.where(
        light < habits.knee,
        light / habits.knee * np.log(255 * habits.knee),
        np.log(255 * np.maximum(light, 1e-9)),
    )
