"""Plain twins of the representations: one event after the other, sharing no code with them."""

from __future__ import annotations

import math

import numpy as np


def voxels(events, bins, begin, end):
    out = np.zeros((bins, events.height, events.width))
    for t, x, y, p in zip(events.t, events.x, events.y, events.p, strict=True):
        if begin <= t < end:
            for b in range(bins):
                at = (bins - 1) * (t - begin) / (end - begin)
                out[b, y, x] += (1 if p else -1) * max(0.0, 1 - abs(b - at))
    return out


def normalised(grid):
    values = grid[grid != 0]
    out = grid.copy()
    out[grid != 0] = (values - values.mean()) / values.std()
    return out


def counts(events, begin, end):
    out = np.zeros((2, events.height, events.width))
    for t, x, y, p in zip(events.t, events.x, events.y, events.p, strict=True):
        out[int(p), y, x] += begin <= t < end
    return out


def histogram(events, bins, begin, end, cutoff):
    out = np.zeros((2, bins, events.height, events.width))
    for t, x, y, p in zip(events.t, events.x, events.y, events.p, strict=True):
        for b in range(bins):
            first, last = (begin + (end - begin) * n / bins for n in (b, b + 1))
            out[int(p), b, y, x] += first <= t < last
    return np.minimum(out, cutoff).reshape(2 * bins, events.height, events.width)


def time_surface(events, tau, begin, now):
    out = np.zeros((2, events.height, events.width))
    for t, x, y, p in zip(events.t, events.x, events.y, events.p, strict=True):
        if begin <= t < now:
            out[int(p), y, x] = math.exp(-(now - t) / tau)
    return out


def last_polarity(events, begin, end):
    out = np.zeros((1, events.height, events.width))
    for t, x, y, p in zip(events.t, events.x, events.y, events.p, strict=True):
        if begin <= t < end:
            out[0, y, x] = 1 if p else -1
    return out


def averaged_time_surface(events, tau, span, cell, surface, begin, end):
    rows, columns, reach = events.height // cell, events.width // cell, surface // 2
    out = np.zeros((2, surface, surface, rows, columns))
    number = np.zeros((2, rows, columns))
    all_of_them = [
        (t, int(x), int(y), int(p))
        for t, x, y, p in zip(events.t, events.x, events.y, events.p, strict=True)
        if begin <= t < end and y // cell < rows and x // cell < columns
    ]
    for i, (t, x, y, p) in enumerate(all_of_them):
        number[p, y // cell, x // cell] += 1
        for s, u, v, q in all_of_them[:i]:
            same = q == p and u // cell == x // cell and v // cell == y // cell
            if same and t - s <= span and abs(u - x) <= reach and abs(v - y) <= reach:
                out[p, v - y + reach, u - x + reach, y // cell, x // cell] += math.exp(-(t - s) / tau)
    out /= np.maximum(number, 1)[:, None, None]
    return out.reshape(2 * surface**2, rows, columns)
