"""What a simulator that holds the frames of a clip makes of a pixel, and the dead time beyond that.

Where light jumps from frame to frame, a pixel sends as many events as the jump has thresholds, and goes on
from there (IEBCS), or it takes the light of the frame for its memory: it sends once for a frame, and the rest
of the change is lost. The latter is a dead time of a part of a frame, in which the pixel is held in reset. It
is no property of a camera, so the model has it before anything is searched. A dead time of the simulator's
own shows where a pixel's intervals begin: at two frames or more.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from dase.diagnosis.candidates import scout_of
from dase.diagnosis.dead_time import find_dead_time, intervals_of
from dase.diagnosis.grading import grade_of, judge_on_report
from dase.diagnosis.state import DiagnosisTask, with_same_freedom
from dase.effects.bandwidth import Bandwidth
from dase.effects.latency import Latency
from dase.effects.refractory import Refractory
from dase.effects.second_order import SecondOrder
from dase.fitting.data_split import SplitMeasurement
from dase.fitting.frame_steps import clip_step_of
from dase.fitting.held_clips import HELD_CLIPS, begin_of_events, frames_late
from dase.fitting.held_events import HeldEvents
from dase.fitting.measurement import Measurement, note_of_held_frames
from dase.fitting.model import FittedModel, fit_present_model, refit_model, refit_work
from dase.fitting.parameter_space import axes_of
from dase.fitting.scheduler import run_side_by_side
from dase.fitting.thresholds_of_frames import spread_of_thresholds
from dase.formatting import format_percent, format_seconds
from dase.probes.random_streams import SimulationStream
from dase.probes.stimulus import STIMULUS
from dase.results import Diagnosis, Estimate, Finding, Grade
from dase.scenes.scene import Scene
from dase.scenes.video import VideoScene
from dase.simulation.sensor import Sensor

EFFECT = Refractory.name


@dataclass(frozen=True)
class HeldFrameSettings:
    """When a pixel's intervals begin."""

    usual: float = 0.1
    """Intervals of as many frames as the first that has this share of the most frequent one's: random events
    come sooner."""

    clear: float = 0.5
    """Share of the next one's below which that may be the first, too: a dead time of whole frames ends at
    about the time of a frame."""

    by_frames: float = 0.7
    """Share of the error of a last model with a low-pass that one from frame to frame leaves, at most."""

    roughly: float = 1.5
    """Times that share that such a low-pass may leave after a fit to few pixels, for a full fit to follow."""

    at_once: float = 0.1
    """Times after a frame, relative to that to the next, at which events are not late."""

    longest: int = 1000
    """Frames up to which is counted."""

    few: int = 1_500_000
    """Intensities, pixels times frames, that tell which frame's light is the memory, about."""

    alike: float = 0.5
    """What thresholds differ by with that frame's light, relative to its neighbours', where it is clear."""

    repeats: int = 12
    """Simulations that judge."""

    few_repeats: int = 4
    """Those that judge a fit to few pixels."""

    missing: float = 3.0
    """Error of the model before the search below which no low-pass is looked for that hides jumps."""

    slow: float = 0.5
    """Share of that error that a low-pass leaves of light that goes straight, at most."""

    better: float = 0.5
    """Share of what then is left that it leaves of light that is held, at most."""


HELD_FRAMES = HeldFrameSettings()


def fewest_frames(measurement: Measurement, settings: HeldFrameSettings = HELD_FRAMES) -> tuple[int, ...]:
    """Return after how many held frames pixels can send again: what that may be, most likely first.

    0 stands for pixels that may send again within their frame: behind a low-pass events come at any time.

    Args:
        measurement: The light and the events.
        settings: What counts as the first.
    """
    intervals = intervals_of(measurement.compared_events()) / measurement.held
    counts = np.bincount(np.minimum(np.round(intervals), settings.longest).astype(np.int64), minlength=3)
    counts[0] = 0
    first = int(np.argmax(counts >= settings.usual * counts.max())) if counts.any() else 1
    out = [first]
    if first + 1 < len(counts) and counts[first] < settings.clear * counts[first + 1]:
        out.append(first + 1)
    if first > 1:
        memory, is_clear = _frames_to_memory(measurement, first, settings)
        # where light is slow no pixel asks for more, and the frames between say nothing; late by a frame and
        # more, an event is not of the frame that it comes after
        out = list(dict.fromkeys((first, memory) if is_clear else (*out, memory, 1)))
    _, are_spread = begin_of_events(_phases(measurement))
    return (*out, 0) if are_spread else tuple(out)


