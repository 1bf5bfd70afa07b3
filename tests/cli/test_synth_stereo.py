"""`dase synth --stereo`: files of both cameras, the truth beside them, and the same bytes however made."""

from __future__ import annotations

import numpy as np
from click.testing import CliRunner

from dase import io
from dase.cli.synth import synth_command

OPTIONS = [
    "--sequences",
    "2",
    "--size",
    "48x32",
    "--duration",
    "0.1",
    "--regime",
    "slow",
    "--frame-rate",
    "20",
]
OPTIONS += ["--sensor", "ideal", "--stereo", "0.1", "--focal", "100", "--depths", "1", "4"]


def make(out, *more: str) -> dict[str, bytes]:
    """Run the command and return what it wrote."""
    done = CliRunner().invoke(synth_command, [str(out), *OPTIONS, *more], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return {path.name: path.read_bytes() for path in out.iterdir() if path.suffix in (".h5", ".npz", ".toml")}


def test_pairs_and_their_truth_are_the_same_bytes(tmp_path):
    whole = make(tmp_path / "a", "--jobs", "1")
    assert len(whole) == 9
    assert make(tmp_path / "b", "--jobs", "2") == whole
    left, right = (io.read(tmp_path / "a" / f"sequence_00000_{name}.h5") for name in ("left", "right"))
    assert 'camera = "right"' in right.configuration
    with np.load(tmp_path / "a" / "sequence_00000_left_truth.npz") as truth:
        np.testing.assert_allclose(truth["times"], left.frame_times, atol=1e-6)
        np.testing.assert_allclose(truth["disparity"] * truth["depth"], 0.1 * 100, rtol=1e-5)
        assert truth["depth"].min() >= 1 - 1e-6
        assert truth["depth"].max() <= 4 + 1e-6
        disparity = truth["disparity"]
    # each pixel of the left is found by its disparity in the right, but where something hides it
    rows, columns = np.mgrid[:32, :48]
    at = columns - np.rint(disparity[0]).astype(int)
    moved = right.frames[0][rows, at.clip(0)].astype(int)
    seen = at >= 0
    there = np.median(np.abs(moved - left.frames[0])[seen])
    assert there < 0.7 * np.median(np.abs(right.frames[0].astype(int) - left.frames[0])[seen])
    # what an interrupted run lacks, or what is damaged, is made again
    (tmp_path / "a" / "sequence_00001_right.h5").unlink()
    (tmp_path / "a" / "sequence_00000_left_truth.npz").write_bytes(b"rubbish")
    assert make(tmp_path / "a", "--resume", "--jobs", "1") == whole
    # one that lacks nothing, killed when all was written, has nothing to do
    for jobs in ("1", "2"):
        assert make(tmp_path / "a", "--resume", "--jobs", jobs) == whole
