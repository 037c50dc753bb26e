"""The animal model: an organic shape, the zero level of blended cones."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from .solids import Model, centred

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
    colours = _animal_colours(vertices[faces].mean(axis=1))
    vertices = centred(vertices)
    return vertices, _facing_out(vertices, faces.astype(np.int32)), colours.astype(np.float32)


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


def _animal_colours(places: np.ndarray) -> np.ndarray:
    """Brown above, pale below, dark hooves, stripes across the back."""
    height = places[:, 2:]
    pale = 1 / (1 + np.exp((height + 0.12) / 0.04))
    colours = (1 - pale) * np.array([0.66, 0.38, 0.16]) + pale * np.array([0.86, 0.78, 0.64])
    stripe = np.clip(2.5 * np.sin(22 * places[:, :1] + 3 * height) - 1.2, 0, 1) * np.clip(6 * (height + 0.05), 0, 1)
    colours = (1 - 0.75 * stripe) * colours + 0.75 * stripe * np.array([0.92, 0.88, 0.78])
    hoof = 1 / (1 + np.exp((height + 0.80) / 0.01))
    return (1 - hoof) * colours + hoof * np.array([0.14, 0.12, 0.11])


def _facing_out(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Faces of a closed surface, reversed where its volume comes out negative."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return faces if np.einsum("fi,fi->", a, np.cross(b, c)) > 0 else faces[:, ::-1].copy()
