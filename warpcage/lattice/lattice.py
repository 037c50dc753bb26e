"""CageLattice: isotropic nodes over a cage, which are inside, distances, and the faces near each block of nodes."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.checks import checked_whole, require_ordinary_side
from ..core.devices import HeldOnDevice, lane_count, launch, resolve_device
from ..core.threads import in_turn
from ..errors import InputError
from ..kernels.lattice.crossings import RUN, LineCrossings, cross_lines
from ..kernels.lattice.distance import (
    BAND,
    BLOCK,
    HALF_DIAGONAL,
    MASK_FACES,
    box_faces,
    find_candidates,
    list_block_faces,
    measure_band,
)
from ..kernels.lattice.nodes import RINGS
from ..mesh.faces import face_area
from ..mesh.mesh import ClosedMesh
from .buffers import BufferPool, PoseConstants, SideStream
from .sizes import PoseSizes

#: Fewest faces that are listed for a block of nodes in the distance band, and the most memory that lists of more take,
#: bytes. Blocks near more faces than are listed look at all faces.
BLOCK_FACES, LIST_BYTES = 16, 1 << 26

#: Cells from the middle of a block within which faces are listed for it.
BAND_REACH = float(BAND) + float(HALF_DIAGONAL)

#: Room in these lists over what an even cage needs.
LIST_ROOM = 3.0

#: Fewest faces of a cage for which groups of blocks are searched first, on a GPU (two more launches) and on a CPU.
MANY_FACES, MANY_FACES_CPU = 512, 64

#: Blocks along each side of a group at least, and the most bytes a node that the bits of all faces take there.
GROUP_SIDE, GROUP_BYTES = 4, 2

#: Most threads that set these bits on a GPU, half of what their 32-bit numbers count.
MAX_THREADS = 1 << 30

#: Bytes of the box of a face, and of a bit mask.
BOX_BYTES, MASK_BYTES = 24, 4


class BlockFaces:
    """The faces near each block of 4 x 4 x 4 nodes of a pose; `spacing` is in world units, `shape` counts nodes.
    Cages of many faces: groups of blocks look through the faces' boxes, blocks at what their group found near."""

    def __init__(self, cage: ClosedMesh, shape: tuple[int, int, int], spacing: float, buffers: BufferPool):
        self._device = buffers.device
        self._counts, self._near, self._clear = (buffers.buffer(wp.int32) for _ in range(3))
        self._boxes, self._candidates = buffers.buffer(wp.vec3), buffers.buffer(wp.int32)
        self._listed = listed_faces(cage, shape, spacing)
        self.group_side = group_side(len(cage.faces), max(shape))  # blocks along each side of a group
        # of blocks: how many faces are near (blocks,), which, the first m ascending (blocks, m), and clear octants
        self.counts, self.near, self.clear_octants = self._counts.take(0), self._near.take((0, 0)), self._clear.take(0)
        # corners of each face's box (f, 2), node units; bits of faces near groups (groups, masks); empty for few faces
        self.boxes, self.candidates = self._boxes.take((0, 2)), self._candidates.take((0, 0))

    def launch(self, sizes: PoseSizes, shapes: wp.array, vertices: wp.array, faces: wp.array) -> None:
        """Launch what lists the faces of a pose.
        shapes: (L,) vec3i nodes along each axis of the levels; vertices: (v,) vec3, node units; faces: (f,) vec3i."""
        lanes, device = lane_count(self._device), self._device
        if faces.size >= (MANY_FACES_CPU if device.is_cpu else MANY_FACES):
            masks = mask_count(faces.size)
            self.boxes = self._boxes.take((faces.size, 2))
            self.candidates = self._candidates.take((sizes.groups, masks))
            launch(box_faces, faces.size, [vertices, faces], [self.boxes], device=device)
            inputs = [shapes, self.boxes, self.group_side]
            launch(find_candidates, lanes * sizes.groups * masks, inputs, [self.candidates], device=device)
        self.counts, self.near = self._counts.take(sizes.blocks), self._near.take((sizes.blocks, self._listed))
        self.clear_octants = self._clear.take(sizes.blocks)
        inputs = [shapes, vertices, faces, self.boxes, self.group_side, self.candidates]
        outputs = [self.counts, self.near, self.clear_octants]
        launch(list_block_faces, lanes * sizes.blocks, inputs, outputs, device=device, work=faces.size)


