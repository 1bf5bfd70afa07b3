"""A dead time by where the intervals between a pixel's events end, as if cut off.

The error of a model is a mean over what light does everywhere: where light is slow, the intervals that a dead
time takes away are less than one in a hundred, and the error is blind to them. But none is left, where a
model without it has hundreds, and just above the end there are as many as the model has. Nothing else does
that: a low-pass, noise and spread thresholds thin short intervals out over a factor of two and more.

Simulators that know frames alone send once or a few times for each, so a pixel's intervals end at about the
time from frame to frame, or at a multiple. There the end says nothing, unless intervals are as frequent right
above it as farther away: then no frame has made it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from dase.diagnosis.seen_effects import with_estimate_that_was_seen
from dase.diagnosis.state import DiagnosisTask, with_same_freedom
from dase.effects.refractory import Refractory
from dase.effects.shot import Shot
from dase.errors import InputError
from dase.events import Events
from dase.fitting.measurement import Measurement
from dase.fitting.model import FittedModel, refit_work, with_fixed_effect
from dase.fitting.scheduler import run_side_by_side
from dase.formatting import format_count, format_seconds
from dase.probes.distance import Judgement
from dase.probes.random_streams import Draw, SimulationStream
from dase.probes.timestamp_patterns import TimestampStructure
from dase.results import Diagnosis, Estimate
from dase.scenes.between_frames import CameraScene
from dase.scenes.video import VideoScene
from dase.signatures import kinds
from dase.signatures.calm_events import intervals_of_pixels, row_major_pixels
from dase.signatures.result import Answer, Signature
from dase.simulation.sensor import Sensor
from dase.simulation.simulate import simulate

Array = NDArray[np.float64]

EFFECT = Refractory.name


@dataclass(frozen=True)
class DeadTimeSettings:
    """When intervals end as if cut off.

    Chosen on sets a to s of other simulators and on 61 more of their recordings without a dead time: of these
    the ends are at 0.9 to 3 frames, and 33 to 16,500 intervals of a model are below.
    """

    lost: int = 100
    """Intervals below the end that the model without a dead time has, at least."""

    lost_under_lamp: float = 0.01
    """As `lost`, as a share of the model's intervals, under a lamp: all events come while its light goes one
    way, and a pole that the model lacks delays the first of them (832 of 300,000 were lost so in a clip of
    DVS-Voltmeter with two poles under one, 77,000 by a dead time)."""

    left: float = 0.01
    """Share of them that may be there: random events may come in a dead time, and pixels differ."""

    of_noise: float = 0.3
    """Share of a model's intervals that its noise makes, at most, for as many as that to be left as well:
    v2e sends noise in a dead time, too. In a clip of it 286 of 2,015 were left, and noise made 378."""

    above: float = 1.5
    """How far above the end intervals must be there, relative to it."""

    alike: float = 0.6
    """Share of the model's intervals that are there, at least: beyond a low-pass few are."""

    frames: float = 1.5
    """Times from frame to frame of a clip, or from tick to tick, below which an end may be made by these."""

    even: float = 1.6
    """How much more frequent intervals may be in one of the parts above an end than in another for it to be
    cut off, whatever frames there are: 1.0 to 1.5 above seven dead times of 0.4 to 2 frames in clips of other
    simulators, 2.6 and more above 16 ends of clips without one."""

    parts: tuple[float, float, float] = (1.03, 1.1, 1.3)
    """Where these parts end, relative to the end of the intervals."""

    fewest: int = 100
    """Intervals in the first of them, at least."""

    lost_in_step: int = 300
    """As `lost`, where events come in step with the frames."""

    left_in_step: float = 0.002
    """As `left`, where events come in step with the frames."""

    longest: float = 0.03
    """Ends above which no dead time lies [s]: 20 ms are plausible, and then a threshold must be crossed.
    In slow light the shortest intervals of spread thresholds are rare as well, such as one of 36 ms in 75,000
    events of a rule of ESIM with a jitter."""

    ends: int = 60
    """Intervals that are tried as the end, from the shortest on."""

    rarest: float = 0.05
    """Share of the intervals below the last of them."""

    events: int = 500_000
    """Events that are looked at, at about as many pixels as that takes."""

    pixels: int = 100_000
    """Pixels that are looked at, at most."""

    worse: float = 0.1
    """By how much a dead time that is certain may raise the error: the data may follow none of the rules."""


