"""Whether a simulator held the frames of a clip, each from the time of the one before on.

A simulator that is given a frame and the time since the last one shows the frame for that time: light
jumps, and it does so a frame before the time that is written beside the frame. Its events then come up to a
frame before the light changes, which no pixel can do, and no effect explains; or all at the same time after a
frame, which light that goes straight from frame to frame does not make. Held light does: events begin at once
with the jump, and behind a low-pass thin out until the next one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dase.events import Events
from dase.fitting.delays_after_frames import delays_after_frames
from dase.fitting.held_events import HeldEvents
from dase.fitting.thresholds_of_frames import spread_of_thresholds, thresholds_of_frames
from dase.probes.stimulus import light_of
from dase.scenes.scene import LOG_EPS, Scene
from dase.scenes.video import VideoScene


@dataclass(frozen=True)
class HeldClipSettings:
    """When a clip is held.

    Chosen on sets a to c, x, y, z, k and g to j of other simulators: of IEBCS 0.92 to 1.00 of the events come
    in 0.06 of a frame, of all others 0.70 at most but for those that stamp events by the frame they tell of.
    """

    events: int = 100_000
    """Events that are looked at, at most, evenly spread."""

    least: int = 2_000
    """Events below which nothing is said."""

    parts: int = 50
    """Of the time from frame to frame."""

    near: int = 3
    """Such parts beside each other in which events come alike."""

    together: float = 0.85
    """Share of the events in these, at least, where light is seen at once."""

    apart: int = 15
    """Such parts beside each other that hold nearly all events of a clip whose light goes farther after the
    frame than before it, at most: of four clips of IEBCS with latencies of 0.2 to 0.7 ms and stamps off by
    0.06 ms 7 to 14, of a clip that goes straight none."""

    nearly: float = 0.985
    """Share of the events in these, at least."""

    begun: float = 0.3
    """Share of the events in these, at least, where a low-pass or noise spreads the others."""

    sudden: float = 0.1
    """Events of as many parts before these, at most, relative to them, where events are spread."""

    filled: float = 0.5
    """Share of the parts that then have events: of a clock's ticks few have."""

    shares: int = 12
    """Into how many parts of a frame, at most, a simulator that knows frames alone puts the events of one,
    evenly; it is not early."""

    spread_out: float = 0.5
    """Share of the events at such parts, to the microsecond, from which on it is one of these: clips of v2e
    in which most pixels send the first of four or five events had 0.9 and more."""

    clear: float = 0.08
    """Times after a frame, relative to that to the next, from which on such parts are told from others."""

    at_parts: float = 0.3
    """Share of those events at such parts from which on nothing is held, where events are spread: 0.56 to
    0.73 in clips of v2e with a dead time, which send the first of many; 0.01 and 0.04 of IEBCS."""

    many: int = 22
    """Such parts, at most, where all events come soon after a frame: the first of many after a dead time."""

    past: float = 0.045
    """Times after a frame, relative to that to the next, from which on so many are told from others."""

    all_at_parts: float = 0.8
    """Share of those events at such parts from which on nothing is held, where all come soon after a frame:
    chance has 0.4 of them there."""

    quarter: int = 12
    """Such parts beside each other that are denser than others behind a low-pass, or where stamps are off."""

    dense: float = 0.4
    """Share of the events in these, at least."""

    width: float = 0.25
    """Share of the time from frame to frame in which most events with a short way come, at most: three clips
    of IEBCS had 0.13 to 0.2, clips whose light goes straight 0.28 and more."""

    later: float = 5.0
    """Standard errors by which events come the later the longer the way, at least: 8 to 38 in those clips,
    -2 to 1 where a readout scans rows from frame to frame."""

    apart_at_most: float = 0.5
    """What thresholds of such frames differ by, relative, at most: 0.28 in a clip of IEBCS behind a low-pass,
    0.7 in one of ESIM with a dead time of some frames."""

    kinds: int = 4
    """How many different parts these are of, at least: what is held comes at one time after a frame."""

    used: float = 0.02
    """Share of those events that are of one, from which on it counts."""

    grids: int = 40
    """Parts of a frame, at most, at all of which a simulator that knows frames alone puts its events, as many
    as the busiest pixel sends."""

    on_grid: float = 0.9
    """Share of the events of a frame that are at such parts, from which on they are."""

    of_frames: float = 0.7
    """Share of the frames with events at parts of their own, from which on nothing is held."""

    of_frame: int = 10
    """Events that are looked at of a frame that counts, at least."""

    tick: float = 0.02
    """Of a frame before its end: rounded stamps of the next frame's time."""

    exact: float = 0.98
    """Share of the events that have the time of a frame to the microsecond, or one of such parts, from which
    on that is a clock whose ticks are frames: it shows the tick before an event. IEBCS has 0.94 at most."""

    same: float = 0.005
    """What thresholds of frames differ by, relative, at most, where all events have the time of one, or all
    but noise: 0.0007 and less in three clips of IEBCS without latency, 0.01 and more in 55 of others; 0.002
    and 0.003 in two of IEBCS with noise, 0.05 and more in 119 of others."""

    longest_wait: int = 16
    """Frames from an event to that whose light is remembered, at most."""

    in_phase: float = 0.4
    """Length of the mean direction of events by their time after a frame, at least, for their memory to be
    asked where they are late by more than a frame: 0.7 where stamps are off by an eighth of one."""

    few: int = 20_000
    """Events that tell that, about: those of the rows with the most of them."""

    latest: int = 9
    """Frames that they are late by, at most."""

    thin_out: tuple[float, float] = (0.5, 0.1)
    """Shares of the events beside those that have the time of a frame that come in its first third, at least,
    and in its last, at most, where latencies are drawn about 0: 0.84 and 0.004 in a clip of IEBCS, 0.71 and
    0.06 in another that has noise at any time."""

    late: tuple[float, float] = (0.1, 0.9)
    """Times after a frame at which events that tell of it have waited: from frame to frame."""

    sooner: float = 1.03
    """How much farther light goes after the frame than before it, at least, in the direction of events."""

    change: float = 0.3
    """Of the logarithm that counts, at most: edges say no more than slopes."""


