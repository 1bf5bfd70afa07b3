"""What a pixel does, as statements: photoreceptor, change detector, events.

A program is made once from the stages of a sensor. It says in which order things happen; how many pixels a
thread works on, and what surrounds the samples, is added by those who print it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from dase.kernels.pixel_codegen import (
    Block,
    Draw,
    Guarded,
    Line,
    Part,
    Statement,
    draws_of,
    if_block,
    lines,
)
from dase.kernels.pixel_codegen_events import noise_key, redraw_thresholds, sleep_condition, step_events
from dase.kernels.pixel_codegen_model import PixelModel
from dase.kernels.random import stream_number

VOLTAGE = "voltage = logarithm(Lane(intensity), log_eps)[0]"
"""Line that takes the logarithm of the light of one pixel."""


@dataclass(frozen=True)
class Program:
    """What a pixel does.

    Args:
        model: What it was made from.
        light: From what is seen to what reaches the photodiode.
        respond: From the logarithm of the light to the photoreceptor's voltage.
        change: From the voltage to the change since the last event at both ends of the step.
        asleep: What must be known before it is clear whether a step can have events.
        busy: On which condition it can.
        events: Events of such a step.
        settle: What is left when the step is over.
        begin: Thresholds and memories at the begin of a chunk.
        draws: Random numbers of all these.
    """

    model: PixelModel
    light: tuple[Part, ...]
    respond: tuple[Part, ...]
    change: tuple[Part, ...]
    asleep: tuple[Statement, ...]
    busy: str
    events: tuple[Statement, ...]
    settle: Part
    begin: tuple[Statement, ...]
    draws: tuple[Draw, ...]


def pass_through(model: PixelModel, stage: str, quantity: str) -> tuple[Part, ...]:
    """Return the parts that pass a quantity through all functions of a stage, which may change states."""
    parts = []
    for effect, call in model.calls(stage):
        results = ", ".join([quantity, *(f"{effect.name}_{state}" for state in effect.states)])
        # a part of its own: a function without branches becomes vectors, whatever its neighbours do
        parts.append(Part((Guarded(effect, (Line(f"{results} = {call.text}", call.draws),)),)))
    return tuple(parts)


def intensity_of_log(model: PixelModel) -> tuple[Part, ...]:
    """Return the part that works intensities out where log intensities are seen and effects ask for more.

    Raises:
        ValueError: An effect works on light, which is not there.
    """
    if model.source != "log":
        return ()
    if model.of("light") or model.of("current"):
        raise ValueError("effects on light need intensities, not log intensities")
    if not model.asks("intensity", "illumination", stages=("respond", "drift", "noise", "delay")):
        return ()
    # before the photoreceptor changes the voltage
    return (Part(lines("intensity = exponential(voltage) - log_eps")), *_keep_illumination(model))


def _keep_illumination(model: PixelModel) -> tuple[Part, ...]:
    """Return the part that keeps the light before currents of the dark are added, none if nobody asks."""
    return (Part(lines("illumination = intensity + 0.0")),) if model.asks("illumination") else ()


def assign_thresholds(model: PixelModel) -> tuple[Statement, ...]:
    """Return the statements that work out the thresholds of a pixel."""
    return tuple(
        Guarded(effect, (Line(f"on, off = {call.text}", call.draws),))
        for effect, call in model.calls("threshold")
    )


def pixel_places(model: PixelModel) -> tuple[Statement, ...]:
    """Return the statements of what depends on where a pixel `i` at column `x` and row `y` is."""
    found = [f"{name} = maps[{at}, i]" for at, name in enumerate(model.maps)]
    # a square root for each pixel, which most sensors do not need
    if model.asks("radius"):
        found += [
            "middle = wp.vec2(float(x) - 0.5 * float(width - 1), float(y) - 0.5 * float(height - 1))",
            "radius = 2.0 * wp.length(middle) / wp.length(wp.vec2(float(width), float(height)))",
        ]
    return lines(*found)


def numbers_drawn_once(draws: Iterable[Draw]) -> tuple[Draw, ...]:
    """Return the random numbers that a pixel draws once."""
    return tuple(draw for draw in draws if draw.per_pixel)


def take_numbers(draws: Iterable[Draw]) -> tuple[Statement, ...]:
    """Return the statements that make the keys of a pixel's streams, and take what was drawn before."""
    draws = tuple(draws)
    once = numbers_drawn_once(draws)
    keys = (f"{d.key} = key(seed, {stream_number(d.name)}, pixel)" for d in draws if not d.per_pixel)
    return lines(*keys, *(f"{draw.name} = numbers[{at}, i]" for at, draw in enumerate(once)))


