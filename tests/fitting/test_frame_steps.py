"""Events of simulators that know the frames of a clip alone, and all others."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.frame_simulator import bright_texture, counted_between_frames

import dase
from dase.diagnosis import seen_effects
from dase.diagnosis.seen_effects import find_seen_effects
from dase.effects import EFFECTS, HighPass
from dase.fitting import compared_time
from dase.fitting.data_split import split_measurement
from dase.fitting.frame_steps import (
    clip_step_of,
    comes_before_its_light,
    frame_step_of,
    is_in_step,
    ticks_are_of_frames,
)
from dase.fitting.measurement import Measurement, as_measurement, static_scene
from dase.probes.timestamp_patterns import find_structure
from dase.scenes.video import VideoScene
from dase.signatures.result import Answer, Signature
from dase.simulation.sensor import Sensor

STEP, SIZE = 0.01, (40, 50)


@pytest.fixture(scope="module")
def clip() -> VideoScene:
    """Waves that go over the picture, 100 frames a second."""
    x = np.arange(SIZE[1]) + 0.7 * np.arange(SIZE[0])[:, None]
    turns = np.arange(120)[:, None, None] * 0.013
    light = np.exp(0.9 * np.sin(x / 4 + 2 * np.pi * turns) + 0.5 * np.sin(x / 9 - 4 * np.pi * turns))
    return VideoScene((light / light.max()).astype(np.float32), np.arange(120) * STEP)


def frame_by_frame(clip: VideoScene, theta: float = 0.1, *, forgets: str = "") -> dase.Events:
    """Return events as v2e makes them: whole thresholds from frame to frame, at times that pixels share.

    Args:
        clip: The frames.
        theta: Threshold.
        forgets: Where pixels take the light of a frame for their memory, as in `HighPass.at`.
    """
    times = clip.sample_times()
    level = np.log(clip.frames(times).astype(float) + 1e-3)
    memory, rows = level[0].copy(), []
    for k in range(1, len(times)):
        change = (level[k] - memory) / theta
        count = np.trunc(change).astype(int)
        most = max(int(np.abs(count).max()), 1)
        for n in range(most):
            y, x = np.nonzero(np.abs(count) > n)
            when = np.full(len(y), times[k - 1] + STEP * (n + 1) / most)
            rows.append(np.stack([when, x, y, count[y, x] > 0], 1))
        memory += count * theta
        taken = {"": False, "frames": True, "sending frames": count != 0}[forgets]
        memory = np.where(taken, level[k], memory)
    t, x, y, p = np.concatenate(rows).T
    return dase.Events(t, x.astype(np.uint16), y.astype(np.uint16), p.astype(bool), SIZE[1], SIZE[0])


def test_events_of_a_simulator_that_knows_frames_alone_are_compared_from_frame_to_frame(clip):
    events = frame_by_frame(clip)
    assert frame_step_of(events, clip) == pytest.approx(STEP)
    found = split_measurement(Measurement(events, clip), pixels=300, seed=1)
    assert np.diff(found.when).mean() == pytest.approx(STEP)
    assert any("in step with the frames" in note for note in found.notes)


def counts_of_frames(events: dase.Events, clip: VideoScene) -> np.ndarray:
    """Return OFF and ON events of each pixel from frame to frame, shape (F, height, width, 2)."""
    frame = np.ceil((events.t - clip.sample_times()[0]) / STEP - 1e-6).astype(int)
    out = np.zeros((len(clip.sample_times()), *SIZE, 2), int)
    np.add.at(out, (frame, events.y, events.x, events.p.astype(int)), 1)
    return out


@pytest.mark.parametrize("forgets", ["frames", "sending frames"])
def test_what_other_simulators_forget_from_frame_to_frame_is_simulated_exactly(clip, device, forgets):
    """A threshold that is hit to a rounding error is the only difference."""
    model = dase.Sensor().with_effect(EFFECTS["threshold"](on=0.1, off=0.1, phase=0.0))
    model = model.with_effect(HighPass(at=forgets, cutoff=1e5))
    mine = counts_of_frames(dase.simulate(clip, model, seed=1, device=device), clip)
    theirs = counts_of_frames(frame_by_frame(clip, forgets=forgets), clip)
    assert theirs.sum() > 10_000
    assert np.abs(mine - theirs).sum() < 1e-4 * theirs.sum()
    on = counts_of_frames(frame_by_frame(clip), clip)
    assert np.abs(on - theirs).sum() > 0.1 * theirs.sum()


def test_a_leak_is_not_taken_for_an_event_at_which_a_pixel_forgets(clip, device):
    """A memory that a leak moves by 0.001 a frame counted as one that had sent, and forgot at each frame."""
    model = dase.Sensor().with_effect(EFFECTS["threshold"](on=0.1, off=0.1, phase=0.0))
    model = model.with_effect(HighPass(at="sending frames", cutoff=1e5))
    leaky = model.with_effect(EFFECTS["leak"](rate=1.0, spread=0.0))
    plain, beside = (len(dase.simulate(clip, one, seed=1, device=device)) for one in (model, leaky))
    every = dase.Sensor(model.effects).with_effect(HighPass(at="frames", cutoff=1e5))
    assert len(dase.simulate(clip, every, seed=1, device=device)) < 0.95 * plain
    assert beside == pytest.approx(plain, rel=0.03)


@pytest.mark.parametrize("hot", [0, 40])
def test_events_that_are_stamped_with_the_frame_before_are_of_the_light_after_it(hot):
    """AirSim's; taken for the light before it, a clip without any effect ended at an error of 10."""
    clip = bright_texture(STEP)
    events = counted_between_frames(clip, 0.0, forgets="frames", hot=hot)
    assert comes_before_its_light(events, clip) == pytest.approx(STEP)
    measurement = as_measurement(events, clip)
    assert any("tell of the light after it" in note for note in measurement.notes)
    shown = measurement.scene
    assert isinstance(shown, VideoScene)
    assert shown.sample_times()[0] == pytest.approx(-0.01 * STEP)
    assert shown.frame_times()[0] == pytest.approx(0.0)
    assert frame_step_of(events, shown) == pytest.approx(STEP)
    assert as_measurement(events, shown).scene is shown
    halves = Sensor().with_effect(EFFECTS["timestamp"](step=STEP / 2))
    others = [dase.simulate(clip, sensor, seed=2) for sensor in ("ideal", halves)]
    others += [counted_between_frames(clip, 0.0, forgets=way, hot=hot) for way in ("", "sending frames")]
    assert [comes_before_its_light(other, clip) for other in others] == [None] * 4


