"""A leak of pixels that hardly rest, by what the time between two events does to how far light goes.

A memory that drifts takes from the change that an ON event needs, and adds to that of an OFF event, as long
as the time since the last event. So the longer that is, the less far light has gone at ON events, and the
farther at OFF events. A slow low-pass makes both longer, noise both shorter: only the difference counts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from dase.diagnosis.light_between_events import LightBetweenEvents, LightSteps
from dase.effects.leak import Leak
from dase.effects.timestamp import Timestamp
from dase.errors import InputError
from dase.probes.random_streams import SimulationStream
from dase.probes.timestamp_patterns import TimestampStructure
from dase.signatures import kinds
from dase.signatures.chance import NINETY
from dase.signatures.result import Answer, Signature
from dase.simulation.sensor import Sensor

Array = NDArray[np.float64]

EFFECT = Leak.name


@dataclass(frozen=True)
class DriftSettings:
    """When a memory drifts.

    Chosen on sets a to c of other simulators and scenes of key `unequal-dev`: without a leak ON and OFF were
    apart by 0.31 of a threshold at most, behind a lin-log response.
    """

    edges: tuple[float, ...] = (
        0.007, 0.01, 0.014, 0.02, 0.028, 0.04, 0.055, 0.075, 0.1, 0.14, 0.2, 0.28, 0.4, 0.55, 0.75, 1.0,
    )  # fmt: skip
    """Between the bins of the time from event to event [s]."""

    events: int = 80
    """Events of each polarity that a bin has, at least."""

    bins: int = 4
    """Bins that have them, at least."""

    goes: float = 0.35
    """Half of what ON and OFF thresholds are apart where the time is longest, relative, at least."""

    steep: float = 1.5
    """Rate of the leak from which on less is enough [Hz]: pixels send before they have waited for long."""

    rate: float = 0.5
    """Of the leak [Hz], at least."""

    errors: float = 8.0
    """Standard errors that it is above zero, at least."""

    floor: float = 0.02
    """What a bin may be off by what is no chance, relative to the threshold."""

    alike: float = 0.4
    """Rate, at least, of events after one of the same polarity and of others apart [Hz]: behind a pole light
    that has turned goes farther, and long waits end in a turn. It is 0.56 and more of nine clips with a
    leak, 0.17 of one of v2e with a pole, whose thresholds differ by 28 %: it looked like one of 0.8 Hz."""

    straight: tuple[float, float] = (0.7, 1.4)
    """Slope of a line that begins at no time and no change, relative to that of any line: so a drift goes,
    and a low-pass, which makes ON and OFF unlike where light is fast, does not."""

    model: float = 0.3
    """Slope that a model without a leak may have, relative to what is seen."""

    late: float = 1e-3
    """Time that events may wait for a tick or for their row, at most [s]: meanwhile light goes on. A scan of
    2.7 ms looked like a leak of 1.6 Hz in one scene of eight."""

    block: int = 8
    """[px] Neighbours see the same edges: blocks are independent, events are not."""


DRIFT = DriftSettings()


@dataclass(frozen=True)
class Drift:
    """How far ON and OFF thresholds go apart with time.

    Args:
        rate: Slope of half of it, relative to the threshold [1/s].
        error: Its standard error.
        goes: Where the time is longest.
        from_none: Slope of a line that begins at no time and no change.
        bins: How many tell.
        alike: Slope beside what events after one of the same polarity and others differ by [1/s].
    """

    rate: float
    error: float
    goes: float
    from_none: float
    bins: int
    alike: float

    def is_leak(self, settings: DriftSettings) -> bool:
        """Whether a leak makes it."""
        low, high = settings.straight
        return (
            self.bins >= settings.bins
            and self.rate >= settings.rate
            and self.rate >= settings.errors * self.error
            and self.alike >= settings.alike
            and (self.goes >= settings.goes or self.rate >= settings.steep)
            and low * self.rate <= self.from_none <= high * self.rate
        )


def find_drifting_memory(
    light: LightBetweenEvents,
    sensor: Sensor,
    *,
    structure: TimestampStructure,
    seed: int,
    settings: DriftSettings = DRIFT,
) -> Signature | None:
    """Return the leak of pixels whose light moves; None where a model lacks none.

    Args:
        light: Of the measurement, whose scene is simulated.
        sensor: The model, taken without a leak.
        structure: Regularities of the time stamps.
        seed: Of every random number.
        settings: What a drift is.
    """
    scene = light.measurement.scene
    if max(structure.step, structure.line * max(scene.width, scene.height)) > settings.late:
        return None
    seen = drift_of(light.seen, scene.width, settings)
    if seen is None or not seen.is_leak(settings):
        return None
    without = sensor.without(EFFECT) if EFFECT in sensor else sensor
    if structure.step and not structure.line and Timestamp.name not in without:
        # light goes on until a tick of the clock, whether a library has it or not
        without = without.with_effect(Timestamp(step=structure.step))
    try:
        made = light.of_model(without, seed=SimulationStream.DRIFTING_MEMORY.seed(seed))
    except InputError:
        return None
    modelled = drift_of(made, scene.width, settings)
    if modelled is not None and modelled.rate > settings.model * seen.rate:
        return None
    sentence = (
        f"the longer a pixel has sent nothing, the less far light goes to its next ON event and the farther "
        f"to its next OFF event: by {seen.rate:.2g} thresholds per second"
    )
    reach = NINETY * seen.error
    return Signature(
        name=kinds.DRIFTING_MEMORY, answer=Answer.FOUND,
        p=float(stats.norm.sf(seen.rate / seen.error)), size=seen.rate,
        low=seen.rate - reach, high=seen.rate + reach, unit="thresholds per second", sentence=sentence,
        details={"goes": seen.goes, "bins": seen.bins},
    )  # fmt: skip


def drift_of(steps: LightSteps, width: int, settings: DriftSettings = DRIFT) -> Drift | None:
    """Return how far ON and OFF thresholds go apart with time; None where too few events tell.

    Args:
        steps: From event to event.
        width: Columns of the sensor.
        settings: What counts.
    """
    block = steps.blocks(width, settings.block)
    sides, alike = [], []
    for sign in (1, -1):
        used = steps.counts & (steps.on == (sign > 0))
        moved = sign * steps.change[used]
        threshold = float(np.median(moved)) if len(moved) else 0.0
        if threshold <= 0:
            return None
        off = np.clip(moved / threshold - 1, -1.0, 1.0)
        sides.append(_means(off, steps.gap[used], block[used], settings))
        alike.append(_means_of_alike(off, steps.gap[used], steps.again[used], settings))
    (on, on_error, on_gap), (off, off_error, off_gap) = sides
    apart, gap = (off - on) / 2, (on_gap + off_gap) / 2
    error = np.hypot(np.hypot(on_error, off_error) / 2, settings.floor)
    # where thresholds are used up, nothing more can be seen of it
    known = np.isfinite(apart) & (np.maximum(np.abs(on), np.abs(off)) < 0.8)
    if known.sum() < settings.bins:
        return None
    apart, gap, error = apart[known], gap[known], error[known]
    rate, rate_error = _slope(gap, apart, error)
    weight = 1 / error**2
    from_none = float((weight * gap * apart).sum() / (weight * gap**2).sum())
    of_alike, _ = _slope(gap, (alike[1] - alike[0])[known] / 2, error)
    return Drift(rate, rate_error, float(apart[-1]), from_none, len(gap), of_alike)


def _means(
    off: Array, gap: Array, block: NDArray[np.int64], settings: DriftSettings
) -> tuple[Array, Array, Array]:
    """Return the mean, its standard error and the mean time of each bin; nan where events are few."""
    bins = len(settings.edges) - 1
    at = np.digitize(gap, settings.edges) - 1
    out = np.full((3, bins), np.nan)
    for n in range(bins):
        used = at == n
        count = int(used.sum())
        if count < settings.events:
            continue
        mean = float(off[used].mean())
        sums = np.bincount(block[used], off[used] - mean)
        out[:, n] = mean, np.sqrt((sums**2).sum()) / count, gap[used].mean()
    return out[0], out[1], out[2]


def _means_of_alike(off: Array, gap: Array, again: NDArray[np.bool_], settings: DriftSettings) -> Array:
    """Return the mean of each bin beside what events after one of the same polarity and others differ by.

    Those means and that difference are the ones that fit best, by least squares over the events.

    Args:
        off: How far light went, relative, shape (N,).
        gap: Time from event to event [s], shape (N,).
        again: Whether the event before had the same polarity, shape (N,).
        settings: The bins.
    """
    bins = len(settings.edges) - 1
    at = np.digitize(gap, settings.edges) - 1
    used = (at >= 0) & (at < bins)
    cell = at[used] * 2 + again[used]
    count = np.bincount(cell, minlength=2 * bins).reshape(bins, 2)
    mean = np.bincount(cell, off[used], minlength=2 * bins).reshape(bins, 2) / np.maximum(count, 1)
    # within a bin the difference of the two is known as well as the smaller of them is
    weight = count[:, 0] * count[:, 1] / np.maximum(count.sum(axis=1), 1)
    apart = float((weight * (mean[:, 1] - mean[:, 0])).sum() / max(weight.sum(), 1e-9))
    mean[:, 1] -= apart
    out: Array = (count * mean).sum(axis=1) / np.maximum(count.sum(axis=1), 1)
    return out


def _slope(x: Array, y: Array, error: Array) -> tuple[float, float]:
    """Return the slope of a straight line and its standard error."""
    weight = 1 / error**2
    centre = (weight * x).sum() / weight.sum()
    width = (weight * (x - centre) ** 2).sum()
    return float((weight * (x - centre) * y).sum() / width), float(1 / np.sqrt(width))
