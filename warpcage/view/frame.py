"""Rendered frames, supersampling, backgrounds, and cameras as kernels take them."""

from __future__ import annotations

import numbers

import numpy as np
import warp as wp

from ..core.devices import launch
from ..kernels.view import downsample
from ..kernels.view.rays import TILE_HEIGHT, TILE_SIZE, TILE_WIDTH, PinholeCamera
from .camera import Camera


def camera_array(cameras, origin, device) -> wp.array:
    """Cameras as kernels take them, relative to `origin` (3,)."""
    return wp.array([camera_struct(camera, origin) for camera in cameras], dtype=PinholeCamera, device=device)


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
    """Threads that walk a camera's picture in whole tiles (kernels.view.rays.tile_pixel)."""
    return -(-camera.width // TILE_WIDTH) * -(-camera.height // TILE_HEIGHT) * TILE_SIZE


BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "grey": (0.5, 0.5, 0.5), "gray": (0.5, 0.5, 0.5)}


def parse_background(background) -> np.ndarray:
    """(3,) float32 of a colour name or three numbers in [0, 1]. Raises ValueError for anything else."""
    if isinstance(background, str):
        if background == "random":
            raise ValueError(
                "random backgrounds are drawn anew for every ray of a fit, where pictures have opacity: "
                "load with a colour and fit with background='random'"
            )
        if background not in BACKGROUNDS:
            raise ValueError(f"background {background!r} is not known: {', '.join(BACKGROUNDS)} or 3 numbers in [0, 1]")
        background = BACKGROUNDS[background]
    colour = np.asarray(background, dtype=np.float32)
    if colour.shape != (3,) or not np.isfinite(colour).all() or colour.min() < 0 or colour.max() > 1:
        raise ValueError(f"background must be a colour name or three numbers in [0, 1], got {background}")
    return colour


#: Rays a side of a pixel, at most: the picture is rendered that many times wider and higher.
MAX_SUPERSAMPLING = 8


def checked_supersampling(side) -> int:
    """Rays a side of a pixel. Raises ValueError where that is no whole number from 1 to MAX_SUPERSAMPLING."""
    if not isinstance(side, numbers.Integral) or isinstance(side, bool) or not 1 <= side <= MAX_SUPERSAMPLING:
        raise ValueError(f"supersampling must be 1 to {MAX_SUPERSAMPLING} rays a side of a pixel, got {side!r}")
    return int(side)


def finer_camera(camera: Camera, side: int) -> Camera:
    """The same view with side x side pixels for each."""
    return Camera(
        side * camera.fx,
        side * camera.fy,
        side * camera.cx,
        side * camera.cy,
        side * camera.width,
        side * camera.height,
        camera.camera_to_world,
    )


def average_frame(frame: Frame, side: int) -> Frame:
    """Each side x side pixels of a frame of Warp arrays joined into one."""
    width, height = frame.width // side, frame.height // side
    joined = {}
    for name, parts in frame.arrays.items():
        kernel = downsample.average_values
        inputs = [side, width, parts]
        if name == "rgb":
            kernel = downsample.average_colours
        elif name == "depth":
            kernel = downsample.average_depths
            inputs.append(frame.arrays["alpha"])
        joined[name] = wp.empty(width * height, dtype=parts.dtype, device=parts.device)
        launch(kernel, width * height, inputs, [joined[name]], device=parts.device)
    return Frame(width, height, **joined)
