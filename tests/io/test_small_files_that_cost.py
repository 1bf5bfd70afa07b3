"""Small files that took half a minute and more, or ended in a traceback: each is a sentence, soon."""

from __future__ import annotations

import zipfile
from contextlib import suppress
from importlib import import_module

import numpy as np
import pytest
from click.testing import CliRunner
from helpers import sample_files as reference_io
from helpers.call_counts import count_calls, counting_calls

import dase
from dase import io
from dase.cli import dase_group
from dase.errors import InputError
from dase.files.text_files import parse_json, parse_toml, read_text_file
from dase.fitting.measurement import open_clip


@pytest.fixture(autouse=True)
def soon():
    """What takes half a minute calls some hundred million functions; PyTorch's import is not meant."""
    with suppress(ImportError):
        import_module("torch")
    with counting_calls() as counted:
        yield
    assert counted.calls < 4_000_000


@pytest.mark.parametrize("content", [b"1" * 50_000_000, b"1 " * 25_000_000, b"0.5 1 1 1" + b" " * 50_000_000])
def test_one_line_of_50_mb(tmp_path, content):
    (tmp_path / "a.txt").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.txt: "):
        io.read(tmp_path / "a.txt")


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("a{}.txt", marks=pytest.mark.slow),
        pytest.param("a{}.npy", marks=pytest.mark.slow),
        pytest.param("frame_{}.png", marks=pytest.mark.slow),
    ],
)
def test_each_member_of_a_zip_costs_the_same(tmp_path, rng, name):
    """One of 20,000 took half a minute; what is counted does not depend on the processor."""
    e = reference_io.events(rng, 300)
    text = "".join(f"{t:.6f} {x} {y} 1\n" for t, x, y in zip(e.t, e.x, e.y, strict=True))

    def calls(act, members):
        with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
            for k in range(members):
                archive.writestr(name.format(k), b"")
            archive.writestr("events.txt", text)

        def read():
            with suppress(InputError):
                act(tmp_path / "a.zip")

        return count_calls(read)

    for act in (io.read, lambda path: list(io.stream(path)), lambda path: list(io.pictures(path))):
        few, many = calls(act, 1000), calls(act, 4000)
        assert many < 4.2 * few
        assert many < 4000 * 150


def test_a_folder_of_text_with_a_long_list_of_pictures(tmp_path):
    (tmp_path / "events.txt").write_text("0.5 1 1 1\n")
    (tmp_path / "images.txt").write_text("".join(f"{k} {k}.png\n" for k in range(300_000)))
    assert len(io.read(tmp_path).events) == 1


def toml(tmp_path, text):
    (tmp_path / "a.toml").write_bytes(text if isinstance(text, bytes) else text.encode())
    return tmp_path / "a.toml"


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("# " + "a" * 10_000_000, "larger than 256 KiB"),
        ("a = " + "[" * 100_000, "is not TOML"),
        ("a = " + "[" * 100_000 + "]" * 100_000, "is not TOML"),
        ("a" + ".a" * 100_000 + " = 1", "is not TOML"),
        ('name = "a\0b"', "is not TOML"),
        ("na\0me = 1", "is not TOML"),
        (b'name = "\xff\xfe"', "is not UTF-8"),
        ("size = [99999999999, 1]\n[threshold]\non = 0.2", "size must lie between"),
        ("size = " + "9" * 5000, "is not TOML"),
        ("[threshold]\non = 1" + "0" * 400, "a whole number of 1329 bits"),
        ('[[history]]\ndid = "x"\nerror_before = -1' + "0" * 400, "a whole number of 1329 bits"),
        ('"\x1b[31mred" = 1', "is not TOML"),
        ('"\\u001b[31mred" = 1', r"\\x1b\[31mred"),
        ('[[history]]\n"a\\u009bb" = 1', r"\\x9bb"),
    ],
)  # fmt: skip
def test_sensor_files(tmp_path, text, match):
    path = toml(tmp_path, text)
    with pytest.raises(InputError, match=match) as found:
        dase.load_sensor(path)
    assert str(path) in str(found.value)
    assert "\x1b" not in str(found.value)
    for words in (("remove", str(path), "leak"), ("add", str(path), "leak")):
        done = CliRunner().invoke(dase_group, [*words])
        assert isinstance(done.exception, InputError | SystemExit), done.exception


def test_the_record_of_a_data_set_that_is_no_utf_8(tmp_path):
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / "synth.toml").write_bytes(b"\xff\xfe")
    done = CliRunner().invoke(dase_group, ["synth", str(tmp_path / "d"), "--resume", "--sequences", "1"])
    assert "is not UTF-8 text" in str(done.exception)


@pytest.mark.parametrize("content", [b"", b"no zip", b"PK\x03\x04 cut short", b"\x80\x04."])
def test_a_scene_that_is_no_zip(tmp_path, content):
    (tmp_path / "x.npz").write_bytes(content)
    with pytest.raises(InputError, match=r"x\.npz"):
        open_clip(tmp_path / "x.npz")


def test_a_scene_that_unpacks_to_too_much(tmp_path):
    np.savez_compressed(
        tmp_path / "x.npz", frames=np.zeros((300, 1000, 1000), np.uint8), frame_us=np.arange(300)
    )
    with pytest.raises(InputError, match="unpacks from"):
        open_clip(tmp_path / "x.npz")


def test_deeply_nested_texts():
    for act, deep in ((parse_json, "[" * 100_000), (parse_toml, "a = " + "[" * 100_000)):
        with pytest.raises(InputError, match="x "):
            act(deep, "x")
    with pytest.raises(InputError, match="x must be JSON"):
        parse_json(b"\xff", "x")


POINTER = f"version https://git-lfs.github.com/spec/v1\noid sha256:{'4d7a2146' * 8}\nsize 12345678\n"


@pytest.mark.parametrize("suffix", [".h5", ".raw", ".aedat4", ".bag", ".npz", ".txt", ".avi", ".bin"])
def test_a_git_lfs_pointer_is_called_one(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    path.write_text(POINTER)
    for act in (io.read, lambda one: list(io.stream(one)), lambda one: io.convert(one, tmp_path / "b.h5")):
        with pytest.raises(InputError, match="is a Git LFS pointer, not the file of 12,345,678 bytes"):
            act(path)


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (POINTER.encode(), "Git LFS pointer"),
        (b"/annex/objects/SHA256E-s1234--abc.h5\n", "git-annex pointer"),
        (b"\n<!DOCTYPE html>\n<html><head>", "is a web page"),
    ],
)
def test_other_files_that_stand_for_one(tmp_path, content, match):
    from dase.scenes.video import open_video

    (tmp_path / "a.png").write_bytes(content)
    (tmp_path / "b.png").write_bytes(content)
    (tmp_path / "a.toml").write_bytes(content)
    (tmp_path / "a.avi").write_bytes(content)
    (tmp_path / "s").mkdir()
    for act in (
        lambda: io.find_format(tmp_path / "a.png"),
        lambda: io.read(tmp_path),
        lambda: dase.load_sensor(tmp_path / "a.toml"),
        lambda: open_video(tmp_path / "a.avi"),
        lambda: dase.open_images(str(tmp_path)).background(np.random.default_rng(0)),
    ):
        with pytest.raises(InputError, match=match):
            act()


def test_a_text_file_has_an_end(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        read_text_file(tmp_path, "a file")
