"""What a trained network makes of recordings: metrics beside their frames and flow, pictures, videos."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from dase import io
from dase.errors import InputError
from dase.events import Events
from dase.figures.event_images import CODECS
from dase.files.atomic_file import replacing
from dase.io.sequence import Sequence
from dase.io.video_writer import open_video_writer
from dase.representations import Voxels
from dase.scenes.frame_alignment import align
from dase.tasks import flow_metrics, image_metrics
from dase.tasks.checkpoints import load_network
from dase.tasks.event_networks import EventNetwork
from dase.torch.stream import choose_device

Pictures = list[NDArray[np.uint8]]
"""Each (H, W, 3), blue, green, red."""


@dataclass(frozen=True)
class Evaluation:
    """What a network is worth on one file.

    Args:
        file: Its name.
        task: `reconstruction` or `flow`.
        windows: How many windows or frames were judged.
        metrics: Their means; of reconstruction `mse`, `mse_affine`, `mse_histogram`, `ssim`, `ms_ssim` where
            pictures are large enough, and `lpips` where its weights are named, none without frames; of flow
            `fwl`, `fwl_signed`, and where it is known `aee` [px per window], `outliers`, `aee_zero`.
        offset: By which the events were taken to come after the frames [s].
    """

    file: str
    task: str
    windows: int
    metrics: dict[str, float]
    offset: float = 0.0

    def __repr__(self) -> str:
        lines = [f"{self.file}: {self.task}, {self.windows} judged"]
        return "\n".join([*lines, *(f"  {name:14s} {value:.4f}" for name, value in self.metrics.items())])

    def to_json(self) -> dict[str, Any]:
        """Return the same as a JSON object."""
        return {
            "file": self.file,
            "task": self.task,
            "windows": self.windows,
            "offset": self.offset,
            **self.metrics,
        }


def evaluate(
    checkpoint: str | PathLike[str],
    file: str | PathLike[str],
    *,
    out: str | PathLike[str] | None = None,
    offset: float | None = 0.0,
    lpips: str | PathLike[str] | None = None,
    normalise: bool = False,
    device: str | None = None,
    **reading: Any,
) -> Evaluation:
    """Return what a trained network is worth on a recording.

    Reconstruction: windows lie between frames, in as many equal parts as bring them nearest to the
    windows that it was trained on; what it says at a frame's time is compared with the frame, in
    [0, 1], without any change but those that a metric's name tells. Flow: windows as in training,
    that end at the frames with true flow if there are any; pixels with events count.

    Args:
        checkpoint: `checkpoint.pt` of a training.
        file: Any recording that dase reads.
        out: Folder that gets `NAME.png`, moments, and `NAME.mp4`, all, both beside the camera's frames.
        offset: Time to add to those of the frames [s], which should be the middles of their exposures on the
            clock of the events; None reads it off, see `dase.align`.
        lpips: Weights of LPIPS, see `dase.tasks.image_metrics.Lpips`; None for none.
        normalise: Whether the network was trained on voxels that are normalised, `Voxels(5, normalise=True)`.
        device: PyTorch's; None for a GPU where there is one.
        **reading: What is known of the file, see `dase.io.ReadOptions`.

    Raises:
        InputError: A file cannot be read, or there is nothing to judge.
    """
    network, window = load_network(Path(checkpoint), choose_device(device))
    return judge_network(
        network, window, file, out=out, offset=offset, lpips=lpips, normalise=normalise, **reading
    )


def judge_network(
    network: EventNetwork,
    window: float,
    file: str | PathLike[str],
    *,
    out: str | PathLike[str] | None = None,
    offset: float | None = 0.0,
    lpips: str | PathLike[str] | None = None,
    normalise: bool = False,
    **reading: Any,
) -> Evaluation:
    """Return what `evaluate` returns, of a network at hand.

    Args:
        network: On its device.
        window: Duration of its windows [s].
        file: See `evaluate`, as all that follow.
        out: Folder.
        offset: Of the frames [s].
        lpips: Weights.
        normalise: Of the voxels.
        **reading: What is known of the file.

    Raises:
        InputError: The file cannot be read, or there is nothing to judge.
    """
    where = next(network.parameters()).device
    sequence = io.read(file, **reading)
    if not len(sequence.events):
        raise InputError(f"{file}: has no events")
    late = _read_off_offset(sequence, str(file)) if offset is None else offset
    judge = _judge_flow if network.task == "flow" else _judge_reconstruction
    perceptual = None if lpips is None else image_metrics.Lpips(Path(lpips)).to(where)
    represent = Voxels(network.shape["bins"], normalise)
    with torch.no_grad():
        rows, pictures, rate = judge(network, represent, sequence, window, late, perceptual, where)
    if out is not None:
        _write_pictures(Path(out), Path(file).name, pictures, rate)
    names = dict.fromkeys(name for row in rows for name in row)
    means = {name: _finite_mean(row[name] for row in rows if name in row) for name in names}
    return Evaluation(Path(file).name, network.task, len(pictures), means, late)


def _finite_mean(values: Iterable[float]) -> float:
    known = [value for value in values if math.isfinite(value)]
    return float(np.mean(known)) if known else math.nan


def _read_off_offset(sequence: Sequence, name: str) -> float:
    """Return the time by which events come after the frames [s], 0 where it is not clear."""
    if sequence.frames is None or sequence.frame_times is None:
        raise InputError(f"{name}: has no frames with times to read an offset off")
    # as if every frame were of one instant: what is found is the middle of the exposure
    found = align(sequence.events, sequence.frames, sequence.frame_times)
    return found.offset if "offset" in found.clear else 0.0


def _grids(
    events: Events, edges: NDArray[np.float64], represent: Voxels, device: torch.device
) -> torch.Tensor:
    """Return voxel grids of windows between edges [s], shape (W, 1, C, H, W)."""
    return torch.from_numpy(represent(events.slice(edges[0], edges[-1]), edges=edges))[:, None].to(device)


def _to_light(frame: NDArray[Any]) -> NDArray[np.float32]:
    """Return a frame (H, W) in [0, 1]."""
    return np.asarray(frame / np.float32(np.iinfo(frame.dtype).max), np.float32)


def _grey_bytes(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return a picture (H, W, 3) of intensity (H, W)."""
    return np.repeat(np.round(255 * np.clip(image, 0, 1)).astype(np.uint8)[..., None], 3, 2)


