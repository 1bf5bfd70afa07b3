"""The part of a kernel that runs where a step has events: crossings, noise events, dead times, delays."""

from __future__ import annotations

from dase.kernels.pixel_codegen import Text
from dase.kernels.pixel_stages import LATEST, LEAK, SIGNAL, EffectStages

COUNT_ON = "{0} = wp.where({0} < 8388608.0, {0} + 1.0, 1.0)"
"""Counts events in float32 without coming to a halt where it resolves no more; random numbers then repeat."""


class Crossings(Text):
    """Writes what becomes of the change of one step."""

    def redrawn(self) -> list[str]:
        """Return the lines that draw the thresholds of the next event, none without such an effect."""
        draws = [
            line
            for effect, function in self.of("redraw")
            for line in self.unless_off(effect, f"on, off = {self.call('redraw', effect, function)}")
        ]
        return ["on = mean_on", "off = mean_off", *draws] if draws else []

    def busy(self) -> None:
        """Events of a step that has any: crossings, cut at the noise events between them."""
        noisy = [effect for effect, _ in self.of("noise")]
        self.add("moved = float(0.0)", "begun = float(0.0)")
        if not noisy:
            self.add("stop = 1.0", "value = after")
            self.crossings()
        else:
            self.add("while begun < 1.0:")
            self.depth += 1
            self.add("stop = float(1.0)", "cause = int(0)")
            for number, effect in enumerate(noisy, start=1):
                n = effect.name
                self.add(f"if {n}_spend > {n}_hazard and {n}_hazard < stop * {n}_spend:")
                self.add(f"    stop = {n}_hazard / {n}_spend", f"    cause = {number}")
            self.add("value = after", "if cause != 0:", "    value = before + (after - before) * stop")
            self.crossings()
            for number, effect in enumerate(noisy, start=1):
                self.noise_event(number, effect)
            self.add("begun = stop", "if cause == 0:", "    break")
            self.depth -= 1
        self.add("reference += moved")
        if "leaked" in self.states:
            self.add(*(["drained += leaked"] if "drained" in self.states else []))
            # keeps `leaked` small, where float32 resolves slow leaks
            self.add("reference -= leaked", "leaked = 0.0")

    def crossings(self) -> None:
        """Exact crossings between `begun` and `stop`, times interpolated; Eqs. (2)-(4) of the paper."""
        delays = self.delays()
        begin = "at" if delays else "begun"
        if delays:
            self.add("at = begun + 0.0")
            self.pending()
        self.add("change = value - moved")
        self.add(
            "theta = on", "polarity = int(1)", "if change < 0.0:", "    theta = -off", "    polarity = 0"
        )
        self.add(
            "crossed = int(whole(wp.abs(change), wp.abs(theta), 1.0 / wp.abs(theta)))",
            *(["passed = int(0)"] if delays else []),
        )
        if self.of("redraw"):
            self.one_by_one(begin)
            return
        if self.sink == "counts" and not self.of("gate"):
            # nobody asks when they happened
            self.add("on_count += polarity * crossed", "off_count += (1 - polarity) * crossed")
            self.add("moved += float(crossed) * theta")
            return
        self.add(*(["if at > stop:", "    crossed = 0"] if delays else []))
        self.add("for n in range(crossed):")
        self.depth += 1
        self.add(f"share = {begin}", "if after != before:")
        self.add("    share = (moved + float(n + 1) * theta - before) / (after - before)")
        self.add(f"share = wp.clamp(share, {begin}, stop)")
        if delays:
            self.wait("share")
            self.add(
                "if wait > 0.0:", "    share += wait / dt", "if share > stop:", "    break", "passed += 1"
            )
            label = self.leaks("share")
            self.event("share", "polarity", label)
        else:
            label = self.leaks("share")
            self.gated("share", "polarity", label)
        self.add(*self.memorise())
        self.depth -= 1
        self.add(f"moved += float({'passed' if delays else 'crossed'}) * theta")

    def one_by_one(self, begin: str) -> None:
        """Crossings with thresholds drawn anew; equal ones are counted as without drawing, bit for bit."""
        if not self.delays():
            self.add("passed = int(0)")
        else:
            self.add("if at > stop:", "    crossed = 0")
        self.add("while passed < crossed:")
        self.depth += 1
        self.add(f"share = {begin}", "if after != before:")
        self.add("    share = (moved + float(passed + 1) * theta - before) / (after - before)")
        self.add(f"share = wp.clamp(share, {begin}, stop)")
        if self.delays():
            self.wait("share")
            self.add("if wait > 0.0:", "    share += wait / dt", "if share > stop:", "    break")
            self.event("share", "polarity", self.leaks("share"))
        else:
            self.gated("share", "polarity", self.leaks("share"))
        self.add("passed += 1", *self.memorise(), *self.next_draw())
        self.add("drawn = on", "if polarity == 0:", "    drawn = -off", "if drawn != theta:")
        self.add("    moved += float(passed) * theta", "    passed = 0", "    theta = drawn")
        self.add("    crossed = int(wp.floor((value - moved) / theta))")
        self.depth -= 1
        self.add("moved += float(passed) * theta")

    def next_draw(self) -> list[str]:
        """Return the lines that draw new thresholds after an event."""
        anew = self.redrawn()
        return [COUNT_ON.format("redraws"), *anew] if anew else []

    def pending(self) -> None:
        """Crossings from before `begun` that still stand when the pixel comes back to life at `at`."""
        self.wait("at")
        self.add("while wait > 0.0:")
        self.depth += 1
        self.add("at += wait / dt", "if at > stop:", "    break")
        self.add("change = before + (after - before) * at - moved")
        self.add("theta = float(0.0)", "polarity = int(0)")
        self.add("if change >= on:", "    theta = on", "    polarity = 1")
        self.add("if change <= -off:", "    theta = -off", "if theta == 0.0:", "    break")
        self.event("at", "polarity", self.leaks("at"))
        self.add("moved += theta", *self.memorise(), *self.next_draw())
        self.wait("at")
        self.depth -= 1

    def wait(self, share: str) -> None:
        """Set `wait` to the time the pixel stays dead after `share` of the step."""
        self.add("wait = float(0.0)", "now = age")
        self.add(f"age = now + {share} * dt")
        for effect, function in self.of("gate"):
            self.add(*self.unless_off(effect, f"wait = wp.max(wait, {self.call('gate', effect, function)})"))
        self.add("age = now")

    def leaks(self, share: str) -> str:
        """Return the label of a crossing: whether the leak did more for it than the light did."""
        if "drained" not in self.states:
            return str(SIGNAL)
        self.add(f"slipped = leaked_before + (leaked - leaked_before) * {share}", f"label = int({SIGNAL})")
        self.add("if polarity == 1 and drained + slipped > 0.5 * on:", f"    label = {LEAK}")
        return "label"

    def memorise(self) -> list[str]:
        """Return the line that begins to count the leak anew, the memory being set where `leaks` looked."""
        return ["drained = -slipped"] if "drained" in self.states else []

    def leave(self, share: str) -> str:
        """Return the time at which an event leaves; events of one pixel do not overtake each other."""
        delays = self.of("delay")
        if not delays:
            return self.instant(share, "0.0")
        self.add("late = float(0.0)")
        for effect, function in delays:
            self.add(*self.unless_off(effect, f"late += {self.call('delay', effect, function)}"))
        self.add(f"late = wp.clamp(late, 0.0, {LATEST})")
        self.add(f"leaves = wp.max(leaves, {self.instant(share, 'late')})")
        return "leaves"

    def instant(self, share: str, late: str) -> str:
        """Return the time `late` after `share` of the step."""
        return f"leaving_time(clock, k, {share}, {late})"

    def keep(self, time: str, polarity: str, label: str) -> str:
        """Return the call that keeps an event."""
        code = f"{polarity} * 4 + {label}" if self.sink == "labels" else polarity
        return f"deposit(sink, row, i, size, {time}, {code})"

    def event(self, share: str, polarity: str, label: str) -> None:
        """Emit an event after `share` of the step."""
        if self.sink == "counts":
            self.add(f"on_count += {polarity}", f"off_count += 1 - {polarity}")
        else:
            self.add(self.keep(self.leave(share), polarity, label))
        if "age" in self.states:
            self.add(f"age = -{share} * dt")

    def gated(self, share: str, polarity: str, label: str, *then: str) -> None:
        """Emit an event unless the pixel is dead, and do `then`."""
        if not self.of("gate"):
            self.event(share, polarity, label)
            self.add(*then)
            return
        self.wait(share)
        self.add("if wait <= 0.0:")
        self.depth += 1
        self.event(share, polarity, label)
        self.add(*then)
        self.depth -= 1

    def noise_event(self, number: int, effect: EffectStages) -> None:
        """Emit the noise event at `stop`; like any event it makes the pixel memorise the present signal."""
        n = effect.name
        self.draws[f"{n}_polarity"] = "uniform"
        self.add(f"if cause == {number}:")
        self.depth += 1
        self.add("polarity = int(0)")
        self.add(
            f"if uniform({n}_polarity_key, int({n}_events)) * ({n}_on + {n}_off) < {n}_on:",
            "    polarity = 1",
        )
        if "drained" in self.states:
            self.add("slipped = leaked_before + (leaked - leaked_before) * stop")
        then = ["moved = value", *self.memorise(), *self.next_draw()]
        self.gated("stop", "polarity", str(effect.label), *then)
        self.add(f"{n}_hazard += waiting({self.noise_key(effect)}, int({n}_events))")
        self.add(COUNT_ON.format(f"{n}_events"))
        self.depth -= 1
