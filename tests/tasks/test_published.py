"""Published weights in our FireNet."""

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch")

import torch.nn.functional as F

from dase.tasks.checkpoints import load_network
from perf.experiments.downstream.published import firenet_of, save_published

CHANNELS = 3


def published_weights():
    """Return random weights by the published names; 3x3 filters, but for the last layer."""
    torch.manual_seed(0)
    found = {}

    def layer(name, outputs, inputs, side=3):
        found[f"net.{name}.weight"] = 0.3 * torch.randn(outputs, inputs, side, side)
        found[f"net.{name}.bias"] = 0.3 * torch.randn(outputs)

    layer("head.conv.conv2d", CHANNELS, 5)
    for cell in ("head.recurrent_block", "resblocks.0.recurrent_block"):
        for gate in ("reset_gate", "update_gate", "out_gate"):
            layer(f"{cell}.{gate}", CHANNELS, 2 * CHANNELS)
    for block in ("resblocks.0.conv", "resblocks.1"):
        layer(f"{block}.conv1", CHANNELS, CHANNELS)
        layer(f"{block}.conv2", CHANNELS, CHANNELS)
    layer("pred.conv2d", 1, CHANNELS, 1)
    return found


def run_published(weights, windows):
    """Return what the paper's network says: head, GRU, block, GRU, block, prediction."""

    def layer(name, x):
        weight, bias = weights[f"net.{name}.weight"], weights[f"net.{name}.bias"]
        return F.conv2d(x, weight, bias, padding=weight.shape[-1] // 2)

    def gru(name, x, state):
        both = torch.cat([x, state], 1)
        update = torch.sigmoid(layer(f"{name}.update_gate", both))
        reset = torch.sigmoid(layer(f"{name}.reset_gate", both))
        out = torch.tanh(layer(f"{name}.out_gate", torch.cat([x, state * reset], 1)))
        return state * (1 - update) + out * update

    def block(name, x):
        return torch.relu(x + layer(f"{name}.conv2", torch.relu(layer(f"{name}.conv1", x))))

    state, made = torch.zeros(2, 1, CHANNELS, *windows.shape[3:]), []
    for window in windows:
        first = gru("head.recurrent_block", torch.relu(layer("head.conv.conv2d", window)), state[0])
        second = gru("resblocks.0.recurrent_block", block("resblocks.0.conv", first), state[1])
        state = torch.stack([first, second])
        made.append(layer("pred.conv2d", block("resblocks.1", second)))
    return torch.stack(made)


def test_published_weights_say_the_same_in_our_network(tmp_path):
    weights, windows = published_weights(), torch.randn(4, 1, 5, 9, 7)
    torch.save({"state_dict": weights, "epoch": 1}, tmp_path / "theirs.pth")
    save_published(tmp_path / "theirs.pth", tmp_path / "ours.pt", 0.02)
    network, window = load_network(tmp_path / "ours.pt")
    assert (network.kind, network.shape, window) == ("firenet", {"bins": 5, "channels": CHANNELS}, 0.02)
    with torch.no_grad():
        torch.testing.assert_close(network.sequence(windows)[0], run_published(weights, windows))


def test_other_networks_are_refused():
    weights = published_weights()
    with pytest.raises(ValueError, match=r"net\.resblocks\.2"):
        firenet_of({**weights, "net.resblocks.2.conv1.weight": weights["net.resblocks.1.conv1.weight"]})
    weights.pop("net.pred.conv2d.bias")
    with pytest.raises(KeyError, match=r"net\.pred\.conv2d\.bias"):
        firenet_of(weights)
