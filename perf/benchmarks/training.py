"""How fast learning is, part by part, and how near a critic step is to what memory allows.

Each part is timed alone; on a GPU as it runs in a step, from a recording, so that its launches cost nothing.

    python -m perf.benchmarks.training                    the study's size: 12 scenes of 240x240, 24 samples
    python -m perf.benchmarks.training --small            for a CPU
    python -m perf.benchmarks.training --out out/training.json

The bound of a critic step is the memory traffic that it cannot do without, `CriticBank.traffic`, at the rate
of a copy on the same device, measured in the same run. In turns with it two naive banks are timed, see
`perf/benchmarks/naive_critic_bank.py`.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import subprocess
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dase.kernels import autograd_critics as bridge
from dase.learning.adversarial import (
    AdversarialObjective,
    AdversarialSettings,
    PatchHash,
    critic_maps,
    cut_patches,
)
from dase.learning.critic_bank import BankShape, CriticBank, CriticBatch, _has_grouped_products
from dase.learning.cuda_graph import GraphReplay
from dase.learning.job import compose_training
from dase.learning.moment_objective import MomentObjective
from dase.learning.recipe import Recipe
from dase.learning.scene_batches import Scenery, SceneSettings, middle_intensity, send_words
from dase.learning.targets import (
    TRUTHS,
    EndlessTarget,
    Pairs,
    draw_noise,
    simulate_counts,
    vary_parameters,
    vary_thresholds,
)
from dase.learning.training import Training
from dase.networks.threshold_network import NetworkShape
from dase.scenes import image_sources
from perf.benchmarks import naive_critic_bank
from perf.data_folder import default_images

ROOT = Path(__file__).resolve().parents[2]


class Clock:
    """Times calls on a device, waiting for it before and after.

    Args:
        device: What to wait for.
        repeats: Of a measurement.
        generators: Random numbers that calls draw on the device.
    """

    def __init__(self, device: torch.device, repeats: int, generators: Sequence[torch.Generator] = ()):
        self.device, self.repeats, self.generators = device, repeats, generators

    def wait(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)

    def recorded(self, work: Callable[[], Any]) -> float:
        """Return the median time [s] of what `work` does on the device."""
        replay = GraphReplay(self.device, self.generators)
        return self(lambda: replay("all", work), inner=5)

    def __call__(self, work: Callable[[], Any], *, inner: int = 1) -> float:
        """Return the median time of `work` [s], called `inner` times between two looks at the clock."""
        return self.in_turns({"": work}, inner=inner)[""]

    def in_turns(self, works: dict[str, Callable[[], Any]], *, inner: int = 1) -> dict[str, float]:
        """Return the median times of some works [s], each measured once before any is again."""
        for work in works.values():
            for _ in range(5):
                work()
        times: dict[str, list[float]] = {name: [] for name in works}
        for _ in range(self.repeats):
            for name, work in works.items():
                self.wait()
                begin = time.perf_counter()
                for _ in range(inner):
                    work()
                self.wait()
                times[name].append((time.perf_counter() - begin) / inner)
        return {name: statistics.median(each) for name, each in times.items()}


def copy_rate(clock: Clock, size: int) -> float:
    """Return the bytes per second, read and written, of a copy of `size` bytes."""
    a = torch.zeros(size // 4, device=clock.device)
    b = torch.empty_like(a)
    return 2 * size / clock(lambda: b.copy_(a), inner=5)


def make(args: argparse.Namespace, objective: str) -> Training:
    """Return a run at the size to be measured, some steps old."""
    looks = SceneSettings(regime="mixed", **(dict(width=96, height=96, samples=12) if args.small else {}))
    scenery = Scenery(image_sources.open_images(args.images), looks, device=args.device)
    how = PatchHash(size=16, orientations=8, coherence=1) if args.small else PatchHash()
    network = NetworkShape(channels=8, depth=2) if args.small else NetworkShape()
    if objective == "moments":
        network = NetworkShape(**{**network.__dict__, "table": (6, 5)})
    batch = 4 if args.small else 12
    critics = AdversarialSettings(hash=how)
    recipe = Recipe(
        objective=objective, batch=batch, adversarial=critics, network=network, warmup=2, steps=10**6
    )
    training = compose_training(recipe, EndlessTarget(scenery, TRUTHS["uniform"]()), scenery)
    for _ in range(30):
        training.advance()
    return training


def iterations(training: Training, clock: Clock) -> dict[str, float]:
    """Return the time of a whole step and what the parts of it take, each measured alone [s]."""
    recipe, scenery, target = training.recipe, training.scenery, training.target
    # moments are weighed anew every 25 steps
    out = {"iteration": clock(training.advance, inner=25)}
    numbers = scenery.draw_numbers(training.scenes, recipe.batch)
    words, reals = (
        send_words(n, clock.device) for n in (numbers, target.draw_numbers(training.reals, recipe.batch))
    )
    out["host: draw scenes"] = clock(lambda: training._draw_inputs(0.0))
    log = scenery.render(words, recipe.batch)
    grey, noise = middle_intensity(log), draw_noise(log, training.generator)
    out["render fake"] = clock.recorded(lambda: scenery.render(words, recipe.batch))
    out["draw real"] = clock.recorded(lambda: target.pairs(reals, recipe.batch))
    out["network forward"] = clock.recorded(lambda: training.net(grey))
    weight = torch.randn_like(grey)

    def both() -> None:
        training.net.zero_grad(set_to_none=True)
        (training.net(grey).mu * weight).sum().backward()

    out["network backward"] = clock.recorded(both) - out["network forward"]
    maps = training.net(grey)
    mu, sigma = maps.mu.detach().requires_grad_(), maps.sigma.detach().requires_grad_()
    out["count"] = clock.recorded(lambda: simulate_counts(log, mu.detach(), sigma.detach(), noise))

    def gradient() -> None:
        mu.grad = sigma.grad = None
        simulate_counts(log, mu, sigma, noise).sum().backward()

    out["count gradient"] = clock.recorded(gradient) - out["count"]
    if recipe.objective == "moments":
        out["count anew for derivatives"] = clock.recorded(
            lambda: (
                vary_thresholds(log, mu, sigma, noise),
                vary_parameters(log, mu.detach(), sigma.detach(), noise),
            )
        )
        out |= _moments(training, clock)
    else:
        out |= _critics(training, clock)
    learn = torch.zeros((), device=clock.device)
    out["optimiser"] = clock.recorded(lambda: (training.optimizer.step(), training._average_weights(learn)))
    return out


def _scenes(training: Training) -> torch.Tensor:
    """Return words that draw the scenes of a step."""
    return send_words(training.scenery.draw_numbers(training.scenes, training.recipe.batch), training.device)


def _moments(training: Training, clock: Clock) -> dict[str, float]:
    fake, _ = training.simulate_fake(_scenes(training))
    real = training.target.draw(training.reals, training.recipe.batch)
    objective = training.objective
    assert isinstance(objective, MomentObjective)
    newton = objective.newton
    while objective.begin_step() is None:
        pass
    return {
        "moments": clock.recorded(lambda: objective.moments.loss(fake, real, move=True)),
        "newton": clock.recorded(lambda: (newton.add_answers(fake), newton.step(0.0))),
    }


def _critics(training: Training, clock: Clock) -> dict[str, float]:
    objective = training.objective
    assert isinstance(objective, AdversarialObjective)
    fake, _ = training.simulate_fake(_scenes(training))
    fake = Pairs(fake.grey, fake.counts.detach())
    real = training.target.draw(training.reals, training.recipe.batch)
    size = objective.hasher.how.size
    patches, others = (cut_patches(critic_maps(p.counts), size) for p in (fake, real))
    ours, theirs = objective.hasher.classes(fake), objective.hasher.classes(real)
    weights = objective.weights()
    bank = objective.bank
    share = torch.rand(len(patches), 1, device=clock.device)
    rate = torch.tensor(1e-9, device=clock.device)

    def sort() -> CriticBatch:
        return CriticBatch(bank, patches, ours, others, theirs, weights, share)

    batch = sort()
    rows, layout = batch.rows.clone(), batch.layout

    def differentiate() -> None:
        batch.rows.copy_(rows)
        batch.differentiate(1.0)

    parts = {
        "bank: sort and gather": clock.recorded(sort),
        "bank: forward": clock.recorded(lambda: bank._forward(rows, layout.of, layout.end[0])),
        "bank: forward, gradients": clock.recorded(differentiate),
        "bank step": clock.recorded(lambda: bank.step(patches, ours, others, theirs, weights, rate=rate)),
    }
    penalty = parts.pop("bank: forward, gradients") - parts["bank: forward"]
    step = parts.pop("bank step")
    return parts | {
        "bank: gradients, penalty": penalty,
        "bank: optimiser": step - penalty - sum(parts.values()),
        "bank: input gradient": clock.recorded(lambda: bank.input_gradient(patches, ours, weights)),
        "hash, both sides": 2 * clock.recorded(lambda: objective.hasher.classes(fake)),
        "maps and patches": clock.recorded(lambda: cut_patches(critic_maps(fake.counts), size)),
    }


GROUPS = {
    "render": ("render fake", "draw real"),
    "UNet": ("network forward", "network backward"),
    "counts": ("count", "count gradient", "count anew for derivatives"),
    "bank": ("bank: sort and gather", "bank: forward", "bank: input gradient"),
    "penalty": ("bank: gradients, penalty",),
    "moments": ("moments", "newton"),
    "optimisers": ("optimiser", "bank: optimiser"),
    "hash": ("hash, both sides", "maps and patches"),
}
"""Parts of a step under the names that are reported."""


def shares(parts: dict[str, float]) -> dict[str, float]:
    """Return the time of each group [s]."""
    sums = {name: sum(parts.get(part, 0.0) for part in group) for name, group in GROUPS.items()}
    return {name: value for name, value in sums.items() if value}


def host(training: Training, clock: Clock, steps: int = 20) -> dict[str, float]:
    """Return the processor time of a step in Python's thread [s], and how often a step waits for the GPU."""
    begin = time.thread_time()
    for _ in range(steps):
        training.advance()
    out = {"host_seconds": (time.thread_time() - begin) / steps}
    clock.wait()
    if clock.device.type == "cuda":
        torch.cuda.set_sync_debug_mode("warn")
        with warnings.catch_warnings(record=True) as seen:
            warnings.simplefilter("always")
            training.advance()
        torch.cuda.set_sync_debug_mode("default")
        out["waits"] = len(seen)
        for text in sorted({f"{w.filename}:{w.lineno}" for w in seen}):
            print(f"  waits for the GPU at {text}")
    return out


