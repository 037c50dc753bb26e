"""Models that the project makes itself beside its bricks: an animal (organic) and a chair (thin parts)."""

from __future__ import annotations

import numpy as np

from .bricks import brick_model
from .solids import _box, _cylinder

#: Cells along the longest side of the box in which the animal's surface is found.
ANIMAL_CELLS = 110


def animal_model() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """An antelope-like animal, one smooth surface about 2 units long, centred at the origin, z up, its head at +x.

    Returns vertices (v, 3) float64, faces (f, 3) int32, counter-clockwise seen from outside, and colours (f, 3) float32
    in [0, 1].
    """
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
    vertices = vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    return vertices, _facing_out(vertices, faces.astype(np.int32)), colours.astype(np.float32)


def _animal_limbs():
    """Cones between two balls: start (3), end (3), radius at either."""
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


def _smooth_union(points, limbs, blend: float = 0.025) -> np.ndarray:
    """Signed distance of the cones, blended over about `blend` where they meet (exponential smooth minimum)."""
    total = np.zeros(points.shape[:-1])
    for limb in limbs:
        start, end, first, last = limb[:3], limb[3:6], limb[6], limb[7]
        along = end - start
        share = np.clip((points - start) @ along / (along @ along), 0, 1)
        distance = np.linalg.norm(points - start - share[..., None] * along, axis=-1) - (first + share * (last - first))
        total += np.exp(np.minimum(-distance / blend, 500))
    return -blend * np.log(np.maximum(total, 1e-300))


def _animal_colours(places) -> np.ndarray:
    """Brown above, pale below, dark hooves, stripes over the back."""
    height = places[:, 2:]
    pale = 1 / (1 + np.exp((height + 0.12) / 0.04))
    colours = (1 - pale) * np.array([0.66, 0.38, 0.16]) + pale * np.array([0.86, 0.78, 0.64])
    stripe = np.clip(2.5 * np.sin(22 * places[:, :1] + 3 * height) - 1.2, 0, 1) * np.clip(6 * (height + 0.05), 0, 1)
    colours = (1 - 0.75 * stripe) * colours + 0.75 * stripe * np.array([0.92, 0.88, 0.78])
    hoof = 1 / (1 + np.exp((height + 0.80) / 0.01))
    return (1 - hoof) * colours + hoof * np.array([0.14, 0.12, 0.11])


def chair_model() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A chair of rods: legs of 0.05 units, a back of spindles half as thick, a slatted seat; 2 units high, z up.

    Returns what animal_model does. Every part is a closed surface; parts overlap.
    """
    parts = list(_chair_parts())
    first = np.cumsum([0] + [len(vertices) for vertices, _, _ in parts])
    vertices = np.concatenate([vertices for vertices, _, _ in parts])
    faces = np.concatenate([faces + n for (_, faces, _), n in zip(parts, first[:-1], strict=True)])
    colours = np.concatenate([np.broadcast_to(colour, faces.shape) for _, faces, colour in parts])
    vertices = vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    return vertices, faces.astype(np.int32), colours.astype(np.float32)


def _chair_parts():
    red, blue, green, white, dark = (
        (0.78, 0.16, 0.12),
        (0.12, 0.34, 0.72),
        (0.16, 0.52, 0.28),
        (0.90, 0.88, 0.82),
        (0.20, 0.20, 0.22),
    )
    for x in (-0.42, 0.42):
        for y in (-0.42, 0.42):
            yield _cylinder((1.12 * x, 1.12 * y, 0.0), (x, y, 0.95), 0.045, red, segments=16)
            yield _cylinder((1.13 * x, 1.13 * y, -0.02), (1.13 * x, 1.13 * y, 0.04), 0.06, dark, segments=16)
    for z, shrink in ((0.35, 1.08), (0.55, 1.05)):  # rungs
        reach = 0.42 * shrink
        for side in (-reach, reach):
            yield _cylinder((-reach, side, z), (reach, side, z), 0.022, blue, segments=12)
            yield _cylinder((side, -reach, z + 0.08), (side, reach, z + 0.08), 0.022, blue, segments=12)
    for y in np.linspace(-0.44, 0.44, 9):  # slats of the seat
        yield _box((-0.5, y - 0.038, 0.93), (0.5, y + 0.038, 0.98), white)
    for x in (-0.4, 0.4):
        yield _box((x - 0.05, -0.47, 0.89), (x + 0.05, 0.47, 0.93), white)
    for y in (-0.44, 0.44):  # the back, leaning
        yield _cylinder((-0.42, y, 0.93), (-0.62, y, 2.0), 0.042, red, segments=16)
    for y in np.linspace(-0.33, 0.33, 7):
        yield _cylinder((-0.43, y, 0.96), (-0.6, y, 1.9), 0.02, green, segments=12)
    for z, x in ((1.45, -0.517), (1.88, -0.598)):
        yield _cylinder((x, -0.46, z), (x, 0.46, z), 0.03, blue, segments=14)


#: Models by name: functions that return vertices, faces and colours.
MODELS = {"bricks": brick_model, "animal": animal_model, "chair": chair_model}


def subdivided_model(name: str, longest_edge: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A model of MODELS, its triangles halved until no edge is longer than longest_edge (world units), so that flat
    triangles follow a deformation. Raises ValueError for another name."""
    import trimesh

    if name not in MODELS:
        raise ValueError(f"model {name!r} is not known: {', '.join(MODELS)}")
    vertices, faces, colours = MODELS[name]()
    vertices, faces, source = trimesh.remesh.subdivide_to_size(vertices, faces, longest_edge, return_index=True)
    return vertices, faces.astype(np.int32), colours[source]


def _facing_out(vertices, faces) -> np.ndarray:
    """Faces of a closed surface, turned if its volume came out negative."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return faces if np.einsum("fi,fi->", a, np.cross(b, c)) > 0 else faces[:, ::-1].copy()
