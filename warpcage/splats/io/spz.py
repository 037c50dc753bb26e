"""Niantic's .spz files: splats of 20 bytes and a byte for each further harmonic, packed by gzip."""

from __future__ import annotations

import pathlib
import struct
import zlib

import numpy as np

from ...core.files import MAX_RATIO, read_limited
from ...core.memory import require_host_memory
from .axes import turned_over
from .compressed import with_largest, without_largest
from .contents import DEGREES, SplatContents, logits_of, opacities_of

_HEADER = struct.Struct("<IIIBBBB")

_MAGIC = 0x5053474E

_ALPHA_EDGE = 0.25 / 255.0

#: What the colours of a file are scaled by, and bits after the point of the positions that are written.
COLOR_SCALE, FRACTIONAL_BITS = 0.15, 12

#: The most that a position of 24 bits holds, in its units.
_MOST = (1 << 23) - 1

#: Flag of splats that were fitted with antialiasing.
_ANTIALIASED = 1


def read_spz(path: pathlib.Path) -> SplatContents:
    """The splats of an .spz file."""
    data = _unpacked(path, read_limited(path, "splat file"))
    if len(data) < _HEADER.size:
        raise ValueError(f"{path}: an .spz file has a header of {_HEADER.size} bytes, got {len(data)}")
    magic, version, count, degree, bits, _flags, _reserved = _HEADER.unpack_from(data)
    if magic != _MAGIC:
        raise ValueError(f"{path}: no .spz file: it begins with {data[:4]!r}")
    if version not in (2, 3):
        raise ValueError(f"{path}: .spz files of version 2 and 3 are read, this is version {version}")
    if degree > 3 or bits > 23:
        raise ValueError(f"{path}: harmonics of degree {degree} and {bits} bits after the point: at most 3 and 23")
    further = (degree + 1) ** 2 - 1
    turn_bytes = 3 if version == 2 else 4
    widths = (9, 1, 3, 3, turn_bytes, 3 * further)
    if len(data) != (size := _HEADER.size + count * sum(widths)):
        raise ValueError(f"{path}: {count} splats of degree {degree} take {size} bytes, got {len(data)}")
    parts, position = [], _HEADER.size
    for width in widths:
        parts.append(np.frombuffer(data, np.uint8, count * width, position).reshape(count, width))
        position += count * width
    places, alphas, colors, scales, turns, octets = parts
    words = places.reshape(count, 3, 3).astype(np.int32)
    fixed = words[..., 0] | words[..., 1] << 8 | words[..., 2] << 16
    fixed = np.where(fixed > _MOST, fixed - (1 << 24), fixed)
    harmonics = np.empty((count, 1 + further, 3), np.float32)
    harmonics[:, 0] = (colors / 255.0 - 0.5) / COLOR_SCALE
    harmonics[:, 1:] = (octets.reshape(count, further, 3) - 128.0) / 128.0
    quaternions = _three_bytes(turns) if version == 2 else _four_bytes(turns)
    contents = SplatContents(
        (fixed / float(1 << bits)).astype(np.float32),
        (scales / 16.0 - 10.0).astype(np.float32),
        quaternions.astype(np.float32),
        logits_of(np.clip(alphas[:, 0] / 255.0, _ALPHA_EDGE, 1.0 - _ALPHA_EDGE)),
        harmonics,
    )
    return turned_over(contents)


def write_spz(contents: SplatContents) -> bytes:
    """An .spz file of version 3; ValueError for splats too far from the origin for 24 bits."""
    contents = turned_over(contents)
    count = contents.count
    reach = float(np.abs(contents.centers).max()) if count else 0.0
    bits = FRACTIONAL_BITS
    while bits > 0 and reach * (1 << bits) > _MOST:
        bits -= 1
    if reach * (1 << bits) > _MOST:
        raise ValueError(f"an .spz file holds positions up to {_MOST}, a splat is {reach:.4g} away: move or scale it")
    fixed = np.round(contents.centers.astype(np.float64) * (1 << bits)).astype(np.int32)
    places = np.stack([(fixed >> shift) & 255 for shift in (0, 8, 16)], axis=-1)
    alphas = np.round(255.0 * opacities_of(contents.logits))
    colors = 255.0 * (contents.harmonics[:, 0].astype(np.float64) * COLOR_SCALE + 0.5)
    scales = 16.0 * (contents.log_scales.astype(np.float64) + 10.0)
    octets = 128.0 * contents.harmonics[:, 1:].astype(np.float64) + 128.0
    header = _HEADER.pack(_MAGIC, 3, count, DEGREES[contents.harmonics.shape[1]], bits, 0, 0)
    body = [np.clip(np.round(part), 0, 255).astype(np.uint8).tobytes() for part in (places, alphas, colors, scales)]
    body += [_turn_bytes(contents.quaternions), np.clip(np.round(octets), 0, 255).astype(np.uint8).tobytes()]
    packer = zlib.compressobj(9, zlib.DEFLATED, 31)
    return packer.compress(header + b"".join(body)) + packer.flush()


def _unpacked(path: pathlib.Path, data: bytes) -> bytes:
    """What gzip packed."""
    require_host_memory(min(len(data) * MAX_RATIO, 1 << 26), f"{path}: unpacking it needs")
    unpacker, parts, total = zlib.decompressobj(31), [], 0
    try:
        rest = data
        while rest and not unpacker.eof:
            part = unpacker.decompress(rest, 1 << 24)
            total += len(part)
            require_host_memory(len(part) + total, f"{path}: its {total} bytes and more, unpacked, need")
            parts.append(part)
            rest = unpacker.unconsumed_tail
            if not part and not rest:
                break
    except zlib.error as error:
        raise ValueError(f"{path}: an .spz file is packed by gzip, this cannot be unpacked: {error}") from None
    if not unpacker.eof:
        raise ValueError(f"{path}: the .spz file ends before what is packed in it")
    return b"".join(parts)


def _three_bytes(turns: np.ndarray) -> np.ndarray:
    """(n, 4) w x y z of x, y and z in a byte each."""
    xyz = turns / 127.5 - 1.0
    w = np.sqrt(np.maximum(1.0 - (xyz**2).sum(axis=1), 0.0))
    return np.column_stack([w, xyz])


def _four_bytes(turns: np.ndarray) -> np.ndarray:
    """(n, 4) w x y z of words: which of x y z w is the largest, and sign and size of the others, of 1 and 9 bits."""
    words = turns.astype(np.uint32)
    word = words[:, 0] | words[:, 1] << 8 | words[:, 2] << 16 | words[:, 3] << 24
    parts = np.stack([(word >> shift) & 1023 for shift in (20, 10, 0)], axis=1).astype(np.int64)
    others = (parts & 511) / 511.0 * np.sqrt(0.5) * np.where(parts & 512, -1.0, 1.0)
    return np.roll(with_largest(others, (word >> 30).astype(int)), 1, axis=1)


def _turn_bytes(quaternions: np.ndarray) -> bytes:
    length = np.linalg.norm(quaternions, axis=1, keepdims=True)
    whole = np.where(length > 0.0, quaternions, [1.0, 0.0, 0.0, 0.0])
    others, largest = without_largest(np.roll(whole, -1, axis=1))
    sizes = np.minimum(np.floor(np.abs(others) * (511.0 * np.sqrt(2.0)) + 0.5), 511).astype(np.uint32)
    parts = sizes | np.where(others < 0.0, 512, 0).astype(np.uint32)
    word = largest.astype(np.uint32) << 30
    for k, shift in enumerate((20, 10, 0)):
        word |= parts[:, k] << np.uint32(shift)
    return word.astype("<u4").tobytes()
