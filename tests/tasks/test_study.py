"""The study's table."""

from __future__ import annotations

import pytest

pytest.importorskip("torch")

import dase
from perf.experiments.downstream import sensors
from perf.experiments.downstream.run import SMALL, Job, Study, next_job, study_plan
from perf.experiments.downstream.sensors import (
    TARGETS,
    LearnSettings,
    record_target,
    train_on,
    tuned_thresholds,
)
from perf.experiments.downstream.table import (
    mean_text,
    paired_gaps,
    share_interval,
    share_text,
    tables,
    turned_rows,
)


def test_gaps_are_of_pairs():
    found = {("tuned", "slow"): {0: 0.5, 1: 0.6}, ("true", "slow"): {0: 0.3, 1: 0.4, 2: 0.1},
             ("fitted", "slow"): {0: 0.35, 1: 0.6, 2: 0.2}}  # fmt: skip
    part, whole = paired_gaps(found, "fitted", "slow")
    assert part == pytest.approx([-0.15, 0.0])
    assert whole == pytest.approx([-0.2, -0.2])
    assert share_text(whole, whole) == "100 (100 to 100)"
    assert mean_text([1.0, 2.0, 3.0], 2) == "2.00 ± 2.48"  # 4.303 / √3
    assert mean_text([], 2) == "–"
    rows = [{"task": "flow", "kind": kind, "target": "slow", "seed": seed, "aee": value}
            for (kind, _), values in found.items() for seed, value in values.items()]  # fmt: skip
    assert "| tuned | 0.55 ± 0.64 | – | – | – |" in tables(rows)


def test_networks_on_real_rotation_have_tables_of_their_own():
    rows = [{"network": "flow-true-all-1", "excerpt": "boxes", "aee": 1.0, "share": 0.25},
            {"network": "flow-esim-0", "excerpt": "boxes", "aee": 2.0, "share": 0.5}]  # fmt: skip
    found = tables(turned_rows(rows))
    assert "boxes, seeds 0, 1" in found
    assert "| true | – | – | – | 0.250 |" in found
    assert "| esim | 0.500 | 0.500 | 0.500 | 0.500 |" in found
    assert "gap" not in found  # their cameras are none of the targets


def test_intervals_of_shares_hold_the_truth_as_often_as_they_say(rng):
    """And there is none where the gap may be 0; two pairs are few, and say little."""
    held, count = 0, 4000
    for _ in range(count):
        whole = rng.normal(-1.0, 0.2, 5)
        part = 0.8 * whole + rng.normal(0.0, 0.1, 5)
        low, high = share_interval(list(part), list(whole))
        held += low <= 0.8 <= high
    assert held / count == pytest.approx(0.95, abs=0.015)
    assert share_interval([0.1, 0.1], [0.1, -0.2]) is None
    assert share_text([0.1, 0.1], [0.1, -0.2]).endswith("(no clear gap)")
    assert share_text([-0.08], [-0.1]) == "80"
    assert share_text([], []) == "–"


def test_what_is_tuned_is_one_polarity(rng):
    drawn = tuned_thresholds(0.2)(rng, 4000)
    on, off = drawn["threshold.on"], drawn["threshold.off"]
    assert ((on == 0.2) ^ (off == 0.2)).all()
    assert (on != 0.2).mean() == pytest.approx(0.5, abs=0.05)
    assert (on / 0.2)[on != 0.2].std() == pytest.approx(0.1, rel=0.1)


def test_targets_have_physics_beyond_thresholds():
    plain = {"threshold", "mismatch"}
    assert len(TARGETS) == 4
    assert all({effect.name for effect in sensor.effects} > plain for sensor in TARGETS.values())


