"""What files and their names say never steers the terminal."""

from __future__ import annotations

import subprocess
import sys
import zipfile

import numpy as np
import pytest
from click.testing import CliRunner
from helpers import sample_files as reference_io

from dase import io
from dase.cli import dase_group
from dase.errors import InputError, printable

EVIL = "\x1b]0;owned\x07\x1b[31m\x9b2J\u202e"


def clean(text):
    return not any(c in text for c in "\x1b\x07\x9b\u202e")


def test_what_is_shown_of_characters():
    assert printable("plain, µs\N{NO-BREAK SPACE}▏ü\n\t") == "plain, µs\N{NO-BREAK SPACE}▏ü\n\t"
    assert printable("a\x1b[31m\x9b\u202e\udcff\r") == r"a\x1b[31m\x9b\u202e\udcff\r"
    assert str(InputError(EVIL)) == printable(EVIL)
    assert str(io.Note(EVIL)) == printable(EVIL)


def evil_zip(path):
    with zipfile.ZipFile(path, "w") as archive:
        for k in range(2):
            archive.writestr(f"{EVIL}{k}.txt", "0.5 1 1 1\n")


def evil_pictures(path):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("events.txt", "0.5 1 1 1\n")
        archive.writestr("images.txt", f"0.5 {EVIL.replace(' ', '')}.png\n")


def evil_hdf5(path):
    import h5py

    with h5py.File(path, "w") as file:
        file[EVIL] = np.arange(3)


def evil_text(path):
    path.write_text(f"0.5 1 1 1\n0.6 1 1 {EVIL}\n")


def evil_head(path):
    path.write_bytes(f"#!AER-DAT2.0\r\n# AEChip: {EVIL}\r\n".encode("latin-1", "replace"))


@pytest.mark.parametrize(
    ("suffix", "make"),
    [
        (".zip", evil_zip),
        (".zip", evil_pictures),
        (".h5", evil_hdf5),
        (".txt", evil_text),
        (".aedat", evil_head),
        (".npy", lambda path: np.save(path, np.zeros(3, [(EVIL[:3], "f8")]))),
    ],
)
@pytest.mark.parametrize("words", [["info"], ["info", "--json", "-"], ["convert"]])
def test_names_in_files(tmp_path, suffix, make, words):
    path = tmp_path / f"a{suffix}"
    make(path)
    done = CliRunner().invoke(
        dase_group, [*words, str(path), *([str(tmp_path / "b.h5")] if words[0] == "convert" else [])]
    )
    assert clean(done.output)
    assert clean(str(done.exception))


def test_names_of_files(tmp_path, rng):
    path = tmp_path / f"{EVIL.replace('/', '')}.h5"
    reference_io.SAMPLES["HDF5"][1](path, reference_io.events(rng, 100))
    for words in (
        ["info", path],
        ["convert", path, tmp_path / "b\x1b[5m.raw"],
        ["show", path, "-o", tmp_path / "\x9b.png"],
    ):
        done = CliRunner().invoke(dase_group, [str(word) for word in words])
        assert done.exit_code == 0, done.exception
        assert clean(done.output)


@pytest.mark.parametrize(
    "words", [["info", f"{EVIL}.h5"], [EVIL], ["info", "a.h5", "--size", EVIL], ["info", EVIL + ".xyz"]]
)
def test_what_the_command_prints_in_a_process_of_its_own(tmp_path, words):
    code = "from dase.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code, *words], capture_output=True, text=True, cwd=tmp_path, check=False
    )
    assert done.returncode == 2
    assert clean(done.stdout + done.stderr)
    assert "x1b" in done.stderr


def test_a_dollar_in_the_name_is_no_mathematics(tmp_path, rng):
    path = tmp_path / "a$\\frac{1$b$_^.h5"
    reference_io.SAMPLES["HDF5"][1](path, reference_io.events(rng, 1000))
    done = CliRunner().invoke(dase_group, ["show", str(path), "-o", str(tmp_path / "a.png")])
    assert done.exit_code == 0, done.exception


def test_the_help_of_effects_says_that_it_runs_code():
    done = CliRunner().invoke(dase_group, ["info", "--help"])
    assert done.exit_code == 0
    done = CliRunner().invoke(dase_group, ["compare", "--help"])
    assert "its code is run" in " ".join(done.output.split())
