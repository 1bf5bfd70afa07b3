"""Networks from events to intensity and to optical flow, written from their papers.

All take windows one after the other, of any size: they pad to the multiple that they need and cut what they
return. What is remembered is handed in and out, so that one long sequence is the same as its parts:

    image, memory = network(inputs[0], None)        (B, C, H, W) → (B, 1, H, W)
    image, memory = network(inputs[1], memory)
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from torch import nn

from dase.errors import InputError, checked_integer

Memory = list[torch.Tensor]
"""What a network remembers, tensors (B, ...)."""


class ConvLstm(nn.Module):
    """Convolutional LSTM (Shi et al., 2015), without peepholes.

    Args:
        channels: Of what comes in and of each of the two memories.
    """

    def __init__(self, channels: int):
        super().__init__()
        self.channels = channels
        self.gates = nn.Conv2d(2 * channels, 4 * channels, 3, padding=1)

    def forward(self, x: torch.Tensor, memory: torch.Tensor | None) -> torch.Tensor:
        """Return hidden and cell state, (B, 2C, H, W), after x, (B, C, H, W), and the same before."""
        if memory is None:
            memory = x.new_zeros(len(x), 2 * self.channels, *x.shape[2:])
        hidden, cell = memory.to(x.dtype).chunk(2, 1)
        keep, write, show, new = self.gates(torch.cat([x, hidden], 1)).chunk(4, 1)
        cell = torch.sigmoid(keep) * cell + torch.sigmoid(write) * torch.tanh(new)
        return torch.cat([torch.sigmoid(show) * torch.tanh(cell), cell], 1)

    def seen(self, memory: torch.Tensor) -> torch.Tensor:
        """Return the part of what is remembered that other layers see, (B, C, H, W)."""
        return memory[:, : self.channels]


class ConvGru(nn.Module):
    """Convolutional GRU (Ballas et al., 2016).

    Args:
        channels: Of what comes in and of the memory.
    """

    def __init__(self, channels: int):
        super().__init__()
        self.gates = nn.Conv2d(2 * channels, 2 * channels, 3, padding=1)
        self.proposal = nn.Conv2d(2 * channels, channels, 3, padding=1)

    def forward(self, x: torch.Tensor, memory: torch.Tensor | None) -> torch.Tensor:
        """Return the memory, (B, C, H, W), after x, (B, C, H, W), and the memory before."""
        memory = torch.zeros_like(x) if memory is None else memory.to(x.dtype)
        update, use = torch.sigmoid(self.gates(torch.cat([x, memory], 1))).chunk(2, 1)
        new = torch.tanh(self.proposal(torch.cat([x, use * memory], 1)))
        return (1 - update) * memory + update * new


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions beside their input.

    Args:
        channels: Of what comes in and out.
    """

    def __init__(self, channels: int):
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return features of the shape of x, (B, C, H, W)."""
        return F.relu(x + self.second(F.relu(self.first(x))))


class EventNetwork(nn.Module):
    """What all networks share: their names, their shape, and windows in sequence.

    Args:
        shape: What a network of this class is built with.
    """

    kind: ClassVar[str]
    """Name in files."""
    task: ClassVar[str]
    """`reconstruction` or `flow`."""
    multiple: ClassVar[int] = 1
    """Rows and columns are padded to multiples of it."""

    def __init__(self, **shape: int):
        super().__init__()
        for name, value in shape.items():
            checked_integer(name, value, 1, 1025)
        self.shape = shape

    @property
    def parameter_count(self) -> int:
        """Number of trained numbers."""
        return sum(p.numel() for p in self.parameters())

    def padded(self, inputs: torch.Tensor) -> torch.Tensor:
        """Return inputs (B, C, H, W) with rows and columns of zeros up to the next multiple."""
        if inputs.ndim != 4 or inputs.shape[1] != self.shape["bins"]:
            bins = self.shape["bins"]
            raise InputError(
                f"{self.kind}: inputs must have shape (B, {bins}, H, W), got {tuple(inputs.shape)}"
            )
        height, width = inputs.shape[2:]
        padded = F.pad(inputs, (0, -width % self.multiple, 0, -height % self.multiple))
        # a processor is faster where the channels of a pixel lie together; what comes after keeps the order
        return padded if padded.is_cuda else padded.contiguous(memory_format=torch.channels_last)

    def sequence(
        self, inputs: torch.Tensor, reset: torch.Tensor | None = None, memory: Memory | None = None
    ) -> tuple[torch.Tensor, Memory | None]:
        """Return what is made of windows that follow each other, and what is remembered behind them.

        Args:
            inputs: Windows, shape (T, B, C, H, W).
            reset: Whether a window begins something else, bool, shape (T, B).
            memory: What was returned for the windows before; None for none.

        Returns:
            Shape (T, B, 1 or 2, H, W).
        """
        made = []
        for step, window in enumerate(inputs):
            if memory is not None and reset is not None:
                kept = (~reset[step]).view(-1, 1, 1, 1)
                # not a product: what was infinite would stay
                memory = [torch.where(kept, one, torch.zeros_like(one)) for one in memory]
            one, memory = self(window, memory)
            made.append(one)
        return torch.stack(made), memory


class E2VidNet(EventNetwork):
    """The recurrent UNet of E2VID (Rebecq et al., 2019), as Stoffregen et al. (2020) train it.

    A 5x5 head, three 5x5 encoders of stride 2 with a ConvLSTM each, two residual blocks, three decoders that
    add what the encoders had, enlarge twofold and filter 5x5, a 1x1 last layer without a sigmoid. No
    normalisation layers. The papers' width is 32 channels; 16 has a quarter of the parameters.

    Args:
        bins: Channels C of the inputs.
        channels: Of the head; twice as many behind every encoder.
    """

    kind = "e2vid"
    task = "reconstruction"
    multiple = 8

    def __init__(self, bins: int = 5, channels: int = 32):
        super().__init__(bins=bins, channels=channels)
        widths = [channels * 2**level for level in range(4)]
        self.head = nn.Conv2d(bins, widths[0], 5, padding=2)
        self.encoders = nn.ModuleList(nn.Conv2d(a, b, 5, 2, 2) for a, b in pairwise(widths))
        self.memories = nn.ModuleList(ConvLstm(width) for width in widths[1:])
        self.residual = nn.Sequential(ResidualBlock(widths[3]), ResidualBlock(widths[3]))
        self.decoders = nn.ModuleList(nn.Conv2d(b, a, 5, padding=2) for a, b in pairwise(widths))
        self.last = nn.Conv2d(widths[0], 1, 1)

    def forward(self, inputs: torch.Tensor, memory: Memory | None = None) -> tuple[torch.Tensor, Memory]:
        """Return the intensity at the window's end, (B, 1, H, W), and the memory; inputs (B, C, H, W)."""
        x = F.relu(self.head(self.padded(inputs)))
        head, skips, after = x, [], []
        for level, (encoder, cell) in enumerate(zip(self.encoders, self.memories, strict=True)):
            after.append(cell(F.relu(encoder(x)), None if memory is None else memory[level]))
            x = cell.seen(after[-1])
            skips.append(x)
        x = self.residual(x)
        for level in (2, 1, 0):
            x = F.relu(self.decoders[level](enlarged(x + skips[level])))
        return self.last(x + head)[..., : inputs.shape[2], : inputs.shape[3]], after


