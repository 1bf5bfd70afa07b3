"""The CPU's kernel, many pixels at once, against the one that works on one pixel at a time."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.stored_scenes import scene_of

import dase
from dase.effects import EFFECTS
from dase.events import Events
from dase.simulation.pixel_array import PixelArray

DROP = {
    "threshold": dict(on=0.11, off=0.07),
    "mismatch": dict(spread=0.2),
    "bandwidth": dict(cutoff=150.0, dark=0.1),
    "second_order": {},
    "linlog": {},
    "voltage_noise": dict(sigma=0.1, cutoff=100.0),
    "leak": dict(rate=5.0, light=3.0),
    "shot": dict(rate=8.0),
    "hot": dict(share=0.05),
    "dead": dict(share=0.05),
    "refractory": dict(period=2e-3, mode="drop"),
    "flicker": dict(frequency=100.0, depth=0.3),
    "vignetting": {},
    "dark": {},
    "latency": {},
}
"""Every effect on the pixels, with values at which it acts."""

SENSORS = {
    "threshold, leak": {name: DROP[name] for name in ("threshold", "leak")},
    "davis": {
        name: DROP[name] for name in ("threshold", "mismatch", "bandwidth", "leak", "shot", "refractory")
    },
    "all, drop": DROP,
    "all, delay, jitter": DROP | {"refractory": dict(period=2e-3, mode="delay"), "jitter": dict(spread=0.1)},
    "all, reset, jitter": DROP
    | {
        "refractory": dict(period=2e-3, after_off=1.5, spread=0.2, mode="reset"),
        "jitter": dict(spread=0.1),
    },
}


def sensor_of(name, kind):
    light = {"flicker", "vignetting", "dark"}
    chosen = {n: v for n, v in SENSORS[name].items() if kind != "log" or n not in light}
    return dase.Sensor(tuple(EFFECTS[n](**values) for n, values in chosen.items()))


def run(sensor, scene, lanes, monkeypatch, *, labels):
    """Return events by chunks of 17 samples, then counts of the same sensor, and the last states."""
    monkeypatch.setattr(PixelArray, "_count_lanes", lambda self, source: lanes)
    monkeypatch.setattr(PixelArray, "_one_pixel_per_thread", lanes == 0)
    times, out = scene.sample_times(), []
    array = PixelArray(sensor, scene.width, scene.height, seed=3, labels=labels)
    for begin in range(0, len(times), 17):
        out.append(array.emit(scene, times[begin : begin + 17])[0])
    other = PixelArray(sensor, scene.width, scene.height, seed=3)
    windows = (np.arange(len(times)) // 9).astype(np.int32)
    counts = other.count_events(scene, times, windows, int(windows[-1]) + 1).numpy()
    return Events.concatenate(out), counts, array._state.numpy(), other._state.numpy()


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("threshold, leak", "log"),
        ("davis", "background"),
        pytest.param("all, drop", "layers", marks=pytest.mark.slow),
        pytest.param("all, delay, jitter", "frames", marks=pytest.mark.slow),
    ],
)
def test_any_number_of_pixels_at_once_gives_the_same_bits(name, kind, device, rng, monkeypatch):
    if device != "cpu":
        pytest.skip("blocks of pixels are for the CPU")
    scene, sensor = scene_of(kind, rng, device), sensor_of(name, kind)
    labels = kind in ("layers", "frames")
    alone = run(sensor, scene, 0, monkeypatch, labels=labels)
    assert len(alone[0]) > 500
    for lanes in (1, 16):
        got = run(sensor, scene, lanes, monkeypatch, labels=labels)
        for field in ("t", "x", "y", "p", *(["label"] if labels else [])):
            np.testing.assert_array_equal(getattr(got[0], field), getattr(alone[0], field), err_msg=field)
        for ours, theirs in zip(got[1:], alone[1:], strict=True):
            np.testing.assert_array_equal(ours, theirs)
