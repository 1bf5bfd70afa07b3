"""What the events of a measurement show by themselves, before any search: see `dase.signatures`.

No scene and no model is needed for it, so it holds where the scene is known badly: what is found here is
certain. What the scene itself does, such as light that flickers in a clip, is no effect of the camera.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from dase.diagnosis.busy_pixels import find_busy_pixels
from dase.diagnosis.doubles_of_jumps import find_doubles_at_small_jumps
from dase.diagnosis.frames_at_rest import events_where_frames_rest
from dase.diagnosis.late_doubles import find_late_doubles
from dase.diagnosis.led_pixels import follow_the_light
from dase.diagnosis.tone_of_light import is_tone_of_light
from dase.effects import EFFECTS, Effect
from dase.effects.high_pass import HighPass
from dase.effects.latency import Latency
from dase.effects.made_signatures import makers_of, told_by
from dase.effects.readout import BUSY, Readout
from dase.effects.threshold import Threshold
from dase.errors import InputError
from dase.events import Events
from dase.fitting.burst_strength import BurstStrength, burst_times_of, fit_bursts
from dase.fitting.frame_steps import clip_step_of, frame_step_of, is_held, is_in_step, ticks_are_of_frames
from dase.fitting.measurement import Measurement
from dase.fitting.time_window import is_constant
from dase.results import DetectionLimit, Diagnosis, Estimate, Finding, Grade
from dase.scenes.between_frames import CameraScene
from dase.scenes.scene import Scene
from dase.scenes.video import VideoScene
from dase.signatures.burst_times import BurstTimes
from dase.signatures.find import find_signatures
from dase.signatures.flicker import FlickerSettings
from dase.signatures.frame_coupling import BurstClock
from dase.signatures.kinds import (
    DOUBLE_EVENTS,
    FIXED_PATTERN,
    FLICKER,
    FRAME_COUPLING,
    FULL_BUS,
    HOT_PIXELS,
    KINDS,
    LATE_EVENTS,
    NOISE_AT_REST,
    OPPOSITE_PAIRS,
    TIME_STAMPS,
    UNEQUAL_THRESHOLDS,
)
from dase.signatures.result import Answer, Signature, Signatures
from dase.simulation.sensor import Sensor
from dase.simulation.simulate import simulate

SHARPER = (1.0, 0.5, 0.25)
"""Thresholds of the model of which it is asked what light does, relative to those of the model before the
search. What that lacks may have made them too high to see a lamp in the clip: at 0.3 it missed 4 of 34."""

WEAK_TONE = 0.1
"""Swing of the rate below which a tone may be what bursts leave beside them; lamps swung it by 0.19 and more
in 18 of 20 clips of other simulators in which one was seen."""

LATE_STAMPS = 2e-4
"""Time from tick to tick of a clock, or from line to the same line of a scan, above which events are stamped
late [s]: thresholds that light crosses before a scan of 1.2 ms comes by fall together, and steps look the
larger the fewer are left (sealed)."""

TICKS_LATE = 1.5
"""Ticks of the clock up to which events that are late may wait for one."""

FRAMES_STAMPED = 0.5
"""Share of the frames of a clip at whose times packets are, from which on these are the frames."""

ROUNDED_APART = 0.3
"""Resultant of the phases within a tick at which frames lie, below which stamps at its multiples are of a
clock: 1 of a simulator whose stamps are as late after each, 0 of frames that know nothing of the clock."""

SLOWEST_CLOCK = 1.5e-3
"""Ticks above which a readout of all pixels at once is as likely [s]: 1 ms is the slowest plausible clock."""

MAKERS = 2
"""Effects that are known to make what is seen, up to which they are said: either this or that one."""

ABOVE_CEILING = 4.0
"""Times a ceiling of the rate of events at which a bus must have nothing to do for it to be no bus's."""

FORGETS = (5.0, 20.0)
"""How fast the memories forget [Hz] of the models of which it is asked whether a pattern is the scene's.
Light that rises falls again, but a pixel that forgets sends fewer events where it does so slowly. Over
the blades of a fan that is the same in each turn: a simulator whose pixels forget at every frame had a
pattern of 15 %, where this had one of 10 %."""


