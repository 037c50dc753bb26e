"""Read and write OBJ, PLY and OFF so that every vertex keeps its place in the file and its last bit.

Own parsers, because mesh libraries merge, split and drop vertices, and a posed cage must
match its rest cage one to one.
"""

from __future__ import annotations

import pathlib

import numpy as np

from .files import atomic_path, require_file

_PLY_TYPES = {"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
              "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
              "double": "f8", "float64": "f8"}  # fmt: skip


def read_mesh(path) -> tuple[pathlib.Path, np.ndarray, np.ndarray]:
    """Path, vertices (v, 3) float64 in the file's order, and triangles (f, 3) int64; polygons are cut into fans.

    Raises FileNotFoundError for a missing file, ValueError (file name and line) for what is no OBJ, PLY or OFF mesh.
    """
    path = require_file(path, "cage file")
    readers = {".obj": _read_obj, ".ply": _read_ply, ".off": _read_off}
    vertices, polygons = readers[_format(path)](path)
    if not len(vertices) or not polygons:
        raise ValueError(f"{path}: no {'faces' if len(vertices) else 'vertices'} in it")
    count = len(vertices)
    triangles = []
    for line, polygon in polygons:
        if len(polygon) < 3:
            raise ValueError(f"{path}:{line}: a face needs at least 3 vertices, got {len(polygon)}")
        for index in polygon:
            if not 0 <= index < count:
                raise ValueError(f"{path}:{line}: face with vertex {index} of 0 to {count - 1}, counted from 0")
        triangles += [(polygon[0], polygon[k], polygon[k + 1]) for k in range(1, len(polygon) - 1)]
    return path, vertices, np.array(triangles, dtype=np.int64)


def write_mesh(path, vertices, faces) -> None:
    """Write vertices (v, 3) and triangles (f, 3) to an OBJ, PLY (binary, double) or OFF file, whole or not at all."""
    writers = {".obj": _write_obj, ".ply": _write_ply, ".off": _write_off}
    writer = writers[_format(pathlib.Path(path))]
    with atomic_path(path) as temporary:
        temporary.write_bytes(writer(np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int32)))


def _format(path: pathlib.Path) -> str:
    ending = path.suffix.lower()
    if ending not in (".obj", ".ply", ".off"):
        raise ValueError(f"cage file {str(path)!r} must end in .obj, .ply or .off")
    return ending


# -- Lines of numbers


def _text_lines(path: pathlib.Path, data: bytes | None = None, first: int = 1):
    """Number and words of each line that holds something, comments left out; a backslash continues a line."""
    text = (path.read_bytes() if data is None else data).decode("utf-8", errors="replace")
    held = ""
    for number, line in enumerate(text.splitlines(), start=first):
        line = held + line.split("#", 1)[0].rstrip()
        if line.endswith("\\"):
            held = line[:-1] + " "
            continue
        held = ""
        words = line.split()
        if words:
            yield number, words


def _floats(words, path, line) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError:
        raise ValueError(f"{path}:{line}: numbers expected, got {' '.join(words)!r}") from None
    if not np.isfinite(values).all():
        raise ValueError(f"{path}:{line}: finite numbers expected, got {' '.join(words)!r}")
    return values


def _whole(words, path, line) -> list[int]:
    try:
        return [int(word) for word in words]
    except ValueError:
        raise ValueError(f"{path}:{line}: whole numbers expected, got {' '.join(words)!r}") from None


def _point(words, path, line) -> list[float]:
    if len(words) < 3:
        raise ValueError(f"{path}:{line}: a vertex needs 3 numbers, got {len(words)}")
    return _floats(words[:3], path, line)


# -- OBJ: `v x y z`, `f a b c` with a, a/t, a//n or a/t/n, counted from 1, or from the end when negative


def _read_obj(path):
    vertices, polygons = [], []
    for line, words in _text_lines(path):
        if words[0] == "v":
            vertices.append(_point(words[1:], path, line))
        elif words[0] == "f":
            polygon = []
            for index in _whole([word.split("/", 1)[0] for word in words[1:]], path, line):
                # a negative index counts back from the vertices read so far
                polygon.append(index - 1 if index > 0 else len(vertices) + index if index < 0 else _zero(path, line))
            polygons.append((line, polygon))
    return np.array(vertices, dtype=np.float64).reshape(-1, 3), polygons


