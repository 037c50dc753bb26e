"""Crumbs: small pieces of matter that the wall of a cage cuts off a part, and leaves floating where they were."""

from __future__ import annotations

import numpy as np

from ..cage.cage import Cage
from ..field.selection import visible_rows
from ..field.voxel_field import VoxelField


def crumbs(field: VoxelField, cage: Cage, size: float) -> np.ndarray:
    """Indices (n, 3) of the voxels of crumbs outside a cage at rest, whose boxes have diagonals below `size`, world
    units."""
    # A crumb is a connected piece (over faces, edges and corners of voxels) of the visible matter outside the cage that
    # touches visible matter inside it, and whose box has a diagonal of less than `size`.
    from scipy.ndimage import binary_dilation
    from skimage.measure import label, regionprops

    # a crumb lies within its size of the cage; what reaches the border of this block is none
    margin = size + 2.0 * field.voxel_size
    low = np.floor((cage.bounds[0] - margin - field.bounds[0]) / field.voxel_size).astype(int)
    high = np.ceil((cage.bounds[1] + margin - field.bounds[0]) / field.voxel_size).astype(int)
    low, high = np.clip(low, 0, field.resolution), np.clip(high, 0, field.resolution)
    if not field.voxel_count or (high - low < 1).any():
        return np.zeros((0, 3), int)
    links = field.grid.links.numpy()[tuple(map(slice, low, high))]
    held = links >= 0
    matter = np.logical_and(held, visible_rows(field)[np.maximum(links, 0)])

    def in_cage(mask: np.ndarray) -> np.ndarray:
        """The voxels of a mask that lie in the cage."""
        cells, inner = np.argwhere(mask), np.zeros(mask.shape, bool)
        inner[tuple(cells.T)] = cage.contains(field.bounds[0] + (cells + low + 0.5) * field.voxel_size)
        return inner

    def grown(mask: np.ndarray) -> np.ndarray:
        """A mask and all voxels next to it."""
        return np.asarray(binary_dilation(mask, np.ones((3, 3, 3))), dtype=bool)

    inside = in_cage(matter)
    outside = np.logical_and(matter, ~inside)
    pieces = np.asarray(label(outside, connectivity=3))
    touching = np.unique(pieces[grown(inside) & outside])
    chosen = np.zeros(matter.shape, bool)
    for piece in regionprops(pieces):
        begin, end = np.array(piece.bbox[:3]), np.array(piece.bbox[3:])
        cut = ((begin == 0) & (low > 0)) | ((end == matter.shape) & (high < field.resolution))
        if piece.label in touching and not cut.any():
            if np.linalg.norm((end - begin) * field.voxel_size) < size:
                chosen[tuple(piece.coords.T)] = True
    # faint voxels around a crumb go with it, where no other matter is next to them
    faint = grown(chosen) & ~grown(outside & ~chosen) & held & np.logical_not(matter)
    return np.argwhere(chosen | (faint & ~in_cage(faint))) + low
