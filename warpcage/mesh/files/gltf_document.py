"""glTF documents (.glb, .gltf): their text, buffers, numbers and nodes."""

from __future__ import annotations

import base64
import contextlib
import json
import pathlib
import struct
import urllib.parse
from collections.abc import Iterator, Mapping

import numpy as np

from ...core.checks import shown
from ...core.files import JSON_ROOM, read_limited
from ...core.memory import require_host_memory

#: Kinds of the chunks of a .glb file.
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942

_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}

#: What moves a node.
_PLACES = {"matrix", "rotation", "scale", "translation"}


@contextlib.contextmanager
def one_line(path: pathlib.Path) -> Iterator[None]:
    """What goes wrong with the content of a file, as a ValueError that names the file."""
    try:
        yield
    except (
        KeyError,
        IndexError,
        TypeError,
        AttributeError,
        struct.error,
        UnicodeDecodeError,
        RecursionError,
        OverflowError,
        json.JSONDecodeError,
    ) as error:
        raise ValueError(f"{path}: not a glTF file that can be read: {type(error).__name__} {error}") from None
    except ValueError as error:
        raise ValueError(str(error) if str(path) in str(error) else f"{path}: {error}") from None


def opened(path: pathlib.Path) -> tuple[dict, bytes | None]:
    """The JSON document of a file, and the binary chunk of a .glb file."""
    data = read_limited(path, "glTF file")
    if data[:4] != b"glTF":
        require_host_memory(JSON_ROOM * len(data), f"its {len(data)} bytes of JSON need")
        return json.loads(data.decode("utf-8")), None
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2 or length > len(data):
        raise ValueError(f"glTF version 2 of {length} bytes expected, got version {version} and {len(data)} bytes")
    chunks, position = {}, 12
    while position + 8 <= length:
        size, kind = struct.unpack_from("<II", data, position)
        chunks.setdefault(kind, data[position + 8 : position + 8 + size])
        position += 8 + size
    require_host_memory(JSON_ROOM * len(chunks[JSON_CHUNK]), f"its {len(chunks[JSON_CHUNK])} bytes of JSON need")
    return json.loads(chunks[JSON_CHUNK].decode("utf-8")), chunks.get(BINARY_CHUNK)


def read_buffers(path: pathlib.Path, document: dict, chunk: bytes | None) -> list[bytes]:
    """The buffers of a file; one that several entries name is read once."""
    files: dict[str, bytes] = {}
    found = []
    for entry in document.get("buffers", []):
        uri = entry.get("uri")
        if uri is None:
            data = chunk or b""
        elif uri.startswith("data:"):
            data = base64.b64decode(uri.split(",", 1)[1])
        else:
            data = files[uri] = files[uri] if uri in files else _buffer_file(path, uri)
        if len(data) < entry["byteLength"]:
            raise ValueError(f"a buffer of {entry['byteLength']} bytes expected, got {len(data)}")
        found.append(data)
    return found


def _buffer_file(path: pathlib.Path, uri: str) -> bytes:
    """The contents of a file that a buffer names: one in the folder of the glTF file, by its real path."""
    name = urllib.parse.unquote(uri)
    file = path.parent / name
    folders = (path.parent.resolve(), path.resolve().parent)
    leads_out = pathlib.PurePath(name).is_absolute() or ".." in pathlib.PurePath(name).parts
    if leads_out or not any(file.resolve().is_relative_to(folder) for folder in folders):
        raise ValueError(f"its buffer {shown(uri)} leads out of the folder of the file")
    if not file.is_file():
        raise ValueError(f"its buffer {shown(uri)} is not there")
    return read_limited(file, "buffer")


def node_matrices(document: dict, moved: Mapping[int, dict] | None = None) -> dict[int, np.ndarray]:
    """World matrices (4, 4) float64 of the nodes of the scene by their numbers, depth first.
    moved: places (translation, rotation, scale) that take the place of a node's own, by its number."""
    nodes = document.get("nodes", [])
    scenes = document.get("scenes")
    roots = scenes[document.get("scene", 0)].get("nodes", []) if scenes else range(len(nodes))
    found: dict[int, np.ndarray] = {}
    stack = [(root, np.eye(4)) for root in reversed(roots)]
    while stack:
        index, parent = stack.pop()
        if index in found:
            raise ValueError(f"its node {index} has two parents, or is its own")
        node = nodes[index] | (moved or {}).get(index, {})
        found[index] = parent @ local_matrix(node) if _PLACES & node.keys() else parent
        stack += [(child, found[index]) for child in reversed(node.get("children", []))]
    return found


def mesh_nodes(document: dict) -> list[tuple[int, np.ndarray]]:
    """Number of the mesh and world matrix (4, 4) of each node of the scene that has a mesh, depth first."""
    nodes = document.get("nodes", [])
    matrices = node_matrices(document).items()
    return [(nodes[index]["mesh"], matrix) for index, matrix in matrices if "mesh" in nodes[index]]


def local_matrix(node: dict) -> np.ndarray:
    """The matrix (4, 4) of a node's own place."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    ) * np.asarray(node.get("scale", (1.0, 1.0, 1.0)), dtype=np.float64)
    matrix[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return matrix


def values_of(document: dict, buffers: list[bytes], index: int, *, empty: int | None = None) -> np.ndarray:
    """The numbers (count, width) of an accessor, in the type of the file.
    empty: how many it must have where the file holds none, zeros but for sparse ones; None refuses such an accessor."""
    accessor = document["accessors"][index]
    kind, width, count = np.dtype(_COMPONENTS[accessor["componentType"]]), _WIDTHS[accessor["type"]], accessor["count"]
    if "bufferView" in accessor:
        values = _viewed(document, buffers, accessor, kind, width, count, f"accessor {index}")
    elif empty == count:
        values = np.zeros((count, width), kind)
    else:
        raise ValueError(f"accessor {index} holds no plain values, at most sparse ones, which cannot be read here")
    if "sparse" in accessor:
        sparse = accessor["sparse"]
        places, changed = sparse["indices"], sparse["values"]
        number = np.dtype(_COMPONENTS[places["componentType"]])
        what = f"the sparse part of accessor {index}"
        rows = _viewed(document, buffers, places, number, 1, sparse["count"], what).reshape(-1).astype(np.int64)
        if len(rows) and not 0 <= rows.min() <= rows.max() < count:
            raise ValueError(f"{what} has indices {rows.min()} to {rows.max()} for {count} values")
        values[rows] = _viewed(document, buffers, changed, kind, width, sparse["count"], what)
    return values


def _viewed(
    document: dict, buffers: list[bytes], place: dict, kind: np.dtype, width: int, count: int, what: str
) -> np.ndarray:
    """(count, width) numbers of a part of a buffer."""
    view = document["bufferViews"][place["bufferView"]]
    start, item = view.get("byteOffset", 0) + place.get("byteOffset", 0), kind.itemsize * width
    stride = view.get("byteStride", item)
    data = buffers[view["buffer"]]
    if stride < item or count < 0 or start < 0:
        raise ValueError(f"{what} has a stride of {stride} bytes, {count} values and begins at {start}")
    if count and start + (count - 1) * stride + item > len(data):
        raise ValueError(f"{what} reads beyond its buffer of {len(data)} bytes")
    if not count:
        return np.zeros((0, width), kind)
    return np.ndarray((count, width), kind, data, start, (stride, kind.itemsize)).copy()
