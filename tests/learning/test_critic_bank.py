"""The bank of critics against one small network per class, in values, gradients and steps."""

from __future__ import annotations

import importlib
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from dase.kernels import autograd_critics as bridge
from dase.learning.adabelief import AdaBelief
from dase.learning.critic_bank import (
    OPTIMIZERS,
    BankShape,
    CriticBank,
    CriticBatch,
    SortedRows,
    multiply_groups,
)

SHAPE = BankShape(classes=5, inputs=64, wide=16, narrow=8)
FAKE = torch.tensor([0, 0, 1, 1, 1, 3, 3, 0, 4])  # class 2 has no fake patches, 4 no real ones
REAL = torch.tensor([0, 1, 1, 2, 2, 3, 3, 3, 3, 3, 0])
BOTH = [0, 1, 3]


@pytest.fixture
def bank() -> CriticBank:
    return CriticBank(SHAPE, generator=torch.Generator().manual_seed(1))


@pytest.fixture
def batch() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(2)
    return {
        "fake": torch.rand(len(FAKE), 64, generator=generator),
        "real": torch.rand(len(REAL), 64, generator=generator),
        "weights": torch.rand(5, generator=generator),
        "share": torch.rand(len(FAKE), 1, generator=generator),
    }


def networks(bank: CriticBank) -> list[nn.Sequential]:
    """Return the critics as networks of PyTorch's own."""
    out = []
    for critic in range(SHAPE.classes):
        sizes = (SHAPE.inputs, SHAPE.wide, SHAPE.narrow, 1)
        layers = [nn.Linear(a, b) for a, b in pairwise(sizes)]
        for n, layer in enumerate(layers, start=1):
            layer.weight.data = getattr(bank, f"w{n}")[critic].clone().view_as(layer.weight)
            layer.bias.data = getattr(bank, f"b{n}")[critic].clone()
        out.append(nn.Sequential(layers[0], nn.LeakyReLU(0.2), layers[1], nn.LeakyReLU(0.2), layers[2]))
    return out


def loss_of(
    critics: list[nn.Sequential], batch: dict[str, torch.Tensor], penalty: float, steepness: float = 0.0
) -> torch.Tensor:
    """Return the loss, the penalty by double backward."""
    total = torch.zeros(())
    for critic in BOTH:
        fake, real = batch["fake"][critic == FAKE], batch["real"][critic == REAL]
        share = batch["share"][critic == FAKE]
        pairs = min(len(fake), len(real))
        between = real[:pairs] + share[:pairs] * (fake[:pairs] - real[:pairs])
        between.requires_grad_()
        (slope,) = torch.autograd.grad(critics[critic](between).sum(), between, create_graph=True)
        distance = critics[critic](fake).mean() - critics[critic](real).mean()
        total = total + batch["weights"][critic] * (
            distance + penalty * (slope.square().sum(1).sqrt() - steepness).square().mean()
        )
    return total


@pytest.mark.parametrize("steepness", [0.0, 1.0])
def test_gradients_are_those_of_double_backward(bank, batch, steepness):
    critics = networks(bank)
    loss_of(critics, batch, 1.5, steepness).backward()
    work = CriticBatch(bank, batch["fake"], FAKE, batch["real"], REAL, batch["weights"], batch["share"])
    found = work.differentiate(1.5, steepness)
    gradients = dict(work.sums)
    for name, (left, right) in work.outer.items():
        gradients[name], begin = torch.zeros_like(getattr(bank, name)), 0
        for critic, end in enumerate(work.layout.end[0].tolist()):
            gradients[name][critic] = left[begin:end].T @ right[begin:end]
            begin = end
    number, ends = work.layout.number.tolist(), work.layout.end.tolist()
    assert number == [np.bincount(classes, minlength=5).tolist() for classes in (FAKE, REAL)]
    pairs = [min(both) for both in zip(*number, strict=True)]
    rows = [p and p + sum(both) for p, both in zip(pairs, zip(*number, strict=True), strict=True)]
    assert ends == [np.cumsum(rows).tolist(), np.cumsum(pairs).tolist()]
    for critic in BOTH:
        for n in (1, 2, 3):
            layer = critics[critic][2 * (n - 1)]
            close(gradients[f"w{n}"][critic].view_as(layer.weight), layer.weight.grad)
            close(gradients[f"b{n}"][critic], layer.bias.grad)
    plain = -sum(
        batch["weights"][c]
        * (critics[c](batch["fake"][c == FAKE]).mean() - critics[c](batch["real"][c == REAL]).mean())
        for c in BOTH
    )
    close(found.distance, plain)
    close(found.penalty * 1.5 - found.distance, loss_of(critics, batch, 1.5, steepness))


