"""A clip whose frames a simulator held is taken as it was shown: each frame from the one before on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.frame_simulator import HEIGHT, WIDTH, counted_between_frames, shaken_texture
from helpers.held_pixels import held_with_low_pass

import dase
from dase.effects import EFFECTS
from dase.effects.threshold import Threshold
from dase.events import Events
from dase.fitting.held_clips import HELD_CLIPS, come_at_even_parts, frames_late, holds_frames
from dase.fitting.measurement import as_measurement
from dase.scenes.video import VideoScene
from dase.simulation.sensor import Sensor


def held_frames(
    scene: VideoScene, *, early: bool, late: float = 0.0, threshold: float = 0.2, wait: int = 0
) -> Events:
    """Return events of light that jumps from frame to frame; a pixel that sends forgets the rest of it.

    Args:
        scene: Frames of light.
        early: Whether a frame is shown from the time of the one before on, or from its own.
        late: From the jump to the event [s]; two microseconds apart from pixel to pixel.
        threshold: ON and OFF [log intensity].
        wait: Frames that it does not look at after that, the last of which it remembers.
    """
    times = scene.sample_times()
    level = np.log(scene.frames(times) + 1e-3)
    memory, out = level[0].copy(), []
    dead = np.zeros(memory.shape, int)
    for begin, now in zip(times[:-1] if early else times[1:], level[1:], strict=True):
        memory = np.where(dead > 0, now, memory)
        y, x = np.nonzero((np.abs(now - memory) >= threshold) & (dead == 0))
        dead = np.maximum(dead - 1, 0)
        apart = 1e-6 * np.round(2 * np.random.default_rng(x).uniform(size=len(x)))
        out.append((begin + late + apart, x, y, now[y, x] > memory[y, x]))
        memory[y, x] = now[y, x]
        dead[y, x] = wait
    t, x, y, p = (np.concatenate(part) for part in zip(*out, strict=True))
    order = np.argsort(t, kind="stable")
    return Events(t[order], x[order], y[order], p[order], WIDTH, HEIGHT)


@pytest.fixture(scope="module", params=[1e-3, 5e-3])
def scene(request) -> VideoScene:
    return shaken_texture(gap=request.param)


@pytest.mark.parametrize("late", [0.0, 0.4])
def test_events_before_their_light_are_of_a_clip_that_holds_frames(scene, late):
    gap = float(np.diff(scene.sample_times())[0])
    events = held_frames(scene, early=True, late=late * gap)
    measured = as_measurement(events, scene)
    assert measured.held == pytest.approx(gap)
    assert any("earlier" in note for note in measured.notes)
    times, shown = scene.sample_times(), measured.scene
    # each frame is there from half a frame before its time on, at the latest, and until just before it
    inner = shown.sample_times()
    held = inner[(inner > times[4] + 0.47 * gap) & (inner < times[5])]
    assert held[-1] > times[5] - 0.03 * gap
    assert len(held) >= 2
    np.testing.assert_array_equal(
        shown.frames(held), np.broadcast_to(scene.frames(times[5:6]), (len(held), HEIGHT, WIDTH))
    )
    # it is moved once
    again = as_measurement(measured)
    assert again.notes == measured.notes
    np.testing.assert_array_equal(again.scene.sample_times(), measured.scene.sample_times())


def test_the_first_of_many_events_is_not_early(scene):
    """After a long dead time a simulator that puts n events of a frame evenly into it sends the first."""
    times = scene.sample_times()
    rng = np.random.default_rng(3)
    frame = np.sort(rng.integers(2, len(times) - 2, 6000))
    gap = times[frame + 1] - times[frame]
    x, y = rng.integers(0, WIDTH, len(frame)), rng.integers(0, HEIGHT, len(frame))
    light = scene.frames(times)
    rises = light[frame + 1, y, x] > light[frame, y, x]

    def sent(late):
        t = np.floor(1e6 * (times[frame] + late * gap)) / 1e6
        order = np.argsort(t, kind="stable")
        return Events(t[order], x[order], y[order], rises[order], WIDTH, HEIGHT)

    assert not holds_frames(sent(1 / rng.integers(11, 21, len(frame))), scene)
    assert holds_frames(sent(rng.uniform(1 / 20, 1 / 11, len(frame)) + 0.1), scene)


@pytest.mark.parametrize("early", [True, False])
def test_events_that_are_late_by_different_times_tell_of_held_frames_as_well(scene, early, rng):
    """A fifth of the time from frame to frame: too wide for a begin, and the rest of it has none."""
    gap = float(np.diff(scene.sample_times())[0])
    events = held_frames(scene, early=early, late=0.1 * gap)
    t = events.t + rng.uniform(0.0, 0.2 * gap, len(events))
    order = np.argsort(t, kind="stable")
    spread = Events(t[order], events.x[order], events.y[order], events.p[order], WIDTH, HEIGHT)
    assert holds_frames(spread, scene) == early


@pytest.mark.parametrize("late", [1.4, 2.45, 6.3])
def test_events_that_are_late_by_some_frames_tell_of_held_frames_by_what_pixels_remember(scene, late):
    """Stamps that are off by an eighth of a frame put events at any time between two."""
    gap = float(np.diff(scene.sample_times())[0])
    events = held_with_low_pass(scene, late=late * gap, stamps=0.12 * gap)
    assert frames_late(events, scene) == pytest.approx(late, abs=0.02)
    assert holds_frames(events, scene)
    # light that goes straight between frames, and pixels that are as late
    sensor = Sensor((EFFECTS["latency"](delay=late * gap, light=0.0), Threshold(on=0.2, off=0.2)))
    straight = dase.simulate(scene, sensor, seed=1)
    assert frames_late(straight, scene) is None
    assert not holds_frames(straight, scene)


def test_a_frame_at_its_own_time_is_not_early(scene):
    events = held_frames(scene, early=False)
    assert not holds_frames(events, scene)
    measured = as_measurement(events, scene)
    assert measured.scene is scene
    assert (measured.held, measured.notes) == (0.0, ())


def test_simulators_of_light_between_frames_are_not_early(scene):
    gap = float(np.diff(scene.sample_times())[0])
    clock = Sensor().with_effect(EFFECTS["timestamp"](step=gap))
    slow = Sensor().with_effect(EFFECTS["latency"](delay=0.5 * gap))
    for events in (
        counted_between_frames(scene, 0.1),
        *(dase.simulate(scene, sensor, seed=1) for sensor in (Sensor(), clock, slow)),
    ):
        assert len(events) > 2000
        assert not holds_frames(events, scene)


def test_the_first_of_some_events_that_share_a_frame_is_not_early(scene):
    """A simulator that knows frames alone puts the events of a frame at equal parts of it."""
    gap = float(np.diff(scene.sample_times())[0])
    events = held_frames(scene, early=True)
    frame = np.round(events.t / gap)
    part = np.where(frame % 2, 4, 5)
    first = Events(gap * (frame + 1 / part), events.x, events.y, events.p, WIDTH, HEIGHT)
    assert not holds_frames(first, scene)


@pytest.mark.parametrize("halves", [0.04, 0.1])
def test_events_at_frames_and_at_parts_of_them_are_not_early(scene, halves):
    """Of a clip of v2e with steps of its light most frames had one event a pixel, and those of a step two. It
    was taken as held, and had a *jitter*, certain and wrong."""
    gap = float(np.diff(scene.sample_times())[0])
    events = counted_between_frames(scene, 0.0)
    rng = np.random.default_rng(4)
    t = np.ceil(events.t / gap) * gap - 0.5 * gap * (rng.random(len(events)) < halves)
    order = np.argsort(t, kind="stable")
    stamped = Events(t[order], events.x[order], events.y[order], events.p[order], WIDTH, HEIGHT)
    # however far light goes after a frame
    assert not holds_frames(stamped, scene, replace(HELD_CLIPS, sooner=0.0))


def test_held_frames_without_any_latency_are_told_by_the_memory_of_pixels(scene):
    """All events have the time of the frame before theirs, as ticks of a clock do that rounds down."""
    gap = float(np.diff(scene.sample_times())[0])
    events = held_frames(scene, early=True)
    t = np.round(events.t / gap) * gap
    assert holds_frames(Events(t, events.x, events.y, events.p, WIDTH, HEIGHT), scene)
    counted = counted_between_frames(scene, 0.0)
    t = np.floor(counted.t / gap) * gap
    assert not holds_frames(Events(t, counted.x, counted.y, counted.p, WIDTH, HEIGHT), scene)


@pytest.mark.parametrize("early", [True, False])
@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_latencies_that_are_drawn_about_nothing_tell_of_held_frames_as_well(scene, early, noise, rng):
    """Half of them are none at all, and the others thin out; some noise comes at any time."""
    gap = float(np.diff(scene.sample_times())[0])
    events = held_frames(scene, early=early)
    late = np.maximum(rng.normal(0.0, 0.25 * gap, len(events)), 0.0)
    late = np.where(rng.random(len(events)) < noise, rng.uniform(0.0, gap, len(events)), late)
    t = np.round(events.t / gap) * gap + late
    order = np.argsort(t, kind="stable")
    spread = Events(t[order], events.x[order], events.y[order], events.p[order], WIDTH, HEIGHT)
    assert holds_frames(spread, scene) is early
    # at frames, and at any time between: noise that is drawn at each, and light that goes on, unless all of
    # one threshold of held frames
    t = np.round(events.t / gap) * gap + gap * np.maximum(rng.uniform(-1.0, 1.0, len(events)), 0.0)
    order = np.argsort(t, kind="stable")
    even = Events(t[order], events.x[order], events.y[order], events.p[order], WIDTH, HEIGHT)
    assert holds_frames(even, scene) is early
    counted = counted_between_frames(scene, 0.0)
    t = np.floor(counted.t / gap) * gap + gap * np.maximum(rng.uniform(-1.0, 1.0, len(counted)), 0.0)
    order = np.argsort(t, kind="stable")
    even = Events(t[order], counted.x[order], counted.y[order], counted.p[order], WIDTH, HEIGHT)
    assert not holds_frames(even, scene)


@pytest.mark.parametrize(("early", "frames"), [(True, 0), (True, 3), (False, 0)])
def test_noise_at_any_time_hides_no_held_frames_of_one_threshold(scene, early, frames):
    """Two clips of IEBCS with shot noise, a tenth of the events, and one with a dead time of four frames."""
    gap, rng = float(np.diff(scene.sample_times())[0]), np.random.default_rng(3)
    events = held_frames(scene, early=early, wait=frames)
    count, end = len(events) // 9, float(scene.sample_times()[-1])
    x, y = (rng.integers(0, size, count) for size in (WIDTH, HEIGHT))
    noise = Events(np.sort(rng.uniform(0, end, count)), x, y, rng.random(count) < 0.5, WIDTH, HEIGHT)
    t, x, y, p = (
        np.concatenate([getattr(one, name) for one in (events, noise)]) for name in ("t", "x", "y", "p")
    )
    t[: len(events)] = np.round(events.t / gap) * gap
    order = np.argsort(t, kind="stable")
    both = Events(t[order], x[order], y[order], p[order], WIDTH, HEIGHT)
    assert holds_frames(both, scene) is early


def test_few_events_tell_nothing(scene):
    events = held_frames(scene, early=True)
    assert holds_frames(events, scene)
    assert not holds_frames(events.select(slice(0, 500)), scene)
    assert not holds_frames(Events.empty(WIDTH, HEIGHT), scene)


def test_a_model_comes_nearer(scene, monkeypatch):
    """The dead time stands for what is left of a frame's change when a pixel has sent."""
    gap = float(np.diff(scene.sample_times())[0])
    events = held_frames(scene, early=True)
    begun = Sensor().with_effect(Threshold(on=0.2, off=0.2, phase=0.0))
    sensor = begun.with_effect(EFFECTS["refractory"](period=0.5 * gap, mode="reset"))
    moved = dase.compare(events, sensor, scene=scene).error
    monkeypatch.setattr("dase.fitting.measurement.holds_frames", lambda *_: False)
    assert moved < 1
    assert moved < 0.1 * dase.compare(events, sensor, scene=scene).error


