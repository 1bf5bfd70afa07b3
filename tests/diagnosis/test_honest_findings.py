"""What was found is said whatever happens, and nothing is announced that the data contradict."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from helpers.brief_diagnosis import NO_LIMITS
from scipy.ndimage import gaussian_filter

import dase
from dase.cli import dase_group
from dase.cli.output import progress_bar
from dase.diagnosis.compare import compare
from dase.diagnosis.conclusion import conclude_diagnosis
from dase.diagnosis.diagnose import diagnose
from dase.diagnosis.explain_effect import moving_bars
from dase.diagnosis.ranking import rank_of_pair
from dase.effects import EFFECTS
from dase.figures import report
from dase.fitting.compared_time import common_grid, times_of_grid
from dase.fitting.contradictions import motion_at_rest
from dase.fitting.data_split import split_measurement
from dase.fitting.fit import notes_on_disagreement, widen_intervals
from dase.fitting.measurement import Measurement, as_measurement
from dase.fitting.model import model_of
from dase.fitting.search_ends import is_where_it_began, parameters_at_bounds
from dase.fitting.time_window import repeated_gaps
from dase.probes.distance import Judgement
from dase.probes.statistics import MEANS, SIZE, lacks_events, shortfall_of
from dase.probes.stimulus import Grid
from dase.results import Diagnosis, Estimate, Fit, Step
from dase.scenes.static import StaticScene
from dase.scenes.video import VideoScene
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
    return Diagnosis(Sensor(), (), (6.0,), 9.0, 1.0, 1.3, values, None, (step,))


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


def test_a_sensor_beyond_all_that_is_tried_is_compared_as_it_is():
    scene = moving_bars()
    noise = EFFECTS["voltage_noise"](sigma=0.15, cutoff=200.0, knee=10.0, dark=10.0)  # searches end at 3
    sensor = Sensor().with_effect(noise)
    found = compare(dase.simulate(scene, sensor, seed=1), sensor, scene=scene, pixels=300)
    assert found.error < found.gate


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


def drifting_texture() -> VideoScene:
    """A texture that goes by at 30 pixels per second: each pixel's events look like noise."""
    rng, columns = np.random.default_rng(0), np.arange(48)
    texture = gaussian_filter(rng.standard_normal((40, 448)), 1.5)
    texture /= texture.std()
    times = np.arange(1001) / 1000
    places = columns + 30.0 * times[:, None]
    left = places.astype(np.int64)
    share = (places - left)[:, None]
    level = (1 - share) * texture[:, left].swapaxes(0, 1) + share * texture[:, left + 1].swapaxes(0, 1)
    return VideoScene((0.3 * np.exp(0.25 * level)).astype(np.float32), times)


@pytest.mark.parametrize("scene", [moving_bars, drifting_texture], ids=lambda scene: scene.__name__)
def test_a_moving_recording_that_is_declared_static_is_seen_by_its_neighbours(scene):
    """Nothing is announced, and a fit to it is not written.

    Shot noise explains the texture to an error below the gate; only neighbours tell that it is none.
    """
    moving = dase.simulate(scene(), Sensor(), seed=4)
    found = diagnose(moving, scene="static", pixels=200, settings=NO_LIMITS)
    assert found.selected == ()
    assert found.unexplained is not None
    assert "contradict a scene at rest" in found.finding()
    assert any("contradict a scene at rest" in note for note in found.notes)
    assert "contradict" in Fit(Sensor(), {}, 0.5, 0.6, 1.0, 1.2, contradiction="they contradict").refusal()


