"""Light behind a low-pass that goes with it, pixel by pixel over all of its time."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import warp as wp
from numpy.typing import NDArray

from dase.kernels import launch
from dase.kernels.compiler_flags import CPU_FLAGS
from dase.kernels.vector_math import exponential

wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS})


@wp.func
def mean_of_decay(x: float, decay: float) -> float:
    """Mean of e^-s over s from 0 to x, whose end is `decay`; by its series where that would cancel."""
    return wp.where(x < 0.05, 1.0 + x * (-0.5 + x * (0.16666667 - x * 0.041666667)), (1.0 - decay) / x)


@wp.kernel(enable_backward=False)
def follow_poles(
    first: int,
    # in
    level: wp.array2d[float],  # (P, T) log intensity
    light: wp.array2d[float],  # (P, T - 1) intensity between instants, relative to the brightest
    gaps: wp.array[float],  # (T - 1,) between instants [s]
    rate: float,  # of the first pole for each unit of light and dark current [1/s]
    faster: float,  # of the second one, relative to the first; 0 where it does not go with the light
    fixed: float,  # of a second one that does not [1/s]; 0 for none
    dark: float,  # current without light, relative to the brightest
    # out
    out: wp.array2d[float],  # (P, T)
):
    """Filter the light of one pixel per thread, exactly where its logarithm runs straight."""
    _, i = wp.tid()
    i += first
    seen = level[i, 0]
    one = seen
    two = seen
    out[i, 0] = seen
    for n in range(gaps.shape[0]):
        after = level[i, n + 1]
        x = rate * gaps[n] * (light[i, n] + dark)
        decay = exponential(-x)
        behind = after - (after - seen) * mean_of_decay(x, decay) + (one - seen) * decay
        y = faster * x + fixed * gaps[n]
        if y > 0.0:
            decay = exponential(-y)
            two = behind - (behind - one) * mean_of_decay(y, decay) + (two - one) * decay
        else:
            two = behind
        one = behind
        seen = after
        out[i, n + 1] = two


class SlowLight:
    """The light of some pixels, to be looked at behind low-passes.

    Args:
        level: Log intensity, shape (P, T).
        light: Intensity between instants, relative to the brightest, shape (P, T - 1).
        times: Of the instants [s], shape (T,).
        device: Where the kernel runs.
    """

    def __init__(
        self,
        level: NDArray[np.float32],
        light: NDArray[np.float32],
        times: NDArray[np.float64],
        device: str = "cpu",
    ):
        self._device = launch.find_device(device)
        self._inputs = [
            wp.array(np.ascontiguousarray(one, np.float32), dtype=float, device=self._device)
            for one in (level, light, np.diff(times))
        ]

    def behind(self, cutoffs: Sequence[float], dark: float, fixed: float = 0.0) -> NDArray[np.float32]:
        """Return log intensity behind one or two poles, shape (P, T).

        Args:
            cutoffs: Of the poles that go with the light, at the brightest [Hz].
            dark: Current without light that adds to it, relative to the brightest.
            fixed: Of a pole behind one of these, which does not go with the light [Hz]; 0 for none.
        """
        first, *second = cutoffs
        rate = 2 * math.pi * first / (1 + dark)
        level = self._inputs[0]
        out = launch.new_array(level.shape, wp.float32, self._device)
        more = second[0] / first if second else 0.0
        launch.run_kernel(
            follow_poles, level.shape[0],
            [*self._inputs, rate, more, 2 * math.pi * fixed, dark, out], self._device, align=16,
        )  # fmt: skip
        return launch.copy_to_host(out)
