"""Summary statistics of events with a physical reading, and what they are called.

`dase.kernels.event_probes` adds up numbers event by event; here the sums become statistics by which model and
measurement are compared. Each belongs to a family, a row of `FAMILIES`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft
from scipy.ndimage import median_filter

from dase.events import Events
from dase.kernels.event_probes import (
    BANDS,
    CELLS,
    CLASSES,
    INTERVALS,
    LAGS,
    ZONES,
    FoldPlace,
    SumPlace,
)
from dase.probes.accumulators import ProbeSums, ProbeTotals, StatisticsFrame, compute_totals

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

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SpectrumBands:
    """Bands of frequency in which the power of the net event rate is compared, each as wide by factors."""

    count: int = 12
    """About half an octave each: lamps and scans stand out, and noise averages over many frequencies."""

    lowest: float = 8.0
    """Lower end of the first [Hz]; what is slower is motion, of which few periods are seen."""

    at_once: int = 1 << 22
    """Numbers of clocks whose spectra are taken together, for the memory that takes."""

    def edges(self, step: float) -> Array:
        """Return the ends of the bands up to half the sampling rate, shape (count + 1,) [Hz].

        Args:
            step: From sample to sample [s].
        """
        return np.geomspace(self.lowest, 0.5 / step, self.count + 1)


SPECTRUM = SpectrumBands()


def _places_of_families() -> dict[str, slice]:
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
        "spectrum": SPECTRUM.count + 2,
        "stamps": 2,
    }
    ends = np.cumsum(list(sizes.values()))
    return {
        name: slice(int(end - size), int(end)) for (name, size), end in zip(sizes.items(), ends, strict=True)
    }


LAYOUT = _places_of_families()
"""Place of each family in a vector of statistics."""

SIZE = max(part.stop for part in LAYOUT.values())
"""Statistics in all."""


def ring_of_pixels(pixels: NDArray[np.int32], width: int, height: int) -> NDArray[np.int64]:
    """Return the ring that each pixel lies in, shape (N,)."""
    x, y = pixels % width - 0.5 * (width - 1), pixels // width - 0.5 * (height - 1)
    radius = np.hypot(x, y)
    out: NDArray[np.int64] = np.searchsorted(np.quantile(radius, np.arange(1, ZONES) / ZONES), radius)
    return out


def compute_statistics(found: ProbeSums | ProbeTotals, frame: StatisticsFrame) -> tuple[Array, Array]:
    """Return statistics and how many events each rests on.

    Returns:
        Statistics, shape (B, J), and events, shape (B, J); of counts, which are given as log(count + 3), the
        count itself.
    """
    of = compute_totals(found, frame) if isinstance(found, ProbeSums) else found
    a = of.sums
    odd = of.folded[:, FoldPlace.ODD : FoldPlace.ODD + 4]
    parts = [
        _log_counts(a[:, SumPlace.RATE : SumPlace.RATE + 2 * CELLS]),
        _log_counts(a[:, SumPlace.ISI : SumPlace.ISI + 6 * INTERVALS]),
        _event_means(
            a[:, SumPlace.LAG : SumPlace.LAG + LAGS * BANDS],
            np.tile(a[:, SumPlace.LAG_COUNT : SumPlace.LAG_COUNT + BANDS], LAGS),
        ),
        _repeat_shares(a[:, SumPlace.REPEAT : SumPlace.REPEAT + 3 * BANDS].reshape(-1, BANDS, 3)),
        _change_moments(
            a[:, SumPlace.CHANGE : SumPlace.CHANGE + 12 * CLASSES].reshape(-1, 4 * CLASSES, 3),
            a[:, SumPlace.SERIAL :],
        ),
        _count_spread(of.folded[:, FoldPlace.PRODUCTS : FoldPlace.PRODUCTS + 12], of.expected),
        _log_counts(odd[:, :3]),
        _log_counts(odd[:, 3:]),
        _log_counts(of.folded[:, FoldPlace.RINGS :]),
        _rate_spectrum(of.clock, frame),
        (of.stamps, np.full(of.stamps.shape, 1e9 if frame.regular else 0.0)),
    ]
    values = np.concatenate([value for value, _ in parts], axis=1)
    weight = np.concatenate([events for _, events in parts], axis=1)
    if frame.measured is not None:
        means = MEANS
        # a mean over few events of the model is drawn to the measured one, as if by these events more
        drawn = (values * weight + 3.0 * frame.measured) / (weight + 3.0)
        values[:, means] = drawn[:, means]
    return values, weight


def _log_counts(counts: Array) -> tuple[Array, Array]:
    return np.log(counts + 3.0), counts


def _event_means(total: Array, events: Array) -> tuple[Array, Array]:
    return total / np.maximum(events, 1.0), events


def _repeat_shares(counts: Array) -> tuple[Array, Array]:
    second, third = (_event_means(counts[:, :, n], counts[:, :, 0]) for n in (1, 2))
    return np.concatenate([second[0], third[0]], 1), np.concatenate([second[1], third[1]], 1)


def _change_moments(pairs: Array, serial: Array) -> tuple[Array, Array]:
    events = pairs[:, :, 0]
    mean, _ = _event_means(pairs[:, :, 1], events)
    deviation, _ = _event_means(pairs[:, :, 2], events)
    product, count = _event_means(serial[:, 1::2], serial[:, 0::2])
    return np.concatenate([mean, deviation, product], 1), np.concatenate([events, events, count], 1)


def _count_spread(products: Array, expected: Array) -> tuple[Array, Array]:
    """Split-half covariances over pixels of what is not expected, and Fano factors."""
    # state (moving, rest), then: products over the halves by their polarities, those of a half with itself
    of = products.reshape(-1, 2, 6)
    total, both = _counts_of_spread(expected)
    diagonal, own = of[..., [0, 3]], of[..., 4:]
    same = diagonal * 2 / total
    cross = (of[..., 1] + of[..., 2]) / both
    fano = (own + 2 * diagonal) / total
    values = np.concatenate([same, cross[..., None], fano], -1).reshape(len(of), -1)
    return values, np.broadcast_to(events_of_spread(expected), values.shape)


def _counts_of_spread(counts: Array) -> tuple[Array, Array]:
    """Return events by state and polarity, at least one, (B, 2, 2), and means of both polarities, (B, 2)."""
    total = np.maximum(counts.reshape(-1, 2, 2, 2).sum(2), 1.0)  # of state, half, polarity
    return total, np.sqrt(total[..., 0] * total[..., 1])


def events_of_spread(counts: Array) -> Array:
    """Return how many events each statistic of `spread` rests on.

    Args:
        counts: Events of all pixels by state, half and polarity, shape (B, HALVES).
    """
    total, both = _counts_of_spread(counts)
    return np.concatenate([total, both[..., None], total], -1).reshape(len(total), -1)


def _rate_spectrum(clock: NDArray[np.int32], frame: StatisticsFrame) -> tuple[Array, Array]:
    """Logarithms of the power of the net rate in bands of frequency, and its swing at the measured peak."""
    # some rows at a time: their spectra take several times the memory of the clocks
    rows = max(1, SPECTRUM.at_once // clock.shape[1])
    parts = [_spectrum_of_rows(clock[n : n + rows], frame) for n in range(0, max(len(clock), 1), rows)]
    values, total = (np.concatenate(column) for column in zip(*parts, strict=True))
    return values, np.repeat(total[:, None], values.shape[1], 1).astype(np.float64)


def _spectrum_of_rows(clock: NDArray[np.int32], frame: StatisticsFrame) -> tuple[Array, NDArray[np.int64]]:
    """Return the statistics of `_rate_spectrum`, shape (B, J), and the events of each row, shape (B,)."""
    steps = clock.shape[1] // 2
    off, on = clock[:, frame.first : steps], clock[:, steps + frame.first :]
    net = (on - off).astype(np.float32)
    total = np.maximum((on + off).sum(1), 1)
    net -= net.mean(1, keepdims=True)
    count = net.shape[1]
    window, mean = _tone_bands(count, frame.step)
    power = np.abs(rfft(net * window, axis=1)) ** 2 / count
    bands = power @ mean
    swing = net @ _swing_basis(frame.peak, frame.first, count, frame.step) / total[:, None]
    return np.concatenate([np.log(bands + 0.5), swing], 1).astype(np.float64), total


@lru_cache(maxsize=8)
def _tone_bands(count: int, step: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the window, shape (T,), and what makes means over bands of the power, shape (F, bands)."""
    bands = np.searchsorted(SPECTRUM.edges(step), np.fft.rfftfreq(count, step))
    inside = bands[:, None] == np.arange(1, SPECTRUM.count + 1)
    mean = (inside / np.maximum(inside.sum(0), 1)).astype(np.float32)
    return np.hanning(count).astype(np.float32), mean


