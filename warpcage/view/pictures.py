"""Pictures: image files, sheets of several, and colours for disparity."""

from __future__ import annotations

import contextlib
import io
import math
import os
import pathlib
import zlib
from collections.abc import Callable, Iterable, Iterator
from typing import Any, BinaryIO

import imageio.v3 as iio
import numpy as np
from numpy.typing import ArrayLike

from ..core.checks import Cuts
from ..core.files import atomic_path, require_file
from ..core.names import error_line, extra_line
from ..errors import InputError

#: The rows of a picture from one to another, (k, w, c) float32.
Rows = Callable[[int, int | None], np.ndarray]

#: What `read_image` opens, and the endings of pictures of phones for which another library is needed.
PICTURE_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF", "AVIF")
HEIF_ENDINGS = (".heic", ".heif", ".hif")

#: What makes a picture (h, w, c) upright whose camera was turned by a quarter, by the number of its orientation tag.
TURNS = {
    5: lambda rows: rows.swapaxes(0, 1),
    6: lambda rows: np.rot90(rows, -1),
    7: lambda rows: np.rot90(rows, 2).swapaxes(0, 1),
    8: lambda rows: np.rot90(rows, 1),
}

#: The number of EXIF's orientation tag.
ORIENTATION = 0x0112

#: How PNG files are packed: runs alone, as rows are filtered before. It takes less than two thirds of the time of a
#: search for repetitions, and files are as large within a tenth (benchmarks/NOTES-batch.md).
PNG_STRATEGY = zlib.Z_RLE

#: The message for an image that cannot be shown.
NOT_FINITE = "an image holds values that are not finite"

#: Colours above 1 are highlights, and harmonics overshoot at edges: frames of captures had 0.4 % of their values
#: outside [0, 1], by up to 0.38. Clipping warns where more than SHARE lie BESIDE outside, or any value FAR.
BESIDE, SHARE, FAR = 0.1, 0.01, 0.5

#: What a message calls the values of pictures.
COLORS = "values of pixels"

#: The hint of a message that pictures for screens clip light.
LIGHT_KEPT = ".exr files keep light above 1"

#: The largest picture that is read: a few bytes can declare any size.
MAX_PIXELS = 89_000_000

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

#: Margin below the least disparity that is seen, as a share of the scale.
FAR_ROOM = 0.15


def read_image(path: str | os.PathLike[str]) -> np.ndarray:
    """Read a picture file (PNG, JPEG, WebP, BMP, TIFF, AVIF, HEIC): (h, w, c) float32 in [0, 1]; c is 1 or 2 for
    grey, 3 or 4 for colour. Rows are as the file stores them: a camera's orientation tag is not applied."""
    return read_rows(path)(0, None)


def read_rows(path: str | os.PathLike[str], *, upright: bool = False) -> Rows:
    """Decode a picture file: a function of the first row and the one after the last (None: the end) that gives them.
    Rows become floats, as in `read_image`, when they are asked for; upright: turned as `is_on_its_side` says."""
    path = require_file(path, "image")
    with _opened(path) as picture:
        pixels = _decoded(picture, path)
        if upright:
            pixels = TURNS[picture.getexif()[ORIENTATION]](np.asarray(pixels))
        first = np.asarray(pixels.crop((0, 0, 1, 1))) if not isinstance(pixels, np.ndarray) else pixels[:1]
        if first.dtype not in (np.uint8, np.uint16) or first.ndim not in (2, 3):
            raise InputError(f"it must hold 8 or 16 bits per channel, got {first.dtype} in {first.ndim} dimensions")
    most = np.float32(np.iinfo(first.dtype).max)

    def rows(first: int, last: int | None) -> np.ndarray:
        if isinstance(pixels, np.ndarray):
            part = pixels[first:last]
        else:
            end = pixels.height if last is None else min(last, pixels.height)
            part = np.asarray(pixels.crop((0, first, pixels.width, end)))
        return np.divide(part if part.ndim == 3 else part[..., None], most, dtype=np.float32)

    return rows


def image_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """Width and height, pixels, that a picture file declares; its pixels are not read."""
    with _opened(require_file(path, "image")) as picture:
        return picture.size


def is_on_its_side(path: str | os.PathLike) -> bool:
    """Whether a picture's orientation tag says that its camera was turned by a quarter: its rows are columns then."""
    with _opened(require_file(path, "image")) as picture:
        return picture.getexif().get(ORIENTATION) in TURNS


@contextlib.contextmanager
def _opened(path: pathlib.Path) -> Iterator[Any]:
    """A PIL image whose header is read and whose size is allowed; whatever goes wrong becomes one ValueError."""
    # opened here: libraries take some names for addresses
    with _read_by(lambda: open(path, "rb"), path) as picture:
        yield picture


