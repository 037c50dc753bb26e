"""Samples along a ray through a sparse voxel grid, and the jump over its empty cells."""

# Sample k of a ray lies at t_k = (k + 1/2) dt from its origin whatever box it enters, so that two marches over one
# space sample the same points. Empty cells are left by their distance to filled ones (field/skip).

import warp as wp

from ..view.rays import box_span
from .grid import VoxelGrid, grid_position

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func
def grid_span(grid: VoxelGrid, origin: wp.vec3, direction: wp.vec3):
    """Distances (near, far) at which a ray is among the grid's nodes."""
    cells = wp.vec3(float(grid.links.shape[0] - 1), float(grid.links.shape[1] - 1), float(grid.links.shape[2] - 1))
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
def sample_index_after(t: float, step: float):
    """Index of the first sample at or beyond distance t."""
    return int(wp.ceil(t / step - 0.5))


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
    return (float(k) + 0.5) * ray.step


@wp.func
def sample_place(ray: GridRay, k: int):
    """Node coordinates of sample k."""
    return ray.start + sample_distance(ray, k) * ray.slope


@wp.func
def sample_beyond(ray: GridRay, k: int, g: wp.vec3, empty: int):
    """The first sample after k, at node coordinates g, that is not among the cells within empty - 1 of its own."""
    return wp.max(k + 1, sample_index_after(sample_distance(ray, k) + exit_distance(g, ray.slope, empty), ray.step))
