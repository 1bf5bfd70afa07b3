"""Gradients of moving layers against central differences, and a descent along them."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the bridge needs torch")

from helpers.layer_gradients import FIELDS, sizes_of

from dase.kernels.autograd_scene_layers import affine_places, render_layers


def smooth_layers(device):
    """Return three textures of low frequency whose alpha fades out at the border."""
    textures = []
    for n, (h, w) in enumerate([(120, 160), (80, 90), (90, 70)]):
        v, u = np.mgrid[:h, :w] / max(h, w)
        grey = 0.5 + 0.2 * np.sin(3 * u + n) + 0.2 * np.cos(4 * v - n * u)
        fade = (np.sin(np.pi * np.arange(h) / (h - 1))[:, None] * np.sin(np.pi * np.arange(w) / (w - 1))) ** 2
        alpha = 0.9 * fade if n else np.ones_like(fade)
        textures.append(tuple(torch.tensor(a, dtype=torch.float32, device=device) for a in (grey, alpha)))
    return textures


def slope(objective, values, directions, step):
    """Return the central difference of `objective` where all `values` move along `directions`."""
    with torch.no_grad():
        ends = [
            objective(*(v + sign * step * d for v, d in zip(values, directions, strict=True))).item()
            for sign in (1, -1)
        ]
    return (ends[0] - ends[1]) / (2 * step)


def along(objective, values, directions):
    """Return the derivative of `objective` along `directions` by its gradients."""
    values = [v.detach().requires_grad_() for v in values]
    gradients = torch.autograd.grad(objective(*values), values)
    pairs = zip(gradients, directions, strict=True)
    return sum((g.double() * d).sum() for g, d in pairs).item()


def smooth_objective(textures, width=96, height=72):
    """Return places of 2 samples and a function of (grey, alpha, place) without float32 sums."""
    motion = torch.zeros(3, 5, 2)
    motion[:, 3:] = 1.2
    motion[1:, 0] = torch.tensor([[-0.1, 0.13], [0.2, 0.03]])
    motion[1:, 2] = torch.tensor([[0.2, 0.5], [-0.6, 0.1]])
    motion[1:, 3:] = 0.8
    motion = motion.to(textures[0][0].device)
    v, u = torch.meshgrid(torch.linspace(0, 3, height), torch.linspace(0, 4, width), indexing="ij")
    weight = torch.stack([torch.sin(u + v), torch.cos(u - 2 * v)]).double().to(motion.device)

    def places(m):
        return affine_places(m, [0.0, 1.0], sizes_of(textures), width=width, height=height, duration=1.0)

    def objective(layers, place):
        return (render_layers(layers, place, width=width, height=height).double() * weight).sum()

    return motion, places, objective


@pytest.mark.parametrize("which", [0, 1])
def test_texture_gradients_equal_differences(which, device, rng):
    textures = smooth_layers(device)
    motion, places, objective = smooth_objective(textures)
    place = places(motion)
    for n in range(3):

        def moved(values, n=n):
            layers = list(textures)
            layers[n] = (values, layers[n][1]) if which == 0 else (layers[n][0], values)
            return objective(layers, place)

        value = textures[n][which]
        direction = torch.tensor(rng.normal(size=value.shape), dtype=torch.float32, device=device)
        got = along(moved, [value], [direction])
        # linear in either: only rounding is left
        want = slope(moved, [value], [direction], 0.2)
        assert abs(want) > 0.1
        assert got == pytest.approx(want, rel=2e-4)


@pytest.mark.parametrize("n", [0, 1, 2])
def test_place_gradients_equal_differences(n, device):
    textures = smooth_layers(device)
    motion, places, objective = smooth_objective(textures)
    place = places(motion)
    for i in range(2):
        for j, extent in enumerate((96, 72, 1)):
            direction = torch.zeros_like(place)
            direction[:, n, i, j] = 1 / extent  # moves no pixel by more than a texel
            got = along(lambda p: objective(textures, p), [place], [direction])
            want = slope(lambda p: objective(textures, p), [place], [direction], 0.05)
            assert got == pytest.approx(want, rel=1e-3), (i, j)
            assert abs(want) > 0.5


@pytest.mark.parametrize("field", FIELDS)
def test_motion_gradients_equal_differences(field, device):
    textures = smooth_layers(device)
    motion, places, objective = smooth_objective(textures)
    for layer in range(3):
        for end in range(2):
            direction = torch.zeros_like(motion)
            direction[layer, FIELDS.index(field), end] = 1
            got = along(lambda m: objective(textures, places(m)), [motion], [direction])
            want = slope(lambda m: objective(textures, places(m)), [motion], [direction], 5e-4)
            assert got == pytest.approx(want, rel=2e-3, abs=0.02), (layer, end)
            assert abs(want) > 5


def test_gradient_reaches_times(device):
    motion = torch.tensor([[[0.0, 0.5], [0.0, 0.0], [0.0, 0.0], [1.0, 1.0], [1.0, 1.0]]], device=device)
    times = torch.tensor([0.1, 0.3], device=device, requires_grad=True)
    places = affine_places(motion, times, [(30, 40)], width=40, height=30, duration=2.0)
    (gradient,) = torch.autograd.grad(places[:, 0, 0, 2].sum(), times)
    torch.testing.assert_close(gradient, torch.full_like(times, -10.0))  # 0.5 · 40 px in 2 s


def test_descent_finds_a_translation(device):
    textures = smooth_layers(device)
    motion, places, _ = smooth_objective(textures)
    true = torch.tensor([[-0.1, 0.13], [0.05, -0.04]], device=device)  # x, y of layer 1 [widths]
    fixed = motion.clone()
    fixed[1, :2] = true
    target = render_layers(textures, places(fixed), width=96, height=72)
    guess = torch.zeros(2, 2, device=device, requires_grad=True)
    optimiser = torch.optim.LBFGS([guess], max_iter=25, line_search_fn="strong_wolfe")

    def loss():
        optimiser.zero_grad()
        moving = motion.clone()
        moving[1, :2] = guess
        error = (render_layers(textures, places(moving), width=96, height=72) - target).square().sum()
        error.backward()
        return error

    optimiser.step(loss)
    torch.testing.assert_close(guess.detach(), true, rtol=0, atol=1e-3)  # a tenth of a pixel
