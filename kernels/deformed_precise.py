"""Points and views of a deformed scene without a lattice: mean value or Green coordinates evaluated at every sample.

The "precise" mode of "Deforming Radiance Fields with Cages" (ECCV 2022), section 5.3. The same functions as in
deformed_points and deformed_render on ClosedFormEdit; a module of its own, so that it is compiled only when it is used.

Positions are exact everywhere. Lattices help only to do without work whose result is known: which cells are certainly
inside or outside a cage, and which certainly show nothing.
Siblings: cage_edits, cage_map, deformed_march, deformed_points, deformed_render, edit_cells, grid, rays.
"""

import warp as wp

from .cage_edits import (
    CELL_FOLDED,
    CELL_INSIDE,
    CELL_OUTSIDE,
    CELL_STAYS,
    CELL_STEEP,
    ClosedFormEdit,
    LatticeEdit,
)
from .cage_map import CageMap, cell_sides
from .deformed_march import MarchOptions, march_deformed
from .deformed_points import canonical_ray
from .deformed_render import Picture, fill_pixel
from .edit_cells import jacobian_spread, largest_stretch, mat83, mean_jacobian
from .grid import VoxelGrid
from .rays import PinholeCamera, pixel_direction, tile_pixel

# small blocks: rays of one end at very different times
wp.set_module_options({"enable_backward": False, "block_dim": 64})

#: Half the diagonal of a cell: no point in it is farther from the nearest corner.
HALF_DIAGONAL = wp.constant(0.8661)


@wp.func
def settled_case(cage_map: CageMap, i: int, j: int, k: int, slack: float):
    """CELL_INSIDE or CELL_OUTSIDE where no point of a lattice cell can be on the other side of the cage, else 0.

    Distances at nodes are exact up to their limit, and change by no more than the way between two points; outside means
    farther than `slack`.
    """
    nearest = float(1.0e30)
    farthest = float(-1.0e30)
    for c in range(8):
        distance = cage_map.distance[i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1)]
        nearest = wp.min(nearest, distance)
        farthest = wp.max(farthest, distance)
    reach = HALF_DIAGONAL * cage_map.spacing
    if nearest > reach + slack:
        return CELL_OUTSIDE
    if farthest < -reach:
        return CELL_INSIDE
    return int(0)


@wp.kernel
def settle_rest_cells(first: int, rest: CageMap, slack: float, flags: wp.array3d(dtype=wp.uint8)):
    """The settled_case of each cell of a lattice over the rest cage."""
    n = first + wp.tid()
    k = n % flags.shape[2]
    j = (n // flags.shape[2]) % flags.shape[1]
    i = n // (flags.shape[2] * flags.shape[1])
    flags[i, j, k] = wp.uint8(settled_case(rest, i, j, k, slack))


@wp.kernel
def settle_deformed_cells(first: int, edit: LatticeEdit, flags: wp.array3d(dtype=wp.uint8)):
    """The settled_case of each cell over the deformed cage, and what the lattice's map says of the inside ones.

    CELL_STAYS as the lattice has it; CELL_STEEP where it may be; CELL_FOLDED where the map may turn over somewhere.
    """
    n = first + wp.tid()
    k = n % flags.shape[2]
    j = (n // flags.shape[2]) % flags.shape[1]
    i = n // (flags.shape[2] * flags.shape[1])
    case = settled_case(edit.deformed, i, j, k, edit.tolerance)
    if case == 0:
        case = CELL_STEEP | CELL_FOLDED
    elif case == CELL_INSIDE and edit.removes == 0:
        case = case | (int(edit.cells[i, j, k]) & (CELL_STAYS | CELL_STEEP))
        corners = mat83()
        for c in range(8):
            corners[c] = edit.deformed.positions[i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1)]
        jacobian = mean_jacobian(corners)
        stretch = largest_stretch(jacobian)
        spread = jacobian_spread(corners, jacobian)
        if cell_sides(edit.deformed, i, j, k) != 0 or wp.determinant(jacobian) <= 6.0 * stretch * stretch * spread:
            case = case | CELL_FOLDED
    flags[i, j, k] = wp.uint8(case)


@wp.kernel
def map_points_precisely(
    first: int,
    edits: wp.array(dtype=ClosedFormEdit),
    origin: wp.vec3,
    points: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    dt: float,
    canonical_points: wp.array(dtype=wp.vec3),
    canonical_directions: wp.array(dtype=wp.vec3),
    region: wp.array(dtype=wp.int32),
    outside: wp.array(dtype=wp.uint8),
):
    """As deformed_points.map_points."""
    n = first + wp.tid()
    ray = canonical_ray(edits, points[n] - origin, directions[n], dt)
    canonical_points[n] = ray.point + origin
    canonical_directions[n] = ray.direction
    region[n] = ray.region
    outside[n] = wp.uint8(ray.outside)


@wp.kernel
def render_precisely(
    first: int,
    grid: VoxelGrid,
    edits: wp.array(dtype=ClosedFormEdit),
    camera: PinholeCamera,
    background: wp.vec3,
    options: MarchOptions,
    picture: Picture,
):
    """As deformed_render.render_edits."""
    column, row = tile_pixel(first + wp.tid(), camera.width)
    if column < camera.width and row < camera.height:
        seen = march_deformed(edits, grid, camera.centre, pixel_direction(camera, column, row), options)
        fill_pixel(picture, row * camera.width + column, seen, background)
