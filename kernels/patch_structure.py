"""The structure of patches: orientation, coherence, strength and energy of the image, contrast of the events.

No thread waits for another. The image is summed by a thread for every row of a patch first, since patches
alone are too few to keep a GPU busy. Patch i of a map lies at
row i // columns and column i % columns of the grid. Nothing here is differentiated: a hash has no gradient.
"""

import warp as wp

from dase.kernels.compiler_flags import CPU_FLAGS

wp.set_module_options({"cpu_compiler_flags": CPU_FLAGS, "enable_backward": False})

BINS = wp.constant(16)  # of the histogram of gradient magnitudes, 1 count wide, the last open
Bins = wp.types.vector(length=16, dtype=float)


@wp.func
def image_gradient(image: wp.array3d[float], b: int, y: int, x: int) -> wp.vec2:
    """Central differences along x and y [intensity/pixel]; outside, the image repeats its border."""
    bottom = image.shape[1] - 1
    right = image.shape[2] - 1
    gx = image[b, y, wp.min(x + 1, right)] - image[b, y, wp.max(x - 1, 0)]
    gy = image[b, wp.min(y + 1, bottom), x] - image[b, wp.max(y - 1, 0), x]
    return 0.5 * wp.vec2(gx, gy)


@wp.kernel
def structure_rows(
    first: int,
    # in
    image: wp.array3d[float],  # (B, H, W) [intensity]
    weight: wp.array[float],  # (S,) window along one axis, its sum 1
    stride: int,  # [pixel]
    columns: int,  # of the grid of patches
    # out
    row_out: wp.array2d[wp.vec3],  # (B, N·S) weighted means of gx², gx·gy, gy² [intensity²/pixel²]
):
    """Sum the structure tensor over a row of a patch, one row per thread.

    Summing row by row keeps float32 rounding at that of a few terms, which the small eigenvalue feels.
    """
    b, i = wp.tid()
    i += first
    size = weight.shape[0]
    patch = i // size
    y = (patch // columns) * stride + i % size
    left = (patch % columns) * stride
    row = wp.vec3(0.0)
    for j in range(size):
        g = image_gradient(image, b, y, left + j)
        row += weight[j] * wp.vec3(g[0] * g[0], g[0] * g[1], g[1] * g[1])
    row_out[b, i] = row


@wp.func
def orientation(tensor: wp.vec3) -> float:
    """Direction of the top eigenvector [rad], in [0, π); 0 where no direction stands out."""
    angle = 0.5 * wp.atan2(2.0 * tensor[1], tensor[0] - tensor[2])
    if angle < 0.0:
        angle += wp.pi
    # just below 0, float32 rounds the sum to π
    return wp.where(angle >= wp.pi, 0.0, angle)


@wp.func
def singular_values(tensor: wp.vec3) -> wp.vec2:
    """Roots √λ1 >= √λ2 of the eigenvalues [intensity/pixel]."""
    mean = 0.5 * (tensor[0] + tensor[2])
    half = 0.5 * (tensor[0] - tensor[2])
    radius = wp.sqrt(half * half + tensor[1] * tensor[1])
    return wp.vec2(wp.sqrt(mean + radius), wp.sqrt(wp.max(mean - radius, 0.0)))


@wp.func
def coherence(roots: wp.vec2) -> float:
    """Coherence (√λ1 - √λ2)/(√λ1 + √λ2): 1 for stripes, 0 for isotropic and for flat patches."""
    if roots[0] == 0.0:
        return 0.0
    return (roots[0] - roots[1]) / (roots[0] + roots[1])


@wp.kernel
def structure_of_patches(
    first: int,
    # in
    row: wp.array2d[wp.vec3],  # (B, N·S) from `structure_rows`
    weight: wp.array[float],  # (S,) window along one axis, its sum 1
    # out
    angle_out: wp.array2d[float],  # (B, N) [rad]
    coherence_out: wp.array2d[float],  # (B, N)
    strength_out: wp.array2d[float],  # (B, N) [intensity/pixel]
    energy_out: wp.array2d[float],  # (B, N) [intensity²/pixel²]
):
    """Eigen analysis of image gradients, one patch per thread."""
    b, i = wp.tid()
    i += first
    size = weight.shape[0]
    tensor = wp.vec3(0.0)
    for j in range(size):
        tensor += weight[j] * row[b, i * size + j]
    roots = singular_values(tensor)
    angle_out[b, i] = orientation(tensor)
    coherence_out[b, i] = coherence(roots)
    strength_out[b, i] = roots[0]
    energy_out[b, i] = tensor[0] + tensor[2]


@wp.func
def total_count(counts: wp.array4d[float], b: int, y: int, x: int) -> float:
    """Events of a pixel, all polarities [events]."""
    events = float(0.0)
    for channel in range(counts.shape[1]):
        events += counts[b, channel, y, x]
    return events


@wp.func
def bin_of(magnitude: float) -> int:
    """Histogram bin of a gradient magnitude [events]; any bin for NaN, whose sum of squares tells."""
    return wp.clamp(int(wp.min(magnitude, float(BINS - 1))), 0, BINS - 1)


@wp.func
def density_weighted(squares: Bins, number: Bins) -> float:
    """Eq. 12 from a histogram: Σ over bins of (Σ g² in the bin) × density of the bin [events].

    Each pair of neighbours is in the histogram once and in Eq. 12 twice, hence the 2.
    """
    weighted = float(0.0)
    pairs = float(0.0)
    for k in range(BINS):
        weighted += squares[k] * number[k]
        pairs += number[k]
    return 2.0 * weighted / pairs


@wp.kernel
def contrast_of_patches(
    first: int,
    # in
    counts: wp.array4d[float],  # (B, C, H, W) [events]
    size: int,  # S [pixel]
    stride: int,  # [pixel]
    columns: int,  # of the grid of patches
    # out
    contrast_out: wp.array2d[float],  # (B, N) [events]
):
    """Contrast of the total count, one patch per thread; each pixel looks right and down."""
    b, i = wp.tid()
    i += first
    top = (i // columns) * stride
    left = (i % columns) * stride
    squares = Bins()
    number = Bins()
    for y in range(top, top + size):
        here = total_count(counts, b, y, left)
        for x in range(left, left + size):
            if y + 1 < top + size:
                g = wp.abs(total_count(counts, b, y + 1, x) - here)
                squares[bin_of(g)] += g * g
                number[bin_of(g)] += 1.0
            if x + 1 < left + size:
                next = total_count(counts, b, y, x + 1)
                g = wp.abs(next - here)
                squares[bin_of(g)] += g * g
                number[bin_of(g)] += 1.0
                here = next
    contrast_out[b, i] = density_weighted(squares, number)
