"""Pixels of one sensor before many scenes at once, each with its own parameters and random numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from dase.kernels import launch, pixel_codegen_scenes, pixel_stages
from dase.kernels import threshold_counts as counting
from dase.kernels.window_sinks import WindowGrids
from dase.simulation.sample_clock import upload_clock
from dase.simulation.sensor import Sensor


class PixelBatch:
    """B arrays of N pixels while time passes; their events go into grids, and are never stored.

    What the pixels of a row do is what those of a `PixelArray` do before its scene, with its parameters and
    its seed. Effects behind the pixels are left out: they need the events of all pixels in order of time.

    Args:
        sensor: What the pixels do.
        batch: Rows B.
        count: Pixels N of each row.
        width: Columns of the camera [px].
        height: Rows of the camera [px].
        deposit: What is done with an event, one of `dase.kernels.window_sinks.DEPOSITS`.
        device: Warp device.
    """

    def __init__(
        self,
        sensor: Sensor,
        batch: int,
        count: int,
        *,
        width: int,
        height: int,
        deposit: str,
        device: wp.Device,
    ):
        self.stages, self.device, self.deposit = sensor.stages(), device, deposit
        self.width, self.height = width, height
        self.batch, self.count = batch, count
        shape = (len(pixel_stages.states(self.stages)), self.batch, self.count)
        self._state = wp.zeros(shape, dtype=float, device=device)
        self._next = wp.zeros(shape, dtype=float, device=device)
        self.maps = any(effect.maps for effect in self.stages)
        self.delays = any(stage == "delay" for effect in self.stages for stage, _ in effect.functions)
        self.samples, self.begin = 0, 0.0

    def reset(self, places: Any, parameters: Any, seeds: Any, maps: Any = None) -> None:
        """Begin new scenes; all are Warp arrays on the device.

        Args:
            places: Row-major indices of the pixels of each row on the camera, int32, shape (B, N).
            parameters: Parameter vectors, float32, shape (B, P).
            seeds: Of every random number, int32, shape (B,).
            maps: What effects have for each pixel, float32, shape (B, M, N); None where there are none.
        """
        self.samples, self.begin = 0, 0.0
        self.places, self._parameters, self._seeds, self._maps = places, parameters, seeds, maps

    def late_windows(self, window: float) -> int:
        """Return how many windows [s] behind the last sample events may leave in."""
        return int(np.ceil(pixel_stages.LATEST / window)) + 1 if self.delays else 0

    def clock(self, times: NDArray[np.float64], run: NDArray[np.int32]) -> Any:
        """Return the clock of samples that follow the last ones, for `advance`.

        Args:
            times: Samples [s], shape (K,).
            run: Samples at which windows begin, and K, shape (W + 1,).
        """
        edges = np.concatenate([times[:1] if self.samples == 0 else [self.begin], times])
        begins = wp.array(run.astype(np.int32), dtype=int, device=self.device)
        windows = wp.array(np.arange(len(run) - 1, dtype=np.int32), dtype=int, device=self.device)
        return upload_clock(edges, self.samples == 0, begins, windows, self.device)

    def advance(
        self, source: str, scenes: Any, clock: Any, times: Any, frames: Any, grids: Any, bins: int
    ) -> None:
        """Advance over samples and add the events to grids.

        Args:
            source: One of `dase.kernels.pixel_codegen_scenes.SCENES`.
            scenes: What the pixels of each row see.
            clock: Of the samples, see `clock`.
            times: Samples [s], shape (K,).
            frames: Warp array (W, B, N) for the intensities at the ends of windows.
            grids: Warp array (W, B, C, N) of at least as many windows as the clock has, of one duration.
            bins: Bins of time in a window.
        """
        sink = WindowGrids()
        sink.grids, sink.bins = grids, bins
        begin = self.begin if self.samples else float(times[0])
        sink.window = wp.float64(1e9 * (float(times[-1]) - begin) / clock.window.shape[0])
        lanes = 0
        if self.device.is_cpu:
            lanes = counting.widest_block(self.count, self.device, source)
        kernel = pixel_codegen_scenes.compose_scenes(self.stages, source, self.deposit, lanes=lanes)
        inputs = [
            scenes, clock, self.places, self.width, self.height, self.samples, self._seeds, self._parameters,
            *([self._maps] if self.maps else []), self._state, self._next, frames, sink,
        ]  # fmt: skip
        size = counting.block_count(self.count, lanes) if lanes else self.count
        launch.run_kernel(kernel, size, inputs, self.device, batch=self.batch)
        self._state, self._next = self._next, self._state
        self.samples += len(times)
        self.begin = float(times[-1])
