"""Crumbs that go with the part: the map of an edit continued beyond the walls of its cage, to where they come out."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..cage.cage import Cage
from ..core.arrays import empty_array
from ..core.checks import warn_caller
from ..core.devices import launch
from ..core.memory import require_memory
from ..field.voxel_field import VoxelField
from ..kernels.deform import carry, carry_cells
from ..kernels.deform.crumbs import CrumbCells
from ..kernels.lattice.cage_map import CageMap
from ..kernels.mesh.walls import Walls
from ..lattice.capture import BufferPool
from ..mesh.fans import prepared_fans
from .crumbs import crumbs
from .edits import CageEdit

#: Steps between the voxels next to one and to the voxel itself.
AROUND = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)

#: How much larger than the box of its corners the image of a voxel is taken to be, as a share, and in cells.
IMAGE_SHARE, IMAGE_CELLS = 0.1, 0.05

#: A place is found where the map leads from it this near to the voxel, in voxels.
FOUND = 0.5

#: Bytes of a node of the larger lattice with its cell.
NODE_BYTES = 24


class CarriedCrumbs:
    """The crumbs of one edit, and the lattices of its poses made as large as to hold them where they go.

    Args:
        edit: The edit.
        field: The field, on the device.
        index: Number of the edit, for messages.

    Attributes:
        voxels: (n, 3) the voxels of crumbs, none where there are no crumbs.
        cells: CrumbCells of kernels/deform/crumbs.py.
        bounds: (2, 3) float64 box of the lattice of the last pose, world units; None before, or where nothing moves.
    """

    def __init__(self, edit: CageEdit, field: VoxelField, index: int):
        self._edit, self._index, self._device, self._origin = edit, index, field.device, field.center
        self.voxels = crumbs(field, edit.cage, edit.crumbs) if edit.crumbs > 0.0 else np.zeros((0, 3), int)
        self.cells = CrumbCells()
        self.bounds: np.ndarray | None = None
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
        corners, rows = np.unique((self.voxels[:, None] + AROUND).reshape(-1, 3), axis=0, return_inverse=True)
        self._rows = rows.reshape(len(self.voxels), len(AROUND))  # of the 27 voxels around each
        points = field.bounds[0] + (corners + 0.5) * field.voxel_size - self._origin
        self._points = wp.array(points.astype(np.float32), dtype=wp.vec3, device=self._device)
        fans = edit.cage.topology.fans
        self._walls = carry.WallMap()
        self._walls.rest = self._local(edit.cage.vertices)
        self._walls.faces = wp.array(fans.faces, dtype=wp.vec3i, device=self._device)
        self._walls.rest_size = edit.cage.size
        self._walls.rest_fans = prepared_fans(self._walls.rest, self._walls.faces, edit.cage.size)
        pool = BufferPool(self._device)
        self._positions, self._distance = pool.buffer(wp.vec3), pool.buffer(wp.float32)
        self._sides, self._pool = pool.buffer(wp.int32), pool
        self._carrying: wp.array | None = None

    def _local(self, vertices: ArrayLike) -> wp.array:
        """(v,) vec3 on the device, relative to the origin."""
        return wp.array((np.asarray(vertices) - self._origin).astype(np.float32), dtype=wp.vec3, device=self._device)

    def extended(self, cage: Cage, plain: Any, cage_map: Any, walls: Any = None) -> Any:
        """The map of a pose on a lattice that reaches as far as its crumbs.

        Args:
            cage: The posed cage.
            plain: Its CageMap, before it fades.
            cage_map: The same once it is faded, or itself again.
            walls: Walls towards which it fades, or None.

        Returns:
            A CageMap; the nodes of `cage_map` are `before` behind the lower corner of its own.
        """
        data = self._walls
        data.posed = self._local(cage.vertices)
        data.posed_size = cage.size
        data.posed_fans = prepared_fans(data.posed, data.faces, cage.size)
        data.plain, data.walls = plain, Walls() if walls is None else walls
        cells = self._reached_cells(cage_map)
        shape = np.array(cage_map.distance.shape)
        low, high = np.zeros(3, int), shape - 1
        if len(cells):
            low, high = np.minimum(low, cells.min(axis=0)), np.maximum(high, cells.max(axis=0) + 1)
        self.before = -low
        padded = tuple(int(n) for n in high - low + 1)
        require_memory(
            NODE_BYTES * int(np.prod(padded)),
            self._device,
            f"the crumbs of edit {self._index} go so far that their lattice needs {{size}}: give a smaller size of "
            "crumbs, or a lower resolution",
            held=self._pool.bytes,
        )
        result = self._padded(cage_map, padded)
        self._carrying = wp.array((cells + self.before).astype(np.int32), dtype=wp.vec3i, device=self._device)
        nodes = np.unique((cells[:, None] + self.before + (AROUND[AROUND.min(axis=1) >= 0])).reshape(-1, 3), axis=0)
        self._launch_nodes(result, nodes)
        lower = self._origin + np.array(result.lower)
        self.bounds = np.stack([lower, lower + result.spacing * (np.array(padded) - 1)])
        return result

    def mark(self, edit: Any, cells: wp.array) -> None:
        """Mark the cells of the last pose through which crumbs go.

        Args:
            edit: The LatticeEdit of the pose.
            cells: (nx-1, ny-1, nz-1) uint8, CELL_... flags, those of `mark_edit_cases`.
        """
        if self._carrying is not None:
            inputs = [edit, self._carrying]
            launch(carry_cells.mark_carrying_cells, self._carrying.size, inputs, [cells], device=self._device)

    def inner(self, cells: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        """The part of a table over the cells of the larger lattice that lies over the map's own.

        Args:
            cells: The table.
            shape: (3,) counts of the map's own cells.

        Returns:
            A view of that shape.
        """
        return cells[tuple(slice(b, b + n) for b, n in zip(self.before, shape, strict=True))]

    def _reached_cells(self, cage_map: Any) -> np.ndarray:
        """(m, 3) cells of the map's lattice, or beside it, that the crumbs reach in the pose."""
        count = self._points.size
        places, errors = (empty_array(count, kind, self._device) for kind in (wp.vec3, wp.float32))
        work = 2 * carry.MOST_STEPS * self._walls.faces.size
        launch(carry.find_places, count, [self._walls, self._points], [places, errors], device=self._device, work=work)
        images = (places.numpy().astype(np.float64) - np.array(cage_map.lower)) / cage_map.spacing
        found = (errors.numpy() < FOUND * self._voxel) & np.isfinite(images).all(axis=1)
        own = found[self._rows[:, len(AROUND) // 2]]
        if not own.all():
            warn_caller(
                f"the pose of edit {self._index} has no place for {np.count_nonzero(~own)} of {len(own)} voxels of "
                "crumbs beside the cage, where its map folds over: they are left out; move the cage less, or give "
                "crumbs a smaller size"
            )
        boxes = np.where(found[self._rows][..., None], images[self._rows], np.nan)[own]
        if not len(boxes):
            return np.zeros((0, 3), int)
        low, high = np.nanmin(boxes, axis=1), np.nanmax(boxes, axis=1)
        spare = IMAGE_SHARE * (high - low) + IMAGE_CELLS
        low, high = np.floor(low - spare).astype(int), np.floor(high + spare).astype(int)
        return cells_of_boxes(low, high)

    def _padded(self, cage_map: Any, shape: tuple[int, ...]) -> Any:
        """The map in a larger lattice."""
        result = CageMap()
        result.spacing, result.inverse_spacing = cage_map.spacing, cage_map.inverse_spacing
        corner = np.array(cage_map.lower) - cage_map.spacing * self.before
        result.lower = wp.vec3(*corner)
        result.positions, result.distance = self._positions.take(shape), self._distance.take(shape)
        has_sides = cage_map.side_index is not None and cage_map.side_index.size > 0
        sides = self._sides.take(int(np.prod(shape)) if has_sides else 0)
        inputs = [cage_map, wp.vec3i(*(int(n) for n in self.before))]
        outputs = [result.positions, result.distance, sides]
        launch(carry_cells.pad_nodes, result.distance.size, inputs, outputs, device=self._device)
        if has_sides:
            result.side_index, result.sides = sides, cage_map.sides
        return result

    def _launch_nodes(self, extended: Any, nodes: np.ndarray) -> None:
        """Continue the map to nodes (n, 3)."""
        places = wp.array(nodes.astype(np.int32), dtype=wp.vec3i, device=self._device)
        inputs = [self._walls, extended.lower, extended.spacing, extended.distance, places]
        work = self._walls.faces.size
        launch(carry.carry_nodes, len(nodes), inputs, [extended.positions], device=self._device, work=work)


def cells_of_boxes(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The cells that boxes of cells hold, each once.

    Args:
        low: (n, 3) int, the first cell of each box.
        high: (n, 3) int, the last one.

    Returns:
        (m, 3) int.
    """
    sides = high - low + 1
    counts = sides.prod(axis=1)
    box = np.repeat(np.arange(len(low)), counts)
    place = np.arange(len(box)) - np.repeat(np.cumsum(counts) - counts, counts)
    ny, nz = sides[box, 1], sides[box, 2]
    steps = np.stack([place // (ny * nz), place // nz % ny, place % nz], axis=1)
    return np.unique(low[box] + steps, axis=0)
