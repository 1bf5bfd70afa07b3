"""Rendering of moving layers: equal to `LayerScene`, with the gradients of a plain torch twin."""

from __future__ import annotations

import math

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the bridge needs torch")

from helpers.layer_gradients import FIELDS, sizes_of

from dase.kernels import launch
from dase.kernels.autograd_scene_layers import affine_places, render_layers
from dase.scenes.image_sources import Picture
from dase.scenes.layers import Layer, LayerScene, Motion

WIDTH, HEIGHT = 40, 30


def random_layers(rng, count, device):
    """Return textures with `count` foregrounds, alpha often exactly 0 or 1."""
    textures = [(torch.tensor(rng.uniform(size=(19, 26)), dtype=torch.float32, device=device), None)]
    for n in range(count):
        grey, alpha = rng.uniform(size=(2, 17 + n, 21 - n))
        alpha = np.clip(2 * alpha - 0.5, 0, 1)
        assert (alpha == 0).any()
        assert (alpha == 1).any()
        alpha[5:12, 5:12] = 1  # a plateau, so that whole pixels are opaque
        textures.append(tuple(torch.tensor(a, dtype=torch.float32, device=device) for a in (grey, alpha)))
    return textures


def random_motion(rng, layers, device):
    """Return motion (L, 5, 2) by which layers overlap and the background is folded at all sides."""
    motion = rng.uniform(-0.25, 0.25, (layers, 5, 2))
    motion[:, 2] *= 4  # angle [rad]
    motion[:, 3:] = rng.uniform(0.5, 0.9, (layers, 2, 2))
    return torch.tensor(motion, dtype=torch.float32, device=device)


def random_scene(rng, count, device, samples=3):
    textures = random_layers(rng, count, device)
    motion = random_motion(rng, len(textures), device)
    times = torch.linspace(0, 1, samples)
    place = affine_places(motion, times, sizes_of(textures), width=WIDTH, height=HEIGHT, duration=1.0)
    return textures, place


def folded(index, length):
    """Fold whole indices as reflect-101 does."""
    period = max(2 * (length - 1), 1)
    index = index.remainder(period)
    return torch.minimum(index, period - index).clamp(max=length - 1)


def bilinear(image, u, v, *, reflect):
    """Sample `image` (h, w) at `u`, `v` from its four neighbours."""
    h, w = image.shape
    left, top = u.detach().floor().long(), v.detach().floor().long()
    total = 0.0
    for i in (0, 1):
        for j in (0, 1):
            column, row = left + i, top + j
            weight = (1 - (u - column).abs()) * (1 - (v - row).abs())
            if reflect:
                column, row = folded(column, w), folded(row, h)
            else:
                weight = weight * ((column >= 0) & (column < w) & (row >= 0) & (row < h))
            total = total + weight * image[row.clamp(0, h - 1), column.clamp(0, w - 1)]
    return total


def twin(textures, place, width=WIDTH, height=HEIGHT):
    """Composite back to front in double precision; torch differentiates it."""
    y, x = torch.meshgrid(
        *(torch.arange(n, dtype=torch.float64, device=place.device) for n in (height, width)), indexing="ij"
    )
    pixel = torch.stack([x, y, torch.ones_like(x)], -1)
    at = torch.einsum("klij,yxj->lkyxi", place.double(), pixel)
    light = 0.0
    for n, (grey, alpha) in enumerate(textures):
        alpha = (torch.ones_like(grey) if alpha is None else alpha).double()
        colour = bilinear(grey.double() * alpha, at[n, ..., 0], at[n, ..., 1], reflect=n == 0)
        if n > 0:
            light = light * (1 - bilinear(alpha, at[n, ..., 0], at[n, ..., 1], reflect=False))
        light = light + colour
    return light


def leaves_of(textures, place):
    """Return all tensors, now asking for gradients."""
    return [t.requires_grad_() for layer in textures for t in layer if t is not None] + [
        place.requires_grad_()
    ]


def assert_gradients_equal(textures, place, width=WIDTH, height=HEIGHT):
    """Compare value and all gradients with the twin, by random weights."""
    leaves = leaves_of(textures, place.detach())
    place = leaves[-1]
    got, want = (
        render_layers(textures, place, width=width, height=height),
        twin(textures, place, width, height),
    )
    torch.testing.assert_close(got.double(), want, rtol=0, atol=1e-5)
    weight = torch.randn(got.shape, generator=torch.Generator().manual_seed(1)).to(got.device)
    pairs = zip(
        torch.autograd.grad((got * weight).sum(), leaves),
        torch.autograd.grad((want * weight).sum(), leaves),
        strict=True,
    )
    for g, w in pairs:
        torch.testing.assert_close(g, w, rtol=1e-4, atol=2e-5 * w.abs().max().item())
        yield w


