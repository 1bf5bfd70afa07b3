"""Training a network that tells optical flow from events: one loop, top to bottom."""

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
from dase.tasks.checkpoints import restore_training, save_checkpoint
from dase.tasks.event_networks import EventNetwork
from dase.tasks.optimisation import BatchSource, Optimisation
from dase.tasks.training_step import Losses, TrainingStep
from dase.torch.batch import Batch


@dataclass(frozen=True, kw_only=True)
class FlowTraining(Optimisation):
    """How a flow network is trained; windows are longer than for reconstruction."""

    steps: int = 5000
    window: float = 1 / 30


def train_flow(
    network: EventNetwork,
    batches: BatchSource,
    folder: str | PathLike[str],
    settings: FlowTraining = FlowTraining(),
) -> EventNetwork:
    """Train a network, or go on where `folder` has a checkpoint; return it with averaged weights.

    The same batches and settings give the same weights, however often the training was stopped, on one
    processor or GPU as far as PyTorch's kernels repeat themselves.

    Args:
        network: With any weights; they are drawn anew from the seed.
        batches: Returns batches from a number on, as `lambda first: dase.torch.Stream(first_batch=first)`.
        folder: Gets `checkpoint.pt` and `log.jsonl`, a JSON object per line.
        settings: How it is trained.

    Raises:
        InputError: The folder holds another training, or a loss is not finite.
    """
    if network.task != "flow":
        raise InputError(f"{network.kind} is a network for {network.task}, not for flow")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "checkpoint.pt"
    device = distributed.join_processes(settings.device)

    # the same first weights whatever was drawn before
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        network = type(network)(**network.shape).to(device)
    averaged = copy.deepcopy(network)

    def forward(batch: Batch) -> torch.Tensor:
        made: torch.Tensor = network(batch.inputs.flatten(0, 1))[0]
        return made

    def losses(made: torch.Tensor, batch: Batch) -> Losses:
        loss, error = flow_loss(made, batch, settings.window)
        return {"loss": loss, "error": error}

    take_step = TrainingStep(network, averaged, settings, device, forward, losses)
    optimizer, steps, window = take_step.optimizer, settings.steps, settings.window
    first = restore_training(path, network, averaged, optimizer, steps=steps, window=window, device=device)
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
                save_checkpoint(path, network, averaged, optimizer, step=done, steps=steps, window=window)
    distributed.leave_processes()
    averaged.eval()
    return averaged


def flow_loss(made: torch.Tensor, batch: Batch, window: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the loss and the mean endpoint error [px per window], scalars.

    Pixels weigh by 1 / (1 + speed): things that cross the whole picture within a window would else be all
    that counts. Pixels whose flow is not known are left out.

    Args:
        made: Displacements x, y [px per window], shape (T * B, 2, H, W).
        batch: What they are of.
        window: Duration of its windows [s].
    """
    truth = window * batch.flow.flatten(0, 1)
    known = truth.isfinite().all(1)
    truth = torch.nan_to_num(truth)
    # masked, not chosen: how many there are is a number that the processor would have to wait for
    apart = torch.where(known[:, None], made - truth, 0.0)
    far = truth.square().sum(1).sqrt()
    # no pixel at all is no loss, and not the mean of nothing
    some = known.sum().clamp_min(1)
    loss = (apart.abs().sum(1) / (1 + far)).sum() / some
    return loss, apart.detach().square().sum(1).sqrt().sum() / some
