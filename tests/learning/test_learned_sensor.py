"""What a run leaves behind: the sensor with its effect, recordings as targets, the command."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from click.testing import CliRunner

import dase
from dase import io
from dase.effects.leak import Leak
from dase.effects.learned_threshold import LearnedThreshold
from dase.effects.mismatch import Mismatch
from dase.effects.threshold import Threshold
from dase.events import Events
from dase.io.sequence import Sequence
from dase.learning.recorded_target import cut_windows, open_target
from dase.learning.targets import draw_noise, simulate_counts
from dase.networks.threshold_network import NetworkShape, ThresholdNet
from dase.recordings.recording import Recording
from dase.scenes.video import VideoScene
from dase.simulation.pixel_array import PixelArray
from dase.simulation.sensor_file import dump_sensor, load_sensor

pytest.importorskip("safetensors", reason="needs safetensors, of the extra `learn`")

from dase.figures import training_figure
from dase.learning import job as learning_job
from dase.networks import weights_file


@pytest.fixture
def scene(rng) -> VideoScene:
    frames = np.clip(rng.random((6, 20, 24)).cumsum(0) / 6, 0, 1).astype(np.float32)
    return VideoScene(frames, np.linspace(0, 0.05, 6))


@pytest.fixture
def folder(tmp_path) -> Path:
    """Return a folder with a sensor whose table knows brightness."""
    torch.manual_seed(0)
    net = ThresholdNet(NetworkShape(channels=4, depth=1, table=(2, 2), split=True), mu=0.25, sigma=0.05)
    with torch.no_grad():
        net.table[0] = torch.tensor([[-0.5], [0.5]])
        net.asymmetry += np.log(1.21)
        torch.nn.init.normal_(net.unet.last.weight, std=0.1)
    learning_job.write_sensor(tmp_path, net, mu=0.3, name="one", size=(24, 20))
    return tmp_path


def maps_of(folder: Path, scene: VideoScene):
    net = weights_file.load_net(folder / learning_job.JobFile.WEIGHTS)
    times = scene.sample_times()
    grey = scene.frames(times[len(times) // 2 :][:1])
    with torch.no_grad():
        mu, sigma = net(torch.from_numpy(grey)).by_polarity()
    return mu[0].numpy(), sigma[0].numpy()


def test_pixels_get_the_thresholds_that_were_learned(folder, scene, device):
    sensor = load_sensor(folder / learning_job.JobFile.SENSOR)
    assert sensor["threshold"].on == pytest.approx(0.3 * 1.1)
    assert sensor["threshold"].off == pytest.approx(0.3 / 1.1)
    mu, sigma = maps_of(folder, scene)
    draws = []
    for seed in range(300):
        pixels = PixelArray(sensor, 24, 20, seed=seed, device=device)
        pixels.bind_scene(scene)
        draws.append(pixels.thresholds()[0].reshape(2, 20, 24))
    found = np.stack(draws)
    np.testing.assert_allclose(found.mean(0), mu, rtol=0.06)
    np.testing.assert_allclose(found.std(0), sigma, rtol=0.25)
    # ON and OFF of a pixel move together, and the same seed draws the same
    above = found[:, 0] > 0.0101  # the floor, under which none lies
    np.testing.assert_allclose((found[:, 1] / found[:, 0])[above], 1.21, rtol=1e-3)
    again = PixelArray(sensor, 24, 20, seed=7, device=device)
    again.bind_scene(scene)
    np.testing.assert_array_equal(again.thresholds()[0].reshape(2, 20, 24), draws[7])


def test_events_and_counts_come_from_those_thresholds(folder, scene, device):
    sensor = load_sensor(folder / learning_job.JobFile.SENSOR)
    events = dase.simulate(scene, sensor, seed=3, device=device)
    counts = dase.count(scene, sensor, (-1.0, 1.0), seed=3, device=device)[0, 0].reshape(2, 20, 24)
    np.testing.assert_array_equal(events.counts([-1.0, 1.0])[0], counts)
    some = dase.simulate(scene, sensor, seed=3, device=device, pixels=np.arange(100, 140))
    place = events.y.astype(int) * 24 + events.x
    assert len(some) == int(((place >= 100) & (place < 140)).sum())
    # with a further effect, whose kernel counts otherwise
    other = sensor.with_effect(Mismatch(spread=0.0))
    np.testing.assert_array_equal(
        dase.count(scene, other, (-1.0, 1.0), seed=3, device=device)[0, 0].reshape(2, 20, 24), counts
    )


def test_off_and_without_weights_nothing_changes(folder, scene, device):
    plain = dase.Sensor((Threshold(on=0.3, off=0.2),))
    want = dase.simulate(scene, plain, device=device)
    path = str(folder / learning_job.JobFile.WEIGHTS)
    for effect in (LearnedThreshold(), LearnedThreshold(weights=path, strength=0.0)):
        got = dase.simulate(scene, plain.with_effect(effect), device=device)
        np.testing.assert_array_equal(got.t, want.t)
        np.testing.assert_array_equal(got.p, want.p)


def test_a_sensor_file_finds_its_weights_wherever_it_lies(folder, scene, monkeypatch):
    text = (folder / learning_job.JobFile.SENSOR).read_text()
    assert str(folder) not in text
    monkeypatch.chdir(folder.parent)
    sensor = load_sensor(Path(folder.name) / learning_job.JobFile.SENSOR)
    assert Path(sensor["learned_threshold"].weights) == (folder / learning_job.JobFile.WEIGHTS).resolve()
    assert len(dase.simulate(scene, sensor)) > 0
    assert "bound" not in dump_sensor(sensor.bound_to(scene))


@pytest.mark.slow
def test_an_effect_is_fitted_beside_learned_thresholds(folder, rng, monkeypatch):
    """From anywhere, and into another folder, from which the weights are still found."""
    t = np.arange(500) * 1e-3
    texture = cv2.GaussianBlur(rng.random((20, 300)).astype(np.float32), (0, 0), 2)
    texture = np.clip((texture - texture.min()) / np.ptp(texture), 0.03, 1)
    grey = np.stack([texture[:, round(200 * time) :][:, :24] for time in t])
    frames = np.round(255 * grey).astype(np.uint8)
    np.savez(folder / "clip.npz", frames=frames, frame_us=np.round(t * 1e6).astype(np.int64))
    sensor = load_sensor(folder / learning_job.JobFile.SENSOR)
    truth, scene = sensor.with_effect(Leak(rate=8.0)), VideoScene(frames / np.float32(255), t)
    io.write(folder / "recording.h5", Sequence(dase.simulate(scene, truth, seed=3)))
    (folder / "other").mkdir()
    monkeypatch.chdir(folder / "other")
    options = ("--fit", "../recording.h5", "--scene", "../clip.npz", "-o", "more.toml")
    done = call("add", f"../{learning_job.JobFile.SENSOR}", "leak", *options)
    assert done.exit_code == 0, done.output
    assert f'weights = "../{learning_job.JobFile.WEIGHTS}"' in Path("more.toml").read_text()
    monkeypatch.chdir("/")
    more = load_sensor(folder / "other/more.toml")
    # a share that grows with the light and one that does not are alike where the light is much the same
    assert more["leak"].rate * (1 + more["leak"].light * grey.mean()) == pytest.approx(8.0, rel=0.2)
    assert more["learned_threshold"].weights == sensor["learned_threshold"].weights
    entry = more.history[-1]
    assert entry.error_before > 2 * entry.error_after


def test_a_sensor_file_edited_in_place_keeps_the_name_of_its_weights(folder, monkeypatch):
    path = folder / learning_job.JobFile.SENSOR
    said = next(line for line in path.read_text().splitlines() if line.startswith("weights"))
    monkeypatch.chdir("/")
    for command in ("add", "remove"):
        done = call(command, str(path), "leak", "-o", str(path))
        assert done.exit_code == 0, done.output
        assert said in path.read_text().splitlines()
        assert ("leak" in load_sensor(path)) == (command == "add")


def test_bad_weights_are_named(folder, scene):
    path = folder / learning_job.JobFile.SENSOR
    sensor = load_sensor(path)
    file = folder / learning_job.JobFile.WEIGHTS
    whole = file.read_bytes()
    file.write_bytes(whole[:100])
    with pytest.raises(dase.InputError, match="does not hold learned thresholds"):
        dase.simulate(scene, sensor)
    file.unlink()
    with pytest.raises(dase.InputError, match="do not exist; they belong beside the sensor file"):
        dase.simulate(scene, sensor)
    text = path.read_text()
    path.write_text(text.replace("learned.safetensors", 300 * "l"))  # more than a name may have
    with pytest.raises(dase.InputError, match="do not exist; they belong beside the sensor file"):
        dase.simulate(scene, load_sensor(path))
    path.write_text(text.replace('"learned.safetensors"', "3"))
    with pytest.raises(
        dase.InputError, match=r"learned_threshold\.weights must be the path of a file, got 3"
    ):
        load_sensor(path)
    net = ThresholdNet(NetworkShape(channels=4, depth=1, pattern=(12, 20)))
    learning_job.write_sensor(folder, net, mu=0.5, name="other")
    with pytest.raises(dase.InputError, match="learned for a 12x20 sensor, the scene is 24x20"):
        dase.simulate(scene, load_sensor(path))


def shown_at(texture: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return 32 columns of a texture from each place on [texel], shape (F, H, 32)."""
    frames = []
    for place in places:
        columns = np.arange(32) + place
        whole = columns.astype(int)
        share = columns - whole
        frames.append((1 - share) * texture[:, whole] + share * texture[:, whole + 1])
    return np.stack(frames)


