"""Endless labelled batches of simulated events, made on the device that trains."""

from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch.utils.data import IterableDataset, get_worker_info

from dase.effects.learned_threshold import LearnedThreshold
from dase.effects.optics import SceneEffect
from dase.errors import InputError, checked_integer, checked_seed
from dase.kernels import launch, scene_paths
from dase.kernels import threshold_counts as counting
from dase.kernels.autograd_counts import follow_torch_stream
from dase.kernels.launch import lend_tensor
from dase.kernels.pixel_codegen_scenes import StoredScenes
from dase.kernels.scene_layers import Affine
from dase.kernels.scene_windows import LayerScenes, flow_kernel, rendering_kernel
from dase.networks.weights_file import load_net
from dase.representations import Representation, Voxels
from dase.scenes.image_sources import BACKGROUND, ImageSource, open_images
from dase.scenes.layers import LayerScene
from dase.scenes.static import StaticScene
from dase.simulation.pixel_batch import PixelBatch
from dase.simulation.sensor import Sensor
from dase.simulation.sensor_file import as_sensor
from dase.torch.augmentation import augmented
from dase.torch.batch import Batch
from dase.torch.pictures import DecodedPictures, TexturePool, decode_pictures
from dase.torch.rendered_scene import RenderedScene
from dase.torch.scene_numbers import (
    Augment,
    Randomise,
    SceneNumbers,
    ScenePlan,
    draw_scene_numbers,
    sensor_of,
)

MEMORY = 1 << 28
"""Bytes of whole pictures that are held at once where a lens needs them."""
GPU_MEMORY = 1 << 30
"""Bytes of pictures that are held at once on a GPU."""
VOXELS = Voxels(5)
"""What networks are given unless something else is asked for."""
NOTHING = Augment()
"""No augmentation."""


@dataclass(frozen=True)
class StoredScene:
    """A scene of a stream as `dase.simulate` takes it: `dase.simulate(scene, sensor, seed=..., pixels=...)`.

    Args:
        scene: All of the camera's view.
        sensor: With the parameters of this scene, readout effects included.
        seed: Of every random number.
        times: Samples [s], shape (K,).
        pixels: Row-major indices on the camera of the pixels that the stream shows, shape (N,).
        flips: Whether the stream shows them mirrored, left to right and top to bottom.
    """

    scene: LayerScene
    sensor: Sensor
    seed: int
    times: NDArray[np.float64]
    pixels: NDArray[np.int32]
    flips: tuple[bool, bool]


