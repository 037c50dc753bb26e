"""Float64 NumPy versions of the formulas of voxel fields and of what is around them, written plainly: background layers
by the coordinates of every lattice point, in a dictionary; outer fields by the contraction's formula, rays cut at every
border."""

import functools
import itertools

import numpy as np
import pytest

from warpcage.field import LayeredBackground, OuterField, surface_node_count

#: Where in its step a sample is, as a share of the step.
SAMPLE_PLACE = 0.5

#: Harmonics of red, green and blue, and of luminance with differences of colour.
both_kinds = pytest.mark.parametrize("numbers", [(9, 3), (24,)], ids=["rgb", "luminance"])


def random_field(
    device,
    resolution=(7, 6, 8),
    seed=0,
    keep=0.5,
    bounds=((-1.0, -0.6, -0.8), (1.1, 1.2, 1.6)),
    density_scale=3.0,
    numbers=(9, 3),
):
    """A VoxelField with random values at a random share of its nodes, and its dense float64 arrays.

    numbers: (9, 3) harmonics of red, green and blue, or (24,) of luminance and differences of colour.
    """
    from warpcage import VoxelField

    random = np.random.default_rng(seed)
    mask = random.random(resolution) < keep
    links = np.full(resolution, -1, np.int32)
    links[mask] = np.arange(mask.sum())
    density = random.normal(0.5, 1.0, mask.sum()) * density_scale
    sh = random.normal(0, 0.4, (mask.sum(), *numbers))
    field = VoxelField(bounds, links, density, sh, device=device)
    dense_density, dense_sh = np.zeros(resolution), np.zeros((*resolution, *numbers))
    dense_density[mask], dense_sh[mask] = density.astype(np.float32), sh.astype(np.float32)
    return field, dense_density, dense_sh


def rays_of(count, seed=0, reach=4.0):
    """Origins (n, 3) in and around the box of a field, unit directions (n, 3)."""
    random = np.random.default_rng(seed)
    directions = random.normal(size=(count, 3))
    return random.uniform(-reach, reach, (count, 3)), directions / np.linalg.norm(directions, axis=1, keepdims=True)


def assert_slopes(found, values, loss, every):
    """Some slopes of a loss of values, none of them zero, are central differences."""
    for at in map(tuple, np.argwhere(np.abs(found) > 0)[::every]):
        ends = []
        for sign in (1, -1):
            moved = values.copy()
            moved[at] += sign * 1e-6
            ends.append(loss(moved))
        assert found[at] == pytest.approx((ends[0] - ends[1]) / 2e-6, abs=2e-3)


def trilinear(values, g):
    """(n, m) values (x, y, z, m) at node coordinates g (n, 3), in float64."""
    cell = np.clip(np.floor(g).astype(int), 0, np.array(values.shape[:3]) - 2)
    f, total = g - cell, 0
    for corner in np.ndindex(2, 2, 2):
        share = np.prod(np.where(corner, f, 1 - f), axis=1)
        total = total + share[:, None] * values[tuple((cell + corner).T)].astype(float)
    return total


def basis(directions, degrees=3):
    """(n, degrees^2) real spherical harmonics from their definition by associated Legendre functions, svox2's signs."""
    from scipy.special import sph_harm_y

    theta = np.arccos(np.clip(directions[:, 2], -1, 1))
    phi = np.arctan2(directions[:, 1], directions[:, 0])
    columns = []
    for degree in range(degrees):
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), theta, phi)
            # SciPy's complex harmonics carry the Condon-Shortley phase; svox2's real ones keep that sign
            if order < 0:
                columns.append(np.sqrt(2) * value.imag)
            elif order == 0:
                columns.append(value.real)
            else:
                columns.append(np.sqrt(2) * value.real)
    return np.stack(columns, axis=-1)


