"""Signed distance to a cage on the nodes of a lattice: exact in a narrow band, clamped outside it."""

# The sign comes from the crossings of lattice lines, exact at nodes; the size from the nearest of the faces near the
# block of 4 x 4 x 4 nodes around. Cages of many faces are looked through for groups of blocks first, by bounding boxes.
# Vertices are in node units (see crossings.py), the result in world units.

import warp as wp

from ..core.gradients import forward_only_in
from ..core.lanes import (
    ballot,
    bit_count,
    bits_before,
    lane_place,
    least_of_lanes,
    lowest_bit,
    union_of_lanes,
    without_lowest_bit,
)
from ..mesh.containment import triangle_distance_squared
from .crossings import LineCrossings, is_inside

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

forward_only = forward_only_in(__name__, (float, wp.vec3))

#: Half-width of the band, in cells.
BAND = wp.constant(4.0)

#: Nodes along a side of a block, and half of its diagonal in cells; the same diagonal of an octant of 2 x 2 x 2 nodes.
BLOCK = wp.constant(4)
HALF_DIAGONAL = wp.constant(2.5981)
OCTANT_DIAGONAL = wp.constant(0.8661)
_Octants = wp.types.vector(length=8, dtype=float)

#: Cells from the cage beyond which a map of closed forms counts as smooth.
CLEARANCE = wp.constant(6.0)


#: Faces that share a 32-bit mask.
MASK_FACES = wp.constant(32)

#: Room for rounding when faces are looked through for a group of blocks, cells.
GROUP_SLACK = wp.constant(0.01)


@wp.func
def box_gap_squared(x: wp.vec3, low: wp.vec3, high: wp.vec3):
    """Squared distance from x to the box between two corners."""
    gap = wp.max(wp.max(low - x, x - high), wp.vec3(0.0, 0.0, 0.0))
    return wp.dot(gap, gap)


@wp.func
def face_gap_squared(
    x: wp.vec3,
    f: int,
    boxes: wp.array2d(dtype=wp.vec3),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
):
    """Squared distance from x to the bounding box of a face, which is worked out where no boxes are kept."""
    if boxes.shape[0] > 0:
        return box_gap_squared(x, boxes[f, 0], boxes[f, 1])
    face = faces[f]
    a = vertices[face[0]]
    b = vertices[face[1]]
    c = vertices[face[2]]
    return box_gap_squared(x, wp.min(wp.min(a, b), c), wp.max(wp.max(a, b), c))


@wp.func
def face_distance_squared(x: wp.vec3, f: int, vertices: wp.array(dtype=wp.vec3), faces: wp.array(dtype=wp.vec3i)):
    """Squared distance from x to a face."""
    face = faces[f]
    return triangle_distance_squared(x, vertices[face[0]], vertices[face[1]], vertices[face[2]])


@wp.func
def block_count(side: int):
    """Blocks that cover a side of `side` nodes."""
    return (side + BLOCK - 1) / BLOCK


@wp.func
def mask_count(face_count: int):
    """32-bit masks that have a bit for each face."""
    return (face_count + MASK_FACES - 1) / MASK_FACES


@wp.func
def candidate_bits(candidates: wp.array2d(dtype=int), group: int, mask: int, face_count: int):
    """Which of the faces of a mask a group's blocks look at: all where no group looked through them."""
    if candidates.shape[0] > 0:
        return candidates[group, mask]
    left = face_count - mask * MASK_FACES
    return wp.where(left < MASK_FACES, (1 << wp.min(left, MASK_FACES - 1)) - 1, -1)


@wp.kernel
def box_faces(
    first: int, vertices: wp.array(dtype=wp.vec3), faces: wp.array(dtype=wp.vec3i), boxes: wp.array2d(dtype=wp.vec3)
):
    """boxes (f, 2): lowest and highest corner of each face's bounding box. One item per face."""
    f = first + wp.tid()
    face = faces[f]
    a = vertices[face[0]]
    b = vertices[face[1]]
    c = vertices[face[2]]
    boxes[f, 0] = wp.min(wp.min(a, b), c)
    boxes[f, 1] = wp.max(wp.max(a, b), c)


