"""Cage coordinates of points, and the deformation of points and meshes by a cage.

Mean value coordinates (Floater, Kos and Reimers 2005; Ju, Schaefer and Warren 2005), green coordinates (Lipman, Levin
and Cohen-Or 2008) and harmonic coordinates (Joshi et al. 2007). Radiance fields go through `Deformer`, whose map runs
from the deformed cage to the rest cage; `deform_points` runs the other way.
"""

from __future__ import annotations

import warp as wp

from ..core.devices import launch
from ..kernels.coordinates import green, local_points, mean_value
from ..mesh.closed_mesh import ClosedMesh, require_mesh
from ..mesh.usable import require_usable
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


def mean_value_coordinates(points, cage: ClosedMesh, device=None):
    """Mean value coordinates of points in a cage: (n, v) float32, each row sums to one and reproduces its point.

    points: (n, 3), world units, NumPy or an array of a device (Warp, DLPack; in float32 there); inside the cage or out,
    up to a thousand times its size away (outside they extend the map smoothly; weights may be negative there, and in
    concave cages; next to where two parts of a cage touch they grow as one over the distance). On the cage, to 1e-6 of
    its size, they interpolate the face linearly. cage: usable `Cage` of v vertices. device: None takes that of an array
    of a device, else the first GPU or the CPU.
    Returns NumPy for NumPy, a Warp array on the device for an array of a device. Weights are good to about 1e-6 inside
    the cage. Outside they grow with the distance, and so does what rounding leaves of their sum: 1e-7 of the largest.
    Raises ValueError for points of another shape, not finite or farther away, for a cage that is open, inward or
    degenerate, and where the device has not the memory.
    """
    require_mesh(cage, "the cage must be")
    require_usable(cage)
    local = _localise(points, cage.bounds.mean(axis=0), cage.size, device)
    _require_near(local, cage)
    _require_room(local, len(cage.vertices))
    weights = wp.empty((local.count, len(cage.vertices)), dtype=wp.float32, device=local.device)
    vertices, faces = _cage_arrays(cage, local)
    launch(
        mean_value.weigh_mean_value, local.count, [local.points, vertices, faces, 1.0], [weights], device=local.device
    )
    return local.given_back(weights)


def green_coordinates(points, cage: ClosedMesh, device=None, *, outside: str = "raise"):
    """Green coordinates of points inside a cage: vertex weights (n, v) and face weights (n, f), float32.

    points, cage, device and what is returned: as in `mean_value_coordinates`. x = vertex_weights @ vertices +
    face_weights @ normals, with the unit outward normals; the face weights are lengths in world units. A deformed
    cage takes its vertices and `stretched_normals(cage, deformed)` in their place.
    Points within 1e-5 of the cage's size of its surface, either side, get the limit from inside. Farther outside green
    coordinates are not defined: outside="raise" raises a ValueError with their number and the first of them,
    outside="nan" fills their rows with NaN.
    Raises ValueError as `mean_value_coordinates` does besides.
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
    vertex_weights = wp.empty((local.count, len(cage.vertices)), dtype=wp.float32, device=local.device)
    face_weights = wp.empty((local.count, len(cage.faces)), dtype=wp.float32, device=local.device)
    vertices, faces = _cage_arrays(cage, local)
    launch(
        green.weigh_green,
        local.count,
        [local.points, vertices, faces, 1.0],
        [vertex_weights, face_weights],
        device=local.device,
    )
    launch(local_points.scale_rows, local.count, [cage.size], [face_weights], device=local.device)
    if len(lost):
        rows = wp.array(lost, dtype=wp.int32, device=local.device)
        for weights in (vertex_weights, face_weights):
            weights[rows].fill_(float("nan"))
    return local.given_back(vertex_weights), local.given_back(face_weights)


def harmonic_coordinates(points, cage: ClosedMesh, resolution: int = HARMONIC_RESOLUTION, device=None):
    """Harmonic coordinates of points inside a cage: (n, v) float32, not negative up to rounding, rows sum to one.

    points, cage, device and what is returned: as in `mean_value_coordinates`; points farther than 1e-5 of the size
    outside raise a ValueError. resolution: nodes along the longest side of the lattice on which they are solved; errors
    at 128 are about 1e-3 away from the cage and 1e-2 next to it. Warns where gaps of the cage are narrower than a cell.
    """
    require_mesh(cage, "the cage must be")
    require_usable(cage)
    local = _localise(points, cage.bounds.mean(axis=0), cage.size, device)
    _require_inside(local, cage, "harmonic")
    weights = harmonic_weights(local.given, cage, resolution, local.device)
    return _as_given(weights, local)