def moving(seconds: float = 1.0, rate: float = 0.2) -> Sequence:
    """Return frames of blobs that drift, and the events of their sensor."""
    rng = np.random.default_rng(0)
    texture = rng.random((40, 120))
    for _ in range(8):
        texture = 0.25 * (np.roll(texture, 1, 0) + np.roll(texture, -1, 0)) + 0.5 * texture
        texture = 0.25 * (np.roll(texture, 1, 1) + np.roll(texture, -1, 1)) + 0.5 * texture
    texture = (texture - texture.min()) / np.ptp(texture)
    times = np.arange(0, seconds, 0.02)
    stack = np.clip(shown_at(texture[:32], 40 * times), 0.02, 1)
    # one grey value at the top, or the frames would look stretched
    scene = VideoScene(stack.astype(np.float32), times)
    events = dase.simulate(scene, dase.Sensor((Threshold(on=rate, off=rate), Mismatch(spread=0.2))))
    return Sequence(events, (200 * stack).astype(np.uint8), times)


def test_windows_hold_the_scene_and_the_events():
    sequence = moving()
    recording = Recording.of(sequence)
    windows = cut_windows(recording, window=0.1, samples=5)
    # as many samples lead up to a window as it has
    assert windows.log.shape == (len(windows.begin), 10, 32, 32)
    np.testing.assert_allclose(windows.lead, [-0.4, -0.32, -0.24, -0.16, -0.08])
    assert windows.trusted > 0.5
    trusted = windows.known
    assert np.all(np.ptp(windows.log, axis=1)[~trusted] == 0)
    t = sequence.events.t
    for n, begin in enumerate(windows.begin):
        some = sequence.events.select((t >= begin) & (t < begin + 0.1))
        want = some.counts([begin - 1, begin + 1])[0]
        np.testing.assert_array_equal(windows.counts[n][:, trusted[n]], want[:, trusted[n]])
        # untrusted places are still, on both sides
        assert windows.counts[n][:, ~trusted[n]].sum() <= want[:, ~trusted[n]].sum()
    middle = windows.grey[0]
    at = int(round((windows.begin[0] + 0.05) / 0.02))
    np.testing.assert_allclose(middle, sequence.frames[at] / 255, atol=0.1)


