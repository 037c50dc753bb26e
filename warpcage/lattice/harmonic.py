"""HarmonicSolver: the Laplace equation inside a cage, by multigrid on the nodes of a lattice."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..core.arrays import WarpStruct, empty_array
from ..core.checks import checked_number, warn_caller
from ..core.devices import captured, lane_count, launch, launch_off_tape
from ..core.modules import load_modules, require_loaded
from ..core.reports import Progress, report_progress
from ..kernels.lattice import harmonic as harmonic_kernels
from ..kernels.lattice import harmonic_coarse
from ..kernels.lattice.cage_map import select_vertices, store_weights
from ..kernels.lattice.cut_rows import set_sources
from ..kernels.lattice.harmonic import (
    LaplaceSystem,
    begin_cycles,
    judge_cycle,
    leave_residual,
    prolong_and_measure,
    prolong_correction,
    relax_and_measure,
    relax_laplace,
    restrict_residual,
)
from ..kernels.lattice.harmonic_coarse import BLOCK_THREADS, cycle_coarse_levels
from .gaps import MapTarget
from .lattice import CageLattice
from .nodes import CutRowTable, LatticeNodes, continue_to_rings
from .sizes import NodeSections, PoseSizes
from .solver import MapSolver, WeightBlock

if TYPE_CHECKING:
    from .corner_sums import CornerSums

SWEEPS = 2  # before and after the coarse correction: V(2, 2)
COARSEST_SWEEPS = 8
MAX_CYCLES = 40
MIN_ADJOINT_CYCLES = 6

#: Tolerances below the rounding of float32 would never be met.
MIN_TOLERANCE = 2e-6

#: What is left after a cycle, seen from the largest correction of that cycle and from the largest scaled residual: a
#: cycle gains a factor of about ten, and errors that its smoothing leaves are a few times their row's update.
ERROR_PER_CORRECTION, ERROR_PER_RESIDUAL = 0.25, 8.0

#: Slots that the largest residuals are gathered in.
LARGEST_SLOTS = 64

#: Sweeps over fewer nodes than this run on one thread of a CPU: cutting them over threads takes longer than they do.
SHORT_LAUNCH = 1 << 16

#: Nodes of a list that an item of a sweep takes on a CPU.
RUN_NODES = 64

#: Levels with fewer nodes of a colour than this go through one launch of one block of threads on CUDA: two a thread.
COARSE_NODES = 2 * BLOCK_THREADS


def require_tolerance(tolerance: float) -> float:
    """The tolerance of a harmonic solver, 2e-6 to 0.1, as a float."""
    return checked_number(tolerance, "tolerance", MIN_TOLERANCE, 0.1)


class HarmonicSolver(MapSolver):
    """Harmonic functions inside a cage, with values on it that are linear on each triangle.
    tolerance: bound aimed at for the error of the discrete equations' solution, in units of the boundary values."""

    # The rows of kernels/lattice/cut_rows.py are solved by V(2, 2) cycles. The residual is the larger of 8 times the
    # largest residual over its row's diagonal and a quarter of the last coarse correction: smooth errors hide from
    # residuals, they leave 1 / n^2 of their size there. Parts thinner than a cell take values from the cage's surface.

    def __init__(self, lattice: CageLattice, *, tolerance: float = 1e-5):
        super().__init__(lattice, LatticeNodes(lattice))
        self.tolerance = require_tolerance(tolerance)
        self._table = CutRowTable(lattice.buffers)
        self._sources = lattice.buffers.buffer(wp.vec3)
        self._loads = lattice.buffers.buffer(wp.vec3)
        self._adjoint = self.slopes.buffer(wp.vec3)
        self._going = wp.zeros(1, dtype=wp.int32, device=self.device)
        self._largest = empty_array(LARGEST_SLOTS, wp.vec2, self.device)
        self._system = LaplaceSystem()
        # of one cycle of each system, with what it has room for and the generation of its buffers
        self._graphs: dict[int, tuple[wp.Graph, NodeSections, int]] = {}

    def launch_layout(self, sizes: PoseSizes) -> PoseSizes:
        """Launch all that does not depend on the boundary values, with the table of cut rows; see MapSolver."""
        sizes = super().launch_layout(sizes)
        self.rows = self._table.describe(self.lattice, self.nodes.levels, sizes.lists)
        system = self._system = LaplaceSystem()
        system.levels, system.rows = self.nodes.levels, self.rows
        system.sources = self._sources.take(sizes.lists.cut)
        system.loads = self._loads.take(sizes.coarse_nodes)
        system.values = self._values.take(sizes.level_nodes)
        return sizes

    def launch_solution(self, sizes: PoseSizes, target: MapTarget) -> None:
        """Launch a whole solution of cleared values, whose cycles end on the device; see MapSolver."""
        sections, values = sizes.lists, self._system.values
        self._launch_inside(sections, target.vertex_values)
        with self.lattice.side.fork():  # it does not look at the rings
            self.gaps.search(self.lattice, self.nodes.levels, self.rows, sections, values)
        self.continue_map(sections, target.vertex_values)
        self.lattice.side.join()

    def launch_continuation(self, sizes: PoseSizes, vertex_values: wp.array) -> None:
        """Launch what continues the values to the rings, and the search for gaps; see MapSolver."""
        self.continue_map(sizes.lists, vertex_values)
        self.gaps.search(self.lattice, self.nodes.levels, self.rows, sizes.lists, self._system.values)

    def weigh(self) -> list[WeightBlock]:
        """The weights (m, v) of all inside nodes in one block; three vertices take one solution."""
        count = self.nodes.sections.finest_inside
        weights = empty_array((count, self.lattice.cage.own_count), wp.float32, self.device)
        for column, _ in self.solve_vertices():
            self._launch(store_weights, count, [0, column, self.nodes.levels, self.values, weights])
        return [(0, weights, None)]

    def solve_vertices(self, progress: bool | Progress = False) -> Iterator[tuple[int, wp.array]]:
        """Solve for the weights of all cage vertices at inside nodes, three at a time; yields the index of the first
        and their boundary values (v,) vec3. Afterwards cycles and residual are the largest of all."""
        count, operator = self.lattice.cage.own_count, self.lattice.cage.operator
        selected = empty_array(self.lattice.vertices.size, wp.vec3, self.device)
        cycles, residual = 0, 0.0
        for column in range(0, count, 3):
            report_progress(progress, column, count, "harmonic weights")
            if operator is None:
                self._launch(select_vertices, count, [column, selected])
            else:
                selected.assign(operator @ np.eye(count, 3, -column, dtype=np.float32))
            self.solve_inside(selected)
            cycles, residual = max(cycles, self.cycles), max(residual, self.residual)
            yield column, selected
        self.cycles, self.residual = cycles, residual

    def solve_inside(self, vertex_values: wp.array) -> None:
        """Solve for the cage's vertex values (v,) vec3 at the inside nodes of the last pose; other nodes are zero."""
        sizes = self.sizes
        self.clear(sizes)
        self._launch_inside(sizes.lists, vertex_values)
        self.take_status(self.status.numpy())

    def take_status(self, status: np.ndarray) -> None:
        """Note the cycles taken and the residual; warn where it is above the tolerance at the end."""
        super().take_status(status)
        if self.cycles == MAX_CYCLES and self.residual > self.tolerance:
            warn_caller(
                f"the harmonic deformation is off by about {self.residual:.1e} of the cage's size (asked for: "
                f"{self.tolerance:.1e}): the cage may cross itself, or be too thin for a lattice of this resolution"
            )

    def continue_map(self, sections: NodeSections, vertex_values: wp.array) -> None:
        """Launch what continues the values at inside nodes to the rings (kernels/lattice/rings.py)."""
        continue_to_rings(self.lattice, self.nodes.levels, self.rows, sections, vertex_values, self._system.values)

    def _launch_inside(self, sections: NodeSections, vertex_values: wp.array) -> None:
        """Launch a solution of cleared values at inside nodes."""
        system = self._system
        inputs = [system.levels, system.rows, self.lattice.faces, vertex_values, system.sources]
        self._launch(set_sources, sections.cut, inputs)
        self._launch(begin_cycles, self._largest.size, [self._going, self.status, self._largest])
        self._sweep(relax_laplace, sections.evaluated, [0, 0, system])
        wp.capture_while(self._going, self.cycle_runner(sections))

    def launch_adjoint(self, sums: CornerSums, targets: wp.array, slopes: wp.array, by_crossings: WarpStruct) -> None:
        """Launch the adjoint solution; see MapSolver. The matrix of the rows is symmetric: the same cycles solve it."""
        sizes, solved = self.sizes, self._system
        system = LaplaceSystem()
        system.levels, system.rows, system.sources = solved.levels, solved.rows, solved.sources
        system.loads, system.values, system.is_loaded = slopes, self._adjoint.take(sizes.level_nodes), 1
        system.values.zero_()
        self._system = system
        try:
            self._sweep(relax_laplace, sizes.lists.evaluated, [0, 0, system])
            run = self.cycle_runner(sizes.lists)
            for _ in range(max(self.cycles, MIN_ADJOINT_CYCLES)):  # each gains the same, whatever the loads
                run()
        finally:
            self._system = solved
        self._sum_crossings(sums, targets, system.values, by_crossings)

    def cycle_runner(self, sections: NodeSections) -> Callable[[], None]:
        """A callable that runs one cycle: its launches on the CPU and in a capture, else the replay of one graph."""
        if self.device.is_cpu or self.device.is_capturing:
            return lambda: self.launch_cycle(sections)
        which, generation = self._system.is_loaded, self.lattice.buffers.generation + self.slopes.generation
        graph, held, made = self._graphs.get(which, (None, None, 0))
        if graph is None or held is None or made != generation or not sections.fits(held):
            # launches somewhat longer than the lists, so that the graph serves other poses of the cage as well
            held = sections.roomier()
            load_modules([harmonic_kernels, harmonic_coarse], self.device)
            with captured(self.device) as capture:
                self.launch_cycle(held)
            graph = capture.graph
            assert graph is not None
            self._graphs[which] = graph, held, generation
        return functools.partial(wp.capture_launch, graph)

    def launch_cycle(self, sections: NodeSections) -> None:
        """Launch a V-cycle and what judges it; the half sweep that it begins with was done by the one before."""
        system, inside = self._system, sections.inside
        few = SHORT_LAUNCH if self.device.is_cpu else COARSE_NODES
        coarse = len(inside) - 1
        while coarse > 1 and inside[coarse - 1].max() < few:
            coarse -= 1
        for level in range(coarse):
            self._relax(level, 1, 2 * SWEEPS - 1, inside)
            self._sweep(leave_residual, int(inside[level, 0]), [level, system])
            self._sweep(restrict_residual, int(inside[level + 1].sum()), [level + 1, system])
        self._cycle_coarse(coarse)
        for level in reversed(range(coarse)):
            if level:
                self._sweep(prolong_correction, int(inside[level, 1]), [level, system])
            else:
                self._measure(prolong_and_measure, int(inside[0, 1]))
            self._relax(level, 0, 2 * SWEEPS, inside)
        self._measure(relax_and_measure, int(inside[0, 0]))
        inputs = [ERROR_PER_RESIDUAL, ERROR_PER_CORRECTION, self.tolerance, MAX_CYCLES, self._largest]
        self._launch(judge_cycle, lane_count(self.device), [*inputs, self._going, self.status])

    def _cycle_coarse(self, level: int) -> None:
        """Launch the levels from `level` on as one block of threads."""
        threads = 1 if self.device.is_cpu else BLOCK_THREADS
        inputs = [0, level, SWEEPS, COARSEST_SWEEPS, threads, self._system]
        require_loaded(cycle_coarse_levels, self.device, BLOCK_THREADS)
        launch_off_tape(cycle_coarse_levels, threads, inputs, device=self.device, block_dim=BLOCK_THREADS)

    def _relax(self, level: int, color: int, half_sweeps: int, inside: np.ndarray) -> None:
        """Launch half sweeps, the colours in turn."""
        for half in range(half_sweeps):
            at = (color + half) % 2
            self._sweep(relax_laplace, int(inside[level, at]), [level, at, self._system])

    def _measure(self, kernel, count: int) -> None:
        """Launch a kernel that raises the largest changes; on a CPU one item per slot, as slots must not be
        shared."""
        lanes = lane_count(self.device)
        items = LARGEST_SLOTS if self.device.is_cpu else -(-count // lanes) * lanes
        threads = 1 if count < SHORT_LAUNCH else None
        inputs = [-(-count // max(items, 1)), self._system, self._largest]
        launch(kernel, items, inputs, device=self.device, threads=threads)

    def _sweep(self, kernel, count: int, inputs) -> None:
        """Launch a kernel whose items are runs of nodes, single ones on CUDA."""
        span = RUN_NODES if self.device.is_cpu else 1
        threads = 1 if count < SHORT_LAUNCH else None
        launch(kernel, -(-count // span), [span, *inputs], device=self.device, threads=threads)

    def _launch(self, kernel, count: int, inputs) -> None:
        launch(kernel, count, inputs, device=self.device)
