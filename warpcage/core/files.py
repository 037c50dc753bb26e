"""Files in and out: written whole or not at all, and never trusted before they are checked."""

from __future__ import annotations

import contextlib
import math
import os
import pathlib
import stat
import zipfile
from collections.abc import Iterator

import numpy as np

from .memory import free_host_bytes

#: A path as callers give it.
PathLike = str | os.PathLike[str]

#: Deflate cannot pack tighter than this: bytes out per byte in.
MAX_RATIO = 1032

#: Bytes that are unpacked at once.
CHUNK = 1 << 24

#: Bytes that a file's name may have on common file systems.
MAX_NAME = 255
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def read_npz(path: PathLike, what: str) -> dict[str, np.ndarray]:
    """Read an .npz file without trusting it.

    Sizes are compared with that of the file before anything is allocated. Pickled objects are refused and never opened.

    Args:
        path: The file.
        what: How messages call it.

    Returns:
        The arrays by name.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: What is wrong in which array.
    """
    path = require_file(path, what)
    try:
        with zipfile.ZipFile(path) as archive:
            members = [info for info in archive.infolist() if info.filename.endswith(".npy")]
            _check_sizes(archive, members)
            return {info.filename.removesuffix(".npy"): _read_member(archive, info) for info in members}
    except Exception as error:
        raise ValueError(
            f"{path} is not an .npz {what}: {' '.join(str(error).split()) or type(error).__name__}"
        ) from error


def require_numbers(
    contents: dict[str, np.ndarray], name: str, shape: tuple[int | None, ...] | None, path: PathLike
) -> np.ndarray:
    """An array of real numbers from a file.

    Args:
        contents: What `read_npz` read.
        name: Name of the array.
        shape: Its shape. None, or None for a side, is any.
        path: The file, for the message.

    Returns:
        The array.

    Raises:
        ValueError: If the array is missing, or holds something else or another shape.
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


def _check_sizes(archive: zipfile.ZipFile, members: list[zipfile.ZipInfo]) -> None:
    names = [info.filename for info in members]
    if len(set(names)) < len(names):
        raise ValueError("it holds two arrays with the same name")
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
        assert isinstance(file, zipfile.ZipExtFile)  # zipfile declares no more than IO[bytes], which has no readinto
        while filled < claimed:
            count = file.readinto(octets[filled : filled + CHUNK])  # pyright: ignore[reportArgumentType]
            if not count:
                raise ValueError(f"array {name!r} ends after {filled} of {claimed} bytes")
            filled += count
    return array.reshape(shape, order="F" if fortran_order else "C")


@contextlib.contextmanager
def atomic_path(path: PathLike) -> Iterator[pathlib.Path]:
    """A temporary file that takes the place of `path` when the block ends without an error.

    The parent folder is made. After an error the temporary file is removed and `path` is as it was. A file that is
    replaced passes on its permissions; a new one gets what an ordinary `open` gives it. Where `path` is a symbolic
    link, it stays one, and the file that it leads to is replaced.

    Args:
        path: The file to be written.

    Yields:
        The path of the temporary file, in the folder of the file that is replaced, and with the same ending.
    """
    path = pathlib.Path(path)
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
    finally:
        with contextlib.suppress(OSError):  # it is gone, or it never was
            temporary.unlink()


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
    """The path of a file that must be there.

    Args:
        path: The file.
        what: How the message calls it.

    Returns:
        The path.

    Raises:
        FileNotFoundError: If it is not a file.
    """
    path = pathlib.Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{what} {str(path)!r} is not there")
    return path
