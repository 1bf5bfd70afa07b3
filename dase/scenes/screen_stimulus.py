"""What a screen shows to a camera: a programme of test pictures, frame by frame, and the file that tells it.

A frame is a picture of 8-bit levels. Its light is known from the levels and the screen's gamma, so the video
that is played and the scene that a fit is made with are the same frames.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dase.errors import InputError
from dase.files.text_files import parse_json, read_text_file
from dase.scenes.light import SRGB_GAMMA, check_gamma

Levels = NDArray[np.uint8]
Draw = Callable[[float, int], Levels]
"""From the time in a segment [s] and its frame to levels, shape (height, width)."""

DITHER = 1
"""Level that stands for a chequerboard of black and white pixels: half of white whatever the gamma is."""

PARTS = ("ladder", "steps", "ramps", "chirp", "edges")
"""What may be shown between the flashes, in this order."""

FORMAT = "dase stimulus"
VERSION = 1


@dataclass(frozen=True)
class ProgrammeSettings:
    """Lengths and strengths of what is shown; those of a file of another version may have been others."""

    rest: float = 0.4
    """Grey before the first flash and after the last [s]: pixels settle."""
    slot: float = 0.1
    """Length of one bit of a flash or of a mark [s]: pixels with a cutoff of 10 Hz still follow."""
    begin_code: str = "0100111010"
    end_code: str = "0101100110"
    """Full-screen flashes: which slots are bright. Both end dark, and neither is like the other."""
    columns: int = 6
    rows: int = 4
    """Marks, and tiles of the other pictures."""
    mark_radius: float = 0.28
    """Radius of a mark as a share of its tile's shorter side."""
    dark: float = 0.04
    bright: float = 0.9
    """Light of marks: 22 times apart, and both well above what a screen leaves in black."""
    flash_dark: float = 0.15
    flash_bright: float = 0.45
    """Light of flashes: a few events of each pixel at once, which a full bus still sends within a slot."""
    low: float = 0.02
    """Least light of the other pictures: 8 bits have steps of 5 % there at a gamma of 2.2."""
    gamma_span: float = 0.7
    """Log light around one half that the greys beside the chequerboard cover."""
    gamma_flips: int = 10
    """Changes between grey and chequerboard."""
    ladder: float = 1.6
    """Time at rest [s]."""
    step_sizes: tuple[float, ...] = (0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0, 1.3, 1.6, 2.0, 2.5, 3.0)
    """Contrast of steps [log intensity]; those that leave the range are cut at its ends."""
    step_time: float = 0.25
    step_count: int = 8
    """A level is held so long [s], and changes so often."""
    ramp_slopes: tuple[float, ...] = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
    """Slopes of log ramps [log intensity / s]."""
    ramps: float = 2.4
    chirp: float = 2.4
    edges: float = 2.6
    """Lengths [s]."""
    chirp_from: float = 0.5
    """First frequency of the chirp [Hz]; the last is half of the refresh rate."""
    chirp_swing: float = 0.7
    """Half of its range [log intensity]."""
    edge_speeds: tuple[float, ...] = (0.06, 0.12, 0.25, 0.5, 1.0, 2.0)
    """Speeds of edges, in screen widths per second; half of the bands go to the left."""


PROGRAMME = ProgrammeSettings()


@dataclass(frozen=True)
class Segment:
    """A part of what is shown.

    Args:
        kind: What it is: `rest`, `flash`, `marks`, `gamma`, or one of `PARTS`.
        begin: First frame.
        end: First frame that is not of it any more.
        about: What is seen and what for, in a sentence.
        values: Numbers that say what is seen, light relative to white.
    """

    kind: str
    begin: int
    end: int
    about: str
    values: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Mark:
    """A disc of the marks by which a picture of the screen is found again.

    Args:
        x: Column of its middle on the screen [px].
        y: Row of its middle on the screen [px].
        radius: Of the disc [px].
        code: In which slots it is bright, `0` and `1`.
    """

    x: float
    y: float
    radius: float
    code: str


