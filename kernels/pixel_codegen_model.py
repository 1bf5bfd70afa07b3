"""What the statements of a kernel are made from: a sensor's stage functions, its source and its sink."""

from __future__ import annotations

import inspect
import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import warp as wp

from dase.kernels.pixel_codegen import Draw, Statement
from dase.kernels.pixel_stages import (
    ANYWHERE,
    CORE,
    LENT,
    QUANTITIES,
    SINKS,
    EffectStages,
    SampleClock,
    array_element,
    deposit_event,
    hold_event,
    keep_held,
    leaving_time,
    states,
    stored_sample,
)
from dase.kernels.random import normal, stream_key, uniform, unit_exponential
from dase.kernels.scene_layers import (
    BackgroundGeometry,
    background_at,
    background_geometry,
    layer_intensity,
    layers_near,
)
from dase.kernels.threshold_counts import SOURCES
from dase.kernels.vector_math import exponential, lane_functions, whole_quotient


@dataclass(frozen=True)
class Call:
    """The call of a stage function, its arguments resolved by name.

    Args:
        text: Of the expression.
        draws: Random numbers among the arguments.
    """

    text: str
    draws: tuple[Draw, ...]


def call_name(stage: str, effect: EffectStages) -> str:
    """Return what a stage function is called in a kernel; no parameter is called so."""
    return f"{stage}_of_{effect.name}"


def call_stage(stage: str, effect: EffectStages, function: Any, lent: Collection[str] = ()) -> Call:
    """Return the call of a stage function.

    Args:
        stage: At which it is called.
        effect: Whose function it is.
        function: Of Warp.
        lent: What other effects lend, of `LENT`.

    Raises:
        ValueError: It asks for a quantity that the stage does not have.
    """
    # a Warp function keeps the Python function it was made from, whose names are all that is asked for
    names = inspect.signature(function.func).parameters
    arguments = [_argument(stage, effect, name, lent) for name in names]
    text = f"{call_name(stage, effect)}({', '.join(argument.text for argument in arguments)})"
    return Call(text, tuple(draw for argument in arguments for draw in argument.draws))


def random_number(name: str) -> re.Match[str] | None:
    """Return the parts of a name that asks for a random number, `pixel_` or None and the kind, else None."""
    # the digit is for functions that want several independent numbers of one kind
    return re.fullmatch(r"(pixel_)?(uniform|normal)(_\d)?", name)


def _argument(stage: str, effect: EffectStages, name: str, lent: Collection[str]) -> Call:
    """Return what a stage function gets for an argument of this name."""
    # an effect's own names first: it may call a parameter like a quantity
    if name in (*effect.parameters, *effect.states, *effect.maps):
        return Call(f"{effect.name}_{name}", ())
    # whole numbers in the kernel, but stage functions reckon with them
    if name in ("x", "y"):
        return Call(f"float({name})", ())
    if name in (*QUANTITIES[stage], *ANYWHERE):
        return Call(name, ())
    # without a lender the argument is there all the same: a function has one signature in all sensors
    if name in LENT:
        return Call(name if name in lent else "0.0", ())
    number = random_number(name)
    if number:
        per_pixel, kind = number.group(1) is not None, number.group(2)
        # named after effect, stage and argument: other effects do not change the numbers of this one
        draw = Draw(f"{effect.name}_{stage}_{name}", kind, effect, per_pixel)
        # thresholds are drawn anew after each event, of which a sample may have several
        index = "int(redraws)" if stage == "redraw" else "sample"
        return Call(draw.name if per_pixel else f"{kind}({draw.key}, {index})", (draw,))
    quantities = *effect.parameters, *effect.states, *effect.maps, *QUANTITIES[stage]
    known = *quantities, *ANYWHERE, *LENT, "normal", "uniform"
    # a misspelt argument of a user's effect ends here
    raise ValueError(
        f"effect '{effect.name}': stage '{stage}' has no quantity '{name}'; there are {', '.join(known)}"
    )


