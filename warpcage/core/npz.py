"""Arrays in .npz and .npy files: sizes are checked before anything is allocated, pickles are never opened."""

from __future__ import annotations

import contextlib
import functools
import io
import math
import os
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from typing import IO

import numpy as np

from ..errors import InputError
from .files import PathLike, begins_as_archive, file_errors, file_stamp, kind_seen, require_file
from .memory import MemoryShortage, free_host_bytes, require_host_memory
from .threads import run_parallel

#: Deflate cannot pack tighter than this: bytes out per byte in.
MAX_RATIO = 1032

#: Bytes that are unpacked at once.
CHUNK = 1 << 24

#: Bytes of what stands before a member's name in a .zip file; its last two numbers are the lengths of name and extra.
LOCAL_HEADER = 30

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


def joined_crc(first: int, second: int, length: int) -> int:
    """The CRC-32 of two parts of a file from the CRC-32 of each; length: bytes of the second."""
    return _product(_power(8 * length), first) ^ second  # as zlib's crc32_combine


# Polynomials over GF(2) modulo that of CRC-32 (reflected): the highest bit is the coefficient of 1, the next that of x.
def _product(a: int, b: int) -> int:
    product = 0
    for bit in range(31, -1, -1):
        if a >> bit & 1:
            product ^= b
        b = b >> 1 ^ (0xEDB88320 if b & 1 else 0)
    return product


@functools.lru_cache(maxsize=16)
def _power(exponent: int) -> int:
    """x to a power."""
    power, square = 1 << 31, 1 << 30
    while exponent:
        if exponent & 1:
            power = _product(square, power)
        square = _product(square, square)
        exponent >>= 1
    return power


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
