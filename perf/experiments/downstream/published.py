"""Published networks of reconstruction, and what they are worth on a recording.

    python -m perf.experiments.downstream.published NETWORK WEIGHTS RECORDING --camera davis240c --out OUT

WEIGHTS are files of others and no part of the project. `firenet` is that of Scheerlinck et al. (Fast image
reconstruction with an event camera, 2020), whose file calls it `firenet_no_skip`: five bins of voxels,
normalised, 16 channels. `firenet+` is the same network as Stoffregen et al. (Reducing the sim-to-real gap
for event cameras, 2020) trained it, on voxels as they are. Their layers are those of `dase.tasks.FireNet`
under other names, so only names change. `pie-net` and `pie-net-lite` are those of the package event-pienet
(Qu, PIE-Net, 2026; MIT), which has to be installed, as their layers are its own; on voxels as they are.
Networks are judged as `real` judges those that were trained; what they were trained on is other events, in
other windows.
"""

from __future__ import annotations

import argparse
import json
import pathlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from dase.tasks.evaluation import judge_network
from dase.tasks.event_networks import EventNetwork, FireNet, Memory
from dase.torch.stream import choose_device

NETWORKS = {
    "firenet": "published FireNet", "firenet+": "published FireNet+", "pie-net": "published PIE-Net",
    "pie-net-lite": "published PIE-Net-Lite",
}  # fmt: skip
"""What they are called in rows and tables."""
NORMALISED = ("firenet",)
"""Those that were trained on voxels that are normalised."""
WINDOW = 1 / 60
"""The windows that the networks of `real` are trained on [s]."""


def _layers(
    head: str, cells: tuple[str, str], blocks: tuple[str, str], last: str
) -> dict[str, tuple[str, ...]]:
    """Return our layers and the published ones whose outputs, one behind the other, are theirs."""
    out: dict[str, tuple[str, ...]] = {"head": (head,), "last": (last,)}
    for n, (cell, block) in enumerate(zip(cells, blocks, strict=True)):
        # of a GRU: how much is new, then how much of the old is used
        out[f"memories.{n}.gates"] = (f"{cell}.update_gate", f"{cell}.reset_gate")
        out[f"memories.{n}.proposal"] = (f"{cell}.out_gate",)
        out[f"residual.{n}.first"] = (f"{block}.conv1",)
        out[f"residual.{n}.second"] = (f"{block}.conv2",)
    return out


LAYERS = {
    "firenet": _layers(
        "net.head.conv.conv2d", ("net.head.recurrent_block", "net.resblocks.0.recurrent_block"),
        ("net.resblocks.0.conv", "net.resblocks.1"), "net.pred.conv2d",
    ),
    "firenet+": _layers("head.conv2d", ("G1", "G2"), ("R1", "R2"), "pred.conv2d"),
}  # fmt: skip
"""Names of the layers in files of FireNet."""


def firenet_of(published: Mapping[str, torch.Tensor], layers: Mapping[str, tuple[str, ...]]) -> FireNet:
    """Return our FireNet with published weights; `layers` are their names, by ours.

    Raises:
        KeyError: A layer is missing.
        ValueError: There is a layer more.
        RuntimeError: A shape is not ours.
    """
    names = {f"{name}.{part}" for of in layers.values() for name in of for part in ("weight", "bias")}
    if more := sorted(set(published) - names):
        raise ValueError(f"published weights have what FireNet has not: {', '.join(more)}")
    channels, bins = published[f"{layers['head'][0]}.weight"].shape[:2]
    network = FireNet(bins, channels)
    network.load_state_dict({
        f"{ours}.{part}": torch.cat([published[f"{name}.{part}"] for name in theirs])
        for ours, theirs in layers.items()
        for part in ("weight", "bias")
    })  # fmt: skip
    return network.eval()


class _Settings:
    """Stands where a file holds its project's settings: they are data here, and their code is not run."""


def read_weights(path: Path) -> dict[str, torch.Tensor]:
    """Return tensors by their names, of a file that may hold settings beside them; no code of it is run."""
    known: list[Any] = [(_Settings, "parse_config.ConfigParser"), pathlib.PosixPath]
    with torch.serialization.safe_globals(known):
        found = torch.load(path, map_location="cpu", weights_only=True)
    weights: dict[str, torch.Tensor] = found.get("state_dict", found)
    return weights


class PieNet(EventNetwork):
    """A network of event-pienet that is handed what it remembers, where its own keeps it.

    Args:
        theirs: As the package makes it.
    """

    kind, task = "pie-net", "reconstruction"

    def __init__(self, theirs: Any):
        super().__init__(bins=5)
        self.theirs = theirs

    def forward(self, inputs: torch.Tensor, memory: Memory | None = None) -> tuple[torch.Tensor, Memory]:
        """Return the intensity at the window's end, (B, 1, H, W), and the memory; inputs (B, C, H, W)."""
        net = self.theirs
        if memory is None:
            net.reset_states()
        else:
            net.f0, net.prev_var, *states = memory
            net.p_states = list(zip(states[::2], states[1::2], strict=True))
        image = net(inputs)["image"]
        return image, [net.f0, net.prev_var, *(state for pair in net.p_states for state in pair)]


def open_network(name: str, weights: Path) -> EventNetwork:
    """Return a published network of NETWORKS with the weights of a file."""
    found = read_weights(weights)
    if name in LAYERS:
        return firenet_of(found, LAYERS[name])
    import pie_net

    theirs = pie_net.load_model(pretrained=False, device="cpu", variant=name)
    # as the package does: the larger file has three blocks more than the network it is for
    missing, _ = theirs.load_state_dict(found, strict=False)
    if missing:
        raise ValueError(f"published weights lack what {name} has: {', '.join(missing)}")
    return PieNet(theirs).eval()


def main() -> None:
    """Judge, and write a row."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("network", choices=NETWORKS)
    ask.add_argument("weights", type=Path)
    ask.add_argument("recording", type=Path)
    ask.add_argument("--camera", required=True, help="preset, as in the rows of `real`")
    ask.add_argument("--offset", type=float, default=0.0)
    ask.add_argument("--window", type=float, default=WINDOW, help="seconds")
    ask.add_argument("--device")
    ask.add_argument("--out", type=Path, required=True, help="folder: pictures, results.jsonl")
    args = ask.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    network = open_network(args.network, args.weights).to(choose_device(args.device))
    judged = judge_network(
        network,
        args.window,
        args.recording,
        offset=args.offset,
        normalise=args.network in NORMALISED,
        out=args.out,
    )
    row = {
        "recording": args.recording.stem, "kind": NETWORKS[args.network], "camera": args.camera,
        "window": args.window, "end": {name: round(value, 5) for name, value in judged.metrics.items()},
        "frames": judged.windows,
    }  # fmt: skip
    with (args.out / "results.jsonl").open("a", encoding="utf-8") as log:
        log.write(json.dumps(row) + "\n")
    print(judged)


if __name__ == "__main__":
    main()
