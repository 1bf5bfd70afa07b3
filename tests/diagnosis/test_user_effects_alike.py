"""A user's effect is searched like a built-in one: by what it says about itself, never by names."""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import warp as wp

import dase
from dase.diagnosis.candidates import acts_on_few_pixels
from dase.diagnosis.diagnose import diagnose
from dase.diagnosis.explain_effect import moving_bars
from dase.effects import EFFECTS, Effect, Observations, parameter
from dase.effects.bandwidth import lowpass_voltage
from dase.effects.dead import Dead
from dase.effects.flicker import Flicker
from dase.effects.readout import Readout
from dase.effects.row_scan import RowScan
from dase.effects.timestamp import Timestamp
from dase.fitting.model import model_of, shift_periodic_effects, starting_places, with_effect_added
from dase.simulation.sensor import Sensor

OBSERVED = Observations(100.0, 1e-3, 3e-6, "left", 1e6, 1.0, 0.01)


@wp.func
def even_voltage(
    voltage: float, intensity: float, dt: float, cutoff: float, dark: float, input: float, output: float
):
    """The bandwidth of pixels that are all alike."""
    return lowpass_voltage(voltage, intensity, dt, cutoff, dark, 0.0, 0.0, input, output, 0.0)


@dataclass(frozen=True, kw_only=True)
class Sluggish(Effect):
    """A copy of the bandwidth that keeps the names of its parameters."""

    name: ClassVar[str] = "sluggish"
    source: ClassVar[str] = "this test"
    stages: ClassVar = {"respond": even_voltage}
    states: ClassVar = ("input", "output")

    cutoff: float = parameter(
        200.0, unit="Hz", off=math.inf, bounds=(0.01, math.inf), plausible=(3.0, 3000.0), about="pole"
    )
    dark: float = parameter(
        0.07, unit="1", bounds=(1e-4, 1.0), plausible=(0.01, 1.0), about="in the dark", starts="ends"
    )


@wp.func
def renamed_voltage(
    voltage: float, intensity: float, dt: float, pace: float, night: float, input: float, output: float
):
    """The same by other names."""
    return even_voltage(voltage, intensity, dt, pace, night, input, output)


@dataclass(frozen=True, kw_only=True)
class Weary(Effect):
    """The same by other names."""

    name: ClassVar[str] = "weary"
    source: ClassVar[str] = "this test"
    stages: ClassVar = {"respond": renamed_voltage}
    states: ClassVar = ("input", "output")

    pace: float = parameter(
        200.0, unit="Hz", off=math.inf, bounds=(0.01, math.inf), plausible=(3.0, 3000.0), about="pole"
    )
    night: float = parameter(
        0.07, unit="1", bounds=(1e-4, 1.0), plausible=(0.01, 1.0), about="in the dark", starts="ends"
    )


@pytest.mark.slow
def test_names_of_an_effect_and_its_parameters_do_not_matter(device):
    scene = moving_bars(duration=0.5)
    true = Sensor((EFFECTS["threshold"](on=0.18, off=0.22), EFFECTS["bandwidth"](cutoff=60.0)))
    events = dase.simulate(scene, true, seed=3, device=device)
    found = []
    for effect in (Sluggish, Weary):
        library = {n: EFFECTS[n] for n in ("threshold", "linlog")} | {effect.name: effect}
        out = diagnose(events, scene=scene, effects=library, pixels=100, most=1, seed=1, device=device)
        assert out.selected == (effect.name,)
        found.append(json.dumps({**out.to_json(), "seconds": 0}))
    for old, new in (("sluggish", "weary"), ("cutoff", "pace"), ("dark", "night")):
        found[0] = re.sub(rf"\b{old}\b", new, found[0])
        found[1] = re.sub(rf"\b{old}\b", new, found[1])  # what is said of dark pixels
    if device == "cpu":
        assert found[0] == found[1]
    else:
        assert json.loads(found[0])["selected"] == json.loads(found[1])["selected"]


def renamed(effect: type[Effect]) -> type[Effect]:
    """Return an effect of another name and otherwise the same."""
    return dataclass(frozen=True, kw_only=True)(type("Renamed", (effect,), {"name": "renamed"}))


@pytest.mark.parametrize("effect", [Flicker, Timestamp, RowScan, Readout], ids=lambda e: e.name)
def test_what_is_read_off_the_measurement_goes_by_the_effect(effect):
    got, other = (e.candidates(OBSERVED) for e in (effect, renamed(effect)))
    assert len(got) > 0
    assert [{n: getattr(e, n) for n in e.settings()} for e in got] == [
        {n: getattr(e, n) for n in e.settings()} for e in other
    ]
    assert all(one.name == "renamed" for one in other)


def test_no_candidate_where_the_measurement_shows_none():
    nothing = Observations(
        100.0, 0.0, 0.0, "down", 1e3, 0.001, 0.01, bus_load=0.001, row_load=0.002, column_load=0.002
    )
    for effect in (RowScan, Readout):
        assert effect.candidates(nothing) == []
    assert [one.step for one in Timestamp.candidates(nothing)] == [0.0]  # stamps that are off have no ticks
    assert len(Flicker.candidates(nothing)) > 0
    assert Flicker.candidates(replace(nothing, peak_chance=0.5)) == []


@pytest.mark.parametrize("name", ["flicker", "bandwidth", "hot", "readout", "voltage_noise"])
def test_a_search_begins_alike_whatever_the_name(name):
    present = model_of(Sensor())
    starts, shifts = [], []
    for effect in (EFFECTS[name], renamed(EFFECTS[name])):
        one = effect.candidates(OBSERVED)[0]
        model = with_effect_added(present, one)
        at = [n for n, axis in enumerate(model.space.axes) if axis.effect is effect]
        starts.append(starting_places(model, one)[:, at])
        shifts.append([way.place[at] for way in shift_periodic_effects(model, 1e-3)])
    np.testing.assert_array_equal(*starts)
    np.testing.assert_array_equal(*shifts)
    assert len(shifts[0]) == (3 if name == "flicker" else 1)


def test_what_acts_on_few_pixels_says_so():
    assert acts_on_few_pixels(renamed(Dead)())
    assert not acts_on_few_pixels(renamed(Flicker)())
