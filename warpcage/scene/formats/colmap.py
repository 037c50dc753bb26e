"""COLMAP models (Schoenberger and Frahm 2016): sparse/0 in text or binary beside images."""

from __future__ import annotations

import array
import contextlib
import dataclasses
import pathlib
import struct
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from ...core.checks import listed, warn_caller
from ...core.files import read_limited
from ...core.memory import MemoryShortage
from ...core.names import error_line
from ...errors import InputError, MissingFileError
from ...view.pictures import image_size
from ..box import Bounds
from ..lenses import Lens, all_around
from ..parsing import DYNAMIC_MASK, PictureFinder, chosen_part, floats, inside, is_file, read_text
from ..pictures import COEFFICIENTS, listed_scene, views_there
from ..scene import Scene
from ..sizes import View

#: Bytes of memory that a byte of a binary file takes at most: a picture of 73 bytes becomes a record of some 700.
BINARY_ROOM = 12


class CameraModel(NamedTuple):
    """A camera model of COLMAP."""

    name: str
    # f or fx and fy, cx, cy, and what the lens has: by name as in COEFFICIENTS, or the values of `lens` in their order
    parameters: tuple[str, ...]
    lens: str | None = None  # its name in PROJECTIONS; None for pinholes with OpenCV's distortion


_SINGLE, _BOTH = ("f", "cx", "cy"), ("fx", "fy", "cx", "cy")

#: The camera models, by the number that binary files use.
MODELS = (
    CameraModel("SIMPLE_PINHOLE", _SINGLE),
    CameraModel("PINHOLE", _BOTH),
    CameraModel("SIMPLE_RADIAL", (*_SINGLE, "k1")),
    CameraModel("RADIAL", (*_SINGLE, "k1", "k2")),
    CameraModel("OPENCV", (*_BOTH, *COEFFICIENTS[:4])),
    CameraModel("OPENCV_FISHEYE", (*_BOTH, "k1", "k2", "k3", "k4"), "FISHEYE"),
    CameraModel("FULL_OPENCV", (*_BOTH, *COEFFICIENTS)),
    CameraModel("FOV", (*_BOTH, "omega"), "FOV"),
    CameraModel("SIMPLE_RADIAL_FISHEYE", (*_SINGLE, "k1"), "FISHEYE"),
    CameraModel("RADIAL_FISHEYE", (*_SINGLE, "k1", "k2"), "FISHEYE"),
    CameraModel("THIN_PRISM_FISHEYE", (*_BOTH, *"k1 k2 p1 p2 k3 k4 sx1 sy1".split()), "THIN_PRISM_FISHEYE"),
    CameraModel("RAD_TAN_THIN_PRISM_FISHEYE", (*_BOTH, *"k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3".split()), "FISHEYE624"),
    CameraModel("SIMPLE_DIVISION", (*_SINGLE, "k"), "DIVISION"),
    CameraModel("DIVISION", (*_BOTH, "k"), "DIVISION"),
    CameraModel("SIMPLE_FISHEYE", _SINGLE, "FISHEYE"),
    CameraModel("FISHEYE", _BOTH, "FISHEYE"),
    CameraModel("EUCM", (*_BOTH, "alpha", "beta"), "EUCM"),
    CameraModel("EQUIRECTANGULAR", ("w", "h"), "EQUIRECTANGULAR"),
)


@dataclasses.dataclass
class ModelCamera:
    """A camera of a model."""

    model: str  # name of its kind
    size: tuple[int, int]  # width and height, pixels
    parameters: list[float]


@dataclasses.dataclass
class ModelImage:
    """A picture of a model."""

    name: str  # file, relative to the folder of pictures
    quaternion: tuple[float, ...]  # rotation (w, x, y, z) from world to camera
    translation: tuple[float, ...]  # (x, y, z) from world to camera
    camera: int  # number of its camera

    def camera_to_world(self, where: str) -> np.ndarray:
        """The pose (4, 4) float64 from camera to world, OpenCV axes; where: file and picture, for messages."""
        q = np.array(self.quaternion)
        length = np.linalg.norm(q)
        if not (np.isfinite(length) and length > 1e-12 and np.isfinite(self.translation).all()):
            raise InputError(f"{where} has no rotation or place: quaternion {q.tolist()}, {list(self.translation)}")
        w, x, y, z = q / length
        to_camera = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        pose = np.eye(4)
        pose[:3, :3] = to_camera.T
        pose[:3, 3] = -to_camera.T @ self.translation
        return pose


