"""Edits of splats, which are bound to their cages once and carried with each pose."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from ..cage.cage import Cage
from ..core.arrays import empty_array, local_points
from ..core.devices import lane_count, launch
from ..core.reports import Progress
from ..edits.edits import CageEdit
from ..edits.falloff import FalloffBand, set_gap_remedies
from ..kernels.splats import pose, split
from ..kernels.splats import splats as inside
from ..kernels.splats.pose import CarriedSplats
from ..kernels.splats.splats import Splats
from ..lattice.position_map import PositionMap
from ..mesh.queries import SURFACE_TOLERANCE
from ..mesh.validity import require_usable
from ..splats.binding import RESOLUTION, CageBinding, split_tree
from ..splats.splat_field import SplatField
from .splat_instances import BOUND, CLEARED, FOLLOWED, LEFT, make_instances, shared_ways

#: A splat of a cage is cut in pieces, which a pose may draw in its place, where twice its standard deviation is more
#: than this share of the cage's size.
LARGE = 0.04

#: Most pieces: so many a splat, and so many more.
PIECES_A_SPLAT, FREE_PIECES = 1, 20_000

#: Pieces are drawn where the map takes one this far from the splat's own affine piece, as a share of the cage's size:
#: half a pixel where the cage is a thousand pixels across.
BEND_TOLERANCE = 5e-4

#: How far behind the walls the map is taken for splats at them, and how near to its target the inverse must come, as
#: shares of the cage's size.
DEPTH, CLOSE = 1e-4, 1e-4


class BoundEdit:
    """One edit on the device: its members and their bindings; `index` is its number."""

    def __init__(self, edit: CageEdit, owner: SplatEdits, index: int, progress: bool | Progress):
        device, origin = owner.device, owner.origin
        self.edit, self.owner, self.index = edit, owner, index
        actions = owner.instances.actions[index]
        members = {kind: actions.of(kind) for kind in (BOUND, LEFT, FOLLOWED, CLEARED)}
        self.members = {kind: wp.array(rows, dtype=wp.int32, device=device) for kind, rows in members.items()}
        self.outside = wp.array(actions.outside[members[LEFT]], dtype=wp.float32, device=device)
        self.ways = wp.array(actions.ways[members[FOLLOWED]], dtype=wp.uint8, device=device)
        self.faces = wp.array(edit.cage.faces, dtype=wp.vec3i, device=device)
        bound = members[BOUND]
        nodes = owner.instances.nodes[bound]
        centers = owner.tree.centers[nodes]
        leaders, others = shared_ways(owner.tree, nodes, bound, owner.anchors[index], len(owner.instances.nodes))
        anchors = owner.anchors[index][nodes[leaders]]
        if len(bound):
            kind, resolution = owner.coordinates, owner.resolution
            self.binding = CageBinding(
                anchors, edit.cage, kind, origin, device, resolution or RESOLUTION, progress=progress
            )
        offsets = (centers[leaders] - anchors).astype(np.float32)
        #: what the binding carries: leaders, others with the same path, anchors, and offsets from these
        self.carriers = (
            wp.array(bound[leaders], dtype=wp.int32, device=device),
            wp.array(others, dtype=wp.int32, device=device),
            owner.local(anchors),
            wp.array(offsets, dtype=wp.vec3, device=device),
        )
        self.targets = owner.local(centers)
        self.missed = wp.zeros(len(bound), dtype=wp.uint8, device=device)
        self._bends(bound, nodes)

    def _bends(self, bound: np.ndarray, nodes: np.ndarray) -> None:
        """The members with pieces, for `measure_bends`."""
        tree, device = self.owner.tree, self.owner.device
        member_of = np.full(len(tree.rows), -1, np.int32)
        member_of[nodes[::-1]] = bound[::-1]  # of several copies the first
        cut = np.flatnonzero((tree.pieces[nodes] >= 0) & (member_of[nodes] == bound))
        wholes = nodes[cut]
        pieces = tree.pieces[wholes][:, None] + np.arange(3)
        offsets = tree.centers[pieces] - tree.centers[wholes][:, None]
        at_wall = self.owner.shares[self.index][wholes] < 1.0
        self.bends = [
            wp.array(bound[cut], dtype=wp.int32, device=device),
            wp.array(np.ascontiguousarray(member_of[pieces]), dtype=wp.int32, device=device),
            wp.array(np.ascontiguousarray(offsets.astype(np.float32)), dtype=wp.vec3, device=device),
            wp.array(at_wall.astype(np.uint8), dtype=wp.uint8, device=device),
            wp.array(wholes.astype(np.int32), dtype=wp.int32, device=device),
        ]

    def carries(self, cage: Cage | None) -> bool:
        """Whether a pose of this edit moves what is bound to it."""
        if cage is None or self.edit.keep_source:
            return True
        return not np.array_equal(cage.vertices, self.edit.cage.vertices)

    def carry(self, cage: Cage | None, carried: Any, bent: wp.array | None) -> None:
        """Take the splats through a pose of this edit, behind the edits before; cage: None for an edit that removes.
        bent: (nodes,) uint8 that takes which splats are bent, or None where none can be."""
        owner, edit = self.owner, self.edit
        if cage is None:
            self._launch_in(edit.cage, pose.clear_inside, CLEARED, [], carried)
            return
        if not self.carries(cage):
            self._launch_in(cage, inside.cover_staying, LEFT, [self.outside], carried)
            return
        bound, vertices = self.members[BOUND], None
        if bound.size:
            vertices = self.binding.carry(cage, *self.carriers, carried)
            if (band := owner.bands[self.index]) is not None:
                walls = band.on_device(cage, owner.origin, owner.device)
                if walls.width > 0.0:
                    inputs = [bound, owner.centers, walls, carried]
                    launch(split.fade_carried, bound.size, inputs, device=owner.device)
            if (position_map := owner.maps[self.index]) is not None:
                self._invert(position_map, cage, carried)
        if bent is not None and self.bends[0].size:
            inputs = [*self.bends, owner.centers, BEND_TOLERANCE * edit.cage.size, carried]
            launch(split.measure_bends, self.bends[0].size, inputs, [bent], device=owner.device)
        self._launch_in(cage, inside.cover_staying, LEFT, [self.outside], carried, vertices)
        if self.members[FOLLOWED].size:
            self._follow(cage, carried)

    def _launch_in(
        self,
        inside_cage: Cage,
        kernel: Any,
        kind: int,
        extra: list[Any],
        carried: Any,
        vertices: wp.array | None = None,
    ) -> None:
        """Launch a kernel that finds members in a cage, whose vertices may be on the device already."""
        owner, members = self.owner, self.members[kind]
        if not members.size:
            return
        low, high = inside_cage.bounds - owner.origin
        if vertices is None:
            vertices = owner.local(inside_cage.vertices)
        order = [vertices, self.faces, wp.vec3(*low), wp.vec3(*high)]
        matter = [owner.centers, owner.covariances] if kind == LEFT else []  # others go as their centres do
        inputs = [members, *extra, *matter, *order, carried]
        count = members.size * (lane_count(owner.device) if kind == LEFT else 1)
        launch(kernel, count, inputs, device=owner.device, work=len(inside_cage.faces))

    def _follow(self, cage: Cage, carried: Any) -> None:
        """Take along what earlier edits moved, through a lattice over the cage at rest."""
        owner, edit = self.owner, self.edit
        options = {"coordinates": owner.coordinates, "resolution": owner.resolution or RESOLUTION}
        forward = PositionMap(cage, **options, origin=owner.origin, device=owner.device).pose(edit.cage)
        extra = [self.ways, forward.data, SURFACE_TOLERANCE * edit.cage.size]
        self._launch_in(cage, pose.follow_map, FOLLOWED, extra, carried)

    def _invert(self, position_map: PositionMap, cage: Cage, carried: Any) -> None:
        """Put the bound splats where the voxels' map finds them."""
        owner, size = self.owner, self.edit.cage.size
        backward = position_map.pose(cage).data
        bound = self.members[BOUND]
        inputs = [bound, self.targets, backward, SURFACE_TOLERANCE * cage.size, CLOSE * size, carried]
        launch(pose.invert_map, bound.size, inputs, [self.missed], device=owner.device, work=200)


