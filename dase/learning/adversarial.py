"""How unlike simulated and real counts are, and which way the thresholds should move.

Two objectives share the images: `AdversarialObjective`, the paper's bank of critics over hashed patches (Eqs. 10 to
13), and `Moments`, which compares means of fixed features between pixels whose surroundings look alike.
"""

from __future__ import annotations

import math
from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import torch

from dase.kernels import autograd_training as bridge
from dase.learning import distributed
from dase.learning.critic_bank import BankShape, CriticBank
from dase.learning.targets import Pairs
from dase.networks.threshold_network import gradient_magnitude


def critic_maps(counts: torch.Tensor) -> torch.Tensor:
    """Return what critics see, log(1 + x)/2 of counts and of their gradient magnitudes, (B, 4, H, W)."""
    return 0.5 * torch.log1p(torch.cat([counts, gradient_magnitude(counts)], 1))


def cut_patches(maps: torch.Tensor, size: int) -> torch.Tensor:
    """Cut maps (B, C, H, W) into patches side by side, shape (patches, C · size²); the rest is left out."""
    batch, channels, height, width = maps.shape
    rows, columns = height // size, width // size
    cut = maps[..., : rows * size, : columns * size].reshape(batch, channels, rows, size, columns, size)
    return cut.permute(0, 2, 4, 1, 3, 5).reshape(batch * rows * columns, channels * size * size)


@dataclass(frozen=True, kw_only=True)
class PatchHash:
    """Which attributes patches are told apart by, and into how many levels.

    Args:
        size: Side of a patch [px].
        orientations: Bins of angle.
        coherence: Levels of coherence.
        contrast: Levels of contrast.
        contrast_from: `energy` of the image gradient; `events`, Eq. 12 of the paper, see
            `dase.learning.patch_hash.StructureHash` for why not; `events-ranked`, the same with boundaries of
            its own for each domain and batch.
        intensity: Levels of mean intensity.
    """

    size: int = 40
    orientations: int = 24
    coherence: int = 3
    contrast: int = 3
    contrast_from: Literal["energy", "events", "events-ranked"] = "energy"
    intensity: int = 1

    @property
    def classes(self) -> int:
        """Number of classes."""
        return self.orientations * self.coherence * self.contrast * self.intensity


class PatchHasher:
    """Sends patches to classes; boundaries of levels are quantiles of what `calibrate` was shown."""

    def __init__(self, how: PatchHash):
        self.how = how
        self.boundaries: dict[str, torch.Tensor] = {}

    def calibrate(self, *sets: Pairs) -> None:
        """Place boundaries so that levels hold equal shares of the patches of all sets."""
        found = [self._attributes(pairs) for pairs in sets]
        for name, levels in self._levels():
            pooled = torch.cat([attributes[name] for attributes in found])
            self.boundaries[name] = _quantile_boundaries(pooled, levels)

    def classes(self, pairs: Pairs) -> torch.Tensor:
        """Return the class of every patch, int64 (patches,), in the order of `cut_patches`."""
        found = self._attributes(pairs)
        bins = torch.floor(found["angle"] * (self.how.orientations / math.pi) + 0.5).long()
        index = bins % self.how.orientations
        for name, levels in self._levels():
            boundaries = self.boundaries[name]
            if name == "contrast" and self.how.contrast_from == "events-ranked":
                boundaries = _quantile_boundaries(found[name], levels)
            index = index * levels + torch.bucketize(found[name], boundaries)
        return index

    def _levels(self) -> tuple[tuple[str, int], ...]:
        how = self.how
        every = ("coherence", how.coherence), ("contrast", how.contrast), ("intensity", how.intensity)
        return tuple((name, levels) for name, levels in every if levels > 1)

    def _attributes(self, pairs: Pairs) -> dict[str, torch.Tensor]:
        size = self.how.size
        found = bridge.patch_structure(pairs.grey, size=size, stride=size)
        found = {name: value.flatten() for name, value in found.items()}
        found["contrast"] = found["energy"]
        if self.how.contrast_from != "energy":
            found["contrast"] = bridge.patch_contrast(pairs.counts, size=size, stride=size).flatten()
        if self.how.intensity > 1:
            found["intensity"] = cut_patches(pairs.grey[:, None], size).mean(1)
        return found


def _quantile_boundaries(values: torch.Tensor, levels: int) -> torch.Tensor:
    """Return the boundaries between `levels` equal shares."""
    ordered = torch.sort(values.flatten()).values
    return torch.stack([ordered[round(n / levels * (len(ordered) - 1))] for n in range(1, levels)])