def _judge_reconstruction(
    network: EventNetwork, represent: Voxels, sequence: Sequence, window: float, late: float,
    perceptual: image_metrics.Lpips | None, device: torch.device,
) -> tuple[list[dict[str, float]], Pictures, float]:  # fmt: skip
    """Return metrics of every frame, pictures and their rate [Hz]."""
    events, frames = sequence.events, sequence.frames
    times: NDArray[Any]
    if frames is None or sequence.frame_times is None or len(frames) < 2:
        frames, span = None, (float(events.t[0]), float(events.t[-1]))
        times = span[0] + window * np.arange(max(int((span[1] - span[0]) / window), 1) + 1)
    else:
        times = sequence.frame_times + late
    rows, pictures, memory = [], [], None
    for index in np.flatnonzero(np.diff(times) > 0):
        begin, end = times[index], times[index + 1]
        parts = max(1, round((end - begin) / window))
        edges = np.linspace(begin, end, parts + 1)
        made, memory = network.sequence(_grids(events, edges, represent, device), memory=memory)
        image = made[-1].float().clamp(0, 1)
        shown = _grey_bytes(image[0, 0].cpu().numpy())
        if frames is not None:
            real = torch.from_numpy(_to_light(frames[index + 1]))[None, None].to(device)
            rows.append(picture_metrics(image, real, perceptual))
            shown = np.concatenate([_grey_bytes(real[0, 0].cpu().numpy()), shown], 1)
        pictures.append(shown)
    return rows, pictures, 1 / float(np.median(np.diff(times)))


def picture_metrics(
    made: torch.Tensor, real: torch.Tensor, perceptual: image_metrics.Lpips | None = None
) -> dict[str, float]:
    """Return the metrics of one picture beside the real one, both (1, 1, H, W) in [0, 1]."""
    affine = image_metrics.affine_matched(made, real).clamp(0, 1)
    found = {
        "mse": image_metrics.mean_squared_error(made, real),
        "mse_affine": image_metrics.mean_squared_error(affine, real),
        "mse_histogram": image_metrics.mean_squared_error(image_metrics.histogram_matched(made, real), real),
    }
    side = min(made.shape[-2:])
    if side >= image_metrics.SSIM_SIDE:
        found["ssim"] = image_metrics.structural_similarity(made, real)
    if side >> 4 >= image_metrics.SSIM_SIDE:
        found["ms_ssim"] = image_metrics.multiscale_similarity(made, real)
    if perceptual is not None:
        found["lpips"] = perceptual(made, real)
    return {name: float(value) for name, value in found.items()}


