"""Pictures of four numbers per pixel, in 16 or 8 bits each: what the losses compare with."""

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


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
