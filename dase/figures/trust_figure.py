"""Pictures of how far the scene between frames can be trusted."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray

from dase.errors import InputError
from dase.events import Events
from dase.figures.event_images import overlay_events
from dase.figures.style import Colour, ShownFigure
from dase.formatting import format_seconds
from dase.scenes.between_frames import CameraScene, TrustSettings
from dase.scenes.frame_motion import HOPELESS


def trust_picture(
    scene: CameraScene, events: Events, time: float, window: float, *, dots: int = 3
) -> NDArray[np.uint8]:
    """Return the scene with doubts and the events around a time.

    Doubt veils the picture, the more the less confidence there is; what no frame can tell, as it is saturated
    or seen in one frame only, is hatched. ON events are red, OFF events blue.

    Args:
        scene: Between frames.
        events: Of the scene's size, on its clock.
        time: Within the scene [s].
        window: Events of this span around `time` are shown [s].
        dots: Of the picture per pixel, so that single events and the hatching are sharp.

    Returns:
        Red, green and blue, shape (dots · H, dots · W, 3).
    """
    light = scene.frames(np.array([time]))[0]
    top = max(float(np.percentile(light, 99.5)), 1e-6)
    grey = np.rint(255 * np.clip(light / top, 0, 1) ** 0.6).astype(np.uint8)
    counts = events.counts([time - window / 2, time + window / 2])[0]
    share = 1 - scene.confidence([time])[0]
    hopeless = scene.doubt([time])[0] > 0.01 * HOPELESS  # the frame before and the one after share a doubt
    large, nothing = (
        a.repeat(dots, 0).repeat(dots, 1) for a in (overlay_events(grey, 0 * counts) / 255, hopeless)
    )
    y, x = np.indices(nothing.shape)
    lines = nothing & ((x + y) % 7 < 2)  # slanted, two of seven dots wide
    veil = np.where(nothing, 0.0, 0.75 * share.repeat(dots, 0).repeat(dots, 1))[..., None]
    out = (1 - veil) * large + veil * np.array(to_rgb(Colour.VEIL))
    out[lines] = 0.6 * out[lines] + 0.4 * np.array(to_rgb(Colour.HATCH))
    seen = (counts.sum(0) > 0).repeat(dots, 0).repeat(dots, 1)
    marked = overlay_events(grey, counts).repeat(dots, 0).repeat(dots, 1)
    return np.where(seen[..., None], marked, np.rint(255 * out)).astype(np.uint8)


def draw_trust(
    scene: CameraScene,
    events: Events,
    *,
    title: str = "",
    moments: int = 6,
    window: float | None = None,
) -> Figure:
    """Draw moments between the frames with most events: the scene, its doubts, and the events over both.

    Args:
        scene: Between frames.
        events: Of the scene's size, on its clock.
        title: Name over the sheet.
        moments: How many moments to show; fewer if there are not as many times between frames.
        window: Events of this span around each moment are shown [s]; None: an eighth of the time of a frame.

    Raises:
        InputError: Sizes differ, or `window` or `moments` is not positive.
    """
    if (events.width, events.height) != (scene.width, scene.height):
        size = f"{scene.width}x{scene.height}, got {events.width}x{events.height}"
        raise InputError(f"trust: events must have the size of the scene, {size}")
    window = float(np.median(np.diff(scene.times))) / 8 if window is None else window
    if moments < 1 or not 0 < window < math.inf:
        raise InputError(f"trust: moments and window must be > 0, got {moments} and {window:g} s")
    counts = np.diff(np.searchsorted(events.t, scene.times))
    shown = np.sort(np.argsort(-counts, kind="stable")[:moments])
    trusted = scene.trusted().mean((1, 2))
    figure, places = _lay_out(len(shown), scene.height / scene.width)
    _draw_header(figure, title, window, float(trusted.mean()))
    for axes, k in zip(places, shown, strict=True):
        time = float(0.5 * (scene.times[k] + scene.times[k + 1]))
        axes.imshow(trust_picture(scene, events, time, window), aspect="auto")
        axes.set_title(f"{time:.3f} s, after frame {k}", fontsize=9, color=Colour.INK, loc="left", pad=3)
        axes.set_title(
            f"{100 * trusted[k]:.0f} % trusted", fontsize=9, color=Colour.QUIET, loc="right", pad=3
        )
    return figure


def _lay_out(count: int, aspect: float) -> tuple[Figure, list[Axes]]:
    """Return a figure with room for a header, and `count` axes of height / width `aspect`."""
    columns = min(count, 3)
    wide, side, head, pad, label = 11.0, 0.4, 0.75, 0.15, 0.28  # all in inches
    across = (wide - 2 * side - pad * (columns - 1)) / columns
    down = across * aspect
    tall = head + math.ceil(count / columns) * (down + label) + 0.15
    figure = ShownFigure(figsize=(wide, tall), dpi=150, facecolor="white")
    FigureCanvasAgg(figure)
    places = []
    for n in range(count):
        left, top = side + (n % columns) * (across + pad), head + label + (n // columns) * (down + label)
        axes = figure.add_axes((left / wide, 1 - (top + down) / tall, across / wide, down / tall))
        axes.spines[:].set(color=Colour.LINE, linewidth=0.6)
        axes.set(xticks=[], yticks=[])
        places.append(axes)
    return figure, places


def _draw_header(figure: Figure, title: str, window: float, share: float) -> None:
    tall = figure.get_figheight()
    left, right = 0.4 / 11, 1 - 0.4 / 11
    figure.text(
        left,
        1 - 0.3 / tall,
        title,
        fontsize=13,
        color=Colour.INK,
        weight="bold",
        va="center",
        parse_math=False,
    )
    facts = (
        f"{100 * share:.0f} % of pixels and times trusted: expected error up to "
        f"{TrustSettings.tolerance:g} log intensity "
        f"or {100 * TrustSettings.relative:.0f} % of the change"
    )
    figure.text(left, 1 - 0.57 / tall, facts, fontsize=9, color=Colour.INK, va="center")
    said = f"events of {format_seconds(window)} around each time"
    figure.text(right, 1 - 0.3 / tall, said, fontsize=9, color=Colour.INK, va="center", ha="right")
    legend = (
        (right, "\N{BLACK SQUARE} OFF", Colour.OFF),
        (right - 0.055, "\N{BLACK SQUARE} ON", Colour.ON),
        (right - 0.105, "\N{BLACK SQUARE} doubtful", Colour.DOUBT),
        (
            right - 0.195,
            "\N{SQUARE WITH UPPER RIGHT TO LOWER LEFT FILL} saturated or seen once",
            Colour.BLIND,
        ),
    )
    for x, name, colour in legend:
        figure.text(x, 1 - 0.57 / tall, name, color=colour, fontsize=9, va="center", ha="right")
