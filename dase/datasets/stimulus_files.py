"""Files that a user can show to a camera: a video for a screen, a sheet for printing, a protocol."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from dase.effects import EFFECTS
from dase.errors import InputError
from dase.figures.printed_sheet import write_sheet
from dase.fitting.screen_limits import screen_limits_of
from dase.io.sequence import replacing
from dase.io.video_writer import VideoCodec, open_video_writer
from dase.scenes.screen_stimulus import ScreenStimulus, truth_text

VIDEOS = {
    ".mkv": (VideoCodec("FFV1", lossless=True),),
    ".avi": (VideoCodec("FFV1", lossless=True),),
    ".mp4": (VideoCodec("avc1", True), VideoCodec("mp4v")),
}
"""How videos are packed by their suffix, the best first."""
SHEETS = (".pdf", ".svg", ".png")
PROTOCOLS = (".md", ".txt")


@dataclass(frozen=True)
class StimulusJob:
    """What to write.

    Args:
        stimulus: For a screen.
        paper: Of the sheet, one of `dase.figures.printed_sheet.PAPERS`.
        dpi: Dots per inch of a sheet in a PNG.
    """

    stimulus: ScreenStimulus
    paper: str = "a4"
    dpi: float = 300.0


def write_stimulus(
    job: StimulusJob, out: Path, *, progress: Callable[[int, int], None] = lambda done, of: None
) -> list[Path]:
    """Write what a user can show to a camera; return the files.

    Args:
        job: What to write.
        out: A video (.mkv, .avi, .mp4) with its JSON beside it, a sheet (.pdf, .svg, .png), a protocol (.md,
            .txt), or a folder for all of them.
        progress: Told how many frames of the video are done, of how many.

    Raises:
        InputError: The suffix is not known, or the video cannot be written here.
    """
    suffix = out.suffix.lower()
    if suffix in VIDEOS:
        return [out, _write_video(job.stimulus, out, progress)]
    if suffix in SHEETS:
        write_sheet(out, paper=job.paper, dpi=job.dpi)
        return [out]
    if suffix in PROTOCOLS:
        return [_write_text(out, protocol_text(job.stimulus))]
    if suffix and not out.is_dir():
        known = ", ".join((*VIDEOS, *SHEETS, *PROTOCOLS))
        raise InputError(f"{out}: must be a folder, or end with one of {known}")
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file, not a folder")
    out.mkdir(parents=True, exist_ok=True)
    told = write_sheet(out / "sheet.pdf", paper=job.paper, dpi=job.dpi)
    files = [out / "sheet.pdf", _write_text(out / "sheet.json", json.dumps(told, indent=1) + "\n")]
    files.append(_write_text(out / "protocol.md", protocol_text(job.stimulus)))
    video = out / "stimulus.mkv"
    return [video, _write_video(job.stimulus, video, progress), *files]


def _write_text(path: Path, text: str) -> Path:
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


def _write_video(stimulus: ScreenStimulus, path: Path, progress: Callable[[int, int], None]) -> Path:
    """Write the video and the JSON beside it; return the name of the JSON."""
    with replacing(path) as temporary:
        out, _ = open_video_writer(temporary, stimulus.refresh, stimulus.size, VIDEOS[path.suffix.lower()])
        if out is None:
            raise InputError(f"{path}: OpenCV cannot write this video; .mkv, .avi and .mp4 are known")
        try:
            for frame in range(stimulus.frame_count):
                # three equal channels: a video of grey values alone is of limited range to some players
                out.write(cv2.cvtColor(np.ascontiguousarray(stimulus.picture(frame)), cv2.COLOR_GRAY2BGR))
                progress(frame + 1, stimulus.frame_count)
        finally:
            out.release()
    return _write_text(path.with_suffix(".json"), truth_text(stimulus, path.name))


def protocol_text(stimulus: ScreenStimulus) -> str:
    """Return what to do with the screen, the sheet, an LED and a lens cap, in Markdown."""
    width, height = stimulus.size
    return "\n".join(
        (
            "# What to show to an event camera",
            "",
            *_numbered(
                "Lens cap, 60 s",
                "Put the cap on and darken the room. Record 60 s.",
                "`dase info cap.raw --signatures` tells hot pixels and noise; `dase fit SENSOR cap.raw "
                "--scene static --free shot,leak,hot -o fitted.toml` fits them.",
            ),
            *_numbered(
                "Even light at rest, 60 s",
                "Take the cap off, defocus, and point the camera at a matt sheet lit by daylight or by an "
                "LED on DC, not by a lamp on the mains. Record 60 s.",
                "`dase fit SENSOR light.raw --scene static --free leak,shot -o fitted.toml` fits them.",
            ),
            *_numbered(
                f"Screen, {stimulus.duration:.0f} s",
                f"Set the screen to {stimulus.refresh:g} Hz, full brightness (dimmed backlights flicker), no "
                "night mode, no HDR, no dynamic contrast. Fix the camera before it, all of the screen in the "
                "picture and in focus, the room dark.",
                f"Play stimulus.mkv pixel for pixel: on a screen of more than {width}x{height}, in the "
                "middle without scaling (`mpv --fs --video-unscaled=yes --video-sync=display-resample "
                "stimulus.mkv`). Begin to record before it and end after it.",
                "`dase fit SENSOR screen.raw --stimulus stimulus.json -o fitted.toml`.",
            ),
            *_numbered(
                "Print, 10 s",
                "Fix the sheet to something flat in daylight and move it, or the camera, slowly and then "
                "fast, with stops. Check the 100 mm line first.",
                "`dase compare SENSOR print.aedat4` where the camera has frames.",
            ),
            *_numbered(
                "LED, 35 s",
                "Let an LED on a function generator light a matt sheet that fills the picture, defocused. "
                "Its current is light: a square wave from 20 % to 80 % is a step of 1.39 in log light.",
                *_led_times(),
                "`dase info led.raw --signatures` reads the frequency back.",
            ),
            "## What a screen cannot tell",
            "",
            *(
                f"- `{name}`: {limit}."
                for name, limit in screen_limits_of(EFFECTS.values(), stimulus).items()
            ),
            "",
        )
    )


def _numbered(title: str, *steps: str) -> Iterable[str]:
    yield f"## {title}"
    yield ""
    yield from (f"{n}. {step}" for n, step in enumerate(steps, 1))
    yield ""


def _led_times() -> Iterable[str]:
    """Yield what an LED does and when."""
    time = 0.0
    for seconds, what in (
        (2, "constant, 50 %"),
        (5, "square wave of 1 Hz, 20 % to 80 %: delays and cutoffs"),
        (5, "square wave of 10 Hz"),
        (5, "square wave of 100 Hz"),
        (5, "square wave of 1000 Hz: dead time, time stamps"),
        (8, "sine sweep of 1 Hz to 2 kHz, 50 % ± 30 %: bandwidth"),
        (5, "single pulses of 1 ms each second, 5 % to 100 %: how full the bus gets"),
    ):
        yield f"{time:g} s to {time + seconds:g} s: {what}."
        time += seconds
