"""Harmonic coordinates at points."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import warp as wp

from ..coordinate_kinds import COORDINATE_KINDS
from ..core.arrays import PointsLike, WarpStruct, as_given, as_host_points, empty_array, points_device, points_in_turn
from ..core.checks import warn_caller
from ..core.devices import launch
from ..core.memory import require_memory
from ..core.names import agreed
from ..core.reports import Progress
from ..errors import InputError
from ..kernels.lattice.cage_map import CageMap, sample_weights
from ..lattice.gaps import MapTarget, lattice_side_bytes
from ..lattice.harmonic import HarmonicSolver
from ..lattice.lattice import CageLattice, require_resolution
from ..lattice.launches import PoseLaunches
from ..mesh.mesh import ClosedMesh
from ..mesh.queries import inside_mesh
from ..mesh.validity import require_usable

#: Cells along the longest side of the lattice on which harmonic coordinates are solved.
HARMONIC_RESOLUTION = 128

#: A jump of weights over less than a cell that is larger than this is reported; at folds of a cage it is half of this.
REPORTED_WEIGHT_JUMP = 0.25


@points_in_turn
def harmonic_weights(
    points: PointsLike,
    cage: ClosedMesh,
    resolution: int = 128,
    device: wp.DeviceLike = None,
    *,
    tolerance: float = 1e-5,
    progress: bool | Progress = False,
) -> Any:
    """Harmonic coordinates (n, v) float32 of points (n, 3), world units, inside a cage, interpolated from a lattice.
    `resolution`: cells along its longest side; `tolerance`: of the solver, as a share of the values."""
    # Source: Joshi et al., "Harmonic coordinates for character articulation" (2007).
    device = points_device(points, device)
    resolution = require_resolution(resolution)
    require_usable(cage)
    cage = cage.refined(COORDINATE_KINDS["harmonic"].face_cells)
    host = as_host_points(points)
    outside = np.flatnonzero(~np.asarray(inside_mesh(host, cage, device=device)))  # inside: up to 1e-5 of its size out
    if len(outside):
        first = int(outside[0])
        raise InputError(
            f"{len(outside)} of {len(host)} points {agreed(len(outside), 'is', 'are')} outside the cage, "
            f"the first is row {first} at "
            f"{host[first].tolist()}: harmonic coordinates are defined inside only"
        )
    vertex_count = cage.own_count
    require_memory(
        4 * len(host) * (vertex_count + 3) + 40 * (resolution + 8) ** 3,
        device,
        f"harmonic weights of {len(host)} points at resolution {resolution} need {{size}}: take fewer points at a time "
        "or a lower resolution",
    )
    weights = empty_array((len(host), vertex_count), float, device)
    if len(host):
        options: dict[str, Any] = {"tolerance": tolerance, "progress": progress}
        for column, cage_map, places, _ in weight_maps(host, cage, resolution, device, **options):
            launch(sample_weights, len(host), [column, cage_map, places], [weights], device=device)
    return as_given(weights, points)


def weight_maps(
    points: np.ndarray,
    cage: ClosedMesh,
    resolution: int,
    device: wp.DeviceLike,
    *,
    tolerance: float = 1e-5,
    progress: bool | Progress = False,
) -> Iterator[tuple[int, WarpStruct, wp.array, float]]:
    """For three vertices at a time, of the mesh that a surface is of: the index of the first, the CageMap of their
    harmonic weights in node units, points (n, 3) in these, and the spacing of nodes in sizes of the cage."""
    center = cage.bounds.mean(axis=0)  # size one about the origin: weights do not depend on units
    local = cage.with_vertices((cage.vertices - center) / cage.size)
    lattice = CageLattice(local, resolution, device=device)
    places = ((points - center) / cage.size - lattice.lower) / lattice.spacing
    places = wp.array(places.astype(np.float32), dtype=wp.vec3, device=device)
    solver = HarmonicSolver(lattice, tolerance=tolerance)
    solver.prepare()
    gaps = WeightGaps(solver)  # own values for each side of gaps below two cells; rough below one, with a warning
    for column, selected in solver.solve_vertices(progress):
        yield column, gaps.cage_map(selected), places, lattice.spacing
    gaps.report()


class WeightGaps:
    """Maps of a harmonic solver's values as they are, in node units, with the sides of the cage's narrow gaps.
    The solver is on a lattice over a cage of size one, with the pose laid out."""

    def __init__(self, solver: HarmonicSolver):
        self._solver, self._lattice = solver, solver.lattice
        self._affine = wp.zeros(4, dtype=wp.vec3, device=solver.device)  # values are all there is
        self._launches: PoseLaunches | None = None
        self._jump = 0.0

    def cage_map(self, vertex_values: wp.array) -> WarpStruct:
        """The map that the solver's values hold, continued to the rings.
        `vertex_values` (v,) vec3 are those at the cage's vertices, the same array each time."""
        solver, lattice = self._solver, self._lattice
        data = CageMap()
        data.lower, data.spacing, data.inverse_spacing = wp.vec3(0.0, 0.0, 0.0), 1.0, 1.0
        data.positions, data.distance = solver.shaped_values, lattice.distance
        solver.launch_continuation(solver.sizes, vertex_values)
        if solver.gaps.found():
            if self._launches is None:
                message = f"sides of gaps at resolution {lattice.resolution} need {{size}}: take a lower resolution"
                require_memory(lattice_side_bytes(lattice), solver.device, message)
                self._launches = PoseLaunches(
                    solver, MapTarget(lattice.cage, self._affine, vertex_values, steepest=0.0)
                )
            self._launches.find_sides(solver.sizes)
            sides = self._launches.sides
            data.side_index, data.sides = sides.index, sides.table
            self._jump = max(self._jump, sides.jump)
        return data

    def report(self) -> None:
        """Warn where gaps are narrower than a cell."""
        if self._jump > REPORTED_WEIGHT_JUMP:
            warn_caller(
                "the cage has gaps narrower than a cell of the harmonic lattice: weights are rough there, take a "
                f"resolution above {self._lattice.resolution} or open the gaps"
            )
