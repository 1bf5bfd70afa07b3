"""Thresholds that are drawn anew at each event, by how far light goes from one event of a pixel to the next.

That is the threshold, and what it differs by from event to event is a jitter if it is independent each time.
Time stamps, latencies and noise that are off at an event make the step before it longer and the next one
shorter, or the other way round; thresholds of a pixel's own make all of its steps longer; what a scene leaves
is alike in steps that follow each other. So of steps d that follow each other the variance of what is drawn
anew is <d_k²> + 2 <d_k d_k+1> - 3 <d_k d_k+2>: of errors of single events it is 0, and of what stays, too.

What else is as irregular, such as noise that makes an event before light has gone far enough, is in the last
model, whose own events over the same scene are asked the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from dase.diagnosis.candidates import Candidate
from dase.diagnosis.light_between_events import LightBetweenEvents, LightSteps, beyond_those_alike
from dase.diagnosis.state import DiagnosisTask, with_same_freedom
from dase.effects.jitter import Jitter
from dase.errors import InputError
from dase.fitting.frame_steps import is_held
from dase.fitting.held_parts import come_together_at_pictures
from dase.fitting.measurement import Measurement
from dase.fitting.model import FittedModel, refit_model, with_fixed_effect
from dase.formatting import format_percent
from dase.probes.distance import Judgement, reaches_floor
from dase.probes.random_streams import SimulationStream
from dase.signatures import kinds
from dase.signatures.chance import NINETY
from dase.signatures.result import Answer, Signature
from dase.simulation.sensor import Sensor

Array = NDArray[np.float64]

EFFECT = Jitter.name


@dataclass(frozen=True)
class RedrawnSettings:
    """When thresholds are drawn anew."""

    least: float = 0.05
    """Spread from event to event, relative: steps of 8 bits look like 0.02, other worlds' frames 0.04."""

    clear: float = 0.1
    """The same beside a model that is not right: one without a lin-log response looked like 0.064."""

    far: float = 2.5
    """Error of the model up to which it is asked: without a low-pass, a dead time or noise steps are as
    irregular as with a strong jitter."""

    sure: float = 1.0
    """Error of the last model up to which a jitter is certain: in clips of other simulators eleven that were
    there left 0.14 to 0.94, and two that were not 1.1 and 1.5."""

    errors: float = 5.0
    """Standard errors that it is above what the model shows, at least; half of them in either polarity."""

    white: float = 0.6
    """Share of all that steps differ by, beyond what they do in the model, that is drawn anew, at least. In
    clips of v2e, whose events come at frames, it was 0.2 to 0.4."""

    model: float = 0.5
    """Variance that a model without it may show, relative to what is seen."""

    near: float = 0.85
    """The same of a model that counts as right but for a jitter: of those the two agreed within two standard
    errors where none was hidden."""

    even: float = 0.6
    """Reach of the shorter tail relative to that of the longer, at least: noise that sends events early makes
    steps shorter only, a dead time longer only."""

    noise: float = 0.5
    """Noise events in a run of four events, at most: how a world goes on after one is not known so well.
    Noise of 27 Hz, some 0.8 in a run, looked like a jitter of 17 %."""

    worse: float = 0.1
    """By how much the held-out error may rise with a jitter that is seen."""

    unlike: float = 2.0
    """Times the spread that fits that it may be: 0.8 to 1.1 in nine cases with a jitter, 5.6 beside doubles a
    quarter of a millisecond late."""

    runs: int = 300
    """Runs of four events of a polarity, at least."""

    blocks: int = 10
    """Blocks of pixels that have such runs, at least: what is independent is they."""

    longest: float = 0.05
    """Time from one event to the next that counts, at most [s]: noise and leaks grow with time."""

    reach: float = 3.0
    """What a step may be off to count, in standard deviations of the middle two thirds: noise that makes an
    event before light has gone far enough is rare, and far off."""

    samples: float = 6.0
    """Times from one sample of the scene to the next that a run lasts, at least: simulators differ in where
    in between an event comes."""

    bins: int = 6
    """Of how long runs last, with as many runs in each: what time stamps and scans do to them is least where
    they last long, what noise does where they are short."""

    shorter: float = 0.5
    """What the shorter half of the runs shows, relative to all, at least."""

    longer: float = 0.75
    """The same of the longer half, and a standard error of it: where light is slow it is of no concern what
    events are late by. A world whose events come at other places within a step showed 0.61."""

    block: int = 8
    """[px] Neighbours see the same edges: blocks are independent, events are not."""


REDRAWN = RedrawnSettings()


