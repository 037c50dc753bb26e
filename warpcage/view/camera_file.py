"""Files of cameras as plain entries: JSON of our own, and glTF as Blender and other programs export it."""

from __future__ import annotations

import json
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..core.checks import checked_path
from ..core.files import PathLike, atomic_path, read_document
from ..errors import InputError
from ..mesh.io.gltf import errors_of_file, node_matrices, opened, read_buffers
from ..mesh.io.gltf_animation import Channel, frames_of

_FORMAT, _VERSION = "warpcage cameras", 1

#: Numbers of a camera, by the names of its arguments.
CAMERA_NUMBERS = ("fx", "fy", "cx", "cy", "width", "height")

#: Width of pictures where none is given, pixels.
WIDTH = 400

#: y up to z up: (x, y, z) -> (x, -z, y).
_TO_Z_UP = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])

#: glTF cameras look along -z with +y up, ours along +z with +y down.
_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])

#: What a channel that moves nodes changes.
_PLACES = ("translation", "rotation", "scale")


def read_camera_document(path: pathlib.Path, size: tuple[int, int] | None = None) -> dict[str, Any]:
    """What a camera file holds: "cameras", entries as `CameraFile.save` writes them, and perhaps fps and loop.
    `size`: width and height of the pictures of glTF cameras, pixels."""
    if path.suffix.lower() in (".glb", ".gltf"):
        return {"cameras": _read_gltf_entries(path, size)}
    document = read_document(path, "camera file", _FORMAT, _VERSION)
    cameras = document["cameras"]
    if not isinstance(cameras, list) or not cameras:
        raise InputError("its cameras must be a list of at least one")
    return document


def write_camera_document(
    path: PathLike, entries: Sequence[dict[str, Any]], *, fps: float | None = None, loop: str | None = None
) -> None:
    """Write entries of cameras as JSON, whole or not at all."""
    path = checked_path(path, "the camera file")
    if path.suffix.lower() != ".json":
        raise InputError(f"camera file {str(path)!r} must end in .json")
    if not entries:
        raise InputError("a camera file needs at least one camera")
    document: dict[str, Any] = {"format": _FORMAT, "version": _VERSION, "cameras": list(entries)}
    document |= {name: value for name, value in (("fps", fps), ("loop", loop)) if value is not None}
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def _read_gltf_entries(path: pathlib.Path, size: tuple[int, int] | None) -> list[dict[str, Any]]:
    """Entries of the perspective cameras of a glTF file, named as the nodes, z up; those of one camera follow each
    other. `size`: width and height, pixels; None is 400 in width, and the height that the file's aspect ratio says."""
    with errors_of_file(path):
        document, chunk = opened(path)
        nodes = document.get("nodes", [])
        at_rest = node_matrices(document)
        found = [index for index in at_rest if "camera" in nodes[index]]
        if not found:
            raise InputError("there is no camera in it: export with cameras (in Blender: Include, Cameras)")
        channels = _channels(document, read_buffers(path, document, chunk))
        # all cameras count from the first key of the file, so that they stay together, and with what else moves in it
        begin = min((float(each.times[0]) for each in channels), default=0.0)
        entries: list[dict[str, Any]] = []
        for node in found:
            lens = _lens(document["cameras"][nodes[node]["camera"]], size)
            name = _name(document, node)
            moving = [each for each in channels if each.node in _above(document, node)]
            if not moving:
                entries.append({"name": name, **lens, "camera_to_world": _pose(at_rest[node])})
                continue
            # A camera that an animation moves, itself or through what it hangs on, becomes keys at the animation's
            # frames, straight between: what a program wrote for each frame comes back frame for frame.
            times, _ = frames_of(np.unique(np.concatenate([each.times for each in moving])))
            for time in times:
                places: dict[int, dict[str, Any]] = {}
                for each in moving:
                    places.setdefault(each.node, {})[each.path] = each.at(time)
                matrix = node_matrices(document, places)[node]
                entry = {"name": name, "time": time - begin, "easing": "linear"}
                entries.append({**entry, **lens, "camera_to_world": _pose(matrix)})
        return entries


def _pose(matrix: np.ndarray) -> np.ndarray:
    """The pose (4, 4) of a camera at the world matrix (4, 4) of its node, whose scale does not matter."""
    pose = _TO_Z_UP @ matrix @ _TO_OPENCV
    lengths = np.linalg.norm(pose[:3, :3], axis=0)
    if not (np.isfinite(pose).all() and lengths.min() > 0.0):
        raise InputError("the place of a camera is not finite, or scaled to nothing")
    pose[:3, :3] /= lengths
    return pose


def _lens(entry: dict, size: tuple[int, int] | None) -> dict[str, float]:
    """The numbers of a camera of the file's field of view."""
    if "perspective" not in entry:
        raise InputError(f"its camera {entry.get('name', '')!r} is {entry.get('type')}: only perspective ones are read")
    yfov, aspect = float(entry["perspective"]["yfov"]), float(entry["perspective"].get("aspectRatio", 1.0))
    if not (0.0 < yfov < np.pi and 0.0 < aspect < 1e4):
        raise InputError(f"a camera has a field of view of {yfov:g} and an aspect ratio of {aspect:g}")
    width, height = size or (WIDTH, max(1, round(WIDTH / aspect)))
    focal = 0.5 * height / float(np.tan(0.5 * yfov))
    values = (focal, focal, width / 2, height / 2, width, height)
    return dict(zip(CAMERA_NUMBERS, values, strict=True))


def _channels(document: dict, buffers: list[bytes]) -> list[Channel]:
    """What animations change of the places of nodes. Where several move one, the first does."""
    found: dict[tuple[int, str], Channel] = {}
    for animation in document.get("animations", []):
        for channel in animation["channels"]:
            key = channel["target"].get("node"), channel["target"]["path"]
            if key[0] is not None and key[1] in _PLACES and key not in found:
                sampler = animation["samplers"][channel["sampler"]]
                found[key] = Channel(document, buffers, channel, sampler, 0)
    return list(found.values())


def _above(document: dict, node: int) -> set[int]:
    """A node and all that it hangs on."""
    parents = {
        child: index for index, each in enumerate(document.get("nodes", [])) for child in each.get("children", [])
    }
    found = {node}
    while node in parents:
        node = parents[node]
        found.add(node)
    return found


def _name(document: dict, node: int) -> str:
    """The name of a camera's node, or of the camera: programs hang cameras on nodes of their own without a name."""
    own = document["nodes"][node]
    return str(own.get("name") or document["cameras"][own["camera"]].get("name") or f"camera {node}")
