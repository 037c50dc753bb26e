"""Which points lie inside a mesh."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..core.arrays import as_host_points, as_points, is_device_array
from ..core.devices import launch, resolve_device
from ..kernels.mesh.containment import measure_distance, measure_winding_number
from .closed_mesh import ClosedMesh
from .usable import require_usable

#: Points this close to a mesh, as a share of its size, count as inside.
SURFACE_TOLERANCE = 1e-5


def inside_mesh(points, mesh: ClosedMesh, *, tolerance: float = SURFACE_TOLERANCE, device=None):
    """Whether points (n, 3), world units, are inside a usable mesh or within tolerance * mesh.size of its surface.

    Returns (n,) bool: NumPy for NumPy input, else a Warp array on the device of the points. Inside is a winding number
    above 1/2, so that a cavity is outside and a place that a tangled pose covers twice is inside.
    """
    require_usable(mesh)
    given_on_device = is_device_array(points)
    if given_on_device:
        array, _ = as_points(points, device)
        device, points = array.device, array.numpy()
    else:
        device = resolve_device(device)
    points = as_host_points(points)

    # float32 relative to the cage's middle, so that a cage far from the origin keeps its digits, and to its size, so
    # that products of lengths stay in range
    centre, size = mesh.bounds.mean(axis=0), mesh.size
    inside = np.zeros(len(points), dtype=bool)
    reach = tolerance * size
    near = np.flatnonzero(((points >= mesh.bounds[0] - reach) & (points <= mesh.bounds[1] + reach)).all(axis=1))
    vertices = wp.array(((mesh.vertices - centre) / size).astype(np.float32), dtype=wp.vec3, device=device)
    faces = wp.array(mesh.faces, dtype=wp.vec3i, device=device)

    def measure(kernel, rows):
        local = wp.array(((points[rows] - centre) / size).astype(np.float32), dtype=wp.vec3, device=device)
        values = wp.empty(len(rows), dtype=wp.float32, device=device)
        launch(kernel, len(rows), [local, vertices, faces], [values], device=device)
        return values.numpy()

    if len(near):
        inside[near] = measure(measure_winding_number, near) > 0.5
    outside = near[~inside[near]]
    if len(outside):
        inside[outside] = measure(measure_distance, outside) <= tolerance
    return wp.array(inside, dtype=wp.bool, device=device) if given_on_device else inside
