"""Lenses that see more than a pinhole camera does, and the pinhole views that their pictures become."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import numpy as np

from ..errors import InputError

#: Focal lengths and principal point (fx, fy, cx, cy), pixels.
Intrinsics = tuple[float, float, float, float]

#: Pixels by which pictures of another size may miss the shape of those that a camera is for: sides are rounded.
ROUNDING = 1.0

#: Shares of a side by which a principal point may miss the middle; further off, it is that of pictures of another size.
FURTHEST_MIDDLE = 0.25


def intrinsics_at(
    given: Intrinsics, size: tuple[float, float], actual: tuple[int, int], where: str, rounding: float = ROUNDING
) -> Intrinsics:
    """The intrinsics of a picture of the same shape as one of `size`, width and height, that they are given for.
    rounding: pixels by which it may miss that shape."""
    across, down = actual[0] / size[0], actual[1] / size[1]
    if abs(across - down) * max(size) > rounding * max(1.0, across, down):
        raise InputError(
            f"{where}: the camera is for {size[0]:g}x{size[1]:g} pixels, its picture has {actual[0]}x{actual[1]}, "
            "which is another shape"
        )
    fx, fy, cx, cy = given[0] * across, given[1] * down, given[2] * across, given[3] * down
    if max(abs(cx / actual[0] - 0.5), abs(cy / actual[1] - 0.5)) > FURTHEST_MIDDLE:
        raise InputError(
            f"{where}: the principal point ({cx:g}, {cy:g}) is far from the middle of a picture of "
            f"{actual[0]}x{actual[1]} pixels: it is that of pictures of another size"
        )
    return fx, fy, cx, cy


#: Takes rays (x, y, z) of any shape and a lens's values to where they meet the picture, in focal lengths from the
#: principal point; NaN where they do not.
Projection = Callable[..., tuple[np.ndarray, np.ndarray]]

#: Degrees that one pinhole view may see across; wider pictures become the sides of a cube.
WIDEST = 100.0

#: Angles from the axis that are looked at to find out how far a lens sees.
STEPS = 4096

#: A side of the cube is made where so much of it is seen, on a grid of so many places.
MIN_SEEN, SEEN_GRID = 0.01, 65

#: A view has at most this many times as many pixels as the picture.
MAX_PIXELS = 4.0


def _angles(x, y, z, *values: float) -> tuple[np.ndarray, np.ndarray]:
    """The angle from the axis instead of its tangent, times 1 + k1 t^2 + k2 t^4 ...: OpenCV's fisheye model."""
    across = np.hypot(x, y)
    angle = np.arctan2(across, z)
    scale = np.where(across > 0, angle / np.where(across > 0, across, 1.0), 1.0) * _powers(angle * angle, values)
    return x * scale, y * scale


def _powers(square, values) -> np.ndarray:
    """1 + k1 s + k2 s^2 and so on."""
    total = np.zeros_like(square)
    for value in reversed(values):
        total = square * (value + total)
    return 1.0 + total


def _planar(x, y, z) -> tuple[np.ndarray, np.ndarray]:
    """The pinhole's plane; NaN behind the camera."""
    depth = np.where(z > 0, z, np.nan)
    return x / depth, y / depth


def _thin_prism(x, y, z, k1, k2, p1, p2, k3, k4, s1, s2) -> tuple[np.ndarray, np.ndarray]:
    # COLMAP's THIN_PRISM_FISHEYE (Weng et al. 1992), as ETH3D has it
    u, v = _angles(x, y, z)
    square = u * u + v * v
    radial = _powers(square, (k1, k2, k3, k4))
    return (
        u * radial + 2 * p1 * u * v + p2 * (square + 2 * u * u) + s1 * square,
        v * radial + 2 * p2 * u * v + p1 * (square + 2 * v * v) + s2 * square,
    )


def _rad_tan_thin_prism(x, y, z, *values: float) -> tuple[np.ndarray, np.ndarray]:
    # Project Aria's FISHEYE624, with its radial polynomial as OpenCV's
    p0, p1, s0, s1, s2, s3 = values[6:]
    u, v = _angles(x, y, z, *values[:6])
    square = u * u + v * v
    common = 2 * (u * p0 + v * p1)
    return (
        u + u * common + p0 * square + square * (s0 + s1 * square),
        v + v * common + p1 * square + square * (s2 + s3 * square),
    )


