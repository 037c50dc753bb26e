"""Surfaces of mesh files with their colours: of vertices, of pictures on them, or one for each part."""

from __future__ import annotations

import dataclasses
import io
import pathlib
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.files import PathLike, require_file
from ..errors import InputError
from ..mesh.io import ALL_OBJECTS, ENDINGS, read_object, turned_up
from ..mesh.io.gltf import (
    errors_of_file,
    mesh_nodes,
    node_matrices,
    opened,
    placed_nodes,
    primitive_faces,
    read_buffers,
    require_room,
    surface_primitives,
    uri_bytes,
    values_of,
)
from ..mesh.io.gltf_meshes import node_points
from ..mesh.io.obj_off import read_obj, read_off
from ..mesh.io.ply import CHANNELS, ply_header, read_ply, read_ply_faces, read_ply_points
from ..mesh.polygons import concave_polygons
from ..view.exr import screen_colors
from ..view.pictures import rgba_pixels

if TYPE_CHECKING:
    import trimesh

#: Endings of the files.
SURFACE_ENDINGS = (*ENDINGS, ".stl")

#: Those that trimesh reads, with the colours and materials in and beside them.
_TRIMESH_ENDINGS = (".obj", ".ply", ".off", ".stl")

#: What a face has in place of a picture, as kernels/render/surface.py has it.
NO_PICTURE, HEADLIGHT = -1, -2

#: The colour of what has none.
GREY = (0.7, 0.7, 0.7, 1.0)


@dataclasses.dataclass(frozen=True)
class Surface:
    """Triangles, and the colours of v vertices, f faces and pictures on them: RGBA as pictures have it."""

    vertices: np.ndarray  # (v, 3) float64, z up
    faces: np.ndarray  # (f, 3) int32
    colors: np.ndarray  # (v, 4) float32 in [0, 1], which pictures are multiplied by
    uv: np.ndarray  # (v, 2) float32 places in the pictures, 0 to 1 from the upper left corner
    face_pictures: np.ndarray  # (f,) int32 number of a picture, NO_PICTURE or HEADLIGHT
    pictures: Sequence[np.ndarray] = ()  # (h, w, 4) uint8 each


def plain_surface(vertices: np.ndarray, faces: np.ndarray, color: Any = GREY, look: int = HEADLIGHT) -> Surface:
    """Triangles of one colour (4,)."""
    colors = np.tile(np.asarray(color, np.float32), (len(vertices), 1))
    uv, looks = np.zeros((len(vertices), 2), np.float32), np.full(len(faces), look, np.int32)
    return Surface(np.asarray(vertices, np.float64), np.asarray(faces, np.int32), colors, uv, looks)


def read_surface(path: PathLike) -> Surface:
    """The triangles of a mesh file with their colours; what has y up is turned to z."""
    path = require_file(path, "mesh file")
    ending = path.suffix.lower()
    if ending in (".glb", ".gltf"):
        surface = _gltf_surface(path)
    elif ending == ".ply" and _has_face_colors(path):
        surface = _face_colored_surface(path)
    elif ending in _TRIMESH_ENDINGS:
        mesh: Any = load_trimesh(path)
        surface = _trimesh_surface(mesh)
        if ending == ".ply" and mesh.visual.kind == "vertex":
            _set_ply_colors(path, surface.colors)
    else:
        found = read_object(path, object=ALL_OBJECTS)
        surface = plain_surface(found.vertices, found.faces)
    count, named = len(surface.vertices), surface.faces
    if named.min() < 0 or named.max() >= count:
        raise InputError(f"{path}: its faces name vertices {named.min()} to {named.max()} of 0 to {count - 1}")
    if not np.isfinite(surface.vertices[named.reshape(-1)]).all():
        raise InputError(f"{path}: a vertex of its faces is not finite")
    uv, colors = (np.where(np.isfinite(each), each, np.float32(0.0)) for each in (surface.uv, surface.colors))
    return dataclasses.replace(surface, uv=uv, colors=colors)  # kernels take texels by them


