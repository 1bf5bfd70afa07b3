"""Dead pixels, told one by one: they send nothing where their light changes and their neighbours send.

A fit looks at some thousand pixels, of which a few are dead; their share then is mostly chance, and makes all
else look like chance beside it. What makes pixels differ a little looks like a few dead ones, too. All pixels
together tell at once: one that is silent while all around it the same light makes events is dead. Where
others there send hardly anything, silence is the end of a range: of slow pixels in the dark, say.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.ndimage import distance_transform_cdt, find_objects, label

from dase.diagnosis.model_at_pixels import count_at_pixels, count_of_model
from dase.effects.dead import Dead
from dase.fitting.compared_time import common_grid, times_of_grid
from dase.fitting.measurement import Measurement
from dase.fitting.time_window import is_constant, within_span
from dase.probes.random_streams import SimulationStream
from dase.probes.stimulus import Trust, light_of
from dase.results import DetectionLimit, Diagnosis, Estimate, Finding, Grade
from dase.scenes.between_frames import CameraScene
from dase.scenes.scene import Scene
from dase.simulation.sensor import Sensor

NAME = Dead.name


@dataclass(frozen=True)
class SilentPixelSettings:
    """Of which pixels events are expected, and how many silent ones there must be of them.

    Chosen on scenes of key `dev1` of the blind benchmark, those of patches also on clips of other simulators.
    """

    times: int = 64
    """Moments at which the light of all pixels is looked at."""

    sent: float = 8.0
    """Events that all of the eight neighbours must have but one, whatever that does: of pixels that are
    alive, chance silences one in 3,000 where 8 are expected, and more at the edge of what moves."""

    alive: int = 3
    """Neighbours that must have as many where others send nothing at all: in two lines of dead ones and at
    the edge of a patch."""

    patch: int = 12
    """Silent pixels side by side, at least, for that: of 130 clips three had up to five at the edge of what
    moves, with three and with five neighbours that send."""

    edge: int = 4
    """Of these, of which events are expected by such neighbours, at least."""

    widest: int = 24
    """Width of a patch of dead pixels, at most: what is wider, or along half of a border, is switched off."""

    change: float = 0.6
    """Range of the log intensity that a pixel must see: most thresholds are far below it."""

    alike: float = 0.7
    """The range, in units of the neighbours' median; and the mean light, either way: an edge that rests lets
    one pixel see less than those beside it."""

    chance: float = 1e-3
    """Chance of as many silent pixels, at most, if no fewer sent one event, two and three each: four of 5,940
    beside one that sent hardly anything were slow ones of a dark current."""

    hardly: int = 3
    """Events of a pixel that sends hardly anything, at most."""

    apart: float = 6.0
    """Silent pixels, as times those that send hardly anything: 24 to 828 dead ones are 23 times as many at
    least, but 61 beside bursts that differ from pixel to pixel three times, 12 that a slow second pole had
    silenced once, and 64 whose memory a leak had driven past their light while it rested three times."""

    repeats: int = 4
    """Of a model that is asked whether a pixel may be silent: its memory begins anywhere."""

    enough: int = 1000
    """Pixels of which events are expected, from which on the lack of silent ones says that none are dead."""


SILENT_PIXELS = SilentPixelSettings()

BLOCK = 1 << 16
"""Pixels whose light is looked at together, for the memory that takes."""

TRUST_LOOKS = 8
"""Moments at which it is asked whether a pixel is trusted."""


@dataclass(frozen=True, eq=False)
class SilentPixels:
    """What all pixels say of dead ones.

    Args:
        pixels: Those that are silent where events are expected, row-major, shape (K,).
        asked: Pixels of which events are expected.
        settings: How many there must be.
        hardly: Pixels of which events are expected, and that send hardly any.
    """

    pixels: NDArray[np.int64]
    asked: int
    settings: SilentPixelSettings = SILENT_PIXELS
    hardly: int = 0

    @property
    def needed(self) -> float:
        """Silent pixels from which on some are dead."""
        usual = (self.hardly + 1) / self.settings.hardly
        by_chance = float(stats.poisson.isf(self.settings.chance, usual)) + 1
        return max(by_chance, self.settings.apart * self.hardly)

    @property
    def found(self) -> bool:
        """Whether some pixels are dead."""
        return len(self.pixels) >= self.needed

    @property
    def decides(self) -> bool:
        """Whether it is known if pixels are dead."""
        return self.found or self.asked >= self.settings.enough

    @property
    def share(self) -> Estimate:
        """Share of pixels that are dead, with its 90 % interval by Clopper and Pearson."""
        silent, alive = len(self.pixels), self.asked - len(self.pixels)
        low = stats.beta.ppf(0.05, silent, alive + 1) if silent else 0.0
        high = stats.beta.ppf(0.95, silent + 1, alive) if alive else 1.0
        return Estimate(silent / max(self.asked, 1), float(low), float(high))

    @property
    def sentence(self) -> str:
        """What is seen."""
        return (
            f"{len(self.pixels)} of {self.asked} pixels send nothing where their light changes and their "
            f"neighbours send"
        )

    def limit(self) -> DetectionLimit:
        """Return the share of dead pixels that would have been seen."""
        share = self.needed / max(self.asked, 1)
        sentence = f"dead pixels: {self.sentence}; a share above {share:.2g} would have been seen"
        return DetectionLimit(NAME, f"{NAME}.share", share, "1", True, sentence)


def find_silent_pixels(
    measurement: Measurement, *, log_eps: float, settings: SilentPixelSettings = SILENT_PIXELS
) -> SilentPixels:
    """Return the pixels that are silent where events are expected.

    Args:
        measurement: Events of the whole sensor, and what it saw.
        log_eps: Added to intensities before the logarithm.
        settings: Where events are expected.

    Raises:
        InputError: Events and scene have different sizes, or no time in common.
    """
    events, scene = measurement.events, measurement.scene
    whole = common_grid(events, scene)
    if min(scene.width, scene.height) < 3 or is_constant(scene):
        return SilentPixels(np.zeros(0, np.int64), 0, settings)
    times = times_of_grid(scene, within_span(whole, measurement.span))
    change, mean = _range_and_mean(scene, times, log_eps, settings.times)
    shape, every = (events.height, events.width), np.arange(events.width * events.height)
    # one that sends after the end of the scene, as a late one does, is not dead
    ever = count_at_pixels(events, every).reshape(shape)
    counts = count_at_pixels(events.select((events.t >= times[0]) & (events.t <= times[-1])), every).reshape(
        shape
    )
    inside = (slice(1, -1), slice(1, -1))
    asked, beside_silent = _are_like_neighbours_that_send(counts, change, mean, settings)
    sent = counts[inside]
    silent = (ever[inside] == 0) & (change[inside] >= settings.change)
    if measurement.trust is not None:
        trusted = _ever_trusted(measurement.trust, scene, times)[inside]
        asked, silent = asked & trusted, silent & trusted
    dead = asked & silent
    # between a camera's frames light is a guess, by which whole patches may see none
    if not isinstance(scene, CameraScene):
        dead |= _dead_patches(silent, beside_silent, settings)
    rows, columns = np.nonzero(dead)
    pixels = (rows + 1) * np.int64(events.width) + columns + 1
    hardly = np.count_nonzero(asked & (sent > 0) & (sent <= settings.hardly))
    return SilentPixels(pixels, int(np.count_nonzero(asked | dead)), settings, int(hardly))


def _dead_patches(
    silent: NDArray[np.bool_], expected: NDArray[np.bool_], settings: SilentPixelSettings
) -> NDArray[np.bool_]:
    """Return which silent pixels lie in lines and patches of dead ones, shape (H, W).

    Those in the middle have no neighbours that send, and are as dead as those at the edge.

    Args:
        silent: Pixels whose light changes and that send nothing, shape (H, W).
        expected: Pixels of which their neighbours let events expect, shape (H, W).
        settings: How large patches are.
    """
    patches, _ = label(silent, np.ones((3, 3)))
    boxes, sizes = find_objects(patches), np.bincount(patches.ravel())
    edges = np.bincount(patches[silent & expected], minlength=len(sizes))
    dead = np.zeros_like(silent)
    for n in np.flatnonzero((edges >= settings.edge) & (sizes >= settings.patch)).tolist():
        box = boxes[n - 1]
        patch = patches[box] == n
        if not _is_switched_off(patch, box, silent.shape, settings):
            dead[box] |= patch
    return dead


def _is_switched_off(
    patch: NDArray[np.bool_],
    box: tuple[slice, slice],
    shape: tuple[int, ...],
    settings: SilentPixelSettings,
) -> bool:
    """Return whether silent pixels side by side are a region outside of the one that a camera reads.

    Args:
        patch: Which pixels of the box they are.
        box: Rows and columns that they lie in.
        shape: Rows and columns of all pixels that are asked.
        settings: How wide a patch of dead pixels is, at most.
    """
    if 2 * int(distance_transform_cdt(np.pad(patch, 1)).max()) > settings.widest:
        return True
    lines = [
        (axis, end) for axis in (0, 1)
        for end, there in ((0, box[axis].start == 0), (-1, box[axis].stop == shape[axis])) if there
    ]  # fmt: skip
    return any(2 * int(patch.take(end, axis).sum()) >= shape[1 - axis] for axis, end in lines)


def _are_like_neighbours_that_send(
    counts: NDArray[np.int64],
    change: NDArray[np.float32],
    mean: NDArray[np.float32],
    settings: SilentPixelSettings,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return of which pixels events are expected, shape (H - 2, W - 2): those at the border are not asked.

    First by neighbours all of which send but one, then also by some where the others send nothing at all.

    Args:
        counts: Events of all pixels, shape (H, W).
        change: Range of their log intensity, shape (H, W).
        mean: Their mean intensity, shape (H, W).
        settings: What is expected.
    """
    around = _neighbours(counts)
    sends, tells = around >= settings.sent, (around >= settings.sent) | (around == 0)
    alive, most = sends.sum(0), len(around) - 1
    places = (alive >= settings.alive) & ((alive >= most) | (tells.sum(0) >= most))
    rows, columns = np.nonzero(places)
    which = (slice(None), rows, columns)
    # whom to be like: all where all but one send, else those that do
    counted = np.where(sends[which] | (alive[rows, columns] >= most), 1.0, np.nan)
    usual_change = np.nanmedian(_neighbours(change)[which] * counted, 0)
    brightness = mean[1:-1, 1:-1][rows, columns] / np.nanmedian(_neighbours(mean)[which] * counted, 0)
    places[rows, columns] = (
        (change[1:-1, 1:-1][rows, columns] >= np.maximum(settings.change, settings.alike * usual_change))
        & (brightness >= settings.alike) & (brightness <= 1 / settings.alike)
    )  # fmt: skip
    return places & (alive >= most), places


