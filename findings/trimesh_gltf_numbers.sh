#!/bin/sh
# Finding: trimesh leaves out the sparse part of glTF accessors and the word `normalized`
# Software: trimesh 5.2.0 (PyPI)
# Expected: a corner that the sparse part moves to y = 5 is there; KHR_mesh_quantization's normalized 16-bit places
#   reach from -1 to 1
# Seen: the corner stays at y = 1, and the places reach to 32767
# Meets: who checks a cage or an object that an optimiser (gltfpack, glTF-Transform) made smaller, or shape keys that
#   are stored sparsely
# Here: glTF is read by its own reader with both (`warpcage/mesh/io/gltf.py`); trimesh reads none of it.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check trimesh==5.2.0 numpy==2.4.6
venv/bin/python - <<'END'
import io
import json
import struct
import sys

import numpy as np
import trimesh


def loaded(parts, position, **more):
    """The vertices of a glTF file of one triangle: parts are its buffer views, position its accessor."""
    views, body = [], b""
    for part in parts:
        views.append({"buffer": 0, "byteOffset": len(body), "byteLength": len(part)})
        body += part + bytes(-len(part) % 4)
    document = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "count": 3, "type": "VEC3", **position},
            {"bufferView": 1, "count": 3, "type": "SCALAR", "componentType": 5123},
        ],
        "bufferViews": views, "buffers": [{"byteLength": len(body)}], **more,
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    data = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(body))
    data += struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
    return trimesh.load(io.BytesIO(data), file_type="glb", force="mesh", process=False).vertices


corners, order = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.uint16([0, 1, 2]).tobytes()
values = {"indices": {"bufferView": 2, "componentType": 5123}, "values": {"bufferView": 3}, "count": 1}
parts = [corners.tobytes(), order, np.uint16([2]).tobytes(), np.float32([0, 5, 0]).tobytes()]
sparse = loaded(parts, {"componentType": 5126, "min": [0, 0, 0], "max": [1, 5, 0], "sparse": values})
short = np.zeros((3, 4), np.int16)  # rows of 8 bytes
short[:, :3] = 32767 * corners
whole = loaded(
    [short.tobytes(), order], {"componentType": 5122, "normalized": True, "min": [0, 0, 0], "max": [32767, 32767, 0]},
    extensionsUsed=["KHR_mesh_quantization"], extensionsRequired=["KHR_mesh_quantization"],
)
print("sparse, y of the corner that is moved to 5:", sparse[2, 1])
print("normalized, the largest x that stands for 1:", whole.max())
sys.exit(0 if sparse[2, 1] == 1 and whole.max() == 32767 else "the behaviour has changed")
END
