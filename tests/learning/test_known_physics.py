"""Thresholds learned on top of a sensor's other effects."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.tiny_training import TINY, small_scenes

import dase
from dase.effects import EFFECTS
from dase.learning.job import compose_training, simulate_target, write_sensor
from dase.learning.known_physics import KnownPhysics
from dase.learning.recipe import Recipe
from dase.learning.scene_batches import middle_intensity
from dase.learning.targets import draw_noise, simulate_counts
from dase.networks.threshold_network import ThresholdMaps
from dase.scenes.scene import LOG_EPS
from dase.scenes.video import VideoScene
from dase.simulation.simulate import count

THRESHOLD = {"on": 0.22, "off": 0.18}
SLOW = dase.Sensor(
    (EFFECTS["bandwidth"](cutoff=15.0), EFFECTS["threshold"](**THRESHOLD), EFFECTS["mismatch"](spread=0.1))
)


@pytest.fixture(scope="module")
def scenes():
    return small_scenes()


def maps_of(grey: torch.Tensor, sigma: float) -> ThresholdMaps:
    mu = torch.full_like(grey, math.sqrt(THRESHOLD["on"] * THRESHOLD["off"]))
    ratio = torch.tensor(THRESHOLD["on"] / THRESHOLD["off"])
    return ThresholdMaps(mu, torch.full_like(mu, sigma), ratio, torch.zeros(len(grey), 2, *grey.shape[1:]))


def test_counts_are_those_of_the_sensor(scenes):
    """As `dase` counts the same samples, pixel by pixel, where no pixel draws anything."""
    still = SLOW.without("mismatch").with_effect(EFFECTS["threshold"](**THRESHOLD, phase=0.0))
    physics = KnownPhysics(still, scenes.scene_settings, batch=2, device=torch.device("cpu"))
    log = scenes.draw(np.random.default_rng(1), 2)
    got = physics.count(log, maps_of(middle_intensity(log), 1e-9)).numpy()
    looks = scenes.scene_settings
    times = np.linspace(0, looks.window, looks.samples)
    for n in range(2):
        frames = torch.exp(log[n]).numpy() - np.float32(LOG_EPS)
        scene = VideoScene(np.clip(frames, 0, 1), times)
        scene.sample_times = lambda: times
        want = count(scene, still, (-1.0, looks.window))[0, 0].reshape(got[n].shape)
        assert np.mean(got[n] != want) < 5e-3
        assert want.sum() > 100


def test_what_leads_up_to_a_window_counts_no_events_but_leaves_its_traces(scenes):
    """As `dase` counts the last three of six samples of pixels that have seen the first three."""
    still = SLOW.without("mismatch").with_effect(EFFECTS["threshold"](**THRESHOLD, phase=0.0))
    whole = scenes.scene_settings
    times = np.linspace(0, whole.window, whole.samples)
    looks = replace(whole, samples=3, window=times[-1] - times[3])
    lead = times[:3] - times[3]
    physics = KnownPhysics(still, looks, lead=lead, batch=2, device=torch.device("cpu"))
    log = scenes.draw(np.random.default_rng(1), 2)
    maps = maps_of(middle_intensity(log, 3), 1e-9)
    known = torch.ones(2, *log.shape[2:], dtype=torch.bool)
    known[:, :20] = False
    got = physics.with_batch(2, 1).count(log, maps, known).numpy()
    assert not got[:, :, :20].any()
    for n in range(2):
        frames = torch.exp(log[n]).numpy() - np.float32(LOG_EPS)
        scene = VideoScene(np.clip(frames, 0, 1), times)
        scene.sample_times = lambda: times
        want = count(scene, still, (times[3], whole.window))[0, 0].reshape(got[n].shape)[:, 20:]
        assert np.mean(got[n][:, 20:] != want) < 5e-3
        assert want.sum() > 50
    alone = KnownPhysics(still, looks, batch=2, device=torch.device("cpu"))
    assert alone.count(log[:, 3:], maps, known).sum() < 0.9 * got.sum()  # as if all had stood still before


def test_pixels_differ_as_the_maps_say(scenes):
    physics = KnownPhysics(SLOW, scenes.scene_settings, batch=4, device=torch.device("cpu"))
    log = scenes.draw(np.random.default_rng(2), 4)
    maps = maps_of(middle_intensity(log), 0.05)
    plain = KnownPhysics(
        dase.load_sensor("ideal"), scenes.scene_settings, batch=4, device=torch.device("cpu")
    )
    noise = draw_noise(log, torch.Generator().manual_seed(0))
    # without other effects they are the counts of training, drawn otherwise
    want = simulate_counts(log, *maps.by_polarity(), noise).sum((0, 2, 3))
    torch.testing.assert_close(plain.count(log, maps).sum((0, 2, 3)), want, rtol=0.06, atol=0)
    assert physics.count(log, maps).sum() < 0.8 * want.sum()
    assert not torch.equal(plain.count(log, maps), plain.count(log, maps))


@pytest.mark.slow
def test_thresholds_beside_a_slow_photoreceptor(scenes, tmp_path):
    """With what is known of the camera the thresholds are its own, without they make up for it."""
    target = simulate_target(SLOW, scenes, 24, seed=5)
    recipe = Recipe(
        objective="moments", steps=50, warmup=4, batch=6, ramp=5, rate=0.0, mu=0.3,
        network=replace(TINY, split=True),
    )  # fmt: skip
    truth = math.sqrt(THRESHOLD["on"] * THRESHOLD["off"])
    found = []
    for known in (SLOW, None):
        training = compose_training(recipe, target, scenes, known)
        while training.step < recipe.steps:
            training.advance()
        found.append(float(training.mean.level[0].detach().exp()))
    assert truth < found[0] < 1.3 * truth  # from above, and not yet there
    assert found[1] > 3 * truth
    state = training.state()
    assert state["random"][0]["physics"] is None
    path = write_sensor(tmp_path, training.mean, mu=found[1], name="learned", known=SLOW)
    written = dase.load_sensor(path)
    assert [e.name for e in written.effects] == ["bandwidth", "threshold", "learned_threshold"]
    assert written["bandwidth"].cutoff == 15.0


def test_refusals(scenes):
    def known(sensor):
        return KnownPhysics(sensor, scenes.scene_settings, batch=1, device=torch.device("cpu"))

    lens = dase.load_sensor("ideal").with_effect(EFFECTS["optics_blur"](sigma=1.0))
    assert known(lens.with_effect(EFFECTS["readout"](rate=1e6))).left_out == ("optics_blur", "readout")
    with pytest.raises(dase.InputError, match="learn without latency and jitter"):
        known(lens.with_effect(EFFECTS["latency"](delay=1e-3)))
    with pytest.raises(dase.InputError, match="has learned thresholds"):
        known(lens.with_effect(EFFECTS["learned_threshold"]()))
    with pytest.raises(ValueError, match="log must be 1 scenes of 6 samples"):
        known(lens).count(torch.zeros(2, 6, 8, 8), maps_of(torch.zeros(2, 8, 8), 0.1))
