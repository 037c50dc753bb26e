"""Mirror planes of objects and cages across the world's axes: found, and kept by vertices that move."""

from __future__ import annotations

import dataclasses

import numpy as np

from .distance import NearestInVoxels, bounds_of

#: Share of an object's size that its mirror image may lie off it, nearly everywhere, for a symmetric cage; and where.
_NEAR, _NEARLY_ALL = 0.02, 0.95

#: Points of an object that are reflected at most, and distance in sizes within which vertices are mirror images.
_MAX_POINTS, _SAME = 20_000, 1e-9


def reflected(points: np.ndarray, axis: int, middle: float) -> np.ndarray:
    """Mirror images (n, 3) of points across the plane where an axis has the value `middle`."""
    image = points.copy()
    image[:, axis] = 2.0 * middle - image[:, axis]
    return image


@dataclasses.dataclass(frozen=True)
class Mirror:
    """A plane where an axis has the value middle, and the vertex across it of each (v,), itself where it lies on it."""

    axis: int
    middle: float
    partner: np.ndarray

    @classmethod
    def of(cls, vertices: np.ndarray, plane: tuple[int, float]) -> Mirror:
        """Of vertices that are nearest to their own mirror images."""
        from scipy.spatial import KDTree

        return cls(*plane, np.asarray(KDTree(vertices).query(reflected(vertices, *plane))[1]))

    def __call__(self, vertices: np.ndarray) -> np.ndarray:
        """The mean of vertices and of the mirror images of their partners."""
        return 0.5 * (vertices + reflected(vertices[self.partner], self.axis, self.middle))

    def farther(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Symmetric vertices moved from before, symmetric, to after or as the mirror image of their partners, by what
        is more: a mean would take back half of what only one side has found."""
        image = reflected(after[self.partner], self.axis, self.middle)
        own = ((after - before) ** 2).sum(axis=1)
        return self(np.where((own >= own[self.partner])[:, None], after, image))

    def renumbered(self, number: np.ndarray) -> Mirror:
        """Once each vertex has another number (v,), those of a pair that became one having the same."""
        partner = np.empty(number.max() + 1, dtype=np.int64)
        partner[number] = number[self.partner]
        return dataclasses.replace(self, partner=partner)


def joined_halves(vertices: np.ndarray, faces: np.ndarray, plane: tuple[int, float]) -> tuple[np.ndarray, np.ndarray]:
    """The closed surface of a half (v, 3), (f, 3) above a plane, whose rim goes there, and of its mirror image."""
    axis, middle = plane
    starts, ends = faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)
    there, back = starts * len(vertices) + ends, ends * len(vertices) + starts
    rim = np.zeros(len(vertices), dtype=bool)
    rim[starts[~np.isin(there, back)]] = True
    vertices = vertices.copy()
    vertices[rim, axis] = middle
    faces = faces[~rim[faces].all(axis=1)]  # in the plane
    used, faces = np.unique(faces, return_inverse=True)
    vertices, rim, faces = vertices[used], rim[used], faces.reshape(-1, 3)
    number = np.where(rim, np.arange(len(used)), len(used) - 1 + np.cumsum(~rim))
    both = np.concatenate([vertices, reflected(vertices[~rim], axis, middle)])
    return both, np.concatenate([faces, number[faces][:, ::-1]])


def nearest_mirror(points: np.ndarray, spacing: float) -> str | None:
    """The axis across whose middle points (n, 3), `spacing` apart, nearly are their own mirror image, the best one; or
    None."""
    tree, bounds = NearestInVoxels.of(points, spacing), bounds_of(points)
    some = points[:: max(1, len(points) // _MAX_POINTS)]
    limit = _NEAR * float((bounds[1] - bounds[0]).max()) + spacing
    off = {}
    for axis, name in enumerate("xyz"):
        image = reflected(some, axis, 0.5 * float(bounds[:, axis].sum()))
        distances = tree.distance(image, np.full(len(image), spacing), 4.0 * limit)
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
