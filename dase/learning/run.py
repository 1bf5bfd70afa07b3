"""A training run in a folder: log, checkpoints, resuming, stopping."""

from __future__ import annotations

import csv
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import torch

from dase.errors import InputError
from dase.files.atomic_file import replacing
from dase.learning import distributed
from dase.learning.evaluation import HeldOutScore, MapEvaluation
from dase.learning.recipe import Recipe
from dase.learning.training import Training, TrainingSettings


class RunFile(StrEnum):
    """Files in the folder of a training."""

    CHECKPOINT = "checkpoint.pt"
    RESULT = "result.pt"
    BEST = "best.pt"
    LOG = "log.csv"
    RECIPE = "recipe.json"


@dataclass(frozen=True, kw_only=True)
class RunSchedule:
    """How often what is done.

    Args:
        log_every: Steps between lines of the log.
        save_every: Time between checkpoints [s]; infinite for none, not even at the end.
        score_every: Lines of the log between scores on held-out pairs; 0 for none.
        seconds: Time the run may take [s], which sets its number of steps; None keeps the recipe's.
        timed_steps: Steps from which, and over which, the speed is measured first where `seconds` is given:
            the first steps are slower, while kernels are compiled and recorded. Where they take more than
            `first_share` of the time, it is measured then.
        first_share: See `timed_steps`.
        result_every: Time between results for the user to take meanwhile [s].
    """

    log_every: int = 50
    save_every: float = 30.0
    score_every: int = 2
    seconds: float | None = None
    timed_steps: int = 30
    first_share: float = 0.25
    result_every: float = 25.0


class TrainingDiverged(InputError):
    """Training met a number that is not finite."""


def train_in_folder(
    training: Training,
    out: Path,
    *,
    schedule: RunSchedule = RunSchedule(),
    resume: bool = False,
    on_row: Callable[[dict[str, float]], None] = lambda row: None,
    on_result: Callable[[dict[str, float]], object] = lambda row: None,
) -> dict[str, float]:
    """Train to the end, in the folder `out`; return the last line of the log.

    Args:
        training: The run.
        out: Folder, made if missing.
        schedule: How often to log, score and save.
        resume: Go on from the checkpoint in `out`.
        on_row: Called with each line of the log.
        on_result: Called now and then in the first process with what the maps of `training.mean` are, so that
            there is a result long before the end.

    Raises:
        InputError: `out` holds another run, or nothing to resume.
        TrainingDiverged: A loss or weight is not finite; the last checkpoint is good.
    """
    began = time.perf_counter()  # all that follows is part of the time the run may take
    out.mkdir(parents=True, exist_ok=True)
    path = out / RunFile.CHECKPOINT
    if resume:
        if not path.is_file():
            raise InputError(f"{out} holds no checkpoint to resume")
        training.load(load_checkpoint(path, training.device))
    elif path.exists():
        raise InputError(f"{out} already holds a run; resume it, or give another folder", argument="resume")
    _write_recipe(out, training.recipe)
    exam = MapEvaluation(training.scenery, training.target)
    pairs = training.target.held_out() if schedule.score_every else None
    held = None if pairs is None else HeldOutScore(training.scenery, pairs, physics=training.physics)
    return _RunLoop(training, out, schedule, exam, held, on_row, on_result).run_steps(began)


