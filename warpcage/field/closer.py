"""Objects of splats on grids that become finer around them: a whole place has few cells for a cup."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.checks import checked_bounds
from .selection import NodeSelection
from .surface import DensityField

#: Cells along the longest side of a grid, at most and at least.
MOST_CELLS, LEAST_CELLS = 128, 32

#: What is looked at around an object, on each side, as a share of its longest side: planes go on around what stands on
#: them over twice its area.
AROUND = 0.75

#: A grid is done where a finer one would be longer than this share of it.
NEAR_ENOUGH = 0.85

#: Grids that are tried, and the share of one that the next has around a click on nothing or on a plane.
GRIDS, CLOSER = 9, 0.5

#: How much larger the next window about a click is where an object does not end in the one before.
WIDER = 1.6

#: What is found only after a click that seemed to be on nothing or on a plane is an object from so many cells along its
#: shortest side on, and not the roughness of the plane.
LEAST_SIDE = 4


def is_splats(field: object) -> bool:
    """Whether a field is of splats, which can be looked at on any grid."""
    return hasattr(field, "matter")


def region_box(box: ArrayLike | None, sphere: ArrayLike | None, cage: Any) -> np.ndarray | None:
    """The box (2, 3) of a region, which may be wrong where what is given makes no sense; None of no region."""
    boxes = [] if box is None else [checked_bounds(box, "box")]
    if sphere is not None and np.shape(sphere) == (4,):
        ball = np.asarray(sphere, np.float64)
        boxes.append(np.stack([ball[:3] - ball[3], ball[:3] + ball[3]]))
    if hasattr(cage, "vertices"):
        boxes.append(np.stack([cage.vertices.min(axis=0), cage.vertices.max(axis=0)]))
    return _common(boxes) if boxes else None


def matter_around(field: Any, region: np.ndarray) -> Any:
    """The matter (SplatDensity) of a field of splats on a grid about a region (2, 3)."""
    window = _clipped(_around(region), field)
    return field.matter(window, _cells(field, window))


def choose_closer(
    field: Any, choose: Callable[[DensityField], NodeSelection], clicks: np.ndarray | None, region: np.ndarray | None
) -> NodeSelection:
    """What `choose` takes of a field of splats, on the finest grid around it that shows it.
    clicks (k, 3) are on it, or None; region (2, 3) holds it, or None."""
    window = _clipped(_around(region), field) if region is not None else np.array(field.shown_bounds)
    near = None
    if region is None and clicks is not None:
        window = np.stack([np.minimum(window[0], clicks.min(axis=0)), np.maximum(window[1], clicks.max(axis=0))])
        near = _near(field, choose, clicks, window)
        window = window if near is None else near[0]
    found: NodeSelection | None = None
    failed: ValueError | None = None
    for _ in range(GRIDS):
        seen = field.matter(window, _cells(field, window)) if near is None else near[1]
        try:
            chosen = choose(seen) if near is None else near[2]
            near = None
            if failed is not None and found is None and _side(chosen) < LEAST_SIDE:
                raise failed
        except ValueError as error:
            failed = failed or error
            if found is not None or clicks is None or _longest(window) <= LEAST_CELLS * field.finest_cell(window):
                break
            window = _shrunk(window, clicks)
            continue
        found = chosen
        points = chosen.points
        closer = _clipped(_around(np.stack([points.min(axis=0), points.max(axis=0)]), seen.voxel_size), field)
        if _longest(closer) > NEAR_ENOUGH * _longest(window) and not _is_cut(chosen, field):
            break
        if _longest(closer) <= LEAST_CELLS * field.finest_cell(window) or np.allclose(closer, window):
            break
        window = closer
    if found is None:
        assert failed is not None
        raise failed
    return found


def _near(
    field: Any, choose: Callable[[DensityField], NodeSelection], clicks: np.ndarray, whole: np.ndarray
) -> tuple[np.ndarray, DensityField, NodeSelection] | None:
    """The smallest window about clicks in which what is chosen ends, its matter, and what is chosen; None in none."""
    # from near to far: in a whole place far walls are planes too, and all that has few cells hangs together
    middle = 0.5 * (clicks.min(axis=0) + clicks.max(axis=0))
    half = float(np.ptp(clicks, axis=0).max()) + 2.0 * _longest(whole) / MOST_CELLS
    while 2.0 * half < _longest(whole):
        window = _clipped(np.stack([middle - half, middle + half]), field)
        half *= WIDER
        if _longest(window) < LEAST_CELLS * field.finest_cell(window):
            continue
        seen = field.matter(window, _cells(field, window))
        try:
            chosen = choose(seen)
        except ValueError:
            continue  # nothing there, or no plane yet
        if _side(chosen) >= LEAST_SIDE and not _is_cut(chosen, field):
            return window, seen, chosen
    return None


def _cells(field: Any, window: np.ndarray) -> int:
    """Cells along the longest side of a window, no smaller than its splats allow."""
    finest = field.finest_cell(window)
    return int(np.clip(_longest(window) / finest, LEAST_CELLS, MOST_CELLS)) if finest > 0.0 else MOST_CELLS


def _longest(box: np.ndarray) -> float:
    return float((box[1] - box[0]).max())


def _side(chosen: NodeSelection) -> int:
    """Cells along the shortest side of what is chosen."""
    return int(np.ptp(np.argwhere(chosen.mask), axis=0).min()) + 1


def _around(box: np.ndarray, least: ArrayLike = 0.0) -> np.ndarray:
    """A box with what is around it; least: its longest side, at least."""
    side = max(_longest(box), float(np.max(least)))
    return np.stack([box[0] - AROUND * side, box[1] + AROUND * side])


def _common(boxes: list[np.ndarray]) -> np.ndarray:
    """What boxes share; the first where they share nothing."""
    both = np.stack([np.max([each[0] for each in boxes], axis=0), np.min([each[1] for each in boxes], axis=0)])
    return both if (both[1] > both[0]).all() else boxes[0]


def _clipped(box: np.ndarray, field: Any) -> np.ndarray:
    return _common([np.asarray(field.bounds, np.float64), box])


def _shrunk(window: np.ndarray, clicks: np.ndarray) -> np.ndarray:
    """A window of half the size about clicks, in which they all are."""
    half = 0.5 * CLOSER * (window[1] - window[0])
    return np.stack([clicks.min(axis=0) - half, clicks.max(axis=0) + half])


def _is_cut(chosen: NodeSelection, field: Any) -> bool:
    """Whether what is chosen reaches a side of its grid beyond which the field goes on."""
    sides = [np.take(chosen.mask, end, axis=axis).any() for end in (0, -1) for axis in range(3)]
    beyond = [*(chosen.bounds[0] > field.bounds[0]), *(chosen.bounds[1] < field.bounds[1])]
    return any(side and more for side, more in zip(sides, beyond, strict=True))
