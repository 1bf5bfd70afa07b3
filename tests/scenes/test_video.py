"""Scenes from videos, folders of pictures and recordings, against frames that are known; damaged files."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.avi_files import avi, chunk, titles
from helpers.sample_files import PEAK, measured

import dase
import dase.io
from dase.io import ffmpeg
from dase.io.image_files import to_grey
from dase.io.video_file import FrameReader
from dase.kernels import launch
from dase.scenes.video import as_scene, open_video


def test_a_video_is_its_frames(rng):
    frames, times = rng.random((5, 3, 4), np.float32), np.array([1.0, 1.5, 1.6, 2.0, 3.0])
    video = dase.VideoScene(frames, times)
    np.testing.assert_array_equal(video.sample_times(), times)
    np.testing.assert_array_equal(video.frames(times[[1, 3]]), frames[[1, 3]])
    assert (video.width, video.height, video.duration) == (4, 3, 2.0)
    assert video.flow(times) is None
    with pytest.raises(dase.InputError, match="between its frames"):
        video.frames(np.array([1.2]))


@pytest.mark.parametrize(
    ("frames", "times", "message"),
    [
        (np.zeros((3, 4)), [0, 1, 2], r"shape \(F, height, width\), got \(3, 4\)"),
        (np.zeros((3, 4, 4)), [0, 1], r"3 frames need as many times, got \(2,\)"),
        (np.full((2, 4, 4), np.nan), [0, 1], "finite and >= 0"),
        (np.full((2, 4, 4), -0.1), [0, 1], "finite and >= 0"),
    ],
)
def test_impossible_videos_are_refused(frames, times, message):
    with pytest.raises(dase.InputError, match=message):
        dase.VideoScene(frames, times)


def test_a_folder_of_pictures_is_read_by_name(tmp_path, device):
    for n in (2, 0, 1):
        cv2.imwrite(str(tmp_path / f"{n:03d}.png"), np.full((6, 8), 40 * (n + 1), np.uint8))
    with pytest.raises(dase.InputError, match="does not say how many frames"):
        open_video(tmp_path)
    video = open_video(tmp_path, fps=100, gamma=1, between="lines")
    want = np.arange(1, 4)[:, None, None] * 40 / 255 * np.ones((1, 6, 8))
    np.testing.assert_allclose(video.frames(video.sample_times()), want, rtol=1e-6)
    np.testing.assert_allclose(video.sample_times(), [0, 0.01, 0.02])
    small = open_video(tmp_path, fps=100, size=(4, 3), between="lines")
    assert small.frames(small.sample_times()).shape == (3, 3, 4)
    sensor = dase.Sensor((dase.EFFECTS["threshold"](phase=0.0),))
    events = dase.simulate(video, sensor, device=device)
    assert len(events) == 48 * int(np.log(0.4716 / 0.1578) / 0.2)


def test_pictures_of_different_sizes_are_refused(tmp_path):
    for n in (0, 1):
        cv2.imwrite(str(tmp_path / f"{n}.png"), np.full((6, 8 + n), 40, np.uint8))
    with pytest.raises(dase.InputError, match="size"):
        dase.simulate(open_video(tmp_path, fps=100), dase.Sensor())


@pytest.mark.parametrize(("suffix", "code"), [("avi", "MJPG"), ("mp4", "mp4v")])
def test_a_video_file_is_read_frame_by_frame(tmp_path, suffix, code):
    path = tmp_path / f"film.{suffix}"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*code), 50.0, (32, 24))
    if not writer.isOpened():
        pytest.skip(f"OpenCV writes no {suffix} here")
    for n in range(9):
        writer.write(np.full((24, 32, 3), 25 * n, np.uint8))
    writer.release()
    video = open_video(path, gamma=1, between="lines")
    np.testing.assert_allclose(video.sample_times(), np.arange(9) / 50)
    want = np.arange(9) * 25 / 255
    whole = video.frames(video.sample_times())
    np.testing.assert_allclose(whole.mean((1, 2)), want, atol=0.02)
    # any increasing run of frames, forwards, overlapping and back again
    reader = FrameReader(path)
    for index in ([0, 1, 2], [2, 3], [5, 8], [0], [8], [3, 4, 7]):
        np.testing.assert_array_equal(reader[np.array(index)], whole[index])
    # pixels that are a chunk ahead ask for frames of the chunk before: nothing is decoded twice
    reader, decoded = FrameReader(path), []
    decode = reader._decode
    reader._decode = lambda index: decoded.append(index) or decode(index)
    for index in ([0, 1, 2], [2, 3, 4, 5], [1], [5, 6, 7], [3], [7, 8], [6]):
        np.testing.assert_array_equal(reader[np.array(index)], whole[index])
    assert decoded == list(range(9))


@pytest.mark.parametrize("kept", [0, 5 * 24 * 32 * 3, 9 * 24 * 32 * 3])
def test_a_short_video_is_decoded_once_and_a_long_one_is_the_same(tmp_path, monkeypatch, rng, kept):
    path = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 50.0, (32, 24))
    for picture in rng.integers(0, 256, (9, 24, 32, 3), dtype=np.uint8):
        writer.write(picture)
    writer.release()
    capture = cv2.VideoCapture(str(path))
    want = np.stack([to_grey(capture.read()[1])[0] for _ in range(9)])
    grabs = []
    grab = FrameReader._grab
    monkeypatch.setattr(FrameReader, "_grab", lambda self, capture: grabs.append(0) or grab(self, capture))
    monkeypatch.setattr("dase.io.video_file.KEPT", kept)
    reader = FrameReader(path)
    for index in ([0, 1, 2], [2, 5, 8], [0, 8]):
        np.testing.assert_array_equal(reader[np.array(index)], want[index])
    assert (len(grabs) > 10) == (kept < 9 * 24 * 32 * 3)  # the end of the video is found by one more


def test_what_is_no_video_is_refused(tmp_path):
    with pytest.raises(dase.InputError, match="does not exist"):
        open_video(tmp_path / "none.mp4")
    with pytest.raises(dase.InputError, match="at least 2 frames, got 0"):
        open_video(tmp_path, fps=10)
    with pytest.raises(dase.InputError, match="fps must be a number > 0"):
        open_video(tmp_path, fps=-1)


def test_frames_of_a_recording_are_a_scene(tmp_path, rng):
    frames = rng.integers(0, 256, (5, 6, 8), dtype=np.uint8)
    times = np.array([0.5, 0.6, 0.8, 0.9, 1.0])
    dase.io.write(
        tmp_path / "a.h5", dase.io.Sequence(dase.Events.empty(8, 6), frames=frames, frame_times=times)
    )
    scene = open_video(tmp_path / "a.h5", between="lines")
    np.testing.assert_allclose(scene.sample_times(), times - 0.5)
    np.testing.assert_array_equal(scene.frames(scene.sample_times()), frames / np.float32(255))
    small = open_video(tmp_path / "a.h5", size=(4, 3), fps=10, between="lines")
    assert (small.width, small.height, small.duration) == (4, 3, 0.4)
    dase.io.write(tmp_path / "b.h5", dase.io.Sequence(dase.Events.empty(8, 6)))
    with pytest.raises(dase.InputError, match="must have at least 2 frames"):
        open_video(tmp_path / "b.h5")


def written(path: Path, code: str, size: tuple[int, int], values=(40, 90, 140)) -> Path:
    """Write a video of plain frames with OpenCV; skips where it has no such encoder."""
    out = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*code), 25.0, size)
    if not out.isOpened():
        pytest.skip(f"this OpenCV writes no {code} into {path.suffix}")
    for value in values:
        out.write(np.full((*size[::-1], 3), value, np.uint8))
    out.release()
    return path


@pytest.mark.parametrize("width", [8, 9, 10, 11])
@pytest.mark.parametrize("options", [{"first": titles()}, {"last": titles()}, {"upward": False}])
def test_an_avi_from_parts_is_its_frames(tmp_path, rng, width, options):
    """Of rows upwards OpenCV 5.0 makes a damaged heap, with which the process may end at any time."""
    grey = rng.integers(0, 256, (4, 6, width), np.uint8)
    (tmp_path / "a.avi").write_bytes(avi(grey, **options))
    got = dase.io.read(tmp_path / "a.avi")
    np.testing.assert_array_equal(got.frames, grey)
    np.testing.assert_allclose(got.frame_times, np.arange(4) / 25)


@pytest.mark.parametrize("claimed", [(1 << 24) + 1, 1 << 29, 0x7FFFFFFF, 0xB300001A, 0xFFFFFFF0, 0xFFFFFFFF])
@pytest.mark.parametrize("where", ["first", "last"])
def test_titles_far_longer_than_their_file_are_refused(tmp_path, rng, claimed, where):
    path = tmp_path / "a.avi"
    path.write_bytes(avi(rng.integers(0, 256, (4, 6, 8), np.uint8), **{where: titles(claimed)}))
    sentence = f"it claims {claimed:,} bytes of titles in a file of {path.stat().st_size:,}$"
    for read in (dase.io.read, open_video, lambda path: list(dase.io.stream(path))):
        with pytest.raises(dase.InputError, match=sentence):
            read(path)


@pytest.mark.parametrize("shift", range(12))
def test_titles_are_found_wherever_a_piece_ends(tmp_path, rng, monkeypatch, shift):
    monkeypatch.setattr(ffmpeg, "PIECE", 64)
    grey, path = rng.integers(0, 256, (2, 6, 8), np.uint8), tmp_path / "a.avi"
    for more in range(64 // 12 + 1):
        padding = chunk(b"JUNK", bytes(2 * (shift + 12 * more)))
        path.write_bytes(avi(grey, first=padding, last=titles(1 << 30)))
        with pytest.raises(dase.InputError, match="bytes of titles"):
            open_video(path)
        path.write_bytes(avi(grey, first=padding, last=titles()))
        assert len(FrameReader(path)) == 2


def test_dropped_frames_are_skipped(tmp_path, rng):
    """Programs that record to AVI write an empty packet for a frame they had no time for."""
    grey, path = rng.integers(0, 256, (4, 6, 8), np.uint8), tmp_path / "a.avi"
    content = avi(grey)
    second = content.index(b"00db", content.index(b"00db") + 1)
    path.write_bytes(content[:second] + chunk(b"00db", b"") + chunk(b"00db", bytes(10)) + content[second:])
    np.testing.assert_array_equal(dase.io.read(path).frames, grey)


@pytest.mark.parametrize("claimed", [40, 10_000, 1 << 24])
def test_titles_little_longer_than_their_file_are_no_harm(tmp_path, rng, claimed):
    grey, path = rng.integers(0, 256, (4, 6, 8), np.uint8), tmp_path / "a.avi"
    path.write_bytes(avi(grey, last=titles(claimed)))
    np.testing.assert_array_equal(dase.io.read(path).frames, grey)


def test_titles_that_a_cut_left_half_are_no_harm(tmp_path, rng):
    grey, path = rng.integers(0, 256, (4, 6, 8), np.uint8), tmp_path / "a.avi"
    path.write_bytes(avi(grey, last=titles())[:-9])
    np.testing.assert_array_equal(dase.io.read(path).frames, grey)


def test_a_damaged_video_takes_little_memory_and_says_nothing_else(tmp_path, rng):
    """FFmpeg fills what titles claim with zeros: half a gigabyte here, were it let to."""
    if not Path("/proc/self/status").exists():
        pytest.skip("reads the memory of a process from /proc, which only Linux has")
    script = """
