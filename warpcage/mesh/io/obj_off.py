"""OBJ and OFF meshes, line by line."""

from __future__ import annotations

import pathlib
import re
from collections.abc import Iterator, Sequence
from typing import NoReturn

import numpy as np

from ...core.checks import shown
from ...core.files import TEXT_ROOM, read_limited
from ...core.names import counted
from ...errors import InputError

#: (line or name, indices of vertices) of each polygon of a file.
Polygons = list[tuple[int | str, list[int]]]

#: Faces to write: triangles (f, 3), or the corners of each.
FacesToWrite = np.ndarray | Sequence[tuple[int, ...]]

# -- OBJ: `v x y z`, `f a b c` with a, a/t, a//n or a/t/n, counted from 1, or from the end when negative


#: The name of faces that stand before the first `o` line of an OBJ file, and of an `o` without a name.
UNNAMED = "unnamed"


def read_obj(path: pathlib.Path) -> tuple[np.ndarray, Polygons]:
    """Vertices (v, 3) float64, and (line, indices of vertices) of each polygon of an OBJ file."""
    vertices, polygons, _, _ = _parsed_obj(path)
    return vertices, polygons


def obj_object_names(path: pathlib.Path) -> list[str]:
    """The names of the objects of an OBJ file that have faces, in their order; groups are none."""
    # numbers are not looked at, which takes most of the time of a file
    name, found = UNNAMED, {}
    for line in read_limited(path, "cage file", TEXT_ROOM).removeprefix(b"\xef\xbb\xbf").splitlines():
        word = line[:16].split(maxsplit=1)[:1]
        if word == [b"f"]:
            found[name] = None
        elif word == [b"o"]:
            tokens = line.split(b"#", 1)[0].decode("utf-8", errors="replace").split()
            name = " ".join(tokens[1:]) or UNNAMED
    return list(found)


def read_obj_object(path: pathlib.Path, name: str) -> tuple[np.ndarray, Polygons]:
    """One object of an OBJ file as `read_obj` gives the whole: the vertices of its faces, and those that stand among
    its lines and that no other object has, in the order of the file."""
    vertices, polygons, declared, owners = _parsed_obj(path)
    count = len(vertices)
    used: dict[bool, set[int]] = {True: set(), False: set()}
    for (_, polygon), owner in zip(polygons, owners, strict=True):
        used[owner == name].update(polygon)
    kept = [
        k for k, owner in enumerate(declared) if k in used[True] or (owner == name and k not in used[False])
    ]  # some programs write all vertices first, others those of an object before its `o`
    number = {old: new for new, old in enumerate(kept)}
    own = [
        # indices out of range stay: the check reports them with their line
        (line, [number.get(index, index if index < 0 else index + count) for index in polygon])
        for (line, polygon), owner in zip(polygons, owners, strict=True)
        if owner == name
    ]
    return vertices[kept], own


def _parsed_obj(path: pathlib.Path) -> tuple[np.ndarray, Polygons, list[str], list[str]]:
    """Vertices, polygons, and the names of the objects that vertices and polygons stand among the lines of."""
    vertices, polygons, declared, owners, name = [], [], [], [], UNNAMED
    for line, tokens in text_lines(path):
        if tokens[0] == "v":
            vertices.append(point(tokens[1:], path, line))
            declared.append(name)
        elif tokens[0] == "f":
            polygon = []
            for index in whole([word.split("/", 1)[0] for word in tokens[1:]], path, line):
                # a negative index counts back from the vertices read so far
                polygon.append(index - 1 if index > 0 else len(vertices) + index if index < 0 else _zero(path, line))
            polygons.append((line, polygon))
            owners.append(name)
        elif tokens[0] == "o":
            name = " ".join(tokens[1:]) or UNNAMED
    return np.array(vertices, dtype=np.float64).reshape(-1, 3), polygons, declared, owners


def _zero(path: pathlib.Path, line: int) -> NoReturn:
    raise InputError(f"{path}:{line}: OBJ counts vertices from 1, got a face with vertex 0")


