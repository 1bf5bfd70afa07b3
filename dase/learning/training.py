"""The training loop: scenes, thresholds, counts, an objective's loss, and the way back.

A step is `Training.advance`, to be read from there downwards. The loop draws scenes, lets the network tell
thresholds, counts events, asks the objective what the counts cost, and moves the network's weights. What the
objective compares and what it learns itself is its own affair, see `Objective`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, Self

import numpy as np
import torch

from dase.errors import InputError
from dase.kernels.autograd_counts import Surrogate
from dase.learning import distributed
from dase.learning.adabelief import AdaBelief
from dase.learning.cuda_graph import GraphReplay
from dase.learning.known_physics import KnownPhysics
from dase.learning.random_streams import TrainingDraw, TrainingStream
from dase.learning.scene_batches import Scenery, middle_intensity, pack_words, send_words, unpack_words
from dase.learning.targets import Pairs, PixelNoise, Target, draw_noise, simulate_counts
from dase.networks.threshold_network import NetworkShape, ThresholdMaps, ThresholdNet


@dataclass(frozen=True, kw_only=True)
class TrainingSettings(ABC):
    """What the loop has to know, whatever the objective; see `dase.learning.recipe`.

    Args:
        steps: Generator steps.
        warmup: Steps before them in which the objective alone learns.
        batch: Scenes of either domain in a step.
        mu: Mean threshold to begin with [log intensity].
        sigma: Standard deviation to begin with [log intensity].
        optimizer: Of the generator: `adam` (0.5, 0.99) or `adabelief` (0.9, 0.999).
        rate: Learning rate of the UNet.
        rate_scalars: Learning rate of the parameters that all pixels share, where descent moves them.
        ramp: Steps over which the rates rise from 0, at most a quarter of all; a cosine takes them back to 0
            at the end.
        average: Decay of the running mean of the weights that is the result; 0 takes the last weights.
        anchor: Weight of the mean square residual.
        smooth: Weight of the roughness of the table.
        kl: λ of Eq. 9, which is added to the loss.
        surrogate: Of the gradient of counts.
        network: Of the generator.
        seed: Of everything random.
    """

    steps: int = 3000
    warmup: int = 50
    batch: int = 12
    mu: float = 0.5
    sigma: float = 0.15
    optimizer: Literal["adam", "adabelief"] = "adam"
    rate: float = 1e-4
    rate_scalars: float = 1e-2
    ramp: int = 100
    average: float = 0.995
    anchor: float = 5.0
    smooth: float = 0.1
    kl: float = 1e-5
    surrogate: Surrogate = "expected"
    network: NetworkShape = field(default_factory=NetworkShape)
    seed: int = 0

    @abstractmethod
    def text(self) -> str:
        """Return all that a checkpoint keeps of the settings, as JSON."""

    @classmethod
    @abstractmethod
    def parse(cls, text: str) -> Self:
        """Return the settings of what `text` returned."""


class Objective(Protocol):
    """What a step costs, and what the objective itself learns or moves in a step.

    `Training.advance` calls, in this order: `step_rates` and `begin_step` on the processor; then, on the
    device and perhaps from a recording (see `dase.learning.cuda_graph`), `extend_fake`, `loss`, and, where
    the network moves, `move_shared`.
    """

    @property
    def moves_shared(self) -> bool:
        """Whether `move_shared` moves the parameters that all pixels share, and descent does not."""

    @property
    def generators(self) -> Sequence[torch.Generator]:
        """Random numbers that a step draws on the device."""

    def calibrate(self, sets: list[tuple[Pairs, Pairs]], held_out: Iterable[Pairs] = ()) -> None:
        """Look at pairs of a fake and a real batch, and at held-out real batches, before training."""

    def begin_step(self) -> Hashable:
        """Count a step that is about to come; return its kind, or None for one that is not recorded."""

    def step_rates(self, share: float, *, move: bool) -> list[float]:
        """Return the numbers that `loss` needs of this step and that differ from step to step.

        Args:
            share: Of the full learning rates, see `Training.learning_share`.
            move: Whether the network moves.
        """

    def extend_fake(
        self,
        fake: Pairs,
        log: torch.Tensor,
        mu: torch.Tensor,
        sigma: torch.Tensor,
        noise: PixelNoise,
        step: torch.Tensor | int,
    ) -> Pairs:
        """Return simulated pairs with all that `loss` has to see of them beside their counts.

        Args:
            fake: Images and counts.
            log: Log intensities of their scenes, shape (B, K, H, W).
            mu: Mean thresholds [log intensity], shape (B, H, W), or (B, 2, H, W) with OFF before ON.
            sigma: Their standard deviation, shaped alike.
            noise: That the counts were made with.
            step: Number of the step.
        """

    def loss(
        self, fake: Pairs, real: Pairs, *, move: bool, rates: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Learn from both batches; return the loss, and numbers for the log.

        Without `move` the objective alone learns and the loss has no gradient.

        Args:
            fake: Simulated pairs.
            real: Pairs of the target.
            move: Whether the network moves in this step.
            rates: What `step_rates` returned, float32 on the device; None for the full rates.

        Returns:
            A scalar whose gradient by the fake counts leads towards the real ones (of this process's scenes:
            gradients are summed over processes), and scalars by their names in the log.
        """

    def move_shared(self, share: torch.Tensor) -> None:
        """Move the parameters that all pixels share, if `moves_shared`.

        Args:
            share: Of the full learning rates, as in `step_rates`, a scalar on the device.
        """

    def state(self) -> dict[str, Any]:
        """Return entries of the checkpoint that hold all that the next step depends on."""

    def load(self, state: dict[str, Any]) -> None:
        """Take over its entries of a checkpoint."""


