"""Harmonics of turned splats."""

from __future__ import annotations

import functools

import numpy as np

#: Splats that are turned at a time.
CHUNK = 1 << 15


def sh_basis(directions: np.ndarray) -> np.ndarray:
    """The real harmonics of kernels/field/harmonics.py, degree 0 to 3: (..., 16) float64 at unit vectors (..., 3)."""
    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    xx, yy, zz = x * x, y * y, z * z
    return np.stack(
        [
            np.full_like(x, 0.28209479177387814),
            -0.4886025119029199 * y,
            0.4886025119029199 * z,
            -0.4886025119029199 * x,
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2.0 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
            -0.5900435899266435 * y * (3.0 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4.0 * zz - xx - yy),
            0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
            -0.4570457994644658 * x * (4.0 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3.0 * yy),
        ],
        axis=-1,
    )


def turned_harmonics(harmonics: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Coefficients (n, b, 3) float32 of d -> f(R^-1 d) from those of f, b = 1, 4, 9 or 16; rotations: R (n, 3, 3).
    That is a splat and its highlights, turned by R."""
    turned = harmonics.astype(np.float32, copy=True)
    degree = int(round(np.sqrt(harmonics.shape[1]))) - 1
    if degree == 0:
        return turned
    directions, parts = _probes()
    for begin in range(0, len(harmonics), CHUNK):
        chunk = slice(begin, begin + CHUNK)
        seen = sh_basis(directions @ rotations[chunk])  # rows d^T R are R^-1 d
        # A turned harmonic is a sum of those of its own degree: it is evaluated in some directions, and taken apart
        # again.
        for band in range(1, degree + 1):
            own = slice(band**2, (band + 1) ** 2)
            values = seen[..., own] @ harmonics[chunk, own].astype(np.float64)
            turned[chunk, own] = parts[band] @ values
    return turned


@functools.cache
def _probes() -> tuple[np.ndarray, list[np.ndarray]]:
    """Directions (k, 3) evenly over the sphere, and for each degree what takes values there apart, (2 l + 1, k)."""
    count = 24
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    angle = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    ring = np.sqrt(1.0 - z * z)
    directions = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
    basis = sh_basis(directions)
    return directions, [np.linalg.pinv(basis[:, band**2 : (band + 1) ** 2]) for band in range(4)]
