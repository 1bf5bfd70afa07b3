"""Videos that are written, packed in the first of several ways that OpenCV has here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from dase.io.ffmpeg import quiet_ffmpeg
from dase.io.image_files import quiet_opencv


@dataclass(frozen=True)
class VideoCodec:
    """How a video is packed.

    Args:
        letters: Four, by which OpenCV knows it.
        plays_in_browsers: Whether browsers play it.
        lossless: Whether the pixels come back as they were.
    """

    letters: str
    plays_in_browsers: bool = False
    lossless: bool = False


def open_video_writer(
    path: Path, rate: float, size: tuple[int, ...], codecs: Sequence[VideoCodec]
) -> tuple[Any, VideoCodec]:
    """Return a writer with the first codec that opens, None where none does, and the codec.

    Args:
        path: Of the video; its suffix says the container.
        rate: Pictures per second [Hz].
        size: Columns and rows [px].
        codecs: What to try, the best first.
    """
    for codec in codecs:
        with quiet_ffmpeg(), quiet_opencv():  # what is missing is tried, not an error
            out = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec.letters), rate, size)
        if out.isOpened():
            return out, codec
    return None, codecs[-1]
