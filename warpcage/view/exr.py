"""Picture files of any ending, and OpenEXR: light, opacity and depth, as compositing programs take them."""

from __future__ import annotations

import os
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.checks import MAX_HALF, Cuts
from ..core.files import atomic_path, require_file
from ..core.names import extra_line
from ..errors import InputError
from .pictures import COLORS, path_with_ending, picture_cuts, write_jpeg, write_png

#: Depth where nothing is seen, as Blender writes it.
NOTHING = 1e10

#: Corners of the colours of sRGB and BT.709, and its white: x and y each.
_PRIMARIES = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)


def require_openexr() -> Any:
    """The OpenEXR library. Raises ValueError where it is not installed."""
    try:
        import OpenEXR
    except ImportError as error:
        raise InputError(f"OpenEXR pictures need its library: {extra_line('exr')}") from error
    return OpenEXR


def linear_light(colors: ArrayLike) -> np.ndarray:
    """Light, float32, of colours as screens take them (sRGB, IEC 61966-2-1): 0 is black, 1 white, more is brighter."""
    coded = np.maximum(np.asarray(colors, np.float32), 0.0)
    return np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4).astype(np.float32)


def screen_colors(light: np.ndarray) -> np.ndarray:
    """sRGB colours of linear light from 0 on, the inverse of `linear_light`."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def mean_picture(pictures: Sequence[np.ndarray]) -> np.ndarray:
    """The mean of pictures (h, w, 3), or (h, w, 4) with straight colours, in linear light, as a shutter gathers it.
    Pixels are weighted by opacity; values that all pictures share are kept to the bit."""
    first = pictures[0]
    light = [linear_light(picture[..., :3]) for picture in pictures]
    if first.shape[-1] == 4:
        opacity = np.mean([picture[..., 3:] for picture in pictures], axis=0, dtype=np.float64)
        weighted = [each * picture[..., 3:] for each, picture in zip(light, pictures, strict=True)]
        total = np.mean(weighted, axis=0, dtype=np.float64) / np.maximum(opacity, 1e-12)
        mean = np.concatenate([screen_colors(total), opacity], axis=-1)
    else:
        mean = screen_colors(np.asarray(np.mean(light, axis=0, dtype=np.float64)))
    same = np.all([np.equal(picture, first) for picture in pictures[1:]], axis=0) if len(pictures) > 1 else True
    return np.where(same, first, mean.astype(np.float32))


def write_picture(
    path: str | os.PathLike[str], image: ArrayLike, depth: ArrayLike | None = None, *, cuts: Cuts | None = None
) -> None:
    """Write a picture as the ending says, whole or not at all: .png, .jpg, or .exr, which alone has depth (h, w).
    The image and `cuts` are as `write_png`, `write_jpeg` and `write_exr` take them."""
    ending = pathlib.Path(path).suffix.lower()
    if ending == ".exr":
        write_exr(path, image, depth, cuts=cuts)
    elif ending in (".jpg", ".jpeg"):
        write_jpeg(path, image, cuts=cuts)
    else:
        write_png(path, image, cuts=cuts)


def write_exr(
    path: str | os.PathLike[str], image: ArrayLike, depth: ArrayLike | None = None, *, cuts: Cuts | None = None
) -> None:
    """Write an OpenEXR file, whole or not at all: half floats of linear light; depth (h, w), world units, in floats.
    The image is (h, w, 3), or (h, w, 4) with straight colours, as screens take them (sRGB): 0 black, 1 white."""
    path = path_with_ending(path, ".exr")
    exr = require_openexr()
    pixels = np.ascontiguousarray(image, np.float32)  # OpenEXR 3.5 does not heed strides
    if pixels.ndim != 3 or pixels.shape[-1] not in (3, 4) or 0 in pixels.shape:
        raise InputError(f"an EXR picture must be (h, w, 3) or (h, w, 4), got {pixels.shape}")
    if not np.isfinite(pixels).all():
        raise InputError("an image holds values that are not finite")
    with picture_cuts(path, cuts) as held:
        channels = _light_channels(pixels, held)
    if depth is not None:
        channels["Z"] = np.ascontiguousarray(depth, np.float32)
        if channels["Z"].shape != pixels.shape[:2]:
            raise InputError(f"depth must be {pixels.shape[:2]} as the picture, got {channels['Z'].shape}")
    header = {"type": exr.scanlineimage, "compression": exr.ZIP_COMPRESSION, "chromaticities": _PRIMARIES}
    with atomic_path(path) as temporary:
        exr.File(header, channels).write(str(temporary))


def _light_channels(pixels: np.ndarray, cuts: Cuts) -> dict[str, np.ndarray]:
    """The channels of pictures (h, w, 3 or 4) float32 as half floats of light."""
    light = linear_light(cuts.clip(COLORS, pixels[..., :3], 0.0, float(screen_colors(np.array(MAX_HALF))), 0.0))
    parts = [light]
    if pixels.shape[-1] == 4:
        alpha = cuts.clip(COLORS, pixels[..., 3:], 0.0, 1.0, 0.0)
        parts = [light * alpha, alpha]  # associated: colours are multiplied by it in the file
    return {"RGBA"[: pixels.shape[-1]]: np.concatenate(parts, axis=-1).astype(np.float16)}


def read_exr(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """The channels of an OpenEXR file of one part, as they are in it, by name.
    They are "RGB" (h, w, 3) or "RGBA" (h, w, 4), and "Z" (h, w)."""
    path = require_file(path, "image")
    exr = require_openexr()
    try:
        with exr.File(str(path)) as file:
            return {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    except RuntimeError as error:
        raise InputError(f"image {str(path)!r} cannot be read: {' '.join(str(error).split())}") from error
