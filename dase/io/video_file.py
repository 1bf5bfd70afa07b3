"""Frames of a video file, decoded one after the other."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.files.text_files import stands_for
from dase.io.ffmpeg import bounded_decoding, decoding_memory, open_video, pixel_format, refuse_titles, size_of
from dase.io.image_files import (
    cut_and_resize,
    decode_file,
    grey_and_colour,
    list_pictures,
    to_grey,
    to_levels,
    weights_of,
)

KEPT = 64 << 20
"""Bytes of frames that are kept as they were decoded while they were counted."""

TOGETHER = 16 << 20
"""Bytes of decoded frames that are turned to grey at once, at most one frame more."""


class FrameReader:
    """Frames of a file or folder, decoded when they are asked for, so that long videos need no memory.

    A video is gone through to count its frames; a short one, of at most `KEPT` bytes, is not decoded again.

    Args:
        path: Video file, or folder of pictures in the order of their names.
        size: Columns and rows to cut the middle to and resize to, or None.
        colour: Whether `planes` has colours beside the grey.
    """

    def __init__(self, path: Path, size: tuple[int, int] | None = None, *, colour: bool = False):
        self._path, self._size, self.colour = path, size, colour
        if not path.exists():
            raise InputError(f"video {path} does not exist")
        self._files = list_pictures(path) if path.is_dir() else None
        if self._files is None:
            with path.open("rb") as file:
                pointer = stands_for(file.read(1024))
            if pointer:
                raise InputError(f"video {path} {pointer}")
        self._capture: Any = None
        self._plain: tuple[int, int] | None = None
        self.rate = 0.0
        self.times: NDArray[np.float64] | None = None
        """Of the frames of a video [s], from 0, where it does not say that they come evenly at `rate`."""
        self.packed = sum(file.stat().st_size for file in self._files or [path])
        """Bytes of all files."""
        self.decoding = 0
        """Bytes of memory that decoding takes at most, beside the frames after the first `capture.TAKEN`."""
        self._first: tuple[int, ...] = ()
        self._short: list[NDArray[np.uint8]] = []  # all frames of a short video
        self._count = len(self._files) if self._files is not None else self._count_frames()
        if self._count < 2:
            raise InputError(f"video {path} must have at least 2 frames, got {self._count}")
        # of the last two calls that decoded: frames are also stored, which are asked for after those of the
        # next chunk where pixels are ahead of their events
        self._kept: deque[dict[int, NDArray[np.float32]]] = deque(maxlen=2)
        self._next = 0
        if self._files is not None:
            self._first = decode_file(self._files[0]).shape[:2]
        self.shape: tuple[int, ...] = (self._count, *(self._first if size is None else size[::-1]))
        self.ndim = 3

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return the frames of increasing indices, intensity in [0, 1], shape (K, height, width).

        They are not to be changed: later calls take from them.
        """
        return self.planes(index)[:, 0]

    def planes(self, index: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return frames in [0, 1], shape (K, 1, height, width): grey; with colour (K, 4, ...): R, G, B, too.

        Args:
            index: Increasing, shape (K,). What is returned is not to be changed: later calls take from it.
        """
        wanted = [int(i) for i in index]
        out = np.empty((len(wanted), 4 if self.colour else 1, *self.shape[1:]), np.float32)
        if self._files is not None:
            files = [self._files[i] for i in wanted]
            for planes, file in zip(out, files, strict=True):
                planes[:] = self._planes_of(decode_file(file), file)
            return out
        place = {i: n for n, i in enumerate(wanted)}
        known = {i: frame for kept in self._kept for i, frame in kept.items() if i in place}
        for i, frame in known.items():
            out[place[i]] = frame
        missing = sorted(place.keys() - known.keys())
        if missing and missing[0] < self._next:
            self._capture, self._next = None, 0
        waiting: list[tuple[NDArray[np.uint8], NDArray[np.float32]]] = []
        for i in range(self._next, missing[-1] + 1 if missing else 0):
            pixels = self._checked(self._decode(i), self._path)
            if i in place:
                waiting.append((pixels, out[place[i]]))
                if len(waiting) * pixels.nbytes >= TOGETHER:
                    self._write_planes(waiting)
        if missing:
            self._write_planes(waiting)
            self._kept.append(dict(zip(wanted, out, strict=True)))
        return out

    def levels(self) -> Iterator[NDArray[np.uint8]]:
        """Yield all frames, 0 to 255, shape (height, width), not resized; little but a frame is kept."""
        if self._files is not None:
            for file in self._files:
                yield to_levels(self._checked(decode_file(file), file))
            return
        capture = None if self._short else self._open()
        for index in range(self._count):
            yield to_levels(self._checked(self._next_of(capture, index), self._path))

    def _open(self) -> Any:
        capture = open_video(self._path)
        if self._plain is not None:
            capture.set(cv2.CAP_PROP_FORMAT, -1)  # packets as they are
        return capture

    def _count_frames(self) -> int:
        refuse_titles(self._path)
        capture = self._open()
        size = size_of(capture)
        kind = pixel_format(capture)
        # an uncompressed AVI: OpenCV 5.0 writes beyond its memory where it turns one over
        self._plain = size if kind == (bytes(4), b"BGR\x18") else None
        self.rate = float(capture.get(cv2.CAP_PROP_FPS))
        if self._plain is not None:
            capture = self._open()
        frame = self._read(capture)
        if frame is None:
            return 0
        self.decoding = decoding_memory(capture)
        self._first = frame.shape[:2]
        times, there, keeps = [], True, True
        while there:
            times.append(float(capture.get(cv2.CAP_PROP_POS_MSEC)))  # the number in the header is often wrong
            keeps = keeps and self._keep(frame)
            if self._plain is not None:
                frame = self._read(capture)
                there = frame is not None
            else:
                there = self._grab(capture)
                frame = self._retrieve(capture) if there and keeps else None
        self.times = _uneven_times(np.array(times) * 1e-3, self.rate)
        return len(times)

    def _keep(self, frame: NDArray[np.uint8] | None) -> bool:
        """Keep a frame behind those before it; without it, or where they are too many, keep none."""
        if frame is None or (len(self._short) + 1) * frame.nbytes > KEPT:
            self._short.clear()
            return False
        self._short.append(frame)
        return True

    def _grab(self, capture: Any) -> bool:
        """Decode the next frame; what is far larger than the head of the file says cannot be decoded."""
        with bounded_decoding(capture, self.packed):
            return bool(capture.grab())

    def _read(self, capture: Any) -> NDArray[np.uint8] | None:
        while self._grab(capture):
            frame = self._retrieve(capture)
            if frame is not None and self._plain is not None:
                frame = _unpack_avi_frame(capture, frame.ravel(), self._plain)
                if frame is None:
                    continue  # a packet of a dropped frame is empty
            return frame
        return None

    @staticmethod
    def _retrieve(capture: Any) -> NDArray[np.uint8] | None:
        """Return the frame that was decoded last as blue, green and red, None where it cannot be had."""
        good, frame = capture.retrieve()
        return frame if good else None

    def _next_of(self, capture: Any, index: int) -> NDArray[np.uint8]:
        frame = self._short[index] if self._short else self._read(capture)
        if frame is None:
            raise InputError(f"video {self._path}: frame {index} cannot be decoded")
        return frame

    def _decode(self, index: int) -> NDArray[np.uint8]:
        if self._capture is None and not self._short:
            self._capture = self._open()
        frame = self._next_of(self._capture, index)
        self._next = index + 1
        return frame

    def _checked(self, pixels: NDArray[Any], path: Path) -> NDArray[Any]:
        """Return pixels; raises InputError where their size is not that of the first frame."""
        got, want = pixels.shape[:2], self._first
        if got != want:
            sizes = f"{got[1]}x{got[0]}, the frames before {want[1]}x{want[0]}"
            raise InputError(f"video: all frames must have one size, {path} has {sizes}")
        return pixels

    def _write_planes(self, frames: list[tuple[NDArray[np.uint8], NDArray[np.float32]]]) -> None:
        """Write planes (1 or 4, height, width) of a video's frames to their places, and empty the list."""
        plain = self._size is None and not self.colour
        if plain and frames and all(_is_packed(pixels) for pixels, _ in frames):
            # here alone, as Warp takes longer to start than to look at a file
            from dase.kernels.picture_grey import write_greys

            pictures, planes = zip(*frames, strict=True)
            write_greys(pictures, weights_of(pictures[0]), [plane[0] for plane in planes])
        else:
            for pixels, there in frames:
                there[:] = self._planes_of(pixels, self._path)
        frames.clear()

    def _planes_of(self, pixels: NDArray[Any], path: Path) -> NDArray[np.float32]:
        """Return the planes of a frame, shape (1 or 4, height, width)."""
        pixels = self._checked(pixels, path)
        planes = grey_and_colour(pixels) if self.colour else to_grey(pixels)[0][None]
        if self._size is None:
            return planes
        return np.stack([cut_and_resize(plane, self._size) for plane in planes])


def _uneven_times(times: NDArray[np.float64], rate: float) -> NDArray[np.float64] | None:
    """Return the times that frames say [s], from 0; None where they say none, or those of the rate."""
    times = times - times[0]
    if not (np.all(np.isfinite(times)) and np.all(np.diff(times) > 0)):
        return None
    # containers round times, Matroska to 1 ms
    even = 0 < rate < 1e7 and np.allclose(times, np.arange(len(times)) / rate, rtol=0, atol=1.1e-3)
    return None if even else times


def _unpack_avi_frame(
    capture: Any, packet: NDArray[np.uint8], size: tuple[int, int]
) -> NDArray[np.uint8] | None:
    """Return the frame (H, W, 3) of the bytes of an uncompressed AVI, or None where some are missing."""
    width, height = size
    step = -(-3 * width // 4) * 4  # rows end at multiples of four bytes, in most files
    step = step if len(packet) >= step * height else 3 * width
    if len(packet) < step * height:
        return None
    frame = packet[: step * height].reshape(height, step)[:, : 3 * width].reshape(height, width, 3)
    _, more = capture.retrieve(flag=int(capture.get(cv2.CAP_PROP_CODEC_EXTRADATA_INDEX)))
    upward = more is not None and more.tobytes().endswith(b"BottomUp\0")  # what FFmpeg calls it
    return frame[::-1] if upward else frame


def _is_packed(pixels: NDArray[Any]) -> bool:
    """Whether pixels are three bytes each without gaps, of which a kernel is given the address."""
    return pixels.dtype == np.uint8 and pixels.shape[2:] == (3,) and pixels.flags.c_contiguous
