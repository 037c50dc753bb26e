"""Ray cast pictures of triangle meshes in poses that carry colour and light along, the truth of deformed fields."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from warpcage.core import checked_whole
from warpcage.core.arrays import empty_array
from warpcage.core.devices import launch, resolve_device
from warpcage.demo.raycast import HIGHLIGHT, SHININESS, checked_mesh, common_size, device_mesh, mesh_lighting
from warpcage.errors import InputError
from warpcage.kernels.demo.mesh_raycast import measure_mesh_distance
from warpcage.view.camera import Camera, camera_struct

from .carried_raycast import SolidTexture, cast_carried_rays, shade_surface_points


class CarriedMesh:
    """A mesh with a colour on each face and a solid texture, lit from above at rest; poses carry all of that along.
    Posed, it is the ground truth of a deformed field, which shows a place at rest along the direction at rest."""

    def __init__(
        self,
        vertices: ArrayLike,  # (v, 3) world units
        faces: ArrayLike,  # (f, 3) indices of vertices
        colors: ArrayLike,  # (f, 3) in [0, 1]
        *,
        texture: tuple[float, float] = (0.35, 9.0),  # amplitude of the noise (0: plain), frequency per world unit
        highlight: float = HIGHLIGHT,  # strength of the specular term
        shininess: float = SHININESS,  # exponent of the specular term
        device: wp.DeviceLike = None,
    ):
        self.vertices, self.faces, colors = checked_mesh(vertices, faces, colors)
        self.device = resolve_device(device)
        self._colors = wp.array(colors, dtype=wp.vec3, device=self.device)
        self._texture = SolidTexture()
        self._texture.amplitude, self._texture.frequency = map(float, texture)
        self._lighting = mesh_lighting(float(np.ptp(self.vertices, axis=0).max()), highlight, shininess)
        self._rest = device_mesh(self.vertices, self.faces, self.vertices.mean(axis=0), self.device)

    def render(
        self,
        cameras: Sequence[Camera],
        *,
        posed: ArrayLike | None = None,  # (v, 3) where the vertices are, world units
        view_matrices: ArrayLike | None = None,  # (v, 3, 3) of any scale, directions from posed to rest; None: same
        light_stays: bool = False,  # light the posed mesh by lights fixed to the world, as no captured field can
        samples: int = 3,  # rays along each side of a pixel
    ) -> tuple[np.ndarray, np.ndarray]:
        """RGBA (n, h, w, 4) float32, straight alpha, and depth (n, h, w) float32, world units, of the mesh, at rest or
        posed. Depth is inf where the mesh does not cover the whole pixel; all cameras have one image size."""
        count = len(self.vertices)
        posed = self.vertices if posed is None else np.asarray(posed, np.float64)
        matrices = np.broadcast_to(np.eye(3), (count, 3, 3)) if view_matrices is None else np.asarray(view_matrices)
        if posed.shape != (count, 3) or matrices.shape != (count, 3, 3):
            raise InputError(
                f"posed must be ({count}, 3) and view_matrices ({count}, 3, 3), got {posed.shape} and {matrices.shape}"
            )
        checked_whole(samples, "samples", 1)
        width, height = common_size(cameras)
        origin = posed.mean(axis=0)
        mesh = self._rest if posed is self.vertices else device_mesh(posed, self.faces, origin, self.device)
        directions = wp.array(np.ascontiguousarray(matrices, np.float32), dtype=wp.mat33, device=self.device)
        rgba = wp.empty(height * width, dtype=wp.vec4, device=self.device)  # pyright: ignore[reportArgumentType]
        depth = wp.empty(height * width, dtype=wp.float32, device=self.device)  # pyright: ignore[reportArgumentType]
        colors = np.empty((len(cameras), height, width, 4), np.float32)
        distances = np.empty((len(cameras), height, width), np.float32)
        scene = [mesh.id, self._rest.id, self._colors, directions, self._texture, self._lighting, int(light_stays)]
        for view, camera in enumerate(cameras):
            inputs = [*scene, camera_struct(camera, origin), samples]
            launch(cast_carried_rays, len(rgba), inputs, [rgba, depth], device=self.device)
            colors[view] = rgba.numpy().reshape(height, width, 4)
            distances[view] = depth.numpy().reshape(height, width)
        return colors, distances

    def shade(self, faces: ArrayLike, corners: ArrayLike, directions: ArrayLike) -> np.ndarray:
        """Colours (n, m, 3) float32 of points of the mesh at rest, from m sides each, as if nothing was between."""
        # unit vectors (n, m, 3) from the eye to the point
        towards = wp.array(np.ascontiguousarray(directions, np.float32), dtype=wp.vec3, device=self.device)
        numbers = np.asarray(faces, np.int32)  # (n,) the face that each point lies on
        colors = empty_array(towards.shape, wp.vec3, self.device)
        inputs = [
            self._rest.id,
            self._colors,
            self._texture,
            self._lighting,
            wp.array(numbers, dtype=wp.int32, device=self.device),
            wp.array(np.asarray(corners), dtype=wp.vec2, device=self.device),  # (n, 2) weights of the first two corners
            towards,
        ]
        work = 100 * towards.shape[1]
        launch(shade_surface_points, len(numbers), inputs, [colors], device=self.device, work=work)
        return colors.numpy()

    def signed_distances(self, points: ArrayLike) -> np.ndarray:
        """How far points (n, 3) are from the mesh at rest: (n,) float32, world units, negative inside.
        The walls of one solid in another count as walls."""
        points, middle = np.asarray(points, np.float64), self.vertices.mean(axis=0)
        mesh = device_mesh(self.vertices, self.faces, middle, self.device, winding=True)
        local = wp.array((points - middle).astype(np.float32), dtype=wp.vec3, device=self.device)
        distances = empty_array(len(points), wp.float32, self.device)
        launch(measure_mesh_distance, len(points), [mesh.id, 1e6, local], [distances], device=self.device, work=1000)
        return distances.numpy()
