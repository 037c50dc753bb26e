"""Gradient of a frame's loss by the map of the pose, by the camera and by the field."""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import Any

import numpy as np
import warp as wp

from ..core.arrays import array_view, as_numbers, as_points, empty_array
from ..core.devices import launch
from ..deform.deformer import Deformer
from ..errors import InputError
from ..field.render import STOP_TRANSMITTANCE, FieldView, RenderOptions
from ..field.voxel_field import VoxelField
from ..fitting.batches import ShardedWork, launch_shards, shard_count, sum_shards
from ..kernels.fitting.cameras import CAMERA_NUMBERS
from ..kernels.gradients.frame import FrameLoss, FrameSlopes, accumulate_frame_gradient, sum_runs
from ..kernels.render.rays import MarchOptions
from ..kernels.view.rays import TILE_SIZE
from ..render.scene import PosedScene
from ..view.camera import Camera, camera_struct

#: Rays whose derivatives one item adds up.
RUN = 64


@dataclasses.dataclass(frozen=True, eq=False)
class FrameGradient:
    """Derivatives of a loss of one frame, on its device."""

    nodes: wp.array  # (nx, ny, nz) vec3, by the canonical position of each node of the map, per world unit
    vertices: wp.array | None = None  # (v,) vec3, by the vertices of the posed cage, per world unit
    rest_vertices: wp.array | None = None  # (v,) vec3, by those of the cage at rest
    camera: np.ndarray | None = None  # (7,) float64: turns about its axes, radians; shifts along them; log focal length
    density: wp.array | None = None  # (rows,) float32, by the field's densities before the ReLU
    harmonics: wp.array | None = None  # (rows, 24 or 27) float32, by the numbers of its harmonics


def frame_gradient(
    deformer: Deformer[VoxelField],
    camera: Camera,
    image_gradient: Any = None,
    *,
    alpha_gradient: Any = None,
    depth_gradient: Any = None,
    by_vertices: bool = False,
    by_camera: bool = False,
    by_field: bool = False,
    background: Any = None,
    step: float | None = None,
) -> FrameGradient:
    """The gradient of a loss of a frame of the last pose, by its derivatives (h, w, 3) or (h, w) by the frame's
    parts, arrays of any library, None for zero; background, step: of the frame, as for `Deformer.render`."""
    # Samples are held at their distances from the camera. Where the frame is not smooth, this is the gradient of what
    # is smooth beside it: see Gradients in docs/arrays.md. Derivatives by depths count where a pixel has one.
    with deformer.lock:
        scene = _plain_scene(deformer)
        field = deformer.field
        view = FieldView(field, camera, RenderOptions(background=background, step=step))
        if view.side != 1:
            raise InputError(f"a gradient is of frames with one ray a pixel, the field's supersampling is {view.side}")
        if view.layers is not None:
            raise InputError("a gradient is of frames without surroundings: give the colour of a background")
        loss = _frame_loss(view, image_gradient, alpha_gradient, depth_gradient)
        stored = field.grid  # with harmonics as single floats
        field.marching.begin()
        grid = field.marching.grid()
        scene.prepare(grid, view.step)
        edit, options = scene.tables.edits[0], MarchOptions()
        options.step, options.inverse_step, options.stop = view.step, 1.0 / view.step, STOP_TRANSMITTANCE
        options.arc_opacity = int(deformer.density == "opacity")
        sums = _Sums(tuple(edit.node_counts), stored if by_field else None, view if by_camera else None, field.device)
        inputs = [grid, field.marching.columns.columns, edit, camera_struct(camera, field.center)]
        sums.add(view, [*inputs, wp.vec3(*map(float, view.color)), options, loss])
        found = sums.gradient()
        if by_vertices:
            position_map = scene.lattices.maps[0]
            assert position_map is not None  # as the edit is no removal
            posed, rest = position_map.vertex_gradient(found.nodes)
            found = dataclasses.replace(found, vertices=posed, rest_vertices=rest)
        return found


def _plain_scene(deformer: Deformer[Any]) -> PosedScene:
    """The posed edits of a Deformer, which must be one on a lattice, of voxels."""
    if not isinstance(deformer.field, VoxelField):
        raise InputError(f"a frame's gradient is of a VoxelField, not of a {type(deformer.field).__name__}")
    scene, edits = deformer.posed_edits(), deformer.edits
    if not isinstance(scene, PosedScene):
        raise InputError("a frame's gradient is of an edit on a lattice: give the Deformer a resolution")
    if len(edits) != 1 or edits[0].remove or edits[0].falloff or edits[0].fragments:
        raise InputError("a frame's gradient is of one edit that moves or copies, without falloff and fragments")
    return scene


