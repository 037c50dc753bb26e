"""Captures of phones as ARKit logs them: raw data of Polycam, Record3D as it exports it, ARKitScenes, Stray Scanner."""

from __future__ import annotations

import bisect
import pathlib
from typing import Any, TypeVar

import numpy as np

from ...core.checks import checked_number, listed
from ...errors import InputError, MissingFileError
from ...mesh.io.ply import read_ply_points
from ..box import Bounds
from ..parsing import (
    PICTURE_ENDINGS,
    TO_OPENCV,
    chosen_part,
    evenly,
    floats,
    is_file,
    numbers,
    picture_size,
    pictures_in,
    read_json,
    read_text,
    table_rows,
)
from ..pictures import held_out_scene, views_there
from ..scene import Scene
from ..sizes import View
from .colmap import ModelImage

POLYCAM_MARK = "keyframes/ with cameras/ and images/"

#: From ARKit's world, y up, to z up.
TO_Z_UP = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


def is_polycam(folder: pathlib.Path) -> bool:
    """Whether a folder holds the raw data of Polycam."""
    return any((folder / "keyframes" / name).is_dir() for name in ("cameras", "corrected_cameras"))


def read_polycam(folder: pathlib.Path, *, split: str, **options: Any) -> Scene:
    """Read a split: every eighth picture, by name, is `test`, the others are `train`. Options as for `load_scene`."""
    keyframes = folder / "keyframes"
    views = _polycam_views(keyframes, "corrected_") or _polycam_views(keyframes, "")
    if not views:
        raise InputError(f"{keyframes} holds no cameras/ (.json) beside images/, and no corrected_ ones")
    views = views_there(views, keyframes)
    return held_out_scene(folder, views, split, **options, to_source=np.linalg.inv(TO_Z_UP))


def _polycam_views(keyframes: pathlib.Path, kind: str) -> list[View]:
    """The pictures of a kind with their cameras, by name."""
    cameras, images = keyframes / f"{kind}cameras", keyframes / f"{kind}images"
    return [_polycam_view(file, images) for file in sorted(cameras.glob("*.json"))] if images.is_dir() else []


def _polycam_view(file: pathlib.Path, images: pathlib.Path) -> View:
    given = read_json(file)

    def value(name: str) -> float:
        return checked_number(given.get(name), f"{file}: {name}")

    pose = np.eye(4)
    pose[:3] = [[value(f"t_{row}{column}") for column in range(4)] for row in range(3)]
    return View(
        _picture(images, file.stem),
        TO_Z_UP @ pose @ TO_OPENCV,
        str(file),
        (value("fx"), value("fy"), value("cx"), value("cy")),
        picture_size(value("width"), value("height"), str(file)),
    )


def _picture(images: pathlib.Path, stem: str) -> pathlib.Path:
    """The picture of a name without ending, a .jpg where none is there."""
    candidates = [images / (stem + ending) for ending in (".jpg", *PICTURE_ENDINGS)]
    return next(filter(is_file, candidates), candidates[0])


RECORD3D_MARK = "metadata or metadata.json with poses, beside rgb/ or rgbd/"


def is_record3d(folder: pathlib.Path) -> bool:
    """Whether a folder holds a capture of Record3D."""
    return _metadata(folder) is not None and any((folder / name).is_dir() for name in ("rgb", "rgbd"))


def read_record3d(folder: pathlib.Path, *, split: str, **options: Any) -> Scene:
    """Read a split: every eighth picture is `test`, the others are `train`. Options as for `load_scene`."""
    path = _metadata(folder)
    if path is None:
        raise MissingFileError(f"{str(folder)!r} holds no capture of Record3D ({RECORD3D_MARK})")
    given = read_json(path)
    poses = given.get("poses")
    if not isinstance(poses, list) or not poses:
        raise InputError(f"{path} holds no poses")
    images = folder / ("rgb" if (folder / "rgb").is_dir() else "rgbd")
    views = views_there([_record3d_view(path, images, given, poses, index) for index in evenly(len(poses))], path)
    return held_out_scene(folder, views, split, **options, to_source=np.linalg.inv(TO_Z_UP))


def _metadata(folder: pathlib.Path) -> pathlib.Path | None:
    return next((folder / name for name in ("metadata.json", "metadata") if is_file(folder / name)), None)


def _pose(quaternion: list[float], place: list[float], where: str) -> np.ndarray:
    """A motion (4, 4) by a quaternion x y z w and a place."""
    x, y, z, w = quaternion
    # ModelImage holds the inverse motion: that of the conjugate, without a shift
    pose = ModelImage("", (w, -x, -y, -z), (0.0, 0.0, 0.0), 0).camera_to_world(where)
    pose[:3, 3] = place
    return pose