def colors(sh, directions):
    """(n, 3) colours before the clamp of rows (n, 9, 3), or (n, 24) of Y, O and G: Y + O - G/2, Y + G, Y - O - G/2."""
    if sh.ndim == 3:
        return np.einsum("nbc,nb->nc", sh, basis(directions)) + 0.5
    functions = basis(directions, 4)
    y = (sh[:, :16] * functions).sum(axis=1)
    orange, green = ((sh[:, first : first + 4] * functions[:, :4]).sum(axis=1) for first in (16, 20))
    return np.stack([y + orange - green / 2, y + green, y - orange - green / 2], axis=1) + 0.5


def interpolate(dense, node_coordinates):
    """Trilinear values (n, ...) of a dense array at node coordinates (n, 3), zero outside the nodes' box."""
    shape = np.array(dense.shape[:3])
    low = np.floor(node_coordinates).astype(int)
    inside = ((low >= 0) & (low < shape - 1)).all(axis=1)
    fraction = node_coordinates - low
    low = np.where(inside[:, None], low, 0)
    total = np.zeros((len(low), *dense.shape[3:]))
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(np.array(corner) == 1, fraction, 1 - fraction), axis=1)
        at = low + corner
        values = dense[at[:, 0], at[:, 1], at[:, 2]]
        total += (weight * inside).reshape(-1, *[1] * (values.ndim - 1)) * values
    return total


def sample(field, density, sh, points, directions):
    g = (points - field.bounds[0]) / field.voxel_size - 0.5
    color = colors(interpolate(sh, g), directions)
    return np.maximum(color, 0), np.maximum(interpolate(density, g), 0)


def render_ray(field, density, sh, origin, direction, step, background, length=20.0):
    """(rgb, alpha, depth) of one ray by brute force: every sample t_k = (k + SAMPLE_PLACE) step up to `length`."""
    t = (np.arange(int(length / step)) + SAMPLE_PLACE) * step
    points = origin + t[:, None] * direction
    color, sigma = sample(field, density, sh, points, np.broadcast_to(direction, points.shape))
    alpha = 1 - np.exp(-sigma * step)
    transmittance = np.concatenate([[1], np.cumprod(1 - alpha)])
    weight = transmittance[:-1] * alpha
    rgb = weight @ color + transmittance[-1] * np.asarray(background)
    opacity = 1 - transmittance[-1]
    return rgb, opacity, weight @ t / opacity if opacity > 1e-3 else np.inf


def surface_points(side):
    """(6 side^2 + 2, 3) lattice points of a cube's surface in the order of kernels.field.background: both faces across
    x, then what is left across y, then across z, each walked row by row."""
    points = []
    for axis in range(3):
        for top in (0, side):
            ranges = [range(1, side) if other < axis else range(side + 1) for other in range(3)]
            ranges[axis] = (top,)
            points += [(i, j, k) for i in ranges[0] for j in ranges[1] for k in ranges[2]]
    return np.array(points)


def random_background(device, side=4, layers=5, seed=0, center=(0.3, -0.2, 0.5), half=1.5):
    """A LayeredBackground of random values, some optical depths below zero, and its values in float64."""
    random = np.random.default_rng(seed)
    values = np.concatenate(
        [
            random.random((layers, surface_node_count(side), 3)),
            random.normal(0.4, 0.5, (layers, surface_node_count(side), 1)),
        ],
        axis=-1,
    )
    values = values.astype(np.float32).astype(np.float64)
    return LayeredBackground(center, half, side, values, device=device), values


def layer_points(background, origin, direction):
    """Where a ray leaves each cube, [-1, 1] of its half side, or None where it passes by. The last is at infinity."""
    last = background.layer_count - 1
    origin = np.asarray(origin, float) - background.center
    points = []
    for layer in range(last):
        half = background.half * last / (last - layer)
        with np.errstate(divide="ignore"):
            ends = np.sort(np.stack([(-half - origin) / direction, (half - origin) / direction]), axis=0)
        near, far = max(ends[0].max(), 0.0), ends[1].min()
        points.append((origin + far * direction) / half if near < far else None)
    return [*points, direction / np.abs(direction).max()]


@functools.cache
def surface_rows(side):
    """{lattice point: its row among `surface_points`}."""
    return {tuple(point): row for row, point in enumerate(surface_points(side).tolist())}


