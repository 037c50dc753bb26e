"""How far the rays of a picture's tiles go before they may meet anything."""

import warp as wp

from ..core.gradients import forward_only_in
from ..core.loads import byte_entry, cell_byte, near_reciprocal, near_root
from ..edits.structs import LOOK_SKIP, EditData
from ..field.grid import VoxelGrid, grid_position
from ..view.rays import TILE_SIZE, TILE_WIDTH, PinholeCamera, tile_pixel

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 64})

forward_only = forward_only_in(__name__, (float, wp.vec3), (wp.vec3, wp.vec3), (wp.vec2, wp.vec3))

#: Distance of what is never met.
NEVER = wp.constant(1.0e30)

#: A beam goes through so many cubes at most, as the march waits for the longest.
MOST_CUBES = wp.constant(32)

#: A beam ends by this share of its distance before what it may meet, as float32 rounds.
ROUNDING = wp.constant(3.0e-6)


@wp.struct
class Beam:
    """Rays of a tile among cells of one kind, in whose widths all is measured."""

    start: wp.vec3  # the camera
    low: wp.vec3  # least movement of a ray along each axis per unit of distance
    high: wp.vec3  # and the largest
    inverse_low: wp.vec3  # 1 / low
    inverse_high: wp.vec3
    size: wp.vec3  # number of cells along each axis
    span: wp.vec2  # distances between which some ray may be among the cells; none if the first is above the second


@wp.func
def beam_among(start: wp.vec3, low: wp.vec3, high: wp.vec3, size: wp.vec3):
    """A Beam."""
    beam = Beam()
    beam.start = start
    beam.low = low
    beam.high = high
    beam.size = size
    near = float(0.0)
    far = float(NEVER)
    for axis in range(3):
        beam.inverse_low[axis] = near_reciprocal(low[axis])
        beam.inverse_high[axis] = near_reciprocal(high[axis])
        below = -start[axis]
        above = start[axis] - size[axis]
        if below > 0.0:  # until the fastest ray is there
            near = wp.max(near, wp.where(high[axis] > 0.0, below * beam.inverse_high[axis], NEVER))
        elif high[axis] < 0.0:
            far = wp.min(far, below * beam.inverse_high[axis])
        if above > 0.0:
            near = wp.max(near, wp.where(low[axis] < 0.0, -above * beam.inverse_low[axis], NEVER))
        elif low[axis] > 0.0:
            far = wp.min(far, -above * beam.inverse_low[axis])
    beam.inverse_low = forward_only(beam.inverse_low, low)
    beam.inverse_high = forward_only(beam.inverse_high, high)
    beam.span = forward_only(wp.vec2(near, far), start)
    return beam


@wp.func
def tile_directions(camera: PinholeCamera, tile: int):
    """Least and largest components of the directions of a tile's rays."""
    column, row = tile_pixel(tile * TILE_SIZE, camera.width)
    x = (float(column) + 0.5 - camera.principal_point[0]) / camera.focal[0]
    y = (float(row) + 0.5 - camera.principal_point[1]) / camera.focal[1]
    right = camera.rotation * wp.vec3(1.0 / camera.focal[0], 0.0, 0.0)
    down = camera.rotation * wp.vec3(0.0, 1.0 / camera.focal[1], 0.0)
    first = camera.rotation * wp.vec3(x, y, 1.0)
    low = wp.vec3(1.0, 1.0, 1.0)
    high = -low
    n = int(0)
    while n < TILE_SIZE:
        along = first + float(n % TILE_WIDTH) * right + float(n / TILE_WIDTH) * down
        along = along * near_reciprocal(near_root(wp.dot(along, along)))
        low = wp.min(low, along)
        high = wp.max(high, along)
        n += 1
    return forward_only(low, first), forward_only(high, first)


@wp.func
def middle_cell(beam: Beam, s: float):
    """The cell that is nearest to the middle of a beam at distance s."""
    middle = beam.start + (0.5 * s) * (beam.low + beam.high)
    cell = wp.vec3i()
    for axis in range(3):
        cell[axis] = int(wp.clamp(middle[axis], 0.0, beam.size[axis] - 1.0))
    return cell


@wp.func
def leave_cube(beam: Beam, cell: wp.vec3i, reach: int, s: float):
    """Distance up to which a beam stays in the cells less than `reach` from one, as far as there are cells; 0 if it is
    not in them at distance s."""
    leave = float(NEVER)
    for axis in range(3):
        lower = float(cell[axis] - reach + 1)
        upper = float(cell[axis] + reach)
        up = (upper - beam.start[axis]) * beam.inverse_high[axis]
        down = (lower - beam.start[axis]) * beam.inverse_low[axis]
        if upper < beam.size[axis]:
            leave = wp.where(beam.high[axis] > 0.0, wp.min(leave, up), leave)
            leave = wp.where(beam.start[axis] + s * beam.high[axis] > upper, 0.0, leave)
        if lower > 0.0:
            leave = wp.where(beam.low[axis] < 0.0, wp.min(leave, down), leave)
            leave = wp.where(beam.start[axis] + s * beam.low[axis] < lower, 0.0, leave)
    return leave


