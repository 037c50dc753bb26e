"""Poses: functions that move vertices to where an artist would drag them."""
# Vertices are (n, 3), world units, and so is what a pose returns, float64. The centre is (3,), world units, a point on
# the line of an axis; None is the middle of the bounding box.
#
# The poses along an axis act between two limits, shares of the bounding box as in Blender's Simple Deform modifier.
# What lies below the lower limit stays. What lies above the upper one follows rigidly (bend, twist), moves along
# (stretch) or takes the last factor (taper). Notation: w the coordinate along the axis, [w0, w1] the limits in world
# units, s = w - w0 clamped to [0, w1 - w0], t = s / (w1 - w0), c the centre.
#
# An axis is "x", "y", "z", or a direction (3,) of any length; along a direction the bounding box is the one that lies
# along it, and its middle stays that of the world's.
#
# `bounds` stands in for the bounding box of the vertices, to pose a part or a point cloud along with something larger:
# its two corners (2, 3), or points (n, 3) whose box it is.

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import PointsLike, as_host_points
from ..core.checks import AXES, axis_index, checked_number, checked_positive, checked_vector, real_array, shown
from .directions import direction, frame_along, signed_axis


def bend(
    vertices: PointsLike,
    degrees: float,
    *,
    axis: str | ArrayLike = "z",
    towards: str | ArrayLike = "x",
    limits: Sequence[float] = (0.0, 1.0),
    centre: ArrayLike | None = None,
    bounds: ArrayLike | None = None,
) -> np.ndarray:
    """Bend the straight line through the centre along an axis into a circular arc towards another axis.
    `towards` may be "-x", against an axis, or a direction (3,), of which what is across the axis counts."""
    if not (isinstance(axis, str) and isinstance(towards, str)):
        return _along(bend, vertices, degrees, axis, towards, limits=limits, centre=centre, bounds=bounds)
    angle, along = np.deg2rad(checked_number(degrees, "degrees")), axis_index(axis)
    sign, across = signed_axis(towards)
    if across == along:
        raise ValueError(f"bend needs two different axes, got axis {axis!r} and towards {towards!r}")
    rest, box, middle = _prepared(vertices, bounds, centre)
    start, length = _limits(limits, box, along)

    # With the curvature k = angle / (w1 - w0), phi = k s, r = w - w0 - s the part beyond the limits, and d = u - c_u
    # the offset in the direction `towards`:
    #     w' = w0  + sin(phi) / k       + r cos(phi) - d sin(phi)
    #     u' = c_u + (1 - cos(phi)) / k + r sin(phi) + d cos(phi)
    # Lengths on the line itself (d = 0) are kept. What is more than 1 / k from the line on the inner side folds over.
    w = rest[:, along] - start
    s = np.clip(w, 0.0, length)
    beyond = w - s
    offset = sign * (rest[:, across] - middle[across])
    phi = angle * s / length
    # sin(phi) / k and (1 - cos(phi)) / k in a form that holds for k = 0 too
    arc_along = s * np.sinc(phi / np.pi)
    arc_across = s * np.sin(phi / 2.0) * np.sinc(phi / (2.0 * np.pi))
    bent = rest.copy()
    bent[:, along] = start + arc_along + beyond * np.cos(phi) - offset * np.sin(phi)
    bent[:, across] = middle[across] + sign * (arc_across + beyond * np.sin(phi) + offset * np.cos(phi))
    return bent


def twist(
    vertices: PointsLike,
    degrees: float,
    *,
    axis: str | ArrayLike = "z",
    limits: Sequence[float] = (0.0, 1.0),
    centre: ArrayLike | None = None,
    bounds: ArrayLike | None = None,
) -> np.ndarray:
    """Turn each slice across an axis about the line through the centre by t * degrees.
    The angle is anticlockwise seen against the axis."""
    if not isinstance(axis, str):
        return _along(twist, vertices, degrees, axis, limits=limits, centre=centre, bounds=bounds)
    angle, along = np.deg2rad(checked_number(degrees, "degrees")), axis_index(axis)
    rest, box, middle = _prepared(vertices, bounds, centre)
    turn = angle * _share(rest, limits, box, along)
    u, v = (along + 1) % 3, (along + 2) % 3
    du, dv = rest[:, u] - middle[u], rest[:, v] - middle[v]
    twisted = rest.copy()
    twisted[:, u] = middle[u] + du * np.cos(turn) - dv * np.sin(turn)
    twisted[:, v] = middle[v] + du * np.sin(turn) + dv * np.cos(turn)
    return twisted


