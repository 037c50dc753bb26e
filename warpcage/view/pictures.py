"""Pictures: PNG, video and GIF files, sheets, and colours for disparity."""

from __future__ import annotations

import contextlib
import math
import pathlib

import imageio.v3 as iio
import numpy as np

from ..core.files import atomic_path, require_file

#: Colours of `colour_disparity` from far to near, (k, 3): dark violet over red and orange to pale yellow, with
#: lightness rising evenly so that the order survives a grey print.
_WARM = (
    np.array(
        [
            (10, 7, 34),
            (50, 12, 84),
            (95, 18, 110),
            (139, 34, 106),
            (182, 51, 90),
            (219, 80, 63),
            (244, 121, 26),
            (252, 168, 13),
            (246, 215, 70),
            (252, 252, 180),
        ],
        np.float32,
    )
    / 255.0
)

#: What `read_image` opens.
PICTURE_FORMATS = ("PNG", "JPEG", "WEBP", "BMP")

#: The largest picture that is read: a few bytes can declare any size.
MAX_PIXELS = 89_000_000


def to_uint8(image) -> np.ndarray:
    """An image or stack of values in [0, 1] (any shape) as uint8, rounded and clipped; uint8 comes back as it is.

    Raises ValueError for values that are not finite.
    """
    image = np.asarray(image)
    if image.dtype == np.uint8:
        return image
    if not np.isfinite(image).all():
        raise ValueError("an image holds values that are not finite")
    return np.round(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)


def read_image(path) -> np.ndarray:
    """A picture file (PNG, JPEG, WebP, BMP) as (h, w, c) float32 in [0, 1]; c is 1 for grey, 2 for grey with
    alpha, 3 or 4 for colour. Rows are as the file stores them: a camera's orientation tag is not applied.

    Raises FileNotFoundError, or ValueError where the file is no picture, is cut off, or declares too large a size.
    """
    pixels = _read_pixels(require_file(path, "image"))
    return (pixels / np.float32(np.iinfo(pixels.dtype).max)).astype(np.float32)


def image_size(path) -> tuple[int, int]:
    """(width, height) that a picture file declares; its pixels are not read. Raises as `read_image` does."""
    path = require_file(path, "image")
    with _opened(path) as picture:
        return picture.size


@contextlib.contextmanager
def _opened(path):
    """A PIL image whose header is read and whose size is bearable; whatever goes wrong becomes one ValueError."""
    from PIL import Image

    try:
        with Image.open(path, formats=PICTURE_FORMATS) as picture:
            width, height = picture.size
            if width * height > MAX_PIXELS:
                raise ValueError(f"it declares {width}x{height} pixels, at most {MAX_PIXELS} are read")
            yield picture
    except Exception as error:
        raise ValueError(f"image {str(path)!r} cannot be read: {_one_line(error)}") from error


def _read_pixels(path) -> np.ndarray:
    """(h, w, c) uint8 or uint16."""
    with _opened(path) as picture:
        if picture.format == "PNG" and _png_depth(path) == 16:
            return _read_deep_png(path)
        if picture.mode in ("P", "PA", "1") or "transparency" in picture.info:
            grey = picture.mode in ("1", "L")
            picture = picture.convert("RGBA" if "transparency" in picture.info else "L" if grey else "RGB")
        elif picture.mode in ("CMYK", "YCbCr", "LAB", "HSV"):
            picture = picture.convert("RGB")
        pixels = np.asarray(picture)
        if pixels.dtype not in (np.uint8, np.uint16) or pixels.ndim not in (2, 3):
            raise ValueError(f"it must hold 8 or 16 bits a channel, got {pixels.dtype} {pixels.shape}")
        return pixels[..., None] if pixels.ndim == 2 else pixels


def _png_depth(path) -> int:
    with open(path, "rb") as file:
        return file.read(25)[24]


def _read_deep_png(path) -> np.ndarray:
    """A PNG of 16 bits a channel; Pillow would cut colour to 8."""
    import av

    with av.open(str(path), format="png_pipe") as file:
        frame = next(file.decode(video=0))
        if frame.format.name == "ya16be":
            return frame.reformat(format="rgba64le").to_ndarray()[..., [0, 3]].astype(np.uint16)
        pixels = frame.to_ndarray().astype(np.uint16)
        return pixels[..., None] if pixels.ndim == 2 else pixels


def write_png(path, image) -> None:
    """Write (h, w), (h, w, 3) or (h, w, 4) values in [0, 1], or uint8, as PNG; whole or not at all.

    Raises ValueError for another shape or another ending than .png.
    """
    path = _path_with_ending(path, ".png")
    pixels = to_uint8(image)
    if pixels.ndim == 3 and pixels.shape[-1] == 1:
        pixels = pixels[..., 0]
    if not (pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[-1] in (3, 4))) or 0 in pixels.shape:
        raise ValueError(f"a PNG holds (h, w), (h, w, 3) or (h, w, 4), got shape {pixels.shape}")
    with atomic_path(path) as temporary:
        iio.imwrite(temporary, pixels, extension=".png")


