"""Poses as functions of vertices (bend, twist, taper, stretch, scale, rotate, move), and as methods of a mesh."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeGuard, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import PointsLike, as_host_points, box_corners
from ..core.checks import AXES, axis_index, checked_number, checked_positive, checked_vector, real_array, renamed, shown
from ..errors import InputError
from ..mesh.mesh import ClosedMesh, own_axis, principal_axes
from . import random_poses


def direction(axis: str | ArrayLike, name: str = "axis") -> np.ndarray:
    """The unit vector (3,) of an axis: "x", "-x", or a direction (3,) of any length; messages call it by `name`."""
    if isinstance(axis, str):
        sign, index = signed_axis(axis)
        return sign * np.eye(3)[index]
    vector = checked_vector(axis, name)
    longest = np.abs(vector).max()
    if longest == 0.0:
        raise InputError(f"{name} must be a direction, got (0, 0, 0)")
    vector = vector / longest  # its square may be beyond float64
    return vector / np.linalg.norm(vector)


def signed_axis(name: str) -> tuple[float, int]:
    """Sign and number of an axis such as "-x"."""
    if isinstance(name, str) and name[:1] in ("-", "+"):
        return (-1.0 if name[0] == "-" else 1.0), axis_index(name[1:])
    return 1.0, axis_index(name)


def _is_plain(axis: str | ArrayLike) -> TypeGuard[str]:
    """Whether an axis is named, and not against it ("-x")."""
    return isinstance(axis, str) and not axis.startswith("-")


def frame_along(axis: str | ArrayLike, towards: str | ArrayLike | None = None) -> np.ndarray:
    """Unit vectors x, y and z, one a row (3, 3): z along `axis`, x to what is across it of `towards` (None: any)."""
    w = direction(axis, "axis")
    aim = np.eye(3)[int(np.argmin(np.abs(w)))] if towards is None else direction(towards, "towards")
    u = aim - (aim @ w) * w
    if np.linalg.norm(u) < 1e-6:
        raise InputError(f"a bend needs two different directions, got axis {axis} and towards {towards}")
    u /= np.linalg.norm(u)
    return np.stack([u, np.cross(w, u), w])


def bend(
    vertices: PointsLike,
    degrees: float,
    *,
    axis: str | ArrayLike = "z",
    towards: str | ArrayLike = "x",
    limits: Sequence[float] = (0.0, 1.0),
    center: ArrayLike | None = None,
    bounds: ArrayLike | None = None,
) -> np.ndarray:
    """Bend the straight line through the centre along an axis into a circular arc towards another axis.
    `towards` may be "-x", against an axis, or a direction (3,), of which what is across the axis counts."""
    if not (_is_plain(axis) and isinstance(towards, str)):
        return _along(bend, vertices, degrees, axis, towards, limits=limits, center=center, bounds=bounds)
    angle, along = np.deg2rad(checked_number(degrees, "degrees")), axis_index(axis)
    sign, across = signed_axis(towards)
    if across == along:
        raise InputError(f"bend needs two different axes, got axis {axis!r} and towards {towards!r}")
    rest, box, middle = _prepared(vertices, bounds, center)
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
    center: ArrayLike | None = None,
    bounds: ArrayLike | None = None,
) -> np.ndarray:
    """Turn each slice across an axis about the line through the centre by t * degrees.
    The angle is anticlockwise seen against the axis."""
    if not _is_plain(axis):
        return _along(twist, vertices, degrees, axis, limits=limits, center=center, bounds=bounds)
    angle, along = np.deg2rad(checked_number(degrees, "degrees")), axis_index(axis)
    rest, box, middle = _prepared(vertices, bounds, center)
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
    center: ArrayLike | None = None,
    bounds: ArrayLike | None = None,
) -> np.ndarray:
    """Scale each slice across an axis about the line through the centre by 1 + (factor - 1) t."""
    if not _is_plain(axis):
        return _along(taper, vertices, factor, axis, limits=limits, center=center, bounds=bounds)
    factor, along = checked_positive(factor, "factor"), axis_index(axis)
    rest, box, middle = _prepared(vertices, bounds, center)
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
    center: ArrayLike | None = None,
    bounds: ArrayLike | None = None,
) -> np.ndarray:
    """Make what lies between the limits longer: w' = w + (factor - 1) s.
    `keep_volume` scales across the axis by 1 / sqrt(factor), about the line, and needs the limits (0, 1)."""
    if not _is_plain(axis):
        kept = {"keep_volume": keep_volume, "limits": limits}
        return _along(stretch, vertices, factor, axis, center=center, bounds=bounds, **kept)
    factor, along = checked_positive(factor, "factor"), axis_index(axis)
    rest, box, middle = _prepared(vertices, bounds, center)
    start, length = _limits(limits, box, along)
    stretched = rest.copy()
    stretched[:, along] += (factor - 1.0) * np.clip(rest[:, along] - start, 0.0, length)
    if keep_volume:
        if tuple(limits) != (0.0, 1.0):
            raise InputError(f"keep_volume stretches the whole length: limits must be (0, 1), got {tuple(limits)}")
        across = np.arange(3) != along
        stretched[:, across] = middle[across] + (rest[:, across] - middle[across]) / np.sqrt(factor)
    return stretched


def scale(
    vertices: PointsLike, factor: ArrayLike, *, center: ArrayLike | None = None, bounds: ArrayLike | None = None
) -> np.ndarray:
    """Scale about the centre by one positive factor, or by one for each axis (3,): x' = c + factor (x - c)."""
    factors = np.asarray(factor, dtype=np.float64)
    if factors.shape not in ((), (3,)) or not np.isfinite(factors).all() or (factors <= 0.0).any():
        raise InputError(f"scale needs one positive factor or three, got {factor}")
    rest, _, middle = _prepared(vertices, bounds, center)
    return middle + (rest - middle) * factors


