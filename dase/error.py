"""How far statistics of a model are from those of a measurement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dase.probes import LAYOUT

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Scale:
    """What differences are measured by.

    Args:
        target: Statistics of the measurement, shape (J,).
        sigma: Standard error of a difference, tolerance included, shape (J,).
        used: Which statistics are compared, shape (J,).
    """

    target: Array
    sigma: Array
    used: NDArray[np.bool_]

    def z(self, values: Array) -> Array:
        """Return differences in standard errors, 0 where nothing is compared, shape (..., J)."""
        return np.where(self.used, (values - self.target) / self.sigma, 0.0)

    def weights(self) -> Array:
        """Return the weight of each statistic: families weigh alike, shape (J,)."""
        out = np.zeros(len(self.used))
        for part in LAYOUT.values():
            count = np.count_nonzero(self.used[part])
            if count:
                out[part] = self.used[part] / count
        return out / max(out.sum(), 1e-300)

    def loss(self, values: Array) -> Array:
        """Return the robust distance, about 1 where the differences are chance, shape (...)."""
        out: Array = robust(self.z(values)) @ self.weights()
        return out

    def families(self, values: Array) -> dict[str, float]:
        """Return the robust distance of each family that is compared."""
        rho = robust(self.z(values))
        used = {name: part for name, part in LAYOUT.items() if self.used[part].any()}
        return {name: float(rho[part][self.used[part]].mean()) for name, part in used.items()}


def robust(z: Array) -> Array:
    """Return the pseudo-Huber loss: z² for small z, 2 |z| for large; its slope never vanishes."""
    out: Array = 2.0 * (np.sqrt(1.0 + z * z) - 1.0)
    return out