import dase.io, dase.scenes.video
def read(path):
    before, sentence = peak(), "read"
    try:
        dase.io.read(path)
    except dase.InputError as error:
        sentence = str(error)
    print(peak() - before, sentence)
apart(read)
"""
    grey, paths, sentences = rng.integers(0, 256, (4, 6, 8), np.uint8), [], []
    for damaged, sentence in (
        (avi(grey, first=titles(1 << 29)), "bytes of titles"),
        (avi(grey, first=b"LIST"), "^read$"),
        (avi(grey)[:300], "cannot be decoded|at least 2 frames"),
        (avi(grey).replace(b"hdrl", b"hdxl"), "cannot be decoded|at least 2 frames|^read$"),
    ):
        paths.append(tmp_path / f"{len(paths)}.avi")
        paths[-1].write_bytes(damaged)
        sentences.append(sentence)
    command = [sys.executable, "-c", PEAK + script, *map(str, paths)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    for line, sentence in zip(done.stdout.splitlines(), sentences, strict=True):
        grown, said = line.split(" ", 1)
        assert float(grown) < 200
        assert re.search(sentence, said)


def test_a_small_file_of_enormous_frames_is_refused(tmp_path, rng):
    path = tmp_path / "a.avi"
    path.write_bytes(avi(rng.integers(0, 256, (4, 6, 8), np.uint8), size=(16000, 16000)))
    with pytest.raises(dase.InputError, match=r"a frame of 16000x16000 unpacks .* more than 100 times"):
        open_video(path)


@pytest.mark.parametrize(
    ("suffix", "code"),
    [
        ("avi", "MJPG"),
        ("avi", "XVID"),
        ("avi", "H264"),
        ("avi", "FFV1"),
        ("avi", "HFYU"),
        ("avi", "MPNG"),
        ("avi", "I420"),
        ("mov", "mjpg"),
        ("mp4", "mp4v"),
        ("mp4", "avc1"),
        ("mp4", "vp09"),
        ("mkv", "FFV1"),
        ("webm", "VP80"),
    ],
)
def test_good_videos_of_every_codec_open(tmp_path, suffix, code):
    got = dase.io.read(written(tmp_path / f"a.{suffix}", code, (96, 64)))
    assert got.frames.shape == (3, 64, 96)
    np.testing.assert_allclose(got.frames.mean((1, 2)), (40, 90, 140), atol=4)
    np.testing.assert_allclose(got.frame_times, np.arange(3) / 25)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("suffix", "code", "size"),
    [
        ("webm", "VP80", (3840, 2160)),
        ("avi", "MJPG", (3840, 2160)),
        ("webm", "VP90", (2560, 2556)),
    ],
)
def test_the_largest_plain_frames_take_little_memory(tmp_path, suffix, code, size):
    """Ten frames of 4K are a few kB of VP8: nothing but their size tells them from a good video."""
    path = written(tmp_path / f"a.{suffix}", code, size, [0] * 10)
    script = """
