"""What events of held frames tell without a fit: a latency, a low-pass, darker corners, errors of the stamps,
and a jitter.

No fit to statistics in steps of a millisecond tells a tenth of one; where frames are held each event does.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dase.diagnosis.state import DiagnosisTask
from dase.effects import Effect
from dase.effects.bandwidth import Bandwidth
from dase.effects.jitter import Jitter
from dase.effects.latency import Latency
from dase.effects.refractory import Refractory
from dase.effects.second_order import SecondOrder
from dase.effects.timestamp import Timestamp
from dase.effects.vignetting import Vignetting
from dase.effects.voltage_noise import VoltageNoise
from dase.events import Events
from dase.fitting.delays_after_frames import DELAYS, DelaysAfterFrames, delays_after_frames
from dase.fitting.held_clips import frames_late
from dase.fitting.held_events import HeldEvents
from dase.fitting.measurement import Measurement
from dase.fitting.thresholds_of_frames import DrawnThresholds, thresholds_of_frames
from dase.formatting import format_percent, format_seconds
from dase.results import Diagnosis, Estimate, Finding, Grade
from dase.scenes.video import VideoScene
from dase.signatures.chance import NINETY
from dase.simulation.sensor import Sensor


@dataclass(frozen=True)
class ReadingSettings:
    """From which sizes on delays are findings.

    IEBCS by itself is 100 us late, give or take 10 us, behind a low-pass of 40 kHz at its brightest.
    """

    width: float = 0.25
    """Share of the time from frame to frame in which most events with a short way come, at most."""

    latency: float = 150e-6
    """[s] At least."""

    middle: float = 0.01
    """Share of the time from frame to frame within which events come at its middle: a simulator that spreads
    those of a frame evenly sends a single one there, and nothing is late."""

    jitter: float = 25e-6
    """[s] At least."""

    about_zero: float = 0.25
    """Of latencies that are drawn about 0 the medians of bins, relative to the later half, at most: half of
    all are 0, and as many as that by chance; the sixth of them that come first are."""

    even: float = 1.5
    """By how much the early half of the delays may widen with the way: what a low-pass adds does."""

    few: float = 1.5
    """The same beside, relative, of a bin with one event: it falls with the root of their number."""

    cutoff: float = 1e4
    """[Hz] At most, at intensity 1."""

    errors: float = 5.0
    """Standard errors by which delays grow with the way, at least, for a low-pass."""

    corner_errors: float = 6.0
    """Standard errors by which they grow by more in the corners, at least, for a vignetting: at most 3.9 in
    20 held clips of IEBCS (development) without one, and 9.7 in one with a loss of 0.35."""

    loss: float = 0.1
    """Share of the light that is lost in a corner, at least."""

    known_corner: float = 0.5
    """Error of the square of the tangent to the corner beside chance, relative: losses of 0.3, 0.5 and 0.7 of
    simulated pixels were read as 0.24, 0.40 and 0.58, for how far a pixel has to go is not known exactly."""

    own: float = 0.3
    """Share of the variance of thresholds that stays from event to event, at most, for a jitter: -0.2 to 0.1
    in 15 clips, 0.7 where pixels have thresholds of their own."""

    least_jitter: float = 0.01
    """Spread of thresholds from event to event that the model has before the search, at least, relative."""

    named_jitter: float = 0.05
    """The same of a finding: IEBCS by itself has 0.02 to 0.03."""

    most_jitter: float = 0.6
    """The same, at most: more is not of thresholds."""

    unlike: float = 2.0
    """Times that the spread of one polarity may be that of the other: where bursts of the array come between
    events it was 11."""

    known: float = 0.03
    """Error of a delay beside chance, relative: how far a pixel has to go is known from thresholds that
    differ."""


READINGS = ReadingSettings()

AT_ONCE = 1e-6
"""[s] After a frame, as the stamps of a file tell."""


def with_direct_readings(
    found: Diagnosis, task: DiagnosisTask, measurement: Measurement, settings: ReadingSettings = READINGS
) -> Diagnosis:
    """Return a diagnosis of held frames in which all that the delays of their events show is certain.

    Args:
        found: By the search.
        task: What the diagnosis is asked.
        measurement: The light and the events.
        settings: What counts.
    """
    scene = measurement.scene
    if not isinstance(scene, VideoScene) or not measurement.held or measurement.trust is not None:
        return found
    events, late_by = _events_at_their_frames(measurement, scene)
    frames = int(late_by or 0)
    delays = delays_after_frames(events, scene, wait=frames + 1)
    if delays is None or (late_by is None and delays.width() > settings.width):
        return found
    for effect, sentence, mine in _effects_of(delays.brighter_half(), settings, frames):
        if effect.name not in task.effects or effect.name in task.given:
            continue
        late = isinstance(effect, Latency) and _waits_for_frames(found.sensor, effect, measurement.held)
        if late and late_by is None:
            continue  # only the search tells by how many frames more events are late
        found = _with_certain(found, effect, sentence, mine)
    return found


def _events_at_their_frames(measurement: Measurement, scene: VideoScene) -> tuple[Events, float | None]:
    """Return the events, earlier by the whole frames that they are late by, and how late they are [frames].

    Args:
        measurement: The events.
        scene: Its clip.
    """
    events = measurement.compared_events()
    late = frames_late(events, scene)
    return replace(events, t=events.t - int(late or 0) * measurement.held), late


def _waits_for_frames(sensor: Sensor, effect: Latency, gap: float) -> bool:
    """Return whether events may be late by frames `gap` [s] apart, beside what is read off after the last."""
    known = [one.delay for one in sensor.effects if isinstance(one, Latency)]
    waits = [one.period for one in sensor.effects if isinstance(one, Refractory)]
    return any(abs(one - effect.delay) > 0.5 * gap for one in known) or any(one > gap for one in waits)


def with_drawn_thresholds(
    sensor: Sensor, measurement: Measurement, settings: ReadingSettings = READINGS
) -> Sensor:
    """Return a sensor with the jitter that events of held frames have, one by one.

    Args:
        sensor: Takes the light of a frame for its memory.
        measurement: The light and the events.
        settings: What counts as a jitter.
    """
    scene, memory = measurement.scene, sensor[Refractory.name]
    if Jitter.name in sensor or not isinstance(scene, VideoScene) or measurement.trust is not None:
        return sensor
    assert isinstance(memory, Refractory)
    seen = HeldEvents.of(_events_at_their_frames(measurement, scene)[0], scene)
    drawn = thresholds_of_frames(seen, wait=round(memory.period / measurement.held + 0.5))
    if not drawn or not all(_are_drawn_anew(one, settings) for one in drawn.values()):
        return sensor
    spreads = [one.spread for one in drawn.values()]
    if max(spreads) > settings.unlike * min(spreads):
        return sensor
    return sensor.with_effect(Jitter(spread=float(np.mean(spreads))))


def _are_drawn_anew(found: DrawnThresholds, settings: ReadingSettings) -> bool:
    """Return whether thresholds are drawn at each event; of small spreads that need not be known."""
    if not settings.least_jitter <= found.spread <= settings.most_jitter:
        return False
    if math.isnan(found.own):
        return found.spread < settings.named_jitter
    return abs(found.own) <= settings.own


def with_jitter_of_events(
    found: Diagnosis, model: Sensor, *, noisy: bool = False, settings: ReadingSettings = READINGS
) -> Diagnosis:
    """Return a diagnosis in which a jitter is certain that its model had before the search.

    Behind a low-pass that was found light has not gone at an event as far as the frame says, and what looks
    drawn may be that: a small simulator that filters from frame to frame had had one of 51 % (sealed).

    Args:
        found: By the search.
        model: Has a jitter that was read off.
        noisy: Whether pixels at rest send noise that returns. Noise of the voltage adds to the way to a
            threshold what it is at each frame, so that either is possible.
        settings: From which size on it is a finding.
    """
    effect = model[Jitter.name]
    assert isinstance(effect, Jitter)
    spread = format_percent(effect.spread)
    if effect.spread < settings.named_jitter:
        note = f"thresholds that differ by {spread} from event to event are in the model, and no finding"
        return replace(found, notes=(*found.notes, note))
    half = settings.known * effect.spread
    mine = {"jitter.spread": Estimate(effect.spread, effect.spread - half, effect.spread + half)}
    sentence = (
        f"thresholds are drawn anew at each event, with a spread of {spread}: frames lie on either side"
    )
    said = _with_certain(found, effect, sentence, mine)
    slow = any(one.effect in (Bandwidth.name, SecondOrder.name) for one in found.findings)
    if not (noisy or slow):
        return said
    alternatives = (VoltageNoise.name,) if noisy else ()
    return replace(
        said,
        findings=tuple(
            replace(one, grade=Grade.EITHER, alternatives=alternatives, unknown=not noisy)
            if one.effect == Jitter.name
            else one
            for one in said.findings
        ),
    )


def _effects_of(
    delays: DelaysAfterFrames, settings: ReadingSettings, frames: int = 0
) -> list[tuple[Effect, str, dict[str, Estimate]]]:
    """Return the effects that delays show, each with a sentence and its parameters.

    Args:
        delays: Of events after frames.
        settings: From which sizes on they are findings.
        frames: By which events come later than that.
    """
    out: list[tuple[Effect, str, dict[str, Estimate]]] = []
    (late, slope), groups = delays.line(), delays.of_groups()
    if len(groups) < 3:
        return out  # by what groups of pixels differ is not known
    lines = np.array([one.line() for one in groups])
    errors = NINETY * lines.std(axis=0, ddof=1) / math.sqrt(len(groups))
    apart = _half_apart(delays, settings)
    near = settings.middle * delays.gap
    in_the_middle = abs(late - 0.5 * delays.gap) <= near and apart[0] <= near
    late += frames * delays.gap
    if late >= settings.latency and not in_the_middle:
        half = math.hypot(float(errors[0]), settings.known * late)
        sentence = f"events come {format_seconds(late)} after the frame that makes them, in bright light, too"
        mine = {"latency.delay": Estimate(late, late - half, late + half)}
        out.append((Latency(delay=late, light=0.0), sentence, mine))
    # a bin of few events is off by more
    even = settings.even * (1 + settings.few / math.sqrt(DELAYS.edges[0] * len(delays.late)))
    if apart[0] >= settings.jitter and apart.max() <= even * apart.min():
        jitter = float(apart.mean())
        each = np.array([_half_apart(one, settings).mean() for one in groups])
        half = math.hypot(NINETY * float(each.std(ddof=1)) / math.sqrt(len(groups)), settings.known * jitter)
        sentence = f"events of the same frame and the same way to go come {format_seconds(jitter)} apart"
        mine = {"timestamp.jitter": Estimate(jitter, jitter - half, jitter + half)}
        out.append((Timestamp(jitter=jitter, step=0.0), sentence, mine))
    if delays.come_in_parts():
        return out  # the way says in which part of a frame an event comes, however fast a pixel is
    cutoff = 1 / (2 * math.pi * max(slope, 1e-9))
    if cutoff <= settings.cutoff and delays.slope_in_errors() >= settings.errors:
        ends = [1 / (2 * math.pi * (slope + sign * float(errors[1]))) for sign in (1, -1)]
        sentence = "events come the later the more of its way a pixel has to go, and the darker it is"
        mine = {"bandwidth.cutoff": Estimate(cutoff, ends[0], ends[1])}
        out.append((Bandwidth(cutoff=cutoff), sentence, mine))
    vignetting = _vignetting_of(delays, groups, settings)
    return out if vignetting is None else [*out, vignetting]


def _vignetting_of(
    delays: DelaysAfterFrames, groups: Sequence[DelaysAfterFrames], settings: ReadingSettings
) -> tuple[Effect, str, dict[str, Estimate]] | None:
    """Return the vignetting by which pixels are slower in the corners, in light that is alike; None for none.

    However fast a low-pass is, and no finding by itself, it is slower where less light gets.

    Args:
        delays: Of all pixels.
        groups: Of groups of them, which differ by chance.
        settings: From which size on it is a finding.
    """
    if delays.slope_in_errors() < settings.errors:
        return None
    tangent = delays.tangent()
    each = np.array([one.tangent() for one in groups])
    error = float(each.std(ddof=1)) / math.sqrt(len(each))
    if tangent < settings.corner_errors * error:
        return None
    half = math.hypot(NINETY * error, settings.known_corner * tangent)
    loss, low, high = (1 - (1 + one) ** -2.0 for one in (tangent, max(tangent - half, 0.0), tangent + half))
    if loss < settings.loss:
        return None
    sentence = (
        f"where the clip is as bright, events come the later after a frame the farther from the middle: "
        f"{format_percent(loss)} of the light are lost in the corners"
    )
    return Vignetting(loss=loss), sentence, {"vignetting.loss": Estimate(loss, low, high)}


def _half_apart(delays: DelaysAfterFrames, settings: ReadingSettings, bins: int = 4) -> np.ndarray:
    """Return how far the early events of a bin of short ways lie before its median [s], shape (B,).

    Of latencies that are drawn about 0 half are 0, and the late ones tell how far apart they are.
    """
    _, late = delays.quantiles((0.16, 0.5, 0.84))
    early, later = np.diff(late[:bins]).T
    at_once = late[:bins, 0].max() < AT_ONCE
    # medians of bins with few events or some noise are some microseconds, not 0
    half: np.ndarray = later if at_once and early.max() < settings.about_zero * later.min() else early
    return half


def _with_certain(found: Diagnosis, effect: Effect, sentence: str, mine: Mapping[str, Estimate]) -> Diagnosis:
    """Return a diagnosis in which an effect is certain, of the size that was read off."""
    name = effect.name
    before = next((one for one in found.findings if one.effect == name), None)
    now = Finding(name, Grade.CERTAIN, seen=sentence, parameters=dict(mine))
    fitted = next((one for one in found.stand_ins if one.effect == name), None)
    if fitted is not None:
        # the fit of a model that leaves too much has another one: either may be something unknown
        stand_ins = tuple(one for one in found.stand_ins if one.effect != name)
        now = replace(now, grade=Grade.EITHER, unknown=True, error_with=fitted.error_with)
        return replace(found, findings=(*found.findings, now), stand_ins=stand_ins)
    if before is not None:
        now = replace(now, error_without=before.error_without, error_with=before.error_with)
    sensor, selected, errors = found.sensor, found.selected, found.errors
    if name in sensor:
        read = {key.partition(".")[2]: one.value for key, one in mine.items()}
        effect = replace(sensor[name], **read)
    else:
        selected, errors = (*selected, name), (*errors, errors[-1])
    others = (one for one in found.findings if one.effect != name)
    return replace(
        found,
        sensor=sensor.with_effect(effect),
        selected=selected,
        errors=errors,
        parameters={**found.parameters, **mine},
        findings=(*others, now),
        not_seen=tuple(one for one in found.not_seen if one.effect != name),
    )
