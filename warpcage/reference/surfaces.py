"""Models whose surface is hard to fit: shiny balls, and a fine pattern of random colours."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .solids import Model, Part, ball, box, joined

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
    colours = random.uniform(0.05, 0.95, faces.shape).astype(np.float32)
    quilted = len(block[1])
    colours[1:quilted:2] = colours[:quilted:2]  # both triangles of a square
    return vertices, faces, colours


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
