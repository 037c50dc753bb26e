"""Voxels of a field that edits deform, shaded once for a camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import warp as wp

from ..core.arrays import empty_array
from ..core.devices import HostFlag, RecordedLaunches, launch
from ..field.tables import ColumnTable, whole_warps
from ..kernels.edits.inverse import NO_CELL, gather_inverse, scatter_cells
from ..kernels.render.shading import (
    ViewDirectionCage,
    find_view_directions,
    keep_cage,
    mark_shaded_bricks,
    shade_carried_rows,
)
from ..kernels.render.volume import ShadedVolume
from ..lattice.buffers import BufferPool

#: A trilinear distance changes by at most the root of three per unit of length; rounded up.
STEEPEST = 1.8


class CarriedColors:
    """Where the poses of edits take the matter of their rest cages, and from where a camera sees it."""

    def __init__(self, edit_count: int, device: wp.Device):
        self._device = device
        pool = BufferPool(device)
        self._owners = pool.buffer(wp.int32)
        self._settled = 0  # owners that are NO_CELL, from the first on
        self._places, self._aims = ([pool.buffer(wp.vec4) for _ in range(edit_count)] for _ in range(2))
        self._kept_cages: list[Any] = [None] * edit_count
        # EditData, (nx, ny, nz) vec4 where rest nodes are taken and whether, ViewDirectionCage of edits that move
        self.posed: list[tuple[Any, wp.array, Any]] = []
        self._cages: wp.array | None = None
        self._aimed: wp.vec3 | None = None
        self._folds = HostFlag(device)
        self._is_folded: bool | None = None
        self._launch = RecordedLaunches(device)
        self._laid: Any = None
        self._marked: tuple[ColumnTable, list[tuple[Any, ...]]] | None = None  # what bricks were found for
        self._texture: wp.Texture3D | None = None  # kept alive for kernels, which hold its handle alone
        self.is_posed = False  # whether `pose` was called for the current pose; unset when that changes

    def pose(self, edits: Sequence[Any], cells: Sequence[wp.array], grid: Any) -> None:
        """Find where matter is, once per pose, of the posed EditData and the VoxelGrid as it is marched.
        cells: (nx-1, ny-1, nz-1) uint8 CELL_... flags of each edit's cells."""
        self.posed, self.is_posed, self._is_folded, self._aimed = [], False, None, None  # an interrupt leaves none
        self._folds.clear()
        for number, (edit, flags) in enumerate(zip(edits, cells, strict=True)):
            if not edit.removes:
                self._find_places(number, edit, flags, grid)
        self._folds.send()
        if self._cages is None:
            self._cages = empty_array(len(self.posed), ViewDirectionCage, self._device)
        for index, (_, _, cage) in enumerate(self.posed):
            self._launch(keep_cage, 1, [cage, index], [self._cages], number=index)
        self.is_posed = True

    def _find_places(self, number: int, edit: Any, flags: wp.array, grid: Any) -> None:
        """Launch what finds where the pose of an edit takes the nodes of its rest cage's lattice."""
        shape = edit.rest.distance.shape
        owners, found = self._owners.take(shape), self._places[number].take(shape)
        settled, self._settled = self._settled, 0  # an interrupt leaves none
        if owners.size > settled:
            owners.fill_(int(NO_CELL))
        # one thread on a CPU, where atomics are none
        claims = [owners, self._folds.array]
        self._launch(scatter_cells, flags.size, [edit, flags, grid], claims, number=number, threads=1)
        self._launch(gather_inverse, owners.size, [edit, owners], [found], number=number)
        self._settled = max(settled, owners.size)
        self.posed.append((edit, found, self._aimed_cage(number, edit, found, grid)))

    def _aimed_cage(self, number: int, edit: Any, places: wp.array, grid: Any) -> Any:
        """The ViewDirectionCage of an edit: the same object for all poses, with what differs between them."""
        cage = self._kept_cages[number]
        if cage is None:
            cage = self._kept_cages[number] = ViewDirectionCage()
            cage.lower, cage.inverse_spacing = edit.rest.lower, edit.rest.inverse_spacing
            cage.node_counts, cage.distance = wp.vec3i(*places.shape), edit.rest.distance.flatten()
            cage.places, cage.aims = places.flatten(), self._aims[number].take(places.size)
        diagonal = math.hypot(*grid.voxel_size)
        reach = STEEPEST * diagonal
        cage.depth, cage.wall_depth = 2 * [math.inf] if edit.keeps_source else (reach, diagonal)
        cage.wall_height = edit.slack + diagonal
        cage.height = edit.slack + edit.rest.spacing + reach  # a cell that stays in the cage may bulge out of it
        cage.posed_lower, cage.posed_inverse_spacing = edit.lower, edit.inverse_spacing
        cage.posed_counts, cage.posed_nodes = edit.node_counts, edit.nodes
        cage.side_index, cage.sides = edit.side_index, edit.sides
        return cage

    @property
    def is_known_folded(self) -> bool:
        """Whether `has_inverted_cells` was True for the pose."""
        return bool(self._is_folded)

    def has_inverted_cells(self) -> bool:
        """Whether the pose turns matter over or squeezes it flat: it may then be in several places, and seen from
        several directions."""
        if self._is_folded is None:
            self._is_folded = bool(self._folds.wait())
        return self._is_folded

    def aim(self, center: wp.vec3) -> None:
        """Find from where a camera sees what the pose moves: what `shaded` of that camera begins with.
        `centre` is relative to the grid's origin; `shaded` knows it as the same object."""
        if self.posed:
            self._launch(find_view_directions, sum(places.size for _, places, _ in self.posed), [self._cages, center])
        self._aimed = center

    def find_bricks(self, grid: Any, table: ColumnTable) -> None:
        """Let the bricks that frames write to be among those of a field's table. After `aim`; rest cages decide."""
        cages = [(cage.distance, cage.depth, cage.height, cage.wall_depth, cage.wall_height) for *_, cage in self.posed]
        if self._marked is not None and self._marked[0] is table and self._marked[1] == cages:
            return
        self._marked = None  # an interrupt leaves none
        marks = table.color_bricks.new_marks()
        inputs = [grid, table.columns, table.nodes, self._cages]
        launch(mark_shaded_bricks, table.nodes.size, inputs, [marks], device=self._device)
        table.color_bricks.add(marks)
        self._marked = table, cages

    def shaded(self, grid: Any, table: ColumnTable, center: wp.vec3, step: float) -> Any:
        """The ShadedVolume of a field, of the values that its VoxelGrid has now, as a camera sees them in the pose.
        table: of the grid's links; centre: relative to the grid's origin; step: of the march, world units."""
        rows = table.nodes.shape[0]
        if self._aimed is not center:
            self.aim(center)
        self._aimed = None
        self.find_bricks(grid, table)
        shaded, laid = table.shaded(center, step), self.shaded_volume(table)
        inputs = [grid, table.nodes, self._cages, shaded, laid]
        self._launch(shade_carried_rows, whole_warps(rows, self._device), inputs)
        return laid

    def shaded_volume(self, table: ColumnTable) -> Any:
        """The ShadedVolume of a field, 0 at nodes without a row: on CUDA the same for all frames, which take turns."""
        laid = self._laid
        if laid is None or laid.node_counts != table.columns.node_counts:
            laid = ShadedVolume()
            laid.node_counts = table.columns.node_counts
            laid.cells = wp.vec3(*(float(n - 1) for n in laid.node_counts))
        bricks = table.color_bricks
        if laid.numbers is not bricks.numbers:
            laid.numbers, laid.pages, laid.first_page = bricks.numbers, bricks.pages, bricks.first_page
        if self._device.is_cpu:
            laid.colors = bricks.new_colors()
        else:
            self._laid, self._texture = laid, table.color_texture()
            laid.texture, laid.surface = self._texture.cuda_texture, self._texture.cuda_surface
        return laid

    def release(self) -> None:
        """Let a frame's colours go once its march is launched. What the field does not keep waits for the GPU."""
        self._texture = None
