"""Whether a camera's frames lie where its events lie: clock, mirror, shift."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dase.errors import InputError, checked_seed
from dase.events import Events
from dase.formatting import fit_to_screen, format_seconds
from dase.scenes.between_frames import CameraScene


@dataclass(frozen=True)
class AlignmentSettings:
    """How events and frames are compared, and when a correction is clear."""

    soft: float = 0.03
    """Added to intensities before the logarithm: frames say little about changes in what is darker."""
    most_events: float = 20.0
    """More net events of a pixel between two frames count as this many, so that hot pixels do not decide."""
    intervals: int = 40
    """Times between frames that are looked at, those with most events; enough to decide on any file."""
    resamples: int = 1000
    """Resamples of these intervals."""
    sure: float = 0.99
    """Share of the resamples in which a correction must win to be clear."""
    spreads: float = 3.0
    """Times its spread over resamples that a shift or an offset must be away from none."""
    least_score: float = 0.1
    """Below this correlation nothing is clear."""
    least_intervals: int = 5
    """With fewer intervals to resample nothing is clear."""
    least_shift: float = 0.5
    """Shifts below this are not corrected unasked [px]."""
    early: float = 1e-3
    """Events this much before the light changes are on another clock [s]."""
    lag: float = 0.02
    """Delay that a pixel's own bandwidth and latency may cause [s]; it is the sensor's to explain."""


Flip = tuple[bool, bool]
Place = tuple[int, int]
Scores = NDArray[np.float64]

FLIPS: tuple[Flip, ...] = ((False, False), (True, False), (False, True), (True, True))
"""Left to right, top to bottom."""

PARTS = ("flip", "shift", "offset")
"""Corrections, in the order in which they are applied."""


@dataclass(frozen=True, repr=False)
class Alignment:
    """What brings frames onto events.

    Args:
        offset: Time by which the events come after the frames [s]; add it to the frames' times.
        flip_x: Whether frames are to be mirrored left to right.
        flip_y: Whether frames are to be mirrored top to bottom.
        shift: Columns and rows by which the mirrored frames are to be moved [px].
        score: Correlation of events and brightness changes after all of that, in -1..1.
        score_as_is: The same without any correction.
        spread: Standard deviation over resampled intervals of the offset [s] and of both shifts [px].
        clear: Corrections that are clearly better than none, of `PARTS`; see `align`.
        shifts: Correlation for each of `FLIPS` and each shift of -R..R rows and columns at `offset`, shape
            (4, 2 R + 1, 2 R + 1).
        offsets: Offsets tried with the best flip and shift [s], and their correlations, shape (2, T).
        intervals: Number of times between frames that were looked at.
    """

    offset: float
    flip_x: bool
    flip_y: bool
    shift: tuple[float, float]
    score: float
    score_as_is: float
    spread: tuple[float, float, float]
    clear: frozenset[str]
    shifts: NDArray[np.float64]
    offsets: NDArray[np.float64]
    intervals: int

    def __repr__(self) -> str:
        """Return the corrections and how sure they are; all correlations are in `shifts` and `offsets`."""
        (x, y), (late, apart_x, apart_y) = self.shift, self.spread
        ways = ["left to right"] * self.flip_x + ["top to bottom"] * self.flip_y
        mirrored = f"mirrored {' and '.join(ways)}" if ways else "not mirrored"
        return fit_to_screen(
            [
                f"Alignment of {self.intervals} times between frames",
                f"  offset {format_seconds(self.offset)} ± {format_seconds(late)}",
                f"  {mirrored}",
                f"  shift {x:.2f} ± {apart_x:.2f}, {y:.2f} ± {apart_y:.2f} px",
                f"  correlation {self.score:.3f}, {self.score_as_is:.3f} as it is",
                f"  clear: {', '.join(sorted(self.clear)) or 'nothing'}",
            ]
        )

    def apply(
        self, frames: NDArray[Any], begin: ArrayLike, end: ArrayLike, parts: Iterable[str] | None = None
    ) -> tuple[NDArray[Any], NDArray[np.float64], NDArray[np.float64]]:
        """Return frames, begin and end of exposures [s] on the pixels and the clock of the events.

        What a shift leaves without content becomes 0, which a `CameraScene` takes for unknown.

        Args:
            frames: Shape (F, H, W).
            begin: Begin of each exposure [s], shape (F,).
            end: End of each exposure [s], shape (F,).
            parts: Corrections to apply, of `PARTS`; None applies those that are clear.
        """
        chosen = self.clear if parts is None else frozenset(parts)
        if not chosen <= set(PARTS):
            raise InputError(f"align: parts must be of {', '.join(PARTS)}, got {', '.join(sorted(chosen))}")
        out, late = np.asarray(frames), self.offset if "offset" in chosen else 0.0
        if "flip" in chosen:
            out = out[:, :: -1 if self.flip_y else 1, :: -1 if self.flip_x else 1]
        if "shift" in chosen:
            out = np.stack([_shift_frame(frame, self.shift) for frame in out])
        return out, np.asarray(begin, np.float64) + late, np.asarray(end, np.float64) + late

    def report(self) -> str:
        """Return what was found, with the table of correlations."""
        flip = {(0, 0): "none", (1, 0): "left to right", (0, 1): "top to bottom", (1, 1): "both"}
        late, dx, dy = self.spread
        clear = ", ".join(part for part in PARTS if part in self.clear) or "nothing"
        lines = [
            f"correlation  {self.score:.3f} ({self.score_as_is:.3f} as it is, {self.intervals} intervals)",
            f"offset       events come {1e3 * self.offset:.2f} ± {1e3 * late:.2f} ms after the frames",
            f"mirror       {flip[self.flip_x, self.flip_y]}",
            f"shift        x {self.shift[0]:+.2f} ± {dx:.2f} px, y {self.shift[1]:+.2f} ± {dy:.2f} px",
            f"clear        {clear}",
        ]
        reach = self.shifts.shape[1] // 2
        shown = [n for n in (-4, -2, -1, 0, 1, 2, 4) if abs(n) <= reach]
        for (flip_x, flip_y), scores in zip(FLIPS, self.shifts, strict=True):
            lines += ["", f"mirror: {flip[flip_x, flip_y]}", "  y \\ x" + "".join(f"{x:+8d}" for x in shown)]
            for y in shown:
                row = "".join(f"{scores[y + reach, x + reach]:8.3f}" for x in shown)
                lines.append(f"  {y:+5d}{row}")
        return "\n".join(lines)


def align(
    events: Events,
    frames: ArrayLike,
    begin: ArrayLike,
    end: ArrayLike | None = None,
    *,
    gamma: float = 1.0,
    black: float = 0.0,
    white: float | None = None,
    gains: ArrayLike | None = None,
    reach: int = 6,
    latest: float | None = None,
    seed: int = 0,
    settings: AlignmentSettings = AlignmentSettings(),
) -> Alignment:
    """Estimate how frames must be mirrored, moved and delayed to lie on the events.

    An event image is the sum of a pixel's polarities, each weighted with the share of the first exposure that
    is over and the share of the second that is still to come, which is how much it contributes to the
    difference between the two means. It is correlated with the change of the log intensity from frame to
    frame; correlations of all intervals are averaged, each weighted by how much changes and how many events
    there are.

    A flip or a shift is clear if it wins in 99 % of resamples of the intervals; a shift must also be half a
    pixel, and three times its spread. An offset is clear only if, beyond that, no pixel could cause it:
    events that come before the light changes, or later than a sensor may answer. Smaller delays belong to the
    sensor's bandwidth and latency, and taking them away here would hide these. Nothing is clear where the
    correlation stays below 0.1, or with fewer than 5 intervals. `AlignmentSettings` holds these numbers.

    Args:
        events: Events on a clock near that of the frames.
        frames: Any real type, shape (F, height, width), of the events' size.
        begin: Begin of each exposure [s], shape (F,).
        end: End of each exposure [s]; None for no or unknown exposure.
        gamma: See `dase.CameraScene`.
        black: See `dase.CameraScene`.
        white: See `dase.CameraScene`.
        gains: See `dase.CameraScene`.
        reach: Largest shift that is tried [px].
        latest: Largest offset that is tried, either way [s]; None: one and a half times between frames.
        seed: Of the resamples.
        settings: How events and frames are compared, and when a correction is clear.

    Raises:
        InputError: Shapes disagree, or there are no events between frames.
    """
    scene = CameraScene(frames, begin, end, gamma=gamma, black=black, white=white, gains=gains)
    if (events.height, events.width) != (scene.height, scene.width):
        raise InputError(
            f"align: frames must have the size of the events, {events.width}x{events.height}, "
            f"got {scene.width}x{scene.height}"
        )
    if reach < 1 or min(scene.width, scene.height) <= 4 * reach:
        raise InputError(
            f"align: reach must lie between 1 px and a quarter of {scene.width}x{scene.height}, got {reach}"
        )
    gap = float(np.median(np.diff(scene.times)))
    latest = 1.5 * gap if latest is None else latest
    if not (np.isfinite(latest) and latest >= 0):
        raise InputError(f"align: latest must be >= 0 s, got {latest:g}")
    search = _ShiftSearch(events, scene, reach, settings)
    counts = np.full(len(search.changes), 1 / len(search.changes))
    draws = np.random.default_rng(checked_seed(seed)).multinomial(len(counts), counts, settings.resamples)
    return _judge_corrections(search, *_search_offsets(search, gap, latest), draws)


class _ShiftSearch:
    """Correlations of events with brightness changes, interval by interval, before they are averaged."""

    def __init__(self, events: Events, scene: CameraScene, reach: int, settings: AlignmentSettings):
        self.events, self.reach, self.settings = events, reach, settings
        self.flat = events.y.astype(np.int64) * events.width + events.x
        self.sign = np.where(events.p, 1.0, -1.0)
        self.shape = events.height, events.width
        counts = np.diff(np.searchsorted(events.t, scene.times))
        if not counts.any():
            raise InputError("align: there are no events between the frames; are both on one clock?")
        busiest = np.sort(np.argsort(-counts, kind="stable")[: settings.intervals])
        ends = np.stack([scene.begin[:-1], scene.end[:-1], scene.begin[1:], scene.end[1:]], 1)
        self.exposures = ends[busiest]
        self.changes = [_log_change(scene, int(k), settings.soft) for k in busiest]

    def table(self, offset: float, flips: Sequence[Flip]) -> tuple[Scores, Scores]:
        """Return weighted correlations (J, flips, 2 R + 1, 2 R + 1) and weights (J,) at an offset [s]."""
        scores, weights = [], []
        for exposures, change in zip(self.exposures, self.changes, strict=True):
            image = self._event_image(exposures, offset)
            weights.append(float(image.std()) * float(change.std()) + 1e-12)
            scores.append([weights[-1] * self._shifts(image, change, flip) for flip in flips])
        return np.array(scores), np.array(weights)

    def _event_image(self, exposures: Scores, offset: float) -> NDArray[np.float32]:
        """Return what the events of each pixel say of the change between two exposures, (H, W)."""
        b0, e0, b1, e1 = exposures
        part = slice(*np.searchsorted(self.events.t, (b0 + offset, e1 + offset)))
        t = self.events.t[part] - offset
        over = np.clip((t - b0) / (e0 - b0), 0, 1) if e0 > b0 else 1.0
        begun = np.clip((t - b1) / (e1 - b1), 0, 1) if e1 > b1 else 0.0
        size = self.shape[0] * self.shape[1]
        image = np.bincount(self.flat[part], self.sign[part] * (over - begun), minlength=size)
        most = self.settings.most_events
        return np.clip(image, -most, most).astype(np.float32).reshape(self.shape)

    def _shifts(self, image: NDArray[np.float32], change: NDArray[np.float32], flip: Flip) -> Scores:
        """Return the correlations of all shifts, every one over as many pixels."""
        mirrored = change[:: -1 if flip[1] else 1, :: -1 if flip[0] else 1]
        inner = np.ascontiguousarray(mirrored[self.reach : -self.reach, self.reach : -self.reach])
        found = cv2.matchTemplate(image, inner, cv2.TM_CCOEFF_NORMED)
        # OpenCV gives 1 or infinity where there is nothing to correlate
        return np.where(np.abs(found) < 1, found, 0.0).astype(np.float64)


def _log_change(scene: CameraScene, interval: int, soft: float) -> NDArray[np.float32]:
    """Return the change of log intensity from a frame to the next, (H, W)."""
    before, after = (np.log(scene.intensity(k) + np.float32(soft)) for k in (interval, interval + 1))
    return np.asarray(after - before)


def _search_offsets(
    search: _ShiftSearch, gap: float, latest: float
) -> tuple[Flip, Place, Scores, Scores, Scores]:
    """Search offsets coarsely with all flips and shifts, then finely with the best.

    Returns:
        Flip and place of the best shift; offsets tried (T,), their weighted correlations and weights (T, J).
    """
    steps = np.arange(0, latest + 1e-9, gap / 4)
    best: tuple[float, float, tuple[int, ...]] = (-np.inf, 0.0, (0, 0, 0))
    for offset in [*steps, *-steps[1:]]:
        scores, weights = search.table(float(offset), FLIPS)
        mean = scores.sum(0) / weights.sum()
        best = max(best, (float(mean.max()), float(offset), np.unravel_index(mean.argmax(), mean.shape)))
    flip, place = FLIPS[best[2][0]], (int(best[2][1]), int(best[2][2]))
    offsets = np.asarray(best[1] + gap / 20 * np.arange(-6, 7), np.float64)
    tables = [search.table(float(offset), (flip,)) for offset in offsets]
    curve = np.array([scores[:, 0, *place] for scores, _ in tables])
    return flip, place, offsets, curve, np.array([weights for _, weights in tables])


def _judge_corrections(
    search: _ShiftSearch,
    flip: Flip,
    place: Place,
    offsets: Scores,
    curve: Scores,
    weights: Scores,
    draws: NDArray[np.int64],
) -> Alignment:
    """Refine offset and shift, and see by resampling how sure they are."""
    limits = search.settings
    offset = float(_parabola_maximum(offsets, curve.sum(1) / weights.sum(1)))
    late = np.array([_parabola_maximum(offsets, curve @ d / (weights @ d)) for d in draws]).std()
    scores, weight = search.table(offset, FLIPS)
    mean, number, middle = scores.sum(0) / weight.sum(), FLIPS.index(flip), search.reach
    peak = _peak_shift(mean[number])
    drawn = np.tensordot(draws, scores, 1) / (draws @ weight)[:, None, None, None]  # (resamples, flips, S, S)
    spread = np.array([_peak_shift(table[number]) for table in drawn]).std(0)
    tops = drawn.max((2, 3))
    clear = set()
    if number and np.mean(tops[:, number] > tops[:, 0]) >= limits.sure:
        clear.add("flip")
    wins = np.mean(drawn[:, number, *place] >= drawn[:, number, middle, middle])
    if np.hypot(*peak) > max(limits.least_shift, limits.spreads * np.hypot(*spread)) and wins >= limits.sure:
        clear.add("shift")
    if offset + limits.spreads * late < -limits.early or offset - limits.spreads * late > limits.lag:
        clear.add("offset")
    if mean[number].max() < limits.least_score or len(search.changes) < limits.least_intervals:
        clear.clear()
    as_is, as_is_weight = search.table(0.0, FLIPS[:1])
    return Alignment(
        offset=offset,
        flip_x=flip[0],
        flip_y=flip[1],
        shift=(peak[0], peak[1]),
        score=float(mean[number].max()),
        score_as_is=float(as_is[:, 0, middle, middle].sum() / as_is_weight.sum()),
        spread=(float(late), float(spread[0]), float(spread[1])),
        clear=frozenset(clear),
        shifts=mean,
        offsets=np.stack([offsets, curve.sum(1) / weights.sum(1)]),
        intervals=len(search.changes),
    )


def _parabola_maximum(x: Scores, y: Scores) -> float:
    """Return where a curve on an even grid has its maximum, by a parabola through three points."""
    k = int(np.clip(y.argmax(), 1, len(y) - 2))
    bend = y[k - 1] - 2 * y[k] + y[k + 1]
    if not bend < 0:
        return float(x[y.argmax()])
    return float(x[k] + np.clip(0.5 * (y[k - 1] - y[k + 1]) / bend, -1, 1) * (x[1] - x[0]))


def _peak_shift(table: Scores) -> tuple[float, float]:
    """Return the shift in x and y [px] of the maximum of a table, by parabolas through its neighbours."""
    row, column = np.unravel_index(table.argmax(), table.shape)
    grid = np.arange(len(table), dtype=np.float64) - len(table) // 2
    return _parabola_maximum(grid, table[row]), _parabola_maximum(grid, table[:, column])


def _shift_frame(frame: NDArray[Any], shift: tuple[float, float]) -> NDArray[Any]:
    """Return a frame moved by columns and rows [px], bilinear; 0 where there is no content."""
    height, width = frame.shape
    matrix = np.array([[1, 0, shift[0]], [0, 1, shift[1]]], np.float64)
    moved = cv2.warpAffine(frame.astype(np.float32), matrix, (width, height), flags=cv2.INTER_LINEAR)
    inside = cv2.warpAffine(np.ones(frame.shape, np.float32), matrix, (width, height), flags=cv2.INTER_LINEAR)
    moved = np.where(inside > 0.999, moved, 0)
    return moved.astype(frame.dtype) if frame.dtype.kind == "f" else np.rint(moved).astype(frame.dtype)
