"""Bias and variance of the surrogate gradients of a count, against finite differences of its mean.

    python -m perf.benchmarks.surrogates

prints the tables of docs/surrogates.md and writes that file. Takes about a minute on two CPU cores.
"""

from __future__ import annotations

import math
import platform
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from dase.kernels.autograd_counts import FLOOR, STEP, SURROGATE, Surrogate, count_events

MU, SIGMA = 0.2, 0.05  # thresholds of the paper's synthetic experiment [log intensity]
SAMPLES = (8, 32, 128)
PIXELS, SEEDS, CHUNK = 128, 4096, 256
DELTA = 0.0025  # half step of the true derivative [log intensity]
NODES = 8  # bins of the quadrature
LIMIT = 3.0  # of |z|: the floor of the thresholds is measured on its own

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"

# samples (B, K, N), z (B, N), phase (B, N) to gradients (objectives, 2, B, N), by mu and by sigma
Estimate = Callable[[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor]
Moments = dict[str, tuple[np.ndarray, np.ndarray]]

OBJECTIVES: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
    "E[N]": lambda counts: counts.sum((1, 2)),
    "E[N²]": lambda counts: counts.square().sum((1, 2)),
}


TEXT = """# Surrogate gradients of a count

`count_events` counts exactly, and a count is a floor: its derivative is zero or undefined. Something must
stand in for it. This page defines the three candidates, measures them, and says which one is the default.
`perf/benchmarks/surrogates.py` writes it; edit the text there.

## Definitions

θ is the threshold of a pixel, N the events of one polarity in a window, s_k the samples of log intensity.

- `interval`: the floor of the paper's Equation 7 passed straight through, in every interval in which an
  event falls: ∂N_k/∂θ = -|s_k - s_(k-1)|/θ², elsewhere 0. Both polarities have this sign.
- `events`: ∂N/∂θ = -N/θ, the derivative of N = |change|/θ.
- `expected`: ∂N/∂θ = (N(θ e^h) - N(θ e^-h)) / (2 θ sinh h), both counts exact, from the same samples, with
  the phase at the same fraction of the threshold; h = {step} unless told. The denominator makes N ∝ 1/θ
  exact. Where ON and OFF have thresholds of their own, each is moved alone, and both counts answer: an OFF
  event moves the reference from which the next ON event is measured.

By the chain rule ∂θ/∂μ = 1 and ∂θ/∂σ = z at the noise z that was drawn.

The smoothing of `expected` is h in the logarithm of θ whatever σ is; no σ is too small for it. But where
the phase is fixed (the default, 0) and σ is below about hμ, the count of a single pixel is a staircase in μ
that it smooths over ±{step}θ: right on average over pixels, not for each. A random phase removes the
staircase.

## Which one

**`{default}` is the default.** Its bias is below 1.5 % for every signal and time sampling, in both
parameters, for the mean count and for the mean square count; its standard deviation is at most 40 % above
that of `events`. `interval` loses most of the gradient as time is sampled more finely, since it sees the
change of one interval instead of the change since the last event. `events` is short by 6 to 23 %, depending
on the signal, as it does not see the changes that have not yet made an event; it is the cheapest, as it
reads no samples.

Each cell: relative bias / standard deviation of the gradient of one pixel at one seed, in units of the root
mean square over pixels of the true gradient. N is summed over both polarities, N² is the sum of both
squares. The three signals are pooled.

{pooled}

## How it was measured

    python -m perf.benchmarks.surrogates

Made with {made}.

θ ~ N({mu}, {sigma}), |z| < {limit:g}, phase uniform in (-1, 1) thresholds. Three signals of {pixels} pixels
each, the same smooth functions of time at 8, 32 and 128 samples: a ramp (change 0.2 to 1.2), an oscillation
(amplitude 0.1 to 0.6, 1 to 2 periods), a texture with edges moving past (log of 0.1 to 1). {seeds} seeds of
z and phase, stratified in z; generators 0 (signals) and 1 (noise). Truth: central differences, half step
{delta}, of the mean over the seeds at the same noise. The mean square count stands for a loss that is not
linear in the counts, as a critic's is.

Signal by signal:

{single}

## The clip at 0.01

Without the limit on z, at 8 samples, one sample in 14 000 falls under the floor of 0.01. There
`count_events` passes no gradient, as is right for max(·, 0.01), unless μ itself is below the floor: then it
passes what would raise θ, so that no pixel is stuck. Passing that for every sample under the floor adds
bias and doubles the noise: the slope there is 1/0.01² where 1/0.2² is usual, 400 times as much. What noise
remains comes from thresholds just above the floor, and belongs to N({mu}, {sigma}). (The last column's bias
is partly the truth's: far in the tail its step times z is as large as the thresholds.)

{clip}

## What failed

- **Quadrature over the distribution.** ∂E[N]/∂μ and ∂E[N]/∂σ integrated over {nodes} bins of z (the chord
  of the counts over each bin times its probability), the same for every z that could have been drawn. Ten
  times less noise, and 3 to 6 % of bias, in the mean count. But a loss that is not linear in the counts
  needs the derivative of the sample that it saw: averaged, the derivative forgets z, and half of ∂E[N²]/∂σ
  is gone. As σ is learned from the spread of the counts and from nothing else, this is the wrong half.
- **The same with score weights** ((z, z² - 1)/σ times the counts at the middles of {nodes} bins of equal
  probability): 20 % of ∂E[N]/∂μ and 61 % of ∂E[N]/∂σ lost, since N ∝ 1/θ bends inside the outer bins.
  Replaced by the chords above.
- **A smaller step**, h = 0.05: the same bias, a third more noise. A larger one, h = 0.2: a tenth less noise
  here, but a fixed phase with a small σ is smoothed twice as far.
- **Straight through wherever it raises θ**: the section on the clip.
"""