@contextlib.contextmanager
def _read_by(open_file: Callable[[], BinaryIO], path: str | pathlib.Path) -> Iterator[Any]:
    """The PIL image of what `open_file` opens; path: for messages, and its ending for HEIC."""
    from PIL import Image

    try:
        formats = [*PICTURE_FORMATS, *_heif_format(pathlib.Path(path))]
        with open_file() as file, Image.open(file, formats=formats) as picture:
            width, height = picture.size
            if width * height > MAX_PIXELS:
                raise InputError(f"it declares {width}x{height} pixels, at most {MAX_PIXELS} are read")
            yield picture
    except Exception as error:
        raise InputError(f"image {str(path)!r} cannot be read: {error_line(error, 300)}") from error


def rgba_pixels(data: bytes, name: str) -> np.ndarray:
    """The pixels (h, w, 4) uint8 of a picture that is in memory; name: what messages call it."""
    with _read_by(lambda: io.BytesIO(data), name) as picture:
        return np.asarray(picture.convert("RGBA"))


def _heif_format(path: pathlib.Path) -> tuple[str, ...]:
    """The name of HEIC's format, once Pillow knows it, for a file of that ending."""
    if path.suffix.lower() not in HEIF_ENDINGS:
        return ()
    try:
        import pillow_heif  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise InputError(f"HEIC needs its library: {extra_line('heif')}") from error
    pillow_heif.register_heif_opener()
    return ("HEIF",)


def _decoded(picture: Any, path: pathlib.Path) -> Any:
    """A picture as it is decoded: a PIL image, or (h, w, c) uint16 where that would cut it to 8 bits."""
    if picture.format == "PNG" and _png_depth(path) == 16:
        return _read_deep_png(path)
    if picture.mode in ("P", "PA", "1") or "transparency" in picture.info:
        grey = picture.mode in ("1", "L")
        return picture.convert("RGBA" if "transparency" in picture.info else "L" if grey else "RGB")
    if picture.mode in ("CMYK", "YCbCr", "LAB", "HSV"):
        return picture.convert("RGB")
    if picture.mode in ("RGBa", "La"):  # multiplied by opacity, in TIFF
        return picture.convert("RGBA" if picture.mode == "RGBa" else "LA")
    if picture.mode == "I;16B":
        return np.asarray(picture).astype(np.uint16)[..., None]
    picture.load()
    return picture


def _png_depth(path: pathlib.Path) -> int:
    """Bits per channel."""
    with open(path, "rb") as file:
        return file.read(25)[24]


def _read_deep_png(path: pathlib.Path) -> np.ndarray:
    """A PNG of 16 bits per channel; Pillow would cut colour to 8."""
    import av

    with open(path, "rb") as file, av.open(file, format="png_pipe") as container:
        frame = next(container.decode(video=0))
        if frame.format.name == "ya16be":
            return frame.reformat(format="rgba64le").to_ndarray()[..., [0, 3]].astype(np.uint16)
        pixels = frame.to_ndarray().astype(np.uint16)
        return pixels[..., None] if pixels.ndim == 2 else pixels


class PictureCuts(Cuts):
    """Counts colours that pictures clip; a little outside [0, 1] does not warn."""

    def __init__(self) -> None:
        super().__init__(beside=BESIDE, share=SHARE, far=FAR)


@contextlib.contextmanager
def picture_cuts(path: object, held: Cuts | None = None) -> Iterator[Cuts]:
    """Counts the colours that are clipped in the block and warns at its end; path: for the message.
    held: a count over several pictures, whose owner warns."""
    cuts = PictureCuts() if held is None else held
    yield cuts
    if held is None:
        cuts.warn(path, "" if str(path).lower().endswith(".exr") else LIGHT_KEPT)


def write_png(path: str | os.PathLike[str], image: ArrayLike, *, cuts: Cuts | None = None) -> None:
    """Write a PNG file, whole or not at all: (h, w), (h, w, 3) or (h, w, 4), in [0, 1] or uint8.
    cuts: counts what is clipped over several pictures; None warns for this file alone."""
    with picture_cuts(path, cuts) as held:
        pixels = _png_pixels(image, held)
        path = path_with_ending(path, ".png")
        with atomic_path(path) as temporary, open(temporary, "wb") as file:  # by name, some are taken for addresses
            _encode_png(file, pixels)


def png_bytes(image: ArrayLike) -> bytes:
    """The bytes that `write_png` writes."""
    data = io.BytesIO()
    _encode_png(data, _png_pixels(image))
    return data.getvalue()


