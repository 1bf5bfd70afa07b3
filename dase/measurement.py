"""Opens what a comparison needs: a recording, and the scene it is of."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dase import io
from dase.errors import InputError
from dase.events import Events
from dase.io.sequence import Sequence
from dase.scene import Scene
from dase.stimulus import Trust
from dase.video import VideoScene, open_video

GREY = 0.5
"""Intensity taken for a static scene of unknown light."""


@dataclass(frozen=True)
class Measurement:
    """Events and the scene they are of, on one clock.

    Args:
        events: What was measured.
        scene: What the camera saw.
        trust: Where and when the scene is to be trusted; None for everywhere.
        notes: What was noticed while reading.
    """

    events: Events
    scene: Scene
    trust: Trust | None = None
    notes: tuple[str, ...] = ()


def open_measurement(recording: Path, scene: str = "frames", video: Path | None = None) -> Measurement:
    """Open a recording and its scene.

    Args:
        recording: File of events.
        scene: `frames` for the recording's own, `static` for light that does not change, `video` for the
            frames of a file, or the path of that file.
        video: The file of `video`.

    Raises:
        InputError: Something is missing or damaged.
    """
    if scene not in ("frames", "static", "video"):
        video, scene = Path(scene), "video"
    if scene == "video" and video is None:
        raise InputError("--scene video needs the file: --scene video FILE")
    if scene != "video" and video is not None:
        raise InputError(f"--scene {scene} takes no file, got {video}")
    notes: list[str] = []
    sequence = io.read(recording, notes=notes)
    if len(sequence.events) == 0:
        raise InputError(f"{recording} has no events, so there is nothing to compare")
    if scene == "static":
        seen: Scene = static_scene(sequence.events)
    elif scene == "video":
        assert video is not None
        seen = open_clip(video)
    else:
        seen = scene_of_frames(sequence, recording)
    return Measurement(sequence.events, seen, None, tuple(notes))


def static_scene(events: Events) -> VideoScene:
    """Return light that does not change, as long as the events last."""
    frames = np.full((2, events.height, events.width), GREY, np.float32)
    begin, end = float(events.t[0]), float(events.t[-1])
    return VideoScene(frames, [begin, max(end, begin + 1e-3)])


def scene_of_frames(sequence: Sequence, path: Path) -> VideoScene:
    """Return the scene of a recording's own frames."""
    if sequence.frames is None or len(sequence.frames) < 2:
        raise InputError(
            f"{path} has no frames to take the scene from; give --scene video FILE, or --scene static for a "
            "camera that saw nothing move"
        )
    if sequence.frame_times is None:
        raise InputError(f"{path}: its frames have no times, so they cannot be laid beside the events")
    return VideoScene(linear(sequence.frames, path), sequence.frame_times)


def open_clip(path: Path) -> VideoScene:
    """Return the scene of a video, of a folder of pictures, or of an archive with `frames` and `frame_us`."""
    if not path.exists():
        raise InputError(f"scene {path} does not exist")
    if path.suffix.lower() != ".npz":
        return open_video(path)
    try:
        with np.load(path, allow_pickle=False) as data:
            missing = [name for name in ("frames", "frame_us") if name not in data]
            if missing:
                raise InputError(f"scene {path} has no '{missing[0]}', got {', '.join(data) or 'nothing'}")
            frames, times = data["frames"], data["frame_us"] * 1e-6
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"scene {path} cannot be read as an archive of frames: {error}") from error
    return VideoScene(linear(frames, path), times)


def linear(frames: NDArray[Any], path: Path) -> NDArray[np.float32]:
    """Return frames as intensities in [0, 1]; whole numbers are shares of the largest their type holds."""
    if frames.dtype.kind == "u":
        shares: NDArray[np.float32] = frames.astype(np.float32) / np.float32(np.iinfo(frames.dtype).max)
        return shares
    out = frames.astype(np.float32)
    bad = ~np.isfinite(out) | (out < 0)
    if bad.any():
        first = int(np.argwhere(bad)[0][0])
        raise InputError(
            f"scene {path}: frame {first} has {int(bad[first].sum())} values below 0 or not numbers; "
            "intensities must be finite and >= 0"
        )
    return out
