"""The experiments of docs/adaptation.md by their names, and the order in which they are worth GPU time."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace
from typing import Any


@dataclass(frozen=True)
class Row:
    """One experiment.

    Args:
        truth: Name of the sensor to be learned.
        finite: Sequences of real data, recorded once; 0 for new ones in every step.
        disjoint: Whether real scenes have textures that simulated ones have not.
        textures: Backgrounds in the pool, of which disjoint sides get a half each.
        augment: Whether finite data is mirrored and turned.
        recipe: What differs from the default recipe.
        hash: What differs from the default hash.
        network: What differs from the default network.
        real: Whether the target is the recording: 8 s to learn from, what follows to judge by.
        judged: What is judged on what follows: `adapted`, or baselines, for which nothing is learned.
    """

    truth: str = "uniform"
    finite: int = 0
    disjoint: bool = False
    textures: int = 48
    augment: bool = True
    recipe: dict[str, Any] = field(default_factory=dict)
    hash: dict[str, Any] = field(default_factory=dict)
    network: dict[str, Any] = field(default_factory=dict)
    real: bool = False
    judged: tuple[str, ...] = ("adapted",)

    def but(self, **changes: Any) -> Row:
        """Return the row with some options changed, dictionaries merged."""
        merged = {
            name: {**getattr(self, name), **value} if isinstance(value, dict) else value
            for name, value in changes.items()
        }
        return replace(self, **merged)


FULL = Row()
"""The paper's hash and its patches of 40 px."""

SMALL = FULL.but(hash=dict(size=8))
"""The same with patches of the size that learns best."""

STEADY = dict(critic_steps=2)
"""Critics that keep up with the generator, which wanders less, for longer runs."""

DRAWS = range(6)
"""Seeds of rows with finite data, each with textures of its own: chance is in the draw of those."""

BASELINES = ("esim", "rate", "random")
"""What a learned sensor is compared with, see `dase.learning.job.make_baseline`."""

SIZES = (8, 16, 24, 40, 60, 80)
LOW = dict(mu=0.1, sigma=0.02)
MOMENTS = Row(recipe=dict(objective="moments", rate=1e-4, anchor=1.0), network=dict(table=(6, 5)))
ATTRIBUTES = {"angle": ("orientations", 24), "contrast": ("contrast", 3), "coherence": ("coherence", 3)}