def translate(vertices: PointsLike, offset: ArrayLike) -> np.ndarray:
    """Move all vertices by an offset (3,), world units: x' = x + offset."""
    return as_host_points(vertices, name="vertices") + checked_vector(offset, "offset")


def rotate(
    vertices: PointsLike,
    degrees: float,
    *,
    axis: str | ArrayLike = "z",
    center: ArrayLike | None = None,
    bounds: ArrayLike | None = None,
) -> np.ndarray:
    """Turn by `degrees` about the line through the centre along an axis, anticlockwise seen against it."""
    angle = np.deg2rad(checked_number(degrees, "degrees"))
    k = np.eye(3)[axis_index(axis)] if _is_plain(axis) else direction(axis, "axis")
    rest, _, middle = _prepared(vertices, bounds, center)
    y = rest - middle  # Rodrigues' formula
    return middle + np.cos(angle) * y + np.sin(angle) * np.cross(k, y) + (1.0 - np.cos(angle)) * np.outer(y @ k, k)


def move(
    vertices: PointsLike,
    offset: ArrayLike,
    *,
    group: ArrayLike | None = None,
    center: ArrayLike | None = None,
    radius: float | None = None,
) -> np.ndarray:
    """Move a group (k,) of vertices, or what is near a centre, by an offset (3,), and the surroundings less and less.
    `radius` is where the effect ends, world units; None moves the group alone."""
    rest, step = as_host_points(vertices, name="vertices"), checked_vector(offset, "offset")
    if (group is None) == (center is None):
        raise InputError("move needs either a group of vertices or a centre")
    reach = None if radius is None else checked_positive(radius, "radius")
    if center is not None:
        if reach is None:
            raise InputError("move about a centre needs a radius")
        distance = np.linalg.norm(rest - checked_vector(center, "center"), axis=1)
    else:
        moved = np.atleast_1d(np.asarray(group))
        whole = moved.dtype.kind in "iu" and moved.ndim == 1 and len(moved)
        if not whole or moved.min() < 0 or moved.max() >= len(rest):
            raise InputError(f"group must be vertex numbers from 0 to {len(rest) - 1}, at least one")
        if reach is None:
            distance, reach = np.where(np.isin(np.arange(len(rest)), moved), 0.0, 1.0), 1.0
        else:
            distance = np.array([np.linalg.norm(rest[moved] - x, axis=1).min() for x in rest])
    # x' = x + w(d / reach) step, d to the nearest vertex of the group or the centre, w(t) = (1 - t)^2 (1 + 2 t)
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
    center: ArrayLike | None,
    **options: Any,
) -> np.ndarray:
    """A pose along any direction: that along z, towards x, in axes that lie so."""
    rest, box, middle = _prepared(vertices, bounds, center)
    frame = frame_along(axis, towards)
    points = rest if bounds is None else np.asarray(bounds, dtype=np.float64)
    if bounds is not None and len(points) == 2:
        points = box_corners(box)
    local = points @ frame.T
    extent = np.stack([local.min(axis=0), local.max(axis=0)])
    across = {} if towards is None else {"towards": "x"}
    posed = pose(rest @ frame.T, amount, axis="z", bounds=extent, center=frame @ middle, **across, **options)
    return posed @ frame


