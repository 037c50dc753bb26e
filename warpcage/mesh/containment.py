"""Which points lie inside a mesh."""

from __future__ import annotations

from typing import overload

import numpy as np
import warp as wp

from ..core.arrays import PointsLike, as_host_points, as_points, is_device_array, points_in_turn
from ..core.devices import launch, resolve_device
from ..core.modules import Kernel
from ..kernels.mesh.containment import measure_distance, measure_winding_number
from .closed_mesh import ClosedMesh
from .usable import require_usable

#: Points this close to a mesh, as a share of its size, count as inside.
SURFACE_TOLERANCE = 1e-5


@overload
@points_in_turn
def inside_mesh(
    points: wp.array, mesh: ClosedMesh, *, tolerance: float = ..., device: wp.DeviceLike = ...
) -> wp.array: ...
@overload
def inside_mesh(
    points: PointsLike, mesh: ClosedMesh, *, tolerance: float = ..., device: wp.DeviceLike = ...
) -> np.ndarray: ...
def inside_mesh(
    points: PointsLike, mesh: ClosedMesh, *, tolerance: float = SURFACE_TOLERANCE, device: wp.DeviceLike = None
) -> np.ndarray | wp.array:
    """Whether points (n, 3), world units, are inside a usable mesh or on its surface: (n,) bool, on a device for points
    on one. tolerance: points this close to the surface are inside, as a share of the mesh's size."""
    # Inside is a winding number above 1/2, so that a cavity is outside, and a place that a tangled pose covers twice is
    # inside.
    require_usable(mesh)
    if is_device_array(points):
        array, _ = as_points(points, device)
        assert array.device is not None
        inside = _inside(as_host_points(array), mesh, tolerance, array.device)
        return wp.array(inside, dtype=wp.bool, device=array.device)
    return _inside(as_host_points(points), mesh, tolerance, resolve_device(device))


def _inside(points: np.ndarray, mesh: ClosedMesh, tolerance: float, device: wp.Device) -> np.ndarray:
    # float32 relative to the mesh's middle, so that a mesh far from the origin keeps its digits, and to its size, so
    # that products of lengths stay in range
    centre, size = mesh.bounds.mean(axis=0), mesh.size
    inside = np.zeros(len(points), dtype=bool)
    reach = tolerance * size
    near = np.flatnonzero(((points >= mesh.bounds[0] - reach) & (points <= mesh.bounds[1] + reach)).all(axis=1))
    vertices = wp.array(((mesh.vertices - centre) / size).astype(np.float32), dtype=wp.vec3, device=device)
    faces = wp.array(mesh.faces, dtype=wp.vec3i, device=device)

    def measure(kernel: Kernel, rows: np.ndarray) -> np.ndarray:
        local = wp.array(((points[rows] - centre) / size).astype(np.float32), dtype=wp.vec3, device=device)
        values = wp.empty(len(rows), dtype=wp.float32, device=device)  # pyright: ignore[reportArgumentType]
        launch(kernel, len(rows), [local, vertices, faces], [values], device=device, work=len(mesh.faces))
        return values.numpy()

    if len(near):
        inside[near] = measure(measure_winding_number, near) > 0.5
    outside = near[~inside[near]]
    if len(outside):
        inside[outside] = measure(measure_distance, outside) <= tolerance
    return inside
