"""Harmonic coordinates at points."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..core.arrays import as_host_points, as_points, is_device_array
from ..core.checks import warn_caller
from ..core.devices import launch, resolve_device
from ..core.memory import require_memory
from ..kernels.lattice.cage_map import CageMap
from ..kernels.lattice.weights import sample_weights
from ..lattice.gaps import MapSides, side_bytes
from ..lattice.harmonic import HarmonicSolver
from ..lattice.lattice import CageLattice, require_resolution
from ..lattice.weights import solve_vertices
from ..mesh.containment import inside_mesh
from ..mesh.faces import face_area
from ..mesh.usable import require_usable

#: Nodes along the longest side of the lattice on which harmonic coordinates are solved.
HARMONIC_RESOLUTION = 128

#: A jump of weights over less than a cell that is larger than this is reported; at folds of a cage it is half of this.
REPORTED_WEIGHT_JUMP = 0.25


def harmonic_weights(points, cage, resolution: int = 128, device=None, *, tolerance: float = 1e-5):
    """Harmonic coordinates (n, v) of points (n, 3) inside a cage, interpolated from a lattice.

    points: world units; NumPy gives NumPy float32, an array on a device gives a Warp array there. resolution: cells
    along the longest side. Points within 1e-5 of the cage's size of it count as inside. At gaps of the cage narrower
    than about two cells each side has values of its own; below one cell they are rough, which a warning says.
    Raises ValueError for points outside (how many and the first), of another shape or not finite, an unusable cage, a
    resolution outside 8 .. 1024, or too little memory.
    Source: Joshi et al., "Harmonic coordinates for character articulation" (2007).
    """
    given_on_device = is_device_array(points)
    if given_on_device and device is None:
        device = as_points(points)[0].device
    device = resolve_device(device)
    resolution = require_resolution(resolution)
    require_usable(cage)
    host = as_host_points(points)
    outside = np.flatnonzero(~inside_mesh(host, cage, device=device))
    if len(outside):
        first = int(outside[0])
        raise ValueError(
            f"{len(outside)} of {len(host)} points are outside the cage, the first is row {first} at "
            f"{host[first].tolist()}: harmonic coordinates are defined inside only"
        )
    vertex_count = len(cage.vertices)
    require_memory(
        4 * len(host) * (vertex_count + 3) + 40 * (resolution + 8) ** 3,
        device,
        f"harmonic weights of {len(host)} points at resolution {resolution} need {{size}}: take fewer points at a time "
        "or a lower resolution",
    )
    weights = wp.empty((len(host), vertex_count), dtype=float, device=device)
    if len(host):
        # size one about the origin: weights do not depend on units
        centre = cage.bounds.mean(axis=0)
        local = cage.with_vertices((cage.vertices - centre) / cage.size)
        lattice = CageLattice(local, resolution, device=device)
        places = ((host - centre) / cage.size - lattice.lower) / lattice.spacing
        places = wp.array(places.astype(np.float32), dtype=wp.vec3, device=device)
        solver = HarmonicSolver(lattice, tolerance=tolerance)
        gaps = WeightGaps(solver)
        for column, selected in solve_vertices(solver):
            solver.extend(selected)
            launch(sample_weights, len(host), [column, gaps.cage_map(selected), places], [weights], device=device)
        gaps.report()
    return weights if given_on_device else weights.numpy()


class WeightGaps:
    """Maps of a harmonic solver's values as they are, in node units, with the sides of the cage's narrow gaps.

    solver: on a lattice over a cage of size one.
    """

    def __init__(self, solver: HarmonicSolver):
        self.solver = solver
        self._affine = wp.zeros(4, dtype=wp.vec3, device=solver.device)  # values are all there is
        self._sides: MapSides | None = None
        self._jump = 0.0

    def cage_map(self, vertex_values: wp.array) -> CageMap:
        """The map that the solver's values hold, extended, of these values at the cage's vertices."""
        solver, lattice = self.solver, self.solver.lattice
        data = CageMap()
        data.lower, data.spacing, data.inverse_spacing = wp.vec3(0.0, 0.0, 0.0), 1.0, 1.0
        data.positions, data.distance = solver.values.reshape(lattice.shape), lattice.distance
        solver.find_gaps(solver.nodes.sections)
        if solver.gaps.found():
            if self._sides is None:
                surface = face_area(lattice.cage) / lattice.spacing**2
                message = f"sides of gaps at resolution {lattice.resolution} need {{size}}: take a lower resolution"
                require_memory(side_bytes(lattice.node_count, surface), solver.device, message)
                constants = {"affine": self._affine, "vertex_values": vertex_values}  # the same array for all columns
                self._sides = MapSides(solver, lattice.cage, constants)
            self._sides.find()
            data.side_index, data.sides = self._sides.index, self._sides.table
            self._jump = max(self._jump, self._sides.jump)
        return data

    def report(self) -> None:
        """Warn where gaps are narrower than a cell."""
        if self._jump > REPORTED_WEIGHT_JUMP:
            warn_caller(
                "the cage has gaps narrower than a cell of the harmonic lattice: weights are rough there, take a "
                f"resolution above {self.solver.lattice.resolution} or open the gaps"
            )