def _frames_to_memory(measurement: Measurement, most: int, settings: HeldFrameSettings) -> tuple[int, bool]:
    """Return after how many frames a pixel takes the light for its memory, and whether that is clear.

    With the light of another frame for the memory, the change that made an event seems to be more, or less:
    thresholds seem to differ. Where light is slow pixels send far later than they can.

    Args:
        measurement: The light and the events.
        most: Frames after which pixels send again.
        settings: How much is looked at.
    """
    scene = measurement.scene
    assert isinstance(scene, VideoScene)
    seen = HeldEvents.of(measurement.compared_events(), scene, most=settings.few)
    differ = list[float]()
    for wait in range(most, 0, -1):
        differ.append(spread_of_thresholds(seen, wait=wait))
        if not differ[-1] <= min(differ) < np.inf:
            break
    if not min(differ) < np.inf:
        return most, False
    best = int(np.argmin(differ))
    beside = [differ[at] for at in (best - 1, best + 1) if 0 <= at < len(differ)]
    return most - best, differ[best] < settings.alike * min(beside)


def with_frame_as_memory(
    sensor: Sensor,
    measurement: Measurement,
    evidence: SplitMeasurement,
    free: Sequence[str] | None,
    *,
    seed: int,
    settings: HeldFrameSettings = HELD_FRAMES,
) -> Sensor:
    """Return a sensor whose pixels take the light of a held frame for their memory, if that does better.

    Args:
        sensor: One with a dead time of its own is left as it is.
        measurement: The light and the events.
        evidence: The same, split.
        free: Parameters of the sensor that may be fitted.
        seed: Of every random number.
        settings: What is counted.
    """
    if not measurement.held or EFFECT in sensor:
        return sensor
    assert isinstance(measurement.scene, VideoScene)
    late_by = frames_late(measurement.compared_events(), measurement.scene)
    if late_by is not None and late_by > 1:
        # such a pixel remembers the light of the frame at which its event is out
        return sensor.with_effect(Refractory(period=(int(late_by) + 0.5) * measurement.held, mode="reset"))
    fewest = fewest_frames(measurement, settings)
    # or it goes on from where it has sent, as often in a frame as that asks for
    waits = [sensor] + [
        sensor.with_effect(Refractory(period=(frames - 0.5) * measurement.held, mode="reset"))
        for frames in fewest
        if frames
    ]
    error = partial(error_once_fitted, evidence, seed=seed, settings=settings)
    errors = [error(one, sensor, free) for one in waits]
    begin, _ = begin_of_events(_phases(measurement))
    if begin is not None and begin > settings.at_once:
        # or it waits until an event is out that comes as many frames later
        for frames in (one for one in fewest if one > 1):
            late = Latency(delay=(frames - 1 + begin) * measurement.held, light=0.0)
            memory = Refractory(period=(frames - 0.5) * measurement.held, mode="reset")
            waits.append(sensor.with_effect(memory))
            errors.append(error(waits[-1].with_effect(late), sensor, free))
    if 0 in fewest:
        for one in (_waiting_for_jump(sensor, evidence), sensor):
            slow = _slow(one, measurement.held)
            errors.append(error(slow, slow.without(EFFECT), None))
            waits.append(one)
    return waits[int(np.argmin(errors))]


def _waiting_for_jump(sensor: Sensor, evidence: SplitMeasurement) -> Sensor:
    """Return a sensor whose pixels wait until a held frame's light is there."""
    step = float(np.median(np.diff(evidence.when)))
    return sensor.with_effect(Refractory(period=step, mode="reset"))


def _slow(sensor: Sensor, gap: float) -> Sensor:
    """Return a sensor behind a low-pass: as slow as frames, every `gap` [s], if it has none of its own."""
    return sensor if Bandwidth.name in sensor else sensor.with_effect(Bandwidth(cutoff=0.5 / gap))


def error_once_fitted(
    evidence: SplitMeasurement,
    sensor: Sensor,
    varied: Sensor,
    free: Sequence[str] | None,
    *,
    seed: int,
    settings: HeldFrameSettings = HELD_FRAMES,
) -> float:
    """Return the error of a sensor that was fitted, of the part that chooses.

    Args:
        evidence: The measurement.
        sensor: What is fitted.
        varied: It, without what is known.
        free: What of that may be fitted; None for all.
        seed: Of every random number.
        settings: How often it is simulated.
    """
    axes = [axis.name for axis in axes_of(varied, free)]
    fitted = fit_present_model(evidence, sensor, axes, seed=seed)
    stream = SimulationStream.JUDGE.seed(seed)
    return fitted.judge(evidence.held, repeats=settings.repeats, seed=stream).error


