"""A glTF document by hand, for files that move."""

import base64
import json

import numpy as np

KINDS = {"f": 5126, "u": 5125, "B": 5121}
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


class GltfWriter:
    """Collects numbers and writes a .gltf of one mesh on node 0."""

    def __init__(self, vertices, faces):
        self.body, self.views, self.accessors = b"", [], []
        self.primitive = {"attributes": {"POSITION": self.add(vertices)}, "indices": self.add(faces, "u")}
        self.nodes, self.more = [{"mesh": 0}], {}

    def view(self, values, kind="f"):
        data = np.ascontiguousarray(values, {"f": "<f4", "u": "<u4", "B": "u1"}[kind]).tobytes()
        self.views.append({"buffer": 0, "byteOffset": len(self.body), "byteLength": len(data)})
        self.body += data + b"\0" * (-len(data) % 4)
        return len(self.views) - 1

    def add(self, values, kind="f", width=None, **more):
        values = np.asarray(values)
        width = width or (1 if kind == "u" or values.ndim == 1 else values.shape[-1])
        self.accessors.append({"bufferView": self.view(values, kind), "componentType": KINDS[kind],
                               "type": TYPES[width], "count": values.size // width, **more})  # fmt: skip
        return len(self.accessors) - 1

    def add_sparse(self, count, rows, values):
        self.accessors.append({
            "componentType": 5126, "type": "VEC3", "count": count,
            "sparse": {"count": len(rows), "indices": {"bufferView": self.view(rows, "u"), "componentType": 5125},
                       "values": {"bufferView": self.view(values)}}})  # fmt: skip
        return len(self.accessors) - 1

    def animate(self, *channels, name=None):
        """channels: (node, path, times, values, interpolation)."""
        samplers, targets = [], []
        for node, path, times, values, way in channels:
            samplers.append({"input": self.add(times), "output": self.add(values), "interpolation": way})
            targets.append({"sampler": len(samplers) - 1, "target": {"node": node, "path": path}})
        named = {} if name is None else {"name": name}
        self.more.setdefault("animations", []).append({"samplers": samplers, "channels": targets, **named})

    def save(self, path, **mesh):
        uri = "data:application/octet-stream;base64," + base64.b64encode(self.body).decode()
        children = {child for node in self.nodes for child in node.get("children", [])}
        document = {
            "asset": {"version": "2.0"}, "scene": 0, "nodes": self.nodes,
            "scenes": [{"nodes": [k for k in range(len(self.nodes)) if k not in children]}],
            "meshes": [{"primitives": [self.primitive], **mesh}], "accessors": self.accessors,
            "bufferViews": self.views, "buffers": [{"byteLength": len(self.body), "uri": uri}], **self.more,
        }  # fmt: skip
        path.write_text(json.dumps(document))
        return path
