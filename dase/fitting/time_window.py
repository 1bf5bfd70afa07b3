"""Which windows of a recording's time are compared: a long one would cost much and tell little more."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.events import Events
from dase.probes.stimulus import Grid
from dase.scenes.scene import Scene
from dase.scenes.static import StaticScene
from dase.scenes.video import VideoScene


@dataclass(frozen=True)
class WindowSettings:
    """How much of a recording is compared, and what counts as missing data."""

    longest: int = 16_000
    """Steps of time that are compared at most: memory and time grow with them."""
    rest: float = 4.0
    """Time [s] that is compared where the light does not change, if it has enough events: there one second
    is like another."""
    enough: float = 1200.0
    """Events that the judging half should have."""
    windows: int = 4
    """Windows over the length that are compared at most, as long as `longest` together: light and motion at
    one time of a recording may be others than at another."""
    shortest: float = 2.0
    """They last so long at least [s]: what is slow would not be seen, and each begins anew."""
    settle: float = 0.5
    """Time at the begin of all windows but the first that is not compared [s]: filters forget the light of
    the window before, and rest is known to be rest."""
    looks: int = 60
    """Windows over the length that are looked at."""
    quantile: float = 0.75
    """Usual is a window of which this share has fewer events: neither a flash nor a pause."""
    like: float = 2.0
    """Windows are taken that have at most so many times the events of the usual one, and at least the same
    part of them."""
    gap: float = 0.005
    """Shortest time without any event [s] that may be missing data."""
    around: int = 50
    """Events that must come as long before a gap and as long after it: what goes on does not stop so."""
    gaps: int = 3
    """Gaps of one length that make them missing data: what is filmed does not pause by the clock."""
    share: float = 0.25
    """Share of the time that they may take: time stamps of whole frames have gaps between them, too."""
    alike: float = 0.15
    """Deviation of their lengths from the median, as a share, up to which they are of one length."""


def is_constant(scene: Scene) -> bool:
    """Whether a scene is known to have light that does not change."""
    if isinstance(scene, StaticScene):
        return True
    if not isinstance(scene, VideoScene) or len(scene.sample_times()) > 2:
        return False
    frames = scene.frames(scene.sample_times())
    return bool(np.array_equal(frames[0], frames[-1]))


def within_span(grid: Grid, span: tuple[float, float] | None) -> Grid:
    """Return the part of a grid of time between two times [s].

    Raises:
        InputError: They leave fewer than 10 steps.
    """
    if span is None:
        return grid
    times = grid.times
    first, last = np.searchsorted(times, (span[0] - 1e-9, span[1] + 1e-9))
    if last - first < 10:
        raise InputError(
            f"nothing to compare from {span[0]:g} s to {span[1]:g} s: recording and scene have "
            f"{times[0]:.6g} s to {times[-1]:.6g} s in common"
        )
    return replace(grid, begin=float(times[first]), steps=int(last - first))


def choose_windows(
    events: Events,
    scene: Scene,
    grid: Grid,
    pixels: int,
    *,
    unbroken: bool = False,
    compared: float = 1.0,
    plenty: float = math.inf,
    settings: WindowSettings = WindowSettings(),
) -> tuple[Grid, ...]:
    """Return the windows of a grid of time that are compared, in order: all of it where it is short.

    Args:
        events: What was measured.
        scene: What the camera saw.
        grid: All time that both have.
        pixels: That are looked at, in each part.
        unbroken: Whether time must go on without a break, so that there is one window.
        compared: Share of the events that lie where the scene is trusted.
        plenty: Events of the pixels that are looked at from which on a longer time tells little more;
            `settings.shortest` it is at least.
        settings: How much is compared.
    """
    usual_rate = len(events) / (grid.step * grid.steps * scene.width * scene.height)
    each = max(compared * usual_rate * pixels, 1e-9)
    most = int(min(settings.longest, max(settings.shortest, plenty / each) / grid.step))
    if is_constant(scene):
        # the later 40 % judge
        needed = settings.enough / max(0.4 * pixels * usual_rate, 1e-9)
        most = int(min(max(settings.rest, needed) / grid.step, 2.5 * settings.longest))
    if grid.steps <= 1.25 * most:
        return (grid,)
    count = 1 if unbroken else max(1, min(settings.windows, int(most * grid.step / settings.shortest)))
    for number in range(count, 1, -1):
        each = most // number
        first, counts, usual = _count_windows(events, grid, each, settings)
        alike = first[(counts >= usual / settings.like) & (counts <= usual * settings.like)]
        chosen = _spread_apart(alike, number, each)
        if len(chosen) == number:
            return tuple(replace(grid, begin=grid.begin + grid.step * at, steps=each) for at in chosen)
    first, counts, usual = _count_windows(events, grid, most, settings)
    at = int(first[np.argmin(np.abs(counts - usual))])
    return (replace(grid, begin=grid.begin + grid.step * at, steps=most),)


def _count_windows(
    events: Events, grid: Grid, steps: int, settings: WindowSettings
) -> tuple[NDArray[np.int64], NDArray[np.int64], float]:
    """Return first steps of windows over the length, the events of each, (K,), and those of a usual one."""
    first = np.unique(np.linspace(0, grid.steps - steps, settings.looks).astype(np.int64))
    begin = grid.begin + grid.step * first
    counts = np.searchsorted(events.t, begin + grid.step * steps) - np.searchsorted(events.t, begin)
    return first, counts, float(np.quantile(counts, settings.quantile))


def _spread_apart(first: NDArray[np.int64], number: int, steps: int) -> list[int]:
    """Return first steps of windows that do not overlap, spread over those there are; maybe fewer.

    Args:
        first: Of the windows to choose from, increasing, shape (K,).
        number: Windows wanted.
        steps: Of each.
    """
    chosen: list[int] = []
    for place in np.linspace(0, len(first) - 1, number):
        free = [at for at in first.tolist() if not chosen or at >= chosen[-1] + steps]
        if not free:
            break
        wanted = int(first[int(place)])
        chosen.append(min(free, key=lambda at: abs(at - wanted)))
    return chosen


def sentence_of_windows(whole: Grid, windows: tuple[Grid, ...]) -> str:
    """Return which part of the time is compared, in words."""
    length = sum(one.step * (one.steps - 1) for one in windows)
    ends = [(one.begin, one.begin + one.step * (one.steps - 1)) for one in windows]
    parts = [f"from {begin:.3g} s to {end:.3g} s" for begin, end in ends]
    return (
        f"{length:.3g} s of {whole.step * (whole.steps - 1):.3g} s are compared, {', '.join(parts)}; "
        "another part is chosen by its times (--from, --to)"
    )


def repeated_gaps(t: NDArray[np.float64], settings: WindowSettings = WindowSettings()) -> NDArray[np.float64]:
    """Return begin and end of gaps in which data are missing [s], shape (G, 2); none unless they repeat.

    Args:
        t: Times of all events of a sensor [s], sorted.
        settings: What counts as missing data.
    """
    none = np.zeros((0, 2))
    if len(t) < 2 * settings.around:
        return none
    before, after = t[:-1], t[1:]
    length = after - before
    least = max(settings.gap, settings.around * float(t[-1] - t[0]) / len(t))
    at = np.flatnonzero(length >= least)
    busy = [
        np.searchsorted(t, before[at], "right") - np.searchsorted(t, before[at] - length[at]),
        np.searchsorted(t, after[at] + length[at]) - np.searchsorted(t, after[at]),
    ]
    at = at[np.minimum(*busy) >= settings.around]
    if len(at) < settings.gaps:
        return none
    usual = float(np.median(length[at]))
    at = at[np.abs(length[at] - usual) <= settings.alike * usual]
    if len(at) < settings.gaps or length[at].sum() > settings.share * float(t[-1] - t[0]):
        return none
    return np.stack([before[at], after[at]], 1)


def outside_gaps(gaps: NDArray[np.float64]) -> Callable[[NDArray[np.float64]], NDArray[np.bool_]]:
    """Return what tells which times lie outside of all gaps (G, 2), the steps at their ends included."""

    def outside(times: NDArray[np.float64]) -> NDArray[np.bool_]:
        step = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
        place = np.searchsorted(gaps[:, 0] - step, times, "right") - 1
        out: NDArray[np.bool_] = (place < 0) | (times > gaps[np.maximum(place, 0), 1] + step)
        return out

    return outside
