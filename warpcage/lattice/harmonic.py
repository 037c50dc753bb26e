"""HarmonicSolver: the Laplace equation inside a cage, by multigrid on the nodes of a lattice."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..core.checks import warn_caller
from ..core.devices import lane_count, launch
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
from .capture import roomier
from .gaps import GapFlags, launch_linear_boundary
from .nodes import LatticeNodes
from .rings import described_rows, launch_rings

SWEEPS = 2  # before and after the coarse correction: V(2, 2)
COARSEST_SWEEPS = 8
MAX_CYCLES = 40

#: Tolerances below the rounding of float32 would never be met.
MIN_TOLERANCE = 2e-6

#: What is left after a cycle, seen from the largest correction of that cycle and from the largest scaled residual: a
#: cycle gains a factor of about ten, and errors that its smoothing leaves are a few times their row's update.
ERROR_PER_CORRECTION, ERROR_PER_RESIDUAL = 0.25, 8.0

#: Slots that the largest residuals are gathered in.
LARGEST_SLOTS = 64

#: Sweeps over fewer nodes than this run on one thread of a CPU: cutting them over threads takes longer than they do.
SHORT_LAUNCH = 1 << 16

#: Levels with fewer nodes of a colour than this go through one launch of one block of threads on CUDA: two a thread.
COARSE_NODES = 2 * BLOCK_THREADS


def require_tolerance(tolerance) -> float:
    """`tolerance` as a float. Raises ValueError outside 2e-6 .. 0.1."""
    if not isinstance(tolerance, int | float | np.floating) or not MIN_TOLERANCE <= tolerance <= 0.1:
        raise ValueError(f"tolerance must be {MIN_TOLERANCE:g} to 0.1 of the cage's size, got {tolerance!r}")
    return float(tolerance)


class HarmonicSolver:
    """Harmonic functions inside a cage, with values on it that are linear on each triangle.

    lattice: CageLattice. tolerance: bound aimed at for the error of the solution of the discrete equations, in units of
    the boundary values. The rows of kernels/lattice/cut_rows.py are solved by V(2, 2) cycles
    (kernels/lattice/harmonic.py); on CUDA a cycle is one graph, kept for later poses as long as the buffers serve them.

    Attributes: cycles, multigrid cycles of the last solve; residual, what was left by it: the larger of 8 times the
    largest residual over its row's diagonal and a quarter of the last coarse correction, both in units of the values.
    The second is there because smooth errors hide from residuals: they leave 1 / n^2 of their size there.

    References: Joshi, Meyer, DeRose, Green and Sanocki 2007; Gibou, Fedkiw, Cheng and Kang 2002.
    Limitations: float32; parts of the cage thinner than a cell have no inside nodes and take values from its surface.
    """

    def __init__(self, lattice, *, tolerance: float = 1e-5):
        self.lattice, self.device = lattice, lattice.device
        self.tolerance = require_tolerance(tolerance)
        self.nodes = LatticeNodes(lattice)
        self.cycles, self.residual = 0, 0.0
        self.going = wp.zeros(1, dtype=int, device=self.device)
        self.status = wp.zeros(2, dtype=float, device=self.device)  # cycles, residual
        self.gaps = GapFlags(self)
        self.corrections = wp.empty(0, dtype=wp.vec3, device=self.device)  # none
        self._graph, self._graph_key, self._graph_sections = None, None, None
        self.launch_rows(self.nodes.sizes, self.nodes.sections)

    def prepare(self) -> None:
        """Set up for the pose that the lattice was filled with."""
        self.nodes.fill()
        self.launch_rows(self.nodes.sizes, self.nodes.sections)

    @property
    def values(self) -> wp.array:
        """(nodes of level 0,) vec3, flat: the last solution."""
        return self.system.values[: self.lattice.node_count]

    def solve(self, vertex_values: wp.array, face_values=None) -> None:
        """Solve for boundary values vertex_values (v,) vec3 at the cage's vertices; then continue to the outside rings.

        face_values is not used: harmonic maps have none. Warns where the tolerance was not met in 40 cycles.
        """
        self.solve_inside(vertex_values)
        self.extend(vertex_values)
        self.find_gaps(self.nodes.sections)

    def solve_inside(self, vertex_values: wp.array) -> None:
        """The same for inside nodes only; other nodes are zero."""
        sections = self.nodes.sections
        self.clear(self.nodes.sizes)
        self._launch_start(sections, vertex_values)
        run_cycle = self._cycle_runner(sections)
        going = True
        while going:
            run_cycle()
            self.take_status(self.status.numpy())
            going = self.residual > self.tolerance and self.cycles < MAX_CYCLES

    def take_status(self, status: np.ndarray) -> None:
        """Note the cycles taken and the residual; warn where it is above the tolerance at the end."""
        self.cycles, self.residual = int(status[0]), float(status[1])
        if self.cycles == MAX_CYCLES and self.residual > self.tolerance:
            warn_caller(
                f"harmonic map: {self.residual:.1e} of the size left after {MAX_CYCLES} cycles, above the tolerance "
                f"{self.tolerance:.1e}: the cage may cross itself or be too thin for its resolution"
            )

    def extend(self, vertex_values: wp.array) -> None:
        """Continue the values at inside nodes to the rings of outside nodes around them (kernels/lattice/rings.py)."""
        launch_rings(self, self.nodes.sections, vertex_values, self.system.values)

    def find_gaps(self, sections: np.ndarray) -> None:
        """Launch the search for narrow gaps."""
        self.gaps.search(sections, self.rows, self.system.values)

    def face_values(self, rest, affine: wp.array):
        """Nothing: harmonic maps have values at vertices only."""
        return None

    def launch_boundary(self, cut_count: int, vertex_values: wp.array, face_values, buffers, boundary) -> None:
        """Launch the map's remainder (rows of level 0, 6) where links cross the cage."""
        launch_linear_boundary(self, cut_count, vertex_values, boundary)

    def clear(self, sizes: dict) -> None:
        """Launch what clears the values and the count of gaps, before a solution."""
        self.gaps.count.zero_()
        self.lattice.buffers.get("values", sizes["nodes"], wp.vec3).zero_()

    def launch_solution(self, sizes: dict, sections: np.ndarray, vertex_values: wp.array, face_values) -> None:
        """Launch a whole solution of cleared values, for a CUDA graph: the cycles end on the device. sections: upper
        bounds."""
        self._launch_start(sections, vertex_values)
        wp.capture_while(self.going, lambda: self._cycle(sections))
        with self.lattice.side.fork():  # it does not look at the rings
            self.gaps.launch(sections, self.rows, self.system.values)
        launch_rings(self, sections, vertex_values, self.system.values)
        self.lattice.side.join()

    def launch_rows(self, sizes: dict, sections: np.ndarray) -> None:
        """Launch the description of the cut rows. sizes, sections: of this pose, or upper bounds."""
        lattice, nodes, buffers = self.lattice, self.nodes, self.lattice.buffers
        levels = nodes.level_count
        row_count, finest = int(sections[2 * levels : 3 * levels].sum()), int(sections[2 * levels])
        rows = self.rows = described_rows(lattice, nodes, row_count, finest)
        system = self.system = LaplaceSystem()
        system.levels, system.rows = nodes.levels, rows
        system.sources = buffers.get("sources", finest, wp.vec3)
        system.loads = buffers.get("loads", sizes["coarse_nodes"], wp.vec3)
        system.values = buffers.get("values", sizes["nodes"], wp.vec3)
        self._largest = buffers.get("largest", LARGEST_SLOTS, wp.vec2)

    def _launch_start(self, sections: np.ndarray, vertex_values: wp.array) -> None:
        system, nodes = self.system, self.nodes
        inputs = [nodes.levels, self.rows, self.lattice.faces, vertex_values, system.sources]
        self._launch(set_sources, int(sections[2 * nodes.level_count]), inputs)
        self._launch(begin_cycles, self._largest.size, [self.going, self.status, self._largest])
        self._sweep(relax_laplace, int(sections[0]), [0, 0, system])

    def _cycle_runner(self, sections: np.ndarray):
        """A callable that runs one cycle: launches on the CPU, the replay of one graph on CUDA."""
        if self.device.is_cpu:
            return lambda: self._cycle(sections)
        held = self._graph_sections
        if self._graph_key != self.lattice.buffers.generation or (sections > held).any():
            # launches somewhat longer than the lists, so that the graph serves other poses of the cage as well
            held = self._graph_sections = roomier(sections)
            self.load_modules()
            with wp.ScopedCapture(device=self.device) as capture:
                self._cycle(held)
            self._graph, self._graph_key = capture.graph, self.lattice.buffers.generation
        return lambda: wp.capture_launch(self._graph)

    def load_modules(self) -> None:
        """Compile what a capture would need."""
        wp.load_module(relax_laplace.module, device=self.device)
        wp.load_module(cycle_coarse_levels.module, device=self.device)

    def _cycle(self, sections: np.ndarray) -> None:
        """Launch a V-cycle and what judges it; the half sweep that it begins with was done by the one before."""
        system, last = self.system, self.nodes.level_count - 1
        inside = sections[: 2 * last + 2].reshape(-1, 2)
        few = SHORT_LAUNCH if self.device.is_cpu else COARSE_NODES
        coarse = last
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
        self._launch(judge_cycle, lane_count(self.device), [*inputs, self.going, self.status])

    def _cycle_coarse(self, level: int) -> None:
        """Launch the levels from `level` on as one block of threads."""
        threads = 1 if self.device.is_cpu else BLOCK_THREADS
        inputs = [0, level, SWEEPS, COARSEST_SWEEPS, threads, self.system]
        wp.launch(cycle_coarse_levels, dim=threads, inputs=inputs, device=self.device, block_dim=BLOCK_THREADS)

    def _relax(self, level: int, colour: int, half_sweeps: int, inside: np.ndarray) -> None:
        """Launch half sweeps, the colours in turn."""
        for half in range(half_sweeps):
            at = (colour + half) % 2
            self._sweep(relax_laplace, int(inside[level, at]), [level, at, self.system])

    def _measure(self, kernel, count: int) -> None:
        """Launch a kernel that raises the largest changes; on a CPU an item a slot, as slots must not be shared."""
        lanes = lane_count(self.device)
        items = LARGEST_SLOTS if self.device.is_cpu else -(-count // lanes) * lanes
        threads = 1 if count < SHORT_LAUNCH else None
        inputs = [-(-count // max(items, 1)), self.system, self._largest]
        launch(kernel, items, inputs, device=self.device, threads=threads)

    def _sweep(self, kernel, count: int, inputs) -> None:
        """Launch a kernel of little work an item."""
        launch(kernel, count, inputs, device=self.device, threads=1 if count < SHORT_LAUNCH else None)

    def _launch(self, kernel, count: int, inputs) -> None:
        launch(kernel, count, inputs, device=self.device)
