"""From a file to a measurement: events and the scene they are of, on one clock.

`Recording` is what a file holds, `Measurement` adds what the camera saw while it recorded, and `compare`,
`fit` and `diagnose` take either (see `as_measurement`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from dase import io
from dase.effects.optics_blur import OpticsBlur, blur_weights
from dase.errors import InputError
from dase.events import Events
from dase.fitting.frame_steps import comes_before_its_light
from dase.fitting.held_clips import holds_frames
from dase.fitting.held_parts import parts_that_are_held
from dase.fitting.screen_alignment import screen_scene
from dase.formatting import fit_to_screen, format_seconds
from dase.io.arrays import check_archive
from dase.io.sequence import Sequence
from dase.probes.stimulus import STIMULUS, Trust
from dase.recordings.recording import Recording, mask_of_region
from dase.results import Comparison, Diagnosis, Fit
from dase.scenes.between_frames import CameraScene
from dase.scenes.frame_alignment import PARTS, align
from dase.scenes.frame_denoising import denoise_resting_pixels
from dase.scenes.frame_motion import estimate_stretches, is_stretched
from dase.scenes.scene import Scene
from dase.scenes.screen_scene import ScreenScene
from dase.scenes.screen_stimulus import read_stimulus
from dase.scenes.video import VideoScene, are_dense, join_frames, open_video
from dase.simulation.sensor import Sensor

Found = TypeVar("Found", Comparison, Diagnosis, Fit)


@dataclass(frozen=True, repr=False)
class Measurement:
    """Events and the scene they are of, on one clock.

    Args:
        events: What was measured.
        scene: What the camera saw.
        trust: Where and when the scene is to be trusted; None for everywhere.
        notes: What was noticed while reading.
        span: First and last time that is compared [s]; None for all.
        lens: Through which the scene is seen, where the events have told it; None without one.
    """

    events: Events
    scene: Scene
    trust: Trust | None = None
    notes: tuple[str, ...] = ()
    span: tuple[float, float] | None = None
    lens: OpticsBlur | None = None

    @property
    def held(self) -> float:
        """Time for which the simulator of the events held each frame of a clip [s]; 0 if it did not."""
        return self.scene.held_for if isinstance(self.scene, VideoScene) else 0.0

    def __repr__(self) -> str:
        trust = "everywhere" if self.trust is None else "in part"
        lines = [f"Measurement, its scene trusted {trust}", f"  {self.events}", f"  {self.scene}"]
        return fit_to_screen([*lines, *(f"  note: {note}" for note in self.notes)])

    def part(
        self,
        begin: float | None = None,
        end: float | None = None,
        region: tuple[int, int, int, int] | None = None,
    ) -> Measurement:
        """Return the same measurement, of which only a part is compared.

        Args:
            begin: First time [s]; None for that of the measurement.
            end: Last time [s]; None for that of the measurement.
            region: First column and row, columns and rows; None for all pixels.

        Raises:
            InputError: The end is not after the begin, or the region is not on the sensor.
        """
        out = self
        if begin is not None or end is not None:
            span = -np.inf if begin is None else begin, np.inf if end is None else end
            if not span[0] < span[1]:
                raise InputError(f"the time to compare must not be empty, got {span[0]:g}..{span[1]:g} s")
            out = replace(out, span=span)
        if region is not None:
            mask = mask_of_region(region, self.events.width, self.events.height)
            out = out.within(mask)
        return out

    def within(self, mask: NDArray[np.bool_]) -> Measurement:
        """Return the same measurement, of which only some pixels are compared, shape (H, W)."""
        return replace(self, trust=_trust_within(mask, self.trust))

    def through_lens_of(self, sensor: Sensor) -> Measurement:
        """Return the measurement with its scene as the lens of a sensor shows it.

        Frames that the camera took itself, and what was found of a screen in its events, are left as they
        are: that lens has shown them already.

        Args:
            sensor: Its `optics_blur` is the lens; without one, or with one that is off, nothing changes.
        """
        lens, scene = lens_of(sensor), self.scene
        if lens is None or lens.is_off() or isinstance(scene, CameraScene | ScreenScene):
            return self
        if isinstance(scene, VideoScene):
            # its frames are compared, and held; seen through a lens already in a second way of a diagnosis
            seen: Scene = scene if scene.sharp is not None else scene.blurred(blur_weights(lens.sigma))
        else:
            seen = lens.seen(scene)
        return replace(self, scene=seen)

    def compared_events(self) -> Events:
        """Return the events of the time that is compared."""
        if self.span is None:
            return self.events
        begin, end = self.span
        return self.events.select((self.events.t >= begin) & (self.events.t <= end))

    def noted(self, found: Found) -> Found:
        """Return a finding with what was noticed while reading before its own notes."""
        return replace(found, notes=(*self.notes, *found.notes))


def lens_of(sensor: Sensor) -> OpticsBlur | None:
    """Return the lens of a sensor; None without one.

    What is compared is already seen through it, see `Measurement.through_lens_of`: models have none.
    """
    return next((one for one in sensor.effects if isinstance(one, OpticsBlur)), None)


def with_lens(sensor: Sensor, lens: OpticsBlur | None) -> Sensor:
    """Return a sensor with a lens, if there is one."""
    return sensor if lens is None else sensor.with_effect(lens)


Measured = Measurement | Recording | Events | str | PathLike[str]
"""What `compare`, `fit` and `diagnose` take: see `as_measurement`."""

SceneChoice = Scene | str | PathLike[str]
"""A scene, `frames` for the recording's own, `static` for light that does not change, or the path of a clip
or of the JSON of a stimulus that was shown."""


def as_measurement(
    measured: Measured, scene: SceneChoice | None = None, trust: Trust | None = None
) -> Measurement:
    """Return events and the scene they are of.

    Args:
        measured: A measurement, a recording, its path, or events.
        scene: What the camera saw. None for what `measured` knows: the scene of a measurement, the frames of
            a recording. Events alone know none.
        trust: Where and when the scene is to be trusted; None for what the scene and `measured` say of it.

    Raises:
        InputError: Events come without a scene, or the recording has no frames to take it from.
    """
    if isinstance(measured, Measurement):
        found = measured
        if scene is not None:
            said = list(measured.notes)
            seen = _chosen_scene(scene, measured.events, said)
            found = replace(measured, scene=seen, trust=_trust_of_scene(seen), notes=tuple(said))
    elif isinstance(measured, Recording):
        found = measurement_of(measured, "frames" if scene is None else scene)
    elif isinstance(measured, Events):
        if scene is None or (isinstance(scene, str) and scene == "frames"):
            raise InputError("events do not say what the camera saw: give the scene", argument="scene")
        said = []
        seen = _chosen_scene(scene, measured, said)
        found = Measurement(measured, seen, _trust_of_scene(seen), tuple(said))
    elif isinstance(measured, str | PathLike):
        found = open_measurement(Path(measured), "frames" if scene is None else scene)
    else:
        raise TypeError(f"expected a recording, its path, or events, got {type(measured).__name__}")
    return _as_shown(found if trust is None else replace(found, trust=trust))


def _as_shown(measurement: Measurement) -> Measurement:
    """Return a measurement with its clip at the times at which its frames were shown, by the events."""
    scene = measurement.scene
    if not isinstance(scene, VideoScene) or scene.early or scene.forgets:
        return measurement
    step = comes_before_its_light(measurement.events, scene)
    if step is not None:
        begun = scene.begun_early(step)
        note = (
            "events at a frame tell of the light after it: the clip is taken "
            f"{format_seconds(begun.early)} earlier"
        )
        return replace(measurement, scene=begun, notes=(*measurement.notes, note))
    parts = parts_that_are_held(measurement.events, scene)
    if not parts and not holds_frames(measurement.events, scene):
        return measurement
    shown = (scene.in_parts(parts) if parts else scene).held(STIMULUS.common_step)
    return replace(measurement, scene=shown, notes=(*measurement.notes, note_of_held_frames(shown, parts)))


def note_of_held_frames(scene: VideoScene, parts: int = 0) -> str:
    """Return what a user should know of a clip whose frames are held.

    Args:
        scene: As it is shown.
        parts: Pictures from frame to frame, each of which is held; 0 where it is the frames that are.
    """
    if parts:
        return (
            f"events tell of {parts} pictures from each frame of the clip to the next, each held for "
            f"{format_seconds(scene.held_for)}: between the frames light is taken to go straight"
        )
    return (
        f"events tell of each frame at the one before: the clip is taken {format_seconds(scene.held_for)} "
        "earlier, and each of its frames is held"
    )


def open_measurement(path: Path, scene: SceneChoice = "frames") -> Measurement:
    """Open a recording and its scene, see `measurement_of`; `Measurement.notes` say what reading noticed.

    Raises:
        InputError: Something is missing or damaged.
    """
    notes: list[str] = []
    # not `open_recording`: its survey of all events would be thrown away here
    return measurement_of(io.read(path, notes=notes, flow=False), scene, notes=notes, name=str(path))


def measurement_of(
    recorded: Recording | Sequence,
    scene: SceneChoice = "frames",
    *,
    notes: Iterable[str] = (),
    name: str = "the recording",
) -> Measurement:
    """Return a recording with its scene.

    Frames of a camera are too far apart to tell all that happened between them: there the scene follows the
    motion from frame to frame, and `Measurement.trust` says where it can be trusted. Frames as dense as the
    steps of a comparison, as those of a simulation may be, are joined by straight lines.

    Args:
        recorded: Events, and where it has them frames. Pixels outside the mask of a `Recording` are not
            trusted.
        scene: What the camera saw: `frames` for the recording's own, `static` for light that does not change,
            the path of a clip, a scene on the clock of the events, or the JSON of a stimulus, which is found
            in the events.
        notes: What reading it said, beside what a `Recording` reports.
        name: What messages call it.

    Raises:
        InputError: It has no events, or no frames to take the scene from, or the clip cannot be read.
    """
    said = list(notes)
    if isinstance(recorded, Recording):
        # what looks odd is the report's to say: it changes nothing here
        said += [note for note in recorded.report.notes if note.kind != "odd"]
    if len(recorded.events) == 0:
        raise InputError(f"{name} has no events, so there is nothing to compare")
    own = isinstance(scene, str) and scene == "frames"
    seen = scene_of_frames(recorded, name, said) if own else _chosen_scene(scene, recorded.events, said)
    trust = _trust_of_scene(seen)
    if isinstance(recorded, Recording) and not recorded.mask.all():
        trust = _trust_within(recorded.mask, trust)
    return Measurement(recorded.events, seen, trust, tuple(said))


def _chosen_scene(scene: SceneChoice, events: Events, notes: list[str]) -> Scene:
    if isinstance(scene, Scene):
        return scene
    if not isinstance(scene, str | PathLike):
        raise InputError(
            f"scene: must be a dase.Scene, 'frames', 'static' or a path, got {type(scene).__name__}; "
            "dase.VideoScene(frames, times) makes one of frames",
            argument="scene",
        )
    if scene == "static":
        return static_scene(events)
    path = Path(scene)
    if path.suffix.lower() == ".json" and not path.is_dir():
        return screen_scene(events, read_stimulus(path), notes)
    return open_clip(path, notes)


def _trust_of_scene(scene: Scene) -> Trust | None:
    """Return what a scene says of where and when it can be trusted, None for everywhere."""
    return scene.is_trusted if isinstance(scene, CameraScene | ScreenScene) else None


def _trust_within(mask: NDArray[np.bool_], trust: Trust | None) -> Trust:
    """Return a trust that ends where a mask of pixels does, shape (H, W)."""
    inside = mask.reshape(-1)

    def within(times: NDArray[np.float64], pixels: NDArray[np.int32]) -> NDArray[np.bool_]:
        everywhen = np.broadcast_to(inside[pixels], (len(times), len(pixels)))
        return everywhen if trust is None else everywhen & trust(times, pixels)

    return within


def static_scene(events: Events, *, intensity: float = 0.5) -> VideoScene:
    """Return light of one intensity that does not change, as long as the events last.

    Args:
        events: At least one; the scene has their size and begins with the first.
        intensity: Of all pixels, in [0, 1]. How bright it was nobody knows: the middle of the range.
    """
    frames = np.full((2, events.height, events.width), intensity, np.float32)
    begin, end = float(events.t[0]), float(events.t[-1])
    return VideoScene(frames, [begin, max(end, begin + 1e-3)])


def scene_of_frames(recorded: Recording | Sequence, name: str, notes: list[str]) -> Scene:
    """Return the scene of a recording's own frames.

    Args:
        recorded: Events and frames.
        name: What messages call it.
        notes: Gets what was found out about the frames.

    Raises:
        InputError: There are not two frames, or their times are not known.
    """
    if recorded.frames is None or len(recorded.frames) < 2:
        raise InputError(
            f"{name} has no frames to take the scene from; give a clip of what the camera saw, or 'static' "
            "where it saw nothing move",
            argument="scene",
        )
    times = recorded.frame_times
    if times is None:
        raise InputError(f"{name}: its frames have no times, so they cannot be laid beside the events")
    if are_dense(times):
        return _scene_of_values(recorded.frames, times, name, notes)
    return scene_between_frames(recorded, notes)


def scene_between_frames(recorded: Recording | Sequence, notes: list[str]) -> CameraScene:
    """Return the scene between the frames of a recording, laid on its events.

    Args:
        recorded: Events and frames.
        notes: Gets what was found out about the frames.

    Raises:
        InputError: There are not two frames, or their times are not known.
    """
    times = recorded.frame_times
    if recorded.frames is None or len(recorded.frames) < 2 or times is None:
        raise InputError("the scene between frames needs at least 2 frames with known times")
    begin, end = _exposures(recorded, times)
    frames, begin, end = align_with_events(recorded.events, recorded.frames, begin, end, notes)
    return camera_scene(frames, begin, end, notes)


def _exposures(
    recorded: Recording | Sequence, times: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return begin and end of each exposure [s], (F,) each: an instant where the exposure is not known."""
    if isinstance(recorded, Sequence):
        half = 0.5 * (np.zeros(len(times)) if recorded.frame_exposure is None else recorded.frame_exposure)
        return times - half, times + half
    if recorded.frame_begin is None or recorded.frame_end is None:
        return times, times
    return recorded.frame_begin, recorded.frame_end


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

    Args:
        frames: Grey values, of any real type, shape (F, H, W).
        begin: Begin of each exposure [s], shape (F,).
        end: End of each exposure [s], shape (F,).
        notes: Gets a sentence where frames were stretched.
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


