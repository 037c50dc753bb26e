"""The inverse of a cage's map in float64: where matter of the rest cage is seen once the cage is posed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from ..coordinates.deform import deform_points, stretched_normals
from ..core.devices import launch, resolve_device
from ..core.names import KINDS
from ..kernels.reference.inverse_map import ExactMap, assemble_layers, invert_map, map_exactly
from ..mesh.match import require_same_faces
from ..mesh.usable import require_usable

#: Newton's iteration ends here, as a share of the cage's size.
TOLERANCE = 1e-11


@dataclass(frozen=True)
class InversePoints:
    """points (n, 3) float64 in the posed cage; residuals (n,), how far the map of each is from what was asked, world
    units; jacobians (n, 3, 3) of the map there, from posed to rest space."""

    points: np.ndarray
    residuals: np.ndarray
    jacobians: np.ndarray


class InverseMap:
    """The map of a Deformer, x -> sum_j w_j(x) v_j with coordinates of the deformed cage, and its inverse, in float64.

    rest, deformed: usable Cages of the same faces. coordinates: "mean_value", "green" (closed forms) or "harmonic"
    (boundary elements: each face in (2 cuts)**2 elements of constant flux, smaller towards its edges, where fluxes are
    singular). For references and for what must follow a rendered field exactly; points within an element of the cage
    are rough for harmonic coordinates.
    Raises ValueError for cages that differ in faces, are not usable, or another name of coordinates.

    Source: "Deforming Radiance Fields with Cages" (ECCV 2022), Eq. 3; see kernels/reference/inverse_map.py.
    """

    def __init__(self, rest, deformed, coordinates: str = "mean_value", *, cuts: int = 2, device=None):
        if coordinates not in KINDS:
            raise ValueError(f"coordinates must be one of {', '.join(KINDS)}, got {coordinates!r}")
        require_usable(rest, "rest cage")
        require_usable(deformed, "deformed cage")
        require_same_faces(rest, deformed)
        self.device = resolve_device(device)
        self.rest, self.deformed, self.coordinates = rest, deformed, coordinates
        self._origin = deformed.bounds.mean(axis=0)
        self._target_origin = rest.bounds.mean(axis=0)
        corners = (deformed.vertices - self._origin)[deformed.faces]
        data = (rest.vertices - self._target_origin)[rest.faces]
        density = np.zeros((len(corners), 3))
        if coordinates == "green":
            density = stretched_normals(deformed, rest)
        elif coordinates == "harmonic":
            corners, data = _cut_towards_edges(corners, cuts), _cut_towards_edges(data, cuts)
            density = self._fluxes(corners, data)
        self._map = ExactMap()
        self._map.corners, self._map.data = self._send2(corners), self._send2(data)
        self._map.density = self._send(density)
        self._map.is_mean_value = int(coordinates == "mean_value")
        self._map.size = wp.float64(deformed.size)

    def __call__(self, points) -> np.ndarray:
        """Positions (n, 3) float64 in the rest cage of points (n, 3) in the deformed one, world units."""
        points = np.asarray(points, np.float64).reshape(-1, 3)
        positions = wp.empty(len(points), dtype=wp.vec3d, device=self.device)
        launch(
            map_exactly, len(points), [self._map, self._send(points - self._origin)], [positions], device=self.device
        )
        return positions.numpy() + self._target_origin

    def invert(self, points) -> InversePoints:
        """Where points (n, 3) of the rest cage, world units, are in the deformed cage.

        A point that the map reaches from nowhere keeps a residual: look at `residuals`.
        """
        points = np.asarray(points, np.float64).reshape(-1, 3)
        guesses = deform_points(points, self.rest, self.deformed, coordinates="mean_value", device=self.device)
        found = wp.empty(len(points), dtype=wp.vec3d, device=self.device)
        residuals = wp.empty(len(points), dtype=wp.float64, device=self.device)
        jacobians = wp.empty(len(points), dtype=wp.mat33d, device=self.device)
        inputs = [
            self._map,
            self._send(points - self._target_origin),
            self._send(guesses - self._origin),
            wp.float64(TOLERANCE * self.rest.size),
        ]
        launch(invert_map, len(points), inputs, [found, residuals, jacobians], device=self.device)
        return InversePoints(found.numpy() + self._origin, residuals.numpy(), jacobians.numpy())

    def _fluxes(self, corners: np.ndarray, data: np.ndarray) -> np.ndarray:
        """(f, 3) flux of the harmonic function with linear data on each element, by collocation at centroids."""
        count = len(corners)
        single = wp.empty((count, count), dtype=wp.float64, device=self.device)
        double = wp.empty(count, dtype=wp.vec3d, device=self.device)
        launch(assemble_layers, count, [self._send2(corners), self._send2(data)], [single, double], device=self.device)
        return np.linalg.solve(single.numpy(), data.mean(axis=1) - double.numpy())

    def _send(self, rows: np.ndarray) -> wp.array:
        return wp.array(np.ascontiguousarray(rows), dtype=wp.vec3d, device=self.device)

    def _send2(self, rows: np.ndarray) -> wp.array:
        return wp.array2d(np.ascontiguousarray(rows), dtype=wp.vec3d, device=self.device)


def _cut_towards_edges(corners: np.ndarray, cuts: int) -> np.ndarray:
    """Triangles (f, 3, k) cut in (2 cuts)**2 each on a grid of barycentric coordinates, narrower towards all edges."""
    count = 2 * cuts
    even = np.linspace(0, 1, count + 1)
    narrowed = np.where(even < 0.5, 2 * even**2, 1 - 2 * (1 - even) ** 2)
    grid = {}
    for i in range(count + 1):
        for j in range(count + 1 - i):
            place = narrowed[[i, j, count - i - j]]
            grid[i, j] = place / place.sum()
    upright = [(grid[i + 1, j], grid[i, j + 1], grid[i, j]) for i in range(count) for j in range(count - i)]
    turned = [
        (grid[i + 1, j + 1], grid[i, j + 1], grid[i + 1, j]) for i in range(count - 1) for j in range(count - 1 - i)
    ]
    return np.einsum("eac,fck->feak", np.array(upright + turned), corners).reshape(-1, 3, corners.shape[2])
