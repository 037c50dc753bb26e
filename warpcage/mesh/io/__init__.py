"""Read and write OBJ, PLY, OFF and glTF so that every vertex keeps its place in the file."""

from __future__ import annotations

import pathlib

import numpy as np
from numpy.typing import ArrayLike

from ...core.checks import checked_path
from ...core.files import PathLike, atomic_path, require_file
from ..polygons import cut_polygon
from .gltf import read_gltf, write_glb, write_gltf
from .obj_off import Polygons, read_obj, read_off, write_obj, write_off
from .ply import read_ply, write_ply

# our own parsers: mesh libraries merge, split and drop vertices, and a posed cage must match its rest cage one to one
_READERS = {".obj": read_obj, ".ply": read_ply, ".off": read_off, ".glb": read_gltf, ".gltf": read_gltf}

_WRITERS = {".obj": write_obj, ".ply": write_ply, ".off": write_off, ".glb": write_glb, ".gltf": write_gltf}

#: Endings of mesh files, lower case.
ENDINGS = tuple(_READERS)

#: Axes that may point up in a file.
UPS = ("z", "y")


def read_mesh(path: PathLike, up: str | None = None) -> tuple[pathlib.Path, np.ndarray, np.ndarray]:
    """The path, vertices (v, 3) float64 in the file's order, and triangles (f, 3) int64; polygons are cut into them.
    up: the axis that points up in the file, "z" or "y", which is turned to z: (x, -z, y); None is that of `file_up`."""
    path = require_file(path, "cage file")
    turned = _turned(path, up)
    vertices, polygons = _READERS[_format(path)](path)
    if not len(vertices) or not len(polygons):
        raise ValueError(f"{path}: no {'faces' if len(vertices) else 'vertices'} in it")
    triangles = polygons if isinstance(polygons, np.ndarray) else _cut(path, vertices, polygons)
    return path, turned_up(vertices, "y", "z") if turned else vertices, triangles


def turned_up(vertices: np.ndarray, was: str, up: str) -> np.ndarray:
    """Points (n, 3) of a world in which the axis `was` points up, "y" or "z", in one in which `up` does."""
    if was == up:
        return vertices
    x, y, z = vertices.T
    return np.stack([x, -z, y] if up == "z" else [x, z, -y], axis=1)


def file_up(path: PathLike) -> str:
    """The axis that points up in a mesh file by its format: "y" for glTF, as its specification says, "z" for others."""
    return "y" if _format(checked_path(path, "the mesh file")) in (".glb", ".gltf") else "z"


def _cut(path: pathlib.Path, vertices: np.ndarray, polygons: Polygons) -> np.ndarray:
    """Triangles (t, 3) int64 of polygons; errors name the line."""
    count, triangles = len(vertices), []
    for line, polygon in polygons:
        if len(polygon) < 3:
            raise ValueError(f"{path}:{line}: a face needs at least 3 vertices, got {len(polygon)}")
        for index in polygon:
            if not 0 <= index < count:
                raise ValueError(f"{path}:{line}: face with vertex {index} of 0 to {count - 1}, counted from 0")
        try:
            triangles += [polygon] if len(polygon) == 3 else cut_polygon(vertices, polygon)
        except ValueError as error:
            raise ValueError(f"{path}:{line}: {error}") from None
    return np.array(triangles, dtype=np.int64)


def write_mesh(path: PathLike, vertices: ArrayLike, faces: ArrayLike, up: str | None = None) -> None:
    """Write a mesh file, whole or not at all; vertices (v, 3), z up; up: as in `read_mesh`."""
    path = checked_path(path, "the mesh file")
    writer = _WRITERS[_format(path)]  # glTF holds float32 from the middle of the vertices, others every bit
    vertices = np.asarray(vertices, dtype=np.float64)
    if _turned(path, up):
        vertices = turned_up(vertices, "z", "y")
    with atomic_path(path) as temporary:
        temporary.write_bytes(writer(vertices, np.asarray(faces, dtype=np.int32)))


def _format(path: pathlib.Path) -> str:
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise ValueError(f"cage file {str(path)!r} must end in {', '.join(ENDINGS[:-1])} or {ENDINGS[-1]}")
    return ending


def _turned(path: pathlib.Path, up: str | None) -> bool:
    """Whether the file has y up."""
    if up not in (None, *UPS):
        raise ValueError(f"up must be 'z' or 'y', or None for the format's own, got {up!r}")
    return (up or file_up(path)) == "y"