def draw_numbers(draws: Iterable[Draw], *, presets: bool = False) -> tuple[Statement, ...]:
    """Return the statements that make the keys of a pixel's streams, and its numbers that are drawn once.

    Args:
        draws: Random numbers that are asked for.
        presets: Whether keys are made and numbers drawn only where their effect acts, which most do not.
    """
    found: list[Statement] = []
    for draw in draws:
        made = [Line(f"{draw.key} = key(seed, {stream_number(draw.name)}, pixel)")]
        made += [Line(f"{draw.name} = {draw.kind}({draw.key}, 0)")] if draw.per_pixel else []
        if presets and draw.effect is not None and draw.effect.off:
            # a name must have a value on every way through a Warp kernel
            found.append(Line(f"{draw.key} = int(0)"))
            found += [Line(f"{draw.name} = float(0.0)")] if draw.per_pixel else []
            found.append(Guarded(draw.effect, tuple(made)))
        else:
            found += made
    return tuple(found)


def all_draws(*parts: Iterable[Part | Statement]) -> tuple[Draw, ...]:
    """Return the random numbers of parts and statements, in the order of the text."""
    found: list[Statement] = []
    for some in parts:
        for one in some:
            found += one.body if isinstance(one, Part) else (one,)
    return draws_of(found)


def make_program(model: PixelModel) -> Program:
    """Return what a pixel does."""
    light = pass_through(model, "light", "intensity")
    light += _keep_illumination(model) if model.source != "log" else ()
    light += pass_through(model, "current", "intensity")
    respond = pass_through(model, "respond", "voltage")
    if model.asks("before", stages=("respond",)):
        respond = (Part((_change(model, "before", "signal"),)), *respond)
    change = change_since_event(model)
    asleep, busy = sleep_condition(model)
    events, settle, begin = step_events(model), settle_step(model), begin_chunk(model)
    # in the order in which a kernel works through them
    draws = all_draws(light, respond, change, asleep, events, settle.body, begin)
    return Program(model, light, respond, change, asleep, busy, events, settle, begin, draws)


def change_since_event(model: PixelModel) -> tuple[Part, ...]:
    """Return the parts from the voltage to the change since the last event at both ends of the step."""
    # rest ends at the first sample: no time passes in which anything could leak or fire
    parts = [
        Part(_first_sample(model), when=("sample == 0",), then=lines("dt = 0.0")),
        Part(_drift(model)),
        Part(_start_phase(model), when=("sample == 1", "phase != 0.0")),
    ]
    if model.of("noise"):
        parts.append(Part(_spend_noise(model)))
    return tuple(parts)


def _change(model: PixelModel, name: str, end: str, *, leaks: bool = True) -> Line:
    """Return the line that sets `name` to the change of the signal `end` since the pixel's last event."""
    return Line(f"{name} = {end} - reference" + (" + leaked" if leaks and "leaked" in model.states else ""))


def _first_sample(model: PixelModel) -> tuple[Statement, ...]:
    """Take the first sample as it is."""
    found: list[Statement] = [*lines("signal = voltage", "reference = voltage")]
    # no pixel begins dead
    found += lines("age = 1.0e6") if "age" in model.states else ()
    for effect, _ in model.of("noise"):
        draw = noise_key(effect)
        found.append(Line(f"{effect.name}_hazard = waiting({draw.key}, 0)", (draw,)))
        found.append(Line(f"{effect.name}_events = 1.0"))
    return tuple(found)


def _drift(model: PixelModel) -> tuple[Statement, ...]:
    """Let the leaks of the step pass, between the changes before and after it."""
    leaks = [
        Guarded(
            effect,
            (
                # what rounding loses of a short step is kept for the next (Kahan), or slow leaks would stall
                Line(f"leak = {call.text} * dt + leaked_rest", call.draws),
                *lines("total = leaked + leak", "leaked_rest = leak - (total - leaked)", "leaked = total"),
            ),
        )
        for effect, call in model.calls("drift")
    ]
    return (
        _change(model, "before", "signal"),
        *(lines("leaked_before = leaked + 0.0") if model.labelled else ()),
        *leaks,
        _change(model, "after", "voltage"),
    )