@wp.kernel
def find_candidates(
    first: int,
    shapes: wp.array(dtype=wp.vec3i),
    boxes: wp.array2d(dtype=wp.vec3),
    group_side: int,
    candidates: wp.array2d(dtype=int),
):
    """candidates (groups, masks): bit b of mask m is set where face 32 m + b may come within CLEARANCE cells of a block
    of the group, which are group_side blocks along each axis. One group of lanes per mask, one lane per face."""
    piece, lane, lanes = lane_place(first + wp.tid())
    masks = mask_count(boxes.shape[0])
    mask = piece % masks
    group = piece / masks
    shape = shapes[0]
    ny = (block_count(shape[1]) + group_side - 1) / group_side
    nz = (block_count(shape[2]) + group_side - 1) / group_side
    if group >= (block_count(shape[0]) + group_side - 1) / group_side * ny * nz:
        return
    side = float(BLOCK * group_side)
    center = wp.vec3(float(group / (ny * nz)), float((group / nz) % ny), float(group % nz)) * side
    center += wp.vec3(1.0, 1.0, 1.0) * (0.5 * side - 0.5)
    # from this middle to those of the outermost blocks
    half = wp.vec3(1.0, 1.0, 1.0) * (0.5 * float(BLOCK * (group_side - 1)))
    reach = CLEARANCE + HALF_DIAGONAL + GROUP_SLACK
    bits = int(0)
    for bit in range(lane, MASK_FACES, lanes):
        f = mask * MASK_FACES + bit
        if f < boxes.shape[0] and box_gap_squared(center, boxes[f, 0] - half, boxes[f, 1] + half) <= reach * reach:
            bits = bits | (1 << bit)
    bits = union_of_lanes(bits)
    if lane == 0:
        candidates[group, mask] = bits


@wp.func
def octant_center(center: wp.vec3, octant: int):
    """Middle of an octant of a block; bits 0, 1, 2: its upper half along the axes."""
    return center + wp.vec3(float(2 * (octant & 1) - 1), float((octant & 2) - 1), float((octant & 4) / 2 - 1))


@wp.func
def clear_octant_bits(
    center: wp.vec3,
    group: int,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    boxes: wp.array2d(dtype=wp.vec3),
    candidates: wp.array2d(dtype=int),
    lane: int,
    lanes: int,
):
    """Bit o is set where the nodes of octant o are CLEARANCE cells and more from the cage. The lanes look at as many
    faces at once, and then each at its octants where a face is near. All lanes."""
    apart = _Octants()
    for octant in range(lane, 8, lanes):
        apart[octant] = (CLEARANCE + OCTANT_DIAGONAL) * (CLEARANCE + OCTANT_DIAGONAL)
    reach = CLEARANCE + HALF_DIAGONAL
    for mask in range(mask_count(faces.shape[0])):
        bits = candidate_bits(candidates, group, mask, faces.shape[0])
        for bit in range(lane, wp.where(bits == 0, 0, MASK_FACES), lanes):
            f = mask * MASK_FACES + bit
            is_near = int(0)
            if (bits >> bit) & 1 == 1:
                is_near = wp.where(face_gap_squared(center, f, boxes, vertices, faces) < reach * reach, 1, 0)
            near = ballot(is_near)
            while near != 0:
                face = faces[f - lane + lowest_bit(near)]
                near = without_lowest_bit(near)
                for octant in range(lane, 8, lanes):
                    x = octant_center(center, octant)
                    found = triangle_distance_squared(x, vertices[face[0]], vertices[face[1]], vertices[face[2]])
                    apart[octant] = wp.min(apart[octant], found)
    clear = int(0)
    for octant in range(lane, 8, lanes):
        if apart[octant] >= (CLEARANCE + OCTANT_DIAGONAL) * (CLEARANCE + OCTANT_DIAGONAL):
            clear = clear | (1 << octant)
    return union_of_lanes(clear)


