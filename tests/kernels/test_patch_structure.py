"""Structure of patches: against the twin, and against known patterns."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from reference import patch_structure as reference

torch = pytest.importorskip("torch")

from dase.kernels import autograd_training as bridge

NAMES = ("angle", "coherence", "strength", "energy", "contrast")
QUIET = np.zeros((1, 2, 40, 40), np.int32)


def attributes(image, counts, *, device, size=40, stride=None):
    """Attributes of all patches by name, each (B, rows, columns)."""
    stride = stride or size
    image, counts = (torch.from_numpy(np.array(a, np.float32)).to(device) for a in (image, counts))
    found = bridge.patch_structure(image, size=size, stride=stride)
    found["contrast"] = bridge.patch_contrast(counts, size=size, stride=stride)
    rows = (image.shape[1] - size) // stride + 1
    return SimpleNamespace(
        **{name: value.cpu().numpy().reshape(len(image), rows, -1) for name, value in found.items()}
    )


def grating(angle, size=42, slope=0.5):
    """Wave whose central differences, not only its derivatives, point along `angle`."""
    y, x = np.indices((size, size))
    return np.sin(np.arcsin(slope * np.cos(angle)) * x + np.arcsin(slope * np.sin(angle)) * y + 0.3)[None]


def inner(image, device):
    """Attributes of the patch in the middle of (1, 42, 42), which touches no image border."""
    found = attributes(image, np.zeros((1, 2, 42, 42)), stride=1, device=device)
    return SimpleNamespace(**{name: getattr(found, name)[0, 1, 1] for name in NAMES})


def apart(a, b):
    """Distance of two angles modulo π [rad]."""
    return abs((a - b + np.pi / 2) % np.pi - np.pi / 2)


def contrast_of(total, device):
    counts = np.stack([total // 2, total - total // 2])[None]
    return attributes(np.zeros((1, *total.shape)), counts, size=len(total), device=device).contrast.item()


@pytest.mark.parametrize("kind", [np.int32, np.float32])
@pytest.mark.parametrize(("size", "stride"), [(4, 3), (9, 9), (16, 5)])
def test_matches_reference(device, rng, kind, size, stride):
    image = rng.random((2, 23, 31)).astype(np.float32)
    counts = (rng.gamma(0.3, 6, (2, 2, 23, 31))).astype(kind)
    assert counts.sum(1).max() > 16  # the open bin is in use
    found = attributes(image, counts, size=size, stride=stride, device=device)
    want = dict(zip(NAMES, reference.attributes(image, counts, size, stride), strict=True))
    assert found.angle.shape == want["angle"].shape
    assert found.angle.dtype == np.float32
    # a direction is as sure as it stands out
    assert (apart(found.angle, want["angle"]) * want["coherence"]).max() < 1e-5
    np.testing.assert_allclose(found.coherence, want["coherence"], atol=1e-5)
    for name in ("strength", "energy", "contrast"):
        np.testing.assert_allclose(getattr(found, name), want[name], rtol=1e-5, err_msg=name)


@pytest.mark.parametrize("degrees", [0, 3.75, 7.5, 30, 45, 89.9, 90, 100, 135, 176.2, 179.9, 180, 225])
def test_angle_is_that_of_a_grating(device, degrees):
    found = inner(grating(np.deg2rad(degrees)), device)
    assert apart(found.angle, np.deg2rad(degrees)) < 1e-4
    assert 0 <= found.angle < np.pi
    assert found.coherence == pytest.approx(1, abs=2e-3)  # root of float32 rounding
    # gradient (slope, 0) along the angle, squared and averaged over the phase
    assert found.strength == pytest.approx(0.5 * np.sqrt(0.5), rel=0.05)
    assert found.energy == pytest.approx(found.strength**2, rel=1e-4)


def test_coherence_of_noise_is_small(device, rng):
    found = attributes(rng.standard_normal((1, 160, 160)), np.zeros((1, 2, 160, 160)), size=80, device=device)
    assert found.coherence.max() < 0.1


def test_flat_patches_are_all_zero(device):
    found = attributes(np.full((1, 40, 40), 0.7), QUIET, device=device)
    assert all(getattr(found, name).item() == 0 for name in NAMES)


def test_contrast_of_a_sharp_edge_beats_a_wide_one(device):
    sharp, wide = np.zeros((40, 40), int), np.zeros((40, 40), int)
    sharp[:, 20] = 8
    wide[:, 16:24] = 1
    assert sharp.sum() == wide.sum()
    # both have 2·40 differing pairs of 2·40·39: 8² and 1² times the density
    density = 80 / (2 * 40 * 39)
    assert contrast_of(sharp, device) == pytest.approx(2 * 80 * 64 * density)
    assert contrast_of(wide, device) == pytest.approx(2 * 80 * density)


def test_contrast_of_isolated_pixels_depends_on_their_events_alone(device):
    few, many, edge = (np.zeros((40, 40), int) for _ in range(3))
    few[2:38:9, 2:38:9] = 12
    many[2:38:9, 2:38:3] = 4
    edge[4:36, 20] = 6
    assert few.sum() == many.sum() == edge.sum()
    assert contrast_of(few, device) == pytest.approx(contrast_of(many, device))
    # the density makes Eq. 12 blind to this kind of focus, as its docstring warns
    assert contrast_of(few, device) > 3 * contrast_of(edge, device)


def test_contrast_adds_channels(device, rng):
    counts = rng.integers(0, 5, (1, 2, 40, 40))
    both = attributes(np.zeros((1, 40, 40)), counts, device=device)
    swapped = attributes(np.zeros((1, 40, 40)), counts[:, ::-1], device=device)
    one = attributes(np.zeros((1, 40, 40)), counts.sum(1, keepdims=True), device=device)
    assert both.contrast == swapped.contrast == one.contrast


def test_brightness_and_gain_leave_the_structure(device, rng):
    image = rng.random((1, 60, 80)).astype(np.float32)
    counts = np.zeros((1, 2, 60, 80), np.int32)
    plain = attributes(image, counts, size=20, device=device)
    brighter = attributes(image + 1, counts, size=20, device=device)
    stronger = attributes(image * 3, counts, size=20, device=device)
    for name in NAMES:
        np.testing.assert_allclose(getattr(brighter, name), getattr(plain, name), rtol=1e-3, atol=1e-5)
    assert apart(stronger.angle, plain.angle).max() < 1e-4
    np.testing.assert_allclose(stronger.coherence, plain.coherence, atol=1e-5)
    np.testing.assert_allclose(stronger.strength, 3 * plain.strength, rtol=1e-5)
    np.testing.assert_allclose(stronger.energy, 9 * plain.energy, rtol=1e-5)


def test_turning_the_image_turns_the_angle(device, rng):
    image = rng.random((1, 40, 40))
    plain, turned = (attributes(i, QUIET, device=device) for i in (image, image.transpose(0, 2, 1)))
    assert apart(turned.angle, np.pi / 2 - plain.angle).max() < 1e-4
    np.testing.assert_allclose(turned.coherence, plain.coherence, atol=1e-5)


def test_grid_covers_what_fits(device):
    large = attributes(np.zeros((2, 260, 346)), np.zeros((2, 2, 260, 346)), device=device)
    assert large.angle.shape == (2, 6, 8)
    image, counts = np.zeros((1, 40, 50)), np.zeros((1, 2, 40, 50))
    assert attributes(image, counts, stride=10, device=device).angle.shape == (1, 1, 2)
