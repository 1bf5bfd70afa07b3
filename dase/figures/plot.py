"""One figure for each kind of finding."""

from __future__ import annotations

from matplotlib.figure import Figure

from dase.diagnosis import distinguish
from dase.figures import diagnosis_figures, report
from dase.results import Comparison, Diagnosis, Distinction, Fit


def plot(found: Comparison | Fit | Diagnosis | Distinction, *, names: tuple[str, str] = ("A", "B")) -> Figure:
    """Return the figure of a finding, with its caption under it.

    A comparison gives the error per family of statistics, a fit the parameters and their intervals, a
    diagnosis the staircase of the falling error, a distinction the power of each recording and duration.

    Args:
        found: What `compare`, `fit`, `diagnose` or `distinguish` returned.
        names: What to call the two sensors of a distinction.

    Raises:
        TypeError: It is none of these.
    """
    if isinstance(found, Comparison):
        return report.comparison_plates(found)[0].alone()
    if isinstance(found, Fit):
        return report.parameters_of(found.sensor, found.parameters).alone()
    if isinstance(found, Diagnosis):
        return report.staircase_of(found).alone()
    if isinstance(found, Distinction):
        tried = {answer.stimulus: answer.tried for answer in found.answers}
        return diagnosis_figures.draw_powers(tried, enough=distinguish.DEFAULTS.power, names=names).alone()
    raise TypeError(f"nothing to draw of a {type(found).__name__}")
