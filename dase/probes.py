"""Summary statistics of events with a physical reading, and what they are called.

`dase.kernels.probes` adds up numbers event by event; here the sums become statistics by which model and
measurement are compared. Each belongs to a family, a row of `FAMILIES`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft
from scipy.ndimage import median_filter

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
    "pixels": "pixels that are far busier than others",
    "silent": "pixels that send nothing although they see something",
    "space": "events by the distance from the middle of the sensor",
    "spectrum": "how fast the rate of all pixels swings",
    "stamps": "regularities of the time stamps; compared only where the measurement has one",
}
"""Families of statistics, each with the weight of all others."""

TOLERANCE = 0.015
"""Relative difference that is of no concern."""

FEW = 25.0
"""Events below which a mean over events is not compared."""

SHRINK = 3.0
"""Events of the measurement that are added to a mean of the model, which may have none."""

SEEN = 6.0
"""Events that are expected of a pixel which is called silent if it sends none."""

ZONES = 4
"""Rings about the middle of the sensor, of equal numbers of pixels."""

TONES = 12
"""Bands of frequency, from `LOWEST` to half the sampling rate."""

LOWEST = 8.0
"""[Hz]"""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sums:
    """What the kernels have added up, a row for each model.

    Args:
        sums: Over all pixels, shape (B, SIZE).
        halves: Counts of each pixel, shape (B, N, HALVES).
        groups: Over groups of neighbours in the list of pixels, shape (B, G, SIZE).
        clock: OFF and ON events of each step of time, shape (B, 2 T).
        teams: The same of groups of pixels, shape (B, G, 2 T).
        stamps: Shares of events that follow regularities of the time stamps, shape (B, 2).
    """

    sums: Array
    halves: NDArray[np.float32]
    groups: NDArray[np.float32]
    clock: NDArray[np.int64]
    teams: NDArray[np.int32]
    stamps: Array

    @classmethod
    def join(cls, parts: Sequence[Sums]) -> Sums:
        """Return the rows of all parts."""
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))

    def row(self, n: int) -> Sums:
        """Return one row."""
        return Sums(*(getattr(self, f.name)[n : n + 1] for f in fields(Sums)))

    def without(self, pixels: NDArray[np.int64]) -> Sums:
        """Return the first row without one group after the other, shape (G, ...).

        Args:
            pixels: Group of each pixel, shape (N,).
        """
        count = self.groups.shape[1]
        kept = np.arange(count)[:, None] != pixels
        return Sums(
            self.sums[0] - self.groups[0], self.halves[0] * kept[..., None], self.groups[:0],
            self.clock[0] - self.teams[0], self.teams[:0], np.repeat(self.stamps[:1], count, 0),
        )  # fmt: skip


@dataclass(frozen=True)
class Frame:
    """What statistics refer to; the same for measurement and models.

    Args:
        expected: Counts that the present model expects, shape (N, HALVES), or one for each row.
        zone: Ring of each pixel, shape (N,).
        measured: Statistics of the measurement, which means of a model with few events are drawn to,
            shape (J,); None to work them out.
        seconds: Time that is compared [s].
        first: Step of the grid at which it begins.
        step: Of the grid [s].
        peak: Frequency at which the measured rate swings most [Hz].
        regular: Whether the time stamps of the measurement follow a regularity.
    """

    expected: Array
    zone: NDArray[np.int64]
    seconds: float
    first: int = 0
    step: float = 1e-3
    peak: float = 0.0
    regular: bool = False
    measured: Array | None = None


def _layout() -> dict[str, slice]:
    sizes = {
        "rate": 2 * CELLS,
        "intervals": 6 * INTERVALS,
        "lag": LAGS * BANDS,
        "repeats": 2 * BANDS,
        "change": 2 * 4 * CLASSES + CLASSES,
        "spread": 10,
        "pixels": 3,
        "silent": 1,
        "space": 4 * ZONES,
        "spectrum": TONES + 2,
        "stamps": 2,
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
    out: NDArray[np.int64] = np.searchsorted(np.quantile(radius, np.arange(1, ZONES) / ZONES), radius)
    return out


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
        *map(_counts, _odd_pixels(found.halves, frame)),
        _counts(_by_zone(found.halves, frame.zone)),
        _spectrum(found.clock, frame),
        (found.stamps, np.full(found.stamps.shape, 1e9 if frame.regular else 0.0)),
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
    d = (halves - expected.astype(np.float32)).reshape(*halves.shape[:2], 2, 2, 2)
    e = expected.reshape(-1, halves.shape[1], 2, 2, 2)
    total = np.maximum(e.sum((1, 3)), 1.0)  # (B or 1, state, polarity)
    both = np.sqrt(total[..., 0] * total[..., 1])
    a, b = d[:, :, :, 0], d[:, :, :, 1]  # the halves
    products = np.einsum("bnsp,bnsq->bspq", a, b, optimize=True).astype(np.float64)
    own = sum(np.einsum("bnsp,bnsp->bsp", x, x, optimize=True) for x in (a, b)).astype(np.float64)
    diagonal = np.stack([products[..., 0, 0], products[..., 1, 1]], -1)
    same = diagonal * 2 / total
    cross = (products[..., 0, 1] + products[..., 1, 0]) / both
    fano = (own + 2 * diagonal) / total
    values = np.concatenate([same, cross[..., None], fano], -1).reshape(len(halves), -1)
    events = np.concatenate([total, both[..., None], total], -1).reshape(len(e), -1)
    return values, np.broadcast_to(events, values.shape)


def _odd_pixels(halves: NDArray[np.float32], frame: Frame) -> tuple[Array, Array]:
    """Numbers of pixels that are busy at rest or altogether, and of those that are silent."""
    rest, rest_e = halves[..., 4:].sum(-1), frame.expected[..., 4:].sum(-1).astype(np.float32)
    all_, all_e = halves.sum(-1), frame.expected.sum(-1).astype(np.float32)
    bound = rest_e + 4 * np.sqrt(rest_e + 1)
    busy = rest > bound + 2, rest > bound + np.float32(15 * frame.seconds), all_ > 3 * all_e + 20
    silent = ((all_ == 0) & (all_e >= SEEN),)
    many, few = (
        np.stack([np.count_nonzero(o, axis=1) for o in odd], 1).astype(np.float64) for odd in (busy, silent)
    )
    return many, few


def _by_zone(halves: NDArray[np.float32], zone: NDArray[np.int64]) -> Array:
    ring = (zone[:, None] == np.arange(ZONES)).astype(np.float32)
    state = np.matmul(halves.transpose(0, 2, 1), ring).reshape(len(halves), 2, 2, 2, ZONES)
    out: Array = state.sum(2).reshape(len(halves), -1).astype(np.float64)
    return out


def _spectrum(clock: NDArray[np.int64], frame: Frame) -> tuple[Array, Array]:
    """Logarithms of the power of the net rate in bands of frequency, and its swing at the measured peak."""
    steps = clock.shape[1] // 2
    off, on = clock[:, frame.first : steps], clock[:, steps + frame.first :]
    net = (on - off).astype(np.float32)
    total = np.maximum((on + off).sum(1), 1)
    net -= net.mean(1, keepdims=True)
    count = net.shape[1]
    power = np.abs(rfft(net * np.hanning(count).astype(np.float32), axis=1)) ** 2 / count
    frequency = np.fft.rfftfreq(count, frame.step)
    edges = np.geomspace(LOWEST, 0.5 / frame.step, TONES + 1)
    inside = np.searchsorted(edges, frequency)[:, None] == np.arange(1, TONES + 1)
    bands = power @ (inside / np.maximum(inside.sum(0), 1)).astype(np.float32)
    turn = 2 * np.pi * frame.peak * frame.step * (frame.first + np.arange(count))
    swing = net @ np.stack([np.cos(turn), -np.sin(turn)], 1).astype(np.float32) / total[:, None]
    values = np.concatenate([np.log(bands + 0.5), swing], 1).astype(np.float64)
    return values, np.repeat(total[:, None], values.shape[1], 1).astype(np.float64)


def peak_of(clock: NDArray[np.int64], step: float) -> float:
    """Return the frequency at which the net rate swings most above what is usual about it [Hz]."""
    steps = clock.shape[-1] // 2
    net = (clock[..., steps:] - clock[..., :steps]).reshape(-1).astype(np.float64)
    net -= net.mean()
    size = 8 * steps
    power = np.abs(np.fft.rfft(net * np.hanning(steps), size)) ** 2
    frequency = np.fft.rfftfreq(size, step)
    usual = median_filter(power, 8 * 25, mode="nearest")
    above = power / (usual + 1e-3 * power.max() + 1e-9)
    above[(frequency < 20.0) | (frequency > 0.48 / step)] = 0.0
    return float(frequency[int(above.argmax())])


def _is_mean() -> NDArray[np.bool_]:
    out = np.zeros(SIZE, np.bool_)
    for name in ("lag", "repeats", "change"):
        out[LAYOUT[name]] = True
    return out


MEANS = _is_mean()
"""Which statistics are means over events."""


def tolerance(measured: Array, events: Array) -> Array:
    """Return what each statistic may be off by: it is of no concern, or a matter of one event, (J,)."""
    out = TOLERANCE + 1.0 / (events + 3.0)
    lag = np.abs(measured[LAYOUT["lag"]]).reshape(LAGS, BANDS)
    scale = np.repeat(lag.max(0)[None], LAGS, 0).reshape(-1)
    out[LAYOUT["lag"]] *= scale
    change = np.abs(measured[LAYOUT["change"]])
    typical = 0.5 * np.median(change[: 4 * CLASSES]) if change.any() else 1.0
    out[LAYOUT["change"]] *= np.maximum(change, typical)
    out[LAYOUT["change"]][-CLASSES:] *= typical
    out[LAYOUT["repeats"]] *= np.maximum(measured[LAYOUT["repeats"]], 0.1)
    out[LAYOUT["spectrum"]] = 0.1
    out[LAYOUT["spectrum"]][TONES:] = 0.005
    out[LAYOUT["stamps"]] = 0.02
    out[LAYOUT["spread"]] = 0.015 * np.maximum(1.0, np.abs(measured[LAYOUT["spread"]]))
    return out


def compared(measured: Array, events: Array) -> NDArray[np.bool_]:
    """Return which statistics rest on enough events of the measurement to be compared, (J,)."""
    out = np.ones(SIZE, np.bool_)
    out[MEANS] = events[MEANS] >= FEW
    out[LAYOUT["spread"]] = events[LAYOUT["spread"]] >= FEW
    out[LAYOUT["spectrum"]] = events[LAYOUT["spectrum"]] >= 10 * FEW
    out[LAYOUT["stamps"]] = (events[LAYOUT["stamps"]] > 0) & (measured[LAYOUT["stamps"]] > 0)
    return out
