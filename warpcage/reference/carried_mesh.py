"""CarriedMesh: a mesh ray cast at rest and in poses that carry its colour and light along."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arrays import empty_array
from ..core.devices import launch, resolve_device
from ..kernels.reference.carried_raycast import SolidTexture, cast_carried_rays, shade_surface_points
from ..kernels.reference.mesh_distance import measure_mesh_distance
from ..view.camera import Camera, camera_struct
from .raycast import HIGHLIGHT, SHININESS, checked_mesh, common_size, device_mesh, mesh_lighting, require_samples


class CarriedMesh:
    """A mesh with a colour on each face and a solid texture, lit from above at rest. Poses carry all of that along.

    A posed radiance field shows just this: colour, shadows and highlights of the place at rest, seen along the
    direction at rest. So renders of a posed CarriedMesh are the ground truth for renders of a deformed field.

    Args:
        vertices: (v, 3) float, world units.
        faces: (f, 3) int, indices of vertices.
        colours: (f, 3) float in [0, 1], one per face.
        texture: Amplitude of the noise over the colours (0 leaves them plain), and its frequency per world unit.
        highlight: Strength of the specular term.
        shininess: Exponent of the specular term.
        device: Warp device. None is CUDA where there is one, else the CPU.

    Attributes:
        vertices: (v, 3) float64, world units, at rest.
        faces: (f, 3) int32.
        device: The Warp device that renders.

    Raises:
        ValueError: For shapes that do not fit.
    """

    def __init__(
        self,
        vertices: ArrayLike,
        faces: ArrayLike,
        colours: ArrayLike,
        *,
        texture: tuple[float, float] = (0.35, 9.0),
        highlight: float = HIGHLIGHT,
        shininess: float = SHININESS,
        device: wp.DeviceLike = None,
    ):
        self.vertices, self.faces, colours = checked_mesh(vertices, faces, colours)
        self.device = resolve_device(device)
        self._colours = wp.array(colours, dtype=wp.vec3, device=self.device)
        self._texture = SolidTexture()
        self._texture.amplitude, self._texture.frequency = map(float, texture)
        self._lighting = mesh_lighting(float(np.ptp(self.vertices, axis=0).max()), highlight, shininess)
        self._rest = device_mesh(self.vertices, self.faces, self.vertices.mean(axis=0), self.device)

    def render(
        self,
        cameras: Sequence[Camera],
        *,
        posed: ArrayLike | None = None,
        view_matrices: ArrayLike | None = None,
        light_stays: bool = False,
        samples: int = 3,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Pictures and depths of the mesh, at rest or posed.

        Args:
            cameras: n cameras of one image size.
            posed: (v, 3) float, where the vertices are, world units. None is at rest.
            view_matrices: (v, 3, 3) float of any scale, take directions from posed to rest space at each vertex. None
                leaves directions as they are.
            light_stays: Light the posed mesh by lights fixed to the world instead, as no captured field can.
            samples: Rays along each side of a pixel.

        Returns:
            RGBA (n, h, w, 4) float32, straight alpha, and depth (n, h, w) float32, world units, inf where the mesh does
            not cover the whole pixel.

        Raises:
            ValueError: For shapes that do not fit, no samples, no camera, or cameras of several sizes.
        """
        count = len(self.vertices)
        posed = self.vertices if posed is None else np.asarray(posed, np.float64)
        matrices = np.broadcast_to(np.eye(3), (count, 3, 3)) if view_matrices is None else np.asarray(view_matrices)
        if posed.shape != (count, 3) or matrices.shape != (count, 3, 3):
            raise ValueError(
                f"posed must be ({count}, 3) and view_matrices ({count}, 3, 3), got {posed.shape} and {matrices.shape}"
            )
        require_samples(samples)
        width, height = common_size(cameras)
        origin = posed.mean(axis=0)
        mesh = device_mesh(posed, self.faces, origin, self.device)
        directions = wp.array(np.ascontiguousarray(matrices, np.float32), dtype=wp.mat33, device=self.device)
        rgba = wp.empty(height * width, dtype=wp.vec4, device=self.device)  # pyright: ignore[reportArgumentType]
        depth = wp.empty(height * width, dtype=wp.float32, device=self.device)  # pyright: ignore[reportArgumentType]
        colours = np.empty((len(cameras), height, width, 4), np.float32)
        distances = np.empty((len(cameras), height, width), np.float32)
        scene = [mesh.id, self._rest.id, self._colours, directions, self._texture, self._lighting, int(light_stays)]
        for view, camera in enumerate(cameras):
            inputs = [*scene, camera_struct(camera, origin), samples]
            launch(cast_carried_rays, len(rgba), inputs, [rgba, depth], device=self.device)
            colours[view] = rgba.numpy().reshape(height, width, 4)
            distances[view] = depth.numpy().reshape(height, width)
        return colours, distances

    def shade(self, faces: ArrayLike, corners: ArrayLike, directions: ArrayLike) -> np.ndarray:
        """Colours of points of the mesh at rest, each seen from several sides, whether or not something is between.

        Args:
            faces: (n,) int, the face that each point lies on.
            corners: (n, 2) float, its weights of the first two corners of the face.
            directions: (n, m, 3) unit vectors from the eye to the point.

        Returns:
            (n, m, 3) float32.
        """
        towards = wp.array(np.ascontiguousarray(directions, np.float32), dtype=wp.vec3, device=self.device)
        numbers = np.asarray(faces, np.int32)
        colours = empty_array(towards.shape, wp.vec3, self.device)
        inputs = [
            self._rest.id,
            self._colours,
            self._texture,
            self._lighting,
            wp.array(numbers, dtype=wp.int32, device=self.device),
            wp.array(np.asarray(corners), dtype=wp.vec2, device=self.device),
            towards,
        ]
        work = 100 * towards.shape[1]
        launch(shade_surface_points, len(numbers), inputs, [colours], device=self.device, work=work)
        return colours.numpy()

    def signed_distances(self, points: ArrayLike) -> np.ndarray:
        """How far points are from the mesh at rest.

        Args:
            points: (n, 3) float, world units.

        Returns:
            (n,) float32, world units: negative inside; the walls of one solid in another count as walls.
        """
        points, middle = np.asarray(points, np.float64), self.vertices.mean(axis=0)
        mesh = device_mesh(self.vertices, self.faces, middle, self.device, winding=True)
        local = wp.array((points - middle).astype(np.float32), dtype=wp.vec3, device=self.device)
        distances = empty_array(len(points), wp.float32, self.device)
        launch(measure_mesh_distance, len(points), [mesh.id, 1e6, local], [distances], device=self.device, work=1000)
        return distances.numpy()
