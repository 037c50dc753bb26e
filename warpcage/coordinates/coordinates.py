"""Cage coordinates of points (a function for each kind), and points moved by a cage."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar, overload

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ..coordinate_kinds import COORDINATE_KINDS, CoordinateKind, names_where
from ..core.arrays import (
    DLPackArray,
    PointsLike,
    as_given,
    as_host_points,
    device_rows,
    empty_array,
    is_device_array,
    localised,
    moved,
    points_device,
    points_in_turn,
)
from ..core.checks import device_by_name
from ..core.devices import launch
from ..core.memory import require_memory
from ..core.names import OUTSIDE, POINT_COORDINATES, agreed, checked_choice, coordinate_kind
from ..core.reports import Progress, reports_progress
from ..errors import InputError
from ..kernels.coordinates import local_points
from ..kernels.lattice import cage_map
from ..lattice.position_map import PositionMap
from ..mesh import faces as face_geometry
from ..mesh.biharmonic import LayerEquations
from ..mesh.match import posed_mesh, require_same_faces, with_faces_of
from ..mesh.mesh import ClosedMesh, prepared_fans, prepared_quads, require_mesh
from ..mesh.queries import SURFACE_TOLERANCE, inside_mesh
from ..mesh.surface import CELLS
from ..mesh.validity import require_covered_once, require_usable, size_problem
from .harmonic import HARMONIC_RESOLUTION, harmonic_weights


@dataclass
class LocalPoints:
    """Points in a local frame: a cage's has the middle of its bounding box at the origin and a longest side of one."""

    given: PointsLike  # as given by the caller
    points: wp.array  # (n,) vec3 on device
    bad: wp.array  # (3,) int, above 0 where a point is not finite; FARTHEST away or more; outside, as kernels find it

    @property
    def device(self) -> wp.Device:
        return self.points.device  # pyright: ignore[reportReturnType]

    @property
    def count(self) -> int:
        return len(self.points)

    @functools.cached_property
    def world(self) -> np.ndarray:
        """The points in world units, on the host: (n, 3) float64, finite."""
        return as_host_points(self.given)

    def place(self, row: int) -> str:
        """World position of a point, for messages."""
        return ", ".join(f"{value:.6g}" for value in self.world[row])


def _localise(points: PointsLike, cage: ClosedMesh, device: wp.DeviceLike) -> LocalPoints:
    """Points relative to a cage. Those of a device that are not finite are found by `_lost_rows`, which waits."""
    center, place = cage.bounds.mean(axis=0), points_device(points, device)
    if is_device_array(points):
        return LocalPoints(points, *localised(moved(device_rows(points), place), center, cage.size))
    host = (as_host_points(points) - center) / cage.size
    bad = [0, int(not (np.abs(host) < local_points.FARTHEST).all()), 0]
    with np.errstate(over="ignore"):
        local = wp.array(host.astype(np.float32), dtype=wp.vec3, device=place)
    return LocalPoints(points, local, wp.array(bad, dtype=int, device=place))


def _way_outside(outside: str | None, kind: CoordinateKind) -> str:
    """What happens to points outside of a cage, as `outside=` says it; None is the default of the kind."""
    if outside is None:
        return "extend" if kind.extends else "raise"
    if checked_choice(outside, "outside", OUTSIDE) == "extend" and not kind.extends:
        raise InputError(f"{kind.name} coordinates are not defined outside of a cage: take outside='raise' or 'nan'")
    return outside


def _lost_rows(
    local: LocalPoints, cage: ClosedMesh, kind: CoordinateKind, outside: str, *, flagged: bool = False
) -> np.ndarray:
    """Rows of points that have no coordinates, to be NaN; waits for the device once, and refuses bad points.
    flagged: a kernel has set `bad[2]` where a point is outside."""
    not_finite, far, found = local.bad.numpy()
    if not_finite:
        _ = local.world  # raises
    if outside == "extend":
        if far:
            _require_near(local, cage)
        return np.zeros(0, np.int64)
    if flagged and not found:
        return np.zeros(0, np.int64)
    lost = _outside_points(local, cage)
    if len(lost) and outside == "raise":
        hint = "" if kind.extends else f", {' or '.join(names_where('extends'))} for any"
        if cage.operator is not None and kind.face_cells < CELLS:
            hint += f"; of faces of four and more corners they take the triangles of refined({kind.face_cells})"
        raise InputError(
            f"{len(lost)} of {local.count} points {agreed(len(lost), 'is', 'are')} outside the cage by more "
            f"than {SURFACE_TOLERANCE:g} of its size, "
            f"the first is point {lost[0]} at ({local.place(lost[0])}): {kind.name} coordinates are for points "
            f"inside{hint}"
        )
    return lost


