"""What a camera sees of Gaussian splats: an ellipse on the image, opacity, colour and depth of each."""

# Elliptical weighted averaging (Zwicker et al., "EWA Volume Splatting", 2001) as in 3DGS (Kerbl et al. 2023, Eq. 5):
# the affine part A of the projection p -> (column, row, distance) at a splat's centre makes its covariance S A S^T.
# With its upper left 2x2 block E, blurred by b (pixels squared), a pixel at d and the centre at distance r,
#   alpha = o exp(-1/2 d^T (E + b)^-1 d),    t = r + k . d,    k = (E + b)^-1 (A S A^T)_{columns and rows, distance};
# t is the expected distance of the matter that the pixel sees: a large slanted splat has a slanted depth. As in 3DGS, A
# is taken at most 0.3 of the picture beyond its rim, alpha is at most 0.999, and what is below 1/255 is nothing. With
# `antialias`, o is weakened by sqrt(det E / det(E + b)), so that the blur adds no matter (Yu et al., "Mip-Splatting",
# 2024, Eq. 10). The exponent is kept by its root, as the terms of d^T E^-1 d cancel for long thin splats:
#   log2 alpha = strength - (l_0 dx + l_1 dy)^2 - (l_2 dy)^2.
# A view of n splats is (3 n,) vec4: three for each,
#   column, row (pixels), strength, l_0    l_1, l_2, red, green    blue, r (world units), k (world units a pixel)

import warp as wp

from ..view.rays import PinholeCamera
from .pose import covariance_of
from .splats import Splats, splat_color

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 128})

#: Nothing is drawn of a splat below this.
MIN_ALPHA = wp.constant(1.0 / 255.0)
LOG2_MIN_ALPHA = wp.constant(-7.994353436858858)

#: sqrt(log2(e) / 2): of the root of the exponent.
ROOT_SCALE = wp.constant(0.8493218002880191)

#: The affine part is taken at most this share of half the picture beyond its rim, and no nearer than this.
RIM = wp.constant(0.3)


@wp.struct
class Lens:
    """How splats are drawn."""

    camera: PinholeCamera
    near: float  # splats whose centre is less than this before the camera are left out, world units
    blur: float  # variance that is added on the image, pixels squared
    antialias: int  # 1: the blur adds no matter


@wp.func
def rim_slope(slope: float, principal: float, focal: float, size: float):
    """x / z (or y / z) of a centre, clamped near the picture."""
    beyond = RIM * 0.5 * size / focal
    return wp.clamp(slope, -principal / focal - beyond, (size - principal) / focal + beyond)


