"""Poses and motion of a cage from files: animated glTF and USD, vertex caches, one cage file a frame."""

from __future__ import annotations

import functools
import itertools
import os
import pathlib
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..core.checks import checked_path, checked_positive, listed, require_type
from ..core.files import PathLike, require_file
from ..core.names import counted
from ..errors import InputError
from ..mesh.io import ALL_OBJECTS, ENDINGS, MOTION_ENDINGS, file_up, object_names, read_object, turned_up
from ..mesh.io.gltf_animation import read_gltf_motion
from ..mesh.io.usd import USD_ENDINGS, read_usd_motion
from ..mesh.io.vertex_cache import CACHE_ENDINGS, read_vertex_cache
from ..mesh.match import in_order, matched_order, posed_mesh
from .cage import Cage
from .pose_file import PoseFile
from .up_axis import is_pose, load_standing, standing_of_pose

#: Frames per second where nothing says another rate.
USUAL_RATE = 24.0

#: How files end that a cage may move in.
GLTF_ENDINGS = (".glb", ".gltf")
MOVING_ENDINGS = (*MOTION_ENDINGS, *CACHE_ENDINGS)

#: Most files of a sequence, and frames of a cache.
MAX_FILES = 20_000


def posed_cage(rest: Cage, pose: Any, what: str) -> Cage:
    """A pose as callers give it: a Cage, vertices (v, 3) of any library in the order of `rest`, or a file of one pose.
    `what` begins the message where it is none of them."""
    if isinstance(pose, str | os.PathLike):
        return read_pose(pose, rest)
    posed = posed_mesh(rest, pose, what)
    require_type(posed, Cage, what)
    return posed


def read_pose(path: PathLike, rest: Cage) -> Cage:
    """The one pose that a file shows, of all that `PoseFile.load` reads."""
    shown = gltf_shown(path, rest)
    file = PoseFile(rest, {"shown": shown}) if shown else PoseFile.load(path, rest)
    if len(file) != 1:
        names = listed(file, 4, none="none")
        raise InputError(
            f"{str(path)!r} holds {counted(len(file), 'pose')} ({names}): take one, PoseFile.load(path, rest)[name]"
        )
    return file[file.names[0]]


def read_motion(
    path: PathLike, rest: Cage | None, *, name: str = "", up: str | None = None, fps: float | None = None
) -> PoseFile:
    """Keyframes in files of other programs: glTF, USD, a vertex cache, numbered cage files, or a posed cage alone.
    name: of an animation or shape, "" takes all; up: None finds the axis."""
    path = checked_path(path, "the file of poses")
    ending = path.suffix.lower()
    if ending in MOTION_ENDINGS and rest is None:
        rest = Cage.load(path, up=up)
    if rest is None:
        raise InputError(f"{str(path)!r} holds poses alone: give the cage at rest")
    files = numbered_files(path)
    moving = sequence_poses(files, rest, fps=fps or USUAL_RATE, up=up) if files else None
    if ending in MOVING_ENDINGS:
        moving = file_poses(path, rest, name=name, up=up, fps=fps)
    if moving is not None:
        return moving
    if name:
        raise InputError(f"{str(path)!r}: there is no animation or shape {name!r}: nothing moves in it")
    return PoseFile(rest, {path.stem: Cage.load(path, up=up, reference=rest)})


def file_poses(
    path: PathLike, rest: Cage, *, name: str = "", up: str | None = None, fps: float | None = None
) -> PoseFile | None:
    """The motion in a glTF or USD file or a vertex cache as keyframes of a cage, as `gltf_poses` and `cache_poses`."""
    if pathlib.Path(path).suffix.lower() not in CACHE_ENDINGS:
        return gltf_poses(path, rest, name=name, up=up)
    file = cache_poses(path, rest, up=up, fps=fps)
    if name and name not in file:
        raise InputError(f"{path}: there is no frame {name!r}, only {listed(file)}")
    return file if not name else PoseFile(rest, {name: file[name]})


def cache_poses(path: PathLike, rest: Cage, *, up: str | None = None, fps: float | None = None) -> PoseFile:
    """The frames of a vertex cache as keyframes of the cage whose vertices it holds, in their order.
    `up` None finds the axis by the first frame; fps: of .pc2 files, which have frames, None is USUAL_RATE."""
    cache = read_vertex_cache(path)
    count, points = cache.vertices.shape[:2]
    if points != len(rest.vertices):
        raise InputError(
            f"{path} has {points} vertices, its cage at rest {len(rest.vertices)}: a vertex cache has no faces, and "
            "takes the vertices as they are in the file of the cage"
        )
    if count > MAX_FILES:
        raise InputError(f"{path}: {count} frames, at most {MAX_FILES} are read")
    was = up or standing_of_pose(rest.with_vertices(cache.vertices[0]), "z", rest).up
    rate = USUAL_RATE if fps is None else checked_positive(fps, "fps")
    times = cache.moments / rate if cache.in_frames else cache.moments
    file = PoseFile(rest)
    for index, (time, vertices) in enumerate(zip(times.tolist(), cache.vertices, strict=True)):
        key = f"frame {index}"
        file[key] = turned_up(vertices, was, "z")
        file.times[key], file.easings[key] = time, "linear"
    # on average: seconds of float32 lose digits
    file.fps = rate if cache.in_frames or count < 2 else round((count - 1) / float(times[-1]), 3)
    return file


