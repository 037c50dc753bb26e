"""Differences of frames from pictures, blurred, a robust sum of their squares, and its slopes by the frames."""

# A loss of views is sum_p w_p rho(d_p), d = e G frame - G picture with e the exposure of the view's picture, which
# opacities have not, G a Gaussian blur of each view that takes what is around it for zero, and
# rho(d) = 2 s^2 (sqrt(1 + (d / s)^2) - 1), which is d^2 near zero and grows linearly above s (pseudo-Huber). G is its
# own adjoint: slopes by the frame are G e rho'(d). Depths z, which have no blur, differ by a (z - target), with a the
# opacity: where little is seen little counts, and nothing jumps where a depth comes or goes. Where one part hides
# another, depths of both meet in a pixel, and no slope of z says that a part should come before the other: such
# differences would pull the wrong part. So theirs is rho(d) = d^2 / (1 + (d / s)^2) (Geman and McClure 1987), which
# does not grow, of a scale s that falls from coarse to fine (graduated non-convexity, Blake and Zisserman 1987).

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Weights of squares of opacities, and of depths as shares of the cage's size, beside those of colors.
ALPHA, DEPTH = wp.constant(0.5), wp.constant(20.0)

#: Differences of colors and opacities above which they count linearly.
ROBUST = wp.constant(0.15)


@wp.struct
class Pixels:
    """Parts of the pixels of stacked views, (views * h * w,) each; arrays without entries are left out."""

    rgb: wp.array(dtype=wp.vec3)
    alpha: wp.array(dtype=wp.float32)
    depth: wp.array(dtype=wp.float32)


@wp.struct
class Comparison:
    """What differences count."""

    scale: float  # of the whole sum
    unit: float  # size of the cage, world units
    depth_scale: float  # s of depths, a share of the size
    behind: float  # by which frames' depth lies behind the surface, world units
    known_alone: int  # 1: opacities count where the pictures have a depth
    view_pixels: int  # h * w
    exposures: wp.array(dtype=wp.vec3)  # (views,) by which pictures are brighter than frames; none: they are not


@wp.kernel
def blur_lines(first: int, values: Pixels, stride: int, size: int, taps: wp.array(dtype=wp.float32), blurred: Pixels):
    """blurred: colors and opacities weighed by taps (r + 1,), which begin in the middle, along lines of `size` pixels
    that lie `stride` apart."""
    n = first + wp.tid()
    place = (n // stride) % size
    reach = taps.shape[0] - 1
    color = wp.vec3()
    opacity = float(0.0)
    k = wp.max(-reach, -place)
    while k <= wp.min(reach, size - 1 - place):
        weight = taps[wp.abs(k)]
        m = n + k * stride
        if blurred.rgb.shape[0] > 0:
            color += weight * values.rgb[m]
        if blurred.alpha.shape[0] > 0:
            opacity += weight * values.alpha[m]
        k += 1
    if blurred.rgb.shape[0] > 0:
        blurred.rgb[n] = color
    if blurred.alpha.shape[0] > 0:
        blurred.alpha[n] = opacity


@wp.func
def robust_square(off: float, scale: float, weight: float):
    """Weighed rho(off), its derivative, and the root of weight off^2."""
    share = off / scale
    root = wp.sqrt(1.0 + share * share)
    return wp.vec3(2.0 * weight * off * off / (1.0 + root), 2.0 * weight * off / root, wp.sqrt(weight) * off)


@wp.func
def bounded_square(off: float, scale: float, weight: float):
    """The same of depths."""
    share = off / scale
    grown = 1.0 + share * share
    return wp.vec3(weight * off * off / grown, 2.0 * weight * off / (grown * grown), wp.sqrt(weight) * off)


@wp.func
def depth_off(frames: Pixels, targets: Pixels, comparison: Comparison, n: int):
    """Difference of the depths of a pixel as a share of the cage's size, 0 where there is none to compare."""
    off = float(0.0)
    if wp.isfinite(targets.depth[n]) and wp.isfinite(frames.depth[n]):
        off = (frames.depth[n] - comparison.behind - targets.depth[n]) / comparison.unit
    return off


@wp.kernel
def weigh_differences(
    first: int,
    frames: Pixels,
    targets: Pixels,
    blurred_frames: Pixels,
    blurred_targets: Pixels,
    weights: wp.array(dtype=wp.float32),
    comparison: Comparison,
    slopes: Pixels,
    roots: Pixels,
    losses: wp.array(dtype=wp.float32),
):
    """losses (views * h * w,): what each pixel adds; slopes by the blurred frames; roots: differences times the
    roots of their weights. weights: of pixels. Parts are those of targets."""
    n = first + wp.tid()
    weight = comparison.scale * weights[n]
    loss = float(0.0)
    if targets.rgb.shape[0] > 0:
        gain = wp.vec3(1.0)
        if comparison.exposures.shape[0] > 0:
            gain = comparison.exposures[n // comparison.view_pixels]
        color = wp.cw_mul(gain, blurred_frames.rgb[n]) - blurred_targets.rgb[n]
        red = robust_square(color[0], ROBUST, weight / 3.0)
        green = robust_square(color[1], ROBUST, weight / 3.0)
        blue = robust_square(color[2], ROBUST, weight / 3.0)
        loss += red[0] + green[0] + blue[0]
        if slopes.rgb.shape[0] > 0:
            slopes.rgb[n] = wp.cw_mul(gain, wp.vec3(red[1], green[1], blue[1]))
        if roots.rgb.shape[0] > 0:
            roots.rgb[n] = wp.vec3(red[2], green[2], blue[2])
    known = float(1.0)
    if targets.depth.shape[0] > 0 and not wp.isfinite(targets.depth[n]):
        known = 0.0
    if targets.alpha.shape[0] > 0:
        counted = wp.where(comparison.known_alone == 1, known, 1.0)
        found = robust_square(blurred_frames.alpha[n] - blurred_targets.alpha[n], ROBUST, ALPHA * weight * counted)
        loss += found[0]
        if slopes.alpha.shape[0] > 0:
            slopes.alpha[n] = found[1]
        if roots.alpha.shape[0] > 0:
            roots.alpha[n] = found[2]
    if targets.depth.shape[0] > 0:
        off = frames.alpha[n] * depth_off(frames, targets, comparison, n)
        found = bounded_square(off, comparison.depth_scale, DEPTH * weight)
        loss += found[0]
        if slopes.depth.shape[0] > 0:
            slopes.depth[n] = found[1]
        if roots.depth.shape[0] > 0:
            roots.depth[n] = found[2]
    losses[n] = loss


@wp.kernel
def share_depth_slopes(first: int, frames: Pixels, targets: Pixels, comparison: Comparison, slopes: Pixels):
    """slopes: those by opacities and depths, where `depth` has those by their products."""
    n = first + wp.tid()
    by_product = slopes.depth[n]
    slopes.alpha[n] = slopes.alpha[n] + by_product * depth_off(frames, targets, comparison, n)
    slopes.depth[n] = by_product * frames.alpha[n] / comparison.unit
