"""Stored events as the probes look at them: one pixel after the other."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from dase.events import Events
from dase.kernels import launch
from dase.kernels.event_order import sort_into_pixels
from dase.probes.stimulus import Stimulus


def sort_by_pixel(stimulus: Stimulus, streams: Sequence[Events]) -> tuple[Any, Any, Any]:
    """Return the events of a stimulus' pixels as Warp arrays on its device; those of others are left out.

    Returns:
        The first event of each pixel of each stream, and the end, shape (B, N + 1); times since the begin of
        the stimulus [ns] and polarities, in order of stream, pixel, time. Between streams there are gaps.
    """
    ends = np.cumsum([len(events) for events in streams])
    start = np.empty((len(streams), len(stimulus.pixels) + 1), np.int32)
    time, polarity = np.empty(int(ends[-1]), np.int64), np.empty(int(ends[-1]), np.uint8)
    place = np.full(stimulus.width * stimulus.height, -1, np.int32)
    place[stimulus.pixels] = np.arange(len(stimulus.pixels), dtype=np.int32)
    parts = [slice(int(end) - len(events), int(end)) for events, end in zip(streams, ends, strict=True)]
    launch.run_concurrently([
        partial(_sort_stream, stimulus, events, place, start[n], time[part], polarity[part])
        for n, (events, part) in enumerate(zip(streams, parts, strict=True))
    ])  # fmt: skip
    start += (ends - [len(events) for events in streams]).astype(np.int32)[:, None]
    kinds = ((start, wp.int32), (time, wp.int64), (polarity, wp.uint8))
    first, times, signs = (wp.array(a, dtype=d, device=stimulus.device, copy=False) for a, d in kinds)
    return first, times, signs


def _sort_stream(
    stimulus: Stimulus,
    events: Events,
    place: NDArray[np.int32],
    start: NDArray[np.int32],
    time: NDArray[np.int64],
    polarity: NDArray[np.uint8],
) -> None:
    """Bring the events of one stream in the order of pixels."""
    cpu = launch.find_device("cpu")

    def lent(array: NDArray[Any], dtype: Any) -> Any:
        return wp.array(array, dtype=dtype, device=cpu, copy=False)

    inputs = [
        lent(events.t, wp.float64), lent(events.x, wp.uint16), lent(events.y, wp.uint16),
        lent(events.p.view(np.uint8), wp.uint8), lent(place, wp.int32), stimulus.width,
        wp.float64(stimulus.grid.begin), lent(start, wp.int32), lent(time, wp.int64),
        lent(polarity, wp.uint8),
    ]  # fmt: skip
    wp.launch(sort_into_pixels, dim=1, inputs=inputs, device=cpu)
