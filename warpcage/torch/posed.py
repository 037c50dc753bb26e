"""Points of posed scenes in canonical space, and frames of them, as operators of torch."""

from __future__ import annotations

from typing import Any, Optional

import torch
import warp as wp

from ..deform.deformer import Deformer
from ..interop.numbers import object_of
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
from ..view.frame import parse_background
from .operators import constant_number, host, in_order, like, real_tensor, single, tensor_of


def to_canonical(
    deformer: Deformer[Any],
    points: torch.Tensor,
    directions: torch.Tensor,
    vertices: torch.Tensor | None = None,
    *,
    step: float | None = None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Where points of a deformed scene are in the canonical one, with gradients by points, directions and pose.

    The same as `Deformer.to_canonical`, to the bit: what a renderer in torch asks in its march. Gradients by points are
    those of differences over a cell of the lattice; points that the pose clears, or leaves where they are, pass on what
    comes as it is.

    Args:
        deformer: A Deformer of one edit with a resolution, without falloff and fragments. A compiled function holds it
            for a constant.
        points: (n, 3), world units, on the Deformer's device.
        directions: (n, 3), from the camera into the scene, of any length but zero.
        vertices: (v, 3) of the posed cage, world units, on any device. None is the last pose at the time of the call.
        step: The dt of the finite difference, world units. None is the field's march step.

    Returns:
        Points (n, 3) and directions (n, 3), float32, and region (n,) int32: 0 unchanged, 1 cleared, 2 mapped.

    Raises:
        ValueError: As `Deformer.pose` and `Deformer.to_canonical`, and for other edits.
    """
    number = constant_number(deformer, Deformer, "to_canonical needs")
    pose = _last_pose(number) if vertices is None else real_tensor(vertices, "vertices")
    return _canonical(single(points, "points"), single(directions, "directions"), pose, number, step)


def render(
    deformer: Deformer[Any],
    camera: Camera,
    vertices: torch.Tensor | None = None,
    *,
    camera_change: torch.Tensor | None = None,
    background: str | tuple[float, float, float] | None = None,
    step: float | None = None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The view of a camera of a deformed scene, with gradients by the pose and by the camera.

    The same as `Deformer.render`. What the gradients are where a frame is not smooth is in docs/arrays.md, under
    Gradients.

    Args:
        deformer: A Deformer of splats, or of voxels with a resolution, and of one edit without falloff and fragments. A
            compiled function holds it, and the camera, for constants.
        camera: The camera, one ray a pixel.
        vertices: (v, 3) of the posed cage, world units, on any device. None is the last pose at the time of the call.
        camera_change: (7,) turns about the camera's axes, radians, shifts along them, world units, and the logarithm of
            a factor of its focal length. None leaves the camera as it is; given, gradients pass to them.
        background: Red, green and blue behind the scene, or the name of a colour. None is the field's own.
        step: March step, world units, for voxels. None is the field's.

    Returns:
        Colours (h, w, 3), opacities (h, w) and depths (h, w), float32, on the Deformer's device.

    Raises:
        ValueError: As `Deformer.pose` and `Deformer.render`, and for other fields and edits.
    """
    number = constant_number(deformer, Deformer, "render needs")
    view = constant_number(camera, Camera, "render needs")
    pose = _last_pose(number) if vertices is None else real_tensor(vertices, "vertices")
    if camera_change is not None:
        camera_change = real_tensor(camera_change, "camera_change")
    if isinstance(background, str):
        background = tuple(parse_background(background).tolist())
    color = [] if background is None else [float(each) for each in background]
    return _frame(pose, camera_change, number, view, color, step)


@torch.library.custom_op("warpcage::posed_vertices", mutates_args=())
def _last_pose(deformer: int) -> torch.Tensor:
    return torch.tensor(posed_vertices(object_of(deformer, Deformer)))


@_last_pose.register_fake
def _(deformer: int) -> Any:
    return torch.empty(posed_vertices(object_of(deformer, Deformer)).shape, dtype=torch.float64, device="cpu")


@torch.library.custom_op("warpcage::to_canonical", mutates_args=())
def _canonical(
    points: torch.Tensor,
    directions: torch.Tensor,
    vertices: torch.Tensor,
    deformer: int,
    step: Optional[float],  # noqa: UP045 (torch reads the schema of an operator from it)
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    with in_order(points):
        owner = object_of(deformer, Deformer)
        with posed_as(owner, host(vertices)):
            return owner.to_canonical(points.detach(), directions.detach(), step=step)


@_canonical.register_fake
def _(points: Any, directions: Any, *others: Any) -> Any:
    found = [torch.empty_like(each, memory_format=torch.contiguous_format) for each in (points, directions)]
    return *found, points.new_empty(points.shape[0], dtype=torch.int32)


@torch.library.custom_op("warpcage::to_canonical_vjp", mutates_args=())
def _canonical_vjp(
    points: torch.Tensor,
    directions: torch.Tensor,
    vertices: torch.Tensor,
    region: torch.Tensor,
    by_points: torch.Tensor,
    by_directions: torch.Tensor,
    deformer: int,
    step: Optional[float],  # noqa: UP045
    by_vertices: bool,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    with in_order(points):
        owner = object_of(deformer, Deformer)
        with posed_as(owner, host(vertices)):
            slopes, regions = (by_points, by_directions), wp.from_torch(region)
            found = canonical_points_vjp(owner, points, directions, regions, slopes, step, by_vertices=by_vertices)
        by_pose = points.new_zeros((0, 3)) if found.vertices is None else tensor_of(found.vertices)
        return tensor_of(found.points), tensor_of(found.directions), by_pose


@_canonical_vjp.register_fake
def _(points: Any, directions: Any, vertices: Any, *others: Any) -> Any:
    found = [torch.empty_like(each, memory_format=torch.contiguous_format) for each in (points, directions)]
    return *found, points.new_empty((vertices.shape[0] if others[-1] else 0, 3))


def _keep_canonical(ctx: Any, inputs: Any, output: Any) -> None:
    ctx.save_for_backward(*inputs[:3], output[2])
    ctx.mark_non_differentiable(output[2])
    ctx.options = inputs[3:]


def _propagate_canonical(ctx: Any, by_points: Any, by_directions: Any, _: Any) -> Any:
    points, directions, vertices, region = ctx.saved_tensors
    slopes, by_vertices = (by_points, by_directions), ctx.needs_input_grad[2]
    found = _canonical_vjp(points, directions, vertices, region, *slopes, *ctx.options, by_vertices)
    return found[0], found[1], like(found[2], vertices) if by_vertices else None, None, None


_canonical.register_autograd(_propagate_canonical, setup_context=_keep_canonical)


@torch.library.custom_op("warpcage::render", mutates_args=())
def _frame(
    vertices: torch.Tensor,
    camera_change: Optional[torch.Tensor],  # noqa: UP045
    deformer: int,
    camera: int,
    background: list[float],
    step: Optional[float],  # noqa: UP045
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    owner = object_of(deformer, Deformer)
    with in_order(_place(owner)):
        options = _options(owner, camera, camera_change, background, step)
        arrays = posed_frame(owner, host(vertices), options)
        rgb, alpha, depth = map(tensor_of, arrays)
        shape = options.camera.height, options.camera.width
        return rgb.reshape(*shape, 3), alpha.reshape(shape), depth.reshape(shape)


@_frame.register_fake
def _(vertices: Any, camera_change: Any, deformer: int, camera: int, *others: Any) -> Any:
    view = object_of(camera, Camera)
    empty = _place(object_of(deformer, Deformer)).new_empty((view.height, view.width))
    return empty.new_empty((*empty.shape, 3)), empty, torch.empty_like(empty)


@torch.library.custom_op("warpcage::render_vjp", mutates_args=())
def _frame_vjp(
    vertices: torch.Tensor,
    camera_change: Optional[torch.Tensor],  # noqa: UP045
    by_rgb: torch.Tensor,
    by_alpha: torch.Tensor,
    by_depth: torch.Tensor,
    deformer: int,
    camera: int,
    background: list[float],
    step: Optional[float],  # noqa: UP045
) -> tuple[torch.Tensor, torch.Tensor]:
    with in_order(by_rgb):
        owner, slopes = object_of(deformer, Deformer), [each.contiguous() for each in (by_rgb, by_alpha, by_depth)]
        options = _options(owner, camera, camera_change, background, step)
        by_pose, by_change = posed_frame_vjp(owner, host(vertices), slopes, options)
        empty = by_rgb.new_zeros(0)
        return tensor_of(by_pose), empty if by_change is None else torch.from_numpy(by_change).to(by_rgb)


@_frame_vjp.register_fake
def _(vertices: Any, camera_change: Any, by_rgb: Any, *others: Any) -> Any:
    return by_rgb.new_empty(vertices.shape), by_rgb.new_empty(0 if camera_change is None else 7)


def _keep_frame(ctx: Any, inputs: Any, output: Any) -> None:
    ctx.save_for_backward(*inputs[:2])
    ctx.options = inputs[2:]


def _propagate_frame(ctx: Any, *slopes: Any) -> Any:
    vertices, camera_change = ctx.saved_tensors
    found = _frame_vjp(vertices, camera_change, *slopes, *ctx.options)
    return *map(like, found, (vertices, camera_change)), None, None, None, None


_frame.register_autograd(_propagate_frame, setup_context=_keep_frame)


def _options(
    deformer: Deformer[Any], camera: int, change: torch.Tensor | None, background: list[float], step: float | None
) -> FrameOptions:
    """What a frame is of."""
    if change is not None:
        require_camera_numbers(change.shape)
    numbers = None if change is None else host(change)
    return FrameOptions(object_of(camera, Camera), numbers, frame_color(deformer, background or None), step)


def _place(deformer: Deformer[Any]) -> torch.Tensor:
    """A tensor of nothing where a Deformer is."""
    return torch.empty(0, device=wp.device_to_torch(deformer.device))
