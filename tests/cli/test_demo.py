"""`dase demo`: what is in its folder and is not its own stays."""

from __future__ import annotations

import shutil

import pytest

from dase import Events, InputError, io
from dase.datasets import generate
from dase.datasets.demo import run_demo


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    out = tmp_path_factory.mktemp("demo")
    run_demo(out, say=lambda line: None)
    return out


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_folder_with_a_data_set_is_not_emptied(tmp_path):
    job = generate.DatasetJob(
        images="builtin", sensor="[threshold]\n", sequences=1, width=8, height=6, duration=0.05, regime="slow"
    )
    generate.generate_dataset(job, tmp_path)
    (tmp_path / "notes.txt").write_text("mine")
    before = contents(tmp_path)
    with pytest.raises(InputError, match=r"synth.toml is not of an earlier demo: choose another folder"):
        run_demo(tmp_path, say=lambda line: None)
    assert contents(tmp_path) == before


def test_a_demo_is_made_anew_and_only_it(made, tmp_path):
    out = tmp_path / "again"
    shutil.copytree(made, out)
    (out / "notes.txt").write_text("mine")
    (out / "sub").mkdir()
    (out / "sub" / "more.txt").write_text("mine, too")
    picture, events = run_demo(out, say=lambda line: None)
    assert picture.is_file()
    assert events.is_file()
    assert (out / "notes.txt").read_text() == "mine"
    assert (out / "sub" / "more.txt").read_text() == "mine, too"


@pytest.mark.parametrize("name", ["synth.toml", "sequence_00000.h5", "sequence_00000.png"])
def test_each_file_that_is_not_of_a_demo_stays(made, tmp_path, name):
    out = tmp_path / "again"
    shutil.copytree(made, out)
    other = tmp_path / "other.h5"
    io.write(other, io.Sequence(Events.empty(8, 6)))
    for content in (b"\xff\xfe", b"[mine]\n", other.read_bytes()):
        (out / name).write_bytes(content)
        before = contents(out)
        with pytest.raises(InputError, match=f"{name} is not of an earlier demo"):
            run_demo(out, say=lambda line: None)
        assert contents(out) == before
