"""What becomes of a step that has events: crossings, noise events, dead times, delays.

Times within a step are shares of it, 0 at the sample before and 1 at the present one. The change since the
last event runs straight from `before` to `after`; `moved` is what the events of this step have taken off it
so far [log intensity].

There are three rules for crossings in the dead time of a pixel: they are lost although its memory follows
them; they come when it ends; or, as in a real pixel, the change detector is held in reset meanwhile, so that
it begins with the signal at the share `at` at which the dead time ends.
"""

from __future__ import annotations

from dase.kernels.pixel_codegen import Block, Draw, Guarded, Line, Statement, if_block, lines
from dase.kernels.pixel_codegen_model import PixelModel
from dase.kernels.pixel_stages import LATEST, EffectStages, Label

Statements = tuple[Statement, ...]


def count_on(name: str) -> Line:
    """Return the line that counts an event in a float32.

    States are float32, in which a count comes to a halt at 2^24. This one starts anew before, whereupon the
    random numbers that it indexes repeat.
    """
    return Line(f"{name} = wp.where({name} < 8388608.0, {name} + 1.0, 1.0)")


def noise_key(effect: EffectStages) -> Draw:
    """Return the stream of an effect's noise events: when they come."""
    return Draw(f"{effect.name}_noise", "uniform", effect)


def redraw_thresholds(model: PixelModel) -> Statements:
    """Return the statements that draw thresholds about the pixel's own ones."""
    return tuple(
        Guarded(effect, (Line(f"on, off = {call.text}", call.draws),))
        for effect, call in model.calls("redraw")
    )


def thresholds_after_event(model: PixelModel) -> Statements:
    """Return the statements that draw new thresholds after an event, none without such an effect."""
    anew = redraw_thresholds(model)
    return (count_on("redraws"), *lines("on = mean_on", "off = mean_off"), *anew) if anew else ()


def sleep_condition(model: PixelModel) -> tuple[Statements, str]:
    """Return when a step can have events.

    Returns:
        Statements that set `asleep` to the rest of the dead time [s], none unless its end matters, and let
        pixels that are held in reset follow the signal; and the condition.
    """
    crossed = "after >= on or after <= -off"
    asleep: list[Statement] = []
    if model.delays or model.resets:
        asleep.append(Line("asleep = float(0.0)"))
        for effect, call in model.calls("gate"):
            asleep.append(Guarded(effect, (Line(f"asleep = wp.max(asleep, {call.text})", call.draws),)))
    if model.resets:
        # seen to in all steps alike: the end of a dead time has no event, and a step that counts as busy is
        # dear, on a GPU for all pixels of a group
        gates = tuple(effect for effect, _ in model.calls("gate"))
        # lanes of which none has a dead time are spared a division, behind which their next sample waited
        asked = gates if all(effect.off for effect in gates) else ()
        asleep.append(Block("if asleep > 0.0:", tuple(_follow_signal(model)), acting=asked))
    if model.delays:
        # a crossing that waits for the end of the dead time may come although the signal returns
        crossed += " or before >= on or before <= -off"
        # a leak is taken off the reference where there are events, so that it must not sleep
        # one whose dead time ends with the step must not miss it by rounding: hence a little more than dt
        awake = "asleep <= 1.0001 * dt" + (" or leaked != 0.0" if "leaked" in model.states else "")
        crossed = f"({crossed}) and ({awake})"
    noisy = [f"{effect.name}_spend > {effect.name}_hazard" for effect, _ in model.of("noise")]
    return tuple(asleep), " or ".join([crossed, *noisy])


def step_events(model: PixelModel) -> Statements:
    """Return the events of a step that has any: crossings, cut at the noise events between them."""
    noisy = [effect for effect, _ in model.of("noise")]
    found: list[Statement] = [*lines("moved = float(0.0)", "begun = float(0.0)")]
    if model.resets:
        found += [Line("at = float(0.0)"), if_block("asleep > 0.0", "at = asleep / dt")]
    if noisy:
        found.append(Block("while begun < 1.0:", _until_noise(model, noisy)))
    else:
        found += [*lines("stop = 1.0", "value = after"), *_crossings(model)]
    found.append(Line("reference += moved"))
    if "leaked" in model.states:
        found += lines("drained += leaked") if model.labelled else ()
        # keeps `leaked` small, where float32 resolves slow leaks
        found += lines("reference -= leaked", "leaked = 0.0")
    return tuple(found)


