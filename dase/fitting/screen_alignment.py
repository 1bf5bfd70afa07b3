"""Where and when a recording shows a stimulus: from its flashes, its marks and its chequerboards.

The flashes of the whole screen tell the times, the marks the place, the tiles that go between a chequerboard
and a grey the gamma. Nothing here knows the sensor: only which events come when, and where.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from dase.errors import InputError
from dase.events import Events
from dase.scenes.screen_scene import ScreenScene, ScreenView, apply_homography
from dase.scenes.screen_stimulus import PROGRAMME, ScreenStimulus, Segment, code_changes

Array = NDArray[np.float64]


@dataclass(frozen=True)
class AlignmentSettings:
    """When flashes, marks and a gamma count as found."""

    bin: float = 2e-3
    """Events are counted for so long where the flashes are looked for [s]."""
    response: float = 0.04
    """Events of a change of the light come within so long [s]: slow pixels and full buses included."""
    likeness: float = 0.7
    """Least correlation of the events with the flashes."""
    clear: float = 2.0
    """Times by which the root of the events of a flash exceeds that of half of all moments: noise is as like
    a flash at one of many moments, but not stronger there."""
    drift: float = 0.02
    """Largest difference between the clocks of screen and camera, as a share."""
    mark_likeness: float = 0.8
    """Least correlation of a pixel's events with the code of a mark."""
    mark_events: float = 1.0
    """Events per change of a mark that its pixels send at least."""
    mark_pixels: int = 5
    """Pixels of a mark at least: fewer tell its middle badly."""
    marks: int = 6
    """Marks without which the place of the screen is not known well."""
    off_plane: float = 1.5
    """Distance from where the others say that it is, up to which a mark is taken [px]."""
    moved: float = 1.0
    """Change between the first marks and the last ones from which the camera is said to have moved [px]."""
    soon: float = 0.1
    """Quantile of the first events of pixels by which the time of a flash is told: later ones are of slow
    pixels, and of a bus that is full."""
    row_bins: int = 12
    """Parts of the screen's rows whose times tell how it is scanned."""
    warning: float = 3.0
    """Standard errors from which a gamma that was given is said to be another one."""


ALIGNMENT = AlignmentSettings()


@dataclass(frozen=True, eq=False)
class ScreenAlignment:
    """Where and when a recording shows a stimulus.

    Args:
        view: How the camera sees the screen.
        gamma: Of the screen; that of the stimulus where the recording does not tell.
        gamma_error: Its standard error; 0 where it was given, or could not be measured.
        marks: How many marks were found.
        residual: Root mean square distance of the marks from where the homography has them [px].
        visible: Share of the screen's area that is in the picture.
        notes: What was found, in sentences.
    """

    view: ScreenView
    gamma: float
    gamma_error: float
    marks: int
    residual: float
    visible: float
    notes: tuple[str, ...]


def align_screen(events: Events, stimulus: ScreenStimulus) -> ScreenAlignment:
    """Find a stimulus in a recording of it.

    Args:
        events: Of a camera at rest before a screen that shows the whole video.
        stimulus: What it showed.

    Raises:
        InputError: The flashes are not in the events, or too few marks.
    """
    if len(events) == 0:
        raise InputError("the recording has no events, so no flashes of the stimulus can be found")
    begin, end = _find_flashes(events, stimulus)
    first, last = (stimulus.segment_of("flash", n).begin / stimulus.refresh for n in range(2))
    pace = 1.0 if end is None else (end - begin) / (last - first)
    rough = _Clock(begin - pace * first, pace)
    notes: list[str] = []
    where = _mark_places(events, stimulus, rough, 0)
    if end is not None:
        where = _both_places(where, _mark_places(events, stimulus, rough, 1), notes)
    matrix, used, residual = _homography(where, stimulus)
    view = _view_in_time(events, stimulus, matrix, rough, drifts=end is not None)
    notes.insert(0, _time_sentence(view, end is not None))
    visible = _visible_share(view, stimulus)
    notes += _place_sentences(view, stimulus, used, residual, visible)
    gamma, error = stimulus.gamma, 0.0
    measured = _measured_gamma(events, stimulus, view)
    if stimulus.gamma_given:
        if measured and abs(measured[0] - gamma) > ALIGNMENT.warning * measured[1] + 0.02 * gamma:
            notes.append(
                f"the chequerboards say that the screen's gamma is {measured[0]:.2f} ± {measured[1]:.2f}, "
                f"{gamma:g} was given: thresholds go in proportion to it"
            )
    elif measured is None:
        notes.append(
            f"the screen's gamma could not be measured and is taken as {gamma:g}: "
            "thresholds go in proportion to it"
        )
    else:
        gamma, error = measured
        notes.append(f"the screen's gamma is {gamma:.3g} ± {error:.1g}, by the chequerboards")
    return ScreenAlignment(view, gamma, error, used, residual, visible, tuple(notes))


