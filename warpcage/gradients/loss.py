"""The loss of a frame as callers give it, by its derivatives, and the gradient that becomes of it."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import warp as wp

from ..core.arrays import as_numbers, as_points, empty_array
from ..core.devices import launch
from ..errors import InputError
from ..kernels.gradients.frame import sum_runs
from ..view.camera import Camera

#: Rays or splats whose derivatives one item adds up.
RUN = 64


@dataclasses.dataclass(frozen=True, eq=False)
class FrameGradient:
    """Derivatives of a loss of one frame, on its device."""

    # of voxels (nx, ny, nz) vec3, by the canonical position of each node of the map, per world unit
    nodes: wp.array | None = None
    vertices: wp.array | None = None  # (v,) vec3, by the vertices of the posed cage, per world unit
    rest_vertices: wp.array | None = None  # (v,) vec3, by those of the cage at rest; of voxels alone
    camera: np.ndarray | None = None  # (7,) float64: turns about its axes, radians; shifts along them; log focal length
    density: wp.array | None = None  # (rows,) float32, by the field's densities before the ReLU
    harmonics: wp.array | None = None  # (rows, 24 or 27) or (n, 3 bases) float32, by the numbers of its harmonics
    # of n splats, float32, by what their file has of each at rest
    centers: wp.array | None = None  # (n, 3), per world unit
    log_scales: wp.array | None = None  # (n, 3)
    quaternions: wp.array | None = None  # (n, 4) w x y z
    logits: wp.array | None = None  # (n,)


def frame_loss(camera: Camera, device: wp.Device, rgb: Any, alpha: Any, depth: Any) -> dict[str, wp.array]:
    """Derivatives as callers give them, (h, w, 3) or (h, w), by the names of a frame's parts: (h * w,) of vec3 or
    float32 on the device, for those that are not None."""
    loss, pixels = {}, camera.width * camera.height
    if rgb is not None:
        is_flat = isinstance(rgb, wp.array) and rgb.dtype == wp.vec3
        rows = as_points(rgb.flatten() if is_flat else _reshaped(rgb, (-1, 3)), device, name="image_gradient")
        if len(rows) != pixels:
            size = f"({camera.height}, {camera.width}, 3)"
            raise InputError(f"image_gradient must be {size}, got {tuple(rgb.shape)}")
        loss["rgb"] = rows
    for name, values in (("alpha", alpha), ("depth", depth)):
        if values is not None:
            loss[name] = as_numbers(values, pixels, device, name=f"{name}_gradient")
    return loss


def _reshaped(values: Any, shape: tuple[int, ...]) -> Any:
    """An array of any library, or lists, in another shape."""
    return values.reshape(shape) if hasattr(values, "reshape") else np.asarray(values, np.float32).reshape(shape)


def run_sums(rows: wp.array) -> wp.array:
    """(m, k) sums of the columns of (n, k) float32 numbers on a device, each over RUN rows or less."""
    sums = empty_array((-(-rows.shape[0] // RUN), rows.shape[1]), wp.float32, rows.device)
    launch(sum_runs, sums.size, [rows, RUN], [sums], device=rows.device, work=RUN)
    return sums


def column_sums(rows: wp.array) -> np.ndarray:
    """(k,) float64 sums of the columns of (n, k) float32 numbers on a device."""
    return run_sums(rows).numpy().sum(axis=0, dtype=np.float64)
