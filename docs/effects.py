"""Writes docs/effects.md, the table of all effects: python docs/effects.py."""

from __future__ import annotations

import json
import textwrap
from pathlib import Path
from typing import Any

import numpy as np

import dase
from dase.effects import Effect, SceneEffect, StreamEffect

HEAD = """# Effects

All physical effects of the sensor model, in the order in which they act. `docs/effects.py` writes this page
from the code; edit the text there. `dase effects show NAME` says more about one.

A parameter stands with its default, its unit and where real cameras lie; *off* is the value at which the
effect changes nothing, bit for bit.

| effect | what it is | stage | parameters | source |
|---|---|---|---|---|
"""


def parameters(effect: type[Effect]) -> str:
    """Return the parameters of an effect, one per line."""
    lines = []
    for p in effect.parameters():
        unit = "" if p.unit == "1" else f" {p.unit}"
        off = "" if p.off is None else f", off at {p.off:g}"
        low, high = p.plausible
        lines.append(f"`{p.name}` = {p.default:g}{unit} ({low:g} to {high:g}{off}): {p.about}")
    lines += [f"`{name}`: {' or '.join(among)}" for name, among in effect.choices().items()]
    return "<br>".join(lines)


def stage(effect: type[Effect]) -> str:
    """Return where an effect acts."""
    if issubclass(effect, SceneEffect | StreamEffect):
        return "optics" if issubclass(effect, SceneEffect) else "readout"
    return ", ".join(effect.stages) or "count"


PICTURES = """
## What events look like

Drawn by `docs/effect_pictures.py`: the same light without and with each effect, stronger than usual where
that shows more. A raster has a pixel in each row and a dot for each event; a picture counts the events of 12
to 50 ms. What `learned_threshold` does is in [adaptation.md](adaptation.md).
"""


def pictures() -> str:
    """Return the pictures of all effects that have one."""
    folder = Path(__file__).parent / "effects"
    found = [(name, path) for name in dase.EFFECTS for path in sorted(folder.glob(f"{name}*.png"))]
    return PICTURES + "".join(f"\n![{name}: without and with](effects/{path.name})\n" for name, path in found)


def recordings() -> str:
    """Return the tables of what was measured in recordings, and simulated."""
    found = json.loads(RESULTS.read_text("utf-8"))
    intervals, rest, tails = [], [], []
    for recording, models in found.items():
        for n, (model, seen) in enumerate(models.items()):
            head = f"| {recording if n == 0 else ''} | {model}"
            cells = (" / ".join(f"{q:.3g}" for q in seen["intervals"].get(pair, [])) for pair in PAIRS)
            intervals.append(f"{head} | " + " | ".join(cells) + " |\n")
            known = " / ".join("–" if rate is None else f"{rate:.2g}" for rate in seen.get("rest", ())) or "–"
            bursts = f"{100 * seen['bursts']:.0f} %" if seen["bursts"] else "none"
            lamp = f"{seen['lamp'][0]:.5g} Hz, {seen['lamp'][1]:.2g}" if seen["lamp"] else "none"
            ties = f"{100 * seen['ties']:.3g} % | {100 * seen['row ties']:.3g} %"
            rest.append(f"{head} | {seen['rate']:.3g} | {known} | {ties} | {bursts} | {lamp} |\n")
            tail = [share for share in seen.get("tail", ()) if share is not None]
            if tail:
                cells = (" / ".join(f"{100 * share:.2g}" for share in half) for half in (tail[:4], tail[4:]))
                tails.append(f"{head} | " + " | ".join(cells) + " |\n")
    tables = {"intervals": intervals, "rest": rest, "tails": tails}
    return MEASURED.format(**{name: "".join(rows) for name, rows in tables.items()}, words=WORDS)


RESULTS = Path(__file__).parents[1] / "perf" / "experiments" / "recordings" / "results.json"
PAIRS = ("ON-ON", "OFF-OFF", "ON-OFF", "OFF-ON")

