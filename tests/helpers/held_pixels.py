"""Pixels over the held frames of a clip, exactly; shares nothing with dase's kernels."""

from __future__ import annotations

import numpy as np
from helpers.frame_simulator import HEIGHT, WIDTH

from dase.events import Events
from dase.scenes.video import VideoScene


def held_with_low_pass(
    scene: VideoScene,
    *,
    cutoff: float = np.inf,
    late: float = 0.0,
    dead: float = 0.0,
    threshold: float = 0.2,
    spread: float = 0.0,
    own: bool = False,
    stamps: float = 0.0,
    goes_on: bool = False,
) -> Events:
    """Return events of frames that are held, each from the one before on, exactly: e-functions, one by one.

    After an event a pixel waits until that is out and for the dead time, and takes what it sees then for its
    memory.

    Args:
        scene: Frames of light.
        cutoff: Of a low-pass, at intensity 1 and as much lower as light is [Hz].
        late: From the crossing to the event [s].
        dead: From the event on [s].
        threshold: ON and OFF [log intensity].
        spread: By which that differs, relative.
        own: Whether a pixel keeps its threshold; else it has another after each event.
        stamps: By which the time of an event is off [s].
        goes_on: Whether it does not wait, and takes what it sends for.
    """
    times = scene.sample_times()
    light = scene.frames(times).astype(np.float64) + 1e-3
    value = np.log(light[0])
    memory, free = value.copy(), np.zeros(value.shape)
    rng = np.random.default_rng(5)
    size = threshold * (1 + spread * rng.standard_normal(value.shape))
    out = []
    for begin, end, now in zip(times[:-1], times[1:], light[1:], strict=True):
        target = np.log(now)
        rate = 2 * np.pi * min(cutoff, 1e7) * now
        at = np.full(value.shape, begin)
        todo = free < end
        while todo.any():
            # memories are taken anew where a pixel becomes free within this frame
            fresh = todo & (free > at)
            seen = target + (value - target) * np.exp(-rate * (np.maximum(free, at) - begin))
            memory[fresh] = seen[fresh]
            at = np.where(fresh, free, at)
            goal = memory + np.sign(target - memory) * size
            left = (goal - target) / np.where(value == target, np.inf, value - target)
            ok = todo & (np.abs(target - memory) > size) & (left > 0)
            cross = np.where(ok, begin - np.log(np.where(ok, left, 1.0)) / rate, np.inf)
            sends = ok & (cross < end)
            y, x = np.nonzero(sends)
            t = np.maximum(cross[y, x], at[y, x])
            off = stamps * rng.standard_normal(len(t)) if stamps else 0.0
            out.append((t + late + off, x, y, target[y, x] > memory[y, x]))
            if spread and not own:
                size[y, x] = threshold * (1 + spread * rng.standard_normal(len(t)))
            at[y, x] = t
            if goes_on:
                memory[y, x] = goal[y, x]
            else:
                free[y, x] = t + late + dead + 1e-6
            todo = sends & (free < end)
        value = target + (value - target) * np.exp(-rate * (end - begin))
    t, x, y, p = (np.concatenate(part) for part in zip(*out, strict=True))
    order = np.argsort(t, kind="stable")
    t = np.round(1e6 * t[order]) / 1e6
    return Events(t, x[order], y[order], p[order], WIDTH, HEIGHT)
