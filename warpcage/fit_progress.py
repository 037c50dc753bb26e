"""Progress of a fit on disk, so that a killed one goes on."""

from __future__ import annotations

import hashlib
import json
import pathlib

import numpy as np
import warp as wp

from .archives import read_npz
from .files import atomic_path
from .kernels.spherical_harmonics import vec9

VERSION = 1


def require_writable(path) -> pathlib.Path:
    """`path` as a Path. Raises ValueError where it does not end in .npz or is a folder."""
    path = pathlib.Path(path)
    if path.suffix != ".npz" or path.is_dir():
        raise ValueError(f"a checkpoint is a file that ends in .npz, got {str(path)!r}")
    return path


def save_progress(optimizer, path) -> None:
    """Write what a FieldOptimizer has reached, atomically: voxels, values, second moments, order of the pixels.

    Second moments are kept as the float16 logarithm, good to 2 %: they only scale steps.
    """
    grid = optimizer.field.grid
    occupied = grid.links.numpy() >= 0
    contents = {
        "format": np.array("warpcage fit"),
        "version": np.array(VERSION),
        "fingerprint": np.array(fingerprint(optimizer)),
        "state": np.array(json.dumps({
            "step_count": optimizer.step_count, "level": optimizer.level, "level_steps": optimizer.level_steps,
            "cursor": optimizer.cursor, "random": optimizer.random.bit_generator.state,
        })),
        "resolution": np.array(optimizer.field.resolution, np.int32),
        "occupancy": np.packbits(occupied.ravel()),
        "density": grid.density.numpy(),
        "sh": grid.sh.numpy(),
        "tiles": optimizer.rays.tiles.numpy(),
        "moment_density": _log_half(optimizer.moments[0].numpy()),
        "moment_sh": _log_half(optimizer.moments[1].numpy()),
    }
    with atomic_path(path) as temporary:
        np.savez(temporary, **contents)


def load_progress(optimizer, path) -> None:
    """Put a fresh FieldOptimizer where a saved one was.

    Raises ValueError for a file that is no checkpoint, or one of another scene, seed or options.
    """
    contents = read_npz(path, "checkpoint")
    if str(contents.get("format", "")) != "warpcage fit" or int(contents.get("version", -1)) != VERSION:
        raise ValueError(f"{path} is no fit checkpoint of this version: remove it or name another file")
    if str(contents["fingerprint"]) != fingerprint(optimizer):
        raise ValueError(f"{path} is the checkpoint of another fit (scene, seed or options differ): remove it or name "
                         "another file")
    state = json.loads(str(contents["state"]))
    shape = tuple(int(n) for n in contents["resolution"])
    occupied = np.unpackbits(contents["occupancy"], count=int(np.prod(shape))).reshape(shape)
    optimizer.restore_field(wp.array(occupied.astype(np.int32), device=optimizer.device))
    for target, values, dtype in (
        (optimizer.field.grid.density, contents["density"], wp.float32),
        (optimizer.field.grid.sh, contents["sh"], vec9),
        (optimizer.moments[0], _exp_half(contents["moment_density"]), wp.float32),
        (optimizer.moments[1], _exp_half(contents["moment_sh"]), vec9),
    ):
        target.assign(wp.array(values, dtype=dtype, device=optimizer.device))
    optimizer.step_count, optimizer.level = state["step_count"], state["level"]
    optimizer.level_steps = state["level_steps"]
    optimizer.total_steps = sum(optimizer.level_steps)
    optimizer.random.bit_generator.state = state["random"]
    optimizer.rays.tiles = wp.array(contents["tiles"], dtype=wp.int32, device=optimizer.device)
    optimizer.cursor = state["cursor"]


def fingerprint(optimizer) -> str:
    """Hash of the scene's pixels and cameras, and of the options: what a fit depends on."""
    scene = optimizer.scene
    digest = hashlib.sha256(json.dumps(optimizer.given, sort_keys=True).encode())
    digest.update(np.ascontiguousarray(scene.images[:, ::7, ::7]).tobytes())
    digest.update(str(scene.images.shape).encode())
    for camera in scene.cameras:
        digest.update(camera.camera_to_world.tobytes())
        digest.update(np.array([camera.fx, camera.fy, camera.cx, camera.cy]).tobytes())
    return digest.hexdigest()


def _log_half(moments: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore"):
        return np.log2(moments).astype(np.float16)


def _exp_half(logarithms: np.ndarray) -> np.ndarray:
    return np.exp2(logarithms.astype(np.float32))
