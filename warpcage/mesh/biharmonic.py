"""Biharmonic maps of a cage: what its faces carry besides vertices and slopes, from one dense system a source cage."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..core.arrays import empty_array
from ..core.devices import launch
from ..errors import InputError
from ..kernels.coordinates.biharmonic import fill_equations
from .mesh import ClosedMesh

#: Triangles of a cage, at most: the system has twice as many unknowns (134 MB of this many), and takes seconds then.
MAX_FACES = 2048

#: Winding numbers farther from one are those of cages that pass through themselves.
WINDING_SLACK = 1e-3

#: Largest error that keeping layers in float32 makes at the middle of a face, as a share of the cage's size.
MAX_ROUNDING = 1e-3


def require_few_faces(count: int) -> None:
    """Refuse cages of too many triangles."""
    if count > MAX_FACES:
        raise InputError(
            f"biharmonic coordinates are for cages of up to {MAX_FACES} triangles, this one has {count}: "
            "take a simpler cage, or other coordinates"
        )


class LayerEquations:
    """The equations of Laplacians and their slopes on faces; see kernels/coordinates/biharmonic.py."""

    # The device fills them, the host solves them, both in float64. Lengths are shares of the cage's size in here.

    def __init__(self, cage: ClosedMesh, faces: np.ndarray, size: float, device: wp.DeviceLike):
        """faces: (f, 3) int32, in any order; size: of the cage, in the unit of slopes and layers outside of here."""
        self._faces, self._cage, self._size = faces, cage, size
        corners, count = len(cage.vertices), len(faces)
        require_few_faces(count)
        local = (cage.vertices - cage.bounds.mean(axis=0)) / cage.size
        vertices = wp.array(local, dtype=wp.vec3d, device=device)
        triangles = wp.array(faces, dtype=wp.vec3i, device=device)
        known = empty_array((2 * count, corners + count), wp.float64, device)
        unknown = empty_array((2 * count, 2 * count), wp.float64, device)
        winding = empty_array(count, wp.float64, device)
        launch(fill_equations, count, [vertices, triangles], [known, unknown, winding], device=device, work=5 * count)
        self._known: np.ndarray = known.numpy()
        self._unknown: np.ndarray = unknown.numpy()
        # in another part of the cage a map is the sum of two: such faces have no more than Green coordinates give them
        without = np.flatnonzero(np.abs(winding.numpy() - 1.0) > WINDING_SLACK)
        self._without = np.concatenate([without, count + without])
        self._unknown[self._without] = 0.0
        self._unknown[self._without, self._without] = 1.0

    def solve(self, values: np.ndarray, slopes: np.ndarray) -> np.ndarray:
        """(3 f, 3): slopes (f, 3) as given, then Laplacians, then their slopes, for values (v, 3) at vertices."""
        given = np.concatenate([values, self._size * slopes])
        sides = np.concatenate([values[self._faces].mean(axis=1), self._size * slopes]) - self._known @ given
        return np.concatenate([slopes, self._solved(sides, np.eye(3) / self._size)])

    def row_operator(self) -> np.ndarray:
        """(v + 3 f, u + f): what layers of vertices and faces multiply, from values at the u vertices that the others
        follow from and slopes on faces."""
        corners, count = len(self._cage.vertices), len(self._faces)
        sides = -self._known
        rows = np.arange(count)
        for k in range(3):
            sides[rows, self._faces[:, k]] += 1.0 / 3.0
        sides[count + rows, corners + rows] += 1.0
        sides[:, corners:] *= self._size
        signs = np.resize([1.0, -1.0], corners + count) / np.repeat([1.0, self._size], (corners, count))
        everything = np.concatenate([np.eye(corners + count), self._solved(sides, signs[:, None])])
        if self._cage.operator is None:
            return everything
        return np.concatenate([everything[:, :corners] @ self._cage.operator, everything[:, corners:]], axis=1)

    def _solved(self, sides: np.ndarray, shares: np.ndarray) -> np.ndarray:
        """Laplacians and their slopes (2 f, n) that leave nothing of right sides (2 f, n).
        shares: (n, k), sums of columns whose digits are looked at, as shares of the cage's size."""
        sides[self._without] = 0.0
        try:
            solved = np.linalg.solve(self._unknown, sides)
        except np.linalg.LinAlgError:
            solved = np.full_like(sides, np.nan)
        if not np.isfinite(solved).all():
            raise InputError(
                "no biharmonic coordinates are found: faces of the cage lie on each other; take them apart"
            )
        count = len(self._faces)
        lost = self._unknown[:count] @ (solved.astype(np.float32) @ shares) - sides[:count] @ shares
        if not np.abs(lost).max(initial=0.0) <= MAX_ROUNDING:
            raise InputError(
                "biharmonic coordinates lose their digits: faces of the cage are too thin, or its sides too near each "
                "other; make its faces more even, or take other coordinates"
            )
        solved[:count] /= self._size**2
        solved[count:] /= self._size**3
        return solved