def held_behind_low_pass(
    measurement: Measurement,
    evidence: SplitMeasurement,
    start: FittedModel,
    split: Callable[[Scene], SplitMeasurement],
    *,
    seed: int,
    settings: HeldFrameSettings = HELD_FRAMES,
) -> Measurement | None:
    """Return a measurement whose clip was held, where only a low-pass hides that; None if it was not.

    Behind a slow low-pass events come at any time from frame to frame. But light that is held explains them,
    and light that goes straight does not.

    Args:
        measurement: Of a clip.
        evidence: The same, split.
        start: The model before the search.
        split: Splits the measurement with another scene.
        seed: Of every random number.
        settings: How much better is enough.
    """
    scene = _clip_with_straight_light(measurement, evidence)
    if scene is None or EFFECT in start.sensor or Bandwidth.name in start.sensor:
        return None
    stream = SimulationStream.JUDGE.seed(seed)
    before = start.judge(evidence.held, repeats=settings.repeats, seed=stream).error
    if before < settings.missing:
        return None
    error = partial(error_once_fitted, seed=seed, settings=settings)
    slow = _slow(start.sensor, scene.longest_gap())
    straight = error(evidence, slow, slow, None)
    if straight > settings.slow * before:
        return None
    shown = scene.held(STIMULUS.common_step)
    again = split(shown)
    errors = (error(again, one, slow, None) for one in (_waiting_for_jump(slow, again), slow))
    if min(errors) > settings.better * straight:
        return None
    return replace(measurement, scene=shown, notes=(*measurement.notes, note_of_held_frames(shown)))


def known_at_frames_alone(
    measurement: Measurement,
    evidence: SplitMeasurement,
    model: FittedModel,
    error: float,
    split: Callable[[Scene], SplitMeasurement],
    *,
    seed: int,
    settings: HeldFrameSettings = HELD_FRAMES,
) -> Measurement | None:
    """Return a measurement of a simulator that filters from frame to frame; None where that says no more.

    Asked where a low-pass leaves too much. Between its frames the events may come at any time.

    Args:
        measurement: Of a clip.
        evidence: The same, split.
        model: The last one, which has a low-pass.
        error: Its error, of the part that chooses.
        split: Splits the measurement with another scene.
        seed: Of every random number.
        settings: How much better is enough.
    """
    scene = _clip_with_straight_light(measurement, evidence)
    slow = low_pass_of(model.sensor)
    if scene is None or slow is None or not clip_step_of(scene):
        return None
    rest = model.sensor.without(slow.name)
    shown = scene.known_at_frames()
    again = split(shown)
    stream = SimulationStream.JUDGE.seed(seed)
    ways = [with_same_freedom(rest.with_effect(one), model, [one.name]) for one in _in_steps(slow)]
    most = settings.by_frames * error
    # most clips are filtered in time: a fit to few pixels is enough to see that
    rough = run_side_by_side([refit_work(scout_of(again), way, seed=seed, rounds=1) for way in ways])
    for way, near in zip(ways, rough, strict=True):
        left = near.judge(again.held, repeats=settings.few_repeats, seed=stream).error
        if left > settings.roughly * most:
            continue
        fitted = refit_model(again, way, seed=seed)
        if fitted.judge(again.held, repeats=settings.repeats, seed=stream).error < most:
            note = "a low-pass from frame to frame of the clip leaves far less than one in time"
            return replace(measurement, scene=shown, notes=(*measurement.notes, note))
    return None


def low_pass_of(sensor: Sensor) -> Bandwidth | SecondOrder | None:
    """Return the low-pass of a sensor; None without one, and of two."""
    slow = [one for one in sensor.effects if isinstance(one, Bandwidth | SecondOrder)]
    return slow[0] if len(slow) == 1 else None


def _clip_with_straight_light(measurement: Measurement, evidence: SplitMeasurement) -> VideoScene | None:
    """Return the clip of a measurement whose light goes straight between frames, as far as is known yet.

    None for another scene, one that is trusted in part, or events in step with the frames.
    """
    scene = measurement.scene
    if not isinstance(scene, VideoScene) or scene.held_for or measurement.trust is not None:
        return None
    return None if evidence.frame_step or evidence.contradiction else scene


