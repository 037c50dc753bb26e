"""Progress of a fit on disk, so that a fit that was stopped goes on."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import json
import math
import os
import pathlib
import weakref
from collections.abc import Collection, Iterator
from typing import Any, Protocol

import numpy as np
import warp as wp

from ..core.arrays import array_view
from ..core.checks import checked_path
from ..core.files import atomic_path
from ..core.npz import read_npz, require_numbers
from ..core.threads import run_parallel
from ..errors import InputError
from ..scene.scene import Scene
from .batches import ORDERS, PRECISIONS, Batches
from .cameras import STATE, CameraErrors, CameraRefinement
from .level import COEFFICIENTS, ROW_NUMBERS, Level
from .schedule import Schedule
from .surroundings import BackgroundOptimizer, OuterOptimizer

#: Version 5: rows of luminance and differences of colour. 6: refined cameras.
KIND, VERSION = "warpcage fit", 6

#: Exponent bits of a bfloat16: all of them are set in numbers that are not finite.
EXPONENT_BITS = 0x7F80

#: The arrays of a checkpoint; others in the file are not read.
NAMES = frozenset(
    (
        *("format", "version", "fingerprint", "state", "resolution", "occupancy", "density", "sh", "tiles", "moments"),
        *("views", "outer_views"),
        *("layers_met", "layers_values", "layers_moments"),
        *("outer_sides", "outer_occupancy", "outer_values", "outer_moments", "outer_sky", "outer_sky_moments"),
        *(f"camera_{name}" for name in STATE),
    )
)

#: Bytes of memory that a byte of these arrays takes: each is checked, then handed to a device.
ROOM = 3


class Fit(Protocol):
    """What a checkpoint holds and restores of a fit: FieldOptimizer has it."""

    scene: Scene
    given: dict[str, Any]
    device: wp.Device
    random: np.random.Generator
    shapes: list[tuple[int, ...]]
    current: Level
    batches: Batches
    schedule: Schedule
    background: BackgroundOptimizer | OuterOptimizer | None
    refinement: CameraRefinement | None
    camera_errors: CameraErrors | None

    def restore(self, mask: wp.array, bits: int) -> None: ...

    def start_refinement(self) -> None: ...


#: What `fingerprint` found. Fits are compared by identity.
_fingerprints: weakref.WeakKeyDictionary[Any, str] = weakref.WeakKeyDictionary()


def require_writable(path: str | os.PathLike[str]) -> pathlib.Path:
    """A checkpoint's path. Raises ValueError where it does not end in .npz or is a folder."""
    path = checked_path(path, "the checkpoint")
    if path.suffix != ".npz" or path.is_dir():
        raise InputError(f"a checkpoint is a file that ends in .npz, got {str(path)!r}")
    return path


def save_progress(optimizer: Fit, path: str | pathlib.Path) -> None:
    """Write voxels, second moments and the order of the pixels to a file (.npz), whole or not at all."""
    field, grid = optimizer.current.field, optimizer.current.field.grid
    schedule, batches = optimizer.schedule, optimizer.batches
    errors = optimizer.camera_errors
    occupied = grid.links.numpy() >= 0
    contents = {
        "format": np.array(KIND),
        "version": np.array(VERSION),
        "fingerprint": np.array(fingerprint(optimizer)),
        "state": np.array(
            json.dumps(
                {
                    "step_count": schedule.step_count,
                    "level": schedule.level,
                    "level_steps": schedule.level_steps,
                    "shapes": optimizer.shapes,
                    "picture_bits": batches.pictures.bits,
                    "cursor": batches.cursor,
                    "order": batches.rays.order,
                    "random": optimizer.random.bit_generator.state,
                }
                | ({} if errors is None else {"camera_errors": dataclasses.astuple(errors)})
            )
        ),
        "resolution": np.array(field.resolution, np.int32),
        "occupancy": np.packbits(occupied.ravel()),
        "density": grid.density.numpy(),
        "sh": grid.sh.numpy(),
        "tiles": batches.rays.tiles.numpy(),
        "moments": moment_bits(optimizer.current.moments).numpy(),
    }
    contents |= optimizer.current.views.state("views")
    if optimizer.background is not None:
        contents |= optimizer.background.state()
    if optimizer.refinement is not None:
        contents |= optimizer.refinement.state()
    with atomic_path(path) as temporary:
        np.savez(temporary, **contents)


