"""A bank of critics as one would write it first: PyTorch, float32, the penalty by double backward.

`Loop` has a network for every class and goes through them; `Padded` holds each layer of all critics in one
tensor and fills the classes up with empty rows to the same number. `perf/benchmarks/training.py` times both
beside `CriticBank` on the same patches, from the same weights, and `differences` says whether all three
differentiate the same loss.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import torch
from torch import nn
from torch.nn.functional import leaky_relu

from dase.learning.critic_bank import CriticBank, CriticBatch
from dase.networks.threshold_network import LEAKY_SLOPE

if TYPE_CHECKING:
    from perf.benchmarks.training import Clock

WEIGHTS = ("w1", "b1", "w2", "b2", "w3")
"""Gradients that are compared; that of the last bias is 0 but for rounding, as all gains add up to 0."""

CHANCE = 0.01
"""Relative difference that is no fault: a sum in another order may fall on the other side of a kink."""
ROUNDING = 3
"""How much further from float32 the bank may be than mixed precision of PyTorch, which rounds less often."""


@dataclass(frozen=True)
class Patches:
    """What a step is given.

    Args:
        fake: Patches of the simulator, (N, inputs).
        fake_classes: Theirs, int64 (N,).
        real: Patches of the target, (M, inputs).
        real_classes: Theirs, int64 (M,).
        weights: Of each class, (C,).
    """

    fake: torch.Tensor
    fake_classes: torch.Tensor
    real: torch.Tensor
    real_classes: torch.Tensor
    weights: torch.Tensor


class Loss(NamedTuple):
    """Both parts of the loss, as in `dase.learning.critic_bank.CriticStep`."""

    distance: torch.Tensor
    penalty: torch.Tensor


class Naive(Protocol):
    """A bank of critics that PyTorch differentiates."""

    optimizer: torch.optim.Optimizer

    def loss(self, patches: Patches, share: torch.Tensor) -> Loss:
        """Return the loss for shares (N, 1) of the fake patches in those half way."""

    def gradient(self, name: str, critic: int) -> torch.Tensor:
        """Return the gradient of a critic's weights, as `CriticBank` names and shapes them."""


class Loop:
    """A network for each class, one after the other.

    Args:
        bank: Weights to begin with.
    """

    def __init__(self, bank: CriticBank):
        shape = bank.shape
        sizes = (shape.inputs, shape.wide, shape.narrow, 1)
        self.critics = []
        for critic in range(shape.classes):
            first, second, third = (nn.Linear(a, b, device=bank.device) for a, b in pairwise(sizes))
            for n, layer in enumerate((first, second, third), start=1):
                layer.weight.data.copy_(getattr(bank, f"w{n}")[critic].view_as(layer.weight))
                layer.bias.data.copy_(getattr(bank, f"b{n}")[critic])
            self.critics.append(
                nn.Sequential(first, nn.LeakyReLU(LEAKY_SLOPE), second, nn.LeakyReLU(LEAKY_SLOPE), third)
            )
        self.optimizer = _adam([p for critic in self.critics for p in critic.parameters()], bank)

    def loss(self, patches: Patches, share: torch.Tensor) -> Loss:
        ours, theirs = (_rows_of(c, len(self.critics)) for c in (patches.fake_classes, patches.real_classes))
        distance, penalty = (patches.weights.new_zeros(()) for _ in range(2))
        for critic, mine, other, weight in zip(self.critics, ours, theirs, patches.weights, strict=True):
            pairs = min(len(mine), len(other))
            if not pairs:
                continue
            fake, real = patches.fake.index_select(0, mine), patches.real.index_select(0, other)
            between = torch.lerp(real[:pairs], fake[:pairs], share[mine[:pairs]]).requires_grad_()
            (slope,) = torch.autograd.grad(critic(between).sum(), between, create_graph=True)
            distance = distance + weight * (critic(real).mean() - critic(fake).mean())
            penalty = penalty + weight * slope.square().sum(1).mean()
        return Loss(distance, penalty)

    def gradient(self, name: str, critic: int) -> torch.Tensor:
        layer = self.critics[critic][2 * (int(name[1]) - 1)]
        return (layer.weight if name[0] == "w" else layer.bias).grad