def _png_pixels(image: ArrayLike, cuts: Cuts | None = None) -> np.ndarray:
    pixels = to_uint8(image, cuts)
    if pixels.ndim == 3 and pixels.shape[-1] == 1:
        pixels = pixels[..., 0]
    if not (pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[-1] in (3, 4))) or 0 in pixels.shape:
        raise InputError(f"a PNG holds (h, w), (h, w, 3) or (h, w, 4), got shape {pixels.shape}")
    return pixels


def _encode_png(file: BinaryIO, pixels: np.ndarray) -> None:
    iio.imwrite(file, pixels, extension=".png", compress_level=1, compress_type=PNG_STRATEGY)


def write_jpeg(path: str | os.PathLike[str], image: ArrayLike, *, quality: int = 95, cuts: Cuts | None = None) -> None:
    """Write a JPEG file, whole or not at all: (h, w) or (h, w, 3), in [0, 1] or uint8; cuts: as of `write_png`."""
    path = pathlib.Path(path)
    if path.suffix.lower() not in (".jpg", ".jpeg"):
        raise InputError(f"{str(path)!r} must end in .jpg or .jpeg")
    with picture_cuts(path, cuts) as held:
        pixels = to_uint8(image, held)
        if not (pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[-1] == 3)) or 0 in pixels.shape:
            raise InputError(f"a JPEG holds (h, w) or (h, w, 3), got shape {pixels.shape}")
        with atomic_path(path) as temporary, open(temporary, "wb") as file:
            iio.imwrite(file, pixels, extension=".jpg", quality=quality, subsampling=0)  # 4:4:4: colours at full size


def path_with_ending(path: str | os.PathLike[str], ending: str) -> pathlib.Path:
    """The path of a file to write, once its ending, in capitals or not, is checked."""
    path = pathlib.Path(path)
    if path.suffix.lower() != ending:
        raise InputError(f"{str(path)!r} must end in {ending}")
    return path


def to_uint8(image: ArrayLike, cuts: Cuts | None = None) -> np.ndarray:
    """An image of any shape, in [0, 1], as uint8, rounded and clipped; uint8 is returned as it is.
    cuts: counts what is clipped."""
    pixels = np.asarray(image)
    if pixels.dtype == np.uint8:
        return pixels
    if not np.isfinite(pixels).all():
        raise InputError(NOT_FINITE)
    if cuts is not None:
        cuts.clip(COLORS, pixels, 0.0, 1.0, 1.0 / 255.0)
    scaled = np.asarray(np.clip(pixels, 0.0, 1.0) * 255.0)
    return np.rint(scaled, out=scaled).astype(np.uint8)