@lru_cache(maxsize=8)
def _swing_basis(peak: float, first: int, count: int, step: float) -> NDArray[np.float32]:
    """Return cosine and minus sine of a frequency `peak` [Hz] at steps [s] from `first` on, shape (T, 2)."""
    turn = 2 * np.pi * peak * step * (first + np.arange(count))
    return np.stack([np.cos(turn), -np.sin(turn)], 1).astype(np.float32)


class RatePeak(NamedTuple):
    """Where the net rate swings most above what is usual about it.

    Args:
        frequency: There [Hz]; 0 where steps are too long for any that is looked for.
        chance: Probability that events which know nothing of each other swing as much anywhere.
    """

    frequency: float
    chance: float


def peak_of(clock: NDArray[np.int64], step: float) -> RatePeak:
    """Return where the net rate swings most above what is usual about it.

    Args:
        clock: OFF, then ON events of each step, shape (..., 2 T).
        step: Of the clock [s].
    """
    steps = clock.shape[-1] // 2
    net = (clock[..., steps:] - clock[..., :steps]).reshape(-1).astype(np.float64)
    net -= net.mean()
    size = 8 * steps
    power = np.abs(np.fft.rfft(net * np.hanning(steps), size)) ** 2
    frequency = np.fft.rfftfreq(size, step)
    usual = median_filter(power, 8 * 25, mode="nearest")
    above = power / (usual + 1e-3 * power.max() + 1e-9)
    inside = (frequency >= 20.0) & (frequency <= 0.48 / step)
    if not inside.any():  # steps of more than 24 ms show none of them
        return RatePeak(0.0, 1.0)
    above[~inside] = 0.0
    top = int(above.argmax())
    # where all is quiet an overtone may stand as far above it as its stronger tone does where more goes on
    for many in (2, 3):
        tone = np.where(np.abs(many * frequency - frequency[top]) < 1.5 / (steps * step), above, 0.0)
        lower = int(tone.argmax())
        if tone[lower] > 0.5 * above[top] and power[lower] > power[top]:
            top = lower
            break
    # the top is chosen where the usual is low by chance as well: what it is compared with is wider
    around = power[max(top - 8 * 200, 0) : top + 8 * 200]
    # the power of independent events is exponential, with a median of log 2 means; padded, a maximum lies
    # between bins, and is that of about twice as many
    power_in_means = power[top] * math.log(2.0) / (float(np.median(around)) + 1e-9)
    tones = 2.0 * np.count_nonzero(inside) * steps / size
    return RatePeak(float(frequency[top]), -math.expm1(-tones * math.exp(-min(power_in_means, 700.0))))