@dataclass(frozen=True)
class SeenEffects:
    """What the events show by themselves.

    Args:
        entries: The signatures that are there and not of the scene.
        bursts: When the whole array sends in step with the frames, which no model explains; None for never.
        absent: Signatures that would have been there, and are not.
        library: Effects that may be named, name to class.
    """

    entries: tuple[Signature, ...] = ()
    bursts: BurstClock | None = None
    absent: tuple[Signature, ...] = ()
    library: Mapping[str, type[Effect]] = field(default_factory=lambda: EFFECTS)

    @property
    def lamp(self) -> float | None:
        """Frequency of light that flickers [Hz]; None where there is none."""
        entry = self.entry_of(FLICKER)
        return float(entry.details["frequency"]) if entry else None

    @property
    def full_bus(self) -> bool:
        """Whether events wait for a bus, or are lost there: light between them tells of another time."""
        return self.entry_of(FULL_BUS) is not None

    @property
    def stamped_late(self) -> bool:
        """Whether a scan, a slow clock or packets stamp events, so that light goes on before they do."""
        entry = self.entry_of(TIME_STAMPS)
        waits = () if entry is None else (entry.details.get(name, 0.0) for name in ("step", "period"))
        return max(map(float, waits), default=0.0) > LATE_STAMPS

    @property
    def of_no_effect(self) -> bool:
        """Whether something is seen that an effect of dase makes and none of the library, if these say so."""
        if any(effect.signatures is None for effect in self.library.values()):
            return False  # a user's effect may make it
        return any(told_by(one, EFFECTS) and not told_by(one, self.library) for one in self.entries)

    @property
    def effects(self) -> dict[str, str]:
        """Effects of the library that are certain, each to what shows it."""
        return {name: entry.sentence for entry in self.entries for name in self.identified_by(entry)}

    @property
    def shown_whatever_fits(self) -> frozenset[str]:
        """Effects of the library that are certain however badly a model fits."""
        entries = (entry for entry in self.entries if KINDS[entry.name].whatever_fits)
        return frozenset(name for entry in entries for name in self.identified_by(entry))

    def without(self, name: str) -> SeenEffects:
        """Return what is seen without the signature of a name."""
        return replace(self, entries=tuple(one for one in self.entries if one.name != name))

    def with_doubt(self, name: str) -> SeenEffects:
        """Return what is seen, with what the signature of a name tells either that or something unknown."""
        entries = (
            replace(one, details={**one.details, "doubtful": True}) if one.name == name else one
            for one in self.entries
        )
        return replace(self, entries=tuple(entries))

    def without_ceiling_of_light(self, sensor: Sensor) -> SeenEffects:
        """Return what is seen without a ceiling of the rate at which the bus that fits has nothing to do.

        Things that move evenly send evenly, too: a fan's blades did, at a 25th of the rate of a bus that was
        fitted beside them.

        Args:
            sensor: The last model.
        """
        entry = self.entry_of(FULL_BUS)
        bus = next((one for one in sensor.effects if isinstance(one, Readout)), None)
        ceiling = entry.details.get("rate", 0.0) if entry is not None else 0.0
        if bus is None or not ceiling:
            return self
        taken = (bus.line if bus.by_lines else 0.0) + 1 / bus.rate
        if ABOVE_CEILING * ceiling * taken >= BUSY:
            return self
        return replace(self, entries=tuple(one for one in self.entries if one is not entry))

    def times_of_bursts(self, measurement: Measurement) -> BurstTimes | None:
        """Return when the bursts of a measurement come; None where there are none at even times."""
        entry = self.entry_of(FRAME_COUPLING)
        return burst_times_of(measurement, entry) if entry else None

    def may_name(self, name: str) -> bool:
        """Whether a signature may name effects: any that does not say what it makes may make it as well."""
        unsaid = any(effect.signatures is None for effect in self.library.values())
        return not (KINDS[name].beside_model and unsaid)

    def named_by(self, entry: Signature) -> tuple[str, ...]:
        """Return the effects of the library that a signature names; there may be none, or several."""
        return told_by(entry, self.library) if self.may_name(entry.name) else ()

    def identified_by(self, entry: Signature) -> tuple[str, ...]:
        """Return the effect of the library that a signature names, if it is the only one; else nothing."""
        named = self.named_by(entry)
        return named if len(named) == 1 else ()

    @property
    def _known(self) -> dict[str, type[Effect]]:
        """The library and the effects of dase, which a sensor may have, too."""
        return {**EFFECTS, **self.library}

    def findings(self, graded: Collection[Finding], given: Collection[str]) -> list[Finding]:
        """Return findings in which all that is seen is certain.

        Args:
            graded: What the search says of each effect of the last model.
            given: Effects that the sensor had before.
        """
        if any(self._is_late_by_a_tick(one) for one in self.entries):
            kept = tuple(one for one in self.entries if not self._is_late_by_a_tick(one))
            return replace(self, entries=kept).findings(graded, given)
        seen = self.effects
        out = []
        two_poles = self._two_poles_for_pole_and_delay(graded)
        for one in graded:
            if one.effect in self._noise and (one.grade is Grade.STAND_IN or one.effect in self._doubtful):
                # noise that comes so is there, but the model with it is another's, or no light makes it so
                one = replace(one, grade=Grade.EITHER, unknown=True, seen=seen[one.effect])
            elif one.grade is Grade.SUPPORTED and self._is_in_doubt(one):
                one = replace(one, grade=Grade.EITHER, unknown=True)
            elif one.effect in two_poles:
                one = replace(
                    one, grade=Grade.EITHER, alternatives=two_poles[one.effect], seen=seen[one.effect]
                )
            elif one.effect in self._doubtful:
                one = replace(one, grade=Grade.EITHER, unknown=True, seen=seen[one.effect])
            elif one.effect in seen:
                one = Finding(
                    one.effect, Grade.CERTAIN, (), False, one.error_without, one.error_with, one.deviation,
                    one.parameters, seen[one.effect],
                )  # fmt: skip
            out.append(one)
        named = {one.effect for one in out if one.grade in (Grade.CERTAIN, Grade.SUPPORTED)}
        unsaid = {name for name in named if name in self.library and self.library[name].signatures is None}
        for entry in self.entries:
            makers = set(makers_of(entry.name, self._known))
            if entry.name == LATE_EVENTS:  # that one way is named says nothing of another
                makers = set(self.named_by(entry))
            if makers & named or makers & set(given):
                continue
            if KINDS[entry.name].beside_model and unsaid:
                continue  # one of the user's own, which was found, may make it
            if entry.name == OPPOSITE_PAIRS and self.entry_of(NOISE_AT_REST):
                continue  # they are said with the noise that sends them
            if entry.name == FIXED_PATTERN and self._names(UNEQUAL_THRESHOLDS):
                continue  # which it is, is known
            if entry.name == NOISE_AT_REST or len(self.named_by(entry)) > 1:
                out = self._with_either(entry, out)
                continue
            named_here = self.named_by(entry)
            if not named_here:
                out = self._with_few_makers(entry, out)
            for name in named_here or (entry.name,):
                others = two_poles.get(name, ())
                doubtful = bool(entry.details.get("doubtful", False))
                grade = Grade.EITHER if others or doubtful else Grade.CERTAIN
                out = [one for one in out if one.effect != name]
                out.append(Finding(name, grade, others, doubtful and not others, seen=entry.sentence))
        return [self._or_read_at_once(one) for one in out]

    def _or_read_at_once(self, one: Finding) -> Finding:
        """Return a finding; of a clock that ticks too slowly for one *either that or a scan*.

        A readout that looks at all pixels at once, from time to time, has the same stamps.
        """
        entry = self.entry_of(TIME_STAMPS)
        step = entry.details.get("step", 0.0) if entry is not None and "packets" not in entry.details else 0.0
        if entry is None or one.grade is not Grade.CERTAIN or one.effect not in self.named_by(entry):
            return one
        scans = tuple(name for name, it in makers_of(TIME_STAMPS, self.library).items() if it.by == "line")
        if step <= SLOWEST_CLOCK or one.effect in scans or not scans:
            return one
        return replace(one, grade=Grade.EITHER, alternatives=scans)

    def _is_in_doubt(self, one: Finding) -> bool:
        """Whether events one by one tell of another effect, or that something else makes them late."""
        return one.effect in self._contradicted or self._waits_for_ticks(one)

    def _waits_for_ticks(self, one: Finding) -> bool:
        """Whether a latency is no longer than what an event may wait for a tick or a packet of the clock."""
        delay = one.parameters.get(f"{Latency.name}.delay")
        return delay is not None and delay.value <= self._longest_wait

    def _is_late_by_a_tick(self, entry: Signature) -> bool:
        """Whether events are late by no more than that."""
        return entry.name == LATE_EVENTS and 0 < entry.details.get("delay", 0.0) <= self._longest_wait

    @property
    def _longest_wait(self) -> float:
        """Time that events may wait for the clock [s], below 0 where stamps follow none.

        A clock that rounds up is late by a tick beside one that rounds down.
        """
        entry = self.entry_of(TIME_STAMPS)
        tick = entry.details.get("step", 0.0) if entry is not None else 0.0
        return TICKS_LATE * float(tick) if tick else -1.0

    def _two_poles_for_pole_and_delay(self, graded: Collection[Finding]) -> dict[str, tuple[str, ...]]:
        """Return the effects that make a pole and a delay, each to that of two poles that a fit has beside.

        Two slow poles, of 9 and 20 Hz, had looked like one of 14 Hz and a delay of 5.8 ms.

        Args:
            graded: What the search says of each effect of the last model.
        """
        kinds = makers_of(LATE_EVENTS, self._known)
        seen = [name for one in self.entries if one.name == LATE_EVENTS for name in self.identified_by(one)]
        fitted = tuple(
            one.effect for one in graded
            if one.effect in kinds and kinds[one.effect].by == "poles" and one.grade is not Grade.STAND_IN
        )  # fmt: skip
        told = {kinds[name].by for name in seen if name in kinds}
        return dict.fromkeys(seen, fitted) if fitted and told == {"pole", "delay"} else {}

    def _with_few_makers(self, entry: Signature, findings: list[Finding]) -> list[Finding]:
        """Return findings with one of the few effects known to make what is seen, or what is not known.

        Args:
            entry: What is seen, which names no effect.
            findings: In which none that makes it is announced.
        """
        makers = tuple(makers_of(entry.name, self._known))
        offered = {name for one in findings for name in one.alternatives if one.grade is Grade.EITHER}
        offered |= {one.effect for one in findings if one.grade is Grade.EITHER}
        if len(makers) > MAKERS or not set(makers) <= set(self.library) or set(makers) & offered:
            return findings
        return self._with_either(entry, findings, unknown=True)

    def _names(self, name: str) -> bool:
        """Whether a signature was seen and names effects of the library."""
        entry = self.entry_of(name)
        return entry is not None and bool(self.named_by(entry))

    @property
    def _noise(self) -> frozenset[str]:
        """The effect of the library that makes the noise of pixels at rest, where that is certain."""
        entries = (entry for entry in self.entries if entry.name == NOISE_AT_REST)
        return frozenset(name for entry in entries for name in self.identified_by(entry))

    @property
    def _doubtful(self) -> frozenset[str]:
        """Effects of the library of which something is seen that speaks against each of them."""
        entries = (entry for entry in self.entries if entry.details.get("doubtful", False))
        return frozenset(name for entry in entries for name in self.identified_by(entry))

    @property
    def _contradicted(self) -> frozenset[str]:
        """Noise and delays of which events one by one tell other ones; effects that would have been seen."""
        out = set[str]()
        for entry in self.entries:
            if entry.name in (NOISE_AT_REST, LATE_EVENTS) and told_by(entry, self._known):
                makers = makers_of(entry.name, self._known).items()
                out |= {name for name, one in makers if one.by and not one.is_told_by(entry)}
        for entry in self.absent:
            if KINDS[entry.name].denies:
                makers = makers_of(entry.name, self._known).items()
                out |= {name for name, one in makers if one.is_denied_by_absence}
        # a pole is seen beside a latency
        return frozenset(out) - set(self.effects)

    def _with_either(
        self, entry: Signature, findings: Sequence[Finding], *, unknown: bool = False
    ) -> list[Finding]:
        """Return findings with one of several effects that is there, and that the search has not announced.

        Args:
            entry: What shows it.
            findings: In which none of them is announced.
            unknown: Whether it may be none of them.
        """
        # where it tells of some, others do not make it so, even if those are not in the library
        told = told_by(entry, self._known) or makers_of(entry.name, self.library)
        kinds = [name for name in told if name in self.library]
        if not kinds:
            return [*findings, Finding(entry.name, Grade.CERTAIN, seen=entry.sentence)]
        nearest = next((one for one in findings if one.effect in kinds), Finding(kinds[0], Grade.EITHER))
        others = tuple(name for name in kinds if name != nearest.effect)
        said = replace(
            nearest,
            grade=Grade.EITHER,
            alternatives=others,
            unknown=unknown or not others,
            seen=entry.sentence,
        )
        return [*(one for one in findings if one.effect not in kinds), said]

    def entry_of(self, name: str) -> Signature | None:
        """Return the signature of a name; None where it was not seen."""
        return next((entry for entry in self.entries if entry.name == name), None)

    def limits(self, named: Collection[str]) -> tuple[DetectionLimit, ...]:
        """Return what the events alone would have shown of effects; of none of those that are named."""
        return tuple(
            DetectionLimit(name, "", None, "", True, f"{entry.name}: {entry.sentence}")
            for entry in self.absent
            for name, one in makers_of(entry.name, self.library).items()
            if one.is_denied_by_absence and name not in named
        )