def _require_near(local: LocalPoints, cage: ClosedMesh) -> None:
    """Refuse points so far from the cage that their mean value weights have no digits."""
    away = np.abs(local.world - cage.bounds.mean(axis=0)).max(axis=1) / cage.size
    lost = np.flatnonzero(away >= local_points.FARTHEST)
    raise InputError(
        f"{len(lost)} of {local.count} points {agreed(len(lost), 'is', 'are')} "
        f"{local_points.FARTHEST:.0f} times the cage's size "
        f"away or more, the first is point {lost[0]} at ({local.place(lost[0])}): leave them out"
    )


def _require_solved(local: LocalPoints, kind: CoordinateKind, values: Any, lost: np.ndarray) -> None:
    """Refuse points for which the iterations found nothing; values: (n,), NaN for these, and for lost rows perhaps."""
    launch(local_points.find_not_finite, local.count, [values], [local.bad[2:]], device=local.device)
    if local.bad.numpy()[2]:
        unsolved = np.setdiff1d(np.flatnonzero(np.isnan(values.numpy().reshape(local.count, -1)[:, 0])), lost)
        if len(unsolved):
            raise InputError(
                f"{len(unsolved)} of {local.count} points {agreed(len(unsolved), 'has', 'have')} no {kind.name} "
                f"coordinates, the first is point {unsolved[0]} at ({local.place(unsolved[0])}): "
                "the cage must not pass through itself, be inside out or a hundred times wider than high there"
            )


def _set_nan(array: wp.array, rows: np.ndarray) -> None:
    """Fill rows, at least one, with NaN."""
    array[wp.array(rows, dtype=wp.int32, device=array.device)].fill_(float("nan"))


def _restored(positions: wp.array, local: LocalPoints, center: np.ndarray, size: float) -> Any:
    """Local positions in world units, as an array of the points' kind."""
    if is_device_array(local.given):
        world = wp.empty_like(positions)
        inputs = [positions, wp.vec3d(*center), wp.float64(size)]
        launch(local_points.restore_points, local.count, inputs, [world], device=local.device)
        return as_given(world, local.given)
    world = positions.numpy().astype(np.float64).reshape(-1, 3) * size + center
    single = isinstance(local.given, np.ndarray) and local.given.dtype == np.float32
    return world.astype(np.float32) if single else world


def cage_arrays(cage: ClosedMesh, local: LocalPoints) -> tuple[wp.array, wp.array]:
    vertices = ((cage.vertices - cage.bounds.mean(axis=0)) / cage.size).astype(np.float32)
    return (
        wp.array(vertices, dtype=wp.vec3, device=local.device),
        wp.array(cage.faces, dtype=wp.vec3i, device=local.device),
    )


def _outside_points(local: LocalPoints, cage: ClosedMesh) -> np.ndarray:
    """Rows of the points farther outside than 1e-5 of the size."""
    if not local.count:
        return np.zeros(0, dtype=np.int64)
    return np.flatnonzero(~inside_mesh(local.world, cage, device=local.device))


def _require_room(local: LocalPoints, columns: int) -> None:
    """Refuse weights that the device has not the memory for; NumPy results are held on the host as well."""
    size = 4 * local.count * columns
    message = f"weights of {local.count} points, {columns} each, need {{size}}: take fewer points at a time"
    require_memory(size, local.device, message + ", or deform_points, which keeps none")
    if not is_device_array(local.given) and not local.device.is_cpu:
        require_memory(size, wp.get_device("cpu"), message)


#: Numbers that NumPy results keep; others become float64.
_Precision = TypeVar("_Precision", np.float32, np.float64)

#: An array of a library other than NumPy: results are of its class.
_DeviceArray = TypeVar("_DeviceArray", bound=DLPackArray)


