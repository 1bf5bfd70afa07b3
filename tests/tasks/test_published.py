"""Published weights in our FireNet."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest

torch = pytest.importorskip("torch")

import torch.nn.functional as F

from perf.experiments.downstream.published import LAYERS, PieNet, firenet_of, open_network

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


RENAMED = {
    "net.head.conv.": "head.", "net.head.recurrent_block.": "G1.", "net.resblocks.0.recurrent_block.": "G2.",
    "net.resblocks.0.conv.": "R1.", "net.resblocks.1.": "R2.", "net.pred.": "pred.",
}  # fmt: skip
"""Beginnings of names in the file of FireNet, and in that of FireNet+."""


def renamed(weights):
    """Return weights by the names of FireNet+."""
    return {
        next(new + name[len(old) :] for old, new in RENAMED.items() if name.startswith(old)): weight
        for name, weight in weights.items()
    }


class ConfigParser:
    """What a file of FireNet+ holds beside weights; a program that loads it must not run its code."""

    def __reduce__(self):
        return pytest.fail, ("code of a file was run",)


@pytest.mark.parametrize("name", ["firenet", "firenet+"])
def test_published_weights_say_the_same_in_our_network(tmp_path, name):
    weights, windows = published_weights(), torch.randn(4, 1, 5, 9, 7)
    held = renamed(weights) if name == "firenet+" else weights
    torch.save({"state_dict": held, "epoch": 1, "save_dir": Path("kept")}, tmp_path / "theirs.pth")
    network = open_network(name, tmp_path / "theirs.pth")
    assert (network.kind, network.shape) == ("firenet", {"bins": 5, "channels": CHANNELS})
    with torch.no_grad():
        torch.testing.assert_close(network.sequence(windows)[0], run_published(weights, windows))


def test_no_code_of_a_file_is_run(tmp_path):
    torch.save({"state_dict": published_weights(), "config": ConfigParser()}, tmp_path / "theirs.pth")
    with pytest.raises(pickle.UnpicklingError, match=r"fail"):
        open_network("firenet", tmp_path / "theirs.pth")


def test_other_networks_are_refused():
    weights = published_weights()
    more = {**weights, "net.resblocks.2.conv1.weight": weights["net.resblocks.1.conv1.weight"]}
    with pytest.raises(ValueError, match=r"net\.resblocks\.2"):
        firenet_of(more, LAYERS["firenet"])
    weights.pop("net.pred.conv2d.bias")
    with pytest.raises(KeyError, match=r"net\.pred\.conv2d\.bias"):
        firenet_of(weights, LAYERS["firenet"])


class Counter(torch.nn.Module):
    """In place of a network of event-pienet: keeps what it has seen as that does."""

    def __init__(self):
        super().__init__()
        self.reset_states()

    def reset_states(self):
        self.f0 = self.prev_var = self.p_states = None

    def forward(self, events):
        mean = events.mean(1, keepdim=True)
        self.f0 = mean if self.f0 is None else self.f0 + mean
        self.prev_var = 2 * self.f0
        self.p_states = [(self.f0 + n, self.f0 - n) for n in range(3)]
        return {"image": self.f0 + self.p_states[2][0]}


def test_what_pie_net_remembers_is_handed_in_and_out():
    windows = torch.randn(6, 1, 5, 4, 3)
    network = PieNet(Counter())
    whole, _ = network.sequence(windows)
    first, memory = network.sequence(windows[:2])
    network.sequence(torch.randn(1, 1, 5, 4, 3))  # another recording in between
    second, _ = network.sequence(windows[2:], memory=memory)
    torch.testing.assert_close(torch.cat([first, second]), whole)
    sums = windows.mean(2, keepdim=True).cumsum(0)
    torch.testing.assert_close(whole, 2 * sums + 2)
