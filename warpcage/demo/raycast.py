"""Ray cast pictures of triangle meshes with a colour on each face."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.checks import checked_whole
from ..core.devices import launch, resolve_device
from ..errors import InputError
from ..kernels.demo.mesh_raycast import MeshLighting, cast_mesh_rays
from ..view.camera import Camera, camera_struct

#: Strength and exponent of the specular term.
HIGHLIGHT, SHININESS = 0.22, 18.0


def render_mesh_views(
    vertices: ArrayLike,  # (v, 3) world units
    faces: ArrayLike,  # (f, 3) indices of vertices
    colors: ArrayLike,  # (f, 3) in [0, 1]
    cameras: Sequence[Camera],  # of one image size
    *,
    samples: int = 3,  # rays along each side of a pixel
    highlight: float = HIGHLIGHT,  # strength of the specular term
    shininess: float = SHININESS,  # exponent of the specular term
    device: wp.DeviceLike = None,
) -> np.ndarray:
    """Ray cast a mesh, lit from above (+z), from each camera: (n, h, w, 4) float32, straight alpha.
    The colour is 0 where alpha is 0."""
    vertices, faces, colors = checked_mesh(vertices, faces, colors)
    cameras = list(cameras)
    width, height = common_size(cameras)
    checked_whole(samples, "samples", 1)
    device = resolve_device(device)
    origin = vertices.mean(axis=0)
    mesh = device_mesh(vertices, faces, origin, device)
    face_colors = wp.array(colors, dtype=wp.vec3, device=device)
    lighting = mesh_lighting(float(np.ptp(vertices, axis=0).max()), highlight, shininess)
    rgba = wp.zeros(width * height, dtype=wp.vec4, device=device)
    views = np.empty((len(cameras), height, width, 4), np.float32)
    for view, camera in zip(views, cameras, strict=True):
        inputs = [mesh.id, face_colors, lighting, camera_struct(camera, origin), samples]
        launch(cast_mesh_rays, width * height, inputs, [rgba], device=device)
        view[...] = rgba.numpy().reshape(height, width, 4)
    return views


def mesh_lighting(size: float, highlight: float = HIGHLIGHT, shininess: float = SHININESS) -> Any:
    """The light of all reference scenes, a MeshLighting of the kernels; size: longest side of the mesh, world units."""
    lighting = MeshLighting()
    lighting.highlight, lighting.shininess = highlight, shininess
    lighting.key_direction = wp.normalize(wp.vec3(0.45, -0.6, 0.9))  # pyright: ignore[reportCallIssue, reportArgumentType]
    lighting.key_color = wp.vec3(0.66, 0.64, 0.59)
    lighting.fill_direction = wp.normalize(wp.vec3(-0.6, 0.7, 0.25))  # pyright: ignore[reportCallIssue, reportArgumentType]
    lighting.fill_color = wp.vec3(0.24, 0.26, 0.29)
    lighting.sky_color = wp.vec3(0.60, 0.62, 0.66)
    lighting.ground_color = wp.vec3(0.46, 0.43, 0.40)
    lighting.reach, lighting.offset = 0.15 * size, 1e-4 * size
    return lighting


def device_mesh(
    vertices: np.ndarray, faces: np.ndarray, origin: np.ndarray, device: wp.DeviceLike, *, winding: bool = False
) -> wp.Mesh:
    """A mesh for ray queries, relative to `origin` (3,), world units; winding: queries ask for winding numbers."""
    points = wp.array((vertices - origin).astype(np.float32), dtype=wp.vec3, device=device)  # far scenes: in float64
    indices = wp.array(faces.ravel(), dtype=wp.int32, device=device)
    return wp.Mesh(points=points, indices=indices, support_winding_number=winding)


def checked_mesh(vertices: ArrayLike, faces: ArrayLike, colors: ArrayLike) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """vertices (v, 3) float64, faces (f, 3) int32, colours (f, 3) float32. Raises ValueError where they do not fit."""
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int32)
    colors = np.asarray(colors, np.float32)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or not np.isfinite(vertices).all():
        raise InputError(f"vertices must be finite (v, 3), got shape {vertices.shape}")
    if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0:
        raise InputError(f"faces must be (f, 3), got shape {faces.shape}")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"faces must be indices from 0 to {len(vertices) - 1}, got {faces.min()} to {faces.max()}")
    if colors.shape != faces.shape:
        raise InputError(f"colours must hold one colour per face, {faces.shape}, got {colors.shape}")
    return vertices, faces, colors


def common_size(cameras: Sequence[Camera]) -> tuple[int, int]:
    """Width and height of every camera. Raises ValueError for no camera and for several sizes."""
    sizes = {(camera.width, camera.height) for camera in cameras}
    if len(sizes) != 1:
        raise InputError(f"give one camera or more, all of one image size, got {len(sizes)} sizes")
    return sizes.pop()