MEASURED = """
## Measured against simulated

Presets on recordings of their cameras, nothing fitted: those of commit 3859195 (before) and those of now
(after). The scene is what the camera's own frames tell, or constant light where nothing moved; where no scene
is known, only the measurement stands. *With its lamp and frames*: the preset of now with `flicker` and
`exposure` at the frequency and the times that the events tell, and both strengths and the threshold set by
three totals, the event rate, the share in bursts and the swing; all else is left to compare. `python -m
perf.experiments.recordings.run $DASE_DATA/recordings` measures anew (all at a4b5fa2, with the same
result to the last digit as at ef55f93),
`python docs/effects.py` writes these tables. Noise of another camera at three illuminances is in
[noise.md](noise.md).

Intervals of a pixel [ms] by its polarities: 0.1 / 1 / 10 % are shorter. Empty where there are fewer than 300.

| recording | | ON-ON | OFF-OFF | ON-OFF | OFF-ON |
|---|---|---|---|---|---|
{intervals}
Rates [Hz] are of both polarities: of all pixels, and of pixels at rest whose frames have 0 to 4, 4 to 10,
10 to 20, 20 to 40 and more of 255 grey levels (of all where nothing moves); these are simulated before the
mean of the frames, whose own noise would make events in the dark. Ties: events with the time stamp
of the one before, in microseconds; of these in one row. Bursts: share of the events in bursts in step with
frames. Lamp: line of the spectrum and its swing, as `dase.find_signatures` finds both in the events.

| recording | | all | at rest | ties | in one row | bursts | lamp |
|---|---|---|---|---|---|---|---|
{rest}
Share of the pixels at rest that send 1 / 2 / 4 / 8 events and more while the recording lasts [%], those of
0 to 4 and those of 20 and more grey levels:

| recording | | in the dark | in the light |
|---|---|---|---|
{tails}
{words}"""

WORDS = """
What is nearer now: noise at rest of the cradle (3.4 times too much in the dark and 160 times in the
light before; 0.95 and 1.6 after), how it spreads over pixels (42 % of dark pixels sent something before
and 0.2 % four events and more; 10 and 0.7 % do, 11 and 0.3 % after), and the events of both DAVIS346:
2.8 and 4.1 times too many before, 1.7 and 1.2 after. Both recordings set the threshold of 0.3 (0.2 of
v2e makes 2.5 and 1.8 times too many), the cradle alone the noise; none is left to check them by. What
the cradle has too many is noise of the frames that make the scene, most of all in the dark, where a grey
level is more than a threshold.

What is not: the shaken DAVIS240C has more events than its preset makes, and fewer with the reset, as its
thresholds are lower, and neither its lamp nor its frames are in a preset. With both, and with thresholds of
0.108, steps of 0.067 by the frames and a lamp of 1.0 % depth, it has the lamp's swing, the bursts and the
events, as it was set to; and of what was not set, intervals of one polarity come nearer (a tenth of those of
ON-ON are below 3.5 ms; 9.9 and 5.9 ms, without and with both), and so do ties (62 %; 7 and 30 %) and those
in one row (43 %; 0.04 and 16 %). Intervals between the polarities stay too long (ON-OFF 4.1 ms; 57 and 30
ms): frames 138 ms apart do not tell the fine turns of a shaking hand. `dase.fit` finds no strength of the
frames here, see [reading-a-diagnosis.md](reading-a-diagnosis.md). Ties in one row, of the DAVIS240B and the
Gen3, too, are of rows that send many events at once, as in bursts in step with the frames; a preset that
reads by rows but has no such bursts makes none. The DAVIS346 shows no such rows: its ties are of different
rows. Intervals of 0 to 1 us of two OFF events of the DVS128 and the DAVIS240B are double events. Pixels of
the DVXplorer at rest send bursts of noise at intervals of its scan, and those of the HD sensor flip their
polarity sooner than independent noise does.
"""


