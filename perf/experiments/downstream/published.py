"""A published FireNet as a checkpoint of dase.tasks, and what it is worth on a recording.

    python -m perf.experiments.downstream.published WEIGHTS RECORDING --camera davis240c --out OUT

WEIGHTS are those of Scheerlinck et al. (Fast image reconstruction with an event camera, 2020), whose file
calls them `firenet_no_skip`: five bins of voxels, normalised, 16 channels. They are no part of the project.
The layers are those of `dase.tasks.FireNet` under other names, so only names change. The network is judged as
`real` judges those that were trained, on normalised voxels; what it was trained on is other events, in
windows between frames.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path

import torch

import dase
from dase.tasks.checkpoints import save_checkpoint

KIND = "published FireNet"
"""What it is called in rows and tables."""
WINDOW = 1 / 60
"""The windows that the networks of `real` are trained on [s]."""
LAYERS = {
    "head": ("head.conv.conv2d",),
    # of a GRU: how much is new, then how much of the old is used
    "memories.0.gates": ("head.recurrent_block.update_gate", "head.recurrent_block.reset_gate"),
    "memories.0.proposal": ("head.recurrent_block.out_gate",),
    "residual.0.first": ("resblocks.0.conv.conv1",),
    "residual.0.second": ("resblocks.0.conv.conv2",),
    "memories.1.gates": (
        "resblocks.0.recurrent_block.update_gate",
        "resblocks.0.recurrent_block.reset_gate",
    ),
    "memories.1.proposal": ("resblocks.0.recurrent_block.out_gate",),
    "residual.1.first": ("resblocks.1.conv1",),
    "residual.1.second": ("resblocks.1.conv2",),
    "last": ("pred.conv2d",),
}
"""Our layers and the published ones whose outputs, one behind the other, are theirs."""


def firenet_of(published: Mapping[str, torch.Tensor]) -> dase.tasks.FireNet:
    """Return our FireNet with published weights, names beginning with `net.`.

    Raises:
        KeyError: A layer is missing.
        ValueError: There is a layer more.
        RuntimeError: A shape is not ours.
    """
    names = {f"net.{name}.{part}" for of in LAYERS.values() for name in of for part in ("weight", "bias")}
    if more := sorted(set(published) - names):
        raise ValueError(f"published weights have what FireNet has not: {', '.join(more)}")
    channels, bins = published["net.head.conv.conv2d.weight"].shape[:2]
    network = dase.tasks.FireNet(bins, channels)
    network.load_state_dict({
        f"{ours}.{part}": torch.cat([published[f"net.{name}.{part}"] for name in theirs])
        for ours, theirs in LAYERS.items()
        for part in ("weight", "bias")
    })  # fmt: skip
    return network.eval()


def save_published(weights: Path, checkpoint: Path, window: float) -> None:
    """Write published weights as a checkpoint of dase.tasks that is judged in windows [s]."""
    found = torch.load(weights, map_location="cpu", weights_only=True)  # tensors and numbers, no code
    network = firenet_of(found["state_dict"])
    optimizer = torch.optim.AdamW(network.parameters())
    save_checkpoint(checkpoint, network, network, optimizer, step=0, steps=0, window=window)


def main() -> None:
    """Judge, and write a row."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("weights", type=Path)
    ask.add_argument("recording", type=Path)
    ask.add_argument("--camera", required=True, help="preset, as in the rows of `real`")
    ask.add_argument("--offset", type=float, default=0.0)
    ask.add_argument("--window", type=float, default=WINDOW, help="seconds")
    ask.add_argument("--device")
    ask.add_argument("--out", type=Path, required=True, help="folder: checkpoint, pictures, results.jsonl")
    args = ask.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    checkpoint = args.out / "published.pt"
    save_published(args.weights, checkpoint, args.window)
    judged = dase.tasks.evaluate(
        checkpoint, args.recording, offset=args.offset, normalise=True, device=args.device, out=args.out
    )
    row = {
        "recording": args.recording.stem, "kind": KIND, "camera": args.camera, "window": args.window,
        "end": {name: round(value, 5) for name, value in judged.metrics.items()}, "frames": judged.windows,
    }  # fmt: skip
    with (args.out / "results.jsonl").open("a", encoding="utf-8") as log:
        log.write(json.dumps(row) + "\n")
    print(judged)


if __name__ == "__main__":
    main()
