"""Effects that users write, from their file to the kernel."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from helpers.command_line import SMALL, dase, dase_here, refusal

from dase import InputError, Sensor, VideoScene, io, load_sensor, simulate
from dase.effects import EFFECTS
from dase.effects.threshold import Threshold
from dase.simulation.effect_template import new_effect
from dase.simulation.user_effects import known_effects, load_effects

FILE = '''\
from dataclasses import dataclass
from typing import ClassVar

import warp as wp

from dase.effects import Effect, Makes, parameter


@wp.func
def respond(voltage: float, strength: float):
    return voltage * (1.0 - strength)


@dataclass(frozen=True, kw_only=True)
class Weaker(Effect):
    """Smaller signals."""

    name: ClassVar[str] = "weaker"
    source: ClassVar[str] = "nobody"
    stages: ClassVar = {"respond": respond}

    strength: float = parameter(0.5, unit="1", off=0.0, plausible=(0.1, 0.9), about="of it")
'''


def line_of(text: str, part: str) -> int:
    return text[: text.index(part)].count("\n") + 1


@pytest.fixture
def scene(rng) -> VideoScene:
    return VideoScene(rng.random((60, 8, 8)), np.arange(60) * 1e-3)


def written(folder: Path, text: str, name: str = "mine.py") -> Path:
    folder.mkdir(exist_ok=True)
    path = folder / name
    path.write_text(text)
    return path


def test_composes_into_the_kernel(tmp_path, scene):
    (effect,) = load_effects(written(tmp_path, FILE)).values()
    # half the signal at half the threshold makes the same events
    half, whole = (Sensor().with_effect(Threshold(on=on, off=on)) for on in (0.1, 0.2))
    got, want = simulate(scene, half.with_effect(effect(strength=0.5))), simulate(scene, whole)
    assert len(want) > 1000
    np.testing.assert_array_equal(got.p, want.p)
    np.testing.assert_allclose(got.t, want.t, atol=2e-9)


def test_two_files_of_one_name_and_one_function_name(tmp_path, scene):
    a = written(tmp_path / "a", FILE)
    b = written(
        tmp_path / "b", FILE.replace("(1.0 - strength)", "(1.0 + strength)").replace("weaker", "more")
    )
    known = known_effects([a, b])
    assert set(known) - set(EFFECTS) == {"weaker", "more"}
    plain = Sensor()
    less, more = known["weaker"](strength=0.5), known["more"](strength=1.0)
    alone = [len(simulate(scene, plain.with_effect(e))) for e in (less, more)]
    assert alone[0] < len(simulate(scene, plain)) < alone[1]
    both = simulate(scene, plain.with_effect(less).with_effect(more))
    np.testing.assert_array_equal(both.t, simulate(scene, plain).t)  # 0.5 · 2 = 1


def test_a_changed_file_is_another_effect(tmp_path, scene):
    path = written(tmp_path, FILE)
    before = simulate(scene, Sensor().with_effect(load_effects(path)["weaker"]()))
    assert load_effects(path)["weaker"] is load_effects(path)["weaker"]
    written(tmp_path, FILE.replace("- strength", "+ strength"))
    after = simulate(scene, Sensor().with_effect(load_effects(path)["weaker"]()))
    assert len(after) > 1.5 * len(before)


def test_leaves_nothing_beside_the_file(tmp_path):
    load_effects(written(tmp_path, FILE))
    assert [p.name for p in tmp_path.iterdir()] == ["mine.py"]


WRONG = [
    ("return voltage * (1.0 - strength)", "return voltage * * 2", "invalid syntax", "return"),
    ("import warp as wp", "import warp as wp\n1 / 0", "ZeroDivisionError: division by zero", "1 / 0"),
    (
        'off=0.0, plausible=(0.1, 0.9), about="of it"',
        "off=0.0",
        "'about' and 'plausible'",
        "strength: float =",
    ),
    ("voltage: float, s", "voltage: float, colour: float, s", "no quantity 'colour'", "@wp.func"),
    ("return voltage * (1.0 - strength)", "return voltage * missing", "undefined symbol: missing", "return"),
    ("(1.0 - strength)", "(1 - strength)", "must be the same", "return"),
    ("return voltage * (1.0 - strength)", "return voltage, 1.0", "must return voltage, each", "@wp.func"),
    ("@wp.func", "", "needs the decorator @wp.func", "class Weaker"),
    ("@dataclass(frozen=True, kw_only=True)", "", "needs the decorator @dataclass", "class Weaker"),
    ('    name: ClassVar[str] = "weaker"\n', "", "lacks 'name", "class Weaker"),
    ('    source: ClassVar[str] = "nobody"\n', "", "lacks 'source", "class Weaker"),
    ('    stages: ClassVar = {"respond": respond}\n', "", "lacks 'stages", "class Weaker"),
    ('    """Smaller signals."""\n', "", "lacks a docstring", "class Weaker"),
    ('"weaker"', '"leak"', "'leak' is built in", "class Weaker"),
    ('"weaker"', '"size"', "means something else", "class Weaker"),
    ('"weaker"', '"Weaker!"', "got 'Weaker!'", "class Weaker"),
    ('{"respond"', '{"responds"', "did you mean 'respond'?", "class Weaker"),
    ("off=0.0, ", "", "needs a parameter with off=", "class Weaker"),
    ("off=0.0, ", "off=-1.0, ", "must lie in [0, inf] 1, got -1", "class Weaker"),
    ("(0.1, 0.9)", "(0.9, 0.1)", "plausible must be a range", "class Weaker"),
    ("parameter(0.5", "parameter(-0.5", "must lie in [0, inf] 1, got -0.5", "class Weaker"),
    ("(1.0 - strength)", "(0.5 - strength)", "still changes events when off (strength = 0)", "class Weaker"),
    (
        "    strength: float =",
        "    other: float = 1.0\n    strength: float =",
        "other must be made by",
        "class Weaker",
    ),
    ("strength", "intensity", "one of dase's own", "class Weaker"),
    (
        '    source: ClassVar[str] = "nobody"\n',
        '    source: ClassVar[str] = "nobody"\n    signatures: ClassVar = ("hot pixels",)\n',
        "must be a tuple such as (Makes(",
        "class Weaker",
    ),
    (
        '    source: ClassVar[str] = "nobody"\n',
        '    source: ClassVar[str] = "nobody"\n    signatures: ClassVar = (Makes("grouping"),) * 2\n',
        "says twice that it makes a signature",
        "class Weaker",
    ),
    (
        '    source: ClassVar[str] = "nobody"\n',
        '    source: ClassVar[str] = "nobody"\n    screen_limits: ClassVar = {"power": "wants an LED"}\n',
        "screen_limits must map parameters",
        "class Weaker",
    ),
    (
        '    source: ClassVar[str] = "nobody"\n',
        '    source: ClassVar[str] = "nobody"\n    screen_limits: ClassVar = {"strength": "{rate} Hz"}\n',
        "can stand in braces, got '{rate} Hz'",
        "class Weaker",
    ),
    (
        '    source: ClassVar[str] = "nobody"\n',
        '    source: ClassVar[str] = "nobody"\n    signatures: ClassVar = (Makes("hot pixel"),)\n',
        "did you mean 'hot pixels'?",
        "    signatures: ClassVar",
    ),
]


@pytest.mark.parametrize(("old", "new", "message", "place"), WRONG, ids=[case[2] for case in WRONG])
def test_wrong_file(old, new, message, place, tmp_path):
    assert old in FILE
    text = FILE.replace(old, new)
    path = written(tmp_path, text)
    with pytest.raises(InputError) as caught:
        load_effects(path)
    said = str(caught.value)
    assert "\n" not in said
    assert message in said
    assert said.startswith(f"{path}, line {line_of(text, place)}: ")


def test_wrong_path(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        load_effects(tmp_path / "none.py")
    with pytest.raises(InputError, match="defines no effect"):
        load_effects(written(tmp_path, "from dase.effects.leak import Leak\n"))
    with pytest.raises(InputError, match="line 1: SystemExit: 3"):
        load_effects(written(tmp_path, "raise SystemExit(3)\n"))
    (tmp_path / "odd.py").write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match="not UTF-8"):
        load_effects(tmp_path / "odd.py")
    again = [written(tmp_path / name, FILE) for name in "ab"]
    with pytest.raises(InputError, match=r"b.mine.py: effect 'weaker' is also defined in .*a.mine.py"):
        known_effects(again)


def test_new_effect_works_as_it_is(tmp_path, scene):
    path = tmp_path / "my own.py"
    new_effect("afterglow", path)
    (effect,) = load_effects(path).values()
    plain = Sensor()
    without = simulate(scene, plain)
    off = simulate(scene, plain.with_effect(effect.identity()))
    for name in "txyp":
        np.testing.assert_array_equal(getattr(off, name), getattr(without, name))
    on = simulate(scene, plain.with_effect(effect()))
    assert len(on) < 0.98 * len(without)
    assert max(map(len, path.read_text().splitlines())) <= 110
    assert "--effects '" in path.read_text()  # the space in its name is quoted


@pytest.mark.parametrize(
    ("name", "file", "message"),
    [
        ("leak", "x.py", "built in"),
        ("Mine", "x.py", "lower-case"),
        ("a-b", "x.py", "lower-case"),
        ("while", "x.py", "lower-case"),
        ("history", "x.py", "means something else"),
        ("mine", "x.txt", "must end with .py"),
        ("mine", "there.py", "not overwritten"),
        ("mine", "no/x.py", "does not exist"),
    ],
)
def test_new_effect_refuses(name, file, message, tmp_path):
    (tmp_path / "there.py").write_text("mine")
    with pytest.raises(InputError, match=message):
        new_effect(name, tmp_path / file)
    assert (tmp_path / "there.py").read_text() == "mine"
    assert [p.name for p in tmp_path.iterdir()] == ["there.py"]


@pytest.mark.slow
def test_commands(tmp_path):
    """What `dase effects new` says to try works, in worker processes too."""
    written_by = dase_here("effects", "new", "afterglow", cwd=tmp_path)
    assert written_by.returncode == 0, written_by.stderr
    assert "afterglow.py written" in written_by.stdout
    shown = dase_here("effects", "show", "afterglow", "--effects", "afterglow.py", cwd=tmp_path)
    assert "strength = 0.5" in shown.stdout
    assert "(--effects)" in refusal("effects", "show", "afterglow", cwd=tmp_path)
    listed = dase_here("effects", "list", "--effects", "afterglow.py", cwd=tmp_path)
    assert listed.stdout.splitlines()[-1].startswith("afterglow")

    sensor = tmp_path / "mine.toml"
    sensor.write_text("[threshold]\n[afterglow]\nstrength = 3.0\n")
    with pytest.raises(InputError, match=re.escape("(your own needs its file)")):
        load_sensor(sensor)
    assert "(--effects)" in refusal("synth", "out", *SMALL, "--sensor", sensor, cwd=tmp_path)
    small = (
        *SMALL[:4],
        "--regime",
        "slow",
        "--sequences",
        2,
        "--sensor",
        sensor,
        "--effects",
        "afterglow.py",
    )
    for jobs in (1, 2):
        done = dase("synth", f"out{jobs}", *small, "--jobs", jobs, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    one, two = (tmp_path / f"out{jobs}" / "sequence_00001.h5" for jobs in (1, 2))
    assert one.read_bytes() == two.read_bytes()
    told = io.read(one).configuration
    assert re.search(r"afterglow\.py sha256:[0-9a-f]{64}", told)
    assert "strength = 3.0" in told
