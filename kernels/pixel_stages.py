"""The effects of a sensor, composed into one kernel per pixel.

A pixel turns light into events in this order; each effect adds Warp functions at some of these stages:

    light      (intensity, ...)           -> intensity            what reaches the photodiode
    current    (intensity, ...)           -> intensity            what flows in it, as the light that makes it
    log        voltage = log(intensity + log_eps)
    respond    (voltage, intensity, log_eps, ...) -> voltage      photoreceptor; it may ask for the voltage at
               the end of the last step, `signal`, for what that is above the memory, `before`, and for the
               thresholds
    threshold  (on, off, ...)             -> on, off              once per pixel [log intensity]
    redraw     (on, off, ...)             -> on, off              anew after each event; random numbers too
    drift      (intensity, on, off, ...)  -> drift                of the change towards ON [log intensity/s]
    noise      (intensity, on, off, ...)  -> rate_on, rate_off    of events without a change [Hz]
               both may also ask for the illumination: the light alone, without currents of the dark
    count      exact threshold crossings of the change since the last event
    gate       (age, fired_on, ...)       -> wait                 time the pixel stays dead [s]
    delay      (intensity, polarity, ...) -> delay                until the event leaves the pixel [s]

A stage function asks for what it needs by the names of its arguments: the quantities above, `t`, `dt`, `x`,
`y`, `t64` (t in double precision, for phases of long recordings), `radius` (distance from the middle of the
sensor to its corner is 1), `nominal_on`, `nominal_off` (thresholds before any effect), `dark_current` (what
the effect `dark` lends all others, 0 where it lends nothing), parameters and states of its effect, random
numbers (`uniform`, `normal`: new ones at every sample; `pixel_uniform`, `pixel_normal`: one for each pixel;
`_2` and so on for more), maps of its effect (one value for each pixel). It returns its quantity, then the new
values of its states.
`dase.kernels.pixel_compile` makes the kernel that calls all of them, one line each, so that a sensor costs
one pass over its samples whatever effects it has. Random numbers are counter-based, keyed by seed, effect,
pixel and sample: they do not depend on the other effects, on chunks, threads or the batch.
"""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import warp as wp

from dase.kernels.scene_layers import Frames as Frames

REST = 1e30
"""Duration of the step that ends at the first sample [s], so that filters start settled."""

LATEST = 1.0
"""Longest time from a crossing to its event's leaving the pixel [s]."""


class Label(IntEnum):
    """What events come from, as the change detector knows it: places in `dase.events.LABELS`."""

    SIGNAL = 0
    LEAK = 1
    SHOT = 2


STAGES = ("light", "current", "respond", "threshold", "redraw", "drift", "noise", "gate", "delay")
CORE = ("on", "off", "phase", "log_eps")
"""Parameters of the change detector itself; they lead the parameter vector."""

QUANTITIES = {
    "light": ("intensity",),
    "current": ("intensity",),
    "respond": ("voltage", "intensity", "log_eps", "signal", "before", "on", "off"),
    "threshold": ("on", "off"),
    "redraw": ("on", "off"),
    "drift": ("intensity", "illumination", "on", "off"),
    "noise": ("intensity", "illumination", "on", "off"),
    "gate": ("age", "fired_on"),
    "delay": ("intensity", "polarity"),
}
"""What the functions of a stage may ask for beside parameters, states, random numbers and `ANYWHERE`."""

ANYWHERE = ("x", "y", "t", "dt", "t64", "radius", "nominal_on", "nominal_off")
"""What the functions of every stage may ask for; `t`, `dt` and `t64` only where there are samples."""

LENT = ("dark_current",)
"""What they may ask for of another effect, as `effect_parameter`; 0 where none of the sensor lends it."""


