"""Views of a deformed voxel field whose edits are looked up on lattices, and the lattice cells that they may skip.

"Deforming Radiance Fields with Cages" (ECCV 2022), section 4.1 (the map on a lattice) and Eq. 5. See deformed_march for
the march and cage_edits for the map.
Siblings: cage_edits, cage_map, deformed_march, grid, rays, volume_render (and, to spread the marks, grid_skip).
"""

import warp as wp

from .cage_edits import CELL_STAYS, LatticeEdit, in_rest_cage
from .cage_map import cell_sides
from .deformed_march import DeformedRadiance, MarchOptions, lattice_lower, lattice_upper, march_deformed
from .grid import VoxelGrid, empty_distance, grid_position
from .grid_skip import SKIP_LIMIT
from .rays import PinholeCamera, pixel_direction, tile_pixel
from .volume_render import DEPTH_MIN_ALPHA

wp.set_module_options({"enable_backward": False})


@wp.func
def visible_depth(seen: DeformedRadiance):
    """Expected distance along the ray, inf where next to nothing is seen."""
    opacity = 1.0 - seen.transmittance
    return wp.where(opacity > DEPTH_MIN_ALPHA, seen.depth / wp.max(opacity, DEPTH_MIN_ALPHA), wp.inf)


@wp.struct
class Picture:
    """Where a view goes, (h * w,) each; the masks are those of DeformedRadiance."""

    rgb: wp.array(dtype=wp.vec3)
    alpha: wp.array(dtype=wp.float32)
    depth: wp.array(dtype=wp.float32)
    reveal: wp.array(dtype=wp.float32)
    fold: wp.array(dtype=wp.float32)
    outside: wp.array(dtype=wp.float32)


@wp.func
def fill_pixel(picture: Picture, pixel: int, seen: DeformedRadiance, background: wp.vec3):
    """Write what a march saw to a pixel."""
    picture.rgb[pixel] = seen.colour + seen.transmittance * background
    picture.alpha[pixel] = 1.0 - seen.transmittance
    picture.depth[pixel] = visible_depth(seen)
    picture.reveal[pixel] = seen.reveal
    picture.fold[pixel] = seen.fold
    picture.outside[pixel] = seen.outside


@wp.kernel
def render_edits(
    first: int,
    grid: VoxelGrid,
    edits: wp.array(dtype=LatticeEdit),
    camera: PinholeCamera,
    background: wp.vec3,
    options: MarchOptions,
    picture: Picture,
):
    """One thread a pixel, tile by tile."""
    column, row = tile_pixel(first + wp.tid(), camera.width)
    if column < camera.width and row < camera.height:
        seen = march_deformed(edits, grid, camera.centre, pixel_direction(camera, column, row), options)
        fill_pixel(picture, row * camera.width + column, seen, background)


@wp.func
def grid_is_empty(grid: VoxelGrid, centre: wp.vec3, half: wp.vec3):
    """Whether a box is certainly empty in the canonical grid."""
    g = grid_position(grid, centre)
    reach = wp.cw_mul(half, grid.inverse_voxel_size)
    needed = float(0.0)
    nearest = wp.vec3(0.0, 0.0, 0.0)
    for axis in range(3):
        top = float(grid.skip.shape[axis])
        if g[axis] + reach[axis] < 0.0 or g[axis] - reach[axis] > top:
            return True  # beside the grid
        nearest[axis] = wp.clamp(g[axis], 0.5, top - 0.5)
        needed = wp.max(needed, reach[axis] + wp.abs(g[axis] - nearest[axis]))
    return float(empty_distance(grid, nearest)) > needed + 1.0


@wp.func
def scene_is_empty(
    edits: wp.array(dtype=LatticeEdit), edit_count: int, grid: VoxelGrid, centre: wp.vec3, half: wp.vec3
):
    """Whether a box is certainly empty in the scene that the first `edit_count` edits leave."""
    e = edit_count - 1
    while e >= 0:
        edit = edits[e]
        lower = lattice_lower(edit)
        upper = lattice_upper(edit)
        beside = bool(False)
        within = bool(True)
        for axis in range(3):
            if centre[axis] + half[axis] < lower[axis] or centre[axis] - half[axis] > upper[axis]:
                beside = True
            if centre[axis] - half[axis] < lower[axis] or centre[axis] + half[axis] > upper[axis]:
                within = False
        if not beside:
            if not within:
                return False  # partly in the edit's box: too rare to look closer
            g = (centre - lower) * edit.deformed.inverse_spacing
            i = wp.clamp(int(wp.floor(g[0])), 0, edit.skip.shape[0] - 1)
            j = wp.clamp(int(wp.floor(g[1])), 0, edit.skip.shape[1] - 1)
            k = wp.clamp(int(wp.floor(g[2])), 0, edit.skip.shape[2] - 1)
            return float(edit.skip[i, j, k]) > wp.max(half) * edit.deformed.inverse_spacing + 1.0
        e -= 1
    return grid_is_empty(grid, centre, half)


@wp.kernel
def mark_edit_cells(
    first: int,
    grid: VoxelGrid,
    edits: wp.array(dtype=LatticeEdit),
    edit_index: int,
    step: float,
    marks: wp.array3d(dtype=wp.uint8),
):
    """0 at the lattice cells of an edit in which a march must look, SKIP_LIMIT at the others.

    The trilinear image of a cell lies in the bounding box of its eight corners' canonical positions; the scene beneath
    (canonical grid and earlier edits, whose `skip` must be ready) is asked whether that box is empty. `step`:
    sub-samples reach half a march step out of the cell. Cells that the map sends out of the rest cage are looked at, to
    be counted.
    """
    n = first + wp.tid()
    k = n % marks.shape[2]
    j = (n // marks.shape[2]) % marks.shape[1]
    i = n // (marks.shape[2] * marks.shape[1])
    edit = edits[edit_index]
    nearest = float(1.0e30)
    farthest = float(-1.0e30)
    for c in range(8):
        distance = edit.deformed.distance[i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1)]
        nearest = wp.min(nearest, distance)
        farthest = wp.max(farthest, distance)
    empty = bool(True)
    if edit.removes == 0 and nearest <= edit.tolerance:
        empty = cell_sides(edit.deformed, i, j, k) == 0
        stays = (int(edit.cells[i, j, k]) & CELL_STAYS) != 0
        lower = wp.vec3(1.0e30, 1.0e30, 1.0e30)
        upper = -lower
        for c in range(8):
            position = edit.deformed.positions[i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1)]
            lower = wp.min(lower, position)
            upper = wp.max(upper, position)
            if empty and not stays:
                empty = in_rest_cage(edit, position, edit.slack)
        reach = 0.5 * (1.0 + step * edit.deformed.inverse_spacing)
        empty = empty and scene_is_empty(edits, edit_index, grid, 0.5 * (lower + upper), reach * (upper - lower))
    if edit.removes == 1 or farthest > edit.tolerance:
        h = 0.5 * edit.deformed.spacing
        centre = edit.deformed.lower + edit.deformed.spacing * wp.vec3(float(i) + 0.5, float(j) + 0.5, float(k) + 0.5)
        empty = empty and scene_is_empty(edits, edit_index, grid, centre, wp.vec3(h, h, h))
    marks[i, j, k] = wp.uint8(wp.where(empty, SKIP_LIMIT, 0))
