"""The networks of learned adaptation: thresholds from an image, and the bank of critics.

Both follow "How to Learn a Domain-Adaptive Event Simulator?" (2021), sections 4.2 and 4.3, with the changes
that docs/adaptation.md measures.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import nn
from torch.nn import functional as F

from dase.kernels import bridge

SLOPE = 0.2
"""Of the leaky rectifiers."""

TINY = 1e-6
"""Under the root of gradient magnitudes, whose slope at 0 would be infinite."""

EDGE = 0.05
"""Edge strength in the middle of a table [intensity/pixel]."""

GREY_MEAN, GREY_SPREAD = 0.449, 0.226
"""Of natural images; the network sees (grey - mean) / spread."""


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
class Maps:
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


class Residual(nn.Module):
    """Two convolutions added to their input (He et al., Deep residual learning, 2016); no normalisation."""

    def __init__(self, channels: int):
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return an image of the same shape."""
        return F.leaky_relu(x + self.second(F.leaky_relu(self.first(x), SLOPE)), SLOPE)


class UNet(nn.Module):
    """Residual encoder, skips, two outputs that begin at zero (Ronneberger et al., U-Net, 2015)."""

    def __init__(self, inputs: int, channels: int, depth: int):
        super().__init__()
        wide = [channels * min(2**level, 4) for level in range(depth + 1)]
        self.stem = nn.Conv2d(inputs, wide[0], 3, padding=1)
        self.encode = nn.ModuleList(Residual(n) for n in wide)
        self.down = nn.ModuleList(
            nn.Conv2d(a, b, 3, 2, 1) for a, b in zip(wide[:-1], wide[1:], strict=True)
        )
        self.up = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in zip(wide[:-1], wide[1:], strict=True))
        self.decode = nn.ModuleList(nn.Conv2d(n, n, 3, padding=1) for n in wide[:-1])
        self.last = nn.Conv2d(wide[0], 2, 1)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return two maps (B, 2, H, W) of an image (B, inputs, H, W) of any size."""
        x = F.leaky_relu(self.stem(x), SLOPE)
        skips = []
        for encode, down in zip(self.encode, self.down, strict=False):
            skips.append(encode(x))
            x = F.leaky_relu(down(skips[-1]), SLOPE)
        x = self.encode[-1](x)
        for level in reversed(range(len(skips))):
            skip = skips[level]
            x = F.interpolate(self.up[level](x), scale_factor=2, mode="nearest")
            # odd sides come back one pixel too long
            x = F.leaky_relu(self.decode[level](x[..., : skip.shape[-2], : skip.shape[-1]] + skip), SLOPE)
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
        x = ((grey - GREY_MEAN) / GREY_SPREAD)[:, None]
        if self.shape.coordinates:
            height, width = grey.shape[-2:]
            across = torch.linspace(-1, 1, width, device=grey.device).expand(len(grey), 1, height, width)
            along = torch.linspace(-1, 1, height, device=grey.device)[:, None].expand_as(across)
            x = torch.cat([x, across, along], 1)
        with torch.autocast(grey.device.type, torch.bfloat16, enabled=grey.is_cuda):
            u = self.unet(x.contiguous(memory_format=torch.channels_last))
        return u.float().contiguous()

    def forward(self, grey: torch.Tensor) -> Maps:
        """Return the maps for images (B, H, W) in [0, 1]."""
        u = self.residual(grey)
        ratio = self.asymmetry.exp()
        if self.shape.literal:
            return Maps(self.level[0].exp() + u[:, 0], (self.level[1] + u[:, 1]).exp(), ratio, u)
        total = self.level.view(1, 2, 1, 1) + u
        if self.shape.table is not None:
            total = total + look_up(self.table, grey)
        if self.shape.pattern is not None:
            total = total + self.columns.view(1, 2, 1, -1) + self.rows.view(1, 2, -1, 1)
        mu, sigma = total.exp().unbind(1)
        return Maps(mu, sigma, ratio, u)

    def basis(self, grey: torch.Tensor) -> torch.Tensor:
        """Return how much each node of the table counts in each pixel, (B, nodes, H, W); ones without it."""
        if self.shape.table is None:
            return torch.ones_like(grey)[:, None]
        rows, columns = table_weights(grey, self.shape.table)
        return (rows[:, :, None] * columns[:, None]).flatten(1, 2)

    def roughness(self) -> torch.Tensor:
        """Return the mean square difference between neighbouring nodes of the table, 0 without one."""
        if self.shape.table is None:
            return self.level.new_zeros(())
        return sum(
            (torch.diff(self.table, dim=axis).square().mean() for axis in (1, 2)), self.level.new_zeros(())
        )

    def body(self) -> list[nn.Parameter]:
        """Return the parameters of the UNet."""
        return list(self.unet.parameters())

    def scalars(self) -> list[nn.Parameter]:
        """Return all other parameters that are learned."""
        return [p for n, p in self.named_parameters() if not n.startswith("unet.") and p.requires_grad]


def look_up(table: torch.Tensor, grey: torch.Tensor) -> torch.Tensor:
    """Interpolate a table by the brightness and the edge strength of every pixel.

    Args:
        table: Shape (2, nodes of brightness, nodes of edge strength). Brightness goes from 0 to 1, edge strength e
            from 0 to infinity, evenly in e / (e + EDGE).
        grey: Images in [0, 1], shape (B, H, W).

    Returns:
        Shape (B, 2, H, W).
    """
    rows, columns = table_weights(grey, (table.shape[1], table.shape[2]))
    across = torch.einsum("oij,bjn->boin", table, columns.flatten(2))
    return (across * rows.flatten(2)[:, None]).sum(2).view(len(grey), 2, *grey.shape[1:])


def table_weights(grey: torch.Tensor, nodes: tuple[int, int]) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the weights of the nodes of brightness and of edge strength, (B, nodes, H, W) each; see `look_up`."""
    brightness, edge = looks(grey)
    return _hats(brightness.clamp(0, 1), nodes[0]), _hats(edge / (edge + EDGE), nodes[1])