def _until_noise(model: PixelModel, noisy: list[EffectStages]) -> Statements:
    """Return the crossings up to the next noise event, and that event."""
    found: list[Statement] = [*lines("stop = float(1.0)", "cause = int(0)")]
    for number, effect in enumerate(noisy, start=1):
        n = effect.name
        # compared as products first: most steps have no noise event, and a division takes long
        sooner = f"{n}_spend > {n}_hazard and {n}_hazard < stop * {n}_spend"
        found.append(if_block(sooner, f"stop = {n}_hazard / {n}_spend", f"cause = {number}"))
    found += [Line("value = after"), if_block("cause != 0", "value = before + (after - before) * stop")]
    found += _crossings(model)
    for number, effect in enumerate(noisy, start=1):
        found.append(if_block(f"cause == {number}", *_noise_event(model, effect)))
    return (*found, Line("begun = stop"), if_block("cause == 0", "break"))


def _crossings(model: PixelModel) -> Statements:
    """Return the exact crossings between `begun` and `stop`, times interpolated; Eqs. (2)-(4) of the paper.

    Where events wait for the end of a dead time, `at` is how far the pixel has come: crossings from before
    `begun` come first, when it is awake again.
    """
    found: list[Statement] = []
    if model.delays:
        found += [Line("at = begun + 0.0"), *_pending_crossings(model)]
    found += [
        *lines("change = value - moved", "theta = on", "polarity = int(1)"),
        if_block("change < 0.0", "theta = -off", "polarity = 0"),
        Line("crossed = int(whole(wp.abs(change), wp.abs(theta), 1.0 / wp.abs(theta)))"),
        *(lines("passed = int(0)") if model.delays else ()),
    ]
    # the dearer ways only for sensors that need them
    if model.resets:
        found += _crossings_between_resets(model)
    elif model.of("redraw"):
        found += _crossings_one_by_one(model)
    elif model.sink == "counts" and not model.of("gate"):
        # nobody asks when they happened
        found += lines("on_count += polarity * crossed", "off_count += (1 - polarity) * crossed")
        found += lines("moved += float(crossed) * theta")
    else:
        passed = "crossed"
        label, asked = _label_crossing(model, "share")
        if model.delays:
            passed = "passed"
            found.append(if_block("at > stop", "crossed = 0"))
            event = (*_wait_for_gate(model), Line("passed += 1"), *asked, *_event(model, "share", label))
        else:
            event = (*asked, *_unless_dead(model, "share", label))
        # all crossings of a step have one threshold, so their number is known before the loop
        body = (*_crossing_time(model, "n"), *event, *_memorise_leak(model))
        found += [Block("for n in range(crossed):", body), Line(f"moved += float({passed}) * theta")]
    return tuple(found)


def _crossings_one_by_one(model: PixelModel) -> Statements:
    """Return crossings with thresholds drawn anew; equal ones are counted as without drawing, bit for bit."""
    label, asked = _label_crossing(model, "share")
    if model.delays:
        found = [if_block("at > stop", "crossed = 0")]
        event = (*_wait_for_gate(model), *asked, *_event(model, "share", label))
    else:
        found = [*lines("passed = int(0)")]
        event = (*asked, *_unless_dead(model, "share", label))
    body = (
        *_crossing_time(model, "passed"),
        *event,
        *lines("passed += 1"),
        *_memorise_leak(model),
        *thresholds_after_event(model),
        *_take_drawn_threshold(),
    )
    return (*found, Block("while passed < crossed:", body), Line("moved += float(passed) * theta"))


def _take_drawn_threshold() -> Statements:
    """Return the statements by which crossings go on with the threshold that was drawn after an event."""
    return (
        Line("drawn = on"),
        if_block("polarity == 0", "drawn = -off"),
        # products of equal thresholds are not summed up one by one, which would round differently
        if_block(
            "drawn != theta",
            "moved += float(passed) * theta",
            "passed = 0",
            "theta = drawn",
            "crossed = int(wp.floor((value - moved) / theta))",
        ),
    )


def _follow_signal(model: PixelModel) -> Statements:
    """Return the statements by which the memory of a pixel in reset is the signal, up to the end of that.

    What is left of the step is seen from the new memory. One that sleeps on sees no change at all.
    """
    return (
        *lines("until = wp.min(asleep / dt, 1.0)", "shift = before + (after - before) * until"),
        *lines("reference += shift", "before -= shift", "after -= shift"),
        *(lines("slipped = leaked_before + (leaked - leaked_before) * until") if model.labelled else ()),
        *_memorise_leak(model),
    )


