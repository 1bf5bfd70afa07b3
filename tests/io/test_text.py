"""Events as text: every way people write them, and every way they get it wrong."""

from __future__ import annotations

import io as streams
import zipfile

import cv2
import numpy as np
import pytest
from helpers.sample_files import H, W, events, measured

from dase import io
from dase.errors import InputError
from dase.events import Events
from dase.io import text
from dase.io.sequence import Sequence


def read(tmp_path, content, name="a.txt", **options):
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    return io.read(tmp_path / name, **options).events


@pytest.mark.parametrize(
    ("content", "size"),
    [
        ("0.5 3 4 1\n1.25 5 6 0\n", (128, 128)),
        ("0.5 3 4 1\r\n1.25 5 6 0", (128, 128)),
        ("\n# a comment\n0.5, 3, 4, 1\n\n1.25,5,6,0,\n\n", (128, 128)),
        ("0.5\t3\t4\t1\n1.25\t5\t6\t-1\n", (128, 128)),
        ("346 260\n0.5 3 4 1\n1.25 5 6 0\n", (346, 260)),
        ("# 300 200 columns and rows; t [s], x, y, p (1 = ON)\n0.5 3 4 1\n1.25 5 6 0\n", (300, 200)),
        ("t,x,y,p\n5e-1,3,4,1\n+1.25,5,6,0\n", (128, 128)),
        ("3,4,1,500000\n5,6,0,1250000\n", (128, 128)),
        ("500000 3 4 1\n1250000 5 6 0\n", (128, 128)),
        ("#!events.txt\n# v2e\n0.5 3 4 1 1\n1.25 5 6 0 0\n", (128, 128)),
    ],
)
def test_the_same_two_events(tmp_path, content, size):
    got = read(tmp_path, content)
    assert got.t.tolist() == [0.5, 1.25]
    assert (got.width, got.height) == size
    assert (got.x.tolist(), got.y.tolist(), got.p.tolist()) == ([3, 5], [4, 6], [True, False])


def test_times_are_read_as_python_reads_them(tmp_path, rng):
    times = np.sort(rng.uniform(0, 100, 3000))
    words = [repr(t) if k % 3 else f"{t:.{k % 17}f}" for k, t in enumerate(times.tolist())]
    words += ["1504645177.420018196", "1e2", ".5", "7.", "00012.50", "0.1234567890123456789"]
    content = "".join(f"{word} 1 1 1\n" for word in words)
    (piece,) = text.decode_text(lambda: streams.BytesIO(content.encode()))
    assert piece.t.tolist() == [float(word) for word in words]


@pytest.mark.parametrize(
    "times",
    [[0.0, 1e-6, 2147.999999], [0.0, 1e-9, 1.000000001], [1 / 3, 2 / 3, 1e3 / 7], [0.1 + 0.2, 4e5 / 3, 1e-3]],
)
def test_times_are_written_with_all_their_digits(tmp_path, times):
    times = np.sort(np.array(times))
    n = np.array([0, 10, 65535 % W], np.uint16)
    e = Events(times, n, n % H, n > 5, W, H)
    for name in ("a.txt", "a.zip"):
        io.write(tmp_path / name, Sequence(e))
        got = io.read(tmp_path / name).events
        np.testing.assert_array_equal(got.t, times)
        np.testing.assert_array_equal(got.x, e.x)


def test_what_a_written_text_looks_like(tmp_path):
    n = np.array([7, 239], np.uint16)
    e = Events(np.array([0.000001, 12.5]), n, n - 7, n > 9, 240, 240)
    io.write(tmp_path / "a.txt", Sequence(e))
    want = "# 240 240 columns and rows; t [s], x, y, p (1 = ON)\n0.000001 7 0 0\n12.500000 239 232 1\n"
    assert (tmp_path / "a.txt").read_text() == want
    io.write(tmp_path / "a.zip", Sequence(e))
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        assert archive.namelist() == ["events.txt"]
        assert archive.read("events.txt").decode() == "240 240\n" + want.split("\n", 1)[1]


