"""Warnings that name the line of the user's program which led to them."""

from __future__ import annotations

import os
import pathlib
import sys
import warnings

_PACKAGE = str(pathlib.Path(__file__).parent) + os.sep


def warn_caller(message: str) -> None:
    """A UserWarning at the innermost line outside this package, however deep below it the call is."""
    depth, frame = 1, sys._getframe(1)
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_PACKAGE):
        depth, frame = depth + 1, frame.f_back
    warnings.warn(message, stacklevel=depth + 1)
