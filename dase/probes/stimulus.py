"""What some pixels of a scene see: the light that drives a model, and the cells events are sorted into."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from dase.kernels import launch, pixel_codegen_trials
from dase.kernels.event_probes import BANDS, CELLS, KINDS, MASKED, RESTING
from dase.scenes.scene import Scene

Trust = Callable[[NDArray[np.float64], NDArray[np.int32]], NDArray[np.bool_]]
"""Times (K,) and pixels (N,) to whether the scene is to be trusted there, shape (K, N)."""


@dataclass(frozen=True)
class StimulusSettings:
    """How light is sampled, and by what its changes are sorted into cells."""

    common_step: float = 1e-3
    """Steps of the grid [s] where a scene has none of its own that are equal and neither too fine nor too
    coarse."""

    finest_step: float = 2.5e-4
    """Finest steps of a scene that are taken [s]: finer ones would take long and show nothing more."""

    coarsest_step: float = 2e-3
    """Coarsest steps of a scene that are taken [s]: coarser ones miss what fast pixels show."""

    growth: float = 0.1
    """Samples grow apart by this share of the time since the light of a pixel last changed: coarse where
    nothing happens, yet fine enough for filters that still settle. With 0.3 of it, intervals of two slow
    poles at rest were 4.6 standard deviations of a recording off, and their damping 1.5; with a tenth 0.5."""

    still: float = 0.02
    """Light that changes by less is at rest [log intensity]."""

    rest: tuple[float, float] = (0.2, 0.06)
    """How long the light has been at rest for the first two kinds of cells [s]."""

    span: float = 0.016
    """The light's change is taken over this time [s]."""

    edges: tuple[float, float, float, float] = (-0.25, -0.04, 0.04, 0.25)
    """Between the five bins of the change [log intensity]."""


STIMULUS = StimulusSettings()
AT_ONCE = 128
"""Pixels whose steps are looked at together, for the memory that takes."""


@dataclass(frozen=True)
class Grid:
    """Equal steps of time.

    Args:
        begin: Time of point 0 [s].
        step: From point to point [s].
        steps: Number of points.
    """

    begin: float
    step: float
    steps: int

    @property
    def times(self) -> NDArray[np.float64]:
        """Times of the points [s]."""
        out: NDArray[np.float64] = self.begin + np.float64(self.step) * np.arange(self.steps)
        return out


