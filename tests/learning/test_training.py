"""Learning thresholds: scenes, patches, objectives, moments, held-out scores."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.tiny_training import SIDE, a_fake, a_run, small_scenes
from reference import patch_structure

from dase.learning import scene_batches
from dase.learning.adabelief import AdaBelief
from dase.learning.adversarial import (
    AdversarialObjective,
    AdversarialSettings,
    PatchHash,
    PatchHasher,
    critic_maps,
    cut_patches,
)
from dase.learning.baselines import RandomThresholds, constant_thresholds, match_event_rate
from dase.learning.evaluation import HeldOutScore
from dase.learning.gauss_newton import GaussNewton
from dase.learning.job import Job
from dase.learning.moment_matching import (
    CellMoments,
    MomentWeighting,
    add_neighbour_features,
    single_pixel_features,
)
from dase.learning.moment_objective import MomentObjective
from dase.learning.recipe import Recipe
from dase.learning.targets import (
    TRUTHS,
    EndlessTarget,
    FiniteTarget,
    Pairs,
    draw_noise,
    flip_pairs,
    record_pairs,
    simulate_counts,
    vary_parameters,
    vary_thresholds,
)
from dase.learning.training import threshold_prior
from dase.networks.threshold_network import (
    NetworkShape,
    ThresholdMaps,
)
from dase.scenes.image_sources import BACKGROUND, Picture
from dase.scenes.layers import Layer, LayerScene, Motion


@pytest.fixture(scope="module")
def scenes() -> scene_batches.Scenery:
    return small_scenes()


def test_batches_show_what_layer_scenes_show(scenes):
    """So do samples that lead up to a window, of layers whose paths are followed back."""
    window = scenes.scene_settings.window
    led = scene_batches.Scenery.__new__(scene_batches.Scenery)
    led.__dict__.update(scenes.__dict__, lead=np.array([-window, -0.5 * window]))
    log = led.draw(np.random.default_rng(5), 2)
    np.testing.assert_array_equal(log[:, 2:], scenes.draw(np.random.default_rng(5), 2))
    rng = np.random.default_rng(5)
    motion = scene_batches.draw_motion(rng, scenes.scene_settings, 2)
    front = rng.integers(len(scenes.size) - 1, size=motion.there.shape)
    ground = rng.integers(len(scenes.grey), size=2)
    for b in range(2):
        layers = []
        for n in np.flatnonzero(motion.there[b]):
            names = ("x", "y", "angle", "scale_x", "scale_y")
            ends = {name: getattr(motion, name)[b, n] for name in names}
            how = Motion(**{name: (2 * begin - end, end) for name, (begin, end) in ends.items()})
            grey = scenes.grey[ground[b]].numpy().reshape(BACKGROUND)
            picture = Picture(grey)
            if n:
                (width, height), start = scenes.size[front[b, n]], int(scenes.start[front[b, n]])
                texels = scenes.texels[start : start + width * height].numpy().reshape(height, width, 2)
                alpha = texels[..., 1]
                light = np.where(alpha > 0, texels[..., 0] / np.maximum(alpha, 1e-9), 0).astype(np.float32)
                picture = Picture(light, alpha)
            layers.append(Layer(picture, how))
        scene = LayerScene(layers, width=SIDE, height=SIDE, duration=2 * window)
        want = scene.frames(np.array([0, 0.5, *np.linspace(1, 2, 6)]) * window)
        np.testing.assert_allclose(np.exp(log[b].numpy()) - scene_batches.LOG_EPS, want, atol=1e-5)


def test_halves_of_a_pool_share_no_texture(scenes):
    first, second = scenes.split(0.5)
    assert len(first.grey) + len(second.grey) == len(scenes.grey)
    assert len(first.start) + len(second.start) == len(scenes.start) + 1  # both have the empty one
    assert not set(first.start[:-1]) & set(second.start[:-1])
    assert first.draw(np.random.default_rng(0), 1).shape == (1, 6, SIDE, SIDE)
    assert second.draw(np.random.default_rng(0), 1).shape == (1, 6, SIDE, SIDE)


def hasher_of(**how):
    return PatchHasher(PatchHash(size=16, **how))


@pytest.mark.parametrize("contrast_from", ["energy", "events"])
def test_classes_are_levels_of_the_twins_attributes(scenes, rng, contrast_from):
    grey = scene_batches.middle_intensity(scenes.draw(rng, 3))
    counts = torch.from_numpy(rng.poisson(1.0, (3, 2, SIDE, SIDE)).astype(np.float32))
    angle, coherence, _, energy, contrast = patch_structure.attributes(grey.numpy(), counts.numpy(), 16, 16)
    hasher = hasher_of(contrast_from=contrast_from)
    hasher.calibrate(Pairs(grey, counts))
    levels = {"coherence": coherence, "contrast": energy if contrast_from == "energy" else contrast}
    want = np.floor(angle.ravel() * 24 / np.pi + 0.5).astype(int) % 24
    for name, values in levels.items():
        edges = hasher.boundaries[name].numpy().astype(float)
        # the boundaries are values of patches, which the twin has but for rounding
        above = (values.ravel()[:, None] > edges * (1 + 1e-4)).sum(1)
        assert np.bincount(above, minlength=3).min() >= 7  # thirds of 27 patches, boundaries below
        want = 3 * want + above
    np.testing.assert_array_equal(hasher.classes(Pairs(grey, counts)), want)


@pytest.mark.parametrize("edge", [1, 5, 12, 23])
def test_bins_of_orientation_meet_where_they_should(edge):
    y, x = np.indices((48, 48))
    for offset, bucket in ((-0.02, edge - 1), (0.02, edge)):
        angle = (edge - 0.5) * np.pi / 24 + offset
        along = np.arcsin(0.5 * np.cos(angle)) * x + np.arcsin(0.5 * np.sin(angle)) * y
        some = Pairs(
            torch.from_numpy(np.sin(along + 0.3)[None].astype(np.float32)), torch.zeros(1, 2, 48, 48)
        )
        # of nine patches that in the middle, which touches no border
        assert hasher_of(coherence=1, contrast=1).classes(some)[4] == bucket


def test_a_level_more_than_the_attribute_has_values_stays_empty(rng):
    quiet = Pairs(torch.from_numpy(rng.random((2, 32, 32)).astype(np.float32)), torch.zeros(2, 2, 32, 32))
    hasher = hasher_of(orientations=1, coherence=1, contrast_from="events")
    hasher.calibrate(quiet)
    assert (hasher.classes(quiet) == 0).all()
    assert (hasher.classes(Pairs(quiet.grey, torch.eye(16).tile(2, 2, 2, 2))) == 2).all()


def test_patches_are_cut_in_the_order_of_their_hash():
    maps = torch.arange(2 * 3 * 8 * 12, dtype=torch.float32).view(2, 3, 8, 12)
    got = cut_patches(maps, 4)
    assert got.shape == (2 * 2 * 3, 3 * 16)
    assert torch.equal(got[1].view(3, 4, 4), maps[0, :, :4, 4:8])
    assert torch.equal(got[6 + 3].view(3, 4, 4), maps[1, :, 4:, :4])


def test_critics_see_logarithms_of_counts_and_gradients():
    counts = torch.zeros(1, 2, 3, 3)
    counts[0, 1, 1, 1] = 3.0
    maps = critic_maps(counts)[0]
    assert maps[1, 1, 1] == pytest.approx(0.5 * math.log(4.0))
    # to the right and down of the middle the count falls by 3 both ways; above it, it rises by 3
    assert maps[3, 1, 1] == pytest.approx(0.5 * math.log1p(math.sqrt(18.0)), rel=1e-4)
    assert maps[3, 0, 1] == pytest.approx(0.5 * math.log1p(3.0), rel=1e-4)
    assert float(maps[0].abs().max()) == 0


def test_weights_of_classes_are_those_of_eq_13():
    how = PatchHash(size=8, orientations=4, coherence=1, contrast=1)
    objective = AdversarialObjective(AdversarialSettings(hash=how, uniform=0.5), device="cpu")
    objective.seen = torch.tensor([6.0, 2.0, 0.0, 0.0])
    assert objective.weights().tolist() == pytest.approx([0.5, 0.25, 0.125, 0.125])
    objective.settings = replace(objective.settings, uniform=1.0)
    assert objective.weights().tolist() == pytest.approx([0.25] * 4)


def test_the_prior_is_minimised_not_maximised():
    mu, sigma = torch.tensor([[0.3]]), torch.tensor([[0.2]], requires_grad=True)
    value = threshold_prior(ThresholdMaps(mu, sigma, torch.ones(()), mu))
    normal = torch.distributions.Normal
    want = torch.distributions.kl_divergence(normal(mu, sigma), normal(0.0, 1.0)).mean()
    torch.testing.assert_close(value, want)
    value.backward()
    assert float(sigma.grad) < 0  # descent makes a small spread larger, as Eq. 9 is meant to


def test_adabelief_by_hand():
    p = torch.nn.Parameter(torch.tensor([1.0]))
    optimizer = AdaBelief([p], lr=0.1, betas=(0.9, 0.99), eps=1e-16)
    mean = spread = 0.0
    want = 1.0
    for step, gradient in enumerate((2.0, -1.0, 0.5), start=1):
        p.grad = torch.tensor([gradient])
        optimizer.step()
        mean = 0.9 * mean + 0.1 * gradient
        spread = 0.99 * spread + 0.01 * (gradient - mean) ** 2 + 1e-16
        want -= 0.1 * (mean / (1 - 0.9**step)) / (math.sqrt(spread / (1 - 0.99**step)) + 1e-16)
        assert float(p.detach()) == pytest.approx(want, rel=1e-5)


def test_counts_answer_as_central_differences_say(scenes, rng):
    log, generator = scenes.draw(rng, 4), torch.Generator().manual_seed(0)
    noise = draw_noise(log, generator)
    level = torch.tensor(math.log(0.2), requires_grad=True)
    mu = level.exp().expand(4, SIDE, SIDE)
    varied = vary_thresholds(log, mu, 0.25 * mu, noise)
    counts = simulate_counts(log, mu.detach(), 0.25 * mu.detach(), noise)
    value = varied.with_gradient(lambda c: c.square(), counts)
    assert torch.equal(value.detach(), counts.square())
    (slope,) = torch.autograd.grad(value.mean(), level)
    ends = [
        simulate_counts(log, 0.2 * f * torch.ones_like(mu), 0.05 * f, noise) for f in (1.105171, 0.904837)
    ]
    want = (ends[0].square() - ends[1].square()).mean() / (2 * math.sinh(0.1))
    # spread and level scale together, but where the floor cuts
    torch.testing.assert_close(slope, want, rtol=2e-2, atol=1e-3)


def test_newton_knows_how_moments_move(scenes):
    training = a_run(scenes, network=NetworkShape(channels=4, depth=1, split=True), mu=0.2, sigma=0.05)
    training.calibrate()
    assert isinstance(training.objective, MomentObjective)
    training.objective.newton.add_answers(a_fake(training))
    jacobian = training.objective.newton._jacobian()
    moments = training.objective.moments
    log, noise = scenes.draw(np.random.default_rng(1), 4), None
    noise = draw_noise(log, torch.Generator().manual_seed(1))
    grey, even = scene_batches.middle_intensity(log), torch.full((4, 2, SIDE, SIDE), 0.2)
    other = Pairs(grey, simulate_counts(log, even, 0.25 * even, noise))
    other.answers = vary_parameters(log, even, 0.25 * even, noise)
    newton = GaussNewton(moments, training.net)
    newton.add_answers(other)
    means = []
    for ratio in (1.04, 1 / 1.04):
        factor = torch.tensor([ratio**-0.5, ratio**0.5]).view(1, 2, 1, 1)
        counts = simulate_counts(log, even * factor, 0.25 * even * factor, noise)
        sums, number = moments.cell_sums(Pairs(grey, counts))["look"]
        means.append(sums.sum(0) / number.sum(0).clamp_min(1)[:, None])
    slope = ((means[0] - means[1]) / (2 * math.log(1.04))).flatten().double()
    got = newton._jacobian()[:, 2]
    assert jacobian.shape == (30 * 13, 3)
    assert float((slope @ got) / (slope.norm() * got.norm())) > 0.95
    assert float(slope.norm() / got.norm()) == pytest.approx(1.0, abs=0.15)


def test_weights_of_moments_invert_their_covariance(rng):
    cells = CellMoments(2, 3, device=torch.device("cpu"), memory=0.9, joint=True)
    scenes_, pixels = 4000, torch.tensor([10.0, 20.0])
    root = torch.from_numpy(rng.normal(size=(6, 6)))
    values = torch.from_numpy(rng.normal(size=(scenes_, 6))) @ root
    cells.add_reference(values.view(-1, 2, 3) * pixels.view(1, 2, 1), pixels.expand(scenes_, 2))
    cells.weigh()
    covariance = root.T @ root
    how = MomentWeighting()
    loaded = covariance + torch.diag((how.ridge + how.scarce_ridge * 6 / scenes_) * covariance.diagonal())
    want = torch.linalg.inv(loaded) / 6
    torch.testing.assert_close(
        cells.kept["weight"][0].double(), want, rtol=0.2, atol=0.02 * float(want.max())
    )
    # where moments do not fit, each weighs by its own variance
    cells.weigh(excess=1e4)
    weight = cells.kept["weight"][0]
    assert float((weight - torch.diag(weight.diagonal())).abs().max()) < 1e-2 * float(weight.diagonal().min())


def test_features_of_neighbours_tell_the_spread(scenes, rng):
    log = scenes.draw(rng, 6)
    noise = draw_noise(log, torch.Generator().manual_seed(3))
    mu = torch.full((6, SIDE, SIDE), 0.2)
    narrow, wide = (
        add_neighbour_features(single_pixel_features(simulate_counts(log, mu, s, noise)))
        for s in (0.01, 0.08)
    )
    assert narrow.shape == (6, 13, SIDE, SIDE)
    assert float(wide[:, 9:11].mean()) > 1.1 * float(narrow[:, 9:11].mean())  # of roughness squared
    assert float(wide[:, :2].mean()) == pytest.approx(float(narrow[:, :2].mean()), rel=0.1)


def test_finite_targets_hold_out_the_last_and_mirror_the_rest(scenes):
    endless = EndlessTarget(scenes, TRUTHS["uniform"]())
    pairs = record_pairs(endless, np.random.default_rng(0), 10, batch=4)
    target = FiniteTarget(pairs, held_out=0.2)
    assert (len(target.recorded), len(target.held_out()), target.scenes) == (8, 2, 8.0)
    assert torch.equal(target.held_out().grey, pairs.grey[8:])
    some = pairs.select(slice(3))
    across, along, turn = torch.tensor([[1, 0, 1], [0, 1, 1], [0, 1, 1]], dtype=torch.bool)
    mirrored = flip_pairs(some, across, along, turn)
    for n in range(3):
        for maps, got in ((some.grey[n], mirrored.grey[n]), (some.counts[n], mirrored.counts[n])):
            want = maps.flip([axis for axis, on in ((-1, across), (-2, along)) if on[n]])
            assert torch.equal(got, want.transpose(-1, -2) if turn[n] else want)
    drawn = target.draw(np.random.default_rng(0), 6)
    levels = pairs.grey[:8].float().sum((1, 2))
    assert all(float((levels - g.sum()).abs().min()) < 1e-2 for g in drawn.grey)


def test_a_held_out_score_finds_the_nearest(scenes):
    pairs = record_pairs(EndlessTarget(scenes, TRUTHS["uniform"]()), np.random.default_rng(0), 48)
    held = HeldOutScore(scenes, pairs.select(slice(None)), scenes=48)
    scores = [held.score(constant_thresholds(mu, mu / 4)) for mu in (0.1, 0.2, 0.4)]
    assert scores[1] < 0.5 * min(scores[0], scores[2])
    numbers = held.statistics(constant_thresholds(0.2, 0.05))
    assert numbers["rate"] == pytest.approx(1.0, abs=0.35)
    assert numbers["counts"] < held.statistics(constant_thresholds(0.4, 0.1))["counts"]


def test_baselines(scenes):
    pairs = record_pairs(EndlessTarget(scenes, TRUTHS["uniform"]()), np.random.default_rng(0), 96)
    tuned = match_event_rate(pairs, scenes, scenes=36)
    assert float(tuned.level[0].detach().exp()) == pytest.approx(0.2, rel=0.4)
    maps = RandomThresholds(0)(torch.rand(6, 32, 32))
    assert len(set(maps.mu[:, 0, 0].tolist())) == 6
    assert 1 / 1.5 <= float(maps.ratio) <= 1.5


def test_recipes_survive_their_text():
    network = NetworkShape(table=(6, 5), pattern=(3, 4))
    recipe = Recipe.from_names(hash=PatchHash(size=8), network=network, cells=(2, 3), steps=7)
    assert (recipe.adversarial.hash.size, recipe.moments.cells, recipe.steps) == (8, (2, 3), 7)
    assert Recipe.parse(recipe.text()) == recipe
    assert json.loads(recipe.text())["network"]["table"] == [6, 5]


def test_samples_follow_each_other_as_the_paper_asks():
    paper = Job(targets=("esim",), preset="paper", window=1 / 30).scene_settings()
    assert paper.samples == 35  # 34 steps of at most 1 ms
    assert Job(targets=("esim",), window=0.05).scene_settings().samples == 24
    assert Job(targets=("esim",), preset="paper", samples=400).scene_settings().samples == 400
    recipe = Job(targets=("esim",), preset="paper").recipe()
    assert recipe.batch == 48
    assert recipe.adversarial.plain_counts
    assert Recipe.parse(recipe.text()) == recipe


def test_critics_see_counts_or_logarithms(scenes):
    counts = torch.tensor([[[[0.0, 3.0], [1.0, 0.0]]] * 2])
    plain = critic_maps(counts, plain=True)
    assert torch.equal(plain[:, :2], counts)
    torch.testing.assert_close(critic_maps(counts), 0.5 * torch.log1p(plain))
    run = a_run(
        scenes, objective="wgan", adversarial=AdversarialSettings(plain_counts=True, hash=PatchHash(size=16))
    )
    fake = a_fake(run)
    assert torch.equal(run.objective._patches(fake), cut_patches(critic_maps(fake.counts, plain=True), 16))
