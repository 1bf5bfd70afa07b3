"""What was found is said whatever happens, and nothing is announced that the data contradict."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

import dase
from dase.cli import dase_group
from dase.diagnosis.compare import compare
from dase.diagnosis.diagnose import diagnose
from dase.diagnosis.explain_effect import moving_bars
from dase.effects import EFFECTS
from dase.figures import report
from dase.fitting.fit import notes_on_disagreement, widen_intervals
from dase.fitting.model import model_of
from dase.probes.statistics import MEANS, SIZE, lacks_events, shortfall_of
from dase.results import Diagnosis, Estimate, Fit, Step
from dase.simulation.sensor import Sensor


@pytest.fixture
def recording(tmp_path):
    """Path of a few events of a sensor at rest."""
    rng = np.random.default_rng(1)
    t = np.sort(rng.uniform(0, 1, 400))
    xy = rng.integers(0, 16, (2, 400))
    events = dase.Events(t, xy[0].astype(np.uint16), xy[1].astype(np.uint16), rng.random(400) < 0.5, 16, 16)
    dase.io.write(tmp_path / "rest.h5", dase.io.Sequence(events))
    return tmp_path / "rest.h5"


def found_nothing() -> Diagnosis:
    step = Step(("threshold",), 6.0, 1.3, {"rate": 6.0}, (), None, (), ())
    values = {"threshold.on": Estimate(0.2, 0.19, 0.21)}
    return Diagnosis(Sensor(), (), (6.0,), 9.0, 1.0, 1.3, values, {}, None, (step,))


def test_a_picture_that_fails_costs_the_picture(recording, tmp_path, monkeypatch):
    """The finding is printed, the numbers are written, and the page has all but the figure."""

    def fails(*args, **options):
        raise TypeError("'float' object is not iterable")

    monkeypatch.setattr("dase.diagnosis.diagnose.diagnose", lambda *args, **options: found_nothing())
    monkeypatch.setattr(report, "staircase_of", fails)
    monkeypatch.setattr(report, "measurement_plates", fails)
    out = {name: tmp_path / f"out.{name}" for name in ("json", "html", "toml", "png")}
    words = ["--json", out["json"], "-o", out["toml"], "--report", out["html"], "--draw", out["png"]]
    result = CliRunner().invoke(
        dase_group, ["diagnose", "ideal", str(recording), "--scene", "static", *map(str, words)]
    )
    assert result.exit_code == 1  # a file that was asked for is not there
    assert "nothing is missing: error 6.00" in result.output
    assert "out.png could not be drawn" in result.output
    assert "Traceback" not in result.output
    assert json.loads(out["json"].read_text())["before"] == 9.0
    assert "threshold" in out["toml"].read_text()
    assert "A figure could not be drawn here" in out["html"].read_text()
    assert not out["png"].exists()


def test_a_model_that_sends_hardly_an_event_is_the_worst():
    """The unit of the error is the measurement's: by its own, a silent model is close to everything."""
    scene, true = moving_bars(), Sensor().with_effect(EFFECTS["leak"](rate=4.0))
    events = dase.simulate(scene, true, seed=4)

    def error(**threshold: float) -> float:
        sensor = true.with_effect(replace(true["threshold"], **threshold))
        sensor = sensor.with_effect(EFFECTS["leak"](rate=0.01)) if threshold else sensor
        return compare(events, sensor, scene=scene, pixels=400, seed=4).error

    assert error() < 0.5
    errors = [error(on=c, off=c) for c in (0.1, 0.4, 0.8, 1.6, 8.0)]
    assert errors[1:4] == sorted(errors[1:4])
    assert errors[-1] > 0.98 * max(errors)  # the last two send next to nothing


def test_events_that_a_model_does_not_send_are_a_difference():
    measured, sent = np.full(SIZE, 400.0), np.full(SIZE, 400.0)
    assert not lacks_events(measured, sent).any()
    assert not shortfall_of(measured, sent).any()
    few = shortfall_of(measured, np.full(SIZE, 10.0))
    assert np.all(few[MEANS] > 10)
    assert np.all(shortfall_of(measured, np.zeros(SIZE)) >= few)
    assert not lacks_events(np.full(SIZE, 20.0), np.zeros(SIZE)).any()  # too few to say


def test_a_fit_that_is_worse_than_what_was_given_is_written_when_asked_twice(
    recording, tmp_path, monkeypatch
):
    worse = Fit(Sensor(), {}, 3.42, 2.39, 1.0, 1.2, plain={"ON events [1/(px s)]": (2.0, 1.0)})
    assert worse.worse
    assert not replace(worse, before=3.4).worse  # repeats differ by as much
    assert not replace(worse, error=1.1, before=0.3).worse  # both count as right
    monkeypatch.setattr("dase.fitting.fit.fit", lambda *args, **options: worse)
    out = tmp_path / "f.toml"
    words = ["fit", "ideal", str(recording), "--scene", "static", "-o", str(out)]
    result = CliRunner().invoke(dase_group, words)
    assert result.exit_code == 1
    assert "was not written" in result.output
    assert "--force" in result.output
    assert "ON events" in result.output
    assert not out.exists()
    assert CliRunner().invoke(dase_group, [*words, "--force"]).exit_code == 0
    assert out.exists()


def test_an_interval_reaches_all_starts_that_are_as_good():
    model = model_of(Sensor(), ["threshold.on"])
    axis = model.space.axes[0]
    ends = [replace(model, place=np.array([axis.to_place(v)])) for v in (0.18, 0.426, 0.499)]
    values = {"threshold.on": Estimate(0.426, 0.42, 0.43)}
    assert "0.18, 0.426, 0.499" in notes_on_disagreement(ends[1], ends, values)[0]
    wide = widen_intervals(ends[1], ends, values)["threshold.on"]
    assert (wide.low, wide.high) == pytest.approx((0.18, 0.499))
    assert widen_intervals(ends[1], ends[1:2], values) == values


def test_a_search_begins_with_what_was_given_where_the_fit_is_worse(monkeypatch):
    """A refit that held-out data contradict is not kept, and said."""
    scene = moving_bars()
    events = dase.simulate(scene, Sensor(), seed=4)
    off = model_of(Sensor().with_effect(replace(Sensor()["threshold"], on=0.3, off=0.3)))
    monkeypatch.setattr("dase.diagnosis.diagnose.fit_present_model", lambda *args, **options: off)
    found = diagnose(events, scene=scene, pixels=200, most=0)
    assert found.sensor["threshold"].on == pytest.approx(0.2, rel=0.05)
    assert found.errors[0] < 1.1 * found.before
    assert any("began from the sensor as given" in note for note in found.notes)
    assert found.plain
