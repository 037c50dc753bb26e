"""Text files of scene folders: numbers, matrices, tables, JSON, and names of files that must stay in their folder."""

from __future__ import annotations

import codecs
import contextlib
import csv
import json
import math
import os
import pathlib
import re
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from ..core.checks import checked_number, listed, shown, warn_caller
from ..core.files import JSON_ROOM, TEXT_ROOM, read_limited, require_file, seen_note
from ..core.names import counted, error_line
from ..errors import InputError, MissingFileError
from .lenses import Intrinsics

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
        raise InputError(f"{path} is not a JSON file{seen_note(path, 'JSON')}: {error_line(error, 300)}") from error
    if not isinstance(content, kind):
        raise InputError(f"{path} must hold a JSON {'object' if kind is dict else 'list'}")
    return content


def read_text(path: pathlib.Path, what: str) -> str:
    """The text of a file; what: how messages call it."""
    try:
        return decoded(read_limited(path, what, TEXT_ROOM))
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not a text file: {error_line(error, 300)}") from error


#: A number as programs write it in countries where a comma stands before the decimals.
DECIMAL_COMMA = re.compile(r"[-+]?[0-9]*,[0-9]+([eE][-+]?[0-9]+)?")


def floats(text: str, where: str) -> list[float]:
    """The numbers in a text, all finite, with decimal points or with decimal commas."""
    tokens = text.split()
    if "," in text and "." not in text:
        tokens = [token.replace(",", ".") if DECIMAL_COMMA.fullmatch(token) else token for token in tokens]
    try:
        values = [float(token) for token in tokens]
    except ValueError as error:
        mixed = " (decimal commas beside points)" if "," in text and "." in text else ""
        raise InputError(f"{where}: {error_line(error, 300)}{mixed}") from error
    if not all(map(math.isfinite, values)):
        raise InputError(f"{where} holds numbers that are not finite")
    return values


def numbers(value: object, count: int, where: str) -> list[float]:
    """As many finite numbers out of a JSON list."""
    if not isinstance(value, list) or len(value) != count:
        raise InputError(f"{where} must hold {count} numbers, got {shown(value)}")
    return [checked_number(each, where) for each in value]


def table_rows(path: pathlib.Path, what: str, columns: Sequence[str]) -> Iterator[tuple[str, dict[str, str]]]:
    """The rows of a .csv file by the names in its first line, each with its place for messages; columns: that it needs;
    what: how messages call the file."""
    rows = csv.reader(read_text(path, what).splitlines(), skipinitialspace=True)
    head = [name.strip() for name in next(rows, [])]
    missing = [name for name in columns if name not in head]
    if missing:
        raise InputError(f"{path} lacks the columns {listed(missing)}, which its first line must name")
    for row in filter(None, rows):
        where = f"{path}:{rows.line_num}"
        if len(row) < len(head):
            raise InputError(f"{where}: {len(head)} values expected, as in the first line, got {shown(','.join(row))}")
        yield where, dict(zip(head, row, strict=False))


def first_with(paths: Iterable[pathlib.Path], count: int, *marks: bytes) -> pathlib.Path | None:
    """The first file that has all marks within its first `count` bytes, spaces left out."""
    for path in paths:
        if path.is_file():
            with path.open("rb") as opened:
                head = opened.read(count).replace(b" ", b"")
            if all(mark in head for mark in marks):
                return path
    return None


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
        [[checked_number(entry, f"{where}[{i}][{j}]") for j, entry in enumerate(row)] for i, row in enumerate(value)]
    )


def matrix_file(path: pathlib.Path, sides: Sequence[int], text: str | None = None) -> np.ndarray:
    """The square matrix of a text file, of one of some sides, float64; text: what the file holds, if it was read."""
    values = floats(read_text(path, "matrix file") if text is None else text, str(path))
    side = next((each for each in sides if each * each == len(values)), None)
    if side is None:
        wanted = " or ".join(f"{each}x{each}" for each in sides)
        raise InputError(f"{path} must hold a {wanted} matrix, got {len(values)} numbers")
    return np.reshape(values, (side, side))