# -- What trimesh reads


def load_trimesh(path: pathlib.Path) -> trimesh.Trimesh:
    """A mesh file as trimesh reads it, vertices in their order. Raises ValueError for one without triangles."""
    import trimesh
    from trimesh.resolvers import FilePathResolver

    text = _cut_obj(path) if path.suffix.lower() == ".obj" else None
    source: Any = path if text is None else io.BytesIO(text)
    options: dict[str, Any] = {} if text is None else {"file_type": "obj", "resolver": FilePathResolver(str(path))}
    try:
        mesh: Any = trimesh.load(source, force="mesh", process=False, maintain_order=True, **options)
    except Exception as error:
        raise InputError(f"{path} cannot be read as a mesh, it is cut off or damaged: {error}") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        if path.suffix.lower() == ".ply":
            read_object(path)  # which raises for points without faces
        raise InputError(f"{path} holds no triangles")
    visual: Any = mesh.visual
    if path.suffix.lower() in (".ply", ".off") and visual.kind in (None, "vertex"):
        _cut_faces(path, mesh)
    return mesh


# -- Concave polygons, which trimesh 5.2 takes for fans


#: Bytes in which the header of a PLY file ends.
_HEADER_ROOM = 1 << 20


def _cut_obj(path: pathlib.Path) -> bytes | None:
    """The text of an OBJ file with triangles in place of its concave faces; None where it has none."""
    data = path.read_bytes()
    if not re.search(rb"^[ \t]*f([ \t]+[-\d/]+){4}|\\[ \t]*\r?$", data, re.MULTILINE):
        return None
    vertices, polygons = read_obj(path)
    cuts = concave_polygons(vertices, [polygon for _, polygon in polygons])
    if not cuts:
        return None
    lines = data.decode("utf-8-sig", errors="surrogateescape").splitlines()
    for number, triangles in cuts.items():
        last = int(polygons[number][0])
        first = last
        while first > 1 and lines[first - 2].split("#")[0].rstrip().endswith("\\"):  # which joins lines
            first -= 1
        joined = " ".join(line.split("#")[0].rstrip().removesuffix("\\") for line in lines[first - 1 : last])
        corners = joined.split()[1:]
        lines[first - 1 : last] = [""] * (last - first) + [
            "\n".join("f " + " ".join(corners[k] for k in each) for each in triangles)
        ]
    return ("\n".join(lines) + "\n").encode("utf-8", errors="surrogateescape")


def _cut_faces(path: pathlib.Path, mesh: trimesh.Trimesh) -> None:
    """Cut the concave faces of a mesh of a PLY or OFF file as those of cages are."""
    is_ply = path.suffix.lower() == ".ply"
    if is_ply and _ply_element(path, "face")[0] == len(mesh.faces):
        return  # triangles
    vertices, rows = read_ply(path, joined=False) if is_ply else read_off(path)
    polygons = [polygon for _, polygon in rows]
    cuts = concave_polygons(vertices, polygons)
    if cuts:
        fans = {number: [(0, k, k + 1) for k in range(1, len(polygon) - 1)] for number, polygon in enumerate(polygons)}
        mesh.faces = [[polygons[n][k] for k in each] for n, triangles in (fans | cuts).items() for each in triangles]


def _set_ply_colors(path: pathlib.Path, colors: np.ndarray) -> None:
    """Put the colours of a PLY file into those (v, 4) that trimesh gives, where they are no bytes."""
    # trimesh 5.2 keeps the low byte of 16-bit ones, and takes all floats from 1 on for white
    kinds = dict(_ply_element(path, "vertex")[1])
    channels = _ply_channels(kinds)
    if set(channels) <= set(kinds) and {kinds[name] for name in channels} != {"u1"}:
        colors[:, : len(channels)] = read_ply_points(path, channels)[1]


