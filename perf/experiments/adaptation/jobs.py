"""Many experiments on some devices: processes that take rows in their order, as far as a device has room."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any

START = 15.0
"""Seconds that a row takes beside its training: starting, drawing textures, judging."""


@dataclass
class Task:
    """A row to be run.

    Args:
        name: Of the row.
        seconds: Training time.
        share: Of a device that it takes, in (0, 1].
    """

    name: str
    seconds: float
    share: float


@dataclass
class Worker:
    """A process that runs one row after the other on a device, and what it runs now."""

    device: str
    process: multiprocessing.process.BaseProcess
    pipe: Connection
    task: Task | None = None


Run = Callable[[str, float], dict[str, Any]]


def run_all(
    tasks: list[Task],
    make: Callable[[str], Run],
    tell: Callable[[dict[str, Any]], None],
    *,
    budget: float,
    devices: Sequence[str],
) -> None:
    """Run tasks until the budget is spent, in their order.

    A worker that dies costs its row only, and is replaced. No row is begun that would not end in time.

    Args:
        tasks: The most important first.
        make: Called in each worker with its device (so it must be a module's function); returns what runs a
            row by name and seconds and returns its line.
        tell: Called with every line, here.
        budget: Seconds in all.
        devices: Names of PyTorch devices.
    """
    end = time.perf_counter() + budget
    most = len(devices) * max((round(1 / task.share) for task in tasks), default=1)
    # set before the workers import what reads it
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 2
    os.environ["OMP_NUM_THREADS"] = str(max(cores // most, 1))
    os.environ.setdefault("DASE_THREADS", os.environ["OMP_NUM_THREADS"])
    waiting, idle, busy = list(tasks), [], []
    try:
        while waiting or busy:
            late = [t for t in waiting if time.perf_counter() + t.seconds + START > end]
            for task in late:
                waiting.remove(task)
                print(f"{task.name}: no time left", flush=True)
            # strictly in order: a row that needs a whole device is not passed by small ones for ever
            while waiting:
                device, room = _emptiest(devices, busy)
                if waiting[0].share > room + 1e-6:
                    break
                worker = next((w for w in idle if w.device == device), None) or _start(make, device)
                idle = [w for w in idle if w is not worker]
                worker.task = waiting.pop(0)
                worker.pipe.send((worker.task.name, worker.task.seconds))
                busy.append(worker)
            left = end - time.perf_counter()
            if left <= 0:
                print("cut off: " + ", ".join(w.task.name for w in busy if w.task is not None), flush=True)
                return
            ready = wait([worker.pipe for worker in busy], timeout=min(left, 60))
            for worker in [w for w in busy if w.pipe in ready]:
                busy.remove(worker)
                assert worker.task is not None
                try:
                    tell(worker.pipe.recv())
                except EOFError:
                    tell({"row": worker.task.name, "error": f"the process died: {worker.process.exitcode}"})
                    worker.process.join()
                else:
                    worker.task = None
                    idle.append(worker)
    finally:
        for worker in (*idle, *busy):
            worker.process.terminate()
            worker.process.join()


def _emptiest(devices: Sequence[str], busy: list[Worker]) -> tuple[str, float]:
    """Return the device with the most room, and how much that is."""
    room = dict.fromkeys(devices, 1.0)
    for worker in busy:
        if worker.task is not None:
            room[worker.device] -= worker.task.share
    return max(room.items(), key=lambda item: item[1])


def _start(make: Callable[[str], Run], device: str) -> Worker:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(make, device, theirs), daemon=True)
    process.start()
    theirs.close()
    return Worker(device, process, ours)


def _work(make: Callable[[str], Run], device: str, pipe: Connection) -> None:
    run = make(device)
    while True:
        name, seconds = pipe.recv()
        try:
            line = run(name, seconds)
        except Exception as error:
            line = {"row": name, "error": f"{type(error).__name__}: {error}"}
        pipe.send(line)
