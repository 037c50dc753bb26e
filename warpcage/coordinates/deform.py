"""Points and normals moved by a cage."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..core.arrays import PointsLike, empty_array, points_in_turn
from ..core.devices import launch
from ..core.names import require_coordinates
from ..kernels.coordinates import green, mean_value
from ..kernels.lattice import cage_map
from ..lattice.position_map import PositionMap
from ..mesh import faces as face_geometry
from ..mesh.fans import prepared_fans
from ..mesh.match import require_same_faces
from ..mesh.mesh import ClosedMesh, require_mesh
from ..mesh.validity import require_usable, size_problem
from .harmonic import HARMONIC_RESOLUTION
from .points import _cage_arrays, _Local, _localise, _require_finite, _require_inside, _require_near, _restore


@points_in_turn
def deform_points(
    points: PointsLike,
    rest: ClosedMesh,
    deformed: ClosedMesh,
    coordinates: str = "mean_value",
    device: wp.DeviceLike = None,
) -> np.ndarray | wp.array:
    """Move points, such as the vertices of a mesh, as the cage around them moves.

    No (n, v) matrix of weights is held. Example: `mesh.vertices = deform_points(mesh.vertices, rest, rest.twist(90))`

    Args:
        points: (n, 3), world units. NumPy or an array on a device.
        rest: Usable Cage around the points.
        deformed: The same faces in another pose.
        coordinates: "mean_value" (points up to 1000 times the cage's size away), "green" or "harmonic" (points inside
            `rest`, or within 1e-5 of its size of it; harmonic on a lattice of 128 cells along the longest side).
        device: Warp device. None is the device of an array on a device, else CUDA where there is one.

    Returns:
        (n, 3), world units: float32 for float32 NumPy, float64 for other NumPy (with float32 accuracy relative to the
        cages), and a Warp array of vec3 for an array on a device.

    Raises:
        ValueError: For points of another shape, not finite, outside (green, harmonic) or farther away (mean_value),
            with their number and the first of them. For cages whose faces differ, and for a rest cage (harmonic: also a
            deformed cage) that is not usable. For another name of coordinates.
    """
    require_coordinates(coordinates)
    for cage, name in ((rest, "rest"), (deformed, "deformed")):
        require_mesh(cage, f"the {name} cage must be")
    require_usable(rest, "rest cage")
    require_same_faces(rest, deformed)
    if deformed.size > rest.size and (problem := size_problem(deformed)):
        raise ValueError(f"deformed cage {problem}")
    local = _localise(points, rest.bounds.mean(axis=0), rest.size, device, check=coordinates == "harmonic")
    if coordinates == "harmonic":
        _require_inside(local, rest, coordinates)
        return _deform_harmonic(local, rest, deformed)

    centre = deformed.bounds.mean(axis=0)
    targets = ((deformed.vertices - centre) / rest.size).astype(np.float32)
    targets = wp.array(targets, dtype=wp.vec3, device=local.device)
    moved = empty_array(local.count, wp.vec3, local.device)
    vertices, _ = _cage_arrays(rest, local)
    fans = rest.topology.fans
    faces = wp.array(fans.faces, dtype=wp.vec3i, device=local.device)
    work = len(rest.faces)
    inputs = [local.points, vertices, faces, prepared_fans(vertices, faces, 1.0), targets]
    if coordinates == "green":
        normals = stretched_normals(rest, deformed)[fans.order].astype(np.float32)
        inputs += [wp.array(normals, dtype=wp.vec3, device=local.device), 1.0]
        launch(green.map_green_inside, local.count, inputs, [moved, local.bad], device=local.device, work=work)
    else:
        launch(mean_value.map_mean_value, local.count, [*inputs, 1.0], [moved], device=local.device, work=work)
    world = _restore(moved, local, centre, rest.size)
    if int(local.bad.numpy()[0]):  # read once, after all is under way
        _require_finite(local)
        if coordinates == "green":
            _require_inside(local, rest, coordinates)
        else:
            _require_near(local, rest)
    return world


def stretched_normals(source: ClosedMesh, target: ClosedMesh) -> np.ndarray:
    """Unit normals of a deformed cage's faces times how much each face is stretched, (f, 3) float64.
    Zero for a target face without area, which has no normal."""
    # Green face weights computed on `source` multiply them (warpcage/mesh/faces.py has the formula).
    require_same_faces(source, target)
    return face_geometry.stretched_normals(source, face_geometry.StretchTarget.of(target)).T


def _deform_harmonic(local: _Local, rest: ClosedMesh, deformed: ClosedMesh) -> np.ndarray | wp.array:
    require_usable(deformed, "deformed cage")
    # the map runs from the cage it is posed to, here the rest cage, to the one it is made of; both about the origin, as
    # float32 keeps few digits of a map between cages that are far apart
    centre = deformed.bounds.mean(axis=0)
    target = deformed.with_vertices((deformed.vertices - centre) / rest.size)
    source = rest.with_vertices((rest.vertices - rest.bounds.mean(axis=0)) / rest.size)
    position_map = PositionMap(
        target, coordinates="harmonic", resolution=HARMONIC_RESOLUTION, origin=np.zeros(3), device=local.device
    ).pose(source)
    moved, distance = wp.empty_like(local.points), empty_array(local.count, float, local.device)
    launch(cage_map.sample_map, local.count, [position_map.data, local.points], [moved, distance], device=local.device)
    return _restore(moved, local, centre, rest.size)
