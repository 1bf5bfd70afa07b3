"""Training a network that reconstructs intensity from events: one loop, top to bottom."""

from __future__ import annotations

import copy
import json
import math
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import torch

from dase.errors import InputError
from dase.learning import distributed
from dase.tasks.carried_memory import CarriedMemory
from dase.tasks.checkpoints import restore_training, save_checkpoint
from dase.tasks.event_networks import EventNetwork
from dase.tasks.image_metrics import Lpips, structural_similarity, temporal_inconsistency
from dase.tasks.optimisation import BatchSource, Optimisation
from dase.tasks.training_step import Losses, TrainingStep
from dase.torch.batch import Batch


@dataclass(frozen=True, kw_only=True)
class ReconstructionTraining(Optimisation):
    """How a reconstruction network is trained.

    Args:
        l1: Weight of the mean absolute error.
        ssim: Weight of 1 - SSIM.
        temporal: Weight of the temporal inconsistency (S2R, 2020).
        lpips: Weight of the perceptual distance, where a file of its weights is named.
        lpips_weights: That file, see `Lpips`; None for no perceptual distance.
        skip: First windows of a scene that only the temporal loss counts: nothing is known there yet.
    """

    l1: float = 1.0
    ssim: float = 0.5
    temporal: float = 1.0
    lpips: float = 0.5
    lpips_weights: str | None = None
    skip: int = 2


def train_reconstruction(
    network: EventNetwork,
    batches: BatchSource,
    folder: str | PathLike[str],
    settings: ReconstructionTraining = ReconstructionTraining(),
) -> EventNetwork:
    """Train a network, or go on where `folder` has a checkpoint; return it with averaged weights.

    The same batches and settings give the same weights, however often the training was stopped, on one
    processor or GPU as far as PyTorch's kernels repeat themselves.

    Args:
        network: With any weights; they are drawn anew from the seed.
        batches: Returns batches from a number on, as `lambda first: dase.torch.Stream(first_batch=first)`.
            What the network remembers goes on from batch to batch until `Batch.reset`, so scenes may go on
            for several, as with `Stream(scene_batches=4)`; gradients end with the batch.
        folder: Gets `checkpoint.pt` and `log.jsonl`, a JSON object per line.
        settings: How it is trained.

    Raises:
        InputError: The folder holds another training, or a loss is not finite.
    """
    if network.task != "reconstruction":
        raise InputError(f"{network.kind} is a network for {network.task}, not for reconstruction")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "checkpoint.pt"
    device = distributed.join_processes(settings.device)

    # the same first weights whatever was drawn before
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        network = type(network)(**network.shape).to(device)
    averaged = copy.deepcopy(network)
    perceptual = None if settings.lpips_weights is None else Lpips(settings.lpips_weights).to(device)

    memory = CarriedMemory()

    def forward(batch: Batch) -> torch.Tensor:
        return memory.sequence(network, batch)

    def losses(made: torch.Tensor, batch: Batch) -> Losses:
        return reconstruction_losses(made, batch, settings, perceptual)

    take_step = TrainingStep(network, averaged, settings, device, forward, losses)
    optimizer, steps, window = take_step.optimizer, settings.steps, settings.window
    first = restore_training(
        path, network, averaged, optimizer, steps=steps, window=window, device=device, memory=memory
    )
    if first < settings.last_step:
        source = iter(batches(first))
        for step in range(first, settings.last_step):
            values = take_step(next(source), step)

            done = step + 1
            last = done == settings.last_step
            if done % settings.log_every == 0 or last:
                row = {name: round(float(value), 6) for name, value in values.items()}
                if not math.isfinite(row["loss"]):
                    raise InputError(
                        f"{folder}: the loss of step {done} is {row['loss']}; lower learning_rate"
                    )
                if distributed.process_rank() == 0:
                    with (folder / "log.jsonl").open("a", encoding="utf-8") as log:
                        log.write(json.dumps({"step": done, **row}) + "\n")
            if (done % settings.save_every == 0 or last) and distributed.process_rank() == 0:
                save_checkpoint(
                    path, network, averaged, optimizer, step=done, steps=steps, window=window, memory=memory
                )
    distributed.leave_processes()
    averaged.eval()
    return averaged


def reconstruction_losses(
    made: torch.Tensor, batch: Batch, settings: ReconstructionTraining, perceptual: Lpips | None
) -> dict[str, torch.Tensor]:
    """Return the weighted sum `loss` and its parts, scalars.

    Args:
        made: Reconstructions, shape (T, B, 1, H, W).
        batch: What they are of.
        settings: Weights of the parts.
        perceptual: LPIPS, where its weights are known.
    """
    seen, real = made.flatten(0, 1), batch.frames.flatten(0, 1)
    counted = _windows_that_count(batch.reset, settings.skip).flatten().float()
    weight = counted / counted.sum()
    losses = {
        "l1": (weight * (seen - real).abs().mean((1, 2, 3))).sum(),
        "ssim": (weight * (1 - structural_similarity(seen, real))).sum(),
    }
    losses["loss"] = settings.l1 * losses["l1"] + settings.ssim * losses["ssim"]
    if settings.temporal and len(made) > 1:
        parts = made[1:], made[:-1], batch.frames[1:], batch.frames[:-1]
        a, b, c, d = (one.flatten(0, 1) for one in parts)
        moved = settings.window * batch.flow[1:].flatten(0, 1)
        # a window that begins another scene has nothing to agree with
        same = (~batch.reset[1:]).flatten().float()
        losses["temporal"] = (same * temporal_inconsistency(a, b, c, d, moved)).sum() / same.sum().clamp_min(
            1
        )
        losses["loss"] = losses["loss"] + settings.temporal * losses["temporal"]
    if perceptual is not None:
        losses["lpips"] = (weight * perceptual(seen, real)).sum()
        losses["loss"] = losses["loss"] + settings.lpips * losses["lpips"]
    return losses


def _windows_that_count(reset: torch.Tensor, skip: int) -> torch.Tensor:
    """Return which windows are at least `skip` behind the begin of their scene, bool, shape (T, B)."""
    fresh = torch.zeros_like(reset)
    for after in range(min(skip, len(reset))):
        fresh[after:] |= reset[: len(reset) - after]
    counted = ~fresh
    counted[-1] = True  # a batch of begins alone would teach nothing
    return counted
