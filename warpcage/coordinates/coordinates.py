"""Cage coordinates of points (mean value, green, harmonic), and points and normals moved by a cage."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ..core.arrays import PointsLike, as_host_points, as_points, empty_array, is_device_array, points_in_turn
from ..core.checks import device_by_name
from ..core.devices import launch, resolve_device
from ..core.memory import require_memory
from ..core.names import agreed, chosen
from ..core.reports import Progress, hears
from ..kernels.coordinates import green, local_points, mean_value
from ..kernels.lattice import cage_map
from ..lattice.position_map import PositionMap
from ..mesh import faces as face_geometry
from ..mesh.match import require_same_faces
from ..mesh.mesh import ClosedMesh, prepared_fans, require_mesh
from ..mesh.queries import SURFACE_TOLERANCE, inside_mesh
from ..mesh.validity import require_usable, size_problem
from .harmonic import HARMONIC_RESOLUTION, harmonic_weights


@dataclass
class _Local:
    """Points in a local frame: a cage's has the middle of its bounding box at the origin and a longest side of one."""

    given: PointsLike  # as given by the caller, but host points are (n, 3) float64
    points: wp.array  # (n,) vec3 on device
    on_device: bool  # whether they were given as an array of a device
    single: bool  # whether they were given as float32
    bad: wp.array  # (1,) int, above 0 where a point is not finite, or FARTHEST away or more

    @property
    def device(self) -> wp.Device:
        return self.points.device  # pyright: ignore[reportReturnType]

    @property
    def count(self) -> int:
        return len(self.points)

    def given_back(self, array: wp.array) -> np.ndarray | wp.array:
        """A result in the form the points came in."""
        return array if self.on_device else array.numpy()

    def world(self, rows) -> np.ndarray:
        """World positions of some rows, for messages and checks on the host."""
        host = np.asarray(self.given.numpy() if isinstance(self.given, wp.array) else self.given, dtype=np.float64)
        return host.reshape(-1, 3)[rows]

    def place(self, row: int) -> str:
        """World position of a point, for messages."""
        return ", ".join(f"{value:.6g}" for value in self.world(row))


def _localise(
    points: PointsLike, center: np.ndarray, size: float, device: wp.DeviceLike, *, check: bool = True
) -> _Local:
    """Points relative to a cage. check: refuse points of a device that are not finite at once, which waits for it."""
    if not is_device_array(points):
        host = as_host_points(points)
        single = isinstance(points, np.ndarray) and points.dtype == np.float32
        local = (host - center) / size
        bad = not (np.abs(local) < local_points.FARTHEST).all()
        with np.errstate(over="ignore"):
            local = wp.array(local.astype(np.float32), dtype=wp.vec3, device=resolve_device(device))
        return _Local(host, local, False, single, wp.full(1, int(bad), dtype=int, device=local.device))

    world, _ = as_points(points, device)
    local = empty_array(len(world), wp.vec3, world.device)
    bad = wp.zeros(1, dtype=int, device=world.device)
    launch(
        local_points.localise_points,
        len(world),
        [world, wp.vec3d(*center), wp.float64(size)],
        [local, bad],
        device=world.device,
    )
    result = _Local(world, local, True, True, bad)
    if check and int(bad.numpy()[0]):
        _require_finite(result)
    return result


def _require_finite(local: _Local) -> None:
    as_host_points(local.given)


def _require_near(local: _Local, cage: ClosedMesh) -> None:
    """Refuse points so far from the cage that their mean value weights have no digits."""
    if int(local.bad.numpy()[0]):
        away = np.abs(local.world(slice(None)) - cage.bounds.mean(axis=0)).max(axis=1) / cage.size
        lost = np.flatnonzero(away >= local_points.FARTHEST)
        raise ValueError(
            f"{len(lost)} of {local.count} points {agreed(len(lost), 'is', 'are')} "
            f"{local_points.FARTHEST:.0f} times the cage's size "
            f"away or more, the first is point {lost[0]} at ({local.place(lost[0])}): leave them out"
        )


def _restore(moved: wp.array, local: _Local, center: np.ndarray, size: float):
    """Local results in world units, in the form the points came in."""
    if local.on_device:
        world = wp.empty_like(moved)
        launch(
            local_points.restore_points,
            local.count,
            [moved, wp.vec3d(*center), wp.float64(size)],
            [world],
            device=local.device,
        )
        return world
    world = moved.numpy().astype(np.float64).reshape(-1, 3) * size + center
    return world.astype(np.float32) if local.single else world


