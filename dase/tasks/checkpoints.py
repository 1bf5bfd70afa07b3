"""Files of trainings: the network, the average of its weights, and all that going on needs."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import torch

from dase.errors import InputError
from dase.files.atomic_file import replacing
from dase.files.text_files import stands_for
from dase.learning import distributed
from dase.tasks.carried_memory import CarriedMemory
from dase.tasks.event_networks import NETWORKS, EventNetwork

KIND = "dase.tasks 1"
"""What a file calls itself."""


def save_checkpoint(
    path: Path,
    network: EventNetwork,
    averaged: EventNetwork,
    optimizer: torch.optim.Optimizer,
    *,
    step: int,
    steps: int,
    window: float,
    memory: CarriedMemory | None = None,
) -> None:
    """Write a training so that it can go on as if it had not stopped; the file appears whole or not at all.

    Args:
        path: File.
        network: With the weights of the last step.
        averaged: The same network with the average of the weights, for users.
        optimizer: Of the network.
        step: Steps done.
        steps: Steps that the learning rate was laid out for.
        window: Duration of the windows [s].
        memory: What the network remembers behind the last batch; None for a network without.
    """
    content = {
        "kind": KIND, "network": network.kind, "shape": network.shape, "weights": network.state_dict(),
        "averaged": averaged.state_dict(), "optimizer": optimizer.state_dict(), "step": step, "steps": steps,
        "window": window, "memory": {} if memory is None else memory.tensors,
    }  # fmt: skip
    with replacing(path) as temporary:
        torch.save(content, temporary)


def read_checkpoint(path: str | Path, device: str | torch.device = "cpu") -> dict[str, Any]:
    """Return what `save_checkpoint` wrote; raises InputError where the file is none."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: there is no such checkpoint")
    with path.open("rb") as head:
        pointer = stands_for(head.read(1024))
    if pointer:
        raise InputError(f"{path}: {pointer}")
    try:
        found = torch.load(path, map_location=device, weights_only=True)  # tensors and numbers, no code
    except (RuntimeError, EOFError, pickle.UnpicklingError, ValueError, KeyError) as error:
        raise InputError(f"{path}: is no checkpoint of dase.tasks: {str(error).splitlines()[0]}") from error
    if not isinstance(found, dict) or found.get("kind") != KIND or found.get("network") not in NETWORKS:
        raise InputError(f"{path}: is no checkpoint of dase.tasks")
    return found


def restore_training(
    path: Path,
    network: EventNetwork,
    averaged: EventNetwork,
    optimizer: torch.optim.Optimizer,
    *,
    steps: int,
    window: float,
    device: str | torch.device,
    memory: CarriedMemory | None = None,
) -> int:
    """Put a training where `path` says that it stopped, and return the steps done; 0 where there is no file.

    Raises:
        InputError: The file is of another network, number of steps or duration of windows [s].
    """
    if not path.exists():
        return 0
    found = read_checkpoint(path, device)
    asked = network.kind, network.shape, steps, window
    if (found["network"], found["shape"], found["steps"], found["window"]) != asked:
        raise InputError(f"{path.parent} holds another training: take its settings, or another folder")
    network.load_state_dict(found["weights"])
    averaged.load_state_dict(found["averaged"])
    optimizer.load_state_dict(found["optimizer"])
    # of several processes, the file has the scenes of the first; files of before have no memory
    if memory is not None and distributed.process_count() == 1:
        memory.tensors = found.get("memory", {})
    step: int = found["step"]
    return step


def load_network(path: str | Path, device: str | torch.device = "cpu") -> tuple[EventNetwork, float]:
    """Return the trained network, with averaged weights, and the windows that it was trained on [s].

    Args:
        path: `checkpoint.pt` of a training.
        device: Where it computes.

    Raises:
        InputError: The file holds none.
    """
    found = read_checkpoint(path, device)
    try:
        network = NETWORKS[found["network"]](**found["shape"])
        network.load_state_dict(found["averaged"])
        window = float(found["window"])
    except (RuntimeError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: the weights do not fit their network: {str(error).splitlines()[0]}"
        ) from error
    return network.to(device).eval(), window
