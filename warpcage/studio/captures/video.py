"""Sharp, well spread frames of a video."""

from __future__ import annotations

import dataclasses
import pathlib
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from ...core.files import atomic_path, require_file, seen_note
from ...core.names import agreed, counted
from ...core.reports import Progress
from ...core.threads import cpu_threads
from ...errors import InputError
from .sources import Source, StepBar, load_upright, shrink_factor
from .tones import mapped_picture, plain_picture, transfer_of

#: Pictures are compared at this width or height, whichever is longer, pixels.
COMPARED_SIZE = 640

#: Motion is measured at this size: shifts of a few of its pixels stay where brightness is linear in them.
MOTION_SIZE = 96

#: Details below this have no edges to judge: a wall, the sky, a lens that is covered. In steps of 8 bits.
MIN_DETAIL = 0.3


def sharpness(grey: np.ndarray) -> float:
    """How much fine detail a picture (h, w), 0 to 255, some COMPARED_SIZE pixels long, has for the coarse detail that
    it has: some 0.2 for blurred to 1 for sharp pictures; 0 where there is nothing to see."""
    # The root mean square of what a binomial blur takes away, over that of what a second, twice as wide one does. Blur
    # takes fine detail first, so that the ratio falls with it, while the content, which both see, hardly matters.
    if min(grey.shape) < 16:
        return 0.0
    picture = np.asarray(grey, np.float32)
    once = _blurred(picture)
    thin = once[::2, ::2]
    coarse = float(np.sqrt(np.mean((thin - _blurred(thin)) ** 2)))
    fine = float(np.sqrt(np.mean((picture - once) ** 2)))
    return fine / coarse if coarse > MIN_DETAIL else 0.0


def motion(before: np.ndarray, after: np.ndarray) -> float:
    """How far the view moves between two pictures (h, w), MOTION_SIZE pixels long: mean shift along the gradients of
    brightness, as a share of the longer side; 0 where there is nothing to see."""
    # Normal flow (Horn and Schunck 1981). It grows slower than the true shift beyond two of the pixels.
    first, second = (_blurred(np.asarray(picture, np.float32)) for picture in (before, after))
    down, across = np.gradient(0.5 * (first + second))
    slope = np.hypot(down, across)
    weight = float((slope * slope).sum())
    if weight < slope.size:
        return 0.0
    return float((np.abs(second - first) * slope).sum()) / weight / max(first.shape)