HELD_CLIPS = HeldClipSettings()


def holds_frames(events: Events, scene: Scene, settings: HeldClipSettings = HELD_CLIPS) -> bool:
    """Return whether events are of the frames of a clip held each from the time of the one before on.

    Args:
        events: Sorted.
        scene: What they are of; only clips are asked, and none whose frames are held already.
        settings: When a clip is held.
    """
    if not isinstance(scene, VideoScene) or scene.held_for or len(scene.sample_times()) < 4:
        return False
    times = scene.sample_times()
    first, last = np.searchsorted(events.t, [times[1], times[-2]])
    if last - first < settings.least:
        return False
    chosen = np.linspace(first, last - 1, settings.events).astype(np.int64)
    chosen = chosen[np.diff(chosen, prepend=-1) > 0]
    t, p = events.t[chosen], np.asarray(events.p, bool)[chosen]
    pixel = events.y[chosen].astype(np.int64) * events.width + events.x[chosen]
    frame = np.searchsorted(times, t, side="right") - 1
    late, gap = t - times[frame], times[frame + 1] - times[frame]
    parts, exact = even_parts(late, gap)
    even = exact & (parts <= settings.shares)
    at_frame = late < 0.6e-6
    if (at_frame | even).mean() >= settings.exact and at_frame.mean() >= settings.spread_out:
        # where no pixel is late at all, only their memory tells held frames from ticks
        return _remember_frames(events, scene, settings)
    if even.mean() >= settings.spread_out:
        return False
    if come_at_even_parts(frame, late, gap, settings):
        return False
    phase = late / gap
    begin, spread = begin_of_events(phase % 1.0, settings)
    lies_apart = begin is None
    if begin is None:  # latencies that differ and stamps that are off put them farther apart
        begin, spread = _begin_of_all(phase % 1.0, settings), False
        if begin is None and (even | at_frame).mean() >= settings.at_parts:
            return False
        if begin is None:
            if frames_late(events, scene, settings) is not None:
                return True
            return _come_by_their_way(events, scene, phase % 1.0, settings)
    elif at_frame.any() and not _begin_or_thin_out(phase[~at_frame], settings):
        # noise that is drawn at each frame and light that goes from frame to frame, or events at frames that
        # are held and noise at any time: their memory tells
        return _remember_frames(events, scene, settings)
    # soon after a frame all parts lie close together
    clear = phase > settings.clear
    if begin is None or (spread and even[clear].mean() >= settings.at_parts):
        return False
    past = phase > settings.past
    fine = exact & (parts <= settings.many)
    if not spread and past.any() and fine[past].mean() >= settings.all_at_parts:
        used = np.bincount(parts[past & fine].astype(np.int64)) / np.count_nonzero(past)
        if np.count_nonzero(used > settings.used) >= settings.kinds:
            return False  # a dead time leaves the first of many
    if settings.late[0] < begin < settings.late[1] and not lies_apart:
        return True
    # at about the time of a frame it may be this one or the next of which they tell
    frame += phase > 1 - settings.tick
    before = after = 0.0
    for one in np.unique(frame[(frame > 0) & (frame < len(times) - 1)]):
        here = frame == one
        some, place = np.unique(pixel[here], return_inverse=True)
        light = light_of(scene, times[one - 1 : one + 2], some.astype(np.int32))
        ways = np.diff(np.log(light + np.float32(LOG_EPS)), axis=1)
        ways = np.clip(ways, -settings.change, settings.change)[place] * np.where(p[here], 1, -1)[:, None]
        before, after = before + float(ways[:, 0].sum()), after + float(ways[:, 1].sum())
    if after > settings.sooner * max(before, 0.0):
        return True
    # it may be one that was shown some frames before
    late_by = frames_late(events, scene, settings)
    return late_by is not None and late_by >= 1