def find_seen_effects(measurement: Measurement, library: Mapping[str, type[Effect]]) -> SeenEffects:
    """Return what the events of a measurement show by themselves.

    Args:
        measurement: Its events are looked at.
        library: Effects that may be named, name to class.
    """
    events, scene = measurement.compared_events(), measurement.scene
    begins = scene.begin if isinstance(scene, CameraScene) else None
    try:
        found = find_signatures(events, begins=begins)
    except InputError:
        return SeenEffects(library=library)
    step, clip_step = frame_step_of(events, scene), clip_step_of(scene)
    entries = tuple(
        slowest_image(entry, step or 0.0) for entry in found.found
        if not _is_of_frames(entry, step or 0.0, events, scene) and not _is_tone_of_clip(entry, clip_step)
        and not _are_led(entry, events, scene)
    )  # fmt: skip
    coupling = [entry for entry in entries if entry.name == FRAME_COUPLING]
    bursts = None
    if coupling:
        interval = coupling[0].details["interval"]
        entries = tuple(one for one in entries if not is_beat_of_bursts(one, interval, clip_step))
        bursts = BurstClock.of(coupling[0].details)
        if begins is None:
            bursts = bursts.extend(float(events.t[-1]))
    absent = tuple(entry for entry in found.entries if entry.answer is Answer.NOT_SEEN)
    seen = SeenEffects(entries, bursts, absent, library)
    # beside pixels whose events are left out others look busy
    return seen if measurement.trust is not None else _with_busy_pixels(seen, events, scene, found)


