"""Fit a voxel field to posed images, with a bar of its progress and checkpoints."""

from __future__ import annotations

import pathlib
import sys
import time
from typing import Any

import warp as wp
from numpy.typing import ArrayLike

from ..core.devices import resolve_device
from ..core.locks import device_turn
from ..field.voxel_field import VoxelField
from ..scene.scene import Scene
from .checkpoint import load_progress, require_writable, save_progress
from .optimizer import FieldOptimizer

#: Seconds between two updates of the progress bar.
SHOWN_EVERY = 1.0


def fit(
    scene: Scene,
    *,
    quality: str = "standard",
    device: wp.DeviceLike = None,
    seed: int = 0,
    progress: bool = True,
    bounds: ArrayLike | None = None,
    checkpoint: str | pathlib.Path | None = None,
    checkpoint_seconds: float = 60.0,
    **options: Any,
) -> VoxelField:
    """Optimise a VoxelField from a Scene.

    Args:
        scene: The images with their cameras.
        quality: "fast", "standard" or "high": time against detail.
        device: Warp device. None is CUDA where there is one.
        seed: Of the pixel order and the backgrounds; see FieldOptimizer.
        progress: Whether to show a bar with the PSNR of the last batch.
        bounds: (2, 3) box of the object, world units. None finds it: the visual hull where the images have alpha.
        checkpoint: File (.npz) that holds the progress, always whole. The fit goes on from a file that is there, and
            removes it when it is done. None keeps no progress.
        checkpoint_seconds: Time between two writes of the checkpoint.
        options: Fields of FitOptions by name, e.g. resolution=256, epochs=12 or max_memory="4GB".

    Returns:
        The field, pruned, with its rendering weights.

    Raises:
        ValueError: For a scene with nothing in it, options out of range, too little memory, or a checkpoint of another
            scene or other options.
    """
    from tqdm import tqdm

    held = None if checkpoint is None else require_writable(checkpoint)
    turn = device_turn(resolve_device(device))
    with turn:
        optimizer = FieldOptimizer(scene, device=device, seed=seed, bounds=bounds, quality=quality, **options)
        if held is not None and held.exists():
            load_progress(optimizer, held)
    with tqdm(total=optimizer.total_steps, initial=optimizer.step_count, desc="fit", disable=not progress) as bar:
        shown = saved = time.monotonic()
        while optimizer.step_count < optimizer.total_steps:
            optimizer.step()
            bar.update()
            if progress and time.monotonic() - shown > SHOWN_EVERY:
                shown = time.monotonic()
                size = "x".join(str(n) for n in optimizer.field.resolution)
                bar.set_postfix_str(f"{optimizer.measure_psnr():.2f} dB at {size}")
            if held is not None and time.monotonic() - saved > checkpoint_seconds:
                with turn:
                    save_progress(optimizer, held)
                saved = time.monotonic()
    optimizer.measure_psnr()
    if progress and optimizer.coarser:
        print(f"fit: {optimizer.coarser}", file=sys.stderr)
    field = optimizer.finish()
    if held is not None:
        held.unlink(missing_ok=True)
    return field
