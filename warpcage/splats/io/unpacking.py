"""Decompression of files of splats (gzip, zstd, zip), never beyond what fits in memory."""

from __future__ import annotations

import importlib
import io
import pathlib
import sys
import zipfile
import zlib
from typing import Any

from ...core.checks import shown
from ...core.memory import require_host_memory
from ...core.names import install_line
from ...core.npz import CHUNK, MAX_RATIO
from ...errors import InputError

#: Bytes that a packed byte may come to, beyond some that any file may have. The places of splats alone are a tenth of
#: what files of them hold, and hardly pack.
MAX_PACKED, LITTLE = 256, 1 << 20

#: The most that zstd looks back, as a power of two: what its own program unpacks without being asked for more.
_WINDOW = 27


def require_packed(path: pathlib.Path, claimed: int, packed: int, what: str, times: int = 1) -> None:
    """Refuse far more bytes than splats were ever packed in, before they are unpacked; times: how much better
    than others what is packed there may be."""
    if claimed > times * (MAX_PACKED * packed + LITTLE):
        raise InputError(f"{path}: {what} claim {claimed} bytes out of {packed}: splats cannot be packed so far")


def gunzipped_head(path: pathlib.Path, data: bytes, size: int) -> bytes:
    """The first bytes that gzip packed, at most `size`; path: for messages."""
    try:
        return zlib.decompressobj(31).decompress(data, size)
    except zlib.error as error:
        raise InputError(f"{path}: what gzip packed in it cannot be unpacked: {error}") from None


def gunzipped(path: pathlib.Path, data: bytes, most: int) -> bytes:
    """What gzip packed, at most `most` bytes, for which there is memory; path: for messages."""
    unpacker, parts, total, rest = zlib.decompressobj(31), [], 0, data
    try:
        while rest and not unpacker.eof:
            part = unpacker.decompress(rest, min(CHUNK, most + 1 - total))
            total += len(part)
            if total > most:
                raise InputError(f"{path}: it unpacks to more than {most} bytes, more than its header says")
            parts.append(part)
            rest = unpacker.unconsumed_tail
            if not part and not rest:
                break
    except zlib.error as error:
        raise InputError(f"{path}: what gzip packed in it cannot be unpacked: {error}") from None
    if not unpacker.eof:
        raise InputError(f"{path}: the file ends before what is packed in it")
    return b"".join(parts)


def unzstd(path: pathlib.Path, data: bytes, size: int) -> bytes:
    """The bytes that zstd packed, of which there must be `size`; path: for messages."""
    zstd = _zstd()
    try:
        if zstd.__name__ == "zstandard":
            unpacker = zstd.ZstdDecompressor(max_window_size=1 << _WINDOW)
            with unpacker.stream_reader(io.BytesIO(data)) as reader:
                found = _read_up_to(reader, size + 1)
        else:
            options = {zstd.DecompressionParameter.window_log_max: _WINDOW}
            with zstd.ZstdFile(io.BytesIO(data), options=options) as reader:
                found = _read_up_to(reader, size + 1)
    except (zstd.ZstdError, EOFError) as error:
        raise InputError(f"{path}: what zstd packed in it cannot be unpacked: {' '.join(str(error).split())}") from None
    if len(found) != size:
        raise InputError(
            f"{path}: {size} bytes should be packed by zstd, got {'more' if len(found) > size else len(found)}"
        )
    return found


def zstd_packed(data: bytes) -> bytes:
    """Bytes packed by zstd."""
    zstd = _zstd()
    return zstd.ZstdCompressor(level=12).compress(data) if zstd.__name__ == "zstandard" else zstd.compress(data, 12)


def zip_members(path: pathlib.Path, what: str) -> zipfile.ZipFile:
    """The archive of a file; one line for what is none."""
    try:
        return zipfile.ZipFile(path)
    except (zipfile.BadZipFile, NotImplementedError, ValueError, UnicodeDecodeError, EOFError) as error:
        raise InputError(f"{path}: not {what}, which is a .zip archive: {' '.join(str(error).split())}") from None


def read_member(path: pathlib.Path, archive: zipfile.ZipFile, name: str, room: int, most: int = 1 << 40) -> bytes:
    """The bytes of a member of an archive, at most `most`, each of which takes `room` bytes of memory; path: for
    messages."""
    try:
        info = archive.getinfo(name)
    except KeyError:
        raise InputError(f"{path}: the archive lacks {shown(name)}") from None
    if info.flag_bits & 1:
        raise InputError(f"{path}: {shown(name)} is encrypted, which is not read")
    if info.file_size > MAX_RATIO * info.compress_size + 1024:
        raise InputError(f"{path}: {shown(name)} claims {info.file_size} bytes out of {info.compress_size}")
    if info.file_size > most:
        raise InputError(f"{path}: {shown(name)} has {info.file_size} bytes, at most {most} are read")
    require_host_memory(room * info.file_size, f"{path}: the {info.file_size} bytes of {shown(name)} need")
    try:
        with archive.open(info) as member:
            found = _read_up_to(member, info.file_size + 1)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError, OSError) as error:
        raise InputError(f"{path}: {shown(name)} cannot be unpacked: {' '.join(str(error).split())}") from None
    if len(found) != info.file_size:
        raise InputError(f"{path}: {shown(name)} ends after {len(found)} of {info.file_size} bytes")
    return found


def _read_up_to(reader: Any, size: int) -> bytes:
    """At most `size` bytes of a reader, which may give fewer at once."""
    parts, left = [], size
    while left and (part := reader.read(min(left, CHUNK))):
        parts.append(part)
        left -= len(part)
    return b"".join(parts)


def _zstd() -> Any:
    """The module that packs by zstd: Python's own from 3.14 on, otherwise zstandard."""
    name = "compression.zstd" if sys.version_info >= (3, 14) else "zstandard"
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(install_line(name, str(pathlib.Path(__file__).parents[3]))) from error
