"""The tables that marches read of a field: rows, colours and matter cells, kept from frame to frame."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import warp as wp

from ..core.arrays import empty_array
from ..core.devices import RecordedLaunch, SpareMemory, launch
from ..core.modules import Kernel
from ..core.threads import owner_lock
from ..kernels.field import columns, occupancy
from ..kernels.field.colors import ShadedGrid, shade_rows
from ..kernels.field.densities import lay_densities
from ..kernels.field.grid import VoxelGrid
from ..kernels.field.march import image_kernel
from ..kernels.field.march_cpu import render_tiles
from ..kernels.field.rows import RowTable, pack_rows
from ..kernels.view.rays import TILE_SIZE
from ..view.camera import camera_struct
from ..view.frame import PART_NAMES, Frame
from .bricks import ColorBricks
from .io.field_file import MAX_VOXELS
from .render import STOP_TRANSMITTANCE, FieldView
from .sparse import MatterSkip, measure_skip, running_counts, store_harmonics, stored_harmonics


class MatterCellTable:
    """The densities of a grid by cells on a CPU, see kernels/field/occupancy."""

    def __init__(self) -> None:
        self._made: tuple[wp.array, int] | None = None  # from which skip, and which version of the densities
        self._cells: Any = None

    def cells(self, links: wp.array, density: wp.array, skip: wp.array, version: int) -> Any:
        """The table, a MatterCells, of densities (rows,) float32, before the ReLU; made anew where it is of other ones.
        links: (nx, ny, nz) int32; skip: of MatterSkip for these densities; version: theirs, see DensityWatch."""
        if self._made is None or self._made[0] is not skip or self._made[1] != version:
            self._made = None  # an interrupt leaves none
            self._cells = gathered_cells(links, density, skip)
            self._made = skip, version
        return self._cells


def gathered_cells(links: wp.array, density: wp.array, skip: wp.array) -> Any:
    """A MatterCells of densities (rows,) float32 at links (nx, ny, nz); skip: 0 in the cells that hold matter."""
    device, (nx, ny, nz) = links.device, skip.shape
    counts = running_counts(skip, 0, 0)
    cells = occupancy.MatterCells()
    cells.blocks = empty_array((nx * ny, -(-nz // int(occupancy.BLOCK_CELLS))), wp.vec2i, device)
    cells.densities = empty_array((int(counts.numpy()[-1]), 8), wp.float32, device)
    inputs = [links, density, skip, counts]
    launch(occupancy.gather_densities, nx * ny, inputs, [cells.blocks, cells.densities], device=device, work=8 * nz)
    return cells


#: uint32 values of a packed row (kernels/field/rows), and of its colour (kernels/field/colors) on CUDA and on a CPU.
PACKED_UINT32S = 8
CUDA_COLOR_UINT32S, CPU_COLOR_UINT32S = 2, 4

#: Rows that work together on CUDA.
WARP_LANES = 32


class ColumnTable:
    """The rows of a grid as bits, see kernels/field/columns; links (nx, ny, nz) int32, row of each node or -1."""

    def __init__(self, links: wp.array):
        device = links.device
        column_count = links.shape[0] * links.shape[1]
        counts = running_counts(links, 0, MAX_VOXELS)
        row_count = int(counts[-1:].numpy()[0])
        self.nodes = empty_array(row_count, wp.int32, device)  # flat index of each row's node
        order = empty_array(row_count, wp.int32, device)
        block_count = -(-(links.shape[2] - 1) // int(columns.BLOCK_NODES))
        self.columns = columns.Columns()
        self.columns.node_counts = wp.vec3i(*links.shape)
        self.columns.blocks = empty_array((column_count, block_count), wp.vec2i, device)
        launch(
            columns.mark_blocks,
            column_count,
            [links, 0, counts],
            [self.columns.blocks, self.nodes, order],
            device=device,
            work=links.shape[2],
        )
        unsorted = wp.zeros(1, dtype=wp.int32, device=device)
        launch(columns.find_unsorted, row_count, [order], [unsorted], device=device)
        if unsorted.numpy()[0]:
            self.columns.order = order
        self.node_count, self._laid, self._packed = math.prod(links.shape), None, None
        self._device = wp.get_device(device)
        self._kept: dict[str, tuple[int, Any]] = {}
        self._shaded: Any = None
        self._texture_bricks = 0
        self.shade_rows = RecordedLaunch(shade_rows, device)  # launches the kernel of that name

    def links(self) -> wp.array:
        """(nx, ny, nz) int32 row of each node, or -1: a new array."""
        shape = tuple(self.columns.node_counts)
        links = wp.full(shape, -1, dtype=wp.int32, device=self._device)
        inputs = [self.nodes, self.columns.order]
        launch(columns.link_rows, self.nodes.size, inputs, [links.flatten()], device=self._device)
        return links

    def laid_densities(self) -> wp.array:
        """(nodes,) float16, one for each node of the grid, made when it is first asked for; 0 without a row."""
        if self._laid is None:
            self._laid = empty_array(self.node_count, wp.float16, self.nodes.device)
            self._laid.zero_()
        return self._laid

    def row_colors(self) -> wp.array:
        """(rows, 4) uint32 on a CPU, else (rows, 2), for the colours of rows, not set yet."""
        # Of the frame before on a CUDA stream, whose frames follow each other: allocating memory takes longer than
        # filling it. A new one for other streams, and on a CPU, whose threads may render at a time.
        shape = self.nodes.shape[0], CPU_COLOR_UINT32S if self._device.is_cpu else CUDA_COLOR_UINT32S
        return self._of_stream("rows", lambda: empty_array(shape, wp.uint32, self._device))

    def shaded(self, center: wp.vec3, step: float) -> Any:
        """A ShadedGrid of kernels/field/colors that is to be filled for a camera, centre relative to the grid's origin.
        On CUDA the same for all cameras, whose frames take turns."""
        shaded = self._shaded
        if shaded is None:
            shaded = ShadedGrid()
            shaded.columns = self.columns
            if self._device.is_cuda:
                self._shaded = shaded
        shaded.center, shaded.step = center, step
        return shaded

    @functools.cached_property
    def color_bricks(self) -> ColorBricks:
        """The bricks of the grid that hold colours of posed frames."""
        return ColorBricks(tuple(self.columns.node_counts), self.nodes)

    def color_texture(self) -> wp.Texture3D:
        """A texture of four halves a node of `color_bricks`, on CUDA for colours at the nodes of rows; 0 at others.
        Kept as `row_colors` is."""
        bricks = self.color_bricks
        if bricks.count != self._texture_bricks:
            self._kept.pop("bricks", None)
            self._texture_bricks = bricks.count
        return self._of_stream("bricks", bricks.new_texture)

    def _of_stream(self, name: str, make: Callable[[], Any]) -> Any:
        """What the frames of the stream that asked first keep; made anew for others."""
        if self._device.is_cpu:
            return make()
        stream = int(self._device.stream.cuda_stream or 0)
        if name not in self._kept:
            self._kept[name] = stream, make()
        owner, kept = self._kept[name]
        return kept if owner == stream else make()

    def packed_rows(self) -> wp.array:
        """(rows, PACKED_UINT32S) uint32, made when it is first asked for."""
        # Kept: CUDA allocates memory slower than it fills it. Frames on several streams write the same into it.
        if self._packed is None:
            self._packed = empty_array((self.nodes.shape[0], PACKED_UINT32S), wp.uint32, self.nodes.device)
        return self._packed


def whole_warps(rows: int, device: wp.Device) -> int:
    """Threads of a kernel whose rows work together: rounded up on CUDA."""
    return rows if device.is_cpu else -(-rows // WARP_LANES) * WARP_LANES


def row_table(grid: Any, table: ColumnTable, *, with_colors: bool = True) -> Any:
    """The rows of a grid as a march reads them: a RowTable of the values that the grid has now."""
    device, rows = wp.get_device(table.nodes.device), table.nodes.shape[0]
    result = RowTable()
    result.columns, result.unit = table.columns, 1.0 / min(grid.voxel_size)
    if not device.is_cpu:
        result.laid = table.laid_densities()
        inputs = [grid.density, table.columns.order, table.nodes, 1.0 / result.unit]
        launch(lay_densities, rows, inputs, [result.laid], device=device)
    if not device.is_cpu and with_colors:
        result.packed = table.packed_rows()
        launch(pack_rows, whole_warps(rows, device), [grid, table.columns], [result.packed], device=device)
    return result


def shaded_grid(grid: Any, table: ColumnTable, center: wp.vec3, step: float) -> Any:
    """The rows of a grid as a camera sees them: a ShadedGrid of the values that the grid has now.
    center: of the camera, relative to the grid's origin; step: world units."""
    shaded = table.shaded(center, step)
    colors = table.row_colors()
    if shaded.colors is not colors:
        shaded.colors = colors
    table.shade_rows(whole_warps(table.nodes.shape[0], wp.get_device(table.nodes.device)), [grid, table.nodes, shaded])
    return shaded


