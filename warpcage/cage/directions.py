"""Directions that poses take: axes by name, or vectors."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..core.checks import axis_index, checked_vector


def direction(axis: str | ArrayLike, name: str = "axis") -> np.ndarray:
    """The unit vector (3,) of an axis: "x", "-x", or a direction (3,) of any length; messages call it by `name`."""
    if isinstance(axis, str):
        sign, index = signed_axis(axis)
        return sign * np.eye(3)[index]
    vector = checked_vector(axis, name)
    longest = np.abs(vector).max()
    if longest == 0.0:
        raise ValueError(f"{name} must be a direction, got (0, 0, 0)")
    vector = vector / longest  # its square may be beyond float64
    return vector / np.linalg.norm(vector)


def signed_axis(name: str) -> tuple[float, int]:
    """Sign and number of an axis such as "-x"."""
    if isinstance(name, str) and name[:1] in ("-", "+"):
        return (-1.0 if name[0] == "-" else 1.0), axis_index(name[1:])
    return 1.0, axis_index(name)


def frame_along(axis: str | ArrayLike, towards: str | ArrayLike | None = None) -> np.ndarray:
    """Unit vectors x, y and z, one a row (3, 3): z along `axis`, x to what is across it of `towards` (None: any)."""
    w = direction(axis, "axis")
    aim = np.eye(3)[int(np.argmin(np.abs(w)))] if towards is None else direction(towards, "towards")
    u = aim - (aim @ w) * w
    if np.linalg.norm(u) < 1e-6:
        raise ValueError(f"a bend needs two different directions, got axis {axis} and towards {towards}")
    u /= np.linalg.norm(u)
    return np.stack([u, np.cross(w, u), w])