def _has_face_colors(path: pathlib.Path) -> bool:
    """Whether the faces of a PLY file have colours, and neither its vertices nor a picture have."""
    vertex, face = (dict(_ply_element(path, name)[1]) for name in ("vertex", "face"))
    return set(CHANNELS) <= set(face) and not set(CHANNELS) <= set(vertex) and "texcoord" not in face


def _face_colored_surface(path: pathlib.Path) -> Surface:
    """A PLY file with colours of faces, which trimesh 5.2 refuses where they are no triangles: a vertex a corner."""
    found = read_object(path)
    _, polygons, colors = read_ply_faces(path, _ply_channels(dict(_ply_element(path, "face")[1])))
    assert colors is not None
    places = found.vertices[found.faces].reshape(-1, 3)
    made = plain_surface(places, np.arange(len(places)).reshape(-1, 3), np.ones(4), NO_PICTURE)
    made.colors[:, : colors.shape[1]] = np.repeat(colors, [3 * (len(polygon) - 2) for _, polygon in polygons], axis=0)
    return made


def _ply_channels(kinds: Mapping[str, Any]) -> tuple[str, ...]:
    """Which properties of an element of a PLY file are its colour, and opacity where it has that."""
    return (*CHANNELS, "alpha")[: 4 if "alpha" in kinds else 3]


def _ply_element(path: pathlib.Path, name: str) -> tuple[int, list[tuple[str, Any]]]:
    """How many there are of an element of a PLY file, and its properties; none where it has no such."""
    with path.open("rb") as file:
        elements = ply_header(path, file.read(_HEADER_ROOM))[1]
    found = {element: (count, properties) for element, count, properties in elements}
    return found.get(name, (0, []))


def _trimesh_surface(mesh: trimesh.Trimesh) -> Surface:
    """A mesh of trimesh with its colours."""
    visual: Any = mesh.visual
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32)
    if visual.kind == "face":  # a vertex for each corner
        colors = np.repeat(np.asarray(visual.face_colors), 3, axis=0)
        made = plain_surface(vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3), look=NO_PICTURE)
        return dataclasses.replace(made, colors=colors.astype(np.float32) / 255.0)
    if visual.kind == "vertex":
        colors = np.asarray(visual.vertex_colors).astype(np.float32) / 255.0
        return dataclasses.replace(plain_surface(vertices, faces, look=NO_PICTURE), colors=colors)
    if visual.kind != "texture":
        return plain_surface(vertices, faces)
    material = visual.material
    picture = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
    if picture is None or visual.uv is None:
        return plain_surface(vertices, faces, np.asarray(material.main_color, np.float32) / 255.0)
    made = plain_surface(vertices, faces, np.ones(4), look=0)
    uv = np.asarray(visual.uv, np.float32) * [1.0, -1.0] + [0.0, 1.0]  # from the lower left corner
    return dataclasses.replace(made, uv=uv.astype(np.float32), pictures=[np.asarray(picture.convert("RGBA"))])


# -- glTF, whose colours of vertices trimesh takes for those of pictures


def _gltf_surface(path: pathlib.Path) -> Surface:
    """All surfaces of the scene of a glTF file, each with its material."""
    with errors_of_file(path):
        document, chunk = opened(path)
        require_room(document, mesh_nodes(document))
        buffers, matrices = read_buffers(path, document, chunk), node_matrices(document)
        pictures: dict[tuple, int] = {}  # numbers of ours by those of the file, and what is left of their opacity
        parts = [
            _gltf_part(document, buffers, primitive, points[primitive["attributes"]["POSITION"]], pictures)
            for node, _ in placed_nodes(document)
            for points in [node_points(document, buffers, node, matrices)]
            for primitive in surface_primitives(document["meshes"][document["nodes"][node]["mesh"]])
        ]
        if not any(len(part.faces) for part in parts):
            raise InputError(f"{path}: no faces in it")
        starts = np.cumsum([0, *(len(part.vertices) for part in parts)])[:-1]
        names = ("vertices", "faces", "colors", "uv", "face_pictures")
        joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        counts = [len(part.faces) for part in parts]
        joined["faces"] += np.repeat(starts, counts)[:, None].astype(np.int32)
        joined["vertices"] = turned_up(joined["vertices"], "y", "z")
        return Surface(**joined, pictures=[_gltf_picture(path, document, buffers, *key) for key in pictures])