def _judge_flow(
    network: EventNetwork, represent: Voxels, sequence: Sequence, window: float, late: float,
    perceptual: image_metrics.Lpips | None, device: torch.device,
) -> tuple[list[dict[str, float]], Pictures, float]:  # fmt: skip
    """Return metrics of every window, pictures and their rate [Hz]."""
    events, truths = sequence.events, sequence.flow
    if truths is not None and sequence.frame_times is not None:
        ends: NDArray[Any] = sequence.frame_times + late
    else:
        truths = None
        span = float(events.t[0]), float(events.t[-1])
        ends = span[0] + window * np.arange(1, max(int((span[1] - span[0]) / window), 1) + 1)
    rows, pictures = [], []
    for index, end in enumerate(ends):
        part = events.slice(end - window, end)
        if len(part) < 2:
            continue
        grid = _grids(part, np.array([end - window, end]), represent, device)[0]
        flow = network(grid)[0].float()
        columns = [torch.from_numpy(np.asarray(one)).to(device) for one in (part.x.astype(np.int64),
                   part.y.astype(np.int64), (end - part.t) / window, part.p.astype(bool))]  # fmt: skip
        moved = columns[0], columns[1], columns[2], columns[3]
        row = {
            "fwl": float(flow_metrics.flow_warp_loss(moved, flow[0])),
            "fwl_signed": float(flow_metrics.flow_warp_loss(moved, flow[0], signed=True)),
        }
        if truths is not None:
            truth = window * torch.from_numpy(truths[index])[None].to(device)
            seen = torch.zeros(flow.shape[2:], dtype=torch.bool, device=device)
            seen[moved[1], moved[0]] = True
            found = flow_metrics.flow_errors(flow, truth, seen[None])
            row |= {name: float(value) for name, value in found.items()}
        rows.append(row)
        pictures.append(_flow_picture(part, flow[0].cpu().numpy()))
    if not rows:
        raise InputError("no window has events to judge flow by")
    return rows, pictures, 1 / float(np.median(np.diff(ends))) if len(ends) > 1 else 1 / window


def _flow_picture(events: Events, flow: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return events beside the flow (2, H, W) at them, hue for direction and brightness for speed."""
    counts = np.zeros((events.height, events.width), np.int64)
    np.add.at(counts, (events.y, events.x), np.where(events.p, 1, -1))
    seen = np.zeros(counts.shape, bool)
    seen[events.y, events.x] = True
    speed = np.hypot(flow[0], flow[1])
    most = max(float(np.quantile(speed[seen], 0.95)), 1e-6)
    hue = np.degrees(np.arctan2(flow[1], flow[0])) % 360 / 2
    colours = np.stack([hue, np.full_like(hue, 255), 255 * np.clip(speed / most, 0, 1) * seen], -1)
    left = _grey_bytes(0.5 + 0.25 * np.clip(counts, -2, 2).astype(np.float32))
    return np.concatenate([left, cv2.cvtColor(colours.astype(np.uint8), cv2.COLOR_HSV2BGR)], 1)


def _write_pictures(folder: Path, name: str, pictures: Pictures, rate: float, *, moments: int = 6) -> None:
    """Write some moments below each other, and all as a video."""
    folder.mkdir(parents=True, exist_ok=True)
    some = np.unique(np.linspace(0, len(pictures) - 1, moments + 1).astype(int)[1:])
    packed, png = cv2.imencode(".png", np.concatenate([pictures[k] for k in some]))
    if not packed:
        raise InputError(f"{folder / name}.png cannot be written")
    with replacing(folder / f"{name}.png") as temporary:
        temporary.write_bytes(png.tobytes())
    height, width = (side // 2 * 2 for side in pictures[0].shape[:2])
    with replacing(folder / f"{name}.mp4") as temporary:
        writer, _ = open_video_writer(temporary, min(rate, 60.0), (width, height), CODECS)
        if writer is None:
            raise InputError(f"{folder / name}.mp4: OpenCV cannot write this video")
        try:
            for picture in pictures:
                writer.write(np.ascontiguousarray(picture[:height, :width]))
        finally:
            writer.release()
