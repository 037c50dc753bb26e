"""Densities of the cells that hold matter, side by side, as marches on a CPU read them."""

from __future__ import annotations

from typing import Any

import warp as wp

from ..core.arrays import empty_array
from ..core.devices import launch
from ..kernels.field import matter_cells


class DensityWatch:
    """Tells whether densities on a CPU are those of the last time, whoever wrote to them; takes a copy for it."""

    def __init__(self) -> None:
        self._kept: wp.array | None = None
        # another number whenever any density is another one
        self.version = 0

    def has_changed(self, density: wp.array) -> bool:
        """Whether any bit of densities (rows,) float32 on a CPU is another one; True the first time.
        Keeps them as they are now."""
        kept, self._kept = self._kept, None  # an interrupt leaves none
        if kept is None or kept.size != density.size:
            kept, changed = wp.clone(density), True
        else:
            news, run = wp.zeros(1, dtype=wp.int32, device=density.device), int(matter_cells.COMPARED_VALUES)
            inputs = [density, kept, news]
            launch(matter_cells.note_densities, -(-density.size // run), inputs, device=density.device, work=run)
            changed = bool(news.numpy()[0])
        self.version += changed
        self._kept = kept
        return changed


class MatterCellTable:
    """The densities of a grid by cells, see kernels/field/matter_cells; links (nx, ny, nz) int32 on a CPU."""

    def __init__(self, links: wp.array):
        self._links = links
        self._made: tuple[wp.array, int] | None = None  # from which skip, and which version of the densities
        self._cells: Any = None

    def cells(self, density: wp.array, skip: wp.array, version: int) -> Any:
        """The table, a MatterCells, of densities (rows,) float32, before the ReLU; made anew where it is of other ones.
        skip: of MatterSkip for these densities; version: theirs, see DensityWatch."""
        if self._made is None or self._made[0] is not skip or self._made[1] != version:
            self._made = None  # an interrupt leaves none
            self._cells = gathered_cells(self._links, density, skip)
            self._made = skip, version
        return self._cells


def gathered_cells(links: wp.array, density: wp.array, skip: wp.array) -> Any:
    """A MatterCells of densities (rows,) float32 at links (nx, ny, nz); skip: 0 in the cells that hold matter."""
    device, (nx, ny, nz) = links.device, skip.shape
    counts = empty_array(nx * ny, wp.int32, device)
    launch(matter_cells.count_cells, nx * ny, [skip], [counts], device=device, work=nz)
    wp.utils.array_scan(counts, counts, inclusive=True)
    cells = matter_cells.MatterCells()
    cells.blocks = empty_array((nx * ny, -(-nz // int(matter_cells.BLOCK_CELLS))), wp.vec2i, device)
    cells.densities = empty_array((int(counts.numpy()[-1]), 8), wp.float32, device)
    inputs = [links, density, skip, counts]
    launch(matter_cells.gather_densities, nx * ny, inputs, [cells.blocks, cells.densities], device=device, work=8 * nz)
    return cells