def _field_of_view(x, y, z, omega) -> tuple[np.ndarray, np.ndarray]:
    # Devernay and Faugeras 2001
    u, v = _planar(x, y, z)
    radius, tangent = np.hypot(u, v), 2 * np.tan(0.5 * omega)
    small = radius * abs(tangent) < 1e-6
    ratio = np.where(small, tangent, np.arctan(radius * tangent) / np.where(small, 1.0, radius))
    scale = ratio / omega if omega else np.ones_like(radius)
    return u * scale, v * scale


def _division(x, y, z, k) -> tuple[np.ndarray, np.ndarray]:
    # Fitzgibbon 2001: r_pinhole = r / (1 + k r^2), solved for r
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = 2 / (z + np.sqrt(z * z - 4 * k * (x * x + y * y)))
        scale = np.where(scale > 0, scale, np.nan)
    return x * scale, y * scale


def _unified(x, y, z, alpha, beta) -> tuple[np.ndarray, np.ndarray]:
    # the enhanced unified camera model, Khomutenko et al. 2016
    depth = alpha * np.sqrt(beta * (x * x + y * y) + z * z) + (1 - alpha) * z
    depth = np.where(depth > 0, depth, np.nan)
    return x / depth, y / depth


def _opensfm(x, y, z, transition, p1, p2, s0, s1, s2, s3, *radial: float) -> tuple[np.ndarray, np.ndarray]:
    # OpenSfM's fisheye62, fisheye624 and dual, by its source: a pinhole's share of the place, then what bends it
    u, v = _angles(x, y, z)
    if transition:
        a, b = _planar(x, y, z)
        u, v = u + transition * (a - u), v + transition * (b - v)
    square = u * u + v * v
    bent = _powers(square, radial)
    return (
        u * bent + 2 * p1 * u * v + p2 * (square + 2 * u * u) + square * (s0 + s1 * square),
        v * bent + 2 * p2 * u * v + p1 * (square + 2 * v * v) + square * (s2 + s3 * square),
    )


def _all_around(x, y, z) -> tuple[np.ndarray, np.ndarray]:
    """Longitude and latitude, radians: an equirectangular picture."""
    return np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))


def all_around(size: tuple[int, int]) -> Intrinsics:
    """The intrinsics, pixels, of an equirectangular picture."""
    return size[0] / (2 * np.pi), size[1] / np.pi, size[0] / 2, size[1] / 2


def _metashape(x, y, z, fisheye, skew, k1, k2, k3, k4, p1, p2, p3, p4) -> tuple[np.ndarray, np.ndarray]:
    # Agisoft Metashape's manual, appendix D
    u, v = _angles(x, y, z) if fisheye else _planar(x, y, z)
    square = u * u + v * v
    radial, growth = _powers(square, (k1, k2, k3, k4)), _powers(square, (p3, p4))
    a = u * radial + (p1 * (square + 2 * u * u) + 2 * p2 * u * v) * growth
    b = v * radial + (p2 * (square + 2 * v * v) + 2 * p1 * u * v) * growth
    return a + skew * b, b


#: Where lenses put rays, by their names.
PROJECTIONS: dict[str, Projection] = {
    "FISHEYE": _angles,
    "FISHEYE624": _rad_tan_thin_prism,
    "THIN_PRISM_FISHEYE": _thin_prism,
    "FOV": _field_of_view,
    "DIVISION": _division,
    "EUCM": _unified,
    "EQUIRECTANGULAR": _all_around,
    "METASHAPE": _metashape,
    "OPENSFM": _opensfm,
}