@overload
def deform_points(
    points: NDArray[_Precision],
    rest: ClosedMesh,
    deformed: ClosedMesh | PointsLike,
    coordinates: str = ...,
    *,
    device: wp.DeviceLike = ...,
    outside: str | None = ...,
) -> NDArray[_Precision]: ...
@overload
def deform_points(
    points: NDArray[Any] | Sequence[Any],
    rest: ClosedMesh,
    deformed: ClosedMesh | PointsLike,
    coordinates: str = ...,
    *,
    device: wp.DeviceLike = ...,
    outside: str | None = ...,
) -> NDArray[np.float64]: ...
@overload
def deform_points(
    points: _DeviceArray,
    rest: ClosedMesh,
    deformed: ClosedMesh | PointsLike,
    coordinates: str = ...,
    *,
    device: wp.DeviceLike = ...,
    outside: str | None = ...,
) -> _DeviceArray: ...
@overload
def deform_points(
    points: PointsLike,
    rest: ClosedMesh,
    deformed: ClosedMesh | PointsLike,
    coordinates: str = ...,
    *,
    device: wp.DeviceLike = ...,
    outside: str | None = ...,
) -> Any: ...
@points_in_turn
@device_by_name
def deform_points(
    points: PointsLike,
    rest: ClosedMesh,
    deformed: ClosedMesh | PointsLike,
    coordinates: str = POINT_COORDINATES,
    *,
    device: wp.DeviceLike = None,
    outside: str | None = None,
) -> Any:
    """Move points, such as the vertices of a mesh, as the cage around them moves.

    No (n, v) matrix of weights is held. Example: `mesh.vertices = deform_points(mesh.vertices, rest, rest.twist(90))`

    Args:
        points: (n, 3), world units. NumPy, Warp or any DLPack array (docs/arrays.md).
        rest: Usable Cage around the points.
        deformed: The same faces in another pose, or its vertices (v, 3) in world units as an array of any library.
        coordinates: "mean_value" (the default here, as it holds for any point), "green", "biharmonic",
            "maximum_likelihood" or "harmonic" (the default of a Deformer; here on a lattice of 128 cells along the
            longest side). Their poses differ: name the one that a Deformer has to have points go with it.
        device: Warp device. None is the device of an array on a device, else CUDA where there is one.
        outside: What happens to points outside of `rest`, by more than 1e-5 of its size. "extend" moves them too
            (mean_value alone, up to 1000 times the size away); "raise" refuses them; "nan" makes NaN of them. None is
            "extend" for mean_value, else "raise".

    Returns:
        (n, 3), world units, an array of the points' kind on their device: float32, but float64 for NumPy of other
        numbers (with float32 accuracy relative to the cages).

    Raises:
        ValueError: For points of another shape, not finite, outside or too far away, with their number and the first
            of them. For cages whose faces differ, and for a rest cage (harmonic: also a deformed cage) that is not
            usable. For another name of coordinates or of `outside`.
    """
    kind = coordinate_kind(coordinates)
    require_mesh(rest, "the rest cage must be")
    require_usable(rest, "rest cage")
    if kind.is_summed:
        require_covered_once(rest, kind.name, "rest cage")
    deformed = posed_mesh(rest, deformed, "the deformed cage must be")
    if not kind.is_closed_form:
        require_usable(deformed, "deformed cage")
    if deformed.size > rest.size and (problem := size_problem(deformed)):
        raise InputError(f"deformed cage {problem}")
    rest, deformed = (cage.refined(kind.face_cells) for cage in (rest, deformed))
    move_points = kind.load("move_points")
    return move_points(kind, _localise(points, rest, device), rest, deformed, _way_outside(outside, kind))


def move_in_closed_form(
    kind: CoordinateKind, local: LocalPoints, rest: ClosedMesh, deformed: ClosedMesh, outside: str
) -> Any:
    """Points moved by a kernel that evaluates the coordinates; arguments and result as in `deform_points`."""
    device, center = local.device, deformed.bounds.mean(axis=0)
    vertices, _ = cage_arrays(rest, local)
    faces = wp.array(rest.topology.fans.faces, dtype=wp.vec3i, device=device)
    targets = (deformed.vertices - center) / rest.size
    inputs, field = [local.points, vertices, faces, prepared_fans(vertices, faces, 1.0)], "map_points"
    if rest.quads is not None and kind.map_quads:
        quads, field = wp.array(rest.quads, dtype=wp.vec4i, device=device), "map_quads"
        inputs = [local.points, vertices, quads, prepared_quads(vertices, quads, 1.0)]
    inputs.append(wp.array(targets.astype(np.float32), dtype=wp.vec3, device=device))
    positions = empty_array(local.count, wp.vec3, device)
    outputs: list[Any] = [positions]
    if kind.has_face_weights:
        face_values = stretched_normals(rest, deformed)[rest.topology.fans.order]
        if kind.face_layers > 1:
            face_values = LayerEquations(rest, rest.topology.fans.faces, 1.0, device).solve(targets, face_values)
        inputs.append(wp.array(face_values.astype(np.float32), dtype=wp.vec3, device=device))
        outputs.append(local.bad[2:])
    launch(kind.load(field), local.count, [*inputs, 1.0], outputs, device=device, work=len(rest.faces))
    world = _restored(positions, local, center, rest.size)
    lost = _lost_rows(local, rest, kind, outside, flagged=kind.has_face_weights)  # waits, so after all launches
    if kind.is_iterative:
        _require_solved(local, kind, positions, lost)
    if len(lost):
        _set_nan(positions, lost)
        world = _restored(positions, local, center, rest.size)
    return world