#: Voxels are shaded for a camera at least this many voxels away: nearer ones are seen under too many directions.
NEAR_VOXELS = 16.0

#: Whether that is done on a CPU too, where rays are few, and bands of a picture would each shade all voxels.
SHADED_ON_CPU = False

#: Whether a CPU marches the rays of a tile side by side, and not one by one as CUDA does.
TILES_ON_CPU = True


class MarchTables:
    """What marches read of a grid instead of its own arrays.
    Values are read anew for each frame; what is kept depends on links and densities' signs, compared at each frame."""

    def __init__(self, grid: Any):
        self._grid, self._device = grid, wp.get_device(grid.links.device)
        self._columns: ColumnTable | None = None
        self._marched: Any = None
        self._launches: dict[Kernel, RecordedLaunch] = {}
        self._matter = MatterSkip(tuple(n - 1 for n in grid.links.shape), self._device)
        self._cells = MatterCellTable()
        size, lower = np.array(grid.voxel_size), np.array(grid.lower)
        self._box = lower.tolist(), (lower + size * (np.array(grid.links.shape) - 1)).tolist()
        self._longest = float(size.max())
        self.spare = SpareMemory(self._device)  # of frames
        self._lock = owner_lock(self._device)  # threads may share a field

    @property
    def columns(self) -> ColumnTable:
        """The rows as bits, made at the first use."""
        with self._lock:
            if self._columns is None:
                self._columns = ColumnTable(self._grid.links)
            return self._columns

    def drop_links(self) -> None:
        """Let the grid have no links, nor the distances that go with them: frames read neither."""
        self._columns = ColumnTable(self._grid.links)
        self._grid.links = self._grid.skip = None

    def restore_links(self) -> None:
        """Let the grid have its links, and distances to the nearest cell that has any, where it has none."""
        if self._grid.links is None:
            self._grid.links = self.columns.links()
            self._grid.skip = measure_skip(self._grid.links)

    def begin(self) -> None:
        """Start on what `grid` waits for; launch what does not need it in between."""
        with self._lock:
            self._matter.compare(self._grid.density)

    @property
    def marched(self) -> Any:
        """The VoxelGrid as `grid` returned it last: for views that follow it with the same densities."""
        return self._marched

    def grid(self) -> Any:
        """The VoxelGrid, with a `skip` that leaves out what holds no matter now."""
        own, harmonics = self._grid, stored_harmonics(self._grid)
        with self._lock:
            skip, grid = self._matter.distance(own.density, self.columns.columns), self._marched
            if (
                grid is None
                or grid.skip is not skip
                or grid.links is not own.links
                or grid.density is not own.density
                or stored_harmonics(grid) is not harmonics
            ):
                self._marched = grid = VoxelGrid()
                grid.lower, grid.voxel_size, grid.inverse_voxel_size = own.lower, own.voxel_size, own.inverse_voxel_size
                grid.links, grid.density, grid.skip = own.links, own.density, skip
                store_harmonics(grid, harmonics)
        return grid

    def rows(self) -> Any:
        """The rows as they are now: a RowTable of kernels/field/rows.py."""
        return row_table(self._grid, self.columns)

    def densities(self) -> Any:
        """The same without colours."""
        return row_table(self._grid, self.columns, with_colors=False)

    def render(self, view: FieldView) -> Frame:
        """The frame of a view of the grid."""
        kernel, inputs, rays = self._image_kernel(view.center, view.step)
        pinhole, color = camera_struct(view.rays, view.field.center), wp.vec3(*map(float, view.color))
        arrays = view.new_arrays()
        ends = [pinhole, color, view.step, STOP_TRANSMITTANCE, *(arrays[name] for name in PART_NAMES)]
        if kernel not in self._launches:
            self._launches[kernel] = RecordedLaunch(kernel, self._device)
        run = self._launches[kernel]
        run(view.threads // rays, [*inputs, *ends], transient=len(ends), work=rays * view.work)
        return view.finished(arrays)

    def _image_kernel(self, center: wp.vec3, step: float) -> tuple[Kernel, list[Any], int]:
        """A kernel that renders views of the grid, its first inputs, and the rays that one of its items follows.
        center: of the camera, relative to the grid's origin; step: world units."""
        self.begin()
        if self.is_shaded(center):
            shaded = shaded_grid(self._grid, self.columns, center, step)
            return image_kernel(True), [self.grid(), shaded], 1
        rows = self.rows()
        if self.by_tiles:
            grid = self.grid()
            return render_tiles, [grid, rows, self.cells(grid)], TILE_SIZE
        return image_kernel(False), [self.grid(), rows], 1

    @property
    def by_tiles(self) -> bool:
        """Whether kernels for the rays of a tile render views."""
        return self._device.is_cpu and TILES_ON_CPU

    def cells(self, grid: Any) -> Any:
        """The densities by cells, on a CPU: a MatterCells; grid: what `grid()` returned."""
        with self._lock:
            return self._cells.cells(grid.links, grid.density, grid.skip, self._matter.version)

    def is_shaded(self, center: wp.vec3, others: Sequence[Sequence[Sequence[float]]] = ()) -> bool:
        """Whether voxels are shaded for a camera: where none is near it, nor to others: boxes (2, 3) they are moved
        into. centre: of the camera, relative to the grid's origin, as boxes are."""
        if self._device.is_cpu and not SHADED_ON_CPU:
            return False
        near, place = NEAR_VOXELS * self._longest, (center[0], center[1], center[2])
        return all(box_distance(lower, upper, place) > near for lower, upper in (self._box, *others))


def box_distance(lower: Sequence[float], upper: Sequence[float], point: Any) -> float:
    """How far a point (3,) is from a box; 0 within."""
    return math.hypot(*(max(low - x, x - high, 0.0) for low, x, high in zip(lower, point, upper, strict=True)))
