"""Files that are shown to a camera, read back by others: OpenCV, Pillow, the numbers of a PDF."""

from __future__ import annotations

import json
import re

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from dase import InputError
from dase.cli import dase_group
from dase.datasets.stimulus_files import StimulusJob, protocol_text, write_stimulus
from dase.effects import EFFECTS
from dase.fitting.screen_limits import screen_limits_of
from dase.scenes.screen_stimulus import ScreenStimulus, read_stimulus

SHORT = ScreenStimulus(size=(160, 90), parts=("steps",))


def frames_of(path):
    capture, out = cv2.VideoCapture(str(path)), []
    rate = capture.get(cv2.CAP_PROP_FPS)
    while True:
        good, frame = capture.read()
        if not good:
            return rate, np.array(out)
        out.append(frame[..., 1])


@pytest.mark.parametrize("suffix", [".mkv", ".avi"])
def test_a_lossless_video_comes_back_as_it_was(tmp_path, suffix):
    path = tmp_path / f"shown{suffix}"
    assert write_stimulus(StimulusJob(SHORT), path) == [path, tmp_path / "shown.json"]
    rate, frames = frames_of(path)
    assert rate == pytest.approx(60)
    assert len(frames) == SHORT.frame_count
    for k in range(0, SHORT.frame_count, 7):
        np.testing.assert_array_equal(frames[k], SHORT.picture(k))
    again = read_stimulus(tmp_path / "shown.json")
    np.testing.assert_array_equal(again.picture(300), SHORT.picture(300))


def test_an_mp4_loses_a_little(tmp_path):
    path = tmp_path / "shown.mp4"
    write_stimulus(StimulusJob(SHORT), path)
    _, frames = frames_of(path)
    segment = SHORT.segment_of("steps")
    off = []
    for k in range(segment.begin + 5, segment.end, 15):
        want = SHORT.picture(k).astype(float)
        flat = cv2.morphologyEx(want, cv2.MORPH_GRADIENT, np.ones((9, 9))) == 0  # inside of tiles
        off.append(np.abs(frames[k] - want)[flat])
    assert 0 < np.concatenate(off).mean() < 4  # docs/stimulus.md says levels of 8 bits


def test_contrasts_of_the_video_are_those_of_the_truth(tmp_path):
    path = tmp_path / "shown.mkv"
    write_stimulus(StimulusJob(SHORT), path)
    _, frames = frames_of(path)
    truth = json.loads((tmp_path / "shown.json").read_text())
    steps = next(s for s in truth["segments"] if s["kind"] == "steps")
    first = round(steps["begin"] * truth["refresh"])
    slot = round(steps["slot"] * truth["refresh"])
    light = [
        truth["black"] + (1 - truth["black"]) * (frames[first + n * slot + 2] / 255.0) ** truth["gamma"]
        for n in range(2)
    ]
    change = np.log(light[1] / light[0])
    for n, contrast in enumerate(steps["contrast"]):
        row, column = int((n // 6 + 0.5) * 90 / 4), int((n % 6 + 0.5) * 160 / 6)
        assert change[row, column] == pytest.approx(contrast, abs=1e-9)


def test_a_png_has_the_size_of_the_paper(tmp_path):
    path = tmp_path / "sheet.png"
    write_stimulus(StimulusJob(SHORT, paper="a5", dpi=100), path)
    with Image.open(path) as picture:
        inches = [n / dpi for n, dpi in zip(picture.size, picture.info["dpi"], strict=True)]
        grey = np.asarray(picture.convert("L"))
    assert [25.4 * n for n in inches] == pytest.approx([210, 148], abs=0.3)
    # the line of 100 mm, 1 mm above the lower margin
    row = grey[round((148 - 11) / 25.4 * 100)]
    dark = np.flatnonzero(row[: round(112 / 25.4 * 100)] < 128)
    assert (dark[-1] - dark[0]) / 100 * 25.4 == pytest.approx(100, abs=0.6)


def test_a_pdf_has_the_size_of_the_paper(tmp_path):
    path = tmp_path / "sheet.pdf"
    write_stimulus(StimulusJob(SHORT, paper="a4"), path)
    box = re.search(rb"/MediaBox \[ ?([\d. ]+)\]", path.read_bytes())
    assert box is not None
    points = [float(n) for n in box[1].split()]
    assert [n / 72 * 25.4 for n in points[2:]] == pytest.approx([297, 210], abs=0.1)


def test_a_folder_gets_all(tmp_path):
    out = tmp_path / "shown"
    done = CliRunner().invoke(
        dase_group, ["stimulus", str(out), "--size", "160x90", "--parts", "ladder", "--refresh", "144"]
    )
    assert done.exit_code == 0, done.output
    names = {path.name for path in out.iterdir()}
    assert names == {"stimulus.mkv", "stimulus.json", "sheet.pdf", "sheet.json", "protocol.md"}
    assert read_stimulus(out / "stimulus.json").refresh == 144
    assert "--stimulus" in done.output
    assert frames_of(out / "stimulus.mkv")[0] == pytest.approx(144)


def test_the_protocol_says_what_a_screen_cannot_tell():
    text = protocol_text(SHORT)
    limits = screen_limits_of(EFFECTS.values(), SHORT)
    assert len(limits) > 10
    assert all(f"- `{name}`: {limit}.\n" in text for name, limit in limits.items())
    assert "60 Hz" in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["x.txtt"], "must be a folder, or end with one of"),
        (["x.pdf", "--paper", "b4"], "paper must be one of a3, a4, a5, letter, got 'b4'"),
        (["x.png", "--dpi", "3"], "dpi must lie in 50..1200, got 3"),
        (["x.mkv", "--refresh", "0"], "refresh must lie in 20..1000 Hz, got 0"),
        (["x.mkv", "--parts", "song"], "parts must be of ladder, steps, ramps, chirp, edges, got 'song'"),
        (["x.mkv", "--size", "97x65"], "size of a screen must be even"),
        (["x.mkv", "--gamma", "-1"], "gamma must lie in"),
    ],
)
def test_wrong_options_are_one_sentence(tmp_path, arguments, message):
    done = CliRunner().invoke(dase_group, ["stimulus", str(tmp_path / arguments[0]), *arguments[1:]])
    assert done.exit_code != 0
    assert isinstance(done.exception, InputError)
    assert message in str(done.exception)
    assert not list(tmp_path.iterdir())