def with_opacity(premultiplied: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Straight colours and opacity (h, w, 4) float32 in [0, 1], black where that is 0.
    premultiplied: (h, w, 3) colour times opacity, alpha: (h, w, 1) in [0, 1]."""
    straight = np.divide(premultiplied, alpha, out=np.zeros_like(premultiplied), where=alpha > 0.0)
    return np.concatenate([np.clip(straight, 0.0, 1.0), alpha], axis=-1).astype(np.float32)


def as_rgb(image: ArrayLike) -> np.ndarray:
    """A grey (h, w) or coloured (h, w, 3) image, in [0, 1] or uint8, as (h, w, 3) float32 in [0, 1]."""
    given = np.asarray(image)
    pixels = given.astype(np.float32) / np.float32(255.0) if given.dtype == np.uint8 else given.astype(np.float32)
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[..., None], 3, axis=-1)
    if pixels.ndim != 3 or pixels.shape[-1] != 3 or 0 in pixels.shape:
        raise InputError(f"an image must be (h, w) or (h, w, 3), got {pixels.shape}")
    return pixels


def shrunk_size(size: tuple[int, int], factor: int) -> tuple[int, int]:
    """The size, pixels, that `shrink` leaves of an image; two sides in the same order."""
    return max(1, round(size[0] / factor)), max(1, round(size[1] / factor))


def shrink(premultiplied: np.ndarray, factor: int) -> np.ndarray:
    """A smaller image by averages over squares of `factor` pixels; (h, w, c) float, colour times opacity."""
    if factor == 1:
        return premultiplied
    height, width = premultiplied.shape[:2]
    if height % factor == 0 and width % factor == 0:
        blocks = premultiplied.reshape(height // factor, factor, width // factor, factor, -1)
        return blocks.mean(axis=(1, 3))
    from skimage.transform import resize_local_mean  # with a remainder the squares are a little larger or smaller

    return resize_local_mean(premultiplied, shrunk_size((height, width), factor), channel_axis=-1, preserve_range=True)


def shrink_weights(weights: np.ndarray, factor: int) -> np.ndarray:
    """Weights of pixels (..., h, w) for images that `shrink` makes smaller: the least in each square."""
    if factor == 1:
        return weights
    for axis in (weights.ndim - 2, weights.ndim - 1):
        side = weights.shape[axis]
        places = np.arange(shrunk_size((side, side), factor)[0] + 1) * side  # with a remainder the squares overlap
        firsts, ends = places[:-1] // (len(places) - 1), -(-places[1:] // (len(places) - 1))
        spans = np.stack([firsts, ends], axis=1).ravel()
        padded = np.concatenate([weights, weights.take([-1], axis)], axis)  # `reduceat` takes no end of the array
        weights = np.minimum.reduceat(padded, spans, axis).take(np.arange(0, len(spans), 2), axis)
    return weights


def side_by_side(images: Iterable[ArrayLike], *, gap: int = 4, background: ArrayLike = 1.0) -> np.ndarray:
    """Images (h, w) or (h, w, 3) of one size in a row, (h, w, 3) float32, with `gap` pixels of background between."""
    row = list(images)
    return contact_sheet(row, columns=max(1, len(row)), gap=gap, background=background)


def contact_sheet(
    images: Iterable[ArrayLike], *, columns: int | None = None, gap: int = 4, background: ArrayLike = 1.0
) -> np.ndarray:
    """Images (h, w) or (h, w, 3) of one size row by row on a sheet, (h, w, 3) float32.
    `columns` of None makes as many rows as columns, or one less."""
    pictures = [as_rgb(image) for image in images]
    if not pictures:
        raise InputError("a sheet needs at least one image")
    if len({picture.shape for picture in pictures}) > 1:
        raise InputError(f"images of a sheet must have one size, got {sorted({p.shape[:2] for p in pictures})}")
    columns = math.ceil(math.sqrt(len(pictures))) if columns is None else columns
    if columns < 1 or gap < 0:
        raise InputError(f"a sheet needs columns >= 1 and gap >= 0, got {columns} and {gap}")
    rows = math.ceil(len(pictures) / columns)
    height, width = pictures[0].shape[:2]
    sheet = np.empty((rows * (height + gap) - gap, columns * (width + gap) - gap, 3), np.float32)
    sheet[...] = background
    for index, picture in enumerate(pictures):
        row, column = divmod(index, columns)
        y, x = row * (height + gap), column * (width + gap)
        sheet[y : y + height, x : x + width] = picture
    return sheet


def disparity_range(disparity: ArrayLike, *, percentiles: tuple[float, float] = (2.0, 98.0)) -> tuple[float, float]:
    """Low and high end of a scale for `colour_disparity` that a few outliers do not spoil; 0 and 1 for nothing seen."""
    values = np.asarray(disparity, np.float32)
    seen = values[np.isfinite(values) & (values > 0)]
    if seen.size == 0:
        return 0.0, 1.0
    low, high = (float(value) for value in np.percentile(seen, percentiles))
    return low - FAR_ROOM * (high - low), high  # what is farthest should still differ from nothing at all


def color_disparity(
    disparity: ArrayLike, *, alpha: ArrayLike | None = None, scale: tuple[float, float] | None = None
) -> np.ndarray:
    """Disparity (h, w) in colour (h, w, 3): near is light, far is dark, nothing seen (0) is black.
    `scale`: of the darkest and the lightest colour, None for `disparity_range`; give one to a whole video."""
    values = np.asarray(disparity, np.float32)
    if values.ndim != 2:
        raise InputError(f"disparity must be (h, w), got {values.shape}")
    if alpha is not None and np.shape(alpha) != values.shape:
        raise InputError(f"alpha must be {values.shape} as the disparity, got {np.shape(alpha)}")
    low, high = disparity_range(values) if scale is None else scale
    if not (np.isfinite([low, high]).all() and high >= low):
        raise InputError(f"a disparity scale needs finite low <= high, got {low} and {high}")
    seen = np.isfinite(values) & (values > 0)
    level = np.clip((np.where(seen, values, low) - low) / max(high - low, 1e-12), 0.0, 1.0)
    place = level * (len(_WARM) - 1)
    color = np.stack([np.interp(place, np.arange(len(_WARM)), channel) for channel in _WARM.T], axis=-1)
    share = seen if alpha is None else seen * np.asarray(alpha, np.float32)  # a frame has depth for the faintest haze
    return (share[..., None] * color).astype(np.float32)
