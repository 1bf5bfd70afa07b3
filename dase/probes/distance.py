"""How far statistics of a model are from those of a measurement."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dase.probes.random_streams import Draw
from dase.probes.statistics import LAYOUT

Array = NDArray[np.float64]


@dataclass(frozen=True)
class JudgementLimits:
    """Errors up to which a model counts as right [noise floors], and what a family of statistics may have."""

    far: float = 4.0
    """Standard deviations above the mean that the error of a family of a true model hardly ever reaches."""

    close: float = 1.15
    """A model up to this error counts as right also where its repeats differ by less: the rest is no
    matter."""

    widest: float = 1.25
    """Highest gate. Repeats may be further apart where some pixels matter much, as hot ones do; but of 1,100
    true models none ended above 1.08, and stand-ins for effects that are not known at 1.6 and 1.7."""

    quiet: float = 0.5
    """Error up to which nothing more is looked for: 100 models that lacked nothing had 0.13 to 0.38."""

    close_family: float = 4.0
    """Error of one family up to which nothing is looked for: what few statistics show the mean hides."""

    much_family: float = 8.0
    """Error of one family above which a finding is not announced, although the mean is at the floor."""


LIMITS = JudgementLimits()
"""What models are judged by unless it is told otherwise."""


@dataclass(frozen=True)
class ErrorScale:
    """What differences are measured by.

    Args:
        target: Statistics of the measurement, shape (J,).
        sigma: Standard error of a difference, tolerance included, shape (J,).
        used: Which statistics are compared, shape (J,).
        least: Standard errors that differences count as at least, shape (J,): a model that hardly sends the
            events that a mean is taken over is not right about it. None for 0.
    """

    target: Array
    sigma: Array
    used: NDArray[np.bool_]
    least: Array | None = None

    def z(self, values: Array) -> Array:
        """Return differences in standard errors, 0 where nothing is compared, shape (..., J)."""
        return in_standard_errors(values - self.target, self)

    def weights(self) -> Array:
        """Return the weight of each statistic: families weigh alike, shape (J,)."""
        return self._weights

    @cached_property
    def _weights(self) -> Array:
        out = np.zeros(len(self.used))
        for part in LAYOUT.values():
            count = np.count_nonzero(self.used[part])
            if count:
                out[part] = self.used[part] / count
        out /= max(float(out.sum()), 1e-300)
        return out

    def loss(self, values: Array) -> Array:
        """Return the robust distance, about 1 where the differences are chance, shape (...)."""
        out: Array = self._rho(values) @ self.weights()
        return out

    def _rho(self, values: Array) -> Array:
        size = np.abs(self.z(values))
        return pseudo_huber(size if self.least is None else np.maximum(size, self.least))

    def families(self, values: Array) -> dict[str, float]:
        """Return the robust distance of each family that is compared, of statistics (J,)."""
        rho = self._rho(values)
        used = {name: part for name, part in LAYOUT.items() if self.used[part].any()}
        return {name: float(rho[part][self.used[part]].mean()) for name, part in used.items()}


@dataclass(frozen=True)
class Judgement:
    """The error of a model, and what chance makes of a true one.

    Args:
        error: 1 is what two repeats of one measurement give, each of them off by what is of no concern.
        gate: Error up to which the model counts as right: 99 of 100 repeats stay below; `close` to
            `widest` of `JudgementLimits`.
        reach: Error that 99 of 100 repeats stay below.
        level: Error of a repeat, in the mean.
        families: Error per family.
        limits: Error per family that hardly any repeat exceeds in any family.
        z: Difference of each statistic in standard errors, shape (J,).
        unit: Robust distance that is called 1.
        measured: Statistics of the measurement, shape (J,).
        simulated: Statistics of the model, the mean over its repeats, shape (J,).
        compared: Which statistics are compared, shape (J,).
    """

    error: float
    gate: float
    reach: float
    level: float
    families: dict[str, float]
    limits: dict[str, float]
    z: Array
    unit: float
    measured: Array = field(default_factory=lambda: np.empty(0))
    simulated: Array = field(default_factory=lambda: np.empty(0))
    compared: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, np.bool_))


def judge_model(
    repeats: Array,
    seen: ErrorScale,
    chance: ErrorScale,
    off: Array,
    *,
    seed: int,
    settings: JudgementLimits = LIMITS,
) -> Judgement:
    """Compare a measurement with repeats of a model.

    The model is the mean of its repeats. Each repeat in turn stands in for the measurement and is compared
    with the others, off by the tolerance at random: what that gives is called 1. So a difference within the
    tolerance does not count as an error, and a model without any chance in it still has a floor. The gate is
    of chance alone: a measurement that the model is true of is not off by the tolerance.

    The unit must not be the model's own: by its scatter, one that hardly sends an event would be close to
    everything. So `seen` has the measurement's sampling errors where a model sends too few events.

    Args:
        repeats: Statistics of simulations with different seeds, shape (R, J).
        seen: Sampling errors of the difference between measurement and model.
        chance: Sampling errors of the model.
        off: The tolerance, shape (J,).
        seed: Of the random part of the tolerance.
        settings: Limits of the gate.
    """
    count = len(repeats)
    mean = repeats.mean(0)
    rng = Draw.TOLERANCE.generator(seed)
    apart = (repeats - mean) * (count / (count - 1))
    rho = pseudo_huber(in_standard_errors(apart + off * rng.standard_normal(repeats.shape), chance))
    weights = chance.weights()
    unit = float((rho @ weights).mean())
    null = pseudo_huber(in_standard_errors(apart, chance)) @ weights / unit
    reach = max(float(np.quantile(null, 0.99)), float(null.mean() + 2.6 * null.std()))
    families = {name: value / unit for name, value in seen.families(mean).items()}
    limits = {}
    for name in families:
        part = LAYOUT[name]
        own = rho[:, part][:, chance.used[part]].mean(1) / unit
        limits[name] = max(float(own.max()), float(own.mean() + settings.far * own.std()))
    error = float(seen.loss(mean)) / unit
    level = float(null.mean())
    gate = min(max(settings.close, reach), settings.widest)
    z = seen.z(mean)
    if seen.least is not None:
        z = np.where(seen.least > 0, 0.0, z)  # nothing is to be said of a mean over events that are not there
    return Judgement(
        error, gate, reach, level, families, limits, z, unit,
        measured=seen.target, simulated=mean, compared=seen.used,
    )  # fmt: skip


def in_standard_errors(apart: Array, scale: ErrorScale) -> Array:
    """Return differences in standard errors, 0 where nothing is compared, shape (..., J)."""
    out: Array = np.divide(apart, scale.sigma, out=np.zeros(np.shape(apart)), where=scale.used)
    return out


def compared_in_standard_errors(apart: Array, scale: ErrorScale) -> Array:
    """Return differences (..., J) in standard errors, only those that are compared, shape (..., K)."""
    out: Array = apart[..., scale.used] / scale.sigma[scale.used]
    return out


def pseudo_huber(z: Array) -> Array:
    """Return the pseudo-Huber loss, of any shape: z² for small z, 2 |z| for large; it never gets flat."""
    out: Array = 2.0 * (np.sqrt(1.0 + z * z) - 1.0)
    return out


def leaves_nothing(judgement: Judgement) -> bool:
    """Whether a model leaves so little that nothing more is looked for."""
    return judgement.error <= LIMITS.quiet and reaches_floor(judgement)


def reaches_floor(judgement: Judgement) -> bool:
    """Whether a model is at the floor, altogether and in every family of probes."""
    families = judgement.families
    inside = (families[name] <= max(judgement.limits[name], LIMITS.close_family) for name in families)
    return judgement.error <= judgement.gate and all(inside)


def may_be_announced(judgement: Judgement) -> bool:
    """Whether what was found may be announced: the mean is at the floor, and no family is far off.

    A search goes on while a family is above `JudgementLimits.close_family`; that nothing more is found there
    does not make what was found a stand-in.
    """
    families = judgement.families
    inside = (families[name] <= max(judgement.limits[name], LIMITS.much_family) for name in families)
    return judgement.error <= judgement.gate and all(inside)


def worst_families(judgement: Judgement) -> list[str]:
    """Return the two families that are most above their limits, if any are."""
    families, limits = judgement.families, judgement.limits
    above = [name for name in families if families[name] > limits[name]]
    return sorted(above, key=lambda name: -families[name] / limits[name])[:2]
