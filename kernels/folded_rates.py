"""A rate folded on many periods, of which one may be its own."""

import warp as wp

from dase.kernels.compiler_flags import CPU_FLAGS

wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS, "enable_backward": False})


@wp.func
def step_of(turn: int, period: wp.float64, phase: int):
    """Step at a phase [steps] of one turn of a period [steps]."""
    return int(wp.rint(wp.float64(turn) * period + wp.float64(phase)))


@wp.kernel
def find_fold_heights(
    first: int,
    # in
    rate: wp.array[wp.float64],  # (K,) by step, in standard errors
    period: wp.array[wp.float64],  # (P,) [steps]
    # out
    height_out: wp.array[wp.float64],  # (P,) in standard errors of a step
):
    """Find the largest sum over all turns at one phase, one period per thread."""
    _, i = wp.tid()
    i += first
    count = rate.shape[0]
    phases = int(period[i])
    turns = int(wp.float64(count - 1) / period[i])
    while turns > 0:  # the last may not be whole
        if step_of(turns - 1, period[i], phases - 1) < count:
            break
        turns -= 1
    height = -wp.float64(wp.inf)
    for phase in range(phases):
        total = wp.float64(0.0)
        for turn in range(turns):
            total += rate[step_of(turn, period[i], phase)]
        height = wp.max(height, total)
    height_out[i] = height / wp.sqrt(wp.float64(wp.max(turns, 1)))
