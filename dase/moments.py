"""The objective without an adversary: means of fixed features between pixels whose surroundings look alike.

Pixels are put into cells by the brightness and the contrast of the image around them; in every cell the means
of a dozen features of the counts are compared. What changes with the image is compared where the image is
alike, so thresholds that depend on brightness or on edges are told from scenes that do. The differences are
weighted by the inverse of their covariance between scenes, which neighbouring pixels share, so a difference
counts as much as it stands out from what other scenes would do. Nothing can be learned by heart: there are a
few hundred numbers whatever the data.
"""

from __future__ import annotations

from typing import Any

import torch
from torch.nn import functional as F

from dase.objectives import gradient_magnitude
from dase.scenery import LOG_EPS
from dase.targets import Pairs

RIDGE = 1.0
"""Added to the variances before they are inverted, as a share."""

FORGET = 0.99
"""Share of the regression on the reference that stays from step to step."""

ANEW = 25
"""Steps after which the weights are worked out again."""


def features(counts: torch.Tensor) -> torch.Tensor:
    """Return features (B, 13, H, W) of counts (B, 2, H, W).

    Level, its square and the share of busy pixels tell the mean threshold; differences of neighbours, which
    see the same change, tell its spread.
    """
    level = torch.log1p(counts)
    rough = gradient_magnitude(level)
    near = F.avg_pool2d(level, 3, stride=1, padding=1, count_include_pad=False)
    busy = counts / (1 + counts)
    both = level[:, :1] * level[:, 1:]
    return torch.cat([level, level.square(), busy, rough, rough.square(), near.square(), both], 1)


