"""A latency, poles and both are told by how far light goes from event to event, with their values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.frame_simulator import HEIGHT, WIDTH, shaken_texture

from dase.diagnosis.late_light import find_late_events, unlike_poles_of
from dase.diagnosis.state import DiagnosisState, DiagnosisTask
from dase.effects.bandwidth import Bandwidth
from dase.effects.base import Observations
from dase.effects.second_order import SecondOrder
from dase.events import Events
from dase.fitting.data_split import split_measurement
from dase.fitting.measurement import Measurement
from dase.scenes.video import VideoScene

FINE = 20
"""Steps from frame to frame of the reference, which takes small ones where the code is exact."""


def late_events(
    scene: VideoScene,
    *,
    delay: float = 0.0,
    poles: tuple[float, ...] = (),
    fixed: float = 0.0,
    spread: float = 0.02,
    dark: float = 0.1,
    even: bool = False,
) -> Events:
    """Return the events of pixels that see light late, step by small step.

    Args:
        scene: Frames of light; its logarithm runs straight between them.
        delay: From the crossing to the event [s].
        poles: Of a low-pass, at full light and as much lower as light is, with the dark current [Hz].
        fixed: Of a low-pass behind these that is the same in all light [Hz]; 0 for none.
        spread: By which thresholds of 0.2 differ from event to event, relative.
        dark: That current, relative to full light.
        even: Whether the light itself runs straight, not its logarithm.
    """
    rng = np.random.default_rng(0)
    times = scene.sample_times()
    level = np.log(scene.frames(times).astype(np.float64) + 1e-3)
    brightest = np.quantile(np.exp(level), 0.99)
    cutoffs = [(one, 1.0) for one in poles] + [(fixed, 0.0)] * (fixed > 0)
    seen = [level[0].copy() for _ in cutoffs]
    memory = level[0].copy()
    last = level[0].copy()
    threshold = 0.2 * (1 + spread * rng.standard_normal(last.shape))
    out = []
    for begin, end, a, b in zip(times[:-1], times[1:], level[:-1], level[1:], strict=True):
        step = (end - begin) / FINE
        for n in range(FINE):
            part = (n + 1) / FINE
            now = np.log(np.exp(a) + (np.exp(b) - np.exp(a)) * part) if even else a + (b - a) * part
            share = (np.exp(now) / brightest + dark) / (1 + dark)
            for k, (cutoff, goes) in enumerate(cutoffs):
                seen[k] += (1 - np.exp(-2 * np.pi * cutoff * share**goes * step)) * (now - seen[k])
                now = seen[k].copy()
            y, x = np.nonzero(np.abs(now - memory) >= threshold)
            sign = np.sign(now - memory)[y, x]
            goal = memory[y, x] + sign * threshold[y, x]
            part = np.clip((goal - last[y, x]) / (now - last)[y, x], 0, 1)
            out.append((begin + (n + part) * step + delay, x, y, sign > 0))
            memory[y, x] = goal
            threshold[y, x] = 0.2 * (1 + spread * rng.standard_normal(len(x)))
            last = now.copy()
    t, x, y, p = (np.concatenate(part) for part in zip(*out, strict=True))
    order = np.argsort(t, kind="stable")
    return Events(np.round(1e6 * t[order]) / 1e6, x[order], y[order], p[order], WIDTH, HEIGHT)


@pytest.fixture(scope="module")
def scene() -> VideoScene:
    return shaken_texture(gap=2e-3, length=0.6)


def told(scene: VideoScene, **late) -> dict[str, float]:
    """Return what is told of events that are late, size by way."""
    found = find_late_events(Measurement(late_events(scene, **late), scene), log_eps=1e-3)
    return {way: size for one in found for way, size in one.details.items()}


def test_a_latency_is_told(scene):
    assert told(scene, delay=3e-3) == pytest.approx({"delay": 3e-3}, rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("cutoff", [20.0, 60.0])
def test_a_pole_is_told(scene, cutoff):
    assert told(scene, poles=(cutoff,)) == pytest.approx({"pole": cutoff}, rel=0.1)


@pytest.mark.slow
def test_two_poles_are_told(scene):
    found = told(scene, poles=(40.0, 60.0))
    assert set(found) == {"poles"}
    assert 30 < found["poles"] < 55


@pytest.mark.slow
def test_two_poles_are_told_where_light_goes_the_other_way_at_once(scene):
    """At the events themselves it goes up as often as down, so that they are as far from even as can be."""
    events = late_events(scene, poles=(12.0, 18.0))
    (found,) = find_late_events(Measurement(events, scene), log_eps=1e-3)
    assert found.details["poles"] == pytest.approx(12.0, rel=0.1)
    assert "either way at once" in found.sentence


@pytest.mark.slow
def test_a_pole_that_goes_with_the_light_before_one_that_does_not_is_told(scene):
    """The circuit's node and its buffer: neither a latency beside a pole nor two poles alike."""
    events = late_events(scene, poles=(60.0,), fixed=40.0)
    (found,) = find_late_events(Measurement(events, scene), log_eps=1e-3)
    first, dark, second = unlike_poles_of(found)
    assert second == pytest.approx(40.0, rel=0.15)
    assert found.details["poles"] == found.size == second
    # the events' pole has 60 Hz at full light, and as much of it as there is photocurrent elsewhere
    light = np.quantile(scene.frames(scene.sample_times()), 0.99)
    assert first * (dark + (1 - dark) * light) == pytest.approx(60.0, rel=0.15)
    assert first * dark == pytest.approx(60.0 * 0.1 / 1.1, rel=0.4)


