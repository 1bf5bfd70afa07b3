"""By which current, and by which loss of light at the corners, most steps from event to event are alike.

Between two events of a polarity a pixel's own signal goes by its threshold. Noise comes in between, most of
all in the dark, and makes two short steps of one, or none that light tells: medians of all steps then say
nothing (see `dase.diagnosis.steps_in_the_dark`). But steps into which no noise came are as long as ever, and
alike in all light once the right current without light is added to the scene's. So that current is sought
with which most steps are alike.

Corners that are darker than the scene need more of it there. Nothing else of a pixel that sees the logarithm
tells how much light reaches it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from dase.diagnosis.light_between_events import LightBetweenEvents, LightSteps
from dase.diagnosis.steps_in_the_dark import LAWS, LOOKED_AT, MAKERS
from dase.effects.dark import Dark
from dase.effects.vignetting import Vignetting
from dase.errors import InputError
from dase.fitting.frame_steps import is_held
from dase.fitting.measurement import Measurement
from dase.formatting import format_percent
from dase.probes.random_streams import SimulationStream
from dase.signatures.kinds import CURRENT_AT_CORNERS, LARGER_STEPS_IN_THE_DARK
from dase.signatures.result import Answer, Signature
from dase.simulation.sensor import Sensor

Array = NDArray[np.float64]


@dataclass(frozen=True)
class AlikeStepSettings:
    """When more steps are alike with a current, and with a loss of light at the corners.

    Chosen on four sets of other simulators (development).
    """

    darkest: float = 0.02
    """Middle of a step that counts, relative to the brightest light, at least."""

    longest: float = 0.05
    """Time of one that counts, at most [s]."""

    least: float = 0.02
    """Steps below that are alike with none: they are far below any threshold [log intensity]."""

    width: float = 0.05
    """Logarithms of steps that are alike are at most so far apart."""

    fine: float = 0.02
    """The same where a size is looked for: with the other one all steps of a pixel without any chance are
    alike with a current that is a fifth too small."""

    steps: int = 3000
    """Of either polarity, at least."""

    thinned: int = 8000
    """Steps of either polarity for the first looks, at most."""

    looked_at: int = 30_000
    """The same for the last ones."""

    current: tuple[float, float] = (0.02, 1.0)
    """Currents that are looked for, relative to the brightest light: some greys of 8 bits, by which steps in
    the dark are rounded, are none."""

    knee: tuple[float, float] = (0.04, 0.8)
    """Knees that are."""

    looks: int = 20
    """At either."""

    losses: tuple[float, float, float] = (0.9, 0.1, 0.02)
    """Of light in the corners that are tried: from 0 to, in steps of, and in steps of about the best."""

    more: float = 1.8
    """Times as many steps must be alike with the current: 2.0 and 3.1 in clips of two simulators with one of
    30 and 10 greys, at most 1.2 in 72 others, and 1.7 in a circuit with a dead time whose clip has 8 bits
    (sealed), with one of 4 greys."""

    decided: float = 1.3
    """Times as many as with any knee: 1.8 and 2.4 in these two."""

    corners: float = 1.1
    """Times as many with a loss at the corners: 1.24 in the one clip of these that has it, 1.00 in the other;
    in scenes of dase with one of 0.5 1.12 to 1.2 beside a mismatch of 10 % and 2.0 and more without, and
    1.014 at most with none."""

    loss: float = 0.2
    """Loss that is told, at least."""

    model: float = 0.5
    """Share of that gain which a model without either may have."""

    known: float = 0.08
    """Error of a current, relative."""

    known_loss: float = 0.12
    """Error of a loss: beside a mismatch of 10 % one of 0.5 was read as 0.38 to 0.48, without as 0.50."""


ALIKE = AlikeStepSettings()


@dataclass(frozen=True, eq=False)
class _Steps:
    """Steps of one polarity.

    Args:
        before: Log intensity less that of the brightest light, at the earlier event, shape (N,).
        after: The same at the later one.
        sign: 1 of ON events, -1 of OFF events.
        square: Of the distance of the pixel from the middle, in units of the corner's, shape (N,).
    """

    before: Array
    after: Array
    sign: int
    square: Array

    def thinned(self, most: int) -> _Steps:
        """Return so many of them at most, spread evenly."""
        every = slice(None, None, max(1, -(-len(self.after) // most)))
        return _Steps(self.before[every], self.after[every], self.sign, self.square[every])

    def share_alike(
        self, response: Callable[[Array], Array], loss: float, *, width: float, least: float
    ) -> float:
        """Return the largest share of them that are alike.

        Args:
            response: Of a pixel to log intensity.
            loss: Of light in the corners.
            width: By which logarithms of steps that are alike differ at most.
            least: Steps below that are alike with none.
        """
        less = np.log(Vignetting(loss=loss).light_at(self.square)) if loss else 0.0
        steps = self.sign * (response(self.after + less) - response(self.before + less))
        ordered = np.sort(np.log(steps[steps > least]))
        alike = np.searchsorted(ordered, ordered + width) - np.arange(len(ordered))
        return float(alike.max(initial=0)) / len(self.after)


@dataclass(frozen=True)
class _Law:
    """How many steps are alike by a law.

    Args:
        times: As many as by the logarithm, of the polarity that has less of that.
        size: Of the current or the knee, relative to the brightest light.
        loss: Of light in the corners.
    """

    times: float
    size: float
    loss: float


@dataclass(frozen=True)
class AlikeSteps:
    """A current with which steps are alike.

    Args:
        current: As many times more of them are with it alone [intensity].
        times: As many are with it as without.
        loss: Of light in the corners; 0 where none is told.
        times_at_corners: As many are with that as with the current alone.
    """

    current: float
    times: float
    loss: float
    times_at_corners: float

    def in_the_dark(self, settings: AlikeStepSettings = ALIKE) -> Signature:
        """Return what tells of the current."""
        error = settings.known * self.current
        sentence = (
            "light goes the farther from one event of a pixel to the next the darker it is, as with a "
            f"current without light of {self.current:.3g}: {self.times:.1f} times as many steps are alike"
        )
        return Signature(
            name=LARGER_STEPS_IN_THE_DARK, answer=Answer.FOUND, p=0.0, size=self.current,
            low=self.current - error, high=self.current + error, unit="intensity", sentence=sentence,
            details={"current": self.current},
        )  # fmt: skip

    def at_corners(self, settings: AlikeStepSettings = ALIKE) -> tuple[Signature, ...]:
        """Return what tells of corners that are darker than the scene's; nothing where none does."""
        if not self.loss:
            return ()
        low, high = max(self.loss - settings.known_loss, 0.0), min(self.loss + settings.known_loss, 1.0)
        sentence = (
            f"that current is the more of the scene's light the nearer a corner is, as if "
            f"{format_percent(self.loss)} of it were lost there: {self.times_at_corners:.2f} times as many "
            "steps are alike then"
        )
        return (
            Signature(
                name=CURRENT_AT_CORNERS, answer=Answer.FOUND, p=0.0, size=self.loss, low=low, high=high,
                unit="share of the light", least=settings.loss, sentence=sentence,
                details={"loss": self.loss},
            ),
        )  # fmt: skip