def test_events_at_few_parts_of_a_frame_are_in_step_with_it_unless_these_are_alike(clip):
    rng = np.random.default_rng(3)
    frame, x, y = (rng.integers(1, most, 20_000) for most in (110, SIZE[1], SIZE[0]))
    for shares, told in (((0.54, 0.36, 0.1), True), ((0.5, 0.5, 0.0), False)):
        part = rng.choice([0.0, 0.5, 1 / 3], 20_000, p=shares)
        t = np.round(1e6 * STEP * (frame + part)) / 1e6
        order = np.argsort(t, kind="stable")
        events = dase.Events(t[order], x[order], y[order], rng.random(20_000) < 0.5, SIZE[1], SIZE[0])
        assert (frame_step_of(events, clip) is not None) is told


def test_events_at_halves_of_frames_are_in_step_if_pixels_send_them_in_turn(clip):
    """A clip of v2e, two events in nearly every frame: a clock of half a frame was certain."""
    change = np.abs(np.diff(np.log(clip.frames(clip.sample_times()) + 1e-3), axis=0)).max((1, 2))
    events = frame_by_frame(clip, theta=float(np.median(change)) / 1.4)
    halves = np.round((events.t % STEP) / STEP * 6).astype(int) % 6
    assert np.isin(halves, (0, 3)).mean() > 0.9
    assert frame_step_of(events, clip) == pytest.approx(STEP)
    clock = Sensor().with_effect(EFFECTS["timestamp"](step=STEP / 2))
    assert frame_step_of(dase.simulate(clip, clock, seed=1), clip) is None


@pytest.mark.parametrize(("period", "kept"), [(STEP, False), (STEP / 2, False), (0.7 * STEP, True)])
def test_intervals_of_frames_are_of_no_clock(clip, monkeypatch, period, kept):
    """Noise that is drawn once a frame, beside events that come at any time: time stamps were certain."""
    entry = Signature(name="time stamps", answer=Answer.FOUND, sentence="", details={"period": period})
    found = SimpleNamespace(found=(entry,), entries=(entry,))
    monkeypatch.setattr(seen_effects, "find_signatures", lambda *args, **more: found)
    seen = find_seen_effects(Measurement(dase.simulate(clip, "ideal", seed=2), clip), EFFECTS)
    assert bool(seen.entries) is kept


def test_what_a_simulator_waits_between_frames_is_no_loss_of_data(clip, monkeypatch):
    gaps = np.array([[0.1, 0.11], [0.3, 0.31], [0.5, 0.51]])
    monkeypatch.setattr(compared_time, "repeated_gaps", lambda t: gaps)
    for events, lost in ((frame_by_frame(clip), False), (dase.simulate(clip, "ideal", seed=2), True)):
        found = split_measurement(Measurement(events, clip), pixels=300, seed=1)
        assert any("data are missing" in note for note in found.notes) is lost


@pytest.mark.parametrize(("frequency", "lamp"), [(99.96, None), (200.0, None), (120.0, 120.0)])
def test_a_tone_of_the_frames_of_a_clip_is_no_lamp(clip, monkeypatch, frequency, lamp):
    """Whatever sends the events: light between frames goes straight, and changes its way at each of them."""
    seen = Signature(name="flicker", answer=Answer.FOUND, details={"frequency": frequency})
    found = SimpleNamespace(found=(seen,), entries=(seen,))
    monkeypatch.setattr(seen_effects, "find_signatures", lambda events, begins: found)
    events = frame_by_frame(clip)
    assert find_seen_effects(Measurement(events, clip), EFFECTS).lamp == lamp
    other = dase.simulate(clip, "ideal", seed=2)
    assert find_seen_effects(Measurement(other, clip), EFFECTS).lamp == lamp
    times = clip.sample_times()
    assert clip_step_of(clip) == pytest.approx(0.01)
    uneven = VideoScene(clip.frames(times), times + 1e-3 * (np.arange(len(times)) % 2))
    assert clip_step_of(uneven) == 0
    assert clip_step_of(static_scene(other)) == 0
    assert find_seen_effects(Measurement(other, uneven), EFFECTS).lamp == frequency


