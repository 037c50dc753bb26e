"""Where the object of a scene is: the places that cameras look at, and the box around the matter there."""

from __future__ import annotations

import dataclasses
import os
import pathlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np

from ..core.names import agreed, counted
from ..errors import InputError
from ..view.camera import Camera, common_up

if TYPE_CHECKING:
    from .scene import Scene

#: Where all cameras look the same way, the object is taken to be this many times their largest spread ahead.
PARALLEL_DISTANCE = 4.0

#: Optical axes whose equations are conditioned worse than this are taken to be parallel.
MAX_CONDITION = 1e6

#: Seed of what is drawn: pairs of optical axes whose nearest points are tried, and points whose visibility is counted.
SEED, PAIRS, MAX_POINTS = 0, 100, 8000

#: Steps of iteratively reweighted least squares, which end where the point moves by less than this share of its
#: median distance.
MAX_STEPS, STILL = 30, 1e-6

#: What is nearer to a camera than this share of the greatest distance of one from their middle is not looked at.
TOUCHING = 1e-6

#: A look is kept where so many cameras and such a share of all support it; at most so many are looked for.
MIN_SUPPORTERS, SUPPORTER_SHARE, MAX_LOOKS = 5, 0.2, 3

#: Matter is looked at where it lies in this middle part of the pictures of such a share of a look's cameras, and nearer
#: to the look's point than this share of the distance of the nearest tenth of them.
MIDDLE, SEEN_SHARE, NEAR_SHARE, NEAR_PERCENTILE = 0.6, 0.7, 0.9, 10.0

#: Fewer points say nothing about where the object is.
MIN_POINTS = 50

#: A point is no outlier where so many others are within this share of the diagonal of the bulk of them.
NEIGHBORS, NEIGHBOR_RADIUS = 5, 0.03

#: A box reaches upwards along axes with more of the direction up than this.
UPWARD = 0.5

#: What a box has beyond the bulk of its points, of the longest side; without points its half side over the radius of
#: the object that a camera sees whole, at most such a share of the distance of the nearest cameras.
MARGIN, CUBE_ROOM, CUBE_SHARE, CUBE_PERCENTILE = 0.1, 1.2, 0.9, 5.0

#: How much larger a box is than the rule has it.
ROOM = 1.0

#: No side is shorter than this share of the longest, as long as no more than this share of the cameras come to be in
#: the box, or nearer to it than this share of its sides; it grows and shrinks by such steps.
SIDE_SHARE, INSIDE_SHARE, CLEAR, STEP = 0.5, 0.02, 1.05, 1.05

#: The reason of boxes that silhouettes shrank.
OUTLINED = "within the object's outlines in the pictures"

#: Where cameras look at nothing in common, the box's half side over the distance of most of them from the middle one.
PLACE_ROOM, PLACE_PERCENTILE = 1.5, 90.0

#: Half side over the radius of the object of the cube that silhouettes are carved in; most it may be of the distance.
CARVED_ROOM, MAX_OF_DISTANCE = 1.2, 0.95


class Hull(Protocol):
    """The visual hull of silhouettes."""

    def bound(self, box: np.ndarray) -> np.ndarray:
        """A box (2, 3) shrunk to the hull."""
        ...


@dataclasses.dataclass(frozen=True, eq=False)
class Look:
    """A place that several cameras look at."""

    point: np.ndarray  # (3,) float64, world units
    cameras: np.ndarray  # (k,) int64, those that have it within half the shorter side of their picture of its middle


@dataclasses.dataclass(frozen=True, eq=False)
class FoundBox:
    """Where the object of a scene is."""

    bounds: np.ndarray  # (2, 3) float64, lower and upper corner of its box, world units
    looks: tuple[Look, ...]  # what cameras look at, the place with most of them first
    reason: str  # one line on where it comes from


