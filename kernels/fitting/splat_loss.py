"""Loss of a drawn picture beside the true one, of absolute differences and structural similarity: slopes by pixels."""

# L = (1 - s) mean |x - y| + s (1 - mean S), x drawn, y true, per colour; S the structural similarity (Wang et al. 2004)
# of windows of 11x11 pixels that lie wholly in the picture, by a Gaussian g of 1.5 pixels, with its means m and
# variances v. With d = x - y, S = (1 - md^2 / A) (1 - vd / B), A = mx^2 + my^2 + C1, B = vx + vy + C2: nothing large
# cancels where x is near y, as it would in 2 mx my + C1 and 2 cov + C2. Slopes are those by g*d, g*d^2, g*(d y), taken
# back to d by the same windows. Colours count from MIDDLE on, so that v = g*y^2 - (g*y)^2 loses less in float32.

import warp as wp

from ..core.gradients import forward
from ..core.variants import native_source

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 256})

#: Pixels along a window, and those that windows beside each other share.
WINDOW = wp.constant(11)

OVERLAP = wp.constant(10)

#: Windows or pixels along the tile of a block of 256 threads.
TILE = wp.constant(16)

C1, C2 = wp.constant(0.01**2), wp.constant(0.03**2)

MIDDLE = wp.constant(0.5)

vec9 = wp.types.vector(length=9, dtype=wp.float32)

vec11 = wp.types.vector(length=11, dtype=wp.float32)

vec16 = wp.types.vector(length=16, dtype=wp.float32)

#: Weights along a window.
TAPS = wp.constant(
    vec11(
        0.00102838, 0.00759876, 0.03600077, 0.10936069, 0.21300554, 0.26601172,
        0.21300554, 0.10936069, 0.03600077, 0.00759876, 0.00102838,
    )
)  # fmt: skip


@wp.struct
class LossTerms:
    """Sizes of a picture, and what its terms count."""

    height: int  # pixels
    width: int
    rows: int  # of windows; 0: none are looked at
    columns: int
    by_color: float  # factor of the slope of |d| of a number
    by_similarity: float  # of the slope of a window's S; below 0


@wp.func
def middle_color(color: wp.vec3):
    return color - wp.vec3(MIDDLE, MIDDLE, MIDDLE)


@wp.func
def similarity_slopes(sums: vec16):
    """Slopes of a window's S by g*d, g*d^2 and g*(d y), each of three colours, times the window's share."""
    # sums: g*d, g*y, g*d^2, g*(d y), g*y^2 of three colours, and the share
    found = vec9()
    for c in range(3):
        mean = sums[c]
        true_mean = sums[3 + c]
        # rounding may leave a variance below 0: it is held there, and has no slope
        raw = sums[6 + c] - mean * mean
        variance = wp.max(raw, 0.0)
        true_variance = wp.max(sums[12 + c] - true_mean * true_mean, 0.0)
        raw_drawn = true_variance + 2.0 * (sums[9 + c] - mean * true_mean) + variance
        y = true_mean + MIDDLE
        x = y + mean
        a = x * x + y * y + C1
        b = wp.max(raw_drawn, 0.0) + true_variance + C2
        luminance = 1.0 - mean * mean / a
        structure = 1.0 - variance / b
        by_square = -luminance / b
        by_product = float(0.0)
        if raw_drawn > 0.0:
            by_square *= structure
            by_product = 2.0 * luminance * variance / (b * b)
        if raw < 0.0:
            by_square = 0.0
        by_luminance = -2.0 * structure * mean * (1.0 - mean * x / a) / a
        found[c] = sums[15] * (by_luminance - 2.0 * mean * by_square - true_mean * by_product)
        found[3 + c] = sums[15] * by_square
        found[6 + c] = sums[15] * by_product
    return found


@wp.func
def sign_of(value: float):
    """-1, 0 or 1; wp.sign has 1 for 0."""
    return wp.where(value > 0.0, 1.0, wp.where(value < 0.0, -1.0, 0.0))


@wp.func
def write_pixel(
    loss: LossTerms,
    n: int,
    x: wp.vec3,
    y: wp.vec3,
    weights: wp.array(dtype=wp.float32),
    sums: vec9,
    slopes: wp.array(dtype=wp.vec3),
    errors: wp.array(dtype=wp.float32),
):
    """Slope and error of pixel n by the weighted sum of the slopes of its windows."""
    d = x - y
    by_color = loss.by_color
    if weights.shape[0] > 0:
        by_color *= weights[n]
    true_color = middle_color(y)
    slope = wp.vec3()
    for c in range(3):
        similarity = sums[c] + 2.0 * d[c] * sums[3 + c] + true_color[c] * sums[6 + c]
        slope[c] = by_color * sign_of(d[c]) + loss.by_similarity * similarity
    slopes[n] = slope
    errors[n] = wp.dot(d, d) / 3.0


@wp.kernel
def sum_rows(
    first: int,
    loss: LossTerms,
    drawn: wp.array(dtype=wp.vec3),
    truth: wp.array(dtype=wp.vec3),
    weights: wp.array(dtype=wp.float32),
    sums: wp.array(dtype=vec16),
):
    """One item per pixel row and column of windows: drawn, truth (h * w,); weights (h * w,) or empty for ones; sums
    (h * columns,) along rows of pixels, last the least weight."""
    n = first + wp.tid()
    start = n // loss.columns * loss.width + n % loss.columns
    mean = wp.vec3()
    true_mean = wp.vec3()
    square = wp.vec3()
    product = wp.vec3()
    true_square = wp.vec3()
    for k in range(WINDOW):
        y = middle_color(truth[start + k])
        d = drawn[start + k] - truth[start + k]
        weighted = TAPS[k] * d
        true_weighted = TAPS[k] * y
        mean += weighted
        true_mean += true_weighted
        square += wp.cw_mul(weighted, d)
        product += wp.cw_mul(weighted, y)
        true_square += wp.cw_mul(true_weighted, y)
    found = vec16()
    for c in range(3):
        found[c] = mean[c]
        found[3 + c] = true_mean[c]
        found[6 + c] = square[c]
        found[9 + c] = product[c]
        found[12 + c] = true_square[c]
    share = float(1.0)
    if weights.shape[0] > 0:
        share = weights[start]
        for k in range(1, WINDOW):
            share = wp.min(share, weights[start + k])
    found[15] = share
    sums[n] = found


