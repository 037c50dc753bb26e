"""SuperSplat's .compressed.ply: splats in chunks of 256, 16 bytes each, and a byte for each further harmonic."""

from __future__ import annotations

import pathlib

import numpy as np

from ...core.checks import float32_spacing, listed
from ...errors import InputError
from ...field.io.field_file import Y0
from .contents import (
    FINEST,
    FURTHER,
    LOGS,
    SplatContents,
    byte_logits,
    chosen_contents,
    opacities_of,
    unit_quaternions,
    usual_size,
)
from .ply import PlyParts

#: Splats of a chunk.
CHUNK = 256

#: Scales of files beyond exp(+-20) are cut.
MAX_LOG_SCALE = 20.0

#: What files hold beside what each chunk says of its own values: the least and the largest, and the step between two.
RANGES = {FURTHER: (-4.0, 4.0, 8.0 / 256.0), LOGS: (-MAX_LOG_SCALE, MAX_LOG_SCALE, 0.0)}

_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def is_compressed(parts: PlyParts) -> bool:
    """Whether a PLY file holds packed splats."""
    table = parts.tables.get("vertex")
    return table is not None and "packed_position" in (table.dtype.names or ())


def read_compressed_ply(path: pathlib.Path, parts: PlyParts) -> SplatContents:
    """The splats of a .compressed.ply file, of which elements chunk, vertex and sh were read; path: for messages."""
    chunk, vertex = parts.tables.get("chunk"), parts.tables["vertex"]
    if chunk is None:
        raise InputError(f"{path}: packed splats need an element 'chunk', got {listed(parts.tables)}")
    ranges = [f"{begin}{axis}" for begin in ("min_", "max_", "min_scale_", "max_scale_") for axis in "xyz"]
    for table, names, kind in ((chunk, ranges, "f4"), (vertex, _PACKED, "u4")):
        lacking = [name for name in names if name not in (table.dtype.names or ()) or table.dtype[name].str[1:] != kind]
        if lacking:
            raise InputError(f"{path}: packed splats lack {listed(lacking)}")
    if len(chunk) * CHUNK < len(vertex):
        raise InputError(
            f"{path}: {len(vertex)} packed splats need {-(-len(vertex) // CHUNK)} chunks, got {len(chunk)}"
        )
    of = np.arange(len(vertex)) // CHUNK

    def within(values: np.ndarray, begin: str, axes: str) -> np.ndarray:
        low, high = (_columns(chunk, [f"{end}_{begin}{axis}" for axis in axes])[of] for end in ("min", "max"))
        with np.errstate(over="ignore", invalid="ignore"):  # found by the check of what is finite
            return low * (1.0 - values) + high * values

    colors = _bytes(vertex["packed_color"])
    opacities, colors = colors[:, 3], colors[:, :3]
    named = chunk.dtype.names or ()
    if "min_r" in named:
        lacking = [f"{end}_{c}" for end in ("min", "max") for c in "rgb" if f"{end}_{c}" not in named]
        if lacking:
            raise InputError(f"{path}: packed splats lack {listed(lacking)}")
        colors = within(colors, "", "rgb")
    further = _further(path, parts, len(vertex))
    harmonics = np.zeros((len(vertex), 1 + further.shape[1], 3), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        harmonics[:, 0] = (colors - 0.5) / Y0
        harmonics[:, 1:] = further
        return SplatContents(
            within(_thirds(vertex["packed_position"]), "", "xyz").astype(np.float32),
            within(_thirds(vertex["packed_scale"]), "scale_", "xyz").astype(np.float32),
            _unpacked_quaternions(vertex["packed_rotation"]).astype(np.float32),
            byte_logits(255.0 * opacities),
            harmonics,
        )


def write_compressed_ply(contents: SplatContents) -> bytes:
    """A .compressed.ply file. The splats keep their order where that does not round their positions by much."""
    contents = _near_together(contents)
    count = contents.count
    begins = np.arange(0, count, CHUNK)
    scales = np.clip(contents.log_scales.astype(np.float64), -MAX_LOG_SCALE, MAX_LOG_SCALE)
    colors = 0.5 + Y0 * contents.harmonics[:, 0].astype(np.float64)
    named = {"": contents.centers.astype(np.float64), "scale_": scales}
    ranges, placed = {}, {}
    for what, values, axes in (*((what, values, "xyz") for what, values in named.items()), ("c", colors, "rgb")):
        low, high = (
            ends.reduceat(values, begins, axis=0).astype("<f4") if count else np.zeros((0, 3), "<f4")
            for ends in (np.minimum, np.maximum)
        )
        prefix = "" if what == "c" else what
        ranges |= {f"min_{prefix}{axis}": low[:, k] for k, axis in enumerate(axes)}
        ranges |= {f"max_{prefix}{axis}": high[:, k] for k, axis in enumerate(axes)}
        of = np.arange(count) // CHUNK
        span = high.astype(np.float64) - low
        with np.errstate(divide="ignore", invalid="ignore"):
            placed[what] = np.where(span[of] > 0.0, (values - low[of]) / span[of], 0.0)
    chunk = np.zeros(len(begins), [(name, "<f4") for name in ranges])
    for name, values in ranges.items():
        chunk[name] = values
    vertex = np.zeros(count, [(name, "<u4") for name in _PACKED])
    vertex["packed_position"] = _packed_thirds(placed[""])
    vertex["packed_scale"] = _packed_thirds(placed["scale_"])
    vertex["packed_rotation"] = _packed_quaternions(contents.quaternions)
    alpha = opacities_of(contents.logits)
    vertex["packed_color"] = _packed(np.column_stack([placed["c"], alpha]), (24, 16, 8, 0), (8, 8, 8, 8))
    further = contents.harmonics[:, 1:].transpose(0, 2, 1).reshape(count, -1).astype(np.float64)
    octets = np.clip(np.trunc((further / 8.0 + 0.5) * 256.0), 0, 255).astype(np.uint8)
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {len(chunk)}"]
    lines += [f"property float {name}" for name in ranges]
    lines += [f"element vertex {count}", *(f"property uint {name}" for name in _PACKED)]
    if octets.shape[1]:
        lines += [f"element sh {count}", *(f"property uchar f_rest_{k}" for k in range(octets.shape[1]))]
    header = "\n".join([*lines, "end_header", ""])
    return header.encode() + chunk.tobytes() + vertex.tobytes() + octets.tobytes()


def position_step(contents: SplatContents) -> float:
    """From one position of a file to the next in the usual chunk, world units: the largest of the three axes, or that
    of float32, which the corners of chunks are."""
    if not contents.count:
        return 0.0
    return max(_step(_near_together(contents)), float32_spacing(float(np.abs(contents.centers).max())))


def _near_together(contents: SplatContents) -> SplatContents:
    """Splats whose chunks lie in small boxes: as they are where these are, otherwise along a curve (Morton's)."""
    if contents.count <= CHUNK or _step(contents) <= FINEST * usual_size(contents):
        return contents
    low, span = contents.centers.min(axis=0), np.ptp(contents.centers, axis=0)
    cells = ((contents.centers - low) / np.where(span > 0.0, span, 1.0) * (2**21 - 1)).astype(np.int64)
    codes = np.zeros(contents.count, np.int64)
    for bit in range(21):
        for axis in range(3):
            codes |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return chosen_contents(contents, np.argsort(codes, kind="stable"))


def _step(contents: SplatContents) -> float:
    begins = np.arange(0, contents.count, CHUNK)
    low, high = (end.reduceat(contents.centers, begins, axis=0) for end in (np.minimum, np.maximum))
    return float(np.median(((high - low) / (2047.0, 1023.0, 2047.0)).max(axis=1)))


def _further(path: pathlib.Path, parts: PlyParts, count: int) -> np.ndarray:
    """(n, b - 1, 3) the harmonics after the first."""
    table = parts.tables.get("sh")
    if table is None:
        return np.zeros((count, 0, 3))
    names = [f"f_rest_{k}" for k in range(len(table.dtype.names or ()))]
    odd = sorted(set(table.dtype.names or ()) ^ set(names))
    if odd or len(names) not in (9, 24, 45) or len(table) != count:
        raise InputError(f"{path}: element 'sh' must have 9, 24 or 45 bytes f_rest_0 and on for each of {count} splats")
    if any(table.dtype[name].str[1:] != "u1" for name in names):
        raise InputError(f"{path}: element 'sh' must hold bytes (uchar)")
    octets = np.stack([table[name] for name in names], axis=1).astype(np.float64)
    shares = np.where(octets == 0, 0.0, np.where(octets == 255, 1.0, (octets + 0.5) / 256.0))
    return (8.0 * (shares - 0.5)).reshape(count, 3, -1).transpose(0, 2, 1)


def _columns(table: np.ndarray, names: list[str]) -> np.ndarray:
    return np.stack([table[name] for name in names], axis=1).astype(np.float64)


def _bits(packed: np.ndarray, shift: int, bits: int) -> np.ndarray:
    """Some bits of uint32s as a share of their most."""
    most = (1 << bits) - 1
    return ((packed >> np.uint32(shift)) & np.uint32(most)).astype(np.float64) / most


def _thirds(packed: np.ndarray) -> np.ndarray:
    """(n, 3) the shares packed in 11, 10 and 11 bits."""
    return np.stack([_bits(packed, 21, 11), _bits(packed, 11, 10), _bits(packed, 0, 11)], axis=1)


def _bytes(packed: np.ndarray) -> np.ndarray:
    """(n, 4) the shares packed in four bytes, the highest first."""
    return np.stack([_bits(packed, shift, 8) for shift in (24, 16, 8, 0)], axis=1)


def _packed(shares: np.ndarray, shifts: tuple[int, ...], bits: tuple[int, ...]) -> np.ndarray:
    """(n,) uint32 of shares (n, k), 0 to 1."""
    packed = np.zeros(len(shares), np.uint32)
    for k, (shift, width) in enumerate(zip(shifts, bits, strict=True)):
        most = (1 << width) - 1
        values = np.clip(np.floor(shares[:, k] * most + 0.5), 0, most).astype(np.uint32)
        packed |= values << np.uint32(shift)
    return packed


def _packed_thirds(shares: np.ndarray) -> np.ndarray:
    return _packed(shares, (21, 11, 0), (11, 10, 11))


def _unpacked_quaternions(packed: np.ndarray) -> np.ndarray:
    """(n, 4) w x y z: the largest is left out, and found from the others."""
    others = np.stack([_bits(packed, shift, 10) for shift in (20, 10, 0)], axis=1)
    others = (others - 0.5) * np.sqrt(2.0)
    largest = (packed >> np.uint32(30)).astype(int)
    return with_largest(others, largest)


def with_largest(others: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """Unit quaternions (n, 4) float64 from all numbers but the largest (n, 3), in order, and which that is (n,)."""
    quaternions = np.empty((len(others), 4))
    rows = np.arange(len(others))
    for k in range(3):
        quaternions[rows, k + (largest <= k)] = others[:, k]
    quaternions[rows, largest] = np.sqrt(np.maximum(1.0 - (others**2).sum(axis=1), 0.0))
    return quaternions


def without_largest(quaternions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All numbers of quaternions (n, 4) but the largest, which is made positive: (n, 3), and (n,) which that is.
    They may have any length; of length zero means w = 1."""
    unit = unit_quaternions(quaternions)
    largest = np.argmax(np.abs(unit), axis=1)
    rows = np.arange(len(unit))
    unit *= np.where(unit[rows, largest] < 0.0, -1.0, 1.0)[:, None]
    others = np.stack([unit[rows, k + (largest <= k)] for k in range(3)], axis=1)
    return others, largest


def _packed_quaternions(quaternions: np.ndarray) -> np.ndarray:
    others, largest = without_largest(quaternions)
    packed = _packed(others / np.sqrt(2.0) + 0.5, (20, 10, 0), (10, 10, 10))
    return packed | (largest.astype(np.uint32) << np.uint32(30))
