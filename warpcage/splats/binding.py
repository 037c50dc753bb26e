"""Points bound to a cage at rest: coordinates and their gradients once, then a weighted sum for each pose."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ..coordinates.harmonic import WeightGaps
from ..core.arrays import empty_array
from ..core.devices import launch
from ..core.memory import require_memory
from ..kernels.splats import green_rows, lattice_rows, mean_value_rows, pose
from ..lattice.harmonic import HarmonicSolver
from ..lattice.lattice import CageLattice
from ..lattice.position_map import fit_affine
from ..mesh.closed_mesh import ClosedMesh
from ..mesh.faces import StretchTarget, stretched_normals

#: Points that are bound in one launch: their sums in float64 take 32 bytes a vertex.
CHUNK = 1 << 15

#: Cells along the longest side of the lattice of harmonic coordinates, where nobody asks for another number.
RESOLUTION = 128


class CageBinding:
    """Points in a cage at rest, and where a pose of it takes them, with the Jacobian of the map there.

    A pose costs one weighted sum a point: phi(x) = A x + t + sum_j w_j(x) r_j (kernels/splats/pose.py).

    Args:
        points: (m, 3) world units, inside the cage, 1e-5 of its size or more from its faces.
        cage: The cage at rest, usable.
        coordinates: "harmonic", "mean_value" or "green".
        origin: (3,) world point that positions on the device are relative to.
        device: Warp device.
        resolution: Harmonic only: cells of the lattice along the cage's longest side.

    Raises:
        ValueError: For too little memory.

    Attributes:
        rows: (j, m) vec4, weight and gradient (per size of the cage) of each vertex (Green: then of each face).
    """

    def __init__(
        self,
        points: np.ndarray,
        cage: ClosedMesh,
        coordinates: str,
        origin: np.ndarray,
        device: wp.Device,
        resolution: int | None = None,
    ):
        self._cage, self._kind, self._origin, self._device = cage, coordinates, origin, device
        count = len(points)
        height = len(cage.vertices) + (len(cage.faces) if coordinates == "green" else 0)
        chunk = 0 if coordinates == "harmonic" else min(CHUNK, count)
        require_memory(
            16 * height * count + 32 * len(cage.vertices) * chunk,
            device,
            f"{count} splats bound to a cage of {len(cage.vertices)} vertices need {{size}}: take a cage of fewer, or "
            "fewer splats",
        )
        self.rows = _columns(height, count, wp.vec4, device)
        if coordinates == "harmonic":
            self._bind_lattice(points, resolution or RESOLUTION)
            return
        centre = cage.bounds.mean(axis=0)
        local = wp.array((points - centre) / cage.size, dtype=wp.vec3d, device=device)
        vertices = wp.array((cage.vertices - centre) / cage.size, dtype=wp.vec3d, device=device)
        faces = wp.array(cage.faces, dtype=wp.vec3i, device=device)
        scratch = _columns(len(cage.vertices), max(chunk, 1), wp.vec4d, device)
        kernel = green_rows.bind_green if coordinates == "green" else mean_value_rows.bind_mean_value
        for begin in range(0, count, CHUNK):
            inputs = [begin, local, vertices, faces, scratch]
            items = min(CHUNK, count - begin)
            launch(kernel, items, inputs, [self.rows], device=device, work=4 * len(cage.faces))

    def _bind_lattice(self, points: np.ndarray, resolution: int) -> None:
        """Rows of harmonic coordinates."""
        cage, device = self._cage, self._device
        centre = cage.bounds.mean(axis=0)
        local = cage.with_vertices((cage.vertices - centre) / cage.size)
        lattice = CageLattice(local, resolution, device=device)
        places = ((points - centre) / cage.size - lattice.lower) / lattice.spacing
        places = wp.array(places.astype(np.float32), dtype=wp.vec3, device=device)
        solver = HarmonicSolver(lattice)
        solver.prepare()
        gaps = WeightGaps(solver)
        for column, selected in solver.solve_vertices():
            inputs = [column, 1.0 / lattice.spacing, gaps.cage_map(selected), places]
            launch(lattice_rows.bind_lattice, len(points), inputs, [self.rows], device=device)
        gaps.report()
        launch(lattice_rows.settle_rows, len(points), [], [self.rows], device=device)

    def targets(self, deformed: ClosedMesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What a pose is made of, for `carry`.

        Args:
            deformed: The posed cage.

        Returns:
            r (j, 3), A - 1 (3, 3) and t (3,) float64, relative to the origin: of vertices, and for Green coordinates of
            the stretched normals times the size.
        """
        rest = self._cage
        if self._kind == "green":
            matrix, shift = fit_similarity(rest.vertices - self._origin, deformed.vertices - self._origin)
            normals = stretched_normals(rest, StretchTarget.of(deformed)).T
            own = stretched_normals(rest, StretchTarget.of(rest)).T
            tilt = rest.size * (normals - own @ matrix.T)
        else:
            matrix, offset = fit_affine(rest, deformed)
            shift = offset - self._origin + matrix @ self._origin
            tilt = np.zeros((0, 3))
        local = rest.vertices - self._origin
        residual = (deformed.vertices - self._origin) - (local @ matrix.T + shift)
        return np.concatenate([residual, tilt]), matrix - np.eye(3), shift

    def carry(
        self, deformed: ClosedMesh, members: wp.array, anchors: wp.array, offsets: wp.array, carried: Any
    ) -> None:
        """Take the bound points to a pose.

        Args:
            deformed: The posed cage.
            members: (m,) int32, which of the splats they are.
            anchors: (m,) vec3, the bound points, relative to the origin.
            offsets: (m,) vec3, from each to the centre of its splat.
            carried: A CarriedSplats of kernels/splats/pose.py that takes them.
        """
        residuals, slope, shift = self.targets(deformed)
        residuals = wp.array(residuals.astype(np.float32), dtype=wp.vec3, device=self._device)
        inputs = [
            *(members, anchors, offsets, self.rows, residuals),
            *(wp.mat33(*slope.ravel()), wp.vec3(*shift), 1.0 / self._cage.size, carried),
        ]
        launch(pose.carry_bound, members.size, inputs, device=self._device, work=len(residuals))


def _columns(height: int, count: int, dtype: Any, device: wp.Device) -> wp.array:
    """An array (height, count) whose columns lie together on the CPU, where a thread walks down one after another, and
    whose rows do on CUDA, where the threads of a warp walk side by side."""
    if device.is_cpu:
        return empty_array((count, height), dtype, device).transpose([1, 0])
    return empty_array((height, count), dtype, device)


def fit_similarity(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The similarity that takes points nearest to others (Umeyama 1991).

    Args:
        source: (v, 3).
        target: (v, 3).

    Returns:
        Matrix (3, 3), a rotation times a scale, and offset (3,), float64.
    """
    centre, middle = source.mean(axis=0), target.mean(axis=0)
    a, b = source - centre, target - middle
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    scale = (s * sign).sum() / (a**2).sum()
    matrix = scale * (u * sign) @ vt
    return matrix, middle - matrix @ centre
