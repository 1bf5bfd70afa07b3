"""What of a measurement a diagnosis compares with models: how many pixels, and what is left out.

Left out is what a fit to some pixels cannot tell: bursts of the whole array in step with frames, a few hot
pixels, and dead pixels. All pixels tell of them, and a diagnosis says so in the end.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dase.diagnosis.few_hot_pixels import NAME as HOT
from dase.diagnosis.few_hot_pixels import few_hot_pixels
from dase.diagnosis.seen_effects import SeenEffects, find_seen_effects, strength_of_bursts
from dase.diagnosis.settings import DiagnosisSettings
from dase.diagnosis.silent_pixels import NAME as DEAD
from dase.diagnosis.silent_pixels import SilentPixels, find_silent_pixels
from dase.effects import Effect
from dase.fitting.burst_strength import BurstStrength, follows_frames
from dase.fitting.data_split import (
    SPLIT,
    LeftOut,
    ModelPremises,
    SplitMeasurement,
    SplitSettings,
    split_measurement,
)
from dase.fitting.measurement import Measurement
from dase.fitting.scene_doubt import is_guessed
from dase.scenes.between_frames import CameraScene
from dase.scenes.scene import Scene
from dase.signatures.burst_times import BurstTimes
from dase.signatures.frame_coupling import BurstClock
from dase.simulation.sensor import Sensor


@dataclass(frozen=True, eq=False)
class ComparedMeasurement:
    """A measurement, and what of it is compared with models.

    Args:
        measurement: All of it.
        given: The sensor as it was given.
        seen: What the events show by themselves.
        guessed: The scene, where light between its frames is a guess; None where it is known.
        bursts: When the whole array sends in step with the frames, which is left out; None for never.
        frames: When such bursts come, where the sensor has what makes them; None where it has not.
        hot: Hot pixels that are too few for a fit, which are left out, row-major, shape (K,); None for none.
        silent: What all pixels say of dead ones; None where that is not asked.
        pixels: In each part of the measurement.
        parts: How the measurement is split.
        seed: Of the choice of pixels.
        device: Where kernels run.
    """

    measurement: Measurement
    given: Sensor
    seen: SeenEffects
    guessed: CameraScene | None
    bursts: BurstClock | None
    frames: BurstTimes | None
    hot: NDArray[np.int64] | None
    silent: SilentPixels | None
    pixels: int
    parts: SplitSettings
    seed: int
    device: str

    @property
    def dead(self) -> SilentPixels | None:
        """What all pixels say of dead ones, where some are; these are left out."""
        return self.silent if self.silent is not None and self.silent.found else None

    @property
    def odd_pixels(self) -> NDArray[np.int64] | None:
        """Pixels that are left out of all that is compared, row-major, shape (K,); None for none."""
        hot, dead = self.hot, self.dead
        some = [*([] if hot is None else [hot]), *([] if dead is None else [dead.pixels])]
        return np.unique(np.concatenate(some)) if some else None

    @property
    def notes(self) -> list[str]:
        """What is left out, in sentences."""
        out = []
        if self.hot is not None:
            out.append(
                f"{len(self.hot)} hot pixels are left out of all that is compared, and counted among all "
                "pixels"
            )
        if self.dead is not None:
            out.append(f"{len(self.dead.pixels)} dead pixels are left out of all that is compared")
        if self.bursts is not None:
            out.append("the bursts that come with the frames are left out of all that is compared")
        return out

    def candidates(self, library: Mapping[str, type[Effect]]) -> dict[str, type[Effect]]:
        """Return the effects of a library that can be tried, by name.

        What is left out of all that is compared cannot be, nor what all pixels contradict.
        """
        known = {HOT} if self.hot is not None else set[str]()
        known |= {DEAD} if self.silent is not None and self.silent.decides else set()
        return {name: effect for name, effect in library.items() if name not in known}

    def split(self, scene: Scene | None = None, *, all_time: bool = False) -> SplitMeasurement:
        """Return the measurement, split for fitting and judging.

        Args:
            scene: In place of the measurement's own; None for that.
            all_time: Whether all of the time is fitted, not its first part alone.
        """
        measurement, given = self.measurement, self.given
        return split_measurement(
            measurement if scene is None else replace(measurement, scene=scene),
            left_out=LeftOut(self.bursts.contains if self.bursts else None, self.odd_pixels),
            models=ModelPremises(given.log_eps, self.seen.lamp, self.frames, given.unbroken),
            pixels=self.pixels,
            seed=self.seed,
            device=self.device,
            settings=replace(self.parts, all_time=all_time),
        )

    def strength_of_bursts(
        self,
        seen: SeenEffects,
        sensor: Sensor,
        library: Mapping[str, type[Effect]],
        begin: Effect | None = None,
    ) -> BurstStrength | None:
        """Return the effect that makes the bursts; see `dase.diagnosis.seen_effects.strength_of_bursts`.

        Args:
            seen: In the events, less what is of the scene.
            sensor: Without the effect.
            library: Effects, name to class.
            begin: The effect as it was fitted beside another model; None before the first fit.
        """
        return strength_of_bursts(
            seen, self.measurement, sensor, library, begin,
            pixels=self.pixels, plenty=self.parts.plenty, seed=self.seed, device=self.device,
        )  # fmt: skip


def choose_compared(
    measurement: Measurement,
    given: Sensor,
    effects: Mapping[str, type[Effect]],
    *,
    pixels: int,
    seed: int,
    device: str,
    settings: DiagnosisSettings,
) -> ComparedMeasurement:
    """Look at all events of a measurement, and choose what of it is compared with models.

    Args:
        measurement: All of it.
        given: The sensor, which knows the size of the array.
        effects: Candidates, name to class; only these are left out.
        pixels: In each part of the measurement, at most.
        seed: Of the choice of pixels.
        device: Where kernels run.
        settings: How much is enough.
    """
    scene = measurement.scene
    guessed = scene if isinstance(scene, CameraScene) and is_guessed(scene) else None
    parts = replace(SPLIT, plenty=settings.plenty)
    if guessed is not None and pixels > settings.guessed_pixels:
        # fewer pixels over the same time
        fewer = settings.guessed_pixels / pixels
        pixels = settings.guessed_pixels
        parts = replace(parts, plenty=fewer * parts.plenty, scouts=round(fewer * parts.scouts))
    seen = find_seen_effects(measurement, effects)
    # a lamp makes neighbours send whatever light does between frames
    asked = DEAD in effects and DEAD not in given and not (guessed is not None and seen.lamp)
    return ComparedMeasurement(
        measurement=measurement,
        given=given,
        seen=seen,
        guessed=guessed,
        # a sensor that has them already is compared with them
        bursts=None if follows_frames(given) else seen.bursts,
        frames=seen.times_of_bursts(measurement) if follows_frames(given) else None,
        hot=few_hot_pixels(seen, measurement.events, pixels) if HOT not in given else None,
        silent=find_silent_pixels(measurement, log_eps=given.log_eps) if asked else None,
        pixels=pixels,
        parts=parts,
        seed=seed,
        device=device,
    )
