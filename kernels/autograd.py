"""The bridge to PyTorch: the only file of the kernels that imports it.

Tensors are lent to Warp without a copy where they are contiguous float32, and kernels run on the stream that
is current in PyTorch. Every operand is cast to float32 here, so that autocast changes nothing. Gradients are
written by hand, once differentiable.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import lru_cache
from itertools import accumulate
from typing import Any, Literal, get_args

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from dase.kernels import counts as _counts
from dase.kernels import scene as _scene
from dase.kernels import surrogates as _surrogates
from dase.kernels.launch import run, threads

wp.init()  # a bare wp.from_torch fails without it

Surrogate = Literal["interval", "events", "expected"]
SURROGATE: Surrogate = "expected"
"""Default surrogate gradient of `count_events`, chosen in docs/surrogates.md."""

STEP = 0.1
"""Default half width of the difference of `expected`, in the logarithm of the threshold."""

FLOOR = 0.01
"""Smallest threshold [log intensity], section 4.2 of the paper."""

Texture = tuple[torch.Tensor, torch.Tensor | None]
"""Intensity and alpha of a layer, each of shape (h, w); alpha None is opaque."""

COPIES = 256
"""Copies of the gradient of `place` on a GPU, so that neighbouring pixels need not wait for each other."""


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

    The threshold of a pixel is max(mu + sigma z, 0.01), see `thresholds`. Gradients go to `mu` and `sigma`.
    They treat the phase as a fixed fraction of the threshold, and none goes to `log` or `phase`.

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
    _check("log", log, None, None)
    if log.ndim < 3 or log.shape[1] < 2:
        raise ValueError(f"log must have shape (B, K, *S) with K >= 2, got {tuple(log.shape)}")
    batch, samples, *space = log.shape
    threshold = thresholds(mu, sigma, z, like=log).flatten(2)
    if phase is None:
        start = torch.zeros(batch, threshold.shape[2], device=log.device)
    else:
        _check("phase", phase, ((batch, *space),), log.device)
        fraction = phase.detach().float().flatten(1)
        on, off = threshold.detach()[:, -1], threshold.detach()[:, 0]
        start = fraction * torch.where(fraction >= 0, on, off)
    window = _window(windows, samples - 1)
    flat = log.detach().flatten(2)
    counts = _Count.apply(flat, threshold, start, window, surrogate, step)
    return counts.view(batch, max(window) + 1, 2, *space)


def thresholds(
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
        _check(name, value, ((batch, *space), (batch, 2, *space)), like.device)
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
        seen.values = wp.from_torch(log.view(batch * samples, pixels))
        lanes = _counts.widest(pixels, wp.device_from_torch(log.device), "log")
        kernel = _counts.count(lanes, "log", shared=threshold.shape[1] == 1, states=False)
        unused = torch.empty(batch, 0, device=log.device)
        inputs = [
            seen, samples, wp.empty(0, dtype=int, device=log.device.type), pixels, 1, 1, threshold,
            torch.zeros(batch, device=log.device), _on_device(tuple(k + 1 for k in runs), log.device),
            _on_device(target, log.device), log[:, 0] - phase,
        ]  # fmt: skip
        _launch(kernel, inputs, [unused, unused, counts], over=log, size=_counts.blocks(pixels, lanes))
        if not once:
            sums = counts.new_zeros(batch, max(window) + 1, 2, pixels)
            counts = sums.index_add_(1, _on_device(window, log.device), counts)
        ctx.save_for_backward(log, threshold, phase, _on_device(windows, log.device), counts)
        ctx.surrogate, ctx.step = surrogate, step
        return counts

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        log, threshold, phase, window, counts = ctx.saved_tensors
        gradient = gradient.float().contiguous()
        out = torch.zeros_like(threshold)
        if ctx.surrogate == "events":
            _launch(_surrogates.events_gradient, [threshold, counts, gradient], [out])
        elif ctx.surrogate == "interval":
            _launch(_surrogates.interval_gradient, [log, threshold, phase, window, gradient], [out])
        else:
            _launch(_surrogates.expected_gradient, [log, threshold, phase, window, gradient, ctx.step], [out])
        return None, out, None, None, None, None


def render(textures: Sequence[Texture], place: torch.Tensor, *, width: int, height: int) -> torch.Tensor:
    """Render moving layers, differentiable in their textures and places: `LayerScene.frames` for training.

    Gradients are those of bilinear sampling: by `place` they jump where a pixel crosses a texel centre, and
    fully opaque texels at the border of a texture make an edge one texel wide. On a GPU they are summed in
    any order, so two runs agree to rounding only.

    Args:
        textures: Intensity and alpha of 1 to 32 layers, each (h, w). The first is the background, continued
            by reflection (its alpha, if any, darkens it); later ones lie in front, transparent outside.
        place: Maps from sensor to texture coordinates, pixel centres at integers [px to texel], shape
            (K, L, 2, 3); `affine_places` makes them.
        width: Columns of the sensor [px].
        height: Rows of the sensor [px].

    Returns:
        Intensities, shape (K, height, width) float32.

    Raises:
        ValueError: A shape, dtype or device does not fit.
    """
    _check("place", place, None, None)
    _check_textures(textures, place.device)
    if place.ndim != 4 or tuple(place.shape[1:]) != (len(textures), 2, 3):
        raise ValueError(f"place must have shape (K, {len(textures)}, 2, 3), got {tuple(place.shape)}")
    if width < 1 or height < 1:
        raise ValueError(f"width and height must be >= 1 px, got {width} and {height}")
    flat = []
    for grey, alpha in textures:
        opacity = torch.ones_like(grey) if alpha is None else alpha
        flat.append(torch.stack([grey.float() * opacity.float(), opacity.float()], -1).view(-1, 2))
    sizes = tuple((grey.shape[1], grey.shape[0]) for grey, _ in textures)
    frames = _Render.apply(torch.cat(flat), place.float(), sizes, width, width * height)
    return frames.view(-1, height, width)


def affine_places(
    motion: torch.Tensor,
    times: torch.Tensor | Sequence[float],
    sizes: Sequence[tuple[int, int]],
    *,
    width: int,
    height: int,
    duration: float,
) -> torch.Tensor:
    """Return the places of `dase.layers.Motion`, differentiable in the motion and the times.

    Args:
        motion: Fields of `Motion` in its order and units, at the beginning and at the end, shape (L, 5, 2).
        times: Samples [s], shape (K,).
        sizes: Height and width of the texture of each layer [texel]; the first is the background.
        width: Columns of the sensor [px].
        height: Rows of the sensor [px].
        duration: Length of the motion [s].

    Returns:
        Maps from sensor to texture coordinates [px to texel], shape (K, L, 2, 3) float32.

    Raises:
        ValueError: A shape or dtype does not fit.
    """
    _check("motion", motion, ((len(sizes), 5, 2),), None)
    # float32 would leave errors of 1e-5 and more
    begin, end = motion.double().unbind(-1)  # each (L, 5)
    share = torch.as_tensor(times, dtype=torch.float64, device=motion.device)[:, None, None] / duration
    x, y, angle, scale_x, scale_y = (begin + share * (end - begin)).unbind(-1)  # each (K, L)
    # texels per unit of the plane: at scale 1 the background covers the sensor, others are as wide as it
    units = [max(h, w) if n else min(w, h * width / height) for n, (h, w) in enumerate(sizes)]
    zoom = motion.new_tensor(units, dtype=torch.float64) / width
    cosine, sine = zoom * torch.cos(angle), zoom * torch.sin(angle)
    centre_x, centre_y = x * width + (width - 1) / 2, y * width + (height - 1) / 2  # [px]
    rows = []  # u, then v
    for a, b, side in ((cosine / scale_x, sine / scale_x, 1), (-sine / scale_y, cosine / scale_y, 0)):
        middle = motion.new_tensor([(size[side] - 1) / 2 for size in sizes], dtype=torch.float64)
        rows.append(torch.stack([a, b, middle - a * centre_x - b * centre_y], -1))
    return torch.stack(rows, -2).float()


class _Render(torch.autograd.Function):
    """Frames of flat pixels; gradients to premultiplied texels and places."""

    @staticmethod
    def forward(
        ctx: Any,
        texels: torch.Tensor,
        place: torch.Tensor,
        sizes: tuple[tuple[int, int], ...],
        width: int,
        pixels: int,
    ) -> torch.Tensor:
        texels, place = texels.contiguous(), place.contiguous()
        frames = torch.empty(len(place), pixels, device=place.device)
        _launch(_scene.render, [_layers(texels, place, sizes), width], [frames])
        ctx.save_for_backward(texels, place)
        ctx.sizes, ctx.width = sizes, width
        return frames

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        texels, place = ctx.saved_tensors
        gradient = gradient.float().contiguous()
        # adding is atomic on a GPU but not on the CPU, where every thread gets a copy and a run of pixels
        lots = min(threads(), 16)
        stretch = 1 if gradient.is_cuda else -(-gradient.shape[1] // lots)
        wanted = [bool(n) for n in ctx.needs_input_grad[:2]]
        copies = (1, COPIES) if gradient.is_cuda else (lots, lots)
        by_texels = texels.new_zeros(copies[0], len(texels) * wanted[0], 2)
        by_place = place.new_zeros(copies[1], len(place) * wanted[1], *place.shape[1:])
        outputs = [wp.from_torch(by_texels, dtype=wp.vec2), wp.from_torch(by_place, dtype=_scene.Affine)]
        inputs = [_layers(texels, place, ctx.sizes), gradient, ctx.width, stretch]
        _launch(_scene.render_gradient, inputs, outputs, over=gradient, align=stretch)
        sums = [by.sum(0) if want else None for by, want in zip((by_texels, by_place), wanted, strict=True)]
        return *sums, None, None, None


def _layers(texels: torch.Tensor, place: torch.Tensor, sizes: tuple[tuple[int, int], ...]) -> Any:
    """Lend textures of `sizes` (width, height) and places to Warp; no layer is ruled out anywhere."""
    starts = (0, *accumulate(w * h for w, h in sizes))
    corner = place.new_full((len(sizes), 2), torch.inf)
    layers = _scene.Layers()
    layers.grey = wp.from_torch(texels.detach()[: starts[1], 0].contiguous())
    layers.texels = wp.from_torch(texels.detach(), dtype=wp.vec2)
    layers.start = wp.from_torch(_on_device(starts[:-1], place.device))
    flat = _on_device(tuple(side for size in sizes for side in size), place.device)
    layers.size = wp.from_torch(flat.view(-1, 2), dtype=wp.vec2i)
    layers.place = wp.from_torch(place.detach(), dtype=_scene.Affine)
    layers.box = wp.from_torch(torch.cat([-corner, corner], 1), dtype=wp.vec4)
    layers.count = len(sizes)
    return layers


def _launch(
    kernel: wp.Kernel,
    inputs: list[Any],
    outputs: list[Any],
    *,
    over: torch.Tensor | None = None,
    align: int = 1,
    size: int | None = None,
) -> None:
    """Run `kernel` on a thread for each of the first and last axis of `over`, else of the first output.

    `size` stands in for the length of the last axis.
    """
    shape = outputs[0] if over is None else over
    # detached: Warp would ask a tensor that requires a gradient for its .grad
    arguments = [wp.from_torch(a.detach()) if isinstance(a, torch.Tensor) else a for a in (*inputs, *outputs)]
    device = wp.device_from_torch(shape.device)
    with _stream(shape.device):
        run(
            kernel,
            shape.shape[-1] if size is None else size,
            arguments,
            device,
            batch=shape.shape[0],
            align=align,
        )


def _stream(device: torch.device) -> AbstractContextManager[Any]:
    """Make Warp follow PyTorch's current stream of a CUDA `device`."""
    if device.type != "cuda":
        return nullcontext()
    # nothing to wait for: all our work is on PyTorch's streams, and waiting would break CUDA graphs
    return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(device)), sync_enter=False)


