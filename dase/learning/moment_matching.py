"""The objective without an adversary: means of fixed features between pixels whose surroundings look alike.

Pixels are put into cells by brightness and edge strength; in every cell the means
of a dozen features of the counts are compared. What changes with the image is compared where the image is
alike, so thresholds that depend on brightness or on edges are told from scenes that do. Nothing can be
learned by heart: there are a few hundred numbers whatever the data.

Scenes differ in speed, and that changes counts far more than thresholds do. Two things keep it out. The
differences of all cells and features are weighted together by the inverse of their covariance between
scenes (Hansen, Large sample properties of generalized method of moments estimators, 1982), so what speed
does to all of them counts little, and what it leaves alone, such as the counts at an edge that has passed,
counts much. And what a simulated scene does at thresholds that never change is known for all scenes ever
drawn, so its part in how a batch differs from all others is taken out: a control variate.
"""

from __future__ import annotations

import math
from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any

import torch
from torch.nn import functional as F

from dase.learning import distributed
from dase.learning.targets import Pairs
from dase.networks.threshold_network import MAGNITUDE_FLOOR, brightness_and_edge, gradient_magnitude

REFERENCE = 0.25, 0.06
"""Usual mean and spread, at which scenes are counted once more to tell busy scenes from low thresholds
[log intensity]."""


@dataclass(frozen=True, kw_only=True)
class MomentSettings:
    """What can be chosen about the moments; the names are those of a run's `recipe.json`.

    Args:
        cells: Levels of brightness and of edge strength by which pixels are compared.
        memory: Share of the fake moments that stays from step to step: less follows the thresholds sooner,
            more averages over more scenes.
        doubt: Share by which means of features may differ for reasons that thresholds cannot cure, such as
            what a recording's frames do not show.
        newton: Share of a Gauss-Newton step that is taken; a whole one would follow the noise of a batch.
    """

    cells: tuple[int, int] = (6, 5)
    memory: float = 0.95
    doubt: float = 0.0
    newton: float = 0.2


@dataclass(frozen=True, kw_only=True)
class MomentWeighting:
    """How moments are averaged and weighed; the method's own numbers, not a run's.

    Args:
        ridge: Added to the variances before they are inverted, as a share: the features are nearly dependent.
        scarce_ridge: The same for each feature per scene that has been seen: few scenes tell little of their
            covariance.
        floor: Added to the variances before they are inverted: a feature that never varies says nothing.
        floor_share: The same as a share of their mean.
        regression_memory: Share of the regression on the reference counts that stays from step to step.
        pattern_memory: Share of the moments of columns and rows that stays; one of them sees few pixels.
        interval: Steps after which the weights are worked out again, which takes longer than a step.
        hold_out_every: Real batches of which one is held out, where real scenes never come again.
    """

    ridge: float = 0.1
    scarce_ridge: float = 0.1
    floor: float = 1e-6
    floor_share: float = 1e-3
    regression_memory: float = 0.99
    pattern_memory: float = 0.99
    interval: int = 25
    hold_out_every: int = 8


CellMembers = tuple[torch.Tensor, torch.Tensor]
"""See `Moments.cell_members`."""


def single_pixel_features(counts: torch.Tensor) -> torch.Tensor:
    """Return features (B, 7, H, W) that depend on the counts (B, 2, H, W) of the pixel alone.

    Level, its square, how busy, and how much of both.
    """
    level = torch.log1p(counts)
    both = level[:, :1] * level[:, 1:]
    return torch.cat([level, level.square(), counts / (1 + counts), both], 1)


def add_neighbour_features(pixels: torch.Tensor) -> torch.Tensor:
    """Add features of the level (the first two) between neighbours, which see the same change: (B, 13, H, W).

    Their differences tell the spread of the thresholds.
    """
    level = pixels[:, :2]
    rough = gradient_magnitude(level)
    near = F.avg_pool2d(level, 3, stride=1, padding=1, count_include_pad=False)
    return torch.cat([pixels, rough, rough.square(), near.square()], 1)


