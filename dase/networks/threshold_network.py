"""The network that tells the thresholds of pixels from an image.

It follows "How to Learn a Domain-Adaptive Event Simulator?" (2021), section 4.2, with the changes that
docs/adaptation.md measures.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import nn
from torch.nn import functional as F

LEAKY_SLOPE = 0.2
"""Of the leaky rectifiers."""

MAGNITUDE_FLOOR = 1e-6
"""Under the root of gradient magnitudes, whose slope at 0 would be infinite."""


@dataclass(frozen=True, kw_only=True)
class NetworkShape:
    """What has to be known to build a `ThresholdNet` again.

    Args:
        channels: Of the UNet at full resolution.
        depth: How often it halves the resolution.
        coordinates: Whether it sees x and y of each pixel.
        pattern: Width and height of a sensor that has an offset for every column and row, or None.
        table: Nodes of brightness and of edge strength of a table that is added, or None.
        split: Whether ON and OFF thresholds differ, by one factor.
        literal: Whether μ and log σ come straight from the network, as in the paper.
    """

    channels: int = 16
    depth: int = 3
    coordinates: bool = False
    pattern: tuple[int, int] | None = None
    table: tuple[int, int] | None = None
    split: bool = False
    literal: bool = False


@dataclass
class ThresholdMaps:
    """Distributions of thresholds [log intensity].

    Args:
        mu: Mean, shape (B, H, W).
        sigma: Standard deviation, shape (B, H, W).
        ratio: ON threshold over OFF threshold, a scalar; both lie evenly about `mu` in their logarithms.
        residual: What the anchor holds, shape (B, 2, H, W).
    """

    mu: torch.Tensor
    sigma: torch.Tensor
    ratio: torch.Tensor
    residual: torch.Tensor

    def by_polarity(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mu and sigma with OFF before ON, each of shape (B, 2, H, W)."""
        factor = torch.stack([self.ratio.rsqrt(), self.ratio.sqrt()]).view(1, 2, 1, 1)
        return self.mu[:, None] * factor, self.sigma[:, None] * factor


class ResidualBlock(nn.Module):
    """Two convolutions added to their input (He et al., Deep residual learning, 2016); no normalisation."""

    def __init__(self, channels: int):
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return an image of the same shape."""
        return F.leaky_relu(x + self.second(F.leaky_relu(self.first(x), LEAKY_SLOPE)), LEAKY_SLOPE)


class UNet(nn.Module):
    """Residual encoder, skips, two outputs that begin at zero (Ronneberger et al., U-Net, 2015).

    Args:
        inputs: Channels of the image.
        channels: Channels at full resolution; they double with every level, four times as many at most.
        depth: How often the resolution is halved.
    """

    def __init__(self, inputs: int, channels: int, depth: int):
        super().__init__()
        wide = [channels * min(2**level, 4) for level in range(depth + 1)]
        self.stem = nn.Conv2d(inputs, wide[0], 3, padding=1)
        self.encode = nn.ModuleList(ResidualBlock(n) for n in wide)
        self.down = nn.ModuleList(nn.Conv2d(a, b, 3, 2, 1) for a, b in pairwise(wide))
        self.up = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in pairwise(wide))
        self.decode = nn.ModuleList(nn.Conv2d(n, n, 3, padding=1) for n in wide[:-1])
        self.last = nn.Conv2d(wide[0], 2, 1)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return two maps (B, 2, H, W) of an image (B, inputs, H, W) of any size."""
        x = F.leaky_relu(self.stem(x), LEAKY_SLOPE)
        skips = []
        for encode, down in zip(self.encode, self.down, strict=False):
            skips.append(encode(x))
            x = F.leaky_relu(down(skips[-1]), LEAKY_SLOPE)
        x = self.encode[-1](x)
        for level in reversed(range(len(skips))):
            skip = skips[level]
            x = self.up[level](x)
            # autocast would copy every number in float32
            with torch.autocast(x.device.type, enabled=False):
                x = F.interpolate(x, scale_factor=2, mode="nearest")
            # odd sides come back one pixel too long
            x = F.leaky_relu(
                self.decode[level](x[..., : skip.shape[-2], : skip.shape[-1]] + skip), LEAKY_SLOPE
            )
        out: torch.Tensor = self.last(x)
        return out


