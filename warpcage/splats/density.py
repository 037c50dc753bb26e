"""The matter of splats as densities on a grid: for cages, selections and walls."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arrays import empty_array
from ..core.checks import checked_bounds, checked_whole
from ..core.devices import launch
from ..core.memory import require_memory
from ..kernels.splats.density import deposit_splats
from .files.contents import LEAST_OPACITY

if TYPE_CHECKING:
    from .splat_field import SplatField

#: Nodes along the longest side of a grid where nobody asks for another number, and at most.
RESOLUTION, MOST_RESOLUTION = 128, 1024


class SplatDensity:
    """Densities of splats at the nodes of a grid: what `Cage.from_field`, `select_nodes` and `extract_mesh` read.
    resolution: nodes along the longest side, 2 to 1024; bounds: (2, 3) box, world units, None is that of all splats."""

    # Node (i, j, k) lies at bounds[0] + (i + 0.5) * voxel_size. A splat counts by its covariance and opacity, not by
    # its centre alone (kernels/splats/density.py).

    def __init__(self, field: SplatField, resolution: int = RESOLUTION, bounds: ArrayLike | None = None):
        self.field, self.straightening = field, None  # the coordinates are those of the file
        box = field.bounds if bounds is None else checked_bounds(bounds)
        # (2, 3) and (3,) float64, world units; the box is a whole number of voxels
        self.bounds, self.voxel_size = whole_voxels(box, checked_whole(resolution, "resolution", 2, MOST_RESOLUTION))
        side = float(self.voxel_size[0])
        shape = np.round((self.bounds[1] - self.bounds[0]) / side).astype(int)
        nodes = int(np.prod(shape, dtype=np.int64))
        require_memory(8 * nodes, field.device, f"{' x '.join(map(str, shape))} nodes need {{size}}: take fewer")
        density = empty_array(tuple(int(n) for n in shape), wp.float32, field.device)
        density.zero_()
        lower = wp.vec3(*(self.bounds[0] + 0.5 * side - field.center))
        inputs = [field.splats, lower, side, LEAST_OPACITY]
        launch(deposit_splats, field.splat_count, inputs, [density], device=field.device, threads=1, work=1000)
        self._density = density.numpy()

    @property
    def up(self) -> np.ndarray:
        """(3,) what is up in the world."""
        return self.field.up

    def node_densities(self) -> np.ndarray:
        """(nx, ny, nz) float32 densities, per world unit."""
        return self._density

    def sample(self, points: ArrayLike, directions: ArrayLike | None = None) -> tuple[None, np.ndarray]:
        """None for colours, and densities (n,) float64, per world unit, at points (n, 3), between the nodes."""
        from scipy.ndimage import map_coordinates

        places = (np.asarray(points, np.float64) - self.bounds[0]) / self.voxel_size - 0.5
        return None, map_coordinates(self._density, places.T, order=1, mode="nearest", output=np.float64)


def whole_voxels(box: np.ndarray, resolution: int) -> tuple[np.ndarray, np.ndarray]:
    """A box (2, 3) made larger about its middle to whole cubes, two or more along each axis, and (3,) the side of a
    cube. resolution: cubes along the longest side of the box."""
    side = float((box[1] - box[0]).max()) / resolution
    shape = np.maximum(np.ceil((box[1] - box[0]) / side - 1e-6), 2.0)
    middle = box.mean(axis=0)
    return np.stack([middle - 0.5 * side * shape, middle + 0.5 * side * shape]), np.full(3, side)