def taper(
    vertices: PointsLike,
    factor: float,
    *,
    axis: str | ArrayLike = "z",
    limits: Sequence[float] = (0.0, 1.0),
    centre: ArrayLike | None = None,
    bounds: ArrayLike | None = None,
) -> np.ndarray:
    """Scale each slice across an axis about the line through the centre by 1 + (factor - 1) t."""
    if not isinstance(axis, str):
        return _along(taper, vertices, factor, axis, limits=limits, centre=centre, bounds=bounds)
    factor, along = checked_positive(factor, "factor"), axis_index(axis)
    rest, box, middle = _prepared(vertices, bounds, centre)
    share = _share(rest, limits, box, along)
    across = np.arange(3) != along
    tapered = rest.copy()
    factors = 1.0 + (factor - 1.0) * share
    tapered[:, across] = middle[across] + (rest[:, across] - middle[across]) * factors[:, None]
    return tapered


def stretch(
    vertices: PointsLike,
    factor: float,
    *,
    axis: str | ArrayLike = "z",
    limits: Sequence[float] = (0.0, 1.0),
    keep_volume: bool = False,
    centre: ArrayLike | None = None,
    bounds: ArrayLike | None = None,
) -> np.ndarray:
    """Make what lies between the limits longer: w' = w + (factor - 1) s.
    `keep_volume` scales across the axis by 1 / sqrt(factor), about the line, and needs the limits (0, 1)."""
    if not isinstance(axis, str):
        kept = {"keep_volume": keep_volume, "limits": limits}
        return _along(stretch, vertices, factor, axis, centre=centre, bounds=bounds, **kept)
    factor, along = checked_positive(factor, "factor"), axis_index(axis)
    rest, box, middle = _prepared(vertices, bounds, centre)
    start, length = _limits(limits, box, along)
    stretched = rest.copy()
    stretched[:, along] += (factor - 1.0) * np.clip(rest[:, along] - start, 0.0, length)
    if keep_volume:
        if tuple(limits) != (0.0, 1.0):
            raise ValueError(f"keep_volume stretches the whole length: limits must be (0, 1), got {tuple(limits)}")
        across = np.arange(3) != along
        stretched[:, across] = middle[across] + (rest[:, across] - middle[across]) / np.sqrt(factor)
    return stretched


def scale(
    vertices: PointsLike, factor: ArrayLike, *, centre: ArrayLike | None = None, bounds: ArrayLike | None = None
) -> np.ndarray:
    """Scale about the centre by one positive factor, or by one for each axis (3,): x' = c + factor (x - c)."""
    factors = np.asarray(factor, dtype=np.float64)
    if factors.shape not in ((), (3,)) or not np.isfinite(factors).all() or (factors <= 0.0).any():
        raise ValueError(f"scale needs one positive factor or three, got {factor}")
    rest, _, middle = _prepared(vertices, bounds, centre)
    return middle + (rest - middle) * factors


def translate(vertices: PointsLike, offset: ArrayLike) -> np.ndarray:
    """Move all vertices by an offset (3,), world units: x' = x + offset."""
    return as_host_points(vertices, name="vertices") + checked_vector(offset, "offset")


def rotate(
    vertices: PointsLike,
    degrees: float,
    *,
    axis: str | ArrayLike = "z",
    centre: ArrayLike | None = None,
    bounds: ArrayLike | None = None,
) -> np.ndarray:
    """Turn by `degrees` about the line through the centre along an axis, anticlockwise seen against it."""
    angle = np.deg2rad(checked_number(degrees, "degrees"))
    k = np.eye(3)[axis_index(axis)] if isinstance(axis, str) else direction(axis, "axis")
    rest, _, middle = _prepared(vertices, bounds, centre)
    y = rest - middle
    # Rodrigues' formula
    return middle + np.cos(angle) * y + np.sin(angle) * np.cross(k, y) + (1.0 - np.cos(angle)) * np.outer(y @ k, k)


