"""Mirror planes of objects and cages across the world's axes: found, and kept by vertices that move."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .distance import bounds_of

#: A function that makes vertices (v, 3) symmetric.
Mirror = Callable[[np.ndarray], np.ndarray]

#: Share of an object's size that its mirror image may lie off it, nearly everywhere, for a symmetric cage; and where.
_NEAR, _NEARLY_ALL = 0.02, 0.95

#: Points of an object that are reflected at most, and distance in sizes within which vertices are mirror images.
_MAX_POINTS, _SAME = 20_000, 1e-9


def reflected(points: np.ndarray, axis: int, middle: float) -> np.ndarray:
    """Mirror images (n, 3) of points across the plane where an axis has the value `middle`."""
    image = points.copy()
    image[:, axis] = 2.0 * middle - image[:, axis]
    return image


def partners(vertices: np.ndarray, axis: int, middle: float) -> np.ndarray:
    """(v,) the vertex nearest to the mirror image of each."""
    from scipy.spatial import KDTree

    return KDTree(vertices).query(reflected(vertices, axis, middle))[1]  # pyright: ignore[reportReturnType]


def mirror_of(partner: np.ndarray, axis: int, middle: float) -> Mirror:
    """A function that takes the mean of vertices and of the mirror images of their partners (v,)."""

    def mirrored(vertices: np.ndarray) -> np.ndarray:
        return 0.5 * (vertices + reflected(vertices[partner], axis, middle))

    return mirrored


def nearest_mirror(points: np.ndarray, spacing: float) -> str | None:
    """The axis across whose middle points (n, 3), `spacing` apart, nearly are their own mirror image, the best one; or
    None."""
    from scipy.spatial import KDTree

    tree, bounds = KDTree(points), bounds_of(points)
    some = points[:: max(1, len(points) // _MAX_POINTS)]
    limit = _NEAR * float((bounds[1] - bounds[0]).max()) + spacing
    off = {}
    for axis, name in enumerate("xyz"):
        image = reflected(some, axis, 0.5 * float(bounds[:, axis].sum()))
        distances = tree.query(image, distance_upper_bound=4.0 * limit)[0]
        distances = np.minimum(distances, 4.0 * limit)
        if np.quantile(distances, _NEARLY_ALL) <= limit:
            off[name] = round(float(distances.mean()) / limit, 3)  # of planes as good as each other the first
    return min(off, key=lambda name: off[name]) if off else None


def mirror_axes(vertices: np.ndarray) -> str:
    """The axes, of "xyz", across whose middle vertices (v, 3) are their own mirror images."""
    from scipy.spatial import KDTree

    tree, bounds = KDTree(vertices), bounds_of(vertices)
    size = float((bounds[1] - bounds[0]).max())
    images = (reflected(vertices, axis, 0.5 * float(bounds[:, axis].sum())) for axis in range(3))
    far = [tree.query(image)[0].max() > _SAME * size for image in images]
    return "".join(name for name, off in zip("xyz", far, strict=True) if not off)