def listed_faces(cage: ClosedMesh, shape: tuple[int, int, int], spacing: float) -> int:
    """How many faces are listed for a block of nodes, a multiple of BLOCK_FACES: more for many small faces."""
    area = face_area(cage) / spacing**2
    # faces whose middle lies within reach of a block, on a flat piece of the cage
    reach = BAND_REACH + math.sqrt(area / len(cage.faces))
    needed = LIST_ROOM * len(cage.faces) * math.pi * reach**2 / max(area, 1.0)
    most = min(needed, LIST_BYTES / (4 * block_count(shape)), len(cage.faces))
    return BLOCK_FACES * max(1, math.ceil(most / BLOCK_FACES))


def more_list_bytes(cage: ClosedMesh, shape: tuple[int, int, int], spacing: float) -> int:
    """Bytes on the device that boxes, bits and lists of faces take beyond those of lists of BLOCK_FACES a block."""
    face_count = len(cage.faces)
    total = 4 * block_count(shape) * (listed_faces(cage, shape, spacing) - BLOCK_FACES)
    if face_count >= min(MANY_FACES, MANY_FACES_CPU):
        total += BOX_BYTES * face_count
        total += MASK_BYTES * mask_count(face_count) * block_count(shape, group_side(face_count, max(shape)))
    return total


def group_side(face_count: int, longest: int) -> int:
    """Blocks along each side of a group of blocks; `longest` counts nodes along the longest side of the lattice."""
    # Other poses may be as long along other sides. More nodes share the bits of many faces: the side doubles then.
    side, masks = GROUP_SIDE, mask_count(face_count)
    while (
        MASK_BYTES * masks > GROUP_BYTES * (int(BLOCK) * side) ** 3
        or int(MASK_FACES) * masks * block_count((longest, longest, longest), side) > MAX_THREADS
    ):
        side *= 2
    return side


