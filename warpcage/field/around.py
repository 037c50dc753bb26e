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
    """Colours that rays see.

    Args:
        kernel: Takes `held`, origins and unit directions (n,) vec3, and writes colours (n,) vec3.
        held: What is looked at, as the kernel takes it.
        center: (3,) what the kernel's origins are relative to, world units.
        origins: (n, 3) float, world units.
        directions: (n, 3) float, of any length but zero.
        device: Warp device.

    Returns:
        (n, 3) float32 colours.

    Raises:
        ValueError: For shapes that differ or are not (n, 3).
    """
    starts, along = as_host_points(origins) - center, as_host_points(directions)
    if starts.shape != along.shape:
        raise ValueError(f"there must be as many directions as origins, got {len(along)} for {len(starts)}")
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    rays = [wp.array(each.astype(np.float32), dtype=wp.vec3, device=device) for each in (starts, along)]
    rgb = empty_array(len(starts), wp.vec3, device)
    launch(kernel, len(starts), [held, *rays], [rgb], device=device)
    return rgb.numpy()