@pytest.mark.parametrize(
    "noise",
    [
        [EFFECTS["shot"](rate=3.0)],
        [EFFECTS["shot"](rate=3.0), EFFECTS["hot"](share=0.01, rate=200.0)],
        [EFFECTS["leak"](rate=1.0), EFFECTS["flicker"](frequency=100.0, depth=0.3)],
        [EFFECTS["shot"](rate=3.0), EFFECTS["row_scan"]()],
    ],
    ids=lambda effects: "+".join(effect.name for effect in effects),
)
def test_noise_at_rest_contradicts_nothing(noise, rng):
    scene = StaticScene(48, 40, 2.0, 0.1 + 0.8 * rng.random((40, 48)))
    sensor = Sensor()
    for effect in noise:
        sensor = sensor.with_effect(effect)
    assert motion_at_rest(dase.simulate(scene, sensor, seed=2)) == 0


@pytest.mark.slow
def test_what_is_at_the_end_of_its_search_is_not_announced(monkeypatch):
    sensor = Sensor().with_effect(EFFECTS["leak"](rate=5.0))
    model = model_of(sensor)
    sure = {axis.name: Estimate(0.2, 0.19, 0.21) for axis in model.space.axes}
    assert parameters_at_bounds(model, sure) == []
    place = model.place.copy()
    names = [axis.name for axis in model.space.axes]
    place[names.index("threshold.on")] = model.space.bounds()[1, names.index("threshold.on")]
    place[names.index("leak.spread")] = model.space.bounds()[0, names.index("leak.spread")]
    at_end = replace(model, place=place)
    said = parameters_at_bounds(at_end, sure)
    unknown = sure | {"threshold.on": Estimate(3.0, 0.02, 3.0)}
    assert parameters_at_bounds(at_end, unknown) == []
    assert len(said) == 1
    assert said[0].startswith("threshold.on = 3 ")
    scene = moving_bars(duration=0.4)
    events = dase.simulate(scene, Sensor().with_effect(EFFECTS["bandwidth"](cutoff=60.0)), seed=4)
    library = {name: EFFECTS[name] for name in ("threshold", "bandwidth")}
    # what each event tells is certain wherever a search ends
    monkeypatch.setattr("dase.diagnosis.seen_beside_model.find_late_events", lambda *args, **known: ())
    announced = []

    def conclude_twice(*args):
        """Return what the end of one search says where parameters are at their bounds; keep what else."""
        announced.append(conclude_diagnosis(*args))
        monkeypatch.setattr("dase.diagnosis.conclusion.parameters_at_bounds", lambda model, values: said)
        return conclude_diagnosis(*args)

    monkeypatch.setattr("dase.diagnosis.diagnose.conclude_diagnosis", conclude_twice)
    found = diagnose(events, scene=scene, effects=library, pixels=150, settings=NO_LIMITS)
    assert announced[0].selected == ("bandwidth",)
    assert found.selected == ()
    assert "nothing is announced: threshold.on = 3" in found.finding()


def test_a_model_that_no_descent_moved_is_known():
    given = model_of(Sensor())
    assert is_where_it_began(given, given)
    assert not is_where_it_began(replace(given, place=given.place + 0.01), given)


def test_too_few_events_says_what_helps():
    rng = np.random.default_rng(2)

    def events(count: int, begin: float = 0.0, end: float = 1.0, side: int = 64) -> dase.Events:
        t, xy = np.sort(rng.uniform(begin, end, count)), rng.integers(0, side, (2, count), dtype=np.uint16)
        return dase.Events(t, xy[0], xy[1], rng.random(count) < 0.5, side, side)

    def sentence(of: dase.Events, pixels: int, length: float = 1.0) -> str:
        scene = StaticScene(of.width, of.height, length)
        with pytest.raises(dase.InputError, match="too few events") as caught:
            split_measurement(Measurement(of, scene), pixels=pixels)
        return str(caught.value)

    more = split_measurement(Measurement(events(20_000), StaticScene(64, 64, 1.0)), pixels=60)
    assert "pixels are compared: 60 had too few events" in more.notes[-1]
    assert len(more.train.trials.stimulus.pixels) > 60
    # far more than were asked for
    assert "looking at more pixels helps" in sentence(events(20_000), 32)
    # still too few with as many as there are
    with pytest.raises(dase.InputError, match="too few events"):
        split_measurement(Measurement(events(1_500), StaticScene(64, 64, 1.0)), pixels=600)
    assert "times as long" in sentence(events(300), 2000)
    early = events(20_000, 0.0, 0.5)
    tail = events(20, 0.5, 1.0)
    assert "record what goes on over the whole time" in sentence(dase.Events.concatenate([early, tail]), 2000)


