"""Slopes of a number by points and cages, from those by moved points or by weights: vector-Jacobian products."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from ..coordinate_kinds import CoordinateKind, names_where
from ..core.arrays import PointsLike, as_points, empty_array
from ..core.checks import shown
from ..core.devices import launch
from ..core.names import POINT_COORDINATES, coordinate_kind, listed
from ..errors import InputError
from ..kernels.coordinates.local_points import scale_rows
from ..kernels.gradients.green_adjoint import slope_green_points
from ..kernels.gradients.maximum_likelihood_adjoint import slope_likely_points
from ..kernels.gradients.mean_value_adjoint import slope_mean_value_points
from ..kernels.gradients.points import propagate_points
from ..kernels.gradients.quad_mean_value_adjoint import slope_quad_points
from ..lattice.corner_sums import CornerSums
from ..mesh.match import posed_mesh
from ..mesh.mesh import ClosedMesh
from ..mesh.surface import merge_rows
from ..mesh.validity import require_usable
from .coordinates import LocalPoints, cage_arrays, checked_points, posed_on_lattice, stretched_normals


@dataclass(frozen=True, eq=False)
class PointSlopes:
    """Slopes of a number, Warp arrays of vec3 on the device, per world unit."""

    points: wp.array  # (n,) by the points, zero for those without coordinates
    cage: wp.array  # (v,) by the vertices of the cage that the points are in
    deformed: wp.array | None = None  # (v,) by those of the cage that they move with


def deform_points_vjp(
    points: PointsLike,
    rest: ClosedMesh,
    deformed: ClosedMesh | PointsLike,
    slopes: PointsLike,
    coordinates: str = POINT_COORDINATES,
    *,
    device: wp.DeviceLike = None,
    outside: str | None = None,
) -> PointSlopes:
    """The gradient of a loss by all that `deform_points` takes, from that by the points that it returns.

    Exact for mean value, Green and maximum likelihood coordinates; on a cage, where their derivatives jump, those 1e-4
    of its size inside. With harmonic coordinates it is that of the map on its lattice (`PositionMap.vertex_gradient`).

    Args:
        points: (n, 3), world units, as for `deform_points`.
        rest: The cage around them.
        deformed: The posed cage, or its vertices (v, 3), world units.
        slopes: (n, 3) gradient by the moved points, per world unit; points without coordinates count for nothing.
        coordinates: "mean_value", "green", "maximum_likelihood" or "harmonic".
        device: As for `deform_points`.
        outside: As for `deform_points`.

    Returns:
        Gradients by the points, the cage at rest and the posed cage.

    Raises:
        ValueError: As `deform_points`, for slopes of another shape, and for kinds without gradients.
    """
    kind = _with_adjoint(coordinate_kind(coordinates))
    local, lost, surface = checked_points(kind, points, rest, device, outside)
    target = posed_mesh(rest, deformed, "the deformed cage must be")
    if not kind.is_closed_form:
        require_usable(target, "deformed cage")
    target = target.refined(kind.face_cells)
    by_moved = as_points(slopes, local.device, name="slopes")
    if by_moved.size != local.count:
        raise InputError(f"slopes must be as many as the points, {local.count}, got {by_moved.size}")
    if len(lost):
        by_moved = wp.clone(by_moved)
        _clear(by_moved.view(wp.float32), lost)
    if not kind.is_closed_form:
        return _slopes_on_lattice(kind, local, surface, target, by_moved)
    center = target.bounds.mean(axis=0)
    targets = wp.array(target.vertices - center, dtype=wp.vec3, device=local.device)
    vertices, _ = cage_arrays(surface, local)
    sums, by_points = _corner_sums(kind, surface, local), empty_array(local.count, wp.vec3, local.device)
    if kind.has_face_weights:
        normals = surface.size * stretched_normals(surface, target)
        normals = wp.array(normals, dtype=wp.vec3, device=local.device)
        places = sums.add_green(local.points, by_moved, vertices, targets, normals, 1.0)
        inputs = [places, by_moved, vertices, sums.faces, targets, normals, sums.no_rows, sums.no_rows]
        _launch(slope_green_points, local, sums, inputs, by_points)
    elif kind.is_iterative:
        likely = sums.add_maximum_likelihood(local.points, by_moved, vertices, targets, 1.0, sums.no_rows)
        _launch(slope_likely_points, local, sums, [likely, vertices, sums.faces, targets, sums.no_rows, 1.0], by_points)
    else:
        pulled = sums.add_mean_value(local.points, by_moved, vertices, targets, 1.0)
        inputs = [pulled, vertices, sums.faces, targets, sums.no_rows, 1.0]
        _launch(slope_quad_points if sums.is_quads else slope_mean_value_points, local, sums, inputs, by_points)
    _scale(by_points, 1.0 / surface.size)
    return PointSlopes(by_points, *sums.gathered((1.0 / surface.size, 1.0)))


def coordinates_vjp(
    points: PointsLike,
    cage: ClosedMesh,
    slopes: wp.array | tuple[wp.array, wp.array],
    coordinates: str = POINT_COORDINATES,
    *,
    device: wp.DeviceLike = None,
    outside: str | None = None,
) -> PointSlopes:
    """The gradient of a loss by points and their cage, from that by the weights of the points.

    Args:
        points: (n, 3), world units, as for the functions of weights.
        cage: The cage around them, of v vertices and f faces; of triangles, for mean value coordinates of any polygons.
        slopes: (n, v) gradient by the weights, a Warp array of float32 on the device; two, (n, v) and (n, f), for Green
            coordinates. Points without coordinates count for nothing.
        coordinates: "mean_value", "green" or "maximum_likelihood".
        device: As for the functions of weights.
        outside: As for the functions of weights.

    Returns:
        Gradients by the points and the cage.

    Raises:
        ValueError: As the functions of weights, for slopes of another shape, and for kinds and faces without gradients.
    """
    kind = _with_adjoint(coordinate_kind(coordinates))
    has_rows = kind.map_quads is not None or cage.refined(kind.face_cells).operator is None  # one a vertex of the cage
    if not kind.is_closed_form or cage.operator is not None or not has_rows:
        raise InputError(
            f"no gradient passes through weights of {kind.name} coordinates and these faces: take deform_points_vjp"
        )
    local, lost, surface = checked_points(kind, points, cage, device, outside)
    vertices, _ = cage_arrays(surface, local)
    sums, by_points = _corner_sums(kind, surface, local), empty_array(local.count, wp.vec3, local.device)
    rows = list(slopes) if isinstance(slopes, tuple) else [slopes]
    for each in rows:
        if not isinstance(each, wp.array) or each.dtype is not wp.float32:
            raise InputError(f"slopes by weights must be Warp arrays of float32, got {shown(each)}")
    widths = [surface.own_count] + [len(surface.faces)] * kind.has_face_weights
    if [tuple(each.shape) for each in rows] != [(local.count, width) for width in widths]:
        raise InputError(
            f"slopes by weights must be {' and '.join(str((local.count, width)) for width in widths)}, got "
            f"{' and '.join(shown(tuple(each.shape)) for each in rows)}"
        )
    if len(lost):
        rows = [wp.clone(each) for each in rows]
        for each in rows:
            _clear(each, lost)
    if kind.has_face_weights:
        rows[1] = wp.clone(rows[1])
        _scale(rows[1], surface.size)  # weights of faces are lengths
        places = sums.add_green_weights(local.points, vertices, rows[0], rows[1], 1.0)
        none = sums.no_vectors
        inputs = [places, none, vertices, sums.faces, none, none, *rows]
        _launch(slope_green_points, local, sums, inputs, by_points)
    elif kind.is_iterative:
        likely = sums.add_maximum_likelihood(local.points, sums.no_vectors, vertices, vertices, 1.0, rows[0])
        _launch(slope_likely_points, local, sums, [likely, vertices, sums.faces, vertices, rows[0], 1.0], by_points)
    else:
        of_surface = rows[0]
        if surface.operator is not None:
            of_surface = empty_array((local.count, vertices.size), wp.float32, local.device)
            merge_rows(rows[0].transpose([1, 0]), surface.operator.T, of_surface.transpose([1, 0]))
        weights = empty_array(of_surface.shape, wp.float32, local.device)
        inputs, weigh = [local.points, vertices, sums.faces, 1.0], "weigh_quads" if sums.is_quads else "weigh_points"
        launch(kind.load(weigh), local.count, inputs, [weights], device=local.device, work=sums.faces.size)
        pulled = sums.add_mean_value(local.points, of_surface, vertices, vertices, 1.0, weights)
        inputs = [pulled, vertices, sums.faces, vertices, of_surface, 1.0]
        _launch(slope_quad_points if sums.is_quads else slope_mean_value_points, local, sums, inputs, by_points)
    _scale(by_points, 1.0 / surface.size)
    return PointSlopes(by_points, sums.gathered((1.0 / surface.size, 1.0))[0])


def _with_adjoint(kind: CoordinateKind) -> CoordinateKind:
    """The kind, which has slopes."""
    if not kind.has_gradients:
        raise InputError(
            f"no gradient passes through {kind.name} coordinates: take {listed(names_where('has_gradients'))}"
        )
    return kind


def _corner_sums(kind: CoordinateKind, surface: ClosedMesh, local: LocalPoints) -> CornerSums:
    """Sums for the corners that the kind weighs, of bilinear patches or of triangles."""
    return CornerSums(surface, local.device, surface.quads if kind.map_quads else None)


def _slopes_on_lattice(
    kind: CoordinateKind, local: LocalPoints, rest: ClosedMesh, deformed: ClosedMesh, by_moved: wp.array
) -> PointSlopes:
    """The slopes of points that a map on a lattice moves."""
    position_map, _ = posed_on_lattice(kind, local, rest, deformed)
    by_points, by_nodes = wp.zeros_like(local.points), wp.zeros_like(position_map.data.positions)
    inputs = [position_map.data, local.points, by_moved]
    launch(propagate_points, local.count, inputs, [by_points, by_nodes], device=local.device, threads=1)
    return PointSlopes(by_points, *position_map.vertex_gradient(by_nodes))


def _clear(rows: wp.array, lost: np.ndarray) -> None:
    """Launch what sets rows (n, k) of these numbers to zero."""
    rows[wp.array(lost, dtype=wp.int32, device=rows.device)].zero_()


def _launch(kernel, local: LocalPoints, sums: CornerSums, inputs: list, by_points: wp.array) -> None:
    launch(kernel, local.count, inputs, [by_points], device=local.device, work=sums.faces.size)


def _scale(array: wp.array, factor: float) -> None:
    """Launch what multiplies rows (n, k) of numbers, or vectors (n,)."""
    rows = array.view(wp.float32) if array.dtype == wp.vec3 else array
    launch(scale_rows, rows.shape[0], [factor], [rows], device=array.device)
