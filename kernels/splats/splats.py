"""Gaussian splats as kernels read them, and the colour of one from a direction."""

import warp as wp

from ..core.gradients import forward_only_in
from ..core.lanes import ballot, from_lane, lane_count, lane_place, least_of_lanes, lowest_bit, sum_of_lanes
from ..field.harmonics import sh_basis
from ..mesh.containment import closest_point_on_triangle, solid_angle, winding_number
from .pose import CarriedSplats, covariance_of

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

forward_only = forward_only_in(__name__, (float, wp.vec3), (wp.vec3, wp.vec3))


@wp.struct
class Splats:
    centers: wp.array(dtype=wp.vec3)  # (n,) world units
    covariances: wp.array2d(dtype=wp.float32)  # (n, 6) xx xy xz yy yz zz, world units squared
    opacities: wp.array(dtype=wp.float32)  # (n,) 0 to 1; 0 where there is nothing (a splat that is cleared away)
    harmonics: wp.array2d(dtype=wp.float32)  # (rows, 3 (degree + 1)^2) coefficient-major, red green blue last
    degree: int  # 0 to 3
    turns: wp.array(dtype=wp.quat)  # (n,) unit quaternion x y z w, from rest to pose; or (0,): nothing is turned
    rows: wp.array(dtype=wp.int32)  # (n,) row of harmonics of each splat; or (0,): splat i has row i


@wp.func_native(
    """
    const float* from = rows.data + (size_t)n * (rows.strides[0] / sizeof(float)) + 4 * j;
#if defined(__CUDA_ARCH__)
    if (4 * j + 4 <= rows.shape[1] && (reinterpret_cast<size_t>(from) & 15u) == 0u)
    {
        const float4 four = *reinterpret_cast<const float4*>(from);
        return wp::vec_t<4, wp::float32>(four.x, four.y, four.z, four.w);
    }
#endif
    wp::vec_t<4, wp::float32> found;
    for (int i = 0; i < 4; ++i)
        found.c[i] = 4 * j + i < rows.shape[1] ? from[i] : 0.0f;
    return found;
""",
    adj_snippet="""
    for (int i = 0; i < 4 && 4 * j + i < rows.shape[1]; ++i)
        wp::adj_address(rows, n, 4 * j + i, adj_rows, 0, 0, adj_ret.c[i]);
""",
)
def four_entries(rows: wp.array2d(dtype=wp.float32), n: int, j: int) -> wp.vec4:
    """rows[n, 4 j] to rows[n, 4 j + 3], 0 beyond the end; in one read where rows begin at a multiple of 16 bytes."""
    ...


@wp.func
def harmonics_row(splats: Splats, n: int):
    """The row of harmonics of splat n."""
    row = n
    if splats.rows.shape[0] > 0:
        row = splats.rows[n]
    return row


@wp.func
def rest_direction(splats: Splats, n: int, direction: wp.vec3):
    """A direction in the frame in which the harmonics of splat n were found."""
    turned = direction
    if splats.turns.shape[0] > 0:
        turned = wp.quat_rotate_inv(splats.turns[n], direction)
    return turned


