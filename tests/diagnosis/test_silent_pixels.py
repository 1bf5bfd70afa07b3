"""Dead pixels are told one by one, and what comes late in a recording is fitted there."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.brief_diagnosis import NO_LIMITS

import dase
from dase.diagnosis import compared_measurement
from dase.diagnosis.diagnose import diagnose
from dase.diagnosis.seen_effects import SeenEffects
from dase.diagnosis.settings import DEFAULTS
from dase.diagnosis.silent_pixels import (
    SilentPixels,
    find_silent_pixels,
    without_the_explained_silence,
)
from dase.effects import EFFECTS
from dase.fitting.data_split import split_measurement
from dase.fitting.measurement import Measurement
from dase.results import Grade
from dase.signatures.result import Answer, Signature
from dase.simulation.sensor import Sensor

WIDTH, HEIGHT = 96, 72


def moving(
    seconds: float = 0.5, *, until: float = np.inf, speed: float = 1.0, seed: int = 1
) -> dase.VideoScene:
    """Return smooth random light that moves to and fro until a time, and rests from then on."""
    rng = np.random.default_rng(seed)
    waves = rng.uniform(-0.3, 0.3, (12, 2)), rng.uniform(0, 6.28, 12), rng.uniform(0.1, 0.4, 12)
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    times = np.arange(round(1000 * seconds) + 1) * 1e-3
    frames = np.empty((len(times), HEIGHT, WIDTH), np.float32)
    for k, time in enumerate(speed * np.minimum(times, until)):
        if k and times[k - 1] >= until:
            frames[k] = frames[k - 1]
            continue
        at = x - 12 * np.sin(2 * np.pi * 2.0 * time), y - 9 * np.sin(2 * np.pi * 1.3 * time)
        level = sum(
            a * np.sin(w[0] * at[0] + w[1] * at[1] + p) for w, p, a in zip(*waves, strict=True)
        )  # fmt: skip
        frames[k] = np.exp(level - 1.5)
    return dase.VideoScene(frames, times)


@pytest.fixture(scope="module")
def scene() -> dase.VideoScene:
    return moving()


def counts_of(events: dase.Events) -> np.ndarray:
    """Return the events of each pixel, row-major."""
    return np.bincount(events.y.astype(np.int64) * WIDTH + events.x, minlength=WIDTH * HEIGHT)


def test_silent_pixels_are_the_dead_ones(scene):
    sensor = Sensor().with_effect(EFFECTS["mismatch"](spread=0.2))
    alive = counts_of(dase.simulate(scene, sensor, seed=5))
    events = dase.simulate(scene, sensor.with_effect(EFFECTS["dead"](share=0.02)), seed=5)
    dead = np.flatnonzero((counts_of(events) == 0) & (alive > 0))
    found = find_silent_pixels(Measurement(events, scene), log_eps=1e-3)
    assert found.found
    assert np.isin(found.pixels, dead).all()
    # of those that have all neighbours, most lie where all is busy
    assert len(found.pixels) > 0.5 * len(dead) > 20
    assert found.share.low < 0.02 < found.share.high
    assert str(len(found.pixels)) in found.sentence


@pytest.mark.parametrize("shape", ["columns", "patch", "cross"])
def test_lines_and_patches_of_dead_pixels_are_found_whole(scene, shape):
    """Their neighbours are dead, too, and those in the middle of a patch have no others."""
    events = dase.simulate(scene, Sensor(), seed=5)
    dead = np.zeros((HEIGHT, WIDTH), np.bool_)
    if shape == "columns":
        dead[:, [20, 41, 42]] = True
    elif shape == "patch":
        dead[30:38, 40:49] = True
    else:
        dead[:, [20, 41]] = dead[33] = True
    alive = counts_of(events) > 0
    events = events.select(~dead[events.y, events.x])
    found = find_silent_pixels(Measurement(events, scene), log_eps=1e-3)
    assert found.found
    there = np.flatnonzero(dead.ravel() & alive)
    assert np.isin(found.pixels, there).all()
    assert len(found.pixels) > 0.75 * len(there)
    # between a camera's frames light is a guess, by which whole patches may see none
    begins = scene.sample_times()[::20]
    grey = np.rint(255 * scene.frames(begins) / scene.frames(begins).max()).astype(np.uint8)
    known = dase.CameraScene(grey, begins)
    assert not find_silent_pixels(Measurement(events, known), log_eps=1e-3).found


def test_masked_pixels_of_a_patch_are_not_dead(scene):
    events = dase.simulate(scene, Sensor(), seed=5)
    events = events.select(~((abs(events.y - 34.0) <= 4) & (abs(events.x - 44.0) <= 4)))

    def trust(times, pixels):
        return np.broadcast_to(pixels % WIDTH >= 44, (len(times), len(pixels)))

    found = find_silent_pixels(Measurement(events, scene, trust=trust), log_eps=1e-3)
    assert found.found
    assert (found.pixels % WIDTH >= 44).all()


@pytest.mark.parametrize("off", [np.s_[:6], np.s_[-5:], np.s_[:, :9], np.s_[20:50, 30:60]])
def test_what_a_camera_does_not_read_is_not_dead(scene, off):
    """A margin along a border, and what is wider than any patch of dead pixels."""
    mask = np.zeros((HEIGHT, WIDTH), np.bool_)
    mask[off] = True
    events = dase.simulate(scene, Sensor(), seed=5)
    found = find_silent_pixels(Measurement(events.select(~mask[events.y, events.x]), scene), log_eps=1e-3)
    assert not len(found.pixels)


@pytest.mark.parametrize("effect", [
    EFFECTS["mismatch"](spread=0.3), EFFECTS["jitter"](spread=0.4), EFFECTS["dark"](current=0.05),
    EFFECTS["bandwidth"](cutoff=20.0), EFFECTS["refractory"](period=0.02), EFFECTS["readout"](rate=2e5),
    EFFECTS["linlog"](knee=0.15, slope=3.0), EFFECTS["vignetting"](loss=0.8),
], ids=lambda effect: effect.name)  # fmt: skip
def test_no_other_effect_silences_single_pixels(scene, effect):
    events = dase.simulate(scene, Sensor().with_effect(effect), seed=5)
    found = find_silent_pixels(Measurement(events, scene), log_eps=1e-3)
    assert not found.found
    assert found.decides
    assert found.limit().strength == pytest.approx(found.needed / found.asked)


@pytest.mark.parametrize(
    ("silent", "hardly", "dead"),
    [(3, 0, False), (4, 0, True), (4, 1, False), (12, 10, False), (64, 19, False), (667, 29, True)],
)
def test_silent_pixels_are_more_than_those_that_send_hardly_anything_say(silent, hardly, dead):
    """Four beside one were slow pixels of a dark current, twelve beside ten those of a slow pole.

    64 beside 19 came of a leak that drove memories past light that rested.
    """
    assert SilentPixels(np.arange(silent), 5940, hardly=hardly).found == dead


def test_silence_at_the_end_of_a_range_is_no_death(scene):
    """Where as many pixels send one to three events as none, what silences them does so by degrees."""
    events = dase.simulate(scene, Sensor(), seed=5)
    order = np.lexsort((events.t, events.y.astype(np.int64) * WIDTH + events.x))
    pixel = (events.y.astype(np.int64) * WIDTH + events.x)[order]
    begin = np.searchsorted(pixel, pixel)
    middle = (np.indices((HEIGHT, WIDTH))[:, 8:-8:7, 8:-8:7].reshape(2, -1) * [[WIDTH], [1]]).sum(0)[:40]
    for some, dead in (((0,), True), ((0, 1, 2, 3), False)):
        allowed = np.full(WIDTH * HEIGHT, np.iinfo(np.int64).max)
        allowed[middle] = np.resize(some, len(middle))
        kept = np.sort(order[np.arange(len(order)) - begin < allowed[pixel]])
        found = find_silent_pixels(Measurement(events.select(kept), scene), log_eps=1e-3)
        assert (found.found, found.decides) == (dead, True)
        assert len(found.pixels) >= 3
        assert found.limit().strength == pytest.approx(found.needed / found.asked)


def test_a_pixel_that_sends_after_the_end_of_the_scene_is_not_dead(scene):
    """Light had swept some dark pixels last, whose events a latency puts off beyond it."""
    events = dase.simulate(scene, Sensor().with_effect(EFFECTS["dead"](share=0.02)), seed=5)
    found = find_silent_pixels(Measurement(events, scene), log_eps=1e-3)
    late, rest = found.pixels[: len(found.pixels) // 2], found.pixels[len(found.pixels) // 2 :]
    after = dase.Events(
        np.full(len(late), 0.51), late % WIDTH, late // WIDTH, np.ones(len(late), bool), WIDTH, HEIGHT
    )
    again = find_silent_pixels(Measurement(dase.Events.concatenate([events, after]), scene), log_eps=1e-3)
    assert sorted(again.pixels) == sorted(rest)


def test_what_a_model_silences_too_is_not_dead(scene):
    """Where a model sends nothing either, silence tells nothing."""
    events = dase.simulate(scene, Sensor(), seed=5)
    alive = np.flatnonzero(counts_of(events) > 8)[:40]
    calm = np.flatnonzero(counts_of(events) == 0)[:10]
    silent = SilentPixels(np.sort(np.concatenate((alive, calm))), 5000)
    measurement = Measurement(events, scene)
    left = without_the_explained_silence(silent, measurement, Sensor(), seed=1)
    assert set(left.pixels) <= set(alive)
    assert len(left.pixels) > 0.8 * len(alive)
    slow = Sensor().with_effect(EFFECTS["bandwidth"](cutoff=0.2))
    assert not len(without_the_explained_silence(silent, measurement, slow, seed=1).pixels)
    dead = Sensor().with_effect(EFFECTS["dead"](share=1.0))
    again = without_the_explained_silence(silent, measurement, dead, seed=1)
    np.testing.assert_array_equal(again.pixels, left.pixels)
    # what needs the events of all pixels is no part of the question
    read = Sensor().with_effect(EFFECTS["readout"](rate=1e6))
    again = without_the_explained_silence(silent, measurement, read, seed=1)
    np.testing.assert_array_equal(again.pixels, left.pixels)


@pytest.mark.parametrize("span", [None, (0.1605, 0.1795)])
def test_frames_of_a_camera_tell_dead_pixels_as_well(scene, span):
    sensor = Sensor().with_effect(EFFECTS["dead"](share=0.02))
    begins = scene.sample_times()[::20]
    grey = np.rint(255 * scene.frames(begins) / scene.frames(begins).max()).astype(np.uint8)
    known = dase.CameraScene(grey, begins)
    found = find_silent_pixels(
        Measurement(dase.simulate(scene, sensor, seed=5), known, span=span), log_eps=1e-3
    )
    # between two frames no change of light is known
    assert found.found == (span is None)
    assert found.decides == (span is None)


@pytest.mark.parametrize("lit", [False, True])
def test_dead_pixels_are_not_asked_for_beside_a_lamp_and_light_that_is_a_guess(scene, lit, monkeypatch):
    """It makes neighbours send whatever the light does: six dead pixels of a sealed case were none."""
    begins = scene.sample_times()[::40]
    grey = np.rint(255 * scene.frames(begins) / scene.frames(begins).max()).astype(np.uint8)
    known = dase.CameraScene(grey, begins)
    lamp = Signature(name="flicker", answer=Answer.FOUND, details={"frequency": 120.0})
    seen = SeenEffects((lamp,) if lit else ())
    monkeypatch.setattr(compared_measurement, "find_seen_effects", lambda *args: seen)
    found = compared_measurement.choose_compared(
        Measurement(dase.simulate(scene, "ideal", seed=5), known), Sensor(), EFFECTS,
        pixels=200, seed=0, device="cpu", settings=DEFAULTS,
    )  # fmt: skip
    assert (found.silent is None) is lit


@pytest.mark.parametrize("every", [33, 7, "uneven"])
def test_clips_of_any_frame_rate_tell_dead_pixels(scene, every):
    times = scene.sample_times()
    chosen = (
        np.unique(np.geomspace(1, len(times), 90).astype(int)) - 1
        if every == "uneven"
        else slice(None, None, every)
    )
    clip = dase.VideoScene(scene.frames(times)[chosen], times[chosen])
    sensor = Sensor().with_effect(EFFECTS["dead"](share=0.02))
    events = dase.simulate(clip, sensor, seed=5)
    found = find_silent_pixels(Measurement(events, clip), log_eps=1e-3)
    assert found.found
    assert found.share.low < 0.02 < found.share.high


def test_pixels_that_are_masked_are_not_dead(scene):
    events = dase.simulate(scene, Sensor(), seed=5)
    counts = counts_of(events).reshape(HEIGHT, WIDTH)
    busy = [(y, x) for y in range(3, HEIGHT - 3, 6) for x in range(3, WIDTH - 3, 6) if counts[y, x] > 20][:20]
    mask = np.ones((HEIGHT, WIDTH), bool)
    mask[tuple(np.array(busy).T)] = False
    left = events.select(mask[events.y, events.x])
    assert find_silent_pixels(Measurement(left, scene), log_eps=1e-3).found

    def trust(times, pixels):
        return np.broadcast_to(mask.reshape(-1)[pixels], (len(times), len(pixels)))

    masked = find_silent_pixels(Measurement(left, scene, trust), log_eps=1e-3)
    assert len(masked.pixels) == 0
    assert masked.decides


def test_a_region_that_is_switched_off_has_no_dead_pixels(scene):
    events = dase.simulate(scene, Sensor(), seed=5)
    found = find_silent_pixels(Measurement(events.select(events.x > 40), scene), log_eps=1e-3)
    assert len(found.pixels) == 0


def test_rest_tells_nothing_of_dead_pixels():
    still = dase.VideoScene(np.full((2, HEIGHT, WIDTH), 0.5, np.float32), [0.0, 2.0])
    noisy = Sensor().with_effect(EFFECTS["shot"](rate=30.0)).with_effect(EFFECTS["dead"](share=0.02))
    found = find_silent_pixels(Measurement(dase.simulate(still, noisy), still), log_eps=1e-3)
    assert not found.decides


LIBRARY = {name: EFFECTS[name] for name in ("threshold", "mismatch", "dead")}


def test_dead_pixels_are_certain_and_left_out_of_the_search(scene):
    true = Sensor().with_effect(EFFECTS["mismatch"](spread=0.2)).with_effect(EFFECTS["dead"](share=0.02))
    events = dase.simulate(scene, true, seed=5)
    found = diagnose(events, scene=scene, effects=LIBRARY, pixels=200, most=2, settings=NO_LIMITS)
    grades = {one.effect: one.grade for one in found.findings}
    assert grades["dead"] is Grade.CERTAIN
    assert grades["mismatch"] is Grade.CERTAIN
    share = found.parameters["dead.share"]
    assert share.low < 0.02 < share.high
    assert found.sensor["dead"].share == share.value
    assert any("dead pixels are left out" in note for note in found.notes)


def test_without_silent_pixels_nothing_is_taken_for_dead_ones(scene):
    lacking = {name: EFFECTS[name] for name in ("threshold", "dead")}
    true = Sensor().with_effect(EFFECTS["mismatch"](spread=0.12))
    found = diagnose(dase.simulate(scene, true, seed=5), scene=scene, effects=lacking, pixels=200, most=2)
    assert not any(one.effect == "dead" for one in (*found.findings, *found.stand_ins))
    (limit,) = (one for one in found.not_seen if one.effect == "dead")
    assert limit.strength < 2e-3


@pytest.mark.slow
def test_all_of_the_time_is_fitted_where_light_comes_to_rest():
    scene = moving(1.2, until=0.78)
    true = Sensor().with_effect(EFFECTS["leak"](rate=2.0, spread=0.2))
    true = true.with_effect(EFFECTS["mismatch"](spread=0.2))
    events = dase.simulate(scene, true, seed=3)
    assert split_measurement(Measurement(events, scene), pixels=200).parts_differ
    restless = moving(1.2)
    assert not split_measurement(
        Measurement(dase.simulate(restless, true), restless), pixels=200
    ).parts_differ
    library = {name: EFFECTS[name] for name in ("threshold", "mismatch", "leak", "hot")}
    found = diagnose(events, scene=scene, effects=library, pixels=130, most=3, settings=NO_LIMITS)
    assert set(found.selected) == {"leak", "mismatch"}
    assert found.errors[-1] < found.gate
    assert any("all of it is fitted" in note for note in found.notes)


@pytest.mark.slow
def test_what_comes_late_is_fitted_there():
    # what the first part shows is little beside what comes when light rests, and a leak is not seen in it
    whole = moving(1.2, until=0.78, speed=3.0)
    frames = whole.frames(whole.sample_times()).copy()
    frames[:, :, :40] = frames[0, :, :40]
    scene = dase.VideoScene(frames, whole.sample_times())
    threshold = EFFECTS["threshold"](on=0.22, off=0.25, phase=0.0)
    true = Sensor((threshold, EFFECTS["mismatch"](spread=0.15), EFFECTS["leak"](rate=2.5, spread=0.1)))
    silent = Sensor((threshold, EFFECTS["mismatch"](spread=0.15)))
    late, early = (dase.simulate(scene, one, seed=3) for one in (true, silent))
    events = dase.Events.concatenate([early.select(early.t < 0.73), late.select(late.t >= 0.73)])
    library = {name: EFFECTS[name] for name in ("threshold", "mismatch", "leak")}
    found = diagnose(events, scene=scene, effects=library, pixels=200, most=2, settings=NO_LIMITS)
    assert any("what is left comes late" in note for note in found.notes)
    # the measurement is of no one sensor, so more than that it is seen is not asked
    assert "leak" in {one.effect for one in found.findings}