def swinging(threshold: float) -> Recording:
    """Return a texture that swings by a few pixels, twice a second."""
    rng = np.random.default_rng(2)
    texture = rng.random((32, 64))
    for _ in range(2):
        texture = 0.25 * (np.roll(texture, 1, 1) + np.roll(texture, -1, 1)) + 0.5 * texture
    texture = 0.1 + 0.8 * (texture - texture.min()) / np.ptp(texture)
    times = np.arange(0, 4.0, 0.01)
    stack = shown_at(texture, 12 + 3 * np.sin(4 * np.pi * times)).astype(np.float32)
    sensor = dase.Sensor((Threshold(on=threshold, off=threshold, phase=1.0),))
    events = dase.simulate(VideoScene(stack, times), sensor)
    return Recording.of(Sequence(events, np.round(255 * stack).astype(np.uint8), times))


def test_pixels_come_to_a_window_with_what_they_saw_before():
    """A window that begins with pixels anywhere between their thresholds has more events than a camera's."""
    threshold = 0.3
    windows = cut_windows(swinging(threshold), window=0.05, samples=8)
    log = torch.from_numpy(windows.log.astype(np.float32))
    noise = draw_noise(log, torch.Generator().manual_seed(3), len(windows.lead))
    mu = torch.full_like(noise.z, threshold)
    found = simulate_counts(log, mu, 0.0, noise).sum().item() / windows.counts.sum()
    assert abs(found - 1) < 0.04
    window = log[:, len(windows.lead) :]
    alone = simulate_counts(window, mu, 0.0, draw_noise(window, torch.Generator().manual_seed(3)))
    assert alone.sum().item() / windows.counts.sum() > 1.15


