"""MapSolver, the interface of solvers of maps on a lattice, and the weights of all cage vertices."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..core.arrays import WarpStruct, empty_array
from ..core.devices import HeldOnDevice, launch
from ..core.names import coordinate_kind
from ..kernels.lattice.cage_map import apply_weights
from ..kernels.lattice.cut_rows import CutRows
from ..kernels.lattice.nodes import RINGS
from ..kernels.lattice.side_values import set_boundary_values
from ..mesh.mesh import ClosedMesh
from .buffers import Buffer, BufferPool
from .gaps import GapFlags, MapTarget
from .lattice import CageLattice
from .nodes import CutRowTable, LatticeNodes
from .sizes import PoseSizes

if TYPE_CHECKING:  # kernels of gradients are imported where one is asked for
    from .corner_sums import CornerSums

#: Rows of weights: the first node's place in the list, then (m, v) of vertices and (m, f) of faces where there are any.
WeightBlock = tuple[int, wp.array, wp.array | None]


class MapSolver(HeldOnDevice, ABC):
    """Values of a map at the nodes of a lattice over a posed cage; `nodes` has the lists that the solver works on.
    A pose is `launch_layout`, then `launch_solution`, and where the pose opens narrow gaps `launch_boundary`."""

    jumps_at_cage = False  # whether the rings continue the map from inside alone, and not through its value on the cage

    def __init__(self, lattice: CageLattice, nodes: LatticeNodes):
        self.lattice, self.nodes, self.device = lattice, nodes, lattice.device
        self.rows = CutRows()  # description of the cut nodes, with as many rows as are known
        self.corrections = empty_array(0, wp.vec3, self.device)  # (rows of level 0 or more,) in the values, or (0,)
        self.gaps = GapFlags(lattice)  # nodes at narrow gaps
        self.status = wp.zeros(2, dtype=wp.float32, device=self.device)  # on the device: cycles and residual
        self.cycles, self.residual = 0, 0.0  # multigrid cycles (0: closed form), remainder as a share of the rest size
        self._values: Buffer = lattice.buffers.buffer(wp.vec3)
        self.slopes = BufferPool(self.device)  # what a backward pass takes, empty until there is one
        self._slopes, self._by_values = self.slopes.buffer(wp.vec3), self.slopes.buffer(wp.vec3)
        self._by_fractions = self.slopes.buffer(wp.float32)

    @property
    def sizes(self) -> PoseSizes:
        """Sizes of the last pose."""
        return self.lattice.sizes(self.nodes.level_count).counted(self.nodes.sections)

    @property
    def values(self) -> wp.array:
        """(nodes of level 0,) vec3, flat: the last map."""
        return self._values.take(self.lattice.node_count)

    def values_of(self, sizes: PoseSizes) -> wp.array:
        """The last map, (nodes or more,) vec3, flat, where launches with these sizes fill it in."""
        return self._values.take(sizes.level_nodes)

    @property
    def shaped_values(self) -> wp.array:
        """The same as an array of the lattice's shape."""
        return self._values.take(self.lattice.shape)

    def prepare(self) -> PoseSizes:
        """Lay out the pose that the lattice lies over, with exact sizes, and return these."""
        return self.launch_layout(self.lattice.sizes(self.nodes.level_count))

    def launch_layout(self, sizes: PoseSizes) -> PoseSizes:
        """Launch all that does not depend on what the map takes at the cage, cleared values included.
        Returns sizes with sections. Without sections it waits until lines are long enough and lists are counted."""
        lattice = self.lattice
        lattice.constants.send()
        with lattice.side.fork():
            self.clear(sizes)
        lattice.launch_geometry(sizes)
        return self.nodes.launch(sizes)

    def clear(self, sizes: PoseSizes) -> None:
        """Launch what clears the values and the count of gaps, before a solution."""
        self.gaps.count.zero_()
        self._values.take(sizes.level_nodes).zero_()

    def write_values(self, rest: ClosedMesh, matrix: np.ndarray) -> None:
        """Write on the host what a pose sends besides the values at vertices that the lattice's map_constants hold;
        matrix: (3, 3), of the affine part."""

    @abstractmethod
    def launch_solution(self, sizes: PoseSizes, target: MapTarget) -> None:
        """Launch what fills the cleared values, at inside nodes and the rings around them, and the search for gaps."""

    @abstractmethod
    def launch_continuation(self, sizes: PoseSizes, vertex_values: wp.array) -> None:
        """Launch what continues the values at inside nodes to the rings, and the search for gaps.
        vertex_values: (v,) vec3, the map at the cage's vertices."""

    def cut_rows(self, sizes: PoseSizes, table: CutRowTable) -> WarpStruct:
        """The description of the cut nodes, launched into `table` where there is none yet."""
        return self.rows

    def launch_boundary(
        self, sizes: PoseSizes, target: MapTarget, rows: WarpStruct, marks: wp.array, boundary: wp.array
    ) -> None:
        """Launch the map less its affine part, (rows of level 0, 6) vec3, where links cross the cage at narrow gaps.
        marks: (nodes,) int, below 0 for cells there; filled in at least for cut nodes of these and of cells beside."""
        inputs = [self.nodes.levels, rows, self.lattice.faces, target.vertex_values]  # on its faces it is linear
        launch(set_boundary_values, sizes.lists.cut, inputs, [boundary], device=self.device)

    @abstractmethod
    def weigh(self) -> list[WeightBlock]:
        """The weights of all cage vertices at the inside nodes of the last pose, in blocks of rows."""

    def weighted_values(self, target: MapTarget) -> tuple[wp.array, ...]:
        """What weights multiply, vec3, in the order of a block: values at vertices, and at faces where they have
        weights."""
        return (target.vertex_values,)

    def backward(self, by_positions: wp.array, target: MapTarget, targets: wp.array, sums: CornerSums) -> None:
        """Launch what adds to `sums` the slopes of a number by corners of the posed cage, node units, and of the rest
        cage, from those by the positions of the last map, (nodes,) vec3; targets: (v,) vec3, the rest cage."""
        from ..kernels.gradients.ring_adjoint import CrossingSlopes, propagate_ring, propagate_through_cage

        sizes, levels = self.sizes, self.nodes.levels
        sections = sizes.lists
        slopes = self._slopes.take(sizes.level_nodes)
        wp.copy(slopes, by_positions, count=sizes.nodes)
        by_crossings = CrossingSlopes()
        by_crossings.values = self._by_values.take((sections.cut, 6))
        by_crossings.fractions = self._by_fractions.take((sections.cut, 6))
        by_crossings.values.zero_()
        by_crossings.fractions.zero_()
        for ring in reversed(range(int(not self.jumps_at_cage), RINGS)):
            inputs = [ring, levels, self.lattice.flat_distance]
            launch(propagate_ring, sections.ring(ring), inputs, [slopes], device=self.device, threads=1)
        if not self.jumps_at_cage:
            inputs = [levels, self.rows, self.lattice.faces, targets, self.values, self.corrections, target.rest.size]
            outputs = [slopes, by_crossings]
            launch(propagate_through_cage, sections.ring(0), inputs, outputs, device=self.device, threads=1)
        self.launch_adjoint(sums, targets, slopes, by_crossings)

    @abstractmethod
    def launch_adjoint(self, sums: CornerSums, targets: wp.array, slopes: wp.array, by_crossings: WarpStruct) -> None:
        """Launch the part of `backward` that begins at inside nodes, with `slopes` (nodes of all levels,) vec3 there,
        which may change, and at crossings."""

    def _sum_crossings(self, sums: CornerSums, targets: wp.array, adjoint: wp.array, by_crossings: WarpStruct) -> None:
        """Launch what crossings of links pass on; adjoint: (nodes,) vec3 of the solution, or (0,)."""
        from ..kernels.gradients.corners import sum_crossings

        count = self.sizes.lists.cut
        span = -(-count // sums.parts) if self.device.is_cpu else 1
        cage = [self.lattice.vertices, self.lattice.faces, targets]
        inputs = [span, count, self.nodes.levels, self.rows, *cage, self.values, adjoint, by_crossings]
        launch(sum_crossings, -(-count // max(span, 1)), inputs, sums.arrays, device=self.device, work=16 * span)

    def take_status(self, status: np.ndarray) -> None:
        """Note how a solution ended: (2,) cycles and residual."""
        self.cycles, self.residual = int(status[0]), float(status[1])


class LatticeWeights(HeldOnDevice):
    """Weights at the listed nodes of a solver's lattice, which has laid out a pose.
    The paper's own way, at many times the memory of a map."""

    def __init__(self, solver: MapSolver):
        self._solver = solver
        # (first list entry, vertex_weights (m, v), face_weights (m, f) or None), v: those that the surface follows from
        self.blocks = solver.weigh()

    @staticmethod
    def row_bytes(coordinates: str, cage: ClosedMesh) -> int:
        """Bytes on the device of the weights of one node."""
        faces = coordinate_kind(coordinates).has_face_weights * len(cage.faces)
        return 4 * (cage.own_count + faces)

    def launch_solution(self, sizes: PoseSizes, target: MapTarget) -> None:
        """Launch the solver's solution, from the weights: values at inside nodes and the rings around them."""
        solver = self._solver
        factors = solver.weighted_values(target)
        solver.clear(sizes)
        for begin, *parts in self.blocks:
            for weights, values in zip(parts, factors, strict=False):
                assert weights is not None
                inputs = [begin, solver.nodes.levels, weights, values[: weights.shape[1]]]
                launch(apply_weights, weights.shape[0], inputs, [solver.values], device=solver.device)
        solver.launch_continuation(sizes, target.vertex_values)