def _frame_loss(view: FieldView, rgb: Any, alpha: Any, depth: Any) -> Any:
    """The FrameLoss of derivatives as callers give them, (h, w, 3) or (h, w)."""
    loss, pixels = FrameLoss(), view.camera.width * view.camera.height
    if rgb is not None:
        is_flat = isinstance(rgb, wp.array) and rgb.dtype == wp.vec3
        rows = as_points(rgb.flatten() if is_flat else _reshaped(rgb, (-1, 3)), view.device, name="image_gradient")
        if len(rows) != pixels:
            size = f"({view.camera.height}, {view.camera.width}, 3)"
            raise InputError(f"image_gradient must be {size}, got {tuple(rgb.shape)}")
        loss.rgb = rows
    for name, values in (("alpha", alpha), ("depth", depth)):
        if values is not None:
            setattr(loss, name, as_numbers(values, pixels, view.device, name=f"{name}_gradient"))
    return loss


def _reshaped(values: Any, shape: tuple[int, ...]) -> Any:
    """An array of any library, or lists, in another shape."""
    return values.reshape(shape) if hasattr(values, "reshape") else np.asarray(values, np.float32).reshape(shape)


class _Sums:
    """What a gradient is added up in: once for each thread of a CPU, whose atomics are plain reads and writes."""

    def __init__(self, shape: tuple[int, ...], stored: Any, view: FieldView | None, device: wp.Device):
        self._device, self._shape, self._stored = device, shape, stored
        self._sizes = [3 * math.prod(shape)]  # of numbers: of nodes, densities and harmonics
        self._sizes += [] if stored is None else [stored.density.size, stored.sh.size]
        self._blocks = [wp.zeros(sum(self._sizes), dtype=wp.float32, device=device) for _ in range(shard_count(device))]
        rays = 0 if view is None else view.camera.width * view.camera.height
        self._rays = wp.zeros((rays, int(CAMERA_NUMBERS)), dtype=wp.float32, device=device)

    def add(self, view: FieldView, inputs: list[Any]) -> None:
        """Launch the march of a view."""
        if not self._device.is_cpu:
            launch(accumulate_frame_gradient, view.threads, inputs, [self._slopes(0)], device=self._device)
            return
        outputs = [[self._slopes(shard)] for shard in range(len(self._blocks))]
        tiles = view.threads // TILE_SIZE
        work = ShardedWork(accumulate_frame_gradient, tiles, inputs, outputs, items=TILE_SIZE)
        launch_shards([work], len(self._blocks), self._device)

    def gradient(self) -> FrameGradient:
        """All that was added."""
        sum_shards(self._blocks)
        nodes, *of_field = self._parts(0)
        camera = None
        if self._rays.shape[0]:
            runs = -(-self._rays.shape[0] // RUN)
            sums = empty_array((runs, int(CAMERA_NUMBERS)), wp.float32, self._device)
            launch(sum_runs, sums.size, [self._rays, RUN], [sums], device=self._device, work=RUN)
            camera = sums.numpy().sum(axis=0, dtype=np.float64)
        names = dict(zip(("density", "harmonics"), of_field, strict=False))
        return FrameGradient(nodes.reshape(self._shape), camera=camera, **names)

    def _parts(self, number: int) -> list[wp.array]:
        """Gradients of a block: by nodes (nodes,) vec3, densities (rows,) and harmonics (rows, n)."""
        block, starts = self._blocks[number], [4 * start for start in itertools.accumulate(self._sizes, initial=0)]
        parts = [array_view(block, wp.vec3, math.prod(self._shape))]
        for start, name in zip(starts[1:], ("density", "sh"), strict=False):
            if self._stored is not None:
                parts.append(array_view(block, wp.float32, getattr(self._stored, name).shape, offset=start))
        return parts

    def _slopes(self, number: int) -> Any:
        """The FrameSlopes of a block."""
        slopes = FrameSlopes()
        for name, part in zip(("nodes", "density", "harmonics"), self._parts(number), strict=False):
            setattr(slopes, name, part)
        if self._rays.shape[0]:
            slopes.rays = self._rays
        return slopes