def come_at_even_parts(
    frame: NDArray[np.int64],
    late: NDArray[np.float64],
    gap: NDArray[np.float64] | float,
    settings: HeldClipSettings = HELD_CLIPS,
) -> bool:
    """Return whether events come at even parts of the time to the next frame, of each frame as many.

    So v2e stamps them, by how many the busiest pixel sends. A clock's ticks are as many in all frames, and
    what is held comes at one of such parts.

    Args:
        frame: After which each event comes, shape (N,).
        late: How long after it [s], shape (N,).
        gap: To the next frame [s], shape (N,) or one for all.
        settings: How many parts there may be.
    """
    many = np.bincount(frame)
    asked = many >= settings.of_frame
    if not asked.any():
        return False
    share, of_all = np.zeros(len(many)), 0.0
    for parts in range(2, settings.grids + 1):
        place = late * parts / gap
        nearest = np.round(place)
        at_one = np.abs(place - nearest) * gap < 0.6e-6 * parts
        usual = np.bincount(frame, at_one & (nearest == np.median(nearest)), len(many))
        here = np.bincount(frame, at_one, len(many))
        of_all = max(of_all, float(at_one.mean()))
        share = np.maximum(share, np.where(usual < settings.on_grid * here, here / np.maximum(many, 1), 0.0))
    own_parts = float(np.mean(share[asked] >= settings.on_grid))
    return of_all < settings.on_grid and own_parts >= settings.of_frames