def kernels(training: Training, steps: int = 5) -> None:
    """Print what runs on the GPU in a step, the longest first."""
    from torch.autograd import DeviceType
    from torch.profiler import ProfilerActivity, profile

    with profile(activities=[ProfilerActivity.CUDA]) as seen:
        for _ in range(steps):
            training.advance()
        torch.cuda.synchronize()
    spent: dict[str, list[float]] = {}
    for event in seen.events():
        if event.device_type != DeviceType.CUDA:
            continue
        spent.setdefault(event.name, []).append(event.time_range.elapsed_us())
    total = sum(map(sum, spent.values())) / steps / 1e3
    number = sum(map(len, spent.values())) / steps
    print(f"  the GPU is busy for {total:.2f} ms per step, {number:.0f} kernels and copies; the longest:")
    for name, each in sorted(spent.items(), key=lambda item: -sum(item[1]))[:14]:
        print(f"    {sum(each) / steps / 1e3:7.3f} ms {len(each) / steps:6.1f} x {name[:90]}")


def bank(args: argparse.Namespace, clock: Clock, rate: float, patches: int) -> dict[str, Any]:
    """Return how a critic step on evenly spread classes compares with its bound, and with naive banks."""
    shape = BankShape(classes=24, inputs=1024) if args.small else BankShape(classes=216)
    generator = torch.Generator(args.device).manual_seed(0)
    made = CriticBank(shape, device=args.device, generator=generator)
    rng = np.random.default_rng(0)
    classes = [torch.from_numpy(rng.integers(0, shape.classes, patches)).to(args.device) for _ in range(2)]
    rows = [torch.rand(patches, shape.inputs, device=args.device) for _ in range(2)]
    weights = torch.full((shape.classes,), 1 / shape.classes, device=args.device)
    active = len(set(classes[0].tolist()) & set(classes[1].tolist()))

    def step() -> Any:
        return made.step(rows[0], classes[0], rows[1], classes[1], weights, rate=1e-9, generator=generator)

    seconds = Clock(clock.device, clock.repeats, [generator]).recorded(step)
    replay = GraphReplay(clock.device, [generator])
    given = naive_critic_bank.Patches(rows[0], classes[0], rows[1], classes[1], weights)
    naive = naive_critic_bank.compare(made, given, lambda: replay("all", step), step, clock)
    bound = made.least_traffic(active) / rate
    end = torch.arange(1, shape.classes + 1, dtype=torch.int32, device=args.device) * (
        3 * patches // shape.classes
    )
    left = torch.rand(3 * patches, shape.wide, device=args.device)
    right = torch.rand(3 * patches, shape.inputs, device=args.device).to(made.working)
    rates, correction = (torch.full((shape.classes,), v, device=args.device) for v in (1e-9, 1.0))
    update = clock.recorded(
        lambda: bridge.move_critics(
            made.w1, made.square["w1"], made.copies["w1"], left, right, end, rates, correction, decay=0.9
        )
    )
    moved = shape.classes * shape.wide * shape.inputs * 18
    if clock.device.type == "cuda":
        print(f"grouped products in one launch: {_has_grouped_products(clock.device)}")
    return {
        "patches": patches,
        "active": active,
        "seconds": seconds,
        "bound": bound,
        "share_of_bound": bound / seconds,
        "update_seconds": update,
        "update_share": moved / rate / update,
        "naive": naive,
    }


