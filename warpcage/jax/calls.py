"""Calls of Warp from XLA: what the functions of this folder share."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
import warp as wp

from ..core.arrays import as_points
from ..core.names import shown
from ..errors import InputError


@functools.cache
def call(function: Callable[..., None], outputs: int) -> Any:
    """A function of Warp arrays and numbers, the last ones its outputs, as XLA calls it, on CPU and CUDA."""
    # Nothing is captured, as poses are read on the host. Under `jax.vmap` calls follow one another: by default Warp
    # joins what is mapped to longer arrays, as for functions of each row alone.
    mode = wp.JaxCallableGraphMode.NONE
    return wp.jax_callable(_in_order(function), num_outputs=outputs, graph_mode=mode, vmap_method="sequential")


def _in_order(function: Callable[..., None]) -> Callable[..., None]:
    """A function that launches on the stream that Warp has now, behind what XLA has queued and before what it queues
    then: frames and poses keep memory from call to call, which streams must not share."""
    streams = {str(device): device.stream for device in wp.get_cuda_devices()}

    @functools.wraps(function)
    def run(*arguments: Any) -> None:
        device = next(each.device for each in arguments if isinstance(each, wp.array))
        if device.is_cpu:
            function(*arguments)
            return
        with wp.ScopedStream(streams[str(device)], sync_enter=True, sync_exit=True):
            function(*arguments)

    run.__signature__ = inspect.signature(function)  # type: ignore[attr-defined]  # Warp reads this one
    return run


def float_rows(array: Any, name: str) -> Any:
    """An array (n, 3) of single floats; gradients pass."""
    try:
        rows = jnp.asarray(array)
        is_real = not jnp.iscomplexobj(rows)
    except (TypeError, ValueError):
        is_real = False
    if not is_real:
        raise InputError(f"{name} must be real numbers (n, 3), got {shown(array)}")
    rows = rows.astype(jnp.float32)
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise InputError(f"{name} must be (n, 3), got {rows.shape}")
    return rows


def host(array: wp.array[Any]) -> np.ndarray:
    """Small arrays as NumPy, float64; (v, 3) of vertices (v,) vec3."""
    return array.numpy().astype(np.float64)


def write(target: Any, values: Any) -> None:
    """Put points (n,), or weights (n, v), where XLA wants them."""
    wp.copy(target, as_points(values) if target.dtype == wp.vec3 else values)
