"""Lines of a kernel that calls the stage functions of effects."""

from __future__ import annotations

import inspect
import re
from typing import Any

import warp as wp

from dase.kernels.pixel_stages import (
    ANYWHERE,
    CORE,
    QUANTITIES,
    SINKS,
    EffectStages,
    SampleClock,
    array_element,
    deposit_event,
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

DRAW = re.compile(r"(pixel_)?(uniform|normal)(_\d)?")


class Text:
    """Lines of a kernel, and what its names mean."""

    def __init__(self, stages: tuple[EffectStages, ...], source: str, sink: str, *, cuda: bool):
        self.stages, self.source, self.sink = stages, source, sink
        self.prefetches = cuda and source in ("frames", "log")
        self.lines: list[str] = []
        self.depth = 0
        self.states = states(stages, sink)
        self.places = {name: i for i, name in enumerate(CORE)}
        for effect in stages:
            for parameter in effect.parameters:
                self.places[f"{effect.name}_{parameter}"] = len(self.places)
        self.maps = [f"{effect.name}_{name}" for effect in stages for name in effect.maps]
        self.draws: dict[str, str] = {}
        self.scope: dict[str, Any] = {
            "wp": wp,
            "Source": SOURCES[source],
            "Sink": SINKS[sink],
            "Clock": SampleClock,
            "deposit": deposit_event,
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
            "logarithm": lane_functions(1).logarithm,
            "Lane": lane_functions(1).Lanes,
            "whole": whole_quotient,
            "exponential": exponential,
        }

    def add(self, *lines: str) -> None:
        """Append lines at the present depth."""
        self.lines += ["    " * self.depth + line for line in lines]

    def of(self, stage: str) -> list[tuple[EffectStages, Any]]:
        """Return the functions of a stage with their effects."""
        return [(effect, f) for effect in self.stages for kind, f in effect.functions if kind == stage]

    def call(self, stage: str, effect: EffectStages, function: Any) -> str:
        """Return the call of a stage function, arguments resolved by name."""
        name = f"{stage}_of_{effect.name}"  # no name of a parameter
        self.scope[name] = function
        arguments = [self.argument(stage, effect, a) for a in inspect.signature(function.func).parameters]
        return f"{name}({', '.join(arguments)})"

    def unless_off(self, effect: EffectStages, *lines: str) -> list[str]:
        """Return the lines of an effect; a kernel for many models skips them where it is off."""
        return list(lines)

    def argument(self, stage: str, effect: EffectStages, name: str) -> str:
        """Return what a stage function gets for an argument of this name."""
        if name in (*effect.parameters, *effect.states, *effect.maps):
            return f"{effect.name}_{name}"
        if name in QUANTITIES[stage] or (name in ANYWHERE and name not in ("x", "y")):
            return name
        if name in ("x", "y"):
            return f"float({name})"
        draw = DRAW.fullmatch(name)
        if draw:
            local = f"{effect.name}_{stage}_{name}"
            self.draws[local] = draw.group(2)
            index = "int(redraws)" if stage == "redraw" else "sample"
            return f"{local}" if draw.group(1) else f"{draw.group(2)}({local}_key, {index})"
        quantities = *effect.parameters, *effect.states, *effect.maps, *QUANTITIES[stage]
        known = *quantities, *ANYWHERE, "normal", "uniform"
        raise ValueError(
            f"effect '{effect.name}': stage '{stage}' has no quantity '{name}'; there are {', '.join(known)}"
        )

    def asks(self, name: str) -> bool:
        """Return whether any function asks for the quantity `name`."""
        functions = (f for effect in self.stages for _, f in effect.functions)
        return any(name in inspect.signature(f.func).parameters for f in functions)

    @staticmethod
    def returns(quantity: str, effect: EffectStages) -> str:
        """Return the left side of a stage that may change the effect's states."""
        return ", ".join([quantity, *(f"{effect.name}_{state}" for state in effect.states)])

    def noise_key(self, effect: EffectStages) -> str:
        """Name of the random stream of an effect's noise events."""
        self.draws[f"{effect.name}_noise"] = "uniform"
        return f"{effect.name}_noise_key"

    def delays(self) -> bool:
        """Whether events that a gate holds back come later."""
        return any(effect.delays for effect, _ in self.of("gate"))

    def change(self, end: str, name: str) -> str:
        """Return the line that sets `name` to the change since the pixel's last event."""
        return f"{name} = {end} - reference" + (" + leaked" if "leaked" in self.states else "")
