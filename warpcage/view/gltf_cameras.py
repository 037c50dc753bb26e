"""Cameras of glTF files, as Blender and other programs export them."""

from __future__ import annotations

import dataclasses
import pathlib
from typing import Any

import numpy as np

from ..mesh.io.gltf import node_matrices, one_line, opened, read_buffers
from ..mesh.io.gltf_animation import Channel, frames_of
from .camera import Camera
from .camera_path import CameraKey

#: Width of pictures where none is given, pixels.
WIDTH = 400

#: y up to z up: (x, y, z) -> (x, -z, y).
_TO_Z_UP = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])

#: glTF cameras look along -z with +y up, ours along +z with +y down.
_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])

#: What a channel that moves nodes changes.
_PLACES = ("translation", "rotation", "scale")


def read_gltf_cameras(path: pathlib.Path, size: tuple[int, int] | None = None) -> list[CameraKey]:
    """Keys of the perspective cameras of a glTF file, named as the nodes, z up; those of one camera follow one another.
    `size`: width and height, pixels; None is 400 in width, and the height that the file's aspect ratio says."""
    with one_line(path):
        document, chunk = opened(path)
        nodes = document.get("nodes", [])
        at_rest = node_matrices(document)
        found = [index for index in at_rest if "camera" in nodes[index]]
        if not found:
            raise ValueError("there is no camera in it: export with cameras (in Blender: Include, Cameras)")
        channels = _channels(document, read_buffers(path, document, chunk))
        keys: list[CameraKey] = []
        for node in found:
            lens = _lens(document["cameras"][nodes[node]["camera"]], size)
            name = _name(document, node)
            moving = [each for each in channels if each.node in _above(document, node)]
            if not moving:
                keys.append(CameraKey(_camera(lens, at_rest[node]), None, name))
                continue
            # A camera that an animation moves, itself or through what it hangs on, becomes keys at the frames of the
            # animation, straight from each to the next, so that what a program wrote for each frame comes back frame
            # for frame.
            times, _ = frames_of(np.unique(np.concatenate([each.times for each in moving])))
            for time in times:
                places: dict[int, dict[str, Any]] = {}
                for each in moving:
                    places.setdefault(each.node, {})[each.path] = each.at(time)
                matrix = node_matrices(document, places)[node]
                keys.append(CameraKey(_camera(lens, matrix), time - times[0], name, "linear"))
        return keys


def _camera(lens: Camera, matrix: np.ndarray) -> Camera:
    """A camera at the world matrix (4, 4) of its node, whose scale does not matter."""
    pose = _TO_Z_UP @ matrix @ _TO_OPENCV
    lengths = np.linalg.norm(pose[:3, :3], axis=0)
    if not (np.isfinite(pose).all() and lengths.min() > 0.0):
        raise ValueError("the place of a camera is not finite, or scaled to nothing")
    pose[:3, :3] /= lengths
    return dataclasses.replace(lens, camera_to_world=pose)


def _lens(entry: dict, size: tuple[int, int] | None) -> Camera:
    """A camera of the file's field of view, at the origin."""
    if "perspective" not in entry:
        raise ValueError(f"its camera {entry.get('name', '')!r} is {entry.get('type')}: only perspective ones are read")
    yfov, aspect = float(entry["perspective"]["yfov"]), float(entry["perspective"].get("aspectRatio", 1.0))
    if not (0.0 < yfov < np.pi and 0.0 < aspect < 1e4):
        raise ValueError(f"a camera has a field of view of {yfov:g} and an aspect ratio of {aspect:g}")
    width, height = size or (WIDTH, max(1, round(WIDTH / aspect)))
    focal = 0.5 * height / float(np.tan(0.5 * yfov))
    return Camera(focal, focal, width / 2, height / 2, width, height, np.eye(4))


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
