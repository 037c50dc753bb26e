"""Sparse voxel grid: trilinear density and spherical-harmonic colour at arbitrary points."""

import warp as wp

from ..core.gradients import forward, forward_only_in
from ..view.rays import box_span
from .columns import eight_rows
from .harmonics import COLOR_OF_ROW, sh_basis, vec16

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

eight_weights = wp.types.vector(length=8, dtype=wp.float32)

forward_only = forward_only_in(__name__, (eight_weights, wp.vec3))

#: Samples of a ray that float32 can count; rays that meet nothing begin beyond them.
MAX_SAMPLES = wp.constant(8388608.0)

#: Where in its step a sample of any march is, as a share of the step: 0.5 is the middle.
SAMPLE_PLACE = wp.constant(0.5)

#: How far the parts of a sample that is cut are from it at most, in steps.
PART_REACH = wp.constant(max(SAMPLE_PLACE, 1.0 - SAMPLE_PLACE))


def blended_row(numbers: str, number: str) -> str:
    """C++ that makes c of the numbers of eight rows, each in its weight, added up. numbers: the array; number: the n-th
    of a `row` of it. Both widths are known while compiling."""
    return f"""
    const int width = {numbers}.shape[1];
    float c[27];
    for (int n = 0; n < 27; ++n)
        c[n] = 0.0f;
    for (int corner = 0; corner < 8; ++corner)
        if (rows.c[corner] >= 0)
        {{
            const float weight = weights.c[corner];
            const auto* row = {numbers}.data + (size_t)rows.c[corner] * width;
#if defined(__CUDA_ARCH__)
            if (width == 24 && sizeof(row[0]) == 4 && ((size_t){numbers}.data & 15) == 0)  // a quarter of the reads
                #pragma unroll
                for (int n = 0; n < 24; n += 4)
                {{
                    const float4 four = reinterpret_cast<const float4*>(row)[n / 4];
                    c[n] += weight * four.x;
                    c[n + 1] += weight * four.y;
                    c[n + 2] += weight * four.z;
                    c[n + 3] += weight * four.w;
                }}
            else
#endif
            if (width == 24)
                for (int n = 0; n < 24; ++n)
                    c[n] += weight * {number};
            else
                for (int n = 0; n < 27; ++n)
                    c[n] += weight * {number};
        }}
"""


#: C++ that goes on to the colour.
SHIFTED_COLOR = (
    COLOR_OF_ROW
    + """
    return wp::vec_t<3, wp::float32>(red + 0.5f, green + 0.5f, blue + 0.5f);
"""
)


@wp.struct
class VoxelGrid:
    lower: wp.vec3  # position of node (0, 0, 0)
    voxel_size: wp.vec3
    inverse_voxel_size: wp.vec3
    links: wp.array3d(dtype=wp.int32)  # row of a node, or -1; none where field/columns has them
    skip: wp.array3d(dtype=wp.uint8)  # cell -> Chebyshev distance in cells to the nearest that holds anything, 0 there
    density: wp.array(dtype=wp.float32)  # (rows,) per world unit
    sh: wp.array2d(dtype=wp.float32)  # (rows, 24 or 27) numbers of field/harmonics, without gaps
    halves: wp.array2d(dtype=wp.float16)  # or the same as halves, on CUDA, where `sh` has no rows


@wp.struct
class CellSample:
    """Rows and trilinear weights of the eight nodes of the cell around a point; corner c is at (c&4, c&2, c&1)."""

    rows: eight_rows
    weights: eight_weights


@wp.func
def grid_position(grid: VoxelGrid, x: wp.vec3):
    """Node coordinates (voxel units) of a point."""
    return wp.cw_mul(x - grid.lower, grid.inverse_voxel_size)


@wp.func
def cell_below(g: wp.vec3):
    """(i, j, k) of the cell that holds node coordinates g."""
    return int(wp.floor(g[0])), int(wp.floor(g[1])), int(wp.floor(g[2]))


