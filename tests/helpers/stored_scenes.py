"""Scenes of every kind that the counting kernels know, with light that was drawn at random."""

from __future__ import annotations

import numpy as np
import warp as wp

from dase.kernels import pixel_stages
from dase.scenes.image_sources import open_images
from dase.scenes.layers import Layer, LayerScene, Motion
from dase.scenes.scene import Scene


class Stored(Scene):
    """Random walks of log intensity, given as such or as intensities."""

    def __init__(self, kind, rng, device, samples=40, size=(13, 11)):
        self.kind, (self.height, self.width) = kind, size
        walk = np.cumsum(rng.normal(0, 0.1, (samples, size[0] * size[1])), 0) - 2
        walk = walk if kind == "log" else np.exp(np.minimum(walk, 0))
        self.values = walk.astype(np.float32)
        self.device, self.duration = device, 1e-3 * samples

    def sample_times(self):
        return 1e-3 * np.arange(len(self.values))

    def source(self, times, pixels, device):
        source = pixel_stages.Frames()
        rows = np.rint(times * 1e3).astype(int)
        values = np.ascontiguousarray(self.values[rows][:, pixels])
        source.values = wp.array(values, dtype=float, device=device)
        return self.kind, source

    def frames(self, times, device="cpu"):
        raise NotImplementedError


def layers(rng, objects):
    images = open_images("builtin")
    stack = [Layer(images.background(rng), Motion(x=(0, 0.3), angle=(0, 0.4)))]
    for _ in range(objects):
        x, y = rng.uniform(-0.3, 0.3, 2)
        motion = Motion(x=(x, -x), y=(y, y), scale_x=(0.3, 0.4), scale_y=(0.4, 0.3))
        stack.append(Layer(images.foreground(rng), motion))
    return LayerScene(stack, width=37, height=23, duration=0.05, shortest=1e-3, longest=1e-3)


def scene_of(kind, rng, device):
    if kind in ("log", "frames"):
        return Stored(kind, rng, device)
    return layers(rng, {"background": 0, "layers": 3}[kind])
