"""Dense motion between two frames, both ways, and how far it can be trusted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Map = NDArray[np.float32]

HOPELESS = 1e3
"""Doubt of what cannot be known at all: saturated, or outside the other frame [log intensity]."""


@dataclass(frozen=True)
class MotionSettings:
    """How frames are matched, and what makes a match doubtful."""

    within: float = 1.0
    """Doubts are a root mean square over so many pixels around (a Gaussian's sigma) [px]."""
    blur_weight: float = 3.0
    """Weight of the doubt by blur beside that by intensity; docs/scenes.md says why."""
    way_weight: float = 0.3
    """Weight of the doubt by disagreeing ways beside that by intensity; docs/scenes.md says why."""
    rest: float = 0.25
    """Ways shorter than this are none [px]."""
    blur_samples: int = 5
    """Places along a blur at which it is sampled."""


@dataclass(frozen=True)
class FrameMatch:
    """Motion between two frames.

    Args:
        ahead: Way of what a pixel of the first frame shows to the second [px], x then y, shape (H, W, 2).
        back: Way of what a pixel of the second frame shows to the first [px], shape (H, W, 2).
        doubt: Expected error of the intensity on the way, of the first and the second frame's pixels
            [log intensity], shape (2, H, W).
    """

    ahead: Map
    back: Map
    doubt: Map


def match_frames(
    first: Map,
    second: Map,
    *,
    eps: float,
    exposure: tuple[float, float] = (0.0, 0.0),
    usable: tuple[NDArray[np.bool_], NDArray[np.bool_]] | None = None,
    settings: MotionSettings = MotionSettings(),
) -> FrameMatch:
    """Match two frames.

    Doubt is the root of the sum of the squares of three parts, each in units of log intensity: the
    difference between a pixel and what it is matched with; the gap between the way there and the way back
    times the slope of the log intensity; and what one more exposure along the motion would change.

    Args:
        first: Linear intensity in [0, 1], shape (H, W).
        second: Likewise, later.
        eps: Added to intensities before the logarithm.
        exposure: Duration of both exposures as a share of the time between the frames.
        usable: Pixels of both frames that are not saturated, each (H, W); None for all.
        settings: How frames are matched, and what makes a match doubtful.
    """
    a, b = _to_8_bit(first, second)
    ahead, back = _optical_flow(a, b, settings.rest), _optical_flow(b, a, settings.rest)
    logs = [np.log(frame + np.float32(eps)) for frame in (first, second)]
    good = usable or (np.ones(first.shape, np.bool_), np.ones(first.shape, np.bool_))
    doubt = np.stack(
        [
            _doubt_of_frame(logs, (ahead, back), good, exposure[0], settings),
            _doubt_of_frame(logs[::-1], (back, ahead), good[::-1], exposure[1], settings),
        ]
    )
    return FrameMatch(ahead, back, doubt)


def _to_8_bit(*frames: Map) -> list[NDArray[np.uint8]]:
    """Return frames in 8 bits, stretched alike."""
    low, high = np.percentile(np.stack(frames), (0.5, 99.5))
    scale = 255 / max(float(high - low), 1e-6)
    return [np.clip((frame - low) * scale, 0, 255).astype(np.uint8) for frame in frames]


def _optical_flow(
    first: NDArray[np.uint8], second: NDArray[np.uint8], rest: float = MotionSettings.rest
) -> Map:
    """Return the way of each pixel from one frame to another [px], shape (H, W, 2)."""
    quick = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(first, second, None)
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    flow.setFinestScale(0)  # the presets stop at half the resolution
    flow.setPatchStride(2)
    # begun from what most of the picture does: repeated textures then match the right repetition
    way = flow.calc(first, second, _dominant_affine_flow(quick))
    # blending over the shortest ways is as exact as following them, and rest is cheap to render
    way[np.hypot(way[..., 0], way[..., 1]) < rest] = 0
    return np.asarray(way)


def _dominant_affine_flow(way: Map, rounds: int = 20) -> Map:
    """Return the affine motion that most of the ways follow, shape (H, W, 2)."""
    height, width = way.shape[:2]
    x, y = pixel_grid(way.shape)
    design = np.stack([x / width - 0.5, y / height - 0.5, np.ones_like(x)], -1)
    thin = max(1, min(height, width) // 50)
    some, wanted = (part[::thin, ::thin].reshape(-1, part.shape[-1]) for part in (design, way))
    residual = np.hypot(*(wanted - np.median(wanted, axis=0)).T)
    for _ in range(rounds):  # a Geman-McClure loss by reweighting, from the median
        weight = 1 / (1 + (residual / max(1.0, float(np.median(residual)))) ** 2) ** 2
        root = np.sqrt(weight)[:, None]
        motion = np.linalg.lstsq(some * root, wanted * root, rcond=None)[0]
        residual = np.hypot(*(wanted - some @ motion).T)
    return np.ascontiguousarray(design @ motion, np.float32)


def pixel_grid(shape: tuple[int, ...]) -> tuple[Map, Map]:
    """Return columns and rows of all pixels, each (H, W)."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    return x, y


def sample_bicubic(values: Map, x: Map, y: Map) -> Map:
    """Return values at places, bicubic, continued by the outermost ones, in the shape of the places.

    Args:
        values: Shape (H, W).
        x: Columns [px].
        y: Rows [px].
    """
    out = cv2.remap(values, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(out, np.float32)


def _doubt_of_frame(
    logs: list[Map],
    ways: tuple[Map, Map],
    usable: tuple[NDArray[np.bool_], ...],
    exposure: float,
    settings: MotionSettings,
) -> Map:
    """Return the doubt about pixels of the first of two frames, (H, W)."""
    log, (there, back) = logs[0], ways
    height, width = log.shape
    x, y = pixel_grid(log.shape)
    to = x + there[..., 0], y + there[..., 1]
    residual = log - sample_bicubic(logs[1], *to)
    returned = there + sample_bicubic(back, *to)
    gradient = np.hypot(cv2.Sobel(log, cv2.CV_32F, 1, 0) / 8, cv2.Sobel(log, cv2.CV_32F, 0, 1) / 8)
    slope = cv2.dilate(gradient, np.ones((3, 3)))
    apart = np.hypot(returned[..., 0], returned[..., 1]) * slope
    blur = np.zeros_like(log)
    if exposure > 0:
        blur = _blur_along_flow(log, there * np.float32(exposure), settings.blur_samples) - log
    square = residual**2 + (settings.way_weight * apart) ** 2 + (settings.blur_weight * blur) ** 2
    out = np.sqrt(np.maximum(cv2.GaussianBlur(square, (0, 0), settings.within), 0))
    outside = (to[0] < 0) | (to[1] < 0) | (to[0] > width - 1) | (to[1] > height - 1)
    bad = (~usable[0]).astype(np.uint8), (~usable[1]).astype(np.uint8)
    blind = cv2.dilate(bad[0], np.ones((3, 3))) > 0  # bicubic looks at the neighbours
    blind |= cv2.remap(cv2.dilate(bad[1], np.ones((3, 3))), *to, cv2.INTER_NEAREST) > 0
    return np.where(outside | blind, np.float32(HOPELESS), out.astype(np.float32))


def _blur_along_flow(log: Map, way: Map, samples: int) -> Map:
    """Return the log of the mean intensity along a way centred at each pixel [px]."""
    x, y = pixel_grid(log.shape)
    total = np.zeros_like(log)
    for share in (np.arange(samples) + 0.5) / samples - 0.5:
        total += np.exp(
            sample_bicubic(log, x + np.float32(share) * way[..., 0], y + np.float32(share) * way[..., 1])
        )
    return np.asarray(np.log(total / samples))


def is_stretched(frames: NDArray[Any], few: float = 5e-4) -> bool:
    """Return whether each frame, (F, H, W), seems to be stretched to the whole range of its type.

    Stretching leaves few pixels at either end, most often one, not always the same; light and shadow beyond
    the range of a camera leave many.

    Args:
        frames: Of any type; only whole numbers without a sign have a range, shape (F, H, W).
        few: Share of a frame's pixels that stretching may leave at either end of the range.
    """
    if frames.dtype.kind != "u":
        return False
    least, most = (np.median((frames == end).mean((1, 2))) for end in (0, np.iinfo(frames.dtype).max))
    brightest = frames.reshape(len(frames), -1).argmax(1)
    return bool(0 < least < few and 0 < most < few and np.ptp(brightest) > 0)


def estimate_stretches(frames: list[Map] | NDArray[np.float32], *, pull: float = 0.1) -> NDArray[np.float64]:
    """Return gain and offset that undo each frame's own stretch, shape (F, 2).

    Cameras and data sets that stretch every frame to the full range change static intensities from frame to
    frame. Each pair of successive frames is matched, and a straight line fitted robustly through the
    intensities of matched pixels; gains and offsets of all frames then follow by least squares. What all
    frames have in common, the camera's true black level above all, cannot be known from frames.

    Args:
        frames: Stretched linear intensity, F of shape (H, W).
        pull: Weight that keeps frames at their own values, so that errors do not add up along a recording:
            its influence reaches 1 / `pull` frames.
    """
    count = len(frames)
    levels = np.percentile(np.stack([frame[::4, ::4] for frame in frames]), (10, 50, 90))
    rows, wanted = [], []

    def ask(weights: dict[int, float], level: float) -> None:
        row = np.zeros(2 * count)
        for place, weight in weights.items():
            row[place] = weight
        rows.append(row)
        wanted.append(level)

    for k in range(count):
        for level in levels:
            ask({2 * k: pull * level, 2 * k + 1: pull}, pull * level)
        if k + 1 < count:
            gain, offset = _gain_and_offset_between(frames[k], frames[k + 1])
            for level in levels:
                ask({2 * k: level, 2 * k + 1: 1, 2 * k + 2: -(gain * level + offset), 2 * k + 3: -1}, 0.0)
    found = np.linalg.lstsq(np.stack(rows), np.array(wanted), rcond=None)[0]
    return np.asarray(found.reshape(count, 2))


def _gain_and_offset_between(first: Map, second: Map, rounds: int = 20) -> tuple[float, float]:
    """Return gain and offset from the intensities of `first` to those it has in `second`."""
    a8, b8 = _to_8_bit(first, second)
    ahead = _optical_flow(a8, b8)
    x, y = pixel_grid(first.shape)
    to = x + ahead[..., 0], y + ahead[..., 1]
    returned = ahead + sample_bicubic(_optical_flow(b8, a8), *to)
    same = np.hypot(returned[..., 0], returned[..., 1]) < 1
    a, b = first[same], sample_bicubic(second, *to)[same]
    if len(a) < 100 or np.ptp(a) < 1e-3:
        return 1.0, 0.0
    design = np.stack([a, np.ones_like(a)], 1).astype(np.float64)
    weights = np.ones(len(a))
    line = np.array([1.0, 0.0])
    for _ in range(rounds):  # a Cauchy loss by reweighting
        weighted = design * weights[:, None]
        line = np.linalg.solve(weighted.T @ design, weighted.T @ b)
        residual = b - design @ line
        weights = 1 / (1 + (residual / (1.5 * np.median(np.abs(residual)) + 1e-4)) ** 2)
    return float(line[0]), float(line[1])
