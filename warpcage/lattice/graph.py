"""PoseGraph: the launches of a pose of a PositionMap on a GPU, as CUDA graphs that later poses replay."""

from __future__ import annotations

import functools
from collections.abc import Callable

import warp as wp

from ..core.devices import captured
from .launches import PoseLaunches
from .sizes import PoseSizes

Launches = Callable[[], object]

#: Cut nodes for one row of the tables of sides, at least, of most cages with narrow gaps.
DEFAULT_SIDES = 4


class PoseGraph:
    """The launches of a pose, captured with somewhat more room than the current pose needs.
    The first pose of the launches is computed step by step, before."""

    # The first graph uploads the constants, lays the lattice out and lists nodes; the second uploads the map's, which
    # the host works out meanwhile, solves and downloads the outcome: a pose costs the host two launches and one wait.

    @staticmethod
    def is_supported(device: wp.Device) -> bool:
        """Whether the device can decide in a graph how often a part of it runs (CUDA 12.4)."""
        return device.is_cuda and wp.is_conditional_graph_supported()

    def __init__(self, launches: PoseLaunches):
        self._launches, self._solver = launches, launches.solver
        self._device, self._buffers = launches.solver.device, launches.solver.lattice.buffers
        self.has_gaps = False  # whether the last pose has nodes at narrow gaps
        self._room: PoseSizes | None = None
        self._layout: Launches | None = None
        self._map: Launches | None = None
        self._sides: Launches | None = None
        self._generation = self._sides_generation = self._sides_room = 0

    def fits(self, sizes: PoseSizes) -> bool:
        """Whether a pose with these sizes has room and can be replayed; graphs are captured where there are none."""
        if self._layout is None:
            self.capture()
        return self._generation == self._buffers.generation and sizes.fits(self._bounds)

    def release(self) -> None:
        """Capture again at the next pose, with room for the current one, which had none, or whose buffers moved."""
        self._make_room()
        self._layout = self._map = self._sides = None

    def capture_sides(self) -> None:
        """Capture the tables of sides for as many rows as most poses take, before one needs them."""
        self._find_sides()

    @property
    def has_room_for_sides(self) -> bool:
        """Whether there are buffers for the tables of sides that a graph fills."""
        return self._sides is not None

    def begin(self) -> None:
        """Start on the pose that the lattice's constants hold; they stay as they are until `finish`."""
        assert self._layout is not None, "begin comes after fits"
        self._layout()

    def go_on(self) -> None:
        """Go on with what the lattice's map_constants hold."""
        assert self._map is not None, "go_on comes after fits"
        self._map()

    def finish(self) -> bool:
        """Wait for the map; False where a list was longer than foreseen."""
        status = self._launches.wait()
        if status.has_room:
            self._solver.take_status(status.solution)
            self._solver.nodes.sections = status.sections
            self.has_gaps = status.has_gaps
        return status.has_room

    def find_sides(self) -> bool:
        """Fill the tables of sides for the pose that was finished; False where they must be found step by step."""
        self._find_sides()
        has_room = self._launches.sides.take()
        if not has_room:
            self._sides = None
        return has_room

    def _find_sides(self) -> None:
        """Launch what fills the tables of sides, captured where it was not."""
        sides = self._launches.sides
        if self._sides is None or self._sides_generation != sides.buffers.generation:
            usual = self._bounds.lists.cut // DEFAULT_SIDES
            self._sides_room = max(self._sides_room, usual, sides.length + sides.length // 4 + 32)
            launches = functools.partial(self._launches.launch_sides, self._bounds, self._sides_room)
            launches()  # once outside, so that all buffers and modules are there
            self._sides_generation = sides.buffers.generation
            self._sides = self._captured(launches)
        self._sides()

    def launch(self) -> None:
        """Launch a whole pose one by one, with the sizes that the graphs have."""
        self._launches.launch_layout(self._bounds)
        self._launches.launch_map(self._bounds)

    @property
    def _bounds(self) -> PoseSizes:
        assert self._room is not None, "room is made by the first pose"
        return self._room

    def _make_room(self) -> None:
        """Make room for the current pose, and keep that of earlier ones: alternating poses fit the same graph."""
        solver = self._solver
        self._room = solver.sizes.roomier(solver.lattice.most_sizes(solver.nodes.level_count), self._room)

    def capture(self) -> None:
        self._make_room()
        self._solver.nodes.limit(self._bounds.lists)
        self.launch()  # once outside, so that all buffers and modules are there
        self._generation = self._buffers.generation
        self._layout = self._captured(functools.partial(self._launches.launch_layout, self._bounds))
        self._map = self._captured(functools.partial(self._launches.launch_map, self._bounds))

    def _captured(self, launches: Launches) -> Launches:
        """The replay of launches; on the CPU they are launched again."""
        if self._device.is_cpu:
            return launches
        with captured(self._device) as capture:
            launches()
        assert capture.graph is not None
        return functools.partial(wp.capture_launch, capture.graph)