def _with_busy_pixels(seen: SeenEffects, events: Events, scene: Scene, found: Signatures) -> SeenEffects:
    """Return what is seen, with hot pixels that their light tells where events alone do not.

    A lamp and bursts make pixels send that the scene does not know of, and noise of low thresholds looks
    alike. Between a camera's frames light is a guess.

    Args:
        seen: By events alone.
        events: Of the measurement.
        scene: What the camera saw.
        found: All signatures, those that are of the scene among them.
    """
    known = {entry.name for entry in found.found}
    if known & {HOT_PIXELS, FLICKER, FRAME_COUPLING, OPPOSITE_PAIRS}:
        return seen
    if isinstance(scene, CameraScene) or is_constant(scene):
        return seen
    busy = find_busy_pixels(events, scene)
    if not busy.found:
        return seen
    absent = tuple(one for one in seen.absent if one.name != HOT_PIXELS)
    return replace(seen, entries=(*seen.entries, busy), absent=absent)


def _is_of_frames(entry: Signature, step: float, events: Events, scene: Scene) -> bool:
    """Return whether ticks or bursts of events in step with frames, every `step` [s], are made by these.

    Of frames that are held all events come so long after one. Where all events come in step with frames, all
    are in bursts: a simulator that knows these frames alone sends no others.
    """
    if entry.name == TIME_STAMPS and is_held(scene):
        return not _are_rounded(entry.details.get("step", 0.0), events, scene)
    if entry.name == FRAME_COUPLING:
        return step > 0 and is_in_step(1 / entry.details["interval"], step)
    if "packets" in entry.details:
        return times_that_are_stamps(events, scene) > FRAMES_STAMPED
    said = entry.details if entry.name == TIME_STAMPS and "line" not in entry.details else {}
    period, gap = said.get("period", 0.0), clip_step_of(scene)
    if period and gap and is_in_step(1 / period, gap):
        return True  # of noise that is drawn once a frame, or of pixels that send some time after each
    tick = said.get("step", period)
    return ticks_are_of_frames(tick, step, events, scene)


