"""CarriedMesh: a mesh ray cast at rest and in poses that carry its colour and light along."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..core.devices import launch, resolve_device
from ..kernels.reference.carried_raycast import SolidTexture, cast_carried_rays
from ..view.frame import camera_struct
from .raycast import mesh_lighting


class CarriedMesh:
    """A mesh with colours of faces and a solid texture, lit from above at rest; poses carry all of that along.

    vertices (v, 3) world units, faces (f, 3), colours (f, 3) in [0, 1]. texture: amplitude and frequency (per world
    unit) of the noise over the colours.

    What a radiance field of the object at rest shows once it is posed is this: colour, shadows and highlights are those
    of the place at rest, seen along the direction at rest. So renders of a posed CarriedMesh are the ground truth of a
    deformed field. Raises ValueError for shapes that do not fit.
    """

    def __init__(self, vertices, faces, colours, *, texture=(0.35, 9.0), device=None):
        self.vertices = np.asarray(vertices, np.float64)
        self.faces = np.asarray(faces, np.int32)
        colours = np.asarray(colours, np.float32)
        if self.vertices.ndim != 2 or self.vertices.shape[1] != 3 or not np.isfinite(self.vertices).all():
            raise ValueError(f"vertices must be finite (v, 3), got shape {self.vertices.shape}")
        if self.faces.ndim != 2 or self.faces.shape[1] != 3 or len(self.faces) == 0:
            raise ValueError(f"faces must be (f, 3), got shape {self.faces.shape}")
        if self.faces.min() < 0 or self.faces.max() >= len(self.vertices):
            raise ValueError(f"faces must be indices below {len(self.vertices)}, got {self.faces.max()}")
        if colours.shape != self.faces.shape:
            raise ValueError(f"colours must hold one colour a face, {self.faces.shape}, got {colours.shape}")
        self.device = resolve_device(device)
        self._colours = wp.array(colours, dtype=wp.vec3, device=self.device)
        self._texture = SolidTexture()
        self._texture.amplitude, self._texture.frequency = map(float, texture)
        self._lighting = mesh_lighting(float(np.ptp(self.vertices, axis=0).max()))
        self._rest = self._mesh(self.vertices, self.vertices.mean(axis=0))

    def render(
        self, cameras, *, posed=None, view_matrices=None, light_stays: bool = False, samples: int = 3
    ) -> tuple[np.ndarray, np.ndarray]:
        """RGBA (n, h, w, 4) float32, straight alpha, and depth (n, h, w), inf where the pixel is not covered whole.

        cameras: n cameras of one image size.

        posed: (v, 3) where the vertices are, world units; None is at rest. view_matrices: (v, 3, 3) that take
        directions from posed to rest space at each vertex, of any scale; None leaves directions as they are.
        light_stays: light the posed mesh by lights fixed to the world instead, as no captured field can.
        samples x samples rays a pixel. Raises ValueError for shapes that do not fit, no camera, or cameras of
        several sizes.
        """
        count = len(self.vertices)
        posed = self.vertices if posed is None else np.asarray(posed, np.float64)
        matrices = np.broadcast_to(np.eye(3), (count, 3, 3)) if view_matrices is None else np.asarray(view_matrices)
        if posed.shape != (count, 3) or matrices.shape != (count, 3, 3):
            raise ValueError(
                f"posed must be ({count}, 3) and view_matrices ({count}, 3, 3), got {posed.shape} and {matrices.shape}"
            )
        if samples < 1:
            raise ValueError(f"samples must be at least 1, got {samples}")
        if len({(camera.width, camera.height) for camera in cameras}) != 1:
            raise ValueError("render needs one camera or more, all of one image size")
        origin = posed.mean(axis=0)
        mesh = self._mesh(posed, origin)
        matrices = wp.array(np.ascontiguousarray(matrices, np.float32), dtype=wp.mat33, device=self.device)
        shape = cameras[0].height, cameras[0].width
        rgba = wp.empty(shape[0] * shape[1], dtype=wp.vec4, device=self.device)
        depth = wp.empty(shape[0] * shape[1], dtype=wp.float32, device=self.device)
        colours = np.empty((len(cameras), *shape, 4), np.float32)
        distances = np.empty((len(cameras), *shape), np.float32)
        for view, camera in enumerate(cameras):
            inputs = [
                mesh.id,
                self._rest.id,
                self._colours,
                matrices,
                self._texture,
                self._lighting,
                int(light_stays),
                camera_struct(camera, origin),
                samples,
            ]
            launch(cast_carried_rays, len(rgba), inputs, [rgba, depth], device=self.device)
            colours[view], distances[view] = rgba.numpy().reshape(*shape, 4), depth.numpy().reshape(shape)
        return colours, distances

    def _mesh(self, vertices: np.ndarray, origin: np.ndarray) -> wp.Mesh:
        points = wp.array((vertices - origin).astype(np.float32), dtype=wp.vec3, device=self.device)
        return wp.Mesh(points=points, indices=wp.array(self.faces.ravel(), dtype=wp.int32, device=self.device))
