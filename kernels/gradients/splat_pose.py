"""From slopes by the splats of a posed picture to those by the pose: residuals of the cage, camera, values at rest."""

# A pose takes a splat to p = a + ... + J o with J = 1 + sum_j r_j (grad w_j)^T (splats/pose), and draws its covariance
# J S J^T, its harmonics turned by the rotation R of J = R P, and, of the law of density, its opacity by |J|. Slopes by
# J: 2 G J S from G, those by the covariance; R [c]x from B, those by R, with (tr(P) 1 - P) c the axial vector of R^T B.
# Shares of splats, and which of them are drawn in pieces, are held.

import warp as wp

from ..core.lanes import lane_place, sum_of_lanes
from ..field.harmonics import sh_basis
from ..splats.composite import DEPTH_MIN_ALPHA
from ..splats.fit import quaternion_slope, splat_axes
from ..splats.packed_rows import PackedRows
from ..splats.pose import FLAT, LAW_DENSITY, CarriedSplats, covariance_of, rms_stretch
from ..splats.project import Lens
from ..splats.project_slopes import LN_2, SplatValues, ViewSlopes, view_slopes
from ..splats.splats import Splats, harmonics_row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 128})


@wp.kernel
def weigh_pixels(
    first: int,
    by_alpha: wp.array(dtype=wp.float32),
    by_depth: wp.array(dtype=wp.float32),
    alpha: wp.array(dtype=wp.float32),
    depth: wp.array(dtype=wp.float32),
    others: wp.array(dtype=wp.vec3),
):
    """others (h * w,): slopes of a loss by opacity and by opacity times depth, and what the light of a pixel adds to it
    by these; from those by opacities and depths (h * w,) or (0,), where a pixel has a depth."""
    n = first + wp.tid()
    opacity = alpha[n]
    other = wp.vec3()
    if by_alpha.shape[0] > 0:
        other = by_alpha[n] * wp.vec3(1.0, 0.0, opacity)
    if by_depth.shape[0] > 0 and opacity > DEPTH_MIN_ALPHA:
        share = by_depth[n] / opacity
        other += wp.vec3(-share * depth[n], share, 0.0)
    others[n] = other


@wp.struct
class CarriedSlopes:
    """Of a loss, by what a pose carries."""

    positions: wp.array(dtype=wp.vec3)  # (n,)
    jacobians: wp.array(dtype=wp.mat33)  # (n,)


@wp.func
def axial(m: wp.mat33):
    """w for which <m, [v]x> = w . v."""
    return wp.vec3(m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1])


@wp.func
def covariance_slopes(seen: ViewSlopes):
    """Slopes by the covariance of a splat, a symmetric matrix."""
    ellipse = seen.ellipse
    direction = wp.normalize(seen.offset)
    by_column = ellipse.cc * seen.to_column + 0.5 * ellipse.cr * seen.to_row + seen.lean_column * direction
    by_row = ellipse.rr * seen.to_row + 0.5 * ellipse.cr * seen.to_column + seen.lean_row * direction
    half = wp.outer(seen.to_column, by_column) + wp.outer(seen.to_row, by_row)
    return 0.5 * (half + wp.transpose(half))


@wp.func
def rotation_slopes(jacobian: wp.mat33, rotation: wp.mat33, by_rotation: wp.mat33):
    """Slopes by J of its polar decomposition's rotation; none where J is flat or turned over."""
    largest = rms_stretch(jacobian)
    found = wp.mat33()
    if wp.determinant(jacobian) > FLAT * largest * largest * largest:
        stretch = wp.transpose(rotation) * jacobian
        stretch = 0.5 * (stretch + wp.transpose(stretch))
        matrix = wp.trace(stretch) * wp.identity(n=3, dtype=float) - stretch
        found = rotation * wp.skew(wp.inverse(matrix) * axial(wp.transpose(rotation) * by_rotation))
    return found


@wp.func
def exponent_of(opacity: float, rest: float):
    """e of opacity = 1 - (1 - rest)^e."""
    if opacity == rest or rest <= 0.0 or opacity >= 1.0:
        return 1.0
    return wp.log(1.0 - opacity) / wp.log(1.0 - rest)


