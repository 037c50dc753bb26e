"""Fits of items: fields of the pictures of scenes."""

from __future__ import annotations

import pathlib

import warp as wp

from ..fitting.fit import fit
from ..scene.load import load_scene
from .outputs import Made, Writer
from .references import References
from .scene_items import FitItem


def make_fit(item: FitItem, references: References, device: wp.Device, checkpoint: pathlib.Path | None = None) -> Made:
    """Fit a field to the pictures of a scene, as `warpcage fit` does.

    Args:
        item: The item.
        references: What it refers to.
        device: Warp device.
        checkpoint: File (.npz) that holds the progress, from which a fit goes on whose worker died. None keeps none.

    Returns:
        The item, made: what writes its outputs.

    Raises:
        FileNotFoundError: For a file that is not there.
        ValueError: For what cannot be used.
    """
    scene = load_scene(
        references.path(item.scene),
        split=item.split,
        downscale=item.downscale,
        format=item.format,
        background=item.background,
        masks=item.masks,
        orient="up" if item.straighten else None,
        cameras=None if item.cameras is None else references.path(item.cameras),
    )
    if checkpoint is not None:
        checkpoint.parent.mkdir(parents=True, exist_ok=True)
    field = fit(scene, device=device, progress=False, checkpoint=checkpoint, **item.options)
    writers: dict[str, Writer] = {item.outputs["field"]: field.save}
    refined = field.refined_cameras
    if refined is not None:
        writers[item.outputs["cameras"]] = refined.save
    return Made(writers)
