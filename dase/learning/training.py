"""The training loop: scenes, thresholds, counts, what tells them from real ones, and the way back."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal

import numpy as np
import torch

from dase.errors import InputError
from dase.kernels.autograd_counts import Surrogate
from dase.learning import distributed
from dase.learning.adabelief import AdaBelief
from dase.learning.adversarial import AdversarialObjective, Objective, PatchHash
from dase.learning.cuda_graph import GraphReplay
from dase.learning.gauss_newton import GaussNewton
from dase.learning.moment_matching import Moments
from dase.learning.scene_batches import Scenery, middle_intensity, pack_words, send_words, unpack_words
from dase.learning.targets import (
    Pairs,
    PixelNoise,
    Target,
    answers,
    draw_noise,
    simulate_counts,
    vary_thresholds,
)
from dase.networks.threshold_network import NetworkShape, ThresholdMaps, ThresholdNet

REFERENCE = 0.25, 0.06
"""Threshold and spread at which scenes are counted once more, to tell busy scenes from low thresholds."""

APART = 1_000_003
"""Between the seeds of one process and the next."""

DERIVED = 4
"""Scenes of a step, at least, that are counted at other thresholds as well, to see how the moments answer."""


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Everything about a training run but its data.

    Args:
        objective: `wgan`, the paper's bank of critics, or `moments`.
        steps: Generator steps.
        warmup: Steps before them in which the objective alone learns.
        batch: Scenes of either domain in a step.
        mu: Mean threshold to begin with [log intensity].
        sigma: Standard deviation to begin with [log intensity].
        optimizer: Of the generator: `adam` (0.5, 0.99) or `adabelief` (0.9, 0.999).
        rate: Learning rate of the UNet.
        rate_scalars: Learning rate of the global numbers.
        ramp: Steps over which the rates rise from 0, at most a quarter of all; a cosine takes them back to 0
            at the end.
        average: Decay of the running mean of the weights that is the result; 0 takes the last weights.
        anchor: Weight of the mean square residual.
        smooth: Weight of the roughness of the table.
        kl: λ of Eq. 9, which is added to the loss.
        surrogate: Of the gradient of counts.
        critic_rate: Learning rate of the critics.
        critic_cosine: Whether it falls as the generator's does.
        critic_steps: Steps of the critics in a step.
        penalty: Weight of the gradient penalty.
        uniform: α of Eq. 13; 1 turns re-weighting off.
        critic_image: Whether critics see the image.
        hash: Of the patches.
        cells: Levels of brightness and contrast of the moments.
        memory: Of the fake moments from step to step.
        doubt: Share by which means of features may differ for reasons that thresholds cannot cure.
        newton: Share of a Gauss-Newton step that is taken with the moments.
        network: Of the generator.
        seed: Of everything random.
    """

    objective: Literal["wgan", "moments"] = "wgan"
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
    critic_rate: float = 2e-4
    critic_cosine: bool = False
    critic_steps: int = 1
    penalty: float = 1.0
    uniform: float = 0.5
    critic_image: bool = False
    hash: PatchHash = field(default_factory=PatchHash)
    cells: tuple[int, int] = (6, 5)
    memory: float = 0.95
    doubt: float = 0.0
    newton: float = 0.2
    network: NetworkShape = field(default_factory=NetworkShape)
    seed: int = 0

    def text(self) -> str:
        """Return the recipe as JSON."""
        return json.dumps(asdict(self), indent=1)

    @classmethod
    def parse(cls, text: str) -> Recipe:
        """Return the recipe of a JSON text."""
        table = json.loads(text)
        table["hash"] = PatchHash(**table["hash"])
        network = table["network"]
        for name in ("pattern", "table"):
            network[name] = None if network[name] is None else tuple(network[name])
        table["network"] = NetworkShape(**network)
        table["cells"] = tuple(table["cells"])
        return cls(**{f.name: table[f.name] for f in fields(cls) if f.name in table})