@wp.kernel
def propagate_pose(
    first: int,
    law: int,
    splats: Splats,
    lenses: wp.array(dtype=Lens),
    view: wp.array(dtype=wp.vec4),
    sums: wp.array(dtype=wp.float32),
    depth_sums: wp.array(dtype=wp.float32),
    rest_covariances: wp.array2d(dtype=float),
    rest_opacities: wp.array(dtype=float),
    carried: CarriedSplats,
    log_scales: wp.array(dtype=wp.vec3),
    quaternions: wp.array(dtype=wp.vec4),
    slopes: CarriedSlopes,
    rays: wp.array2d(dtype=wp.float32),
    values: SplatValues,
):
    """splats (n,): as posed; view, sums (9 v n,), depth_sums (3 v n,) or (0,): of pictures by lenses (v,). Slopes, rays
    (n, 7) or (0,) by the camera, and values by rows where there are log_scales are added to; CPU threads share rows."""
    n = first + wp.tid()
    for number in range(lenses.shape[0]):
        at = number * splats.centers.shape[0] + n
        depths = wp.vec3()
        if depth_sums.shape[0] > 0:
            depths = wp.vec3(depth_sums[3 * at], depth_sums[3 * at + 1], depth_sums[3 * at + 2])
        lens = lenses[number]
        seen = view_slopes(splats, n, at, lens, view, sums, depths)
        if seen.is_seen == 0:
            continue
        jacobian = carried.jacobians[n]
        rotation = wp.quat_to_matrix(splats.turns[n])
        by_covariance = covariance_slopes(seen)
        by_rotation = wp.outer(rotation * seen.rest, seen.turn)
        by_jacobian = 2.0 * by_covariance * jacobian * covariance_of(rest_covariances, n)
        by_jacobian += rotation_slopes(jacobian, rotation, by_rotation)
        opacity = splats.opacities[n]
        rest = rest_opacities[n]
        left = 1.0 - opacity
        by_opacity = seen.strength / (LN_2 * opacity)
        if law == LAW_DENSITY and left > 0.0:
            square = wp.ddot(jacobian, jacobian)  # 3 |J|^2
            by_jacobian -= (by_opacity * left * wp.log(left) / wp.max(square, 1.0e-30)) * jacobian
        by_center = seen.center + seen.by_color
        slopes.positions[n] = slopes.positions[n] + by_center
        slopes.jacobians[n] = slopes.jacobians[n] + by_jacobian
        if rays.shape[0] > 0:
            # a camera that turns sees what it saw of splats that turn the other way, but for their colors
            turn = wp.cross(seen.offset, seen.center) + axial(
                2.0 * by_covariance * covariance_of(splats.covariances, n)
            )
            for axis in range(3):
                along = wp.vec3(
                    lens.camera.rotation[0, axis], lens.camera.rotation[1, axis], lens.camera.rotation[2, axis]
                )
                rays[n, axis] = rays[n, axis] - wp.dot(turn, along)
                rays[n, 3 + axis] = rays[n, 3 + axis] - wp.dot(by_center, along)
            rays[n, 6] = rays[n, 6] + seen.focal
        if log_scales.shape[0] > 0:
            row = harmonics_row(splats, n)
            logs = log_scales[row]
            quaternion = quaternions[row]
            axes = splat_axes(quaternion)
            at_rest = wp.transpose(jacobian) * by_covariance * jacobian
            by_axes = wp.mat33()
            by_logs = wp.vec3()
            for i in range(3):
                own = wp.vec3(axes[0, i], axes[1, i], axes[2, i])
                scale = wp.exp(logs[i])
                factor = 2.0 * scale * (at_rest * own)
                by_logs[i] = scale * wp.dot(factor, own)
                for j in range(3):
                    by_axes[j, i] = scale * factor[j]
            wp.atomic_add(values.centers, row, wp.transpose(jacobian) * by_center)
            wp.atomic_add(values.log_scales, row, by_logs)
            wp.atomic_add(values.quaternions, row, quaternion_slope(quaternion, by_axes))
            wp.atomic_add(values.logits, row, by_opacity * exponent_of(opacity, rest) * left * rest)
            basis = sh_basis(seen.rest)
            for b in range((splats.degree + 1) * (splats.degree + 1)):
                for channel in range(3):
                    wp.atomic_add(values.harmonics, row, 3 * b + channel, basis[b] * seen.color[channel])