def screen_scene(events: Events, stimulus: ScreenStimulus, notes: list[str]) -> ScreenScene:
    """Return the stimulus as the scene of a recording of it.

    Args:
        events: Of a camera that looked at it.
        stimulus: What was shown.
        notes: Gets what was found out.

    Raises:
        InputError: The stimulus is not found in the recording.
    """
    found = align_screen(events, stimulus)
    notes += found.notes
    return ScreenScene(stimulus, found.view, gamma=found.gamma, gamma_error=found.gamma_error)


@dataclass(frozen=True)
class _Clock:
    """Times of the camera [s] from times of the video [s]."""

    offset: float
    pace: float

    def at(self, time: float) -> float:
        return self.offset + self.pace * time


def _find_flashes(events: Events, stimulus: ScreenStimulus) -> tuple[float, float | None]:
    """Return when the first flash begins and when the last one does [s], the last None if it is not there."""
    s = ALIGNMENT
    first = float(events.t[0]) - 0.5
    count = math.ceil((float(events.t[-1]) + s.response - first) / s.bin)
    place = ((events.t - first) / s.bin).astype(np.int64)
    sign = np.where(events.p, 1.0, -1.0)
    net = np.bincount(place, sign, count)
    width = round(s.response / s.bin)
    total = np.concatenate([[0.0], np.cumsum(net)])
    # roots, or the largest change of a picture would outweigh all others
    change = total[width:] - total[:-width]
    change = np.sign(change) * np.sqrt(np.abs(change))
    scores = [_flash_scores(change, stimulus, which) for which in range(2)]
    begin = int(np.argmax(scores[0]))
    apart = (stimulus.segment_of("flash", 1).begin - stimulus.segment_of("flash").begin) / stimulus.refresh
    low, high = (begin + round(apart * (1 + way * s.drift) / s.bin) for way in (-1, 1))
    near = scores[1][low : high + 1]
    if scores[0][begin] < s.likeness:
        raise InputError(
            f"the flash with which the stimulus begins is not in the recording: the likest moment, "
            f"{first + begin * s.bin:.3g} s, correlates at {scores[0][begin]:.2f}, at least {s.likeness:g} "
            "is needed; start the camera before the video, and show it whole, at its own rate"
        )
    if not len(near) or near.max() < s.likeness:
        return first + begin * s.bin, None
    return first + begin * s.bin, first + (low + int(np.argmax(near))) * s.bin


def _flash_scores(change: Array, stimulus: ScreenStimulus, which: int) -> Array:
    """Return how like a flash the events are from each bin on, shape (bins,)."""
    flash = stimulus.segment_of("flash", which)
    slot = (flash.end - flash.begin) // len(flash.values["code"])
    light = stimulus.light_of_levels()
    ends = range(flash.begin, flash.end, slot)
    levels = [np.log(light[stimulus.levels(k)[::8, ::8]]).mean() for k in (flash.begin - 1, *ends)]
    expected = np.diff(levels)
    expected = np.sign(expected) * np.sqrt(np.abs(expected))
    at = [round(n * slot / stimulus.refresh / ALIGNMENT.bin) for n in range(len(expected))]
    length = len(change) - at[-1]
    if length < 1:
        return np.zeros(1)
    seen = np.stack([change[shift : shift + length] for shift in at])
    energy = np.sqrt((seen**2).sum(0) * (expected**2).sum())
    strength = np.sign(expected) @ seen / np.count_nonzero(expected)
    # so weak that a few events of noise would look like anything
    weak = strength < ALIGNMENT.clear * max(float(np.median(np.abs(change))), 1.0)
    out: Array = np.where(weak, 0.0, expected @ seen / np.maximum(energy, 1e-9))
    return out