def add_next_pixel_features(pixels: torch.Tensor, axis: int) -> torch.Tensor:
    """Add differences of the level to the next pixel along `axis` only, shape (B, 11, H, W).

    Those of other columns must not come into what a column is judged by.
    """
    last = (0, 0, 0, 1) if axis == -2 else (0, 1)
    step = F.pad(torch.diff(pixels[:, :2], dim=axis), last)
    return torch.cat([pixels, torch.sqrt(step.square() + MAGNITUDE_FLOOR), step.square()], 1)


def pixel_features(pairs: Pairs) -> torch.Tensor:
    """Return features (B, 7, H, W) of pixels, with gradients where the pairs say how counts answer."""
    if pairs.varied is None:
        return single_pixel_features(pairs.counts)
    return pairs.varied.with_gradient(single_pixel_features, pairs.counts)


class CellMoments:
    """Running means, covariances and weights of the features in a set of cells.

    Args:
        cells: How many.
        width: Number of features.
        device: PyTorch device.
        memory: Share of the fake means that stays from step to step.
        joint: Whether the covariance is that of all cells together; else each cell has its own.
        weighting: How moments are averaged and weighed.

    Attributes:
        kept: All running sums, float64, which a checkpoint holds: with C cells and F features, `*_sum`,
            `both` and `square` (C, F), `*_number` (C,) [pixels], `*_scenes` and `usual` scalars, `products`
            and `weight` (1, C · F, C · F) where `joint`, else (C, F, F).
    """

    def __init__(
        self,
        cells: int,
        width: int,
        *,
        device: torch.device,
        memory: float,
        joint: bool,
        weighting: MomentWeighting = MomentWeighting(),
    ):
        self.memory, self.joint, self.weighting = memory, joint, weighting
        blocks, size = (1, cells * width) if joint else (cells, width)

        def zeros(*shape: int) -> torch.Tensor:
            return torch.zeros(shape, dtype=torch.float64, device=device)

        self.kept: dict[str, torch.Tensor] = {
            name: zeros(cells, width)
            for name in ("real_sum", "held_sum", "fake_sum", "plain_sum", "both", "square")
        }
        numbers = ("real_number", "held_number", "fake_number", "plain_number")
        self.kept |= {name: zeros(cells) for name in numbers}
        self.kept |= {"products": zeros(blocks, size, size), "scenes": zeros()}
        self.kept |= {"real_scenes": zeros(), "fake_scenes": zeros(), "usual": zeros()}
        self.kept["weight"] = torch.zeros(blocks, size, size, device=device)

    def add_real(self, sums: torch.Tensor, number: torch.Tensor, *, held_out: bool = False) -> None:
        """Add real scenes.

        Args:
            sums: Of the features over the pixels of a cell, shape (B, cells, F).
            number: Of these pixels, shape (B, cells).
            held_out: Whether the scenes are kept apart from those that are learned from.
        """
        side = "held" if held_out else "real"
        self.kept[f"{side}_sum"] += sums.double().sum(0)
        self.kept[f"{side}_number"] += number.double().sum(0)
        if not held_out:
            self.kept["real_scenes"] += len(sums)

    def add_reference(self, sums: torch.Tensor, number: torch.Tensor) -> torch.Tensor:
        """Add simulated scenes at the reference thresholds; arguments as those of `add_real`.

        Returns:
            By how much the sums of each scene are off what the mean of all would make them, (B, cells, F).
        """
        kept = self.kept
        sums, number = sums.double(), number.double()
        kept["plain_sum"] += sums.sum(0)
        kept["plain_number"] += number.sum(0)
        usual = kept["plain_sum"] / kept["plain_number"].clamp_min(1)[:, None]
        off = sums - number[..., None] * usual
        flat = off.reshape(len(off), *kept["products"].shape[:2])
        kept["products"] += torch.einsum("bnf,bng->nfg", flat, flat)
        kept["scenes"] += len(sums)
        return off

    def add_fake(self, sums: torch.Tensor, number: torch.Tensor, off: torch.Tensor) -> None:
        """Add simulated scenes, and forget a part of earlier ones.

        Args:
            sums: Of the features, shape (B, cells, F).
            number: Of pixels, shape (B, cells).
            off: What `add_reference` returned for the same scenes, shape (B, cells, F).
        """
        kept = self.kept
        sums, number = sums.detach().double(), number.double()
        mean = sums.sum(0) / number.sum(0).clamp_min(1)[:, None]
        memory = self.weighting.regression_memory
        kept["both"].mul_(memory).add_((off * (sums - number[..., None] * mean)).sum(0))
        kept["square"].mul_(memory).add_(off.square().sum(0))
        # the control variate: a scene busy at the reference is busy now, which says nothing of the thresholds
        slope = kept["both"] / kept["square"].clamp_min(1e-12)
        kept["fake_sum"].mul_(self.memory).add_((sums - slope * off).sum(0))
        kept["fake_number"].mul_(self.memory).add_(number.sum(0))
        kept["fake_scenes"].mul_(self.memory).add_(len(sums))

    def shift_fake_means(self, means: torch.Tensor) -> None:
        """Add to the fake means (cells, F) what a move of the thresholds does to them."""
        self.kept["fake_sum"] += self.kept["fake_number"][:, None] * means

    def mean_difference(self, *, held_out: bool = False) -> torch.Tensor:
        """Return fake minus real means, shape (cells, F); 0 where one has no pixel."""
        kept, side = self.kept, "held" if held_out else "real"
        known = (kept[f"{side}_number"] > 0) & (kept["fake_number"] > 0)
        real = kept[f"{side}_sum"] / kept[f"{side}_number"].clamp_min(1)[:, None]
        fake = kept["fake_sum"] / kept["fake_number"].clamp_min(1)[:, None]
        return torch.where(known[:, None], fake - real, 0.0)

    def weigh(self, doubt: float = 0.0, excess: torch.Tensor | float = 1.0) -> None:
        """Set the weights to the inverse covariance of what one scene adds to the means.

        Args:
            doubt: Share of themselves by which means differ for reasons that thresholds cannot cure.
            excess: By how much more than chance they differ after a linear step. Where it is large, what
                varies little is not what tells most, and the weights become those of single features. A
                number, or a scalar on the device.
        """
        kept = self.kept
        cells, width = kept["plain_sum"].shape
        total = kept["plain_number"].clamp_min(1)[:, None].expand(cells, width)
        total = total.reshape(kept["products"].shape[:2]) / kept["scenes"]
        covariance = kept["products"] / (total[:, :, None] * total[:, None, :] * kept["scenes"])
        diagonal = covariance.diagonal(dim1=-2, dim2=-1)
        how = self.weighting
        floor = how.floor + how.floor_share * diagonal.mean(-1, keepdim=True)
        ridge = excess * (how.ridge + how.scarce_ridge * diagonal.shape[-1] / kept["scenes"])
        mean = kept["real_sum"] / kept["real_number"].clamp_min(1)[:, None]
        wrong = (doubt * mean).square().reshape(diagonal.shape) * kept["real_scenes"]
        weight, _ = torch.linalg.inv_ex(covariance + torch.diag_embed(ridge * diagonal + floor + wrong))
        # `usual` is what chance makes of the distance of one scene, by which the excess is measured
        kept["usual"].copy_((weight * covariance).sum())
        kept["weight"].copy_(weight / (cells * width))

    def slope(self, off: torch.Tensor) -> torch.Tensor:
        """Return the derivative of half the weighted square difference by the fake means, (cells, F)."""
        flat = off.float().reshape(self.kept["weight"].shape[:2])
        return torch.einsum("nfg,ng->nf", self.kept["weight"], flat).reshape(off.shape)

    def distance(self, off: torch.Tensor) -> torch.Tensor:
        """Return the weighted square difference, in variances of a scene, mean over cells and features.

        Args:
            off: Fake minus real means, shape (cells, F).

        Returns:
            A scalar.
        """
        return (self.slope(off) * off).sum()


