"""Reports: one HTML file each, which opens anywhere and needs nothing else."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from html import escape
from itertools import pairwise
from pathlib import Path

import numpy as np

from dase.events import Events
from dase.figures import diagnosis_figures
from dase.figures import html as html_page
from dase.figures.event_maps import event_plates
from dase.figures.style import Plate, format_number
from dase.fitting.measurement import Measurement
from dase.io import replacing
from dase.probes.statistics import FAMILY_WORDS
from dase.results import NO_CLAIM, Comparison, Diagnosis, Estimate, Finding, Grade, Rank, Step
from dase.scenes.between_frames import CameraScene
from dase.simulation.sensor import Sensor
from dase.simulation.sensor_file import dump_sensor
from dase.simulation.simulate import stream

Drawing = Callable[[], Plate]
"""Draws one figure."""


def write_page(path: Path, html: str) -> None:
    """Write a page, whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(html, "utf-8")


def measurement_plates(
    measured: Measurement, sensor: Sensor, *, seed: int = 0, device: str = "cpu", longest: float = 2.0
) -> list[Plate]:
    """Return pictures of a measurement beside what a model makes of its scene, its first seconds.

    Args:
        measured: The measurement.
        sensor: The model.
        seed: Of every random number of the simulation.
        device: `cpu`, `cuda` or a Warp name.
        longest: Of what is pictured [s].
    """
    times = measured.scene.sample_times()
    begin, end = float(times[0]), min(float(times[-1]), float(times[0]) + longest)
    parts = []
    for part in stream(measured.scene, sensor, seed=seed, device=device):
        parts.append(part)
        if len(part) and part.t[-1] > end:
            break
    shown = times[np.unique(np.searchsorted(times, np.linspace(begin, end, 13)[:-1]))]
    frames = np.clip(255 * measured.scene.frames(shown), 0, 255).astype(np.uint8)
    real, made = measured.events, Events.concatenate(parts)
    if not isinstance(measured.scene, CameraScene):
        return event_plates(real, made, (begin, end), frames=frames, frame_times=shown)
    real, made = measured.scene.trusted_events(real), measured.scene.trusted_events(made)
    plates = event_plates(real, made, (begin, end), frames=frames, frame_times=shown)
    believed = "Events are shown only where and when the scene between the frames can be trusted."
    return [replace(plate, caption=f"{plate.caption} {believed}") for plate in plates]


def comparison_page(
    found: Comparison, *, recording: str, model: str | None = None, plates: Sequence[Plate] = ()
) -> str:
    """Return the report of a comparison.

    Args:
        found: What the comparison found.
        recording: What to call the measurement.
        model: What to call the model; the name of the sensor if None.
        plates: Pictures of it, see `dase.figures.event_maps`.
    """
    wrong = found.error > found.gate
    body = [
        html_page.verdict_html(comparison_verdict(found), wrong=wrong),
        html_page.table_html(("", "measured", "simulated", "model / measured"), _plain_rows(found.plain)),
        "<h2>Where the model fails</h2>",
        html_page.cells_html(found.cells, "No single cell differs by more than chance."),
        *_figures_html([*plates, *comparison_drawings(found)]),
        _sensor_file_html(found.sensor),
        html_page.notes_html(found.notes),
    ]
    return html_page.html_document(
        f"{model or found.sensor.name} against {recording}", "comparison", body, found.seconds
    )


def comparison_verdict(found: Comparison) -> str:
    """Return what a comparison found, in a sentence or two."""
    if found.error <= found.gate:
        return (
            f"The model cannot be told from the measurement: its error is {format_number(found.error)} noise "
            f"floors, and chance alone reaches {format_number(found.gate)}."
        )
    worst = max(found.families, key=lambda name: found.families[name], default="")
    about = f" It is worst in {family_words(worst)}." if worst else ""
    return (
        f"The model is wrong: its error on held-out pixels and time is {format_number(found.error)} "
        f"times the noise floor, where chance alone reaches {format_number(found.gate)}.{about}"
    )


def comparison_plates(found: Comparison) -> list[Plate]:
    """Return the figures of a comparison: errors by family, then the curves of each family, worst first."""
    return [draw() for draw in comparison_drawings(found)]


def comparison_drawings(found: Comparison) -> list[Drawing]:
    """Return what draws the figures of a comparison, one function for each."""
    named = {family_words(name): error for name, error in found.families.items()}
    out: list[Drawing] = []
    if named:
        out.append(partial(diagnosis_figures.draw_families, named, floor=found.floor, gate=found.gate))
    for name in sorted(found.curves, key=lambda name: -found.families.get(name, 0.0)):
        title = family_words(name)
        about = f"error {format_number(found.families[name])}" if name in found.families else ""
        caption = (
            "Points are measured, lines are the model's; the grey band is twice the sampling error of their "
            "difference, so a line outside of it is wrong beyond chance."
        )
        title = title[:1].upper() + title[1:]
        out.append(partial(diagnosis_figures.draw_curves, title, about, found.curves[name], caption))
    return out


