"""One level of a fit: its rows, gradients and moments."""

from __future__ import annotations

import warp as wp

from ..kernels.field.harmonics import vec9
from ..kernels.fitting.rmsprop import COEFFICIENTS as _COEFFICIENTS
from ..kernels.fitting.rmsprop import GRADIENT_ROW

COEFFICIENTS = int(_COEFFICIENTS)

#: Numbers of a gradient's row: the coefficients, red first, then the density.
ROW_NUMBERS = int(GRADIENT_ROW)


def coefficient_rows(sh: wp.array) -> wp.array:
    """Coefficients (rows, 3) of vec9 as numbers (rows, 27), without a copy."""
    return wp.array(ptr=sh.ptr, dtype=wp.float32, shape=(sh.shape[0], COEFFICIENTS), device=sh.device, copy=False)


def gradient_parts(gradients: wp.array) -> tuple[wp.array, wp.array]:
    """The densities (rows,) and the coefficients (rows, 3) of vec9 of gradients (rows, 28), without a copy."""
    rows, stride = gradients.shape[0], gradients.strides[0]
    density = wp.array(
        ptr=gradients.ptr + COEFFICIENTS * 4,
        dtype=wp.float32,
        shape=rows,
        strides=(stride,),
        device=gradients.device,
        copy=False,
    )
    sh = wp.array(
        ptr=gradients.ptr, dtype=vec9, shape=(rows, 3), strides=(stride, 36), device=gradients.device, copy=False
    )
    return density, sh