def _cage_arrays(cage: ClosedMesh, local: _Local) -> tuple[wp.array, wp.array]:
    vertices = ((cage.vertices - cage.bounds.mean(axis=0)) / cage.size).astype(np.float32)
    return (
        wp.array(vertices, dtype=wp.vec3, device=local.device),
        wp.array(cage.faces, dtype=wp.vec3i, device=local.device),
    )


def _outside_points(local: _Local, cage: ClosedMesh) -> np.ndarray:
    """Rows of the points farther outside than 1e-5 of the size."""
    if not local.count:
        return np.zeros(0, dtype=np.int64)
    inside = inside_mesh(local.given, cage, device=local.device)
    return np.flatnonzero(~(inside.numpy() if isinstance(inside, wp.array) else np.asarray(inside)).astype(bool))


def _require_room(local: _Local, columns: int) -> None:
    """Refuse weights that the device has not the memory for; NumPy results are held on the host as well."""
    size = 4 * local.count * columns
    message = f"weights of {local.count} points, {columns} each, need {{size}}: take fewer points at a time"
    require_memory(size, local.device, message + ", or deform_points, which keeps none")
    if not local.on_device and not local.device.is_cpu:
        require_memory(size, wp.get_device("cpu"), message)


def _require_inside(local: _Local, cage: ClosedMesh, kind: str) -> None:
    lost = _outside_points(local, cage)
    if len(lost):
        raise ValueError(_outside_message(local, lost, kind))


def _outside_message(local: _Local, lost: np.ndarray, kind: str) -> str:
    return (
        f"{len(lost)} of {local.count} points {agreed(len(lost), 'is', 'are')} outside the cage by more "
        f"than {SURFACE_TOLERANCE:g} of its size, "
        f"the first is point {lost[0]} at ({local.place(lost[0])}): {kind} coordinates are for points inside, "
        "mean_value for any"
    )


def _as_given(array, local: _Local):
    """`array` as Warp or NumPy, whichever the points were."""
    if local.on_device:
        return array if isinstance(array, wp.array) else wp.array(array, dtype=wp.float32, device=local.device)
    return array.numpy() if isinstance(array, wp.array) else array


