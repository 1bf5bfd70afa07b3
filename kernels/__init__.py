"""Warp kernels, CPU and CUDA from one source.

In the order of the pipeline:

- `launch`: where work runs, and how CPU work is spread over threads;
- `scene`: moving textured layers to intensity and flow;
- `blur`: pictures through a lens;
- `pixel`: the effects of a sensor composed into one kernel, intensity to counts or events;
- `events`: sort and decode what `pixel` emitted, and see what an event has near it;
- `patches`: the structure of image and count-map patches;
- `autograd`, `autograd_scene`, `autograd_training`: the bridge to PyTorch, the only files that import it.

Nothing here imports from `dase`.
"""

if __name__ != "dase.kernels":
    raise ImportError("import dase.kernels, not kernels: a second copy would compile every kernel twice")
