"""transforms.json of nerfstudio (Tancik et al. 2023), instant-ngp (Mueller et al. 2022) and NeRF-synthetic scenes."""

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np

from ...core.checks import checked_number, listed, shown
from ...core.files import PathLike, require_file
from ...errors import InputError, MissingFileError
from ...mesh.io.ply import read_ply_points
from ...view.alignment import Similarity
from ...view.camera import Camera
from ...view.pictures import image_size
from ..box import Bounds
from ..lenses import Intrinsics, Lens, all_around
from ..parsing import (
    TO_OPENCV,
    PictureFinder,
    find_picture,
    frames_of,
    held_out,
    intrinsics_of,
    matrix,
    missing_split,
    names_apart,
    picture_size,
    read_json,
    split_file,
)
from ..pictures import COEFFICIENTS, files_of, make_scene, views_there
from ..scene import Scene
from ..sizes import View

TRANSFORMS_MARK = "transforms.json, or transforms_train.json with fl_x or K"

#: camera_model values that mean a pinhole with or without OpenCV's distortion, and those of lenses that see more.
MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")
LENSES = ("OPENCV_FISHEYE", "EQUIRECTANGULAR")

#: Pixels by which a camera matrix may differ from what is said beside it: numbers are rounded, half a pixel is moved.
SAME = 1.0


def is_transforms(folder: pathlib.Path) -> bool:
    """Whether a folder holds transforms.json, or transforms_<split>.json with focal lengths."""
    if (folder / "transforms.json").is_file():
        return True
    files = sorted(folder.glob("transforms_*.json"))
    return bool(files) and _says_intrinsics(read_json(files[0]))


#: What exporters call the camera matrix of the file or of a frame: (3, 3) to (4, 4), or 9 or 16 numbers in a row.
MATRICES = ("K", "camera_matrix", "intrinsic_matrix", "intrinsics", "intrinsic", "camera_intrinsics", "cam_intrinsics")


def _says_intrinsics(content: dict) -> bool:
    """Whether a file, or its first frame, has more intrinsics than an angle of view."""
    frames = content.get("frames")
    first = frames[0] if isinstance(frames, list) and frames else None
    levels = [content, first] if isinstance(first, dict) else [content]
    return any("fl_x" in level or _matrix_rows(level) is not None for level in levels)


def _matrix_rows(values: dict) -> tuple[str, list] | None:
    """The camera matrix among the values of a file or a frame as lists of rows, and its name; None without one."""
    for name in MATRICES:
        rows = values.get(name)
        if isinstance(rows, list) and len(rows) in (9, 16) and not any(isinstance(each, list) for each in rows):
            side = 3 if len(rows) == 9 else 4
            rows = [rows[first : first + side] for first in range(0, len(rows), side)]
        if isinstance(rows, list) and len(rows) in (3, 4) and all(isinstance(each, list) for each in rows):
            return name, rows
    return None


def _given(transforms: dict, frame: dict, where: str) -> dict:
    """The values of a frame over those of the file, camera matrices as fl_x, fl_y, cx, cy."""
    top = _with_matrix({name: transforms[name] for name in transforms if name != "frames"}, where)
    own = _with_matrix(frame, where)
    for axis in "xy":  # an angle of the frame's own goes before the file's focal length
        if own.get(f"camera_angle_{axis}") is not None and own.get(f"fl_{axis}") is None:
            top.pop(f"fl_{axis}", None)
    return {**top, **own}


def _with_matrix(values: dict, where: str) -> dict:
    """Values with the intrinsics of their camera matrix; refused where the two differ."""
    found = _matrix_rows(values)
    if found is None:
        return dict(values)
    name, rows = found
    where = f"{where}: {name}"
    k = matrix(rows, (len(rows), len(rows[0]) if rows[0] else 3), where)
    if k.shape == (3, 3) and not k[:2, 2].any() and k[2, :2].any():  # column by column, as Record3D has it
        k = k.T
    if k.shape not in ((3, 3), (3, 4), (4, 4)) or not np.allclose(k[2, :3], [0, 0, 1], atol=1e-9):
        raise InputError(f"{where} must be a camera matrix, fx 0 cx, 0 fy cy, 0 0 1, got {shown(rows)}")
    said = dict(zip(("fl_x", "fl_y", "cx", "cy"), intrinsics_of(k, where), strict=True))
    for key, value in said.items():
        other = _optional(values, key, where)
        if other is not None and abs(other - value) > SAME:
            raise InputError(f"{where} has {key} {value:g}, beside it {key} is {other:g}: which is right?")
    return values | said