def _check(
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


def _check_textures(textures: Sequence[Texture], device: torch.device) -> None:
    """Raise ValueError unless `textures` are layers that `render` takes, all on `device`."""
    if not 1 <= len(textures) <= _scene.MAX_LAYERS:
        raise ValueError(f"textures must be 1 to {_scene.MAX_LAYERS} layers, got {len(textures)}")
    for n, layer in enumerate(textures):
        if not isinstance(layer, (tuple, list)) or len(layer) != 2:
            raise ValueError(
                f"textures[{n}] must be a pair of intensity and alpha, got {type(layer).__name__}"
            )
        grey, alpha = layer
        _check(f"intensity of textures[{n}]", grey, None, device)
        if grey.ndim != 2 or grey.numel() == 0:
            raise ValueError(f"intensity of textures[{n}] must have shape (h, w), got {tuple(grey.shape)}")
        if alpha is not None:
            _check(f"alpha of textures[{n}]", alpha, (tuple(grey.shape),), device)


def _window(windows: Sequence[int] | torch.Tensor | None, intervals: int) -> tuple[int, ...]:
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
def _on_device(indices: tuple[int, ...], device: torch.device) -> torch.Tensor:
    """Return `indices` as int32 on `device`, kept so that a training loop copies them once."""
    # a tensor born in inference mode could not be saved for a later backward pass
    with torch.inference_mode(False):
        return torch.tensor(indices, dtype=torch.int32, device=device)