@wp.func
def fine_reach(edit: EditData, cell: wp.vec3i):
    """Distance in fine cells from one to the nearest that a march must look at, 0 or less there."""
    bits = edit.fine_bits
    rest = (1 << bits) - 1
    n = (cell[0] >> bits) * edit.node_counts[1] + (cell[1] >> bits)
    n = n * edit.node_counts[2] + (cell[2] >> bits)
    within = ((((cell[0] & rest) << bits) + (cell[1] & rest)) << bits) + (cell[2] & rest)
    return byte_entry(edit.fine_look, (n << (3 * bits)) + within) - LOOK_SKIP


@wp.func
def is_covered(edit: EditData, grid: VoxelGrid, size: wp.vec3):
    """Whether a field's grid lies in an edit's lattice as a whole: places in it are known of the lattice alone."""
    cells = wp.vec3(float(grid.skip.shape[0]), float(grid.skip.shape[1]), float(grid.skip.shape[2]))
    lower = (grid.lower - edit.lower) * edit.inverse_fine_size
    upper = lower + wp.cw_mul(cells, grid.voxel_size) * edit.inverse_fine_size
    return wp.min(lower) >= 0.0 and wp.min(size - upper) >= 0.0


@wp.func
def beam_begin(edit: EditData, grid: VoxelGrid, origin: wp.vec3, low: wp.vec3, high: wp.vec3):
    """Distance from `origin` up to which no ray of a tile can meet anything; NEVER where none meets anything at all."""
    last = edit.last_fine
    size = wp.vec3(float(last[0] + 1), float(last[1] + 1), float(last[2] + 1))
    width = edit.inverse_fine_size
    fine = beam_among((origin - edit.lower) * width, low * width, high * width, size)
    cells = wp.vec3(float(grid.skip.shape[0]), float(grid.skip.shape[1]), float(grid.skip.shape[2]))
    widths = grid.inverse_voxel_size
    plain = beam_among(grid_position(grid, origin), wp.cw_mul(low, widths), wp.cw_mul(high, widths), cells)
    if is_covered(edit, grid, size):
        plain.span = wp.vec2(NEVER, NEVER)
    # a beam that gains a quarter of a cell or less ends
    least = 0.25 / wp.max(wp.max(wp.abs(fine.low)), wp.max(wp.abs(fine.high)))
    s = wp.min(fine.span[0], plain.span[0])
    leave = float(s)
    cubes = int(0)
    while leave < NEVER and leave >= s:
        s = leave
        cubes += 1
        leave = float(NEVER)
        if s < fine.span[0]:
            leave = fine.span[0]
        elif s <= fine.span[1]:
            cell = middle_cell(fine, s)
            reach = fine_reach(edit, cell)
            leave = wp.where(reach > 0, leave_cube(fine, cell, reach, s), 0.0)
        if s < plain.span[0]:
            leave = wp.min(leave, plain.span[0])
        elif s <= plain.span[1]:
            cell = middle_cell(plain, s)
            reach = cell_byte(grid.skip, cell[0], cell[1], cell[2])
            leave = wp.min(leave, wp.where(reach > 0, leave_cube(plain, cell, reach, s), 0.0))
        if leave <= wp.max(s * (1.0 + ROUNDING), s + least) or cubes == MOST_CUBES:
            leave = float(-1.0)
    return forward_only(wp.where(leave < 0.0, s * (1.0 - ROUNDING), NEVER), origin)


@wp.kernel
def find_tile_starts(first: int, grid: VoxelGrid, edit: EditData, camera: PinholeCamera, begins: wp.array(dtype=float)):
    """Distance up to which no ray of a tile meets anything. begins: (tiles,). One item a tile."""
    tile = first + wp.tid()
    low, high = tile_directions(camera, tile)
    begins[tile] = beam_begin(edit, grid, camera.center, low, high)


@wp.kernel
def find_tile_starts_of_edits(
    first: int,
    tiles: int,
    grid: VoxelGrid,
    edits: wp.array(dtype=EditData),
    camera: PinholeCamera,
    begins: wp.array(dtype=float),
):
    """The same for each of several edits by itself. begins: (edits * tiles,). One item a tile, edit by edit."""
    n = first + wp.tid()
    low, high = tile_directions(camera, n % tiles)
    begins[n] = beam_begin(edits[n / tiles], grid, camera.center, low, high)
