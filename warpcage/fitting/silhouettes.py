"""Where the object of a scene is: boxes and masks of voxels, from its cameras and silhouettes."""

from __future__ import annotations

import math

import numpy as np
import warp as wp

from ..core.arrays import empty_array
from ..core.devices import launch
from ..errors import InputError
from ..field.sparse import mask_count
from ..kernels.field.refine import dilate_mask
from ..kernels.fitting.visual_hull import carve_visual_hull, keep_seen_voxels, sum_columns, sum_rows
from ..scene.box import scene_box
from ..scene.scene import Scene
from ..view.camera import Camera, camera_array

#: Alpha above which a pixel counts as part of the object (of 1).
OPAQUE = 0.5 / 255


class Silhouettes:
    """The outlines of a scene's object in its images, by their alphas, on a device."""

    def __init__(self, scene: Scene, device: wp.Device):
        if scene.alphas is None:
            raise InputError("the scene's images have no alpha: there are no silhouettes")
        opaque = scene.alphas > OPAQUE
        if not (opaque if scene.weights is None else opaque & (scene.weights > 0.0)).any():
            raise InputError("every pixel of the scene is transparent: there is nothing to fit")
        if scene.weights is not None:  # the object may be wherever pixels do not say that it is not
            opaque |= scene.weights == 0.0
        opaque = opaque.view(np.uint8)
        self.cameras, self.device = scene.cameras, device
        count, height, width = opaque.shape
        self.sums = wp.zeros((count, height + 1, width + 1), dtype=wp.int32, device=device)  # summed-area tables
        held = wp.array(opaque, dtype=wp.uint8, device=device)
        launch(sum_rows, count * height, [held], [self.sums], device=device)
        launch(sum_columns, count * (width + 1), [], [self.sums], device=device)
        cut = [scene.cut(index, each) for index, each in enumerate(opaque)]
        touching = np.array([each[[0, -1]].any() or each[:, [0, -1]].any() for each in cut])
        showing = np.array([each.any() for each in cut])  # a view of nothing only says where the object is not
        self.bounded = wp.array(showing & ~touching, dtype=wp.int32, device=device)  # 1: clear of border

    @property
    def held_bytes(self) -> int:
        """Device memory of the tables."""
        return 4 * self.sums.size + 4 * self.bounded.size

    def carve(self, bounds: np.ndarray, resolution: tuple[int, ...]) -> wp.array:
        """The visual hull, (nx, ny, nz) uint8: the voxels of a box (2, 3) that no image shows as transparent."""
        mask = empty_array(tuple(int(n) for n in resolution), wp.uint8, self.device)
        inputs = [*_node_places(bounds, resolution, self.cameras, self.device), self.sums, self.bounded]
        launch(carve_visual_hull, mask.size, inputs, [mask], device=self.device)
        return mask

    def bound(self, box: np.ndarray, *, resolution: int = 64, rounds: int = 2) -> np.ndarray:
        """A box (2, 3), world units, shrunk to the visual hull; resolution: voxels along its longest side."""
        for _ in range(rounds):
            shape = np.maximum(8, np.ceil(resolution * (box[1] - box[0]) / (box[1] - box[0]).max()).astype(int))
            occupied = np.argwhere(self.carve(box, shape).numpy())
            if len(occupied) == 0:
                raise InputError("the silhouettes of the views have no common inside: check cameras' axes and alphas")
            voxel = (box[1] - box[0]) / shape
            box = np.stack([box[0] + (occupied.min(axis=0) - 1) * voxel, box[0] + (occupied.max(axis=0) + 2) * voxel])
        return box


def object_bounds(scene: Scene, device: wp.Device) -> np.ndarray:
    """The box (2, 3), world units, of a scene's object, shrunk to the visual hull where there are alphas."""
    return scene_box(scene, None if scene.alphas is None else Silhouettes(scene, device)).bounds


def keep_seen(bounds: np.ndarray, cameras: list[Camera], least: int, mask: wp.array) -> None:
    """Clear the voxels of a mask (nx, ny, nz) uint8 over bounds (2, 3) that fewer than `least` cameras see."""
    inputs = [*_node_places(bounds, mask.shape, cameras, mask.device), least]
    launch(keep_seen_voxels, mask.size, inputs, [mask], device=mask.device)


def dilated(mask: wp.array) -> wp.array:
    """The voxels of a mask (nx, ny, nz) uint8 and their 26 neighbours."""
    result = wp.empty_like(mask)
    launch(dilate_mask, mask.size, [mask], [result], device=mask.device)
    return result


def possible_voxels(
    silhouettes: Silhouettes | None,
    cameras: list[Camera],
    bounds: np.ndarray,
    resolution: tuple[int, ...],
    view_share: float,
    device: wp.Device,
    *,
    neighbors: bool = True,
) -> wp.array:
    """(nx, ny, nz) uint8 mask of the voxels of bounds (2, 3) that may hold something of the object.
    Those that a share of the cameras see, inside all silhouettes, and then their neighbours if these are asked for."""
    if silhouettes is None:
        mask = wp.ones(resolution, dtype=wp.uint8, device=device)
    else:
        mask = silhouettes.carve(bounds, resolution)
    keep_seen(bounds, cameras, max(1, math.ceil(view_share * len(cameras))), mask)
    if not mask_count(mask):
        raise InputError(
            "no camera sees the bounds of the field: check the bounds and the cameras' axes"
            if silhouettes is None
            else "no voxel of the bounds lies inside all silhouettes: check bounds, cameras and alphas"
        )
    return dilated(mask) if neighbors and silhouettes is not None else mask


def _node_places(bounds, resolution, cameras: list[Camera], device: wp.DeviceLike) -> list:
    """Position of the first voxel's centre, voxel size and cameras, relative to the middle of `bounds`."""
    bounds = np.asarray(bounds, np.float64)
    voxel_size = (bounds[1] - bounds[0]) / resolution
    center = bounds.mean(axis=0)
    return [
        wp.vec3(*(bounds[0] - center + 0.5 * voxel_size)),
        wp.vec3(*voxel_size),
        camera_array(cameras, center, device),
    ]
