"""Where the object of a scene is: a box from its cameras, tightened by its alphas."""

from __future__ import annotations

import numpy as np
import warp as wp

from .devices import launch
from .kernels.grid_refine import carve_visual_hull
from .kernels.rays import PinholeCamera
from .render import camera_struct
from .scene import Scene

#: Alpha above which a pixel counts as part of the object (of 1).
OPAQUE = 0.5 / 255


def view_box(scene: Scene) -> np.ndarray:
    """(2, 3) a cube around what the cameras look at.

    Its centre is the point nearest to all optical axes (least squares; the mean of what they look at where they are
    parallel), its half side the largest radius that most cameras see whole, at most their distance to the centre.
    """
    centres = np.stack([camera.centre for camera in scene.cameras])
    axes = np.stack([camera.rotation[:, 2] for camera in scene.cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    system = across.sum(axis=0)
    if np.linalg.cond(system) < 1e6:
        centre = np.linalg.solve(system, (across @ centres[:, :, None])[..., 0].sum(axis=0))
    else:  # one camera, or parallel ones: nothing says how far the object is, so take a unit distance
        centre = (centres + axes).mean(axis=0)
    distance = np.linalg.norm(centres - centre, axis=1)
    tangent = np.array([max(camera.width / camera.fx, camera.height / camera.fy) / 2 for camera in scene.cameras])
    # an object that fills the image's longer side at that distance
    half = float(np.median(distance * tangent / np.sqrt(1 + tangent**2))) * 1.2
    half = min(half, 0.95 * float(distance.min())) if distance.min() > 0 else half
    return np.stack([centre - half, centre + half])


def visual_hull(scene: Scene, bounds, resolution, device) -> wp.array:
    """(nx, ny, nz) int32 mask of the voxels that no image shows as transparent, at `resolution` over `bounds`."""
    bounds = np.asarray(bounds, np.float64)
    center = bounds.mean(axis=0)
    voxel_size = (bounds[1] - bounds[0]) / resolution
    opaque = scene.alphas > OPAQUE
    sums = np.zeros((len(scene), opaque.shape[1] + 1, opaque.shape[2] + 1), np.int32)
    np.cumsum(np.cumsum(opaque, axis=1, dtype=np.int32), axis=2, out=sums[:, 1:, 1:])
    bounded = ~(opaque[:, [0, -1]].any(axis=(1, 2)) | opaque[:, :, [0, -1]].any(axis=(1, 2)))
    mask = wp.empty(tuple(int(n) for n in resolution), dtype=wp.int32, device=device)
    lower = bounds[0] - center + 0.5 * voxel_size
    inputs = [wp.vec3(*lower), wp.vec3(*voxel_size), camera_array(scene.cameras, center, device),
              wp.array(sums, dtype=wp.int32, device=device), wp.array(bounded, dtype=wp.int32, device=device)]
    launch(carve_visual_hull, mask.size, inputs, [mask], device=device)
    return mask


def object_bounds(scene: Scene, device, *, resolution: int = 64, rounds: int = 2) -> np.ndarray:
    """(2, 3) box of the object: view_box, shrunk to the visual hull where the scene has alphas.

    Raises ValueError where every pixel is transparent or the silhouettes of the views have no common inside.
    """
    box = view_box(scene)
    if scene.alphas is None:
        return box
    if not (scene.alphas > OPAQUE).any():
        raise ValueError("every pixel of the scene is transparent: there is nothing to fit")
    for _ in range(rounds):
        shape = np.maximum(8, np.ceil(resolution * (box[1] - box[0]) / (box[1] - box[0]).max()).astype(int))
        occupied = np.argwhere(visual_hull(scene, box, shape, device).numpy())
        if len(occupied) == 0:
            raise ValueError("the silhouettes of the views have no common inside: check cameras' axes and alphas")
        voxel = (box[1] - box[0]) / shape
        box = np.stack([box[0] + (occupied.min(axis=0) - 1) * voxel, box[0] + (occupied.max(axis=0) + 2) * voxel])
    return box


def camera_array(cameras, origin, device) -> wp.array:
    """Cameras as kernels take them, relative to `origin` (3,)."""
    return wp.array([camera_struct(camera, origin) for camera in cameras], dtype=PinholeCamera, device=device)
