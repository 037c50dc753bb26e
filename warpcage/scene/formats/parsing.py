"""Read what scene folders say in text: numbers, matrices, JSON, and names of files that must stay in their folder."""

from __future__ import annotations

import codecs
import contextlib
import json
import math
import os
import pathlib
import re
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from ...core.checks import listed, shown, warn_caller
from ...core.files import JSON_ROOM, TEXT_ROOM, read_limited, require_file
from ...core.names import error_line
from ...errors import InputError, MissingFileError

#: Endings of pictures, and what is tried where a name has none.
PICTURE_ENDINGS = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff", ".avif", ".heic", ".heif")

GUESSED_ENDINGS = (*PICTURE_ENDINGS, *(ending.upper() for ending in PICTURE_ENDINGS))

#: Where a format has no splits of its own, every eighth picture is held out.
HOLD_OUT = 8

#: From the camera axes of Blender and OpenGL (+y up, -z forward) to OpenCV's, to multiply poses with from the right.
TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def decoded(data: bytes) -> str:
    """The text of a file, UTF-8 or UTF-16, without the mark at its beginning; other bytes stay as in names of files."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", "surrogateescape")
    return data.removeprefix(codecs.BOM_UTF8).decode("utf-8", "surrogateescape")


def read_json(path: pathlib.Path, kind: type = dict) -> Any:
    """The JSON object, or the list, that a file holds."""
    path = require_file(path, "file")
    try:
        content = json.loads(decoded(read_limited(path, "file", JSON_ROOM)))
    except (ValueError, RecursionError) as error:  # wrong bytes, wrong syntax, brackets without end
        raise InputError(f"{path} is no JSON file: {error_line(error, 300)}") from error
    if not isinstance(content, kind):
        raise InputError(f"{path} must hold a JSON {'object' if kind is dict else 'list'}")
    return content


def read_text(path: pathlib.Path, what: str) -> str:
    """The text of a file; what: how messages call it."""
    try:
        return decoded(read_limited(path, what, TEXT_ROOM))
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is no text file: {error_line(error, 300)}") from error


#: A number as programs write it in countries where a comma stands before the decimals.
DECIMAL_COMMA = re.compile(r"[-+]?[0-9]*,[0-9]+([eE][-+]?[0-9]+)?")


def floats(text: str, where: str) -> list[float]:
    """The numbers in a text, all finite, with decimal points or with decimal commas."""
    words = text.split()
    if "," in text and "." not in text:
        words = [word.replace(",", ".") if DECIMAL_COMMA.fullmatch(word) else word for word in words]
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        mixed = " (decimal commas beside points)" if "," in text and "." in text else ""
        raise InputError(f"{where}: {error_line(error, 300)}{mixed}") from error
    if not all(map(math.isfinite, values)):
        raise InputError(f"{where} holds numbers that are not finite")
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
    raise InputError(f"{where} must be a finite number, got {shown(value)}")


def picture_size(width: float, height: float, where: str) -> tuple[int, int]:
    """Sides of a picture in whole pixels; refused where no picture has them."""
    if not 1 <= min(width, height) <= max(width, height) < 1e6:
        raise InputError(f"{where} is for {width:g}x{height:g} pixels")
    return int(width), int(height)


def matrix(value: object, shape: tuple[int, int], where: str) -> np.ndarray:
    """A matrix of finite numbers out of JSON lists, float64."""
    rows, columns = shape
    if not (
        isinstance(value, list)
        and len(value) == rows
        and all(isinstance(row, list) and len(row) == columns for row in value)
    ):
        raise InputError(f"{where} must be a {rows}x{columns} matrix, got {shown(value)}")
    return np.array(
        [[number(entry, f"{where}[{i}][{j}]") for j, entry in enumerate(row)] for i, row in enumerate(value)]
    )


def inside(folder: pathlib.Path, name: object, where: str) -> pathlib.Path:
    """The path of `name` in `folder`; refused where it is the folder, or leads out of it by its words alone."""
    if not isinstance(name, str) or not name.strip() or "\0" in name or len(name) > 4000:
        raise InputError(f"{where} must be the name of a file, got {shown(name)}")
    root = os.path.abspath(folder)
    relative = os.path.relpath(os.path.join(root, name.replace("\\", "/")), root)
    if relative == os.curdir:
        raise InputError(f"{where}: {shown(name)} is the data folder {str(folder)!r}, not a file in it")
    if relative.split(os.sep)[0] == os.pardir:
        raise InputError(f"{where}: {shown(name)} leads out of the data folder {str(folder)!r}")
    return folder / relative


class PictureFinder:
    """Finds the files that lists of pictures name: in one of several folders, however the names are encoded, and by the
    ends of paths of another machine."""

    def __init__(self, folder: pathlib.Path, homes: Sequence[str] = ("",)):
        self.folder = folder
        self.homes = [folder / home for home in homes]  # where names begin, the usual one first
        self.places = list(dict.fromkeys([*self.homes, folder / "images", folder]))  # where files of other paths may be
        self.moved: list[str] = []  # names that were found by their ends

    def find(self, name: object, where: str) -> pathlib.Path:
        """The file of a name, of a picture where it has no ending; it may not be there. ValueError where a name leads
        out of the folder, and no file in it has its end."""
        usual = None
        with contextlib.suppress(ValueError):
            usual = _with_ending(inside(self.homes[0], name, where))
        if usual is not None and is_file(usual):
            return usual
        if isinstance(name, str):
            for spelled in _spellings(name):
                if not _leads_out(self.homes[0], spelled):
                    found = self._first(self.homes, spelled)
                else:
                    found = next(filter(None, (self._first(self.places, end) for end in _ends(spelled))), None)
                    self.moved += [name] if found else []
                if found is not None:
                    return found
        return _with_ending(inside(self.homes[0], name, where)) if usual is None else usual

    def _first(self, folders: Iterable[pathlib.Path], name: str) -> pathlib.Path | None:
        """The first of some folders' files of a name."""
        for folder in folders:
            with contextlib.suppress(ValueError):  # no name of a file
                path = _with_ending(inside(folder, name, ""))
                if is_file(path):
                    return path
        return None

    def name_of(self, file: pathlib.Path) -> str:
        """The name of a picture, relative to the folder of pictures that it is in."""
        home = next(home for home in [*self.homes, file.parent] if file.is_relative_to(home))
        return str(file.relative_to(home))

    def tell(self, listing: pathlib.Path) -> None:
        """Warn where pictures were found by the ends of their paths; listing: the file that lists them."""
        if self.moved:
            warn_caller(
                f"{listing} names {len(self.moved)} files by paths of another folder, the first is "
                f"{shown(self.moved[0])}: files of these names in {str(self.folder)!r} are taken"
            )


