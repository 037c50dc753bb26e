"""A deformed scene as a voxel field of its own."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..core.devices import launch
from ..core.memory import require_memory
from ..field.sparse import link_mask
from ..field.voxel_field import VoxelField
from ..kernels.deform.bake import bake_nodes, mark_filled_nodes
from ..kernels.field.harmonics import vec9
from .deformer import Deformer
from .edits import LatticeEdits

#: Cells of the lattice that stands in for a Deformer without one.
STAND_IN_RESOLUTION = 128

#: Bytes a node takes while it is looked for, and a voxel that is kept.
NODE_BYTES, VOXEL_BYTES = 16, 160


def bake(deformer: Deformer, resolution: int | None = None, bounds=None) -> VoxelField:
    """Resample the deformed scene into a VoxelField, which renders faster, and is saved in either format.

    resolution: voxels along the longest side of `bounds`; None keeps the largest voxel that no side of the field's
    exceeds. bounds: (2, 3) world units to look in; None is all that the field and the deformed cages reach. The new
    field's bounds are the box of what is found there; backgrounds, `up` and supersampling are the source's, and it has
    no training rays' weights.

    Harmonics are turned by the rotation of the map's Jacobian (polar decomposition), which a shear or a stretch leaves
    approximate. density="opacity": a voxel has one density for all directions and takes the root mean square over them
    of the map's stretch; exact for rotations and uniform scales. A precise Deformer is baked from a lattice of
    128 cells.
    Raises ValueError for bounds or a resolution that cannot be, or where nothing is found.

    Example::

        bake(Deformer(field, cage).pose(cage.twist(60))).save("twisted.npz", format="svox2")
    """
    if not isinstance(deformer, Deformer):
        raise ValueError(f"bake needs a Deformer, got {type(deformer).__name__}")
    deformer._require_pose()
    edits, field, device = _lattice_edits(deformer), deformer.field, deformer.device
    searched = _reach(deformer) if bounds is None else _checked_bounds(bounds)
    side = _voxel_side(field, searched, resolution)
    shape = np.maximum(np.ceil((searched[1] - searched[0]) / side - 1e-6).astype(int), 2)
    need = f"looking through {' x '.join(map(str, shape))} voxels needs {{size}}: give a lower resolution or bounds"
    require_memory(NODE_BYTES * int(np.prod(shape, dtype=np.int64)), device, need)

    spacing = wp.vec3(side, side, side)
    lower = searched[0] + 0.5 * side  # of the first voxel's centre
    mask = wp.empty(tuple(int(n) for n in shape), dtype=wp.uint8, device=device)
    inputs = [edits.array, field.grid, wp.vec3(*(lower - field.center)), spacing]
    launch(mark_filled_nodes, mask.size, inputs, [mask], device=device)
    filled = mask.numpy()
    begin, end = _filled_range(filled)
    mask = wp.array(np.ascontiguousarray(filled[tuple(map(slice, begin, end))]), dtype=wp.uint8, device=device)
    lower = lower + begin * side

    links, nodes = link_mask(mask)
    require_memory(VOXEL_BYTES * nodes.size, device, f"{nodes.size} voxels need {{size}}: give a lower resolution")
    density = wp.empty(nodes.size, dtype=wp.float32, device=device)
    sh = wp.empty((nodes.size, 3), dtype=vec9, device=device)
    inputs = [
        edits.array,
        field.grid,
        wp.vec3(*(lower - field.center)),
        spacing,
        nodes,
        side,
        int(deformer.density == "opacity"),
    ]
    launch(bake_nodes, nodes.size, inputs, [density, sh], device=device)
    corner = lower - 0.5 * side
    return VoxelField(
        [corner, corner + side * np.array(mask.shape)], links, density, sh, device=device, **field.view_options()
    )


def _lattice_edits(deformer: Deformer) -> LatticeEdits:
    if isinstance(deformer._edits, LatticeEdits):
        return deformer._edits
    stand_in = Deformer(
        deformer.field,
        deformer.edits,
        coordinates=deformer.coordinates,
        density=deformer.density,
        resolution=STAND_IN_RESOLUTION,
        device=deformer.device,
    )
    return stand_in.pose(deformer.deformed)._edits


def _reach(deformer: Deformer) -> np.ndarray:
    """(2, 3) box of the field and all deformed cages."""
    boxes = [deformer.field.bounds] + [cage.bounds for cage in deformer.deformed if cage is not None]
    return np.stack([np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)])


def _checked_bounds(bounds) -> np.ndarray:
    bounds = np.asarray(bounds, np.float64)
    if bounds.shape != (2, 3) or not np.isfinite(bounds).all() or not (bounds[1] > bounds[0]).all():
        raise ValueError(f"bounds must be (2, 3), finite, lower below upper, got {bounds.tolist()}")
    return bounds


def _voxel_side(field: VoxelField, bounds: np.ndarray, resolution: int | None) -> float:
    if resolution is None:
        return float(field.voxel_size.min())
    if isinstance(resolution, bool) or not isinstance(resolution, int | np.integer) or not 2 <= resolution <= 2048:
        raise ValueError(f"resolution must be a whole number of voxels, 2 to 2048, got {resolution!r}")
    return float((bounds[1] - bounds[0]).max()) / int(resolution)


def _filled_range(filled: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First and last (exclusive) index of filled nodes along each axis, at least two apart."""
    begin, end = np.zeros(3, int), np.zeros(3, int)
    for axis in range(3):
        indices = np.flatnonzero(filled.any(axis=tuple(other for other in range(3) if other != axis)))
        if not len(indices):
            raise ValueError("nothing of the deformed scene lies in the bounds: there is nothing to bake")
        begin[axis], end[axis] = indices[0], indices[-1] + 1
        if end[axis] - begin[axis] < 2:
            begin[axis] = max(0, begin[axis] - 1)
            end[axis] = begin[axis] + 2
    return begin, end
