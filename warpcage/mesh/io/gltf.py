"""glTF 2.0 (.glb, .gltf): documents, buffers and nodes; the triangles of all meshes of the scene, at their places."""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import json
import os
import pathlib
import struct
import urllib.parse
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, TypedDict

import numpy as np

from ...core.checks import shown
from ...core.files import JSON_ROOM, read_limited
from ...core.memory import require_host_memory
from ...errors import InputError

if TYPE_CHECKING:
    from typing_extensions import Unpack  # of the type checker

#: Kinds of the chunks of a .glb file.
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942

_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}

_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}

#: What moves a node.
_PLACES = {"matrix", "rotation", "scale", "translation"}


@contextlib.contextmanager
def errors_of_file(path: pathlib.Path) -> Iterator[None]:
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
        raise InputError(f"{path}: not a glTF file that can be read: {type(error).__name__} {error}") from None
    except ValueError as error:
        raise InputError(str(error) if str(path) in str(error) else f"{path}: {error}") from None


def opened(path: pathlib.Path) -> tuple[dict, bytes | None]:
    """The JSON document of a file, and the binary chunk of a .glb file."""
    data = read_limited(path, "glTF file")
    if data[:4] != b"glTF":
        require_host_memory(JSON_ROOM * len(data), f"its {len(data)} bytes of JSON need")
        return json.loads(data.decode("utf-8")), None
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2 or length > len(data):
        raise InputError(f"glTF version 2 of {length} bytes expected, got version {version} and {len(data)} bytes")
    chunks, position = {}, 12
    while position + 8 <= length:
        size, kind = struct.unpack_from("<II", data, position)
        if position + 8 + size > length:
            raise InputError(
                f"a chunk of {size} bytes from byte {position + 8} on ends beyond the {length} of the file"
            )
        chunks.setdefault(kind, data[position + 8 : position + 8 + size])
        position += 8 + size
    if JSON_CHUNK not in chunks:
        raise InputError(f"there is no chunk of JSON in the {length} bytes of the file")
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
        else:
            data = files[uri] = files[uri] if uri in files else uri_bytes(path, uri)
        if len(data) < entry["byteLength"]:
            raise InputError(f"a buffer of {entry['byteLength']} bytes expected, got {len(data)}")
        found.append(data)
    return found


def uri_bytes(path: pathlib.Path, uri: str, what: str = "buffer") -> bytes:
    """What the address of a buffer or a picture holds: data, or a file in the folder of the glTF file."""
    if uri.startswith("data:"):
        return base64.b64decode(uri.split(",", 1)[1])
    name = urllib.parse.unquote(uri)
    file = path.parent / name
    folders = (path.parent.resolve(), path.resolve().parent)
    leads_out = pathlib.PurePath(name).is_absolute() or ".." in pathlib.PurePath(name).parts
    if leads_out or not any(file.resolve().is_relative_to(folder) for folder in folders):
        raise InputError(f"its {what} {shown(uri)} leads out of the folder of the file")
    if not os.path.isfile(file):  # False for names that no file can have, too
        raise InputError(f"its {what} {shown(uri)} is not there")
    return read_limited(file, what)


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
            raise InputError(f"its node {index} has two parents, or is its own")
        node = nodes[index] | (moved or {}).get(index, {})
        found[index] = parent @ local_matrix(node) if _PLACES & node.keys() else parent
        stack += [(child, found[index]) for child in reversed(node.get("children", []))]
    return found


def placed_nodes(document: dict) -> list[tuple[int, np.ndarray]]:
    """Number and world matrix (4, 4) of each node of the scene that has a mesh, depth first."""
    nodes = document.get("nodes", [])
    return [(index, matrix) for index, matrix in node_matrices(document).items() if "mesh" in nodes[index]]