def dead_times() -> str:
    """Return the table of fits under each rule of the dead time, and what it says."""
    found = json.loads(DEAD_TIMES.read_text("utf-8"))
    lines = [
        "| recording | | error | dead time after ON [ms] | after OFF [ms] | ON-ON | OFF-OFF |",
        "|---" * 7 + "|",
    ]
    for recording, part in found["recordings"].items():
        measured = [" / ".join(f"{q:.3g}" for q in part["measured"][pair][:2]) for pair in ALIKE]
        lines.append(f"| {recording} | measured | | | | " + " | ".join(measured) + " |")
        for rule in dict.fromkeys(fit["rule"] for fit in part["fits"]):
            fits = fits_by(part, rule)
            dead = ["", ""]
            if "refractory.period" in fits[0]["values"]:
                periods = [dead_times_of(fit) for fit in fits]
                dead = [" / ".join(f"{1e3 * one:.2g}" for one in side) for side in zip(*periods, strict=True)]
            cells = [" / ".join(f"{fit['error']:.2f}" for fit in fits), *dead]
            for pair in ALIKE:
                ends = [span([fit["intervals"][pair][n] for fit in fits], ".3g") for n in (0, 1)]
                cells.append(" / ".join(ends))
            lines.append(f"| | {rule} | " + " | ".join(cells) + " |")
    figures = figures_of_dead_times(found["recordings"])
    about = {"commit": found["commit"], "processor": found["processor"]}
    text = DEAD.format(table="{table}", **about, **figures)
    # figures are longer or shorter than their names
    parts = [textwrap.fill(part, 110, break_on_hyphens=False) for part in text.split("\n\n")]
    return "\n\n".join(parts).format(table="\n".join(lines)) + "\n"


DEAD_TIMES = Path(__file__).parents[1] / "perf" / "experiments" / "dead_times" / "results.json"
ALIKE = ("ON-ON", "OFF-OFF")


def fits_by(part: dict[str, Any], rule: str) -> list[dict[str, Any]]:
    """Return the fits of a recording under a rule, in the order of their seeds."""
    return sorted((fit for fit in part["fits"] if fit["rule"] == rule), key=lambda fit: fit["seed"])


def dead_times_of(fit: dict[str, Any]) -> tuple[float, float]:
    """Return the dead time after ON and after OFF events [s]."""
    after_on = fit["values"]["refractory.period"][0]
    return after_on, after_on * fit["values"].get("refractory.after_off", [1.0])[0]


def span(values: list[float], style: str = ".2f") -> str:
    """Return the least and the largest of some values."""
    ends = [f"{one:{style}}" for one in (min(values), max(values))]
    return ends[0] if ends[0] == ends[1] else " to ".join(ends)


def figures_of_dead_times(recordings: dict[str, Any]) -> dict[str, str]:
    """Return the figures of the text: what spans the seeds, differences between two fits of one seed."""
    out = {}
    for name, part in zip(("cradle", "shaken"), recordings.values(), strict=True):
        fits = {key: fits_by(part, rule) for key, rule in FITTED_RULES.items()}
        for key, mine in fits.items():
            pairs = zip(mine, fits["reset"], strict=True)
            out[f"{name}_{key}"] = span([fit["error"] - reset["error"] for fit, reset in pairs], "+z.2f")
            out[f"{name}_{key}_rise"] = span([one / least for least, one, _ in intervals_of(mine, "ON-ON")])
        out[f"{name}_dead"] = span([1e3 * dead_times_of(fit)[0] for fit in fits["reset"]], ".2g")
        ends = [1e3 * end for fit in fits["reset"] for end in fit["values"]["refractory.period"][1:]]
        out[f"{name}_dead_ends"] = span(ends, ".2g")
        out[f"{name}_given"] = span([fit["before"] - fit["error"] for fit in fits["reset"]], "+z.2f")
        out[f"{name}_errors"] = span([fit["error"] for mine in fits.values() for fit in mine], ".2g")
        ratios = [fit["values"]["refractory.after_off"] for fit in fits["after"]]
        each = [f"{value:.2f} ({low:.2f} to {high:.2f})" for value, low, high in ratios]
        out[f"{name}_ratios"] = ", ".join(each[:-1]) + " and " + each[-1]
        measured = [part["measured"][pair] for pair in ALIKE]
        out[f"{name}_measured_rise"] = f"{measured[0][1] / measured[0][0]:.2f}"
        alike = [intervals_of(fits["none"], pair) for pair in ALIKE]
        on, off = ([real[0] - fit[0] for fit in mine] for real, mine in zip(measured, alike, strict=True))
        out[f"{name}_asked_on"], out[f"{name}_asked_off"] = span(on), span(off)
        out[f"{name}_asked"] = span([after / before for before, after in zip(on, off, strict=True)])
        for key in ("reset", "after"):
            both = zip(*(intervals_of(fits[key], pair) for pair in ALIKE), strict=True)
            out[f"{name}_{key}_ordered"] = str(sum(off[0] < on[0] for on, off in both))
    out["seeds"] = str(len(fits["reset"]))
    return out