def load_progress(optimizer: Fit, path: str | pathlib.Path) -> None:
    """Put a fresh fit, of the same scene, seed and options and before its first step, where a saved one was."""
    contents = read_checkpoint(path, KIND, VERSION, NAMES, fingerprint(optimizer))
    if isinstance(optimizer.background, OuterOptimizer) and "layers_values" in contents:  # the options are the same
        raise InputError(
            f"{path} is the checkpoint of a fit with background layers, which background='auto' took for whole "
            "pictures before it took an outer field: fit with the warpcage that wrote it, remove it or name another one"
        )
    with damage_as_error(path):
        _restore(optimizer, contents, pathlib.Path(path))


def read_checkpoint(
    path: str | pathlib.Path, kind: str, version: int, names: Collection[str], own: str
) -> dict[str, np.ndarray]:
    """The arrays of a checkpoint of a kind, with these names, of the fit whose fingerprint is `own`."""
    contents = read_npz(path, "checkpoint", names.__contains__, room=ROOM)
    if str(contents.get("format", "")) != kind:
        raise InputError(f"{path} is not a {kind.removeprefix('warpcage ')} checkpoint: remove it or name another file")
    if str(contents.get("version")) != str(version):
        found = " ".join(str(contents.get("version")).split())[:20]  # an array prints in lines
        raise InputError(
            f"{path} is a fit checkpoint of another version ({found}, this warpcage reads {version}): fit with the "
            "warpcage that wrote it, remove it or name another file"
        )
    if str(contents.get("fingerprint")) != own:
        raise InputError(
            f"{path} is the checkpoint of another fit (scene, seed or options differ): remove it or name another file"
        )
    return contents


@contextlib.contextmanager
def damage_as_error(path: str | pathlib.Path) -> Iterator[None]:
    """Turn errors while a checkpoint is restored into one InputError."""
    try:
        yield
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path} is a damaged fit checkpoint, remove it or name another file: {reason}") from error


