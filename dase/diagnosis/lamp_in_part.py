"""A lamp that lights a part of the picture: neighbouring pixels follow one tone, the others do not.

A lamp over the whole array is seen in the events alone, see `dase.signatures.flicker`: tiles anywhere agree
on its phase. One in a part moves few of them. So tones are looked for in circles of any size at any place.
Motion has tones, too: what passes at an even speed sends as often as its pattern comes by. But its phase goes
on from place to place and changes from time to time, it swings rates by less, and the light of the clip has
it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_propagation

from dase.diagnosis.light_between_events import times_that_are_compared
from dase.effects.base import Effect
from dase.effects.made_signatures import told_by
from dase.events import Events
from dase.fitting.frame_steps import clip_step_of
from dase.fitting.measurement import Measurement
from dase.formatting import format_percent
from dase.probes.stimulus import log_light_of
from dase.results import Diagnosis, Finding, Grade
from dase.scenes.video import VideoScene
from dase.signatures.calm_events import row_major_pixels
from dase.signatures.kinds import FLICKER
from dase.signatures.result import Answer, Signature


@dataclass(frozen=True)
class LampSettings:
    """Which tones are looked for where, and which are lamps.

    Chosen on 540 clips of other simulators with 21 lamps, 20 of which are beyond each limit by as much as it
    says: the last one has a multiple of its frames' rate.
    """

    step: float = 1e-3
    """[s] of counts."""

    longest: float = 4.0
    """[s] of the events that are looked at."""

    block: float = 0.05
    """[s] Longer than a lamp's cycles, shorter than what moves keeps its phase; half overlapping."""

    tones: tuple[float, float] = (45.0, 450.0)
    """[Hz] Mains have 100 and 120, screens and dimmers others."""

    cell: float = 2.5
    """[Hz] between tones at which blocks are transformed: a tone between them turns their phase only."""

    tile: int = 6
    """Pixels on a side of a tile, about; more where there would be more than `most_tiles`."""

    most_tiles: int = 800

    radii: tuple[float, ...] = (1.01, 1.5, 2.3, 3.2, 4.5, 6.5)
    """Of circles, in tiles."""

    ratio: float = 40.0
    """Power of a tone in a circle over that of chance there, at least: lamps 65 and more, most above 500; a
    chance of 1e-8. Motion reaches as much, so that the others decide."""

    agree: float = 0.85
    """Share of its tiles with events in phase with the rest, at least: lamps 0.92, blades of a fan 0.78."""

    fewest_tiles: int = 6
    """With events."""

    steady: float = 0.88
    """Length of the mean of the directions of its blocks, at least: lamps 0.93, motion mostly less."""

    coherent: float = 0.35
    """Share of the power of tiles and blocks in that phase, at least: lamps 0.44, others that pass 0.24."""

    coherent_at_frames: float = 0.5
    """The same of a third or a quarter of the rate of a clip's frames: lamps 0.62; noise that is drawn for
    each frame 0.36."""

    swing: float = 0.17
    """Of the rate, at least: lamps 0.22, a pan over text 0.13."""

    balanced: float = 0.3
    """Share of the swing that is left less the balance of ON and OFF around, at least: lamps 0.35 and most
    0.6, scans of rows, which move both alike, 0.24."""

    of_scene: float = 0.2
    """Swing of the clip's own light in the place, relative to that of the events, from which on the tone is
    the scene's: 0.09 at most under lamps, 0.58 and more of what moves."""

    of_turns: float = 0.8
    """Share of the power of the light's change in the place that is of one slower tone and its multiples,
    from which on each of these is the scene's: pixels that see the same send together, at multiples of its
    rate. 0.99 in a clip whose light goes to and fro at 10 Hz."""

    at_their_times: float = 0.5
    """Amplitude of a tone in events at their own times, relative to that in counts, at least. In counts of
    1 ms tones look alike that are whole kHz apart, or add up to such: frames at 640 Hz look like 360 Hz.
    Lamps have 0.99 and more, that image 0.005."""

    most_of_all: float = 0.6
    """Share of the array from which on a lamp lights all of it."""


