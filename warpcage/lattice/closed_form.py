"""Mean value and Green maps on the nodes of a lattice, behind the same methods as HarmonicSolver."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..core.devices import lane_count, launch
from ..kernels.coordinates.green import weigh_green
from ..kernels.coordinates.mean_value import weigh_mean_value
from ..kernels.lattice.closed_form import (
    interpolate_nodes,
    map_crossings_green,
    map_nodes_green,
    map_nodes_mean_value,
    stretch_normals,
)
from ..kernels.lattice.corrections import correct_values, measure_corrections
from ..kernels.lattice.nodes import RINGS
from ..kernels.lattice.rings import extend_outwards
from ..kernels.lattice.weights import place_nodes
from ..mesh.faces import StretchTarget
from ..mesh.fans import prepared_fans
from .gaps import GapFlags, launch_linear_boundary
from .nodes import LatticeNodes
from .rings import described_rows, launch_ring


class ClosedFormSolver:
    """What both closed forms share: the nodes and the values at them. cycles and residual are 0."""

    cycles, residual = 0, 0.0

    def __init__(self, lattice):
        self.lattice, self.device = lattice, lattice.device
        self.nodes = LatticeNodes(lattice, level_count=1, interpolates=True)
        self.status = wp.zeros(2, dtype=float, device=self.device)
        self.gaps = GapFlags(self)
        self.rows = None  # of cut nodes, once the map is continued through the cage
        self.corrections = wp.empty(0, dtype=wp.vec3, device=self.device)  # that are in values at the cage
        # indices of these faces stay in here: all others mean the lattice's
        self._faces = wp.array(lattice.cage.topology.fans.faces, dtype=wp.vec3i, device=self.device)
        self._fans = wp.empty(2 * self._faces.size, dtype=wp.vec4, device=self.device)

    def prepare(self) -> None:
        """Set up for the pose that the lattice was filled with."""
        self.nodes.fill()

    @property
    def values(self) -> wp.array:
        """(nodes,) vec3, flat: the last map."""
        return self.lattice.buffers.get("values", self.lattice.node_count, wp.vec3)

    def clear(self, sizes: dict) -> None:
        """Launch what clears the values and the count of gaps and prepares the faces, before a solution."""
        self.gaps.count.zero_()
        self.lattice.buffers.get("values", sizes["nodes"], wp.vec3).zero_()
        prepared_fans(self._vertices, self._faces, self._size(), out=self._fans)

    def launch_rows(self, sizes: dict, sections: np.ndarray) -> None:
        """Nothing: what needs the cut nodes described does so beside the map."""

    def face_values(self, rest, affine: wp.array):
        """What psi multiplies: nothing."""
        return None

    def launch_solution(self, sizes: dict, sections: np.ndarray, vertex_values: wp.array, face_values) -> None:
        """Launch what fills the cleared values. sizes, sections: of this pose, or upper bounds."""
        values, side = self.lattice.buffers.get("values", sizes["nodes"], wp.vec3), self.lattice.side
        with side.fork():
            self.describe(sections)
        self.launch_map(sections, vertex_values, face_values, values)
        side.join()
        with side.fork():  # neither of these looks at the rings, nor they at them
            self.gaps.launch(sections, self.rows, values)
        with self.lattice.other_side.fork():
            for axis in range(3):
                self._launch(interpolate_nodes, int(sections[1]), [axis, self.nodes.levels], [values])
        self.continue_map(sections, vertex_values, values)
        side.join()
        self.lattice.other_side.join()

    def find_gaps(self, sections: np.ndarray) -> None:
        """Launch the search for narrow gaps."""
        self.gaps.search(sections, self.rows, self.values)

    def extend(self, vertex_values: wp.array) -> None:
        """Continue the values at inside nodes to the rings of outside nodes around them."""
        self.describe(self.nodes.sections)
        self.continue_map(self.nodes.sections, vertex_values, self.values)

    def _launch(self, kernel, count: int, inputs, outputs) -> None:
        launch(kernel, count, inputs, outputs, device=self.device)

    def solve(self, vertex_values: wp.array, face_values=None) -> None:
        """Values at inside nodes and rings for vertex_values (v,) and, for green, face_values (f,) vec3: what psi in
        node units multiplies, of the faces as fans have them."""
        self.clear(self.nodes.sizes)
        self.launch_solution(self.nodes.sizes, self.nodes.sections, vertex_values, face_values)

    def take_status(self, status: np.ndarray) -> None:
        """Nothing to note."""

    def load_modules(self) -> None:
        """Compile what a capture would need: the map has run before."""

    def node_ranges(self) -> list[tuple[int, int]]:
        """(begin, count) in the node list of what has weights: inside nodes."""
        return [(int(self.nodes.starts[0]), int(self.nodes.starts[2] - self.nodes.starts[0]))]

    def _size(self) -> float:
        """Size of the cage in node units."""
        return float(self.lattice.resolution)

    @property
    def _vertices(self) -> wp.array:
        return self.lattice.constants.arrays["centred"]

    def _place(self, begin: int, count: int) -> wp.array:
        points = wp.empty(count, dtype=wp.vec3, device=self.device)
        launch(place_nodes, count, [begin, self.nodes.levels], [points], device=self.device)
        return points


class MeanValueSolver(ClosedFormSolver):
    """Mean value maps. Their formula holds outside the cage as well, but bends at its edges and, in gaps, from one side
    to the other, so that the rings continue the inside values through the cage instead, as harmonic maps do."""

    def launch_map(self, sections: np.ndarray, vertex_values: wp.array, face_values, values: wp.array) -> None:
        """Launch the map at the inside nodes that are not interpolated."""
        self._launch(
            map_nodes_mean_value,
            int(sections[0]),
            [self.nodes.levels, self._vertices, self._faces, self._fans, vertex_values, self._size()],
            [values],
        )

    def describe(self, sections: np.ndarray) -> None:
        """Launch the description of the cut nodes."""
        self.rows = described_rows(self.lattice, self.nodes, int(sections[2]), int(sections[2]))

    def continue_map(self, sections: np.ndarray, vertex_values: wp.array, values: wp.array) -> None:
        """Launch what continues the map to the rings, and corrects it next to the cage."""
        lattice, nodes, side = self.lattice, self.nodes, self.lattice.side
        count = int(sections[2:5].sum())
        corrections = self.corrections = lattice.buffers.get("corrections", count, wp.vec3)
        for ring in range(2):
            launch_ring(self, ring, sections, vertex_values, values)
        with side.fork():  # looks at rings 0 and 1 only
            inputs = [nodes.levels, self.rows, *lattice.block_faces, lattice.vertices, lattice.faces]
            self._launch(measure_corrections, count, [*inputs, vertex_values, values], [corrections])
        launch_ring(self, 2, sections, vertex_values, values)
        side.join()
        self._launch(correct_values, count, [nodes.levels, corrections], [values])

    def launch_boundary(self, cut_count: int, vertex_values: wp.array, face_values, buffers, boundary) -> None:
        """Launch the map's remainder (rows, 6) where links cross the cage."""
        launch_linear_boundary(self, cut_count, vertex_values, boundary)

    def weigh(self, begin: int, count: int) -> tuple[wp.array, None]:
        """Weights (count, v) of the nodes listed from `begin` on; no weights of faces."""
        lattice = self.lattice
        weights = wp.empty((count, lattice.vertices.size), dtype=float, device=self.device)
        points = self._place(begin, count)
        self._launch(weigh_mean_value, count, [points, self._vertices, lattice.faces, self._size()], [weights])
        return weights, None


