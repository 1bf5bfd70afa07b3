"""Figures of a comparison that are pictures: moments side by side, and where too many events come."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import FixedLocator
from numpy.typing import NDArray
from scipy.signal import welch

from dase.errors import InputError
from dase.events import Events
from dase.figures.diagnosis_figures import draw_curves
from dase.figures.event_images import overlay_events
from dase.figures.style import (
    TOO_FEW_TO_TOO_MANY,
    WIDE,
    Colour,
    Plate,
    add_legend,
    format_number,
    label_axes,
    place_axes,
    titled_figure,
)
from dase.formatting import format_seconds
from dase.results import Curve


def event_plates(
    measured: Events,
    simulated: Events,
    span: tuple[float, float],
    *,
    frames: NDArray[np.uint8] | None = None,
    frame_times: NDArray[np.float64] | None = None,
    count: int = 3,
) -> list[Plate]:
    """Return the pictures of a comparison: moments side by side, where events are too many or few, rhythms.

    Args:
        measured: Events of the camera.
        simulated: Events of the model, on the same clock.
        span: Begin and end of what is compared [s].
        frames: What the camera saw, uint8, shape (F, H, W); None where that is unknown.
        frame_times: Times of the frames [s], shape (F,).
        count: Number of moments.

    Raises:
        InputError: The sizes differ.
    """
    sizes = {(events.width, events.height) for events in (measured, simulated)}
    if len(sizes) != 1:
        raise InputError(f"measured and simulated events must have one size, got {sizes}")
    begin, end = span
    parts = [events.slice(begin, end) for events in (measured, simulated)]
    window = _moment_window(parts[0], end - begin, count)
    times = [begin + (end - begin) * (i + 0.5) / count for i in range(count)]
    counts = [np.concatenate([p.counts([t - window / 2, t + window / 2]) for t in times]) for p in parts]
    seen: list[NDArray[np.uint8] | None] = [None] * count
    if frames is not None and frame_times is not None and len(frames):
        seen = [frames[int(np.abs(frame_times - t).argmin())] for t in times]
    whole = [p.counts([begin, np.nextafter(end, math.inf)])[0].astype(np.float64) for p in parts]
    return [
        draw_moments(seen, counts[0], counts[1], times, window),
        draw_residual_maps(whole[0], whole[1], end - begin),
        *draw_spectra(parts[0], parts[1], span),
    ]


def _moment_window(events: Events, span: float, count: int, *, shown: float = 0.05) -> float:
    """Return a time of 1, 2 or 5 times a power of ten in which about `shown` events come per pixel [s]."""
    rate = max(len(events), 1) / span / (events.width * events.height)
    wanted = min(shown / rate, span / count)
    power = 10.0 ** math.floor(math.log10(wanted))
    return power * max(step for step in (1, 2, 5) if step * power <= wanted * (1 + 1e-9))


def draw_moments(
    frames: Sequence[NDArray[np.uint8] | None],
    measured: NDArray[np.int32],
    simulated: NDArray[np.int32],
    times: Sequence[float],
    window: float,
) -> Plate:
    """Draw events of the measurement and of the model side by side, over what the camera saw.

    Args:
        frames: Grey pictures, each (H, W), or None where there is none.
        measured: OFF and ON events, shape (M, 2, H, W).
        simulated: The same of the model.
        times: Moments [s], M of them.
        window: Span of the events around each [s].
    """
    n = len(times)
    aspect = measured.shape[2] / measured.shape[3]
    across = (WIDE - 0.95 - 0.12 * (n - 1)) / n
    down = across * aspect
    figure = titled_figure(
        1.2 + 2 * down,
        "Measured and simulated events",
        f"events of {format_seconds(window)} around each time",
    )
    for row, (name, counts) in enumerate((("measured", measured), ("simulated", simulated))):
        for i, time in enumerate(times):
            axes = place_axes(figure, 0.65 + i * (across + 0.12), 1.0 + row * (down + 0.1), across, down)
            # more than 400 columns cannot be seen; no event is lost where a dot stands for several pixels
            size = math.ceil(counts.shape[3] / 400)
            _show_picture(axes, overlay_events(_calm_frame(frames[i], size), _sum_blocks(counts[i], size)))
            label_axes(axes, title=f"{time:.3f} s" if row == 0 else "")
            if i == 0:
                axes.set_ylabel(name, fontsize=10, color=Colour.INK, labelpad=6)
    add_legend(figure, [("box", Colour.ON, "ON"), ("box", Colour.OFF, "OFF")])
    caption = (
        "Pixels that sent events, red ON and blue OFF, over the grey picture the camera saw; above what was "
        "measured, below what the model makes of the same scene."
    )
    return Plate(figure, caption)


def draw_spectra(
    measured: Events,
    simulated: Events,
    span: tuple[float, float],
    *,
    resolution: float = 4.0,
    end: float = 1000.0,
) -> list[Plate]:
    """Draw the spectrum of the event rate: flicker and the rhythm of a readout are peaks in it.

    Args:
        measured: Events of the camera.
        simulated: Events of the model.
        span: Begin and end of what is compared [s].
        resolution: Of the spectra [Hz].
        end: Of the spectra [Hz].

    Returns:
        One figure; none where the span is too short for the resolution.
    """
    if span[1] - span[0] < 1.5 / resolution:
        return []
    panels = []
    bins = np.arange(span[0], span[1], 0.5 / end)
    for name, on in (("ON events", True), ("OFF events", False)):
        powers = []
        for events in (measured, simulated):
            rate = np.histogram(events.t[events.p == on], bins)[0] * 2 * end
            across = min(round(2 * end / resolution), len(rate))
            frequency, power = welch(rate, fs=2 * end, nperseg=across, detrend="constant")
            # 1 is what independent events of this rate would give
            powers.append(power[1:] / max(2 * rate.mean(), 1e-9))
        zero = np.zeros(len(frequency) - 1)
        words = "frequency [Hz]", "power [1 = by chance]"
        panels.append(Curve(name, frequency[1:], *words, powers[0], powers[1], zero, True, True))
    caption = (
        "Power of the fluctuations of the event rate, in units of what events would give that come "
        "independently. Peaks are light that flickers or a clock that ticks; slow power is the scene."
    )
    return [draw_curves("Rhythms of the event rate", f"resolution {resolution:g} Hz", panels, caption)]


def _calm_frame(frame: NDArray[np.uint8] | None, size: int) -> NDArray[np.uint8] | None:
    """Return every `size`th pixel of a frame, with less contrast, so that events stand out."""
    if frame is None:
        return None
    return (96 + 0.6 * frame[::size, ::size].astype(np.float32)).clip(0, 255).astype(np.uint8)


def _show_picture(axes: Axes, picture: NDArray[np.uint8]) -> None:
    axes.imshow(picture.repeat(2, 0).repeat(2, 1), interpolation="none", aspect="auto")
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set(visible=True, color=Colour.LINE, linewidth=0.8)


def draw_residual_maps(
    measured: NDArray[np.float64],
    simulated: NDArray[np.float64],
    seconds_long: float,
    *,
    least: float = 50.0,
    octaves_shown: int = 3,
) -> Plate:
    """Draw where the model sends too many or too few events.

    Args:
        measured: OFF and ON events per pixel, shape (2, H, W).
        simulated: The same of the model.
        seconds_long: Span in which they were counted [s].
        least: Pixels are joined to blocks of about so many events.
        octaves_shown: Too many or too few at which the colours end.
    """
    size = _block_side(measured, least)
    m, s = _sum_blocks(measured, size), _sum_blocks(simulated, size)
    octaves = np.log2((s + 3) / (m + 3))
    octaves *= np.clip(np.abs(s - m) / np.sqrt(s + m + 1) - 1, 0, 1)  # chance stays white
    aspect = measured.shape[1] / measured.shape[2]
    across = (WIDE - 1.75) / 2
    down = across * aspect
    block = f"blocks of {size} × {size} pixels" if size > 1 else "pixel by pixel"
    about = f"events of the model against those measured in {format_seconds(seconds_long)}, {block}"
    figure = titled_figure(1.2 + down, "Where the model sends too many or too few events", about)
    for i, (channel, name) in enumerate(((1, "ON"), (0, "OFF"))):
        axes = place_axes(figure, 0.3 + i * (across + 0.15), 1.0, across, down)
        image = axes.imshow(
            octaves[channel],
            cmap=TOO_FEW_TO_TOO_MANY,
            vmin=-octaves_shown,
            vmax=octaves_shown,
            aspect="auto",
            interpolation="none",
        )
        axes.set(xticks=[], yticks=[])
        axes.spines[:].set(visible=True, color=Colour.LINE, linewidth=0.8)
        rates = [
            counts[channel].sum() / measured[channel].size / seconds_long for counts in (measured, simulated)
        ]
        label_axes(
            axes,
            title=f"{name} events: {format_number(rates[0])} measured, "
            f"{format_number(rates[1])} simulated [1/(px s)]",
        )
    bar = place_axes(figure, 0.3 + 2 * across + 0.3, 1.0, 0.16, down)
    _colour_bar(figure, bar, image, octaves_shown)
    caption = (
        "Blue: the model sends too few events; brown: too many; white: as many as measured, or no "
        "further off than chance takes them."
    )
    return Plate(figure, caption)


def _colour_bar(figure: Figure, axes: Axes, image: AxesImage, octaves: int) -> None:
    bar = figure.colorbar(image, cax=axes)
    ticks = np.arange(-octaves, octaves + 1.0)
    bar.locator = FixedLocator(list(ticks))
    bar.update_ticks()
    words = [f"{2 ** abs(t):.0f} × too {'many' if t > 0 else 'few'}" if t else "equal" for t in ticks]
    axes.set_yticklabels(words, fontsize=8)
    axes.spines[:].set_visible(False)
    bar.outline.set_visible(False)


def _block_side(counts: NDArray[np.float64], least: float) -> int:
    """Return the side of square blocks that hold `least` events of a polarity on average."""
    mean = counts.sum((1, 2)).max() / counts[0].size
    size = math.ceil(math.sqrt(least / max(mean, 1e-9)))
    return int(min(max(size, 1), max(min(counts.shape[1:]) // 8, 1)))


def _sum_blocks(counts: NDArray[Any], size: int) -> NDArray[Any]:
    for axis in (1, 2):
        counts = np.add.reduceat(counts, np.arange(0, counts.shape[axis], size), axis)
    return counts
