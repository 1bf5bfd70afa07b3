"""A scene in which nothing happens: only noise makes events, as much as it should."""

from __future__ import annotations

import numpy as np
import pytest

import dase


def test_without_noise_nothing_happens(device):
    scene = dase.StaticScene(8, 6, 2.0, 0.3)
    assert len(dase.simulate(scene, dase.Sensor(), device=device)) == 0
    assert scene.sample_times()[[0, -1]].tolist() == [0.0, 2.0]
    np.testing.assert_array_equal(scene.frames(np.array([0.0, 1.3]), device), np.float32(0.3))
    assert not scene.flow(np.zeros(2)).any()


def test_leak_and_shot_noise_come_at_their_rates(device):
    """A leak of 2 Hz makes 2 ON events a second; shot noise adds to both polarities, more in the dark."""
    effects = dase.EFFECTS
    leaking = dase.Sensor((effects["threshold"](), effects["leak"](rate=2.0)))
    scene = dase.StaticScene(40, 30, 10.0, 0.5)
    off, on = dase.count(scene, leaking, [0, 10.0], device=device)[0, 0].sum(1)
    assert off == 0
    assert on == pytest.approx(2 * 10 * 1200, rel=0.06)
    noisy = dase.Sensor((effects["threshold"](), effects["shot"](rate=3.0)))
    light = np.full((30, 40), 1.0, np.float32)
    light[:, :20] = 0.02
    counts = dase.count(dase.StaticScene(40, 30, 10.0, light), noisy, [0, 10.0], device=device)[0, 0]
    dark, bright = counts.sum(0).reshape(30, 2, 20).sum((0, 2))
    assert dark > 1.5 * bright
    assert abs(counts[0].sum() - counts[1].sum()) < 5 * np.sqrt(counts.sum())


def test_the_same_light_as_a_video_makes_the_same_noise(device):
    effects = dase.EFFECTS
    sensor = dase.Sensor((effects["threshold"](), effects["shot"](rate=3.0), effects["leak"](rate=0.5)))
    scene = dase.StaticScene(12, 10, 3.0, 0.1, longest=0.05)
    times = scene.sample_times()
    video = dase.VideoScene(np.full((len(times), 10, 12), 0.1, np.float32), times)
    a, b = (dase.simulate(s, sensor, seed=3, device=device) for s in (scene, video))
    assert len(a) > 300
    for name in "txyp":
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0, 5, 1.0), "at least 1x1, got 0x5"),
        ((5, 5, -1.0), "duration must be > 0 s, got -1"),
        ((5, 4, 1.0, np.ones((5, 4))), r"a number or \(4, 5\), got \(5, 4\)"),
        ((5, 4, 1.0, -0.1), "finite and >= 0"),
        ((5, 4, 1.0, np.nan), "finite and >= 0"),
    ],
)
def test_bad_input_gets_a_sentence(arguments, message):
    with pytest.raises(dase.InputError, match=message):
        dase.StaticScene(*arguments)
