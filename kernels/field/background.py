"""Background layers around a voxel grid: what a ray meets behind everything that the grid holds."""

# Multi-sphere images as in Fridovich-Keil and Yu et al., "Plenoxels" (CVPR 2022), section 3.3, in the max norm:
# concentric cubes, layer l of L magnified by L' / (L' - l), L' = L - 1, even in inverse distance, the first around the
# grid, the last opaque at infinity. A ray meets each where it leaves it: C = sum_l T_l (1 - exp(-max(0, tau_l))) c_l,
# without view-dependent colours. Values live at the 6 side^2 + 2 lattice points of a cube's surface, (i, j, k) in [0,
# side]^3 with one of them 0 or side: no seams. Positions are relative to the cubes' centre, in world units.

import warp as wp

from ..core.gradients import forward_only_in
from ..view.rays import PinholeCamera, box_span, pixel_direction, tile_pixel

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

forward_only = forward_only_in(__name__, (wp.vec3, wp.vec3), (wp.vec4, wp.vec3))

#: A ray ends where this share of the light is left.
OPAQUE_TRANSMITTANCE = wp.constant(1.0e-4)


@wp.struct
class BackgroundLayers:
    """Layers around a grid; positions are relative to their centre."""

    half: float  # half side of the innermost cube, world units
    side: int  # cells along an edge of a cube
    values: wp.array2d(dtype=wp.vec4)  # (layers, 6 side^2 + 2): red, green, blue, optical depth


@wp.struct
class LayerSample:
    """Nodes and bilinear weights around a point of a layer."""

    met: int  # 0: the ray passes by
    nodes: wp.vec4i
    weights: wp.vec4


@wp.func
def surface_node(side: int, node: wp.vec3i):
    """Number of a lattice point of a cube's surface: the two faces across x first, then the rest
    of those across y, then of those across z."""
    i = node[0]
    j = node[1]
    k = node[2]
    width = side + 1
    inner = side - 1
    number = int(0)
    if i == 0 or i == side:
        number = j * width + k
        if i == side:
            number += width * width
    elif j == 0 or j == side:
        number = 2 * width * width + (i - 1) * width + k
        if j == side:
            number += inner * width
    else:
        number = 2 * width * width + 2 * inner * width + (i - 1) * inner + j - 1
        if k == side:
            number += inner * inner
    return number


