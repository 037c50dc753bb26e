"""Folders of frames: which film they are of, and which frames are whole."""

from __future__ import annotations

import contextlib
import json
import os
import pathlib
import re
import shutil
from collections.abc import Callable, Iterator

from ...core.files import PathLike, atomic_path
from ...errors import InputError
from ...view.camera import Camera
from ...view.exr import read_exr
from ...view.pictures import read_image
from .video import FILM_ENDINGS, read_film_frame

#: The note beside the frames that says which film they are of.
SETTINGS_NAME = "animation.json"

#: The last chunk of every PNG file.
PNG_END = b"\0\0\0\0IEND\xaeB`\x82"

#: What frames are called.
FRAME_NAME = re.compile(r"frame_[0-9]{4,}\.(png|exr|npz)")


def make_folder(
    folder: pathlib.Path,
    cameras: list[Camera],
    make: Callable[[list[int], Callable[[], None]], None],
    settings: dict,  # all that decides how frames look, as JSON has it; "format" is their ending
    *,
    overwrite: bool = False,  # replace frames of another film
) -> int:
    """Make the frames of a film that are not there yet, each whole or not at all; returns how many were there.
    make(missing, begin) is called where any is missing, and calls `begin` before it writes the first."""
    foreign = _other_film(folder, settings)
    if foreign and not overwrite:
        raise InputError(
            f"folder {str(folder)!r} holds {foreign}: give another folder, or --overwrite to replace those frames; "
            "with the options of that film it is continued"
        )
    with _nothing_left_without_frames(folder):
        paths = [frame_path(folder, index, settings["format"]) for index in range(len(cameras))]
        pairs = enumerate(zip(paths, cameras, strict=True))
        missing = [index for index, pair in pairs if foreign or not _holds_picture(*pair)]

        def begin() -> None:
            for other in frame_files(folder) if foreign else [paths[index] for index in missing]:
                other.unlink(missing_ok=True)
            with atomic_path(folder / SETTINGS_NAME) as note:  # not before: a folder without frames has no settings
                note.write_text(json.dumps(settings, indent=1) + "\n", encoding="utf-8")

        if missing:
            make(missing, begin)
    return len(cameras) - len(missing)


def frame_path(folder: pathlib.Path, index: int, kind: str) -> pathlib.Path:
    """The file of a frame; kind: its ending."""
    return folder / f"frame_{index:04d}.{kind}"


def frame_files(folder: pathlib.Path) -> list[pathlib.Path]:
    """The frames in a folder, in their order; none where there is no such folder."""
    files = sorted(folder.iterdir()) if folder.is_dir() else []
    return [file for file in files if FRAME_NAME.fullmatch(file.name)]


def _other_film(folder: pathlib.Path, settings: dict) -> str:
    """Whose frames a folder holds, empty where it holds none or those of this film."""
    note = folder / SETTINGS_NAME
    held = _read_note(note) if note.exists() else None
    if not frame_files(folder) or held == settings:
        return ""
    if held is None:
        return f"other frames (no {SETTINGS_NAME} says of which film)"
    names = [name for name in settings if held.get(name) != settings[name]]
    changed = [_difference(name, held.get(name), settings[name]) for name in names]
    return f"frames of another film (other {', '.join(changed) or 'settings'})"


def _read_note(note: pathlib.Path) -> dict:
    """What a note says. Raises ValueError for a file of that name that is none: it is not ours to replace."""
    try:
        found = json.loads(note.read_text(encoding="utf-8"))
    except ValueError:
        found = None
    if not isinstance(found, dict) or not {"frames", "field", "camera"} <= found.keys():
        raise InputError(f"{str(note)!r} is not a list of frames that warpcage wrote: give another folder")
    return found


def _difference(name: str, there: object, here: object) -> str:
    """A setting that differs, with both values where they are short texts or numbers."""
    if all(isinstance(value, str | int | float | None) and len(str(value)) <= 12 for value in (there, here)):
        there, here = ("default" if value is None else value for value in (there, here))
        return f"{name}: {there} there, {here} now"
    return name


@contextlib.contextmanager
def _nothing_left_without_frames(folder: pathlib.Path) -> Iterator[None]:
    """Where the block fails before the folder has a frame, take the note and the folders away that it made."""
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        yield
    except BaseException:
        if not frame_files(folder):
            with contextlib.suppress(OSError):  # what others put there stays
                (folder / SETTINGS_NAME).unlink(missing_ok=True)
                for each in made:
                    each.rmdir()
        raise


def _holds_picture(path: pathlib.Path, camera: Camera) -> bool:
    """Whether a file is a whole picture from a camera. What was cut, on a full disk or elsewhere, is rendered again."""
    try:
        if path.suffix == ".exr":
            shape = read_exr(path)["Z"].shape
        elif path.suffix == ".npz":
            shape = read_film_frame(path).shape[:2]
        else:
            with open(path, "rb") as file:
                file.seek(-len(PNG_END), os.SEEK_END)
                # all pixels may be there before
                shape = read_image(path).shape[:2] if file.read() == PNG_END else None
        return shape == (camera.height, camera.width)
    except (OSError, ValueError, KeyError):
        return False


def checked_film_path(path: PathLike, *, new: bool = True) -> pathlib.Path:
    """The path of a film, or of a folder without an ending, once it is clear that one can be written there.
    new: whether the folder may not hold anything."""
    target, endings = pathlib.Path(path), ", ".join(FILM_ENDINGS)
    if target.suffix.lower() in FILM_ENDINGS:
        if target.is_dir():
            raise InputError(f"film {str(target)!r} is a folder")
    elif target.suffix:
        raise InputError(f"film {str(target)!r} must end in {endings}, or have no ending: a folder of pictures")
    elif new and target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise InputError(f"{str(target)!r} is not empty: give the name of a new folder")
    elif target.exists() and not target.is_dir():
        raise InputError(f"film {str(target)!r} is a file without an ending: give {endings} or a folder")
    return target


@contextlib.contextmanager
def atomic_folder(path: PathLike) -> Iterator[pathlib.Path]:
    """A temporary folder that becomes `path`, which is not there or empty, when the block ends without an error."""
    target = pathlib.Path(path).absolute()
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name[:60]}-{os.urandom(8).hex()}")
    temporary.mkdir()
    try:
        yield temporary
        try:
            with contextlib.suppress(FileNotFoundError):
                target.rmdir()  # an empty folder alone lets itself be removed
            os.rename(temporary, target)
        except OSError as error:
            if os.path.lexists(target):
                raise InputError(f"{str(path)!r} is not empty: give the name of a new folder") from error
            raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
