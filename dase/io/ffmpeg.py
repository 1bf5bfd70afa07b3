"""Videos opened with FFmpeg as OpenCV has it: in memory that small files cannot drive up.

A file of a few kB may hold frames that take gigabytes, as black ones pack well. So the head is read before
anything is decoded, and tells what decoding would take at most; FFmpeg is told how much it may take at once.
"""

from __future__ import annotations

import ctypes
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2

from dase.errors import InputError
from dase.io.image_files import quiet_opencv
from dase.io.source import BOMB_BYTES, refuse_bomb

TAKEN = 10
"""Frames that are kept as grey at once, at least: of a byte per pixel each."""
PIECE = 1 << 22
"""Bytes of a file that are looked at together."""


@dataclass(frozen=True)
class FfmpegEnvironment:
    """How FFmpeg inside of OpenCV is told what to do."""

    options: str = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
    """Variable with its options."""

    log_level: str = "OPENCV_FFMPEG_LOGLEVEL"
    """Variable with the level of its messages."""

    quiet: int = -8
    """The level of none at all."""


ENVIRONMENT = FfmpegEnvironment()


@dataclass(frozen=True)
class AllocationLimits:
    """How much FFmpeg may take at once, see `_at_once`."""

    always: int = 4 << 20
    """Bytes that it may always take: a frame of 4 megapixels, of which even 26 stay below 200 MiB."""

    untold_size: tuple[int, int] = (2048, 2048)
    """Columns and rows that it may decode, in any format, where the head of a file does not tell them."""

    border: int = 256
    """Columns and rows that it adds to a frame at most [px]."""

    none: int = (1 << 31) - 1
    """Bytes that it takes unless told otherwise."""


ALLOCATION = AllocationLimits()


@dataclass(frozen=True)
class DecodedPixel:
    """What a pixel takes while it is decoded [bytes]."""

    deepest: int = 8
    """In a frame of any format."""

    beside: int = 7 + TAKEN
    """Beside the decoder: blue, green and red twice, as OpenCV has them, and grey."""

    def in_format(self, name: bytes) -> float:
        """Return what a decoder keeps of it in a frame of a format, by the four letters of OpenCV."""
        known = {b"I420": 1.5, b"Y800": 1, b"Y42B": 2, b"444P": 3, b"BGR\x18": 3, b"RGB\x18": 3, b"BGR\0": 4}
        return known.get(name, self.deepest)


PIXEL = DecodedPixel()


def frames_kept(codec: bytes) -> int:
    """Return how many frames a decoder keeps at most; `codec` is OpenCV's name for it, in small letters."""
    few = (b"vp80", b"mjpg", b"ffv1", b"hfyu", b"ffvh", b"mpng", b"rle ", b"dib ", b"avdn", b"apch")
    # all others as H.264 and HEVC: sixteen to refer to, ten on their way
    return {b"vp90": 10, b"fmp4": 6, **dict.fromkeys(few, 5)}.get(codec, 26)


def open_video(path: Path) -> Any:
    """Open a video with FFmpeg; raises InputError where it cannot be, or its frames are absurdly large."""
    packed = path.stat().st_size
    # without decoders, which would decode a frame to be asked its size; FFmpeg calls that an error
    with _at_once(ALLOCATION.always + 2 * packed), quiet_ffmpeg():
        size = size_of(_open_capture(path, "codec_whitelist;none"))
    if min(size) < 1:  # of MPEG-4 only the decoder knows it
        size = ALLOCATION.untold_size
    with _at_once(max(ALLOCATION.always, _plane_bytes(size, PIXEL.deepest)) + 2 * packed):
        return _open_capture(path)


def _open_capture(path: Path, with_options: str | None = None) -> Any:
    # each thread of a decoder keeps frames of its own, and there would be as many as processors
    parameters = [cv2.CAP_PROP_N_THREADS, 1]
    before = os.environ.get(ENVIRONMENT.options)
    if with_options is not None:
        os.environ[ENVIRONMENT.options] = with_options
    try:
        # FFmpeg alone: the others after it take as much memory as a damaged file asks for
        with quiet_opencv():
            capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, parameters)
    finally:
        if with_options is not None:
            del os.environ[ENVIRONMENT.options]
            os.environ.update({} if before is None else {ENVIRONMENT.options: before})
    if not capture.isOpened():
        raise InputError(f"video {path} cannot be decoded")
    _refuse_huge(path, capture)
    return capture


def size_of(capture: Any) -> tuple[int, int]:
    """Return columns and rows: those of the last frame, before any those that the head of the file tells."""
    return int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))


def _four_letters(capture: Any, which: int) -> bytes:
    """Return the four letters of a codec or of a format of pixels."""
    return (int(capture.get(which)) & 0xFFFFFFFF).to_bytes(4, "little")