def close(got: torch.Tensor, want: torch.Tensor) -> None:
    torch.testing.assert_close(got, want, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("kind", ["Loop", "Padded"])
def test_naive_banks_differentiate_the_same_loss(bank, batch, kind, monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[2])
    naive_bank = importlib.import_module("perf.benchmarks.naive_critic_bank")
    naive = getattr(naive_bank, kind)(bank)
    patches = naive_bank.Patches(batch["fake"], FAKE, batch["real"], REAL, batch["weights"])
    found = naive_bank.differences(bank, naive, patches)
    assert max(found["bank"].values()) < 1e-5
    assert not naive_bank.faults({"differences": {kind: found}})
    bank.w2 *= 1.05
    found = naive_bank.differences(bank, naive, patches)
    assert naive_bank.faults({"differences": {kind: found}})


def test_a_step_is_adams_and_leaves_other_critics_alone(bank, batch):
    before = {name: getattr(bank, name).clone() for name in bank.parameter_names()}
    critics = networks(bank)
    optimizers = [torch.optim.Adam(c.parameters(), lr=1e-3, betas=(0.0, 0.9)) for c in critics]
    generator = torch.Generator().manual_seed(7)
    for _ in range(3):
        batch["share"] = torch.rand(len(FAKE), 1, generator=generator)
        for optimizer in optimizers:
            optimizer.zero_grad()
        loss_of(critics, batch, 1.0).backward()
        for critic in BOTH:
            optimizers[critic].step()
    generator = torch.Generator().manual_seed(7)
    for _ in range(3):
        bank.step(batch["fake"], FAKE, batch["real"], REAL, batch["weights"], rate=1e-3, generator=generator)
    assert bank.steps.tolist() == [3, 3, 0, 3, 0]
    for n in (1, 2, 3):
        for critic in range(5):
            layer = critics[critic][2 * (n - 1)]
            got = getattr(bank, f"w{n}")[critic].view_as(layer.weight)
            # where a gradient is rounding, Adam's step has any sign
            assert float((got - layer.weight).abs().gt(1e-5).float().mean()) < 0.02
            if critic not in BOTH:
                assert torch.equal(getattr(bank, f"w{n}")[critic], before[f"w{n}"][critic])
                assert torch.equal(getattr(bank, f"b{n}")[critic], before[f"b{n}"][critic])
    assert torch.equal(bank.copies["w1"][BOTH], bank.w1[BOTH].bfloat16())


def test_input_gradient_and_scores(bank, batch):
    critics, gain = networks(bank), torch.rand(5)
    patches = batch["fake"].clone().requires_grad_()
    scores = torch.stack([critics[c](p)[0] for c, p in zip(FAKE.tolist(), patches, strict=True)])
    (want,) = torch.autograd.grad((scores * gain[FAKE]).sum(), patches)
    close(bank.input_gradient(batch["fake"], FAKE, gain), want)
    close(bank.scores(batch["fake"], FAKE), scores.detach())
    # patches of no class have no gradient
    none = torch.where(FAKE == 1, 5, FAKE)
    got = bank.input_gradient(batch["fake"], none, gain)
    assert torch.equal(got[FAKE == 1], torch.zeros(3, 64))
    close(got[FAKE != 1], want[FAKE != 1])


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_moving_by_outer_products(device, dtype):
    place = torch.device("cuda" if device.startswith("cuda") else "cpu")
    generator = torch.Generator().manual_seed(3)
    weight, square = (torch.rand(4, 8, 32, generator=generator).to(place) - 0.4 for _ in range(2))
    square = square.abs()
    left = torch.randn(7, 8, generator=generator).to(place)
    right = torch.randn(7, 32, generator=generator).to(place, dtype)
    end = torch.tensor([2, 2, 6, 7], dtype=torch.int32, device=place)
    rate = torch.tensor([0.1, 0.1, 0.0, 0.2], device=place)
    correction = torch.tensor([1.0, 2.0, 1.0, 1.5], device=place)
    copy = weight.bfloat16()
    gradient, begin = torch.zeros_like(weight), 0
    for critic, stop in enumerate(end.tolist()):
        gradient[critic] = left[begin:stop].T @ right[begin:stop].float()
        begin = stop
    moving = (rate > 0).view(-1, 1, 1)
    want_square = torch.where(moving, 0.9 * square + 0.1 * gradient.square(), square)
    root = (want_square * correction.view(-1, 1, 1)).sqrt() + 1e-8
    want = weight - rate.view(-1, 1, 1) * gradient / root
    bridge.move_critics(weight, square, copy, left, right, end, rate, correction, decay=0.9)
    torch.testing.assert_close(weight, want, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(square, want_square, rtol=1e-4, atol=1e-6)
    assert torch.equal(copy[rate > 0], weight[rate > 0].bfloat16())


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_moving_by_adabelief(device, dtype):
    """Over several steps as the optimiser that is written from its paper, critics without rows left alone."""
    place = torch.device("cuda" if device.startswith("cuda") else "cpu")
    generator = torch.Generator().manual_seed(4)
    weight, bias = (torch.randn(*shape, generator=generator).to(place) for shape in ((3, 8, 32), (3, 8)))
    kept = [torch.zeros_like(one) for one in (weight, weight, bias, bias)]
    wants = [[torch.nn.Parameter(one[c].clone()) for one in (weight, bias)] for c in range(3)]
    steps = [AdaBelief(want, lr=0.1, betas=(0.9, 0.999)) for want in wants]
    end = torch.tensor([2, 6, 6], dtype=torch.int32, device=place)
    copy = weight.bfloat16()
    for turn in range(1, 5):
        left = torch.randn(6, 8, generator=generator).to(place)
        right = torch.randn(6, 32, generator=generator).to(place, dtype)
        gradient = torch.randn(3, 8, generator=generator).to(place)
        rate = torch.tensor([0.1, 0.1, 0.0], device=place) / (1 - 0.9**turn)
        correction = torch.full((3,), 1 / (1 - 0.999**turn), device=place)
        how = {"decay": 0.999, "momentum": 0.9, "tiny": 1e-16}
        bridge.move_critics(weight, kept[0], copy, left, right, end, rate, correction, mean=kept[1], **how)
        bridge.move_sums(bias, kept[2], gradient, rate, correction, mean=kept[3], **how)
        for c, (begin, stop) in enumerate(((0, 2), (2, 6))):
            wants[c][0].grad = left[begin:stop].T @ right[begin:stop].float()
            wants[c][1].grad = gradient[c].clone()
            steps[c].step()
    for c, want in enumerate(wants):
        torch.testing.assert_close(weight[c], want[0].detach(), rtol=1e-3, atol=1e-5)
        torch.testing.assert_close(bias[c], want[1].detach(), rtol=1e-3, atol=1e-5)
    assert not kept[1][2].any()
    assert torch.equal(copy[:2], weight[:2].bfloat16())


def test_grouped_products_and_order(rng):
    classes = torch.from_numpy(rng.integers(0, 4, 20))
    by = SortedRows.of_classes(classes, 3)  # class 3 is none
    assert torch.equal(by.end, torch.bincount(classes, minlength=4)[:3].cumsum(0).int())
    rows, weights = torch.randn(20, 8), torch.randn(3, 8, 4)
    got = multiply_groups(rows[by.order], weights, by.end)
    for n, (row, critic) in enumerate(zip(by.order.tolist(), by.of.tolist(), strict=True)):
        if critic < 3:
            close(got[n], rows[row] @ weights[critic])


@pytest.mark.parametrize("rows", [(3, 0, 1, 9, 4, 0), (0, 0, 5, 0), (1,), (17,)])
def test_few_rows_are_spread_over_columns(rng, device, rows):
    end = torch.tensor(np.cumsum(rows), dtype=torch.int32)
    many = int(end[-1]) + 5  # some of no critic
    left = torch.from_numpy(rng.normal(size=(many, 24))).bfloat16()
    weights = torch.from_numpy(rng.normal(size=(len(rows), 24, 40))).bfloat16()
    name = "cuda" if "cuda" in device else "cpu"
    got = bridge.multiply_by_critic(left.to(name), weights.to(name), end.to(name)).cpu().float()
    begin = 0
    for critic, stop in enumerate(end.tolist()):
        want = left[begin:stop].float() @ weights[critic].float()
        torch.testing.assert_close(got[begin:stop], want, rtol=0.01, atol=1e-4)
        begin = stop


def test_traffic_counts_what_has_to_move():
    bank = CriticBank(BankShape(classes=2, inputs=16, wide=8, narrow=8))
    assert bank.least_traffic(1) == 8 * (16 + 8) * (3 * 2 + 4 * 4 + 2)
    assert bank.least_traffic(2) == 2 * bank.least_traffic(1)
    believing = CriticBank(
        BankShape(classes=2, inputs=16, wide=8, narrow=8), optimizer=OPTIMIZERS["adabelief"]
    )
    assert believing.least_traffic(1) == 8 * (16 + 8) * (3 * 2 + 6 * 4 + 2)
    assert BankShape(classes=216).weights() == pytest.approx(361e6, rel=0.01)  # the paper's bank
    assert np.isclose(BankShape(classes=1).weights(), 6400 * 256 + 256 + 256 * 128 + 128 + 128 + 1)
