"""Where the object of a scene is: a box from its cameras, tightened by its alphas."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..core.devices import launch
from ..kernels.fitting.visual_hull import carve_visual_hull, keep_seen_voxels, sum_columns, sum_rows
from ..scene.box import scene_box
from ..scene.scene import Scene
from ..view.frame import camera_array

#: Alpha above which a pixel counts as part of the object (of 1).
OPAQUE = 0.5 / 255


class Silhouettes:
    """The outlines of a scene's object in its images, on a device.

    Raises ValueError where the scene has no alphas or every pixel is transparent.
    """

    def __init__(self, scene: Scene, device):
        if scene.alphas is None:
            raise ValueError("the scene's images have no alpha: there are no silhouettes")
        opaque = (scene.alphas > OPAQUE).view(np.uint8)
        if not opaque.any():
            raise ValueError("every pixel of the scene is transparent: there is nothing to fit")
        self.cameras, self.device = scene.cameras, device
        count, height, width = opaque.shape
        self.sums = wp.zeros((count, height + 1, width + 1), dtype=wp.int32, device=device)
        held = wp.array(opaque, dtype=wp.uint8, device=device)
        launch(sum_rows, count * height, [held], [self.sums], device=device)
        launch(sum_columns, count * (width + 1), [], [self.sums], device=device)
        touching = opaque[:, [0, -1]].any(axis=(1, 2)) | opaque[:, :, [0, -1]].any(axis=(1, 2))
        showing = opaque.any(axis=(1, 2))  # a view of nothing only says where the object is not
        self.bounded = wp.array(showing & ~touching, dtype=wp.int32, device=device)

    def carve(self, bounds, resolution) -> wp.array:
        """(nx, ny, nz) uint8 mask of the voxels that no image shows as transparent, at `resolution` over `bounds`."""
        mask = wp.empty(tuple(int(n) for n in resolution), dtype=wp.uint8, device=self.device)
        inputs = [*_node_places(bounds, resolution, self.cameras, self.device), self.sums, self.bounded]
        launch(carve_visual_hull, mask.size, inputs, [mask], device=self.device)
        return mask

    def bound(self, box, *, resolution: int = 64, rounds: int = 2) -> np.ndarray:
        """(2, 3) `box` shrunk to the visual hull. Raises ValueError where the silhouettes have no common inside."""
        for _ in range(rounds):
            shape = np.maximum(8, np.ceil(resolution * (box[1] - box[0]) / (box[1] - box[0]).max()).astype(int))
            occupied = np.argwhere(self.carve(box, shape).numpy())
            if len(occupied) == 0:
                raise ValueError("the silhouettes of the views have no common inside: check cameras' axes and alphas")
            voxel = (box[1] - box[0]) / shape
            box = np.stack([box[0] + (occupied.min(axis=0) - 1) * voxel, box[0] + (occupied.max(axis=0) + 2) * voxel])
        return box


def keep_seen(bounds, cameras, least: int, mask: wp.array) -> None:
    """Clear the voxels of a mask (nx, ny, nz) uint8 over `bounds` that fewer than `least` cameras see."""
    inputs = [*_node_places(bounds, mask.shape, cameras, mask.device), least]
    launch(keep_seen_voxels, mask.size, inputs, [mask], device=mask.device)


def _node_places(bounds, resolution, cameras, device) -> list:
    """Position of the first voxel's centre, voxel size and cameras, relative to the middle of `bounds`."""
    bounds = np.asarray(bounds, np.float64)
    voxel_size = (bounds[1] - bounds[0]) / resolution
    center = bounds.mean(axis=0)
    return [
        wp.vec3(*(bounds[0] - center + 0.5 * voxel_size)),
        wp.vec3(*voxel_size),
        camera_array(cameras, center, device),
    ]


def object_bounds(scene: Scene, device) -> np.ndarray:
    """(2, 3) box of the object: `scene_box`, shrunk to the visual hull where the scene has alphas."""
    box = scene_box(scene)
    return box if scene.alphas is None else Silhouettes(scene, device).bound(box)