def make_network(settings: TrainingSettings, device: torch.device) -> ThresholdNet:
    """Return the network at its beginning; its weights depend on the seed only."""
    torch.manual_seed(TrainingStream.WEIGHTS.seed(settings.seed))
    net = ThresholdNet(settings.network, mu=settings.mu, sigma=settings.sigma)
    net.to(device)
    net.to(memory_format=torch.channels_last)
    return net


class Training:
    """One run: the state between two steps, and the step.

    Args:
        recipe: How to learn.
        net: What learns, of `make_network`.
        objective: What a step costs.
        target: What to become like.
        scenery: Draws the simulator's scenes.
        physics: What else the camera does, which counts are made with; None for thresholds alone.
    """

    def __init__(
        self,
        recipe: TrainingSettings,
        net: ThresholdNet,
        objective: Objective,
        target: Target,
        scenery: Scenery,
        physics: KnownPhysics | None = None,
    ):
        self.physics = physics
        self.recipe, self.net, self.objective = recipe, net, objective
        self.target, self.scenery, self.device = target, scenery, scenery.device
        self.mean = ThresholdNet(recipe.network).to(self.device).to(memory_format=torch.channels_last)
        self.mean.load_state_dict(self.net.state_dict())
        if self.device.type == "cuda":
            # every step has the same shapes, so trying convolutions out once pays
            torch.backends.cudnn.benchmark = True
        self.optimizer = self._make_optimizer()
        distributed.broadcast_tensors(self.net.state_dict().values())
        # other processes have scenes and phases of their own
        seed, process = recipe.seed, distributed.process_rank()
        self.generator = torch.Generator(self.device).manual_seed(TrainingStream.NOISE.seed(seed, process))
        self.scenes = TrainingDraw.SCENES.generator(seed, process)
        self.reals = TrainingDraw.TARGETS_SCENES.generator(seed, process)
        target.set_process(process)
        self.replay = GraphReplay(self.device, self.generators())
        self.inputs: torch.Tensor | None = None
        self.step = -recipe.warmup
        self.seconds = 0.0
        self.best = math.inf
        self.calibrated = False

    def generators(self) -> list[torch.Generator]:
        """Return all random numbers that a step draws on the device."""
        own = [part.generator for part in (self, self.target) if hasattr(part, "generator")]
        own += [] if self.physics is None else [self.physics.generator]
        return [*own, *self.objective.generators]

    def _make_optimizer(self) -> torch.optim.Optimizer:
        recipe, cuda = self.recipe, self.device.type == "cuda"
        parts = [(self.net.unet_parameters(), recipe.rate)]
        if self.objective.moves_shared:
            for shared in self.net.shared_parameters():
                shared.requires_grad_(False)
        else:
            parts.append((self.net.shared_parameters(), recipe.rate_scalars))
        # rates are tensors, which a step that is replayed can read
        groups = [
            {"params": params, "lr": torch.tensor(rate, device=self.device), "full": rate}
            for params, rate in parts
        ]
        if recipe.optimizer == "adabelief":
            return AdaBelief(groups, betas=(0.9, 0.999))
        return torch.optim.Adam(groups, betas=(0.5, 0.99), fused=cuda, capturable=cuda)

    def advance(self) -> dict[str, torch.Tensor]:
        """Do one step; return what is worth logging, each a scalar on the device, until the next step."""
        if not self.calibrated:
            self.calibrate()
        move = self.step >= 0
        self.inputs = self._draw_inputs(self.learning_share() if move else 0.0)
        kind = self.objective.begin_step()
        # in the middle of a run there is only one kind, or two
        values = self.replay(kind if kind is None else (move, kind), lambda: self._step_on_device(move))
        self.step += 1
        return values

    def calibrate(self, batches: int = 4) -> None:
        """Show the objective what both domains look like."""
        sets = []
        for _ in range(batches):
            with torch.no_grad():
                numbers = self.scenery.draw_numbers(self.scenes, self.recipe.batch)
                fake, _ = self.simulate_fake(send_words(numbers, self.device))
                sets.append((fake, self.target.draw(self.reals, self.recipe.batch)))
        self.objective.calibrate(sets, self._held_out_batches())
        self.calibrated = True

    def _held_out_batches(self) -> Iterable[Pairs]:
        held_out = self.target.held_out()
        if held_out is not None:
            # one at a time: as float32 all of them might not fit into memory
            for n in range(0, len(held_out), self.recipe.batch):
                yield held_out.select(slice(n, n + self.recipe.batch))

    def learning_share(self) -> float:
        """Return the share of the full learning rates at this step."""
        step, steps = self.step, self.recipe.steps
        ramp = min(self.recipe.ramp, max(steps // 4, 1))
        fall = max(steps - ramp, 1)
        cosine = 0.5 * (1 + math.cos(math.pi * min(max(step - ramp, 0) / fall, 1)))
        return min((step + 1) / max(ramp, 1), 1) * cosine

    def _draw_inputs(self, share: float) -> torch.Tensor:
        """Draw scenes; return all that a step reads from the processor, where the last one read it.

        Returns:
            Words of 4 bytes, int32: learning rates, number of the step, and what is random in the scenes. The
            memory is the same in every step, because a step that is replayed reads where it was recorded.
        """
        recipe = self.recipe
        # the first steps are forgotten soon, as if the mean had begun later
        step = max(self.step, 0)
        keep = min(recipe.average, (step + 1) / (step + 10)) if recipe.average else 0.0
        rates = self.objective.step_rates(share, move=self.step >= 0)
        parts = (
            np.array([share, 1 - keep, *rates], np.float32),
            np.array([self.step + recipe.warmup], np.int32),
            self.scenery.draw_numbers(self.scenes, recipe.batch),
            self.target.draw_numbers(self.reals, recipe.batch),
        )
        self.shapes = [part.shape for part in parts]
        return send_words(pack_words(*parts), self.device, to=self.inputs)

    def _step_on_device(self, move: bool) -> dict[str, torch.Tensor]:
        """Do what a step does on the device; nothing here may wait for it, or a recording would fail."""
        recipe, inputs = self.recipe, self.inputs
        assert inputs is not None
        numbers, step, scenes, reals = unpack_words(inputs, *self.shapes)
        numbers = numbers.view(torch.float32)
        share, learn, rates = numbers[0], numbers[1], numbers[2:]
        fake, maps = self.simulate_fake(scenes, step)
        real = self.target.pairs(reals, recipe.batch)
        loss, values = self.objective.loss(fake, real, move=move, rates=rates)
        if move:
            held = recipe.anchor * maps.residual.square().mean() + recipe.kl * threshold_prior(maps)
            if recipe.smooth:
                held = held + recipe.smooth * self.net.roughness()
            # the objective's part is that of the process's own scenes, to be summed over all
            loss = loss + held / distributed.process_count()
            for group in self.optimizer.param_groups:
                group["lr"].copy_(share * group["full"])
            self.optimizer.zero_grad(set_to_none=True)
            loss.backward()
            distributed.sum_gradients(self.net.parameters())
            self.optimizer.step()
            self.objective.move_shared(share)
            self._average_weights(learn)
        return values | {"loss": loss.detach()}

    def simulate_fake(
        self, numbers: torch.Tensor, step: torch.Tensor | int = 0
    ) -> tuple[Pairs, ThresholdMaps]:
        """Return pairs simulated from the scenes that `numbers` (words,) drew, and their thresholds' maps."""
        batch, lead = self.recipe.batch, len(self.scenery.lead)
        log = self.scenery.render(numbers, batch)
        grey = middle_intensity(log, lead)
        maps = self.net(grey)
        mu, sigma = maps.by_polarity() if self.recipe.network.split else (maps.mu, maps.sigma)
        noise = draw_noise(log, self.generator, lead)
        counts = simulate_counts(log, mu, sigma, noise, surrogate=self.recipe.surrogate)
        if self.physics is not None:
            # what all effects make of the scenes; how thresholds move counts is told by thresholds alone
            told = self.physics.count(log, maps, self.scenery.known(numbers, batch))
            counts = counts + (told - counts).detach()
        return self.objective.extend_fake(Pairs(grey, counts), log, mu, sigma, noise, step), maps

    @torch.no_grad()
    def _average_weights(self, learn: torch.Tensor) -> None:
        """Move the running mean of the weights by the share `learn` towards them."""
        mine, theirs = list(self.mean.parameters()), list(self.net.parameters())
        apart = torch._foreach_sub(theirs, mine)
        torch._foreach_mul_(apart, learn)
        torch._foreach_add_(mine, apart)

    def state(self) -> dict[str, Any]:
        """Return everything the rest of the run depends on."""
        return {
            "recipe": self.recipe.text(),
            "net": self.net.state_dict(),
            "mean": self.mean.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            **self.objective.state(),
            "random": distributed.gather_objects(self._random_state()),
            "step": self.step,
            "seconds": self.seconds,
            "best": self.best,
            "calibrated": self.calibrated,
        }

    def _random_state(self) -> dict[str, Any]:
        """Return what makes this process's scenes its own."""
        return {
            "generator": self.generator.get_state(),
            "physics": None if self.physics is None else self.physics.generator.get_state(),
            "target": self.target.state(),
            "scenes": self.scenes.bit_generator.state,
            "reals": self.reals.bit_generator.state,
        }

    def load(self, state: dict[str, Any]) -> None:
        """Take over what `state` returned; raises InputError for the state of another number of processes."""
        if len(state["random"]) != distributed.process_count():
            raise InputError(
                f"the run has {len(state['random'])} processes, not {distributed.process_count()}"
            )
        self.net.load_state_dict(state["net"])
        self.mean.load_state_dict(state["mean"])
        self.optimizer.load_state_dict(state["optimizer"])
        for group in self.optimizer.param_groups:
            group["lr"] = torch.as_tensor(group["lr"], device=self.device)
        self.objective.load(state)
        mine = state["random"][distributed.process_rank()]
        self.generator.set_state(mine["generator"].cpu())
        if self.physics is not None:
            self.physics.generator.set_state(mine["physics"].cpu())
        self.target.load(mine["target"])
        self.scenes.bit_generator.state = mine["scenes"]
        self.reals.bit_generator.state = mine["reals"]
        self.step, self.seconds, self.best = state["step"], state["seconds"], state["best"]
        self.recipe = self.recipe.parse(state["recipe"])
        self.calibrated = state["calibrated"]


def threshold_prior(maps: ThresholdMaps) -> torch.Tensor:
    """Return the mean over pixels of KL(N(μ, σ²) ‖ N(0, 1)): Eq. 9, with the sign that keeps it small."""
    mu, sigma = maps.mu, maps.sigma
    return (0.5 * (sigma.square() + mu.square() - 1) - sigma.log()).mean()