def _figures_html(figures: Iterable[Plate | Drawing]) -> list[str]:
    """Return figures with their captions; where one fails, a sentence in its place.

    What a report says took minutes to find out, so a figure that fails costs that figure and nothing else.
    """
    out = []
    for one in figures:
        try:
            out.append(html_page.figure_html(one if isinstance(one, Plate) else one()))
        except Exception as error:  # whatever matplotlib stumbles over
            said = f"A figure could not be drawn here ({type(error).__name__}: {error})."
            out.append(f"<p>{escape(said)}</p>")
    return out


def diagnosis_page(
    found: Diagnosis, *, recording: str, model: str | None = None, plates: Sequence[Plate] = ()
) -> str:
    """Return the report of a diagnosis.

    Args:
        found: What the diagnosis found.
        recording: What to call the measurement.
        model: What to call the model; the name of the sensor if None.
        plates: Pictures of the model that was found, see `dase.figures.event_maps`.
    """
    mute = found.unexplained is not None and not found.findings
    body = [html_page.verdict_html(diagnosis_verdict(found), wrong=mute)]
    if found.findings or found.stand_ins:
        head = ("effect", "how sure", "error without it", "error with it", "why")
        body += [
            html_page.table_html(head, [_finding_row(one) for one in (*found.findings, *found.stand_ins)])
        ]
    body += _figures_html(diagnosis_drawings(found))
    if found.history and found.history[0].cells:
        body += ["<h2>Where the model failed</h2>", html_page.cells_html(found.history[0].cells)]
    if found.unexplained is not None:
        body += ["<h2>What stays unexplained</h2>", f"<p>{escape(found.unexplained.sentence)}.</p>"]
        body += [f"<p>{escape(text[:1].upper() + text[1:])}.</p>" for text in found.unexplained.whereabouts()]
        body += [
            html_page.cells_html(
                found.unexplained.cells, "It is spread over many cells; no single one stands out."
            )
        ]
    if found.record:
        items = "".join(f"<li>{escape(text)}</li>" for text in found.record)
        body += ["<h2>What to record next</h2>", f"<ul>{items}</ul>"]
    if found.not_seen:
        limits = [(one.effect, one.sentence) for one in found.not_seen]
        body += [
            html_page.folded_html("What was not seen", html_page.table_html(("effect", "limit"), limits))
        ]
    body += [
        *_figures_html(plates),
        html_page.table_html(("", "measured", "simulated", "model / measured"), _plain_rows(found.plain)),
        "" if found.parameters_hold else f"<p>{escape(NO_CLAIM[:1].upper() + NO_CLAIM[1:])}.</p>",
        _parameter_table(found.parameters),
        _sensor_file_html(found.sensor),
        html_page.notes_html(found.notes),
    ]
    foot = f"{found.evaluations:,} simulations. " if found.evaluations else ""
    return html_page.html_document(
        f"{model or found.sensor.name} against {recording}", "diagnosis", body, found.seconds, foot
    )


def diagnosis_verdict(found: Diagnosis) -> str:
    """Return what a diagnosis found, in a sentence or two."""
    first, last = format_number(found.errors[0]), format_number(found.errors[-1])
    if found.unexplained is not None and not found.findings:
        left = format_number(found.unexplained.error)
        near = " and ".join(found.unexplained.nearest)
        tried = f" {near} comes nearest, but leaves {left}: a stand-in, not a finding." if near else ""
        return (
            f"Something is missing that no known effect explains: the error is {first} noise floors, and "
            f"chance reaches {format_number(found.gate)}.{tried}"
        )
    if not found.findings:
        error = f"the error is {first} noise floors, and chance reaches {format_number(found.gate)}."
        if found.errors[0] > found.gate:
            return f"Nothing of weight is missing: {error} What is left is beyond chance, but small."
        return f"Nothing is missing: {error}"
    said = [
        f"{text}: {', '.join(one.words() for one in mine)}."
        for grade, text in GRADE_WORDS.items() if (mine := found.of_grade(grade))
    ]  # fmt: skip
    if found.selected:
        it = "it" if len(found.selected) == 1 else "them"
        said.append(
            f"With {it} the error falls from {first} to {last} noise floors; "
            f"chance alone reaches {format_number(found.gate)}."
        )
    if found.unexplained is not None:
        said.append(f"{100 * found.unexplained.share:.0f} % of the error stays unexplained.")
    return " ".join(said)


GRADE_WORDS = {
    Grade.CERTAIN: "Missing, and certain without the scene",
    Grade.SUPPORTED: "Missing, and supported given the scene",
    Grade.EITHER: "Missing, but the data do not tell what",
}
"""How a verdict begins for each grade."""


