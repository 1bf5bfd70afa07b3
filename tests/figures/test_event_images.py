"""Statistics against a stream counted by hand, and drawings that are there."""

from __future__ import annotations

import importlib
import math

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from helpers.call_counts import count_calls

from dase import formatting, io
from dase.errors import InputError
from dase.events import Events
from dase.figures import event_images
from dase.io.sequence import Sequence
from dase.recordings import summary
from dase.recordings.statistics import sequence_statistics


def stream(rows, width, height):
    """Events from rows of (t, x, y, p)."""
    t, x, y, p = np.array(rows, float).T
    return Events(t, x.astype(np.uint16), y.astype(np.uint16), p > 0, width, height)


def random_sequence(rng, count=5000, frames=5, width=64, height=48, end=0.5):
    events = Events(
        np.sort(rng.uniform(0, end, count)),
        rng.integers(0, width, count, np.uint16),
        rng.integers(0, height, count, np.uint16),
        rng.random(count) < 0.3,
        width,
        height,
    )
    if not frames:
        return Sequence(events)
    grey = rng.integers(0, 256, (frames, height, width), np.uint8)
    return Sequence(events, grey, np.linspace(0, end, frames))


BY_HAND = [(0.0, 0, 0, 1), (0.1, 2, 1, 0), (0.4, 0, 0, 1), (0.5, 0, 0, 0), (1.1, 2, 1, 1), (2.0, 1, 0, 1)]


def test_statistics_by_hand():
    got = sequence_statistics(Sequence(stream(BY_HAND, 3, 2)))
    assert (got.width, got.height, got.frames, got.events) == (3, 2, 0, 6)
    assert got.duration == 2.0
    assert got.on_rate == pytest.approx(4 / 12)
    assert got.off_rate == pytest.approx(2 / 12)
    assert got.on_share == pytest.approx(4 / 6)
    assert got.interval_low == pytest.approx(0.106)
    assert got.interval_median == pytest.approx(0.4)
    assert got.interval_high == pytest.approx(0.988)
    assert got.silent_pixels == 3
    assert got.busiest_rate == pytest.approx(1.5)
    assert got.busiest_pixel == (0, 0)


def test_drawn_intervals_are_those_of_a_loop_over_pixels(rng):
    # a clock of which no tick is at the edge of a bin; some pairs of one pixel are at the same tick
    events = random_sequence(rng, 20_000, end=0.005).events
    events = Events(np.rint(events.t / 7.3e-7) * 7.3e-7, events.x, events.y, events.p, 64, 48)
    pixel = events.y.astype(int) * events.width + events.x
    between = np.concatenate([np.diff(events.t[pixel == k]) for k in range(events.width * events.height)])
    assert np.count_nonzero(between == 0) > 3
    axes = event_images.draw_sequence(Sequence(events)).axes[-1]
    shares, edges, _ = axes.patches[0].get_data()
    want, _ = np.histogram(np.clip(between, edges[0], edges[-1]), edges)
    np.testing.assert_allclose(shares, 100 * want / len(between), atol=100 * 2 / len(between))
    assert shares.sum() == pytest.approx(100)
    assert axes.lines[0].get_xdata()[0] == pytest.approx(np.median(between))


def test_frames_lengthen_the_duration():
    frames = np.zeros((2, 2, 3), np.uint8)
    assert sequence_statistics(Sequence(stream(BY_HAND, 3, 2), frames, np.array([-1.0, 3.0]))).duration == 4.0


def test_nothing_to_count():
    for events in (Events.empty(3, 2), stream(BY_HAND[:1], 3, 2)):
        sequence = Sequence(events)
        got = sequence_statistics(sequence)
        assert math.isnan(got.interval_median)
        assert got.silent_pixels == 6 - len(events)
        assert dict(summary.statistics_table(got))["interval, median"] == "unknown"
        figure = event_images.draw_sequence(sequence)
        figure.canvas.draw()


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (12.149788, "12.1 s"),
        (0.9999, "1 s"),
        (0.00325, "3.25 ms"),
        (75e-6, "75 µs"),
        (2e-9, "0.002 µs"),
        (0.0, "0 µs"),
        (1200.0, "1.2 ks"),
        (math.nan, "unknown"),
    ],
)
def test_seconds(value, text):
    assert formatting.format_seconds(value) == text