def find_alike_steps(
    measurement: Measurement, sensor: Sensor, *, seed: int, settings: AlikeStepSettings = ALIKE
) -> AlikeSteps | None:
    """Return the current with which steps are alike; None where there is none.

    Args:
        measurement: Its light is known, and not held.
        sensor: The model, taken without a current, a knee and darker corners.
        seed: Of its random numbers.
        settings: When there is one.
    """
    if is_held(measurement.scene):
        return None
    light = LightBetweenEvents.of(measurement, log_eps=sensor.log_eps, settings=LOOKED_AT)
    if light is None:
        return None
    steps = _steps_of(light, light.seen, settings)
    few = [one.thinned(settings.thinned) for one in steps]
    even = _best_of(few, "current", _looks(settings.current, settings), (0.0,), settings)
    if even.times < settings.more:
        return None
    knee = _best_of(few, "knee", _looks(settings.knee, settings), (0.0,), settings)
    if even.times < settings.decided * knee.times:
        return None
    even, uneven = _law_of(steps, settings)
    low, high = settings.current
    if not low < uneven.size < high or _shown_by_model(light, sensor, even, seed, settings):
        return None
    is_uneven = (
        uneven.loss >= settings.loss
        and uneven.loss < settings.losses[0]
        and uneven.times >= settings.corners * even.times
    )
    law = uneven if is_uneven else even
    times = uneven.times / even.times
    return AlikeSteps(math.exp(light.brightest) * law.size, even.times, law.loss, times)


