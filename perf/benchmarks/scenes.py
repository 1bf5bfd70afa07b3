"""How near the scene between frames is to the truth, and how it agrees with the events of real cameras.

    python -m perf.benchmarks.scenes [--recordings FOLDER] [--picture docs/frames.png] [--out FOLDER]

The truth is a photograph under two fast cut-outs, seen by a camera of 25 frames a second with exposure and
noise. With recordings it prints the alignments of a DAVIS346 and of a DAVIS240C, and how events and scene
agree inside the times between frames. `--picture` draws the DAVIS346 (cuke-emlb, MIT); recordings without a
licence are drawn into FOLDER only.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from reference.scene_frames import film, moving_picture

import dase
from dase.figures import trust_figure
from dase.kernels import launch
from dase.scenes.frame_denoising import denoise_resting_pixels
from dase.scenes.frame_motion import estimate_stretches

EPS = 1e-3
BAD = 0.25
CASES = ((1.0, 0.0, 1e-3), (1.0, 0.01, 0.01), (2.5, 0.01, 0.01), (2.5, 0.004, 0.02), (5.0, 0.004, 0.005))
"""Speed [widths/s of the fastest], noise [of white], exposure [s]."""

RULES = {"everything": (1e9, 0.0), "strict, relative=0": (0.2, 0.0), "default": (0.2, 0.5)}
"""Tolerance and relative tolerance."""


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def truth(seeds: range) -> None:
    """Print errors of log intensity at three times between all frames."""
    print(
        "| speed | noise | exposure | mask | pixels | rms | straight | bad | bad found | of the masked, bad |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for speed, noise, exposure in CASES:
        errors, straights, masks = [], [], {name: [] for name in RULES}
        for seed in seeds:
            rng = np.random.default_rng(1000 + seed)
            scene = moving_picture(rng, speed=speed)
            begin, end, frames = film(scene, rng, noise=noise, exposure=exposure)
            camera = dase.CameraScene(frames, begin, end)
            gaps = np.diff(camera.times)
            times = np.sort(np.concatenate([camera.times[:-1] + s * gaps for s in (0.25, 0.5, 0.75)]))
            k = camera.interval(times)
            share = ((times - camera.times[k]) / gaps[k])[:, None, None]
            logs, want = np.log(frames / 255 + EPS), np.log(scene.frames(times) + EPS)
            errors.append(np.log(camera.frames(times) + EPS) - want)
            straights.append((1 - share) * logs[k] + share * logs[k + 1] - want)
            for name, (tolerance, relative) in RULES.items():
                masks[name].append(camera.trusted(tolerance=tolerance, relative=relative)[k])
        error, straight = np.concatenate(errors), np.concatenate(straights)
        bad = np.abs(error) > BAD
        for name, parts in masks.items():
            use = np.concatenate(parts)
            found = " | " if use.all() else f"{(bad & ~use).sum() / bad.sum():.2f} | {bad[~use].mean():.2f}"
            print(
                f"| {speed:g} | {noise:g} | {1e3 * exposure:g} ms | {name} | {use.mean():.2f} "
                f"| {rms(error[use]):.3f} | {rms(straight[use]):.3f} | {bad[use].mean():.3f} | {found} |"
            )


def speed() -> None:
    """Print how long 0.5 s of a DAVIS346 take at 1 kHz, all pixels and a tenth of them."""
    rng = np.random.default_rng(0)
    begin, end, frames = film(moving_picture(rng, width=346, height=260, duration=0.52), rng)
    device, size = launch.find_device("cpu"), 346 * 260
    for name, pixels in (("all", np.arange(size)), ("a tenth", rng.permutation(size)[: size // 10])):
        camera = dase.CameraScene(frames, begin, end)
        camera.frames(camera.times[:1])  # compiles
        started, used = time.perf_counter(), time.process_time()
        times = np.arange(camera.times[0], camera.times[-1], 1e-3)
        for first in range(0, len(times), 64):
            camera.source(times[first : first + 64], pixels.astype(np.int32), device)
        spent, worked = time.perf_counter() - started, time.process_time() - used
        print(
            f"{len(times)} samples of 346x260, {name} pixels: {spent:.2f} s, {worked:.2f} s of CPU, motion "
            f"included; its own sampling: {len(camera.sample_times())} samples"
        )


def load(folder: Path, name: str):
    """Return events, frames, begin and end [s]."""
    held = np.load(folder / f"{name}.npz")
    width, height = (int(n) for n in held["wh"])
    events = dase.Events(1e-6 * held["t_us"], held["x"], held["y"], held["p"] > 0, width, height)
    return events, held["frames"], 1e-6 * held["frame_begin_us"], 1e-6 * held["frame_end_us"]


def agreement(events, scene, lag: float, parts: int = 4, soft: float = 0.03) -> None:
    """Print how net events and changes of log intensity correlate in quarters of the times between frames."""
    sums = {(mask, kind): np.zeros(5) for mask in RULES for kind in ("scene", "straight")}
    masks = {name: scene.trusted(tolerance=t, relative=r) for name, (t, r) in RULES.items()}
    kept = dict.fromkeys(RULES, 0)
    for k in range(len(scene) - 1):
        edges = np.linspace(scene.times[k], np.nextafter(scene.times[k + 1], 0), parts + 1)
        counts = events.counts(edges + lag)
        net = (counts[:, 1] - counts[:, 0]).clip(-20, 20).astype(float)
        ends = np.log(np.stack([scene.intensity(k), scene.intensity(k + 1)]) + soft)
        changes = {
            "scene": np.diff(np.log(scene.frames(edges) + soft), axis=0),
            "straight": np.repeat(np.diff(ends, axis=0) / parts, parts, 0),
        }
        for name, mask in masks.items():
            use = mask[k]
            kept[name] += counts[:, :, use].sum()
            for kind, change in changes.items():
                e, c = net[:, use].ravel(), change[:, use].ravel()
                sums[name, kind] += (e @ c, e @ e, c @ c, e.size, 0)
    total = kept["everything"]
    for name in RULES:
        said = [f"{a / np.sqrt(b * c):.3f}" for a, b, c, *_ in (sums[name, k] for k in ("scene", "straight"))]
        pixels = sums[name, "scene"][3] / sums["everything", "scene"][3]
        slope = sums[name, "scene"][0] / sums[name, "scene"][2]
        print(
            f"  {name:20s} pixels {pixels:.2f}, events {kept[name] / total:.2f}: correlation {said[0]}, "
            f"straight {said[1]}; {slope:.2f} events per log intensity"
        )


def recordings(folder: Path, picture: Path | None, out: Path | None) -> None:
    """Print alignments and agreements, and draw."""
    events, frames, begin, end = load(folder, "davis346_cuke_cradle")
    print("\ndavis346_cuke_cradle\n" + dase.align(events, frames, begin, end).report())
    scene = dase.CameraScene(frames, begin, end)
    agreement(events, scene, 5e-3)
    quiet = denoise_resting_pixels(frames)
    print(f"  steady: {np.mean(np.diff(quiet, axis=0) == 0):.2f} of all pixels rest from a frame to the next")
    if picture is not None:
        picture.parent.mkdir(parents=True, exist_ok=True)
        trust_figure.draw_trust(scene, events, title="Newton's cradle before a DAVIS346", moments=3).savefig(
            picture
        )
    events, frames, begin, end = load(folder, "davis240c_camerashake")
    light = list(frames / np.float32(255))
    gains = estimate_stretches(light)
    for share in (0.5, 0.75, 1.0):
        exposed = begin + share * (end - begin)
        found = dase.align(events, frames, begin, exposed, gains=gains)
        print(f"\ndavis240c_camerashake, exposure taken to be {share:g} of each window\n" + found.report())
    plain = dase.align(events, frames, begin, begin + 0.75 * (end - begin))
    print(f"\nwithout gains, 0.75: correlation {plain.score:.3f}")
    shaken = slice(37, 60)  # windows of this part follow each other, as far as events tell
    part = frames[shaken], begin[shaken], (begin + 0.75 * (end - begin))[shaken]
    scene = dase.CameraScene(*part, gains=gains[shaken])
    agreement(events, scene, 5e-3)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        trust_figure.draw_trust(scene, events, title="davis240c_camerashake").savefig(out / "camerashake.png")


def main() -> None:
    """Print everything."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--recordings", type=Path)
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--seeds", type=int, default=6)
    chosen = parser.parse_args()
    speed()
    truth(range(chosen.seeds))
    if chosen.recordings is not None:
        recordings(chosen.recordings, chosen.picture, chosen.out)


if __name__ == "__main__":
    main()
