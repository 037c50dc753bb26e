"""Video files: H.264, animated GIF, and with opacity ProRes 4444 and VP9."""

from __future__ import annotations

import functools
import io
import itertools
import os
import pathlib
from collections.abc import Iterable, Iterator, Sequence, Sized
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...core.checks import Cuts, checked_positive, checked_whole
from ...core.files import atomic_path
from ...core.memory import require_host_memory
from ...core.npz import read_npz, require_numbers
from ...core.reports import Progress, report_progress, reports_progress
from ...errors import InputError
from ...view.motion import frame_rate
from ...view.pictures import COLORS, as_rgb, path_with_ending, picture_cuts, read_image, to_uint8
from .overlap import stream

#: Endings of films, and of films with opacity.
FILM_ENDINGS, CLEAR_ENDINGS = (".mp4", ".gif", ".mov", ".webm"), (".mov", ".webm")

#: Frames per second, least and most: of a video, and of a GIF, which counts hundredths of a second. Viewers slow down
#: where a frame has fewer than two of them.
VIDEO_RATES, GIF_RATES = (Fraction(1, 100), Fraction(1000)), (Fraction(1, 100), Fraction(50))

#: Milliseconds that a GIF can show one picture. Equal frames that follow one another are one picture.
MAX_STILL = 655350

#: Colours of a GIF's palette.
MIN_COLORS, MAX_COLORS = 2, 256

#: Frames that a GIF's palette is chosen from.
PALETTE_FRAMES = 12

#: Bytes of frames of a GIF between checks of free memory, and bytes a pixel that it needs beside its frames: one for
#: the indexed frame, two in Pillow, which compares each frame with the one before.
GIF_LOOK, GIF_COPIES = 1 << 27, 3

#: Pixels by which colours are continued beyond an edge: the blocks of video codecs are 8 to 32 pixels wide.
SPREAD = 24

#: Opacity below which 8 bits show nothing.
CLEAR = 0.5 / 255.0


def checked_rate(fps: float | Fraction, ending: str) -> Fraction:
    """A film's frames per second as a fraction, which may not be too high or low; see `frame_rate`."""
    low, high = GIF_RATES if ending == ".gif" else VIDEO_RATES
    rate = frame_rate(fps if isinstance(fps, Fraction) else checked_positive(fps, "fps"))
    if not low <= rate <= high:
        raise InputError(f"fps of a film ({ending}) must be from {float(low):g} to {float(high):g}, got {fps}")
    return rate


