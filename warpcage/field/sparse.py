"""Buffers of a sparse voxel grid: rows for the nodes of a mask, and the distances by which a march skips."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from ..core.arrays import array_view, empty_array
from ..core.devices import HostFlag, RecordedLaunch, launch
from ..errors import InputError
from ..kernels.field import occupancy as grid_skip
from ..kernels.field import refine as grid_refine
from ..kernels.field.columns import BLOCK_NODES, Columns, find_rows, mark_blocks
from .io.field_file import BASIS_COUNT, LUMINANCE_NUMBERS, RGB_NUMBERS, as_single


class DensityWatch:
    """Whether densities on a CPU have changed since the last comparison; keeps a copy to compare with."""

    def __init__(self) -> None:
        self._kept: wp.array | None = None
        self.version = 0  # another number whenever any density is another one

    def has_changed(self, density: wp.array) -> bool:
        """Whether any bit of densities (rows,) float32 on a CPU is another one; True the first time.
        Keeps them as they are now."""
        kept, self._kept = self._kept, None  # an interrupt leaves none
        if kept is None or kept.size != density.size:
            kept, changed = wp.clone(density), True
        else:
            news, run = wp.zeros(1, dtype=wp.int32, device=density.device), int(grid_skip.COMPARED_VALUES)
            inputs = [density, kept, news]
            launch(grid_skip.note_densities, -(-density.size // run), inputs, device=density.device, work=run)
            changed = bool(news.numpy()[0])
        self.version += changed
        self._kept = kept
        return changed


#: Bytes behind those that marches read, as a GPU reads whole uint32s of them (kernels/core/loads.row_has_zero).
PADDING = 3


def checked_resolution(links: Any) -> tuple[int, ...]:
    """Nodes (nx, ny, nz) of a grid by its links, NumPy or Warp; at least two along each axis."""
    if not hasattr(links, "shape"):
        raise InputError(f"links must be an array (nx, ny, nz), got {type(links).__name__}")
    if len(links.shape) != 3 or min(links.shape) < 2:
        raise InputError(f"links must be (nx, ny, nz) with at least 2 along each axis, got {tuple(links.shape)}")
    return tuple(int(n) for n in links.shape)


def link_mask(mask: wp.array) -> tuple[wp.array, wp.array]:
    """Number the set nodes of a mask (nx, ny, nz) uint8 in memory order.
    Returns links (nx, ny, nz) int32, the row of each node or -1, and nodes (rows,) int32, flat indices."""
    counts, nodes = _numbered(mask)
    links = empty_array(mask.shape, wp.int32, mask.device)
    launch(grid_refine.link_nodes, counts.size, [mask, counts], [links, nodes], device=mask.device)
    return links, nodes


def mask_columns(mask: wp.array) -> tuple[Any, wp.array]:
    """As `link_mask`, of a cubic grid: Columns instead of links, which take fifteen times as much."""
    counts, nodes = _numbered(mask)
    columns: Any = Columns()
    columns.node_counts = wp.vec3i(*mask.shape)
    blocks = -(-(mask.shape[2] - 1) // int(BLOCK_NODES))
    columns.blocks = empty_array((counts.size, blocks), wp.vec2i, mask.device)
    launch(mark_blocks, counts.size, [mask, 1, counts], [columns.blocks, nodes, None], device=mask.device)
    return columns, nodes


def mask_nodes(mask: wp.array) -> wp.array:
    """(rows,) int32 flat indices of the set nodes of a mask (nx, ny, nz) uint8, in memory order."""
    counts, nodes = _numbered(mask)
    launch(grid_refine.link_nodes, counts.size, [mask, counts], [None, nodes], device=mask.device)
    return nodes


def _numbered(mask: wp.array) -> tuple[wp.array, wp.array]:
    """(nx * ny,) int32 set nodes of a mask up to the end of each line along the last axis, and room for all of them."""
    counts = running_counts(mask, 1, 255)
    return counts, empty_array(int(counts[-1:].numpy()[0]), wp.int32, mask.device)


def place_grid(grid: Any, bounds: np.ndarray) -> None:
    """Where the nodes of a VoxelGrid with `links` lie in bounds (2, 3), relative to their middle, and its skips."""
    extent = bounds[1] - bounds[0]
    voxel = extent / grid.links.shape
    grid.lower = wp.vec3(*(0.5 * voxel - 0.5 * extent))
    grid.voxel_size = wp.vec3(*voxel)
    grid.inverse_voxel_size = wp.vec3(*(1.0 / voxel))
    grid.skip = measure_skip(grid.links)


def gathered(values: wp.array, rows: wp.array) -> wp.array:
    """Those of values (n,) that stay, by their indices (rows,) int32."""
    kept = empty_array(rows.shape[0], values.dtype, rows.device)
    launch(grid_refine.gather_rows, rows.shape[0], [rows, values], [kept], device=rows.device)
    return kept


def column_rows(columns: Any, nodes: wp.array) -> wp.array:
    """(n,) int32 rows by Columns of nodes (n,), flat indices; -1 for those without."""
    rows = empty_array(nodes.shape[0], wp.int32, nodes.device)
    launch(find_rows, nodes.shape[0], [columns, nodes], [rows], device=nodes.device)
    return rows


def mask_count(mask: wp.array) -> int:
    """Number of set nodes of a mask (nx, ny, nz) uint8."""
    return int(running_counts(mask, 1, 255)[-1:].numpy()[0])


def running_counts(values: wp.array, least: int, most: int) -> wp.array:
    """(nx * ny,) int32 how many of values (nx, ny, nz), uint8 or int32, are from `least` to `most`, up to the end of a
    line along the last axis."""
    nx, ny, nz = values.shape
    counts = empty_array(nx * ny, wp.int32, values.device)
    inputs = [values, least, most]
    launch(grid_refine.count_lines, nx * ny, inputs, [counts], device=values.device, work=nz)
    wp.utils.array_scan(counts, counts, inclusive=True)
    return counts


def held_nodes(columns: Any) -> np.ndarray:
    """(nx, ny, nz) bool, which nodes have rows by Columns."""
    nx, ny, nz = (int(n) for n in columns.node_counts)
    bits = np.unpackbits(columns.blocks.numpy()[..., :1].view(np.uint8), axis=-1, bitorder="little").astype(bool)
    # each block has the first node of the next one too
    width = bits.shape[1]
    nodes = np.concatenate([bits[..., : int(BLOCK_NODES)].reshape(nx * ny, -1), bits[:, width - 1, -1:]], axis=1)
    return nodes[:, :nz].reshape(nx, ny, nz)


def measure_skip(rows: Any) -> wp.array:
    """Chebyshev distance (nx-1, ny-1, nz-1) uint8 of each cell from the nearest cell with a row at a node, in cells.
    rows: links (nx, ny, nz) int32, or Columns."""
    is_links = isinstance(rows, wp.array)
    counts, device = (rows.shape, rows.device) if is_links else (rows.node_counts, rows.blocks.device)
    distance, spread = (empty_array(tuple(int(n) - 1 for n in counts), wp.uint8, device) for _ in range(2))
    kernel = grid_skip.mark_cells if is_links else grid_skip.mark_column_cells
    launch(kernel, distance.size, [rows], [distance], device=device)
    return _spread(distance, spread)


class MatterSkip:
    """How far each cell is from the nearest in which there is any matter, for the densities as they are."""

    # Rows reach further than matter: marches that know this look at half as many samples. Densities may change at any
    # time, by a fit or a caller: what this holds depends on their signs alone, compared at each call.

    def __init__(self, shape: tuple[int, ...], device: wp.DeviceLike):
        self._shape, self._device = shape, wp.get_device(device)  # (nx-1, ny-1, nz-1) cells
        self._positive: wp.array | None = None
        self._distance: wp.array | None = None
        self._changed: HostFlag | None = None
        self._note_signs = RecordedLaunch(grid_skip.note_signs, self._device)
        self._is_compared = False
        # signs need not be noted where no density has changed
        self._watch = DensityWatch() if self._device.is_cpu else None
        self._noted = 0

    def compare(self, density: wp.array) -> None:
        """Launch the comparison of densities (rows,) float32, before the ReLU, that `distance` asks for.
        What is launched in between has the device at work while the host waits."""
        self._settle()  # a result that no call has taken
        device = self._device
        if self._positive is None or self._positive.size != density.size:
            self._positive, self._distance = wp.zeros(density.size, dtype=wp.uint8, device=device), None
        if self._changed is None:  # a fit never asks
            self._changed = HostFlag(device)
        self._changed.clear()
        self._is_compared = True
        if self._watch is None or self._watch.has_changed(density) or self._noted != self._watch.version:
            self._note_signs(density.size, [density], [self._positive, self._changed.array])
            self._noted = self.version
        self._changed.send()

    @property
    def version(self) -> int:
        """Of the densities that were compared last, on a CPU: another number whenever any of them is another one."""
        return 0 if self._watch is None else self._watch.version

    def distance(self, density: wp.array, columns: Any) -> wp.array:
        """(nx-1, ny-1, nz-1) uint8 distance in cells, 0 where a corner has a density above zero; a new array when any
        changes. density: that of the last `compare`, if no call has asked since; columns: those of the grid's rows."""
        if not self._is_compared:
            self.compare(density)
        self._settle()
        if self._distance is None:
            shape, device = self._shape, self._device
            held = (empty_array(math.prod(shape) + PADDING, wp.uint8, device) for _ in range(2))
            distance, spread = (array_view(each, wp.uint8, shape) for each in held)
            launch(grid_skip.mark_matter, distance.size, [columns, density], [distance], device=device)
            self._distance = _spread(distance, spread)
        return self._distance

    def _settle(self) -> None:
        """Forget distances of other signs than were found."""
        if self._is_compared and self._changed is not None and self._changed.wait():
            self._distance = None
        self._is_compared = False


