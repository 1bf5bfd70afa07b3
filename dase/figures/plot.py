"""One figure for each kind of finding."""

from __future__ import annotations

from matplotlib.figure import Figure

from dase.diagnosis import distinguish
from dase.events import Events
from dase.figures import diagnosis_figures, event_images, report
from dase.figures.style import Colour, place_axes, titled_figure
from dase.io.sequence import Sequence
from dase.recordings.recording import Recording
from dase.results import Comparison, Diagnosis, Distinction, Fit
from dase.simulation.sweep import Sweep

Drawable = Events | Recording | Sequence | Sweep | Comparison | Fit | Diagnosis | Distinction


def plot(found: Drawable, *, names: tuple[str, str] = ("A", "B")) -> Figure:
    """Return the figure of events, of a recording, or of a finding, with its caption under it.

    Events, over frames where a recording has them, give the sheet of `dase show`; a sweep the rates by the
    parameter, a comparison the error per family of statistics, a fit the parameters and their intervals, a
    diagnosis the staircase of the falling error, a distinction the power of each recording and duration.

    Args:
        found: Events, a recording, or what `sweep`, `compare`, `fit`, `diagnose` or `distinguish` returned.
        names: What to call the two sensors of a distinction.

    Raises:
        TypeError: It is none of these.
    """
    if isinstance(found, Events):
        return event_images.draw_sequence(Sequence(found))
    if isinstance(found, Recording):
        return event_images.draw_sequence(Sequence(found.events, found.frames, found.frame_times))
    if isinstance(found, Sequence):
        return event_images.draw_sequence(found)
    if isinstance(found, Sweep):
        return draw_sweep(found)
    if isinstance(found, Comparison):
        return report.comparison_plates(found)[0].alone()
    if isinstance(found, Fit):
        return report.parameters_of(found.sensor, found.parameters).alone()
    if isinstance(found, Diagnosis):
        return report.staircase_of(found).alone()
    if isinstance(found, Distinction):
        tried = {answer.stimulus: answer.tried for answer in found.answers}
        return diagnosis_figures.draw_powers(tried, enough=distinguish.DEFAULTS.power, names=names).alone()
    takes = "events, a recording, a sweep, a comparison, a fit, a diagnosis or a distinction"
    raise TypeError(f"plot: draws {takes}, got {type(found).__name__}")


def draw_sweep(found: Sweep) -> Figure:
    """Return the rates of both polarities by the value of the parameter."""
    figure = titled_figure(3.6, f"Events as {found.name} varies", "mean over pixels and time")
    axes = place_axes(figure, 0.9, 0.75, 8.2, 2.2)
    for name, rates, colour in (("ON", found.on, Colour.ON), ("OFF", found.off, Colour.OFF)):
        axes.plot(found.values, rates, "o-", color=colour, label=name)
    axes.set_xlabel(f"{found.name} [{found.unit}]")
    axes.set_ylabel("events [1/pixel/s]")
    axes.set_ylim(bottom=0)
    axes.legend(frameon=False)
    return figure
