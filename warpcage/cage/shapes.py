"""Simple closed cages: box, cylinder, icosphere. Each function returns vertices (v, 3) and outward faces (f, 3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from ..core.checks import axis_index, checked_positive, checked_vector, checked_whole
from ..errors import InputError
from .repair import cut_in_four

#: Faces of an icosahedron over the corners of three golden rectangles.
_ICOSAHEDRON = [
    [0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11],
    [1, 5, 9], [5, 11, 4], [11, 10, 2], [10, 7, 6], [7, 1, 8],
    [3, 9, 4], [3, 4, 2], [3, 2, 6], [3, 6, 8], [3, 8, 9],
    [4, 9, 5], [2, 4, 11], [6, 2, 10], [8, 6, 7], [9, 8, 1],
]  # fmt: skip


def box(
    lower: ArrayLike, upper: ArrayLike | None = None, segments: int | Sequence[int] = 1
) -> tuple[np.ndarray, np.ndarray]:
    """The surface of a grid between two corners, both in `lower` (2, 3) where `upper` is None; see `Cage.box`."""
    corners = np.asarray(lower if upper is None else [lower, upper], dtype=np.float64)
    if corners.shape != (2, 3) or not np.isfinite(corners).all():
        raise InputError(f"a box needs two finite corners of 3 numbers, got {corners.tolist()}")
    if not (corners[1] > corners[0]).all():
        raise InputError(f"a box needs its upper corner above the lower, got {corners.tolist()}")
    if np.shape(segments) not in ((), (3,)):
        raise InputError(f"box segments must be one whole number or three, got {segments!r}")
    pieces = [checked_whole(count, "box segments", 1) for count in np.broadcast_to(np.asarray(segments), 3).tolist()]

    number: dict[tuple, int] = {}
    faces = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for end in (0, pieces[axis]):
            for i in range(pieces[u]):
                for j in range(pieces[v]):
                    quad = []
                    for du, dv in ((0, 0), (1, 0), (1, 1), (0, 1)):
                        node = [0, 0, 0]
                        node[axis], node[u], node[v] = end, i + du, j + dv
                        quad.append(tuple(node))
                    quad = quad if end else quad[::-1]
                    faces += [(quad[0], quad[1], quad[2]), (quad[0], quad[2], quad[3])]
    for node in sorted({node for face in faces for node in face}):
        number[node] = len(number)
    share = np.array(list(number)) / pieces
    vertices = corners[0] * (1.0 - share) + corners[1] * share
    return vertices, np.array([[number[node] for node in face] for face in faces])


def cylinder(
    center: ArrayLike, radius: float, height: float, axis: str = "z", sides: int = 12, rings: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Rings of vertices around an axis, and two caps with a vertex in the middle; see `Cage.cylinder`."""
    middle = checked_vector(center, "center")
    radius, height = checked_positive(radius, "cylinder radius"), checked_positive(height, "cylinder height")
    sides, rings = checked_whole(sides, "cylinder sides", 3), checked_whole(rings, "cylinder rings", 1)
    w = axis_index(axis)
    u, v = (w + 1) % 3, (w + 2) % 3

    angle = 2.0 * np.pi * np.arange(sides) / sides
    along = np.linspace(-0.5, 0.5, rings + 1) * height
    vertices = np.zeros(((rings + 1) * sides + 2, 3))
    vertices[:-2, u] = np.tile(radius * np.cos(angle), rings + 1)
    vertices[:-2, v] = np.tile(radius * np.sin(angle), rings + 1)
    vertices[:-2, w] = np.repeat(along, sides)
    vertices[-2, w], vertices[-1, w] = along[0], along[-1]

    here = np.arange(rings * sides)
    side = here // sides * sides + (here + 1) % sides
    edge, after = np.arange(sides), (np.arange(sides) + 1) % sides
    bottom, top = len(vertices) - 2, len(vertices) - 1
    faces = np.concatenate(
        [
            np.stack([here, side, side + sides], axis=1),
            np.stack([here, side + sides, here + sides], axis=1),
            np.stack([np.full(sides, bottom), after, edge], axis=1),
            np.stack([np.full(sides, top), rings * sides + edge, rings * sides + after], axis=1),
        ]
    )
    return vertices + middle, faces


def icosphere(center: ArrayLike, radius: float, subdivisions: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """A divided icosahedron; see `Cage.icosphere`."""
    middle, radius = checked_vector(center, "center"), checked_positive(radius, "icosphere radius")
    subdivisions = checked_whole(subdivisions, "icosphere subdivisions", 0, 6)
    golden = (1.0 + np.sqrt(5.0)) / 2.0
    rectangle = np.array([[-1, golden, 0], [1, golden, 0], [-1, -golden, 0], [1, -golden, 0]])
    vertices = np.concatenate([rectangle, np.roll(rectangle, 1, axis=1), np.roll(rectangle, 2, axis=1)])
    faces = np.array(_ICOSAHEDRON)
    for _ in range(subdivisions):
        vertices, faces = cut_in_four(vertices / np.linalg.norm(vertices, axis=1, keepdims=True), faces)
    return middle + radius * vertices / np.linalg.norm(vertices, axis=1, keepdims=True), faces