@wp.kernel
def list_block_faces(
    first: int,
    shapes: wp.array(dtype=wp.vec3i),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    boxes: wp.array2d(dtype=wp.vec3),
    group_side: int,
    candidates: wp.array2d(dtype=int),
    counts: wp.array(dtype=int),
    near: wp.array2d(dtype=int),
    clear_octants: wp.array(dtype=int),
):
    """near (blocks, m): faces within BAND cells of a block's nodes, ascending; counts (blocks,): how many, also beyond
    m. One group of lanes per block, one lane per face."""
    # clear_octants (blocks,): bit o is set where the nodes of octant o are CLEARANCE cells or more from the cage; bits
    # 0, 1, 2 of o: its upper half along the axes. boxes, candidates: empty where every block looks at all faces.
    block, lane, lanes = lane_place(first + wp.tid())
    shape = shapes[0]
    ny = block_count(shape[1])
    nz = block_count(shape[2])
    if block >= block_count(shape[0]) * ny * nz:
        return
    i = block / (ny * nz)
    j = (block / nz) % ny
    k = block % nz
    group = (i / group_side * ((ny + group_side - 1) / group_side) + j / group_side) * (
        (nz + group_side - 1) / group_side
    ) + k / group_side
    half = 0.5 * float(BLOCK - 1)
    center = wp.vec3(float(i * BLOCK) + half, float(j * BLOCK) + half, float(k * BLOCK) + half)
    reach = BAND + HALF_DIAGONAL
    nearest = (CLEARANCE + HALF_DIAGONAL) * (CLEARANCE + HALF_DIAGONAL)
    count = int(0)
    for mask in range(mask_count(faces.shape[0])):
        bits = candidate_bits(candidates, group, mask, faces.shape[0])
        for bit in range(lane, wp.where(bits == 0, 0, MASK_FACES), lanes):
            f = mask * MASK_FACES + bit
            is_near = int(0)
            if (bits >> bit) & 1 == 1:
                if face_gap_squared(center, f, boxes, vertices, faces) <= wp.max(nearest, reach * reach):
                    apart = face_distance_squared(center, f, vertices, faces)
                    nearest = wp.min(nearest, apart)
                    is_near = wp.where(apart <= reach * reach, 1, 0)
            found = ballot(is_near)
            slot = count + bit_count(bits_before(found, lane))
            if is_near == 1 and slot < near.shape[1]:
                near[block, slot] = f
            count += bit_count(found)
    apart = wp.sqrt(least_of_lanes(nearest))
    clear = wp.where(apart >= 0.9999 * (CLEARANCE + HALF_DIAGONAL), 255, 0)
    if clear == 0 and apart > CLEARANCE - HALF_DIAGONAL:
        clear = clear_octant_bits(center, group, vertices, faces, boxes, candidates, lane, lanes)
    if lane == 0:
        counts[block] = count
        clear_octants[block] = clear


@wp.func
def is_clear(shape: wp.vec3i, clear_octants: wp.array(dtype=int), i: int, j: int, k: int):
    """Whether node (i, j, k) of a lattice is known to be CLEARANCE cells and more from the cage."""
    block = ((i / BLOCK) * block_count(shape[1]) + j / BLOCK) * block_count(shape[2]) + k / BLOCK
    octant = (i % BLOCK) / 2 + 2 * ((j % BLOCK) / 2) + 4 * ((k % BLOCK) / 2)
    return (clear_octants[block] >> octant) & 1 == 1


@wp.func
def nearest_face(
    x: wp.vec3,
    block: int,
    counts: wp.array(dtype=int),
    near: wp.array2d(dtype=int),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    boxes: wp.array2d(dtype=wp.vec3),
):
    """Squared distance from a node x to the cage, at most BAND^2, and the face that is nearest, -1 where none is within
    BAND. block: the one that the node lies in; counts, near, boxes: see list_block_faces."""
    count = counts[block]
    listed = count <= near.shape[1]
    if not listed:
        count = faces.shape[0]
    nearest = float(BAND * BAND)
    found = int(-1)
    for m in range(count):
        f = int(m)
        if listed:
            f = near[block, m]
        if face_gap_squared(x, f, boxes, vertices, faces) < nearest:
            apart = face_distance_squared(x, f, vertices, faces)
            found = wp.where(apart < nearest, f, found)
            nearest = wp.min(nearest, apart)
    return forward_only(nearest, x), found


@wp.kernel
def measure_band(
    first: int,
    crossings: LineCrossings,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    boxes: wp.array2d(dtype=wp.vec3),
    counts: wp.array(dtype=int),
    near: wp.array2d(dtype=int),
    scales: wp.array(dtype=float),
    distance: wp.array(dtype=float),
):
    """distance (nodes,): signed, clamped to BAND cells. scales[0]: world units per cell. BLOCK^3 items per block of
    nodes, which look at the same faces."""
    item = first + wp.tid()
    shape = crossings.shapes[0]
    ny = block_count(shape[1])
    nz = block_count(shape[2])
    block = item / (BLOCK * BLOCK * BLOCK)
    local = item % (BLOCK * BLOCK * BLOCK)
    i = (block / (ny * nz)) * BLOCK + local / (BLOCK * BLOCK)
    j = ((block / nz) % ny) * BLOCK + (local / BLOCK) % BLOCK
    k = (block % nz) * BLOCK + local % BLOCK
    if i >= shape[0] or j >= shape[1] or k >= shape[2]:
        return
    x = wp.vec3(float(i), float(j), float(k))
    nearest, _face = nearest_face(x, block, counts, near, vertices, faces, boxes)
    found = wp.max(wp.sqrt(nearest) * scales[0], 1.0e-30)  # a node on the cage keeps its side
    distance[(i * shape[1] + j) * shape[2] + k] = wp.where(is_inside(crossings, i, j, k), -found, found)
