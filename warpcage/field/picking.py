"""Where in a field the pixel of a view points."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ..core.checks import require_type, shown
from ..view.camera import Camera

if TYPE_CHECKING:
    from .voxel_field import VoxelField

#: A pixel shows the place where the light that is left falls to this share; faint floaters before it are passed.
PICKED_TRANSMITTANCE = 0.5


def pick_point(field: VoxelField, camera: Camera, pixel: ArrayLike) -> np.ndarray:
    """The place (3,) float64, world units, that a pixel shows: where half of the light through its middle is gone.
    pixel: column and row, whole numbers from 0 at the top left."""
    require_type(camera, Camera, "a click needs")
    place = np.asarray(pixel)
    whole = place.shape == (2,) and np.issubdtype(place.dtype, np.number) and bool((place == np.floor(place)).all())
    if not whole:
        raise ValueError(f"a pixel is a column and a row, two whole numbers, got {shown(pixel)}")
    column, row = (int(each) for each in place)
    if not (0 <= column < camera.width and 0 <= row < camera.height):
        raise ValueError(
            f"pixel {column} {row} is outside the picture of {camera.width}x{camera.height}: columns go from 0 to "
            f"{camera.width - 1}, rows from 0 to {camera.height - 1}"
        )
    in_camera = np.array([(column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy, 1.0])
    direction = camera.rotation @ (in_camera / np.linalg.norm(in_camera))
    nothing = f"the click at pixel {column} {row} is on nothing: the field is not half opaque there"
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (field.bounds - camera.centre) / direction
    along = np.where(np.isnan(ends), [[-np.inf], [np.inf]], np.sort(ends, axis=0))
    near, far = max(float(along[0].max()), 0.0), float(along[1].min())
    if not near < far:
        raise ValueError(nothing)
    distance = near + field.step * (np.arange(int(np.ceil((far - near) / field.step))) + 0.5)
    points = camera.centre + distance[:, None] * direction
    _, density = field.sample(points, np.broadcast_to(direction, points.shape))
    depth = np.cumsum(np.asarray(density, np.float64)) * field.step
    there = int(np.searchsorted(depth, -np.log(PICKED_TRANSMITTANCE)))
    if there == len(depth):
        raise ValueError(nothing)
    return points[there]