def read_transforms(folder: pathlib.Path, *, split: str, **options: Any) -> Scene:
    """Read a split: a file of its own, a list of file names in transforms.json, or every eighth frame, by name, as
    `test`. Options as for `load_scene`; mask_path becomes the alpha, ply_file_path the bounds."""
    single = folder / "transforms.json"
    path = single if single.is_file() else split_file(folder, split)
    transforms = read_json(path)
    # Frames without a picture are left out, as by nerfstudio and instant-ngp: captures often lack blurred ones.
    finder = PictureFinder(folder)
    views = views_there([_view(finder, transforms, where, frame) for where, frame in frames_of(transforms, path)], path)
    finder.warn_of_changed_names(path)
    options["beside"] = files_of(views)
    if path == single:
        views.sort(key=lambda view: str(view.file))
        views = _of_split(views, transforms, split, folder, path)
    points, colors = _points(folder, transforms, path)
    return make_scene(
        folder, views, **options, points=points, point_colors=colors, to_source=_to_source(transforms, path)
    )


def _view(finder: PictureFinder, transforms: dict, where: str, frame: dict) -> View:
    given = _given(transforms, frame, where)
    model = given.get("camera_model", "OPENCV")
    if model not in (*MODELS, *LENSES):
        raise InputError(f"{where}: camera_model {shown(model)} is not read, only {', '.join((*MODELS, *LENSES))}")
    size = None
    if "w" in given or "h" in given:
        size = picture_size(_positive(given, "w", where), _positive(given, "h", where), where)
    pose = matrix(_with_last_row(frame.get("transform_matrix")), (4, 4), f"{where}: transform_matrix") @ TO_OPENCV
    file, mask = finder.find(frame.get("file_path"), f"{where}: file_path"), None
    if frame.get("mask_path") is not None:
        mask = finder.find(frame["mask_path"], f"{where}: mask_path")
        if mask == file:  # by the end of a path of another machine
            raise MissingFileError(f"{where}: mask_path: {shown(frame['mask_path'])} is not there")
    return View(file, pose, where, size=size, mask=mask, **_lens(given, model, where))


def _lens(given: dict, model: str, where: str) -> dict[str, Any]:
    """What a View takes of the lens of a frame."""
    if model == "EQUIRECTANGULAR":
        return {"intrinsics": all_around, "lens": Lens(model)}

    def intrinsics(actual: tuple[int, int]) -> Intrinsics:
        return frame_intrinsics(given, actual, where)

    if model == "OPENCV_FISHEYE" or given.get("is_fisheye"):  # the latter of instant-ngp
        values = tuple(_optional(given, name, where) or 0.0 for name in ("k1", "k2", "k3", "k4"))
        return {"intrinsics": intrinsics, "lens": Lens("FISHEYE", values)}
    if _optional(given, "k4", where):  # nerfstudio's k4 is a power of r, not OpenCV's
        raise InputError(f"{where}: distortion k4 is not read, only k1, k2, k3, p1, p2")
    distortion = tuple(_optional(given, name, where) or 0.0 for name in COEFFICIENTS[:5])
    return {"intrinsics": intrinsics, "distortion": distortion}


def _with_last_row(rows):
    """Three rows of a pose get the fourth."""
    return [*rows, [0.0, 0.0, 0.0, 1.0]] if isinstance(rows, list) and len(rows) == 3 else rows


def frame_intrinsics(given: dict, size: tuple[int, int], where: str) -> Intrinsics:
    """fl_x, fl_y, cx, cy; where they are missing, from angles of view and the middle of the picture."""
    focal = [_focal(given, axis, side, where) for axis, side in zip("xy", size, strict=True)]
    known = [value for value in focal if value is not None]
    if not known:
        raise InputError(f"{where} has no fl_x and no camera_angle_x, nor a camera matrix K, nor has the file")
    fx, fy = (known[0] if value is None else value for value in focal)
    cx, cy = (_optional(given, name, where) for name in ("cx", "cy"))
    return fx, fy, size[0] / 2 if cx is None else cx, size[1] / 2 if cy is None else cy


