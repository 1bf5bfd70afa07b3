"""From a recording of my camera to a network that turns its events into video."""

# %% A recording; put the path of yours here. This one is made up, so that the example runs everywhere
from pathlib import Path

import numpy as np
import torch

import dase

RECORDING = Path("recording.h5")
if not RECORDING.exists():
    camera = dase.Sensor((dase.EFFECTS["threshold"](on=0.3, off=0.25), dase.EFFECTS["mismatch"](spread=0.1)))
    y, x = np.mgrid[:48, :64]
    times = np.arange(0, 1.5, 0.002)
    waves = [0.5 + 0.25 * np.sin(0.3 * x - 9 * t) + 0.2 * np.sin(0.25 * y + 6 * t) for t in times]
    scene = dase.VideoScene(np.array(waves, np.float32), times)
    seen = times[::10]
    frames = np.round(255 * scene.frames(seen)).astype(np.uint8)
    dase.io.write(RECORDING, dase.io.Sequence(dase.simulate(scene, camera, seed=1), frames, seen))

# %% The sensor: fitted to what the camera's own frames say; `dase.diagnose` asks which effects it needs
start = dase.load_sensor("ideal").with_effect(dase.EFFECTS["mismatch"]())
free = ["threshold.on", "threshold.off", "mismatch"]
fitted = dase.fit(dase.open_recording(RECORDING), start, free=free, pixels=200)
Path("fitted.toml").write_text(dase.dump_sensor(fitted.sensor))
print(fitted.sensor)

# %% Training on endless scenes before that sensor: a minute of one core for a small network, which shows that
# it works; good ones take an E2VidNet, batches of 12 sequences of 24 windows of 128x128 pixels, 7000 steps
device = "cuda" if torch.cuda.is_available() else "cpu"
torch.set_num_threads(1)  # more gain nothing for networks this small, and lose much on a busy machine
network = dase.tasks.FireNet()
settings = dase.tasks.ReconstructionTraining(
    steps=1000 if device == "cuda" else 200, warm_up=20, average=0.97, learning_rate=8e-3, device=device
)


def batches(first):
    """Return batches from a number on."""
    return dase.torch.Stream(
        "builtin", "fitted.toml", batch=3, steps=8, size=(32, 32), first_batch=first, augment=dase.torch.S2R,
        backgrounds=8, objects=8, device=device,
    )  # fmt: skip


dase.tasks.train_reconstruction(network, batches, "reconstruction", settings)

# %% The recording as a video, beside the camera's own frames
found = dase.tasks.evaluate("reconstruction/checkpoint.pt", RECORDING, out="reconstruction", device=device)
print(found)