def ramp(t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return steady changes of 0.2 to 1.2, of either sign, shape (K, PIXELS) [log intensity]."""
    log: np.ndarray = rng.uniform(0.2, 1.2, PIXELS) * rng.choice([-1, 1], PIXELS) * t
    return log


def oscillation(t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return sines of amplitude 0.1 to 0.6 and 1 to 2 periods, shape (K, PIXELS) [log intensity]."""
    angle = 2 * np.pi * (rng.uniform(1, 2, PIXELS) * t + rng.uniform(0, 1, PIXELS))
    log: np.ndarray = rng.uniform(0.1, 0.6, PIXELS) * np.sin(angle)
    return log


def texture(t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a texture with edges that moves past, shape (K, PIXELS) [log intensity]."""
    place = rng.uniform(0, 1, PIXELS) + rng.uniform(0.02, 0.15, PIXELS) * t
    waves = sum(np.sin(2 * np.pi * (f * place + rng.uniform())) / math.sqrt(f) for f in range(1, 13))
    log: np.ndarray = np.log(0.55 + 0.45 * np.tanh(1.5 * waves))
    return log


SIGNALS = {"ramp": ramp, "oscillation": oscillation, "texture": texture}


def draw(chunk: int, limit: float, rng: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Return z in ±limit, stratified over all seeds, and the phase of one chunk of them, both (CHUNK, N)."""
    place = np.arange(CHUNK)[:, None] * (SEEDS // CHUNK) + chunk + rng.uniform(size=(CHUNK, PIXELS))
    tail = math.erfc(limit / math.sqrt(2)) / 2
    z = torch.special.ndtri(torch.from_numpy(tail + (1 - 2 * tail) * place / SEEDS))
    phase = torch.from_numpy(rng.uniform(-1, 1, (CHUNK, PIXELS)))
    return z.float().to(DEVICE), phase.float().to(DEVICE)


def truth(log: torch.Tensor, z: torch.Tensor, phase: torch.Tensor) -> torch.Tensor:
    """Return central differences of the objectives at the same noise."""

    def at(mu: float, sigma: float) -> torch.Tensor:
        counts = count_events(log, torch.full_like(z, mu), sigma, z, phase=phase)
        return torch.stack([f(counts) for f in OBJECTIVES.values()])

    by_mu = at(MU + DELTA, SIGMA) - at(MU - DELTA, SIGMA)
    by_sigma = at(MU, SIGMA + DELTA) - at(MU, SIGMA - DELTA)
    return torch.stack([by_mu, by_sigma], 1) / (2 * DELTA)


def surrogate(name: Surrogate, step: float = STEP) -> Estimate:
    """Return the gradients that `count_events` passes."""

    def estimate(log: torch.Tensor, z: torch.Tensor, phase: torch.Tensor) -> torch.Tensor:
        mu = torch.full_like(z, MU, requires_grad=True)
        sigma = torch.full_like(z, SIGMA, requires_grad=True)
        counts = count_events(log, mu, sigma, z, phase=phase, surrogate=name, step=step)
        losses = [f(counts).sum() for f in OBJECTIVES.values()]
        return torch.stack(
            [torch.stack(torch.autograd.grad(loss, (mu, sigma), retain_graph=True)) for loss in losses]
        )

    return estimate


def quadrature(log: torch.Tensor, z: torch.Tensor, phase: torch.Tensor) -> torch.Tensor:
    """Return the derivatives of the mean counts, integrated over NODES bins of z, times the objective's.

    The derivative is the chord of a bin, weighted by the probability of the bin: an integral by parts.
    """
    counts = count_events(log, torch.full_like(z, MU), SIGMA, z, phase=phase).requires_grad_()
    weights = [torch.autograd.grad(f(counts).sum(), counts)[0] for f in OBJECTIVES.values()]
    edges = torch.linspace(-LIMIT, LIMIT, NODES + 1, dtype=torch.float64)
    probability = torch.special.ndtr(edges).diff()
    density = torch.exp(-(edges**2) / 2) / math.sqrt(2 * math.pi)
    total = probability.sum()
    by_mu, by_sigma = probability / total, -density.diff() / total  # P and the integral of z over the bin
    nodes = [
        count_events(log, torch.full_like(z, MU + SIGMA * edge), 0.0, 0.0, phase=phase)
        for edge in edges.tolist()
    ]
    out = torch.zeros(len(weights), 2, *z.shape, device=z.device)
    width = SIGMA * (edges[1] - edges[0]).item()
    for q in range(NODES):
        chord = (nodes[q + 1] - nodes[q]) / width
        for o, weight in enumerate(weights):
            share = (weight * chord).sum((1, 2))
            out[o, 0] += by_mu[q].item() * share
            out[o, 1] += by_sigma[q].item() * share
    return out


def straight_through(log: torch.Tensor, z: torch.Tensor, phase: torch.Tensor) -> torch.Tensor:
    """Return the gradients of the default, the clip straight through wherever that raises thresholds."""
    raw = MU + SIGMA * z
    theta = raw.clamp_min(FLOOR).requires_grad_()
    counts = count_events(log, theta, 0.0, 0.0, phase=phase)
    out = []
    for f in OBJECTIVES.values():
        (slope,) = torch.autograd.grad(f(counts).sum(), theta, retain_graph=True)
        slope = slope * ((raw >= FLOOR) | (slope < 0))
        out.append(torch.stack([slope, z * slope]))
    return torch.stack(out)


ESTIMATES: dict[str, Estimate] = {
    "`interval`": surrogate("interval"),
    "`events`": surrogate("events"),
    "`expected`": surrogate("expected"),
    "`expected`, h = 0.05": surrogate("expected", 0.05),
    "`expected`, h = 0.2": surrogate("expected", 0.2),
    f"dropped: quadrature, {NODES} bins": quadrature,
}

CLIPS: dict[str, Estimate] = {
    "as built": surrogate("expected"),
    "straight through wherever it raises": straight_through,
}


def measure(kind: str, samples: int, estimates: dict[str, Estimate], limit: float) -> Moments:
    """Return mean and variance over the seeds, each (objectives, 2, N), of the truth and every estimate."""
    log = SIGNALS[kind](np.linspace(0, 1, samples)[:, None], np.random.default_rng(0))
    batch = torch.tensor(log, dtype=torch.float32, device=DEVICE).repeat(CHUNK, 1, 1)
    rng = np.random.default_rng(1)
    sums: dict[str, torch.Tensor] = {}
    for chunk in range(SEEDS // CHUNK):
        z, phase = draw(chunk, limit, rng)
        for name, estimate in {"truth": truth, **estimates}.items():
            value = estimate(batch, z, phase).double()
            both = torch.stack([value.sum(2), value.square().sum(2)])
            sums[name] = sums[name] + both if name in sums else both
    moments = {name: (both / SEEDS).cpu().numpy() for name, both in sums.items()}
    return {name: (mean, square - mean**2) for name, (mean, square) in moments.items()}


def judge(results: list[Moments], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return bias [%] and standard deviation of one seed's gradient, both relative, each (objectives, 2)."""
    true = np.concatenate([r["truth"][0] for r in results], -1)
    mean = np.concatenate([r[name][0] for r in results], -1)
    variance = np.concatenate([r[name][1] for r in results], -1)
    bias = 100 * (mean.sum(-1) / true.sum(-1) - 1)
    return bias, np.sqrt(variance.mean(-1) / (true**2).mean(-1))


def row(head: list[str], results: list[Moments], name: str) -> str:
    """Return one line of a table: bias % / standard deviation for every objective and parameter."""
    bias, deviation = (a.ravel() for a in judge(results, name))
    cells = [f"{b:+.1f} % / {d:.2f}" for b, d in zip(bias, deviation, strict=True)]
    return "| " + " | ".join([*head, *cells]) + " |"


def table(head: list[str], rows: list[str]) -> str:
    """Return a markdown table whose last columns are the objectives by mu and by sigma."""
    names = [*head, *(f"∂{o}/∂{p}" for o in OBJECTIVES for p in ("μ", "σ"))]
    return "\n".join(["| " + " | ".join(names) + " |", "|" + "---|" * len(names), *rows])


def tables() -> dict[str, str]:
    """Return the three tables of the document."""
    results = {(kind, k): measure(kind, k, ESTIMATES, LIMIT) for kind in SIGNALS for k in SAMPLES}
    pooled = [row([n, str(k)], [results[s, k] for s in SIGNALS], n) for n in ESTIMATES for k in SAMPLES]
    single = [
        row([s, n, str(k)], [results[s, k]], n) for s in SIGNALS for n in list(ESTIMATES)[:3] for k in SAMPLES
    ]
    clip = [measure(kind, SAMPLES[0], CLIPS, 8.0) for kind in SIGNALS]
    return {
        "pooled": table(["gradient", "samples"], pooled),
        "single": table(["signal", "gradient", "samples"], single),
        "clip": table(["clip"], [row([n], clip, n) for n in CLIPS]),
    }


def provenance(seconds: float) -> str:
    """Return where and how the numbers were made."""
    root = Path(__file__).parents[2]
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=root, capture_output=True, text=True, check=False
    ).stdout.strip()
    name = torch.cuda.get_device_name() if DEVICE == "cuda" else f"{platform.machine()} CPU"
    return f"{name}, PyTorch {torch.__version__}, on commit {commit or 'unknown'}, {seconds:.0f} s"


def main() -> None:
    """Measure, print, and write docs/surrogates.md."""
    start = time.perf_counter()
    parts = tables()
    for part in parts.values():
        print(part, end="\n\n")
    values = dict(
        mu=MU,
        sigma=SIGMA,
        limit=LIMIT,
        pixels=PIXELS,
        seeds=SEEDS,
        delta=DELTA,
        nodes=NODES,
        default=SURROGATE,
        step=STEP,
        made=provenance(time.perf_counter() - start),
    )
    folder = Path(__file__).parents[2] / "docs"
    folder.mkdir(exist_ok=True)
    (folder / "surrogates.md").write_text(TEXT.format(**values, **parts), encoding="utf-8")


if __name__ == "__main__":
    main()
