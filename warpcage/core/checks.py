"""Checks of what callers give, and words to them."""

from __future__ import annotations

import os
import pathlib
import sys
import warnings

import numpy as np


def require_type(value, kind: type, what: str) -> None:
    """Raise a ValueError, "`what` a `kind`, got ...", unless `value` is one."""
    if not isinstance(value, kind):
        raise ValueError(f"{what} a {kind.__name__}, got {type(value).__name__}")


def checked_bounds(bounds) -> np.ndarray:
    """(2, 3) float64, read-only. Raises ValueError where they are not two finite corners, the lower one first."""
    bounds = np.array(bounds, dtype=np.float64)
    if bounds.shape != (2, 3) or not np.isfinite(bounds).all() or not (bounds[1] > bounds[0]).all():
        raise ValueError(f"bounds must be (2, 3), finite, lower below upper, got {bounds.tolist()}")
    bounds.setflags(write=False)
    return bounds


#: The folder of the whole package: frames in it are not the caller's.
_PACKAGE = str(pathlib.Path(__file__).parents[1]) + os.sep


def warn_caller(message: str) -> None:
    """A UserWarning at the innermost line outside this package, however deep below it the call is."""
    depth, frame = 1, sys._getframe(1)
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_PACKAGE):
        depth, frame = depth + 1, frame.f_back
    warnings.warn(message, stacklevel=depth + 1)