class _RunLoop:
    """The loop around the steps."""

    def __init__(
        self,
        training: Training,
        out: Path,
        schedule: RunSchedule,
        exam: MapEvaluation,
        held: HeldOutScore | None,
        on_row: Callable[[dict[str, float]], None],
        on_result: Callable[[dict[str, float]], object],
    ):
        self.training, self.out, self.schedule = training, out, schedule
        self.exam, self.held, self.on_row, self.on_result = exam, held, on_row, on_result
        self.broken = torch.full((), -1, device=training.device)
        self._over = False
        """Whether the time is over."""
        self._planned = False
        """Whether the first steps were so slow that the end was planned by them."""
        self.table = None if distributed.process_rank() else _LogTable(out / RunFile.LOG, training.step)

    def run_steps(self, began: float) -> dict[str, float]:
        """Train to the end; return the last line of the log. The run began at this `time.perf_counter`."""
        training, schedule = self.training, self.schedule
        timed = schedule.timed_steps
        begin = began - training.seconds
        saved = shown = time.perf_counter()
        mark = max(training.step, timed), saved
        first = training.step, time.perf_counter()
        row: dict[str, float] = {
            "step": training.step,
            "seconds": training.seconds,
        } | self.exam.describe_maps(training.mean)
        while training.step < training.recipe.steps and not self._over:
            values = training.advance()
            wrong = ~torch.isfinite(values["loss"]) & (self.broken < 0)
            self.broken = torch.where(wrong, training.step - 1, self.broken)
            if self.schedule.seconds is not None and training.step in (timed, 2 * mark[0]):
                _synchronise(training.device)
                if training.step > timed:
                    self._fit_time(*mark, begin)
                mark = training.step, time.perf_counter()
            self._keep_time(first, begin)
            last = training.step == training.recipe.steps or self._over
            if training.step % schedule.log_every == 0 or last:
                _synchronise(training.device)
                training.seconds = time.perf_counter() - begin
                row = self._log_row(values, last)
                waited = time.perf_counter() - saved > schedule.save_every
                # clocks differ, and processes must save together, since each tells its random state
                if distributed.broadcast_number(waited or (last and schedule.save_every < math.inf)):
                    save_checkpoint(self.out / RunFile.CHECKPOINT, training.state())
                    saved = time.perf_counter()
            if self.table is not None and time.perf_counter() - shown > schedule.result_every:
                self.on_result(self.exam.describe_maps(training.mean))
                shown = time.perf_counter()
        save_checkpoint(self.out / RunFile.RESULT, {"net": training.mean.state_dict(), "row": row})
        return row

    def _keep_time(self, first: tuple[int, float], begin: float) -> None:
        """End the run when its time is over, and plan its end early where steps are slow.

        Args:
            first: Step and time at which the first step began.
            begin: Of the run.
        """
        training, seconds = self.training, self.schedule.seconds
        steps = training.step - first[0]
        if seconds is None or (steps > self.schedule.timed_steps and training.step % self.schedule.log_every):
            return  # by then the end was planned by the speed; processes agree here, which takes a while
        elapsed = distributed.broadcast_number(time.perf_counter() - begin)
        if elapsed >= seconds:
            self._over = True
            training.recipe = replace(training.recipe, steps=max(training.step, 1))
            _write_recipe(self.out, training.recipe)
            return
        slow = 0 < steps < self.schedule.timed_steps and elapsed >= self.schedule.first_share * seconds
        if slow and not self._planned:
            self._fit_time(*first, begin)
            self._planned = True

    def _fit_time(self, step: int, mark: float, begin: float) -> None:
        """Set the number of steps so that the run takes the time it may, by its speed since `mark`."""
        training = self.training
        assert self.schedule.seconds is not None
        now = time.perf_counter()
        each = distributed.broadcast_number((now - mark) / (training.step - step))
        left = distributed.broadcast_number(self.schedule.seconds - (now - begin))
        steps = training.step + max(int(0.97 * left / each), 1)  # below 1 while critics warm up
        training.recipe = replace(training.recipe, steps=max(steps, 1))
        _write_recipe(self.out, training.recipe)

    def _log_row(self, values: dict[str, torch.Tensor], last: bool) -> dict[str, float]:
        """Write a line of the log, and the best network so far; return the line, empty in other processes."""
        training = self.training
        self._check_finite()
        if self.table is None:
            return {}
        row = {"step": training.step, "seconds": training.seconds}
        row |= {name: float(value) for name, value in values.items()}
        row |= {f"raw_{name}": value for name, value in self.exam.describe_maps(training.net).items()}
        row |= self.exam.describe_maps(training.mean)
        if self.held is not None and training.step > 0:
            lines = training.step // self.schedule.log_every
            if last or lines % self.schedule.score_every == 0:
                row["held_out"] = self.held.score(training.mean)
                if row["held_out"] < training.best:
                    training.best = row["held_out"]
                    save_checkpoint(self.out / RunFile.BEST, {"net": training.mean.state_dict(), "row": row})
        self.table.add(row)
        self.on_row(row)
        return row

    def _check_finite(self) -> None:
        """Raise TrainingDiverged where a number is not finite."""
        training, step = self.training, int(self.broken)
        culprit = "the loss" if step >= 0 else None
        for name, value in training.net.named_parameters():
            if not bool(torch.isfinite(value).all()):
                culprit = f"the weight '{name}'"
                break
        if culprit is None:
            return
        when = f"at step {step}" if step >= 0 else f"by step {training.step}"
        path = self.out / RunFile.CHECKPOINT
        good = f"the last good checkpoint is {path}" if path.exists() else "there is no checkpoint yet"
        raise TrainingDiverged(f"training broke {when}: {culprit} is not finite; {good}")


class _LogTable:
    """A CSV file of which every line but the last is whole, however a run ends.

    Args:
        path: File; lines after `step` of an interrupted run are dropped.
        step: Where training begins.
    """

    def __init__(self, path: Path, step: int):
        self.path = path
        self.names: list[str] = []
        self.rows: list[dict[str, str]] = []
        if not path.exists():
            return
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            # a line that was cut lacks columns
            rows = [row for row in reader if None not in row.values()]
            self.names = list(reader.fieldnames or [])
        self.rows = [row for row in rows if step > 0 and int(float(row["step"])) <= step]
        if self.rows:
            self._rewrite()
        else:
            self.names = []
            path.unlink()

    def add(self, row: dict[str, float]) -> None:
        """Append a line; columns that come later are added to the file."""
        line = {name: f"{value:.6g}" for name, value in row.items()}
        new = [name for name in row if name not in self.names]
        self.names += new
        self.rows.append(line)
        if new:
            self._rewrite()
            return
        with self.path.open("a", newline="", encoding="utf-8") as file:
            csv.DictWriter(file, self.names).writerow(line)

    def _rewrite(self) -> None:
        with replacing(self.path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, self.names)
            writer.writeheader()
            writer.writerows(self.rows)


def _write_recipe(out: Path, recipe: TrainingSettings) -> None:
    if distributed.process_rank() == 0:
        with replacing(out / RunFile.RECIPE) as temporary:
            temporary.write_text(recipe.text(), "utf-8")


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint, if this is the first process; it appears whole or not at all."""
    if distributed.process_rank():
        return
    with replacing(path) as temporary:
        torch.save(state, temporary)


def load_checkpoint(path: Path, device: torch.device | str) -> dict[str, Any]:
    """Return a checkpoint; raises InputError where it is none."""
    try:
        # random states are kept as Python objects of NumPy's
        state: dict[str, Any] = torch.load(path, map_location=device, weights_only=True)
    except Exception as error:
        raise InputError(f"{path} is not a checkpoint of a training run: {error}") from error
    return state


def read_recipe(out: Path) -> Recipe:
    """Return the recipe of the run in a folder; raises InputError where there is none."""
    path = out / RunFile.RECIPE
    if not path.is_file():
        raise InputError(f"{out} holds no training run: {RunFile.RECIPE} is missing")
    return Recipe.parse(path.read_text("utf-8"))


def _synchronise(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
