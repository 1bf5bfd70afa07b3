"""Summary statistics of events with a physical reading, and what they are called.

`dase.kernels.probes` adds up numbers event by event; here the sums become statistics that model and measurement
are compared by. Each belongs to a family, a row of `FAMILIES`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dase.kernels.probes import (
    BANDS,
    CELLS,
    CHANGE,
    CLASSES,
    INTERVALS,
    ISI,
    LAG,
    LAG_COUNT,
    LAGS,
    RATE,
    REPEAT,
    SERIAL,
)

FAMILIES = {
    "rate": "events per polarity, by what the light does and how bright it is",
    "intervals": "time between two events of a pixel, by their polarities, at rest and moving",
    "lag": "how the light went before and after an event, by how bright it is",
    "repeats": "further events of a pixel in the same step of time",
    "change": "change of the light between two events of a pixel",
    "spread": "how differently pixels count that see the same",
    "pixels": "pixels far off the others: silent ones, busy ones",
    "space": "events by the distance from the middle of the sensor",
}
"""Families of statistics, each with the weight of all others."""

TOLERANCE = 0.015
"""Relative difference that is of no concern."""

FEW = 25.0
"""Events below which a mean over events is not compared."""

SHRINK = 3.0
"""Events of the measurement that are added to a mean of the model, which may have none."""

ZONES = 4
"""Rings about the middle of the sensor, of equal numbers of pixels."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sums:
    """What the kernels have added up, a row for each model.

    Args:
        sums: Over all pixels, shape (B, SIZE).
        halves: Counts of each pixel, shape (B, N, HALVES).
        groups: Over groups of neighbours in the list of pixels, shape (B, G, SIZE).
    """

    sums: Array
    halves: NDArray[np.float32]
    groups: NDArray[np.float32]

    def without(self, pixels: NDArray[np.int64]) -> Sums:
        """Return the first row without one group after the other, shape (G, ...).

        Args:
            pixels: Group of each pixel, shape (N,).
        """
        count = self.groups.shape[1]
        kept = np.arange(count)[:, None] != pixels
        return Sums(self.sums[0] - self.groups[0], self.halves[0] * kept[..., None], self.groups[:0])


@dataclass(frozen=True)
class Frame:
    """What statistics refer to; the same for measurement and models.

    Args:
        expected: Counts that the present model expects, shape (N, HALVES), or one for each row.
        zone: Ring of each pixel, shape (N,).
        measured: Statistics of the measurement, which means of a model with few events are drawn to,
            shape (J,); None to work them out.
        seconds: Time that is compared [s].
    """

    expected: Array
    zone: NDArray[np.int64]
    seconds: float
    measured: Array | None = None


def _layout() -> dict[str, slice]:
    sizes = {
        "rate": 2 * CELLS,
        "intervals": 6 * INTERVALS,
        "lag": LAGS * BANDS,
        "repeats": 2 * BANDS,
        "change": 2 * 4 * CLASSES + CLASSES,
        "spread": 10,
        "pixels": 4,
        "space": 4 * ZONES,
    }
    ends = np.cumsum(list(sizes.values()))
    return {
        name: slice(int(end - size), int(end)) for (name, size), end in zip(sizes.items(), ends, strict=True)
    }


LAYOUT = _layout()
"""Place of each family in a vector of statistics."""

SIZE = max(part.stop for part in LAYOUT.values())
"""Statistics in all."""


def zones(pixels: NDArray[np.int32], width: int, height: int) -> NDArray[np.int64]:
    """Return the ring that each pixel lies in, shape (N,)."""
    x, y = pixels % width - 0.5 * (width - 1), pixels // width - 0.5 * (height - 1)
    radius = np.hypot(x, y)
    return np.searchsorted(np.quantile(radius, np.arange(1, ZONES) / ZONES), radius)


def statistics(found: Sums, frame: Frame) -> tuple[Array, Array]:
    """Return statistics and how many events each rests on.

    Returns:
        Statistics, shape (B, J), and events, shape (B, J); of counts, which are given as log(count + 3), the
        count itself.
    """
    a = found.sums.astype(np.float64)
    parts = [
        _counts(a[:, RATE : RATE + 2 * CELLS]),
        _counts(a[:, ISI : ISI + 6 * INTERVALS]),
        _means(a[:, LAG : LAG + LAGS * BANDS], np.tile(a[:, LAG_COUNT : LAG_COUNT + BANDS], LAGS)),
        _repeats(a[:, REPEAT : REPEAT + 3 * BANDS].reshape(-1, BANDS, 3)),
        _changes(a[:, CHANGE : CHANGE + 12 * CLASSES].reshape(-1, 4 * CLASSES, 3), a[:, SERIAL:]),
        _spread(found.halves, frame.expected),
        _counts(_odd_pixels(found.halves, frame)),
        _counts(_by_zone(found.halves, frame.zone)),
    ]
    values = np.concatenate([value for value, _ in parts], axis=1)
    weight = np.concatenate([events for _, events in parts], axis=1)
    if frame.measured is not None:
        means = MEANS
        drawn = (values * weight + SHRINK * frame.measured) / (weight + SHRINK)
        values[:, means] = drawn[:, means]
    return values, weight


