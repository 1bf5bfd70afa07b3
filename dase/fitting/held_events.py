"""Events of a clip whose frames are held, beside the light of these frames."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dase.events import Events
from dase.probes.stimulus import log_light_of
from dase.scenes.scene import LOG_EPS
from dase.scenes.video import VideoScene

Array = NDArray[np.float64]

MOST = 40_000_000
"""Intensities that are looked at, pixels times frames, at most."""


@dataclass(frozen=True, eq=False)
class HeldEvents:
    """Events, pixel by pixel and in order of time; frame n + 1 is shown from the time of frame n on.

    Args:
        times: Of the frames [s], shape (F,).
        level: Log intensity of the frames, shape (F, P).
        pixel: Column of `level`, shape (N,).
        row: Of the sensor, shape (N,).
        late: Time after the frame before [s], shape (N,).
        sign: 1 for ON and -1 for OFF, shape (N,).
        frame: The frame before, shape (N,).
    """

    times: Array
    level: NDArray[np.float32]
    pixel: NDArray[np.int64]
    row: NDArray[np.int64]
    late: Array
    sign: Array
    frame: NDArray[np.int64]

    @classmethod
    def of(cls, events: Events, scene: VideoScene, *, most: int = MOST) -> HeldEvents:
        """Return the events of the rows with the most of them, as many as are looked at.

        Args:
            events: In order of time.
            scene: A clip, held or as its frames are written down.
            most: Intensities that are looked at, pixels times frames.
        """
        times = scene.frame_times()
        first, after = rows_with_most_events(events, most // (len(times) * scene.width))
        frame = np.searchsorted(times, events.t + 1e-9, side="right") - 1
        inside = (events.y >= first) & (events.y < after) & (frame >= 0) & (frame < len(times) - 1)
        events, frame = events.select(inside), frame[inside]
        order = np.lexsort((events.t, events.x, events.y))
        row, frame = events.y.astype(np.int64)[order], frame[order]
        pixels = np.arange(first * scene.width, after * scene.width, dtype=np.int32)
        return cls(
            times,
            log_light_of(scene, scene.sample_times()[:: scene.parts], pixels, log_eps=LOG_EPS),
            (row - first) * scene.width + events.x[order],
            row,
            events.t[order] - times[frame],
            np.where(np.asarray(events.p, bool)[order], 1.0, -1.0),
            frame,
        )

    @property
    def gap(self) -> float:
        """Time from frame to frame [s]."""
        return float(np.median(np.diff(self.times)))

    @cached_property
    def before(self) -> NDArray[np.int64]:
        """Frame of the pixel's last event before each, shape (N,); 0 where it has none."""
        again = self.pixel[1:] == self.pixel[:-1]
        return np.concatenate([[0], np.where(again, self.frame[:-1], 0)])[: len(self.frame)]

    @cached_property
    def is_first(self) -> NDArray[np.bool_]:
        """Whether each is the first of its pixel in a frame, and not the first of all, shape (N,)."""
        again = np.concatenate([[False], self.pixel[1:] == self.pixel[:-1]])[: len(self.frame)]
        first: NDArray[np.bool_] = again & (self.before != self.frame)
        return first


def rows_with_most_events(events: Events, most: int) -> tuple[int, int]:
    """Return the rows with the most events: the first, and the one after the last.

    Args:
        events: Of the whole sensor.
        most: Rows that are looked at, at most; eight are, wherever there are so many.
    """
    most = min(max(most, 8), events.height)
    total = np.concatenate([[0], np.cumsum(np.bincount(events.y, minlength=events.height))])
    first = int(np.argmax(total[most:] - total[:-most]))
    return first, first + most
