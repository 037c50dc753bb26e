"""The one table of mesh formats: their names, endings, readers and writers, those of other packages too."""

from __future__ import annotations

import dataclasses
import functools
import pathlib
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from ...core.checks import registered_formats, require_endings
from ...core.files import seen_note
from ...errors import InputError
from .gltf import gltf_object_names, write_glb, write_gltf
from .gltf_meshes import read_gltf
from .obj_off import Polygons, obj_object_names, read_obj, read_obj_object, read_off, write_obj, write_off
from .ply import read_ply, write_ply
from .usd import read_usd, usd_object_names, write_usd, write_usda

#: The group of entry points by which other packages add formats.
GROUP = "warpcage.mesh_formats"

#: What a reader gives: vertices (v, 3) float64, and triangles (t, 3) or polygons with the lines that they are on.
Surface = tuple[np.ndarray, "np.ndarray | Polygons"]


@dataclasses.dataclass(frozen=True)
class MeshFormat:
    """A format of mesh files; another package adds one by an entry point of GROUP that leads to a MeshFormat.
    Readers keep the order of vertices, by which a posed cage matches its rest cage."""

    name: str  # for messages, as "OBJ"
    endings: tuple[str, ...]  # of its files, lower case with the dot
    read: Callable[[pathlib.Path], Surface] | None = None  # raises ValueError; None for what is only written
    write: Callable[[np.ndarray, Any], bytes] | None = None  # of vertices (v, 3) float64, triangles (t, 3) int32
    up: str = "z"  # the axis that points up in its files, "z" or "y"
    object_names: Callable[[pathlib.Path], list[str]] | None = None  # of the objects in a file; None where it has one
    read_object: Callable[[pathlib.Path, str], Surface] | None = None  # one of them by its name, as `read` does
    together: bool = False  # whether all objects of a file are one mesh where none is chosen
    polygons: bool = False  # whether `write` takes tuples of the corners of faces of any number, in place of triangles


# our own parsers: mesh libraries merge, split and drop vertices, and a posed cage must match its rest cage one to one
FORMATS = (
    MeshFormat(
        "OBJ", (".obj",), read_obj, write_obj, object_names=obj_object_names, read_object=read_obj_object, polygons=True
    ),
    MeshFormat("PLY", (".ply",), read_ply, write_ply, polygons=True),
    MeshFormat("OFF", (".off",), read_off, write_off, polygons=True),
    MeshFormat("GLB", (".glb",), read_gltf, write_glb, "y", gltf_object_names, read_gltf, together=True),
    MeshFormat("glTF", (".gltf",), read_gltf, write_gltf, "y", gltf_object_names, read_gltf, together=True),
    # its reader turns what has y up by what the file says
    MeshFormat("USD", (".usd", ".usdc"), read_usd, write_usd, "z", usd_object_names, read_usd, True, True),
    MeshFormat("USDA", (".usda",), read_usd, write_usda, "z", usd_object_names, read_usd, True, True),
)

#: Endings of mesh files that are read without other packages, lower case.
ENDINGS = tuple(ending for format in FORMATS for ending in format.endings)


@functools.cache
def mesh_formats() -> tuple[MeshFormat, ...]:
    """All formats: our own first, then those of other packages, by name; an ending belongs to the first that has it."""
    return (*FORMATS, *registered_formats(GROUP, "the mesh format", _require_format))


def _require_format(format: object) -> None:
    if not isinstance(format, MeshFormat):
        raise InputError(f"it must be a warpcage.mesh.MeshFormat, got {type(format).__name__}")
    require_endings(format.endings)
    if format.up not in ("z", "y"):
        raise InputError(f"its up must be 'z' or 'y', got {format.up!r}")


def mesh_format(path: pathlib.Path, verb: str = "read") -> MeshFormat:
    """The format of a file to "read" or "write" by its ending. Raises ValueError, with what is known, where there is
    none."""
    ending = path.suffix.lower()
    # our own without a look at other packages
    formats = FORMATS if ending in ENDINGS else mesh_formats()
    found = next((format for format in formats if ending in format.endings), None)
    if found is None:
        known = list(dict.fromkeys(mesh_endings(verb)))
        seen = seen_note(path) if verb == "read" else ""
        raise InputError(f"cage file {str(path)!r} must end in {', '.join(known[:-1])} or {known[-1]}{seen}")
    if getattr(found, verb) is None:
        raise InputError(f"{str(path)!r}: {found.name} files are not {'read' if verb == 'read' else 'written'}")
    return found


def mesh_endings(verb: str = "read") -> Iterable[str]:
    """Endings of the files that can be read, or with "write" written."""
    return (ending for format in mesh_formats() if getattr(format, verb) for ending in format.endings)
