"""Points of an object whose places in another pose are known, in space or in pictures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..coordinates.coordinates import deform_points, mean_value_coordinates
from ..errors import InputError
from ..mesh.mesh import ClosedMesh
from ..mesh.queries import inside_mesh
from ..splats.splat_field import SplatField
from .priors import Rigidity
from .targets import PoseTargets

#: Weight of their squares beside those of colours.
WEIGHT = 20.0

#: Weight of the rigid prior beside them where a person drags them: a tenth of `fit_pose`'s, they shall be met.
PULLED_RIGID = 0.005

#: Distances, as shares of the cage's size, above which they count linearly.
ROBUST = 0.05

#: Share of the size by which points may lie outside of the cage at rest: surfaces that are scanned are not exact.
MAX_OUTSIDE = 0.02

#: Newton steps that find where the map has a place at rest, at most; the share of the size that they may leave, and
#: that which needs no more of them.
NEWTON_STEPS, CLOSE, EXACT = 12, 1e-4, 1e-5

#: Differences of places for the map's derivatives there, as a share of the size.
DIFFERENCE = 2e-3


class PointLoss:
    """Mean square distance of points from where they should be, as shares of the cage's size."""

    # Points go by mean value weights of the cage at rest, which are linear in the pose; what the deformer's own map
    # adds to that is held, and found anew by `settle` at each step of the fit: at its end they lie where frames show
    # them, whatever the kind of coordinates.

    def __init__(self, targets: PoseTargets, rest: ClosedMesh, device: Any):
        self._targets, self._size = targets, rest.size
        self.points: np.ndarray = np.asarray(targets.points)
        for number in np.flatnonzero(~inside_mesh(self.points, rest, tolerance=MAX_OUTSIDE, device=device)):
            raise InputError(
                f"point {number} of a pose lies outside of the cage at rest, so that it does not move with it: leave "
                "it out, or take a larger cage"
            )
        self._shares = np.asarray(mean_value_coordinates(self.points, rest, device=device), np.float64)
        self._added = np.zeros_like(self.points)
        self._pixels = () if targets.pixels is None else np.asarray(targets.pixels)
        self._count = 0
        for name in ("positions", "pixels"):
            if getattr(targets, name) is not None:
                self._count += int(np.isfinite(getattr(targets, name)).all(axis=-1).sum())

    def settle(self, deformer: Any) -> None:
        """Take up where the last pose of a deformer has the points."""
        moved = self._shares @ deformer.deformed[0].vertices
        self._added = positions_of(deformer, self.points, moved) - moved

    def __call__(self, vertices: np.ndarray) -> tuple[float, np.ndarray]:
        """The loss of a pose, and its gradient (v, 3)."""
        loss, by_places = 0.0, np.zeros_like(self.points)
        for off, back in self._off(vertices):
            value, slope = robust(off, ROBUST)
            loss, by_places = loss + value, by_places + back(slope)
        scale = WEIGHT / max(self._count, 1)
        return scale * loss, scale / self._size * (self._shares.T @ by_places)

    def differences(self, vertices: np.ndarray) -> np.ndarray:
        """(m,) all distances of a pose by the root of their weight: the sum of squares is about the loss."""
        return np.sqrt(WEIGHT / max(self._count, 1)) * np.concatenate([off.ravel() for off, _ in self._off(vertices)])

    def _off(self, vertices: np.ndarray) -> list[tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]]:
        """Distances as shares of the size, zero where nothing is known; and what takes slopes by them to slopes (p, 3)
        by the places, both in units of the size."""
        places, parts = self._shares @ vertices + self._added, []
        if self._targets.positions is not None:
            known = np.isfinite(self._targets.positions).all(axis=1, keepdims=True)
            off = (places - np.where(known, self._targets.positions, 0)) / self._size
            parts.append((off * known, lambda slope, known=known: slope * known))
        for camera, pixels in zip(self._targets.cameras, self._pixels, strict=False):
            known = np.isfinite(pixels).all(axis=1, keepdims=True)
            rays = (np.where(known, pixels, 0) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
            local = (places - camera.center) @ camera.rotation
            off = (local[:, :2] - local[:, 2:] * rays) / self._size  # to the pixel's ray, at the place's depth
            axes = camera.rotation.T
            parts.append(
                (off * known, lambda slope, known=known, rays=rays, axes=axes: _placed(slope * known, rays) @ axes)
            )
        return parts


class PointPull:
    """Vertices that take points where they should be, as rigidly as possible: `fit_pose` of points alone, live."""

    # What `fit_pose` minimizes, the squares of `PointLoss` (not robust: a person has set them) and of `Rigidity`, from
    # a pose `before` that counts as rigid. By turns the best rotations, and the best vertices with these: one matrix,
    # which is factored once ("As-Rigid-As-Possible Surface Modeling", Sorkine and Alexa 2007, Section 3).

    def __init__(self, rest: ClosedMesh, before: np.ndarray, points: np.ndarray, device: Any):
        from scipy.linalg import cho_factor

        self.shares = np.asarray(mean_value_coordinates(points, rest, device=device), np.float64)
        self._rigidity = Rigidity(rest.with_vertices(before))
        self._weights = PULLED_RIGID, WEIGHT / len(points) / rest.size**2
        rigid, pull = self._weights
        self._factor = cho_factor(rigid * self._rigidity.matrix() + pull * self.shares.T @ self.shares)

    def __call__(self, vertices: np.ndarray, places: np.ndarray, turns: int) -> np.ndarray:
        """(v, 3) from a pose nearby; places (p, 3): where the points should be, by mean value weights alone."""
        from scipy.linalg import cho_solve

        rigid, pull = self._weights
        for _ in range(turns):
            right = rigid * self._rigidity.right_side(vertices) + pull * self.shares.T @ places
            vertices = cho_solve(self._factor, right)
        return vertices


def _placed(slope: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Slopes (p, 3) by places in a camera's axes, from those (p, 2) by their distances to rays."""
    return np.column_stack([slope, -(slope * rays).sum(axis=1)])


def positions_of(deformer: Any, points: np.ndarray, guess: np.ndarray) -> np.ndarray:
    """(n, 3) where the last pose of a Deformer shows places at rest (n, 3); the guess where it shows none of them."""
    rest, posed = deformer.edits[0].cage, deformer.deformed[0]
    if deformer.map == "forward" or (deformer.map is None and isinstance(deformer.field, SplatField)):
        return np.asarray(deform_points(points, rest, posed, deformer.coordinates, device=deformer.device))
    size, found = rest.size, guess.copy()
    best = np.full(len(points), np.inf)
    place, steps = guess.copy(), DIFFERENCE * size * np.concatenate([np.zeros((1, 3)), np.eye(3)])
    for _ in range(NEWTON_STEPS):
        samples = (place[:, None] + steps).reshape(-1, 3)
        canonical, _, region = deformer.to_canonical(samples, np.broadcast_to([0.0, 0.0, 1.0], samples.shape))
        canonical, mapped = canonical.reshape(-1, 4, 3), (region.reshape(-1, 4) == 2).all(axis=1)
        off = points - canonical[:, 0]
        distance = np.where(mapped, np.linalg.norm(off, axis=1), np.inf)
        better = distance < best
        best, found[better] = np.where(better, distance, best), place[better]
        if (best < EXACT * size).all():
            break
        slopes = np.swapaxes(canonical[:, 1:] - canonical[:, :1], 1, 2) / (DIFFERENCE * size)
        usable = mapped & (np.abs(np.linalg.det(slopes)) > 1e-3)
        place[usable] += np.linalg.solve(slopes[usable], off[usable, :, None])[..., 0]
    lost = best > CLOSE * size
    found[lost] = guess[lost]
    return found


def robust(difference: np.ndarray, scale: float) -> tuple[float, np.ndarray]:
    """Sum of squares that grow linearly above a scale (pseudo-Huber), and its derivatives."""
    root = np.sqrt(1 + (difference / scale) ** 2)
    return float((2 * scale**2 * (root - 1)).sum()), 2 * difference / root