class Cells:
    """Running means, covariances and weights of the features in a set of cells.

    Args:
        cells: How many.
        width: Number of features.
        device: PyTorch device.
        memory: Share of the fake means that stays from step to step.
    """

    def __init__(self, cells: int, width: int, *, device: torch.device, memory: float):
        self.memory = memory
        double = {"dtype": torch.float64, "device": device}
        self.kept: dict[str, torch.Tensor] = {
            "real_sum": torch.zeros(cells, width, **double),  # type: ignore[arg-type]
            "real_number": torch.zeros(cells, **double),  # type: ignore[arg-type]
            "fake_sum": torch.zeros(cells, width, **double),  # type: ignore[arg-type]
            "fake_number": torch.zeros(cells, **double),  # type: ignore[arg-type]
            "plain_sum": torch.zeros(cells, width, **double),  # type: ignore[arg-type]
            "plain_number": torch.zeros(cells, **double),  # type: ignore[arg-type]
            "both": torch.zeros(cells, width, **double),  # type: ignore[arg-type]
            "square": torch.zeros(cells, width, **double),  # type: ignore[arg-type]
            "products": torch.zeros(cells, width, width, **double),  # type: ignore[arg-type]
            "scenes": torch.zeros((), **double),  # type: ignore[arg-type]
            "weight": torch.zeros(cells, width, width, device=device),
        }

    def see_real(self, sums: torch.Tensor, number: torch.Tensor) -> None:
        """Add scenes: sums of the features (B, cells, F) over `number` (B, cells) pixels."""
        kept = self.kept
        sums, number = sums.double(), number.double()
        kept["real_sum"] += sums.sum(0)
        kept["real_number"] += number.sum(0)
        off = sums - number[..., None] * self.real()
        kept["products"] += torch.einsum("bcf,bcg->cfg", off, off)
        kept["scenes"] += len(sums)

    def see_fake(self, sums: torch.Tensor, number: torch.Tensor, plain: torch.Tensor) -> None:
        """Add scenes, and forget a part of earlier ones.

        Scenes differ in speed far more than in what thresholds do to them. What a scene does at thresholds
        that never change (`plain`) is known for all scenes ever drawn, so its part in the difference between
        these scenes and all is taken out: a control variate, by regression.
        """
        kept = self.kept
        sums, number, plain = sums.detach().double(), number.double(), plain.double()
        kept["plain_sum"] += plain.sum(0)
        kept["plain_number"] += number.sum(0)
        usual = kept["plain_sum"] / kept["plain_number"].clamp_min(1)[:, None]
        off = plain - number[..., None] * usual
        mean = sums.sum(0) / number.sum(0).clamp_min(1)[:, None]
        kept["both"].mul_(FORGET).add_((off * (sums - number[..., None] * mean)).sum(0))
        kept["square"].mul_(FORGET).add_(off.square().sum(0))
        slope = kept["both"] / kept["square"].clamp_min(1e-12)
        kept["fake_sum"].mul_(self.memory).add_((sums - slope * off).sum(0))
        kept["fake_number"].mul_(self.memory).add_(number.sum(0))

    def real(self) -> torch.Tensor:
        """Return the real means, shape (cells, F)."""
        return self.kept["real_sum"] / self.kept["real_number"].clamp_min(1)[:, None]

    def off(self) -> torch.Tensor:
        """Return fake minus real means, shape (cells, F); 0 where one has no pixel."""
        kept = self.kept
        both = (kept["real_number"] > 0) & (kept["fake_number"] > 0)
        fake = kept["fake_sum"] / kept["fake_number"].clamp_min(1)[:, None]
        return torch.where(both[:, None], fake - self.real(), 0.0)

    def weigh(self) -> None:
        """Set the weights to the inverse covariance of what one scene adds to the means."""
        kept = self.kept
        total = kept["real_number"].clamp_min(1)[:, None, None]
        covariance = kept["products"] * kept["scenes"] / total.square()
        diagonal = covariance.diagonal(dim1=-2, dim2=-1)
        # a feature that never varies in a cell says nothing there
        floor = 1e-6 + 1e-3 * diagonal.mean(-1, keepdim=True)
        covariance = covariance + torch.diag_embed(RIDGE * diagonal + floor)
        weight = torch.linalg.inv(covariance)
        weight = torch.where(kept["real_number"][:, None, None] > 0, weight, 0.0)
        kept["weight"].copy_(weight / (weight.shape[0] * weight.shape[1]))

    def slope(self) -> torch.Tensor:
        """Return the derivative of half the weighted square difference by the fake means, (cells, F)."""
        return torch.einsum("cfg,cg->cf", self.kept["weight"], self.off().float())

    def distance(self) -> torch.Tensor:
        """Return the weighted square difference, in variances of a scene, mean over cells and features."""
        return (self.slope() * self.off().float()).sum()


