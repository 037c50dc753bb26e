"""Niantic's .spz files: splats of 20 bytes and a byte for each further harmonic, packed by gzip (version 1 to 3), by
zstd (version 4), or not at all."""

from __future__ import annotations

import itertools
import pathlib
import struct
import zlib
from collections.abc import Iterator

import numpy as np

from ...core.checks import shown, warn_caller
from ...core.files import read_limited
from ...core.memory import require_host_memory
from ...errors import InputError
from .axes import SPZ_AXES, axes_matrix, turned, turned_over
from .compressed import with_largest, without_largest
from .contents import DEGREES, FINEST, FIRST, FURTHER, LOGS, SplatContents, byte_logits, opacities_of, usual_size
from .unpacking import gunzipped, gunzipped_head, require_packed, unzstd, zstd_packed

_HEADER, _HEADER_4 = struct.Struct("<4sIIBBBB"), struct.Struct("<4sIIBBBBI12x")

#: Sizes packed and unpacked of a stream of version 4; kind and bytes of an extension.
_STREAM, _RECORD = struct.Struct("<QQ"), struct.Struct("<II")

_MAGIC, _GZIP = b"NGSP", b"\x1f\x8b"

#: What the colours of a file are scaled by, and bits after the point of the positions that are written.
COLOR_SCALE, FRACTIONAL_BITS = 0.15, 12

#: Most bits after the point.
_MAX_BITS = 23

#: What files hold: the least and the largest, and the step between two.
RANGES = {
    FIRST: (-0.5 / COLOR_SCALE, 0.5 / COLOR_SCALE, 1.0 / 255.0 / COLOR_SCALE),
    FURTHER: (-1.0, 127.0 / 128.0, 1.0 / 128.0),
    LOGS: (-10.0, 255.0 / 16.0 - 10.0, 1.0 / 16.0),
}

#: The most that a position of 24 bits holds, in its units.
_MOST = (1 << 23) - 1

#: Flags: of splats that were fitted with antialiasing, and of files with extensions.
_ANTIALIASED, _EXTENDED = 1, 2

#: The extension that says where the axes point, and its values from 1 on (Adobe's; 0 says nothing).
_AXES_RECORD = 0xADBE0003
_AXES = "LDB RDB LUB RUB LDF RDF LUF RUF LFD RFD LFU RFU LBD RBD LBU RBU".split()

#: Most bytes of extensions.
_MAX_EXTENSIONS = 1 << 20

#: Bytes of memory that an unpacked byte takes until its splats are made.
_ROOM = 16

#: Harmonics of a channel that a field has room for.
_MAX_HARMONICS = 15


def read_spz(path: pathlib.Path) -> SplatContents:
    """The splats of an .spz file."""
    return read_spz_data(path, read_limited(path, "splat file"))


def read_spz_data(path: pathlib.Path, data: bytes) -> SplatContents:
    """The splats that the bytes of an .spz file hold, with the axes of a field; path: for messages."""
    packed = data.startswith(_GZIP)
    head = gunzipped_head(path, data, _HEADER.size) if packed else data[: _HEADER.size]
    if len(head) < _HEADER.size:
        raise InputError(f"{path}: an .spz file has a header of {_HEADER.size} bytes, got {len(head)}")
    magic, version, count, degree, bits, flags, _ = _HEADER.unpack(head)
    if magic != _MAGIC:
        raise InputError(f"{path}: no .spz file: it begins with {head[:4]!r}")
    if not 1 <= version <= (3 if packed else 4):
        most = "1 to 3 in gzip" if packed else "1 to 4"
        raise InputError(f"{path}: .spz files of version {most} are read, this is version {version}")
    if degree > 4 or bits > _MAX_BITS:
        raise InputError(
            f"{path}: harmonics of degree {degree} and {bits} bits after the point: at most 4 and {_MAX_BITS}"
        )
    further = (degree + 1) ** 2 - 1
    widths = (6 if version == 1 else 9, 1, 3, 3, 3 if version < 3 else 4, 3 * further)
    size = count * sum(widths)
    require_packed(path, size, len(data), f"its {count} splats of degree {degree}")
    require_host_memory(_ROOM * size, f"{path}: its {count} splats of degree {degree} need")
    if version == 4:
        parts, extensions = _streams(path, data, [count * width for width in widths])
    else:
        whole = gunzipped(path, data, _HEADER.size + size + _MAX_EXTENSIONS) if packed else data
        extra = len(whole) - _HEADER.size - size
        if extra < 0 or (extra and not flags & _EXTENDED):
            raise InputError(
                f"{path}: {count} splats of degree {degree} take {_HEADER.size + size} bytes, got {len(whole)}"
            )
        ends = np.cumsum([_HEADER.size, *(count * width for width in widths)])
        parts = [whole[begin:end] for begin, end in itertools.pairwise(ends)]
        extensions = whole[len(whole) - extra :]
    tables = [np.frombuffer(part, np.uint8).reshape(count, width) for part, width in zip(parts, widths, strict=True)]
    if degree == 4:
        warn_caller(f"{path}: its harmonics of degree 4 are left out: those of degree 0 to 3 are read")
    contents = _splats(tables, version, bits, min(further, _MAX_HARMONICS), bool(flags & _ANTIALIASED))
    axes = _declared_axes(path, extensions) if flags & _EXTENDED else SPZ_AXES
    return turned(contents, axes_matrix(axes))


