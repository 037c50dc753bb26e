"""Read what scene folders say in text: numbers, matrices, JSON, and names of files that must stay in their folder."""

from __future__ import annotations

import json
import math
import os
import pathlib
from collections.abc import Iterable

import numpy as np

from ...core.checks import listed, shown
from ...core.files import JSON_ROOM, TEXT_ROOM, read_limited, require_file
from ...core.names import error_line

#: Endings of pictures, and what is tried where a name has none.
PICTURE_ENDINGS = (".png", ".jpg", ".jpeg", ".webp", ".bmp")

GUESSED_ENDINGS = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG", ".webp")

#: Where a format has no splits of its own, every eighth picture is held out.
HOLD_OUT = 8

#: From the camera axes of Blender and OpenGL (+y up, -z forward) to OpenCV's, to multiply poses with from the right.
TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def read_json(path: pathlib.Path) -> dict:
    """The JSON object that a file holds."""
    path = require_file(path, "file")
    try:
        content = json.loads(read_limited(path, "file", JSON_ROOM).decode("utf-8"))
    except (ValueError, RecursionError) as error:  # wrong bytes, wrong syntax, brackets without end
        raise ValueError(f"{path} is no JSON file: {error_line(error, 300)}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} must hold a JSON object")
    return content


def read_text(path: pathlib.Path, what: str) -> str:
    """The text of a file; what: how messages call it."""
    try:
        return read_limited(path, what, TEXT_ROOM).decode("utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is no text file: {error_line(error, 300)}") from error


def floats(text: str, where: str) -> list[float]:
    """The numbers in a text, all finite."""
    try:
        values = [float(word) for word in text.split()]
    except ValueError as error:
        raise ValueError(f"{where}: {error_line(error, 300)}") from error
    if not all(map(math.isfinite, values)):
        raise ValueError(f"{where} holds numbers that are not finite")
    return values


def number(value: object, where: str) -> float:
    """A finite number out of JSON; text, truth values and null are none."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            value = float(value)
        except OverflowError:
            value = math.inf
        if math.isfinite(value):
            return value
    raise ValueError(f"{where} must be a finite number, got {shown(value)}")


def matrix(value: object, shape: tuple[int, int], where: str) -> np.ndarray:
    """A matrix of finite numbers out of JSON lists, float64."""
    rows, columns = shape
    if not (
        isinstance(value, list)
        and len(value) == rows
        and all(isinstance(row, list) and len(row) == columns for row in value)
    ):
        raise ValueError(f"{where} must be a {rows}x{columns} matrix, got {shown(value)}")
    return np.array(
        [[number(entry, f"{where}[{i}][{j}]") for j, entry in enumerate(row)] for i, row in enumerate(value)]
    )


def inside(folder: pathlib.Path, name: object, where: str) -> pathlib.Path:
    """The path of `name` in `folder`; refused where it is the folder, or leads out of it by its words alone."""
    if not isinstance(name, str) or not name.strip() or "\0" in name or len(name) > 4000:
        raise ValueError(f"{where} must be the name of a file, got {shown(name)}")
    root = os.path.abspath(folder)
    relative = os.path.relpath(os.path.join(root, name.replace("\\", "/")), root)
    if relative == os.curdir:
        raise ValueError(f"{where}: {shown(name)} is the data folder {str(folder)!r}, not a file in it")
    if relative.split(os.sep)[0] == os.pardir:
        raise ValueError(f"{where}: {shown(name)} leads out of the data folder {str(folder)!r}")
    return folder / relative


def find_picture(folder: pathlib.Path, name: object, where: str) -> pathlib.Path:
    """The picture that `name` means in `folder`, with an ending where it has none; it may not be there."""
    path = inside(folder, name, where)
    if path.suffix.lower() in PICTURE_ENDINGS or is_file(path):
        return path
    candidates = [path.with_name(path.name + ending) for ending in GUESSED_ENDINGS]
    return next((candidate for candidate in candidates if is_file(candidate)), candidates[0])


def pictures_in(folder: pathlib.Path) -> list[pathlib.Path]:
    """The pictures of a folder by name; FileNotFoundError where there is none."""
    files = sorted(file for file in folder.glob("*") if file.suffix.lower() in PICTURE_ENDINGS)
    if not files:
        raise FileNotFoundError(f"folder {str(folder)!r} holds no pictures ({', '.join(PICTURE_ENDINGS)})")
    return files


def is_file(path: pathlib.Path) -> bool:
    """Whether a file is there; no for names that no file can have."""
    try:
        return path.is_file()
    except OSError:  # a name that is too long for the file system
        return False


def held_out(count: int, split: str, folder: pathlib.Path) -> list[int]:
    """Indices of a split where the format has none: every eighth is `test`, the rest `train`; `all` is both."""
    splits = {
        "train": [i for i in range(count) if i % HOLD_OUT],
        "test": list(range(0, count, HOLD_OUT)),
        "all": list(range(count)),
    }
    if split not in splits:
        raise missing_split(split, folder, splits)
    if not splits[split]:
        raise ValueError(
            f"split {split!r} of {str(folder)!r} is empty: every {HOLD_OUT}th picture is held out as "
            f"'test', and there is {count}"
        )
    return splits[split]


def missing_split(split: str, folder: pathlib.Path, splits: Iterable[str]) -> FileNotFoundError:
    """An error that names the splits there are."""
    return FileNotFoundError(f"split {split!r} of {str(folder)!r} is not there; splits: {listed(splits)}")


def split_file(folder: pathlib.Path, split: str) -> pathlib.Path:
    """The file transforms_<split>.json of a folder; FileNotFoundError that names the splits there are."""
    files = {file.stem.removeprefix("transforms_"): file for file in sorted(folder.glob("transforms_*.json"))}
    if split not in files:
        raise missing_split(split, folder, files)
    return files[split]


def frames_of(transforms: dict, path: pathlib.Path) -> list[tuple[str, dict]]:
    """The frames of a transforms file, each with its name for messages."""
    frames = transforms.get("frames")
    if not isinstance(frames, list) or not frames:
        raise ValueError(f"{path} holds no frames")
    for index, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise ValueError(f"{path}: frame {index} must be a JSON object")
    return [(f"{path}: frame {index}", frame) for index, frame in enumerate(frames)]
