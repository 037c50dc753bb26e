"""Records: what a data set keeps of each frame: picture, depth, opacity, pose of the cage, camera, and its origin."""

from __future__ import annotations

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..cage.cage import Cage
from ..core.checks import shown
from ..scene.formats.parsing import TO_OPENCV
from ..view.camera import Camera, CameraKey, camera_json
from .items import ID, FrameItem, Item

#: Kinds of records, as "records" of a job's header has them.
FOLDER, WEBDATASET = "folder", "webdataset"

#: What lists the frames of a folder.
TRANSFORMS = "transforms.json"

#: Items of a shard where the header does not say.
ITEMS_PER_SHARD = 1000

#: Endings of the parts of a record after an item's id.
POSE_ENDING, DEPTH_ENDING, ALPHA_ENDING, RECORD_ENDING = ".pose.npy", ".depth.npy", ".alpha.png", ".json"


def record_outputs(records: Mapping[str, Any]) -> dict[str, str]:
    """The files of each item of a job with records: names by part, with `{id}` where the item's id goes."""
    outputs = {"rgb": f"{ID}.{records.get('image', 'png')}"}
    if records.get("depth", True):
        outputs["depth"] = ID + DEPTH_ENDING
    if records.get("alpha", True):
        outputs["alpha"] = ID + ALPHA_ENDING
    return outputs | {"pose": ID + POSE_ENDING, "record": ID + RECORD_ENDING}


def require_frame(entry: Mapping[str, Any], defaults: Mapping[str, Any]) -> None:
    """Refuse a line of a job with records that is no frame: a ValueError. defaults: "defaults" of the header."""
    kind = entry.get("kind") or defaults.get("kind") or FrameItem.kind
    if kind != FrameItem.kind:
        raise ValueError(f"'records' are of frames: an item of kind {shown(kind)} belongs into another job")


def require_recordable(entry: Mapping[str, Any], item: Item, records: Mapping[str, Any]) -> None:
    """Refuse a frame that cannot be a record: with outputs of its own, or an id that a data set would cut or has
    itself."""
    expected = {part: path.replace(ID, item.id) for part, path in record_outputs(records).items()}
    if entry.get("outputs") is not None and item.outputs != expected:
        raise ValueError("'records' of the header say what is written: leave 'outputs' out")
    name = item.id.rpartition("/")[2]
    if records["kind"] == FOLDER and name + RECORD_ENDING == TRANSFORMS:
        raise ValueError(f"a folder of records has a {TRANSFORMS} of its own: call it something else")
    if records["kind"] == WEBDATASET and "." in name:
        raise ValueError(f"a WebDataset cuts names at their first dot: call it {name.replace('.', '_')!r}")


def pose_array(posed: Sequence[Cage | None]) -> np.ndarray:
    """Vertices (v, 3) float64, world units, of the posed cages of a frame, one edit after the other; None: one that
    removes."""
    return np.concatenate([np.zeros((0, 3)), *(cage.vertices for cage in posed if cage is not None)])


def frame_record(item: FrameItem, camera: Camera, posed: Sequence[Cage | None]) -> dict[str, Any]:
    """What is written beside a picture, JSON; posed: the cage of each edit, None for one that removes."""
    edits = []
    for edit, cage in zip(item.edits, posed, strict=True):
        words = edit.to_json()
        if isinstance(words.get("posed"), list):
            del words["posed"]  # numbers, which the pose's own file has
        # the number of rows that the edit has in the pose's array
        edits.append(words | {"pose_vertices": 0 if cage is None else len(cage.vertices)})
    record: dict[str, Any] = {
        "id": item.id,
        "field": item.field,
        # as camera files have it (OpenCV axes), and as NeRF-synthetic scenes have it (+y up, -z forward)
        "camera": camera_json(CameraKey(camera)),
        "transform_matrix": (camera.camera_to_world @ TO_OPENCV).tolist(),
        "background": item.background,
    }
    if edits:
        record |= {"coordinates": item.coordinates, "density": item.density, "edits": edits}
    return record if item.extra is None else record | {"extra": item.extra}


def camera_words(camera: Mapping[str, Any]) -> dict[str, Any]:
    """The intrinsics of a record's camera as transforms.json has them; pixels, and radians for the angle of view."""
    width, height, fx, fy = camera["width"], camera["height"], camera["fx"], camera["fy"]
    angle = 2.0 * np.arctan(0.5 * width / fx)
    return {"camera_angle_x": float(angle), "w": width, "h": height, "fl_x": fx, "fl_y": fy} | {
        name: camera[name] for name in ("cx", "cy")
    }


def beside(path: str, folder: str) -> str:
    """A path below the folder of a run as one below a folder in it."""
    return pathlib.PurePosixPath(path).relative_to(folder).as_posix()
