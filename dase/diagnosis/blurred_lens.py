"""Whether the camera saw a clip less sharply than it is: a lens, which no fit of what pixels do can find.

A lens acts on pictures, so each width of it is another scene. How far light goes from one event of a pixel
to the next is the threshold, and differs least behind the lens that was there: where that shows it, the
search begins behind it. It is asked for once more where a search ends with something unexplained: one number
is tried against all that was added, and where it leaves less, the search begins anew. A camera's own frames
are as blurred as its events, and are not asked.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial

import numpy as np

from dase.diagnosis.compared_measurement import ComparedMeasurement
from dase.diagnosis.grading import grade_of, judge_on_report
from dase.diagnosis.late_light import more_alike_if_late
from dase.diagnosis.light_between_events import LightBetweenEvents, LightSteps
from dase.diagnosis.state import DiagnosisTask
from dase.effects.optics_blur import OpticsBlur
from dase.fitting.data_split import SplitMeasurement
from dase.fitting.measurement import Measurement, with_lens
from dase.fitting.model import (
    FittedModel,
    fit_present_model,
    fit_roughly,
    model_of,
    refit_model,
    still_free,
)
from dase.formatting import format_percent
from dase.probes.random_streams import SimulationStream
from dase.results import Diagnosis, Estimate, Finding, Grade
from dase.scenes.scene import Scene
from dase.scenes.video import VideoScene
from dase.simulation.sensor import Sensor

EFFECT = OpticsBlur.name


@dataclass(frozen=True)
class LensSettings:
    """Which lenses are tried, and how much one must explain."""

    widths: tuple[float, ...] = (0.6, 1.2, 2.4)
    """Standard deviations of the point spread that are tried first [px]."""

    finer: tuple[float, ...] = (0.5, 0.25)
    """Then those so many octaves on both sides of the best one."""

    closest: float = 0.125
    """And of the last model those so many octaves away: between them lies the width [octaves]."""

    better: float = 0.8
    """Share of the error of the last model that a lens leaves at most where all of that is known."""

    simpler: float = 1.0
    """The same where effects were added to it that are not certain: the lens does without them."""

    beside: float = 0.4
    """The same where one effect stays: 0.1 to 0.2 where there was a lens, 0.6 and more where something was
    missing that the library has not."""

    others: int = 6
    """Effects beside which a lens is tried, one at a time, by rough fits; beside one it is fitted well."""

    worth: float = 2.0
    """What is left after a coarser look, in units of what may be left, with which finer ones go on."""

    roughly: float = 1.25
    """What a rough fit may leave, in units of what may be left, for a good one to follow."""

    repeats: int = 12
    """Simulations that judge."""

    few_repeats: int = 4
    """Those that judge a rough fit."""

    octaves: tuple[float, float, float] = (-2.0, 1.5, 0.5)
    """Widths behind which steps from event to event are compared: from, to, and apart [octaves of 1.2 px]."""

    first: tuple[float, float] = (-1.5, -0.5)
    """Those that are looked at first [octaves of 1.2 px]."""

    begun: float = 0.97
    """Share of what steps differ by that they do behind the better of these, at most, for others to be looked
    at: narrower than a lens they show some of it, and without one steps differ more."""

    closer: float = 0.125
    """And between the two beside the best, so far apart [octaves]."""

    alike: float = 0.6
    """Share of what steps differ by that they do behind a lens, at most, in either polarity: 0.02 to 0.5
    where there was one. Without one, and with what follows, it was 0.75 at least."""

    even: float = 0.35
    """What they then differ by, at most, relative to the threshold: of slow pixels, whose steps a lens makes
    more alike, too, it was 0.7 and more."""

    ruled_out: tuple[float, ...] = (-1.5, -0.5, 0.5)
    """Widths behind all of which steps differ more where there is no lens [octaves of 1.2 px]. Behind the
    best they differed by 0.06 to 0.96 of what they did without where there was one, whatever was beside it,
    of one polarity at least."""

    tells: float = 0.3
    """What steps differ by without a lens, at most, relative to the threshold, for that to be said: behind a
    lens of 0.5 px and a latency of 3 ms, where it is 0.5, they may become more alike nowhere."""

    steps: int = 300
    """Steps of a polarity, at least."""

    longest: float = 0.05
    """Time of one that counts, at most [s]: noise and leaks grow with time."""


LENS = LensSettings()


@dataclass(frozen=True)
class SeenLens:
    """A lens that is seen by how far light goes from event to event.

    Args:
        measurement: Its clip is behind the lens.
        sharp: What steps differ by without the lens, relative to the threshold.
        behind: What they differ by behind it.
    """

    measurement: Measurement
    sharp: float
    behind: float

    @property
    def sentence(self) -> str:
        """What is seen."""
        return (
            f"from one event of a pixel to the next the light of the clip goes as far to within "
            f"{format_percent(self.sharp)}, and behind the lens to within {format_percent(self.behind)}"
        )


def lens_between_events(
    measurement: Measurement, *, log_eps: float, settings: LensSettings = LENS
) -> SeenLens | None:
    """Return the lens behind which light goes equally far from event to event; None where none is seen.

    It takes no model: whatever thresholds are, light goes one of them from each event to the next. Effects
    that make steps differ, such as a low-pass, hide a lens here, and are no lens.

    Args:
        measurement: Of a clip, without a lens.
        log_eps: Added to intensities before the logarithm.
        settings: Which widths are looked at, and how alike steps must become.
    """
    scene = measurement.scene
    if not isinstance(scene, VideoScene) or scene.sharp is not None or scene.held_for:
        return None
    if (scene.width, scene.height) != (measurement.events.width, measurement.events.height):
        return None  # who splits the measurement says so

    def differ(width: float) -> tuple[float, float]:
        seen = behind_lens(measurement, width) if width else measurement
        return _differ_between_events(seen, log_eps, settings)

    sharp = differ(0.0)
    if not all(math.isfinite(one) for one in sharp):
        return None
    low, high, step = settings.octaves
    seen = {at: differ(1.2 * 2**at) for at in settings.first}
    if not any(_ratio(sharp, one) < settings.begun for one in seen.values()):
        return None
    wide = np.arange(low, high + step / 2, step)
    seen |= {float(at): differ(1.2 * 2**at) for at in wide if float(at) not in seen}
    best = min(seen, key=lambda at: max(seen[at]))
    if not low < best < high or not _is_lens(sharp, seen[best], settings):
        return None
    closer = np.arange(best - step + settings.closer, best + step - settings.closer / 2, settings.closer)
    seen |= {float(at): differ(1.2 * 2**at) for at in closer if float(at) not in seen}
    best = min(seen, key=lambda at: max(seen[at]))
    errors = tuple(max(seen[at]) ** 2 for at in (best - settings.closer, best, best + settings.closer))
    assert len(errors) == 3
    width = _least_between(1.2 * 2**best, settings.closer, errors)
    behind = behind_lens(measurement, width)
    # events behind a very slow low-pass are those of light that looks less sharp
    if more_alike_if_late(measurement, behind, log_eps=log_eps):
        return None
    return SeenLens(behind, max(sharp), max(seen[best]))


def rules_out_lens(measurement: Measurement, *, log_eps: float, settings: LensSettings = LENS) -> bool:
    """Return whether light goes less equally far from event to event behind any lens, in either polarity.

    Whatever else makes steps differ, behind a lens that is there they differ less. It takes a part of the
    time of one fit, and `seen_through_a_lens` dozens.

    Args:
        measurement: Of a clip, without a lens.
        log_eps: Added to intensities before the logarithm.
        settings: Which widths are looked at.
    """
    scene = measurement.scene
    if not isinstance(scene, VideoScene) or scene.sharp is not None or scene.held_for:
        return False
    sharp = _differ_between_events(measurement, log_eps, settings)
    if max(sharp) > settings.tells:
        return False
    lenses = (behind_lens(measurement, 1.2 * 2**at) for at in settings.ruled_out)
    behind = (_differ_between_events(seen, log_eps, settings) for seen in lenses)
    return all(b > a for both in behind for a, b in zip(sharp, both, strict=True))


def _is_lens(sharp: tuple[float, float], behind: tuple[float, float], settings: LensSettings = LENS) -> bool:
    """Return whether steps differ so much less behind a lens, and so little.

    Args:
        sharp: What ON and OFF steps differ by without it, relative to the threshold.
        behind: The same behind it.
        settings: How much less, and how little.
    """
    return _ratio(sharp, behind) <= settings.alike and max(behind) <= settings.even


def _ratio(sharp: tuple[float, float], behind: tuple[float, float]) -> float:
    """Return what steps differ by behind a lens, relative to without it, of the polarity with more."""
    return max(b / a if 0 < a < math.inf else math.inf for a, b in zip(sharp, behind, strict=True))


def _differ_between_events(
    measurement: Measurement, log_eps: float, settings: LensSettings
) -> tuple[float, float]:
    """Return what ON and OFF steps of the light of a measurement differ by, see `_differences`."""
    light = LightBetweenEvents.of(measurement, log_eps=log_eps)
    return (math.inf, math.inf) if light is None else _differences(light.seen, settings)


def _differences(steps: LightSteps, settings: LensSettings = LENS) -> tuple[float, float]:
    """Return what ON and OFF steps differ by: half of what two thirds lie in, relative to their median.

    Infinite for a polarity with too few.

    Args:
        steps: From event to event.
        settings: Which count.
    """
    out = []
    for on in (True, False):
        moved = steps.change[steps.counts & (steps.on == on) & (steps.gap < settings.longest)]
        if len(moved) < settings.steps:
            out.append(math.inf)
            continue
        low, middle, high = np.quantile(moved, [0.16, 0.5, 0.84])
        as_far = float(middle) if on else -float(middle)
        out.append(0.5 * float(high - low) / as_far if as_far > 0 else math.inf)
    return out[0], out[1]


def seen_through_a_lens(
    measurement: Measurement,
    model: FittedModel,
    error: float,
    known: Iterable[str],
    first: Sequence[FittedModel],
    split: Callable[[Scene], SplitMeasurement],
    *,
    seed: int,
    settings: LensSettings = LENS,
) -> Measurement | None:
    """Return a measurement whose clip is seen through a lens; None where that explains no more.

    The lens is tried in place of all that was added, and then beside each effect that did best by itself, for
    what was added may stand for both.

    Args:
        measurement: Of a clip, without a lens.
        model: The last one.
        error: Its error, of the part that chooses.
        known: Names of its effects that are not in question.
        first: Models with one effect more than what is known, the best first.
        split: Splits the measurement with another scene.
        seed: Of every random number.
        settings: What is tried.
    """
    scene = measurement.scene
    if not isinstance(scene, VideoScene) or scene.sharp is not None:
        return None
    bare = model.sensor
    for effect in model.sensor.effects:
        bare = bare if effect.name in known else bare.without(effect.name)
    tried = [(bare, still_free(bare, model))]
    tried += [(one.sensor, [axis.name for axis in one.space.axes]) for one in first[: settings.others]]

    @lru_cache(len(settings.widths))  # of those that each is tried behind
    def seen_behind(width: float) -> SplitMeasurement:
        return split(behind_lens(measurement, width).scene)

    @cache
    def left(which: int, width: float) -> float:
        fitted = fit_present_model(seen_behind(width), *tried[which], seed=seed)
        return error_of_choice(seen_behind(width), fitted, seed=seed)

    @cache
    def left_roughly(which: int, width: float) -> float:
        return _rough_error(seen_behind(width), *tried[which], seed=seed)

    def left_at_first(which: int) -> float:
        return min(left_roughly(which, width) for width in settings.widths)

    share = settings.better if bare == model.sensor else settings.simpler

    def ways() -> Iterator[tuple[int, float]]:
        yield 0, share * error
        if len(tried) > 1:
            yield min(range(1, len(tried)), key=left_at_first), settings.beside * error

    for which, most in ways():
        near = best_width(partial(left_roughly, which), settings.roughly * most, settings)
        if near is None:
            continue
        closely = replace(settings, widths=(near,), finer=settings.finer[-1:])
        width = best_width(partial(left, which), most, closely)
        if width is not None:
            return behind_lens(measurement, width)
    return None


def _rough_error(evidence: SplitMeasurement, sensor: Sensor, free: Sequence[str], *, seed: int) -> float:
    """Return about the error that a model leaves on the part that chooses, fitted to few pixels."""
    fitted = fit_roughly(evidence, sensor, free, seed=seed)
    stream = SimulationStream.JUDGE.seed(seed)
    return fitted.judge(evidence.held, repeats=LENS.few_repeats, seed=stream).error


def best_width(
    left: Callable[[float], float], most: float = math.inf, settings: LensSettings = LENS
) -> float | None:
    """Return the width of a point spread [px] that leaves the least error; None where that is too much.

    Args:
        left: Tells the error behind a lens of a width [px].
        most: Error that is not too much.
        settings: What is tried.
    """
    errors = {width: left(width) for width in settings.widths}
    for octaves in settings.finer:
        if min(errors.values()) > settings.worth * most:
            return None
        best = min(errors, key=lambda width: errors[width])
        errors |= {width: left(width) for width in _beside(best, octaves)}
    best, step = min(errors, key=lambda width: errors[width]), settings.finer[-1]
    if errors[best] > most:
        return None
    low, high = (errors[width] if width in errors else left(width) for width in _beside(best, step))
    return _least_between(best, step, (low, errors[best], high))


def with_blurred_lens(
    diagnosis: Diagnosis,
    task: DiagnosisTask,
    compared: ComparedMeasurement,
    start: FittedModel,
    model: FittedModel,
    settings: LensSettings = LENS,
) -> Diagnosis:
    """Return a diagnosis that says that the clip is seen through a lens, and how wide its point spread is.

    Args:
        diagnosis: Made behind that lens.
        task: What the diagnosis is asked.
        compared: The measurement, which has the lens.
        start: The model before the search.
        model: The last one.
        settings: How finely the width is told.
    """
    measurement, seed = compared.measurement, task.seed
    scene, lens = measurement.scene, measurement.lens
    assert isinstance(scene, VideoScene)
    assert scene.sharp is not None
    assert lens is not None
    task.progress("how sharp the lens is", 0.9, diagnosis.errors[-1])
    sharp = compared.split(scene.sharp, all_time=task.all_time)
    stream, repeats = SimulationStream.JUDGE.seed(seed), task.settings.repeats
    given = model_of(compared.given).judge(sharp.report, repeats=repeats // 2, seed=stream)
    first, without = (
        refit_model(sharp, one, seed=seed).judge(sharp.report, repeats=repeats, seed=stream)
        for one in (start, model)
    )
    last = judge_on_report(task, [model], repeats=repeats)[0].judgement
    grade, unknown = grade_of(first, without, last, math.inf, has_rivals=False, settings=task.settings.grades)
    bare = replace(measurement, scene=scene.sharp, lens=None)
    seen = lens_between_events(bare, log_eps=compared.given.log_eps, settings=settings)
    if seen is not None and without.error > last.error:
        grade, unknown = Grade.CERTAIN, False
    width = _width_beside(compared, task, model, lens.sigma, settings)
    mine = {f"{EFFECT}.sigma": width}
    found = Finding(
        EFFECT, grade, unknown=unknown, error_without=without.error, error_with=last.error, parameters=mine,
        seen="" if seen is None else seen.sentence,
    )  # fmt: skip
    out = replace(diagnosis, before=given.error)
    if grade not in (Grade.CERTAIN, Grade.SUPPORTED):
        note = f"all errors are behind a lens of {lens.sigma:.2g} px, which is not found for certain"
        out = replace(out, notes=(*out.notes, note))
    if grade is Grade.STAND_IN:
        return replace(out, stand_ins=(*out.stand_ins, found))
    out = replace(out, findings=(*out.findings, found))
    if grade is Grade.EITHER:
        return out
    return replace(
        out,
        sensor=with_lens(out.sensor, OpticsBlur(sigma=width.value)),
        selected=(EFFECT, *out.selected),
        errors=(first.error, *out.errors),
        parameters={**mine, **out.parameters},
    )


def behind_lens(measurement: Measurement, width: float) -> Measurement:
    """Return a measurement whose clip is seen through a lens of this width [px]."""
    lens = OpticsBlur(sigma=width)
    scene = measurement.scene
    bare = replace(measurement, scene=(scene.sharp or scene) if isinstance(scene, VideoScene) else scene)
    return replace(bare.through_lens_of(with_lens(Sensor(), lens)), lens=lens)


def _beside(width: float, octaves: float) -> tuple[float, float]:
    """Return the widths so many octaves below and above one."""
    return width * math.exp2(-octaves), width * math.exp2(octaves)


def error_of_choice(
    evidence: SplitMeasurement, model: FittedModel, *, seed: int, settings: LensSettings = LENS
) -> float:
    """Return the error of a model, of the part that chooses."""
    stream = SimulationStream.JUDGE.seed(seed)
    return model.judge(evidence.held, repeats=settings.repeats, seed=stream).error


def _width_beside(
    compared: ComparedMeasurement,
    task: DiagnosisTask,
    model: FittedModel,
    width: float,
    settings: LensSettings,
) -> Estimate:
    """Return the width of the point spread [px] beside the last model, between two that leave more."""
    errors, step = list[float](), settings.closest
    for octaves in (-step, 0.0, step):
        seen = behind_lens(compared.measurement, width * math.exp2(octaves))
        evidence = compared.split(seen.scene, all_time=task.all_time)
        fitted = refit_model(evidence, model, seed=task.seed, rounds=1)
        errors.append(error_of_choice(evidence, fitted, seed=task.seed, settings=settings))
    low, middle, high = errors
    best = _least_between(width, step, (low, middle, high))
    return Estimate(best, *_beside(best, step))


def _least_between(width: float, step: float, errors: tuple[float, float, float]) -> float:
    """Return the width that leaves least, by a parabola through three errors.

    Args:
        width: The one in the middle [px].
        step: To the others, below and above it [octaves].
        errors: Of the three, in this order.
    """
    low, middle, high = errors
    curve = low - 2 * middle + high
    # where the parabola opens downwards, the better end
    off = 0.5 * (low - high) / curve if curve > 0 else math.copysign(1.0, low - high)
    return width * math.exp2(step * min(max(off, -1.0), 1.0))
