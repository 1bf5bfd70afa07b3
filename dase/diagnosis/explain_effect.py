"""What an effect is, and what it does to the probes: seen in a simulation, so true of any effect."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from dase.diagnosis.cell_descriptions import worst_cells
from dase.effects import EFFECTS, Effect
from dase.errors import InputError, nearest
from dase.fitting.data_split import split_measurement
from dase.fitting.measurement import Measurement
from dase.fitting.model import model_of
from dase.probes.statistics import FAMILIES
from dase.results import Cell
from dase.scenes.video import VideoScene
from dase.simulation.sensor import Sensor
from dase.simulation.simulate import simulate


def explain_effect(name: str, effects: Mapping[str, type[Effect]] = EFFECTS, *, shown: int = 6) -> str:
    """Return what an effect is, what it does to the probes, and where it was described.

    Args:
        name: Of the effect.
        effects: All effects known, by name.
        shown: Cells at most that are listed.

    Raises:
        InputError: There is no such effect.
    """
    if name not in effects:
        raise InputError(f"there is no effect '{name}': {nearest(name, effects)}")
    effect = effects[name]
    lines = [f"{name}: {effect.about()}", ""]
    clear = noticeable_effect(effect)
    families, cells = changes_by_effect(clear)
    units = {p.name: "" if p.unit == "1" else f" {p.unit}" for p in effect.parameters()}
    values = ", ".join(f"{n} {getattr(clear, n):.3g}{unit}" for n, unit in units.items())
    lines.append(f"What it does to the probes, at {values}, over bars that move and stand still:")
    for family, error in sorted(families.items(), key=lambda item: -item[1]):
        if error > 1.5:
            lines.append(f"  {family:10s} {error:7.1f}  {FAMILIES[family]}")
    if len(lines) == 3:
        lines.append("  nothing that such a recording would show")
    lines += [f"  - {with_and_without(cell)}" for cell in cells[:shown]]
    return "\n".join([*lines, "", f"Source: {effect.source}"])


def noticeable_effect(effect: type[Effect]) -> Effect:
    """Return an effect as strong as half way from its default to the end of its plausible range."""
    values = {}
    for p in effect.parameters():
        if p.off is not None and p.default > 0:
            end = p.plausible[0] if p.off > p.default else p.plausible[1]
            values[p.name] = math.sqrt(p.default * end)
    return effect(**values)


def changes_by_effect(effect: Effect) -> tuple[dict[str, float], tuple[Cell, ...]]:
    """Return by how much each family changes, and the cells that change most; measured is with it."""
    scene = moving_bars()
    plain = Sensor(name="without")
    events = simulate(scene, plain.with_effect(effect), seed=1)
    evidence = split_measurement(Measurement(events, scene), pixels=scene.width * scene.height // 2)
    judgement = model_of(plain).judge(evidence.held, repeats=24, seed=2)
    return judgement.families, worst_cells(evidence, judgement)


def with_and_without(cell: Cell) -> str:
    """Return what an effect does to a cell, in words."""
    if cell.unit == "events":
        return f"{cell.where}: {cell.what} {cell.simulated:.0f} without, {cell.measured:.0f} with"
    return f"{cell.where}: {cell.what} {cell.simulated:.3g} without, {cell.measured:.3g} with"


def moving_bars(
    *, width: int = 72, height: int = 48, duration: float = 0.8, frame_rate: float = 1000.0
) -> VideoScene:
    """Return bars that move at several speeds over a still background from dark to bright.

    Args:
        width: Columns.
        height: Rows, a multiple of the four speeds.
        duration: Length [s].
        frame_rate: Of the frames that make it up [Hz].
    """
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    still = np.exp(np.linspace(np.log(0.01), np.log(0.9), width))[None] * np.ones((height, 1))
    times = np.arange(round(duration * frame_rate) + 1) / frame_rate
    frames = np.empty((len(times), height, width), np.float32)
    speeds = np.repeat([12.0, 60.0, 250.0, 900.0], height // 4)[:, None]
    for k, t in enumerate(times):
        # each strip of rows has its own speed; bars pass for a while, then the light rests
        moving = np.where(np.sin(2 * np.pi * (t / 0.4 + y / height)) > -0.2, 1.0, 0.0)
        wave = 0.5 + 0.5 * np.tanh(4 * np.sin(2 * np.pi * (x - speeds * t) / 24.0))
        frames[k] = still * (1 + moving * (1.5 * wave - 0.5))
    return VideoScene(np.clip(frames, 0, 4), times)
