"""Representations equal their plain twins for events, arrays and tensors, and keep what they promise."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from reference import representations as reference

import dase

EDGES = np.array([0.1, 0.2, 0.35, 0.5, 0.9])
HISTOGRAM = dase.StackedHistogram(4, cutoff=2)
SURFACES = dase.AveragedTimeSurface(0.1, span=0.2, cell=4, surface=5)

TWINS = {
    "voxels": (dase.Voxels(5), lambda e, a, b: reference.voxels(e, 5, a, b)),
    "one bin": (dase.Voxels(1), lambda e, a, b: reference.voxels(e, 1, a, b)),
    "normalised": (
        dase.Voxels(3, normalise=True),
        lambda e, a, b: reference.normalised(reference.voxels(e, 3, a, b)),
    ),
    "counts": (dase.CountImage(), reference.counts),
    "histogram": (HISTOGRAM, lambda e, a, b: reference.histogram(e, 4, a, b, 2)),
    "frame": (dase.EventFrame(), reference.last_polarity),
    "averaged": (SURFACES, lambda e, a, b: reference.averaged_time_surface(e, 0.1, 0.2, 4, 5, a, b)),
}


@pytest.fixture
def events(rng):
    """So many on so few pixels that they meet, some at one time, none at an edge of a bin."""
    n = 400
    t = np.sort(np.round(rng.uniform(0, 1, n), 3)) + 3e-4
    return dase.Events(t, rng.integers(0, 9, n), rng.integers(0, 7, n), rng.random(n) < 0.6, 9, 7)


def kinds(events):
    """Return the same events in every form that is taken."""
    columns = events.t, events.x.astype(int), events.y.astype(int), events.p
    table = np.empty(len(events), [("x", "i2"), ("y", "i2"), ("t", "f8"), ("p", "i1")])
    for name, column in zip("txyp", columns, strict=True):
        table[name] = column
    table["p"] = 2 * table["p"] - 1
    yield events, {}
    yield columns, {"size": (9, 7)}
    yield table, {"size": (9, 7)}


@pytest.mark.parametrize("name", TWINS)
def test_twin(name, events):
    represent, twin = TWINS[name]
    want = np.stack([twin(events, a, b) for a, b in pairwise(EDGES)])
    assert np.abs(want).max() > 0
    for given, options in kinds(events):
        got = represent(given, edges=EDGES, **options)
        assert got.dtype == np.float32
        assert got.shape == want.shape
        if name != "averaged":
            assert got.shape[1] == represent.channels
        np.testing.assert_allclose(got, want, atol=1e-5)


@pytest.mark.parametrize("name", [*TWINS, "surface"])
def test_tensors_stay_on_their_device(name, events, device):
    torch = pytest.importorskip("torch")
    represent = dase.TimeSurface(0.3) if name == "surface" else TWINS[name][0]
    where = device if device != "cpu" else "cpu"
    columns = [torch.from_numpy(c).to(where) for c in (events.t, events.x.astype(int), events.y.astype(int))]
    got = represent((*columns, torch.from_numpy(events.p).to(where)), edges=EDGES, size=(9, 7))
    assert got.device == columns[0].device
    assert got.dtype == torch.float32
    np.testing.assert_allclose(got.cpu().numpy(), represent(events, edges=EDGES), atol=1e-5)


def test_time_surface_remembers_from_window_to_window(events):
    edges = np.linspace(0.1, 0.9, 5)
    got = dase.TimeSurface(0.3)(events, edges=edges)
    want = [reference.time_surface(events, 0.3, 0.1, now) for now in edges[1:]]
    np.testing.assert_allclose(got, want, atol=1e-6)


def test_sum_of_voxels_is_the_signed_count(events):
    grids = dase.Voxels(7)(events, edges=EDGES)
    off, on = np.moveaxis(dase.CountImage()(events, edges=EDGES), 1, 0)
    np.testing.assert_allclose(grids.sum(1), on - off, atol=1e-5)
    np.testing.assert_array_equal(np.stack([off, on], 1), events.counts(EDGES))
    assert np.abs(on - off).max() > 0


@pytest.mark.parametrize("name", TWINS)
def test_time_has_no_origin(name, events):
    """A power of two is added without rounding to times that are multiples of a smaller one."""
    represent = TWINS[name][0]
    t = np.round(events.t * 1024) / 1024
    before = dase.Events(t, events.x, events.y, events.p, 9, 7)
    after = dase.Events(t + 64, events.x, events.y, events.p, 9, 7)
    edges = np.array([0.125, 0.25, 0.5])
    np.testing.assert_array_equal(represent(before, edges=edges), represent(after, edges=edges + 64))


def test_swapped_polarity(events):
    swapped = dase.Events(events.t, events.x, events.y, ~events.p, 9, 7)
    np.testing.assert_allclose(dase.Voxels(5)(swapped), -dase.Voxels(5)(events), atol=1e-6)
    np.testing.assert_array_equal(dase.EventFrame()(swapped), -dase.EventFrame()(events))
    np.testing.assert_array_equal(dase.CountImage()(swapped), dase.CountImage()(events)[::-1])


def test_one_window_holds_its_end(events):
    """From the first event to the last one, as E2VID and tonic take it."""
    assert dase.CountImage()(events).sum() == len(events)
    assert dase.CountImage()(events, events.t[0], events.t[-1]).sum() == len(events)
    inside = (events.t >= 0.2) & (events.t <= 0.3)
    assert dase.CountImage()(events, 0.2, 0.3).sum() == inside.sum() > 0
    grid = dase.Voxels(3)(events.select(slice(0, 1)))
    assert np.abs(grid[0]).sum() == 1
    assert np.abs(grid[1:]).sum() == 0


def test_no_events():
    none = dase.Events.empty(9, 7)
    for represent in (dase.Voxels(5, normalise=True), HISTOGRAM, dase.TimeSurface(1.0), dase.EventFrame()):
        assert represent(none).shape == (represent.channels, 7, 9)
        assert not represent(none, edges=EDGES).any()
    assert SURFACES(none).shape == (50, 1, 2)


@pytest.mark.parametrize(
    ("act", "sentence"),
    [
        (lambda e: dase.Voxels(0), "bins must be a whole number >= 1, got 0"),
        (lambda e: dase.StackedHistogram(3, cutoff=0), "cutoff must be > 0 events, got 0"),
        (lambda e: dase.TimeSurface(0.0), "tau must be > 0, got 0.0"),
        (lambda e: dase.AveragedTimeSurface(1.0, surface=4), "surface must be odd, got 4"),
        (lambda e: dase.Voxels(3)(e, edges=[0.2, 0.1]), "window edges must increase"),
        (lambda e: dase.Voxels(3)(e, 0.1, edges=[0.2, 0.3]), "by begin and end or by edges"),
        (lambda e: dase.Voxels(3)((e.t, e.x, e.y, e.p)), "need size=\\(width, height\\)"),
        (lambda e: dase.Voxels(3)((e.t, e.x, e.y, e.p), size=(8, 7)), "on the 8x7 sensor, got columns 0..8"),
        (lambda e: dase.Voxels(3)((e.t, e.x[1:], e.y, e.p), size=(9, 7)), "must have one shape"),
        (lambda e: dase.Voxels(3)({"t": e.t, "x": e.x}), "lack y, p"),
        (lambda e: dase.Voxels(3)(3.0), "must be Events or columns"),
    ],
)
def test_refusals(act, sentence, events):
    with pytest.raises(dase.InputError, match=sentence):
        act(events)
