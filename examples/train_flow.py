"""From a recording of my camera to a network that tells optical flow from its events."""

# %% A recording; put the path of yours here. This one is made up, so that the example runs everywhere
from pathlib import Path

import numpy as np
import torch

import dase

RECORDING = Path("recording.h5")
if not RECORDING.exists():
    # a random pattern, 240 px/s to the right
    right, down, phase = np.random.default_rng(1).uniform(-0.6, 0.6, (3, 20, 1, 1))
    y, x = np.mgrid[:48, :64]
    times = np.arange(0, 1.5, 0.002)
    moving = [np.sin(right * (x - 240 * t) + down * y + 9 * phase).mean(0) for t in times]
    scene = dase.VideoScene(np.clip(0.5 + np.array(moving, np.float32), 0.1, 1), times)
    seen = times[::5]
    frames = np.round(255 * scene.frames(seen)).astype(np.uint8)
    flow = np.zeros((len(seen), 2, 48, 64), np.float32)
    flow[:, 0] = 240.0
    events = dase.simulate(scene, "ideal", seed=1)
    dase.io.write(RECORDING, dase.io.Sequence(events, frames, seen, flow))

# %% The sensor: a preset, a file of `dase fit` or `dase train`, or as here fitted to the camera's own frames
fitted = dase.fit(dase.open_recording(RECORDING), "ideal", free=["threshold.on", "threshold.off"], pixels=200)
Path("fitted.toml").write_text(dase.dump_sensor(fitted.sensor))
print(fitted.sensor)

# %% Training on endless scenes before that sensor, shaken by a hand, in windows of 1/120 s: things move about
# 3 px in one, and a network learns fastest from few pixels of motion. A minute or two of one core, and one of
# a GPU for a larger network; better ones take 32 to 64 channels, 112x112 pixels, 12000 steps
device = "cuda" if torch.cuda.is_available() else "cpu"
torch.set_num_threads(1)  # more gain nothing for networks this small, and lose much on a busy machine
channels, batch, side, steps = (16, 32, 64, 4000) if device == "cuda" else (8, 8, 48, 2000)
window = 1 / 120
network = dase.tasks.EvFlowNet(channels=channels)
settings = dase.tasks.FlowTraining(
    steps=steps, window=window, average=0.99, learning_rate=2e-3, device=device
)


def batches(first):
    """Return batches from a number on."""
    return dase.torch.Stream(
        "builtin", "fitted.toml", batch=batch, steps=1, size=(side, side), window=window, regimes=("shake",),
        first_batch=first, backgrounds=8, objects=8, device=device,
    )  # fmt: skip


dase.tasks.train_flow(network, batches, "flow", settings)

# %% What the network makes of the recording; `aee` is the mean error where the file has the true flow,
# `aee_zero` that of no flow at all
found = dase.tasks.evaluate("flow/checkpoint.pt", RECORDING, out="flow", device=device)
print(found)
