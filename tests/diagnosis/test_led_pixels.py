"""Pixels that send with their light alone are not hot."""

import numpy as np
import pytest

import dase
from dase.diagnosis.led_pixels import follow_the_light
from dase.diagnosis.seen_effects import find_seen_effects
from dase.fitting.measurement import Measurement
from dase.signatures.kinds import HOT_PIXELS
from dase.signatures.result import Answer, Signature

WIDTH, HEIGHT = 24, 18
PLACES = [[4, 4], [12, 9], [19, 6], [8, 14]]


def clip(moves):
    """A ramp that moves in two stretches of two seconds, or always, or never."""
    times = np.arange(0, 2.0, 1e-3)
    going = {
        "at times": ((times % 1.0) > 0.3) & ((times % 1.0) < 0.6), "always": times >= 0, "never": times < 0
    }[moves]  # fmt: skip
    far = np.cumsum(going) * 0.002
    level = 0.1 + 0.8 * np.abs((np.linspace(0, 1, WIDTH)[None] + far[:, None]) % 1 - 0.5)
    frames = np.broadcast_to(level[:, None, :], (len(times), HEIGHT, WIDTH)).astype(np.float32)
    return dase.VideoScene(frames, times)


def events_of(times):
    t = np.concatenate(times)
    x, y = (np.repeat([p[k] for p in PLACES], [len(one) for one in times]) for k in (0, 1))
    order = np.argsort(t, kind="stable")
    return dase.Events(
        t[order], x[order].astype(np.uint16), y[order].astype(np.uint16), np.ones(len(t), bool), WIDTH, HEIGHT
    )


def entry():
    return Signature(
        name=HOT_PIXELS,
        answer=Answer.FOUND,
        p=0.0,
        size=4.0,
        least=3.0,
        sentence="",
        details={"pixels": PLACES},
    )


def sent(rng, with_light):
    """Times of the events of each pixel: of some with the light, 2 ms late, of the others at any time."""
    any_time = rng.uniform(0, 2.0, (len(PLACES), 40))
    led = 0.302 + rng.integers(0, 2, any_time.shape) + 0.3 * rng.random(any_time.shape)
    return list(np.where(np.arange(len(PLACES))[:, None] < with_light, led, any_time))


@pytest.mark.parametrize("with_light", [0, 1, 2, 4])
def test_pixels_that_rest_with_their_light_are_led(rng, with_light):
    events = events_of(sent(rng, with_light))
    assert follow_the_light(entry(), events, clip("at times")) == (with_light >= 2)


@pytest.mark.parametrize("moves", ["always", "never"])
def test_light_that_always_or_never_changes_tells_nothing(rng, moves):
    assert not follow_the_light(entry(), events_of(sent(rng, 4)), clip(moves))


def test_a_diagnosis_calls_no_led_pixel_hot(rng):
    """Some pixels of another simulator have thresholds close to zero."""
    width, height = 96, 72
    times = np.arange(0, 2.0, 1e-3)
    far = 0.01 * np.cumsum(((times % 1.0) > 0.3) & ((times % 1.0) < 0.6))
    picture = np.linspace(0.1, 0.9, width + 16)
    frames = np.stack([np.interp(np.arange(width) + d, np.arange(width + 16), picture) for d in far])
    scene = dase.VideoScene(np.repeat(frames[:, None], height, 1).astype(np.float32), times)
    thresholds = [dase.EFFECTS["threshold"](on=c, off=c) for c in (0.01, 0.5)]
    sharp, usual = (dase.load_sensor("ideal").with_effect(one) for one in thresholds)
    few, many = dase.simulate(scene, sharp, seed=1), dase.simulate(scene, usual, seed=2)
    chosen = np.isin(few.y.astype(int) * width + few.x, rng.choice(width * height, 9, replace=False))
    events = dase.Events.concatenate([few.select(chosen), many])
    events = events.select(np.argsort(events.t, kind="stable"))
    assert dase.find_signatures(events)["hot pixels"].found
    assert find_seen_effects(Measurement(events, scene), dase.EFFECTS).entry_of(HOT_PIXELS) is None
