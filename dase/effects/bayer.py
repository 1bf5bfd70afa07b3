"""Colour filters over the pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from dase.effects.base import choice, parameter
from dase.effects.optics import SceneEffect, rendered_pictures
from dase.kernels import pixel_stages
from dase.kernels.scene_mosaic import mosaic_pictures
from dase.scenes.scene import Scene


class Mosaic(Scene):
    """A scene behind colour filters, one for each pixel.

    It costs three stored pictures per sample, of which each pixel takes one.

    Args:
        scene: Without filters.
        filtered: The scene behind a red, a green and a blue filter.
        colours: Which of them each pixel is behind, 0, 1 or 2, shape (height, width).
    """

    def __init__(self, scene: Scene, filtered: tuple[Scene, Scene, Scene], colours: NDArray[np.uint8]):
        self.scene, self._filtered, self._colours = scene, filtered, colours
        self.width, self.height, self.duration = scene.width, scene.height, scene.duration
        self.anytime = scene.anytime

    def sample_times(self) -> NDArray[np.float64]:
        """Return when the scene itself asks to be sampled [s]."""
        return self.scene.sample_times()

    def source(self, times: NDArray[np.float64], pixels: NDArray[np.int32], device: Any) -> tuple[str, Any]:
        """Return the intensities of these pixels behind their filters, shape (K, N); see `Scene.source`."""
        red, green, blue = (rendered_pictures(one, times, device) for one in self._filtered)
        frames = pixel_stages.Frames()
        frames.values = mosaic_pictures((red, green, blue), self._colours.reshape(-1), pixels, device)
        return "frames", frames

    def frames(self, times: NDArray[np.float64], device: str = "cpu") -> NDArray[np.float32]:
        """Return the mosaics at `times` [s], shape (K, height, width)."""
        return self._chosen([one.frames(times, device) for one in self._filtered])

    def exposed_frames(
        self, begins: NDArray[np.float64], exposure: float, device: str = "cpu"
    ) -> NDArray[np.float32]:
        """Return the mosaics of exposures; `begins`, `exposure` [s] and the result are as in `Scene`."""
        return self._chosen([one.exposed_frames(begins, exposure, device) for one in self._filtered])

    def _chosen(self, pictures: list[NDArray[np.float32]]) -> NDArray[np.float32]:
        """Return of three pictures (K, height, width) that of each pixel's colour."""
        return np.choose(self._colours, pictures)

    def flow(self, times: NDArray[np.float64], device: str = "cpu") -> NDArray[np.float32] | None:
        """Return the flow of the scene itself [px/s], shape (K, 2, height, width)."""
        return self.scene.flow(times, device)


@dataclass(frozen=True, kw_only=True)
class Bayer(SceneEffect):
    """Colour filters over the pixels, in a Bayer pattern.

    Each pixel sees red, green or blue light only, so that an edge between two colours makes events at pixels
    of one colour and none, or such of the other polarity, at those beside them. What colour a pixel has is
    told by its place: `pattern` names those of the first two rows, from the left, and goes on over all of the
    sensor. Events stay events of one kind, and frames are the mosaic that a colour camera sends.

    Behind a filter linear intensity is (1 - purity) (0.21 R + 0.72 G + 0.07 B) + purity C, with C that of the
    filter's own colour and the rest what it lets through of all. Weights sum to 1, and grey things look as
    they do without. Pictures without colour stay as they are, to the bit.
    """

    name: ClassVar[str] = "bayer"
    source: ClassVar[str] = (
        "Bayer: Color imaging array, US patent 3971065, 1976; Scheerlinck et al.: CED, color event camera "
        "dataset, 2019 (DAVIS346 with filters); jAER, class Davis346redColor, 2024 (its pattern)"
    )
    in_frames: ClassVar[bool] = True
    needs_colour: ClassVar[bool] = True
    signatures: ClassVar = ()

    purity: float = parameter(
        0.8,
        unit="1",
        off=0.0,
        bounds=(0.0, 1.0),
        plausible=(0.4, 1.0),
        about="share of the light of a filter's own colour; the rest is that of all three",
    )
    pattern: str = choice(
        "rggb", among=("rggb", "bggr", "grbg", "gbrg"), about="colours of two by two pixels, row by row"
    )

    def colours(self, width: int, height: int) -> NDArray[np.uint8]:
        """Return the colour of each pixel, 0 for red, 1 for green, 2 for blue, shape (height, width)."""
        square = np.array(["rgb".index(letter) for letter in self.pattern], np.uint8).reshape(2, 2)
        return square[np.arange(height)[:, None] % 2, np.arange(width) % 2]

    def seen(self, scene: Scene) -> Scene:
        """Return the scene behind the filters; the scene itself where it has no colour."""
        filtered = scene.filtered(self.purity) if self.purity else None
        return scene if filtered is None else Mosaic(scene, filtered, self.colours(scene.width, scene.height))
