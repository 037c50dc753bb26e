"""Films as files: H.264 video and animated GIF."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from typing import Any

import imageio.v3 as iio
import numpy as np
from numpy.typing import ArrayLike

from ..core.checks import checked_positive, checked_whole
from ..core.files import atomic_path
from .pictures import as_rgb, path_with_ending, to_uint8

#: Colours of a GIF's palette.
MIN_COLOURS, MAX_COLOURS = 2, 256

#: Frames that a GIF's palette is chosen from.
PALETTE_FRAMES = 12


def write_video(path: str | os.PathLike, frames: Iterable[ArrayLike], fps: float = 24.0) -> None:
    """Write an H.264 video that browsers play (yuv420p), whole or not at all.

    Args:
        path: The file; it must end in .mp4.
        frames: Images (h, w, 3) of one size, values in [0, 1] or uint8. They are taken one by one, so a generator that
            renders will do. Odd sizes lose their last row or column.
        fps: Frames per second.

    Raises:
        ValueError: For no frames, sizes that differ, a rate that is not positive, or another ending.
    """
    path = path_with_ending(path, ".mp4")
    fps = checked_positive(fps, "fps")
    with atomic_path(path) as temporary:
        with iio.imopen(temporary, "w", plugin="pyav", extension=".mp4") as video:
            started = False
            for frame in _even_frames(frames):
                if not started:
                    video.init_video_stream("libx264", fps=round(fps), pixel_format="yuv420p")
                    started = True
                video.write_frame(frame)


def write_gif(
    path: str | os.PathLike, frames: Iterable[ArrayLike], fps: float = 15.0, *, colours: int = 128, loop: bool = True
) -> None:
    """Write an animated GIF with one palette, kept small, whole or not at all.

    Args:
        path: The file; it must end in .gif.
        frames: Images (h, w, 3) of one size, values in [0, 1] or uint8.
        fps: Frames per second.
        colours: Size of the palette, 2 to 256.
        loop: Whether the film starts again at its end.

    Raises:
        ValueError: For no frames, sizes that differ, a rate or palette out of range, or another ending.
    """
    from PIL import Image

    path = path_with_ending(path, ".gif")
    fps = checked_positive(fps, "fps")
    colours = checked_whole(colours, "colours", MIN_COLOURS, MAX_COLOURS)
    images = list(_same_size(frames))
    # one palette for all frames, from a thinned strip of them, so that still regions stay still
    strip = np.concatenate(images[:: max(1, len(images) // PALETTE_FRAMES)])
    palette = Image.fromarray(strip).quantize(colours - 1, method=Image.Quantize.MEDIANCUT)
    # median cut mixes the background with similar colours: it gets an entry of its own
    entries, background = (palette.getpalette() or [])[: 3 * (colours - 1)], _most_frequent_colour(strip)
    flat = []
    for frame in images:
        indices = np.array(Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE))
        indices[(frame == background).all(axis=-1)] = len(entries) // 3
        flat.append(Image.fromarray(indices))
        flat[-1].putpalette([*entries, *background.tolist()])
    with atomic_path(path) as temporary:
        options: dict[str, Any] = {"loop": 0} if loop else {}
        flat[0].save(
            temporary,
            format="GIF",
            save_all=True,
            append_images=flat[1:],
            duration=round(1000 / fps),
            optimize=True,
            **options,
        )


def _most_frequent_colour(pixels: np.ndarray) -> np.ndarray:
    """(3,) uint8, the colour that most of the pixels (..., 3) have: usually the background."""
    codes = pixels.reshape(-1, 3).astype(np.int64) @ (65536, 256, 1)
    values, counts = np.unique(codes, return_counts=True)
    code = int(values[counts.argmax()])
    return np.array([code >> 16, code >> 8 & 255, code & 255], np.uint8)


def _same_size(frames: Iterable[ArrayLike]) -> Iterator[np.ndarray]:
    """The frames as (h, w, 3) uint8; refused where their sizes differ or there are none."""
    first = None
    for index, frame in enumerate(frames):
        pixels = to_uint8(as_rgb(frame))
        first = pixels.shape if first is None else first
        if pixels.shape != first:
            raise ValueError(f"frames must have one size: frame 0 is {first[:2]}, frame {index} is {pixels.shape[:2]}")
        yield pixels
    if first is None:
        raise ValueError("a film needs at least one frame")


def _even_frames(frames: Iterable[ArrayLike]) -> Iterator[np.ndarray]:
    """The frames cut to even sizes, as yuv420p has half as many colours along each axis."""
    for frame in _same_size(frames):
        height, width = (side // 2 * 2 for side in frame.shape[:2])
        if height == 0 or width == 0:
            raise ValueError(f"a video needs frames of at least 2x2 pixels, got {frame.shape[:2]}")
        yield np.ascontiguousarray(frame[:height, :width])
