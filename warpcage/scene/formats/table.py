"""The formats of scenes in one table: the name, the test and the reader of each."""

from __future__ import annotations

import dataclasses
import functools
import pathlib
from collections.abc import Callable, Iterator
from typing import Any, cast

from ...core.checks import registered_formats, require_type, shown
from ...errors import InputError
from ..scene import Scene
from . import bundler, colmap, dtu, llff, metashape, nsvf, opensfm, phone, realityscan, transforms
from .datasets import rooms, splatting, views

#: Where other packages register a SceneFormat, in the entry points of their setup.
ENTRY_POINTS = "warpcage.scene_formats"


@dataclasses.dataclass(frozen=True)
class SceneFormat:
    """A format of scene folders, as another package registers it too: see docs/captures.md."""

    name: str  # what `load_scene(format=...)` calls it, such as "nsvf"
    mark: str  # what a folder of the format holds, for messages
    is_scene: Callable[[pathlib.Path], bool]  # whether a folder is one; quick, as every folder is asked
    # of a folder, and of split, downscale, background (3,) and masks by name, as `load_scene` has them
    read: Callable[..., Scene]
    options: tuple[str, ...] = ()  # names of other options of `load_scene` that `read` takes: "model" and "progress"
    round_bounds: bool = False  # whether bounds are those of a ball around the origin


def _read_output(folder: pathlib.Path, **options: Any) -> Scene:
    """Read a folder of 3DGS, whose pictures may be of any format."""
    return splatting.read(folder, formats=candidates(), **options)


def _with_progress(format: SceneFormat) -> SceneFormat:
    return dataclasses.replace(format, options=(*format.options, "progress"))


#: All that warpcage knows by itself, in the order in which they are tried: Nerfies before Record3D, which has a
#: metadata.json beside rgb/ too.
BUILT_IN = tuple(map(_with_progress, (
    SceneFormat("blender", transforms.BLENDER_MARK, transforms.is_blender, transforms.read_blender),
    SceneFormat("nsvf", nsvf.MARK, nsvf.is_scene, nsvf.read),
    SceneFormat("dtu", dtu.MARK, dtu.is_scene, dtu.read, round_bounds=True),
    SceneFormat("transforms", transforms.TRANSFORMS_MARK, transforms.is_transforms, transforms.read_transforms),
    SceneFormat("colmap", colmap.MARK, colmap.is_scene, colmap.read, ("model",)),
    SceneFormat("polycam", phone.POLYCAM_MARK, phone.is_polycam, phone.read_polycam),
    SceneFormat("nerfies", views.NERFIES_MARK, views.is_nerfies, views.read_nerfies),
    SceneFormat("record3d", phone.RECORD3D_MARK, phone.is_record3d, phone.read_record3d),
    SceneFormat("arkitscenes", phone.ARKITSCENES_MARK, phone.is_arkitscenes, phone.read_arkitscenes, ("model",)),
    SceneFormat("stray", phone.STRAY_MARK, phone.is_stray, phone.read_stray),
    SceneFormat("opensfm", opensfm.MARK, opensfm.is_scene, opensfm.read, ("model",)),
    SceneFormat("metashape", metashape.MARK, metashape.is_scene, metashape.read, ("model",)),
    SceneFormat("bundler", bundler.MARK, bundler.is_scene, bundler.read),
    SceneFormat("realityscan", realityscan.MARK, realityscan.is_scene, realityscan.read),
    SceneFormat("llff", llff.MARK, llff.is_scene, llff.read),
    SceneFormat("scannet", rooms.SCANNET_MARK, rooms.is_scannet, rooms.read_scannet),
    SceneFormat("replica", rooms.REPLICA_MARK, rooms.is_replica, rooms.read_replica),
    SceneFormat("blendedmvs", views.BLENDEDMVS_MARK, views.is_blendedmvs, views.read_blendedmvs),
    SceneFormat("nerfpp", views.NERFPP_MARK, views.is_nerfpp, views.read_nerfpp),
    SceneFormat(splatting.NAME, splatting.MARK, splatting.is_output, _read_output),
)))  # fmt: skip


def scene_formats() -> tuple[SceneFormat, ...]:
    """All formats: warpcage's own, then those that other packages registered."""
    return tuple(candidates())


def candidates() -> Iterator[SceneFormat]:
    """All formats one by one; those of other packages last, as to look for them takes a while."""
    yield from BUILT_IN
    yield from other_formats()


@functools.cache
def other_formats() -> tuple[SceneFormat, ...]:
    """The formats of other packages; a name belongs to the first format that has it."""
    return tuple(registered_formats(ENTRY_POINTS, "the scene format", _require_format))


def _require_format(format: object) -> None:
    require_type(format, SceneFormat, "it must be")
    name = cast(SceneFormat, format).name
    if not name or any(each.name == name for each in BUILT_IN):
        raise InputError(f"its name must be one that no other format has, got {shown(name)}")


def format_named(name: str) -> SceneFormat:
    """The format of a name; ValueError, with those that are known, for another."""
    found = next((each for each in candidates() if each.name == name), None)
    if found is None:
        known = ", ".join(each.name for each in candidates())
        raise InputError(f"scene format {shown(name)} is not known: {known}")
    return found


def format_lines() -> list[str]:
    """A line for each format: its name, and what a folder of it holds."""
    return [f"{each.name}: {each.mark}" for each in candidates()]
