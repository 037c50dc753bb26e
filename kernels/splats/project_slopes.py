"""Slopes of a loss by the values of splats, from the sums that splats/composite leaves of a picture."""

# The adjoint of splats/project, from its end to its beginning, and of splats/fit: slopes by l_0, l_1, l_2,
# strength, column and row become those by E = A S A^T, blurred and not, by the rows of A and by S = M M^T, M = R
# diag(s), then by centre (through A, view direction and place), log s, quaternion and logit (Kerbl et al. 2023,
# appendix A). Where A is taken at the rim, or a colour held at 0, the slope is none.

import warp as wp

from ..core.gradients import forward_only_in
from ..core.loads import vec4_entry
from ..field.harmonics import sh_basis, vec16
from .fit import quaternion_slope, splat_axes
from .pose import covariance_of
from .project import ROOT_SCALE, Lens, rim_slope
from .splats import Splats, four_entries, harmonics_row, rest_direction

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 128})

forward_only = forward_only_in(__name__, (wp.vec3, wp.vec3))

LN_2 = wp.constant(0.6931471805599453)


@wp.struct
class SplatValues:
    """Numbers of n splats by kind: their values, slopes by them, or means of those."""

    centers: wp.array(dtype=wp.vec3)  # (n,)
    log_scales: wp.array(dtype=wp.vec3)  # (n,)
    quaternions: wp.array(dtype=wp.vec4)  # (n,) w x y z
    logits: wp.array(dtype=wp.float32)  # (n,)
    harmonics: wp.array2d(dtype=wp.float32)  # (n, 3 (degree + 1)^2)


@wp.struct
class RowSlopes:
    """Slopes by the values of one splat. Those by its harmonics are Y_b(direction) color."""

    center: wp.vec3
    log_scales: wp.vec3
    quaternion: wp.vec4
    logit: float
    direction: wp.vec3  # in which it is seen, of length one
    color: wp.vec3  # by the color before it is held at 0


@wp.struct
class EllipseSlopes:
    """Slopes by A S A^T of a splat: columns, both, rows."""

    cc: float
    cr: float
    rr: float


@wp.func
def basis_slope(d: wp.vec3, g: vec16):
    """Slope by a direction of sum_b g_b Y_b(d)."""
    x = d[0]
    y = d[1]
    z = d[2]
    xx = x * x
    yy = y * y
    zz = z * z
    a = 0.4886025119029199
    b = 1.0925484305920792
    c = 0.31539156525252005
    e = 0.5900435899266435
    f = 2.890611442640554
    h = 0.4570457994644658
    k = 0.3731763325901154
    m = 1.445305721320277
    along_x = -a * g[3] + b * (y * g[4] - z * g[7] + x * g[8]) - 2.0 * c * x * g[6]
    along_x += -6.0 * e * x * y * g[9] + f * y * z * g[10] + 2.0 * h * x * y * g[11] - 6.0 * k * x * z * g[12]
    along_x += -h * (4.0 * zz - 3.0 * xx - yy) * g[13] + 2.0 * m * x * z * g[14] - 3.0 * e * (xx - yy) * g[15]
    along_y = -a * g[1] + b * (x * g[4] - z * g[5] - y * g[8]) - 2.0 * c * y * g[6]
    along_y += -3.0 * e * (xx - yy) * g[9] + f * x * z * g[10] - h * (4.0 * zz - xx - 3.0 * yy) * g[11]
    along_y += -6.0 * k * y * z * g[12] + 2.0 * h * x * y * g[13] - 2.0 * m * y * z * g[14] + 6.0 * e * x * y * g[15]
    along_z = a * g[2] - b * (y * g[5] + x * g[7]) + 4.0 * c * z * g[6] + f * x * y * g[10] - 8.0 * h * y * z * g[11]
    along_z += k * (6.0 * zz - 3.0 * xx - 3.0 * yy) * g[12] - 8.0 * h * x * z * g[13] + m * (xx - yy) * g[14]
    return wp.vec3(along_x, along_y, along_z)


