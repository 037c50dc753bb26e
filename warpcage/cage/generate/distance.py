"""Distances around an object that points give: of its voxels, to the nearest of its points, and closed by a ball."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
import warp as wp

from ...core.devices import launch, resolve_device
from ...core.threads import cpu_threads
from ...kernels.mesh.shell import DistanceGrid, list_near_samples, look_up_directions, look_up_faces, measure_nearest

#: Steps of a look-up, and of a search for the nearest point, as `launch` counts them.
_LOOK_UP_WORK, _SEARCH_WORK = 1, 128

#: Voxels by which interpolated distances err at most.
_ERROR = 0.5

#: How much farther than asked for is searched, so that rounding leaves what is given for the rest above it.
_BEYOND = 1.0 + 1e-9

#: Voxels about `need` in which the distances of a grid are exact, and over which they pass into those of voxels.
_EXACT, _MIXED = 1.0, 1.5


def on_cpu(values: np.ndarray, dtype) -> wp.array:
    """A Warp array of the same memory, where values are C-contiguous."""
    return wp.array(np.ascontiguousarray(values), dtype=dtype, device="cpu", copy=False)


class ObjectVoxels:
    """A solid given by points (p, 3), world units, in voxels of side `spacing`: they leave no hole wider than that.
    Near `need`, a cage's distance, distances are exact."""

    def __init__(self, points: np.ndarray, spacing: float, need: float):
        import scipy.ndimage

        self.points, self.spacing, self.need = points, float(spacing), float(need)
        self._widest = 0, np.zeros((0, 0, 0), np.float32)  # distances between voxels' middles, and to which radius
        # centre of voxel 0; the object's bounds, and points a voxel apart from there on, lie in the middle of voxels,
        # where last digits do not decide which voxel is theirs
        self.bounds = bounds_of(points)
        self.lower, self.size = self.bounds[0], float((self.bounds[1] - self.bounds[0]).max())
        cell = np.floor((points - self.lower) / spacing + 0.5).astype(np.int64)
        self.solid = np.zeros(bounds_of(cell)[1] + 1, dtype=bool)
        self.solid[tuple(cell.T)] = True
        deep = np.asarray(scipy.ndimage.binary_erosion(self.solid, np.ones((3, 3, 3), bool), iterations=2), bool)
        near = np.flatnonzero(~deep[tuple(cell.T)])  # what is two voxels below the skin is nearest to nothing
        places = np.asarray(np.ravel_multi_index(tuple(cell[near].T), self.solid.shape))
        one = first_of_each(places, self.solid.size)
        self.skin = points[near[one]]  # (n, 3) one in each voxel less than two voxels from free space
        # from far off a search among all points is slow and more than is needed: voxels stand for those they hold
        self._coarse = np.sqrt(0.75) * spacing if need > 6.0 * spacing else 0.0
        self._search = (
            NearestInTree(self.lower + cell[near[one]] * spacing)
            if self._coarse
            else NearestInVoxels(points[near], places, self.solid.shape, self.lower, spacing)
        )
        self._band = self._about_need(deep)
        self.inside_parts = self._inside_parts()

    def _about_need(self, deep) -> tuple[np.ndarray, np.ndarray]:
        """Nodes (n, 3) about `need` and their distances (n,)."""
        radius = int(np.ceil(self.need / self.spacing + _EXACT + _MIXED)) + 2
        distance = self._of_middles(radius)
        far = np.clip(np.abs(distance - self.need) / self.spacing - _EXACT, 0.0, _MIXED) / _MIXED
        nodes = np.argwhere((far < 1.0) & ~np.pad(deep, radius))
        far, found = far[tuple(nodes.T)], distance[tuple(nodes.T)]
        nodes -= radius
        # points lie at most half a diagonal from the middle of their voxel
        exact = self.exact_distance(self.lower + nodes * self.spacing, found + np.sqrt(0.76) * self.spacing)
        return nodes, (1.0 - far) * exact + far * np.minimum(found, exact)

    @property
    def certain(self) -> wp.vec3d:
        """From which distance on nodes are as far off the points as `distances` says or farther, up to which one, and
        how much farther all of them are."""
        # beyond the nodes about `need` a distance to the middles of voxels may be half a diagonal too long
        room = (_EXACT + _MIXED - np.sqrt(0.75)) * self.spacing
        return wp.vec3d(self.need - room, self.need + room, self._coarse)

    def distances(self, radius: int) -> np.ndarray:
        """From the middle of each voxel to the nearest point, `radius` voxels beyond the solid: exact near `need`,
        between voxels' middles elsewhere, 0 deep inside."""
        distance = self._of_middles(radius)
        nodes, exact = self._band
        distance[tuple((nodes + radius).T)] = exact
        return distance

    def _of_middles(self, radius: int) -> np.ndarray:
        """From the middle of each voxel to the nearest one of the solid, at most `radius` voxels and so far beyond."""
        widest, distance = self._widest
        if radius > widest:
            self._widest = widest, distance = radius, distance_to(np.pad(self.solid, radius), radius)
        inner = distance[tuple(slice(widest - radius, size + radius - widest) for size in distance.shape)]
        return np.minimum(inner, radius).astype(np.float64) * self.spacing

    @functools.cached_property
    def narrow_shell(self) -> ObjectShell:
        """The shell that closes least."""
        return ObjectShell(self, self.need + 2.0 * self.spacing)

    def exact_distance(self, x: np.ndarray, about: np.ndarray, most: np.ndarray | float = math.inf) -> np.ndarray:
        """(n,) distance from x (n, 3) to the object's skin, up to 1.8 voxels less where `need` is more than six voxels.
        `about` (n,): how far it likely is at most; beyond `most` any larger number may come. Both only save time."""
        about, beyond = np.maximum(about, 0.5 * self.spacing), (most + self._coarse) * _BEYOND
        return np.maximum(self._search.distance(x, about, beyond) - self._coarse, 0.0)

    def _inside_parts(self) -> np.ndarray:
        """(k, 3) centre of one voxel of each connected part of the object: the one nearest to the part's middle."""
        import skimage.measure

        parts = np.asarray(skimage.measure.label(self.solid, connectivity=3))
        cells = np.argwhere(self.solid)
        part = parts[tuple(cells.T)] - 1
        count = np.bincount(part)
        # a corner of a part would be half outside, and the first to be left out by what can still be moved
        middle = np.stack([np.bincount(part, weights=cells[:, k]) for k in range(3)], axis=1) / count[:, None]
        # in whole numbers of 1e-6: cells at one distance are taken by their order, not by last digits
        off = np.round(((cells - middle[part]) ** 2).sum(axis=1), 6)
        order = np.lexsort((off, part))
        return self.lower + cells[order[np.cumsum(count) - count]] * self.spacing


