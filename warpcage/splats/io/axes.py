"""Where the axes of files point, and splats moved from the axes of one kind of file to those of another."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike

from ...errors import InputError
from .contents import SplatContents

#: Where x, y and z of each kind of file point: right or left, down or up, front or back. A field has those of PLY.
OWN, SPZ_AXES, GLTF_AXES = "RDF", "RUB", "LUF"

_DIRECTIONS = {"R": (1, 0, 0), "L": (-1, 0, 0), "D": (0, 1, 0), "U": (0, -1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}

#: The axes whose signs change that of each harmonic, of degree 1 to 3.
_ODD = "y z x xy yz . xz . y xyz y z x z x".split()


def axes_matrix(axes: str) -> np.ndarray:
    """The matrix (3, 3) from the axes of a file, three letters such as "RUB", to those of a field."""
    return np.array([_DIRECTIONS[letter] for letter in axes], np.float64).T


def turned(contents: SplatContents, matrix: np.ndarray) -> SplatContents:
    """Splats turned or mirrored by an orthogonal matrix (3, 3) about the origin. One that only changes signs of axes
    rounds nothing: twice gives the same bits."""
    if np.array_equal(matrix, np.eye(3)):
        return contents
    harmonics = contents.harmonics.copy()
    further = harmonics.shape[1] - 1
    signs = np.diag(matrix)
    if np.array_equal(np.abs(matrix), np.eye(3)):
        x, y, z = signs.astype(np.float32)
        centers = contents.centers * signs.astype(contents.centers.dtype)
        quaternions = contents.quaternions * np.array([1.0, y * z, x * z, x * y], np.float32)
        sign_of = {"x": x, "y": y, "z": z, ".": np.float32(1.0)}
        harmonics[:, 1:] *= np.array([np.prod([sign_of[a] for a in odd]) for odd in _ODD[:further]], np.float32)[
            :, None
        ]
    else:
        centers = (contents.centers.astype(np.float64) @ matrix.T).astype(contents.centers.dtype)
        # a mirrored splat is as well a turned one: it looks the same from both ends of its axes
        turn = _quaternion_of(matrix * np.linalg.det(matrix))
        quaternions = _product(turn, contents.quaternions.astype(np.float64)).astype(np.float32)
        harmonics[:] = np.einsum("ab,nbc->nac", harmonics_matrix(matrix, harmonics.shape[1]), harmonics)
    return dataclasses.replace(contents, centers=centers, quaternions=quaternions, harmonics=harmonics, layout=None)


def turned_over(contents: SplatContents) -> SplatContents:
    """Splats with the signs of y and z changed, which is half a turn about x; twice gives the same bits."""
    return turned(dataclasses.replace(contents, layout=None), axes_matrix(SPZ_AXES))


def placed(contents: SplatContents, rotation: np.ndarray, offset: ArrayLike, scale: float) -> SplatContents:
    """Splats scaled, turned (3, 3) and moved; those that stay are as they were."""
    shift = np.asarray(offset, np.float64)
    if scale == 1.0 and not shift.any() and np.array_equal(rotation, np.eye(3)):
        return contents
    whole = turned(contents, rotation)
    centers = scale * (contents.centers.astype(np.float64) @ rotation.T) + shift
    log_scales = contents.log_scales.astype(np.float64) + np.log(scale)
    return dataclasses.replace(
        whole,
        centers=centers.astype(contents.centers.dtype),
        log_scales=log_scales.astype(contents.log_scales.dtype),
        layout=None,
    )


#: How far a node's axes may be from those of a turned and evenly scaled one.
_EVEN = 1e-4


def placed_by(contents: SplatContents, matrix: np.ndarray, where: str = "a node") -> SplatContents:
    """Splats at the place of a node, a matrix (4, 4) for columns; ValueError for one that stretches them unevenly.
    Where it moves them the centers are float64. where: for messages."""
    if np.array_equal(matrix, np.eye(4)):
        return contents
    axes = matrix[:3, :3]
    if not np.isfinite(matrix).all():
        raise InputError(f"{where} is at no place: its matrix is not finite")
    scale = float(np.cbrt(abs(np.linalg.det(axes))))
    if not scale > 0.0 or np.abs(axes.T @ axes / scale**2 - np.eye(3)).max() > _EVEN:
        raise InputError(f"{where} stretches its splats unevenly: only turned, moved and evenly scaled ones are read")
    left, _, right = np.linalg.svd(axes / scale)
    moved = dataclasses.replace(contents, centers=contents.centers.astype(np.float64))
    return placed(moved, left @ right, matrix[:3, 3], scale)


def harmonics_matrix(matrix: np.ndarray, count: int) -> np.ndarray:
    """(count, count) what takes harmonics to those of the world moved by an orthogonal matrix (3, 3)."""
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    # a colour that was seen along d is now seen along M d
    after, before = sh_basis(directions)[:, :count], sh_basis(directions @ matrix)[:, :count]
    return np.linalg.lstsq(after, before, rcond=None)[0]


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


def _quaternion_of(rotation: np.ndarray) -> np.ndarray:
    """(4,) w x y z of a rotation matrix (3, 3)."""
    r = rotation
    # the quaternion is the eigenvector of the largest eigenvalue (Bar-Itzhack 2000), which no case is left out of
    k = np.array(
        [
            [r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 0] - r[1, 1] - r[2, 2], r[1, 0] + r[0, 1], r[0, 2] + r[2, 0]],
            [r[0, 2] - r[2, 0], r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], r[2, 1] + r[1, 2]],
            [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[2, 1] + r[1, 2], r[2, 2] - r[0, 0] - r[1, 1]],
        ]
    )
    return np.linalg.eigh(k)[1][:, -1]


def _product(turn: np.ndarray, quaternions: np.ndarray) -> np.ndarray:
    """(n, 4) turn (4,) after quaternions (n, 4), all w x y z; those of length zero, which turn nothing, count as 1."""
    whole = np.where(np.abs(quaternions).max(axis=1, keepdims=True, initial=0.0) > 0.0, quaternions, [1.0, 0, 0, 0])
    w, v = whole[:, :1], whole[:, 1:]
    scalar = turn[0] * w - v @ turn[1:, None]
    return np.concatenate([scalar, turn[0] * v + w * turn[1:] + np.cross(turn[1:], v)], axis=1)