def decoding_memory(capture: Any) -> int:
    """Return the bytes of memory that decoding takes at most, with `TAKEN` frames of it."""
    width, height = size_of(capture)
    kept = frames_kept(_four_letters(capture, cv2.CAP_PROP_FOURCC).lower())
    format = _four_letters(capture, cv2.CAP_PROP_CODEC_PIXEL_FORMAT)
    # four times FF before anything was decoded: most videos are I420
    depth = PIXEL.in_format(b"I420" if format == b"\xff\xff\xff\xff" else format)
    return int((PIXEL.beside + kept * depth) * max(width, 0) * max(height, 0))


def pixel_format(capture: Any) -> tuple[bytes, bytes]:
    """Return the names of the codec and of its format of pixels, four bytes each."""
    return _four_letters(capture, cv2.CAP_PROP_FOURCC), _four_letters(
        capture, cv2.CAP_PROP_CODEC_PIXEL_FORMAT
    )


def _refuse_huge(path: Path, capture: Any) -> None:
    """Raise InputError where a small file holds frames of an absurd size, or says so."""
    (width, height), memory = size_of(capture), decoding_memory(capture)
    try:
        refuse_bomb(path.stat().st_size, memory)
    except InputError as error:
        most = BOMB_BYTES * width * height / memory / 1e6
        always = f"such frames of up to {most:.1f} megapixels are always read"
        raise InputError(f"video {path}: a frame of {width}x{height} {error}; {always}") from None


@contextmanager
def bounded_decoding(capture: Any, packed: int) -> Iterator[None]:
    """Decode frames of no more than about the size that the head of the file says.

    A frame may say another size, and OpenCV then shrinks it to that of the head without a word: all that can
    be known beforehand is how much FFmpeg takes at once.

    Args:
        capture: The video.
        packed: Bytes of the file; its tables and packets may take as much.
    """
    codec, pixels = pixel_format(capture)
    # frames of these may change their size on the way, and take nothing larger than a plane at once
    resizing = codec.lower() in (b"vp80", b"vp90", b"h264", b"hevc")
    depth = 1 if resizing and PIXEL.in_format(pixels) <= 3 else PIXEL.deepest
    with _at_once(max(ALLOCATION.always, _plane_bytes(size_of(capture), depth)) + 2 * packed):
        yield


def _plane_bytes(size: tuple[int, int], depth: int) -> int:
    return depth * (max(size[0], 0) + ALLOCATION.border) * (max(size[1], 0) + ALLOCATION.border)


@contextmanager
def _at_once(most: int) -> Iterator[None]:
    """Let FFmpeg take no more bytes at once, where its library can be told so."""
    library = _find_libavutil()
    if library is None:
        yield
        return
    library.av_max_alloc(min(most, ALLOCATION.none))
    try:
        yield
    finally:
        library.av_max_alloc(ALLOCATION.none)


@contextmanager
def quiet_ffmpeg() -> Iterator[None]:
    """Keep FFmpeg quiet, also where it was used before it could be told so by its environment."""
    # where it is used for the first time, OpenCV asks this and else sets a level of its own
    os.environ.setdefault(ENVIRONMENT.log_level, str(ENVIRONMENT.quiet))
    library = _find_libavutil()
    if library is not None:
        library.av_log_set_level(ENVIRONMENT.quiet)
    try:
        yield
    finally:
        wanted = os.environ.get(ENVIRONMENT.log_level, "")
        if library is not None and wanted.lstrip("-").isdigit():
            library.av_log_set_level(int(wanted))


@lru_cache(maxsize=1)
def _find_libavutil() -> Any:
    """Return the library of FFmpeg that comes with OpenCV; None where it is not a file of its own."""
    home = Path(cv2.__file__).parent
    for folder in (*home.parent.glob("opencv_*.libs"), home / ".dylibs"):  # of wheels for Linux and macOS
        for file in folder.glob("libavutil*"):
            library = ctypes.CDLL(str(file))
            library.av_max_alloc.argtypes, library.av_max_alloc.restype = [ctypes.c_size_t], None
            return library
    return None


def refuse_titles(path: Path) -> None:
    """Raise InputError where a list of titles in an AVI says that it is far longer than the file.

    FFmpeg takes as much memory as such a list says, and fills it with zeros, before it reads what is there.
    It follows damaged sizes to wherever they lead, so the list may lie anywhere.
    """
    length = path.stat().st_size
    titles = re.compile(rb"LIST(.{4})INFO", re.DOTALL)  # with the length of the list [bytes]
    with path.open("rb") as file:
        kept = file.read(12)
        if kept[:4] not in (b"RIFF", b"ON2 "):
            return
        while more := file.read(PIECE):
            kept += more
            for found in titles.finditer(kept):
                claimed = int.from_bytes(found[1], "little")
                if claimed > max(length, 1 << 24):  # so much does no harm, whatever a damaged file claims
                    sizes = f"{claimed:,} bytes of titles in a file of {length:,}"
                    raise InputError(f"video {path} is damaged: it claims {sizes}")
            kept = kept[-11:]  # all but one byte of what is looked for
