"""PLY: a text header that names elements and their properties, then text or binary rows."""

from __future__ import annotations

import pathlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from ...core.checks import listed, shown
from ...core.files import TEXT_ROOM, read_limited
from ...core.memory import require_host_memory
from ...errors import InputError
from ..faces import joined_rows
from .obj_off import FacesToWrite, floats, text_lines, whole

_PLY_TYPES = {"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
              "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
              "double": "f8", "float64": "f8"}  # fmt: skip

#: An element of the header: name, count, and the name and type of each property; a list has two types.
Element = tuple[str, int, list[tuple[str, Any]]]

#: What the body holds of an element: name, properties, and (line or name, values) of each row; a table with a field
#: for each property where rows are binary and alike.
Rows = tuple[str, list[tuple[str, Any]], Any]

#: Bytes of memory that a property of a row takes where it has lists, and each byte in them.
PROPERTY_BYTES, LIST_ROOM = 300, 40


def read_ply(path: pathlib.Path, *, joined: bool = True) -> tuple[np.ndarray, list[tuple[int | str, list[int]]]]:
    """Vertices (v, 3) float64, and (line or name, indices of vertices) of each polygon of a PLY file.
    joined: those that a seam splits are one."""
    vertices, polygons, _ = _read(path, joined=joined)
    return vertices, polygons


#: Properties of a vertex that are its colour, and what is white in those of whole numbers.
CHANNELS, WHITE = ("red", "green", "blue"), {"u1": 255.0, "u2": 65535.0}


def read_ply_points(path: pathlib.Path, channels: tuple[str, ...] = CHANNELS) -> tuple[np.ndarray, np.ndarray | None]:
    """Vertices (v, 3) float64 of a PLY file and their colours (v, channels) float32 in [0, 1], or None."""
    vertices, _, colors = _read(path, channels, joined=False)
    return vertices, colors


def read_ply_faces(path: pathlib.Path, channels: tuple[str, ...]) -> tuple[np.ndarray, list, np.ndarray | None]:
    """Vertices and polygons of a PLY file, as of `read_ply`, and colours (f, channels) of the polygons, or None."""
    return _read(path, channels, "face", joined=False)


def _read(
    path: pathlib.Path, channels: tuple[str, ...] = (), colored: str = "vertex", *, joined: bool
) -> tuple[np.ndarray, list, np.ndarray | None]:
    """Vertices, polygons, and where channels are asked for and there, colours of the vertices or of each "face"."""
    data = read_limited(path, "PLY file")
    order, elements, body, body_line = ply_header(path, data)
    if order == "ascii":
        require_host_memory(TEXT_ROOM * len(data), f"{path}: its {len(data)} bytes of text need")
    rows = _ply_text_rows if order == "ascii" else _ply_binary_rows
    vertices, polygons, colors, seams = None, [], None, None
    for name, properties, values in rows(path, data[body:], elements, order, body_line):
        names = [each[0] for each in properties]
        if name == "vertex":
            if "packed_position" in names or {"f_dc_0", "rot_0"} <= set(names):
                raise InputError(f"{path} holds splats, without faces, no mesh and no cage")
            if not {"x", "y", "z"} <= set(names):
                raise InputError(f"{path}: PLY vertices need properties x, y, z, got {listed(names)}")
            vertices = _columns(values, [names.index(axis) for axis in "xyz"])
            seams = _seams(properties, values) if joined else None
            if not np.isfinite(vertices).all():
                number = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
                raise InputError(f"{path}: PLY vertex {number} is not finite")
        elif name == "face":
            column = next((k for k, each in enumerate(names) if each in ("vertex_indices", "vertex_index")), None)
            if column is None or isinstance(values, np.ndarray) or not isinstance(properties[column][1], tuple):
                raise InputError(f"{path}: PLY faces need a list property vertex_indices, got {listed(names)}")
            polygons = [(line, _whole_numbers(row[column], path, line)) for line, row in values]
        if name == colored and channels and set(channels) <= set(names):
            colors = _element_colors(path, channels, name, properties, values)
    if vertices is None:
        raise InputError(f"{path}: no vertices in it")
    if seams is not None:
        kept, number = seams
        count = len(vertices)
        polygons = [(line, [int(number[k]) if 0 <= k < count else k for k in polygon]) for line, polygon in polygons]
        vertices = vertices[kept]
    return vertices, polygons, colors