def _spread(distance: wp.array, spread: wp.array) -> wp.array:
    """Distances from the cells that hold 0, in one of two arrays; both are used."""
    for axis in range(3):
        spread_along(axis, distance, spread)
        distance, spread = spread, distance
    return distance


def spread_along(axis: int, source: wp.array, target: wp.array, repeated: Callable[..., None] | None = None) -> None:
    """One pass of the transform that spreads distances (nx, ny, nz) uint8; one along each axis makes them Chebyshev's.
    repeated: a RecordedLaunches, for what is spread again and again."""
    device = wp.get_device(source.device)
    run = repeated or functools.partial(launch, device=device)
    if device.is_cpu:  # a line at a time, many cells of it at once
        nx, ny, nz = source.shape
        run(grid_skip.spread_lines, nx * ny, [axis, source], [target], work=nz)
    else:
        run(grid_skip.spread_distance, source.size, [axis, source], [target])


def values_on_device(array: np.ndarray | wp.array, dtype: Any, device: wp.Device) -> Any:
    """A Warp array of a data type on a device; the same one if it is there already."""
    if isinstance(array, wp.array):
        return array if array.device == device else array.to(device)
    host = np.ascontiguousarray(array, dtype=np.int32 if dtype == wp.int32 else np.float32)
    return wp.array(host, dtype=dtype, device=device)


