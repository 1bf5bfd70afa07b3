"""Biases of a DAVIS346: what follows them, by which ratios, and what is refused."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from helpers.small_scenes import still

import dase
from dase.effects.leak import Leak
from dase.effects.shot import Shot
from dase.effects.threshold import Threshold
from dase.errors import InputError
from dase.simulation.biases import DAVIS_LAWS, bias_current, parse_biases, with_biases

BEFORE = {"ONBn": bias_current(5, 255), "OFFBn": bias_current(4, 1), "DiffBn": bias_current(4, 39)}


def test_settings_are_currents():
    assert bias_current(7, 255) == pytest.approx(24.8e-6)
    assert bias_current(4, 39) == pytest.approx(48.437e-9 * 39 / 255)


@pytest.mark.parametrize("factor", [0.5, 1.0, 4.0])
def test_thresholds_go_with_the_logarithm_of_ratios(factor):
    """One that is e times as far from the others is further by that many e-folds."""
    fitted = dase.Sensor((Threshold(on=0.3, off=0.25),))
    after = BEFORE | {"ONBn": BEFORE["ONBn"] * factor, "OFFBn": BEFORE["OFFBn"] / factor}
    got = with_biases(fitted, BEFORE, after)["threshold"]
    # of coarse 5 with 255 over coarse 4 with 39, and of 39 over 1
    on, off = math.log(387.5 / (48.437 * 39 / 255)), math.log(39)
    assert got.on == pytest.approx(0.3 * (on + math.log(factor)) / on)
    assert got.off == pytest.approx(0.25 * (off + math.log(factor)) / off)
    # back again, and one bias at a time
    again = with_biases(with_biases(fitted, BEFORE, after), after, BEFORE)["threshold"]
    assert (again.on, again.off) == pytest.approx((0.3, 0.25))


def test_a_dead_time_goes_with_the_inverse_of_its_current():
    fitted = dase.load_sensor("davis346")
    got = with_biases(fitted, {"RefrBp": 2e-9}, {"RefrBp": 8e-9})
    assert got["refractory"].period == pytest.approx(fitted["refractory"].period / 4)
    assert got.without("refractory") == fitted.without("refractory")


def test_the_same_biases_change_no_value():
    fitted = dase.load_sensor("davis346")
    assert with_biases(fitted, BEFORE, BEFORE) == fitted


def test_noise_is_that_of_the_same_pixels(device):
    """Of half of the threshold there is twice the leak and twice the shot noise."""
    theta = 0.4
    fitted = dase.Sensor((Threshold(on=theta, off=theta), Leak(rate=20.0, spread=0.0), Shot(rate=20.0)))
    half = {
        "ONBn": math.sqrt(BEFORE["ONBn"] * BEFORE["DiffBn"]), "DiffBn": BEFORE["DiffBn"],
        "OFFBn": math.sqrt(BEFORE["OFFBn"] * BEFORE["DiffBn"]),
    }  # fmt: skip
    changed = with_biases(fitted, BEFORE, half)
    assert changed["threshold"].on == pytest.approx(theta / 2)
    scene = still(np.zeros(600), 2.0, 41)
    for name in ("leak", "shot"):
        kept = [
            replace(s, effects=tuple(e for e in s.effects if e.name in ("threshold", name)))
            for s in (fitted, changed)
        ]
        few, many = (dase.count(scene, s, [0, 2.0], device=device).sum() for s in kept)
        assert many / few == pytest.approx(2, rel=0.03)


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ({"PrSFBp": 1e-9}, {"PrSFBp": 2e-9}, "no law of it is published; it sets bandwidth.cutoff"),
        ({"OnBn": 1e-9}, {"OnBn": 2e-9}, "ONBn"),
        (BEFORE, {"ONBn": 1e-6}, "before and after"),
        ({"ONBn": 1e-6}, {"ONBn": 2e-6}, "relative to DiffBn"),
        (BEFORE, BEFORE | {"OFFBn": BEFORE["ONBn"]}, "OFFBn must be below DiffBn"),
        (BEFORE, BEFORE | {"ONBn": 0.0}, "above 0 A"),
        ({"ONBn": 1e-6, "DiffBn": 1e-8}, {"ONBn": 1e-6, "DiffBn": 2e-8}, "give OFFBn"),
        ({"RefrBp": 1e-9}, {"RefrBp": 2e-9}, "has no 'refractory'"),
    ],
)
def test_what_no_law_tells_is_refused(before, after, words):
    with pytest.raises(InputError, match=words):
        with_biases(dase.Sensor(), before, after)


def test_a_fine_setting_of_nothing_is_refused():
    with pytest.raises(InputError, match="1 to 255"):
        bias_current(4, 0)


def test_each_law_says_what_is_not_known():
    assert all(law.source and law.uncertainty for law in DAVIS_LAWS)
    followed = {value for law in DAVIS_LAWS for value in law.values}
    names = {f"{effect.name}.{p.name}" for effect in dase.EFFECTS.values() for p in effect.parameters()}
    assert followed <= names


@pytest.mark.parametrize(
    ("text", "currents"),
    [
        ("ONBn=5/255:6/200", (387.5e-9, 3.1e-6 * 200 / 255)),
        ("DiffBn=4/39", (48.437e-9 * 39 / 255,) * 2),
        ("RefrBp = 2 nA : 8nA", (2e-9, 8e-9)),
        ("OFFBn=1.5e-10A:2uA", (1.5e-10, 2e-6)),
        ("ONBn=8nA:+20%", (8e-9, 9.6e-9)),
        ("OFFBn=4/1:-50%", (48.437e-9 / 255, 48.437e-9 / 510)),
        ("RefrBp=+25%", (1.0, 1.25)),
    ],
)
def test_settings_are_read_from_texts(text, currents):
    before, after = parse_biases([text])
    (name,) = before
    assert name == text.split("=")[0].strip()
    assert (before[name], after[name]) == pytest.approx(currents)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ONBn", "is not of the form NAME=BEFORE:AFTER"),
        ("ONBn=5/255:", "is not of the form NAME=BEFORE:AFTER"),
        ("ONBn=5/300:5/2", "a fine one of 1 to 255, got 5, 300"),
        ("ONBn=5/x", "'5/x' of 'ONBn=5/x' is neither coarse/fine"),
        ("ONBn=8", "'8' of 'ONBn=8' is neither coarse/fine"),
        ("ONBn=1.2.3nA", "neither coarse/fine"),
        ("ONBn=+20%", "needs its setting before, as in ONBn=5/255:+20%"),
    ],
)
def test_other_texts_are_refused(text, message):
    with pytest.raises(InputError, match=re.escape(message)):
        parse_biases([text])


def test_a_bias_has_one_setting():
    with pytest.raises(InputError, match="RefrBp is given twice"):
        parse_biases(["RefrBp=+20%", "RefrBp=-20%"])


@pytest.mark.parametrize(("name", "sets"), [("bias_diff_on", "threshold.on"), ("PrBp", "bandwidth.cutoff")])
def test_a_bias_without_a_law_says_what_it_sets(name, sets):
    with pytest.raises(InputError, match=re.escape(f"no law of it is published; it sets {sets}")):
        with_biases(dase.load_sensor("imx636"), {name: 1.0}, {name: 1.2})


def test_no_bias_is_the_sensor_itself():
    sensor = dase.load_sensor("imx636")
    assert with_biases(sensor, *parse_biases([])) == sensor
