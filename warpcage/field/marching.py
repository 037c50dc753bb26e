"""What marches read of a field: tables that follow its arrays, whoever writes to them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from ..core.devices import RepeatedLaunch
from ..core.locks import owner_lock
from ..core.modules import Kernel
from ..kernels.field.grid import VoxelGrid
from ..kernels.field.march import image_kernel
from ..kernels.field.render_cpu import render_tiles
from ..view.camera import TILE_SIZE
from ..view.frame import PART_NAMES
from .matter_cells import MatterCellTable
from .rendering import STOP_TRANSMITTANCE, MakeArrays, March
from .shading import ColumnTable, row_table, shaded_grid
from .sparse import MatterSkip

#: Voxels are shaded for a camera at least this many voxels away: nearer ones are seen under too many directions.
NEAR_VOXELS = 16.0

#: Whether that is done on a CPU too, where rays are few, and bands of a picture would each shade all voxels.
SHADES_ON_CPU = False

#: Whether a CPU marches the rays of a tile side by side, and not one by one as CUDA does.
TILES_ON_CPU = True


class MarchTables:
    """What marches read of a grid instead of its own arrays."""

    # Values are read anew for each frame, so that none is shown that is no longer there. What is kept depends on the
    # links, which do not change, and on which densities are above zero, which is compared at each frame.

    def __init__(self, grid: Any):
        self._grid = grid
        self._columns: ColumnTable | None = None
        self._marched: Any = None
        self._launches: dict[Kernel, RepeatedLaunch] = {}
        self._matter = MatterSkip(grid.links)
        self._cells = MatterCellTable(grid.links)
        size, lower = np.array(grid.voxel_size), np.array(grid.lower)
        self._box = lower.tolist(), (lower + size * (np.array(grid.links.shape) - 1)).tolist()
        self._longest = float(size.max())
        self._lock = owner_lock(grid.links.device)  # threads may share a field

    @property
    def columns(self) -> ColumnTable:
        """The rows told by bits, made when they are first asked for."""
        with self._lock:
            if self._columns is None:
                self._columns = ColumnTable(self._grid.links)
            return self._columns

    def begin(self) -> None:
        """Start on what `grid` waits for; launch what does not need it in between."""
        with self._lock:
            self._matter.compare(self._grid.density)

    def grid(self) -> Any:
        """The VoxelGrid, with a `skip` that leaves out what holds no matter now."""
        own = self._grid
        with self._lock:
            skip, grid = self._matter.distance(own.density), self._marched
            if grid is None or grid.skip is not skip or grid.density is not own.density or grid.sh is not own.sh:
                self._marched = grid = VoxelGrid()
                grid.lower, grid.voxel_size, grid.inverse_voxel_size = own.lower, own.voxel_size, own.inverse_voxel_size
                grid.links, grid.density, grid.sh, grid.skip = own.links, own.density, own.sh, skip
        return grid

    def rows(self) -> Any:
        """The rows as they are now: a RowTable of kernels/field/rows.py."""
        return row_table(self._grid, self.columns)

    def begin_image(self, centre: wp.vec3, step: float, work: float) -> March:
        """Start on a view of the grid and return what launches the rest; step: world units.
        centre: of the camera, relative to the grid's origin; work: steps that a ray may take, as `launch` has them."""
        kernel, inputs, rays = self._image_kernel(centre, step)

        def march(threads: int, pinhole: Any, colour: wp.vec3, make_arrays: MakeArrays) -> None:
            arrays = make_arrays()
            outputs = [arrays[name] for name in PART_NAMES]
            view = [pinhole, colour, step, STOP_TRANSMITTANCE]
            passing = len(view) + len(outputs)
            self._launch_of(kernel)(threads // rays, [*inputs, *view], outputs, passing=passing, work=rays * work)

        return march

    def _launch_of(self, kernel: Kernel) -> RepeatedLaunch:
        """The launch of a kernel that renders views."""
        if kernel not in self._launches:
            self._launches[kernel] = RepeatedLaunch(kernel, self._grid.links.device)
        return self._launches[kernel]

    def _image_kernel(self, centre: wp.vec3, step: float) -> tuple[Kernel, list[Any], int]:
        """A kernel that renders views of the grid, its first inputs, and the rays that one of its items follows.
        centre: of the camera, relative to the grid's origin; step: world units."""
        self.begin()
        if self.is_shaded(centre):
            shaded = shaded_grid(self._grid, self.columns, centre, step)
            return image_kernel(True), [self.grid(), shaded], 1
        rows = self.rows()
        if self.by_tiles:
            grid = self.grid()
            return render_tiles, [grid, rows, self.cells(grid)], TILE_SIZE
        return image_kernel(False), [self.grid(), rows], 1

    @property
    def by_tiles(self) -> bool:
        """Whether kernels for the rays of a tile render views."""
        return self._grid.links.device.is_cpu and TILES_ON_CPU

    def cells(self, grid: Any) -> Any:
        """The densities by cells, on a CPU: a MatterCells; grid: what `grid()` returned."""
        with self._lock:
            return self._cells.cells(grid.density, grid.skip, self._matter.version)

    def is_shaded(self, centre: wp.vec3, others: Sequence[Sequence[Sequence[float]]] = ()) -> bool:
        """Whether voxels are shaded for a camera: where none is near it, nor to others: boxes (2, 3) they are moved
        into. centre: of the camera, relative to the grid's origin, as boxes are."""
        if self._grid.links.device.is_cpu and not SHADES_ON_CPU:
            return False
        near, place = NEAR_VOXELS * self._longest, (centre[0], centre[1], centre[2])
        return all(box_distance(lower, upper, place) > near for lower, upper in (self._box, *others))


def box_distance(lower: Sequence[float], upper: Sequence[float], point: Any) -> float:
    """How far a point (3,) is from a box; 0 within."""
    return math.hypot(*(max(low - x, x - high, 0.0) for low, x, high in zip(lower, point, upper, strict=True)))