def _net_events(events: Events, begin: float, slot: float, slots: int) -> Array:
    """Return ON less OFF events of each pixel in slots of time, shape (H W, slots)."""
    cut = slice(*np.searchsorted(events.t, (begin, begin + slots * slot)))
    pixel = events.y[cut].astype(np.int64) * events.width + events.x[cut]
    number = np.minimum(((events.t[cut] - begin) / slot).astype(np.int64), slots - 1)
    size = events.width * events.height
    sign = np.where(events.p[cut], 1.0, -1.0)
    net: Array = np.bincount(pixel * slots + number, sign, size * slots).astype(np.float64)
    return net.reshape(size, slots)


Places = dict[int, tuple[float, float]]


def _mark_places(events: Events, stimulus: ScreenStimulus, clock: _Clock, which: int) -> Places:
    """Return where marks are in the picture [px], those that touch its border left out."""
    s, segment = ALIGNMENT, stimulus.segment_of("marks", which)
    codes = np.array([code_changes(mark.code) for mark in stimulus.marks])
    slot = segment.values["slot"] * clock.pace
    # some ms early: the clock is known to a few bins, and most events come at once
    begin = clock.at(segment.begin / stimulus.refresh) - 4 * s.bin
    net = _net_events(events, begin, slot, codes.shape[1])
    sent = np.linalg.norm(net, axis=1)
    fits = net @ codes.T
    like = fits / np.maximum(sent[:, None] * np.linalg.norm(codes, axis=1), 1e-9)
    best = np.argmax(like, 1)
    every = np.arange(len(best))
    strength = fits[every, best] / np.abs(codes).sum(1)[best]
    good = (like[every, best] >= s.mark_likeness) & (strength >= s.mark_events)
    out: Places = {}
    for n in range(len(codes)):
        # what is half covered sends less, and counts as much less
        weight = np.where(good & (best == n), strength, 0).reshape(events.height, events.width)
        found = _blob_middle(weight)
        if found is not None:
            out[n] = found
    return out


