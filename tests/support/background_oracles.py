"""Background layers in float64 NumPy, written plainly: every lattice point by its coordinates, in a dictionary."""

import numpy as np

from warpcage.field import LayeredBackground, surface_node_count


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


def bilinear(values, place, side):
    """(c,) value at a point of the surface, values: {lattice point: (c,)}."""
    axis = int(np.argmax(np.abs(place)))
    grid = (np.asarray(place) / np.abs(place[axis]) + 1) / 2 * side
    low = np.minimum(np.floor(grid).astype(int), side - 1)
    total = 0.0
    for corner in np.ndindex(2, 2):
        node, weight = np.empty(3, int), 1.0
        node[axis] = side if place[axis] > 0 else 0
        for other, up in zip([other for other in range(3) if other != axis], corner, strict=True):
            node[other] = low[other] + up
            fraction = grid[other] - low[other]
            weight *= fraction if up else 1 - fraction
        total = total + weight * values[tuple(node)]
    return total


def ray_color(background, values, origin, direction):
    """(3,) what a ray sees; values (layers, nodes, 4) float64, direction of unit length."""
    points = surface_points(background.side)
    color, transmittance = np.zeros(3), 1.0
    for layer, place in enumerate(layer_points(background, origin, direction)):
        if place is None:
            continue
        table = {tuple(point): value for point, value in zip(points, values[layer], strict=True)}
        value = bilinear(table, place, background.side)
        kept = np.exp(-max(value[3], 0.0)) if layer < len(values) - 1 else 0.0
        color += transmittance * (1 - kept) * value[:3]
        transmittance *= kept
    return color
