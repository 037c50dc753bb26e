"""Five small fields that are hard for cages, made from formulas: thin, concave, ring, two parts, tall."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..core.checks import checked_whole
from ..core.names import checked_choice
from ..field.voxel_field import VoxelField

#: Half the side of the cube that every scene lies in.
HALF = 1.0


def _thin(x: np.ndarray) -> np.ndarray:
    """A curled leaf: a disc, 1/100 as thick as wide."""
    radius = np.hypot(x[..., 0], x[..., 1])
    height = x[..., 2] - 0.35 * (x[..., 0] ** 2 - x[..., 1])
    return np.maximum(np.abs(height) - 0.02, radius - 0.75)


def _concave(x: np.ndarray) -> np.ndarray:
    """A bowl on its side with a thick wall."""
    radius = np.linalg.norm(x, axis=-1)
    return np.maximum(np.maximum(radius - 0.8, 0.6 - radius), x[..., 0] - 0.25)


def _ring(x: np.ndarray) -> np.ndarray:
    """A ring, tilted by 30 degrees."""
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    y, z = c * x[..., 1] - s * x[..., 2], s * x[..., 1] + c * x[..., 2]
    return np.hypot(np.hypot(x[..., 0], y) - 0.6, z) - 0.16


def _two_parts(x: np.ndarray) -> np.ndarray:
    """A ball and a block that do not touch."""
    ball = np.linalg.norm(x - [-0.5, 0.0, 0.2], axis=-1) - 0.3
    block = (np.abs(x - [0.5, 0.1, -0.2]) - [0.2, 0.45, 0.3]).max(axis=-1)
    return np.minimum(ball, block)


def _tall(x: np.ndarray) -> np.ndarray:
    """A tower that turns and narrows towards the top."""
    turn = np.pi / 3 * x[..., 2]
    u = np.cos(turn) * x[..., 0] + np.sin(turn) * x[..., 1]
    v = np.cos(turn) * x[..., 1] - np.sin(turn) * x[..., 0]
    side = 0.14 - 0.06 * x[..., 2]
    return np.maximum(np.maximum(np.abs(u), np.abs(v)) - side, np.abs(x[..., 2]) - 0.9)


#: Name -> function of points (..., 3) that is negative inside the object.
CAGE_SCENES = {"thin": _thin, "concave": _concave, "ring": _ring, "two parts": _two_parts, "tall": _tall}


def scene_field(name: str, resolution: int = 48, device: wp.DeviceLike = None) -> VoxelField:
    """A grey field of one of `CAGE_SCENES` over the cube [-1, 1]^3; resolution: voxels along each side, 8 or more."""
    checked_choice(name, "scene", tuple(CAGE_SCENES))
    checked_whole(resolution, "resolution", 8)
    axis = HALF * ((np.arange(resolution) + 0.5) * 2.0 / resolution - 1.0)
    x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    # opaque within a voxel of the surface, so that thin walls show too
    density = 60.0 * np.clip(0.5 - CAGE_SCENES[name](x) * 0.5 * resolution, 0.0, 1.0)
    sh = np.zeros((*density.shape, 9, 3), np.float32)
    return VoxelField.from_dense(density, sh, [[-HALF] * 3, [HALF] * 3], device=device)
