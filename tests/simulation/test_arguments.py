"""Numbers that a user gives are taken as they are or refused: never wrapped, cut or taken modulo any."""

from __future__ import annotations

import numpy as np
import pytest

import dase
from dase import io
from dase.errors import InputError
from dase.events import Events

SENSOR = dase.Sensor()


def scene():
    return dase.VideoScene(np.stack([np.full((4, 6), level, np.float32) for level in (0.1, 0.9)]), [0.0, 0.1])


def some_events():
    t = np.arange(20) * 1e-3
    x = np.zeros(20, np.uint16)
    return Events(t, x, x, x > 0, 6, 4)


@pytest.mark.parametrize("seed", [-1, 2**31, 1.5, 1.0, True, "1", None, np.int64(-5)])
def test_a_seed_is_never_taken_modulo(seed):
    for act in (
        lambda: dase.simulate(scene(), SENSOR, seed=seed),
        lambda: dase.count(scene(), SENSOR, [0, 0.1], seed=seed),
        lambda: dase.compare(some_events(), SENSOR, scene=scene(), seed=seed),
        lambda: dase.fit(some_events(), SENSOR, scene=scene(), seed=seed),
        lambda: dase.diagnose(some_events(), SENSOR, scene=scene(), seed=seed),
    ):
        with pytest.raises(InputError, match=r"seed must be a whole number in 0\.\."):
            act()


def test_the_largest_seed_is_not_the_smallest():
    jitter = dase.load_sensor("davis346")
    one, other = (dase.simulate(scene(), jitter, seed=seed) for seed in (0, 2**31 - 1))
    assert len(one) != len(other) or not np.array_equal(one.t, other.t)


@pytest.mark.parametrize("chunk", [-1, 0, 1.5])
def test_a_chunk_has_at_least_one(tmp_path, chunk):
    with pytest.raises(InputError, match="chunk must be a whole number >= 1"):
        dase.stream(scene(), SENSOR, chunk=chunk)
    with pytest.raises(InputError, match="chunk must be a whole number >= 1"):
        io.stream(tmp_path / "a.h5", chunk=chunk)


@pytest.mark.parametrize("pixels", [[1.7], [1.0], [True, False], [-1], [24], [[1, 2]], [], [2**32], ["1"]])
def test_pixels_are_whole_numbers_on_the_sensor(pixels):
    with pytest.raises(InputError, match="pixels must be whole numbers, indices of the 6x4 sensor"):
        dase.simulate(scene(), SENSOR, pixels=pixels)


@pytest.mark.parametrize("size", [(99999999999, 1), (1, 16385), (0, 4), (70_000, 70_000)])
def test_a_sensor_of_absurd_size_is_refused(tmp_path, size):
    with pytest.raises(InputError, match="size must lie between 1x1 and 16384x16384"):
        dase.Sensor(size=size)
    (tmp_path / "a.toml").write_text(f'name = "a"\nsize = [{size[0]}, {size[1]}]\n[threshold]\non = 0.2\n')
    with pytest.raises(InputError, match=r"a\.toml: .*size must lie between"):
        dase.load_sensor(tmp_path / "a.toml")


def made(**fields):
    columns = {"t": np.zeros(2), "x": np.zeros(2, np.uint16), "y": np.zeros(2, np.uint16)}
    return Events(**({**columns, "p": np.zeros(2, bool), "width": 6, "height": 4} | fields))


@pytest.mark.parametrize("name", ["x", "y"])
def test_coordinates_never_wrap(name):
    for wrong in (np.array([0, 65536]), np.array([-1, 0]), np.array([0.5, 1.0])):
        with pytest.raises(InputError, match=rf"events: {name} must"):
            made(**{name: wrong})
    assert getattr(made(**{name: np.array([3, 65535])}), name).dtype == np.uint16


def test_events_convert_what_loses_nothing():
    e = made(t=np.array([1, 2]), p=np.array([0, 1], np.uint8))
    assert e.t.dtype == np.float64
    assert e.p.tolist() == [False, True]
    with pytest.raises(InputError, match="p must be bool"):
        made(p=np.array([-1, 1]))  # as bool, both would be ON
    with pytest.raises(InputError, match="t must be numbers"):
        made(t=np.array(["a", "b"]))
    with pytest.raises(InputError, match="sensor size must lie between"):
        made(width=65_537)


@pytest.mark.parametrize("seed", [-1, 0.5])
def test_seeds_of_recordings(seed):
    recording = dase.Recording.of(io.Sequence(made()))
    for act in (lambda: recording.subsample(3, seed), lambda: recording.split_pixels(0.5, seed)):
        with pytest.raises(InputError, match="seed must be"):
            act()