def camera_rests(scene: CameraScene, *, looks: int = 8, movement: float = 0.1) -> bool:
    """Return whether most of the picture does not move in most of the times between frames.

    Args:
        scene: Between frames.
        looks: Times between frames that are looked at, spread evenly.
        movement: Half of all pixels must move by less from one frame to the next [px].
    """
    chosen = np.unique(np.linspace(0, len(scene) - 2, looks).astype(int))
    ways = [np.linalg.norm(scene.matched(int(k)).ahead, axis=-1) for k in chosen]
    return bool(np.median([np.median(way) for way in ways]) < movement)


def open_clip(path: Path, notes: list[str] | None = None) -> Scene:
    """Return the scene of a video, of a folder of pictures, or of an archive with `frames` and `frame_us`.

    Args:
        path: Of the clip.
        notes: Gets sentences about what was assumed, as of what is between frames that are far apart.
    """
    if not path.exists():
        raise InputError(f"scene {path} does not exist")
    if path.suffix.lower() != ".npz":
        return open_video(path, notes=notes)
    try:
        check_archive(path, ("frames", "frame_us"))
        with np.load(path, allow_pickle=False) as data:
            missing = [name for name in ("frames", "frame_us") if name not in data]
            if missing:
                raise InputError(f"scene {path} has no '{missing[0]}', got {', '.join(data) or 'nothing'}")
            frames, times = data["frames"], data["frame_us"] * 1e-6
    except InputError as error:
        raise InputError(f"scene {path}: {error}" if str(path) not in str(error) else str(error)) from error
    except Exception as error:  # numpy, zipfile and zlib have no common error for damaged files
        raise InputError(f"scene {path} cannot be read as an archive of frames: {error}") from error
    return _scene_of_values(frames, times, path, notes)


def _scene_of_values(
    frames: NDArray[Any], times: NDArray[np.float64], name: Path | str, notes: list[str] | None
) -> Scene:
    """Return the scene of frames (F, H, W) at times (F,) [s]; messages say whose frames they are."""
    try:
        return join_frames(frames, times, notes=notes)
    except InputError as error:
        raise InputError(f"scene {name}: {error}") from None
