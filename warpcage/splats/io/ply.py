"""The .ply files of 3D Gaussian Splatting: any order of properties, foreign ones and other elements kept."""

from __future__ import annotations

import dataclasses
import pathlib
import re

import numpy as np

from ...core.checks import listed
from ...core.files import read_limited
from ...mesh.io.ply import Element, ply_header
from .contents import PlyLayout, SplatContents, rounding_of

#: What a splat needs beside its harmonics.
_NEEDED = (
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)

#: Bytes of memory that a byte of a file takes until its splats are made.
_ROOM = 4

_REST = re.compile(r"f_rest_(\d+)")

_FLOATS = ("f4", "f8")


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
        raise ValueError(f"{path}: splats in PLY files of text are not read: write it as a binary file")
    names = [name for name, _, _ in elements]
    last = max((names.index(name) for name in wanted if name in names), default=-1)
    tables, begins, position = {}, {}, begin
    for name, count, properties in elements[: last + 1]:
        if any(isinstance(kind, tuple) for _, kind in properties):
            raise ValueError(f"{path}: element {name!r} before the splats has lists, whose rows cannot be told apart")
        fields = [field for field, _ in properties]
        if len(set(fields)) < len(fields) or name in tables:
            raise ValueError(f"{path}: element {name!r} or one of its properties is there twice")
        row = np.dtype([(field, order + kind) for field, kind in properties])
        if position + count * row.itemsize > len(data):
            raise ValueError(f"{path}: the file ends within its {count} elements {name!r}")
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
        raise ValueError(f"{path}: no 3DGS splats: the vertices lack {lacking}: it holds {meant}")


def read_splat_ply(path: pathlib.Path, parts: PlyParts) -> SplatContents:
    """The splats of a 3DGS .ply file, and what else is in it; path: for messages."""
    table = parts.tables.get("vertex")
    if table is None:
        raise ValueError(f"{path}: a PLY file of splats has an element 'vertex', got {listed(parts.tables)}")
    names = table.dtype.names or ()
    lacking = [name for name in _NEEDED if name not in names]
    if lacking:
        raise ValueError(f"{path}: no 3DGS splats: the vertices lack {listed(lacking)}")
    rest = sorted(int(found[1]) for found in map(_REST.fullmatch, names) if found)
    if rest != list(range(len(rest))) or len(rest) not in (0, 9, 24, 45):
        raise ValueError(f"{path}: splats have 0, 9, 24 or 45 properties f_rest_0 and on, got {len(rest)}")
    used = (*_NEEDED, *(f"f_rest_{k}" for k in rest))
    odd = [name for name in used if table.dtype[name].str[1:] not in _FLOATS]
    if odd:
        raise ValueError(f"{path}: properties {listed(odd)} of splats must be float or double")

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
        return SplatContents(
            columns("x", "y", "z"),
            columns("scale_0", "scale_1", "scale_2").astype(np.float32),
            columns("rot_0", "rot_1", "rot_2", "rot_3").astype(np.float32),
            columns("opacity")[:, 0].astype(np.float32),
            harmonics,
            PlyLayout(parts.header, parts.body[: parts.begins["vertex"]], table, parts.body[parts.begins[""] :]),
        )


def write_splat_ply(contents: SplatContents) -> bytes:
    """A 3DGS .ply file: in the layout that the splats come from, with a row for each of them, or the usual one."""
    layout = contents.layout or usual_layout(contents)
    table = layout.table.copy()
    values = _properties(contents)
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
    values |= {"opacity": contents.logits}
    values |= {f"scale_{k}": contents.log_scales[:, k] for k in range(3)}
    return values | {f"rot_{k}": contents.quaternions[:, k] for k in range(4)}


def _with_count(header: bytes, count: int) -> bytes:
    """A header whose element vertex has another count; the same bytes where it has that one."""
    found = re.search(rb"^[ \t]*element[ \t]+vertex[ \t]+(\d+)", header, re.MULTILINE)
    assert found is not None
    if int(found[1]) == count:
        return header
    return header[: found.start(1)] + str(count).encode() + header[found.end(1) :]
