"""Trainings: the same weights however often they stop, less loss, sentences; on batches made here."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

torch = pytest.importorskip("torch")

from helpers.scripts import load_script
from helpers.two_processes import run_as_two_processes

from dase.errors import InputError
from dase.tasks.carried_memory import CarriedMemory
from dase.tasks.checkpoints import load_network, read_checkpoint
from dase.tasks.event_networks import E2VidNet, EvFlowNet, FireNet
from dase.tasks.flow_training import FlowTraining, flow_loss, train_flow
from dase.tasks.optimisation import Optimisation
from dase.tasks.reconstruction_training import (
    ReconstructionTraining,
    reconstruction_losses,
    train_reconstruction,
)
from dase.tasks.training_step import TrainingStep
from dase.torch.batch import Batch

RECONSTRUCTION = ReconstructionTraining(steps=6, warm_up=2, average=0.5, save_every=2, log_every=1)
FLOW = FlowTraining(steps=6, warm_up=2, average=0.5, save_every=2, log_every=1)


def made_batch(number: int) -> Batch:
    """Return a batch that its number decides: events where frames are bright, flow everywhere alike.

    Scenes go on for three batches.
    """
    generator = torch.Generator().manual_seed(number % 2)
    frames = torch.rand(3, 2, 1, 16, 16, generator=generator)
    flow = torch.full((3, 2, 2, 16, 16), 60.0)
    reset = torch.zeros(3, 2, dtype=torch.bool)
    reset[0] = number % 3 == 0
    return Batch(frames.expand(3, 2, 5, 16, 16), frames, flow, reset, torch.ones(2, 2))


def batches(first):
    while True:
        yield made_batch(first)
        first += 1


def weights(network):
    return torch.cat([p.flatten() for p in network.parameters()])


TASKS = [(train_reconstruction, FireNet(5, 4), RECONSTRUCTION), (train_flow, EvFlowNet(5, 4), FLOW)]


@pytest.mark.parametrize(("train", "network", "settings"), TASKS, ids=["reconstruction", "flow"])
def test_stopped_and_resumed_gives_the_same_weights(train, network, settings, tmp_path):
    torch.manual_seed(5)
    whole = train(network, batches, tmp_path / "whole", settings)
    torch.manual_seed(6)
    drawn = torch.rand(1)
    torch.manual_seed(6)
    for stop in (1, 4, None):
        parts = train(network, batches, tmp_path / "parts", replace(settings, stop_at=stop))
    assert torch.equal(drawn, torch.rand(1))  # the caller's random numbers are left alone
    assert torch.equal(weights(whole), weights(parts))
    rows = [
        [json.loads(s) for s in (tmp_path / n / "log.jsonl").read_text().splitlines()]
        for n in ("whole", "parts")
    ]
    assert rows[0] == rows[1]
    assert [row["step"] for row in rows[0]] == [1, 2, 3, 4, 5, 6]
    loaded, window = load_network(tmp_path / "parts" / "checkpoint.pt")
    assert window == settings.window
    assert torch.equal(weights(loaded), weights(whole))
    found = read_checkpoint(tmp_path / "parts" / "checkpoint.pt")
    last = torch.cat([found["weights"][name].flatten() for name, _ in whole.named_parameters()])
    assert not torch.equal(last, weights(whole))  # averaged ones are others
    other = train(network, batches, tmp_path / "other", replace(settings, seed=1))
    assert not torch.equal(weights(other), weights(whole))
    with pytest.raises(InputError, match="holds another training"):
        train(network, batches, tmp_path / "parts", replace(settings, steps=9))


@pytest.mark.parametrize("kind", [FireNet, E2VidNet])
def test_a_scene_of_two_batches_is_the_scene_as_one(kind):
    torch.manual_seed(0)  # with some weights what is remembered hardly counts
    network, batch = kind(5, 4), made_batch(0)
    memory = CarriedMemory()
    one, other = (memory.sequence(network, replace(batch, reset=made_batch(n).reset)) for n in (0, 1))
    whole, _ = network.sequence(batch.inputs.repeat(2, 1, 1, 1, 1))
    torch.testing.assert_close(torch.cat([one, other]), whole)
    assert not torch.allclose(other, one)
    # a scene that begins knows nothing, and the other slot goes on
    reset = made_batch(1).reset
    reset[0, 1] = True
    third = memory.sequence(network, replace(batch, reset=reset))
    torch.testing.assert_close(third[:, 1], one[:, 1])
    assert not torch.allclose(third[:, 0], one[:, 0])
    assert not any(kept.requires_grad for kept in memory.tensors[tuple(batch.inputs.shape[1:])])


def test_windows_count_from_two_behind_the_begin_of_their_scene():
    batch = replace(made_batch(1), frames=torch.zeros(3, 2, 1, 16, 16))
    batch.reset[1, 0] = True  # slot 0 counts window 0 alone, beside the last; slot 1 goes on
    made = torch.zeros(3, 2, 1, 16, 16)
    made[0, 0], made[1, 0], made[2, 0] = 1.0, 2.0, 4.0
    made[0, 1], made[1, 1], made[2, 1] = 8.0, 16.0, 32.0
    found = reconstruction_losses(made, batch, ReconstructionTraining(skip=2), None)
    assert float(found["l1"]) == pytest.approx((1 + 4 + 8 + 16 + 32) / 5)
    found = reconstruction_losses(made, batch, ReconstructionTraining(skip=0), None)
    assert float(found["l1"]) == pytest.approx((1 + 2 + 4 + 8 + 16 + 32) / 6)


@pytest.mark.parametrize(
    ("train", "network", "settings"),
    [(train_reconstruction, E2VidNet(5, 4), RECONSTRUCTION), (train_flow, EvFlowNet(5, 8), FLOW)],
    ids=["reconstruction", "flow"],
)
def test_the_loss_falls(train, network, settings, tmp_path):
    train(network, batches, tmp_path, replace(settings, steps=60, learning_rate=5e-3, log_every=10))
    losses = [json.loads(line)["loss"] for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert losses[-1] < 0.7 * losses[0]


def test_flow_loss_by_hand():
    batch = made_batch(0)
    batch.flow[0, 0, :, 0, 0] = float("nan")
    made = torch.zeros(6, 2, 16, 16, requires_grad=True)
    loss, error = flow_loss(made, batch, 1 / 30)
    far = 8**0.5  # 2 px in x and y
    assert loss.item() == pytest.approx(4 / (1 + far), rel=1e-5)
    assert error.item() == pytest.approx(far, rel=1e-5)
    loss.backward()
    assert made.grad.isfinite().all()


def a_step(device: str, settings: FlowTraining) -> TrainingStep:
    torch.manual_seed(3)
    network, averaged = (EvFlowNet(5, 4).to(device) for _ in range(2))
    averaged.load_state_dict(network.state_dict())

    def losses(made, batch):
        loss, error = flow_loss(made, batch, settings.window)
        return {"loss": loss, "error": error}

    return TrainingStep(
        network, averaged, settings, device, lambda batch: network(batch.inputs.flatten(0, 1))[0], losses
    )


def test_a_step_by_hand():
    """AdamW's first step goes as far as the rate, whatever the gradient; the mean takes its share."""
    settings = replace(FLOW, steps=10, warm_up=1, weight_decay=0.0, average=0.9, clip=0.1)
    take = a_step("cpu", settings)
    before = weights(take.network).clone()
    assert torch.equal(weights(take.averaged), before)
    values = take(made_batch(0), 0)
    moved = weights(take.network) - before
    gradient = torch.cat([p.grad.flatten() for p in take.network.parameters()])
    assert float(values["gradient"]) > settings.clip  # that of before it was clipped
    assert float(gradient.norm()) == pytest.approx(settings.clip, rel=1e-3)
    clear = gradient.abs() > 1e-5
    torch.testing.assert_close(moved[clear], -settings.rate(0) * gradient[clear].sign(), rtol=2e-3, atol=0)
    torch.testing.assert_close(weights(take.averaged) - before, 0.9 * moved, rtol=1e-3, atol=1e-7)