def provenance(device: str, commit: str | None) -> dict[str, str]:
    name = torch.cuda.get_device_name() if device.startswith("cuda") else f"{platform.machine()} CPU"
    command = ["git", "rev-parse", "--short", "HEAD"]
    found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False).stdout.strip()
    return {"device": name, "commit": commit or found or "unknown", "torch": torch.__version__}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--images", default=default_images())
    parser.add_argument("--small", action="store_true")
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--commit")
    args = parser.parse_args()
    clock = Clock(torch.device(args.device), args.repeats)
    rate = copy_rate(clock, 1 << (26 if args.small else 31))
    found: dict[str, Any] = provenance(args.device, args.commit) | {"copy_rate": rate}
    print(f"{found['device']}, PyTorch {found['torch']}: a copy moves {rate / 1e12:.3f} TB/s")
    faults: list[str] = []
    for patches in (64,) if args.small else (432, 1728):
        line = bank(args, clock, rate, patches)
        found[f"bank_{patches}"] = line
        print(
            f"critic step on {patches} + {patches} patches: {1e3 * line['seconds']:.2f} ms, bound "
            f"{1e3 * line['bound']:.2f} ms: {100 * line['share_of_bound']:.0f} %; its update alone "
            f"{1e3 * line['update_seconds']:.2f} ms: {100 * line['update_share']:.0f} %"
        )
        print(naive_critic_bank.told(line["naive"], line["bound"]))
        faults += naive_critic_bank.faults(line["naive"])
    for objective in ("wgan", "moments"):
        training = make(args, objective)
        clock.generators = training.generators()
        parts = iterations(training, clock)
        whole = parts["iteration"]
        parts |= host(training, clock)
        found[objective] = parts | {"shares": shares(parts)}
        print(f"{objective}: {1e3 * whole:.2f} ms per iteration, {1 / whole:.1f} steps/s")
        print(
            f"  Python's thread works {1e3 * parts['host_seconds']:.2f} ms per step, meanwhile; "
            f"{1e3 * parts['host: draw scenes']:.2f} ms of it draw scenes"
        )
        if "waits" in parts:
            print(f"  a step waits for the GPU {parts['waits']} times")
        for name, seconds in found[objective]["shares"].items():
            print(f"  {name:28s} {1e3 * seconds:8.2f} ms  {100 * seconds / whole:4.0f} %")
            for part in GROUPS[name]:
                if part in parts and len(GROUPS[name]) > 1:
                    print(f"      {part:24s} {1e3 * parts[part]:8.2f} ms")
        if clock.device.type == "cuda":
            kernels(training)
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(json.dumps(found, indent=1), encoding="utf-8")
    if faults:
        raise SystemExit("\n".join(faults))


if __name__ == "__main__":
    main()
