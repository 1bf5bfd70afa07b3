"""The messages of event cameras in ROS bags, parsed from their bytes.

    ROS 1     little-endian, packed; header: u32 number, u32 s, u32 ns, u32 length + frame name
    ROS 2     CDR: 4 bytes of which the second says little-endian (1), then every number at a multiple of its
              size; header: i32 s, u32 ns, u32 length + frame name with its zero

    dvs_msgs/EventArray               header, u32 rows, columns, then u32 count of
                                      u16 column, row, u32 s, ns, u8 ON
    event_camera_msgs/EventPacket     header, u32 rows, columns, u64 number, time base, text encoding,
                                      u8 big-endian, u32 count of bytes in that encoding
    sensor_msgs/Image                 header, u32 rows, columns, text encoding, u8 big-endian, u32 step, data
    sensor_msgs/CompressedImage       header, text format, data

Sources: the .msg files of rpg_dvs_ros, event_camera_msgs and common_msgs; event_camera_codecs and
libcaer_driver (Apache-2.0) for the encodings mono, libcaer and libcaer_cmp.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.io import evt2, evt3, frames
from dase.io.evt21 import expand_masks
from dase.io.source import Piece, Size, join_pieces

DVS_EVENT = np.dtype([("x", "<u2"), ("y", "<u2"), ("s", "<u4"), ("ns", "<u4"), ("p", "u1")])
CDR_EVENT = np.dtype(  # from the second event on: 16 bytes apart, begun 2 bytes past a multiple of 4
    [("x", "<u2"), ("y", "<u2"), ("", "V2"), ("s", "<u4"), ("ns", "<u4"), ("p", "u1"), ("", "V1")]
)
LIBCAER_CMP = np.array([8, 6, 0, 2, 3, 5, 4] + [9] * 9, np.uint16)
"""Word type of libcaer_cmp to that of EVT3, with rows and columns exchanged; 9 is unknown to it."""

CHANNELS = {"mono8": 1, "8UC1": 1, "mono16": 1, "16UC1": 1, "bgr8": 3, "rgb8": 3, "8UC3": 3}


class Message:
    """Takes one field of a message after the other; InputError or struct.error where it is too short."""

    def __init__(self, data: bytes, cdr: bool) -> None:
        self._data, self._cdr = bytes(data), cdr
        self._place = self._start = 4 if cdr else 0
        if cdr and (len(data) < 4 or data[1] != 1):
            raise InputError("a message is not in little-endian CDR")

    def number(self, kind: str) -> int:
        """Take a number of a struct format."""
        size = struct.calcsize(f"<{kind}")
        self._align(size)
        self._place += size
        return int(struct.unpack_from(f"<{kind}", self._data, self._place - size)[0])

    def text(self) -> str:
        """Take a text."""
        return self.bytes().rstrip(b"\0").decode("latin-1")

    def bytes(self) -> bytes:
        """Take bytes with their length before them."""
        count = self.number("I")
        if self._place + count > len(self._data):
            raise InputError("a message ends before its data do")
        self._place += count
        return self._data[self._place - count : self._place]

    def stamp(self) -> int:
        """Take a header; return its time [ns]."""
        if not self._cdr:
            self.number("I")
        time = self.number("I") * 10**9 + self.number("I")
        self.bytes()
        return time

    def dvs_events(self) -> Piece:
        """Take the events of dvs_msgs [ns]."""
        count = self.number("I")
        size = 13 if not self._cdr or not count else 16
        if self._place + count * size - (size - 13) > len(self._data):
            raise InputError(f"a message claims {count} events, more than it holds")
        if not self._cdr:
            return _dvs_piece(np.frombuffer(self._data, DVS_EVENT, count, self._place))
        if not count:
            return join_pieces([])
        whole = np.frombuffer(self._data + b"\0\0\0", CDR_EVENT, count, self._place - 2)
        first = np.frombuffer(self._data, "<u2", 2, self._place)  # the first is not preceded by a gap
        out = _dvs_piece(whole)
        out.x[0], out.y[0] = first
        return out

    def _align(self, size: int) -> None:
        if self._cdr:
            self._place += -(self._place - self._start) % size


def _dvs_piece(events: NDArray[Any]) -> Piece:
    t = events["s"].astype(np.int64) * 10**9 + events["ns"]
    return Piece(t, events["x"].copy(), events["y"].copy(), events["p"])


def dvs_size(data: bytes, cdr: bool) -> Size:
    """Return columns and rows of an EventArray or EventPacket."""
    message = Message(data, cdr)
    message.stamp()
    height = message.number("I")
    return message.number("I"), height


def event_array(data: bytes, cdr: bool) -> Piece:
    """Return the events of a dvs_msgs/EventArray [ns]."""
    message = Message(data, cdr)
    message.stamp()
    message.number("I")
    message.number("I")
    return message.dvs_events()


@dataclass
class Packets:
    """Decodes the EventPackets of one topic one after the other; carries the decoder's state over.

    The clock of the sensor is moved to that of ROS by the stamp of the first packet with events.
    """

    offset: int | None = None
    evt2: evt2.Decoder = field(default_factory=evt2.Decoder)
    evt3: evt3.Decoder = field(default_factory=evt3.Decoder)

    def __call__(self, data: bytes, cdr: bool) -> Iterator[Piece]:
        """Yield the events of a message [ns]."""
        message = Message(data, cdr)
        stamp = message.stamp()
        for kind in "IIQ":
            message.number(kind)
        base = message.number("Q")
        encoding = message.text()
        if message.number("B"):
            raise InputError("events in big-endian order are not read")
        for piece in self._decoded(encoding, message.bytes(), base):
            if not len(piece.t):
                continue
            if self.offset is None:
                self.offset = stamp - int(piece.t[0])
            yield piece._replace(t=piece.t + self.offset)

    def _decoded(self, encoding: str, data: bytes, base: int) -> Iterator[Piece]:
        if encoding == "evt3":
            for piece in self.evt3(_as_words(data, "<u2")):
                yield piece._replace(t=piece.t * 1000)
        elif encoding == "evt2":
            for piece in self.evt2(_as_words(data, "<u4")):
                yield piece._replace(t=piece.t * 1000)
        elif encoding == "evt21":
            halves = _as_words(data, "<u8").view("<u4").reshape(-1, 2)
            at, piece = self.evt2.part(halves[:, 1])
            yield from expand_masks(piece._replace(t=piece.t * 1000), halves[at, 0])
        elif encoding == "mono":
            yield _decode_mono(_as_words(data, "<u8"), base)
        elif encoding == "libcaer":
            yield _decode_libcaer(_as_words(data, "<u8"), base)
        elif encoding == "libcaer_cmp":
            yield from self._libcaer_cmp(_as_words(data, "<u2"), base)
        else:
            known = "evt3, evt2, evt21, mono, libcaer, libcaer_cmp"
            raise InputError(f"events are encoded as '{encoding}', known: {known}")

    def _libcaer_cmp(self, words: NDArray[np.uint16], base: int) -> Iterator[Piece]:
        """Yield the events [ns]: counted in microseconds from a time base in nanoseconds.

        TIME_HIGH leaves the low bits of the time as they were: libcaer_driver writes TIME_LOW only where
        these change.
        """
        start = np.array([0x8000], "<u2")  # every packet begins at its own time base
        words = np.concatenate((start, (LIBCAER_CMP[words >> 12] << 12) | (words & 4095)))
        for piece in evt3.Decoder(clears=False)(words):
            yield Piece(piece.t * 1000 + base, piece.y, piece.x, piece.p)


def _as_words(data: bytes, kind: str) -> NDArray[Any]:
    return np.frombuffer(data, kind, len(data) // np.dtype(kind).itemsize)


def _decode_mono(words: NDArray[np.uint64], base: int) -> Piece:
    t = (words & 0xFFFFFFFF).astype(np.int64) + base
    x, y = (((words >> shift) & mask).astype(np.uint16) for shift, mask in ((32, 0xFFFF), (48, 0x7FFF)))
    return Piece(t, x, y, words >> 63 > 0)


def _decode_libcaer(words: NDArray[np.uint64], base: int) -> Piece:
    valid = words[(words & 1) > 0]
    t = (valid >> 32).astype(np.int64) * 1000 + base
    y, x = (((valid >> shift) & 0x7FFF).astype(np.uint16) for shift in (2, 17))
    return Piece(t, x, y, valid & 2 > 0)


def decode_image(data: bytes, cdr: bool, compressed: bool) -> tuple[int, NDArray[Any]]:
    """Return the time [ns] and the grey values of 8 or 16 bits (H, W) of an Image or a CompressedImage."""
    message = Message(data, cdr)
    time = message.stamp()
    if compressed:
        message.text()
        return time, frames.decode_grey(message.bytes(), "a compressed image")
    height, width = message.number("I"), message.number("I")
    encoding, swapped, step = message.text(), message.number("B"), message.number("I")
    pixels = message.bytes()
    if encoding not in CHANNELS:
        raise InputError(f"images are encoded as '{encoding}', known: {', '.join(CHANNELS)}")
    wide = 2 if "16" in encoding else 1
    row = width * CHANNELS[encoding] * wide
    if not row or step < row or len(pixels) != step * height:
        raise InputError(f"an image of {width}x{height} has {len(pixels)} bytes in rows of {step}")
    values = np.frombuffer(pixels, np.uint8).reshape(height, step)[:, :row]
    if wide == 2:
        wide_values = np.ascontiguousarray(values).view(">u2" if swapped else "<u2")
        return time, wide_values.astype(np.uint16, copy=False)
    if CHANNELS[encoding] == 1:
        return time, values
    weights = (0.21, 0.72, 0.07) if encoding == "rgb8" else (0.07, 0.72, 0.21)
    return time, np.rint(values.reshape(height, width, 3) @ np.array(weights)).astype(np.uint8)
