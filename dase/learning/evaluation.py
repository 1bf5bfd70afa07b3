"""How far learned thresholds are from known ones, and how far simulated counts are from unseen real ones."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch.nn import functional as F

from dase.learning.known_physics import KnownPhysics
from dase.learning.moment_matching import REFERENCE, Moments, MomentSettings, moment_discrepancy
from dase.learning.scene_batches import Scenery, middle_intensity, send_words
from dase.learning.targets import Pairs, Target, draw_noise, simulate_counts
from dase.networks.threshold_network import ThresholdMaps, ThresholdNet


class MapEvaluation:
    """Fixed scenes and noise on which networks are compared.

    Args:
        scenery: Draws the scenes.
        target: Its `truth`, where known, and its held-out pairs.
        scenes: How many.
        seed: Of scenes and noise.
    """

    def __init__(self, scenery: Scenery, target: Target, *, scenes: int = 16, seed: int = 12345):
        rng, generator = np.random.default_rng(seed), torch.Generator(scenery.device).manual_seed(seed)
        self.log = scenery.draw(rng, scenes)
        self.grey = middle_intensity(self.log, len(scenery.lead))
        self.noise = draw_noise(self.log, generator, len(scenery.lead))
        self.truth = None if target.truth is None else target.truth(self.grey)
        mu, sigma = self.truth or (torch.full_like(self.grey, 0.2), 0.05)
        self.active = simulate_counts(self.log, mu, sigma, self.noise).sum(1) > 0

    @torch.no_grad()
    def describe_maps(self, net: ThresholdNet) -> dict[str, float]:
        """Return numbers that describe the maps of `net`, and compare them with the truth where known.

        KL is that of the learned from the true normal distribution of each pixel's threshold, averaged over
        pixels and both polarities; differences are those of the maps [log intensity]. Slope and correlation
        are of the learned on the true mean over active pixels.
        """
        maps = net(self.grey)
        out = {
            "mu": float(maps.mu.mean()),
            "sigma": float(maps.sigma.mean()),
            "mu_spread": float(maps.mu.std()),
            "sigma_spread": float(maps.sigma.std()),
            "ratio": float(maps.ratio),
        }
        return out if self.truth is None else out | self._compare(maps)

    def _compare(self, maps: ThresholdMaps) -> dict[str, float]:
        assert self.truth is not None
        (mu, sigma), (true_mu, true_sigma) = maps.by_polarity(), self.truth
        kl = torch.log(true_sigma / sigma) - 0.5
        kl = (kl + (sigma.square() + (mu - true_mu).square()) / (2 * true_sigma.square())).mean(1)
        got, want = mu.mean(1)[self.active].double(), true_mu.mean(1)[self.active].double()
        got, want = got - got.mean(), want - want.mean()
        flat = float(want.square().mean()) < 1e-10
        out = {
            "kl": float(kl.mean()),
            "kl_active": float(kl[self.active].mean()),
            "kl_idle": float(kl[~self.active].mean()),
            "mu_diff": float((mu - true_mu).abs().mean()),
            "mu_diff_spread": float((mu - true_mu).abs().std()),
            "sigma_diff": float((sigma - true_sigma).abs().mean()),
            "sigma_diff_spread": float((sigma - true_sigma).abs().std()),
        }
        if not flat:
            out["slope"] = float((got * want).mean() / want.square().mean())
            out["correlation"] = float((got * want).mean() / (got.std() * want.std()).clamp_min(1e-12))
        return out


class HeldOutScore:
    """Pairs that training never sees, against fixed scenes seen through a network.

    The score needs no truth. It compares moments, whatever the objective, because they cannot be learned by
    heart; boundaries and weights come from the held-out pairs and a first set of scenes.

    Args:
        scenery: Draws the scenes.
        pairs: Held out.
        scenes: How many to compare them with.
        seed: Of scenes and noise.
        doubt: Share by which means may differ for reasons that thresholds cannot cure.
        batch: Scenes that are simulated and compared at a time, which bounds the memory.
    """

    def __init__(
        self,
        scenery: Scenery,
        pairs: Pairs,
        *,
        scenes: int = 96,
        seed: int = 54321,
        doubt: float = 0.05,
        batch: int = 12,
        physics: KnownPhysics | None = None,
    ):
        self.physics = None if physics is None else physics.with_batch(batch, seed)
        self.scenery, self.scenes, self.seed, self.batch = scenery, scenes, seed, batch
        self.real = [pairs.select(slice(n, n + batch)) for n in range(0, len(pairs), batch)]
        self.like = Moments(MomentSettings(doubt=doubt), device=scenery.device)
        first = self.simulate_fakes(None)
        self.like.calibrate(list(zip(first, self.real, strict=False)))
        for some in self.real:
            self.like.add_real(some)
        for fake in first:
            self.like.add_reference(
                Pairs(fake.grey, fake.counts, fake.counts), self.like.cell_members(fake.grey)
            )
        self.like.weigh()

    @torch.no_grad()
    def simulate_fakes(self, net: Callable[[torch.Tensor], ThresholdMaps] | None) -> list[Pairs]:
        """Return batches of the fixed scenes seen through a network, or at usual thresholds without one.

        Args:
            net: From images in [0, 1], shape (B, H, W), to thresholds.
        """
        rng = np.random.default_rng(self.seed)
        generator = torch.Generator(self.scenery.device).manual_seed(self.seed)
        if self.physics is not None:
            self.physics.generator.manual_seed(self.seed)
        out = []
        for _ in range(0, self.scenes, self.batch):
            numbers = send_words(self.scenery.draw_numbers(rng, self.batch), self.scenery.device)
            log = self.scenery.render(numbers, self.batch)
            grey = middle_intensity(log, len(self.scenery.lead))
            noise = draw_noise(log, generator, len(self.scenery.lead))
            if net is None:
                level = torch.full_like(grey, REFERENCE[0])
                out.append(Pairs(grey, simulate_counts(log, level, REFERENCE[1], noise)))
            elif self.physics is not None:
                known = self.scenery.known(numbers, self.batch)
                out.append(Pairs(grey, self.physics.count(log, net(grey), known)))
            else:
                out.append(Pairs(grey, simulate_counts(log, *net(grey).by_polarity(), noise)))
        return out

    def score(self, net: Callable[[torch.Tensor], ThresholdMaps]) -> float:
        """Return the weighted square difference of the moments; smaller is better.

        Args:
            net: From images in [0, 1], shape (B, H, W), to thresholds.
        """
        return float(moment_discrepancy(self.simulate_fakes(net), self.real, self.like))

    def statistics(self, net: Callable[[torch.Tensor], ThresholdMaps]) -> dict[str, float]:
        """Return how counts and 8x8 patches of them differ from the held-out ones, in plain numbers.

        Args:
            net: From images in [0, 1], shape (B, H, W), to thresholds.
        """
        fake, real = (
            torch.cat([pairs.counts for pairs in side]) for side in (self.simulate_fakes(net), self.real)
        )
        out = {"score": self.score(net), "rate": float(fake.mean() / real.mean().clamp_min(1e-9))}
        out["counts"] = 0.5 * float((count_histogram(fake) - count_histogram(real)).abs().sum())
        sums = [F.avg_pool2d(side, 8) * 64 for side in (fake, real)]
        spreads = [
            (F.avg_pool2d(side.square(), 8) - F.avg_pool2d(side, 8).square()).clamp_min(0).sqrt()
            for side in (fake, real)
        ]
        out["patch_sums"] = log_count_distance(sums[0], sums[1])
        out["patch_spreads"] = log_count_distance(spreads[0], spreads[1])
        return out


def count_histogram(counts: torch.Tensor, most: int = 12) -> torch.Tensor:
    """Return the shares of pixels with 0, 1, ... events, (most + 1,); the last has `most` and more."""
    whole = counts.round().long().clamp(0, most).flatten()
    return torch.bincount(whole, minlength=most + 1).double() / len(whole)


def log_count_distance(one: torch.Tensor, other: torch.Tensor) -> float:
    """Return the mean distance of sorted values of log(1 + x), Wasserstein's of the first order.

    Args:
        one: Counts, of any shape.
        other: Counts, of any shape.
    """
    shares = torch.linspace(0, 1, 2001, device=one.device, dtype=torch.float64)
    values = []
    for side in (one, other):
        ordered = torch.sort(torch.log1p(side.double()).flatten()).values
        values.append(ordered[(shares * (len(ordered) - 1)).round().long()])
    return float((values[0] - values[1]).abs().mean())
