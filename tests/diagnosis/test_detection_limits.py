"""What a measurement would have shown of effects that were not found, and what to record next."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers.brief_diagnosis import NO_LIMITS

import dase
from dase.diagnosis.cell_descriptions import kind_of_pixels
from dase.diagnosis.detection_limits import (
    _limit_work,
    _range_of,
    _reported_model,
    _rule_of_first,
    describe_limit,
    main_axis,
    would_be_added,
)
from dase.diagnosis.diagnose import diagnose
from dase.diagnosis.explain_effect import moving_bars
from dase.diagnosis.remainder import shares_by_pixels, what_to_record
from dase.diagnosis.settings import DEFAULTS
from dase.diagnosis.state import DiagnosisTask
from dase.effects import EFFECTS
from dase.fitting.data_split import split_measurement
from dase.fitting.measurement import Measurement
from dase.fitting.model import model_of
from dase.fitting.scheduler import answer_requests
from dase.probes.distance import Judgement
from dase.probes.statistics import LAYOUT, SIZE
from dase.results import Finding, Grade, Unexplained
from dase.scenes.between_frames import CameraScene
from dase.scenes.video import VideoScene
from dase.simulation.sensor import Sensor

LIBRARY = {name: EFFECTS[name] for name in ("threshold", "leak", "shot")}


@pytest.fixture(scope="module")
def scene() -> VideoScene:
    return moving_bars()


def look(
    scene, *effects, seed: int = 3, library=LIBRARY, settings=DEFAULTS, pixels: int = 400
) -> dase.Diagnosis:
    sensor = Sensor()
    for effect in effects:
        sensor = sensor.with_effect(effect)
    events = dase.simulate(scene, sensor, seed=seed)
    return diagnose(events, scene=scene, effects=library, pixels=pixels, most=1, seed=seed, settings=settings)


@pytest.fixture(scope="module")
def leaky(scene) -> dase.Diagnosis:
    return look(scene, EFFECTS["leak"](rate=4.0))


def judged(error: float) -> Judgement:
    return Judgement(error, 1.15, 0.4, 0.25, {}, {}, np.zeros(1), 1.0)


def test_what_was_not_found_has_a_limit_and_what_was_has_none(leaky):
    found = leaky
    (limit,) = [one for one in found.not_seen if one.parameter]
    assert limit.effect == "shot"
    assert limit.strength is not None
    # pixels at rest here see some seconds in all: far less than an event of each, far more than none of all
    assert 0.02 < limit.strength < 4
    assert limit.sentence in repr(found)
    assert json.loads(json.dumps(found.to_json()))["not_seen"][0]["sentence"] == limit.sentence


@pytest.mark.slow
@pytest.mark.parametrize(("name", "pixels"), [("shot", 150), ("mismatch", 400)], ids=["shot", "mismatch"])
def test_limits_agree_with_simulation(name, pixels):
    """Twice the limit is named in most recordings, a quarter of it in few."""
    # a limit that is five times too high fails here too; with fewer pixels that of mismatch would not
    scene = moving_bars(duration=0.5)
    library = {n: EFFECTS[n] for n in ("threshold", name)}
    (limit,) = [one for one in look(scene, library=library, pixels=pixels).not_seen if one.parameter]
    assert limit.strength is not None
    field = limit.parameter.split(".")[1]

    def three_of_four(share: float, *, named: bool) -> bool:
        """Return whether it is named, or not, in three of four recordings; those that decide are made."""
        effect, agree = EFFECTS[name](**{field: share * limit.strength}), 0
        for k in range(4):
            found = look(scene, effect, seed=20 + k, library=library, settings=NO_LIMITS, pixels=pixels)
            agree += bool(found.findings) == named
            if agree == 3 or agree < k:
                break
        return agree == 3

    assert three_of_four(2.0, named=True)
    assert three_of_four(0.25, named=False)


@pytest.mark.parametrize("name", ["leak", "voltage_noise"])
def test_stronger_is_tried_only_where_weaker_is_not_seen(scene, name):
    """But where a model needs samples of its own, all strengths fill one launch."""
    sensor = Sensor()
    evidence = split_measurement(Measurement(dase.simulate(scene, sensor, seed=3), scene), pixels=200, seed=3)
    task = DiagnosisTask(evidence, EFFECTS, 3, lambda text, share, error: None, frozenset({"threshold"}))
    model = model_of(sensor)
    half = model.calibrate(evidence.report, repeats=20, seed=5)
    known = _reported_model(task, model, half, half.judge(1), half.judge(1))
    effect = EFFECTS[name].candidates(evidence.observe(idle_bus=0.01))[0]
    axis = main_axis(model, effect)
    work = _limit_work(task, known, effect, axis)
    asked, asks = [], next(work)
    while True:
        asked.append(asks)
        try:
            asks = work.send(answer_requests(asks))
        except StopIteration as stop:
            place = stop.value
            break
    first = asked[0]
    assert len(first) == task.settings.detection.repeats
    column = [a.name for a in first[0].space.axes].index(axis.name)
    tried = [np.unique(np.concatenate([ask.places[:, column] for ask in asks])) for asks in asked]
    assert place is not None
    if name == "voltage_noise":
        assert len(asked) == 1
        assert len({ask.finer for ask in first}) == 1
        assert first[0].finer
        assert sum(len(ask.places) for ask in first) <= 16
    else:
        # the strongest, which takes longest, is not simulated where a weaker one is seen
        assert len(tried[0]) == 2
        assert max(t.max() for t in tried) < _range_of(axis)[1]
        assert place <= max(t.max() for t in tried)


def test_limits_in_words():
    leak, bandwidth, present = EFFECTS["leak"](), EFFECTS["bandwidth"](), model_of(Sensor())
    axis = main_axis(present, leak)
    limit = describe_limit(leak, axis, axis.to_place(0.6))
    assert limit.sentence == "leak rate above 600 mHz would have been seen"
    assert limit.rises
    assert describe_limit(leak, axis, None).sentence == "no leak rate up to 20 Hz would have been seen"
    axis = main_axis(present, bandwidth)
    limit = describe_limit(bandwidth, axis, axis.to_place(300.0))
    assert limit.sentence == "bandwidth cutoff below 300 Hz would have been seen"
    assert not limit.rises
    assert describe_limit(bandwidth, axis, None).strength is None


def test_what_a_search_would_not_add_is_not_seen():
    assert not would_be_added(judged(0.3), judged(0.45), DEFAULTS)  # nothing is looked for
    assert would_be_added(judged(0.3), judged(0.9), DEFAULTS)
    assert not would_be_added(judged(0.8), judged(0.9), DEFAULTS)  # explains too little of what is left
    assert would_be_added(judged(2.0), judged(9.0), DEFAULTS)
    assert not would_be_added(judged(2.0), judged(2.1), DEFAULTS)


def test_each_statistic_is_of_one_kind_of_pixels():
    seen = {family: {kind_of_pixels(family, n) for n in range(part.stop - part.start)}
            for family, part in LAYOUT.items()}  # fmt: skip
    assert seen["rate"] == seen["intervals"] == seen["space"] == seen["spread"] == {"moving", "resting"}
    assert seen["lag"] == seen["change"] == {"moving"}
    assert seen["spectrum"] == seen["stamps"] == {"all"}


def test_where_an_error_sits_is_told_by_pixels():
    z = np.zeros(SIZE)
    z[LAYOUT["lag"]] = 3.0
    compared = np.ones(SIZE, np.bool_)
    one = replace(judged(3.0), z=z, compared=compared)
    assert shares_by_pixels(one) == pytest.approx({"moving": 1.0, "resting": 0.0, "all": 0.0})


def frames(exposure: float) -> CameraScene:
    begin = 0.04 * np.arange(6)
    return CameraScene(np.full((6, 8, 8), 90, np.uint8), begin, begin + exposure)


def left(of_scene: float, **places: float) -> Unexplained:
    return Unexplained(3.0, 0.4, (), (), "", of_scene, places)


def test_what_to_record_next(scene):
    lamp = Finding("flicker", Grade.CERTAIN)
    either = Finding("leak", Grade.EITHER, ("shot",))
    assert what_to_record(scene, [lamp], None, EFFECTS) == ()
    texts = what_to_record(frames(0.02), [lamp], left(0.6, moving=0.3, resting=0.1), EFFECTS)
    assert [text.split(",")[0].split(" (")[0] for text in texts] == [
        "frames more often than every 40 ms", "exposures below 10 ms",
        "the same under light that does not flicker",
    ]  # fmt: skip
    for name in ("exposure", "frame coupling"):  # the effect, or what is seen where no effect of it is known
        (text,) = what_to_record(frames(0.001), [Finding(name, Grade.CERTAIN)], left(0.0), EFFECTS)
        assert "frames off" in text
    (text,) = what_to_record(frames(0.001), [], left(0.0, moving=0.1, resting=0.9), EFFECTS)
    assert "lens cap" in text
    (text,) = what_to_record(scene, [], left(0.0, moving=0.9), EFFECTS)
    assert "dase stimulus" in text
    (text,) = what_to_record(scene, [either], None, EFFECTS)
    assert "dase distinguish" in text
    assert "what the camera saw" in what_to_record(scene, [], None, EFFECTS, contradiction=True)[0]


def test_parameters_of_a_model_that_leaves_too_much_are_no_claim(leaky):
    found = leaky
    assert found.parameters_hold
    assert "with 90 % intervals" in repr(found)
    off = replace(found, errors=(6.0, 5.0))
    assert not off.parameters_hold
    assert "no claim" in repr(off)
    assert off.to_json()["parameters_hold"] is False
    # next to nothing of much is left: another world's habits
    assert replace(found, errors=(40.0, 2.0)).parameters_hold


def test_a_limit_names_the_rule_for_which_it_holds():
    refractory = EFFECTS["refractory"](mode="reset")
    model = model_of(Sensor())
    axis = main_axis(model, refractory)
    assert axis is not None
    limit = describe_limit(refractory, axis, axis.to_place(2e-3), "reset")
    assert limit.sentence == "refractory period (reset) above 2 ms would have been seen"
    variants = [EFFECTS["refractory"](mode=mode) for mode in ("reset", "drop")]
    assert _rule_of_first(variants) == "reset"
    assert _rule_of_first(variants[:1]) == ""