@pytest.mark.parametrize("count", [0, 1, 4])
def test_gradients_equal_the_twin(count, device, rng):
    textures, place = random_scene(rng, count, device)
    for want in assert_gradients_equal(textures, place):
        assert want.abs().max() > 0.5


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (6, 1), (2, 2), (2, 3)])
def test_narrow_textures(size, device, rng):
    textures = [
        (torch.tensor(rng.uniform(size=size), dtype=torch.float32, device=device), None),
        tuple(torch.tensor(rng.uniform(size=(2, *size)), dtype=torch.float32, device=device)),
    ]
    place = torch.tensor(rng.uniform(-0.3, 0.3, (2, 2, 2, 3)), dtype=torch.float32, device=device)
    for want in assert_gradients_equal(textures, place, 9, 7):
        assert want.isfinite().all()


def test_nothing_behind_an_opaque_layer_matters_but_to_its_alpha(device):
    grey = torch.full((12, 12), 0.25, device=device, requires_grad=True)
    front, alpha = (torch.full((12, 12), a, device=device, requires_grad=True) for a in (0.75, 1.0))
    place = torch.eye(2, 3, device=device).expand(1, 2, 2, 3)
    frames = render_layers([(grey, None), (front, alpha)], place, width=12, height=12)
    by_grey, by_front, by_alpha = torch.autograd.grad(frames.sum(), (grey, front, alpha))
    assert not by_grey.any()
    torch.testing.assert_close(by_front, torch.ones_like(front))
    torch.testing.assert_close(by_alpha, torch.full_like(alpha, 0.75 - 0.25))


def test_moving_a_constant_background_changes_nothing(device):
    # pixels lie on texels exactly, those of the last row and column on the fold
    textures = [(torch.full((6, 9), 0.5, device=device), None)]
    place = torch.eye(2, 3, device=device).repeat(1, 1, 1, 1).requires_grad_()
    frames = render_layers(textures, place, width=9, height=6)
    weight = torch.arange(54.0, device=device).view(6, 9)
    (gradient,) = torch.autograd.grad((frames * weight).sum(), place)
    torch.testing.assert_close(gradient, torch.zeros_like(place))


def test_frames_equal_those_of_a_scene(device, rng):
    textures = random_layers(rng, 4, device)
    motion = random_motion(rng, 5, device)
    scene = LayerScene(
        [
            Layer(
                Picture(grey.cpu().numpy(), None if alpha is None else alpha.cpu().numpy()),
                Motion(**{name: tuple(row.tolist()) for name, row in zip(FIELDS, rows, strict=True)}),
            )
            for (grey, alpha), rows in zip(textures, motion, strict=True)
        ],
        width=WIDTH,
        height=HEIGHT,
        duration=0.7,
    )
    times = np.linspace(0, 0.7, 6)
    want = scene.arrays(times, launch.find_device(device)).place.numpy()
    places = affine_places(motion, times, sizes_of(textures), width=WIDTH, height=HEIGHT, duration=0.7)
    np.testing.assert_allclose(places.cpu(), want, rtol=0, atol=1e-5)
    frames = render_layers(textures, torch.tensor(want, device=device), width=WIDTH, height=HEIGHT)
    # a GPU's compiler joins products and sums in other places of the two kernels
    tolerance = 0 if str(device) == "cpu" else 1e-5
    np.testing.assert_allclose(frames.cpu(), scene.frames(times, device), rtol=0, atol=tolerance)
    assert frames.std() > 0.1


def test_no_grad_autocast_strides_and_dtypes(device, rng):
    textures, place = random_scene(rng, 2, device)
    place.requires_grad_()
    want = render_layers(textures, place, width=WIDTH, height=HEIGHT)
    (gradient,) = torch.autograd.grad(want.square().sum(), place)
    with torch.no_grad():
        assert not render_layers(textures, place, width=WIDTH, height=HEIGHT).requires_grad
    with torch.inference_mode():
        render_layers(textures, place, width=WIDTH, height=HEIGHT)
    strided = [tuple(None if t is None else t.mT.contiguous().mT for t in layer) for layer in textures]
    turned = place.permute(3, 2, 1, 0).contiguous().permute(3, 2, 1, 0)
    assert not turned.is_contiguous()
    assert not strided[1][0].is_contiguous()
    got = render_layers(strided, turned, width=WIDTH, height=HEIGHT)
    torch.testing.assert_close(got, want, rtol=0, atol=0)
    # the sum expands, so its gradient is not contiguous either
    (summed,) = torch.autograd.grad(got.sum(), place)
    assert summed.abs().max() > 1
    with torch.autocast(torch.device(device).type, torch.bfloat16):
        got = render_layers(textures, place, width=WIDTH, height=HEIGHT)
        assert got.dtype == torch.float32
        loss = got.square().sum()
    torch.testing.assert_close(torch.autograd.grad(loss, place)[0], gradient, rtol=1e-4, atol=1e-3)
    double = place.detach().double().requires_grad_()
    got = render_layers(textures, double, width=WIDTH, height=HEIGHT)
    (g,) = torch.autograd.grad(got.square().sum(), double)
    torch.testing.assert_close(g.float(), gradient, rtol=1e-4, atol=1e-3)


