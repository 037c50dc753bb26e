"""CageLattice: isotropic nodes over a cage, which of them are inside, and the signed distance near its surface."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import warp as wp

from ..core.devices import lane_count, launch, resolve_device
from ..kernels.lattice.crossings import RUN, LineCrossings, cross_lines
from ..kernels.lattice.distance import BLOCK, list_block_faces, measure_band
from ..mesh.usable import require_usable
from .capture import Buffers, PoseConstants, SideStream

MIN_RESOLUTION, MAX_RESOLUTION = 8, 1024

#: Cells between the cage's bounding box and the first node, per axis: two and an irrational share, so that the faces,
#: edges and vertices of boxes and other regular cages do not fall on lattice lines.
MARGIN = (1.0 + math.sqrt(2), 1.0 + math.sqrt(3), math.sqrt(5))

#: Crossings kept for a line at first; lines that need more make all of them longer.
LINE_CAPACITY = 8

#: Faces listed for a block of nodes in the distance band; blocks near more look at all faces.
BLOCK_FACES = 16

#: Flags that a pose raises on the device: lines overflow, lists overflow, gaps narrower than a cell, nodes at gaps.
FLAGS = 4

#: Views of buffers that are kept, of poses of different shapes.
MOST_VIEWS = 64

#: Most that float32 may be apart, in cells, where the lattice is: rounding leaves two cells of the margin.
MOST_ROUNDING = 0.4

#: Bits of a float32 number's digits.
FLOAT32_BITS = 24

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
    block_faces, how many faces are near each block of nodes and which (kernels/lattice/distance.py);
    constants and map_constants, what a pose sends to the device, for the lattice and for the map on it; sizes, how many
    nodes, lines and blocks of nodes there are.

    Inside means a winding number above 0.5, exact at nodes. Raises ValueError for a resolution outside 8 .. 1024, an
    unusable cage, one without extent, or one too far from the origin for float32 numbers to tell its cells apart.
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
        vertex_count, levels = len(cage.vertices), self.level_count
        self.constants = PoseConstants(
            {
                "flags": (FLAGS, int),  # sent as zeros
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
            },
            self.device,
        )
        self.vertices = self.constants.arrays["vertices"]
        self.faces = wp.array(cage.faces, dtype=wp.vec3i, device=self.device)
        self._line_capacity = LINE_CAPACITY
        self.flags = self.constants.arrays["flags"]
        self.overflow = self.flags[:1]
        self.side, self.other_side = SideStream(self.device), SideStream(self.device)
        self._views: dict = {}
        self.fill(cage)

    def fill(self, cage, name: str = "cage") -> CageLattice:
        """Lay the lattice over another pose of the cage, in the same buffers where they are large enough.

        Raises ValueError, beginning with `name`, for an unusable cage. Arrays handed out before are overwritten.
        """
        require_usable(cage, name)
        self.lay(cage)
        self.constants.send()
        self.measure()
        return self

    def lay(self, cage) -> None:
        """Work out, on the host, where the nodes are; `constants` take it, still to be sent. Raises ValueError, before
        anything is changed, for a cage too far from the origin."""
        self.shape, self.lower, self.spacing = lattice_frame(cage, self.resolution, self.origin)
        self.cage = cage
        layout = level_layout(self.shape, self.level_count)
        self.first_node, self.first_column, self.sizes = layout.first_node, layout.first_column, layout.sizes
        scaled = (cage.vertices - self.lower) / self.spacing
        host = self.constants.host
        host["flags"][:] = 0
        host["scales"][0] = self.spacing
        host["shapes"][:] = layout.shapes
        host["first_node"][:] = layout.first_node
        host["first_column"][:] = layout.first_column
        host["vertices"][:] = scaled
        host["centred"][:] = scaled - (np.array(self.shape) - 1) // 2

    def measure(self) -> None:
        """Cross the lines and measure distances for the pose that was laid and sent."""
        while True:
            self.flags.zero_()
            self.launch_geometry(self.sizes)
            needed = int(self.overflow.numpy()[0])
            if needed == 0:
                break
            self._line_capacity = max(2 * self._line_capacity, needed)
        self.take_distance()

    @property
    def node_count(self) -> int:
        return self.sizes["nodes"]

    @property
    def local_lower(self) -> wp.vec3:
        """Position of node (0, 0, 0) relative to the origin; exact in float32."""
        return wp.vec3(*(self.lower - self.origin))

    def launch_geometry(self, sizes: dict) -> None:
        """Launch what finds crossings and signed distances. sizes: those of this pose, or upper bounds."""
        with self.side.fork():
            self._launch_block_faces(sizes)
        self._launch_crossings(sizes)
        self.side.join()
        self.flat_distance = self.buffers.get("distance", sizes["nodes"], float)
        inputs = [self.crossings, self.vertices, self.faces, *self.block_faces, self.constants.arrays["scales"]]
        launch(measure_band, BLOCK**3 * sizes["blocks"], [*inputs, self.flat_distance], device=self.device)

    def _launch_crossings(self, sizes: dict) -> None:
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

    def _launch_block_faces(self, sizes: dict) -> None:
        blocks = sizes["blocks"]
        counts = self.buffers.get("block_counts", blocks, int)
        near = self.buffers.get("block_faces", (blocks, BLOCK_FACES), int)
        self.clear_octants = self.buffers.get("clear_octants", blocks, int)
        self.block_faces = counts, near
        inputs = [self.constants.arrays["shapes"], self.vertices, self.faces, counts, near]
        launch(list_block_faces, lane_count(self.device) * blocks, [*inputs, self.clear_octants], device=self.device)

    def take_distance(self) -> None:
        """Let `distance` be this pose's part of the buffer."""
        self.distance = self.view("distance", float)

    def view(self, name: str, dtype) -> wp.array:
        """The buffer of that name, of values at the nodes, as an array of the lattice's shape. Poses of the same shape
        share it: making one takes a few microseconds."""
        key = name, self.shape, self.buffers.generation
        if key not in self._views:
            if len(self._views) >= MOST_VIEWS:
                self._views.clear()
            self._views[key] = self.buffers.get(name, self.node_count, dtype).reshape(self.shape)
        return self._views[key]


