"""BlockFaces: which faces of a cage are near each block of nodes of a lattice, and which blocks are clear of it."""

from __future__ import annotations

import math

import warp as wp

from ..core.devices import lane_count, launch
from ..kernels.lattice.distance import (
    BAND,
    BLOCK,
    HALF_DIAGONAL,
    WORD_FACES,
    box_faces,
    find_candidates,
    list_block_faces,
)
from ..mesh.faces import face_area
from ..mesh.mesh import ClosedMesh
from .capture import BufferPool
from .sizes import PoseSizes

#: Fewest faces that are listed for a block of nodes in the distance band, and the most memory that lists of more take,
#: bytes. Blocks near more faces than are listed look at all faces.
BLOCK_FACES, LIST_BYTES = 16, 1 << 26

#: Cells from the middle of a block within which faces are listed for it.
BAND_REACH = float(BAND) + float(HALF_DIAGONAL)

#: Room in these lists over what an even cage needs.
LIST_ROOM = 3.0

#: Fewest faces of a cage that are looked through for groups of blocks first, on a GPU, where that is two launches more,
#: and on a CPU.
MANY_FACES, MANY_FACES_CPU = 512, 64

#: Blocks along each side of a group at least, and the most bytes a node that the bits of all faces take there.
GROUP_SIDE, GROUP_BYTES = 4, 2

#: Most threads that set these bits on a GPU, half of what their 32-bit numbers count.
MOST_THREADS = 1 << 30

#: Bytes of a face's box, and of a word of bits.
BOX_BYTES, WORD_BYTES = 24, 4


class BlockFaces:
    """The faces near each block of 4 x 4 x 4 nodes of a pose; `spacing` is in world units, `shape` counts nodes."""

    # A cage of many faces has their bounding boxes worked out first, and has them looked through for groups of blocks:
    # each block then looks at the boxes that its group found near.

    def __init__(self, cage: ClosedMesh, shape: tuple[int, int, int], spacing: float, buffers: BufferPool):
        self._device = buffers.device
        self._counts, self._near, self._clear = (buffers.buffer(wp.int32) for _ in range(3))
        self._boxes, self._candidates = buffers.buffer(wp.vec3), buffers.buffer(wp.int32)
        self._listed = listed_faces(cage, shape, spacing)
        # blocks along each side of a group
        self.group_side = group_side(len(cage.faces), max(shape))
        # of each block: how many faces are near, (blocks,) int, which, the first m ascending (blocks, m) int, and the
        # octants that are clear of the cage, (blocks,) int
        self.counts, self.near, self.clear_octants = self._counts.take(0), self._near.take((0, 0)), self._clear.take(0)
        # corners of each face's bounding box (f, 2) vec3, node units, and bits of the faces that may be near a group of
        # blocks, (groups, words) int; empty for few faces
        self.boxes, self.candidates = self._boxes.take((0, 2)), self._candidates.take((0, 0))

    def launch(self, sizes: PoseSizes, shapes: wp.array, vertices: wp.array, faces: wp.array) -> None:
        """Launch what lists the faces of a pose.
        shapes: (L,) vec3i nodes along each axis of the levels; vertices: (v,) vec3, node units; faces: (f,) vec3i."""
        lanes, device = lane_count(self._device), self._device
        if faces.size >= (MANY_FACES_CPU if device.is_cpu else MANY_FACES):
            words = word_count(faces.size)
            self.boxes = self._boxes.take((faces.size, 2))
            self.candidates = self._candidates.take((sizes.groups, words))
            launch(box_faces, faces.size, [vertices, faces], [self.boxes], device=device)
            inputs = [shapes, self.boxes, self.group_side]
            launch(find_candidates, lanes * sizes.groups * words, inputs, [self.candidates], device=device)
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
        total += WORD_BYTES * word_count(face_count) * block_count(shape, group_side(face_count, max(shape)))
    return total


def group_side(face_count: int, longest: int) -> int:
    """Blocks along each side of a group that faces are looked through for; `longest` counts nodes along the longest
    side."""
    # The other sides of another pose may be as long as the longest. More nodes have to share the bits of many faces:
    # the side doubles then.
    side, words = GROUP_SIDE, word_count(face_count)
    while (
        WORD_BYTES * words > GROUP_BYTES * (int(BLOCK) * side) ** 3
        or int(WORD_FACES) * words * block_count((longest, longest, longest), side) > MOST_THREADS
    ):
        side *= 2
    return side


def word_count(face_count: int) -> int:
    """Words of 32 bits that have a bit for each face."""
    return -(-face_count // int(WORD_FACES))


def block_count(shape: tuple[int, int, int], group_side: int = 1) -> int:
    """Blocks over a lattice of so many nodes along each axis, or groups of them, of `group_side` blocks along each
    side."""
    return math.prod(-(-nodes // (int(BLOCK) * group_side)) for nodes in shape)
