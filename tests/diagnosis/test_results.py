"""What Python prints of a result: a short table from which the finding can be read."""

from __future__ import annotations

import numpy as np
import pytest

import dase
from dase.fitting.measurement import measurement_of
from dase.io.sequence import Sequence
from dase.results import (
    Answer,
    Cell,
    Comparison,
    Curve,
    Diagnosis,
    Distinction,
    Estimate,
    Finding,
    Fit,
    Grade,
    Rank,
    Step,
    Unexplained,
)
from dase.simulation.sensor import Sensor

LONG = "pixels of a very long description " * 5
CELLS = tuple(Cell("rate", LONG, "OFF events", 3.0, 9.0, "events", 4.0 - n, f"{LONG}{n}") for n in range(24))
BINS = np.linspace(0, 1, 300)
CURVE = Curve("ON events, dark pixels", BINS, "interval [ms]", "events", BINS, BINS + 1, 0.1 * BINS)
FAMILIES = {f"family{n}": 0.5 * n for n in range(11)}
PARAMETERS = {f"effect{n}.parameter": Estimate(1.0 * n, 0.9 * n, 1.1 * n) for n in range(40)}
RANKS = tuple(Rank(f"effect{n}", 1.5 + n, 4.0 - n, 0.8, 0.016, PARAMETERS) for n in range(20))
STEP = Step(("threshold",), 6.0, 1.2, FAMILIES, RANKS, "leak", ("shot",), CELLS)
SCREENED = Rank("linlog", float("nan"), float("nan"), 0.0, 1.0, {}, refined=False)
NOTES = tuple(f"note {n} {LONG}" for n in range(9))
ANSWERS = tuple(Answer(f"edge {n}", LONG, 0.5, 0.97, "how many events come", (1, 2, 3, 4)) for n in range(5))


FINDINGS = (
    Finding("leak", Grade.EITHER, ("shot",), True, 6.0, 2.5, 5.0),
    Finding("bandwidth", Grade.SUPPORTED, (), False, 2.5, 1.04, 9.0),
    Finding("flicker", Grade.CERTAIN, seen=f"light at 100 Hz {LONG}"),
)


def comparison() -> Comparison:
    plain = {f"{name} events [1/(px s)]": (1.25, 2.5) for name in "ABCDEF"}
    return Comparison(Sensor(), 5.754, 1.0, 1.15, FAMILIES, CELLS, plain, {"rate": (CURVE,) * 9}, NOTES)


def diagnosis(**more) -> Diagnosis:
    found = dict(
        sensor=Sensor(), selected=("leak", "bandwidth"), errors=(6.0, 2.5, 1.04), before=9.0, floor=1.0,
        gate=1.2, parameters=PARAMETERS, findings=FINDINGS, unexplained=None, history=(STEP,) * 5,
        notes=NOTES,
    )  # fmt: skip
    return Diagnosis(**(found | more))


LEFT = Unexplained(
    3.5, 0.5, ("leak",), CELLS, f"unexplained: with leak an error of 3.5 is left; worst: {LONG}"
)
RESULTS = {
    "comparison": (comparison(), ("error 5.75", "below 1.15", "family10", "5.00", "1.25", "note 0")),
    "fit": (
        Fit(Sensor(), PARAMETERS, 1.3, 6.4, 1.0, 1.2, notes=NOTES),
        ("6.40", "1.30", "effect3.parameter"),
    ),
    "diagnosis": (
        diagnosis(),
        ("missing: flicker (certain); bandwidth (supported); either leak or shot", "as given", "1.04"),
    ),
    "nothing": (diagnosis(selected=(), errors=(1.0,), findings=()), ("nothing is missing: error 1.00",)),
    "unexplained": (
        diagnosis(selected=(), errors=(6.0,), findings=(), unexplained=LEFT),
        ("an error of 3.5 is left",),
    ),
    "left": (LEFT, ("an error of 3.5 is left",)),
    "step": (STEP, ("added: leak", "shot", "error 1.50")),
    "rank": (RANKS[0], ("effect0", "error 1.50", "80 %")),
    "screened": (SCREENED, ("linlog", "not judged")),
    "cell": (CELLS[0], ("pixels of a very long",)),
    "curve": (CURVE, ("interval [ms]", "measured")),
    "answer": (ANSWERS[0], ("edge 0", "0.5 s", "97 %")),
    "distinction": (Distinction(ANSWERS, ANSWERS[0], f"Record {LONG}", 1500, 60.0), ("edge 4", "Record")),
}


def fits_on_a_screen(text: str) -> bool:
    lines = text.splitlines()
    return len(lines) <= 30 and max(map(len, lines)) <= 100


@pytest.mark.parametrize("name", RESULTS)
def test_a_result_fits_on_a_screen_and_says_what_was_found(name):
    found, words = RESULTS[name]
    text = repr(found)
    assert fits_on_a_screen(text), text
    for word in words:
        assert word in text, text


def test_what_results_are_made_from_fits_on_a_screen():
    rng = np.random.default_rng(0)
    t = np.sort(rng.uniform(0, 1, 5000))
    x, y = (rng.integers(0, n, 5000).astype(np.uint16) for n in (30, 20))
    events = dase.Events(t, x, y, rng.random(5000) < 0.5, 30, 20)
    frames = rng.integers(0, 255, (40, 20, 30)).astype(np.uint8)
    sequence = Sequence(events, frames, 2e-3 * np.arange(40))
    recording = dase.Recording.of(sequence, NOTES)
    measured = measurement_of(recording)
    for thing in (events, events.select(slice(0, 0)), sequence, recording, recording.report, measured):
        assert fits_on_a_screen(repr(thing)), repr(thing)
    assert "5000 of 30x20 pixels" in repr(events)
    assert "40 frames" in repr(recording)
    assert repr(measured.scene) == "VideoScene(30x20 pixels, 0.078 s)"
