"""The paper's objective: a bank of critics over hashed patches (Eqs. 10 to 13).

The other objective, which needs no adversary, is `dase.learning.moment_matching`.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable
from dataclasses import dataclass
from typing import Any, Literal

import torch

from dase.kernels import autograd_training as bridge
from dase.learning import distributed
from dase.learning.critic_bank import OPTIMIZERS, BankShape, CriticBank
from dase.learning.targets import Pairs, PixelNoise
from dase.networks.threshold_network import gradient_magnitude


def critic_maps(counts: torch.Tensor, *, plain: bool = False) -> torch.Tensor:
    """Return what critics see, (B, 4, H, W): log(1 + x)/2 of counts and of their gradient magnitudes.

    Args:
        counts: Shape (B, 2, H, W).
        plain: Whether the numbers are left as they are, as in the paper.
    """
    maps = torch.cat([counts, gradient_magnitude(counts)], 1)
    return maps if plain else 0.5 * torch.log1p(maps)


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
        orientations: Bins of angle, centred so that edges along the pixel grid fall into one of them.
        coherence: Levels of coherence.
        contrast: Levels of contrast.
        contrast_from: `energy` of the image gradient; `events`, Eq. 12 of the paper; `events-ranked`, the
            same with boundaries of its own for each domain and batch. Counts of events depend on the
            thresholds that are being learned: a change of thresholds moves patches from class to class,
            comparing inside of classes misleads, and training can settle on wrong thresholds.
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
    """Sends patches to classes; boundaries of levels are quantiles of what `calibrate` was shown.

    Args:
        how: The attributes and their levels.

    Attributes:
        boundaries: Between the levels of an attribute by its name, float32 (levels - 1,).
    """

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
        # without events the hash cannot depend on the thresholds that are being learned
        found["contrast"] = found["energy"]
        if self.how.contrast_from != "energy":
            found["contrast"] = bridge.patch_contrast(pairs.counts, size=size, stride=size).flatten()
        if self.how.intensity > 1:
            found["intensity"] = cut_patches(pairs.grey[:, None], size).mean(1)
        return found


def _quantile_boundaries(values: torch.Tensor, levels: int) -> torch.Tensor:
    """Return the boundaries between `levels` equal shares of values of any shape, (levels - 1,)."""
    ordered = torch.sort(values.flatten()).values
    return torch.stack([ordered[round(n / levels * (len(ordered) - 1))] for n in range(1, levels)])


@dataclass(frozen=True, kw_only=True)
class AdversarialSettings:
    """What can be chosen about the critics; the names are those of a run's `recipe.json`.

    Args:
        critic_rate: Learning rate of the critics.
        critic_optimizer: `adam`, without momentum, or `adabelief` (0.9, 0.999).
        critic_cosine: Whether it falls as the generator's does, so that critics settle with it.
        critic_steps: Steps of the critics in a step; more keep up with the generator better.
        penalty: Weight of the gradient penalty.
        steepness: Length of the gradient that it asks for: 0, or 1 as WGAN-GP (Gulrajani et al., 2017).
        uniform: α of Eq. 13: share of the weights that all classes have alike; 1 turns re-weighting off.
        critic_image: Whether critics see the image too.
        plain_counts: Whether they see counts, as in the paper, and not logarithms of them.
        hash: Of the patches.
    """

    critic_rate: float = 2e-4
    critic_optimizer: Literal["adam", "adabelief"] = "adam"
    critic_cosine: bool = False
    critic_steps: int = 1
    penalty: float = 1.0
    steepness: float = 0.0
    uniform: float = 0.5
    critic_image: bool = False
    plain_counts: bool = False
    hash: PatchHash = PatchHash()


class AdversarialObjective:
    """The bank of critics (Eqs. 10, 11 and 13).

    Args:
        settings: The hash of patches, and how critics learn.
        device: PyTorch device.
        seed: Of weights and shares.

    Attributes:
        seen: Real patches of each class seen so far, float32 (classes,).
    """

    moves_shared = False

    def __init__(self, settings: AdversarialSettings, *, device: str | torch.device, seed: int = 0):
        self.settings, self.device = settings, torch.device(device)
        how = settings.hash
        self.hasher = PatchHasher(how)
        self.generator = torch.Generator(self.device).manual_seed(seed)
        self.generators = [self.generator]
        self.seen = torch.zeros(how.classes, device=self.device)
        # counts and gradient magnitudes of both polarities, and the image
        channels = 4 + settings.critic_image
        shape = BankShape(classes=how.classes, inputs=channels * how.size**2)
        self.bank = CriticBank(
            shape, device=self.device, generator=self.generator,
            optimizer=OPTIMIZERS[self.settings.critic_optimizer],
        )  # fmt: skip

    def calibrate(self, sets: list[tuple[Pairs, Pairs]], held_out: Iterable[Pairs] = ()) -> None:
        """Place the boundaries of the hash; held-out pairs are not looked at."""
        self.hasher.calibrate(*(pairs for both in sets for pairs in both))
        distributed.broadcast_tensors(self.hasher.boundaries.values())

    def begin_step(self) -> Hashable:
        """All steps are of one kind, where products of groups are one launch."""
        return "all" if self.bank.one_launch() else None

    def step_rates(self, share: float, *, move: bool) -> list[float]:
        """Return the learning rate of the critics: the full one before the generator moves."""
        falls = self.settings.critic_cosine and move
        return [self.settings.critic_rate * (share if falls else 1.0)]

    def extend_fake(
        self,
        fake: Pairs,
        log: torch.Tensor,
        mu: torch.Tensor,
        sigma: torch.Tensor,
        noise: PixelNoise,
        step: torch.Tensor | int,
    ) -> Pairs:
        """Return the pairs as they are: critics look at images and counts alone.

        Arguments have the shape and unit that `Objective.extend_fake` says.
        """
        return fake

    def weights(self) -> torch.Tensor:
        """Return ω of Eq. 13, float32 (classes,), from the real patches seen so far."""
        uniform = self.settings.uniform
        share = self.seen / self.seen.sum().clamp_min(1)
        return uniform / len(share) + (1 - uniform) * share

    def _patches(self, pairs: Pairs) -> torch.Tensor:
        maps = critic_maps(pairs.counts, plain=self.settings.plain_counts)
        if self.settings.critic_image:
            maps = torch.cat([maps, pairs.grey[:, None]], 1)
        return cut_patches(maps, self.hasher.how.size)

    def loss(
        self, fake: Pairs, real: Pairs, *, move: bool, rates: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Move the critics, then return minus the weighted mean score of the fake patches.

        Args:
            fake: Simulated pairs, whose counts have a gradient where `move`.
            real: Pairs of the target.
            move: Whether the network moves in this step; else the loss is 0.
            rates: Learning rate of the critics, float32 (1,); None for that of the settings.
        """
        rate = self.settings.critic_rate if rates is None else rates[0]
        patches, others = (distributed.gather_values(self._patches(pairs)) for pairs in (fake, real))
        ours, theirs = (distributed.gather_values(self.hasher.classes(pairs)) for pairs in (fake, real))
        number, real_number = (self._number(classes) for classes in (ours, theirs))
        ours, theirs = (
            distributed.mask_foreign_classes(classes, len(self.seen)) for classes in (ours, theirs)
        )
        self.seen += real_number
        weights = self.weights()
        for _ in range(self.settings.critic_steps):
            found = self.bank.step(
                patches.detach(), ours, others, theirs, weights,
                rate=rate, penalty=self.settings.penalty, steepness=self.settings.steepness,
                generator=self.generator,
            )  # fmt: skip
        both = (number > 0) & (real_number > 0)
        distance, lies = (
            distributed.sum_over_processes(found.distance),
            distributed.sum_over_processes(found.penalty),
        )
        values = {"distance": distance, "penalty": lies, "classes": both.sum()}
        if not move:
            return fake.counts.new_zeros(()), values
        # every class counts by its weight, however many patches it has in this batch
        gain = torch.where(both, -weights / number.clamp_min(1), 0.0)
        slopes = distributed.sum_over_processes(self.bank.input_gradient(patches.detach(), ours, gain))
        # a sum whose gradient by the patches is `slopes`: autograd goes on from here to the counts
        return (patches * slopes).sum(), values

    def _number(self, classes: torch.Tensor) -> torch.Tensor:
        """Return how many patches each class has."""
        return torch.zeros_like(self.seen).index_add_(
            0, classes, torch.ones_like(classes, dtype=torch.float32)
        )

    def move_shared(self, share: torch.Tensor) -> None:
        """Move nothing, whatever `share` (a scalar) is: descent moves all parameters."""

    def state(self) -> dict[str, Any]:
        """Return the bank, the hash and the random numbers, as the entry `objective` of a checkpoint."""
        own = {
            "bank": self._bank(),
            "boundaries": self.hasher.boundaries,
            "seen": self.seen,
            "generator": self.generator.get_state(),
        }
        # checkpoints of all objectives have the same entries
        return {"newton": None, "objective": own}

    def _bank(self) -> dict[str, Any]:
        """Return the state of all critics, each from the process that looks after it."""
        state = self.bank.state()
        out: dict[str, Any] = {"steps": distributed.gather_from_owners(state["steps"])}
        for kind in ("weights", "square", "mean"):
            out[kind] = {name: distributed.gather_from_owners(value) for name, value in state[kind].items()}
        return out

    def load(self, state: dict[str, Any]) -> None:
        """Take over its entry of a checkpoint."""
        own = state["objective"]
        self.bank.load(own["bank"])
        self.hasher.boundaries = {name: value.to(self.device) for name, value in own["boundaries"].items()}
        self.seen.copy_(own["seen"])
        self.generator.set_state(own["generator"].cpu())
