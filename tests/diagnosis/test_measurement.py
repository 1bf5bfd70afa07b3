"""Recordings with frames: what the frames cannot tell takes part in nothing."""

from __future__ import annotations

import numpy as np
import pytest
from click.testing import CliRunner
from reference.scene_frames import film, moving_picture

import dase
from dase import io
from dase.cli import dase_group
from dase.diagnosis.compare import compare
from dase.fitting.data_split import split_measurement
from dase.fitting.measurement import (
    Measurement,
    as_measurement,
    measurement_of,
    open_clip,
    open_measurement,
)
from dase.io.sequence import Sequence
from dase.probes.stimulus import MASKED
from dase.scenes.video import VideoScene

SENSOR = dase.load_sensor("ideal")
PIXELS = 600


PICTURE = dict(width=128, height=96, duration=0.5)


def recorded(path, *, mirrored=False, stretched=False, speed=1.0):
    """Write events of a moving picture and frames of 25 Hz and 10 ms; return the events."""
    rng = np.random.default_rng(5)
    truth = moving_picture(rng, speed=speed, **PICTURE)
    noise = dase.EFFECTS["shot"](rate=1.0)
    events = dase.simulate(truth, SENSOR if speed else SENSOR.with_effect(noise), seed=1)
    begin, end, frames = film(truth, rng, noise=0.004)
    if stretched:
        light = frames + 4 * rng.standard_normal(frames.shape)
        low, high = (f(light, axis=(1, 2), keepdims=True) for f in (np.min, np.max))
        frames = np.rint(255 * (light - low) / (high - low)).astype(np.uint8)
    frames = frames[:, :, ::-1] if mirrored else frames
    io.write(path, Sequence(events, frames, 0.5 * (begin + end), frame_exposure=end - begin))
    return events


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("measurement") / "recording.h5"
    return path, recorded(path)


@pytest.fixture(scope="module")
def measured(recording):
    return open_measurement(recording[0])


def test_frames_far_apart_make_a_scene_with_trust(measured):
    assert isinstance(measured.scene, dase.CameraScene)
    assert measured.trust is not None
    assert any("after the frames" in note and "nothing was corrected" in note for note in measured.notes)
    evidence = split_measurement(measured, pixels=PIXELS)
    for half in (evidence.train, evidence.held):
        stimulus = half.trials.stimulus
        compared = stimulus.cell != MASKED
        assert 0.3 < compared.mean() < 1 or half is evidence.held
        trusted = measured.scene.is_trusted(stimulus.grid.times, stimulus.pixels).T
        assert not (compared & ~trusted).any()
        assert stimulus.holes
    first, second = (half.trials.stimulus.pixels for half in (evidence.train, evidence.held))
    assert len(np.union1d(first, second)) == 2 * PIXELS  # none twice
    assert any("of pixels and times, with" in note for note in evidence.notes)


def test_the_true_model_is_wrong_only_where_frames_are(recording, measured):
    """A mask that left in what the frames do not show, or a scene without it, would blame the model."""
    path, events = recording
    masked = compare(
        events, SENSOR, scene=measured.scene, pixels=PIXELS
    )  # a scene's own trust is what is taken
    bare = compare(events, SENSOR, scene=measured.scene, pixels=PIXELS, trust=everywhere)
    sequence = io.read(path)
    straight = VideoScene(sequence.frames / np.float32(255), sequence.frame_times)
    before = compare(events, SENSOR, scene=straight, pixels=PIXELS)
    told = compare(events, SENSOR, scene=moving_picture(np.random.default_rng(5), **PICTURE), pixels=PIXELS)
    print(*(f"{found.error:.2f}" for found in (masked, bare, before, told)))
    assert masked.error < 0.65 * bare.error
    assert masked.error < 0.55 * before.error
    assert masked.error < 1.4 * told.error  # whose light is taken at each millisecond only
    wrong = compare(events, SENSOR.with_effect(slow()), scene=measured.scene, pixels=PIXELS)
    assert wrong.error > 2 * masked.error  # and yet it sees what is wrong


def everywhere(times, pixels):
    return np.ones((len(times), len(pixels)), bool)


def slow():
    return dase.EFFECTS["bandwidth"](cutoff=5.0)


