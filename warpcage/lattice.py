"""CageLattice: isotropic nodes over a cage, which of them are inside, and the signed distance near its surface."""

from __future__ import annotations

import numpy as np
import warp as wp

from .buffers import Buffers
from .devices import lane_count, launch, resolve_device
from .kernels.crossings import RUN, LineCrossings, cross_lines
from .kernels.distance_band import BLOCK, list_block_faces, measure_band
from .pose_constants import PoseConstants

MIN_RESOLUTION, MAX_RESOLUTION = 8, 1024

#: Cells between the cage's bounding box and the first node, per axis: two and an irrational share, so that the faces,
#: edges and vertices of boxes and other regular cages do not fall on lattice lines.
MARGIN = 2.0 + np.array([np.sqrt(2) - 1, np.sqrt(3) - 1, np.sqrt(5) - 2])

#: Crossings kept for a line at first; lines that need more make all of them longer.
LINE_CAPACITY = 8

#: Faces listed for a block of nodes in the distance band; blocks near more look at all faces.
BLOCK_FACES = 16

#: Cells along the longest side at which coarsening ends.
COARSEST_RESOLUTION = 4


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
    cells and clamped to that; crossings, where lattice lines cross the cage; vertices (v,) vec3 in node units; faces;
    constants and map_constants, what a pose sends to the device, for the lattice and for the map on it; sizes, how many
    nodes, lines and blocks of nodes there are.

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
        self.level_count = 1
        while self.resolution >> self.level_count >= COARSEST_RESOLUTION:
            self.level_count += 1
        vertex_count, face_count, levels = len(cage.vertices), len(cage.faces), self.level_count
        self.constants = PoseConstants(
            {
                "scales": (1, float),  # world units a cell
                "shapes": (levels, wp.vec3i),
                "first_node": (levels + 1, int),
                "first_column": (levels + 1, int),
                "vertices": (vertex_count, wp.vec3),  # node units
                "centred": (vertex_count, wp.vec3),  # the same, from the middle of the lattice
            },
            self.device,
        )
        self.map_constants = PoseConstants(
            {
                "affine": (4, wp.vec3),
                "vertex_values": (vertex_count, wp.vec3),  # what a map takes at the vertices
                "face_values": (face_count, wp.vec3),
            },
            self.device,
        )
        self.vertices = self.constants.arrays["vertices"]
        self.faces = wp.array(cage.faces, dtype=wp.vec3i, device=self.device)
        self._line_capacity = LINE_CAPACITY
        self.overflow = wp.zeros(1, dtype=int, device=self.device)
        self.fill(cage)

    def fill(self, cage, name: str = "cage") -> CageLattice:
        """Lay the lattice over another pose of the cage, in the same buffers where they are large enough.

        Raises ValueError, beginning with `name`, for an unusable cage. Arrays handed out before are overwritten.
        """
        cage.require_usable(name)
        self.lay(cage)
        self.constants.send()
        self.measure()
        return self

    def lay(self, cage) -> None:
        """Work out, on the host, where the nodes are; `constants` take it, still to be sent."""
        self.cage = cage
        self.shape, self.lower, self.spacing = lattice_frame(cage, self.resolution, self.origin)
        shapes = level_shapes(self.shape, self.level_count)
        self.first_node = np.concatenate([[0], np.cumsum(shapes.prod(axis=1, dtype=np.int64))])
        self.first_column = np.concatenate([[0], np.cumsum(shapes[:, 0] * shapes[:, 1])])
        nx, ny, nz = self.shape
        self.sizes = {
            "nodes": nx * ny * nz,
            "lines": ny * nz + nx * nz + nx * ny,
            "runs": (nx + ny) * -(-nz // RUN) + nx * -(-ny // RUN),
            "blocks": -(-nx // BLOCK) * -(-ny // BLOCK) * -(-nz // BLOCK),
        }
        scaled = (cage.vertices - self.lower) / self.spacing
        host = self.constants.host
        host["scales"][0] = self.spacing
        host["shapes"][:] = shapes
        host["first_node"][:] = self.first_node
        host["first_column"][:] = self.first_column
        host["vertices"][:] = scaled
        host["centred"][:] = scaled - (np.array(self.shape) - 1) // 2

    def measure(self) -> None:
        """Cross the lines and measure distances for the pose that was laid and sent."""
        while True:
            self.overflow.zero_()
            self.launch_crossings(self.sizes)
            needed = int(self.overflow.numpy()[0])
            if needed == 0:
                break
            self._line_capacity = max(2 * self._line_capacity, needed)
        self.launch_distances(self.sizes)
        self.take_distance()

    @property
    def node_count(self) -> int:
        return self.sizes["nodes"]

    @property
    def local_lower(self) -> wp.vec3:
        """Position of node (0, 0, 0) relative to the origin; exact in float32."""
        return wp.vec3(*(self.lower - self.origin))

    def launch_crossings(self, sizes: dict) -> None:
        """Launch what finds the crossings. sizes: those of this pose, or upper bounds."""
        lines = sizes["lines"]
        self.crossings = LineCrossings()
        self.crossings.shapes = self.constants.arrays["shapes"]
        self.crossings.counts = self.buffers.get("counts", lines, int)
        self.crossings.places = self.buffers.get("places", (lines, self._line_capacity), float)
        self.crossings.faces = self.buffers.get("faces", (lines, self._line_capacity), int)
        launch(
            cross_lines,
            lane_count(self.device) * sizes["runs"],
            [self.vertices, self.faces, self.crossings, self.overflow],
            device=self.device,
        )

    def launch_distances(self, sizes: dict) -> None:
        """Launch what fills the signed distances."""
        counts = self.buffers.get("block_counts", sizes["blocks"], int)
        near = self.buffers.get("block_faces", (sizes["blocks"], BLOCK_FACES), int)
        self.flat_distance = self.buffers.get("distance", sizes["nodes"], float)
        self.clearances = self.buffers.get("clearances", sizes["blocks"], float)
        inputs = [self.crossings, self.vertices, self.faces, counts, near]
        items = lane_count(self.device) * sizes["blocks"]
        launch(list_block_faces, items, [*inputs, self.clearances], device=self.device)
        inputs += [self.constants.arrays["scales"], self.flat_distance]
        launch(measure_band, sizes["nodes"], inputs, device=self.device)

    def take_distance(self) -> None:
        """Let `distance` be this pose's part of the buffer."""
        self.distance = self.buffers.get("distance", self.sizes["nodes"], float).reshape(self.shape)


def lattice_frame(cage, resolution: int, origin) -> tuple[tuple[int, int, int], np.ndarray, float]:
    """Shape (node counts), lower (3,) float64 and spacing of the lattice over a cage's bounding box.

    Spacing and lower - origin are float32 numbers, so that kernels see exactly the same lattice.
    """
    bounds = cage.bounds
    spacing = float(np.float32((bounds[1] - bounds[0]).max() / resolution))
    lower = bounds[0] - MARGIN * spacing - origin
    lower = lower.astype(np.float32).astype(np.float64) + origin
    cells = np.ceil((bounds[1] - lower) / spacing + 3.0)
    return tuple(int(side) + 1 for side in cells), lower, spacing


def level_shapes(shape, level_count: int) -> np.ndarray:
    """(L, 3) node counts: each level keeps every second node and has a last one at or beyond the finer level's."""
    shapes = [np.asarray(shape, dtype=np.int64)]
    for _ in range(level_count - 1):
        shapes.append(shapes[-1] // 2 + 1)
    return np.stack(shapes)
