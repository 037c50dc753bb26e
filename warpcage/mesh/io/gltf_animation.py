"""Motion in glTF files: animated nodes, skins and shapes (morph targets), as places of vertices frame by frame."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from ...core.checks import listed
from ...core.memory import require_host_memory
from ...errors import InputError
from .gltf import (
    as_floats,
    errors_of_file,
    mesh_nodes,
    node_matrices,
    object_name,
    opened,
    placed_nodes,
    read_buffers,
    require_room,
    values_of,
)
from .gltf_meshes import Body

#: Rates at which programs write animations, in the order in which they are tried.
RATES = (24.0, 25.0, 30.0, 50.0, 60.0, 12.0, 15.0, 48.0, 120.0, 30000 / 1001, 24000 / 1001, 60000 / 1001)

#: Frames per second that a file's own rate may be; others are counts of ticks, or of whole seconds.
OWN_RATES = (10.0, 240.0)

#: Times of keys fall on frames up to this share of a frame: files hold float32.
ON_FRAME = 0.02

#: Most frames of an animation.
MAX_FRAMES = 20_000

#: What a channel of an animation changes.
_PATHS = ("translation", "rotation", "scale", "weights")


@dataclasses.dataclass(frozen=True)
class GltfMotion:
    """The places that the vertices of a file go through: frames of an animation, or shapes."""

    names: tuple[str, ...]  # of each: that of the shape, or "frame 1" and so on
    vertices: list[np.ndarray]  # (v, 3) float64 each, y up, in the order of `read_gltf`
    times: tuple[float, ...] | None = None  # seconds from the first frame; None, and no rate, for shapes
    fps: float | None = None
    shown: np.ndarray | None = None  # (v, 3) shapes that are on in the file, together; None without, and for animations


def read_gltf_motion(path: pathlib.Path, name: str = "", object: str = "") -> GltfMotion | None:
    """How the vertices of a glTF file move; None where nothing does. Without an animation each shape is a pose.
    name: the animation or the shape; "" takes the only animation, or all shapes; object: as `read_gltf` takes it."""
    with errors_of_file(path):
        document, chunk = opened(path)
        moving = _Moving(document, read_buffers(path, document, chunk), object)
        animations = moving.animations()
        shapes = moving.shape_names()
        if name and name not in animations and name not in shapes:
            known = [*animations, *shapes]
            held = f"only {listed(known)}" if known else "and nothing else that moves"
            raise InputError(f"there is no animation or shape key {name!r}, {held}")
        if len(animations) > 1 and not name:
            raise InputError(
                f"it holds {len(animations)} animations ({listed(animations)}): name one, as in {path.name}:"
                f"{next(iter(animations))}, or export them as one (Blender: Animation Mode, Active actions merged)"
            )
        if animations and (not name or name in animations):
            return _sampled(moving, animations[name or next(iter(animations))])  # at its keys' frames, as written
        if name:
            return GltfMotion((name,), [moving.vertices(shapes={name: 1.0})])
        if not shapes:
            return None
        shown = moving.vertices() if moving.has_shapes_on() else None
        return GltfMotion(shapes, [moving.vertices(shapes={shape: 1.0}) for shape in shapes], shown=shown)


def gltf_animation_names(path: pathlib.Path) -> list[str]:
    """The names of the animations of a glTF file that move a mesh."""
    with errors_of_file(path):
        document, chunk = opened(path)
        return list(_Moving(document, read_buffers(path, document, chunk), "").animations())


def _sampled(moving: _Moving, channels: list[Channel]) -> GltfMotion:
    """The frames of an animation."""
    keys = np.unique(np.concatenate([channel.times for channel in channels]))
    times, fps = frames_of(keys)
    require_host_memory(24 * moving.count * len(times), f"its {len(times)} frames of {moving.count} vertices need")
    poses = []
    for time in at_keys(times, keys, ON_FRAME / fps):
        places: dict[int, dict] = {}
        weights: dict[int, np.ndarray] = {}
        for channel in channels:
            if channel.path == "weights":
                weights[channel.node] = channel.at(time)
            else:
                places.setdefault(channel.node, {})[channel.path] = channel.at(time)
        poses.append(moving.vertices(places, weights))
    names = tuple(f"frame {index + 1}" for index in range(len(times)))
    return GltfMotion(names, poses, tuple(time - times[0] for time in times), fps)


def frames_of(keys: np.ndarray, rates: Sequence[float] = ()) -> tuple[list[float], float]:
    """Times to sample at, and the rate on whose frames all keys lie, one of the file's or a usual one, or that of keys
    which are evenly apart; else keys and frames."""
    begin, end = float(keys[0]), float(keys[-1])
    known, even = [*rates, *RATES], (len(keys) - 1) / (end - begin) if end > begin else 0.0
    if len(keys) > 2 and even >= OWN_RATES[0]:
        known += [round(even, 3), even]
    for fps in known:
        frames = (keys - begin) * fps
        if np.abs(frames - np.round(frames)).max() < ON_FRAME:
            count = _require_frames(begin, end, fps)
            if count > 1 or len(keys) == 1:
                return [begin + index / fps for index in range(count)], fps
    # what turns or bends between its keys is not straight there
    if len(keys) + _require_frames(begin, end, known[0]) > MAX_FRAMES:
        raise InputError(f"its animation has {len(keys)} keys between frames, at most {MAX_FRAMES} are read")
    between = np.arange(begin, end, 1.0 / known[0])
    return np.union1d(keys, at_keys(between, keys, ON_FRAME / known[0])).tolist(), known[0]


def _require_frames(begin: float, end: float, fps: float) -> int:
    """The frames between two times; more than MAX_FRAMES are refused."""
    count = round((end - begin) * fps) + 1
    if count > MAX_FRAMES:
        raise InputError(f"its animation of {end - begin:g} s has {count:.9g} frames, at most {MAX_FRAMES} are read")
    return count


def at_keys(times: ArrayLike, keys: np.ndarray, tolerance: float) -> np.ndarray:
    """Times (n,), those at most a tolerance from one of the keys, which ascend, at it."""
    # values that jump at a key would come a frame late where float32 has it a little later
    times = np.asarray(times, np.float64)
    after = np.searchsorted(keys, times).clip(1, max(1, len(keys) - 1))
    near = np.where(
        times - keys[after - 1] <= keys[after % len(keys)] - times, keys[after - 1], keys[after % len(keys)]
    )
    return np.where(np.abs(near - times) <= tolerance, near, times)


class Channel:
    """One value of a node that an animation changes."""

    def __init__(self, document: dict, buffers: list[bytes], channel: dict, sampler: dict, shape_count: int):
        self.node, self.path = channel["target"]["node"], channel["target"]["path"]
        self.times = values_of(document, buffers, sampler["input"]).reshape(-1).astype(np.float64)
        self.interpolation = sampler.get("interpolation", "LINEAR")
        values = values_of(document, buffers, sampler["output"])
        numbers = as_floats(values)
        width = {"rotation": 4, "weights": shape_count}.get(self.path, 3)
        sets = 3 if self.interpolation == "CUBICSPLINE" else 1
        if not len(self.times) or numbers.size != len(self.times) * sets * width or (np.diff(self.times) < 0).any():
            raise InputError(f"the animation of node {self.node} has {numbers.size} values at {len(self.times)} times")
        if not (np.isfinite(self.times).all() and np.isfinite(numbers).all()):
            raise InputError(f"the animation of node {self.node} holds values that are not finite")
        self.values = numbers.reshape(len(self.times), sets, width)

    def at(self, time: float) -> np.ndarray:
        """The value at a time: translation and scale (3,), rotation (4,), or the weights of shapes."""
        index = int(np.clip(np.searchsorted(self.times, time, side="right") - 1, 0, len(self.times) - 1))
        middle = self.values.shape[1] // 2
        begin = self.values[index, middle]
        if index == len(self.times) - 1 or time <= self.times[0] or self.interpolation == "STEP":
            return begin
        length = self.times[index + 1] - self.times[index]
        share, end = (time - self.times[index]) / length, self.values[index + 1, middle]
        if self.interpolation == "CUBICSPLINE":
            leaving, arriving = self.values[index, 2], self.values[index + 1, 0]
            value = _hermite(begin, end, length * leaving, length * arriving, share)
        elif self.path == "rotation":
            value = _turned(begin, end, share)
        else:
            value = begin + share * (end - begin)
        return value / np.linalg.norm(value) if self.path == "rotation" else value


def _hermite(begin: np.ndarray, end: np.ndarray, leaving: np.ndarray, arriving: np.ndarray, s: float) -> np.ndarray:
    return (
        (2 * s**3 - 3 * s**2 + 1) * begin
        + (s**3 - 2 * s**2 + s) * leaving
        + (3 * s**2 - 2 * s**3) * end
        + (s**3 - s**2) * arriving
    )


def _turned(begin: np.ndarray, end: np.ndarray, share: float) -> np.ndarray:
    """A quaternion on the shorter way from one to another (slerp)."""
    cosine = float(begin @ end)
    if cosine < 0.0:
        end, cosine = -end, -cosine
    if cosine > 1.0 - 1e-9:
        return begin + share * (end - begin)
    angle = np.arccos(min(cosine, 1.0))
    return (np.sin((1.0 - share) * angle) * begin + np.sin(share * angle) * end) / np.sin(angle)


class _Moving:
    """The meshes of a scene, and how their vertices follow nodes and shapes."""

    def __init__(self, document: dict, buffers: list[bytes], name: str = ""):
        self.document, self.buffers = document, buffers
        require_room(document, mesh_nodes(document, name))
        nodes = [node for node, _ in placed_nodes(document) if not name or object_name(document, node) == name]
        self.bodies = [Body(document, buffers, node) for node in nodes]
        self.count = sum(len(body.positions) for body in self.bodies)

    def animations(self) -> dict[str, list[Channel]]:
        """Channels of each animation that moves a mesh, by its name."""
        shape_counts = {body.node: len(body.shapes) for body in self.bodies}
        concerned = self._concerned()
        found: dict[str, list[Channel]] = {}
        for number, animation in enumerate(self.document.get("animations", [])):
            channels = []
            for channel in animation["channels"]:
                node, path = channel["target"].get("node"), channel["target"]["path"]
                known = node in shape_counts if path == "weights" else node in concerned
                if known and path in _PATHS:
                    sampler = animation["samplers"][channel["sampler"]]
                    count = shape_counts.get(node, 0)
                    channels.append(Channel(self.document, self.buffers, channel, sampler, count))
            if channels:
                found[str(animation.get("name") or f"animation {number + 1}")] = channels
        return found

    def _concerned(self) -> set[int]:
        """Nodes on whose places meshes depend: their own, their joints and all above them."""
        parents = {
            child: index
            for index, node in enumerate(self.document.get("nodes", []))
            for child in node.get("children", [])
        }
        waiting = [
            node for body in self.bodies for node in (body.node, *(body.joints if body.skin is not None else ()))
        ]
        found: set[int] = set()
        while waiting:
            node = waiting.pop()
            if node not in found:
                found.add(node)
                waiting += [parents[node]] if node in parents else []
        return found

    def shape_names(self) -> tuple[str, ...]:
        """Names of all shapes, each once."""
        return tuple(dict.fromkeys(name for body in self.bodies for name in body.names))

    def has_shapes_on(self) -> bool:
        """Whether the file shows a shape."""
        return any(body.weights.any() for body in self.bodies)

    def vertices(
        self,
        places: Mapping[int, dict] | None = None,
        weights: Mapping[int, np.ndarray] | None = None,
        shapes: Mapping[str, float] | None = None,
    ) -> np.ndarray:
        """Places (v, 3) of all vertices, y up; places: translation, rotation, scale of nodes by number, the others
        stay. weights: of the shapes of nodes, by number; shapes: weight by name instead, the others are off."""
        matrices = node_matrices(self.document, places)
        found = [body.at(self._weights(body, weights, shapes), matrices) for body in self.bodies]
        joined = np.concatenate(found) if found else np.zeros((0, 3))
        if not np.isfinite(joined).all():
            raise InputError("its motion leads to places that are not finite")
        return joined

    @staticmethod
    def _weights(
        body: Body, weights: Mapping[int, np.ndarray] | None, shapes: Mapping[str, float] | None
    ) -> np.ndarray:
        if shapes is not None:
            return np.array([shapes.get(name, 0.0) for name in body.names])
        return (weights or {}).get(body.node, body.weights)
