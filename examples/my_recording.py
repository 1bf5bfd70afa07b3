"""My recording: open it, look at it, ask which effect my model of the camera lacks."""

# %% A recording to work with; leave this out where you have one of your own
import numpy as np

import dase
from dase.io.sequence import Sequence

x, y = np.meshgrid(np.arange(96), np.arange(64))
times = np.arange(
    0, 0.5, 0.001
)  # a camera's frames come less often; dase then follows the motion between them
waves = [0.5 + 0.3 * np.sin(0.2 * (x + 0.4 * y) - 40 * t) + 0.15 * np.sin(0.5 * y - 25 * t) for t in times]
frames = np.rint(255 * np.clip(waves, 0.01, 1)).astype(np.uint8)
camera = dase.load_sensor("ideal").with_effect(dase.EFFECTS["bandwidth"](cutoff=30.0))
events = dase.simulate(frames, camera, times=times, seed=1)
dase.io.write("recording.h5", Sequence(events, frames, times))

# %% Open it: of any format, checked; what was repaired or looks odd is said
recording = dase.open_recording("recording.h5")
print(recording)

# %% Look at it; in a notebook the last line of a cell is shown
dase.plot(recording).savefig("recording.png")

# %% What it shows by itself, without a scene and without a model
print(dase.find_signatures(recording))

# %% How far is a model from it, where does it fail?
print(dase.compare(recording, "ideal", pixels=300))

# %% Which effect does the model lack? Each is fitted, and judged on pixels and times that no fit has seen
found = dase.diagnose(recording, "ideal", most=1, pixels=300)
print(found)
dase.plot(found).savefig("staircase.png")

# %% Keep the fitted model, for `dase.load_sensor("fitted.toml")`
with open("fitted.toml", "w", encoding="utf-8") as file:
    file.write(dase.dump_sensor(found.sensor))