def test_replayed_steps_are_the_same_steps(device):
    if device == "cpu":
        pytest.skip("steps are replayed on a GPU only; --device cuda:0 asks for one")
    found = []
    for plain_runs in (10**9, 3):
        take = a_step(device, replace(FLOW, steps=40, mixed_precision=False))
        take._replay.plain_runs = plain_runs
        found.append([float(take(made_batch(n), n)["loss"]) for n in range(20)])
        assert bool(take._replay.recorded) == (plain_runs == 3)
    assert found[1] == pytest.approx(found[0], rel=1e-2)
    assert found[1][-1] < found[1][0]


def test_rate_rises_and_falls():
    how = Optimisation(steps=100, warm_up=10, learning_rate=1.0)
    assert how.rate(0) == pytest.approx(0.1)
    assert how.rate(9) == max(how.rate(k) for k in range(100))
    assert how.rate(50) == pytest.approx(0.5)
    assert how.rate(99) < 1e-3


def test_refusals(tmp_path):
    with pytest.raises(InputError, match="evflownet is a network for flow"):
        train_reconstruction(EvFlowNet(5, 2), batches, tmp_path)
    with pytest.raises(InputError, match="average must lie in"):
        Optimisation(average=1.0)
    (tmp_path / "checkpoint.pt").write_text("no")
    with pytest.raises(InputError, match=r"is no checkpoint of dase\.tasks"):
        load_network(tmp_path / "checkpoint.pt")
    with pytest.raises(InputError, match="no such checkpoint"):
        load_network(tmp_path / "other.pt")


def broken(first):
    for batch in batches(first):
        yield replace(batch, inputs=batch.inputs * float("nan"))


@pytest.mark.parametrize(("train", "network", "settings"), TASKS, ids=["reconstruction", "flow"])
def test_a_loss_that_is_no_number_ends_the_training(train, network, settings, tmp_path):
    with pytest.raises(InputError, match="lower learning_rate"):
        train(network, broken, tmp_path, settings)
    assert not (tmp_path / "checkpoint.pt").exists()


@pytest.mark.slow
def test_two_processes_are_one_with_all_slots(tmp_path):
    script = str(Path(__file__).with_name("process_of_training.py"))
    load_script("tests/tasks/process_of_training.py").train(tmp_path / "one")
    run_as_two_processes(script, str(tmp_path / "two"))
    one, two = (weights(load_network(tmp_path / name / "checkpoint.pt")[0]) for name in ("one", "two"))
    assert torch.allclose(one, two, atol=2e-5)
    assert len((tmp_path / "two" / "log.jsonl").read_text().splitlines()) == 1