def intrinsics_of(k: np.ndarray, where: str) -> Intrinsics:
    """The intrinsics of a camera matrix (3, 3) or (4, 4); refused with skew."""
    if max(abs(k[0, 1]), abs(k[1, 0])) > 1e-6 * abs(k[0, 0]):
        raise InputError(f"{where}: a camera matrix with skew {k[0, 1]:g} is not read")
    return float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2])


def inside(folder: pathlib.Path, name: object, where: str) -> pathlib.Path:
    """The path of `name` in `folder`; refused where it is the folder, or leads out of it, links aside."""
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
        self.changed: list[str] = []  # names that were found with another ending
        self._known: dict[pathlib.Path, dict[str, list[pathlib.Path]]] = {}

    def find(self, name: object, where: str) -> pathlib.Path:
        """The file of a name, of a picture where it has no ending; it may not be there. ValueError where a name leads
        out of the folder to a file, and none in it has its end, or may be one of several with other endings."""
        usual = None
        with contextlib.suppress(ValueError):
            usual = _with_ending(inside(self.homes[0], name, where))
        if usual is not None and is_file(usual):
            return usual
        if isinstance(name, str):
            found = self._spelled(name) or self._of_other_ending(name, where)
            if found is not None:
                return found
            foreign = pathlib.PurePosixPath(name).is_absolute() or pathlib.PureWindowsPath(name).is_absolute()
            own = [*_ends(name)][-1:]
            if foreign and usual is None and own and "\0" not in name and not os.path.lexists(self.homes[0] / name):
                return _with_ending(inside(self.homes[0], own[0], where))  # a path of another machine
        return _with_ending(inside(self.homes[0], name, where)) if usual is None else usual

    def _spelled(self, name: str) -> pathlib.Path | None:
        """The file of a name as it may be meant, or of the end of a path of elsewhere."""
        for spelled in _spellings(name):
            if not _leads_out(self.homes[0], spelled):
                found = self._first(self.homes, spelled)
            else:
                found = next(filter(None, (self._first(self.places, end) for end in _ends(spelled))), None)
                self.moved += [name] if found else []
            if found is not None:
                return found
        return None

    def _first(self, folders: Iterable[pathlib.Path], name: str) -> pathlib.Path | None:
        """The first of some folders' files of a name."""
        for folder in folders:
            with contextlib.suppress(ValueError):  # no name of a file
                path = _with_ending(inside(folder, name, ""))
                if is_file(path):
                    return path
        return None

    def _of_other_ending(self, name: str, where: str) -> pathlib.Path | None:
        """The picture of a name, or of the end of a path of elsewhere, with another ending; what it would be, where its
        smaller copies alone are there. ValueError for several."""
        is_moved = _leads_out(self.homes[0], name)
        for end in _ends(name) if is_moved else [name]:
            for home in self.places if is_moved else self.homes:
                path = None
                with contextlib.suppress(ValueError):  # no name of a file
                    path = inside(home, end, "")
                if path is None or path.suffix.lower() not in PICTURE_ENDINGS:
                    continue
                found = self._pictures_of(path.parent).get(path.stem, [])
                if len(found) > 1:
                    raise InputError(
                        f"{where}: {shown(name)} is not there, and {listed(sorted(each.name for each in found))} may "
                        f"each be what it means: name the one in the list, or leave it alone in {str(path.parent)!r}"
                    )
                if found or smaller_copies(path, self.folder):
                    self.moved += [name] if is_moved else []
                    self.changed += [name] if found else []
                    return found[0] if found else path
        return None

    def _pictures_of(self, folder: pathlib.Path) -> dict[str, list[pathlib.Path]]:
        """The pictures of a folder by their names without ending."""
        if folder not in self._known:
            known: dict[str, list[pathlib.Path]] = {}
            for file in folder.glob("*") if is_folder(folder) else ():
                if file.suffix.lower() in PICTURE_ENDINGS:
                    known.setdefault(file.stem, []).append(file)
            self._known[folder] = known
        return self._known[folder]

    def warn_of_changed_names(self, listing: pathlib.Path) -> None:
        """Warn of pictures that were found by the ends of their paths, or with other endings than `listing` has."""
        said = [
            f"{counted(len(names), 'file')} {changed}, the first is {shown(names[0])}"
            for names, changed in ((self.moved, "by paths of another folder"), (self.changed, "with another ending"))
            if names
        ]
        if said:
            warn_caller(
                f"{listing} names {', and '.join(said)}: files of these names in {str(self.folder)!r} are taken"
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
    parts = parts[-MAX_FOLDERS:]
    return ("/".join(parts[first:]) for first in range(len(parts)))


#: Folders of a path of another machine that are looked for.
MAX_FOLDERS = 8


def find_picture(folder: pathlib.Path, name: object, where: str) -> pathlib.Path:
    """The picture that `name` means in `folder`, with an ending where it has none; it may not be there."""
    return PictureFinder(folder).find(name, where)


def _with_ending(path: pathlib.Path) -> pathlib.Path:
    """A path of a picture, with the first ending that is there where it has none."""
    if path.suffix.lower() in (*PICTURE_ENDINGS, ".ply") or is_file(path):
        return path
    candidates = [path.with_name(path.name + ending) for ending in GUESSED_ENDINGS]
    return next((candidate for candidate in candidates if is_file(candidate)), candidates[0])


def names_apart(files: Sequence[pathlib.PurePath]) -> list[str]:
    """Different names of different files: their stems, with folders and endings only as far as these are needed."""

    def named(count: int, whole: bool) -> list[str]:
        return ["/".join([*file.parts[-count:-1], file.name if whole else file.stem]) for file in files]

    most = max((len(file.parts) for file in files), default=1)
    tried = (named(count, whole) for whole in (False, True) for count in range(1, most + 1))
    return next((names for names in tried if len({*names}) == len(files)), named(most, True))


def smaller_copies(file: pathlib.Path, scene: pathlib.Path) -> dict[int, pathlib.Path]:
    """The smaller copies of a picture of images/, by how many times they are: those of its name, with this ending or
    another, in images_2/, images_4/ and others beside. scene: the folder of the scene, or a file in it."""
    home = next((parent for parent in file.parents if parent.name == "images"), None)
    if home is None or home in (scene, *scene.parents):
        return {}
    found = {}
    for factor, folder in numbered_folders(home.parent).items():
        path = folder / file.relative_to(home)
        copies = filter(is_file, [path, *(path.with_suffix(ending) for ending in GUESSED_ENDINGS)])
        found[factor] = next(copies, None)
    return {factor: copy for factor, copy in found.items() if copy is not None}


def numbered_folders(folder: pathlib.Path) -> dict[int, pathlib.Path]:
    """The folders images_2, images_4 and others of a folder, by their numbers."""
    found = {}
    for path in folder.glob("images_*") if is_folder(folder) else ():
        number = path.name.removeprefix("images_")
        if path.is_dir() and number.isdecimal() and len(number) < 4 and int(number) > 1:
            found[int(number)] = path
    return found


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


def is_folder(path: pathlib.Path) -> bool:
    """Whether a folder is there; no for names that no folder can have."""
    try:
        return path.is_dir()
    except OSError:
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


#: Videos have 30 or 60 pictures a second: no more than this are taken, evenly, as nerfstudio does.
MAX_PICTURES = 300


def evenly(count: int) -> list[int]:
    """Indices of all pictures, or of MAX_PICTURES evenly."""
    return np.unique(np.linspace(0, count - 1, min(count, MAX_PICTURES)).round().astype(int)).tolist()


def chosen_part(counts: dict[str, int], wanted: str | None, where: pathlib.Path, kind: str) -> str:
    """The name of one of several models in a scene: `wanted`, or the one with most pictures and a warning that names
    the others. counts: pictures by name; kind: what messages call a model."""
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
