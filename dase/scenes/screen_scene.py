"""A screen in a camera's picture, as a scene: light that is held for a refresh, row after row."""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from dase.errors import InputError
from dase.kernels import pixel_stages
from dase.scenes.scene import Scene
from dase.scenes.screen_stimulus import ScreenStimulus, read_stimulus

FINEST = 1000.0
"""Samples per second at least [Hz]: light jumps within one of them, as fast as that of a screen does."""
INSIDE = 3
"""Points on each side of a pixel at which the screen is looked at: a pixel sees their mean."""
AROUND = 0.1
"""Light of what is around the screen, relative to its white: it does not change, and nothing trusts it."""


@dataclass(frozen=True, eq=False)
class ScreenView:
    """How a camera sees a screen.

    Args:
        width: Columns of the camera's picture [px].
        height: Rows of it [px].
        homography: From places on the screen [screen px] to places in the picture [px], shape (3, 3). The
            middle of the first pixel is at (0.5, 0.5) in both.
        offset: Time of the camera at which the first frame begins at the top of the screen [s].
        pace: Seconds of the camera that a second of the video takes.
        scan: Time after which the bottom of the screen shows a frame that the top shows already [s].

    Raises:
        InputError: The homography or a time is no number that can be.
    """

    width: int
    height: int
    homography: NDArray[np.float64]
    offset: float = 0.0
    pace: float = 1.0
    scan: float = 0.0

    def __post_init__(self) -> None:
        matrix = np.asarray(self.homography, np.float64)
        if matrix.shape != (3, 3) or not np.all(np.isfinite(matrix)) or abs(np.linalg.det(matrix)) < 1e-12:
            raise InputError("screen: the homography must be a regular matrix of shape (3, 3)")
        if not (math.isfinite(self.offset) and 0.5 < self.pace < 2 and 0 <= self.scan < 0.1):
            raise InputError(
                f"screen: offset {self.offset:g} s, pace {self.pace:g} or scan {self.scan:g} s cannot be"
            )

    @classmethod
    def filling(cls, size: tuple[int, int], screen: tuple[int, int]) -> ScreenView:
        """Return the view in which the whole screen just fits into the picture, straight and in its middle.

        Args:
            size: Columns and rows of the picture [px].
            screen: Columns and rows of the screen [px].
        """
        scale = min(size[0] / screen[0], size[1] / screen[1])
        shift = [0.5 * (size[n] - scale * screen[n]) for n in range(2)]
        matrix = np.array([[scale, 0, shift[0]], [0, scale, shift[1]], [0, 0, 1]])
        return cls(size[0], size[1], matrix)

    def on_screen(self, x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.float64]:
        """Return places on the screen [screen px] of places (x, y) in the picture [px], shape (2, ...)."""
        return apply_homography(np.linalg.inv(self.homography), x, y)


def apply_homography(matrix: NDArray[Any], x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.float64]:
    """Return where a homography (3, 3) takes places (x, y) of any shape [px], shape (2, ...).

    What lies behind the plane of the picture is taken nowhere: nan.
    """
    a = np.asarray(matrix, np.float64)
    a = a * np.sign(np.linalg.det(a))
    u, v, w = (a[row, 0] * x + a[row, 1] * y + a[row, 2] for row in range(3))
    with np.errstate(divide="ignore", invalid="ignore"):
        out: NDArray[np.float64] = np.where(w != 0, np.stack([u, v]) / w, np.nan)
    return out


@dataclass
class _Sampling:
    """Where on the screen some pixels look."""

    pixels: NDArray[np.int32]
    places: NDArray[np.int64]
    outside: NDArray[np.bool_]
    row: NDArray[np.float64]
    frames: OrderedDict[int, NDArray[np.float32]] = field(default_factory=OrderedDict)


