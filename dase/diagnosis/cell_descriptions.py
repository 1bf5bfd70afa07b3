"""Cells and statistics in words."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from dase.fitting.data_split import SplitMeasurement
from dase.kernels.event_probes import BANDS, CLASSES, INTERVALS, KINDS, ZONES
from dase.probes.accumulators import PROBE_TIMES
from dase.probes.distance import Judgement
from dase.probes.statistics import LAYOUT, MEANS, SPECTRUM
from dase.probes.timestamp_patterns import TimestampStructure
from dase.results import Cell

StatisticWords = tuple[str, str, str]
"""Where a statistic is taken, what it is, and its unit."""


_BOTH_POLARITIES = ("OFF", "ON")
_STATES = ("moving", "resting")


def band_in_words(evidence: SplitMeasurement, n: int) -> str:
    """Return a band of intensity in words, in grey values of 8 bits."""
    edges = [f"{255 * e:.0f}" for e in evidence.bands]
    between = [f"{a} to {b} DN" for a, b in pairwise(edges)]
    name = ("dark", "dim", "middle", "bright")[n]
    return f"{name} pixels ({[f'below {edges[0]} DN', *between, f'above {edges[-1]} DN'][n]})"


KINDS_OF_PIXELS = ("moving", "resting", "all")
"""Whose statistics they are: of pixels whose light changes, of those at rest, of all together."""


def kind_of_pixels(family: str, n: int) -> str:
    """Return of which pixels the `n`-th statistic of a family is, one of `KINDS_OF_PIXELS`."""
    match family:
        case "rate":
            resting = (n % (KINDS * BANDS)) // BANDS < 2  # the first two kinds of cells are at rest
        case "intervals":
            resting = n // INTERVALS // 3 == 1
        case "spread":
            resting = n // 5 == 1
        case "space":
            resting = n // ZONES // 2 == 1
        case "pixels":
            resting = n < 2
        case "lag" | "repeats" | "change":
            resting = False
        case _:
            return "all"
    return "resting" if resting else "moving"


def describe_statistic(evidence: SplitMeasurement, family: str, n: int) -> StatisticWords:
    """Return where the `n`-th statistic of a family is taken, what it is, and its unit."""
    words: dict[str, Callable[[SplitMeasurement, int], StatisticWords]] = {
        "rate": _rate_words,
        "intervals": _interval_words,
        "lag": _lag_words,
        "repeats": _repeat_words,
        "change": _change_words,
        "spread": _spread_words,
        "pixels": _odd_pixel_words,
        "silent": _silent_pixel_words,
        "space": _ring_words,
        "spectrum": _spectrum_words,
        "stamps": _timestamp_words,
    }
    return words[family](evidence, n)


def _rate_words(evidence: SplitMeasurement, n: int) -> StatisticWords:
    polarity, cell = divmod(n, KINDS * BANDS)
    # in the order of the kinds of `dase.kernels.event_probes`
    kind = (
        "at rest for 200 ms", "at rest for 60 ms", "where the light falls fast", "where the light falls",
        "where the light changes little", "where the light rises", "where the light rises fast",
    )[cell // BANDS]  # fmt: skip
    return (
        f"{band_in_words(evidence, cell % BANDS)}, {kind}",
        f"{_BOTH_POLARITIES[polarity]} events",
        "events",
    )


def _interval_words(evidence: SplitMeasurement, n: int) -> StatisticWords:
    group, octave = divmod(n, INTERVALS)
    rest, kin = divmod(group, 3)
    pair = ("OFF after OFF", "ON after ON", "opposite after each other")[kin]
    return f"{_STATES[rest]} pixels", f"intervals {_octave_words(octave)} of {pair}", "events"


def _lag_words(evidence: SplitMeasurement, n: int) -> StatisticWords:
    lag, where = divmod(n, BANDS)
    a, b = 1e3 * PROBE_TIMES.lags[lag], 1e3 * PROBE_TIMES.lags[lag + 1]
    what = f"change of light from {b:g} to {a:g} ms before the event"
    return band_in_words(evidence, where), what, "log intensity"


def _repeat_words(evidence: SplitMeasurement, n: int) -> StatisticWords:
    third, where = divmod(n, BANDS)
    what = f"events that are the {'third' if third else 'second'} in a step"
    return band_in_words(evidence, where), what, "share"


def _change_words(evidence: SplitMeasurement, n: int) -> StatisticWords:
    kind, rest = divmod(n, 4 * CLASSES)
    after = ("within 12 ms", "within 50 ms", "later than 50 ms")
    if kind == 2:
        return after[rest], "correlation of successive changes between events", "log intensity²"
    pair, group = divmod(rest, CLASSES)
    what = ("change between events", "deviation from the mean change between events")[kind]
    order = ("OFF after OFF", "OFF after ON", "ON after OFF", "ON after ON")[pair]
    return after[group], f"{what}, {order}", "log intensity"


def _spread_words(evidence: SplitMeasurement, n: int) -> StatisticWords:
    spreads = (
        "lasting spread between pixels of OFF events", "lasting spread between pixels of ON events",
        "shared spread of ON and OFF events", "spread between pixels of OFF events",
        "spread between pixels of ON events",
    )  # fmt: skip
    state, what = divmod(n, len(spreads))
    return f"{_STATES[state]} pixels", spreads[what], "events² per event"


def _odd_pixel_words(evidence: SplitMeasurement, n: int) -> StatisticWords:
    what = ("busy pixels at rest", "very busy pixels at rest", "busy pixels")[n]
    return "single pixels", what, "pixels"


def _silent_pixel_words(evidence: SplitMeasurement, n: int) -> StatisticWords:
    return "single pixels", "silent pixels", "pixels"


def _ring_words(evidence: SplitMeasurement, n: int) -> StatisticWords:
    state, ring = divmod(n, ZONES)
    rest, polarity = divmod(state, 2)
    where = f"ring {ring + 1} of {ZONES} from the middle, {_STATES[rest]}"
    return where, f"{_BOTH_POLARITIES[polarity]} events", "events"


def _spectrum_words(evidence: SplitMeasurement, n: int) -> StatisticWords:
    if n >= SPECTRUM.count:
        return "all pixels", f"swing of the net rate at {evidence.peak.frequency:.4g} Hz", "share"
    ends = SPECTRUM.edges(evidence.held.frame.step)
    return "all pixels", f"power of the net rate from {ends[n]:.3g} to {ends[n + 1]:.3g} Hz", "log power"


def _timestamp_words(evidence: SplitMeasurement, n: int) -> StatisticWords:
    return "all pixels", TimestampStructure.NAMES[n], "share"


def _octave_words(n: int) -> str:
    if n < 2:
        return ("within one step of time", "of one step")[n]
    if n == INTERVALS - 1:
        return f"longer than {2 ** (n - 2)} steps"
    return f"up to {2 ** (n - 1)} steps"


def worst_cells(
    evidence: SplitMeasurement,
    judgement: Judgement,
    *,
    shown: int = 24,
    notable: float = 2.5,
) -> tuple[Cell, ...]:
    """Return where model and measurement differ most, worst first.

    Args:
        evidence: The measurement.
        judgement: Of the model.
        shown: Cells at most.
        notable: Standard errors below which a cell is not worth a sentence.
    """
    simulated, measured = judgement.simulated, judgement.measured
    out = []
    for family, part in LAYOUT.items():
        for n, j in enumerate(range(part.start, part.stop)):
            z = judgement.z[j]
            if not judgement.compared[j] or abs(z) < notable:
                continue
            counts = not MEANS[j] and family not in ("spread", "spectrum", "stamps")
            m, s = (np.exp(v[j]) - 3.0 if counts else v[j] for v in (measured, simulated))
            where, what, unit = describe_statistic(evidence, family, n)
            m, s = (max(0.0, float(v)) if counts else float(v) for v in (m, s))
            out.append(
                Cell(family, where, what, m, s, unit, float(z), _cell_sentence(where, what, m, s, counts))
            )
    return tuple(sorted(out, key=lambda cell: -abs(cell.z))[:shown])


def _cell_sentence(where: str, what: str, measured: float, simulated: float, counts: bool) -> str:
    if not counts:
        return f"{where}: {what} is {simulated:.3g} in the model, {measured:.3g} in the measurement"
    few, many = sorted((measured, simulated))
    side = "few" if simulated < measured else "many"
    if few < 0.5:
        return f"{where}: {what}, {simulated:.0f} in the model, {measured:.0f} in the measurement"
    ratio = many / few
    times = f"{ratio:.1f} times too {side}" if ratio >= 1.5 else f"{100 * (ratio - 1):.0f} % too {side}"
    return f"{where}: {times} {what}"
