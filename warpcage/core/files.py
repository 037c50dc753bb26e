"""Files in and out: written whole or not at all, never trusted before they are checked; JSON, .npz, .npy, CRC-32."""

from __future__ import annotations

import contextlib
import functools
import io
import json
import logging
import math
import os
import pathlib
import stat
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from typing import IO, Any

import numpy as np

from ..errors import InputError, MissingFileError, file_error
from .checks import checked_path
from .memory import MemoryShortage, free_host_bytes, require_host_memory
from .threads import run_parallel

_log = logging.getLogger(__name__)

#: The polynomial of zip files, and the polynomials 1 and x; the highest bit is the constant one.
POLYNOMIAL, ONE, X = 0xEDB88320, 1 << 31, 1 << 30


def joined_crc(first: int, second: int, length: int) -> int:
    """The checksum of two parts one after the other, by that of each and the bytes of the second."""
    return _product(_shift(8 * length), first) ^ second  # `crc32_combine` of zlib


def _product(a: int, b: int) -> int:
    """The product of two polynomials, modulo POLYNOMIAL."""
    product, bit = 0, ONE
    while bit:
        if a & bit:
            product ^= b
        b = b >> 1 ^ POLYNOMIAL if b & 1 else b >> 1
        bit >>= 1
    return product


@functools.lru_cache(maxsize=16)
def _shift(bits: int) -> int:
    """x to the power of a number of bits."""
    power, square = ONE, X
    while bits:
        if bits & 1:
            power = _product(square, power)
        square = _product(square, square)
        bits >>= 1
    return power


#: A path as callers give it.
PathLike = str | os.PathLike[str]

#: Deflate cannot pack tighter than this: bytes out per byte in.
MAX_RATIO = 1032

#: Bytes of memory that a byte of JSON takes at most, "[]," being 72 in three; and one of text cut into words.
JSON_ROOM = TEXT_ROOM = 32

#: Bytes that are unpacked at once.
CHUNK = 1 << 24

#: Bytes of what stands before a member's name in a .zip file; its last two numbers are the lengths of name and extra.
LOCAL_HEADER = 30

#: Bytes that a file's name may have on common file systems.
MAX_NAME = 255

#: The longest header of an array: one of numbers or text has some hundred bytes.
MAX_HEADER = 10_000

#: What reads the header of each version, and the bytes that say how long it is.
_HEADERS = {(1, 0): (np.lib.format.read_array_header_1_0, 2), (2, 0): (np.lib.format.read_array_header_2_0, 4)}


def read_npz(
    path: PathLike, what: str, wanted: Callable[[str], object] | None = None, *, room: int = 1
) -> dict[str, np.ndarray]:
    """Read the arrays of an .npz file that are wanted (None: all) without trusting it.
    `room`: bytes of memory that each byte of the arrays takes until the caller is done with them."""
    # Sizes are compared with the file's and with free memory before anything is allocated. Pickles are never opened.
    with _opened_npz(path, what) as archive:
        members = [info for info in _members(archive) if wanted is None or wanted(_array_name(info))]
        _check_sizes(archive, members, room)
        return {_array_name(info): _read_member(archive, info) for info in members}


def npz_names(path: PathLike, what: str) -> list[str]:
    """The names of the arrays in an .npz file, in alphabetical order; none of them is read."""
    with _opened_npz(path, what) as archive:
        return sorted(map(_array_name, _members(archive)))


def read_limited(path: PathLike, what: str, room: int = 1) -> bytes:
    """The bytes of a file, if there is memory for what becomes of them: `room` bytes for each."""
    path = require_file(path, what)
    size = path.stat().st_size
    require_host_memory(room * size, f"{path}: its {size} bytes need")
    with file_errors():
        return path.read_bytes()


def require_numbers(
    contents: dict[str, np.ndarray], name: str, shape: tuple[int | None, ...] | None, path: PathLike
) -> np.ndarray:
    """An array of real numbers from what `read_npz` read; a shape of None, or None for a side, is any."""
    if name not in contents:
        raise InputError(f"{path} lacks {name}")
    array = contents[name]
    fits = shape is None or (
        array.ndim == len(shape) and all(want in (None, size) for want, size in zip(shape, array.shape, strict=True))
    )
    if array.dtype.kind not in "fiu" or not fits:
        wanted = "numbers" if shape is None else f"numbers of shape {shape}".replace("None", "any")
        raise InputError(f"{path}: {name} must hold {wanted}, got {array.dtype} {array.shape}")
    return array


@contextlib.contextmanager
def _opened_npz(path: PathLike, what: str) -> Iterator[zipfile.ZipFile]:
    """The archive of an .npz file; whatever goes wrong with it becomes one ValueError."""
    path = require_file(path, what)
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        if isinstance(error, zipfile.BadZipFile) and not zipfile.is_zipfile(path):
            reason = "it is cut off or damaged" if begins_as_archive(path) else f"it looks like {kind_seen(path)}"
        raise InputError(f"{path} is not an .npz {what}: {reason}") from error