def bilinear(values, place, side):
    """(c,) value at a point of the surface, values: (points, c) at its lattice points."""
    axis = int(np.argmax(np.abs(place)))
    grid = (np.asarray(place) / np.abs(place[axis]) + 1) / 2 * side
    low = np.minimum(np.floor(grid).astype(int), side - 1)
    total = 0.0
    for corner in np.ndindex(2, 2):
        node, weight = [0, 0, 0], 1.0
        node[axis] = side if place[axis] > 0 else 0
        for other, up in zip([other for other in range(3) if other != axis], corner, strict=True):
            node[other] = int(low[other]) + up
            fraction = grid[other] - low[other]
            weight *= fraction if up else 1 - fraction
        total = total + weight * values[surface_rows(side)[tuple(node)]]
    return total


def ray_color(background, values, origin, direction):
    """(3,) what a ray sees; values (layers, nodes, 4) float64, direction of unit length."""
    color, transmittance = np.zeros(3), 1.0
    for layer, place in enumerate(layer_points(background, origin, direction)):
        if place is None:
            continue
        value = bilinear(values[layer], place, background.side)
        kept = np.exp(-max(value[3], 0.0)) if layer < len(values) - 1 else 0.0
        color += transmittance * (1 - kept) * value[:3]
        transmittance *= kept
    return color