class ThresholdNet(nn.Module):
    """Threshold distributions from the middle frame: μ = exp(g0 + u0), σ = exp(g1 + u1).

    Two global numbers g find the level quickly; the residual u of the UNet begins at zero and is held near it
    by the anchor of the training loss, because pixels without events identify nothing.

    Args:
        shape: How it is built.
        mu: Mean threshold to begin with [log intensity].
        sigma: Its standard deviation [log intensity].
    """

    def __init__(self, shape: NetworkShape, *, mu: float = 0.5, sigma: float = 0.15):
        super().__init__()
        self.shape = shape
        self.unet = UNet(3 if shape.coordinates else 1, shape.channels, shape.depth)
        self.level = nn.Parameter(torch.tensor([math.log(mu), math.log(sigma)]))
        self.asymmetry = nn.Parameter(torch.zeros(()), requires_grad=shape.split)
        if shape.table is not None:
            self.table = nn.Parameter(torch.zeros(2, *shape.table))
        if shape.pattern is not None:
            self.columns = nn.Parameter(torch.zeros(2, shape.pattern[0]))
            self.rows = nn.Parameter(torch.zeros(2, shape.pattern[1]))

    def residual(self, grey: torch.Tensor) -> torch.Tensor:
        """Return u of the UNet, shape (B, 2, H, W) float32, for images (B, H, W) in [0, 1]."""
        # mean and spread of natural images
        x = ((grey - 0.449) / 0.226)[:, None]
        if self.shape.coordinates:
            height, width = grey.shape[-2:]
            across = torch.linspace(-1, 1, width, device=grey.device).expand(len(grey), 1, height, width)
            along = torch.linspace(-1, 1, height, device=grey.device)[:, None].expand_as(across)
            x = torch.cat([x, across, along], 1)
        # to learn with alone: what was learned gives thresholds in full precision, as on a CPU
        half = grey.is_cuda and torch.is_grad_enabled()
        with torch.autocast(grey.device.type, torch.bfloat16, enabled=half):
            u = self.unet(x.contiguous(memory_format=torch.channels_last))
        return u.float().contiguous()

    def forward(self, grey: torch.Tensor) -> ThresholdMaps:
        """Return the maps for images (B, H, W) in [0, 1]."""
        u = self.residual(grey)
        ratio = self.asymmetry.exp()
        if self.shape.literal:
            return ThresholdMaps(self.level[0].exp() + u[:, 0], (self.level[1] + u[:, 1]).exp(), ratio, u)
        total = self.level.view(1, 2, 1, 1) + u
        if self.shape.table is not None:
            total = total + interpolate_table(self.table, grey)
        if self.shape.pattern is not None:
            total = total + self.columns.view(1, 2, 1, -1) + self.rows.view(1, 2, -1, 1)
        mu, sigma = total.exp().unbind(1)
        return ThresholdMaps(mu, sigma, ratio, u)

    def node_weights(self, grey: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return how much rows (B, R, H, W) and columns (B, C, H, W) of the table count in each pixel.

        A node counts as much as its row times its column; without a table there is one.
        """
        if self.shape.table is None:
            return torch.ones_like(grey)[:, None], torch.ones_like(grey)[:, None]
        return node_weights(grey, self.shape.table)

    def roughness(self) -> torch.Tensor:
        """Return the mean square difference of neighbouring nodes of the table, a scalar, 0 without one."""
        if self.shape.table is None:
            return self.level.new_zeros(())
        return sum(
            (torch.diff(self.table, dim=axis).square().mean() for axis in (1, 2)), self.level.new_zeros(())
        )

    @torch.no_grad()
    def with_level(self, mu: float) -> ThresholdNet:
        """Return the same network with `mu` as its level, where a table can take up the difference."""
        other = copy.deepcopy(self)
        if self.shape.table is not None:
            off = math.log(mu) - other.level[0]
            other.level[0] += off
            other.table[0] -= off
        return other

    def unet_parameters(self) -> list[nn.Parameter]:
        """Return the parameters of the UNet."""
        return list(self.unet.parameters())

    def shared_parameters(self) -> list[nn.Parameter]:
        """Return all other parameters that are learned."""
        return [p for n, p in self.named_parameters() if not n.startswith("unet.") and p.requires_grad]


def interpolate_table(table: torch.Tensor, grey: torch.Tensor) -> torch.Tensor:
    """Interpolate a table by the brightness and the edge strength of every pixel.

    Args:
        table: Shape (2, nodes of brightness, nodes of edge strength). Brightness goes from 0 to 1, edge
            strength e from 0 to infinity, evenly in e / (e + 0.05), see `node_weights`.
        grey: Images in [0, 1], shape (B, H, W).

    Returns:
        Shape (B, 2, H, W).
    """
    rows, columns = node_weights(grey, (table.shape[1], table.shape[2]))
    across = torch.einsum("oij,bjn->boin", table, columns.flatten(2))
    return (across * rows.flatten(2)[:, None]).sum(2).view(len(grey), 2, *grey.shape[1:])


def node_weights(
    grey: torch.Tensor, nodes: tuple[int, int], *, middle_edge: float = 0.05
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the weights of the nodes of brightness and of edge strength, each (B, nodes, H, W).

    Args:
        grey: Images in [0, 1], shape (B, H, W).
        nodes: Numbers of nodes of brightness and of edge strength.
        middle_edge: Edge strength in the middle of the table [intensity/pixel]. Tables are files' content:
            they have to be read with the value that they were learned with.
    """
    brightness, edge = brightness_and_edge(grey)
    along = _axis_weights(edge / (edge + middle_edge), nodes[1])
    return _axis_weights(brightness.clamp(0, 1), nodes[0]), along


def _axis_weights(share: torch.Tensor, nodes: int) -> torch.Tensor:
    """Return the weights of linear interpolation between evenly spaced nodes, (B, nodes, H, W)."""
    place = share[:, None] * (nodes - 1) - torch.arange(nodes, device=share.device).view(1, -1, 1, 1)
    return (1 - place.abs()).clamp_min(0)


def brightness_and_edge(grey: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return brightness and edge strength of every pixel of images (B, H, W), each of their shape.

    Edge strength is the gradient of the image blurred by (1 2 1)/4 along both axes [intensity/pixel].
    """
    return grey, edge_strength(grey)


def edge_strength(grey: torch.Tensor, blurs: int = 1) -> torch.Tensor:
    """Return |∇| of images (B, H, W) by central differences, after some blurs by (1 2 1)/4 on both axes."""
    blurred = grey[:, None]
    for _ in range(blurs):
        for side in ((1, 1, 0, 0), (0, 0, 1, 1)):
            wide = F.pad(blurred, side, mode="replicate")
            axis = -1 if side[0] else -2
            first, last = (wide.narrow(axis, n, blurred.shape[axis]) for n in (0, 2))
            blurred = 0.5 * blurred + 0.25 * (first + last)
    wide = F.pad(blurred, (1, 1, 1, 1), mode="replicate")
    across = 0.5 * (wide[..., 1:-1, 2:] - wide[..., 1:-1, :-2])
    down = 0.5 * (wide[..., 2:, 1:-1] - wide[..., :-2, 1:-1])
    return torch.sqrt(across.square() + down.square())[:, 0]


def gradient_magnitude(maps: torch.Tensor) -> torch.Tensor:
    """Return |∇| of maps (B, C, H, W) by differences to the right and down, 0 past the border."""
    across = F.pad(maps[..., 1:] - maps[..., :-1], (0, 1))
    down = F.pad(maps[..., 1:, :] - maps[..., :-1, :], (0, 0, 0, 1))
    return torch.sqrt(across.square() + down.square() + MAGNITUDE_FLOOR)