class SplatEdits:
    """Edits of splats on a device, by a law of kernels/splats/pose.py; resolution: of lattices, None is RESOLUTION.
    backward: whether splats go where the voxels' map finds them; bands: None for an edit without a falloff."""

    def __init__(
        self,
        field: SplatField,
        edits: list[CageEdit],
        coordinates: str,
        resolution: int | None,
        law: int,
        backward: bool,
        bands: Sequence[FalloffBand | None],
        progress: bool | Progress = False,
    ):
        self.field, self.device, self.origin = field, field.device, field.center
        self.coordinates, self.resolution, self.law = coordinates, resolution, law
        self.bands = list(bands)
        self._edits = edits
        self.maps: list[PositionMap | None] = [None] * len(edits)  # where `backward`, of edits that do not remove
        if backward:
            options = {"coordinates": coordinates, "resolution": resolution or RESOLUTION, "origin": self.origin}
            self.maps = [
                None if edit.remove else PositionMap(edit.cage, **options, device=self.device).warm() for edit in edits
            ]
            set_gap_remedies(self.maps, self.bands)
        self._cut(edits)
        instances = self.instances = make_instances(edits, self.shares)
        count, device = len(instances.nodes), self.device
        nodes = instances.nodes
        six = self.tree.covariances[nodes][:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
        self.centers = self.local(self.tree.centers[nodes])
        self.covariances = wp.array(six.astype(np.float32), dtype=wp.float32, device=device)
        self.opacities = wp.array(self.tree.opacities[nodes].astype(np.float32), dtype=wp.float32, device=device)
        self._shares = wp.array(instances.shares, dtype=wp.float32, device=device)
        self._nodes = wp.array(nodes, dtype=wp.int32, device=device)
        self._parents = wp.array(self.tree.parents.astype(np.int32), dtype=wp.int32, device=device)
        has_pieces = bool((self.tree.pieces >= 0).any())
        self._split = wp.zeros(len(self.tree.rows), dtype=wp.uint8, device=device) if has_pieces else None
        self._hidden = wp.zeros(count if has_pieces else 0, dtype=wp.uint8, device=device)
        self.carried = CarriedSplats()  # of the last pose that was not at rest
        self.carried.positions = empty_array(count, wp.vec3, device)
        self.carried.jacobians = empty_array(count, wp.mat33, device)
        self.carried.shares = empty_array(count, wp.float32, device)
        launch(pose.start_splats, count, [self.centers, self.carried], device=device)
        self._ready = False
        self.bound = [BoundEdit(edit, self, index, progress) for index, edit in enumerate(edits)]
        self._posed = self._empty_splats(count)
        self.posed: Any = None  # the Splats of the last pose
        self.backward: Any = None  # what gradients keep between calls

    def _cut(self, edits: list[CageEdit]) -> None:
        """The tree of pieces, and which share of each node is in each cage, and where the map is taken for it."""
        field = self.field
        centers = field.contents.centers.astype(np.float64)
        factors = field.rotations * field.scales[:, None, :]
        shares, anchors = self._measure(edits, centers, field.covariances)
        largest = np.full(len(centers), np.inf)
        for edit, share in zip(edits, shares, strict=True):
            if not edit.remove:
                largest[share > 0.0] = np.minimum(largest[share > 0.0], 0.5 * LARGE * edit.cage.size)
        count = len(centers)
        max_count = count * (1 + PIECES_A_SPLAT) + FREE_PIECES
        self.tree = split_tree(centers, factors, field.opacities, largest, most=max_count)
        if len(self.tree.rows) > count:
            more, places = self._measure(edits, self.tree.centers[count:], self.tree.covariances[count:])
            shares, anchors = np.concatenate([shares, more], axis=1), np.concatenate([anchors, places], axis=1)
        self.shares, self.anchors = shares, anchors

    def _measure(
        self, edits: list[CageEdit], centers: np.ndarray, covariances: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """(edits, n) shares inside the cages at rest, and (edits, n, 3) anchors, world units."""
        device, count = self.device, len(centers)
        six = covariances[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].astype(np.float32)
        six = wp.array(six, dtype=wp.float32, device=device)
        local = self.local(centers)
        found = []
        for edit in edits:
            share, anchor = empty_array(count, wp.float32, device), empty_array(count, wp.vec3, device)
            low, high = edit.cage.bounds - self.origin
            faces = wp.array(edit.cage.faces, dtype=wp.vec3i, device=device)
            inputs = [local, six, self.local(edit.cage.vertices), faces, wp.vec3(*low), wp.vec3(*high)]
            inputs.append(DEPTH * edit.cage.size)
            launch(inside.measure_shares, count, inputs, [share, anchor], device=device, work=len(edit.cage.faces))
            moved = np.any(anchor.numpy() != local.numpy(), axis=1)
            places = np.where(moved[:, None], anchor.numpy().astype(np.float64) + self.origin, centers)
            found.append((share.numpy(), places))
        shares, anchors = zip(*found, strict=True)
        return np.stack(shares), np.stack(anchors)

    def local(self, points: np.ndarray) -> wp.array:
        """(n,) vec3 on the device, relative to the origin; points (n, 3) world units."""
        return local_points(points, self.origin, self.device)

    def _empty_splats(self, count: int) -> Any:
        """The Splats that poses are written to."""
        splats, rest, device = Splats(), self.field.splats, self.device
        splats.centers, splats.turns = empty_array(count, wp.vec3, device), empty_array(count, wp.quat, device)
        splats.covariances = empty_array((count, 6), wp.float32, device)
        splats.opacities = empty_array(count, wp.float32, device)
        splats.harmonics, splats.degree = rest.harmonics, rest.degree
        rows = self.tree.rows[self.instances.nodes].astype(np.int32)
        is_same = count == self.field.splat_count and np.array_equal(rows, np.arange(count))
        splats.rows = empty_array(0, wp.int32, device) if is_same else wp.array(rows, dtype=wp.int32, device=device)
        return splats

    def is_at_rest(self, cages: Sequence[Cage | None]) -> bool:
        """Whether a pose leaves everything as it is."""
        return all(
            cage is not None and np.array_equal(cage.vertices, edit.cage.vertices)
            for edit, cage in zip(self._edits, cages, strict=True)
        )

    def pose(self, cages: Sequence[Cage | None]) -> None:
        """Carry the splats to a pose, None for an edit that removes; `posed` has them then.
        Where a cage cannot be used, the splats stay where they are."""
        for cage in cages:
            if cage is not None:
                require_usable(cage, "the deformed cage")
        if self.is_at_rest(cages):  # to the bit: nothing is in pieces or shares
            self.posed = self.field.splats
            return
        self.carry(cages)

    def carry(self, cages: Sequence[Cage | None]) -> None:
        """Carry the splats to a pose as `pose` does, also to the one at rest, in pieces and shares."""
        count, device = self._nodes.size, self.device
        moving = [bound.carries(cage) for bound, cage in zip(self.bound, cages, strict=True)]
        if not self._ready:
            self._rewind()
        if not all(moving):  # what another pose has moved is at rest, and nothing writes its place anew
            launch(pose.start_splats, count, [self.centers, self.carried], device=device)
        self._ready = False
        for bound, cage in zip(self.bound, cages, strict=True):
            bound.carry(cage, self.carried, self._split)
        if self._split is not None:
            inputs = [self._nodes, self._parents, self._split]
            launch(split.hide_splats, count, inputs, [self._hidden], device=device)
        out = self._posed
        inputs = [self.law, self.covariances, self.opacities, self._hidden, self.carried]
        outputs = [out.centers, out.covariances, out.opacities, out.turns]
        launch(pose.finish_splats, count, inputs, outputs, device=device)
        self.posed = out
        self._rewind()

    def _rewind(self) -> None:
        """Whole shares, and nothing split: ahead of the next pose, as its first launches are waited for."""
        wp.copy(self.carried.shares, self._shares)
        if self._split is not None:
            self._split.zero_()
        self._ready = True

    @property
    def is_split(self) -> bool:
        """Whether the last pose draws pieces in place of a splat."""
        whole = self.tree.parents[self.instances.nodes] < 0
        return bool(self._hidden.size and self._hidden.numpy()[whole].any())

    @property
    def missed_count(self) -> int:
        """Splats that the inverse of the voxels' map did not find a place for in the last pose."""
        return int(sum(int(bound.missed.numpy().sum()) for bound in self.bound))