class ScreenScene(Scene):
    """A stimulus on a screen, seen by a camera.

    A screen holds a frame until the next one, and so does the light here; it changes within the sample after
    the frame begins.
    Flicker of the backlight is light as well, not the camera's: the effect `flicker` stands for it.

    Args:
        stimulus: What is shown.
        view: How the camera sees it.
        gamma: Of the screen; None for that of the stimulus.
        gamma_error: Standard error of `gamma`; 0 where it is known.
    """

    anytime = True

    def __init__(
        self,
        stimulus: ScreenStimulus,
        view: ScreenView,
        *,
        gamma: float | None = None,
        gamma_error: float = 0.0,
    ):
        self.stimulus, self.view, self.gamma_error = stimulus, view, gamma_error
        self.gamma = stimulus.gamma if gamma is None else gamma
        self.width, self.height = view.width, view.height
        self.duration = stimulus.duration * view.pace
        self._light = stimulus.light_of_levels(self.gamma).astype(np.float32)
        self._sampling: _Sampling | None = None

    def sample_times(self) -> NDArray[np.float64]:
        """Return even times of the camera [s], a whole number of them for each refresh."""
        each = math.ceil(FINEST / self.stimulus.refresh - 0.06 * FINEST / self.stimulus.refresh)
        step = self.view.pace / self.stimulus.refresh / each
        count = self.stimulus.frame_count * each
        out: NDArray[np.float64] = np.float64(self.view.offset) + np.float64(step) * np.arange(count)
        return out

    def source(self, times: NDArray[np.float64], pixels: NDArray[np.int32], device: Any) -> tuple[str, Any]:
        """Return the light of these pixels, shape (K, N); see `Scene.source`."""
        source = pixel_stages.Frames()
        source.values = wp.array(self._values(times, pixels), dtype=float, device=device)
        return "frames", source

    def frames(self, times: NDArray[np.float64], device: str = "cpu") -> NDArray[np.float32]:
        """Return intensities at `times` [s], shape (K, height, width)."""
        every = np.arange(self.width * self.height, dtype=np.int32)
        return self._values(times, every).reshape(len(times), self.height, self.width)

    def is_trusted(self, times: NDArray[np.float64], pixels: NDArray[np.int32]) -> NDArray[np.bool_]:
        """Return where and when the scene tells the light, bool, shape (K, N).

        Pixels at the border of the screen and beyond see what nobody knows; while chequerboards are shown a
        pixel's light depends on how many of their squares it sees.
        """
        x, y = pixels % self.width + 0.5, pixels // self.width + 0.5
        corners = [self.view.on_screen(x + dx, y + dy) for dx in (-2.0, 2.0) for dy in (-2.0, 2.0)]
        (width, height), out = self.stimulus.size, np.ones(len(pixels), np.bool_)
        for u, v in corners:
            out &= (u >= 0) & (u < width) & (v >= 0) & (v < height)
        shown = (np.asarray(times) - self.view.offset) / self.view.pace
        dither = self.stimulus.segment_of("gamma")
        begin, end = dither.begin / self.stimulus.refresh, dither.end / self.stimulus.refresh
        # the first moments after it still have events of its last change
        known = (shown < begin) | (shown > end + 0.2)
        return known[:, None] & out[None, :]

    def _values(self, times: NDArray[np.float64], pixels: NDArray[np.int32]) -> NDArray[np.float32]:
        at = self._sample(pixels)
        shown = (np.asarray(times, np.float64) - self.view.offset) / self.view.pace
        # light runs straight from sample to sample: the one at which a frame begins shows the last
        delay = self.view.scan / self.view.pace * np.clip(at.row, 0, 1)
        number = np.floor((shown[:, None] - delay[None, :] - 5e-7) * self.stimulus.refresh).astype(np.int64)
        number = np.clip(number, 0, self.stimulus.frame_count - 1)
        if number.size == 0:
            return np.zeros(number.shape, np.float32)
        first, last = int(number.min()), int(number.max())
        rows = np.stack([self._frame(at, n) for n in range(first, last + 1)])
        out: NDArray[np.float32] = np.take_along_axis(rows, number - first, 0)
        return out

    def _frame(self, at: _Sampling, number: int) -> NDArray[np.float32]:
        """Return the light of a frame at the pixels of a sampling, shape (N,)."""
        if number in at.frames:
            at.frames.move_to_end(number)
            return at.frames[number]
        levels = self.stimulus.levels(number).reshape(-1)
        light: NDArray[np.float32] = self._light[levels[at.places]].mean(0, dtype=np.float32)
        light[at.outside] = AROUND
        at.frames[number] = light
        while len(at.frames) > 8:
            at.frames.popitem(last=False)
        return light

    def _sample(self, pixels: NDArray[np.int32]) -> _Sampling:
        known = self._sampling
        if known is not None and np.array_equal(known.pixels, pixels):
            return known
        x, y = pixels % self.width, pixels // self.width
        inside = (np.arange(INSIDE) + 0.5) / INSIDE
        dy, dx = (part.reshape(-1, 1) for part in np.meshgrid(inside, inside, indexing="ij"))
        (width, height), (u, v) = self.stimulus.size, self.view.on_screen(x + dx, y + dy)
        off = ~((u >= 0) & (u < width) & (v >= 0) & (v < height))
        column = np.clip(np.nan_to_num(u), 0, width - 1).astype(np.int64)
        row = np.clip(np.nan_to_num(v), 0, height - 1).astype(np.int64)
        middle = np.nan_to_num(self.view.on_screen(x + 0.5, y + 0.5)[1]) / height
        self._sampling = _Sampling(np.array(pixels), row * width + column, off.any(0), middle)
        return self._sampling


def open_stimulus(path: str | Path, *, size: tuple[int, int] | None = None) -> ScreenScene:
    """Return a stimulus of `dase stimulus` as a scene: a camera sees the whole screen, straight.

    Args:
        path: The JSON beside the video.
        size: Columns and rows of the camera; None for 346x260.

    Raises:
        InputError: It is no such file.
    """
    stimulus = read_stimulus(Path(path))
    return ScreenScene(stimulus, ScreenView.filling(size or (346, 260), stimulus.size))