def _focal(given: dict, axis: str, side: int, where: str) -> float | None:
    """The focal length along an axis, pixels, or that of an angle of view; None without either."""
    if f"fl_{axis}" in given:
        return _positive(given, f"fl_{axis}", where)
    angle = _optional(given, f"camera_angle_{axis}", where)
    if angle is None:
        return None
    if not 0 < angle < np.pi:
        raise InputError(f"{where}: camera_angle_{axis} must lie between 0 and pi, got {angle}")
    return 0.5 * side / np.tan(0.5 * angle)


def _optional(given: dict, name: str, where: str) -> float | None:
    """A number, or None where it is not given."""
    return None if given.get(name) is None else checked_number(given[name], f"{where}: {name}")


def _positive(given: dict, name: str, where: str) -> float:
    """A number above zero."""
    value = checked_number(given.get(name), f"{where}: {name}")
    if value <= 0:
        raise InputError(f"{where}: {name} must be positive, got {value:g}")
    return value


def _of_split(views: list[View], transforms: dict, split: str, folder: pathlib.Path, path: pathlib.Path) -> list[View]:
    """The views of a split of transforms.json, which may list its files."""
    lists = {
        name: transforms[f"{name}_filenames"] for name in ("train", "val", "test") if f"{name}_filenames" in transforms
    }
    if not lists:
        return [views[index] for index in held_out(len(views), split, folder)]
    if split not in lists:
        raise missing_split(split, folder, lists)
    where = f"{path}: {split}_filenames"
    if not isinstance(lists[split], list) or not lists[split]:
        raise InputError(f"{where} must list the pictures of the split, got {shown(lists[split])}")
    by_file = {view.file: view for view in views}
    chosen = [find_picture(folder, name, where) for name in lists[split]]
    unknown = [file.name for file in chosen if file not in by_file]
    if unknown:
        raise InputError(f"{where} names {unknown[0]!r}, which no frame has")
    return [by_file[file] for file in chosen]


def _points(
    folder: pathlib.Path, transforms: dict, path: pathlib.Path
) -> tuple[np.ndarray, np.ndarray | None] | tuple[None, None]:
    """The points that ply_file_path names, in the coordinates of the poses, and their colours."""
    if transforms.get("ply_file_path") is None:
        return None, None
    where = f"{path}: ply_file_path"
    file = Bounds(folder).require(find_picture(folder, transforms["ply_file_path"], where), where)
    return read_ply_points(require_file(file, where))


def _to_source(transforms: dict, path: pathlib.Path) -> np.ndarray | None:
    """The inverse of applied_transform (3x4 or 4x4)."""
    applied = transforms.get("applied_transform")
    if applied is None:
        return None
    where = f"{path}: applied_transform"
    applied = matrix(_with_last_row(applied), (4, 4), where)
    if not np.linalg.cond(applied) < 1e12:
        raise InputError(f"{where} is singular")
    return np.linalg.inv(applied)


#: nerfstudio's file with the motion of a dataset before its fit; exports are in that frame.
FRAME_FILE = "dataparser_transforms.json"


#: Scales and shifts of frames are no larger, and scales no smaller than one over it.
MAX_SCALE = 1e9


def read_frame(path: PathLike) -> Similarity:
    """The similarity from the coordinates of a dataset, before its applied_transform, to nerfstudio's, by its file."""
    # poses are multiplied by `transform` from the left, which holds applied_transform too, and their places by `scale`
    path = require_file(path, "frame file")
    content = read_json(path)
    if not {"transform", "scale"} <= content.keys():
        raise InputError(f"{path} has no transform and scale, as dataparser_transforms.json of nerfstudio has them")
    rows, where = content["transform"], f"{path}: transform"
    motion = matrix(_with_last_row(rows), (4, 4), where)
    scale = _positive(content, "scale", str(path))
    left, lengths, right = np.linalg.svd(motion[:3, :3])
    if np.abs(lengths - 1.0).max() > 1e-3 or np.linalg.det(left @ right) < 0.0 or (motion[3] != (0, 0, 0, 1)).any():
        raise InputError(f"{where} must be a turn and a shift: it changes lengths, mirrors, or has another last row")
    if not (1.0 / MAX_SCALE <= scale <= MAX_SCALE and np.abs(motion[:3, 3]).max() <= MAX_SCALE):
        raise InputError(f"{path}: a scale of {scale:g} or a shift of {shown(motion[:3, 3].tolist())} is not a frame's")
    return Similarity(scale, left @ right, scale * motion[:3, 3])  # rounded to float32 in the file