def _finding_row(one: Finding) -> tuple[str, ...]:
    """Return what is said of an effect as cells of a table."""
    sure = {Grade.EITHER: "cannot be told apart", Grade.STAND_IN: "comes nearest, not found"}
    why = [one.seen] if one.seen else []
    if math.isfinite(one.deviation):
        why.append(f"{one.deviation:.1f} standard deviations along its way")
    return (
        one.words(), sure.get(one.grade, str(one.grade)), _number_or_dash(one.error_without),
        _number_or_dash(one.error_with), "; ".join(why),
    )  # fmt: skip


def diagnosis_plates(found: Diagnosis) -> list[Plate]:
    """Return the figures of a diagnosis: the staircase, the candidates of each step, the parameters."""
    return [draw() for draw in diagnosis_drawings(found)]


def diagnosis_drawings(found: Diagnosis) -> list[Drawing]:
    """Return what draws the figures of a diagnosis, one function for each."""
    judged = [step for step in found.history if _judged_ranks(step)]
    out: list[Drawing] = [partial(staircase_of, found)]
    out += [partial(ranking_of, step, found.floor) for step in judged]
    shown = found.parameters and found.parameters_hold
    return out + ([partial(parameters_of, found.sensor, found.parameters)] if shown else [])


def parameters_of(sensor: Sensor, estimates: Mapping[str, Estimate]) -> Plate:
    """Return fitted parameters of a sensor within the ranges of real cameras."""
    facts = {f"{e.name}.{p.name}": p for e in sensor.effects for p in e.parameters()}
    known = {name: value for name, value in estimates.items() if name in facts}
    ranges = {name: facts[name].plausible for name in known}
    return diagnosis_figures.draw_parameters(known, ranges, {name: facts[name].unit for name in known})


def staircase_of(found: Diagnosis) -> Plate:
    """Return the staircase of the falling error."""
    steps, errors = ["fitted"], list(found.errors)
    if math.isfinite(found.before) and found.before > 1.05 * errors[0]:
        steps, errors = ["as given", "fitted"], [found.before, *errors]
    steps += [f"+ {name}" for name in found.selected]
    names, more = stand_ins(found)
    return diagnosis_figures.draw_staircase(
        [*steps, *names], [*errors, *more], floor=found.floor, gate=found.gate, stand_ins=len(names)
    )


def stand_ins(found: Diagnosis) -> tuple[list[str], list[float]]:
    """Return the effects that came nearest where nothing explains the error, and the errors with them."""
    if found.unexplained is None or not found.unexplained.nearest:
        return [], []
    last, nearest = found.unexplained.error, found.unexplained.nearest
    after = {a.chosen: b.error for a, b in pairwise(found.history) if a.chosen and a.chosen in b.model}
    # beside what is found, stand-ins have no error of their own on the way
    if found.selected or not all(name in after for name in nearest[:-1]):
        return [f"+ {' + '.join(nearest)}"], [last]
    return [f"+ {name}" for name in nearest], [*(after[name] for name in nearest[:-1]), last]


def ranking_of(step: Step, floor: float) -> Plate:
    """Return how far each candidate of one step brings the error down."""
    full = _judged_ranks(step)
    return diagnosis_figures.draw_ranking(
        [rank.effect for rank in full],
        [rank.error for rank in full],
        present=step.error,
        p_values=[rank.p_value for rank in full],
        chosen=[] if step.chosen is None else [step.chosen],
        ties=step.ties,
        floor=floor,
        screened=len(step.ranking) - len(full),
    )


def _judged_ranks(step: Step) -> list[Rank]:
    """Return the candidates of a step that were judged: none where the first look ruled all of them out."""
    return [rank for rank in step.ranking if rank.refined and math.isfinite(rank.error)]


def family_words(name: str) -> str:
    """Return a family of statistics in a few words."""
    return FAMILY_WORDS.get(name, name)


def _plain_rows(plain: Mapping[str, tuple[float, float]]) -> list[tuple[str, ...]]:
    # what is left of a count after rounding is none
    whole = {name: [v if abs(v) > 1e-9 else 0.0 for v in pair] for name, pair in plain.items()}
    return [
        (name, _number_or_dash(m), _number_or_dash(s), _ratio_text(m, s)) for name, (m, s) in whole.items()
    ]


def _number_or_dash(value: float) -> str:
    return "–" if math.isnan(value) else format_number(value)


def _ratio_text(measured: float, simulated: float) -> str:
    return format_number(simulated / measured) if measured > 0 and math.isfinite(simulated) else "–"


def _parameter_table(found: Mapping[str, Estimate]) -> str:
    rows = [
        (name, format_number(e.value), f"{format_number(e.low)} to {format_number(e.high)}")
        for name, e in found.items()
    ]
    return html_page.folded_html(
        "Parameters as a table", html_page.table_html(("parameter", "value", "90 % interval"), rows)
    )


def _sensor_file_html(sensor: Sensor) -> str:
    return html_page.folded_html("The model as a sensor file", f"<pre>{escape(dump_sensor(sensor))}</pre>")