import sys
import dase.io, dase.scenes.video
before = peak()
shape = dase.io.read(sys.argv[1]).frames.shape
print(*shape, peak() - before)
"""
    (line,) = measured(script, path)
    *shape, grown = line.split()
    assert shape == ["10", str(size[1]), str(size[0])]
    assert float(grown) < 200


@pytest.mark.slow
@pytest.mark.parametrize(("code", "size"), [("VP80", (8192, 4096)), ("VP90", (4096, 4096))])
def test_small_files_of_huge_frames_are_refused_before_decoding(tmp_path, code, size):
    path = written(tmp_path / "a.webm", code, size, (0,))
    script = """
import sys
import dase, dase.io, dase.scenes.video
before = peak()
for read in (dase.io.read, dase.scenes.video.open_video, lambda path: next(dase.io.pictures(path))):
    try:
        read(sys.argv[1])
    except dase.InputError as error:
        print(error)
print(peak() - before)
"""
    *said, grown = measured(script, path)
    assert len(said) == 3
    frame = f"{size[0]}x{size[1]}"
    sentence = rf"a\.webm: a frame of {frame} unpacks from .* more than 100 times .*; such .* megapixels"
    assert all(re.search(sentence, line) for line in said)
    assert float(grown) < 1.5 * size[0] * size[1] / 2**20  # what a frame alone takes


def test_large_files_of_huge_frames_open(tmp_path, rng):
    """Frames of 8K with something on them are a hundredth of what decoding them takes, and more."""
    path = tmp_path / "a.avi"
    out = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (7680, 4320))
    if not out.isOpened():
        pytest.skip("this OpenCV writes no MJPG")
    noise = cv2.resize(rng.integers(0, 256, (2160, 3840, 3), np.uint8), (7680, 4320))
    for frame in (noise, noise):
        out.write(frame)
    out.release()
    assert FrameReader(path, (48, 27)).shape == (2, 27, 48)


def test_more_frames_than_a_small_file_may_give_at_once_come_one_by_one(tmp_path, monkeypatch):
    path = written(tmp_path / "a.webm", "VP80", (64, 48), [0] * 16)
    assert dase.io.read(path).frames.shape == (16, 48, 64)
    monkeypatch.setattr(dase.io.source, "BOMB_BYTES", 64 * 48 * 30)  # less than 24.5 and 6 further frames
    monkeypatch.setattr(dase.io.frames, "FRAMES_RATIO", 10)
    with pytest.raises(dase.InputError, match=r"all 16 frames at once: .* more than 10 times is refused"):
        dase.io.read(path)
    assert sum(1 for _ in dase.io.pictures(path)) == 16
    assert len(FrameReader(path)) == 16
    assert len(dase.io.read(written(tmp_path / "b.webm", "VP80", (64, 48), [0] * 15)).frames) == 15


def grown_webm(small: bytes, large: bytes) -> bytes:
    """Return a file of VP8 whose last frames are those of a larger video: its head tells the small size."""
    cluster = b"\x1f\x43\xb6\x75"
    last = large[large.index(cluster) :]
    last = last[: last.index(b"\x1c\x53\xbb\x6b")] if b"\x1c\x53\xbb\x6b" in last else last
    return small[: small.index(cluster)] + small[small.index(cluster) :].split(b"\x1c\x53\xbb\x6b")[0] + last


@pytest.mark.slow
def test_frames_far_larger_than_the_head_says_are_not_decoded(tmp_path):
    """A frame of VP8 may change the size; OpenCV shrinks it, when FFmpeg has decoded it, without a word."""
    if ffmpeg._find_libavutil() is None:
        pytest.skip("FFmpeg of this OpenCV cannot be told how much memory it may take")
    small = written(tmp_path / "small.webm", "VP80", (320, 240), (40, 90)).read_bytes()
    large = written(tmp_path / "large.webm", "VP80", (6000, 5000), (0,)).read_bytes()
    path = tmp_path / "a.webm"
    path.write_bytes(grown_webm(small, large))
    script = """