def _counts(counts: Array) -> tuple[Array, Array]:
    return np.log(counts + 3.0), counts


def _means(total: Array, events: Array) -> tuple[Array, Array]:
    return total / np.maximum(events, 1.0), events


def _repeats(counts: Array) -> tuple[Array, Array]:
    second, third = (_means(counts[:, :, n], counts[:, :, 0]) for n in (1, 2))
    return np.concatenate([second[0], third[0]], 1), np.concatenate([second[1], third[1]], 1)


def _changes(pairs: Array, serial: Array) -> tuple[Array, Array]:
    events = pairs[:, :, 0]
    mean, _ = _means(pairs[:, :, 1], events)
    deviation, _ = _means(pairs[:, :, 2], events)
    product, count = _means(serial[:, 1::2], serial[:, 0::2])
    return np.concatenate([mean, deviation, product], 1), np.concatenate([events, events, count], 1)


def _spread(halves: NDArray[np.float32], expected: Array) -> tuple[Array, Array]:
    """Split-half covariances over pixels of what is not expected, and Fano factors."""
    # state (moving, rest), half, polarity
    n = halves.reshape(*halves.shape[:2], 2, 2, 2).astype(np.float64)
    e = expected.reshape(-1, halves.shape[1], 2, 2, 2)
    d = n - e
    off, on = d[..., 0], d[..., 1]
    total = np.maximum(e.sum((1, 3)), 1.0)  # (B or 1, state, polarity)
    both = np.sqrt(total[..., 0] * total[..., 1])
    same = (d[:, :, :, 0] * d[:, :, :, 1]).sum(1) * 2 / total
    cross = (off[..., 0] * on[..., 1] + off[..., 1] * on[..., 0]).sum(1) / both
    fano = (d.sum(3) ** 2).sum(1) / total
    values = np.concatenate([same, cross[..., None], fano], -1).reshape(len(n), -1)
    events = np.concatenate([total, both[..., None], total], -1).reshape(len(e), -1)
    return values, np.broadcast_to(events, values.shape)


def _odd_pixels(halves: NDArray[np.float32], frame: Frame) -> Array:
    """Numbers of pixels that are silent, and of those that are busy at rest or altogether."""
    rest, rest_e = halves[:, :, 4:].sum(2), frame.expected[..., 4:].sum(-1)
    all_, all_e = halves.sum(2), frame.expected.sum(-1)
    silent = (all_ == 0) & (all_e >= 6)
    busy = rest > rest_e + 4 * np.sqrt(rest_e + 1) + 2
    busier = rest > rest_e + 4 * np.sqrt(rest_e + 1) + 15 * frame.seconds
    much = all_ > 3 * all_e + 20
    return np.stack([silent.sum(1), busy.sum(1), busier.sum(1), much.sum(1)], 1).astype(np.float64)


def _by_zone(halves: NDArray[np.float32], zone: NDArray[np.int64]) -> Array:
    state = halves.reshape(*halves.shape[:2], 2, 2, 2).sum(3).reshape(*halves.shape[:2], 4)
    rings = [state[:, zone == ring].sum(1) for ring in range(ZONES)]
    return np.stack(rings, 2).reshape(len(halves), -1).astype(np.float64)


def _is_mean() -> NDArray[np.bool_]:
    out = np.zeros(SIZE, np.bool_)
    for name in ("lag", "repeats", "change"):
        out[LAYOUT[name]] = True
    return out


MEANS = _is_mean()
"""Which statistics are means over events."""


def tolerance(measured: Array, events: Array) -> Array:
    """Return what each statistic may be off by, because it is of no concern or a matter of one event, (J,)."""
    out = TOLERANCE + 1.0 / (events + 3.0)
    lag = np.abs(measured[LAYOUT["lag"]]).reshape(LAGS, BANDS)
    scale = np.repeat(lag.max(0)[None], LAGS, 0).reshape(-1)
    out[LAYOUT["lag"]] *= scale
    change = np.abs(measured[LAYOUT["change"]])
    typical = 0.5 * np.median(change[: 4 * CLASSES]) if change.any() else 1.0
    out[LAYOUT["change"]] *= np.maximum(change, typical)
    out[LAYOUT["change"]][-CLASSES:] *= typical
    out[LAYOUT["repeats"]] *= np.maximum(measured[LAYOUT["repeats"]], 0.1)
    out[LAYOUT["spread"]] = 0.01 * np.maximum(1.0, np.abs(measured[LAYOUT["spread"]]))
    return out


def compared(events: Array) -> NDArray[np.bool_]:
    """Return which statistics rest on enough events of the measurement to be compared, (J,)."""
    out = np.ones(SIZE, np.bool_)
    out[MEANS] = events[MEANS] >= FEW
    out[LAYOUT["spread"]] = events[LAYOUT["spread"]] >= FEW
    return out


Describe = Callable[[int], str]
