"""How often rays from points pass through the faces of a closed mesh: inside or outside, for points not on a face."""

# Rays go along z. A ray passes an edge on one side or the other by the sign of one determinant, of the ends in the
# order of their numbers, so that the two faces of an edge agree and a closed mesh has no gap. In float64.

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fuse_fp": False})

ZERO = wp.constant(wp.float64(0.0))


@wp.func
def passes_left(x: wp.vec3d, i: int, j: int, vertices: wp.array(dtype=wp.vec3d)):
    """Whether the ray at x has the edge from vertex i to j on its left, seen from above."""
    a = vertices[wp.min(i, j)]
    b = vertices[wp.max(i, j)]
    left = (b[0] - a[0]) * (x[1] - a[1]) - (b[1] - a[1]) * (x[0] - a[0]) >= ZERO
    return left == (i < j)


@wp.kernel
def count_crossings(
    first: int,
    points: wp.array(dtype=wp.vec3d),
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=wp.vec3i),
    boxes: wp.array(dtype=wp.vec4d),
    starts: wp.array(dtype=int),
    listed: wp.array(dtype=int),
    lower: wp.float64,
    width: wp.float64,
    winding: wp.array(dtype=int),
):
    """Winding number (n,) about points (n,): faces above that look up less those that look down.
    boxes (f,): least x and y, largest x and y; listed[starts[k]:starts[k + 1]]: faces over strip k of x, from lower."""
    n = first + wp.tid()
    x = points[n]
    total = int(0)
    strip = int(wp.floor((x[0] - lower) / width))
    if strip >= 0 and strip < starts.shape[0] - 1:
        for k in range(starts[strip], starts[strip + 1]):
            f = listed[k]
            bounds = boxes[f]
            if x[0] >= bounds[0] and x[1] >= bounds[1] and x[0] <= bounds[2] and x[1] <= bounds[3]:
                face = faces[f]
                up = passes_left(x, face[0], face[1], vertices)
                if (
                    passes_left(x, face[1], face[2], vertices) == up
                    and passes_left(x, face[2], face[0], vertices) == up
                ):
                    a = vertices[face[0]]
                    normal = wp.cross(vertices[face[1]] - a, vertices[face[2]] - a)
                    above = wp.dot(normal, a - x)  # over the normal's z: how far the plane is above
                    if (above > ZERO) == (normal[2] > ZERO) and above != ZERO:
                        total += wp.where(up, 1, -1)
    winding[n] = total
