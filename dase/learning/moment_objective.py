"""The objective without an adversary: moments that shall agree, and Gauss-Newton steps that make them.

The moments are those of `dase.learning.moment_matching`. The network's UNet descends their difference; the
few parameters that all pixels share are moved by `dase.learning.gauss_newton`.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable
from dataclasses import replace
from typing import Any

import torch

from dase.learning import distributed
from dase.learning.gauss_newton import GaussNewton
from dase.learning.moment_matching import REFERENCE, Moments, MomentSettings
from dase.learning.targets import Pairs, PixelNoise, simulate_counts, vary_parameters, vary_thresholds
from dase.networks.threshold_network import ThresholdNet


class MomentObjective:
    """Compare the moments, and move the shared parameters by Gauss-Newton steps.

    Args:
        settings: What to compare.
        net: Whose shared parameters are moved; on the device that learns.
        scenes: How many different real scenes there are.
        trains_network: Whether the UNet learns, too, so that counts need a gradient by every threshold.
        derived: Scenes of a step, at least, that are counted at other parameters as well, to see how the
            moments answer. That is most of a step's counting, and a running mean needs only some.
    """

    moves_shared = True
    generators: tuple[torch.Generator, ...] = ()

    def __init__(
        self,
        settings: MomentSettings,
        net: ThresholdNet,
        *,
        scenes: float = math.inf,
        trains_network: bool = True,
        derived: int = 4,
    ):
        self.settings, self.net = settings, net
        self.trains_network, self.derived = trains_network, derived
        pattern = net.shape.pattern is not None
        self.moments = Moments(settings, device=net.level.device, pattern=pattern, scenes=scenes)
        self.newton = GaussNewton(self.moments, net)

    def calibrate(self, sets: list[tuple[Pairs, Pairs]], held_out: Iterable[Pairs] = ()) -> None:
        """Place the cells, and take in the moments of held-out real batches."""
        self.moments.calibrate(sets)
        for some in held_out:
            self.moments.add_real(some, held_out=True)

    def begin_step(self) -> Hashable:
        """Count a step that is about to come; return its kind, see `Moments.begin_step`."""
        return self.moments.begin_step()

    def step_rates(self, share: float, *, move: bool) -> list[float]:
        """Return nothing: all steps are alike."""
        return []

    def extend_fake(
        self,
        fake: Pairs,
        log: torch.Tensor,
        mu: torch.Tensor,
        sigma: torch.Tensor,
        noise: PixelNoise,
        step: torch.Tensor | int,
    ) -> Pairs:
        """Count the scenes at the reference thresholds, and at thresholds a little higher and lower.

        Args:
            fake: Images (B, H, W) and counts (B, 2, H, W).
            log: Log intensities of their scenes, shape (B, K, H, W).
            mu: Mean thresholds [log intensity], shape (B, H, W), or (B, 2, H, W) with OFF before ON.
            sigma: Their standard deviation, shaped alike.
            noise: That the counts were made with; the same for all, or chance would hide the differences.
            step: Number of the step, which chooses the scenes of the derivatives.
        """
        with torch.no_grad():
            level = torch.full_like(fake.grey, REFERENCE[0])
            reference = simulate_counts(log, level, REFERENCE[1], noise)
        varied = vary_thresholds(log, mu, sigma, noise) if self.trains_network else None
        some = self.choose_derived_scenes(len(log), step, log.device)
        few = replace(noise, z=noise.z[some], phase=noise.phase[some])
        answers = vary_parameters(log[some], mu.detach()[some], sigma.detach()[some], few)
        return replace(fake, reference=reference, varied=varied, answers=answers, some=some)

    def choose_derived_scenes(
        self, batch: int, step: torch.Tensor | int, device: torch.device
    ) -> torch.Tensor:
        """Return which scenes of a batch the derivatives are taken of, others in every step; indices (n,)."""
        every = max(batch // self.derived, 1)
        return (torch.arange(-(-batch // every), device=device) * every + step) % batch

    def loss(
        self, fake: Pairs, real: Pairs, *, move: bool, rates: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Take both batches in; see `Moments.loss` for the loss and the distance, each a scalar."""
        loss, values = self.moments.loss(fake, real, move=move)
        self.newton.add_answers(fake)
        return loss, values

    def move_shared(self, share: torch.Tensor) -> None:
        """Take a share of a Gauss-Newton step of the shared parameters.

        Args:
            share: Of the step that the settings ask for, a scalar on the device.
        """
        self.newton.step(self.settings.newton * share)
        # every process has solved the same equations, but sums on a GPU are taken in any order
        shared = [v for n, v in self.net.state_dict().items() if not n.startswith("unet.")]
        distributed.broadcast_tensors(shared)

    def state(self) -> dict[str, Any]:
        """Return the entries `objective` and `newton` of a checkpoint."""
        return {"newton": self.newton.state(), "objective": self.moments.state()}

    def load(self, state: dict[str, Any]) -> None:
        """Take over its entries of a checkpoint."""
        self.moments.load(state["objective"])
        self.newton.load(state["newton"])