def _blob_middle(weight: Array) -> tuple[float, float] | None:
    """Return the middle of the largest patch of pixels with a weight (H, W) [px], None if it is no mark."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats((weight > 0).astype(np.uint8), connectivity=8)
    if count < 2:
        return None
    n = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    left, top, wide, tall, area = (int(v) for v in stats[n][:5])
    height, width = weight.shape
    at_border = left == 0 or top == 0 or left + wide == width or top + tall == height
    if area < ALIGNMENT.mark_pixels or at_border:
        return None
    # the patch and the pixels beside it that are covered in part
    y, x = np.nonzero(labels == n)
    share = np.minimum(weight[y, x] / np.median(weight[y, x]), 1)
    return float((x + 0.5) @ share / share.sum()), float((y + 0.5) @ share / share.sum())


def _both_places(first: Places, last: Places, notes: list[str]) -> Places:
    """Return where marks are on average, and note it if they moved."""
    both = sorted(set(first) & set(last))
    if both:
        way = np.median([np.hypot(*np.subtract(first[n], last[n])) for n in both])
        if way > ALIGNMENT.moved:
            notes.append(
                f"the marks at the end lie {way:.1f} px from where they were at the begin: the camera or the "
                "screen moved, and the scene is off by as much; fix both and record again"
            )
    mean = {n: tuple(np.mean([first[n], last[n]], 0)) for n in both}
    return {**first, **last, **mean}


def _homography(where: Places, stimulus: ScreenStimulus) -> tuple[Array, int, float]:
    """Return the homography, the number of marks that agree with it, and their distance from it [px]."""
    s, marks = ALIGNMENT, stimulus.marks
    found = sorted(where)
    few = (
        "{0} of {1} marks of the screen are found in the picture, at least {2} are needed: have all of the "
        "screen in the picture, in focus and larger"
    )
    if len(found) < s.marks:
        raise InputError(few.format(len(found), len(marks), s.marks))
    screen = np.array([(marks[n].x, marks[n].y) for n in found])
    picture = np.array([where[n] for n in found])
    matrix, inside = cv2.findHomography(screen, picture, cv2.RANSAC, s.off_plane)
    used = int(inside.sum()) if matrix is not None else 0
    if used < s.marks:
        raise InputError(few.format(used, len(marks), s.marks))
    good = inside.reshape(-1) > 0
    matrix, _ = cv2.findHomography(screen[good], picture[good], 0)
    matrix = np.asarray(matrix, np.float64)
    off = apply_homography(matrix, *screen[good].T) - picture[good].T
    return matrix, used, float(np.sqrt((off**2).sum(0).mean()))


def _view_in_time(
    events: Events, stimulus: ScreenStimulus, matrix: Array, clock: _Clock, *, drifts: bool
) -> ScreenView:
    """Return the view with the times that the first events of pixels after bright flashes say."""
    s = ALIGNMENT
    rough = ScreenView(events.width, events.height, matrix, clock.offset, clock.pace)
    y, x = np.divmod(np.arange(events.width * events.height), events.width)
    u, v = rough.on_screen(x + 0.5, y + 0.5)
    (width, height), row = stimulus.size, v / stimulus.size[1]
    inside = (u > 0) & (u < width) & (v > 0) & (v < height)
    bin_of = np.where(inside, np.clip(np.nan_to_num(row) * s.row_bins, 0, s.row_bins - 1), -1).astype(int)
    points: list[tuple[float, float, float]] = []
    for shown in _bright_changes(stimulus, last=drifts):
        begin = clock.at(shown) - 10 * s.bin
        cut = slice(*np.searchsorted(events.t, (begin, begin + s.response + 10 * s.bin)))
        on = events.p[cut]
        pixel = (events.y[cut].astype(np.int64) * events.width + events.x[cut])[on]
        _, first = np.unique(pixel, return_index=True)  # events are in order of time
        time, part = events.t[cut][on][first], bin_of[pixel[first]]
        for n in range(s.row_bins):
            those = time[part == n]
            if len(those) >= 10:
                points.append((shown, (n + 0.5) / s.row_bins, float(np.quantile(those, s.soon))))
    if len(points) < 4:
        return rough
    told = np.array(points)
    # a straight line over rows, and over time where both flashes were seen
    columns = [np.ones(len(told)), told[:, 1], *([told[:, 0]] if drifts else [])]
    wanted = told[:, 2] - (0 if drifts else told[:, 0])
    start = np.array([clock.offset, 0.0, *([clock.pace] if drifts else [])])
    design = np.stack(columns, 1)
    fitted = least_squares(
        lambda p: 1e3 * (design @ p - wanted), start, loss="soft_l1", x_scale=[1e-3, 1e-3, 1e-4][: len(start)]
    ).x
    scan = float(np.clip(fitted[1], 0, 1.05 / stimulus.refresh))
    offset = float(fitted[0] + min(fitted[1] - scan, 0) * 0.5)
    return ScreenView(events.width, events.height, matrix, offset, float(fitted[2]) if drifts else 1.0, scan)


def _bright_changes(stimulus: ScreenStimulus, *, last: bool) -> list[float]:
    """Return when flashes of the whole screen become bright, in times of the video [s]."""
    out = []
    for which in range(2 if last else 1):
        flash = stimulus.segment_of("flash", which)
        code = flash.values["code"]
        slot = (flash.end - flash.begin) // len(code)
        out += [
            (flash.begin + n * slot) / stimulus.refresh
            for n in range(1, len(code))
            if code[n - 1 : n + 1] == "01"
        ]
    return out


def _time_sentence(view: ScreenView, drifts: bool) -> str:
    drift = (
        f"its second takes {1e6 * (view.pace - 1):+.0f} ppm more of the camera's clock"
        if drifts
        else "its last flash is not in the recording, so both clocks are taken to run alike"
    )
    return (
        f"the video begins at {view.offset:.4f} s (the camera's latency included), {drift}; "
        f"the screen is drawn from top to bottom within {1e3 * view.scan:.1f} ms"
    )


def _visible_share(view: ScreenView, stimulus: ScreenStimulus) -> float:
    """Return the share of the screen's area that is in the picture."""
    (width, height) = stimulus.size
    y, x = (np.indices((90, 160)).reshape(2, -1) + 0.5) / np.array([[90], [160]])
    u, v = apply_homography(view.homography, x * width, y * height)
    return float(np.mean((u >= 0) & (u < view.width) & (v >= 0) & (v < view.height)))