def shrunk_grey(grey: np.ndarray, size: int) -> np.ndarray:
    """A picture (h, w) uint8 as float32, its longer side at most `size`, by averages of whole squares."""
    factor = -(-max(grey.shape) // size)
    height, width = (side // factor * factor for side in grey.shape)
    if factor <= 1 or not height or not width:
        return grey.astype(np.float32)
    blocks = grey[:height, :width].reshape(height // factor, factor, width // factor, factor)
    return blocks.mean(axis=(1, 3), dtype=np.float32)


def _blurred(picture: np.ndarray) -> np.ndarray:
    """The binomial blur (1 2 1) / 4 along both axes, with edges repeated."""
    padded = np.pad(picture, 1, mode="edge")
    rows = 0.25 * (padded[:-2] + padded[2:]) + 0.5 * padded[1:-1]
    return 0.25 * (rows[:, :-2] + rows[:, 2:]) + 0.5 * rows[:, 1:-1]


#: A frame is taken where the view has moved at least this far since the last one, as a share of the longer side: closer
#: ones show nothing new.
MIN_STEP = 0.004


@dataclasses.dataclass(frozen=True)
class FrameScores:
    """What is known of the frames of a video, in their order."""

    times: np.ndarray  # (n,) int64 presentation times, which name the frames
    sharpness: np.ndarray  # (n,) see `sharpness`
    way: np.ndarray  # (n,) how far the view has moved until each frame, in longer sides of the picture
    size: tuple[int, int]  # width and height as it is looked at, pixels
    broken: int  # frames and packets that could not be decoded
    transfer: str = ""  # "HLG" or "PQ" for videos of high dynamic range, which are tone-mapped


def scan_video(path: pathlib.Path, *, progress: bool | Progress = False) -> FrameScores:
    """Decode a video once and measure each frame."""
    times, scores, steps, size, broken, before, transfer = [], [], [], None, [0], None, ""
    with _opened(path) as container:
        context = container.streams.video[0].codec_context
        total = container.streams.video[0].frames or None
        with StepBar(total, "frames", progress) as shown:
            for frame in _frames(container, broken):
                grey = frame.to_ndarray(format="gray")  # (h, w) uint8, as it is stored
                small = shrunk_grey(grey, MOTION_SIZE)
                steps.append(0.0 if before is None or before.shape != small.shape else motion(before, small))
                scores.append(sharpness(shrunk_grey(grey, COMPARED_SIZE)))
                times.append(frame.pts)
                transfer = transfer or transfer_of(frame, context)
                size = (frame.height, frame.width) if _quarters(frame) % 2 else (frame.width, frame.height)
                before = small
                shown.update()
    if size is None:
        raise InputError(f"video {str(path)!r} has no frame that can be decoded: it may be cut off, or not a video")
    if broken[0]:
        warnings.warn(
            f"{counted(broken[0], 'frame')} of {str(path)!r} cannot be decoded and "
            f"{agreed(broken[0], 'is', 'are')} left out",
            stacklevel=3,
        )
    way = np.cumsum(np.array(steps))
    return FrameScores(np.array(times, np.int64), np.array(scores), way, size, broken[0], transfer)


def pick_frames(scores: FrameScores, count: int, least_step: float = MIN_STEP) -> np.ndarray:
    """Indices (k,) int64, ascending, of at most `count` frames that are worth their while, at least a step apart."""
    # The sharpest of each of `count` equal parts of the way, fewer where it is short, however fast the camera moves.
    length = float(scores.way[-1])
    parts = int(min(count, len(scores.times), max(1, length / least_step)))
    part = np.minimum((scores.way / max(length, 1e-12) * parts).astype(np.int64), parts - 1)
    order = np.lexsort((np.arange(len(part)), -scores.sharpness, part))  # by part, then the sharpest first
    first = np.concatenate([[True], np.diff(part[order]) > 0])
    return np.sort(order[first])


def write_frames(
    path: pathlib.Path, times: np.ndarray, files: list[pathlib.Path], *, progress: bool | Progress = False
) -> None:
    """Write the frames of a video at ascending presentation times (k,) to k files (.png, .jpg), upright, but those that
    are there."""
    from PIL import Image

    from ...core.files import atomic_path

    wanted = dict(zip(times.tolist(), files, strict=True))
    missing = {time: file for time, file in wanted.items() if not file.is_file()}
    with StepBar(len(files), "pictures", progress, done=len(files) - len(missing)) as shown:
        if not missing:
            return
        with _opened(path) as container:
            context = container.streams.video[0].codec_context
            for frame in _frames(container, [0]):
                file = missing.pop(frame.pts, None)
                if file is not None:
                    transfer = transfer_of(frame, context)
                    stored = mapped_picture(frame, transfer) if transfer else plain_picture(frame)
                    picture = np.rot90(stored, _quarters(frame))
                    with atomic_path(file) as temporary:
                        Image.fromarray(np.ascontiguousarray(picture)).save(temporary, quality=97, subsampling=0)
                    shown.update()
                if not missing:
                    return
    raise InputError(
        f"video {str(path)!r}: {counted(len(missing), 'frame')} {agreed(len(missing), 'is', 'are')} not "
        "found again: it changed while it was read"
    )


def _opened(path: pathlib.Path) -> Any:
    """The container of a video file."""
    import av
    from av.error import FFmpegError

    path = require_file(path, "video")
    try:
        # by name, some names are taken for addresses
        name = f"file:{path.absolute()}"
        try:
            container = av.open(name, metadata_errors="ignore")
        except TypeError:  # from version 19 on PyAV takes no such word
            container = av.open(name)
    except (FFmpegError, OSError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise InputError(f"{str(path)!r} cannot be read as a video{seen_note(path)}: {reason}") from error
    if not container.streams.video:
        container.close()
        raise InputError(f"{str(path)!r} holds no video stream")
    container.streams.video[0].thread_type = "AUTO"
    return container


def _frames(container: Any, broken: list[int]) -> Iterator[Any]:
    """Frames whose time is known; what cannot be decoded is counted in broken[0]."""
    from av.error import FFmpegError

    stream = container.streams.video[0]
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets)
        except StopIteration:
            return
        except FFmpegError:  # the container itself ends here
            broken[0] += 1
            return
        try:
            frames = packet.decode()
        except FFmpegError:
            broken[0] += 1
            continue
        for frame in frames:
            if frame.is_corrupt or frame.pts is None:
                broken[0] += 1
            else:
                yield frame


def _quarters(frame: Any) -> int:
    """Quarter turns against the clock that bring a frame upright."""
    return round(frame.rotation / 90) % 4


def shrink_all(
    sources: Sequence[Source], folder: pathlib.Path, size: int, progress: bool | Progress
) -> tuple[list[str], np.ndarray]:
    """Write pictures, but those that are there, with longer sides of at most `size` pixels, at which features are
    looked for. Returns their file names, and (n,) how sharp each is."""
    folder.mkdir(exist_ok=True)
    names = [
        f"{source.name.replace(' ', '_')}.png" for source in sources
    ]  # COLMAP's lists of pairs end names at spaces
    if len(set(names)) < len(names):
        names = [f"{index:05d}.png" for index in range(len(sources))]
    sharp = np.zeros(len(sources))

    def shrink(index: int) -> None:
        sharp[index] = _shrink(sources[index], folder / names[index], size)

    with StepBar(len(sources), "shrink", progress) as shown, ThreadPoolExecutor(cpu_threads()) as pool:
        for _ in pool.map(shrink, range(len(sources))):
            shown.update()
    return names, sharp


def _shrink(source: Source, file: pathlib.Path, size: int) -> float:
    """Write a picture no larger than `size`, unless it is there, and measure how sharp it is."""
    from PIL import Image

    if file.is_file():
        small = Image.open(file)
    else:
        picture = Image.fromarray(load_upright(source.file)).convert("RGB")
        factor = shrink_factor(source.size, size)
        goal = (max(1, int(picture.width * factor)), max(1, int(picture.height * factor)))
        part = (0.0, 0.0, min(goal[0] / factor, picture.width), min(goal[1] / factor, picture.height))
        # the same factor along both sides, so that pixels stay square: a lens with one focal length needs it
        small = picture if factor == 1.0 else picture.resize(goal, Image.Resampling.LANCZOS, part, reducing_gap=2.0)
        with atomic_path(file) as temporary:
            small.save(temporary, compress_level=1)
    return sharpness(shrunk_grey(np.asarray(small.convert("L")), COMPARED_SIZE))