class ObjectShell:
    """Distances around an object's voxels, closed by a ball of radius `reach`: that fills gaps narrower than twice it.
    In a grid that reaches so far beyond them."""

    def __init__(self, voxels: ObjectVoxels, reach: float):
        import skimage.measure

        self.voxels, self.spacing, self.reach = voxels, voxels.spacing, float(reach)
        radius = int(np.ceil(reach / self.spacing)) + 3
        self.lower = voxels.lower - radius * self.spacing  # node 0
        self.distance = voxels.distances(radius)  # (nx, ny, nz) from nodes to the nearest point
        parts = np.asarray(skimage.measure.label(self.distance > reach, connectivity=1))
        outside = parts == parts[0, 0, 0]  # the corner is free, so cavities of the dilated object are not part of it
        # by the triangle inequality reach - inward never exceeds the distance to the object; the voxel nearest to the
        # true rim of what is outside may lie half a diagonal behind it, which would keep cages so much farther off
        inward = distance_to(outside, radius) * self.spacing - np.sqrt(0.75) * self.spacing
        # signed distance to the object closed by a ball of radius `reach` (Serra 1982), never above `distance`
        self.closed = np.where(outside, self.distance, np.minimum(self.distance, reach - inward)).astype(np.float64)

    @functools.cached_property
    def smooth(self) -> np.ndarray:
        """`closed`, smoothed over a voxel: for surfaces and slopes."""
        import skimage.filters

        return skimage.filters.gaussian(self.closed, 1.0, mode="nearest", truncate=3.0)

    @functools.cached_property
    def grid(self) -> Any:
        """What kernels look up, a DistanceGrid."""
        grid = DistanceGrid()
        slopes = np.empty((*self.smooth.shape, 3), dtype=np.float32)
        for axis in range(3):
            slopes[..., axis] = np.gradient(self.smooth, self.spacing, axis=axis)
        grid.distances = on_cpu(self.closed.astype(np.float32).reshape(-1), wp.float32)
        grid.slopes, grid.shape = on_cpu(slopes.reshape(-1, 3), wp.vec3), wp.vec3i(*slopes.shape[:3])
        grid.lower, grid.spacing = wp.vec3d(*self.lower), wp.float64(self.spacing)
        return grid

    def surface(
        self, level: float, step: int = 1, plane: tuple[int, float] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (v, 3), world units, and outward faces (f, 3) of the closed object's offset by `level`; where there
        is a plane (axis, place), of what lies above. `step`: voxels a side of the cubes that are marched."""
        import skimage.measure

        values, lower = self.smooth, self.lower.copy()
        if plane is not None:  # node 0 lies on it
            axis, lower[axis] = plane
            first, share = divmod(float((lower[axis] - self.lower[axis]) / self.spacing), 1.0)
            rows = np.moveaxis(values, axis, 0)[int(first) :]
            values = np.moveaxis((1.0 - share) * rows[:-1] + share * rows[1:], 0, axis)
        nodes, faces, _, _ = skimage.measure.marching_cubes(values, level=level, step_size=step)
        nodes = nodes.astype(np.float64)
        a, b, c = (nodes[faces[:, k]] for k in range(3))
        if np.einsum("fi,fi->", a, np.cross(b, c)) < 0.0:
            faces = faces[:, ::-1]
        return lower + nodes * self.spacing, np.ascontiguousarray(faces)

    def distance_on_faces(self, vertices: np.ndarray, faces: np.ndarray, pieces: int) -> np.ndarray:
        """`closed` at the samples (f, s) of faces (f, 3), as in `face_samples`; beyond the grid as at its edge."""
        found = np.empty((len(faces), (pieces + 1) * (pieces + 2) // 2))
        inputs = [on_cpu(vertices, wp.vec3d), on_cpu(faces.astype(np.int32), wp.vec3i), pieces, self.grid]
        work = _LOOK_UP_WORK * found.shape[1]
        launch(look_up_faces, len(faces), inputs, [on_cpu(found, wp.float64)], device="cpu", work=work)
        return found

    def near_samples(self, vertices, faces, pieces, levels) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Samples of faces (f, 3), cut in pieces (f,), that may be nearer to the object than levels (f,): how many of
        each face (f,), their places (n, 3) and about how far they are off (n,), face after face."""
        held = (pieces + 1) * (pieces + 2) // 2
        starts, counts = np.cumsum(held, dtype=np.int32) - held.astype(np.int32), np.zeros(len(faces), np.int32)
        places, distances = np.empty((held.sum(), 3)), np.empty(held.sum())  # of which few are written
        inputs = [on_cpu(vertices, wp.vec3d), on_cpu(faces.astype(np.int32), wp.vec3i), on_cpu(pieces, wp.int32)]
        inputs += [on_cpu(levels, wp.float64), wp.float64(_ERROR * self.spacing), self.voxels.certain]
        inputs += [self.grid, on_cpu(starts, wp.int32)]
        outputs = [on_cpu(counts, wp.int32), on_cpu(places, wp.vec3d), on_cpu(distances, wp.float64)]
        launch(list_near_samples, len(faces), inputs, outputs, device="cpu", work=256)
        listed = np.arange(counts.sum()) + np.repeat(starts - (np.cumsum(counts) - counts), counts)
        return counts, places[listed], distances[listed]

    def outward(self, x: np.ndarray) -> np.ndarray:
        """Unit directions (n, 3) in which `closed` grows fastest at x (n, 3); zero where it is flat."""
        found = np.empty(x.shape)
        inputs, work = [on_cpu(x, wp.vec3d), self.grid], 3 * _LOOK_UP_WORK
        launch(look_up_directions, len(x), inputs, [on_cpu(found, wp.vec3d)], device="cpu", work=work)
        return found


class NearestInVoxels:
    """Distances to the nearest of points (p, 3) that lie in voxels places (p,) of a grid, numbered row by row."""

    def __init__(self, points, places, shape, lower, spacing):
        starts = np.zeros(math.prod(shape) + 1, dtype=np.int32)
        np.cumsum(np.bincount(places, minlength=len(starts) - 1), out=starts[1:])
        resolve_device("cpu")  # starts Warp
        self._inputs = [
            on_cpu(points[np.argsort(places, kind="stable")], wp.vec3d),
            on_cpu(starts, wp.int32),
            wp.vec3i(*shape),
            wp.vec3d(*lower),
            wp.float64(spacing),
        ]

    @classmethod
    def of(cls, points, spacing) -> NearestInVoxels:
        """Of points (p, 3) in voxels of their own."""
        bounds = bounds_of(points)
        cell = np.floor((points - bounds[0]) / spacing + 0.5).astype(np.int64)
        shape = tuple((bounds_of(cell)[1] + 1).tolist())
        return cls(points, np.asarray(np.ravel_multi_index(tuple(cell.T), shape)), shape, bounds[0], spacing)

    def distance(self, x: np.ndarray, about: np.ndarray, most: np.ndarray | float = math.inf) -> np.ndarray:
        """(n,) distance from x (n, 3) to the nearest point, to the same bits as SciPy's KDTree; about (n,) > 0: where
        the search begins; most, for all or (n,), > 0: where it ends."""
        found, most = np.empty(len(x)), np.broadcast_to(most, len(x))
        inputs = [on_cpu(x, wp.vec3d), on_cpu(about, wp.float64), on_cpu(most, wp.float64), *self._inputs]
        launch(measure_nearest, len(x), inputs, [on_cpu(found, wp.float64)], device="cpu", work=_SEARCH_WORK)
        return found


class NearestInTree:
    """Distances to the nearest of points (p, 3), however far they are."""

    def __init__(self, points):
        import scipy.spatial

        # large leaves and no balancing: built in half the time and searched in less, for the same distances
        self._tree = scipy.spatial.KDTree(points, leafsize=32, balanced_tree=False)

    def distance(self, x: np.ndarray, about: np.ndarray, most: np.ndarray | float = math.inf) -> np.ndarray:
        """(n,) distance from x (n, 3) to the nearest point; infinite where it is more than all of `most`."""
        return self._tree.query(x, distance_upper_bound=np.max(most, initial=0.0), workers=cpu_threads())[0]


def bounds_of(points: np.ndarray) -> np.ndarray:
    """(2, 3) lower and upper corner of the box of points (n, 3): column by column, a fraction of the time of rows."""
    return np.array([[column.min() for column in points.T], [column.max() for column in points.T]])


def one_a_cell(points: np.ndarray, side: float) -> np.ndarray:
    """Indices of one of points (n, 3) in each cube of such a side that holds any."""
    cell = np.floor((points - bounds_of(points)[0]) / side).astype(np.int64)
    # numbered row by row: sorted in a fraction of the time of rows of three
    return np.unique(np.ravel_multi_index(tuple(cell.T), tuple(bounds_of(cell)[1] + 1)), return_index=True)[1]


def first_of_each(numbers: np.ndarray, count: int) -> np.ndarray:
    """Index of the first of each of the numbers (n,), 0 to count - 1, in the order of the numbers."""
    first = np.full(count, -1)
    first[numbers[::-1]] = np.arange(len(numbers))[::-1]  # of several values at one place the last stays
    return first[first >= 0]


def distance_to(mask: np.ndarray, radius: int) -> np.ndarray:
    """Euclidean distance in voxels from each voxel centre to the nearest one of `mask`, at most `radius`; float32."""
    # the smaller the numbers, the more of them pass at once; a sum of two is the largest
    kind = np.uint16 if 2 * radius * radius < 2**16 else np.uint32
    squared = np.where(mask, kind(0), kind(radius * radius))
    farther = np.empty_like(squared)
    for axis in range(3):  # exact and separable: along one axis after the other (Saito and Toriwaki 1994)
        rows = np.moveaxis(squared, axis, 0)
        nearest, room = rows.copy(order="K"), np.moveaxis(farther, axis, 0)
        for step in range(1, min(radius, len(rows) - 1) + 1):
            np.add(rows, kind(step * step), out=room)
            np.minimum(nearest[step:], room[:-step], out=nearest[step:])
            np.minimum(nearest[:-step], room[step:], out=nearest[:-step])
        squared = np.moveaxis(nearest, 0, axis)
    return np.sqrt(np.ascontiguousarray(squared).astype(np.float32))