FITTED_RULES = {
    "none": "none", "reset": "reset", "drop": "drop", "delay": "delay", "after": "reset, after OFF free",
}  # fmt: skip


def intervals_of(fits: list[dict[str, Any]], pair: str) -> list[list[float]]:
    """Return the quantiles of the intervals between two polarities that fits make [ms]."""
    return [fit["intervals"][pair] for fit in fits]


DEAD = """
## What recordings ask for

**Dead time.** Two recordings fitted under each rule of the dead time, and with none: thresholds, cutoff and
dead time free, all else as in the preset of the camera, which is where a fit begins (`dase.fit`, 600 pixels,
three seeds; `python -m perf.experiments.dead_times.run $DASE_DATA/recordings` computes it anew, {commit},
{processor}). The scene is what the camera's own frames tell, and no fit reaches the noise floor, so this
shows which rule is nearer, not that it is right. Errors and dead times of the three seeds; a seed sets which
pixels are looked at, so errors compare between rules seed by seed. Intervals of a pixel [ms]: 0.1 / 1 % are
shorter, the least and the largest of the seeds.

{table}

**Rule.** The cradle asks for a reset by its intervals, hardly by its error. Without a dead time the error is
higher than that of a reset in every seed ({cradle_none}), but with a drop ({cradle_drop}) or a delay
({cradle_delay}) it is lower in some and higher in others, and on these pixels and times, which
no fit has seen, the preset as it was given has a smaller error than its fit ({cradle_given}): a tenth tells
nothing here. Intervals of two ON events spread as far above the shortest with a reset as the measured ones do
(1 % over 0.1 %: {cradle_measured_rise} measured, {cradle_reset_rise} reset), while with a drop
({cradle_drop_rise}) or a delay ({cradle_delay_rise}) they pile up at the dead time. The reset's dead time is
{cradle_dead} ms (ends of the intervals of 90 %: {cradle_dead_ends} ms). Shaken by hand, with frames every 138
ms and their bursts, the scene is too poor to tell: at errors of {shaken_errors} fits take thresholds down and
dead times up, a reset's to {shaken_dead} ms and those of a drop and a delay in two seeds of three to about
60 ms, where the search ends, far above the measured intervals. (Of its ON-ON intervals 0.1 % are those of
double events, 1 us apart.)

**Dead time after OFF.** On the cradle a fit with `after_off` free has no smaller error than a reset without
({cradle_after}). It ends at {cradle_ratios} (with intervals of 90 %; the search ends at 0.10, below 0.3 is
implausible), in {cradle_after_ordered} of {seeds} seeds with OFF-OFF intervals shorter than ON-ON, as the
measured ones are ({cradle_reset_ordered} without). The intervals by themselves do ask for a shorter dead time
after OFF: with a reset they are longer by about the dead time, and the measured 0.1 % lie {cradle_asked_on}
ms above those of the fit without one for ON-ON and {cradle_asked_off} ms for OFF-OFF, a ratio of
{cradle_asked}. That rests on how fast the fastest edges are to ON and to OFF, which frames hardly tell. On
the shaken camera the error is smaller in two seeds and larger in one ({shaken_after}), at {shaken_ratios},
the other way round, and at dead times that its intervals contradict. As the error of the cradle
does not fall and no second recording agrees, presets keep one dead time.
"""

