"""OpenEB's `GPUEventSimulator` making batches of voxel grids, for `training_batches` to stand beside.

It is called as OpenEB's own training calls it (`event_to_video/gpu_esim.py`): a low-pass of 8-bit pictures,
then grids of a sequence of windows. The pictures are those that the first batch of the stream shows at its
samples. They lie on the device before the clock runs: its time lacks scenes and labels, which a stream makes
in its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import torch

import dase
from dase.torch.stream import BatchMaker
from perf.benchmarks.peer_worker import find_openeb

MULTIPLES = (1, 4)
"""So many times the slots of the stream: on a GPU more may be faster."""


def nearest_settings(sensor: dase.Sensor) -> dict[str, Any]:
    """Return what OpenEB's simulator takes, as near to a sensor as it goes.

    Thresholds alone differ over pixels. Its shot noise falls with light, its leak is in thresholds of ON, its
    low-pass has two poles, whose corner falls in the dark as v2e's does. It knows no spread of noise, no hot
    pixels and no readout.
    """

    def value(effect: str, parameter: str) -> float:
        found = float(getattr(sensor[effect], parameter)) if effect in sensor else 0.0
        return found if math.isfinite(found) else 0.0

    on, off = value("threshold", "on"), value("threshold", "off")
    return {
        "c_mu": [off, on],
        "c_std": round(value("mismatch", "spread") * (on + off) / 2, 6),
        "refractory_period": round(1e6 * value("refractory", "period")),
        "leak_rate_hz": value("leak", "rate"),
        "cutoff_hz": value("bandwidth", "cutoff"),
        "shot_noise_hz": value("shot", "rate"),
    }


def film_stream(stream: dase.torch.Stream) -> torch.Tensor:
    """Return what a stream's first batch shows at its samples, 8-bit, shape (H, W, B, T * samples)."""
    plan = stream.plan
    each = dase.torch.Stream(
        stream.images, stream.sensor, batch=plan.batch, steps=stream.steps * stream.samples, size=plan.size,
        window=plan.window / stream.samples, samples=1, represent=dase.EventFrame(), device=stream.device,
        seed=stream.seed, regimes=plan.regimes, backgrounds=stream.backgrounds, objects=stream.objects,
        renew=stream.renew,
    )  # fmt: skip
    maker = BatchMaker(each)
    frames = maker.make(0).frames
    maker.close()
    return frames.mul_(255).round_().byte()[:, :, 0].permute(2, 3, 1, 0).contiguous()


class OpenebBatches:
    """Makes the same batch over and over.

    Args:
        simulator: Class of OpenEB's simulator.
        stream: The batch is one of its first, the voxels have as many bins.
        pictures: What it shows, see `film_stream`.
        slots: How many, a multiple of those of the pictures.
        windows: How many windows a call makes; the batch takes as many calls as that needs.
    """

    def __init__(
        self, simulator: Any, stream: dase.torch.Stream, pictures: torch.Tensor, *, slots: int, windows: int
    ):
        (height, width), samples, device = pictures.shape[:2], stream.samples, stream.device
        self.simulator = simulator(slots, height, width, **nearest_settings(stream.sensor)).to(device)
        self.log_eps, self.bins = stream.sensor.log_eps, stream.represent.channels
        self.parts = []
        for first in range(0, stream.steps, windows):
            last = min(first + windows, stream.steps)
            part = pictures[..., first * samples : last * samples].repeat(1, 1, slots // pictures.shape[2], 1)
            length = torch.full((slots,), part.shape[3], dtype=torch.int32, device=device)
            window = 1e6 * stream.plan.window  # it wants microseconds
            times = torch.arange(first * samples + 1, last * samples + 1) * (window / samples)
            edges = torch.arange(first, last + 1) * window
            begins = torch.full((slots,), float(first == 0), device=device)
            clocks = [one.repeat(slots, 1).to(device) for one in (times.float(), edges.long())]
            self.parts.append((part.flatten(2), length, *clocks, begins))

    def make(self, _: int = 0) -> list[torch.Tensor]:
        """Return grids, each of shape (windows, slots, bins, H, W)."""
        grids = []
        for pictures, length, times, edges, begins in self.parts:
            levels = self.simulator.dynamic_moving_average(pictures, length, times, begins, eps=self.log_eps)
            grids.append(
                self.simulator.event_volume_sequence(levels, length, times, edges, begins, self.bins)
            )
        return grids


def measure_openeb(
    path: Path, stream: dase.torch.Stream, seconds_each: Callable[[Callable[[int], Any]], float]
) -> list[dict[str, Any]]:
    """Return how fast OpenEB's simulator makes batches like a stream's, all windows at once and one by one.

    Args:
        path: Checkout of OpenEB, or folder of its Python.
        stream: With `dase.Voxels`.
        seconds_each: Returns how long a call takes [s], warm, and with the device done.
    """
    find_openeb(path)
    simulator = import_module("metavision_core_ml.video_to_event.gpu_simulator").GPUEventSimulator
    pictures, rows = film_stream(stream), []
    for multiple in MULTIPLES if stream.device.type == "cuda" else MULTIPLES[:1]:
        for at_once in (stream.steps, 1):
            slots = multiple * stream.plan.batch
            batches = OpenebBatches(simulator, stream, pictures, slots=slots, windows=at_once)
            each = seconds_each(batches.make)
            windows, pixels = stream.steps * slots, stream.plan.size[0] * stream.plan.size[1]
            mass = sum(float(grids.abs().sum()) for grids in batches.make())
            rows.append({
                "slots": slots,
                "windows_at_once": at_once,
                "batch_ms": round(1e3 * each, 2),
                "windows_per_s": round(windows / each),
                "Gsample_per_s": round(1e-9 * windows * stream.samples * pixels / each, 4),
                "absolute_sum_per_pixel_and_window": round(mass / (windows * pixels), 3),
            })  # fmt: skip
    return rows
