"""EventGAN, a network that makes event volumes of two frames: the baseline of the paper, in the study alone.

Zhu et al., EventGAN: Leveraging Large Scale Image Datasets for Event Cameras, 2021; written afresh from its
published facts. A UNet takes two grey frames in [-1, 1] to 18 channels, 9 nodes of time for each polarity; a
critic of patches sees volumes beside both frames. Hinge losses, two steps of the critic for one of the
generator, RAdam. Spectral norm on residual blocks and decoders, and here on the critic, too. Its auxiliary
losses by pretrained networks of flow and images are left out.

Volumes are normalised: divided by the 98th percentile of all numbers of the target's recording that are not
0, and no more than 1. That percentile is kept, so that what the generator makes is multiplied by it again
before networks see it: they are trained and tested on numbers of events. Nodes of time are those of
`dase.Voxels(9)`, every second of which is one of `dase.Voxels(5)`: the networks' inputs are sums of volumes,
exact for volumes of real events. Nothing in it is random, so noise can only be its mean, which is the
method's limit.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn
from torch.nn.utils.parametrizations import spectral_norm

from dase import Events, Voxels
from dase.files.atomic_file import replacing
from dase.torch import Batch

NODES = 9
"""Of time, for each polarity."""
CHANNELS = (32, 64, 128, 256, 512)
"""Of the levels of the generator, the first in full size."""
LOGGED = ("critic", "generator", "real", "made", "correlation")
"""Both losses, means of normalised volumes, and the correlation of what networks would see of both."""
PAIRS_AT_ONCE = 64
"""Pairs of frames that are binned, or generated, at once."""


class Residual(nn.Module):
    """Two convolutions whose result is added."""

    def __init__(self, channels: int):
        super().__init__()
        self.first, self.second = (
            spectral_norm(nn.Conv2d(channels, channels, 3, padding=1)) for _ in range(2)
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the same shape."""
        return F.relu(x + self.second(F.relu(self.first(x))))


class Generator(nn.Module):
    """Frames (B, 2, H, W) in [-1, 1], the earlier one first, to volumes (B, 18, H, W): OFF, then ON.

    The last layer is linear, and what lies outside [0, 1] is clipped where volumes are used: behind a
    sigmoid, in a small trial, volumes became 0 everywhere within 1000 steps, without a gradient back.
    """

    def __init__(self) -> None:
        super().__init__()
        pairs = list(itertools.pairwise(CHANNELS))
        self.head = nn.Conv2d(2, CHANNELS[0], 3, padding=1)
        self.encoders = nn.ModuleList(nn.Conv2d(a, b, 3, stride=2, padding=1) for a, b in pairs)
        self.middle = nn.Sequential(*(Residual(CHANNELS[-1]) for _ in range(2)))
        self.decoders = nn.ModuleList(
            spectral_norm(nn.Conv2d(a + b, a, 3, padding=1)) for a, b in reversed(pairs)
        )
        self.tail = nn.Conv2d(CHANNELS[0], 2 * NODES, 1)
        # most of a volume is 0: so is the first guess, nearly
        nn.init.zeros_(self.tail.bias)

    def forward(self, frames: torch.Tensor) -> torch.Tensor:
        """Return normalised volumes, of which a few numbers may lie outside [0, 1]."""
        height, width = frames.shape[-2:]
        multiple = 2 ** len(self.encoders)
        x = F.pad(frames, (0, -width % multiple, 0, -height % multiple), mode="replicate")
        x = F.relu(self.head(x))
        skips = []
        for encoder in self.encoders:
            skips.append(x)
            x = F.relu(encoder(x))
        x = self.middle(x)
        for decoder in self.decoders:
            enlarged = F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
            x = F.relu(decoder(torch.cat([enlarged, skips.pop()], 1)))
        volumes: torch.Tensor = self.tail(x)[..., :height, :width]
        return volumes


class PatchCritic(nn.Module):
    """Volumes and their frames to a score of each patch, (B, 1, H / 8, W / 8)."""

    def __init__(self) -> None:
        super().__init__()
        channels = (2 * NODES + 2, 64, 128, 256)
        layers: list[nn.Module] = []
        for a, b in itertools.pairwise(channels):
            layers += [spectral_norm(nn.Conv2d(a, b, 4, stride=2, padding=1)), nn.LeakyReLU(0.2)]
        self.layers = nn.Sequential(*layers, spectral_norm(nn.Conv2d(channels[-1], 1, 3, padding=1)))

    def forward(self, volumes: torch.Tensor, frames: torch.Tensor) -> torch.Tensor:
        """Return the scores."""
        scores: torch.Tensor = self.layers(torch.cat([volumes, frames], 1))
        return scores


def event_volumes(events: Events, times: np.ndarray) -> torch.Tensor:
    """Return the volumes of events between frames, float16.

    Args:
        events: In order of time.
        times: Of F frames [s].

    Returns:
        Shape (F - 1, 18, H, W), OFF before ON.
    """
    parts = []
    for begin in range(0, len(times) - 1, PAIRS_AT_ONCE):
        edges = times[begin : begin + PAIRS_AT_ONCE + 1]
        part = events.slice(edges[0], edges[-1])
        of_both = []
        for on in (False, True):
            some = part.p.astype(bool) == on
            # all ON: a number of events, whatever their polarity
            columns = part.t[some], part.x[some], part.y[some], np.ones(int(some.sum()), bool)
            grids = Voxels(NODES)(columns, edges=edges, size=(events.width, events.height))
            of_both.append(torch.from_numpy(grids).half())
        parts.append(torch.cat(of_both, 1))
    return torch.cat(parts)