def side_by_side(images, *, gap: int = 4, background=1.0) -> np.ndarray:
    """Images of one height in a row, (h, w, 3) float32 each or grey (h, w); `gap` pixels of `background` between."""
    images = list(images)
    return contact_sheet(images, columns=max(1, len(images)), gap=gap, background=background)


def contact_sheet(images, *, columns: int | None = None, gap: int = 4, background=1.0) -> np.ndarray:
    """Images row by row on a sheet, (h, w, 3) float32.

    images: values in [0, 1] or uint8, (h, w) grey or (h, w, 3), all of one size; columns: images a row (default: near
    square); gap: pixels between them; background: a grey value or (3,) colour of gaps and empty places.
    Raises ValueError for no images or images of several sizes.
    """
    images = [_as_rgb(image) for image in images]
    if not images:
        raise ValueError("a sheet needs at least one image")
    if len({image.shape for image in images}) > 1:
        raise ValueError(f"images of a sheet must have one size, got {sorted({i.shape[:2] for i in images})}")
    columns = math.ceil(math.sqrt(len(images))) if columns is None else columns
    if columns < 1 or gap < 0:
        raise ValueError(f"a sheet needs columns >= 1 and gap >= 0, got {columns} and {gap}")
    rows = math.ceil(len(images) / columns)
    height, width = images[0].shape[:2]
    sheet = np.empty((rows * (height + gap) - gap, columns * (width + gap) - gap, 3), np.float32)
    sheet[...] = background
    for index, image in enumerate(images):
        row, column = divmod(index, columns)
        y, x = row * (height + gap), column * (width + gap)
        sheet[y : y + height, x : x + width] = image
    return sheet


def disparity_range(disparity, *, percentiles=(2.0, 98.0)) -> tuple[float, float]:
    """A scale for `colour_disparity` that a few wild pixels do not spoil: percentiles of what is seen (values > 0)."""
    disparity = np.asarray(disparity, np.float32)
    seen = disparity[np.isfinite(disparity) & (disparity > 0)]
    if seen.size == 0:
        return 0.0, 1.0
    low, high = (float(value) for value in np.percentile(seen, percentiles))
    # what is farthest should still differ from nothing at all
    return low - 0.15 * (high - low), high


def colour_disparity(disparity, *, alpha=None, scale: tuple[float, float] | None = None) -> np.ndarray:
    """Disparity (h, w) in colour, (h, w, 3) float32: near is light, far is dark, nothing seen is black.

    alpha: (h, w) opacity in [0, 1], fades what is hardly there (a frame has a depth for the faintest haze).
    scale: (low, high) of the colours; None takes `disparity_range` of this image (give one scale to a whole video).
    Values outside the scale take its end colours. Raises ValueError for another shape or a scale without extent.
    """
    disparity = np.asarray(disparity, np.float32)
    if disparity.ndim != 2:
        raise ValueError(f"disparity must be (h, w), got {disparity.shape}")
    if alpha is not None and np.shape(alpha) != disparity.shape:
        raise ValueError(f"alpha must be {disparity.shape} as the disparity, got {np.shape(alpha)}")
    low, high = disparity_range(disparity) if scale is None else scale
    if not (np.isfinite([low, high]).all() and high >= low):
        raise ValueError(f"a disparity scale needs finite low <= high, got {low} and {high}")
    seen = np.isfinite(disparity) & (disparity > 0)
    level = np.clip((np.where(seen, disparity, low) - low) / max(high - low, 1e-12), 0.0, 1.0)
    place = level * (len(_WARM) - 1)
    colour = np.stack([np.interp(place, np.arange(len(_WARM)), channel) for channel in _WARM.T], axis=-1)
    share = seen if alpha is None else seen * np.asarray(alpha, np.float32)
    return (share[..., None] * colour).astype(np.float32)


def _as_rgb(image) -> np.ndarray:
    """(h, w) or (h, w, 3) as (h, w, 3) float32 in [0, 1]."""
    image = np.asarray(image)
    scale = np.float32(255.0) if image.dtype == np.uint8 else np.float32(1.0)
    image = image.astype(np.float32) / scale
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=-1)
    if image.ndim != 3 or image.shape[-1] != 3 or 0 in image.shape:
        raise ValueError(f"an image must be (h, w) or (h, w, 3), got {image.shape}")
    return image


def _path_with_ending(path, ending: str) -> pathlib.Path:
    path = pathlib.Path(path)
    if path.suffix.lower() != ending:
        raise ValueError(f"{str(path)!r} must end in {ending}")
    return path


def _one_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__


def shrink(premultiplied: np.ndarray, factor: int) -> np.ndarray:
    """Area average of an (h, w, c) float image over factor x factor pixels (about, where that leaves a remainder)."""
    if factor == 1:
        return premultiplied
    height, width = premultiplied.shape[:2]
    if height % factor == 0 and width % factor == 0:
        blocks = premultiplied.reshape(height // factor, factor, width // factor, factor, -1)
        return blocks.mean(axis=(1, 3))
    from skimage.transform import resize_local_mean

    size = (max(1, round(height / factor)), max(1, round(width / factor)))
    return resize_local_mean(premultiplied, size, channel_axis=-1, preserve_range=True)
