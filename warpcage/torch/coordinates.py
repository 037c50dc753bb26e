"""Points moved by cages, and weights of points, as operators of torch."""

from __future__ import annotations

from typing import Any, Optional

import torch
import warp as wp

from ..coordinate_kinds import COORDINATE_KINDS
from ..coordinates import coordinates as library
from ..coordinates.vjp import coordinates_vjp, deform_points_vjp
from ..core.names import POINT_COORDINATES
from ..interop.numbers import object_of, weight_counts
from ..mesh.mesh import ClosedMesh
from .operators import constant_number, host, in_order, like, real_tensor, single, tensor_of

#: The number of a cage that was left out.
NONE = -1


def deform_points(
    points: torch.Tensor,
    rest: ClosedMesh,
    deformed: ClosedMesh | torch.Tensor,
    coordinates: str = POINT_COORDINATES,
    *,
    rest_vertices: torch.Tensor | None = None,
    outside: str | None = None,
) -> torch.Tensor:
    """Move points as the cage around them moves, with gradients by points, pose and cage.

    The same as `warpcage.deform_points`, to the bit.

    Args:
        points: (n, 3), world units; the work is done on their device, in single floats.
        rest: Usable Cage around the points. A compiled function holds it for a constant, and is compiled again for
            another one.
        deformed: A Cage of the same faces, or the vertices (v, 3) of one, world units, on any device.
        coordinates: "mean_value", "green" or "harmonic"; the other kinds have no gradients.
        rest_vertices: (v, 3), world units. None are those of `rest`; given, gradients pass to them.
        outside: As for `warpcage.deform_points`.

    Returns:
        (n, 3) float32, world units, on the points' device.

    Raises:
        ValueError: As `warpcage.deform_points`.
    """
    number = constant_number(rest, ClosedMesh, "the rest cage must be")
    pose, vertices = NONE, None
    if isinstance(deformed, ClosedMesh):
        pose = constant_number(deformed, ClosedMesh, "the deformed cage must be")
    else:
        vertices = real_tensor(deformed, "deformed, where it is no Cage,")
    if rest_vertices is not None:
        rest_vertices = real_tensor(rest_vertices, "rest_vertices")
    return _moved(single(points, "points"), rest_vertices, vertices, number, pose, coordinates, outside or "")


def mean_value_coordinates(
    points: torch.Tensor, cage: ClosedMesh, *, vertices: torch.Tensor | None = None, outside: str = "extend"
) -> torch.Tensor:
    """Mean value coordinates of points in a cage, with gradients by points and cage.

    Args:
        points: (n, 3), world units; the work is done on their device, in single floats.
        cage: Usable Cage of v vertices.
        vertices: (v, 3), world units. None are those of `cage`; given, gradients pass to them.
        outside: As for `warpcage.mean_value_coordinates`.

    Returns:
        (n, v) float32 weights, on the points' device.

    Raises:
        ValueError: As `warpcage.mean_value_coordinates`.
    """
    number = constant_number(cage, ClosedMesh, "the cage must be")
    if vertices is not None:
        vertices = real_tensor(vertices, "vertices")
    return _weights(single(points, "points"), vertices, number, "mean_value", outside)[0]


def green_coordinates(
    points: torch.Tensor, cage: ClosedMesh, *, vertices: torch.Tensor | None = None, outside: str = "raise"
) -> tuple[torch.Tensor, torch.Tensor]:
    """Green coordinates of points in a cage of triangles, with gradients by points and cage.

    Args:
        points: (n, 3), world units; the work is done on their device, in single floats.
        cage: Usable Cage of v vertices and f faces.
        vertices: (v, 3), world units. None are those of `cage`; given, gradients pass to them.
        outside: As for `warpcage.green_coordinates`.

    Returns:
        Weights of vertices (n, v) and of normals (n, f), float32, on the points' device.

    Raises:
        ValueError: As `warpcage.green_coordinates`.
    """
    number = constant_number(cage, ClosedMesh, "the cage must be")
    if vertices is not None:
        vertices = real_tensor(vertices, "vertices")
    return _weights(single(points, "points"), vertices, number, "green", outside)


def _cage(number: int, vertices: torch.Tensor | None) -> ClosedMesh:
    """A cage, with other vertices where they are given."""
    cage = object_of(number, ClosedMesh)
    return cage if vertices is None else cage.with_vertices(host(vertices))


def _pose(number: int, vertices: torch.Tensor | None) -> Any:
    return object_of(number, ClosedMesh) if vertices is None else host(vertices)


