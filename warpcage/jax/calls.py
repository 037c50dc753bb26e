"""Calls of Warp from XLA: what the functions of this folder share."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
import warp as wp

from ..core.arrays import as_points
from ..errors import InputError


@functools.cache
def call(function: Callable[..., None], outputs: int) -> Any:
    """A function of Warp arrays and numbers, the last ones its outputs, as XLA calls it, on CPU and CUDA."""
    # All is launched on XLA's stream. Nothing is captured, as poses are read on the host.
    return wp.jax_callable(function, num_outputs=outputs, graph_mode=wp.JaxCallableGraphMode.NONE)


def float_rows(array: Any, name: str) -> Any:
    """An array (n, 3) of single floats; gradients pass."""
    rows = jnp.asarray(array, dtype=jnp.float32)
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise InputError(f"{name} must be (n, 3), got {rows.shape}")
    return rows


def host(array: wp.array[Any]) -> np.ndarray:
    """Small arrays as NumPy, float64; (v, 3) of vertices (v,) vec3."""
    return array.numpy().astype(np.float64)


def write(target: Any, values: Any) -> None:
    """Put points (n,), or weights (n, v), where XLA wants them."""
    wp.copy(target, as_points(values) if target.dtype == wp.vec3 else values)