DEAD_TIME = DeadTimeSettings()


def find_dead_time(
    measurement: Measurement,
    sensor: Sensor,
    *,
    frame_step: float,
    structure: TimestampStructure,
    lamp: bool = False,
    seed: int,
    settings: DeadTimeSettings = DEAD_TIME,
) -> Signature | None:
    """Return the end of the intervals of a measurement that a model has not; None where there is none.

    Args:
        measurement: Its scene is simulated. Nothing is said where light is known in part only.
        sensor: The model, taken without any dead time but one that frames which are held ask for.
        frame_step: Time between the frames of a clip in step with which events come [s], 0 if they do not.
        structure: Regularities of the time stamps: of what comes at ticks or scans, intervals end at these.
        lamp: Whether light flickers.
        seed: Of every random number.
        settings: What an end is.
    """
    scene = measurement.scene
    if isinstance(scene, CameraScene) or measurement.trust is not None:
        return None
    events = measurement.compared_events()
    if not len(events):
        return None
    pixels = _some_pixels(events, settings, seed)
    # of held frames a pixel forgets the rest of one, which is no dead time of its own
    without = sensor.without(EFFECT) if EFFECT in sensor and not measurement.held else sensor
    try:
        made = simulate(scene, without, seed=SimulationStream.DEAD_TIME.seed(seed), pixels=pixels)
    except InputError:
        return None
    made = replace(measurement, events=made).compared_events()
    seen, modelled = (intervals_of(one, pixels) for one in (events, made))
    of_light = modelled
    if Shot.name in without:
        quiet = simulate(
            scene, without.without(Shot.name), seed=SimulationStream.DEAD_TIME.seed(seed), pixels=pixels
        )
        of_light = intervals_of(replace(measurement, events=quiet).compared_events(), pixels)
    step = max(structure.step, structure.line * max(events.width, events.height))
    gap = scene.longest_gap() if isinstance(scene, VideoScene) else 0.0
    doubtful = settings.frames * max(step, gap)
    shortest = doubtful if frame_step or measurement.held else settings.frames * step
    if lamp:
        lost = max(settings.lost, round(settings.lost_under_lamp * len(modelled)))
        settings = replace(settings, lost=lost, lost_in_step=max(lost, settings.lost_in_step))
    return end_of_intervals(
        seen, modelled, of_light, shortest=shortest, doubtful=doubtful, in_step=frame_step > 0,
        settings=settings,
    )  # fmt: skip


def intervals_of(events: Events, pixels: NDArray[np.int64] | None = None) -> Array:
    """Return the times between successive events of each pixel [s], ascending, shape (N,).

    Args:
        events: Of any polarity, in order of time.
        pixels: Row-major indices of those that count, shape (K,); None for all.
    """
    if pixels is not None:
        counts = np.zeros(events.width * events.height, bool)
        counts[pixels] = True
        events = events.select(counts[row_major_pixels(events)])
    intervals = intervals_of_pixels(events)
    return np.sort(intervals[intervals < np.inf])


