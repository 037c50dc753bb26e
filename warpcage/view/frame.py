"""Rendered frames, frames of several rays a pixel, and the color behind a picture."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, overload

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arrays import HostCopy, array_view, as_given, empty_array
from ..core.checks import checked_path, checked_whole, real_array, shown
from ..core.devices import launch
from ..core.files import atomic_path
from ..core.names import BACKGROUNDS, MAX_SUPERSAMPLING, TRANSPARENT
from ..core.threads import device_turn
from ..errors import InputError
from ..kernels.view import pictures
from .camera import Camera
from .exr import NOTHING, write_picture
from .pictures import COLORS, NOT_FINITE, picture_cuts, png_bytes, to_uint8, with_opacity

#: Parts of every frame.
PART_NAMES = ("rgb", "alpha", "depth")

#: Masks that a frame may carry. A frame of a plain field has none of them.
MASK_NAMES = ("reveal", "fold", "outside")

#: What `Frame.begin_copies` calls `Frame.rgb_bytes`.
RGB_BYTES = "rgb_bytes"

#: Masks that are made after rendering.
LATER_MASKS = ("filled",)

#: Optional outputs of frames; see the properties.
OUTPUT_NAMES = ("canonical", "flow", "instance")

#: Types of a pixel's value that are not float32.
_TYPES: dict[str, Any] = {"rgb": wp.vec3, "canonical": wp.vec3, "flow": wp.vec2, "instance": wp.int32}

#: How files end that a frame is written to.
PICTURE_ENDINGS = (".png", ".jpg", ".jpeg", ".exr", ".npz")


class Frame:
    """One rendered view.

    The arrays stay where they are until a property asks for NumPy; that copy is made once.

    Args:
        width: Width of the picture, pixels.
        height: Height of the picture, pixels.
        rgb: (h * w,) wp.vec3, or anything that reshapes to (h, w, 3), composited over the background.
        alpha: (h * w,) opacity in [0, 1].
        depth: (h * w,) expected distance along the ray, world units, inf where nothing is seen.
        masks: Masks of a deformed frame by name, (h * w,) each: reveal, fold, outside, filled; and the optional
            outputs canonical, flow and instance (see the properties).

    Raises:
        ValueError: For sizes that do not fit, or a mask that does not exist.

    Attributes:
        width: Width of the picture, pixels.
        height: Height of the picture, pixels.
        arrays: The arrays by name, as they were given: rgb, alpha, depth, and what else there is.
        camera: The camera that the frame was rendered from, None where that is not known.
        background: (3,) colour that the frame was composited over, None where that is not known or a model of a scene.
        transparent: Whether the frame was rendered with `background="transparent"`: files of it have opacity.
        layered: Whether the background is a model of a scene, which has places that no camera saw; else it is one
            colour, and hides nothing.
    """

    camera: Camera | None = None
    background: np.ndarray | None = None
    transparent = layered = False

    def __init__(self, width: int, height: int, rgb: Any, alpha: Any, depth: Any, **masks: Any):
        width, height = checked_whole(width, "width of a frame", 1), checked_whole(height, "height of a frame", 1)
        unknown = sorted(set(masks) - {*MASK_NAMES, *LATER_MASKS, *OUTPUT_NAMES})
        if unknown:
            raise InputError(f"a frame has no mask {unknown[0]!r}, it has {', '.join(MASK_NAMES)}")
        self.width, self.height = int(width), int(height)
        self.arrays: dict[str, Any] = {"rgb": rgb, "alpha": alpha, "depth": depth}
        self.arrays.update({name: mask for name, mask in masks.items() if mask is not None})
        for name, array in self.arrays.items():
            if not hasattr(array, "shape"):
                raise InputError(f"{name} of a frame must be an array, got {type(array).__name__}")
            shape = tuple(array.shape)
            if isinstance(array, wp.array) and array.dtype in (wp.vec2, wp.vec3):
                shape += (wp.types.type_size(array.dtype),)
            expected = math.prod((width, height, *_channels(name)))
            if math.prod(shape) != expected:
                raise InputError(f"{name} of a {width}x{height} frame holds {expected} numbers, got shape {shape}")
        self._host: dict[str, np.ndarray] = {}
        self._coming: dict[str, HostCopy] = {}

    def __reduce__(self):
        """Copies and pickles hold NumPy arrays, so that frames pass between the processes of a pool."""
        arrays = {name: getattr(self, name) for name in self.arrays}
        return _host_frame, (self.width, self.height, arrays, self._view())

    def __repr__(self) -> str:
        return f"Frame({self.width}x{self.height}: {', '.join(self.arrays)})"

    def _repr_png_(self) -> bytes:
        """The picture in notebooks."""
        return png_bytes(self.rgba if self.transparent else self.rgb_bytes)

    def _view(self) -> dict[str, Any]:
        """Camera and background, by the names of the attributes."""
        return {name: getattr(self, name) for name in ("camera", "background", "transparent", "layered")}

    def like(self, other: Frame) -> Frame:
        """Take camera and background of the frame that this one was made from.

        Args:
            other: The other frame.

        Returns:
            This frame.
        """
        vars(self).update(other._view())
        return self

    def seen_by(self, camera: Camera, color: np.ndarray | None, background: Any) -> Frame:
        """Set camera and background, as renderers do.

        Args:
            camera: The camera.
            color: (3,) behind the frame, None for a model of a scene.
            background: The option `background` of the renderer.

        Returns:
            This frame.
        """
        self.camera, self.background, self.layered = camera, color, color is None
        self.transparent = is_transparent(background)
        return self

    @property
    def rgb(self) -> np.ndarray:
        """(h, w, 3) float32 colour, composited over the background, as it is rendered.

        Harmonics of a field may leave [0, 1] a little; `rgb_bytes`, `rgba` and files of 8 bits clip.
        """
        return self._on_host("rgb")

    @property
    def rgb_bytes(self) -> np.ndarray:
        """(h, w, 3) uint8, `rgb` clipped to [0, 1] and rounded: less to copy from a device.

        Raises:
            ValueError: For values that are not finite.
        """
        if RGB_BYTES not in self._host:
            self.begin_copies(RGB_BYTES)
            coming = self._coming.get(RGB_BYTES)
            if coming is None:
                self._host[RGB_BYTES] = to_uint8(self.rgb)
            else:
                pixels, state = coming.wait()
                if state == pictures.NOT_FINITE:
                    raise InputError(NOT_FINITE)
                self._host[RGB_BYTES] = pixels.reshape(self.height, self.width, 3)
                self._coming.pop(RGB_BYTES, None)
        return self._host[RGB_BYTES]

    @property
    def rgba_premultiplied(self) -> np.ndarray:
        """(h, w, 4) float32, colour times opacity without the background, and opacity in [0, 1]; colour is not clipped.

        Raises:
            ValueError: Where the background is a model of a scene or not known, which cannot be taken away.
        """
        if self.background is None:
            behind = "a model of a scene" if self.layered else "not known"
            raise InputError(
                f"what is behind this frame is {behind}, and cannot be taken away: render with "
                f'background="{TRANSPARENT}"'
            )
        alpha = np.clip(self.alpha, 0.0, 1.0)[..., None]
        return np.concatenate([self.rgb - (1.0 - alpha) * self.background, alpha], axis=-1)

    @property
    def rgba(self) -> np.ndarray:
        """(h, w, 4) float32 in [0, 1], straight colour without the background (black for nothing seen) and opacity.

        Raises:
            ValueError: As `rgba_premultiplied`.
        """
        premultiplied = self.rgba_premultiplied
        return with_opacity(np.maximum(premultiplied[..., :3], 0.0), premultiplied[..., 3:])

    @property
    def alpha(self) -> np.ndarray:
        """(h, w) float32 opacity in [0, 1]."""
        return self._on_host("alpha")

    @property
    def mask(self) -> np.ndarray:
        """(h, w) bool, where opacity is one half or more."""
        return self.alpha >= 0.5

    @property
    def depth(self) -> np.ndarray:
        """(h, w) float32 expected distance along the ray in world units, inf where nothing is seen."""
        return self._on_host("depth")

    @property
    def z_depth(self) -> np.ndarray:
        """(h, w) float32 expected distance along the camera's axis in world units, inf where nothing is seen.

        Raises:
            ValueError: For a frame that no camera rendered: set `camera`.
        """
        if self.camera is None:
            raise InputError("a frame that no camera rendered has depth along the rays alone: set its camera")
        return _depth_along_axis(self, self.camera)

    @property
    def disparity(self) -> np.ndarray:
        """(h, w) float32 1 / depth, 0 where nothing is seen."""
        with np.errstate(divide="ignore"):
            return np.where(np.isfinite(self.depth), 1.0 / self.depth, 0.0).astype(np.float32)

    @property
    def reveal(self) -> np.ndarray | None:
        """(h, w) float32 in [0, 1], how much of the pixel was covered by matter that an edit cleared.

        The pixel now shows what lies behind. None for a plain field.
        """
        return self._mask("reveal")

    @property
    def missing(self) -> np.ndarray | None:
        """(h, w) float32 in [0, 1], how much of the pixel shows what an edit uncovered and no camera may have seen.

        It is `reveal` without what was filled in, and without a background of one colour, which hides nothing. None
        for a plain field.
        """
        if self.reveal is None:
            return None
        behind = self.reveal if self.layered else self.reveal * self.alpha
        return behind if self.filled is None else behind * (1.0 - self.filled)

    @property
    def filled(self) -> np.ndarray | None:
        """(h, w) float32 in [0, 1], how much of the pixel is filled in by `fill_unseen`. None without it."""
        return self._mask("filled")

    @property
    def fold(self) -> np.ndarray | None:
        """(h, w) float32 in [0, 1], opacity that comes from where the map folds over (det J <= 0).

        None for a plain field.
        """
        return self._mask("fold")

    @property
    def outside(self) -> np.ndarray | None:
        """(h, w) float32 number of samples along the ray that the map sends out of the canonical cage.

        They are left empty, and counted up to where the ray ends in something opaque. None for a plain field.
        """
        return self._mask("outside")

    @property
    def canonical(self) -> np.ndarray | None:
        """(h, w, 3) float32 position in the scene at rest of the surface point at `depth`, world units.

        It is `to_canonical` of the point at that distance on the ray through the pixel's centre; NaN where nothing is
        seen, or where nothing is at that distance, as between two surfaces. None where it was not requested.
        """
        return self._mask("canonical")

    @property
    def flow(self) -> np.ndarray | None:
        """(h, w, 2) float32 optical flow, columns and rows, to where another view shows the surface point at `depth`.

        Pixels, from the centre of each. NaN where nothing is seen, or where the point is cleared in the other pose or
        behind its camera. Occlusion in the other view is ignored. None where it was not requested.
        """
        return self._mask("flow")

    @property
    def instance(self) -> np.ndarray | None:
        """(h, w) int32 number of the edit whose posed cage holds the surface point at `depth`.

        Of several it is the last; -1 outside all cages, and where nothing is seen. None where it was not requested.
        """
        return self._mask("instance")

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the frame to a file, whole or not at all.

        Args:
            path: The file. Its ending says what is written: .png and .jpg the colours, clipped to [0, 1], with a
                warning where that is much; .exr light as compositing programs take it, with depth along the camera's
                axis as channel Z (see docs/films.md); .npz all arrays by name as float32, with z_depth and background
                where they are known. PNG and EXR have opacity where the frame was rendered with
                `background="transparent"`.

        Raises:
            ValueError: For another ending, opacity in a JPEG, colours that are not finite, or an EXR without its
                library.
        """
        path = checked_path(path, "the picture to write")
        ending = path.suffix.lower()
        if ending not in PICTURE_ENDINGS:
            raise InputError(
                f"a frame is written to a file that ends in {', '.join(PICTURE_ENDINGS)}, got {path.name!r}"
            )
        if ending != ".npz":
            depth = None if ending != ".exr" or self.camera is None else depth_along_view(self, self.camera)
            with picture_cuts(path) as cuts:
                if self.transparent:
                    cuts.clip(COLORS, self.rgb, 0.0, 1.0, 1.0 / 255.0)  # which `rgba` cuts
                write_picture(path, self.rgba if self.transparent else self.rgb, depth, cuts=cuts)
            return
        arrays = {name: getattr(self, name) for name in self.arrays}
        if self.camera is not None:
            arrays["z_depth"] = self.z_depth
        if self.background is not None:
            arrays["background"] = self.background
        with atomic_path(path) as temporary:
            np.savez(temporary, **arrays)

    def begin_copies(self, *names: str) -> None:
        """Start copies of arrays from a CUDA device to the host while the device goes on with other work.

        The properties then wait for what was launched before this call, not for what is launched afterwards; any
        thread may read them. Without this a property makes the copy itself, after all that was launched.

        Args:
            names: Of `arrays`, or "rgb_bytes".
        """
        for name in names:
            if not isinstance(name, str) or name not in (*self.arrays, RGB_BYTES):
                raise InputError(f"a frame has no array {shown(name)}, only {', '.join(self.arrays)}")
            array = self.arrays["rgb" if name == RGB_BYTES else name]
            if name in self._host or name in self._coming or not _comes_from_cuda(array):
                continue
            if name != RGB_BYTES:
                self._coming[name] = HostCopy(array)
            elif array.dtype == wp.vec3:
                self._coming[name] = _copy_bytes(array)

    def _mask(self, name: str) -> np.ndarray | None:
        return self._on_host(name) if name in self.arrays else None

    def _on_host(self, name: str) -> np.ndarray:
        if name not in self._host:
            array = self.arrays[name]
            coming = self._coming.get(name)
            if coming is not None:
                host = coming.wait()[0].view(np.float32)
            else:
                host = _host_array(array)
            self._host[name] = _shaped(host, name, self.height, self.width)
            self._coming.pop(name, None)
        return self._host[name]