def network_inputs(volumes: torch.Tensor) -> torch.Tensor:
    """Return `dase.Voxels(5)` (..., 5, H, W) of volumes (..., 18, H, W) that are numbers of events."""
    off, on = volumes.split(NODES, -3)
    net = on - off
    # what lies between two nodes of the coarse grid is half each one's
    between = 0.5 * net[..., 1::2, :, :]
    inputs = net[..., ::2, :, :].clone()
    inputs[..., :-1, :, :] += between
    inputs[..., 1:, :, :] += between
    return inputs


def to_network_range(frames: torch.Tensor) -> torch.Tensor:
    """Return intensities of [0, 1] in [-1, 1]."""
    return 2 * frames - 1


@dataclass(frozen=True)
class GanTraining:
    """How the generator is trained.

    Args:
        steps: Of the generator.
        batch: Pairs of frames of a step.
        crop: Columns and rows of them [px].
        seed: Of weights and of what is drawn.
    """

    steps: int = 3000
    batch: int = 16
    crop: tuple[int, int] = (112, 112)
    seed: int = 0


def train_eventgan(
    events: Events, frames: np.ndarray, times: np.ndarray, device: str, settings: GanTraining,
    between: Callable[[], None] = lambda: None,
) -> dict[str, object]:  # fmt: skip
    """Return a generator that was trained on pairs of frames and the events between them.

    Args:
        events: Of the target.
        frames: Of the same, uint8, shape (F, H, W).
        times: Of the frames [s], shape (F,).
        device: PyTorch's.
        settings: How it is trained.
        between: Called before each step; what it raises ends the training.

    Returns:
        `weights` of the generator, float16; `scale`, which its volumes are multiplied by; and of the last
        tenth of the steps `log`, means of LOGGED.
    """
    volumes = event_volumes(events, times).to(device)
    pictures = torch.from_numpy(frames).to(device)
    some = volumes[:: max(1, len(volumes) // 50)]
    scale = float(np.quantile(some[some > 0].float().cpu().numpy(), 0.98)) if bool((some > 0).any()) else 1.0
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        generator, critic = Generator().to(device), PatchCritic().to(device)
    of_generator = torch.optim.RAdam(generator.parameters(), lr=2e-4, betas=(0.0, 0.999))
    of_critic = torch.optim.RAdam(critic.parameters(), lr=5e-5, betas=(0.0, 0.999))
    rng = np.random.default_rng(settings.seed)
    width, height = settings.crop

    rows, columns = torch.arange(height, device=device), torch.arange(width, device=device)

    def draw() -> tuple[torch.Tensor, torch.Tensor]:
        """Return volumes and frames of a batch."""
        most = len(volumes), frames.shape[1] - height + 1, frames.shape[2] - width + 1
        drawn = torch.from_numpy(np.stack([rng.integers(one, size=settings.batch) for one in most])).to(
            device
        )
        k, y, x = drawn[0, :, None, None], drawn[1, :, None] + rows, drawn[2, :, None] + columns
        y, x = y[:, :, None], x[:, None]
        # where an index stands on both sides of a slice, its dimensions come first
        real = volumes[k, :, y, x].movedim(-1, 1).float() / scale
        shown = torch.stack([pictures[k, y, x], pictures[k + 1, y, x]], 1).float() / 255
        return real.clamp(max=1), to_network_range(shown)

    log = []
    for step in range(settings.steps):
        between()
        for _ in range(2):
            real, shown = draw()
            with torch.no_grad():
                made = generator(shown)
            loss = F.relu(1 - critic(real, shown)).mean() + F.relu(1 + critic(made, shown)).mean()
            of_critic.zero_grad()
            loss.backward()
            of_critic.step()
        real, shown = draw()
        made = generator(shown)
        fooled = -critic(made, shown).mean()
        of_generator.zero_grad()
        fooled.backward()
        of_generator.step()
        if step >= int(0.9 * settings.steps):
            a, b = (network_inputs(one.detach().clamp(0, 1)).flatten() for one in (real, made))
            correlation = torch.corrcoef(torch.stack([a, b]))[0, 1]
            log.append(
                torch.stack([loss.detach(), fooled.detach(), real.mean(), made.detach().mean(), correlation])
            )
    found = torch.stack(log).mean(0).tolist()
    return {
        "weights": {name: one.half().cpu() for name, one in generator.state_dict().items()},
        "scale": scale,
        "log": dict(zip(LOGGED, found, strict=True)),
    }


def save_eventgan(path: Path, found: dict[str, object]) -> None:
    """Write what `train_eventgan` returned."""
    with replacing(path) as temporary:
        torch.save(found, temporary)


class EventGan:
    """Makes the inputs of a batch of its frames, instead of the events that were simulated.

    Args:
        path: What `save_eventgan` wrote.
    """

    def __init__(self, path: Path):
        found = torch.load(path, map_location="cpu", weights_only=True)
        self.scale = float(found["scale"])
        self.generator = Generator()
        self.generator.load_state_dict({name: one.float() for name, one in found["weights"].items()})
        # a step of the power iteration of the spectral norm would change the weights at each call
        self.generator.eval().requires_grad_(False)

    @torch.no_grad()
    def __call__(self, batch: Batch) -> torch.Tensor:
        """Return inputs (T, B, 5, H, W); the first window, before which no frame is known, has no events."""
        self.generator.to(batch.frames.device)
        shown = to_network_range(torch.cat([batch.frames[:-1], batch.frames[1:]], 2)).flatten(0, 1)
        made = torch.cat(
            [
                network_inputs(self.scale * self.generator(one).clamp(0, 1))
                for one in shown.split(PAIRS_AT_ONCE)
            ]
        )
        inputs = torch.zeros_like(batch.inputs)
        inputs[1:] = made.view_as(inputs[1:])
        return inputs