def _whole_numbers(indices: list[float], path: pathlib.Path, line: int | str) -> list[int]:
    """The indices of a face, which text and lists of floats may have with a point."""
    try:
        found = [int(index) for index in indices]
    except (OverflowError, ValueError):  # of what is not finite
        found = []
    if found != indices:
        raise InputError(f"{path}:{line}: a face needs whole numbers, got {listed(indices, 4)}")
    return found


#: Properties of a vertex by which programs split it, along seams and at sharp edges: texture coordinates and normals.
SEAM_NAMES = frozenset("s t u v texture_s texture_t texture_u texture_v nx ny nz".split())


def _seams(properties: list[tuple[str, Any]], values: Any) -> tuple[np.ndarray, np.ndarray] | None:
    """Which vertices stay (u,), in their order, and the new number of each (v,), where those at one place that differ
    in nothing but texture coordinates and normals are one; None where there is nothing to join."""
    names = [name for name, _ in properties]
    if not SEAM_NAMES & set(names):
        return None
    alike = [k for k, (name, kind) in enumerate(properties) if name not in SEAM_NAMES and not isinstance(kind, tuple)]
    kept, number = joined_rows(_columns(values, alike))
    return None if len(kept) == len(number) else (kept, number)


def _columns(values: Any, columns: list[int]) -> np.ndarray:
    """(rows, columns) float64 of some properties of an element."""
    if isinstance(values, np.ndarray):
        return np.stack([values[f"p{column}"].astype(np.float64) for column in columns], axis=1)
    return np.array([[row[column] for column in columns] for _, row in values], np.float64).reshape(-1, len(columns))


def _element_colors(
    path: pathlib.Path, channels: tuple[str, ...], element: str, properties: list[tuple[str, Any]], values: Any
) -> np.ndarray:
    """(rows, channels) float32 in [0, 1], of properties of any type; numbers with a point reach to 1, or to 255."""
    kinds = dict(properties)
    if any(isinstance(kinds[name], tuple) for name in channels):
        raise InputError(f"{path}: PLY colours must be numbers, not lists")
    names = [each[0] for each in properties]
    colors = _columns(values, [names.index(name) for name in channels])
    whites = [WHITE.get(kinds[name]) for name in channels]
    if None in whites:  # other types say nothing, their values do
        whites = [1.0 if colors.max(initial=0.0) <= 1.0 and kinds["red"][0] == "f" else 255.0] * len(channels)
    colors = colors / whites
    if not (colors.min(initial=0.0) >= 0.0 and colors.max(initial=0.0) <= 1.0):  # false for NaN too
        wrong = int(np.flatnonzero(~((colors >= 0.0) & (colors <= 1.0)).all(axis=1))[0])
        raise InputError(
            f"{path}: the colour of PLY {element} {wrong} is not a colour: {(colors[wrong] * whites).tolist()}"
        )
    return colors.astype(np.float32)


def ply_header(path: pathlib.Path, data: bytes) -> tuple[str, list[Element], int, int]:
    """'ascii', '<' or '>'; elements (name, count, properties); where the body begins, and on which line."""
    order, elements, position = None, [], 0
    for line in range(1, data.count(b"\n") + 2):
        end = data.find(b"\n", position)
        tokens = data[position : len(data) if end < 0 else end].decode("ascii", errors="replace").split()
        position = len(data) if end < 0 else end + 1
        if line == 1 and tokens != ["ply"]:
            raise InputError(f"{path}:1: a PLY file begins with 'ply'")
        if tokens[:1] == ["format"]:
            orders = {"ascii": "ascii", "binary_little_endian": "<", "binary_big_endian": ">"}
            if len(tokens) < 2 or tokens[1] not in orders:
                raise InputError(f"{path}:{line}: unknown PLY format {shown(' '.join(tokens[1:]))}")
            order = orders[tokens[1]]
        elif tokens[:1] == ["element"]:
            if len(tokens) != 3 or not tokens[2].isdigit() or len(tokens[2]) > 18:
                raise InputError(f"{path}:{line}: an element needs a name and a count, got {shown(' '.join(tokens))}")
            elements.append((tokens[1], int(tokens[2]), []))
        elif tokens[:1] == ["property"]:
            listed = tokens[1:2] == ["list"]
            kinds = [_PLY_TYPES.get(word) for word in (tokens[2:4] if listed else tokens[1:2])]
            if len(tokens) != (5 if listed else 3) or None in kinds or not elements:
                raise InputError(f"{path}:{line}: cannot read PLY property {shown(' '.join(tokens))}")
            elements[-1][2].append((tokens[-1], tuple(kinds) if listed else kinds[0]))
        elif tokens[:1] == ["end_header"]:
            if order is None:
                raise InputError(f"{path}:{line}: the PLY header names no format")
            return order, elements, position, line + 1
    raise InputError(f"{path}: the PLY header has no end_header")