class Moments:
    """Compare means of features in cells; see the module.

    Args:
        device: PyTorch device.
        levels: Levels of brightness, and of contrast.
        pattern: Whether to compare columns and rows of the sensor as well.
        memory: Share of the fake means that stays from step to step.
    """

    def __init__(
        self,
        *,
        device: str | torch.device,
        levels: tuple[int, int] = (6, 5),
        pattern: bool = False,
        memory: float = 0.95,
    ):
        self.device, self.levels, self.pattern, self.memory = torch.device(device), levels, pattern, memory
        self.boundaries: list[torch.Tensor] = []
        self.sets: dict[str, Cells] = {}
        self.calls = 0

    def calibrate(self, sets: list[tuple[Pairs, Pairs]]) -> None:
        """Place the boundaries of brightness and contrast at quantiles of both domains."""
        found = [self._attributes(pairs.grey) for both in sets for pairs in both]
        for level, values in zip(self.levels, zip(*found, strict=True), strict=True):
            pooled = torch.sort(torch.cat([v.flatten()[:: max(v.numel() // 50_000, 1)] for v in values])).values
            places = [round(n / level * (len(pooled) - 1)) for n in range(1, level)]
            self.boundaries.append(pooled[places].contiguous())
        width = features(sets[0][0].counts[:1, :, :8, :8]).shape[1]
        height, across = sets[0][0].grey.shape[1:]
        sizes = {"look": self.levels[0] * self.levels[1]}
        if self.pattern:
            sizes |= {"column": across, "row": height}
        self.sets = {
            name: Cells(size, width, device=self.device, memory=self.memory) for name, size in sizes.items()
        }

    @staticmethod
    def _attributes(grey: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return brightness and contrast of every pixel, each (B, H, W)."""
        log = torch.log(grey + LOG_EPS)[:, None]
        contrast = F.avg_pool2d(gradient_magnitude(log), 3, stride=1, padding=1)[:, 0]
        return grey, contrast

    def _sums(self, pairs: Pairs) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
        """Return sums (B, cells, F) and numbers of pixels (B, cells) for each set of cells."""
        found = features(pairs.counts)
        brightness, contrast = self._attributes(pairs.grey)
        cell = torch.bucketize(brightness, self.boundaries[0]) * self.levels[1]
        cell = cell + torch.bucketize(contrast, self.boundaries[1])
        every = torch.arange(self.levels[0] * self.levels[1], device=self.device)
        member = (cell.flatten(1)[..., None] == every).float()  # (B, N, cells)
        out = {"look": (torch.bmm(member.transpose(1, 2), found.flatten(2).transpose(1, 2)), member.sum(1))}
        if self.pattern:
            batch, _, height, width = found.shape
            out["column"] = found.sum(2).transpose(1, 2), found.new_full((batch, width), height)
            out["row"] = found.sum(3).transpose(1, 2), found.new_full((batch, height), width)
        return out

    def loss(self, fake: Pairs, real: Pairs, *, move: bool) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Take both batches in; return the fake means of this batch along what they are off."""
        with torch.no_grad():
            for name, (sums, number) in self._sums(real).items():
                self.sets[name].see_real(sums, number)
            assert fake.reference is not None
            plain = self._sums(Pairs(fake.grey, fake.reference))
        fakes = self._sums(fake)
        if self.calls % ANEW == 0:
            for cells in self.sets.values():
                cells.weigh()
        self.calls += 1
        total = fake.counts.new_zeros(())
        distance = fake.counts.new_zeros(())
        for name, (sums, number) in fakes.items():
            cells = self.sets[name]
            # earlier batches say how far off the means are, this one which way they go: no bias by its noise
            if move:
                means = sums.sum(0) / number.sum(0).clamp_min(1)[:, None]
                total = total + (cells.slope() * means).sum()
            distance = distance + cells.distance().detach()
            cells.see_fake(sums, number, plain[name][0])
        return total, {"distance": distance}

    def state(self) -> dict[str, Any]:
        """Return the boundaries and all running means."""
        sets = {name: cells.kept for name, cells in self.sets.items()}
        return {"boundaries": self.boundaries, "sets": sets, "calls": self.calls}

    def load(self, state: dict[str, Any]) -> None:
        """Take over what `state` returned."""
        self.boundaries = [b.to(self.device) for b in state["boundaries"]]
        self.calls = state["calls"]
        for name, kept in state["sets"].items():
            cells, width = kept["real_sum"].shape
            self.sets[name] = Cells(cells, width, device=self.device, memory=self.memory)
            self.sets[name].kept = {key: value.to(self.device) for key, value in kept.items()}


def discrepancy(fake: list[Pairs], real: list[Pairs], like: Moments) -> float:
    """Return how far pairs are apart, with the cells and weights of a trained objective: a held-out score."""
    total = 0.0
    with torch.no_grad():
        parts = [[like._sums(pairs) for pairs in side] for side in (fake, real)]
    for name, cells in like.sets.items():
        means = []
        for side in parts:
            sums = torch.stack([part[name][0].sum(0) for part in side]).sum(0)
            number = torch.stack([part[name][1].sum(0) for part in side]).sum(0)
            means.append(sums / number.clamp_min(1)[:, None])
        off = means[0] - means[1]
        total += float(torch.einsum("cf,cfg,cg->", off, cells.kept["weight"], off))
    return total