class GreenSolver(ClosedFormSolver):
    """Green maps: the formula jumps at the cage, so the rings continue the inside values linearly. Cut nodes are
    described where there are gaps only."""

    def __init__(self, lattice):
        super().__init__(lattice)
        self._rest = None

    def face_values(self, rest, affine: wp.array) -> wp.array:
        """Launch what psi in node units multiplies (f,), of the faces in fans, for the remainder of the map to a rest
        cage after its affine part; see the kernel."""
        if self._rest is not rest:
            target = StretchTarget.of(rest, rest.topology.fans.faces)
            products = np.stack([target.ss, target.st, target.tt]) / rest.size**2
            self._rest_faces = [
                wp.array(np.ascontiguousarray(columns.T, dtype=np.float32), dtype=wp.vec3, device=self.device)
                for columns in (target.normals, products)
            ]
            self._rest, self._face_values = rest, wp.empty(self._faces.size, dtype=wp.vec3, device=self.device)
        inputs = [self._vertices, self._faces, *self._rest_faces, affine, rest.size]
        self._launch(stretch_normals, self._faces.size, inputs, [self._face_values])
        return self._face_values

    def launch_map(self, sections: np.ndarray, vertex_values: wp.array, face_values, values: wp.array) -> None:
        """Launch the map at the inside nodes that are not interpolated."""
        self._launch(
            map_nodes_green,
            int(sections[0]),
            [self.nodes.levels, self._vertices, self._faces, self._fans, vertex_values, face_values, self._size()],
            [values],
        )

    def describe(self, sections: np.ndarray) -> None:
        """Nothing: the rings are continued from values alone."""
        self.rows = None

    def continue_map(self, sections: np.ndarray, vertex_values: wp.array, values: wp.array) -> None:
        """Launch what continues the map to the rings."""
        lattice = self.lattice
        for ring in range(RINGS):
            inputs = [ring, lattice.vertices, lattice.faces, self.nodes.levels, vertex_values, lattice.flat_distance]
            self._launch(extend_outwards, lane_count(self.device) * int(sections[3 + ring]), inputs, [values])

    def launch_boundary(self, cut_count: int, vertex_values: wp.array, face_values, buffers, boundary) -> None:
        """Launch the limit (rows, 6) of the map's remainder, from inside, where links cross the cage; the cut nodes are
        described first, in `buffers`."""
        lattice = self.lattice
        self.rows = described_rows(lattice, self.nodes, cut_count, cut_count, buffers)
        inputs = [self.nodes.levels, self.rows, self._vertices, self._faces, self._fans, vertex_values, face_values]
        self._launch(map_crossings_green, boundary.size, [*inputs, self._size()], [boundary])

    def weigh(self, begin: int, count: int) -> tuple[wp.array, wp.array]:
        """Weights (count, v) of vertices and (count, f) of faces, as fans have them, at the nodes listed from `begin`
        on."""
        lattice = self.lattice
        vertex_weights = wp.empty((count, lattice.vertices.size), dtype=float, device=self.device)
        face_weights = wp.empty((count, self._faces.size), dtype=float, device=self.device)
        self._launch(
            weigh_green,
            count,
            [self._place(begin, count), self._vertices, self._faces, self._size()],
            [vertex_weights, face_weights],
        )
        return vertex_weights, face_weights
