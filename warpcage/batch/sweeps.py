"""Sweeps: job files of all poses from all cameras, by all kinds of coordinates; for data sets of deformed scenes."""

from __future__ import annotations

import dataclasses
import math
import os
import pathlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from ..cage.cage import Cage
from ..cage.pose_modes import RandomNumbers
from ..cage.random_poses import RandomPoses
from ..core.checks import checked_whole
from ..core.files import PathLike, atomic_path
from ..core.names import require_coordinates
from ..core.threads import cpu_threads
from ..view.camera import Camera
from ..view.camera_file import CameraFile
from ..view.camera_path import CameraKey
from .job_file import write_jobs

#: Highest camera of random views above the horizon, and how much farther than needed the farthest stands.
MOST_ELEVATION, FARTHEST = 80.0, 1.3

#: Ends of the keys of streams of random numbers: those of poses have two parts, and share none with these.
_VIEWS, _CHOICES = (0, 1), (0, 2)

#: Random poses that are worked on at once, for each thread.
AHEAD = 4


class PoseSource(Protocol):
    """Some poses of one cage."""

    def __len__(self) -> int:
        """How many."""
        ...

    def rows(self) -> Iterator[np.ndarray]:
        """The vertices of each, (v, 3), world units."""
        ...

    def origin(self, number: int) -> dict[str, Any]:
        """What is kept of where a pose comes from."""
        ...


@dataclasses.dataclass(frozen=True)
class RandomSource:
    """Random poses of one seed.

    Args:
        poses: Where they come from.
        count: How many of them.
    """

    poses: RandomPoses[Cage]
    count: int

    def __len__(self) -> int:
        return self.count

    def rows(self) -> Iterator[np.ndarray]:
        """The vertices of each, made by several threads, in their order."""
        self.poses.probe  # noqa: B018  (made once, before threads need it)
        with ThreadPoolExecutor(cpu_threads()) as pool:
            step = AHEAD * cpu_threads()
            for first in range(0, self.count, step):
                yield from pool.map(self.poses.vertices, range(first, min(first + step, self.count)))

    def origin(self, number: int) -> dict[str, Any]:
        """Seed and number."""
        return {"seed": self.poses.seed, "number": number}


@dataclasses.dataclass(frozen=True)
class GivenSource:
    """Poses that are there.

    Args:
        vertices: (p, v, 3) world units; or as many cages' vertices.
        name: What they are called.
    """

    vertices: Sequence[np.ndarray] | np.ndarray
    name: str

    def __len__(self) -> int:
        return len(self.vertices)

    def rows(self) -> Iterator[np.ndarray]:
        """The vertices of each."""
        return iter(self.vertices)

    def origin(self, number: int) -> dict[str, Any]:
        """Name, and number where there are several."""
        return {"source": self.name} | ({"number": number} if len(self) > 1 else {})


@dataclasses.dataclass(frozen=True)
class RandomViews:
    """Cameras at random places of the upper half of the sphere, other ones for each pose.

    Args:
        count: Cameras for each pose.
        points: (n, 3) what every picture shows whole, world units.
        seed: Another one gives other places.
        up: (3,) what is up.
        fov_degrees: Horizontal field of view.
        width: Width of the pictures, pixels.
        height: Height of the pictures, pixels.
    """

    count: int
    points: ArrayLike
    seed: int = 0
    up: Sequence[float] = (0.0, 0.0, 1.0)
    fov_degrees: float = 40.0
    width: int = 400
    height: int = 400

    def of(self, pose: int) -> list[dict[str, Any]]:
        """The cameras of a pose.

        Args:
            pose: Its number in the sweep.

        Returns:
            Cameras as items have them: eye, target, up, fov_degrees, width and height.
        """
        points = np.asarray(self.points, np.float64)
        target = 0.5 * (points.min(axis=0) + points.max(axis=0))
        radius = float(np.linalg.norm(points - target, axis=1).max())
        half = math.tan(math.radians(self.fov_degrees) / 2) * min(1.0, self.height / self.width)
        nearest = max(radius, 1e-9) / math.sin(math.atan(half))
        up = np.asarray(self.up, np.float64) / np.linalg.norm(self.up)
        side = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
        side /= np.linalg.norm(side)
        random = RandomNumbers(self.seed, (pose, *_VIEWS))
        cameras = []
        for _ in range(self.count):
            height = random.number(0.0, math.sin(math.radians(MOST_ELEVATION)))  # even over the sphere's area
            turn, distance = 2.0 * math.pi * random.number(), nearest * random.number(1.0, FARTHEST)
            flat = math.sqrt(1.0 - height * height)
            across = math.cos(turn) * side + math.sin(turn) * np.cross(up, side)
            eye = target + distance * (flat * across + height * up)
            view = {"eye": eye.tolist(), "target": target.tolist(), "up": up.tolist()}
            cameras.append(
                view | {"fov_degrees": self.fov_degrees, "width": int(self.width), "height": int(self.height)}
            )
        return cameras


