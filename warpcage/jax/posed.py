"""Points of posed scenes in canonical space, and frames of them, as functions of JAX."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import warp as wp

from ..core.checks import checked_step, require_type
from ..deform.deformer import Deformer
from ..errors import InputError
from ..interop.numbers import number_of, object_of
from ..interop.posed import (
    FrameOptions,
    canonical_points_vjp,
    frame_color,
    posed_as,
    posed_frame,
    posed_frame_vjp,
    posed_vertices,
    require_camera_numbers,
)
from ..view.camera import Camera
from ..view.frame import PART_NAMES
from .calls import call, float_rows, host, write

#: A march step that is left to the field, as XLA passes it on.
FIELD_STEP = 0.0


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
    arrays = [float_rows(points, "points"), float_rows(directions, "directions"), _pose(deformer, vertices)]
    if arrays[0].shape != arrays[1].shape:
        raise InputError(f"there must be as many directions as points, got {len(arrays[1])} for {len(arrays[0])}")
    return _canonical(*arrays, (number, checked_step(step, deformer.field.step)))


def render(
    deformer: Deformer[Any],
    camera: Camera,
    vertices: Any,
    *,
    camera_change: Any = None,
    background: tuple[float, float, float] | None = None,
    step: float | None = None,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The view of a camera of a deformed scene, with gradients by the pose and by the camera, under `jax.jit` too.

    The same as `Deformer.render`. What the gradients are where a frame is not smooth is in docs/arrays.md, under
    Gradients.

    Args:
        deformer: A Deformer of splats, or of voxels with a resolution, and of one edit without falloff and fragments, a
            constant of what is traced, as the camera is. Hold it as long as traced functions.
        camera: The camera, one ray a pixel.
        vertices: (v, 3) of the posed cage, world units, on the Deformer's device.
        camera_change: (7,) turns about the camera's axes, radians, shifts along them, world units, and the logarithm of
            a factor of its focal length. None leaves the camera as it is; given, gradients pass to them.
        background: Red, green and blue behind the scene. None is the field's own colour.
        step: March step, world units, for voxels. None is the field's.

    Returns:
        Colours (h, w, 3), opacities (h, w) and depths (h, w), float32.

    Raises:
        ValueError: For arrays of another shape, for other fields and edits.
    """
    number = number_of(deformer, Deformer, "render needs")
    require_type(camera, Camera, "render needs")
    pose = _pose(deformer, vertices)
    change = jnp.zeros(7, jnp.float32) if camera_change is None else jnp.asarray(camera_change, jnp.float32)
    require_camera_numbers(change.shape)
    numbers = *frame_color(deformer, background), checked_step(step, FIELD_STEP)
    return _frame(pose, change, (number, camera, camera_change is not None, numbers))


def _pose(deformer: Deformer[Any], vertices: Any) -> jax.Array:
    """Vertices of a pose, of a Deformer that has gradients."""
    rows, count = float_rows(vertices, "the pose"), len(posed_vertices(deformer))
    if len(rows) != count:
        raise InputError(f"the pose must be ({count}, 3), got {rows.shape}")
    return rows


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


def _keep_canonical(points: Any, directions: Any, vertices: Any, options: tuple[int, float]) -> Any:
    found: Any = _canonical(points, directions, vertices, options)
    return found, (points, directions, vertices, found[2])


@functools.partial(jax.jit, static_argnums=0)
def _propagate_canonical(options: tuple[int, float], kept: Any, slopes: Any) -> Any:
    shapes = {"by_points": len(kept[0]), "by_directions": len(kept[0]), "by_vertices": len(kept[2])}
    return tuple(call(_map_vjp, 3)(*kept, *slopes[:2], *options, output_dims=shapes))


_canonical.defvjp(_keep_canonical, _propagate_canonical)


def _options(change: wp.array[Any], camera: int, is_changed: bool, numbers: tuple[float, ...]) -> FrameOptions:
    red, green, blue, step = numbers
    view = object_of(camera, Camera)
    return FrameOptions(view, host(change) if is_changed else None, (red, green, blue), step or None)


def _draw(
    vertices: wp.array[wp.vec3],
    change: wp.array[float],
    deformer: int,
    camera: int,
    is_changed: bool,
    red: float,
    green: float,
    blue: float,
    step: float,
    rgb: wp.array2d[wp.vec3],
    alpha: wp.array2d[float],
    depth: wp.array2d[float],
) -> None:
    options = _options(change, camera, is_changed, (red, green, blue, step))
    found = posed_frame(object_of(deformer, Deformer), host(vertices), options)
    for target, values in zip((rgb, alpha, depth), found, strict=True):
        write(target.flatten(), values)


def _draw_vjp(
    vertices: wp.array[wp.vec3],
    change: wp.array[float],
    by_rgb: wp.array2d[wp.vec3],
    by_alpha: wp.array2d[float],
    by_depth: wp.array2d[float],
    deformer: int,
    camera: int,
    is_changed: bool,
    red: float,
    green: float,
    blue: float,
    step: float,
    by_vertices: wp.array[wp.vec3],
    by_change: wp.array[float],
) -> None:
    options, slopes = _options(change, camera, is_changed, (red, green, blue, step)), (by_rgb, by_alpha, by_depth)
    by_pose, by_camera = posed_frame_vjp(object_of(deformer, Deformer), host(vertices), slopes, options)
    write(by_vertices, by_pose)
    if by_camera is None:
        by_change.zero_()
    else:
        by_change.assign(by_camera.astype("float32"))


#: Number of a Deformer, camera, whether it is changed, and red, green, blue and step. JAX holds the camera as long as
#: what it compiled for it.
_FrameOptions = tuple[int, Camera, bool, tuple[float, ...]]


def _numbers(options: _FrameOptions) -> tuple[Any, ...]:
    """Options as XLA passes them on."""
    deformer, camera, is_changed, numbers = options
    return deformer, number_of(camera, Camera, "render needs"), is_changed, *numbers


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
@functools.partial(jax.jit, static_argnums=2)
def _frame(vertices: Any, change: Any, options: _FrameOptions) -> Any:
    shapes = dict.fromkeys(PART_NAMES, (options[1].height, options[1].width))
    return tuple(call(_draw, 3)(vertices, change, *_numbers(options), output_dims=shapes))


def _keep_frame(vertices: Any, change: Any, options: _FrameOptions) -> Any:
    return _frame(vertices, change, options), (vertices, change)


@functools.partial(jax.jit, static_argnums=0)
def _propagate_frame(options: _FrameOptions, kept: Any, slopes: Any) -> Any:
    shapes = {"by_vertices": len(kept[0]), "by_change": 7}
    return tuple(call(_draw_vjp, 2)(*kept, *slopes, *_numbers(options), output_dims=shapes))


_frame.defvjp(_keep_frame, _propagate_frame)
