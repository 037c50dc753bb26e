"""The weights of all cage vertices at the inside nodes of a lattice, and harmonic weights at points."""

from __future__ import annotations

import warp as wp

from ..core.devices import launch
from ..kernels.lattice.weights import apply_weights, select_vertices, store_weights
from .harmonic import HarmonicSolver


class LatticeWeights:
    """Weights at the listed nodes of a solver's lattice; the paper's own way, at many times the memory of a map.

    Attributes: blocks, a list of (begin, vertex_weights (m, v), face_weights (m, f) or None): rows of a block belong to
    the entries begin .. begin + m - 1 of solver.nodes' list (kernels/lattice/nodes.py). cycles and residual: the worst
    of the harmonic solves, one for every three vertices.
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
                        apply_weights, weights.shape[0], [begin, levels, weights, targets], [values], device=self.device
                    )
        self.solver.extend(vertex_values)
        self.solver.find_gaps(self.solver.nodes.sections)

    def _solve_harmonic(self):
        solver, nodes = self.solver, self.solver.nodes
        begin, count = int(nodes.starts[0]), int(nodes.starts[2] - nodes.starts[0])
        weights = wp.empty((count, solver.lattice.vertices.size), dtype=float, device=self.device)
        for column, _ in solve_vertices(solver):
            launch(store_weights, count, [begin, column, nodes.levels, solver.values], [weights], device=self.device)
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