@wp.kernel
def gather_bound(
    first: int,
    members: wp.array(dtype=int),
    others: wp.array(dtype=int),
    offsets: wp.array(dtype=wp.vec3),
    slopes: CarriedSlopes,
    bound: CarriedSlopes,
):
    """bound (m,): what splats members (m,), and the others (n,) that go the same way, pass on to the sums of the
    weights and of their gradients."""
    m = first + wp.tid()
    by_position = wp.vec3()
    by_jacobian = wp.mat33()
    each = members[m]
    while each >= 0:
        by_position += slopes.positions[each]
        by_jacobian += slopes.jacobians[each]
        each = others[each]
    bound.positions[m] = by_position
    bound.jacobians[m] = by_jacobian + wp.outer(by_position, offsets[m])


@wp.kernel
def propagate_rows(
    first: int,
    span: int,
    rows: wp.array2d(dtype=wp.vec4),
    inverse_size: float,
    bound: CarriedSlopes,
    by_targets: wp.array2d(dtype=wp.vec3),
):
    """The backward pass of splats/pose `carry_bound`: add to by_targets (parts, j) the slopes by r_j over `span` of the
    points a part, rows (j, m). One item per part."""
    part = first + wp.tid()
    for m in range(part * span, wp.min((part + 1) * span, rows.shape[1])):
        by_position = bound.positions[m]
        by_gradient = inverse_size * bound.jacobians[m]
        for j in range(rows.shape[0]):
            row = rows[j, m]
            moved = row[0] * by_position + by_gradient * wp.vec3(row[1], row[2], row[3])
            by_targets[part, j] = by_targets[part, j] + moved


@wp.func
def half_number(bits: wp.uint64, place: int):
    """The half float in the bits from `place` on."""
    return float(wp.cast(wp.uint16((bits >> wp.uint64(place)) & wp.uint64(65535)), wp.float16))


@wp.kernel
def propagate_packed_rows(
    first: int,
    count: int,
    packed: PackedRows,
    inverse_size: float,
    bound: CarriedSlopes,
    by_targets: wp.array2d(dtype=wp.vec3),
):
    """`propagate_rows` of packed rows of `count` points; by_targets (parts, 4 g). A group of lanes per part and group
    of rows; tiles of 32 points are shared out over the parts."""
    item, lane, lanes = lane_place(first + wp.tid())
    group = item % packed.groups.shape[1]
    part = item // packed.groups.shape[1]
    zero = wp.vec3()
    one = wp.vec3()
    two = wp.vec3()
    three = wp.vec3()
    four = wp.vec3()
    tile = part
    while tile < packed.groups.shape[0]:
        place = lane
        while place < 32:
            m = 32 * tile + place
            if m < count:
                by_position = bound.positions[m]
                by_gradient = (inverse_size * packed.scales[m]) * bound.jacobians[m]
                tail = packed.groups[tile, group, 128 + place]
                for k in range(4):
                    head = packed.groups[tile, group, 64 * (k // 2) + 2 * place + k % 2]
                    weight = wp.cast(wp.uint32(head & wp.uint64(4294967295)), wp.float32)
                    gradient = wp.vec3(half_number(head, 32), half_number(head, 48), half_number(tail, 16 * k))
                    moved = weight * by_position + by_gradient * gradient
                    one += wp.where(k == 0, moved, zero)
                    two += wp.where(k == 1, moved, zero)
                    three += wp.where(k == 2, moved, zero)
                    four += wp.where(k == 3, moved, zero)
            place += lanes
        tile += by_targets.shape[0]
    for k in range(4):
        total = wp.where(k == 0, one, wp.where(k == 1, two, wp.where(k == 2, three, four)))
        for axis in range(3):
            total[axis] = sum_of_lanes(total[axis])
        if lane == 0:
            by_targets[part, 4 * group + k] = total


@wp.kernel
def add_parts(first: int, parts: wp.array2d(dtype=wp.vec3), begin: int, factor: float, sums: wp.array(dtype=wp.vec3)):
    """Add to sums (k,) factor times those over all rows of parts (p, j), from column `begin` on."""
    j = first + wp.tid()
    total = wp.vec3()
    for part in range(parts.shape[0]):
        total += parts[part, begin + j]
    sums[j] = sums[j] + factor * total
