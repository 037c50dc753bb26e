"""Tables of a posed scene that marches read."""

from __future__ import annotations

import functools
import math
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import warp as wp

from ..core.arrays import array_view, empty_array, struct_array
from ..core.devices import RecordedLaunches, lane_count
from ..edits.falloff import has_sides
from ..kernels.edits.cell_tables import join_cell_tables, join_nodes
from ..kernels.edits.fine_cells import FINE_COUNT, FINE_SIDE, FINE_UINTS, mark_fine_cells, spread_fine_cells
from ..kernels.edits.nodes import CELL_VEC4S, expand_map_cells
from ..kernels.edits.structs import CELL_OUTSIDE, EditData
from ..lattice.buffers import Buffer, BufferPool, SideStream, StreamOrder
from ..lattice.sizes import FINE_NODES
from .plan import FramePlan

#: Cells narrower than this, in voxels, are not divided: fine cells would be smaller than what they skip.
MIN_VOXELS = 2.0

#: FINE_SIDE is two to the power of this.
FINE_BITS = int(FINE_SIDE).bit_length() - 1

#: Lattices of more nodes have more fine cells than an index counts.
MAX_NODES = (1 << 31) // int(FINE_COUNT) - 64


#: Nodes that tables have room for, in those of the first pose, up to FINE_NODES: most poses have no more, and a memory
#: pool that grows keeps a frame waiting for 6 ms.
NODE_ROOM = 2

#: The buffers of each CUDA device, while tables use them.
_shared_buffers: weakref.WeakValueDictionary[int, CellBuffers] = weakref.WeakValueDictionary()


class CellBuffers:
    """Buffers for the largest tables of edits' cells. Tables take turns: those of the scene that was drawn last have
    them, and others are filled again, in less than a millisecond."""

    def __init__(self, device: wp.Device):
        self._pool, self._order = BufferPool(device), StreamOrder(device)
        self._buffers: dict[tuple[type, int], Buffer] = {}
        self._user: weakref.ref[EditTables] | None = None

    @staticmethod
    def of(device: wp.Device) -> CellBuffers:
        """Those of a CUDA device; new ones on a CPU, where threads draw their scenes at once."""
        return CellBuffers(device) if device.is_cpu else _shared_buffers.setdefault(device.ordinal, CellBuffers(device))

    def give(self, user: EditTables) -> None:
        """Let tables have the buffers, behind what was launched for those that had them, which lose theirs."""
        self._order.follow()
        last = None if self._user is None else self._user()
        if last is not user:
            if last is not None:
                last.lose_cells()
            self._user = weakref.ref(user)

    def take(self, dtype: type, number: int, each: int, nodes: int) -> wp.array:
        """(each * nodes,) items of a type for the edit of a number; see `Buffer.take`."""
        key = dtype, number
        if key not in self._buffers:
            self._buffers[key] = self._pool.buffer(dtype)
            self._buffers[key].take(each * min(NODE_ROOM * nodes, max(nodes, FINE_NODES)))
        return self._buffers[key].take(each * nodes)