@wp.func
def surface_place(side: int, number: int):
    """The lattice point that surface_node numbers."""
    width = side + 1
    inner = side - 1
    rest = number
    if rest < 2 * width * width:
        top = rest // (width * width)
        rest -= top * width * width
        return wp.vec3i(top * side, rest // width, rest % width)
    rest -= 2 * width * width
    if rest < 2 * inner * width:
        top = rest // (inner * width)
        rest -= top * inner * width
        return wp.vec3i(1 + rest // width, top * side, rest % width)
    rest -= 2 * inner * width
    top = rest // (inner * inner)
    rest -= top * inner * inner
    return wp.vec3i(1 + rest // inner, 1 + rest % inner, top * side)


@wp.func
def on_surface(side: int, node: wp.vec3i):
    """Whether a lattice point lies on the surface of a cube."""
    result = bool(False)
    for axis in range(3):
        if node[axis] == 0 or node[axis] == side:
            result = True
    return result


@wp.func
def surface_sample(side: int, point: wp.vec3):
    """Nodes and weights where the ray from the centre to a point leaves a cube."""
    result = LayerSample()
    # the face: the axis of the largest coordinate
    axis = int(0)
    for other in range(1, 3):
        if wp.abs(point[other]) > wp.abs(point[axis]):
            axis = other
    p = point / wp.abs(point[axis])
    b = (axis + 1) % 3
    c = (axis + 2) % 3
    u = wp.clamp(0.5 * (p[b] + 1.0), 0.0, 1.0) * float(side)
    v = wp.clamp(0.5 * (p[c] + 1.0), 0.0, 1.0) * float(side)
    ui = wp.min(int(u), side - 1)
    vi = wp.min(int(v), side - 1)
    fu = u - float(ui)
    fv = v - float(vi)
    for corner_index in range(4):
        du = corner_index >> 1
        dv = corner_index & 1
        node = wp.vec3i()
        node[axis] = wp.where(p[axis] > 0.0, side, 0)
        node[b] = ui + du
        node[c] = vi + dv
        result.nodes[corner_index] = surface_node(side, node)
        result.weights[corner_index] = wp.where(du == 1, fu, 1.0 - fu) * wp.where(dv == 1, fv, 1.0 - fv)
    result.weights = forward_only(result.weights, point)
    result.met = 1
    return result


@wp.func
def layer_sample(layers: BackgroundLayers, layer: int, origin: wp.vec3, direction: wp.vec3):
    """Where a ray leaves a layer."""
    last = layers.values.shape[0] - 1
    shrink = float(last - layer) / (float(last) * layers.half)  # 1 / half side
    p = direction
    if layer < last:
        corner = wp.vec3(1.0, 1.0, 1.0) / shrink
        span = box_span(origin, direction, -corner, corner)
        if span[0] >= span[1]:
            return LayerSample()
        p = origin + span[1] * direction
    return surface_sample(layers.side, p)


@wp.func
def layer_value(layers: BackgroundLayers, layer: int, sample: LayerSample):
    """Colour and optical depth, bilinear."""
    value = wp.vec4()
    for corner in range(4):
        value += sample.weights[corner] * layers.values[layer, sample.nodes[corner]]
    return value


@wp.func
def layer_kept(layers: BackgroundLayers, layer: int, value: wp.vec4):
    """Share of the light that passes a layer."""
    return wp.where(layer < layers.values.shape[0] - 1, wp.exp(-wp.max(value[3], 0.0)), 0.0)


@wp.func
def background_color(layers: BackgroundLayers, origin: wp.vec3, direction: wp.vec3):
    """What a ray sees of the layers."""
    color = wp.vec3()
    transmittance = float(1.0)
    for layer in range(layers.values.shape[0]):
        if transmittance > OPAQUE_TRANSMITTANCE:
            sample = layer_sample(layers, layer, origin, direction)
            if sample.met == 1:
                value = layer_value(layers, layer, sample)
                kept = layer_kept(layers, layer, value)
                color += transmittance * (1.0 - kept) * wp.vec3(value[0], value[1], value[2])
                transmittance *= kept
    return forward_only(color, direction)


@wp.kernel
def sample_background(
    first: int,
    layers: BackgroundLayers,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    rgb: wp.array(dtype=wp.vec3),
):
    """Colours (n,) along rays from origins (n,) in unit directions (n,)."""
    n = first + wp.tid()
    rgb[n] = background_color(layers, origins[n], directions[n])


@wp.kernel
def add_background(
    first: int,
    layers: BackgroundLayers,
    camera: PinholeCamera,
    alpha: wp.array(dtype=wp.float32),
    rgb: wp.array(dtype=wp.vec3),
):
    """Put the layers behind a picture on black of opacity `alpha`, (h * w,) both. A thread per pixel, tile by tile."""
    column, row = tile_pixel(first + wp.tid(), camera.width)
    if column < camera.width and row < camera.height:
        n = row * camera.width + column
        left = 1.0 - alpha[n]
        if left > OPAQUE_TRANSMITTANCE:
            rgb[n] = rgb[n] + left * background_color(layers, camera.center, pixel_direction(camera, column, row))


@wp.kernel
def refine_layers(first: int, coarse: BackgroundLayers, fine_side: int, values: wp.array2d(dtype=wp.vec4)):
    """The layers at other nodes, bilinear. values: (layers, 6 fine_side^2 + 2)."""
    n = first + wp.tid()
    layer = n // values.shape[1]
    number = n % values.shape[1]
    place = surface_place(fine_side, number)
    half = 0.5 * float(fine_side)
    p = wp.vec3(float(place[0]) - half, float(place[1]) - half, float(place[2]) - half)
    values[layer, number] = layer_value(coarse, layer, surface_sample(coarse.side, p))
