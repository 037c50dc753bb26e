"""Points and normals moved by a cage."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..core.devices import launch
from ..core.names import KINDS
from ..kernels.coordinates import green, mean_value
from ..kernels.lattice import cage_map
from ..lattice.position_map import PositionMap
from ..mesh import faces as face_geometry
from ..mesh.closed_mesh import ClosedMesh, require_mesh
from ..mesh.fans import prepared_fans
from ..mesh.match import require_same_faces
from ..mesh.usable import require_usable
from .harmonic import HARMONIC_RESOLUTION
from .points import _cage_arrays, _Local, _localise, _require_finite, _require_inside, _require_near, _restore


def deform_points(points, rest: ClosedMesh, deformed: ClosedMesh, coordinates: str = "mean_value", device=None):
    """Move points, the vertices of a mesh say, as the cage around them moves from `rest` to `deformed`: (n, 3).

    points: (n, 3), world units, NumPy or an array of a device. rest: usable `Cage`; deformed: the same faces in another
    pose. coordinates: "mean_value" (points up to 1000 sizes away), "green" or "harmonic" (points inside `rest`, or
    within 1e-5 of its size; harmonic on a lattice of 128 nodes). device: as in `mean_value_coordinates`.
    Returns world units: float32 for float32 NumPy, float64 for other NumPy (float32 accuracy relative to the cages),
    a Warp array of vec3 for an array of a device. No (n, v) matrix is held, save by harmonic.
    Raises ValueError for points of another shape, not finite, outside (green, harmonic) or farther away (mean_value),
    with their number and the first of them; for cages whose faces differ; for a rest cage, and with harmonic a deformed
    cage, that is not usable; for another name of coordinates.

    Example: `mesh.vertices = deform_points(mesh.vertices, rest, rest.twist(90))`
    """
    if coordinates not in KINDS:
        raise ValueError(f"coordinates must be one of {', '.join(KINDS)}, got {coordinates!r}")
    for cage, name in ((rest, "rest"), (deformed, "deformed")):
        require_mesh(cage, f"the {name} cage must be")
    require_usable(rest, "rest cage")
    require_same_faces(rest, deformed)
    local = _localise(points, rest.bounds.mean(axis=0), rest.size, device, check=coordinates == "harmonic")
    if coordinates == "harmonic":
        _require_inside(local, rest, coordinates)
        return _deform_harmonic(local, rest, deformed)

    centre = deformed.bounds.mean(axis=0)
    targets = ((deformed.vertices - centre) / rest.size).astype(np.float32)
    targets = wp.array(targets, dtype=wp.vec3, device=local.device)
    moved = wp.empty(local.count, dtype=wp.vec3, device=local.device)
    vertices, _ = _cage_arrays(rest, local)
    fans = rest.topology.fans
    faces = wp.array(fans.faces, dtype=wp.vec3i, device=local.device)
    inputs = [local.points, vertices, faces, prepared_fans(vertices, faces, 1.0), targets]
    if coordinates == "green":
        normals = stretched_normals(rest, deformed)[fans.order].astype(np.float32)
        inputs += [wp.array(normals, dtype=wp.vec3, device=local.device), 1.0]
        launch(green.map_green_inside, local.count, inputs, [moved, local.bad], device=local.device)
    else:
        launch(mean_value.map_mean_value, local.count, [*inputs, 1.0], [moved], device=local.device)
    world = _restore(moved, local, centre, rest.size)
    if int(local.bad.numpy()[0]):  # read once, after all is under way
        _require_finite(local)
        if coordinates == "green":
            _require_inside(local, rest, coordinates)
        else:
            _require_near(local, rest)
    return world


def stretched_normals(source: ClosedMesh, target: ClosedMesh) -> np.ndarray:
    """Unit normals of `target`'s faces times how much each is stretched from `source`'s: (f, 3) float64.

    What green face weights computed on `source` multiply; see face_geometry for the formula. A target face without area
    has no normal and gives zero. Raises ValueError for cages whose faces differ.
    """
    require_same_faces(source, target)
    return face_geometry.stretched_normals(source, face_geometry.StretchTarget.of(target)).T


def _deform_harmonic(local: _Local, rest: ClosedMesh, deformed: ClosedMesh):
    require_usable(deformed, "deformed cage")
    # the map runs from the cage it is posed to, here the rest cage, to the one it is made of; both about the origin, as
    # float32 keeps few digits of a map between cages that are far apart
    centre = deformed.bounds.mean(axis=0)
    target = deformed.with_vertices((deformed.vertices - centre) / rest.size)
    source = rest.with_vertices((rest.vertices - rest.bounds.mean(axis=0)) / rest.size)
    position_map = PositionMap(
        target, coordinates="harmonic", resolution=HARMONIC_RESOLUTION, origin=np.zeros(3), device=local.device
    ).pose(source)
    moved, distance = wp.empty_like(local.points), wp.empty(local.count, dtype=float, device=local.device)
    launch(cage_map.sample_map, local.count, [position_map.data, local.points], [moved, distance], device=local.device)
    return _restore(moved, local, centre, rest.size)
