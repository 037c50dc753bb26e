"""The numbers of items that a pose launches: exact, or upper bounds that other poses fit as well."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..kernels.lattice.nodes import RINGS

#: Lattices with fewer nodes have small buffers, and idle threads of their launches take no time.
FINE_NODES = 1 << 22


@dataclass(frozen=True)
class RoomShares:
    """Room that launches and lists have over the current pose, as shares of it: they serve other poses as well."""

    nodes: float  # of all nodes, up to those of a cube: a rod has four times as many once it is turned by 45 degrees
    inside: float  # of those in the cage
    surface: float  # of those at the cage


#: Room for poses of about the same size, and for most poses.
NARROW_ROOM, WIDE_ROOM = RoomShares(0.125, 0.125, 0.125), RoomShares(3.0, 1.5, 0.75)


@dataclass(frozen=True, eq=False)
class NodeSections:
    """Lengths (3 L + RINGS,) int64 of the sections of a list of nodes on L levels, in the list's order, by name.
    See kernels/lattice/nodes.py."""

    lengths: np.ndarray

    @property
    def level_count(self) -> int:
        """L."""
        return (len(self.lengths) - int(RINGS)) // 3

    @property
    def inside(self) -> np.ndarray:
        """(L, 2) inside nodes: red and black, or evaluated and interpolated."""
        return self.lengths[: 2 * self.level_count].reshape(-1, 2)

    @property
    def evaluated(self) -> int:
        """Inside nodes of level 0 that are evaluated rather than interpolated: the first of the list."""
        return int(self.lengths[0])

    @property
    def interpolated(self) -> int:
        """Inside nodes of level 0 that are interpolated; they come after the evaluated ones."""
        return int(self.lengths[1])

    @property
    def finest_inside(self) -> int:
        """Inside nodes of level 0: the list begins with them."""
        return int(self.lengths[:2].sum())

    @property
    def cut(self) -> int:
        """Cut nodes of level 0."""
        return int(self.lengths[2 * self.level_count])

    @property
    def all_cut(self) -> int:
        """Cut nodes of all levels."""
        return int(self.lengths[2 * self.level_count : 3 * self.level_count].sum())

    @property
    def near_rings(self) -> int:
        """Nodes of rings 0 and 1."""
        return self.ring(0) + self.ring(1)

    def ring(self, ring: int) -> int:
        """Nodes of ring 0, 1 or 2."""
        return int(self.lengths[3 * self.level_count + ring])

    @property
    def total(self) -> int:
        """Nodes in the list."""
        return int(self.lengths.sum())

    def fits(self, room: NodeSections) -> bool:
        """Whether no section is longer than that of `room`."""
        return bool((self.lengths <= room.lengths).all())

    def roomier(self, room: RoomShares = NARROW_ROOM) -> NodeSections:
        """Lengths for launches and lists that serve other poses of the same cage as well."""
        shares = np.full(len(self.lengths), room.surface)
        shares[: 2 * self.level_count] = room.inside
        lengths = self.lengths + (shares * self.lengths).astype(np.int64) + 32
        # faces along the axes have rings 1 and 2 at their edges alone; once they are turned, as many nodes as in ring 0
        rings = lengths[-int(RINGS) :]
        rings[:] = np.maximum(rings, rings[0])
        return NodeSections(lengths)

    def larger(self, other: NodeSections) -> NodeSections:
        """The larger of two lengths of each section."""
        return NodeSections(np.maximum(self.lengths, other.lengths))


@dataclass(frozen=True, eq=False)
class PoseSizes:
    """What the launches of a pose count, on the finest level of a lattice unless a name says otherwise."""

    nodes: int
    lines: int  # lattice lines, and runs of neighbouring ones that are crossed with the cage together
    runs: int
    blocks: int  # blocks of nodes, and groups of blocks that faces are looked through for
    groups: int
    columns: int
    level_nodes: int  # nodes of all levels that a solver uses, and those above the finest
    coarse_nodes: int
    level_columns: int  # columns of all levels
    entries: int  # entries to be scanned for the lists
    sections: NodeSections | None = None  # lengths of lists; None: not counted yet, launches that need them wait

    @property
    def lists(self) -> NodeSections:
        """The sections, where they are known."""
        assert self.sections is not None, "the lists of nodes are not counted yet"
        return self.sections

    def counted(self, sections: NodeSections) -> PoseSizes:
        """The same with these lengths of the lists."""
        return replace(self, sections=sections)

    def fits(self, room: PoseSizes) -> bool:
        """Whether launches of `room` do for these sizes; of lists only the device knows."""
        return all(own <= other for own, other in zip(self._counts(), room._counts(), strict=True))

    def roomier(self, most: PoseSizes, held: PoseSizes | None = None) -> PoseSizes:
        """Bounds with more room, and no less than `held` has: poses that take turns fit them.
        most: sizes that hardly any pose has more than, without sections."""
        room = NARROW_ROOM if self.nodes >= FINE_NODES else WIDE_ROOM
        counts = [
            max(count, min(count + int(room.nodes * count), top))
            for count, top in zip(self._counts(), most._counts(), strict=True)
        ]
        sections = self.lists.roomier(room)
        if held is not None:
            counts = [max(pair) for pair in zip(counts, held._counts(), strict=True)]
            sections = sections.larger(held.lists)
        return PoseSizes(*counts, sections=sections)

    def _counts(self) -> tuple[int, ...]:
        return (
            self.nodes,
            self.lines,
            self.runs,
            self.blocks,
            self.groups,
            self.columns,
            self.level_nodes,
            self.coarse_nodes,
            self.level_columns,
            self.entries,
        )