def without_the_explained_silence(
    silent: SilentPixels, measurement: Measurement, sensor: Sensor, *, seed: int
) -> SilentPixels:
    """Return the silent pixels without those that may hardly send anything in a model either.

    Args:
        silent: Pixels that send nothing.
        measurement: Its scene is simulated.
        sensor: The model; that it may have dead pixels does not count.
        seed: Of its random numbers.
    """
    if not len(silent.pixels):
        return silent
    alive = sensor.without(NAME) if NAME in sensor else sensor
    least = np.full(len(silent.pixels), np.inf)
    for turn in range(silent.settings.repeats):
        stream = SimulationStream.SILENT_PIXELS.seed(seed, turn)
        least = np.minimum(least, count_of_model(measurement, alive, silent.pixels, seed=stream))
    return replace(silent, pixels=silent.pixels[least > silent.settings.hardly])


def _range_and_mean(
    scene: Scene, times: NDArray[np.float64], log_eps: float, most: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the range of the log intensity and the mean intensity of all pixels, each (H, W).

    Looked at are at most `most` moments of a time.
    """
    size = scene.width * scene.height
    low, high, total = (
        np.full(size, np.inf, np.float32),
        np.zeros(size, np.float32),
        np.zeros(size, np.float32),
    )
    if isinstance(scene, CameraScene):
        # the frames are at hand; what is between them is a guess
        found = np.flatnonzero((scene.times >= times[0]) & (scene.times <= times[-1]))
        looks = found[_evenly(len(found), most)] if len(found) else np.zeros(1, np.int64)
        for n in looks:
            light = scene.intensity(int(n)).reshape(-1)
            low, high, total = np.minimum(low, light), np.maximum(high, light), total + light
    else:
        looks = _evenly(len(times), most)
        for first in range(0, size, BLOCK):
            part = slice(first, min(first + BLOCK, size))
            light = light_of(scene, times[looks], np.arange(part.start, part.stop, dtype=np.int32))
            low[part], high[part], total[part] = light.min(1), light.max(1), light.sum(1)
    shape = scene.height, scene.width
    change = np.log(high + log_eps) - np.log(low + log_eps)
    mean = (total / len(looks) + log_eps).astype(np.float32)
    return change.reshape(shape), mean.reshape(shape)


def _ever_trusted(trust: Trust, scene: Scene, times: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which pixels are trusted at one of some moments, shape (H, W); those of a mask never are."""
    looks, size = times[_evenly(len(times), TRUST_LOOKS)], scene.width * scene.height
    found = [
        trust(looks, np.arange(first, min(first + BLOCK, size), dtype=np.int32)).any(0)
        for first in range(0, size, BLOCK)
    ]
    return np.concatenate(found).reshape(scene.height, scene.width)


def _evenly(count: int, most: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, count - 1, most).round().astype(np.int64))


def _neighbours(values: NDArray[Any]) -> NDArray[Any]:
    """Return the eight neighbours of the pixels that have them all, shape (8, H - 2, W - 2)."""
    height, width = values.shape
    around = [
        values[1 + dy : height - 1 + dy, 1 + dx : width - 1 + dx]
        for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dy or dx
    ]  # fmt: skip
    return np.stack(around)


def with_dead_pixels(found: Diagnosis, silent: SilentPixels) -> Diagnosis:
    """Return a diagnosis that knew nothing of dead pixels with what all pixels say of them."""
    limits = tuple(one for one in found.not_seen if one.effect != NAME)
    if not silent.found:
        return replace(found, not_seen=(*limits, silent.limit()))
    parameters: Mapping[str, Estimate] = {f"{NAME}.share": silent.share}
    finding = Finding(NAME, Grade.CERTAIN, parameters=dict(parameters), seen=silent.sentence)
    return replace(
        found,
        sensor=found.sensor.with_effect(Dead(share=silent.share.value)),
        selected=(*found.selected, NAME),
        errors=(*found.errors, found.errors[-1]),
        parameters={**found.parameters, **parameters},
        findings=(*found.findings, finding),
        not_seen=limits,
    )