def test_the_last_point_of_the_grid_lies_within_the_scene():
    """284 steps of 1 ms end at 0.28400000000000003 s."""
    scene = moving_bars()
    times = np.linspace(0, 0.284, 9)
    frames = scene.frames(scene.sample_times()[: 9 * 35 : 35])
    short = VideoScene(frames, times)
    grid = common_grid(dase.simulate(short, Sensor(), seed=1), short)
    grid = Grid(0.0, 1e-3, 285) if grid.step != 1e-3 else grid
    assert times_of_grid(short, grid)[-1] <= 0.284
    assert compare(dase.simulate(short, Sensor(), seed=1), "ideal", scene=short, pixels=300).error < 20


def test_a_pair_that_was_found_is_in_the_table():
    step = Step(("threshold",), 6.0, 1.3, {"rate": 6.0}, (), None, (), ())
    model = model_of(Sensor().with_effect(EFFECTS["leak"](rate=5.0)).with_effect(EFFECTS["shot"](rate=2.0)))
    judged = Judgement(1.0, 1.2, 0.5, 0.3, {}, {}, np.zeros(1), 1.0)
    rank = rank_of_pair("leak + shot", model, judged, step)
    assert rank.share == 1.0
    assert rank.parameters["leak.rate"].value == pytest.approx(5.0)
    assert "nan" not in repr(rank)
    found = replace(found_nothing(), history=(replace(step, ranking=(rank,), chosen=rank.effect),))
    assert "leak + shot" in report.diagnosis_page(found, recording="a")


def at_rest(length: float, rate: float, side: int = 64) -> dase.Events:
    sensor = Sensor().with_effect(EFFECTS["shot"](rate=rate))
    return dase.simulate(StaticScene(side, side, length), sensor, seed=3)


@pytest.mark.slow
def test_of_a_long_recording_a_part_is_compared():
    """Memory and time do not grow with the recording; which part it was is said."""
    events = at_rest(60.0, 2.0)
    evidence = split_measurement(Measurement(events, StaticScene(64, 64, 60.0)), pixels=600)
    assert evidence.held.trials.stimulus.grid.steps <= 5000
    assert " s of 60 s are compared" in evidence.notes[0]
    assert int(evidence.held.found.halves.sum()) > 1000
    few = split_measurement(Measurement(at_rest(60.0, 0.1), StaticScene(64, 64, 60.0)), pixels=600)
    assert few.held.trials.stimulus.grid.steps > 20_000  # so that there are enough events


def test_the_part_that_is_compared_can_be_chosen():
    events = at_rest(3.0, 20.0)
    part = as_measurement(events, "static").part(1.0, 2.5, (8, 4, 32, 40))
    assert part.trust is not None
    evidence = split_measurement(part, pixels=300)
    stimulus = evidence.held.trials.stimulus
    assert stimulus.grid.begin == pytest.approx(1.0, abs=2e-3)
    assert stimulus.grid.times[-1] == pytest.approx(2.5, abs=2e-3)
    x, y = stimulus.pixels % 64, stimulus.pixels // 64
    assert (x.min(), y.min()) >= (8, 4)
    assert x.max() < 40
    assert y.max() < 44
    with pytest.raises(dase.InputError, match="not on the 64x64 sensor"):
        part.part(region=(40, 0, 32, 8))
    with pytest.raises(dase.InputError, match="must not be empty"):
        part.part(2.0, 1.0)
    with pytest.raises(dase.InputError, match="in common"):
        split_measurement(Measurement(events, part.scene, span=(9.0, 10.0)))