def _are_rounded(tick: float, events: Events, scene: Scene) -> bool:
    """Return whether stamps of held frames come at all times within a tick [s] about these: by a clock.

    Those of a simulator come as long after each frame as after any other.
    """
    times = scene.frame_times() if isinstance(scene, VideoScene) else scene.sample_times()
    if not tick:
        return False
    stamps = np.unique(events.t)
    stamps = stamps[(stamps > times[0]) & (stamps < times[-1])]
    after = np.searchsorted(times, stamps + 0.5 * tick, side="right") - 1
    late = (stamps - times[after]) / tick
    together = float(np.abs(np.exp(2j * np.pi * late).mean())) if len(late) else 1.0
    return together < ROUNDED_APART


def times_that_are_stamps(events: Events, scene: Scene) -> float:
    """Return the share of the instants of a scene at which there are events, to 2 us."""
    times = scene.sample_times()
    times = times[(times >= events.t[0]) & (times <= events.t[-1])]
    if not len(times):
        return 0.0
    after = np.minimum(np.searchsorted(events.t, times - 2e-6), len(events) - 1)
    return float(np.mean(events.t[after] <= times + 2e-6))


def _are_led(entry: Signature, events: Events, scene: Scene) -> bool:
    """Return whether hot pixels send with their light; between a camera's frames that is a guess."""
    if entry.name != HOT_PIXELS or isinstance(scene, CameraScene):
        return False
    return follow_the_light(entry, events, scene)


