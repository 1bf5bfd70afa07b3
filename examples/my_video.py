"""My video, or any array of frames: events of a camera, what a parameter does to them, files for others."""

# %% Frames of linear intensity, shape (F, H, W); `dase.open_video("clip.mp4")` makes a scene of a file
import numpy as np

import dase

x, y = np.meshgrid(np.arange(128), np.arange(96))
places = 20 + 0.3 * np.arange(300)  # a bright ball that crosses a grey wall, px
ball = [0.3 + 0.6 * np.exp(-((x - place) ** 2 + (y - 48) ** 2) / 150) for place in places]
frames = np.array(ball, np.float32)

# %% Events of a DAVIS346 at 1000 frames per second: .t [s], .x, .y, .p
events = dase.simulate(frames, "davis346", fps=1000, seed=1)
print(events)
print(dase.load_sensor("davis346"))

# %% Show them; `dase.plot` takes recordings and findings as well
dase.plot(events).savefig("events.png")

# %% What would another threshold do?
rates = dase.sweep(frames, "davis346", "threshold.on", [0.1, 0.15, 0.2, 0.3, 0.4], fps=1000)
print(rates)
dase.plot(rates).savefig("rates.png")

# %% As arrays for a network: 5 bins of time by rows and columns
print(dase.Voxels(5)(events, 0.0, 0.3).shape)

# %% Save them, and convert the file: the suffix says the format
dase.io.write("events.h5", events)
print(dase.io.convert("events.h5", "events.raw"), "events as Prophesee's cameras write them")
print(dase.io.read("events.raw").events)
