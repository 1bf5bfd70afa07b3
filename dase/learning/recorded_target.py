"""A camera's recordings as the target of training, and their own frames as the scenes.

The recording is cut into windows. What the camera saw in each, `CameraScene` tells from its frames; the
simulator is shown the same windows, in other order and with other noise, so that the two sides have the same
scenes and speeds without being paired. Pixels whose scene cannot be trusted have no events on either side.

A camera's pixels come to a window with what they have seen before it: after a turn of the motion they must go
through both thresholds, and a slow photoreceptor lags. Simulated pixels that begin with the window have no
such past, and make up to a third more or less events in 50 ms. So the simulator also sees what leads up to a
window.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from dase.errors import InputError
from dase.learning.scene_batches import Scenery, SceneSettings
from dase.learning.targets import FiniteTarget, store_pairs
from dase.recordings.recording import Recording, mask_of_region, open_recording
from dase.scenes.between_frames import CameraScene, TrustSettings
from dase.scenes.frame_motion import estimate_stretches, is_stretched
from dase.scenes.scene import LOG_EPS


@dataclass(frozen=True)
class RecordedWindows:
    """What a camera saw and sent, window by window.

    Args:
        begin: Begin of each window [s], shape (M,).
        lead: Times of the samples that lead up to a window, from its begin [s], shape (L,).
        log: Log intensities, float16, shape (M, L + K, H, W); constant where the scene is not trusted.
        counts: Events, float32, shape (M, 2, H, W), OFF before ON; none where the scene is not trusted.
        known: Where the scene is trusted, shape (M, H, W).
    """

    begin: NDArray[np.float64]
    lead: NDArray[np.float64]
    log: NDArray[np.float16]
    counts: NDArray[np.float32]
    known: NDArray[np.bool_]

    @property
    def trusted(self) -> float:
        """Share of the pixels whose scene is trusted."""
        return float(self.known.mean())

    @property
    def grey(self) -> NDArray[np.float32]:
        """Intensity at the middles of the windows, shape (M, H, W)."""
        lead = len(self.lead)
        middle = self.log[:, lead + (self.log.shape[1] - lead) // 2]
        return np.exp(middle.astype(np.float32)) - np.float32(LOG_EPS)


LEAD = 4
"""How much of a recording leads up to a window, in windows: 4, with as many samples as the window has."""


def cut_windows(
    recording: Recording,
    *,
    window: float = 0.05,
    samples: int = 16,
    tolerance: float = TrustSettings.tolerance,
    most: int | None = None,
    memory: int = 1 << 31,
    fewest: float = 0.005,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> RecordedWindows:
    """Cut a recording into windows.

    Args:
        recording: With frames whose times are known.
        window: Duration [s].
        samples: Of the log intensity, in a window, and in what leads up to it.
        tolerance: Doubt up to which a scene is trusted [log intensity].
        most: Windows, evenly chosen; None for as many as fit into `memory`.
        memory: For the windows' log intensities [bytes]; of a longer recording only some windows are used.
        fewest: Events per pixel and window below which nothing can be learned.
        progress: Called with how many windows are done, and of how many.

    Raises:
        InputError: There are no frames or times, or too few events.
    """
    scene = _scene_of(recording)
    begin = np.arange(scene.times[0], scene.times[-1] - window, window)
    if len(begin) < 4:
        raise InputError(
            f"the frames of the recording span {scene.duration:g} s; 4 windows of {window:g} s need "
            f"{4 * window:g} s"
        )
    lead = -LEAD * window * np.linspace(1, 0, samples, endpoint=False)
    size = 4 * samples * recording.height * recording.width
    most = min(most or len(begin), max(memory // size, 4))
    begin = begin[np.unique(np.round(np.linspace(0, len(begin) - 1, min(most, len(begin)))).astype(int))]
    log = np.empty((len(begin), 2 * samples, recording.height, recording.width), np.float16)
    counts = np.empty((len(begin), 2, recording.height, recording.width), np.float32)
    known = np.empty((len(begin), recording.height, recording.width), np.bool_)
    for n, start in enumerate(begin):
        times = start + window * np.linspace(0, 1, samples)
        trusted = recording.mask & (scene.doubt(times[:: max(samples // 4, 1)]).max(0) <= tolerance)
        # before its first frame the scene stands still
        before = np.maximum(start + lead, scene.times[0])
        levels = np.log(scene.frames(np.concatenate([before, times])) + np.float32(LOG_EPS))
        log[n] = np.where(trusted, levels, levels[samples + samples // 2])
        counts[n] = np.where(trusted, _count_events(recording, start, start + window), 0)
        known[n] = trusted
        progress(n + 1, len(begin))
    rate = float(counts.sum((1, 2, 3)).mean()) / (recording.height * recording.width)
    if rate < fewest:
        raise InputError(
            f"the recording has {rate:.2g} events per pixel in windows of {window:g} s where its frames can "
            f"be trusted; learning needs at least {fewest:g}"
        )
    return RecordedWindows(begin, lead, log, counts, known)


def _scene_of(recording: Recording) -> CameraScene:
    if recording.frames is None or len(recording.frames) < 2:
        raise InputError(
            "the recording has no frames, by which events are compared where scenes are alike; record with "
            "frames, or reconstruct them and store them with the events"
        )
    begin = recording.frame_times if recording.frame_begin is None else recording.frame_begin
    if begin is None:
        raise InputError(
            "the frames of the recording have no times, so they cannot be laid beside the events"
        )
    scene = CameraScene(recording.frames, begin, recording.frame_end)
    if not is_stretched(recording.frames):
        return scene
    gains = estimate_stretches([scene.intensity(k) for k in range(len(scene))])
    return CameraScene(recording.frames, begin, recording.frame_end, gains=gains)


def _count_events(recording: Recording, begin: float, end: float) -> NDArray[np.float32]:
    events = recording.events
    first, last = np.searchsorted(events.t, (begin, end))
    some = slice(int(first), int(last))
    place = (
        events.p[some].astype(np.int64) * recording.height + events.y[some]
    ) * recording.width + events.x[some]
    found = np.bincount(place, minlength=2 * recording.height * recording.width)
    return found.reshape(2, recording.height, recording.width).astype(np.float32)


class ReplayedScenes(Scenery):
    """Scenes that are the windows of a recording, on a device."""

    def __init__(self, windows: RecordedWindows, *, window: float, device: str | torch.device = "cpu"):
        samples, height, width = windows.log.shape[1:]
        self.lead = windows.lead
        self.scene_settings = SceneSettings(
            width=width, height=height, window=window, samples=samples - len(self.lead)
        )
        self.device = torch.device(device)
        self.log = torch.from_numpy(windows.log).to(self.device)
        self.trusted = torch.from_numpy(windows.known).to(self.device)

    def draw_numbers(self, rng: np.random.Generator, count: int) -> NDArray[np.int32]:
        """Choose `count` windows; return their indices, (count,)."""
        index = rng.choice(len(self.log), size=count, replace=count > len(self.log))
        return np.asarray(index, np.int32)

    def render(self, numbers: torch.Tensor, count: int) -> torch.Tensor:
        """Return the log intensities of windows, shape (count, L + samples, height, width)."""
        return self.log[numbers[:count].long()].float()

    def known(self, numbers: torch.Tensor, count: int) -> torch.Tensor | None:
        """Return where the scenes of windows are trusted, shape (count, height, width)."""
        return self.trusted[numbers[:count].long()]


def open_target(
    paths: Sequence[Path],
    *,
    window: float = 0.05,
    samples: int = 16,
    held_out: float = 0.2,
    begin: float | None = None,
    end: float | None = None,
    region: tuple[int, int, int, int] | None = None,
    device: str | torch.device = "cpu",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[FiniteTarget, ReplayedScenes]:
    """Open recordings of one camera as a target, and their windows as scenes.

    Args:
        paths: Files.
        window: Duration of a window [s].
        samples: Of the log intensity, in a window.
        held_out: Share of the windows kept for choosing between models: the last ones of each recording.
        begin: Time of each recording from which on is learned [s]; None for its begin.
        end: Time at which learning stops [s]; None for its end.
        region: First column and row, columns and rows of what is learned from; None for all pixels. What lies
            outside is not trusted, and the sensor keeps its size.
        device: PyTorch device.
        progress: Called with how many windows are done, and of how many.

    Raises:
        InputError: A file cannot be read, is of another size, or holds too little.
    """
    found: list[RecordedWindows] = []
    shape = None
    for path in paths:
        recording = open_recording(path)
        recording = recording.masked(~recording.hot)
        try:
            if begin is not None or end is not None:
                span = -np.inf if begin is None else begin, np.inf if end is None else end
                recording = recording.slice(*span)
            if region is not None:
                recording = recording.masked(mask_of_region(region, recording.width, recording.height))
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        size = (recording.width, recording.height)
        shape = shape or size
        if size != shape:
            raise InputError(
                f"{path} is of a {size[0]}x{size[1]} sensor, those before it of {shape[0]}x{shape[1]}"
            )
        try:
            found.append(cut_windows(recording, window=window, samples=samples, progress=progress))
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
    return join_windows(found, window=window, held_out=held_out, device=device)


def join_windows(
    found: Sequence[RecordedWindows], *, window: float, held_out: float = 0.2,
    device: str | torch.device = "cpu",
) -> tuple[FiniteTarget, ReplayedScenes]:  # fmt: skip
    """Return the windows of recordings as a target, and as scenes, the held-out ones of all recordings last.

    Args:
        found: Windows of each recording.
        window: Duration of a window [s].
        held_out: Share of the windows, the last ones of each recording, kept for choosing between models.
        device: PyTorch device.
    """
    order: list[int] = []
    rest: list[int] = []
    start = 0
    for part in found:
        cut = len(part.begin) - max(int(round(held_out * len(part.begin))), 1)
        order += range(start, start + cut)
        rest += range(start + cut, start + len(part.begin))
        start += len(part.begin)
    # scenes and pairs in one order, so that a window can be looked at from both sides
    chosen = np.array(order + rest)
    begin, log, counts, known = (
        np.concatenate(parts)[chosen]
        for parts in zip(*((part.begin, part.log, part.counts, part.known) for part in found), strict=True)
    )
    every = RecordedWindows(begin, found[0].lead, log, counts, known)
    scenes = ReplayedScenes(every, window=window, device=device)
    pairs = store_pairs(torch.from_numpy(every.grey), torch.from_numpy(counts), device)
    return FiniteTarget(pairs, held_out=len(rest) / start, augment=False), scenes