def _place_sentences(
    view: ScreenView, stimulus: ScreenStimulus, used: int, residual: float, visible: float
) -> list[str]:
    width, height = stimulus.size
    total = len(stimulus.marks)
    out = [f"{used} of {total} marks of the screen are found, {residual:.2f} px off its plane on average"]
    if residual > 0.7:
        out[0] += ": the lens may bend straight lines, or the screen is not flat"
    if visible < 0.98:
        out.append(
            f"{100 * (1 - visible):.0f} % of the screen is out of the picture: what is shown there is lost"
        )
    corners = apply_homography(
        view.homography, np.array([0.0, width, 0.0, width]), np.array([0.0, 0.0, height, height])
    )
    down = corners[:, 2] - corners[:, 0] + corners[:, 3] - corners[:, 1]
    turned = math.degrees(math.atan2(-down[0], down[1]))
    mirrored = np.linalg.det(view.homography[:2, :2]) < 0
    if mirrored:
        out.append("the picture is mirrored: a mirror is in the way, or the camera's file is turned over")
    if abs(turned) > 20:
        out.append(f"the screen is turned by {abs(turned):.0f}° in the picture: taken into account")
    return out


def _measured_gamma(events: Events, stimulus: ScreenStimulus, view: ScreenView) -> tuple[float, float] | None:
    """Return the gamma of the screen and its standard error; None where the tiles do not tell.

    Tiles go between a chequerboard, half as bright as white whatever gamma is, and a grey: as many events
    come for a grey that much brighter as for one that much darker, of the other sign. So the grey that looks
    like the chequerboard is the middle of an odd function, whatever the thresholds are.
    """
    segment: Segment = stimulus.segment_of("gamma")
    slot = segment.values["slot"] * view.pace
    slots = round((segment.end - segment.begin) / stimulus.refresh / segment.values["slot"])
    begin = view.offset + view.pace * segment.begin / stimulus.refresh
    net = _net_events(events, begin, slot, slots)
    tile = _tile_of_pixels(view, stimulus)
    # to grey and back; the first three changes still know from which side the light came before them
    way = np.array([0.0, 0.0, 0.0, *((1.0 if n % 2 else -1.0) for n in range(3, slots))])
    swing = net @ way / (slots - 3)
    counts = np.bincount(tile[tile >= 0], minlength=PROGRAMME.rows * PROGRAMME.columns)
    seen = counts >= 8
    if seen.sum() < 10:
        return None
    level = np.array(segment.values["levels"])[seen] / 255
    x = np.log(level)
    y = np.bincount(tile[tile >= 0], swing[tile >= 0], len(counts))[seen] / counts[seen]

    def middle(keep: NDArray[np.bool_]) -> float:
        # no event below a threshold, then in proportion
        def off(p: Array) -> Array:
            far = x[keep] - p[0]
            bent: Array = p[1] * np.sign(far) * np.maximum(np.abs(far) - p[2] ** 2, 0) - y[keep]
            return bent

        guess = [math.log(0.5) / stimulus.gamma, max(float(np.ptp(y) / np.ptp(x)), 1e-3), 0.2]
        starts = [[guess[0] + shift, *guess[1:]] for shift in (-0.1, 0.0, 0.1)]
        best = min((least_squares(off, start, loss="soft_l1", f_scale=0.1) for start in starts),
                   key=lambda found: float(found.cost))  # fmt: skip
        return float(best.x[0])

    every = np.ones(len(x), np.bool_)
    if np.ptp(y) < 1.0 or y.min() > -0.2 or y.max() < 0.2:
        return None
    at = middle(every)
    parts = []
    for n in range(8):  # a jackknife over groups of tiles
        keep = every.copy()
        keep[n::8] = False
        parts.append(middle(keep))
    error = math.sqrt(7 / 8 * float(np.sum((np.array(parts) - np.mean(parts)) ** 2)))
    gamma = math.log(0.5) / at if at < 0 else math.inf
    if not 1.2 < gamma < 4:
        return None
    return gamma, gamma * error / abs(at)


def _tile_of_pixels(view: ScreenView, stimulus: ScreenStimulus) -> NDArray[np.int64]:
    """Return the tile that each pixel sees, -1 at its border and outside of the screen, shape (H W,)."""
    y, x = np.divmod(np.arange(view.width * view.height), view.width)
    (width, height), grid = stimulus.size, (PROGRAMME.columns, PROGRAMME.rows)
    found = []
    for dy in (-1.0, 2.0):
        for dx in (-1.0, 2.0):
            u, v = view.on_screen(x + dx, y + dy)
            column, row = np.floor(u * grid[0] / width), np.floor(v * grid[1] / height)
            good = (column >= 0) & (column < grid[0]) & (row >= 0) & (row < grid[1])
            found.append(np.where(good, row * grid[0] + column, -1))
    same = np.all(np.stack(found) == found[0], axis=0)
    return np.where(same, found[0], -1).astype(np.int64)