def film_size(width: int, height: int, ending: str) -> tuple[int, int]:
    """Width and height of a film whose pictures have some size: .mp4 has even sides."""
    return (width // 2 * 2, height // 2 * 2) if ending == ".mp4" else (width, height)


def require_clear_film(path: str | os.PathLike[str]) -> None:
    """Raises ValueError for a film that has no opacity; a name without an ending is a folder of pictures, which do."""
    ending = os.path.splitext(path)[1].lower()
    if ending and ending not in CLEAR_ENDINGS:
        raise InputError(
            f"a film that ends in {ending} has no opacity: give .mov (ProRes 4444), .webm, or a folder of pictures, "
            "which has no ending"
        )


@reports_progress
def write_film(
    path: str | os.PathLike[str],
    frames: Iterable[ArrayLike],
    fps: float | Fraction = 24.0,
    *,
    loop: bool = True,
    progress: bool | Progress = False,
) -> None:
    """Write a film, whole or not at all, by its ending; frames are (h, w, 3), for .mov and .webm also (h, w, 4).
    They are taken one by one, in this thread, and encoded by others while the next are made; `loop` is of a GIF."""
    ending = os.path.splitext(path)[1].lower()
    if ending == ".gif":
        write_gif(path, frames, fps, loop=loop, progress=progress)
    elif ending in FILM_ENDINGS:
        _write_stream(path, ending, frames, fps, progress)
    else:
        raise InputError(f"film {str(path)!r} must end in {', '.join(FILM_ENDINGS)}")


def write_video(
    path: str | os.PathLike[str],
    frames: Iterable[ArrayLike],
    fps: float | Fraction = 24.0,
    *,
    progress: bool | Progress = False,
) -> None:
    """Write an H.264 video that browsers play (yuv420p), whole or not at all; odd sizes lose their last row or column.
    Frames are (h, w, 3) of one size, in [0, 1] or uint8, and are taken one by one."""
    _write_stream(path_with_ending(path, ".mp4"), ".mp4", frames, fps, progress)


def _write_stream(
    path: str | os.PathLike[str], ending: str, frames: Iterable[ArrayLike], fps: float | Fraction, progress: Any
) -> None:
    """Write a video: H.264 (.mp4), or with straight colours and opacity ProRes 4444 (.mov) or VP9 (.webm)."""
    rate = checked_rate(fps, ending)
    with picture_cuts(path) as cuts, atomic_path(path) as temporary:
        prepare = functools.partial(_byte_pixels if ending == ".mp4" else deep_pixels, cuts=cuts)
        stream(_owned(frames, progress), prepare, functools.partial(_encode, temporary, ending, rate))


def _encode(path: pathlib.Path, ending: str, rate: Fraction, images: Iterable[np.ndarray]) -> None:
    """Write images (h, w, 3) uint8, or (h, w, 3 or 4) uint16 where the film may have opacity."""
    import av

    images = _of_one_size(images)
    images = map(even_frame, images) if ending == ".mp4" else images
    first = next(images)
    height, width, channels = first.shape
    given, pixel_format, codec, options = _codec(ending, channels == 4)
    # opened here: by name, some names are taken for addresses
    with open(path, "w+b") as file, av.open(file, "w", format=ending[1:]) as container:
        video = container.add_stream(codec, rate=rate, options=options)
        video.width, video.height, video.pix_fmt = width, height, pixel_format
        # players guess the colour space of a stream that is not tagged; PyAV does not convert by it
        video.color_range, video.color_primaries, video.color_trc, video.colorspace = _LIMITED, 1, 1, 1
        if ending == ".webm" and channels == 4:
            video.metadata["alpha_mode"] = "1"
        for image in itertools.chain([first], images):
            frame = av.VideoFrame.from_ndarray(image, format=given)
            container.mux(video.encode(frame.reformat(format=pixel_format, **_converted())))
        container.mux(video.encode(None))


#: Limited range (AVCOL_RANGE_MPEG), and BT.709, which is number 1 of primaries, transfer and matrix.
_LIMITED = 1


def _converted() -> dict[str, Any]:
    """The options of a conversion to those colours."""
    return {"dst_colorspace": "ITU709", "dst_color_range": "MPEG", **one_thread()}


def one_thread() -> dict[str, Any]:
    """The option of a conversion of a frame in one thread."""
    # Threads of the conversion, which PyAV 17 brought, race: now and then a part of a plane is not written (FFmpeg 8).
    import av

    return {"threads": 1} if int(av.__version__.split(".")[0]) >= 17 else {}


def _codec(ending: str, clear: bool) -> tuple[str, str, str, dict[str, str]]:
    """Pixel formats of images and of the film, encoder and its options."""
    if ending == ".mp4":
        return "rgb24", "yuv420p", "libx264", {}
    given, kind = ("rgba64le", "yuva") if clear else ("rgb48le", "yuv")
    if ending == ".mov":  # for editors
        options = {"profile": "4444", "vendor": "apl0", **({"alpha_bits": "16"} if clear else {})}
        return given, f"{kind}444p10le", "prores_ks", options
    return given, f"{kind}420p", "libvpx-vp9", {"crf": "18", "b": "0", "auto-alt-ref": "0"}  # for browsers


def _owned(frames: Iterable[ArrayLike], progress: bool | Progress) -> Iterator[np.ndarray]:
    """The frames as arrays that stay as they are while the next ones are made: copies of those that can be written."""
    total = len(frames) if isinstance(frames, Sized) else 0
    for index, frame in enumerate(frames, 1):
        report_progress(progress, index, total, "film")
        pixels = np.asarray(frame)
        yield pixels.copy() if pixels.flags.writeable else pixels


def with_spread_colors(rgba: ArrayLike, reach: int = SPREAD) -> np.ndarray:
    """A picture (h, w, 4), straight colours in [0, 1], whose clear pixels take the colour of the nearest one that is
    not clear, up to `reach` pixels away."""
    # Codecs halve colours apart from opacity: the black behind clear pixels would be a dark rim around the object.
    from scipy.ndimage import distance_transform_edt

    spread = np.array(rgba, np.float32)
    clear = spread[..., 3] < CLEAR
    if clear.all() or not clear.any():
        return spread
    # SciPy's stubs know no more than that it returns something
    distance, (row, column) = distance_transform_edt(clear, return_indices=True)  # pyright: ignore[reportGeneralTypeIssues]
    filled = clear & (distance <= reach)
    spread[filled, :3] = spread[row[filled], column[filled], :3]
    return spread


def deep_pixels(pixels: np.ndarray, cuts: Cuts | None = None) -> np.ndarray:
    """A frame as films with 16 bits take it: (h, w, 3) or (h, w, 4) uint16, colours spread beyond edges.
    It is (h, w), (h, w, 3) or (h, w, 4) with straight colours, in [0, 1] or uint8; or uint16, which stays as it is."""
    if pixels.dtype == np.uint16:
        return pixels
    if pixels.ndim == 3 and pixels.shape[-1] == 4:
        scale = np.float32(255.0) if pixels.dtype == np.uint8 else np.float32(1.0)
        image = with_spread_colors(pixels / scale)
    else:
        image = as_rgb(pixels)
    if not np.isfinite(image).all():
        raise InputError("an image holds values that are not finite")
    if cuts is not None:
        cuts.clip(COLORS, image, 0.0, 1.0, 1.0 / 65535.0)
    return np.round(np.clip(image, 0.0, 1.0) * 65535.0).astype(np.uint16)


def write_film_frame(path: str | os.PathLike[str], picture: ArrayLike, *, cuts: Cuts | None = None) -> None:
    """Write a frame of a film with 16 bits (.npz), without loss and with all that its encoder needs, in place.
    cuts: as of `write_png`."""
    data = io.BytesIO()
    with picture_cuts(path, cuts) as held:
        np.savez_compressed(data, pixels=deep_pixels(np.asarray(picture), held))
    pathlib.Path(path).write_bytes(data.getbuffer())


def read_film_frame(path: str | os.PathLike[str]) -> np.ndarray:
    """Read a picture that becomes a frame of a film; one of `write_film_frame` (.npz) is (h, w, 3) or (h, w, 4) uint16.
    Others are as `read_image` has them, grey as (h, w). Read-only."""
    if os.path.splitext(path)[1].lower() == ".npz":
        contents = read_npz(path, "frame")
        pixels = require_numbers(contents, "pixels", (None, None, None), path)
        if pixels.dtype != np.uint16 or pixels.shape[-1] not in (3, 4):
            raise InputError(f"{path}: pixels must be (h, w, 3) or (h, w, 4) uint16, got {pixels.dtype} {pixels.shape}")
    else:
        pixels = read_image(path)
        pixels = pixels[..., 0] if pixels.shape[-1] == 1 else pixels
    pixels.flags.writeable = False
    return pixels


def _byte_pixels(pixels: np.ndarray, cuts: Cuts) -> np.ndarray:
    """A frame as (h, w, 3) uint8."""
    return to_uint8(as_rgb(pixels), cuts)


def write_gif(
    path: str | os.PathLike[str],
    frames: Iterable[ArrayLike],
    fps: float | Fraction = 15.0,
    *,
    colors: int = 128,
    loop: bool = True,
    progress: bool | Progress = False,
) -> None:
    """Write an animated GIF with one palette, kept small, whole or not at all, of frames (h, w, 3), in [0, 1] or uint8.
    All are held in memory until the last one is there: the palette is of all of them."""
    from PIL import Image

    path = path_with_ending(path, ".gif")
    rate = checked_rate(fps, ".gif")
    colors = checked_whole(colors, "colors", MIN_COLORS, MAX_COLORS)
    images: list[np.ndarray] = []
    with picture_cuts(path) as cuts:
        prepare = functools.partial(_byte_pixels, cuts=cuts)
        stream(_owned(frames, progress), prepare, lambda ready: images.extend(_that_fit(_of_one_size(ready))))
    # one palette for all frames, from a thinned strip of them, so that still regions stay still
    strip = np.concatenate(images[:: max(1, len(images) // PALETTE_FRAMES)])
    palette = Image.fromarray(strip).quantize(colors - 1, method=Image.Quantize.MEDIANCUT)
    # median cut mixes the background with similar colours: it gets an entry of its own
    entries, background = (palette.getpalette() or [])[: 3 * (colors - 1)], _most_frequent_color(strip)
    flat = []
    for frame in images:
        indices = np.array(Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE))
        indices[(frame == background).all(axis=-1)] = len(entries) // 3
        flat.append(Image.fromarray(indices))
        flat[-1].putpalette([*entries, *background.tolist()])
    durations = _gif_durations(flat, rate)
    with atomic_path(path) as temporary:
        options: dict[str, Any] = {"loop": 0} if loop else {}
        flat[0].save(
            temporary, format="GIF", save_all=True, append_images=flat[1:], duration=durations, optimize=True, **options
        )


def _gif_durations(images: Sequence[Any], rate: Fraction) -> list[int]:
    """Milliseconds of each PIL image, in whole hundredths of a second: each begins as near to its time as can be."""
    starts = [round(100 * index / rate) for index in range(len(images) + 1)]
    durations = [10 * (end - begin) for begin, end in itertools.pairwise(starts)]
    still = 0
    for index, duration in enumerate(durations):
        same = index > 0 and images[index].tobytes() == images[index - 1].tobytes()
        still = duration + (still if same else 0)
        if still > MAX_STILL:
            raise InputError(
                f"a GIF shows a picture for at most {MAX_STILL / 1000} s, but frame {index} and those before it, which "
                f"are equal, take {still / 1000:g} s: give a higher fps, or write .mp4"
            )
    return durations


def _most_frequent_color(pixels: np.ndarray) -> np.ndarray:
    """(3,) uint8, the colour that most of the pixels (..., 3) have: usually the background."""
    codes = pixels.reshape(-1, 3).astype(np.int64) @ (65536, 256, 1)
    values, counts = np.unique(codes, return_counts=True)
    code = int(values[counts.argmax()])
    return np.array([code >> 16, code >> 8 & 255, code & 255], np.uint8)


def _of_one_size(images: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    """The images; refused where their sizes differ or there are none."""
    first = None
    for index, pixels in enumerate(images):
        first = pixels.shape if first is None else first
        if pixels.shape != first:
            sides = 2 if pixels.shape[:2] != first[:2] else 3  # or one has opacity
            raise InputError(
                f"frames must have one size: frame 0 is {first[:sides]}, frame {index} is {pixels.shape[:sides]}"
            )
        yield pixels
    if first is None:
        raise InputError("a film needs at least one frame")


def _that_fit(images: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    """The images of a GIF, while there is memory for them."""
    since = 0
    for index, pixels in enumerate(images):
        since += pixels.nbytes
        if since > GIF_LOOK:
            need = GIF_COPIES * (index + 1) * pixels.nbytes // pixels.shape[-1]
            require_host_memory(need, f"{index + 1} frames of a GIF, which are all held (.mp4 holds few), need")
            since = 0
        yield pixels


def even_frame(frame: np.ndarray) -> np.ndarray:
    """A frame cut to even sizes, as yuv420p has half as many colours along each axis."""
    height, width = (side // 2 * 2 for side in frame.shape[:2])
    if height == 0 or width == 0:
        raise InputError(f"a video needs frames of at least 2x2 pixels, got {frame.shape[:2]}")
    return np.ascontiguousarray(frame[:height, :width])