@dataclass(frozen=True)
class EffectStages:
    """The part of an effect that the composer sees.

    Args:
        name: Of the effect, a Python identifier.
        functions: (stage, Warp function) pairs.
        parameters: Names, in the order of their places in the parameter vector.
        states: Names of what a pixel remembers from sample to sample; all zero at the start.
        delays: Whether the events that `gate` holds back come later; otherwise they are lost.
        resets: Whether the pixel memorises the signal at the end of the time for which `gate` holds it.
        spares_noise: Whether events that `noise` makes pass `gate`, and begin no dead time.
        label: Of the events that `noise` makes.
        off: (parameter, value) pairs; an effect with all of them changes nothing.
        maps: Names of quantities that every pixel has its own value of, handed over as arrays.
        lends: Names of the parameters that functions of other effects follow, see `LENT`.
    """

    name: str
    functions: tuple[tuple[str, Any], ...]
    parameters: tuple[str, ...] = ()
    states: tuple[str, ...] = ()
    delays: bool = False
    resets: bool = False
    spares_noise: bool = False
    label: int = Label.SHOT
    off: tuple[tuple[str, float], ...] = ()
    maps: tuple[str, ...] = ()
    lends: tuple[str, ...] = ()


@wp.struct
class SampleClock:
    """Time samples of one chunk; sample k ends the step that begins at sample k - 1."""

    t: wp.array[float]  # (K,) [s]
    t64: wp.array[wp.float64]  # (K,) [s]
    dt: wp.array[float]  # (K,) [s], REST at the first sample of all
    begin: wp.array[wp.int64]  # (K,) begin of the step [ns since the chunk's begin]
    length: wp.array[float]  # (K,) duration of the step [ns]
    span: wp.int64  # of the chunk [ns]
    run: wp.array[int]  # (R + 1,) samples at which runs of one window begin, and K
    window: wp.array[int]  # (R,) window that a run is counted in; -1 for none


@wp.struct
class EventCounts:
    """Sink that counts events."""

    counts: wp.array4d[int]  # (B, W, 2, N) OFF, ON


@wp.struct
class EventKeys:
    """Sink that keeps every event as one sortable 64-bit key: time, place, polarity, label if asked for."""

    keys: wp.array3d[wp.int64]  # (B, slabs, capacity)
    used: wp.array2d[int]  # (B, slabs) events met; more than the capacity asks for another run
    # where a thread has one pixel: what a sample gives after its first event waits here for its end
    later: wp.array3d[wp.int64]  # (B, slabs, room · pixels of a slab), all second events, then all third ones
    most: wp.array[int]  # (1,) events of a pixel in a sample, where there were more than 1 + room
    room: int  # later events of a pixel
    slab: int  # pixels per slab, as a power of 2
    bits: int  # of row · N + i
    low: int  # bits below: 1 of the polarity, 2 more of the label


@wp.func_native("return a.data[k];")
def array_element(a: wp.array[float], k: int) -> float:
    """Return a[k]; Warp's own look-up asks whether k is negative, in the innermost loop."""
    ...


@wp.func_native(
    "return *(const float*)((const char*)a.data + (size_t)k * (size_t)a.strides[0] + 4 * (size_t)i);"
)
def stored_sample(a: wp.array2d[float], k: int, i: int) -> float:
    """Return a[k, i], as `array_element` does."""
    ...


@wp.func
def leaving_time(clock: SampleClock, k: int, at: float, late: float) -> wp.int64:
    """When an event of the share `at` of step k leaves, `late` [s] after it [ns since the chunk's begin]."""
    time = clock.begin[k] + wp.int64(wp.min(at * clock.length[k], clock.length[k]))
    return time + wp.int64(wp.round(late * 1.0e9))


@wp.func_native(
    """
    const int slab = i >> shift;
    int* met = used.data + row * used.shape[1] + slab;
#ifdef __CUDA_ARCH__
    const int slot = atomicAdd(met, 1);
#else
    const int slot = (*met)++;  // a slab has one thread
#endif
    if (slot < keys.shape[2]) keys.data[((size_t)row * keys.shape[1] + slab) * keys.shape[2] + slot] = key;
"""
)
def append_key(
    keys: wp.array3d[wp.int64], used: wp.array2d[int], row: int, i: int, shift: int, key: wp.int64
):
    """Append a key to those of the pixel's slab, keys (B, slabs, room), used (B, slabs), or only count it."""
    ...


@wp.func
def key_of(sink: EventKeys, row: int, i: int, size: int, time: wp.int64, code: int) -> wp.int64:
    """Return the key of an event that leaves its pixel at `time` [ns since the chunk's begin]."""
    place = wp.int64(row) * wp.int64(size) + wp.int64(i)
    place |= time << wp.int64(sink.bits)
    return (place << wp.int64(sink.low)) | wp.int64(code)