import sys
import dase.io, dase.scenes.video
from dase.io import ffmpeg
before = peak()
print(*dase.io.read(sys.argv[1]).frames.shape, peak() - before)
ffmpeg.ALLOCATION = ffmpeg.AllocationLimits(always=1 << 30)
before = peak()
print(*dase.io.read(sys.argv[1]).frames.shape, peak() - before)
"""
    bounded, free = (line.split() for line in measured(script, path))
    assert bounded[:3] == ["2", "240", "320"]
    assert float(bounded[3]) < 25
    assert float(free[3]) > 30  # as without the bound


def test_frames_of_16_bits_are_light_by_their_range(tmp_path, rng):
    frames = rng.integers(0, 1 << 16, (4, 6, 8), dtype=np.uint16)
    times = np.arange(4) / 1000
    dase.io.write(
        tmp_path / "a.npz", dase.io.Sequence(dase.Events.empty(8, 6), frames=frames, frame_times=times)
    )
    want = frames / np.float32(65535)
    for scene in (
        open_video(tmp_path / "a.npz"),
        dase.VideoScene(frames, times),
        dase.VideoScene(want, times),
        as_scene(frames, times=times),
    ):
        np.testing.assert_array_equal(scene.frames(times), want)
    pixels = np.arange(48, dtype=np.int32)
    got = dase.VideoScene(frames, times).source(times, pixels, launch.find_device("cpu"))[1].values.numpy()
    np.testing.assert_array_equal(got, want.reshape(4, -1))


def test_bytes_are_light_by_their_range_and_gamma(rng):
    frames, times = rng.integers(0, 256, (3, 4, 5), dtype=np.uint8), [0.0, 1.0, 2.0]
    want = (frames / np.float32(255)) ** np.float32(2.2)
    np.testing.assert_allclose(dase.VideoScene(frames, times, gamma=2.2).frames(np.array(times)), want)
    with pytest.raises(dase.InputError, match=r"gamma must lie in 0.1..10"):
        dase.VideoScene(frames, times, gamma=0.0)


@pytest.mark.parametrize("values", [np.full((2, 3, 4), 255.0), np.full((2, 3, 4), 200)])
def test_numbers_that_cannot_be_light_are_refused(values):
    with pytest.raises(dase.InputError, match=r"divide them by the value of white|must be uint8"):
        dase.VideoScene(values, [0.0, 1.0])


def moving(tmp_path, rate, frames=12):
    """Write pictures of a texture that moves at 120 px/s; return their folder and the truth at any time."""
    rng = np.random.default_rng(1)
    texture = cv2.GaussianBlur(rng.random((48, 400)).astype(np.float32), (0, 0), 2)
    texture = 0.1 + 0.8 * (texture - texture.min()) / np.ptp(texture)

    def truth(time):
        shift = np.array([[1, 0, -120 * time], [0, 1, 0]])
        return cv2.warpAffine(texture, shift, (64, 48), flags=cv2.INTER_LINEAR)

    folder = tmp_path / "clip"
    folder.mkdir()
    for n in range(frames):
        cv2.imwrite(str(folder / f"{n:03d}.png"), np.rint(255 * truth(n / rate)).astype(np.uint8))
    return folder, truth


def test_frames_of_a_slow_video_follow_the_motion_and_say_so(tmp_path):
    folder, truth = moving(tmp_path, 30)
    notes: list[str] = []
    scene = open_video(folder, fps=30, gamma=1, notes=notes)
    assert isinstance(scene, dase.CameraScene)
    assert re.search(
        r"frames are 33.3 ms apart: the motion .* \d+ % of pixels and times are to be trusted", notes[0]
    )
    lines = open_video(folder, fps=30, gamma=1, between="lines", notes=notes)
    assert "joined by straight lines" in notes[-1]
    at = np.array([5.5 / 30])
    pixels = np.arange(64 * 48, dtype=np.int32)
    straight = lines.source(at, pixels, launch.find_device("cpu"))[1].values.numpy().reshape(48, 64)
    inner = np.s_[8:-8, 8:-8]
    errors = [np.abs(got - truth(at[0]))[inner].mean() for got in (scene.frames(at)[0], straight)]
    assert errors[0] < 0.3 * errors[1]
    assert isinstance(open_video(folder, fps=1000), dase.VideoScene)


def test_gamma_is_that_of_the_file_and_said(tmp_path):
    folder, _ = moving(tmp_path, 1000, frames=3)
    notes: list[str] = []
    scene = open_video(folder, fps=1000, notes=notes)
    assert scene.gamma == 2.2
    assert "light is taken as value ** 2.2" in notes[0]
    from PIL import Image, PngImagePlugin

    linear = PngImagePlugin.PngInfo()
    linear.add(b"gAMA", (100_000).to_bytes(4, "big"))
    with Image.open(folder / "000.png") as picture:
        picture.load()
        picture.save(folder / "000.png", pnginfo=linear)
    assert open_video(folder, fps=1000).gamma == 1


def test_times_beside_pictures_count(tmp_path):
    folder, _ = moving(tmp_path, 1000, frames=4)
    (folder / "timestamps.txt").write_text("000.png 5.0\n001.png 5.001\n002.png 5.0025\n003.png 5.003\n")
    np.testing.assert_allclose(open_video(folder).sample_times(), [0, 0.001, 0.0025, 0.003], atol=1e-12)
    np.testing.assert_allclose(open_video(folder, fps=1000).sample_times(), np.arange(4) / 1000)


def test_times_of_a_video_of_variable_rate_are_the_true_ones(tmp_path, rng):
    """An AVI tells a dropped frame by an empty packet: the frames after it are later."""
    grey, path = rng.integers(0, 256, (4, 6, 8), np.uint8), tmp_path / "a.avi"
    content = avi(grey)
    second = content.index(b"00db", content.index(b"00db") + 1)
    path.write_bytes(content[:second] + 2 * chunk(b"00db", b"") + content[second:])
    want = np.array([0, 3, 4, 5]) / 25
    np.testing.assert_allclose(open_video(path, between="lines").sample_times(), want)
    np.testing.assert_allclose(dase.io.read(path).frame_times, want)


def test_a_video_is_cut_to_the_shape_of_the_sensor(tmp_path):
    picture = np.zeros((20, 60), np.uint8)
    picture[:, 20:40] = 255
    for n in range(2):
        cv2.imwrite(str(tmp_path / f"{n}.png"), picture)
    scene = open_video(tmp_path, fps=1000, size=(10, 10))
    np.testing.assert_array_equal(scene.frames(scene.sample_times()), np.ones((2, 10, 10)))