def rows() -> dict[str, Row]:
    """Return all experiments by name."""
    out: dict[str, Row] = {}
    for seed in range(3):
        out[f"full-s{seed}"] = SMALL.but(recipe=dict(seed=seed, **STEADY))
        out[f"full-low-s{seed}"] = SMALL.but(recipe=dict(seed=seed, **STEADY, **LOW))
        out[f"full16-s{seed}"] = FULL.but(recipe=dict(seed=seed), hash=dict(size=16))
        out[f"full40-s{seed}"] = FULL.but(recipe=dict(seed=seed))
        out[f"moments-s{seed}"] = MOMENTS.but(recipe=dict(seed=seed))
        out[f"moments-low-s{seed}"] = MOMENTS.but(recipe=dict(seed=seed, **LOW))
    for seed, count in itertools.product(DRAWS, (600, 100)):
        for name, base in (("wgan", SMALL), ("moments", MOMENTS)):
            row = base.but(finite=count, disjoint=True, textures=200, recipe=dict(seed=seed))
            out[f"finite{count}-{name}-s{seed}"] = row
    one = dict(orientations=1, coherence=1, contrast=1)
    out["table4-global"] = FULL.but(hash=one)
    out["table4-uniform"] = FULL.but(recipe=dict(uniform=1.0))
    for name, cells in (("global", (1, 1)), ("brightness", (6, 1)), ("edges", (1, 5))):
        out[f"table4-moments-{name}"] = MOMENTS.but(recipe=dict(cells=cells))
    for kind in ("energy", "events"):
        for n in range(8):
            used = [name for bit, name in enumerate(ATTRIBUTES) if n >> bit & 1]
            how = {**one, **dict(ATTRIBUTES[name] for name in used), "contrast_from": kind}
            out[f"table5-{kind}-{'+'.join(used) or 'none'}"] = FULL.but(hash=how)
    out["table5-ranked"] = FULL.but(hash=dict(contrast_from="events-ranked"))
    out["fig3-no-kl"] = FULL.but(recipe=dict(kl=0.0))
    out["fig3-literal"] = FULL.but(recipe=dict(anchor=0.0), network=dict(literal=True))
    out["fig3-literal-no-kl"] = out["fig3-literal"].but(recipe=dict(kl=0.0))
    out["paper"] = FULL.but(
        recipe=dict(
            optimizer="adabelief", rate=4e-4, rate_scalars=4e-4, critic_rate=4e-4, critic_cosine=True,
            anchor=0.0, average=0.0, surrogate="interval", warmup=0,
        ),
        hash=dict(contrast_from="events"),
        network=dict(literal=True),
    )  # fmt: skip
    for size in SIZES:
        out[f"fig5-{size}"] = FULL.but(hash=dict(size=size))
    for surrogate in ("interval", "events"):
        out[f"surrogate-{surrogate}"] = FULL.but(recipe=dict(surrogate=surrogate))
    for anchor in (0.0, 1.0, 30.0):
        out[f"anchor-{anchor:g}"] = FULL.but(recipe=dict(anchor=anchor))
    recorded = dict(doubt=0.2, batch=8)
    out["real-moments"] = MOMENTS.but(real=True, recipe=recorded, network=dict(split=True))
    out["real-baselines"] = out["real-moments"].but(judged=BASELINES, recipe=dict(steps=0, warmup=0))
    for doubt in (0.05, 0.1):
        out[f"real-moments-doubt{doubt:g}"] = out["real-moments"].but(recipe=dict(doubt=doubt))
    out["real-moments-flat"] = out["real-moments"].but(network=dict(table=None), recipe=dict(rate=0.0))
    out["real-wgan"] = SMALL.but(
        real=True, recipe=dict(batch=8, anchor=0.5), hash=dict(orientations=8), network=dict(split=True)
    )
    out.update(_finite_variants())
    out.update(_maps())
    return out


def _finite_variants() -> dict[str, Row]:
    base = FULL.but(finite=600, textures=200)
    energy = dict(size=8, orientations=6, contrast=12)
    fine = {
        f"finite600-wgan-energy12-s{seed}": base.but(disjoint=True, hash=energy, recipe=dict(seed=seed))
        for seed in DRAWS
    }
    return fine | {
        "finite600-wgan-same-textures": base,
        "finite600-wgan-plain": base.but(augment=False, disjoint=True),
        "finite600-wgan-slow-critic": base.but(disjoint=True, recipe=dict(critic_rate=5e-5)),
        "finite600-wgan-cosine-critic": base.but(disjoint=True, recipe=dict(critic_cosine=True)),
        "finite600-wgan-penalty10": base.but(disjoint=True, recipe=dict(penalty=10.0)),
        "finite600-wgan-global": base.but(disjoint=True, hash=dict(orientations=1, coherence=1, contrast=1)),
        "finite600-moments-same-textures": MOMENTS.but(finite=600),
        "finite600-moments-24-textures": MOMENTS.but(finite=600, disjoint=True, textures=48),
        "finite600-wgan-24-textures": base.but(disjoint=True, textures=48),
        "finite600-moments-flat": MOMENTS.but(
            finite=600, disjoint=True, textures=200, recipe=dict(rate=0.0), network=dict(table=None)
        ),
    }


