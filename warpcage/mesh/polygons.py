"""Cut a polygon into triangles that do not fold, concave or not."""

from __future__ import annotations

import heapq
from collections.abc import Sequence

import numpy as np

from ..errors import InputError

#: Most corners of a polygon that is cut ear by ear, which takes two seconds for as many. Convex ones may have more.
MAX_CORNERS = 4096


def cut_polygon(vertices: np.ndarray, polygon: list[int]) -> list[tuple[int, int, int]]:
    """Triangles over a polygon of n of the vertices (v, 3), wound as it is: n - 2 times three indices of vertices."""
    # The fan from its first vertex where the polygon is convex or has no area; else ears are cut off, the best shaped
    # first (Meisters 1975), in the plane that fits the polygon, the same whatever vertex it begins at.
    fan = [(polygon[0], polygon[k], polygon[k + 1]) for k in range(1, len(polygon) - 1)]
    points = vertices[polygon] - vertices[polygon[0]]
    normal = 0.5 * np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)  # Newell 1972
    length = np.linalg.norm(normal)
    if length == 0.0 or not np.isfinite(length):
        return fan
    normal /= length
    heights = _heights(vertices, np.array(fan), normal)
    turns = _heights(points, _turns(len(polygon)), normal)
    if (heights > 1e-9 * length).all() and (turns > -1e-9 * length).all():
        return fan
    if len(polygon) > MAX_CORNERS:
        if (heights > 0.0).all():  # a disc of so many corners has slivers
            return fan
        raise InputError(
            f"a face of {len(polygon)} corners is not convex, at most {MAX_CORNERS} are cut into triangles: cut it in "
            "the program that made it"
        )
    first = int(np.lexsort(vertices[polygon].T)[0])
    polygon = [*polygon[first:], *polygon[:first]]
    points = vertices[polygon]
    around = points - points[0]
    normal = np.cross(around, np.roll(around, -1, axis=0)).sum(axis=0)  # summed in this order, to the last bit
    return EarCutter(points, polygon, normal / np.linalg.norm(normal)).cut()


def _turns(count: int) -> np.ndarray:
    """(n, 3) places of the corner before each of a polygon, of itself, and of the one after it."""
    return (np.arange(count)[:, None] + [-1, 0, 1]) % count


def concave_polygons(vertices: np.ndarray, polygons: Sequence[Sequence[int]]) -> dict[int, list[tuple[int, int, int]]]:
    """Number and triangles, of places in it, of each polygon of vertices (v, 3) that `cut_polygon` cuts to no fan.
    Those that name vertices that are not there are left out."""
    there = [bool(polygon) and min(polygon) >= 0 and max(polygon) < len(vertices) for polygon in polygons]
    sizes, found = np.array([len(polygon) * known for polygon, known in zip(polygons, there, strict=True)]), {}
    for size in np.unique(sizes[sizes > 3]).tolist():
        numbers = np.flatnonzero(sizes == size).tolist()
        corners = vertices[np.array([polygons[number] for number in numbers])]
        around = corners - corners[:, :1]
        normal = np.cross(around, np.roll(around, -1, axis=1)).sum(axis=1, keepdims=True)
        backward = (np.cross(around[:, 1:-1], around[:, 2:]) * normal).sum(axis=2).min(axis=1) <= 0.0
        before, here, after = np.moveaxis(around[:, _turns(size)], 2, 0)
        backward |= (np.cross(here - before, after - here) * normal).sum(axis=2).min(axis=1) < 0.0
        fan = [(0, k, k + 1) for k in range(1, size - 1)]
        cuts = {int(k): cut_polygon(corners[k], list(range(size))) for k in np.flatnonzero(backward)}
        found |= {numbers[k]: triangles for k, triangles in cuts.items() if triangles != fan}
    return found


def _heights(vertices, triangles, normal) -> np.ndarray:
    """Area of triangles (t, 3) seen along the normal; negative where they look backward."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return 0.5 * np.cross(b - a, c - a) @ normal


class EarCutter:
    """Cuts ears off a polygon, the best one each time."""

    # A cut changes the two ears beside it, and those that its corner blocked: each remembers one corner in its way
    # until that goes. Ears see the corners near along one axis: n corners take a few n looks, not n^2.

    def __init__(self, points: np.ndarray, polygon: list[int], normal: np.ndarray):
        """points (n, 3): places of the corners; polygon: their n indices; normal: (3,) unit vector."""
        count = len(polygon)
        self.points, self.normal = points, normal
        self.indices = np.array(polygon)
        self.before, self.after = [k - 1 for k in range(count)], [k + 1 for k in range(count)]
        self.before[0], self.after[-1] = count - 1, 0
        self.left, self.alive = count, np.ones(count, bool)
        self.axis = int(np.argmax(np.ptp(points, axis=0)))
        self.order = np.argsort(points[:, self.axis], kind="stable")
        self.along = points[self.order, self.axis]
        self.looks = [0] * count
        self.blocked: list[set[int]] = [set() for _ in range(count)]  # ears that a corner is in the way of
        self.best: list[tuple[float, int, int]] = []  # a heap of (-quality, corner, number of the look)
        for corner in range(count):
            self._look(corner)

    def cut(self) -> list[tuple[int, int, int]]:
        """The triangles."""
        triangles = []
        while self.left > 3:
            _, corner, look = heapq.heappop(self.best)
            if not self.alive[corner] or look != self.looks[corner]:
                continue
            ear = self.before[corner], corner, self.after[corner]
            triangles.append(self._triangle(ear))
            self.alive[corner], self.left = False, self.left - 1
            self.after[ear[0]], self.before[ear[2]] = ear[2], ear[0]
            for changed in {ear[0], ear[2], *self.blocked[corner]}:
                if self.alive[changed]:
                    self._look(changed)
        a, b, c = np.flatnonzero(self.alive).tolist()
        return [*triangles, self._triangle((a, b, c))]

    def _triangle(self, ear: tuple[int, int, int]) -> tuple[int, int, int]:
        a, b, c = self.indices[list(ear)].tolist()
        return a, b, c

    def _look(self, corner: int) -> None:
        """Put the ear at a corner on the heap, as it is now."""
        self.looks[corner] += 1
        heapq.heappush(self.best, (-self.quality(corner), corner, self.looks[corner]))

    def quality(self, corner: int) -> float:
        """Area over the square of the longest side; below zero where the ear looks backward or holds another corner."""
        ear = [self.before[corner], corner, self.after[corner]]
        a, b, c = self.points[ear]
        area = float(0.5 * np.cross(b - a, c - a) @ self.normal)
        longest = max(float(((p - q) ** 2).sum()) for p, q in ((a, b), (b, c), (c, a)))
        if area <= 0.0 or longest == 0.0:
            return -1.0 + area / max(longest, 1e-300)
        span = self.points[ear, self.axis]
        room = 1e-6 * longest**0.5
        first, last = np.searchsorted(self.along, (span.min() - room, span.max() + room))
        near = self.order[first:last]
        # distances from the three sides, times their lengths
        inward = np.cross(self.normal, self.points[[ear[1], ear[2], ear[0]]] - self.points[ear])
        of_sides = np.array([(a - b) @ inward[0], 0.0, (c - b) @ inward[2]])
        inside = ((self.points[near] - b) @ inward.T - of_sides).min(axis=1) >= -1e-9 * longest
        for index in self.indices[ear]:  # a polygon may come to a vertex twice
            inside &= self.indices[near] != index
        inside &= self.alive[near]
        if not inside.any():
            return area / longest
        self.blocked[near[int(inside.argmax())]].add(corner)
        return -0.5
