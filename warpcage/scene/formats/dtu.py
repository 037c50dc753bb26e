"""DTU folders in the IDR layout: image/, mask/, cameras.npz or cameras_sphere.npz (Yariv et al. 2020)."""
# world_mat_i @ scale_mat_i projects the scene's world, its object in the unit sphere, to pixels of whole centres: +0.5.

from __future__ import annotations

import pathlib
import re
from typing import Any

import numpy as np

from ...core.npz import read_npz
from ...errors import InputError
from ..parsing import held_out, pictures_in
from ..pictures import make_scene
from ..scene import Scene
from ..sizes import View

MARK = "image/ and cameras_sphere.npz or cameras.npz"
FILES = ("cameras_sphere.npz", "cameras.npz")

#: The arrays that are read of a camera file.
MATRICES = re.compile(r"(world|scale)_mat_[0-9]+")

#: Largest skew that is taken for rounding, of the focal length.
SKEW_TOLERANCE = 1e-3


def is_scene(folder: pathlib.Path) -> bool:
    """Whether a folder holds pictures and cameras in the IDR layout."""
    return (folder / "image").is_dir() and any((folder / name).is_file() for name in FILES)


def read(folder: pathlib.Path, *, split: str, masks: bool | str, **options: Any) -> Scene:
    """Read a split: every eighth view is `test`, the others `train`; masks become alphas. Options as `load_scene`."""
    path = next((folder / name for name in FILES if (folder / name).is_file()), folder / FILES[0])
    cameras = read_npz(path, "camera file", MATRICES.fullmatch)
    pictures = pictures_in(folder / "image")
    shapes = pictures_in(folder / "mask") if masks and (folder / "mask").is_dir() else [None] * len(pictures)
    if len(shapes) != len(pictures):
        raise InputError(f"{str(folder)!r} holds {len(pictures)} images and {len(shapes)} masks: one per image needed")
    views, scales = [], []
    for index in held_out(len(pictures), split, folder):
        where = f"{path}: world_mat_{index} @ scale_mat_{index}"
        world, scale = (_matrix(cameras, f"{name}_{index}", path) for name in ("world_mat", "scale_mat"))
        intrinsics, pose = decompose((world @ scale)[:3], where)
        views.append(View(pictures[index], pose, where, intrinsics, mask=shapes[index]))
        scales.append(scale)
    same = all(np.array_equal(scale, scales[0]) for scale in scales)
    return make_scene(
        folder,
        views,
        masks=masks,
        **options,
        beside=pictures,
        bounds=np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]),
        to_source=scales[0] if same else None,
    )


def decompose(projection: np.ndarray, where: str) -> tuple[tuple[float, float, float, float], np.ndarray]:
    """The camera of a projection (3, 4) from world to pixels whose centres are integers: (fx, fy, cx, cy) in pixels,
    the centre of the first one at (0.5, 0.5), and the (4, 4) camera-to-world pose."""
    # Hartley and Zisserman 2004, section 6.2.4: K R is the left 3x3 block; the centre is the null vector.
    block = projection[:, :3]
    scale = np.abs(block).max()
    if not (np.isfinite(projection).all() and scale > 0 and np.linalg.cond(block) < 1e12):
        raise InputError(f"{where} is singular or not finite: no camera")
    projection = projection / (scale * np.sign(np.linalg.det(block / scale)))  # its scale and sign are free
    block = projection[:, :3]
    # RQ by QR: block^-1 = R^-1 K^-1, an orthonormal factor times an upper triangular one
    rotation, inverse = np.linalg.qr(np.linalg.inv(block))
    signs = np.sign(np.diag(inverse))
    rotation, k = rotation * signs, np.linalg.inv(inverse * signs[:, None])
    k = k / k[2, 2]
    if abs(k[0, 1]) > SKEW_TOLERANCE * k[0, 0]:
        raise InputError(f"{where} has skew {k[0, 1]:.3g} pixels: cameras here have none")
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -np.linalg.solve(block, projection[:, 3])
    return (k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5), pose


def _matrix(cameras: dict, name: str, path: pathlib.Path) -> np.ndarray:
    """A (4, 4) float64 matrix of a camera file, completed where it has three rows."""
    if name not in cameras:
        raise InputError(f"{path} lacks {name}: it must hold one matrix per image")
    matrix = cameras[name]
    if matrix.shape == (3, 4) and matrix.dtype.kind in "fiu":
        matrix = np.concatenate([matrix, [[0, 0, 0, 1]]])
    if matrix.shape != (4, 4) or matrix.dtype.kind not in "fiu" or not np.isfinite(matrix).all():
        raise InputError(f"{path}: {name} must be a finite 4x4 matrix, got {matrix.dtype} {matrix.shape}")
    return matrix.astype(np.float64)
