"""Free parameters of a sensor, and the space in which they are searched."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dase.effects.base import Effect, Parameter
from dase.effects.optics import SceneEffect
from dase.effects.threshold import Threshold
from dase.errors import InputError, nearest
from dase.simulation.sensor import Sensor

Array = NDArray[np.float64]

PHASE = 0.125
"""Unit along a phase [turns]: beyond it, statistics do not run along straight lines."""


@dataclass(frozen=True)
class SearchAxis:
    """One free parameter.

    Args:
        name: `effect.parameter`.
        fact: What the effect says about it.
        low: Least value of the search.
        high: Largest value of the search.
        log: Whether the search goes by factors.
        span: How long the range is in units of the search, where it does not go by factors.
        effect: Whose parameter it is.
    """

    name: str
    fact: Parameter
    low: float
    high: float
    log: bool
    span: float = 2.0
    effect: type[Effect] = Effect

    @property
    def main(self) -> bool:
        """Whether it switches its effect off."""
        return self.fact.off is not None

    @property
    def of_threshold(self) -> bool:
        """Whether it belongs to the change detector: every event depends on it."""
        return issubclass(self.effect, Threshold)

    @property
    def is_threshold(self) -> bool:
        """Whether it is the ON or the OFF threshold."""
        return self.of_threshold and self.fact.fitted

    def to_place(self, value: Any) -> Any:
        """Return where a value lies: a unit is a factor e, or a part of the range."""
        value = np.clip(value, self.low, self.high)
        if self.log:
            return np.log(value)
        return self.span * (value - self.low) / (self.high - self.low)

    def to_value(self, place: Any) -> Any:
        """Return the value at a place, the nearest one in range."""
        if self.log:
            value = np.exp(np.clip(place, math.log(self.low), math.log(self.high)))
        else:
            value = self.low + np.clip(place, 0.0, self.span) * (self.high - self.low) / self.span
        return np.clip(value, self.low, self.high)  # the exponential of a logarithm may be a bit off

    def bounds(self) -> tuple[float, float]:
        """Return the places of the ends."""
        return float(self.to_place(self.low)), float(self.to_place(self.high))


def make_axis(effect: type[Effect], fact: Parameter) -> SearchAxis:
    """Return the axis of one parameter of an effect, somewhat wider than its plausible range."""
    low, high = fact.bounds if fact.periodic else fact.plausible
    log = low > 0
    if log:
        low, high = low / 3.0, high * 3.0  # a fit may leave the plausible range, and then says so
    low, high = max(low, fact.bounds[0]), min(high, fact.bounds[1])
    span = (high - low) / PHASE if fact.periodic else 2.0
    return SearchAxis(f"{effect.name}.{fact.name}", fact, low, high, log, span, effect)


def axis_of(effect: Effect, fact: Parameter) -> SearchAxis:
    """Return the axis of one parameter of an effect, as far from its present value as a fit may go."""
    axis, value = make_axis(type(effect), fact), float(getattr(effect, fact.name))
    if axis.high > fact.farthest:
        axis = replace(axis, high=min(axis.high, max(fact.farthest, value)))
    if fact.nearby is None:
        return axis
    low, high = value * (1 - fact.nearby), value * (1 + fact.nearby)
    return replace(axis, low=low, high=high, log=False, span=2.0 / PHASE)


def full_axis(axis: SearchAxis) -> SearchAxis:
    """Return an axis that goes as far as a fit may, where a search goes less far."""
    return replace(axis, high=max(axis.high, make_axis(axis.effect, axis.fact).high))


@dataclass(frozen=True)
class ParameterSpace:
    """Free parameters of a sensor.

    Args:
        sensor: Fixed parameters are its own.
        axes: The free ones.
    """

    sensor: Sensor
    axes: tuple[SearchAxis, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the axes."""
        return tuple(axis.name for axis in self.axes)

    def places(self) -> Array:
        """Return where the sensor lies, shape (P,)."""
        return np.array([axis.to_place(value_of(self.sensor, axis.name)) for axis in self.axes])

    def bounds(self) -> Array:
        """Return the least and the largest places, shape (2, P)."""
        return np.array([axis.bounds() for axis in self.axes]).T.reshape(2, -1)

    def vectors(self, places: Array) -> NDArray[np.float32]:
        """Return the parameter vectors at some places, shape (B, all parameters)."""
        places = np.atleast_2d(places)
        names = self.sensor.parameter_names()
        out = np.repeat(self.sensor.parameters()[None], len(places), 0)
        for n, axis in enumerate(self.axes):
            if axis.name in names:  # effects behind the pixels have no place there
                out[:, names.index(axis.name)] = axis.to_value(places[:, n])
        return out

    def at(self, place: Array) -> Sensor:
        """Return the sensor at a place, shape (P,)."""
        return with_values(
            self.sensor,
            {axis.name: float(axis.to_value(p)) for axis, p in zip(self.axes, place, strict=True)},
        )


def refuse_idle(sensor: Sensor, names: Iterable[str] | None) -> None:
    """Raise InputError where a user names a parameter as free that changes nothing."""
    for name in sensor.idle_parameters().intersection(names or ()):
        shared = name.endswith(".dark") and "dark" in sensor
        why = "beside the effect 'dark': name dark.current" if shared else "by the words of its effect"
        raise InputError(f"free: {name} changes nothing {why}")


def value_of(sensor: Sensor, name: str) -> float:
    """Return the parameter `effect.parameter` of a sensor."""
    effect, parameter = name.split(".")
    return float(getattr(sensor[effect], parameter))


def with_values(sensor: Sensor, values: Mapping[str, float]) -> Sensor:
    """Return the sensor with some parameters set."""
    for name in dict.fromkeys(key.split(".")[0] for key in values):
        mine = {key.split(".")[1]: value for key, value in values.items() if key.split(".")[0] == name}
        sensor = sensor.with_effect(replace(sensor[name], **mine))
    return sensor


def axes_of(sensor: Sensor, names: Iterable[str] | None = None) -> tuple[SearchAxis, ...]:
    """Return the axes of a sensor's free parameters.

    Args:
        sensor: Whose parameters.
        names: Effects or `effect.parameter`; None for all effects that are not off. Of an effect all
            parameters but those with `Parameter.fitted` False, which must be named, and those that change
            nothing by its words.

    Raises:
        InputError: A name that the sensor does not have, or of what acts on pictures.
    """
    every = {
        f"{effect.name}.{p.name}": axis_of(effect, p)
        for effect in sensor.effects
        for p in effect.parameters()
    }
    on_pictures = {effect.name for effect in sensor.effects if isinstance(effect, SceneEffect)}
    idle = sensor.idle_parameters()
    usual = {name for name, axis in every.items() if axis.fact.fitted and name not in idle}
    if names is None:
        # a change detector whose phase is 0 is not off
        off = {e.name for e in sensor.effects if e.is_off() and not isinstance(e, Threshold)}
        return tuple(a for name, a in every.items() if name in usual and a.effect.name not in off)
    chosen = []
    for name in names:
        found = [n for n in every if n == name or (n.split(".")[0] == name and n in usual)]
        if name.split(".")[0] in on_pictures:
            raise InputError(f"free: {name} acts on pictures, which a fit leaves as they are")
        if not found:
            known = [*every, *(e.name for e in sensor.effects)]
            raise InputError(f"free: the sensor has no parameter '{name}': {nearest(name, known)}")
        chosen += found
    return tuple(every[n] for n in every if n in chosen)
