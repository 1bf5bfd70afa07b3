"""AVI files from parts: good ones and damaged ones."""

from __future__ import annotations

import struct

import numpy as np


def chunk(name: bytes, content: bytes, claimed: int | None = None) -> bytes:
    """Return a part of a RIFF file, which may claim another length than it has."""
    size = len(content) if claimed is None else claimed
    return name + struct.pack("<I", size) + content + bytes(len(content) % 2)


def titles(claimed: int | None = None) -> bytes:
    """Return a list of one title that may claim another length; so does its title."""
    inner = None if claimed is None else max(claimed - 12, 0)
    return chunk(b"LIST", b"INFO" + chunk(b"INAM", b"a title\0", inner), claimed)


def avi(grey, *, size=None, upward=True, first=b"", last=b"") -> bytes:
    """Return an AVI of frames (F, H, W) that are not compressed, at 25 per second.

    Args:
        grey: Values of all three colours, uint8.
        upward: Whether the bottom row comes first, as usual.
        size: Columns and rows to claim, or None for those of the frames.
        first: Parts before the frames.
        last: Parts after the frames.
    """
    count, height, width = grey.shape
    w, h = size or (width, height)
    padding = -3 * width % 4
    frame = (3 * w + padding) * h & 0x7FFFFFFF
    main = struct.pack("<14I", 40_000, 0, 0, 0, count, 0, 1, frame, w, h, 0, 0, 0, 0)
    numbers = (0, 0, 0, 0, 1, 25, 0, count, frame, -1, 0, 0, 0, 0, 0)
    stream = b"vids" + bytes(4) + struct.pack("<IHHIIIIIIiI4H", *numbers)
    picture = struct.pack("<IiiHHIIiiII", 40, w, h if upward else -h, 1, 24, 0, frame, 0, 0, 0, 0)
    strl = chunk(b"LIST", b"strl" + chunk(b"strh", stream) + chunk(b"strf", picture))
    turned = grey[:, ::-1] if upward else grey
    rows = np.pad(np.repeat(turned, 3, 2), ((0, 0), (0, 0), (0, padding)))
    movi = chunk(b"LIST", b"movi" + b"".join(chunk(b"00db", one.tobytes()) for one in rows))
    return chunk(
        b"RIFF", b"AVI " + chunk(b"LIST", b"hdrl" + chunk(b"avih", main) + strl) + first + movi + last
    )
