"""Sensors with every effect switched on, so that no stage is left out, and with some by their names."""

from __future__ import annotations

import numpy as np
from reference import pixel as reference

import dase
from dase.effects.bandwidth import Bandwidth
from dase.effects.dark import Dark
from dase.effects.dead import Dead
from dase.effects.exposure import Exposure
from dase.effects.flicker import Flicker
from dase.effects.high_pass import HighPass
from dase.effects.hot import Hot
from dase.effects.jitter import Jitter
from dase.effects.leak import Leak
from dase.effects.linlog import Linlog
from dase.effects.mismatch import Mismatch
from dase.effects.refractory import Refractory
from dase.effects.second_order import SecondOrder
from dase.effects.shot import Shot
from dase.effects.threshold import Threshold
from dase.effects.vignetting import Vignetting
from dase.effects.voltage_noise import VoltageNoise


def sensor_with(**effects: dict[str, float]) -> dase.Sensor:
    """Return a sensor with effects, each a dict of its values."""
    sensor = dase.Sensor()
    for name, values in effects.items():
        sensor = sensor.with_effect(dase.EFFECTS[name](**values))
    return sensor


def full(mode: str = "reset", noise: str = "held") -> dase.Sensor:
    """Return a sensor on which every effect is strong."""
    return reference.only(
        Threshold(on=0.17, off=0.23),
        Mismatch(spread=0.1),
        Bandwidth(cutoff=400.0),
        Leak(rate=8.0, spread=0.3),
        Shot(rate=60.0, balance=0.6, spread=0.5),
        Refractory(period=3e-3, mode=mode, noise=noise),
    )


FURTHER = (
    Flicker, Vignetting, Dark, Linlog, SecondOrder, VoltageNoise, HighPass, Exposure, Jitter, Hot, Dead
)  # fmt: skip


STRONG = {
    "flicker": Flicker(frequency=40.0, depth=0.5),
    "vignetting": Vignetting(loss=0.6),
    "dark": Dark(current=0.02, spread=0.5),
    "linlog": Linlog(knee=0.08, slope=1.5),
    "second_order": SecondOrder(cutoff=60.0, damping=0.4, dark=0.3),
    "voltage_noise": VoltageNoise(sigma=0.3, cutoff=300.0),
    "high_pass": HighPass(cutoff=30.0),
    "exposure": Exposure(amplitude=0.5, spread=0.5, period=0.013, exposure=0.004, begin=0.002),
    "jitter": Jitter(spread=0.3),
    "hot": Hot(share=0.2, rate=300.0),
    "dead": Dead(share=0.3),
}


def every(*effects: dase.Effect, mode: str = "reset", log_eps: float = 1e-3) -> dase.Sensor:
    """Return a sensor that has every effect, those not given switched off: one kernel serves many tests."""
    off = [effect.identity() for effect in dase.EFFECTS.values() if effect is not Refractory]
    known = {effect.name: effect for effect in (*off, Refractory(period=0.0, mode=mode), *effects)}
    return dase.Sensor(tuple(known[name] for name in dase.EFFECTS), log_eps=log_eps)


def counts(scene: dase.Scene, sensor: dase.Sensor, seconds: float, device: str, **options) -> np.ndarray:
    """Return events of every pixel in (0, seconds], shape (2, N): OFF, ON."""
    return dase.count(scene, sensor, [0, seconds], device=device, **options)[0, 0]
