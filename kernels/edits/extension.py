"""The lattice map of an edit, faded to the identity towards walls of its cage that do not move."""

import warp as wp

from ..coordinates.mean_value import mean_value_position
from ..core.gradients import forward_only_in
from ..core.lanes import grid_place
from ..lattice.cage_map import CageMap, cell_sides, map_position
from ..lattice.nodes import CELL_DIAGONAL
from ..mesh.containment import triangle_distance_squared
from ..mesh.triangle import Walls, faded_position, nearest_barycentric
from .cell_tables import jacobian_spread, largest_stretch, mat83, mean_jacobian
from .structs import CELL_CARRIES, CELL_FOLDED, CELL_INSIDE, CELL_STEEP, CUT_LENGTH, LatticeEdit

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

forward_only = forward_only_in(__name__, (wp.vec3, wp.vec3))

#: Most steps of the search for a place that the map leads to a given point.
MAX_STEPS = wp.constant(12)


@wp.struct
class WallMap:
    """Both cages of a posed edit, and its map on the lattice."""

    posed: wp.array(dtype=wp.vec3)  # (v,) vertices of the posed cage
    rest: wp.array(dtype=wp.vec3)  # (v,) of the rest cage
    faces: wp.array(dtype=wp.vec3i)
    posed_fans: wp.array(dtype=wp.vec4)  # see mesh/fans
    rest_fans: wp.array(dtype=wp.vec4)
    posed_size: float  # longest side
    rest_size: float
    plain: CageMap  # the map before it fades
    walls: Walls  # it fades towards them


@wp.func(inline=False)  # the closed form is long, and slow enough that a call does not matter
def cage_position(
    x: wp.vec3,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    size: float,
):
    """coordinates/mean_value.mean_value_position."""
    return mean_value_position(x, vertices, faces, fans, targets, size)


@wp.func(inline=False)
def wall_offset(walls: WallMap, x: wp.vec3):
    """phi(q) - g(q) at the point q of the posed cage nearest to x."""
    nearest = float(1.0e30)
    chosen = int(0)
    for f in range(walls.faces.shape[0]):
        face = walls.faces[f]
        squared = triangle_distance_squared(x, walls.posed[face[0]], walls.posed[face[1]], walls.posed[face[2]])
        if squared < nearest:
            nearest = squared
            chosen = f
    face = walls.faces[chosen]
    share = nearest_barycentric(
        wp.vec3d(walls.posed[face[0]] - x), wp.vec3d(walls.posed[face[1]] - x), wp.vec3d(walls.posed[face[2]] - x)
    )
    q = wp.vec3(0.0, 0.0, 0.0)
    flat = wp.vec3(0.0, 0.0, 0.0)
    for corner in range(3):
        q += wp.float32(share[corner]) * walls.posed[face[corner]]
        flat += wp.float32(share[corner]) * walls.rest[face[corner]]
    offset = map_position(walls.plain, q) - flat
    if not wp.isfinite(wp.length_sq(offset)):  # a face without area
        return forward_only(wp.vec3(0.0, 0.0, 0.0), x)
    return forward_only(offset, x)


@wp.func
def continued_position(walls: WallMap, x: wp.vec3):
    """psi(x): where a point outside the posed cage comes from."""
    mapped = cage_position(x, walls.posed, walls.faces, walls.posed_fans, walls.rest, walls.posed_size)
    return faded_position(walls.walls, x, mapped + wall_offset(walls, x))


@wp.func
def forward_position(walls: WallMap, y: wp.vec3):
    """F(y), nearly the inverse of psi: the mean value map from the rest cage to the posed one."""
    return cage_position(y, walls.rest, walls.faces, walls.rest_fans, walls.posed, walls.rest_size)


@wp.kernel
def map_forwards(first: int, walls: WallMap, points: wp.array(dtype=wp.vec3), places: wp.array(dtype=wp.vec3)):
    """F at points (n,)."""
    n = first + wp.tid()
    places[n] = forward_position(walls, points[n])


@wp.kernel
def find_places(
    first: int,
    walls: WallMap,
    points: wp.array(dtype=wp.vec3),
    enough: float,
    offsets: wp.array(dtype=wp.vec3),
    errors: wp.array(dtype=float),
):
    """How far from F(y) the place x is that psi leads to points y (n,) beside the rest cage, and how far from y psi
    leads at last, world units; the search ends where that is less than `enough`."""
    n = first + wp.tid()
    y = points[n]
    goal = forward_position(walls, y)
    x = goal  # x <- x + F(y) - F(psi(x)) from here on; the best of all x is kept
    best = goal
    error = float(1.0e30)
    step = int(0)
    while step < MAX_STEPS and error > enough:
        reached = continued_position(walls, x)
        off = wp.length(reached - y)
        if off < error:
            error = off
            best = x
        if error > enough:
            x += goal - forward_position(walls, reached)
        step += 1
    offsets[n] = best - goal
    errors[n] = error


@wp.kernel
def carry_nodes(
    first: int,
    walls: WallMap,
    lower: wp.vec3,
    spacing: float,
    distance: wp.array3d(dtype=float),
    marks: wp.array3d(dtype=wp.uint8),
    positions: wp.array3d(dtype=wp.vec3),
):
    """psi at the nodes of a lattice at corners of marked cells; those in the rings of the map (lattice/nodes) keep what
    they have. Node (0, 0, 0) is at `lower`. One item per node."""
    i, j, k = grid_place(first + wp.tid(), distance.shape[1], distance.shape[2])
    if distance[i, j, k] / spacing < CELL_DIAGONAL:
        return
    found = bool(False)
    for c in range(8):
        a = i - (c >> 2)
        b = j - ((c >> 1) & 1)
        d = k - (c & 1)
        if a >= 0 and b >= 0 and d >= 0 and a < marks.shape[0] and b < marks.shape[1] and d < marks.shape[2]:
            found = found or marks[a, b, d] != wp.uint8(0)
    if found:
        positions[i, j, k] = continued_position(walls, lower + spacing * wp.vec3(float(i), float(j), float(k)))


