"""Detached fragments: small pieces of matter outside a rest cage, found, and carried where the part goes."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ..cage.cage import Cage
from ..core.arrays import empty_array, local_points
from ..core.checks import warn_caller
from ..core.devices import launch
from ..core.memory import require_memory
from ..field.voxel_field import VoxelField
from ..kernels.edits import extension
from ..kernels.edits.structs import FragmentCells
from ..kernels.lattice.cage_map import CageMap
from ..kernels.mesh.triangle import Walls
from ..lattice.buffers import BufferPool
from ..mesh.mesh import prepared_fans
from ..select.selection import visible_rows
from .edits import CageEdit
from .falloff import has_sides


def fragment_voxels(field: VoxelField, cage: Cage, size: float) -> np.ndarray:
    """Indices (n, 3) of the voxels of fragments outside a cage at rest, whose boxes have diagonals below `size`, world
    units."""
    # Connected (over faces, edges, corners) visible matter outside the cage that touches visible matter inside it.
    from scipy.ndimage import binary_dilation
    from skimage.measure import label, regionprops

    # a fragment lies within its size of the cage; what reaches the border of this block is none
    margin = size + 2.0 * field.voxel_size
    low = np.floor((cage.bounds[0] - margin - field.bounds[0]) / field.voxel_size).astype(int)
    high = np.ceil((cage.bounds[1] + margin - field.bounds[0]) / field.voxel_size).astype(int)
    low, high = np.clip(low, 0, field.resolution), np.clip(high, 0, field.resolution)
    if not field.voxel_count or (high - low < 1).any():
        return np.zeros((0, 3), int)
    links = field.host_links()[tuple(map(slice, low, high))]
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
    # faint voxels around a fragment go with it, where no other matter is next to them
    faint = grown(chosen) & ~grown(outside & ~chosen) & held & np.logical_not(matter)
    return np.argwhere(chosen | (faint & ~in_cage(faint))) + low


#: Steps from a voxel to the corners of what it has a part in.
CORNERS = np.stack(np.meshgrid(*[[-1, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)

#: How much larger than the box of its corners the image of a voxel is taken to be, as a share, and in cells.
IMAGE_SHARE, IMAGE_CELLS = 0.1, 0.05

#: A place is found where the map leads from it this near to the voxel, and well found, in voxels.
FOUND, WELL_FOUND = 0.5, 0.02

#: Bytes of a node of the larger lattice with its cell.
NODE_BYTES = 25


class CarriedFragments:
    """The fragments of one edit, and the lattices of its poses made as large as to hold them where they go.
    `index` is the number of the edit, for messages."""

    def __init__(self, edit: CageEdit, field: VoxelField, index: int):
        self._edit, self._index, self._device, self._origin = edit, index, field.device, field.center
        size = edit.fragments
        self.voxels = fragment_voxels(field, edit.cage, size) if size > 0.0 else np.zeros((0, 3), int)  # (n, 3)
        self.cells = FragmentCells()
        self.bounds: np.ndarray | None = None  # (2, 3) box of the last pose's lattice, world units; None: nothing moves
        if not len(self.voxels):
            return
        self._voxel = float(field.voxel_size.max())
        first = self.voxels.min(axis=0) - 1
        marks = np.zeros(np.ptp(self.voxels, axis=0) + 2, np.uint8)
        for low in np.ndindex(2, 2, 2):
            marks[tuple((self.voxels - first - low).T)] = 1
        self.cells.lower = wp.vec3(*(field.bounds[0] + (first + 0.5) * field.voxel_size - self._origin))
        self.cells.inverse_voxel_size = wp.vec3(*(1.0 / field.voxel_size))
        self.cells.marks = wp.array(marks, dtype=wp.uint8, device=self._device)
        corners, rows = np.unique((self.voxels[:, None] + CORNERS).reshape(-1, 3), axis=0, return_inverse=True)
        self._rows = rows.reshape(len(self.voxels), len(CORNERS))  # of the corners of each voxel
        self._points, self._corners = (
            local_points(field.bounds[0] + (nodes + 0.5) * field.voxel_size, self._origin, self._device)
            for nodes in (self.voxels, corners)
        )
        fans = edit.cage.topology.fans
        self._walls = extension.WallMap()
        self._walls.rest = local_points(edit.cage.vertices, self._origin, self._device)
        self._walls.faces = wp.array(fans.faces, dtype=wp.vec3i, device=self._device)
        self._walls.rest_size = edit.cage.size
        self._walls.rest_fans = prepared_fans(self._walls.rest, self._walls.faces, edit.cage.size)
        pool = BufferPool(self._device)
        self._positions, self._distance = pool.buffer(wp.vec3), pool.buffer(wp.float32)
        self._sides, self._pool = pool.buffer(wp.int32), pool
        self._mark_buffer = pool.buffer(wp.uint8)
        self._marks: wp.array | None = None

    def extended(self, cage: Cage, plain: Any, cage_map: Any, walls: Any = None) -> Any:
        """The CageMap of a pose on a lattice that reaches as far as its fragments. plain: the CageMap before it fades;
        cage_map: once it is faded, or `plain` again; walls: the Walls towards which it fades, or None."""
        data = self._walls
        data.posed = local_points(cage.vertices, self._origin, self._device)
        data.posed_size = cage.size
        data.posed_fans = prepared_fans(data.posed, data.faces, cage.size)
        data.plain, data.walls = plain, Walls() if walls is None else walls
        first, last = self._reached_boxes(cage_map)
        low, high = np.zeros(3, int), np.array(cage_map.distance.shape) - 1
        if len(first):
            low, high = np.minimum(low, first.min(axis=0)), np.maximum(high, last.max(axis=0) + 1)
        self.before = -low  # how far the nodes of `cage_map` are behind the lower corner of the result
        padded = tuple(int(n) for n in high - low + 1)
        require_memory(
            NODE_BYTES * int(np.prod(padded)),
            self._device,
            f"the fragments of edit {self._index} go so far that their lattice needs {{size}}: give a smaller size of "
            "fragments, or a lower resolution",
            held=self._pool.bytes,
        )
        result = self._padded(cage_map, padded)
        marks = self._marks = self._mark_buffer.take(tuple(side - 1 for side in padded))
        marks.zero_()
        if len(first):
            depth = int((last - first)[:, 0].max()) + 1
            boxes = [self._triples(cells + self.before) for cells in (first, last)]
            launch(extension.mark_boxes, depth * len(first), [*boxes, depth], [marks], device=self._device, threads=1)
            inputs = [data, result.lower, result.spacing, result.distance, marks]
            launch(extension.carry_nodes, result.distance.size, inputs, [result.positions], device=self._device)
        lower = self._origin + np.array(result.lower)
        self.bounds = np.stack([lower, lower + result.spacing * (np.array(padded) - 1)])
        return result

    def mark(self, edit: Any, cells: wp.array) -> None:
        """Mark the cells of the last pose, of which `edit` is the LatticeEdit, through which fragments go.
        cells: (nx-1, ny-1, nz-1) uint8, the CELL_... flags of `mark_edit_cases`."""
        if self._marks is not None:
            launch(extension.mark_carrying_cells, cells.size, [edit, self._marks], [cells], device=self._device)

    def inner(self, cells: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        """The part of a table over the cells of the larger lattice that lies over the map's own, a view of that
        `shape`."""
        return cells[tuple(slice(b, b + n) for b, n in zip(self.before, shape, strict=True))]

    def _reached_boxes(self, cage_map: Any) -> tuple[np.ndarray, np.ndarray]:
        """First and last cell (m, 3) of the map's lattice, or beside it, that each voxel reaches in the pose."""
        count, faces = self._points.size, self._walls.faces.size
        offsets, errors = (empty_array(count, kind, self._device) for kind in (wp.vec3, wp.float32))
        places = empty_array(self._corners.size, wp.vec3, self._device)
        inputs, work = [self._walls, self._points, WELL_FOUND * self._voxel], 4 * extension.MAX_STEPS * faces
        launch(extension.find_places, count, inputs, [offsets, errors], device=self._device, work=work)
        inputs = [self._walls, self._corners]
        launch(extension.map_forwards, places.size, inputs, [places], device=self._device, work=2 * faces)
        images = places.numpy()[self._rows].astype(np.float64) + offsets.numpy()[:, None]
        images = (images - np.array(cage_map.lower)) / cage_map.spacing
        found = (errors.numpy() < FOUND * self._voxel) & np.isfinite(images).all(axis=(1, 2))
        if not found.all():
            warn_caller(
                f"the pose of edit {self._index} has no place for {np.count_nonzero(~found)} of {count} voxels of "
                "fragments beside the cage, where its map folds over: they are left out; move the cage less, or give "
                "fragments a smaller size"
            )
        low, high = images[found].min(axis=1), images[found].max(axis=1)
        spare = IMAGE_SHARE * (high - low) + IMAGE_CELLS
        return np.floor(low - spare).astype(int), np.floor(high + spare).astype(int)

    def _triples(self, values: np.ndarray) -> wp.array:
        """(n,) vec3i on the device."""
        return wp.array(values.astype(np.int32), dtype=wp.vec3i, device=self._device)

    def _padded(self, cage_map: Any, shape: tuple[int, ...]) -> Any:
        """The map in a larger lattice."""
        result = CageMap()
        result.spacing, result.inverse_spacing = cage_map.spacing, cage_map.inverse_spacing
        corner = np.array(cage_map.lower) - cage_map.spacing * self.before
        result.lower = wp.vec3(*corner)
        result.positions, result.distance = self._positions.take(shape), self._distance.take(shape)
        sides = self._sides.take(int(np.prod(shape)) if has_sides(cage_map) else 0)
        inputs = [cage_map, wp.vec3i(*(int(n) for n in self.before))]
        outputs = [result.positions, result.distance, sides]
        launch(extension.pad_nodes, result.distance.size, inputs, outputs, device=self._device)
        if has_sides(cage_map):
            result.side_index, result.sides = sides, cage_map.sides
        return result


def found_fragments(edit: CageEdit, field: VoxelField, index: int) -> CarriedFragments | None:
    """The fragments that go with an edit, None where there are none; `index` is its number, for messages."""
    carried = CarriedFragments(edit, field, index) if edit.fragments > 0.0 else None
    return carried if carried is not None and len(carried.voxels) else None
