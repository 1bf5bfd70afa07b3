"""Writes docs/presets.md from the preset files: python docs/presets.py."""

from __future__ import annotations

from pathlib import Path

from dase.simulation.preset_sources import preset_sources
from dase.simulation.sensor_file import read_presets

HEAD = """# Presets

Built-in sensors: every value with its unit, and where it comes from. `docs/presets.py` writes this page from
the files in `dase/presets`, which `dase presets show NAME` prints, too; edit them. What no source
is given for beside a value is said in the text above its table. How close presets come to recordings is in
[effects.md](effects.md). A preset is where to begin: `dase fit` fits it to a recording of your own camera.

## Other biases than the default

Nothing takes biases: change the values themselves. What is known of how they follow for the DAVIS346:

- `OnBn`, `OffBn`, `DiffBn`: `threshold.on` goes with abs(ln(I_on / I_diff)), `threshold.off` with
  abs(ln(I_off / I_diff)); capacitors and slopes before it cancel against those at the preset's own biases
  (Nozaki, Delbruck: Temperature and parasitic photocurrent effects in dynamic vision sensors, 2017). The
  article itself could not be read; jAER, the software of its authors, estimates thresholds by this law and
  cites it, with 0.7 / 0.7² / 20 = 0.071 before the logarithm.
- `RefrBp`: `refractory.period` goes with 1 / current, as a constant current charges a capacitor. So does
  jAER, whose own numbers for capacitor and voltage are guesses and say so. No recording at hand measures
  it.
- `PrBp`, `PrSFBp`: nothing to be said of `bandwidth.cutoff`. A pole goes with its current only where
  neither the photocurrent nor another pole is slower, and which one limits the preset is not known.
- `leak` and `shot` follow the thresholds by themselves, as their `threshold` says at which one they were
  measured.

These are laws of ratios. Which currents the recordings were made with that gave the preset its thresholds
is not known, so no table from currents to values is given: with your own currents before and after a
change, multiply `threshold.on` by ln(I_on / I_diff) after over before, and `refractory.period` by the
current before over after.

How far currents on a chip are from those asked for has not been measured here.

For the IMX636 and the Gen4.1, `bias_diff_on` and `bias_diff_off` set `threshold.on` and `threshold.off`,
`bias_fo` sets `bandwidth.cutoff`, `bias_hpf` sets `high_pass.cutoff` (an effect that no preset has), and
`bias_refr` sets `refractory.period`. No curve from any of these settings to a value was found in the parts of
Prophesee's public documentation that could be read, and none is invented: fit the values to a recording.
Their presets' `leak` and `shot` follow the thresholds, too, as those of all presets of cameras do, except the
`shot` of the Gen3, which has two thresholds where that effect knows one.
"""


def page() -> str:
    """Return the page."""
    parts = [HEAD]
    for name in sorted(read_presets()):
        found = preset_sources(name)
        parts.append(f"\n## {name}\n\n{found.about}\n\n| | value | source |\n|---|---|---|\n")
        for one in found.values:
            parts.append(f"| `{one.name}` | {one.value} {one.unit}".rstrip() + f" | {one.source} |\n")
    return "".join(parts)


if __name__ == "__main__":
    Path(__file__).with_suffix(".md").write_text(page(), "utf-8")