@wp.kernel
def find_window_slopes(first: int, loss: LossTerms, sums: wp.array(dtype=vec16), windows: wp.array(dtype=vec9)):
    """One item per window: sums of `sum_rows`; windows (rows * columns,) of `similarity_slopes`."""
    n = first + wp.tid()
    total = vec16()
    share = sums[n][15]
    for k in range(WINDOW):
        row = sums[n + k * loss.columns]
        total += TAPS[k] * row
        share = wp.min(share, row[15])
    total[15] = share
    windows[n] = similarity_slopes(total)


@wp.kernel
def sum_window_rows(first: int, loss: LossTerms, windows: wp.array(dtype=vec9), sums: wp.array(dtype=vec9)):
    """One item per row of windows and column of pixels: sums (rows * w,) of the slopes of windows over that column."""
    n = first + wp.tid()
    row = n // loss.width
    column = n % loss.width
    total = vec9()
    for k in range(wp.max(0, OVERLAP - column), wp.min(WINDOW, loss.columns + OVERLAP - column)):
        total += TAPS[k] * windows[row * loss.columns + column - OVERLAP + k]
    sums[n] = total


@wp.kernel
def find_slopes(
    first: int,
    loss: LossTerms,
    drawn: wp.array(dtype=wp.vec3),
    truth: wp.array(dtype=wp.vec3),
    weights: wp.array(dtype=wp.float32),
    sums: wp.array(dtype=vec9),
    slopes: wp.array(dtype=wp.vec3),
    errors: wp.array(dtype=wp.float32),
):
    """One item per pixel: sums of `sum_window_rows`; slopes (h * w,) of the loss by `drawn`; errors (h * w,): mean
    square of the colors' differences."""
    n = first + wp.tid()
    row = n // loss.width
    total = vec9()
    for k in range(wp.max(0, OVERLAP - row), wp.min(WINDOW, loss.rows + OVERLAP - row)):
        total += TAPS[k] * sums[n + (k - OVERLAP) * loss.width]
    write_pixel(loss, n, drawn[n], truth[n], weights, total, slopes, errors)


# On CUDA a block takes 16x16 windows or pixels at once, and sums in shared memory.


@forward.func_native(native_source(__file__, "cpp/splat_loss_windows.h"))
def window_sums(
    drawn: wp.array(dtype=wp.vec3),
    truth: wp.array(dtype=wp.vec3),
    weights: wp.array(dtype=wp.float32),
    height: int,
    width: int,
    top: int,
    left: int,
    middle: float,
    taps: vec11,
) -> vec16:
    """Sums of a thread's window, see `similarity_slopes`; top, left: first window of the block. All 256 threads."""
    ...


@forward.func_native(native_source(__file__, "cpp/splat_loss_pixels.h"))
def pixel_sums(windows: wp.array(dtype=vec9), rows: int, columns: int, top: int, left: int, taps: vec11) -> vec9:
    """Weighted sum of the slopes of the windows over a thread's pixel; top, left: first pixel of the block. All 256
    threads."""
    ...


@wp.kernel
def find_window_slopes_of_tiles(
    first: int,
    loss: LossTerms,
    drawn: wp.array(dtype=wp.vec3),
    truth: wp.array(dtype=wp.vec3),
    weights: wp.array(dtype=wp.float32),
    windows: wp.array(dtype=vec9),
):
    """One thread per window of the tiles; arrays as those of `sum_rows` and `find_window_slopes`."""
    n = first + wp.tid()
    tile = n // (TILE * TILE)
    across = (loss.columns + TILE - 1) // TILE
    top = tile // across * TILE
    left = tile % across * TILE
    sums = window_sums(drawn, truth, weights, loss.height, loss.width, top, left, MIDDLE, TAPS)
    row = top + n % (TILE * TILE) // TILE
    column = left + n % TILE
    if row < loss.rows and column < loss.columns:
        windows[row * loss.columns + column] = similarity_slopes(sums)


@wp.kernel
def find_slopes_of_tiles(
    first: int,
    loss: LossTerms,
    drawn: wp.array(dtype=wp.vec3),
    truth: wp.array(dtype=wp.vec3),
    weights: wp.array(dtype=wp.float32),
    windows: wp.array(dtype=vec9),
    slopes: wp.array(dtype=wp.vec3),
    errors: wp.array(dtype=wp.float32),
):
    """One thread per pixel of the tiles; arrays as those of `find_window_slopes` and `find_slopes`."""
    n = first + wp.tid()
    tile = n // (TILE * TILE)
    across = (loss.width + TILE - 1) // TILE
    top = tile // across * TILE
    left = tile % across * TILE
    sums = pixel_sums(windows, loss.rows, loss.columns, top, left, TAPS)
    row = top + n % (TILE * TILE) // TILE
    column = left + n % TILE
    if row < loss.height and column < loss.width:
        at = row * loss.width + column
        write_pixel(loss, at, drawn[at], truth[at], weights, sums, slopes, errors)