RECORDINGS = """
**Noise over light.** Rate of resting pixels of the cradle that send fewer than 8 events, both polarities, at
0 to 1, 4 to 7, 7 to 10, 10 to 14, 14 to 20, 20 to 30 and 40 to 60 of 255 grey levels: 0.32, 0.15, 0.053,
0.036, 0.025, 0.0070 and 0.0035 Hz. The likeliest law of the kind that `shot` has gives 0.33, 0.10, 0.064,
0.044, 0.028, 0.014 and 0.005: it falls too slowly at last, and no leak is left. `davis346` had 1.0 to 0.87 Hz
of shot noise and 0.1 Hz of leak at all of them.

**Noise over pixels.** Counts of a pixel in eight parts of the time scatter as those of a steady rate do (1.1
times their mean), but some pixels are noisy in all parts: rates vary over pixels by 5.5 times the square of
their mean, so that their logarithms have a standard deviation of 1.4 (`shot.spread`). Above 20 grey levels 8
of 28,298 resting pixels send three events and more, at random times and of both polarities (`hot`). Mismatch
of the thresholds is no substitute, as the noise follows it in proportion only, nor is leak, as half of the
events are OFF. Of the HD sensor at rest 97 % of the pixels send nothing in 1.25 s, and counts in two halves
of the time vary together by 22 times the square of their mean: a spread of 1.8.

## Voltage noise between samples

Events of a change detector under noise of two equal poles, relative to those in steps of a twentieth of a
time constant: an independent NumPy simulation of 6000 pixels over 400 time constants. Samples are per period
of the corner.

| samples per period | way between two samples | threshold of 1 sigma | 2 | 3 | 4 |
|---|---|---|---|---|---|
| 16 | straight (until 0a128f4) | 0.91 | 0.90 | 0.87 | 0.86 |
| 16 | with its turn | 1.01 | 1.01 | 1.01 | 1.01 |
| 10 | straight | 0.82 | 0.80 | 0.77 | 0.75 |
| 10 | with its turn | 1.00 | 1.01 | 1.00 | 1.03 |
| 6.5 | straight | 0.73 | 0.70 | 0.64 | 0.61 |
| 6.5 | with its turn | 0.99 | 1.00 | 1.01 | 1.04 |

With its turn: means of what 0.04 and 0.06 sigma beyond the turn give, after a time constant; `dase` takes
0.05, and eight samples. Failed: straight lines with a larger amplitude instead (1 + x / 11 after x time
constants), which is right for one threshold at a time (0.99, 1.03, 1.07, 1.17 at 16 samples). Below 20
samples per period levels are passed up to a tenth more rarely than Rice's formula says, and events are yet as
many as in small steps: a voltage that comes back at once makes none.
"""


def rice() -> str:
    """Return the table of events of voltage noise against Rice's formula."""
    found = json.loads(RICE.read_text("utf-8"))
    cases = list(dict.fromkeys((row["cutoff"], row["dead"]) for row in found))
    names = [f"{cutoff:g} Hz" + (f", dead {dead:g}" if dead else "") for cutoff, dead in cases]
    lines = ["| threshold | Rice [1/period] | " + " | ".join(names) + " |", "|---" * (2 + len(names)) + "|"]
    for ratio in dict.fromkeys(row["ratio"] for row in found):
        rows = {(row["cutoff"], row["dead"]): row for row in found if row["ratio"] == ratio}
        first = rows[cases[0]]
        cells = [f"{rows[case]['rate'] / rows[case]['rice']:.2f}" for case in cases]
        share = first["rice"] / (0.5 * first["cutoff"])
        lines.append(f"| {ratio:g} sigma | {share:.3g} | " + " | ".join(cells) + " |")
    return AGAINST_RICE.format(table="\n".join(lines))


RICE = Path(__file__).parents[1] / "perf" / "experiments" / "noise" / "rice.json"

AGAINST_RICE = """
## Voltage noise against Rice's formula

Events relative to those that Rice's formula tells, of `dase.count` at five cutoffs and, at one of them,
with dead times (`mode = "reset"`, in periods of the corner). A pixel's levels lie a threshold apart,
anywhere beside the mean of its voltage; a level at a is passed 1.55 · corner · exp(-a² / 2 sigma²) times a
second, and the memory goes to and fro between the two next to the mean, and waits for one and then for the
other to be passed. `python -m perf.experiments.noise.rice` computes it anew.

{table}

The cutoff sets the pace and nothing else. The formula is a limit: it takes a voltage that passes a level
for one that has forgotten when it last did. From 5 sigma on it holds within a tenth (errors of the table:
0.01 at 5 and 0.02 at 6 sigma). At 3 and 4 there are an eighth less, as in small steps of an independent
simulation (0.88 at 3 sigma): levels 1.5 to 2 sigma away are passed several times in a row. At 1 sigma more
than two levels are within reach. With a short dead time the memory is where the voltage has gone on to,
beyond the level, whence it returns the sooner; after a whole period it is the noise of a random moment,
mostly near the mean and so a whole threshold from both levels, and events are 10 to 20 times as rare: no
formula for pixels that keep their phase holds then.
"""


