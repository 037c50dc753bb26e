"""Ray cast pictures of meshes."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..core.devices import launch, resolve_device
from ..kernels.reference.mesh_raycast import MeshLighting, cast_mesh_rays
from ..view.frame import camera_struct

# Pictures

#: Strength and exponent of the specular term.
HIGHLIGHT, SHININESS = 0.22, 18.0


def render_mesh_views(
    vertices,
    faces,
    colours,
    cameras,
    *,
    samples: int = 3,
    highlight: float = HIGHLIGHT,
    shininess: float = SHININESS,
    device=None,
) -> np.ndarray:
    """Ray cast a mesh from each camera.

    vertices (v, 3) world units; faces (f, 3); colours (f, 3) in [0, 1]; cameras of one image size; samples x samples
    rays a pixel; highlight, shininess: strength and exponent of the specular term.
    Returns (n, h, w, 4) float32, straight alpha (colour 0 where alpha is 0).
    Lit from above (+z). Raises ValueError for shapes that do not fit, no camera, or cameras of several sizes.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int32)
    colours = np.asarray(colours, np.float32)
    cameras = list(cameras)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or not np.isfinite(vertices).all():
        raise ValueError(f"vertices must be finite (v, 3), got shape {vertices.shape}")
    if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0 or faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(f"faces must be (f, 3) indices below {len(vertices)}, got shape {faces.shape}")
    if colours.shape != faces.shape:
        raise ValueError(f"colours must hold one colour a face, {faces.shape}, got {colours.shape}")
    if not cameras or len({(camera.width, camera.height) for camera in cameras}) > 1:
        raise ValueError("render_mesh_views needs one camera or more, all of one image size")
    if samples < 1:
        raise ValueError(f"samples must be at least 1, got {samples}")

    device = resolve_device(device)
    origin = vertices.mean(axis=0)  # taken off in float64: far scenes survive float32
    size = float(np.ptp(vertices, axis=0).max())
    mesh = wp.Mesh(
        points=wp.array((vertices - origin).astype(np.float32), dtype=wp.vec3, device=device),
        indices=wp.array(faces.ravel(), dtype=wp.int32, device=device),
    )
    face_colours = wp.array(colours, dtype=wp.vec3, device=device)
    lighting = mesh_lighting(size, highlight, shininess)
    width, height = cameras[0].width, cameras[0].height
    rgba = wp.zeros(width * height, dtype=wp.vec4, device=device)
    views = np.empty((len(cameras), height, width, 4), np.float32)
    for view, camera in zip(views, cameras, strict=True):
        inputs = [mesh.id, face_colours, lighting, camera_struct(camera, origin), samples]
        launch(cast_mesh_rays, width * height, inputs, [rgba], device=device)
        view[...] = rgba.numpy().reshape(height, width, 4)
    return views


def mesh_lighting(size: float, highlight: float = HIGHLIGHT, shininess: float = SHININESS) -> MeshLighting:
    """The light of all scenes here, for a mesh of this size (world units)."""
    lighting = MeshLighting()
    lighting.highlight, lighting.shininess = highlight, shininess
    lighting.key_direction = wp.normalize(wp.vec3(0.45, -0.6, 0.9))
    lighting.key_colour = wp.vec3(0.66, 0.64, 0.59)
    lighting.fill_direction = wp.normalize(wp.vec3(-0.6, 0.7, 0.25))
    lighting.fill_colour = wp.vec3(0.24, 0.26, 0.29)
    lighting.sky_colour = wp.vec3(0.60, 0.62, 0.66)
    lighting.ground_colour = wp.vec3(0.46, 0.43, 0.40)
    lighting.reach, lighting.offset = 0.15 * size, 1e-4 * size
    return lighting
