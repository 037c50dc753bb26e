"""Fit a field to posed images, with a bar of its progress and checkpoints."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import os
import pathlib
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.checks import checked_path, require_type, warn_caller
from ..core.devices import resolve_device
from ..core.names import checked_choice
from ..core.reports import Progress, report_progress, reports_progress, shows_bars, span_text
from ..core.threads import device_turn
from ..errors import InputError
from ..field.voxel_field import VoxelField
from ..scene.box_picture import box_text, draw_box
from ..scene.camera_check import camera_doubt
from ..scene.scene import Scene
from ..splats.splat_field import SplatField
from ..view.pictures import side_by_side, write_png
from . import checkpoint as voxel_checkpoint
from .batches import counted_pixels
from .checkpoint import require_writable
from .evaluation import comparison, mean_psnr, view_figures
from .memory import memory_text
from .optimizer import FieldOptimizer
from .options import FitNames, checked_options
from .schedule import Pace
from .splats import checkpoint as splat_checkpoint
from .splats.optimizer import SplatFit
from .splats.options import SplatFitNames

if TYPE_CHECKING:
    from typing_extensions import Unpack  # of the type checker

_log = logging.getLogger(__name__)

#: Seconds between two updates of the progress bar.
SHOWN_EVERY = 1.0

#: Pixels of the pictures that its last line is about, at most, but one picture at least: a few seconds on a CPU.
LAST_PIXELS = 2_000_000

#: What a fit can make of pictures.
REPRESENTATIONS = ("voxels", "splats")


@overload
def fit(scene: Scene, *, representation: Literal["voxels"] = "voxels", **options: Unpack[FitNames]) -> VoxelField: ...


@overload
def fit(scene: Scene, *, representation: Literal["splats"], **options: Unpack[SplatFitNames]) -> SplatField: ...


@reports_progress
def fit(
    scene: Scene,
    *,
    representation: str = "voxels",
    quality: str = "standard",
    device: wp.DeviceLike = None,
    seed: int = 0,
    progress: bool | Progress = True,
    bounds: ArrayLike | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    checkpoint_seconds: float = 60.0,
    preview: str | os.PathLike[str] | None = None,
    preview_seconds: float = 20.0,
    **options: Any,
) -> VoxelField | SplatField:
    """Optimise a VoxelField, or a SplatField, from a Scene.

    Voxels show objects best, above all where masks or opacity cut them out; splats show whole places. Splats begin at
    the points of the scene where it has any.

    Args:
        scene: The images with their cameras.
        representation: "voxels" or "splats".
        quality: "fast", "standard" or "high": time against detail. "fast" takes half as long as "standard"; "high" 3
            to 9 times as long, with up to twice the memory, for about 1 dB where cameras are exact and views many,
            and for little elsewhere.
        device: Warp device. None is CUDA where there is one.
        seed: Seed of the pixel order and the backgrounds; see FieldOptimizer.
        progress: True shows a bar on stderr with the PSNR of the last batch, and at the end that of the field over some
            of the pictures, as `evaluate` measures it. A function is called with (done, total, message), in steps, and
            cancels by returning False or raising; a checkpoint stays then as it was last written.
        bounds: (2, 3) box of the object, world units, for voxels. None finds it: the visual hull where the images have
            alpha.
        checkpoint: File (.npz) that holds the progress, always whole. The fit goes on from a file that is there, and
            removes it when it is done. None keeps no progress.
        checkpoint_seconds: Time between two writes of the checkpoint.
        preview: Picture (.png) that is updated during the fit: at first, for voxels, cameras, points and the object's
            box from three sides (`warpcage.scene.draw_box`), then a picture of the scene beside the field's view
            from its camera. None writes none.
        preview_seconds: Time before the first view of the field, and between two writes.
        options: Fields of FitOptions by name, e.g. resolution=256, epochs=12 or max_memory="4GB"; for splats those of
            SplatFitOptions, e.g. steps=7000 or most_splats=200000, and the `weights` of SplatFit.

    Returns:
        The field, pruned: of voxels with its rendering weights, or of splats.

    Raises:
        ValueError: For a scene with nothing in it, options out of range, too little memory, or a checkpoint of another
            scene or other options.
        Cancelled: Where `progress` returned False.

    Warns:
        UserWarning: Where matches between some of the pictures contradict the cameras, or where hardly two pictures
            show the same place.
    """
    held = None if checkpoint is None else require_writable(checkpoint)
    picture = None if preview is None else _preview_path(preview)
    checked_choice(representation, "representation", REPRESENTATIONS)
    require_type(scene, Scene, "a fit needs")
    goes_on = held is not None and held.exists()
    turn = device_turn(resolve_device(device))
    kept: Any = voxel_checkpoint if representation == "voxels" else splat_checkpoint
    optimizer: FieldOptimizer | SplatFit
    with turn:
        options = {"device": device, "seed": seed, "quality": quality, "progress": progress, **options}
        if representation == "voxels":
            optimizer = FieldOptimizer(scene, bounds=bounds, **options)
        elif bounds is not None:
            raise InputError("bounds are for voxels: splats are fitted to all that the pictures show")
        else:
            optimizer = SplatFit(scene, **options)
        if held is not None and held.exists():
            kept.load_progress(optimizer, held)
    if isinstance(optimizer, FieldOptimizer):
        _say(f"box {box_text(optimizer.found.bounds)}, {optimizer.found.reason}", progress)
        if picture is not None:
            write_png(picture, draw_box(scene.cameras, scene.points, optimizer.found))
    start = shown = saved = pictured = time.monotonic()
    message, looked = "fit", isinstance(optimizer, SplatFit) or optimizer.camera_errors is not None
    pace = optimizer.pace() if isinstance(optimizer, FieldOptimizer) else None
    with contextlib.nullcontext() if goes_on else _camera_doubt_beside(scene) as looking:
        while optimizer.step_count < optimizer.total_steps:
            report_progress(progress, optimizer.step_count, optimizer.total_steps, message)
            if looking is not None and looking.done():
                _warn_of(looking)
                looking = None
            if pace is None or not isinstance(optimizer, FieldOptimizer):
                optimizer.step()
            elif pace.time(optimizer.step):
                _say(_forecast(optimizer, pace, time.monotonic() - start), progress)
            if not looked and isinstance(optimizer, FieldOptimizer) and optimizer.camera_errors is not None:
                looked = True
                _say(str(optimizer.camera_errors), progress)
            if progress and time.monotonic() - shown > SHOWN_EVERY:
                shown = time.monotonic()
                message = f"fit: {optimizer.measure_psnr():.2f} dB, {optimizer.size_text}"
                if pace is not None and pace.is_known:
                    message += f", about {span_text(pace.left())} left"
            if held is not None and time.monotonic() - saved > checkpoint_seconds:
                with turn:
                    kept.save_progress(optimizer, held)
                saved = time.monotonic()
            if picture is not None and time.monotonic() - pictured > preview_seconds:
                with turn:
                    _write_preview(picture, optimizer.field, scene)
                pictured = time.monotonic()
        report_progress(progress, optimizer.step_count, optimizer.total_steps, message)
        optimizer.measure_psnr()
        if optimizer.coarser:
            _say(optimizer.coarser, progress)
        if looking is not None:
            _warn_of(looking)
    field = optimizer.finish()
    if progress:
        cameras = optimizer.cameras if isinstance(optimizer, FieldOptimizer) else scene.cameras
        decibels = _last_psnr(field, dataclasses.replace(scene, cameras=cameras))
        message = f"fit: {decibels:.2f} dB, {optimizer.size_text}"
        report_progress(progress, optimizer.step_count, optimizer.total_steps, message)
    if held is not None:
        held.unlink(missing_ok=True)
    if picture is not None:
        _write_preview(picture, field, scene)
    return field


@contextlib.contextmanager
def _camera_doubt_beside(scene: Scene) -> Iterator[Future[str | None]]:
    """What a look at the pictures finds, in a thread of its own: it takes seconds, in which a GPU fits half a scene.
    It ends with the block, however that ends."""
    ended = threading.Event()

    with ThreadPoolExecutor(1, "warpcage-cameras") as pool:
        try:
            yield pool.submit(camera_doubt, scene, progress=lambda *_: not ended.is_set())
        finally:
            ended.set()


def _warn_of(looking: Future[str | None]) -> None:
    """Warn of what a look has found, if anything; wait for it."""
    if (doubt := looking.result()) is not None:
        warn_caller(doubt)


def _last_psnr(field: VoxelField | SplatField, scene: Scene) -> float:
    """Mean PSNR, dB, of a field over pictures evenly among those that count, as `evaluate` has it."""
    counting = np.arange(len(scene))
    if scene.weights is not None:
        counting = counting[scene.weights.any(axis=(1, 2))]
    size = np.mean([scene.cameras[view].width * scene.cameras[view].height for view in counting])
    places = np.linspace(0, len(counting) - 1, int(np.clip(LAST_PIXELS // size, 1, len(counting))))
    views = scene.subset(counting[places.round().astype(int)].tolist())
    return mean_psnr(view_figures(field, views))


def _forecast(optimizer: FieldOptimizer, pace: Pace, taken: float) -> str:
    """Time and memory that a fit will take, as text; taken: seconds so far."""
    seconds = pace.left() + taken
    text = f"about {span_text(seconds)} and {memory_text(optimizer.peak_bytes(pace.rows))}"
    rays, pixels = optimizer.total_steps * optimizer.batch_rays, counted_pixels(optimizer.scene)
    if (found := pace.quicker(seconds, rays, pixels, checked_options({"quality": "fast"}))) is None:
        return text
    factor, shorter = found
    shrunk = f" of pictures shrunk {factor} times" if factor > 1 else ""
    return f"{text}; a fast fit{shrunk} takes about {span_text(shorter)}"


def _say(text: str, progress: bool | Progress) -> None:
    """Log a line about a fit, and print it on stderr where a bar is shown."""
    _log.info("fit: %s", text)
    if shows_bars(progress):
        print(f"fit: {text}", file=sys.stderr)


def _preview_path(preview: str | os.PathLike[str]) -> pathlib.Path:
    """The file of a preview; ValueError where it is none."""
    path = checked_path(preview, "the preview")
    if path.suffix.lower() != ".png" or path.is_dir():
        raise InputError(f"a preview is a picture that ends in .png, got {str(path)!r}")
    return path


def _write_preview(path: pathlib.Path, field: VoxelField | SplatField, scene: Scene) -> None:
    """Write a picture of the scene beside the field's view of its camera."""
    background, images = comparison(field, scene)
    view = len(scene) // 2
    image, drawn = scene.cut(view, images[view]), field.render(scene.cameras[view], background=background).rgb
    write_png(path, side_by_side([image, drawn]))