def is_beat_of_bursts(entry: Signature, interval: float, step: float) -> bool:
    """Return whether light flickers weakly in step with two or three bursts of frames, in a clip.

    A simulator makes bursts at the frames of its clip that are next, every `step` [s]. Where two or three of
    their intervals are as long as whole frames are, that is the same again as often, and what is left of it
    beside the bursts is a tone: one of 50 Hz with bursts at 30 Hz in a clip of DVS-Voltmeter at 500 Hz.

    Args:
        entry: Any signature.
        interval: From burst to burst [s].
        step: From frame to frame of the clip [s]; 0 for another scene.
    """
    if entry.name != FLICKER or step <= 0 or entry.size >= WEAK_TONE:
        return False
    as_long = [turns * interval for turns in (2, 3) if is_in_step(1 / step, turns * interval, near=0.1)]
    return any(is_in_step(entry.details["frequency"], time, near=0.05) for time in as_long)


def _is_tone_of_clip(entry: Signature, step: float) -> bool:
    """Return whether light flickers as often as the frames of a clip come, every `step` [s], or in overtones.

    Light that changes its way at each frame does so, and what a simulator makes of it.
    """
    return entry.name == FLICKER and step > 0 and is_in_step(entry.details["frequency"], step)


def slowest_image(entry: Signature, step: float) -> Signature:
    """Return flicker at the slowest frequency that looks alike where events come in step with frames.

    Who knows light at frames alone cannot tell a tone from its sum and difference with their rate, and what
    is sent at frames may show any of them most: of a lamp of 100 Hz in a clip of 500 Hz that of 400 Hz. No
    lamp is as slow as what 120 Hz looks like at frames of 100 Hz.

    Args:
        entry: Any signature; others stay as they are.
        step: Time from frame to frame in step with which all events come [s]; 0 if they do not.
    """
    fast = entry.details["frequency"] if entry.name == FLICKER else 0.0
    if fast * step <= 0.5:
        return entry
    slow = abs(fast - round(fast * step) / step)
    if slow < FlickerSettings.slowest_lamp:
        return entry
    half = 0.5 * (entry.details["frequency_high"] - entry.details["frequency_low"])
    details = {"frequency": slow, "frequency_low": slow - half, "frequency_high": slow + half}
    said = entry.sentence.replace(f"{fast:.2f} Hz", f"{slow:.2f} Hz")
    return replace(entry, sentence=said, details={**entry.details, **details})


