"""Scenes: moving layers, their flow and sampling; videos; the motion regimes of S2R."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import warp as wp
from reference import pixel as reference

import dase
from dase.datasets.generate import DatasetJob, make_scene
from dase.kernels import launch, scene_render
from dase.scenes import layers, random_scenes
from dase.scenes.image_sources import ImageSource

SIZES = [(12, 9), (7, 13), (10, 10), (1, 6), (15, 4)]


def picture(rng: np.random.Generator, size: tuple[int, int], alpha: str = "none") -> dase.Picture:
    """Return a random texture; its alpha is none, soft or a hole."""
    grey = rng.random(size[::-1], np.float32)
    if alpha == "none":
        return dase.Picture(grey)
    opacity = rng.random(size[::-1], np.float32)
    return dase.Picture(grey, opacity if alpha == "soft" else opacity.round())


def motion(rng: np.random.Generator, scale: tuple[float, float]) -> dase.Motion:
    """Return a random motion."""
    zoom, place = rng.uniform(*scale, (2, 2)).tolist(), rng.uniform(-0.5, 0.5, (2, 2)).tolist()
    return dase.Motion(
        x=tuple(place[0]),
        y=tuple(place[1]),
        angle=tuple(rng.uniform(-3, 3, 2).tolist()),
        scale_x=tuple(zoom[0]),
        scale_y=tuple(zoom[1]),
    )


def scene(rng: np.random.Generator, layers: int = 5, size: tuple[int, int] = (21, 16)) -> dase.LayerScene:
    """Return a scene of small random layers."""
    made = [dase.Layer(picture(rng, (11, 14)), motion(rng, (0.4, 1.5)))]
    for n in range(layers - 1):
        texture = picture(rng, SIZES[n % len(SIZES)], ("soft", "hole", "none")[n % 3])
        made.append(dase.Layer(texture, motion(rng, (0.2, 0.8))))
    return dase.LayerScene(made, width=size[0], height=size[1], duration=0.7)


def shaken(rng: np.random.Generator, **options) -> dase.LayerScene:
    """Return a scene whose camera sways, turns, zooms and pauses before layers, one of which does so too."""
    made = scene(rng)
    quantities = ("x", "y", "angle", "scale_x", "scale_y", "x", "angle")
    waves = tuple(
        dase.Wave(name, rng.uniform(0.02, 0.08), rng.uniform(0.5, 4), rng.uniform(0, 6))
        for name in quantities
    )
    pauses = ((0.11, 0.19), (0.19, 0.2), (0.4, 0.6))
    camera = dase.Motion(x=(0.0, 0.1), scale_x=(1.1, 0.9), angle=(0.2, -0.1), waves=waves, pauses=pauses)
    layers = list(made.layers)
    swaying = replace(layers[1].motion, waves=waves[:3], pauses=((0.3, 0.35),))
    layers[1] = replace(layers[1], motion=swaying)
    size = {"width": made.width, "height": made.height, "duration": made.duration}
    return dase.LayerScene(layers, **size, camera=camera, **options)


def test_a_moving_camera_and_light_match_the_twin(device, rng):
    light = dase.Lighting(stops=1.5, frequency=1.7, phase=0.4, drops=((0.2, -1.0), (0.5, 0.5)))
    made = shaken(rng, lighting=light)
    times = np.linspace(0, made.duration, 9)
    want = np.stack([reference.frame(made, t) for t in times])
    np.testing.assert_allclose(made.frames(times, device), want, atol=1e-5)
    assert want.std() > 0.02
    # what pixels see is what frames show
    pixels = np.arange(3, 40, dtype=np.int32)
    name, seen = made.source(times, pixels, wp.get_device(device))
    assert name == "frames"
    np.testing.assert_allclose(seen.values.numpy(), want.reshape(len(times), -1)[:, pixels], atol=1e-5)


def test_flow_before_a_moving_camera_is_the_derivative_of_the_motion(device, rng):
    made = shaken(rng)
    times = np.array([0.05, 0.15, 0.25, 0.33, 0.5, 0.65])  # in a pause of the camera, of a layer, in none
    got, want = made.flow(times, device), np.stack([reference.flow(made, t) for t in times])
    wrong = np.abs(got - want).max(1) > 1e-4 * np.abs(want).max()
    assert wrong.mean() < 0.003
    assert np.abs(want).max() > 20
    assert np.all(np.abs(made.flow(times, device)).max((1, 2, 3)) <= made.speed(times).max() * 1.001)


def test_less_travel_between_samples_is_nearer_to_the_light(device):
    """Events of the same scene come to those of the light itself, which coarse samples cut the corners of."""

    def of_travel(travel: float) -> tuple[dase.LayerScene, int]:
        images = dase.open_images("builtin")
        rng = np.random.default_rng(5)
        made = random_scenes.draw_scene(
            rng, images, "shake", width=64, height=48, duration=0.2, travel=travel
        )
        return made, len(dase.simulate(made, "ideal", device=device))

    (coarse, fewer), (usual, some), (fine, more), (_, all_) = map(of_travel, (1.0, 0.5, 0.125, 0.02))
    at = np.linspace(0, 0.2, 5)
    np.testing.assert_array_equal(coarse.frames(at, device), fine.frames(at, device))
    assert len(coarse.sample_times()) < len(usual.sample_times()) < len(fine.sample_times())
    assert fewer < some < more < all_
    assert all_ - more < 0.25 * (all_ - some)


def test_travel_of_a_data_set_is_recorded_where_it_is_not_the_usual():
    job = DatasetJob(
        images="builtin", sensor="[threshold]", sequences=1, width=32, height=24, duration=0.1, regime="fast"
    )
    assert "travel" not in job.text()
    finer = replace(job, travel=0.125)
    assert "travel = 0.125" in finer.text()
    assert make_scene(job, 0).travel == 0.5
    assert make_scene(finer, 0).travel == 0.125
    assert make_scene(finer, 0).shortest == pytest.approx(2.5e-4)
    for wrong in (0.0, 1.5, float("nan")):
        with pytest.raises(dase.InputError, match=r"travel must be 0\.01 to 1 px"):
            replace(job, travel=wrong)


def test_shake_is_a_regime(rng):
    images = dase.open_images("builtin")
    speeds = []
    for _ in range(20):
        made = random_scenes.draw_scene(rng, images, "shake", width=64, height=48, duration=2.0)
        pauses = made.camera.pauses
        grid = np.linspace(0, 2, 400)
        still = any(a <= t < b for t in grid for a, b in pauses)
        _, rate = made.camera.path(grid, 2.0)
        assert (np.abs(rate).max(0) == 0).any() == still
        assert np.sum(np.diff(np.sign(rate[0])) != 0) >= 2  # it turns back
        speeds.append(64 * np.sqrt(np.mean(np.sum(rate[:2] ** 2, 0))))
    assert 10 < min(speeds) < 100 < max(speeds) < 2000


@pytest.mark.parametrize("size", [(21, 16), (9, 20), (1, 1)])
def test_frames_match_the_twin(device, rng, size):
    made = scene(rng, size=size)
    times = np.linspace(0, made.duration, 7)
    want = np.stack([reference.frame(made, t) for t in times])
    np.testing.assert_allclose(made.frames(times, device), want, atol=1e-5)
    assert want.std() > 0.05 or size == (1, 1)


@pytest.mark.parametrize("size", [(21, 16), (1, 1)])
def test_greys_are_rounded_frames(device, rng, size):
    made = scene(rng, size=size)
    # from 0 to 255 and beyond, with levels half way between two
    halves = dase.Picture(((np.arange(256, dtype=np.float32) - 0.5) / 255 * 1.01).reshape(16, 16))
    still = dase.Motion(scale_x=(1.0, 1.0), scale_y=(1.0, 1.0))
    steps = dase.LayerScene([dase.Layer(halves, still)], width=16, height=16, duration=0.1)
    times = np.linspace(0, 0.1, 3)
    for one in (made, steps, shaken(rng, lighting=dase.Lighting(stops=1.0))):
        want = np.clip(np.rint(one.frames(times, device) * np.float32(255)), 0, 255)
        got = one.grey_frames(times, device)
        assert got.dtype == np.uint8
        np.testing.assert_array_equal(got, want)
    assert np.ptp(steps.grey_frames(times, device)) == 255


def test_a_background_of_one_texel_fills_the_picture(device):
    still = dase.Layer(dase.Picture(np.full((1, 1), 0.3, np.float32)), dase.Motion(x=(0.0, 2.0)))
    made = dase.LayerScene([still], width=5, height=4, duration=1.0)
    np.testing.assert_array_equal(made.frames(np.array([0.0, 0.5]), device), np.float32(0.3))


def test_a_layer_at_rest_is_its_texture(device, rng):
    made = dase.LayerScene([dase.Layer(picture(rng, (6, 5)), dase.Motion())], width=6, height=5, duration=1.0)
    grey = made.layers[0].picture.grey
    np.testing.assert_allclose(made.frames(np.zeros(1), device)[0], grey, atol=1e-6)
    assert np.abs(made.flow(np.zeros(1), device)).max() == 0


def test_the_pixel_kernel_sees_the_frames(device, rng):
    made = scene(rng)
    times = made.sample_times()
    stored = dase.VideoScene(made.frames(times, device), times)
    # compilers may contract the two kernels differently
    sensor = dase.Sensor((dase.EFFECTS["threshold"](),))
    a, b = (dase.count(s, sensor, [0, made.duration], device=device) for s in (made, stored))
    assert a.sum() > 100
    assert np.mean(a != b) < 1e-3


def test_flow_is_the_derivative_of_the_motion(device, rng):
    made = scene(rng)
    times = np.linspace(0.05, 0.65, 6)
    got, want = made.flow(times, device), np.stack([reference.flow(made, t) for t in times])
    size = np.abs(want).max()
    wrong = np.abs(got - want).max(1) > 1e-4 * size
    # where the border of a layer passes through a pixel, float32 may see it on the other side
    assert wrong.mean() < 0.003
    assert size > 5


def test_speed_bounds_the_flow(device, rng):
    for _ in range(6):
        made = scene(rng)
        times = np.linspace(0, made.duration, 9)
        shown = np.linalg.norm(made.flow(times, device), axis=1).max((1, 2))
        assert np.all(shown <= made.speed(times) * (1 + 1e-5))


def test_speed_is_tight_where_nothing_is_hidden(device, rng):
    # many pixels, so that one lies near the corner of the object that is the fastest
    for _ in range(3):
        still = dase.Layer(picture(rng, (8, 8)), dase.Motion())
        thing = dase.Layer(picture(rng, (8, 5)), motion(rng, (0.2, 0.7)))
        made = dase.LayerScene([still, thing], width=160, height=120, duration=0.5)
        times = np.linspace(0, made.duration, 5)
        shown = np.linalg.norm(made.flow(times, device), axis=1).max((1, 2))
        np.testing.assert_allclose(made.speed(times), shown, rtol=0.03)


def moved(made: dase.LayerScene, begin: float, end: float) -> float:
    """Return how far anything travels inside the picture [px]."""
    longest, last = 0.0, np.array([made.width - 1, made.height - 1])
    for number, layer in enumerate(made.layers):
        h, w = layer.picture.grey.shape
        for here, there in ((begin, end), (end, begin)):
            texels = reference.to_texture(made, number, here, reference.grid(made))
            inside = np.all((texels > -1) & (texels < [w, h]), -1) | (number == 0)
            way = reference.to_sensor(made, number, there, texels) - reference.grid(made)
            room = np.where(way > 0, last - reference.grid(made), reference.grid(made))
            share = np.minimum(room / np.maximum(np.abs(way), 1e-12), 1).min(-1)
            longest = max(longest, float((np.linalg.norm(way, axis=-1) * share * inside).max()))
    return longest


def entering() -> dase.LayerScene:
    """Return a still picture that a fast object shoots into after a third of the time."""
    grey = np.linspace(0, 1, 64, dtype=np.float32).reshape(8, 8)
    quick = dase.Motion(x=(-2.0, 4.0), scale_x=(0.2, 0.2), scale_y=(0.2, 0.2))
    layers = [dase.Layer(dase.Picture(grey), dase.Motion()), dase.Layer(dase.Picture(grey), quick)]
    return dase.LayerScene(layers, width=32, height=24, duration=0.6)


@pytest.mark.parametrize("kind", ["random", "entering"])
def test_sampling_obeys_equation_5(rng, kind):
    for _ in range(3 if kind == "random" else 1):
        made = scene(rng, layers=3) if kind == "random" else entering()
        times = made.sample_times()
        assert times[0] == 0.0
        assert times[-1] == made.duration
        steps = np.diff(times)
        assert steps[:-1].min() >= made.shortest * (1 - 1e-9)
        assert steps[:-1].max() <= made.longest * (1 + 1e-9)
        assert 0.5 * made.shortest * (1 - 1e-9) <= steps[-1] <= made.longest + 0.5 * made.shortest
        ways = np.array([moved(made, a, b) for a, b in pairwise(times)])
        bound = steps <= made.shortest * (1 + 1e-6)
        # speed is looked up on a grid of `shortest`, so it may grow a little within a cell
        assert np.all((ways[:-1] <= 1.05 * made.travel) | bound[:-1])


def test_steps_are_interpolated_as_numpy_does(rng):
    x = np.cumsum(rng.uniform(0.1, 1, 50)).tolist()
    y = rng.normal(size=50).tolist()
    for at in [*rng.uniform(x[0] - 1, x[-1] + 1, 200), *x]:
        assert layers._interpolated(at, x, y, np.inf) == np.interp(at, x, y, right=np.inf)


def test_points_are_mapped_as_a_product_of_matrices(rng):
    maps, (x, y) = rng.normal(size=(7, 3, 3, 3)), rng.normal(size=(2, 3))
    want = np.einsum("tlij,lj->tli", maps[..., :2, :], np.stack([x, y, np.ones(3)], -1))
    np.testing.assert_allclose(layers._mapped(maps, x, y), want, rtol=1e-12)


def test_sampling_is_no_denser_than_needed(rng):
    grey = rng.random((8, 8), np.float32)
    for speed, step in ((1e-9, 1 / 72), (100.0, 0.5 / 100), (5000.0, 1e-3)):
        way = speed * 0.5 / 32
        layer = dase.Layer(dase.Picture(grey), dase.Motion(x=(-way / 2, way / 2)))
        times = dase.LayerScene([layer], width=32, height=32, duration=0.5).sample_times()
        np.testing.assert_allclose(np.diff(times)[:-1], step, rtol=1e-6)


def test_sampling_of_a_scene_shorter_than_the_bound(rng):
    layer = dase.Layer(picture(rng, (8, 8)), dase.Motion())
    times = dase.LayerScene([layer], width=4, height=4, duration=2e-4).sample_times()
    np.testing.assert_array_equal(times, [0, 2e-4])


def test_culling_changes_nothing(device, rng):
    made = scene(rng, layers=9, size=(30, 25))
    where = launch.find_device(device)
    for times in (np.linspace(0, 0.7, 20), np.array([0.1]), np.array([0.3, 0.31])):
        layers = made.arrays(times, where)
        culled = scene_render.render_frames(layers, 30, 25, where).numpy()
        box = layers.box.numpy()
        assert np.any(box[1:, 0] > 0) or np.any(box[1:, 2] < 29)
        layers.box.assign(np.tile(np.array([-1e9, -1e9, 1e9, 1e9], np.float32), (9, 1)))
        np.testing.assert_array_equal(scene_render.render_frames(layers, 30, 25, where).numpy(), culled)


def test_32_layers_are_seen_and_33_refused(device, rng):
    full = scene(rng, layers=32)
    want = reference.frame(full, 0.2)
    np.testing.assert_allclose(full.frames(np.array([0.2]), device)[0], want, atol=1e-5)
    with pytest.raises(dase.InputError, match="1 to 32 layers, got 33"):
        dase.LayerScene([*full.layers, full.layers[0]], width=4, height=4, duration=1.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"width": 0}, "at least 1x1, got 0x4"),
        ({"duration": 0.0}, "duration must be > 0 s, got 0"),
        ({"duration": float("nan")}, "duration must be > 0 s, got nan"),
        ({"shortest": 0.1}, "0 < shortest <= longest and travel > 0, got 0.1, 0.01"),
        ({"travel": 0.0}, "travel > 0"),
    ],
)
def test_impossible_scenes_are_refused(rng, options, message):
    layer = dase.Layer(picture(rng, (4, 4)), dase.Motion())
    with pytest.raises(dase.InputError) as error:
        dase.LayerScene([layer], **{"width": 4, "height": 4, "duration": 1.0, **options})
    assert message in str(error.value)


def test_impossible_motions_are_refused():
    with pytest.raises(dase.InputError, match="scales must be > 0"):
        dase.Motion(scale_x=(1.0, -1.0))
    with pytest.raises(dase.InputError, match="angle must be finite"):
        dase.Motion(angle=(0.0, float("inf")))


class Plain(ImageSource):
    """Textures of no interest."""

    name = "plain"

    def __len__(self) -> int:
        return 1

    def background(self, rng: np.random.Generator) -> dase.Picture:
        return picture(rng, (4, 4))

    def foreground(self, rng: np.random.Generator) -> dase.Picture:
        return picture(rng, (4, 4), "soft")


def drawn(rng: np.random.Generator, regime: str, duration: float = 0.5) -> dase.LayerScene:
    """Return a random scene of a regime."""
    return random_scenes.draw_scene(rng, Plain(), regime, width=64, height=48, duration=duration)


def pace(layer: dase.Layer) -> tuple[float, float]:
    """Return the speed of the centre [px/s] and the rotation [°/s] of a layer of `drawn`."""
    m = layer.motion
    way = np.hypot(m.x[1] - m.x[0], m.y[1] - m.y[0]) * 64
    return float(way / 0.5), float(np.degrees(abs(m.angle[1] - m.angle[0])) / 0.5)


@pytest.mark.parametrize(
    ("regime", "objects", "mean", "percentiles", "most", "spin"),
    [
        ("slow", (2, 5), 3.5, (2, 21, 62), 98, (0, 5.8)),
        ("medium", (5, 9), 7.2, (5.5, 62, 155), 268, (0, 15)),
        ("fast", (5, 19), 12.3, (19, 221, 714), 1386, (10, 45)),
        ("variety", (10, 29), 20.3, (38, 403, 1174), 1961, (0, 60)),
    ],
)
def test_regimes_move_as_published(rng, regime, objects, mean, percentiles, most, spin):
    made = [drawn(rng, regime) for _ in range(150)]
    counts = [len(s.layers) - 1 for s in made]
    assert objects[0] <= min(counts)
    assert max(counts) <= objects[1]
    assert np.mean(counts) == pytest.approx(mean, rel=0.1)
    paces = np.array([pace(layer) for s in made for layer in s.layers[1:]])
    assert np.all((paces[:, 1] >= spin[0] - 1e-9) & (paces[:, 1] <= spin[1] + 1e-9))
    assert paces[:, 0].max() <= most
    # few objects blur the lowest percentile, so percentiles come from the speeds alone
    assert np.median(paces[:, 0]) == pytest.approx(percentiles[1], rel=0.2)
    speeds = [random_scenes.draw_speed(rng, *random_scenes.REGIMES[regime].speed) for _ in range(20_000)]
    np.testing.assert_allclose(np.percentile(speeds, [5, 50, 95]), percentiles, rtol=0.2)


@pytest.mark.parametrize(
    ("regime", "speed", "spin"),
    [
        ("background", (0.5, 9.4), (0.3, 4.8)),
        ("slow", (0.6, 14), (0.2, 11)),
        ("medium", (5, 25), (0, 15)),
        ("fast", (5, 25), (0, 15)),
        ("variety", (0.3, 40), (1, 44.5)),
    ],
)
def test_backgrounds_move_as_published(rng, regime, speed, spin):
    paces = np.array([pace(drawn(rng, regime).layers[0]) for _ in range(60)])
    for column, (low, high) in zip(paces.T, (speed, spin), strict=True):
        assert low - 1e-9 <= column.min() < low + 0.15 * (high - low)
        assert high - 0.15 * (high - low) < column.max() <= high + 1e-9


def test_scales_and_paths_are_those_of_the_clip(rng):
    layers = [layer for _ in range(30) for layer in drawn(rng, "variety", duration=10.0).layers]
    for part, (low, high) in ((layers[:1], (1.0, 1.5)), (layers[1:10], (0.2, 1.2))):
        for layer in part:
            assert all(low <= s <= high for s in (*layer.motion.scale_x, *layer.motion.scale_y))
    for layer in layers:
        # the straight path passes through the middle of the picture: [-0.45, 0.45] of its width and height
        ends = np.array([layer.motion.x, layer.motion.y]).T * [1, 64 / 48]
        share = np.linspace(0, 1, 4001)[:, None]
        near = np.abs(ends[0] + share * (ends[1] - ends[0])).max(1).min()
        assert near <= 0.45 + 0.01 * np.linalg.norm(ends[1] - ends[0])


def test_the_same_numbers_draw_the_same_scene():
    a, b, c = (drawn(np.random.default_rng(seed), "mixed") for seed in (4, 4, 5))
    assert [layer.motion for layer in a.layers] == [layer.motion for layer in b.layers]
    for x, y in zip(a.layers, b.layers, strict=True):
        np.testing.assert_array_equal(x.picture.grey, y.picture.grey)
    assert [layer.motion for layer in a.layers] != [layer.motion for layer in c.layers]


def test_mixed_draws_regimes_by_their_share(rng):
    objects = np.array([len(drawn(rng, "mixed").layers) - 1 for _ in range(400)])
    assert 0.02 < np.mean(objects == 0) < 0.1  # 15 of 281
    assert 0.1 < np.mean(objects > 19) < 0.22  # half of 70 of 281, those with 20 to 29
    with pytest.raises(dase.InputError, match="no regime 'fats': did you mean 'fast'"):
        drawn(rng, "fats")
