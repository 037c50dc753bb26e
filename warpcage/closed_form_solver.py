"""Mean value and Green maps on the nodes of a lattice, behind the same methods as HarmonicSolver."""

from __future__ import annotations

import numpy as np
import warp as wp

from .devices import launch
from .kernels.closed_form_map import map_nodes_green, map_nodes_mean_value
from .kernels.green import weigh_green
from .kernels.lattice_weights import place_nodes
from .kernels.map_extension import extend_outwards
from .kernels.mean_value import weigh_mean_value
from .node_levels import LatticeNodes


class ClosedFormSolver:
    """What both closed forms share: the nodes and the values at them. cycles and residual are 0."""

    cycles, residual = 0, 0.0

    def __init__(self, lattice):
        self.lattice, self.device = lattice, lattice.device
        self.nodes = LatticeNodes(lattice, level_count=1)
        self._set_up()

    def prepare(self) -> None:
        """Set up for the pose that the lattice was filled with."""
        self.nodes.fill()
        self._set_up()

    def _set_up(self) -> None:
        lattice = self.lattice
        self.values = lattice.buffers.get("values", lattice.node_count, wp.vec3)
        # float32 keeps most digits around the middle
        centre = (np.array(lattice.shape) - 1) // 2
        vertices = (lattice.cage.vertices - lattice.lower) / lattice.spacing - centre
        self._centre = wp.vec3(*centre.astype(float))
        self._vertices = wp.array(vertices.astype(np.float32), dtype=wp.vec3, device=self.device)

    def count_thin_nodes(self) -> int:
        return 0

    def _size(self) -> float:
        """Size of the cage in node units."""
        return self.lattice.cage.size / self.lattice.spacing

    def _place(self, begin: int, count: int) -> wp.array:
        points = wp.empty(count, dtype=wp.vec3, device=self.device)
        launch(place_nodes, count, [begin, self._centre, self.nodes.levels], [points], device=self.device)
        return points


class MeanValueSolver(ClosedFormSolver):
    """Mean value maps: the formula holds outside the cage as well, so the rings take their own values."""

    def solve(self, vertex_values: wp.array, face_values=None) -> None:
        """Values at inside nodes and rings for vertex_values (v,) vec3 at the cage's vertices."""
        lattice = self.lattice
        self.values.zero_()
        for begin, count in self.node_ranges():
            launch(
                map_nodes_mean_value,
                count,
                [
                    begin, self._centre, self.nodes.levels, self._vertices, lattice.faces, vertex_values,
                    self._size(),
                ],
                [self.values],
                device=self.device,
            )

    def extend(self, vertex_values: wp.array) -> None:
        """Nothing to do: the rings have values of their own."""

    def node_ranges(self) -> list[tuple[int, int]]:
        """(begin, count) in the node list of what has weights: inside nodes, then rings."""
        starts = self.nodes.starts
        return [(int(starts[0]), int(starts[2] - starts[0])), (int(starts[3]), int(starts[-1] - starts[3]))]

    def weigh(self, begin: int, count: int) -> tuple[wp.array, None]:
        """Weights (count, v) of the nodes listed from `begin` on; no weights of faces."""
        lattice = self.lattice
        weights = wp.empty((count, lattice.vertices.size), dtype=float, device=self.device)
        points = self._place(begin, count)
        launch(
            weigh_mean_value,
            count,
            [points, self._vertices, lattice.faces, self._size()],
            [weights],
            device=self.device,
        )
        return weights, None


class GreenSolver(ClosedFormSolver):
    """Green maps: the formula jumps at the cage, so the rings continue the inside values linearly."""

    def solve(self, vertex_values: wp.array, face_values: wp.array) -> None:
        """Values at inside nodes and rings for vertex_values (v,) and face_values (f,) vec3, as the normals weighted by
        psi in node units."""
        lattice = self.lattice
        self.values.zero_()
        for begin, count in self.node_ranges():
            launch(
                map_nodes_green,
                count,
                [
                    begin, self._centre, self.nodes.levels, self._vertices, lattice.faces, vertex_values, face_values,
                    self._size(),
                ],
                [self.values],
                device=self.device,
            )
        self.extend(vertex_values)

    def extend(self, vertex_values: wp.array) -> None:
        """Continue the values at inside nodes to the rings of outside nodes around them."""
        lattice = self.lattice
        for ring in range(4):
            launch(
                extend_outwards,
                int(self.nodes.counts["rings"][ring]),
                [ring, lattice.vertices, lattice.faces, self.nodes.levels, vertex_values],
                [self.values],
                device=self.device,
            )

    def node_ranges(self) -> list[tuple[int, int]]:
        """(begin, count) in the node list of what has weights: inside nodes."""
        return [(int(self.nodes.starts[0]), int(self.nodes.starts[2] - self.nodes.starts[0]))]

    def weigh(self, begin: int, count: int) -> tuple[wp.array, wp.array]:
        """Weights (count, v) of vertices and (count, f) of faces at the nodes listed from `begin` on."""
        lattice = self.lattice
        vertex_weights = wp.empty((count, lattice.vertices.size), dtype=float, device=self.device)
        face_weights = wp.empty((count, lattice.faces.size), dtype=float, device=self.device)
        launch(
            weigh_green,
            count,
            [self._place(begin, count), self._vertices, lattice.faces, self._size()],
            [vertex_weights, face_weights],
            device=self.device,
        )
        return vertex_weights, face_weights
