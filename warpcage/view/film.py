"""Films: how cages and cameras go from keyframe to keyframe, and video files."""

from __future__ import annotations

import dataclasses

import imageio.v3 as iio
import numpy as np

from ..core.files import atomic_path
from .camera import Camera
from .pictures import _as_rgb, _path_with_ending, to_uint8


def write_video(path, frames, fps: float = 24.0) -> None:
    """Write frames (h, w, 3) as an H.264 .mp4 that browsers play (yuv420p); whole or not at all.

    frames: any iterable of images of one size, values in [0, 1] or uint8; taken one by one, so a generator that
    renders will do. Odd sizes lose their last row or column. Raises ValueError for no frames, sizes that differ, or
    another ending.
    """
    path = _path_with_ending(path, ".mp4")
    _check_rate(fps)
    with atomic_path(path) as temporary:
        with iio.imopen(temporary, "w", plugin="pyav", extension=".mp4") as video:
            started = False
            for frame in _even_frames(frames):
                if not started:
                    video.init_video_stream("libx264", fps=round(fps), pixel_format="yuv420p")
                    started = True
                video.write_frame(frame)


def write_gif(path, frames, fps: float = 15.0, *, colours: int = 128, loop: bool = True) -> None:
    """Write frames (h, w, 3) as an animated .gif with one palette, kept small; whole or not at all.

    frames: as for `write_video`; colours: palette size, 2 to 256. Raises ValueError as `write_video` does.
    """
    from PIL import Image

    path = _path_with_ending(path, ".gif")
    _check_rate(fps)
    if not 2 <= colours <= 256:
        raise ValueError(f"a GIF palette holds 2 to 256 colours, got {colours}")
    frames = list(_same_size(frames))
    # one palette for all frames, from a thinned strip of them, so that still regions stay still
    strip = np.concatenate(frames[:: max(1, len(frames) // 12)])
    palette = Image.fromarray(strip).quantize(colours - 1, method=Image.Quantize.MEDIANCUT)
    # median cut mixes the background with what is like it: it gets an entry of its own
    entries, background = palette.getpalette()[: 3 * (colours - 1)], _most_frequent_colour(strip)
    flat = []
    for frame in frames:
        indices = np.array(Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE))
        indices[(frame == background).all(axis=-1)] = len(entries) // 3
        flat.append(Image.fromarray(indices))
        flat[-1].putpalette([*entries, *background.tolist()])
    with atomic_path(path) as temporary:
        options = {"loop": 0} if loop else {}
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
    """(3,) uint8 of (..., 3) pixels: the background, as a rule."""
    codes = pixels.reshape(-1, 3).astype(np.int64) @ (65536, 256, 1)
    values, counts = np.unique(codes, return_counts=True)
    code = int(values[counts.argmax()])
    return np.array([code >> 16, code >> 8 & 255, code & 255], np.uint8)


def _same_size(frames):
    first = None
    for index, frame in enumerate(frames):
        frame = to_uint8(_as_rgb(frame))
        first = frame.shape if first is None else first
        if frame.shape != first:
            raise ValueError(f"frames must have one size: frame 0 is {first[:2]}, frame {index} is {frame.shape[:2]}")
        yield frame
    if first is None:
        raise ValueError("a film needs at least one frame")


def _even_frames(frames):
    for frame in _same_size(frames):
        height, width = (side // 2 * 2 for side in frame.shape[:2])
        if height == 0 or width == 0:
            raise ValueError(f"a video needs frames of at least 2x2 pixels, got {frame.shape[:2]}")
        yield np.ascontiguousarray(frame[:height, :width])


def _check_rate(fps: float) -> None:
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"fps must be positive, got {fps}")


MOTIONS = ("swing", "once", "hold")
INTERPOLATIONS = ("smooth", "linear")


def pose_weights(count: int, motion: str = "swing") -> np.ndarray:
    """(count,) weights of a pose in [0, 1], gentle at both ends.

    motion: "swing" from rest to the pose and back, so that the film loops without a repeated frame; "once" from rest to
    the pose; "hold" the pose throughout. Raises ValueError for no frames or another motion.
    """
    return frame_places(count, 2, motion)


def frame_places(count: int, keyframe_count: int, motion: str = "swing", interpolation: str = "smooth") -> np.ndarray:
    """(count,) places of a film's frames among keyframes, 0 the first and keyframe_count - 1 the last.

    motion: "swing" there and back, "once" there, "hold" at the last throughout. interpolation: "linear" goes at one
    speed, "smooth" sets out and arrives gently. Raises ValueError for no frames or keyframes, or another name.
    """
    if count < 1 or keyframe_count < 1:
        raise ValueError(f"a film needs at least one frame and one keyframe, got {count} and {keyframe_count}")
    if motion not in MOTIONS:
        raise ValueError(f"motion {motion!r} is not known: {', '.join(MOTIONS)}")
    _check_interpolation(interpolation)
    if motion == "hold":
        return np.full(count, keyframe_count - 1.0)
    phase = np.arange(count) / count if motion == "swing" else 0.5 * np.arange(count) / max(1, count - 1)
    # phase 0 is the first keyframe, 1/2 the last
    weights = 0.5 - 0.5 * np.cos(2 * np.pi * phase) if interpolation == "smooth" else 1.0 - np.abs(1.0 - 2.0 * phase)
    return weights * (keyframe_count - 1)


def keyframe_weights(place: float, keyframe_count: int, interpolation: str = "smooth") -> np.ndarray:
    """(keyframe_count,) weights, of sum 1, by which keyframes make up the state at a place among them.

    "linear" joins keyframes by straight lines, "smooth" by cubics whose speed does not jump at keyframes (Catmull and
    Rom 1974; straight at both ends). Raises ValueError for a place beyond the keyframes.
    """
    _check_interpolation(interpolation)
    if not 0 <= place <= keyframe_count - 1:
        raise ValueError(f"a place among {keyframe_count} keyframes must be 0 to {keyframe_count - 1}, got {place}")
    weights = np.zeros(keyframe_count)
    if keyframe_count == 1:
        return np.ones(1)
    begin = min(int(place), keyframe_count - 2)
    f = place - begin
    weights[begin], weights[begin + 1] = 1 - f, f
    if interpolation == "smooth" and keyframe_count > 2:
        # Hermite form; what is added to the straight line, for tangents m_i = (p_(i+1) - p_(i-1)) / 2
        value_begin, value_end = 2 * f**3 - 3 * f**2 + 1, 3 * f**2 - 2 * f**3
        weights[begin], weights[begin + 1] = value_begin, value_end
        for index, share in ((begin, f**3 - 2 * f**2 + f), (begin + 1, f**3 - f**2)):
            after, before = min(index + 1, keyframe_count - 1), max(index - 1, 0)
            weights[after] += share / (after - before)
            weights[before] -= share / (after - before)
    return weights


def pose_between(rest, posed, weight: float):
    """The cage whose vertices lie on the straight way from `rest` (weight 0) to `posed` (weight 1), world units."""
    return rest.with_vertices((1.0 - weight) * rest.vertices + weight * posed.vertices)


def pose_along(keyframes, place: float, interpolation: str = "smooth"):
    """The cage at a place among keyframes, a list of Cage with the same faces; see `keyframe_weights`."""
    weights = keyframe_weights(place, len(keyframes), interpolation)
    vertices = sum(weight * cage.vertices for weight, cage in zip(weights, keyframes, strict=True))
    return keyframes[0].with_vertices(vertices)


def cameras_along(cameras: list[Camera], count: int, interpolation: str = "smooth") -> list[Camera]:
    """`count` cameras on the way through a list of cameras, the first and the last included.

    Centres go as keyframes do, rotations by the shortest turn from one to the next.
    Raises ValueError for no cameras, or pictures of several sizes.
    """
    if not cameras:
        raise ValueError("a camera path needs at least one camera")
    sizes = {(camera.width, camera.height) for camera in cameras}
    if len(sizes) > 1:
        raise ValueError(f"cameras of a path must have one picture size, got {sorted(sizes)}")
    return [_camera_at(cameras, place, interpolation) for place in np.linspace(0, len(cameras) - 1, count)]


def _camera_at(cameras, place: float, interpolation: str) -> Camera:
    weights = keyframe_weights(place, len(cameras), interpolation)
    begin = min(int(place), max(0, len(cameras) - 2))
    end = min(begin + 1, len(cameras) - 1)
    pose = np.eye(4)
    pose[:3, 3] = sum(weight * camera.centre for weight, camera in zip(weights, cameras, strict=True))
    pose[:3, :3] = _rotation_between(cameras[begin].rotation, cameras[end].rotation, place - begin)
    names = ("fx", "fy", "cx", "cy")
    lens = {name: float(sum(w * getattr(c, name) for w, c in zip(weights, cameras, strict=True))) for name in names}
    return dataclasses.replace(cameras[begin], camera_to_world=pose, **lens)


def _rotation_between(first, second, share: float) -> np.ndarray:
    """Rotation (3, 3) at a share of the shortest turn from `first` to `second`."""
    turn = first.T @ second
    cosine = np.clip(0.5 * (np.trace(turn) - 1), -1.0, 1.0)
    angle = np.arccos(cosine)
    if angle < 1e-9:
        return np.array(first)
    symmetric = 0.5 * (turn + turn.T)
    if angle > np.pi - 1e-4:  # half a turn: the axis is the eigenvector of the symmetric part
        axis = np.linalg.eigh(symmetric)[1][:, -1]
    else:
        axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        axis /= np.linalg.norm(axis)
    return first @ axis_rotation(axis, share * angle)


def axis_rotation(axis, angle: float) -> np.ndarray:
    """Rotation (3, 3) by an angle in radians about a unit axis (Rodrigues' formula)."""
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def _check_interpolation(interpolation: str) -> None:
    if interpolation not in INTERPOLATIONS:
        raise ValueError(f"interpolation {interpolation!r} is not known: {', '.join(INTERPOLATIONS)}")
