"""CageLattice: isotropic nodes over a cage, which of them are inside, and the signed distance near its surface."""

from __future__ import annotations

import numpy as np
import warp as wp

from .buffers import Buffers
from .devices import launch, resolve_device
from .kernels.crossings import LineCrossings, cross_lines
from .kernels.distance_band import mark_inside, measure_band

MIN_RESOLUTION, MAX_RESOLUTION = 8, 1024

#: Cells between the cage's bounding box and the first node, per axis: two and an irrational share, so that the faces,
#: edges and vertices of boxes and other regular cages do not fall on lattice lines.
MARGIN = 2.0 + np.array([np.sqrt(2) - 1, np.sqrt(3) - 1, np.sqrt(5) - 2])

#: Crossings kept for a line at first; lines that need more make all of them longer.
LINE_CAPACITY = 8


def require_resolution(resolution) -> int:
    """`resolution` as an int. Raises ValueError unless it is a whole number from 8 to 1024."""
    if isinstance(resolution, bool) or not isinstance(resolution, int | np.integer):
        raise ValueError(f"resolution must be a whole number of cells, got {resolution!r}")
    if not MIN_RESOLUTION <= resolution <= MAX_RESOLUTION:
        raise ValueError(f"resolution must be {MIN_RESOLUTION} to {MAX_RESOLUTION} cells, got {resolution}")
    return int(resolution)


class CageLattice:
    """Nodes over one cage, with the signed distance to it.

    cage: closed, outward-oriented Cage. resolution: cells along the longest side of its bounding box; cells are cubes,
    and at least two of them lie between the box and the border of the lattice. origin: (3,) world point that all
    device arrays are relative to (float64; default the middle of the cage's bounding box).

    Attributes: shape (3,) node counts; lower (3,) float64, world position of node (0, 0, 0); spacing, world units;
    origin (3,) float64; distance, array3d float: signed distance in world units, negative inside, exact nearer than 4
    cells and clamped to that; crossings, where lattice lines cross the cage; vertices (v,) vec3 in node units; faces.

    Inside means a winding number above 0.5, exact at nodes. Raises ValueError for a resolution outside 8 .. 1024, an
    unusable cage, or one without extent.
    """

    def __init__(self, cage, resolution: int, *, origin=None, device=None):
        self.resolution = require_resolution(resolution)
        self.device = resolve_device(device)
        self.origin = None if origin is None else np.asarray(origin, dtype=np.float64).reshape(3)
        if self.origin is None:
            self.origin = cage.bounds.mean(axis=0)
        self.buffers = Buffers(self.device)
        self._line_capacity = LINE_CAPACITY
        self.faces: wp.array | None = None
        self.fill(cage)

    def fill(self, cage, name: str = "cage") -> CageLattice:
        """Lay the lattice over another cage or pose, in the same buffers where they are large enough.

        Raises ValueError, beginning with `name`, for an unusable cage. Arrays handed out before are overwritten.
        """
        cage.require_usable(name)
        self.cage = cage
        self.shape, self.lower, self.spacing = lattice_frame(cage, self.resolution, self.origin)
        scaled = (cage.vertices - self.lower) / self.spacing
        self.vertices = wp.array(scaled.astype(np.float32), dtype=wp.vec3, device=self.device)
        self.faces = wp.array(cage.faces, dtype=wp.vec3i, device=self.device)
        self._cross_lines()
        self._measure_distance()
        return self

    @property
    def node_count(self) -> int:
        return int(np.prod(self.shape))

    @property
    def local_lower(self) -> wp.vec3:
        """Position of node (0, 0, 0) relative to the origin; exact in float32."""
        return wp.vec3(*(self.lower - self.origin))

    def _cross_lines(self) -> None:
        nx, ny, nz = self.shape
        line_count = ny * nz + nx * nz + nx * ny
        # a GPU wants many short items; a CPU visits the faces less often with long ones
        segment = 32 if self.device.is_cpu else 1
        runs = [-(-count // segment) for count in (nz, nz, ny)]
        rows = [ny, nx, nx]
        bases = np.concatenate([[0], np.cumsum(np.multiply(rows, runs))])
        overflow = wp.zeros(1, dtype=int, device=self.device)
        while True:
            self.crossings = LineCrossings()
            self.crossings.shape = wp.vec3i(nx, ny, nz)
            self.crossings.counts = self.buffers.get("counts", line_count, int)
            self.crossings.places = self.buffers.get("places", (line_count, self._line_capacity), float)
            self.crossings.faces = self.buffers.get("faces", (line_count, self._line_capacity), int)
            launch(
                cross_lines,
                int(bases[3]),
                [segment, wp.vec3i(*bases[:3]), self.vertices, self.faces, self.crossings, overflow],
                device=self.device,
            )
            needed = int(overflow.numpy()[0])
            if needed == 0:
                return
            self._line_capacity = max(2 * self._line_capacity, needed)
            overflow.zero_()

    def _measure_distance(self) -> None:
        self.distance = self.buffers.get("distance", self.shape, float)
        launch(mark_inside, self.node_count, [self.crossings, self.spacing], [self.distance], device=self.device)
        block = 4
        block_count = int(np.prod([-(-side // block) for side in self.shape]))
        launch(
            measure_band,
            block_count,
            [block, self.vertices, self.faces, self.spacing],
            [self.distance],
            device=self.device,
        )


def lattice_frame(cage, resolution: int, origin) -> tuple[tuple[int, int, int], np.ndarray, float]:
    """Shape (node counts), lower (3,) float64 and spacing of the lattice over a cage's bounding box.

    Spacing and lower - origin are float32 numbers, so that kernels see exactly the same lattice.
    """
    bounds = cage.bounds
    spacing = float(np.float32(cage.size / resolution))
    lower = bounds[0] - MARGIN * spacing - origin
    lower = lower.astype(np.float32).astype(np.float64) + origin
    cells = np.ceil((bounds[1] - lower) / spacing + 3.0)
    return tuple(int(side) + 1 for side in cells), lower, spacing