class Moments:
    """Compare means of features in cells; see the module.

    Args:
        settings: What to compare; its `newton` is not used here.
        device: PyTorch device.
        pattern: Whether to compare columns and rows of the sensor as well.
        scenes: How many different real scenes there are.

    Attributes:
        excess: See `Cells.weigh`; set by what moves the thresholds.
    """

    def __init__(
        self,
        settings: MomentSettings = MomentSettings(),
        *,
        device: str | torch.device,
        pattern: bool = False,
        scenes: float = math.inf,
        weighting: MomentWeighting = MomentWeighting(),
    ):
        self.settings, self.weighting = settings, weighting
        self.excess: torch.Tensor | float = 1.0
        self.device, self.pattern, self.scenes = torch.device(device), pattern, scenes
        self.boundaries: list[torch.Tensor] = []
        self.sets: dict[str, CellMoments] = {}
        self.calls = 0
        self.holds_out = self.reweighs = False

    def calibrate(self, sets: list[tuple[Pairs, Pairs]]) -> None:
        """Place the boundaries of brightness and edge strength at quantiles of both domains."""
        found = [brightness_and_edge(pairs.grey) for both in sets for pairs in both]
        for level, values in zip(self.settings.cells, zip(*found, strict=True), strict=True):
            pooled = torch.sort(
                torch.cat([v.flatten()[:: max(v.numel() // 50_000, 1)] for v in values])
            ).values
            places = [round(n / level * (len(pooled) - 1)) for n in range(1, level)]
            self.boundaries.append(pooled[places].contiguous())
        distributed.broadcast_tensors(self.boundaries)
        height, across = sets[0][0].grey.shape[1:]
        self._make_cells(across, height)

    def _make_cells(self, across: int, height: int) -> None:
        """Begin anew, for a sensor of `across` columns and `height` rows."""
        sizes = {"look": self.settings.cells[0] * self.settings.cells[1]}
        if self.pattern:
            sizes |= {"column": across, "row": height}
        self.sets = {
            name: CellMoments(
                size,
                13 if name == "look" else 11,
                device=self.device,
                memory=self.settings.memory if name == "look" else self.weighting.pattern_memory,
                joint=name == "look",
                weighting=self.weighting,
            )
            for name, size in sizes.items()
        }

    def cell_members(self, grey: torch.Tensor) -> CellMembers:
        """Return which cells of `look` pixels are in, 1 or 0 (B, pixels, cells), and how many (B, cells)."""
        brightness, edge = brightness_and_edge(grey)
        cell = torch.bucketize(brightness.contiguous(), self.boundaries[0]) * self.settings.cells[1]
        cell = (cell + torch.bucketize(edge, self.boundaries[1])).flatten(1)[..., None]
        every = torch.arange(self.settings.cells[0] * self.settings.cells[1], device=self.device)
        # numbers at once: truth values first would be another pass
        member = torch.eq(cell, every, out=grey.new_empty((*cell.shape[:2], len(every))))
        return member, member.sum(1)

    def cell_sums(
        self, pairs: Pairs, members: CellMembers | None = None
    ) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
        """Return sums (B, cells, F) and numbers of pixels (B, cells) for each set of cells.

        Args:
            pairs: Of which counts are summed.
            members: What `cell_members` returned for their images, where it is known.
        """
        pixels = pixel_features(pairs)
        member, number = self.cell_members(pairs.grey) if members is None else members
        found = add_neighbour_features(pixels)
        out = {"look": (sum_by_cell(member, found.flatten(2).transpose(1, 2)), number)}
        if self.pattern:
            batch, _, height, width = found.shape
            down, across = (
                add_next_pixel_features(pixels, -2).sum(2),
                add_next_pixel_features(pixels, -1).sum(3),
            )
            out["column"] = down.transpose(1, 2), found.new_full((batch, width), height)
            out["row"] = across.transpose(1, 2), found.new_full((batch, height), width)
        return out

    @torch.no_grad()
    def add_real(self, real: Pairs, *, held_out: bool = False) -> None:
        """Take real pairs in, some of them for choosing between priors only."""
        for name, both in self.cell_sums(real).items():
            self.sets[name].add_real(*map(distributed.gather_values, both), held_out=held_out)

    @torch.no_grad()
    def add_reference(self, fake: Pairs, members: CellMembers) -> dict[str, torch.Tensor]:
        """Take the reference counts of simulated pairs in; return how far each scene is off.

        Args:
            fake: With their reference counts.
            members: What `cell_members` returned for their images.

        Returns:
            For each set of cells what `CellMoments.add_reference` returns, shape (B, cells, F).
        """
        assert fake.reference is not None
        found = self.cell_sums(Pairs(fake.grey, fake.reference), members)
        return {
            name: self.sets[name].add_reference(*map(distributed.gather_values, both))
            for name, both in found.items()
        }

    def weigh(self) -> None:
        """Work out the weights."""
        for cells in self.sets.values():
            cells.weigh(self.settings.doubt, self.excess)

    def begin_step(self) -> Hashable:
        """Count a step that is about to come; return its kind, see `dase.learning.cuda_graph`."""
        # where real scenes never come again, some batches are held out
        every = self.weighting.hold_out_every
        self.holds_out = self.scenes == math.inf and self.calls % every == every - 1
        self.reweighs = self.calls % self.weighting.interval == 0
        self.calls += 1
        return None if self.reweighs else self.holds_out

    def loss(self, fake: Pairs, real: Pairs, *, move: bool) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Take both batches in; return the fake means of this batch along what they are off.

        Args:
            fake: Simulated pairs with their reference counts.
            real: Pairs of the target.
            move: Whether the network moves; else the loss is 0.

        Returns:
            A scalar, and by their names numbers for the log, each a scalar.
        """
        self.add_real(real, held_out=self.holds_out)
        members = self.cell_members(fake.grey)
        plain = self.add_reference(fake, members)
        if self.reweighs:
            self.weigh()
        total, distance = fake.counts.new_zeros(()), fake.counts.new_zeros(())
        for name, both in self.cell_sums(fake, members).items():
            sums, number = map(distributed.gather_values, both)
            cells = self.sets[name]
            # earlier batches say how far off the means are, this one which way they go: no bias by its noise
            off = cells.mean_difference()
            if move:
                means = sums.sum(0) / number.sum(0).clamp_min(1)[:, None]
                total = total + (cells.slope(off) * means).sum()
            distance = distance + cells.distance(off)
            cells.add_fake(sums, number, plain[name])
        return total, {"distance": distance}

    def state(self) -> dict[str, Any]:
        """Return the boundaries and all running means."""
        sets = {name: cells.kept for name, cells in self.sets.items()}
        return {"boundaries": self.boundaries, "sets": sets, "calls": self.calls}

    def load(self, state: dict[str, Any]) -> None:
        """Take over what `state` returned."""
        self.boundaries = [b.to(self.device) for b in state["boundaries"]]
        self.calls = state["calls"]
        sizes = [len(state["sets"][name]["real_sum"]) if self.pattern else 0 for name in ("column", "row")]
        self._make_cells(*sizes)
        for name, kept in state["sets"].items():
            self.sets[name].kept = {key: value.to(self.device) for key, value in kept.items()}


def sum_by_cell(member: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """Return the sums of values (B, N, F) over the pixels of each cell (B, N, cells), shape (B, cells, F).

    Pixels are summed in many pieces, which a GPU works at side by side; in one it took 16 times as long.
    """
    batch, pixels = member.shape[:2]
    pieces = next(n for n in range(min(64, pixels), 0, -1) if pixels % n == 0)
    a, b = (maps.reshape(batch * pieces, pixels // pieces, -1) for maps in (member, values))
    pieced = torch.bmm(a.transpose(1, 2), b).view(batch, pieces, a.shape[2], -1)
    return pieced.sum(1, dtype=torch.float32)


@torch.no_grad()
def moment_discrepancy(fake: list[Pairs], real: list[Pairs], like: Moments) -> float:
    """Return how far simulated and real batches are apart, by the cells and weights of `like`."""
    total = 0.0
    parts = [[like.cell_sums(pairs) for pairs in side] for side in (fake, real)]
    for name, cells in like.sets.items():
        means = []
        for side in parts:
            sums = torch.stack([part[name][0].sum(0) for part in side]).sum(0)
            number = torch.stack([part[name][1].sum(0) for part in side]).sum(0)
            means.append(sums / number.clamp_min(1)[:, None])
        total += float(cells.distance(means[0] - means[1]))
    return total