def test_default_window_is_a_round_number(rng):
    assert event_images.default_window(random_sequence(rng)) == pytest.approx(0.02)  # 3.3 Hz a pixel
    assert event_images.default_window(random_sequence(rng, 100_000)) == pytest.approx(0.001)
    assert event_images.default_window(Sequence(Events.empty(3, 2))) == pytest.approx(0.02)


def test_overlay_colours():
    counts = np.zeros((2, 1, 4), np.int32)
    counts[1, 0, 1] = counts[0, 0, 2] = 1
    counts[1, 0, 3] = 5
    got = event_images.overlay_events(None, counts).astype(int)[0]
    assert tuple(got[0]) == (255, 255, 255)
    assert got[1, 0] > got[1, 2] + 50
    assert got[2, 2] > got[2, 0] + 50
    assert got[3, 1] < got[1, 1]  # more events hide more
    black = event_images.overlay_events(np.zeros((1, 4), np.uint8), counts)
    assert black[0, 0, 0] < 100


def test_panel_loses_no_event_when_it_shrinks(rng):
    sequence = random_sequence(rng, 200, frames=0, width=65, height=49)
    full, small = (event_images.moment_picture(sequence, 0.25, 0.5, shrink=k) for k in (1, 4))
    assert small.shape == (13, 17, 3)
    marked = (full != 255).any(-1)
    for y, x in zip(*np.nonzero(marked), strict=True):
        assert (small[y // 4, x // 4] != 255).any()


def assert_nothing_overlaps(figure):
    boxes = [axes.get_tightbbox() for axes in figure.axes]
    for k, one in enumerate(boxes):
        assert not any(one.overlaps(other) for other in boxes[k + 1 :])
        assert figure.bbox.containsx(one.x0)
        assert figure.bbox.containsx(one.x1)


@pytest.mark.parametrize("frames", [0, 1, 5])
def test_sheet(tmp_path, rng, frames):
    sequence = random_sequence(rng, frames=frames)
    figure = event_images.draw_sequence(sequence, title="a")
    pictures = [axes for axes in figure.axes if axes.images]
    assert len(pictures) == (min(frames, 6) or 6)
    assert_nothing_overlaps(figure)
    figure.savefig(tmp_path / "a.png")
    assert 20_000 < (tmp_path / "a.png").stat().st_size < 3_000_000
    assert cv2.imread(str(tmp_path / "a.png")).shape[1] == 1650


@pytest.mark.parametrize(("width", "height"), [(20, 90), (200, 20), (1, 1)])
def test_sheet_of_odd_sensors(rng, width, height):
    figure = event_images.draw_sequence(random_sequence(rng, width=width, height=height))
    figure.canvas.draw()
    assert_nothing_overlaps(figure)
    for picture in (axes for axes in figure.axes if axes.images):
        box = picture.get_window_extent()
        assert box.height / box.width == pytest.approx(height / width, rel=0.01)  # pixels are square
        assert min(box.width, box.height) > 20  # and can be seen


def test_sheet_of_one_moment_and_of_frames_without_times(rng):
    sequence = random_sequence(rng)
    figure = event_images.draw_sequence(sequence, at=0.1, window=0.01)
    assert sum(bool(axes.images) for axes in figure.axes) == 1
    figure = event_images.draw_sequence(Sequence(sequence.events, sequence.frames))
    assert any("unknown" in text.get_text() for text in figure.texts)
    with pytest.raises(InputError, match=r"at: must lie in 0\.\.0\.5 s, got 7 s"):
        event_images.draw_sequence(sequence, at=7.0)
    for window in (0.0, -1.0, math.nan):
        with pytest.raises(InputError, match="window"):
            event_images.draw_sequence(sequence, window=window)


@pytest.mark.parametrize("frames", [0, 1, 7])
def test_video(tmp_path, rng, frames):
    event_images.write_video(random_sequence(rng, frames=frames), tmp_path / "a.mp4")
    film = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) == (frames or 60)
    assert film.get(cv2.CAP_PROP_FPS) == pytest.approx(12.0 if frames == 7 else 30.0)
    good, picture = film.read()
    assert good
    assert picture.shape == (384, 512, 3)
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]


