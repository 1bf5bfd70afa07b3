"""The bridge to PyTorch: exact counts of events, differentiable in the thresholds.

Tensors are lent to Warp without a copy where they are contiguous float32, and kernels run on the stream that
is current in PyTorch. Every operand is cast to float32 here, so that autocast changes nothing. Gradients are
written by hand, once differentiable.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import lru_cache
from typing import Any, Literal, get_args

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from dase.kernels import scene_layers as _scene
from dase.kernels import threshold_counts as _counts
from dase.kernels import threshold_surrogates as _surrogates
from dase.kernels.launch import lend_tensor, run_kernel

Surrogate = Literal["interval", "events", "expected"]
SURROGATE: Surrogate = "expected"
"""Default surrogate gradient of `count_events`, chosen in docs/surrogates.md."""

STEP = 0.1
"""Default half width of the difference of `expected`, in the logarithm of the threshold."""

FLOOR = 0.01
"""Smallest threshold [log intensity], section 4.2 of the paper."""


def count_events(
    log: torch.Tensor,
    mu: torch.Tensor,
    sigma: torch.Tensor | float,
    z: torch.Tensor | float,
    *,
    phase: torch.Tensor | None = None,
    windows: Sequence[int] | torch.Tensor | None = None,
    surrogate: Surrogate = SURROGATE,
    step: float = STEP,
) -> torch.Tensor:
    """Count events exactly, differentiable in the distribution of the thresholds.

    The threshold of a pixel is max(mu + sigma z, 0.01), see `clipped_thresholds`. Gradients go to `mu` and
    `sigma`. They treat the phase as a fixed fraction of the threshold, and none goes to `log` or `phase`.

    Args:
        log: Samples, shape (B, K, *S) [log intensity]; S are the pixels, e.g. (H, W), and K >= 2.
        mu: Mean threshold [log intensity], shape (B, *S), or (B, 2, *S) with OFF before ON.
        sigma: Standard deviation of the threshold [log intensity], shaped like `mu` in either way; 0 makes
            `mu` the threshold itself.
        z: Standard normal noise, shaped like `mu` in either way.
        phase: Where the memory starts, as a fraction of the threshold in (-1, 1), shape (B, *S): the first
            sample lies `phase` ON thresholds above the reference, or -`phase` OFF thresholds below it where
            negative. None: 0, as in the paper.
        windows: Index of the window that each of the K - 1 intervals counts for, all >= 0; a list or a CPU
            tensor avoids waiting for the GPU. None: one window. `range(K - 1)`: every interval its own.
        surrogate: What stands for the derivative of the floor: `interval`, `events` or `expected`.
        step: Half width of the difference of `expected`, in the logarithm of the threshold, > 0.

    Returns:
        Counts, shape (B, W, 2, *S) float32 [events], OFF before ON.

    Raises:
        ValueError: A shape, dtype, device or option does not fit.
    """
    if surrogate not in get_args(Surrogate):
        raise ValueError(f"surrogate must be one of {', '.join(get_args(Surrogate))}, got {surrogate!r}")
    if not step > 0:
        raise ValueError(f"step must be > 0, got {step}")
    check_tensor("log", log, None, None)
    if log.ndim < 3 or log.shape[1] < 2:
        raise ValueError(f"log must have shape (B, K, *S) with K >= 2, got {tuple(log.shape)}")
    batch, samples, *space = log.shape
    threshold = clipped_thresholds(mu, sigma, z, like=log).flatten(2)
    if phase is None:
        start = torch.zeros(batch, threshold.shape[2], device=log.device)
    else:
        check_tensor("phase", phase, ((batch, *space),), log.device)
        fraction = phase.detach().float().flatten(1)
        on, off = threshold.detach()[:, -1], threshold.detach()[:, 0]
        start = fraction * torch.where(fraction >= 0, on, off)
    window = _window_indices(windows, samples - 1)
    flat = log.detach().flatten(2)
    counts = _Count.apply(flat, threshold, start, window, surrogate, step)
    return counts.view(batch, max(window) + 1, 2, *space)


def clipped_thresholds(
    mu: torch.Tensor, sigma: torch.Tensor | float, z: torch.Tensor | float, *, like: torch.Tensor
) -> torch.Tensor:
    """Return the thresholds max(mu + sigma z, 0.01) that `count_events` uses.

    Below the floor the gradient is zero, that of the maximum, unless the mean itself lies there: then it
    passes where descent on it would raise the threshold, so that no pixel is stuck. Passing it for every
    sample of the tail would add rare gradients hundreds of times too large, see docs/surrogates.md.

    Args:
        mu: Mean [log intensity], shape (B, *S) shared by the polarities, or (B, 2, *S) with OFF before ON.
        sigma: Standard deviation [log intensity], a number or shaped in either way.
        z: Standard normal noise, a number or shaped in either way.
        like: Samples of shape (B, K, *S); shapes and device must fit them.

    Returns:
        Shape (B, P, *S) float32 [log intensity]; P is 2 where an argument has a polarity axis, else 1.

    Raises:
        ValueError: A shape, dtype or device does not fit.
    """
    batch, _, *space = like.shape
    parts = []
    for name, value in (("mu", mu), ("sigma", sigma), ("z", z)):
        if isinstance(value, (int, float)) and name != "mu":
            parts.append(value)
            continue
        check_tensor(name, value, ((batch, *space), (batch, 2, *space)), like.device)
        value = value.float()
        parts.append(value if value.ndim == like.ndim else value.unsqueeze(1))
    return _Floor.apply(parts[0] + parts[1] * parts[2], parts[0].detach())


class _Floor(torch.autograd.Function):
    """Clip thresholds from below; straight through where the mean is below too and descent would raise it."""

    @staticmethod
    def forward(ctx: Any, threshold: torch.Tensor, mean: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(threshold, mean)
        return threshold.clamp_min(FLOOR)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, None]:
        threshold, mean = ctx.saved_tensors
        passes = (threshold >= FLOOR) | ((mean < FLOOR) & (gradient < 0))
        return torch.where(passes, gradient, 0.0), None


class _Count(torch.autograd.Function):
    """Counts of flat pixels; gradients to the thresholds."""

    @staticmethod
    def forward(
        ctx: Any,
        log: torch.Tensor,
        threshold: torch.Tensor,
        phase: torch.Tensor,
        windows: tuple[int, ...],
        surrogate: str,
        step: float,
    ) -> torch.Tensor:
        log, threshold, phase = (t.float().contiguous() for t in (log, threshold, phase))
        batch, samples, pixels = log.shape
        # a run of intervals of one window is counted at once; sample k + 1 ends interval k
        runs = [0, *(k for k in range(1, len(windows)) if windows[k] != windows[k - 1]), len(windows)]
        window = tuple(windows[k] for k in runs[:-1])
        once = len(set(window)) == len(window)
        target = window if once else tuple(range(len(window)))
        counts = torch.zeros(batch, max(target) + 1, 2, pixels, device=log.device)
        seen = _scene.Frames()
        seen.values = lend_tensor(log.view(batch * samples, pixels))
        lanes = _counts.widest_block(pixels, wp.device_from_torch(log.device), "log")
        shared, aligned = threshold.shape[1] == 1, _counts.samples_are_aligned("log", seen, pixels)
        kernel = _counts.counting_kernel(lanes, "log", shared=shared, states=False, aligned=aligned)
        unused = torch.empty(batch, 0, device=log.device)
        inputs = [
            seen, samples, wp.empty(0, dtype=int, device=log.device.type), pixels, 1, 1, threshold,
            torch.zeros(batch, device=log.device), indices_on_device(tuple(k + 1 for k in runs), log.device),
            indices_on_device(target, log.device), log[:, 0] - phase,
        ]  # fmt: skip
        launch_on_tensors(
            kernel, inputs, [unused, unused, counts], over=log, size=_counts.block_count(pixels, lanes)
        )
        if not once:
            sums = counts.new_zeros(batch, max(window) + 1, 2, pixels)
            counts = sums.index_add_(1, indices_on_device(window, log.device), counts)
        ctx.save_for_backward(log, threshold, phase, indices_on_device(windows, log.device), counts)
        ctx.surrogate, ctx.step = surrogate, step
        return counts

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        log, threshold, phase, window, counts = ctx.saved_tensors
        gradient = gradient.float().contiguous()
        out = torch.zeros_like(threshold)
        if ctx.surrogate == "events":
            launch_on_tensors(_surrogates.events_gradient, [threshold, counts, gradient], [out])
        elif ctx.surrogate == "interval":
            launch_on_tensors(_surrogates.interval_gradient, [log, threshold, phase, window, gradient], [out])
        else:
            launch_on_tensors(
                _surrogates.expected_gradient, [log, threshold, phase, window, gradient, ctx.step], [out]
            )
        return None, out, None, None, None, None


def launch_on_tensors(
    kernel: wp.Kernel,
    inputs: list[Any],
    outputs: list[Any],
    *,
    over: torch.Tensor | None = None,
    align: int = 1,
    size: int | None = None,
) -> None:
    """Run `kernel` on a thread for each of the first and last axis of `over`, else of the first output.

    Tensors have whatever shape the kernel asks for; `size` stands in for the length of the last axis.
    """
    shape = outputs[0] if over is None else over
    # detached: Warp would ask a tensor that requires a gradient for its .grad
    arguments = [lend_tensor(a.detach()) if isinstance(a, torch.Tensor) else a for a in (*inputs, *outputs)]
    device = wp.device_from_torch(shape.device)
    with follow_torch_stream(shape.device):
        run_kernel(
            kernel,
            shape.shape[-1] if size is None else size,
            arguments,
            device,
            batch=shape.shape[0],
            align=align,
        )


def follow_torch_stream(device: torch.device) -> AbstractContextManager[Any]:
    """Make Warp follow PyTorch's current stream of a CUDA `device`."""
    if device.type != "cuda":
        return nullcontext()
    # nothing to wait for: all our work is on PyTorch's streams, and waiting would break CUDA graphs
    return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(device)), sync_enter=False)