class Stream(IterableDataset[Batch]):
    """Endless batches of random scenes, simulated and represented on one device; nothing is stored.

        for batch in dase.torch.Stream("photos/", "davis240c", batch=12, steps=40):
            loss = train(batch.inputs, batch.frames, batch.flow, batch.reset)

    All scenes of a batch are simulated by one launch of the sensor's kernel, each with parameters, random
    numbers and pictures of its own. Events are weighed into their windows where they happen, with their exact
    times: the batch is what `dase.simulate` of the same scenes (`scene`) gives, represented window by window,
    to rounding. Readout effects are left out: they need the events of all pixels in order of time, so a
    sensor with a crowded bus or coarse time stamps is that sensor without them; `left_out` names them. The
    same seed gives the same batches on the same device, whatever was drawn before.

    With a `DataLoader` (`batch_size=None`), workers simulate on the CPU. On a GPU use it as it is, without
    workers: pictures are decoded by a thread of its own meanwhile.

    Args:
        images: Textures: a folder, `builtin`, or what else `dase.open_images` takes; or an image source.
        sensor: A `Sensor`, the name of a preset, or the path of a sensor file.
        batch: Slots B.
        steps: Windows T of a batch.
        size: Columns and rows [px].
        window: Duration of a window [s].
        represent: Representation of the events of a window.
        randomise: Range of each parameter that differs from scene to scene, by `effect.parameter`;
            `threshold` stands for `threshold.on` and `threshold.off` together. Or a function of a random
            generator and B that returns values, shape (B,), by such names.
        device: PyTorch device; None for a GPU where there is one, else the CPU.
        seed: Of everything random.
        samples: Time samples of a window. Fast scenes need many (Eq. 5 of ESIM's paper asks for no more than
            half a pixel of motion between two).
        view: Columns and rows of the camera [px], of which each scene shows a part of `size` anywhere; None
            for `size`.
        regimes: How scenes move, equally likely: names as for `dase synth --regime`, `shaken` beside them.
        speed: All straight motions are so much faster.
        lighting: Share of the scenes whose light sways or is switched.
        scene_batches: Batches that a scene goes on for.
        augment: Mirroring, noise, hot pixels and pauses beside all that.
        backgrounds: Pictures in the pool that scenes are made of.
        objects: Cut-outs in it.
        renew: After so many scenes of each slot there is a new pool; 0 keeps the first one.
        first_batch: Number of the first batch, to go on where a training stopped.

    Raises:
        InputError: Something does not exist, or is not of its kind.
    """

    def __init__(
        self,
        images: str | PathLike[str] | ImageSource = "builtin",
        sensor: Sensor | str | PathLike[str] = "davis240c",
        *,
        batch: int = 12,
        steps: int = 40,
        size: tuple[int, int] = (128, 128),
        window: float = 1 / 60,
        represent: Representation = VOXELS,
        randomise: Randomise | None = None,
        device: str | torch.device | None = None,
        seed: int = 0,
        samples: int = 16,
        view: tuple[int, int] | None = None,
        regimes: tuple[str, ...] = ("shake", "mixed"),
        speed: float = 1.0,
        lighting: float = 0.0,
        scene_batches: int = 1,
        augment: Augment = NOTHING,
        backgrounds: int = 48,
        objects: int = 96,
        renew: int = 100,
        first_batch: int = 0,
    ):
        self.images = images if isinstance(images, ImageSource) else open_images(str(images))
        self.sensor = as_sensor(sensor)
        self.steps, self.samples = checked_integer("steps", steps, 1), checked_integer("samples", samples, 1)
        self.scene_batches = checked_integer("scene_batches", scene_batches, 1)
        self.backgrounds = checked_integer("backgrounds", backgrounds, 1)
        self.objects = checked_integer("objects", objects, 0)
        self.renew, self.first_batch = (
            checked_integer("renew", renew, 0),
            checked_integer("first_batch", first_batch, 0),
        )
        self.seed, self.represent = checked_seed(seed), represent
        if not represent.deposit:
            raise InputError(
                f"{type(represent).__name__} needs whole events, which a stream never has; "
                "take another representation, or dase.simulate"
            )
        if not np.isfinite(window) or not window > 0:
            raise InputError(f"window must be a number > 0 s, got {window}")
        view = size if view is None else view
        if min(*size) < 1 or size[0] > view[0] or size[1] > view[1]:
            raise InputError(
                f"size must lie in 1x1 to the view, {view[0]}x{view[1]}, got {size[0]}x{size[1]}"
            )
        self.plan = ScenePlan(
            batch=checked_integer("batch", batch, 1), size=size, view=view, windows=steps * scene_batches,
            window=window, regimes=tuple(regimes), speed=speed, lighting=lighting, randomise=randomise,
            augment=augment,
        )  # fmt: skip
        self.plan.most_layers()
        self.device = choose_device(device)
        self.left_out = tuple(effect.name for effect in self.sensor.readout_effects())
        # what cannot work is refused here and not in the loop
        draw_scene_numbers(np.random.default_rng(0), self.plan, self.sensor, 1, self.objects)

    def __iter__(self) -> Iterator[Batch]:
        """Yield batches without end, beginning with number `first_batch`."""
        worker = get_worker_info()
        first, stride = self.first_batch, 1
        if worker is not None:
            if self.device.type == "cuda":
                raise InputError(
                    "a worker process cannot share the GPU: take num_workers=0, pictures are decoded by a "
                    "thread meanwhile; or device='cpu'"
                )
            if self.scene_batches > 1 and worker.num_workers > 1:
                raise InputError(
                    "scenes that go on for several batches need one worker, "
                    f"got num_workers={worker.num_workers}: batches of several are mixed"
                )
            launch.set_threads(1)
            first, stride = first + worker.id, worker.num_workers
        return self._batches(first, stride)

    def _batches(self, first: int, stride: int) -> Iterator[Batch]:
        maker = BatchMaker(self)
        try:
            number = first
            while True:
                yield maker.make(number)
                number += stride
        finally:
            maker.close()

    def decode(self, pool: int) -> DecodedPictures:
        """Return the textures of a pool by its number."""
        rng = np.random.default_rng([self.seed, 0, pool])
        return decode_pictures(self.images, rng, self.backgrounds, self.objects)

    def pool_of(self, group: int) -> int:
        """Return the number of the pool that a group of scenes is made of."""
        return group // self.renew if self.renew else 0

    def draw(self, group: int) -> SceneNumbers:
        """Return what is random in a group of scenes, one for each slot."""
        rng = np.random.default_rng([self.seed, 1, group])
        return draw_scene_numbers(rng, self.plan, self.sensor, self.backgrounds, self.objects)

    def times(self, part: int) -> NDArray[np.float64]:
        """Return the samples [s] of the batches of a scene by their number in it; the first has one more."""
        each = self.steps * self.samples
        index = np.arange(part * each + (part > 0), (part + 1) * each + 1, dtype=np.float64)
        return index * (self.plan.window / self.samples)

    def scene(self, number: int, slot: int) -> StoredScene:
        """Return what a slot of a batch shows, to be simulated and looked at by other means.

        Args:
            number: Of the batch.
            slot: In it.
        """
        group = checked_integer("number", number, 0) // self.scene_batches
        slot = checked_integer("slot", slot, 0, self.plan.batch)
        drawn, pictures = self.draw(group), self.decode(self.pool_of(group))
        scene = drawn.layer_scene(slot, self.plan, pictures.grounds, pictures.fronts)
        times = np.concatenate([self.times(part) for part in range(self.scene_batches)])
        made = sensor_of(self.sensor, drawn.parameters[slot])
        flips = bool(drawn.flips[slot, 0]), bool(drawn.flips[slot, 1])
        return StoredScene(scene, made, int(drawn.seeds[slot]), times, drawn.places(self.plan)[slot], flips)