@points_in_turn
@device_by_name
def deform_points(
    points: PointsLike,
    rest: ClosedMesh,
    deformed: ClosedMesh,
    coordinates: str = "mean_value",
    *,
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
    move = chosen(coordinates, "coordinates", harmonic=_move_harmonic, mean_value=_move_mean_value, green=_move_green)
    for cage, name in ((rest, "rest"), (deformed, "deformed")):
        require_mesh(cage, f"the {name} cage must be")
    require_usable(rest, "rest cage")
    require_same_faces(rest, deformed)
    if deformed.size > rest.size and (problem := size_problem(deformed)):
        raise ValueError(f"deformed cage {problem}")
    return move(_localise(points, rest.bounds.mean(axis=0), rest.size, device, check=False), rest, deformed)


def _move_mean_value(local: _Local, rest: ClosedMesh, deformed: ClosedMesh) -> np.ndarray | wp.array:
    moved, inputs = _closed_form_inputs(local, rest, deformed)
    work = len(rest.faces)
    launch(mean_value.map_mean_value, local.count, [*inputs, 1.0], [moved], device=local.device, work=work)
    world = _restore(moved, local, deformed.bounds.mean(axis=0), rest.size)
    if int(local.bad.numpy()[0]):  # read once, after all is under way
        _require_finite(local)
        _require_near(local, rest)
    return world


def _move_green(local: _Local, rest: ClosedMesh, deformed: ClosedMesh) -> np.ndarray | wp.array:
    moved, inputs = _closed_form_inputs(local, rest, deformed)
    normals = stretched_normals(rest, deformed)[rest.topology.fans.order].astype(np.float32)
    inputs += [wp.array(normals, dtype=wp.vec3, device=local.device), 1.0]
    outputs, work = [moved, local.bad], len(rest.faces)
    launch(green.map_green_inside, local.count, inputs, outputs, device=local.device, work=work)
    world = _restore(moved, local, deformed.bounds.mean(axis=0), rest.size)
    if int(local.bad.numpy()[0]):  # read once, after all is under way
        _require_finite(local)
        _require_inside(local, rest, "green")
    return world


def _closed_form_inputs(local: _Local, rest: ClosedMesh, deformed: ClosedMesh) -> tuple[wp.array, list[Any]]:
    """Where the moved points go, in the frame of the posed cage, and what kernels of both closed forms take."""
    targets = ((deformed.vertices - deformed.bounds.mean(axis=0)) / rest.size).astype(np.float32)
    vertices, _ = _cage_arrays(rest, local)
    faces = wp.array(rest.topology.fans.faces, dtype=wp.vec3i, device=local.device)
    fans = prepared_fans(vertices, faces, 1.0)
    moved = empty_array(local.count, wp.vec3, local.device)
    return moved, [local.points, vertices, faces, fans, wp.array(targets, dtype=wp.vec3, device=local.device)]


def stretched_normals(source: ClosedMesh, target: ClosedMesh) -> np.ndarray:
    """Unit normals of a deformed cage's faces times how much each face is stretched, (f, 3) float64.
    Zero for a target face without area, which has no normal. Green face weights of `source` multiply them."""
    require_same_faces(source, target)
    return face_geometry.stretched_normals(source, face_geometry.StretchTarget.of(target)).T


def _move_harmonic(local: _Local, rest: ClosedMesh, deformed: ClosedMesh) -> np.ndarray | wp.array:
    _require_finite(local)
    _require_inside(local, rest, "harmonic")
    require_usable(deformed, "deformed cage")
    # the map runs from the cage it is posed to, here the rest cage, to the one it is made of; both about the origin, as
    # float32 keeps few digits of a map between cages that are far apart
    center = deformed.bounds.mean(axis=0)
    target = deformed.with_vertices((deformed.vertices - center) / rest.size)
    source = rest.with_vertices((rest.vertices - rest.bounds.mean(axis=0)) / rest.size)
    position_map = PositionMap(
        target, coordinates="harmonic", resolution=HARMONIC_RESOLUTION, origin=np.zeros(3), device=local.device
    ).pose(source)
    moved, distance = wp.empty_like(local.points), empty_array(local.count, float, local.device)
    launch(cage_map.sample_map, local.count, [position_map.data, local.points], [moved, distance], device=local.device)
    return _restore(moved, local, center, rest.size)


@points_in_turn
@device_by_name
def mean_value_coordinates(
    points: PointsLike, cage: ClosedMesh, *, device: wp.DeviceLike = None
) -> np.ndarray | wp.array:
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
@device_by_name
def green_coordinates(
    points: PointsLike, cage: ClosedMesh, *, device: wp.DeviceLike = None, outside: str = "raise"
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
@device_by_name
@hears
def harmonic_coordinates(
    points: PointsLike,
    cage: ClosedMesh,
    resolution: int = HARMONIC_RESOLUTION,
    *,
    device: wp.DeviceLike = None,
    progress: bool | Progress = False,
) -> np.ndarray | wp.array:
    """Harmonic coordinates of points inside a cage.

    Warns where gaps of the cage are narrower than a cell of the lattice.

    Args:
        points: (n, 3), world units. NumPy, or an array on a device (Warp or DLPack; in float32 there).
        cage: Usable Cage of v vertices.
        resolution: Cells along the longest side of the lattice on which they are solved, 8 to 1024. Errors at 128 are
            about 1e-3 away from the cage and 1e-2 next to it.
        device: Warp device. None is the device of an array on a device, else CUDA where there is one.
        progress: True shows a bar on stderr. A function is told (done, total, words), in vertices of the cage, and ends
            the work by returning False or by raising.

    Returns:
        (n, v) float32, not negative up to rounding; rows sum to one. NumPy for NumPy, a Warp array for an array on a
        device.

    Raises:
        ValueError: For points farther outside than 1e-5 of the cage's size, of another shape or not finite, for a cage
            that is open, inward or degenerate, a resolution out of range, and for too little memory on the device.
        Cancelled: Where `progress` returned False.
    """
    require_mesh(cage, "the cage must be")
    require_usable(cage)
    local = _localise(points, cage.bounds.mean(axis=0), cage.size, device)
    _require_inside(local, cage, "harmonic")
    weights = harmonic_weights(local.given, cage, resolution, local.device)
    return _as_given(weights, local)
