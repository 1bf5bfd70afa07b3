"""Writes docs/presets.md from the preset files: python docs/presets.py."""

from __future__ import annotations

from pathlib import Path

from dase.simulation.biases import DAVIS_LAWS
from dase.simulation.preset_sources import preset_sources
from dase.simulation.sensor_file import read_presets

HEAD = """# Presets

Built-in sensors: every value with its unit, and where it comes from. `docs/presets.py` writes this page from
the files in `dase/presets`, which `dase presets show NAME` prints, too; edit them. What no source
is given for beside a value is said in the text above its table. How close presets come to recordings is in
[effects.md](effects.md). A preset is where to begin: `dase fit` fits it to a recording of your own camera.

## Other biases than the default

For the DAVIS346 laws of ratios are published. `dase bias` changes a sensor file by them, from settings before
to settings after, and `dase synth --bias` simulates with others, in the same words:

```sh
dase bias                                                        # what is known of biases
dase bias fitted.toml ONBn=5/255:6/200 DiffBn=4/39 -o dull.toml  # coarse/fine; DiffBn has not changed
dase bias fitted.toml RefrBp=2nA:8nA -o quick.toml               # or currents; +20% for one a fifth larger
dase synth dull --sensor fitted.toml --bias ONBn=5/255:6/200 --bias DiffBn=4/39
```

In Python `dase.simulation.biases.with_biases` takes currents:

```python
from dase.simulation.biases import bias_current, with_biases

before = {{"ONBn": bias_current(5, 255), "OFFBn": bias_current(4, 1), "DiffBn": bias_current(4, 39)}}
after = before | {{"ONBn": bias_current(6, 200)}}  # coarse and fine setting
less_sensitive = with_biases(fitted, before, after)
```

| biases | what follows | law | source | not known |
|---|---|---|---|---|
{laws}

The sensor must be one that was fitted to a recording with the biases before: with which currents the
recordings were made that gave the presets their values is not known (their files do not say), so no table
from currents to values is given. A bias of which no law is published is refused, and what it sets is said.
How far currents on a chip are from those asked for has not been measured here.

For the IMX636, the Gen4.1 and the Gen3, `bias_diff_on` and `bias_diff_off` (relative to `bias_diff`) set
`threshold.on` and `threshold.off`, `bias_fo` sets `bandwidth.cutoff`, `bias_hpf` sets `high_pass.cutoff` (an
effect that no preset has), and `bias_refr` sets `refractory.period`. Prophesee's public page of biases, of
which we could read the beginning, says what each does and in which direction; no curve from any of these
settings to a value was found, jAER has none either (it answers "not a number" for these cameras), and none
is invented: fit the values to a recording. Step responses of the IMX636 are measured in McReynolds, Graca,
Kulesza, McMahon-Crabtree: Re-interpreting the step-response probability curve to extract fundamental
physical parameters of event-based vision sensors, 2024 (arXiv 2404.07656); beyond its summary it could not be
read, so whether it has thresholds by setting is not known. Their presets' `leak` and `shot` follow the
thresholds, too, as those of all presets of cameras do, except the `shot` of the Gen3, which has two
thresholds where that effect knows one.
"""


def page() -> str:
    """Return the page."""
    laws = (
        f"| {', '.join(law.biases)} | {', '.join(f'`{v}`' for v in law.values) or 'nothing'} | {law.law} | "
        f"{law.source} | {law.uncertainty} |"
        for law in DAVIS_LAWS
    )
    parts = [HEAD.format(laws="\n".join(laws))]
    for name in sorted(read_presets()):
        found = preset_sources(name)
        parts.append(f"\n## {name}\n\n{found.about}\n\n| | value | source |\n|---|---|---|\n")
        for one in found.values:
            parts.append(f"| `{one.name}` | {one.value} {one.unit}".rstrip() + f" | {one.source} |\n")
    return "".join(parts)


if __name__ == "__main__":
    Path(__file__).with_suffix(".md").write_text(page(), "utf-8")