def _hats(share: torch.Tensor, nodes: int) -> torch.Tensor:
    """Return the weights of linear interpolation between evenly spaced nodes, (B, nodes, H, W)."""
    place = share[:, None] * (nodes - 1) - torch.arange(nodes, device=share.device).view(1, -1, 1, 1)
    return (1 - place.abs()).clamp_min(0)


def looks(grey: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
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
    return torch.sqrt(across.square() + down.square() + TINY)


@dataclass(frozen=True, kw_only=True)
class BankShape:
    """Sizes of a bank of critics.

    Args:
        classes: Number of critics.
        inputs: Numbers in a patch; a multiple of 4.
        wide: Outputs of the first layer; a multiple of 4.
        narrow: Outputs of the second layer.
        room: Most patches of one domain that a critic sees in a step; further ones are left out.
    """

    classes: int
    inputs: int = 6400
    wide: int = 256
    narrow: int = 128
    room: int = 32

    def weights(self) -> int:
        """Return the number of weights of all critics."""
        return self.classes * (self.inputs * self.wide + self.wide * (self.narrow + 1) + 2 * self.narrow + 1)


@dataclass
class Slots:
    """Where the patches of one domain lie in a table of (classes, room) slots.

    Args:
        place: Slot of each patch, int64 (N,); `classes * room` for one that has no room.
        number: Patches of each class that have room, int32 (classes,).
    """

    place: torch.Tensor
    number: torch.Tensor


def sort_into_slots(classes: torch.Tensor, shape: BankShape) -> Slots:
    """Give each patch a slot of its class, in order; `classes` is int64 (N,). Nothing waits for the GPU."""
    ordered, order = torch.sort(classes, stable=True)
    ones = torch.ones_like(classes)
    number = torch.zeros(shape.classes, dtype=torch.int64, device=classes.device).index_add_(0, classes, ones)
    first = number.cumsum(0) - number
    rank = torch.arange(len(classes), device=classes.device) - first[ordered]
    slot = torch.where(rank < shape.room, ordered * shape.room + rank, shape.classes * shape.room)
    place = torch.empty_like(slot).index_copy_(0, order, slot)
    return Slots(place, number.clamp_max(shape.room).int())


@dataclass
class Critique:
    """What one step of the bank found.

    Args:
        distance: Weighted difference of the critics' means, real minus fake: what Eq. 10 maximises.
        penalty: Weighted mean squared gradient between the domains.
        dropped: Share of patches that had no room.
    """

    distance: torch.Tensor
    penalty: torch.Tensor
    dropped: torch.Tensor


@dataclass
class Forward:
    """Activations of all critics for rows (C, R, inputs)."""

    first: torch.Tensor
    second: torch.Tensor
    score: torch.Tensor
    slope_first: torch.Tensor = field(init=False)
    slope_second: torch.Tensor = field(init=False)

    def __post_init__(self) -> None:
        self.slope_first = torch.where(self.first > 0, 1.0, SLOPE)
        self.slope_second = torch.where(self.second > 0, 1.0, SLOPE)


class CriticBank:
    """Critics inputs→wide→narrow→1 with leaky rectifiers, one for each class of patches, worked as one.

    Patches are sorted by class into a table with `room` slots for each critic, so that every layer is one
    batched product over all critics and nothing depends on how many patches fall where. Gradients are written
    out: that of the penalty on |∇D|² needs no second backward pass, because a network of rectifiers is linear
    between its kinks. First-layer weights are read as bfloat16 (on the CPU as float32) and moved as float32.

    Args:
        shape: Sizes.
        device: PyTorch device.
        generator: Draws the weights.
        decay: Of Adam's mean square; there is no momentum.
    """

    def __init__(
        self,
        shape: BankShape,
        *,
        device: str | torch.device = "cpu",
        generator: torch.Generator | None = None,
        decay: float = 0.9,
    ):
        self.shape, self.device, self.decay = shape, torch.device(device), decay
        self.working = torch.bfloat16 if self.device.type == "cuda" else torch.float32

        def drawn(outputs: int, inputs: int) -> tuple[torch.Tensor, torch.Tensor]:
            # as nn.Linear does
            bound = 1 / math.sqrt(inputs)
            sizes = (shape.classes, outputs, inputs), (shape.classes, 1, outputs)
            w, b = (
                torch.empty(s, device=self.device).uniform_(-bound, bound, generator=generator) for s in sizes
            )
            return w, b

        self.w1, self.b1 = drawn(shape.wide, shape.inputs)
        self.w2, self.b2 = drawn(shape.narrow, shape.wide)
        self.w3, self.b3 = drawn(1, shape.narrow)
        self.copy = self.w1.bfloat16()
        self.square = {name: torch.zeros_like(getattr(self, name)) for name in self.names()}
        self.steps = torch.zeros(shape.classes, device=self.device)

    @staticmethod
    def names() -> tuple[str, ...]:
        """Return the names of the weights and biases."""
        return ("w1", "b1", "w2", "b2", "w3", "b3")

    def state(self) -> dict[str, Any]:
        """Return everything that the next step depends on."""
        weights = {name: getattr(self, name) for name in self.names()}
        return {"weights": weights, "square": self.square, "steps": self.steps}

    def load(self, state: dict[str, Any]) -> None:
        """Take over what `state` returned."""
        for name in self.names():
            getattr(self, name).copy_(state["weights"][name])
            self.square[name].copy_(state["square"][name])
        self.steps.copy_(state["steps"])
        self.copy = self.w1.bfloat16()

    def table(self, patches: torch.Tensor, slots: Slots) -> torch.Tensor:
        """Return patches (N, inputs) in their slots, shape (classes, room, inputs); empty slots are 0."""
        flat = torch.zeros(
            self.shape.classes * self.shape.room + 1, self.shape.inputs, dtype=self.working, device=self.device
        )
        flat[slots.place] = patches.detach().to(self.working)
        return flat[:-1].view(self.shape.classes, self.shape.room, self.shape.inputs)

    def _first(self) -> torch.Tensor:
        return self.copy if self.working == torch.bfloat16 else self.w1

    def forward(self, rows: torch.Tensor) -> Forward:
        """Return the activations for rows (C, R, inputs)."""
        first = torch.bmm(rows, self._first().transpose(1, 2)).float() + self.b1
        second = torch.baddbmm(self.b2, F.leaky_relu(first, SLOPE), self.w2.transpose(1, 2))
        score = torch.baddbmm(self.b3, F.leaky_relu(second, SLOPE), self.w3.transpose(1, 2))
        return Forward(first, second, score[..., 0])

    def slopes(self, at: Forward, by: slice) -> tuple[torch.Tensor, torch.Tensor]:
        """Return derivatives of the scores of rows `by` by the second and by the first layer's sums."""
        second = self.w3 * at.slope_second[:, by]
        first = torch.bmm(second, self.w2) * at.slope_first[:, by]
        return second, first

    def scores(self, patches: torch.Tensor, slots: Slots) -> torch.Tensor:
        """Return the scores of the patches that have room, shape (classes, room)."""
        return self.forward(self.table(patches, slots)).score

    def input_gradient(self, patches: torch.Tensor, slots: Slots, gain: torch.Tensor) -> torch.Tensor:
        """Return the gradient of Σ gain · score by the patches, shape (N, inputs).

        Args:
            patches: Shape (N, inputs).
            slots: Theirs.
            gain: Of every class, shape (classes,).
        """
        at = self.forward(self.table(patches, slots))
        _, first = self.slopes(at, slice(None))
        first = (first * gain.view(-1, 1, 1)).to(self.working)
        flat = torch.bmm(first, self._first()).view(-1, self.shape.inputs)
        # those without room have no gradient
        inside = (slots.place < len(flat)).unsqueeze(1)
        return flat[slots.place.clamp_max(len(flat) - 1)] * inside

    @torch.no_grad()
    def step(
        self,
        fake: torch.Tensor,
        fake_slots: Slots,
        real: torch.Tensor,
        real_slots: Slots,
        weights: torch.Tensor,
        *,
        rate: float,
        penalty: float = 1.0,
        generator: torch.Generator | None = None,
    ) -> Critique:
        """Move the critics of the classes that both domains have, once.

        The loss is Σ weight · (mean fake score - mean real score + penalty · mean |∇D|²), the gradient taken
        half way (by a uniform share) between the i-th fake and the i-th real patch of the class.

        Args:
            fake: Patches of the simulator, shape (N, inputs).
            fake_slots: Theirs.
            real: Patches of the target, shape (M, inputs).
            real_slots: Theirs.
            weights: Of each class, shape (classes,), Eq. 13.
            rate: Learning rate.
            penalty: Weight of the penalty.
            generator: Draws the shares.
        """
        room = self.shape.room
        rows = torch.empty(
            self.shape.classes, 3 * room, self.shape.inputs, dtype=self.working, device=self.device
        )
        rows[:, :room], rows[:, room : 2 * room] = self.table(fake, fake_slots), self.table(real, real_slots)
        share = torch.rand(self.shape.classes, room, 1, device=self.device, generator=generator)
        rows[:, 2 * room :] = torch.lerp(rows[:, room : 2 * room], rows[:, :room], share.to(self.working))
        number = torch.stack([fake_slots.number, real_slots.number], 1)
        pairs = number.min(1, keepdim=True).values
        valid = torch.cat([number, pairs], 1)
        active = pairs[:, 0] > 0
        gain = torch.where(active[:, None], weights[:, None] / valid.clamp_min(1), 0.0)  # (C, 3)
        mask = torch.arange(room, device=self.device) < valid[:, :, None]  # (C, 3, room)
        gradients, critique = self._gradients(rows, (gain[..., None] * mask).flatten(1), penalty)
        self._move(gradients, rows, torch.where(active[:, None], valid, 0).int().contiguous(), active, rate)
        seen = fake_slots.number.sum() + real_slots.number.sum()
        critique.dropped = 1 - seen / (len(fake) + len(real))
        return critique

    def _gradients(
        self, rows: torch.Tensor, gain: torch.Tensor, penalty: float
    ) -> tuple[dict[str, torch.Tensor], Critique]:
        """Return gradients by all weights; that by `w1` as the left rows of its outer products.

        The right rows replace the interpolated ones in `rows`.

        Args:
            rows: Fake, real and interpolated patches, shape (C, 3 · room, inputs).
            gain: What a row counts in its mean, shape (C, 3 · room), zero for empty slots.
            penalty: Weight of the penalty.
        """
        room = self.shape.room
        at = self.forward(rows)
        by_score = gain[:, : 2 * room, None].clone()
        by_score[:, room:] *= -1
        distance = -(by_score[..., 0] * at.score[:, : 2 * room]).sum()
        second, first = self.slopes(at, slice(None))
        plain, between = slice(0, 2 * room), slice(2 * room, None)
        second_plain, first_plain = second[:, plain] * by_score, first[:, plain] * by_score
        # the penalty: g = first W1, loss = gain |g|²
        g = torch.bmm(first[:, between].to(self.working), self._first())
        squares = g.float().square().sum(-1)
        weight = gain[:, between]
        by_g = (2 * penalty * weight[..., None]).to(self.working) * g
        by_first = torch.bmm(by_g, self._first().transpose(1, 2)).float() * at.slope_first[:, between]
        by_second = torch.bmm(by_first, self.w2.transpose(1, 2)) * at.slope_second[:, between]
        rows[:, between] = by_g
        activated_first = F.leaky_relu(at.first[:, plain], SLOPE)
        activated_second = F.leaky_relu(at.second[:, plain], SLOPE)
        gradients = {
            "w1": torch.cat([first_plain, first[:, between]], 1),
            "b1": first_plain.sum(1, keepdim=True),
            "w2": torch.bmm(second_plain.transpose(1, 2), activated_first)
            + torch.bmm(second[:, between].transpose(1, 2), by_first),
            "b2": second_plain.sum(1, keepdim=True),
            "w3": torch.bmm(by_score.transpose(1, 2), activated_second) + by_second.sum(1, keepdim=True),
            "b3": by_score.sum(1, keepdim=True),
        }
        return gradients, Critique(distance, (weight * squares).sum(), distance.new_zeros(()))

    def _move(
        self,
        gradients: dict[str, torch.Tensor],
        rows: torch.Tensor,
        valid: torch.Tensor,
        active: torch.Tensor,
        rate: float,
    ) -> None:
        """Move the active critics by Adam without momentum."""
        self.steps += active
        correction = 1 / (1 - self.decay ** self.steps.clamp_min(1))
        rates = torch.where(active, rate, 0.0)
        bridge.move_critics(
            self.w1, self.square["w1"], self.copy, gradients["w1"].contiguous(), rows.to(torch.bfloat16),
            valid, rates, correction, decay=self.decay,
        )  # fmt: skip
        lazy = active.view(-1, 1, 1)
        for name in self.names()[1:]:
            weight, square, gradient = getattr(self, name), self.square[name], gradients[name]
            square.copy_(torch.where(lazy, torch.lerp(gradient.square(), square, self.decay), square))
            root = (square * correction.view(-1, 1, 1)).sqrt_().add_(1e-8)
            weight.addcdiv_(gradient * -rates.view(-1, 1, 1), root)

    def traffic(self, active: int) -> int:
        """Return the bytes that one step has to move at least, `active` critics being in use.

        Per first-layer weight: the forward pass, the penalty's gradient and its derivative read a bfloat16
        copy, the update reads and writes the weight and its mean square and writes the copy.
        """
        first = self.shape.wide * self.shape.inputs
        return active * first * (3 * 2 + 4 * 4 + 2)