@dataclasses.dataclass(frozen=True)
class Lens:
    """A lens by its model and the values of that."""

    model: str  # of PROJECTIONS
    values: tuple[float, ...] = ()

    @property
    def is_round(self) -> bool:
        """Whether its pictures go all around, so that their left edge continues at the right one."""
        return self.model == "EQUIRECTANGULAR"

    def project(self, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where rays (..., 3) in the camera's axes meet the picture, in focal lengths from the principal point; NaN
        where they do not."""
        x, y, z = np.moveaxis(rays, -1, 0)
        with np.errstate(all="ignore"):
            return PROJECTIONS[self.model](x, y, z, *self.values)

    @functools.cached_property
    def reach(self) -> float:
        """The angle from the axis, radians, up to which places in the picture move outwards on all sides."""
        if self.is_round:
            return np.pi
        angles = np.linspace(0.0, np.pi, STEPS + 1)[:-1]  # the other side of the axis has no direction
        turns = np.linspace(0.0, 2 * np.pi, 16, endpoint=False)[:, None]
        x, y, z = np.sin(angles) * np.cos(turns), np.sin(angles) * np.sin(turns), np.cos(angles)
        a, b = self.project(np.stack(np.broadcast_arrays(x, y, z), axis=-1))
        with np.errstate(all="ignore"):
            outwards = np.diff(a * np.cos(turns) + b * np.sin(turns), axis=1) > 0  # false for NaN
        stops = np.argmin(np.concatenate([outwards, np.zeros((len(turns), 1), bool)], axis=1), axis=1)
        return float(angles[stops.min()])

    def pixels(self, rays: np.ndarray, intrinsics: Intrinsics, size: tuple[int, int]) -> tuple[np.ndarray, ...]:
        """Pixels u and v of rays (..., 3) in a picture, and whether they are in it."""
        a, b = self.project(rays)
        u, v = a * intrinsics[0] + intrinsics[2], b * intrinsics[1] + intrinsics[3]
        near = np.arctan2(np.hypot(rays[..., 0], rays[..., 1]), rays[..., 2]) <= self.reach
        with np.errstate(invalid="ignore"):
            seen = near & (u >= 0) & (u <= size[0]) & (v >= 0) & (v <= size[1])
        return np.where(seen, u, 0.0), np.where(seen, v, 0.0), seen


@dataclasses.dataclass(frozen=True)
class Part:
    """A pinhole view into the picture of a lens."""

    name: str  # of a side of the cube; "" where the view is the whole
    rotation: np.ndarray  # (3, 3) from the axes of the view to those of the camera
    intrinsics: Intrinsics  # of the view, pixels
    size: tuple[int, int]  # width and height of the view, pixels

    def rays(self, columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Directions (rows, columns, 3) in the camera's axes through places of the view, pixels."""
        fx, fy, cx, cy = self.intrinsics
        x, y = np.meshgrid((columns - cx) / fx, (rows - cy) / fy)
        return np.stack([x, y, np.ones_like(x)], axis=-1) @ self.rotation.T


#: Sides of a cube around a camera: where x, y and z of their views point in the camera's axes.
SIDES = {
    "front": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "right": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "back": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    "left": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "up": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "down": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}


def pinhole_parts(lens: Lens, intrinsics: Intrinsics, size: tuple[int, int], where: str) -> list[Part]:
    """The pinhole views that show what a picture of a lens does: one that reaches the middles of its edges, or where
    that is too wide those sides of a cube of which something is seen; as fine as the picture is on average."""
    left, right, top, bottom = (_extent(lens, intrinsics, size, way) for way in ((-1, 0), (1, 0), (0, -1), (0, 1)))
    if not min(left + right, top + bottom) > 0:
        raise InputError(f"{where}: {lens.model} sees nothing with {', '.join(f'{value:g}' for value in lens.values)}")
    if max(left + right, top + bottom) <= np.radians(WIDEST):
        width, height = np.tan(left) + np.tan(right), np.tan(top) + np.tan(bottom)
        focal = np.sqrt(size[0] * size[1] / (width * height))
        shape = max(1, round(focal * width)), max(1, round(focal * height))
        center = (np.tan(left) * shape[0] / width, np.tan(top) * shape[1] / height)
        parts = [Part("", np.eye(3), (shape[0] / width, shape[1] / height, *center), shape)]
    else:
        side = max(1, round(float(np.sqrt(abs(intrinsics[0] * intrinsics[1]))) * np.pi / 2))
        pinhole = (side / 2, side / 2, side / 2, side / 2)
        parts = [Part(name, np.array(axes, np.float64).T, pinhole, (side, side)) for name, axes in SIDES.items()]
    for part in parts:
        if max(part.size) > MAX_PIXELS * max(size):
            raise InputError(f"{where}: {lens.model} would become views of {part.size[0]}x{part.size[1]} pixels")
    return [part for part in parts if not part.name or _seen_share(part, lens, intrinsics, size) >= MIN_SEEN]


def _extent(lens: Lens, intrinsics: Intrinsics, size: tuple[int, int], way: tuple[int, int]) -> float:
    """The angle, radians, up to which a picture reaches from the axis of its lens in a direction (x, y)."""
    angles = np.linspace(0.0, lens.reach, STEPS + 1)
    rays = np.stack([np.sin(angles) * way[0], np.sin(angles) * way[1], np.cos(angles)], axis=-1)
    seen = lens.pixels(rays, intrinsics, size)[2]
    return float(angles[-1 if seen.all() else max(int(np.argmin(seen)) - 1, 0)])


def _seen_share(part: Part, lens: Lens, intrinsics: Intrinsics, size: tuple[int, int]) -> float:
    """How much of a view is in the picture."""
    places = (np.arange(SEEN_GRID) + 0.5) / SEEN_GRID
    rays = part.rays(places * part.size[0], places * part.size[1])
    return float(lens.pixels(rays, intrinsics, size)[2].mean())
