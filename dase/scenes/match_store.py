"""Matches of frames that were computed: the latest in memory, those before in a temporary file."""

from __future__ import annotations

import os
import shutil
import tempfile
import weakref
from collections import OrderedDict
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from dase.scenes.frame_motion import FrameMatch


@dataclass(frozen=True)
class StoreSettings:
    """How much is kept of the matches of frames."""

    memory: int = 1 << 28
    """Matches kept in memory [bytes]."""
    fewest: int = 4
    """Matches that are kept there whatever their size: what a chunk of samples touches must not thrash."""
    file: int = 4 << 30
    """Matches kept in a temporary file [bytes]; others are computed anew when they are asked for."""
    share: float = 0.25
    """Of the room on the disk that the file takes at most."""


class MatchStore:
    """What is known of the motion between each frame and the next.

    A comparison goes through a recording four times, and to match two frames takes a hundred times as long as
    to read what was found. A file that cannot grow is no error: what it lacks is computed anew.

    Args:
        settings: How much is kept.
    """

    def __init__(self, settings: StoreSettings = StoreSettings()):
        self.settings = settings
        self._latest: OrderedDict[int, FrameMatch] = OrderedDict()
        self._file: int | None = None  # its number
        self._filed: set[int] = set()
        self._room: int | None = None  # of the file, once it is known
        self._shapes: tuple[tuple[int, ...], ...] = ()  # of what a match consists of

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy in another process begins with: nothing but the settings."""
        return MatchStore(self.settings).__dict__

    def find(self, interval: int) -> FrameMatch | None:
        """Return the match of an interval if it is kept."""
        if interval in self._latest:
            self._latest.move_to_end(interval)
            return self._latest[interval]
        found = self._read(interval) if interval in self._filed else None
        if found is not None:
            self._remember(interval, found)
        return found

    def keep(self, interval: int, match: FrameMatch) -> None:
        """Keep the match of an interval; those before may go to the file."""
        self._remember(interval, match)

    def _remember(self, interval: int, match: FrameMatch) -> None:
        self._latest[interval] = match
        most = max(self.settings.memory // _size_of(match), self.settings.fewest)
        while len(self._latest) > most:
            oldest, kept = self._latest.popitem(last=False)
            if oldest not in self._filed:
                self._write(oldest, kept)

    def _write(self, interval: int, match: FrameMatch) -> None:
        if self._room is None:
            self._room = self._open_file() // _size_of(match)
        if self._file is None or len(self._filed) >= self._room:
            return
        # the place goes with the number: after a fork all processes write the same there
        place = interval * _size_of(match)
        try:
            for part in (match.ahead, match.back, match.doubt):
                left = np.ascontiguousarray(part, np.float32).reshape(-1).view(np.uint8).data
                while left:
                    done = os.pwrite(self._file, left, place)
                    left, place = left[done:], place + done
        except OSError:
            self._room = 0  # the disk is full: no more
            return
        self._filed.add(interval)
        self._shapes = match.ahead.shape, match.back.shape, match.doubt.shape

    def _open_file(self) -> int:
        """Open the file, if that can be, and return how much it may hold [bytes]."""
        if not hasattr(os, "pwrite"):  # on Windows
            return 0
        with suppress(OSError):
            number, name = tempfile.mkstemp(prefix="dase-matches-")
            self._file = number
            weakref.finalize(self, os.close, number)
            os.unlink(name)  # without a name it is gone when the process ends, however
            free = shutil.disk_usage(tempfile.gettempdir()).free
            return min(self.settings.file, int(self.settings.share * free))
        return 0

    def _read(self, interval: int) -> FrameMatch | None:
        assert self._file is not None
        parts = [np.empty(shape, np.float32) for shape in self._shapes]
        place = interval * sum(part.nbytes for part in parts)
        for part in parts:
            data = b""
            with suppress(OSError):
                data = os.pread(self._file, part.nbytes, place)
            if len(data) < part.nbytes:
                self._filed.discard(interval)
                return None
            part.reshape(-1)[:] = np.frombuffer(data, np.float32)
            place += part.nbytes
        return FrameMatch(*parts)


def _size_of(match: FrameMatch) -> int:
    return match.ahead.nbytes + match.back.nbytes + match.doubt.nbytes
