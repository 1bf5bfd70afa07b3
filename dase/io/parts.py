"""The part of a recording that was asked for: a span of time, a window of the sensor."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.events import Events
from dase.io.format import cut_chunks
from dase.io.sequence import Sequence
from dase.io.source import Beside, Motion, Part, Picture, Piece, Source


def cut_events(events: Events, part: Part) -> Events:
    """Return the events in the part; raises InputError where its region does not lie on the sensor."""
    events = events.slice(part.begin, part.end)
    if part.region is None:
        return events
    x, y, width, height = part.region
    if x + width > events.width or y + height > events.height:
        where, sensor = f"{width}x{height} at ({x}, {y})", f"{events.width}x{events.height}"
        raise InputError(f"the region must lie on the {sensor} sensor, got {where}")
    inside = (events.x >= x) & (events.x < x + width) & (events.y >= y) & (events.y < y + height)
    e = events.select(inside)
    return Events(e.t, e.x - np.uint16(x), e.y - np.uint16(y), e.p, width, height, e.label)


def cut_stream(parts: Iterable[Events], part: Part, chunk: int) -> Iterator[Events]:
    """Yield the events in the part, in chunks of `chunk` again; nothing is read beyond its end."""
    empty: Events | None = None

    def pieces() -> Iterator[Piece]:
        nonlocal empty
        for events in parts:
            kept = cut_events(events, part)
            empty = kept.select(slice(0)) if empty is None else empty
            yield Piece(kept.t, kept.x, kept.y, kept.p, kept.label)
            if len(events) and events.t[-1] >= part.end:
                return

    some = False
    for piece in cut_chunks(pieces(), chunk):
        assert empty is not None
        some = True
        yield Events(*piece[:4], empty.width, empty.height, piece.label)
    if not some and empty is not None:
        yield empty


def cut_pictures(source: Source, pictures: Iterable[Picture], part: Part) -> Iterator[Picture]:
    """Yield the frames whose whole exposure lies in the part, as large as its region."""
    timed = math.isfinite(part.begin) or math.isfinite(part.end)
    for picture in pictures:
        if timed and not math.isfinite(picture.t):
            sentence = "frames without times lie in no part of time: left out"
            return source.note(sentence, "refused", "frames")
        if picture.t + picture.exposure / 2 > part.end:
            return
        if timed and picture.t - picture.exposure / 2 < part.begin:
            continue
        flow = None if picture.flow is None else window(picture.flow, part)
        yield picture._replace(grey=window(picture.grey, part), flow=flow)


def window(array: NDArray[Any], part: Part) -> NDArray[Any]:
    """Return the region of maps (..., H, W)."""
    if part.region is None:
        return array
    x, y, width, height = part.region
    if x + width > array.shape[-1] or y + height > array.shape[-2]:
        sensor = f"{array.shape[-1]}x{array.shape[-2]}"
        raise InputError(f"the region must lie on the {sensor} sensor, got {width}x{height} at ({x}, {y})")
    return np.ascontiguousarray(array[..., y : y + height, x : x + width])


def cut_beside(beside: Beside, part: Part) -> Beside:
    """Return thresholds as large as the region, and the configuration."""
    thresholds, configuration = beside
    return None if thresholds is None else window(thresholds, part), configuration


def cut_motion(motion: Motion | None, part: Part) -> Motion | None:
    """Return the samples in the part of time."""
    if motion is None:
        return None
    within = (motion.t >= part.begin) & (motion.t < part.end)
    return Motion(*(column[within] for column in motion))


def cut_sequence(source: Source, sequence: Sequence, part: Part) -> Sequence:
    """Return the part of a sequence that was read whole."""
    events = cut_events(sequence.events, part)
    maps: dict[str, Any] = {}
    frames, times, exposure = sequence.frames, sequence.frame_times, sequence.frame_exposure
    if frames is not None:
        span = np.zeros(len(frames)) if exposure is None else exposure
        middle = np.full(len(frames), np.nan) if times is None else times
        kept = np.ones(len(frames), np.bool_)
        if math.isfinite(part.begin) or math.isfinite(part.end):
            kept = (middle - span / 2 >= part.begin) & (middle + span / 2 <= part.end)
            if times is None:
                sentence = "frames without times lie in no part of time: left out"
                source.note(sentence, "refused", "frames")
        names = ("frames", "frame_times", "frame_exposure", "flow")
        found = {name: getattr(sequence, name) for name in names}
        maps = {name: None if array is None else array[kept] for name, array in found.items()}
        if not kept.any():
            maps = dict.fromkeys(names)
    for name in ("frames", "flow", "thresholds"):
        array = maps.get(name, getattr(sequence, name))
        maps[name] = None if array is None else window(array, part)
    return replace(sequence, events=events, **maps)


def note_part(source: Source, part: Part) -> None:
    """Note what was read, once."""
    said = []
    if math.isfinite(part.begin) or math.isfinite(part.end):
        begin = f"from {part.begin:g} s " if math.isfinite(part.begin) else ""
        end = f"to {part.end:g} s " if math.isfinite(part.end) else ""
        said.append(f"{begin}{end}".strip())
    if part.region is not None:
        x, y, width, height = part.region
        said.append(f"{width}x{height} pixels at ({x}, {y})")
    if said:
        source.note(f"read was a part only: {', '.join(said)}", "said", "part")
