"""Canonical position map of a cage on a lattice, and its look-up at arbitrary points."""

# The map x -> sum_j w_j(x) v_j from deformed to canonical space (Joshi et al. 2007, section 3; "Deforming Radiance
# Fields with Cages", ECCV 2022, section 4.1) is stored at nodes and interpolated trilinearly. It is linear in the
# weights, so interpolating positions is the same as interpolating weights and summing afterwards.
#
# Node (i, j, k) lies at lower + (i, j, k) * spacing, in world units relative to any origin that the caller keeps to.
# `distance` is the signed distance to the cage the lattice is built on, negative inside, exact at nodes nearer than 4 *
# spacing and clamped to that elsewhere. `positions` hold at inside nodes and at the rings of nodes around them that
# look-up near the cage takes in. Cells at narrow gaps of the cage have corner values for each side (see
# side_values.py).

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.struct
class CageMap:
    lower: wp.vec3  # position of node (0, 0, 0)
    spacing: float
    inverse_spacing: float
    positions: wp.array3d(dtype=wp.vec3)  # canonical position of each node
    distance: wp.array3d(dtype=float)  # signed distance, negative inside, clamped to +-4 spacings
    side_index: wp.array(dtype=int)  # (nodes,) 8 * first row of `sides` + rows, of the cell beyond a node; or (0,)
    sides: wp.array2d(dtype=wp.vec4)  # (rows, 8) position and signed distance at a cell's corners, as one side has them


@wp.func
def map_distance(cage_map: CageMap, x: wp.vec3):
    """Trilinear signed distance at a point, negative inside; 4 * spacing outside the lattice."""
    g = (x - cage_map.lower) * cage_map.inverse_spacing
    i = int(wp.floor(g[0]))
    j = int(wp.floor(g[1]))
    k = int(wp.floor(g[2]))
    distance = 4.0 * cage_map.spacing
    if (
        i >= 0
        and j >= 0
        and k >= 0
        and i < cage_map.distance.shape[0] - 1
        and j < cage_map.distance.shape[1] - 1
        and k < cage_map.distance.shape[2] - 1
    ):
        fx = g[0] - float(i)
        fy = g[1] - float(j)
        fz = g[2] - float(k)
        d00 = wp.lerp(cage_map.distance[i, j, k], cage_map.distance[i, j, k + 1], fz)
        d01 = wp.lerp(cage_map.distance[i, j + 1, k], cage_map.distance[i, j + 1, k + 1], fz)
        d10 = wp.lerp(cage_map.distance[i + 1, j, k], cage_map.distance[i + 1, j, k + 1], fz)
        d11 = wp.lerp(cage_map.distance[i + 1, j + 1, k], cage_map.distance[i + 1, j + 1, k + 1], fz)
        distance = wp.lerp(wp.lerp(d00, d01, fy), wp.lerp(d10, d11, fy), fx)
    return distance


@wp.func
def corner_share(corner: int, offset: wp.vec3):
    """Trilinear weight of a corner of a cell at a place in it, 0 to 1; highest bit of `corner`: axis 0."""
    wi = wp.where((corner & 4) != 0, offset[0], 1.0 - offset[0])
    wj = wp.where((corner & 2) != 0, offset[1], 1.0 - offset[1])
    wk = wp.where((corner & 1) != 0, offset[2], 1.0 - offset[2])
    return wi * wj * wk


@wp.func
def cell_sides(cage_map: CageMap, i: int, j: int, k: int):
    """Entry of `side_index` for a cell: 0 where the positions at its corners hold for all of it."""
    if cage_map.side_index.shape[0] == 0:
        return int(0)
    return cage_map.side_index[(i * cage_map.positions.shape[1] + j) * cage_map.positions.shape[2] + k]


@wp.func(inline=False)  # rare
def side_position(sides: wp.array2d(dtype=wp.vec4), entry: int, offset: wp.vec3):
    """Canonical position at a place in a cell with an entry that is not 0: of the side that the place is on."""
    # Of a CageMap it takes the table alone: the whole struct would be copied to the stack of every thread.
    lowest = float(1.0e30)
    position = wp.vec3(0.0, 0.0, 0.0)
    for side in range(entry % 8):
        total = wp.vec4(0.0, 0.0, 0.0, 0.0)
        for corner in range(8):
            total += corner_share(corner, offset) * sides[entry / 8 + side, corner]
        if total[3] < lowest:
            lowest = total[3]
            position = wp.vec3(total[0], total[1], total[2])
    return position


@wp.func
def map_position(cage_map: CageMap, x: wp.vec3):
    """Trilinear canonical position of a point; valid where map_distance is negative. Clamped to the lattice's cells."""
    g = (x - cage_map.lower) * cage_map.inverse_spacing
    i = wp.clamp(int(wp.floor(g[0])), 0, cage_map.positions.shape[0] - 2)
    j = wp.clamp(int(wp.floor(g[1])), 0, cage_map.positions.shape[1] - 2)
    k = wp.clamp(int(wp.floor(g[2])), 0, cage_map.positions.shape[2] - 2)
    fx = g[0] - float(i)
    fy = g[1] - float(j)
    fz = g[2] - float(k)
    entry = cell_sides(cage_map, i, j, k)
    if entry != 0:
        return side_position(cage_map.sides, entry, wp.vec3(fx, fy, fz))
    p00 = wp.lerp(cage_map.positions[i, j, k], cage_map.positions[i, j, k + 1], fz)
    p01 = wp.lerp(cage_map.positions[i, j + 1, k], cage_map.positions[i, j + 1, k + 1], fz)
    p10 = wp.lerp(cage_map.positions[i + 1, j, k], cage_map.positions[i + 1, j, k + 1], fz)
    p11 = wp.lerp(cage_map.positions[i + 1, j + 1, k], cage_map.positions[i + 1, j + 1, k + 1], fz)
    return wp.lerp(wp.lerp(p00, p01, fy), wp.lerp(p10, p11, fy), fx)


@wp.kernel
def sample_map(
    first: int,
    cage_map: CageMap,
    points: wp.array(dtype=wp.vec3),
    positions: wp.array(dtype=wp.vec3),
    distance: wp.array(dtype=float),
):
    """Canonical positions (n,) and signed distances (n,) at points (n,)."""
    n = first + wp.tid()
    positions[n] = map_position(cage_map, points[n])
    distance[n] = map_distance(cage_map, points[n])
