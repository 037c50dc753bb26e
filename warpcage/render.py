"""Rendered frames, and cameras as kernels take them."""

from __future__ import annotations

import numpy as np
import warp as wp

from .camera import Camera
from .kernels.rays import TILE_HEIGHT, TILE_SIZE, TILE_WIDTH, PinholeCamera

#: Masks a frame may carry; a frame of a plain field has none of them.
MASK_NAMES = ("reveal", "fold", "outside")


class Frame:
    """One rendered view.

    width, height: pixels. rgb: (h * w,) wp.vec3 or anything that reshapes to (h, w, 3), composited over the background.
    alpha: (h * w,) opacity in [0, 1]. depth: (h * w,) expected distance along the ray in world units, inf where nothing
    is seen. Masks of deformed frames by name, (h * w,) each: reveal, fold, outside (see the properties).

    The arrays stay where they are (`.arrays`) until a property asks for NumPy; that copy is made once.
    Raises ValueError for sizes that do not fit or a mask that does not exist.
    """

    def __init__(self, width: int, height: int, rgb, alpha, depth, **masks):
        if width < 1 or height < 1:
            raise ValueError(f"a frame needs at least 1x1 pixel, got {width}x{height}")
        unknown = sorted(set(masks) - set(MASK_NAMES))
        if unknown:
            raise ValueError(f"a frame has no mask {unknown[0]!r}, it has {', '.join(MASK_NAMES)}")
        self.width, self.height = int(width), int(height)
        self.arrays = {"rgb": rgb, "alpha": alpha, "depth": depth}
        self.arrays.update({name: mask for name, mask in masks.items() if mask is not None})
        for name, array in self.arrays.items():
            shape = tuple(array.shape)
            if isinstance(array, wp.array) and array.dtype == wp.vec3:
                shape += (3,)
            expected = width * height * (3 if name == "rgb" else 1)
            if int(np.prod(shape)) != expected:
                raise ValueError(f"{name} of a {width}x{height} frame holds {expected} numbers, got shape {shape}")
        self._host: dict[str, np.ndarray] = {}

    def __reduce__(self):
        """Copies and pickles hold NumPy arrays, so that frames pass between the processes of a pool."""
        return _host_frame, (self.width, self.height, {name: getattr(self, name) for name in self.arrays})

    def __repr__(self) -> str:
        return f"Frame({self.width}x{self.height}: {', '.join(self.arrays)})"

    def _numpy(self, name: str, *channels: int) -> np.ndarray | None:
        if name not in self.arrays:
            return None
        if name not in self._host:
            array = self.arrays[name]
            host = array.numpy() if isinstance(array, wp.array) else np.asarray(array)
            self._host[name] = np.ascontiguousarray(host, np.float32).reshape(self.height, self.width, *channels)
        return self._host[name]

    @property
    def rgb(self) -> np.ndarray:
        """(h, w, 3) float32 colour, composited over the background."""
        return self._numpy("rgb", 3)

    @property
    def alpha(self) -> np.ndarray:
        """(h, w) float32 opacity in [0, 1]."""
        return self._numpy("alpha")

    @property
    def depth(self) -> np.ndarray:
        """(h, w) float32 expected distance along the ray in world units, inf where nothing is seen."""
        return self._numpy("depth")

    @property
    def disparity(self) -> np.ndarray:
        """(h, w) float32 1 / depth, 0 where nothing is seen."""
        with np.errstate(divide="ignore"):
            return np.where(np.isfinite(self.depth), 1.0 / self.depth, 0.0).astype(np.float32)

    @property
    def reveal(self) -> np.ndarray | None:
        """(h, w) float32 in [0, 1]: how much of the pixel matter covered that an edit cleared, so that it now shows
        what lies behind; None for a plain field."""
        return self._numpy("reveal")

    @property
    def fold(self) -> np.ndarray | None:
        """(h, w) float32 in [0, 1]: opacity that comes from where the map folds over (det J <= 0); None for a plain
        field."""
        return self._numpy("fold")

    @property
    def outside(self) -> np.ndarray | None:
        """(h, w) float32 number of samples along the ray, before anything opaque, that the map sends out of the
        canonical cage and that are therefore left empty; None for a plain field."""
        return self._numpy("outside")


def _host_frame(width: int, height: int, arrays: dict) -> Frame:
    return Frame(width, height, **arrays)


def camera_struct(camera: Camera, origin) -> PinholeCamera:
    """`camera` for kernels, its centre relative to `origin` (3,).

    The difference is taken in float64, so that float32 kernels see small numbers however far the scene lies from zero.
    """
    struct = PinholeCamera()
    struct.centre = wp.vec3(*(camera.centre - np.asarray(origin, np.float64)))
    struct.rotation = wp.mat33(*np.asarray(camera.rotation, np.float64).ravel())
    struct.focal = wp.vec2(camera.fx, camera.fy)
    struct.principal_point = wp.vec2(camera.cx, camera.cy)
    struct.width = camera.width
    struct.height = camera.height
    return struct


def tile_threads(camera: Camera) -> int:
    """Threads that walk a camera's picture in whole tiles (kernels.rays.tile_pixel)."""
    return -(-camera.width // TILE_WIDTH) * -(-camera.height // TILE_HEIGHT) * TILE_SIZE