def test_gaps_that_repeat_are_left_out():
    """Missing data are not what the model gets wrong."""
    events = at_rest(4.0, 20.0)
    missing = (events.t % 0.3) < 0.018
    cut = events.select(~missing)
    gaps = repeated_gaps(cut.t)
    assert len(gaps) == 13  # the first is before the first event
    assert np.diff(gaps, axis=1) == pytest.approx(0.018, rel=0.05)
    scene, sensor = StaticScene(64, 64, 4.0), Sensor().with_effect(EFFECTS["shot"](rate=20.0))
    evidence = split_measurement(Measurement(cut, scene), pixels=600)
    assert any("13 gaps of 18" in note for note in evidence.notes)
    found = compare(cut, sensor, scene=scene, pixels=600)
    assert found.error < found.gate
    assert len(repeated_gaps(events.t)) == 0
    frames = np.repeat(np.arange(0, 4, 0.02), 200)
    assert len(repeated_gaps(frames)) == 0  # stamps of whole frames, nothing is missing


def test_what_is_known_is_written_as_it_is_found_and_when_the_user_stops(recording, tmp_path, monkeypatch):
    interim = replace(found_nothing(), finished=False)
    interim = replace(interim, history=(replace(interim.history[0], chosen="leak"),))

    def stopped(*args, so_far, **options):
        so_far(interim)
        assert json.loads(out.read_text())["finished"] is False
        raise KeyboardInterrupt

    out = tmp_path / "f.json"
    monkeypatch.setattr("dase.diagnosis.diagnose.diagnose", stopped)
    words = ["diagnose", "ideal", str(recording), "--scene", "static", "--auto", "--json", str(out), "-o"]
    result = CliRunner().invoke(dase_group, [*words, str(tmp_path / "s.toml")])
    assert result.exit_code == 130
    assert "not finished: error 6.00 after 1 steps; nearest so far: leak, not yet checked" in result.output
    assert not (tmp_path / "s.toml").exists()


def test_json_is_all_that_is_printed_where_it_is_printed(recording, monkeypatch):
    def interrupted(*args, so_far, **options):
        so_far(replace(found_nothing(), finished=False))
        so_far(replace(found_nothing(), finished=False))
        raise KeyboardInterrupt

    words = ["diagnose", "ideal", str(recording), "--scene", "static", "--auto", "--quiet", "--json", "-"]
    for ends, code in ((lambda *args, **options: found_nothing(), 0), (interrupted, 130)):
        monkeypatch.setattr("dase.diagnosis.diagnose.diagnose", ends)
        result = CliRunner().invoke(dase_group, words)
        assert result.exit_code == code
        assert json.loads(result.stdout)["finished"] is (code == 0)


def test_each_step_of_a_search_is_told():
    scene, known = moving_bars(), []
    events = dase.simulate(scene, Sensor().with_effect(EFFECTS["leak"](rate=5.0)), seed=4)
    library = {name: EFFECTS[name] for name in ("threshold", "leak")}
    found = diagnose(events, scene=scene, effects=library, pixels=300, so_far=known.append)
    assert found.finished
    assert [one.finished for one in known] == [False] * len(known)
    assert known[0].history[0].chosen == "leak"
    assert "leak" in known[0].sensor


def test_progress_in_a_pipe_is_a_line_now_and_then(capsys, monkeypatch):
    now = [0.0]
    monkeypatch.setattr("dase.cli.output.time.monotonic", lambda: now[0])
    with progress_bar(False) as tell:
        for second in range(35):
            now[0] = float(second)
            tell("fitting", second / 35, 2.0)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3
    assert lines[0] == "fitting, 29 %, error 2.00"
    with progress_bar(True) as tell:
        now[0] = 1000.0
        tell("fitting", 0.5, 2.0)
    assert capsys.readouterr().err == ""