@wp.func
def cell_sample(grid: VoxelGrid, g: wp.vec3):
    """Rows and weights around node coordinates g; all rows are -1 outside the grid."""
    result = CellSample()
    i, j, k = cell_below(g)
    inside = (
        i >= 0
        and j >= 0
        and k >= 0
        and i < grid.links.shape[0] - 1
        and j < grid.links.shape[1] - 1
        and k < grid.links.shape[2] - 1
    )
    fx = g[0] - float(i)
    fy = g[1] - float(j)
    fz = g[2] - float(k)
    for c in range(8):
        di = c >> 2
        dj = (c >> 1) & 1
        dk = c & 1
        row = int(-1)
        if inside:
            row = grid.links[i + di, j + dj, k + dk]
        wx = wp.where(di == 1, fx, 1.0 - fx)
        wy = wp.where(dj == 1, fy, 1.0 - fy)
        wz = wp.where(dk == 1, fz, 1.0 - fz)
        result.rows[c] = row
        result.weights[c] = wx * wy * wz
    result.weights = forward_only(result.weights, g)
    return result


@wp.func
def cell_density(grid: VoxelGrid, cell: CellSample):
    """Trilinear density before the ReLU."""
    sigma = float(0.0)
    for c in range(8):
        if cell.rows[c] >= 0:
            sigma += cell.weights[c] * grid.density[cell.rows[c]]
    return sigma


@forward.func_native(blended_row("sh", "row[n]") + SHIFTED_COLOR)
def blended_color(sh: wp.array2d(dtype=wp.float32), rows: eight_rows, weights: eight_weights, basis: vec16) -> wp.vec3:
    """basis . (sum of weight times row) + 0.5."""
    ...


@wp.func
def cell_color(grid: VoxelGrid, cell: CellSample, basis: vec16):
    """SH colour before the clamp at zero, of a grid whose numbers are single."""
    return blended_color(grid.sh, cell.rows, cell.weights, basis)


@forward.func_native(blended_row("halves", "wp::half_to_float(row[n])") + SHIFTED_COLOR)
def blended_halves(
    halves: wp.array2d(dtype=wp.float16), rows: eight_rows, weights: eight_weights, basis: vec16
) -> wp.vec3:
    """`blended_color` of rows of halves."""
    ...


@wp.func
def stored_color(grid: VoxelGrid, cell: CellSample, basis: vec16):
    """SH colour before the clamp at zero."""
    if grid.halves.shape[0] > 0:
        return blended_halves(grid.halves, cell.rows, cell.weights, basis)
    return cell_color(grid, cell, basis)


@wp.func
def stored_number(grid: VoxelGrid, row: int, number: int):
    """One number of a row's harmonics."""
    if grid.halves.shape[0] > 0:
        return float(grid.halves[row, number])
    return grid.sh[row, number]


@wp.func
def empty_distance(grid: VoxelGrid, g: wp.vec3):
    """Chebyshev distance in cells from the cell of g to the nearest cell that holds anything; 1 outside the grid."""
    i, j, k = cell_below(g)
    if i < 0 or j < 0 or k < 0 or i >= grid.skip.shape[0] or j >= grid.skip.shape[1] or k >= grid.skip.shape[2]:
        return int(1)
    return int(grid.skip[i, j, k])


@wp.kernel
def sample_field(
    first: int,
    grid: VoxelGrid,
    origin: wp.vec3,
    points: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    rgb: wp.array(dtype=wp.vec3),
    density: wp.array(dtype=wp.float32),
):
    """Colour and density at points (n,) seen along directions (n,) of any length. origin: the grid's origin among the
    points."""
    n = first + wp.tid()
    cell = cell_sample(grid, grid_position(grid, points[n] - origin))
    basis = sh_basis(wp.normalize(directions[n]))
    rgb[n] = wp.max(stored_color(grid, cell, basis), wp.vec3(0.0, 0.0, 0.0))
    density[n] = wp.max(cell_density(grid, cell), 0.0)


