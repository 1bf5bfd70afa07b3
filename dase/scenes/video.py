"""Scenes from frames: a user's own high-speed video, or an array."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from dase import io
from dase.errors import InputError
from dase.io import frames as picture_frames
from dase.io.image_files import cut_and_resize, grey_and_colour, list_pictures
from dase.io.video_file import FrameReader
from dase.kernels import pixel_stages
from dase.kernels.scene_blur import blur_pictures
from dase.kernels.scene_layers import interpolate_frames
from dase.kernels.stored_levels import LEVELS, light_of_levels, upload_levels
from dase.scenes.between_frames import CameraScene
from dase.scenes.light import SRGB_GAMMA, check_gamma, check_light, to_light
from dase.scenes.scene import LOG_EPS as LOG_EPS
from dase.scenes.scene import Scene, check_exposures


class ColourFrames:
    """Frames with colours, turned to planes when they are asked for.

    Args:
        frames: Red, green and blue, shape (F, height, width, 3), of the types that `VideoScene` takes.
    """

    def __init__(self, frames: NDArray[Any]):
        self._frames = frames

    def planes(self, index: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return grey, red, green and blue in [0, 1] of frames (K,), shape (K, 4, height, width)."""
        turned = (np.ascontiguousarray(self._frames[i][..., ::-1]) for i in index)
        return np.stack([grey_and_colour(frame) for frame in turned])


class FilteredFrames:
    """Frames behind a colour filter, worked out when they are asked for: linear intensity.

    Args:
        frames: With their colours.
        shape: Frames, rows and columns.
        gamma: Linear intensity is value ** gamma.
        colour: Of the filter, 0 for red, 1 for green, 2 for blue.
        purity: As `Scene.filtered` takes it.
    """

    ndim = 3

    def __init__(
        self,
        frames: ColourFrames | FrameReader,
        shape: tuple[int, ...],
        gamma: float,
        colour: int,
        purity: float,
    ):
        self._frames, self.shape, self._gamma, self._colour = frames, shape, gamma, colour
        self._purity = np.float32(purity)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return the frames of increasing indices (K,), shape (K, height, width)."""
        planes = self._frames.planes(index)
        grey, own = (to_light(planes[:, n], gamma=self._gamma) for n in (0, 1 + self._colour))
        return grey + self._purity * (own - grey)


class RepeatedFrames:
    """Frames of which each is there several times, without a copy.

    Args:
        frames: Of shape (F, height, width).
        index: Which frame each is, not decreasing, shape (N,).
    """

    ndim = 3

    def __init__(self, frames: Frames, index: NDArray[np.int64]):
        self._frames, self._index = frames, index
        self.shape: tuple[int, ...] = (len(index), *frames.shape[1:])
        self.dtype = getattr(frames, "dtype", None)

    def __len__(self) -> int:
        return len(self._index)

    def of(self, changed: Callable[[Frames], Frames]) -> RepeatedFrames:
        """Return the same frames, each of shape (height, width) changed once however often it is there."""
        return RepeatedFrames(changed(self._frames), self._index)

    def __getitem__(self, index: NDArray[np.int64]) -> NDArray[Any]:
        """Return the frames of increasing indices (K,), shape (K, height, width)."""
        needed, place = np.unique(self._index[index], return_inverse=True)
        out: NDArray[Any] = self._frames[needed][place]
        return out


class BlurredFrames:
    """Frames behind a lens, worked out when they are asked for: linear intensity.

    Args:
        frames: Without the lens.
        gamma: Linear intensity is value ** gamma.
        weights: Of the middle, the first neighbours, the second neighbours and so on, shape (R + 1,).
    """

    ndim = 3

    def __init__(self, frames: Frames, gamma: float, weights: NDArray[np.float32]):
        self._frames, self._gamma, self._weights = frames, gamma, weights
        self.shape: tuple[int, ...] = tuple(frames.shape)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return the frames of increasing indices (K,), shape (K, height, width)."""
        light = to_light(self._frames[index], gamma=self._gamma)
        return blur_pictures(np.ascontiguousarray(light, np.float32), self._weights)


