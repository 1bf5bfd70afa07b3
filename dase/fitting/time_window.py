"""Which part of a recording's time is compared: a long one would cost much and tell little more."""

from __future__ import annotations

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
    looks: int = 40
    """Windows over the length that are looked at."""
    quantile: float = 0.75
    """The window is taken in which this share of them has fewer events: neither a flash nor a pause."""
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


def choose_window(
    events: Events, scene: Scene, grid: Grid, pixels: int, settings: WindowSettings = WindowSettings()
) -> Grid:
    """Return the part of a grid of time that is compared.

    Args:
        events: What was measured.
        scene: What the camera saw.
        grid: All time that both have.
        pixels: That are looked at, in each half.
        settings: How much is compared.
    """
    most = settings.longest
    if is_constant(scene):
        rate = len(events) / (grid.step * grid.steps * scene.width * scene.height)
        # the later 40 % judge
        needed = settings.enough / max(0.4 * pixels * rate, 1e-9)
        most = int(min(max(settings.rest, needed) / grid.step, 2.5 * most))
    if grid.steps <= 1.25 * most:
        return grid
    first = np.unique(np.linspace(0, grid.steps - most, settings.looks).astype(np.int64))
    begin = grid.begin + grid.step * first
    counts = np.searchsorted(events.t, begin + grid.step * most) - np.searchsorted(events.t, begin)
    wanted = np.quantile(counts, settings.quantile)
    chosen = int(np.argmin(np.abs(counts - wanted)))
    return replace(grid, begin=float(begin[chosen]), steps=most)


def sentence_of_window(whole: Grid, part: Grid) -> str:
    """Return which part of the time is compared, in words."""
    end = part.begin + part.step * (part.steps - 1)
    return (
        f"{end - part.begin:.3g} s of {whole.step * (whole.steps - 1):.3g} s are compared, from "
        f"{part.begin:.3g} s to {end:.3g} s; another part is chosen by its times (--from, --to)"
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