def _maps() -> dict[str, Row]:
    """Targets whose thresholds differ from pixel to pixel, and ways to learn them."""
    ways = {
        "moments": MOMENTS,
        "moments-table-only": MOMENTS.but(recipe=dict(rate=0.0)),
        "moments-unet-only": MOMENTS.but(recipe=dict(rate=1e-3, anchor=0.01), network=dict(table=None)),
        "moments-unet": MOMENTS.but(recipe=dict(rate=1e-3, anchor=0.01)),
        "wgan": FULL.but(recipe=dict(anchor=0.5)),
        "wgan-table": SMALL.but(recipe=dict(anchor=5.0), network=dict(table=(6, 5))),
        "wgan-table-intensity": SMALL.but(
            recipe=dict(anchor=5.0), network=dict(table=(6, 5)), hash=dict(orientations=8, intensity=6)
        ),
        "wgan-image-table": FULL.but(recipe=dict(critic_image=True), network=dict(table=(6, 5))),
        "wgan-image": FULL.but(recipe=dict(anchor=0.5, critic_image=True)),
        "wgan-intensity": FULL.but(
            recipe=dict(anchor=0.5), hash=dict(orientations=8, coherence=1, contrast=3, intensity=6)
        ),
        "wgan-small": FULL.but(
            recipe=dict(anchor=0.5, rate=3e-4), hash=dict(size=16, orientations=8, coherence=1, intensity=6)
        ),
    }
    out = {}
    for truth in ("intensity", "edges"):
        for name, way in ways.items():
            out[f"maps-{truth}-{name}"] = way.but(truth=truth)
    pattern = dict(pattern=(240, 240))
    out["maps-column-moments"] = ways["moments"].but(truth="column", network=pattern)
    out["maps-column-wgan"] = SMALL.but(truth="column", network=pattern)
    out["maps-column-moments-finite600"] = out["maps-column-moments"].but(finite=600, augment=False)
    for truth in ("intensity", "edges"):
        out[f"maps-{truth}-moments-finite600"] = MOMENTS.but(
            truth=truth, finite=600, disjoint=True, textures=200
        )
    for name in ("moments", "wgan-table"):
        out[f"maps-asymmetric-{name}"] = ways[name].but(truth="asymmetric", network=dict(split=True))
    return out


@dataclass(frozen=True)
class Planned:
    """A row of a plan.

    Args:
        name: Of the row.
        seconds: Training time.
        adversarial: Whether it has critics, which fill a GPU; other rows run many at a time.
    """

    name: str
    seconds: float
    adversarial: bool


SEEDS = (0, 1, 2)

SAME = {
    "table5-energy-none": "table4-global",
    "table5-energy-angle+contrast+coherence": "full40-s0",
    "fig5-40": "full40-s0",
    "fig5-16": "full16-s0",
    "fig5-8": "full-s0",
}
"""Rows that are other rows by another name."""


def plan(which: str) -> list[Planned]:
    """Return the rows of a plan, the most important first: `main`, `tables` or `all`."""
    every = rows()
    main = [f"{kind}-s{n}" for kind in ("moments", "moments-low") for n in SEEDS]
    main += [f"finite{count}-moments-s{n}" for count in (600, 100) for n in DRAWS]
    main += [f"maps-{truth}-moments" for truth in ("intensity", "edges", "column", "asymmetric")]
    main += ["real-moments", "real-moments-flat", "real-baselines"]
    main += [f"{kind}-s{n}" for kind in ("full", "full-low", "full16", "full40") for n in SEEDS]
    tables = ["table4-global", "table4-uniform", "table5-events-angle+contrast+coherence"]
    tables += [f"table4-moments-{name}" for name in ("global", "brightness", "edges")]
    tables += [n for n in every if n.startswith("table5-energy") and n not in SAME]
    tables += ["fig3-literal", "fig3-literal-no-kl", "fig3-no-kl"]
    tables += [f"fig5-{size}" for size in SIZES if f"fig5-{size}" not in SAME]
    rest = ["real-wgan", "real-moments-doubt0.05", "real-moments-doubt0.1", "paper", "table5-ranked"]
    rest += [f"finite{count}-wgan-s{n}" for count in (600, 100) for n in DRAWS]
    rest += [f"table5-events-{used}" for used in ("contrast", "angle+contrast", "contrast+coherence")]
    rest += [f"maps-{truth}-wgan-table" for truth in ("intensity", "edges", "asymmetric")]
    rest += ["maps-column-wgan", "maps-intensity-wgan-table-intensity"]
    chosen = {"main": main, "tables": tables, "all": main + tables + rest}
    if which not in chosen:
        raise SystemExit(f"--plan must be one of {', '.join(chosen)}, got '{which}'")
    out = []
    for name in chosen[which]:
        adversarial = every[name].recipe.get("objective") != "moments"
        seconds = 40.0 if name.startswith(("full", "real", "paper")) else 28.0
        if "critic_steps" in every[name].recipe:
            seconds = 75.0
        if every[name].recipe.get("steps") == 0:
            seconds = 0.0
        out.append(Planned(name, seconds, adversarial))
    return out