def test_events_where_nothing_is_known_change_nothing(measured):
    """Neither the error, nor the choice of pixels."""
    scene, events, rng = measured.scene, measured.events, np.random.default_rng(2)
    known = scene.trusted()
    k, y, x = (axis for axis in np.nonzero(~known))
    t = scene.times[k] + rng.uniform(0.01, 0.99, len(k)) * np.diff(scene.times)[k]
    late = rng.uniform(scene.times[-1] + 1e-3, scene.times[-1] + 2e-3, 500)
    t, x, y = np.append(t, late), np.append(x, np.arange(500) % 128), np.append(y, np.arange(500) % 96)
    order = np.argsort(np.append(events.t, t), kind="stable")
    flooded = dase.Events(
        np.append(events.t, t)[order],
        np.append(events.x, x.astype(np.uint16))[order],
        np.append(events.y, y.astype(np.uint16))[order],
        np.append(events.p, rng.random(len(t)) < 0.5)[order],
        events.width,
        events.height,
    )
    assert len(t) > 10_000
    plain, other = (compare(e, SENSOR, scene=scene, pixels=PIXELS) for e in (events, flooded))
    assert other.error == plain.error
    assert other.families == plain.families
    assert other.plain == plain.plain
    assert other.notes != plain.notes  # the share of the events that is compared fell


def test_what_clearly_lies_elsewhere_is_corrected(tmp_path, measured):
    recorded(tmp_path / "mirrored.h5", mirrored=True)
    found = open_measurement(tmp_path / "mirrored.h5")
    assert any(note.endswith("corrected flip") for note in found.notes)
    times = measured.scene.times
    np.testing.assert_allclose(found.scene.frames(times), measured.scene.frames(times), atol=1e-6)
    recorded(tmp_path / "stretched.h5", stretched=True)
    assert any("stretched" in note for note in open_measurement(tmp_path / "stretched.h5").notes)


def test_a_camera_that_rests_sees_no_noise(tmp_path, measured):
    recorded(tmp_path / "still.h5", speed=0.0)
    scene = open_measurement(tmp_path / "still.h5").scene
    light = scene.frames(scene.times)
    assert np.mean(np.diff(light, axis=0) == 0) > 0.95
    moving = measured.scene.frames(measured.scene.times)
    assert np.mean(np.diff(moving, axis=0) == 0) < 0.3


def test_dense_frames_are_joined_by_lines(tmp_path):
    frames = np.random.default_rng(0).integers(0, 255, (9, 20, 30)).astype(np.uint8)
    events = dase.Events(np.array([1e-3]), *np.zeros((2, 1), np.uint16), np.ones(1, bool), 30, 20)
    io.write(tmp_path / "dense.h5", Sequence(events, frames, 2e-3 * np.arange(9)))
    found = open_measurement(tmp_path / "dense.h5")
    assert isinstance(found.scene, VideoScene)
    assert found.trust is None
    np.testing.assert_allclose(found.scene.frames(2e-3 * np.arange(9)), frames / 255, atol=1e-6)


def test_an_archive_of_frames_is_joined_as_all_others_are(tmp_path):
    """Far apart the motion is followed, which is said; it used to be straight lines whatever the gap."""
    truth = moving_picture(np.random.default_rng(3), speed=1.0, width=48, height=36, duration=0.2)
    times = np.arange(0, 0.2, 0.02)
    frames = np.rint(255 * truth.frames(times)).astype(np.uint8)
    for name, step in (("far", 20_000), ("dense", 2000)):
        np.savez(tmp_path / f"{name}.npz", frames=frames, frame_us=step * np.arange(len(frames)))
    notes = []
    far = open_clip(tmp_path / "far.npz", notes)
    assert isinstance(far, dase.CameraScene)
    assert "20.0 ms apart: the motion from one to the next is followed" in notes[0]
    between = times[:-1] + 0.01
    want = dase.CameraScene(frames, times).frames(between)
    np.testing.assert_array_equal(far.frames(between), want)
    assert isinstance(open_clip(tmp_path / "dense.npz"), VideoScene)
    events = dase.simulate(truth, SENSOR, seed=1)
    measured = as_measurement(events, tmp_path / "far.npz")
    assert measured.notes == tuple(notes)  # so that a comparison says them
    assert isinstance(measured.scene, dase.CameraScene)


def test_next_to_nothing_to_trust_is_said(measured):
    few = np.zeros(128 * 96, bool)
    few[:20] = True

    def nearly_nowhere(times, pixels):
        return np.broadcast_to(few[pixels], (len(times), len(pixels)))

    with pytest.raises(dase.InputError, match=r"trusted in 0\.16 % of pixels and times only"):
        split_measurement(Measurement(measured.events, measured.scene, trust=nearly_nowhere))
    still = measured.events.select(slice(None, None, 200))
    with pytest.raises(dase.InputError, match=r"too few events .* compared is only where the scene can be"):
        split_measurement(Measurement(still, measured.scene), pixels=PIXELS)