LAMP = LampSettings()


@dataclass(frozen=True)
class LampInPart:
    """A lamp, and where it lights.

    Args:
        entry: What is seen, as the signature of flicker.
        place: Pixels that it lights, shape (H, W).
    """

    entry: Signature
    place: NDArray[np.bool_]

    def lights_all(self, settings: LampSettings = LAMP) -> bool:
        """Whether it lights so much of the array that a model with a lamp everywhere is right."""
        return bool(self.place.mean() >= settings.most_of_all)

    def rest_of(self, measurement: Measurement) -> Measurement:
        """Return a measurement without what the lamp lights."""
        events = measurement.events
        dark = ~self.place.ravel()[row_major_pixels(events)]
        note = f"the {format_percent(float(self.place.mean()))} of the pixels under the lamp are not compared"
        out = replace(measurement, events=events.select(dark), notes=(*measurement.notes, note))
        return out.within(~self.place)

    def added_to(self, found: Diagnosis, library: Mapping[str, type[Effect]]) -> Diagnosis:
        """Return a diagnosis of the rest with the lamp; its model has none, for that would light everything.

        Args:
            found: Made of the rest.
            library: Effects that may be named, name to class.
        """
        names = told_by(self.entry, library) or (FLICKER,)
        others = tuple(one for one in found.findings if one.effect not in names)
        lamps = tuple(Finding(name, Grade.CERTAIN, seen=self.entry.sentence) for name in names)
        limits = tuple(one for one in found.not_seen if one.effect not in names)
        return replace(found, findings=(*lamps, *others), not_seen=limits)


def find_lamp_in_part(
    measurement: Measurement, *, log_eps: float, settings: LampSettings = LAMP
) -> LampInPart | None:
    """Return the lamp in a part of the array that stands out most; None where there is none.

    Args:
        measurement: Its scene is a clip; nothing is said of others.
        log_eps: Added to intensities before the logarithm.
        settings: Which tones are lamps.
    """
    scene, events, s = measurement.scene, measurement.compared_events(), settings
    if not isinstance(scene, VideoScene) or len(events) < 2000 or events.t[-1] - events.t[0] < 0.4:
        return None
    events = events.select(events.t < events.t[0] + s.longest)
    counts = _TileCounts.of(events, s)
    blocks = _blocks_of(counts, s)
    lamps = [
        one for one in _likely_tones(counts, blocks, s)
        if _is_lamp(one, clip_step_of(scene), counts.duration, s)
        and _share_at_their_times(one, counts, events) >= s.at_their_times
    ]  # fmt: skip
    if not lamps:
        return None
    # of a lamp and its overtones the strongest; if that is the scene's, pixels make the others of it
    lamp = max(lamps, key=lambda one: one.swing)
    place = lamp.place[counts.tile_of_pixel]
    light = _LightChange.of(measurement, place, log_eps=log_eps)
    if light.swing(lamp.frequency) >= s.of_scene * lamp.swing or light.has_multiple(lamp.frequency, s):
        return None
    return LampInPart(_signature_of(lamp, place, counts.duration, s), place)


