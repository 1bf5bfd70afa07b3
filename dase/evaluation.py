"""How far learned thresholds are from known ones, and how far simulated counts are from unseen real ones."""

from __future__ import annotations

import numpy as np
import torch

from dase.moments import Moments, discrepancy
from dase.networks import Maps, ThresholdNet
from dase.scenery import Scenery, middle
from dase.targets import Noise, Pairs, Target, draw_noise, simulate


class Exam:
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
        self.grey = middle(self.log)
        self.noise = draw_noise(self.log, generator)
        self.truth = None if target.truth is None else target.truth(self.grey)
        mu, sigma = self.truth or (torch.full_like(self.grey, 0.2), 0.05)
        self.active = simulate(self.log, mu, sigma, self.noise).sum(1) > 0

    @torch.no_grad()
    def marks(self, net: ThresholdNet) -> dict[str, float]:
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

    def _compare(self, maps: Maps) -> dict[str, float]:
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


class HeldOut:
    """Pairs that training never sees, against fixed scenes seen through a network.

    The score needs no truth. It compares moments, whatever the objective, because they cannot be learned by
    heart; boundaries and weights come from the held-out pairs and a first set of scenes.

    Args:
        scenery: Draws the scenes.
        pairs: Held out.
        scenes: How many to compare them with.
        seed: Of scenes and noise.
    """

    def __init__(self, scenery: Scenery, pairs: Pairs, *, scenes: int = 96, seed: int = 54321):
        self.scenery, self.scenes, self.seed = scenery, scenes, seed
        self.real = [pairs.select(slice(n, n + 12)) for n in range(0, len(pairs), 12)]
        self.like = Moments(device=scenery.device)
        first = self._fakes(None)
        self.like.calibrate(list(zip(first, self.real, strict=False)))
        for fake in first:
            self.like.see_plain(Pairs(fake.grey, fake.counts, fake.counts))
        self.like.weigh()

    @torch.no_grad()
    def _fakes(self, net: ThresholdNet | None) -> list[Pairs]:
        rng = np.random.default_rng(self.seed)
        generator = torch.Generator(self.scenery.device).manual_seed(self.seed)
        out = []
        for _ in range(0, self.scenes, 12):
            log = self.scenery.draw(rng, 12)
            grey = middle(log)
            noise: Noise = draw_noise(log, generator)
            if net is None:
                out.append(Pairs(grey, simulate(log, torch.full_like(grey, 0.25), 0.06, noise)))
                continue
            maps = net(grey)
            mu, sigma = maps.by_polarity() if net.shape.split else (maps.mu, maps.sigma)
            out.append(Pairs(grey, simulate(log, mu, sigma, noise)))
        return out

    def score(self, net: ThresholdNet) -> float:
        """Return the weighted square difference of the moments; smaller is better."""
        return discrepancy(self._fakes(net), self.real, self.like)
