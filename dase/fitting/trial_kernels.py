"""Which compiled kernel models under trial run through: one that has all effects, or their sensor's own."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Hashable
from dataclasses import dataclass, field

import warp as wp

from dase.kernels import pixel_codegen_trials
from dase.kernels.pixel_stages import EffectStages


@dataclass(frozen=True)
class KernelSettings:
    """When a sensor's own kernel is taken; speed depends on it, results do not."""

    effects: int
    """Effects up to which a sensor has a kernel of its own at once. Those with more share one that has all
    effects, which takes 1.5 to 2.2 times as long: it is compiled once, and not for each of hundreds of
    combinations."""

    ask: float
    """Samples of pixels [models x pixels x samples] from which on it is looked whether a sensor's own kernel
    was compiled once before, by whatever process: to write its text takes as long as some ten million."""

    compile: float
    """The same from which on it is compiled: those of the shared kernel have then cost about as much more as
    that takes, and as many may come."""

    filled: float = 0.6
    """Share of the lanes that models must fill to run in their own kernel beside others."""


KERNELS = {
    "cpu": KernelSettings(effects=1, ask=3e7, compile=5e8),
    # so that all candidates run in one launch
    "cuda": KernelSettings(effects=0, ask=math.inf, compile=math.inf),
}


@dataclass(eq=False)
class KernelChoice:
    """What a process has simulated of each combination of effects, and which have kernels of their own.

    Args:
        work: Samples of pixels so far.
        own: Whether a combination has a kernel of its own, of those that were asked for.
    """

    work: Counter[Hashable] = field(default_factory=Counter)
    own: dict[Hashable, bool] = field(default_factory=dict)

    def has_own(
        self, key: Hashable, stages: tuple[EffectStages, ...], settings: KernelSettings, *, lanes: int
    ) -> bool:
        """Whether models run through their sensor's own kernel.

        Args:
            key: Of the combination of effects.
            stages: Of the sensor.
            settings: For the device.
            lanes: Models of a thread.
        """
        if len(stages) <= settings.effects:
            return True
        if not self.own.get(key):
            done = self.work[key]
            if done >= settings.compile:
                self.own[key] = True
            elif done >= settings.ask and key not in self.own:
                self.own[key] = _is_compiled(stages, lanes=lanes)
        return self.own.get(key, False)


CHOICE = KernelChoice()
"""Of this process: parts of a measurement have simulators of their own, their models the same kernels."""


def _is_compiled(stages: tuple[EffectStages, ...], *, lanes: int) -> bool:
    """Whether the kernel of a sensor lies among those that Warp has compiled for this CPU before."""
    module = pixel_codegen_trials.compose_trials(stages, lanes=lanes).module
    # 1 as in `launch.run_kernel`: the variant that CPU launches use
    return os.path.isdir(os.path.join(wp.config.kernel_cache_dir, module.get_module_identifier(1)))