@dataclass(frozen=True)
class Outlet:
    """Where time comes from and where events go.

    Args:
        instant: Expression of the time at which an event leaves, `{late}` after `{share}` of the step.
        emit: Statement that keeps an event, of `{time}` and `{code}`.
        emitted: What follows after an event has been kept and the pixel has taken note of it.
        resumes: Whether pixels go on where the chunk before has ended.
        presets_noise: Whether what a noise spends must have a value although its effect may be off. Lanes
            need none: their vectors begin at 0.
    """

    instant: str = "leaving_time(clock, k, {share}, {late})"
    emit: str = "deposit(sink, row, i, size, {time}, {code})"
    emitted: tuple[Statement, ...] = ()
    resumes: bool = True
    presets_noise: bool = False


@dataclass(frozen=True)
class PixelModel:
    """All that the statements of a pixel are made from.

    Args:
        stages: Effects, in order.
        source: One of `dase.kernels.threshold_counts.SOURCES`.
        sink: One of `dase.kernels.pixel_stages.SINKS`.
        outlet: Where events go.
    """

    stages: tuple[EffectStages, ...]
    source: str
    sink: str
    outlet: Outlet = Outlet()

    # asked for at every other statement, hence kept
    @cached_property
    def states(self) -> list[str]:
        """Names of what a pixel remembers, in the order of the state array."""
        return states(self.stages, self.sink)

    @cached_property
    def parameters(self) -> list[str]:
        """Names in the order of the parameter vector."""
        # with the effect's name before it, as several effects may have a `rate`
        own = [f"{effect.name}_{name}" for effect in self.stages for name in effect.parameters]
        return [*CORE, *own]

    @cached_property
    def maps(self) -> list[str]:
        """Names of quantities that are handed over for each pixel, in the order of the array of maps."""
        return [f"{effect.name}_{name}" for effect in self.stages for name in effect.maps]

    @cached_property
    def lent(self) -> list[str]:
        """Names of parameters that functions of other effects may ask for."""
        return [f"{effect.name}_{name}" for effect in self.stages for name in effect.lends]

    @property
    def labelled(self) -> bool:
        """Whether events say what they came from, and a pixel remembers what the leak has done."""
        return "drained" in self.states

    @property
    def delays(self) -> bool:
        """Whether events that a gate holds back come later."""
        return any(effect.delays for effect, _ in self.of("gate")) and not self.resets

    @property
    def resets(self) -> bool:
        """Whether a pixel memorises the signal when its dead time ends."""
        return any(effect.resets for effect, _ in self.of("gate"))

    @property
    def spares_noise(self) -> bool:
        """Whether noise passes a gate, and begins no dead time."""
        return any(effect.spares_noise for effect, _ in self.of("gate"))

    def of(self, stage: str) -> list[tuple[EffectStages, Any]]:
        """Return the functions of a stage with their effects."""
        return [(effect, f) for effect in self.stages for kind, f in effect.functions if kind == stage]

    def calls(self, stage: str) -> list[tuple[EffectStages, Call]]:
        """Return the calls of a stage with their effects."""
        return [
            (effect, call_stage(stage, effect, function, self.lent)) for effect, function in self.of(stage)
        ]

    def asks(self, *names: str, stages: Iterable[str] = ()) -> bool:
        """Return whether any function, of some stages or of all, asks for one of these quantities."""
        chosen = [f for effect in self.stages for s, f in effect.functions if not stages or s in stages]
        return any(name in inspect.signature(f.func).parameters for f in chosen for name in names)


def pixel_scope(model: PixelModel) -> dict[str, Any]:
    """Return what the names of a kernel mean that it does not define itself."""
    # `Source` and `Sink` stand for one of several structures, so that all kernels have the same head
    functions = {call_name(stage, effect): f for effect in model.stages for stage, f in effect.functions}
    return {
        "wp": wp,
        "Source": SOURCES[model.source],
        "Sink": SINKS[model.sink],
        "Clock": SampleClock,
        "deposit": deposit_event,
        "hold": hold_event,
        "keep_held": keep_held,
        "element": array_element,
        "stored": stored_sample,
        "leaving_time": leaving_time,
        "key": stream_key,
        "uniform": uniform,
        "normal": normal,
        "waiting": unit_exponential,
        "layer_intensity": layer_intensity,
        "layers_near": layers_near,
        "Ground": BackgroundGeometry,
        "ground_of": background_geometry,
        "background_at": background_at,
        # one lane of the vectors' own function, so that a pixel alone and one of a block get the same bits
        "logarithm": lane_functions(1).logarithm,
        "Lane": lane_functions(1).Lanes,
        "whole": whole_quotient,
        "exponential": exponential,
        **functions,
    }
