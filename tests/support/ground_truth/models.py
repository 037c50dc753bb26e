"""Models for scenes: an animal of blended cones, thin rods, and surfaces that are hard to fit."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from warpcage.demo.bricks import Model, Part, ball, box, brick_model, centered, cylinder, joined
from warpcage.errors import InputError

#: Cells along the longest side of the box in which its surface is found.
ANIMAL_CELLS = 110


def animal_model() -> Model:
    """An antelope-like animal, one smooth surface about 2 units long, centred at the origin, z up, its head at +x.
    Faces are counterclockwise seen from outside."""
    from skimage.measure import marching_cubes

    limbs = np.array(list(_animal_limbs()))
    low = limbs[:, :6].reshape(-1, 3).min(axis=0) - 0.45
    high = limbs[:, :6].reshape(-1, 3).max(axis=0) + 0.45
    spacing = (high - low).max() / ANIMAL_CELLS
    axes = [np.arange(low[a], high[a] + spacing, spacing) for a in range(3)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    vertices, faces, _, _ = marching_cubes(
        _smooth_union(nodes, limbs), 0.0, spacing=(spacing,) * 3, gradient_direction="ascent"
    )
    vertices = vertices + low
    colors = _animal_colors(vertices[faces].mean(axis=1))
    vertices = centered(vertices)
    return vertices, _facing_out(vertices, faces.astype(np.int32)), colors.astype(np.float32)


def _animal_limbs() -> Iterator[tuple[float, ...]]:
    """Cones between two balls: start (3), end (3), and the radius at each."""
    yield -0.55, 0.0, 0.0, 0.45, 0.0, 0.05, 0.30, 0.27  # trunk
    yield -0.1, 0.0, -0.03, 0.1, 0.0, -0.03, 0.31, 0.31
    yield 0.5, 0.0, 0.12, 0.82, 0.0, 0.62, 0.17, 0.12  # neck
    yield 0.82, 0.0, 0.66, 1.1, 0.0, 0.55, 0.13, 0.075  # head
    for y in (-1, 1):
        yield 0.78, 0.08 * y, 0.76, 0.70, 0.2 * y, 0.86, 0.045, 0.03  # ears
        yield 0.8, 0.05 * y, 0.76, 0.62, 0.12 * y, 1.12, 0.035, 0.02  # horns
        yield 0.42, 0.15 * y, -0.05, 0.5, 0.17 * y, -0.45, 0.12, 0.075  # legs
        yield 0.5, 0.17 * y, -0.45, 0.44, 0.17 * y, -0.88, 0.07, 0.055
        yield -0.55, 0.15 * y, -0.03, -0.66, 0.17 * y, -0.42, 0.16, 0.085
        yield -0.66, 0.17 * y, -0.42, -0.56, 0.17 * y, -0.88, 0.075, 0.055
    yield -0.82, 0.0, 0.08, -1.0, 0.0, -0.12, 0.05, 0.045  # tail
    yield -1.0, 0.0, -0.12, -1.04, 0.0, -0.34, 0.045, 0.06


def _smooth_union(points: np.ndarray, limbs: np.ndarray, blend: float = 0.025) -> np.ndarray:
    """Signed distance of the cones, blended over about `blend` where they meet (exponential smooth minimum)."""
    total = np.zeros(points.shape[:-1])
    for limb in limbs:
        start, end, first, last = limb[:3], limb[3:6], limb[6], limb[7]
        along = end - start
        share = np.clip((points - start) @ along / (along @ along), 0, 1)
        distance = np.linalg.norm(points - start - share[..., None] * along, axis=-1) - (first + share * (last - first))
        total += np.exp(np.minimum(-distance / blend, 500))
    return -blend * np.log(np.maximum(total, 1e-300))


def _animal_colors(places: np.ndarray) -> np.ndarray:
    """Brown above, pale below, dark hooves, stripes across the back."""
    height = places[:, 2:]
    pale = 1 / (1 + np.exp((height + 0.12) / 0.04))
    colors = (1 - pale) * np.array([0.66, 0.38, 0.16]) + pale * np.array([0.86, 0.78, 0.64])
    stripe = np.clip(2.5 * np.sin(22 * places[:, :1] + 3 * height) - 1.2, 0, 1) * np.clip(6 * (height + 0.05), 0, 1)
    colors = (1 - 0.75 * stripe) * colors + 0.75 * stripe * np.array([0.92, 0.88, 0.78])
    hoof = 1 / (1 + np.exp((height + 0.80) / 0.01))
    return (1 - hoof) * colors + hoof * np.array([0.14, 0.12, 0.11])


def _facing_out(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Faces of a closed surface, reversed where its volume comes out negative."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return faces if np.einsum("fi,fi->", a, np.cross(b, c)) > 0 else faces[:, ::-1].copy()


def chair_model() -> Model:
    """A chair of rods: legs of 0.05 units, a back of spindles half as thick, a slatted seat; 2 units high, z up.
    Every part is a closed surface, counterclockwise seen from outside; parts overlap."""
    vertices, faces, colors = joined(_chair_parts())
    return centered(vertices), faces, colors


def _chair_parts() -> Iterator[Part]:
    red, blue, green, white, dark = (
        (0.78, 0.16, 0.12),
        (0.12, 0.34, 0.72),
        (0.16, 0.52, 0.28),
        (0.90, 0.88, 0.82),
        (0.20, 0.20, 0.22),
    )
    for x in (-0.42, 0.42):
        for y in (-0.42, 0.42):
            yield cylinder((1.12 * x, 1.12 * y, 0.0), (x, y, 0.95), 0.045, red, segments=16)
            yield cylinder((1.13 * x, 1.13 * y, -0.02), (1.13 * x, 1.13 * y, 0.04), 0.06, dark, segments=16)
    for z, shrink in ((0.35, 1.08), (0.55, 1.05)):  # rungs
        reach = 0.42 * shrink
        for side in (-reach, reach):
            yield cylinder((-reach, side, z), (reach, side, z), 0.022, blue, segments=12)
            yield cylinder((side, -reach, z + 0.08), (side, reach, z + 0.08), 0.022, blue, segments=12)
    for y in np.linspace(-0.44, 0.44, 9):  # slats of the seat
        yield box((-0.5, y - 0.038, 0.93), (0.5, y + 0.038, 0.98), white)
    for x in (-0.4, 0.4):
        yield box((x - 0.05, -0.47, 0.89), (x + 0.05, 0.47, 0.93), white)
    for y in (-0.44, 0.44):  # the back, leaning
        yield cylinder((-0.42, y, 0.93), (-0.62, y, 2.0), 0.042, red, segments=16)
    for y in np.linspace(-0.33, 0.33, 7):
        yield cylinder((-0.43, y, 0.96), (-0.6, y, 1.9), 0.02, green, segments=12)
    for z, x in ((1.45, -0.517), (1.88, -0.598)):
        yield cylinder((x, -0.46, z), (x, 0.46, z), 0.03, blue, segments=14)


def globe_model() -> Model:
    """A wire globe on a lattice mast, its rods a fiftieth of the model thick. Returns what `chair_model` does."""
    parts, rod = [], 0.02
    turn = 2 * np.pi * np.arange(28) / 28

    def ring(points, color):
        for start, end in zip(points, np.roll(points, -1, axis=0), strict=True):
            parts.append(cylinder(start, end, rod, color, segments=8))

    globe = np.array([0.0, 0.0, 0.35])
    for tilt, color in ((0, (0.8, 0.15, 0.1)), (60, (0.1, 0.3, 0.75)), (120, (0.15, 0.55, 0.25))):
        c, s = np.cos(np.radians(tilt)), np.sin(np.radians(tilt))
        ring(globe + 0.62 * np.stack([c * np.cos(turn), s * np.cos(turn), np.sin(turn)], axis=1), color)
    ring(globe + 0.62 * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1), (0.9, 0.7, 0.1))
    feet = np.array([[0.3, 0.3], [-0.3, 0.3], [-0.3, -0.3], [0.3, -0.3]])
    levels = ((-0.95, 1.0), (-0.6, 0.7), (-0.27, 0.3))
    for (low, wide), (high, narrow) in itertools.pairwise(levels):
        for i in range(4):
            foot, head = np.append(wide * feet[i], low), np.append(narrow * feet[i], high)
            across = np.append(narrow * feet[(i + 1) % 4], high)
            for end in (head, across):
                parts.append(cylinder(foot, end, rod, (0.25, 0.25, 0.28), segments=8))
            parts.append(cylinder(head, across, rod, (0.25, 0.25, 0.28), segments=8))
    parts.append(box((-0.4, -0.4, -1.0), (0.4, 0.4, -0.95), (0.5, 0.48, 0.45)))
    return joined(parts)


#: Side of the squares of the pattern, world units.
PATTERN = 0.11


def specular_model() -> Model:
    """Three balls on a plate, to be rendered with strong highlights. Returns what `brick_model` does."""
    balls = (
        ((-0.35, 0.25, -0.05), 0.45, (0.6, 0.06, 0.05)),
        ((0.45, 0.1, -0.15), 0.35, (0.05, 0.15, 0.5)),
        ((0.1, -0.5, -0.22), 0.28, (0.1, 0.1, 0.1)),
    )
    parts = [ball(*each) for each in balls]
    return joined([*parts, box((-0.95, -0.95, -0.6), (0.95, 0.95, -0.5), (0.45, 0.42, 0.38))])


def textured_model() -> Model:
    """A block and a ball in a pattern of random colours, a few pixels wide each. Returns what `brick_model` does."""
    random = np.random.default_rng(5)
    block = _quilted_box((-0.75, -0.55, -0.7), (0.75, 0.55, 0.2))
    ball_vertices, ball_faces, _ = ball((0.1, 0.0, 0.5), 0.45, (1, 1, 1), subdivisions=3)
    vertices, faces, _ = joined([block, (ball_vertices, ball_faces, (1, 1, 1))])
    colors = random.uniform(0.05, 0.95, faces.shape).astype(np.float32)
    quilted = len(block[1])
    colors[1:quilted:2] = colors[:quilted:2]  # both triangles of a square
    return vertices, faces, colors


def _quilted_box(low: ArrayLike, high: ArrayLike) -> Part:
    """A box whose sides are cut into squares of about PATTERN. The two triangles of a square follow each other."""
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    vertices, faces = [], []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        counts = [int(np.ceil((high[i] - low[i]) / PATTERN)) for i in (u, v)]
        a, b = np.meshgrid(np.linspace(0, 1, counts[0] + 1), np.linspace(0, 1, counts[1] + 1), indexing="ij")
        corner = np.arange(counts[0] * (counts[1] + 1)).reshape(counts[0], -1)[:, :-1].ravel()
        row = counts[1] + 1
        for end in (0, 1):
            points = np.empty((a.size, 3))
            points[:, axis] = (low, high)[end][axis]
            points[:, u] = low[u] + a.ravel() * (high[u] - low[u])
            points[:, v] = low[v] + b.ravel() * (high[v] - low[v])
            first, second = (corner, corner + row, corner + row + 1), (corner, corner + row + 1, corner + 1)
            sides = np.stack([np.stack(first, axis=1), np.stack(second, axis=1)], axis=1).reshape(-1, 3)
            faces.append((sides if end else sides[:, ::-1]) + sum(map(len, vertices)))
            vertices.append(points)
    return np.concatenate(vertices), np.concatenate(faces), (1.0, 1.0, 1.0)


#: Models by name: functions that return vertices, faces and colours.
MODELS = {
    "bricks": brick_model,
    "animal": animal_model,
    "chair": chair_model,
    "thin": globe_model,
    "specular": specular_model,
    "textured": textured_model,
}


def subdivided_model(name: str, longest_edge: float) -> Model:
    """A model whose triangles are halved until none is longer than `longest_edge`, to follow a deformation."""
    import trimesh

    if name not in MODELS:
        raise InputError(f"model {name!r} is not known: {', '.join(MODELS)}")
    vertices, faces, colors = MODELS[name]()
    vertices, faces, source = trimesh.remesh.subdivide_to_size(vertices, faces, longest_edge, return_index=True)  # pyright: ignore[reportAssignmentType]
    return np.asarray(vertices), faces.astype(np.int32), colors[source]
