"""Where the real side of training comes from: pairs of a grey image and the event counts around it."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from dase.kernels.autograd_counts import FLOOR, STEP, Surrogate, clipped_thresholds, count_events
from dase.learning.scene_batches import Scenery, middle_intensity, send_words
from dase.networks.threshold_network import edge_strength

Truth = Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor]]
"""Images (B, H, W) to μ and σ of their thresholds, each (B, 2, H, W), OFF before ON [log intensity]."""


@dataclass
class VariedCounts:
    """Counts at thresholds a little higher and lower, to differentiate anything by central differences.

    Args:
        log: Logarithm of the thresholds, with gradient, (B, P, H, W): shared, or OFF before ON.
        above: Counts with one of the P thresholds at e^STEP of itself, each (B, 2, H, W).
        below: Counts with it at e^-STEP of itself.
    """

    log: torch.Tensor
    above: list[torch.Tensor]
    below: list[torch.Tensor]

    def with_gradient(
        self, value: Callable[[torch.Tensor], torch.Tensor], counts: torch.Tensor
    ) -> torch.Tensor:
        """Return `value` of the counts, with its gradient by the thresholds; it looks at single pixels.

        A surrogate for the count itself, put through a curved function, is off by what the curve does inside
        the step; the difference of the function's values is not.

        Args:
            value: From counts (B, 2, H, W) to features (B, F, H, W).
            counts: At the thresholds themselves, shape (B, 2, H, W).
        """
        out = value(counts.detach())
        # a slope by the logarithm; between e^-STEP and e^STEP lie 2 sinh(STEP) of a threshold
        for n, (above, below) in enumerate(zip(self.above, self.below, strict=True)):
            slope = (value(above) - value(below)) / (2 * math.sinh(STEP))
            log = self.log[:, n : n + 1]
            out = out + slope * (log - log.detach())
        return out


@dataclass
class Pairs:
    """Images and the events in the window around each.

    Args:
        grey: Images in [0, 1], shape (B, H, W).
        counts: Shape (B, 2, H, W), OFF before ON.
        reference: Counts of the same scenes and noise at thresholds that never change, where simulated.
        varied: How the counts answer to the thresholds, where simulated.
        answers: Counts with all μ, σ and ratios at e^STEP and at e^-STEP of themselves, where simulated.
        some: Indices of the pairs of which `answers` are.
    """

    grey: torch.Tensor
    counts: torch.Tensor
    reference: torch.Tensor | None = None
    varied: VariedCounts | None = None
    answers: dict[str, tuple[torch.Tensor, torch.Tensor]] | None = None
    some: torch.Tensor | None = None

    def __len__(self) -> int:
        return len(self.grey)

    def select(self, index: torch.Tensor | slice) -> Pairs:
        """Return some of the pairs, by a slice or indices (K,), as float32."""
        return Pairs(self.grey[index].float(), self.counts[index].float())


def store_pairs(grey: torch.Tensor, counts: torch.Tensor, device: str | torch.device) -> Pairs:
    """Return pairs as float16 on a device, which halves the memory of a data set.

    Args:
        grey: Images in [0, 1], shape (B, H, W).
        counts: Shape (B, 2, H, W), OFF before ON; more than 2000 are not told apart.
        device: Where training draws them.
    """
    # float16 holds whole numbers exactly up to 2048
    return Pairs(grey.half().to(device), counts.clamp_max(2000).half().to(device))


class Target(ABC):
    """What the simulator is to be like.

    Attributes:
        truth: Its thresholds, where they are known.
        scenes: How many different pairs `draw` has.
    """

    truth: Truth | None = None
    scenes: float = math.inf

    @property
    @abstractmethod
    def device(self) -> torch.device:
        """Where pairs are."""

    @abstractmethod
    def draw_numbers(self, rng: np.random.Generator, count: int) -> NDArray[np.int32]:
        """Draw `count` pairs; return what `pairs` needs to know of them, as words of 4 bytes, (words,)."""

    @abstractmethod
    def pairs(self, numbers: torch.Tensor, count: int) -> Pairs:
        """Return the pairs that `numbers` (words,) drew; the processor decides nothing here."""

    def draw(self, rng: np.random.Generator, count: int) -> Pairs:
        """Return random pairs."""
        return self.pairs(send_words(self.draw_numbers(rng, count), self.device), count)

    def held_out(self) -> Pairs | None:
        """Return pairs that `draw` never gives, or None where every draw is new."""
        return None

    def set_process(self, process: int) -> None:  # noqa: B027  # most have nothing to do here
        """Become different from the same target in other processes, but for what is recorded."""

    def state(self) -> dict[str, Any]:
        """Return what further draws depend on, beside the random numbers they are given."""
        return {}

    def load(self, state: dict[str, Any]) -> None:  # noqa: B027  # most have nothing to do here
        """Take over what `state` returned."""


class EndlessTarget(Target):
    """Fresh scenes seen by a sensor whose threshold distribution is known.

    Args:
        scenery: Draws the scenes.
        truth: The sensor.
        seed: Of thresholds and phases.
    """

    def __init__(self, scenery: Scenery, truth: Truth, *, seed: int = 0):
        self.scenery, self.truth = scenery, truth
        self.generator = torch.Generator(scenery.device).manual_seed(seed)

    @property
    def device(self) -> torch.device:
        """Where scenes are rendered."""
        return self.scenery.device

    def draw_numbers(self, rng: np.random.Generator, count: int) -> NDArray[np.int32]:
        """Draw scenes; return them as words of 4 bytes, (words,)."""
        return self.scenery.draw_numbers(rng, count)

    def pairs(self, numbers: torch.Tensor, count: int) -> Pairs:
        """Render the scenes that `numbers` (words,) drew, and let the sensor see them."""
        log = self.scenery.render(numbers, count)
        grey = middle_intensity(log)
        assert self.truth is not None
        mu, sigma = self.truth(grey)
        return Pairs(grey, simulate_counts(log, mu, sigma, draw_noise(log, self.generator)))

    def set_process(self, process: int) -> None:
        """Draw other thresholds and phases than other processes."""
        if process:
            self.generator.manual_seed(self.generator.initial_seed() + process)

    def state(self) -> dict[str, Any]:
        """Return the state of the random numbers."""
        return {"generator": self.generator.get_state()}

    def load(self, state: dict[str, Any]) -> None:
        """Take over what `state` returned."""
        self.generator.set_state(state["generator"].cpu())


class FiniteTarget(Target):
    """Pairs that were recorded once.

    Args:
        pairs: All of them.
        held_out: Share kept away from training, the last ones.
        augment: Whether to mirror and turn them; motion in a mirror is still motion.
        truth: See `Target`.
    """

    def __init__(
        self, pairs: Pairs, *, held_out: float = 0.2, augment: bool = True, truth: Truth | None = None
    ):
        cut = len(pairs) - int(round(held_out * len(pairs)))
        self.recorded = Pairs(pairs.grey[:cut], pairs.counts[:cut])
        self.rest = Pairs(pairs.grey[cut:], pairs.counts[cut:]) if cut < len(pairs) else None
        self.augment, self.truth, self.scenes = augment, truth, float(cut)

    @property
    def device(self) -> torch.device:
        """Where the pairs were recorded to."""
        return self.recorded.grey.device

    def draw_numbers(self, rng: np.random.Generator, count: int) -> NDArray[np.int32]:
        """Choose pairs, and how each is turned and mirrored; return it as words of 4 bytes, (4 · count,)."""
        index = rng.choice(len(self.recorded), size=count, replace=count > len(self.recorded))
        mirrored = rng.random((2, count)) < 0.5
        turned = np.full(count, rng.random() < 0.5)
        return np.stack([index, *mirrored, turned]).astype(np.int32).ravel()

    def pairs(self, numbers: torch.Tensor, count: int) -> Pairs:
        """Return the pairs that `numbers` (4 · count,) chose, turned and mirrored where `augment` says so."""
        index, across, along, turned = numbers.view(4, count)
        some = self.recorded.select(index.long())
        return flip_pairs(some, across > 0, along > 0, turned > 0) if self.augment else some

    def held_out(self) -> Pairs | None:
        """Return the pairs kept away from training."""
        return self.rest


def flip_pairs(pairs: Pairs, across: torch.Tensor, along: torch.Tensor, turned: torch.Tensor) -> Pairs:
    """Mirror pairs across and along, and transpose them if they are square, where these (B,) say so."""
    out = []
    for maps in (pairs.grey[:, None], pairs.counts):
        for which, axis in ((across, -1), (along, -2)):
            maps = torch.where(which.view(-1, 1, 1, 1), maps.flip(axis), maps)
        if maps.shape[-1] == maps.shape[-2]:
            maps = torch.where(turned.view(-1, 1, 1, 1), maps.transpose(-1, -2), maps)
        out.append(maps)
    return Pairs(out[0][:, 0], out[1])


def record_pairs(target: Target, rng: np.random.Generator, count: int, *, batch: int = 20) -> Pairs:
    """Return `count` pairs of an endless target, stored compactly."""
    parts = [target.draw(rng, min(batch, count - n)) for n in range(0, count, batch)]
    grey = torch.cat([part.grey for part in parts]).half()
    # counts above 2048 would round; nothing looks at them that closely
    return Pairs(grey, torch.cat([part.counts.detach() for part in parts]).half())


@dataclass
class PixelNoise:
    """What is random in pixels.

    Args:
        z: Normal numbers, one for both thresholds of a pixel, which go together, shape (B, H, W).
        phase: Where between two events a pixel begins, in (-1, 1), shape (B, H, W).
        lead: Samples before the window, in which pixels get to where its begin finds them; their events do
            not count.
    """

    z: torch.Tensor
    phase: torch.Tensor
    lead: int = 0

    def windows(self, samples: int) -> tuple[int, ...] | None:
        """Return for `count_events` that the intervals of `samples` which end the lead do not count."""
        return (0,) * self.lead + (1,) * (samples - 1 - self.lead) if self.lead else None


def draw_noise(log: torch.Tensor, generator: torch.Generator, lead: int = 0) -> PixelNoise:
    """Draw the noise of pixels that start anywhere between two events.

    As if the first change had been going on before, like `effects.threshold.phase`.

    Args:
        log: Log intensities, shape (B, K, H, W).
        generator: Draws the numbers.
        lead: See `PixelNoise`.
    """
    shape = (len(log), *log.shape[2:])
    z = torch.randn(shape, device=log.device, generator=generator)
    fraction = torch.rand(shape, device=log.device, generator=generator)
    return PixelNoise(z, torch.where(log[:, 1] >= log[:, 0], fraction, -fraction), lead)


def simulate_counts(
    log: torch.Tensor,
    mu: torch.Tensor,
    sigma: torch.Tensor | float,
    noise: PixelNoise,
    *,
    surrogate: Surrogate = "expected",
) -> torch.Tensor:
    """Count the events of scenes.

    Args:
        log: Log intensities, shape (B, K, H, W).
        mu: Mean thresholds, shape (B, H, W), or (B, 2, H, W) with OFF before ON.
        sigma: Their standard deviation, a number or shaped in either way.
        noise: See `draw_noise`.
        surrogate: See `count_events`.

    Returns:
        Counts of the whole window, shape (B, 2, H, W), OFF before ON.
    """
    windows = noise.windows(log.shape[1])
    counts = count_events(log, mu, sigma, noise.z, phase=noise.phase, windows=windows, surrogate=surrogate)
    return counts[:, -1]


def vary_thresholds(
    log: torch.Tensor, mu: torch.Tensor, sigma: torch.Tensor, noise: PixelNoise
) -> VariedCounts:
    """Return how the counts of `simulate_counts`, for arguments of that shape, answer to the thresholds."""
    theta, windows = clipped_thresholds(mu, sigma, noise.z, like=log), noise.windows(log.shape[1])
    above: list[torch.Tensor] = []
    below: list[torch.Tensor] = []
    with torch.no_grad():
        for n in range(theta.shape[1]):
            for factor, kept in ((math.exp(STEP), above), (math.exp(-STEP), below)):
                moved = theta.detach().clone()
                moved[:, n] *= factor
                moved = moved[:, 0] if theta.shape[1] == 1 else moved
                counts = count_events(log, moved, 0.0, 0.0, phase=noise.phase, windows=windows)
                kept.append(counts[:, -1])
    return VariedCounts(theta.log(), above, below)


@torch.no_grad()
def vary_parameters(
    log: torch.Tensor, mu: torch.Tensor, sigma: torch.Tensor, noise: PixelNoise
) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
    """Return counts with all means, and with all spreads, a little higher and lower, and likewise the ratio.

    Args:
        log: Log intensities, shape (B, K, H, W).
        mu: Mean thresholds, shape (B, H, W), or (B, 2, H, W), which asks for the ratio too.
        sigma: Their standard deviation, shaped alike.
        noise: That of the counts themselves.
    """
    up, down = math.exp(STEP), math.exp(-STEP)
    out = {
        "mu": (simulate_counts(log, up * mu, sigma, noise), simulate_counts(log, down * mu, sigma, noise)),
        "sigma": (simulate_counts(log, mu, up * sigma, noise), simulate_counts(log, mu, down * sigma, noise)),
    }
    if mu.ndim == 4:
        both = []
        for half in (math.sqrt(up), math.sqrt(down)):
            means, spreads = (torch.stack([m[:, 0] / half, m[:, 1] * half], 1) for m in (mu, sigma))
            both.append(simulate_counts(log, means, spreads, noise))
        out["ratio"] = both[0], both[1]
    return out


def uniform_thresholds(mu: float = 0.2, sigma: float = 0.05) -> Truth:
    """One distribution for all pixels: the paper's synthetic experiment."""

    def truth(grey: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        like = grey[:, None].expand(-1, 2, -1, -1)
        return torch.full_like(like, mu), torch.full_like(like, sigma)

    return truth


def thresholds_by_intensity(low: float = 0.12, slope: float = 0.16, spread: float = 0.25) -> Truth:
    """Thresholds that rise with the image: μ = low + slope · I, σ = spread · μ."""

    def truth(grey: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        mu = (low + slope * grey)[:, None].expand(-1, 2, -1, -1)
        return mu, spread * mu

    return truth


def thresholds_by_edges(
    low: float = 0.14, gain: float = 0.16, half: float = 0.04, spread: float = 0.25
) -> Truth:
    """Thresholds that are higher at edges: μ = low + gain · e / (e + half), e the gradient of the image.

    The image is blurred twice before, which is not how the networks and cells see edges.
    """

    def truth(grey: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        e = edge_strength(grey, blurs=2)[:, None]
        mu = (low + gain * e / (e + half)).expand(-1, 2, -1, -1)
        return mu, spread * mu

    return truth


def thresholds_by_column(mu: float = 0.2, spread: float = 0.25, depth: float = 0.25, seed: int = 3) -> Truth:
    """A fixed pattern: every column has a factor exp(depth · N(0, 1)) of its own."""

    @lru_cache(maxsize=4)
    def factors(width: int, device: torch.device) -> torch.Tensor:
        drawn = np.exp(depth * np.random.default_rng(seed).normal(size=width)).astype(np.float32)
        return torch.from_numpy(drawn).to(device)

    def truth(grey: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        row = (mu * factors(grey.shape[-1], grey.device)).clamp_min(2 * FLOOR)
        maps = row.expand(len(grey), 2, *grey.shape[1:])
        return maps, spread * maps

    return truth


def asymmetric_thresholds(mu: float = 0.2, sigma: float = 0.05, ratio: float = 1.4) -> Truth:
    """ON thresholds `ratio` times the OFF thresholds, evenly about `mu` in the logarithm."""

    def truth(grey: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        like = torch.stack([torch.full_like(grey, ratio**power) for power in (-0.5, 0.5)], 1)
        return mu * like, sigma * like

    return truth


TRUTHS: dict[str, Callable[[], Truth]] = {
    "uniform": uniform_thresholds,
    "intensity": thresholds_by_intensity,
    "edges": thresholds_by_edges,
    "column": thresholds_by_column,
    "asymmetric": asymmetric_thresholds,
}
"""Sensors of the synthetic experiments."""
