"""Training in miniature: scenes of 48 pixels, a network of four channels."""

from __future__ import annotations

from dataclasses import replace

from dase.learning import scene_batches
from dase.learning.adversarial import AdversarialSettings, PatchHash
from dase.learning.job import compose_training
from dase.learning.recipe import Recipe
from dase.learning.targets import TRUTHS, EndlessTarget
from dase.learning.training import Training
from dase.networks.threshold_network import NetworkShape
from dase.scenes import image_sources

SIDE = 48
TINY = NetworkShape(channels=4, depth=1)
CRITICS = AdversarialSettings(hash=PatchHash(size=16, orientations=2, coherence=1, contrast=2))
WGAN = dict(objective="wgan", anchor=5.0, adversarial=CRITICS)


def small_scenes() -> scene_batches.Scenery:
    looks = scene_batches.SceneSettings(width=SIDE, height=SIDE, samples=6, regime="variety")
    return scene_batches.Scenery(image_sources.open_images("builtin"), looks, backgrounds=6, objects=8)


def a_run(scenes: scene_batches.Scenery, **changes) -> Training:
    recipe = Recipe(objective="moments", steps=40, warmup=6, batch=4, ramp=5, network=TINY, rate=1e-4)
    target = EndlessTarget(scenes, TRUTHS["uniform"](), seed=9)
    return compose_training(replace(recipe, **changes), target, scenes)


def a_fake(training):
    numbers = training.scenery.draw_numbers(training.scenes, training.recipe.batch)
    return training.simulate_fake(scene_batches.send_words(numbers, training.device), training.step)[0]
