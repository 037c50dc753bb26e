"""The splats that edits draw of a field of splats, and the action of each edit on each of them."""

from __future__ import annotations

import dataclasses

import numpy as np

from ..edits.edits import CageEdit
from ..kernels.splats.pose import GOES, GOES_OR_STAYS, STAYS
from ..splats.binding import SplitTree

#: What an edit does to a splat: nothing; it moves with the cage, bound to it at rest; it stays, and is covered by what
#: moves; an earlier edit moved it, and it is carried from there; it is cleared if it is in the cage then.
NOTHING, BOUND, LEFT, FOLLOWED, CLEARED = range(5)


@dataclasses.dataclass
class EditActions:
    """What one edit does to each of n splats."""

    kinds: np.ndarray  # uint8: NOTHING, BOUND, LEFT, FOLLOWED or CLEARED
    outside: np.ndarray  # float32, of LEFT splats the share that stays at most
    ways: np.ndarray  # uint8, of FOLLOWED splats the way of kernels/splats/pose.py

    def of(self, kind: int) -> np.ndarray:
        """(m,) int32 the splats with an action."""
        return np.flatnonzero(self.kinds == kind).astype(np.int32)


@dataclasses.dataclass
class Instances:
    """Splats as they are drawn: of one node of a SplitTree each, whole or in part, or a copy."""

    nodes: np.ndarray  # (n,) int32
    shares: np.ndarray  # (n,) float32, of the optical depth of the node
    actions: list[EditActions]  # one for each edit


def make_instances(edits: list[CageEdit], shares: np.ndarray) -> Instances:
    """The splats that edits, in their order, make of nodes.
    shares: (edits, nodes) of each node inside the cage of each edit at rest, 0 to 1."""
    # A splat in the cage goes with it; at its wall by its share, the rest stays, as copies do where the source is kept.
    count = shares.shape[1]
    nodes, held = np.arange(count, dtype=np.int32), np.ones(count, np.float32)
    moved = np.zeros(count, dtype=bool)
    actions: list[EditActions] = []
    for edit, inside in zip(edits, shares, strict=True):
        share = inside[nodes].astype(np.float32)
        new = EditActions(*(np.zeros(len(nodes), kind) for kind in (np.uint8, np.float32, np.uint8)))
        actions.append(new)
        if edit.remove:
            new.kinds[moved] = CLEARED
            held[~moved] *= 1.0 - share[~moved]
            nodes, held, moved = _rows(np.flatnonzero(held > 0.0), nodes, held, moved, actions)
            continue
        goes, stays = ~moved & (share > 0.0), ~moved & ((share < 1.0) | edit.keep_source)
        new.kinds[goes], new.kinds[stays & ~goes], new.kinds[moved] = BOUND, LEFT, FOLLOWED
        new.outside[:] = 1.0 if edit.keep_source else 1.0 - share
        new.ways[:] = GOES if edit.keep_source else GOES_OR_STAYS
        twice = np.flatnonzero((goes & stays) | (moved & edit.keep_source))
        first, whole = len(nodes), held.copy()
        held[goes] *= share[goes]
        moved = moved | goes
        nodes, held, moved = _rows(np.concatenate([np.arange(first), twice]), nodes, held, moved, actions)
        held[first:] = whole[twice]  # each pose decides how much of it stays
        copies = np.arange(first, len(nodes))
        followed = new.kinds[copies] == FOLLOWED
        new.kinds[copies[~followed]], new.ways[copies[followed]] = LEFT, STAYS
        moved[copies[~followed]] = False
    return Instances(nodes, held, actions)


def shared_ways(
    tree: SplitTree, nodes: np.ndarray, bound: np.ndarray, anchors: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Which of `bound` splats (m,), of `nodes` (m,), go the same way, as the map is taken at their anchors (nodes, 3):
    rows of `bound` (k,) that are carried for all, and (count,) int32, the next splat of the same way, or -1."""
    source = np.arange(len(tree.rows))
    whole = np.flatnonzero(tree.pieces >= 0)
    middle = tree.pieces[whole]  # middle pieces lie where their splats do, and copies where their sources do
    same = (anchors[middle] == anchors[whole]) & (tree.centers[middle] == tree.centers[whole])
    source[middle[same.all(axis=1)]] = whole[same.all(axis=1)]
    while not np.array_equal(source, above := source[source]):  # middle pieces of middle pieces
        source = above
    order = np.argsort(source[nodes], kind="stable")
    ways = source[nodes][order]
    begins = np.append(True, ways[1:] != ways[:-1])[: len(ways)]
    others = np.full(count, -1, np.int32)
    follows = np.flatnonzero(~begins)
    others[bound[order[follows - 1]]] = bound[order[follows]]
    return order[begins], others


def _rows(
    rows: np.ndarray, nodes: np.ndarray, held: np.ndarray, moved: np.ndarray, actions: list[EditActions]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Some of the instances, or copies of them, with their history."""
    for action in actions:
        action.kinds, action.outside, action.ways = action.kinds[rows], action.outside[rows], action.ways[rows]
    return nodes[rows], held[rows], moved[rows]
