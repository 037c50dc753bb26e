"""Faces of a cage as the closed forms read them: in fans, with what all points have in common worked out."""

# A face (a, b, c) that begins with the edge a, c of the face before it goes on with a fan around a: what its first two
# corners and their edge give is there. Faces come in any order, best in long fans (warpcage/mesh/mesh.py).

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Faces whose plane passes closer to a point than this share of the size are for float64.
PLANE_BAND = wp.constant(1.0e-3)

#: So are faces lower than about the square root of this share of their length: their normal has few digits in float32.
SLIVER = wp.constant(1.0e-6)
INFINITE = wp.constant(3.0e38)


@wp.func
def near_plane_limit(normal: wp.vec3, edge_b: wp.vec3, edge_c: wp.vec3, size: float):
    """A face a, b, c is for float64 where the square of det(a, b, c), seen from the point, is no more than this.
    edge_b, edge_c: from a to b and c; normal: their cross product."""
    squared = wp.dot(normal, normal)
    edges = wp.dot(edge_b, edge_b) + wp.dot(edge_c, edge_c)
    band = PLANE_BAND * size
    return wp.where(squared <= SLIVER * edges * edges, INFINITE, band * band * squared)


@wp.kernel
def prepare_fans(
    first: int,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    size: float,
    fans: wp.array(dtype=wp.vec4),
):
    """What the closed forms read of each face. fans (2 f,): corner c and its index, as bits; the cross product of
    two edges, and `near_plane_limit`. The last face of a fan has its index inverted. size: of the cage."""
    f = first + wp.tid()
    face = faces[f]
    after = faces[wp.min(f + 1, faces.shape[0] - 1)]
    index = face[2]
    if after[0] != face[0] or after[1] != face[2] or f + 1 == faces.shape[0]:
        index = -1 - index
    a = vertices[face[0]]
    c = vertices[face[2]]
    edge_b = vertices[face[1]] - a
    edge_c = c - a
    normal = wp.cross(edge_b, edge_c)
    fans[2 * f] = wp.vec4(c[0], c[1], c[2], wp.cast(index, float))
    fans[2 * f + 1] = wp.vec4(normal[0], normal[1], normal[2], near_plane_limit(normal, edge_b, edge_c, size))
