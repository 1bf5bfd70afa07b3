"""NumPy twin of the patch kernels, in float64 and written from the definitions."""

from __future__ import annotations

import numpy as np


def tensor(image, top, left, size):
    """Mean of the outer product of the gradient under a two-dimensional Gaussian, (2, 2)."""
    padded = np.pad(np.asarray(image, np.float64), 1, mode="edge")
    gx = (padded[1:-1, 2:] - padded[1:-1, :-2]) / 2
    gy = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / 2
    inside = np.s_[top : top + size, left : left + size]
    vectors = np.stack([gx[inside].ravel(), gy[inside].ravel()])
    y, x = np.indices((size, size)).reshape(2, -1) - (size - 1) / 2
    weights = np.exp(-(x**2 + y**2) / (2 * (size / 4) ** 2))
    return (vectors * weights) @ vectors.T / weights.sum()


def structure(image, top, left, size):
    """Angle [rad], coherence, strength and energy of one patch."""
    values, vectors = np.linalg.eigh(tensor(image, top, left, size))
    small, large = np.sqrt(np.maximum(values, 0))
    angle = np.arctan2(vectors[1, 1], vectors[0, 1]) % np.pi
    coherence = (large - small) / (large + small) if large > 0 else 0.0
    return angle, coherence, large, values.sum()


def contrast(patch):
    """Eq. 12 of one patch of total counts (S, S): every ordered pair of 4-neighbours, its own density."""
    size = len(patch)
    magnitudes = []
    for y, x in np.ndindex(size, size):
        for v, u in ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)):
            if 0 <= v < size and 0 <= u < size:
                magnitudes.append(abs(float(patch[v, u]) - float(patch[y, x])))
    magnitudes = np.array(magnitudes)
    edges = np.arange(17.0)  # the last bin is open: what lies beyond is counted in it
    density, _ = np.histogram(np.minimum(magnitudes, 15.5), edges, density=True)
    return (magnitudes**2 * density[np.digitize(magnitudes, edges[1:-1])]).sum()


def attributes(image, counts, size, stride):
    """Angle, coherence, strength, energy and contrast, each (B, rows, columns)."""
    batch, height, width = image.shape
    tops, lefts = range(0, height - size + 1, stride), range(0, width - size + 1, stride)
    out = np.empty((5, batch, len(tops), len(lefts)))
    for b in range(batch):
        total = counts[b].astype(np.float64).sum(0)
        for row, top in enumerate(tops):
            for column, left in enumerate(lefts):
                patch = total[top : top + size, left : left + size]
                out[:, b, row, column] = *structure(image[b], top, left, size), contrast(patch)
    return out
