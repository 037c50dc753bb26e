"""Arrays in and out: NumPy, DLPack and `__cuda_array_interface__` in; NumPy or Warp out, as the caller's were."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import warp as wp

from .devices import resolve_device

#: Points as callers give them: NumPy, sequences, Warp arrays, or anything with DLPack or `__cuda_array_interface__`.
AnyArray: TypeAlias = Any

#: An instance of a Warp struct. `wp.struct` makes a value of the class, which no annotation can name.
WarpStruct: TypeAlias = Any


def is_device_array(array: AnyArray) -> bool:
    """Whether an array is a Warp array or a foreign one (torch, CuPy, JAX) rather than NumPy or a sequence.

    Args:
        array: What was given.

    Returns:
        Whether it is.
    """
    if isinstance(array, wp.array):
        return True
    if isinstance(array, np.ndarray | list | tuple):
        return False
    # DLPack first: torch refuses even to say whether a tensor that requires grad has the other
    return hasattr(array, "__dlpack__") or hasattr(array, "__cuda_array_interface__")


def as_points(points: AnyArray, device: wp.DeviceLike = None, *, name: str = "points") -> tuple[wp.array, bool]:
    """Points as a Warp array on a device.

    Args:
        points: (n, 3) float. Arrays on a device are not copied where they are float32, contiguous and there already.
        device: Warp device. None is the device of an array on a device, else CUDA where there is one.
        name: What messages call the points.

    Returns:
        (n,) vec3, and whether results should go back as Warp arrays.

    Raises:
        ValueError: For another shape, or for values that are not finite (NumPy input only: arrays on a device are not
            read back).
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
            return (array if array.device == target else array.to(target)), True  # pyright: ignore[reportReturnType]
        if array.dtype == wp.float32 and array.is_contiguous:
            there = array if array.device == target else array.to(target)
            return there.view(wp.vec3), True  # pyright: ignore[reportReturnType]
        # another precision or layout: through the host, once
        host = np.ascontiguousarray(array.numpy(), dtype=np.float32).reshape(-1, 3)
        return wp.array(host, dtype=wp.vec3, device=target), True
    host = as_host_points(points, name=name)
    return wp.array(host.astype(np.float32), dtype=wp.vec3, device=resolve_device(device)), False


def as_host_points(points: AnyArray, *, name: str = "points") -> np.ndarray:
    """Points as a NumPy copy.

    Args:
        points: (n, 3) real numbers.
        name: What messages call the points.

    Returns:
        (n, 3) float64.

    Raises:
        ValueError: For anything but real numbers, another shape, or values that are not finite.
    """
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


def _from_foreign(array: AnyArray, name: str) -> wp.array:
    if getattr(array, "requires_grad", False):
        array = array.detach()
    try:
        return wp.from_dlpack(array) if hasattr(array, "__dlpack__") else wp.array(array, copy=False)  # pyright: ignore[reportReturnType]
    except Exception as error:
        raise ValueError(f"{name} of type {type(array).__name__} could not be read through DLPack: {error}") from error


def array_view(
    owner: wp.array,
    dtype: type,
    shape: int | tuple[int, ...],
    *,
    device: wp.DeviceLike = None,
    offset: int = 0,
    strides: tuple[int, ...] | None = None,
) -> wp.array:
    """The memory of an array as an array of another type, shape or device. It keeps its owner alive.

    Warp's own views (slices, `reshape`, `view`) do so as well, where they can say what is wanted.

    Args:
        owner: The array whose memory it is.
        dtype: Type of the items of the view.
        shape: Items along each axis of the view.
        device: Device that the view is used on: for pinned host memory a CUDA device. None is the owner's.
        offset: Bytes from the owner's first item to the view's.
        strides: Bytes from item to item along each axis of the view. None is without gaps.

    Returns:
        The view. It holds the same memory as `owner`, whose lifetime it extends.
    """
    view = wp.array(
        ptr=None if owner.ptr is None else owner.ptr + offset,  # None: it has no items
        dtype=dtype,
        shape=shape,
        strides=strides,
        device=owner.device if device is None else device,
        copy=False,
    )
    view._ref = owner  # where Warp's own views keep theirs
    return view


def empty_array(shape: int | tuple[int, ...], dtype: type, device: wp.DeviceLike) -> wp.array:
    """A new array that is not filled in.

    Args:
        shape: Items along each axis.
        dtype: Type of the items.
        device: Warp device.

    Returns:
        The array.
    """
    return wp.empty(shape, dtype=dtype, device=device)  # pyright: ignore[reportArgumentType]