@pytest.mark.parametrize(
    ("line", "match"),
    [
        ("0.5 3 4", "line 4 "),
        ("0.5 3 4 1 9 9", "line 4"),
        ("0.5 3 4 2", "line 4"),
        ("0.5 -3 4 1", "line 4"),
        ("0.5 70000 4 1", "line 4"),
        ("0.5 3.5 4 1", "line 4"),
        ("0.5.5 3 4 1", "line 4"),
        ("nan 3 4 1", "line 4"),
        ("inf 3 4 1", "line 4"),
        ("5-3 3 4 1", "line 4"),
        (". 3 4 1", "line 4"),
        ("# late comment here", "line 4"),
        ("0.5 3 4 1" + " " * 300 + "1", "line 4"),
        ("\0\0\0", "line 4"),
        ("1_0 3 4 1", "line 4"),
    ],
)
def test_a_line_that_is_no_event_is_named(tmp_path, monkeypatch, line, match):
    for head, block in ((1 << 14, 1 << 20), (30, 8)):
        monkeypatch.setattr(text, "LIMITS", text.TextLimits(head=head, block=block))
        with pytest.raises(InputError, match=match):
            read(tmp_path, f"# comment\n0.1 1 1 1\n0.2 1 1 1\n{line}\n0.6 1 1 1\n")


def test_texts_that_are_no_events(tmp_path):
    for content in ("hello world\n", "1 2\n3 4\n", "", "# only\n# comments\n", "x y\n1 2 3 4 5 6\n"):
        with pytest.raises(InputError, match="holds no events"):
            read(tmp_path, content)
    with pytest.raises(InputError, match=r"longer than 200 bytes|no events"):
        read(tmp_path, b"0.5 1 1 1\n" + b"1" * (3 << 20))


@pytest.mark.parametrize("packed", [False, True])
def test_ijrr_folder_and_zip_with_frames(tmp_path, rng, packed):
    e, grey = events(rng, 500), rng.integers(0, 256, (3, H, W), np.uint8)
    folder = tmp_path / "shapes"
    (folder / "images").mkdir(parents=True)
    io.write(folder / "events.txt", Sequence(e))
    (folder / "events.txt").write_text((folder / "events.txt").read_text().split("\n", 1)[1])
    (folder / "calib.txt").write_text("1 2 3 4 5 6 7 8 9\n")
    lines = []
    for k, frame in enumerate(grey):
        cv2.imwrite(str(folder / f"images/frame_{k:08d}.png"), frame)
        lines.append(f"{0.001 * k:.6f} images/frame_{k:08d}.png\n")
    (folder / "images.txt").write_text("".join(lines))
    path = folder
    if packed:
        path = tmp_path / "shapes.zip"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for file in sorted(folder.rglob("*.*")):
                archive.write(file, file.relative_to(tmp_path))
    for place in (path,) if packed else (path, folder / "events.txt"):
        notes = []
        got = io.read(place, notes=notes)
        np.testing.assert_array_equal(got.frames, grey)
        np.testing.assert_allclose(got.frame_times, [0, 0.001, 0.002])
        np.testing.assert_array_equal(got.events.t, e.t)
        assert notes == []  # the size is that of the frames
    if packed:
        return
    (folder / "images/frame_00000001.png").unlink()
    notes = []
    assert io.read(folder, notes=notes).frames is None
    assert "missing" in notes[-1]
    (folder / "images/frame_00000001.png").write_bytes(b"rubbish")
    with pytest.raises(InputError, match=r"frame_00000001\.png: cannot be decoded"):
        io.read(folder)
    (folder / "images.txt").write_text("0.1 ../../secret.png\n")
    with pytest.raises(InputError, match="leads out of the folder"):
        io.read(folder)


CLAIMS = """
import sys
from pathlib import Path
from dase.errors import InputError
from dase.io import frames
from dase.io.image_files import decode_file
data = Path(sys.argv[1]).read_bytes()
frames.decode_grey(data, "whole"), decode_file(Path(sys.argv[1]))
before = peak()
place = data.index(b"IDAT") - 4
Path(sys.argv[1]).write_bytes(data[:place] + bytes.fromhex("54000000") + data[place + 4 :])
path = Path(sys.argv[1])
for act in (lambda: frames.decode_grey(path.read_bytes(), "a.png"), lambda: decode_file(path)):
    try:
        act()
    except InputError as error:
        print(error)
print(peak() - before)
"""


def test_a_picture_that_claims_to_be_large_takes_no_memory(tmp_path, rng):
    """OpenCV 5 takes 1.4 GB for a PNG of 2 kB whose part says that it is as long."""
    cv2.imwrite(str(tmp_path / "a.png"), rng.integers(0, 256, (36, 48), np.uint8))
    *said, grown = measured(CLAIMS, tmp_path / "a.png")
    assert len(said) == 2
    assert all("decode" in line for line in said)
    assert float(grown) < 50


def test_zips_with_more_than_one_text(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr("a.txt", "0.1 1 1 1\n")
        archive.writestr("b.txt", "0.1 1 1 1\n")
    with pytest.raises(InputError, match="must hold one text of them, got 2"):
        io.read(tmp_path / "a.zip")