def _zero(path, line):
    raise ValueError(f"{path}:{line}: OBJ counts vertices from 1, got a face with vertex 0")


def _write_obj(vertices, faces) -> bytes:
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces.tolist()]
    return ("\n".join(["# cage", *lines]) + "\n").encode()


# -- OFF: `OFF`, counts, vertices, then `n i0 .. in-1` a face


def _read_off(path):
    lines = _text_lines(path)
    line, words = next(lines, (1, []))
    if not words or not words[0].upper().endswith("OFF") or words[0].upper() not in ("OFF", "COFF", "NOFF", "CNOFF"):
        raise ValueError(f"{path}:{line}: an OFF file begins with 'OFF', got {' '.join(words[:3])!r}")
    words = words[1:]
    if not words:
        line, words = next(lines, (line, []))
    counts = _whole(words[:2], path, line)
    if len(counts) < 2 or min(counts) < 0:
        raise ValueError(f"{path}:{line}: the numbers of vertices and faces expected, got {' '.join(words)!r}")

    vertices, polygons = [], []
    for line, words in lines:
        if len(vertices) < counts[0]:
            vertices.append(_point(words, path, line))
        elif len(polygons) < counts[1]:
            size = _whole(words[:1], path, line)[0]
            if size < 0 or len(words) < size + 1:
                raise ValueError(f"{path}:{line}: a face of {size} vertices expected, got {' '.join(words)!r}")
            polygons.append((line, _whole(words[1 : size + 1], path, line)))
    if len(vertices) < counts[0] or len(polygons) < counts[1]:
        raise ValueError(f"{path}:{line}: {counts[0]} vertices and {counts[1]} faces announced, {len(vertices)} and "
                         f"{len(polygons)} found")
    return np.array(vertices, dtype=np.float64).reshape(-1, 3), polygons