def _in_steps(effect: Bandwidth | SecondOrder) -> tuple[Bandwidth, SecondOrder]:
    """Return a low-pass from frame to frame, and two in a row, about as late as a continuous one."""
    later = 1 / effect.cutoff if isinstance(effect, Bandwidth) else 2 * effect.damping / effect.cutoff
    one = Bandwidth(cutoff=1 / later, dark=effect.dark, signal="steps")
    return one, SecondOrder(cutoff=2 / later, damping=1.0, dark=effect.dark, poles="steps")


def with_longer_dead_time(
    diagnosis: Diagnosis, task: DiagnosisTask, measurement: Measurement, model: FittedModel
) -> Diagnosis:
    """Return a diagnosis that says so where pixels wait for longer than their frame.

    A simulator that waits until a late event is out does so, too: what a latency explains is none.

    Args:
        diagnosis: Made with a model that waits.
        task: What the diagnosis is asked.
        measurement: The light and the events.
        model: The last one.
    """
    effect, gap = model.sensor[EFFECT], measurement.held
    assert isinstance(effect, Refractory)
    explained = sum(one.delay for one in model.sensor.effects if isinstance(one, Latency))
    if effect.period < gap + explained:
        return diagnosis
    sensor = model.sensor.with_effect(Refractory(period=0.5 * gap, mode="reset"))
    bare = refit_model(task.evidence, with_same_freedom(sensor, model, ()), seed=task.seed)
    without, last = (
        one.judgement for one in judge_on_report(task, [bare, model], repeats=task.settings.repeats)
    )
    ended = find_dead_time(
        measurement, bare.sensor, frame_step=0.0, structure=task.evidence.structure, seed=task.seed
    )
    grade, unknown = grade_of(without, without, last, np.inf, has_rivals=False, settings=task.settings.grades)
    fewest = round(effect.period / gap + 0.5)
    remembered = _sentence_of_memory(measurement, fewest)
    if (ended is not None and without.error > last.error) or remembered:
        grade, unknown = Grade.CERTAIN, False
    if grade is Grade.STAND_IN:
        return diagnosis
    others = (Latency.name,) if not explained and _come_late(measurement) else ()
    grade = Grade.EITHER if others else grade
    low, high = (fewest - 1) * gap, fewest * gap
    mine = {f"{EFFECT}.period": Estimate(effect.period, low, high)}
    words = f"pixels send again {format_seconds(high)} after an event at the soonest, {fewest} frames later"
    found = Finding(
        EFFECT, grade, others, unknown, error_without=without.error, error_with=last.error, parameters=mine,
        seen=ended.sentence if ended else remembered or words,
    )  # fmt: skip
    out = replace(
        diagnosis, findings=(*diagnosis.findings, found), parameters={**diagnosis.parameters, **mine}
    )
    if grade is Grade.EITHER:
        return out
    return replace(out, selected=(*out.selected, EFFECT), errors=(*out.errors, out.errors[-1]))


def _sentence_of_memory(
    measurement: Measurement, frames: int, settings: HeldFrameSettings = HELD_FRAMES
) -> str:
    """Return words for thresholds that are alike if pixels remember a later frame than that of an event.

    Args:
        measurement: The light and the events.
        frames: After how many that comes.
        settings: How much is looked at, and how alike thresholds are.

    Returns:
        "" where they are not, or as much with the frame of the event.
    """
    scene = measurement.scene
    assert isinstance(scene, VideoScene)
    if frames < 2:
        return ""
    seen = HeldEvents.of(measurement.compared_events(), scene, most=settings.few)
    later, at_once = (spread_of_thresholds(seen, wait=wait) for wait in (frames, 1))
    if not later < min(HELD_CLIPS.same, settings.alike * at_once):
        return ""
    return (
        f"thresholds of all events are alike if pixels remember the light {frames} frames after one, and "
        f"differ by {format_percent(at_once)} if they remember that of its frame"
    )


def _come_late(measurement: Measurement, settings: HeldFrameSettings = HELD_FRAMES) -> bool:
    """Return whether most events come long after a frame is shown; pixels wait for late ones."""
    begin, _ = begin_of_events(_phases(measurement))
    return begin is not None and settings.at_once < begin < 1 - settings.at_once


def _phases(measurement: Measurement) -> NDArray[np.float64]:
    """Return when events come, in times from frame to frame after the one that is shown, shape (N,)."""
    events = measurement.compared_events()
    return np.asarray((events.t - measurement.scene.sample_times()[0]) / measurement.held % 1.0)
