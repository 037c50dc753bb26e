#!/bin/sh
# Finding: the vertex matrix of PyMeshLab leaves out where a glTF's node puts its mesh
# Software: PyMeshLab 2025.7.post1 (PyPI)
# Expected: a triangle in a node that moves it by 10 along x has x from 10 to 11
# Seen: vertex_matrix has x from 0 to 1; the move is in transform_matrix and transformed_vertex_matrix alone
# Meets: who takes an object from a .glb file to make a cage around it: the cage lies at the origin, the object does
#   not
# Here: glTF is read with all its nodes by a reader of its own (`warpcage/mesh/io/gltf.py`); PyMeshLab gets arrays
#   alone.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check pymeshlab==2025.7.post1 numpy==2.4.6
venv/bin/python - <<'END'
import json
import struct
import sys

import numpy as np
import pymeshlab

body = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]]).tobytes() + np.uint16([0, 1, 2, 0]).tobytes()
document = {
    "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}],
    "nodes": [{"mesh": 0, "translation": [10, 0, 0]}],
    "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
    "accessors": [
        {"bufferView": 0, "count": 3, "type": "VEC3", "componentType": 5126, "min": [0, 0, 0], "max": [1, 1, 0]},
        {"bufferView": 1, "count": 3, "type": "SCALAR", "componentType": 5123},
    ],
    "bufferViews": [
        {"buffer": 0, "byteOffset": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 6},
    ],
    "buffers": [{"byteLength": len(body)}],
}
text = json.dumps(document).encode()
text += b" " * (-len(text) % 4)
with open("moved.glb", "wb") as file:
    file.write(struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(body)))
    file.write(struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body)
meshes = pymeshlab.MeshSet(verbose=False)
meshes.load_new_mesh("moved.glb")
mesh = meshes.current_mesh()
plain, placed = mesh.vertex_matrix()[:, 0], mesh.transformed_vertex_matrix()[:, 0]
print("x of vertex_matrix:", plain, "x of transformed_vertex_matrix:", placed)
sys.exit(0 if plain.min() == 0 and placed.min() == 10 else "the behaviour has changed")
END
