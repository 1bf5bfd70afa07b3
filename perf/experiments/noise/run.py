"""Compares simulated with measured background noise at three light levels; writes docs/noise.md and a figure.

    python -m perf.experiments.noise.run MEASURED.npz [--out docs]

MEASURED.npz holds, for each light level and polarity, how many intervals between events of a pixel were at
least as long as 1 / frequency, shape (50, 50, 72): noise recordings that come with the simulator IEBCS
(Joubert et al., Event camera simulator improvements via characterized parameters, 2021; GPL-3, not included).
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import NullFormatter

import dase
from dase.effects.shot import Shot
from dase.simulation.sensor_file import parse_sensor

EDGES = np.array([digit * 10.0**decade for decade in range(-3, 5) for digit in range(1, 10)] + [1e5])
"""Frequencies between which the measured intervals were counted [Hz]."""

LEVELS = {"0.1lux": (0.1, 10.0), "161lux": (161.0, 25.0), "3klux": (3000.0, 25.0)}
"""Illuminance [lux], and the duration that the sums of the measured intervals suggest [s]."""

SENSOR = """
name = "noise"
[voltage_noise]
sigma = 0.122 # the rates in the dark
cutoff = 77.0 # the intervals in the dark, together with knee and dark
knee = 0.0022 # 7 lux: the noise is gone at 161 lux
dark = 0.0005 # 1.5 lux: bandwidth is left at 0.1 lux
[threshold]
on = 0.2 # not seen in static noise, only sigma / threshold is: typical
off = 0.26 # the balance of ON and OFF in the dark
[mismatch]
spread = 0.2 # the spread of the rates in the dark
[leak]
rate = 0.045 # 161 lux
spread = 0.3 # the spread of the rates at 3000 lux
light = 2.2 # 3000 lux against 161 lux
[hot]
share = 0.01 # pixels far above the others at 161 and 3000 lux; all of them ON
rate = 2.0
spread = 1.2
balance = 1.0
"""
"""Set by hand, each number by the observation beside it. Intensity 1 is 3000 lux."""


def measured(path: Path) -> dict[str, np.ndarray]:
    """Return intervals counted per pixel and frequency bin, shape (OFF ON, pixels, bins), by level."""
    with np.load(path) as data:
        stored = {level: [data[f"{p}_{level}"] for p in ("neg", "pos")] for level in LEVELS}
    # counts are cumulative over frequency; the last bin was not written
    return {
        level: np.diff(np.stack(pair).reshape(2, -1, 72)[..., :71].astype(np.int64), axis=-1, prepend=0)
        for level, pair in stored.items()
    }


def simulated(sensor: dase.Sensor, level: str, pixels: int = 2500, seed: int = 0) -> np.ndarray:
    """Return the same of a simulation."""
    lux, seconds = LEVELS[level]
    frames = np.full((2, 1, pixels), lux / 3000, np.float32)
    events = dase.simulate(dase.VideoScene(frames, [0.0, seconds]), sensor, seed=seed)
    out = np.zeros((2, pixels, len(EDGES) - 2), np.int64)
    order = np.lexsort((events.t, events.x, events.p))
    t, x, p = events.t[order], events.x[order].astype(int), events.p[order].astype(int)
    follows = (x[1:] == x[:-1]) & (p[1:] == p[:-1])
    bins = np.searchsorted(EDGES, 1 / np.maximum(np.diff(t), 1e-9), side="right") - 1
    np.add.at(out, (p[1:][follows], x[1:][follows], np.clip(bins[follows], 0, len(EDGES) - 3)), 1)
    return out


def rates(intervals: np.ndarray) -> np.ndarray:
    """Return the mean rate of each pixel from its intervals [Hz], 0 where it has none, shape (2, pixels)."""
    middle = np.sqrt(EDGES[:-2] * EDGES[1:-1])
    total, time = intervals.sum(-1), (intervals / middle).sum(-1)
    return total / np.maximum(time, 1e-9)


def summary(intervals: np.ndarray) -> dict[str, float]:
    """Return what the table compares."""
    off, on = rates(intervals)
    total = intervals.sum((1, 2))
    frequency = np.cumsum(intervals.sum((0, 1)))
    return {
        "ON share": total[1] / total.sum(),
        "pixels with ON intervals": np.mean(on > 0),
        "pixels with OFF intervals": np.mean(off > 0),
        "ON rate, median [Hz]": float(np.median(on)),
        "OFF rate, median [Hz]": float(np.median(off)),
        "ON rate, 90 % of pixels below [Hz]": float(np.percentile(on, 90)),
        "OFF rate, 90 % of pixels below [Hz]": float(np.percentile(off, 90)),
        "ON pixels above 3 Hz": np.mean((on > 3) & (intervals[1].sum(-1) > 60)),
        "1 / interval, median [Hz]": float(EDGES[np.searchsorted(frequency, total.sum() / 2)]),
    }


def draw(columns: dict[str, dict[str, np.ndarray]], path: Path) -> None:
    """Draw the deciles over pixels of the rates."""
    figure, axes = plt.subplots(1, 3, figsize=(10, 3.5), sharey=True, layout="constrained")
    share = np.linspace(0.05, 0.95, 19)
    for axis, level in zip(axes, LEVELS, strict=True):
        for (name, data), style in zip(columns.items(), ("o", "-", ":", "--"), strict=True):
            for polarity, colour in ((1, "tab:red"), (0, "tab:blue")):
                rate = np.maximum(np.quantile(rates(data[level])[polarity], share), 0.01)
                label = f"{'ON' if polarity else 'OFF'}, {name}"
                axis.plot(rate, share, style, color=colour, label=label, markersize=3)
        axis.set(title=f"{LEVELS[level][0]:g} lux", xscale="log", xlabel="rate of a pixel [Hz]")
        decades = [n * 10.0**k for k in range(-2, 2) for n in ((1, 2, 5) if level == "0.1lux" else (1,))]
        low, high = axis.get_xlim()
        ticks = [tick for tick in decades if low <= tick <= high]
        axis.set_xticks(ticks, ["none" if tick == 0.01 else f"{tick:g}" for tick in ticks])
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(alpha=0.25, linewidth=0.5)
    axes[0].set_ylabel("share of pixels below")
    lines, labels = axes[0].get_legend_handles_labels()
    figure.legend(lines, labels, ncols=4, loc="outside lower center", fontsize=9, frameon=False)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def table(columns: dict[str, dict[str, np.ndarray]]) -> str:
    """Return the comparison in Markdown."""
    rows = [f"| light | | {' | '.join(columns)} |", "|---|---|" + "---|" * len(columns)]
    for level, (lux, _) in LEVELS.items():
        each = [summary(data[level]) for data in columns.values()]
        for name in each[0]:
            rows.append(f"| {lux:g} lux | {name} | " + " | ".join(f"{s[name]:.2g}" for s in each) + " |")
    return "\n".join(rows)


TEXT = """# Noise: simulated and measured