def choose_device(device: str | torch.device | None) -> torch.device:
    """Return a PyTorch device; raises InputError where it is not there."""
    if device is None:
        device = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        found = torch.device(device)
    except RuntimeError as error:
        raise InputError(f"there is no device '{device}': cpu or cuda") from error
    if found.type not in ("cpu", "cuda"):
        raise InputError(f"device must be cpu or cuda, got '{device}'")
    if found.type == "cuda" and not torch.cuda.is_available():
        raise InputError(f"device '{device}' needs an NVIDIA GPU that PyTorch can use; use 'cpu'")
    return found


class BatchMaker:
    """Makes the batches of a stream, in any order, best one after the other."""

    def __init__(self, stream: Stream):
        self.stream, self.plan, self.device = stream, stream.plan, stream.device
        self.where = launch.find_device(str(self.device))
        width, height = self.plan.view
        self.pixels = PixelBatch(
            stream.sensor, self.plan.batch, self.plan.size[0] * self.plan.size[1], width=width, height=height,
            deposit=stream.represent.deposit, device=self.where,
        )  # fmt: skip
        optics = (effect for effect in stream.sensor.effects if isinstance(effect, SceneEffect))
        self._mixing = any(not effect.is_off() for effect in optics)
        # a thread that looks layers up and is a pixel needs so many registers that a GPU runs few of them:
        # on an H100 two kernels, with light between them, are a third faster
        self._rendering = self.device.type == "cuda" and not self._mixing
        self._decoder = ThreadPoolExecutor(1, thread_name_prefix="dase pictures")
        self._coming: dict[int, Future[DecodedPictures]] = {}
        self._pool: tuple[int, TexturePool] | None = None
        self._group, self._part = -1, 0
        self._clocks: dict[tuple[int, int], Any] = {}
        self._kept: dict[str, Any] = {}  # memory of work that is done anew in every batch
        self._late: torch.Tensor | None = None
        self._before: torch.Tensor | None = None

    def close(self) -> None:
        """End the thread that decodes pictures."""
        self._decoder.shutdown(wait=False, cancel_futures=True)

    @torch.no_grad()
    def make(self, number: int) -> Batch:
        """Return a batch by its number."""
        group, part = divmod(number, self.stream.scene_batches)
        with follow_torch_stream(self.device):
            if group != self._group or part < self._part:
                self._begin(group)
            # a scene that is entered in its middle is simulated up to there
            for one in range(number - part + self._part, number + 1):
                made = self._finish(one, *self._advance())
            return made

    def _begin(self, group: int) -> None:
        """Begin the scenes of a group."""
        pool = self._load_pool(self.stream.pool_of(group))
        drawn = self.stream.draw(group)
        self._group, self._part, self._late, self._before = group, 0, None, None
        self._drawn = drawn
        scenes = LayerScenes()
        scenes.grey, scenes.texels = pool.grey, pool.texels
        start, size = np.zeros(drawn.front.shape, np.int32), np.zeros((*drawn.front.shape, 2), np.int32)
        if len(pool.size):
            start, size = pool.start[drawn.front], pool.size[drawn.front]
        size[:, 0] = BACKGROUND[::-1]
        size[~drawn.there] = 0
        scenes.ground, scenes.start = self._send(drawn.ground, wp.int32), self._send(start, wp.int32)
        scenes.size = self._send(size, wp.vec2i)
        self._scenes = scenes
        cameras = drawn.cameras
        paths = cameras.ends, cameras.waves, cameras.pauses
        self._camera = [self._send(numbers, wp.float64) for numbers in paths]
        self._ends = self._send(drawn.ends, wp.float64)
        places = self._send(drawn.places(self.plan), wp.int32)
        maps = self._maps_of_scenes(drawn) if self.pixels.maps else None
        parameters = self._send(drawn.parameters, wp.float32)
        self._vectors = wp.to_torch(parameters)
        self._flips = self._upload(drawn.flips)
        self.pixels.reset(places, parameters, self._send(drawn.seeds, wp.int32), maps)

    def _load_pool(self, number: int) -> TexturePool:
        """Return a pool on the device, and have the next one decoded meanwhile."""
        if self._pool is None or self._pool[0] != number:
            coming = self._coming.pop(number, None)
            decoded = self.stream.decode(number) if coming is None else coming.result()
            self._pool = number, decoded.upload(self.where)
            self._coming.clear()
        if self.stream.renew and number + 1 not in self._coming:
            self._coming[number + 1] = self._decoder.submit(self.stream.decode, number + 1)
        return self._pool[1]

    def _upload(self, values: NDArray[Any]) -> torch.Tensor:
        """Return numbers on the device; nobody waits for the copy."""
        here = torch.from_numpy(np.ascontiguousarray(values))
        if self.device.type == "cuda":
            here = here.pin_memory()
        return here.to(self.device, non_blocking=True)

    def _send(self, values: NDArray[Any], dtype: Any) -> wp.array:
        """Return numbers as a Warp array on the device, in memory of PyTorch; nobody waits for the copy."""
        return lend_tensor(self._upload(values), dtype=dtype)

    def _memory(self, name: str, shape: tuple[int, ...], dtype: Any) -> wp.array:
        """Return memory of a shape that is used again by the next one that wants as much, or less, of it."""
        count = math.prod(shape)
        if name not in self._kept or self._kept[name].shape[0] < count:
            self._kept[name] = wp.empty(count, dtype=dtype, device=self.where)
        return self._kept[name][:count].reshape(shape)

    def _place(self, times: wp.array, run: wp.array) -> wp.array:
        """Work out where layers are at samples (K,) in runs (R + 1,); return their velocities (B, R, L)."""
        batch, layers, samples = self.plan.batch, self._ends.shape[1], times.shape[0]
        runs = run.shape[0] - 1
        pose = self._memory("pose", (batch, samples, scene_paths.POSE), wp.float64)
        inputs = [times, wp.float64(self.plan.duration), *self._camera, pose]
        launch.run_kernel(scene_paths.camera_poses, samples, inputs, self.where, batch=batch)
        self._scenes.place = self._memory("place", (batch, samples, layers), Affine)
        self._scenes.box = self._memory("box", (batch, runs, layers), wp.vec4)
        velocity = self._memory("velocity", (batch, runs, layers), Affine)
        view = wp.vec2d(*map(float, self.plan.view))
        inputs = [
            pose, self._ends, self._scenes.size, view, run, self._scenes.place, self._scenes.box, velocity
        ]  # fmt: skip
        launch.run_kernel(scene_paths.place_layers, runs * layers, inputs, self.where, batch=batch)
        return velocity

    def _advance(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Simulate the next batch of the scenes; return grids (T, B, C, N), frames and flow."""
        plan, steps, batch, count = self.plan, self.stream.steps, self.plan.batch, self.pixels.count
        late = self.pixels.late_windows(plan.window)
        grids = torch.zeros(steps + late, batch, self.stream.represent.channels, count, device=self.device)
        if self._late is not None:
            grids[:late] += self._late
        frames = torch.empty(steps, batch, count, device=self.device)
        flow = torch.empty(steps, batch, 2, count, device=self.device)
        each = self._windows_at_once()
        for first in range(0, steps, each):
            last = min(first + each, steps)
            parts = grids[first : last + late], frames[first:last], flow[first:last]
            self._advance_windows(first, last, *parts)
        self._part += 1
        self._late = grids[steps:].clone() if late else None
        return grids[:steps], frames, flow

    def _windows_at_once(self) -> int:
        """Return how many windows are simulated by one launch."""
        if not (self._mixing or self._rendering):
            return self.stream.steps
        width, height = self.plan.view if self._mixing else self.plan.size
        window = 4 * self.plan.batch * self.stream.samples * width * height
        most = MEMORY if self._mixing else GPU_MEMORY
        return max(1, min(self.stream.steps, most // window))

    def _advance_windows(
        self, first: int, last: int, grids: torch.Tensor, frames: torch.Tensor, flow: torch.Tensor
    ) -> None:
        """Simulate windows of a batch: add their events to grids (W, B, C, N), fill frames and flow."""
        each, count = self.stream.samples, self.pixels.count
        # the very first sample belongs to the first window, and begins no step
        fresh = int(self._part == 0)
        times = self.stream.times(self._part)[first * each + fresh * (first > 0) : last * each + fresh]
        run = np.arange(last - first + 1, dtype=np.int32) * each
        run[1:] += fresh * (first == 0)
        # scenes have the same clocks as those before them
        if (self._part, first) not in self._clocks:
            self._clocks[self._part, first] = self.pixels.clock(times, run)
        clock = self._clocks[self._part, first]
        velocity = self._place(clock.t64, clock.run)
        self._scenes.light = self._light(times)
        lent, bins = (lend_tensor(frames), lend_tensor(grids)), getattr(self.stream.represent, "bins", 1)
        if self._mixing:
            sharp = self._render(clock.run, len(times), self._whole_view())
            self.pixels.advance("frames", self._through_optics(sharp, times), clock, times, *lent, bins)
            # a label is what there is to be seen, not what a lens makes of it
            self._show(sharp, run[1:] - 1, frames)
        elif self._rendering:
            seen = StoredScenes()
            seen.light = self._scenes.light
            seen.values = self._render(clock.run, len(times), self.pixels.places)
            self.pixels.advance("frames", seen, clock, times, *lent, bins)
        else:
            self.pixels.advance("layers", self._scenes, clock, times, *lent, bins)
        lanes = counting.widest_block(count, self.where, "layers")
        inputs = [
            self._scenes, velocity, clock.run, self.pixels.places, self.plan.view[0], lend_tensor(flow)
        ]  # fmt: skip
        blocks = (last - first) * counting.block_count(count, lanes)
        launch.run_kernel(flow_kernel(lanes), blocks, inputs, self.where, batch=self.plan.batch)

    def _whole_view(self) -> wp.array:
        """Return indices of all pixels of the cameras, shape (B, pixels of the view)."""
        if "every" not in self._kept:
            indices = np.arange(self.plan.view[0] * self.plan.view[1], dtype=np.int32)
            self._kept["every"] = self._send(np.repeat(indices[None], self.plan.batch, 0), wp.int32)
        every: wp.array = self._kept["every"]
        return every

    def _render(self, run: wp.array, samples: int, places: wp.array) -> wp.array:
        """Return what pixels (B, N) of the cameras see in full light, shape (B, samples, N)."""
        batch, count = places.shape
        out = self._memory("sharp", (batch, samples, count), wp.float32)
        lanes = counting.widest_block(count, self.where, "layers")
        blocks = (run.shape[0] - 1) * counting.block_count(count, lanes)
        inputs = [self._scenes, run, places, self.plan.view[0], out]
        launch.run_kernel(rendering_kernel(lanes), blocks, inputs, self.where, batch=batch)
        return out

    def _through_optics(self, sharp: wp.array, times: NDArray[np.float64]) -> StoredScenes:
        """Return what pixels see of whole pictures (B, K, pixels) through effects that mix neighbours."""
        seen = StoredScenes()
        seen.light = self._scenes.light
        seen.values = self._memory("seen", (self.plan.batch, len(times), self.pixels.count), wp.float32)
        for slot, pixels in enumerate(self._drawn.places(self.plan)):
            picture = RenderedScene(self.plan.view, sharp[slot])
            _, mixed = self.stream.sensor.through_optics(picture).source(times, pixels, self.where)
            wp.copy(seen.values[slot], mixed.values)
        return seen

    def _show(self, sharp: wp.array, samples: NDArray[np.int32], frames: torch.Tensor) -> None:
        """Write what there is to be seen at some samples (W,) of whole pictures into frames (W, B, N)."""
        at = torch.from_numpy(samples.astype(np.int64)).to(self.device)
        pictures = wp.to_torch(sharp)[:, at].transpose(0, 1)
        light = wp.to_torch(self._scenes.light)[:, at].T[..., None]
        places = wp.to_torch(self.pixels.places).long().expand(len(at), -1, -1)
        frames.copy_(pictures.gather(2, places) * light)

    def _light(self, times: NDArray[np.float64]) -> wp.array:
        """Return what intensities are multiplied by at samples [s], shape (B, K)."""
        light = np.ones((self.plan.batch, len(times)), np.float32)
        for slot, lighting in enumerate(self._drawn.lighting):
            if lighting is not None:
                light[slot] = lighting.factor(times)
        return self._send(light, wp.float32)

    def _finish(self, number: int, grids: torch.Tensor, frames: torch.Tensor, flow: torch.Tensor) -> Batch:
        """Return the batch of what was simulated."""
        plan, (width, height) = self.plan, self.plan.size
        shape = grids.shape[:2]
        inputs = self.stream.represent.finish(
            grids.view(*grids.shape[:3], height, width), plan.window, self._before
        )
        self._before = inputs[-1]
        begins = torch.zeros(shape, dtype=torch.bool, device=self.device)
        begins[0] = self._part == 1
        names = self.stream.sensor.parameter_names()
        vectors = self._vectors
        # taken one by one: a list of places would be sent, and the GPU waited for
        nominal = [vectors[:, names.index(f"threshold.{which}")] for which in ("off", "on")]
        batch = Batch(
            inputs=inputs,
            frames=frames.view(*shape, 1, height, width),
            flow=flow.view(*shape, 2, height, width),
            reset=begins,
            thresholds=torch.stack(nominal, 1),
            parameters={name: vectors[:, place] for place, name in enumerate(names)},
        )
        return augmented(batch, plan.augment, self._flips, [self.stream.seed, 2, number])

    def _maps_of_scenes(self, drawn: SceneNumbers) -> wp.array:
        """Return what effects have for each pixel of each scene, shape (B, M, N)."""
        frames = self._middle_frames()
        places = drawn.places(self.plan)
        rows = []
        for effect in self.stream.sensor.effects:
            if isinstance(effect, LearnedThreshold) and effect.weights:
                rows.append(self._learned_maps(effect, frames, places))
            elif effect.maps:
                seen = (StaticScene(*self.plan.view, 1.0, frame) for frame in frames.cpu().numpy())
                found = [effect.bound_to(one).map_values(at) for one, at in zip(seen, places, strict=True)]
                rows.append(torch.from_numpy(np.stack(found)).to(self.device))
        return lend_tensor(torch.cat(rows, 1).float().contiguous())

    def _middle_frames(self) -> torch.Tensor:
        """Return what the whole cameras see at the middle samples of their scenes, shape (B, H, W)."""
        batch, (width, height) = self.plan.batch, self.plan.view
        total = self.plan.windows * self.stream.samples + 1
        time = np.array([total // 2 * (self.plan.window / self.stream.samples)])
        run = self._send(np.array([0, 1], np.int32), wp.int32)
        self._place(self._send(time, wp.float64), run)
        self._scenes.light = self._light(time)
        frames = wp.to_torch(self._render(run, 1, self._whole_view()))[:, 0] * wp.to_torch(self._scenes.light)
        return frames.view(batch, height, width)

    def _learned_maps(
        self, effect: LearnedThreshold, frames: torch.Tensor, places: NDArray[np.int32]
    ) -> torch.Tensor:
        """Return factor and spread of the thresholds that a network tells, shape (B, 2, N)."""
        if "net" not in self._kept:
            self._kept["net"] = load_net(Path(effect.weights)).to(self.device)
        net = self._kept["net"]
        size = self.plan.view
        if net.shape.pattern not in (None, size):
            made = "x".join(map(str, net.shape.pattern))
            raise InputError(
                f"{effect.weights} was learned for a {made} sensor, the view is {size[0]}x{size[1]}"
            )
        # convolutions of a GPU have 10 bits of fractions unless told otherwise: thresholds differ by 1e-3
        with torch.backends.cudnn.flags(enabled=torch.backends.cudnn.enabled, allow_tf32=False):
            maps = net(frames.clamp(0, 1))
        both = torch.stack([maps.mu / net.level[0].exp(), maps.sigma / maps.mu], 1).flatten(2)
        at = torch.from_numpy(places.astype(np.int64)).to(self.device)
        return both.gather(2, at[:, None].expand(-1, 2, -1))