def without_the_scene(
    seen: SeenEffects, measurement: Measurement, sensor: Sensor, seed: int, *, in_step: bool = False
) -> SeenEffects:
    """Return what is seen and not of the scene: a sensor that has no such effect would show that, too.

    Args:
        seen: In the events of the measurement.
        measurement: Its scene is simulated.
        sensor: The model before the search.
        seed: Of its random numbers.
        in_step: Whether events come in step with the frames of a clip.
    """
    scene = measurement.scene
    if isinstance(scene, CameraScene):
        seen = replace(
            seen, entries=tuple(one for one in seen.entries if _is_at_rest(one, measurement, scene))
        )
    if is_held(scene) or (isinstance(scene, VideoScene) and seen.entry_of(DOUBLE_EVENTS) is not None):
        # a simulator that is late does not show that it has held a clip, nor one that holds parts of a frame
        doubles = find_doubles_at_small_jumps(measurement.compared_events(), scene, sensor)
        seen = _with_doubles(seen, doubles)
    if isinstance(scene, VideoScene) and seen.entry_of(DOUBLE_EVENTS) is None:
        late = find_late_doubles(measurement.compared_events(), scene)
        seen = _with_doubles(seen, late) if late.found else seen
    if isinstance(scene, VideoScene):
        of_light = [
            one for one in seen.entries
            if one.name == FLICKER
            and is_tone_of_light(one, measurement, log_eps=sensor.log_eps, in_step=in_step)
        ]  # fmt: skip
        seen = replace(seen, entries=tuple(one for one in seen.entries if one not in of_light))
    asked = _asked_of_scene(seen.entries, scene)
    if not asked:
        return seen
    kept = seen.entries
    for sharper in SHARPER:
        more = asked if sharper == 1 else [entry for entry in asked if KINDS[entry.name].of_light]
        if any(entry in kept for entry in more):
            made = _signatures_of(scene, _with_thresholds(sensor, sharper), seed)
            kept = tuple(entry for entry in kept if entry not in more or not shows_in(made, entry))
    patterns = [entry for entry in kept if entry.name == FIXED_PATTERN]
    for cutoff in FORGETS if patterns else ():
        made = _signatures_of(scene, sensor.with_effect(HighPass(cutoff=cutoff, at="memory")), seed)
        kept = tuple(entry for entry in kept if entry not in patterns or not shows_in(made, entry))
    coupled = any(entry.name == FRAME_COUPLING for entry in kept)
    return replace(seen, entries=kept, bursts=seen.bursts if coupled else None)


def _with_doubles(seen: SeenEffects, found: Signature) -> SeenEffects:
    """Return what is seen, with what is `found` of double events in place of what was."""
    entries = (*seen.without(DOUBLE_EVENTS).entries, *([found] if found.found else []))
    absent = tuple(one for one in seen.absent if one.name != DOUBLE_EVENTS or not found.found)
    return replace(seen, entries=entries, absent=absent)


def part_to_simulate(measurement: Measurement, when: NDArray[np.float64]) -> Measurement:
    """Return a measurement whose scene, if it is between a camera's frames, lasts as long as is compared.

    Of such a scene only patterns of the pixels are asked, which show in any part of the time; to simulate all
    pixels over minutes would take longer than the search.

    Args:
        measurement: All of it.
        when: Times that are compared [s], increasing, shape (T,).
    """
    scene = measurement.scene
    if not isinstance(scene, CameraScene):
        return measurement
    return replace(measurement, scene=scene.within(float(when[0]), float(when[-1])))


def without_the_explained(
    seen: SeenEffects, measurement: Measurement, sensor: Sensor, seed: int, *, before: Sensor
) -> SeenEffects:
    """Return what is seen less what tells no single effect and is there with the last model, too.

    Args:
        seen: In the events of the measurement.
        measurement: Its scene is simulated.
        sensor: The model after the search.
        seed: Of its random numbers.
        before: The model before the search, which shows none of it.
    """
    gained = [type(effect) for effect in sensor.effects if effect.name not in before]
    if all(_changes_light(effect) for effect in gained):
        return seen  # what comes with the light is the same for all pixels
    # what a model was asked for already, signatures of its events do not show
    open_ = [one for one in seen.entries if not seen.named_by(one) and not KINDS[one.name].beside_model]
    open_ = _asked_of_scene(open_, measurement.scene)
    if not open_:
        return seen
    made = _signatures_of(measurement.scene, sensor, seed)
    kept = tuple(entry for entry in seen.entries if entry not in open_ or not shows_in(made, entry))
    return replace(seen, entries=kept)


def strength_of_bursts(
    seen: SeenEffects,
    measurement: Measurement,
    sensor: Sensor,
    library: Mapping[str, type[Effect]],
    begin: Effect | None = None,
    *,
    pixels: int,
    plenty: float,
    seed: int,
    device: str,
) -> BurstStrength | None:
    """Return the effect that makes the bursts; None where there are none, or they do not tell its strength.

    Args:
        seen: In the events.
        measurement: With the bursts.
        sensor: Without the effect.
        library: Effects, name to class.
        begin: The effect as it was fitted beside another model; None before the first fit.
        pixels: In each part of the measurement.
        plenty: Events about the bursts from which on a longer time is not looked at.
        seed: Of every random number.
        device: Where kernels run.
    """
    entry, times = seen.entry_of(FRAME_COUPLING), seen.times_of_bursts(measurement)
    if seen.bursts is None or entry is None or times is None:
        return None
    for name in seen.identified_by(entry):
        if name in library and name not in sensor:
            return fit_bursts(
                measurement, sensor, library[name], times, begin,
                pixels=pixels, plenty=plenty, seed=seed, device=device,
            )  # fmt: skip
    return None