@dataclass(frozen=True)
class _TileCounts:
    """Events by step and tile.

    Args:
        net: ON less OFF, shape (K, T).
        events: All, shape (K, T).
        tile_of_pixel: Shape (H, W).
        columns: Of tiles.
        rows: Of tiles.
        step: [s].
    """

    net: NDArray[np.float32]
    events: NDArray[np.float32]
    tile_of_pixel: NDArray[np.int64]
    columns: int
    rows: int
    step: float

    @property
    def duration(self) -> float:
        """Time of all steps [s]."""
        return len(self.net) * self.step

    @property
    def asked(self) -> NDArray[np.bool_]:
        """Tiles that have enough events to follow a tone, shape (T,)."""
        number = self.events.sum(0)
        out: NDArray[np.bool_] = number > 0.1 * np.median(number[number > 0])
        return out

    @classmethod
    def of(cls, events: Events, s: LampSettings) -> _TileCounts:
        """Count events, less those of pixels with three times as many as most others of their tile."""
        width, height = events.width, events.height
        side = max(s.tile, math.sqrt(width * height / s.most_tiles))
        columns, rows = max(1, round(width / side)), max(1, round(height / side))
        across, down = np.arange(width) * columns // width, np.arange(height) * rows // height
        tile = (down[:, None] * columns + across).ravel()
        pixel, tiles = row_major_pixels(events), columns * rows
        number = np.bincount(pixel, minlength=width * height)
        # the pixels of each tile by their events: a sixth from the top is usual, whatever a few hot ones send
        order = np.lexsort((number, tile))
        size = np.bincount(tile, minlength=tiles)
        first = np.concatenate(([0], np.cumsum(size)[:-1]))
        usual = number[order][first + (0.85 * size).astype(np.int64)]
        kept = (number <= 3 * np.maximum(usual, 3)[tile])[pixel]
        steps = ((events.t - events.t[0]) / s.step).astype(np.int64)
        place, count = steps[kept] * tiles + tile[pixel[kept]], (int(steps[-1]) + 1) * tiles
        sign = np.where(events.p[kept], 1.0, -1.0)
        net, every = (np.bincount(place, w, minlength=count).astype(np.float32) for w in (sign, None))
        shape = (-1, tiles)
        return cls(
            net.reshape(shape), every.reshape(shape), tile.reshape(height, width), columns, rows, s.step
        )


@dataclass(frozen=True)
class _Blocks:
    """What tiles do at tones in blocks of time.

    Args:
        tones: At which they are transformed [Hz], shape (C,).
        phasors: Of length 1 at most, so that no tile and no block makes a tone alone, shape (C, B, T).
        middle: Of each block [s], shape (B,).
    """

    tones: NDArray[np.float64]
    phasors: NDArray[np.complex64]
    middle: NDArray[np.float64]


def _blocks_of(counts: _TileCounts, s: LampSettings) -> _Blocks:
    length = round(s.block / s.step)
    hop = length // 2
    number = (len(counts.net) - length) // hop + 1
    tones = np.arange(s.tones[0], s.tones[1] + s.cell / 2, s.cell)
    window = np.hanning(length + 2)[1:-1]
    window /= np.sqrt((window**2).sum())
    turns = np.outer(tones, (np.arange(length) - (length - 1) / 2) * s.step)
    waves = (np.exp(-2j * np.pi * turns) * window).astype(np.complex64)
    both = np.concatenate([waves.real, waves.imag])
    squares = (window**2).astype(np.float32)
    phasors = np.empty((len(tones), number, counts.net.shape[1]), np.complex64)
    for block in range(number):
        rows = slice(block * hop, block * hop + length)
        net, chance = counts.net[rows], squares @ counts.events[rows]
        real, imaginary = np.split(both @ (net - net.mean(0)), 2)
        # chance alone has as much power as there are events
        scale = 1 / np.sqrt(real * real + imaginary * imaginary + chance + 1e-6)
        phasors[:, block].real = real * scale
        phasors[:, block].imag = imaginary * scale
    middle = (np.arange(number, dtype=np.float64) * hop + length / 2) * s.step
    return _Blocks(tones, phasors, middle)


@dataclass(frozen=True)
class _Tone:
    """A tone in a circle of tiles; see `LampSettings` for what its numbers tell."""

    frequency: float
    ratio: float
    agree: float
    tiles: int
    steady: float
    coherent: float
    swing: float
    balanced: float
    place: NDArray[
        np.bool_
    ]  # tiles that hang together with the circle's and have the tone in its phase, (T,)


