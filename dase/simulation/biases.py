"""What a DAVIS346's bias currents do to a sensor, as far as it is published: laws of ratios.

For other cameras no such law was found; docs/presets.md says what is known of them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from dase.effects.leak import Leak
from dase.effects.refractory import Refractory
from dase.effects.shot import Shot
from dase.effects.threshold import Threshold
from dase.errors import InputError, nearest
from dase.simulation.sensor import Sensor

COARSE_CURRENTS = (11e-12, 94e-12, 756e-12, 6.054e-9, 48.437e-9, 387.5e-9, 3.1e-6, 24.8e-6)
"""Largest current of each coarse setting [A], as libcaer, the cameras' library, has them."""


@dataclass(frozen=True)
class BiasLaw:
    """How values of a sensor follow biases.

    Args:
        biases: By the names of the camera's software.
        values: `effect.parameter` of what follows; empty where no law is published.
        law: In words or as a formula.
        source: Who says so.
        uncertainty: What is not known of it.
    """

    biases: tuple[str, ...]
    values: tuple[str, ...]
    law: str
    source: str
    uncertainty: str


_NOZAKI = (
    "Nozaki, Delbruck: Temperature and parasitic photocurrent effects in dynamic vision sensors, 2017, as "
    "jAER, the software of its authors, cites it"
)

DAVIS_LAWS = (
    BiasLaw(
        ("ONBn", "OFFBn", "DiffBn"),
        ("threshold.on", "threshold.off"),
        "in proportion to ln(ONBn / DiffBn), and to ln(DiffBn / OFFBn)",
        _NOZAKI,
        "the article could not be read. The factor before the logarithm cancels; jAER's own is 0.7 / 0.7² / "
        "20 = 0.071, where the capacitors in the same file have a ratio of 24 and not 20",
    ),
    BiasLaw(
        ("RefrBp",),
        ("refractory.period",),
        "in proportion to 1 / RefrBp: a constant current charges a capacitor",
        "jAER",
        "capacitor and voltage, 20 fF and 0.8 V in jAER, are called guesses there, and cancel; no recording "
        "at hand measures it",
    ),
    BiasLaw(
        ("ONBn", "OFFBn", "DiffBn"),
        ("leak.threshold", "shot.threshold"),
        "what makes them stays the same, so that rates follow the thresholds: both remember at which ones "
        "they were measured",
        "the effects' own laws",
        "shot noise of a real camera falls faster with the threshold than in proportion to 1 / threshold",
    ),
    BiasLaw(
        ("PrBp", "PrSFBp"),
        (),
        "none to go by. jAER estimates the cutoff of the source follower alone, PrSFBp / (2π · 25 mV · 131 "
        "fF), and only below half of PrBp",
        "jAER",
        "a pole goes with its current only where neither the photocurrent nor another pole is slower, and "
        "which one limits a preset is not known; jAER calls the capacitor a guess",
    ),
)
"""All that is known of the biases of a DAVIS346; currents on a chip differ from those asked for."""

_APPLIED = ("ONBn", "OFFBn", "DiffBn", "RefrBp")

_NO_LAW = {
    "PrBp": "bandwidth.cutoff",
    "PrSFBp": "bandwidth.cutoff",
    "bias_diff": "threshold.on and threshold.off",
    "bias_diff_on": "threshold.on",
    "bias_diff_off": "threshold.off",
    "bias_fo": "bandwidth.cutoff",
    "bias_hpf": "high_pass.cutoff",
    "bias_refr": "refractory.period",
}
"""Biases of which it is known what they set, but no law: of a DAVIS346, and of Prophesee's cameras."""

_CURRENT = re.compile(r"([0-9]*\.?[0-9]+(?:e[+-]?[0-9]+)?) ?([fpnuµm]?)A", re.IGNORECASE)
_PREFIXES = {"": 1.0, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "n": 1e-9, "p": 1e-12, "f": 1e-15}


def bias_current(coarse: int, fine: int) -> float:
    """Return the current of a coarse and a fine setting [A].

    Raises:
        InputError: Not 0 to 7 and 1 to 255; a fine setting of 0 switches a bias off.
    """
    whole = isinstance(coarse, int) and isinstance(fine, int)
    if not whole or coarse not in range(8) or fine not in range(1, 256):
        raise InputError(
            f"bias: must have a coarse setting of 0 to 7 and a fine one of 1 to 255, got {coarse}, {fine}"
        )
    return COARSE_CURRENTS[coarse] * fine / 255


