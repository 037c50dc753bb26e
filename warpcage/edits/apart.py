"""Edits that cannot meet each other: boxes that are apart, and their order from a camera."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from ..cage.cage import Cage
from .edits import CageEdit

#: A box without a point in it.
NOWHERE = np.array([[np.inf] * 3, [-np.inf] * 3])


@dataclasses.dataclass(frozen=True)
class EditBoxes:
    """Boxes (n, 2, 3) float64, lower and upper corners, around the places that edits of a scene have to do with."""

    changed: np.ndarray  # around the posed cage and the rest cage of each: beyond, it changes nothing
    sources: np.ndarray  # around where its map may lead
    _wider: dict[float, np.ndarray] = dataclasses.field(default_factory=dict, init=False, repr=False, compare=False)

    def are_apart(self, reach: float) -> bool:
        """Whether no place has to do with two edits, where a sample looks as far as `reach`, world units, from its
        place."""
        between, beneath = self._least_gaps
        return between > 2.0 * reach and beneath > 0.0  # maps lead to their own rest cages, which no edit changed

    def front_to_back(self, center: ArrayLike, reach: float) -> tuple[int, ...] | None:
        """The edits in an order in which rays from `center` (3,) meet them, where they `are_apart`. None where they may
        meet, or hide each other in a circle."""
        order = front_to_back(self.reaching(reach), center) if self.are_apart(reach) else None
        return None if order is None else tuple(order)

    def reaching(self, reach: float) -> np.ndarray:
        """(n, 2, 3) boxes of places that samples look at which look as far as `reach`; kept, as frames ask again."""
        if self._wider.get(reach) is None:
            self._wider.clear()
            self._wider[reach] = wider(self.changed, reach)
        return self._wider[reach]

    @functools.cached_property
    def _least_gaps(self) -> tuple[float, float]:
        """Between two boxes, and between what a map leads to and the box of an earlier edit."""
        later = np.tril_indices(len(self.changed), -1)
        gaps = (box_gaps(boxes, self.changed)[later] for boxes in (self.changed, self.sources))
        between, beneath = (float(gap.min(initial=np.inf)) for gap in gaps)
        return between, beneath


def edit_boxes(
    edits: Sequence[CageEdit],
    cages: Sequence[Cage | None],
    origin: ArrayLike,
    tolerances: Sequence[float],
    slacks: Sequence[float],
) -> EditBoxes:
    """The boxes of posed edits, relative to the world point `origin`; cages: None for an edit that removes.
    tolerances: how far out of a cage points count as in it; slacks: how far out of the rest cage a map may lead."""
    # A trilinear distance is nowhere below that to a plane with the cage behind it: what counts as in is in the box.
    changed, sources = [], []
    for edit, cage, tolerance, slack in zip(edits, cages, tolerances, slacks, strict=True):
        rest = edit.cage.bounds - np.asarray(origin)
        posed = rest if cage is None else cage.bounds - np.asarray(origin)
        both = np.stack([np.minimum(rest[0], posed[0]), np.maximum(rest[1], posed[1])])
        changed.append(wider(both, tolerance))
        sources.append(NOWHERE if cage is None else wider(rest, slack + tolerance))
    return EditBoxes(np.stack(changed), np.stack(sources))


def wider(boxes: np.ndarray, by: float) -> np.ndarray:
    """Boxes (..., 2, 3) that reach further on each side."""
    return boxes + by * np.array([[-1.0], [1.0]])


def box_gaps(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """How far boxes (n, 2, 3) and others (m, 2, 3) are apart, (n, m), along the axis along which they are farthest.
    Negative where they overlap."""
    beyond = others[None, :, 0] - boxes[:, None, 1]
    before = boxes[:, None, 0] - others[None, :, 1]
    return np.maximum(beyond, before).max(axis=-1)


def front_to_back(boxes: np.ndarray, center: ArrayLike) -> list[int] | None:
    """An order in which each ray from `centre`, in a box or not, enters those of the boxes (n, 2, 3) that it meets.
    No two boxes may overlap. None where there is no order, as boxes hide each other in a circle."""
    lower, upper, center = boxes[:, 0], boxes[:, 1], np.asarray(center)
    below = upper[:, None] < lower[None, :]  # (n, n, 3)
    # Rays go one way along each axis: of two boxes with a gap none meets first the lower and then the upper if it
    # starts above the lower one's top, nor the other way round if it starts under the upper one's bottom.
    never = below & (center > upper)[:, None] | below.swapaxes(0, 1) & (center < lower)[:, None]
    first = ~never.any(axis=-1)
    np.fill_diagonal(first, False)
    order, left = [], list(range(len(boxes)))
    while left:
        free = [i for i in left if not first[left, i].any()]
        if not free:
            return None
        order.append(free[0])
        left.remove(free[0])
    return order
