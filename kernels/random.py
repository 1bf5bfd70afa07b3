"""Counter-based random numbers: the same whatever chunks, threads, batches and other effects there are."""

from __future__ import annotations

import zlib

import warp as wp


def stream_number(name: str) -> int:
    """Return the number of a named stream of random numbers, a 31-bit hash."""
    return zlib.crc32(name.encode()) & 0x7FFFFFFF


@wp.func
def stream_key(seed: int, stream: int, pixel: int) -> int:
    """Key of one stream of random numbers of one pixel."""
    return int(wp.rand_init(seed ^ stream, pixel))


@wp.func
def uniform(key: int, index: int) -> float:
    """Uniform in [0, 1)."""
    return wp.randf(wp.rand_init(key, index))


@wp.func
def normal(key: int, index: int) -> float:
    """Standard normal."""
    return wp.randn(wp.rand_init(key, index))


@wp.func
def unit_exponential(key: int, index: int) -> float:
    """Exponential with mean 1: the hazard a Poisson process spends before its next event."""
    return -wp.log(1.0 - uniform(key, index))
