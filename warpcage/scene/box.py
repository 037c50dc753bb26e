"""Where the cameras of a scene look: the box around its object."""

from __future__ import annotations

import numpy as np

from .scene import Scene

#: Where all cameras look the same way, the object is taken to be this many times their largest spread ahead.
PARALLEL_DISTANCE = 4.0


def view_box(scene: Scene) -> np.ndarray:
    """(2, 3) a cube around what the cameras look at.

    Its centre is the point nearest to all optical axes (least squares; ahead of the cameras where those are
    parallel), its half side the largest radius that most cameras see whole, at most their distance to the centre.
    """
    centres = np.stack([camera.centre for camera in scene.cameras])
    axes = np.stack([camera.rotation[:, 2] for camera in scene.cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    system = across.sum(axis=0)
    if np.linalg.cond(system) < 1e6:
        centre = np.linalg.solve(system, (across @ centres[:, :, None])[..., 0].sum(axis=0))
    else:  # one camera, or parallel ones: how far the object is nobody says, so go by how far apart they are
        spread = float(np.ptp(centres, axis=0).max())
        centre = (centres + axes * (PARALLEL_DISTANCE * spread if spread > 0 else 1.0)).mean(axis=0)
    distance = np.linalg.norm(centres - centre, axis=1)
    tangent = np.array([max(camera.width / camera.fx, camera.height / camera.fy) / 2 for camera in scene.cameras])
    # an object that fills the image's longer side at that distance
    half = float(np.median(distance * tangent / np.sqrt(1 + tangent**2))) * 1.2
    half = min(half, 0.95 * float(distance.min())) if distance.min() > 0 else half
    return np.stack([centre - half, centre + half])


def scene_box(scene: Scene) -> np.ndarray:
    """(2, 3) the bounds that the scene's files give, or else view_box.

    Raises ValueError where there are none and the cameras do not look at anything in common: most of them away from the
    centre of that box, or all from one place into several directions.
    """
    if getattr(scene, "bounds", None) is not None:
        return scene.bounds
    box = view_box(scene)
    away = sum((box.mean(axis=0) - camera.centre) @ camera.rotation[:, 2] <= 0 for camera in scene.cameras)
    if 2 * away > len(scene):
        raise ValueError(
            f"{away} of {len(scene)} cameras look away from what the views have in common: check the "
            "cameras' axes, or give the bounds of what should be fitted"
        )
    if not (box[1] > box[0]).all():
        raise ValueError(
            "the cameras do not tell the size of what they look at: check focal lengths and positions, or "
            "give the bounds of what should be fitted"
        )
    return box
