"""Views of Gaussian splats: project them, sort them by depth and tile, and draw them over each other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arrays import WarpStruct
from ..core.devices import SpareMemory, launch, resolve_device
from ..core.modules import Kernel
from ..core.threads import owner_lock
from ..errors import InputError
from ..field.render import DEFAULT_OPTIONS, NEW_TARGET, RenderOptions, RenderTarget, View
from ..kernels.splats import composite, composite_cpu, project, tiles
from ..lattice.buffers import BufferPool
from ..view.camera import Camera, camera_struct
from ..view.frame import PART_NAMES, Frame

#: A pixel ends where less than this share of the light is left.
STOP_TRANSMITTANCE = 1e-4

#: Variance by which pictures are blurred, pixels squared: what scenes of 3DGS are fitted with.
IMAGE_BLUR = 0.3

#: Splats nearer than this share of the median distance from the middle of a field are not drawn.
NEAR_SHARE = 0.01

#: Entries of splats in tiles that are sorted at once. Pictures that have more are drawn in bands.
MAX_ENTRIES = 1 << 26

#: Threads that write the entries of a splat on CUDA.
OCTET = 8

#: Steps that a splat takes to be projected and a tile to be drawn, for launches on the CPU.
PROJECT_WORK, DRAW_WORK = 100, 20_000


class SplatRenderer:
    """Draws splats on a device, in buffers that are kept and grow."""

    # The host waits once a CUDA frame, for the number of tiles touched. Kerbl et al., "3D Gaussian Splatting for
    # Real-Time Radiance Field Rendering" (SIGGRAPH 2023); tiles of ellipses: Hanson et al., "Speedy-Splat" (CVPR 2025).

    def __init__(self, device: wp.DeviceLike = None):
        self.device = resolve_device(device)
        self.entry_count = 0  # Tiles that splats touched in the last frame, summed over the splats.
        self._lock = owner_lock(self.device)
        pool = BufferPool(self.device)
        self._view = pool.buffer(wp.vec4)
        self._depths, self._order = pool.buffer(wp.float32), pool.buffer(wp.int32)
        self._counts, self._ends = pool.buffer(wp.int64), pool.buffer(wp.int64)
        self._keys, self._members = pool.buffer(wp.int32), pool.buffer(wp.int32)
        self._starts = pool.buffer(wp.int32)
        self._spare = SpareMemory(self.device)
        self._total = wp.zeros(1, dtype=wp.int64, device="cpu", pinned=self.device.is_cuda)

    def render(
        self,
        splats: WarpStruct,
        camera: Camera,
        *,
        color: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),  # (3,) behind the splats, in [0, 1]
        origin: ArrayLike = (0.0, 0.0, 0.0),  # (3,) world point that the splats' centres are relative to
        near: float = 0.0,  # splats whose centre is less than this before the camera are left out, world units
        antialias: bool = False,  # the blur adds no matter (Mip-Splatting), where the options leave that open
        options: RenderOptions = DEFAULT_OPTIONS,
        target: RenderTarget = NEW_TARGET,
    ) -> Frame:
        """The view of a camera, its arrays on the device; splats: a Splats of kernels/splats/splats.py."""
        view = View(camera, options, options.color(np.asarray(color, np.float32)), 1, self.device, target)
        view.spare = self._spare
        antialias = antialias if options.antialias is None else bool(options.antialias)
        blur = IMAGE_BLUR * view.side**2  # as with one ray a pixel
        lens = splat_lens(view.rays, origin, near, blur, antialias)
        with self._lock:
            arrays = view.new_arrays()
            seen = self._project(splats, lens, splats.centers.shape[0])
            self.entry_count = 0
            inputs = [wp.vec3(*map(float, view.color)), STOP_TRANSMITTANCE]
            grid = tile_grid(view.rays.width, view.rays.height)
            self._draw(grid, seen, inputs, [arrays[name] for name in PART_NAMES])
            return view.finished(arrays)

    def _project(
        self, splats: WarpStruct, lens: Any, count: int, kernel: Kernel = project.project_splats
    ) -> tuple[int, wp.array, wp.array, wp.array]:
        """Number of the first splats, their view, sorted depths, and order; lens: as the kernel takes it."""
        view = self._view.take(3 * count)
        depths, order = self._depths.take(2 * count), self._order.take(2 * count)
        outputs = [view, depths, order]
        launch(kernel, count, [splats, lens], outputs, device=self.device, work=PROJECT_WORK)
        wp.utils.radix_sort_pairs(depths, order, count)
        return count, view, depths, order

    def _draw(self, grid: Any, seen: tuple, inputs: list, outputs: list) -> None:
        """Draw the rows of tiles of a grid, in halves where they have too many entries."""
        total = self._count(grid, *seen)
        if total > MAX_ENTRIES and grid.rows > 1:
            half = grid.rows // 2
            self._draw(_band(grid, 0, half), seen, inputs, outputs)
            self._draw(_band(grid, half, grid.rows - half), seen, inputs, outputs)
            return
        if total > 1 << 30:
            raise InputError(f"{total} splats in a row of tiles are more than can be sorted: draw a smaller picture")
        self.entry_count += total
        keys, members = self._write(grid, total, seen)
        starts = self._sort(grid, total, keys, members)
        self._composite(grid, [seen[1], members, starts, grid, *inputs], outputs)

    def _write(self, grid: Any, total: int, seen: tuple) -> tuple[wp.array, wp.array]:
        """Tiles and splats of the entries that were counted, in the order of depth."""
        count, view, _, order = seen
        keys, members = self._keys.take(2 * total), self._members.take(2 * total)
        ends = self._ends.take(count)
        inputs = [view, order, ends, grid, total]
        items = count * (1 if self.device.is_cpu else OCTET) if total else 0
        launch(tiles.write_entries, items, inputs, [keys, members], device=self.device)
        return keys, members

    def _sort(self, grid: Any, total: int, keys: wp.array, members: wp.array) -> wp.array:
        """Sort entries by tile; returns where those of each tile begin."""
        count = tile_count(grid)
        wp.utils.radix_sort_pairs(keys, members, total, 0, count.bit_length())
        starts = self._starts.take(count + 1)
        launch(tiles.find_tile_starts, count + 1, [keys, total], [starts], device=self.device)
        return starts

    def _composite(self, grid: Any, inputs: list, outputs: list) -> None:
        """Draw the tiles of a grid."""
        kernel, items = composite_cpu.composite_tiles, tile_count(grid)
        if self.device.is_cuda:
            kernel, items = composite.composite_pixels, items * tiles.TILE_SIDE**2
        launch(kernel, items, inputs, outputs, device=self.device, work=DRAW_WORK)

    def _count(self, grid: Any, count: int, view: wp.array, depths: wp.array, order: wp.array) -> int:
        """Find how many tiles of a grid the splats touch; the running sums are left in `_ends`."""
        if count == 0:
            return 0
        counts, ends = self._counts.take(count), self._ends.take(count)
        launch(tiles.count_tiles, count, [view, depths, order, grid], [counts], device=self.device)
        wp.utils.array_scan(counts, ends)
        wp.copy(self._total, ends, src_offset=count - 1, count=1)
        if self.device.is_cuda:
            wp.synchronize_stream(self.device.stream)
        return int(self._total.numpy()[0])


def near_distance(centers: np.ndarray) -> float:
    """How near a camera draws the splats of a field with centres (n, 3), world units; 0 for fewer than two places."""
    if not len(centers):
        return 0.0
    places = np.asarray(centers, np.float64)
    # Those nearer would fill the picture with one flat colour.
    return NEAR_SHARE * float(np.median(np.linalg.norm(places - np.median(places, axis=0), axis=1)))


def splat_lens(camera: Camera, origin: ArrayLike, near: float, blur: float, antialias: bool) -> Any:
    """How a camera draws splats: a Lens of kernels/splats/project.py; antialias: the blur adds no matter. origin: (3,)
    world point that centres are relative to; near: world units; blur: variance on the image, pixels squared."""
    lens = project.Lens()
    lens.camera = camera_struct(camera, origin)
    lens.near, lens.blur, lens.antialias = near, blur, int(antialias)
    return lens


def tile_grid(width: int, height: int, views: int = 1, splats: int = 0) -> Any:
    """The tiles of a picture, or of several of so many splats each: a TileGrid of kernels/splats/tiles.py."""
    grid = tiles.TileGrid()
    grid.columns, grid.rows = -(-width // tiles.TILE_SIDE), -(-height // tiles.TILE_SIDE)
    grid.width, grid.height, grid.views, grid.splats = width, height, views, splats
    return grid


def tile_count(grid: Any) -> int:
    """Tiles of all pictures of a grid."""
    return grid.columns * grid.rows * grid.views


def _band(grid: Any, first_row: int, rows: int) -> Any:
    """Some rows of tiles of a grid."""
    band = tiles.TileGrid()
    band.columns, band.width, band.height, band.views = grid.columns, grid.width, grid.height, grid.views
    band.splats = grid.splats
    band.first_row, band.rows = grid.first_row + first_row, rows
    return band
