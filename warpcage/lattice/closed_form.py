"""Mean value, Green, maximum likelihood and biharmonic maps on the nodes of a lattice."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..coordinate_kinds import CoordinateKind
from ..core.arrays import WarpStruct, empty_array
from ..core.checks import warn_caller
from ..core.devices import DEFAULT_WORK, launch
from ..errors import InputError
from ..kernels.coordinates.local_points import find_not_finite
from ..kernels.lattice.cage_map import place_nodes
from ..kernels.lattice.closed_form import interpolate_nodes, stretch_normals
from ..kernels.lattice.corrections import correct_values, measure_corrections
from ..kernels.lattice.nodes import RINGS
from ..mesh.biharmonic import LayerEquations, require_few_faces
from ..mesh.faces import StretchTarget, stretched_normals
from ..mesh.mesh import ClosedMesh, prepared_fans
from ..mesh.surface import merge_rows
from .buffers import PoseConstants
from .gaps import MapTarget
from .lattice import CageLattice
from .nodes import CutRowTable, LatticeNodes, continue_outwards, continue_through_cage
from .sizes import NodeSections, PoseSizes
from .solver import MapSolver, WeightBlock

if TYPE_CHECKING:
    from .corner_sums import CornerSums

#: Points whose layers, of faces that have several, are held at a time.
CHUNK = 1 << 13

#: Where iterations may find no coordinates.
_WITHOUT = "where the posed cage passes through itself, is inside out or a hundred times wider than high"


def weight_operator(kind: CoordinateKind, cage: ClosedMesh, faces: wp.array, size: float) -> Any:
    """The operator (see `merge_rows`) from what kernels weigh, of the vertices of a surface and layers of faces, to the
    vertices of the mesh that it is of and one weight a face; None where these are the same. size: in the kernels."""
    if kind.face_layers <= 1:
        return cage.operator
    return LayerEquations(cage, faces.numpy(), size, faces.device).row_operator()


def closed_form_weights(
    kind: CoordinateKind,
    points: wp.array,
    vertices: wp.array,
    faces: wp.array,
    cage: ClosedMesh,
    size: float,
    field: str = "weigh_points",
) -> list[wp.array]:
    """Weights (n, v) of the vertices that a cage has of its own, and (n, f) of `faces` where they have any.
    size: of the cage, in the unit of points and vertices."""
    device, count, operator = points.device, points.size, weight_operator(kind, cage, faces, size)
    kernel, work, corners = kind.load(field), len(cage.faces), vertices.size
    if kind.face_layers > 1:
        own = cage.own_count
        weights = [empty_array((count, width), wp.float32, device) for width in (own, faces.size)]
        rows = empty_array((min(count, CHUNK), operator.shape[0]), wp.float64, device)
        for begin in range(0, count, CHUNK):
            items = min(CHUNK, count - begin)
            inputs = [points[begin : begin + items], vertices, faces, size]
            part: Any = rows[:items]
            launch(kernel, items, inputs, [part[:, :corners], part[:, corners:]], device=device, work=work)
            for columns, each in zip((operator[:, :own], operator[:, own:]), weights, strict=True):
                merged: Any = each[begin : begin + items]
                merge_rows(part.transpose([1, 0]), columns, merged.transpose([1, 0]))
        return weights
    weights = [empty_array((count, width), wp.float32, device) for width in [corners] + [faces.size] * kind.face_layers]
    launch(kernel, count, [points, vertices, faces, size], weights, device=device, work=work)
    if operator is not None:
        summed = empty_array((count, cage.own_count), wp.float32, device)
        merge_rows(weights[0].transpose([1, 0]), operator, summed.transpose([1, 0]))
        weights[0] = summed
    return weights


class ClosedFormSolver(MapSolver):
    """Maps by the kernels of a closed form: few nodes are evaluated, and the others interpolated."""

    def __init__(self, lattice: CageLattice, kind: CoordinateKind):
        super().__init__(lattice, LatticeNodes(lattice, level_count=1, interpolates=True))
        # indices of these faces stay in here: all others mean the lattice's
        self._faces = wp.array(lattice.cage.topology.fans.faces, dtype=wp.vec3i, device=self.device)
        self._fans = empty_array(2 * self._faces.size, wp.vec4, self.device)
        self._vertices = lattice.constants.centered.array
        self._size = float(lattice.resolution)  # of the cage, node units
        self._kind, self._map_nodes = kind, kind.load("map_nodes")

    def clear(self, sizes: PoseSizes) -> None:
        """Launch what clears the values and the count of gaps and prepares the faces, before a solution."""
        super().clear(sizes)
        prepared_fans(self._vertices, self._faces, self._size, out=self._fans)

    def launch_solution(self, sizes: PoseSizes, target: MapTarget) -> None:
        """Launch what fills the cleared values; see MapSolver."""
        sections, values = sizes.lists, self.values_of(sizes)
        side, other_side, levels = self.lattice.side, self.lattice.other_side, self.nodes.levels
        self._launch_map(sections, target, values)
        with side.fork():  # neither of these looks at the rings, nor they at them
            self.gaps.search(self.lattice, levels, self.rows, sections, values)
        with other_side.fork():
            for axis in range(3):
                self._launch(interpolate_nodes, sections.interpolated, [axis, levels], [values])
        self.continue_map(sections, target.vertex_values, values)
        side.join()
        other_side.join()

    def launch_continuation(self, sizes: PoseSizes, vertex_values: wp.array) -> None:
        """Launch what continues the values to the rings, and the search for gaps; see MapSolver."""
        sections, values = sizes.lists, self.values_of(sizes)
        self.continue_map(sections, vertex_values, values)
        self.gaps.search(self.lattice, self.nodes.levels, self.rows, sections, values)

    def launch_adjoint(self, sums: CornerSums, targets: wp.array, slopes: wp.array, by_crossings: WarpStruct) -> None:
        """Launch the backward pass through the formula; see MapSolver."""
        from ..kernels.gradients.corners import gather_nodes
        from ..kernels.gradients.ring_adjoint import propagate_interpolation

        sections, levels = self.sizes.lists, self.nodes.levels
        for axis in reversed(range(3)):
            self._launch(propagate_interpolation, sections.finest_inside, [axis, levels], [slopes])
        points, by_positions = (empty_array(sections.evaluated, wp.vec3, self.device) for _ in "pp")
        self._launch(place_nodes, points.size, [0, levels], [points])
        self._launch(gather_nodes, points.size, [levels, slopes], [by_positions])
        self.launch_formula_adjoint(sums, targets, points, by_positions)

    @abstractmethod
    def launch_formula_adjoint(
        self, sums: CornerSums, targets: wp.array, points: wp.array, by_positions: wp.array
    ) -> None:
        """Launch what adds the slopes by the positions (m,) vec3 of points (m,) vec3, node units from the middle."""

    def weigh(self) -> list[WeightBlock]:
        """The weights (m, v) of vertices, and (m, f) of faces in the order of fans where there are any, of all inside
        nodes in one block."""
        points = empty_array(self.nodes.sections.finest_inside, wp.vec3, self.device)
        self._launch(place_nodes, points.size, [0, self.nodes.levels], [points])
        faces = self._faces if self._kind.has_face_weights else self.lattice.faces
        weights = closed_form_weights(self._kind, points, self._vertices, faces, self.lattice.cage, self._size)
        return [(0, weights[0], weights[1] if self._kind.has_face_weights else None)]

    @abstractmethod
    def _launch_map(self, sections: NodeSections, target: MapTarget, values: wp.array) -> None:
        """Launch the map at the inside nodes that are not interpolated, and what describes the cut nodes."""

    @abstractmethod
    def continue_map(self, sections: NodeSections, vertex_values: wp.array, values: wp.array) -> None:
        """Launch what continues the map to the rings."""

    def _launch(self, kernel, count: int, inputs: list, outputs: list, *, all_faces: bool = False) -> None:
        """all_faces: whether each item looks at all faces."""
        work = self._faces.size if all_faces else DEFAULT_WORK
        launch(kernel, count, inputs, outputs, device=self.device, work=work)


class VertexWeightSolver(ClosedFormSolver):
    """Maps that are linear on each face, as mean value maps: the rings continue them through the cage from inside.
    Their formula may hold outside the cage too, but bends at its edges and, in gaps, from one side to the other."""

    def __init__(self, lattice: CageLattice, kind: CoordinateKind):
        super().__init__(lattice, kind)
        self._table = CutRowTable(lattice.buffers)
        self._corrections = lattice.buffers.buffer(wp.vec3)

    def launch_continuation(self, sizes: PoseSizes, vertex_values: wp.array) -> None:
        """Launch what continues the values to the rings, and the search for gaps; see MapSolver."""
        self._describe(sizes.lists)
        super().launch_continuation(sizes, vertex_values)

    def _launch_map(self, sections: NodeSections, target: MapTarget, values: wp.array) -> None:
        with self.lattice.side.fork():
            self._describe(sections)
        cage = [self._vertices, self._faces, self._fans, target.vertex_values, self._size]
        outputs = [values] + [self.status] * self._kind.is_iterative
        self._launch(self._map_nodes, sections.evaluated, [self.nodes.levels, *cage], outputs, all_faces=True)
        self.lattice.side.join()

    def launch_adjoint(self, sums: CornerSums, targets: wp.array, slopes: wp.array, by_crossings: WarpStruct) -> None:
        """Launch the backward pass through the formula and from crossings; see MapSolver. Corrections are held."""
        super().launch_adjoint(sums, targets, slopes, by_crossings)
        self._sum_crossings(sums, targets, empty_array(0, wp.vec3, self.device), by_crossings)

    def launch_formula_adjoint(
        self, sums: CornerSums, targets: wp.array, points: wp.array, by_positions: wp.array
    ) -> None:
        """Launch the backward pass through mean value coordinates; see ClosedFormSolver."""
        sums.add_mean_value(points, by_positions, self._vertices, targets, self._size)

    def _describe(self, sections: NodeSections) -> None:
        self.rows = self._table.describe(self.lattice, self.nodes.levels, sections)

    def continue_map(self, sections: NodeSections, vertex_values: wp.array, values: wp.array) -> None:
        """Launch what continues the map to the rings, and corrects it next to the cage."""
        lattice, levels, rows, side = self.lattice, self.nodes.levels, self.rows, self.lattice.side
        count = sections.cut + sections.near_rings
        corrections = self.corrections = self._corrections.take(count)
        continue_through_cage(lattice, levels, rows, sections, vertex_values, values)
        continue_outwards(1, lattice, levels, sections, vertex_values, values)
        with side.fork():  # looks at rings 0 and 1 only
            found = lattice.block_faces
            near = [found.counts, found.near, lattice.vertices, lattice.faces, found.boxes]
            inputs = [levels, rows, *near, vertex_values, values]
            self._launch(measure_corrections, count, inputs, [corrections])
        continue_outwards(2, lattice, levels, sections, vertex_values, values)
        side.join()
        self._launch(correct_values, count, [levels, corrections], [values])


class IterativeSolver(VertexWeightSolver):
    """The same, by coordinates that are found by iterations at each node, and are not there in what is inside out."""

    def clear(self, sizes: PoseSizes) -> None:
        """Launch what clears the values, the count of gaps and what is left, before a solution."""
        super().clear(sizes)
        self.status.zero_()

    def launch_formula_adjoint(
        self, sums: CornerSums, targets: wp.array, points: wp.array, by_positions: wp.array
    ) -> None:
        """Launch the backward pass through maximum likelihood coordinates; see ClosedFormSolver."""
        sums.add_maximum_likelihood(points, by_positions, self._vertices, targets, self._size, sums.no_rows)

    def take_status(self, status: np.ndarray) -> None:
        """Note how a solution ended, and warn where there was none."""
        super().take_status(status)
        if self.residual > 0.0:
            warn_caller(
                f"no {self._kind.name} coordinates are found {_WITHOUT}, and the picture is rough there: "
                "pose it without, or take other coordinates"
            )

    def weigh(self) -> list[WeightBlock]:
        """As ClosedFormSolver; refuses a pose with nodes that have none."""
        blocks = super().weigh()
        bad = wp.zeros(1, dtype=int, device=self.device)
        for _, weights, _ in blocks:
            if weights.size:
                self._launch(find_not_finite, weights.shape[0], [weights[:, 0]], [bad])
        if bad.numpy()[0]:
            raise InputError(
                f"no {self._kind.name} weights are found {_WITHOUT}: pose it without, or take other coordinates"
            )
        return blocks


class GreenSolver(ClosedFormSolver):
    """Green maps: the formula jumps at the cage, so the rings continue the inside values linearly."""

    jumps_at_cage = True

    def __init__(self, lattice: CageLattice, kind: CoordinateKind):
        super().__init__(lattice, kind)
        self._map_crossings = kind.load("map_crossings")
        self._rest: ClosedMesh | None = None
        self._rest_faces: list[wp.array] = []
        self._face_values = empty_array(self._faces.size, wp.vec3, self.device)

    def weighted_values(self, target: MapTarget) -> tuple[wp.array, wp.array]:
        """Values at vertices (v,), and what face weights in node units multiply (f,), of the faces in fans. The latter
        are launched; see the kernel."""
        rest = target.rest
        if self._rest is not rest:
            stretch = StretchTarget.of(rest, rest.topology.fans.faces)
            products = np.stack([stretch.ss, stretch.st, stretch.tt]) / rest.size**2
            self._rest_faces = [
                wp.array(np.ascontiguousarray(columns.T, dtype=np.float32), dtype=wp.vec3, device=self.device)
                for columns in (stretch.normals, products)
            ]
            self._rest = rest
        inputs = [self._vertices, self._faces, *self._rest_faces, target.affine, rest.size]
        self._launch(stretch_normals, self._faces.size, inputs, [self._face_values])
        return target.vertex_values, self._face_values

    def cut_rows(self, sizes: PoseSizes, table: CutRowTable) -> WarpStruct:
        """Launch the description of the cut nodes, which the map itself takes none of; see MapSolver."""
        return table.describe(self.lattice, self.nodes.levels, sizes.lists)

    def launch_boundary(
        self, sizes: PoseSizes, target: MapTarget, rows: WarpStruct, marks: wp.array, boundary: wp.array
    ) -> None:
        """Launch the limit of the map from inside where links cross the cage at narrow gaps; see MapSolver."""
        values = self.weighted_values(target)
        inputs = [self.nodes.levels, rows, marks, self._vertices, self._faces, self._fans, *values, self._size]
        self._launch(self._map_crossings, boundary.size, inputs, [boundary], all_faces=True)

    def launch_formula_adjoint(
        self, sums: CornerSums, targets: wp.array, points: wp.array, by_positions: wp.array
    ) -> None:
        """Launch the backward pass through Green coordinates and stretched normals; see ClosedFormSolver."""
        assert self._rest is not None
        lattice = self.lattice
        normals = lattice.spacing * stretched_normals(lattice.cage, StretchTarget.of(self._rest)).T
        values = wp.array(normals.astype(np.float32), dtype=wp.vec3, device=self.device)
        sums.add_green(points, by_positions, self._vertices, targets, values, self._size)

    def _launch_map(self, sections: NodeSections, target: MapTarget, values: wp.array) -> None:
        cage = [self._vertices, self._faces, self._fans, *self.weighted_values(target), self._size]
        self._launch(self._map_nodes, sections.evaluated, [self.nodes.levels, *cage], [values], all_faces=True)

    def continue_map(self, sections: NodeSections, vertex_values: wp.array, values: wp.array) -> None:
        for ring in range(RINGS):
            continue_outwards(ring, self.lattice, self.nodes.levels, sections, vertex_values, values)


class BiharmonicSolver(GreenSolver):
    """Biharmonic maps: as Green maps, with more on the faces, which the host solves for."""

    # They meet the cage to about a hundredth of its size or less, so they are continued from inside as Green maps are.

    def __init__(self, lattice: CageLattice, kind: CoordinateKind):
        super().__init__(lattice, kind)
        require_few_faces(self._faces.size)
        self._is_solved = True
        self._sent = PoseConstants(self.device, [(kind.face_layers * self._faces.size, wp.vec3)])

    def write_values(self, rest: ClosedMesh, matrix: np.ndarray) -> None:
        """Solve for what faces carry, of the pose and vertex values that the lattice has; see MapSolver."""
        lattice, posed = self.lattice, self.lattice.cage
        stretched = stretched_normals(posed, StretchTarget.of(rest)) - matrix @ StretchTarget.of(posed).normals
        slopes = stretched.T[posed.topology.fans.order] * (lattice.spacing / rest.size)
        equations = LayerEquations(posed, posed.topology.fans.faces, posed.size / lattice.spacing, self.device)
        try:
            found = equations.solve(lattice.map_constants.vertex_values.host, slopes)
        except InputError:  # of a pose that is not usable, as the caller says once the device is done
            found = np.full(self._sent.slots[0].host.shape, np.nan)
        self._is_solved = bool(np.isfinite(found).all())
        self._sent.slots[0].host[:] = found

    def take_status(self, status: np.ndarray) -> None:
        """Note how a solution ended; warn where there was none."""
        super().take_status(status)
        if not self._is_solved:
            warn_caller(f"no {self._kind.name} coordinates are found, as faces of the posed cage lie on each other")

    def weighted_values(self, target: MapTarget) -> tuple[wp.array, wp.array]:
        """Values at vertices (v,), and of faces (3 f,) the slopes, Laplacians and their slopes, which are sent."""
        self._sent.send()
        return target.vertex_values, self._sent.slots[0].array