def test_video_of_nothing_and_with_a_window(tmp_path, rng):
    event_images.write_video(Sequence(Events.empty(3, 2)), tmp_path / "a.mp4")
    event_images.write_video(random_sequence(rng, frames=0), tmp_path / "b.mp4", window=0.1)
    assert cv2.VideoCapture(str(tmp_path / "b.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 5


def test_every_event_is_in_one_picture_of_the_video(rng):
    for frames in (0, 6):
        sequence = random_sequence(rng, frames=frames)
        begins, ends, _ = event_images._video_times(sequence, None)
        assert begins[0] < sequence.events.t[0]
        np.testing.assert_array_equal(begins[1:], ends[:-1])
        assert ends[-1] >= sequence.events.t[-1]


def test_command(tmp_path, rng):
    command = importlib.import_module("dase.cli.show").show_command
    io.write(tmp_path / "a.h5", random_sequence(rng))
    done = CliRunner().invoke(command, [str(tmp_path / "a.h5")])
    assert done.exit_code == 0, done.output
    assert "ON share" in done.output
    assert (tmp_path / "a.png").stat().st_size > 20_000
    done = CliRunner().invoke(command, [str(tmp_path / "a.h5"), "-o", str(tmp_path / "a.mp4")])
    assert done.exit_code == 0, done.output
    assert (tmp_path / "a.mp4").exists()
    for bad in (["-o", "a.gif"], ["-o", "a.mp4", "--at", "0.1"], ["--at", "9"], ["--window", "0"]):
        done = CliRunner().invoke(command, [str(tmp_path / "a.h5"), *bad])
        assert isinstance(done.exception, InputError)
    done = CliRunner().invoke(command, [str(tmp_path / "b.h5")])
    assert isinstance(done.exception, InputError)


def test_no_statistic_goes_through_single_events(rng):
    few, many = (random_sequence(rng, n, frames=0, width=640, height=480, end=10.0) for n in (10**4, 10**6))
    sequence_statistics(few)  # compiles and imports
    assert count_calls(lambda: sequence_statistics(many)) < 2 * count_calls(lambda: sequence_statistics(few))


def test_shared_recording(shared):
    got = sequence_statistics(io.read(shared / "recordings" / "dvx_noise_static.npz"))
    assert 0.2 < got.on_rate + got.off_rate < 1.0
    assert got.busiest_rate > 1000.0  # its stuck pixel


def test_videos_play_in_browsers_where_opencv_can_write_such(rng, tmp_path, capfd, monkeypatch):
    codec = event_images.write_video(random_sequence(rng, frames=3), tmp_path / "a.mp4")
    assert capfd.readouterr().err == ""  # what OpenCV lacks is nothing to tell
    capture = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    letters = int(capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little").lower()
    browsers = (b"avc1", b"h264", b"vp09", b"vp90")
    assert (letters in browsers) == codec.plays_in_browsers
    has = [
        cv2.VideoWriter(str(tmp_path / "b.mp4"), cv2.VideoWriter.fourcc(*code), 30.0, (64, 48)).isOpened()
        for code in ("avc1", "vp09")
    ]
    assert codec.plays_in_browsers == any(has)
    monkeypatch.setattr(event_images, "CODECS", event_images.CODECS[-1:])
    assert not event_images.write_video(random_sequence(rng, frames=3), tmp_path / "c.mp4").plays_in_browsers
