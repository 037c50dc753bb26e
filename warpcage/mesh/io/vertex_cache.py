"""Vertex caches: the vertices of a mesh at each frame without its faces, .pc2 (Point Cache 2) and .mdd (LightWave)."""

from __future__ import annotations

import dataclasses
import struct

import numpy as np

from ...core.files import PathLike, atomic_path, read_limited
from ...errors import InputError

#: How vertex caches end.
CACHE_ENDINGS = (".pc2", ".mdd")

#: How a .pc2 file begins: its mark, version, points, first frame, frames a sample, and samples.
_PC2_HEAD, _PC2_MARK = struct.Struct("<12siiffi"), b"POINTCACHE2\0"

#: How a .mdd file begins: frames and points.
_MDD_HEAD = struct.Struct(">ii")

#: Bytes of memory for each of a file: floats of both precisions, and cages.
_ROOM = 4


@dataclasses.dataclass(frozen=True)
class VertexCache:
    """The vertices of a mesh at some moments."""

    vertices: np.ndarray  # (n, v, 3) float32 in the axes of the file
    moments: np.ndarray  # (n,) float64 of each from the first one on, seconds or frames
    in_frames: bool  # whether the moments are frames


def read_vertex_cache(path: PathLike) -> VertexCache:
    """Read a .pc2 or .mdd file without trusting it."""
    data = read_limited(path, "vertex cache", _ROOM)
    try:
        return _read_pc2(data) if data.startswith(_PC2_MARK) else _read_mdd(data)
    except ValueError as error:
        raise InputError(f"vertex cache {str(path)!r} cannot be read: {error}") from None


def _read_pc2(data: bytes) -> VertexCache:
    if len(data) < _PC2_HEAD.size:
        raise InputError("it breaks off in its beginning")
    _, version, points, _, frames_each, count = _PC2_HEAD.unpack_from(data)
    if version != 1 or not 0.0 < frames_each < np.inf:
        raise InputError(f"it has version {version} and {frames_each:g} frames a sample, known are 1 and more than 0")
    vertices = _positions(data, _PC2_HEAD.size, count, points, "<f4")
    return VertexCache(vertices, np.arange(count) * float(frames_each), True)


def _read_mdd(data: bytes) -> VertexCache:
    if len(data) < _MDD_HEAD.size:
        raise InputError("it breaks off in its beginning")
    count, points = _MDD_HEAD.unpack_from(data)
    begin = _MDD_HEAD.size + 4 * max(count, 0)
    vertices = _positions(data, begin, count, points, ">f4")
    times = np.frombuffer(data, ">f4", count, _MDD_HEAD.size).astype(np.float64)
    if not np.isfinite(times).all() or not (np.diff(times) > 0.0).all():
        raise InputError("its times must be finite and ascend")
    return VertexCache(vertices, times - times[0], False)


def _positions(data: bytes, begin: int, count: int, points: int, kind: str) -> np.ndarray:
    """(n, v, 3) float32, which end the file."""
    claimed = begin + 12 * count * points
    if count < 1 or points < 1 or claimed != len(data):
        raise InputError(
            f"{count} frames of {points} vertices take {claimed} bytes, the file has {len(data)}: it is cut off, "
            "damaged, or holds something else"
        )
    vertices = np.frombuffer(data, kind, 3 * count * points, begin).reshape(count, points, 3)
    if not np.isfinite(vertices).all():
        raise InputError("its vertices must be finite")
    return vertices.astype(np.float32)


def write_vertex_cache(path: PathLike, vertices: np.ndarray, fps: float) -> None:
    """Write vertices (n, v, 3), one frame after the other, whole or not at all; the ending is one of CACHE_ENDINGS."""
    count, points = vertices.shape[:2]
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        if temporary.suffix.lower() == ".pc2":
            file.write(_PC2_HEAD.pack(_PC2_MARK, 1, points, 0.0, 1.0, count) + vertices.astype("<f4").tobytes())
        else:
            times = (np.arange(count) / fps).astype(">f4")
            file.write(_MDD_HEAD.pack(count, points) + times.tobytes() + vertices.astype(">f4").tobytes())
