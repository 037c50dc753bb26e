"""Light meshes of a field's surface with its colours in a picture: simplified, unwrapped and painted from the field."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.names import counted, extra_line
from ..errors import InputError, MissingPackageError
from ..mesh.io.gltf import Texture, middle_of
from ..view.pictures import PictureCuts, png_bytes
from .surface import ColorField, surface_colors

if TYPE_CHECKING:
    import trimesh

#: Pairs of faces and texels, and points, that are looked at together.
PAIRS, POINTS = 2_000_000, 500_000

#: Texels between parts of a picture, so that none shines through at the rim of another.
PADDING = 2


def _library(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingPackageError(f"light meshes need {name}: {extra_line('texture')}") from error


def simplified(mesh: trimesh.Trimesh, face_count: int) -> trimesh.Trimesh:
    """A mesh with about so many faces, by quadric errors (Garland and Heckbert 1997), or this one if it has no more."""
    import trimesh

    if len(mesh.faces) <= face_count:
        return mesh
    # around the origin, where float32 is fine, and of size 1: the library's bounds on errors are in the unit of length
    middle, size = middle_of(np.asarray(mesh.vertices)), float(mesh.extents.max())
    points = ((np.asarray(mesh.vertices) - middle) / size).astype(np.float32)
    faces = np.asarray(mesh.faces, np.int32)
    vertices, faces = _library("fast_simplification").simplify(points, faces, target_count=face_count, agg=5)
    faces = _without_flaps(faces)
    light = trimesh.Trimesh(size * vertices.astype(np.float64) + middle, faces, process=False)
    light.remove_unreferenced_vertices()
    return light


def _without_flaps(faces: np.ndarray) -> np.ndarray:
    """Faces without pairs that lie on one another and look apart: they enclose nothing, and have no normal."""
    _, number, counts = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True)
    return faces[counts[number.reshape(-1)] == 1]


def textured(
    field: ColorField, vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray, Texture]:
    """Vertices (v, 3) with unit normals and faces unwrapped: which vertex each new one is, new faces, and the picture,
    size x size texels with the colours that `surface_colors` finds."""
    xatlas = _library("xatlas")
    atlas, packing = xatlas.Atlas(), xatlas.PackOptions()
    packing.resolution, packing.padding = size, PADDING
    points = (vertices - middle_of(vertices)).astype(np.float32)
    atlas.add_mesh(points, faces.astype(np.uint32), normals.astype(np.float32))
    atlas.generate(pack_options=packing)
    origin, faces, places = atlas[0]
    origin, faces = origin.astype(np.int64), faces.astype(np.int64)
    face, shares = _faces_of_texels(places[faces] * size, size)
    seen = np.flatnonzero(face >= 0)
    if not len(seen):
        raise InputError(f"{size} texels a side are too few for {counted(len(faces), 'face')}: take a larger picture")
    corners = origin[faces]
    colors, cuts = np.empty((len(seen), 3), np.float32), PictureCuts()
    for part in np.split(np.arange(len(seen)), range(POINTS, len(seen), POINTS)):
        own, share = corners[face[seen[part]]], shares[seen[part], :, None]
        along = (share * normals[own]).sum(axis=1)
        along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
        colors[part] = surface_colors(field, (share * vertices[own]).sum(axis=1), along, cuts)
    cuts.warn("the texture")
    picture = _filled(seen, colors, size)
    return origin, faces, Texture(places.astype(np.float64), normals[origin], png_bytes(picture))


def _faces_of_texels(corners: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """The face (size^2,) over the middle of each texel, -1 where there is none, and its corners' shares (size^2, 3).
    corners: (f, 3, 2) columns and rows of the faces' corners, texels."""
    face, shares = np.full(size * size, -1), np.zeros((size * size, 3))
    low = np.clip(np.floor(corners.min(axis=1) - 0.5), 0, size - 1).astype(np.int64)
    high = np.clip(np.ceil(corners.max(axis=1) - 0.5), 0, size - 1).astype(np.int64)
    spans = high - low + 1
    counts = spans.prod(axis=1)
    ends = np.cumsum(counts)
    first = 0
    while first < len(counts):
        last = max(first + 1, int(np.searchsorted(ends, ends[first] - counts[first] + PAIRS, side="right")))
        own = np.repeat(np.arange(first, last), counts[first:last])
        before = ends - counts
        step = np.arange(before[first], ends[last - 1]) - before[own]
        column, row = low[own, 0] + step % spans[own, 0], low[own, 1] + step // spans[own, 0]
        a, b, c = np.moveaxis(corners[own], 1, 0)
        point = np.stack([column, row], axis=1) + 0.5
        one, two, three = (_area(p, q, point) for p, q in ((b, c), (c, a), (a, b)))
        whole = one + two + three
        with np.errstate(divide="ignore", invalid="ignore"):
            found = np.stack([one, two, three], axis=1) / whole[:, None]
        inside = (found >= 0.0).all(axis=1)  # NaN of faces without an area is not
        texel = (row * size + column)[inside]
        face[texel], shares[texel] = own[inside], found[inside]
        first = last
    return face, shares


def _area(p: np.ndarray, q: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Twice the signed area of triangles (n, 2) each."""
    return (q[:, 0] - p[:, 0]) * (r[:, 1] - p[:, 1]) - (q[:, 1] - p[:, 1]) * (r[:, 0] - p[:, 0])


def _filled(seen: np.ndarray, colors: np.ndarray, size: int) -> np.ndarray:
    """(size, size, 3) colours of texels that are seen, those beside them carried on so that no rim shows."""
    import scipy.ndimage

    number = np.full(size * size, -1)
    number[seen] = np.arange(len(seen))
    number = number.reshape(size, size)
    nearest = np.asarray(scipy.ndimage.distance_transform_edt(number < 0, return_distances=False, return_indices=True))
    return colors[number[nearest[0], nearest[1]]]