def _record3d_view(path: pathlib.Path, images: pathlib.Path, given: dict, poses: list, index: int) -> View:
    """One picture with its camera."""
    where = f"{path}: picture {index}"
    values = numbers(poses[index], 7, f"{path}: poses[{index}]")
    pose = _pose(values[:4], values[4:], where)
    each = given.get("perFrameIntrinsicCoeffs")
    if isinstance(each, list) and len(each) == len(poses):
        fx, fy, cx, cy = numbers(each[index], 4, f"{path}: perFrameIntrinsicCoeffs[{index}]")
    else:
        matrix = numbers(given.get("K"), 9, f"{path}: K")
        fx, fy, cx, cy = matrix[0], matrix[4], matrix[6], matrix[7]
    width, height = (checked_number(given.get(side), f"{path}: {side}") for side in "wh")
    picture = _picture(images, str(index))
    return View(picture, TO_Z_UP @ pose @ TO_OPENCV, where, (fx, fy, cx, cy), picture_size(width, height, str(path)))


# ARKitScenes (Baruch et al. 2021): DATA.md of its repository, and its loader. Lines of lowres_wide.traj are a time, a
# rotation vector and a translation from the world, with z up, to cameras with OpenCV's axes. Names of pictures end in
# their times, those of intrinsics beside them too: width, height, fx, fy, cx, cy.

ARKITSCENES_MARK = "lowres_wide.traj, in it or in NAME_frames/, beside lowres_wide/ and lowres_wide_intrinsics/"
TRAJECTORY = "lowres_wide.traj"

Value = TypeVar("Value")

#: Folders of pictures of the camera that the poses are for, the largest pictures first.
PICTURES = ("wide", "vga_wide", "lowres_wide")

#: Seconds by which a picture may miss its pose, and its intrinsics, as in the data's own loader.
POSE_TIME, LENS_TIME = 0.005, 0.002


def is_arkitscenes(folder: pathlib.Path) -> bool:
    """Whether a folder holds a video of ARKitScenes."""
    return _trajectory(folder) is not None


def _trajectory(folder: pathlib.Path) -> pathlib.Path | None:
    candidates = [folder / TRAJECTORY, *sorted(folder.glob(f"*_frames/{TRAJECTORY}"))]
    return next(filter(is_file, candidates), None)


def read_arkitscenes(folder: pathlib.Path, *, split: str, model: str | None = None, **options: Any) -> Scene:
    """Read a split: every eighth picture is `test`, the others are `train`. Options as for `load_scene`; of several
    folders of pictures the one with the largest is read, or the one of a name."""
    path = _trajectory(folder)
    if path is None:
        raise MissingFileError(f"{str(folder)!r} holds no video of ARKitScenes ({ARKITSCENES_MARK})")
    bounds = Bounds(folder)
    bounds.require(path, str(folder))
    homes = {name: path.parent / name for name in PICTURES if (path.parent / f"{name}_intrinsics").is_dir()}
    homes = {name: home for name, home in homes.items() if home.is_dir()}
    if not homes:
        raise MissingFileError(f"{str(path.parent)!r} holds none of {listed(PICTURES)} with its intrinsics beside it")
    name = next(iter(homes)) if model is None else chosen_part(dict.fromkeys(homes, 0), model, path.parent, "folder")
    lenses = _timed(sorted(homes[name].with_name(f"{name}_intrinsics").glob("*.pincam")))
    poses, found = _read_trajectory(path), []
    for time, file in _timed(pictures_in(homes[name])).items():  # 60 a second, of poses there are 10
        pose, lens = _nearest(poses, time, POSE_TIME), _nearest(lenses, time, LENS_TIME)
        if pose is not None and lens is not None:
            found.append((file, pose, lens))
    if not found:
        raise InputError(f"{path} has no pose at the time of a picture in {homes[name]} that has intrinsics (.pincam)")
    taken = [found[index] for index in evenly(len(found))]
    views = [_pincam_view(file, pose, lens, bounds) for file, pose, lens in taken]
    points = colors = None
    mesh = next(iter(sorted(folder.glob("*_mesh.ply"))), None)
    if mesh is not None:
        points, colors = read_ply_points(bounds.require(mesh, str(folder)))
    return held_out_scene(folder, views, split, **options, points=points, point_colors=colors)


def _timed(files: list[pathlib.Path]) -> dict[float, pathlib.Path]:
    """Files by the times, seconds, that their names end in; those of other names are left out."""
    found = {}
    for file in files:
        time = file.stem.rpartition("_")[2]
        if time.replace(".", "", 1).isdecimal():
            found[float(time)] = file
    return dict(sorted(found.items()))


