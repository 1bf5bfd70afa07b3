"""Frames without the noise of what does not change."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dase.errors import InputError
from dase.scenes.between_frames import full_scale

NOISE_FILTER = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32) / np.float32(6 * np.sqrt(2))
"""Filter whose output has the standard deviation of a frame's noise, of differences of two frames."""


@dataclass(frozen=True)
class DenoisingSettings:
    """Where noise is measured, and what is more than noise."""

    around: float = 1.5
    """A change is looked for in the mean around a pixel (a Gaussian's sigma) [px]."""
    sure: float = 4.0
    """Changes of so many standard deviations of the noise are changes."""
    block: int = 9
    """Side of the places at which noise is measured [px]."""
    pairs: int = 16
    """Pairs of frames in which noise is measured."""
    smooth_percentile: float = 20.0
    """Percentile over places that counts as smooth; what is above has texture or moves."""
    smoothest: float = 0.88
    """What the root mean square over a place is at that percentile, for noise of standard deviation 1."""
    bands: int = 12
    """Classes of intensity whose noise is measured apart: that of photons grows with the light."""


def denoise_resting_pixels(
    frames: ArrayLike,
    *,
    black: float = 0.0,
    white: float | None = None,
    settings: DenoisingSettings = DenoisingSettings(),
) -> NDArray[np.float32]:
    """Return frames in which every pixel keeps one value as long as it rests.

    The noise of frames is no change of light, but a sensor model would answer it with events, and nothing
    would ever count as resting. A pixel rests from one frame to the next if neither it nor the mean around it
    differs from the mean of its rest so far by more than noise does; the noise is measured from the
    differences of successive frames, class by class of intensity. All frames of one rest get their mean.
    What moves is left as it is. A drift comes out in steps of a few standard deviations.

    Args:
        frames: Any real type, shape (F, H, W), F >= 2.
        black: Value of no light. A pixel that is saturated in a frame of its rest is saturated in all of it.
        white: Value of intensity 1; see `CameraScene`.
        settings: Where noise is measured, and what is more than noise.

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
    noise = _measure_noise(values, 1 / (white - black) if raw.dtype.kind in "iu" else 0.0, settings)
    bounds = np.where(values <= 0, -1, np.where(values >= 1, 1, 0)).astype(np.int8)
    goes_on = np.zeros(raw.shape, np.bool_)
    total, count, limit = values[0].copy(), np.ones(raw.shape[1:], np.float32), bounds[0].copy()
    means, limits = [], []
    for k in range(len(raw)):
        if k:
            goes_on[k] = _is_resting(values[k], total / count, count, noise, settings)
            total = np.where(goes_on[k], total, 0) + values[k]
            count = np.where(goes_on[k], count, 0) + 1
            limit = np.where(goes_on[k] & (limit != 0), limit, bounds[k])
        # the mean of the rest so far: a drift is seen against all of it, not against the last frame
        means.append(total / count)
        limits.append(limit)
    for k in range(len(raw) - 2, -1, -1):  # the last frame of a rest knows the mean of all
        means[k] = np.where(goes_on[k + 1], means[k + 1], means[k])
        limits[k] = np.where(goes_on[k + 1], limits[k + 1], limits[k])
    ends = np.stack(limits)
    return np.where(ends == 0, np.stack(means), ends > 0).astype(np.float32)


@dataclass(frozen=True)
class _NoiseLevels:
    """Standard deviations of a frame's noise, class by class of intensity, each of shape (bands,)."""

    light: NDArray[np.float64]
    pixel: NDArray[np.float64]
    around: NDArray[np.float64]


def _measure_noise(values: NDArray[np.float32], step: float, settings: DenoisingSettings) -> _NoiseLevels:
    """Measure noise in the smoothest places of each class of intensity.

    That of pixels is what is neither flat nor a slope in the difference: moving cameras and flickering light
    leave it alone. The mean around a pixel has more of it than independent pixels would give, as rows,
    columns and whole frames have noise of their own; that is believed up to half the noise of pixels.
    """
    light, pixel, around = [], [], []
    block = settings.block
    inner = (slice(block // 2, -(block // 2) or None, block // 2),) * 2
    for k in np.unique(np.linspace(0, len(values) - 2, settings.pairs).astype(int)):
        change = values[k + 1] - values[k]
        light.append(cv2.blur(values[k], (block, block))[inner].ravel())
        pixel.append(_local_rms(cv2.filter2D(change, cv2.CV_32F, NOISE_FILTER), block)[inner].ravel())
        mean_change = cv2.GaussianBlur(change, (0, 0), settings.around)
        around.append(_local_rms(mean_change, block)[inner].ravel() / np.sqrt(2))
    place, single, mean = (np.concatenate(part) for part in (light, pixel, around))
    parts = [part for part in np.array_split(np.argsort(place, kind="stable"), settings.bands) if len(part)]
    # rounding to whole steps hides noise below half a step
    smooth = [float(np.percentile(single[p], settings.smooth_percentile)) for p in parts]
    sigma = np.array([max(rms / settings.smoothest, 0.5 * step) for rms in smooth])
    common = np.array([float(np.percentile(mean[p], 50)) for p in parts])
    independent = sigma / (2 * np.sqrt(np.pi) * settings.around)
    return _NoiseLevels(
        np.array([float(np.median(place[p])) for p in parts]),
        sigma,
        np.maximum(independent, np.minimum(common, 0.5 * sigma)),
    )


def _local_rms(values: NDArray[np.float32], block: int) -> NDArray[np.float32]:
    """Return the root mean square over a square of side `block` [px] around each place."""
    return np.asarray(np.sqrt(np.maximum(cv2.blur(values * values, (block, block)), 0)))


def _is_resting(
    value: NDArray[np.float32],
    mean: NDArray[np.float32],
    count: NDArray[np.float32],
    noise: _NoiseLevels,
    settings: DenoisingSettings,
) -> NDArray[np.bool_]:
    """Return which pixels of a frame do not differ from the mean of so many frames before, (H, W)."""
    change = value - mean
    around = cv2.GaussianBlur(change, (0, 0), settings.around)
    wider = settings.sure * np.sqrt(1 + 1 / count)
    single, common = (np.interp(mean, noise.light, sigma) * wider for sigma in (noise.pixel, noise.around))
    return np.asarray((np.abs(change) <= single) & (np.abs(around) <= common))
