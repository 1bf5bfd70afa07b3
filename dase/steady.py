"""Frames without the noise of what does not change."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dase.camera import full_scale
from dase.errors import InputError

AROUND = 1.5
"""A change is looked for in the mean around a pixel (a Gaussian's sigma) [px]."""

SURE = 4.0
"""Changes of so many standard deviations of the noise are changes."""

BANDS = 12
"""Classes of intensity whose noise is measured apart."""


def steady(frames: ArrayLike, *, black: float = 0.0, white: float | None = None) -> NDArray[np.float32]:
    """Return frames in which every pixel keeps one value as long as it rests.

    The noise of frames is no change of light, but a sensor model would answer it with events, and nothing
    would ever count as resting. A pixel rests from one frame to the next if neither it nor the mean around it
    differs from the mean of its rest so far by more than noise does; the noise is measured from the
    differences of successive frames, class by class of intensity. All frames of one rest get their mean.
    What moves is left as it is, and so is a drift once it exceeds the noise.

    Args:
        frames: Any real type, shape (F, H, W), F >= 2.
        black: Value of no light. A pixel that is saturated in a frame of its rest is saturated in all of it.
        white: Value of intensity 1; see `CameraScene`.

    Returns:
        Values from 0, `black`, to 1, `white`, shape (F, H, W), for a `CameraScene` of real numbers.
    """
    raw = np.asarray(frames)
    if raw.ndim != 3 or len(raw) < 2 or raw.dtype.kind not in "iuf":
        raise InputError(
            f"steady: needs at least 2 frames of shape (F, H, W) of real numbers, got {raw.dtype} {raw.shape}"
        )
    white = full_scale(raw) if white is None else white
    values = (raw.astype(np.float32) - np.float32(black)) / np.float32(white - black)
    level, sigma = _noise(values, step=1 / (white - black) if raw.dtype.kind in "iu" else 0.0)
    bounds = np.where(values <= 0, -1, np.where(values >= 1, 1, 0)).astype(np.int8)
    goes_on = np.zeros(raw.shape, np.bool_)
    total, count, limit = values[0].copy(), np.ones(raw.shape[1:], np.float32), bounds[0].copy()
    means, limits = [], []
    for k in range(len(raw)):
        if k:
            goes_on[k] = _rests(values[k], total / count, count, level, sigma)
            total = np.where(goes_on[k], total, 0) + values[k]
            count = np.where(goes_on[k], count, 0) + 1
            limit = np.where(goes_on[k] & (limit != 0), limit, bounds[k])
        means.append(total / count)
        limits.append(limit)
    for k in range(len(raw) - 2, -1, -1):  # the last frame of a rest knows the mean of all
        means[k] = np.where(goes_on[k + 1], means[k + 1], means[k])
        limits[k] = np.where(goes_on[k + 1], limits[k + 1], limits[k])
    ends = np.stack(limits)
    return np.where(ends == 0, np.stack(means), ends > 0).astype(np.float32)


def _noise(values: NDArray[np.float32], step: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return intensities and the standard deviation of a frame's noise at each, both (BANDS,)."""
    thin = max(1, values[0].size // 20_000)
    some = values.reshape(len(values), -1)[:, ::thin]
    middle, change = 0.5 * (some[1:] + some[:-1]).ravel(), np.abs(np.diff(some, axis=0)).ravel()
    order = np.argsort(middle, kind="stable")
    parts = [part for part in np.array_split(order, BANDS) if len(part)]
    # most pixels of a class rest; rounding to whole steps hides noise below half a step
    sigma = [max(1.4826 * float(np.median(change[part])) / np.sqrt(2), 0.5 * step) for part in parts]
    return np.array([float(np.median(middle[part])) for part in parts]), np.array(sigma)


def _rests(
    value: NDArray[np.float32],
    mean: NDArray[np.float32],
    count: NDArray[np.float32],
    level: NDArray[np.float64],
    sigma: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Return which pixels of a frame do not differ from the mean of so many frames before, (H, W)."""
    noise = (SURE * np.interp(mean, level, sigma) * np.sqrt(1 + 1 / count)).astype(np.float32)
    change = value - mean
    around = cv2.GaussianBlur(change, (0, 0), AROUND)
    return np.asarray((np.abs(change) <= noise) & (np.abs(around) <= noise / (2 * np.sqrt(np.pi) * AROUND)))