class FineCells:
    """Which fine cells of posed lattices may be skipped, found on the stream `side`."""

    def __init__(self, buffers: CellBuffers, side: SideStream):
        self._device, self._lanes = side.device, lane_count(side.device)
        self._buffers, self._side, self._launch = buffers, side, RecordedLaunches(side.device)

    def begin(self, edits: Sequence[Any], grid: Any, step: float) -> None:
        """Divide the marked cells of posed EditData into fine cells, on the side stream.
        step: the longest of a march, world units."""
        width, take = max(grid.voxel_size), self._buffers.take
        held = [
            (edit, take(wp.uint32, number, int(FINE_UINTS), edit.look.size), take(wp.uint64, number, 1, edit.look.size))
            for number, edit in enumerate(edits)
            if edit.spacing >= MIN_VOXELS * width and edit.look.size <= MAX_NODES
        ]
        self._side.mark()  # behind the allocations, and the tables of cells
        stream = self._side.behind_mark()
        for number, (edit, fine_looks, looks) in enumerate(held):
            self._mark(edit, grid, step, fine_looks, looks, {"number": number, "stream": stream})

    def _mark(
        self, edit: Any, grid: Any, step: float, fine_looks: wp.array, looks: wp.array, options: dict[str, Any]
    ) -> None:
        """Launch the kernels of one edit; options: of the launches."""
        nodes = looks.size
        fine_look = array_view(fine_looks, wp.uint8, int(FINE_COUNT) * nodes)
        groups = -(-nodes // max(1, self._lanes // 4))  # an octet of cells for a group of lanes
        work = int(FINE_COUNT) / self._lanes
        self._launch(
            mark_fine_cells, self._lanes * groups, [grid, edit, step], [looks, fine_look], work=work, **options
        )
        whole_groups = -(-nodes // self._lanes) * self._lanes
        self._launch(spread_fine_cells, whole_groups, [edit, looks], [fine_looks], **options)
        set_fine_cells(edit, FINE_BITS, fine_look)


def set_fine_cells(edit: Any, bits: int, fine_look: wp.array) -> None:
    """Set the fine cells of an EditData, 2^bits along each side of a cell; fine_look: (8^bits * nodes,) uint8."""
    edit.fine_bits, edit.fine_look, side = bits, fine_look, 1 << bits
    edit.last_fine = wp.vec3i(*(side * (count - 1) - 1 for count in edit.node_counts))
    edit.fine_width, edit.fine_size = 1.0 / side, edit.spacing / side
    edit.inverse_fine_size = edit.inverse_spacing * side


def edit_data(edit: Any, look: Buffer, nodes: Buffer) -> Any:
    """The EditData of a posed LatticeEdit, perhaps without the sides of narrow gaps, its arrays still to be filled.
    look: of uint8, for the table of cells; nodes: of vec4. `set_sides` and `join_tables` come after."""
    node_count = edit.deformed.distance.size
    flat = EditData()
    flat.lower, flat.inverse_spacing = edit.deformed.lower, edit.deformed.inverse_spacing
    flat.spacing = 1.0 / edit.deformed.inverse_spacing
    flat.node_counts = wp.vec3i(*edit.deformed.distance.shape)
    flat.look, flat.nodes = look.take(node_count), nodes.take(node_count)
    flat.rest = edit.rest
    flat.tolerance, flat.slack = edit.tolerance, edit.slack
    flat.keeps_source, flat.removes, flat.fragments = edit.keeps_source, edit.removes, edit.fragments
    leave_out_cells(flat)
    flat.all_outside = int(CELL_OUTSIDE) if edit.removes else 0
    flat.carried_below = -math.inf if edit.removes else 0.0
    return flat


def leave_out_cells(flat: Any) -> None:
    """Let an EditData have no fine cells and polynomials, until there are some."""
    set_fine_cells(flat, 0, flat.look)
    flat.polynomials, flat.by_nodes = empty_array(0, wp.vec4, flat.look.device), int(not flat.removes)


def set_sides(flat: Any, edit: Any) -> None:
    """Set the sides of narrow gaps of an EditData, from its posed LatticeEdit."""
    flat.has_sides = int(has_sides(edit.deformed))
    if flat.has_sides:
        flat.side_index, flat.sides = edit.deformed.side_index, edit.deformed.sides


def join_tables(flat: Any, edit: Any, skip: wp.array, launch: Callable[..., None]) -> None:
    """Launch what fills the arrays of an EditData, of a posed LatticeEdit, by RecordedLaunches.
    skip: (nx-1, ny-1, nz-1) uint8, how far each cell is from the nearest that may hold anything."""
    count = flat.nodes.size
    launch(join_cell_tables, count, [edit.cells, skip, flat.node_counts], [flat.look])
    positions = empty_array(0, wp.vec3, skip.device) if edit.removes else edit.deformed.positions.flatten()
    launch(join_nodes, count, [positions, edit.deformed.distance.flatten()], [flat.nodes])


def lattice_box(flat: Any) -> list[list[float]]:
    """Lower and upper corner, (3,) each, of an EditData's lattice, relative to the edits' origin."""
    lower, counts, spacing = tuple(flat.lower), tuple(flat.node_counts), 1.0 / flat.inverse_spacing
    return [list(lower), [low + (count - 1) * spacing for low, count in zip(lower, counts, strict=True)]]


#: An array has fewer entries along an axis.
MAX_ENTRIES = 1 << 31

#: Share of a GPU's memory that the polynomials of a lattice's cells may take.
MAX_POLYNOMIALS = 1 / 16


class MapPolynomials:
    """The map of each cell of posed lattices as a polynomial."""

    def __init__(self, buffers: CellBuffers, device: wp.Device):
        self._max_bytes = math.inf if device.is_cpu else MAX_POLYNOMIALS * device.total_memory
        self._buffers, self._launch = buffers, RecordedLaunches(device)

    def expand(self, edits: Sequence[Any]) -> None:
        """Give posed EditData, whose cells are marked, their `polynomials`, where they map anything and there is
        memory."""
        for number, edit in enumerate(edits):
            count = int(CELL_VEC4S) * edit.look.size
            size = wp.types.type_size_in_bytes(wp.vec4) * count
            if not edit.removes and count < MAX_ENTRIES and size <= self._max_bytes:
                inputs = [edit.nodes, edit.look, edit.node_counts]
                polynomials = self._buffers.take(wp.vec4, number, int(CELL_VEC4S), edit.look.size)
                self._launch(expand_map_cells, edit.look.size, inputs, [polynomials], number=number)
                edit.polynomials, edit.by_nodes = polynomials, 0


def needs_general_map(edit: Any) -> bool:
    """Whether an EditData has corner values for each side of narrow gaps, or no polynomials: the faster march takes
    polynomials only."""
    return bool(edit.has_sides or edit.by_nodes)


class EditTables:
    """The EditData of posed edits with all their tables, which are filled beside each other on two streams."""

    def __init__(self, edit_count: int, device: wp.Device):
        self.edits: list[Any] = []  # in their order, once `fill` was called for a pose
        self.lattice_boxes: list[list[list[float]]] = []  # of each, see `lattice_box`
        self._laid: list[tuple[Any, Any]] = []  # each LatticeEdit and its EditData, once for a pose
        self.general_maps: tuple[bool, ...] = ()  # of each, see `needs_general_map`
        self.has_gaps, self.most_nodes = False, 0  # narrow gaps of any; nodes of the largest lattice
        self._stack: wp.array | None = None
        self._has_cells = False
        pool = BufferPool(device)
        self._buffers = [(pool.buffer(wp.uint8), pool.buffer(wp.vec4)) for _ in range(edit_count)]
        self._side, self._join = SideStream(device, priority=-1), RecordedLaunches(device)
        cells = self._cells = CellBuffers.of(device)
        self._fine, self._polynomials = FineCells(cells, self._side), MapPolynomials(cells, device)

    def clear(self) -> None:
        """Forget the pose."""
        self.edits, self._laid, self._stack = [], [], None

    def lay_out(self, posed: Sequence[tuple[Any, wp.array]]) -> None:
        """Make the EditData of a pose, their tables still to be filled. posed: of EditLattices."""
        held = zip((edit for edit, _ in posed), self._buffers, strict=True)
        self._laid = [(edit, edit_data(edit, look, nodes)) for edit, (look, nodes) in held]

    def fill(self, posed: Sequence[tuple[Any, wp.array]]) -> None:
        """Launch what fills the tables of cells and nodes, by what `mark_empty` found. posed: of EditLattices."""
        self.edits, self._stack, self._has_cells = [], None, False  # an interrupt leaves none
        if [id(edit) for edit, _ in posed] != [id(edit) for edit, _ in self._laid]:
            self.lay_out(posed)
        laid, self._laid = self._laid, []
        for number, ((edit, skip), (_, data)) in enumerate(zip(posed, laid, strict=True)):
            set_sides(data, edit)
            join_tables(data, edit, skip, functools.partial(self._join, number=number))
        self.lattice_boxes = [lattice_box(data) for _, data in laid]
        self.has_gaps = any(data.has_sides for _, data in laid)
        self.most_nodes = max(data.nodes.size for _, data in laid)
        self.edits = [data for _, data in laid]
        self._set_general_maps()

    def stack(self) -> wp.array:
        """(edits,) EditData, as the kernel for several edits takes them."""
        if self._stack is None:
            self._stack = struct_array(self.edits, EditData, self._side.device)
        return self._stack

    def _set_general_maps(self) -> None:
        self.general_maps = tuple([needs_general_map(edit) for edit in self.edits])

    def begin_cells(self, plan: FramePlan, grid: Any, step: float) -> bool:
        """Launch the tables of fine cells and the polynomials of cells, where the march reads them. Returns whether
        they are new: they are ready after `join`. step: the longest of a march, world units."""
        if plan.lanes == "tile" or not plan.edits:
            return False
        self._cells.give(self)
        if self._has_cells:
            return False
        self._fine.begin(self.edits, grid, step)
        self._polynomials.expand(self.edits)  # on the program's stream, which has less to do meanwhile
        return True

    def lose_cells(self) -> None:
        """Forget what `begin_cells` launched: other tables have its buffers."""
        for edit in self.edits:
            leave_out_cells(edit)
        self._stack, self._has_cells = None, False
        self._set_general_maps()

    def join(self) -> None:
        """Let what follows wait for the tables that `begin_cells` launched."""
        self._side.join()
        self._has_cells = True
        self._set_general_maps()
