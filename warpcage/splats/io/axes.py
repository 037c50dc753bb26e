"""Where the axes of files point, and splats moved from the axes of one kind of file to those of another."""

from __future__ import annotations

import numpy as np

from .contents import SplatContents

#: Harmonics that change their sign with y and z, of degree 1 to 3: odd in y and z together.
FLIPPED = np.array([1, 1, 0, 1, 0, 0, 1, 0, 1, 0, 1, 1, 0, 1, 0], dtype=bool)


def turned_over(contents: SplatContents) -> SplatContents:
    """Splats with the signs of y and z changed, which is half a turn about x; twice gives the same bits."""
    signs = np.array([1.0, -1.0, -1.0], np.float32)
    harmonics = contents.harmonics.copy()
    flipped = FLIPPED[: harmonics.shape[1] - 1]
    harmonics[:, 1:][:, flipped] *= np.float32(-1.0)
    quaternions = contents.quaternions * np.array([1.0, 1.0, -1.0, -1.0], np.float32)
    return SplatContents(contents.centers * signs, contents.log_scales, quaternions, contents.logits, harmonics)


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