@torch.library.custom_op("warpcage::deform_points", mutates_args=())
def _moved(
    points: torch.Tensor,
    rest_vertices: Optional[torch.Tensor],  # noqa: UP045 (torch reads the schema of an operator from it)
    vertices: Optional[torch.Tensor],  # noqa: UP045
    rest: int,
    pose: int,
    coordinates: str,
    outside: str,
) -> torch.Tensor:
    with in_order(points):
        cages = _cage(rest, rest_vertices), _pose(pose, vertices)
        return library.deform_points(points.detach(), *cages, coordinates, outside=outside or None)


@_moved.register_fake
def _(points: Any, *others: Any) -> Any:
    return torch.empty_like(points, memory_format=torch.contiguous_format)


@torch.library.custom_op("warpcage::deform_points_vjp", mutates_args=())
def _moved_vjp(
    points: torch.Tensor,
    rest_vertices: Optional[torch.Tensor],  # noqa: UP045
    vertices: Optional[torch.Tensor],  # noqa: UP045
    slopes: torch.Tensor,
    rest: int,
    pose: int,
    coordinates: str,
    outside: str,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    with in_order(points):
        cages = _cage(rest, rest_vertices), _pose(pose, vertices)
        found = deform_points_vjp(points, *cages, slopes, coordinates, outside=outside or None)
        return tensor_of(found.points), tensor_of(found.cage), tensor_of(found.deformed)


@_moved_vjp.register_fake
def _(points: Any, rest_vertices: Any, vertices: Any, slopes: Any, rest: int, *others: Any) -> Any:
    cage = points.new_empty((object_of(rest, ClosedMesh).own_count, 3))
    return torch.empty_like(points, memory_format=torch.contiguous_format), cage, torch.empty_like(cage)


def _keep_moved(ctx: Any, inputs: Any, output: Any) -> None:
    ctx.save_for_backward(*inputs[:3])
    ctx.options = inputs[3:]


def _propagate_moved(ctx: Any, slopes: Any) -> Any:
    points, rest_vertices, vertices = ctx.saved_tensors
    found = _moved_vjp(points, rest_vertices, vertices, slopes, *ctx.options)
    by_points, by_rest, by_pose = map(like, found, (points, rest_vertices, vertices))
    return by_points, by_rest, by_pose, None, None, None, None


_moved.register_autograd(_propagate_moved, setup_context=_keep_moved)


@torch.library.custom_op("warpcage::coordinates", mutates_args=())
def _weights(
    points: torch.Tensor,
    vertices: Optional[torch.Tensor],  # noqa: UP045
    cage: int,
    coordinates: str,
    outside: str,
) -> tuple[torch.Tensor, torch.Tensor]:
    with in_order(points):
        surface, rows = _cage(cage, vertices), points.detach()
        if COORDINATE_KINDS[coordinates].has_face_weights:
            return library.green_coordinates(rows, surface, outside=outside)
        return library.mean_value_coordinates(rows, surface, outside=outside), points.new_empty((len(points), 0))


@_weights.register_fake
def _(points: Any, vertices: Any, cage: int, coordinates: str, outside: str) -> Any:
    counts = weight_counts(object_of(cage, ClosedMesh), coordinates)
    return tuple(points.new_empty((points.shape[0], count)) for count in counts)


@torch.library.custom_op("warpcage::coordinates_vjp", mutates_args=())
def _weights_vjp(
    points: torch.Tensor,
    vertices: Optional[torch.Tensor],  # noqa: UP045
    by_vertices: torch.Tensor,
    by_faces: torch.Tensor,
    cage: int,
    coordinates: str,
    outside: str,
) -> tuple[torch.Tensor, torch.Tensor]:
    with in_order(points):
        arrays = [wp.from_torch(each.contiguous()) for each in (by_vertices, by_faces) if each.shape[1]]
        slopes = (arrays[0], arrays[1]) if len(arrays) > 1 else arrays[0]
        found = coordinates_vjp(points, _cage(cage, vertices), slopes, coordinates, outside=outside)
        return tensor_of(found.points), tensor_of(found.cage)


@_weights_vjp.register_fake
def _(points: Any, vertices: Any, by_vertices: Any, *others: Any) -> Any:
    return torch.empty_like(points, memory_format=torch.contiguous_format), points.new_empty((by_vertices.shape[1], 3))


def _keep_weights(ctx: Any, inputs: Any, output: Any) -> None:
    ctx.save_for_backward(*inputs[:2])
    ctx.options = inputs[2:]


def _propagate_weights(ctx: Any, by_vertices: Any, by_faces: Any) -> Any:
    points, vertices = ctx.saved_tensors
    found = _weights_vjp(points, vertices, by_vertices, by_faces, *ctx.options)
    by_points, by_cage = map(like, found, (points, vertices))
    return by_points, by_cage, None, None, None


_weights.register_autograd(_propagate_weights, setup_context=_keep_weights)