class FireNet(EventNetwork):
    """The small reconstruction network of Scheerlinck et al. (2020): full resolution, two GRUs, 3x3 filters.

    Args:
        bins: Channels C of the inputs.
        channels: Of all layers; 16 in the paper.
    """

    kind = "firenet"
    task = "reconstruction"

    def __init__(self, bins: int = 5, channels: int = 16):
        super().__init__(bins=bins, channels=channels)
        self.head = nn.Conv2d(bins, channels, 3, padding=1)
        self.memories = nn.ModuleList(ConvGru(channels) for _ in range(2))
        self.residual = nn.ModuleList(ResidualBlock(channels) for _ in range(2))
        self.last = nn.Conv2d(channels, 1, 1)

    def forward(self, inputs: torch.Tensor, memory: Memory | None = None) -> tuple[torch.Tensor, Memory]:
        """Return the intensity at the window's end, (B, 1, H, W), and the memory; inputs (B, C, H, W)."""
        x, after = F.relu(self.head(self.padded(inputs))), []
        for level, (cell, block) in enumerate(zip(self.memories, self.residual, strict=True)):
            after.append(cell(x, None if memory is None else memory[level]))
            x = block(after[-1])
        return self.last(x), after


class EvFlowNet(EventNetwork):
    """The UNet of EV-FlowNet (Zhu et al., 2018), as Stoffregen et al. (2020) train it: one output, no memory.

    Four 3x3 encoders of stride 2, two residual blocks, four decoders that take what the encoders had beside
    them, enlarge twofold and filter 3x3, a 1x1 last layer. The papers' width is 64 channels.

    Args:
        bins: Channels C of the inputs.
        channels: Behind the first encoder; twice as many behind every further one.
    """

    kind = "evflownet"
    task = "flow"
    multiple = 16

    def __init__(self, bins: int = 5, channels: int = 64):
        super().__init__(bins=bins, channels=channels)
        widths = [channels * 2**level for level in range(4)]
        last = max(channels // 2, 1)
        self.encoders = nn.ModuleList(nn.Conv2d(a, b, 3, 2, 1) for a, b in pairwise([bins, *widths]))
        self.residual = nn.Sequential(ResidualBlock(widths[3]), ResidualBlock(widths[3]))
        self.decoders = nn.ModuleList(
            nn.Conv2d(2 * a, b, 3, padding=1)
            for a, b in zip(widths, [last, *widths[:3]], strict=True)
        )  # fmt: skip
        self.last = nn.Conv2d(last, 2, 1)

    def forward(self, inputs: torch.Tensor, memory: Any = None) -> tuple[torch.Tensor, Memory]:
        """Return displacements x, y [px per window], (B, 2, H, W), and no memory, of inputs (B, C, H, W)."""
        x, skips = self.padded(inputs), []
        for encoder in self.encoders:
            x = F.relu(encoder(x))
            skips.append(x)
        x = self.residual(x)
        for level in (3, 2, 1, 0):
            x = F.relu(self.decoders[level](enlarged(torch.cat([x, skips[level]], 1))))
        return self.last(x)[..., : inputs.shape[2], : inputs.shape[3]], []


def enlarged(x: torch.Tensor) -> torch.Tensor:
    """Return features (B, C, H, W) of twice the rows and columns, bilinear, in their own precision."""
    if x.is_cuda:
        return enlarged_by_slices(x)
    return F.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)


def enlarged_by_slices(x: torch.Tensor) -> torch.Tensor:
    """Return what `enlarged` does, (B, C, H, W) of twice the rows and columns, without PyTorch's own kernel.

    On a GPU its gradient is summed by atomics, which was two thirds of a step of a flow network on an H100;
    on a processor it is the faster one.
    """
    for axis in (2, 3):
        size = x.shape[axis]
        before = torch.cat([x.narrow(axis, 0, 1), x.narrow(axis, 0, size - 1)], axis)
        after = torch.cat([x.narrow(axis, 1, size - 1), x.narrow(axis, size - 1, 1)], axis)
        pair = torch.lerp(x, before, 0.25), torch.lerp(x, after, 0.25)
        x = torch.stack(pair, axis + 1).flatten(axis, axis + 1)
    return x


NETWORKS: dict[str, type[EventNetwork]] = {one.kind: one for one in (E2VidNet, FireNet, EvFlowNet)}
"""Networks by their names in files."""
