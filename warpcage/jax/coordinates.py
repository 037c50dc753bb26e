"""Points moved by cages, and weights of points, as functions of JAX."""

from __future__ import annotations

import functools
from typing import Any

import jax
import warp as wp

from ..coordinate_kinds import COORDINATE_KINDS
from ..coordinates import coordinates as library
from ..coordinates.vjp import coordinates_vjp, deform_points_vjp
from ..core.names import OUTSIDE, POINT_COORDINATES, checked_choice, coordinate_kind
from ..interop.numbers import number_of, object_of, weight_counts
from ..mesh.mesh import ClosedMesh
from .calls import call, float_rows, host, write

#: What XLA passes on as whole numbers.
KIND_NAMES, WAYS = list(COORDINATE_KINDS), [*OUTSIDE, None]


def deform_points(
    points: Any,
    rest: ClosedMesh,
    deformed: Any,
    coordinates: str = POINT_COORDINATES,
    *,
    rest_vertices: Any = None,
    outside: str | None = None,
) -> jax.Array:
    """Move points as the cage around them moves, with gradients by points, pose and cage, under `jax.jit` too.

    The same as `warpcage.deform_points`. What is wrong with values, such as points outside, is found while XLA runs,
    and raised by JAX (ValueError, or jax.errors.JaxRuntimeError) with the same line.

    Args:
        points: (n, 3) of JAX, world units; the work is done on their device, in single floats.
        rest: Usable Cage around the points, a constant of what is traced. Hold it as long as traced functions.
        deformed: A Cage of the same faces, or the vertices (v, 3) of one, world units.
        coordinates: "mean_value", "green" or "harmonic"; the other kinds have no gradients.
        rest_vertices: (v, 3), world units. None are those of `rest`; given, gradients pass to them.
        outside: As for `warpcage.deform_points`.

    Returns:
        (n, 3) float32, world units.

    Raises:
        ValueError: For arrays of another shape, and for names that do not exist.
    """
    coordinate_kind(coordinates)
    number = number_of(rest, ClosedMesh, "the rest cage must be")
    vertices = _vertices(rest, rest_vertices), _vertices(deformed, None)
    options = number, KIND_NAMES.index(coordinates), _way(outside)
    return _moved(float_rows(points, "points"), *vertices, options)


def mean_value_coordinates(
    points: Any, cage: ClosedMesh, *, vertices: Any = None, outside: str = "extend"
) -> jax.Array:
    """Mean value coordinates of points in a cage, with gradients by points and cage.

    Args:
        points: (n, 3) of JAX, world units; the work is done on their device, in single floats.
        cage: Usable Cage of v vertices, a constant of what is traced.
        vertices: (v, 3), world units. None are those of `cage`; given, gradients pass to them.
        outside: As for `warpcage.mean_value_coordinates`.

    Returns:
        (n, v) float32 weights.

    Raises:
        ValueError: For arrays of another shape, and for names that do not exist.
    """
    return _weights_of("mean_value", points, cage, vertices, outside)[0]


def green_coordinates(
    points: Any, cage: ClosedMesh, *, vertices: Any = None, outside: str = "raise"
) -> tuple[jax.Array, jax.Array]:
    """Green coordinates of points in a cage of triangles, with gradients by points and cage.

    Args:
        points: (n, 3) of JAX, world units; the work is done on their device, in single floats.
        cage: Usable Cage of v vertices and f faces, a constant of what is traced.
        vertices: (v, 3), world units. None are those of `cage`; given, gradients pass to them.
        outside: As for `warpcage.green_coordinates`.

    Returns:
        Weights of vertices (n, v) and of normals (n, f), float32.

    Raises:
        ValueError: For arrays of another shape, and for names that do not exist.
    """
    by_vertices, by_faces = _weights_of("green", points, cage, vertices, outside)
    return by_vertices, by_faces


def _vertices(cage: Any, given: Any) -> jax.Array:
    """Vertices (v, 3), those of a cage where none are given."""
    values = given if given is not None else cage.vertices if isinstance(cage, ClosedMesh) else cage
    return float_rows(values, "vertices of a cage")


def _way(outside: str | None) -> int:
    return WAYS.index(None if outside is None else checked_choice(outside, "outside", OUTSIDE))


# Vertices of cages are arrays here, single floats: those of a Cage are taken as they are where they say the same.


def _cage(number: int, vertices: wp.array[Any]) -> ClosedMesh:
    cage, given = object_of(number, ClosedMesh), vertices.numpy()
    return cage if (cage.vertices.astype("float32") == given).all() else cage.with_vertices(given)


def _move(
    points: wp.array[wp.vec3],
    rest_vertices: wp.array[wp.vec3],
    vertices: wp.array[wp.vec3],
    rest: int,
    kind: int,
    way: int,
    moved: wp.array[wp.vec3],
) -> None:
    cages = _cage(rest, rest_vertices), host(vertices)
    write(moved, library.deform_points(points, *cages, KIND_NAMES[kind], outside=WAYS[way]))