def _gltf_part(
    document: dict, buffers: list[bytes], primitive: dict, points: np.ndarray, pictures: dict[tuple, int]
) -> Surface:
    """A primitive whose vertices are at points (v, 3)."""
    attributes, faces = primitive["attributes"], primitive_faces(document, buffers, primitive)
    material = document["materials"][primitive["material"]] if "material" in primitive else {}
    metal, mode = material.get("pbrMetallicRoughness", {}), material.get("alphaMode", "OPAQUE")
    light = np.tile(np.asarray(metal.get("baseColorFactor", np.ones(4)), np.float64), (len(points), 1))
    look = NO_PICTURE if "KHR_materials_unlit" in material.get("extensions", {}) else HEADLIGHT
    if "COLOR_0" in attributes:
        factors, look = _shares(values_of(document, buffers, attributes["COLOR_0"])), NO_PICTURE
        light[:, : factors.shape[1]] *= factors
    elif "baseColorFactor" not in metal and "baseColorTexture" not in metal:
        light[:] = (0.448, 0.448, 0.448, 1.0)  # GREY
    # colours are of light, those of pictures are not: of their powers products are the same
    colors = np.clip(np.concatenate([screen_colors(np.maximum(light[:, :3], 0.0)), light[:, 3:]], axis=1), 0.0, 1.0)
    if mode == "OPAQUE":
        colors[:, 3] = 1.0
    uv, texture = np.zeros((len(points), 2)), metal.get("baseColorTexture")
    places = "" if texture is None else f"TEXCOORD_{texture.get('texCoord', 0)}"
    if texture is not None and places in attributes:
        uv = _shares(values_of(document, buffers, attributes[places]))
        cutoff = material.get("alphaCutoff", 0.5) if mode == "MASK" else None
        look = pictures.setdefault((texture["index"], mode, cutoff), len(pictures))
    made = plain_surface(points, faces, look=look)
    return dataclasses.replace(made, colors=colors.astype(np.float32), uv=uv.astype(np.float32))


def _shares(values: np.ndarray) -> np.ndarray:
    """Numbers of a file as floats: whole ones are shares of the largest."""
    return values.astype(np.float64) / (1.0 if values.dtype.kind == "f" else np.iinfo(values.dtype).max)


def _gltf_picture(
    path: pathlib.Path, document: dict, buffers: list[bytes], number: int, mode: str, cutoff: float | None
) -> np.ndarray:
    """The pixels (h, w, 4) uint8 of a texture; their opacity as the material takes it."""
    texture = document["textures"][number]
    source = texture.get("source", texture.get("extensions", {}).get("EXT_texture_webp", {}).get("source"))
    if source is None:
        raise InputError(f"its texture {number} has no picture that can be read here: export it with PNG or JPEG")
    image = document["images"][source]
    if "uri" in image:
        data = uri_bytes(path, image["uri"], "picture")
    else:
        view = document["bufferViews"][image["bufferView"]]
        begin = view.get("byteOffset", 0)
        data = buffers[view["buffer"]][begin : begin + view["byteLength"]]
    pixels = rgba_pixels(data, f"{path}, picture {source}").copy()
    if mode == "OPAQUE":
        pixels[..., 3] = 255
    elif cutoff is not None:
        pixels[..., 3] = np.where(pixels[..., 3] >= 255.0 * cutoff, 255, 0)
    return pixels