def stretched_normals(source: ClosedMesh, target: ClosedMesh) -> np.ndarray:
    """Unit normals of a deformed cage's faces times how much each face is stretched, (f, 3) float64.
    Zero for a target face without area, which has no normal. Green face weights of `source` multiply them."""
    # faces are the triangles that Green coordinates are computed on
    require_same_faces(source, target)
    cells = COORDINATE_KINDS["green"].face_cells
    source, target = source.refined(cells), with_faces_of(source, target).refined(cells)
    return face_geometry.stretched_normals(source, face_geometry.StretchTarget.of(target)).T


def move_on_lattice(
    kind: CoordinateKind, local: LocalPoints, rest: ClosedMesh, deformed: ClosedMesh, outside: str
) -> Any:
    """Points moved by a map on a lattice; arguments and result as in `deform_points`."""
    lost = _lost_rows(local, rest, kind, outside)
    position_map, center = posed_on_lattice(kind, local, rest, deformed)
    positions, distance = wp.empty_like(local.points), empty_array(local.count, float, local.device)
    launch(
        cage_map.sample_map, local.count, [position_map.data, local.points], [positions, distance], device=local.device
    )
    if len(lost):
        _set_nan(positions, lost)
    return _restored(positions, local, center, rest.size)


def posed_on_lattice(
    kind: CoordinateKind, local: LocalPoints, rest: ClosedMesh, deformed: ClosedMesh
) -> tuple[PositionMap, np.ndarray]:
    """The map of points in the frame of the cage at rest to places in sizes of it from a center, and that center."""
    # the map runs from the cage it is posed to, here the rest cage, to the one it is made of; both about the origin, as
    # float32 keeps few digits of a map between cages that are far apart
    center = deformed.bounds.mean(axis=0)
    target = deformed.with_vertices((deformed.vertices - center) / rest.size)
    source = rest.with_vertices((rest.vertices - rest.bounds.mean(axis=0)) / rest.size)
    position_map = PositionMap(
        target, coordinates=kind.name, resolution=HARMONIC_RESOLUTION, origin=np.zeros(3), device=local.device
    )
    return position_map.pose(source), center


@points_in_turn
@device_by_name
def mean_value_coordinates(
    points: PointsLike, cage: ClosedMesh, *, device: wp.DeviceLike = None, outside: str = "extend"
) -> Any:
    """Mean value coordinates of points in a cage.

    On the cage, to 1e-6 of its size, they interpolate the face linearly. Outside they extend the map smoothly. Weights
    may be negative there, and in concave cages; next to where two parts of a cage touch they grow as one over the
    distance. Weights are good to about 1e-6 inside the cage. Outside they grow with the distance, and so does the
    rounding error of their sum: 1e-7 of the largest.

    Args:
        points: (n, 3), world units. NumPy, Warp or any DLPack array (docs/arrays.md).
        cage: Usable Cage of v vertices.
        device: Warp device. None is the device of an array on a device, else CUDA where there is one.
        outside: What happens to points outside, by more than 1e-5 of the cage's size. "extend" gives them weights too,
            up to a thousand times the size away; "raise" refuses them; "nan" fills their rows with NaN.

    Returns:
        (n, v) float32, an array of the points' kind on their device; each row sums to one and reproduces its point.

    Raises:
        ValueError: For points of another shape, not finite, refused as outside or farther away, for a cage that is
            open, inward or degenerate, for too little memory on the device, and for another name of `outside`.
    """
    (weights,) = _weigh(COORDINATE_KINDS["mean_value"], points, cage, device, outside)
    return as_given(weights, points)


