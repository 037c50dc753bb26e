"""The files of web viewers: .splat, 32 bytes a splat, and .ksplat of GaussianSplats3D, sections of buckets."""

from __future__ import annotations

import pathlib
import struct

import numpy as np

from ...core.files import read_limited
from ...core.memory import require_host_memory
from ...errors import InputError
from ...field.io.field_file import Y0
from .contents import (
    FIRST,
    FLOAT_LOGS,
    FURTHER,
    LOGS,
    SplatContents,
    byte_logits,
    joined,
    logs_of,
    opacities_of,
    unit_quaternions,
)

_ROW = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)])

#: What .splat files hold, which have bytes of colours alone, and .ksplat files: see `SplatFormat`.
KSPLAT_RANGES = {FIRST: (-0.5 / Y0, 0.5 / Y0, 1.0 / 255.0 / Y0)}
RANGES = {**KSPLAT_RANGES, FURTHER: (0.0, 0.0, 0.0), LOGS: FLOAT_LOGS}

#: Bytes of memory that a byte of a .splat file takes until its splats are made.
_SPLAT_ROOM = 8


def read_splat(path: pathlib.Path) -> SplatContents:
    """The splats of a .splat file."""
    data = read_limited(path, "splat file", room=_SPLAT_ROOM)
    if len(data) % _ROW.itemsize:
        raise InputError(f"{path}: a .splat file has {_ROW.itemsize} bytes a splat, got {len(data)} bytes")
    table = np.frombuffer(data, _ROW)
    shares = table["color"] / 255.0
    return SplatContents(
        table["position"].astype(np.float32),
        logs_of(table["scale"]),
        ((table["rotation"].astype(np.float32) - 128.0) / 128.0),
        byte_logits(table["color"][:, 3]),
        ((shares[:, :3] - 0.5) / Y0).astype(np.float32)[:, None, :],
    )


def write_splat(contents: SplatContents) -> bytes:
    """A .splat file. Harmonics of degree 1 and up, which it has no place for, are left out."""
    table = np.zeros(contents.count, _ROW)
    table["position"] = contents.centers
    table["scale"] = np.exp(np.maximum(contents.log_scales.astype(np.float64), FLOAT_LOGS[0]))
    color = 0.5 + Y0 * contents.harmonics[:, 0].astype(np.float64)
    shares = np.column_stack([color, opacities_of(contents.logits)])
    table["color"] = np.clip(np.round(255.0 * shares), 0, 255)
    table["rotation"] = np.clip(np.round(128.0 * unit_quaternions(contents.quaternions) + 128.0), 0, 255)
    return table.tobytes()


#: Bytes of the header of a .ksplat file and of a section.
HEADER, SECTION = 4096, 1024

_FILE = struct.Struct("<BB2xIIIIH2x3f2f")

_SECTION = struct.Struct("<IIIIfH2xIIIIH")

#: By the level of compression: types of a position, of scales and rotations, and of harmonics.
_TYPES = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))

#: What a position in its bucket is counted from, where a section does not say.
_RANGE = 32767

#: What harmonics in bytes reach, where the file does not say.
_HARMONICS_REACH = 1.5

#: Bytes of memory that a byte of a .ksplat file takes until its splats are made.
_ROOM = 12


def read_ksplat(path: pathlib.Path) -> SplatContents:
    """The splats of a .ksplat file, whose axes are those of the .ply that it was made of."""
    data = read_limited(path, "splat file", room=_ROOM)
    if len(data) < HEADER:
        raise InputError(f"{path}: a .ksplat file has a header of {HEADER} bytes, got {len(data)}")
    major, minor, sections, _, _, total, level, *reach = _FILE.unpack_from(data)
    if (major, minor) != (0, 1):
        raise InputError(f"{path}: .ksplat files of version 0.1 are read, this is version {major}.{minor}")
    if level >= len(_TYPES):
        raise InputError(f"{path}: .ksplat files of compression 0, 1 and 2 are read, this has {level}")
    place = HEADER + sections * SECTION
    if place > len(data):
        raise InputError(f"{path}: the headers of {sections} sections take {place} bytes, got {len(data)}")
    low, high = reach[3:] if reach[3] < reach[4] else (-_HARMONICS_REACH, _HARMONICS_REACH)
    heads = [_SECTION.unpack_from(data, HEADER + k * SECTION) for k in range(sections)]
    degree = max((head[-1] for head in heads if head[0]), default=0)
    if degree > 3:
        raise InputError(f"{path}: harmonics of degree {degree}: at most 3")
    parts, left = [], memoryview(data)
    for head in heads:
        part, size = _read_section(path, left[place:], head, level, (low, high))
        parts.append(part)
        place += size
    count = sum(part.count for part in parts)
    if count != total:
        raise InputError(f"{path}: its sections hold {count} splats, its header says {total}")
    return joined(parts, degree)