def _circles(columns: int, rows: int, radii: tuple[float, ...]) -> NDArray[np.float32]:
    """Return which tiles are in which circle, shape (N, T)."""
    y, x = np.divmod(np.arange(columns * rows), columns)
    square = (x[:, None] - x) ** 2 + (y[:, None] - y) ** 2
    circles = np.concatenate([square <= radius * radius for radius in radii])
    out: NDArray[np.float32] = circles[circles.sum(1) >= 3].astype(np.float32)
    return out


def _likely_tones(counts: _TileCounts, blocks: _Blocks, s: LampSettings, many: int = 8) -> list[_Tone]:
    """Return the tones that stand out most, each where it does, half as much as a lamp at least."""
    tones = np.arange(*s.tones, 1 / (1.5 * counts.duration))
    cell = np.clip(np.rint((tones - s.tones[0]) / s.cell).astype(int), 0, len(blocks.tones) - 1)
    sums = np.empty((len(tones), counts.net.shape[1]), np.complex64)
    for one in np.unique(cell):
        here = np.flatnonzero(cell == one)
        turn = np.exp(-2j * np.pi * tones[here, None] * blocks.middle).astype(np.complex64)
        sums[here] = turn @ blocks.phasors[one]
    power = (blocks.phasors.real**2 + blocks.phasors.imag**2).sum(1)[cell]
    circles = _circles(counts.columns, counts.rows, s.radii)
    inside = power @ circles.T
    found = ((sums.real @ circles.T) ** 2 + (sums.imag @ circles.T) ** 2) / np.maximum(inside, 1e-6)
    found[inside < 0.2 * len(blocks.middle)] = 0.0
    # exponential with mean 1 by chance; what moves together without a tone raises all of a circle's alike
    ratio = found / np.maximum(np.median(found, 0) / math.log(2), 1)
    best, where = ratio.max(1), ratio.argmax(1)
    out: list[_Tone] = []
    while len(out) < many:
        top = int(best.argmax())
        if best[top] < 0.5 * s.ratio:
            break
        phasors = blocks.phasors[cell[top]]
        circle = circles[where[top]] > 0
        out.append(_look_at(counts, phasors, blocks.middle, float(tones[top]), circle, float(best[top])))
        best[np.abs(tones - tones[top]) < 5] = -1.0
    return out


def _look_at(
    counts: _TileCounts,
    phasors: NDArray[np.complex64],
    middle: NDArray[np.float64],
    frequency: float,
    circle: NDArray[np.bool_],
    ratio: float,
) -> _Tone:
    """Return what is to be known of a tone in a circle.

    Args:
        counts: Events by step and tile.
        phasors: Of the tone by block and tile, shape (B, T).
        middle: Of each block [s], shape (B,).
        frequency: To what the duration resolves [Hz].
        circle: Its tiles, shape (T,).
        ratio: See `LampSettings`.
    """
    together = phasors[:, circle].sum(1)
    for _ in range(2):  # where the directions of blocks agree best
        tried = frequency + 0.75 * np.linspace(-1, 1, 21) / counts.duration
        length = np.abs(np.exp(-2j * np.pi * tried[:, None] * middle) @ _directions(together))
        frequency = float(tried[length.argmax()])
    turned = phasors * np.exp(-2j * np.pi * frequency * middle)[:, None]
    tiles, power = turned.sum(0), (np.abs(phasors) ** 2).sum(0)
    whole = tiles[circle].sum()
    rest = np.where(circle, whole - tiles, whole)
    in_phase = np.abs(np.angle(tiles * np.conj(rest))) < np.pi / 4
    asked = counts.asked
    lit = circle & asked
    own = np.abs(tiles) ** 2 / np.maximum(power, 1e-9)
    together = turned[:, circle].sum(1)
    wave = np.exp(-2j * np.pi * frequency * (np.arange(len(counts.net)) + 0.5) * counts.step)
    net, every = counts.net[:, lit].sum(1), counts.events[:, lit].sum(1)
    box = np.ones(round(LAMP.block / counts.step))
    # ticks and scans move ON and OFF alike, and leave their balance as it is
    balance = np.convolve(net, box, "same") / np.maximum(np.convolve(every, box, "same"), 1)
    number = max(float(every.sum()), 1.0)
    coherent = np.abs(tiles[lit].sum()) ** 2 / max(lit.sum() * len(middle) * float(power[lit].sum()), 1e-9)
    return _Tone(
        frequency=frequency,
        ratio=ratio,
        agree=float(in_phase[lit].mean()) if lit.any() else 0.0,
        tiles=int(lit.sum()),
        steady=float(np.abs(_directions(together).mean())),
        coherent=float(coherent),
        swing=float(np.abs(((net - net.mean()) * wave).sum())) / number,
        balanced=float(np.abs(((net - every * balance) * wave).sum())) / number,
        place=_joined(in_phase & (own > 4) & asked, circle, counts.columns) | lit,
    )


