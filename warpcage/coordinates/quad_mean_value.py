"""Mean value coordinates of points in a cage of quads, triangles and polygons."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arrays import empty_array
from ..core.devices import launch, resolve_device
from ..kernels.coordinates.quad_mean_value import weigh_quad_mean_value
from ..mesh.mesh import prepared_quads
from ..mesh.surface import in_strips


class QuadFaces:
    """Faces as the kernels take them. A triangle names its last corner twice; a polygon of five corners and more is
    triangles around the mean of its corners."""

    def __init__(self, vertex_count: int, polygons: Sequence[Sequence[int]]):
        corners, self.centered = [], [list(face) for face in polygons if len(face) > 4]
        middles = iter(range(vertex_count, vertex_count + len(self.centered)))
        for face in polygons:
            if len(face) < 5:
                corners.append([int(corner) for corner in (*face[:3], face[-1])])
            else:
                middle = next(middles)
                corners += [[a, b, middle, middle] for a, b in zip(face, [*face[1:], face[0]], strict=True)]
        self.corners = in_strips(corners)

    def with_middles(self, values: np.ndarray) -> np.ndarray:
        """Values of vertices (v, ...) and after them those of the middles of polygons, (v + k, ...)."""
        return np.concatenate([values, *(values[face].mean(axis=0, keepdims=True) for face in self.centered)])

    def merge(self, weights: np.ndarray) -> np.ndarray:
        """Weights (n, v) of vertices from those of vertices and middles, (n, v + k)."""
        merged = weights[:, : weights.shape[1] - len(self.centered)].copy()
        for face, column in zip(self.centered, weights.T[merged.shape[1] :], strict=True):
            merged[:, face] += column[:, None] / np.float32(len(face))
        return merged

    def prepared(self, vertices: wp.array, size: float) -> tuple[wp.array, wp.array]:
        """The corners (f,) vec4i on the vertices' device, and what maps read of each face, (3 f,) vec4."""
        corners = wp.array(self.corners, dtype=wp.vec4i, device=vertices.device)
        return corners, prepared_quads(vertices, corners, size)


def quad_mean_value_weights(
    points: ArrayLike, vertices: ArrayLike, polygons: Sequence[Sequence[int]], device: wp.DeviceLike = None
) -> np.ndarray:
    """Mean value coordinates (n, v) float32 of points (n, 3) in the closed cage of vertices (v, 3) and polygons, each
    the corners of a face counterclockwise from outside: faces of four are bilinear patches."""
    faces = QuadFaces(len(np.asarray(vertices)), polygons)
    corners = faces.with_middles(np.asarray(vertices, np.float64))
    low, high = corners.min(axis=0), corners.max(axis=0)
    place = resolve_device(device)
    center, size = (low + high) / 2, (high - low).max()
    local = [
        wp.array(((np.asarray(each, np.float64) - center) / size).astype(np.float32), dtype=wp.vec3, device=place)
        for each in (points, corners)
    ]
    weights = empty_array((len(local[0]), len(corners)), wp.float32, place)
    inputs = [*local, wp.array(faces.corners, dtype=wp.vec4i, device=place), 1.0]
    launch(weigh_quad_mean_value, len(local[0]), inputs, [weights], device=place, work=len(faces.corners))
    return faces.merge(weights.numpy())
