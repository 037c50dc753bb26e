"""Batches of a fit: pictures and tiles on the device, tiles with something in them, and pixels in a shuffled order."""

import warp as wp

from ..field.grid import VoxelGrid, empty_distance, grid_ray, sample_beyond, sample_distance, sample_place
from ..view.rays import PinholeCamera, pixel_direction

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.kernel
def mark_active_tiles(
    first: int,
    grid: VoxelGrid,
    cameras: wp.array(dtype=PinholeCamera),
    tile_size: int,
    step: float,
    active: wp.array(dtype=wp.int32),
):
    """active: (tiles,) 1 where any pixel of a tile looks through a cell that holds values: the others have no gradient.
    One item per tile. step: world units from one look at the grid to the next."""
    tile = first + wp.tid()
    width = cameras[0].width
    height = cameras[0].height
    columns = (width + tile_size - 1) // tile_size
    rows = (height + tile_size - 1) // tile_size
    camera = cameras[tile // (rows * columns)]
    found = int(0)
    for n in range(tile_size * tile_size):
        row = (tile // columns) % rows * tile_size + n // tile_size
        column = tile % columns * tile_size + n % tile_size
        if found == 0 and row < height and column < width:
            ray = grid_ray(grid, camera.center, pixel_direction(camera, column, row), step)
            k = ray.first
            while sample_distance(ray, k) < ray.far and found == 0:
                g = sample_place(ray, k)
                empty = empty_distance(grid, g)
                if empty > 0:
                    k = sample_beyond(ray, k, g, empty)
                else:
                    found = int(1)
    active[tile] = found


@wp.struct
class Pictures:
    """Views of one size in one of two precisions; the other array is empty. Premultiplied rgb in [0, 1], then alpha."""

    halves: wp.array3d(dtype=wp.vec4h)  # (views, h, w)
    bytes: wp.array3d(dtype=wp.vec4ub)  # (views, h, w) in 1/255


@wp.func
def picture_pixel(pictures: Pictures, view: int, row: int, column: int):
    """The four numbers of a pixel."""
    value = wp.vec4()
    if pictures.bytes.shape[0] > 0:
        held = pictures.bytes[view, row, column]
        value = wp.vec4(float(held[0]), float(held[1]), float(held[2]), float(held[3])) / 255.0
    else:
        half = pictures.halves[view, row, column]
        value = wp.vec4(float(half[0]), float(half[1]), float(half[2]), float(half[3]))
    return value


ROUNDS = wp.constant(4)

#: Factors of the finaliser, and 2^32 over the golden ratio, which separates the rounds.
FIRST_FACTOR = wp.constant(wp.uint32(0x85EBCA6B))

SECOND_FACTOR = wp.constant(wp.uint32(0xC2B2AE35))

GOLDEN = wp.constant(wp.uint32(0x9E3779B9))


@wp.func
def mixed(value: wp.uint32):
    """All bits of a number mixed into all others."""
    x = value
    x = (x ^ (x >> wp.uint32(16))) * FIRST_FACTOR
    x = (x ^ (x >> wp.uint32(13))) * SECOND_FACTOR
    return x ^ (x >> wp.uint32(16))


@wp.func
def half_bits(count: int):
    """Bits of one half of a Feistel network over at least `count` numbers."""
    bits = int(1)
    while bits < 15 and (1 << (2 * bits)) < count:
        bits += 1
    return bits


@wp.func
def shuffled_place(place: int, count: int, key: int):
    """The item at a place of the shuffled order: a bijection of 0 .. count - 1 for each key. count: up to 2^30."""
    bits = wp.uint32(half_bits(count))
    mask = (wp.uint32(1) << bits) - wp.uint32(1)
    item = wp.uint32(place)
    inside = int(0)
    while inside == 0:
        left = item >> bits
        right = item & mask
        for turn in range(ROUNDS):
            both = (wp.uint32(key) + wp.uint32(turn) * GOLDEN) ^ (right << wp.uint32(8))
            other = left ^ (mixed(both) & mask)
            left = right
            right = other
        item = (left << bits) | right
        if item < wp.uint32(count):
            inside = 1
    return int(item)