def _write_off(vertices, faces) -> bytes:
    lines = ["OFF", f"{len(vertices)} {len(faces)} 0"]
    lines += [f"{x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines += [f"3 {a} {b} {c}" for a, b, c in faces.tolist()]
    return ("\n".join(lines) + "\n").encode()


# -- PLY: a text header that names elements and their properties, then text or binary rows


def _read_ply(path):
    data = path.read_bytes()
    order, elements, body, body_line = _ply_header(path, data)
    rows = _ply_text_rows if order == "ascii" else _ply_binary_rows
    vertices, polygons = None, []
    for name, properties, values in rows(path, data[body:], elements, order, body_line):
        names = [each[0] for each in properties]
        if name == "vertex":
            if not {"x", "y", "z"} <= set(names):
                raise ValueError(f"{path}: PLY vertices need properties x, y, z, got {', '.join(names) or 'none'}")
            columns = [names.index(axis) for axis in "xyz"]
            vertices = np.array([[row[column] for column in columns] for _, row in values], dtype=np.float64)
            if not np.isfinite(vertices).all():
                number = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
                raise ValueError(f"{path}: PLY vertex {number} is not finite")
        elif name == "face":
            column = next((k for k, each in enumerate(names) if each in ("vertex_indices", "vertex_index")), None)
            if column is None or not isinstance(properties[column][1], tuple):
                found = ", ".join(names) or "none"
                raise ValueError(f"{path}: PLY faces need a list property vertex_indices, got {found}")
            polygons = [(line, [int(index) for index in row[column]]) for line, row in values]
    if vertices is None:
        raise ValueError(f"{path}: no vertices in it")
    return vertices.reshape(-1, 3), polygons


def _ply_header(path, data: bytes):
    """'ascii', '<' or '>'; elements (name, count, properties); where the body begins, and on which line."""
    order, elements, position = None, [], 0
    for line in range(1, data.count(b"\n") + 2):
        end = data.find(b"\n", position)
        words = data[position : len(data) if end < 0 else end].decode("ascii", errors="replace").split()
        position = len(data) if end < 0 else end + 1
        if line == 1 and words != ["ply"]:
            raise ValueError(f"{path}:1: a PLY file begins with 'ply'")
        if words[:1] == ["format"]:
            orders = {"ascii": "ascii", "binary_little_endian": "<", "binary_big_endian": ">"}
            if len(words) < 2 or words[1] not in orders:
                raise ValueError(f"{path}:{line}: unknown PLY format {' '.join(words[1:])!r}")
            order = orders[words[1]]
        elif words[:1] == ["element"]:
            if len(words) != 3 or not words[2].isdigit():
                raise ValueError(f"{path}:{line}: an element needs a name and a count, got {' '.join(words)!r}")
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            listed = words[1:2] == ["list"]
            kinds = [_PLY_TYPES.get(word) for word in (words[2:4] if listed else words[1:2])]
            if len(words) != (5 if listed else 3) or None in kinds or not elements:
                raise ValueError(f"{path}:{line}: cannot read PLY property {' '.join(words)!r}")
            elements[-1][2].append((words[-1], tuple(kinds) if listed else kinds[0]))
        elif words[:1] == ["end_header"]:
            if order is None:
                raise ValueError(f"{path}:{line}: the PLY header names no format")
            return order, elements, position, line + 1
    raise ValueError(f"{path}: the PLY header has no end_header")


def _ply_text_rows(path, body, elements, order, first_line):
    lines = _text_lines(path, body, first_line)
    for name, count, properties in elements:
        rows = []
        for _ in range(count):
            line, words = next(lines, (None, None))
            if words is None:
                raise ValueError(f"{path}: {count} PLY elements {name!r} announced, {len(rows)} found")
            row, position = [], 0
            for _, kind in properties:
                size = _whole(words[position : position + 1], path, line) if isinstance(kind, tuple) else None
                position += size is not None
                taken = 1 if size is None else (size or [0])[0]
                values = _floats(words[position : position + taken], path, line)
                if len(values) < taken or size == []:
                    raise ValueError(f"{path}:{line}: too few numbers for a PLY {name}")
                position += taken
                row.append(values[0] if size is None else values)
            rows.append((line, row))
        yield name, properties, rows


def _ply_binary_rows(path, body, elements, order, first_line):
    position = 0
    for name, count, properties in elements:
        kinds = [kind for _, kind in properties]
        if not any(isinstance(kind, tuple) for kind in kinds):
            row_type = np.dtype([(f"p{k}", order + kind) for k, kind in enumerate(kinds)])
            if position + count * row_type.itemsize > len(body):
                raise ValueError(f"{path}: the PLY file ends within its {count} elements {name!r}")
            table = np.frombuffer(body, row_type, count, position)
            position += count * row_type.itemsize
            yield name, properties, [(k, row) for k, row in enumerate(table.tolist())]
            continue
        rows = []
        for number in range(count):
            row = []
            try:
                for kind in kinds:
                    taken = 1
                    if isinstance(kind, tuple):
                        taken = int(np.frombuffer(body, order + kind[0], 1, position)[0])
                        position += np.dtype(kind[0]).itemsize
                    value_type = np.dtype(order + (kind[1] if isinstance(kind, tuple) else kind))
                    values = np.frombuffer(body, value_type, taken, position) if taken > 0 else np.zeros(0)
                    position += taken * value_type.itemsize
                    row.append(values.tolist() if isinstance(kind, tuple) else values[0])
            except ValueError:
                raise ValueError(f"{path}: the PLY file ends within element {number} of {count} {name!r}") from None
            rows.append((f"face {number}", row))
        yield name, properties, rows


def _write_ply(vertices, faces) -> bytes:
    header = ("ply\nformat binary_little_endian 1.0\ncomment cage\n"
              f"element vertex {len(vertices)}\nproperty double x\nproperty double y\nproperty double z\n"
              f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n")
    rows = np.zeros(len(faces), dtype=[("count", "u1"), ("indices", "<i4", 3)])
    rows["count"], rows["indices"] = 3, faces
    return header.encode() + vertices.astype("<f8").tobytes() + rows.tobytes()
