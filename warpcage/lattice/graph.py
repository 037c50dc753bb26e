"""PoseGraph: all that a pose of a PositionMap does on a GPU, as two CUDA graphs that later poses replay."""

from __future__ import annotations

import functools

import numpy as np
import warp as wp

from ..core.devices import launch
from ..kernels.lattice.rings import add_affine, gather_status
from .capture import roomier


class PoseGraph:
    """The launches of a pose, captured with somewhat more room than the pose at hand needs.

    lattice, solver, rest: of a PositionMap that has just been posed. The first graph uploads the lattice's constants
    and lays it out, with the lists of nodes; the second uploads the map's constants, which the host works out
    meanwhile, solves until the tolerance is met and downloads the outcome. A pose costs the host two launches and one
    wait.

    Attribute: has_gaps, whether the solver flagged nodes at narrow gaps.
    """

    @staticmethod
    def is_supported(device) -> bool:
        """Whether the device can decide in a graph how often a part of it runs (CUDA 12.4)."""
        return device.is_cuda and wp.is_conditional_graph_supported()

    def __init__(self, lattice, solver, rest):
        self.lattice, self.solver, self.rest, self.device = lattice, solver, rest, lattice.device
        # overflow of lines and lists, cycles, residual, nodes at gaps, then the length of each section
        words = 5 + solver.nodes.section_count
        # written by the device where the host reads it
        self._host_status = wp.zeros(words, dtype=float, device="cpu", pinned=self.device.is_cuda)
        self._status = wp.array(ptr=self._host_status.ptr, dtype=float, shape=words, device=self.device)
        self.has_gaps = False
        self._graph = None
        self._lattice_sizes: dict = {}
        self._node_sizes: dict = {}
        self._sections = np.zeros(solver.nodes.section_count, dtype=np.int64)
        self._sides_graph, self._sides_generation, self._sides_room = None, 0, 0
        self._make_room()

    def fits(self) -> bool:
        """Whether the pose that the lattice was laid over has room; a first one that has is captured."""
        lattice, nodes = self.lattice, self.solver.nodes
        if self._graph is None:
            self._make_room()
            self._capture()
        return (
            self._generation == lattice.buffers.generation
            and all(size <= self._lattice_sizes[name] for name, size in lattice.sizes.items())
            and all(size <= self._node_sizes[name] for name, size in nodes.sizes.items())
        )

    def release(self) -> None:
        """Capture anew at the next pose, with room for the one at hand: it had none, or buffers have moved."""
        self._make_room()
        self._graph = self._sides_graph = None

    def begin(self) -> None:
        """Start on the pose that the lattice's constants hold; they stay as they are until `finish`."""
        self._run_lattice()

    def go_on(self) -> None:
        """Go on with what the lattice's map_constants hold."""
        self._run_map()

    def finish(self) -> bool:
        """Wait for the map; False where a list was longer than foreseen."""
        if self.device.is_cuda:
            wp.synchronize_stream(self.device.stream)
        status = self._host_status.numpy()
        if status[0] != 0.0 or status[1] != 0.0:
            return False
        self.solver.take_status(status[2:4])
        self.solver.nodes.take_sections(status[5:].astype(np.int64))
        self.lattice.take_distance()
        self.has_gaps = status[4] > 0.0
        return True

    def find_sides(self, sides) -> bool:
        """Fill the tables of a MapSides for the pose that was finished; False where they must be found step by step."""
        if sides.length == 0:  # nobody knows how long they are
            return False
        if self._sides_graph is None or self._sides_generation != sides.buffers.generation:
            self._sides_room = max(self._sides_room, sides.length + sides.length // 4 + 32)
            launches = functools.partial(self._launch_sides, sides)
            launches()  # once outside, so that all buffers and modules are there
            self._sides_generation = sides.buffers.generation
            self._sides_graph = self._captured(launches) if self.device.is_cuda else launches
        if self.device.is_cuda:
            wp.capture_launch(self._sides_graph)
        else:
            self._sides_graph()
        has_room = sides.take()
        if not has_room:
            self._sides_graph = None
        return has_room

    def _make_room(self) -> None:
        """Have room for the pose at hand, and no less than before: poses that take turns fit the same graph."""
        lattice, nodes = self.lattice, self.solver.nodes
        for held, sizes in ((self._lattice_sizes, lattice.sizes), (self._node_sizes, nodes.sizes)):
            held.update({name: max(held.get(name, 0), size + size // 16) for name, size in sizes.items()})
        self._sections = np.maximum(self._sections, roomier(nodes.sections))

    def _capture(self) -> None:
        lattice, solver, nodes = self.lattice, self.solver, self.solver.nodes
        solver.load_modules()
        wp.load_module(gather_status.module, device=self.device)
        nodes.set_limits(self._sections)
        self._launch()  # once outside, so that all buffers and modules are there
        self._generation = lattice.buffers.generation
        self._graph = self._run_lattice, self._run_map = self._launch_lattice, self._launch_map
        if self.device.is_cuda:
            lattice_graph, map_graph = (self._captured(launches) for launches in self._graph)
            self._run_lattice = functools.partial(wp.capture_launch, lattice_graph)
            self._run_map = functools.partial(wp.capture_launch, map_graph)

    def _captured(self, launches):
        with wp.ScopedCapture(device=self.device) as capture:
            launches()
        return capture.graph

    def _launch(self) -> None:
        self._launch_lattice()
        self._launch_map()

    def _launch_lattice(self) -> None:
        lattice, solver, nodes = self.lattice, self.solver, self.solver.nodes
        lattice.constants.send()
        with lattice.side.fork():
            solver.clear(self._node_sizes)
        lattice.launch_geometry(self._lattice_sizes)
        nodes.launch_classes(self._node_sizes)
        nodes.launch_lists(self._node_sizes, int(self._sections.sum()))
        solver.launch_rows(self._node_sizes, self._sections)

    def _launch_sides(self, sides) -> None:
        columns = self._node_sizes["columns"]  # of all levels
        sides.launch(self._lattice_sizes["nodes"], columns, self._sections, self._sides_room)

    def _launch_map(self) -> None:
        lattice, solver, nodes = self.lattice, self.solver, self.solver.nodes
        arrays = lattice.map_constants.arrays
        lattice.map_constants.send()
        face_values = solver.face_values(self.rest, arrays["affine"])
        solver.launch_solution(self._node_sizes, self._sections, arrays["vertex_values"], face_values)
        with lattice.side.fork():
            inputs = [lattice.overflow, nodes.overflow, solver.status, solver.gaps.count, nodes.narrow, nodes.levels]
            launch(gather_status, self._status.size, inputs, [self._status], device=self.device)
        values = lattice.buffers.get("values", self._node_sizes["nodes"], wp.vec3)
        inputs = [nodes.levels, self.rest.size, arrays["affine"]]
        launch(add_affine, self._lattice_sizes["nodes"], inputs, [values], device=self.device)
        lattice.side.join()
