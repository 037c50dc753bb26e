"""Pinhole rays and their span inside a box."""

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Pixels of a tile, which has as many threads.
TILE_WIDTH = wp.constant(8)
TILE_HEIGHT = wp.constant(4)
TILE_SIZE = wp.constant(32)


@wp.struct
class PinholeCamera:
    """OpenCV axes; the centre of the first pixel is (0.5, 0.5). Same origin and units as the scene's positions."""

    center: wp.vec3
    rotation: wp.mat33  # camera axes, one per column
    focal: wp.vec2  # pixels
    principal_point: wp.vec2  # pixels
    width: int
    height: int


@wp.func
def image_direction(camera: PinholeCamera, x: float, y: float):
    """Unit direction through a point of the image, pixels from its upper left corner."""
    right = (x - camera.principal_point[0]) / camera.focal[0]
    down = (y - camera.principal_point[1]) / camera.focal[1]
    return wp.normalize(camera.rotation * wp.vec3(right, down, 1.0))


@wp.func
def pixel_direction(camera: PinholeCamera, column: int, row: int):
    """Unit direction through the centre of a pixel."""
    return image_direction(camera, float(column) + 0.5, float(row) + 0.5)


@wp.func
def tile_pixel(n: int, width: int):
    """Column and row of the n-th pixel when a picture is walked tile by tile; the last tiles reach beyond it."""
    tile = n // TILE_SIZE  # one warp of a GPU: its rays lie together and read the same cells
    tiles_per_row = (width + TILE_WIDTH - 1) // TILE_WIDTH
    column = (tile % tiles_per_row) * TILE_WIDTH + n % TILE_WIDTH
    row = (tile // tiles_per_row) * TILE_HEIGHT + (n % TILE_SIZE) // TILE_WIDTH
    return column, row


@wp.func
def strided_pixel(n: int, width: int, height: int, stride: int):
    """(view, row, column) of the n-th of every stride-th row and column of pictures of one size."""
    per_row = (width + stride - 1) // stride
    per_view = per_row * ((height + stride - 1) // stride)
    return wp.vec3i(n // per_view, (n % per_view // per_row) * stride, (n % per_view % per_row) * stride)


@wp.func
def box_span(origin: wp.vec3, direction: wp.vec3, lower: wp.vec3, upper: wp.vec3):
    """Distances (near, far) at which a ray from `origin` is inside a box, near >= 0; (0, -1) where it misses."""
    near = float(0.0)
    far = float(1.0e30)
    for axis in range(3):
        if wp.abs(direction[axis]) > 1.0e-12:
            a = (lower[axis] - origin[axis]) / direction[axis]
            b = (upper[axis] - origin[axis]) / direction[axis]
            near = wp.max(near, wp.min(a, b))
            far = wp.min(far, wp.max(a, b))
        elif origin[axis] < lower[axis] or origin[axis] > upper[axis]:
            far = float(-1.0)
    if near >= far:  # almost along the box's sides both are too large to count steps by
        return wp.vec2(0.0, -1.0)
    return wp.vec2(near, far)


@wp.func
def joined_span(a: wp.vec2, b: wp.vec2):
    """Distances (near, far) that hold two spans of a ray; a span whose far is not beyond its near is none."""
    meets_a = a[0] < a[1]
    meets_b = b[0] < b[1]
    near = wp.min(wp.where(meets_a, a[0], 1.0e30), wp.where(meets_b, b[0], 1.0e30))
    far = wp.max(wp.where(meets_a, a[1], -1.0), wp.where(meets_b, b[1], -1.0))
    return wp.vec2(near, far)
