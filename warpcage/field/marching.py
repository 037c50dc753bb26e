"""What marches read of a field: tables that follow its arrays, whoever writes to them."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ..core.locks import owner_lock
from ..core.modules import Kernel
from ..kernels.field.grid import VoxelGrid
from ..kernels.field.render import render_image
from ..kernels.field.render_shaded import render_shaded_image
from .shading import ColumnTable, row_table, shaded_grid
from .sparse import MatterSkip

#: Voxels are shaded for a camera at least this many voxels away: nearer ones are seen under too many directions.
NEAR_VOXELS = 16.0

#: On the CPU, where rays are few, it pays from this many per voxel; on CUDA it takes no longer than packing rows.
CPU_RAYS_PER_VOXEL = 0.3


class MarchTables:
    """What marches read of a grid instead of its own arrays.

    Values are read anew for each frame, so that none is shown that is no longer there. What is kept depends on the
    links, which do not change, and on which densities are above zero, which is compared at each frame.

    Args:
        grid: The VoxelGrid.
    """

    def __init__(self, grid: Any):
        self._grid = grid
        self._columns: ColumnTable | None = None
        self._matter = MatterSkip(grid.links)
        self._lock = owner_lock(grid.links.device)  # threads may share a field

    @property
    def columns(self) -> ColumnTable:
        """The rows told by bits, made when they are first asked for."""
        with self._lock:
            if self._columns is None:
                self._columns = ColumnTable(self._grid.links)
            return self._columns

    def grid(self) -> Any:
        """The VoxelGrid, with a `skip` that leaves out what holds no matter now."""
        grid, own = VoxelGrid(), self._grid
        grid.lower, grid.voxel_size, grid.inverse_voxel_size = own.lower, own.voxel_size, own.inverse_voxel_size
        grid.links, grid.density, grid.sh = own.links, own.density, own.sh
        with self._lock:
            grid.skip = self._matter.distance(own.density)
        return grid

    def rows(self) -> Any:
        """The rows as they are now: a RowTable of kernels/field/rows.py."""
        return row_table(self._grid, self.columns)

    def image_kernel(self, centre: wp.vec3, rays: int, step: float) -> tuple[Kernel, list[Any]]:
        """What renders a view of the grid.

        Args:
            centre: Of the camera, relative to the grid's origin.
            rays: Their number.
            step: March step, world units.

        Returns:
            A kernel, and its first inputs.
        """
        grid = self.grid()
        if self._pays_shading(centre, rays):
            return render_shaded_image, [grid, shaded_grid(grid, self.columns, centre, step)]
        return render_image, [grid, self.rows()]

    def _pays_shading(self, centre: wp.vec3, rays: int) -> bool:
        """Whether voxels are shaded for a camera."""
        grid = self._grid
        if grid.links.device.is_cpu and rays < CPU_RAYS_PER_VOXEL * grid.density.shape[0]:
            return False
        size = np.array(grid.voxel_size)
        lower = np.array(grid.lower)
        upper = lower + size * (np.array(grid.links.shape) - 1)
        away = np.maximum(lower - np.array(centre), np.array(centre) - upper)
        return bool(np.linalg.norm(np.maximum(away, 0.0)) > NEAR_VOXELS * size.max())
