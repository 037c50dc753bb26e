"""Stage files: the objects of a scene, where they stand, their cages and poses, and their files."""

from __future__ import annotations

import itertools
import json
import os
import pathlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ..cage.cage import Cage
from ..core.files import DAMAGED, PathLike, atomic_path, damage, errors_of, read_document, require_file
from ..core.names import renamed_keys
from ..core.spec import Checker, anything, checked_keys
from ..errors import InputError
from .edits import CageEdit, edit_from_spec, edit_spec
from .place import PlaceFile
from .spec import EditSpec

#: Version 1 has another key for "objects", which is read too.
_FORMAT, _VERSION = "warpcage stage", 2

#: How a stage file ends.
STAGE_ENDING = ".stage.json"

#: Keys of an object, and options of Deformers that the file keeps.
_OBJECT: dict[str, Checker] = dict.fromkeys(("name", "field", "place", "hidden", "deformation"), anything)
_OPTIONS: dict[str, Checker] = dict.fromkeys(("coordinates", "resolution", "density", "store", "map"), anything)


def is_stage(path: PathLike) -> bool:
    """Whether a file is that of a stage, by its ending."""
    return os.fspath(path).lower().endswith(STAGE_ENDING)


def free_name(name: str, taken: Collection[str]) -> str:
    """A name that is not taken: the same, or with the first number from 2 that makes it one."""
    names = itertools.chain([name], (f"{name} {number}" for number in itertools.count(2)))
    return next(each for each in names if each not in taken)


def write_stage_file(path: pathlib.Path, objects: Iterable[Mapping[str, Any]]) -> None:
    """Write objects, as JSON has them, a line each, to be read and changed; whole or not at all."""
    if not is_stage(path):
        raise InputError(f"a scene file ends in {STAGE_ENDING}, got {path.name!r}")
    lines = [json.dumps(scene_object) for scene_object in objects]
    if not lines:
        raise InputError("an empty scene is not written: add an object first")
    head = f'{{"format": "{_FORMAT}", "version": {_VERSION}, "objects": [\n '
    with atomic_path(path) as temporary:
        temporary.write_text(head + ",\n ".join(lines) + "]}\n", encoding="utf-8")


def read_stage_file(path: PathLike) -> list[dict[str, Any]]:
    """The objects of a stage file, with a PlaceFile each as "place"; no field is read."""
    path = require_file(path, "scene file")
    with errors_of(path, "scene file"):
        content = read_document(path, "scene file", _FORMAT, _VERSION)
        objects = renamed_keys(content, {"objects": "things"}).get("objects")
        if not isinstance(objects, list) or not objects or not all(isinstance(each, dict) for each in objects):
            raise InputError("'objects' must be a list of at least one object")
        entries = [checked_keys(each, _OBJECT, f"object {number}") for number, each in enumerate(objects, 1)]
        for number, entry in enumerate(entries, 1):
            for key in ("name", "field"):
                if not isinstance(entry.get(key), str) or not entry[key].strip():
                    raise InputError(f"object {number} needs a {key}")
            entry["place"] = PlaceFile.from_json(entry.get("place", {}))
        return entries


def deformation_json(
    options: Mapping[str, Any], edits: Sequence[CageEdit], poses: Sequence[Cage | None]
) -> dict[str, Any]:
    """The options of a Deformer, its edits and their poses, as the file has them."""
    specs = []
    for edit, posed in zip(edits, poses, strict=True):
        cage = {"vertices": edit.cage.vertices.tolist(), "faces": [list(face) for face in edit.cage.polygons]}
        specs.append(edit_spec(edit, cage, None if posed is None else posed.vertices.tolist()))
    return {**options, "edits": [each.to_json() for each in specs]}


def read_deformation(content: Any) -> tuple[dict[str, Any], list[CageEdit], list[Cage | None]]:
    """Options, edits and poses of what `deformation_json` made."""
    try:
        options = {name: value for name, value in content.items() if name != "edits"}
        specs = [EditSpec.from_json(entry, f"edit {number}") for number, entry in enumerate(content["edits"], 1)]
        checked_keys(options, _OPTIONS, "it")
        edits = [edit_from_spec(each, Cage(each.cage["vertices"], each.cage["faces"])) for each in specs]
        poses = [
            None if each.posed is None else edit.cage.with_vertices(np.asarray(each.posed))
            for edit, each in zip(edits, specs, strict=True)
        ]
        return options, edits, poses
    except DAMAGED as error:
        raise InputError(damage("scene file", error)) from None