def refine_frequency(events: Events, begin: float, end: float, near: float) -> float:
    """Return the frequency about `near` at which the net rate of all events swings most in a time [Hz]."""
    step = 1 / (32 * near)
    bins = int((end - begin) / step)
    inside = (events.t >= begin) & (events.t < begin + bins * step)
    place = np.minimum((events.t[inside] - begin) / step, bins - 1).astype(np.int64)
    net = np.bincount(place, np.where(events.p[inside], 1.0, -1.0), bins)
    net = (net - net.mean()) * np.hanning(bins)
    # finer than a Fourier transform of this time has them
    frequency = near + np.linspace(-1.5, 1.5, 121) / (end - begin)
    power = np.empty(len(frequency))
    for few in np.array_split(np.arange(len(frequency)), 31):  # all at once would not fit into memory
        turns = np.exp(-2j * np.pi * frequency[few, None] * step * np.arange(bins))
        power[few] = np.abs(turns @ net) ** 2
    top = int(power[1:-1].argmax()) + 1
    left, middle, right = np.log(power[top - 1 : top + 2] + 1e-300)
    shift = 0.5 * (left - right) / min(left - 2 * middle + right, -1e-12)
    return float(frequency[top] + np.clip(shift, -1, 1) * (frequency[1] - frequency[0]))


def _is_mean() -> NDArray[np.bool_]:
    out = np.zeros(SIZE, np.bool_)
    for name in ("lag", "repeats", "change"):
        out[LAYOUT[name]] = True
    return out


MEANS = _is_mean()
"""Which statistics are means over events."""