def _memorise_at_end(model: PixelModel, share: str) -> Statements:
    """Return the statements for a dead time that ends at a share of the step, maybe beyond its end."""
    # one that ends beyond goes on in the next step
    return (
        *lines(f"at = {share}", "until = wp.min(at, 1.0)", "moved = before + (after - before) * until"),
        *(lines("slipped = leaked_before + (leaked - leaked_before) * until") if model.labelled else ()),
        *_memorise_leak(model),
    )


def _crossings_between_resets(model: PixelModel) -> Statements:
    """Return crossings after each of which the pixel is held in reset.

    Without a dead time they are those of pixels that are never held, bit for bit.
    """
    label, asked = _label_crossing(model, "share")
    anew = (
        *lines("passed = 0", "change = value - moved", "theta = on", "polarity = 1"),
        if_block("change < 0.0", "theta = -off", "polarity = 0"),
        Line("crossed = int(whole(wp.abs(change), wp.abs(theta), 1.0 / wp.abs(theta)))"),
        if_block("at > stop", "crossed = 0"),
    )
    body = (
        *_crossing_time(model, "passed"),
        *asked,
        *_event(model, "share", label),
        Line("passed += 1"),
        *_memorise_leak(model),
        *thresholds_after_event(model),
        *_dead_time(model, "share"),
        Block(
            "if wait > 0.0:",
            # what is left of the step begins at the end of the dead time
            (*_memorise_at_end(model, "share + wait / dt"), *anew),
            _take_drawn_threshold() if model.of("redraw") else (),
        ),
    )
    return (
        *lines("passed = int(0)"),
        if_block("at > stop", "crossed = 0"),
        Block("while passed < crossed:", body),
        Line("moved += float(passed) * theta"),
    )


def _crossing_time(model: PixelModel, number: str) -> Statements:
    """Return the statements that set `share` to the time of the crossing after `number` others."""
    begin = "at" if model.delays else "wp.max(at, begun)" if model.resets else "begun"
    return (
        Line(f"share = {begin}"),
        # a change that is all noise or leak stands still: its crossings are due at once
        if_block(
            "after != before",
            f"share = (moved + float({number} + 1) * theta - before) / (after - before)",
        ),
        # rounding must not bring an event before another one, or into the next step
        Line(f"share = wp.clamp(share, {begin}, stop)"),
    )


def _wait_for_gate(model: PixelModel) -> Statements:
    """Return the statements that put a crossing off to the end of the dead time, or to the next step."""
    return (
        *_dead_time(model, "share"),
        if_block("wait > 0.0", "share += wait / dt"),
        # still dead: what crosses is looked at again when time has gone on
        if_block("share > stop", "break"),
    )


def _pending_crossings(model: PixelModel) -> Statements:
    """Return crossings from before `begun` that still stand when the pixel comes back to life at `at`."""
    label, asked = _label_crossing(model, "at")
    body = (
        Line("at += wait / dt"),
        if_block("at > stop", "break"),
        *lines("change = before + (after - before) * at - moved", "theta = float(0.0)", "polarity = int(0)"),
        # one at a time: each begins a dead time of its own
        if_block("change >= on", "theta = on", "polarity = 1"),
        if_block("change <= -off", "theta = -off"),
        if_block("theta == 0.0", "break"),
        *asked,
        *_event(model, "at", label),
        Line("moved += theta"),
        *_memorise_leak(model),
        *thresholds_after_event(model),
        *_dead_time(model, "at"),
    )
    return (*_dead_time(model, "at"), Block("while wait > 0.0:", body))


def _dead_time(model: PixelModel, share: str, *, of_noise: bool = False) -> Statements:
    """Return the statements that set `wait` to the time the pixel stays dead after `share` of the step [s].

    Of noise that is the time for which gates hold it that do not let it pass. Gates ask for the time since
    the last event by the name of `age`, which a pixel keeps as of the begin of the step.
    """
    gates = [
        Guarded(effect, (Line(f"wait = wp.max(wait, {call.text})", call.draws),))
        for effect, call in model.calls("gate")
        if not (of_noise and effect.spares_noise)
    ]
    return (*lines("wait = float(0.0)", "now = age", f"age = now + {share} * dt"), *gates, Line("age = now"))


