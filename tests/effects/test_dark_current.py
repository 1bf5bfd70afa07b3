"""One dark current, which light, speed, delay and noise of a pixel share."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from helpers.event_comparison import by_pixel, same, tracks
from helpers.sensors import every
from helpers.small_scenes import flicker, static
from reference import effects as reference_effects
from reference.pixel import Stream

import dase
from dase.effects.bandwidth import Bandwidth
from dase.effects.base import Effect, parameter
from dase.effects.dark import Dark
from dase.effects.latency import Latency
from dase.effects.second_order import SecondOrder
from dase.effects.threshold import Threshold
from dase.effects.voltage_noise import VoltageNoise
from dase.errors import InputError
from dase.fitting.model import model_of, starting_places, still_free, with_effect_added
from dase.fitting.parameter_space import axes_of, refuse_idle
from dase.simulation.pixel_array import PixelArray
from dase.simulation.sensor_file import dump_sensor, parse_sensor

FINE = Threshold(on=0.01, off=0.01, phase=0.0)


@dataclass(frozen=True, kw_only=True)
class SlowInTheDark(Effect):
    """What a user may write, with a share of the current by a name of its own."""

    name: ClassVar[str] = "slow_in_the_dark"
    least: float = parameter(0.1, unit="1", plausible=(0.01, 1.0), about="share in the dark")

    def idle(self, beside):
        return ("least",) if any("current" in e.lends() for e in beside) else ()


SLOW = {
    "one pole": (Bandwidth(cutoff=150.0, dark=0.4),),
    "two poles": (SecondOrder(cutoff=150.0, damping=0.4, dark=0.4),),
    "noise": (VoltageNoise(sigma=0.2, cutoff=30.0, dark=0.4),),
    "all": (
        Bandwidth(cutoff=300.0, dark=0.4, spread=0.2),
        SecondOrder(cutoff=400.0, damping=2.0, dark=0.4),
        VoltageNoise(sigma=0.2, cutoff=30.0, dark=0.4),
    ),
    "circuit": (
        SecondOrder(cutoff=120.0, damping=0.3, dark=0.4, fixed=0.8, poles="apart"),
        VoltageNoise(sigma=0.2, cutoff=30.0, dark=0.4, poles="apart"),
    ),
}


@pytest.mark.parametrize("current", [0.003, 0.03, 0.3])
@pytest.mark.parametrize("name", SLOW)
def test_what_follows_the_current_matches_its_twin(device, rng, name, current):
    scene = flicker(rng, size=(5, 6), step=0.5)
    times = scene.sample_times()
    sensor = every(Threshold(on=0.17, off=0.23), Dark(current=current, spread=0.6), *SLOW[name])
    array = PixelArray(sensor, 6, 5, seed=11, device=device)
    got = by_pixel(array.emit(scene, times)[0])
    want = reference_effects.events(sensor, times, scene.frames(times), 11)
    equal = [np.array_equal(g[:, 1], w[:, 2]) for g, w in zip(got, want, strict=True)]
    assert np.mean(equal) >= 0.9
    assert np.mean([len(w) for w in want]) > 3
    for g, w, alike in zip(got, want, equal, strict=True):
        if alike:
            np.testing.assert_array_less(np.abs(g[:, 0] - w[:, 1]) * w[:, 3], 5e-5 + 3e-9 * w[:, 3])


@pytest.mark.parametrize("current", [0.01, 0.05, 0.2])
@pytest.mark.parametrize("dark", [1e-4, 0.5])
def test_the_current_that_ends_the_contrast_sets_the_speed(device, current, dark):
    """Pixel by pixel: in complete darkness, the current is told by the contrast and by the time constant."""
    cutoff, light, lag = 40.0, 0.3, 1e-7
    times = np.r_[-lag, np.linspace(0, 3 * (1 + current) / (cutoff * current), 6001)]
    frames = np.r_[light, np.zeros(6001)][:, None, None] * np.ones((1, 3, 4))
    sensor = every(FINE, Dark(current=current, spread=0.3), Bandwidth(cutoff=cutoff, dark=dark), log_eps=1e-6)
    told = []
    for at in tracks(dase.simulate(dase.VideoScene(frames, times), sensor, device=device)):
        contrast = 0.01 * len(at)
        own = light / np.expm1(contrast)
        half = int(0.5 * contrast / 0.01)
        tau = at[half - 1] / -np.log(1 - 0.01 * half / contrast)
        told.append((own, (1 + current) / (2 * np.pi * cutoff * tau)))
    told = np.array(told)
    assert np.ptp(np.log(told[:, 0])) > 0.5
    np.testing.assert_allclose(told[:, 1], told[:, 0], rtol=0.04)


@pytest.mark.parametrize("spread", [0.0, 0.4])
def test_events_are_late_by_the_current_of_their_pixel(device, rng, spread):
    scene = flicker(rng, size=(4, 5), step=0.5)
    times, current, late = scene.sample_times(), 0.02, Latency(delay=1e-3, light=0.6, dark=0.3)
    dark = Dark(current=current, spread=spread)
    plain, got = (
        dase.simulate(scene, every(Threshold(phase=0.0), dark, *more), device=device)
        for more in ((), (late,))
    )
    own = [current * np.exp(spread * Stream("dark_current_pixel_normal", 0, i).normal()) for i in range(20)]
    place = plain.y.astype(int) * plain.width + plain.x
    light = scene.frames(times)[np.searchsorted(times, plain.t - 1e-9), plain.y, plain.x]
    left = np.minimum((light + np.array(own)[place]) / (1 + current), 1)
    due = plain.t + 1e-3 * (0.4 + 0.6 / left)
    for i in range(20):
        want = np.maximum.accumulate(due[place == i])  # they do not overtake each other
        leaves = got.t[got.y.astype(int) * got.width + got.x == i]
        np.testing.assert_allclose(leaves, want, rtol=0, atol=3e-8)
    assert np.ptp(due - plain.t) > 5e-3


@pytest.mark.parametrize("poles", ["alike", "apart"])
def test_noise_in_the_dark_is_that_of_as_much_light(device, poles):
    """What flows in a photodiode makes noise, whether light or warmth has moved it."""
    noise = VoltageNoise(sigma=0.3, cutoff=60.0, knee=0.3, dark=0.5, poles=poles)
    totals = []
    for light, more in ((0.0, (noise, Dark(current=0.05))), (0.05, (replace(noise, dark=1e-6),))):
        scene = static(np.full((20, 20), light), 4.0, 9)
        totals.append(dase.count(scene, every(Threshold(), *more), [0, 4], device=device).sum())
    assert totals[1] > 10_000
    assert totals[0] == pytest.approx(totals[1], rel=0.03)
    own = every(Threshold(), noise, Dark(current=0.05, speed="own"))
    both = dase.count(static(np.zeros((20, 20)), 4.0, 9), own, [0, 4], device=device).sum()
    assert abs(both - totals[1]) > 0.2 * totals[1]


EVERYTHING_SLOW = (*SLOW["all"], Latency(delay=2e-3, light=0.7, dark=0.4))


def with_other_dark(effects: tuple[dase.Effect, ...], dark: float) -> tuple[dase.Effect, ...]:
    return tuple(replace(effect, dark=dark) for effect in effects)


def test_the_poles_own_dark_current_changes_nothing_beside_it(device, rng):
    scene, dark = flicker(rng), Dark(current=0.02, spread=0.3)
    shared, other, two, other_two = (
        dase.simulate(scene, every(Threshold(), one, *with_other_dark(EVERYTHING_SLOW, own)), device=device)
        for one in (dark, replace(dark, speed="own")) for own in (0.4, 0.01)
    )  # fmt: skip
    assert len(shared) > 500
    same(other, shared)
    assert len(two) != len(other_two)


@pytest.mark.parametrize("speed", ["shared", "own"])
def test_a_dark_current_of_nothing_leaves_the_poles_theirs(device, rng, speed):
    scene = flicker(rng)
    sensor = dase.Sensor((*EVERYTHING_SLOW[:3], Threshold(), EVERYTHING_SLOW[3]))
    off = sensor.with_effect(Dark(current=0.0, spread=0.7, speed=speed))
    got, want = (dase.simulate(scene, one, seed=3, device=device) for one in (off, sensor))
    assert len(want) > 500
    same(got, want)
    assert off.idle_parameters() == sensor.idle_parameters()


def test_a_fit_has_one_dark_current():
    sensor = dase.Sensor((*SLOW["all"][:2], Threshold(), Latency()))
    present = model_of(sensor)
    poles = {"bandwidth.dark", "second_order.dark", "latency.dark"}
    assert poles <= set(present.space.names)
    more = with_effect_added(present, Dark())
    assert {n for n in more.space.names if "dark" in n} == {"dark.current", "dark.spread"}
    assert set(more.space.names) - {"dark.current", "dark.spread"} == set(present.space.names) - poles
    # without it, the poles have theirs again, unless something of them was not to be fitted
    assert set(still_free(sensor, more)) == set(present.space.names)
    less = with_effect_added(model_of(sensor, ["threshold", "second_order.cutoff"]), Dark())
    assert not poles & set(still_free(sensor, less))
    own = with_effect_added(present, Dark(speed="own"))
    assert poles <= set(own.space.names)
    (shared,) = Dark(speed="own").otherwise(sensor.effects)
    assert shared == Dark()
    assert not Dark(speed="own").otherwise([Threshold()])
    assert not Dark().otherwise(sensor.effects)


@pytest.mark.parametrize("slow", [Bandwidth(dark=0.02), Latency(dark=0.02)], ids=lambda e: e.name)
def test_a_search_begins_with_the_current_that_others_stand_for(slow):
    """A latency or a pole that was fitted without it has a dark current of its own."""
    present = model_of(dase.Sensor((Threshold(), slow)))

    def tried(effect, few):
        model = with_effect_added(present, effect)
        n = model.space.names.index("dark.current")
        return np.unique(model.space.axes[n].to_value(starting_places(model, effect, few=few)[:, n]).round(6))

    for few in (False, True):
        # one that is of the light alone follows nobody
        more = np.setdiff1d(tried(Dark(), few), tried(Dark(speed="own"), few))
        assert more == pytest.approx([0.02 / 0.98], rel=1e-3)
    assert Dark().stood_in_for([VoltageNoise()]) == {}  # its own is an intensity, and not fitted
    # it goes by what a current changes, not by a name
    assert Dark().stood_in_for([replace(slow, dark=0.6)]) == {}
    assert Dark().stood_in_for([SlowInTheDark(least=0.02)]) == Dark().stood_in_for([slow])


def test_a_pole_added_to_a_sensor_with_a_dark_current_has_none_to_fit():
    present = model_of(dase.Sensor((Dark(), Threshold())))
    names = with_effect_added(present, Bandwidth()).space.names
    assert "bandwidth.cutoff" in names
    assert "bandwidth.dark" not in names


def test_what_changes_nothing_cannot_be_asked_for():
    sensor = dase.Sensor((Dark(), Bandwidth(), Threshold()))
    refuse_idle(sensor, ["dark", "bandwidth", "threshold.on"])
    with pytest.raises(InputError, match=r"bandwidth\.dark changes nothing.*name dark\.current"):
        refuse_idle(sensor, ["threshold", "bandwidth.dark"])
    assert "bandwidth.dark" not in [axis.name for axis in axes_of(sensor)]


def test_a_sensor_file_says_which_dark_current_counts():
    text = dump_sensor(dase.Sensor((Dark(), Bandwidth(), Threshold())))
    (line,) = (one for one in text.splitlines() if one.startswith("dark = "))
    assert "changes nothing here" in line
    assert parse_sensor(text, "text")["bandwidth"] == Bandwidth()
    assert "changes nothing here" not in dump_sensor(dase.Sensor((Bandwidth(), Threshold())))