def _ply_text_rows(
    path: pathlib.Path, body: bytes, elements: list[Element], order: str, first_line: int
) -> Iterator[Rows]:
    lines = text_lines(path, body, first_line)
    for name, count, properties in elements:
        rows = []
        for _ in range(count):
            found = next(lines, None)
            if found is None:
                raise InputError(f"{path}: {count} PLY elements {name!r} announced, {len(rows)} found")
            (line, tokens), row, position = found, [], 0
            for _, kind in properties:
                size = whole(tokens[position : position + 1], path, line) if isinstance(kind, tuple) else None
                position += size is not None
                taken = 1 if size is None else (size or [0])[0]
                values = floats(tokens[position : position + taken], path, line)
                if len(values) < taken or size == []:
                    raise InputError(f"{path}:{line}: too few numbers for a PLY {name}")
                position += taken
                row.append(values[0] if size is None else values)
            rows.append((line, row))
        yield name, properties, rows


def _ply_binary_rows(
    path: pathlib.Path, body: bytes, elements: list[Element], order: str, first_line: int
) -> Iterator[Rows]:
    position = 0
    for name, count, properties in elements:
        kinds = [kind for _, kind in properties]
        if kinds and not any(isinstance(kind, tuple) for kind in kinds):
            row_type = np.dtype([(f"p{k}", order + kind) for k, kind in enumerate(kinds)])
            if position + count * row_type.itemsize > len(body):
                raise InputError(f"{path}: the PLY file ends within its {count} elements {name!r}")
            table = np.frombuffer(body, row_type, count, position)
            position += count * row_type.itemsize
            yield name, properties, table
            continue
        rows, room = [], len(body) - position
        if count * max(1, len(kinds)) > room:  # a property has at least a byte
            raise InputError(f"{path}: the PLY file ends within its {count} elements {name!r}")
        need = PROPERTY_BYTES * count * (1 + len(kinds)) + LIST_ROOM * room
        require_host_memory(need, f"{path}: its {count} elements {name!r} need")
        for number in range(count):
            row = []
            try:
                for kind in kinds:
                    taken = 1
                    if isinstance(kind, tuple):
                        taken = int(np.frombuffer(body, order + kind[0], 1, position)[0])
                        position += np.dtype(kind[0]).itemsize
                        if taken < 0:
                            raise InputError("a list of less than nothing")
                    value_type = np.dtype(order + (kind[1] if isinstance(kind, tuple) else kind))
                    values = np.frombuffer(body, value_type, taken, position) if taken > 0 else np.zeros(0)
                    position += taken * value_type.itemsize
                    row.append(values.tolist() if isinstance(kind, tuple) else values[0])
            except ValueError:
                raise InputError(f"{path}: the PLY file ends within element {number} of {count} {name!r}") from None
            rows.append((f"face {number}", row))
        yield name, properties, rows


def write_ply(
    vertices: np.ndarray, faces: FacesToWrite, colors: np.ndarray | None = None, *, comment: str = "cage"
) -> bytes:
    """A binary PLY file with vertices (v, 3) in float64, and colours (v, 3) uint8 where they are given."""
    most = 3 if isinstance(faces, np.ndarray) else max(map(len, faces))
    channels = "" if colors is None else "".join(f"property uchar {name}\n" for name in CHANNELS)
    header = (
        f"ply\nformat binary_little_endian 1.0\ncomment {comment}\n"
        f"element vertex {len(vertices)}\nproperty double x\nproperty double y\nproperty double z\n{channels}"
        f"element face {len(faces)}\nproperty list {'uchar' if most < 256 else 'int'} int vertex_indices\nend_header\n"
    )
    count = "u1" if most < 256 else "<i4"
    if isinstance(faces, np.ndarray):
        rows = np.zeros(len(faces), dtype=[("count", count), ("indices", "<i4", 3)])
        rows["count"], rows["indices"] = 3, faces
        body = rows.tobytes()
    else:
        body = b"".join(np.array(len(face), count).tobytes() + np.array(face, "<i4").tobytes() for face in faces)
    points = np.zeros(len(vertices), [("place", "<f8", 3), ("color", "u1", 0 if colors is None else 3)])
    points["place"] = vertices
    if colors is not None:
        points["color"] = colors
    return header.encode() + points.tobytes() + body
