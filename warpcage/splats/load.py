"""Fields of either kind from their files: voxels or splats."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TypeAlias

import warp as wp

from ..core.files import PathLike
from ..core.names import counted
from ..field.io import load_field as load_voxels
from ..field.io.field_file import FieldContents
from ..field.voxel_field import VoxelField
from .files.files import is_splat_file, read_splats
from .splat_field import SplatField

#: What a Deformer poses.
AnyField: TypeAlias = VoxelField | SplatField


def load_field(path: PathLike, *, scene_scale: float = 1.0, device: wp.DeviceLike = None) -> AnyField:
    """Read a field of voxels or of splats, which the ending tells; scene_scale as for `VoxelField.load`."""
    return read_field(path, scene_scale=scene_scale)(device)


def read_field(path: PathLike, *, scene_scale: float = 1.0) -> Callable[[wp.DeviceLike], AnyField]:
    """Read a field into the host's memory, for which no device is needed; returns what makes the field on a device.
    That may raise a ValueError of parts that do not fit."""
    if not is_splat_file(path):
        return functools.partial(_voxels_of, load_voxels(path, scene_scale=scene_scale), path)
    if scene_scale != 1.0:
        raise ValueError(f"{path} holds splats, which keep their scale: leave the scene scale out")
    splats = read_splats(path)
    return lambda device: SplatField.from_contents(splats, device=device)


def _voxels_of(contents: FieldContents, path: PathLike, device: wp.DeviceLike) -> VoxelField:
    """The field of what was read of a file, which a ValueError names."""
    try:
        return VoxelField.from_contents(contents, device)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def field_size(field: AnyField) -> str:
    """How large a field is, in words such as "12000 voxels"."""
    return counted(len(field), "splat") if isinstance(field, SplatField) else counted(field.voxel_count, "voxel")
