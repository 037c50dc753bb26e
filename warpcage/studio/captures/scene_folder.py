"""The folder of a captured scene: pinhole pictures, transforms.json, points, report; where the object is."""

from __future__ import annotations

import json
import pathlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from ...core.reports import Progress
from ...core.threads import cpu_threads
from ...scene.box import FoundBox, find_box
from ...scene.parsing import DYNAMIC_MASK
from ...scene.pictures import distort, undistorted_intrinsics
from ...scene.save import transforms_frame
from ...scene.scene import rotation_to
from ...view.camera import Camera, common_up
from .colmap import Found, Lens
from .feature_masks import PictureMask, ignored_pixels, mask_opacity
from .sources import Source, StepBar, load_upright, shrink_factor


def common_size(sizes: Sequence[tuple[int, int]]) -> tuple[int, int]:
    """The width and height that most pictures have, the larger of several; a picture on its side counts as upright."""
    kinds = [tuple(sorted(size)) for size in sizes]
    kind = max(set(kinds), key=lambda each: (kinds.count(each), each))
    ways = [size for size in sizes if tuple(sorted(size)) == kind]
    return max(set(ways), key=lambda each: (ways.count(each), each))


class Pinhole:
    """Takes the pictures of one lens to those of a pinhole camera of a common size, pixels.
    Undistorts (bilinear), turns one on its side among others, cuts others to the shape around the middle, resizes."""

    def __init__(self, lens: Lens, size: tuple[int, int], *, clockwise: bool = False):
        self.lens, self.size, self.clockwise = lens, size, clockwise
        self._inner = undistorted_intrinsics(self.lens.intrinsics, self.lens.size, self.lens.distortion, "the lens")
        width, height = self.lens.size
        self.reshaped = (width, height) != size  # turned, cut or resized
        self.turned = width != height and (width > height) != (self.size[0] > self.size[1])  # by a quarter
        fx, fy, cx, cy = self._inner
        if self.turned:
            cx, cy = (height - cy, cx) if clockwise else (cy, width - cx)
            fx, fy, width, height = fy, fx, height, width
        scale = max(self.size[0] / width, self.size[1] / height)
        left, top = (width - self.size[0] / scale) / 2, (height - self.size[1] / scale) / 2
        self._part = (left, top, width - left, height - top)
        self.intrinsics = (fx * scale, fy * scale, (cx - left) * scale, (cy - top) * scale)  # pixels of the result
        self._table: tuple[np.ndarray, ...] | None = None

    def camera(self, pose: np.ndarray) -> Camera:
        """The pinhole camera of a picture, turned with it; pose: (4, 4) camera to world of the lens, OpenCV axes."""
        if self.turned:
            turn = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
            pose = pose @ (turn.T if self.clockwise else turn)
        return Camera(*self.intrinsics, *self.size, pose)

    def prepare(self) -> None:
        """Make the table of pixels, which every picture of the lens needs."""
        if any(self.lens.distortion) and self._table is None:
            self._table = self._resampling()

    def forget(self) -> None:
        """Free the table of pixels."""
        self._table = None

    def picture(self, picture: np.ndarray) -> np.ndarray:
        """A picture (h, w, 3 or 4) uint8, of the lens's size, as the pinhole camera sees it: uint8 of its `size`."""
        from PIL import Image

        if any(self.lens.distortion):
            picture = self._undistorted(picture)
        if self.turned:
            picture = np.rot90(picture, 3 if self.clockwise else 1)
        if picture.shape[1::-1] == self.size:
            return np.ascontiguousarray(picture)
        whole = Image.fromarray(np.ascontiguousarray(picture))
        return np.array(whole.resize(self.size, Image.Resampling.LANCZOS, box=self._part))

    def _undistorted(self, picture: np.ndarray) -> np.ndarray:
        self.prepare()
        assert self._table is not None
        corner, across, below = self._table
        right, down = 1, self.lens.size[0]
        flat = picture.reshape(-1, picture.shape[-1])
        if picture.shape[-1] == 4:  # colours count as much as they are seen
            flat = flat.astype(np.float32)
            flat[:, :3] *= flat[:, 3:] / 255.0
        upper = flat[corner] * (1 - across) + flat[corner + right] * across
        lower = flat[corner + down] * (1 - across) + flat[corner + down + right] * across
        mixed = upper * (1 - below) + lower * below
        if picture.shape[-1] == 4:
            mixed[:, :3] *= 255.0 / np.maximum(mixed[:, 3:], 1.0)
        return np.clip(np.rint(mixed), 0, 255).astype(np.uint8).reshape(picture.shape)

    def _resampling(self) -> tuple[np.ndarray, ...]:
        """For each pixel of the pinhole picture its upper left source, and how much those beside and below it count."""
        width, height = self.lens.size
        fx, fy, cx, cy = self._inner
        x, y = np.meshgrid((np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy)
        x, y = distort(x.ravel(), y.ravel(), self.lens.distortion)
        fx, fy, cx, cy = self.lens.intrinsics
        u = np.clip(fx * x + cx - 0.5, 0, width - 1)
        v = np.clip(fy * y + cy - 0.5, 0, height - 1)
        left, top = np.minimum(u.astype(np.int64), width - 2), np.minimum(v.astype(np.int64), height - 2)
        across, below = (part.astype(np.float32)[:, None] for part in (u - left, v - top))
        return top * width + left, across, below


def write_scene(
    folder: pathlib.Path,
    sources: Sequence[Source],
    sharpness: Sequence[float] | np.ndarray,
    found: Found,
    feature_size: int,  # longer side that pictures were shrunk to where they are longer, pixels
    *,
    masks: Sequence[PictureMask] | None = None,
    progress: bool | Progress = False,
) -> tuple[tuple[int, int], int]:
    """Write the pictures that have a camera, their masks and cameras and the points to an empty folder, in nerfstudio's
    conventions. Returns width and height of the pictures as they are written, and how many had another shape before."""
    chosen = [sources[picture] for picture in found.pictures]
    size = common_size([source.size for source in chosen])
    pinholes = _pinholes(chosen, found, size, feature_size)
    (folder / "images").mkdir()
    frames = []
    given = [PictureMask() if masks is None else masks[picture] for picture in found.pictures]
    if any(mask.opacity for mask in given):
        (folder / "masks").mkdir()
    for source, pinhole, pose, picture, mask in zip(chosen, pinholes, found.poses, found.pictures, given, strict=True):
        file = f"images/{source.name}{'.png' if source.lossless else '.jpg'}"
        frames.append(transforms_frame(file, pinhole.camera(pose), sharpness=round(float(sharpness[picture]), 4)))
        if mask.opacity is not None:
            frames[-1]["mask_path"] = f"masks/{source.name}.png"
    with StepBar(len(chosen), "undistort", progress) as shown, ThreadPoolExecutor(cpu_threads()) as pool:

        def write(index: int) -> None:
            source, pinhole, mask = chosen[index], pinholes[index], given[index]
            _write_picture(folder / frames[index]["file_path"], source, pinhole)
            if mask.opacity is not None:
                _write_mask(folder / frames[index]["mask_path"], mask_opacity(source, mask.opacity), pinhole)
            if mask.ignored is not None:
                name = f"images/{DYNAMIC_MASK}{source.name}.png"
                _write_mask(folder / name, ignored_pixels(source, mask.ignored), pinhole)

        for pinhole in dict.fromkeys(pinholes):  # by camera, whose table of pixels is large
            members = [index for index, other in enumerate(pinholes) if other is pinhole]
            pinhole.prepare()
            for _ in pool.map(write, members):
                shown.update()
            pinhole.forget()
    write_points(folder / "points.ply", found)
    content = {"camera_model": "PINHOLE", "ply_file_path": "points.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return size, sum(pinhole.reshaped for pinhole in pinholes)


def write_points(path: pathlib.Path, found: Found) -> None:
    """Write the points of a reconstruction with their colours, as a binary PLY file."""
    kinds = [(name, "<f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    rows = np.zeros(len(found.points), np.dtype(kinds))
    for axis, name in enumerate("xyz"):
        rows[name] = found.points[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        rows[name] = found.colors[:, channel]
    properties = "".join(f"property {'float' if kind == '<f4' else 'uchar'} {name}\n" for name, kind in kinds)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    path.write_bytes(header.encode() + rows.tobytes())


def _pinholes(sources: Sequence[Source], found: Found, size: tuple[int, int], feature_size: int) -> list[Pinhole]:
    """What each picture is resampled by; pictures of one camera share it."""
    made: dict[tuple, Pinhole] = {}
    result = []
    for source, lens, pose in zip(sources, found.lenses, found.poses, strict=True):
        clockwise = bool(pose[2, 0] < 0)  # so that up, +z, is up in the turned picture
        key = (id(lens), source.size, clockwise)
        if key not in made:
            factor = 1.0 / shrink_factor(source.size, feature_size)
            made[key] = Pinhole(lens.enlarged(factor, source.size), size, clockwise=clockwise)
        result.append(made[key])
    return result


def _write_picture(path: pathlib.Path, source: Source, pinhole: Pinhole) -> None:
    from PIL import Image

    picture = Image.fromarray(pinhole.picture(load_upright(source.file)))
    if path.suffix == ".jpg":
        picture.convert("RGB").save(path, quality=95, subsampling=0)
    else:
        picture.save(path, compress_level=4)


def _write_mask(path: pathlib.Path, mask: np.ndarray, pinhole: Pinhole) -> None:
    """Write a mask (h, w) in [0, 1] as its picture is."""
    from PIL import Image

    grey = np.repeat(np.rint(255.0 * mask).astype(np.uint8)[..., None], 3, axis=-1)
    Image.fromarray(pinhole.picture(grey)[..., 0]).save(path, compress_level=4)


def placed(found: Found) -> Found:
    """The cameras and points of a capture, from COLMAP's own frame and unit, in coordinates of its object."""
    # +z is up for the cameras (`common_up`), the first one at -y; the object's box is around 0, its longest side 2.
    upright = rotation_to(common_up(cameras_of(found)), np.array([0.0, 0.0, 1.0]))
    turned = found.moved(np.eye(3) if upright is None else upright[:3, :3], np.zeros(3), 1.0)
    center = object_box(turned).bounds.mean(axis=0)
    x, y = (turned.poses[0, :3, 3] - center)[:2]
    turn = -0.5 * np.pi - np.arctan2(y, x)
    about = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    turned = turned.moved(about, np.zeros(3), 1.0)
    box = object_box(turned).bounds
    return turned.moved(np.eye(3), box.mean(axis=0), 2.0 / float((box[1] - box[0]).max()))


def object_box(found: Found) -> FoundBox:
    """The box of the object, as `load_scene` finds it from a scene's points."""
    return find_box(cameras_of(found), found.points)


def cameras_of(found: Found) -> list[Camera]:
    """Pinhole cameras of the pictures, without what the lenses bend."""
    return [Camera(*lens.intrinsics, *lens.size, pose) for lens, pose in zip(found.lenses, found.poses, strict=True)]