def _stacked(name: str, text: str) -> Any:
    """A property of Frames: the arrays of all views on the host."""

    def on_host(frames: Frames) -> np.ndarray | None:
        return frames._on_host(name)

    return property(on_host, doc=text)


class Frames(Sequence[Frame]):
    """Views of one size that were rendered by one call; `frames[i]` is the Frame of view i.

    Their arrays lie in one allocation on the device, which the frames share. Properties copy one of them to the host,
    once, for all views together; what was not rendered is None.

    Example::

        frames = deformer.render(cameras, outputs=["canonical"])
        rgb = torch.from_dlpack(frames.arrays["rgb"])  # (n, h, w, 3), not copied
        frames[3].save("third.png")

    Args:
        frames: The frames of the views.
        arrays: What they share, by name: (n * h * w,) Warp arrays, or anything that reshapes to (n, h, w, ...).

    Attributes:
        arrays: The arrays by name, contiguous: rgb and canonical (n, h, w, 3), flow (n, h, w, 2), others (n, h, w);
            float32, instance int32.
    """

    def __init__(self, frames: Sequence[Frame], arrays: dict[str, Any]):
        self._frames, self.arrays = list(frames), dict(arrays)
        self._host: dict[str, np.ndarray] = {}
        shape = len(self._frames), self._frames[0].height, self._frames[0].width
        for name, array in arrays.items():
            if isinstance(array, wp.array) and array.ndim == 1:
                self.arrays[name] = array_view(array, _number_type(name), (*shape, *_channels(name)))

    def __len__(self) -> int:
        return len(self._frames)

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> list[Frame]: ...
    def __getitem__(self, index: int | slice) -> Frame | list[Frame]:
        return self._frames[index]

    def __iter__(self) -> Iterator[Frame]:
        return iter(self._frames)

    def __reduce__(self):
        """Copies and pickles hold NumPy arrays, as those of a Frame."""
        return Frames, (self._frames, {name: self._on_host(name) for name in self.arrays})

    def __repr__(self) -> str:
        first = self._frames[0]
        return f"Frames({len(self)} of {first.width}x{first.height}: {', '.join(self.arrays)})"

    def arrays_like(self, given: Any) -> dict[str, Any]:
        """The arrays as those of another library.

        Args:
            given: An array of that library on the same device, such as a torch tensor, or NumPy for copies on the host.

        Returns:
            The arrays by name, of the kind of `given`, not copied: what follows on the library's current stream waits
            for the frames, the host does not.
        """
        return {name: as_given(_warp_array(array), given) for name, array in self.arrays.items()}

    def _on_host(self, name: str) -> np.ndarray | None:
        if name in self.arrays and name not in self._host:
            self._host[name] = _shaped(_host_array(self.arrays[name]), name, *self.arrays[name].shape[:3])
        return self._host.get(name)

    rgb = _stacked("rgb", "(n, h, w, 3) float32, as `Frame.rgb`.")
    alpha = _stacked("alpha", "(n, h, w) float32, as `Frame.alpha`.")
    depth = _stacked("depth", "(n, h, w) float32, as `Frame.depth`.")
    reveal = _stacked("reveal", "(n, h, w) float32, as `Frame.reveal`.")
    fold = _stacked("fold", "(n, h, w) float32, as `Frame.fold`.")
    outside = _stacked("outside", "(n, h, w) float32, as `Frame.outside`.")
    canonical = _stacked("canonical", "(n, h, w, 3) float32, as `Frame.canonical`.")
    flow = _stacked("flow", "(n, h, w, 2) float32, as `Frame.flow`.")
    instance = _stacked("instance", "(n, h, w) int32, as `Frame.instance`.")


