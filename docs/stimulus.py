"""Draw the pictures of docs/stimulus.md: `python docs/stimulus.py`, one minute."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from matplotlib.figure import Figure

import dase
from dase.fitting.screen_alignment import align_screen
from dase.scenes.screen_scene import ScreenScene, ScreenView, apply_homography
from dase.scenes.screen_stimulus import ScreenStimulus

HERE = Path(__file__).parent
CAMERA = (173, 130)
"""Half of a DAVIS346."""
CORNERS = np.array([[12, 26], [163, 18], [158, 108], [17, 103]], np.float32)


def draw_contact_sheet(stimulus: ScreenStimulus) -> None:
    """Draw a frame of each segment."""
    figure = Figure(figsize=(11, 5.2))
    chosen = [(0.5, 0), (0.25, 1), (0.45, 2), (0.05, 3), (0.15, 3), (0.5, 4), (0.05, 5), (0.2, 5), (0.4, 6),
              (0.6, 7), (0.3, 8), (0.7, 8)]  # fmt: skip
    for n, (share, number) in enumerate(chosen):
        segment = stimulus.segments[number]
        frame = int(segment.begin + share * (segment.end - segment.begin))
        axes = figure.add_subplot(3, 4, n + 1)
        axes.imshow(stimulus.picture(frame), cmap="gray", vmin=0, vmax=255, interpolation="antialiased")
        axes.set_title(f"{segment.kind}, {frame / stimulus.refresh:.2f} s", fontsize=9)
        axes.set(xticks=[], yticks=[])
    figure.tight_layout()
    figure.savefig(HERE / "stimulus.png", dpi=90)


def draw_events(stimulus: ScreenStimulus) -> None:
    """Draw events of a simulated camera, and where the alignment says that the screen is."""
    width, height = stimulus.size
    screen = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    true = ScreenView(*CAMERA, cv2.getPerspectiveTransform(screen, CORNERS), 0.8, 1.0007, 0.015)
    events = dase.simulate(ScreenScene(stimulus, true, gamma=2.35), "davis346", seed=1)
    found = align_screen(events, stimulus)
    print(*found.notes, sep="\n")
    figure = Figure(figsize=(11, 5.4))
    marks = stimulus.segment_of("marks").begin / stimulus.refresh
    for n, (title, time, window) in enumerate(
        (
            ("marks", marks + 0.2, 0.05),
            ("steps", stimulus.segment_of("steps").begin / stimulus.refresh + 0.5, 0.03),
            ("ladder, at rest", stimulus.segment_of("ladder").begin / stimulus.refresh + 0.3, 1.2),
            ("ramps", stimulus.segment_of("ramps").begin / stimulus.refresh + 0.5, 0.03),
            ("chirp", stimulus.segment_of("chirp").begin / stimulus.refresh + 1.5, 0.03),
            ("edges", stimulus.segment_of("edges").begin / stimulus.refresh + 0.5, 0.03),
        )
    ):
        begin = found.view.offset + found.view.pace * time
        part = events.select((events.t >= begin) & (events.t < begin + window))
        picture = np.zeros((*CAMERA[::-1], 3)) + 0.12
        for polarity, colour in ((True, (0.95, 0.45, 0.1)), (False, (0.2, 0.5, 1.0))):
            count = np.zeros(CAMERA[::-1])
            np.add.at(count, (part.y[part.p == polarity], part.x[part.p == polarity]), 1)
            picture += np.clip(count / 4, 0, 1)[..., None] * (np.array(colour) - 0.12)
        axes = figure.add_subplot(2, 3, n + 1)
        axes.imshow(np.clip(picture, 0, 1), extent=(0, CAMERA[0], CAMERA[1], 0), interpolation="nearest")
        x, y = apply_homography(found.view.homography, *screen[[0, 1, 2, 3, 0]].T)
        axes.plot(x, y, color="lime", linewidth=0.8)
        axes.set_title(f"{title}, {1e3 * window:.0f} ms", fontsize=9)
        axes.set(xticks=[], yticks=[])
    figure.tight_layout()
    figure.savefig(HERE / "stimulus-events.png", dpi=90)


if __name__ == "__main__":
    draw_contact_sheet(ScreenStimulus())
    draw_events(ScreenStimulus())