@wp.kernel
def pad_nodes(
    first: int,
    cage_map: CageMap,
    before: wp.vec3i,
    positions: wp.array3d(dtype=wp.vec3),
    distance: wp.array3d(dtype=float),
    side_index: wp.array(dtype=int),
):
    """A map's nodes in a larger lattice, `before` of whose nodes lie below the map's along each axis, the others far
    outside the cage. side_index: (nodes,), or (0,) for a map without sides."""
    n = first + wp.tid()
    i, j, k = grid_place(n, positions.shape[1], positions.shape[2])
    a = i - before[0]
    b = j - before[1]
    c = k - before[2]
    shape = cage_map.distance.shape
    position = wp.vec3(0.0, 0.0, 0.0)
    nearest = 4.0 * cage_map.spacing
    entry = int(0)
    if a >= 0 and b >= 0 and c >= 0 and a < shape[0] and b < shape[1] and c < shape[2]:
        position = cage_map.positions[a, b, c]
        nearest = cage_map.distance[a, b, c]
        if side_index.shape[0] > 0:
            entry = cage_map.side_index[(a * shape[1] + b) * shape[2] + c]
    positions[i, j, k] = position
    distance[i, j, k] = nearest
    if side_index.shape[0] > 0:
        side_index[n] = entry


@wp.kernel
def mark_boxes(
    first: int,
    low: wp.array(dtype=wp.vec3i),
    high: wp.array(dtype=wp.vec3i),
    depth: int,
    marks: wp.array3d(dtype=wp.uint8),
):
    """1 at the cells of boxes (n,), from the first cell to the last; boxes may overlap, so that the CPU takes one
    thread. `depth` items per box, each for one layer of at most so many."""
    item = first + wp.tid()
    n = item / depth
    i = low[n][0] + item % depth
    if i > high[n][0]:
        return
    for j in range(low[n][1], high[n][1] + 1):
        for k in range(low[n][2], high[n][2] + 1):
            marks[i, j, k] = wp.uint8(1)


@wp.kernel
def mark_carrying_cells(
    first: int, edit: LatticeEdit, marks: wp.array3d(dtype=wp.uint8), cells: wp.array3d(dtype=wp.uint8)
):
    """CELL_CARRIES at marked cells, and what else holds there, but for those wholly in the cage or at a narrow gap of
    it. `cells` holds the flags of edits/cell_tables.mark_edit_cases. One item per cell."""
    i, j, k = grid_place(first + wp.tid(), cells.shape[1], cells.shape[2])
    if marks[i, j, k] == wp.uint8(0):
        return
    if (int(cells[i, j, k]) & CELL_INSIDE) != 0 or cell_sides(edit.deformed, i, j, k) != 0:
        return
    corners = mat83()
    for c in range(8):
        corners[c] = edit.deformed.positions[i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1)]
    flags = CELL_CARRIES
    jacobian = mean_jacobian(corners) * edit.deformed.inverse_spacing
    if wp.determinant(jacobian) <= 0.0:
        flags = flags | CELL_FOLDED
    spread = jacobian_spread(corners, edit.deformed.spacing * jacobian) * edit.deformed.inverse_spacing
    if largest_stretch(jacobian) + spread > CUT_LENGTH:
        flags = flags | CELL_STEEP
    cells[i, j, k] = wp.uint8(flags)


#: Corners of cells with a point in the cage are no farther from it than this, in cells.
FAR_CELLS = wp.constant(2.0)


@wp.func
def node_position(cage_map: CageMap, i: int, j: int, k: int):
    """Position of a node, relative to the map's origin."""
    return cage_map.lower + cage_map.spacing * wp.vec3(float(i), float(j), float(k))


@wp.kernel
def fade_nodes(first: int, cage_map: CageMap, walls: Walls, positions: wp.array3d(dtype=wp.vec3)):
    """The faded map at each node, but for those that no look-up in the cage takes in."""
    i, j, k = grid_place(first + wp.tid(), positions.shape[1], positions.shape[2])
    mapped = cage_map.positions[i, j, k]
    if cage_map.distance[i, j, k] < FAR_CELLS * cage_map.spacing:
        mapped = faded_position(walls, node_position(cage_map, i, j, k), mapped)
    positions[i, j, k] = mapped


@wp.kernel
def fade_sides(first: int, cage_map: CageMap, walls: Walls, sides: wp.array2d(dtype=wp.vec4)):
    """The faded map at the corners of the cell above each node, for each side that the cell has."""
    n = first + wp.tid()
    entry = cage_map.side_index[n]
    if entry == 0:
        return
    shape = cage_map.positions.shape
    i, j, k = grid_place(n, shape[1], shape[2])
    for side in range(entry % 8):
        row = entry / 8 + side
        for corner in range(8):
            x = node_position(cage_map, i + (corner >> 2), j + ((corner >> 1) & 1), k + (corner & 1))
            old = cage_map.sides[row, corner]
            new = faded_position(walls, x, wp.vec3(old[0], old[1], old[2]))
            sides[row, corner] = wp.vec4(new[0], new[1], new[2], old[3])
