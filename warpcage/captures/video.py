"""Sharp, well spread frames of a video."""

from __future__ import annotations

import dataclasses
import pathlib
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np

from ..core.names import agreed, counted
from .progress import bar
from .sharpness import COMPARED_SIZE, MOTION_SIZE, motion, sharpness, shrunk_grey

#: A frame is taken where the view has moved at least this far since the last one, as a share of the longer side: closer
#: ones show nothing new.
LEAST_STEP = 0.004


@dataclasses.dataclass(frozen=True)
class FrameScores:
    """What is known of the frames of a video, in their order."""

    times: np.ndarray  # (n,) int64 presentation times, which name the frames
    sharpness: np.ndarray  # (n,) see `sharpness`
    way: np.ndarray  # (n,) how far the view has moved until each frame, in longer sides of the picture
    size: tuple[int, int]  # width and height as it is looked at, pixels
    broken: int  # frames and packets that could not be decoded


def scan_video(path: pathlib.Path, *, progress: bool = False) -> FrameScores:
    """Decode a video once and measure each frame."""
    times, scores, steps, size, broken, before = [], [], [], None, [0], None
    with _opened(path) as container:
        total = container.streams.video[0].frames or None
        with bar(total, "frames", progress) as shown:
            for frame in _frames(container, broken):
                grey = _brightness(frame)
                small = shrunk_grey(grey, MOTION_SIZE)
                steps.append(0.0 if before is None or before.shape != small.shape else motion(before, small))
                scores.append(sharpness(shrunk_grey(grey, COMPARED_SIZE)))
                times.append(frame.pts)
                size = (frame.height, frame.width) if _quarters(frame) % 2 else (frame.width, frame.height)
                before = small
                shown.update()
    if size is None:
        raise ValueError(f"video {str(path)!r} has no frame that can be decoded: it may be cut off, or not a video")
    if broken[0]:
        warnings.warn(
            f"{counted(broken[0], 'frame')} of {str(path)!r} cannot be decoded and "
            f"{agreed(broken[0], 'is', 'are')} left out",
            stacklevel=3,
        )
    return FrameScores(np.array(times, np.int64), np.array(scores), np.cumsum(np.array(steps)), size, broken[0])


def pick_frames(scores: FrameScores, count: int) -> np.ndarray:
    """Indices (k,) int64, ascending, of at most `count` frames that are worth their while."""
    # The way of the view is cut into `count` equal parts, fewer where it is short, and of each the sharpest frame is
    # taken, so that frames stand as far apart where the camera is slow as where it is fast.
    length = float(scores.way[-1])
    parts = int(min(count, len(scores.times), max(1, length / LEAST_STEP)))
    part = np.minimum((scores.way / max(length, 1e-12) * parts).astype(np.int64), parts - 1)
    order = np.lexsort((np.arange(len(part)), -scores.sharpness, part))  # by part, then the sharpest first
    first = np.concatenate([[True], np.diff(part[order]) > 0])
    return np.sort(order[first])


def write_frames(path: pathlib.Path, times: np.ndarray, files: list[pathlib.Path], *, progress: bool = False) -> None:
    """Write the frames of a video at ascending presentation times (k,) to k files (.png, .jpg), upright, but those that
    are there."""
    from PIL import Image

    from ..core.files import atomic_path

    wanted = dict(zip(times.tolist(), files, strict=True))
    missing = {time: file for time, file in wanted.items() if not file.is_file()}
    with bar(len(files), "pictures", progress, done=len(files) - len(missing)) as shown:
        if not missing:
            return
        with _opened(path) as container:
            for frame in _frames(container, [0]):
                file = missing.pop(frame.pts, None)
                if file is not None:
                    picture = np.rot90(frame.to_ndarray(format="rgb24"), _quarters(frame))
                    with atomic_path(file) as temporary:
                        Image.fromarray(np.ascontiguousarray(picture)).save(temporary, quality=97, subsampling=0)
                    shown.update()
                if not missing:
                    return
    raise ValueError(
        f"video {str(path)!r}: {counted(len(missing), 'frame')} {agreed(len(missing), 'is', 'are')} not "
        "found again: it changed while it was read"
    )


def _opened(path: pathlib.Path) -> Any:
    """The container of a video file."""
    import av
    from av.error import FFmpegError

    try:
        # by name, some names are taken for addresses
        container = av.open(f"file:{path.absolute()}", metadata_errors="ignore")
    except (FFmpegError, OSError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise ValueError(f"{str(path)!r} cannot be read as a video: {reason}") from error
    if not container.streams.video:
        container.close()
        raise ValueError(f"{str(path)!r} holds no video stream")
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


def _brightness(frame: Any) -> np.ndarray:
    """(h, w) uint8, the frame in grey as it is stored."""
    return frame.to_ndarray(format="gray")


def _quarters(frame: Any) -> int:
    """Quarter turns against the clock that bring a frame upright."""
    return round(frame.rotation / 90) % 4