@dataclass(frozen=True, eq=False)
class ScreenStimulus:
    """A video of test pictures, as it is played and as light.

    Args:
        refresh: Frames per second [Hz].
        size: Columns and rows [px].
        gamma: The screen's: light is (level / 255) ** gamma.
        black: Light of level 0 relative to white: the screen's own, and what it reflects.
        parts: Which of `PARTS` are shown.
        gamma_given: Whether `gamma` is known; else it is what screens are adjusted to, and a fit finds it.

    Raises:
        InputError: A number is out of range, or a part is not known.
    """

    refresh: float = 60.0
    size: tuple[int, int] = (1280, 720)
    gamma: float = SRGB_GAMMA
    black: float = 0.001
    parts: tuple[str, ...] = PARTS
    gamma_given: bool = False

    def __post_init__(self) -> None:
        width, height = self.size
        if not (math.isfinite(self.refresh) and 20 <= self.refresh <= 1000):
            raise InputError(f"refresh must lie in 20..1000 Hz, got {self.refresh:g}", argument="refresh")
        if not (96 <= width <= 7680 and 64 <= height <= 4320) or width % 2 or height % 2:
            raise InputError(
                f"size of a screen must be even and lie between 96x64 and 7680x4320, got {width}x{height}"
            )
        check_gamma(self.gamma)
        if not (0 <= self.black <= 0.05):
            raise InputError(f"black must lie in 0..0.05 of white, got {self.black:g}", argument="black")
        for part in self.parts:
            if part not in PARTS:
                raise InputError(f"parts must be of {', '.join(PARTS)}, got '{part}'", argument="parts")

    def __repr__(self) -> str:
        width, height = self.size
        return (
            f"ScreenStimulus({width}x{height} pixels, {self.refresh:g} Hz, {self.duration:.3g} s: "
            f"{', '.join(self.parts)})"
        )

    @property
    def duration(self) -> float:
        """Length [s]."""
        return self.frame_count / self.refresh

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return self.segments[-1].end

    @property
    def segments(self) -> tuple[Segment, ...]:
        """What is shown, in order of time."""
        return tuple(segment for segment, _ in self._programme)

    def segment_of(self, kind: str, which: int = 0) -> Segment:
        """Return a segment of a kind, the first or another one."""
        return [segment for segment in self.segments if segment.kind == kind][which]

    def light_of_levels(self, gamma: float | None = None) -> NDArray[np.float64]:
        """Return the light of each level relative to white, shape (256,).

        Args:
            gamma: Of the screen; None for the one that the stimulus was made for.
        """
        share = np.linspace(0, 1, 256) ** (self.gamma if gamma is None else gamma)
        light = self.black + (1 - self.black) * share
        light[DITHER] = 0.5 * (light[0] + light[255])
        return light

    def level_of(self, light: Any) -> Levels:
        """Return the nearest levels that show some light in 0..1 relative to white, of any shape."""
        share = np.clip((np.asarray(light, np.float64) - self.black) / (1 - self.black), 0, 1)
        level = np.rint(255 * share ** (1 / self.gamma)).astype(np.uint8)
        return np.where(level == DITHER, np.uint8(2), level)

    def levels(self, frame: int) -> Levels:
        """Return a frame, shape (height, width); `DITHER` stands for a chequerboard of black and white.

        Args:
            frame: Its number; before the first and after the last the screen is at rest.
        """
        frame = min(max(frame, 0), self.frame_count - 1)
        for segment, draw in self._programme:
            if frame < segment.end:
                return draw((frame - segment.begin) / self.refresh, frame - segment.begin)
        raise AssertionError

    def picture(self, frame: int) -> Levels:
        """Return a frame as it is shown, shape (height, width)."""
        levels = self.levels(frame)
        y, x = np.nonzero(levels == DITHER)
        if not len(y):
            return levels
        out = levels.copy()
        out[y, x] = 255 * ((x + y) % 2)
        return out

    @cached_property
    def marks(self) -> tuple[Mark, ...]:
        """The marks, row by row."""
        (width, height), s = self.size, PROGRAMME
        wide, tall = width / s.columns, height / s.rows
        radius = s.mark_radius * min(wide, tall)
        codes = mark_codes(s.columns * s.rows, len(s.begin_code))
        return tuple(
            Mark((n % s.columns + 0.5) * wide, (n // s.columns + 0.5) * tall, radius, code)
            for n, code in enumerate(codes)
        )

    @cached_property
    def _programme(self) -> list[tuple[Segment, Draw]]:
        builder = _Programme(self)
        builder.build()
        return builder.done

    def as_truth(self, video: str | None = None) -> dict[str, Any]:
        """Return what a file says of it: plain numbers, times in seconds, light relative to white.

        Args:
            video: Name of the file of the video.
        """
        return {
            "format": FORMAT,
            "version": VERSION,
            "video": video,
            "refresh": self.refresh,
            "size": list(self.size),
            "duration": self.duration,
            "gamma": self.gamma,
            "gamma_given": self.gamma_given,
            "black": self.black,
            "parts": list(self.parts),
            "light": "light = black + (1 - black) * (level / 255) ** gamma, relative to white",
            "dither": "chequerboards of black and white pixels shine with half of white, whatever gamma is",
            "marks": [asdict(mark) for mark in self.marks],
            "segments": [
                {
                    "kind": segment.kind,
                    "begin": segment.begin / self.refresh,
                    "end": segment.end / self.refresh,
                    "about": segment.about,
                    **segment.values,
                }
                for segment in self.segments
            ],
        }


def read_stimulus(path: Path) -> ScreenStimulus:
    """Return the stimulus that a file written beside a video tells.

    Raises:
        InputError: It is no such file, or of another version.
    """
    if not path.is_file():
        raise InputError(f"stimulus {path} does not exist")
    truth = parse_json(read_text_file(path, "stimulus"), f"stimulus {path}")
    if not isinstance(truth, dict) or truth.get("format") != FORMAT:
        raise InputError(f"stimulus {path}: is not the JSON that dase stimulus writes beside a video")
    if truth.get("version") != VERSION:
        raise InputError(
            f"stimulus {path}: is of version {truth.get('version')}, this dase reads version {VERSION}: "
            "write and record it anew, or use the dase that wrote it"
        )
    try:
        width, height = (int(n) for n in truth["size"])
        made = ScreenStimulus(
            refresh=float(truth["refresh"]), size=(width, height), gamma=float(truth["gamma"]),
            black=float(truth["black"]), parts=tuple(truth["parts"]), gamma_given=bool(truth["gamma_given"]),
        )  # fmt: skip
        told = [(s["kind"], round(s["begin"] * made.refresh), round(s["end"] * made.refresh))
                for s in truth["segments"]]  # fmt: skip
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        if isinstance(error, InputError):
            raise InputError(f"stimulus {path}: {error}") from None
        raise InputError(f"stimulus {path}: a value is missing or of the wrong type: {error}") from None
    if told != [(s.kind, s.begin, s.end) for s in made.segments]:
        raise InputError(f"stimulus {path}: its segments are not those that its numbers make")
    return made


def truth_text(stimulus: ScreenStimulus, video: str | None = None) -> str:
    """Return the text of the file that `read_stimulus` reads."""
    return json.dumps(stimulus.as_truth(video), indent=1) + "\n"


def mark_codes(count: int, slots: int) -> list[str]:
    """Return codes of which each is bright in half of its slots, and that change unlike each other.

    Args:
        count: How many are wanted.
        slots: Length of a code.

    Raises:
        ValueError: There are not so many.
    """
    every = [c for c in (f"{n:0{slots}b}" for n in range(1 << slots)) if c.count("1") == slots // 2]
    changes = {c: code_changes(c) for c in every}
    # codes that change in few slots show few events
    every = [c for c in every if np.abs(changes[c]).sum() >= slots // 2]
    chosen: list[str] = []
    for alike in (0.3, 0.45, 0.6, 0.75):
        for code in every:
            if len(chosen) == count:
                return chosen
            if code not in chosen and all(
                _likeness(changes[code], changes[other]) <= alike for other in chosen
            ):
                chosen.append(code)
    if len(chosen) < count:
        raise ValueError(f"{slots} slots have not {count} codes")
    return chosen


def code_changes(code: str) -> NDArray[np.float64]:
    """Return the changes of a code that begins and ends dark, -1, 0 or 1, shape (len(code) + 1,)."""
    return np.diff(np.array([0, *map(int, code), 0], np.float64))


def _likeness(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(a @ b / math.sqrt(float((a @ a) * (b @ b))))


class _Programme:
    """Puts the segments together."""

    def __init__(self, stimulus: ScreenStimulus):
        self.stimulus = stimulus
        self.done: list[tuple[Segment, Draw]] = []
        s = PROGRAMME
        width, height = stimulus.size
        self.column = np.arange(width) * s.columns // width
        self.row = np.arange(height) * s.rows // height
        self.tiles = s.columns * s.rows
        self.grey = float(math.sqrt(s.low))  # the middle of what is shown, in log

    def build(self) -> None:
        s = PROGRAMME
        self.add("rest", s.rest, "Grey: pixels settle.", self.uniform(self.grey), light=self.grey)
        self.flash(s.begin_code, "begins")
        self.show_marks()
        self.gamma_tiles()
        for part in self.stimulus.parts:
            getattr(self, part)()
        self.show_marks()
        self.flash(s.end_code, "ends")
        self.add("rest", s.rest, "Grey.", self.uniform(self.grey), light=self.grey)

    def add(self, kind: str, seconds: float, about: str, draw: Draw, **values: Any) -> None:
        begin = self.done[-1][0].end if self.done else 0
        frames = max(1, round(seconds * self.stimulus.refresh))
        self.done.append((Segment(kind, begin, begin + frames, about, values), draw))

    def uniform(self, light: float) -> Draw:
        width, height = self.stimulus.size
        level = self.stimulus.level_of(light)
        return lambda time, frame: np.full((height, width), level, np.uint8)

    def of_tiles(self, light: NDArray[np.float64]) -> Levels:
        """Return a frame of the light of each tile, shape (tiles,)."""
        return self.tile_levels(self.stimulus.level_of(light))

    def tile_levels(self, level: Levels) -> Levels:
        grid = level.reshape(PROGRAMME.rows, PROGRAMME.columns)
        return grid[self.row[:, None], self.column[None, :]]

    def frames(self, seconds: float) -> int:
        return max(1, round(seconds * self.stimulus.refresh))

    def flash(self, code: str, what: str) -> None:
        s, slot = PROGRAMME, self.frames(PROGRAMME.slot)
        dark, bright = (self.uniform(light) for light in (s.flash_dark, s.flash_bright))

        def draw(time: float, frame: int) -> Levels:
            return (bright if code[frame // slot] == "1" else dark)(time, frame)

        about = f"Flashes of the whole screen by which a recording tells when the video {what}."
        self.add(
            "flash", len(code) * slot / self.stimulus.refresh, about, draw,
            code=code, slot=slot / self.stimulus.refresh, dark=s.flash_dark, bright=s.flash_bright,
        )  # fmt: skip

    def show_marks(self) -> None:
        s, slot, marks = PROGRAMME, self.frames(PROGRAMME.slot), self.stimulus.marks
        width, height = self.stimulus.size
        y, x = np.indices((height, width)) + 0.5
        which = np.full((height, width), len(marks))
        for n, mark in enumerate(marks):
            which[np.hypot(x - mark.x, y - mark.y) <= mark.radius] = n
        slots = len(marks[0].code) + 1
        dark, bright = self.stimulus.level_of([s.dark, s.bright])

        def draw(time: float, frame: int) -> Levels:
            at = min(frame // slot, slots - 1)
            lit = [at < slots - 1 and mark.code[at] == "1" for mark in marks]
            out: Levels = np.where([*lit, False], bright, dark).astype(np.uint8)[which]
            return out

        about = "Discs that flash, each with a code of its own: they tell where the screen is in the picture."
        self.add(
            "marks", slots * slot / self.stimulus.refresh, about, draw,
            slot=slot / self.stimulus.refresh, dark=s.dark, bright=s.bright,
        )  # fmt: skip

    def gamma_tiles(self) -> None:
        s, slot = PROGRAMME, self.frames(PROGRAMME.slot)
        logs = np.linspace(-s.gamma_span, s.gamma_span, self.tiles)
        # a mixed order: brightness must not go with the place on the screen
        logs = logs[np.random.default_rng(2).permutation(self.tiles)]
        level = self.stimulus.level_of(0.5 * np.exp(logs))
        grey = self.tile_levels(level)
        chequered = self.tile_levels(np.full(self.tiles, DITHER, np.uint8))

        def draw(time: float, frame: int) -> Levels:
            return grey if frame // slot % 2 else chequered

        about = (
            "Tiles go between a chequerboard of black and white pixels and greys: the grey at which neither "
            "ON nor OFF events come shines with half of white, which tells the screen's gamma."
        )
        self.add(
            "gamma", (s.gamma_flips + 1) * slot / self.stimulus.refresh, about, draw,
            slot=slot / self.stimulus.refresh, levels=[int(v) for v in level],
        )  # fmt: skip

    def ladder(self) -> None:
        s = PROGRAMME
        light = np.geomspace(s.low, 1.0, self.tiles)
        frame = self.of_tiles(light)
        about = "A grey ladder at rest: noise, leak and hot pixels over brightness."
        self.add("ladder", s.ladder, about, lambda time, number: frame, light=light.tolist())

    def steps(self) -> None:
        s, slot = PROGRAMME, self.frames(PROGRAMME.step_time)
        size = np.resize(np.array(s.step_sizes), self.tiles)
        rng = np.random.default_rng(1)
        # the middle of the two levels, so that both are within the range
        room = np.maximum(-math.log(s.low) - size, 0)
        middle = math.log(s.low) + 0.5 * size + rng.uniform(0, 1, self.tiles) * room
        light = [np.exp(np.clip(middle + half * size, math.log(s.low), 0)) for half in (-0.5, 0.5)]
        both = [self.of_tiles(v) for v in light]
        shown = [self.stimulus.light_of_levels()[self.stimulus.level_of(v)] for v in light]
        about = "Contrast steps up and down, of another size and about another grey in each tile: thresholds."
        self.add(
            "steps", (s.step_count + 1) * slot / self.stimulus.refresh, about,
            lambda time, frame: both[frame // slot % 2],
            slot=slot / self.stimulus.refresh, low=shown[0].tolist(), high=shown[1].tolist(),
            contrast=np.log(shown[1] / shown[0]).tolist(),
        )  # fmt: skip

    def ramps(self) -> None:
        s = PROGRAMME
        slope = np.resize(np.array(s.ramp_slopes), self.tiles)
        span = -math.log(s.low)

        def draw(time: float, frame: int) -> Levels:
            # up and down, a triangle in log light
            at = np.abs((time * slope / span + 1) % 2 - 1)
            return self.of_tiles(s.low * np.exp(span * at))

        about = "Log light goes up and down at several slopes, in steps of a refresh and of 8 bits."
        self.add("ramps", s.ramps, about, draw, slopes=slope.tolist(), low=s.low)

    def chirp(self) -> None:
        s, last = PROGRAMME, 0.5 * self.stimulus.refresh
        growth = math.log(last / s.chirp_from) / s.chirp
        middle = np.linspace(math.log(s.low) + s.chirp_swing, -s.chirp_swing, self.tiles)

        def draw(time: float, frame: int) -> Levels:
            phase = 2 * math.pi * s.chirp_from * math.expm1(growth * time) / growth
            return self.of_tiles(np.exp(middle + s.chirp_swing * math.sin(phase)))

        about = f"Flicker from {s.chirp_from:g} Hz to half of the refresh rate: bandwidth up to that."
        self.add(
            "chirp", s.chirp, about, draw,
            frequency=[s.chirp_from, last], swing=s.chirp_swing, light=np.exp(middle).tolist(),
        )  # fmt: skip

    def edges(self) -> None:
        s = PROGRAMME
        width, height = self.stimulus.size
        bands = len(s.edge_speeds)
        band = np.arange(height) * bands // height
        rng = np.random.default_rng(3)
        # bars of a few widths of an edge's way within a tenth of a second, at least some pixels
        wide = np.maximum(np.array(s.edge_speeds) * 0.15, 0.03) * width
        greys = rng.uniform(math.log(s.low), 0, (bands, 257))
        way = np.where(np.arange(bands) % 2, -1, 1) * np.array(s.edge_speeds) * width
        level = np.stack([self.stimulus.level_of(np.exp(row)) for row in greys])
        x = np.arange(width)

        def draw(time: float, frame: int) -> Levels:
            rows = [
                level[b, np.floor((x - round(way[b] * time)) / wide[b]).astype(int) % level.shape[1]]
                for b in range(bands)
            ]
            return np.stack(rows)[band]

        about = "Bars of many greys that go to the right and to the left at several speeds."
        self.add("edges", s.edges, about, draw, speeds=(way / 1.0).tolist(), bar_widths=wide.tolist())