EARLY = 5e-6
"""Begin of a held frame's light before its time [s]: what comes at once is stamped with that time."""

EARLY_SHARE = 0.01
"""The same of light that goes straight from frame to frame, as a share of the time from one to the next."""

Frames = NDArray[Any] | FrameReader | FilteredFrames | RepeatedFrames | BlurredFrames
"""What a `VideoScene` takes frames from, shape (F, height, width)."""


class VideoScene(Scene):
    """Frames at given times; between two frames the log intensity of a pixel runs straight.

    Args:
        frames: Intensity, shape (F, height, width), or red, green and blue, shape (F, height, width, 3), of
            which sensors without colour filters see the luma. Whole numbers without a sign are taken by the
            range of their type (255 or 65535 is white), real numbers by 1.
        times: Times of the frames [s], increasing, shape (F,); the scene begins with the first.
        gamma: Linear intensity is value ** gamma: 1 for linear values, 2.2 for pictures and videos.

    Raises:
        InputError: Shapes or times do not fit, or a value cannot be light.
    """

    anytime = True
    held_for = 0.0
    """Time for which each frame is shown unchanged [s]; 0 where light goes straight from frame to frame."""

    parts = 1
    """Samples of a held frame."""

    by_frames = False
    """Whether a simulator has filtered light from frame to frame, and knows none between them."""

    forgets = ""
    """What a simulator forgets from frame to frame: where `HighPass.at` says so, or nothing."""

    early = 0.0
    """By how much it is earlier than the times that are written beside its frames [s]."""

    sharp: VideoScene | None = None
    """The clip as it is, where this is what a lens makes of it."""

    def __init__(
        self,
        frames: ArrayLike | FrameReader | FilteredFrames | RepeatedFrames | BlurredFrames,
        times: ArrayLike,
        *,
        gamma: float = 1.0,
    ):
        self.gamma = check_gamma(gamma)
        self._frames: Frames = (
            frames
            if isinstance(frames, FrameReader | FilteredFrames | RepeatedFrames | BlurredFrames)
            else np.asarray(frames)
        )
        self._colours: ColourFrames | FrameReader | None = None
        if isinstance(frames, FrameReader) and frames.colour:
            self._colours = frames
        elif isinstance(self._frames, np.ndarray) and self._frames.ndim == 4 and self._frames.shape[3] == 3:
            check_light(self._frames, "video")
            self._colours = ColourFrames(self._frames)
            every = np.arange(len(self._frames))
            self._frames = np.stack([self._colours.planes(every[i : i + 1])[0, 0] for i in every])
        self._times = np.asarray(times, np.float64)
        if self._frames.ndim != 3 or min(self._frames.shape) < 1:
            shape = self._frames.shape
            raise InputError(
                f"video: frames must have shape (F, height, width), got {shape}; colours add a 3 at its end"
            )
        if self._times.shape != (len(self._frames),):
            raise InputError(f"video: {len(self._frames)} frames need as many times, got {self._times.shape}")
        if not np.all(np.isfinite(self._times)) or not np.all(np.diff(self._times) > 0):
            raise InputError("video: frame times must be finite and increase")
        if isinstance(self._frames, np.ndarray):
            check_light(self._frames, "video")
        self._lens_weights = np.ones(1, np.float32)
        self._light_of_level: NDArray[np.float32] | None = None
        if getattr(self._frames, "dtype", None) == np.uint8:
            self._light_of_level = to_light(np.arange(LEVELS, dtype=np.uint8), gamma=self.gamma)
        self.height, self.width = self._frames.shape[1:]
        self.duration = float(self._times[-1] - self._times[0])

    def sample_times(self) -> NDArray[np.float64]:
        """Return the times of the frames [s]."""
        return self._times

    def frame_times(self) -> NDArray[np.float64]:
        """Return the times that are written beside the frames [s], whether they are held or not."""
        return self._times[:: self.parts] + EARLY if self.held_for else self._times + self.early

    def forgetting(self, at: str) -> VideoScene:
        """Return the clip as a simulator sees it whose pixels forget from frame to frame.

        Args:
            at: What they forget, see `HighPass`.
        """
        out = copy(self)
        out.forgets = at
        out.sharp = self.sharp and self.sharp.forgetting(at)
        return out

    def begun_early(self, step: float) -> VideoScene:
        """Return the clip a little earlier, for events that are stamped with the time their light begins at.

        Args:
            step: From frame to frame [s].
        """
        if self.early:
            return self
        out = copy(self)
        out.early = EARLY_SHARE * step
        out._times = self._times - out.early
        out.sharp = self.sharp and self.sharp.begun_early(step)
        return out

    def known_at_frames(self) -> VideoScene:
        """Return the light as a simulator takes it that knows the frames alone."""
        other = copy(self)
        other.by_frames = True
        other.sharp = self.sharp and self.sharp.known_at_frames()
        return other

    def longest_gap(self) -> float:
        """Return the longest time from frame to frame [s]; 0 for one frame."""
        return self.held_for or float(np.diff(self._times).max(initial=0.0))

    def in_parts(self, parts: int) -> VideoScene:
        """Return the clip with pictures between its frames, straight in intensity, all of them in memory.

        Args:
            parts: From each frame to the next.
        """
        light = to_light(self._frames[np.arange(len(self._times))], gamma=self.gamma)
        out = np.empty((parts * (len(light) - 1) + 1, *light.shape[1:]), np.float32)
        out[::parts] = light
        change = np.diff(light, axis=0)
        for part in range(1, parts):
            out[part::parts] = light[:-1] + np.float32(part / parts) * change
        inner = self._times[:-1, None] + np.diff(self._times)[:, None] * np.arange(parts) / parts
        return VideoScene(out, np.append(inner.ravel(), self._times[-1]))

    def of_rows(self, first: int, after: int) -> VideoScene:
        """Return some rows of the clip.

        Args:
            first: The first of them.
            after: The one after the last.
        """
        return VideoScene(
            self._frames[np.arange(len(self._times))][:, first:after], self._times, gamma=self.gamma
        )

    def held(self, step: float) -> VideoScene:
        """Return the light of each frame shown from the time of the one before on, unchanged until its own.

        Light goes over to a frame in the first part of the time that it is shown, and is at rest in the last.

        Args:
            step: Length of the parts, about [s]; there are two of each frame at least.
        """
        if self.sharp is not None:
            return self.sharp.held(step).blurred(self._lens_weights)
        gaps = np.diff(self._times)
        parts = max(2, round(float(np.median(gaps)) / step)) if len(gaps) else 1
        inner = self._times[:-1, None] + gaps[:, None] * (np.arange(parts) + 1) / parts
        inner[:, -1] = self._times[1:]
        index = np.concatenate(([0], np.repeat(np.arange(1, len(self._times)), parts)))
        times = np.concatenate((self._times[:1], inner.ravel())) - EARLY
        out = VideoScene(RepeatedFrames(self._frames, index), times, gamma=self.gamma)
        out.held_for, out.parts = self.longest_gap(), parts
        return out

    def blurred(self, weights: NDArray[np.float32]) -> VideoScene:
        """Return the clip as a lens shows it: each frame blurred along its rows and its columns.

        Args:
            weights: Of the middle, the first neighbours, the second neighbours and so on, shape (R + 1,).
        """
        frames: BlurredFrames | RepeatedFrames
        if isinstance(self._frames, RepeatedFrames):
            frames = self._frames.of(lambda once: BlurredFrames(once, self.gamma, weights))
        else:
            frames = BlurredFrames(self._frames, self.gamma, weights)
        out = VideoScene(frames, self._times)
        out.held_for, out.parts, out.by_frames = self.held_for, self.parts, self.by_frames
        out.early, out.forgets = self.early, self.forgets
        out.sharp, out._lens_weights = self, weights
        return out

    def source(self, times: NDArray[np.float64], pixels: NDArray[np.int32], device: Any) -> tuple[str, Any]:
        """Return the stored intensities of these pixels, shape (K, N); see `Scene.source`.

        On a CPU those of 8 bits are the levels that they are.
        """
        source = pixel_stages.Frames()
        above = np.minimum(np.searchsorted(self._times, times), len(self._times) - 1)
        if np.array_equal(self._times[above], times):
            if self._light_of_level is not None:
                levels = upload_levels(self._values(above, pixels), self._light_of_level, device)
                if device.is_cpu:
                    return "levels", levels
                source.values = light_of_levels(levels, device)
                return "frames", source
            # on a CPU the frames themselves: a copy would take longer than the events
            source.values = wp.array(self._rows(above, pixels), dtype=float, device=device, copy=False)
        else:
            source.values = self._between(times, above, pixels, device)
        return "frames", source

    def frames(self, times: NDArray[np.float64], device: str = "cpu") -> NDArray[np.float32]:
        """Return the frames at `times`, which must be times of frames, shape (K, height, width)."""
        return to_light(self._at(times), gamma=self.gamma)

    def filtered(self, purity: float) -> tuple[Scene, Scene, Scene] | None:
        """Return the video behind a red, a green and a blue filter; see `Scene.filtered`."""
        if self._colours is None:
            return None
        red, green, blue = (
            VideoScene(FilteredFrames(self._colours, self._frames.shape, self.gamma, c, purity), self._times)
            for c in range(3)
        )
        return red, green, blue

    def exposed_frames(
        self, begins: NDArray[np.float64], exposure: float, device: str = "cpu"
    ) -> NDArray[np.float32]:
        """Return frames with their blur, exactly: the mean of the exponentials of straight lines.

        Times `begins` and `exposure` [s], and the result of shape (K, height, width), are those of
        `Scene.exposed_frames`.
        """
        check_exposures(self, begins, exposure)
        out = np.empty((len(begins), self.height, self.width), np.float32)
        for frame, edges in zip(out, self._exposure_edges(begins, exposure), strict=True):
            light = self._light_between(edges) + LOG_EPS
            step = np.log(light[1:] / light[:-1])
            steep = np.abs(step) > 1e-6  # below, the mean of both ends is as exact as float64
            mean = np.where(steep, np.diff(light, axis=0), 0.0) / np.where(steep, step, 1.0)
            mean = np.where(steep, mean, (light[1:] + light[:-1]) / 2)
            frame[:] = np.tensordot(np.diff(edges) / (edges[-1] - edges[0]), mean, 1) - LOG_EPS
        return np.maximum(out, 0, out=out)

    def _light_between(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the intensities at any `times` [s] of the video, float64, shape (K, height, width)."""
        above = np.clip(np.searchsorted(self._times, times), 1, len(self._times) - 1)
        share = (times - self._times[above - 1]) / (self._times[above] - self._times[above - 1])
        needed, at = np.unique(np.concatenate([above - 1, above]), return_inverse=True)
        level = np.log(to_light(self._frames[needed], gamma=self.gamma).astype(np.float64) + LOG_EPS)
        below, over = level[at[: len(times)]], level[at[len(times) :]]
        return np.asarray(np.exp(below + share[:, None, None] * (over - below)) - LOG_EPS)

    def _values(self, index: NDArray[np.int64], pixels: NDArray[np.int32]) -> NDArray[Any]:
        """Return frames as they are given, for these pixels, shape (K, N)."""
        if isinstance(self._frames, np.ndarray) and np.all(np.diff(index) == 1):
            frames = self._frames[index[0] : index[0] + len(index)]  # no copy
        else:
            frames = self._frames[index]
        flat = frames.reshape(len(index), -1)
        first = int(pixels[0]) if len(pixels) else 0
        if np.array_equal(pixels, np.arange(first, first + len(pixels))):
            return np.ascontiguousarray(flat[:, first : first + len(pixels)])
        return np.take(flat, pixels, axis=1)

    def _rows(self, index: NDArray[np.int64], pixels: NDArray[np.int32]) -> NDArray[np.float32]:
        return to_light(self._values(index, pixels), gamma=self.gamma)

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
            Red, green and blue have the shape (F, height, width, 3).
        fps: Frames per second; the first frame is at 0 s. For frames only.
        times: Times of the frames [s], increasing, shape (F,), instead of `fps`.

    Raises:
        InputError: Frames without a rate or times, or with both; a scene with either; values out of range.
    """
    if isinstance(scene, Scene):
        if fps is not None or times is not None:
            raise InputError("scene: knows its own times; fps and times go with frames, shape (F, H, W)")
        return scene
    if isinstance(scene, str | PathLike):
        raise InputError(f"scene: '{scene}' is a path; dase.open_video(path) makes a scene of a video")
    frames: NDArray[Any] = np.asarray(scene)
    coloured = frames.ndim == 4 and frames.shape[3] == 3
    if not (frames.ndim == 3 or coloured) or frames.dtype.kind not in "uf":
        raise InputError(
            "scene: must be a dase.Scene, or frames of shape (F, height, width), uint8, uint16 or float, "
            f"got {type(scene).__name__} of type {frames.dtype} and shape {frames.shape}"
        )
    if (fps is None) == (times is None):
        raise InputError("scene: frames need either fps, such as fps=1000, or times, one for each frame [s]")
    check_light(frames, "scene", most=1.0)
    if fps is None:
        return VideoScene(frames, np.asarray(times, np.float64))
    _check_rate(fps)
    return VideoScene(frames, np.arange(len(frames)) / fps)


def _check_rate(fps: float | None) -> None:
    if fps is not None and not (np.isfinite(fps) and fps > 0):
        raise InputError(f"fps must be a number > 0, got {fps:g}")


COARSEST = 2e-3
"""Time between frames [s] up to which straight lines between them say enough; beyond it is motion."""


def open_video(
    path: Path,
    *,
    fps: float | None = None,
    size: tuple[int, int] | None = None,
    gamma: float | None = None,
    between: str = "auto",
    colour: bool = False,
    notes: list[str] | None = None,
) -> VideoScene | CameraScene:
    """Return the scene of a video file, of a folder of frames, or of the frames of a recording.

    Args:
        path: File or folder; the events of a recording, such as a sequence of `dase synth`, do not matter.
        fps: Frames per second; None takes the times that the file, or `timestamps.txt` in the folder, says.
        size: Columns and rows to cut to shape and resize to; None keeps the video's.
        gamma: Linear intensity is value ** gamma. None takes the file's: 2.2 for pictures and videos unless
            they say otherwise, 1 for recordings.
        between: `lines` joins the frames by straight lines, `motion` follows the motion from frame to frame,
            `auto` takes motion where frames are more than 2 ms apart.
        colour: Whether colours are kept, for sensors with colour filters. Frames of recordings have none.
        notes: Gets sentences about what was assumed.

    Raises:
        InputError: Missing or undecodable, or a folder without a rate.
    """
    _check_rate(fps)
    if between not in BETWEEN:
        raise InputError(f"between must be one of {', '.join(BETWEEN)}, got '{between}'")
    path, notes = Path(path), [] if notes is None else notes
    frames: Any
    if _is_recording(path):
        frames, times = _frames_of_recording(path, fps, size)
        found = 1.0
    else:
        frames = FrameReader(path, size, colour=colour)
        times = _video_times(path, frames, fps)
        found = _file_gamma(path)
    if gamma is None:
        gamma = found
        notes.append(f"light is taken as value ** {gamma:g}: give gamma where that is wrong")
    return join_frames(frames, times, gamma=gamma, between=between, notes=notes)


def join_frames(
    frames: Any,
    times: NDArray[np.float64],
    *,
    gamma: float = 1.0,
    between: str = "auto",
    notes: list[str] | None = None,
) -> VideoScene | CameraScene:
    """Return the scene of frames at moments: joined by lines where they are dense, else following the motion.

    Args:
        frames: Grey values, shape (F, H, W), or a `FrameReader`.
        times: Of the frames [s], shape (F,).
        gamma: Linear intensity is value ** gamma.
        between: As `open_video` takes it.
        notes: Gets sentences about what is between them.

    Raises:
        InputError: Fewer than two frames, or times that do not increase.
    """
    notes = [] if notes is None else notes
    if between == "lines" or (between == "auto" and are_dense(times)):
        if not are_dense(times):
            gap = 1e3 * float(np.median(np.diff(times)))
            notes.append(f"frames are {gap:.1f} ms apart and joined by straight lines")
        return VideoScene(frames, times, gamma=gamma)
    kept, colours = _all_frames(frames) if isinstance(frames, FrameReader) else (frames, None)
    scene = CameraScene(kept, times, gamma=gamma, colours=colours)
    share = scene.trusted().mean()
    gap = 1e3 * float(np.median(np.diff(times)))
    notes.append(
        f"frames are {gap:.1f} ms apart: the motion from one to the next is followed, "
        f"{100 * share:.0f} % of pixels and times are to be trusted (dase show --trust draws them)"
    )
    return scene


def are_dense(times: NDArray[np.float64]) -> bool:
    """Return whether frames at these times [s], (F,), are so dense that straight lines may join them."""
    # those that come exactly as slowly as the slowest steps of a comparison are
    return len(times) < 2 or float(np.median(np.diff(times))) <= COARSEST * (1 + 1e-6)


BETWEEN = ("auto", "motion", "lines")
"""What may be between frames, see `open_video`."""


def _video_times(path: Path, reader: FrameReader, fps: float | None) -> NDArray[np.float64]:
    """Return the times of frames [s], from 0: what the user says, else what lies beside or in the file."""
    if fps is not None:
        return np.arange(len(reader)) / fps
    listed = path / picture_frames.TIMES
    if path.is_dir() and listed.is_file():
        times = picture_frames.listed_times(listed, len(reader))
        return np.asarray(times - times[0])
    if reader.times is not None:
        return reader.times
    if not reader.rate > 0:
        raise InputError(f"{path} does not say how many frames it has per second: give its frame rate, fps")
    return np.arange(len(reader)) / reader.rate


def _file_gamma(path: Path) -> float:
    """Return the gamma that the first picture of a folder says, else that of sRGB."""
    from PIL import Image  # only folders of pictures say one

    first = next(iter(list_pictures(path)), None) if path.is_dir() else None
    if first is None:
        return SRGB_GAMMA
    try:
        with Image.open(first) as picture:
            said = picture.info.get("gamma")  # of PNG: the power that the values are of light
    except OSError:
        return SRGB_GAMMA
    return 1 / said if isinstance(said, float) and 0.1 <= said <= 10 else SRGB_GAMMA


def _all_frames(
    reader: FrameReader, most: int = 8 << 30
) -> tuple[NDArray[np.uint16], NDArray[np.uint16] | None]:
    """Return all frames, of 16 bits, as motion is looked for in all of them, and their colours if kept."""
    planes = 4 if reader.colour else 1
    size = 2 * planes * int(np.prod(reader.shape))
    if size > most:
        raise InputError(
            f"video: its frames need {size / (1 << 30):.1f} GiB of memory to follow their motion, more than "
            f"{most >> 30}: cut it into parts, give a smaller size, or join frames by lines",
            argument="between",
        )
    grey = np.empty(reader.shape, np.uint16)
    colours = np.empty((reader.shape[0], 3, *reader.shape[1:]), np.uint16) if reader.colour else None
    for index in range(len(reader)):
        levels = np.rint(np.float32(65535) * reader.planes(np.array([index]))[0])
        grey[index] = levels[0]
        if colours is not None:
            colours[index] = levels[1:]
    return grey, colours


def _is_recording(path: Path) -> bool:
    if not path.is_file():
        return False
    try:
        return io.find_format(path) is not picture_frames.FORMAT  # which are videos and pictures
    except InputError:
        return False


def _frames_of_recording(
    path: Path, fps: float | None, size: tuple[int, int] | None
) -> tuple[NDArray[Any], NDArray[np.float64]]:
    """Return a recording's frames and their times [s] from 0."""
    sequence = io.read(path, flow=False)
    if sequence.frames is None or len(sequence.frames) < 2:
        raise InputError(f"video {path}: the recording must have at least 2 frames to be taken for a video")
    frames: NDArray[Any] = sequence.frames
    if size is not None:
        frames = np.stack([cut_and_resize(frame, size) for frame in frames])
    if fps is None and sequence.frame_times is None:
        raise InputError(f"{path} does not say when its frames were taken: give fps", argument="fps")
    times = sequence.frame_times if fps is None else np.arange(len(frames)) / fps
    assert times is not None
    return frames, times - times[0]
