"""Fields as volumes for other programs: NanoVDB (.nvdb) by Warp, OpenVDB (.vdb) where its Python module is there."""

from __future__ import annotations

import dataclasses
import importlib
import pathlib
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from ...errors import InputError, MissingPackageError, StateError
from ...view.exr import linear_light
from .field_file import Y0, FieldContents, rgb_harmonics

#: Voxels along a side of a tile, the least part of a volume that is held.
_SIDE = 8


@dataclasses.dataclass(frozen=True)
class _Tiles:
    """The voxels that are not empty, in tiles of 8 x 8 x 8."""

    origins: np.ndarray  # (n, 3) int32, the first voxel of each
    density: np.ndarray  # (n, 8, 8, 8) float32 per world unit
    color: np.ndarray  # (n, 8, 8, 8, 3) float32, linear light
    voxel_size: np.ndarray  # (3,) float64, world units
    first: np.ndarray  # (3,) float64, world units, the middle of voxel (0, 0, 0)


def write_volume(path: pathlib.Path, field: FieldContents) -> None:
    """Write grids "density", per world unit, and "color", that of all directions, in the world of the field."""
    WRITERS[path.suffix.lower()](path, _tiles(field))


def _tiles(field: FieldContents) -> _Tiles:
    shape = np.array(field.links.shape)
    places = np.argwhere(field.links >= 0)
    rows = field.links[tuple(places.T)]
    seen = field.density[rows] > 0.0
    places, rows = places[seen], rows[seen]
    if not len(rows):
        raise InputError("the field is empty: it has no density above 0")
    counts = -(-shape // _SIDE)
    numbers, tile = np.unique(np.ravel_multi_index(tuple((places // _SIDE).T), tuple(counts)), return_inverse=True)
    inside = (tile.reshape(-1), *(places % _SIDE).T)
    density = np.zeros((len(numbers), _SIDE, _SIDE, _SIDE), np.float32)
    density[inside] = field.density[rows]
    color = np.zeros((*density.shape, 3), np.float32)
    color[inside] = linear_light(Y0 * np.asarray(rgb_harmonics(field.sh[rows]), np.float32)[:, 0, :] + 0.5)
    voxel_size = (field.bounds[1] - field.bounds[0]) / shape
    origins = _SIDE * np.stack(np.unravel_index(numbers, tuple(counts)), axis=1).astype(np.int32)
    return _Tiles(origins, density, color, voxel_size, field.bounds[0] + 0.5 * voxel_size)


# -- NanoVDB

#: Of a grid's bytes (NanoVDB 32): its number and count, its name; the tree behind them, with the place of its leaves
#: from there and their count.
_NUMBER, _NAME, _TREE, _LEAF_COUNT = 24, 40, 672, 32

#: Bytes of a leaf of 512 numbers, or of 512 vectors of 3, which its values end.
_LEAF_BYTES = {1: 2144, 3: 6272}


def _write_nanovdb(path: pathlib.Path, tiles: _Tiles) -> None:
    grids = (("density", tiles.density, 0.0), ("color", tiles.color, wp.vec3(0.0, 0.0, 0.0)))
    parts = []
    for number, (name, values, background) in enumerate(grids):
        part = _nanovdb_grid(tiles, values, background)
        part[_NUMBER : _NUMBER + 8] = np.array([number, len(grids)], "<u4").view(np.uint8)
        part[_NAME : _NAME + len(name)] = np.frombuffer(name.encode(), np.uint8)
        parts.append(part)
    wp.Volume(wp.array(np.concatenate(parts), dtype=wp.uint8, device="cpu")).save_to_nvdb(str(path))


def _nanovdb_grid(tiles: _Tiles, values: np.ndarray, background: Any) -> np.ndarray:
    """The bytes of a grid."""
    points = wp.array(tiles.origins, dtype=wp.int32, device="cpu")
    volume = wp.Volume.allocate_by_tiles(
        points,
        voxel_size=tuple(tiles.voxel_size.tolist()),
        bg_value=background,
        translation=tuple(tiles.first.tolist()),
        device="cpu",
    )
    data = np.array(volume.array().numpy())
    width = values[0, 0, 0, 0].size
    begin, size = _TREE + int(data[_TREE : _TREE + 8].view("<i8")[0]), _LEAF_BYTES[width]
    count = int(data[_TREE + _LEAF_COUNT : _TREE + _LEAF_COUNT + 4].view("<u4")[0])
    if count != len(tiles.origins) or begin + count * size != len(data):
        raise StateError("this Warp lays NanoVDB out in another way than is known: write .vdb, or take Warp 1.19")
    leaves = data[begin:].reshape(count, size)
    origins = np.ascontiguousarray(leaves[:, :12]).view("<i4")
    order = np.empty(count, np.int64)
    order[np.lexsort(origins.T)] = np.lexsort(tiles.origins.T)  # leaves lie in an order of their own
    leaves[:, size - 4 * width * _SIDE**3 :] = values[order].reshape(count, -1).view(np.uint8)
    return data


# -- OpenVDB


def _write_openvdb(path: pathlib.Path, tiles: _Tiles) -> None:
    vdb = _openvdb()
    matrix = np.diag([*tiles.voxel_size, 1.0])
    matrix[3, :3] = tiles.first
    grids = []
    for name, values, grid in (("density", tiles.density, vdb.FloatGrid()), ("color", tiles.color, vdb.Vec3SGrid())):
        grid.name, grid.transform = name, vdb.createLinearTransform(matrix.tolist())
        for origin, block in zip(tiles.origins.tolist(), values, strict=True):
            grid.copyFromArray(block, ijk=tuple(origin))
        grids.append(grid)
    grids[0].gridClass = vdb.GridClass.FOG_VOLUME
    vdb.write(str(path), grids=grids)


def _openvdb() -> Any:
    for name in ("openvdb", "pyopenvdb"):
        try:
            return importlib.import_module(name)
        except ImportError:
            continue
    raise MissingPackageError(
        "OpenVDB needs its Python module, which PyPI does not have: conda install -c conda-forge openvdb, or take "
        "Blender's (docs/blender.md); NanoVDB (.nvdb) needs none"
    )


#: What writes a volume, by the ending of its file.
WRITERS: dict[str, Callable[[pathlib.Path, _Tiles], None]] = {".nvdb": _write_nanovdb, ".vdb": _write_openvdb}
