"""Read and write OBJ, PLY, OFF and glTF so that every vertex keeps its place in the file.

Own parsers, because mesh libraries merge, split and drop vertices, and a posed cage must
match its rest cage one to one.
"""

from __future__ import annotations

import pathlib

import numpy as np

from ...core.files import atomic_path, require_file
from ..polygons import cut_polygon
from .gltf import read_gltf, write_glb, write_gltf
from .ply import read_ply, write_ply
from .text import read_obj, read_off, write_obj, write_off

_READERS = {".obj": read_obj, ".ply": read_ply, ".off": read_off, ".glb": read_gltf, ".gltf": read_gltf}
_WRITERS = {".obj": write_obj, ".ply": write_ply, ".off": write_off, ".glb": write_glb, ".gltf": write_gltf}
ENDINGS = tuple(_READERS)


def read_mesh(path, up: str | None = None) -> tuple[pathlib.Path, np.ndarray, np.ndarray]:
    """Path, vertices (v, 3) float64 in the file's order, and triangles (f, 3) int64; polygons are cut without folds.

    up: the axis that points up in the file, "z" or "y"; what a y-up file holds is turned to z-up, (x, -z, y). None is
    "y" for glTF, as its specification has it, and "z", the numbers as they are, for the others.
    Raises FileNotFoundError for a missing file, ValueError (file name and line) for what is no mesh of these formats.
    """
    path = require_file(path, "cage file")
    turned = _turned(path, up)
    vertices, polygons = _READERS[_format(path)](path)
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
        triangles += [polygon] if len(polygon) == 3 else cut_polygon(vertices, polygon)
    if turned:
        vertices = np.stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]], axis=1)
    return path, vertices, np.array(triangles, dtype=np.int64)


def write_mesh(path, vertices, faces, up: str | None = None) -> None:
    """Write vertices (v, 3) and triangles (f, 3), z-up, to a file of these formats, whole or not at all; up: as in
    `read_mesh`. OBJ, PLY and OFF keep every bit; glTF holds float32 relative to the middle of the vertices."""
    path = pathlib.Path(path)
    writer = _WRITERS[_format(path)]
    vertices = np.asarray(vertices, dtype=np.float64)
    if _turned(path, up):
        vertices = np.stack([vertices[:, 0], vertices[:, 2], -vertices[:, 1]], axis=1)
    with atomic_path(path) as temporary:
        temporary.write_bytes(writer(vertices, np.asarray(faces, dtype=np.int32)))


def _format(path: pathlib.Path) -> str:
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise ValueError(f"cage file {str(path)!r} must end in {', '.join(ENDINGS[:-1])} or {ENDINGS[-1]}")
    return ending


def _turned(path: pathlib.Path, up: str | None) -> bool:
    """Whether the file has y up."""
    if up not in (None, "y", "z"):
        raise ValueError(f"up must be 'z' or 'y', or None for the format's own, got {up!r}")
    return up == "y" or (up is None and _format(path) in (".glb", ".gltf"))
