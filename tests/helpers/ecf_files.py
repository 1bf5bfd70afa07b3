"""Events packed as the codec ECF of HDF5 packs them, number by number."""

from __future__ import annotations

import struct
from itertools import pairwise

import numpy as np


def ecf_buffer(t, x, y, p, mode):
    """One ECF buffer; mode 2 packs all, 1 columns and polarities, 0 nothing."""
    out = struct.pack("<IQ", len(t) << 2 | mode, t[0]) + _ecf_times(t)
    if mode == 2:
        v = y.astype(np.int64) << 12 | x.astype(np.int64) << 1 | p
        a, b, c, d = np.pad(v, (0, -len(v) % 4)).reshape(-1, 4).T
        words = [a << 8 | b & 0xFF, b >> 8 << 16 | c & 0xFFFF, c >> 16 << 24 | d & 0xFFFFFF]
        return out + np.stack(words, axis=1).astype("<u4").tobytes()
    out += _ecf_runs(y, "<H", 5)
    if mode == 1:
        v = x.astype(np.int64) << 1 | p
        a, b, c, d = np.pad(v, (0, -len(v) % 4)).reshape(-1, 4).T
        words = [a << 4 | b & 0xF, b >> 4 << 8 | c & 0xFF, c >> 8 << 12 | d & 0xFFF]
        return out + np.stack(words, axis=1).astype("<u2").tobytes()
    k = 0
    while k < len(x):
        base, mask = int(x[k]), 0
        k += 1
        for j in range(5):
            if k < len(x) and x[k] == base + j + 1:
                mask |= 1 << (4 - j)
                k += 1
        out += struct.pack("<H", base << 5 | mask)
    return out + _ecf_runs(p, "<B", 7)


def _ecf_times(t):
    out, now = bytearray(), int(t[0])
    for value, count in _runs(t):
        step, now = value - now, value
        if step > 14:
            while step:  # the low four bits first
                out.append(0xF0 | step & 15)
                step >>= 4
        out += bytes([step << 4 | count]) if count < 15 else struct.pack("<BH", step << 4 | 15, count)
    return bytes(out)


def _ecf_runs(values, kind, bits):
    out, most = b"", (1 << bits) - 1
    for value, count in _runs(values):
        out += struct.pack(kind, value << bits | min(count, most))
        out += struct.pack("<H", count) if count >= most else b""
    return out


def _runs(values):
    values = values.astype(np.int64)
    edges = np.concatenate(([0], np.flatnonzero(np.diff(values)) + 1, [len(values)]))
    return [(int(values[i]), int(j - i)) for i, j in pairwise(edges)]