@dataclass(eq=False)
class Stimulus:
    """Light of some pixels on a grid of time.

    Args:
        pixels: Row-major indices, shape (N,).
        width: Columns of the sensor.
        height: Rows of the sensor.
        grid: The time.
        intensity: Linear, float32, shape (N, T); a view of one column where no light ever changes.
        cell: Cell of each pixel and step, uint8, shape (N, T); `MASKED` where nothing is compared.
        log_eps: Added to intensities before the logarithm.
        device: Where kernels run.
        holes: Whether parts of the time of some pixels are not compared, and others after them are.
    """

    pixels: NDArray[np.int32]
    width: int
    height: int
    grid: Grid
    intensity: NDArray[np.float32]
    cell: NDArray[np.uint8]
    log_eps: float
    device: Any
    holes: bool = False
    _kept: dict[str, Any] = field(default_factory=dict, repr=False)

    @property
    def at_rest(self) -> bool:
        """Whether no light ever changes."""
        return self.intensity.strides[1] == 0

    @property
    def never_changes(self) -> bool:
        """Whether the light of every pixel stays within what counts as at rest."""
        return self.at_rest or bool(np.ptp(self.level, axis=1).max() < STIMULUS.still)

    @property
    def level(self) -> NDArray[np.float32]:
        """Log intensity, shape (N, T), or (N, 1) where it never changes."""
        light = self.intensity[:, :1] if self.at_rest else self.intensity
        out: NDArray[np.float32] = np.log(light + np.float32(self.log_eps))
        return out

    def share_at_rest(self) -> float:
        """Return the share of the compared time of all pixels in which light has been at rest for a while."""
        time = self.exposure().reshape(KINDS, BANDS)
        return float(time[:RESTING].sum() / max(float(time.sum()), 1e-12))

    def exposure(self) -> NDArray[np.float64]:
        """Return the time spent in each cell, summed over pixels [px s], shape (CELLS,)."""
        # counting makes 8 bytes of each, so some pixels at a time
        parts = (
            np.bincount(self.cell[n : n + AT_ONCE].reshape(-1), minlength=256)
            for n in range(0, len(self.cell), AT_ONCE)
        )
        steps = sum(parts, np.zeros(256, np.int64))[:CELLS]
        out: NDArray[np.float64] = np.float64(self.grid.step) * steps
        return out

    def part(self, count: int) -> Stimulus:
        """Return the stimulus of the first `count` pixels."""
        cut = slice(0, count)
        return Stimulus(
            self.pixels[cut], self.width, self.height, self.grid, self.intensity[cut], self.cell[cut],
            self.log_eps, self.device, self.holes,
        )  # fmt: skip

    def history(self, finer: int = 0) -> Any:
        """Return the light as a kernel of many models takes it.

        Args:
            finer: 0 leaves out samples where nothing changes; n > 0 takes n samples per step everywhere, by
                straight lines between those that are stored.
        """
        if "history" not in self._kept:
            self._kept["history"] = self._sparse()
        out, stored = pixel_codegen_trials.LightHistory(), self._kept["history"]
        out.start, out.stamp = stored["start"], stored["stamp"]
        out.intensity, out.voltage = stored["intensity"], stored["voltage"]
        out.log_eps, out.finer, out.step = self.log_eps, finer, self.grid.step / max(finer, 1)
        return out

    def light_at(self, points: NDArray[np.int64], finer: int) -> NDArray[np.float32]:
        """Return the intensity at points of a finer grid, between whose own its logarithm runs straight.

        Args:
            points: Places on the finer grid, shape (K,).
            finer: Its points per step.

        Returns:
            Linear intensities, shape (N, K).
        """
        below = np.minimum(points // finer, self.intensity.shape[1] - 2)
        share = (points / finer - below).astype(np.float32)
        low, high = self.intensity[:, below], self.intensity[:, below + 1]
        eps = np.float32(self.log_eps)
        between = np.exp(np.log(low + eps) * (1 - share) + np.log(high + eps) * share) - eps
        # what is on the grid itself, or at rest, stays as it is
        out: NDArray[np.float32] = np.where(share == 0, low, np.where(share == 1, high, between))
        return np.maximum(np.where(low == high, low, out), 0)

    def finer_light(self, finer: int, most_bytes: int = 1 << 28) -> Any | None:
        """Return the intensity at the points of a finer grid on the device, shape (K, N); the last is kept.

        Args:
            finer: Points per step.
            most_bytes: What it may take.

        Returns:
            None where it takes more.
        """
        points = np.arange((self.grid.steps - 1) * finer + 1)
        if 4 * len(points) * len(self.pixels) > most_bytes:
            return None
        name = f"light {finer}"
        if name not in self._kept:
            for other in [one for one in self._kept if one.startswith("light ")]:
                del self._kept[other]
        return self.array(name, lambda: self.light_at(points, finer).T)

    def array(self, name: str, make: Callable[[], NDArray[Any]]) -> Any:
        """Return an array on the device, of the shape that `make` gives it; made and moved there once."""
        if name not in self._kept:
            # on a CPU the array itself is taken, not a copy: nothing here is ever written to
            self._kept[name] = wp.array(np.ascontiguousarray(make()), device=self.device, copy=False)
        return self._kept[name]

    def _sparse(self) -> dict[str, Any]:
        count, steps = self.intensity.shape
        gaps = [0]
        while gaps[-1] < steps:
            gaps.append(gaps[-1] + max(1, int(STIMULUS.growth * gaps[-1])))
        due = np.zeros(steps + 1, np.bool_)
        due[[gap for gap in gaps if gap <= steps]] = True
        # some pixels at a time: what is kept is little, what tells it is large
        parts = [
            _kept_samples(self.intensity[n : n + AT_ONCE], due) for n in range(0, max(count, 1), AT_ONCE)
        ]
        many, at, light = (np.concatenate(column) for column in zip(*parts, strict=True))
        start = np.concatenate([[0], np.cumsum(many)])
        kinds = {"start": (start, np.int32), "stamp": (at, np.int32), "intensity": (light, np.float32)}
        kinds["voltage"] = (np.log(light + np.float32(self.log_eps)), np.float32)
        return {
            name: wp.array(values.astype(kind, copy=False), device=self.device, copy=False)
            for name, (values, kind) in kinds.items()
        }


def _kept_samples(
    light: NDArray[np.float32], due: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    """Return which samples of some pixels are kept.

    Args:
        light: Linear, shape (N, T).
        due: Whether a sample is kept so many steps after the light last changed, shape (T + 1,).

    Returns:
        Samples of each pixel, shape (N,); their steps and intensities, pixel by pixel, shape (S,).
    """
    changed = np.zeros(light.shape, np.bool_)
    changed[:, 1:] = light[:, 1:] != light[:, :-1]
    index = np.arange(light.shape[1], dtype=np.int32)
    since = index - np.maximum.accumulate(np.where(changed, index, np.int32(0)), axis=1)
    keep = due[since]
    keep[:, :-1] |= changed[:, 1:]  # the end of each rest
    keep[:, [0, 1, -1]] = True  # a pixel's phase is set by where the light goes in the first step
    row, at = np.nonzero(keep)
    return keep.sum(1), at, light[row, at]


def light_of(
    scene: Scene, times: NDArray[np.float64], pixels: NDArray[np.int32], *, at_once: int = 256
) -> NDArray[np.float32]:
    """Return the linear intensity of some pixels at some times, shape (N, T).

    Args:
        scene: What they see.
        times: Increasing [s], shape (T,).
        pixels: Row-major indices, shape (N,).
        at_once: Frames that are rendered together, for their memory.
    """
    out = np.empty((len(pixels), len(times)), np.float32)
    for first in range(0, len(times), at_once):
        values, light = _values_of(scene, times[first : first + at_once], pixels)
        out[:, first : first + at_once] = (values if light is None else light[values]).T
    return out


def log_light_of(
    scene: Scene,
    times: NDArray[np.float64],
    pixels: NDArray[np.int32],
    *,
    log_eps: float,
    at_once: int = 256,
) -> NDArray[np.float32]:
    """Return the log intensity of some pixels at some times, shape (T, N): one instant after the other.

    Args:
        scene: What they see.
        times: Increasing [s], shape (T,).
        pixels: Row-major indices, shape (N,).
        log_eps: Added to intensities before the logarithm.
        at_once: Frames that are rendered together, for their memory.
    """
    eps = np.float32(log_eps)
    out = np.empty((len(times), len(pixels)), np.float32)
    for first in range(0, len(times), at_once):
        values, light = _values_of(scene, times[first : first + at_once], pixels)
        part = out[first : first + at_once]
        if light is None:
            np.log(np.add(values, eps, out=part), out=part)
        else:
            np.take(np.log(light + eps), values, out=part)
    return out


def log_light_beside(
    scene: Scene,
    times: NDArray[np.float64],
    pixels: NDArray[np.int32],
    at: NDArray[np.int64],
    which: NDArray[np.int64],
    *,
    log_eps: float,
    reach: int = 1,
    at_once: int = 256,
) -> NDArray[np.float32]:
    """Return the log intensity of single pixels at the instants about some, shape (2 * reach, N).

    From `reach` - 1 before the instant of each to `reach` behind it; what lies beyond the first or the last
    instant is that one.

    Args:
        scene: What they see.
        times: Increasing [s], shape (T,).
        pixels: Row-major indices, shape (P,).
        at: Which of the times, ascending, shape (N,).
        which: Of the pixels, shape (N,).
        log_eps: Added to intensities before the logarithm.
        reach: Instants on either side.
        at_once: Frames that are rendered together, for their memory.
    """
    eps, count = np.float32(log_eps), len(times)
    out = np.empty((2 * reach, len(at)), np.float32)
    # one instant after the other: of all light only what is asked for is looked up, and stays near
    firsts = np.arange(0, count, at_once)
    ends = np.searchsorted(at, np.append(firsts, count))
    for first, begin, end in zip(firsts.tolist(), ends[:-1].tolist(), ends[1:].tolist(), strict=True):
        if begin == end:
            continue
        low, high = max(first - reach + 1, 0), min(first + at_once + reach, count)
        values, light = _values_of(scene, times[low:high], pixels)
        flat, log_of_level = values.reshape(-1), None if light is None else np.log(light + eps)
        for n, part in enumerate(out[:, begin:end]):
            instant = np.clip(at[begin:end] + (n + 1 - reach), 0, count - 1) - low
            found = flat[instant * len(pixels) + which[begin:end]]
            if log_of_level is None:
                np.log(np.add(found, eps, out=part), out=part)
            else:
                np.take(log_of_level, found, out=part)
    return out


def _values_of(
    scene: Scene, times: NDArray[np.float64], pixels: NDArray[np.int32]
) -> tuple[NDArray[Any], NDArray[np.float32] | None]:
    """Return the intensities of some pixels at some times (T, N), or their levels and the light of each."""
    name, source = scene.source(times, pixels, launch.find_device("cpu"))
    if name == "frames":
        return source.values.numpy(), None
    if name == "levels":
        return source.values.numpy(), source.light.numpy()
    return scene.frames(times).reshape(len(times), -1)[:, pixels], None


def sort_into_cells(
    intensity: NDArray[np.float32], step: float, bands: NDArray[np.float64], log_eps: float
) -> NDArray[np.uint8]:
    """Return the cell of each pixel and step, uint8, shape (N, T).

    Args:
        intensity: Linear, shape (N, T).
        step: Of the grid [s].
        bands: Intensities between the bands, shape (BANDS - 1,).
        log_eps: Added to intensities before the logarithm.
    """
    if intensity.strides[1] == 0:  # at rest from the begin on, and never in another band
        cell = np.searchsorted(bands, intensity[:, 0]).astype(np.uint8)
        return np.repeat(cell[:, None], intensity.shape[1], 1)
    level = np.log(intensity + np.float32(log_eps))
    kind = np.searchsorted(STIMULUS.edges, _light_change(level, step)).astype(np.uint8) + RESTING
    for number, time in reversed(list(enumerate(STIMULUS.rest))):
        width = max(2, round(time / step))
        # a window that ends at the step; before the first one the light was at rest
        shift = dict(size=width, axis=1, mode="nearest", origin=(width - 1) // 2)
        spread = maximum_filter1d(level, **shift) - minimum_filter1d(level, **shift)
        kind[spread < STIMULUS.still] = number
    return kind * BANDS + np.searchsorted(bands, intensity).astype(np.uint8)


def _light_change(level: NDArray[np.float32], step: float) -> NDArray[np.float32]:
    back = max(1, round(STIMULUS.span / step))
    before = np.concatenate([np.repeat(level[:, :1], back, 1), level[:, :-back]], axis=1)
    out: NDArray[np.float32] = level - before[:, : level.shape[1]]
    return out


def band_edges(intensity: NDArray[np.float32], compared: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the intensities between the bands, shape (BANDS - 1,): quantiles of what is compared.

    Args:
        intensity: Of pixels and times, shape (N, T).
        compared: Which of these are, shape (N, T).
    """
    # of light that never changes all times have the same quantiles
    values = intensity[:, 0] if intensity.strides[1] == 0 else intensity[compared]
    return np.quantile(values, (0.15, 0.4, 0.7)) if len(values) else np.array([0.1, 0.3, 0.6])


__all__ = [
    "CELLS", "KINDS", "MASKED", "Grid", "Stimulus", "Trust", "band_edges", "light_of", "sort_into_cells",
]  # fmt: skip
