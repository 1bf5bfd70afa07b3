"""Hidden effects are found, nothing is invented, and what is unknown is called unexplained."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import ClassVar

import click
import cv2
import numpy as np
import pytest
import warp as wp
from click.testing import CliRunner
from helpers.brief_diagnosis import NO_LIMITS

import dase
from dase.cli import dase_group
from dase.cli.options import open_recorded
from dase.diagnosis import conclusion
from dase.diagnosis.diagnose import diagnose
from dase.diagnosis.explain_effect import moving_bars
from dase.diagnosis.state import explains_remainder
from dase.effects import EFFECTS, Effect, parameter
from dase.fitting.confidence_intervals import estimate_parameters
from dase.fitting.data_split import split_measurement
from dase.fitting.fit import _equally_good_models, _notes_on_minimum, fit
from dase.fitting.measurement import Measurement
from dase.fitting.model import model_of, refit_model
from dase.probes.distance import (
    ErrorScale,
    Judgement,
    judge_model,
    leaves_nothing,
    pseudo_huber,
    reaches_floor,
)
from dase.probes.statistics import LAYOUT, SIZE
from dase.results import Fit
from dase.scenes.video import VideoScene
from dase.simulation.sensor import Sensor

FEW = ("bandwidth", "mismatch", "leak", "shot")
LIBRARY = {name: effect for name, effect in EFFECTS.items() if name in (*FEW, "threshold")}
PIXELS = 900
FEWER = 250
"""Where an effect is far above chance, and how exactly it is measured is not asked."""


@wp.func
def popping(intensity: float, rate: float):
    """Both polarities alike, in bright light only."""
    total = rate * wp.clamp(intensity - 0.3, 0.0, 1.0)
    return 0.5 * total, 0.5 * total


@dataclass(frozen=True, kw_only=True)
class Popping(Effect):
    """Events of bright pixels that see nothing; no part of dase."""

    name: ClassVar[str] = "popping"
    source: ClassVar[str] = "this test"
    stages: ClassVar = {"noise": popping}

    rate: float = parameter(
        8.0, unit="Hz", off=0.0, bounds=(0.0, 1e4), plausible=(1.0, 80.0), about="events in bright light"
    )


@pytest.fixture(scope="module")
def scene() -> VideoScene:
    return moving_bars()


def hidden(scene, device, *effects: Effect, seed: int = 3) -> dase.Events:
    sensor = Sensor(effects=(EFFECTS["threshold"](on=0.18, off=0.22),))
    for effect in effects:
        sensor = sensor.with_effect(effect)
    return dase.simulate(scene, sensor, seed=seed, device=device)


@pytest.mark.parametrize(
    ("effect", "pixels"),
    [
        pytest.param(EFFECTS["leak"](rate=4.0), FEWER, id="leak"),
        # thresholds are fitted less well beside it
        pytest.param(EFFECTS["mismatch"](spread=0.25), PIXELS, id="mismatch", marks=pytest.mark.slow),
        pytest.param(EFFECTS["bandwidth"](cutoff=60.0), FEWER, id="bandwidth", marks=pytest.mark.slow),
    ],
)
def test_a_hidden_effect_is_named(scene, device, effect, pixels):
    events = hidden(scene, device, effect)
    found = diagnose(events, scene=scene, effects=LIBRARY, pixels=pixels, device=device, settings=NO_LIMITS)
    assert found.selected == (effect.name,)
    assert found.unexplained is None
    assert found.errors[1] - 1 < 0.1 * (found.errors[0] - 1)
    main = next(p.name for p in effect.parameters() if p.off is not None)
    got, true = found.parameters[f"{effect.name}.{main}"], getattr(effect, main)
    assert abs(got.value / true - 1) < 0.15 or got.low < true < got.high
    assert found.parameters["threshold.on"].value == pytest.approx(0.18, rel=0.05)
    assert json.loads(json.dumps(found.to_json()))["selected"] == [effect.name]
    assert f"missing: {effect.name}" in found.finding()


def test_nothing_is_invented(scene, device):
    events = hidden(scene, device)
    found = diagnose(events, scene=scene, effects=LIBRARY, pixels=PIXELS, device=device, settings=NO_LIMITS)
    assert found.selected == ()
    assert found.unexplained is None
    assert "nothing is missing" in found.finding()


@pytest.mark.slow
def test_two_hidden_effects_are_both_found(scene, device):
    events = hidden(scene, device, EFFECTS["mismatch"](spread=0.25), EFFECTS["leak"](rate=5.0))
    # with fewer, the mismatch is not found beside the leak
    found = diagnose(events, scene=scene, effects=LIBRARY, pixels=450, device=device, settings=NO_LIMITS)
    assert sorted(found.selected) == ["leak", "mismatch"]
    assert len(found.errors) == 3
    assert found.errors[0] > 2 > found.errors[2]


@pytest.mark.slow
def test_an_unknown_effect_is_unexplained_until_it_is_given(scene, device):
    events = hidden(scene, device, Popping(rate=25.0))
    how = {"scene": scene, "pixels": 250, "device": device, "settings": NO_LIMITS}
    found = diagnose(events, effects=LIBRARY, most=1, **how)
    assert found.selected == ()
    assert found.unexplained is not None
    assert any("bright" in cell.where for cell in found.unexplained.cells[:8])
    more = LIBRARY | {"popping": Popping}
    known = diagnose(events, effects=more, **how)
    assert known.selected == ("popping",)
    assert known.parameters["popping.rate"].value == pytest.approx(25.0, rel=0.15)


@pytest.mark.parametrize("astray", [0.0, 0.3])
def test_last_steps_that_lead_away_are_not_taken(scene, device, monkeypatch, astray):
    """One answer had an error of 0.58, and another of 1.4, which it called unexplained."""
    asked = conclusion.estimate_parameters

    def lead_away(evidence, model, *, seed):
        improved, values = asked(evidence, model, seed=seed)
        return replace(improved, place=improved.place + astray), values

    monkeypatch.setattr(conclusion, "estimate_parameters", lead_away)
    found = diagnose(hidden(scene, device), scene=scene, effects=LIBRARY, pixels=200, most=1, device=device)
    assert found.unexplained is None
    assert found.selected == ()
    assert found.errors[-1] < found.gate
    for name, true in {"threshold.on": 0.18, "threshold.off": 0.22}.items():
        value = found.parameters[name]
        assert value.low <= value.value <= value.high
        assert value.value == pytest.approx(true, rel=0.05)
        assert found.sensor["threshold"].on == found.parameters["threshold.on"].value


@pytest.mark.slow
def test_the_same_seed_gives_the_same_findings(scene, device):
    events = hidden(scene, device, EFFECTS["leak"](rate=4.0))
    one, two = (
        diagnose(events, scene=scene, effects=LIBRARY, pixels=80, most=1, seed=5, device=device).to_json()
        for _ in range(2)
    )
    if device == "cpu":
        # as text: candidates that were not judged have no error, and NaN is not equal to itself
        assert json.dumps({**one, "seconds": 0}) == json.dumps({**two, "seconds": 0})


@pytest.mark.slow
def test_another_simulator(shared, device):
    """Of an independent simulator the effect is named, and its lin-log mapping as well."""
    with np.load(shared / "hidden" / "clip_a.npz") as data:
        scene = VideoScene(data["frames"].astype(np.float32) / 255, data["frame_us"] * 1e-6)
    truth = json.loads((shared / "hidden" / "truth.json").read_text())
    wanted = next(n for n, case in truth.items() if case["params"]["leak_rate_hz"] > 0)
    with np.load(shared / "hidden" / f"{wanted}.npz") as data:
        t, x, y, p = (data[k] for k in ("t_us", "x", "y", "p"))
    events = dase.Events(t * 1e-6, x, y, p.astype(bool), scene.width, scene.height)
    library = LIBRARY | {"linlog": EFFECTS["linlog"]}
    found = diagnose(events, scene=scene, effects=library, pixels=450, device=device, settings=NO_LIMITS)
    assert sorted(found.selected) == ["leak", "linlog"]
    assert found.parameters["linlog.knee"].value == pytest.approx(20 / 255, rel=0.05)
    assert found.parameters["linlog.slope"].value == pytest.approx(np.log(20), rel=0.05)


@pytest.mark.slow
def test_intervals_cover_the_truth(scene, device):
    """Over several measurements, a 90 % interval holds the truth about as often as it says."""
    true = {"threshold.on": 0.18, "threshold.off": 0.22, "leak.rate": 4.0}
    given = Sensor(effects=(EFFECTS["threshold"](on=0.2, off=0.2),)).with_effect(EFFECTS["leak"](rate=2.0))
    inside, widths = [], []
    for seed in range(8):
        events = hidden(scene, device, EFFECTS["leak"](rate=4.0, spread=0.1), seed=20 + seed)
        evidence = split_measurement(Measurement(events, scene), pixels=300, seed=seed, device=device)
        model = refit_model(evidence, model_of(given, list(true)), seed=seed)
        _, got = estimate_parameters(evidence, model, seed=seed)
        inside += [got[n].low <= v <= got[n].high for n, v in true.items()]
        widths.append(got["leak.rate"].high / got["leak.rate"].low)
    assert np.mean(inside) > 0.7
    assert np.median(widths) < 1.5


@pytest.mark.slow
def test_a_fit_from_far_away(scene, device):
    events = hidden(scene, device, EFFECTS["leak"](rate=4.0))
    given = Sensor(effects=(EFFECTS["threshold"](on=0.5, off=0.1),)).with_effect(EFFECTS["leak"](rate=0.3))
    got = fit(events, given, scene=scene, pixels=FEWER, device=device)
    assert got.error < 1 < got.before
    assert got.sensor["threshold"].off == pytest.approx(0.22, rel=0.05)
    assert got.parameters["leak.rate"].value == pytest.approx(4.0, rel=0.15)


def test_the_error_of_repeats_is_one(rng):
    used = np.ones(SIZE, np.bool_)
    sigma = rng.uniform(0.5, 2, SIZE)
    off = 0.3 * sigma
    repeats = rng.normal(0, sigma, (200, SIZE))
    chance = ErrorScale(np.zeros(SIZE), np.sqrt(sigma**2 * 1.005 + off**2), used)
    errors = []
    for _ in range(400):
        target = rng.normal(0, sigma) + off * rng.standard_normal(SIZE)
        seen = ErrorScale(target, chance.sigma, used)
        errors.append(judge_model(repeats, seen, chance, off, seed=0).error)
    assert np.mean(errors) == pytest.approx(1.0, abs=0.05)
    one = judge_model(repeats, seen, chance, off, seed=0)
    assert np.mean(np.array(errors) < one.gate) >= 0.9


def test_the_loss_is_robust_and_its_slope_never_vanishes():
    z = np.linspace(0, 1e4, 1000)
    np.testing.assert_allclose(pseudo_huber(np.array([1e-3])), 1e-6, rtol=1e-3)
    assert np.all(np.diff(pseudo_huber(z)) > 0)
    assert pseudo_huber(np.array(1e4)) < 2e4


def test_families_weigh_alike():
    used = np.ones(SIZE, np.bool_)
    used[LAYOUT["rate"]] = False
    used[LAYOUT["rate"].start] = True
    weights = ErrorScale(np.zeros(SIZE), np.ones(SIZE), used).weights()
    sums = [weights[part].sum() for part in LAYOUT.values()]
    np.testing.assert_allclose(sums, 1 / len(LAYOUT))


def run(*words: str):
    return CliRunner().invoke(dase_group, words, standalone_mode=False)


def save(path, events, **more):
    np.savez(path, t_us=np.rint(events.t * 1e6).astype(np.int32), x=events.x, y=events.y,
             p=events.p.astype(np.uint8), wh=np.array([events.width, events.height]), **more)  # fmt: skip


def clip(path, scene, times=None):
    times = scene.sample_times() if times is None else times
    np.savez(path, frames=scene.frames(scene.sample_times()), frame_us=np.rint(times * 1e6).astype(np.int64))


def bad(message: str, *words: str) -> None:
    result = run(*words)
    assert isinstance(result.exception, dase.InputError)
    assert message in str(result.exception)
    assert "\n" not in str(result.exception)


def test_bad_input_is_one_sentence(tmp_path, scene):
    events = dase.simulate(scene, Sensor(), seed=1)
    save(tmp_path / "r.npz", events)
    clip(tmp_path / "s.npz", scene)
    r, s = str(tmp_path / "r.npz"), str(tmp_path / "s.npz")
    clip(tmp_path / "late.npz", scene, scene.sample_times() + 100)
    small = VideoScene(scene.frames(scene.sample_times())[:, :20], scene.sample_times())
    clip(tmp_path / "small.npz", small)
    frames = scene.frames(scene.sample_times()).copy()
    frames[7, 3, 3] = np.nan
    np.savez(tmp_path / "nan.npz", frames=frames, frame_us=np.rint(scene.sample_times() * 1e6))
    save(tmp_path / "few.npz", events.select(slice(0, None, 1000)))
    for command in ("diagnose", "compare"):
        bad(
            "must have one size, got 72x48 and 72x20",
            command,
            "ideal",
            r,
            "--scene",
            str(tmp_path / "small.npz"),
        )
        bad("must overlap in time", command, "ideal", r, "--scene", str(tmp_path / "late.npz"))
        bad("frame 7 has 1 values", command, "ideal", r, "--scene", str(tmp_path / "nan.npz"))
        bad("too few events", command, "ideal", str(tmp_path / "few.npz"), "--scene", s)
    bad("has no frames", "diagnose", "ideal", r)
    bad("needs the file", "diagnose", "ideal", r, "--scene", "video")
    bad(
        "no parameter 'leek'",
        "fit",
        "ideal",
        r,
        "--scene",
        s,
        "--free",
        "leek",
        "-o",
        str(tmp_path / "o.toml"),
    )
    assert not (tmp_path / "o.toml").exists()


@pytest.mark.slow
def test_the_commands_agree_with_python(tmp_path, scene):
    events = dase.simulate(scene, Sensor(), seed=1)
    save(tmp_path / "r.npz", events)
    clip(tmp_path / "s.npz", scene)
    made = [str(tmp_path / n) for n in ("r.npz", "s.npz")]
    result = run("compare", "ideal", made[0], "--scene", "video", made[1], "--pixels", "400", "--quiet",
                 "-o", str(tmp_path / "c.html"))  # fmt: skip
    assert result.exception is None, result.exception
    table = json.loads((tmp_path / "c.json").read_text())
    assert {"error", "floor", "gate", "families", "cells", "plain"} <= set(table)
    result = run("fit", "ideal", *made[:1], "--scene", made[1], "--pixels", "400", "--quiet", "-o",
                 str(tmp_path / "f.toml"))  # fmt: skip
    assert result.exception is None, result.exception
    assert dase.load_sensor(tmp_path / "f.toml")["threshold"].on == pytest.approx(0.2, rel=0.05)


def test_a_poor_minimum_is_said(tmp_path, scene, monkeypatch):
    """The file is written, the last line says so, and a script that goes on only after success stops."""
    save(tmp_path / "r.npz", dase.simulate(scene, Sensor(), seed=1))
    ends = Fit(Sensor(), {}, error=3.0, before=4.0, floor=1.0, gate=1.2, agree=False, poor=True)
    monkeypatch.setattr("dase.fitting.fit.fit", lambda *args, **more: ends)
    words = ["fit", "ideal", str(tmp_path / "r.npz"), "--scene", "static", "-o", str(tmp_path / "f.toml")]
    result = CliRunner().invoke(dase_group, words)
    assert result.exit_code == 1
    assert "poor minimum" in result.output
    assert (tmp_path / "f.toml").exists()
    monkeypatch.setattr("dase.fitting.fit.fit", lambda *args, **more: replace(ends, poor=False))
    assert CliRunner().invoke(dase_group, words).exit_code == 0


def test_starts_that_end_higher_are_not_counted():
    judgements = [Judgement(error, 1.2, 0.5, 0.3, {}, {}, np.zeros(1), 1.0) for error in (1.1, 5.0, 9.0)]
    ends = [(judgement, model_of(Sensor())) for judgement in judgements]
    assert len(_equally_good_models(ends)) == 1
    assert "only one came" in _notes_on_minimum(judgements[0], 3, 1)[0]
    assert "model lacks something" in _notes_on_minimum(judgements[1], 3, 2)[0]
    assert _notes_on_minimum(judgements[0], 3, 2) == []


def test_a_clip_is_played_at_the_rate_that_is_given(tmp_path, scene):
    save(tmp_path / "r.npz", dase.simulate(scene, Sensor(), seed=1))
    (tmp_path / "clip").mkdir()
    for k, frame in enumerate(scene.frames(scene.sample_times()[:5])):
        cv2.imwrite(str(tmp_path / "clip" / f"{k}.png"), np.rint(255 * frame.clip(0, 1)).astype(np.uint8))
    seen = open_recorded(tmp_path / "r.npz", str(tmp_path / "clip"), None, 800.0).scene
    # frames so near each other are joined as they are
    np.testing.assert_allclose(seen.sample_times(), np.arange(5) / 800)
    with pytest.raises(click.UsageError, match="--fps goes with"):
        open_recorded(tmp_path / "r.npz", "static", None, 200.0)


def test_an_effect_of_the_user_is_explained_wherever_its_file_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "dase.simulation.user_effects.known_effects", lambda paths: [path.name for path in paths]
    )
    monkeypatch.setattr(
        "dase.diagnosis.explain_effect.explain_effect", lambda name, known: f"{name} of {known}"
    )
    for words in (("--effects", "a.py", "--explain", "x"), ("--explain", "x", "--effects", "a.py")):
        result = CliRunner().invoke(dase_group, ["diagnose", *words])
        assert result.exit_code == 0, result.output
        assert result.output == "x of ['a.py']\n"


def test_too_small_a_scene_is_refused(scene):
    tiny = VideoScene(scene.frames(scene.sample_times())[:, :4, :4], scene.sample_times())
    with pytest.raises(dase.InputError, match="16 pixels"):
        split_measurement(Measurement(dase.simulate(tiny, Sensor()), tiny))


def judged(error: float, reach: float = 0.4, level: float = 0.2, **families: float) -> Judgement:
    return Judgement(error, 1.2, reach, level, families, dict.fromkeys(families, 2.0), np.zeros(1), 1.0)


def test_a_search_ends_at_what_chance_gives():
    assert leaves_nothing(judged(0.4))
    assert not leaves_nothing(judged(0.8))
    assert reaches_floor(judged(0.8))
    # a family far off is looked at, however small the mean
    assert not leaves_nothing(judged(0.3, rate=5.0))


def test_little_is_added_only_where_it_accounts_for_most():
    assert explains_remainder(judged(0.3), judged(0.8))
    assert explains_remainder(judged(0.45), judged(0.8))  # 0.25 of 0.6 above the level of chance
    assert not explains_remainder(judged(0.45), judged(0.6))  # 0.25 of 0.4
    assert not explains_remainder(judged(0.6), judged(1.3))  # more than chance is left
    assert explains_remainder(judged(0.6, reach=0.7), judged(1.3))


def test_nothing_is_free_where_light_never_changes_and_only_the_readout_is_tried():
    """Thresholds are not fitted there, and a scan is read off the events."""
    bright = np.random.default_rng(1).uniform(0.1, 0.9, (1, 24, 32)).astype(np.float32)
    scene = dase.VideoScene(np.repeat(bright, 2, 0), np.array([0.0, 1.0]))
    sensor = dase.Sensor().with_effect(EFFECTS["shot"](rate=20.0)).with_effect(EFFECTS["row_scan"](line=2e-4))
    library = {name: EFFECTS[name] for name in ("row_scan", "timestamp")}
    found = diagnose(
        dase.simulate(scene, sensor, seed=1),
        scene=scene,
        effects=library,
        pixels=200,
        most=1,
        settings=NO_LIMITS,
    )
    assert "row_scan" in {one.effect for one in found.findings if one.grade == "certain"}
    assert not found.parameters


@pytest.mark.slow
def test_no_pair_is_added_where_one_effect_is_the_most(scene):
    """A pair took two, and what was left to add was negative: a traceback."""
    sensor = Sensor().with_effect(EFFECTS["bandwidth"](cutoff=40.0))
    sensor = sensor.with_effect(EFFECTS["refractory"](period=0.008)).with_effect(
        EFFECTS["mismatch"](spread=0.2)
    )
    library = {name: EFFECTS[name] for name in ("threshold", "latency", "leak", "shot", "linlog")}
    events = dase.simulate(scene, sensor, seed=4)
    found = diagnose(events, scene=scene, effects=library, pixels=200, most=1, settings=NO_LIMITS)
    assert len(found.sensor.effects) <= 2
    assert found.unexplained is not None
