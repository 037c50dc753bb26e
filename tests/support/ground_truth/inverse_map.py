"""The inverse of a cage's map in float64: where matter of the rest cage is seen once the cage is posed."""

from __future__ import annotations

import dataclasses

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from warpcage.coordinates.coordinates import deform_points, stretched_normals
from warpcage.core.devices import launch, resolve_device
from warpcage.core.names import POINT_COORDINATES, chosen, coordinate_kind
from warpcage.mesh.match import require_same_faces
from warpcage.mesh.mesh import ClosedMesh
from warpcage.mesh.validity import require_usable

from .inverse_map_kernels import ExactMap, assemble_layers, invert_map, map_exactly

#: Newton's iteration ends at this distance, as a share of the cage's size.
TOLERANCE = 1e-11


@dataclasses.dataclass(frozen=True)
class InversePoints:
    """Points of the posed cage that the map takes to given points of the rest cage."""

    points: np.ndarray  # (n, 3) float64 in the posed cage, world units
    residuals: np.ndarray  # (n,) float64, distance of the map of each from the point that was asked for, world units
    jacobians: np.ndarray  # (n, 3, 3) float64 of the map there, from posed to rest space


class InverseMap:
    """The map of a Deformer, x -> sum_j w_j(x) v_j with coordinates of the posed cage, and its inverse, in float64.
    "Deforming Radiance Fields with Cages" (ECCV 2022), Eq. 3: for whatever must follow a rendered field exactly."""

    def __init__(
        self,
        rest: ClosedMesh,  # usable, as the other, of the same faces
        deformed: ClosedMesh,
        coordinates: str = POINT_COORDINATES,  # "mean_value", "green" or "harmonic"
        *,
        cuts: int = 2,  # each face is cut into (2 cuts)^2 boundary elements, for harmonic coordinates only
        device: wp.DeviceLike = None,
    ):
        coordinate_kind(coordinates)
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
            # Boundary elements of constant flux stand in for the missing closed form, smaller towards the edges of a
            # face, where fluxes are singular; points nearer to the cage than an element are rough.
            corners, data = _cut_towards_edges(corners, cuts), _cut_towards_edges(data, cuts)
            density = _boundary_fluxes(corners, data, self.device)
        self._map = ExactMap()
        self._map.corners, self._map.data = _vectors(corners, self.device), _vectors(data, self.device)
        self._map.density = _vectors(density, self.device)
        self._map.is_mean_value = chosen(coordinates, "coordinates", harmonic=0, mean_value=1, green=0)
        self._map.size = wp.float64(deformed.size)

    def __call__(self, points: ArrayLike) -> np.ndarray:
        """Positions (n, 3) float64 in the rest cage of points (n, 3) in the deformed cage, world units."""
        points = np.asarray(points, np.float64).reshape(-1, 3)
        positions = wp.empty(len(points), dtype=wp.vec3d, device=self.device)  # pyright: ignore[reportArgumentType]
        inputs = [self._map, _vectors(points - self._origin, self.device)]
        launch(map_exactly, len(points), inputs, [positions], device=self.device)
        return positions.numpy() + self._target_origin

    def invert(self, points: ArrayLike) -> InversePoints:
        """Where points (n, 3) of the rest cage are in the deformed one; those reached from nowhere keep a residual."""
        points = np.asarray(points, np.float64).reshape(-1, 3)
        guesses = deform_points(points, self.rest, self.deformed, coordinates="mean_value", device=self.device)
        found = wp.empty(len(points), dtype=wp.vec3d, device=self.device)  # pyright: ignore[reportArgumentType]
        residuals = wp.empty(len(points), dtype=wp.float64, device=self.device)  # pyright: ignore[reportArgumentType]
        jacobians = wp.empty(len(points), dtype=wp.mat33d, device=self.device)  # pyright: ignore[reportArgumentType]
        targets = _vectors(points - self._target_origin, self.device)
        starts = _vectors(guesses - self._origin, self.device)
        inputs = [self._map, targets, starts, wp.float64(TOLERANCE * self.rest.size)]
        launch(invert_map, len(points), inputs, [found, residuals, jacobians], device=self.device)
        return InversePoints(found.numpy() + self._origin, residuals.numpy(), jacobians.numpy())


def _vectors(rows: np.ndarray, device: wp.DeviceLike) -> wp.array:
    """Rows (..., 3) as an array of vec3d (...) on a device."""
    return wp.array(np.ascontiguousarray(rows), dtype=wp.vec3d, device=device)


def _boundary_fluxes(corners: np.ndarray, data: np.ndarray, device: wp.DeviceLike) -> np.ndarray:
    """(e, 3) flux of the harmonic function with linear data on each element, by collocation at centroids.
    corners, data: (e, 3, 3) corners of the elements and the values there."""
    count = len(corners)
    single_layer = wp.empty((count, count), dtype=wp.float64, device=device)  # pyright: ignore[reportArgumentType]
    double_layer = wp.empty(count, dtype=wp.vec3d, device=device)  # pyright: ignore[reportArgumentType]
    inputs = [_vectors(corners, device), _vectors(data, device)]
    launch(assemble_layers, count, inputs, [single_layer, double_layer], device=device)
    return np.linalg.solve(np.asarray(single_layer.numpy(), np.float64), data.mean(axis=1) - double_layer.numpy())


def _cut_towards_edges(corners: np.ndarray, cuts: int) -> np.ndarray:
    """Triangles (f, 3, k) cut into (2 cuts)^2 each on a barycentric grid that is finer towards all edges."""
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
