"""Effects that users write: a Python file each, loaded only when the user names it."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
import sys
import traceback
import zlib
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import warp as wp

from dase.effects import EFFECTS, Effect, Makes, StreamEffect
from dase.errors import InputError, nearest
from dase.events import LABELS
from dase.files.text_files import read_text_file
from dase.kernels import pixel_codegen_model, pixel_compile, pixel_stages
from dase.scenes.video import VideoScene
from dase.simulation.sensor import Sensor
from dase.simulation.simulate import simulate

RESERVED_NAMES = ("name", "size", "log_eps", "history", "sensor")
"""Other entries of a sensor file; no effect can have such a name."""

STAGE_RETURNS = {
    "light": ("intensity",),
    "current": ("intensity",),
    "respond": ("voltage",),
    "threshold": ("on", "off"),
    "redraw": ("on", "off"),
    "drift": ("drift",),
    "noise": ("rate_on", "rate_off"),
    "gate": ("wait",),
    "delay": ("delay",),
}
"""What the function of a stage returns; those of the first three also return the effect's states."""


def known_effects(paths: Iterable[str | Path] = ()) -> dict[str, type[Effect]]:
    """Return the built-in effects and those of effect files.

    Args:
        paths: Files that the user named.

    Raises:
        InputError: As `load_effects`, or two files define an effect of one name.
    """
    effects = dict(EFFECTS)
    for path in paths:
        for name, effect in load_effects(path).items():
            if name in effects:
                raise InputError(
                    f"{path}: effect '{name}' is also defined in {_file_of_effect(effects[name])}"
                )
            effects[name] = effect
    return effects


def load_effects(path: str | Path) -> dict[str, type[Effect]]:
    """Run a Python file and return the effects it defines.

    Every effect is tried on a few pixels: it must compile, and switched off it must change no event.

    Args:
        path: File with subclasses of `Effect`.

    Returns:
        Name in sensor files to class, in the order of the file.

    Raises:
        InputError: Missing file, an error in it (with its line), or an effect that lacks something.
    """
    path = Path(path)
    return dict(_load_checked(path, _read_effect_file(path)))


@lru_cache(maxsize=64)
def _load_checked(path: Path, text: str) -> dict[str, type[Effect]]:
    module = _run_effect_file(path, text)
    classes = [c for c in vars(module).values() if isinstance(c, type) and issubclass(c, Effect)]
    own = [c for c in classes if c.__module__ == module.__name__]
    found: dict[str, type[Effect]] = {}
    for effect in own:
        if inspect.isabstract(effect) and "name" not in vars(effect):
            continue  # what several effects of the file have in common
        definition = _EffectDefinition(path, text, effect)
        definition.check()
        if effect.name in found and found[effect.name] is not effect:
            raise definition.wrong(f"the file defines effect '{effect.name}' twice")
        found[effect.name] = effect
    if not found:
        raise InputError(f"{path} defines no effect, that is no subclass of dase.Effect")
    return found


def _file_of_effect(effect: type[Effect]) -> str:
    return str(getattr(sys.modules[effect.__module__], "__file__", effect.__module__))


def _read_effect_file(path: Path) -> str:
    if not path.is_file():
        raise InputError(f"effect file {path} does not exist")
    return read_text_file(path, "effect file", 1 << 24)


def _run_effect_file(path: Path, text: str) -> ModuleType:
    # Warp keeps functions by module, so files of one stem, or one file before and after a change, must differ
    key = zlib.crc32(f"{path.resolve()}\n{text}".encode())
    name = f"dase_effects_{re.sub(r'[^0-9a-zA-Z]', '_', path.stem)}_{key:08x}"
    module = ModuleType(name)
    module.__file__ = str(path)
    try:
        code = compile(text, str(path), "exec")
    except (SyntaxError, ValueError) as error:
        line = getattr(error, "lineno", None) or 1
        raise InputError(f"{path}, line {line}: {getattr(error, 'msg', error)}") from error
    sys.modules[name] = module  # dataclasses looks its class's module up
    try:
        exec(code, module.__dict__)
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename == str(path)]
        reason = " ".join(str(error).split())
        kind = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
        raise InputError(f"{path}, line {lines[-1] if lines else 1}: {kind}{reason}") from error
    return module


