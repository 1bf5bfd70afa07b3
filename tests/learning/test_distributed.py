"""Training by several processes is training by one with as many times the scenes."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("safetensors")

from helpers.two_processes import run_as_two_processes, torchrun_two_processes

from dase.learning import distributed
from dase.learning.adversarial import AdversarialObjective, AdversarialSettings, PatchHash
from dase.learning.moment_matching import Moments
from dase.learning.scene_batches import Scenery, SceneSettings, middle_intensity
from dase.learning.targets import Pairs, draw_noise, simulate_counts
from dase.scenes.image_sources import open_images


def batches() -> tuple[Pairs, Pairs]:
    """Return four simulated scenes, of a threshold that wants a gradient, and four real ones."""
    looks = SceneSettings(width=48, height=48, window=0.05, samples=8, regime="mixed")
    scenery = Scenery(open_images("builtin"), looks, device="cpu", seed=1, backgrounds=4, objects=8)
    rng, generator = np.random.default_rng(0), torch.Generator().manual_seed(0)
    out = []
    for level in (0.3, 0.2):
        log = scenery.draw(rng, 4)
        grey, noise = middle_intensity(log), draw_noise(log, generator)
        counts = simulate_counts(log, torch.full_like(grey, level), 0.05, noise)
        out.append(Pairs(grey, counts, simulate_counts(log, torch.full_like(grey, 0.25), 0.05, noise)))
    return out[0], out[1]


def objectives() -> dict:
    how = PatchHash(size=16, orientations=4, coherence=1)
    return {
        "moments": Moments(device="cpu"),
        "critics": AdversarialObjective(AdversarialSettings(hash=how), device="cpu", seed=3),
    }


def part(pairs: Pairs, some: slice) -> Pairs:
    return Pairs(pairs.grey[some], pairs.counts[some], pairs.reference[some])


def steps(some: slice) -> dict:
    """Return what two steps on some of the scenes make of both objectives, and the gradients."""
    fake, real = batches()
    out = {}
    for name, objective in objectives().items():
        objective.calibrate([(fake, real)])
        gradients = []
        for _ in range(2):
            mine = part(fake, some)
            counts = mine.counts.clone().requires_grad_()
            loss, values = objective.loss(
                Pairs(mine.grey, counts, mine.reference), part(real, some), move=True
            )
            (gradient,) = torch.autograd.grad(loss, counts)
            gradients.append(distributed.gather_values(gradient))
        out[name] = {"gradients": gradients, "values": values, "state": objective.state()}
    return out


def flat(value, at=""):
    if isinstance(value, torch.Tensor):
        yield at, value.double()
    elif isinstance(value, dict):
        for key, inner in value.items():
            yield from flat(inner, f"{at}/{key}")
    elif isinstance(value, list | tuple):
        for key, inner in enumerate(value):
            yield from flat(inner, f"{at}/{key}")


@pytest.mark.slow
def test_two_processes_do_what_one_does_with_all_scenes(tmp_path):
    one = steps(slice(None))  # which compiles what both processes then load
    run_as_two_processes(str(Path(__file__)), str(tmp_path / "two.pt"))
    two = torch.load(tmp_path / "two.pt", weights_only=True)
    found, wanted = dict(flat(two)), dict(flat(one))
    assert found.keys() == wanted.keys()
    assert sum("gradients" in name for name in wanted) == 4
    for name, value in wanted.items():
        if "generator" not in name:
            size = float(value.abs().max())
            assert float((found[name] - value).abs().max()) <= 2e-4 * size + 1e-9, name


@pytest.mark.slow
def test_the_command_on_two_processes(tmp_path):
    out = tmp_path / "run"
    command = str(Path(sys.executable).parent / "dase")
    words = (command, "train", "esim", "-o", str(out), "--preset", "tiny", "--steps", "6")
    words = (*words, "--objective", "wgan", "--sequences", "8", "--size", "24x24")
    torchrun_two_processes("--no-python", *words)
    assert (out / "sensor.toml").is_file()
    assert json.loads((out / "recipe.json").read_text())["steps"] == 6
    log = (out / "log.csv").read_text().splitlines()
    assert log[-1].startswith("6,")
    run_as_two_processes(*words, "--resume")
    assert torch.load(out / "checkpoint.pt", weights_only=True)["step"] == 6


if __name__ == "__main__":
    distributed.join_processes("cpu")
    half = slice(2 * distributed.process_rank(), 2 * distributed.process_rank() + 2)
    result = steps(half)
    if distributed.process_rank() == 0:
        torch.save(result, sys.argv[1])
    distributed.leave_processes()