def poles_apart() -> str:
    """Return the table of events of noise of two poles against those in small steps."""
    found = json.loads(APART.read_text("utf-8"))
    levels = list(dict.fromkeys(row["level"] for row in found))
    heads = [f"{level:g} sigma: in small steps | dase | Rice" for level in levels]
    head = "| node's pole, gain | samples per period, processor time | " + " | ".join(heads) + " |"
    lines = [head, "|---" * (2 + 3 * len(levels)) + "|"]
    for ratio, gain in dict.fromkeys((row["ratio"], row["gain"]) for row in found):
        rows = [row for row in found if (row["ratio"], row["gain"]) == (ratio, gain)]
        cells = [
            f"{row['fine']:.3g} | {row['rate'] / row['fine']:.3f} ± {row['error']:.3f} | "
            f"{row['rice'] / row['fine']:.2f}"
            for row in rows
        ]
        # 5000 pixels over 60 periods
        spent = sum(row["seconds"] for row in rows) / len(rows) / (5000 * 60) * 1e6
        cost = f"{rows[0]['samples']:.0f}, {spent:.2g} us"
        lines.append(f"| {ratio:g}, {gain:g} | {cost} | " + " | ".join(cells) + " |")
    return POLES_APART.format(table="\n".join(lines))


APART = RICE.with_name("apart.json")

POLES_APART = """
## Noise of two poles against small steps

`voltage_noise` with `poles = "apart"`: events per period of the fixed pole in an independent NumPy process
of steps of a twentieth of the faster pole's time constant (5000 pixels, 40 periods after 20 others), and
those of `dase.count` and of Rice's formula relative to these. The node's pole is that at the light looked
at, in units of the fixed one: from light of a tenth of the knee to a hundred times the knee; the gain is
that of a loop around both. Samples are per period of the fixed pole, and processor time is per pixel and
such period, of one core of an AMD EPYC. `python -m perf.experiments.noise.rice --poles apart` computes it
anew.

{table}

Without a loop all are within 2.0 % of the small steps, with one within 3.2 %, which is two errors. Rice's
formula is the same as above, with a mean that is passed sqrt((1 + gain) a b) / 2π times a second upwards, a
and b the poles. The faster the node, the rougher the voltage, and the more crossings come in clusters, of
which hardly any but the first makes an event. The fixed pole's frequency sets the pace and nothing else (the
same within 1 % at 10 to 3000 Hz, `pytest tests/effects/test_effects_voltage.py -k pace`). What a low knee
costs are samples, π (1 + dark) / knee per period of the fixed pole, whatever the light in the scene; a loop
asks for some sqrt(25 (1 + gain) / knee), where that is more.
"""


def damping() -> str:
    """Return the table of fits of the photoreceptor's circuit."""
    lines = [
        "| true damping | begun with poles | error | cutoff [Hz] | damping | dark | thresholds |",
        "|---" * 7 + "|",
    ]
    lines += [
        f"| {row['damping']:g} | {row['poles']} | {row['error']:.2f} | {row['cutoff']:.3g} | "
        f"{row['fitted damping']:.3g} | {row['dark']:.2g} | {row['on']:.3f}, {row['off']:.3f} |"
        for row in json.loads(CIRCUIT.read_text("utf-8"))
    ]
    return DAMPING.format(table="\n".join(lines))


CIRCUIT = Path(__file__).parents[1] / "perf" / "experiments" / "photoreceptor" / "fits.json"

DAMPING = """
## Damping that follows the light

The photoreceptor's node has a pole that follows the photocurrent, its amplifier a fixed one, and a loop of
gain A goes round both. Of poles a L and b in light of which L is left, the loop has the natural frequency
sqrt((1 + A) a b L) and the damping (a L + b) / 2 over that: in the light it may ring, in the dark it creeps.
`second_order` with `poles = "apart"` is that circuit: its events are within a threshold and a half of the
voltage of an independent integration of node and amplifier, in light that goes up and down by 30, at five
pairs of poles and gains of 0 to 60 (`pytest tests/effects/test_photoreceptor.py -k circuit`). Special cases
are `bandwidth` (b far above the rest), a low-pass behind another (A = 0), and `poles = "alike"` in light
that is the same everywhere. `voltage_noise` with `poles = "apart"` is the noise of the same circuit, with
the same `gain` (above); `SecondOrder.of_poles` and `VoltageNoise.of_photoreceptor` take the same numbers.

Does it matter? Events of the circuit with thresholds of 0.2, cutoff 60 Hz and dark 0.01, before waves 20
times as bright on one side as on the other (64x48, 0.6 s, 1 kHz, nothing else on), fitted from either law
(`dase.fit`, 400 pixels, Intel Xeon, 4b70082; `python -m perf.experiments.photoreceptor.run` makes it anew):

{table}

A fit tries the other law, too, and keeps the better, so that with which it begins does not matter. When it
kept to the law that it began with (13e41f6), poles that are alike ended at cutoffs of 219, 213 and 126 Hz
and thresholds of 0.175, 0.184 and 0.198, at errors of 0.93, 0.35 and 0.30: no error tells that something is
wrong (what repeats have is 1), and yet thresholds are up to 13 % too low. A diagnosis tries poles that are
alike alone ([what was tried](diagnosis-log.md#populations-and-descents)), so its thresholds have this error
beside `second_order` where the light goes over decades: fit its sensor again.
"""


