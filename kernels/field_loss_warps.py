"""The photometric gradient of field_loss, for CUDA: one warp a ray, one lane a coefficient.

The same sums as field_loss.accumulate_photometric_gradient, which says what they are. Densities of 32 samples in a row
are looked up at once, one a lane; then the samples that hold matter are taken one by one, and the 27 coefficients of a
voxel are read, and their gradients added, by 27 neighbouring lanes: a voxel's row is one run of memory instead of 27
scattered numbers. (Lanes for coefficients: Plenoxels 2022, in its CUDA code.)
Siblings: field_loss, grid, rays, spherical_harmonics, volume_render. Uses warp shuffles: CUDA only.
"""

import warp as wp

from .field_loss import MIN_OPACITY, TrainingRays, batch_pixel
from .grid import VoxelGrid, cell_density, cell_sample, empty_distance, grid_position
from .rays import pixel_direction
from .spherical_harmonics import sh_basis
from .volume_render import exit_distance, grid_span, sample_index_after

wp.set_module_options({"enable_backward": False})

LANES = wp.constant(32)
COEFFICIENTS = wp.constant(27)
#: Numbers of a gradient row: 27 coefficients, red first, then the density.
GRADIENT_ROW = wp.constant(28)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __shfl_sync(0xffffffffu, value, lane);
#else
    return value;  // never launched there
#endif
""")
def from_lane(value: wp.float32, lane: wp.int32) -> wp.float32:
    """The value that another lane of the warp holds."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return (int)__ballot_sync(0xffffffffu, flag);
#else
    return flag;
#endif
""")
def ballot(flag: wp.int32) -> wp.int32:
    """Bit i is set where lane i has a flag."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ffs(bits) - 1;
#else
    return 0;
#endif
""")
def lowest_bit(bits: wp.int32) -> wp.int32: ...


@wp.func_native("""
    return (int)((unsigned int)bits & ((unsigned int)bits - 1u));
