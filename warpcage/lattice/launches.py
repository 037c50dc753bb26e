"""PoseLaunches: all that a pose of a map does on a device, as lists of launches with sizes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..core.devices import HeldOnDevice, launch
from ..kernels.lattice.rings import add_affine, gather_status
from .buffers import HostNumbers
from .gaps import MapNodes, MapSides, MapTarget
from .sizes import NodeSections, PoseSizes
from .solver import MapSolver

#: Entries of a status before the lengths of the sections.
STATUS_WORDS = 5


class MapSource(Protocol):
    """What fills in a map: a solver, or its stored weights."""

    def launch_solution(self, sizes: PoseSizes, target: MapTarget) -> None:
        """See MapSolver."""


@dataclass(frozen=True, eq=False)
class PoseStatus:
    """The outcome of a computed pose."""

    has_room: bool  # whether lines and lists were long enough
    solution: np.ndarray  # (2,) cycles and residual of the solver
    has_gaps: bool  # whether there are narrow gaps over which the map jumps
    sections: NodeSections  # lengths of the lists of nodes


class PoseLaunches(HeldOnDevice):
    """The launches of a pose, in order: the layout, the map, and where it has narrow gaps their sides.
    Each takes the sizes of its pose, or bounds: a CUDA graph that holds the launches serves all poses within them."""

    def __init__(self, solver: MapSolver, target: MapTarget):
        self.solver, self.target = solver, target  # another target: another map of the same layout
        self.sides = MapSides(solver.device)
        self._lattice, self._device = solver.lattice, solver.device
        self._status = HostNumbers(STATUS_WORDS + len(solver.nodes.sections.lengths), self._device)

    def launch_layout(self, sizes: PoseSizes) -> PoseSizes:
        """Launch what lays out the pose that the lattice's constants hold, from their upload on.
        Returns sizes with sections. Without sections it waits for what only the device knows."""
        return self.solver.launch_layout(sizes)

    def launch_map(self, sizes: PoseSizes, source: MapSource | None = None) -> None:
        """Launch the map that the lattice's map_constants hold, from their upload on; `wait` returns how it ended.
        sizes: with sections; source: what fills in the map, None is the solver."""
        lattice, solver, levels = self._lattice, self.solver, self.solver.nodes.levels
        values = solver.values_of(sizes)
        lattice.map_constants.send()
        (source or solver).launch_solution(sizes, self.target)
        with lattice.side.fork():
            flags = lattice.flags
            inputs = [flags.lines, flags.lists, solver.status, flags.gaps, flags.narrow, levels]
            status = self._status.array
            launch(gather_status, status.size, inputs, [status], device=self._device)
        inputs = [levels, self.target.rest.size, self.target.affine]
        launch(add_affine, sizes.nodes, inputs, [values], device=self._device)
        lattice.side.join()

    def wait(self) -> PoseStatus:
        """Wait for the map, and return how it ended."""
        status = self._status.wait()
        return PoseStatus(
            has_room=status[0] == 0.0 and status[1] == 0.0,
            solution=status[2:4],
            has_gaps=status[4] > 0.0,
            sections=NodeSections(status[STATUS_WORDS:].astype(np.int64)),
        )

    def launch_sides(self, sizes: PoseSizes, room: int | None = None) -> None:
        """Launch the tables of sides, of a map that is there; `sides.take` reads what they hold.
        sizes: with sections; room: rows of the tables, at most, None waits until the device has counted them."""
        solver, sides, sections = self.solver, self.sides, sizes.lists
        lattice, levels, values = self._lattice, solver.nodes.levels, solver.values_of(sizes)
        boundary = sides.boundary.take((sections.cut, 6))
        rows = solver.cut_rows(sizes, sides.rows)
        solver.gaps.count.zero_()
        # where there are sides at all, all gaps get theirs
        flags = solver.gaps.search(lattice, levels, rows, sections, values, 0.0)
        nodes = MapNodes(levels, rows, boundary, values, solver.corrections, flags)
        marks = sides.launch_marks(sizes, nodes)
        solver.launch_boundary(sizes, self.target, rows, marks, boundary)
        sides.launch(sizes, lattice, nodes, self.target, room)

    def find_sides(self, sizes: PoseSizes) -> None:
        """Fill the tables of sides, with as many rows as they take; sizes: of the pose, with sections."""
        self.launch_sides(sizes)
        self.sides.take()