class Padded:
    """Layers of all critics in one tensor each, on as many rows for each as the largest class has.

    Args:
        bank: Weights to begin with.
    """

    def __init__(self, bank: CriticBank):
        self.weights = {name: getattr(bank, name).clone().requires_grad_() for name in bank.parameter_names()}
        self.optimizer = _adam(list(self.weights.values()), bank)

    def scores(self, rows: torch.Tensor) -> torch.Tensor:
        """Return the scores (C, P) of rows (C, P, inputs)."""
        w = self.weights
        first = torch.baddbmm(w["b1"][:, None], rows, w["w1"].transpose(1, 2))
        second = torch.baddbmm(w["b2"][:, None], leaky_relu(first, LEAKY_SLOPE), w["w2"].transpose(1, 2))
        return torch.baddbmm(w["b3"][:, None], leaky_relu(second, LEAKY_SLOPE), w["w3"][:, :, None])[..., 0]

    def loss(self, patches: Patches, share: torch.Tensor) -> Loss:
        classes = len(patches.weights)
        (mine, fakes), (other, reals) = (
            _padded(c, classes) for c in (patches.fake_classes, patches.real_classes)
        )
        pairs = min(mine.shape[1], other.shape[1])
        both, trusted = fakes & reals.any(1, keepdim=True), reals & fakes.any(1, keepdim=True)
        held = fakes[:, :pairs] & reals[:, :pairs]
        fake, real = patches.fake[mine], patches.real[other]
        between = torch.lerp(real[:, :pairs], fake[:, :pairs], share[mine[:, :pairs]]).requires_grad_()
        (slope,) = torch.autograd.grad(self.scores(between).sum(), between, create_graph=True)
        means = [_means(self.scores(rows), mask) for rows, mask in ((real, trusted), (fake, both))]
        square = _means(slope.square().sum(2), held)
        return Loss((patches.weights * (means[0] - means[1])).sum(), (patches.weights * square).sum())

    def gradient(self, name: str, critic: int) -> torch.Tensor:
        return self.weights[name].grad[critic]


def _adam(parameters: list[torch.Tensor], bank: CriticBank) -> torch.optim.Optimizer:
    """Return the optimiser of the bank, as PyTorch has it."""
    return torch.optim.Adam(parameters, lr=1e-9, betas=(0.0, bank.optimizer.decay))


def _rows_of(classes: torch.Tensor, number: int) -> list[torch.Tensor]:
    """Return the indices of the rows of each class; waits for the GPU once."""
    counts = torch.bincount(classes, minlength=number).tolist()
    return list(torch.argsort(classes, stable=True).split(counts))


