"""HarmonicSolver: the Laplace equation inside a cage, by multigrid on the nodes of a lattice."""

from __future__ import annotations

import warnings

import numpy as np
import warp as wp

from .devices import launch
from .kernels.harmonic import (
    LaplaceSystem,
    clear_corrections,
    measure_residual,
    prolong_correction,
    reduce_largest,
    relax_laplace,
    restrict_residual,
)
from .kernels.harmonic_rows import CutRows, describe_rows, set_sources
from .kernels.map_extension import extend_outwards, extend_through_cage, flag_thin_nodes
from .node_levels import LatticeNodes

SWEEPS = 2  # before and after the coarse correction: V(2, 2)
COARSEST_SWEEPS = 8
MAX_CYCLES = 40

#: Tolerances below the rounding of float32 would never be met.
MIN_TOLERANCE = 2e-6

#: What is left after a cycle, seen from the largest correction of that cycle and from the largest scaled residual: a
#: cycle gains a factor of about ten, and errors that its smoothing leaves are a few times their row's update.
ERROR_PER_CORRECTION, ERROR_PER_RESIDUAL = 0.25, 8.0

#: Sweeps over fewer nodes than this run on one thread of a CPU: cutting them over threads takes longer than they do.
SHORT_LAUNCH = 1 << 16


def require_tolerance(tolerance) -> float:
    """`tolerance` as a float. Raises ValueError outside 2e-6 .. 0.1."""
    if not isinstance(tolerance, int | float | np.floating) or not MIN_TOLERANCE <= tolerance <= 0.1:
        raise ValueError(f"tolerance must be {MIN_TOLERANCE:g} to 0.1 of the cage's size, got {tolerance!r}")
    return float(tolerance)


