"""Pixels that begin with the next chunk before the events of this one are ordered: the same events."""

import numpy as np
import pytest

import dase
from dase.effects.latency import Latency
from dase.effects.threshold import Threshold
from dase.scenes.image_sources import open_images
from dase.scenes.layers import Layer, LayerScene, Motion
from dase.simulation.pixel_array import PixelArray
from dase.simulation.sensor_run import ChunkSettings, SensorRun


@pytest.fixture(scope="module")
def scene():
    images, rng = open_images("builtin"), np.random.default_rng(3)
    layers = [Layer(images.background(rng), Motion(x=(0, 0.2)))]
    return LayerScene(layers, width=40, height=30, duration=0.1, shortest=1e-3, longest=1e-3)


def run_events(scene, sensor, device, **options):
    run = SensorRun(scene, sensor, device=device, chunk=7, **options)
    return run.events(), run.pixel_array


def assert_same(got, want):
    for a, b in zip(got, want, strict=True):
        for column in "txyp":
            np.testing.assert_array_equal(getattr(a, column), getattr(b, column))
        if b.label is not None:
            np.testing.assert_array_equal(a.label, b.label)


@pytest.mark.parametrize("name", ["ideal", "davis346", "latency"])
@pytest.mark.parametrize("labels", [False, True])
def test_events_do_not_depend_on_pixels_being_ahead(device, scene, name, labels):
    sensor = dase.load_sensor("davis346" if name == "latency" else name)
    if name == "latency":
        sensor = sensor.with_effect(Latency(delay=0.02))
    options = {"labels": labels}
    want, _ = run_events(scene, sensor, device, settings=ChunkSettings(ahead=False), **options)
    got, array = run_events(
        scene, sensor, device, settings=ChunkSettings(ahead=True), events_per_pixel=0, **options
    )
    # no event fits at first: chunks ran again while the next one had begun
    assert len(want[0]) > 1000
    assert array.emitted_again > 1
    assert_same(got, want)


def test_a_batch_does_not_depend_on_pixels_being_ahead(device, scene):
    sensor = dase.load_sensor("davis346")
    vectors = np.repeat(sensor.parameters()[None], 3, 0)
    vectors[1, :2] *= 1.5
    want, _ = run_events(scene, sensor, device, settings=ChunkSettings(ahead=False), parameters=vectors)
    got, _ = run_events(scene, sensor, device, settings=ChunkSettings(ahead=True), parameters=vectors)
    assert len(got) == 3
    assert len(got[1]) != len(got[0])
    assert_same(got, want)


@pytest.mark.parametrize("ahead", [False, True])
def test_threads_of_one_pixel_keep_all_events_of_a_sample(device, scene, monkeypatch, ahead):
    """As a GPU's do: events wait for the end of their sample, with room that grows."""
    sensor = dase.load_sensor("davis346").without("refractory").with_effect(Threshold(on=0.02, off=0.02))
    want, _ = run_events(scene, sensor, device)
    monkeypatch.setattr(PixelArray, "_one_pixel_per_thread", True)
    got, array = run_events(scene, sensor, device, settings=ChunkSettings(ahead=ahead))
    assert array._later_room > 4
    assert array.emitted_again > 0
    assert_same(got, want)