def write_spz(contents: SplatContents, version: int = 3) -> bytes:
    """An .spz file of version 3 or 4; ValueError for splats too far from the origin for 24 bits."""
    if version not in (3, 4) or isinstance(version, bool):
        raise InputError(f".spz files of version 3 and 4 are written, got {shown(version)}")
    contents = turned_over(contents)
    count, degree = contents.count, DEGREES[contents.harmonics.shape[1]]
    bits = _fractional_bits(contents)
    fixed = np.round(contents.centers.astype(np.float64) * (1 << bits)).astype(np.int32)
    places = np.stack([(fixed >> shift) & 255 for shift in (0, 8, 16)], axis=-1)
    alphas = np.round(255.0 * opacities_of(contents.logits))
    colors = 255.0 * (contents.harmonics[:, 0].astype(np.float64) * COLOR_SCALE + 0.5)
    scales = 16.0 * (contents.log_scales.astype(np.float64) + 10.0)
    octets = 128.0 * contents.harmonics[:, 1:].astype(np.float64) + 128.0
    body = [np.clip(np.round(part), 0, 255).astype(np.uint8).tobytes() for part in (places, alphas, colors, scales)]
    body += [_turn_bytes(contents.quaternions), np.clip(np.round(octets), 0, 255).astype(np.uint8).tobytes()]
    flags = _ANTIALIASED if contents.antialias else 0
    if version == 4:
        return _packed_streams(body[: 6 if degree else 5], (count, degree, bits, flags))
    packer = zlib.compressobj(9, zlib.DEFLATED, 31)
    header = _HEADER.pack(_MAGIC, 3, count, degree, bits, flags, 0)
    return packer.compress(header + b"".join(body)) + packer.flush()


def _fractional_bits(contents: SplatContents) -> int:
    """Bits after the point of positions: those that all programs write, more for finer splats, fewer for far ones."""
    if not contents.count:
        return FRACTIONAL_BITS
    finest = FINEST * usual_size(contents)
    bits = int(np.clip(np.ceil(-np.log2(finest)), FRACTIONAL_BITS, _MAX_BITS))
    reach = float(np.abs(contents.centers).max())
    while bits > 0 and reach * (1 << bits) > _MOST:
        bits -= 1
    if reach * (1 << bits) > _MOST:
        raise InputError(f"an .spz file holds positions up to {_MOST}, a splat is {reach:.4g} away: move or scale it")
    return bits


def position_step(contents: SplatContents) -> float:
    """From one position of a file to the next, world units."""
    return 0.5 ** _fractional_bits(contents)


def _streams(path: pathlib.Path, data: bytes, sizes: list[int]) -> tuple[list[bytes], bytes]:
    """The parts of a file of version 4, each of the size that it must have, and its extensions."""
    if len(data) < _HEADER_4.size:
        raise InputError(f"{path}: an .spz file of version 4 has a header of {_HEADER_4.size} bytes, got {len(data)}")
    *_, streams, table = _HEADER_4.unpack_from(data)
    wanted = sizes if sizes[-1] or streams == len(sizes) else sizes[:-1]  # without harmonics they have no stream
    place = table + streams * _STREAM.size
    if streams != len(wanted) or not _HEADER_4.size <= table <= table + _MAX_EXTENSIONS or place > len(data):
        raise InputError(f"{path}: {len(wanted)} streams expected, got {streams} with their table at byte {table}")
    parts = []
    for k, size in enumerate(wanted):
        packed, claimed = _STREAM.unpack_from(data, table + k * _STREAM.size)
        if claimed != size or place + packed > len(data):
            raise InputError(
                f"{path}: stream {k} must hold {size} bytes and end in the file of {len(data)}, it claims {claimed} in "
                f"{packed} from byte {place} on"
            )
        parts.append(unzstd(path, data[place : place + packed], size) if size else b"")
        place += packed
    return parts + [b""] * (len(sizes) - len(parts)), data[_HEADER_4.size : table]