def _start_phase(model: PixelModel) -> tuple[Statement, ...]:
    """Spread the memories at the start as if the first change had been going on before."""
    draw = Draw("initial_phase", "uniform")
    falls = f"after < 0.0 or (after == 0.0 and uniform({draw.key}, 1) < 0.5)"
    # a pixel that starts half way is done with half of the way, whatever of it the leak will make
    off = ["reference += lead * off", *(["drained -= 0.5 * lead * off"] if model.labelled else [])]
    on = ["reference -= lead * on", *(["drained += 0.5 * lead * on"] if model.labelled else [])]
    return (
        Line(f"lead = phase * uniform({draw.key}, 0)", (draw,)),
        Block(f"if {falls}:", lines(*off), lines(*on), draws=(draw,)),
        _change(model, "before", "signal", leaks=False),  # nothing has leaked before the second sample
        _change(model, "after", "voltage"),
    )


def _spend_noise(model: PixelModel) -> tuple[Statement, ...]:
    """Work out what of its waiting time each noise spends in the step."""
    found: list[Statement] = []
    for effect, call in model.calls("noise"):
        n = effect.name
        if model.outlet.presets_noise:
            found += lines(*(f"{n}_{name} = float(0.0)" for name in ("on", "off", "spend")))
        # the hazard of a Poisson process: an event comes when what is waited for is spent
        spend = Line(f"{n}_spend = ({n}_on + {n}_off) * dt + {n}_rest")
        found.append(Guarded(effect, (Line(f"{n}_on, {n}_off = {call.text}", call.draws), spend)))
    return tuple(found)


def settle_step(model: PixelModel) -> Part:
    """Return what is left when the step is over."""
    found: list[Statement] = []
    for effect, _ in model.of("noise"):
        n = effect.name
        # the rest that rounding loses is kept here, too (Kahan)
        rest = lines(
            f"{n}_left = {n}_hazard - {n}_spend",
            f"{n}_rest = {n}_spend - ({n}_hazard - {n}_left)",
            f"{n}_hazard = {n}_left",
        )
        found.append(Guarded(effect, rest))
    found.append(Line("signal = voltage"))
    found += lines("age += dt") if "age" in model.states else ()
    return Part(tuple(found))


def begin_chunk(model: PixelModel) -> tuple[Statement, ...]:
    """Return the statements that set thresholds and memories at the begin of a chunk."""
    # thresholds depend on seed and pixel only: to work them out again costs less than to keep them
    found = [*assign_thresholds(model), *lines(*(f"{name} = float(0.0)" for name in model.states))]
    if model.outlet.resumes:
        kept = (f"{name} = state_in[{at}, row, i]" for at, name in enumerate(model.states))
        found.append(if_block("begin > 0", *kept))
    elif "leaving" in model.states:
        found.append(Line("leaving = 0.0"))
    redraws = redraw_thresholds(model)
    # thresholds scatter about the pixel's own, which are kept for that
    found += [*lines("mean_on = on", "mean_off = off"), *redraws] if redraws else []
    if "leaving" in model.states and model.sink != "counts":
        # the state holds the bits of whole nanoseconds, which float32 would round
        found.append(Line("leaves = wp.int64(wp.cast(leaving, wp.int32))"))
    return tuple(found)


def zero_counts(model: PixelModel) -> tuple[Part, ...]:
    """Return the part that begins to count a window, none where events are kept one by one."""
    return (Part(lines("on_count = int(0)", "off_count = int(0)")),) if model.sink == "counts" else ()


def put_counts(model: PixelModel) -> tuple[Part, ...]:
    """Return the part that hands the counts of a window over."""
    if model.sink != "counts":
        return ()
    body = lines("sink.counts[row, window, 0, i] = off_count", "sink.counts[row, window, 1, i] = on_count")
    return (Part(body, when=("window >= 0",), handover=True),)


def keep_states(model: PixelModel) -> Part:
    """Return the part that keeps what the next chunk needs."""
    leaving = "leaving = wp.cast(wp.int32(wp.max(leaves - clock.span, wp.int64(0))), float)"
    kept = [f"state_out[{at}, row, i] = {name}" for at, name in enumerate(model.states)]
    # counts know no times, so nobody asks when an event has left
    counts = "leaving" not in model.states or model.sink == "counts"
    return Part(lines(*kept) if counts else lines(leaving, *kept), handover=True)