def mesh_nodes(document: dict, name: str = "") -> list[tuple[int, np.ndarray]]:
    """Number of the mesh and world matrix (4, 4) of each node of the scene that has a mesh, depth first, or of those of
    one name."""
    return [
        (document["nodes"][node]["mesh"], matrix)
        for node, matrix in placed_nodes(document)
        if not name or object_name(document, node) == name
    ]


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
        raise InputError(f"accessor {index} holds no plain values, at most sparse ones, which cannot be read here")
    if "sparse" in accessor:
        sparse = accessor["sparse"]
        places, changed = sparse["indices"], sparse["values"]
        number = np.dtype(_COMPONENTS[places["componentType"]])
        what = f"the sparse part of accessor {index}"
        rows = _viewed(document, buffers, places, number, 1, sparse["count"], what).reshape(-1).astype(np.int64)
        if len(rows) and not 0 <= rows.min() <= rows.max() < count:
            raise InputError(f"{what} has indices {rows.min()} to {rows.max()} for {count} values")
        values[rows] = _viewed(document, buffers, changed, kind, width, sparse["count"], what)
    return values


def points_of(document: dict, buffers: list[bytes], index: int, *, empty: int | None = None) -> np.ndarray:
    """Points or moves (count, 3) float64 of an accessor; whole numbers are themselves, or shares where it says so
    (KHR_mesh_quantization)."""
    accessor = document["accessors"][index]
    if "sparse" in accessor:  # it may hold all that is not zero
        empty = accessor["count"]
    values = values_of(document, buffers, index, empty=empty)
    return (as_floats(values) if accessor.get("normalized") else values.astype(np.float64)).reshape(-1, 3)


def as_floats(values: np.ndarray) -> np.ndarray:
    """Numbers of an accessor as float64; whole ones stand for shares of the largest (normalised integers)."""
    if values.dtype.kind == "f":
        return values.astype(np.float64)
    return np.maximum(values.astype(np.float64) / np.iinfo(values.dtype).max, -1.0)


def _viewed(
    document: dict, buffers: list[bytes], place: dict, kind: np.dtype, width: int, count: int, what: str
) -> np.ndarray:
    """(count, width) numbers of a part of a buffer."""
    view = document["bufferViews"][place["bufferView"]]
    packed = [name for name in view.get("extensions", {}) if name.endswith("meshopt_compression")]
    if packed:
        raise InputError(f"it is compressed ({packed[0]}): export it without compression")
    start, item = view.get("byteOffset", 0) + place.get("byteOffset", 0), kind.itemsize * width
    stride = view.get("byteStride", item)
    data = buffers[view["buffer"]]
    if stride < item or count < 0 or start < 0:
        raise InputError(f"{what} has a stride of {stride} bytes, {count} values and begins at {start}")
    if count and start + (count - 1) * stride + item > len(data):
        raise InputError(f"{what} reads beyond its buffer of {len(data)} bytes")
    if not count:
        return np.zeros((0, width), kind)
    return np.ndarray((count, width), kind, data, start, (stride, kind.itemsize)).copy()


#: Kinds of primitives that are surfaces; points, lines and loops of lines are none.
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_SURFACES = (_TRIANGLES, _STRIP, _FAN)

#: Most triangles of all nodes together: a thousand times what a large cage has.
MAX_TRIANGLES = 10_000_000

#: Bytes of memory that a vertex and a triangle take while they are read, split vertices joined again.
VERTEX_BYTES, TRIANGLE_BYTES = 200, 150


def gltf_object_names(path: pathlib.Path) -> list[str]:
    """The names of the nodes with meshes of a glTF file, or of their meshes, in the order of `read_gltf`."""
    with errors_of_file(path):
        document, _ = opened(path)
        return list(dict.fromkeys(object_name(document, node) for node, _ in placed_nodes(document)))


def object_name(document: dict, node: int) -> str:
    """What a node with a mesh is called."""
    own = document["nodes"][node]
    return str(own.get("name") or document["meshes"][own["mesh"]].get("name") or f"node {node}")


