"""Where the views of deformed scenes go.

Needs: deform/march, field/render.
"""

import warp as wp

from ..field.render import DEPTH_MIN_ALPHA
from .march import DeformedRadiance

wp.set_module_options({"enable_backward": False})


@wp.func
def visible_depth(seen: DeformedRadiance):
    """Expected distance along the ray, inf where almost nothing is seen."""
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