#: What file names are encoded in besides UTF-8: simplified Chinese, Japanese, Korean, traditional Chinese, Western.
ENCODINGS = ("gb18030", "cp932", "cp949", "big5", "cp1252")


def _spellings(name: str) -> Iterator[str]:
    """A name as it is, and as it may be meant: with an ending in other letters (.JPG), where its bytes are no UTF-8, or
    its accents are letters of their own."""
    yield name
    stem, dot, ending = name.rpartition(".")
    yield from (f"{stem}{dot}{each}" for each in (ending.lower(), ending.upper()) if each != ending)
    if name.isascii():
        return
    for form in ("NFC", "NFD"):
        yield unicodedata.normalize(form, name)
    with contextlib.suppress(UnicodeEncodeError):
        data = name.encode("utf-8", "surrogateescape")
        for encoding in ENCODINGS:
            with contextlib.suppress(UnicodeDecodeError):
                yield data.decode(encoding)


def _leads_out(folder: pathlib.Path, name: str) -> bool:
    """Whether a name is a path of another place: from a root, a drive or a file://, or back out of the folder."""
    if re.match(r"[A-Za-z]+:[\\/]", name):
        return True
    try:
        inside(folder, name, "")
    except ValueError:
        return True
    return False


def _ends(name: str) -> Iterator[str]:
    """The ends of a path, the longest first, down to the file's own name."""
    parts = [part for part in name.replace("\\", "/").split("/") if part not in ("", ".", "..")]
    parts = parts[-MOST_FOLDERS:]
    return ("/".join(parts[first:]) for first in range(len(parts)))


#: Folders of a path of another machine that are looked for.
MOST_FOLDERS = 8


def find_picture(folder: pathlib.Path, name: object, where: str) -> pathlib.Path:
    """The picture that `name` means in `folder`, with an ending where it has none; it may not be there."""
    return PictureFinder(folder).find(name, where)


def _with_ending(path: pathlib.Path) -> pathlib.Path:
    """A path of a picture, with the first ending that is there where it has none."""
    if path.suffix.lower() in (*PICTURE_ENDINGS, ".ply") or is_file(path):
        return path
    candidates = [path.with_name(path.name + ending) for ending in GUESSED_ENDINGS]
    return next((candidate for candidate in candidates if is_file(candidate)), candidates[0])


#: What begins the names of masks of what moves, which instant-ngp's scripts write beside the pictures.
DYNAMIC_MASK = "dynamic_mask_"


def pictures_in(folder: pathlib.Path) -> list[pathlib.Path]:
    """The pictures of a folder by name; FileNotFoundError where there is none."""
    files = sorted(file for file in folder.glob("*") if file.suffix.lower() in PICTURE_ENDINGS)
    files = [file for file in files if not file.name.startswith(DYNAMIC_MASK)]
    if not files:
        raise MissingFileError(f"folder {str(folder)!r} holds no pictures ({', '.join(PICTURE_ENDINGS)})")
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
        raise InputError(
            f"split {split!r} of {str(folder)!r} is empty: every {HOLD_OUT}th picture is held out as "
            f"'test', and there is {count}"
        )
    return splits[split]


def chosen_part(counts: dict[str, int], wanted: str | None, where: pathlib.Path, kind: str) -> str:
    """The name of one of several models in a scene: the one that was asked for, or the one with most pictures; others
    are told of. counts: pictures by name; kind: what messages call a model."""
    if wanted is not None:
        fitting = [name for name in counts if wanted in (name, name.rpartition("/")[2])]
        if not fitting:
            raise InputError(f"{str(where)!r} holds no {kind} {wanted!r}, only {listed(counts)}")
        return fitting[0]
    most = max(counts, key=counts.__getitem__)
    others = [f"{name} ({count})" for name, count in counts.items() if count and name != most]
    if others:
        warn_caller(
            f"{where}: of {len(counts)} {kind}s {most} is taken, which has most pictures ({counts[most]}); others: "
            f"{listed(others)}; model= chooses (--model)"
        )
    return most


def missing_split(split: str, folder: pathlib.Path, splits: Iterable[str]) -> FileNotFoundError:
    """An error that names the splits there are."""
    return MissingFileError(f"split {split!r} of {str(folder)!r} is not there; splits: {listed(splits)}")


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
        raise InputError(f"{path} holds no frames")
    for index, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise InputError(f"{path}: frame {index} must be a JSON object")
    return [(f"{path}: frame {index}", frame) for index, frame in enumerate(frames)]
