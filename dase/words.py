"""Cells and statistics in words."""

from __future__ import annotations

import numpy as np

from dase.error import Judgement
from dase.evidence import Evidence, Half
from dase.kernels.probes import BANDS, CLASSES, INTERVALS, KINDS, LAGS
from dase.probes import LAYOUT, MEANS, ZONES
from dase.results import Cell
from dase.trials import LAG_TIMES

SHOWN = 24
"""Cells that are listed."""

NOTABLE = 2.5
"""Standard errors below which a cell is not worth a sentence."""

_KINDS = (
    "at rest for 200 ms", "at rest for 60 ms", "where the light falls fast", "where the light falls",
    "where the light changes little", "where the light rises", "where the light rises fast",
)  # fmt: skip
_BANDS = ("dark", "dim", "middle", "bright")
_PAIRS = ("OFF after OFF", "ON after ON", "opposite after each other")
_ORDER = ("OFF after OFF", "OFF after ON", "ON after OFF", "ON after ON")
_CLASSES = ("within 12 ms", "within 50 ms", "later than 50 ms")
_STATES = ("moving", "resting")
_POLARITY = ("OFF", "ON")


def band(evidence: Evidence, n: int) -> str:
    """Return a band of intensity in words, in grey values of 8 bits."""
    edges = [f"{255 * e:.0f}" for e in evidence.bands]
    spans = [
        f"below {edges[0]} DN",
        *(f"{a} to {b} DN" for a, b in zip(edges, edges[1:], strict=False)),
        f"above {edges[-1]} DN",
    ]
    return f"{_BANDS[n]} pixels ({spans[n]})"


def place(evidence: Evidence, family: str, n: int) -> tuple[str, str, str]:
    """Return where the `n`-th statistic of a family is taken, what it is, and its unit."""
    if family == "rate":
        polarity, cell = divmod(n, KINDS * BANDS)
        return (
            f"{band(evidence, cell % BANDS)}, {_KINDS[cell // BANDS]}",
            f"{_POLARITY[polarity]} events",
            "events",
        )
    if family == "intervals":
        group, octave = divmod(n, INTERVALS)
        rest, kin = divmod(group, 3)
        return f"{_STATES[rest]} pixels", f"intervals {_octave(octave)} of {_PAIRS[kin]}", "events"
    if family == "lag":
        lag, where = divmod(n, BANDS)
        a, b = 1e3 * LAG_TIMES[lag], 1e3 * LAG_TIMES[lag + 1]
        return (
            band(evidence, where),
            f"change of light from {b:g} to {a:g} ms before the event",
            "log intensity",
        )
    if family == "repeats":
        third, where = divmod(n, BANDS)
        return (
            band(evidence, where),
            f"events that are the {'third' if third else 'second'} in a step",
            "share",
        )
    if family == "change":
        kind, rest = divmod(n, 4 * CLASSES)
        if kind == 2:
            return _CLASSES[rest], "correlation of successive changes between events", "log intensity²"
        pair, group = divmod(rest, CLASSES)
        what = ("change between events", "its deviation from the mean")[kind]
        return _CLASSES[group], f"{what}, {_ORDER[pair]}", "log intensity"
    if family == "spread":
        state, what = divmod(n, 5)
        names = ("lasting spread between pixels of OFF events", "lasting spread between pixels of ON events",
                 "shared spread of ON and OFF events", "spread between pixels of OFF events", "spread between pixels of ON events")  # fmt: skip
        return f"{_STATES[state]} pixels", names[what], "events² per event"
    if family == "pixels":
        return (
            "single pixels",
            ("silent pixels", "busy pixels at rest", "very busy pixels at rest", "busy pixels")[n],
            "pixels",
        )
    state, ring = divmod(n, ZONES)
    rest, polarity = divmod(state, 2)
    return (
        f"ring {ring + 1} of {ZONES} from the middle, {_STATES[rest]}",
        f"{_POLARITY[polarity]} events",
        "events",
    )


def _octave(n: int) -> str:
    if n < 2:
        return ("within one step of time", "of one step")[n]
    if n == INTERVALS - 1:
        return f"longer than {2 ** (n - 2)} steps"
    return f"up to {2 ** (n - 1)} steps"


def worst_cells(
    evidence: Evidence, judgement: Judgement, half: Half | None = None, *, shown: int = SHOWN
) -> tuple[Cell, ...]:
    """Return where model and measurement differ most, worst first."""
    half = half or evidence.held
    simulated, measured = half.simulated, half.seen.target
    out = []
    for family, part in LAYOUT.items():
        for n, j in enumerate(range(part.start, part.stop)):
            z = judgement.z[j]
            if not half.seen.used[j] or abs(z) < NOTABLE:
                continue
            counts = not MEANS[j] and family != "spread"
            m, s = (np.exp(v[j]) - 3.0 if counts else v[j] for v in (measured, simulated))
            where, what, unit = place(evidence, family, n)
            m, s = (max(0.0, float(v)) if counts else float(v) for v in (m, s))
            out.append(Cell(family, where, what, m, s, unit, float(z), _sentence(where, what, m, s, counts)))
    return tuple(sorted(out, key=lambda cell: -abs(cell.z))[:shown])


def _sentence(where: str, what: str, measured: float, simulated: float, counts: bool) -> str:
    if not counts:
        return f"{where}: {what} is {simulated:.3g} in the model, {measured:.3g} in the measurement"
    few, many = sorted((measured, simulated))
    side = "few" if simulated < measured else "many"
    if few < 0.5:
        return f"{where}: {what}, {simulated:.0f} in the model, {measured:.0f} in the measurement"
    ratio = many / few
    times = f"{ratio:.1f} times too {side}" if ratio >= 1.5 else f"{100 * (ratio - 1):.0f} % too {side}"
    return f"{where}: {times} {what}"


__all__ = ["LAGS", "band", "place", "worst_cells"]