def _weigh(
    kind: CoordinateKind, points: PointsLike, cage: ClosedMesh, device: wp.DeviceLike, outside: str
) -> list[wp.array]:
    """Weights of vertices (n, v), and of faces (n, f) in world units where there are any, by a closed form."""
    from ..lattice.closed_form import closed_form_weights  # here, as frames by harmonic maps need no kernel of it

    local, lost, cage = checked_points(kind, points, cage, device, outside)
    _require_room(local, _row_length(kind, cage))
    vertices, faces = cage_arrays(cage, local)
    field = "weigh_points"
    if cage.quads is not None and kind.weigh_quads:
        faces, field = wp.array(cage.quads, dtype=wp.vec4i, device=local.device), "weigh_quads"
    weights = closed_form_weights(kind, local.points, vertices, faces, cage, 1.0, field)
    if kind.is_iterative and local.count:
        _require_solved(local, kind, weights[0][:, 0], lost)
    for lengths in weights[1:]:
        launch(local_points.scale_rows, local.count, [cage.size], [lengths], device=local.device)
    if len(lost):
        for array in weights:
            _set_nan(array, lost)
    return weights


def _row_length(kind: CoordinateKind, cage: ClosedMesh) -> int:
    """Numbers that are held for each point while it is weighed."""
    faces = kind.has_face_weights * len(cage.faces)
    return len(cage.vertices) + faces + (0 if cage.operator is None else cage.own_count)


def checked_points(
    kind: CoordinateKind, points: PointsLike, cage: ClosedMesh, device: wp.DeviceLike, outside: str | None
) -> tuple[LocalPoints, np.ndarray, ClosedMesh]:
    """Points in the frame of a usable cage, the rows that have no coordinates, and the cage's surface."""
    require_mesh(cage, "the cage must be")
    require_usable(cage)
    if kind.is_summed:
        require_covered_once(cage, kind.name)
    outside, cage = _way_outside(outside, kind), cage.refined(kind.face_cells)
    local = _localise(points, cage, device)
    return local, _lost_rows(local, cage, kind, outside), cage


@points_in_turn
@device_by_name
def green_coordinates(
    points: PointsLike, cage: ClosedMesh, *, device: wp.DeviceLike = None, outside: str = "raise"
) -> tuple[Any, Any]:
    """Green coordinates of points inside a cage.

    x = vertex_weights @ vertices + face_weights @ normals, with the unit outward normals. A deformed cage takes its
    vertices and `stretched_normals(cage, deformed)` in their place. Points within 1e-5 of the cage's size of its
    surface, on either side, get the limit from inside. Farther outside green coordinates are not defined.

    Args:
        points: (n, 3), world units. NumPy, Warp or any DLPack array (docs/arrays.md).
        cage: Usable Cage of v vertices and f faces.
        device: Warp device. None is the device of an array on a device, else CUDA where there is one.
        outside: "raise" refuses points outside; "nan" fills their rows with NaN.

    Returns:
        Vertex weights (n, v) and face weights (n, f), float32, arrays of the points' kind on their device; the latter
        are lengths in world units.

    Raises:
        ValueError: For points outside (with their number and the first of them), of another shape or not finite, for a
            cage that is open, inward or degenerate, for too little memory on the device, and for another `outside`.
    """
    vertex_weights, face_weights = _weigh(COORDINATE_KINDS["green"], points, cage, device, outside)
    return as_given(vertex_weights, points), as_given(face_weights, points)


@points_in_turn
def biharmonic_coordinates(
    points: PointsLike, cage: ClosedMesh, *, device: wp.DeviceLike = None, outside: str = "raise"
) -> tuple[Any, Any]:
    """Biharmonic coordinates of points inside a cage, with control of derivatives.

    x = vertex_weights @ vertices + face_weights @ normals, with the unit outward normals. A deformed cage takes its
    vertices and `stretched_normals(cage, deformed)` in their place: the Laplacian of the map is harmonic, at the
    middles of faces it is there and has that slope along the normal, and between them it is off the cage by about a
    hundredth of the size or less (docs/coordinates.md). Weights are good to about 1e-5. Points within 1e-5 of the
    cage's size of its surface, on either side, get the limit from inside. Source: after Weber, Poranne and Gotsman,
    "Biharmonic coordinates" (CGF 2012), and Thiery, Michel and Chen, "Biharmonic coordinates and their
    derivatives for triangular 3D cages" (TOG 2024), with Laplacians that are constant on faces, as
    kernels/coordinates/biharmonic.py has it.

    Args:
        points: (n, 3), world units. NumPy, Warp or any DLPack array (docs/arrays.md).
        cage: Usable Cage of v vertices and f faces, at most 2,048 of which.
        device: Warp device. None is the device of an array on a device, else CUDA where there is one.
        outside: "raise" refuses points outside; "nan" fills their rows with NaN.

    Returns:
        Vertex weights (n, v) and face weights (n, f), float32, arrays of the points' kind on their device; the latter
        are lengths in world units. Of quads f counts four triangles each, `cage.refined(1)`.

    Raises:
        ValueError: For points outside (with their number and the first of them), of another shape or not finite, for a
            cage that is open, inward, degenerate or of more faces, for too little memory on the device, and for another
            `outside`.
    """
    vertex_weights, face_weights = _weigh(COORDINATE_KINDS["biharmonic"], points, cage, device, outside)
    return as_given(vertex_weights, points), as_given(face_weights, points)


