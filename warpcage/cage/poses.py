"""Poses: functions that move vertices (n, 3) float64, world units, to where an artist would drag them.

The poses along an axis act between two limits, shares of the bounding box as in Blender's Simple Deform modifier: what
lies below the lower limit stays, what lies above the upper follows rigidly (bend, twist), moves along (stretch) or
takes the last factor (taper). Notation: w the coordinate along the axis, [w0, w1] the limits in world units, s = w - w0
cut to [0, w1 - w0], t = s / (w1 - w0), c the centre.

`centre` (3,) lies on the line that the pose bends, turns or scales about (default: middle of the bounding box).
`bounds` (2, 3) replaces the bounding box of the vertices, to pose a part or a point cloud with something larger.
All functions raise ValueError for values that are not finite and for axes and limits that make no sense.
"""

from __future__ import annotations

import numpy as np

from ..core.arrays import as_host_points

AXES = "xyz"


def bend(vertices, degrees, *, axis="z", towards="x", limits=(0.0, 1.0), centre=None, bounds=None) -> np.ndarray:
    """Bend the straight line through `centre` along `axis` into a circular arc of `degrees`, towards another axis.

    With curvature k = angle / (w1 - w0), phi = k s, r = w - w0 - s what lies beyond the limits and d = u - c_u the
    offset in the direction `towards` ("x", "-x", ...):

        w' = w0  + sin(phi) / k       + r cos(phi) - d sin(phi)
        u' = c_u + (1 - cos(phi)) / k + r sin(phi) + d cos(phi)

    Lengths on the line itself (d = 0) are kept. What is more than 1 / k from the line on the inner side folds over.
    """
    angle, along = np.deg2rad(_finite(degrees, "degrees")), axis_index(axis)
    sign, across = _signed_axis(towards)
    if across == along:
        raise ValueError(f"bend needs two different axes, got axis {axis!r} and towards {towards!r}")
    vertices, bounds, centre = _prepared(vertices, bounds, centre)
    start, length = _limits(limits, bounds, along)

    w = vertices[:, along] - start
    s = np.clip(w, 0.0, length)
    rest = w - s
    offset = sign * (vertices[:, across] - centre[across])
    phi = angle * s / length
    # sin(phi) / k and (1 - cos(phi)) / k in the form that holds for a straight line too
    arc_along = s * np.sinc(phi / np.pi)
    arc_across = s * np.sin(phi / 2.0) * np.sinc(phi / (2.0 * np.pi))
    bent = vertices.copy()
    bent[:, along] = start + arc_along + rest * np.cos(phi) - offset * np.sin(phi)
    bent[:, across] = centre[across] + sign * (arc_across + rest * np.sin(phi) + offset * np.cos(phi))
    return bent


def twist(vertices, degrees, *, axis="z", limits=(0.0, 1.0), centre=None, bounds=None) -> np.ndarray:
    """Turn each slice across `axis` about the line through `centre` by t * degrees.

    Positive angles are anticlockwise seen against the axis.
    """
    angle, along = np.deg2rad(_finite(degrees, "degrees")), axis_index(axis)
    vertices, bounds, centre = _prepared(vertices, bounds, centre)
    turn = angle * _share(vertices, limits, bounds, along)
    u, v = (along + 1) % 3, (along + 2) % 3
    du, dv = vertices[:, u] - centre[u], vertices[:, v] - centre[v]
    twisted = vertices.copy()
    twisted[:, u] = centre[u] + du * np.cos(turn) - dv * np.sin(turn)
    twisted[:, v] = centre[v] + du * np.sin(turn) + dv * np.cos(turn)
    return twisted


def taper(vertices, factor, *, axis="z", limits=(0.0, 1.0), centre=None, bounds=None) -> np.ndarray:
    """Scale each slice across `axis` about the line through `centre` by 1 + (factor - 1) t; factor > 0."""
    factor, along = _positive(factor), axis_index(axis)
    vertices, bounds, centre = _prepared(vertices, bounds, centre)
    share = _share(vertices, limits, bounds, along)
    across = np.arange(3) != along
    tapered = vertices.copy()
    factors = 1.0 + (factor - 1.0) * share
    tapered[:, across] = centre[across] + (vertices[:, across] - centre[across]) * factors[:, None]
    return tapered


def stretch(
    vertices, factor, *, axis="z", limits=(0.0, 1.0), keep_volume=False, centre=None, bounds=None
) -> np.ndarray:
    """Make what lies between the limits `factor` times as long: w' = w + (factor - 1) s; factor > 0.

    keep_volume scales across the axis by 1 / sqrt(factor), about the line through `centre`; it takes the whole length,
    limits (0, 1).
    """
    factor, along = _positive(factor), axis_index(axis)
    vertices, bounds, centre = _prepared(vertices, bounds, centre)
    start, length = _limits(limits, bounds, along)
    stretched = vertices.copy()
    stretched[:, along] += (factor - 1.0) * np.clip(vertices[:, along] - start, 0.0, length)
    if keep_volume:
        if tuple(limits) != (0.0, 1.0):
            raise ValueError(f"keep_volume stretches the whole length: limits must be (0, 1), got {tuple(limits)}")
        across = np.arange(3) != along
        stretched[:, across] = centre[across] + (vertices[:, across] - centre[across]) / np.sqrt(factor)
    return stretched


def scale(vertices, factor, *, centre=None, bounds=None) -> np.ndarray:
    """x' = c + factor (x - c); factor: one positive number, or one an axis (3,)."""
    factors = np.asarray(factor, dtype=np.float64)
    if factors.shape not in ((), (3,)) or not np.isfinite(factors).all() or (factors <= 0.0).any():
        raise ValueError(f"scale needs one positive factor or three, got {factor}")
    vertices, _, centre = _prepared(vertices, bounds, centre)
    return centre + (vertices - centre) * factors