BLENDER_MARK = "transforms_train.json with camera_angle_x"


def is_blender(folder: pathlib.Path) -> bool:
    """Whether a folder holds transforms_<split>.json as NeRF-synthetic scenes have it."""
    transforms = sorted(folder.glob("transforms_*.json"))
    if not transforms:
        return False
    content = read_json(transforms[0])
    return "camera_angle_x" in content and not _says_intrinsics(content)


def read_blender(folder: pathlib.Path, *, split: str, **options: Any) -> Scene:
    """Read a split; camera axes are turned from Blender's (+y up, -z forward) to OpenCV's. Options as `load_scene`."""
    path = split_file(folder, split)
    transforms = read_json(path)
    given = {"camera_angle_x": checked_number(transforms.get("camera_angle_x"), f"{path}: camera_angle_x")}

    def intrinsics(size: tuple[int, int]) -> Intrinsics:
        return frame_intrinsics(given, size, str(path))

    views, finder = [], PictureFinder(folder)
    for where, frame in frames_of(transforms, path):
        file = finder.find(frame.get("file_path"), f"{where}: file_path")
        pose = matrix(frame.get("transform_matrix"), (4, 4), f"{where}: transform_matrix") @ TO_OPENCV
        views.append(View(file, pose, where, intrinsics))
    finder.warn_of_changed_names(path)
    return make_scene(folder, views, **options)


class TransformsCameras:
    """The cameras of a transforms.json, of NeRF-synthetic scenes, nerfstudio or instant-ngp."""

    def __init__(self, path: PathLike):
        self.path = require_file(path, "camera file")
        self._content = read_json(self.path)
        self._frames = frames_of(self._content, self.path)

    def __len__(self) -> int:
        return len(self._frames)

    def camera(self, name: str, size: tuple[int, int] | None = None) -> Camera:
        """The camera of a frame, in the world of the file: by number from 0, or by its picture, with or without folder
        and ending. size: width and height where the file does not say them; None takes those of the picture."""
        where, frame = self._found(name)
        given = _given(self._content, frame, where)
        if "w" in given and "h" in given:
            width, height = (checked_number(given[side], f"{where}: {side}") for side in "wh")
            width, height = picture_size(width, height, where)
        elif size is not None:
            width, height = size
        else:
            width, height = image_size(find_picture(self.path.parent, frame.get("file_path"), f"{where}: file_path"))
        fx, fy, cx, cy = frame_intrinsics(given, (width, height), where)
        rows = frame.get("transform_matrix")
        if isinstance(rows, list) and len(rows) == 3:
            rows = [*rows, [0.0, 0.0, 0.0, 1.0]]
        pose = matrix(rows, (4, 4), f"{where}: transform_matrix") @ TO_OPENCV
        try:
            return Camera(fx, fy, cx, cy, width, height, np.asarray(pose))
        except ValueError as error:
            raise InputError(f"{where}: {error}") from None

    def _found(self, name: str) -> tuple[str, dict[str, Any]]:
        number = int(name) if name.isdecimal() and len(name) < 10 and int(name) < len(self._frames) else None
        if number is not None and str(number) == name:
            return self._frames[number]
        names = [str(frame.get("file_path")) for _, frame in self._frames]
        paths = [pathlib.PurePosixPath(each) for each in names]
        short = names_apart(paths) if len({*paths}) == len(paths) else names
        known = [(names[k], short[k], each.stem, names[k].removesuffix(each.suffix)) for k, each in enumerate(paths)]
        chosen = [index for index, each in enumerate(known) if name in each]
        if not chosen and number is not None:
            chosen = [number]
        if len(chosen) == 1:
            return self._frames[chosen[0]]
        wrong = f"{len(chosen)} frames" if chosen else "no frame"
        raise InputError(f"{self.path} has {wrong} {name!r}, only 0 to {len(names) - 1}: {listed(short)}")
