"""Networks of flow on real events of a camera that only turned: the true flow follows from its gyroscope.

    python -m perf.experiments.downstream.rotation CHECKPOINT... --files EXCERPT.npz...

An excerpt holds events `t_us, x, y, p` of a short time, the sensor's size `wh`, and `flow` (1, 2, H, W), the
displacement [px] over that time. It is cut into as many equal windows as come nearest to those of the
training, and what a network says of each is added up. Pixels with events count. Prints a line of JSON for
each network and excerpt: error, outliers, error of no flow [px], and the error's share of the latter.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch

from dase import Voxels
from dase.tasks import load_network
from dase.tasks.flow_metrics import flow_errors


@torch.no_grad()
def judge(network: torch.nn.Module, window: float, bins: int, excerpt: Path) -> dict[str, float]:
    """Return what a network of flow is worth on an excerpt; `window` is that of its training [s]."""
    with np.load(excerpt) as file:
        t, x, y, p = (file[name] for name in ("t_us", "x", "y", "p"))
        (width, height), truth = file["wh"], torch.from_numpy(file["flow"])
    span = float(t[-1] - t[0]) * 1e-6
    count = max(round(span / window), 1)
    seconds = (t - t[0]) * 1e-6
    edges = np.linspace(0, span * (1 + 1e-9), count + 1)
    size = (int(width), int(height))
    grids = torch.from_numpy(Voxels(bins)((seconds, x, y, p), edges=edges, size=size))
    device = next(network.parameters()).device
    made = sum(network(grid[None].to(device))[0].float().cpu() for grid in grids)
    seen = torch.zeros(1, int(height), int(width), dtype=torch.bool)
    seen[0, y.astype(int), x.astype(int)] = True
    found = {name: float(value) for name, value in flow_errors(made, truth, seen).items()}
    return {"windows": count, **found, "share": found["aee"] / found["aee_zero"]}


def main() -> None:
    """Judge all networks on all excerpts."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("checkpoints", type=Path, nargs="+")
    ask.add_argument("--files", type=Path, nargs="+", required=True)
    ask.add_argument("--device", default="cpu")
    args = ask.parse_args()
    for checkpoint in args.checkpoints:
        network, window = load_network(checkpoint, torch.device(args.device))
        for excerpt in args.files:
            found = judge(network, window, network.shape["bins"], excerpt)
            row = {"network": checkpoint.parent.name, "excerpt": excerpt.stem, **found}
            print(
                json.dumps({k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()}),
                flush=True,
            )


if __name__ == "__main__":
    main()
