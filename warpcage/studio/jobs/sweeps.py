"""Sweeps: poses times cameras times coordinates as a job file."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import math
import multiprocessing
import pathlib
import signal
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...cage.cage import Cage
from ...cage.random_poses import RandomNumbers, RandomPoses
from ...core.checks import checked_whole
from ...core.files import PathLike, atomic_path, path_from
from ...core.names import FIELD_COORDINATES, coordinate_kind
from ...edits.spec import drawn_pose_spec
from ...errors import InputError
from ...view.camera import Camera, CameraFile, CameraKey
from .job_file import write_jobs

#: Poses that a process gets at once, and that each gets before the next ones are assigned.
AT_ONCE, AHEAD = 4, 256


def rows_by_processes(poses: RandomPoses, count: int, processes: int) -> Iterator[np.ndarray]:
    """The vertices (v, 3) float64, world units, of the first poses in their order: those of this process, to the bit.
    Processes are started anew, not copied: a program needs `if __name__ == "__main__":` around what it does."""
    poses.probe  # noqa: B018  (made once, and sent with the poses)
    fresh, ignored = multiprocessing.get_context("spawn"), (signal.SIGINT, signal.SIG_IGN)  # this process ends them
    with ProcessPoolExecutor(processes, fresh, initializer=signal.signal, initargs=ignored) as pool:
        step = AHEAD * processes
        for first in range(0, count, step):
            yield from pool.map(poses.vertices, range(first, min(first + step, count)), chunksize=AT_ONCE)


#: Highest camera of random views above the horizon, and how much farther than needed the farthest stands.
MAX_ELEVATION, FARTHEST = 80.0, 1.3

#: Ends of the keys of streams of random numbers: those of poses have two parts, and share none with these.
_VIEWS, _CHOICES = (0, 1), (0, 2)

#: Random poses that are drawn to find cameras that see all whole, where workers draw them.
FRAMED = 256

#: Random poses that take longer than starting processes for them.
WORTH_PROCESSES = 200


@dataclasses.dataclass(frozen=True)
class RandomSource:
    """Random poses of one seed."""

    poses: RandomPoses[Cage]
    count: int
    written: bool = False  # drawn at once, and their vertices written; else the worker of an item draws its pose
    processes: int = 1  # that draw what is drawn at once, where that is much; see `rows_by_processes`

    def __len__(self) -> int:
        return self.count

    def rows(self, most: int | None = None) -> Iterator[np.ndarray]:
        """The vertices of each, (v, 3), world units; most: of the first ones alone."""
        count = self.count if most is None else min(most, self.count)
        if self.processes == 1 or count < WORTH_PROCESSES:
            return map(self.poses.vertices, range(count))
        return rows_by_processes(self.poses, count, self.processes)

    def drawn(self, number: int) -> dict[str, Any] | None:
        """What a worker draws a pose by, as items have it; None where its vertices are written."""
        return None if self.written else drawn_pose_spec(self.poses.chance, number)

    def origin(self, number: int) -> dict[str, Any]:
        """What is kept of where a pose comes from."""
        return {"seed": self.poses.seed, "number": number}


@dataclasses.dataclass(frozen=True)
class GivenSource:
    """Poses that are there."""

    vertices: Sequence[np.ndarray] | np.ndarray  # (p, v, 3) world units; or as many cages' vertices
    name: str

    def __len__(self) -> int:
        return len(self.vertices)

    def rows(self, most: int | None = None) -> Iterator[np.ndarray]:
        return iter(self.vertices[:most])

    def drawn(self, number: int) -> None:
        """Their vertices are written."""

    def origin(self, number: int) -> dict[str, Any]:
        return {"source": self.name} | ({"number": number} if len(self) > 1 else {})


#: Some poses of one cage.
PoseSource = RandomSource | GivenSource


@dataclasses.dataclass(frozen=True)
class RandomViews:
    """Cameras at random places of the upper half of the sphere, other ones for each pose."""

    count: int  # for each pose
    points: ArrayLike  # (n, 3) what every picture shows whole, world units
    seed: int = 0
    up: Sequence[float] = (0.0, 0.0, 1.0)
    fov_degrees: float = 40.0  # horizontal
    width: int = 400
    height: int = 400

    def of(self, pose: int) -> list[dict[str, Any]]:
        """The cameras of a pose by its number in the sweep, as items have them."""
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
            height = random.number(0.0, math.sin(math.radians(MAX_ELEVATION)))  # even over the sphere's area
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
    """What a sweep wrote."""

    jobs: pathlib.Path
    poses: pathlib.Path | None  # (p, v, 3) float64, world units (.npy), of those that workers do not draw; None: none
    cameras: pathlib.Path | None  # those that all poses share; None where each pose has its own
    items: int


def _checked(source: PoseSource, corners: np.ndarray, shape: tuple[int, ...], most: int | None) -> Iterator[np.ndarray]:
    """The poses of a source, by which corners (2, 3), the lowest and the highest, grow; most: the first ones alone.
    Raises ValueError for vertices that do not fit."""
    for number, row in enumerate(source.rows(most)):
        vertices = np.ascontiguousarray(row, dtype="<f8")
        if vertices.shape != shape or not np.isfinite(vertices).all():
            raise InputError(
                f"pose {number} of {source.origin(number)} must be {shape} finite numbers as the cage at rest has "
                f"them, got shape {vertices.shape}"
            )
        corners[0] = np.minimum(corners[0], vertices.min(axis=0))
        corners[1] = np.maximum(corners[1], vertices.max(axis=0))
        yield vertices


def write_sweep(
    path: PathLike,
    *,
    field: PathLike,
    cage: PathLike,
    rest: Cage,
    sources: Sequence[PoseSource],
    cameras: Sequence[Camera] | Callable[[np.ndarray], Sequence[Camera] | RandomViews],
    coordinates: Sequence[str] = (FIELD_COORDINATES,),
    views: int | None = None,
    seed: int = 0,
    records: Mapping[str, Any] | None = None,
    defaults: Mapping[str, Any] | None = None,
) -> SweepFiles:
    """Write the job file of a sweep, and beside it its poses (.poses.npy) and their common cameras (.cameras.json).
    cameras: shared, in the world of the field; or a function that makes them, or `RandomViews`, of corners (2, 3)."""
    # Poses that workers draw are named by what they are drawn by, and not written. Corners: the lowest and highest of
    # all poses and of the cage at rest; of poses that workers draw the first FRAMED, spread over their sources. Each
    # pose is seen from `views` of the shared cameras, chosen at random by `seed`, or from all (None). `records`: see
    # docs/sweeps.md; None is a folder. `defaults`: keys that all items share, such as "background".
    path = pathlib.Path(path)
    kinds = [coordinate_kind(kind).name for kind in coordinates]
    if not kinds or len(set(kinds)) < len(kinds):
        raise InputError(f"a sweep needs kinds of coordinates, each once, got {list(coordinates)}")
    if not sum(map(len, sources)):
        raise InputError("a sweep needs at least one pose")
    written = [source for source in sources if len(source) and source.drawn(0) is None]
    drawn = [source for source in sources if len(source) and source.drawn(0) is not None]
    poses, named = (path.with_name(f"{path.stem}.{ending}") for ending in ("poses.npy", "cameras.json"))
    corners, shape = np.array(rest.bounds, np.float64), rest.vertices.shape
    # of poses that workers draw some are drawn: those that cameras are to see whole, or the first, as a trial
    share = None if sum(map(len, drawn)) <= FRAMED else -(-FRAMED // len(drawn))
    for source in drawn:
        collections.deque(_checked(source, corners, shape, share if callable(cameras) else 1), maxlen=0)
    with contextlib.ExitStack() as files:
        if written:
            header = {"descr": "<f8", "fortran_order": False, "shape": (sum(map(len, written)), *shape)}
            # written, not mapped: a disk that gets full under a mapped file kills the process
            with files.enter_context(atomic_path(poses)).open("wb") as file:
                np.lib.format.write_array_header_1_0(file, header)
                for source in written:
                    file.writelines(vertices.tobytes() for vertices in _checked(source, corners, shape, None))
        chosen = cameras(corners) if callable(cameras) else cameras
        shared = None if isinstance(chosen, RandomViews) else chosen
        count = chosen.count if isinstance(chosen, RandomViews) else len(chosen)
        if not count:
            raise InputError("a sweep needs at least one camera")
        if views is not None and shared is None:
            raise InputError("random views are other ones for each pose: ask for as many as are wanted")
        if views is not None:
            checked_whole(views, "views", 1, count)

        def of_pose(number: int) -> Iterator[tuple[int, Any]]:
            if isinstance(chosen, RandomViews):
                yield from enumerate(chosen.of(number))
            else:
                for camera in range(count) if views is None else _chosen(seed, number, count, views):
                    yield camera, f"{named.name}#{camera}"

        beside = path.absolute().parent
        usual = {"field": path_from(beside, field), "cage": path_from(beside, cage), **(defaults or {})}
        usual |= {"coordinates": kinds[0]} if len(kinds) == 1 else {}
        items = _items(sources, poses.name, of_pose, kinds, max(3, len(str(count - 1))))
        written_items = write_jobs(path, items, defaults=usual, records=records or {"kind": "folder"})
        if shared is not None:
            # names that are their numbers: those of files may be anything
            CameraFile([CameraKey(camera, name=str(index)) for index, camera in enumerate(shared)]).save(named)
    return SweepFiles(path, poses if written else None, None if shared is None else named, written_items)


def _items(
    sources: Iterable[PoseSource],
    file: str,  # of the poses that are written
    cameras: Callable[[int], Iterable[tuple[int, Any]]],  # numbers and cameras of a pose
    kinds: Sequence[str],
    digits: int,
) -> Iterator[dict[str, Any]]:
    """The items of a sweep by pose, coordinates and camera: a map is made once for the cameras of a pose."""
    row, poses = 0, ((source, number) for source in sources for number in range(len(source)))
    for pose, (source, place) in enumerate(poses):
        posed, seen = source.drawn(place), list(cameras(pose))
        if posed is None:
            posed, row = f"{file}#{row}", row + 1
        for kind in kinds:
            folder = f"pose_{pose:06d}" + (f"_{kind}" if len(kinds) > 1 else "")
            for number, camera in seen:
                yield {
                    "id": f"{folder}/camera_{number:0{digits}d}",
                    "posed": posed,
                    "camera": camera,
                    **({"coordinates": kind} if len(kinds) > 1 else {}),
                    "extra": {"pose": pose, "camera": number, **source.origin(place)},
                }


def _chosen(seed: int, pose: int, count: int, views: int) -> list[int]:
    """Some of the numbers below `count`, each set of them as likely as another, ascending."""
    random = RandomNumbers(seed, (pose, *_CHOICES))
    numbers = list(range(count))
    for place in range(views):
        other = place + random.whole(count - place)
        numbers[place], numbers[other] = numbers[other], numbers[place]
    return sorted(numbers[:views])
