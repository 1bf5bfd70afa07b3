"""The network that tells thresholds from a picture."""

from __future__ import annotations

import math

import numpy as np
import torch

from dase.networks.threshold_network import NetworkShape, ThresholdNet, edge_strength, interpolate_table


def test_a_network_begins_flat_and_a_table_interpolates(rng):
    grey = torch.from_numpy(rng.random((2, 20, 24)).astype(np.float32))
    maps = ThresholdNet(NetworkShape(channels=4, depth=2, table=(3, 2)), mu=0.3, sigma=0.1)(grey)
    assert torch.allclose(maps.mu, torch.full_like(grey, 0.3))
    assert torch.allclose(maps.sigma, torch.full_like(grey, 0.1))
    table = torch.zeros(2, 3, 2)
    table[0] = torch.tensor([[0.0], [1.0], [4.0]])  # of brightness 0, 1/2 and 1
    flat = torch.full((1, 4, 4), 0.75)
    assert torch.allclose(interpolate_table(table, flat)[0, 0], torch.tensor(2.5))
    assert float(edge_strength(flat).max()) == 0
    split = ThresholdNet(NetworkShape(channels=4, depth=1, split=True), mu=0.3, sigma=0.1)
    split.asymmetry.data += math.log(1.44)
    mu, sigma = split(grey).by_polarity()
    assert torch.allclose(mu[:, 1] / mu[:, 0], torch.tensor(1.44))
    assert torch.allclose(mu[:, 1], torch.tensor(0.36))
    assert torch.allclose(sigma / mu, torch.tensor(1 / 3))
