"""Cage coordinates of points: mean value, green and harmonic ones."""
# Mean value coordinates: Floater, Kos and Reimers 2005; Ju, Schaefer and Warren 2005. Green coordinates: Lipman, Levin
# and Cohen-Or 2008. Harmonic coordinates: Joshi et al. 2007. Radiance fields go through `Deformer`, whose map runs from
# the deformed cage to the rest cage; `deform_points` runs the other way.

from __future__ import annotations

import numpy as np
import warp as wp

from ..core.arrays import PointsLike, empty_array, points_in_turn
from ..core.devices import launch
from ..kernels.coordinates import green, local_points, mean_value
from ..mesh.mesh import ClosedMesh, require_mesh
from ..mesh.validity import require_usable
from .harmonic import HARMONIC_RESOLUTION, harmonic_weights
from .points import (
    _as_given,
    _cage_arrays,
    _localise,
    _outside_message,
    _outside_points,
    _require_inside,
    _require_near,
    _require_room,
)


@points_in_turn
def mean_value_coordinates(points: PointsLike, cage: ClosedMesh, device: wp.DeviceLike = None) -> np.ndarray | wp.array:
    """Mean value coordinates of points in a cage.

    On the cage, to 1e-6 of its size, they interpolate the face linearly. Outside they extend the map smoothly. Weights
    may be negative there, and in concave cages; next to where two parts of a cage touch they grow as one over the
    distance. Weights are good to about 1e-6 inside the cage. Outside they grow with the distance, and so does the
    rounding error of their sum: 1e-7 of the largest.

    Args:
        points: (n, 3), world units, up to a thousand times the cage's size away. NumPy, or an array on a device (Warp
            or DLPack; in float32 there).
        cage: Usable Cage of v vertices.
        device: Warp device. None is the device of an array on a device, else CUDA where there is one.

    Returns:
        (n, v) float32; each row sums to one and reproduces its point. NumPy for NumPy, a Warp array for an array on a
        device.

    Raises:
        ValueError: For points of another shape, not finite or farther away, for a cage that is open, inward or
            degenerate, and for too little memory on the device.
    """
    require_mesh(cage, "the cage must be")
    require_usable(cage)
    local = _localise(points, cage.bounds.mean(axis=0), cage.size, device)
    _require_near(local, cage)
    _require_room(local, len(cage.vertices))
    weights = empty_array((local.count, len(cage.vertices)), wp.float32, local.device)
    vertices, faces = _cage_arrays(cage, local)
    inputs = [local.points, vertices, faces, 1.0]
    launch(mean_value.weigh_mean_value, local.count, inputs, [weights], device=local.device, work=len(cage.faces))
    return local.given_back(weights)


@points_in_turn
def green_coordinates(
    points: PointsLike, cage: ClosedMesh, device: wp.DeviceLike = None, *, outside: str = "raise"
) -> tuple[np.ndarray | wp.array, np.ndarray | wp.array]:
    """Green coordinates of points inside a cage.

    x = vertex_weights @ vertices + face_weights @ normals, with the unit outward normals. A deformed cage takes its
    vertices and `stretched_normals(cage, deformed)` in their place. Points within 1e-5 of the cage's size of its
    surface, on either side, get the limit from inside. Farther outside green coordinates are not defined.

    Args:
        points: (n, 3), world units. NumPy, or an array on a device (Warp or DLPack; in float32 there).
        cage: Usable Cage of v vertices and f faces.
        device: Warp device. None is the device of an array on a device, else CUDA where there is one.
        outside: "raise" refuses points outside; "nan" fills their rows with NaN.

    Returns:
        Vertex weights (n, v) and face weights (n, f), float32; the latter are lengths in world units. NumPy for NumPy,
        Warp arrays for an array on a device.

    Raises:
        ValueError: For points outside (with their number and the first of them), of another shape or not finite, for a
            cage that is open, inward or degenerate, and for too little memory on the device.
    """
    if outside not in ("raise", "nan"):
        raise ValueError(f"outside must be 'raise' or 'nan', got {outside!r}")
    require_mesh(cage, "the cage must be")
    require_usable(cage)
    local = _localise(points, cage.bounds.mean(axis=0), cage.size, device)
    lost = _outside_points(local, cage)
    if len(lost) and outside == "raise":
        raise ValueError(_outside_message(local, lost, "green"))
    _require_room(local, len(cage.vertices) + len(cage.faces))
    vertex_weights = empty_array((local.count, len(cage.vertices)), wp.float32, local.device)
    face_weights = empty_array((local.count, len(cage.faces)), wp.float32, local.device)
    vertices, faces = _cage_arrays(cage, local)
    launch(
        green.weigh_green,
        local.count,
        [local.points, vertices, faces, 1.0],
        [vertex_weights, face_weights],
        device=local.device,
        work=len(cage.faces),
    )
    launch(local_points.scale_rows, local.count, [cage.size], [face_weights], device=local.device)
    if len(lost):
        rows = wp.array(lost, dtype=wp.int32, device=local.device)
        for weights in (vertex_weights, face_weights):
            weights[rows].fill_(float("nan"))
    return local.given_back(vertex_weights), local.given_back(face_weights)


@points_in_turn
def harmonic_coordinates(
    points: PointsLike, cage: ClosedMesh, resolution: int = HARMONIC_RESOLUTION, device: wp.DeviceLike = None
) -> np.ndarray | wp.array:
    """Harmonic coordinates of points inside a cage.

    Warns where gaps of the cage are narrower than a cell of the lattice.

    Args:
        points: (n, 3), world units. NumPy, or an array on a device (Warp or DLPack; in float32 there).
        cage: Usable Cage of v vertices.
        resolution: Cells along the longest side of the lattice on which they are solved, 8 to 1024. Errors at 128 are
            about 1e-3 away from the cage and 1e-2 next to it.
        device: Warp device. None is the device of an array on a device, else CUDA where there is one.

    Returns:
        (n, v) float32, not negative up to rounding; rows sum to one. NumPy for NumPy, a Warp array for an array on a
        device.

    Raises:
        ValueError: For points farther outside than 1e-5 of the cage's size, of another shape or not finite, for a cage
            that is open, inward or degenerate, a resolution out of range, and for too little memory on the device.
    """
    require_mesh(cage, "the cage must be")
    require_usable(cage)
    local = _localise(points, cage.bounds.mean(axis=0), cage.size, device)
    _require_inside(local, cage, "harmonic")
    weights = harmonic_weights(local.given, cage, resolution, local.device)
    return _as_given(weights, local)
