"""What learning is measured against: thresholds by default, by the event rate, and at random.

All of them answer like a `ThresholdNet`, so they are judged and written in the same way.
"""

from __future__ import annotations

import numpy as np
import torch

from dase.learning.scene_batches import Scenery
from dase.learning.targets import Pairs, draw_noise, simulate_counts
from dase.networks.threshold_network import NetworkShape, ThresholdMaps, ThresholdNet


def constant_thresholds(mu: float, sigma: float, ratio: float = 1.0) -> ThresholdNet:
    """Return a network that gives every pixel the same distribution."""
    net = ThresholdNet(NetworkShape(channels=4, depth=1, split=True), mu=mu, sigma=sigma)
    with torch.no_grad():
        net.asymmetry.fill_(float(np.log(ratio)))
    net.eval()
    return net


def esim_thresholds() -> ThresholdNet:
    """Return ESIM's thresholds: what one has without looking at the target.

    They are those that it was used with to train E2VID, and of the preset `esim`.
    """
    return constant_thresholds(mu=0.18, sigma=0.03)


def match_event_rate(
    target: Pairs, scenery: Scenery, *, scenes: int = 96, spread: float = 0.1, seed: int = 0
) -> ThresholdNet:
    """Return the threshold at which simulated scenes have the target's event rate.

    S2R's tuning (Stoffregen et al., Reducing the sim-to-real gap for event cameras, 2020) takes the median
    over sequences of the events per pixel and second, which falls with the threshold, so bisection finds it;
    the other polarity is off by a factor N(1, `spread`), here in every pixel.

    Args:
        target: Real pairs.
        scenery: Draws the simulator's scenes.
        scenes: How many to compare with.
        spread: Of thresholds, as a share of them.
        seed: Of scenes and noise.
    """
    wanted = float(target.counts.float().mean((1, 2, 3)).median())
    low, high = 0.01, 3.0
    for _ in range(18):
        tried = (low * high) ** 0.5
        if _median_event_rate(tried, spread, scenery, scenes, seed) > wanted:
            low = tried
        else:
            high = tried
    return constant_thresholds((low * high) ** 0.5, spread * (low * high) ** 0.5)


@torch.no_grad()
def _median_event_rate(mu: float, spread: float, scenery: Scenery, scenes: int, seed: int) -> float:
    """Return the median over scenes of the events per pixel."""
    rng, generator = np.random.default_rng(seed), torch.Generator(scenery.device).manual_seed(seed)
    rates = []
    for _ in range(0, scenes, 12):
        log = scenery.draw(rng, 12)
        noise = draw_noise(log, generator, len(scenery.lead))
        level = torch.full_like(noise.z, mu)
        rates.append(simulate_counts(log, level, spread * mu, noise).mean((1, 2, 3)))
    return float(torch.cat(rates).median())


class RandomThresholds:
    """Thresholds drawn anew for every scene over all that cameras have: no adaptation, a strong baseline.

    Args:
        seed: Of the draws; the same scenes get the same thresholds every time.
        bounds: Of the mean thresholds [log intensity], as in V2V, 2025.
        most: Greatest ratio of ON and OFF, either way.
    """

    shape = NetworkShape(split=True)

    def __init__(self, seed: int = 0, *, bounds: tuple[float, float] = (0.05, 2.0), most: float = 1.5):
        self.seed, self.bounds, self.most = seed, bounds, most

    def __call__(self, grey: torch.Tensor) -> ThresholdMaps:
        """Return maps for images (B, H, W)."""
        # of the pictures themselves, so that a batch draws the same whatever came before it
        key = int(torch.sum(grey[:, ::16, ::16] * 1e4).item())
        rng = np.random.default_rng([self.seed, key])
        mu = torch.from_numpy(rng.uniform(*self.bounds, len(grey)).astype(np.float32)).to(grey.device)
        ratio = torch.tensor(float(self.most ** rng.uniform(-1, 1)), device=grey.device)
        maps = mu.view(-1, 1, 1).expand_as(grey)
        return ThresholdMaps(maps, 0.1 * maps, ratio, torch.zeros(len(grey), 2, 1, 1, device=grey.device))
