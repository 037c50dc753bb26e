"""The weights of all cage vertices at the inside nodes of a lattice."""

from __future__ import annotations

from ..core.devices import launch
from ..kernels.lattice.weights import apply_weights
from ..mesh.mesh import ClosedMesh
from .gaps import MapTarget
from .sizes import PoseSizes
from .solver import MapSolver


class LatticeWeights:
    """Weights at the listed nodes of a solver's lattice, which has laid out a pose."""

    # The paper's own way, at many times the memory of a map.

    def __init__(self, solver: MapSolver):
        self._solver = solver
        # (begin, vertex_weights (m, v), face_weights (m, f) or None): rows of a block belong to the entries begin ..
        # begin + m - 1 of the list of nodes (kernels/lattice/nodes.py)
        self.blocks = solver.weigh()

    @staticmethod
    def row_bytes(coordinates: str, cage: ClosedMesh) -> int:
        """Bytes on the device of the weights of one node."""
        return 4 * (len(cage.vertices) + (len(cage.faces) if coordinates == "green" else 0))

    def launch_solution(self, sizes: PoseSizes, target: MapTarget) -> None:
        """Launch the solver's solution, from the weights: values at inside nodes and the rings around them."""
        solver = self._solver
        factors = solver.weighted_values(target)
        solver.clear(sizes)
        for begin, *parts in self.blocks:
            for weights, values in zip(parts, factors, strict=False):
                assert weights is not None
                inputs = [begin, solver.nodes.levels, weights, values]
                launch(apply_weights, weights.shape[0], inputs, [solver.values], device=solver.device)
        solver.launch_continuation(sizes, target.vertex_values)