def lattice_frame(cage, resolution: int, origin) -> tuple[tuple[int, int, int], np.ndarray, float]:
    """Shape (node counts), lower (3,) float64 and spacing of the lattice over a cage's bounding box.

    Spacing and lower - origin are float32 numbers, so that kernels see exactly the same lattice. Raises ValueError for
    a cage so far from the origin that float32 numbers are about half a cell apart there.
    """
    low, high, origin = *cage.bounds.tolist(), np.asarray(origin).tolist()
    spacing = float(np.float32(max(b - a for a, b in zip(low, high, strict=True)) / resolution))
    far = max(max(abs(a - o), abs(b - o)) for a, b, o in zip(low, high, origin, strict=True))
    if not math.ldexp(1.0, math.frexp(far)[1] - FLOAT32_BITS) <= MOST_ROUNDING * spacing:
        raise ValueError(
            f"the cage reaches {far:.3g} from the origin of its lattice, {far / cage.size:.2g} times its "
            f"size: float32 cannot tell cells of {spacing:.2g} apart there, move it nearer or take a "
            f"resolution below {resolution}"
        )
    lower = [float(np.float32(a - margin * spacing - o)) + o for a, margin, o in zip(low, MARGIN, origin, strict=True)]
    cells = (math.ceil((b - a) / spacing + 3.0) for a, b in zip(lower, high, strict=True))
    return tuple(side + 1 for side in cells), np.array(lower), spacing


@dataclass(frozen=True)
class LevelLayout:
    """How the nodes of a lattice of some shape are numbered, level after level; see CageLattice."""

    shapes: np.ndarray
    first_node: np.ndarray
    first_column: np.ndarray
    sizes: dict


@functools.lru_cache(maxsize=256)
def level_layout(shape, level_count: int) -> LevelLayout:
    """shapes (L, 3) node counts: each level keeps every second node and has a last one at or beyond the finer level's;
    first_node, first_column (L + 1,); sizes, what launches count. Poses of the same shape share it."""
    shapes = [np.asarray(shape, dtype=np.int64)]
    for _ in range(level_count - 1):
        shapes.append(shapes[-1] // 2 + 1)
    shapes = np.stack(shapes)
    nx, ny, nz = shape
    return LevelLayout(
        shapes=shapes,
        first_node=np.concatenate([[0], np.cumsum(shapes.prod(axis=1))]),
        first_column=np.concatenate([[0], np.cumsum(shapes[:, 0] * shapes[:, 1])]),
        sizes={
            "nodes": nx * ny * nz,
            "lines": ny * nz + nx * nz + nx * ny,
            "runs": (nx + ny) * -(-nz // RUN) + nx * -(-ny // RUN),
            "blocks": -(-nx // BLOCK) * -(-ny // BLOCK) * -(-nz // BLOCK),
        },
    )
