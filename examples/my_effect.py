"""My own effect: write it in one file, simulate with it, find it in a recording."""

# %% Physics that dase does not know: thresholds rise along the rows, as of a supply line with a resistance.
# `dase effects new NAME` writes such a file, docs/tutorial-effect.md explains it
from pathlib import Path

import numpy as np

import dase

Path("supply_drop.py").write_text(
    '''"""A supply that falls from column to column."""

from dataclasses import dataclass
from typing import ClassVar

import warp as wp

from dase.effects import Effect, parameter


@wp.func
def raise_thresholds(on: float, off: float, x: float, drop: float):
    """Return the thresholds at a column; arguments are found by their names."""
    factor = 1.0 + drop * x / 100.0
    return on * factor, off * factor


@dataclass(frozen=True, kw_only=True)
class SupplyDrop(Effect):
    """Thresholds rise from column to column, as the supply falls along the rows."""

    name: ClassVar[str] = "supply_drop"
    source: ClassVar[str] = "an example"
    stages: ClassVar = {"threshold": raise_thresholds}

    drop: float = parameter(
        0.3, unit="1", off=0.0, bounds=(0.0, 10.0), plausible=(0.03, 3.0), about="rise over 100 columns"
    )
'''
)

# %% A camera with it; the file is tried when it is loaded
effects = dase.load_effects("supply_drop.py")
ideal = dase.load_sensor("ideal")
camera = ideal.with_effect(effects["supply_drop"](drop=0.6))
print(camera)

# %% Light that the camera sees, and its events
x, y = np.meshgrid(np.arange(96), np.arange(64))
times = np.arange(0, 0.5, 0.001)
waves = [0.5 + 0.3 * np.sin(0.2 * (x + 0.4 * y) - 40 * t) + 0.15 * np.sin(0.5 * y - 25 * t) for t in times]
scene = dase.VideoScene(np.array(waves, np.float32), times)
events = dase.simulate(scene, camera, seed=1)
print(events)

# %% Does an ideal model lack it? It is tried beside all that dase has
found = dase.diagnose(events, ideal, scene=scene, effects=dase.EFFECTS | effects, most=1, pixels=300)
print(found)