@dataclass(frozen=True, eq=False)
class Runs:
    """Runs of four events of one polarity, and so of three steps.

    Args:
        drawn: What was drawn anew, relative to the threshold squared; its mean is a variance, shape (N,).
        whole: All that the steps differ by, squared, shape (N,).
        lasts: Time from the first event to the last [s], shape (N,).
        block: Where they are: neighbours see the same edges, so blocks are independent, shape (N,).
        even: Reach of the shorter tail relative to that of the longer.
    """

    drawn: Array
    whole: Array
    lasts: Array
    block: NDArray[np.int64]
    even: float

    def variances(self, edges: Array) -> tuple[Array, Array, Array]:
        """Return the mean of `drawn`, its standard error and the mean of `whole` of runs that last alike.

        Args:
            edges: Between the bins of how long they last [s], shape (B,).

        Returns:
            Shape (B + 1,) each; NaN where a bin is empty.
        """
        at = np.searchsorted(edges, self.lasts)
        out = np.full((3, len(edges) + 1), np.nan)
        for n in np.unique(at):
            used = at == n
            mean = float(self.drawn[used].mean())
            sums = np.bincount(self.block[used], self.drawn[used] - mean)
            out[:, n] = mean, np.sqrt((sums**2).sum()) / used.sum(), self.whole[used].mean()
        return out[0], out[1], out[2]


@dataclass(frozen=True)
class Excess:
    """By how much the runs of a measurement are more irregular than those of a model, in one polarity.

    Args:
        drawn: Variance of what is drawn anew in the measurement, relative to the threshold squared.
        model: The same in the model.
        error: Standard error of their difference.
        whole: Variance of all that steps differ by in the measurement, less that in the model.
        shorter: What the model lacks in the shorter half of the runs.
        longer: The same in the longer half, and a standard error more.
    """

    drawn: float
    model: float
    error: float
    whole: float
    shorter: float
    longer: float

    @classmethod
    def of(cls, seen: Runs, made: Runs, bins: int) -> Excess | None:
        """Return the mean over runs that last alike, where it is known best; None where too few compare."""
        edges = np.quantile(seen.lasts, np.arange(1, bins) / bins)
        (drawn, error, whole), (model, model_error, other) = (one.variances(edges) for one in (seen, made))
        errors = np.hypot(error, model_error)
        known = np.isfinite(errors) & (errors > 0)
        if not known.all():
            return None
        weight = 1 / errors**2

        def mean(values: Array, part: slice = slice(None)) -> float:
            return float((weight[part] * values[part]).sum() / weight[part].sum())

        lacks, half = drawn - np.maximum(model, 0.0), bins // 2
        error_of_longer = float(1 / math.sqrt(weight[half:].sum()))
        return cls(
            mean(drawn), mean(model), float(1 / math.sqrt(weight.sum())), mean(whole - other),
            mean(lacks, slice(half)), mean(lacks, slice(half, None)) + error_of_longer,
        )  # fmt: skip

    @property
    def variance(self) -> float:
        """What the model lacks."""
        return self.drawn - max(self.model, 0.0)

    def is_jitter(self, settings: RedrawnSettings, *, right: bool) -> bool:
        """Whether it is large, sure, most of what there is, and not of the model.

        Args:
            settings: How large and how sure.
            right: Whether the model counts as right, but for a jitter.
        """
        least, most = (settings.least, settings.near) if right else (settings.clear, settings.model)
        return (
            self.variance >= max(least**2, 0.5 * settings.errors * self.error)
            and self.model <= most * self.drawn
            and self.variance >= settings.white * self.whole
            and self.shorter >= settings.shorter * self.variance
            and self.longer >= settings.longer * self.variance
        )


def find_jitter_beside(
    measurement: Measurement, model: FittedModel, judgement: Judgement, *, noise: float, seed: int
) -> Signature | None:
    """Return the jitter that a model lacks, however little of its error that is; None where it is far off.

    Args:
        measurement: Its scene is simulated.
        model: A jitter of its own is left out.
        judgement: Its held-out error.
        noise: Rate of the noise of pixels at rest [Hz], which a model that is not right may lack.
        seed: Of the simulations.
    """
    right = reaches_floor(judgement)
    if not right and (noise or judgement.error > REDRAWN.far):
        return None
    if come_together_at_pictures(measurement.compared_events(), measurement.scene):
        return None
    light = LightBetweenEvents.of(measurement, log_eps=model.sensor.log_eps)
    if light is None:
        return None
    return find_redrawn_thresholds(light, model.sensor, right=right, noise=noise, seed=seed)