def _read_section(
    path: pathlib.Path, data: memoryview, head: tuple, level: int, reach: tuple[float, float]
) -> tuple[SplatContents, int]:
    """The splats of a section that begins where `data` does, and its bytes; reach: of harmonics in bytes."""
    count, most, bucket_size, buckets, block, bucket_bytes, span, _, full, partial, degree = head
    if degree > 3:
        raise InputError(f"{path}: harmonics of degree {degree}: at most 3")
    place_type, value_type, harmonic_type = _TYPES[level]
    further = (degree + 1) ** 2 - 1
    row = np.dtype(
        [
            ("place", place_type, 3),
            ("scale", value_type, 3),
            ("rotation", value_type, 4),
            ("color", "u1", 4),
            ("harmonics", harmonic_type, (3 * further,)),
        ]
    )
    begin = 4 * partial + bucket_bytes * buckets
    size = begin + row.itemsize * most
    if count > most or begin + row.itemsize * count > len(data):
        raise InputError(f"{path}: a section of {count} splats takes {size} bytes, {len(data)} are left in the file")
    table = np.frombuffer(data, row, count, begin)
    centers = table["place"].astype(np.float32)
    if level:
        if buckets and bucket_bytes < 12:
            raise InputError(f"{path}: a bucket has a middle of 12 bytes, got {bucket_bytes}")
        middles = np.frombuffer(
            data, [("middle", "<f4", 3), ("rest", "u1", max(bucket_bytes - 12, 0))], buckets, 4 * partial
        )
        of = _buckets(path, count, bucket_size, full, np.frombuffer(data, "<u4", partial), buckets)
        span = span or _RANGE
        with np.errstate(over="ignore", invalid="ignore"):  # found by the check of what is finite
            within = (table["place"].astype(np.float64) - span) * (block / 2.0 / span)
            centers = (within + middles["middle"][of]).astype(np.float32)
    harmonics = np.empty((count, 1 + further, 3), np.float32)
    harmonics[:, 0] = (table["color"][:, :3] / 255.0 - 0.5) / Y0
    values = table["harmonics"].astype(np.float32)
    if level == 2:
        values = reach[0] + (reach[1] - reach[0]) / 255.0 * values
    for band in range(1, degree + 1):  # those of a degree stand together, all of red first
        own = slice(band**2 - 1, (band + 1) ** 2 - 1)
        part = values[:, 3 * own.start : 3 * own.stop].reshape(count, 3, 2 * band + 1)
        harmonics[:, 1 + own.start : 1 + own.stop] = part.transpose(0, 2, 1)
    contents = SplatContents(
        centers,
        logs_of(table["scale"]),
        table["rotation"].astype(np.float32),
        byte_logits(table["color"][:, 3]),
        harmonics,
    )
    return contents, size


def _buckets(path: pathlib.Path, count: int, size: int, full: int, lengths: np.ndarray, buckets: int) -> np.ndarray:
    """(n,) the bucket of each splat: full ones first, then those of fewer splats."""
    if full + len(lengths) > buckets or full * size > count or full * size + int(lengths.sum()) < count:
        raise InputError(f"{path}: {full} full buckets of {size} and {len(lengths)} others do not hold {count} splats")
    require_host_memory(16 * count, f"{path}: its {count} splats need")
    last = np.searchsorted(np.cumsum(lengths.astype(np.int64)), np.arange(count - full * size), side="right")
    return np.concatenate([np.repeat(np.arange(full), size), full + last])