def _directions(values: NDArray[np.complexfloating]) -> NDArray[np.complex128]:
    out: NDArray[np.complex128] = values / np.maximum(np.abs(values), 1e-9)
    return out


def _joined(some: NDArray[np.bool_], seed: NDArray[np.bool_], columns: int) -> NDArray[np.bool_]:
    """Return which of some tiles hang together with those of a seed, shape (T,)."""
    grid = some.reshape(-1, columns)
    out: NDArray[np.bool_] = binary_propagation(grid & seed.reshape(-1, columns), mask=grid).ravel()
    return out


def _is_lamp(tone: _Tone, step: float, duration: float, s: LampSettings) -> bool:
    """Return whether a tone is that of a lamp, by the events.

    Args:
        tone: What is known of it.
        step: From frame to frame of the clip [s]; 0 where that is not known.
        duration: Of the events [s].
        s: Limits.
    """
    part = _part_of_frames(tone.frequency, step, duration) if step else 0
    coherent = s.coherent_at_frames if part else s.coherent
    return (
        tone.ratio >= s.ratio
        and tone.tiles >= s.fewest_tiles
        and tone.agree >= s.agree
        and tone.steady >= s.steady
        and tone.coherent >= coherent
        and tone.swing >= s.swing
        and tone.balanced >= s.balanced * tone.swing
        and part not in (1, 2)  # frames come as often, or are alike in turns
    )


def _share_at_their_times(tone: _Tone, counts: _TileCounts, events: Events) -> float:
    """Return how strong a tone of counts is in events at their own times, relative to the counts.

    Args:
        tone: Found in the counts.
        counts: Of the events.
        events: All of them.
    """
    inside = tone.place[counts.tile_of_pixel].ravel()[row_major_pixels(events)]
    turn = -2j * np.pi * tone.frequency
    sign = np.where(events.p[inside], 1.0, -1.0)
    own = np.abs((sign * np.exp(turn * (events.t[inside] - events.t[0]))).sum())
    net = counts.net[:, tone.place].sum(1, dtype=np.float64)
    middle = (np.arange(len(net)) + 0.5) * counts.step
    counted = np.abs(((net - net.mean()) * np.exp(turn * middle)).sum())
    return float(own / max(counted, 1e-9))


def _part_of_frames(frequency: float, step: float, duration: float) -> int:
    """Return n up to 4 where a tone is k/n of the rate of frames, the least; 0 where it is none."""
    for part in range(1, 5):
        turns = part * frequency * step
        if round(turns) > 0 and abs(turns - round(turns)) / (part * step) < 1 / duration:
            return part
    return 0


