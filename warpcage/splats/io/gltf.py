"""glTF and GLB with KHR_gaussian_splatting: splats as points with further attributes, plain or packed as SPZ."""

from __future__ import annotations

import dataclasses
import json
import pathlib
import struct
from typing import Any

import numpy as np

from ...core.checks import checked_whole, shown, warn_caller
from ...core.files import JSON_ROOM
from ...core.memory import require_host_memory
from ...errors import InputError
from ...field.io.field_file import Y0
from ...mesh.io.gltf import (
    BINARY_CHUNK,
    JSON_CHUNK,
    errors_of_file,
    mesh_nodes,
    node_matrices,
    opened,
    read_buffers,
    values_of,
)
from .axes import GLTF_AXES, axes_matrix, placed_by, turned
from .contents import FLOAT_LOGS, LOGS, SplatContents, joined, logits_of, logs_of, opacities_of, unit_quaternions
from .spz import read_spz_data

EXTENSION = "KHR_gaussian_splatting"

#: Its companions for SPZ, the newest first.
SPZ_EXTENSIONS = (f"{EXTENSION}_compression_spz_2", f"{EXTENSION}_compression_spz")

#: What files hold that are written.
RANGES = {LOGS: FLOAT_LOGS}

#: What splats are that are drawn as here: what the extension calls so.
_KERNEL, _COLORS = "ellipse", "srgb_rec709_display"

_POINTS = 0

#: Bytes of memory that a splat of degree 3 takes while it is read.
_SPLAT_BYTES = 1500

#: Numbers that are whole stand for shares of these, where an accessor says that they do.
_MOST = {"i1": 127.0, "u1": 255.0, "i2": 32767.0, "u2": 65535.0}


def has_splats(path: pathlib.Path) -> bool:
    """Whether a .glb or .gltf file holds splats, by its JSON."""
    try:
        with path.open("rb") as file:
            head = file.read(20)
            if head[:4] != b"glTF":
                size = path.stat().st_size
                require_host_memory(JSON_ROOM * size, f"{path}: its {size} bytes of JSON need")
                return EXTENSION.encode() in head + file.read()
            length = struct.unpack_from("<I", head, 12)[0] if len(head) == 20 else 0
            require_host_memory(min(length, path.stat().st_size), f"{path}: its {length} bytes of JSON need")
            return EXTENSION.encode() in file.read(min(length, path.stat().st_size))
    except OSError:
        return False


def gltf_counts(path: pathlib.Path) -> dict[str, int]:
    """How many of each kind of object the scene of a file holds."""
    with errors_of_file(path):
        document, _ = opened(path)
        parts = [document["meshes"][mesh]["primitives"] for mesh, _ in mesh_nodes(document)]
        of_splats = [any(EXTENSION in each.get("extensions", {}) for each in primitives) for primitives in parts]
        return {
            "mesh": of_splats.count(False),
            "camera": sum("camera" in document["nodes"][node] for node in node_matrices(document)),
            "skeleton": len(document.get("skins", [])),
            "prim of splats": of_splats.count(True),
        }


def read_gltf_splats(path: pathlib.Path) -> SplatContents:
    """The splats of all nodes of the scene of a file, at their places."""
    with errors_of_file(path):
        document, chunk = opened(path)
        nodes = [
            (primitive, matrix)
            for mesh, matrix in mesh_nodes(document)
            for primitive in document["meshes"][mesh]["primitives"]
            if EXTENSION in primitive.get("extensions", {})
        ]
        if not nodes:
            raise InputError(f"{path}: it has no splats: no node of its scene has a mesh with {EXTENSION}")
        counts = [_claimed(document, primitive) for primitive, _ in nodes]
        require_host_memory(
            _SPLAT_BYTES * sum(counts), f"its {len(nodes)} nodes come to {sum(counts)} splats, which need"
        )
        buffers = read_buffers(path, document, chunk)
        parts = [placed_by(_primitive(path, document, buffers, each), matrix) for each, matrix in nodes]
        parts = [dataclasses.replace(part, centers=part.centers.astype(np.float32)) for part in parts]
        contents = joined(parts)
        return turned(contents, axes_matrix(GLTF_AXES))


