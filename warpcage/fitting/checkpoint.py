"""Progress of a fit on disk, so that a killed one goes on."""

from __future__ import annotations

import hashlib
import json
import math
import pathlib

import numpy as np
import warp as wp

from ..core.files import atomic_path, read_npz, require_numbers
from ..kernels.field.harmonics import vec9
from .pictures import PRECISIONS

VERSION = 2


def require_writable(path) -> pathlib.Path:
    """`path` as a Path. Raises ValueError where it does not end in .npz or is a folder."""
    path = pathlib.Path(path)
    if path.suffix != ".npz" or path.is_dir():
        raise ValueError(f"a checkpoint is a file that ends in .npz, got {str(path)!r}")
    return path


def save_progress(optimizer, path) -> None:
    """Write what a FieldOptimizer has reached, atomically: voxels, values, second moments, order of the pixels."""
    grid = optimizer.field.grid
    occupied = grid.links.numpy() >= 0
    contents = {
        "format": np.array("warpcage fit"),
        "version": np.array(VERSION),
        "fingerprint": np.array(fingerprint(optimizer)),
        "state": np.array(
            json.dumps(
                {
                    "step_count": optimizer.step_count,
                    "level": optimizer.level,
                    "level_steps": optimizer.level_steps,
                    "shapes": optimizer.shapes,
                    "picture_bits": optimizer.pictures.bits,
                    "cursor": optimizer.cursor,
                    "random": optimizer.random.bit_generator.state,
                }
            )
        ),
        "resolution": np.array(optimizer.field.resolution, np.int32),
        "occupancy": np.packbits(occupied.ravel()),
        "density": grid.density.numpy(),
        "sh": grid.sh.numpy(),
        "tiles": optimizer.rays.tiles.numpy(),
        "moments": moment_bits(optimizer.moments).numpy(),
    }
    if optimizer.background is not None:
        contents |= optimizer.background.state()
    with atomic_path(path) as temporary:
        np.savez(temporary, **contents)


def load_progress(optimizer, path) -> None:
    """Put a fresh FieldOptimizer where a saved one was.

    Raises ValueError for a file that is no checkpoint, or one of another scene, seed or options.
    """
    contents = read_npz(path, "checkpoint")
    if str(contents.get("format", "")) != "warpcage fit" or str(contents.get("version")) != str(VERSION):
        raise ValueError(f"{path} is no fit checkpoint of this version: remove it or name another file")
    if str(contents.get("fingerprint")) != fingerprint(optimizer):
        raise ValueError(
            f"{path} is the checkpoint of another fit (scene, seed or options differ): remove it or name another file"
        )
    try:
        _restore(optimizer, contents, path)
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{path} is a damaged fit checkpoint, remove it or name another file: {reason}") from error


def _restore(optimizer, contents: dict, path) -> None:
    """Everything is looked at before it reaches a kernel, which would not."""
    state = json.loads(str(contents["state"]))
    level, cursor = int(state["level"]), int(state["cursor"])
    level_steps = [int(count) for count in state["level_steps"]]
    if not 0 <= level < len(optimizer.shapes) or len(level_steps) != len(optimizer.level_steps):
        raise ValueError(f"level {level} of {len(level_steps)} steps")
    shape = tuple(int(n) for n in require_numbers(contents, "resolution", (3,), path))
    shapes = [tuple(int(n) for n in held) for held in state["shapes"]]  # coarser than planned where memory was short
    planned = optimizer.shapes
    fitting = len(shapes) == len(planned) and all(
        2 <= n <= m for held, whole in zip(shapes, planned, strict=True) for n, m in zip(held, whole, strict=True)
    )
    if not fitting or shape != shapes[level]:
        raise ValueError(f"resolution {shape} at level {level} of {shapes}, {planned} planned")
    packed = require_numbers(contents, "occupancy", (-(-math.prod(shape) // 8),), path)
    occupied = np.unpackbits(packed, count=math.prod(shape)).reshape(shape)
    rows = int(occupied.sum())
    density = require_numbers(contents, "density", (rows,), path)
    sh = require_numbers(contents, "sh", (rows, 3, 9), path)
    moments = require_numbers(contents, "moments", (rows, 28), path).astype(np.uint16)
    if not all(np.isfinite(values).all() for values in (density, sh)) or (moments & 0x7F80 == 0x7F80).any():
        raise ValueError("values that are not finite")
    tiles = require_numbers(contents, "tiles", (None,), path)
    picture_bits = state.get("picture_bits", PRECISIONS[0])
    if picture_bits not in PRECISIONS:
        raise ValueError(f"pictures of {picture_bits!r} bits a channel, {PRECISIONS} are known")

    optimizer.keep_pictures(picture_bits)
    optimizer.restore_field(wp.array(occupied.astype(np.uint8), device=optimizer.device))
    if len(tiles) != optimizer.active_tiles or tiles.min() < 0 or tiles.max() >= optimizer.tile_total:
        raise ValueError(f"{len(tiles)} tiles of pixels, {optimizer.active_tiles} expected")
    if not 0 <= cursor <= len(tiles):
        raise ValueError(f"cursor {cursor} among {len(tiles)} tiles")
    for target, values, dtype in (
        (optimizer.field.grid.density, density, wp.float32),
        (optimizer.field.grid.sh, sh, vec9),
        (moment_bits(optimizer.moments), moments, wp.uint16),
    ):
        target.assign(wp.array(values, dtype=dtype, device=optimizer.device))
    if optimizer.background is not None:
        optimizer.background.restore(contents, level, path)
    optimizer.step_count, optimizer.level = int(state["step_count"]), level
    optimizer.level_steps, optimizer.shapes = level_steps, shapes
    optimizer.total_steps = sum(level_steps)
    optimizer.random.bit_generator.state = state["random"]
    optimizer.rays.tiles = wp.array(tiles, dtype=wp.int32, device=optimizer.device)
    optimizer.cursor = cursor


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


def moment_bits(moments: wp.array) -> wp.array:
    """bfloat16 numbers as their bits, without a copy: NumPy has no such type."""
    return wp.array(ptr=moments.ptr, dtype=wp.uint16, shape=moments.shape, device=moments.device, copy=False)