def test_noise_that_is_drawn_at_each_frame_is_not_early(scene):
    """Ten times as many events at frames as others, which come at any time: Metavision's shot noise."""
    rng, times = np.random.default_rng(1), scene.sample_times()
    sent = dase.simulate(scene, Sensor(), seed=1)
    count = 10 * len(sent)
    x, y = (rng.integers(0, size, count) for size in (WIDTH, HEIGHT))
    noise = Events(np.sort(rng.choice(times[1:-1], count)), x, y, rng.random(count) < 0.5, WIDTH, HEIGHT)
    t, x, y, p = (
        np.concatenate([getattr(one, name) for one in (sent, noise)]) for name in ("t", "x", "y", "p")
    )
    order = np.argsort(t, kind="stable")
    both = Events(t[order], x[order], y[order], p[order], WIDTH, HEIGHT)
    assert not holds_frames(both, scene)


@pytest.mark.parametrize(
    ("places", "is_so"),
    [
        ("parts of their own", True), ("ticks", False), ("one part", False), ("any time", False),
        ("few", False),
    ],
)  # fmt: skip
def test_even_parts_of_which_each_frame_has_its_own_number_are_of_frames(places, is_so):
    """v2e puts the n events of its busiest pixel at n parts: 179, 357 ... us of one frame, 147, 294 ... of
    the next. As held pictures these had a latency, certain and wrong."""
    rng = np.random.default_rng(0)
    frame = np.sort(rng.integers(0, 40, 2000 if places != "few" else 200))
    parts = 12 + frame % 6 if places != "ticks" else np.full(len(frame), 25)
    part = np.minimum(rng.geometric(0.4, len(frame)), parts - 1)
    late = part / parts if places != "one part" else 1 / parts
    late = rng.uniform(size=len(frame)) if places == "any time" else late
    stamped = np.floor(1e6 * 2.5e-3 * late + 0.5) / 1e6
    assert come_at_even_parts(frame, stamped, 2.5e-3) == is_so
    assert come_at_even_parts(frame, stamped, np.full(len(frame), 2.5e-3)) == is_so
