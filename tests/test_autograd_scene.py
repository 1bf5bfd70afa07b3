"""Rendering of moving layers: equal to `LayerScene`, with the gradients of a plain torch twin."""

from __future__ import annotations

import math

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the bridge needs torch")

from dase.images import Picture
from dase.kernels import launch
from dase.kernels.autograd_scene import affine_places, render
from dase.layers import Layer, LayerScene, Motion

WIDTH, HEIGHT = 40, 30
FIELDS = ("x", "y", "angle", "scale_x", "scale_y")


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


def sizes_of(textures):
    return [tuple(grey.shape) for grey, _ in textures]


def random_scene(rng, count, device, samples=3):
    textures = random_layers(rng, count, device)
    motion = random_motion(rng, len(textures), device)
    times = torch.linspace(0, 1, samples)
    place = affine_places(motion, times, sizes_of(textures), width=WIDTH, height=HEIGHT, duration=1.0)
    return textures, place


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
    got, want = render(textures, place, width=width, height=height), twin(textures, place, width, height)
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
    frames = render([(grey, None), (front, alpha)], place, width=12, height=12)
    by_grey, by_front, by_alpha = torch.autograd.grad(frames.sum(), (grey, front, alpha))
    assert not by_grey.any()
    torch.testing.assert_close(by_front, torch.ones_like(front))
    torch.testing.assert_close(by_alpha, torch.full_like(alpha, 0.75 - 0.25))


def test_moving_a_constant_background_changes_nothing(device):
    # pixels lie on texels exactly, those of the last row and column on the fold
    textures = [(torch.full((6, 9), 0.5, device=device), None)]
    place = torch.eye(2, 3, device=device).repeat(1, 1, 1, 1).requires_grad_()
    frames = render(textures, place, width=9, height=6)
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
    want = scene.arrays(times, launch.device(device)).place.numpy()
    places = affine_places(motion, times, sizes_of(textures), width=WIDTH, height=HEIGHT, duration=0.7)
    np.testing.assert_allclose(places.cpu(), want, rtol=0, atol=1e-5)
    frames = render(textures, torch.tensor(want, device=device), width=WIDTH, height=HEIGHT)
    np.testing.assert_array_equal(frames.cpu(), scene.frames(times, device))
    assert frames.std() > 0.1


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
        return (render(layers, place, width=width, height=height).double() * weight).sum()

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
    target = render(textures, places(fixed), width=96, height=72)
    guess = torch.zeros(2, 2, device=device, requires_grad=True)
    optimiser = torch.optim.LBFGS([guess], max_iter=25, line_search_fn="strong_wolfe")

    def loss():
        optimiser.zero_grad()
        moving = motion.clone()
        moving[1, :2] = guess
        error = (render(textures, places(moving), width=96, height=72) - target).square().sum()
        error.backward()
        return error

    optimiser.step(loss)
    torch.testing.assert_close(guess.detach(), true, rtol=0, atol=1e-3)  # a tenth of a pixel


def test_no_grad_autocast_strides_and_dtypes(device, rng):
    textures, place = random_scene(rng, 2, device)
    place.requires_grad_()
    want = render(textures, place, width=WIDTH, height=HEIGHT)
    (gradient,) = torch.autograd.grad(want.square().sum(), place)
    with torch.no_grad():
        assert not render(textures, place, width=WIDTH, height=HEIGHT).requires_grad
    with torch.inference_mode():
        render(textures, place, width=WIDTH, height=HEIGHT)
    strided = [tuple(None if t is None else t.mT.contiguous().mT for t in layer) for layer in textures]
    turned = place.permute(3, 2, 1, 0).contiguous().permute(3, 2, 1, 0)
    assert not turned.is_contiguous()
    assert not strided[1][0].is_contiguous()
    got = render(strided, turned, width=WIDTH, height=HEIGHT)
    torch.testing.assert_close(got, want, rtol=0, atol=0)
    # the sum expands, so its gradient is not contiguous either
    (summed,) = torch.autograd.grad(got.sum(), place)
    assert summed.abs().max() > 1
    with torch.autocast(torch.device(device).type, torch.bfloat16):
        got = render(textures, place, width=WIDTH, height=HEIGHT)
        assert got.dtype == torch.float32
        loss = got.square().sum()
    torch.testing.assert_close(torch.autograd.grad(loss, place)[0], gradient, rtol=1e-4, atol=1e-3)
    double = place.detach().double().requires_grad_()
    got = render(textures, double, width=WIDTH, height=HEIGHT)
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
    every = torch.autograd.grad(render(textures, leaves[-1], width=WIDTH, height=HEIGHT).sum(), leaves)
    fixed = [tuple(None if t is None else t.detach() for t in layer) for layer in textures]
    frames = render(fixed, leaves[-1], width=WIDTH, height=HEIGHT)
    torch.testing.assert_close(torch.autograd.grad(frames.sum(), leaves[-1])[0], every[-1])
    frames = render(textures, leaves[-1].detach(), width=WIDTH, height=HEIGHT)
    for g, w in zip(torch.autograd.grad(frames.sum(), leaves[:-1]), every[:-1], strict=True):
        torch.testing.assert_close(g, w)


def test_threads_do_not_change_gradients(rng):
    textures, place = random_scene(rng, 4, "cpu", samples=8)
    leaves = leaves_of(textures, place.detach())
    before, found = launch.threads(), []
    try:
        for count in (1, 3, 20):
            launch.set_threads(count)
            frames = render(textures, leaves[-1], width=WIDTH, height=HEIGHT)
            found.append(torch.autograd.grad(frames.sum(), leaves))
    finally:
        launch.set_threads(before)
    for other in found[1:]:
        for g, w in zip(other, found[0], strict=True):
            torch.testing.assert_close(g, w, rtol=1e-4, atol=1e-4 * w.abs().max().item())


def test_places_that_are_not_numbers_stay_inside_the_textures(device, rng):
    textures, place = random_scene(rng, 2, device)
    for value in (math.nan, math.inf, 1e30):
        lost = torch.full_like(place, value).requires_grad_()
        render(textures, lost, width=WIDTH, height=HEIGHT).sum().backward()


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
        render(given.pop("textures"), given.pop("place"), **given)


def test_bad_motion_is_refused():
    with pytest.raises(ValueError, match=r"motion must have shape \(2, 5, 2\), got \(2, 5\)"):
        affine_places(torch.zeros(2, 5), [0.0], [(3, 3)] * 2, width=4, height=4, duration=1.0)
