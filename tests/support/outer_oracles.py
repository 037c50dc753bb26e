"""Outer fields in float64 NumPy, written plainly: the contraction by its formula, rays cut at every border."""

import numpy as np
from background_oracles import bilinear, surface_points

from warpcage.field import OuterField


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
    return OuterField(center, half, links, values, sky=sky, device=device), values


def interpolate(links, values, places):
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
    for near, far in zip(cuts, cuts[1:], strict=False):
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


def march(outer, values, origin, direction, begin=0.0, end=1e30, samples_per_voxel=2):
    """(colour (3,), light that is left) of a ray's way outside the box."""
    links, side = outer.grid.links.numpy(), outer.side
    color, light = np.zeros(3), 1.0
    for start, stop in pieces(outer, origin, direction, begin, end):
        length = np.linalg.norm(stop - start)
        count = int(np.ceil(length * side / 4 * samples_per_voxel))
        if not count:
            continue
        places = start + (np.arange(count) + 0.5)[:, None] / count * (stop - start)
        for value in interpolate(links, values, places):
            kept = np.exp(-max(value[3], 0.0) * length / count)
            color += light * (1 - kept) * np.maximum(value[:3], 0.0)
            light *= kept
    return color, light


def sky_color(outer, direction):
    """(3,) of the sky's cube in a direction."""
    sky = outer.sky.astype(float)
    side = outer.grid.sky.side
    table = {tuple(point): color for point, color in zip(surface_points(side), sky, strict=True)}
    return bilinear(table, direction, side)


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
    front, light = march(outer, values, origin, direction, 0.0, between) if between > 0 else (np.zeros(3), 1.0)
    back, left = march(outer, values, origin, direction, between)
    return front + light * inner(back + left * sky_color(outer, direction)), 1 - light
