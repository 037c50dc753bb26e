"""The weights of all cage vertices at the inside nodes of a lattice, and harmonic weights at points."""

from __future__ import annotations

import numpy as np
import warp as wp

from .arrays import as_host_points, is_device_array
from .devices import launch, resolve_device
from .harmonic_solver import HarmonicSolver
from .kernels.lattice_weights import apply_weights, sample_weights, select_vertices, store_weights
from .lattice import CageLattice, require_resolution
from .memory import require_memory


class LatticeWeights:
    """Weights at the listed nodes of a solver's lattice; the paper's own way, at many times the memory of a map.

    Attributes: blocks, a list of (begin, vertex_weights (m, v), face_weights (m, f) or None): rows of a block belong to
    the entries begin .. begin + m - 1 of solver.nodes' list (kernels/node_levels.py). cycles and residual: the worst of
    the harmonic solves, one for every three vertices.
    """

    def __init__(self, solver):
        self.solver, self.device = solver, solver.device
        if isinstance(solver, HarmonicSolver):
            self.blocks = [self._solve_harmonic()]
        else:
            self.blocks = [(begin, *solver.weigh(begin, count)) for begin, count in solver.node_ranges()]

    @staticmethod
    def row_bytes(coordinates: str, cage) -> int:
        """Bytes of the weights of one node."""
        return 4 * (len(cage.vertices) + (len(cage.faces) if coordinates == "green" else 0))

    def solve(self, vertex_values: wp.array, face_values=None) -> None:
        """The solver's `solve`, from the weights: values at inside nodes and the rings around them."""
        values, levels = self.solver.values, self.solver.nodes.levels
        self.solver.clear(self.solver.nodes.sizes)
        for begin, vertex_weights, face_weights in self.blocks:
            for weights, targets in ((vertex_weights, vertex_values), (face_weights, face_values)):
                if weights is not None:
                    launch(
                        apply_weights,
                        weights.shape[0],
                        [begin, levels, weights, targets],
                        [values],
                        device=self.device,
                    )
        self.solver.extend(vertex_values)
        self.solver.find_gaps(self.solver.nodes.sections)

    def _solve_harmonic(self):
        solver, nodes = self.solver, self.solver.nodes
        begin, count = int(nodes.starts[0]), int(nodes.starts[2] - nodes.starts[0])
        weights = wp.empty((count, solver.lattice.vertices.size), dtype=float, device=self.device)
        for column, _ in solve_vertices(solver):
            launch(
                store_weights,
                count,
                [begin, column, nodes.levels, solver.values],
                [weights],
                device=self.device,
            )
        return begin, weights, None


def solve_vertices(solver: HarmonicSolver):
    """Solve for the weights of three cage vertices after another; yields the first's index and their boundary values.

    Afterwards the solver's cycles and residual are the largest of all.
    """
    count = solver.lattice.vertices.size
    selected = wp.empty(count, dtype=wp.vec3, device=solver.device)
    cycles, residual = 0, 0.0
    for column in range(0, count, 3):
        launch(select_vertices, count, [column], [selected], device=solver.device)
        solver.solve_inside(selected)
        cycles, residual = max(cycles, solver.cycles), max(residual, solver.residual)
        yield column, selected
    solver.cycles, solver.residual = cycles, residual


def harmonic_weights(points, cage, resolution: int = 128, device=None, *, tolerance: float = 1e-5):
    """Harmonic coordinates (n, v) of points (n, 3) inside a cage, interpolated from a lattice.

    points: world units; NumPy gives NumPy float32, an array on a device gives a Warp array there. resolution: cells
    along the longest side. Points within 1e-5 of the cage's size of it count as inside.
    Raises ValueError for points outside (how many and the first), of another shape or not finite, an unusable cage, a
    resolution outside 8 .. 1024, or too little memory.
    Source: Joshi et al., "Harmonic coordinates for character articulation" (2007).
    """
    given_on_device = is_device_array(points)
    if given_on_device and device is None:
        from .arrays import as_points

        device = as_points(points)[0].device
    device = resolve_device(device)
    resolution = require_resolution(resolution)
    cage.require_usable()
    host = as_host_points(points)
    outside = np.flatnonzero(~np.asarray(cage.contains(host, device=device)))
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
        lattice = CageLattice(cage, resolution, device=device)
        solver = HarmonicSolver(lattice, tolerance=tolerance)
        places = ((host - lattice.lower) / lattice.spacing).astype(np.float32)
        places = wp.array(places, dtype=wp.vec3, device=device)
        for column, selected in solve_vertices(solver):
            solver.extend(selected)
            launch(
                sample_weights,
                len(host),
                [column, wp.vec3i(*lattice.shape), places, solver.values],
                [weights],
                device=device,
            )
    return weights if given_on_device else weights.numpy()
