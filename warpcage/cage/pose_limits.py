"""What a pose does to lengths, on the faces of a cage and inside it, in float64: the limits of random poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..coordinates.reference_mvc import mean_value_gradients
from ..mesh.faces import column_dot, face_edges
from ..mesh.mesh import ClosedMesh
from ..mesh.queries import intersecting_faces
from ..mesh.validity import first_problem, winding_numbers
from .check import grid_points

#: About how many places inside a cage are looked at.
SAMPLES = 300

#: Length of finite differences, as a share of the size. In float64 they are right to six digits.
DIFFERENCE = 1e-6

#: Samples are this far from the surface, as a share of their distance from each other; nearer where a cage is so thin
#: that few are left.
CLEARANCES = (0.15, 0.01, 0.001)

#: As many are enough, as a share of those that were asked for.
ENOUGH = 0.3


@dataclass(frozen=True)
class Stretch:
    """Least and largest length after a pose over the length before, over all directions."""

    # 0 or less where space is turned inside out, or where matter is sent out of the posed cage
    least: float
    largest: float

    def within(self, least: float, largest: float) -> bool:
        """Whether both lie between two bounds."""
        return self.least >= least and self.largest <= largest

    def __or__(self, other: Stretch) -> Stretch:
        return Stretch(min(self.least, other.least), max(self.largest, other.largest))


class PoseProbe:
    """Measures poses of one usable cage, at about `samples` places inside."""

    # Inside, a pose moves matter by mean value coordinates, in one of two ways: the coordinates of the cage at rest
    # carry points along ("forward", as meshes and splats go), and those of the posed cage say where a place has its
    # matter from ("backward", as fields are rendered; paper, section 3). The first are linear in the posed vertices:
    # their gradients are worked out once, which makes `forward` quick. `backward` takes some hundredths of a second.

    def __init__(self, rest: ClosedMesh, samples: int = SAMPLES):
        self.rest = rest
        self._step = DIFFERENCE * rest.size
        self.places = _places(rest, samples)
        self._weights, gradients = mean_value_gradients(self.places, rest, self._step)
        self._gradients = gradients.reshape(-1, len(rest.vertices))
        self._crossing = {tuple(pair) for pair in intersecting_faces(rest.vertices, rest.faces).tolist()}

    def faces(self, posed: ClosedMesh) -> Stretch:
        """How much faces stretch: the singular values of the maps of their planes."""
        # in the frame of a face at rest, u along its first edge, the map takes [u, v] = [[a, b], [0, c]] to [s, t]
        u, v = face_edges(self.rest)
        s, t = face_edges(posed)
        a = np.sqrt(column_dot(u, u))
        b = column_dot(u, v) / a
        c = np.sqrt(column_dot(v - u * (b / a), v - u * (b / a)))
        first, second = s / a, (t - s * (b / a)) / c
        p, q, r = column_dot(first, first), column_dot(first, second), column_dot(second, second)
        mean, half = 0.5 * (p + r), np.sqrt(0.25 * (p - r) ** 2 + q * q)
        return Stretch(float(np.sqrt(np.maximum(mean - half, 0.0)).min()), float(np.sqrt(mean + half).max()))

    def forward(self, posed: ClosedMesh) -> Stretch:
        """How much the inside stretches as points are carried along; the least is 0 or less where det J <= 0."""
        jacobian = (self._gradients @ posed.vertices).reshape(-1, 3, 3)
        least, largest = _singular_values(jacobian)
        return Stretch(least, largest)

    def backward(self, posed: ClosedMesh) -> Stretch:
        """How much the inside stretches in pictures of the pose.
        The least is 0 where det J <= 0, and where a sample is carried out of the posed cage."""
        if not len(self.places):
            return Stretch(1.0, 1.0)
        places = self._weights @ (posed.vertices - posed.vertices[0]) + posed.vertices[0]
        if not _inside(places, posed).all():
            return Stretch(0.0, 1.0)
        _, gradients = mean_value_gradients(places, posed, self._step)
        least, largest = _singular_values(np.matmul(gradients, self.rest.vertices))
        # 1 over the singular values of the map posed -> rest, at the places where the samples are carried to
        return Stretch(1.0 / largest, 1.0 / least) if least > 0.0 else Stretch(0.0, 1.0)

    def crosses(self, posed: ClosedMesh) -> bool:
        """Whether faces cross that do not at rest, or the pose cannot be used."""
        if first_problem(posed):
            return True
        found = intersecting_faces(posed.vertices, posed.faces).tolist()
        return any(tuple(pair) not in self._crossing for pair in found)


def _places(rest: ClosedMesh, samples: int) -> np.ndarray:
    """About so many places (n, 3) inside a cage, clear of its surface; none where it is too thin for any."""
    points, spacing = grid_points(rest, samples)
    places = points[:0]
    for clearance in CLEARANCES:
        around = clearance * spacing * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
        inside = _inside((points[:, None] + around).reshape(-1, 3), rest).reshape(-1, 7).all(axis=1)
        places = points[inside]
        if len(places) >= ENOUGH * samples:
            break
    return places


def _inside(points: np.ndarray, mesh: ClosedMesh) -> np.ndarray:
    """Whether points (n, 3) are inside a mesh, by winding numbers in float64."""
    return winding_numbers(points, mesh.vertices, mesh.faces) > 0.5


def _singular_values(jacobian: np.ndarray) -> tuple[float, float]:
    """Least and largest singular value of matrices (n, 3, 3), the least negated where one turns inside out."""
    if not len(jacobian):
        return 1.0, 1.0
    values = np.linalg.svd(jacobian, compute_uv=False)
    folded = np.linalg.det(jacobian) <= 0.0
    return (-1.0 if folded.any() else 1.0) * float(values[:, 2].min()), float(values[:, 0].max())