def _move_vjp(
    points: wp.array[wp.vec3],
    rest_vertices: wp.array[wp.vec3],
    vertices: wp.array[wp.vec3],
    slopes: wp.array[wp.vec3],
    rest: int,
    kind: int,
    way: int,
    by_points: wp.array[wp.vec3],
    by_rest: wp.array[wp.vec3],
    by_pose: wp.array[wp.vec3],
) -> None:
    cages = _cage(rest, rest_vertices), host(vertices)
    found = deform_points_vjp(points, *cages, slopes, KIND_NAMES[kind], outside=WAYS[way])
    for target, values in ((by_points, found.points), (by_rest, found.cage), (by_pose, found.deformed)):
        write(target, values)


@functools.partial(jax.custom_vjp, nondiff_argnums=(3,))
@functools.partial(jax.jit, static_argnums=3)
def _moved(points: Any, rest_vertices: Any, vertices: Any, options: tuple[int, int, int]) -> Any:
    return call(_move, 1)(points, rest_vertices, vertices, *options)[0]


def _keep_moved(points: Any, rest_vertices: Any, vertices: Any, options: tuple[int, int, int]) -> Any:
    return _moved(points, rest_vertices, vertices, options), (points, rest_vertices, vertices)


@functools.partial(jax.jit, static_argnums=0)
def _propagate_moved(options: tuple[int, int, int], kept: Any, slopes: Any) -> Any:
    shapes = dict(zip(("by_points", "by_rest", "by_pose"), (len(each) for each in kept), strict=True))
    return tuple(call(_move_vjp, 3)(*kept, slopes, *options, output_dims=shapes))


_moved.defvjp(_keep_moved, _propagate_moved)


def _weights_of(coordinates: str, points: Any, cage: ClosedMesh, vertices: Any, outside: str) -> Any:
    options = number_of(cage, ClosedMesh, "the cage must be"), KIND_NAMES.index(coordinates), _way(outside)
    return _weights(float_rows(points, "points"), _vertices(cage, vertices), options)


def _weigh(
    points: wp.array[wp.vec3], vertices: wp.array[wp.vec3], cage: int, kind: int, way: int, weights: wp.array2d[float]
) -> None:
    write(weights, library.mean_value_coordinates(points, _cage(cage, vertices), outside=WAYS[way] or "extend"))


def _weigh_green(
    points: wp.array[wp.vec3],
    vertices: wp.array[wp.vec3],
    cage: int,
    kind: int,
    way: int,
    weights: wp.array2d[float],
    of_faces: wp.array2d[float],
) -> None:
    found = library.green_coordinates(points, _cage(cage, vertices), outside=WAYS[way] or "raise")
    for target, values in zip((weights, of_faces), found, strict=True):
        write(target, values)


def _weigh_vjp(
    points: wp.array[wp.vec3],
    vertices: wp.array[wp.vec3],
    slopes: wp.array2d[float],
    cage: int,
    kind: int,
    way: int,
    by_points: wp.array[wp.vec3],
    by_cage: wp.array[wp.vec3],
) -> None:
    _write_weight_slopes(points, vertices, slopes, (cage, kind, way), (by_points, by_cage))


def _weigh_green_vjp(
    points: wp.array[wp.vec3],
    vertices: wp.array[wp.vec3],
    slopes: wp.array2d[float],
    of_faces: wp.array2d[float],
    cage: int,
    kind: int,
    way: int,
    by_points: wp.array[wp.vec3],
    by_cage: wp.array[wp.vec3],
) -> None:
    _write_weight_slopes(points, vertices, (slopes, of_faces), (cage, kind, way), (by_points, by_cage))


def _write_weight_slopes(points: Any, vertices: Any, slopes: Any, options: tuple[int, int, int], targets: Any) -> None:
    cage, kind, way = options
    found = coordinates_vjp(points, _cage(cage, vertices), slopes, KIND_NAMES[kind], outside=WAYS[way])
    write(targets[0], found.points)
    write(targets[1], found.cage)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
@functools.partial(jax.jit, static_argnums=2)
def _weights(points: Any, vertices: Any, options: tuple[int, int, int]) -> Any:
    counts = weight_counts(object_of(options[0], ClosedMesh), KIND_NAMES[options[1]])
    shapes = {"weights": (len(points), counts[0]), "of_faces": (len(points), counts[1])}
    weigh = call(_weigh_green, 2) if counts[1] else call(_weigh, 1)
    return tuple(weigh(points, vertices, *options, output_dims=shapes))


def _keep_weights(points: Any, vertices: Any, options: tuple[int, int, int]) -> Any:
    return _weights(points, vertices, options), (points, vertices)


@functools.partial(jax.jit, static_argnums=0)
def _propagate_weights(options: tuple[int, int, int], kept: Any, slopes: Any) -> Any:
    shapes = {"by_points": len(kept[0]), "by_cage": len(kept[1])}
    weigh = call(_weigh_green_vjp if len(slopes) > 1 else _weigh_vjp, 2)
    return tuple(weigh(*kept, *slopes, *options, output_dims=shapes))


_weights.defvjp(_keep_weights, _propagate_weights)
