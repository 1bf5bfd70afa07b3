"""Figures and pages: complete, self-contained, and they say what the numbers say."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from functools import lru_cache
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest
from helpers.command_line import dase_here, refusal

from dase import Events, InputError, Sensor, VideoScene, io, simulate
from dase.effects import EFFECTS
from dase.figures import diagnosis_figures, event_maps, report
from dase.figures.plot import plot
from dase.figures.style import Colour, colour_of, format_number
from dase.results import (
    Cell,
    Comparison,
    Curve,
    Diagnosis,
    Estimate,
    Finding,
    Fit,
    Grade,
    Rank,
    Step,
    Unexplained,
)

CELLS = tuple(
    Cell("rate", "dark pixels", f"OFF events {i}", 10.0, 1.0, "events", -9.0 + i, f"dark <pixels>: {i} & few")
    for i in range(15)
)
PARAMETERS = {"threshold.on": Estimate(0.21, 0.2, 0.22), "leak.rate": Estimate(0.3, 0.2, 0.5)}
SENSOR = Sensor(name="my <camera>").with_effect(EFFECTS["leak"]())


def curve(title: str, **options: bool) -> Curve:
    x = np.arange(1.0, 13)
    return Curve(title, x, "lag [ms]", "events", x**2, x**2 + 1, np.ones(12), **options)


def comparison(error: float = 5.0) -> Comparison:
    return Comparison(
        sensor=SENSOR,
        error=error,
        floor=1.0,
        gate=1.3,
        families={"rate": 2.0, "lag": 8.0, "spread": 0.9},
        cells=CELLS if error > 1.3 else (),
        plain={"ON events [1/(px s)]": (2.0, 1.0), "OFF events [1/(px s)]": (0.0, 1.0)},
        curves={
            "rate": (curve("ON events"), curve("OFF events", log_y=True)),
            "lag": (curve("lag", log_x=True),),
        },
        notes=("mind <this>",),
        seconds=1.5,
    )


def diagnosis(**changes: object) -> Diagnosis:
    ranking = (
        Rank("leak", 1.05, 5.0, 0.98, 0.0164, {"leak.rate": PARAMETERS["leak.rate"]}),
        Rank("shot", 4.0, 2.0, 0.4, 0.3, {}),
        Rank("hot", float("nan"), 0.0, 0.0, 1.0, {}, refined=False),
    )
    steps = (
        Step(("threshold",), 6.0, 1.3, {"rate": 6.0}, ranking, "leak", ("shot",), CELLS),
        Step(("threshold", "leak"), 1.05, 1.3, {"rate": 1.0}, (), None, (), ()),
    )
    facts = dict(
        sensor=SENSOR,
        selected=("leak",),
        errors=(6.0, 1.05),
        before=9.0,
        floor=1.0,
        gate=1.3,
        parameters=PARAMETERS,
        findings=(Finding("leak", Grade.SUPPORTED, (), False, 6.0, 1.05, 7.5),),
        unexplained=None,
        history=steps,
    )
    return Diagnosis(**facts | changes)


class Page(HTMLParser):
    """Checks that tags are balanced, and collects what could reach out of the page."""

    def __init__(self, text: str):
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.outside: list[str] = []
        self.pictures: list[dict[str, str | None]] = []
        self.words = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        if tag not in ("meta", "img"):
            self.open.append(tag)
        for name, value in attrs:
            if name in ("src", "href", "srcset", "data", "action") and not (value or "").startswith("data:"):
                self.outside.append(f"{tag} {name}={value}")
        if tag == "img":
            self.pictures.append(dict(attrs))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1:] != ["style"]:
            self.words += data
        else:
            assert "url(" not in data
            assert "@import" not in data


def checked(text: str) -> Page:
    page = Page(text)
    assert page.open == []
    assert page.outside == []
    assert not {"script", "link", "iframe"} & set(page.tags)
    for picture in page.pictures:
        assert len(str(picture["alt"])) > 40
        svg = base64.b64decode(str(picture["src"]).split(",")[1]).decode()
        assert svg.startswith("<svg")
        assert not re.search(r'(?:href|src)="(?!#|data:)', svg)
        assert "<text" not in svg  # letters are shapes: no font is needed
    return page


def test_a_step_without_a_judged_candidate_has_no_figure():
    """All candidates may be ruled out by the first look: there is nothing to draw then."""
    ruled_out = tuple(
        Rank(name, float("nan"), 0.0, 0.0, 1.0, {}, refined=False) for name in ("leak", "shot", "hot")
    )
    step = Step(("threshold",), 6.0, 1.3, {"rate": 6.0}, ruled_out, None, (), CELLS)
    found = diagnosis(selected=(), errors=(6.0,), history=(step,))
    page = checked(report.diagnosis_page(found, recording="office.h5"))
    # nor are parameters of a model that leaves so much: the staircase alone
    assert "no claim about the camera" in page.words
    assert len(page.pictures) == 1
    assert len(report.diagnosis_plates(found)) == 1


def test_a_figure_that_fails_costs_the_figure(monkeypatch):
    def fails(*args, **options):
        raise RuntimeError("no <font>")

    monkeypatch.setattr(report.diagnosis_figures, "draw_families", fails)
    page = checked(report.comparison_page(comparison(), recording="office.h5"))
    assert "The model is wrong" in page.words
    assert "A figure could not be drawn here (RuntimeError: no <font>)" in page.words
    assert len(page.pictures) == 2
    monkeypatch.setattr(report, "ranking_of", fails)
    page = checked(report.diagnosis_page(diagnosis(), recording="office.h5"))
    assert "supported given the scene: leak" in page.words
    assert "RuntimeError" in page.words


def test_comparison_page():
    page = checked(report.comparison_page(comparison(), recording="office.h5"))
    assert "The model is wrong" in page.words
    assert "5 times the noise floor" in page.words
    assert "my <camera> against office.h5" in page.words
    assert "Dark <pixels>: 0 & few" in page.words
    assert "mind <this>" in page.words
    assert page.words.index("0 & few") < page.words.index("14 & few")
    assert "3 more" in page.words
    assert len(page.pictures) == 3  # families, two families with curves
    assert "[threshold]" in page.words


def test_comparison_within_chance():
    page = checked(report.comparison_page(comparison(1.1), recording="office.h5"))
    assert "cannot be told from the measurement" in page.words
    assert "No single cell differs" in page.words


def test_diagnosis_page():
    page = checked(report.diagnosis_page(diagnosis(), recording="office.h5"))
    assert "supported given the scene: leak. With it the error falls from 6 to 1.05" in page.words
    assert "7.5 standard deviations along its way" in page.words
    assert "Where the model failed" in page.words
    assert len(page.pictures) == 3  # staircase, ranking, parameters
    assert "0.2 to 0.22" in page.words


def test_what_cannot_be_told_apart_and_what_is_certain_stand_beside_what_is_left():
    left = Unexplained(3.0, 0.04, ("hot",), CELLS[:2], "beside that an error of 3 stays unexplained")
    findings = (
        Finding("flicker", Grade.CERTAIN, seen="light at 100.1 Hz"),
        Finding("leak", Grade.EITHER, ("shot",), True, 6.0, 3.0, 4.0),
    )
    found = diagnosis(selected=(), errors=(6.0,), findings=findings, unexplained=left)
    words = checked(report.diagnosis_page(found, recording="office.h5")).words
    assert "certain without the scene: flicker" in words
    assert "either leak or shot or something that is not in the library" in words
    assert "4 % of the error stays unexplained" in words
    assert "Something is missing that no known effect explains" not in words


def test_nothing_missing():
    first = Step(("threshold",), 1.1, 1.3, {}, (), None, (), ())
    found = diagnosis(selected=(), errors=(1.1,), findings=(), history=(first,), before=float("nan"))
    page = checked(report.diagnosis_page(found, recording="office.h5"))
    assert "Nothing is missing: the error is 1.1 noise floors" in page.words
    assert "unexplained" not in page.words
    small = diagnosis(selected=(), errors=(1.6,), findings=(), history=(first,))
    assert "Nothing of weight is missing" in checked(report.diagnosis_page(small, recording="a")).words


def test_unexplained_names_nothing_as_found():
    left = Unexplained(3.0, 0.4, ("shot",), CELLS[:2], "unexplained: with shot an error of 3 is left")
    found = diagnosis(selected=(), errors=(6.0,), findings=(), unexplained=left)
    page = checked(report.diagnosis_page(found, recording="office.h5"))
    assert "Something is missing that no known effect explains" in page.words
    assert "shot comes nearest, but leaves 3: a stand-in, not a finding" in page.words
    assert "Missing, and" not in page.words
    assert "What stays unexplained" in page.words


def test_the_staircase_goes_on_with_stand_ins():
    left = Unexplained(3.0, 0.4, ("shot", "hot"), CELLS[:2], "unexplained")
    steps = (
        Step(("threshold",), 6.0, 1.3, {}, (), "shot", (), ()),
        Step(("threshold", "shot"), 4.0, 1.3, {}, (), "hot", (), ()),
        Step(("threshold", "shot", "hot"), 3.1, 1.3, {}, (), None, (), ()),
    )
    found = diagnosis(selected=(), errors=(6.0,), findings=(), unexplained=left, history=steps)
    assert report.stand_ins(found) == (["+ shot", "+ hot"], [4.0, 3.0])
    assert "not announced" in report.staircase_of(found).caption
    # found as a pair: there is no error with the first of them alone
    assert report.stand_ins(replace(found, history=steps[:1])) == (["+ shot + hot"], [3.0])
    assert report.stand_ins(diagnosis()) == ([], [])
    assert "not announced" not in report.staircase_of(diagnosis()).caption


def test_pages_are_the_same_every_time(tmp_path):
    pages = [report.diagnosis_page(diagnosis(), recording="a") for _ in range(2)]
    assert pages[0] == pages[1]
    report.write_page(tmp_path / "report.html", pages[0])
    assert (tmp_path / "report.html").read_text() == pages[0]
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


def words_of(plate) -> str:
    """Return all words in a figure."""
    texts = plate.figure.findobj(lambda artist: hasattr(artist, "get_text"))
    return " | ".join(text.get_text() for text in texts if text.get_text())


@lru_cache(maxsize=1)
def plates():
    event_counts = np.random.default_rng(0).poisson(0.1, (3, 2, 24, 32)).astype(np.int32)
    frame = np.full((24, 32), 90, np.uint8)
    sums = event_counts.sum(0).astype(float)
    return {
        "staircase": diagnosis_figures.draw_staircase(["fitted", "+ leak"], [6.0, 1.1], gate=1.3),
        "families": diagnosis_figures.draw_families({"lag": 3.0, "rate": 0.8}, gate=1.3),
        "ranking": diagnosis_figures.draw_ranking(
            ["leak", "shot"], [1.1, 5.0], present=6.0, p_values=[0.01, 1.0]
        ),
        "parameters": report.parameters_of(SENSOR, PARAMETERS),
        "curves": diagnosis_figures.draw_curves(
            "Lag", "", [curve("ON"), curve("OFF", log_x=True, log_y=True)], "What it is."
        ),
        "powers": diagnosis_figures.draw_powers(
            {"static": [(0.2, 0.1), (0.5, 0.97)]}, enough=0.95, names=("a", "b")
        ),
        "moments": event_maps.draw_moments([frame] * 3, event_counts, event_counts, [0.1, 0.2, 0.3], 0.01),
        "maps": event_maps.draw_residual_maps(sums, 2 * sums, 1.0),
    }


@pytest.mark.parametrize("name", plates())
def test_figures_can_be_read_alone(name, tmp_path):
    plate = plates()[name]
    assert len(plate.title) >= 3
    assert plate.caption.endswith(".")
    for axes in plate.figure.axes:
        if axes.get_xlabel() and name not in ("moments", "maps"):
            assert re.search(r"\[.+\]|lag|duration", axes.get_xlabel())
    plate.save(tmp_path / "figure.png")
    picture = cv2.imread(str(tmp_path / "figure.png"))
    assert picture.std() > 5
    assert picture.shape[1] > 1000
    # nothing is cut off at the sides
    assert np.all(picture[:, [0, 1, -1, -2]] == 255)


def test_staircase_says_where_it_ends():
    def title(errors, **options):
        return diagnosis_figures.draw_staircase([""] * len(errors), errors, **options).title

    assert title([6.0, 1.1], gate=1.3) == "The error falls to the noise floor"
    assert title([6.0, 1.5], gate=1.3) == "The error falls, but not to the noise floor"
    assert title([1.1], gate=1.3) == "The error is at the noise floor"
    assert title([2.0], gate=1.3) == "The error is above the noise floor"


def test_colours_belong_to_polarities():
    assert colour_of("ON events, dark") == Colour.ON
    assert colour_of("OFF after OFF") == Colour.OFF
    assert colour_of("ON after OFF") == colour_of("lag of Onset") not in (Colour.ON, Colour.OFF)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        *((0, "0"), (1.0, "1"), (0.123456, "0.123"), (12.345, "12.3"), (1234.5, "1234"), (-0.5, "−0.5")),
        *((1e-5, "1.0·10⁻⁵"), (3e7, "3.0·10⁷"), (float("inf"), "∞"), (float("nan"), "?"), (99999, "99999")),
    ],
)
def test_number(value, text):
    assert format_number(value) == text


def test_event_plates(rng):
    n = 4000
    t = np.sort(rng.uniform(0, 1, n))
    x, y = (rng.integers(0, size, n).astype(np.uint16) for size in (32, 24))
    events = Events(t, x, y, rng.random(n) < 0.5, 32, 24)
    fewer = events.select(events.p)
    side, where, rhythm = event_maps.event_plates(events, fewer, (0.0, 1.0))
    assert "Rhythms" in rhythm.title
    assert "measured" in words_of(side)
    rate = np.count_nonzero(~events.p) / (32 * 24)
    assert f"OFF events: {format_number(rate)} measured, 0 simulated" in words_of(where)
    with pytest.raises(InputError, match="one size"):
        event_maps.event_plates(events, Events.empty(3, 3), (0.0, 1.0))


def test_spectra_show_a_rhythm(rng):
    """Events that come independently have power 1; those of a lamp have a peak at its frequency."""
    t = np.sort(rng.uniform(0, 2, 20_000))
    t = t[rng.random(len(t)) < 0.5 * (1 + np.sin(2 * np.pi * 100 * t))]
    even = np.sort(rng.uniform(0, 2, len(t)))

    def events(times):
        zero = np.zeros(len(times), np.uint16)
        return Events(times, zero, zero, np.ones(len(times), np.bool_), 4, 4)

    (plate,) = event_maps.draw_spectra(events(t), events(even), (0.0, 2.0))
    simulated, measured = (line.get_xydata() for line in plate.figure.axes[0].get_lines()[:2])
    assert abs(measured[measured[:, 1].argmax(), 0] - 100) < 4
    assert measured[:, 1].max() > 30
    assert 0.8 < simulated[:, 1].mean() < 1.2


def test_results_plot_themselves(tmp_path):
    fit = Fit(SENSOR, PARAMETERS, 1.1, 5.0, 1.0, 1.3)
    for found in (comparison(), diagnosis(), fit):
        plot(found).savefig(tmp_path / "plot.png")
        assert (tmp_path / "plot.png").stat().st_size > 10_000


@pytest.mark.slow
def test_compare_writes_a_report(tmp_path, rng):
    texture = cv2.GaussianBlur(rng.random((24, 300)).astype(np.float32), (0, 0), 2)
    texture = np.clip((texture - texture.min()) / np.ptp(texture), 0.05, 1)
    frames = np.stack([np.round(255 * texture[:, n // 4 :][:, :32]) for n in range(500)]).astype(np.uint8)
    times = np.arange(500) * 1e-3
    noisy = Sensor().with_effect(EFFECTS["shot"](rate=5.0))
    events = simulate(VideoScene(frames / np.float32(255), times), noisy, seed=2)
    io.write(tmp_path / "a.h5", io.Sequence(events, frames=frames, frame_times=times))
    (tmp_path / "mine.toml").write_text("[threshold]\n")
    done = dase_here("compare", "mine.toml", "a.h5", "-o", "report.html", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    page = checked((tmp_path / "report.html").read_text())
    assert "mine against a.h5" in page.words
    assert "The model is wrong" in page.words
    titles = [str(picture["alt"]).split(".")[0] for picture in page.pictures]
    assert "Measured and simulated events" in titles
    assert "Rhythms of the event rate" in titles
    assert "Where the model sends too many or too few events" in titles
    numbers = json.loads((tmp_path / "report.json").read_text())
    assert f"{format_number(numbers['error'])} times the noise floor" in page.words
    for name in ("report.txt", "nowhere/report.html"):
        said = refusal("compare", "mine.toml", "a.h5", "-o", name, cwd=tmp_path)
        assert "must end with .html" in said or "folder 'nowhere' does not exist" in said
