"""Pictures with opacity: straight colours, and colours that go on beyond an edge."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from ..mesh.mesh import ClosedMesh
from .camera import Camera
from .frame import Frame
from .overlay import draw_cage
from .pictures import with_opacity

#: How far colours go on beyond an edge, pixels: the blocks of video codecs are 8 to 32 pixels wide.
REACH = 24

#: Opacity below which 8 bits show nothing.
CLEAR = 0.5 / 255.0


def rgba_picture(frame: Frame, camera: Camera | None = None, cages: Sequence[ClosedMesh] = ()) -> np.ndarray:
    """Straight colours and opacity (h, w, 4) float32 in [0, 1] of a frame rendered on black; black for nothing seen.
    Edges of cages, drawn into it, need the camera."""
    colors = np.maximum(frame.rgb, 0.0)
    clear = np.repeat(1.0 - np.clip(frame.alpha, 0.0, 1.0)[..., None], 3, axis=-1)
    for cage in cages:
        assert camera is not None
        colors = draw_cage(colors, camera, cage)
        clear = draw_cage(clear, camera, cage, color=(0.0, 0.0, 0.0))  # what is behind, through the same lines
    alpha = 1.0 - clear[..., :1]
    return with_opacity(colors, alpha)


def with_spread_colors(rgba: ArrayLike, reach: int = REACH) -> np.ndarray:
    """A picture (h, w, 4), in [0, 1], whose colours go on where it is clear, each from the nearest place that is not.
    They are straight, and go on for `reach` pixels."""
    # Codecs halve colours apart from opacity: the black behind clear pixels would be a dark rim around the object.
    from scipy.ndimage import distance_transform_edt

    spread = np.array(rgba, np.float32)
    clear = spread[..., 3] < CLEAR
    if clear.all() or not clear.any():
        return spread
    # SciPy's stubs know no more than that it returns something
    distance, (row, column) = distance_transform_edt(clear, return_indices=True)  # pyright: ignore[reportGeneralTypeIssues]
    filled = clear & (distance <= reach)
    spread[filled, :3] = spread[row[filled], column[filled], :3]
    return spread
