"""Training as a whole: steps, their replay, and the folder of a run that goes on where it stopped."""

from __future__ import annotations

import re
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.tiny_training import CRITICS, SIDE, WGAN, a_fake, a_run, small_scenes

from dase.errors import InputError
from dase.learning import scene_batches
from dase.learning.evaluation import MapEvaluation
from dase.learning.run import RunFile, RunSchedule, TrainingDiverged, load_checkpoint, train_in_folder
from dase.learning.targets import Pairs
from dase.networks.threshold_network import NetworkShape
from dase.scenes import image_sources


@pytest.fixture(scope="module")
def scenes() -> scene_batches.Scenery:
    return small_scenes()


@pytest.mark.slow
@pytest.mark.parametrize("start", [(0.45, 0.12), (0.09, 0.02)])
def test_a_wrong_start_is_left_behind(scenes, start):
    training = a_run(scenes, mu=start[0], sigma=start[1], steps=60, warmup=10)
    exam = MapEvaluation(scenes, training.target, scenes=4)
    before = exam.describe_maps(training.net)
    while training.step < training.recipe.steps:
        training.advance()
    after = exam.describe_maps(training.mean)
    assert after["mu_diff"] < 0.1 * before["mu_diff"]
    assert after["kl"] < 0.05
    assert before["kl"] > 1
    assert set(after) >= {"kl_active", "kl_idle", "mu_spread", "sigma_spread"}


@pytest.mark.slow
def test_critics_push_towards_the_target(scenes):
    training = a_run(scenes, **WGAN, warmup=30, batch=6, mu=0.4, sigma=0.1)
    for _ in range(30):
        training.advance()
    assert training.step == 0
    loss, _ = training.objective.loss(a_fake(training), training.target.draw(training.reals, 6), move=True)
    loss.backward()
    assert float(training.net.level.grad[0]) > 0  # descent lowers thresholds that are too high
    low = a_run(scenes, **WGAN, warmup=30, batch=6, mu=0.1, sigma=0.025)
    for _ in range(30):
        low.advance()
    loss, _ = low.objective.loss(a_fake(low), low.target.draw(low.reals, 6), move=True)
    loss.backward()
    assert float(low.net.level.grad[0]) < 0


def test_rates_rise_and_fall_within_the_steps_there_are(scenes):
    for steps, ramp in ((400, 50), (24, 50), (2, 50)):
        training = a_run(scenes, steps=steps, ramp=ramp)
        shares = []
        for training.step in range(steps):
            shares.append(training.learning_share())
        top = int(np.argmax(shares))
        assert top == min(ramp, max(steps // 4, 1)) - 1
        assert shares[top] == 1
        assert (np.diff(shares[: top + 1]) > 0).all()
        assert (np.diff(shares[top + 1 :]) < 0).all()
        assert np.sum(shares) > 0.4 * steps


def test_derivatives_are_of_other_scenes_in_every_step(scenes):
    training = a_run(scenes, batch=8)
    seen = []
    for training.step in range(2):
        fake = a_fake(training)
        seen += fake.some.tolist()
        for above, below in fake.answers.values():
            assert above.shape == below.shape == (4, 2, SIDE, SIDE)
    assert sorted(seen) == list(range(8))


def tensors(value, name=""):
    """Yield all tensors inside of dictionaries and lists, by their names."""
    if isinstance(value, torch.Tensor):
        yield name, value
    elif isinstance(value, dict | list | tuple):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, inner in items:
            yield from tensors(inner, f"{name}.{key}")


KINDS = {
    "moments": dict(network=NetworkShape(channels=4, depth=1, split=True, table=(3, 3))),
    "patterns": dict(network=NetworkShape(channels=4, depth=1, pattern=(SIDE, SIDE))),
    "adabelief": dict(optimizer="adabelief"),
    "critics": dict(WGAN, adversarial=replace(CRITICS, critic_cosine=True), batch=6),
}


@pytest.mark.parametrize(
    "kind",
    [
        kind if kind in ("moments", "critics") else pytest.param(kind, marks=pytest.mark.slow)
        for kind in KINDS
    ],
)
def test_steps_leave_everything_where_it_was(scenes, kind):
    # what is replayed reads and writes the memory of the step that was recorded
    training = a_run(scenes, **KINDS[kind], steps=80, warmup=4)
    for _ in range(8):
        training.advance()

    def places():
        state = training.state() | {"inputs": training.inputs}
        kept = ((n, v) for n, v in tensors(state) if not re.search("random|generator", n))
        return {name: value.data_ptr() for name, value in kept}

    before = places()
    assert len(before) > 20
    for _ in range(30):
        training.advance()
    assert places() == before


@pytest.mark.parametrize("kind", KINDS)
def test_replayed_steps_are_the_same_steps(scenes, device, kind):
    if device == "cpu":
        pytest.skip("steps are replayed on a GPU only; --device cuda:0 asks for one")
    source = image_sources.open_images("builtin")
    there = scene_batches.Scenery(source, scenes.scene_settings, device=device, backgrounds=6, objects=8)
    ends = []
    for seen in (10**9, 3):
        training = a_run(there, **KINDS[kind], steps=60, warmup=8)
        training.replay.plain_runs = seen
        for _ in range(40):
            values = training.advance()
        assert bool(training.replay.recorded) == (seen == 3)
        assert np.isfinite(float(values["loss"]))
        ends.append(training)
    first, second = (dict(tensors([t.net.state_dict(), t.mean.state_dict()])) for t in ends)
    for name, value in first.items():
        # sums on a GPU are taken in any order
        torch.testing.assert_close(second[name], value, rtol=2e-3, atol=2e-4, msg=name)
    numbers = [t.generator.get_state() for t in ends]
    assert torch.equal(*numbers)


def same(one, other) -> bool:
    if isinstance(one, torch.Tensor):
        return torch.equal(one, other)
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[k], other[k]) for k in one)
    if isinstance(one, (list, tuple)):
        return len(one) == len(other) and all(same(a, b) for a, b in zip(one, other, strict=True))
    return one == other


