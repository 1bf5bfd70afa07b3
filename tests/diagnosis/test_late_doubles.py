"""Double events some hundred microseconds late are told where the light of a clip does not change."""

import numpy as np
import pytest

import dase
from dase.diagnosis.late_doubles import find_late_doubles
from dase.effects.bandwidth import Bandwidth
from dase.effects.double_events import DoubleEvents
from dase.effects.flicker import Flicker
from dase.effects.leak import Leak
from dase.effects.refractory import Refractory
from dase.effects.shot import Shot
from dase.effects.threshold import Threshold
from dase.scenes.video import VideoScene

PIXELS = dase.Sensor((Threshold(on=0.2, off=0.24),))


@pytest.fixture(scope="module")
def clip():
    """A picture that drifts slowly, and a sharp square that crosses it, at 200 frames per second."""
    rng = np.random.default_rng(31)
    base = rng.random((12, 16))
    wide = np.kron(base, np.ones((8, 8)))
    wide = 0.25 * sum(np.roll(wide, (i, j), (0, 1)) for i in (0, 3) for j in (0, 3))
    frames = []
    for k in range(161):
        shift = 0.08 * k
        whole = int(shift)
        part = shift - whole
        here = (1 - part) * np.roll(wide, whole, 1) + part * np.roll(wide, whole + 1, 1)
        frame = 0.15 + 0.7 * here[:48, :64]
        frame[18:26, (k // 2) % 64 : (k // 2) % 64 + 8] = 0.95
        frames.append(frame)
    return VideoScene(np.array(frames, np.float32), np.arange(161) / 200)


def events_of(clip, *effects):
    return dase.simulate(clip, dase.Sensor((*PIXELS.effects, *effects)), seed=3)


@pytest.mark.parametrize(("delay", "polarity"), [(1.4e-4, "opposite"), (8e-4, "same"), (2.4e-3, "same")])
def test_doubles_are_told_with_their_delay_share_and_polarity(clip, delay, polarity):
    doubles = DoubleEvents(share=0.08, delay=0.8 * delay, tail=0.1 * delay, polarity=polarity)
    found = find_late_doubles(events_of(clip, doubles), clip)
    assert found.found
    assert found.size == pytest.approx(0.08, rel=0.35)
    assert found.details["gap"] == pytest.approx(0.88 * delay, rel=0.1)
    assert found.details["opposite"] == (polarity == "opposite")


@pytest.mark.parametrize(("longest", "polarity"), [(3e-4, "same"), (9e-4, "opposite"), (2e-3, "same")])
def test_doubles_that_come_at_any_time_up_to_one_are_told(clip, longest, polarity):
    doubles = DoubleEvents(share=0.06, delay=0.0, spread=longest, polarity=polarity)
    found = find_late_doubles(events_of(clip, doubles), clip)
    assert found.found
    assert "up to" in found.sentence
    assert found.size == pytest.approx(0.06, rel=0.35)
    assert found.details["spread"] == pytest.approx(longest, rel=0.05)
    assert found.details["gap"] == pytest.approx(0.5 * longest, rel=0.05)
    assert found.details["opposite"] == (polarity == "opposite")
    # noise of pixels that rest has pairs of any interval, but far from as many
    beside = find_late_doubles(events_of(clip, Shot(rate=2e-3 / longest), doubles), clip)
    assert beside.found
    assert beside.details["opposite"] == (polarity == "opposite")
    # long tails come at any time as well, and later
    tail = DoubleEvents(share=0.06, delay=0.0, tail=longest / 2, polarity=polarity)
    assert not find_late_doubles(events_of(clip, tail), clip).found


@pytest.mark.parametrize(
    "effects",
    [
        (),
        (Shot(rate=8.0),),
        (Leak(rate=4.0),),
        (Bandwidth(cutoff=30.0),),
        (Refractory(period=3e-3), Shot(rate=4.0)),
        (Flicker(frequency=100.0, depth=0.4),),
        (DoubleEvents(share=0.002, delay=8e-4),),  # too few to be told
    ],
    ids=lambda effects: "+".join(e.name for e in effects) or "plain",
)
def test_what_comes_at_all_times_is_no_double(clip, effects):
    assert not find_late_doubles(events_of(clip, *effects), clip).found


def test_held_frames_send_at_once_and_are_no_doubles(clip):
    held = clip.held(1e-3)
    assert not find_late_doubles(events_of(held), held).found
    doubled = events_of(held, DoubleEvents(share=0.08, delay=7e-4, tail=1e-4))
    assert find_late_doubles(doubled, held).found


def test_a_clip_with_hardly_any_events_tells_nothing(clip):
    few = events_of(clip).select(slice(0, 50))
    assert not find_late_doubles(few, clip).found
