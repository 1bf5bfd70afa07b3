"""The file that `dase effects new` writes: an effect that works as it is, to fill in."""

from __future__ import annotations

import keyword
import re
import shlex
from pathlib import Path

from dase.effects import EFFECTS
from dase.errors import InputError
from dase.io import replacing
from dase.kernels import pixel_stages
from dase.simulation.user_effects import RESERVED_NAMES, STAGE_RETURNS

STAGE_MEANINGS = {
    "light": "what reaches the photodiode; 1 is white",
    "current": "what flows in the photodiode, as the light that makes as much",
    "respond": "voltage of the photoreceptor [log intensity]",
    "threshold": "thresholds of a pixel, once and for all [log intensity]",
    "redraw": "thresholds of a pixel, anew after each event [log intensity]",
    "drift": "speed at which the pixel's memory drifts towards ON events [log intensity/s]",
    "noise": "rates of events that no change of light makes [Hz]",
    "gate": "how long the pixel stays dead now [s]; age is the time since its last event [s]",
    "delay": "time until an event leaves the pixel [s]; polarity is 1 for ON, 0 for OFF",
}
"""Stage to what its function returns."""

FILE_TEMPLATE = '''\
"""An effect of your own. It works as it is: fill in your physics and try it again.

{commands}
"""

from dataclasses import dataclass
from typing import ClassVar

import warp as wp

from dase.effects import Effect, parameter

# A function for each stage at which the effect acts. It becomes part of the kernel that simulates a pixel,
# so it is restricted Python: numbers, if, for, wp.exp, wp.log, wp.sqrt, wp.sin, wp.min, wp.clamp, ...
# (https://nvidia.github.io/warp). Write numbers as 1.0, not 1.
#
# Its arguments are resolved by name. It may ask for
#     the parameters and states of the effect
#     x, y            place of the pixel [px]; radius: 0 in the middle of the sensor, 1 at its corner
#     t, dt           time and time since the last sample [s]; not in stage threshold. At the first sample
#                     dt is 1e30, so that filters begin settled
#     nominal_on, nominal_off    thresholds before any effect [log intensity]
#     uniform, normal            random numbers, new at every sample (uniform_2, ... for more of them)
#     pixel_uniform, pixel_normal    random numbers that each pixel keeps
# and for what its stage has:
{stages}


@wp.func
def light(intensity: float, strength: float):
    """Return what the photodiode makes of the light; here it saturates."""
    return intensity / (1.0 + strength * intensity)


@dataclass(frozen=True, kw_only=True)
class {cls}(Effect):
    """One line that says what happens, such as: bright light saturates the photodiode.

    Then the physics, in plain words: where it comes from, when it shows, what it depends on. Contrasts in the
    bright parts of a scene shrink and make fewer events; the dark parts stay as they are.
    """

    name: ClassVar[str] = "{name}"
    source: ClassVar[str] = "Authors: Title, year; or your own measurement"
    stages: ClassVar = {{"light": light}}
    # What a pixel remembers from sample to sample, all zero at the start. Functions of the stages light and
    # respond get the states as arguments and return their new values behind their own, such as
    # `return intensity, level`.
    states: ClassVar = ()
    # Which signatures it makes in recorded events, where you know all of them, such as
    # `signatures: ClassVar = (Makes("hot pixels", tells=True),)`; see `dase.effects.Makes`.

    strength: float = parameter(
        0.5,  # what `dase add` writes
        unit="1",  # SI; "1" is a ratio
        off=0.0,  # the value at which the effect changes no event at all
        bounds=(0.0, 100.0),  # values outside are refused
        plausible=(0.05, 5.0),  # where `dase diagnose` looks
        about="white light gives 1 / (1 + strength) of the photocurrent it would give without saturation",
        # where a fit begins and what it may change: starts=, fitted=, ..., see `dase.effects.Parameter`
    )
'''


def new_effect(name: str, path: Path) -> None:
    """Write the file of a new effect.

    Args:
        name: In sensor files and on the command line.
        path: Python file that does not exist yet.

    Raises:
        InputError: The name cannot be used, or the file exists.
    """
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name) or keyword.iskeyword(name):
        raise InputError(f"the name of an effect must be lower-case letters, digits and _, got '{name}'")
    if name in EFFECTS:
        raise InputError(f"effect '{name}' is built in (`dase effects show {name}`); choose another name")
    if name in RESERVED_NAMES:
        raise InputError(f"'{name}' means something else in sensor files; choose another name")
    if path.suffix != ".py":
        raise InputError(f"output must end with .py, got '{path}'")
    if path.exists():
        raise InputError(f"{path} exists and is not overwritten; choose another name")
    with replacing(path) as temporary:
        temporary.write_text(effect_file_text(name, path.name), "utf-8")


def effect_file_text(name: str, file: str) -> str:
    """Return the text of the file of a new effect; `file` is what the commands in it call the file."""
    wide = max(map(len, pixel_stages.STAGES))
    stages = []
    for stage in pixel_stages.STAGES:
        returns = ", ".join(STAGE_RETURNS[stage])
        stages.append(
            f"#     {stage:{wide}}  asks {', '.join(pixel_stages.QUANTITIES[stage])}; returns {returns}:"
        )
        stages.append(f"#     {'':{wide}}  {STAGE_MEANINGS[stage]}")
    cls = "".join(part.capitalize() for part in name.split("_")) or name
    lines = "\n".join(f"    {line}" for line in trial_commands(name, file))
    return FILE_TEMPLATE.format(name=name, cls=cls, stages="\n".join(stages), commands=lines)


def trial_commands(name: str, file: str) -> list[str]:
    """Return the commands that try an effect out, in this order."""
    quoted = shlex.quote(file)
    return [
        f"dase effects show {name} --effects {quoted}",
        f"dase add davis346 {name} --effects {quoted} -o with_{name}.toml",
        f"dase synth out_{name} --sensor with_{name}.toml --effects {quoted} --sequences 1 --duration 0.5",
        f"dase show out_{name}/sequence_00000.h5",
    ]