def parse_biases(texts: Iterable[str]) -> tuple[dict[str, float], dict[str, float]]:
    """Return currents [A] before and after from texts such as `ONBn=5/255:6/200`.

    A setting is coarse/fine, as the camera's software shows it, or a current with its unit, `8nA`; that after
    may also be relative, `+20%`. One alone has not changed. What follows in proportion needs none before:
    `RefrBp=+20%`.

    Raises:
        InputError: Not of that form, or a bias is named twice.
    """
    before, after = dict[str, float](), dict[str, float]()
    for text in texts:
        name, equals, settings = text.partition("=")
        name = name.strip()
        first, colon, second = settings.partition(":")
        if not equals or not name or not first.strip() or (colon and not second.strip()):
            raise InputError(
                f"bias: '{text}' is not of the form NAME=BEFORE:AFTER, such as ONBn=5/255:6/200 or "
                "RefrBp=2nA:+20%"
            )
        if name in before:
            raise InputError(f"bias: {name} is given twice")
        if _share(first) is not None and not colon:
            if name in ("ONBn", "OFFBn", "DiffBn"):
                raise InputError(
                    f"bias: thresholds follow ratios of currents, so {name} needs its setting before, as in "
                    f"{name}=5/255:{first.strip()}"
                )
            first, second, colon = "1A", first, ":"
        before[name] = _parse_current(first, text)
        share = _share(second) if colon else 1.0
        after[name] = before[name] * share if share is not None else _parse_current(second, text)
    return before, after


def _share(text: str) -> float | None:
    """Return the factor of a text such as `+20%`, None of any other."""
    found = re.fullmatch(r"([+-][0-9]*\.?[0-9]+) ?%", text.strip())
    return 1 + float(found.group(1)) / 100 if found else None


def _parse_current(setting: str, text: str) -> float:
    """Return the current [A] of a setting, coarse/fine or with its unit."""
    if found := re.fullmatch(r"([0-9]+) ?/ ?([0-9]+)", setting.strip()):
        return bias_current(int(found.group(1)), int(found.group(2)))
    if found := _CURRENT.fullmatch(setting.strip()):
        return float(found.group(1)) * _PREFIXES[found.group(2).lower()]
    raise InputError(
        f"bias: '{setting.strip()}' of '{text}' is neither coarse/fine (5/255) nor a current (8nA)"
    )


def with_biases(sensor: Sensor, before: Mapping[str, float], after: Mapping[str, float]) -> Sensor:
    """Return a DAVIS346 as it is with other biases, by `DAVIS_LAWS`.

    Args:
        sensor: As it is with the currents of `before`: a fit to a recording made with them, not a preset,
            whose currents nobody knows.
        before: Currents [A] by the names ONBn, OFFBn, DiffBn and RefrBp, see `bias_current`; those that both
            leave out have not changed.
        after: The same biases, as they are then.

    Raises:
        InputError: A name has no law, a current is not above 0, or currents are such that thresholds have no
            sign.
    """
    for name in (*before, *after):
        if name not in _APPLIED:
            why = nearest(name, _APPLIED)
            if name in _NO_LAW:
                why = f"no law of it is published; it sets {_NO_LAW[name]}: fit that, or set it in the file"
            raise InputError(f"biases: nothing follows '{name}': {why}")
    if missing := set(before) ^ set(after):
        raise InputError(
            f"biases: must be given before and after, got only one of {', '.join(sorted(missing))}"
        )
    for name, current in (*before.items(), *after.items()):
        if not (math.isfinite(current) and current > 0):
            raise InputError(f"biases: {name} must be a current above 0 A, got {current:g}")
    if {"ONBn", "OFFBn", "DiffBn"} & set(before):
        sensor = _with_thresholds(sensor, before, after)
    if "RefrBp" in before:
        if "refractory" not in sensor:
            raise InputError(
                f"biases: RefrBp sets a dead time, and sensor '{sensor.name}' has no 'refractory'"
            )
        dead = sensor["refractory"]
        assert isinstance(dead, Refractory)
        sensor = sensor.with_effect(replace(dead, period=dead.period * before["RefrBp"] / after["RefrBp"]))
    return sensor


def _with_thresholds(sensor: Sensor, before: Mapping[str, float], after: Mapping[str, float]) -> Sensor:
    """Return the sensor with the thresholds of other currents, its noise that of the same pixels."""
    if "DiffBn" not in before or not {"ONBn", "OFFBn"} & set(before):
        raise InputError(
            "biases: thresholds follow ONBn and OFFBn relative to DiffBn: give DiffBn and one of them"
        )
    old = sensor["threshold"]
    assert isinstance(old, Threshold)
    new = old
    for bias, name, sign in (("ONBn", "on", 1), ("OFFBn", "off", -1)):
        if bias not in before:
            if before["DiffBn"] != after["DiffBn"]:
                raise InputError(f"biases: with another DiffBn threshold.{name} changes: give {bias}, too")
            continue
        ways = [sign * math.log(currents[bias] / currents["DiffBn"]) for currents in (before, after)]
        if min(ways) <= 0:
            side = "above" if sign > 0 else "below"
            raise InputError(
                f"biases: {bias} must be {side} DiffBn, or its comparator fires at rest or never"
            )
        new = replace(new, **{name: getattr(old, name) * ways[1] / ways[0]})
    for name in ("leak", "shot"):
        if name not in sensor:
            continue
        noise = sensor[name]
        if isinstance(noise, Leak | Shot) and not noise.threshold:
            if isinstance(noise, Shot) and old.on != old.off:
                raise InputError(
                    "biases: shot.rate follows one threshold of both polarities, and this sensor has "
                    f"{old.on:g} and {old.off:g}: set shot.threshold"
                )
            sensor = sensor.with_effect(replace(noise, threshold=old.on))
    return sensor.with_effect(new)
