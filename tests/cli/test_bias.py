"""`dase bias` and `--bias`: sensors with other biases, in the same words."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path

import pytest
from click.testing import CliRunner
from helpers.command_line import SMALL, refusal

import dase
from dase import io
from dase.cli import dase_group

WORDS = ("ONBn=5/255:6/200", "OFFBn=4/1", "DiffBn=4/39")


def on_after(before: float) -> float:
    """Return the ON threshold by the law of logarithms."""
    diff = 48.437e-9 * 39 / 255
    return before * math.log(3.1e-6 * 200 / 255 / diff) / math.log(387.5e-9 / diff)


def run(*arguments: object) -> str:
    done = CliRunner().invoke(dase_group, list(map(str, arguments)))
    assert done.exit_code == 0, done.output
    return done.output


def test_a_sensor_file_keeps_its_comments(tmp_path: Path):
    file = tmp_path / "dull.toml"
    said = run("bias", "davis346", *WORDS, "-o", file)
    before, after = dase.load_sensor("davis346"), dase.load_sensor(file)
    assert after["threshold"].on == pytest.approx(on_after(before["threshold"].on))
    assert after.with_effect(before["threshold"]) == before
    assert said.count("→") == 1
    assert "threshold.on 0.3 →" in said
    assert after.history[-1].did == f"bias {' '.join(WORDS)}"
    text = file.read_text("utf-8")
    assert "# by biases (was 0.3: cradle: fitted" in text
    assert "# as on: 52 % of the events" in text


@pytest.mark.slow
def test_synth_takes_the_same_words(tmp_path: Path):
    given = [word for text in WORDS for word in ("--bias", text)]
    run("synth", tmp_path / "out", *SMALL, "--sensor", "davis346", *given)
    (made,) = (tmp_path / "out").glob("*.h5")
    assert dase.load_sensor("davis346")["threshold"].on == 0.3
    record = tomllib.loads((tmp_path / "out" / "synth.toml").read_text("utf-8"))
    assert record["sensor"]["threshold"]["on"] == pytest.approx(on_after(0.3))
    clip = ("synth", tmp_path / "clip.npz", "--video", made, "--sensor", "davis346")
    run(*clip)
    usual = len(io.read(tmp_path / "clip.npz").events)
    run(*clip, *given)
    assert len(io.read(tmp_path / "clip.npz").events) < usual


def test_without_a_sensor_it_says_what_is_known():
    said = run("bias")
    assert "ONBn, OFFBn, DiffBn: threshold.on, threshold.off" in said
    assert "PrBp, PrSFBp: nothing" in said


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("bias", "davis346"), "which bias?"),
        (("bias", "davis346", "ONBn"), "is not of the form NAME=BEFORE:AFTER"),
        (("bias", "davis346", "ONBn=5/255:+20%"), "give DiffBn"),
        (("bias", "imx636", "bias_fo=+20%"), "no law of it is published; it sets bandwidth.cutoff"),
        (("bias", "ideal", "RefrBp=+20%"), "has no 'refractory'"),
        (("synth", "{out}", *SMALL, "--bias", "RefrB=+20%"), "did you mean 'RefrBp'?"),
    ],
)
def test_what_has_no_law_is_refused(arguments, message, tmp_path: Path):
    out = tmp_path / "out"
    assert message in refusal(*(str(a).format(out=out) for a in arguments))
    assert not out.exists()