@wp.func
def color_slope(splats: Splats, n: int, direction: wp.vec3, by_color: wp.vec3):
    """Slope by a unit direction in the frame of the harmonics, from that by the color seen along it where that is not
    held at 0."""
    weights = vec16()
    row = harmonics_row(splats, n)
    count = 3 * (splats.degree + 1) * (splats.degree + 1)
    for j in range(12):  # unrolled, so that the weights stay in registers
        if 4 * j < count:
            four = four_entries(splats.harmonics, row, j)
            for i in range(4):
                if 4 * j + i < count:
                    weights[(4 * j + i) // 3] += by_color[(4 * j + i) % 3] * four[i]
    return forward_only(basis_slope(direction, weights), direction)


@wp.func
def ellipse_slopes(cc: float, cr: float, rr: float, blur: float, antialias: int, shape: wp.vec3, strength: float):
    """Slopes by an ellipse (before its blur) from those by l_0, l_1, l_2 (shape) and by the strength."""
    c = cc + blur
    r = rr + blur
    sharp = wp.max(cc * rr - cr * cr, 0.0)
    blurred = sharp + blur * (cc + rr) + blur * blur
    l0 = ROOT_SCALE * wp.sqrt(r / blurred)
    by_l0 = shape[0] - shape[1] * cr / r
    by_blurred = -0.5 * by_l0 * l0 / blurred
    found = EllipseSlopes()
    found.cr = -shape[1] * l0 / r
    found.rr = shape[1] * l0 * cr / (r * r) - 0.5 * shape[2] * ROOT_SCALE / (r * wp.sqrt(r)) + 0.5 * by_l0 * l0 / r
    if antialias == 1:  # log2 sqrt(sharp / blurred) of the strength
        by_blurred -= 0.5 * strength / (LN_2 * blurred)
        if sharp > 0.0:
            by_sharp = 0.5 * strength / (LN_2 * sharp)
            found.cc += by_sharp * rr
            found.rr += by_sharp * cc
            found.cr -= 2.0 * by_sharp * cr
    found.cc += by_blurred * r
    found.rr += by_blurred * c
    found.cr -= 2.0 * by_blurred * cr
    return found


@wp.struct
class ViewSlopes:
    """Slopes by what a view depends on of one splat, posed or not, and the frame they are in."""

    is_seen: int
    center: wp.vec3  # all but through the color
    by_color: wp.vec3  # by the center, through the direction of the color
    strength: float  # by log2 of the opacity
    ellipse: EllipseSlopes
    lean_column: float  # of a depth, by direction . S c and direction . S r, c and r the rows of A
    lean_row: float
    to_column: wp.vec3  # c
    to_row: wp.vec3  # r
    offset: wp.vec3  # from the camera
    rest: wp.vec3  # unit direction in the frame of the harmonics
    turn: wp.vec3  # by that
    color: wp.vec3  # by the color before it is held at 0
    focal: float  # by the logarithm of the focal length


@wp.func
def view_slopes(
    splats: Splats,
    n: int,
    at: int,
    lens: Lens,
    view: wp.array(dtype=wp.vec4),
    sums: wp.array(dtype=wp.float32),
    depths: wp.vec3,
):
    """Slopes of splat n; all are 0 where it is not seen. at: its place among those of the view and of the sums, (9 n,)
    of splats/composite; depths: the three of a picture's depths, zero without."""
    by_place = wp.vec3(sums[9 * at], sums[9 * at + 1], sums[9 * at + 2])
    by_shape = wp.vec3(-2.0 * sums[9 * at + 3], -2.0 * sums[9 * at + 4], -2.0 * sums[9 * at + 5])
    by_color = wp.vec3(sums[9 * at + 6], sums[9 * at + 7], sums[9 * at + 8])
    found = ViewSlopes()
    of_all = wp.length_sq(by_place) + wp.length_sq(by_shape) + wp.length_sq(by_color) + wp.length_sq(depths)
    if of_all == 0.0:
        return found
    found.is_seen = 1
    strength = by_place[0]
    place = vec4_entry(view, 3 * at)
    shape = vec4_entry(view, 3 * at + 1)
    by_drawn = wp.vec3(  # none where a color is held at 0
        wp.where(shape[2] > 0.0, by_color[0], 0.0),
        wp.where(shape[3] > 0.0, by_color[1], 0.0),
        wp.where(vec4_entry(view, 3 * at + 2)[0] > 0.0, by_color[2], 0.0),
    )
    # w = l_0 (x - column) + l_1 (y - row) and s = l_2 (y - row), each once in -w^2 - s^2
    column = 2.0 * place[3] * by_place[1]
    row = 2.0 * (shape[0] * by_place[1] + shape[1] * by_place[2])

    camera = lens.camera
    axis_x = wp.vec3(camera.rotation[0, 0], camera.rotation[1, 0], camera.rotation[2, 0])
    axis_y = wp.vec3(camera.rotation[0, 1], camera.rotation[1, 1], camera.rotation[2, 1])
    axis_z = wp.vec3(camera.rotation[0, 2], camera.rotation[1, 2], camera.rotation[2, 2])
    offset = splats.centers[n] - camera.center
    z = wp.dot(offset, axis_z)
    x = wp.dot(offset, axis_x) / z
    y = wp.dot(offset, axis_y) / z
    rim_x = rim_slope(x, camera.principal_point[0], camera.focal[0], float(camera.width))
    rim_y = rim_slope(y, camera.principal_point[1], camera.focal[1], float(camera.height))
    along_x = axis_x - rim_x * axis_z
    along_y = axis_y - rim_y * axis_z
    to_column = (camera.focal[0] / z) * along_x
    to_row = (camera.focal[1] / z) * along_y
    covariance = covariance_of(splats.covariances, n)
    by_column = covariance * to_column
    by_row = covariance * to_row
    cc = wp.max(wp.dot(to_column, by_column), 0.0)
    cr = wp.dot(to_row, by_column)
    rr = wp.max(wp.dot(to_row, by_row), 0.0)
    ellipse = ellipse_slopes(cc, cr, rr, lens.blur, lens.antialias, by_shape, strength)
    distance = wp.length(offset)
    direction = offset / distance
    by_depth = wp.vec3()  # by the offset
    slope_column = wp.vec3()
    slope_row = wp.vec3()
    if wp.length_sq(depths) > 0.0:
        # depth = |offset| + k . (x - column, y - row), k = E^-1 (direction . S c, direction . S r), E blurred
        ends = vec4_entry(view, 3 * at + 2)
        column -= ends[2] * depths[0]
        row -= ends[3] * depths[0]
        blurred_c = cc + lens.blur
        blurred_r = rr + lens.blur
        inverse = 1.0 / (wp.max(cc * rr - cr * cr, 0.0) + lens.blur * (cc + rr) + lens.blur * lens.blur)
        found.lean_column = inverse * (blurred_r * depths[1] - cr * depths[2])
        found.lean_row = inverse * (blurred_c * depths[2] - cr * depths[1])
        ellipse.cc -= found.lean_column * ends[2]
        ellipse.cr -= found.lean_column * ends[3] + found.lean_row * ends[2]
        ellipse.rr -= found.lean_row * ends[3]
        turned = found.lean_column * by_column + found.lean_row * by_row
        by_depth = depths[0] * direction + (turned - wp.dot(turned, direction) * direction) / distance
        slope_column = found.lean_column * (covariance * direction)
        slope_row = found.lean_row * (covariance * direction)
    # E = A S A^T by its two rows
    slope_column += 2.0 * ellipse.cc * by_column + ellipse.cr * by_row
    slope_row += 2.0 * ellipse.rr * by_row + ellipse.cr * by_column
    found.ellipse = ellipse
    found.strength = strength
    found.to_column = to_column
    found.to_row = to_row
    found.offset = offset

    by_x = camera.focal[0] * column
    by_y = camera.focal[1] * row
    along = wp.dot(slope_column, to_column) + wp.dot(slope_row, to_row)
    found.focal = along + by_x * x + by_y * y
    if rim_x == x:
        by_x -= camera.focal[0] / z * wp.dot(slope_column, axis_z)
    else:  # the rim is nearer the axis the longer the focal length
        found.focal += camera.focal[0] / z * rim_x * wp.dot(slope_column, axis_z)
    if rim_y == y:
        by_y -= camera.focal[1] / z * wp.dot(slope_row, axis_z)
    else:
        found.focal += camera.focal[1] / z * rim_y * wp.dot(slope_row, axis_z)
    by_z = -(along + by_x * x + by_y * y) / z
    rest = rest_direction(splats, n, direction)
    turn = color_slope(splats, n, rest, by_drawn)
    by_direction = turn
    if splats.turns.shape[0] > 0:
        by_direction = wp.quat_rotate(splats.turns[n], turn)
    found.rest = rest
    found.turn = turn
    found.color = by_drawn
    found.by_color = (by_direction - wp.dot(by_direction, direction) * direction) / distance
    found.center = (by_x / z) * axis_x + (by_y / z) * axis_y + by_z * axis_z + by_depth
    return found


@wp.func
def row_slopes(
    splats: Splats,
    n: int,
    lens: Lens,
    logs: wp.vec3,
    quaternion: wp.vec4,
    view: wp.array(dtype=wp.vec4),
    sums: wp.array(dtype=wp.float32),
):
    """Slopes of splat n, see `find_value_slopes`; all are 0 where it is not seen."""
    found = RowSlopes()
    seen = view_slopes(splats, n, n, lens, view, sums, wp.vec3())
    if seen.is_seen == 0:
        return found
    # S = M M^T: M' = 2 S' M
    ellipse = seen.ellipse
    axes = splat_axes(quaternion)
    by_axes = wp.mat33()
    by_logs = wp.vec3()
    for i in range(3):
        axis = wp.vec3(axes[0, i], axes[1, i], axes[2, i])
        scale = wp.exp(logs[i])
        p = scale * wp.dot(seen.to_column, axis)
        q = scale * wp.dot(seen.to_row, axis)
        factor = (2.0 * ellipse.cc * p + ellipse.cr * q) * seen.to_column
        factor += (2.0 * ellipse.rr * q + ellipse.cr * p) * seen.to_row
        by_logs[i] = scale * wp.dot(factor, axis)
        for j in range(3):
            by_axes[j, i] = scale * factor[j]
    found.log_scales = by_logs
    found.quaternion = quaternion_slope(quaternion, by_axes)
    found.logit = seen.strength * (1.0 - splats.opacities[n]) / LN_2
    found.center = seen.center + seen.by_color
    found.direction = seen.rest
    found.color = seen.color
    return found


@wp.kernel
def find_value_slopes(
    first: int,
    splats: Splats,
    lens: Lens,
    log_scales: wp.array(dtype=wp.vec3),
    quaternions: wp.array(dtype=wp.vec4),
    view: wp.array(dtype=wp.vec4),
    sums: wp.array(dtype=wp.float32),
    slopes: SplatValues,
):
    """splats: as splats/fit makes them from log_scales, quaternions; none turned, a row of harmonics each.
    view: (3 n,) of splats/project. sums: (9 n,) of splats/composite, zeros for what is not seen."""
    n = first + wp.tid()
    found = row_slopes(splats, n, lens, log_scales[n], quaternions[n], view, sums)
    slopes.centers[n] = found.center
    slopes.log_scales[n] = found.log_scales
    slopes.quaternions[n] = found.quaternion
    slopes.logits[n] = found.logit
    basis = sh_basis(found.direction)
    for b in range((splats.degree + 1) * (splats.degree + 1)):
        for channel in range(3):
            slopes.harmonics[n, 3 * b + channel] = basis[b] * found.color[channel]