def gltf_poses(path: PathLike, rest: Cage, *, name: str = "", up: str | None = None) -> PoseFile | None:
    """The motion in a glTF or USD file as keyframes of a cage, its vertices in any order; None where nothing moves.
    `name` "" takes the only animation, or all shapes; `up` None is that of the format."""
    # An animation is a keyframe for each frame, straight between; shapes (Blender's keys) alone are ones without times.
    path = require_file(path, "cage file")
    chosen = _object_of(path, rest)
    read = read_usd_motion if path.suffix.lower() in USD_ENDINGS else read_gltf_motion
    motion = read(path, name, chosen)
    if motion is None:
        return None
    was = up or file_up(path)
    base = Cage.load(path, up=was, object=chosen or ALL_OBJECTS)
    order = _order(rest, base, str(path))
    file = PoseFile(rest)
    for key, vertices in zip(motion.names, motion.vertices, strict=True):
        file[key] = in_order(rest, turned_up(vertices, was, "z"), order)
        if motion.times is not None:
            file.times[key], file.easings[key] = motion.times[len(file) - 1], "linear"
    file.fps = motion.fps
    return file


def gltf_shown(path: PathLike, rest: Cage, *, up: str | None = None) -> Cage | None:
    """The pose that the shapes of a glTF file show together, as a program that opens it does.
    None where the file has no shape on, or an animation, or is another one."""
    if pathlib.Path(path).suffix.lower() not in GLTF_ENDINGS:
        return None
    path = require_file(path, "cage file")
    chosen = _object_of(path, rest)
    motion = read_gltf_motion(path, object=chosen)
    if motion is None or motion.shown is None:
        return None
    was = up or "y"
    order = _order(rest, Cage.load(path, up=was, object=chosen or ALL_OBJECTS), str(path))
    return rest.with_vertices(in_order(rest, turned_up(motion.shown, was, "z"), order))


def _object_of(path: pathlib.Path, rest: Cage) -> str:
    """The object of a glTF or USD file that is called as the cage at rest, or alone has its mesh, "" for all of it."""
    names = object_names(path)
    if rest.object_name in names or len(names) < 2:
        return rest.object_name if rest.object_name in names else ""
    return read_object(path, fits=functools.partial(is_pose, rest)).name


def sequence_poses(
    paths: Sequence[PathLike], rest: Cage, *, fps: float = 24.0, up: str | None = None, expected: str | None = None
) -> PoseFile:
    """One cage file a frame as keyframes, each at the time of the number in its name, counted from the first.
    `up` None finds the axis from the first file and the cage at rest, or else takes `expected` (None: the format's)."""
    # A number that is missing leaves its time to the way between, which is straight.
    rate = checked_positive(fps, "fps")
    numbers = [number for path in paths if (number := _number(pathlib.Path(path))) is not None]
    if not numbers or len(set(numbers)) < len(paths):
        raise InputError("a sequence of cage files needs a number at the end of each name, another one for each")
    first, standing = load_standing(Cage, paths[0], up=up, reference=rest, expected=expected)
    order = _order(rest, first, str(paths[0]))  # vertices may come in another order, the same in all files
    file = PoseFile(rest)
    for path, number in zip(paths, numbers, strict=True):
        cage = first if path is paths[0] else Cage.load(path, up=standing.up, object=first.object_name or None)
        if cage.faces.shape != first.faces.shape or not np.array_equal(cage.faces, first.faces):
            raise InputError(f"cage {str(path)!r} has other faces than {str(paths[0])!r}: one cage moves in a sequence")
        name = pathlib.Path(path).stem
        file[name] = in_order(rest, cage.vertices, order)
        file.times[name], file.easings[name] = (number - numbers[0]) / rate, "linear"
    file.fps = rate
    return file


def numbered_files(text: PathLike) -> list[pathlib.Path] | None:
    """The cage files of a folder, or of a name with # for the digits of its number (walk_####.obj), by their numbers.
    None where the text is neither."""
    path = pathlib.Path(text)
    if path.is_dir():
        found = [file for file in path.iterdir() if file.suffix.lower() in ENDINGS and _number(file) is not None]
    elif "#" in path.name and not path.exists():
        pattern = re.compile(re.sub(r"(?:\\?#)+", r"(\\d+)", re.escape(path.name)))
        found = [file for file in path.parent.glob("*") if pattern.fullmatch(file.name)]
    else:
        return None
    if not found:
        raise InputError(f"{str(text)!r}: no cage file with a number at the end of its name is there")
    if len(found) > MAX_FILES:
        raise InputError(f"{str(text)!r}: {len(found)} cage files, at most {MAX_FILES} are read")
    return sorted(found, key=lambda file: (_number(file) or 0, file.name))


def are_numbered(paths: Sequence[PathLike]) -> bool:
    """Whether files are named alike but for a number at the end, each with another one, ascending."""
    files = [pathlib.Path(path) for path in paths]
    numbers = [_number(file) for file in files]
    heads = {(file.parent, re.sub(r"\d+$", "", file.stem), file.suffix.lower()) for file in files}
    alike = len(files) > 1 and None not in numbers and len(heads) == 1
    return alike and all(one < two for one, two in itertools.pairwise(numbers))  # pyright: ignore[reportOperatorIssue]


def _number(path: pathlib.Path) -> int | None:
    """The number at the end of a file's name."""
    found = re.search(r"(\d{1,9})$", path.stem)
    return int(found[1]) if found else None


def _order(rest: Cage, mesh: Cage, name: str) -> np.ndarray:
    """(v,) numbers of a mesh's vertices in the order of a cage. It is found once: a symmetric cage could be laid over
    its poses in several ways."""
    try:
        return matched_order(rest, mesh)
    except ValueError as error:
        raise InputError(f"cage {name!r} does not fit its rest cage: {error}") from None
