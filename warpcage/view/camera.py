"""Pinhole cameras: one, circles of them around an object, keys and files of them, cameras as kernels take them."""

from __future__ import annotations

import collections
import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arrays import as_host_points
from ..core.checks import (
    checked_easing,
    checked_number,
    checked_positive,
    checked_vector,
    checked_whole,
    listed,
    real_array,
    require_type,
    warn_renamed,
)
from ..core.files import PathLike, errors_of, require_file
from ..core.names import LOOPS, Easing, checked_choice, picture_stem
from ..errors import InputError
from ..kernels.view.rays import TILE_HEIGHT, TILE_SIZE, TILE_WIDTH, PinholeCamera
from .camera_file import CAMERA_NUMBERS, read_camera_document, write_camera_document

#: Rotations of a pose may be off by this much: files hold few digits.
POSE_TOLERANCE = 1e-3


@dataclasses.dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera without distortion.

    Args:
        fx: Focal length along the width, pixels.
        fy: Focal length along the height, pixels.
        cx: Column of the principal point, pixels. The centre of the first pixel is (0.5, 0.5).
        cy: Row of the principal point, pixels.
        width: Width of the image, pixels.
        height: Height of the image, pixels.
        camera_to_world: (4, 4) float64, rigid, world units. OpenCV axes: +x right, +y down, +z forward.

    Raises:
        ValueError: For sizes or focal lengths that are not positive, or a pose that is not a finite rigid (4, 4).
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    camera_to_world: np.ndarray

    def __post_init__(self) -> None:
        pose = rigid_motion(self.camera_to_world, "camera_to_world")
        for name in ("width", "height"):
            object.__setattr__(self, name, checked_pixels(getattr(self, name), f"{name} of a camera"))
        for name in ("fx", "fy", "cx", "cy"):
            object.__setattr__(self, name, checked_number(getattr(self, name), f"{name} of a camera"))
        if not (self.fx > 0 and self.fy > 0):
            raise InputError(f"focal lengths must be positive, got fx={self.fx}, fy={self.fy}")
        pose = pose.copy()
        pose.setflags(write=False)
        object.__setattr__(self, "camera_to_world", pose)

    @classmethod
    def look_at(
        cls,
        eye: ArrayLike,
        target: ArrayLike,
        *,
        up: ArrayLike = (0.0, 0.0, 1.0),
        fov_degrees: float = 40.0,
        width: int = 400,
        height: int = 400,
    ) -> Camera:
        """A camera that looks at a point.

        Args:
            eye: (3,) centre of projection, world units.
            target: (3,) the point in the middle of the picture, world units.
            up: (3,) the direction that points up in the picture, of any length. The default is +z.
            fov_degrees: Horizontal field of view.
            width: Width of the image, pixels.
            height: Height of the image, pixels.

        Returns:
            The camera, with square pixels.

        Raises:
            ValueError: If `target` is `eye`, for places that are not 3 finite numbers, for a size that is not whole and
                positive, or a field of view that is not between 0 and 180 degrees.
        """
        place, goal, upward = (
            checked_vector(v, f"{name} of look_at") for v, name in ((eye, "eye"), (target, "target"), (up, "up"))
        )
        width, height = checked_pixels(width, "width of look_at"), checked_pixels(height, "height of look_at")
        fov_degrees = checked_number(fov_degrees, "fov_degrees of look_at")
        if not 0.0 < fov_degrees < 180.0:
            raise InputError(f"fov_degrees of look_at must be between 0 and 180, got {fov_degrees:g}")
        with np.errstate(over="ignore"):
            forward = goal - place
        if not np.isfinite(forward).all():
            raise InputError(f"look_at needs places a finite distance apart, got {place} and {goal}")
        longest = np.abs(forward).max()
        if longest > 0 and not 1e-100 < longest < 1e100:
            forward = forward / longest  # its square is beyond float64
        if np.linalg.norm(forward) == 0:
            raise InputError(f"look_at needs a target that is not the eye, both are {place}")
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, upward)
        if np.linalg.norm(right) < 1e-9:  # looking along `up`: any right will do
            right = np.cross(forward, [1.0, 0.0, 0.0] if abs(forward[0]) < 0.9 else [0.0, 1.0, 0.0])
        right = right / np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = right, np.cross(forward, right), forward, place
        focal = 0.5 * width / np.tan(np.radians(fov_degrees) / 2)
        return cls(focal, focal, width / 2, height / 2, width, height, pose)

    def save(self, path: PathLike) -> None:
        """Write the camera to a JSON file; see `warpcage.view.camera.CameraFile.save`.

        Args:
            path: The file; it must end in .json.

        Raises:
            ValueError: For another ending.
        """
        # which needs cameras

        CameraFile([self]).save(path)

    @classmethod
    def load(cls, path: PathLike, name: str = "", *, size: tuple[int, int] | None = None) -> Camera:
        """Read a camera from a file of `save` or from glTF, as Blender exports its cameras.

        Args:
            path: The file (.json, .glb, .gltf).
            name: Name or number of the camera; empty where the file holds one.
            size: Width and height of a glTF camera's picture; see `warpcage.view.camera.CameraFile.load`.

        Returns:
            The camera.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: What is wrong in which file, and for a name of no camera or of several.
        """

        cameras = CameraFile.load(path, size=size)
        try:
            return cameras.named(name)
        except ValueError as error:
            raise InputError(f"{path}: {error}") from None

    @property
    def center(self) -> np.ndarray:
        """(3,) the centre of projection in world units."""
        return self.camera_to_world[:3, 3]

    @property
    def centre(self) -> np.ndarray:
        """The old name of `center`, for one release."""
        warn_renamed("Camera.centre", "center")
        return self.center

    @property
    def rotation(self) -> np.ndarray:
        """(3, 3) camera axes in world coordinates, one per column."""
        return self.camera_to_world[:3, :3]

    def resized(self, width: int, height: int) -> Camera:
        """The same view at another image size.

        Args:
            width: New width, pixels.
            height: New height, pixels.

        Returns:
            The camera whose picture shows the same, stretched to the new size.
        """
        width, height = checked_pixels(width, "width of a picture"), checked_pixels(height, "height of a picture")
        sx, sy = width / self.width, height / self.height
        return dataclasses.replace(
            self, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy, width=width, height=height
        )

    def moved(self, transform: ArrayLike) -> Camera:
        """The camera after a rigid motion of the world.

        Args:
            transform: (4, 4) rigid transform of world coordinates.

        Returns:
            The moved camera.

        Raises:
            ValueError: If the transform is not rigid.
        """
        motion = real_array(transform, "the motion of a camera")
        return dataclasses.replace(self, camera_to_world=motion @ self.camera_to_world)

    def rays(self) -> tuple[np.ndarray, np.ndarray]:
        """The rays through the pixel centres.

        Returns:
            Origins (h, w, 3) float64, world units, and unit directions (h, w, 3) float64.
        """
        x = (np.arange(self.width) + 0.5 - self.cx) / self.fx
        y = (np.arange(self.height) + 0.5 - self.cy) / self.fy
        local = np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0), axis=-1)
        directions = local @ self.rotation.T
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        return np.broadcast_to(self.center, directions.shape).copy(), directions

    def project(self, points: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Where points fall in the picture.

        Args:
            points: (n, 3) float, world units.

        Returns:
            Pixels (n, 2) float64 and depths along the optical axis (n,) float64, world units.
        """
        places = real_array(points, "points")
        if places.ndim != 2 or places.shape[1] != 3:
            raise InputError(f"points must be (n, 3), got {places.shape}")
        local = (places - self.center) @ self.rotation
        with np.errstate(divide="ignore", invalid="ignore"):
            u = self.fx * local[:, 0] / local[:, 2] + self.cx
            v = self.fy * local[:, 1] / local[:, 2] + self.cy
        return np.stack([u, v], axis=-1), local[:, 2]


def checked_pixels(value: Any, name: str) -> int:
    """How wide or high a picture is, at least 1; a float that is a whole number will do."""
    whole = isinstance(value, float | np.floating) and math.isfinite(value) and value == int(value)
    return checked_whole(int(value) if whole else value, name, 1)


def turntable(
    target: ArrayLike,
    radius: float,
    elevation_degrees: float,
    count: int,
    *,
    up: ArrayLike = (0.0, 0.0, 1.0),
    fov_degrees: float = 40.0,
    width: int = 400,
    height: int = 400,
    start_degrees: float = 0.0,
) -> list[Camera]:
    """Cameras on a circle around a point, all of which look at it.

    Args:
        target: (3,) the point, world units.
        radius: Distance of the cameras from the point, world units.
        elevation_degrees: Angle of the cameras above the plane through the point that `up` is normal to.
        count: Number of cameras.
        up: (3,) the axis of the circle, of any length. The default is +z.
        fov_degrees: Horizontal field of view.
        width: Width of the images, pixels.
        height: Height of the images, pixels.
        start_degrees: Angle of the first camera on the circle; 0 is at +x and 90 at +y where `up` is +z.

    Returns:
        `count` cameras, evenly around the circle.

    Raises:
        ValueError: If `count` is below one.
    """
    count = checked_whole(count, "the number of cameras of a turntable", 1)
    radius, elevation_degrees, start_degrees = (
        checked_number(value, f"{name} of a turntable")
        for value, name in (
            (radius, "radius"),
            (elevation_degrees, "elevation_degrees"),
            (start_degrees, "start_degrees"),
        )
    )
    target, axis = checked_vector(target, "target of a turntable"), checked_vector(up, "up of a turntable")
    if not axis.any():
        raise InputError("up of a turntable must be a direction, got 0 0 0")
    axis = axis / np.linalg.norm(axis)
    side = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.9 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    front = np.cross(side, axis)
    elevation = np.radians(elevation_degrees)
    cameras = []
    for angle in np.radians(start_degrees) + 2 * np.pi * np.arange(count) / count:
        flat = np.cos(angle) * front + np.sin(angle) * side
        eye = np.asarray(target, np.float64) + radius * (np.cos(elevation) * flat + np.sin(elevation) * axis)
        cameras.append(Camera.look_at(eye, target, up=axis, fov_degrees=fov_degrees, width=width, height=height))
    return cameras


def framing_orbit(
    points: ArrayLike,
    count: int,
    *,
    elevation_degrees: float = 20.0,
    start_degrees: float = 0.0,
    up: ArrayLike = (0.0, 0.0, 1.0),
    fov_degrees: float = 40.0,
    width: int = 400,
    height: int = 400,
    fill: float = 0.92,
) -> list[Camera]:
    """Cameras on a circle, as in `turntable`, around points (n, 3), as near as possible with all points in view.
    `fill`: share of the picture's width or height that the points may take."""
    host = as_host_points(points)
    if not len(host):
        raise InputError("a view needs at least one point to look at")
    if not (0 < fov_degrees < 180 and 0 < fill <= 1):
        raise InputError(f"a view needs fov_degrees in (0, 180) and fill in (0, 1], got {fov_degrees} and {fill}")
    target = (host.min(axis=0) + host.max(axis=0)) / 2
    offsets = host - target
    tangent = np.tan(np.radians(fov_degrees) / 2) * fill
    circle: dict[str, Any] = {
        "up": up,
        "fov_degrees": fov_degrees,
        "width": width,
        "height": height,
        "start_degrees": start_degrees,
    }
    distance = 0.0
    for camera in turntable(np.zeros(3), 1.0, elevation_degrees, count, **circle):
        x, y, z = (offsets @ camera.rotation).T
        # a point is in the picture where |x| <= (distance + z) tan(fov / 2), and the same for y
        needed = np.maximum(np.abs(x) / tangent, np.abs(y) / (tangent * height / width)) - z
        distance = max(distance, float(needed.max()))
    if distance <= 0.0:
        distance = 1.0  # one point alone: any distance shows it
    return turntable(target, distance, elevation_degrees, count, **circle)


def rigid_motion(matrix: ArrayLike, name: str = "a rigid motion") -> np.ndarray:
    """A rigid motion (4, 4), checked; messages call it by `name`."""
    motion = real_array(matrix, name)
    if motion.shape != (4, 4) or not np.isfinite(motion).all():
        raise InputError(f"{name} must be a finite (4, 4) matrix, got shape {motion.shape}")
    rotation = motion[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=POSE_TOLERANCE) or np.linalg.det(rotation) < 0:
        raise InputError(f"{name} must hold a rotation (orthonormal, determinant 1)")
    if not np.allclose(motion[3], (0, 0, 0, 1), atol=POSE_TOLERANCE):
        raise InputError(f"{name} must end in the row 0 0 0 1, got {motion[3].tolist()}")
    return motion


def common_up(cameras: Sequence[Camera]) -> np.ndarray:
    """The common up direction of cameras in the world, a unit vector (3,)."""
    mean = -np.mean([camera.rotation[:, 1] for camera in cameras], axis=0)
    length = np.linalg.norm(mean)
    if length < 1e-3:
        return np.array([0.0, 0.0, 1.0])
    mean /= length
    # Normal to the sideward axes of all, as for level cameras; where these do not determine it, the mean upward axis.
    sideward = np.stack([camera.rotation[:, 0] for camera in cameras])
    variances, axes = np.linalg.eigh(sideward.T @ sideward / len(sideward))  # ascending
    across = axes[:, 0] * np.sign(axes[:, 0] @ mean)
    nearest = np.round(across)  # a world axis, up to the digits of the file
    across = nearest if np.linalg.norm(across - nearest) < 2e-3 else across
    level = variances[1] > 0.02 and variances[0] < 0.2 * variances[1]
    return across if level and across @ mean > 0.7 else mean


def camera_struct(camera: Camera, origin: ArrayLike) -> Any:
    """A camera as a PinholeCamera of kernels/view/rays.py.
    `origin` (3,): world point that the kernel's positions are relative to."""
    struct = PinholeCamera()
    # in float64, as scenes may be far from zero; in plain floats: NumPy's own take Warp several times as long
    struct.center = wp.vec3(*(camera.center - np.asarray(origin, np.float64)).tolist())
    struct.rotation = wp.mat33(*np.asarray(camera.rotation, np.float64).ravel().tolist())
    struct.focal = wp.vec2(camera.fx, camera.fy)
    struct.principal_point = wp.vec2(camera.cx, camera.cy)
    struct.width = camera.width
    struct.height = camera.height
    return struct


def camera_array(cameras: Sequence[Camera], origin: ArrayLike, device: wp.DeviceLike) -> wp.array:
    """Cameras (n,) for kernels that take several; see `camera_struct`."""
    return wp.array([camera_struct(camera, origin) for camera in cameras], dtype=PinholeCamera, device=device)


def tile_threads(camera: Camera) -> int:
    """Threads that walk a camera's picture in whole tiles, for a kernel that finds its pixel by `tile_pixel`."""
    return -(-camera.width // TILE_WIDTH) * -(-camera.height // TILE_HEIGHT) * TILE_SIZE


@dataclasses.dataclass(frozen=True)
class CameraKey:
    """A camera of a path.

    Args:
        camera: The camera.
        time: Seconds from the film's start. None leaves it open.
        name: A name, empty for none.
        easing: Interpolation to the next key: "smooth", "linear" or another of `warpcage.core.EASINGS`, or
            {"bezier": [x1, y1, x2, y2]} as CSS has it.
        target: (3,) the point ahead that the camera orbits, world units. None takes what all keys look at.

    Raises:
        ValueError: For a time that is not a finite number from 0 on, another easing, or a target that is none.
    """

    camera: Camera
    time: float | None = None
    name: str = ""
    easing: Easing = "smooth"
    target: np.ndarray | None = None

    def __post_init__(self) -> None:
        require_type(self.camera, Camera, "a camera key needs")
        if self.time is not None:
            time = checked_number(self.time, "the time of a camera")
            if time < 0.0:
                raise InputError(f"the time of a camera must be from 0 on, got {time:g}")
            object.__setattr__(self, "time", time)
        object.__setattr__(self, "easing", checked_easing(self.easing, "easing"))
        if self.target is not None:
            object.__setattr__(self, "target", checked_vector(self.target, "the target of a camera"))


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
            checked_choice(loop, "loop", LOOPS)
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
        timed = [(key.time, key.name) for key in self if key.time is not None]
        counts = collections.Counter(name for _, name in timed)
        # cameras of glTF files that each move, one after the other in the file, at times that overlap
        apart = any(
            before != after and later <= earlier and min(counts[before], counts[after]) > 1
            for (earlier, before), (later, after) in itertools.pairwise(timed)
        )
        if apart or len({time for time, _ in timed}) < len(timed):
            names = listed(dict.fromkeys(key.name for key in self if key.name))
            raise InputError(f"several of its cameras are at one time: name the one that moves, of {names}")
        return list(self)

    def named(self, name: str) -> Camera:
        """One of the cameras.

        Args:
            name: Its name, with its picture's ending or without, or its number from 0; empty where there is only one.

        Returns:
            The camera.

        Raises:
            ValueError: If there is no such camera, or several of that name.
        """
        require_type(name, str, "the name of a camera must be")
        found = [key for key in self if key.name == name] if name else list(self)
        if not found and name.isdecimal() and name == str(int(name)) and int(name) < len(self):
            found = [self[int(name)]]
        if not found:  # 0013 of picture 0013.jpg, and the other way round
            found = [key for key in self if key.name and picture_stem(key.name) == picture_stem(name)]
        if len(found) == 1:
            return found[0].camera
        names = listed(dict.fromkeys(key.name or str(index) for index, key in enumerate(self)))
        if len({key.name for key in found}) == 1 and all(key.time is not None for key in found):
            raise InputError(
                f"its camera {found[0].name!r} moves through {len(found)} keys: take one by its number, 0 to "
                f"{len(self) - 1}, or all as a path"
            )
        if not name:
            raise InputError(f"it holds {len(self)} cameras: name one of {names}")
        raise InputError(f"it holds {f'{len(found)} cameras' if found else 'no camera'} {name!r}, only {names}")

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
        entries = [camera_json(key) | extra for key, extra in zip(self, extras or [{}] * len(self), strict=True)]
        write_camera_document(path, entries, fps=self.fps, loop=self.loop)

    @classmethod
    def load(cls, path: PathLike, *, size: tuple[int, int] | None = None) -> CameraFile:
        """Read a file.

        Args:
            path: A file that `save` wrote, or a glTF file (.glb, .gltf) with perspective cameras, as Blender exports
                them; those that are animated become keys at the times of the file. Also JSON of other programs:
                cameras.json of 3D Gaussian Splatting, camera_path.json of nerfstudio in the world of its field, and
                settings.json of SuperSplat's viewer or document.json of its projects in coordinates of the .ply.
            size: Width and height of the pictures of cameras of glTF and SuperSplat, which have none. None is 400
                pixels in width, and the height that a glTF file says, or 225. Others have their own.

        Returns:
            The cameras.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: What is wrong in which file.
        """
        path = require_file(path, "camera file")
        with errors_of(path, "camera file"):
            document = read_camera_document(path, size)
            keys = [camera_from_json(entry, index) for index, entry in enumerate(document["cameras"])]
            return cls(keys, fps=document.get("fps"), loop=document.get("loop"))


def camera_json(key: CameraKey) -> dict[str, Any]:
    """A camera key as JSON takes it; see `CameraFile.save`."""
    camera = key.camera
    entry: dict[str, Any] = {"name": key.name} if key.name else {}
    entry |= {} if key.time is None else {"time": key.time}
    entry |= {} if key.easing == "smooth" else {"easing": key.easing}
    entry |= {name: getattr(camera, name) for name in CAMERA_NUMBERS}
    entry["camera_to_world"] = camera.camera_to_world.tolist()
    return entry if key.target is None else entry | {"target": key.target.tolist()}


def camera_from_json(entry: dict[str, Any], index: int) -> CameraKey:
    """A camera key from JSON. Raises ValueError for numbers that cannot be; index: what it is called without a name."""
    name = entry.get("name", "")
    if not isinstance(name, str):
        raise InputError(f"the name of camera {index} must be a text, got {str(name)[:40]!r}")
    try:
        camera = Camera(
            **{number: entry[number] for number in CAMERA_NUMBERS}, camera_to_world=entry["camera_to_world"]
        )
        return CameraKey(camera, entry.get("time"), name, entry.get("easing", "smooth"), entry.get("target"))
    except ValueError as error:
        raise InputError(f"camera {name or index}: {error}") from None


def fitted(camera: Camera, size: Sequence[int], *, widen: bool = False) -> Camera:
    """The view at another size: a width, which keeps the shape, or width and height; none keeps the camera.
    Another shape shows the most of the camera's picture that fits in; `widen`: all of it, and more on two sides."""
    if not size:
        return camera
    width = int(size[0])
    if len(size) == 1:
        return camera.resized(width, max(1, round(width * camera.height / camera.width)))
    height = int(size[1])
    if abs(width * camera.height - height * camera.width) <= max(camera.width, camera.height):
        return camera.resized(width, height)  # the same shape in whole pixels
    scale = (min if widen else max)(width / camera.width, height / camera.height)
    return dataclasses.replace(
        camera,
        fx=camera.fx * scale,
        fy=camera.fy * scale,
        cx=width / 2 + (camera.cx - camera.width / 2) * scale,  # about the middle of the picture
        cy=height / 2 + (camera.cy - camera.height / 2) * scale,
        width=width,
        height=height,
    )