def begins_as_archive(path: pathlib.Path) -> bool:
    """Whether a file begins as .npz files do."""
    with path.open("rb") as opened:
        return opened.read(4) == b"PK\x03\x04"


#: What files are by how they begin, and by their endings where that does not tell.
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
    """What a file looks like, in words such as "a mesh", for a message that asks for another kind."""
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


def _members(archive: zipfile.ZipFile) -> list[zipfile.ZipInfo]:
    return [info for info in archive.infolist() if info.filename.endswith(".npy")]


def _array_name(info: zipfile.ZipInfo) -> str:
    return info.filename.removesuffix(".npy")


def _check_sizes(archive: zipfile.ZipFile, members: list[zipfile.ZipInfo], room: int) -> None:
    """Refuse arrays that cannot be in the file, or for which there is no memory."""
    if len({info.filename for info in members}) < len(members):
        raise InputError("it holds two arrays with the same name")
    for info in members:
        if info.file_size > MAX_RATIO * info.compress_size + 1024:
            raise InputError(f"array {info.filename!r} claims {info.file_size} bytes out of {info.compress_size}")
    assert archive.filename is not None
    packed, there = sum(info.compress_size for info in members), os.path.getsize(archive.filename)
    if packed > there:
        raise InputError(f"its arrays claim {packed} packed bytes, the file has {there}")
    total, free = sum(info.file_size for info in members), free_host_bytes()
    if room * total > free:
        need = f" and need {room * total / 2**30:.1f}" if room > 1 else ""
        raise MemoryShortage(f"its arrays claim {total / 2**30:.1f} GiB{need}, {free / 2**30:.1f} GiB are free")


def _read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    name = _array_name(info)
    with archive.open(info) as file:
        shape, fortran_order, dtype = read_npy_header(file, name)
        claimed, there = math.prod(shape) * dtype.itemsize, info.file_size - file.tell()
        if min(shape, default=0) < 0 or claimed != there:
            raise InputError(f"array {name!r} claims {claimed} bytes {shape}, the file has {there}")
        array = np.empty(math.prod(shape), dtype)
        octets, filled = array.view(np.uint8), 0
        if info.compress_type == zipfile.ZIP_STORED and claimed > CHUNK:
            _read_stored(archive, info, octets)
            return array.reshape(shape, order="F" if fortran_order else "C")
        assert isinstance(file, zipfile.ZipExtFile)  # zipfile declares no more than IO[bytes], which has no readinto
        while filled < claimed:
            count = file.readinto(octets[filled : filled + CHUNK])  # pyright: ignore[reportArgumentType]
            if not count:
                raise InputError(f"array {name!r} ends after {filled} of {claimed} bytes")
            filled += count
    return array.reshape(shape, order="F" if fortran_order else "C")


def _read_stored(archive: zipfile.ZipFile, info: zipfile.ZipInfo, octets: np.ndarray) -> None:
    """Fill octets (n,) uint8 with the last bytes of a stored member, on several threads, and compare its checksum."""
    path, head = archive.filename, info.file_size - len(octets)
    assert path is not None
    with open(path, "rb") as file:
        file.seek(info.header_offset)
        local = file.read(LOCAL_HEADER)
        begin = info.header_offset + LOCAL_HEADER + sum(struct.unpack("<HH", local[-4:]))
        file.seek(begin)
        crc = zlib.crc32(file.read(head))

    def read(place: int) -> int:
        part = octets[place : place + CHUNK]
        with open(path, "rb", buffering=0) as file:
            file.seek(begin + head + place)
            filled = 0
            while filled < len(part):
                count = file.readinto(part[filled:])  # pyright: ignore[reportArgumentType]
                if not count:
                    raise InputError(f"array {_array_name(info)!r} ends after {place + filled} of {len(octets)} bytes")
                filled += count
        return zlib.crc32(part)  # pyright: ignore[reportArgumentType]

    places = range(0, len(octets), CHUNK)
    for place, part in zip(places, run_parallel([functools.partial(read, place) for place in places]), strict=True):
        crc = joined_crc(crc, part, min(CHUNK, len(octets) - place))
    if crc != info.CRC:
        raise zipfile.BadZipFile(f"Bad CRC-32 for file {info.filename!r}")


