"""Windows of a long recording laid end to end: one clock for what is compared, however long the recording."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dase.events import Events
from dase.probes.stimulus import Grid
from dase.scenes.scene import Scene

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SplicedTime:
    """Windows of time laid end to end.

    Args:
        windows: In order and apart, with one step.
        moments: Time of each of their points on the clock of the recording [s], shape (T,).
        settle: Steps at the begin of each window but the first that are not compared: the light has leapt,
            and what a pixel remembers is of another window.
    """

    windows: tuple[Grid, ...]
    moments: Array
    settle: int

    @property
    def grid(self) -> Grid:
        """The points of all windows as if they followed each other, from the begin of the first on."""
        return replace(self.windows[0], steps=sum(one.steps for one in self.windows))

    @property
    def firsts(self) -> NDArray[np.int64]:
        """The first point of each window, shape (W,)."""
        steps = [one.steps for one in self.windows]
        return np.cumsum([0, *steps[:-1]])

    def real(self, times: Array) -> Array:
        """Return times of the spliced clock [s], any shape, as those of the recording."""
        grid = self.grid
        place = (times - grid.begin) / grid.step
        at = np.clip(np.floor(place + 1e-6), 0, grid.steps - 1).astype(np.int64)
        beyond = place - at
        out: Array = self.moments[at] + np.where(np.abs(beyond) < 1e-5, 0.0, beyond * grid.step)
        return out

    def events(self, events: Events) -> Events:
        """Return the events of the windows, with times of the spliced clock."""
        grid, kept, moved = self.grid, [], []
        for window, first in zip(self.windows, self.firsts, strict=True):
            last = window.begin + window.step * (window.steps - 1)
            part = np.arange(*np.searchsorted(events.t, (window.begin, np.nextafter(last, np.inf))))
            kept.append(part)
            moved.append(events.t[part] - (window.begin - (grid.begin + grid.step * first)))
        return replace(events.select(np.concatenate(kept)), t=np.concatenate(moved))

    def settled(self, times: Array) -> NDArray[np.bool_]:
        """Return which times of the spliced clock [s], shape (T,), may be compared."""
        grid = self.grid
        at = np.rint((times - grid.begin) / grid.step).astype(np.int64)
        firsts = self.firsts
        window = np.maximum(np.searchsorted(firsts, at, "right") - 1, 0)
        out: NDArray[np.bool_] = (window == 0) | (at - firsts[window] >= self.settle)
        return out


class SplicedScene(Scene):
    """A scene on a spliced clock.

    Args:
        scene: On the clock of the recording.
        time: Which of its time, and in which order.
    """

    def __init__(self, scene: Scene, time: SplicedTime):
        self._scene, self._time = scene, time
        self.width, self.height = scene.width, scene.height
        self.anytime = scene.anytime
        self.duration = time.grid.step * (time.grid.steps - 1)

    def sample_times(self) -> Array:
        """Return the points of the windows on the spliced clock [s]."""
        return self._time.grid.times

    def source(self, times: Array, pixels: NDArray[np.int32], device: Any) -> tuple[str, Any]:
        """Return the scene's source at spliced times (K,) [s] for pixels (N,); see `Scene.source`."""
        return self._scene.source(self._time.real(times), pixels, device)

    def frames(self, times: Array, device: str = "cpu") -> NDArray[np.float32]:
        """Return the scene's own frames at these times, shape (K, height, width)."""
        return self._scene.frames(self._time.real(times), device)
