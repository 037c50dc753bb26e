"""Pictures of splats that say how each splat's values would change them."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ..core.devices import launch
from ..kernels.splats import composite_slopes, composite_slopes_tiles, project_slopes, tiles
from ..kernels.splats.composite_slopes import SUMS
from ..lattice.buffers import BufferPool
from ..view.camera import Camera
from .parameters import SplatParameters
from .rendering import DRAW_WORK, MOST_ENTRIES, PROJECT_WORK, STOP_TRANSMITTANCE, SplatRenderer, tile_grid

#: Sums of a splat on the host.
SUM_COUNT = int(SUMS)


class SplatGradients(SplatRenderer):
    """Draws splats, and takes the slopes of a loss by the picture back to their values."""

    # Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering" (SIGGRAPH 2023), appendix A.

    def __init__(self, device: wp.DeviceLike = None):
        super().__init__(device)
        pool = BufferPool(self.device)
        self._sums, self._entry_sums = pool.buffer(wp.float32), pool.buffer(wp.float32)
        self._tiles, self._sources = pool.buffer(wp.int32), pool.buffer(wp.int32)
        self._rgb, self._parts = pool.buffer(wp.vec3), pool.buffer(wp.float32)
        self._drawn: tuple[Any, ...] = ()

    def draw(self, parameters: SplatParameters, camera: Camera, lens: Any, colour: wp.vec3) -> wp.array:
        """The picture (h * w,) vec3, one ray a pixel, valid until the next one; `parameters` are refreshed before.
        lens: of `splat_lens`, of the same camera; colour: behind the splats."""
        grid, pixels = tile_grid(camera), camera.width * camera.height
        seen = self._project(parameters.splats, lens)
        total = self.entry_count = self._count(grid, *seen)
        if total > MOST_ENTRIES:
            raise ValueError(f"splats touch {total} tiles of a picture, at most {MOST_ENTRIES}: fit smaller pictures")
        keys, members = self._write(grid, total, seen)
        sources = self._write_sources(grid, total, keys) if self.device.is_cpu else None
        starts = self._sort(grid, total, keys, members)
        rgb, parts = self._rgb.take(pixels), self._parts.take((2, pixels))
        inputs = [seen[1], members, starts, grid]
        self._composite(grid, [*inputs, colour, STOP_TRANSMITTANCE], [rgb, parts[0], parts[1]])
        self._drawn = parameters, lens, grid, seen, inputs, sources, total, rgb
        return rgb

    def take_back(self, slopes: wp.array) -> None:
        """Set the slopes of the parameters drawn last, from those (h * w,) vec3 of a loss by the picture's colours."""
        parameters, lens, grid, seen, inputs, sources, total, rgb = self._drawn
        count, view, _, order = seen
        sums = self._sums.take(SUM_COUNT * count)
        inputs = [*inputs, STOP_TRANSMITTANCE, rgb, slopes]
        tile_count = grid.columns * grid.rows
        if self.device.is_cpu:
            rows = self._entry_sums.take(SUM_COUNT * total)
            inputs.insert(2, sources)
            kernel = composite_slopes_tiles.sum_slopes_of_tiles
            launch(kernel, tile_count, inputs, [rows], device=self.device, work=DRAW_WORK)
            kernel, inputs = composite_slopes_tiles.sum_slopes_of_splats, [order, self._ends.take(count), rows]
            launch(kernel, count, inputs, [sums], device=self.device)
        else:
            sums.zero_()
            items = tile_count * tiles.TILE_SIDE**2
            launch(composite_slopes.add_slopes, items, inputs, [sums], device=self.device)
        held = [parameters.by_rows(name, parameters.values) for name in ("log_scales", "quaternions")]
        inputs = [parameters.splats, lens, *held, view, sums]
        outputs = [parameters.value_slopes]
        kernel = project_slopes.find_value_slopes
        launch(kernel, count, inputs, outputs, device=self.device, work=2 * PROJECT_WORK)

    def _write_sources(self, grid: Any, total: int, keys: wp.array) -> wp.array:
        """The place before they were sorted of entries that are sorted by tile."""
        held, sources = self._tiles.take(2 * total), self._sources.take(2 * total)
        wp.copy(held, keys, count=total)
        wp.copy(sources, wp.array(np.arange(total, dtype=np.int32), device=self.device), count=total)
        wp.utils.radix_sort_pairs(held, sources, total, 0, (grid.columns * grid.rows).bit_length())
        return sources
