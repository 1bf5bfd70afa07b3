"""Where kernels run, and how CPU work is spread over threads.

Warp runs a CPU launch on one thread and releases the GIL meanwhile, so a launch is cut into slabs that a
thread pool works off. Every kernel that goes through `run_kernel` takes the start of its slab as first
argument.
"""

from __future__ import annotations

import os
import sys
import tempfile
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np
import warp as wp

from dase.kernels.kept_headers import keep_headers
from dase.kernels.threads import keep_thread_count
from dase.kernels.threads import thread_count as thread_count

wp.config.log_level = wp.LOG_WARNING

Result = TypeVar("Result")

_pool: ThreadPoolExecutor | None = None
_starting = threading.Lock()
_started = False


def set_threads(count: int) -> None:
    """Use `count` CPU threads from now on; worker processes use one each."""
    global _pool
    keep_thread_count(count)
    if _pool is not None:
        _pool.shutdown()
    _pool = None


def find_device(name: str) -> wp.Device:
    """Return the Warp device of a backend name.

    Args:
        name: `cpu`, `cuda` (the first GPU) or a Warp name such as `cuda:1`.

    Raises:
        ValueError: There is no such device on this machine.
    """
    _start_warp()
    if name.startswith("cuda") and not wp.is_cuda_available():
        raise ValueError(f"device '{name}' needs an NVIDIA GPU with a driver, none was found; use 'cpu'")
    try:
        return wp.get_device("cuda:0" if name == "cuda" else name)
    except ValueError as error:
        names = ", ".join(d.alias for d in wp.get_devices())
        raise ValueError(f"device '{name}' does not exist, here there are: {names}") from error


def lend_tensor(tensor: Any, dtype: Any = None) -> Any:
    """Return a Warp array over the memory of a PyTorch tensor, without a copy.

    Warp starts here at the earliest, never when a module is imported: with it starts CUDA, and a process that
    forks or chooses its GPU afterwards would be too late.

    Args:
        tensor: Contiguous, of any shape.
        dtype: Of Warp; its last axes are then those of a vector or matrix.
    """
    _start_warp()
    return wp.from_torch(tensor, dtype=dtype)


def _forget_threads() -> None:
    """Leave the parent's pool behind in a forked child, where none of its threads lives."""
    global _pool, _starting
    # a lock that another thread of the parent held would stay locked for ever
    _pool, _starting = None, threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_threads)


def _start_warp() -> None:
    """Start Warp without its line on standard error that a machine has no NVIDIA driver."""
    global _started
    if _started:
        return  # asked on every launch, by threads that need not wait for each other
    # two threads that hold the file descriptor back at once would restore it in the wrong order
    with _starting:
        if wp._src.context.runtime is None:
            _init_quietly()
        keep_headers(wp._src.context.runtime)
        # only now: Warp shows a runtime before its modules are ready
        _started = True


def _init_quietly() -> None:
    # the line comes from native code, so only the file descriptor can be held back
    try:
        sys.stderr.flush()
        kept = os.dup(2)
    except (AttributeError, OSError):  # closed: there is nothing to hold back
        wp.init()
        return
    with tempfile.TemporaryFile() as said:
        os.dup2(said.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(kept, 2)
            os.close(kept)
        said.seek(0)
        for line in said.read().decode(errors="replace").splitlines():
            if "Could not find or load the NVIDIA CUDA driver" not in line:
                print(line, file=sys.stderr)


def run_kernel(
    kernel: wp.Kernel,
    size: int,
    inputs: list[Any],
    device: wp.Device,
    *,
    batch: int = 1,
    align: int = 1,
    slabs: int = 4,
) -> None:
    """Launch `kernel` over (batch, size) threads and wait for it on the CPU.

    Args:
        kernel: Takes `first: int` before `inputs`, and `row, i = wp.tid()` with i counted from `first`.
        size: Number of work items.
        inputs: Arguments after `first`.
        device: Where the arrays live.
        batch: Length of the leading axis, which is never cut.
        align: Slabs begin at multiples of this, so that no two threads share what belongs together.
        slabs: Of each thread; several even out rows of different cost, each takes a tenth of a millisecond.
    """
    if size == 0 or batch == 0:
        return
    if device.is_cuda:
        wp.launch(kernel, dim=(batch, size), inputs=[0, *inputs], device=device)
        return
    # load before the threads race for it
    kernel.module.load(device, block_dim=1)  # the variant that CPU launches use
    pieces = 1 if thread_count() == 1 else min(slabs * thread_count(), -(-size // align))
    step = align * -(-size // (align * pieces))
    starts = range(0, size, step)

    def work(first: int) -> None:
        wp.launch(kernel, dim=(batch, min(step, size - first)), inputs=[first, *inputs], device=device)

    if len(starts) == 1:
        work(0)
        return
    global _pool
    if _pool is None:
        _pool = ThreadPoolExecutor(thread_count(), thread_name_prefix="dase")
    for done in _pool.map(work, starts):
        assert done is None


def run_on_arrays(kernel: wp.Kernel, *inputs: Any, dim: int | tuple[int, ...] = 1) -> None:
    """Launch a kernel on one thread of the CPU, over the memory of NumPy arrays.

    Args:
        kernel: Takes `inputs` alone.
        inputs: Its arguments; arrays of any shape, with the types of numbers that it takes.
        dim: How often it is called.
    """
    cpu = find_device("cpu")
    lent = [wp.array(a, device=cpu, copy=False) if isinstance(a, np.ndarray) else a for a in inputs]
    wp.launch(kernel, dim=dim, inputs=lent, device=cpu)


def run_concurrently(works: Sequence[Callable[[], Result]]) -> list[Result]:
    """Return what works give that pass their time in kernels of the CPU or in NumPy, done on its threads.

    The first is done before the others: what it loads or works out is there for all. Works may use
    `run_kernel`, whose threads are others.
    """
    if len(works) < 2 or thread_count() == 1:
        return [work() for work in works]
    first = works[0]()
    with ThreadPoolExecutor(thread_count(), thread_name_prefix="dase works") as pool:
        return [first, *pool.map(lambda work: work(), works[1:])]


def copy_to_host(values: wp.array) -> np.ndarray:
    """Return a copy of an array of any shape, once the stream that is current on its device came so far.

    `wp.array.numpy` would wait for all streams of the device.
    """
    if values.device.is_cpu:
        return np.array(values.numpy())
    host = wp.empty(values.shape, dtype=values.dtype, device="cpu")
    wp.copy(host, values)
    wp.synchronize_stream(values.device.stream)
    return np.asarray(host.numpy())


def new_array(shape: int | tuple[int, ...], dtype: Any, device: wp.Device) -> wp.array:
    """Return new memory of a shape; on a CPU NumPy's, with large pages: small ones cost as much as work."""
    if device.is_cuda:
        return wp.empty(shape, dtype=dtype, device=device)
    return wp.array(np.empty(shape, wp.dtype_to_numpy(dtype)), dtype=dtype, device=device, copy=False)


def new_zeros(shape: int | tuple[int, ...], dtype: Any, device: wp.Device) -> wp.array:
    """Return zeros of a shape; on a CPU pages that nothing is written to cost next to nothing."""
    if device.is_cuda:
        return wp.zeros(shape, dtype=dtype, device=device)
    return wp.array(np.zeros(shape, wp.dtype_to_numpy(dtype)), dtype=dtype, device=device, copy=False)