@dataclass(frozen=True)
class _LightChange:
    """By how much the light of a clip goes in a place from instant to instant, all pixels together.

    Args:
        middle: Between two instants [s], shape (K,).
        rises: Of log intensity, shape (K,).
        falls: The same.
    """

    middle: NDArray[np.float64]
    rises: NDArray[np.float64]
    falls: NDArray[np.float64]

    @classmethod
    def of(cls, measurement: Measurement, place: NDArray[np.bool_], *, log_eps: float) -> _LightChange:
        """Return that of some pixels of a place, shape (H, W)."""
        times = times_that_are_compared(measurement)
        pixels = np.flatnonzero(place.ravel()).astype(np.int32)
        pixels = pixels[:: max(1, len(pixels) // 4000)]
        if len(times) < 3 or not len(pixels):
            return cls(*np.empty((3, 0)))
        change = np.diff(log_light_of(measurement.scene, times, pixels, log_eps=log_eps), axis=0)
        rises, falls = np.maximum(change, 0).sum(1, dtype=float), np.maximum(-change, 0).sum(1, dtype=float)
        return cls(0.5 * (times[1:] + times[:-1]), rises, falls)

    @property
    def duration(self) -> float:
        """From the first instant to the last, about [s]."""
        return max(float(self.middle[-1] - self.middle[0]), 1e-3)

    def swing(self, frequency: float) -> float:
        """Return by how much a tone moves the change, or rises or falls, relative to all.

        Above half of the rate of frames a tone looks like a slower one, in the light as in the events.
        """
        if not len(self.middle):
            return 0.0
        rises, falls = self.rises, self.falls
        tried = frequency + 0.7 * np.linspace(-1, 1, 9) / self.duration
        waves = np.exp(-2j * np.pi * tried[:, None] * self.middle)
        tones = (float(np.abs(waves @ (one - one.mean())).max()) for one in (rises - falls, rises, falls))
        return max(tones) / max(float((rises + falls).sum()), 1e-9)

    def has_multiple(self, frequency: float, s: LampSettings) -> bool:
        """Whether the light goes to and fro at a rate of which a tone is a multiple, and does little else."""
        if len(self.middle) < 16:
            return False
        net = (self.rises - self.falls) * np.hanning(len(self.middle))
        power = np.abs(np.fft.rfft(net - net.mean())) ** 2
        tones = np.fft.rfftfreq(len(net), self.duration / (len(net) - 1))
        slower = tones < 0.5 * frequency
        strongest = tones[slower][power[slower].argmax()]
        near = strongest + np.linspace(-1, 1, 41) / self.duration
        waves = np.exp(-2j * np.pi * near[:, None] * self.middle)
        rate = float(near[np.abs(waves @ net).argmax()])
        if rate < 2 / self.duration:
            return False
        # a window as this one spreads a tone over two steps on either side
        off = np.abs(tones - rate * np.rint(tones / rate))
        of_rate = float(power[(tones > 0.5 * rate) & (off <= 2.5 / self.duration)].sum())
        multiple = abs(frequency - rate * round(frequency / rate)) <= 1 / self.duration
        return multiple and of_rate >= s.of_turns * float(power.sum())


def _signature_of(tone: _Tone, place: NDArray[np.bool_], duration: float, s: LampSettings) -> Signature:
    """Return a lamp as the signature of flicker, in words."""
    tests = 2 * (s.tones[1] - s.tones[0]) * duration * len(tone.place)
    # half overlapping blocks are worth three quarters as many
    p = min(1.0, tests * math.exp(-0.75 * tone.ratio))
    y, x = np.nonzero(place)
    where = (
        f"around pixel ({x.mean():.0f}, {y.mean():.0f}), {format_percent(float(place.mean()))} of the array"
    )
    off = 0.1 / duration
    return Signature(
        name=FLICKER, answer=Answer.FOUND, p=p, size=tone.swing,
        unit="swing, share of the rate", least=s.swing,
        sentence=f"light at {tone.frequency:.2f} Hz, swing {tone.swing:.2g} of the rate, {where}",
        details={
            "frequency": tone.frequency, "frequency_low": tone.frequency - off,
            "frequency_high": tone.frequency + off,
        },
    )  # fmt: skip