def move(
    vertices: PointsLike,
    offset: ArrayLike,
    *,
    group: ArrayLike | None = None,
    centre: ArrayLike | None = None,
    radius: float | None = None,
) -> np.ndarray:
    """Move a group (k,) of vertices, or what is near a centre, by an offset (3,), and the surroundings less and less.
    `radius` is where the effect ends, world units; None moves the group alone."""
    rest, step = as_host_points(vertices, name="vertices"), checked_vector(offset, "offset")
    if (group is None) == (centre is None):
        raise ValueError("move needs either a group of vertices or a centre")
    reach = None if radius is None else checked_positive(radius, "radius")
    if centre is not None:
        if reach is None:
            raise ValueError("move about a centre needs a radius")
        distance = np.linalg.norm(rest - checked_vector(centre, "centre"), axis=1)
    else:
        moved = np.atleast_1d(np.asarray(group))
        whole = moved.dtype.kind in "iu" and moved.ndim == 1 and len(moved)
        if not whole or moved.min() < 0 or moved.max() >= len(rest):
            raise ValueError(f"group must be vertex numbers from 0 to {len(rest) - 1}, at least one")
        if reach is None:
            distance, reach = np.where(np.isin(np.arange(len(rest)), moved), 0.0, 1.0), 1.0
        else:
            distance = np.array([np.linalg.norm(rest[moved] - x, axis=1).min() for x in rest])
    # x' = x + w(d / radius) offset, with d the distance to the nearest vertex of the group, or to the centre, and
    # w(t) = (1 - t)^2 (1 + 2 t), smooth at both ends
    t = np.clip(distance / reach, 0.0, 1.0)
    return rest + ((1.0 - t) ** 2 * (1.0 + 2.0 * t))[:, None] * step


def _along(
    pose: Callable[..., np.ndarray],
    vertices: PointsLike,
    amount: float,
    axis: str | ArrayLike,
    towards: str | ArrayLike | None = None,
    *,
    bounds: ArrayLike | None,
    centre: ArrayLike | None,
    **options: Any,
) -> np.ndarray:
    """A pose along any direction: that along z, towards x, in axes that lie so."""
    rest, box, middle = _prepared(vertices, bounds, centre)
    frame = frame_along(axis, towards)
    points = rest if bounds is None else np.asarray(bounds, dtype=np.float64)
    if bounds is not None and len(points) == 2:
        points = box[np.indices((2, 2, 2)).reshape(3, 8).T, np.arange(3)]  # its corners
    local = points @ frame.T
    extent = np.stack([local.min(axis=0), local.max(axis=0)])
    across = {} if towards is None else {"towards": "x"}
    posed = pose(rest @ frame.T, amount, axis="z", bounds=extent, centre=frame @ middle, **across, **options)
    return posed @ frame


def _prepared(
    vertices: PointsLike, bounds: ArrayLike | None, centre: ArrayLike | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, bounds and centre as float64, with their defaults."""
    rest = as_host_points(vertices, name="vertices")
    if bounds is None:
        if not len(rest):
            raise ValueError("a pose needs at least one vertex, or bounds")
        bounds = np.stack([rest.min(axis=0), rest.max(axis=0)])
    box = np.asarray(bounds, dtype=np.float64)
    if box.ndim == 2 and box.shape[0] > 2 and box.shape[1] == 3:
        box = np.stack([box.min(axis=0), box.max(axis=0)])
    # unlike checked_bounds: a flat cage can be posed along its own plane
    if box.shape != (2, 3) or not np.isfinite(box).all() or (box[1] < box[0]).any():
        raise ValueError(f"bounds must be (2, 3), the lower corner first, got {box.tolist()}")
    return rest, box, box.mean(axis=0) if centre is None else checked_vector(centre, "centre")


def _limits(limits: Sequence[float], bounds: np.ndarray, along: int) -> tuple[float, float]:
    """Where the limits begin along the axis and how far apart they are, world units."""
    shares = real_array(limits, "limits")
    if shares.shape != (2,) or not np.isfinite(shares).all() or not shares[0] < shares[1]:
        raise ValueError(f"limits must be two shares of the bounding box, the lower first, got {shown(limits)}")
    extent = bounds[1, along] - bounds[0, along]
    if extent == 0.0:
        raise ValueError(f"the bounding box is flat along axis {AXES[along]!r}: pose along another axis")
    return bounds[0, along] + shares[0] * extent, (shares[1] - shares[0]) * extent


def _share(vertices: np.ndarray, limits: Sequence[float], bounds: np.ndarray, along: int) -> np.ndarray:
    """t of each vertex."""
    start, length = _limits(limits, bounds, along)
    return np.clip((vertices[:, along] - start) / length, 0.0, 1.0)