def _prepared(
    vertices: PointsLike, bounds: ArrayLike | None, center: ArrayLike | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, bounds and centre as float64, with their defaults."""
    rest = as_host_points(vertices, name="vertices")
    if bounds is None:
        if not len(rest):
            raise InputError("a pose needs at least one vertex, or bounds")
        bounds = np.stack([rest.min(axis=0), rest.max(axis=0)])
    box = np.asarray(bounds, dtype=np.float64)
    if box.ndim == 2 and box.shape[0] > 2 and box.shape[1] == 3:
        box = np.stack([box.min(axis=0), box.max(axis=0)])
    # unlike checked_bounds: a flat cage can be posed along its own plane
    if box.shape != (2, 3) or not np.isfinite(box).all() or (box[1] < box[0]).any():
        raise InputError(f"bounds must be (2, 3), the lower corner first, got {box.tolist()}")
    return rest, box, box.mean(axis=0) if center is None else checked_vector(center, "center")


def _limits(limits: Sequence[float], bounds: np.ndarray, along: int) -> tuple[float, float]:
    """Where the limits begin along the axis and how far apart they are, world units."""
    shares = real_array(limits, "limits")
    if shares.shape != (2,) or not np.isfinite(shares).all() or not shares[0] < shares[1]:
        raise InputError(f"limits must be two shares of the bounding box, the lower first, got {shown(limits)}")
    extent = bounds[1, along] - bounds[0, along]
    if extent == 0.0:
        raise InputError(f"the bounding box is flat along axis {AXES[along]!r}: pose along another axis")
    return bounds[0, along] + shares[0] * extent, (shares[1] - shares[0]) * extent


def _share(vertices: np.ndarray, limits: Sequence[float], bounds: np.ndarray, along: int) -> np.ndarray:
    """t of each vertex."""
    start, length = _limits(limits, bounds, along)
    return np.clip((vertices[:, along] - start) / length, 0.0, 1.0)


Posed = TypeVar("Posed", bound="PosableMesh")


class PosableMesh(ClosedMesh):
    """A closed mesh with the poses of this module as methods; the functions hold the formulas."""

    __slots__ = ()

    @renamed(center="centre")
    def bend(
        self: Posed,
        degrees: float,
        *,
        axis: str | ArrayLike = "z",
        towards: str | ArrayLike = "x",
        limits: Sequence[float] = (0.0, 1.0),
        center: ArrayLike | None = None,
    ) -> Posed:
        """Bend the mesh along an axis into a circular arc; see `warpcage.cage.poses.bend`.

        Args:
            degrees: Angle of the arc.
            axis: "x", "y", "z" or "-x", the axis that is bent; one of the mesh's own, "long", "middle" or "short" (see
                `principal_axes`); or a direction (3,) of any length.
            towards: The direction that it is bent to: another axis, "-x" against it, or a direction (3,), of which what
                is across the axis counts.
            limits: (2,) where the arc begins and ends, as shares of the bounding box along the axis. What is beyond
                follows rigidly.
            center: (3,) a point on the line that is bent, world units. None is the middle of the bounding box.

        Returns:
            The pose.

        Raises:
            ValueError: For values that are not finite, and for other axes or limits.
        """
        return self._posed(bend, degrees, axis=axis, towards=towards, limits=limits, center=center)

    @renamed(center="centre")
    def twist(
        self: Posed,
        degrees: float,
        *,
        axis: str | ArrayLike = "z",
        limits: Sequence[float] = (0.0, 1.0),
        center: ArrayLike | None = None,
    ) -> Posed:
        """Turn the mesh about an axis by an angle that grows along it; see `warpcage.cage.poses.twist`.

        Args:
            degrees: Angle at the upper limit, anticlockwise seen against the axis.
            axis: "x", "y", "z", "-x", "long", "middle", "short", or a direction (3,).
            limits: (2,) where the angle begins and ends to grow, as shares of the bounding box along the axis.
            center: (3,) a point on the line that it turns about, world units. None is the middle of the bounding box.

        Returns:
            The pose.

        Raises:
            ValueError: For values that are not finite, and for other axes or limits.
        """
        return self._posed(twist, degrees, axis=axis, limits=limits, center=center)

    @renamed(center="centre")
    def taper(
        self: Posed,
        factor: float,
        *,
        axis: str | ArrayLike = "z",
        limits: Sequence[float] = (0.0, 1.0),
        center: ArrayLike | None = None,
    ) -> Posed:
        """Scale the mesh across an axis by a factor that changes along it; see `warpcage.cage.poses.taper`.

        Args:
            factor: Factor at the upper limit, positive; it is 1 at the lower.
            axis: "x", "y", "z", "-x", "long", "middle", "short", or a direction (3,).
            limits: (2,) where the factor begins and ends to change, as shares of the bounding box along the axis.
            center: (3,) a point on the line that it scales about, world units. None is the middle of the bounding box.

        Returns:
            The pose.

        Raises:
            ValueError: For a factor that is not positive and finite, and for other axes or limits.
        """
        return self._posed(taper, factor, axis=axis, limits=limits, center=center)

    @renamed(center="centre")
    def stretch(
        self: Posed,
        factor: float,
        *,
        axis: str | ArrayLike = "z",
        limits: Sequence[float] = (0.0, 1.0),
        keep_volume: bool = False,
        center: ArrayLike | None = None,
    ) -> Posed:
        """Make the mesh longer along an axis; see `warpcage.cage.poses.stretch`.

        Args:
            factor: Length afterwards over length before, positive.
            axis: "x", "y", "z", "-x", "long", "middle", "short", or a direction (3,).
            limits: (2,) what is stretched, as shares of the bounding box along the axis. What is beyond moves along.
            keep_volume: Whether to make it thinner across the axis by the square root of the factor. This needs the
                limits (0, 1).
            center: (3,) a point on the line that it gets thinner about, world units. None is the middle of the
                bounding box.

        Returns:
            The pose.

        Raises:
            ValueError: For a factor that is not positive and finite, and for other axes or limits.
        """
        return self._posed(stretch, factor, axis=axis, limits=limits, keep_volume=keep_volume, center=center)

    @renamed(center="centre")
    def scale(self: Posed, factor: ArrayLike, *, center: ArrayLike | None = None) -> Posed:
        """Scale the mesh about a point.

        Args:
            factor: One positive number, or (3,) one for each axis.
            center: (3,) the point that stays, world units. None is the middle of the bounding box.

        Returns:
            The pose.

        Raises:
            ValueError: For factors that are not positive and finite.
        """
        return self._posed(scale, factor, center=center)

    def translate(self: Posed, offset: ArrayLike) -> Posed:
        """Move the mesh.

        Args:
            offset: (3,) world units.

        Returns:
            The pose.

        Raises:
            ValueError: For anything but 3 finite numbers.
        """
        return self.with_vertices(translate(self.vertices, offset))

    @renamed(center="centre")
    def rotate(self: Posed, degrees: float, *, axis: str | ArrayLike = "z", center: ArrayLike | None = None) -> Posed:
        """Turn the mesh about an axis.

        Args:
            degrees: Angle, anticlockwise seen against the axis.
            axis: "x", "y", "z", "-x", "long", "middle", "short", or a direction (3,) of any length.
            center: (3,) a point on the axis, world units. None is the middle of the bounding box.

        Returns:
            The pose.

        Raises:
            ValueError: For values that are not finite, and for another axis.
        """
        return self._posed(rotate, degrees, axis=axis, center=center)

    @renamed(center="centre")
    def move(
        self: Posed,
        offset: ArrayLike,
        *,
        group: ArrayLike | None = None,
        center: ArrayLike | None = None,
        radius: float | None = None,
    ) -> Posed:
        """Move some vertices, and their surroundings less and less; see `warpcage.cage.poses.move`.

        Args:
            offset: (3,) world units.
            group: (k,) numbers of the vertices that are moved. None moves what is near `centre`.
            center: (3,) the point about which vertices are moved, world units. None where there is a group.
            radius: Distance from the group or the centre where the effect ends, world units. None moves the group
                alone.

        Returns:
            The pose.

        Raises:
            ValueError: Without a group and a centre or with both, for a centre without a radius, for a radius that is
                not positive, or numbers of no vertices.
        """
        return self.with_vertices(move(self.vertices, offset, group=group, center=center, radius=radius))

    def random_pose(
        self: Posed,
        seed: int = 0,
        number: int = 0,
        *,
        stretch: Sequence[float] = random_poses.DEFAULT_STRETCH,
        reach: Sequence[float] = random_poses.DEFAULT_REACH,
        modes: Sequence[str] = random_poses.POSE_MODES,
    ) -> Posed:
        """A random plausible pose: smooth, without folds, within bounds of stretch; see `warpcage.RandomPoses`.

        That class makes many poses sooner.

        Args:
            seed: Another one gives other poses.
            number: The pose's number among those of the seed, from 0.
            stretch: (2,) least and largest length in the pose over the length at rest.
            reach: (2,) shares between which the pose's share of the farthest that the bounds allow lies.
            modes: Which of "bend", "twist", "stretch", "taper", "wave" and "bump" may act.

        Returns:
            The pose.

        Raises:
            ValueError: For a mesh that is not usable, and for options that cannot be.
        """
        made = random_poses.RandomPoses(self, seed=seed, stretch=stretch, reach=reach, modes=modes)
        return made.pose(number)

    @property
    def principal_axes(self) -> np.ndarray:
        """(3, 3) unit vectors, one a row: the directions in which the surface reaches farthest, less and least.

        They are the principal axes of the surface's area, right-handed, each towards the positive side of the world
        axis that it is nearest to. In poses they are called "long", "middle" and "short", with "-long" against it.
        """
        return principal_axes(self)[0]

    def _posed(self: Posed, pose: Callable[..., np.ndarray], *arguments: Any, **options: Any) -> Posed:
        """A pose relative to the bounding box of the vertices in use."""
        for name in ("axis", "towards"):
            if isinstance(options.get(name), str):
                options[name] = own_axis(self, options[name])
        oblique = any(not isinstance(options.get(name, "z"), str) for name in ("axis", "towards"))
        bounds = self.vertices[self.topology.used_vertices] if oblique else self.bounds
        return self.with_vertices(pose(self.vertices, *arguments, bounds=bounds, **options))