@dataclasses.dataclass
class Model:
    """A COLMAP model."""

    cameras: dict[int, ModelCamera]  # by number
    images: list[ModelImage]  # in the order of the file
    points: np.ndarray | None  # (n, 3) float64, None where there is no such file
    colors: np.ndarray | None  # (n, 3) float32 in [0, 1], None where the file has none for all points
    cameras_path: pathlib.Path  # for messages, as the next
    images_path: pathlib.Path


def read_images(folder: pathlib.Path) -> list[ModelImage]:
    """The pictures of a model alone."""
    binary = (folder / "images.bin").is_file()
    return (_images_bin if binary else _images_txt)(folder / f"images{'.bin' if binary else '.txt'}")


def read_model(folder: pathlib.Path, *, points: bool = True) -> Model:
    """Read a model, binary where cameras.bin is there; points: its points too."""
    binary = (folder / "cameras.bin").is_file()
    ending = ".bin" if binary else ".txt"
    cameras, images, cloud = (folder / f"{name}{ending}" for name in ("cameras", "images", "points3D"))
    return Model(
        (_cameras_bin if binary else _cameras_txt)(cameras),
        (_images_bin if binary else _images_txt)(images),
        *((_points_bin if binary else _points_txt)(cloud) if points and cloud.is_file() else (None, None)),
        cameras,
        images,
    )


def _lines(path: pathlib.Path):
    """(line number, text) of all lines that are not comments; empty ones too."""
    for line, text in enumerate(read_text(path, "COLMAP file").split("\n"), 1):
        if not text.lstrip().startswith("#"):
            yield line, text.strip()


def _whole(token: str, where: str) -> int:
    try:
        return int(token)
    except ValueError as error:
        raise InputError(f"{where}: {error_line(error, 300)}") from error


def _cameras_txt(path: pathlib.Path) -> dict[int, ModelCamera]:
    cameras = {}
    for line, text in _lines(path):
        where, tokens = f"{path}:{line}", text.split()
        if not tokens:
            continue
        if len(tokens) < 5:
            raise InputError(f"{where}: CAMERA_ID MODEL WIDTH HEIGHT PARAMS expected, got {text[:60]!r}")
        number, width, height = (_whole(tokens[index], where) for index in (0, 2, 3))
        cameras[number] = ModelCamera(tokens[1], (width, height), floats(" ".join(tokens[4:]), where))
    return cameras


def _images_txt(path: pathlib.Path) -> list[ModelImage]:
    images, is_open = [], False  # whether the keypoints of the last image may follow, which some programs leave out
    for line, text in _lines(path):
        tokens = text.split(maxsplit=9)
        if is_open and not _is_image(tokens):
            is_open = False
            continue
        if not tokens:
            continue
        where = f"{path}:{line}"
        if len(tokens) < 10:
            raise InputError(f"{where}: IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME expected, got {text[:60]!r}")
        values = floats(" ".join(tokens[1:8]), where)
        images.append(ModelImage(tokens[9], tuple(values[:4]), tuple(values[4:]), _whole(tokens[8], where)))
        is_open = True
    return images


def _is_image(tokens: list[str]) -> bool:
    """Whether the tokens of a line, the rest in the tenth, are those of an image, not keypoints: X Y POINT3D_ID."""
    if len(tokens) < 10 or not (tokens[0].isdigit() and tokens[8].isdigit()):
        return False
    rest = tokens[9].split()
    try:
        for token in rest[:3]:
            float(token)
    except ValueError:
        return True
    return (9 + len(rest)) % 3 != 0  # a name of digits alone


def _points_txt(path: pathlib.Path) -> tuple[np.ndarray, np.ndarray | None]:
    points, colors, has_colors = array.array("d"), array.array("d"), True  # lists would take four times the memory
    for line, text in _lines(path):
        where, tokens = f"{path}:{line}", text.split(maxsplit=7)
        if not tokens:
            continue
        if len(tokens) < 4:
            raise InputError(f"{where}: POINT3D_ID X Y Z expected, got {text[:60]!r}")
        points.extend(floats(" ".join(tokens[1:4]), where))
        has_colors = has_colors and len(tokens) >= 7
        if has_colors:
            color = floats(" ".join(tokens[4:7]), where)
            if min(color) < 0 or max(color) > 255:
                raise InputError(f"{where}: R G B must lie in 0 to 255, got {' '.join(tokens[4:7])[:60]!r}")
            colors.extend(color)
    places = np.array(points, np.float64).reshape(-1, 3)
    return places, (np.array(colors) / 255.0).astype(np.float32).reshape(-1, 3) if has_colors else None