def _nearest(by_time: dict[float, Value], time: float, most: float) -> Value | None:
    """What is nearest in time, None where nothing is near enough; in the order of time."""
    times = list(by_time)
    place = bisect.bisect(times, time)
    near = min(times[max(place - 1, 0) : place + 1], key=lambda each: abs(each - time), default=np.inf)
    return by_time[near] if abs(near - time) < most else None


def _read_trajectory(path: pathlib.Path) -> dict[float, np.ndarray]:
    """Poses (4, 4) from camera to world by their times."""
    from scipy.spatial.transform import Rotation

    poses = {}
    for line, text in enumerate(read_text(path, "trajectory").splitlines(), 1):
        if not text.strip():
            continue
        values = floats(text, f"{path}:{line}")
        if len(values) != 7:
            raise InputError(f"{path}:{line}: a time, a rotation and a place, 7 numbers, expected, got {len(values)}")
        to_camera = np.eye(4)
        to_camera[:3, :3] = Rotation.from_rotvec(values[1:4]).as_matrix()
        to_camera[:3, 3] = values[4:]
        poses[values[0]] = np.linalg.inv(to_camera)
    return dict(sorted(poses.items()))


def _pincam_view(file: pathlib.Path, pose: np.ndarray, lens: pathlib.Path, bounds: Bounds) -> View:
    """One picture with its camera."""
    values = floats(read_text(bounds.require(lens, str(lens.parent)), "intrinsics"), str(lens))
    if len(values) != 6 or not min(values[:4]) > 0:
        raise InputError(f"{lens} must hold width, height, fx, fy, cx, cy, the first four above zero, got {values}")
    width, height, fx, fy, cx, cy = values

    return View(file, pose, str(file), (fx, fy, cx, cy), picture_size(width, height, str(lens)))


# Stray Scanner: docs.strayrobots.io has its files; that cameras have OpenCV's axes is how its own viewer uses them.

STRAY_MARK = "odometry.csv and camera_matrix.csv beside rgb/, the frames of rgb.mp4"
STRAY_COLUMNS = ("frame", "x", "y", "z", "qx", "qy", "qz", "qw")


def is_stray(folder: pathlib.Path) -> bool:
    """Whether a folder holds a capture of Stray Scanner."""
    return all(is_file(folder / name) for name in ("odometry.csv", "camera_matrix.csv"))


def read_stray(folder: pathlib.Path, *, split: str, **options: Any) -> Scene:
    """Read a split: every eighth picture is `test`, the others are `train`. Options as for `load_scene`."""
    path, images = folder / "odometry.csv", folder / "rgb"
    if not images.is_dir():
        raise MissingFileError(
            f"{str(folder)!r} holds no folder rgb/: make the frames of rgb.mp4 into pictures first, "
            "ffmpeg -i rgb.mp4 -q:v 2 -start_number 0 rgb/%06d.jpg"
        )
    bounds = Bounds(folder)
    matrix = floats(
        read_text(bounds.require(folder / "camera_matrix.csv", str(folder)), "camera matrix").replace(",", " "),
        str(folder / "camera_matrix.csv"),
    )
    if len(matrix) != 9:
        raise InputError(f"{folder / 'camera_matrix.csv'} must hold 9 numbers, got {len(matrix)}")
    rows = _stray_rows(bounds.require(path, str(folder)))
    files = {int(file.stem): file for file in pictures_in(images) if file.stem.isdecimal()}
    there = [frame for frame in sorted(rows) if frame in files]
    if 2 * len(there) < len(rows):
        raise MissingFileError(f"{path} has poses of {len(rows)} frames, {images} pictures of {len(there)} of them")
    views = []
    for index in evenly(len(there)):
        frame = there[index]
        where = f"{path}: frame {frame}"
        x, y, z, *turn = rows[frame]
        pose = TO_Z_UP @ _pose(turn, [x, y, z], where)
        views.append(View(files[frame], pose, where, (matrix[0], matrix[4], matrix[2], matrix[5])))
    return held_out_scene(folder, views, split, **options, to_source=np.linalg.inv(TO_Z_UP))


def _stray_rows(path: pathlib.Path) -> dict[int, list[float]]:
    """Place and quaternion x y z w by the numbers of frames."""
    found = {}
    for where, row in table_rows(path, "odometry", STRAY_COLUMNS):
        values = floats(" ".join(row[name] for name in STRAY_COLUMNS), where)
        if len(values) != len(STRAY_COLUMNS):
            raise InputError(f"{where}: each column must hold one number")
        found[int(values[0])] = values[1:]
    return found