def part_type(name: str) -> Any:
    """The type of a pixel's value in an array of a frame, by its name."""
    return _TYPES.get(name, wp.float32)


def _number_type(name: str) -> Any:
    """The type of the numbers of a pixel's value."""
    return wp.int32 if part_type(name) == wp.int32 else wp.float32


def _channels(name: str) -> tuple[int, ...]:
    """The channels of a pixel's value as the last dimension of its array; () for a scalar."""
    count = wp.types.type_size(part_type(name))
    return (count,) if count > 1 else ()


def _warp_array(array: Any) -> wp.array:
    """An array of a frame as Warp's, not copied; those of copies of frames are NumPy."""
    return array if isinstance(array, wp.array) else wp.array(array, device="cpu", copy=False)


def _host_array(array: Any) -> np.ndarray:
    """An array of a frame as NumPy."""
    if not isinstance(array, wp.array) or array.device is None:
        return np.asarray(array)
    with device_turn(array.device):
        return array.numpy()


def _shaped(host: np.ndarray, name: str, *shape: int) -> np.ndarray:
    """Values of pixels as float32, numbers of edits as int32, in the shape of their pictures."""
    return np.ascontiguousarray(host, wp.dtype_to_numpy(_number_type(name))).reshape(*shape, *_channels(name))


