"""Shading of the voxels of a field that edits deform, once per view: colours towards the camera and optical depths."""

import warp as wp

from ..core.gradients import forward_only_in
from ..core.lanes import ballot, grid_place
from ..edits.nodes import node_blend, node_slope, side_slope
from ..field.colors import ShadedGrid, own_row, row_place, shade_color
from ..field.columns import Columns
from ..field.grid import VoxelGrid
from ..field.harmonics import sh_basis
from ..field.outer_bricks import mark_bricks_of_node
from .volume import ALL_LAYERS, CARRIED_LAYER, PLAIN_LAYER, ShadedVolume, write_shaded_volume

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 128})

forward_only = forward_only_in(__name__, (wp.vec3, wp.vec3))

#: A cage is at least this many cells within the border of its lattice (warpcage/lattice/lattice).
LATTICE_MARGIN = wp.constant(2.0)


@wp.struct
class ViewDirectionCage:
    """A rest cage's lattice, the pose of its edit, and what `find_view_directions` found at its nodes."""

    lower: wp.vec3  # position of node (0, 0, 0)
    inverse_spacing: float
    node_counts: wp.vec3i
    distance: wp.array(dtype=float)  # (nodes,) signed distance to the rest cage
    places: wp.array(dtype=wp.vec4)  # (nodes,) where the pose takes each, of edits/inverse
    aims: wp.array(dtype=wp.vec4)  # (nodes,) canonical view direction or 0, and signed distance to the rest cage
    depth: float  # rows up to so deep in the rest cage are read by samples of both layers
    height: float  # and those up to so far out of it
    wall_depth: float  # up to so deep and so far out each layer has a colour of its own
    wall_height: float
    posed_lower: wp.vec3  # of the lattice over the posed cage, as edits/structs has it
    posed_inverse_spacing: float
    posed_counts: wp.vec3i
    posed_nodes: wp.array(dtype=wp.vec4)
    side_index: wp.array(dtype=int)  # or (0,)
    sides: wp.array2d(dtype=wp.vec4)


@wp.kernel
def keep_cage(first: int, cage: ViewDirectionCage, index: int, cages: wp.array(dtype=ViewDirectionCage)):
    """Put a cage into an array: an argument takes the host less time than a copy. One item."""
    cages[first + wp.tid() + index] = cage


@wp.kernel
def find_view_directions(first: int, cages: wp.array(dtype=ViewDirectionCage), center: wp.vec3):
    """Canonical view direction at each node of each rest lattice, 0 where no pose takes it anywhere, and its signed
    distance to the rest cage: the aims of each cage. centre: of the camera. One item a node, cage by cage."""
    n = first + wp.tid()
    index = int(0)
    size = cages[0].places.shape[0]
    while n >= size:
        n -= size
        index += 1
        size = cages[index].places.shape[0]
    cage = cages[index]
    place = cage.places[n]
    along = wp.vec3(0.0, 0.0, 0.0)
    if place[3] > 0.0:
        counts = cage.posed_counts
        nz = counts[2]
        nyz = counts[1] * nz
        seat = wp.vec3(place[0], place[1], place[2])
        cell = wp.vec3i()
        for axis in range(3):
            cell[axis] = wp.min(int(seat[axis]), counts[axis] - 2)
        f = seat - wp.vec3(float(cell[0]), float(cell[1]), float(cell[2]))
        rate = seat - (center - cage.posed_lower) * cage.posed_inverse_spacing
        corner = cell[0] * nyz + cell[1] * nz + cell[2]
        slope = node_slope(cage.posed_nodes, corner, nyz, nz, f, rate)
        entry = int(0)
        if cage.side_index.shape[0] > 0:
            entry = cage.side_index[corner]
        if entry != 0:
            slope = side_slope(cage.sides, entry, f, rate)
        along = wp.normalize(slope)
    cage.aims[n] = wp.vec4(along[0], along[1], along[2], cage.distance[n])


@wp.struct
class RowView:
    """How a row is seen."""

    along: wp.vec3  # canonical view direction
    carried: int  # 1: it lies in a rest cage
    is_plain: int  # 1: samples of the plain layer may read it
    is_carried: int  # 1: and those of the other one
    is_wall: int  # 1: and the two see it differently


@wp.func
def aim_at(cage: ViewDirectionCage, g: wp.vec3):
    """Blended aims at node coordinates g among the nodes: direction of any length, and signed distance."""
    counts = cage.node_counts
    cell = wp.vec3i()
    for axis in range(3):
        cell[axis] = wp.min(int(g[axis]), counts[axis] - 2)
    f = g - wp.vec3(float(cell[0]), float(cell[1]), float(cell[2]))
    nyz = counts[1] * counts[2]
    return node_blend(cage.aims, cell[0] * nyz + cell[1] * counts[2] + cell[2], nyz, counts[2], f)