def _packed_streams(body: list[bytes], values: tuple[int, int, int, int]) -> bytes:
    """A file of version 4, which says where its axes point; values: of the header from the number of splats on."""
    extension = _RECORD.pack(_AXES_RECORD, 4) + struct.pack("<I", _AXES.index(SPZ_AXES) + 1)
    packed = [zstd_packed(part) for part in body]
    count, degree, bits, flags = values
    header = _HEADER_4.pack(
        _MAGIC, 4, count, degree, bits, flags | _EXTENDED, len(body), _HEADER_4.size + len(extension)
    )
    table = b"".join(_STREAM.pack(len(part), len(raw)) for part, raw in zip(packed, body, strict=True))
    return header + extension + table + b"".join(packed)


def _declared_axes(path: pathlib.Path, extensions: bytes) -> str:
    """Where the axes point by a file's extensions; where none says so as in all files."""
    for kind, content in _records(path, extensions):
        if kind == _AXES_RECORD:
            value = int.from_bytes(content[:4], "little")
            if len(content) < 4 or value > len(_AXES):
                raise InputError(f"{path}: its coordinate system {value} is not known: 0 to {len(_AXES)} are")
            return _AXES[value - 1] if value else SPZ_AXES
    return SPZ_AXES


def _records(path: pathlib.Path, extensions: bytes) -> Iterator[tuple[int, bytes]]:
    """Kind and content of each extension."""
    place = 0
    while place + _RECORD.size <= len(extensions):
        kind, size = _RECORD.unpack_from(extensions, place)
        place += _RECORD.size + size
        if place > len(extensions):
            raise InputError(f"{path}: its extension {kind:#x} of {size} bytes ends beyond all {len(extensions)}")
        yield kind, extensions[place - size : place]


def _splats(tables: list[np.ndarray], version: int, bits: int, further: int, antialias: bool) -> SplatContents:
    """The splats of tables of bytes, (n, width) each, with the axes of the file."""
    places, alphas, colors, scales, turns, octets = tables
    count = len(places)
    if version == 1:
        centers = np.ascontiguousarray(places).view("<f2").astype(np.float32)
    else:
        uint8s = places.reshape(count, 3, 3).astype(np.int32)
        fixed = uint8s[..., 0] | uint8s[..., 1] << 8 | uint8s[..., 2] << 16
        centers = (np.where(fixed > _MOST, fixed - (1 << 24), fixed) / float(1 << bits)).astype(np.float32)
    harmonics = np.empty((count, 1 + further, 3), np.float32)
    harmonics[:, 0] = (colors / 255.0 - 0.5) / COLOR_SCALE
    harmonics[:, 1:] = (octets[:, : 3 * further].reshape(count, further, 3) - 128.0) / 128.0
    return SplatContents(
        centers,
        (scales / 16.0 - 10.0).astype(np.float32),
        (_three_bytes(turns) if version < 3 else _four_bytes(turns)).astype(np.float32),
        byte_logits(alphas[:, 0]),
        harmonics,
        antialias=antialias,
    )


def _three_bytes(turns: np.ndarray) -> np.ndarray:
    """(n, 4) w x y z of x, y and z in a byte each."""
    xyz = turns / 127.5 - 1.0
    w = np.sqrt(np.maximum(1.0 - (xyz**2).sum(axis=1), 0.0))
    return np.column_stack([w, xyz])


def _four_bytes(turns: np.ndarray) -> np.ndarray:
    """(n, 4) w x y z of four bytes: the index of the largest of x y z w, then signs and 9-bit sizes of the others."""
    uint8s = turns.astype(np.uint32)
    packed = uint8s[:, 0] | uint8s[:, 1] << 8 | uint8s[:, 2] << 16 | uint8s[:, 3] << 24
    parts = np.stack([(packed >> shift) & 1023 for shift in (20, 10, 0)], axis=1).astype(np.int64)
    others = (parts & 511) / 511.0 * np.sqrt(0.5) * np.where(parts & 512, -1.0, 1.0)
    return np.roll(with_largest(others, (packed >> 30).astype(int)), 1, axis=1)


def _turn_bytes(quaternions: np.ndarray) -> bytes:
    length = np.linalg.norm(quaternions, axis=1, keepdims=True)
    whole = np.where(length > 0.0, quaternions, [1.0, 0.0, 0.0, 0.0])
    others, largest = without_largest(np.roll(whole, -1, axis=1))
    sizes = np.minimum(np.floor(np.abs(others) * (511.0 * np.sqrt(2.0)) + 0.5), 511).astype(np.uint32)
    parts = sizes | np.where(others < 0.0, 512, 0).astype(np.uint32)
    packed = largest.astype(np.uint32) << 30
    for k, shift in enumerate((20, 10, 0)):
        packed |= parts[:, k] << np.uint32(shift)
    return packed.astype("<u4").tobytes()