def written(path: Path, sequence: Sequence) -> Path:
    io.write(path, sequence)
    return path


def test_bad_targets_are_named(tmp_path):
    good = moving(0.6)
    events, frames, times = good.events, good.frames, good.frame_times
    cases = {
        "no frames": (Sequence(events), "has no frames"),
        "few": (Sequence(events.select(slice(3)), frames, times), "events per pixel in windows of 0.05 s"),
        "short": (Sequence(events, frames[:5], times[:5]), "4 windows of 0.05 s need 0.2 s"),
    }
    for name, (sequence, said) in cases.items():
        path = written(tmp_path / f"{name.replace(' ', '_')}.npz", sequence)
        with pytest.raises(dase.InputError, match=said) as caught:
            open_target([path])
        assert str(path) in str(caught.value)
    one = written(tmp_path / "one.npz", good)
    small = Events(events.t, events.x % 16, events.y, events.p, 16, 32)
    other = written(tmp_path / "other.npz", Sequence(small, frames[:, :, :16], times))
    with pytest.raises(dase.InputError, match="is of a 16x32 sensor, those before it of 32x32"):
        open_target([one, other])


def test_a_part_of_a_recording_is_learned_from(tmp_path):
    path = written(tmp_path / "one.npz", moving(0.8))
    _, whole = open_target([path])
    target, part = open_target([path], begin=0.2, end=0.65, region=(4, 8, 16, 12))
    assert len(part.log) < len(whole.log)
    counts = target.recorded.counts
    outside = np.ones((32, 32), np.bool_)
    outside[8:20, 4:20] = False
    assert counts[..., torch.from_numpy(~outside)].sum() > 0
    assert counts[..., torch.from_numpy(outside)].sum() == 0
    log = part.log.float().numpy()
    assert np.ptp(log[..., outside], axis=1).max() == 0  # still outside, on the simulator's side, too
    with pytest.raises(
        dase.InputError, match=r"one.npz: the region 40x4 from 0,0 is not on the 32x32 sensor"
    ):
        open_target([path], region=(0, 0, 40, 4))
    with pytest.raises(dase.InputError, match=r"one.npz: slice: must overlap"):
        open_target([path], begin=5.0)


def test_textures_beside_a_recording_are_led_up_to_as_its_windows_are(tmp_path):
    path = written(tmp_path / "one.npz", moving(0.8))
    job = learning_job.Job(targets=(str(path),), images="builtin", preset="tiny", steps=2)
    training = learning_job.open_training(job)
    _, replayed = open_target([path], samples=12)
    np.testing.assert_array_equal(training.scenery.lead, replayed.lead)
    looks, lead = training.scenery.scene_settings, len(replayed.lead)
    log = training.scenery.draw(np.random.default_rng(1), 2)
    assert log.shape == (2, lead + looks.samples, 32, 32)
    assert (log[:, 1:lead] != log[:, : lead - 1]).float().mean() > 0.2  # it moves before the window, too
    training.advance()


