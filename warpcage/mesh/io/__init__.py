"""Read and write OBJ, PLY, OFF, glTF and USD so that every vertex keeps its place in the file."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ...core.checks import checked_path, listed, require_type, warn_caller
from ...core.files import PathLike, atomic_path, require_file
from ...core.names import counted
from ...errors import InputError
from ..mesh import ClosedMesh
from ..polygons import cut_polygon
from .formats import ENDINGS, MeshFormat, mesh_format
from .gltf import Texture, write_glb, write_gltf
from .obj_off import UNNAMED, Polygons
from .usd import USD_ENDINGS, write_usd

__all__ = [
    "ALL_OBJECTS",
    "ENDINGS",
    "MOTION_ENDINGS",
    "UPS",
    "MeshFile",
    "file_up",
    "object_names",
    "read_mesh",
    "read_object",
    "turned_up",
    "write_mesh",
    "write_shown_mesh",
]

#: Axes that may point up in a file.
UPS = ("z", "y")

#: Endings of mesh files that hold motion, and colours.
MOTION_ENDINGS = (".glb", ".gltf", *USD_ENDINGS)

#: The word that takes all objects of a file together.
ALL_OBJECTS = "*"


#: Faces: triangles (f, 3), or the corners of each.
Faces = np.ndarray | list[list[int]]


@dataclasses.dataclass(frozen=True)
class MeshFile:
    """What was read from a mesh file."""

    path: pathlib.Path
    vertices: np.ndarray  # (v, 3) float64 in the file's order
    faces: np.ndarray  # (f, 3) int64; polygons are cut into them
    polygons: list[list[int]] | None = None  # the faces as they came, where one has more than three corners
    name: str = ""  # of the object that it is; "" where the file has no names, or all of it was taken

    @property
    def as_came(self) -> Faces:
        """The faces as a ClosedMesh takes them."""
        return self.faces if self.polygons is None else self.polygons


def read_mesh(path: PathLike, up: str | None = None) -> tuple[pathlib.Path, np.ndarray, np.ndarray]:
    """Path, vertices and triangles of a file; see `read_object`."""
    found = read_object(path, up)
    return found.path, found.vertices, found.faces


def read_object(
    path: PathLike,
    up: str | None = None,
    object: str | None = None,
    fits: Callable[[np.ndarray, Faces], bool] | None = None,
    likely: str = "",
) -> MeshFile:
    """A mesh file, or one `object` of it, "*" for all; of several without a name, that which is called `likely`, or the
    only one that `fits`. up: the axis that points up in the file, "z" or "y"; None is that of `file_up`."""
    # what has y up is turned to z: (x, -z, y)
    path = require_file(path, "cage file")
    turned, format = _turned(path, up), mesh_format(path)
    assert format.read is not None
    names = [] if object == ALL_OBJECTS or format.object_names is None else format.object_names(path)
    name = _chosen(path, names, format, object, fits, likely)
    found = _whole(path, *(format.read(path) if not name or len(names) == 1 else _read_named(format, path, name)))
    vertices = turned_up(found.vertices, "y", "z") if turned else found.vertices
    return dataclasses.replace(found, vertices=vertices, name=name)


def object_names(path: PathLike) -> list[str]:
    """The names of the objects of a mesh file; none where its format has no names."""
    path = require_file(path, "cage file")
    format = mesh_format(path)
    return [] if format.object_names is None else format.object_names(path)


def _whole(path: pathlib.Path, vertices: np.ndarray, polygons: np.ndarray | Polygons) -> MeshFile:
    """What a reader gives, checked, in triangles."""
    if len(vertices) and not len(polygons) and path.suffix.lower() == ".ply":
        raise InputError(f"{path} holds {counted(len(vertices), 'point')} without faces, no mesh and no cage")
    if not len(vertices) or not len(polygons):
        raise InputError(f"{path}: no {'faces' if len(vertices) else 'vertices'} in it")
    if isinstance(polygons, np.ndarray):
        return MeshFile(path, vertices, polygons)
    faces = _cut(path, vertices, polygons)
    is_cut = len(faces) > len(polygons)
    return MeshFile(path, vertices, faces, [polygon for _, polygon in polygons] if is_cut else None)


def _read_named(format: MeshFormat, path: pathlib.Path, name: str) -> tuple[np.ndarray, np.ndarray | Polygons]:
    assert format.read_object is not None
    return format.read_object(path, name)


def _chosen(
    path: pathlib.Path,
    names: list[str],
    format: MeshFormat,
    object: str | None,
    fits: Callable[[np.ndarray, Faces], bool] | None,
    likely: str,
) -> str:
    """The name of the object of a file to read, of those in it; "" for the whole file."""
    if object not in (None, ALL_OBJECTS):
        require_type(object, str, "the name of an object must be")
        if object not in names and names not in ([], [UNNAMED]):
            raise InputError(f"{path}: there is no object {object!r} in it, only {listed(names)}")
        if object not in names:
            warn_caller(f"{path} holds one mesh without a name: it is taken for {object!r}")
        return object if object in names else ""
    if len(names) < 2:
        return "" if names in ([], [UNNAMED]) else names[0]
    if likely in names:
        return likely
    fitting = [] if fits is None else [name for name in names if _fits(path, format, name, fits)]
    if len(fitting) == 1:
        return fitting[0]
    if format.together:
        return ""
    what = f"{path} holds {counted(len(names), 'object')} ({listed(names)})"
    if fits is not None:
        what += f", of which {listed(fitting)} fit the cage at rest"
    raise InputError(f"{what}: choose one by object= (--cage-object NAME), or {ALL_OBJECTS!r} for all as one")


def _fits(path: pathlib.Path, format: MeshFormat, name: str, fits: Callable[[np.ndarray, Faces], bool]) -> bool:
    try:
        found = _whole(path, *_read_named(format, path, name))
    except ValueError:
        return False
    return fits(found.vertices, found.as_came)


def turned_up(vertices: np.ndarray, was: str, up: str) -> np.ndarray:
    """Points (n, 3) of a world in which the axis `was` points up, "y" or "z", in one in which `up` does."""
    if was == up:
        return vertices
    x, y, z = vertices.T
    return np.stack([x, -z, y] if up == "z" else [x, z, -y], axis=1)


def file_up(path: PathLike) -> str:
    """The axis that points up in a mesh file by its format: "y" for glTF, as its specification says, "z" for others."""
    return _up(checked_path(path, "the mesh file"))


def _cut(path: pathlib.Path, vertices: np.ndarray, polygons: Polygons) -> np.ndarray:
    """Triangles (t, 3) int64 of polygons; errors name the line."""
    count, triangles = len(vertices), []
    for line, polygon in polygons:
        if len(polygon) < 3:
            raise InputError(f"{path}:{line}: a face needs at least 3 vertices, got {len(polygon)}")
        for index in polygon:
            if not 0 <= index < count:
                raise InputError(f"{path}:{line}: face with vertex {index} of 0 to {count - 1}, counted from 0")
        try:
            triangles += [polygon] if len(polygon) == 3 else cut_polygon(vertices, polygon)
        except ValueError as error:
            raise InputError(f"{path}:{line}: {error}") from None
    return np.array(triangles, dtype=np.int64)


def write_mesh(path: PathLike, mesh: ClosedMesh, up: str | None = None) -> None:
    """Write a mesh file, whole or not at all, with polygons as they came where its format has any; z is up in the mesh;
    up: as in `read_mesh`."""
    path = checked_path(path, "the mesh file")
    format = mesh_format(path, "write")
    writer, faces = format.write, mesh.faces
    assert writer is not None  # glTF holds float32 from the middle of the vertices, others every bit
    if mesh.polygon_faces is not None:
        if format.polygons:
            faces = mesh.polygons
        else:
            _warn_cut(path)
    vertices = mesh.vertices
    if _turned(path, up, "write"):
        vertices = turned_up(vertices, "z", "y")
    with atomic_path(path) as temporary:
        temporary.write_bytes(writer(vertices, faces))


def write_shown_mesh(
    path: PathLike,
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    polygons: Sequence[tuple[int, ...]] | None = None,
    colors: np.ndarray | None = None,
    frames: np.ndarray | None = None,
    fps: float = 24.0,
    name: str = "cage",
    texture: Texture | None = None,
) -> None:
    """Write a mesh of vertices (v, 3), z up, with colours (v, 3) in [0, 1], sRGB, or motion, whole or not at all; its
    ending is one of MOTION_ENDINGS. frames: (n, v, 3), fps a second; USD holds them as time samples, glTF as shapes."""
    # polygons: what USD has in place of the triangles (f, 3), None the same. A texture is for glTF: it lies in the file
    path = checked_path(path, "the mesh file")
    ending = path.suffix.lower()
    if ending not in MOTION_ENDINGS:
        raise InputError(f"{str(path)!r} must end in {listed(MOTION_ENDINGS)} to hold motion or colours")
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int32)
    shown: dict[str, Any] = {"colors": colors, "frames": frames, "fps": fps, "name": name}
    if ending in USD_ENDINGS:
        if texture is not None:
            raise InputError(f"{str(path)!r}: textures are written to glTF (.glb, .gltf)")
        data = write_usd(vertices, faces if polygons is None else polygons, ending=ending, **shown)
    else:
        if polygons is not None and len(polygons) < len(faces):
            _warn_cut(path)
        if frames is not None:
            shown["frames"] = turned_up(np.asarray(frames).reshape(-1, 3), "z", "y").reshape(np.shape(frames))
        if texture is not None:
            shown["texture"] = dataclasses.replace(texture, normals=turned_up(texture.normals, "z", "y"))
        data = (write_glb if ending == ".glb" else write_gltf)(turned_up(vertices, "z", "y"), faces, **shown)
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def _warn_cut(path: pathlib.Path) -> None:
    warn_caller(f"{path} holds triangles: faces of more corners are cut; .obj, .ply, .off and USD keep them")


def _up(path: pathlib.Path, verb: str = "read") -> str:
    return mesh_format(path, verb).up


def _turned(path: pathlib.Path, up: str | None, verb: str = "read") -> bool:
    """Whether the file has y up."""
    if up not in (None, *UPS):
        raise InputError(f"up must be 'z' or 'y', or None for the format's own, got {up!r}")
    return (up or _up(path, verb)) == "y"