# Binary: little endian, a count and then records


class _Bytes:
    """A file's bytes from front to back; reading beyond the end is refused."""

    def __init__(self, path: pathlib.Path):
        self.path, self.data, self.position = path, read_limited(path, "COLMAP file", BINARY_ROOM), 0

    def take(self, layout: str) -> tuple:
        size = struct.calcsize(layout)
        self.skip(size)
        return struct.unpack_from(layout, self.data, self.position - size)

    def skip(self, size: int) -> None:
        if size > len(self.data) - self.position:
            raise InputError(f"{self.path} ends after {len(self.data)} bytes, {self.position + size} are announced")
        self.position += size

    def name(self) -> str:
        end = self.data.find(b"\0", self.position)
        if end < 0:
            raise InputError(f"{self.path} ends within a name")
        text = self.data[self.position : end].decode("utf-8", errors="surrogateescape")
        self.position = end + 1
        return text

    def count(self, smallest: int) -> int:
        """The number of records to come, of at least `smallest` bytes each."""
        (count,) = self.take("<Q")
        if count * smallest > len(self.data) - self.position:
            raise InputError(f"{self.path} announces {count} records, more than {len(self.data)} bytes hold")
        return count


def _cameras_bin(path: pathlib.Path) -> dict[int, ModelCamera]:
    file, cameras = _Bytes(path), {}
    for _ in range(file.count(40)):
        number, model, width, height = file.take("<iiQQ")
        if not 0 <= model < len(MODELS):
            raise InputError(
                f"{path}: camera {number} has the model of number {model}, which is not known: those that are read go "
                f"from 0 to {len(MODELS) - 1} ({MODELS[-1].name}); run COLMAP's image_undistorter"
            )
        parameters = file.take(f"<{len(MODELS[model].parameters)}d")
        if not np.isfinite(parameters).all():
            raise InputError(f"{path}: camera {number} has parameters that are not finite")
        cameras[number] = ModelCamera(MODELS[model].name, (width, height), list(parameters))
    return cameras


def _images_bin(path: pathlib.Path) -> list[ModelImage]:
    file, images = _Bytes(path), []
    for _ in range(file.count(73)):
        _, *values, camera = file.take("<i7di")
        images.append(ModelImage(file.name(), tuple(values[:4]), tuple(values[4:]), camera))
        file.skip(24 * file.take("<Q")[0])
    return images


def _points_bin(path: pathlib.Path) -> tuple[np.ndarray, np.ndarray]:
    file, points, colors = _Bytes(path), array.array("d"), bytearray()
    for _ in range(file.count(51)):
        _, x, y, z, red, green, blue, _, track = file.take("<Q3d3BdQ")
        points.extend((x, y, z))
        colors.extend((red, green, blue))
        file.skip(8 * track)
    places = np.array(points, np.float64).reshape(-1, 3)
    if not np.isfinite(places).all():
        raise InputError(f"{path} holds points that are not finite")
    return places, np.frombuffer(colors, np.uint8).reshape(-1, 3) / np.float32(255)


MARK = "sparse/0/ with cameras and images, .bin or .txt"

#: Where models lie, themselves or in folders by number: COLMAP's own folders, nerfstudio's, hloc's, those of pictures
#: whose lens was undone, and beside the pictures, as RealityScan exports them.
MODEL_FOLDERS = (
    *("sparse", "colmap/sparse", "sparse/0/models", "dense/sparse", "dense/0/sparse"),
    *("undistorted/sparse", "undistorted", ""),
)

#: Where their pictures lie.
PICTURE_FOLDERS = ("images", "dense/images", "dense/0/images", "undistorted/images", "")

#: Numbers of text and of binary files are the same within this.
SAME = 1e-4

#: Pictures, evenly, whose sizes are compared with those that a model's cameras are for.
COMPARED = 12


def is_scene(folder: pathlib.Path) -> bool:
    """Whether a folder holds a COLMAP model."""
    return any(_models(folder))