@pytest.mark.parametrize(
    "effects",
    [
        (),
        ("shot", "leak", "bandwidth"),
        (EFFECTS["flicker"](frequency=1 / STEP, depth=0.6),),
        (EFFECTS["timestamp"](step=1e-3, jitter=0.0),),
        (EFFECTS["row_scan"](line=1e-5),),
    ],
)
def test_events_of_cameras_are_not(clip, effects):
    sensor = Sensor()
    for effect in effects:
        sensor = sensor.with_effect(EFFECTS[effect]() if isinstance(effect, str) else effect)
    events = dase.simulate(clip, sensor, seed=2)
    assert len(events) > 2_000
    assert frame_step_of(events, clip) is None


@pytest.fixture(scope="module")
def fine_clip(clip) -> VideoScene:
    """The same, 1000 frames a second and as fast for each frame."""
    return VideoScene(clip.frames(clip.sample_times()), np.arange(120) * 1e-3)


def at_times(events: dase.Events, t: np.ndarray) -> dase.Events:
    order = np.argsort(t, kind="stable")
    return dase.Events(t[order], *(getattr(events, n)[order] for n in "xyp"), events.width, events.height)


@pytest.mark.parametrize("ticks", [1, 2])
def test_ticks_of_a_simulator_that_knows_frames_alone_are_no_clock(fine_clip, ticks):
    exact = dase.simulate(fine_clip, "ideal", seed=2)
    # what a frame changes is told at its end, the half of it that most pixels have no event in, sooner
    part = np.where((exact.x + exact.y) % 5 > 0, 1, ticks)
    told = np.ceil(part * exact.t / 1e-3 - 1e-6) / part * 1e-3
    events = at_times(exact, told)
    assert frame_step_of(events, fine_clip) == pytest.approx(1e-3)
    assert find_structure(events).step == pytest.approx(1e-3 / ticks, rel=1e-3)
    found = split_measurement(Measurement(events, fine_clip), pixels=300, seed=1)
    assert found.structure.step == 0
    assert any("times between frames are made by a simulator" in note for note in found.notes)
    assert "timestamp" not in find_seen_effects(Measurement(events, fine_clip), EFFECTS).effects


@pytest.mark.parametrize(("share", "clock"), [(0.25, False), (0.3125, True), (0.248, True)])
def test_ticks_that_are_no_parts_of_a_frame_are_a_clock(fine_clip, share, clock):
    """IEBCS with stamps rounded to 625 us, of frames each 2 ms: its clock was taken for the frames.

    So was one of 312 us, of frames each 2.5 ms, which goes from eighths of these by three ticks in a second.
    """
    events = dase.simulate(fine_clip, "ideal", seed=2)
    tick = share * 1e-3
    stamped = at_times(events, np.rint(np.ceil(events.t / 1e-3) * 1e-3 / tick) * tick)
    assert frame_step_of(stamped, fine_clip) == pytest.approx(1e-3)
    assert ticks_are_of_frames(tick, 1e-3, stamped, fine_clip) is not clock


def test_a_clock_that_rounds_to_halves_of_frames_is_one(fine_clip):
    """Half of the events are then at frames, and go with the light there; the others are at the middle."""
    events = dase.simulate(fine_clip, "ideal", seed=2)
    stamped = at_times(events, np.rint(events.t / 0.5e-3) * 500 * 1e-6)
    assert frame_step_of(stamped, fine_clip) is None
    assert find_seen_effects(Measurement(stamped, fine_clip), EFFECTS).entry_of("time stamps") is not None


def test_a_clock_that_ticks_as_often_as_frames_come_is_one(fine_clip):
    sensor = Sensor().with_effect(EFFECTS["timestamp"](step=1e-3, jitter=0.0))
    events = dase.simulate(fine_clip, sensor, seed=2)
    assert frame_step_of(events, fine_clip) == pytest.approx(1e-3)
    assert split_measurement(
        Measurement(events, fine_clip), pixels=300, seed=1
    ).structure.step == pytest.approx(1e-3)
    assert "timestamp" in find_seen_effects(Measurement(events, fine_clip), EFFECTS).effects
    assert not ticks_are_of_frames(1e-3, 0.0, events, fine_clip)


def test_tones_of_frames():
    assert is_in_step(99.9, 0.01)
    assert is_in_step(200.0, 0.01)
    assert not is_in_step(120.0, 0.01)
    assert not is_in_step(100.0, 1e-3)  # far below the frames