def find_box(
    cameras: Sequence[Camera], points: np.ndarray | None = None, silhouettes: Hull | None = None, *, room: float = ROOM
) -> FoundBox:
    """The box around what cameras look at, within silhouettes if given, or else among points (n, 3); `room`: a factor.
    Around the cameras where they look at nothing in common. ValueError where its size cannot be determined."""
    # Where: a robust mean of where the axes meet, as cameras that look away, or are near what they show, must not move
    # it. What: points in the middle of most of the pictures that look there; that others hide some only lowers a share.
    looks = find_looks(cameras)
    if silhouettes is not None:  # points may all lie around what they cut out
        return FoundBox(silhouettes.bound(_carved_cube(cameras)), looks, OUTLINED)
    if not looks:
        return _place(cameras)
    matter = [_matter(cameras, look, points) for look in looks]
    counts = [count for _, count in matter]
    boxes = np.stack([_scaled(_require_size(box), room) for box, _ in matter])
    box = np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])
    reason = _reason(cameras, looks, counts)
    if len(looks) > 1 and not _is_clear(box, cameras):  # they walk between the places
        box, reason = boxes[0], f"{reason}; the box is around the first"
    return FoundBox(_without_cameras(box, cameras), looks, reason)


def scene_box(scene: Scene, silhouettes: Hull | None = None) -> FoundBox:
    """The box of a scene's object: its bounds, or else what its cameras look at; within the silhouettes if given."""
    if scene.bounds is None or (silhouettes is not None and are_found(scene)):
        return find_box(scene.cameras, scene.points, silhouettes)
    found = scene.found
    if found is None or not are_found(scene):
        found = FoundBox(scene.bounds, find_looks(scene.cameras), "as the scene's files give it")
    if silhouettes is None:
        return found
    return FoundBox(silhouettes.bound(found.bounds), found.looks, f"{found.reason}, {OUTLINED}")


def are_found(scene: Scene) -> bool:
    """Whether the bounds of a scene were found, not given."""
    return scene.found is not None and scene.bounds is not None and np.array_equal(scene.found.bounds, scene.bounds)


def find_looks(cameras: Sequence[Camera]) -> tuple[Look, ...]:
    """The places that at least a fifth of the cameras look at, three at most, that of most cameras first."""
    origin = np.mean([camera.center for camera in cameras], axis=0)  # far from that of the world digits would be lost
    every, found, left = _Axes.of(cameras, origin), [], np.arange(len(cameras))
    least = max(min(MIN_SUPPORTERS, len(cameras)), int(np.ceil(SUPPORTER_SHARE * len(cameras))))
    while len(left) >= least and len(found) < MAX_LOOKS:
        axes = every.chosen(left)
        point = axes.focus(axes.candidates())
        supporters = axes.angles(point)[0] < axes.fields
        if supporters.sum() < least:
            break
        found.append(Look(origin + point, left[supporters]))
        left = left[~supporters]
    return tuple(sorted(found, key=lambda look: -len(look.cameras)))