""")
def without_lowest_bit(bits: wp.int32) -> wp.int32: ...


@wp.func
def sum_before(value: float, lane: int):
    """Sum of the values of the lanes before this one."""
    total = float(value)
    for i in range(5):
        other = from_lane(total, wp.max(lane - (1 << i), 0))
        if lane >= (1 << i):
            total += other
    return total - value


@wp.func
def channel_sum(value: float, lane: int, channel: int):
    """Sum over the nine lanes of a channel, in each of them."""
    b = lane - 9 * channel
    ninth = from_lane(value, wp.min(9 * channel + 8, 31))
    total = float(value)
    for i in range(3):
        reach = 4 >> i
        other = from_lane(total, wp.min(lane + reach, 31))
        if b < reach:
            total += other
    return from_lane(total + ninth, wp.min(9 * channel, 31))


@wp.func
def over_channels(value: float):
    """Sum of what the first lanes of red, green and blue hold."""
    return from_lane(value, 0) + from_lane(value, 9) + from_lane(value, 18)


@wp.func
def pick(v: wp.vec3, channel: int):
    return wp.where(channel == 0, v[0], wp.where(channel == 1, v[1], v[2]))


# few registers: many rays in flight hide the latency of their loads
@wp.kernel(launch_bounds=(128, 6))
def accumulate_photometric_gradient_by_warps(
    first: int,
    grid: VoxelGrid,
    coefficients: wp.array2d(dtype=wp.float32),
    rays: TrainingRays,
    background: wp.vec3,
    random_background: int,
    jitter: int,
    seed: int,
    step: float,
    stop: float,
    scale: float,
    spread: float,
    gradients: wp.array2d(dtype=wp.float32),
    squared_error: wp.array(dtype=wp.float32),
):
    """As field_loss.accumulate_photometric_gradient, 32 items a ray, in blocks of 128.

    coefficients: (rows, 27), grid.sh as numbers. gradients: (rows, 28), coefficients, then density.
    """
    item = first + wp.tid()
    n = item // LANES
    lane = item % LANES
    pixel = batch_pixel(rays, n)
    if pixel[1] >= rays.pixels.shape[1] or pixel[2] >= rays.pixels.shape[2]:
        if lane == 0:
            squared_error[n] = 0.0
        return
    channel = wp.min(lane // 9, 3)
    camera = rays.cameras[pixel[0]]
    direction = pixel_direction(camera, pixel[2], pixel[1])
    random = wp.rand_init(seed, n)
    behind = background
    if random_background == 1:
        behind = wp.vec3(wp.randf(random), wp.randf(random), wp.randf(random))
    origin = camera.centre
    if jitter == 1:
        origin += (wp.randf(random) - 0.5) * step * direction
    rgba = rays.pixels[pixel[0], pixel[1], pixel[2]]
    seen = wp.vec3(float(rgba[0]), float(rgba[1]), float(rgba[2]))
    opacity = float(rgba[3])
    own_behind = pick(behind, channel)
    own_target = pick(seen, channel) + (1.0 - opacity) * own_behind
    own_surface = pick(seen, channel) / wp.max(opacity, MIN_OPACITY)
    pull = spread * scale * opacity

    basis = float(0.0)
    all_basis = sh_basis(direction)
    for b in range(9):
        if lane - 9 * channel == b and lane < COEFFICIENTS:
            basis = all_basis[b]
    g0 = grid_position(grid, origin)
    dg = wp.cw_mul(direction, grid.inverse_voxel_size)
    span = grid_span(grid, origin, direction)

    colour = float(0.0)  # of this lane's channel
    apart = float(0.0)  # sum of w |c - surface colour|^2 of this lane's channel
    slope = float(0.0)  # dL/dC of this lane's channel
    later = float(0.0)  # the part of the loss's first-order change that comes from behind the current sample
    transmittance = float(1.0)
    march = int(0)
    while march < 2:
        transmittance = float(1.0)
        k = sample_index_after(span[0], step)
        while (float(k) + 0.5) * step < span[1] and transmittance > stop:
            t = (float(k) + 0.5) * step
            g = g0 + t * dg
            empty = empty_distance(grid, g)
            if empty > 0:
                k = wp.max(k + 1, sample_index_after(t + exit_distance(g, dg, empty), step))
            else:
                # density of 32 samples, one a lane
                own_t = (float(k + lane) + 0.5) * step
                own_g = g0 + own_t * dg
                depth = float(0.0)
                if own_t < span[1] and empty_distance(grid, own_g) == 0:
                    depth = wp.max(cell_density(grid, cell_sample(grid, own_g)), 0.0) * step
                before = transmittance * wp.exp(-sum_before(depth, lane))
                alpha = 1.0 - wp.exp(-depth)
                matter = ballot(wp.where(depth > 0.0 and before > stop, 1, 0))
                transmittance = from_lane(before * (1.0 - alpha), 31)
                while matter != 0:
                    j = lowest_bit(matter)
                    matter = without_lowest_bit(matter)
                    cell = cell_sample(grid, g0 + (float(k + j) + 0.5) * step * dg)
                    left = from_lane(before, j)
                    weight = left * from_lane(alpha, j)
                    value = float(0.0)
                    if lane < COEFFICIENTS:
                        for c in range(8):
                            if cell.rows[c] >= 0:
                                value += cell.weights[c] * coefficients[cell.rows[c], lane]
                    raw = channel_sum(basis * value, lane, channel) + 0.5
                    radiance = wp.max(raw, 0.0)
                    off = radiance - own_surface
                    if march == 0:
                        colour += weight * radiance
                        apart += weight * off * off
                    else:
                        change = over_channels(radiance * slope + pull * off * off)
                        later -= weight * change
                        grad = step * ((left - weight) * change - later)
                        if lane < COEFFICIENTS:
                            grad = wp.where(raw > 0.0, weight * (slope + 2.0 * pull * off) * basis, 0.0)
                        if lane < GRADIENT_ROW:
                            for c in range(8):
                                if cell.rows[c] >= 0:
                                    wp.atomic_add(gradients, cell.rows[c], lane, cell.weights[c] * grad)
                k += LANES
        if march == 0:
            error = colour + transmittance * own_behind - own_target
            slope = 2.0 * scale * error
            later = over_channels((colour + transmittance * own_behind) * slope + pull * apart)
            total = over_channels(error * error)
            if lane == 0:
                squared_error[n] = total
        march += 1
