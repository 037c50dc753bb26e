"""Load a scene of any known format."""

from __future__ import annotations

import pathlib

from ..view.frame import parse_background
from .formats import blender, colmap, dtu, nsvf, transforms
from .scene import Scene


def load_scene(
    path,
    *,
    split: str = "train",
    downscale: int = 1,
    format: str | None = None,
    background="white",
    masks: bool | str = True,
) -> Scene:
    """Read one split of a scene from disk.

    path: folder of the scene.
    split: as the format has them ("train", "val", "test"); where it has none, every eighth picture is "test", the
        others are "train", and "all" is both.
    downscale: whole factor by which width and height shrink, by area averaging of premultiplied colour.
    format: "blender" (NeRF-synthetic), "nsvf", "dtu" (IDR layout), "transforms" (nerfstudio, instant-ngp), "colmap";
        None detects it, the first of these that fits.
    background: colour name or three numbers, put behind transparent pixels.
    masks: mask files become alphas, and what they hide the background; "split" keeps what they hide as the scene's
        surroundings, which `fit` puts into layers behind the object; False leaves the pictures whole.

    Raises FileNotFoundError for a missing folder, split or image, ValueError for contents that cannot be used.
    """
    folder = pathlib.Path(path)
    if not folder.is_dir():
        raise FileNotFoundError(f"scene folder {str(folder)!r} is not there")
    if int(downscale) != downscale or downscale < 1:
        raise ValueError(f"downscale must be a whole number of at least 1, got {downscale}")
    if format is None:
        format = detect_format(folder)
    if masks not in (True, False, "split"):
        raise ValueError(f"masks must be True, False or 'split', got {masks!r}")
    if format not in READERS:
        raise ValueError(f"scene format {format!r} is not known: {', '.join(READERS)}")
    return READERS[format].read(
        folder, split=split, downscale=int(downscale), background=parse_background(background), masks=masks
    )


def detect_format(path) -> str:
    """The name of the format of a scene folder. Raises ValueError that says what was looked for and what is there."""
    folder = pathlib.Path(path)
    for name, reader in READERS.items():
        if reader.is_scene(folder):
            return name
    looked = "; ".join(f"{name}: {reader.MARK}" for name, reader in READERS.items())
    seen = sorted(entry.name + "/" * entry.is_dir() for entry in folder.iterdir())
    there = ", ".join(seen[:8]) + (f" and {len(seen) - 8} more" if len(seen) > 8 else "")
    raise ValueError(f"{str(folder)!r} is no scene of a known format ({looked}); it holds {there or 'nothing'}")


READERS = {"blender": blender, "nsvf": nsvf, "dtu": dtu, "transforms": transforms, "colmap": colmap}