def require_room(document: dict, nodes: list[tuple[int, np.ndarray]]) -> None:
    """Refuse more triangles than a mesh may have, or than there is memory for, before the first is read."""
    counts = {mesh: _counts(document, document["meshes"][mesh]) for mesh in {mesh for mesh, _ in nodes}}
    vertices, triangles = (sum(counts[mesh][k] for mesh, _ in nodes) for k in range(2))
    what = f"its {len(nodes)} nodes with meshes come to {triangles} triangles and {vertices} vertices"
    if triangles > MAX_TRIANGLES or vertices > 3 * MAX_TRIANGLES:
        raise InputError(f"{what}: at most {MAX_TRIANGLES} triangles are read")
    require_host_memory(VERTEX_BYTES * vertices + TRIANGLE_BYTES * triangles, f"{what}, which need")


def _counts(document: dict, mesh: dict) -> tuple[int, int]:
    """Vertices and triangles that a mesh claims to have."""
    accessors = document["accessors"]
    drawn = list(surface_primitives(mesh))
    positions = [each["attributes"]["POSITION"] for each in drawn]
    corners = [accessors[each.get("indices", each["attributes"]["POSITION"])]["count"] for each in drawn]
    plain = [each.get("mode", _TRIANGLES) == _TRIANGLES for each in drawn]
    triangles = sum(count // 3 if whole else max(0, count - 2) for count, whole in zip(corners, plain, strict=True))
    return sum(accessors[index]["count"] for index in set(positions)), triangles


def mesh_parts(document: dict, buffers: list[bytes], mesh: dict) -> tuple[np.ndarray, np.ndarray, list[dict], bool]:
    """Positions (v, 3) float64 and triangles (f, 3) int64 of a mesh, a primitive for each range of positions, in their
    order, and whether vertices may be split."""
    positions, faces, starts, owners, split = [], [], {}, [], len(mesh["primitives"]) > 1
    for primitive in surface_primitives(mesh):
        accessor = primitive["attributes"]["POSITION"]
        split |= len(primitive["attributes"]) > 1
        if accessor not in starts:  # primitives may share their vertices
            starts[accessor] = sum(map(len, positions))
            positions.append(points_of(document, buffers, accessor))
            owners.append(primitive)
        faces.append(primitive_faces(document, buffers, primitive) + starts[accessor])
    if not positions:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), [], False
    return np.concatenate(positions), np.concatenate(faces), owners, split


def surface_primitives(mesh: dict) -> Iterator[dict]:
    """The primitives of a mesh that are surfaces; points and lines are loose vertices and edges of other programs."""
    for primitive in mesh["primitives"]:
        if primitive.get("mode", _TRIANGLES) in _SURFACES:
            if "KHR_draco_mesh_compression" in primitive.get("extensions", {}):
                raise InputError("it is compressed (Draco): export it without compression")
            yield primitive


def primitive_faces(document: dict, buffers: list[bytes], primitive: dict) -> np.ndarray:
    """Triangles (f, 3) int64 of a primitive, by the numbers of its own positions."""
    mode, count = primitive.get("mode", _TRIANGLES), document["accessors"][primitive["attributes"]["POSITION"]]["count"]
    indices = (
        values_of(document, buffers, primitive["indices"]).reshape(-1).astype(np.int64)
        if "indices" in primitive
        else np.arange(count)
    )
    uneven = mode == _TRIANGLES and len(indices) % 3
    if uneven or (len(indices) and (indices.max() >= count or indices.min() < 0)):
        raise InputError(f"a mesh of {count} vertices has {len(indices)} indices up to {indices.max(initial=0)}")
    return _as_triangles(indices, mode)


def _as_triangles(indices: np.ndarray, mode: int) -> np.ndarray:
    """Triangles (t, 3) of the indices of a primitive; those that only lead a strip on to its next part are left out."""
    if mode == _TRIANGLES:
        return indices.reshape(-1, 3)
    first = np.arange(max(0, len(indices) - 2))
    # glTF 2.0, 3.7.2.1: strips (v_i, v_(i + 1 + i % 2), v_(i + 2 - i % 2)), fans (v_(i + 1), v_(i + 2), v_0)
    odd = first % 2
    corners = (first, first + 1 + odd, first + 2 - odd) if mode == _STRIP else (first + 1, first + 2, 0 * first)
    found = indices[np.stack(corners, axis=1)]
    return found[(found != np.roll(found, 1, axis=1)).all(axis=1)]


# -- Writing