def test_what_waits_for_no_fit_comes_first_and_seed_by_seed():
    tasks, kinds = ("reconstruction", "flow"), ("esim", "tuned", "fitted", "true")
    plan = study_plan(tasks, kinds, ("slow", "all"), (0, 1))
    assert plan[:2] == [Job("tune", "", "slow", 0), Job("tune", "", "all", 0)]
    quick = 2 * (1 + 2 * 2)  # of a seed: esim, and two kinds for two targets
    assert [job.seed for job in plan[2 : 2 + 2 * quick]] == [0] * quick + [1] * quick
    fits = 2 + 2 * quick
    assert plan[fits : fits + 2] == [Job("fit", "", "slow", 0), Job("fit", "", "all", 0)]
    assert {job.kind for job in plan[fits + 2 :]} == {"fitted"}
    assert [job.seed for job in plan[fits + 2 :]] == [0] * 4 + [1] * 4
    assert len(set(plan)) == len(plan)
    assert Job("flow", "esim", "", 1) in plan
    assert not any(job.task == "fit" for job in study_plan(("flow",), ("esim", "true"), ("slow",), (0,)))


def test_thresholds_on_top_of_a_fit_wait_for_it():
    plan = study_plan(("reconstruction",), ("learned", "learned_on_fitted", "fitted"), ("slow",), (0,))
    assert plan[:2] == [Job("train", "", "slow", 0), Job("reconstruction", "learned", "slow", 0)]
    on_top = Job("train_on_fit", "", "slow", 0)
    assert set(plan[2:4]) == {Job("fit", "", "slow", 0), on_top}
    assert next_job([on_top], set(), 100.0, {}) is None
    assert next_job([on_top], {("train", "slow")}, 100.0, {}) is None
    assert next_job([on_top], {("fit", "slow")}, 100.0, {}) == on_top


@pytest.mark.slow
def test_thresholds_are_learned_from_a_recording_and_loaded_again(tmp_path, monkeypatch):
    """Two steps of the default recipe on top of a cutoff: it stays, thresholds become learned ones."""
    # what is kept and what is learned goes for any size, and a network sees every pixel at every step
    monkeypatch.setattr(sensors, "VIEW", (64, 48))
    target = TARGETS["slow"]
    recorded = record_target(target, "builtin", 1.0, "cpu")
    settings = LearnSettings(steps=2, windows=4, batch=2)
    sensor = dase.load_sensor(
        train_on(recorded, tmp_path / "run", "default", "cpu", known=target, settings=settings)
    )
    assert sensor["bandwidth"] == target["bandwidth"]
    assert "mismatch" not in sensor
    assert (sensor.size, sensor["learned_threshold"].is_off()) == ((64, 48), False)
    batch = next(iter(dase.torch.Stream("builtin", sensor, batch=1, steps=2, size=(32, 32), device="cpu")))
    assert batch.inputs.abs().sum() > 0


def test_what_is_not_known_yet_or_takes_too_long_waits():
    waiting = [
        Job("flow", "fitted", "slow", 0),
        Job("reconstruction", "true", "slow", 0),
        Job("flow", "esim", "", 0),
    ]
    assert next_job(waiting, set(), 100.0, {}) == waiting[1]
    assert next_job(waiting, {("tune", "slow")}, 100.0, {}) == waiting[1]
    learned = {("fit", "slow")}
    assert next_job(waiting, learned, 100.0, {}) == waiting[0]
    assert next_job(waiting, set(), 100.0, {"reconstruction": 120.0}) == waiting[2]
    assert next_job(waiting, learned, 100.0, {"reconstruction": 120.0, "flow": 101.0}) is None


def test_fitted_sensors_are_trained_on_in_the_midst_of_things(tmp_path):
    """What a fit says of the phase is of its recording: with 0, first windows have too few events."""
    fitted = TARGETS["tired"].with_effect(dase.effects.Threshold(on=0.2, off=0.3, phase=0.0))
    study = Study("", "", tmp_path, "cpu", SMALL, 0.0)
    path = study.learned_file("fit", "tired")
    path.parent.mkdir()
    path.write_text(dase.dump_sensor(fitted), "utf-8")
    trained_on = study.training("fitted", "tired").sensor
    assert trained_on == fitted.with_effect(dase.effects.Threshold(on=0.2, off=0.3, phase=1.0))
