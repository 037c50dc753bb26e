"""The .ply files of 3D Gaussian Splatting: any order of properties, foreign ones and other elements kept."""

from __future__ import annotations

import dataclasses
import pathlib
import re

import numpy as np

from ...core.checks import listed, warn_caller
from ...core.files import read_limited
from ...errors import InputError
from ...mesh.io.ply import Element, ply_header
from .contents import PlyLayout, SplatContents, logits_of, logs_of, opacities_of, rounding_of

#: What a splat needs beside its harmonics.
_NEEDED = (
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)

#: Bytes of memory that a byte of a file takes until its splats are made.
_ROOM = 4

_REST = re.compile(r"f_rest_(\d+)")

_FLOATS = ("f4", "f8")

#: Infinite logits are written so: other programs drop what is not finite, and the opacity in float32 is 0 or 1 as well.
MAX_LOGIT = 80.0

#: What an opacity of 1 may be rounded up by.
_ROUNDED = 1e-5

#: Of one kind alone scales are found where there are so many splats and half the numbers are so near 0, opacities where
#: they spread by more.
_MANY, _NEAR_ZERO, _SPREAD = 100, 0.25, 0.1

#: The property by which Mip-Splatting widens a splat.
_FILTER = "filter_3D"


@dataclasses.dataclass(frozen=True)
class PlyParts:
    """A binary PLY file in parts."""

    header: bytes  # as found
    order: str  # "<" or ">"
    elements: list[Element]  # (name, count, properties) of each
    tables: dict[str, np.ndarray]  # of each element, by name, up to the last that was asked for
    body: bytes  # all that follows the header
    begins: dict[str, int]  # where each of those elements begins in the body; "" where the last of them ends


def read_parts(path: pathlib.Path, wanted: tuple[str, ...]) -> PlyParts:
    """Read the wanted elements of a binary PLY file as tables; those that are not there are left out."""
    data = read_limited(path, "splat file", room=_ROOM)
    order, elements, begin, _ = ply_header(path, data)
    _require_scales(path, elements)
    if order == "ascii":
        raise InputError(f"{path}: splats in PLY files of text are not read: write it as a binary file")
    names = [name for name, _, _ in elements]
    last = max((names.index(name) for name in wanted if name in names), default=-1)
    tables, begins, position = {}, {}, begin
    for name, count, properties in elements[: last + 1]:
        if any(isinstance(kind, tuple) for _, kind in properties):
            raise InputError(f"{path}: element {name!r} before the splats has lists, whose rows have no fixed length")
        fields = [field for field, _ in properties]
        if len(set(fields)) < len(fields) or name in tables:
            raise InputError(f"{path}: element {name!r} or one of its properties is there twice")
        row = np.dtype([(field, order + kind) for field, kind in properties])
        if position + count * row.itemsize > len(data):
            raise InputError(f"{path}: the file ends within its {count} elements {name!r}")
        tables[name] = np.frombuffer(data, row, count, position) if row.itemsize else np.zeros(count, row)
        begins[name] = position - begin
        position += count * row.itemsize
    begins[""] = position - begin
    return PlyParts(data[:begin], order, elements, tables, data[begin:], begins)


def _require_scales(path: pathlib.Path, elements: list[Element]) -> None:
    """Refuse a file of points or of a mesh, which have the same ending."""
    fields = {field for name, _, properties in elements if name == "vertex" for field, _ in properties}
    if {"x", "y", "z"} <= fields and not fields & {"scale_0", "opacity", "rot_0", "f_dc_0"}:
        meant = "a mesh" if any(name == "face" and count for name, count, _ in elements) else "points without scales"
        lacking = listed(name for name in _NEEDED if name not in fields)
        raise InputError(f"{path}: no 3DGS splats: the vertices lack {lacking}: it holds {meant}")