def one_dark_current() -> str:
    """Return the table of fits of a sensor with one dark current."""

    def estimate(row: dict[str, Any], name: str) -> str:
        if name not in row:
            return ""
        value, low, high = row[name]
        return f"{value:.2g} ({low:.2g} to {high:.2g})"

    lines = [
        "| true current | fitted with a dark current | error | current | bandwidth's share | thresholds |",
        "|---" * 6 + "|",
    ]
    lines += [
        f"| {row['true current']:g} | {row['model']} | {row['error']:.2f} | "
        f"{estimate(row, 'dark.current')} | {estimate(row, 'bandwidth.dark')} | "
        f"{row['threshold.on'][0]:.3f}, {row['threshold.off'][0]:.3f} |"
        for row in json.loads(ONE_CURRENT.read_text("utf-8"))
    ]
    return DARK.format(table="\n".join(lines))


ONE_CURRENT = CIRCUIT.with_name("dark.json")

DARK = """
## One dark current

A photodiode has one dark current, and all that flows in it charges the photoreceptor's node: C dV/dt = I + D
minus what the feedback takes away, I the photocurrent, D the dark current, so that the time constant goes as
1 / (I + D). (That it goes as one over the photodiode's current is in Delbruck and Mead, 1994, not verified at
the source; that the dark current is a part of it is derived here from the circuit, not quoted.) So the effect
`dark` is that of the whole pixel, with its spread over pixels: D of each, Dm the median.

| of | with the effect `dark` | without |
|---|---|---|
| the light's logarithm | log(I + D + log_eps) | log(I + log_eps) |
| speed L of `bandwidth`, `second_order` | (I + D) / (1 + Dm), at most 1 | dark + (1 - dark) I |
| delay of `latency` | delay · (1 - light + light / L) | the same, with that L |
| corner and variance of `voltage_noise` | I + D in place of I | I + dark |

Where a sensor has it, the poles' own `dark` changes nothing (`dase add` and sensor files say so, and a fit
has no such parameter); D / (1 + D), `Dark.share`, is what it would have to be. Where it has none, or a
current of 0, all is as if the effect were not there, to the bit. Until f3f47db the poles had their floor
beneath the sum, dark + (1 - dark) (I + D): with the default of 0.07 and a current of 0.003 a black pixel was
25 times as fast as its current makes it. `speed = "own"` is that law yet, for other simulators whose light
and whose cutoff have a floor each; a diagnosis tries it where events come in step with the frames of a clip,
and each fit that has it tries the shared one.

`pytest tests/effects/test_dark_current.py` compares one pole, two, the circuit, noise and all of them with
independent twins at three currents; pixel by pixel, the current that the contrast tells in an edge to
complete darkness is within 4 % of what the time constant tells; noise in darkness is that of as much light.

Does it matter? Events of thresholds 0.2 and a bandwidth of 60 Hz before the waves above, with a dark current
whose logarithm spreads by 0.3, fitted (`dase.fit`, 400 pixels, with intervals of 90 %; AMD EPYC; `python -m
perf.experiments.photoreceptor.dark` computes it anew). All that begin with one of each end with one for both:

{table}

Of 0.01 and less the bandwidth's own share stands in, at an error that says nothing, with thresholds up to 5 %
too high; of 0.04 the error says that something is missing, and thresholds are a fifth too high.
"""


def is_open(ratio: float, error: float) -> bool:
    """Whether a ratio does not tell if it is within 3 %, as of what hardly sends."""
    return error > 0.015 and abs(ratio - 1) < 0.03 + 3 * error


