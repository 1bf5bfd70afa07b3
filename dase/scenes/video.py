"""Scenes from frames: a user's own high-speed video, or an array."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from dase import io
from dase.errors import InputError
from dase.io import frames as picture_frames
from dase.io.video_file import FrameReader
from dase.kernels import pixel_stages
from dase.kernels.scene_layers import interpolate_frames
from dase.scenes.scene import Scene

LOG_EPS = 1e-3
"""Added to intensities before the logarithm between frames; that of sensors unless they say otherwise."""


class VideoScene(Scene):
    """Frames at given times; between two frames the log intensity of a pixel runs straight.

    Args:
        frames: Linear intensity in [0, 1], shape (F, height, width).
        times: Times of the frames [s], increasing, shape (F,); the scene begins with the first.
    """

    anytime = True

    def __init__(self, frames: ArrayLike | FrameReader, times: ArrayLike):
        self._frames = frames if isinstance(frames, FrameReader) else np.asarray(frames)
        self._times = np.asarray(times, np.float64)
        if self._frames.ndim != 3 or min(self._frames.shape) < 1:
            raise InputError(f"video: frames must have shape (F, height, width), got {self._frames.shape}")
        if self._times.shape != (len(self._frames),):
            raise InputError(f"video: {len(self._frames)} frames need as many times, got {self._times.shape}")
        if not np.all(np.isfinite(self._times)) or not np.all(np.diff(self._times) > 0):
            raise InputError("video: frame times must be finite and increase")
        if isinstance(self._frames, np.ndarray) and not (
            np.all(np.isfinite(self._frames)) and self._frames.min() >= 0
        ):
            raise InputError("video: intensities must be finite and >= 0")
        self.height, self.width = self._frames.shape[1:]
        self.duration = float(self._times[-1] - self._times[0])

    def sample_times(self) -> NDArray[np.float64]:
        """Return the times of the frames [s]."""
        return self._times

    def source(self, times: NDArray[np.float64], pixels: NDArray[np.int32], device: Any) -> tuple[str, Any]:
        """Return the stored intensities of these pixels."""
        source = pixel_stages.Frames()
        above = np.minimum(np.searchsorted(self._times, times), len(self._times) - 1)
        if np.array_equal(self._times[above], times):
            # on a CPU the frames themselves: a copy would take longer than the events
            source.values = wp.array(self._rows(above, pixels), dtype=float, device=device, copy=False)
        else:
            source.values = self._between(times, above, pixels, device)
        return "frames", source

    def frames(self, times: NDArray[np.float64], device: str = "cpu") -> NDArray[np.float32]:
        """Return the frames at `times`, which must be times of frames, shape (K, height, width)."""
        return np.asarray(self._at(times), np.float32)

    def _rows(self, index: NDArray[np.int64], pixels: NDArray[np.int32]) -> NDArray[np.float32]:
        if isinstance(self._frames, np.ndarray) and np.all(np.diff(index) == 1):
            frames = self._frames[index[0] : index[0] + len(index)]  # no copy
        else:
            frames = self._frames[index]
        flat = frames.reshape(len(index), -1)
        every = np.array_equal(pixels, np.arange(flat.shape[1]))
        return np.ascontiguousarray(flat if every else flat[:, pixels], np.float32)

    def _between(
        self, times: NDArray[np.float64], above: NDArray[np.int64], pixels: NDArray[np.int32], device: Any
    ) -> Any:
        if np.any(times < self._times[0]) or np.any(times > self._times[-1]):
            raise InputError("video: asked for a time outside it")
        below = np.where(self._times[above] == times, above, above - 1)
        gap = self._times[above] - self._times[below]
        share = (times - self._times[below]) / np.where(gap > 0, gap, 1.0)
        needed, at = np.unique(np.concatenate([below, above]), return_inverse=True)
        pairs = at.reshape(2, -1).astype(np.int32)
        return interpolate_frames(self._rows(needed, pixels), pairs, share, LOG_EPS, device)

    def _at(self, times: NDArray[np.float64]) -> NDArray[Any]:
        index = np.searchsorted(self._times, times)
        if np.any(index >= len(self._times)) or not np.array_equal(self._times[index], times):
            raise InputError("video: asked for a time between its frames")
        return self._frames[index]


def as_scene(scene: Scene | ArrayLike, *, fps: float | None = None, times: ArrayLike | None = None) -> Scene:
    """Return a scene however it is given: as it is, or made of frames.

    Args:
        scene: A `Scene`, or frames of linear intensity, shape (F, height, width). Whole numbers without a
            sign are taken by the range of their type (255 or 65535 is white), others must lie in [0, 1].
        fps: Frames per second; the first frame is at 0 s. For frames only.
        times: Times of the frames [s], increasing, shape (F,), instead of `fps`.

    Raises:
        InputError: Frames without a rate or times, or with both; a scene with either; values out of range.
    """
    if isinstance(scene, Scene):
        if fps is not None or times is not None:
            raise InputError("scene: knows its own times; fps and times go with frames, shape (F, H, W)")
        return scene
    frames: NDArray[Any] = np.asarray(scene)
    if frames.ndim != 3 or frames.dtype.kind not in "uf":
        raise InputError(
            "scene: must be a dase.Scene, or frames of shape (F, height, width), uint8, uint16 or float, "
            f"got {type(scene).__name__} of type {frames.dtype} and shape {frames.shape}"
        )
    if (fps is None) == (times is None):
        raise InputError("scene: frames need either fps, such as fps=1000, or times, one for each frame [s]")
    if frames.dtype.kind == "u":
        frames = frames / np.float32(np.iinfo(frames.dtype).max)
    elif frames.size and not (frames.min() >= 0 and frames.max() <= 1):
        raise InputError(
            f"scene: frames of real numbers must lie in [0, 1], got {frames.min():g}..{frames.max():g}; "
            "divide them by the value of white"
        )
    if fps is None:
        return VideoScene(frames, np.asarray(times, np.float64))
    _check_rate(fps)
    return VideoScene(frames, np.arange(len(frames)) / fps)


def _check_rate(fps: float | None) -> None:
    if fps is not None and not (np.isfinite(fps) and fps > 0):
        raise InputError(f"fps must be a number > 0, got {fps:g}")


def open_video(path: Path, *, fps: float | None = None, size: tuple[int, int] | None = None) -> VideoScene:
    """Return the scene of a video file, of a folder of frames, or of the frames of a recording.

    Args:
        path: File or folder; the events of a recording, such as a sequence of `dase synth`, do not matter.
        fps: Frames per second; None takes what the file says.
        size: Columns and rows to resize to; None keeps the video's.

    Raises:
        InputError: Missing or undecodable, or a folder without a rate.
    """
    _check_rate(fps)
    path = Path(path)
    if _is_recording(path):
        return _scene_of(path, fps, size)
    reader = FrameReader(path, size)
    rate = fps or reader.rate
    if not rate > 0:
        raise InputError(f"{path} does not say how many frames it has per second: give fps", argument="fps")
    return VideoScene(reader, np.arange(len(reader)) / rate)


def _is_recording(path: Path) -> bool:
    if not path.is_file():
        return False
    try:
        return io.find_format(path) is not picture_frames.FORMAT  # which are videos and pictures
    except InputError:
        return False


def _scene_of(path: Path, fps: float | None, size: tuple[int, int] | None) -> VideoScene:
    """Return the scene of a recording's frames."""
    sequence = io.read(path)
    if sequence.frames is None or len(sequence.frames) < 2:
        raise InputError(f"video {path}: the recording must have at least 2 frames to be taken for a video")
    frames = sequence.frames
    if size is not None:
        frames = np.stack([cv2.resize(frame, size, interpolation=cv2.INTER_AREA) for frame in frames])
    if fps is None and sequence.frame_times is None:
        raise InputError(f"{path} does not say when its frames were taken: give fps", argument="fps")
    times = sequence.frame_times if fps is None else np.arange(len(frames)) / fps
    assert times is not None
    return VideoScene(frames / np.float32(255), times - times[0])