def read_splat_ply(path: pathlib.Path, parts: PlyParts, activated: bool | None = None) -> SplatContents:
    """The splats of a 3DGS .ply file, and what else is in it; path: for messages. activated: whether it has opacities
    and scales instead of logits and logarithms; None finds out, and says so."""
    table = parts.tables.get("vertex")
    if table is None:
        raise InputError(f"{path}: a PLY file of splats has an element 'vertex', got {listed(parts.tables)}")
    names = table.dtype.names or ()
    lacking = [name for name in _NEEDED if name not in names]
    if lacking:
        raise InputError(f"{path}: no 3DGS splats: the vertices lack {listed(lacking)}")
    rest = sorted(int(found[1]) for found in map(_REST.fullmatch, names) if found)
    if rest != list(range(len(rest))) or len(rest) not in (0, 9, 24, 45):
        gap = next((k for k in range(len(rest)) if k not in rest), None)
        without = "" if gap is None else f" without f_rest_{gap}"
        raise InputError(f"{path}: splats have 0, 9, 24 or 45 properties f_rest_0 and on, got {len(rest)}{without}")
    used = (*_NEEDED, *(f"f_rest_{k}" for k in rest), *((_FILTER,) if _FILTER in names else ()))
    odd = [name for name in used if table.dtype[name].str[1:] not in _FLOATS]
    if odd:
        raise InputError(f"{path}: properties {listed(odd)} of splats must be float or double")

    def columns(*fields: str) -> np.ndarray:
        kind = np.float64 if any(table.dtype[field].itemsize == 8 for field in fields) else np.float32
        with np.errstate(over="ignore"):  # found by the check of what is finite
            return np.stack([table[field].astype(kind) for field in fields], axis=1)

    harmonics = np.empty((len(table), 1 + len(rest) // 3, 3), np.float32)
    with np.errstate(over="ignore"):
        harmonics[:, 0] = columns("f_dc_0", "f_dc_1", "f_dc_2")
        for k in rest:
            channel, coefficient = divmod(k, len(rest) // 3)
            harmonics[:, 1 + coefficient, channel] = table[f"f_rest_{k}"]
        log_scales = columns("scale_0", "scale_1", "scale_2").astype(np.float32)
        logits = columns("opacity")[:, 0].astype(np.float32)
    of_scales = of_opacities = bool(activated)
    if activated is None:
        of_scales, of_opacities = _look_activated(log_scales, logits)
        if of_scales or of_opacities:
            seen = ["no opacity leaves 0 to 1"] * of_opacities + ["no scale is below 0"] * of_scales
            usual = ["logits"] * of_opacities + ["logarithms"] * of_scales
            warn_caller(
                f"{path}: {' and '.join(seen)}, so they are taken as they are, not as {' and '.join(usual)}: "
                "activated=False reads them as those"
            )
    if of_scales:
        log_scales = logs_of(log_scales)
    if of_opacities:
        with np.errstate(invalid="ignore"):
            logits = logits_of(np.where(logits <= 1.0 + _ROUNDED, np.minimum(logits, 1.0), np.nan).astype(np.float64))
    header, kept = parts.header, table
    if _FILTER in names:
        log_scales, logits = _filtered(log_scales, logits, table[_FILTER].astype(np.float64))
        header, kept = _without_filter(header), _without_field(table, _FILTER)
    with np.errstate(over="ignore"):
        return SplatContents(
            columns("x", "y", "z"),
            log_scales,
            columns("rot_0", "rot_1", "rot_2", "rot_3").astype(np.float32),
            logits,
            harmonics,
            PlyLayout(header, parts.body[: parts.begins["vertex"]], kept, parts.body[parts.begins[""] :]),
            antialias=_FILTER in names,  # such splats were fitted with the 2D filter of the same paper
        )


def _look_activated(scales: np.ndarray, opacities: np.ndarray) -> tuple[bool, bool]:
    """Whether values are those of scales, and of opacities, not their logarithms and logits: logits leave 0 to 1 in any
    field that was fitted, and logarithms above 0 are of splats larger than a unit of the world."""
    good = np.isfinite(scales).all(axis=1) & np.isfinite(opacities)
    scales, opacities = scales[good], opacities[good]
    if not len(scales):
        return False, False
    of_scales = bool(scales.min() >= 0.0 and scales.max() > 0.0)
    of_opacities = bool(opacities.min() >= 0.0 and 0.0 < opacities.max() <= 1.0 + _ROUNDED)
    if of_scales and of_opacities:
        return True, True
    # one kind alone must be clearer: handmade splats may have logits of 0.5, or be a little larger than a unit
    many = len(scales) >= _MANY
    of_scales &= many and bool(np.median(scales) < _NEAR_ZERO)
    return of_scales, of_opacities and many and bool(np.ptp(opacities) > _SPREAD)


def _filtered(log_scales: np.ndarray, logits: np.ndarray, widths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Logarithms of scales and logits of splats that are widened by the 3D filter of Mip-Splatting, its standard
    deviation (n,) in world units."""
    # Yu et al., "Mip-Splatting: Alias-free 3D Gaussian Splatting" (CVPR 2024), eq. 7: a splat is smoothed, and weakened
    # by the ratio of its volumes
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        logs = log_scales.astype(np.float64)
        wider = 0.5 * np.logaddexp(2.0 * logs, 2.0 * np.log(np.abs(widths))[:, None])
        weaker = logits_of(opacities_of(logits) * np.exp((logs - wider).sum(axis=1)))
        still = widths == 0.0  # which keep their bits
        return (
            np.where(still[:, None], log_scales, wider).astype(np.float32),
            np.where(still, logits, weaker).astype(np.float32),
        )


def _without_filter(header: bytes) -> bytes:
    """A header without the property of Mip-Splatting, whose values hold what it says."""
    lines = header.splitlines(keepends=True)
    return b"".join(line for line in lines if line.split()[:1] != [b"property"] or line.split()[-1] != _FILTER.encode())


def _without_field(table: np.ndarray, left_out: str) -> np.ndarray:
    """A table without one of its fields, its rows packed."""
    names = [name for name in table.dtype.names or () if name != left_out]
    fewer = np.empty(len(table), [(name, table.dtype[name].str) for name in names])
    for name in names:
        fewer[name] = table[name]
    return fewer


def write_splat_ply(contents: SplatContents) -> bytes:
    """A 3DGS .ply file: in the layout that the splats come from, with a row for each of them, or the usual one."""
    layout = contents.layout or usual_layout(contents)
    table = layout.table.copy()
    values = _properties(contents)
    if contents.layout is None:  # others divide by the length, and read zeros as a file that was never filled
        values["rot_0"] = np.where(contents.quaternions.any(axis=1), values["rot_0"], np.float32(1.0))
    for name, new in values.items():  # what did not change keeps its last bit, also in double
        changed = table[name].astype(new.dtype) != new
        table[name][changed] = new[changed]
    return _with_count(layout.header, len(table)) + layout.before + table.tobytes() + layout.after


def usual_layout(contents: SplatContents) -> PlyLayout:
    """The layout that 3DGS's own training writes, its values zero; positions double where float rounds by much."""
    rest = 3 * (contents.harmonics.shape[1] - 1)
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{k}" for k in range(rest)]
    names += ["opacity", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {contents.count}"]
    wide = "xyz" if contents.centers.dtype == np.float64 and rounding_of(contents)[0] else ""
    lines += [f"property {'double' if name in wide else 'float'} {name}" for name in names] + ["end_header", ""]
    table = np.zeros(contents.count, [(name, "<f8" if name in wide else "<f4") for name in names])
    return PlyLayout("\n".join(lines).encode(), b"", table, b"")


def _properties(contents: SplatContents) -> dict[str, np.ndarray]:
    """The values of splats by the names of their properties."""
    rest = contents.harmonics.shape[1] - 1
    values = {name: contents.centers[:, k] for k, name in enumerate("xyz")}
    values |= {f"f_dc_{k}": contents.harmonics[:, 0, k] for k in range(3)}
    values |= {f"f_rest_{c * rest + k}": contents.harmonics[:, 1 + k, c] for c in range(3) for k in range(rest)}
    values |= {"opacity": np.clip(contents.logits, -MAX_LOGIT, MAX_LOGIT)}
    values |= {f"scale_{k}": contents.log_scales[:, k] for k in range(3)}
    return values | {f"rot_{k}": contents.quaternions[:, k] for k in range(4)}


def _with_count(header: bytes, count: int) -> bytes:
    """A header whose element vertex has another count; the same bytes where it has that one."""
    found = re.search(rb"^[ \t]*element[ \t]+vertex[ \t]+(\d+)", header, re.MULTILINE)
    assert found is not None
    if int(found[1]) == count:
        return header
    return header[: found.start(1)] + str(count).encode() + header[found.end(1) :]