`perf/experiments/noise/run.py` writes this page; edit the text there. Measured: 50×50 pixels of an event
camera that look at nothing, at three light levels (Joubert et al., Event camera simulator improvements via
characterized parameters, 2021; the histograms come with their simulator IEBCS under GPL-3 and are not part of
dase; this page has summary statistics only). Simulated: 2500 pixels, static light, with this sensor:

```toml{sensor}```

Rates are counted from intervals between two events of one polarity of one pixel, the same way on both sides;
a pixel with fewer than two events has none. The durations of the recordings are not published; 10 s in the
dark and 25 s else agree with the sums of the intervals.

![rates over pixels](noise.png)

{table}

## What it says

- **In the dark** noise comes in both polarities, a few per second. Voltage noise of about half a threshold
  makes it by itself. The change detector returns to where it was, so the rates of ON and OFF are inverse to
  the thresholds: the measured balance says that the OFF threshold is a third larger.
- **In bright light** nearly all noise is ON: leak. It grows with the light by a parasitic photocurrent, here
  by a factor of about 3 from 161 to 3000 lux. OFF noise is gone.
- **Hot pixels**, about one in a hundred, are ON in both bright recordings. At 161 lux the few hottest have
  most of the intervals, so the median interval there is that of a handful of pixels.
- `voltage_noise` does all three levels with one set of parameters. `shot` cannot while its rate falls in a
  straight line, as v2e's does: at 161 of 3000 lux it is hardly lower. With a knee of 3 lux it has the OFF
  events of all three levels, and needs no fine sampling. The column *shot* has
  `shot` with rate {rate:g} Hz and bright 0 in place of the voltage noise, the column *shot, knee* the same
  with a knee of 0.001, which is 3 lux.

The numbers of the sensor were set by hand, so this shows that the effects can be like a camera, not that a
fit finds them. Threshold, cutoff and noise are not told apart by static noise: only their ratios are.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("measured", type=Path)
    parser.add_argument("--out", type=Path, default=Path("docs"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    sensor = parse_sensor(SENSOR, "sensor")
    shot = Shot(rate=10.5, bright=0.0, balance=0.57)
    bare = sensor.without("voltage_noise")
    columns = {
        "measured": measured(options.measured),
        "simulated": {level: simulated(sensor, level) for level in LEVELS},
        "shot": {level: simulated(bare.with_effect(shot), level) for level in LEVELS},
        "shot, knee": {
            level: simulated(bare.with_effect(replace(shot, knee=0.001)), level) for level in LEVELS
        },
    }
    text = TEXT.format(sensor=SENSOR, table=table(columns), rate=shot.rate)
    (options.out / "noise.md").write_text(text)
    draw(columns, options.out / "noise.png")
    print(text)


if __name__ == "__main__":
    main()