class _EffectDefinition:
    """An effect as it stands in a file, with the checks it has to pass."""

    def __init__(self, path: Path, text: str, effect: type[Effect]):
        self.path, self.effect = path, effect
        nodes = (n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.ClassDef))
        self.node = next((n for n in nodes if n.name == effect.__name__), None)

    def wrong(self, what: str, line: int | None = None) -> InputError:
        """Return the error that says what is wrong, and where."""
        line = line or (self.node.lineno if self.node else 1)
        return InputError(f"{self.path}, line {line}: {what}")

    def check(self) -> None:
        """Raise InputError unless this is an effect that can be composed, fitted and switched off."""
        self.check_class()
        self.check_signatures()
        self.check_screen_limits()
        self.check_name()
        self.check_fields()
        self.check_values()
        self.check_stages()
        self.try_out()

    def check_class(self) -> None:
        """Check what a class needs beside its fields."""
        what = f"effect class '{self.effect.__name__}'"
        if "__dataclass_params__" not in vars(self.effect):
            raise self.wrong(f"{what} needs the decorator @dataclass(frozen=True, kw_only=True)")
        for name in ("name", "source", "stages"):
            if not hasattr(self.effect, name):
                raise self.wrong(f"{what} lacks '{name}: ClassVar = ...'")
        if self.node is None or not ast.get_docstring(self.node):
            raise self.wrong(f"{what} lacks a docstring, which `dase effects show` prints")
        if not isinstance(self.effect.source, str) or not self.effect.source:
            raise self.wrong(f"{what}: source must be a text that says where the physics is from")
        if inspect.isabstract(self.effect):
            lacking = ", ".join(sorted(getattr(self.effect, "__abstractmethods__", ())))
            raise self.wrong(f"{what} lacks the method {lacking}")
        if self.effect.label not in LABELS:
            raise self.wrong(f"{what}: label must be one of {', '.join(LABELS)}, got {self.effect.label!r}")

    def check_signatures(self) -> None:
        """Check what the effect says of the signatures that it makes; each checks itself when it is made."""
        said = self.effect.signatures
        if said is None:
            return
        if not isinstance(said, tuple) or not all(isinstance(one, Makes) for one in said):
            what = f"effect class '{self.effect.__name__}': signatures"
            raise self.wrong(f'{what} must be a tuple such as (Makes("hot pixels"),), got {said!r}')
        names = [one.signature for one in said]
        if len(set(names)) != len(names):
            raise self.wrong(f"effect class '{self.effect.__name__}' says twice that it makes a signature")

    def check_screen_limits(self) -> None:
        """Check what the effect says of what a screen cannot tell."""
        said, known = self.effect.screen_limits, {"", *(p.name for p in self.effect.parameters())}
        if not isinstance(said, Mapping) or not said.keys() <= known:
            what = f"effect class '{self.effect.__name__}': screen_limits"
            raise self.wrong(f'{what} must map parameters, or "" for all of it, to texts, got {said!r}')
        for text in said.values():
            try:
                text.format(refresh=60.0, highest_cutoff=15.0)
            except (AttributeError, IndexError, KeyError, ValueError) as error:
                what = "screen_limits: only {refresh:g} and {highest_cutoff:g} can stand in braces"
                raise self.wrong(f"{what}, got {text!r}") from error

    def check_name(self) -> None:
        """Check the name, which stands in sensor files and in the text of the kernel."""
        name = self.effect.name
        if not isinstance(name, str) or not re.fullmatch(r"[a-z][a-z0-9_]*", name):
            raise self.wrong(f"name must be lower-case letters, digits and _, got {name!r}")
        if name in EFFECTS:
            raise self.wrong(f"effect '{name}' is built in; choose another name")
        if name in RESERVED_NAMES:
            raise self.wrong(f"'{name}' means something else in sensor files; choose another name")

    def check_fields(self) -> None:
        """Check that all fields are parameters or choices under names that are free."""
        effect = self.effect
        known = [p.name for p in effect.parameters()] + list(effect.choices())
        for f in dataclasses.fields(effect):
            if f.name not in known:
                raise self.wrong(f"{effect.name}.{f.name} must be made by parameter(...) or choice(...)")
        taken = {q for qs in pixel_stages.QUANTITIES.values() for q in qs}
        taken |= {*pixel_stages.ANYWHERE, *pixel_stages.LENT}
        if "noise" in effect.stages:
            # what the composed kernel itself keeps for an effect with noise events
            taken |= {"hazard", "rest", "events", "spend", "left"}
        for name in (*known, *effect.states):
            if name in taken or pixel_codegen_model.random_number(name):
                raise self.wrong(f"{effect.name}.{name}: the name is one of dase's own; choose another")
        if len({*known, *effect.states}) != len(known) + len(effect.states):
            raise self.wrong(f"effect '{effect.name}': parameters and states must have names of their own")

    def check_values(self) -> None:
        """Check defaults, ranges and values that switch the effect off."""
        effect = self.effect
        if not any(p.off is not None for p in effect.parameters()):
            raise self.wrong(f"effect '{effect.name}' needs a parameter with off=..., which switches it off")
        for p in effect.parameters():
            (low, high), (least, most) = p.plausible, p.bounds
            if not (least <= low < high <= most and np.isfinite([low, high]).all()):
                raise self.wrong(
                    f"{effect.name}.{p.name}: plausible must be a range within the bounds "
                    f"[{least:g}, {most:g}], got ({low:g}, {high:g})"
                )
        try:
            effect(), effect.identity()
        except Exception as error:
            raise self.wrong(str(error)) from error

    def check_stages(self) -> None:
        """Check that all stage functions are Warp's and ask for what there is."""
        effect = self.effect
        if not isinstance(effect.stages, Mapping) or not (effect.stages or issubclass(effect, StreamEffect)):
            raise self.wrong(f"effect '{effect.name}': stages must map a stage to a Warp function")
        for stage, function in effect.stages.items():
            if stage not in pixel_stages.STAGES:
                raise self.wrong(f"there is no stage '{stage}': {nearest(stage, pixel_stages.STAGES)}")
            if not isinstance(function, wp.Function):
                raise self.wrong(f"the function of stage '{stage}' needs the decorator @wp.func")
            line = self.line_of(function)
            arguments = inspect.signature(function.func).parameters
            if stage == "threshold" and {"t", "dt", "t64"} & set(arguments):
                raise self.wrong("stage 'threshold' comes once per pixel and has no time", line)
            alone = dataclasses.replace(effect().compiled(), functions=((stage, function),))
            try:
                pixel_compile.source_text((alone,), "frames", "keys")
            except ValueError as error:
                raise self.wrong(str(error), line) from error

    def line_of(self, function: Any) -> int | None:
        """Return the line of the file at which a function stands; None where it is from another file."""
        code = function.func.__code__
        return int(code.co_firstlineno) if code.co_filename == str(self.path) else None

    def try_out(self) -> None:
        """Simulate a few pixels: with the effect as it comes, and switched off as if it were not there."""
        light = np.random.default_rng(0).random((40, 4, 4), np.float32)
        scene, plain = VideoScene(light, np.arange(40) * 1e-3), Sensor()
        try:
            simulate(scene, plain.with_effect(self.effect()))
            off = simulate(scene, plain.with_effect(self.effect.identity()))
        except Exception as error:
            raise self.uncompiled(error) from error
        without = simulate(scene, plain)
        same = (np.array_equal(getattr(off, name), getattr(without, name)) for name in "txyp")
        if not all(same):
            off_at = ", ".join(f"{p.name} = {p.off:g}" for p in self.effect.parameters() if p.off is not None)
            raise self.wrong(f"effect '{self.effect.name}' still changes events when off ({off_at})")

    def uncompiled(self, error: Exception) -> InputError:
        """Return the error that says where Warp could not compile the effect, and why."""
        said = str(error.args[0]) if error.args else str(error)
        places = re.findall(rf"at {re.escape(str(self.path))}:(\d+)", said)
        reason = " ".join(said.split(";")[-1].split()) or type(error).__name__
        if places:
            return self.wrong(reason, int(places[-1]))
        stage = next((s for s in self.effect.stages if f"{s}_of_{self.effect.name}(" in said), None)
        if stage is not None:  # the function itself compiles, what calls it does not
            returns = (
                *STAGE_RETURNS[stage],
                *(self.effect.states if stage in ("light", "current", "respond") else ()),
            )
            what = f"the function of stage '{stage}' must return {', '.join(returns)}, each a float"
            return self.wrong(what, self.line_of(self.effect.stages[stage]))
        return self.wrong(f"effect '{self.effect.name}' does not run: {reason}")