@wp.func
def splat_color(splats: Splats, n: int, direction: wp.vec3):
    """Colour of splat n seen along a unit direction, from the camera into the scene; not below 0."""
    row = harmonics_row(splats, n)
    basis = sh_basis(rest_direction(splats, n, direction))
    color = wp.vec3(0.5, 0.5, 0.5)
    count = 3 * (splats.degree + 1) * (splats.degree + 1)
    for j in range(12):  # unrolled, so that the basis stays in registers
        if 4 * j < count:
            four = four_entries(splats.harmonics, row, j)
            for i in range(4):
                if 4 * j + i < count:
                    color[(4 * j + i) % 3] += basis[(4 * j + i) // 3] * four[i]
    return forward_only(wp.max(color, wp.vec3(0.0, 0.0, 0.0)), direction)


#: Standard deviations beyond which nothing of a splat is counted.
FAR = wp.constant(3.0)


@wp.struct
class NearestWall:
    distance: float  # signed, negative inside
    place: wp.vec3  # nearest point of the cage
    normal: wp.vec3  # outward, of the wall as the splat sees it


@wp.func
def nearest_wall(x: wp.vec3, vertices: wp.array(dtype=wp.vec3), faces: wp.array(dtype=wp.vec3i)):
    """The cage's surface nearest to a point. The normal is that from the surface to the point, or of a face where the
    point is on it."""
    wall = NearestWall()
    nearest = float(1.0e30)
    for f in range(faces.shape[0]):
        face = faces[f]
        a = vertices[face[0]]
        b = vertices[face[1]]
        c = vertices[face[2]]
        place = closest_point_on_triangle(x, a, b, c)
        squared = wp.length_sq(x - place)
        if squared < nearest:
            nearest = squared
            wall.place = place
            wall.normal = wp.normalize(wp.cross(b - a, c - a))
    length = wp.sqrt(nearest)
    inside = winding_number(x, vertices, faces) > 0.5
    if length > 1.0e-6 * wp.max(wp.length(x), length):
        wall.normal = (x - wall.place) / wp.where(inside, -length, length)
    wall.distance = forward_only(wp.where(inside, -length, length), x)
    wall.place = forward_only(wall.place, x)
    wall.normal = forward_only(wall.normal, x)
    return wall


@wp.func
def nearest_wall_of_lanes(x: wp.vec3, vertices: wp.array(dtype=wp.vec3), faces: wp.array(dtype=wp.vec3i), lane: int):
    """`nearest_wall` of a point that a group of lanes shares, in each of them. All lanes."""
    nearest = float(1.0e30)
    place = wp.vec3(0.0, 0.0, 0.0)
    normal = wp.vec3(0.0, 0.0, 0.0)
    total = float(0.0)
    for f in range(lane, faces.shape[0], lane_count()):
        face = faces[f]
        a = vertices[face[0]]
        b = vertices[face[1]]
        c = vertices[face[2]]
        near = closest_point_on_triangle(x, a, b, c)
        squared = wp.length_sq(x - near)
        if squared < nearest:
            nearest = squared
            place = near
            normal = wp.cross(b - a, c - a)
        total += solid_angle(x, a, b, c)
    least = least_of_lanes(nearest)
    has_it = int(0)
    if nearest == least:
        has_it = 1
    owner = lowest_bit(ballot(has_it))
    length = wp.sqrt(least)
    inside = sum_of_lanes(total) > 2.0 * wp.pi
    wall = NearestWall()
    wall.place = wp.vec3(from_lane(place[0], owner), from_lane(place[1], owner), from_lane(place[2], owner))
    wall.normal = wp.normalize(
        wp.vec3(from_lane(normal[0], owner), from_lane(normal[1], owner), from_lane(normal[2], owner))
    )
    if length > 1.0e-6 * wp.max(wp.length(x), length):
        wall.normal = (x - wall.place) / wp.where(inside, -length, length)
    wall.distance = wp.where(inside, -length, length)
    return wall


@wp.func
def share_inside(wall: NearestWall, covariance: wp.mat33):
    """Share of a Gaussian behind a wall, 0 and 1 beyond FAR standard deviations."""
    reach = wp.sqrt(wp.max(wp.dot(wall.normal, covariance * wall.normal), 0.0))
    if wp.abs(wall.distance) >= FAR * reach:
        return wp.where(wall.distance <= 0.0, 1.0, 0.0)
    return 0.5 * wp.erfc(wall.distance / (1.4142135623730951 * reach))


@wp.func
def is_near_box(x: wp.vec3, covariance: wp.mat33, lower: wp.vec3, upper: wp.vec3):
    """Whether a splat may reach a box."""
    for axis in range(3):
        reach = FAR * wp.sqrt(wp.max(covariance[axis, axis], 0.0))
        if x[axis] + reach < lower[axis] or x[axis] - reach > upper[axis]:
            return False
    return True


@wp.kernel
def measure_shares(
    first: int,
    centers: wp.array(dtype=wp.vec3),
    covariances: wp.array2d(dtype=float),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    lower: wp.vec3,
    upper: wp.vec3,
    depth: float,
    shares: wp.array(dtype=float),
    anchors: wp.array(dtype=wp.vec3),
):
    """shares (n,) of splats inside a cage at rest, 0 to 1, and anchors (n,): the centre, or where it lies outside or
    nearer to a wall than `depth`, the place at that depth behind the wall. lower, upper: box of the cage."""
    n = first + wp.tid()
    x = centers[n]
    covariance = covariance_of(covariances, n)
    shares[n] = 0.0
    anchors[n] = x
    if not is_near_box(x, covariance, lower, upper):
        return
    wall = nearest_wall(x, vertices, faces)
    shares[n] = share_inside(wall, covariance)
    if wall.distance > -depth:
        anchors[n] = wall.place - depth * wall.normal


@wp.kernel
def cover_staying(
    first: int,
    members: wp.array(dtype=int),
    outside: wp.array(dtype=float),
    centers: wp.array(dtype=wp.vec3),
    covariances: wp.array2d(dtype=float),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    lower: wp.vec3,
    upper: wp.vec3,
    carried: CarriedSplats,
):
    """Multiply the shares of splats members (m,), which stay at rest, by what of them is outside a posed cage with the
    box lower, upper, or outside (m,), their shares outside the cage at rest, if less. A group of lanes each."""
    m, lane, _ = lane_place(first + wp.tid())
    n = members[m]
    left = outside[m]
    x = centers[n]
    covariance = covariance_of(covariances, n)
    if is_near_box(x, covariance, lower, upper):
        wall = nearest_wall_of_lanes(x, vertices, faces, lane)
        left = wp.min(left, 1.0 - share_inside(wall, covariance))
    if lane == 0:
        carried.shares[n] = carried.shares[n] * left
