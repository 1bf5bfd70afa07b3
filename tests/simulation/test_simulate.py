"""What users call in Python: frames and sensors however they are given, and sweeps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import dase
from dase.effects import EFFECTS
from dase.scenes.video import VideoScene, as_scene
from dase.simulation.sensor_file import as_sensor
from dase.simulation.sweep import Sweep


@pytest.fixture
def frames(rng) -> np.ndarray:
    """Grey squares that get lighter and darker, uint8, shape (F, H, W)."""
    levels = rng.integers(20, 236, (12, 3, 4))
    return np.repeat(np.repeat(levels, 2, 1), 2, 2).astype(np.uint8)


def same(a: dase.Events, b: dase.Events) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in "txyp")


def test_frames_of_all_types_are_one_scene(frames):
    want = dase.simulate(VideoScene(frames / np.float32(255), np.arange(12) / 1000), dase.Sensor())
    assert len(want) > 100
    assert same(dase.simulate(frames, dase.Sensor(), fps=1000), want)
    assert same(dase.simulate(frames / np.float32(255), dase.Sensor(), fps=1000), want)
    assert same(dase.simulate(frames, dase.Sensor(), times=np.arange(12) / 1000), want)
    wide = frames.astype(np.uint16) * 257  # 255 becomes 65535
    assert abs(len(dase.simulate(wide, dase.Sensor(), fps=1000)) - len(want)) <= 2
    parts = list(dase.stream(frames, dase.Sensor(), fps=1000, chunk=3))
    assert len(parts) == 4
    assert same(dase.Events.concatenate(parts), want)
    counts = dase.count(frames, dase.Sensor(), [0, 0.005, 0.011], fps=1000)
    assert abs(int(counts.sum()) - len(want)) <= 2


def test_sensors_however_given(frames, tmp_path):
    sensor = dase.load_sensor("davis346")
    path = tmp_path / "mine.toml"
    path.write_text(dase.dump_sensor(sensor), "utf-8")
    want = dase.simulate(frames, sensor, fps=1000)
    for given in ("davis346", path, str(path)):
        assert same(dase.simulate(frames, given, fps=1000), want)
    assert as_sensor(sensor) is sensor


@pytest.mark.parametrize(
    ("change", "options", "says"),
    [
        (lambda f: f, {}, "fps=1000"),
        (lambda f: f, {"fps": 10, "times": np.arange(12)}, "either fps"),
        (lambda f: f, {"fps": 0}, "fps must be a number > 0"),
        (lambda f: f, {"times": np.arange(3)}, "need as many times"),
        (lambda f: f[0], {"fps": 10}, r"shape \(6, 8\)"),
        (lambda f: f.astype(np.int64), {"fps": 10}, "type int64"),
        (lambda f: f.astype(np.float32), {"fps": 10}, r"must lie in \[0, 1\]"),
        (lambda f: as_scene(f, fps=10), {"fps": 10}, "knows its own times"),
    ],
)
def test_what_is_no_scene_is_one_sentence(frames, change, options, says):
    with pytest.raises(dase.InputError, match=says):
        dase.simulate(change(frames), "davis346", **options)


def test_what_is_no_sensor_is_one_sentence(frames):
    with pytest.raises(dase.InputError, match="did you mean 'davis346'"):
        dase.simulate(frames, "davis34", fps=10)
    with pytest.raises(TypeError, match="a preset's name or a path, got int"):
        dase.simulate(frames, 346, fps=10)  # type: ignore[arg-type]


def one_by_one(frames: np.ndarray, sensors: list[dase.Sensor]) -> np.ndarray:
    """Events per pixel of each sensor, counted apart, (V, 2, N)."""
    parts = [dase.count(frames, sensor, [0, 0.011], seed=2, fps=1000)[0, 0] for sensor in sensors]
    return np.stack(parts)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("threshold.on", [0.1, 0.2, 0.5]),
        ("shot.rate", [0.0, 5.0, 500.0]),
        ("bandwidth.cutoff", [50.0, 5000.0]),  # asks for finer samples
        ("latency.delay", [0.0, 1e-3]),  # moves events
        ("sensor.log_eps", [1e-3, 0.1]),
    ],
)
def test_a_sweep_is_what_its_values_give_one_by_one(frames, name, values, device):
    effect, parameter = name.split(".")
    sensor = dase.Sensor((EFFECTS["threshold"](),))
    if effect not in ("threshold", "sensor"):
        sensor = sensor.with_effect(EFFECTS[effect]())
    found = dase.sweep(frames, sensor, name, values, fps=1000, seed=2, device=device)
    sensors = [
        replace(sensor, log_eps=value)
        if effect == "sensor"
        else sensor.with_effect(replace(sensor[effect], **{parameter: value}))
        for value in values
    ]
    want = one_by_one(frames, sensors)
    if device == "cpu":
        np.testing.assert_array_equal(found.counts, want)
    else:
        np.testing.assert_allclose(found.counts.sum(), want.sum(), rtol=1e-3)
    np.testing.assert_allclose(found.on, found.counts[:, 1].mean(-1) / 0.011)
    np.testing.assert_allclose(found.off, found.counts[:, 0].mean(-1) / 0.011)


def test_a_bus_is_counted_behind_where_it_is_swept_itself(frames):
    sensor = dase.Sensor((EFFECTS["threshold"](),)).with_effect(EFFECTS["readout"](mode="drop"))
    rates = [2e4, 1e9]
    found = dase.sweep(frames, sensor, "readout.rate", rates, fps=1000)
    streams = [
        dase.simulate(frames, sensor.with_effect(replace(sensor["readout"], rate=rate)), fps=1000)
        for rate in rates
    ]
    want = [events.slice(-1.0, 0.011 + 1e-9).counts([-1.0, 1.0])[0] for events in streams]
    np.testing.assert_array_equal(found.counts.sum(2), np.sum(want, (2, 3)))
    assert found.counts[0].sum() < 0.5 * found.counts[1].sum()
    np.testing.assert_array_equal(
        dase.sweep(frames, sensor, "threshold.on", [0.2], fps=1000).counts[0],
        dase.sweep(frames, sensor.without("readout"), "threshold.on", [0.2], fps=1000).counts[0],
    )


def test_a_sweep_is_a_short_table(frames):
    found = dase.sweep(frames, "davis346", "threshold.on", np.geomspace(0.1, 1, 5), fps=1000)
    assert isinstance(found, Sweep)
    assert len(found) == 5
    assert np.all(np.diff(found.on) <= 0)
    lines = repr(found).splitlines()
    assert len(lines) == 6
    assert lines[0].split() == [
        "threshold.on", "[log", "intensity]", "ON", "[1/pixel/s]", "OFF", "[1/pixel/s]",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "values", "says"),
    [
        ("threshold", [1], "must be effect.parameter"),
        ("dead.share", [0.1], r"add it before, as in sensor.with_effect\(dase.EFFECTS\['dead'\]\(\)\)"),
        ("treshold.on", [1], "did you mean 'threshold'"),
        ("threshold.of", [1], "did you mean 'off'"),
        ("threshold.on", [], r"shape \(V,\)"),
        ("threshold.on", [-1], "must lie in"),
    ],
)
def test_what_cannot_be_swept_is_one_sentence(frames, name, values, says):
    with pytest.raises(dase.InputError, match=says):
        dase.sweep(frames, dase.Sensor(), name, values, fps=1000)