@wp.func
def project_splat(
    n: int,
    at: int,
    splats: Splats,
    lens: Lens,
    view: wp.array(dtype=wp.vec4),
    depths: wp.array(dtype=wp.float32),
    order: wp.array(dtype=wp.int32),
):
    """Splat n of `project_splats`; at: its place in the outputs."""
    order[at] = at
    depths[at] = wp.inf
    camera = lens.camera
    axis_x = wp.vec3(camera.rotation[0, 0], camera.rotation[1, 0], camera.rotation[2, 0])
    axis_y = wp.vec3(camera.rotation[0, 1], camera.rotation[1, 1], camera.rotation[2, 1])
    axis_z = wp.vec3(camera.rotation[0, 2], camera.rotation[1, 2], camera.rotation[2, 2])
    offset = splats.centers[n] - camera.center
    z = wp.dot(offset, axis_z)
    opacity = splats.opacities[n]
    if not (z >= lens.near and opacity >= MIN_ALPHA):  # so that it is left out where it is not a number
        return
    x = wp.dot(offset, axis_x) / z
    y = wp.dot(offset, axis_y) / z
    width = float(camera.width)
    height = float(camera.height)
    rim_x = rim_slope(x, camera.principal_point[0], camera.focal[0], width)
    rim_y = rim_slope(y, camera.principal_point[1], camera.focal[1], height)
    to_column = (camera.focal[0] / z) * (axis_x - rim_x * axis_z)
    to_row = (camera.focal[1] / z) * (axis_y - rim_y * axis_z)
    distance = wp.length(offset)
    direction = offset / distance

    covariance = covariance_of(splats.covariances, n)
    by_column = covariance * to_column
    by_row = covariance * to_row
    cc = wp.max(wp.dot(to_column, by_column), 0.0)
    cr = wp.dot(to_row, by_column)
    rr = wp.max(wp.dot(to_row, by_row), 0.0)
    sharp = wp.max(cc * rr - cr * cr, 0.0)  # det E; below zero by rounding alone
    blurred = sharp + lens.blur * (cc + rr) + lens.blur * lens.blur
    cc += lens.blur
    rr += lens.blur
    if lens.antialias == 1:
        opacity *= wp.sqrt(sharp / blurred)
    strength = wp.log2(opacity)
    reach = strength - LOG2_MIN_ALPHA
    if not (reach >= 0.0 and blurred > 0.0 and blurred < 1.0e37 and rr > 0.0):
        return
    column = camera.focal[0] * x + camera.principal_point[0]
    row = camera.focal[1] * y + camera.principal_point[1]
    reach_column = wp.sqrt(reach * cc) / ROOT_SCALE
    reach_row = wp.sqrt(reach * rr) / ROOT_SCALE
    if column + reach_column < 0.5 or column - reach_column > width - 0.5:
        return
    if row + reach_row < 0.5 or row - reach_row > height - 0.5:
        return

    l0 = ROOT_SCALE * wp.sqrt(rr / blurred)
    l1 = -l0 * cr / rr
    l2 = ROOT_SCALE / wp.sqrt(rr)
    along_column = wp.dot(direction, by_column)
    along_row = wp.dot(direction, by_row)
    color = splat_color(splats, n, direction)
    view[3 * at] = wp.vec4(column, row, strength, l0)
    view[3 * at + 1] = wp.vec4(l1, l2, color[0], color[1])
    view[3 * at + 2] = wp.vec4(
        color[2],
        distance,
        (rr * along_column - cr * along_row) / blurred,
        (cc * along_row - cr * along_column) / blurred,
    )
    depths[at] = z


@wp.kernel
def project_splats(
    first: int,
    splats: Splats,
    lens: Lens,
    view: wp.array(dtype=wp.vec4),
    depths: wp.array(dtype=wp.float32),
    order: wp.array(dtype=wp.int32),
):
    """view: (3 n,), see above. depths: (n,) along the optical axis, inf for what is not seen. order: (n,) 0 to
    n - 1."""
    n = first + wp.tid()
    project_splat(n, n, splats, lens, view, depths, order)


@wp.kernel
def project_by_lens(
    first: int,
    splats: Splats,
    lenses: wp.array(dtype=Lens),
    view: wp.array(dtype=wp.vec4),
    depths: wp.array(dtype=wp.float32),
    order: wp.array(dtype=wp.int32),
):
    """`project_splats` for each of some lenses (v,), view after view; one item a splat of a view. They lie on the
    device, as graphs of training steps replay them."""
    at = first + wp.tid()
    count = splats.centers.shape[0]
    project_splat(at % count, at, splats, lenses[at // count], view, depths, order)


@wp.func
def band_columns(place: wp.vec4, shape: wp.vec4, low: float, high: float):
    """Least and greatest column of a splat among the rows from `low` to `high`, pixels; the first is greater where it
    does not reach them. place, shape: the first two of its view."""
    reach = place[2] - LOG2_MIN_ALPHA
    root = wp.sqrt(wp.max(reach, 0.0))
    # s = l_2 dy is between -root and root; the column is -(l_1 / l_2) s +- sqrt(reach - s^2), over l_0
    lean = shape[0] / shape[1]
    from_s = wp.max(shape[1] * (low - place[1]), -root)
    to_s = wp.min(shape[1] * (high - place[1]), root)
    least = float(1.0)
    greatest = float(0.0)
    if from_s <= to_s:
        extreme = lean * root / wp.sqrt(1.0 + lean * lean)
        right = wp.clamp(-extreme, from_s, to_s)
        left = wp.clamp(extreme, from_s, to_s)
        greatest = place[0] + (wp.sqrt(wp.max(reach - right * right, 0.0)) - lean * right) / place[3]
        least = place[0] - (wp.sqrt(wp.max(reach - left * left, 0.0)) + lean * left) / place[3]
    return wp.vec2(least, greatest)
