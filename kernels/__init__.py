"""Warp kernels, CPU and CUDA from one source.

In the order of the pipeline:

- `compiler_flags`, `kept_headers`, `launch`, `threads`: how and where work runs and kernels are compiled, and
  how CPU work is spread over threads;
- `vector_math`, `vec4`, `random`: arithmetic on several pixels at once, loads and stores, random numbers;
- `scene_layers`, `scene_batch`, `scene_frames`, `scene_blur`, `scene_render`: scenes to intensity and flow;
- `stored_levels`: pictures of 8 bits, which a CPU's kernels look up as they are;
- `pixel_stages`: what an effect may do, and what the composed kernels are given;
- `pixel_codegen*`: statements of such a kernel as data (`pixel_codegen`), made from a sensor's stage
  functions (`_model`, `_events`, `_program`) and printed for CUDA, for the CPU, and for many models at once
  (`_trials`);
- `pixel_compile`: the printed kernels, compiled;
- `threshold_counts`, `threshold_events`, `threshold_levels`, `threshold_surrogates`: pixels that are nothing
  but a change detector;
- `event_keys`, `event_order`, `event_queue`, `event_probes`, `event_neighbours`: what becomes of events;
- `patch_structure`, `critic_*`: what training needs;
- `autograd_*`: the bridge to PyTorch, the only files that import it.

Nothing here imports from `dase`.
"""

if __name__ != "dase.kernels":
    raise ImportError("import dase.kernels, not kernels: a second copy would compile every kernel twice")
