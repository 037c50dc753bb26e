"""Files: written whole or not at all, recognised by their first bytes, JSON checked as it is read. Arrays: `npz`."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import pathlib
import stat
from collections.abc import Iterator
from typing import Any

from ..errors import InputError, MissingFileError, file_error
from .checks import checked_path
from .memory import require_host_memory

_log = logging.getLogger(__name__)

#: A path as callers give it.
PathLike = str | os.PathLike[str]

#: Bytes of memory that a byte of JSON takes at most, "[]," being 72 in three; and one of text split into tokens.
JSON_ROOM = TEXT_ROOM = 32

#: Bytes that a file's name may have on common file systems.
MAX_NAME = 255


def read_limited(path: PathLike, what: str, room: int = 1) -> bytes:
    """The bytes of a file, if there is memory for what becomes of them: `room` bytes for each."""
    path = require_file(path, what)
    size = path.stat().st_size
    require_host_memory(room * size, f"{path}: its {size} bytes need")
    with file_errors():
        return path.read_bytes()


def begins_as_archive(path: pathlib.Path) -> bool:
    """Whether a file begins as .npz files do."""
    with path.open("rb") as opened:
        return opened.read(4) == b"PK\x03\x04"


#: Kinds of files by their first bytes, and by their endings where these are not known.
_BEGINNINGS = {
    b"\x89PNG": "a picture", b"\xff\xd8\xff": "a picture", b"GIF8": "a picture", b"v/1\x01": "a picture",
    b"ply": "a .ply file", b"glTF": "a glTF file", b"PXR-USDC": "a USD file", b"#usda": "a USD file",
    b"NGSP": "splats", b"{": "JSON", b"[": "JSON",
}  # fmt: skip
_ENDINGS = {
    "a mesh": ".obj .off .stl .gltf .fbx", "a film": ".mp4 .mov .webm .mkv", "text": ".txt .md .csv",
    "a picture": ".tif .tiff .hdr .webp", "a Blender file": ".blend",
}  # fmt: skip


def kind_seen(path: pathlib.Path) -> str:
    """The kind that a file seems to be, such as "a mesh", for a message that asks for another kind."""
    with path.open("rb") as opened:
        head = opened.read(16)
    if not head:
        return "an empty file"
    for begin, kind in _BEGINNINGS.items():
        if head.startswith(begin):
            return kind
    ending = path.suffix.lower()
    named = (kind for kind, endings in _ENDINGS.items() if ending and ending in endings.split())
    return next(named, "another kind of file")


def seen_note(path: PathLike, asked: str = "") -> str:
    """What a refused file looks like, to follow what is taken; empty where there is none, or a damaged one of the kind
    that was asked for."""
    path = pathlib.Path(path)
    if path.is_dir():
        return ", this is a folder"
    kind = kind_seen(path) if path.is_file() else asked
    return f", this looks like {kind}" if kind != asked else ""


@contextlib.contextmanager
def file_errors() -> Iterator[None]:
    """Make errors of the system in a block a `warpcage.Error` too."""
    try:
        yield
    except OSError as error:
        refusal = file_error(error)
        if refusal is error:
            raise
        raise refusal.with_traceback(error.__traceback__) from error.__cause__


@contextlib.contextmanager
def atomic_path(path: PathLike) -> Iterator[pathlib.Path]:
    """A temporary file, with the same ending, that takes the place of `path` when the block ends without an error.
    After an error `path` is as it was. Where it is a symbolic link, it stays one, and its target is replaced."""
    with file_errors(), _replacing(path) as temporary:
        yield temporary


@contextlib.contextmanager
def _replacing(path: PathLike) -> Iterator[pathlib.Path]:
    # A file that is replaced passes on its permissions; a new one gets what an ordinary `open` gives it.
    path = checked_path(path, "the file to write")
    path.parent.mkdir(parents=True, exist_ok=True)
    target = pathlib.Path(os.path.realpath(path)) if path.is_symlink() else path
    temporary = target.with_name(_temporary_name(target.stem, path.suffix))
    try:
        try:
            mode = _permissions(target)
            # no more readers than the file itself has, from the beginning. The kernel applies the umask: to read
            # it is to set it for a moment, also for the files of other threads
            permissions = 0o666 if mode is None else mode | stat.S_IRUSR | stat.S_IWUSR
            os.close(os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL, permissions))
        except OSError as error:
            error.filename = str(path)  # which the caller knows, instead of the temporary one
            raise
        yield temporary
        if mode is not None and mode != _permissions(temporary):
            temporary.chmod(mode)
        os.replace(temporary, target)
        _log.debug("wrote %s", path)
    finally:
        with contextlib.suppress(OSError):  # it is gone, or it never was
            temporary.unlink()


def path_from(folder: PathLike, path: PathLike) -> str:
    """A path from a folder, with slashes, so that both can be moved together and read on any system."""
    try:
        return pathlib.Path(os.path.relpath(path, folder)).as_posix()
    except ValueError:  # on another drive
        return pathlib.Path(path).absolute().as_posix()


def _permissions(path: pathlib.Path) -> int | None:
    """Who may read, write and execute a file; None where there is none yet."""
    try:
        return stat.S_IMODE(path.stat().st_mode) & 0o777
    except FileNotFoundError:
        return None


def _temporary_name(stem: str, suffix: str) -> str:
    """A hidden name that no other file has. Of a long stem it keeps the beginning."""
    ending = f"-{os.urandom(8).hex()}{suffix}"
    while stem and len(os.fsencode(f".{stem}{ending}")) > MAX_NAME:
        stem = stem[:-1]
    return f".{stem}{ending}"


def require_file(path: PathLike, what: str) -> pathlib.Path:
    """The path of a file that must be there, itself and not a pointer to it or a page about it."""
    path = checked_path(path, f"the {what}")
    if os.path.isdir(path):
        raise MissingFileError(f"{what} {str(path)!r} is a folder")
    if not os.path.isfile(path):  # False for names that no file can have, too
        raise MissingFileError(f"{what} {str(path)!r} is not there")
    stand_in = _stand_in(path)
    if stand_in:
        raise InputError(f"{what} {str(path)!r} is {stand_in}")
    return path


#: Bytes at the beginning of a file that are looked at, and how pointers begin that version control leaves in place of
#: large files: https://github.com/git-lfs/git-lfs/blob/main/docs/spec.md, with the address of its first releases, and
#: https://git-annex.branchable.com/internals/pointer_file/.
HEAD = 1024
_LFS_BEGINNINGS = (b"version https://git-lfs.github.com/spec/", b"version https://hawser.github.com/spec/")
_ANNEX_BEGINNING = b"/annex/objects/"

#: How web pages begin, in lower case; before it there may be a declaration of XML or a comment.
_PAGE_BEGINNINGS = (b"<!doctype html", b"<html")


def _stand_in(path: pathlib.Path) -> str:
    """What stands in place of a file, and what to do; "" where the file itself is there."""
    try:
        with path.open("rb") as file:
            head = file.read(HEAD)
    except OSError:  # raised again when it is read
        return ""
    if head.startswith(_LFS_BEGINNINGS):
        return "a Git LFS pointer, not the file itself: fetch it with `git lfs pull`, or download it"
    if head.startswith(_ANNEX_BEGINNING):
        return "a git-annex pointer, not the file itself: fetch it with `git annex get`"
    page = head.removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    if page.startswith(_PAGE_BEGINNINGS) or (
        page.startswith((b"<?xml", b"<!--")) and any(beginning in page for beginning in _PAGE_BEGINNINGS)
    ):
        return "a web page, not the file itself: download the file that the page is about"
    return ""


def check_parent(path: pathlib.Path) -> None:
    """Raises ValueError for a path below something that is not a folder."""
    for parent in path.parents:
        if parent.exists():
            if not parent.is_dir():
                raise InputError(f"{str(path)!r} cannot be written: {str(parent)!r} is not a folder")
            return


def file_stamp(path: PathLike) -> tuple[int, int]:
    """Bytes of a file and its time of change, nanoseconds, by which one that was replaced or written to is known."""
    status = os.stat(path)
    return status.st_size, status.st_mtime_ns


#: What taking apart the contents of a file raises that is not as it should be.
DAMAGED = (KeyError, TypeError, AttributeError, OverflowError, RecursionError)


def read_json(path: PathLike, what: str, kinds: type | tuple[type, ...] = dict) -> Any:
    """The object, or what else of `kinds`, that a JSON file holds; a ValueError says what is wrong without the path."""
    data = read_limited(path, what, JSON_ROOM)
    try:
        content = json.loads(data.decode("utf-8"))
    except UnicodeDecodeError:
        raise InputError(f"{not_a(what)}: it holds no text{seen_note(path)}") from None
    except RecursionError:
        raise InputError(f"{not_a(what)}: its JSON is nested too deeply") from None
    except json.JSONDecodeError as error:
        place = f"line {error.lineno}, column {error.colno}"
        wrong = f"its JSON breaks off or is damaged at {place}" if data.strip() else "it is empty"
        raise InputError(f"{not_a(what)}: {wrong}") from None
    except ValueError:  # of Python, which reads no longer ones
        raise InputError(f"{not_a(what)}: a number in it has thousands of digits") from None
    if not isinstance(content, kinds):
        raise InputError(f"{not_a(what)}: it holds no JSON object")
    return content


def damage(what: str, error: Exception) -> str:
    """One line for an error of `DAMAGED`."""
    if isinstance(error, KeyError):
        return f"{not_a(what)}: it lacks {error.args[0]!r}"
    return f"{not_a(what)}: something in it is of another kind than it should be ({error})"


@contextlib.contextmanager
def errors_of(path: PathLike, what: str) -> Iterator[None]:
    """What goes wrong with the content of a file, as a ValueError that begins with its path."""
    try:
        yield
    except DAMAGED as error:
        raise InputError(f"{path}: {damage(what, error)}") from None
    except ValueError as error:
        raise InputError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from None


def read_document(path: PathLike, what: str, form: str, newest: int, **defaults: Any) -> dict[str, Any]:
    """The object of a JSON file that names its format and its version, `newest` at most; for `errors_of`.
    defaults: of keys that the file may lack."""
    content = defaults | read_json(path, what)
    if content["format"] != form:
        raise InputError(f"its format is {str(content['format'])[:40]!r}, not {form!r}")
    require_version(content["version"], newest)
    return content


def require_version(version: Any, newest: int) -> None:
    """Raise ValueError for the version of a file that is none, or newer than what is read."""
    if type(version) is not int or version < 1:
        raise InputError(f"its version must be a whole number from 1, got {str(version)[:40]!r}")
    if version > newest:
        raise InputError(f"its version is {version}, this warpcage reads up to {newest}: upgrade")


def not_a(what: str) -> str:
    """The beginning of the message."""
    return f"not {'an' if what[0] in 'aeiou' else 'a'} {what}"