@dataclasses.dataclass(frozen=True)
class _Axes:
    """Optical axes of cameras, about an origin."""

    centers: np.ndarray  # (n, 3)
    directions: np.ndarray  # (n, 3) unit vectors
    fields: np.ndarray  # (n,) angle from the middle of a picture to its nearer edge, radians

    @classmethod
    def of(cls, cameras: Sequence[Camera], origin: np.ndarray) -> _Axes:
        centers, directions = _centers_and_axes(cameras)
        slopes = [min(camera.width / camera.fx, camera.height / camera.fy) / 2 for camera in cameras]
        return cls(centers - origin, directions, np.arctan(slopes))

    def chosen(self, rows: np.ndarray) -> _Axes:
        return _Axes(self.centers[rows], self.directions[rows], self.fields[rows])

    def angles(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Angles from the axes to points (..., 3), and distances of these: (..., n)."""
        ways = points[..., None, :] - self.centers
        along = (ways * self.directions).sum(axis=-1)
        across = np.linalg.norm(ways - along[..., None] * self.directions, axis=-1)
        distances = np.linalg.norm(ways, axis=-1)
        return np.where(distances > self.least, np.arctan2(across, along), np.pi), np.maximum(distances, self.least)

    @property
    def least(self) -> float:
        """A distance below which nothing is looked at."""
        return TOUCHING * (float(np.abs(self.centers).max()) or 1.0)

    def candidates(self) -> np.ndarray:
        """Points (k, 3) that cameras may look at: where all axes meet, those of pairs, and one ahead."""
        count = len(self.centers)
        pairs = np.random.default_rng(SEED).integers(count, size=(PAIRS, 2))
        rows = [np.arange(count), *pairs[pairs[:, 0] != pairs[:, 1]]]
        meeting = [_nearest(self.centers[each], self.directions[each]) for each in rows]
        return np.stack([_ahead(self.centers, self.directions), *(each for each in meeting if each is not None)])

    def focus(self, candidates: np.ndarray) -> np.ndarray:
        """The point (3,) that most look at, from the best of candidates (k, 3) on."""
        angles, _ = self.angles(candidates)
        point = candidates[np.argmax((1.0 / (1.0 + (2.0 * angles / self.fields) ** 2)).sum(axis=-1))]
        for _ in range(MAX_STEPS):  # Geman and McClure's weights, of angles: lengths over distances
            angle, distance = self.angles(point)
            weights = (angle < 0.5 * np.pi) / (1.0 + (2.0 * angle / self.fields) ** 2) ** 2
            weights /= distance**2
            moved = _nearest(self.centers, self.directions, weights)
            if moved is None:
                break
            still = np.linalg.norm(moved - point) <= STILL * np.median(distance)
            point = moved
            if still:
                break
        return point


def _centers_and_axes(cameras: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Places and directions of view of cameras, (n, 3) each."""
    return np.stack([camera.center for camera in cameras]), np.stack([camera.rotation[:, 2] for camera in cameras])


def _nearest(centers: np.ndarray, directions: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray | None:
    """The point (3,) nearest to axes through centers (n, 3), by least squares; None for one and for parallel ones."""
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    across = across if weights is None else across * weights[:, None, None]
    system = across.sum(axis=0)
    if not np.linalg.cond(system) < MAX_CONDITION:
        return None
    return np.linalg.solve(system, (across @ centers[:, :, None])[..., 0].sum(axis=0))


def axes_meeting(cameras: Sequence[Camera]) -> np.ndarray | None:
    """The point (3,) nearest to all optical axes, by least squares; None for one camera and for parallel ones."""
    return _nearest(*_centers_and_axes(cameras))


def _ahead(centers: np.ndarray, directions: np.ndarray) -> np.ndarray:
    spread = float(np.ptp(centers, axis=0).max())
    return (centers + directions * (PARALLEL_DISTANCE * spread if spread > 0 else 1.0)).mean(axis=0)


def center_ahead(cameras: Sequence[Camera]) -> np.ndarray:
    """A point (3,) ahead of cameras that look the same way, by how far apart they are: nothing says how far it is."""
    return _ahead(*_centers_and_axes(cameras))


def _matter(cameras: Sequence[Camera], look: Look, points: np.ndarray | None) -> tuple[np.ndarray, int]:
    """The box (2, 3) of what a look's cameras see, and of how many points it is; a cube and 0 where too few say."""
    looking = [cameras[index] for index in look.cameras]
    axes = _Axes.of(looking, look.point)
    distances = np.linalg.norm(axes.centers, axis=1)
    central = np.zeros((0, 3)) if points is None else points[central_points(looking, look.point, points)]
    if len(central) < MIN_POINTS:
        # what fills the shorter side of a picture at that distance
        half = CUBE_ROOM * float(np.median(distances * np.sin(axes.fields)))
        near = np.percentile(np.abs(axes.centers).max(axis=1), CUBE_PERCENTILE)
        half = min(half, CUBE_SHARE * float(near))
        return np.stack([look.point - half, look.point + half]), 0
    low, high = np.percentile(central, [1.0, 99.0], axis=0)  # a few are always far off
    # Most points lie on the floor. Above the bulk the box also holds points with others near them: an arm or an ear has
    # few, beside each other, and mistakes of the reconstruction are alone.
    up = common_up(cameras)
    together = central[are_inliers(central, NEIGHBOR_RADIUS * float(np.linalg.norm(high - low)))]
    top, bottom = together.max(axis=0, initial=-np.inf), together.min(axis=0, initial=np.inf)
    high = np.where(up > UPWARD, np.maximum(high, top), high)
    low = np.where(up < -UPWARD, np.minimum(low, bottom), low)
    margin = MARGIN * float((high - low).max())
    return np.stack([low - margin, high + margin]), len(central)


def central_points(cameras: Sequence[Camera], point: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Rows of points (n, 3), some MAX_POINTS of them, near a point (3,) in the middle of most pictures of cameras."""
    distances = [np.linalg.norm(camera.center - point) for camera in cameras]
    reach = NEAR_SHARE * float(np.percentile(distances, NEAR_PERCENTILE))
    near = np.flatnonzero(np.linalg.norm(points - point, axis=1) < reach)
    if len(near) > MAX_POINTS:
        near = np.sort(np.random.default_rng(SEED).choice(near, MAX_POINTS, replace=False))
    seen = np.zeros(len(near), np.int64)
    for camera in cameras:
        pixels, depths = camera.project(points[near])
        size = np.array([camera.width, camera.height])
        with np.errstate(invalid="ignore"):
            seen += (depths > 0) & (np.abs(2.0 * pixels / size - 1.0) < MIDDLE).all(axis=1)
    return near[seen >= SEEN_SHARE * len(cameras)]


def _is_clear(box: np.ndarray, cameras: Sequence[Camera]) -> bool:
    """Whether hardly a camera is in a box (2, 3) or close to it; of fewer than MIN_SUPPORTERS none."""
    most = int(np.ceil(INSIDE_SHARE * len(cameras))) if len(cameras) >= MIN_SUPPORTERS else 0
    centers = np.stack([camera.center for camera in cameras])
    return bool((np.abs(centers - box.mean(axis=0)) < CLEAR / 2 * np.ptp(box, axis=0)).all(axis=1).sum() <= most)


def _without_cameras(box: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """A box (2, 3) without sides much shorter than the longest, small enough that it is clear of cameras."""
    while not _is_clear(box, cameras):
        box = _scaled(box, 1.0 / STEP)
    least = SIDE_SHARE * np.ptp(box, axis=0).max()
    while ((sides := np.ptp(box, axis=0)) < least).any():  # voxels around a flat box are long
        grown = _scaled(box, np.where(sides < least, np.minimum(STEP, least / sides), 1.0))
        if not _is_clear(grown, cameras):
            break
        box = grown
    return box


def _reason(cameras: Sequence[Camera], looks: Sequence[Look], counts: Sequence[int]) -> str:
    """Why a box is where it is."""
    numbers = [len(look.cameras) for look in looks]
    looking = agreed(sum(numbers), "looks", "look")
    who = f"{' and '.join(map(str, numbers))} of {counted(len(cameras), 'camera')} {looking} at"
    several = f", {len(looks)} places" if len(looks) > 1 else ""
    if len(looks) > 1 and not any(_shown(camera, looks) > 1 for camera in cameras):
        several += " of which no picture shows two: several objects, or cameras that fell apart"
    if any(counts):
        return f"around {counted(sum(counts), 'point')} that {who}{several}"
    return f"around what {who}, whose size no points show{several}"


def _shown(camera: Camera, looks: Sequence[Look]) -> int:
    """How many of the places that are looked at a camera has in its picture."""
    pixels, depths = camera.project(np.stack([look.point for look in looks]))
    return int(((depths > 0) & (pixels >= 0).all(axis=1) & (pixels <= [camera.width, camera.height]).all(axis=1)).sum())


def _carved_cube(cameras: Sequence[Camera]) -> np.ndarray:
    """A cube (2, 3) that holds all that most cameras see whole, to carve in it."""
    # Around the point nearest to all optical axes, as an outline says more than any of them: no camera is an outlier.
    centers = np.stack([camera.center for camera in cameras])
    center = axes_meeting(cameras)
    center = center_ahead(cameras) if center is None else center
    away = sum(bool((center - camera.center) @ camera.rotation[:, 2] <= 0) for camera in cameras)
    if 2 * away > len(cameras):
        raise InputError(
            f"{away} of {len(cameras)} cameras {agreed(away, 'looks', 'look')} away from what the views "
            "have in common: check the "
            "cameras' axes, or give the bounds of what should be fitted"
        )
    distance = np.linalg.norm(centers - center, axis=1)
    tangent = np.array([max(camera.width / camera.fx, camera.height / camera.fy) / 2 for camera in cameras])
    # an object that fills the image's longer side at that distance
    half = float(np.median(distance * tangent / np.sqrt(1 + tangent**2))) * CARVED_ROOM
    half = min(half, MAX_OF_DISTANCE * float(distance.min())) if distance.min() > 0 else half
    return _require_size(np.stack([center - half, center + half]))


def _place(cameras: Sequence[Camera]) -> FoundBox:
    """A box around most of the cameras, where they look at nothing in common."""
    centers = np.stack([camera.center for camera in cameras])
    middle = np.median(centers, axis=0)
    half = PLACE_ROOM * float(np.percentile(np.linalg.norm(centers - middle, axis=1), PLACE_PERCENTILE))
    box = _require_size(np.stack([middle - half, middle + half]))
    return FoundBox(
        box, (), "around most cameras, as they look at nothing in common: a place, or cameras whose axes are wrong"
    )


def _scaled(box: np.ndarray, factor: float | np.ndarray) -> np.ndarray:
    middle, half = box.mean(axis=0), np.ptp(box, axis=0) / 2
    return np.stack([middle - factor * half, middle + factor * half])


def _require_size(box: np.ndarray) -> np.ndarray:
    if not (np.isfinite(box).all() and (box[1] > box[0]).all()):
        raise InputError(
            "the cameras do not determine the size of what they look at: check focal lengths and positions, or "
            "give the bounds of what should be fitted"
        )
    return box


def are_inliers(points: np.ndarray, radius: float) -> np.ndarray:
    """Which points (n, 3) have NEIGHBOURS others within a radius, world units (radius outlier removal)."""
    from scipy.spatial import KDTree

    if len(points) <= NEIGHBORS:
        return np.zeros(len(points), bool)
    distances = np.asarray(KDTree(points).query(points, NEIGHBORS + 1)[0])  # the first is the point itself
    return distances[:, -1] <= radius


class Bounds:
    """Where the files of a scene may lie, by real paths: in its folder, or where a link to a folder in it leads.
    Such a link is `images -> /captures/fox/images`; links deeper inside, and to files, must not lead elsewhere."""

    def __init__(self, folder: pathlib.Path):
        self.folder = folder
        with os.scandir(folder) as entries:
            linked = [entry.path for entry in entries if entry.is_symlink() and entry.is_dir()]
        self.roots = [pathlib.Path(os.path.realpath(path)) for path in (folder, *linked)]

    def require(self, path: pathlib.Path, where: str) -> pathlib.Path:
        """The path of a file that a scene names; ValueError where it lies elsewhere."""
        real = pathlib.Path(os.path.realpath(path))
        if not any(real.is_relative_to(root) for root in self.roots):
            raise InputError(
                f"{where}: {path.name[:60]!r} is a link that leads out of the data folder {str(self.folder)!r}: put "
                "the file there, or a link to its whole folder"
            )
        return path