def fitted_and_simulated() -> str:
    """Return the table of rates in trials against those of simulations."""
    table = json.loads(TRIALS.read_text("utf-8"))
    lines = [
        "| effect | models | within 3 % | median | lowest | highest | commit, processor |",
        "|---" * 7 + "|",
    ]
    far = []
    for name, part in table.items():
        rows = [row for row in part["rows"] if row["events"] and not is_open(row["ratio"], row["error"])]
        ratios = np.array([row["ratio"] for row in rows])
        inside = np.count_nonzero(np.abs(ratios - 1) <= 0.03)
        few = len(part["rows"]) - len(rows)
        lines.append(
            f"| `{name}` | {len(rows)} ({few} left out) | {inside} | {np.median(ratios):.3f} | "
            f"{ratios.min():.3f} | {ratios.max():.3f} | {part['commit']}, {part['device']} |"
        )
        far += [
            f"| `{name}`, {row['case']} | {row['ratio']:.3f} ± {row['error']:.3f} |"
            for row in rows
            if abs(row["ratio"] - 1) > 0.03
        ]
    beyond = "\n".join(["| beyond 3 % | ratio |", "|---|---|", *far]) if far else "None is beyond 3 %."
    return FITTED.format(table="\n".join(lines), beyond=beyond)


TRIALS = Path(__file__).parents[1] / "perf" / "experiments" / "trials" / "rates.json"

FITTED = """
## Fitted is simulated

Events in the trials of a fit relative to those of `dase.simulate`. Buses of four modes can take 3.3 times to
a third of what pixels send, in two scenes, where 900 other pixels are simulated or each of 300 stands for
three. Voltage noise and lamps are seen at rest, in scenes of 1000, 500 and 250 frames per second, whose time
a fit cuts into steps of 1, 2 and 1 ms; lamps by themselves, where all are within 3 %, and behind a
photoreceptor whose cutoff is their frequency; noise at three knees; noise of two poles (`poles = "apart"`)
at two. Left out
are models with no event, and those whose ratio has an error above 0.015 and may be within 3 %.
`python -m perf.experiments.trials.rates` computes it anew.

{table}

{beyond}

Lamps had been 17 % off, in simulations more than in trials: dips of rectified light and tops of sines fell
between samples, and the two sample at other moments. Now the sample nearest to an extreme shows it, so that
counts do not depend on sampling. What is smoothed behind them feels the way between the extremes, too, and a
sample that shows a dip makes it wider. **One corner is left**: where a smoothed swing is 7 % longer than the
threshold (a sine of depth 0.15 at the cutoff), 1 % of it is a sixth of the events, and tops of what is
smoothed fall between samples. With 11.5 samples a period, as many as a shallow sine is given, a simulation
sends 42 % of what 1000 samples a period send, with 12 that stand still before the sine 15 %, with 16, 24, 32
and 64 some 77, 88, 94 and 98 %; trials and simulations differ by as much where their samples do. Three times
the samples for all lamps are a high price for lamps that hardly reach a threshold, so it stays. Pulses of 50
µs (1000 Hz, duty 0.05) were up to half off behind a photoreceptor, for trials had one or two samples of each
and simulations four or five; now trials have as many, and samples at a pulse's ends show the share of it
around them: events of pulses of four and a half samples had depended on where samples fall by a fifth, of
both, and are 10 to 15 % below those of light that is sampled without end. Voltage noise had nothing to mend:
it is off by a fifth (3 kHz) where 24 samples are taken in 4 ms, but no fit has steps above 2 ms, and those
are now cut into as many as it needs. Noise of two poles wants 94 samples per millisecond at 3 kHz and a knee
of a tenth of the brightest light, and was 4 % off with 48 in 2 ms.
"""


def page() -> str:
    """Return the page."""
    rows = []
    for name, effect in dase.EFFECTS.items():
        what = effect.about().splitlines()[0]
        rows.append(f"| `{name}` | {what} | {stage(effect)} | {parameters(effect)} | {effect.source} |")
    return (
        HEAD
        + "\n".join(rows)
        + "\n"
        + pictures()
        + recordings()
        + dead_times()
        + RECORDINGS
        + rice()
        + poles_apart()
        + damping()
        + one_dark_current()
        + fitted_and_simulated()
    )


if __name__ == "__main__":
    Path(__file__).with_suffix(".md").write_text(page(), "utf-8")
