"""Pinhole cameras, and cameras that hold a set of points in the picture."""

from __future__ import annotations

import dataclasses
import numbers

import numpy as np

from ..core.arrays import as_host_points


@dataclasses.dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera without distortion.

    fx, fy, cx, cy: focal lengths and principal point in pixels; the centre of the first pixel is (0.5, 0.5).
    width, height: image size in pixels.
    camera_to_world: (4, 4) float64, rigid; OpenCV axes (+x right, +y down, +z forward), scene units.

    Raises ValueError for sizes or focal lengths that are not positive, or a pose that is not a finite rigid (4, 4).
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    camera_to_world: np.ndarray

    def __post_init__(self):
        pose = np.asarray(self.camera_to_world, dtype=np.float64)
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            raise ValueError(f"camera_to_world must be a finite (4, 4) matrix, got shape {pose.shape}")
        rotation = pose[:3, :3]
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
            raise ValueError("camera_to_world must hold a rotation (orthonormal, determinant 1)")
        if not np.allclose(pose[3], (0, 0, 0, 1), atol=1e-3):
            raise ValueError(f"camera_to_world must end in the row 0 0 0 1, got {pose[3].tolist()}")
        if int(self.width) < 1 or int(self.height) < 1:
            raise ValueError(f"a camera needs an image of at least 1x1 pixel, got {self.width}x{self.height}")
        for name in ("fx", "fy", "cx", "cy"):
            value = getattr(self, name)
            if not (isinstance(value, numbers.Real) and np.isfinite(value)):
                raise ValueError(f"{name} of a camera must be a finite number, got {value!r}")
        if not (self.fx > 0 and self.fy > 0):
            raise ValueError(f"focal lengths must be positive, got fx={self.fx}, fy={self.fy}")
        pose = pose.copy()
        pose.setflags(write=False)
        object.__setattr__(self, "camera_to_world", pose)
        object.__setattr__(self, "width", int(self.width))
        object.__setattr__(self, "height", int(self.height))
        for name in ("fx", "fy", "cx", "cy"):
            object.__setattr__(self, name, float(getattr(self, name)))

    @classmethod
    def look_at(
        cls, eye, target, *, up=(0.0, 0.0, 1.0), fov_degrees: float = 40.0, width: int = 400, height: int = 400
    ) -> Camera:
        """A camera at `eye` (3,) that looks at `target` (3,); fov_degrees is the horizontal field of view."""
        eye, target, up = (np.asarray(v, dtype=np.float64) for v in (eye, target, up))
        forward = target - eye
        if np.linalg.norm(forward) == 0:
            raise ValueError(f"look_at needs a target that is not the eye, both are {eye}")
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, up)
        if np.linalg.norm(right) < 1e-9:  # looking along `up`: any right will do
            right = np.cross(forward, [1.0, 0.0, 0.0] if abs(forward[0]) < 0.9 else [0.0, 1.0, 0.0])
        right = right / np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = right, np.cross(forward, right), forward, eye
        focal = 0.5 * width / np.tan(np.radians(fov_degrees) / 2)
        return cls(focal, focal, width / 2, height / 2, width, height, pose)

    @property
    def centre(self) -> np.ndarray:
        """(3,) the centre of projection in world units."""
        return self.camera_to_world[:3, 3]

    @property
    def rotation(self) -> np.ndarray:
        """(3, 3) camera axes in world coordinates, one a column."""
        return self.camera_to_world[:3, :3]

    def resized(self, width: int, height: int) -> Camera:
        """The same view at another image size."""
        sx, sy = width / self.width, height / self.height
        return dataclasses.replace(
            self, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy, width=width, height=height
        )

    def moved(self, transform) -> Camera:
        """The camera after a rigid world transform (4, 4)."""
        return dataclasses.replace(self, camera_to_world=np.asarray(transform, np.float64) @ self.camera_to_world)

    def rays(self) -> tuple[np.ndarray, np.ndarray]:
        """Origins (h, w, 3) and unit directions (h, w, 3) of the rays through the pixel centres, world units."""
        x = (np.arange(self.width) + 0.5 - self.cx) / self.fx
        y = (np.arange(self.height) + 0.5 - self.cy) / self.fy
        local = np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0), axis=-1)
        directions = local @ self.rotation.T
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        return np.broadcast_to(self.centre, directions.shape).copy(), directions

    def project(self, points) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (n, 2) and depths along the optical axis (n,) of world points (n, 3)."""
        local = (np.asarray(points, np.float64) - self.centre) @ self.rotation
        with np.errstate(divide="ignore", invalid="ignore"):
            u = self.fx * local[:, 0] / local[:, 2] + self.cx
            v = self.fy * local[:, 1] / local[:, 2] + self.cy
        return np.stack([u, v], axis=-1), local[:, 2]


def turntable(
    target,
    radius: float,
    elevation_degrees: float,
    count: int,
    *,
    up=(0.0, 0.0, 1.0),
    fov_degrees: float = 40.0,
    width: int = 400,
    height: int = 400,
    start_degrees: float = 0.0,
) -> list[Camera]:
    """`count` cameras on a circle of `radius` around `target`, `elevation_degrees` above the plane across `up`."""
    if count < 1:
        raise ValueError(f"a turntable needs at least one view, got {count}")
    up = np.asarray(up, np.float64) / np.linalg.norm(up)
    side = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    front = np.cross(side, up)
    elevation = np.radians(elevation_degrees)
    cameras = []
    for angle in np.radians(start_degrees) + 2 * np.pi * np.arange(count) / count:
        flat = np.cos(angle) * front + np.sin(angle) * side
        eye = np.asarray(target, np.float64) + radius * (np.cos(elevation) * flat + np.sin(elevation) * up)
        cameras.append(Camera.look_at(eye, target, up=up, fov_degrees=fov_degrees, width=width, height=height))
    return cameras


def framing_orbit(
    points,
    count: int,
    *,
    elevation_degrees: float = 20.0,
    start_degrees: float = 0.0,
    up=(0.0, 0.0, 1.0),
    fov_degrees: float = 40.0,
    width: int = 400,
    height: int = 400,
    fill: float = 0.92,
) -> list[Camera]:
    """`count` cameras on a circle around points (n, 3), as near as keeps every point in every picture.

    elevation_degrees: above the plane across `up`; start_degrees: of the first camera, from +x towards +y where up is
    z; fov_degrees: horizontal; fill: share of the picture's width or height that the points may take.
    Raises ValueError for no points, or angles and shares out of range.
    """
    points = as_host_points(points)
    if not len(points):
        raise ValueError("a view needs at least one point to look at")
    if not (0 < fov_degrees < 180 and 0 < fill <= 1):
        raise ValueError(f"a view needs fov_degrees in (0, 180) and fill in (0, 1], got {fov_degrees} and {fill}")
    target = (points.min(axis=0) + points.max(axis=0)) / 2
    offsets = points - target
    tangent = np.tan(np.radians(fov_degrees) / 2) * fill
    options = {"up": up, "fov_degrees": fov_degrees, "width": width, "height": height, "start_degrees": start_degrees}
    distance = 0.0
    for camera in turntable(np.zeros(3), 1.0, elevation_degrees, count, **options):
        x, y, z = (offsets @ camera.rotation).T
        # a point is in the picture where |x| <= (distance + z) tan(fov / 2), and so for y
        needed = np.maximum(np.abs(x) / tangent, np.abs(y) / (tangent * height / width)) - z
        distance = max(distance, float(needed.max()))
    if distance <= 0.0:
        distance = 1.0  # one point alone: any distance shows it
    return turntable(target, distance, elevation_degrees, count, **options)