def test_events_that_are_believed(measured):
    scene, events = measured.scene, measured.events
    got = scene.trusted_events(events)
    assert 0.2 < len(got) / len(events) < 0.8
    some = np.random.default_rng(1).integers(0, len(events), 2000)
    pixels = (events.y[some].astype(int) * 128 + events.x[some]).astype(np.int32)
    want = [scene.is_trusted(events.t[k : k + 1], pixels[n : n + 1])[0, 0] for n, k in enumerate(some)]
    kept = set(zip(got.t, got.x, got.y, strict=True))
    assert [row in kept for row in zip(events.t[some], events.x[some], events.y[some], strict=True)] == want


@pytest.mark.slow
def test_the_commands_say_what_is_compared(tmp_path, recording):
    report = tmp_path / "report.html"
    arguments = ["compare", "ideal", str(recording[0]), "--pixels", "300", "-o", str(report), "--quiet"]
    done = CliRunner().invoke(dase_group, arguments)
    assert done.exit_code == 0, done.output
    for sentence in ("compared is only where the scene can be trusted: ", "after the frames"):
        assert sentence in done.output
        assert sentence in report.read_text()
    assert "Events are shown only where" in report.read_text()


@pytest.mark.slow
def test_a_davis_and_its_frames(shared):
    """20 ms exposures every 40 ms leave little to trust, yet enough to compare."""
    path = shared / "recordings" / "native" / "davis346_cuke_cradle.aedat4"
    found = open_measurement(path)
    assert isinstance(found.scene, dase.CameraScene)
    evidence = split_measurement(found)
    assert min(int(h.found.halves.sum()) for h in (evidence.train, evidence.held)) > 1000
    told = next(note for note in evidence.notes if note.startswith("compared is only"))
    pixels, events = (float(word) for word in told.replace("%", " ").split() if word[0].isdigit())
    assert 40 < pixels < 80
    assert 5 < events < 40


@pytest.mark.slow
def test_a_recording_its_path_and_its_measurement_give_the_same(recording, measured):
    path, events = recording
    opened = dase.open_recording(path)
    made = measurement_of(opened)
    assert made.notes == measured.notes
    np.testing.assert_array_equal(made.scene.frames([0.1, 0.2]), measured.scene.frames([0.1, 0.2]))
    found = [dase.compare(what, "ideal", pixels=100) for what in (path, str(path), opened, made, measured)]
    assert len({one.error for one in found}) == 1
    assert len({one.notes for one in found}) == 1
    assert found[0].notes[: len(measured.notes)] == measured.notes
    told = dase.compare(events, SENSOR, scene=measured.scene, pixels=100)
    assert told.error == found[0].error
    assert told.notes == found[0].notes[len(measured.notes) :]


def test_the_scene_is_chosen_beside_the_recording(tmp_path, recording, measured):
    path, events = recording
    for what in (path, dase.open_recording(path), events, measured):
        still = as_measurement(what, "static")
        assert isinstance(still.scene, VideoScene)
        assert still.trust is None
        assert as_measurement(what, measured.scene).scene is measured.scene
    assert as_measurement(measured) is measured
    assert as_measurement(measured, trust=everywhere).trust is everywhere
    with pytest.raises(dase.InputError, match="events do not say what the camera saw") as refused:
        dase.fit(events, "ideal")
    assert refused.value.argument == "scene"
    with pytest.raises(dase.InputError, match="has no frames to take the scene from"):
        measurement_of(Sequence(events))
    with pytest.raises(TypeError, match="expected a recording"):
        dase.diagnose(measured.scene, SENSOR)
    with pytest.raises(TypeError, match="sensor: expected"):
        dase.compare(events, measured.scene)


def test_masked_pixels_take_part_in_nothing(recording):
    opened = dase.open_recording(recording[0])
    mask = np.ones((96, 128), bool)
    mask[:, :40] = False
    for scene in ("frames", "static"):
        found = measurement_of(opened.masked(mask), scene)
        pixels = np.arange(96 * 128, dtype=np.int32)
        assert isinstance(found, Measurement)
        trusted = found.trust(np.array([0.1, 0.3]), pixels)
        assert not trusted[:, ~mask.reshape(-1)].any()
        assert trusted[:, mask.reshape(-1)].any()