@pytest.mark.parametrize(
    "changes",
    [
        {"network": NetworkShape(channels=4, depth=1, table=(3, 2), split=True, pattern=(SIDE, SIDE))},
        pytest.param(WGAN, marks=pytest.mark.slow),
        pytest.param(
            {**WGAN, "optimizer": "adabelief", "adversarial": replace(CRITICS, critic_image=True)},
            marks=pytest.mark.slow,
        ),
    ],
    ids=["moments", "wgan", "adabelief"],
)
def test_a_resumed_run_ends_bit_equal(scenes, tmp_path, changes):
    recipe = {**changes, "steps": 6, "warmup": 2}
    whole, first, second = (a_run(scenes, **recipe) for _ in range(3))
    schedule = RunSchedule(log_every=2, save_every=0.0, score_every=0)
    train_in_folder(whole, tmp_path / "whole", schedule=schedule)

    def stop(row: dict[str, float]) -> None:
        if row["step"] == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_in_folder(first, tmp_path / "cut", schedule=schedule, on_row=stop)
    with (tmp_path / "cut" / RunFile.LOG).open("a") as file:
        file.write("1")  # of a line that was being written when the run was killed
    train_in_folder(second, tmp_path / "cut", schedule=schedule, resume=True)
    states = [load_checkpoint(tmp_path / name / RunFile.CHECKPOINT, "cpu") for name in ("whole", "cut")]
    for state in states:
        del state["seconds"]
    assert same(*states)
    steps = [
        [line.split(",")[0] for line in (tmp_path / name / RunFile.LOG).read_text().splitlines()]
        for name in ("whole", "cut")
    ]
    assert steps[0] == steps[1]


def test_nan_stops_with_its_step_and_the_last_good_checkpoint(scenes, tmp_path):
    training = a_run(scenes, steps=30, warmup=1)
    plain = training.objective.loss

    def poisoned(fake: Pairs, real: Pairs, *, move: bool, rates: torch.Tensor):
        loss, values = plain(fake, real, move=move, rates=rates)
        return (loss * float("nan") if training.step == 3 else loss), values

    training.objective.loss = poisoned
    with pytest.raises(
        TrainingDiverged, match=r"broke at step 3: .* is not finite; the last good checkpoint is .*pt"
    ):
        train_in_folder(
            training, tmp_path / "run", schedule=RunSchedule(log_every=2, save_every=0.0, score_every=0)
        )
    assert load_checkpoint(tmp_path / "run" / RunFile.CHECKPOINT, "cpu")["step"] == 2


def test_a_folder_is_not_begun_twice(scenes, tmp_path):
    with pytest.raises(InputError, match="no checkpoint to resume"):
        train_in_folder(a_run(scenes), tmp_path / "none", resume=True)
    (tmp_path / RunFile.CHECKPOINT).write_bytes(b"not one")
    with pytest.raises(InputError, match="already holds a run"):
        train_in_folder(a_run(scenes), tmp_path)
    with pytest.raises(InputError, match="is not a checkpoint"):
        train_in_folder(a_run(scenes), tmp_path, resume=True)


@pytest.mark.parametrize("slow_from", [-100, pytest.param(5, marks=pytest.mark.slow)])
def test_the_time_is_kept_where_steps_are_slow(scenes, tmp_path, monkeypatch, slow_from):
    """The clock was looked at after 30 steps, however long those took."""
    training = a_run(scenes, steps=500, warmup=0)
    advance = training.advance

    def slow_advance():
        if training.step >= slow_from:
            time.sleep(0.3)
        return advance()

    monkeypatch.setattr(training, "advance", slow_advance)
    results = []
    schedule = RunSchedule(seconds=3.0, result_every=0.5, score_every=0)
    row = train_in_folder(training, tmp_path, schedule=schedule, on_result=results.append)
    assert 1 <= training.step < 40
    assert row["step"] == training.step == training.recipe.steps
    assert results  # long before the end
    assert all("mu" in found for found in results)
