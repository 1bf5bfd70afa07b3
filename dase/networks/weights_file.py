"""Files of learned thresholds: the network's weights, and how it is built, as safetensors."""

from __future__ import annotations

import json
import os
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from dase.errors import InputError, checked_integer
from dase.events import LARGEST_SIDE
from dase.files.atomic_file import replacing
from dase.files.text_files import parse_json, stands_for
from dase.networks.threshold_network import NetworkShape, ThresholdNet

KIND = "dase.learned_threshold"
"""Name of the file's only entry of metadata, the shape as JSON; of several the order is up to chance."""


def save_net(path: Path, net: ThresholdNet) -> None:
    """Write a network; the file appears whole or not at all."""
    tensors = {name: value.detach().cpu().contiguous() for name, value in net.state_dict().items()}
    with replacing(path) as temporary:
        # `save_file` would let nobody else read it
        temporary.write_bytes(save(tensors, {KIND: json.dumps(asdict(net.shape))}))


def load_net(path: Path) -> ThresholdNet:
    """Read a network; raises InputError where the file holds none."""
    if not os.path.isfile(path):
        raise InputError(f"the weights {path} do not exist; they belong beside the sensor file")
    with path.open("rb") as head:
        pointer = stands_for(head.read(1024))
    if pointer:
        raise InputError(f"the weights {path}: {pointer}")
    try:
        with safe_open(path, "pt") as file:
            shape = (file.metadata() or {}).get(KIND)
            if shape is None:
                raise InputError(f"{path} does not hold learned thresholds")
            of_shape, names = parse_shape(shape), file.keys()
            with torch.device("meta"):  # without memory: a small file may claim a large network
                wanted = {
                    name: list(value.shape) for name, value in ThresholdNet(of_shape).state_dict().items()
                }
            if wanted != {name: file.get_slice(name).get_shape() for name in names}:
                raise InputError(f"{path} does not hold the weights of the network that it says it holds")
            tensors = {name: file.get_tensor(name) for name in names}
        net = ThresholdNet(of_shape)
        net.load_state_dict(tensors)
    except (SafetensorError, RuntimeError, KeyError, ValueError, TypeError) as error:
        raise InputError(f"{path} does not hold learned thresholds: {error}") from error
    net.eval()
    return net


def parse_shape(text: str) -> NetworkShape:
    """Return the shape of a network from JSON."""
    table = parse_json(text, "the shape of the network")
    if not isinstance(table, dict):
        raise InputError(f"the shape of the network must be a table, got {type(table).__name__}")
    fixed: dict[str, Any] = {n: tuple(v) if isinstance(v, list) else v for n, v in table.items()}
    shape = NetworkShape(**fixed)
    # a network is built before its weights are laid beside it, so what it takes is bounded here
    checked_integer("channels", shape.channels, 1, 1025)
    checked_integer("depth", shape.depth, 1, 9)
    pairs = (("pattern", shape.pattern, LARGEST_SIDE), ("table", shape.table, 1024))
    for name, pair, most in pairs:
        if pair is not None and (not isinstance(pair, tuple) or len(pair) != 2):
            raise InputError(f"{name} must be two whole numbers, got {pair!r}")
        for number in pair or ():
            checked_integer(name, number, 1, most + 1)
    for name in ("coordinates", "split", "literal"):
        if not isinstance(getattr(shape, name), bool):
            raise InputError(f"{name} must be true or false, got {getattr(shape, name)!r}")
    return shape


@lru_cache(maxsize=4)
def _load_cached(path: Path, changed: int) -> ThresholdNet:
    return load_net(path)


def predict_thresholds(
    path: Path, grey: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32], float]:
    """Return mean and spread of the thresholds for an image (H, W) in [0, 1], and the level of the mean.

    Raises:
        InputError: The file holds no network, or one for a sensor of another size.
    """
    net = _load_cached(path, path.stat().st_mtime_ns) if os.path.isfile(path) else load_net(path)
    size = grey.shape[1], grey.shape[0]
    if net.shape.pattern not in (None, size):
        made = "x".join(map(str, net.shape.pattern or ()))
        raise InputError(f"{path} was learned for a {made} sensor, the scene is {size[0]}x{size[1]}")
    with torch.no_grad():
        maps = net(torch.from_numpy(np.clip(grey, 0, 1))[None])
        level = float(net.level[0].exp())
    return maps.mu[0].numpy(), maps.sigma[0].numpy(), level