def test_a_part_of_a_recording_is_asked_for_in_the_command(tmp_path):
    path = written(tmp_path / "one.npz", moving(0.8))
    out = tmp_path / "out"
    found = call(
        "train", str(path), "-o", str(out), "--preset", "tiny", "--steps", "1",
        "--from", "0.2", "--to", "0.65", "--region", "4,8,16,12",
    )  # fmt: skip
    assert found.exit_code == 0, found.output
    job = learning_job.read_job(out)
    assert (job.begin, job.end, job.region) == (0.2, 0.65, (4, 8, 16, 12))
    with pytest.raises(dase.InputError, match="a sensor file has none"):
        learning_job.Job(targets=("davis346",), begin=1.0)


def call(*arguments: str):
    from dase.cli import dase_group

    return CliRunner().invoke(dase_group, arguments, catch_exceptions=True)


@pytest.mark.slow
def test_the_command_learns_from_a_sensor_and_goes_on(tmp_path, monkeypatch):
    sensor = tmp_path / "target.toml"
    sensor.write_text(dump_sensor(dase.Sensor((Threshold(on=0.2, off=0.2), Mismatch(spread=0.25)))))
    out = tmp_path / "run"
    options = ("--preset", "tiny", "--sequences", "12", "--size", "48x48", "--steps", "24")

    def killed(*arguments, **named):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("dase.learning.run.train_in_folder", killed)
        call("train", str(sensor), "-o", str(out), *options)
    # there is no checkpoint yet, so it begins anew
    first = call("train", str(sensor), "-o", str(out), *options, "--resume")
    assert first.exit_code == 0, first.output
    assert "KL" in first.output
    job = json.loads((out / learning_job.JobFile.JOB).read_text())
    assert job["images"] == "builtin"
    made = load_sensor(out / learning_job.JobFile.SENSOR)
    # began at 0.5; so few steps and scenes bring it most of the way, to 0.14 to 0.24 by the seed
    assert 0.1 < made["threshold"].on < 0.35
    twice = call("train", str(sensor), "-o", str(out), *options)
    assert isinstance(twice.exception, dase.InputError)
    assert twice.exception.argument == "resume"
    other = call("train", str(sensor), "-o", str(out), "--preset", "tiny", "--resume")
    assert "begun with other options" in str(other.exception)
    again = call("train", str(sensor), "-o", str(out), *options, "--resume")
    assert again.exit_code == 0, again.output
    figure, lines = training_figure.draw_training(out)
    assert {"thresholds", "ON / OFF", "KL from truth"} <= {name for name, _ in lines}
    assert len(figure.axes) == 3 * 5 + 2 + 2
    shown = call("show", str(out))
    assert shown.exit_code == 0, shown.output
    assert (out / "learned.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("missing.npz",), "missing.npz"),
        (("ideal", "--preset", "fast"), "there is no preset 'fast'"),
        (("ideal", "--samples", "1"), "samples must lie in 2 to 4096, or be 0, got 1"),
        (("ideal", "--images", "frames"), "a sensor file has none"),
        (("ideal", "--window", "-1"), "window must be a number > 0 s, got -1"),
        (("ideal", "ideal"), "one sensor file is one target, got 2"),
        (("ideal", "--objective", "magic"), "objective must be moments or wgan"),
        (("ideal", "--preset", "paper", "--size", "24x24", "--sequences", "5"), "patches are 40 px wide"),
    ],
)
def test_bad_options_are_named(tmp_path, arguments, said):
    for _ in range(2):  # what failed leaves nothing that is in the way of the next attempt
        done = call("train", *arguments, "-o", str(tmp_path / "run"))
        assert isinstance(done.exception, dase.InputError), done.exception
        assert said in str(done.exception)