def find_redrawn_thresholds(
    light: LightBetweenEvents,
    sensor: Sensor,
    *,
    right: bool = False,
    noise: float = 0.0,
    seed: int,
    settings: RedrawnSettings = REDRAWN,
) -> Signature | None:
    """Return by how much thresholds differ from event to event; None where a model lacks no such jitter.

    Args:
        light: Of the measurement, whose scene is simulated.
        sensor: The model, taken without a jitter.
        right: Whether the model counts as right, but for a jitter.
        noise: Rate of the events that a pixel sends without a change [Hz].
        seed: Of every random number.
        settings: When they differ.
    """
    if is_held(light.measurement.scene):
        return None
    width = light.measurement.scene.width
    shortest = settings.samples * float(np.median(np.diff(light.times)))
    seen = runs_of(light.seen, width, shortest=shortest, settings=settings)
    if not seen or (not right and any(one.even < settings.even for one in seen.values())):
        return None
    if any(noise * float(np.median(one.lasts)) > settings.noise for one in seen.values()):
        return None
    without = sensor.without(EFFECT) if EFFECT in sensor else sensor
    try:
        made = light.of_model(without, seed=SimulationStream.REDRAWN_THRESHOLDS.seed(seed))
    except InputError:
        return None
    modelled = runs_of(made, width, shortest=shortest, settings=settings)
    excess = [
        Excess.of(one, modelled[sign], settings.bins) if sign in modelled else None
        for sign, one in seen.items()
    ]
    told = [one for one in excess if one is not None and one.is_jitter(settings, right=right)]
    if len(told) < len(excess):
        return None
    weight = np.array([1 / one.error**2 for one in told])
    mean = float(weight @ [one.variance for one in told] / weight.sum())
    error = float(1 / math.sqrt(weight.sum()))
    if mean < settings.errors * error:
        return None
    spread, low, high = (math.sqrt(max(mean + k * NINETY * error, 0.0)) for k in (0, -1, 1))
    sentence = (
        f"thresholds are drawn anew at each event, with a spread of {format_percent(spread)}: light goes as "
        f"much farther or less far from one event to the next, independently each time"
    )
    return Signature(
        name=kinds.REDRAWN_THRESHOLDS, answer=Answer.FOUND,
        p=float(stats.norm.sf(mean / error)), size=spread, low=low, high=high,
        unit="spread of thresholds over events, relative", sentence=sentence,
        least=settings.least if right else settings.clear,
        details={"runs": min(len(one.drawn) for one in seen.values())},
    )  # fmt: skip


def runs_of(
    steps: LightSteps, width: int, *, shortest: float, settings: RedrawnSettings = REDRAWN
) -> dict[int, Runs]:
    """Return the runs of ON (1) and of OFF events (-1); none of a polarity that has too few.

    Args:
        steps: From event to event.
        width: Columns of the sensor.
        shortest: Time that a run lasts, at least [s].
        settings: What counts.
    """
    block = steps.blocks(width, settings.block)
    counts = steps.counts & (steps.gap < settings.longest)
    out = {}
    for sign in (1, -1):
        of_sign = counts & (steps.on == (sign > 0))
        used = of_sign & steps.again
        moved = sign * steps.change[of_sign]
        threshold = float(np.median(moved)) if len(moved) else 0.0
        if threshold <= 0 or not used.any():
            continue
        off = np.zeros(len(steps.pixel))
        near = np.clip(moved / threshold - 1, -1.0, 1.0)
        off[of_sign] = beyond_those_alike(
            near, steps.level[of_sign], sign * steps.speed[of_sign], steps.again[of_sign]
        )
        low, middle, high = np.quantile(off[used], [0.16, 0.5, 0.84])
        used &= np.abs(off - middle) <= settings.reach * 0.5 * (high - low)
        first = np.flatnonzero(used[:-2] & used[1:-1] & used[2:] & (steps.pixel[:-2] == steps.pixel[2:]))
        first = first[steps.gap[first] + steps.gap[first + 1] + steps.gap[first + 2] >= shortest]
        if len(first) < settings.runs or len(np.unique(block[first])) < settings.blocks:
            continue
        a, b, c = (off[first + n] - middle for n in range(3))
        whole = (a * a + b * b + c * c) / 3
        tails = sorted([float(middle - low), float(high - middle)])
        out[sign] = Runs(
            drawn=whole + (a * b + b * c) - 3 * a * c,
            whole=whole,
            lasts=steps.gap[first] + steps.gap[first + 1] + steps.gap[first + 2],
            block=block[first],
            even=tails[0] / tails[1] if tails[1] > 0 else 0.0,
        )
    return out


def is_unlike_fit(found: Signature, sensor: Sensor, settings: RedrawnSettings = REDRAWN) -> bool:
    """Return whether thresholds seem to differ far more from event to event than in the model that fits.

    Args:
        found: By how much they differ.
        sensor: The model, with a jitter.
        settings: How much more is too much.
    """
    jitter = sensor[EFFECT]
    assert isinstance(jitter, Jitter)
    return found.size > settings.unlike * jitter.spread


def add_jitter(
    task: DiagnosisTask,
    model: FittedModel,
    judgement: Judgement,
    found: Signature,
    settings: RedrawnSettings = REDRAWN,
) -> Candidate | None:
    """Return a model with the jitter that was seen, fitted and judged; None where it is worse or unlike that.

    Args:
        task: What the diagnosis is asked.
        model: Without a jitter.
        judgement: Its held-out error.
        found: By how much thresholds differ from event to event.
        settings: By how much the error may rise, and what was seen may be off from the fit.
    """
    sensor = with_fixed_effect(model, Jitter(spread=min(found.size, 1.0))).sensor
    fitted = refit_model(task.evidence, with_same_freedom(sensor, model, (EFFECT,)), seed=task.seed, rounds=1)
    if is_unlike_fit(found, fitted.sensor, settings):
        return None
    judged = task.judge(fitted)
    if judged.error > judgement.error + settings.worse:
        return None
    return Candidate(EFFECT, fitted, fitted.loss, judgement=judged)
