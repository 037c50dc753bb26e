"""The triangles of all meshes of a glTF scene at their places, with the skins and shapes that move them."""

from __future__ import annotations

import pathlib
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from ...core.checks import warn_caller
from ...core.memory import require_host_memory
from ...errors import InputError
from ..faces import joined_rows
from .gltf import (
    as_floats,
    errors_of_file,
    mesh_nodes,
    mesh_parts,
    node_matrices,
    object_name,
    opened,
    placed_nodes,
    points_of,
    read_buffers,
    require_room,
    surface_primitives,
    values_of,
)


def read_gltf(path: pathlib.Path, name: str = "") -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) float64, y up as in the file, and triangles (t, 3) int64 of a glTF file, or of the nodes of one
    name; shapes are off, skins where their bones stand."""
    with errors_of_file(path):
        document, chunk = opened(path)
        require_room(document, mesh_nodes(document, name))  # nodes may share a mesh: few bytes for many triangles
        buffers, matrices = read_buffers(path, document, chunk), node_matrices(document)
        meshes: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        vertices, triangles, count = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], 0
        for node, matrix in placed_nodes(document):
            if name and object_name(document, node) != name:
                continue
            if "EXT_mesh_gpu_instancing" in document["nodes"][node].get("extensions", {}):
                what = f"node {object_name(document, node)!r} is read once, not at its instances"
                warn_caller(f"{path}: {what} (EXT_mesh_gpu_instancing): export them as nodes")
            mesh = document["nodes"][node]["mesh"]
            if mesh not in meshes:
                meshes[mesh] = _mesh(document, buffers, document["meshes"][mesh])
            points, faces = meshes[mesh]
            if "skin" in document["nodes"][node]:  # glTF 2.0, 3.7.3.2: its own place does not count
                body = Body(document, buffers, node, shaped=False)
                points, matrix = body.at((), matrices), matrices[body.joints[0]] @ body.binds[0]
            else:
                points = points @ matrix[:3, :3].T + matrix[:3, 3]
            vertices.append(points)
            # a mirrored node: its faces are turned, so that they look the same way
            triangles.append((faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0.0 else faces) + count)
            count += len(points)
    joined = np.concatenate(vertices)
    if not np.isfinite(joined).all():
        raise InputError(f"{path}: glTF vertex {np.flatnonzero(~np.isfinite(joined).all(axis=1))[0]} is not finite")
    return joined, np.concatenate(triangles)


def _mesh(document: dict, buffers: list[bytes], mesh: dict) -> tuple[np.ndarray, np.ndarray]:
    """Positions (v, 3) float64 and triangles (f, 3) of all primitives, split vertices joined."""
    positions, faces, _, split = mesh_parts(document, buffers, mesh)
    if not split:  # positions alone are taken as they are
        return positions, faces
    first, number = joined_rows(positions)
    return positions[first], number[faces]


def node_points(
    document: dict, buffers: list[bytes], node: int, matrices: Mapping[int, np.ndarray]
) -> dict[int, np.ndarray]:
    """(v, 3) float64 in the scene's world of each accessor of positions of a node's mesh, as `read_gltf` has them."""
    body = Body(document, buffers, node, shaped=False, joined=False)
    ends = np.cumsum([document["accessors"][accessor]["count"] for accessor in body.accessors])
    return dict(zip(body.accessors, np.split(body.at((), matrices), ends[:-1]), strict=True)) if len(ends) else {}


class Body:
    """The vertices of one node with a mesh; shaped: with its shapes, which are off else; joined: split ones are one."""

    def __init__(self, document: dict, buffers: list[bytes], node: int, *, shaped: bool = True, joined: bool = True):
        self.node = node
        mesh = document["meshes"][document["nodes"][node]["mesh"]]
        positions, _, primitives, split = mesh_parts(document, buffers, mesh)
        self.kept = joined_rows(positions)[0] if split and joined else np.arange(len(positions))
        self.positions = positions[self.kept]
        self.accessors = [one["attributes"]["POSITION"] for one in primitives]
        counts = [document["accessors"][accessor]["count"] for accessor in self.accessors]

        def gathered(read) -> np.ndarray:
            parts = [read(one, count) for one, count in zip(primitives, counts, strict=True)]
            return np.concatenate(parts)[self.kept] if parts else np.zeros((0, 3))

        def moved(one: dict, count: int, k: int) -> np.ndarray:
            target = one.get("targets", [])[k]
            if "POSITION" not in target:
                return np.zeros((count, 3))
            return points_of(document, buffers, target["POSITION"], empty=count)

        shape_count = max((len(one.get("targets", [])) for one in primitives), default=0)
        if not shaped:
            shape_count = 0
        elif any(len(one.get("targets", [])) != shape_count for one in primitives):
            raise InputError("the parts of its mesh have different numbers of shapes")
        require_host_memory(24 * shape_count * len(positions), f"its {shape_count} shapes need")
        self.shapes = [gathered(lambda one, count, k=k: moved(one, count, k)) for k in range(shape_count)]
        names = mesh.get("extras", {}).get("targetNames", []) if isinstance(mesh.get("extras", {}), dict) else []
        self.names = [str(names[k]) if k < len(names) else f"shape {k + 1}" for k in range(shape_count)]
        weights = document["nodes"][node].get("weights", mesh.get("weights", [0.0] * shape_count))
        self.weights = np.array(weights if shaped else [], np.float64)
        if self.weights.shape != (shape_count,):
            raise InputError(f"a mesh of {shape_count} shapes has {self.weights.size} weights")
        self.skin = document["nodes"][node].get("skin")
        if self.skin is not None:
            self._read_skin(document, buffers, mesh, gathered)

    def _read_skin(self, document: dict, buffers: list[bytes], mesh: dict, gathered) -> None:
        skin = document["skins"][self.skin]
        self.joints = list(skin["joints"])
        binds = np.tile(np.eye(4), (len(self.joints), 1, 1))
        if "inverseBindMatrices" in skin:
            read = values_of(document, buffers, skin["inverseBindMatrices"]).astype(np.float64)
            binds = read.reshape(-1, 4, 4).transpose(0, 2, 1)
        if not self.joints or any("JOINTS_0" not in one["attributes"] for one in surface_primitives(mesh)):
            raise InputError("a skin needs joints, and its mesh JOINTS_0 and WEIGHTS_0")
        if len(binds) < len(self.joints):
            raise InputError(f"a skin of {len(self.joints)} joints has {len(binds)} matrices")
        self.binds = binds
        sets = range(8)

        def attribute(one: dict, name: str) -> list[np.ndarray]:
            found = [one["attributes"].get(f"{name}_{k}") for k in sets]
            return [values_of(document, buffers, index) for index in found if index is not None]

        self.bones = gathered(lambda one, count: np.concatenate(attribute(one, "JOINTS"), axis=1).astype(np.int64))
        shares = gathered(
            lambda one, count: np.concatenate([as_floats(each) for each in attribute(one, "WEIGHTS")], axis=1)
        )
        if self.bones.shape != shares.shape or (self.bones.size and self.bones.max() >= len(self.joints)):
            raise InputError(f"a skin of {len(self.joints)} joints has bones up to {self.bones.max(initial=0)}")
        total = shares.sum(axis=1, keepdims=True)
        self.shares = np.divide(shares, total, out=np.zeros_like(shares), where=total > 0.0)

    def at(self, weights: ArrayLike, matrices: Mapping[int, np.ndarray]) -> np.ndarray:
        """(v, 3) places in the world."""
        points = self.positions
        for weight, shape in zip(np.asarray(weights), self.shapes, strict=True):
            if weight:
                points = points + weight * shape
        matrix = matrices[self.node]
        if self.skin is None:
            return points @ matrix[:3, :3].T + matrix[:3, 3]
        bones = np.stack([matrices[joint] @ bind for joint, bind in zip(self.joints, self.binds, strict=False)])
        blended = np.einsum("vb,vbij->vij", self.shares, bones[self.bones])
        return np.einsum("vij,vj->vi", blended[:, :3, :3], points) + blended[:, :3, 3]
