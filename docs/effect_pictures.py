"""Draw what each effect does to events, for docs/effects.md: python docs/effect_pictures.py [NAME ...]."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

import dase
from dase.effects import EFFECTS, Effect
from dase.events import Events
from dase.figures.style import Colour, add_legend, label_axes, log_axis, place_axes, titled_figure

FOLDER = Path(__file__).parent / "effects"
Array = NDArray[np.float64]

LIGHT = np.geomspace(0.002, 0.3, 200)
"""Brightness of the pixels of a raster, one pixel each."""


@dataclass(frozen=True)
class Raster:
    """Pixels in a row, one dot for each event over time.

    Args:
        light: Intensity at times [s], shape (T,), for the pixels, shape (T, N).
        seconds: How long.
        places: Where pixels lie on the vertical axis, shape (N,).
        label: Of that axis.
        shown: First and last time that is shown [s].
        log: Whether the vertical axis is logarithmic.
        step: Between samples [s].
    """

    light: Callable[[Array], Array]
    seconds: float
    places: Array
    label: str = "intensity"
    shown: tuple[float, float] = (0.0, np.inf)
    log: bool = True
    step: float = 5e-4

    def scene(self) -> dase.VideoScene:
        """Return what the pixels see."""
        times = np.arange(round(self.seconds / self.step) + 1) * self.step
        return dase.VideoScene(self.light(times)[:, None].astype(np.float32), times)

    def draw(self, axes: Axes, events: Events, most: int) -> None:
        """Draw the events, with dots as large as those of the busier side can be."""
        first, last = self.shown[0], min(self.shown[1], self.seconds)
        seen = events.select((events.t >= first) & (events.t <= last))
        size = float(np.clip(6e3 * self.seconds / (last - first) / max(most, 1), 0.7, 9.0))
        for polarity, colour in ((False, Colour.OFF), (True, Colour.ON)):
            mine = seen.select(seen.p == polarity)
            axes.scatter(1e3 * mine.t, self.places[mine.x], s=size, c=colour, lw=0)
        axes.set(xlim=(1e3 * first, 1e3 * last), ylim=(self.places[0], self.places[-1]))
        if not self.log:
            axes.set(ylim=(self.places[0] - 0.5, self.places[-1] + 0.5))
        if self.log:
            log_axis(axes, "y")
        label_axes(axes, "time [ms]", self.label)


@dataclass(frozen=True)
class Lines:
    """Rows of a whole sensor, one dot for every sixteenth event over some milliseconds.

    Args:
        shown: First and last time [s].
    """

    shown: tuple[float, float]

    def scene(self) -> dase.VideoScene:
        """Return light that rises everywhere within a millisecond."""
        times = np.arange(121) * 1e-4
        rise = np.clip((times - 5e-3) / 1e-3, 0, 1)
        light = 0.2 * np.exp(1.0 * rise)[:, None, None] * np.ones((1, 120, 160))
        return dase.VideoScene(light.astype(np.float32), times)

    def draw(self, axes: Axes, events: Events, most: int) -> None:
        """Draw the events."""
        seen = events.select((events.t >= self.shown[0]) & (events.t <= self.shown[1]))
        # the same share on both sides, so that they can be compared
        seen = seen.select(np.random.default_rng(0).permutation(len(seen))[: len(seen) // 16])
        for polarity, colour in ((False, Colour.OFF), (True, Colour.ON)):
            mine = seen.p == polarity
            axes.scatter(1e3 * seen.t[mine], seen.y[mine], s=1.2, c=colour, lw=0)
        axes.set(xlim=(1e3 * self.shown[0], 1e3 * self.shown[1]), ylim=(120, 0))
        label_axes(axes, "time [ms]", "row")


@dataclass(frozen=True)
class Picture:
    """A drawing that moves, its events counted over some milliseconds.

    Args:
        window: For so long [s].
        speed: Of the drawing [px/s]; 0 for light that is the same everywhere and always.
        size: Columns and rows [px].
        coloured: Whether what is brightest is red instead, of the grey of the ground.
    """

    window: float = 0.012
    speed: float = 160.0
    size: tuple[int, int] = (160, 100)
    coloured: bool = False

    def scene(self) -> dase.VideoScene:
        """Return the drawing, moving to the left."""
        times = np.arange(61) * 1e-3
        if not self.speed:
            return dase.VideoScene(np.full((61, *self.size[::-1]), 0.15, np.float32), times)
        drawing = draw_shapes(self.size, round(self.speed * times[-1]) + 2)
        frames = [
            cv2.warpAffine(drawing, np.float32([[1, 0, -self.speed * t], [0, 1, 0]]), self.size)
            for t in times
        ]
        light = np.clip(frames, 0.002, 1).astype(np.float32)
        return dase.VideoScene(turn_red(light) if self.coloured else light, times)

    def draw(self, axes: Axes, events: Events, most: int) -> None:
        """Draw the events, the more of a pixel the darker."""
        middle = 0.06 - self.window / 2
        counts = events.counts([middle - self.window / 2, middle + self.window / 2])[0]
        colours = [[int(code[i : i + 2], 16) / 255 for i in (1, 3, 5)] for code in (Colour.OFF, Colour.ON)]
        total = counts.sum(0)
        mixed = np.tensordot(counts / np.maximum(total, 1), np.array(colours), axes=(0, 0))
        alpha = (1 - 0.45 ** total.clip(0, 4))[..., None]
        axes.imshow(1 - alpha * (1 - mixed), interpolation="nearest")
        axes.set(xticks=[], yticks=[])
        axes.spines[["top", "right"]].set_visible(True)
        for spine in axes.spines.values():
            spine.set(color=Colour.LINE, linewidth=0.8)


def draw_shapes(size: tuple[int, int], more: int) -> NDArray[np.float32]:
    """Return shapes of several contrasts, with `more` columns to move by, intensity, shape (H, W)."""
    fine = 8
    wide, tall = (size[0] + more) * fine, size[1] * fine
    out = np.full((tall, wide), 0.15, np.float32)
    for n, x in enumerate(range(12, size[0] + more, 34)):
        high, low = (28, 74) if n % 2 else (72, 26)
        cv2.circle(out, (x * fine, high * fine), 15 * fine, 0.75, -1)
        cv2.circle(out, (x * fine, high * fine), 8 * fine, 0.2, -1)
        box = cv2.boxPoints(((x * fine, low * fine), (20 * fine, 20 * fine), 25.0 + 20 * n)).astype(np.int32)
        cv2.fillPoly(out, [box], 0.04 if n % 2 else 0.6)
        for bar in range(3):
            left = (x + 14 + 5 * bar) * fine
            cv2.rectangle(out, (left, (low - 12) * fine), (left + 2 * fine, (low + 12) * fine), 0.4, -1)
    return cv2.resize(out, None, fx=1 / fine, fy=1 / fine, interpolation=cv2.INTER_AREA)


def turn_red(light: NDArray[np.float32], ground: float = 0.15) -> NDArray[np.float32]:
    """Return red, green and blue, shape (F, H, W, 3): what is bright is red, of the luma of the ground."""
    share = np.clip((light - ground) / 0.25, 0, 1)[..., None]
    red = np.float32([0.35, -0.35 * 0.21 / 0.72, 0.0])
    return np.minimum(light, ground)[..., None] + share * red


def steps(times: Array) -> Array:
    """Return light that becomes three times as bright for 80 ms."""
    bright = (times > 0.04) & (times < 0.12)
    return LIGHT[None] * np.where(bright, 3.0, 1.0)[:, None]


def slopes(times: Array) -> Array:
    """Return light that slowly becomes three times as bright, and falls back, so that events lie apart."""
    way = np.interp(times, [0.02, 0.08, 0.12, 0.18], [0.0, 1.0, 1.0, 0.0])
    return LIGHT[None] * 3.0 ** way[:, None]


def rest(times: Array) -> Array:
    """Return light that does not change."""
    return np.broadcast_to(LIGHT, (len(times), len(LIGHT)))


SWINGS = np.geomspace(0.2, 20.0, 200)
"""Frequencies of light that swings, one pixel each [Hz]."""
RAMPS = np.geomspace(5.0, 1000.0, 200)
"""Slopes of light that rises, one pixel each [log intensity / s]."""


def swings(times: Array) -> Array:
    """Return light that swings, every pixel at a frequency of its own."""
    return 0.1 * np.exp(0.8 * np.sin(2 * np.pi * SWINGS * times[:, None]))


def ramps(times: Array) -> Array:
    """Return light that rises and falls again, every pixel at a slope of its own."""
    around = np.abs((RAMPS * times[:, None] + 2) % 8 - 4)
    return 0.01 * np.exp(around - 2)


def half_lit(times: Array) -> Array:
    """Return the same, with a lamp of 100 Hz over the brighter half of the pixels."""
    lamp = 1 + 0.5 * np.sin(2 * np.pi * 100 * times)[:, None]
    return steps(times) * np.where(np.arange(len(LIGHT)) < len(LIGHT) // 2, 1.0, lamp)


def falls(times: Array) -> Array:
    """Return light that falls fast, the same everywhere."""
    return 0.9 * np.exp(-3e3 * times)[:, None] * np.ones(30)


STEPS = Raster(steps, 0.2, LIGHT)
SLOPES = Raster(slopes, 0.2, LIGHT)
ALIKE = Raster(
    lambda times: 0.1 * np.exp(0.7 * np.sin(2 * np.pi * 10 * times))[:, None] * np.ones(10),
    0.4, np.arange(10.0), "pixel", log=False,
)  # fmt: skip
REST = Raster(rest, 4.0, LIGHT, step=2e-3)


@dataclass(frozen=True)
class Shown:
    """How an effect is shown.

    Args:
        effect: With it.
        view: What pixels see, and how events are drawn.
        words: What is to be seen.
        beside: Effects that both sides have.
        phase: Spread of the pixels' memories at the start.
        other: What stands in its place on the left; None for nothing.
        left: Words over the left side.
        right: Words over the right side.
    """

    effect: Effect
    view: Raster | Lines | Picture
    words: str
    beside: tuple[Effect, ...] = field(default=())
    phase: float = 1.0
    other: Effect | None = None
    left: str = "without"
    right: str = "with"


def shown() -> dict[str, Shown]:
    """Return how each effect is shown."""
    e = EFFECTS
    step_words = "Light triples at 40 ms and falls back at 120 ms"
    slope_words = "Light triples from 20 to 80 ms and falls back from 120 to 180 ms"
    return {
        "optics_blur": Shown(
            e["optics_blur"](sigma=2.0), Picture(), "Edges are wider and fine texture is gone: fewer events."
        ),
        "bayer": Shown(
            e["bayer"](), Picture(size=(80, 50), speed=80.0, coloured=True),
            "Red shapes on a ground of the same grey: only pixels behind filters see them."
        ),
        "flicker": Shown(
            e["flicker"](frequency=100.0, depth=0.5), STEPS,
            f"{step_words}; the lamp makes events in every cycle besides, at all intensities alike.",
        ),
        "vignetting": Shown(
            e["vignetting"](loss=0.8), Picture(0.05, 0.0),
            "Shot noise under a plain light: it falls with light, so dark corners have more of it.",
            beside=(e["shot"](rate=60.0, bright=0.0, knee=0.05),),
        ),
        "dark": Shown(
            e["dark"](current=0.03), SLOPES,
            f"{slope_words}: below the dark current, 0.03, the same contrast makes fewer events, or none.",
        ),
        "dark_shared": Shown(
            e["dark"](current=0.01), STEPS,
            f"{step_words}, with a bandwidth of 300 Hz: its speed in the dark is that of the dark current.",
            beside=(e["bandwidth"](cutoff=300.0),),
            other=e["dark"](current=0.01, speed="own"), left="speed own, 0.07 beside", right="speed shared",
        ),
        "linlog": Shown(
            e["linlog"](knee=0.0784), SLOPES,
            f"{slope_words}: below the knee, 0.08, the response is linear: fewer events.",
        ),
        "bandwidth": Shown(
            e["bandwidth"](cutoff=300.0, dark=0.01), STEPS,
            f"{step_words}: events of a step are spread over time, most of all in the dark.",
        ),
        "second_order": Shown(
            e["second_order"](cutoff=300.0, damping=0.3, dark=0.01), STEPS,
            f"{step_words}: with little damping the response overshoots and rings.",
        ),
        "second_order_apart": Shown(
            e["second_order"](cutoff=150.0, damping=0.3, dark=0.01, poles="apart"), STEPS,
            f"{step_words}: with a fixed pole only bright pixels ring.",
            other=e["second_order"](cutoff=150.0, damping=0.3, dark=0.01),
            left="poles alike", right="poles apart",
        ),
        "voltage_noise": Shown(
            e["voltage_noise"](sigma=0.08, cutoff=100.0, knee=0.03), REST,
            "Light that does not change: noise crosses levels, often in pixels that began near one.",
        ),
        "high_pass": Shown(
            e["high_pass"](cutoff=2.0),
            Raster(swings, 3.0, SWINGS, "frequency of the light [Hz]", step=1e-3),
            "Light that swings by as much at any frequency: what is slower than the cutoff makes no events.",
        ),
        "exposure": Shown(
            e["exposure"](amplitude=0.25, spread=0.4, period=0.05, exposure=0.015, begin=0.012), STEPS,
            f"{step_words}; beside that, ON and OFF bursts at the begin and the end of each frame.",
        ),
        "threshold": Shown(
            e["threshold"](on=0.15, off=0.15),
            Raster(swings, 1.0, SWINGS, "frequency of the light [Hz]", step=1e-3),
            "Light that swings: with half the threshold, twice the events.",
            other=e["threshold"](on=0.3, off=0.3), left="0.3", right="0.15",
        ),
        "mismatch": Shown(
            e["mismatch"](spread=0.2), ALIKE,
            "All pixels see the same light, which swings: each is early or late in all cycles alike.",
            phase=0.0,
        ),
        "jitter": Shown(
            e["jitter"](spread=0.2), ALIKE,
            "All pixels see the same light, which swings: early or late anew at each event.",
            phase=0.0,
        ),
        "leak": Shown(
            e["leak"](rate=2.0, spread=0.1), REST,
            "Light that does not change: regular ON events, each pixel at a phase of its own.",
        ),
        "shot": Shown(
            e["shot"](rate=5.0, bright=0.0, knee=0.03), REST,
            "Light that does not change: random events of both polarities, most of all in the dark.",
        ),
        "hot": Shown(
            e["hot"](share=0.01, rate=1500.0, spread=0.3, balance=0.9), Picture(),
            "A few pixels fire all the time, whatever they see."
        ),
        "refractory": Shown(
            e["refractory"](period=3e-3),
            Raster(ramps, 0.4, RAMPS, "slope of the light [1/s]", step=2e-4, shown=(0.0, 0.1)),
            "Light that rises and falls, faster for each pixel: none fires twice in 3 ms.",
        ),
        "dead": Shown(
            e["dead"](share=0.05), Picture(window=0.03), "Pixels that are silent, whatever they see: holes."
        ),
        "latency": Shown(
            e["latency"](delay=1e-3, light=1.0, dark=0.01), STEPS,
            f"{step_words}: events come late, in the dark by many milliseconds, but not spread.",
        ),
        "row_scan": Shown(
            e["row_scan"](line=1.5e-5), Lines((4.5e-3, 10e-3)),
            "Light rises everywhere from 5 to 6 ms: rows are visited in turn, and events wait for their row.",
        ),
        "readout": Shown(
            e["readout"](rate=2.5e7, depth=1000000), Lines((4.5e-3, 10e-3)),
            "Light rises everywhere from 5 to 6 ms: the bus is full, and events leave later and later.",
        ),
        "double_events": Shown(
            e["double_events"](share=0.5, delay=1e-5),
            Raster(falls, 1e-3, np.arange(30.0), "pixel", shown=(4e-4, 5e-4), log=False, step=2e-5),
            "A tenth of a millisecond of falling light: half of the events are sent again 10 us later.",
        ),
        "anti_flicker": Shown(
            e["anti_flicker"](low=50.0, high=520.0), Raster(half_lit, 0.2, LIGHT),
            f"{step_words}, the upper half under a lamp: after 7 periods nothing is seen there any more.",
        ),
        "trail_filter": Shown(
            e["trail_filter"](threshold=0.02), STEPS,
            f"{step_words}: of each burst of one polarity the first event passes.",
            beside=(e["bandwidth"](cutoff=300.0, dark=0.01),),
        ),
        "rate_control": Shown(
            e["rate_control"](rate=1e7), Lines((4.5e-3, 7e-3)),
            "Light rises everywhere from 5 to 6 ms: after 0.2 ms the controller leaves most events out.",
        ),
        "timestamp": Shown(
            e["timestamp"](jitter=0.0, step=2.5e-4), Lines((4.5e-3, 7e-3)),
            "Light rises everywhere from 5 to 6 ms: time stamps are multiples of the tick.",
        ),
    }  # fmt: skip


def draw(name: str, how: Shown) -> None:
    """Draw an effect."""
    threshold = EFFECTS["threshold"](on=0.2, off=0.2, phase=how.phase)
    plain = dase.Sensor((threshold,))
    for effect in how.beside:
        plain = plain.with_effect(effect)
    sides = (plain if how.other is None else plain.with_effect(how.other), plain.with_effect(how.effect))
    figure = titled_figure(3.35, name, how.words)
    add_legend(figure, (("dot", Colour.ON, "ON"), ("dot", Colour.OFF, "OFF")))
    scene = how.view.scene()
    streams = [dase.simulate(scene, sensor, seed=2) for sensor in sides]
    for side, events in enumerate(streams):
        is_picture = isinstance(how.view, Picture)
        left = (0.3 + 4.6 * side) if is_picture else (0.75 + 4.65 * side)
        axes = place_axes(figure, left, 0.95, 4.4 if is_picture else 3.85, 2.3 if is_picture else 1.9)
        how.view.draw(axes, events, max(map(len, streams)))
        axes.set_title((how.left, how.right)[side], fontsize=9.5, color=Colour.INK, loc="left", pad=5)
    FOLDER.mkdir(exist_ok=True)
    figure.savefig(FOLDER / f"{name}.png", dpi=90)


if __name__ == "__main__":
    every = shown()
    for name in sys.argv[1:] or every:
        draw(name, every[name])
