"""A deformed scene as a voxel field of its own."""

from __future__ import annotations

from typing import Any, overload

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arrays import empty_array
from ..core.checks import checked_bounds, checked_whole, require_type
from ..core.devices import launch
from ..core.memory import require_memory
from ..core.names import chosen
from ..core.reports import Progress, report_progress, reports_progress
from ..errors import InputError
from ..field.sparse import link_mask
from ..field.voxel_field import VoxelField
from ..kernels.edits.bake import bake_nodes, mark_filled_nodes
from ..render.scene import PosedScene
from ..splats.splat_field import SplatField
from .deformer import Deformer

#: Cells of the lattice that stands in for a Deformer without one.
STAND_IN_RESOLUTION = 128

#: Bytes that a node takes while it is looked at, and a voxel that is kept.
NODE_BYTES, VOXEL_BYTES = 16, 160

#: Voxels along the longest side of a baked field.
MIN_RESOLUTION, MAX_RESOLUTION = 2, 2048


@overload
def bake(deformer: Deformer[SplatField], *, progress: bool | Progress = ...) -> SplatField: ...
@overload
def bake(
    deformer: Deformer[VoxelField],
    resolution: int | None = ...,
    bounds: ArrayLike | None = ...,
    *,
    progress: bool | Progress = ...,
) -> VoxelField: ...
@overload
def bake(
    deformer: Deformer[Any],
    resolution: int | None = ...,
    bounds: ArrayLike | None = ...,
    *,
    progress: bool | Progress = ...,
) -> VoxelField | SplatField: ...
@reports_progress
def bake(
    deformer: Deformer,
    resolution: int | None = None,
    bounds: ArrayLike | None = None,
    *,
    progress: bool | Progress = False,
) -> VoxelField | SplatField:
    """The deformed scene as a field that needs no cage: voxels resampled, which render faster; splats as they are.

    For splats see `Deformer.baked`; the rest is about voxels, which are saved in any format.

    The new field's bounds are the box of what is found; backgrounds, `up` and supersampling are the source's, and it
    has no training rays' weights. Harmonics are turned by the rotation of the map's Jacobian (polar decomposition),
    which a shear or a stretch leaves approximate. With density="opacity" a voxel has one density for all directions and
    takes the root mean square over them of the map's stretch, which is exact for rotations and uniform scales. A
    precise Deformer is baked from a lattice of 128 cells.

    Example::

        bake(Deformer(field, cage).pose(cage.twist(60))).save("twisted.npz", format="svox2")

    Args:
        deformer: The posed Deformer.
        resolution: Voxels along the longest side of `bounds`. None, as splats need it, takes voxels whose side is the
            smallest side of the field's voxels.
        bounds: (2, 3) box to look in, world units. None is all that the field and the deformed cages reach.
        progress: True shows a bar on stderr. A function is called with (done, total, message), in stages, and cancels
            the work by returning False or by raising.

    Returns:
        The baked field, on the Deformer's device.

    Raises:
        ValueError: For bounds or a resolution out of range, where nothing is found, or for too little memory.
        Cancelled: Where `progress` returned False.
    """
    require_type(deformer, Deformer, "bake needs")
    if isinstance(deformer.field, SplatField):
        if resolution is not None or bounds is not None:
            raise InputError("splats are baked one by one: leave resolution and bounds out")
        return deformer.baked()
    require_type(deformer.field, VoxelField, "bake needs a Deformer of")
    with deformer.lock:
        return _baked(deformer, resolution, bounds, progress)


def _baked(
    deformer: Deformer[VoxelField], resolution: int | None, bounds: ArrayLike | None, progress: bool | Progress
) -> VoxelField:
    """`bake`, while the pose stays."""
    report_progress(progress, 0, 3, "bake: the pose")
    edits, field, device = lattice_edits(deformer), deformer.field, deformer.device
    searched = deformer.reached_bounds if bounds is None else checked_bounds(bounds)
    side = float(field.voxel_size.min())
    if resolution is not None:
        longest = float((searched[1] - searched[0]).max())
        side = longest / checked_whole(resolution, "resolution", MIN_RESOLUTION, MAX_RESOLUTION)
    shape = np.maximum(np.ceil((searched[1] - searched[0]) / side - 1e-6).astype(int), 2)
    need = f"looking through {' x '.join(map(str, shape))} voxels needs {{size}}: give a lower resolution or bounds"
    require_memory(NODE_BYTES * int(np.prod(shape, dtype=np.int64)), device, need)

    report_progress(progress, 1, 3, "bake: search")
    spacing = wp.vec3(side, side, side)
    lower = searched[0] + 0.5 * side  # of the first voxel's centre
    mask = empty_array(tuple(int(n) for n in shape), wp.uint8, device)
    inputs = [edits.array, field.linked_grid(), wp.vec3(*(lower - field.center)), spacing]
    launch(mark_filled_nodes, mask.size, inputs, [mask], device=device)
    filled = mask.numpy()
    begin, end = filled_range(filled)
    mask = wp.array(np.ascontiguousarray(filled[tuple(map(slice, begin, end))]), dtype=wp.uint8, device=device)
    lower = lower + begin * side

    report_progress(progress, 2, 3, "bake: voxels")
    links, nodes = link_mask(mask)
    require_memory(VOXEL_BYTES * nodes.size, device, f"{nodes.size} voxels need {{size}}: give a lower resolution")
    density = empty_array(nodes.size, wp.float32, device)
    sh = empty_array((nodes.size, field.stored.sh.shape[1]), wp.float32, device)
    inputs = [
        edits.array,
        field.stored,  # with the links that were asked for above
        wp.vec3(*(lower - field.center)),
        spacing,
        wp.vec3i(*mask.shape),
        nodes,
        side,
        chosen(deformer.density, "density", opacity=1, paper=0),
    ]
    launch(bake_nodes, nodes.size, inputs, [density, sh], device=device)
    report_progress(progress, 3, 3, "bake: done")
    corner = lower - 0.5 * side
    return VoxelField(
        [corner, corner + side * np.array(mask.shape)], links, density, sh, device=device, **field.view_options()
    )


def lattice_edits(deformer: Deformer) -> PosedScene:
    """The edits of a Deformer, posed at rest where it was not posed, on lattices."""
    edits = deformer.posed_edits()
    if isinstance(edits, PosedScene):
        return edits
    assert deformer.deformed is not None
    stand_in = Deformer(  # its own edits have no lattice: those of another Deformer in the same pose stand in
        deformer.field,
        deformer.edits,
        coordinates=deformer.coordinates,
        density=deformer.density,
        resolution=STAND_IN_RESOLUTION,
        device=deformer.device,
    )
    return lattice_edits(stand_in.pose(deformer.deformed))


def filled_range(filled: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First and last (exclusive) index, (3,) int each, of the box of nodes filled in (nx, ny, nz) bool or uint8.
    They are at least two apart along each axis."""
    begin, end = np.zeros(3, int), np.zeros(3, int)
    for axis in range(3):
        indices = np.flatnonzero(filled.any(axis=tuple(other for other in range(3) if other != axis)))
        if not len(indices):
            raise InputError("nothing of the deformed scene lies in the bounds: there is nothing to bake")
        begin[axis], end[axis] = indices[0], indices[-1] + 1
        if end[axis] - begin[axis] < 2:
            begin[axis] = max(0, begin[axis] - 1)
            end[axis] = begin[axis] + 2
    return begin, end
