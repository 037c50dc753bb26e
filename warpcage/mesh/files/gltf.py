"""glTF 2.0 (.glb, .gltf): the triangles of all meshes of the scene, at the places of their nodes."""

from __future__ import annotations

import base64
import json
import pathlib
import struct

import numpy as np

from ...core.memory import require_host_memory
from .gltf_document import BINARY_CHUNK, JSON_CHUNK, mesh_nodes, one_line, opened, read_buffers, values_of

_TRIANGLES = 4

#: Most triangles of all nodes together: a thousand times what a large cage has.
MAX_TRIANGLES = 10_000_000

#: Bytes of memory that a vertex and a triangle take while they are read, split vertices joined again.
VERTEX_BYTES, TRIANGLE_BYTES = 200, 150


def read_gltf(path: pathlib.Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) float64, y up as in the file, and triangles (t, 3) int64 of a glTF file."""
    with one_line(path):
        document, chunk = opened(path)
        nodes = mesh_nodes(document)
        # nodes may share a mesh, so that a few bytes stand for a triangle each time: what they come to is counted first
        _require_room(document, nodes)
        buffers = read_buffers(path, document, chunk)
        meshes: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        vertices, triangles, count = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], 0
        for mesh, matrix in nodes:
            if mesh not in meshes:
                meshes[mesh] = _mesh(document, buffers, document["meshes"][mesh])
            points, faces = meshes[mesh]
            vertices.append(points @ matrix[:3, :3].T + matrix[:3, 3])
            # a mirrored node: its faces are turned, so that they look the same way
            triangles.append((faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0.0 else faces) + count)
            count += len(points)
    joined = np.concatenate(vertices)
    if not np.isfinite(joined).all():
        raise ValueError(f"{path}: glTF vertex {np.flatnonzero(~np.isfinite(joined).all(axis=1))[0]} is not finite")
    return joined, np.concatenate(triangles)


def require_gltf_room(path: pathlib.Path) -> None:
    """Refuse a glTF file whose nodes come to too many triangles, before another library reads it."""
    with one_line(path):
        document, _ = opened(path)
        _require_room(document, mesh_nodes(document))


def _require_room(document: dict, nodes: list[tuple[int, np.ndarray]]) -> None:
    """Refuse more triangles than a mesh may have, or than there is memory for, before the first is read."""
    counts = {mesh: _counts(document, document["meshes"][mesh]) for mesh in {mesh for mesh, _ in nodes}}
    vertices, triangles = (sum(counts[mesh][k] for mesh, _ in nodes) for k in range(2))
    what = f"its {len(nodes)} nodes with meshes come to {triangles} triangles and {vertices} vertices"
    if triangles > MAX_TRIANGLES or vertices > 3 * MAX_TRIANGLES:
        raise ValueError(f"{what}: at most {MAX_TRIANGLES} triangles are read")
    require_host_memory(VERTEX_BYTES * vertices + TRIANGLE_BYTES * triangles, f"{what}, which need")


def _counts(document: dict, mesh: dict) -> tuple[int, int]:
    """Vertices and triangles that a mesh claims to have."""
    accessors = document["accessors"]
    drawn = [each for each in mesh["primitives"] if each.get("mode", _TRIANGLES) == _TRIANGLES]
    positions = [each["attributes"]["POSITION"] for each in drawn]
    corners = [accessors[each.get("indices", each["attributes"]["POSITION"])]["count"] for each in drawn]
    return sum(accessors[index]["count"] for index in set(positions)), sum(corners) // 3


def _mesh(document: dict, buffers: list[bytes], mesh: dict) -> tuple[np.ndarray, np.ndarray]:
    """Positions (v, 3) float64 and triangles (f, 3) of all primitives, split vertices joined."""
    positions, faces, _, split = mesh_parts(document, buffers, mesh)
    # a mesh of positions alone is taken as it is
    if not split:
        return positions, faces
    first, number = joined_vertices(positions)
    return positions[first], number[faces]


def mesh_parts(document: dict, buffers: list[bytes], mesh: dict) -> tuple[np.ndarray, np.ndarray, list[dict], bool]:
    """Positions (v, 3) float64 and triangles (f, 3) int64 of a mesh, a primitive for each range of positions, in their
    order, and whether vertices may be split."""
    positions, faces, starts, owners, split = [], [], {}, [], len(mesh["primitives"]) > 1
    for primitive in mesh["primitives"]:
        if primitive.get("mode", _TRIANGLES) != _TRIANGLES:
            continue  # points and lines: loose vertices and edges of the exporting program
        if "KHR_draco_mesh_compression" in primitive.get("extensions", {}):
            raise ValueError("it is compressed (Draco): export it without compression")
        accessor = primitive["attributes"]["POSITION"]
        split |= len(primitive["attributes"]) > 1
        # primitives may share their vertices
        if accessor not in starts:
            starts[accessor] = sum(map(len, positions))
            positions.append(values_of(document, buffers, accessor).astype(np.float64).reshape(-1, 3))
            owners.append(primitive)
        count = document["accessors"][accessor]["count"]
        indices = (
            values_of(document, buffers, primitive["indices"]).reshape(-1).astype(np.int64)
            if "indices" in primitive
            else np.arange(count)
        )
        if len(indices) % 3 or (len(indices) and (indices.max() >= count or indices.min() < 0)):
            raise ValueError(f"a mesh of {count} vertices has {len(indices)} indices up to {indices.max(initial=0)}")
        faces.append(indices.reshape(-1, 3) + starts[accessor])
    if not positions:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), [], False
    return np.concatenate(positions), np.concatenate(faces), owners, split


def joined_vertices(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) at exactly the same place made one, in the order of the first at each place.
    Returns (u,) the vertices that stay, and (v,) the new number of each vertex."""
    # Exporters split a vertex wherever its normal, texture coordinate or material changes.
    _, first, place = np.unique(positions + 0.0, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.arange(len(order))
    return first[order], number[place.reshape(-1)]


# -- Writing


def write_glb(
    vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray | None = None, *, name: str = "cage"
) -> bytes:
    """A .glb file of one mesh, vertices (v, 3) with y up; colors: (v, 3) in [0, 1], sRGB, shown without light."""
    # the node holds the middle, so that float32 keeps the digits
    document, body = _document(vertices, faces)
    document["nodes"][0]["name"] = name
    if colors is not None:
        body += _add_colors(document, colors, len(body))
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + len(body)
    return (
        struct.pack("<4sII", b"glTF", 2, size)
        + struct.pack("<II", len(text), JSON_CHUNK)
        + text
        + struct.pack("<II", len(body), BINARY_CHUNK)
        + body
    )


def write_gltf(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """The same as a .gltf file, without colours: text with the buffer in it."""
    document, body = _document(vertices, faces)
    document["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(body).decode()
    return (json.dumps(document, indent=1) + "\n").encode()


def _add_colors(document: dict, colors: np.ndarray, offset: int) -> bytes:
    """Give the mesh of a document vertex colours, whose bytes follow its buffer. glTF has them in linear light."""
    srgb = np.clip(np.asarray(colors, np.float64), 0.0, 1.0)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    rows = np.ones((len(linear), 4))  # four, as rows must be whole words
    rows[:, :3] = linear
    body = np.round(rows * 65535.0).astype("<u2").tobytes()
    document["bufferViews"].append({"buffer": 0, "byteOffset": offset, "byteLength": len(body), "target": 34962})
    document["accessors"].append(
        {"bufferView": 2, "componentType": 5123, "normalized": True, "type": "VEC4", "count": len(linear)}
    )
    primitive = document["meshes"][0]["primitives"][0]
    primitive["attributes"]["COLOR_0"], primitive["material"] = 2, 0
    unlit = "KHR_materials_unlit"  # the light is in the colours
    document["materials"] = [{"name": "captured", "extensions": {unlit: {}}, "doubleSided": True}]
    document["extensionsUsed"] = [unlit]
    document["buffers"][0]["byteLength"] += len(body)
    return body


def _document(vertices: np.ndarray, faces: np.ndarray) -> tuple[dict, bytes]:
    """The JSON document and the buffer that it describes."""
    # a whole multiple of a coarse step: exact in float32 too, for programs that keep transforms in it
    size = float(np.ptp(vertices, axis=0).max()) or 1.0
    step = 2.0 ** np.ceil(np.log2(size))
    middle = np.round((vertices.min(axis=0) + vertices.max(axis=0)) / 2.0 / step) * step
    points = (vertices - middle).astype("<f4")
    body = points.tobytes() + faces.astype("<u4").tobytes()
    node = {"mesh": 0, "name": "cage"} | ({"translation": middle.tolist()} if middle.any() else {})
    accessors = [
        {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": len(points),
         "min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()},
        {"bufferView": 1, "componentType": 5125, "type": "SCALAR", "count": int(faces.size)},
    ]  # fmt: skip
    document = {
        "asset": {"version": "2.0", "generator": "warpcage"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [node],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "mode": _TRIANGLES}]}],
        "accessors": accessors,
        "bufferViews": [{"buffer": 0, "byteOffset": 0, "byteLength": points.nbytes, "target": 34962},
                        {"buffer": 0, "byteOffset": points.nbytes, "byteLength": 4 * faces.size, "target": 34963}],
        "buffers": [{"byteLength": len(body)}],
    }  # fmt: skip
    return document, body