def with_effect_of_bursts(found: Diagnosis, strength: BurstStrength) -> Diagnosis:
    """Return a diagnosis, made without the bursts, with the effect that makes them."""
    name = strength.effect.name
    findings = tuple(
        replace(
            one, error_without=strength.error_without, error_with=strength.error_with,
            parameters=strength.parameters,
        )
        if one.effect == name
        else one
        for one in found.findings
    )  # fmt: skip
    return replace(
        found,
        sensor=found.sensor.with_effect(strength.effect),
        selected=(*found.selected, name),
        errors=(*found.errors, found.errors[-1]),
        parameters={**found.parameters, **strength.parameters},
        findings=findings,
    )


def with_size_that_was_seen(diagnosis: Diagnosis, found: Signature, parameter: str) -> Diagnosis:
    """Return a diagnosis with the size of a signature, see `with_estimate_that_was_seen`."""
    return with_estimate_that_was_seen(diagnosis, Estimate(found.size, found.low, found.high), parameter)


def with_estimate_that_was_seen(diagnosis: Diagnosis, seen: Estimate, parameter: str) -> Diagnosis:
    """Return a diagnosis in which a parameter has the value that was seen, where no fit gave one.

    Args:
        diagnosis: By the fits alone.
        seen: By the events.
        parameter: With its effect, `effect.name`.
    """
    if parameter in diagnosis.parameters:
        return diagnosis
    effect = parameter.partition(".")[0]
    mine: Mapping[str, Estimate] = {parameter: seen}
    return replace(
        diagnosis,
        parameters={**diagnosis.parameters, **mine},
        findings=tuple(
            replace(one, parameters=mine) if one.effect == effect and not one.parameters else one
            for one in diagnosis.findings
        ),
    )


def _changes_light(effect: type[Effect]) -> bool:
    """Whether an effect makes what light makes by itself."""
    return any(KINDS[one.signature].of_light for one in effect.signatures or ())


def _asked_of_scene(entries: Collection[Signature], scene: Scene) -> list[Signature]:
    """Return the signatures of which a simulation of the scene tells whether they are the scene's.

    Between a camera's frames light is a guess in time: it tells nothing of lamps, pairs or stamps. But a
    pattern is of the pixels: a sensor that makes one makes it whatever light does.
    """
    if not isinstance(scene, CameraScene):
        return list(entries)
    return [entry for entry in entries if entry.name == FIXED_PATTERN]


def _is_at_rest(entry: Signature, measurement: Measurement, scene: CameraScene) -> bool:
    """Return whether a signature of pixels at rest is there where a camera's frames rest; others are."""
    if entry.name != OPPOSITE_PAIRS:
        return True
    resting = events_where_frames_rest(measurement.compared_events(), scene)
    return len(resting) > 0 and find_signatures(resting)[OPPOSITE_PAIRS].found


def _with_thresholds(sensor: Sensor, times: float) -> Sensor:
    """Return a sensor whose thresholds are some times as high, but not below the least that there are."""
    now = sensor["threshold"]
    assert isinstance(now, Threshold)
    least = {p.name: p.bounds[0] for p in now.parameters()}
    return sensor.with_effect(
        replace(now, on=max(times * now.on, least["on"]), off=max(times * now.off, least["off"]))
    )


def _signatures_of(scene: Scene, sensor: Sensor, seed: int) -> tuple[Signature, ...]:
    """Return the signatures of the events of a sensor."""
    made = simulate(scene, sensor, seed=seed)
    return find_signatures(made).entries if len(made) else ()


def shows_in(made: Collection[Signature], seen: Signature, share: float = 0.3) -> bool:
    """Whether what is seen shows in simulated events as well, if only by a hint.

    What is not beyond all doubt there is enough to doubt that it is the camera's, if it is not far smaller:
    many events of a model whose thresholds are too low hint at everything.

    Args:
        made: Signatures of simulated events.
        seen: In the measurement.
        share: Of the size seen that must show.
    """
    for entry in made:
        if entry.name != seen.name or not (entry.found or (entry.size >= entry.least and entry.p < 0.05)):
            continue
        other = entry.details.get("frequency", 0.0) if seen.name == FLICKER else 0.0
        if other and abs(other / seen.details["frequency"] - 1) > 0.02:
            continue
        return not entry.size < share * seen.size  # sizes may be unknown
    return False