def end_of_intervals(
    seen: Array,
    modelled: Array,
    of_light: Array | None = None,
    *,
    shortest: float = 0.0,
    doubtful: float = 0.0,
    in_step: bool = False,
    settings: DeadTimeSettings = DEAD_TIME,
) -> Signature | None:
    """Return where measured intervals end and a model's do not; None where they end alike.

    Args:
        seen: Times between a pixel's events that were measured [s], ascending, shape (N,).
        modelled: Those of the model without a dead time, of the same pixels [s], ascending, shape (M,).
        of_light: The same without its noise, shape (L,); None for a model that has none.
        shortest: Times up to which an end tells nothing [s].
        doubtful: Times up to which frames may make an end, unless intervals are cut off there [s].
        in_step: Whether events come in step with frames.
        settings: What an end is.
    """
    lost = settings.lost_in_step if in_step else settings.lost
    left = settings.left_in_step if in_step else settings.left
    places = np.unique(np.geomspace(1, settings.rarest * len(seen) + 1, settings.ends).astype(int)) - 1
    best: tuple[float, float, int, int, int] | None = None
    for end in np.unique(seen[places[places < len(seen)]]):
        if not shortest < end <= settings.longest:
            continue
        if end <= doubtful and not is_cut_off(seen, float(end), settings):
            continue
        here, seen_above = (int(n) for n in np.searchsorted(seen, [end, settings.above * end]))
        there, modelled_above = (int(n) for n in np.searchsorted(modelled, [end, settings.above * end]))
        just_above = seen_above - here
        of_noise = 0 if of_light is None else there - int(np.searchsorted(of_light, end))
        may_be_left = left * there + (of_noise if of_noise <= settings.of_noise * there else 0)
        if there < lost or here > may_be_left or just_above < settings.alike * (modelled_above - there):
            continue
        if best is None or here + 1 < best[0] * there:
            best = (here + 1) / there, float(end), here, there, just_above
    if best is None:
        return None
    _, end, here, there, just_above = best
    # with as many a second below the end as just above, so long a time without any is rare
    rare = -np.log(0.05) * (settings.above - 1) * end / just_above
    # and a pixel that is reset must cross a threshold after it
    shortest = float(modelled[0])
    low = max(end - float(rare) - shortest, 0.0)
    many = "no event" if not here else f"{format_count(here)} events"
    sentence = (
        f"{many} of a pixel within {format_seconds(end)} of its last, where the model without a dead time "
        f"has {format_count(there)}"
    )
    return Signature(
        name=kinds.DEAD_TIME, answer=Answer.FOUND,
        p=float(stats.poisson.cdf(here, there)), size=1 - here / there,
        unit="share of the shorter intervals that are not there", least=1 - left, sentence=sentence,
        details={
            "period": end, "low": low, "high": end, "shortest": shortest, "here": here, "without": there,
            "cut_off": is_cut_off(seen, end, settings),
        },
    )  # fmt: skip


def is_cut_off(seen: Array, end: float, settings: DeadTimeSettings = DEAD_TIME) -> bool:
    """Return whether intervals are as frequent right above an end as farther above it.

    Args:
        seen: Times between a pixel's events [s], ascending, shape (N,).
        end: One of them [s].
        settings: How alike is enough.
    """
    edges = np.array([1.0, *settings.parts])
    counts = np.diff(np.searchsorted(seen, edges * end))
    if counts[0] < settings.fewest:
        return False
    frequent = counts / np.diff(edges)
    return bool(frequent.max() <= settings.even * frequent.min())


def add_dead_time(
    task: DiagnosisTask,
    model: FittedModel,
    judgement: Judgement,
    found: Signature,
    settings: DeadTimeSettings = DEAD_TIME,
) -> tuple[FittedModel, Judgement]:
    """Return a model with the dead time that was seen, by the rule that does best; as it was if none will do.

    Args:
        task: What the diagnosis is asked.
        model: Without a dead time.
        judgement: Its held-out error.
        found: Where the intervals end.
        settings: By how much the error may rise.
    """
    end, shortest = (float(found.details[key]) for key in ("period", "shortest"))
    effects = [Refractory(period=end, mode=mode) for mode in Refractory.choices()["mode"]]
    effects = [
        replace(one, period=max(end - shortest, 0.5 * end)) if one.resets() else one for one in effects
    ]
    ways = [with_same_freedom(with_fixed_effect(model, one).sensor, model, ()) for one in effects]
    fitted = run_side_by_side([refit_work(task.evidence, way, seed=task.seed, rounds=1) for way in ways])
    judged = [task.judge(one) for one in fitted]
    first = int(np.argmin([one.error for one in judged]))
    if judged[first].error > judgement.error + settings.worse:
        return model, judgement
    return fitted[first], judged[first]


def with_dead_time(diagnosis: Diagnosis, found: Signature) -> Diagnosis:
    """Return a diagnosis in which the dead time that was seen has its length, where no fit gave one."""
    period, low, high = (float(found.details[key]) for key in ("period", "low", "high"))
    if EFFECT in diagnosis.sensor:
        model = diagnosis.sensor[EFFECT]
        assert isinstance(model, Refractory)
        period = model.period
    seen = Estimate(period, min(low, period), max(high, period))
    return with_estimate_that_was_seen(diagnosis, seen, f"{EFFECT}.period")


def _some_pixels(events: Events, settings: DeadTimeSettings, seed: int) -> NDArray[np.int64] | None:
    """Return pixels that have as many events as are looked at, row-major, shape (K,); None for all."""
    size = events.width * events.height
    count = min(settings.pixels, size * settings.events // len(events))
    if count >= size:
        return None
    draw = Draw.PIXELS_OF_INTERVALS.generator(seed)
    return np.sort(draw.choice(size, max(count, 1), replace=False))