def translate(vertices, offset) -> np.ndarray:
    """x' = x + offset; offset (3,)."""
    return as_host_points(vertices, name="vertices") + _vector(offset, "offset")


def rotate(vertices, degrees, *, axis="z", centre=None, bounds=None) -> np.ndarray:
    """Turn about the line through `centre` along `axis` ("x", "y", "z" or a direction (3,)), by Rodrigues' formula:

    x' = c + cos(a) y + sin(a) k x y + (1 - cos(a)) (k . y) k, with y = x - c and k the axis; anticlockwise seen
    against the axis.
    """
    angle = np.deg2rad(_finite(degrees, "degrees"))
    k = np.eye(3)[axis_index(axis)] if isinstance(axis, str) else _vector(axis, "axis")
    if np.linalg.norm(k) == 0.0:
        raise ValueError("rotate needs an axis that is not (0, 0, 0)")
    k = k / np.linalg.norm(k)
    vertices, _, centre = _prepared(vertices, bounds, centre)
    y = vertices - centre
    return centre + np.cos(angle) * y + np.sin(angle) * np.cross(k, y) + (1.0 - np.cos(angle)) * np.outer(y @ k, k)


def move(vertices, offset, *, group=None, centre=None, radius: float | None = None) -> np.ndarray:
    """Move a group of vertices by `offset` (3,), and their surroundings less and less: x' = x + w(d / radius) offset.

    group: vertex numbers (k,), d the distance to the nearest of them; or centre (3,), d the distance to it. radius:
    world units, where the effect ends; None moves the group alone. w(t) = (1 - t)^2 (1 + 2 t), smooth at both ends.
    """
    vertices, offset = as_host_points(vertices, name="vertices"), _vector(offset, "offset")
    if (group is None) == (centre is None):
        raise ValueError("move needs a group of vertices or a centre, one of both")
    if radius is not None and _finite(radius, "radius") <= 0.0:
        raise ValueError(f"radius must be positive, got {radius}")
    if centre is not None:
        if radius is None:
            raise ValueError("move about a centre needs a radius")
        distance = np.linalg.norm(vertices - _vector(centre, "centre"), axis=1)
    else:
        group = np.atleast_1d(np.asarray(group))
        whole = group.dtype.kind in "iu" and group.ndim == 1 and len(group)
        if not whole or group.min() < 0 or group.max() >= len(vertices):
            raise ValueError(f"group must be vertex numbers from 0 to {len(vertices) - 1}, at least one")
        distance = np.array([np.linalg.norm(vertices[group] - x, axis=1).min() for x in vertices])
        if radius is None:
            distance, radius = np.where(np.isin(np.arange(len(vertices)), group), 0.0, 1.0), 1.0
    t = np.clip(distance / radius, 0.0, 1.0)
    return vertices + ((1.0 - t) ** 2 * (1.0 + 2.0 * t))[:, None] * offset


def axis_index(axis) -> int:
    """0, 1 or 2 for "x", "y" or "z". Raises ValueError for anything else."""
    if not isinstance(axis, str) or len(axis) != 1 or axis not in AXES:
        raise ValueError(f"axis must be 'x', 'y' or 'z', got {axis!r}")
    return AXES.index(axis)


def _signed_axis(name) -> tuple[float, int]:
    if isinstance(name, str) and name[:1] in ("-", "+"):
        return (-1.0 if name[0] == "-" else 1.0), axis_index(name[1:])
    return 1.0, axis_index(name)


def _prepared(vertices, bounds, centre):
    """Vertices, bounds and centre as float64, with their defaults."""
    vertices = as_host_points(vertices, name="vertices")
    if bounds is None:
        if not len(vertices):
            raise ValueError("a pose needs at least one vertex, or bounds")
        bounds = np.stack([vertices.min(axis=0), vertices.max(axis=0)])
    bounds = np.asarray(bounds, dtype=np.float64)
    if bounds.shape != (2, 3) or not np.isfinite(bounds).all() or (bounds[1] < bounds[0]).any():
        raise ValueError(f"bounds must be (2, 3), the lower corner first, got {bounds.tolist()}")
    return vertices, bounds, bounds.mean(axis=0) if centre is None else _vector(centre, "centre")


def _limits(limits, bounds, along) -> tuple[float, float]:
    """Where the limits begin along the axis and how far apart they are, world units."""
    shares = np.asarray(limits, dtype=np.float64)
    if shares.shape != (2,) or not np.isfinite(shares).all() or not shares[0] < shares[1]:
        raise ValueError(f"limits must be two shares of the bounding box, the lower first, got {limits}")
    extent = bounds[1, along] - bounds[0, along]
    if extent == 0.0:
        raise ValueError(f"there is nothing to pose along axis {AXES[along]!r}: the bounding box is flat there")
    return bounds[0, along] + shares[0] * extent, (shares[1] - shares[0]) * extent


def _share(vertices, limits, bounds, along) -> np.ndarray:
    start, length = _limits(limits, bounds, along)
    return np.clip((vertices[:, along] - start) / length, 0.0, 1.0)


def _finite(value, name: str) -> float:
    if not np.isscalar(value) or isinstance(value, str) or not np.isfinite(value):
        raise ValueError(f"{name} must be one finite number, got {value!r}")
    return float(value)


def _positive(factor) -> float:
    if _finite(factor, "factor") <= 0.0:
        raise ValueError(f"factor must be positive, got {factor}")
    return float(factor)


def _vector(value, name: str) -> np.ndarray:
    vector = np.asarray(value, dtype=np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"{name} must be 3 finite numbers, got {value}")
    return vector
