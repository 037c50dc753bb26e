"""Files of cameras as plain entries: JSON of warpcage and of other programs, and glTF as Blender exports it."""

from __future__ import annotations

import json
import math
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..core.checks import checked_number, checked_path, checked_positive, checked_vector, real_array, shown
from ..core.files import PathLike, atomic_path, read_document, read_json
from ..errors import InputError
from ..mesh.io.gltf import errors_of_file, node_matrices, opened, read_buffers
from ..mesh.io.gltf_animation import ON_FRAME, Channel, at_keys, frames_of

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
    `size`: width and height of the pictures of cameras of glTF and SuperSplat, pixels."""
    if path.suffix.lower() in (".glb", ".gltf"):
        return {"cameras": _read_gltf_entries(path, size)}
    content = read_json(path, "camera file", (dict, list))
    program = camera_program(content)
    if program == "3D Gaussian Splatting":
        return {"cameras": [_splatting_entry(entry) for entry in _some(content, "cameras")]}
    if program == "nerfstudio":
        return _nerfstudio_path(content)
    if program == "SuperSplat":
        return _supersplat_path(content, size or (WIDTH, round(WIDTH * 9 / 16)))
    document = read_document(path, "camera file", _FORMAT, _VERSION)
    cameras = document["cameras"]
    if not isinstance(cameras, list) or not cameras:
        raise InputError("its cameras must be a list of at least one")
    return document


def camera_program(content: dict[str, Any] | list) -> str:
    """Which other program writes cameras in JSON such as this; "" for none."""
    if isinstance(content, list):
        return "3D Gaussian Splatting"
    marks = {"camera_path": "nerfstudio", "animTracks": "SuperSplat", "poseSets": "SuperSplat"}
    return next((program for mark, program in marks.items() if mark in content), "")


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


def _some(content: Any, name: str) -> list:
    """A list of at least one, out of JSON."""
    if not isinstance(content, list) or not content:
        raise InputError(f"its {name} must be a list of at least one, got {shown(content)}")
    return content


def _numbers(values: Any, shape: tuple[int, ...], name: str) -> np.ndarray:
    """Finite numbers of a shape, of nested lists or of one."""
    array = real_array(values, name)
    if array.size != np.prod(shape) or not np.isfinite(array).all():
        raise InputError(f"{name} must be {np.prod(shape)} finite numbers, got {shown(values)}")
    return array.reshape(shape)


def _pinhole(focal: float, width: float, height: float) -> dict[str, float]:
    """The numbers of a camera that looks through the middle of its picture."""
    return dict(zip(CAMERA_NUMBERS, (focal, focal, width / 2, height / 2, width, height), strict=True))


def _focal(degrees: Any, side: float, name: str) -> float:
    """The focal length, pixels, of an angle of view over a side."""
    angle = checked_number(degrees, name)
    if not 0.0 < angle < 180.0:
        raise InputError(f"{name} must lie between 0 and 180 degrees, got {angle:g}")
    return 0.5 * side / math.tan(math.radians(0.5 * angle))


def _splatting_entry(entry: dict[str, Any]) -> dict[str, Any]:
    """A camera of cameras.json of 3D Gaussian Splatting (Kerbl et al. 2023): OpenCV's axes, camera to world.
    The principal point is the middle of the picture unless the file has cx and cy."""
    width, height = entry["width"], entry["height"]
    pose = np.eye(4)
    pose[:3, :3] = _numbers(entry["rotation"], (3, 3), "rotation of a camera")
    pose[:3, 3] = checked_vector(entry["position"], "position of a camera")
    center = {name: entry.get(name, side / 2) for name, side in (("cx", width), ("cy", height))}
    sizes = {"fx": entry["fx"], "fy": entry["fy"], "width": width, "height": height}
    return {"name": str(entry.get("img_name", "")), **sizes, **center, "camera_to_world": pose}


def _nerfstudio_path(content: dict[str, Any]) -> dict[str, Any]:
    """Frames of camera_path.json of nerfstudio (Tancik et al. 2023), in the world of its fields: cameras look along -z
    with +y up, the field of view is that of the height. Its keyframes repeat what is in its frames."""
    kind = content.get("camera_type", "perspective")
    if kind != "perspective":
        raise InputError(f"its camera_type {shown(kind)} is not read, only perspective")
    frames = _some(content["camera_path"], "camera_path")
    width, height = (checked_positive(content[f"render_{side}"], f"render_{side}") for side in ("width", "height"))
    seconds = content.get("seconds")
    fps = len(frames) / checked_positive(seconds, "seconds") if seconds else checked_positive(content["fps"], "fps")
    entries = []
    for index, frame in enumerate(frames):
        pose = _numbers(frame["camera_to_world"], (4, 4), f"camera_to_world of frame {index}") @ _TO_OPENCV
        lens = _pinhole(_focal(frame["fov"], height, f"fov of frame {index}"), width, height)
        entries.append({"time": index / fps, "easing": "linear", **lens, "camera_to_world": pose})
    return {"cameras": entries, "fps": fps, "loop": "loop" if content.get("is_cycle") else None}


#: SuperSplat shows .ply files turned by half a turn about z, y up.
_FROM_SUPERSPLAT = np.array([-1.0, -1.0, 1.0])

#: Default field of view of SuperSplat's editor and its viewer, degrees, and frames per second.
_EDITOR_FOV, _VIEWER_FOV, _SUPERSPLAT_FPS = 60.0, 85.0, 30.0

_LOOPS = {"none": "once", "repeat": "loop", "pingpong": "ping-pong"}


def _supersplat_path(content: dict[str, Any], size: tuple[int, int]) -> dict[str, Any]:
    """Keys of SuperSplat, of settings.json of its viewer or document.json of a project, in coordinates of the .ply."""
    initial = (content.get("cameras") or [{"initial": content.get("camera") or {}}])[0]["initial"]  # the still camera
    if "poseSets" in content:
        return _supersplat_poses(content, initial.get("fov") or _EDITOR_FOV, size)
    default = initial.get("fov") or _VIEWER_FOV
    tracks = content["animTracks"] or []
    if not tracks and "position" in initial:
        return {"cameras": [_supersplat_view(initial["position"], initial["target"], default, size)]}
    entries = [entry for track in _some(tracks, "animTracks") for entry in _supersplat_track(track, default, size)]
    return {
        "cameras": entries,
        "fps": tracks[0].get("frameRate") or _SUPERSPLAT_FPS,
        "loop": _LOOPS.get(tracks[0].get("loopMode", "")),
    }


def _supersplat_poses(content: dict[str, Any], default: Any, size: tuple[int, int]) -> dict[str, Any]:
    """Keys of the editor; default: the field of view of keys without one."""
    timeline = content.get("timeline") or {}
    fps = checked_positive(timeline.get("frameRate", _SUPERSPLAT_FPS), "frameRate")
    easing, entries = "smooth" if timeline.get("smoothness", 1) else "linear", []
    for index, pose in enumerate(_some(_some(content["poseSets"], "poseSets")[0]["poses"], "poses")):
        time = checked_number(pose.get("frame", index * fps), "frame of a pose") / fps
        view = _supersplat_view(pose["position"], pose["target"], pose.get("fov") or default, size)
        entries.append({"name": str(pose.get("name", "")), "time": time, "easing": easing, **view})
    return {"cameras": entries, "fps": fps}


def _supersplat_track(track: dict[str, Any], default: Any, size: tuple[int, int]) -> list[dict[str, Any]]:
    """Keys of a track of the viewer, whose times are frames, or seconds where it has no rate."""
    rate = checked_positive(track["frameRate"], "frameRate") if track.get("frameRate") else 1.0
    times, values = _some(track["keyframes"]["times"], "times"), track["keyframes"]["values"]
    places, targets = (_numbers(values[name], (len(times), 3), name) for name in ("position", "target"))
    fovs = _numbers(values.get("fov") or [default] * len(times), (len(times),), "fov")
    easing = "smooth" if track.get("smoothness", 0) else "linear"
    easing = "hold" if track.get("interpolation") == "step" else easing
    return [
        {
            "name": str(track.get("name", "")),
            "time": checked_number(time, "time of a key") / rate,
            "easing": easing,
            **_supersplat_view(place, target, fov, size),
        }
        for time, place, target, fov in zip(times, places, targets, fovs, strict=True)
    ]


def _supersplat_view(position: Any, target: Any, fov: Any, size: tuple[int, int]) -> dict[str, Any]:
    """A camera that looks from a position to a target, its field of view that of the longer side of the picture."""
    eye, ahead = (_FROM_SUPERSPLAT * checked_vector(each, "position or target") for each in (position, target))
    forward = ahead - eye
    length = np.linalg.norm(forward)
    if not length > 0.0:
        raise InputError("a camera stands where it looks")
    forward = forward / length
    right = np.cross(forward, [0.0, -1.0, 0.0])  # up in the .ply
    across = np.linalg.norm(right)
    right = right / across if across > 1e-9 else np.array([-1.0, 0.0, 0.0])  # straight up or down
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, eye], axis=1)
    return {**_pinhole(_focal(fov, max(size), "fov"), *size), "camera_to_world": pose, "target": ahead}


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
            above = _above(document, node)
            moving = [each for each in channels if each.node in above]
            if not moving:
                entries.append({"name": name, **lens, "camera_to_world": _pose(at_rest[node])})
                continue
            # A camera that an animation moves, itself or through an ancestor, becomes keys at the animation's
            # frames, straight between: what a program wrote for each frame comes back frame for frame.
            keys = np.unique(np.concatenate([each.times for each in moving]))
            times, rate = frames_of(keys)
            for time, moment in zip(times, at_keys(times, keys, ON_FRAME / rate), strict=True):
                places: dict[int, dict[str, Any]] = {}
                for each in moving:
                    places.setdefault(each.node, {})[each.path] = each.at(moment)
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
    return _pinhole(0.5 * height / float(np.tan(0.5 * yfov)), width, height)


def _channels(document: dict, buffers: list[bytes]) -> list[Channel]:
    """Channels of animations that move nodes; of several for one node the first."""
    found: dict[tuple[int, str], Channel] = {}
    for animation in document.get("animations", []):
        for channel in animation["channels"]:
            key = channel["target"].get("node"), channel["target"]["path"]
            if key[0] is not None and key[1] in _PLACES and key not in found:
                sampler = animation["samplers"][channel["sampler"]]
                found[key] = Channel(document, buffers, channel, sampler, 0)
    return list(found.values())


def _above(document: dict, node: int) -> set[int]:
    """A node and its ancestors."""
    parents = {
        child: index for index, each in enumerate(document.get("nodes", [])) for child in each.get("children", [])
    }
    found = {node}
    while node in parents:
        node = parents[node]
        found.add(node)
    return found


def _name(document: dict, node: int) -> str:
    """The name of a camera's node, or of the camera where a program gave it an unnamed node."""
    entry = document["nodes"][node]
    return str(entry.get("name") or document["cameras"][entry["camera"]].get("name") or f"camera {node}")
