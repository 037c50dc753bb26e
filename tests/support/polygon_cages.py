"""Cages of quads and other polygons, and their bilinear patches by formulas of their own."""

import numpy as np

from warpcage import Cage

#: The quads of a cube of corners (x, y, z) in {-1, 1}, x changing fastest, anticlockwise seen from outside.
CUBE_QUADS = ((0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5))

CUBE_CORNERS = np.array([(x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], np.float64)


def quad_cube() -> Cage:
    """A cube of side two about the origin, six quads."""
    return Cage(CUBE_CORNERS, CUBE_QUADS)


def quad_box(segments: int, warp: float = 0.0, seed: int = 0, round: bool = False) -> Cage:
    """A cube about the origin, or a ball, whose sides are segments^2 quads, vertices moved by shares of their edges."""
    numbers: dict[tuple[int, ...], int] = {}
    quads = []
    for axis in range(3):
        for side in (0, segments):
            for i, j in np.ndindex(segments, segments):
                quad = []
                for a, b in ((0, 0), (1, 0), (1, 1), (0, 1)):
                    place = [side] * 3
                    place[(axis + 1) % 3], place[(axis + 2) % 3] = i + a, j + b
                    quad.append(numbers.setdefault(tuple(place), len(numbers)))
                quads.append(quad if side else quad[::-1])
    vertices = 2.0 * np.array(list(numbers)) / segments - 1.0
    if round:
        vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    moved = np.random.default_rng(seed).uniform(-1.0, 1.0, vertices.shape)
    return Cage(vertices + warp * 2.0 / segments * moved, quads)


def mixed_prism() -> Cage:
    """A prism over a pentagon: two pentagons, three quads, and two triangle pairs in place of the other quads."""
    angles = 2.0 * np.pi * np.arange(5) / 5.0
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    vertices = np.concatenate([np.column_stack([ring, np.full(5, height)]) for height in (-0.7, 0.7)])
    sides = [[k, (k + 1) % 5, (k + 1) % 5 + 5, k + 5] for k in range(5)]
    cut = [[face[0], face[k], face[k + 1]] for face in sides[:2] for k in (1, 2)]
    return Cage(vertices, [[4, 3, 2, 1, 0], [5, 6, 7, 8, 9], *sides[2:], *cut])


def concave_prism() -> Cage:
    """A prism over an L: two concave hexagons and six quads."""
    outline = np.array([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], np.float64)
    vertices = np.concatenate([np.column_stack([outline, np.full(6, height)]) for height in (0.0, 1.0)])
    sides = [[k, (k + 1) % 6, (k + 1) % 6 + 6, k + 6] for k in range(6)]
    return Cage(vertices, [[5, 4, 3, 2, 1, 0], [6, 7, 8, 9, 10, 11], *sides])


def triangulated(cage: Cage, turn: int = 0) -> Cage:
    """The same vertices with each polygon cut as a fan from its corner number `turn`."""
    faces = []
    for polygon in cage.polygons:
        face = (*polygon[turn % len(polygon) :], *polygon[: turn % len(polygon)])
        faces += [(face[0], face[k], face[k + 1]) for k in range(1, len(face) - 1)]
    return Cage(cage.vertices, faces)


def reordered(cage: Cage, seed: int = 0) -> tuple[Cage, np.ndarray]:
    """The cage with vertices and faces in another order, faces begun at another corner; and (v,) the old numbers."""
    random = np.random.default_rng(seed)
    old = random.permutation(len(cage.vertices))
    new = np.argsort(old)
    faces = [np.roll(new[list(face)], random.integers(len(face))).tolist() for face in cage.polygons]
    return Cage(cage.vertices[old], [faces[k] for k in random.permutation(len(faces))]), old


def patch_rows(cage: Cage, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Of a cage of quads: weights (w, v) of a grid of points on each bilinear patch, and triangles (t, 3) of them."""
    steps = np.linspace(0.0, 1.0, cells + 1)
    rows: dict[tuple[float, ...], int] = {}
    triangles = []
    for quad in cage.polygons:
        grid = np.empty((cells + 1, cells + 1), int)
        for i, j in np.ndindex(grid.shape):
            s, t = steps[i], steps[j]
            row = np.zeros(len(cage.vertices))
            np.add.at(row, list(quad), [(1 - s) * (1 - t), s * (1 - t), s * t, (1 - s) * t])
            grid[i, j] = rows.setdefault(tuple(row.round(12).tolist()), len(rows))
        for i, j in np.ndindex(cells, cells):
            a, b, c, d = grid[i, j], grid[i + 1, j], grid[i + 1, j + 1], grid[i, j + 1]
            triangles += [(a, b, c), (a, c, d)] if (i + j) % 2 else [(a, b, d), (b, c, d)]
    return np.array(list(rows)), np.array(triangles)