def _restore(optimizer: Fit, contents: dict[str, np.ndarray], path: pathlib.Path) -> None:
    """Check everything before it reaches a kernel: kernels do not."""
    schedule, batches = optimizer.schedule, optimizer.batches
    state = json.loads(str(contents["state"]))
    level, cursor, order = (int(state[name]) for name in ("level", "cursor", "order"))
    level_steps = [int(count) for count in state["level_steps"]]
    if not 0 <= level < len(optimizer.shapes) or len(level_steps) != len(schedule.level_steps):
        raise InputError(f"level {level} of {len(level_steps)} steps")
    shape = tuple(int(n) for n in require_numbers(contents, "resolution", (3,), path))
    shapes = [tuple(int(n) for n in held) for held in state["shapes"]]  # coarser than planned where memory was short
    planned = optimizer.shapes
    fitting = len(shapes) == len(planned) and all(
        2 <= n <= m for held, whole in zip(shapes, planned, strict=True) for n, m in zip(held, whole, strict=True)
    )
    if not fitting or shape != shapes[level]:
        raise InputError(f"resolution {shape} at level {level} of {shapes}, {planned} planned")
    packed = require_numbers(contents, "occupancy", (-(-math.prod(shape) // 8),), path)
    occupied = np.unpackbits(packed, count=math.prod(shape)).reshape(shape)
    rows = int(occupied.sum())
    density = require_numbers(contents, "density", (rows,), path)
    sh = require_numbers(contents, "sh", (rows, COEFFICIENTS), path)
    moments = require_numbers(contents, "moments", (rows * ROW_NUMBERS,), path).astype(np.uint16)
    infinite = (moments & EXPONENT_BITS == EXPONENT_BITS).any()
    if infinite or not all(np.isfinite(values).all() for values in (density, sh)):
        raise InputError("values that are not finite")
    tiles = require_numbers(contents, "tiles", (None,), path)
    picture_bits = state.get("picture_bits", PRECISIONS[0])
    if picture_bits not in PRECISIONS:
        raise InputError(f"pictures of {picture_bits!r} bits per channel, {PRECISIONS} are known")

    if state.get("camera_errors") is not None:
        optimizer.camera_errors = CameraErrors(*(float(number) for number in state["camera_errors"]))
        if optimizer.camera_errors and optimizer.refinement is None:
            optimizer.start_refinement()
    optimizer.restore(wp.array(occupied.astype(np.uint8), device=optimizer.device), picture_bits)
    # which tiles count was found with the cameras that were then
    counted = 0 < len(tiles) <= batches.tile_total if optimizer.refinement else len(tiles) == batches.active_tiles
    if not counted or tiles.min() < 0 or tiles.max() >= batches.tile_total:
        raise InputError(f"{len(tiles)} tiles of pixels, {batches.active_tiles} expected")
    if not 0 <= cursor <= len(tiles):
        raise InputError(f"cursor {cursor} among {len(tiles)} tiles")
    if not 0 <= order < ORDERS:
        raise InputError(f"order {order}, its key is below {ORDERS}")
    for target, values, dtype in (
        (optimizer.current.field.grid.density, density, wp.float32),
        (optimizer.current.field.grid.sh, sh, wp.float32),
        (moment_bits(optimizer.current.moments), moments, wp.uint16),
    ):
        target.assign(wp.array(values, dtype=dtype, device=optimizer.device))
    optimizer.current.views.restore(contents, "views", rows, path)
    if optimizer.background is not None:
        optimizer.background.restore(contents, level, path)
    if optimizer.refinement is not None:
        optimizer.refinement.restore(contents, path)
        optimizer.refinement.attach(batches.rays)
    schedule.step_count, schedule.level, schedule.level_steps = int(state["step_count"]), level, level_steps
    optimizer.shapes = shapes
    optimizer.random.bit_generator.state = state["random"]
    batches.take(tiles)
    batches.order(order, cursor)


def fingerprint(optimizer: Any) -> str:  # FieldOptimizer or SplatFit
    """Hash, in hexadecimal digits, of all that a fit depends on: its `given` (seed, options, start) and its scene."""
    if optimizer not in _fingerprints:  # once, as a fit reads pictures only when it begins
        given = json.dumps(optimizer.given, sort_keys=True).encode()
        _fingerprints[optimizer] = hashlib.blake2b(given + scene_digest(optimizer.scene), digest_size=32).hexdigest()
    return _fingerprints[optimizer]


def scene_digest(scene: Scene) -> bytes:
    """32 bytes, a hash of every number of a scene that a fit uses, the same for any number of threads."""
    # BLAKE2b (RFC 7693) over each picture, in parallel, then over their hashes: 0.33 GB/s a thread (Xeon, CPython
    # 3.11). 87 views of 800x800 with alphas (0.9 GB) take 2.7 s on one thread and 0.2 s on 16.
    cameras = [[camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height] for camera in scene.cameras]
    arrays = {
        "images": scene.images,
        "alphas": scene.alphas,
        "surroundings": scene.surroundings,
        "weights": scene.weights,
        "background": scene.background,
        "bounds": scene.bounds,
        "poses": np.array([camera.camera_to_world for camera in scene.cameras]),
        "cameras": np.array(cameras, np.float64),
    }
    there = {name: array for name, array in arrays.items() if array is not None}
    heads = [f"{name} {array.dtype} {array.shape}" for name, array in there.items()]
    # pictures one by one, and small arrays whole
    pieces = [piece for array in there.values() for piece in (array if array.ndim > 2 else [array])]
    hashes = run_parallel([functools.partial(_piece_hash, piece) for piece in pieces])
    whole = hashlib.blake2b(json.dumps([heads, bool(scene.captured)]).encode(), digest_size=32)
    for each in hashes:
        whole.update(each)
    return whole.digest()


def _piece_hash(piece: np.ndarray) -> bytes:
    """hashlib lets other threads run while it hashes."""
    return hashlib.blake2b(np.ascontiguousarray(piece).view(np.uint8).data, digest_size=32).digest()


def moment_bits(moments: wp.array) -> wp.array:
    """bfloat16 numbers as their bits, without a copy: NumPy has no such type."""
    return array_view(moments, wp.uint16, moments.shape)