class Objective(Protocol):
    """What the loop asks of an objective."""

    def calibrate(self, sets: list[tuple[Pairs, Pairs]]) -> None:
        """Look at pairs of a fake and a real batch before training."""

    def begin(self) -> Hashable:
        """Count a step that is about to come; return its kind, see `dase.learning.cuda_graph`."""

    def loss(self, fake: Pairs, real: Pairs, *, move: bool) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Learn from both batches; return a loss whose gradient by the fake counts leads towards the real.

        Without `move` the objective alone learns and the loss has no gradient.
        """

    def state(self) -> dict[str, Any]:
        """Return all that the next step depends on."""

    def load(self, state: dict[str, Any]) -> None:
        """Take over what `state` returned."""


class AdversarialObjective:
    """The bank of critics (Eqs. 10, 11 and 13).

    Args:
        how: The hash of patches.
        device: PyTorch device.
        seed: Of weights and shares.
        rate: Learning rate of the critics; a tensor may be changed between steps that are replayed.
        steps: Steps of the critics for each call.
        penalty: Weight of the gradient penalty.
        uniform: α of Eq. 13: share of the weights that all classes have alike.
        image: Whether critics see the image too.
    """

    def __init__(
        self,
        how: PatchHash,
        *,
        device: str | torch.device,
        seed: int = 0,
        rate: float | torch.Tensor = 2e-4,
        steps: int = 1,
        penalty: float = 1.0,
        uniform: float = 0.5,
        image: bool = False,
    ):
        self.hasher, self.device = PatchHasher(how), torch.device(device)
        self.rate, self.steps, self.penalty, self.uniform, self.image = rate, steps, penalty, uniform, image
        self.generator = torch.Generator(self.device).manual_seed(seed)
        self.seen = torch.zeros(how.classes, device=self.device)
        shape = BankShape(classes=how.classes, inputs=(4 + image) * how.size**2)
        self.bank = CriticBank(shape, device=self.device, generator=self.generator)

    def calibrate(self, sets: list[tuple[Pairs, Pairs]]) -> None:
        """Place the boundaries of the hash."""
        self.hasher.calibrate(*(pairs for both in sets for pairs in both))
        distributed.broadcast_tensors(self.hasher.boundaries.values())

    def begin(self) -> Hashable:
        """All steps are of one kind, where products of groups are one launch."""
        return "all" if self.bank.one_launch() else None

    def weights(self) -> torch.Tensor:
        """Return ω of Eq. 13, from the real patches seen so far."""
        share = self.seen / self.seen.sum().clamp_min(1)
        return self.uniform / len(share) + (1 - self.uniform) * share

    def _patches(self, pairs: Pairs) -> torch.Tensor:
        maps = critic_maps(pairs.counts)
        if self.image:
            maps = torch.cat([maps, pairs.grey[:, None]], 1)
        return cut_patches(maps, self.hasher.how.size)

    def loss(self, fake: Pairs, real: Pairs, *, move: bool) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Move the critics, then return minus the weighted mean score of the fake patches."""
        patches, others = (distributed.gather_values(self._patches(pairs)) for pairs in (fake, real))
        ours, theirs = (distributed.gather_values(self.hasher.classes(pairs)) for pairs in (fake, real))
        number, real_number = (self._number(classes) for classes in (ours, theirs))
        ours, theirs = (
            distributed.mask_foreign_classes(classes, len(self.seen)) for classes in (ours, theirs)
        )
        self.seen += real_number
        weights = self.weights()
        for _ in range(self.steps):
            found = self.bank.step(
                patches.detach(), ours, others, theirs, weights,
                rate=self.rate, penalty=self.penalty, generator=self.generator,
            )  # fmt: skip
        both = (number > 0) & (real_number > 0)
        distance, lies = (
            distributed.sum_over_processes(found.distance),
            distributed.sum_over_processes(found.penalty),
        )
        values = {"distance": distance, "penalty": lies, "classes": both.sum()}
        if not move:
            return fake.counts.new_zeros(()), values
        gain = torch.where(both, -weights / number.clamp_min(1), 0.0)
        slopes = distributed.sum_over_processes(self.bank.input_gradient(patches.detach(), ours, gain))
        return (patches * slopes).sum(), values

    def _number(self, classes: torch.Tensor) -> torch.Tensor:
        """Return how many patches each class has."""
        return torch.zeros_like(self.seen).index_add_(
            0, classes, torch.ones_like(classes, dtype=torch.float32)
        )

    def state(self) -> dict[str, Any]:
        """Return the bank, the hash and the random numbers."""
        return {
            "bank": self._bank(),
            "boundaries": self.hasher.boundaries,
            "seen": self.seen,
            "generator": self.generator.get_state(),
        }

    def _bank(self) -> dict[str, Any]:
        """Return the state of all critics, each from the process that looks after it."""
        state = self.bank.state()
        out: dict[str, Any] = {"steps": distributed.gather_from_owners(state["steps"])}
        for kind in ("weights", "square"):
            out[kind] = {name: distributed.gather_from_owners(value) for name, value in state[kind].items()}
        return out

    def load(self, state: dict[str, Any]) -> None:
        """Take over what `state` returned."""
        self.bank.load(state["bank"])
        self.hasher.boundaries = {name: value.to(self.device) for name, value in state["boundaries"].items()}
        self.seen.copy_(state["seen"])
        self.generator.set_state(state["generator"].cpu())
