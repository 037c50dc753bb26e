"""Signed distances of points from a triangle mesh."""

# The side is told by the winding number (Barill et al., "Fast Winding Numbers for Soups and Clouds", 2018, inside
# `wp.mesh_query_point_sign_winding_number`): a point is inside where it is above 1/2, so that what lies in two solids
# of a mesh at once is inside, and what lies on the wall of one in another is, too.
#
# Shapes: points and distances (n,); one unit of length, one origin for points and mesh.

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.kernel
def measure_mesh_distance(
    first: int, mesh: wp.uint64, farthest: float, points: wp.array(dtype=wp.vec3), distances: wp.array(dtype=float)
):
    """distances (n,): negative inside; `farthest` for points that are farther from the mesh."""
    n = first + wp.tid()
    point = points[n]
    distances[n] = farthest
    query = wp.mesh_query_point_sign_winding_number(mesh, point, farthest)
    if query.result:
        foot = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
        distances[n] = query.sign * wp.length(point - foot)
