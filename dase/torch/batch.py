"""What a network is trained with, and tested on."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

import torch

from dase.formatting import fit_to_screen


@dataclass(frozen=True, repr=False)
class Batch:
    """B slots of T windows of time that follow each other, all tensors of one device.

    A slot shows one scene or recording; the next batch goes on where it stopped, unless `reset` says that
    something else begins.

    Args:
        inputs: Representations of the events of windows, float32, shape (T, B, C, H, W).
        frames: Intensities at the ends of windows, linear, in [0, 1], float32, shape (T, B, 1, H, W).
        flow: Velocity of what is seen at the ends of windows, x and y [px/s], float32, shape (T, B, 2, H, W).
        reset: Whether a window is the first of its scene, so that memories must be cleared, shape (T, B).
        thresholds: Nominal thresholds of the scenes [log intensity], OFF before ON, float32, shape (B, 2).
        parameters: All parameters of the sensors by `effect.parameter`, float32, each of shape (B,).
        valid: Whether what labels there are hold at a window, shape (T, B); None where they all do.
    """

    inputs: torch.Tensor
    frames: torch.Tensor
    flow: torch.Tensor
    reset: torch.Tensor
    thresholds: torch.Tensor
    parameters: dict[str, torch.Tensor] = field(default_factory=dict)
    valid: torch.Tensor | None = None

    def __repr__(self) -> str:
        """Return the shapes of all tensors."""
        lines = [f"Batch on {self.inputs.device}"]
        for item in dataclasses.fields(self):
            value = getattr(self, item.name)
            if isinstance(value, dict):
                lines += [f"  {item.name}['{name}']  {tuple(one.shape)}" for name, one in value.items()]
            elif value is not None:
                lines.append(f"  {item.name}  {tuple(value.shape)} {str(value.dtype).removeprefix('torch.')}")
        return fit_to_screen(lines)

    def map(self, change: Any) -> Batch:
        """Return the batch with `change` done to every tensor."""
        changed: dict[str, Any] = {}
        for item in dataclasses.fields(self):
            value = getattr(self, item.name)
            if isinstance(value, dict):
                changed[item.name] = {name: change(one) for name, one in value.items()}
            else:
                changed[item.name] = None if value is None else change(value)
        return Batch(**changed)

    def copy_to(self, other: Batch) -> None:
        """Write the batch into the memory of another one of the same shapes, on any device."""
        for item in dataclasses.fields(self):
            mine, theirs = getattr(self, item.name), getattr(other, item.name)
            if isinstance(mine, dict):
                for name, value in mine.items():
                    theirs[name].copy_(value, non_blocking=True)
            elif mine is not None:
                theirs.copy_(mine, non_blocking=True)

    def to(self, device: str | torch.device, non_blocking: bool = False) -> Batch:
        """Return the batch on a device."""
        return self.map(lambda one: one.to(device, non_blocking=non_blocking))

    def pin_memory(self) -> Batch:
        """Return the batch in pinned memory, as a `DataLoader` asks for."""
        return self.map(lambda one: one.pin_memory())

    def detach(self) -> Batch:
        """Return the batch without gradients."""
        return self.map(lambda one: one.detach())
