"""Gauss-Newton steps of the few numbers that all pixels share, from the moments.

How the moments answer to the level, the table, the ratio and the patterns of a `ThresholdNet` is measured by
counting the same scenes with all thresholds a little higher and lower. With that, the differences of the
moments say at once how far to go, however unlike the numbers' scales are; what is left to gradient descent is
the UNet.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch

from dase.kernels.autograd_counts import STEP
from dase.learning import distributed
from dase.learning.moment_matching import (
    CellMoments,
    Moments,
    add_neighbour_features,
    add_next_pixel_features,
    single_pixel_features,
    sum_by_cell,
)
from dase.learning.targets import Pairs
from dase.networks.threshold_network import ThresholdNet


@dataclass(frozen=True, kw_only=True)
class GaussNewtonSettings:
    """The numbers of the method.

    Args:
        memory: Share of the derivatives and of the excess that stays from step to step.
        longest: Most that a number moves in a step [in its logarithm]: derivatives hold nearby only.
        widest: Most that a column or row is off [in its logarithm]; none without events may run away.
        spreads: Candidates of the prior spread between neighbouring nodes of the table [in its logarithm],
            ascending, from a table that is nearly flat to one that is nearly free.
        excess: To begin with; large, since the first thresholds may be far off, which no table should follow.
        pattern_spread: Prior spread of the offsets of columns and rows [in their logarithm].
        pattern_share: Share of a step that they take, beside that of all numbers.
        ridge: Added to the information of the data, as a share of its mean: some nodes are seen nowhere.
    """

    memory: float = 0.95
    longest: float = 0.1
    widest: float = 1.0
    spreads: tuple[float, ...] = tuple(10 ** (n / 4) for n in range(-10, 1))
    excess: float = 100.0
    pattern_spread: float = 0.3
    pattern_share: float = 0.5
    ridge: float = 1e-6


class GaussNewton:
    """Running derivatives of the moments, and the steps.

    What is left of the differences, above what chance between scenes explains, says how far the simulator's
    scenes are from the target's: the data is trusted that much less (`excess`), and the table held firmer.

    Args:
        moments: What is to vanish.
        net: Whose shared numbers are moved.
        settings: Numbers of the method.

    Attributes:
        loose: Prior spread of the table that was chosen last, a scalar [in its logarithm].
        excess: Square of the differences over that of chance, at least 1, a scalar.
        kept: Running sums of derivatives, float64, which a checkpoint holds: with C cells, F features and N
            nodes, `mu` and `sigma` (C, F, N), `ratio` (C, F, 1), `number` (C,) [pixels]; of columns and rows
            `column_mu` and the like (columns, F), `column_number` (columns,).
        prior: Precision of the shared numbers at unit spread, (p, p).
    """

    def __init__(
        self, moments: Moments, net: ThresholdNet, *, settings: GaussNewtonSettings = GaussNewtonSettings()
    ):
        self.moments, self.net, self.settings = moments, net, settings
        self._choices = torch.tensor(settings.spreads, dtype=torch.float64, device=moments.device)
        self.loose = self._choices[len(settings.spreads) // 2].clone()
        self.excess = torch.full((), settings.excess, dtype=torch.float64, device=moments.device)
        moments.excess = self.excess
        self.kept: dict[str, torch.Tensor] = {}
        self.prior = self._table_precision()

    @torch.no_grad()
    def add_answers(self, fake: Pairs) -> None:
        """Take in how the counts of a batch answer.

        Args:
            fake: B simulated pairs, with `answers` for all of them or for `some`.
        """
        assert fake.answers is not None
        ends = {
            name: [single_pixel_features(counts) for counts in both] for name, both in fake.answers.items()
        }

        long = self.moments.weighting.pattern_memory

        def slope(name: str, add: Callable[[torch.Tensor], torch.Tensor]) -> torch.Tensor:
            above, below = ends[name]
            return (add(above) - add(below)) / (2 * STEP)

        grey = fake.grey if fake.some is None else fake.grey[fake.some]
        member, number = self.moments.cell_members(grey)
        self._accumulate("number", number.sum(0).double())
        # half the memory traffic; what a derivative is off by only makes a step a little longer or shorter
        working = torch.bfloat16 if grey.is_cuda else torch.float32
        rows, columns = (hats.flatten(2).transpose(1, 2).to(working) for hats in self.net.node_weights(grey))
        cells, size = number.shape[1], (rows.shape[2], columns.shape[2])
        # a node is a row times a column: half goes to the cells, half to the features
        member = member.to(working)
        places = (member[..., None] * columns[:, :, None]).flatten(2)
        for name in ends:
            flat = slope(name, add_neighbour_features).flatten(2).transpose(1, 2).to(working)  # (B, N, F)
            width = flat.shape[2]
            if name == "ratio":
                total = sum_by_cell(member, flat).sum(0).view(cells, width, 1)
            else:
                each = (flat[..., None] * rows[:, :, None]).flatten(2)
                total = sum_by_cell(places, each).sum(0).view(cells, size[1], width, size[0])
                total = total.permute(0, 2, 3, 1).reshape(cells, width, -1)
            self._accumulate(name, total.double())
            if self.moments.pattern and name != "ratio":
                down, across = (slope(name, partial(add_next_pixel_features, axis=axis)) for axis in (-2, -1))
                self._accumulate(f"column_{name}", down.sum((0, 2)).T.double(), long)
                self._accumulate(f"row_{name}", across.sum((0, 3)).T.double(), long)
        if self.moments.pattern:
            batch, height, width = grey.shape
            self._accumulate("column_number", fake.counts.new_full((width,), batch * height).double(), long)
            self._accumulate("row_number", fake.counts.new_full((height,), batch * width).double(), long)

    def _accumulate(self, name: str, value: torch.Tensor, memory: float | None = None) -> None:
        kept, value = self.kept.get(name), distributed.sum_over_processes(value)
        self.kept[name] = value if kept is None else kept.mul_(memory or self.settings.memory).add_(value)

    def _jacobian(self) -> torch.Tensor:
        """Return derivatives of the means by the shared numbers, (cells · F, p): nodes of μ, of σ, ratio."""
        parts = [self.kept[name] for name in ("mu", "sigma", "ratio") if name in self.kept]
        whole = torch.cat(parts, 2) / self.kept["number"].clamp_min(1)[:, None, None]
        return whole.flatten(0, 1)

    def _table_precision(self) -> torch.Tensor:
        """Return the precision (p, p) of the table for unit prior spread between neighbouring nodes."""
        shape = self.net.shape.table
        nodes = 1 if shape is None else shape[0] * shape[1]
        laplacian = torch.zeros(nodes, nodes, dtype=torch.float64)
        if shape is not None:
            index = torch.arange(nodes).view(shape)
            pairs = [(index[1:], index[:-1]), (index[:, 1:], index[:, :-1])]
            for a, b in ((a.flatten(), b.flatten()) for a, b in pairs):
                edge = torch.zeros(len(a), nodes, dtype=torch.float64)
                edge[torch.arange(len(a)), a], edge[torch.arange(len(a)), b] = 1, -1
                laplacian += edge.T @ edge
        size = 2 * nodes + int(self.net.shape.split)
        out = torch.zeros(size, size, dtype=torch.float64)
        out[:nodes, :nodes] = out[nodes : 2 * nodes, nodes : 2 * nodes] = laplacian
        return out.to(self.moments.device)

    def shared_numbers(self) -> torch.Tensor:
        """Return the shared numbers, shape (p,), in the order of the derivatives."""
        net = self.net
        maps = net.level[:, None] if net.shape.table is None else net.table.flatten(1)
        parts = [maps[0], maps[1], *([net.asymmetry.view(1)] if net.shape.split else [])]
        return torch.cat(parts).detach().double()

    def _real_scene_count(self, cells: CellMoments) -> torch.Tensor:
        """Return how many different real scenes the means are of."""
        return cells.kept["real_scenes"].clamp(1, min(self.moments.scenes, 1e9))

    @torch.no_grad()
    def step(self, share: float | torch.Tensor) -> None:
        """Move the shared numbers by `share` of what makes the moments vanish, as far as the prior lets.

        With the Jacobian J of the moments, their weights W, differences d, and numbers x with prior P, the
        whole step is -(JᵀWJ + P)⁻¹ (JᵀWd + Px).

        Args:
            share: A number, or a scalar on the device.
        """
        cells = self.moments.sets["look"]
        jacobian, prior = self._jacobian(), self.prior
        # weights are of one scene, and per cell and feature
        whole = cells.kept["weight"][0].double() * len(jacobian)
        scenes = 1 / (1 / self._real_scene_count(cells) + 1 / cells.kept["scenes"])
        # chance in the real scenes and in the simulated ones adds up, see `scenes`
        weight = whole * scenes / self.excess
        off = cells.mean_difference().flatten()
        curve = jacobian.T @ weight @ jacobian
        pull = jacobian.T @ weight @ off
        here = self.shared_numbers()
        eye = torch.eye(len(curve), device=curve.device, dtype=curve.dtype)
        tiny = self.settings.ridge * eye * curve.diagonal().mean()
        if self.moments.reweighs and self.net.shape.table is not None:
            self._choose_prior_spread(curve + tiny, curve @ here - pull, prior)
        hold = prior / self.loose**2
        # as a table that nothing holds leaves it, or a firm one would look like a bad model
        free = self.excess * curve + prior / self.settings.spreads[-1] ** 2 + tiny
        both = torch.stack([curve + hold + tiny, free])
        move, fit = _solve_positive_definite(both, torch.stack([-pull - hold @ here, self.excess * pull]))
        # what a free table could not explain, in units of what chance leaves
        rest = off - jacobian @ fit
        excess = rest @ whole @ rest * scenes / cells.kept["usual"]
        self.excess.copy_(torch.lerp(excess, self.excess, self.settings.memory).clamp_min(1.0))
        longest = self.settings.longest
        move = (share * move).clamp(-longest, longest)
        self._move_network(move)
        # the running means are of scenes seen before the move, so the move has to be told to them
        cells.shift_fake_means((jacobian @ move).view(cells.kept["fake_sum"].shape))
        if self.moments.pattern:
            self._move_patterns(share)

    def _choose_prior_spread(self, curve: torch.Tensor, data: torch.Tensor, prior: torch.Tensor) -> None:
        """Choose the prior spread that makes the moments most likely, the table being averaged over.

        Real scenes held out could not choose: they have the real textures, and a table bent to those fits
        them too. The evidence (MacKay, Bayesian interpolation, 1992) asks whether chance, the choice of
        textures included, explains the differences between cells without a table.

        Args:
            curve: Information of the data on the shared numbers, (p, p).
            data: The same times what the data alone makes of them, (p,).
            prior: Precision at unit spread, (p, p).
        """
        # the differences of the nodes of μ and of σ; nothing holds their levels and the ratio
        rank = 2 * (self.kept["mu"].shape[2] - 1)
        scores = []
        for loose in self.settings.spreads:
            whole = curve + prior / loose**2
            fit = 0.5 * data @ _solve_positive_definite(whole, data)
            scores.append(fit - 0.5 * torch.linalg.slogdet(whole).logabsdet - rank * math.log(loose))
        self.loose.copy_(self._choices.take(torch.stack(scores).argmax()))

    def _move_network(self, move: torch.Tensor) -> None:
        net = self.net
        nodes = self.kept["mu"].shape[2]
        maps = move[: 2 * nodes].float().view(2, nodes)
        if net.shape.table is None:
            net.level += maps[:, 0]
        else:
            net.table += maps.view(net.table.shape)
        if net.shape.split:
            net.asymmetry += move[-1].float()

    def _move_patterns(self, share: float | torch.Tensor) -> None:
        """Move the offsets of columns and rows, each by its own moments.

        One column sees little, so simulated scenes are remembered longer and noise in them counts as well.
        """
        how = self.settings
        longest, widest = how.longest, how.widest
        for axis, offsets in (("column", self.net.columns), ("row", self.net.rows)):
            cells = self.moments.sets[axis]
            number = self.kept[f"{axis}_number"][:, None]
            jacobian = torch.stack([self.kept[f"{axis}_{n}"] / number for n in ("mu", "sigma")], 2)
            weight = cells.kept["weight"].double()
            curve = torch.einsum("cfp,cfg,cgq->cpq", jacobian, weight, jacobian)
            pull = torch.einsum("cfp,cfg,cg->cp", jacobian, weight, cells.mean_difference())
            scenes = 1 / (1 / self._real_scene_count(cells) + 1 / cells.kept["fake_scenes"])
            unit = 1 / (scenes * weight.shape[0] * weight.shape[1] * how.pattern_spread**2)
            eye = torch.eye(2, device=curve.device, dtype=curve.dtype)
            here = offsets.T.double()
            move = -_solve_positive_definite(curve + unit * eye, pull + unit * here)
            # the mean of all columns is the level's, which the step above moves
            move = (how.pattern_share * share * (move - move.mean(0))).clamp(-longest, longest)
            move = (here + move).clamp(-widest, widest) - here
            offsets += move.T.float()
            cells.shift_fake_means(torch.einsum("cfp,cp->cf", jacobian, move))

    def state(self) -> dict[str, Any]:
        """Return what the next step depends on."""
        return {"kept": self.kept, "loose": self.loose, "excess": self.excess}

    def load(self, state: dict[str, Any]) -> None:
        """Take over what `state` returned."""
        self.kept = {name: value.to(self.moments.device) for name, value in state["kept"].items()}
        self.loose, self.excess = (state[name].to(self.moments.device) for name in ("loose", "excess"))
        self.moments.excess = self.excess


def _solve_positive_definite(matrix: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
    """Return the solutions of symmetric positive definite systems, without waiting for the GPU to say so."""
    factor, _ = torch.linalg.cholesky_ex(matrix)
    half = torch.linalg.solve_triangular(factor, right[..., None], upper=False)
    out: torch.Tensor = torch.linalg.solve_triangular(factor.mT, half, upper=True)[..., 0]
    return out
