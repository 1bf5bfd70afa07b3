"""Twins in NumPy of the kernels that render between two frames, and a camera that takes exposed frames."""

from __future__ import annotations

import numpy as np

import dase


def bilinear(ways, at):
    """Ways (H, W, 2) at places (N, 2), x then y, constant beyond the border."""
    height, width = ways.shape[:2]
    x, y = np.clip(at[:, 0], 0, width - 1), np.clip(at[:, 1], 0, height - 1)
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    out = np.zeros((len(at), 2))
    for dy in (0, 1):
        for dx in (0, 1):
            weight = np.abs(1 - dx - (x - x0)) * np.abs(1 - dy - (y - y0))
            out += weight[:, None] * ways[np.minimum(y0 + dy, height - 1), np.minimum(x0 + dx, width - 1)]
    return out


def catmull_rom(distance):
    """Keys' cubic convolution with a = -1/2, as a function of the distance."""
    d = np.abs(distance)
    return np.where(
        d < 1, 1.5 * d**3 - 2.5 * d**2 + 1, np.where(d < 2, -0.5 * d**3 + 2.5 * d**2 - 4 * d + 2, 0)
    )


def bicubic(values, at):
    """Values (H, W) at places (N, 2), constant beyond the border."""
    height, width = values.shape
    x, y = np.clip(at[:, 0], 0, width - 1), np.clip(at[:, 1], 0, height - 1)
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    out = np.zeros(len(at))
    for dy in range(-1, 3):
        for dx in range(-1, 3):
            weight = catmull_rom(x - x0 - dx) * catmull_rom(y - y0 - dy)
            out += weight * values[np.clip(y0 + dy, 0, height - 1), np.clip(x0 + dx, 0, width - 1)]
    return out


def origin(ways, share, pixels, steps):
    """Place (N, 2) from which each pixel's content came."""
    p = pixels - share * bilinear(ways, pixels)
    for _ in range(steps):
        p = pixels - share * bilinear(ways, p)
    return p


def seen(shape, at):
    """Weight of a look at a place (N, 2): 1 inside, less over a pixel beyond the border."""
    beyond = np.maximum(-at, at - np.array(shape[::-1]) + 1).max(1)
    return np.clip(1 - beyond, 1e-3, 1)


def blend(first, second, ahead, back, share, pixels, steps, eps):
    """Linear intensity of pixels (N, 2) at a share of the time between two frames."""
    p, q = origin(ahead, share, pixels, steps), origin(back, 1 - share, pixels, steps)
    a, b = (1 - share) * seen(first.shape, p), share * seen(first.shape, q)
    level = a * bicubic(np.log(first + eps), p) + b * bicubic(np.log(second + eps), q)
    return np.maximum(np.exp(level / (a + b)) - eps, 0)


def moving_picture(rng, *, width=200, height=150, duration=0.2, speed=1.0, objects=2):
    """A photograph under two cut-outs; the background moves by 0.3 widths a second, objects up to 1."""
    images = dase.open_images("builtin")
    way = speed * duration
    zoom = {"scale_x": (1.2, 1.2), "scale_y": (1.2, 1.2)}
    ground = dase.Motion(x=(0, 0.3 * way), y=(0, 0.1 * way), angle=(0, 0.2 * way), **zoom)
    layers = [dase.Layer(images.background(rng), ground)]
    for _ in range(objects):
        (x, y), angle = rng.uniform(-0.3, 0.3, 2), rng.uniform(0, 2 * np.pi)
        far = way * rng.uniform(0.3, 1.0)
        layers.append(
            dase.Layer(
                images.foreground(rng),
                dase.Motion(
                    x=(x, x + far * np.cos(angle)),
                    y=(0.7 * y, 0.7 * y + far * np.sin(angle)),
                    scale_x=(0.35, 0.35),
                    scale_y=(0.35, 0.35),
                ),
            )
        )
    return dase.LayerScene(layers, width=width, height=height, duration=duration)


def film(scene, rng, *, rate=25.0, exposure=0.01, noise=0.0, looks=16):
    """Frames of a camera before a scene: begin, end [s] and uint8 frames, each the mean over its exposure."""
    begin = np.arange(0, scene.duration - exposure + 1e-9, 1 / rate)
    inside = begin[:, None] + exposure * (np.arange(looks) + 0.5) / looks
    mean = np.stack([scene.frames(times).mean(0) for times in inside])
    mean = mean + noise * rng.standard_normal(mean.shape)
    return begin, begin + exposure, np.clip(np.rint(255 * mean), 0, 255).astype(np.uint8)
