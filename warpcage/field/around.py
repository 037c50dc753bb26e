"""What rays see of what lies around a field."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arrays import as_host_points, empty_array
from ..core.devices import launch
from ..core.modules import Kernel


def seen_by_rays(
    kernel: Kernel, held: Any, center: np.ndarray, origins: ArrayLike, directions: ArrayLike, device: wp.Device
) -> np.ndarray:
    """Colours (n, 3) float32 that rays see; origins (n, 3), world units, directions (n, 3) of any length but zero."""
    starts, along = as_host_points(origins) - center, as_host_points(directions)
    if starts.shape != along.shape:
        raise ValueError(f"there must be as many directions as origins, got {len(along)} for {len(starts)}")
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    rays = [wp.array(each.astype(np.float32), dtype=wp.vec3, device=device) for each in (starts, along)]
    rgb = empty_array(len(starts), wp.vec3, device)
    # the kernel has origins relative to the centre and unit directions, all (n,) vec3
    launch(kernel, len(starts), [held, *rays], [rgb], device=device)
    return rgb.numpy()
