"""Pictures of lenses made into pictures of pinhole cameras, all of one size."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..scene.pictures import distort, undistorted_intrinsics
from ..view.camera import Camera
from .found import Lens


def common_size(sizes: Sequence[tuple[int, int]]) -> tuple[int, int]:
    """The width and height that most pictures have, the larger of several; a picture on its side counts as upright."""
    kinds = [tuple(sorted(size)) for size in sizes]
    kind = max(set(kinds), key=lambda each: (kinds.count(each), each))
    ways = [size for size in sizes if tuple(sorted(size)) == kind]
    return max(set(ways), key=lambda each: (ways.count(each), each))


class Pinhole:
    """Takes the pictures of one lens to those of a pinhole camera of a common size, pixels."""

    # The distortion is undone by bilinear resampling; a picture that lies on its side beside the others is turned by a
    # quarter; what is larger or of another shape is cut to the shape around its middle and resized.

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