def check_tensor(
    name: str, value: Any, shapes: tuple[tuple[int, ...], ...] | None, device: torch.device | None
) -> None:
    """Raise ValueError unless `value` is a floating-point tensor of one of `shapes` on `device`."""
    if not isinstance(value, torch.Tensor):
        raise ValueError(f"{name} must be a torch.Tensor, got {type(value).__name__}")
    if not value.is_floating_point():
        raise ValueError(f"{name} must be floating point, got {value.dtype}")
    if shapes is not None and tuple(value.shape) not in shapes:
        rule = " or ".join(map(str, shapes))
        raise ValueError(f"{name} must have shape {rule}, got {tuple(value.shape)}")
    if device is not None and value.device != device:
        raise ValueError(f"{name} must be on {device}, got {value.device}")


def _window_indices(windows: Sequence[int] | torch.Tensor | None, intervals: int) -> tuple[int, ...]:
    """Return the window of every interval, shape (K - 1,).

    Raises:
        ValueError: Not one index per interval, or an index below 0.
    """
    if windows is None:
        indices = (0,) * intervals
    elif isinstance(windows, torch.Tensor):
        if windows.is_floating_point() or windows.ndim != 1:
            raise ValueError(f"windows must be 1-D integers, got {windows.ndim}-D {windows.dtype}")
        indices = tuple(windows.tolist())
    else:
        indices = tuple(windows)
    if len(indices) != intervals:
        raise ValueError(f"windows must name one window per interval, {intervals}, got {len(indices)}")
    if min(indices) < 0:
        raise ValueError(f"windows must be >= 0, got {min(indices)}")
    return indices


@lru_cache(maxsize=64)
def indices_on_device(indices: tuple[int, ...], device: torch.device) -> torch.Tensor:
    """Return `indices` as int32 (N,) on `device`, kept so that a training loop copies them once."""
    # a tensor born in inference mode could not be saved for a later backward pass
    with torch.inference_mode(False):
        return torch.tensor(indices, dtype=torch.int32, device=device)