def write_obj(vertices: np.ndarray, faces: FacesToWrite) -> bytes:
    """An OBJ file that keeps every bit of the vertices."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines += [f"f {' '.join(str(corner + 1) for corner in face)}" for face in listed_faces(faces)]
    return ("\n".join(["# cage", *lines]) + "\n").encode()


# -- OFF: `OFF`, counts, vertices, then `n i0 .. in-1` for each face


def read_off(path: pathlib.Path) -> tuple[np.ndarray, Polygons]:
    """Vertices (v, 3) float64, and (line, indices of vertices) of each polygon of an OFF file."""
    lines = text_lines(path)
    line, tokens = next(lines, (1, []))
    # with colours, normals and texture coordinates behind the places, in either order (MeshLab: NCOFF)
    if not tokens or not re.fullmatch(r"(ST)?(C?N?|NC)OFF", tokens[0].upper()):
        raise InputError(f"{path}:{line}: an OFF file begins with 'OFF', got {shown(' '.join(tokens[:3]))}")
    tokens = tokens[1:]
    if not tokens:
        line, tokens = next(lines, (line, []))
    counts = whole(tokens[:2], path, line)
    if len(counts) < 2 or min(counts) < 0:
        raise InputError(f"{path}:{line}: the numbers of vertices and faces expected, got {shown(' '.join(tokens))}")

    vertices, polygons = [], []
    for line, tokens in lines:
        if len(vertices) < counts[0]:
            vertices.append(point(tokens, path, line))
        elif len(polygons) < counts[1]:
            size = whole(tokens[:1], path, line)[0]
            if size < 0 or len(tokens) < size + 1:
                raise InputError(f"{path}:{line}: a face of {size} vertices expected, got {shown(' '.join(tokens))}")
            polygons.append((line, whole(tokens[1 : size + 1], path, line)))
    if len(vertices) < counts[0] or len(polygons) < counts[1]:
        raise InputError(
            f"{path}:{line}: {counted(counts[0], 'vertex', 'vertices')} and {counted(counts[1], 'face')} announced, "
            f"{len(vertices)} and {len(polygons)} found"
        )
    return np.array(vertices, dtype=np.float64).reshape(-1, 3), polygons


def write_off(vertices: np.ndarray, faces: FacesToWrite) -> bytes:
    """An OFF file that keeps every bit of the vertices."""
    lines = ["OFF", f"{len(vertices)} {len(faces)} 0"]
    lines += [f"{x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines += [f"{len(face)} {' '.join(map(str, face))}" for face in listed_faces(faces)]
    return ("\n".join(lines) + "\n").encode()


def listed_faces(faces: FacesToWrite) -> Sequence[Sequence[int]]:
    """The corners of each face as plain numbers."""
    return faces.tolist() if isinstance(faces, np.ndarray) else faces


def text_lines(path: pathlib.Path, data: bytes | None = None, first: int = 1) -> Iterator[tuple[int, list[str]]]:
    """Number, from 1, and tokens of each line that holds any, without comments and byte order mark; a backslash joins
    lines. data: the contents from line `first` on; None reads the file."""
    if data is None:
        data = read_limited(path, "cage file", TEXT_ROOM)
    text = data.decode("utf-8-sig", errors="replace")
    held = ""
    for number, line in enumerate(text.splitlines(), start=first):
        line = held + line.split("#", 1)[0].rstrip()
        if line.endswith("\\"):
            held = line[:-1] + " "
            continue
        held = ""
        tokens = line.split()
        if tokens:
            yield number, tokens


def floats(tokens: list[str], path: pathlib.Path, line: int) -> list[float]:
    """Tokens as finite numbers."""
    try:
        values = [float(word) for word in tokens]
    except ValueError:
        raise InputError(f"{path}:{line}: numbers expected, got {shown(' '.join(tokens))}") from None
    if not np.isfinite(values).all():
        raise InputError(f"{path}:{line}: finite numbers expected, got {shown(' '.join(tokens))}")
    return values


def whole(tokens: list[str], path: pathlib.Path, line: int) -> list[int]:
    """Tokens as whole numbers."""
    try:
        return [int(word) for word in tokens]
    except ValueError:
        raise InputError(f"{path}:{line}: whole numbers expected, got {shown(' '.join(tokens))}") from None


def point(tokens: list[str], path: pathlib.Path, line: int) -> list[float]:
    """The first three tokens as finite numbers; colours and the like may follow."""
    if len(tokens) < 3:
        raise InputError(f"{path}:{line}: a vertex needs 3 numbers, got {len(tokens)}")
    return floats(tokens[:3], path, line)
