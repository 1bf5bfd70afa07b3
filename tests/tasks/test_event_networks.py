"""Networks: shapes, padding, memory, numbers of parameters."""

from __future__ import annotations

from itertools import pairwise

import pytest

torch = pytest.importorskip("torch")

from dase.errors import InputError
from dase.tasks.event_networks import (
    ConvGru,
    ConvLstm,
    E2VidNet,
    EvFlowNet,
    FireNet,
    enlarged,
    enlarged_by_slices,
)


def small(kind):
    torch.manual_seed(0)
    return kind(5, 4).eval()


@pytest.mark.parametrize(("kind", "channels"), [(E2VidNet, 1), (FireNet, 1), (EvFlowNet, 2)])
@pytest.mark.parametrize("size", [(16, 32), (13, 21), (1, 1)])
def test_any_size_is_padded_and_cut(kind, channels, size):
    made, _ = small(kind)(torch.randn(2, 5, *size))
    assert made.shape == (2, channels, *size)
    assert made.isfinite().all()


@pytest.mark.parametrize("kind", [E2VidNet, EvFlowNet])
def test_padding_is_zeros_right_and_below(kind):
    net, inputs = small(kind), torch.randn(1, 5, 13, 21)
    larger = torch.zeros(1, 5, 16, 32 if kind is EvFlowNet else 24)
    larger[..., :13, :21] = inputs
    assert torch.equal(net(inputs)[0], net(larger)[0][..., :13, :21])


@pytest.mark.parametrize("kind", [E2VidNet, FireNet])
def test_parts_of_a_sequence_are_the_sequence(kind):
    net, inputs = small(kind), torch.randn(6, 2, 5, 16, 16)
    whole, _ = net.sequence(inputs)
    begin, memory = net.sequence(inputs[:2])
    end, _ = net.sequence(inputs[2:], memory=memory)
    assert torch.equal(whole, torch.cat([begin, end]))
    # and it does remember
    assert not torch.allclose(whole[2:], net.sequence(inputs[2:])[0], atol=1e-4)


@pytest.mark.parametrize("kind", [E2VidNet, FireNet])
def test_reset_clears_the_memory_of_its_slot_alone(kind):
    net, inputs = small(kind), torch.randn(4, 2, 5, 8, 8)
    reset = torch.zeros(4, 2, dtype=torch.bool)
    reset[2, 1] = True
    made, _ = net.sequence(inputs, reset)
    assert torch.allclose(made[:, 0], net.sequence(inputs)[0][:, 0], atol=1e-6)
    fresh = net.sequence(inputs[2:])[0]
    assert torch.allclose(made[2:, 1], fresh[:, 1], atol=1e-6)


def conv(inputs, outputs, side):
    return outputs * (inputs * side**2 + 1)


def test_numbers_of_parameters_are_those_of_the_layers():
    c = (32, 64, 128, 256)
    e2vid = conv(5, 32, 5) + conv(32, 1, 1) + 4 * conv(256, 256, 3)
    for a, b in pairwise(c):
        e2vid += conv(a, b, 5) + conv(2 * b, 4 * b, 3) + conv(b, a, 5)
    assert E2VidNet().parameter_count == e2vid == 10_710_401
    fire = conv(5, 16, 3) + 2 * (conv(32, 32, 3) + conv(32, 16, 3)) + 4 * conv(16, 16, 3) + conv(16, 1, 1)
    assert FireNet().parameter_count == fire == 37_777
    flow = conv(5, 64, 3) + conv(64, 128, 3) + conv(128, 256, 3) + conv(256, 512, 3) + 4 * conv(512, 512, 3)
    flow += conv(1024, 256, 3) + conv(512, 128, 3) + conv(256, 64, 3) + conv(128, 32, 3) + conv(32, 2, 1)
    assert EvFlowNet().parameter_count == flow


def test_memory_cells_are_their_equations():
    """One pixel and one channel, by hand; filters but for their middle are 0."""

    def sigmoid(a):
        return 1 / (1 + torch.exp(-a))

    x, h, c = torch.tensor(0.3), torch.tensor(-0.4), torch.tensor(0.7)
    lstm = ConvLstm(1)
    w = lstm.gates.weight[:, :, 1, 1]
    f, i, o, g = (w[n, 0] * x + w[n, 1] * h + lstm.gates.bias[n] for n in range(4))
    cell = sigmoid(f) * c + sigmoid(i) * torch.tanh(g)
    got = lstm(x.view(1, 1, 1, 1), torch.stack([h, c]).view(1, 2, 1, 1)).flatten()
    assert torch.allclose(got, torch.stack([sigmoid(o) * torch.tanh(cell), cell]))
    gru = ConvGru(1)
    w, v = gru.gates.weight[:, :, 1, 1], gru.proposal.weight[0, :, 1, 1]
    z, r = (sigmoid(w[n, 0] * x + w[n, 1] * h + gru.gates.bias[n]) for n in range(2))
    new = torch.tanh(v[0] * x + v[1] * r * h + gru.proposal.bias[0])
    got = gru(x.view(1, 1, 1, 1), h.view(1, 1, 1, 1)).flatten()
    assert torch.allclose(got, (1 - z) * h + z * new)


def test_wrong_inputs_are_one_sentence():
    with pytest.raises(InputError, match=r"e2vid: inputs must have shape \(B, 5, H, W\), got \(1, 4, 8, 8\)"):
        small(E2VidNet)(torch.zeros(1, 4, 8, 8))
    with pytest.raises(InputError, match="channels"):
        FireNet(5, 0)


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (4, 3)])
@pytest.mark.parametrize("enlarge", [enlarged, enlarged_by_slices])
def test_enlarged_is_bilinear(enlarge, size):
    x = torch.randn(2, 3, *size, dtype=torch.float64, requires_grad=True)
    want = torch.nn.functional.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)
    torch.testing.assert_close(enlarge(x), want)
    weight = torch.randn_like(want)
    (ours,), (theirs,) = (torch.autograd.grad((y * weight).sum(), x) for y in (enlarge(x), want))
    torch.testing.assert_close(ours, theirs)
