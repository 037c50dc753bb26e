"""Views of Gaussian splats: project, sort, and draw them over each other in tiles."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arrays import WarpStruct
from ..core.devices import launch, resolve_device
from ..core.locks import device_turn, owner_lock
from ..field.rendering import picture_arrays
from ..kernels.splats import composite, composite_tiles, project, tiles
from ..lattice.capture import BufferPool
from ..view.camera import Camera, camera_struct
from ..view.frame import PART_NAMES, Frame, average_frame, finer_camera

#: A pixel ends where less than this share of the light is left.
STOP_TRANSMITTANCE = 1e-4

#: Variance that the image is blurred by, pixels squared: 3DGS, which scenes are fitted with.
IMAGE_BLUR = 0.3

#: Pixels along each side of a tile.
TILE_SIDE = composite_tiles.TILE_SIDE


class SplatRenderer:
    def __init__(self, device: wp.DeviceLike = None):
        self.device = resolve_device(device)
        self._lock = owner_lock(self.device)
        pool = BufferPool(self.device)
        self._view = pool.buffer(wp.vec4)
        self._depths, self._order = pool.buffer(wp.float32), pool.buffer(wp.int32)
        self._counts, self._ends = pool.buffer(wp.int64), pool.buffer(wp.int64)
        self._keys, self._members = pool.buffer(wp.int32), pool.buffer(wp.int32)
        self._starts = pool.buffer(wp.int32)
        self._total = wp.zeros(1, dtype=wp.int64, device="cpu", pinned=self.device.is_cuda)

    def render(
        self,
        splats: WarpStruct,
        camera: Camera,
        *,
        colour: ArrayLike = (0.0, 0.0, 0.0),
        origin: ArrayLike = (0.0, 0.0, 0.0),
        near: float = 0.01,
        supersampling: int = 1,
        antialias: bool = False,
        side: int = TILE_SIDE,
        variant="warps",
    ) -> Frame:
        fine = finer_camera(camera, supersampling)
        n = splats.centres.shape[0]
        device = self.device
        arrays = picture_arrays(fine.width * fine.height, PART_NAMES, device)
        lens = project.Lens()
        lens.camera = camera_struct(fine, origin)
        lens.near = near
        lens.blur = IMAGE_BLUR * supersampling**2
        lens.antialias = int(antialias)
        grid = tiles.TileGrid()
        grid.side = side
        grid.columns, grid.rows = -(-fine.width // side), -(-fine.height // side)
        grid.width, grid.height = fine.width, fine.height
        tile_count = grid.columns * grid.rows
        with self._lock:
            view = self._view.take(3 * n)
            depths, order = self._depths.take(2 * n), self._order.take(2 * n)
            launch(project.project_splats, n, [splats, lens], [view, depths, order], device=device, work=100)
            wp.utils.radix_sort_pairs(depths, order, n)
            counts, ends = self._counts.take(n), self._ends.take(n)
            launch(tiles.count_tiles, n, [view, depths, order, grid], [counts], device=device)
            wp.utils.array_scan(counts, ends)
            wp.copy(self._total, ends, src_offset=n - 1, count=1)
            if device.is_cuda:
                wp.synchronize_stream(device.stream)
            total = int(self._total.numpy()[0])
            keys, members = self._keys.take(2 * total), self._members.take(2 * total)
            launch(tiles.write_entries, n, [view, order, ends, grid, total], [keys, members], device=device)
            wp.utils.radix_sort_pairs(keys, members, total, 0, max(1, tile_count.bit_length()))
            starts = self._starts.take(tile_count + 1)
            launch(tiles.find_tile_starts, tile_count + 1, [keys, total], [starts], device=device)
            outputs = [arrays[name] for name in PART_NAMES]
            inputs = [view, members, starts, grid, wp.vec3(*map(float, colour)), STOP_TRANSMITTANCE]
            if device.is_cpu:
                launch(composite_tiles.composite_tiles, tile_count, inputs, outputs, device=device, work=20000)
            else:
                kernel = composite.composite_pixels if variant == "warps" else composite.composite_pixels_plain
                launch(kernel, tile_count * side * side, inputs, outputs, device=device)
        self.entries = total
        return average_frame(Frame(fine.width, fine.height, **arrays), supersampling)
