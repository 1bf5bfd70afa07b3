"""Scenes of moving textures."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from dase.errors import InputError
from dase.kernels import host_blocks, launch, scene_render
from dase.kernels import scene_layers as kernels
from dase.scenes.image_sources import Picture
from dase.scenes.scene import SamplingSettings, Scene

Pair = tuple[float, float]

QUANTITIES = ("x", "y", "angle", "scale_x", "scale_y")
"""What a motion says, in this order wherever it becomes an array."""


@dataclass(frozen=True)
class Wave:
    """A sine that sways one quantity of a motion: amplitude · sin(2π frequency t + phase).

    Args:
        quantity: One of `QUANTITIES`.
        amplitude: In the unit of the quantity.
        frequency: [Hz].
        phase: [rad].
    """

    quantity: str
    amplitude: float
    frequency: float
    phase: float = 0.0

    def __post_init__(self) -> None:
        if self.quantity not in QUANTITIES:
            raise InputError(f"wave: quantity must be one of {', '.join(QUANTITIES)}, got '{self.quantity}'")
        if not np.all(np.isfinite((self.amplitude, self.frequency, self.phase))):
            raise InputError("wave: amplitude, frequency and phase must be finite")


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Affine motion: each pair holds the value at the beginning and at the end of a scene, straight between.

    Lengths are in widths of the sensor, so that a scene keeps its looks when the sensor size changes. Waves
    sway what would go straight, as a hand does; in a pause everything stands still, and goes on behind it.

    Args:
        x: Horizontal place of the centre, 0 is the middle of the picture.
        y: Vertical place of the centre.
        angle: Rotation [rad].
        scale_x: Horizontal scale; at 1 the texture is as wide as the sensor.
        scale_y: Vertical scale.
        waves: Added to the straight line; their phases are those at the beginning.
        pauses: Begin and end of each [s], one after the other.
    """

    x: Pair = (0.0, 0.0)
    y: Pair = (0.0, 0.0)
    angle: Pair = (0.0, 0.0)
    scale_x: Pair = (1.0, 1.0)
    scale_y: Pair = (1.0, 1.0)
    waves: tuple[Wave, ...] = ()
    pauses: tuple[Pair, ...] = ()

    def __post_init__(self) -> None:
        for name in QUANTITIES:
            if not np.all(np.isfinite(getattr(self, name))):
                raise InputError(f"motion: {name} must be finite, got {getattr(self, name)}")
        for name in ("scale_x", "scale_y"):
            sway = sum(abs(wave.amplitude) for wave in self.waves if wave.quantity == name)
            if min(getattr(self, name)) - sway <= 0:
                swayed = f" swayed by {sway:g}" if sway else ""
                raise InputError(f"motion: scales must be > 0, got {self.scale_x} and {self.scale_y}{swayed}")
        edges = [edge for pause in self.pauses for edge in pause]
        if not np.all(np.isfinite(edges)) or not np.all(np.diff(edges) >= 0):
            raise InputError(f"motion: pauses must follow each other, got {self.pauses}")

    def path(
        self, times: NDArray[np.float64], duration: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the quantities at `times` [s] of a scene of `duration` [s] and their rates [1/s], (5, T)."""
        value, rate = _paths([self], times, duration)
        return value[0], rate[0]


def _paths(
    motions: Sequence[Motion], times: NDArray[np.float64], duration: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the quantities of motions at `times` [s], and their rates [1/s], each of shape (L, 5, T)."""
    times = np.asarray(times, np.float64)
    awake, moving = np.tile(times, (len(motions), 1)), np.ones((len(motions), len(times)))
    for motion, now, goes in zip(motions, awake, moving, strict=True):
        for begin, end in motion.pauses:
            now -= np.clip(times - begin, 0, end - begin)
            goes[(times >= begin) & (times < end)] = 0
    ends = np.array([[getattr(motion, name) for name in QUANTITIES] for motion in motions], np.float64)
    way = (ends[..., 1] - ends[..., 0])[..., None]
    value = ends[..., :1] + (awake / duration)[:, None] * way
    rate = way / duration + 0 * value
    for n, motion in enumerate(motions):
        for wave in motion.waves:
            turn = 2 * np.pi * wave.frequency
            row = QUANTITIES.index(wave.quantity)
            value[n, row] += wave.amplitude * np.sin(turn * awake[n] + wave.phase)
            rate[n, row] += wave.amplitude * turn * np.cos(turn * awake[n] + wave.phase)
    return value, rate * moving[:, None]


@dataclass(frozen=True)
class Lighting:
    """Light on a scene that changes: all intensities are multiplied by one factor in (0, 1].

    The factor is 2 to the power of -stops (1 + sin(2π frequency t + phase)) / 2, and of `drops` beside it.

    Args:
        stops: How far it sways, in powers of two, at least 0.
        frequency: [Hz].
        phase: [rad].
        drops: Times [s] at which it changes at once, and by how many powers of two from then on; the sums
            of them stay at most 0.
    """

    stops: float = 0.0
    frequency: float = 1.0
    phase: float = 0.0
    drops: tuple[Pair, ...] = ()

    def __post_init__(self) -> None:
        sums = np.cumsum([0.0, *(drop for _, drop in sorted(self.drops))])
        if not (self.stops >= 0 and np.all(sums <= 1e-9)):
            raise InputError(
                "lighting: nothing may be brighter than full light: stops >= 0, sums of drops <= 0"
            )

    def factor(self, times: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return what intensities are multiplied by at `times` [s], shape (T,)."""
        sway = 0.5 * self.stops * (1 + np.sin(2 * np.pi * self.frequency * np.asarray(times) + self.phase))
        level = sum((np.where(np.asarray(times) >= at, drop, 0.0) for at, drop in self.drops), -sway)
        return np.exp2(np.minimum(level, 0)).astype(np.float32)


@dataclass(frozen=True)
class Layer:
    """A texture and its motion."""

    picture: Picture
    motion: Motion


class LayerScene(Scene):
    """Textured layers that move over each other.

    The renderer of S2R (Stoffregen et al., Reducing the sim-to-real gap for event cameras, 2020): rotation,
    translation and x and y scale are linear in time, layers are composited back to front, the background is
    continued by reflection. Unlike there, textures keep their aspect ratio, motions may be swayed by waves,
    and a camera may move before all of them.

    Args:
        layers: Background first, at most 32.
        width: Columns [px].
        height: Rows [px].
        duration: Length [s].
        camera: Motion of the picture as a whole, after that of each layer: rotation and scale are about the
            middle of the picture. None for a camera at rest.
        lighting: Light on the scene, None for full light all the time.
        travel: Share of a pixel that anything may move between two samples (λ of Eq. 5 of the paper).
        shortest: Lower bound of the time between samples [s] (δ of Eq. 5).
        longest: Upper bound of it [s]; S2R samples at 72 Hz at least.
        shifts: How far to the right each layer is seen, behind all motion [px], shape (L,); None for nowhere.
    """

    anytime = True

    def __init__(
        self,
        layers: Sequence[Layer],
        *,
        width: int,
        height: int,
        duration: float,
        camera: Motion | None = None,
        lighting: Lighting | None = None,
        travel: float = SamplingSettings.travel,
        shortest: float = SamplingSettings.shortest,
        longest: float = SamplingSettings.longest,
        shifts: Sequence[float] | None = None,
    ):
        if not 1 <= len(layers) <= kernels.MAX_LAYERS:
            raise InputError(f"a scene needs 1 to {kernels.MAX_LAYERS} layers, got {len(layers)}")
        if width < 1 or height < 1:
            raise InputError(f"scene size must be at least 1x1, got {width}x{height}")
        if not duration > 0 or not np.isfinite(duration):
            raise InputError(f"scene duration must be > 0 s, got {duration:g}")
        if not 0 < shortest <= longest or not travel > 0:
            raise InputError(
                "sampling needs 0 < shortest <= longest and travel > 0, "
                f"got {shortest:g}, {longest:g} and {travel:g}"
            )
        if shifts is not None and not (len(shifts) == len(layers) and np.all(np.isfinite(shifts))):
            raise InputError(f"a scene of {len(layers)} layers needs as many finite shifts, got {shifts}")
        self.shifts = None if shifts is None else tuple(map(float, shifts))
        self.layers = tuple(layers)
        self.width, self.height, self.duration = width, height, duration
        self.camera, self.lighting = camera, lighting
        self.travel, self.shortest, self.longest = travel, shortest, longest
        self._from_texture: NDArray[np.float64] | None = None  # to the unit plane, of each layer
        self._uploaded: dict[str, Any] = {}
        self._placed: tuple[tuple[str, bytes], kernels.Layers] | None = None  # at the times asked for last

    def like(
        self, *, layers: Sequence[Layer] | None = None, shifts: Sequence[float] | None = None
    ) -> LayerScene:
        """Return the same scene with other layers or shifts."""
        return LayerScene(
            self.layers if layers is None else layers, width=self.width, height=self.height,
            duration=self.duration, camera=self.camera, lighting=self.lighting, travel=self.travel,
            shortest=self.shortest, longest=self.longest, shifts=self.shifts if shifts is None else shifts,
        )  # fmt: skip

    def filtered(self, purity: float) -> tuple[Scene, Scene, Scene] | None:
        """Return the scene behind a red, a green and a blue filter; see `Scene.filtered`."""
        if all(layer.picture.colour is None for layer in self.layers):
            return None
        red, green, blue = (
            self.like(layers=[replace(one, picture=one.picture.filtered(c, purity)) for one in self.layers])
            for c in range(3)
        )
        return red, green, blue

    def forward(self, times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return texture-to-sensor maps M(t) and their time derivatives, each of shape (T, L, 3, 3)."""
        m, d = _affine_maps([layer.motion for layer in self.layers], times, self.duration)
        if self.camera is not None:
            camera, camera_rate = _affine_maps([self.camera], times, self.duration)
            m, d = camera @ m, camera_rate @ m + camera @ d
        if self.shifts is not None:
            m[..., 0, 2] += np.array(self.shifts) / self.width
        # motions are in units of the sensor's width, so a scene looks the same at any size
        to_sensor = _unit_plane_to_pixels(self.width, self.height, self.width)
        if self._from_texture is None:
            planes = [self._texture_plane(layer) for layer in range(len(self.layers))]
            self._from_texture = np.linalg.inv(np.stack(planes))
        return to_sensor @ m @ self._from_texture, to_sensor @ d @ self._from_texture

    def _texture_plane(self, layer: int) -> NDArray[np.float64]:
        """Return the map from the unit plane to texels of a layer."""
        h, w = self.layers[layer].picture.grey.shape
        if layer == 0:
            # at scale 1 the background covers the sensor
            return _unit_plane_to_pixels(w, h, min(w, h * self.width / self.height))
        return _unit_plane_to_pixels(w, h, max(w, h))

    def velocity(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return maps from sensor coordinates to velocity [px/s], shape (T, L, 2, 3)."""
        m, d = self.forward(times)
        return np.asarray((d @ np.linalg.inv(m))[..., :2, :])

    def speed(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the highest speed of any layer inside the picture [px/s], shape (T,).

        Speed is convex over the polygon in which a layer overlaps the picture, so the highest one is found
        at a corner of it. Layers hidden behind others count as well: an upper bound of max|v| of Eq. 5.
        """
        m, d = self.forward(times)
        inverse: NDArray[np.float64] = np.asarray(np.linalg.inv(m), np.float64)
        points, inside = self._corners(m, inverse)
        at, layer, _ = np.nonzero(inside)
        # most candidates are no corners
        v = _mapped((d @ inverse)[at, layer], *points[inside].T)
        highest = np.zeros(len(m))
        np.maximum.at(highest, at, np.linalg.norm(v, axis=-1))
        return highest

    def _outlines(self, m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the corners of all layers on the sensor [px], shape (T, L, 4, 2)."""
        h, w = np.array([layer.picture.grey.shape for layer in self.layers], np.float64).T
        before = np.full(len(w), -1.0)
        x, y = np.stack([before, w, w, before], -1), np.stack([before, before, h, h], -1)
        return _mapped(m[:, :, None], x, y)

    def _corners(
        self, m: NDArray[np.float64], inverse: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return candidates for corners of layer ∩ picture, (T, L, P, 2), and which are."""
        w, h = self.width - 1, self.height - 1
        quad = self._outlines(m)
        frame = np.array([[0, 0], [w, 0], [w, h], [0, h]], np.float64)
        back = _mapped(inverse[:, :, None], *frame.T.astype(np.float64))
        sizes = np.array([layer.picture.grey.shape[::-1] for layer in self.layers])[None, :, None]
        frame_in = np.all((back >= -1) & (back <= sizes), -1)
        frame_in[:, 0] = True  # the background is everywhere
        quad_in = np.all((quad >= 0) & (quad <= [w, h]), -1)
        quad_in[:, 0] = False
        a, b = quad, np.roll(quad, -1, axis=2)
        crossings, crosses = [], []
        for axis, level in ((0, 0), (0, w), (1, 0), (1, h)):
            with np.errstate(divide="ignore", invalid="ignore"):
                share = (level - a[..., axis]) / (b[..., axis] - a[..., axis])
            hit = (share >= 0) & (share <= 1)  # False for the NaN of parallel edges
            at = a + np.where(hit, share, 0.0)[..., None] * (b - a)
            other = at[..., 1 - axis]
            hit &= (other >= 0) & (other <= (w, h)[1 - axis])
            hit[:, 0] = False
            crossings.append(at)
            crosses.append(hit)
        everywhere = np.broadcast_to(frame, (*quad.shape[:2], 4, 2))
        points = np.concatenate([everywhere, quad, *crossings], axis=2)
        inside = np.concatenate([frame_in, quad_in, *crosses], axis=2)
        return points, inside

    def sample_times(self) -> NDArray[np.float64]:
        """Return adaptive sample times [s] by Eq. 5: the step is travel / max|v|, between the two bounds.

        The speed is looked up on a grid of `shortest`; between two grid points the larger value holds.
        """
        cells = max(int(np.ceil(self.duration / self.shortest)), 1)
        grid = np.linspace(0, self.duration, min(cells, 100_000) + 1)
        speed = np.concatenate([self.speed(part) for part in np.array_split(grid, max(len(grid) // 512, 1))])
        # the larger of both ends, so that no step moves further than asked while things get faster
        held = np.maximum(speed[:-1], speed[1:])
        # the way travelled grows with time, so it can be inverted; 1e-9 keeps it growing at rest
        way = np.concatenate([[0.0], np.cumsum(np.maximum(held, 1e-9) * np.diff(grid))])
        times, at, ways = [0.0], grid.tolist(), way.tolist()
        while times[-1] < self.duration:
            now = times[-1]
            # a step may span many cells, and something fast may enter the picture in a later one
            travelled = _interpolated(now, at, ways, ways[-1]) + self.travel
            due = _interpolated(travelled, ways, at, np.inf)
            times.append(now + min(max(due - now, self.shortest), self.longest))
        # the last step ends with the scene; a stub shorter than half the bound is not worth a sample
        if len(times) > 2 and self.duration - times[-2] < 0.5 * self.shortest:
            times.pop()
        times[-1] = self.duration
        return np.array(times)

    def arrays(self, times: NDArray[np.float64], device: wp.Device) -> kernels.Layers:
        """Return textures and motion at `times` [s], shape (K,), on a Warp device; not to be changed."""
        # frames and the flow in them ask one after the other
        asked = device.alias, np.asarray(times, np.float64).tobytes()
        placed = self._placed  # another thread may ask for other times meanwhile
        if placed is None or placed[0] != asked:
            self._placed = placed = asked, self._layers_at(times, device)
        return placed[1]

    def _layers_at(self, times: NDArray[np.float64], device: wp.Device) -> kernels.Layers:
        if device.alias not in self._uploaded:
            textures = [(layer.picture.grey, layer.picture.alpha) for layer in self.layers]
            self._uploaded[device.alias] = kernels.upload_textures(textures, device)
        m, _ = self.forward(times)
        quad = self._outlines(m)
        # only these samples are looked at, so their outlines bound the layer; the pixel is for float32
        box = np.concatenate([quad.min((0, 2)) - 1, quad.max((0, 2)) + 1], -1)
        layers = kernels.Layers()
        layers.grey, layers.texels, layers.start, layers.size = self._uploaded[device.alias]
        layers.place = wp.array(
            np.linalg.inv(m)[..., :2, :].astype(np.float32), dtype=kernels.Affine, device=device
        )
        layers.box = wp.array(box.astype(np.float32), dtype=wp.vec4, device=device)
        layers.count = len(self.layers)
        return layers

    def source(self, times: NDArray[np.float64], pixels: NDArray[np.int32], device: Any) -> tuple[str, Any]:
        """Return the layers themselves: the pixel kernel warps, so no frame is ever stored.

        Under light that changes, frames. Arguments have the shape and unit that `Scene.source` says.
        """
        if self.lighting is not None:
            seen = kernels.Frames()
            lit = self._lit_frames(times, device)
            seen.values = wp.array(np.ascontiguousarray(lit[:, pixels]), dtype=float, device=device)
            return "frames", seen
        return "background" if len(self.layers) == 1 else "layers", self.arrays(times, device)

    def frames(self, times: NDArray[np.float64], device: str = "cpu") -> NDArray[np.float32]:
        """Return intensities in [0, 1] at `times` [s], shape (K, height, width)."""
        lit = self._lit_frames(times, launch.find_device(device))
        return lit.reshape(len(times), self.height, self.width)

    def grey_frames(self, times: NDArray[np.float64], device: str = "cpu") -> NDArray[np.uint8]:
        """Return frames of 8 bits, rendered as such, shape (K, height, width); see `Scene.grey_frames`."""
        if self.lighting is not None:
            return super().grey_frames(times, device)
        where = launch.find_device(device)
        layers = self.arrays(times, where)
        out = scene_render.render_frames(layers, self.width, self.height, where, grey=True)
        return host_blocks.copy_to_host(out).reshape(len(times), self.height, self.width)

    def _exposure_edges(self, begins: NDArray[np.float64], exposure: float) -> Iterator[NDArray[np.float64]]:
        """Yield the edges of even sub-frames of each exposure [s], in which nothing moves over `travel`.

        Samples may lie further apart, for want of time; a blur would show them as ghosts.
        """
        for begin in begins:
            looks = np.linspace(begin, begin + exposure, 17)
            way = float(self.speed(looks).max()) * exposure
            yield np.linspace(begin, begin + exposure, max(int(np.ceil(way / self.travel)), 16) + 1)

    def _first_time(self) -> float:
        return 0.0

    def _lit_frames(self, times: NDArray[np.float64], device: wp.Device) -> NDArray[np.float32]:
        """Return intensities at `times` [s], shape (K, height · width)."""
        layers = self.arrays(times, device)
        out = host_blocks.copy_to_host(scene_render.render_frames(layers, self.width, self.height, device))
        return np.asarray(out if self.lighting is None else out * self.lighting.factor(times)[:, None])

    def flow(self, times: NDArray[np.float64], device: str = "cpu") -> NDArray[np.float32]:
        """Return the flow of the foremost layer at `times` [px/s], shape (K, 2, height, width)."""
        return self._of_foremost(times, self.velocity(times), device)

    def values_of_foremost(
        self, times: NDArray[np.float64], values: NDArray[np.float64], device: str = "cpu"
    ) -> NDArray[np.float32]:
        """Return two numbers of the layer that is foremost at each pixel, shape (K, 2, height, width).

        Args:
            times: When [s], shape (K,).
            values: Of each layer, shape (L, 2).
            device: `cpu`, `cuda` or a Warp name.
        """
        maps = np.zeros((len(times), len(self.layers), 2, 3))
        maps[..., 2] = values
        return self._of_foremost(times, maps, device)

    def _of_foremost(
        self, times: NDArray[np.float64], affine: NDArray[np.float64], device: str
    ) -> NDArray[np.float32]:
        """Return what the maps of the foremost layer, (K, L, 2, 3), make of each pixel's place."""
        where = launch.find_device(device)
        maps = wp.array(affine.astype(np.float32), dtype=kernels.Affine, device=where)
        out = scene_render.render_flow(self.arrays(times, where), maps, self.width, self.height, where)
        return host_blocks.copy_to_host(out).reshape(len(times), 2, self.height, self.width)


def _affine_maps(
    motions: Sequence[Motion], times: NDArray[np.float64], duration: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the affine maps of motions and their time derivatives, each of shape (T, L, 3, 3)."""
    value, rate = _paths(motions, times, duration)
    x, y, angle, sx, sy = value.transpose(1, 2, 0)
    vx, vy, spin, gx, gy = rate.transpose(1, 2, 0)
    c, s = np.cos(angle), np.sin(angle)
    m = np.zeros((*x.shape, 3, 3))
    m[..., 0, 0], m[..., 0, 1], m[..., 0, 2] = sx * c, -sy * s, x
    m[..., 1, 0], m[..., 1, 1], m[..., 1, 2] = sx * s, sy * c, y
    m[..., 2, 2] = 1
    d = np.zeros_like(m)
    d[..., 0, 0], d[..., 0, 1], d[..., 0, 2] = gx * c - sx * s * spin, -gy * s - sy * c * spin, vx
    d[..., 1, 0], d[..., 1, 1], d[..., 1, 2] = gx * s + sx * c * spin, gy * c - sy * s * spin, vy
    return m, d


def _mapped(maps: NDArray[np.float64], x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points under affine maps, (..., 2); maps of shape (..., 2, 3), or more rows that do not count.

    In the order of `np.einsum`, whose bits this has in a quarter of the time.
    """
    x, y = x[..., None], y[..., None]
    maps = maps[..., :2, :]
    return np.asarray((maps[..., 0] * x + maps[..., 2]) + maps[..., 1] * y)


def _interpolated(at: float, x: list[float], y: list[float], beyond: float) -> float:
    """Return what `np.interp` of one number does, to the bit, in a fiftieth of the time; `beyond` x, that."""
    n = bisect_right(x, at) - 1
    if n < 0:
        return y[0]
    if n == len(x) - 1:
        return y[n] if at == x[n] else beyond
    if x[n] == at:
        return y[n]
    return (y[n + 1] - y[n]) / (x[n + 1] - x[n]) * (at - x[n]) + y[n]


def _unit_plane_to_pixels(width: int, height: int, unit: float) -> NDArray[np.float64]:
    """Return the map from the plane, whose unit is `unit` pixels, to pixels; centres lie at integers."""
    return np.array([[unit, 0, (width - 1) / 2], [0, unit, (height - 1) / 2], [0, 0, 1]], np.float64)