def _models(folder: pathlib.Path) -> Iterator[list[str]]:
    """Models of a scene, relative to it: those of each of MODEL_FOLDERS that has any."""
    for name in MODEL_FOLDERS:
        base = folder / name
        numbers = [path.name for path in base.iterdir() if path.name.isdigit()] if name and base.is_dir() else []
        found = [f"{name}/{number}" for number in sorted(numbers, key=int)] + [name]
        models = [each for each in found if _has_model(folder / each)]
        if models:
            yield models


def _has_model(folder: pathlib.Path) -> bool:
    return any((folder / f"cameras{e}").is_file() and (folder / f"images{e}").is_file() for e in (".bin", ".txt"))


def _chosen_model(folder: pathlib.Path, wanted: str | None) -> pathlib.Path:
    """The folder of the wanted model; or of the one with most pictures, in the first of MODEL_FOLDERS with models for
    pictures of the sizes that are there, and a warning that names the others."""
    groups = list(_models(folder))
    if not groups:
        raise MissingFileError(f"{str(folder)!r} holds no COLMAP model ({MARK})")
    names = [name for models in groups for name in models]
    if wanted is not None:
        return folder / chosen_part(dict.fromkeys(names, 0), wanted, folder, "COLMAP model")
    chosen = groups[0]
    if len(names) > 1:
        fitting = (
            [name for name in models if _fits(folder, read_model(folder / name, points=False))] for models in groups
        )
        chosen = next(filter(None, fitting), chosen)
    counts = {name: len(read_images(folder / name)) if len(chosen) > 1 else 0 for name in chosen}
    taken = chosen_part(counts, None, folder, "COLMAP model")
    others = [name or "." for name in groups[0] if name not in chosen]
    if others:
        warn_caller(
            f"{folder}: the COLMAP model {taken or '.'} is taken, whose cameras are for pictures of the size that is "
            f"there; those of {listed(others)} are for pictures of another; model= chooses (--model)"
        )
    return folder / taken


def _fits(folder: pathlib.Path, model: Model) -> bool:
    """Whether a model's cameras are for pictures of the sizes that they have."""
    return _fitting_count(folder, _picture_folders(folder, model)[0], model) > 0