class HarmonicSolver:
    """Harmonic functions inside a cage, with values on it that are linear on each triangle.

    lattice: CageLattice. tolerance: bound aimed at for the error of the solution of the discrete equations, in units of
    the boundary values. The rows of kernels/harmonic_rows.py are solved by V(2, 2) cycles (kernels/harmonic.py); on
    CUDA a cycle is one graph, kept for later poses as long as the buffers serve them.

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
        self._graph, self._graph_key = None, None
        self._lengths: dict = {}
        self._build_rows()

    def prepare(self) -> None:
        """Set up for the pose that the lattice was filled with."""
        self.nodes.fill()
        self._build_rows()

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

    def solve_inside(self, vertex_values: wp.array) -> None:
        """The same for inside nodes only; other nodes are zero."""
        system, nodes = self.system, self.nodes
        system.values.zero_()
        self._launch(
            set_sources,
            int(nodes.counts["cut"][0]),
            [nodes.levels, self.rows, self.lattice.faces, vertex_values, system.sources],
        )
        run_cycle = self._cycle_runner()
        for cycle in range(1, MAX_CYCLES + 1):
            run_cycle()
            row_residual, correction = self._reduced.numpy().max(axis=0)
            self.cycles = cycle
            self.residual = float(max(ERROR_PER_RESIDUAL * row_residual, ERROR_PER_CORRECTION * correction))
            if self.residual <= self.tolerance:
                return
        warnings.warn(
            f"harmonic map: {self.residual:.1e} of the size left after {MAX_CYCLES} cycles, above the tolerance "
            f"{self.tolerance:.1e}: the cage may cross itself or be too thin for its resolution",
            stacklevel=2,
        )

    def extend(self, vertex_values: wp.array) -> None:
        """Continue the values at inside nodes to the rings of outside nodes around them (kernels/map_extension.py)."""
        lattice, levels = self.lattice, self.nodes.levels
        rings = self.nodes.counts["rings"]
        self._launch(
            extend_through_cage,
            int(rings[0]),
            [levels, self.rows, lattice.faces, vertex_values, self.system.values],
        )
        for ring in (1, 2, 3):
            self._launch(
                extend_outwards,
                int(rings[ring]),
                [ring, lattice.vertices, lattice.faces, levels, vertex_values, self.system.values],
            )

    def count_thin_nodes(self) -> int:
        """Nodes at gaps of the cage so narrow that one outside node serves both sides; the map is rough there."""
        count = int(self.nodes.counts["cut"][0] + self.nodes.counts["rings"][0])
        flags = wp.zeros(count, dtype=int, device=self.device)
        self._launch(flag_thin_nodes, count, [self.nodes.levels, self.rows, flags])
        return int(flags.numpy().sum())

    def _build_rows(self) -> None:
        lattice, nodes, buffers = self.lattice, self.nodes, self.lattice.buffers
        row_count, finest = int(nodes.counts["cut"].sum()), int(nodes.counts["cut"][0])
        rows = self.rows = CutRows()
        rows.links = buffers.get("links", row_count, int)
        rows.diagonals = buffers.get("diagonals", row_count, float)
        rows.fractions = buffers.get("fractions", (row_count, 6), float)
        rows.faces = buffers.get("cut_faces", (finest, 6), int)
        rows.corners = buffers.get("cut_corners", (finest, 6), wp.vec3)
        self._launch(
            describe_rows,
            row_count,
            [lattice.crossings, lattice.distance, lattice.vertices, lattice.faces, nodes.levels, rows],
        )
        system = self.system = LaplaceSystem()
        system.levels, system.rows = nodes.levels, rows
        system.sources = buffers.get("sources", finest, wp.vec3)
        system.loads = buffers.get("loads", int(nodes.first_node[-1] - nodes.first_node[1]), wp.vec3)
        system.values = buffers.get("values", int(nodes.first_node[-1]), wp.vec3)
        self._largest = buffers.get("largest", 512 if self.device.is_cpu else 32768, wp.vec2)
        self._reduced = buffers.get("reduced", 64, wp.vec2)

    def _cycle_runner(self):
        """A callable that runs one cycle: launches on the CPU, the replay of one graph on CUDA."""
        counts = self.nodes.counts["inside"]
        corrections = int(self.nodes.first_node[-1] - self.nodes.first_node[1])
        if self.device.is_cpu:
            self._lengths = {"inside": counts, "corrections": corrections}
            return self._cycle
        held = self._lengths
        if not held or (counts > held["inside"]).any() or corrections > held["corrections"]:
            # launches somewhat longer than the lists, so that the graph serves other poses of the cage as well
            self._lengths = {"inside": counts + counts // 8 + 32, "corrections": corrections + corrections // 8}
            self._graph = None
        if self._graph is None or self._graph_key != self.lattice.buffers.generation:
            wp.load_module(relax_laplace.module, device=self.device)
            with wp.ScopedCapture(device=self.device) as capture:
                self._cycle()
            self._graph, self._graph_key = capture.graph, self.lattice.buffers.generation
        return lambda: wp.capture_launch(self._graph)

    def _cycle(self) -> None:
        inside, system = self._lengths["inside"], self.system
        last = self.nodes.level_count - 1
        self._sweep(clear_corrections, self._lengths["corrections"], [system])
        for level in range(last):
            self._relax(level, SWEEPS)
            self._sweep(restrict_residual, int(inside[level + 1].sum()), [level + 1, system])
        self._relax(last, COARSEST_SWEEPS)
        for level in reversed(range(last)):
            self._sweep(prolong_correction, int(inside[level, 1]), [level, system])
            self._relax(level, SWEEPS)
        self._launch(measure_residual, self._largest.size, [system, self._largest])
        self._sweep(reduce_largest, self._reduced.size, [self._largest, self._reduced])

    def _relax(self, level: int, sweeps: int) -> None:
        for _ in range(sweeps):
            for colour in (0, 1):
                self._sweep(relax_laplace, int(self._lengths["inside"][level, colour]), [level, colour, self.system])

    def _sweep(self, kernel, count: int, inputs) -> None:
        """Launch a kernel of little work an item."""
        launch(kernel, count, inputs, device=self.device, threads=1 if count < SHORT_LAUNCH else None)

    def _launch(self, kernel, count: int, inputs) -> None:
        launch(kernel, count, inputs, device=self.device)
