"""Structure of patches: against the twin, against known patterns, and the hash built on it."""

from __future__ import annotations

import json
from dataclasses import fields, replace

import numpy as np
import pytest
import warp as wp
from reference import patch_structure as reference

from dase.errors import InputError
from dase.learning.patch_hash import PatchAttributes, StructureHash, attributes

NAMES = [field.name for field in fields(PatchAttributes)]
QUIET = np.zeros((1, 2, 40, 40), np.int32)


def grating(angle, size=42, slope=0.5):
    """Wave whose central differences, not only its derivatives, point along `angle`."""
    y, x = np.indices((size, size))
    return np.sin(np.arcsin(slope * np.cos(angle)) * x + np.arcsin(slope * np.sin(angle)) * y + 0.3)[None]


def inner(image, device):
    """Attributes of the patch in the middle of (1, 42, 42), which touches no image border."""
    found = attributes(image, np.zeros((1, 2, 42, 42)), stride=1, device=device)
    return PatchAttributes(**{name: getattr(found, name)[:, 1:2, 1:2] for name in NAMES})


def apart(a, b):
    """Distance of two angles modulo π [rad]."""
    return abs((a - b + np.pi / 2) % np.pi - np.pi / 2)


def contrast_of(total, device):
    counts = np.stack([total // 2, total - total // 2])[None]
    return attributes(np.zeros((1, *total.shape)), counts, size=len(total), device=device).contrast.item()


def sample(rng, count=600):
    """Attributes without an image behind them."""
    return PatchAttributes(
        angle=rng.uniform(0, np.pi, (1, count, 1)).astype(np.float32),
        **{name: rng.gamma(2, 1, (1, count, 1)).astype(np.float32) for name in NAMES[1:]},
    )


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


@pytest.mark.parametrize("edge", range(1, 24))
def test_orientation_bins_meet_where_they_should(device, edge):
    boundary = (edge - 0.5) * np.pi / 24
    only_angle = StructureHash(coherence=(), contrast=())
    for offset, bucket in ((-1e-3, edge - 1), (1e-3, edge)):
        assert only_angle.bucket(inner(grating(boundary + offset), device)) == bucket


def test_first_orientation_holds_both_sides_of_zero(rng):
    angle = np.array([0, 0.06, np.pi - 0.06, np.nextafter(np.pi, 0)], np.float32).reshape(1, 4, 1)
    found = replace(sample(rng, 4), angle=angle)
    assert (StructureHash(coherence=(), contrast=()).bucket(found) == 0).all()


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
    assert attributes(np.zeros((2, 260, 346)), np.zeros((2, 2, 260, 346)), device=device).angle.shape == (
        2,
        6,
        8,
    )
    image, counts = np.zeros((1, 40, 50)), np.zeros((1, 2, 40, 50))
    assert attributes(image, counts, stride=10, device=device).angle.shape == (1, 1, 2)


@pytest.mark.parametrize("kind", [wp.int32, wp.float32])
def test_warp_arrays_give_the_same(device, rng, kind):
    image = rng.random((1, 40, 80)).astype(np.float32)
    counts = rng.integers(0, 5, (1, 2, 40, 80)).astype(np.int32)
    plain = attributes(image, counts, device=device)
    warped = attributes(
        wp.array(image, device=device), wp.array(counts, dtype=kind, device=device), device=device
    )
    for name in NAMES:
        np.testing.assert_array_equal(getattr(warped, name), getattr(plain, name))


def test_read_only_and_strided_input(device, rng):
    image = rng.random((1, 80, 80))
    counts = rng.integers(0, 5, (1, 2, 80, 80), np.uint8)
    image.flags.writeable = counts.flags.writeable = False
    found = attributes(image[:, ::2, ::-2], counts[..., ::2, ::-2], device=device)
    want = attributes(image[:, ::2, ::-2].copy(), counts[..., ::2, ::-2].copy(), device=device)
    assert found.energy == want.energy
    assert found.contrast == want.contrast


@pytest.mark.parametrize("contrast_from", ["events", "energy"])
def test_calibrated_boundaries_give_thirds(rng, contrast_from):
    found = [sample(rng, 300), sample(rng, 600)]
    cells = StructureHash.calibrate(*found, orientations=1, contrast_from=contrast_from)
    assert cells.buckets == 9
    bucket = np.concatenate([cells.bucket(part).ravel() for part in found])
    assert (np.bincount(bucket // 3) == 300).all()
    assert (np.bincount(bucket % 3) == 300).all()


def test_ties_stay_together(rng):
    quiet = replace(sample(rng), contrast=np.zeros((1, 600, 1), np.float32))
    cells = StructureHash.calibrate(quiet, orientations=1, coherence_levels=1, contrast_from="events")
    assert cells.contrast == (0, 0)
    assert (cells.bucket(quiet) == 0).all()
    assert (cells.bucket(replace(quiet, contrast=quiet.contrast + 1)) == 2).all()


def test_bucket_is_orientation_major(rng):
    found = sample(rng)
    cells = StructureHash.calibrate(found)
    assert cells.buckets == 216
    bucket = cells.bucket(found)
    assert bucket.dtype == np.int32
    assert bucket.shape == found.angle.shape
    assert 0 <= bucket.min() < 9
    assert 207 <= bucket.max() < 216
    orientation = np.round(found.angle / np.pi * 24).astype(int) % 24
    coherence = (found.coherence > cells.coherence[0]) * 1 + (found.coherence > cells.coherence[1])
    contrast = (found.energy > cells.contrast[0]) * 1 + (found.energy > cells.contrast[1])
    np.testing.assert_array_equal(bucket, (orientation * 3 + coherence) * 3 + contrast)


@pytest.mark.parametrize(
    ("orientations", "coherence", "contrast", "buckets"),
    [(1, 1, 1, 1), (24, 1, 1, 24), (1, 1, 3, 3), (1, 3, 1, 3), (24, 3, 1, 72), (1, 3, 3, 9), (24, 3, 3, 216)],
)
def test_attributes_can_be_left_out(rng, orientations, coherence, contrast, buckets):
    found = sample(rng, 5000)
    cells = StructureHash.calibrate(
        found, orientations=orientations, coherence_levels=coherence, contrast_levels=contrast
    )
    assert cells.buckets == buckets
    assert set(cells.bucket(found).ravel()) == set(range(buckets))


def test_dict_round_trip(rng):
    cells = StructureHash.calibrate(sample(rng), orientations=12, contrast_from="events")
    assert StructureHash.from_dict(json.loads(json.dumps(cells.to_dict()))) == cells
    assert set(cells.to_dict()) == {"orientations", "coherence", "contrast", "contrast_from"}


@pytest.mark.parametrize(
    ("image", "counts", "options", "message"),
    [
        ((40, 40), (1, 2, 40, 40), {}, r"image: shape must be \(B, H, W\)"),
        ((1, 40, 40), (1, 40, 40), {}, r"counts: shape must be \(B, C, H, W\)"),
        ((0, 40, 40), (0, 2, 40, 40), {}, "image: .* nothing empty"),
        ((1, 40, 40), (1, 2, 40, 41), {}, r"must match image \(1, 40, 40\), got \(1, 2, 40, 41\)"),
        ((2, 40, 40), (1, 2, 40, 40), {}, "must match"),
        ((1, 40, 40), (1, 2, 40, 40), {"size": 3}, "integer >= 4 pixels wide, got 3"),
        ((1, 40, 40), (1, 2, 40, 40), {"size": 8.0}, r"integer >= 4 pixels wide, got 8\.0"),
        ((1, 40, 80), (1, 2, 40, 80), {"size": 41}, "fit into the map of 80x40 pixels, got 41"),
        ((1, 40, 40), (1, 2, 40, 40), {"stride": 0}, "stride: must be an integer >= 1"),
        ((1, 40, 40), (1, 2, 40, 40), {"device": "abacus"}, "abacus"),
    ],
)
def test_refuses_what_does_not_fit(device, image, counts, options, message):
    with pytest.raises(InputError, match=message):
        attributes(np.zeros(image), np.zeros(counts), **{"device": device, **options})


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1e300])
@pytest.mark.parametrize(("y", "x"), [(0, 40), (39, 79), (20, 60)])
def test_refuses_nan(device, bad, y, x):
    image, counts = np.zeros((1, 40, 80)), np.zeros((1, 2, 40, 80))
    image[0, y, x] = bad
    # the border of the neighbouring patch sees (0, 40) too
    with pytest.raises(InputError, match=r"image: pixels must be finite, .* patch \(0, [01]\) of map 0"):
        attributes(image, counts, device=device)
    counts[0, 1] = image[0]
    with pytest.raises(InputError, match=r"counts: pixels must be finite, .* patch \(0, 1\) of map 0"):
        attributes(np.zeros((1, 40, 80)), counts, device=device)


def test_refuses_other_types(device):
    for image in ([["a"]], np.zeros((1, 40, 40), complex)):
        with pytest.raises(InputError, match="image: must be real numbers, got dtype"):
            attributes(image, QUIET, device=device)
    with pytest.raises(InputError, match="image: must be an array of shape"):
        attributes([[1, 2], [3]], QUIET, device=device)
    with pytest.raises(InputError, match="image: dtype must be float32, got float64"):
        attributes(wp.zeros((1, 40, 40), dtype=wp.float64, device=device), QUIET, device=device)


@pytest.mark.parametrize(
    ("stored", "message"),
    [
        ({"coherence": [0.2, 0.1], "contrast": []}, "ascending order"),
        ({"coherence": [float("nan")], "contrast": []}, "finite numbers"),
        ({"coherence": 0.3, "contrast": []}, "must list"),
        ({"coherence": [], "contrast": ["a"]}, "StructureHash.contrast must list"),
        ({"coherence": [], "contrast": [], "orientations": 0}, "orientations must be an integer >= 1, got 0"),
        ({"coherence": [], "contrast": [], "contrast_from": "edges"}, "'events' or 'energy', got 'edges'"),
        ({"coherence": []}, "'contrast' is missing"),
        ({"coherence": [], "contrast": [], "orientation": 3}, "did you mean 'orientations'"),
    ],
)
def test_refuses_bad_hashes(stored, message):
    with pytest.raises(InputError, match=message):
        StructureHash.from_dict(stored)


def test_refuses_calibration_without_patches(rng):
    with pytest.raises(InputError, match="at least one patch"):
        StructureHash.calibrate()
    with pytest.raises(InputError, match="coherence_levels must be an integer >= 1, got 0"):
        StructureHash.calibrate(sample(rng), coherence_levels=0)
