"""Whether the faces around a vertex of a triangle mesh meet other faces, as across a narrow gap."""

# Around vertex v are the faces ring[starts[v]] to ring[starts[v + 1]]. Edges are tested against faces (Moeller and
# Trumbore 1997); faces in one plane do not meet, nor do those of an edge, which may only fold. In float64.

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fuse_fp": False})

ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))

#: Determinant of an edge and a face, over their sizes, below which they are in one plane.
FLAT = wp.constant(wp.float64(1.0e-12))


@wp.func
def edge_meets(p: wp.vec3d, q: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Whether the line from p to q meets the triangle a, b, c."""
    along = q - p
    h = wp.cross(along, c - a)
    determinant = wp.dot(b - a, h)
    if wp.abs(determinant) <= FLAT * wp.length(along) * wp.length(b - a) * wp.length(c - a):
        return False
    u = wp.dot(p - a, h) / determinant
    if u < ZERO or u > ONE:
        return False
    k = wp.cross(p - a, b - a)
    v = wp.dot(along, k) / determinant
    t = wp.dot(c - a, k) / determinant
    return v >= ZERO and u + v <= ONE and t >= ZERO and t <= ONE


@wp.func
def has_corner(face: wp.vec3i, v: int):
    return face[0] == v or face[1] == v or face[2] == v


@wp.func
def edges_meet(vertices: wp.array(dtype=wp.vec3d), one: wp.vec3i, two: wp.vec3i):
    """Whether an edge of the first face that has no corner in common with the second one meets it."""
    a = vertices[two[0]]
    b = vertices[two[1]]
    c = vertices[two[2]]
    for k in range(3):
        i = one[k]
        j = one[(k + 1) % 3]
        if not has_corner(two, i) and not has_corner(two, j):
            if edge_meets(vertices[i], vertices[j], a, b, c):
                return True
    return False


@wp.kernel
def find_meeting_rings(
    first: int,
    rings: wp.array(dtype=int),
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=wp.vec3i),
    starts: wp.array(dtype=int),
    ring: wp.array(dtype=int),
    lower: wp.array(dtype=wp.vec3d),
    upper: wp.array(dtype=wp.vec3d),
    found: wp.array(dtype=int),
):
    """1 for each vertex of rings (n,) around which a face meets another face, else 0 (n,).
    lower, upper (f,): boxes of the faces."""
    n = first + wp.tid()
    v = rings[n]
    low = lower[ring[starts[v]]]
    high = upper[ring[starts[v]]]
    for m in range(starts[v], starts[v + 1]):
        low = wp.min(low, lower[ring[m]])
        high = wp.max(high, upper[ring[m]])
    found[n] = 0
    for f in range(faces.shape[0]):
        a = lower[f]
        b = upper[f]
        if a[0] <= high[0] and a[1] <= high[1] and a[2] <= high[2]:
            if b[0] >= low[0] and b[1] >= low[1] and b[2] >= low[2]:
                face = faces[f]
                for m in range(starts[v], starts[v + 1]):
                    other = faces[ring[m]]
                    common = int(0)
                    for k in range(3):
                        common += wp.where(has_corner(face, other[k]), 1, 0)
                    if common < 2:
                        if edges_meet(vertices, face, other) or edges_meet(vertices, other, face):
                            found[n] = 1
                            return