@dataclasses.dataclass(frozen=True)
class Texture:
    """A picture on a mesh."""

    places: np.ndarray  # (v, 2) of the vertices in the picture, 0 to 1 from its upper left corner
    normals: np.ndarray  # (v, 3) of the vertices, in the axes of the vertices
    png: bytes


class Shown(TypedDict, total=False):
    """How a mesh is shown besides its colours."""

    name: str  # of the mesh; "cage"
    frames: np.ndarray | None  # (n, v, 3), an animation of shapes (morph targets), fps a second
    fps: float
    texture: Texture | None


def write_glb(
    vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray | None = None, **options: Unpack[Shown]
) -> bytes:
    """A .glb file of one mesh, vertices (v, 3) with y up; colors: (v, 3) in [0, 1], sRGB, shown without light."""
    document, body = _document(vertices, faces, colors, **options)
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


def write_gltf(
    vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray | None = None, **options: Unpack[Shown]
) -> bytes:
    """The same as a .gltf file: text with the buffer in it."""
    document, body = _document(vertices, faces, colors, **options)
    document["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(body).decode()
    return (json.dumps(document, indent=1) + "\n").encode()


def linear_light(colors: np.ndarray) -> np.ndarray:
    """Colours (n, 3) in [0, 1] of sRGB as linear light, as glTF and USD have those of vertices."""
    srgb = np.clip(np.asarray(colors, np.float64), 0.0, 1.0)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1


def middle_of(vertices: np.ndarray) -> np.ndarray:
    """(3,) about the middle of vertices, which float32 keeps their digits around."""
    # a whole multiple of a coarse step: exact in float32 too, for programs that keep transforms in it
    size = float(np.ptp(vertices, axis=0).max()) or 1.0
    step = 2.0 ** np.ceil(np.log2(size))
    return np.round((vertices.min(axis=0) + vertices.max(axis=0)) / 2.0 / step) * step


def shapes_of(moves: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Shapes (k, m), at least one, and weights (n, k) in [0, 1] whose sums are moves (n, m) up to a tolerance."""
    # Gram-Schmidt, the largest rest first: a film between keyframes takes few shapes, whatever its frames
    left, directions, shares = np.array(moves, np.float64), [], []
    while not directions or (np.abs(left).max() > tolerance and len(directions) < len(moves)):
        lengths = np.linalg.norm(left, axis=1)
        longest = int(lengths.argmax())
        directions.append(left[longest] / (lengths[longest] or 1.0))
        shares.append(left @ directions[-1])
        left -= np.outer(shares[-1], directions[-1])
    shapes, weights = np.stack(directions), np.stack(shares, axis=1)
    # Blender clamps weights to [0, 1]: what is below 0 becomes one shape more, which is always on
    low = np.minimum(weights.min(axis=0), 0.0)
    span = np.maximum(weights.max(axis=0), 0.0) - low
    span[span == 0.0] = 1.0
    shapes, weights, always = shapes * span[:, None], (weights - low) / span, low @ shapes
    if not low.any():
        return shapes, weights
    return np.vstack([shapes, always]), np.hstack([weights, np.ones((len(weights), 1))])


#: Most that animated vertices are off, as a share of the mesh's size: what float32 holds.
SHAPE_ERROR = 1e-6


class _Body:
    """The buffer of a document that grows by a view and an accessor at a time."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.views: list[dict] = []
        self.accessors: list[dict] = []

    def add_bytes(self, data: bytes, *, target: int | None = None) -> int:
        """Add bytes, up to a whole word. Returns the number of their view."""
        view = {"buffer": 0, "byteOffset": sum(map(len, self.parts)), "byteLength": len(data)}
        self.views.append(view if target is None else view | {"target": target})
        self.parts.append(data + bytes(-len(data) % 4))
        return len(self.views) - 1

    def add(self, values: np.ndarray, kind: str, *, target: int | None = None, **properties: object) -> int:
        """Add values in the type of the file, (n,) or (n, width). Returns the number of their accessor."""
        component = next(number for number, name in _COMPONENTS.items() if np.dtype(name) == values.dtype)
        view = self.add_bytes(values.tobytes(), target=target)
        entry = {"bufferView": view, "componentType": component, "type": kind, "count": len(values)}
        self.accessors.append(entry | properties)
        return len(self.accessors) - 1

    def add_ranged(self, values: np.ndarray, kind: str, *, target: int | None = None) -> int:
        """The same with the least and the largest values, which positions and times need."""
        rows = values.reshape(len(values), -1)
        return self.add(values, kind, target=target, min=rows.min(axis=0).tolist(), max=rows.max(axis=0).tolist())


#: What views are for: vertices, and indices.
_VERTICES, _INDICES = 34962, 34963


def _document(
    vertices: np.ndarray,
    faces: np.ndarray,
    colors: np.ndarray | None,
    *,
    name: str = "cage",
    frames: np.ndarray | None = None,
    fps: float = 24.0,
    texture: Texture | None = None,
) -> tuple[dict, bytes]:
    """The JSON document and the buffer that it describes."""
    middle, body = middle_of(vertices), _Body()  # the node holds the middle
    position = body.add_ranged((vertices - middle).astype("<f4"), "VEC3", target=_VERTICES)
    corners = body.add(faces.astype("<u4").reshape(-1), "SCALAR", target=_INDICES)
    primitive: dict = {"attributes": {"POSITION": position}, "indices": corners, "mode": _TRIANGLES}
    node = {"mesh": 0, "name": name} | ({"translation": middle.tolist()} if middle.any() else {})
    mesh: dict = {"primitives": [primitive]}
    document: dict = {
        "asset": {"version": "2.0", "generator": "warpcage"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [node],
        "meshes": [mesh],
    }  # fmt: skip
    if colors is not None:
        rows = np.ones((len(colors), 4))  # RGBA, as glTF aligns each row to four bytes
        rows[:, :3] = linear_light(colors)
        colored = np.round(rows * 65535.0).astype("<u2")
        primitive["attributes"]["COLOR_0"] = body.add(colored, "VEC4", target=_VERTICES, normalized=True)
    if texture is not None:
        attributes = primitive["attributes"]
        attributes["NORMAL"] = body.add(texture.normals.astype("<f4"), "VEC3", target=_VERTICES)
        attributes["TEXCOORD_0"] = body.add(texture.places.astype("<f4"), "VEC2", target=_VERTICES)
        document["images"] = [{"bufferView": body.add_bytes(texture.png), "mimeType": "image/png"}]
        document["textures"] = [{"source": 0}]
    if colors is not None or texture is not None:
        primitive["material"], unlit = 0, "KHR_materials_unlit"  # the light is in the colours
        material: dict = {"name": "captured", "extensions": {unlit: {}}, "doubleSided": True}
        if texture is not None:
            material["pbrMetallicRoughness"] = {"baseColorTexture": {"index": 0}, "metallicFactor": 0.0}
        document["materials"], document["extensionsUsed"] = [material], [unlit]
    if frames is not None:
        size = float(np.ptp(vertices, axis=0).max()) or 1.0
        shapes, weights = shapes_of((frames - vertices).reshape(len(frames), -1), SHAPE_ERROR * size)
        moves = shapes.reshape(len(shapes), -1, 3).astype("<f4")
        primitive["targets"] = [{"POSITION": body.add_ranged(move, "VEC3", target=_VERTICES)} for move in moves]
        mesh["weights"] = [0.0] * len(moves)
        mesh["extras"] = {"targetNames": [f"shape {index + 1}" for index in range(len(moves))]}
        sampler = {
            "input": body.add_ranged((np.arange(len(frames)) / float(fps)).astype("<f4"), "SCALAR"),
            "output": body.add(weights.astype("<f4").reshape(-1), "SCALAR"),
            "interpolation": "LINEAR",
        }
        channel = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
        document["animations"] = [{"name": "film", "samplers": [sampler], "channels": [channel]}]
    joined = b"".join(body.parts)
    document |= {"accessors": body.accessors, "bufferViews": body.views, "buffers": [{"byteLength": len(joined)}]}
    return document, joined
