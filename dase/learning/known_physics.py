"""Counts by a sensor with more than thresholds, for learning thresholds on top of what is known of it."""

from __future__ import annotations

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from dase.effects.learned_threshold import LearnedThreshold
from dase.effects.optics import SceneEffect
from dase.effects.threshold import Threshold
from dase.errors import InputError
from dase.kernels import launch
from dase.kernels.autograd_counts import follow_torch_stream
from dase.kernels.launch import lend_tensor
from dase.kernels.pixel_codegen_scenes import StoredScenes
from dase.networks.threshold_network import ThresholdMaps
from dase.scenes.scene import LOG_EPS
from dase.scenes.scene_motions import SceneSettings
from dase.simulation.pixel_batch import PixelBatch
from dase.simulation.sensor import Sensor


def with_learned_thresholds(sensor: Sensor, *, on: float, off: float, weights: str = "") -> Sensor:
    """Return a sensor whose thresholds are learned ones, and whose other effects are as before.

    Args:
        sensor: What is known of a camera; its thresholds and their mismatch are replaced.
        on: Level of the ON threshold [log intensity].
        off: Level of the OFF threshold [log intensity].
        weights: File of the network, as `LearnedThreshold` has it.
    """
    sensor = sensor.without("mismatch").with_effect(LearnedThreshold(weights=weights))
    phase = sensor["threshold"].phase  # type: ignore[attr-defined]
    return sensor.with_effect(Threshold(on=on, off=off, phase=phase))


class KnownPhysics:
    """What all effects of a sensor on its pixels make of scenes, with thresholds from elsewhere.

    Bandwidth, dead times, leaks and noise of the pixels take part. What acts before the pixels (the blur of
    a lens) and behind them (the readout) is left out.

    Args:
        sensor: Its thresholds and mismatch do not count.
        scenes: What scenes look like.
        lead: Times of the samples that lead up to a window, see `Scenery.lead`; None for none.
        batch: Scenes B that are counted at once.
        device: PyTorch device.
        seed: Of the pixels' noise.

    Attributes:
        left_out: Names of the effects that take no part.
        given: The sensor as it was given.
    """

    def __init__(
        self,
        sensor: Sensor,
        scenes: SceneSettings,
        *,
        lead: NDArray[np.float64] | None = None,
        batch: int,
        device: torch.device,
        seed: int = 0,
    ):
        optics = [e.name for e in sensor.effects if isinstance(e, SceneEffect) and not e.is_off()]
        self.left_out = (*optics, *(effect.name for effect in sensor.readout_effects()))
        if "learned_threshold" in sensor:
            raise InputError(
                f"sensor '{sensor.name}' has learned thresholds: learn on top of one with physics alone"
            )
        self.given, self.sensor = sensor, with_learned_thresholds(sensor, on=0.2, off=0.2)
        self.scenes, self.batch, self.device = scenes, batch, device
        self.lead = np.empty(0) if lead is None else lead
        self.generator = torch.Generator(device).manual_seed(seed)
        self._where = launch.find_device(str(device))
        names, count = self.sensor.parameter_names(), scenes.width * scenes.height
        self._on, self._off = names.index("threshold.on"), names.index("threshold.off")
        self._pixels = PixelBatch(
            self.sensor, batch, count, width=scenes.width, height=scenes.height, deposit="counts",
            device=self._where,
        )  # fmt: skip
        if self._pixels.delays:
            raise InputError(
                f"sensor '{sensor.name}': events that leave late may leave after their window; "
                "learn without latency and jitter"
            )
        row = torch.from_numpy(np.repeat(self.sensor.parameters()[None], batch, 0)).to(device)
        self._parameters = row.contiguous()
        places = np.repeat(np.arange(count, dtype=np.int32)[None], batch, 0)
        self._places = torch.from_numpy(places).to(device)
        times = np.concatenate([self.lead, np.linspace(0.0, scenes.window, scenes.samples)])
        # what comes between the last sample of the lead and the begin of the window is of the lead
        self._times = np.split(times - times[0], [len(self.lead) + 1]) if len(self.lead) else [times]
        self._clocks = []
        for part in self._times:
            # of samples that follow those of the part before
            self._clocks.append(self._pixels.clock(part, np.array([0, len(part)], np.int32)))
            self._pixels.samples, self._pixels.begin = self._pixels.samples + len(part), float(part[-1])

    def with_batch(self, batch: int, seed: int) -> KnownPhysics:
        """Return the same for another number of scenes, with random numbers of its own."""
        return KnownPhysics(
            self.given, self.scenes, lead=self.lead, batch=batch, device=self.device, seed=seed
        )

    @torch.no_grad()
    def count(
        self, log: torch.Tensor, maps: ThresholdMaps, known: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Return counts of the whole window, shape (B, 2, H, W), OFF before ON, without a gradient.

        Args:
            log: Log intensities of scenes, shape (B, L + K, H, W); L samples lead up to the window.
            maps: Distributions of their thresholds; every call draws pixels anew.
            known: Pixels that count, shape (B, H, W); the others have no events, not even noise. None: all.
        """
        batch, samples = log.shape[:2]
        expected = sum(map(len, self._times))
        if (batch, samples) != (self.batch, expected):
            raise ValueError(
                f"log must be {self.batch} scenes of {expected} samples, got {batch} of {samples}"
            )
        # thresholds are these levels times a factor of the pixel: their mean, and how far a pixel is from it
        middle = maps.mu.log().mean().exp()
        parameters = self._parameters.clone()
        parameters[:, self._on] = middle * maps.ratio.sqrt()
        parameters[:, self._off] = middle * maps.ratio.rsqrt()
        factors = torch.stack([maps.mu / middle, maps.sigma / maps.mu], 1).flatten(2).float().contiguous()
        seeds = torch.randint(1 << 31, (batch,), generator=self.generator, device=self.device)
        light = (log.float().exp() - LOG_EPS).flatten(2).contiguous()
        frames = torch.empty(1, batch, light.shape[2], device=self.device)
        with follow_torch_stream(self.device):
            self._pixels.reset(
                lend_tensor(self._places, dtype=wp.int32), lend_tensor(parameters, dtype=wp.float32),
                lend_tensor(seeds.int(), dtype=wp.int32), lend_tensor(factors, dtype=wp.float32),
            )  # fmt: skip
            begin = 0
            for times, clock in zip(self._times, self._clocks, strict=True):
                end = begin + len(times)
                part = light[:, begin:end].contiguous()
                lamps = torch.ones(batch, len(times), device=self.device)
                grids = torch.zeros(1, batch, 2, light.shape[2], device=self.device)
                seen = StoredScenes()
                seen.values = lend_tensor(part, dtype=wp.float32)
                seen.light = lend_tensor(lamps, dtype=wp.float32)
                self._pixels.advance("frames", seen, clock, times, lend_tensor(frames), lend_tensor(grids), 1)
                begin = end
        counts = grids[0].view(batch, 2, *log.shape[2:])  # the window's: what led up to it does not count
        return counts if known is None else torch.where(known[:, None], counts, 0.0)