def _label_crossing(model: PixelModel, share: str) -> tuple[str, Statements]:
    """Return the label of a crossing, and what it takes: whether the leak did more for it than the light."""
    if not model.labelled:
        return f"{Label.SIGNAL:d}", ()
    return "label", (
        *lines(
            f"slipped = leaked_before + (leaked - leaked_before) * {share}", f"label = int({Label.SIGNAL:d})"
        ),
        # a leak is towards ON, so OFF events are never its
        if_block("polarity == 1 and drained + slipped > 0.5 * on", f"label = {Label.LEAK:d}"),
    )


def _memorise_leak(model: PixelModel) -> Statements:
    """Return what begins to count the leak anew, the memory being set where `_label_crossing` looked."""
    return lines("drained = -slipped") if model.labelled else ()


def _leave_pixel(model: PixelModel, share: str) -> tuple[str, Statements]:
    """Return the time at which an event leaves, and what it takes to know it.

    Events of one pixel do not overtake each other.
    """
    instant = model.outlet.instant
    delays = model.calls("delay")
    if not delays:
        return instant.format(share=share, late="0.0"), ()
    late = [Guarded(effect, (Line(f"late += {call.text}", call.draws),)) for effect, call in delays]
    return "leaves", (
        Line("late = float(0.0)"),
        *late,
        # chunks keep what leaves late for so long, and keys have room for it
        Line(f"late = wp.clamp(late, 0.0, {LATEST})"),
        Line(f"leaves = wp.max(leaves, {instant.format(share=share, late='late')})"),
    )


def _event(model: PixelModel, share: str, label: str, *, begins_dead_time: bool = True) -> Statements:
    """Return the emission of an event after `share` of the step, and whether a dead time begins with it."""
    # negative, as the whole step is added to the age when it is over
    aged = lines(f"age = -{share} * dt") if begins_dead_time and "age" in model.states else ()
    aged += lines("fired_on = float(polarity)") if begins_dead_time and "fired_on" in model.states else ()
    if model.sink == "counts":
        return (*lines("on_count += polarity", "off_count += 1 - polarity"), *aged, *model.outlet.emitted)
    time, asked = _leave_pixel(model, share)
    code = f"polarity * 4 + {label}" if model.sink == "labels" else "polarity"
    kept = Line(model.outlet.emit.format(time=time, code=code))
    return (*asked, kept, *aged, *model.outlet.emitted)


def _unless_dead(model: PixelModel, share: str, label: str, *then: Statement) -> Statements:
    """Return the emission of an event, and what follows from it, unless the pixel is dead."""
    event = (*_event(model, share, label), *then)
    if not model.of("gate"):
        return event
    return (*_dead_time(model, share), if_block("wait <= 0.0", *event))


def _noise_event(model: PixelModel, effect: EffectStages) -> Statements:
    """Return the noise event at `stop`; like any event it makes the pixel memorise the present signal."""
    n = effect.name
    polarity, noise = Draw(f"{n}_polarity", "uniform", effect), noise_key(effect)
    is_on = f"uniform({polarity.key}, int({n}_events)) * ({n}_on + {n}_off) < {n}_on"
    # only what leaves the pixel resets it: a dead pixel's noise changes nothing
    then: Statements = (Line("moved = value"), *_memorise_leak(model), *thresholds_after_event(model))
    code = f"{effect.label:d}"
    if model.spares_noise:
        # what is held in reset memorises nothing, whatever is sent on top
        then = (Block("if stop >= at:", then),) if model.resets else then
        sent = (*_event(model, "stop", code, begins_dead_time=False), *then)
        if not all(effect.spares_noise for effect, _ in model.of("gate")):
            sent = (*_dead_time(model, "stop", of_noise=True), if_block("wait <= 0.0", *sent))
    elif model.resets:
        held = if_block("wait > 0.0", *_memorise_at_end(model, "stop + wait / dt"))
        sent = _unless_dead(model, "stop", code, *then, *_dead_time(model, "stop"), held)
    else:
        sent = _unless_dead(model, "stop", code, *then)
    slipped = "slipped = leaked_before + (leaked - leaked_before) * stop"
    return (
        Line("polarity = int(0)"),
        Block(f"if {is_on}:", lines("polarity = 1"), draws=(polarity,)),
        *(lines(slipped) if model.labelled else ()),
        *sent,
        Line(f"{n}_hazard += waiting({noise.key}, int({n}_events))", (noise,)),
        count_on(f"{n}_events"),
    )
