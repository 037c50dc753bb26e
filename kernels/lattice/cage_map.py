"""Canonical position map of a cage on a lattice, and its look-up at arbitrary points."""

from typing import Any

import warp as wp

from ..core.gradients import forward_only_in, gradient_of
from .nodes import NodeLevels, centered_place

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

forward_only = forward_only_in(__name__, (wp.vec3, wp.vec3))


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


@wp.func(inline=False)  # rare; takes the table alone, as a CageMap would be copied to the stack of every thread
def side_position(sides: wp.array2d(dtype=wp.vec4), entry: int, offset: wp.vec3):
    """Canonical position at a place in a cell with an entry that is not 0: of the side that the place is on."""
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
def nearest_side(sides: wp.array2d(dtype=wp.vec4), entry: int, offset: wp.vec3):
    """Row of `sides` that holds the side on which a place is, in a cell with an entry that is not 0; -1: on none."""
    lowest = float(1.0e30)
    row = int(-1)
    for side in range(entry % 8):
        distance = float(0.0)
        for corner in range(8):
            distance += corner_share(corner, offset) * sides[entry / 8 + side, corner][3]
        if distance < lowest:
            lowest = distance
            row = entry / 8 + side
    return row


@wp.func_native("wp::adj_address(sides, row, corner, slopes, 0, 0, value);")
def add_side_slope(
    sides: wp.array2d(dtype=wp.vec4), slopes: wp.array2d(dtype=wp.vec4), row: int, corner: int, value: wp.vec4
):
    """Add to the gradient of sides[row, corner], where one is asked for."""
    ...


@gradient_of(side_position, wp.vec3)
def grad_side_position(sides: wp.array2d(dtype=wp.vec4), entry: int, offset: wp.vec3, grad: wp.vec3):
    """Slopes by the place and by the positions of its side, at the corners."""
    row = nearest_side(sides, entry, offset)
    if row >= 0:
        slope = wp.vec3(0.0, 0.0, 0.0)
        for corner in range(8):
            value = sides[row, corner]
            along = wp.dot(grad, wp.vec3(value[0], value[1], value[2]))
            ahead = wp.vec3(
                wp.where((corner & 4) != 0, 1.0, 0.0),
                wp.where((corner & 2) != 0, 1.0, 0.0),
                wp.where((corner & 1) != 0, 1.0, 0.0),
            )
            slope += along * wp.vec3(
                (2.0 * ahead[0] - 1.0) * corner_share(corner, wp.vec3(ahead[0], offset[1], offset[2])),
                (2.0 * ahead[1] - 1.0) * corner_share(corner, wp.vec3(offset[0], ahead[1], offset[2])),
                (2.0 * ahead[2] - 1.0) * corner_share(corner, wp.vec3(offset[0], offset[1], ahead[2])),
            )
            share = corner_share(corner, offset)
            add_side_slope(
                sides, wp.adjoint[sides], row, corner, wp.vec4(share * grad[0], share * grad[1], share * grad[2], 0.0)
            )
        wp.adjoint[offset] += slope


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


@wp.func
def map_slope(cage_map: CageMap, x: wp.vec3):
    """Jacobian of a map on a lattice, by central differences over half a cell to each side."""
    h = 0.5 * cage_map.spacing
    inverse = cage_map.inverse_spacing
    dx = map_position(cage_map, x + wp.vec3(h, 0.0, 0.0)) - map_position(cage_map, x - wp.vec3(h, 0.0, 0.0))
    dy = map_position(cage_map, x + wp.vec3(0.0, h, 0.0)) - map_position(cage_map, x - wp.vec3(0.0, h, 0.0))
    dz = map_position(cage_map, x + wp.vec3(0.0, 0.0, h)) - map_position(cage_map, x - wp.vec3(0.0, 0.0, h))
    return inverse * wp.matrix_from_cols(dx, dy, dz)


#: Of Newton's method: steps at most, and the longest step, in cells.
STEPS = wp.constant(24)

LONGEST = wp.constant(2.0)


def make_inverse(map_type: Any, position: Any, slope: Any) -> Any:
    """The function that inverts maps of a type; position, slope: functions of a map and a point."""

    @wp.func
    def inverse_position(backward: map_type, start: wp.vec3, target: wp.vec3, cell: float, close: float):
        """The place near `start` that a map takes to `target`, by Newton's method, up to `close`; or how far it came.
        cell: length in which the map hardly turns."""
        x = start
        off = wp.length(position(backward, x) - target)
        step = int(0)
        while step < STEPS and off > close:
            jacobian = slope(backward, x)
            if wp.abs(wp.determinant(jacobian)) < 1.0e-9:
                break
            move = wp.inverse(jacobian) * (target - position(backward, x))
            length = wp.length(move)
            if length > LONGEST * cell:
                move = move * (LONGEST * cell / length)
            share = float(1.0)  # a shorter step where the whole one does not come nearer
            better = float(0.0)
            for _ in range(6):
                trial = wp.length(position(backward, x + share * move) - target)
                if trial < off:
                    better = share
                    off = trial
                    break
                share *= 0.5
            if better == 0.0:
                break
            x += better * move
            step += 1
        return forward_only(x, target)

    return inverse_position


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


@wp.kernel
def place_nodes(first: int, begin: int, levels: NodeLevels, points: wp.array(dtype=wp.vec3)):
    """points (m,): places of entries of the node list from `begin` on; node units from the middle of the lattice."""
    n = first + wp.tid()
    points[n] = centered_place(levels, levels.nodes[begin + n])


@wp.kernel
def select_vertices(first: int, column: int, values: wp.array(dtype=wp.vec3)):
    """values (v,): channel c is 1 at vertex column + c and 0 at the others."""
    vertex = first + wp.tid()
    selected = wp.vec3(0.0, 0.0, 0.0)
    for c in range(3):
        if vertex == column + c:
            selected[c] = 1.0
    values[vertex] = selected


@wp.kernel
def store_weights(
    first: int,
    begin: int,
    column: int,
    levels: NodeLevels,
    values: wp.array(dtype=wp.vec3),
    weights: wp.array2d(dtype=float),
):
    """Columns column .. column + 2 of weights (m, v) from the values of the nodes listed from `begin` on."""
    n = first + wp.tid()
    value = values[levels.nodes[begin + n]]
    for c in range(3):
        if column + c < weights.shape[1]:
            weights[n, column + c] = value[c]


@wp.kernel
def apply_weights(
    first: int,
    begin: int,
    levels: NodeLevels,
    weights: wp.array2d(dtype=float),
    targets: wp.array(dtype=wp.vec3),
    values: wp.array(dtype=wp.vec3),
):
    """Add sum_j weights[n, j] targets[j] to the value of each node listed from `begin` on."""
    n = first + wp.tid()
    total = wp.vec3(0.0, 0.0, 0.0)
    for j in range(targets.shape[0]):
        total += weights[n, j] * targets[j]
    node = levels.nodes[begin + n]
    values[node] = values[node] + total


@wp.kernel
def sample_weights(
    first: int, column: int, cage_map: CageMap, points: wp.array(dtype=wp.vec3), weights: wp.array2d(dtype=float)
):
    """Columns column .. column + 2 of weights (n, v) by look-up at points (n,). cage_map: has the weights of three
    vertices where others have positions."""
    n = first + wp.tid()
    value = map_position(cage_map, points[n])
    for c in range(3):
        if column + c < weights.shape[1]:
            weights[n, column + c] = value[c]
