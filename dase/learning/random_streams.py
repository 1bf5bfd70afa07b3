"""Which random numbers of a training are for what, so that no two purposes share any by chance.

The numbers are part of the results: a training can be repeated to the last bit as long as they stay as they
are. PyTorch takes one number as a seed, so its purposes are apart by what is added to the user's seed; NumPy
takes several, of which the second is the purpose.
"""

from __future__ import annotations

from enum import IntEnum, unique

import numpy as np

PROCESSES_APART = 1_000_003
"""Between seeds of two processes: far, so that none has the numbers of another run whose seed is a little
larger."""


@unique
class TrainingStream(IntEnum):
    """What is drawn by PyTorch: what is added to the user's seed."""

    WEIGHTS = 0
    """First weights of the network, and what PyTorch draws without being told by what."""
    NOISE = 1
    """Thresholds and phases of the pixels in the simulator's scenes."""
    CRITICS = 2
    """Weights of critics, and where between real and simulated patches they are held; one seed for all
    processes, which share the critics out."""
    KNOWN_PHYSICS = 3
    """Noise of pixels that comes of what is known of the camera."""

    def seed(self, seed: int, process: int = 0) -> int:
        """Return the seed of this purpose for a user's seed, in one of several processes."""
        return seed + int(self) + PROCESSES_APART * process


@unique
class TrainingDraw(IntEnum):
    """What is drawn by NumPy: the second word of the generator's seed."""

    TEXTURES = 0
    """Which textures scenes are made of."""
    SCENES = 1
    """The simulator's scenes."""
    TARGETS_SCENES = 2
    """Scenes, or windows of recordings, of the target."""
    SIMULATED_TARGET = 4
    """Scenes and pixels of a target that a sensor file simulates before the training."""

    def generator(self, seed: int, process: int = 0) -> np.random.Generator:
        """Return the random numbers of this purpose for a user's seed, in one of several processes."""
        return np.random.default_rng([seed, int(self), *([process] if process else [])])
