"""Simple closed cages: box, cylinder, icosphere. Each function returns vertices (v, 3) and outward faces (f, 3)."""

from __future__ import annotations

import numpy as np

from .poses import axis_index


def box(lower, upper=None, segments=1) -> tuple[np.ndarray, np.ndarray]:
    """The surface of a grid between two corners: see `Cage.box`."""
    corners = np.asarray(lower if upper is None else [lower, upper], dtype=np.float64)
    if corners.shape != (2, 3) or not np.isfinite(corners).all():
        raise ValueError(f"a box needs two finite corners of 3 numbers, got {corners.tolist()}")
    if not (corners[1] > corners[0]).all():
        raise ValueError(f"a box needs its upper corner above the lower, got {corners.tolist()}")
    pieces = np.broadcast_to(_whole(segments, 1, "box segments"), 3)

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
                        node[axis], node[u], node[v] = int(end), i + du, j + dv
                        quad.append(tuple(node))
                    quad = quad if end else quad[::-1]
                    faces += [(quad[0], quad[1], quad[2]), (quad[0], quad[2], quad[3])]
    for node in sorted({node for face in faces for node in face}):
        number[node] = len(number)
    share = np.array(list(number)) / pieces
    vertices = corners[0] * (1.0 - share) + corners[1] * share
    return vertices, np.array([[number[node] for node in face] for face in faces])


def cylinder(centre, radius, height, axis="z", sides=12, rings=1) -> tuple[np.ndarray, np.ndarray]:
    """Rings of vertices around an axis and two caps with a middle vertex: see `Cage.cylinder`."""
    centre = _centre(centre)
    radius, height = _positive(radius, "cylinder radius"), _positive(height, "cylinder height")
    sides, rings = int(_whole(sides, 3, "cylinder sides")), int(_whole(rings, 1, "cylinder rings"))
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
    return vertices + centre, faces


def icosphere(centre, radius, subdivisions=1) -> tuple[np.ndarray, np.ndarray]:
    """A divided icosahedron: see `Cage.icosphere`."""
    centre, radius = _centre(centre), _positive(radius, "icosphere radius")
    subdivisions = int(_whole(subdivisions, 0, "icosphere subdivisions"))
    if subdivisions > 6:
        raise ValueError(f"icosphere subdivisions must be at most 6, got {subdivisions}")
    golden = (1.0 + np.sqrt(5.0)) / 2.0
    rectangle = np.array([[-1, golden, 0], [1, golden, 0], [-1, -golden, 0], [1, -golden, 0]])
    vertices = np.concatenate([rectangle, np.roll(rectangle, 1, axis=1), np.roll(rectangle, 2, axis=1)])
    faces = np.array(
        [
            [0, 11, 5],
            [0, 5, 1],
            [0, 1, 7],
            [0, 7, 10],
            [0, 10, 11],
            [1, 5, 9],
            [5, 11, 4],
            [11, 10, 2],
            [10, 7, 6],
            [7, 1, 8],
            [3, 9, 4],
            [3, 4, 2],
            [3, 2, 6],
            [3, 6, 8],
            [3, 8, 9],
            [4, 9, 5],
            [2, 4, 11],
            [6, 2, 10],
            [8, 6, 7],
            [9, 8, 1],
        ]
    )
    for _ in range(subdivisions):
        vertices, faces = _divided(vertices, faces)
    return centre + radius * vertices / np.linalg.norm(vertices, axis=1, keepdims=True), faces


def _divided(vertices, faces):
    """Cut every face in four at the middles of its edges, pushed out to the unit sphere."""
    vertices = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    edges, middle = np.unique(pairs, axis=0, return_inverse=True)
    ab, bc, ca = middle.reshape(3, -1) + len(vertices)
    a, b, c = faces.T
    divided = np.concatenate(
        [np.stack(corner, axis=1) for corner in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))]
    )
    return np.concatenate([vertices, vertices[edges].mean(axis=1)]), divided


def _centre(centre) -> np.ndarray:
    centre = np.asarray(centre, dtype=np.float64)
    if centre.shape != (3,) or not np.isfinite(centre).all():
        raise ValueError(f"centre must be 3 finite numbers, got {centre.tolist()}")
    return centre


def _positive(value, name: str) -> float:
    if not (np.isfinite(value) and value > 0):
        raise ValueError(f"{name} must be positive and finite, got {value}")
    return float(value)


def _whole(value, least: int, name: str) -> np.ndarray:
    array = np.asarray(value)
    if array.dtype.kind not in "iu" or array.shape not in ((), (3,)) or (array < least).any():
        raise ValueError(f"{name} must be whole numbers of at least {least}, got {value}")
    return array