@dataclasses.dataclass(frozen=True)
class SweepFiles:
    """What a sweep wrote.

    Attributes:
        jobs: The job file.
        poses: The poses, (p, v, 3) float64, world units (.npy).
        cameras: The cameras that all poses share; None where each pose has its own.
        items: Number of items.
    """

    jobs: pathlib.Path
    poses: pathlib.Path
    cameras: pathlib.Path | None
    items: int


def poses_path(jobs: PathLike) -> pathlib.Path:
    """The file of a sweep's poses; jobs: its job file."""
    path = pathlib.Path(jobs)
    return path.with_name(f"{path.stem}.poses.npy")


def cameras_path(jobs: PathLike) -> pathlib.Path:
    """The file of a sweep's cameras; jobs: its job file."""
    path = pathlib.Path(jobs)
    return path.with_name(f"{path.stem}.cameras.json")


def _write_poses(path: pathlib.Path, rest: Cage, sources: Sequence[PoseSource]) -> np.ndarray:
    """Write poses as one array, one after the other. Returns (2, 3) the corners of all and of the cage at rest."""
    count, shape = sum(map(len, sources)), rest.vertices.shape
    if not count:
        raise ValueError("a sweep needs at least one pose")
    low, high = rest.bounds
    header = {"descr": "<f8", "fortran_order": False, "shape": (count, *shape)}
    # written, not mapped: a disk that gets full under a mapped file kills the process
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        for source in sources:
            for number, row in enumerate(source.rows()):
                vertices = np.ascontiguousarray(row, dtype="<f8")
                if vertices.shape != shape or not np.isfinite(vertices).all():
                    raise ValueError(
                        f"pose {number} of {source.origin(number)} must be {shape} finite numbers as the cage at rest "
                        f"has them, got shape {vertices.shape}"
                    )
                low, high = np.minimum(low, vertices.min(axis=0)), np.maximum(high, vertices.max(axis=0))
                file.write(vertices.tobytes())
    return np.stack([low, high])


