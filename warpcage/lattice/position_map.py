"""PositionMap: where every point inside a deformed cage comes from in the rest cage, on a lattice."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arrays import PointsLike, WarpStruct, empty_array
from ..core.checks import warn_caller
from ..core.devices import HeldOnDevice, resolve_device
from ..core.memory import free_bytes, require_memory
from ..core.names import FIELD_COORDINATES, coordinate_kind, require_store
from ..core.threads import owner_lock
from ..errors import InputError
from ..kernels.lattice.cage_map import CageMap
from ..mesh.faces import face_area
from ..mesh.match import posed_mesh, require_same_faces, with_faces_of
from ..mesh.mesh import ClosedMesh, require_mesh
from ..mesh.validity import require_covered_once, require_usable
from .gaps import REPORTED_JUMP, MapTarget, lattice_side_bytes, side_bytes
from .graph import PoseGraph
from .harmonic import require_tolerance
from .lattice import CageLattice, lattice_frame, more_list_bytes, require_resolution
from .launches import PoseLaunches
from .solver import LatticeWeights, MapSolver

if TYPE_CHECKING:  # kernels of gradients are imported where one is asked for
    from .corner_sums import CornerSums

#: Bytes for each node (and its coarser levels), lattice line and square cell of the cage surface, and a fixed part.
NODE_BYTES, LEVELS_BYTES, LINE_BYTES, SURFACE_BYTES, FIXED_BYTES = 20, 4, 100, 350, 1 << 19


#: Free memory, in multiples of that of the rest pose, from which graphs are captured before the first pose.
WARM_MEMORY = 8

#: Crossings of a lattice line that these graphs have room for: twice what lines have otherwise.
WARM_CROSSINGS = 16


@dataclass(frozen=True, eq=False)
class BegunPose:
    """A pose between `begin` and `finish`."""

    cage: ClosedMesh
    draft: WarpStruct | None = None  # the map to be, without sides of narrow gaps, where a graph is at work on it
    last: ClosedMesh | None = None  # the cage of the map before, None where that is lost


class PositionMap(HeldOnDevice):
    """The map x -> sum_j w_j(x) v_j from a deformed cage to its rest cage, on the nodes of a lattice over the former.

    What is computed is the residual after the affine map that fits the cage's vertices best (least squares), which all
    kinds of coordinates reproduce: so affine poses are exact (green: similarities, up to rounding), whatever the
    resolution. Nothing is computed before `pose`.

    Where the deformed cage has gaps narrower than about two cells that the pose opens, the map keeps values for each
    side (kernels/lattice/side_values.py), which hold down to gaps of one cell. `pose` warns where it opens gaps
    narrower than that by more than 2e-2 of the size; faces of the posed cage that pass through each other count too.

    Source: "Deforming Radiance Fields with Cages" (ECCV 2022), sections 3.3, 4.1.

    Args:
        rest: The canonical Cage.
        coordinates: "harmonic", "mean_value", "green", "maximum_likelihood" or "biharmonic" (coordinate_kinds.py).
        resolution: Cells along the longest side of the deformed cage, 8 to 1024.
        origin: (3,) world point that device arrays are relative to. None is the middle of the rest cage's bounding box.
        device: Warp device. None is CUDA where there is one.
        store: "map" keeps three channels for each node. "weights" keeps the weights of all vertices at inside nodes
            (green: of faces too), so that `rebind` can give the pose another rest cage.
        tolerance: Harmonic only: the solver's, as a share of the rest cage's size, 2e-6 to 0.1.

    Attributes:
        rest: The canonical Cage.
        coordinates: As given.
        store: As given.
        resolution: As given.
        tolerance: As given.
        device: Warp device.
        origin: (3,) float64.
        lattice: The lattice, None before the first pose.
        launches: What poses launch, with their solver and the tables of narrow gaps; None before the first pose.
        gap_jump: By how much the pose opens gaps narrower than a cell, as a share of the rest cage's size. Grooves over
            which the map stretches by up to 3 alone are none.
        gap_remedy: What the warning of them says that callers can do, where the cage is not posed as they gave it;
            empty is to open the gaps, or to take a finer lattice.
        lock: Held while buffers are in use. Threads that share a map hold it over `pose` and what then reads `data`.

    Raises:
        ValueError: For an unusable cage, unknown names, or a resolution or tolerance out of range.
    """

    def __init__(
        self,
        rest: ClosedMesh,
        *,
        coordinates: str = FIELD_COORDINATES,
        resolution: int = 128,
        origin: ArrayLike | None = None,
        device: wp.DeviceLike = None,
        store: str = "map",
        tolerance: float = 1e-5,
    ):
        self._kind, self.store = coordinate_kind(coordinates), require_store(store)
        self.coordinates: str = self._kind.name
        require_mesh(rest, "the rest cage must be")
        require_usable(rest, "rest cage")
        if self._kind.is_summed:
            require_covered_once(rest, self.coordinates, "rest cage")
        self.rest = rest
        self._surface = rest.refined(self._kind.face_cells)
        self.resolution = require_resolution(resolution)
        self.tolerance = require_tolerance(tolerance)
        self.device = resolve_device(device)
        self.origin = np.array(rest.bounds.mean(axis=0) if origin is None else origin, dtype=np.float64).reshape(3)
        self.lock = owner_lock(self.device)
        self.lattice: CageLattice | None = None
        # arrays, not None, which a wp.Tape that goes back through the map cannot take
        self._no_sides = empty_array(0, wp.int32, self.device), empty_array((0, 8), wp.vec4, self.device)
        self.gap_jump, self.gap_remedy = 0.0, ""
        self.launches: PoseLaunches | None = None
        self._weights: LatticeWeights | None = None
        self._data: WarpStruct | None = None
        self._graph: PoseGraph | None = None
        self._has_gaps = False
        self._begun: BegunPose | None = None
        self._sums: CornerSums | None = None
        self._is_at_work = False  # whether a graph may read what the host wrote for a pose
        self._is_replayable = False  # whether the graph's buffers and the lattice have seen a pose

    def pose(self, deformed: ClosedMesh | PointsLike) -> PositionMap:
        """Compute the map from a deformed cage. Buffers of the last pose are reused.

        Args:
            deformed: A Cage with the faces of the rest cage, or its vertices (v, 3) in world units as an array of any
                library.

        Returns:
            self.

        Raises:
            ValueError: For faces that differ, an unusable cage, or one farther from `origin` than about
                3e6 / resolution times its size, where float32 numbers are half a cell apart (the map then stays that
                of the last pose). For too little memory (there is no map then, until the next pose).
        """
        with self.lock:
            self.begin(deformed)
            self.finish()
        return self

    def begin(self, deformed: ClosedMesh | PointsLike) -> WarpStruct | None:
        """Start on a pose, so that the device is at work while the host goes on.

        Call `finish` before the map is used, and hold `lock` over both where threads share it.

        Args:
            deformed: As for `pose`.

        Returns:
            What `data` is to be, its arrays still to be filled, without the sides of narrow gaps. None where `finish`
            does the work, and perhaps makes buffers anew.

        Raises:
            ValueError: As `pose`, for what is known before the work.
        """
        deformed = posed_mesh(self.rest, deformed, "a pose must be").refined(self._kind.face_cells)
        return self._begin(deformed)

    def _begin(self, deformed: ClosedMesh) -> WarpStruct | None:
        """Start on a pose of the surface; see `begin`."""
        if deformed.size == 0.0:  # no lattice at all
            require_usable(deformed, "deformed cage")
        with self.lock:
            self._let_go()
            draft, last = None, None
            if self._graph is not None and self._is_replayable:
                last = None if self._data is None or self.lattice is None else self.lattice.cage
                draft = self._replay(self._graph, deformed)
            self._begun = BegunPose(deformed, draft, last)
            return draft

    def finish(self) -> PositionMap:
        """Wait for the pose that was begun last; the host checks its cage while the device is at work.

        Returns:
            self. `data` is what `begin` returned, unless that had no room: compare them (`is`).

        Raises:
            ValueError: As `pose`.
        """
        with self.lock:
            assert self._begun is not None, "finish comes after begin"
            begun, graph = self._begun, self._graph
            try:
                require_usable(begun.cage, "deformed cage")
            except ValueError:
                self._let_go()
                if self._data is None and begun.last is not None:
                    self._begin(begun.last)
                    self.finish()
                raise
            has_room = begun.draft is not None and graph is not None and graph.finish()
            self._begun, self._is_at_work = None, False
            if has_room and self.launches is not None and graph is not None:
                self._take_map(self.launches, graph.has_gaps, graph, begun.draft)
            else:
                self._pose_step_by_step(begun.cage)
        return self

    def _let_go(self) -> None:
        """Forget an unfinished pose, once the device no longer reads what the host wrote for it."""
        if self._is_at_work and self.launches is not None:
            self.launches.wait()
        self._begun, self._is_at_work = None, False

    def warm(self) -> PositionMap:
        """Pose the rest cage, and capture the graphs that later poses replay; the first poses take no longer then.

        Nothing is done where no graphs are, or where memory is short: a pose will say so.

        Returns:
            self.
        """
        if self.store != "map" or not PoseGraph.is_supported(self.device):
            return self
        with self.lock:
            if WARM_MEMORY * self.memory_bytes(gaps=True) > free_bytes(self.device):
                return self
            self.pose(self.rest)
            launches, lattice = self._posed()
            assert self._graph is not None
            lattice.make_room(WARM_CROSSINGS)
            self._graph.fits(lattice.sizes(launches.solver.nodes.level_count))
            self._graph.capture_sides()
        return self

    def _pose_step_by_step(self, deformed: ClosedMesh) -> None:
        """Pose with exact sizes, which the device is waited for."""
        needed = self.memory_bytes(deformed)  # refuses a cage too far away
        self._data = self._weights = None  # what is in the buffers goes, and weights before new ones come
        self._is_replayable = False
        held = 0 if self.lattice is None else self.lattice.buffers.bytes
        require_memory(needed, self.device, self._too_large(), held=held)
        launches = self._laid(deformed)
        launches.solver.prepare()
        if self.store == "weights":
            self._weights = LatticeWeights(launches.solver)
        self._map_positions(launches)
        if self._graph is not None:
            self._graph.release()
            self._is_replayable = True

    def _laid(self, deformed: ClosedMesh) -> PoseLaunches:
        """The launches of a pose, with the lattice laid over it; made with the first one."""
        if self.launches is not None:
            self.launches.solver.lattice.lay(deformed)
            return self.launches
        self.lattice = CageLattice(deformed, self.resolution, origin=self.origin, device=self.device)
        constants = self.lattice.map_constants
        target = MapTarget(self._surface, constants.affine.array, constants.vertex_values.array)
        self.launches = PoseLaunches(self._new_solver(self.lattice), target)
        if self.store == "map" and PoseGraph.is_supported(self.device):
            self._graph = PoseGraph(self.launches)
        return self.launches

    def _replay(self, graph: PoseGraph, deformed: ClosedMesh) -> WarpStruct | None:
        """Start on a pose by the graph; the map that it is to be, None where there is no room."""
        launches = self.launches
        assert launches is not None
        lattice = launches.solver.lattice
        lattice.lay(deformed)
        self._data = None  # what is in the buffers goes
        if not graph.fits(lattice.sizes(launches.solver.nodes.level_count)):
            return None
        self._is_at_work = True
        graph.begin()
        with np.errstate(all="ignore"):  # of faces without area
            self._write_values(lattice)
        graph.go_on()
        return self._draft(launches)

    def rebind(self, rest: ClosedMesh) -> PositionMap:
        """Map the same pose to another canonical cage, from the weights that were kept.

        Args:
            rest: A Cage with the faces of the first one.

        Returns:
            self.

        Raises:
            ValueError: Without weights or a pose, for faces that differ, or an unusable cage.
        """
        if self.store != "weights":
            raise InputError('rebind needs the weights: make the PositionMap with store="weights"')
        require_usable(rest, "rest cage")
        with self.lock:
            launches, _ = self._posed()
            require_same_faces(rest, self.rest)
            self._surface = with_faces_of(self.rest, rest).refined(self._kind.face_cells)
            self.rest = rest
            launches.target = MapTarget(self._surface, launches.target.affine, launches.target.vertex_values)
            self._data = None  # what is in the buffers goes
            self._map_positions(launches)
        return self

    def vertex_gradient(self, by_positions: wp.array[Any, Any]) -> tuple[wp.array[Any, Any], wp.array[Any, Any]]:
        """The gradient of a number by the cages of the last pose, from that by the positions of the map's nodes.

        The lattice is held: nodes stay where they are while vertices move. That they go with the cage's box changes
        nothing but the error of look-up. Where the map is not smooth the gradient is that of the branch the map is on:
        a node that a face passes over turns from the map to its continuation outside (they agree on the face), and a
        value beyond a crossing is continued from another node. Held are also the sides of narrow gaps, the signed
        distance, and the corrections of mean value and maximum likelihood maps next to the cage, without which slopes
        of nodes there are off by less than a hundredth.

        Args:
            by_positions: Slopes of the number by `data.positions`, of its shape, vec3 on its device; zero where it does
                not depend on a node. Hold `lock` over the pose, what reads it, and this.

        Returns:
            Slopes by the vertices of the posed cage and of the rest cage, two Warp arrays (v,) of vec3 on the device,
            per world unit. Neither the host nor other streams wait for them.

        Raises:
            ValueError: Without a pose, for slopes of another shape, type or device, and for coordinates without an
                adjoint (biharmonic).
        """
        with self.lock:
            launches, lattice = self._posed()
            if not self._kind.has_gradients:
                raise InputError(f"no gradient passes through {self.coordinates} maps: take other coordinates")
            if by_positions.shape != lattice.shape or by_positions.dtype != wp.vec3:
                given = f"{by_positions.shape} of {by_positions.dtype.__name__}"
                raise InputError(f"slopes by the nodes must be {lattice.shape} of vec3, as data.positions, got {given}")
            if self._sums is None:
                from .corner_sums import CornerSums

                self._sums = CornerSums(lattice.cage, self.device)
            self._sums.clear()
            targets = wp.array(self._surface.vertices - self.origin, dtype=wp.vec3, device=self.device)
            launches.solver.backward(by_positions.flatten(), launches.target, targets, self._sums)
            return self._sums.gathered((1.0 / lattice.spacing, 1.0))

    @property
    def data(self) -> WarpStruct:
        """The map for kernels: positions and distances relative to `origin`. The next pose overwrites its arrays."""
        with self.lock:
            self._posed()
            assert self._data is not None
            return self._data

    @property
    def weights(self) -> LatticeWeights:
        """The weights of the last pose. Raises ValueError where none are kept."""
        if self._weights is None:
            raise InputError('no weights are kept: make the PositionMap with store="weights", and pose it')
        return self._weights

    @property
    def cycles(self) -> int:
        """Multigrid cycles of the last pose; 0 for closed forms."""
        return 0 if self.launches is None else self.launches.solver.cycles

    @property
    def residual(self) -> float:
        """What the harmonic solver left, as a share of the rest cage's size; 0 for closed forms."""
        return 0.0 if self.launches is None else self.launches.solver.residual

    @property
    def thin_nodes(self) -> int:
        """Nodes at gaps of the deformed cage that are narrower than about two cells and that the pose opens."""
        with self.lock:
            launches, _ = self._posed()
            return launches.solver.gaps.total() if self._has_gaps else 0

    def memory_bytes(self, deformed: ClosedMesh | None = None, *, gaps: bool = False) -> int:
        """Bytes on the device that a pose takes, worked out from shapes before allocation.

        Args:
            deformed: A pose. None is the rest pose.
            gaps: Whether to add the most that the tables of narrow gaps may take, where they go all over the cage.

        Returns:
            Bytes, somewhat more than are taken. On CUDA the graphs that later poses replay have room for poses of any
            proportions (lattices of less than four million nodes: up to four times as much, and no more than for a
            cube), or an eighth more.

        Raises:
            ValueError: For a cage too far from `origin`.
        """
        deformed = (self.rest if deformed is None else deformed).refined(self._kind.face_cells)
        shape, _, spacing = lattice_frame(deformed, self.resolution, self.origin)
        nx, ny, nz = shape
        nodes, lines = nx * ny * nz, nx * ny + ny * nz + nx * nz
        inside = abs(deformed.volume) / spacing**3
        surface = face_area(deformed) / spacing**2
        total = FIXED_BYTES + NODE_BYTES * nodes + LINE_BYTES * lines + SURFACE_BYTES * surface + 5 * inside
        total += more_list_bytes(deformed, shape, spacing)
        if not self._kind.is_closed_form:
            total += LEVELS_BYTES * nodes
        if gaps:
            total += side_bytes(nodes, surface)
        if self.store == "weights":
            total += LatticeWeights.row_bytes(self.coordinates, deformed) * (inside + 4 * surface)
        return int(total)

    def _posed(self) -> tuple[PoseLaunches, CageLattice]:
        if self._data is None or self.launches is None:
            raise InputError("the PositionMap has no pose yet: call pose(deformed) first")
        return self.launches, self.launches.solver.lattice

    def _too_large(self) -> str:
        remedy = "take a lower resolution"
        if self.store == "weights":
            remedy += ' or store="map"'
        return f"a {self.coordinates} {self.store} lattice at resolution {self.resolution} needs {{size}}: {remedy}"

    def _new_solver(self, lattice: CageLattice) -> MapSolver:
        solver = self._kind.load("solver")
        return solver(lattice, self._kind) if self._kind.is_closed_form else solver(lattice, tolerance=self.tolerance)

    def _write_values(self, lattice: CageLattice) -> None:
        """The residual of the map, and its affine part, to the lattice's map_constants; still to be sent."""
        deformed, rest = lattice.cage, self._surface
        matrix, offset = fit_affine(deformed, rest)
        constants = lattice.map_constants
        constants.vertex_values.host[:] = (rest.vertices - (deformed.vertices @ matrix.T + offset)) / rest.size
        constants.affine.host[:3] = matrix.T * lattice.spacing
        constants.affine.host[3] = matrix @ lattice.lower + offset - self.origin
        assert self.launches is not None
        self.launches.solver.write_values(rest, matrix)

    def _map_positions(self, launches: PoseLaunches) -> None:
        """Fill the positions of the pose that is laid out: residual of the map, plus its affine part."""
        solver = launches.solver
        self._write_values(solver.lattice)
        launches.launch_map(solver.sizes, self._weights)
        status = launches.wait()
        if self._weights is None:
            solver.take_status(status.solution)
        self._take_map(launches, status.has_gaps)

    def _draft(self, launches: PoseLaunches) -> WarpStruct:
        """The map of the pose that is laid out, without sides."""
        lattice = launches.solver.lattice
        data = CageMap()
        data.lower, data.spacing, data.inverse_spacing = lattice.local_lower, lattice.spacing, 1.0 / lattice.spacing
        data.positions = launches.solver.shaped_values
        data.distance = lattice.distance
        data.side_index, data.sides = self._no_sides
        return data

    def _take_map(
        self, launches: PoseLaunches, has_gaps: bool, graph: PoseGraph | None = None, draft: WarpStruct | None = None
    ) -> None:
        """Let `data` be what was computed. graph: that had room for it. draft: the map without sides, where it is
        there."""
        data = self._draft(launches) if draft is None else draft
        self.gap_jump = 0.0
        self._has_gaps = has_gaps
        if has_gaps:
            self._take_sides(data, launches, graph)
        self._data = data  # whole: sides that there is no memory for leave none
        if self.gap_jump > REPORTED_JUMP:
            usual = f"open the gaps in the cage, or take a finer lattice, a resolution above {self.resolution}"
            warn_caller(
                f"a cage has gaps narrower than a cell of its {self.coordinates} lattice, or faces that pass through "
                f"each other, which the pose opens by up to {self.gap_jump:.2g} of its size: the picture is rough "
                f"there; {self.gap_remedy or usual}"
            )

    def _take_sides(self, data: WarpStruct, launches: PoseLaunches, graph: PoseGraph | None) -> None:
        """Give the map the sides of narrow gaps."""
        sides = launches.sides
        if graph is None or not graph.has_room_for_sides:
            require_memory(
                lattice_side_bytes(launches.solver.lattice),
                self.device,
                f"tables for sides of narrow gaps at resolution {self.resolution} need {{size}}: "
                "take a lower resolution",
                held=sides.buffers.bytes,
            )
        if graph is None or not graph.find_sides():
            launches.find_sides(launches.solver.sizes)
        data.side_index, data.sides = sides.index, sides.table
        self.gap_jump = sides.jump


def fit_affine(source: ClosedMesh, target: ClosedMesh) -> tuple[np.ndarray, np.ndarray]:
    """The affine map that takes a cage's used vertices nearest (least squares) to another's: (3, 3), (3,), world."""
    unused = source.topology.unused_vertices
    a, b = (np.delete(cage.vertices, unused, axis=0) if len(unused) else cage.vertices for cage in (source, target))
    center, middle = a.mean(axis=0), b.mean(axis=0)
    a, b = a - center, b - middle
    spread = a.T @ a
    if np.linalg.det(spread) > 1e-18 * np.trace(spread) ** 3:
        matrix = np.linalg.solve(spread, a.T @ b).T
    else:  # almost flat: leave out directions that the vertices do not span
        size = source.size
        matrix = np.linalg.lstsq(a / size, b, rcond=1e-9)[0].T / size
    return matrix, middle - matrix @ center