def tolerance_of(measured: Array, events: Array, *, relative: float = 0.015) -> Array:
    """Return what each statistic may be off by: it is of no concern, or a matter of one event, (J,).

    Args:
        measured: Statistics of the measurement, shape (J,).
        events: That they rest on, shape (J,).
        relative: Difference that is of no concern, as a share.
    """
    out = relative + 1.0 / (events + 3.0)
    lag = np.abs(measured[LAYOUT["lag"]]).reshape(LAGS, BANDS)
    scale = np.repeat(lag.max(0)[None], LAGS, 0).reshape(-1)
    out[LAYOUT["lag"]] *= scale
    change = np.abs(measured[LAYOUT["change"]])
    typical = 0.5 * np.median(change[: 4 * CLASSES]) if change.any() else 1.0
    out[LAYOUT["change"]] *= np.maximum(change, typical)
    out[LAYOUT["change"]][-CLASSES:] *= typical
    out[LAYOUT["repeats"]] *= np.maximum(measured[LAYOUT["repeats"]], 0.1)
    out[LAYOUT["spectrum"]] = 0.1
    out[LAYOUT["spectrum"]][SPECTRUM.count :] = 0.005
    out[LAYOUT["stamps"]] = 0.02
    out[LAYOUT["spread"]] = 0.015 * np.maximum(1.0, np.abs(measured[LAYOUT["spread"]]))
    return out


def sampling_variance(left: Array, events: Array) -> Array:
    """Return the variance of statistics of the measurement, seen between groups of its pixels, shape (J,).

    Args:
        left: Statistics of the measurement without one group after the other, shape (G, J).
        events: That each rests on, shape (J,).
    """
    out: Array = (len(left) - 1) * left.var(0)
    # counts scatter at least by chance; where few came, groups may be alike by chance
    counts = ~MEANS
    for name in ("spread", "spectrum", "stamps"):
        counts[LAYOUT[name]] = False
    out[counts] = np.maximum(out, (events + 2.0) / (events + 3.0) ** 2)[counts]
    return out


def lacks_events(measured: Array, sent: Array, *, least_events: float = 25.0) -> NDArray[np.bool_]:
    """Return where a model sends less than half of the events that a statistic rests on, (J,).

    There the scatter of its repeats says nothing of that of the measurement. Only where enough was measured:
    half of it is no chance of a true model then.

    Args:
        measured: Events of the measurement, shape (J,).
        sent: Events of the model, shape (J,).
        least_events: Of the measurement, below which nothing is said.
    """
    out: NDArray[np.bool_] = (measured >= least_events) & (sent < 0.5 * measured)
    return out


def shortfall_of(
    measured: Array, sent: Array, *, least_events: float = 25.0, relative: float = 0.015
) -> Array:
    """Return by how many standard errors events are too few for a mean over them to be compared, (J,).

    A mean over events that a model does not send is drawn to the measured one, so it would look right. From
    a fourth of the events on, the lack of events is taken for the difference.

    Args:
        measured: Events of the measurement, shape (J,).
        sent: Events of the model, shape (J,).
        least_events: Of the measurement, below which nothing is said.
        relative: Difference that is of no concern, as a share.
    """
    lack = np.log((measured + 3.0) / (sent + 3.0)) - np.log(4.0)
    z = lack / np.sqrt((measured + 2.0) / (measured + 3.0) ** 2 + relative**2)
    means = MEANS.copy()
    means[LAYOUT["spread"]] = True
    return np.where(means & (measured >= least_events), np.maximum(z, 0.0), 0.0)


def is_compared(measured: Array, events: Array, *, least_events: float = 25.0) -> NDArray[np.bool_]:
    """Return which statistics rest on enough events of the measurement to be compared, (J,).

    Args:
        measured: Statistics of the measurement, shape (J,).
        events: That they rest on, shape (J,).
        least_events: Below which a mean over events is not compared; the spectrum needs ten times as many.
    """
    out = np.ones(SIZE, np.bool_)
    out[MEANS] = events[MEANS] >= least_events
    out[LAYOUT["spread"]] = events[LAYOUT["spread"]] >= least_events
    out[LAYOUT["spectrum"]] = events[LAYOUT["spectrum"]] >= 10 * least_events
    out[LAYOUT["stamps"]] = (events[LAYOUT["stamps"]] > 0) & (measured[LAYOUT["stamps"]] > 0)
    return out


FAMILY_WORDS = {
    "rate": "how many events come",
    "intervals": "the time between events of a pixel",
    "lag": "how late events come",
    "repeats": "bursts of events",
    "change": "the contrast from event to event",
    "spread": "how unlike pixels are",
    "pixels": "busy pixels",
    "silent": "silent pixels",
    "space": "events in the middle and in the corners",
    "spectrum": "rhythms of the event rate",
    "stamps": "the clock of the time stamps",
}
"""Family of statistics to what differs."""