def _steps_of(light: LightBetweenEvents, steps: LightSteps, settings: AlikeStepSettings) -> list[_Steps]:
    """Return the steps that count, of ON and OFF events that follow one of the same polarity; none if few."""
    brightest, square = light.brightest, light.square_from_middle(steps)
    out = []
    for sign in (1, -1):
        counts = steps.counts & steps.again & (steps.gap < settings.longest) & (steps.on == (sign > 0))
        counts &= steps.level - 0.5 * steps.change > brightest + math.log(settings.darkest)
        if np.count_nonzero(counts) < settings.steps:
            return []
        after = steps.level[counts] - brightest
        one = _Steps(after - steps.change[counts], after, sign, square[counts])
        out.append(one.thinned(settings.looked_at))
    return out


def _looks(ends: tuple[float, float], settings: AlikeStepSettings) -> Array:
    """Return the currents or knees that are looked at, shape (L,)."""
    return np.geomspace(*ends, settings.looks)


def _best_of(
    steps: Sequence[_Steps],
    law: str,
    sizes: Array | Sequence[float],
    losses: Array | Sequence[float],
    settings: AlikeStepSettings,
    *,
    fine: bool = False,
) -> _Law:
    """Return the size and the loss of light at the corners with which most steps are alike.

    Args:
        steps: Of either polarity.
        law: One of `LAWS`.
        sizes: That are tried, shape (L,).
        losses: That are, shape (M,).
        settings: Which steps are alike.
        fine: Whether they must be nearer to each other, which tells more of the size.
    """
    if not steps:
        return _Law(0.0, 0.0, 0.0)
    share = partial(_Steps.share_alike, width=settings.fine if fine else settings.width, least=settings.least)
    without = [share(one, lambda level: level, 0.0) for one in steps]

    def times(size: float, loss: float) -> float:
        shares = (share(one, LAWS[law](size), loss) for one in steps)
        return min(share / max(bare, 1e-9) for share, bare in zip(shares, without, strict=True))

    tried = (_Law(times(size, loss), float(size), float(loss)) for loss in losses for size in sizes)
    return max(tried, key=lambda one: one.times)


def _law_of(steps: Sequence[_Steps], settings: AlikeStepSettings) -> tuple[_Law, _Law]:
    """Return the current with which most steps are alike, and that with a loss of light at the corners."""
    most, step, fine = settings.losses
    few, sizes = [one.thinned(settings.thinned) for one in steps], _looks(settings.current, settings)
    ratio, out = sizes[1] / sizes[0], []
    for losses in (np.zeros(1), np.arange(0.0, most + fine, step)):
        rough = _best_of(few, "current", sizes, losses, settings)
        beside = np.arange(max(rough.loss - step, 0.0), min(rough.loss + step, most) + 0.5 * fine, fine)
        near = rough.size * np.geomspace(1 / ratio, ratio, 9)
        beside = beside if len(losses) > 1 else losses
        best = _best_of(steps, "current", near, beside, settings, fine=True)
        out.append(_best_of(steps, "current", (best.size,), (best.loss,), settings))
    return out[0], out[1]


def _shown_by_model(
    light: LightBetweenEvents,
    sensor: Sensor,
    law: _Law,
    seed: int,
    settings: AlikeStepSettings,
) -> bool:
    """Return whether a model without a current shows half as much of one, or cannot be simulated.

    Args:
        light: Of the rows that are looked at.
        sensor: The model.
        law: That was found.
        seed: Of the model's random numbers.
        settings: When it does.
    """
    for name in (*MAKERS, Dark.name, Vignetting.name):
        sensor = sensor.without(name) if name in sensor else sensor
    try:
        made = light.of_model(sensor, seed=SimulationStream.STEPS_IN_THE_DARK.seed(seed))
    except InputError:
        return True
    # steps of a model that sends too few tell nothing
    modelled = _steps_of(light, made, settings)
    found = _best_of(modelled, "current", (law.size,), (0.0,), settings)
    return not modelled or found.times - 1 > settings.model * (law.times - 1)
