"""Points of posed scenes in canonical space, as a function of JAX."""

from __future__ import annotations

import functools
from typing import Any

import jax
import warp as wp

from ..core.checks import checked_step
from ..deform.deformer import Deformer
from ..errors import InputError
from ..interop.numbers import number_of, object_of
from ..interop.posed import canonical_points_vjp, posed_as, posed_vertices
from .calls import call, float_rows, host, write


def to_canonical(
    deformer: Deformer[Any], points: Any, directions: Any, vertices: Any, *, step: float | None = None
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Where points of a deformed scene are in the canonical one, with gradients by points, directions and pose.

    The same as `Deformer.to_canonical`. Gradients by points are those of differences over a cell of the lattice; points
    that the pose clears, or leaves where they are, pass on what comes as it is.

    Args:
        deformer: A Deformer of one edit with a resolution, without falloff and fragments, a constant of what is traced.
            Hold it as long as traced functions.
        points: (n, 3) of JAX, world units, on the Deformer's device.
        directions: (n, 3), from the camera into the scene, of any length but zero.
        vertices: (v, 3) of the posed cage, world units.
        step: The dt of the finite difference, world units. None is the field's march step.

    Returns:
        Points (n, 3) and directions (n, 3), float32, and region (n,) int32: 0 unchanged, 1 cleared, 2 mapped.

    Raises:
        ValueError: For arrays of another shape, and for other edits.
    """
    number = number_of(deformer, Deformer, "to_canonical needs")
    posed_vertices(deformer)  # refuses others
    arrays = [float_rows(points, "points"), float_rows(directions, "directions"), float_rows(vertices, "the pose")]
    if arrays[0].shape != arrays[1].shape:
        raise InputError(f"there must be as many directions as points, got {len(arrays[1])} for {len(arrays[0])}")
    return _canonical(*arrays, (number, checked_step(step, deformer.field.step)))


def _map(
    points: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    vertices: wp.array[wp.vec3],
    deformer: int,
    step: float,
    canonical: wp.array[wp.vec3],
    along: wp.array[wp.vec3],
    region: wp.array[wp.int32],
) -> None:
    owner = object_of(deformer, Deformer)
    with posed_as(owner, host(vertices)):
        found = owner.to_canonical(points, directions, step=step)
    for target, values in zip((canonical, along, region), found, strict=True):
        write(target, values)


def _map_vjp(
    points: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    vertices: wp.array[wp.vec3],
    region: wp.array[wp.int32],
    by_canonical: wp.array[wp.vec3],
    by_along: wp.array[wp.vec3],
    deformer: int,
    step: float,
    by_points: wp.array[wp.vec3],
    by_directions: wp.array[wp.vec3],
    by_vertices: wp.array[wp.vec3],
) -> None:
    owner, slopes = object_of(deformer, Deformer), (by_canonical, by_along)
    with posed_as(owner, host(vertices)):
        found = canonical_points_vjp(owner, points, directions, region, slopes, step, by_vertices=True)
    for target, values in zip(
        (by_points, by_directions, by_vertices), (found.points, found.directions, found.vertices), strict=True
    ):
        write(target, values)


@functools.partial(jax.custom_vjp, nondiff_argnums=(3,))
@functools.partial(jax.jit, static_argnums=3)
def _canonical(points: Any, directions: Any, vertices: Any, options: tuple[int, float]) -> Any:
    return tuple(call(_map, 3)(points, directions, vertices, *options, output_dims=len(points)))


def _keep(points: Any, directions: Any, vertices: Any, options: tuple[int, float]) -> Any:
    found: Any = _canonical(points, directions, vertices, options)
    return found, (points, directions, vertices, found[2])


@functools.partial(jax.jit, static_argnums=0)
def _propagate(options: tuple[int, float], kept: Any, slopes: Any) -> Any:
    shapes = {"by_points": len(kept[0]), "by_directions": len(kept[0]), "by_vertices": len(kept[2])}
    return tuple(call(_map_vjp, 3)(*kept, *slopes[:2], *options, output_dims=shapes))


_canonical.defvjp(_keep, _propagate)