class Training:
    """One run: the state between two steps, and the step.

    Args:
        recipe: How to learn.
        target: What to become like.
        scenery: Draws the simulator's scenes.
    """

    def __init__(self, recipe: Recipe, target: Target, scenery: Scenery):
        self.recipe, self.target, self.scenery, self.device = recipe, target, scenery, scenery.device
        torch.manual_seed(recipe.seed)
        self.net = ThresholdNet(recipe.network, mu=recipe.mu, sigma=recipe.sigma).to(self.device)
        self.net = self.net.to(memory_format=torch.channels_last)
        self.mean = ThresholdNet(recipe.network).to(self.device).to(memory_format=torch.channels_last)
        self.mean.load_state_dict(self.net.state_dict())
        if self.device.type == "cuda":
            # every step has the same shapes, so trying convolutions out once pays
            torch.backends.cudnn.benchmark = True
        self.optimizer = self._optimizer()
        self.objective = self._objective()
        moments = self.objective
        self.newton = GaussNewton(moments, self.net) if isinstance(moments, Moments) else None
        distributed.broadcast_tensors(self.net.state_dict().values())
        self.generator = torch.Generator(self.device).manual_seed(
            recipe.seed + 1 + APART * distributed.process_rank()
        )
        # other processes have scenes and phases of their own
        apart = [distributed.process_rank()] if distributed.process_rank() else []
        self.scenes = np.random.default_rng([recipe.seed, 1, *apart])
        self.reals = np.random.default_rng([recipe.seed, 2, *apart])
        target.part(distributed.process_rank())
        self.replay = GraphReplay(self.device, self._generators())
        self.inputs: torch.Tensor | None = None
        self.step = -recipe.warmup
        self.seconds = 0.0
        self.best = math.inf
        self.calibrated = False

    def _generators(self) -> list[torch.Generator]:
        """Return all random numbers that a step draws on the device."""
        parts = self, self.target, self.objective
        return [part.generator for part in parts if hasattr(part, "generator")]

    def _optimizer(self) -> torch.optim.Optimizer:
        recipe, cuda = self.recipe, self.device.type == "cuda"
        parts = [(self.net.body(), recipe.rate)]
        if recipe.objective == "wgan":
            parts.append((self.net.shared_parameters(), recipe.rate_scalars))
        else:
            for shared in self.net.shared_parameters():
                # moved by Newton's steps
                shared.requires_grad_(False)
        # rates are tensors, which a step that is replayed can read
        groups = [
            {"params": params, "lr": torch.tensor(rate, device=self.device), "full": rate}
            for params, rate in parts
        ]
        if recipe.optimizer == "adabelief":
            return AdaBelief(groups, betas=(0.9, 0.999))
        return torch.optim.Adam(groups, betas=(0.5, 0.99), fused=cuda, capturable=cuda)

    def _objective(self) -> Objective:
        recipe = self.recipe
        if recipe.objective == "moments":
            pattern = recipe.network.pattern is not None
            return Moments(
                device=self.device,
                levels=recipe.cells,
                pattern=pattern,
                memory=recipe.memory,
                scenes=self.target.scenes,
                doubt=recipe.doubt,
            )
        return AdversarialObjective(
            recipe.hash,
            device=self.device,
            seed=recipe.seed + 2,
            rate=recipe.critic_rate,
            steps=recipe.critic_steps,
            penalty=recipe.penalty,
            uniform=recipe.uniform,
            image=recipe.critic_image,
        )

    def calibrate(self, batches: int = 4) -> None:
        """Show the objective what patches of both domains look like."""
        sets = []
        for _ in range(batches):
            with torch.no_grad():
                log = self.scenery.draw(self.scenes, self.recipe.batch)
                sets.append((self.simulate_fake(log)[0], self.target.draw(self.reals, self.recipe.batch)))
        self.objective.calibrate(sets)
        held_out = self.target.held_out()
        if held_out is not None and isinstance(self.objective, Moments):
            for n in range(0, len(held_out), self.recipe.batch):
                some = held_out.select(slice(n, n + self.recipe.batch))
                self.objective.add_real(some, held_out=True)
        self.calibrated = True

    def simulate_fake(self, log: torch.Tensor, step: torch.Tensor | int = 0) -> tuple[Pairs, ThresholdMaps]:
        """Return pairs simulated from log intensities, and the maps of their thresholds."""
        grey = middle_intensity(log)
        maps = self.net(grey)
        mu, sigma = maps.by_polarity() if self.recipe.network.split else (maps.mu, maps.sigma)
        noise = draw_noise(log, self.generator)
        counts = simulate_counts(log, mu, sigma, noise, surrogate=self.recipe.surrogate)
        if self.recipe.objective != "moments":
            return Pairs(grey, counts), maps
        with torch.no_grad():
            level = torch.full_like(grey, REFERENCE[0])
            reference = simulate_counts(log, level, REFERENCE[1], noise)
        varied = vary_thresholds(log, mu, sigma, noise) if self.recipe.rate > 0 else None
        some = choose_derived_scenes(len(log), step, log.device)
        few = PixelNoise(noise.z[some], noise.phase[some])
        near = answers(log[some], mu.detach()[some], sigma.detach()[some], few)
        return Pairs(grey, counts, reference, varied, near, some), maps

    def rate(self) -> float:
        """Return the share of the full learning rates at this step."""
        step, steps = self.step, self.recipe.steps
        ramp = min(self.recipe.ramp, max(steps // 4, 1))
        fall = max(steps - ramp, 1)
        cosine = 0.5 * (1 + math.cos(math.pi * min(max(step - ramp, 0) / fall, 1)))
        return min((step + 1) / max(ramp, 1), 1) * cosine

    def advance(self) -> dict[str, torch.Tensor]:
        """Do one step; return what is worth logging, still on the device and until the next step."""
        if not self.calibrated:
            self.calibrate()
        move = self.step >= 0
        self.inputs = self._draw_inputs(self.rate() if move else 0.0)
        kind = self.objective.begin()
        # in the middle of a run there is only one kind, or two
        values = self.replay(kind if kind is None else (move, kind), lambda: self._step_on_device(move))
        self.step += 1
        return values

    def _draw_inputs(self, share: float) -> torch.Tensor:
        """Draw scenes; return all that a step reads from the processor, where the last one read it."""
        recipe = self.recipe
        critic_rate = recipe.critic_rate * (share if recipe.critic_cosine and self.step >= 0 else 1.0)
        # the first steps are forgotten soon, as if the mean had begun later
        step = max(self.step, 0)
        keep = min(recipe.average, (step + 1) / (step + 10)) if recipe.average else 0.0
        parts = (
            np.array([share, critic_rate, 1 - keep], np.float32),
            np.array([self.step + recipe.warmup], np.int32),
            self.scenery.draw_numbers(self.scenes, recipe.batch),
            self.target.draw_numbers(self.reals, recipe.batch),
        )
        self.shapes = [part.shape for part in parts]
        return send_words(pack_words(*parts), self.device, to=self.inputs)

    def _step_on_device(self, move: bool) -> dict[str, torch.Tensor]:
        """Do what a step does on the device."""
        recipe, inputs = self.recipe, self.inputs
        assert inputs is not None
        numbers, step, scenes, reals = unpack_words(inputs, *self.shapes)
        share, critic_rate, learn = numbers.view(torch.float32).unbind()
        if isinstance(self.objective, AdversarialObjective):
            self.objective.rate = critic_rate
        fake, maps = self.simulate_fake(self.scenery.render(scenes, recipe.batch), step)
        real = self.target.pairs(reals, recipe.batch)
        loss, values = self.objective.loss(fake, real, move=move)
        if self.newton is not None:
            self.newton.see(fake)
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
            if self.newton is not None:
                self.newton.step(recipe.newton * share)
                shared = [v for n, v in self.net.state_dict().items() if not n.startswith("unet.")]
                distributed.broadcast_tensors(shared)
            self._average(learn)
        return values | {"loss": loss.detach()}

    @torch.no_grad()
    def _average(self, learn: torch.Tensor) -> None:
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
            "newton": None if self.newton is None else self.newton.state(),
            "objective": self.objective.state(),
            "random": distributed.gather_objects(self._random()),
            "step": self.step,
            "seconds": self.seconds,
            "best": self.best,
            "calibrated": self.calibrated,
        }

    def _random(self) -> dict[str, Any]:
        """Return what makes this process's scenes its own."""
        return {
            "generator": self.generator.get_state(),
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
        self.objective.load(state["objective"])
        if self.newton is not None:
            self.newton.load(state["newton"])
        mine = state["random"][distributed.process_rank()]
        self.generator.set_state(mine["generator"].cpu())
        self.target.load(mine["target"])
        self.scenes.bit_generator.state = mine["scenes"]
        self.reals.bit_generator.state = mine["reals"]
        self.step, self.seconds, self.best = state["step"], state["seconds"], state["best"]
        self.recipe = Recipe.parse(state["recipe"])
        self.calibrated = state["calibrated"]


def choose_derived_scenes(batch: int, step: torch.Tensor | int, device: torch.device) -> torch.Tensor:
    """Return which scenes of a batch the derivatives are taken of, others in every step; indices."""
    every = max(batch // DERIVED, 1)
    return (torch.arange(-(-batch // every), device=device) * every + step) % batch


def threshold_prior(maps: ThresholdMaps) -> torch.Tensor:
    """Return the mean over pixels of KL(N(μ, σ²) ‖ N(0, 1)): Eq. 9, with the sign that keeps it small."""
    mu, sigma = maps.mu, maps.sigma
    return (0.5 * (sigma.square() + mu.square() - 1) - sigma.log()).mean()
