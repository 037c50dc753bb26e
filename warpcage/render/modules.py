"""Which modules of kernels poses and their frames launch, to be compiled and loaded side by side beforehand."""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType

import warp as wp

from ..core.modules import Kernel, load_modules
from ..field import tables
from ..kernels.core import texels
from ..kernels.edits import cell_tables, fine_cells, inverse, structs
from ..kernels.edits import nodes as map_cells
from ..kernels.field import columns, densities, rows
from ..kernels.field import occupancy as grid_skip
from ..kernels.lattice import (
    closed_form,
    corrections,
    crossings,
    cut_rows,
    distance,
    gaps,
    harmonic,
    harmonic_coarse,
    nodes,
    rings,
    side_values,
)
from ..kernels.mesh import fans
from ..kernels.render import march_cpu, shading
from ..kernels.render.views import part_kernel, stack_kernel, view_kernel
from ..kernels.view import tile_order

#: Modules of the kernels that every pose launches, and those of the solver of each kind of coordinates.
POSE_MODULES = (crossings, distance, nodes, rings, gaps, side_values, cell_tables, structs, grid_skip)

SOLVER_MODULES = {
    "harmonic": (harmonic, harmonic_coarse, cut_rows),
    "mean_value": (closed_form, fans, cut_rows, corrections),
    "green": (closed_form, fans, cut_rows),
}


def load_pose_modules(coordinates: str, others: Sequence[ModuleType | Kernel], device: wp.Device) -> None:
    """Compile and load the kernels of a pose side by side, with what frames need beside them."""
    load_modules([*POSE_MODULES, *SOLVER_MODULES[coordinates], *others], device)


def render_modules(device: wp.Device, edit_count: int = 1, has_fragments: bool = False) -> list[ModuleType | Kernel]:
    """What renders views, kernel files and variants; has_fragments: fragments go with one of the edits."""
    if has_fragments:
        return [stack_kernel(False)]
    several = [stack_kernel(True), stack_kernel(False)] if edit_count > 1 else []
    if device.is_cpu and tables.TILES_ON_CPU:
        return [march_cpu, columns, *several]
    march_modules = [fine_cells, map_cells, *several]
    kernel_of = part_kernel if several else view_kernel
    by_rows = [kernel_of(False, has_sides) for has_sides in (False, True)]
    if device.is_cpu and not tables.SHADES_ON_CPU:
        return [*march_modules, *by_rows]
    shaded = [kernel_of(True, has_sides) for has_sides in (False, True)]
    # poses that turn matter over are marched by rows, and no hand that moves a cage is to wait for a compiler
    frame_modules = [columns, densities, rows, texels, tile_order]
    return [*march_modules, inverse, shading, *shaded, *by_rows, *frame_modules]
