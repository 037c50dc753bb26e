"""Records of a data set: what is kept of a frame beside its picture, and transforms.json over them."""

from __future__ import annotations

import array
import json
import pathlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from ..cage.cage import Cage
from ..core.files import PathLike, atomic_path
from ..scene.formats.parsing import TO_OPENCV
from ..view.camera import Camera, CameraKey, camera_json
from .items import TRANSFORMS, FrameItem
from .job_file import JobFile
from .manifest import DONE


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
        edits.append(words | {"pose_vertices": 0 if cage is None else len(cage.vertices)})  # rows in the pose's array
    record: dict[str, Any] = {
        "id": item.id,
        "field": item.field,
        "camera": camera_json(CameraKey(camera)),  # OpenCV axes
        "transform_matrix": (camera.camera_to_world @ TO_OPENCV).tolist(),  # of NeRF-synthetic: +y up, -z forward
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


#: What frames call the parts of a record.
_WORDS = {"depth": "depth_path", "alpha": "alpha_path", "pose": "pose_path", "record": "record_path"}


class Manifested(Protocol):
    """What knows which items of a run are done: `batch.manifest.Manifest`."""

    def find(self, item_id: str) -> Mapping[str, Any] | None:
        """The record of an item; None where there is none."""
        ...


def finish_folder(out: PathLike, job: JobFile, manifest: Manifested) -> list[pathlib.Path]:
    """Write transforms.json for the pictures of a run: one for all, and one in each folder of pictures for those in it.
    manifest: which items are done, others are left out. Returns the files; none where no item is done."""
    # Ids as of `warpcage sweep`, pose_000012/camera_003, put the pictures of one pose into a folder, a scene of its
    # own. Intrinsics are those of the first frame, a frame with others has its own. Frames are read one after another.
    out = pathlib.Path(out)
    folders: dict[str, array.array[int]] = {}
    everything = array.array("q")
    for index, item in enumerate(job.items()):
        found = manifest.find(item.id) if isinstance(item, FrameItem) and "record" in item.outputs else None
        if found is not None and found["state"] == DONE:
            everything.append(index)
            folders.setdefault(_folder(item.outputs["rgb"]), array.array("q")).append(index)
    if not everything:
        return []
    parts = {folder: indices for folder, indices in folders.items() if folder != "."}
    written = [_write(out, ".", _frames(out, ".", job, everything))]
    return written + [_write(out, folder, _frames(out, folder, job, indices)) for folder, indices in parts.items()]


def _folder(path: str) -> str:
    return pathlib.PurePosixPath(path).parent.as_posix()


def _frames(
    out: pathlib.Path, folder: str, job: JobFile, indices: Iterable[int]
) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """Intrinsics and frame of each item, its paths below a folder."""
    for index in indices:
        item = job.item(index)
        record = json.loads((out / item.outputs["record"]).read_text(encoding="utf-8"))
        frame = {
            "file_path": f"./{beside(item.outputs['rgb'], folder)}",
            "transform_matrix": record["transform_matrix"],  # camera to world, +y up, -z forward
        }
        frame |= {_WORDS[part]: f"./{beside(item.outputs[part], folder)}" for part in _WORDS if part in item.outputs}
        posed = [edit["posed"] for edit in record.get("edits", ()) if "posed" in edit]
        frame |= {"id": item.id, "posed": posed}
        yield camera_words(record["camera"]), frame if item.extra is None else frame | {"extra": item.extra}


def _write(out: pathlib.Path, folder: str, frames: Iterator[tuple[dict[str, Any], dict[str, Any]]]) -> pathlib.Path:
    path = out / folder / TRANSFORMS
    usual: dict[str, Any] | None = None
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as file:
        for intrinsics, frame in frames:
            if usual is None:
                usual = intrinsics
                file.write(json.dumps(usual)[:-1] + ', "frames": [\n')
            else:
                file.write(",\n")
            own = {} if intrinsics == usual else intrinsics
            file.write(json.dumps(frame | own, ensure_ascii=False))
        file.write("\n]}\n")
    return path