def harmonics_on_device(sh: np.ndarray | wp.array, device: wp.Device) -> Any:
    """Harmonics as kernels take them, (rows, 27) or (rows, 24) float32, or float16 on CUDA where they are halves.
    NumPy ones are (rows, 9, 3) or (rows, 24)."""
    if isinstance(sh, wp.array) and sh.dtype == wp.float16 and device.is_cpu:
        return wp.array(as_single(sh.numpy()), dtype=wp.float32, device=device)
    if isinstance(sh, wp.array):
        array = values_on_device(sh, wp.float32, device)  # without gaps: rows are read as runs of memory
        if array.ndim != 2 or array.shape[1] not in (LUMINANCE_NUMBERS, RGB_NUMBERS):
            raise InputError(f"sh on a device must be (rows, 24) or (rows, 27) numbers, got {array.shape}")
        return array if array.is_contiguous else array.contiguous()
    host = np.asarray(sh)
    if host.ndim == 3 and host.shape[1:] == (BASIS_COUNT, 3):
        host = host.transpose(0, 2, 1).reshape(len(host), RGB_NUMBERS)
    elif host.ndim != 2 or host.shape[1] != LUMINANCE_NUMBERS:
        raise InputError(f"sh must be (rows, 9, 3) or (rows, 24), got {host.shape}")
    if host.dtype == np.float16 and device.is_cuda:
        return wp.array(np.ascontiguousarray(host), dtype=wp.float16, device=device)
    if host.dtype == np.float16:
        host = as_single(host)
    return wp.array(np.ascontiguousarray(host, np.float32), dtype=wp.float32, device=device)


def store_harmonics(grid: Any, sh: wp.array) -> None:
    """Let a VoxelGrid hold harmonics (rows, 27) or (rows, 24), float32 or float16."""
    is_half = sh.dtype == wp.float16
    grid.halves = sh if is_half else None
    grid.sh = empty_array((0, sh.shape[1]), wp.float32, sh.device) if is_half else sh


def stored_harmonics(grid: Any) -> wp.array:
    """(rows, 27) or (rows, 24) harmonics of a VoxelGrid, float32 or float16."""
    return grid.sh if grid.halves is None else grid.halves


def widen_harmonics(grid: Any) -> None:
    """Let a VoxelGrid whose harmonics are halves hold them as float32."""
    halves = grid.halves
    singles = empty_array(halves.shape, wp.float32, halves.device)
    launch(grid_refine.widen_rows, halves.size // int(grid_refine.RUN), [halves], [singles], device=halves.device)
    store_harmonics(grid, singles)


def harmonics_on_host(sh: wp.array) -> np.ndarray:
    """Harmonics (rows, 27) or (rows, 24) as files and callers have them: NumPy (rows, 9, 3) or (rows, 24) float32."""
    host: np.ndarray = sh.numpy() if sh.dtype == wp.float32 else as_single(sh.numpy())
    return host if sh.shape[1] == LUMINANCE_NUMBERS else host.reshape(-1, 3, BASIS_COUNT).transpose(0, 2, 1)
