"""Where the object of a capture stands: up is +z, the object around the origin, its box two units long."""

from __future__ import annotations

import numpy as np

from ..scene.box import bulk_box, view_box
from ..scene.scene import rotation_to
from ..view.camera import Camera, common_up
from .found import Found


def placed(found: Found) -> Found:
    """The cameras and points of a capture, from COLMAP's own frame and unit, in coordinates of its object."""
    # Up for the cameras becomes +z (`common_up`), the first camera stands at -y, the middle of the object's box becomes
    # the origin and its longest side two units.
    upright = rotation_to(common_up(_cameras(found)), np.array([0.0, 0.0, 1.0]))
    turned = found.moved(np.eye(3) if upright is None else upright[:3, :3], np.zeros(3), 1.0)
    centre = object_box(turned).mean(axis=0)
    x, y = (turned.poses[0, :3, 3] - centre)[:2]
    turn = -0.5 * np.pi - np.arctan2(y, x)
    about = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    turned = turned.moved(about, np.zeros(3), 1.0)
    box = object_box(turned)
    return turned.moved(np.eye(3), box.mean(axis=0), 2.0 / float((box[1] - box[0]).max()))


def object_box(found: Found) -> np.ndarray:
    """The box of the object (2, 3), lower and upper corner, as `load_scene` finds it from a scene's points."""
    # It is around the bulk of the points that the cameras look at, or what they look at where points are few.
    cameras = _cameras(found)
    seen = view_box(cameras)
    box = bulk_box(found.points, seen, common_up(cameras))
    return seen if box is None else box


def _cameras(found: Found) -> list[Camera]:
    """Pinhole cameras of the pictures, without what the lenses bend."""
    return [Camera(*lens.intrinsics, *lens.size, pose) for lens, pose in zip(found.lenses, found.poses, strict=True)]