def _fitting_count(folder: pathlib.Path, home: str, model: Model) -> int:
    """How many of some pictures of a model, in a folder of the scene, have the size that their camera is for, upright
    or not; 0 where fewer than half have."""
    bounds, there = Bounds(folder), [image for image in model.images if is_file(folder / home / image.name)]
    some, count = there[:: max(1, len(there) // COMPARED)], 0
    for image in some:
        with contextlib.suppress(ValueError, OSError):  # a damaged one, or one that lies elsewhere
            size = image_size(bounds.require(inside(folder / home, image.name, ""), ""))
            camera = model.cameras.get(image.camera)
            count += camera is not None and camera.size in (size, size[::-1])
    return count if 2 * count >= len(some) else 0


def read(folder: pathlib.Path, *, split: str, model: str | None = None, **options: Any) -> Scene:
    """Read a split: every eighth image, by name, is `test`, the others are `train`. Options as for `load_scene`."""
    found = read_model(_chosen_model(folder, model))
    _warn_of_text_files(found)
    if not found.images:
        raise InputError(f"{found.images_path} holds no images")
    finder = PictureFinder(folder, _picture_folders(folder, found))
    views = [_view(finder, found, image) for image in found.images]
    views = views_there(views, found.images_path)
    options |= {"points": found.points, "point_colors": found.colors}
    # which looks at whether they lie within the folder
    scene = listed_scene(folder, views, split, found.images_path, finder, **options)
    _warn_of_unlisted(views, found.images_path)
    return scene


def _warn_of_unlisted(views: list[View], path: pathlib.Path) -> None:
    """Warn of pictures beside those of a model that it has no camera for."""
    known = {(view.file.parent, view.file.stem) for view in views}
    endings = {view.file.suffix.lower() for view in views}
    folders = {view.file.parent for view in views if view.file.parent.is_dir()}  # smaller copies may stand for it
    beside = (file for folder in folders for file in folder.iterdir())
    others = sorted(
        file.name
        for file in beside
        if file.suffix.lower() in endings
        and not {(file.parent, file.stem), (file.parent, pathlib.Path(file.stem).stem)} & known  # 1.png.png is a mask
        and not file.name.startswith((DYNAMIC_MASK, "."))
    )
    if others:
        count = len(others)
        warn_caller(
            f"{path}: {count} of {len(views) + count} pictures have no camera and are left out ({listed(others, 3)})"
        )


def _warn_of_text_files(model: Model) -> None:
    """Warn where text files beside the binary ones that are read, as COLMAP does too, say something else."""
    cameras, images = (path.with_suffix(".txt") for path in (model.cameras_path, model.images_path))
    if model.cameras_path.suffix == ".txt" or not (cameras.is_file() and images.is_file()):
        return
    try:
        same = _is_same(model, Model(_cameras_txt(cameras), _images_txt(images), None, None, cameras, images))
    except MemoryShortage:  # of many keypoints: what is read does not need it
        return
    except InputError:  # of another program, or half edited
        same = False
    if not same:
        warn_caller(
            f"{model.cameras_path} and {model.images_path.name} are read, and the .txt files beside them say something "
            "else: remove those that are not wanted"
        )


def _is_same(one: Model, other: Model) -> bool:
    """Whether two models have the same pictures, lenses and poses, up to the digits of text."""
    held = [{image.name: image for image in model.images} for model in (one, other)]
    if held[0].keys() != held[1].keys():
        return False
    for name in held[0]:
        lenses = [model.cameras.get(each[name].camera) for model, each in zip((one, other), held, strict=True)]
        poses = [
            each[name].camera_to_world(f"{model.images_path}: image {name!r}")
            for model, each in zip((one, other), held, strict=True)
        ]
        if not np.allclose(*poses, rtol=SAME, atol=SAME) or not _is_same_lens(*lenses):
            return False
    return True


def _is_same_lens(one: ModelCamera | None, other: ModelCamera | None) -> bool:
    """Whether two cameras of models are the same."""
    if (
        one is None
        or other is None
        or (one.model, one.size, len(one.parameters)) != (other.model, other.size, len(other.parameters))
    ):
        return one is other
    return np.allclose(one.parameters, other.parameters, rtol=SAME, atol=SAME)


def _picture_folders(folder: pathlib.Path, model: Model) -> list[str]:
    """The folders of pictures: first the one where most of the model's are, of its size; the usual one if none is."""

    def order(name: str) -> tuple[int, int]:
        count = sum(is_file(folder / name / image.name) for image in model.images)
        return count, _fitting_count(folder, name, model) if count else 0

    return sorted(PICTURE_FOLDERS, key=order, reverse=True)


def _view(finder: PictureFinder, model: Model, image: ModelImage) -> View:
    """One picture of a model with its camera."""
    where = f"{model.images_path}: image {image.name!r}"
    file = finder.find(image.name, where)
    camera = model.cameras.get(image.camera)
    if camera is None:
        raise InputError(f"{where} has camera {image.camera}, which {model.cameras_path} lacks")
    lens = _lens(camera, f"{model.cameras_path}: camera {image.camera}")
    return View(file, image.camera_to_world(where), where, size=camera.size, **lens)


def _lens(camera: ModelCamera, where: str) -> dict[str, Any]:
    """What a View takes of the lens of a camera."""
    found = next((each for each in MODELS if each.name == camera.model), None)
    if found is None:
        raise InputError(
            f"{where}: camera model {camera.model[:60]!r} is not read, only {', '.join(each.name for each in MODELS)}: "
            "run COLMAP's image_undistorter"
        )
    names = found.parameters
    if len(camera.parameters) != len(names):
        raise InputError(f"{where} needs {len(names)} parameters ({' '.join(names)}), got {len(camera.parameters)}")
    if found.lens == "EQUIRECTANGULAR":
        return {"intrinsics": all_around, "lens": Lens(found.lens)}
    given = dict(zip(names, camera.parameters, strict=True))
    fx, fy = (given[name] if name in given else given["f"] for name in ("fx", "fy"))
    intrinsics = (fx, fy, given["cx"], given["cy"])
    if found.lens is None:
        return {"intrinsics": intrinsics, "distortion": tuple(given.get(name, 0.0) for name in COEFFICIENTS)}
    first = names.index("cy") + 1
    return {"intrinsics": intrinsics, "lens": Lens(found.lens, tuple(camera.parameters[first:]))}
