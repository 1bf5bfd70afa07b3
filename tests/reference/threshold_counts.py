"""Plain twins of the counting kernels: slow, literal, and sharing no code with them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch


def recursion(log: np.ndarray, on: np.ndarray, off: np.ndarray, phase: np.ndarray) -> np.ndarray:
    """Return the events of every interval by Equations 2 to 4 in float32, one sample after the other.

    Args:
        log: Samples, shape (K, ...) float32 [log intensity].
        on: ON threshold, shape (...) float32 [log intensity].
        off: OFF threshold, shape (...) float32 [log intensity].
        phase: First sample minus first reference, shape (...) float32 [log intensity].

    Returns:
        Counts, shape (K - 1, 2, ...) float32 [events], OFF before ON.
    """
    assert log.dtype == on.dtype == off.dtype == phase.dtype == np.float32
    memory = log[0] - phase
    counts = []
    for sample in log[1:]:
        change = sample - memory
        positive = whole(np.maximum(change, 0), on)
        negative = whole(np.maximum(-change, 0), off)
        memory = memory + positive * on - negative * off
        counts.append(np.stack([negative, positive]))
    return np.stack(counts)


def whole(change: np.ndarray, threshold: np.ndarray) -> np.ndarray:
    """Return the greatest whole n with n threshold <= change, both float32 and change >= 0."""
    n = np.floor(change.astype(np.float64) / threshold.astype(np.float64)).astype(np.float32)
    for _ in range(2):  # the product rounds, so the floor of the real quotient may be one off
        n = np.where((n + 1) * threshold <= change, n + 1, n).astype(np.float32)
        n = np.where(n * threshold > change, n - 1, n).astype(np.float32)
    return n


def exact(log: Sequence[int], on: int, off: int, phase: int = 0) -> list[tuple[int, int]]:
    """Return the (OFF, ON) events of every interval of one pixel in integers, without any rounding."""
    memory = log[0] - phase
    counts = []
    for sample in log[1:]:
        change = sample - memory
        positive, negative = max(change, 0) // on, max(-change, 0) // off
        memory += positive * on - negative * off
        counts.append((negative, positive))
    return counts


def clamp(log: Sequence[int], threshold: int) -> list[tuple[int, int]]:
    """Return the (OFF, ON) events of one pixel by the clamped level, equal thresholds, in integers."""
    level = 0
    counts = []
    for sample in log[1:]:
        down, up = (sample - log[0]) // threshold, -((log[0] - sample) // threshold)
        change = min(max(level, down), up) - level
        level += change
        counts.append((max(-change, 0), max(change, 0)))
    return counts


def printed(log: np.ndarray, threshold: int, *, truncate: bool) -> np.ndarray:
    """Return the signed events of every interval by Equations 6 to 8 as printed, in integers.

    Args:
        log: Samples, shape (K, N) integers.
        threshold: Threshold of both polarities.
        truncate: Round towards zero, as a cast to integer does, instead of down.
    """
    change = log - log[0]
    low = change // threshold
    whole = low * threshold == change
    level = np.where(truncate & (change < 0) & ~whole, low + 1, low)
    residual = np.zeros_like(level)
    for k in range(1, len(log)):
        rise, fall = level[k] > level[k - 1], level[k] < level[k - 1]
        cases = [whole[k], rise & (change[k] < 0), fall & (change[k] > 0), level[k] == level[k - 1]]
        residual[k] = np.select(cases, [0, -1, 1, residual[k - 1]], 0)
    return np.diff(level + residual, axis=0)


def binned(counts: np.ndarray, windows: Sequence[int]) -> np.ndarray:
    """Return interval counts, shape (K - 1, ...), summed by window, shape (W, ...)."""
    out = np.zeros((max(windows) + 1, *counts.shape[1:]), np.float32)
    np.add.at(out, list(windows), counts)
    return out


def surrogate(
    log: torch.Tensor,
    threshold: torch.Tensor,
    phase: torch.Tensor,
    windows: Sequence[int],
    name: str,
    step: float,
) -> torch.Tensor:
    """Return exact counts whose derivative by PyTorch is the surrogate `name`.

    Args:
        log: Samples, shape (B, K, N) [log intensity].
        threshold: OFF and ON, shape (B, 2, N) [log intensity].
        phase: Shape (B, N) [log intensity].
        windows: Window of every interval.
        name: `interval`, `events` or `expected`.
        step: Half width of `expected`.

    Returns:
        Shape (B, W, 2, N).
    """
    fixed = threshold.detach()
    counts = _intervals(log, fixed, phase)
    if name == "events":
        smooth = counts * (fixed / threshold)[:, None]
    elif name == "interval":
        size = log.diff(dim=1).abs()[:, :, None]
        smooth = torch.where(counts > 0, size / threshold[:, None], 0.0)
    else:
        smooth = torch.zeros_like(counts)
        for p, sign in enumerate((-1, 1)):
            high, low = (_moved(log, fixed, phase, p, sign, s) for s in (step, -step))
            slope = (high - low) / (2 * np.sinh(step) * fixed[:, None, p : p + 1])
            smooth = smooth + slope * threshold[:, None, p : p + 1]
    straight = counts + (smooth - smooth.detach())
    out = torch.zeros(len(log), max(windows) + 1, *counts.shape[2:], device=log.device)
    return out.index_add(1, torch.tensor(list(windows), device=log.device), straight)


def _intervals(log: torch.Tensor, threshold: torch.Tensor, phase: torch.Tensor) -> torch.Tensor:
    """Return `recursion` of tensors, shape (B, K - 1, 2, N)."""
    samples = log.transpose(0, 1).cpu().numpy()
    off, on = threshold.transpose(0, 1).cpu().numpy()
    counts = recursion(samples, on, off, phase.cpu().numpy())
    return torch.from_numpy(counts).permute(2, 0, 1, 3).to(log.device)


def _moved(
    log: torch.Tensor, threshold: torch.Tensor, phase: torch.Tensor, p: int, sign: int, step: float
) -> torch.Tensor:
    """Return the counts with the threshold of polarity `p`, and a phase of its sign, times e^step."""
    factor = float(np.exp(np.float32(step)))
    moved = threshold.clone()
    moved[:, p] *= factor
    own = (phase >= 0) == (sign > 0)
    return _intervals(log, moved, torch.where(own, phase * factor, phase))