def read_npy_header(file: IO[bytes], name: str) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, whether columns come first, and data type of a .npy file of numbers or text; pickled objects are refused.
    The file is at its beginning, afterwards at the array's first byte."""
    version = np.lib.format.read_magic(file)
    if version not in _HEADERS:
        raise InputError(f"array {name!r} has the unknown .npy version {version}")
    read_header, length_bytes = _HEADERS[version]
    prefix = file.read(length_bytes)
    length = int.from_bytes(prefix, "little")
    if length > MAX_HEADER:  # NumPy would read all of it first
        raise InputError(f"array {name!r} has a header of {length} bytes, at most {MAX_HEADER} are read")
    shape, fortran_order, dtype = read_header(io.BytesIO(prefix + file.read(length)))
    if dtype.hasobject:
        raise InputError(f"array {name!r} holds pickled objects, which are never opened")
    if dtype.kind not in "biufcSU" or not dtype.itemsize:  # records, and items without bytes
        raise InputError(f"array {name!r} holds neither numbers nor text, but {dtype}")
    return shape, fortran_order, dtype


@contextlib.contextmanager
def file_errors() -> Iterator[None]:
    """Make errors of the system in a block a `warpcage.Error` too."""
    try:
        yield
    except OSError as error:
        told = file_error(error)
        if told is error:
            raise
        raise told.with_traceback(error.__traceback__) from error.__cause__


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
            # no more readers than the file itself has, from the beginning. The kernel applies the umask: whoever reads
            # the umask sets it for a moment, also for the files of other threads
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
    except OSError:  # told by who reads it
        return ""
    if head.startswith(_LFS_BEGINNINGS):
        return "a Git LFS pointer, not the file itself: fetch it with `git lfs pull`, or download it"
    if head.startswith(_ANNEX_BEGINNING):
        return "a git-annex pointer, not the file itself: fetch it with `git annex get`"
    page = head.removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    if page.startswith(_PAGE_BEGINNINGS) or (
        page.startswith((b"<?xml", b"<!--")) and any(beginning in page for beginning in _PAGE_BEGINNINGS)
    ):
        return "a web page, not the file itself: download the file that the page tells of"
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


def read_document(path: PathLike, what: str, form: str, newest: int, **usual: Any) -> dict[str, Any]:
    """The object of a JSON file that names its format and its version, `newest` at most; for `errors_of`.
    usual: what holds where the file does not say it."""
    content = usual | read_json(path, what)
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


#: Kinds of numbers that are read: floats, and whole numbers with a sign or without.
NUMBERS = "fiu"


class NpyFile:
    """An array in a .npy file, of which a row is read at a time by its place in the file.
    Of millions of poses one is in memory. A mapped file would do so too, but one cut off under it kills the process."""

    def __init__(self, path: PathLike):
        self.path = require_file(path, "array file")
        self.stamp = file_stamp(self.path)  # size and time, by which a changed file is known
        with file_errors(), self.path.open("rb") as file:
            try:
                self.shape, columns_first, self.dtype = read_npy_header(file, self.path.name)
            except Exception as error:
                reason = " ".join(str(error).split()) or type(error).__name__
                raise InputError(f"{self.path} is not an .npy file of numbers: {reason}") from None
            self._start = file.tell()
        if self.dtype.kind not in NUMBERS or min(self.shape, default=0) < 0:
            raise InputError(f"{self.path} must hold numbers, got {self.dtype} of shape {self.shape}")
        if columns_first and len(self.shape) > 1:
            raise InputError(f"{self.path} holds columns first: save it by np.save(path, np.ascontiguousarray(array))")
        claimed = math.prod(self.shape) * self.dtype.itemsize
        if claimed != self.stamp[0] - self._start:
            raise InputError(
                f"{self.path} claims {claimed} bytes {self.shape}, it has {self.stamp[0] - self._start}: it is cut off "
                "or damaged"
            )

    @property
    def row_bytes(self) -> int:
        """Bytes of a row."""
        return math.prod(self.shape[1:]) * self.dtype.itemsize

    def row(self, index: int) -> np.ndarray:
        """The array's part at a place of its first axis, from 0."""
        return self._array(self.row_data(index), self.shape[1:])

    def row_data(self, index: int) -> bytes:
        """The bytes of a row; see `row`."""
        if not self.shape or not 0 <= index < self.shape[0]:
            rows = self.shape[0] if self.shape else 0
            raise InputError(
                f"{self.path} has rows 0 to {rows - 1}, got {index}" if rows else f"{self.path} has no rows"
            )
        return self._read(self._start + index * self.row_bytes, self.row_bytes)

    def read(self) -> np.ndarray:
        """The whole array. Raises ValueError where there is no memory for it, or the file was cut off."""
        size = math.prod(self.shape) * self.dtype.itemsize
        require_host_memory(size, f"{self.path}: its array needs")
        return self._array(self._read(self._start, size), self.shape)

    def _read(self, start: int, size: int) -> bytes:
        require_host_memory(size, f"{self.path}: a row needs")
        with self.path.open("rb") as file:
            file.seek(start)
            data = file.read(size)
        if len(data) != size:
            raise InputError(f"{self.path} was cut off while it was in use")
        return data

    def _array(self, data: bytes, shape: tuple[int, ...]) -> np.ndarray:
        return np.frombuffer(data, self.dtype).reshape(shape)