@wp.func
def deposit_event(sink: EventKeys, row: int, i: int, size: int, time: wp.int64, code: int):
    """Keep one event that leaves its pixel at `time` [ns since the chunk's begin]."""
    append_key(sink.keys, sink.used, row, i, sink.slab, key_of(sink, row, i, size, time, code))


@wp.func_native(
    """
    const int slab = i >> shift;
    const size_t plane = ((size_t)row * later.shape[1] + slab) * room + number;
    later.data[(plane << shift) + (i - (slab << shift))] = key;
"""
)
def put_later_key(
    later: wp.array3d[wp.int64], room: int, number: int, row: int, i: int, shift: int, key: wp.int64
):
    """Write the later key of this number, from 0 on and below `room`; later (B, slabs, room · pixels)."""
    ...


@wp.func
def hold_event(
    sink: EventKeys, row: int, i: int, size: int, time: wp.int64, code: int, held: int, first: wp.int64
) -> wp.int64:
    """Hold an event that leaves at `time` [ns since the chunk's begin] until the end of its sample.

    Returns:
        Key of the sample's first event, which stays in a register: most samples have no other.
    """
    key = key_of(sink, row, i, size, time, code)
    if held == 0:
        return key
    if held <= sink.room:
        put_later_key(sink.later, sink.room, held - 1, row, i, sink.slab, key)
    return first


@wp.func_native(
    """
    const int slab = i >> shift;
    int* met = used.data + row * used.shape[1] + slab;
#ifdef __CUDA_ARCH__
    const int slot = atomicAdd(met, held);
    if (held > room + 1) atomicMax(most.data, held);
#else
    const int slot = *met;  // a slab has one thread
    *met += held;
    if (held > room + 1 && held > most.data[0]) most.data[0] = held;
#endif
    const int capacity = keys.shape[2];
    long long* to = keys.data + ((size_t)row * keys.shape[1] + slab) * capacity;
    if (slot < capacity) to[slot] = first;
    const size_t plane = ((size_t)row * later.shape[1] + slab) * room;
    for (int n = 1; n < held && n <= room && slot + n < capacity; ++n)
        to[slot + n] = later.data[((plane + n - 1) << shift) + (i - (slab << shift))];
"""
)
def append_held(
    keys: wp.array3d[wp.int64],
    used: wp.array2d[int],
    later: wp.array3d[wp.int64],
    most: wp.array[int],
    room: int,
    row: int,
    i: int,
    shift: int,
    held: int,
    first: wp.int64,
):
    """Append the events of a sample to those of the pixel's slab, keys (B, slabs, capacity): `EventKeys`."""
    ...


@wp.func
def keep_held(sink: EventKeys, row: int, i: int, held: int, first: wp.int64):
    """Keep the events of a sample, of which there is at least one."""
    append_held(sink.keys, sink.used, sink.later, sink.most, sink.room, row, i, sink.slab, held, first)


SINKS = {"counts": EventCounts, "keys": EventKeys, "labels": EventKeys}


def states(stages: Sequence[EffectStages], sink: str = "keys") -> list[str]:
    """Return the names of what a pixel with these effects remembers, in the order of the state array."""
    kinds = {stage for effect in stages for stage, _ in effect.functions}
    names = ["signal", "reference"]
    names += ["leaked", "leaked_rest"] if "drift" in kinds else []
    names += ["age"] if "gate" in kinds else []
    names += ["fired_on"] if _gates_ask(stages, "fired_on") else []
    names += ["redraws"] if "redraw" in kinds else []
    names += ["leaving"] if "delay" in kinds else []
    names += ["drained"] if "drift" in kinds and sink == "labels" else []
    for effect in stages:
        if any(stage == "noise" for stage, _ in effect.functions):
            names += [f"{effect.name}_hazard", f"{effect.name}_rest", f"{effect.name}_events"]
        names += [f"{effect.name}_{state}" for state in effect.states]
    return names


def _gates_ask(stages: Sequence[EffectStages], quantity: str) -> bool:
    gates = [f for effect in stages for stage, f in effect.functions if stage == "gate"]
    return any(quantity in inspect.signature(gate.func).parameters for gate in gates)