def write_glb_splats(contents: SplatContents) -> bytes:
    """A .glb file, whose splats are plain float32 numbers in glTF's axes."""
    contents = turned(contents, axes_matrix(GLTF_AXES).T)
    opacities = opacities_of(contents.logits)
    colors = 0.5 + Y0 * contents.harmonics[:, 0].astype(np.float64)
    places = contents.centers.astype("<f4")
    scales = np.exp(np.maximum(contents.log_scales.astype(np.float64), FLOAT_LOGS[0])).astype("<f4")
    attributes: dict[str, np.ndarray] = {
        "POSITION": places,
        # what programs that know no splats colour the points by
        "COLOR_0": np.clip(np.round(255.0 * np.column_stack([colors, opacities])), 0, 255).astype("u1"),
        f"{EXTENSION}:ROTATION": np.roll(unit_quaternions(contents.quaternions), -1, axis=1).astype("<f4"),
        f"{EXTENSION}:SCALE": scales,
        f"{EXTENSION}:OPACITY": opacities.astype("<f4")[:, None],
    }
    for k in range(contents.harmonics.shape[1]):
        degree = int(np.sqrt(k))
        attributes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k - degree**2}"] = contents.harmonics[:, k].astype("<f4")
    views, accessors, parts, end = [], [], [], 0
    for name, values in attributes.items():
        data = values.tobytes()
        view = {"buffer": 0, "byteOffset": end, "byteLength": len(data), "target": 34962}
        accessor: dict[str, Any] = {
            "bufferView": len(views),
            "componentType": 5126 if values.dtype == np.float32 else 5121,
            "count": len(values),
            "type": "SCALAR" if values.shape[1] == 1 else f"VEC{values.shape[1]}",
        }
        if name == "COLOR_0":
            accessor["normalized"] = True
        if name == "POSITION" and len(values):
            accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        views.append(view)
        accessors.append(accessor)
        parts.append(data)
        end += len(data)
    primitive: dict[str, Any] = {
        "attributes": {name: k for k, name in enumerate(attributes)},
        "mode": _POINTS,
        "extensions": {
            EXTENSION: {
                "kernel": _KERNEL,
                "colorSpace": _COLORS,
                "sortingMethod": "cameraDistance",
                "projection": "perspective",
            }
        },
    }
    document = {
        "asset": {"version": "2.0", "generator": "warpcage"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": end}],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body = b"".join(parts) + b"\0" * (-end % 4)
    chunks = struct.pack("<II", len(text), JSON_CHUNK) + text + struct.pack("<II", len(body), BINARY_CHUNK) + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _claimed(document: dict, primitive: dict) -> int:
    """Splats that a part of a mesh claims to have, 0 where it does not say."""
    if "POSITION" not in primitive["attributes"]:
        return 0
    count = document["accessors"][primitive["attributes"]["POSITION"]]["count"]
    return checked_whole(count, "a number of splats", 0)


def _primitive(path: pathlib.Path, document: dict, buffers: list[bytes], primitive: dict) -> SplatContents:
    """The splats of a part of a mesh, in glTF's axes."""
    extension = primitive["extensions"][EXTENSION]
    if primitive.get("mode", 4) != _POINTS:
        raise InputError(f"splats are points, which is mode 0, got mode {shown(primitive.get('mode', 4))}")
    for key, known in (("kernel", _KERNEL), ("colorSpace", _COLORS)):
        if (value := extension.get(key, known)) != known:
            warn_caller(f"{path}: its splats have {key} {shown(value)}, they are drawn as {known!r}")
    packed = [each for each in SPZ_EXTENSIONS if each in extension.get("extensions", {})]
    if packed:
        view = document["bufferViews"][extension["extensions"][packed[0]]["bufferView"]]
        begin, size = view.get("byteOffset", 0), view["byteLength"]
        data = buffers[view["buffer"]]
        if not 0 <= begin <= begin + size <= len(data):
            raise InputError(f"the part of a buffer for SPZ ends at byte {begin + size} of {len(data)}")
        contents = read_spz_data(path, data[begin : begin + size])
        if "POSITION" in primitive["attributes"] and contents.count != (claimed := _claimed(document, primitive)):
            raise InputError(f"{contents.count} splats are packed by SPZ, {claimed} are claimed")
        return turned(contents, axes_matrix(GLTF_AXES).T)  # from a field's axes, which SPZ was read into
    return _plain(document, buffers, primitive["attributes"])


def _plain(document: dict, buffers: list[bytes], attributes: dict[str, int]) -> SplatContents:
    """The splats of attributes."""

    def values(name: str, width: int) -> np.ndarray:
        if name not in attributes:
            raise InputError(f"its splats lack {name}")
        accessor = document["accessors"][attributes[name]]
        found = values_of(document, buffers, attributes[name])
        if found.shape != (count, width):
            raise InputError(f"{name} of {count} splats must be {(count, width)}, got {found.shape}")
        if accessor.get("normalized"):
            most = _MOST.get(found.dtype.str[1:])
            if most is None:
                raise InputError(f"{name} cannot be normalized numbers of type {found.dtype}")
            return np.maximum(found / most, -1.0)
        return found.astype(np.float64)

    if "POSITION" not in attributes:
        raise InputError("its splats lack POSITION")
    count = document["accessors"][attributes["POSITION"]]["count"]
    degree = max((k for k in range(1, 4) if f"{EXTENSION}:SH_DEGREE_{k}_COEF_0" in attributes), default=0)
    names = [f"{EXTENSION}:SH_DEGREE_{k}_COEF_{c}" for k in range(degree + 1) for c in range(2 * k + 1)]
    harmonics = np.empty((count, len(names), 3), np.float32)
    with np.errstate(over="ignore"):
        for k, name in enumerate(names):
            harmonics[:, k] = values(name, 3)
        return SplatContents(
            values("POSITION", 3).astype(np.float32),
            logs_of(values(f"{EXTENSION}:SCALE", 3)),
            np.roll(values(f"{EXTENSION}:ROTATION", 4), 1, axis=1).astype(np.float32),
            logits_of(np.clip(values(f"{EXTENSION}:OPACITY", 1)[:, 0], 0.0, 1.0)),
            harmonics,
        )
