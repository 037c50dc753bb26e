"""Dead (almost transparent) splats become copies of living ones, and new copies are added."""

# Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte Carlo" (2024), Eq. 9: n copies at one place look like
# the one splat of opacity o and scale s that was there if each has
#   o' = 1 - (1 - o)^(1 / n),    s' = s o / sum_{j = 1..n} (-1)^(j - 1) C(n, j) o'^j / sqrt(j).
# The paper's double sum is this single one. Its terms alternate: float64, and o held at 0.999. Unlike in the paper,
# sources are drawn by opacity times the fourth root of what the picture would change if they moved by their size, of
# which Adam has the mean squares: large splats on fine detail are what is to be divided. Whole numbers are drawn from,
# so that a scan of them is exact on every device.

import warp as wp

from ..core.gradients import forward_only_in
from ..splats.project_slopes import SplatValues

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

forward_only = forward_only_in(__name__, (float, float))

#: Most copies of one splat, and its greatest opacity, of which copies are made.
MAX_COPIES = wp.constant(51)

MAX_OPACITY = wp.constant(0.999)

#: Units of an opacity of 1 when places are drawn.
OPACITY_UNITS = wp.constant(16777216.0)

#: Slopes of a picture's mean loss by a splat's size are about 1e-8; and those of a splat that is new count as at least
#: this small.
SLOPE_UNITS = wp.constant(1.0e8)

MIN_SLOPE = wp.constant(1.0e-8)


@wp.func
def split_opacity(opacity: float, copies: int):
    """Opacity and factor on the scales of each of so many copies of a splat, together as it is seen."""
    o = wp.float64(wp.min(opacity, MAX_OPACITY))
    one = wp.float64(1.0)
    part = one - wp.pow(one - o, one / wp.float64(copies))
    total = wp.float64(0.0)
    term = -one  # (-1)^(j - 1) C(n, j) o'^j
    for j in range(1, copies + 1):
        term *= -part * wp.float64(copies + 1 - j) / wp.float64(j)
        total += term / wp.sqrt(wp.float64(j))
    return forward_only(float(part), opacity), forward_only(float(o / total), opacity)


@wp.kernel
def weigh_splats(
    first: int,
    least: float,
    opacities: wp.array(dtype=wp.float32),
    values: SplatValues,
    squares: SplatValues,
    weights: wp.array(dtype=wp.int64),
):
    """weights: (n,) by which splats are drawn, 0 for those of opacity `least` or less, which are dead. squares: Adam's
    mean squares of the slopes by `values`."""
    n = first + wp.tid()
    opacity = opacities[n]
    weight = wp.int64(0)
    if opacity > least:
        logs = values.log_scales[n]
        square = squares.centers[n]
        size = wp.exp((logs[0] + logs[1] + logs[2]) / 3.0)
        slope = wp.max(SLOPE_UNITS * size * wp.sqrt(square[0] + square[1] + square[2]), MIN_SLOPE)
        weight = wp.int64(opacity * OPACITY_UNITS * wp.sqrt(wp.sqrt(slope)))
    weights[n] = weight


@wp.kernel
def draw_sources(
    first: int,
    count: int,
    seed: int,
    weights: wp.array(dtype=wp.int64),
    ends: wp.array(dtype=wp.int64),
    sources: wp.array(dtype=wp.int32),
    copies: wp.array(dtype=wp.int32),
):
    """weights, ends: (count,) and their running sums. sources: (all,) the living splat that each dead one, and each
    beyond `count`, is to copy; -1 for the others. copies: (count,) is added to. One item at a time on the CPU."""
    n = first + wp.tid()
    sources[n] = -1
    total = ends[count - 1]
    if n < count:
        if weights[n] > wp.int64(0):
            return
    if total == wp.int64(0):
        if n >= count:  # nothing lives: copies of whatever is there
            sources[n] = n % count
        return
    state = wp.rand_init(seed, n)
    place = wp.min(wp.int64(wp.float64(wp.randf(state)) * wp.float64(total)), total - wp.int64(1))
    low = int(0)
    high = count - 1
    while low < high:
        middle = low + (high - low) // 2
        if ends[middle] > place:
            high = middle
        else:
            low = middle + 1
    sources[n] = low
    wp.atomic_add(copies, low, 1)


@wp.func
def clear_means(n: int, means: SplatValues, squares: SplatValues):
    """Forget the slopes that splat n had."""
    means.centers[n] = wp.vec3()
    means.log_scales[n] = wp.vec3()
    means.quaternions[n] = wp.vec4()
    means.logits[n] = 0.0
    squares.centers[n] = wp.vec3()
    squares.log_scales[n] = wp.vec3()
    squares.quaternions[n] = wp.vec4()
    squares.logits[n] = 0.0
    for i in range(means.harmonics.shape[1]):
        means.harmonics[n, i] = 0.0
        squares.harmonics[n, i] = 0.0


@wp.func
def shared_values(source: int, copies: int, least: float, values: SplatValues):
    """Logit, and what is added to the logarithms of scales, of each of the copies of a splat and of itself."""
    opacity = 1.0 / (1.0 + wp.exp(-values.logits[source]))
    part, factor = split_opacity(opacity, wp.min(copies + 1, MAX_COPIES))
    part = wp.clamp(part, least, MAX_OPACITY)
    return wp.log(part / (1.0 - part)), wp.log(factor)


@wp.kernel
def copy_sources(
    first: int,
    least: float,
    sources: wp.array(dtype=wp.int32),
    copies: wp.array(dtype=wp.int32),
    values: SplatValues,
    means: SplatValues,
    squares: SplatValues,
):
    """Splats that have a source become copies of it as it is shared. least: opacity that a copy has at least."""
    n = first + wp.tid()
    source = sources[n]
    if source < 0:
        return
    logit, grown = shared_values(source, copies[source], least, values)
    values.centers[n] = values.centers[source]
    values.log_scales[n] = values.log_scales[source] + wp.vec3(grown, grown, grown)
    values.quaternions[n] = values.quaternions[source]
    values.logits[n] = logit
    for i in range(values.harmonics.shape[1]):
        values.harmonics[n, i] = values.harmonics[source, i]
    clear_means(n, means, squares)


@wp.kernel
def settle_sources(
    first: int,
    least: float,
    copies: wp.array(dtype=wp.int32),
    values: SplatValues,
    means: SplatValues,
    squares: SplatValues,
):
    """Splats that were copied become one of the copies."""
    n = first + wp.tid()
    if copies[n] == 0:
        return
    logit, grown = shared_values(n, copies[n], least, values)
    values.log_scales[n] = values.log_scales[n] + wp.vec3(grown, grown, grown)
    values.logits[n] = logit
    clear_means(n, means, squares)
