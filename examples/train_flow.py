"""From a recording of my camera to a network that tells optical flow from its events."""

# %% A recording; put the path of yours here. This one is made up, so that the example runs everywhere
from pathlib import Path

import numpy as np

import dase

RECORDING = Path("recording.h5")
if not RECORDING.exists():
    y, x = np.mgrid[:48, :64]
    times = np.arange(0, 1.5, 0.002)
    # 60 px/s to the right
    waves = [0.5 + 0.3 * np.sin(0.3 * (x - 60 * t)) * np.cos(0.2 * y) for t in times]
    scene = dase.VideoScene(np.array(waves, np.float32), times)
    seen = times[::25]
    frames = np.round(255 * scene.frames(seen)).astype(np.uint8)
    flow = np.zeros((len(seen), 2, 48, 64), np.float32)
    flow[:, 0] = 60.0
    events = dase.simulate(scene, "ideal", seed=1)
    dase.io.write(RECORDING, dase.io.Sequence(events, frames, seen, flow))

# %% The sensor: a preset, a file of `dase fit` or `dase train`, or as here fitted to the camera's own frames
fitted = dase.fit(dase.open_recording(RECORDING), "ideal", free=["threshold.on", "threshold.off"], pixels=200)
Path("fitted.toml").write_text(dase.dump_sensor(fitted.sensor))
print(fitted.sensor)

# %% Training on endless scenes before that sensor, in windows of 1/30 s. So small it teaches next to nothing:
# on a GPU take 64 channels, batches of 24 sequences of 3 windows of 128x128 pixels, 5000 steps, device="cuda"
network = dase.tasks.EvFlowNet(channels=8)
settings = dase.tasks.FlowTraining(steps=100, warm_up=20, average=0.95, log_every=10, learning_rate=2e-3)


def batches(first):
    """Return batches from a number on."""
    return dase.torch.Stream(
        "builtin", "fitted.toml", batch=4, steps=2, size=(48, 48), window=1 / 30, first_batch=first,
        backgrounds=8, objects=8, device="cpu",
    )  # fmt: skip


dase.tasks.train_flow(network, batches, "flow", settings)

# %% What the network makes of the recording; `aee` is the mean error where the file has the true flow
found = dase.tasks.evaluate("flow/checkpoint.pt", RECORDING, out="flow", device="cpu")
print(found)