@points_in_turn
def maximum_likelihood_coordinates(
    points: PointsLike, cage: ClosedMesh, *, device: wp.DeviceLike = None, outside: str = "raise"
) -> Any:
    """Maximum likelihood coordinates of points inside a cage: positive, also in concave cages.

    They are close to mean value coordinates in convex cages and continuously differentiable. On the cage, to 1e-6 of
    its size, they interpolate the face linearly. Weights are good to about 1e-6. Source: after Chang, Deng and Hormann,
    "Maximum likelihood coordinates" (SGP 2023), with directions to faces in place of those to vertices, as
    kernels/coordinates/maximum_likelihood.py has it.

    Args:
        points: (n, 3), world units. NumPy, Warp or any DLPack array (docs/arrays.md).
        cage: Usable Cage of v vertices.
        device: Warp device. None is the device of an array on a device, else CUDA where there is one.
        outside: "raise" refuses points farther outside than 1e-5 of the cage's size; "nan" fills their rows with NaN.

    Returns:
        (n, v) float32, an array of the points' kind on their device, not negative up to rounding; each row sums to one
        and reproduces its point.

    Raises:
        ValueError: For points outside (with their number and the first of them), of another shape or not finite, for a
            cage that is open, inward or degenerate, for points where none are found, as a cage is inside out or a
            hundred times wider than high, for too little memory on the device, and for another `outside`.
    """
    (weights,) = _weigh(COORDINATE_KINDS["maximum_likelihood"], points, cage, device, outside)
    return as_given(weights, points)


@points_in_turn
@device_by_name
@reports_progress
def harmonic_coordinates(
    points: PointsLike,
    cage: ClosedMesh,
    resolution: int = HARMONIC_RESOLUTION,
    *,
    device: wp.DeviceLike = None,
    outside: str = "raise",
    progress: bool | Progress = False,
) -> Any:
    """Harmonic coordinates of points inside a cage.

    Warns where gaps of the cage are narrower than a cell of the lattice.

    Args:
        points: (n, 3), world units. NumPy, Warp or any DLPack array (docs/arrays.md).
        cage: Usable Cage of v vertices.
        resolution: Cells along the longest side of the lattice on which they are solved, 8 to 1024. Errors at 128 are
            about 1e-3 away from the cage and 1e-2 next to it.
        device: Warp device. None is the device of an array on a device, else CUDA where there is one.
        outside: "raise" refuses points farther outside than 1e-5 of the cage's size; "nan" fills their rows with NaN.
        progress: True shows a bar on stderr. A function is called with (done, total, message), in vertices of the cage,
            and ends the work by returning False or by raising.

    Returns:
        (n, v) float32, an array of the points' kind on their device, not negative up to rounding; rows sum to one.

    Raises:
        ValueError: For points outside, of another shape or not finite, for a cage that is open, inward or degenerate, a
            resolution out of range, too little memory on the device, and for another `outside`.
        Cancelled: Where `progress` returned False.
    """
    local, lost, cage = checked_points(COORDINATE_KINDS["harmonic"], points, cage, device, outside)
    if not len(lost):
        return harmonic_weights(points, cage, resolution, local.device, progress=progress)
    weights = np.full((local.count, cage.own_count), np.nan, np.float32)
    held = np.delete(np.arange(local.count), lost)
    weights[held] = harmonic_weights(local.world[held], cage, resolution, local.device, progress=progress)
    return as_given(wp.array(weights, device=local.device), points)
