"""PositionMap: where every point inside a deformed cage comes from in the rest cage, on a lattice."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..core.checks import warn_caller
from ..core.devices import launch, resolve_device
from ..core.memory import require_memory
from ..core.names import COORDINATES, STORES
from ..kernels.lattice.cage_map import CageMap
from ..kernels.lattice.rings import add_affine
from ..mesh.closed_mesh import require_mesh
from ..mesh.faces import face_area
from ..mesh.match import require_same_faces
from ..mesh.usable import require_usable
from .closed_form import GreenSolver, MeanValueSolver
from .gaps import REPORTED_JUMP, MapSides, side_bytes
from .graph import PoseGraph
from .harmonic import HarmonicSolver, require_tolerance
from .lattice import CageLattice, lattice_frame, require_resolution
from .weights import LatticeWeights

#: Bytes that a node, a lattice line and a square cell of the cage surface take, and some that all share.
NODE_BYTES, LEVELS_BYTES, LINE_BYTES, SURFACE_BYTES, FIXED_BYTES = 20, 4, 100, 350, 1 << 19


class PositionMap:
    """The map x -> sum_j w_j(x) v_j from a deformed cage to its rest cage, on the nodes of a lattice over the former.

    rest: the canonical Cage. coordinates: "harmonic", "mean_value" or "green". resolution: cells along the longest
    side of the deformed cage, 8 to 1024. origin: (3,) world point that device arrays are relative to (default: the
    middle of the rest cage's bounding box). store: "map" keeps three channels a node; "weights" keeps the weights of
    all vertices at inside nodes (green: of faces too), so that `rebind` can give the pose another rest cage.
    tolerance: harmonic only, the solver's, as a share of the rest cage's size.

    What is computed is the remainder after the affine map that fits the cage's vertices best (least squares), which all
    three kinds of coordinates reproduce: so affine poses are exact (green: similarities, up to rounding), whatever the
    resolution. Nothing is computed before `pose`.

    Attributes: data, the CageMap for kernels; lattice; origin (3,) float64; cycles and residual of the harmonic solver
    (0 for the closed forms); thin_nodes, how many nodes lie at gaps of the deformed cage that are narrower than about
    two cells and that the pose opens: there the map keeps values for each side (kernels/lattice/side_values.py), which
    hold down to gaps of one cell; gap_jump, by how much the pose opens gaps narrower than that, as a share of the rest
    cage's size. `pose` warns where it is above 2e-2.

    Raises ValueError for unusable cages, unknown names, a resolution or tolerance out of range, poses whose faces
    differ, and where the device has not the memory. Source: "Deforming Radiance Fields with Cages" (ECCV 2022),
    sections 3.3, 4.1.
    """

    def __init__(
        self,
        rest,
        *,
        coordinates: str = "harmonic",
        resolution: int = 128,
        origin=None,
        device=None,
        store: str = "map",
        tolerance: float = 1e-5,
    ):
        if coordinates not in COORDINATES:
            raise ValueError(f"coordinates must be one of {', '.join(COORDINATES)}, got {coordinates!r}")
        if store not in STORES:
            raise ValueError(f"store must be one of {', '.join(STORES)}, got {store!r}")
        require_mesh(rest, "the rest cage must be")
        require_usable(rest, "rest cage")
        self.coordinates, self.store = coordinates, store
        self.rest = rest
        self.resolution = require_resolution(resolution)
        self.tolerance = require_tolerance(tolerance)
        self.device = resolve_device(device)
        self.origin = np.array(rest.bounds.mean(axis=0) if origin is None else origin, dtype=np.float64).reshape(3)
        self.lattice: CageLattice | None = None
        self._solver = None
        self._weights: LatticeWeights | None = None
        self._data: CageMap | None = None
        self._graph: PoseGraph | None = None
        self._sides: MapSides | None = None
        self.gap_jump = 0.0

    def pose(self, deformed) -> PositionMap:
        """Compute the map from `deformed`, a Cage with the faces of the rest cage. Buffers of the last pose are reused.

        Raises ValueError for faces that differ, an unusable cage, or one farther from `origin` than about
        3e6 / resolution times its size, where float32 numbers are half a cell apart (the map then stays that of the
        last pose); and for too little memory (there is no map then, until the next pose).
        """
        require_mesh(deformed, "a pose must be")
        require_same_faces(self.rest, deformed)
        if self._graph is not None and self._data is not None and self._replay(deformed):
            return self
        require_usable(deformed, "deformed cage")
        needed = self.memory_bytes(deformed)  # refuses a cage too far away
        self._data = None  # what is in the buffers goes
        if self.lattice is not None:
            self.lattice.lay(deformed)
        self._weights = None  # the last pose's go before this one's come
        held = 0 if self.lattice is None else self.lattice.buffers.bytes
        require_memory(needed, self.device, self._too_large(), held=held)
        if self.lattice is None:
            self.lattice = CageLattice(deformed, self.resolution, origin=self.origin, device=self.device)
            self._solver = self._new_solver()
        else:
            self.lattice.constants.send()
            self.lattice.measure()
            self._solver.prepare()
        if self.store == "weights":
            self._weights = LatticeWeights(self._solver)
        self._map_positions()
        if self._graph is not None:
            self._graph.release()
        elif self._weights is None and PoseGraph.is_supported(self.device):
            self._graph = PoseGraph(self.lattice, self._solver, self.rest)
        return self

    def _replay(self, deformed) -> bool:
        """Pose by the graph; the host checks the cage while the device is at work. False where there is no room.

        Raises ValueError for an unusable cage, once the last pose's map is worked out again.
        """
        last = self.lattice.cage
        if deformed.size == 0.0:  # no lattice at all
            require_usable(deformed, "deformed cage")
        self.lattice.lay(deformed)
        self._data = None  # what is in the buffers goes
        has_room = self._graph.fits()
        if has_room:
            self._graph.begin()
            with np.errstate(all="ignore"):  # of faces without area
                self._write_values()
            self._graph.go_on()
        try:
            require_usable(deformed, "deformed cage")
        except ValueError:
            self.pose(last)
            raise
        if not has_room or not self._graph.finish():
            return False
        self._take_map(self._graph.has_gaps, self._graph)
        return True

    def rebind(self, rest) -> PositionMap:
        """Map the same pose to another canonical cage, from the weights that were kept.

        Raises ValueError without weights or a pose, for faces that differ, or an unusable cage.
        """
        if self.store != "weights":
            raise ValueError('rebind needs the weights: make the PositionMap with store="weights"')
        require_usable(rest, "rest cage")
        require_same_faces(rest, self._posed_lattice().cage)
        self.rest, self._sides = rest, None  # its tables were of the other cage
        self._data = None  # what is in the buffers goes
        self._map_positions()
        return self

    @property
    def data(self) -> CageMap:
        """The map for kernels: positions and distances relative to `origin`. The next pose overwrites its arrays."""
        self._posed_lattice()
        return self._data

    @property
    def weights(self) -> LatticeWeights:
        """The weights of the last pose. Raises ValueError where none are kept."""
        if self._weights is None:
            raise ValueError('no weights are kept: make the PositionMap with store="weights", and pose it')
        return self._weights

    @property
    def cycles(self) -> int:
        return 0 if self._solver is None else self._solver.cycles

    @property
    def residual(self) -> float:
        return 0.0 if self._solver is None else self._solver.residual

    @property
    def thin_nodes(self) -> int:
        self._posed_lattice()
        return self._solver.gaps.total() if self._has_gaps else 0

    def memory_bytes(self, deformed=None, *, gaps: bool = False) -> int:
        """Bytes on the device that a pose takes (default: the rest pose), worked out from shapes before allocation.

        gaps: with the most that the tables of narrow gaps may take, where they go all over the cage.
        """
        deformed = self.rest if deformed is None else deformed
        shape, _, spacing = lattice_frame(deformed, self.resolution, self.origin)
        nx, ny, nz = shape
        nodes, lines = nx * ny * nz, nx * ny + ny * nz + nx * nz
        inside = abs(deformed.volume) / spacing**3
        surface = face_area(deformed) / spacing**2
        total = FIXED_BYTES + NODE_BYTES * nodes + LINE_BYTES * lines + SURFACE_BYTES * surface + 5 * inside
        if self.coordinates == "harmonic":
            total += LEVELS_BYTES * nodes
        if gaps:
            total += side_bytes(nodes, surface)
        if self.store == "weights":
            total += LatticeWeights.row_bytes(self.coordinates, deformed) * (inside + 4 * surface)
        return int(total)

    def _posed_lattice(self) -> CageLattice:
        if self._data is None:
            raise ValueError("the PositionMap has no pose yet: call pose(deformed) first")
        return self.lattice

    def _too_large(self) -> str:
        remedy = "take a lower resolution"
        if self.store == "weights":
            remedy += ' or store="map"'
        return f"a {self.coordinates} {self.store} lattice at resolution {self.resolution} needs {{size}}: {remedy}"

    def _new_solver(self):
        if self.coordinates == "harmonic":
            return HarmonicSolver(self.lattice, tolerance=self.tolerance)
        return MeanValueSolver(self.lattice) if self.coordinates == "mean_value" else GreenSolver(self.lattice)

    def _write_values(self) -> None:
        """The remainder of the map, and its affine part, to the lattice's map_constants; still to be sent."""
        lattice, deformed, rest = self.lattice, self.lattice.cage, self.rest
        matrix, offset = fit_affine(deformed, rest)
        host = lattice.map_constants.host
        host["vertex_values"][:] = (rest.vertices - (deformed.vertices @ matrix.T + offset)) / rest.size
        host["affine"][:3] = matrix.T * lattice.spacing
        host["affine"][3] = matrix @ lattice.lower + offset - self.origin

    def _map_positions(self) -> None:
        """Fill the positions: remainder of the map, plus its affine part."""
        lattice = self.lattice
        self._write_values()
        lattice.map_constants.send()
        arrays = lattice.map_constants.arrays
        solver = self._solver if self._weights is None else self._weights
        solver.solve(arrays["vertex_values"], self._solver.face_values(self.rest, arrays["affine"]))
        inputs = [self._solver.nodes.levels, self.rest.size, arrays["affine"]]
        launch(add_affine, lattice.node_count, inputs, [self._solver.values], device=self.device)
        self._take_map(self._solver.gaps.found())

    def _take_map(self, has_gaps: bool, graph: PoseGraph | None = None) -> None:
        """Let `data` be what was computed. graph: that had room for it."""
        lattice = self.lattice
        data = CageMap()
        data.lower, data.spacing, data.inverse_spacing = lattice.local_lower, lattice.spacing, 1.0 / lattice.spacing
        data.positions = lattice.view("values", wp.vec3)
        data.distance = lattice.distance
        self.gap_jump = 0.0
        self._has_gaps = has_gaps
        if has_gaps:
            self._take_sides(data, graph)
        self._data = data  # whole: sides that there is no memory for leave none
        if self.gap_jump > REPORTED_JUMP:
            warn_caller(
                f"a cage has gaps narrower than a cell of its {self.coordinates} lattice, which the map opens by up to "
                f"{self.gap_jump:.2g} of the size: it is rough there, take a resolution above {self.resolution} or "
                "open the gaps"
            )

    def _take_sides(self, data: CageMap, graph: PoseGraph | None) -> None:
        """Give the map the sides of narrow gaps."""
        lattice = self.lattice
        if self._sides is None:
            self._sides = MapSides(self._solver, self.rest, lattice.map_constants.arrays)
        sides = self._sides
        require_memory(
            side_bytes(lattice.node_count, face_area(lattice.cage) / lattice.spacing**2),
            self.device,
            f"tables for sides of narrow gaps at resolution {self.resolution} need {{size}}: take a lower resolution",
            held=sides.buffers.bytes,
        )
        if graph is None or not graph.find_sides(sides):
            sides.find()
        data.side_index, data.sides = sides.index, sides.table
        self.gap_jump = sides.jump


def fit_affine(source, target) -> tuple[np.ndarray, np.ndarray]:
    """Matrix (3, 3) and offset (3,) of the affine map that takes the vertices of one cage nearest to another's.

    Vertices that no face uses do not count.
    """
    unused = source.topology.unused_vertices
    a, b = (np.delete(cage.vertices, unused, axis=0) if len(unused) else cage.vertices for cage in (source, target))
    centre, middle = a.mean(axis=0), b.mean(axis=0)
    a, b = a - centre, b - middle
    spread = a.T @ a
    if np.linalg.det(spread) > 1e-18 * np.trace(spread) ** 3:
        matrix = np.linalg.solve(spread, a.T @ b).T
    else:  # next to flat: directions that the vertices say nothing of stay out
        size = source.size
        matrix = np.linalg.lstsq(a / size, b, rcond=1e-9)[0].T / size
    return matrix, middle - matrix @ centre