def _comes_from_cuda(array: Any) -> bool:
    """Whether `begin_copies` can copy an array."""
    if not isinstance(array, wp.array) or array.device is None or not array.device.is_cuda:
        return False
    return array.is_contiguous and array.dtype in (wp.vec3, wp.float32)


def _copy_bytes(colors: wp.array) -> HostCopy:
    """A copy of (n,) vec3 as (n, 3) bytes."""
    assert colors.device is not None
    with device_turn(colors.device):
        packed = empty_array((colors.size, 3), wp.uint8, colors.device)
        state = wp.full(1, int(pictures.DONE), dtype=wp.int32, device=colors.device)
        launch(pictures.round_colors, colors.size, [colors, packed, state], device=colors.device)
        return HostCopy(packed, state)


def _host_frame(width: int, height: int, arrays: dict, view: dict) -> Frame:
    frame = Frame(width, height, **arrays)
    vars(frame).update(view)
    return frame


def _depth_along_axis(frame: Frame, camera: Camera) -> np.ndarray:
    x = (np.arange(frame.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(frame.height) + 0.5 - camera.cy) / camera.fy
    length = np.sqrt(1.0 + x[None, :] ** 2 + y[:, None] ** 2)  # of a ray that goes one unit along the axis
    return (frame.depth / length).astype(np.float32)


def depth_along_view(frame: Frame, camera: Camera) -> np.ndarray:
    """Depth (h, w) float32, world units, of a frame along the axis of its camera, as compositing programs compare it.
    NOTHING where nothing is seen."""
    return np.where(np.isfinite(frame.depth), _depth_along_axis(frame, camera), np.float32(NOTHING))


def checked_supersampling(side: Any) -> int:
    """The number of rays along each side of a pixel, 1 to MAX_SUPERSAMPLING."""
    return checked_whole(side, "supersampling", 1, MAX_SUPERSAMPLING)


def finer_camera(camera: Camera, side: int) -> Camera:
    """The same view with `side` times as many pixels along each side; the same camera for 1."""
    if side == 1:
        return camera
    names = ("fx", "fy", "cx", "cy", "width", "height")
    return dataclasses.replace(camera, **{name: side * getattr(camera, name) for name in names})


def average_frame(frame: Frame, side: int, into: dict[str, Any] | None = None) -> Frame:
    """A frame of Warp arrays averaged over squares of `side` pixels, which divides its width and height.
    into: arrays to fill, None makes new ones."""
    if side == 1:
        return frame
    width, height = frame.width // side, frame.height // side
    joined = {}
    for name, parts in frame.arrays.items():
        kernel = pictures.average_values
        inputs = [side, width, parts]
        if name == "rgb":
            kernel = pictures.average_colors
        elif name == "depth":
            kernel = pictures.average_depths
            inputs.append(frame.arrays["alpha"])
        joined[name] = empty_array(width * height, parts.dtype, parts.device) if into is None else into[name]
        launch(kernel, width * height, inputs, [joined[name]], device=parts.device)
    return Frame(width, height, **joined)


def is_transparent(background: Any) -> bool:
    """Whether a background is "transparent"."""
    return isinstance(background, str) and background == TRANSPARENT


def view_background(background: str | ArrayLike) -> np.ndarray:
    """The colour (3,) float32 that a view is composited over: black, which adds no light, for "transparent"."""
    return parse_background("black" if is_transparent(background) else background, (*BACKGROUNDS, TRANSPARENT))


def parse_background(background: str | ArrayLike, names: Iterable[str] = BACKGROUNDS) -> np.ndarray:
    """The colour (3,) float32 in [0, 1] of a background: the name of one (see BACKGROUNDS), or three numbers.
    names: those that the message lists."""
    if isinstance(background, str):
        if background == "random":
            raise InputError(
                "random backgrounds are drawn anew for every ray of a fit, where pictures have opacity: "
                "load with a colour and fit with background='random'"
            )
        if background not in BACKGROUNDS:
            raise InputError(f"background {shown(background)} is not known: {', '.join(names)} or 3 numbers in [0, 1]")
        background = BACKGROUNDS[background]
    color = real_array(background, "a background that is no colour name", np.float32)
    flags = any(isinstance(each, bool | np.bool_) for each in np.array(background, object).flat)
    if flags or color.shape != (3,) or not np.isfinite(color).all() or color.min() < 0 or color.max() > 1:
        raise InputError(f"background must be a colour name or three numbers in [0, 1], got {shown(background)}")
    return color