def contract(u, like=None):
    """MeRF's piecewise projective contraction of points (..., 3) in box units.

    like: Points whose largest coordinates tell the regions, for points at the borders of these. None is `u`.
    """
    u = np.asarray(u, float)
    size = np.abs(u if like is None else like)
    axis = size.argmax(axis=-1)[..., None] == np.arange(3)
    largest = np.abs(np.where(axis, u, 0)).max(axis=-1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        pressed = np.where(axis, np.sign(u) * (2 - 1 / np.abs(u)), u / largest)
    return np.where(size.max(axis=-1, keepdims=True) > 1, pressed, u)


def expand(p):
    """The inverse of `contract`, for places within (-2, 2)^3."""
    p = np.asarray(p, float)
    size = np.abs(p).max(axis=-1, keepdims=True)
    axis = np.abs(p).argmax(axis=-1)[..., None] == np.arange(3)
    largest = 1 / (2 - np.maximum(size, 1.0))
    return np.where(size > 1, np.where(axis, np.sign(p) * largest, p * largest), p)


def node_places(side):
    """(side, side, side, 3) contracted places of the nodes."""
    places = (np.arange(side) + 0.5) * 4 / side - 2
    return np.stack(np.meshgrid(places, places, places, indexing="ij"), axis=-1)


def random_outer(device, side=8, keep=0.7, seed=0, center=(0.0, 0.0, 0.0), half=(1.0, 1.0, 1.0), density=1.0):
    """An OuterField of random values, some densities below zero, and its values (rows, 4) in float64."""
    random = np.random.default_rng(seed)
    places = np.abs(node_places(side))
    around = (places.max(axis=-1) > 1 - 4 / side) & ((places > 1 + 4 / side).sum(axis=-1) < 2)
    kept = around & (random.random(around.shape) < keep)
    links = np.full(kept.shape, -1, np.int32)
    links[kept] = random.permutation(int(kept.sum()))
    values = np.concatenate(
        [random.random((kept.sum(), 3)), density * random.normal(0.4, 0.5, (kept.sum(), 1))], axis=-1
    )
    values = values.astype(np.float32).astype(np.float64)
    sky = random.random((6 * 3**2 + 2, 3))
    # whose rows are in the order of memory
    return OuterField(center, half, links, values, sky=sky, device=device), values[links[kept]]


def interpolate_outer(links, values, places):
    """(n, 4) trilinear values at contracted places; beyond the last nodes they go on as they are."""
    side = len(links)
    g = np.clip((np.asarray(places) + 2) * side / 4 - 0.5, 0, side - 1 - 1e-3)
    low = np.floor(g).astype(int)
    total = np.zeros((len(g), 4))
    for corner in np.ndindex(2, 2, 2):
        node = low + corner
        weight = np.where(corner, g - low, 1 - (g - low)).prod(axis=1)
        rows = links[tuple(node.T)]
        total += weight[:, None] * np.where(rows[:, None] >= 0, values[np.maximum(rows, 0)], 0.0)
    return total


def pieces(outer, origin, direction, begin, end):
    """(start, stop) in contracted space of a ray's way outside the box between two distances, in order."""
    o, d = (np.asarray(origin, float) - outer.center) / outer.half, np.asarray(direction, float) / outer.half
    cuts = [begin, end]
    with np.errstate(divide="ignore", invalid="ignore"):
        for a in range(3):
            cuts += list((np.array([-1.0, 1.0]) - o[a]) / d[a])
            for b in range(a):
                cuts += [(o[b] - o[a]) / (d[a] - d[b]), -(o[a] + o[b]) / (d[a] + d[b])]
    cuts = sorted(cut for cut in cuts if begin <= cut <= end)
    found = []
    for near, far in itertools.pairwise(cuts):
        middle = near + 1.0 if far > 1e20 else 0.5 * (near + far)
        if far - near > 1e-9 and np.abs(o + middle * d).max() > 1:
            found.append(tuple(contract(o + min(t, 1e12) * d, o + middle * d) for t in (near, far)))
    # cuts at planes of the box that are not borders of regions: pieces of one straight line are one piece
    joined = []
    for start, stop in found:
        if joined:
            along, before = stop - start, joined[-1][1] - joined[-1][0]
            straight = np.linalg.norm(np.cross(along, before)) < 1e-7 * np.linalg.norm(along) * np.linalg.norm(before)
            if straight and along @ before > 0 and np.allclose(joined[-1][1], start, atol=1e-9):
                joined[-1] = joined[-1][0], stop
                continue
        joined.append((start, stop))
    return joined


def march_outer(outer, values, origin, direction, begin=0.0, end=1e30, samples_per_voxel=2):
    """(colour (3,), light that is left) of a ray's way outside the box."""
    links, side = outer.contents().links, outer.side
    color, light = np.zeros(3), 1.0
    for start, stop in pieces(outer, origin, direction, begin, end):
        length = np.linalg.norm(stop - start)
        count = int(np.ceil(length * side / 4 * samples_per_voxel))
        if not count:
            continue
        places = start + (np.arange(count) + SAMPLE_PLACE)[:, None] / count * (stop - start)
        found = interpolate_outer(links, values, places)
        kept = np.exp(-np.maximum(found[:, 3], 0.0) * length / count)
        lights = light * np.concatenate([[1], np.cumprod(kept)])
        color += (lights[:-1] * (1 - kept)) @ np.maximum(found[:, :3], 0.0)
        light = lights[-1]
    return color, light


def sky_color(outer, direction):
    """(3,) of the sky's cube in a direction."""
    return bilinear(outer.sky.astype(float), direction, outer.grid.sky.side)


def front_end(outer, origin, direction):
    """Distance at which a ray enters the box, 0 where it begins in it; half the way to where it is nearest to the
    middle where it misses the box."""
    o, d = (np.asarray(origin, float) - outer.center) / outer.half, np.asarray(direction, float) / outer.half
    with np.errstate(divide="ignore"):
        ends = np.sort(np.stack([(-1 - o) / d, (1 - o) / d]), axis=0)
    near, far = max(ends[0].max(), 0.0), ends[1].min()
    return near if near < far else max(0.0, 0.5 * direction @ (outer.center - origin))


def surrounded(outer, values, origin, direction, inner):
    """(3,) what a ray sees: `inner(behind)` is the box's colour before a colour behind it; and the front's opacity."""
    between = front_end(outer, origin, direction)
    front, light = march_outer(outer, values, origin, direction, 0.0, between) if between > 0 else (np.zeros(3), 1.0)
    back, left = march_outer(outer, values, origin, direction, between)
    return front + light * inner(back + left * sky_color(outer, direction)), 1 - light
