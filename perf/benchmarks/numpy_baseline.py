"""The ideal sensor in NumPy and OpenCV alone: what dase is compared with where no other simulator is given.

`plain` is what comes to mind first: whole pictures, one expression after the other. `tuned` is the fastest
that was found without leaving NumPy and OpenCV: float32 in place, bands of rows that stay in the cache, one
band per thread at a time, one threshold for both polarities. Both look up a texture with `cv2.warpAffine`.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np

from dase.scenes.layers import LayerScene

EPS = np.float32(1e-3)
BAND = 32_000
"""Pixels of a band: its five arrays fill 640 KB, which a level-2 cache holds."""


class Pictures:
    """Bands of the pictures of a scene of one layer, looked up in its texture; or of stored pictures.

    Args:
        scene: A background and nothing else, or pictures of 8 bits of shape (K, height, width), linear.
        times: Samples [s], shape (K,).
    """

    def __init__(self, scene: LayerScene | np.ndarray, times: np.ndarray):
        self.stored = scene if isinstance(scene, np.ndarray) else None
        if isinstance(scene, np.ndarray):
            _, self.height, self.width = scene.shape
            self.logs = np.log(np.arange(256, dtype=np.float32) / 255 + EPS)
        else:
            self.width, self.height = scene.width, scene.height
            self.texture = np.ascontiguousarray(scene.layers[0].picture.grey)
            self.places = np.linalg.inv(scene.forward(times)[0])[:, 0, :2]

    def look(self, k: int, top: int, out: np.ndarray) -> np.ndarray:
        """Write the rows from `top` on of picture k: linear intensity."""
        place = self.places[k].copy()
        place[:, 2] += place[:, 1] * top
        how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        size = out.shape[::-1]
        return cv2.warpAffine(self.texture, place, size, out, how, cv2.BORDER_REFLECT_101)

    def log(self, k: int, top: int, out: np.ndarray) -> np.ndarray:
        """Write the logarithms of these rows; those of stored pictures are looked up by level."""
        if self.stored is not None:
            return cv2.LUT(self.stored[k, top : top + len(out)], self.logs, out)
        self.look(k, top, out)
        out += EPS
        return cv2.log(out, out)  # twice as fast as np.log


def count_plain(pictures: Pictures, samples: int, theta: float) -> tuple[np.ndarray, np.ndarray]:
    """Return OFF and ON events of every pixel, picture by picture."""
    shape = pictures.height, pictures.width
    on, off = np.zeros(shape, np.int32), np.zeros(shape, np.int32)
    picture = np.empty(shape, np.float32)
    reference = np.log(pictures.look(0, 0, picture) + EPS)
    for k in range(1, samples):
        change = np.log(pictures.look(k, 0, picture) + EPS) - reference
        crossed = np.floor(np.abs(change) / theta)
        up = change > 0
        on += np.where(up, crossed, 0).astype(np.int32)
        off += np.where(up, 0, crossed).astype(np.int32)
        reference += np.where(up, crossed, -crossed) * np.float32(theta)
    return off, on


def count_tuned(
    pictures: Pictures, samples: int, theta: float, threads: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return OFF and ON events of every pixel, band by band."""
    rows = max(min(BAND // pictures.width, -(-pictures.height // threads)), 1)
    shape = pictures.height, pictures.width
    both, net = np.zeros(shape, np.float32), np.zeros(shape, np.float32)

    def work(top: int) -> None:
        band = slice(top, top + rows)
        _count_band(pictures, samples, theta, top, both[band], net[band])

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, range(0, pictures.height, rows)))
    return (both - net) / 2, (both + net) / 2


def _count_band(
    pictures: Pictures, samples: int, theta: float, top: int, both: np.ndarray, net: np.ndarray
) -> None:
    level, crossed, reference = (np.empty_like(both) for _ in range(3))
    step, inverse = np.float32(theta), np.float32(1 / theta)
    for k in range(samples):
        pictures.log(k, top, level)
        if k == 0:
            reference[:] = level
            continue
        np.subtract(level, reference, out=crossed)
        crossed *= inverse
        np.trunc(crossed, out=crossed)
        net += crossed
        np.multiply(crossed, step, out=level)
        reference += level
        np.abs(crossed, out=crossed)
        both += crossed


def events(pictures: Pictures, times: np.ndarray, theta: float) -> tuple[np.ndarray, ...]:
    """Return t [s], x, y, p of all events in order of time, picture by picture."""
    shape = pictures.height, pictures.width
    last, level, crossed, scratch, reference = (np.empty(shape, np.float32) for _ in range(5))
    step, inverse = np.float32(theta), np.float32(1 / theta)
    parts = []
    for k, now in enumerate(times):
        pictures.log(k, 0, level)
        if k > 0:
            np.subtract(level, reference, out=crossed)
            crossed *= inverse
            np.trunc(crossed, out=crossed)
            parts.append(_events(crossed, reference, last, level, times[k - 1], now, step))
            np.multiply(crossed, step, out=scratch)
            reference += scratch
        else:
            reference[:] = level
        last, level = level, last
    return tuple(np.concatenate(column) for column in zip(*parts, strict=True))


def _events(
    crossed: np.ndarray,
    reference: np.ndarray,
    before: np.ndarray,
    after: np.ndarray,
    begin: float,
    end: float,
    step: np.float32,
) -> tuple[np.ndarray, ...]:
    """Return the events of one picture, in order of their interpolated times."""
    busy = np.flatnonzero(crossed)
    number = np.abs(crossed.ravel()[busy]).astype(np.int64)
    place = np.repeat(busy, number)
    first = np.repeat(np.cumsum(number) - number, number)
    nth = np.arange(1, len(place) + 1) - first
    up = crossed.ravel()[place] > 0
    at = reference.ravel()[place] + np.where(up, step, -step) * nth - before.ravel()[place]
    t = begin + (end - begin) * np.clip(at / (after - before).ravel()[place], 0, 1)
    order = np.argsort(t)
    place = place[order]
    y, x = np.divmod(place, crossed.shape[1])
    return t[order], x.astype(np.uint16), y.astype(np.uint16), up[order]
