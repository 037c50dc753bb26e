"""Views of posed scenes, one or several by one call, and the outputs of their pixels beside colours."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import warp as wp

from ..cage.cage import Cage
from ..core.arrays import array_view, as_host_array, empty_array, is_device_array, local_points, struct_array
from ..core.checks import require_type, shown
from ..core.devices import launch
from ..core.names import checked_choice
from ..errors import InputError
from ..field.render import PoseKeywords, RenderOptions, RenderTarget, picture_arrays
from ..kernels.render.pixels import MovedCage, find_flow, follow_kernel, trace_kernel
from ..mesh.mesh import prepared_fans
from ..render.view import PosedEdits
from ..view.camera import Camera, camera_struct
from ..view.frame import MASK_NAMES, OUTPUT_NAMES, PART_NAMES, Frame, Frames
from .backends import AnyBackend
from .exact import ExactEdits
from .poses import PoseLike

#: How near a place of another pose must map back to where it was, as a share of the largest rest cage's size.
CLOSE = 1e-4

#: Steps of a pixel that is followed to another pose, for launches on the CPU.
FOLLOW_WORK = 200


class ViewKeywords(PoseKeywords, total=False):
    """What `Deformer.render` takes by keyword."""

    outputs: str | Sequence[str]
    flow_pose: PoseLike | Sequence[PoseLike | None] | None
    flow_camera: Camera | Sequence[Camera] | None


def render_pose(
    backend: AnyBackend,
    cages: list[Cage | None],
    camera: Camera | Sequence[Camera],
    options: RenderOptions,
    outputs: str | Sequence[str],
    flow_pose: Any,
    flow_camera: Camera | Sequence[Camera] | None,
) -> Frame | Frames:
    """See `Deformer.render`; needs the lock."""
    names = checked_outputs(backend, outputs, flow_pose is not None or flow_camera is not None)
    if isinstance(camera, Camera) and not names:
        return backend.render(cages, camera, options)
    cameras = checked_cameras(camera)
    count = len(cameras)
    poses = [] if flow_pose is None else count * [backend.checked(flow_pose)]
    aims = checked_aims(cameras, flow_camera, names)
    frames = render_views(backend, cameras, count * [cages], options, names, poses, aims)
    return frames if is_several(camera) else frames[0]


def render_poses(
    backend: AnyBackend,
    poses: Any,
    camera: Camera | Sequence[Camera],
    options: RenderOptions,
    outputs: str | Sequence[str],
    flow_poses: Any,
    flow_camera: Camera | Sequence[Camera] | None,
) -> Frames:
    """See `Deformer.render_poses`; needs the lock."""
    names = checked_outputs(backend, outputs, flow_poses is not None or flow_camera is not None)
    cages = [backend.checked(pose) for pose in listed_poses(poses)]
    cameras = checked_cameras(camera, len(cages))
    others = [] if flow_poses is None else [backend.checked(pose) for pose in listed_poses(flow_poses)]
    if flow_poses is not None and len(others) != len(cages):
        raise InputError(f"there must be as many flow_poses as poses, {len(cages)}, got {len(others)}")
    aims = checked_aims(cameras, flow_camera, names)
    return render_views(backend, cameras, cages, options, names, others, aims)


def listed_poses(poses: Any) -> list[Any]:
    """Poses as callers give them, one by one: a sequence, or (n, v, 3) vertices of any library."""
    found = list(as_host_array(poses, "poses")) if isinstance(poses, np.ndarray) or is_device_array(poses) else poses
    if not isinstance(found, Sequence) or isinstance(found, str) or not found:
        raise InputError(f"poses must be a list of poses or (n, v, 3) vertices, got {shown(poses)}")
    return list(found)


def is_several(camera: Any) -> bool:
    """Whether this is a sequence of cameras, and not one."""
    return isinstance(camera, Sequence) and not isinstance(camera, str)


def checked_cameras(camera: Any, count: int | None = None) -> list[Camera]:
    """The cameras of a call. count: of the views, which may all have one camera."""
    cameras = list(camera) if is_several(camera) else (count or 1) * [camera]
    for each in cameras:
        require_type(each, Camera, "render needs")
    if not cameras or count not in (None, len(cameras)):
        raise InputError(f"there must be a camera for each view, {count or '1 or more'}, got {len(cameras)}")
    return cameras


def checked_aims(cameras: list[Camera], flow_camera: Any, names: Sequence[str]) -> list[Camera]:
    """The cameras to which flow goes, where it is requested."""
    if "flow" not in names:
        return []
    return cameras if flow_camera is None else checked_cameras(flow_camera, len(cameras))


def checked_outputs(backend: AnyBackend, outputs: str | Sequence[str], flows: bool) -> list[str]:
    """The requested OUTPUT_NAMES, once each. flows: whether another pose or camera was given."""
    requested = list(outputs) if isinstance(outputs, Iterable) and not isinstance(outputs, str) else [outputs]
    for name in requested:
        checked_choice(name, "outputs", (*PART_NAMES, *MASK_NAMES, *OUTPUT_NAMES))
    names = [name for name in OUTPUT_NAMES if name in requested]
    if flows and "flow" not in names:
        raise InputError('flow_pose and flow_camera are the target of flow: add outputs=["flow"]')
    if "flow" in names and not flows:
        raise InputError('outputs=["flow"] needs a target: give flow_pose, flow_camera or both')
    if names and not backend.masks:
        raise InputError(
            f"outputs {', '.join(names)} look pixels up backward, as only voxels do: splats move forward, as meshes do"
        )
    return names


def render_views(
    backend: AnyBackend,
    cameras: Sequence[Camera],
    poses: Sequence[list[Cage | None]],  # of each view
    options: RenderOptions,
    names: Sequence[str],  # of OUTPUT_NAMES
    flow_poses: Sequence[list[Cage | None]],  # to which flow goes; empty where it stays in each view's own
    flow_cameras: Sequence[Camera],  # empty without flow
) -> Frames:
    """The views, in one allocation; needs the lock. Between those of one pose the host waits for nothing."""
    sizes = [(camera.width, camera.height) for camera in cameras]
    other = next((number for number, size in enumerate(sizes) if size != sizes[0]), None)
    if other is not None:
        one, two = ("x".join(map(str, sizes[number])) for number in (0, other))
        raise InputError(f"cameras of one call must have one size: the first has {one}, number {other} has {two}")
    count, pixels = len(sizes), math.prod(sizes[0])
    device = backend.device
    parts = (*PART_NAMES, *backend.masks)
    arrays = picture_arrays(count * pixels, (*parts, *names), device)
    tracks = count * pixels if flow_poses else 0  # pixels that are followed to another pose
    scratch = {"places": empty_array(tracks, wp.vec3, device), "paths": empty_array(tracks, wp.int32, device)}
    slices = [_parts_of({**arrays, **scratch}, pixels, number) for number in range(count)]
    frames = []
    for number, (camera, cages) in enumerate(zip(cameras, poses, strict=True)):
        target = RenderTarget({name: slices[number][name] for name in parts}, is_again=number > 0)
        frame = backend.render(cages, camera, options, target)
        if tracks or {"canonical", "instance"} & set(names):
            _trace(backend, backend.hold(cages), camera, slices[number])
        frame.arrays.update({name: slices[number][name] for name in names})
        frames.append(frame)
    last, moved = None, []
    for cages, part in zip(flow_poses, slices, strict=False):
        edits = backend.hold(cages)
        if cages is not last:
            last, moved = cages, _moved_cages(backend, cages)
        _follow(backend, edits, struct_array(moved, MovedCage, device), part)
    for camera, other, part in zip(cameras, flow_cameras, slices, strict=False):
        seen, target = (camera_struct(each, backend.field.center) for each in (camera, other))
        inputs = [seen, part["depth"], part["places"], target]
        launch(find_flow, pixels, inputs, [part["flow"]], device=device)
    return Frames(frames, arrays)


def _parts_of(arrays: dict[str, wp.array], pixels: int, number: int) -> dict[str, wp.array]:
    """The part of one view, by its number, of arrays of several; arrays without entries stay."""
    return {
        name: array_view(array, array.dtype, pixels, offset=number * pixels * wp.types.type_size_in_bytes(array.dtype))
        if array.size
        else array
        for name, array in arrays.items()
    }


def _trace(backend: AnyBackend, edits: PosedEdits, camera: Camera, arrays: dict[str, wp.array]) -> None:
    """Find what the pixels of a view show, of the pose that the buffers hold."""
    center, device = backend.field.center, backend.device
    none = {"canonical": empty_array(0, wp.vec3, device), "instance": empty_array(0, wp.int32, device)}
    outputs = [{**none, **arrays}[name] for name in ("canonical", "instance", "places", "paths")]
    inputs = [edits.array, wp.vec3(*center), camera_struct(camera, center), arrays["depth"]]
    kernel = trace_kernel(isinstance(edits, ExactEdits))
    launch(kernel, arrays["depth"].size, inputs, outputs, device=device, work=edits.sample_work)


def _follow(backend: AnyBackend, edits: PosedEdits, cages: wp.array, arrays: dict[str, wp.array]) -> None:
    """Take the places of a view to the pose that the buffers hold; cages: its MovedCages."""
    close = CLOSE * max(edit.cage.size for edit in backend.edits)
    inputs, places = [edits.array, cages, close, arrays["paths"]], arrays["places"]
    kernel, work = follow_kernel(isinstance(edits, ExactEdits)), FOLLOW_WORK * edits.sample_work
    launch(kernel, places.size, inputs, [places], device=backend.device, work=work)


def _moved_cages(backend: AnyBackend, cages: Sequence[Cage | None]) -> list[Any]:
    """The MovedCage of each edit in a pose."""
    center, device = backend.field.center, backend.device
    structs = []
    for edit, cage in zip(backend.surfaces, map(backend.surface, cages), strict=True):
        struct, rest = MovedCage(), edit.cage
        if cage is not None:
            struct.vertices, struct.targets = (local_points(each.vertices, center, device) for each in (rest, cage))
            struct.faces = wp.array(rest.topology.fans.faces, dtype=wp.vec3i, device=device)
            struct.fans, struct.size = prepared_fans(struct.vertices, struct.faces, rest.size), rest.size
        structs.append(struct)
    return structs
