"""Several processes that train one model together, as `torchrun` starts them.

Each draws scenes of its own. What an objective knows of scenes is put together from all processes, so that a
step is that of one process with as many times the scenes, and critics are shared out by class. In a process
that is alone nothing here does anything.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any

import torch
import torch.distributed as dist


def join_processes(backend: str) -> str:
    """Meet the other processes that the environment names; return the device of this one.

    Args:
        backend: `cpu`, or `cuda` for one GPU per process.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) < 2:
        return backend
    if backend == "cuda":
        backend = f"cuda:{os.environ['LOCAL_RANK']}"
        torch.cuda.set_device(backend)
    dist.init_process_group("nccl" if backend.startswith("cuda") else "gloo")
    return backend


def leave_processes() -> None:
    """Part from the other processes."""
    if dist.is_initialized():
        dist.barrier()
        dist.destroy_process_group()


def process_count() -> int:
    """Return how many processes there are."""
    return dist.get_world_size() if dist.is_initialized() else 1


def process_rank() -> int:
    """Return which of the processes this is, from 0."""
    return dist.get_rank() if dist.is_initialized() else 0


def gather_values(values: torch.Tensor) -> torch.Tensor:
    """Return the values of all processes, those of the first in front; (N, ...) becomes (size · N, ...).

    Gradients reach the process's own values alone; summed over the processes they are those of all.
    """
    if process_count() == 1:
        return values
    parts = [torch.empty_like(values) for _ in range(process_count())]
    dist.all_gather(parts, values.detach().contiguous())
    parts[process_rank()] = values
    return torch.cat(parts)


def sum_over_processes(values: torch.Tensor) -> torch.Tensor:
    """Return the sum over the processes, of the shape of `values`."""
    if process_count() == 1:
        return values
    out = values.detach().clone()
    dist.all_reduce(out)
    return out


def sum_gradients(parameters: Iterable[torch.Tensor]) -> None:
    """Replace the gradients of parameters, of any shape, by their sums over the processes, in one message."""
    if process_count() == 1:
        return
    found = [p.grad for p in parameters if p.grad is not None]
    whole = sum_over_processes(torch.cat([g.flatten() for g in found]))
    for gradient, part in zip(found, whole.split([g.numel() for g in found]), strict=True):
        gradient.copy_(part.view_as(gradient))


def broadcast_tensors(values: Iterable[torch.Tensor]) -> None:
    """Give tensors of any shape the values that they have in the first process, in place."""
    if process_count() > 1:
        for value in values:
            dist.broadcast(value.detach(), 0)


def broadcast_number(value: float) -> float:
    """Return the first process's number."""
    if process_count() == 1:
        return value
    told = [value]
    dist.broadcast_object_list(told, 0)
    return told[0]


def gather_objects(value: Any) -> list[Any]:
    """Return an object of each process."""
    if process_count() == 1:
        return [value]
    told: list[Any] = [None] * process_count()
    dist.all_gather_object(told, value)
    return told


def mask_foreign_classes(classes: torch.Tensor, count: int) -> torch.Tensor:
    """Return classes, those of other processes' critics replaced by none.

    Args:
        classes: Class of each patch, int64 (N,); class c is that of process c modulo `process_count()`.
        count: Number of classes, which stands for none.
    """
    if process_count() == 1:
        return classes
    return torch.where(classes % process_count() == process_rank(), classes, count)


def gather_from_owners(values: torch.Tensor) -> torch.Tensor:
    """Return tensors of all classes (C, ...), each class from the process that looks after it."""
    if process_count() == 1:
        return values
    place = torch.arange(len(values), device=values.device) % process_count() == process_rank()
    return sum_over_processes(torch.where(place.view(-1, *[1] * (values.ndim - 1)), values, 0))
