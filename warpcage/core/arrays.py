"""Arrays in and out: NumPy, DLPack and `__cuda_array_interface__` in; NumPy or Warp out, as the caller's were."""

from __future__ import annotations

import numpy as np
import warp as wp

from .devices import resolve_device


def is_device_array(array) -> bool:
    """Whether `array` is a Warp array or a foreign one (torch, CuPy, JAX) rather than NumPy or a sequence."""
    if isinstance(array, wp.array):
        return True
    if isinstance(array, np.ndarray | list | tuple):
        return False
    # DLPack first: torch refuses even to say whether a tensor that requires grad has the other
    return hasattr(array, "__dlpack__") or hasattr(array, "__cuda_array_interface__")


def as_points(points, device=None, *, name: str = "points") -> tuple[wp.array, bool]:
    """`points` as a Warp array of wp.vec3 on a device, and whether results should go back as Warp arrays.

    points: (n, 3) float, NumPy / sequence, or any DLPack or `__cuda_array_interface__` array (then without a copy
    where it is float32, contiguous and on that device already; its own device is taken where `device` is None).
    Raises ValueError for another shape or for values that are not finite (NumPy input only: arrays on a device are
    not read back).
    """
    if is_device_array(points):
        array = points if isinstance(points, wp.array) else _from_foreign(points, name)
        if array.dtype in (wp.vec3, wp.vec3d):
            if array.ndim != 1:
                raise ValueError(f"{name} must be (n, 3), got {array.shape} of {array.dtype.__name__}")
        elif array.ndim != 2 or array.shape[1] != 3:
            raise ValueError(f"{name} must be (n, 3), got {tuple(array.shape)}")
        target = array.device if device is None else resolve_device(device)
        if array.dtype == wp.vec3:
            return (array if array.device == target else array.to(target)), True
        if array.dtype == wp.float32 and array.is_contiguous:
            return array.to(target).view(wp.vec3) if array.device != target else array.view(wp.vec3), True
        # another precision or layout: through the host, once
        host = np.ascontiguousarray(array.numpy(), dtype=np.float32).reshape(-1, 3)
        return wp.array(host, dtype=wp.vec3, device=target), True
    host = as_host_points(points, name=name)
    return wp.array(host.astype(np.float32), dtype=wp.vec3, device=resolve_device(device)), False


def as_host_points(points, *, name: str = "points") -> np.ndarray:
    """(n, 3) float64 NumPy copy of `points`. Raises ValueError for what are no real numbers, another shape or values
    that are not finite."""
    try:
        host = np.asarray(points.numpy() if isinstance(points, wp.array) else points)
        host = host.astype(np.float64, casting="unsafe" if host.dtype == object else "same_kind")
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be (n, 3) real numbers, got {type(points).__name__}") from None
    if host.shape == (0,):  # an empty list
        host = host.reshape(0, 3)
    if host.ndim != 2 or host.shape[1] != 3:
        raise ValueError(f"{name} must be (n, 3), got {host.shape}")
    if not np.isfinite(host).all():
        row = int(np.flatnonzero(~np.isfinite(host).all(axis=1))[0])
        raise ValueError(f"{name} must be finite, row {row} is {host[row]}")
    return host


def _from_foreign(array, name: str) -> wp.array:
    if getattr(array, "requires_grad", False):
        array = array.detach()
    try:
        return wp.from_dlpack(array) if hasattr(array, "__dlpack__") else wp.array(array, copy=False)
    except Exception as error:
        raise ValueError(f"{name} of type {type(array).__name__} could not be read through DLPack: {error}") from error
