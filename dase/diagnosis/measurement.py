"""Opens what a comparison needs: a recording, and the scene it is of."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from dase import io
from dase.errors import InputError
from dase.events import Events
from dase.io.sequence import Sequence
from dase.probes.stimulus import COARSEST, Trust
from dase.results import Comparison, Diagnosis, Fit
from dase.scenes.between_frames import CameraScene
from dase.scenes.frame_alignment import PARTS, align
from dase.scenes.frame_denoising import denoise_resting_pixels
from dase.scenes.frame_motion import estimate_stretches, is_stretched
from dase.scenes.scene import Scene
from dase.scenes.video import VideoScene, open_video

GREY = 0.5
"""Intensity taken for a static scene of unknown light."""

INTERVALS = 8
"""Times between frames that tell whether a camera rests."""

REST = 0.1
"""It does where half of all pixels move by less from one frame to the next [px]."""

Found = TypeVar("Found", Comparison, Diagnosis, Fit)


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

    def noted(self, found: Found) -> Found:
        """Return a finding with what was noticed while reading before its own notes."""
        return replace(found, notes=(*self.notes, *found.notes))


def open_measurement(recording: Path, scene: str = "frames", video: Path | None = None) -> Measurement:
    """Open a recording and its scene.

    Frames of a camera are too far apart to tell all that happened between them: there the scene follows the
    motion from frame to frame, and `Measurement.trust` says where it can be trusted. Frames as dense as the
    steps of a comparison, as those of a simulation may be, are joined by straight lines.

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
    trust: Trust | None = None
    if scene == "static":
        seen: Scene = static_scene(sequence.events)
    elif scene == "video":
        assert video is not None
        seen = open_clip(video)
    else:
        seen = scene_of_frames(sequence, recording, notes)
    if isinstance(seen, CameraScene):
        trust = seen.is_trusted
    return Measurement(sequence.events, seen, trust, tuple(notes))


def static_scene(events: Events) -> VideoScene:
    """Return light that does not change, as long as the events last."""
    frames = np.full((2, events.height, events.width), GREY, np.float32)
    begin, end = float(events.t[0]), float(events.t[-1])
    return VideoScene(frames, [begin, max(end, begin + 1e-3)])


def scene_of_frames(sequence: Sequence, path: Path, notes: list[str]) -> Scene:
    """Return the scene of a recording's own frames; `notes` gets what was found out about them."""
    if sequence.frames is None or len(sequence.frames) < 2:
        raise InputError(
            f"{path} has no frames to take the scene from; give --scene video FILE, or --scene static for a "
            "camera that saw nothing move"
        )
    times = sequence.frame_times
    if times is None:
        raise InputError(f"{path}: its frames have no times, so they cannot be laid beside the events")
    if float(np.median(np.diff(times))) <= COARSEST * (1 + 1e-6):
        return VideoScene(linear_intensity(sequence.frames, path), times)
    return scene_between_frames(sequence, notes)


def scene_between_frames(sequence: Sequence, notes: list[str]) -> CameraScene:
    """Return the scene between the frames of a sequence, laid on its events; `notes` gets what was found out.

    Raises:
        InputError: There are not two frames, or their times are not known.
    """
    times = sequence.frame_times
    if sequence.frames is None or len(sequence.frames) < 2 or times is None:
        raise InputError("the scene between frames needs at least 2 frames with known times")
    half = 0.5 * (np.zeros(len(times)) if sequence.frame_exposure is None else sequence.frame_exposure)
    frames, begin, end = align_with_events(
        sequence.events, sequence.frames, times - half, times + half, notes
    )
    return camera_scene(frames, begin, end, notes)


def align_with_events(
    events: Events,
    frames: NDArray[Any],
    begin: NDArray[np.float64],
    end: NDArray[np.float64],
    notes: list[str],
) -> tuple[NDArray[Any], NDArray[np.float64], NDArray[np.float64]]:
    """Return frames and exposures [s] where the events are: corrected in what clearly lies elsewhere."""
    try:
        found = align(events, frames, begin, end)
    except InputError as error:
        notes.append(f"whether frames and events fit could not be seen ({error})")
        return frames, begin, end
    done = ", ".join(part for part in PARTS if part in found.clear)
    notes.append(
        f"events come {1e3 * found.offset:.1f} ms after the frames and correlate with them at "
        f"{found.score:.2f}: " + (f"corrected {done}" if done else "nothing was corrected")
    )
    return found.apply(frames, begin, end)


def camera_scene(
    frames: NDArray[Any], begin: NDArray[np.float64], end: NDArray[np.float64], notes: list[str]
) -> CameraScene:
    """Return the scene between a camera's frames.

    Where the camera itself rests, what differs from frame to frame by no more than noise rests as well; where
    all moves slowly that would make steps of it.
    """
    gains = None
    scene = CameraScene(frames, begin, end)
    if is_stretched(frames):
        gains = estimate_stretches([scene.intensity(k) for k in range(len(scene))])
        notes.append("each frame was stretched to the full range of grey: undone as far as they tell")
        scene = CameraScene(frames, begin, end, gains=gains)
    return (
        CameraScene(denoise_resting_pixels(frames), begin, end, gains=gains) if camera_rests(scene) else scene
    )


def camera_rests(scene: CameraScene) -> bool:
    """Return whether most of the picture does not move in most of the times between frames looked at."""
    chosen = np.unique(np.linspace(0, len(scene) - 2, INTERVALS).astype(int))
    ways = [np.linalg.norm(scene.matched(int(k)).ahead, axis=-1) for k in chosen]
    return bool(np.median([np.median(way) for way in ways]) < REST)


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
    return VideoScene(linear_intensity(frames, path), times)


def linear_intensity(frames: NDArray[Any], path: Path) -> NDArray[np.float32]:
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
