"""What a camera sees of each voxel of a field that edits deform: its colour towards the camera and its optical depth,
evaluated once per view.

A voxel of the rest cage is seen where the pose has taken it, at y with phi(y) = x, from the direction that Eq. 4 of
"Deforming Radiance Fields with Cages" (ECCV 2022) has there: d_c = norm(J (y - o)) with the derivative J of phi and the
camera at o. The direction is found at the nodes of the rest cage's lattice and blended. All other voxels are seen as
they are (field/shades).
Needs: deform/flat_edits, deform/map_nodes, field/grid, field/harmonics, field/shades.
"""

import warp as wp

from ..field.grid import VoxelGrid
from ..field.harmonics import sh_basis
from ..field.shades import ShadedGrid, shade_colour, write_shade
from .flat_edits import FlatEdit
from .map_nodes import node_blend, node_slope, side_slope

wp.set_module_options({"enable_backward": False, "block_dim": 128})


@wp.struct
class AimedCage:
    """A rest cage's lattice with what `aim_nodes` found at its nodes."""

    lower: wp.vec3  # position of node (0, 0, 0)
    inverse_spacing: float
    node_counts: wp.vec3i
    aims: wp.array(dtype=wp.vec4)  # (nodes,) canonical view direction or 0, and signed distance to the rest cage


@wp.kernel
def aim_nodes(
    first: int,
    edit: FlatEdit,
    centre: wp.vec3,
    places: wp.array3d(dtype=wp.vec4),
    aims: wp.array(dtype=wp.vec4),
):
    """Canonical view direction at each node of the rest lattice, 0 where no pose takes it anywhere, and its signed
    distance to the rest cage.

    centre: of the camera. places: of deform/posed_places. aims: one for each of them.
    """
    item = first + wp.tid()
    k = item % places.shape[2]
    j = (item // places.shape[2]) % places.shape[1]
    i = item // (places.shape[2] * places.shape[1])
    place = places[i, j, k]
    along = wp.vec3(0.0, 0.0, 0.0)
    if place[3] > 0.0:
        nz = edit.node_counts[2]
        nyz = edit.node_counts[1] * nz
        seat = wp.vec3(place[0], place[1], place[2])
        cell = wp.vec3i()
        for axis in range(3):
            cell[axis] = wp.min(int(seat[axis]), edit.node_counts[axis] - 2)
        f = seat - wp.vec3(float(cell[0]), float(cell[1]), float(cell[2]))
        rate = seat - (centre - edit.lower) * edit.inverse_spacing
        n = cell[0] * nyz + cell[1] * nz + cell[2]
        slope = node_slope(edit.nodes, n, nyz, nz, f, rate)
        if edit.has_sides == 1:
            entry = edit.side_index[n]
            if entry != 0:
                slope = side_slope(edit.sides, entry, f, rate)
        along = wp.normalize(slope)
    aims[item] = wp.vec4(along[0], along[1], along[2], edit.rest.distance[i, j, k])


@wp.func
def carried_direction(cages: wp.array(dtype=AimedCage), x: wp.vec3, plain: wp.vec3):
    """Direction under which a voxel at x is seen: `plain` where it is in none of the rest cages."""
    along = plain
    for index in range(cages.shape[0]):
        cage = cages[index]
        counts = cage.node_counts
        g = (x - cage.lower) * cage.inverse_spacing
        cell = wp.vec3i(int(wp.floor(g[0])), int(wp.floor(g[1])), int(wp.floor(g[2])))
        if wp.min(cell) >= 0 and cell[0] < counts[0] - 1 and cell[1] < counts[1] - 1 and cell[2] < counts[2] - 1:
            nyz = counts[1] * counts[2]
            f = g - wp.vec3(float(cell[0]), float(cell[1]), float(cell[2]))
            aim = node_blend(cage.aims, cell[0] * nyz + cell[1] * counts[2] + cell[2], nyz, counts[2], f)
            turned = wp.vec3(aim[0], aim[1], aim[2])
            if aim[3] <= 0.0 and wp.length_sq(turned) > 1.0e-6:
                along = wp.normalize(turned)
    return along


@wp.kernel
def shade_carried_rows(
    first: int,
    grid: VoxelGrid,
    nodes: wp.array(dtype=wp.int32),
    cages: wp.array(dtype=AimedCage),
    shaded: ShadedGrid,
):
    """field/shades.shade_rows of a field that edits deform, to the nodes of the rows. One thread per row, in whole warps.

    nodes: (rows,); cages: (edits,) that do not meet; shaded: its shades are those of LaidShades.
    """
    item = first + wp.tid()
    n = wp.min(item, nodes.shape[0] - 1)
    node = nodes[n]
    counts = shaded.columns.node_counts
    k = node % counts[2]
    j = (node // counts[2]) % counts[1]
    i = node // (counts[2] * counts[1])
    row = int(n)
    if shaded.columns.order.shape[0] > 0:
        row = shaded.columns.order[n]
    x = grid.lower + wp.cw_mul(grid.voxel_size, wp.vec3(float(i), float(j), float(k)))
    along = carried_direction(cages, x, wp.normalize(x - shaded.centre))
    colour = shade_colour(grid.sh, row, sh_basis(along))
    if item < nodes.shape[0]:
        write_shade(shaded.shades, node, wp.vec4(colour[0], colour[1], colour[2], grid.density[row] * shaded.step))