def mask_count(face_count: int) -> int:
    """32-bit masks with a bit for each face."""
    return -(-face_count // int(MASK_FACES))


def block_count(shape: tuple[int, int, int], group_side: int = 1) -> int:
    """Blocks over a lattice of so many nodes along each axis, or groups of them, of `group_side` blocks along each
    side."""
    return math.prod(-(-nodes // (int(BLOCK) * group_side)) for nodes in shape)


MIN_RESOLUTION, MAX_RESOLUTION = 8, 1024

#: Cells between the cage's bounding box and the first node, per axis: two and an irrational share, so that the faces,
#: edges and vertices of boxes and other regular cages do not fall on lattice lines.
MARGIN = (1.0 + math.sqrt(2), 1.0 + math.sqrt(3), math.sqrt(5))

#: Nodes along the longest side of a lattice beside its resolution, at most: both margins, rounded up.
MAX_MARGIN = 8

#: Crossings kept for a line at first; lines that need more make all of them longer.
LINE_CAPACITY = 8

#: Flags of a pose; see PoseFlags.
FLAGS = 4

#: Largest spacing of float32 numbers at the lattice, in cells: rounding leaves two cells of the margin.
MAX_ROUNDING = 0.4

#: Bits of a float32 number's digits.
FLOAT32_BITS = 24

#: Cells along the longest side at which coarsening ends.
COARSEST_RESOLUTION = 4


def require_resolution(resolution: int) -> int:
    """The number of cells along the longest side of a lattice, 8 to 1024, as an int."""
    return checked_whole(resolution, "resolution", MIN_RESOLUTION, MAX_RESOLUTION)


class PoseFlags:
    """Flags of a pose that kernels set while its lattice is laid out: (1,) int each of (FLAGS,) int, zero at first."""

    def __init__(self, array: wp.array):
        # lines: crossings of the longest line that has no room; lists: 1 where a list has none; narrow: 1 where gaps
        # are below a cell, 2 where the map jumps over one; gaps: above 0 where nodes lie at narrow gaps it jumps over
        self.lines, self.lists, self.narrow, self.gaps = (array[flag : flag + 1] for flag in range(FLAGS))


class LatticeConstants(PoseConstants):
    """What a pose sends to the device for its lattice, of `level_count` levels, L."""

    def __init__(self, level_count: int, vertex_count: int, device: wp.DeviceLike):
        levels = (level_count + 1, int)
        corners = (vertex_count, wp.vec3)
        super().__init__(device, [(FLAGS, int), (1, float), (level_count, wp.vec3i), levels, levels, corners, corners])
        # flags: see PoseFlags; scales: (1,) world units per cell; shapes: (L, 3) nodes along the axes of levels;
        # first_node, first_column: (L + 1,); vertices: (v, 3) node units; centred: from the middle of the lattice
        (self.flags, self.scales, self.shapes, self.first_node, self.first_column, self.vertices, self.centered) = (
            self.slots
        )


class MapConstants(PoseConstants):
    """What a pose sends to the device for the map on its lattice."""

    def __init__(self, vertex_count: int, device: wp.DeviceLike):
        super().__init__(device, [(4, wp.vec3), (vertex_count, wp.vec3)])
        self.affine, self.vertex_values = self.slots  # (4, 3): steps along the axes, node (0, 0, 0); (v, 3): besides


class CageLattice(HeldOnDevice):
    """Nodes over a usable cage, with the signed distance to it once they are measured.
    resolution: cells along its longest side; origin: world point of device arrays, None is the middle of its box."""

    # Cubic cells, at least two between the cage's box and the border. Inside: winding number above 0.5, exact at nodes.

    def __init__(
        self, cage: ClosedMesh, resolution: int, *, origin: ArrayLike | None = None, device: wp.DeviceLike = None
    ):
        self.resolution = require_resolution(resolution)
        self.device = resolve_device(device)
        place = cage.bounds.mean(axis=0) if origin is None else origin
        self.origin = np.asarray(place, dtype=np.float64).reshape(3)
        self.level_count = 1
        while self.resolution >> self.level_count >= COARSEST_RESOLUTION:
            self.level_count += 1
        self.constants = LatticeConstants(self.level_count, len(cage.vertices), self.device)
        self.map_constants = MapConstants(len(cage.vertices), self.device)
        self.flags = PoseFlags(self.constants.flags.array)
        self.vertices = self.constants.vertices.array  # (v,) vec3, node units
        self.faces = wp.array(cage.faces, dtype=wp.vec3i, device=self.device)  # (f,) vec3i
        self.side, self.other_side = SideStream(self.device), SideStream(self.device)
        self.buffers = BufferPool(self.device)  # all that is held on the device and depends on the pose
        self._distance = self.buffers.buffer(wp.float32)
        self._crossing_counts = self.buffers.buffer(wp.int32)
        self._crossing_places = self.buffers.buffer(wp.float32)
        self._crossing_faces = self.buffers.buffer(wp.int32)
        self._line_capacity = LINE_CAPACITY
        self.crossings = LineCrossings()  # where lattice lines cross the cage
        self.flat_distance = self._distance.take(0)  # (nodes or more,), signed, world units; see `distance`
        self._place(cage)
        self.block_faces = BlockFaces(cage, self.layout.shape, self.spacing, self.buffers)

    def lay(self, cage: ClosedMesh) -> CageLattice:
        """Lay the lattice over another pose, on the host; `constants` hold it then, still to be sent.
        `cage` is usable and has the faces of the first one; where it is too far from the origin, the lattice stays."""
        self._place(cage)
        return self

    def _place(self, cage: ClosedMesh) -> None:
        shape, self.lower, self.spacing = lattice_frame(cage, self.resolution, self.origin)
        self.cage = cage
        self.layout = layout = level_layout(shape, self.level_count)
        scaled = (cage.vertices - self.lower) / self.spacing
        constants = self.constants
        constants.flags.host[:] = 0
        constants.scales.host[0] = self.spacing
        constants.shapes.host[:] = layout.shapes
        constants.first_node.host[:] = layout.first_node
        constants.first_column.host[:] = layout.first_column
        constants.vertices.host[:] = scaled
        constants.centered.host[:] = scaled - (np.array(shape) - 1) // 2

    @in_turn
    def measure(self) -> CageLattice:
        """Cross the lines and measure distances for the pose that the lattice lies over, whatever there was before."""
        self.constants.send()
        self.launch_geometry(self.sizes(1))
        return self

    @property
    def shape(self) -> tuple[int, int, int]:
        """Nodes along each axis."""
        return self.layout.shape

    @property
    def node_count(self) -> int:
        """Nodes in all."""
        return self.layout.node_count

    @property
    def distance(self) -> wp.array:
        """Array of the lattice's shape: signed distance in world units, negative inside, exact nearer than 4 cells and
        clamped to that. The next pose overwrites it."""
        return self._distance.take(self.shape)

    @property
    def local_lower(self) -> wp.vec3:
        """Position of node (0, 0, 0) relative to the origin; exact in float32."""
        return wp.vec3(*(self.lower - self.origin).tolist())  # NumPy's own take Warp longer

    def sizes(self, level_count: int) -> PoseSizes:
        """The sizes of launches over this pose on so many levels, without sections: nodes are not listed yet."""
        return pose_sizes(self.layout, level_count, self.block_faces.group_side)

    def most_sizes(self, level_count: int) -> PoseSizes:
        """The same over a pose as long along all axes: hardly any pose has more, whatever its proportions."""
        layout = level_layout((self.resolution + MAX_MARGIN,) * 3, self.level_count)
        return pose_sizes(layout, level_count, self.block_faces.group_side)

    def launch_geometry(self, sizes: PoseSizes) -> None:
        """Launch what finds crossings and signed distances, the constants being sent; sizes: of the pose, or bounds."""
        self._launch_geometry(sizes)
        while sizes.sections is None and self._lengthen_lines():  # waits for the device; later poses look at `flags`
            self._launch_geometry(sizes)

    def _launch_geometry(self, sizes: PoseSizes) -> None:
        with self.side.fork():
            self.block_faces.launch(sizes, self.constants.shapes.array, self.vertices, self.faces)
        self._launch_crossings(sizes)
        self.side.join()
        self.flat_distance = self._distance.take(sizes.nodes)
        found = self.block_faces
        inputs = [self.crossings, self.vertices, self.faces, found.boxes, found.counts, found.near]
        inputs.append(self.constants.scales.array)
        launch(measure_band, BLOCK**3 * sizes.blocks, [*inputs, self.flat_distance], device=self.device)

    def make_room(self, crossings: int) -> None:
        """Have room for this many crossings a line from the next pose on, before one needs it."""
        self._line_capacity = max(self._line_capacity, crossings)

    def _lengthen_lines(self) -> bool:
        """Wait, and whether lines were too short for their crossings."""
        needed = int(self.flags.lines.numpy()[0])
        if needed:
            self._line_capacity = max(2 * self._line_capacity, needed)
            self.flags.lines.zero_()
        return needed > 0

    def _launch_crossings(self, sizes: PoseSizes) -> None:
        places = sizes.lines, self._line_capacity
        self.crossings = LineCrossings()
        self.crossings.shapes = self.constants.shapes.array
        self.crossings.counts = self._crossing_counts.take(sizes.lines)
        self.crossings.places = self._crossing_places.take(places)
        self.crossings.faces = self._crossing_faces.take(places)
        inputs = [self.vertices, self.faces, self.crossings, self.flags.lines]
        launch(cross_lines, lane_count(self.device) * sizes.runs, inputs, device=self.device, work=self.faces.size)


def lattice_frame(
    cage: ClosedMesh, resolution: int, origin: ArrayLike
) -> tuple[tuple[int, int, int], np.ndarray, float]:
    """Where the lattice over a cage's bounding box lies: shape (node counts), lower (3,) float64 and spacing, world
    units; spacing and lower - origin are float32 numbers, as kernels have them. origin: (3,) world point."""
    require_ordinary_side(cage.size, "the cage of a lattice")
    (low, high), place = cage.bounds.tolist(), np.asarray(origin).tolist()
    spacing = float(np.float32(max(b - a for a, b in zip(low, high, strict=True)) / resolution))
    far = max(max(abs(a - o), abs(b - o)) for a, b, o in zip(low, high, place, strict=True))
    if not math.ldexp(1.0, math.frexp(far)[1] - FLOAT32_BITS) <= MAX_ROUNDING * spacing:
        raise InputError(
            f"the cage reaches {far:.3g} from the origin of its lattice, {far / cage.size:.2g} times its "
            f"size: float32 cannot separate cells of {spacing:.2g} there, move it nearer or take a "
            f"resolution below {resolution}"
        )
    lower = [float(np.float32(a - margin * spacing - o)) + o for a, margin, o in zip(low, MARGIN, place, strict=True)]
    cells = (math.ceil((b - a) / spacing + 3.0) for a, b in zip(lower, high, strict=True))
    return tuple(side + 1 for side in cells), np.array(lower), spacing


@dataclass(frozen=True, eq=False)
class LevelLayout:
    """How the nodes of a lattice of some shape are numbered, level after level.
    Each level keeps every second node and has a last one at or beyond the finer level's."""

    shape: tuple[int, int, int]
    shapes: np.ndarray  # (L, 3) nodes along each axis of all levels
    first_node: np.ndarray  # (L + 1,) where each level's nodes and columns begin
    first_column: np.ndarray

    @property
    def node_count(self) -> int:
        """Nodes of level 0."""
        nx, ny, nz = self.shape
        return nx * ny * nz


@functools.lru_cache(maxsize=256)
def level_layout(shape: tuple[int, int, int], level_count: int) -> LevelLayout:
    """The layout of a lattice of `shape` nodes; poses of the same shape share it."""
    sides = [np.asarray(shape, dtype=np.int64)]
    for _ in range(level_count - 1):
        sides.append(sides[-1] // 2 + 1)
    shapes = np.stack(sides)
    return LevelLayout(
        shape=shape,
        shapes=shapes,
        first_node=np.concatenate([[0], np.cumsum(shapes.prod(axis=1))]),
        first_column=np.concatenate([[0], np.cumsum(shapes[:, 0] * shapes[:, 1])]),
    )


@functools.lru_cache(maxsize=256)
def pose_sizes(layout: LevelLayout, level_count: int, group_side: int) -> PoseSizes:
    """The sizes of launches over a lattice, without sections: nodes are not listed yet.
    `level_count` levels are used; `group_side` counts blocks along each side of a group."""
    nx, ny, nz = layout.shape
    level_nodes, level_columns = int(layout.first_node[level_count]), int(layout.first_column[level_count])
    return PoseSizes(
        nodes=layout.node_count,
        lines=ny * nz + nx * nz + nx * ny,
        runs=(nx + ny) * -(-nz // RUN) + nx * -(-ny // RUN),
        blocks=block_count(layout.shape),
        groups=block_count(layout.shape, group_side),
        columns=nx * ny,
        level_nodes=level_nodes,
        coarse_nodes=level_nodes - layout.node_count,
        level_columns=level_columns,
        entries=3 * level_columns + RINGS * nx * ny + 1,
    )
