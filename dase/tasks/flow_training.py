"""Training a network that tells optical flow from events: one loop, top to bottom."""

from __future__ import annotations

import copy
import json
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import torch

from dase.errors import InputError
from dase.learning import distributed
from dase.tasks.checkpoints import restore_training, save_checkpoint
from dase.tasks.event_networks import EventNetwork
from dase.tasks.optimisation import BatchSource, Optimisation, average_weights, mean_gradients
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
    optimizer = torch.optim.AdamW(
        network.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay
    )

    first = restore_training(
        path, network, averaged, optimizer, steps=settings.steps, window=settings.window, device=device
    )
    if first < settings.last_step:
        source = iter(batches(first))
        half = settings.mixed_precision and device.startswith("cuda")
        for step in range(first, settings.last_step):
            batch = next(source).to(device)
            for group in optimizer.param_groups:
                group["lr"] = settings.rate(step)
            with torch.autocast(torch.device(device).type, torch.bfloat16, enabled=half):
                made, _ = network(batch.inputs.flatten(0, 1))
            loss, error = flow_loss(made.float(), batch, settings.window)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            mean_gradients(network)
            norm = torch.nn.utils.clip_grad_norm_(network.parameters(), settings.clip)
            optimizer.step()
            average_weights(averaged, network, step, settings.average)

            done = step + 1
            last = done == settings.last_step
            if done % settings.log_every == 0 or last:
                row = {
                    "step": done,
                    "loss": float(loss.detach()),
                    "error": float(error),
                    "gradient": float(norm),
                }
                if not torch.isfinite(loss):
                    raise InputError(
                        f"{folder}: the loss of step {done} is {row['loss']}; lower learning_rate"
                    )
                if distributed.process_rank() == 0:
                    with (folder / "log.jsonl").open("a", encoding="utf-8") as log:
                        log.write(json.dumps({name: round(value, 6) for name, value in row.items()}) + "\n")
            if (done % settings.save_every == 0 or last) and distributed.process_rank() == 0:
                save_checkpoint(
                    path,
                    network,
                    averaged,
                    optimizer,
                    step=done,
                    steps=settings.steps,
                    window=settings.window,
                )
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
    apart = (made - torch.nan_to_num(truth)).permute(0, 2, 3, 1)[known]
    far = torch.nan_to_num(truth).permute(0, 2, 3, 1)[known].square().sum(1).sqrt()
    # no pixel at all is no loss, and not the mean of nothing
    some = max(len(apart), 1)
    loss = (apart.abs().sum(1) / (1 + far)).sum() / some
    return loss, apart.detach().square().sum(1).sqrt().sum() / some
