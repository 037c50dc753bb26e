"""Gradient of a frame's loss by the map of the pose, by the camera and by the field."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Any

import warp as wp

from ..core.arrays import array_view, empty_array
from ..core.checks import require_type
from ..core.devices import launch
from ..deform.deformer import Deformer
from ..errors import InputError
from ..field.render import STOP_TRANSMITTANCE, FieldView, RenderOptions
from ..field.voxel_field import VoxelField
from ..fitting.batches import ShardedWork, launch_shards, shard_count, sum_shards
from ..kernels.fitting.cameras import CAMERA_NUMBERS
from ..kernels.gradients.frame import FrameSlopes, accumulate_frame_gradient, sum_samples, weigh_samples
from ..kernels.gradients.frame_samples import FrameLoss, FrameRays, RaySamples, find_largest, keep_samples
from ..kernels.render.rays import MarchOptions
from ..kernels.view.rays import TILE_SIZE
from ..render.scene import PosedScene
from ..splats.splat_field import SplatField
from ..view.camera import Camera, camera_array
from .loss import FrameGradient, column_sums, frame_loss
from .splats import splat_gradient

#: Samples of a ray, and rays of whole tiles, that are held at a time, 16 bytes each; a ray with more is followed again.
HELD_SAMPLES = {"cpu": 128, "cuda": 64}
HELD_RAYS = {"cpu": 2**11, "cuda": 2**17}

#: Runs of so many samples whose beginnings are kept on the way.
KNOWN_RUNS = 4

#: Steps of a march, for launches on a CPU.
MARCH_WORK = 200


def frame_gradient(
    deformer: Deformer[Any],
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
    """The gradient of a loss of a frame of the last pose, from that by the frame's colours, opacities and depths.

    Where the frame is not smooth, this is the gradient of what is smooth beside it: see Gradients in docs/arrays.md.

    Args:
        deformer: A posed Deformer of voxels or splats, of one edit that moves or copies.
        camera: The camera of the frame, one ray a pixel.
        image_gradient: (h, w, 3) by the colours, an array of any library. None is zero.
        alpha_gradient: (h, w) by the opacities. None is zero.
        depth_gradient: (h, w) by the depths, per world unit, where pixels have one. None is zero.
        by_vertices: Whether it goes on to the cages' vertices.
        by_camera: Whether it is also taken by the camera's turns, shifts and focal length.
        by_field: Whether it is also taken by what the field stores.
        background: Of the frame, as for `Deformer.render`.
        step: March step of the frame, world units, for voxels. None is the field's.

    Returns:
        The gradients asked for, and for voxels always those by the nodes of the map.

    Raises:
        ValueError: For other fields and edits, surroundings, more rays a pixel, or gradients of another shape.
    """
    require_type(deformer, Deformer, "frame_gradient needs")
    require_type(camera, Camera, "frame_gradient needs")
    field, wanted = deformer.field, {"by_vertices": by_vertices, "by_camera": by_camera, "by_field": by_field}
    if not isinstance(field, (VoxelField, SplatField)):
        raise InputError(f"a frame's gradient is of a VoxelField or SplatField, not of a {type(field).__name__}")
    with deformer.lock:
        loss = frame_loss(camera, field.device, image_gradient, alpha_gradient, depth_gradient)
        if isinstance(field, SplatField):
            if step is not None:
                raise InputError("splats are not marched through: leave step out")
            return splat_gradient(deformer, camera, loss, background, **wanted)
        options = RenderOptions(background=background, step=step)
        return voxel_gradient(deformer, [camera], loss, options, **wanted)


def voxel_gradient(
    deformer: Deformer[VoxelField],
    cameras: Sequence[Camera],
    given: dict[str, wp.array],
    options: RenderOptions,
    *,
    by_vertices: bool = False,
    by_camera: bool = False,
    by_field: bool = False,
) -> FrameGradient:
    """The sum of the gradients of frames of one size; given: (views * h * w,) by their parts, view after view.
    `by_camera` is for one. See `frame_gradient`."""
    # Samples are held at their distances from the camera.
    scene = _plain_scene(deformer)
    field = deformer.field
    views = [FieldView(field, camera, options) for camera in cameras]
    view = views[0]  # all have its step, threads and colour
    if view.side != 1:
        raise InputError(
            f"a gradient is of frames with one ray a pixel, the field takes {view.side**2}: set field.supersampling = 1"
        )
    if view.layers is not None:
        raise InputError("a gradient is of frames without surroundings: give the colour of a background")
    loss = FrameLoss()
    for name, values in given.items():
        setattr(loss, name, values)
    stored = field.grid  # with harmonics as single floats
    field.marching.begin()
    grid = field.marching.grid()
    scene.prepare(grid, view.step)
    edit, march = scene.tables.edits[0], MarchOptions()
    march.step, march.inverse_step, march.stop = view.step, 1.0 / view.step, STOP_TRANSMITTANCE
    march.arc_opacity = int(deformer.density == "opacity")
    rays = FrameRays()
    rays.cameras = camera_array(cameras, field.center, field.device)
    rays.view_rays, rays.background, rays.loss = view.threads, wp.vec3(*map(float, view.color)), loss
    sums = _Sums(tuple(edit.node_counts), stored if by_field else None, view if by_camera else None, field.device)
    sums.add(len(views) * view.threads, [grid, field.marching.densities(), edit, rays, march])
    found = sums.gradient()
    if by_vertices:
        position_map = scene.lattices.maps[0]
        assert position_map is not None and found.nodes is not None  # as the edit is no removal
        posed, rest = position_map.vertex_gradient(found.nodes)
        found = dataclasses.replace(found, vertices=posed, rest_vertices=rest)
    return found


def _plain_scene(deformer: Deformer[Any]) -> PosedScene:
    """The posed edits of a Deformer, which must be one on a lattice, of voxels."""
    scene, edits = deformer.posed_edits(), deformer.edits
    if not isinstance(scene, PosedScene):
        raise InputError("a frame's gradient is of an edit on a lattice: give the Deformer a resolution")
    if len(edits) != 1 or edits[0].remove or edits[0].falloff or edits[0].fragments:
        raise InputError("a frame's gradient is of one edit that moves or copies, without falloff and fragments")
    return scene


class _Sums:
    """What a gradient is added up in: once for each thread of a CPU, whose atomics are plain reads and writes."""

    def __init__(self, shape: tuple[int, ...], stored: Any, view: FieldView | None, device: wp.Device):
        self._device, self._shape, self._stored = device, shape, stored
        self._kind = "cpu" if device.is_cpu else "cuda"
        self._sizes = [3 * math.prod(shape)]  # of numbers: of nodes, harmonics and densities
        self._sizes += [] if stored is None else [stored.sh.size, stored.density.size]
        self._blocks = [wp.zeros(sum(self._sizes), dtype=wp.float32, device=device) for _ in range(shard_count(device))]
        rays = 0 if view is None else view.camera.width * view.camera.height
        self._rays = wp.zeros((rays, int(CAMERA_NUMBERS)), dtype=wp.float32, device=device)

    def add(self, count: int, inputs: list[Any]) -> None:
        """Add what whole tiles of rays pass on; inputs: the field's grid and rows, edit, FrameRays and options."""
        most = HELD_RAYS[self._kind]
        for begin in range(0, count, most):
            inputs[3].begin = begin
            self._add_batch(min(most, count - begin), inputs)

    def _add_batch(self, count: int, inputs: list[Any]) -> None:
        device, samples = self._device, RaySamples()
        held = HELD_SAMPLES[self._kind]
        samples.kept = empty_array((held, count), wp.vec4, device)
        samples.begins = empty_array((KNOWN_RUNS, count), wp.vec4, device)
        samples.counts, samples.ends = empty_array(count, wp.int32, device), empty_array(count, wp.vec4, device)

        def keep(back: int) -> None:
            launch(keep_samples, count, [*inputs, back], [samples], device=device, work=MARCH_WORK)

        keep(0)
        self._spread([*inputs, 0, samples])
        largest: wp.array = wp.zeros(1, dtype=wp.int32, device=device)
        launch(find_largest, count, [samples.counts], [largest], device=device, threads=1)
        runs = -(-int(largest.numpy()[0]) // held)  # read behind all that most rays need
        if runs > KNOWN_RUNS:
            samples.begins = empty_array((runs, count), wp.vec4, device)
            keep(-1)
        for back in range(1, runs):
            keep(back)
            self._spread([*inputs, back, samples])

    def _spread(self, inputs: list[Any]) -> None:
        """Add what the samples of a table pass on."""
        device, back, samples = self._device, *inputs[-2:]
        rays = samples.counts.size
        if device.is_cpu:  # a thread goes through rays that are its own
            outputs = [[self._slopes(shard)] for shard in range(len(self._blocks))]
            work = ShardedWork(accumulate_frame_gradient, rays // TILE_SIZE, [1, *inputs], outputs, items=TILE_SIZE)
            launch_shards([work], len(self._blocks), device)
            return
        slots = samples.kept.shape[0]
        launch(weigh_samples, slots * rays, inputs, device=device)
        launch(sum_samples, rays, [back, samples], device=device)
        launch(accumulate_frame_gradient, slots * rays, [slots, *inputs], [self._slopes(0)], device=device)

    def gradient(self) -> FrameGradient:
        """All that was added."""
        sum_shards(self._blocks)
        nodes, *of_field = self._parts(0)
        camera = None
        if self._rays.shape[0]:
            camera = column_sums(self._rays)
        names = dict(zip(("harmonics", "density"), of_field, strict=False))
        return FrameGradient(nodes.reshape(self._shape), camera=camera, **names)

    def _parts(self, number: int) -> list[wp.array]:
        """Gradients of a block: by nodes (nodes,) vec3, harmonics (rows, n) and densities (rows,)."""
        block, starts = self._blocks[number], [4 * start for start in itertools.accumulate(self._sizes, initial=0)]
        parts = [array_view(block, wp.vec3, math.prod(self._shape))]
        for start, name in zip(starts[1:], ("sh", "density"), strict=False):
            if self._stored is not None:
                parts.append(array_view(block, wp.float32, getattr(self._stored, name).shape, offset=start))
        return parts

    def _slopes(self, number: int) -> Any:
        """The FrameSlopes of a block."""
        slopes = FrameSlopes()
        for name, part in zip(("nodes", "harmonics", "density"), self._parts(number), strict=False):
            setattr(slopes, name, part)
        if self._rays.shape[0]:
            slopes.rays = self._rays
        return slopes