def test_autocast_leaves_places_alone(device, rng):
    motion = random_motion(rng, 3, device)
    options = {"width": 346, "height": 260, "duration": 1.0}
    want = affine_places(motion, [0.0, 0.4], [(300, 400)] * 3, **options)
    with torch.autocast(torch.device(device).type, torch.bfloat16):
        got = affine_places(motion, [0.0, 0.4], [(300, 400)] * 3, **options)
    torch.testing.assert_close(got, want, rtol=0, atol=0)


def test_only_wanted_gradients_are_made(device, rng):
    textures, place = random_scene(rng, 2, device)
    leaves = leaves_of(textures, place.detach())
    every = torch.autograd.grad(render_layers(textures, leaves[-1], width=WIDTH, height=HEIGHT).sum(), leaves)
    fixed = [tuple(None if t is None else t.detach() for t in layer) for layer in textures]
    frames = render_layers(fixed, leaves[-1], width=WIDTH, height=HEIGHT)
    torch.testing.assert_close(torch.autograd.grad(frames.sum(), leaves[-1])[0], every[-1])
    frames = render_layers(textures, leaves[-1].detach(), width=WIDTH, height=HEIGHT)
    for g, w in zip(torch.autograd.grad(frames.sum(), leaves[:-1]), every[:-1], strict=True):
        torch.testing.assert_close(g, w)


def test_threads_do_not_change_gradients(rng):
    textures, place = random_scene(rng, 4, "cpu", samples=8)
    leaves = leaves_of(textures, place.detach())
    before, found = launch.thread_count(), []
    try:
        for count in (1, 3, 20):
            launch.set_threads(count)
            frames = render_layers(textures, leaves[-1], width=WIDTH, height=HEIGHT)
            found.append(torch.autograd.grad(frames.sum(), leaves))
    finally:
        launch.set_threads(before)
    for other in found[1:]:
        for g, w in zip(other, found[0], strict=True):
            torch.testing.assert_close(g, w, rtol=1e-4, atol=1e-4 * w.abs().max().item())


@pytest.mark.parametrize("value", [1e30, -1e30, math.nan, math.inf])
def test_places_out_of_reach_stay_inside_the_textures(device, rng, value):
    textures, place = random_scene(rng, 2, device)
    *leaves, lost = leaves_of(textures, torch.full_like(place, value))
    frames = render_layers(textures, lost, width=WIDTH, height=HEIGHT)
    of_background, *of_foregrounds, _ = torch.autograd.grad(frames.sum(), [*leaves, lost])
    # foregrounds are nowhere in the picture; a GPU takes a place that is no number for texel 0
    for gradient in of_foregrounds if math.isfinite(value) or place.device.type == "cpu" else ():
        torch.testing.assert_close(gradient, torch.zeros_like(gradient))
    if math.isfinite(value):  # the folded background is everywhere: each pixel shows texels of weight 1
        assert of_background.sum().item() == pytest.approx(frames.numel())
        without = render_layers(textures[:1], lost[:, :1], width=WIDTH, height=HEIGHT)
        torch.testing.assert_close(frames, without, rtol=0, atol=0)
    else:  # said, not hidden: 0 · ∞ is no number either
        assert frames[:, 0, 0].isnan().all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"place": torch.zeros(2, 3)}, r"place must have shape \(K, 2, 2, 3\), got \(2, 3\)"),
        ({"place": torch.zeros(4, 1, 2, 3)}, r"place must have shape \(K, 2, 2, 3\), got \(4, 1, 2, 3\)"),
        ({"place": np.zeros((4, 2, 2, 3))}, r"place must be a torch\.Tensor, got ndarray"),
        ({"place": torch.zeros(4, 2, 2, 3, dtype=torch.int32)}, r"place must be floating point"),
        ({"textures": []}, r"1 to 32 layers, got 0"),
        ({"textures": [(torch.zeros(2, 2), None)] * 33}, r"1 to 32 layers, got 33"),
        ({"textures": [torch.zeros(2, 5, 5)] * 2}, r"textures\[0\] must be a pair .*, got Tensor"),
        ({"textures": [(torch.zeros(2, 5, 5), None)] * 2}, r"textures\[0\] must have shape \(h, w\)"),
        ({"textures": [(torch.zeros(5, 0), None)] * 2}, r"intensity of textures\[0\] .* got \(5, 0\)"),
        ({"textures": [(torch.zeros(5, 4), torch.zeros(4, 5))] * 2}, r"alpha of textures\[0\] .* \(5, 4\)"),
        ({"textures": [(torch.zeros(5, 4, device="meta"), None)] * 2}, r"must be on cpu, got meta"),
        ({"width": 0}, r"width and height must be >= 1 px, got 0 and 5"),
    ],
)
def test_bad_input_is_refused(change, message):
    given = {"textures": [(torch.zeros(5, 4), None)] * 2, "place": torch.zeros(4, 2, 2, 3)}
    given |= {"width": 6, "height": 5} | change
    with pytest.raises(ValueError, match=message):
        render_layers(given.pop("textures"), given.pop("place"), **given)


def test_bad_motion_is_refused():
    with pytest.raises(ValueError, match=r"motion must have shape \(2, 5, 2\), got \(2, 5\)"):
        affine_places(torch.zeros(2, 5), [0.0], [(3, 3)] * 2, width=4, height=4, duration=1.0)