def even_parts(
    late: NDArray[np.float64], gap: NDArray[np.float64] | float
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the number of parts of a time of which events come at the end of one, and whether they just do.

    Args:
        late: Of each event since that time began [s], shape (N,).
        gap: That time [s], shape (N,) or one for all.

    Returns:
        The nearest whole number, and whether the event is there to the microsecond, shape (N,) each.
    """
    parts = np.round(gap / np.maximum(late, 1e-9))
    return parts, np.abs(late * parts - gap) < 1.1e-6 * parts


def most_beside(phase: NDArray[np.float64], bins: int, beside: int) -> float:
    """Return how many events at most lie in some bins beside each other of a turn.

    Args:
        phase: Of the events, in 0..1, shape (N,).
        bins: Of the turn.
        beside: Bins that are taken together.
    """
    counts = np.histogram(phase, bins, (0.0, 1.0))[0]
    return float(np.convolve(np.concatenate([counts, counts]), np.ones(beside), "valid").max())


def _begin_or_thin_out(phase: NDArray[np.float64], settings: HeldClipSettings) -> bool:
    """Return whether events begin at a time after a frame, or are the fewer the later.

    Args:
        phase: When they come after a frame, relative to the next, in 0..1, shape (N,).
        settings: How fast.
    """
    if begin_of_events(phase % 1.0, settings)[0] is not None:
        return True
    first, second, last = np.histogram(phase, 3, (0.0, 1.0))[0] / max(len(phase), 1)
    most, least = settings.thin_out
    return bool(first >= most and first > second > last and last <= least)


def _remember_frames(events: Events, scene: VideoScene, settings: HeldClipSettings) -> bool:
    """Return whether one threshold makes the events of pixels that remember the light of a held frame.

    That of their last event, or of one some frames later, when a dead time ends.

    Args:
        events: Sorted.
        scene: Their clip.
        settings: How alike thresholds are.
    """
    seen, last = HeldEvents.of(events, scene), np.inf
    for wait in range(1, settings.longest_wait + 1):
        spread = spread_of_thresholds(seen, wait=wait)
        if spread < settings.same or spread >= last:
            return spread < settings.same
        last = spread
    return False


def frames_late(events: Events, scene: VideoScene, settings: HeldClipSettings = HELD_CLIPS) -> float | None:
    """Return how late events are [frames] if one threshold makes them all once that is known; None if not.

    A pixel whose event is late remembers the light of the frame at which it is sent. The frame of an event is
    looked for from half a frame before the usual time of events on, so that stamps which are off stay
    within it.

    Args:
        events: Sorted.
        scene: Their clip, held or as its frames are written down.
        settings: How alike thresholds are.
    """
    times = scene.frame_times()
    gap = float(np.median(np.diff(times)))
    turn = np.exp(2j * np.pi * (events.t - times[0]) / gap).mean() if len(events) else 0.0
    if abs(turn) < settings.in_phase:
        return None
    usual = float(np.angle(turn)) / (2 * np.pi) % 1.0
    most = int(len(times) * scene.width * scene.height * min(settings.few / len(events), 1.0))
    for frames in range(settings.latest):
        sooner = replace(events, t=events.t - (usual - 0.5 + frames) * gap)
        seen = HeldEvents.of(sooner, scene, most=most)
        drawn = thresholds_of_frames(seen, wait=frames + 1).values()
        # of a few events of one polarity thresholds are alike by chance
        if len(drawn) == 2 and max(one.spread for one in drawn) < settings.same:
            return frames + usual
    return None


def _come_by_their_way(
    events: Events, scene: VideoScene, phase: NDArray[np.float64], settings: HeldClipSettings
) -> bool:
    """Return whether events come after frames by how far a pixel has to go to their light.

    Args:
        events: Sorted.
        scene: Their clip.
        phase: When they come after a frame, relative to the next, in 0..1, shape (N,).
        settings: How sure.
    """
    if most_beside(phase, settings.parts, settings.quarter) < settings.dense * len(phase):
        return False
    delays = delays_after_frames(events, scene)
    if delays is None or delays.width() > settings.width or delays.slope_in_errors() < settings.later:
        return False
    # what appears on a dark ground sends at the begin of a frame, too, and more of it the longer that lasts
    differ = spread_of_thresholds(HeldEvents.of(events, scene))
    return not settings.apart_at_most < differ < np.inf


def _begin_of_all(phase: NDArray[np.float64], settings: HeldClipSettings = HELD_CLIPS) -> float | None:
    """Return the begin of the part of the time from frame to frame in which nearly all events come.

    None where that part is not short.

    Args:
        phase: Of the events, in 0..1, shape (N,).
        settings: How short, and how many.
    """
    counts = np.histogram(phase, settings.parts, (0.0, 1.0))[0]
    inside = np.convolve(np.concatenate([counts, counts]), np.ones(settings.apart), "valid")[: settings.parts]
    first = int(np.argmax(inside))
    return first / settings.parts if inside[first] >= settings.nearly * len(phase) else None


def begin_of_events(
    phase: NDArray[np.float64], settings: HeldClipSettings = HELD_CLIPS
) -> tuple[float | None, bool]:
    """Return at which share of the time from frame to frame most events begin, and whether others follow.

    None if they come at any time.

    Args:
        phase: Of the events, in 0..1, shape (N,).
        settings: What a begin is.
    """
    counts = np.histogram(phase, settings.parts, (0.0, 1.0))[0]
    near = settings.near
    around = sum(np.roll(counts, -shift) for shift in range(near))
    first = int(np.argmax(around))
    most = float(np.max(around))
    begin = (first + np.argmax(np.roll(counts, -first)[:near] > 0)) % settings.parts / settings.parts
    if most >= settings.together * len(phase):
        return float(begin), False
    ahead = float(np.roll(counts, near - first)[:near].sum())
    spread = np.count_nonzero(counts > 1e-4 * len(phase)) >= settings.filled * settings.parts
    is_sudden = ahead <= settings.sudden * most
    begins = most >= settings.begun * len(phase) and is_sudden and spread
    return (float(begin) if begins else None), True
