"""Rays that several marches follow one after the other, each through a part of the scene."""

import warp as wp

from ..core.gradients import forward_only_in
from ..field.march import pending_color, visible_depth
from ..view.tile_order import TileOrder

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

forward_only = forward_only_in(__name__, (float, wp.vec3), (wp.vec3, wp.vec3))

#: A sample that is longer than CUT_LENGTH in canonical space is cut into at most this many.
MAX_SUB_SAMPLES = wp.constant(16)

#: Samples that weigh less than this are not examined for folds: an 8-bit image does not show them.
FOLD_MIN_WEIGHT = wp.constant(1.0 / 255.0)

#: Matter behind cleared matter that lets less light than this through is not counted as revealed.
FAINT = wp.constant(1.0e-3)


@wp.struct
class MarchOptions:
    """How a scene is marched."""

    step: float  # world units
    inverse_step: float  # 1 / step
    stop: float  # a march ends where less than this share of the light is left
    arc_opacity: int  # 1: optical depth in canonical arc length, 0: sigma dt


@wp.struct
class DeformedRadiance:
    """What a march through a deformed scene gathered along a ray."""

    color: wp.vec3  # sum of w_k c_k, without background
    transmittance: float  # what is left for the background
    depth: float  # sum of w_k t_k
    cleared_transmittance: float  # what the cleared matter would have let through
    reveal: float  # opacity that the cleared matter would have had in front of the rest
    fold: float  # sum of w_k over samples where the map turns over
    outside: float  # number of samples whose map leaves the rest cage


@wp.struct
class Picture:
    """The arrays of a view, (h * w,) each; the masks are those of DeformedRadiance."""

    rgb: wp.array(dtype=wp.vec3)
    alpha: wp.array(dtype=wp.float32)
    depth: wp.array(dtype=wp.float32)
    reveal: wp.array(dtype=wp.float32)
    fold: wp.array(dtype=wp.float32)
    outside: wp.array(dtype=wp.float32)
    order: TileOrder  # in which marches of one edit or of a part of the scene follow its tiles


@wp.func
def fill_pixel(picture: Picture, pixel: int, seen: DeformedRadiance, background: wp.vec3):
    """Write what a march gathered to a pixel."""
    picture.rgb[pixel] = seen.color + seen.transmittance * background
    opacity = 1.0 - seen.transmittance
    picture.alpha[pixel] = opacity
    picture.depth[pixel] = visible_depth(seen.depth, opacity)
    picture.reveal[pixel] = seen.reveal
    picture.fold[pixel] = seen.fold
    picture.outside[pixel] = seen.outside


#: Beyond the end of any ray.
RAY_END = wp.constant(1.0e30)

#: Smallest distance that a ray has reached once it was begun.
BEGUN = wp.constant(1.0e-30)


@wp.struct
class RayState:
    """A ray that a march is to go on with."""

    seen: DeformedRadiance
    pending: float  # weight of samples whose colour is not looked up yet
    reached: float  # distance up to which all is seen, above 0 once a march has followed the ray


@wp.struct
class ScenePart:
    """A part of the scene for one march: from where the ones before it ended up to where a ray leaves a box."""

    lower: wp.vec3  # corners of the box
    upper: wp.vec3
    is_first: int  # 1: nothing was marched before
    is_last: int  # 1: rays are followed to their end, those beside the box too
    # (rays,) each, as three times as many may be more than an array holds; unset for the first and only part
    progress: wp.array(dtype=wp.vec4)  # light that is left, distance reached, light left by what is cleared, pending
    colors: wp.array(dtype=wp.vec4)  # colour and depth; not set before a ray has reached anything
    masks: wp.array(dtype=wp.vec4)  # reveal, fold, outside; likewise


@wp.func
def forward_only_radiance(seen: DeformedRadiance, origin: wp.vec3):
    """What a march gathered, through which no gradient passes."""
    result = seen
    result.color = forward_only(seen.color, origin)
    result.transmittance = forward_only(seen.transmittance, origin)
    result.depth = forward_only(seen.depth, origin)
    result.cleared_transmittance = forward_only(seen.cleared_transmittance, origin)
    result.reveal = forward_only(seen.reveal, origin)
    result.fold = forward_only(seen.fold, origin)
    return result


@wp.func
def ray_start():
    """The state of a ray before its first sample."""
    state = RayState()
    seen = DeformedRadiance()
    seen.transmittance = float(1.0)
    seen.cleared_transmittance = float(1.0)
    state.seen = seen
    return state


@wp.func
def finished(state: RayState):
    """What a finished ray has gathered."""
    seen = state.seen
    seen.color += pending_color(seen.color, seen.transmittance, state.pending)
    return seen


@wp.func
def part_end(part: ScenePart, origin: wp.vec3, direction: wp.vec3):
    """Distance at which a part of the scene ends for a ray; 0 for a ray that misses it."""
    # As view/rays.box_span, but without branches, as a march needs all registers: rays along a face may miss or not.
    end = float(RAY_END)
    if part.is_last == 0:
        inverse = wp.cw_div(wp.vec3(1.0, 1.0, 1.0), direction)  # infinite for rays across an axis
        a = wp.cw_mul(part.lower - origin, inverse)
        b = wp.cw_mul(part.upper - origin, inverse)
        near = wp.max(wp.max(wp.min(a, b)), 0.0)
        far = wp.min(wp.max(a, b))
        end = wp.where(near < far, far, 0.0)
    return end


@wp.func
def ray_state(part: ScenePart, n: int):
    """The state in which the marches before left ray n."""
    state = ray_start()
    if part.is_first == 0:
        progress = part.progress[n]
        if progress[1] > 0.0:
            color = part.colors[n]
            masks = part.masks[n]
            seen = DeformedRadiance()
            seen.transmittance = progress[0]
            seen.cleared_transmittance = progress[2]
            seen.color = wp.vec3(color[0], color[1], color[2])
            seen.depth = color[3]
            seen.reveal = masks[0]
            seen.fold = masks[1]
            seen.outside = masks[2]
            state.seen = seen
            state.pending = progress[3]
            state.reached = progress[1]
    return state


@wp.func
def store_ray(part: ScenePart, n: int, state: RayState):
    """Keep the state of ray n for the marches that follow."""
    seen = state.seen
    part.progress[n] = wp.vec4(seen.transmittance, state.reached, seen.cleared_transmittance, state.pending)
    if state.reached > 0.0:
        part.colors[n] = wp.vec4(seen.color[0], seen.color[1], seen.color[2], seen.depth)
        part.masks[n] = wp.vec4(seen.reveal, seen.fold, seen.outside, 0.0)