@pytest.mark.slow
def test_two_poles_alike_are_not_unlike(scene):
    events = late_events(scene, poles=(40.0, 60.0))
    (found,) = find_late_events(Measurement(events, scene), log_eps=1e-3)
    assert unlike_poles_of(found) == ()


def test_poles_that_are_seen_to_be_unlike_are_tried():
    usual = Observations(100.0, 0.0, 0.0, "down", 1e5, 0.1, 0.1)
    (tried,) = SecondOrder.candidates(replace(usual, unlike_poles=(80.0, 0.05, 30.0)))
    assert tried == SecondOrder.of_poles(Bandwidth(cutoff=80.0, dark=0.05), cutoff=30.0)
    assert SecondOrder.candidates(usual)[0].poles == "alike"


@pytest.mark.parametrize("poles", [(80.0, 0.0, 30.0), (80.0, 3.0, 30.0), (1e5, 0.1, 3.0), (3.0, 0.1, 1e5)])
def test_poles_beyond_what_the_effect_can_be_are_tried_at_its_ends(poles):
    usual = Observations(100.0, 0.0, 0.0, "down", 1e5, 0.1, 0.1)
    (tried,) = SecondOrder.candidates(replace(usual, unlike_poles=poles))
    assert tried.poles == "apart"
    assert 1e-4 <= tried.dark <= 1.0


def test_poles_that_are_seen_stay_where_all_of_the_time_is_split_anew(scene):
    evidence = split_measurement(Measurement(late_events(scene), scene), pixels=100)
    library = {SecondOrder.name: SecondOrder}
    state = DiagnosisState(DiagnosisTask(evidence, library, 0, lambda *_: None, frozenset()))
    state.try_unlike_poles((80.0, 0.05, 30.0))
    state.split_anew(replace(evidence))
    (tried,) = SecondOrder.candidates(state.task.evidence.observe(idle_bus=0.01))
    assert tried.poles == "apart"


@pytest.mark.slow
def test_a_pole_and_a_latency_are_told_apart(scene):
    found = told(scene, poles=(30.0,), delay=4e-3)
    assert found == pytest.approx({"pole": 30.0, "delay": 4e-3}, rel=0.15)


@pytest.mark.slow
def test_a_pole_is_told_beside_a_latency_that_a_simulator_of_frames_may_have(scene):
    """It is later by less than three frames: of which of them light is, nobody tells."""
    events = late_events(scene, delay=3e-3, poles=(30.0,))
    found = find_late_events(Measurement(events, scene), log_eps=1e-3, frame_step=2e-3)
    assert [list(one.details) for one in found] == [["pole"]]
    assert found[0].details["pole"] == pytest.approx(30.0, rel=0.1)
    late = late_events(scene, delay=3e-3)
    assert not find_late_events(Measurement(late, scene), log_eps=1e-3, frame_step=2e-3)


@pytest.mark.slow
def test_a_latency_within_a_step_of_the_clip_is_not_told_beside_a_pole():
    """If light runs straight, not its logarithm, two poles look like one and a latency."""
    scene = shaken_texture(gap=5e-3, length=1.0)
    late = {"poles": (62.5, 115.0), "dark": 100.0, "spread": 0.005}
    assert "delay" not in told(scene, even=True, **late)


@pytest.mark.slow
def test_what_comes_within_a_dead_time_is_not_told(scene):
    """What is due in it comes at its end, as if behind a pole."""
    measured = Measurement(late_events(scene, delay=3e-3), scene)
    for dead_time, told_late in ((2e-3, True), (5e-3, False)):
        assert bool(find_late_events(measured, log_eps=1e-3, dead_time=dead_time)) == told_late


@pytest.mark.parametrize("late", [{}, {"spread": 0.2}, {"delay": 2e-4}, {"poles": (3000.0,)}])
def test_nothing_is_told_of_what_is_not_late(scene, late):
    assert told(scene, **late) == {}


def test_few_events_tell_nothing(scene):
    events = late_events(scene, delay=3e-3)
    few = events.select(np.arange(900))
    assert find_late_events(Measurement(few, scene), log_eps=1e-3) == ()
