"""Files of cameras: one camera, or the keys of a path. JSON of our own; glTF is read too."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from ..core.checks import checked_path, checked_positive, listed, require_type
from ..core.files import DAMAGED, PathLike, atomic_path, damage, read_json, require_file
from ..core.names import require_name
from .camera import Camera
from .camera_path import CameraKey
from .keys import LOOPS

_FORMAT, _VERSION = "warpcage cameras", 1

#: Numbers of a camera, by the names of its arguments.
_NUMBERS = ("fx", "fy", "cx", "cy", "width", "height")


class CameraFile(list[CameraKey]):
    """The cameras of a file, in their order.

    Args:
        keys: Cameras, or keys with times, names and easings.
        fps: Frames per second of the film. None leaves it open.
        loop: What the film does at its end, "once", "loop" or "ping-pong". None leaves it open.

    Raises:
        ValueError: For a rate that is not positive, or another loop.
    """

    def __init__(self, keys: Sequence[Camera | CameraKey] = (), *, fps: float | None = None, loop: str | None = None):
        require_type(keys, Sequence, "cameras of a file must be")
        super().__init__(key if isinstance(key, CameraKey) else CameraKey(key) for key in keys)
        self.fps = None if fps is None else checked_positive(fps, "the rate of a camera file")
        if loop is not None:
            require_name(loop, LOOPS, "loop")
        self.loop = loop

    def path(self, name: str = "") -> list[CameraKey]:
        """The keys of a path.

        Args:
            name: Name of the camera that moves. Empty takes all cameras as the keys of one path.

        Returns:
            The keys.

        Raises:
            ValueError: For a name that no camera has, or several cameras that move each by itself and no name.
        """
        if name:
            return [key for key in self if key.name == name] or [CameraKey(self.named(name))]
        times = [key.time for key in self if key.time is not None]
        if len(set(times)) < len(times):
            names = listed(dict.fromkeys(key.name for key in self if key.name))
            raise ValueError(f"several of its cameras are at one time: name the one that moves, of {names}")
        return list(self)

    def named(self, name: str) -> Camera:
        """One of the cameras.

        Args:
            name: Its name, or its number from 0; empty where there is only one.

        Returns:
            The camera.

        Raises:
            ValueError: If there is no such camera, or several of that name.
        """
        require_type(name, str, "the name of a camera must be")
        found = [key for key in self if key.name == name] if name else list(self)
        if not found and name.isdigit() and int(name) < len(self):
            found = [self[int(name)]]
        if len(found) == 1:
            return found[0].camera
        names = listed(dict.fromkeys(key.name or str(index) for index, key in enumerate(self)))
        if len({key.name for key in found}) == 1 and all(key.time is not None for key in found):
            raise ValueError(
                f"its camera {found[0].name!r} moves through {len(found)} keys: take one by its number, 0 to "
                f"{len(self) - 1}, or all as a path"
            )
        if not name:
            raise ValueError(f"it holds {len(self)} cameras: name one of {names}")
        raise ValueError(f"it holds {f'{len(found)} cameras' if found else 'no camera'} {name!r}, only {names}")

    def save(self, path: PathLike, *, extras: Sequence[dict[str, Any]] | None = None) -> None:
        """Write the file as JSON, whole or not at all. All numbers keep their digits.

        The file holds format, version and cameras: for each width, height, fx, fy, cx and cy in pixels, the (4, 4)
        camera_to_world in OpenCV axes and world units, and what there is of name, time, easing and target; besides fps
        and loop where they are given. Readers ignore keys that they do not know.

        Args:
            path: The file; it must end in .json.
            extras: For each camera, more that stands beside its numbers. None is nothing.

        Raises:
            ValueError: For another ending, or no cameras.
        """
        path = checked_path(path, "the camera file")
        if path.suffix.lower() != ".json":
            raise ValueError(f"camera file {str(path)!r} must end in .json")
        if not self:
            raise ValueError("a camera file needs at least one camera")
        document: dict[str, Any] = {
            "format": _FORMAT,
            "version": _VERSION,
            "cameras": [camera_json(key) | extra for key, extra in zip(self, extras or [{}] * len(self), strict=True)],
        }
        document |= {name: value for name, value in (("fps", self.fps), ("loop", self.loop)) if value is not None}
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")

    @classmethod
    def load(cls, path: PathLike, *, size: tuple[int, int] | None = None) -> CameraFile:
        """Read a file.

        Args:
            path: A file that `save` wrote, or a glTF file (.glb, .gltf) with perspective cameras, as Blender exports
                them; those that are animated become keys at the times of the file.
            size: Width and height of the pictures of glTF cameras, which have none. None is 400 pixels in width, and
                the height that the file says. Cameras of JSON files have their own.

        Returns:
            The cameras.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: What is wrong in which file.
        """
        path = require_file(path, "camera file")
        if path.suffix.lower() in (".glb", ".gltf"):
            from .gltf_cameras import read_gltf_cameras

            return cls(read_gltf_cameras(path, size))
        try:
            document = read_json(path, "camera file")
            if document["format"] != _FORMAT:
                raise ValueError(f"its format is {str(document['format'])[:40]!r}, not {_FORMAT!r}")
            version = document["version"]
            if type(version) is not int or version < 1:
                raise ValueError(f"its version must be a whole number from 1, got {str(version)[:40]!r}")
            if version > _VERSION:
                raise ValueError(f"its version is {version}, this warpcage reads up to {_VERSION}: upgrade")
            cameras = document["cameras"]
            if not isinstance(cameras, list) or not cameras:
                raise ValueError("its cameras must be a list of at least one")
            keys = [camera_from_json(entry, index) for index, entry in enumerate(cameras)]
            return cls(keys, fps=document.get("fps"), loop=document.get("loop"))
        except DAMAGED as error:
            raise ValueError(f"{path}: {damage('camera file', error)}") from None
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None


def camera_json(key: CameraKey) -> dict[str, Any]:
    """A camera key as JSON takes it; see `CameraFile.save`."""
    camera = key.camera
    entry: dict[str, Any] = {"name": key.name} if key.name else {}
    entry |= {} if key.time is None else {"time": key.time}
    entry |= {} if key.easing == "smooth" else {"easing": key.easing}
    entry |= {name: getattr(camera, name) for name in _NUMBERS}
    entry["camera_to_world"] = camera.camera_to_world.tolist()
    return entry if key.target is None else entry | {"target": key.target.tolist()}


def camera_from_json(entry: dict[str, Any], index: int) -> CameraKey:
    """A camera key from JSON. Raises ValueError for numbers that cannot be; index: what it is called without a name."""
    name = entry.get("name", "")
    if not isinstance(name, str):
        raise ValueError(f"the name of camera {index} must be a text, got {str(name)[:40]!r}")
    try:
        camera = Camera(**{number: entry[number] for number in _NUMBERS}, camera_to_world=entry["camera_to_world"])
        return CameraKey(camera, entry.get("time"), name, entry.get("easing", "smooth"), entry.get("target"))
    except ValueError as error:
        raise ValueError(f"camera {name or index}: {error}") from None
