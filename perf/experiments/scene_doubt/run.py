"""How much of what half the frames make has to be added so that plain sensors count as right.

    python -m perf.experiments.scene_doubt.run --scenes 20 --log out/scene_doubt.jsonl

Photographs shake before a sensor of thresholds alone; a camera films them at 25, 50 and 100 Hz with exposures
of a twentieth to a half of the interval, in 8 bits with noise. The sensor is fitted, and judged by several
shares. `SceneDoubtSettings.share` is read off the table. No recording and no reported set is looked at.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from perf.data_folder import default_images

SHARES = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5)
SIZE = (180, 135)


def shaken_photograph(rng: np.random.Generator, seconds: float) -> Any:
    """Return a photograph that shakes by some pixels at up to 6 Hz and turns a little, at 1 kHz."""
    import cv2

    import dase

    width, height = SIZE
    grey = dase.open_images(default_images()).background(rng).grey.astype(np.float32)
    grey = cv2.GaussianBlur(0.03 + 0.94 * grey / max(float(grey.max()), 1e-6), (0, 0), 0.9)
    grey = cv2.resize(grey, (width + 60, height + 60), interpolation=cv2.INTER_AREA)
    times = np.arange(0, seconds, 1e-3)
    path = np.zeros((3, len(times)))
    for axis, size in enumerate((10.0, 10.0, 0.03)):
        for frequency in rng.uniform(0.7, 6.0, 6):
            turn = 2 * np.pi * (frequency * times + rng.uniform())
            path[axis] += 0.6 * size / (1 + frequency / 2) * np.sin(turn)
    frames = np.empty((len(times), height, width), np.float32)
    for frame, (x, y, angle) in zip(frames, path.T, strict=True):
        move = cv2.getRotationMatrix2D((width / 2 + 30, height / 2 + 30), np.degrees(angle), 1.0)
        move[:, 2] += (x - 30, y - 30)
        cv2.warpAffine(grey, move, (width, height), dst=frame, flags=cv2.INTER_LINEAR,
                       borderMode=cv2.BORDER_REFLECT)  # fmt: skip
    return dase.VideoScene(np.clip(frames, 0.01, 1), times)


def errors_of(number: int, gap: float, pixels: int, device: str) -> dict[str, Any]:
    """Return the errors of a plain sensor by share, and its gate."""
    import dase
    from dase.effects import EFFECTS
    from dase.fitting import scene_doubt
    from dase.fitting.data_split import split_measurement
    from dase.fitting.measurement import Measurement, camera_scene
    from dase.fitting.model import fit_present_model

    rng = np.random.default_rng([number, 555])
    scene = shaken_photograph(rng, 1.2)
    on, off = 0.2 * np.exp(rng.uniform(-0.3, 0.3, 2))
    true = dase.Sensor(effects=(EFFECTS["threshold"](on=float(on), off=float(off)),))
    events = dase.simulate(scene, true, seed=number, device=device)
    times = scene.sample_times()
    dense, exposure = scene.frames(times), gap * float(rng.uniform(0.05, 0.5))
    begins = np.arange(times[0], times[-1] - exposure, gap)
    shown = [
        dense[(times >= b - 1e-9) & (times < b + max(exposure, 1.1e-3) - 1e-9)].mean(0)
        + 0.004 * rng.standard_normal(dense.shape[1:])
        for b in begins
    ]  # fmt: skip
    grey = np.clip(np.rint(255 * np.array(shown)), 0, 255).astype(np.uint8)
    camera = camera_scene(grey, begins, begins + exposure, [])
    evidence = split_measurement(Measurement(events, camera), pixels=pixels, seed=number, device=device)
    model = fit_present_model(evidence, dase.Sensor(), None, seed=number)
    whole = replace(scene_doubt.SCENE_DOUBT, share=1.0)
    full = scene_doubt.with_scene_doubt(evidence, camera, model, seed=number, settings=whole).report
    out = []
    for share in SHARES:
        part = full if full.doubt is None else replace(full, doubt=share * full.doubt)
        judged = model.judge(part, repeats=30, seed=7)
        out.append((judged.error, judged.gate, max(judged.families.values())))
    return {"number": number, "gap": gap, "exposure": exposure, "shares": out}


def table(lines: list[dict[str, Any]]) -> list[str]:
    """Return how many plain sensors count as right, by frame rate and share."""
    out = ["| frames | cases | " + " | ".join(f"share {s:g}" for s in SHARES) + " |"]
    out.append("|---|---|" + "---|" * len(SHARES))
    for gap in sorted({line["gap"] for line in lines}):
        mine = [line["shares"] for line in lines if line["gap"] == gap]
        cells = []
        for n in range(len(SHARES)):
            right = np.mean([case[n][0] <= case[n][1] for case in mine])
            cells.append(f"{100 * right:.0f} % ({np.median([case[n][0] for case in mine]):.2g})")
        out.append(f"| {1 / gap:.0f} Hz | {len(mine)} | " + " | ".join(cells) + " |")
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--pixels", type=int, default=1000)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="no scene begins after these")
    parser.add_argument("--log", type=Path, default=Path("out/scene_doubt.jsonl"))
    options = parser.parse_args()
    options.log.parent.mkdir(parents=True, exist_ok=True)
    begin = time.time()
    lines = (
        [json.loads(line) for line in options.log.read_text().splitlines()] if options.log.exists() else []
    )
    done = {(line["number"], line["gap"]) for line in lines}
    for number in range(options.scenes):
        for gap in (0.04, 0.02, 0.01):
            if (number, gap) in done or time.time() - begin > 60 * options.minutes:
                continue
            lines.append(errors_of(number, gap, options.pixels, options.device))
            with options.log.open("a") as log:
                log.write(json.dumps(lines[-1]) + "\n")
    print("\n".join(table(lines)))


if __name__ == "__main__":
    main()