@wp.func
def grid_span(grid: VoxelGrid, origin: wp.vec3, direction: wp.vec3):
    """Distances (near, far) at which a ray is among the grid's nodes."""
    cells = wp.vec3(float(grid.skip.shape[0]), float(grid.skip.shape[1]), float(grid.skip.shape[2]))
    return box_span(origin, direction, grid.lower, grid.lower + wp.cw_mul(cells, grid.voxel_size))


@wp.func
def exit_distance(g: wp.vec3, dg: wp.vec3, reach: int):
    """How far a ray at node coordinates g, moving by dg per unit, stays in the cells within reach - 1 of its own."""
    leave = float(1.0e30)
    for axis in range(3):
        if wp.abs(dg[axis]) > 1.0e-12:
            cell = wp.floor(g[axis])
            plane = wp.where(dg[axis] > 0.0, cell + float(reach), cell - float(reach) + 1.0)
            leave = wp.min(leave, (plane - g[axis]) / dg[axis])
    return leave


@wp.func
def safe_inverse(rate: wp.vec3):
    """1 / rate by component; a large number where the rate is almost zero."""
    result = wp.vec3(1.0e30, 1.0e30, 1.0e30)
    for axis in range(3):
        if wp.abs(rate[axis]) > 1.0e-12:
            result[axis] = 1.0 / rate[axis]
    return result


@wp.func
def exit_of_cell(offset: wp.vec3, inverse_rate: wp.vec3, reach: int):
    """exit_distance from an offset in a cell, 0 to 1, with the divisions done once per ray."""
    leave = float(1.0e30)
    for axis in range(3):
        plane = wp.where(inverse_rate[axis] > 0.0, float(reach), 1.0 - float(reach))
        way = (plane - offset[axis]) * inverse_rate[axis]
        leave = wp.where(way < leave, way, leave)  # a CPU takes less time for it than for min
    return leave


@wp.func
def steps_to_sample(k: float):
    """Distance along a ray to sample k, in steps. cpp/cpu_samples.h has this and first_sample in C++."""
    return k + SAMPLE_PLACE


@wp.func
def first_sample(steps: float):
    """The first sample at or beyond a distance, in steps."""
    return wp.ceil(steps - SAMPLE_PLACE)


@wp.func
def sample_index_after(t: float, step: float):
    """Index of the first sample at or beyond distance t, at most MAX_SAMPLES."""
    return int(wp.min(first_sample(t / step), MAX_SAMPLES))


@wp.struct
class GridRay:
    """A ray through a grid, in steps."""

    start: wp.vec3  # node coordinates of its origin
    slope: wp.vec3  # node coordinates per unit of distance
    step: float
    far: float  # distance at which it leaves the grid
    first: int  # the first sample in the grid


@wp.func
def grid_ray(grid: VoxelGrid, origin: wp.vec3, direction: wp.vec3, step: float):
    """From an origin along a unit direction; step: world units."""
    ray = GridRay()
    ray.start = grid_position(grid, origin)
    ray.slope = wp.cw_mul(direction, grid.inverse_voxel_size)
    ray.step = step
    span = grid_span(grid, origin, direction)
    ray.far = span[1]
    ray.first = sample_index_after(span[0], step)
    return ray


@wp.func
def sample_distance(ray: GridRay, k: int):
    """From the ray's origin to sample k, world units."""
    return steps_to_sample(float(k)) * ray.step


@wp.func
def sample_place(ray: GridRay, k: int):
    """Node coordinates of sample k."""
    return ray.start + sample_distance(ray, k) * ray.slope


@wp.func
def sample_beyond(ray: GridRay, k: int, g: wp.vec3, empty: int):
    """The first sample after k, at node coordinates g, that is not among the cells within empty - 1 of its own."""
    return wp.max(k + 1, sample_index_after(sample_distance(ray, k) + exit_distance(g, ray.slope, empty), ray.step))