def write_sweep(
    path: PathLike,
    *,
    field: PathLike,
    cage: PathLike,
    rest: Cage,
    sources: Sequence[PoseSource],
    cameras: Sequence[Camera] | Callable[[np.ndarray], Sequence[Camera] | RandomViews],
    coordinates: Sequence[str] = ("harmonic",),
    views: int | None = None,
    seed: int = 0,
    records: Mapping[str, Any] | None = None,
    defaults: Mapping[str, Any] | None = None,
) -> SweepFiles:
    """Write the job file of a sweep, and beside it its poses (`poses_path`) and the cameras that they share.

    Items go by pose, then by kind of coordinates, then by camera, so that a map is made once for the cameras of a pose.
    They are called `pose_000012/camera_003`; with several kinds of coordinates `pose_000012_green/camera_003`. Their
    `extra` has `pose` and `camera`, their numbers, and what the pose comes from: `seed` and `number`, or `source`.

    Args:
        path: The job file.
        field: The field file.
        cage: The file of the cage at rest.
        rest: The cage.
        sources: The poses.
        cameras: Cameras that all poses share, in the world of the field. Or a function that makes them, or views of
            their own for each pose, of (2, 3), the lowest and highest corner of all poses and of the cage at rest.
        coordinates: Kinds of coordinates.
        views: How many of the shared cameras, chosen at random, each pose is seen from. None is all.
        seed: Of that choice.
        records: How records are kept; see docs/sweeps.md. None is a folder.
        defaults: More words that all items share, such as "background" or "resolution".

    Returns:
        The files.

    Raises:
        ValueError: For no poses or vertices of another shape, no cameras, other coordinates, more views than cameras,
            or words that items do not have.
    """
    path = pathlib.Path(path)
    kinds = [require_coordinates(kind) for kind in coordinates]
    if not kinds or len(set(kinds)) < len(kinds):
        raise ValueError(f"a sweep needs kinds of coordinates, each once, got {list(coordinates)}")
    with atomic_path(poses_path(path)) as temporary:
        bounds = _write_poses(temporary, rest, sources)
        chosen = cameras(bounds) if callable(cameras) else cameras
        shared = {"field": _beside(field, path), "cage": _beside(cage, path), **(defaults or {})}
        items = _Items(path, sources, chosen, kinds, views, seed)
        count = write_jobs(path, items, defaults=shared | items.shared, records=records or {"kind": "folder"})
        if not isinstance(chosen, RandomViews):
            # names that are their numbers: those of files may be anything
            CameraFile([CameraKey(camera, name=str(index)) for index, camera in enumerate(chosen)]).save(items.named)
    return SweepFiles(path, poses_path(path), None if isinstance(chosen, RandomViews) else items.named, count)


class _Items:
    """The items of a sweep, in the order of their poses."""

    def __init__(
        self,
        path: pathlib.Path,
        sources: Sequence[PoseSource],
        cameras: Sequence[Camera] | RandomViews,
        kinds: Sequence[str],
        views: int | None,
        seed: int,
    ):
        self._sources, self._cameras, self._kinds, self._views, self._seed = sources, cameras, kinds, views, seed
        self._count = cameras.count if isinstance(cameras, RandomViews) else len(cameras)
        if not self._count:
            raise ValueError("a sweep needs at least one camera")
        if views is not None:
            if isinstance(cameras, RandomViews):
                raise ValueError("random views are other ones for each pose: ask for as many as are wanted")
            checked_whole(views, "views", 1, self._count)
        self._poses, self.named = poses_path(path).name, cameras_path(path)
        self.shared = {"coordinates": kinds[0]} if len(kinds) == 1 else {}

    def __iter__(self) -> Iterator[dict[str, Any]]:
        several = len(self._kinds) > 1
        digits = max(3, len(str(self._count - 1)))
        for pose, origin in enumerate(_origins(self._sources)):
            own = self._cameras.of(pose) if isinstance(self._cameras, RandomViews) else None
            chosen = range(self._count) if self._views is None else _chosen(self._seed, pose, self._count, self._views)
            for kind in self._kinds:
                folder = f"pose_{pose:06d}" + (f"_{kind}" if several else "")
                for number in chosen:
                    yield {
                        "id": f"{folder}/camera_{number:0{digits}d}",
                        "posed": f"{self._poses}#{pose}",
                        "camera": f"{self.named.name}#{number}" if own is None else own[number],
                        **({"coordinates": kind} if several else {}),
                        "extra": {"pose": pose, "camera": number, **origin},
                    }


def _origins(sources: Sequence[PoseSource]) -> Iterator[dict[str, Any]]:
    for source in sources:
        for number in range(len(source)):
            yield source.origin(number)


def _chosen(seed: int, pose: int, count: int, views: int) -> list[int]:
    """Some of the numbers below `count`, each set of them as likely as another, ascending."""
    random = RandomNumbers(seed, (pose, *_CHOICES))
    numbers = list(range(count))
    for place in range(views):
        other = place + random.whole(count - place)
        numbers[place], numbers[other] = numbers[other], numbers[place]
    return sorted(numbers[:views])


def _beside(file: PathLike, path: pathlib.Path) -> str:
    """A file as items of a job file call it."""
    try:
        return pathlib.Path(os.path.relpath(file, path.absolute().parent)).as_posix()
    except ValueError:  # on another drive
        return pathlib.Path(file).absolute().as_posix()