@wp.func
def row_view(cages: wp.array(dtype=ViewDirectionCage), x: wp.vec3, plain: wp.vec3):
    """How a row at x is seen: by the pose of the rest cage that it is in, else from `plain`."""
    seen = RowView()
    seen.along = plain
    seen.is_plain = int(1)
    for index in range(cages.shape[0]):
        cage = cages[index]
        g = (x - cage.lower) * cage.inverse_spacing
        top = wp.vec3(float(cage.node_counts[0] - 1), float(cage.node_counts[1] - 1), float(cage.node_counts[2] - 1))
        away = wp.length(g - wp.max(wp.min(g, top), wp.vec3(0.0, 0.0, 0.0)))
        if away == 0.0:
            aim = aim_at(cage, g)
            turned = wp.vec3(aim[0], aim[1], aim[2])
            seen.is_plain = wp.where(aim[3] < -cage.depth, 0, seen.is_plain)
            seen.is_carried = wp.where(aim[3] < cage.height, 1, seen.is_carried)
            seen.is_wall = wp.where(aim[3] > -cage.wall_depth and aim[3] < cage.wall_height, 1, seen.is_wall)
            if aim[3] <= 0.0:
                seen.carried = 1
                if wp.length_sq(turned) > 1.0e-6:
                    seen.along = wp.normalize(turned)
        elif away + LATTICE_MARGIN < cage.wall_height * cage.inverse_spacing:
            seen.is_wall = int(1)
    seen.along = forward_only(seen.along, x)
    return seen


@wp.func
def nearest_view(cages: wp.array(dtype=ViewDirectionCage), x: wp.vec3, plain: wp.vec3):
    """How a row at x, not far out of a rest cage, would be seen if it moved with what lies just in the cage."""
    along = plain
    least = float(1.0e30)
    for index in range(cages.shape[0]):
        cage = cages[index]
        g = (x - cage.lower) * cage.inverse_spacing
        top = wp.vec3(float(cage.node_counts[0] - 1), float(cage.node_counts[1] - 1), float(cage.node_counts[2] - 1))
        near = wp.max(wp.min(g, top), wp.vec3(0.0, 0.0, 0.0))
        aim = aim_at(cage, near)
        away = aim[3] + wp.length(g - near) / cage.inverse_spacing
        if away < least:
            least = away
            slope = wp.vec3(0.0, 0.0, 0.0)
            for axis in range(3):
                ahead = near
                behind = near
                ahead[axis] = wp.min(near[axis] + 0.5, top[axis])
                behind[axis] = wp.max(near[axis] - 0.5, 0.0)
                slope[axis] = aim_at(cage, ahead)[3] - aim_at(cage, behind)[3]
            within = near - wp.normalize(slope) * (aim[3] * cage.inverse_spacing + 0.75)
            aim = aim_at(cage, wp.max(wp.min(within, top), wp.vec3(0.0, 0.0, 0.0)))
            turned = wp.vec3(aim[0], aim[1], aim[2])
            if wp.length_sq(turned) > 1.0e-6:
                along = wp.normalize(turned)
    return forward_only(along, x)


@wp.kernel
def mark_shaded_bricks(
    first: int,
    grid: VoxelGrid,
    columns: Columns,
    nodes: wp.array(dtype=wp.int32),
    cages: wp.array(dtype=ViewDirectionCage),
    marks: wp.array4d(dtype=wp.int32),
):
    """1 in the marks (layers, bricks along each axis) of those to which `shade_carried_rows` writes. One item a row."""
    node = nodes[first + wp.tid()]
    seen = row_view(cages, row_place(grid, columns.node_counts, node), wp.vec3(0.0, 0.0, 0.0))
    i, j, k = grid_place(node, columns.node_counts[1], columns.node_counts[2])
    if seen.is_plain == 1 or seen.is_wall == 1:
        mark_bricks_of_node(marks, PLAIN_LAYER, i, j, k)
    if seen.is_carried == 1 or seen.is_wall == 1:
        mark_bricks_of_node(marks, CARRIED_LAYER, i, j, k)


#: With more registers too few warps wait for rows.
MAX_REGISTERS = 64


@wp.kernel(cuda_max_registers=MAX_REGISTERS)
def shade_carried_rows(
    first: int,
    grid: VoxelGrid,
    nodes: wp.array(dtype=wp.int32),
    cages: wp.array(dtype=ViewDirectionCage),
    shaded: ShadedGrid,
    laid: ShadedVolume,
):
    """Colors of rows, in the layers of samples that may read them; rows near a rest cage have a colour for samples on
    either side of it, each in its layer. A thread per row, in whole warps."""
    # nodes: (rows,); cages: (edits,) that do not meet; shaded: holds the camera and the length of a step
    item = first + wp.tid()
    n = wp.min(item, nodes.shape[0] - 1)
    row = own_row(shaded, n)
    x = row_place(grid, shaded.columns.node_counts, nodes[n])
    plain = wp.normalize(x - shaded.center)
    seen = row_view(cages, x, plain)
    own_layer = 1 << wp.where(seen.carried == 1, CARRIED_LAYER, PLAIN_LAYER)
    layers = (seen.is_plain << PLAIN_LAYER) | (seen.is_carried << CARRIED_LAYER)
    if seen.is_wall == 1:
        layers &= own_layer
    color = shade_color(grid.sh, grid.halves, row, sh_basis(seen.along))
    if item < nodes.shape[0]:
        shade = wp.vec4(color[0], color[1], color[2], grid.density[row] * shaded.step)
        write_shaded_volume(laid, nodes[n], layers, shade)
    if ballot(seen.is_wall) != 0:  # a warp reads its rows together
        along = plain
        if seen.is_wall == 1 and seen.carried == 0:
            along = nearest_view(cages, x, plain)
        color = shade_color(grid.sh, grid.halves, row, sh_basis(along))
        if item < nodes.shape[0] and seen.is_wall == 1:
            shade = wp.vec4(color[0], color[1], color[2], grid.density[row] * shaded.step)
            write_shaded_volume(laid, nodes[n], ALL_LAYERS - own_layer, shade)
