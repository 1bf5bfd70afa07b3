"""A run that ended early goes on where it was, and takes nothing damaged or foreign for its own."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
from helpers.tiny_datasets import JOB

from dase import Events, InputError, io
from dase.datasets import generate


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    out = tmp_path_factory.mktemp("whole") / "data"
    generate.generate_dataset(JOB, out)
    return out


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("spoil", ["cut", "empty", "garbage", "zeros"])
def test_resume_makes_damaged_sequences_again(whole, tmp_path, spoil):
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    path = out / "sequence_00001.h5"
    good = path.read_bytes()
    spoilt = {
        "cut": good[:1000],
        "empty": b"",
        "garbage": b"rubbish" * 100,
        "zeros": good[:600] + bytes(9000),
    }
    path.write_bytes(spoilt[spoil])
    said: list[str] = []
    report = generate.generate_dataset(JOB, out, resume=True, say=said.append)
    assert report.sequences == 1
    assert len(said) == 1
    assert re.search(r"sequence_00001\.h5.*: made again$", said[0])
    assert contents(out) == contents(whole)


def test_resume_of_what_is_whole_makes_nothing(whole, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    for jobs in (1, 2):
        assert generate.generate_dataset(JOB, out, jobs=jobs, resume=True).sequences == 0
    assert contents(out) == contents(whole)


def test_resume_sets_foreign_sequences_aside(whole, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    io.write(out / "sequence_00000.h5", io.Sequence(Events.empty(16, 12)))  # says nothing of a job
    shutil.copy(whole / "sequence_00001.h5", out / "sequence_00002.h5")  # of the job, but another one of it
    foreign = (out / "sequence_00000.h5").read_bytes()
    said: list[str] = []
    assert generate.generate_dataset(JOB, out, resume=True, say=said.append).sequences == 2
    assert ["of another job: set aside as" in line for line in said] == [True, True]
    made = contents(out)
    assert made.pop("sequence_00000.h5.other") == foreign
    assert made.pop("sequence_00002.h5.other") == made["sequence_00001.h5"]
    assert made == contents(whole)


def test_sequences_without_a_record_are_not_taken_for_done(whole, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    (out / "synth.toml").unlink()
    (out / "sequence_00001.h5").write_bytes(b"rubbish")
    with pytest.raises(InputError, match=r"holds 'sequence_00000.h5', but no synth.toml"):
        generate.generate_dataset(JOB, out)
    assert (out / "sequence_00001.h5").read_bytes() == b"rubbish"
    assert generate.generate_dataset(JOB, out, resume=True).sequences == 1
    assert contents(out) == contents(whole)


def test_a_record_that_is_no_text_is_refused(whole, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    (out / "synth.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match="not UTF-8 text"):
        generate.generate_dataset(JOB, out, resume=True)