def _padded(classes: torch.Tensor, number: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the indices (C, P) of the rows of each class, the first ones, and which are not padding."""
    counts = torch.bincount(classes, minlength=number)
    place = torch.arange(int(counts.max()), device=classes.device)
    begin = counts.cumsum(0) - counts
    mask = place < counts[:, None]
    index = torch.where(mask, begin[:, None] + place, 0)
    return torch.argsort(classes, stable=True)[index], mask


def _means(values: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Return the mean of values (C, P) of each class over those that count, 0 where none does."""
    return torch.where(mask, values, 0.0).sum(1) / mask.sum(1).clamp_min(1)


def step(bank: Naive, patches: Patches, generator: torch.Generator | None = None) -> None:
    """Move the critics once."""
    fake = patches.fake
    share = torch.rand(len(fake), 1, device=fake.device, generator=generator)
    bank.optimizer.zero_grad()
    loss = bank.loss(patches, share)
    (loss.penalty - loss.distance).backward()
    bank.optimizer.step()


class Derived(NamedTuple):
    """What a bank makes of a batch.

    Args:
        values: Both parts of the loss.
        gradients: By the weights of each critic in use.
    """

    values: dict[str, torch.Tensor]
    gradients: dict[str, list[torch.Tensor]]

    def apart(self, other: Derived, scale: float) -> dict[str, float]:
        """Return how far both are apart, relative to this one; gradients by their length over all critics.

        The distance is what is left of scores that all but cancel, and is compared with `scale`.
        """
        sizes = {"distance": scale, "penalty": float(self.values["penalty"])}
        out = {n: abs(float(other.values[n] - value)) / sizes[n] for n, value in self.values.items()}
        for name, mine in self.gradients.items():
            squares = [
                ((b.view_as(a) - a).square().sum(), a.square().sum())
                for a, b in zip(mine, other.gradients[name], strict=True)
            ]
            off, whole = (float(sum(each)) for each in zip(*squares, strict=True))
            out[name] = (off / whole) ** 0.5
        return out


def _of_naive(bank: Naive, patches: Patches, share: torch.Tensor, used: list[int], half: bool) -> Derived:
    bank.optimizer.zero_grad()
    with torch.autocast(share.device.type, torch.bfloat16, enabled=half):
        found = bank.loss(patches, share)
    (found.penalty - found.distance).backward()
    gradients = {name: [bank.gradient(name, critic).clone() for critic in used] for name in WEIGHTS}
    bank.optimizer.zero_grad()
    return Derived({name: value.detach() for name, value in found._asdict().items()}, gradients)


@torch.no_grad()
def _of_bank(bank: CriticBank, patches: Patches, share: torch.Tensor) -> tuple[Derived, list[int]]:
    given = (patches.fake, patches.fake_classes, patches.real, patches.real_classes, patches.weights)
    batch = CriticBatch(bank, *given, share)
    found = batch.differentiate(1.0)
    rows = [(c, *ends) for c, ends in enumerate(pairwise([0, *batch.layout.end[0].tolist()]))]
    rows = [(c, begin, end) for c, begin, end in rows if end > begin]
    gradients = {}
    for name in WEIGHTS:
        if name in batch.outer:
            left, right = (side.float() for side in batch.outer[name])
            gradients[name] = [left[begin:end].T @ right[begin:end] for _, begin, end in rows]
        else:
            gradients[name] = [batch.sums[name][c] for c, _, _ in rows]
    return Derived({"distance": found.distance, "penalty": found.penalty}, gradients), [c for c, *_ in rows]


def differences(bank: CriticBank, naive: Naive, patches: Patches) -> dict[str, dict[str, float]]:
    """Return how far the fast bank is from a naive one on the same patches, and what rounding alone makes.

    Where the bank multiplies in bfloat16, that is how far the naive one is from itself in mixed precision:
    some per cent of a gradient, since fake and real patches pull a weight in opposite ways and nearly cancel,
    but for the few whose sums lie beside a kink, and those are easily rounded to its other side.
    """
    share = torch.rand(len(patches.fake), 1, device=bank.device)
    got, used = _of_bank(bank, patches, share)
    want = _of_naive(naive, patches, share, used, half=False)
    scale = float(bank.scores(patches.fake, patches.fake_classes).abs().mean() * patches.weights.sum())
    out = {"bank": want.apart(got, scale)}
    if bank.working == torch.bfloat16:
        out["rounding"] = want.apart(_of_naive(naive, patches, share, used, half=True), scale)
    return out


def faults(found: dict[str, Any]) -> list[str]:
    """Return in which respects the fast bank is further from naive ones than rounding can make it."""
    return [
        f"the bank and '{name}' are apart by {value:.2g} in {what}"
        for name, apart in found["differences"].items()
        for what, value in apart["bank"].items()
        if not value <= max(ROUNDING * apart.get("rounding", {}).get(what, 0.0), CHANCE)
    ]


def compare(
    bank: CriticBank, patches: Patches, fast: Callable[[], Any], plain: Callable[[], Any], clock: Clock
) -> dict[str, Any]:
    """Return the times of naive banks and of the fast one, taken in turns, and how far results are apart.

    Args:
        bank: The fast one; its weights are where the naive ones begin.
        patches: Of every step.
        fast: One step of the fast bank, as it runs in training.
        plain: The same, on a GPU launched from Python kernel by kernel.
        clock: Takes the times.
    """
    makers: dict[str, Callable[[CriticBank], Naive]] = {"loop": Loop, "padded": Padded}
    banks = {name: make(bank) for name, make in makers.items()}
    apart = {name: differences(bank, naive, patches) for name, naive in banks.items()}
    works = {name: (lambda naive=naive: step(naive, patches)) for name, naive in banks.items()}
    if clock.device.type == "cuda":
        works["unrecorded"] = plain
    seconds = clock.in_turns({"fast": fast, **works})
    return {"seconds": seconds, "differences": apart}


def told(found: dict[str, Any], bound: float) -> str:
    """Return lines that say what `compare` found, beside the bound by traffic [s]."""
    names = {
        "fast": "the bank, in turns with the naive ones",
        "unrecorded": "the same, launched kernel by kernel",
        "loop": "naive: a network per class, in a loop",
        "padded": "naive: one product, classes padded",
    }
    lines = []
    for name, seconds in found["seconds"].items():
        lines.append(
            f"  {names[name]:40s} {1e3 * seconds:8.2f} ms {1 / seconds:7.1f} steps/s "
            f"{seconds / found['seconds']['fast']:6.1f} x the bank {seconds / bound:6.1f} x the bound"
        )
        for other, apart in found["differences"].get(name, {}).items():
            shown = ", ".join(f"{key} {value:.1e}" for key, value in apart.items())
            lines.append(f"    apart from it, {other}: {shown}")
    return "\n".join(lines)
