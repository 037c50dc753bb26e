"""Files in and out: whole or not at all, and none that is trusted unread."""

from __future__ import annotations

import contextlib
import math
import os
import pathlib
import tempfile
import zipfile

import numpy as np

from .memory import free_host_bytes

#: Deflate cannot pack tighter than this.
MAX_RATIO = 1032

#: Bytes that are unpacked at a time.
CHUNK = 1 << 24
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def read_npz(path, what: str) -> dict[str, np.ndarray]:
    """The arrays of an .npz file by name.

    what: how messages call the file. Sizes are compared with the file's own before anything is allocated; pickled
    objects are refused and never opened. Raises FileNotFoundError, or ValueError with the name of the bad array.
    """
    path = require_file(path, what)
    try:
        with zipfile.ZipFile(path) as archive:
            members = [info for info in archive.infolist() if info.filename.endswith(".npy")]
            _check_sizes(archive, members)
            return {info.filename.removesuffix(".npy"): _read_member(archive, info) for info in members}
    except Exception as error:
        raise ValueError(f"{path} is no .npz {what}: {' '.join(str(error).split()) or type(error).__name__}") from error


def require_numbers(contents: dict, name: str, shape: tuple | None, path) -> np.ndarray:
    """The array `name` of what read_npz read, of real numbers and of a shape (None in it, or for it, is any).

    Raises ValueError that names the file, where it is missing or something else.
    """
    if name not in contents:
        raise ValueError(f"{path} lacks {name}")
    array = contents[name]
    fits = shape is None or (
        array.ndim == len(shape) and all(want in (None, size) for want, size in zip(shape, array.shape, strict=True))
    )
    if array.dtype.kind not in "fiu" or not fits:
        wanted = "numbers" if shape is None else f"numbers of shape {shape}".replace("None", "any")
        raise ValueError(f"{path}: {name} must hold {wanted}, got {array.dtype} {array.shape}")
    return array


def _check_sizes(archive: zipfile.ZipFile, members) -> None:
    names = [info.filename for info in members]
    if len(set(names)) < len(names):
        raise ValueError("it holds two arrays of one name")
    for info in members:
        if info.file_size > MAX_RATIO * info.compress_size + 1024:
            raise ValueError(f"array {info.filename!r} claims {info.file_size} bytes out of {info.compress_size}")
    total, free = sum(info.file_size for info in members), free_host_bytes()
    if total > free:
        raise ValueError(f"its arrays claim {total / 2**30:.1f} GiB, {free / 2**30:.1f} GiB are free")


def _read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    name = info.filename.removesuffix(".npy")
    with archive.open(info) as file:
        version = np.lib.format.read_magic(file)
        if version not in _HEADERS:
            raise ValueError(f"array {name!r} has the unknown .npy version {version}")
        shape, fortran_order, dtype = _HEADERS[version](file)
        if dtype.hasobject:
            raise ValueError(f"array {name!r} holds pickled objects, which are never opened")
        claimed, there = math.prod(shape) * dtype.itemsize, info.file_size - file.tell()
        if min(shape, default=0) < 0 or claimed != there:
            raise ValueError(f"array {name!r} claims {claimed} bytes {shape}, the file has {there}")
        array = np.empty(math.prod(shape), dtype)
        octets, filled = array.view(np.uint8), 0
        while filled < claimed:
            count = file.readinto(octets[filled : filled + CHUNK])
            if not count:
                raise ValueError(f"array {name!r} ends after {filled} of {claimed} bytes")
            filled += count
    return array.reshape(shape, order="F" if fortran_order else "C")


@contextlib.contextmanager
def atomic_path(path):
    """A temporary path beside `path`, with its ending, that replaces it when the block ends without an error.

    The parent folder is made. After an error the temporary file is removed and `path` is as it was.
    """
    path = pathlib.Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=path.suffix, dir=path.parent)
    except OSError as error:
        error.filename = str(path)  # which the caller knows, instead of the temporary one
        raise
    os.close(handle)
    temporary = pathlib.Path(name)
    try:
        yield temporary
        # mkstemp makes files private; give the result what an ordinary open() would have
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def require_file(path, what: str) -> pathlib.Path:
    """`path` as a Path. Raises FileNotFoundError with one line when it is not a file."""
    path = pathlib.Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{what} {str(path)!r} is not there")
    return path
