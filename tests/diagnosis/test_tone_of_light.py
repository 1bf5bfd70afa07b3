"""A tone that the light of a clip has by itself is not a lamp that the clip lacks."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from dase.diagnosis.tone_of_light import is_tone_of_light, swing_of_light
from dase.events import Events
from dase.fitting.measurement import Measurement
from dase.scenes.video import VideoScene
from dase.signatures import kinds
from dase.signatures.result import Answer, Signature

EVERY = 1 / 400


def pan(rng, speed: float, swing: float = 0.0) -> Measurement:
    """Return the light of a picture that moves by `speed` [px/s] between pixels, under a lamp of 120 Hz."""
    picture = 0.1 + 0.8 * (gaussian_filter(rng.random((24, 200)), 0.7) > 0.5)
    t = np.arange(320) * EVERY
    at = speed * t[:, None] + np.arange(40)
    whole, part = np.floor(at).astype(int), at % 1
    frames = (1 - part) * picture[:, whole] + part * picture[:, whole + 1]
    frames = frames.transpose(1, 0, 2) * (1 + swing * np.sin(2 * np.pi * 120 * t))[:, None, None]
    return seen_of(VideoScene(frames.astype(np.float32), t))


def seen_of(scene: VideoScene) -> Measurement:
    """Return a measurement of a scene; its events are not looked at."""
    return Measurement(Events.empty(scene.width, scene.height), scene)


def flicker(frequency: float, size: float) -> Signature:
    """Return flicker as it is seen in events."""
    return Signature(
        name=kinds.FLICKER, answer=Answer.FOUND, size=size, sentence="", details={"frequency": frequency}
    )


def test_a_pan_swings_as_often_as_it_goes_by_a_pixel(rng):
    seen = pan(rng, 130.0)
    swing = swing_of_light(seen, 130.0, 130.0, log_eps=0.01)
    assert swing > 5 * swing_of_light(seen, 97.0, 97.0, log_eps=0.01)
    assert is_tone_of_light(flicker(130.0, swing), seen, log_eps=0.01)
    assert not is_tone_of_light(flicker(130.0, 3 * swing), seen, log_eps=0.01)
    # frames of 400 Hz show one of 270 Hz as the same
    assert not is_tone_of_light(flicker(270.0, swing), seen, log_eps=0.01)


def test_at_half_the_rate_of_frames_of_a_simulator_there_is_no_lamp(rng):
    """What goes on in a pixel from one frame to the next, held or differenced, may go on in turns."""
    seen = pan(rng, 130.0)
    held = seen_of(seen.scene.held(0.5 * EVERY))
    for frequency, of_frames in ((200.0, True), (150.0, False)):
        assert is_tone_of_light(flicker(frequency, 0.5), held, log_eps=0.01) is of_frames
        assert is_tone_of_light(flicker(frequency, 0.5), seen, log_eps=0.01, in_step=True) is of_frames
        assert not is_tone_of_light(flicker(frequency, 0.5), seen, log_eps=0.01)


def test_a_tone_is_looked_for_as_far_as_it_is_known(rng):
    """In the time that is compared, of which the events have told it."""
    seen = pan(rng, 130.0)
    part = replace(seen, span=(0.2, 0.5))
    entry = replace(
        flicker(127.0, 0.05), details={"frequency": 127.0, "frequency_low": 123.0, "frequency_high": 131.0}
    )
    assert is_tone_of_light(entry, part, log_eps=0.01)
    assert not is_tone_of_light(flicker(110.0, 0.1), part, log_eps=0.01)


def test_a_fan_that_shows_other_blades_in_turns_is_no_lamp_of_half_the_frame_rate(rng):
    """What light does between two frames is a guess: there a part of the swing is enough."""
    seen = pan(rng, 57.0)
    frames = seen.scene.frames(seen.scene.sample_times())
    turns = seen_of(
        VideoScene(frames * (1 + 0.02 * (np.arange(320) % 2))[:, None, None], np.arange(320) * EVERY)
    )
    swing = swing_of_light(turns, 199.99, 200.01, log_eps=0.01)
    assert swing > 0.05
    entry = flicker(200.0, 4 * swing)
    assert is_tone_of_light(entry, turns, log_eps=0.01)
    assert not is_tone_of_light(entry, seen, log_eps=0.01)
    assert not is_tone_of_light(flicker(180.0, 4 * swing), turns, log_eps=0.01)


@pytest.mark.parametrize("swing", [0.0, 0.2])
def test_a_lamp_is_the_scene_s_if_the_clip_has_it(rng, swing):
    assert is_tone_of_light(flicker(120.0, 0.2), pan(rng, 57.0, swing), log_eps=0.01) is bool(swing)


def test_light_that_never_changes_has_no_tone():
    scene = VideoScene(np.full((30, 4, 5), 0.5, np.float32), np.arange(30) * EVERY)
    assert swing_of_light(seen_of(scene), 100.0, 100.0, log_eps=0.01) == 0.0
