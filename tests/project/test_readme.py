"""The examples of the README, word for word."""

from __future__ import annotations

import ast
import inspect
import re
import shlex
import subprocess
from pathlib import Path

import dase
from dase.effects import EFFECTS
from dase.simulation.sensor_file import parse_sensor

README = (Path(__file__).parents[2] / "README.md").read_text("utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


def test_python():
    (code,) = (block for block in blocks("python") if "voxel" in block.lower())
    scope: dict = {}
    exec(compile(code, "README.md", "exec"), scope)
    assert len(scope["events"]) > 1000
    assert scope["counts"].shape == (1, 2, 2, 346 * 260)
    before = dase.simulate(scope["scene"], scope["sensor"].without("readout").without("timestamp"), seed=1)
    # an event in the first nanosecond of a window may count for the one before
    assert abs(int(scope["counts"].sum()) - len(before)) <= 2
    assert 0.5 * len(before) < len(scope["events"]) <= len(before)  # what finds the bus busy may be lost
    assert scope["grid"].shape == (5, 260, 346)


def test_the_calls_on_a_recording_fit_their_functions():
    """Without running them: they would take minutes."""
    (code,) = (block for block in blocks("python") if "open_recording" in block)
    calls = [node for node in ast.walk(ast.parse(code)) if isinstance(node, ast.Call)]
    assert {ast.unparse(call.func) for call in calls} == {
        f"dase.{name}" for name in ("open_recording", "compare", "fit", "diagnose")
    }
    for call in calls:
        function = getattr(dase, ast.unparse(call.func).removeprefix("dase."))
        inspect.signature(function).bind(*call.args, **{k.arg: k.value for k in call.keywords if k.arg})


def test_sensor():
    (text,) = blocks("toml")
    assert parse_sensor(text, "README").size == (346, 260)


def test_commands_and_their_options_exist():
    import click

    from dase.cli import dase_group

    context = click.Context(dase_group)
    for line in "\n".join(blocks("sh")).splitlines():
        words = shlex.split(line, comments=True)
        if not words or words[0] != "dase":
            continue
        command = dase_group.get_command(context, words[1])
        assert command is not None, line
        known = {name for p in command.params for name in (*p.opts, *p.secondary_opts)}
        assert {w for w in words[2:] if w.startswith("-")} <= known, line
    assert set(re.findall(r"dase effects show (\w+)", README)) <= set(EFFECTS)


def test_shell_blocks_are_shell():
    """What stands there to be copied must be read by a shell, with no <placeholders>."""
    for block in blocks("sh"):
        done = subprocess.run(["sh", "-n"], input=block, text=True, capture_output=True, check=False)
        assert done.returncode == 0, done.stderr
        code = [line.split("#")[0] for line in block.splitlines()]
        assert not any(re.search(r"<\w", line) for line in code)
