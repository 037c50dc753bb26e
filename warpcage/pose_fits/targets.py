"""What a pose is fitted to: pictures, masks and depth with their cameras, and points in space and in pictures."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arrays import array_view, empty_array
from ..core.checks import real_array, require_type
from ..core.devices import SpareMemory, launch
from ..errors import InputError
from ..field.render import RenderOptions, picture_arrays
from ..gradients.frame import voxel_gradient
from ..gradients.loss import column_sums, run_sums
from ..gradients.splats import SplatViews
from ..kernels.gradients.differences import Comparison, blur_lines, share_depth_slopes, weigh_differences
from ..scene.scene import ALPHA_ROOM, IMAGE_ROOM, Scene
from ..splats.splat_field import SplatField
from ..view.camera import Camera
from ..view.frame import PART_NAMES, parse_background, part_type
from .photographs import Surroundings, fit_exposures, hull_pixels, pixels_of

#: Pixels that differ by more from the background show the object, where pictures have no opacity.
SHOWN = 0.06

#: Pictures whose colours are all below are black.
BLACK = 1.0 / 255.0

#: Differences of depths that count most, as shares of the cage's size: with pictures that are not blurred, as much more
#: for each pixel of blur, and at most: with 0.12 an object that leaves the picture counts less than one that is beside.
DEPTH_SCALE, MAX_DEPTH_SCALE = 0.03, 0.075

#: Bytes of a pixel of frames with their masks, of their differences and slopes.
FRAME_BYTES = 128


@dataclasses.dataclass(frozen=True, eq=False)
class PoseTargets:
    """What is known of an object in another pose.

    Args:
        cameras: n cameras of the pictures, in the field's world.
        images: (n, h, w, 3) in [0, 1], before `background`; (n, h, w, 4) with opacity, whose colours are their own
            (straight alpha). None: there are none.
        alphas: (n, h, w) opacities or masks in [0, 1]. None: those of images with four channels, or none. Images that
            show something else than the background where most of these are 0 are photographs, and are cut out.
        depths: (n, h, w) distances from the cameras' centres along the rays to the surface, world units; not finite or
            0 where they are not known. None: there are none. Those of frames lie behind the surface; a fit allows for
            that.
        weights: (n, h, w) in [0, 1], how much each pixel counts, 0 for what is to be ignored. None counts all.
        background: Colour behind the object, a name or (3,). The field is drawn before it. None is white for pictures
            with opacity, and else what is around the field: its surroundings where it has them, or its own colour.
        points: (p, 3) places of the object at rest, world units. None: there are none.
        positions: (p, 3) where these are now, world units; rows of NaN where that is not known.
        pixels: (n, p, 2) where the cameras see them, pixels from the upper left corner of the picture (the first
            pixel's middle is (0.5, 0.5)); NaN where they do not.

    Raises:
        ValueError: Where the parts do not fit together, hold values out of range, or say nothing.
    """

    cameras: Sequence[Camera] = ()
    images: Any = None
    alphas: Any = None
    depths: Any = None
    weights: Any = None
    background: Any = None
    points: ArrayLike | None = None
    positions: ArrayLike | None = None
    pixels: ArrayLike | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.cameras, Sequence | Camera):
            raise InputError(f"cameras of a pose must be a list, got {type(self.cameras).__name__}")
        cameras = [self.cameras] if isinstance(self.cameras, Camera) else list(self.cameras)
        for camera in cameras:
            require_type(camera, Camera, "cameras of a pose must each be")
        images = None if self.images is None else real_array(self.images, "images of a pose", np.float32)
        count, shape = len(cameras), None if images is None else images.shape
        is_whole = shape is not None and self.alphas is None and shape[-1:] == (3,)
        color = None
        if self.background is not None or not is_whole:
            color = parse_background("white" if self.background is None else self.background)
        parts: dict[str, Any] = {"background": color, "cameras": cameras}
        if images is not None and shape is not None:
            if len(shape) != 4 or shape[-1] not in (3, 4):
                raise InputError(f"images of a pose must be (n, h, w, 3) or (n, h, w, 4), got {shape}")
            kind = np.asarray(self.images).dtype
            if kind.kind in "iu":
                raise InputError(f"images of a pose must be in [0, 1], got {kind}: divide 8-bit ones by 255")
            if shape[-1] == 4:
                if self.alphas is None:
                    parts["alphas"] = images[..., 3]
                images = images[..., :3] * images[..., 3:] + (1 - images[..., 3:]) * color
            parts["images"] = images
        for name in ("alphas", "depths", "weights"):
            values = parts.get(name, getattr(self, name))
            if values is not None:
                values = parts[name] = real_array(values, f"{name} of a pose", np.float32)
                shape = shape or values.shape
                if values.shape != shape[:3]:
                    raise InputError(f"{name} of a pose must be {shape[:3]}, got {values.shape}")
        if shape is not None and shape[0] != count:
            raise InputError(f"a pose needs one camera per picture: {shape[0]} pictures, {count} cameras")
        for index, camera in enumerate(cameras if shape is not None else ()):
            if shape and (camera.height, camera.width) != shape[1:3]:
                raise InputError(
                    f"camera {index} is of {camera.width}x{camera.height} pixels, its picture of {shape[2]}x{shape[1]}"
                )
        if shape is not None and 0 in shape:
            raise InputError(f"pictures of a pose hold no pixels: they are {shape}")
        for name, room in (("images", IMAGE_ROOM), ("alphas", ALPHA_ROOM), ("weights", ALPHA_ROOM)):
            low, high = (parts[name].min(), parts[name].max()) if name in parts else (0, 1)
            if not (-room <= low and high <= 1 + room):  # false for NaN too
                hint = ": divide 8-bit ones by 255" if high > 2 else ""
                raise InputError(f"{name} of a pose must be finite, in [0, 1], got {low:g} to {high:g}{hint}")
        if "depths" in parts:
            known = parts["depths"][np.isfinite(parts["depths"]) & (parts["depths"] != 0)]
            if known.size and known.min() < 0:
                raise InputError(f"depths of a pose must be distances, 0 or NaN where not known, got {known.min():g}")
            if not known.size:
                parts["depths"] = None
        if color is not None and "alphas" in parts and "images" in parts:
            shares = parts["alphas"][..., None]
            if _shows_more(parts["images"], parts["alphas"], color):
                parts["images"] = shares * parts["images"] + (1 - shares) * color
        parts |= self._checked_points(count)
        if shape is None and "points" not in parts:
            raise InputError("a pose needs pictures, masks, depth or points to be fitted to")
        if shape is not None and all(parts.get(name) is None for name in ("images", "alphas", "depths")):
            what = "depths that are known nowhere" if "depths" in parts else "weights alone"
            raise InputError(f"{what} say nothing of a pose: give pictures, masks or depth")
        if "weights" in parts and parts["weights"].max() <= 0:
            raise InputError("weights of a pose are 0 in all pixels: nothing is left to compare")
        for name, value in parts.items():
            object.__setattr__(self, name, value)

    def _checked_points(self, count: int) -> dict[str, np.ndarray]:
        """Points, positions and pixels as float64."""
        if self.points is None:
            if self.positions is not None or self.pixels is not None:
                raise InputError("positions and pixels of a pose need points, the same places at rest")
            return {}
        found = {"points": real_array(self.points, "points of a pose")}
        if found["points"].ndim != 2:
            raise InputError(f"points of a pose must be (p, 3), got {found['points'].shape}")
        number = len(found["points"])
        shapes = {"points": (number, 3), "positions": (number, 3), "pixels": (count, number, 2)}
        if self.pixels is not None and not count:
            raise InputError("pixels of a pose need cameras, one for each (p, 2) of them")
        for name in ("positions", "pixels"):
            if getattr(self, name) is not None:
                found[name] = real_array(getattr(self, name), f"{name} of a pose")
        for name, values in found.items():
            if values.shape != shapes[name]:
                raise InputError(f"{name} of a pose must be {shapes[name]}, got {values.shape}")
        if not np.isfinite(found["points"]).all():
            raise InputError("points of a pose must be finite: they are places of the object at rest")
        if len(found) == 1:
            raise InputError("points of a pose need positions, or pixels of cameras")
        if not any(np.isfinite(values).all(axis=-1).any() for name, values in found.items() if name != "points"):
            raise InputError("positions and pixels of a pose are known for none of its points: all hold NaN")
        return found

    @classmethod
    def of(cls, targets: Any, cameras: Any = None) -> PoseTargets:
        """What `fit_pose` makes of its targets.

        Args:
            targets: A PoseTargets, a Scene, or pictures (n, h, w, 3) or (n, h, w, 4).
            cameras: For pictures, a Camera each.

        Returns:
            The targets.

        Raises:
            ValueError: For cameras beside a Scene or a PoseTargets, and as the constructor.
        """
        if isinstance(targets, cls | Scene) and cameras is not None:
            raise InputError(f"cameras are for arrays of pictures, {type(targets).__name__} has its own")
        if isinstance(targets, cls):
            return targets
        if isinstance(targets, Scene):
            scene = {"images": targets.images, "alphas": targets.alphas, "weights": targets.weights}
            height, width = targets.images.shape[1:3]  # smaller pictures lie at the upper left, without weight beside
            cameras = [dataclasses.replace(camera, width=width, height=height) for camera in targets.cameras]
            return cls(cameras, **scene, background=None if targets.alphas is None else targets.background)
        if cameras is None:
            raise InputError(
                "a pose is fitted to a Scene (load_scene reads one), to PoseTargets, or to arrays of pictures, which "
                f"need cameras, one each: got {type(targets).__name__} without"
            )
        return cls(cameras, images=targets)

    @property
    def has_pictures(self) -> bool:
        """Whether there is anything to compare frames with."""
        return any(part is not None for part in (self.images, self.alphas, self.depths))

    @property
    def is_whole(self) -> bool:
        """Whether pictures show more than the object, and no opacity says what is it."""
        return self.images is not None and self.alphas is None

    @property
    def pixel_size(self) -> int:
        """Pixels along the longer side of the pictures."""
        return max(self.cameras[0].width, self.cameras[0].height) if self.has_pictures else 0


def _shows_more(images: np.ndarray, alphas: np.ndarray, color: np.ndarray) -> bool:
    """Whether most of what lies outside of masks has another colour than the background."""
    outside = images[alphas < 0.02]
    return len(outside) > 0.05 * alphas.size and float(np.median(np.abs(outside - color).max(axis=-1))) > SHOWN


def _averaged(pictures: np.ndarray, height: int, width: int) -> np.ndarray:
    """Pictures (n, h, w, ...) of another size, each pixel the mean of what it covers."""
    for axis, size in ((1, height), (2, width)):
        if pictures.shape[axis] == size:
            continue
        shares = _shares(pictures.shape[axis], size)
        pictures = np.moveaxis(np.tensordot(shares, pictures, (1, axis)), 0, axis)
    return pictures


def _shares(before: int, after: int) -> np.ndarray:
    """(after, before) share of each pixel of a line in each pixel of a shorter one."""
    edges = np.arange(after + 1) * before / after
    low, high = edges[:-1, None], edges[1:, None]
    pixels = np.arange(before)[None, :]
    shares = np.clip(np.minimum(high, pixels + 1) - np.maximum(low, pixels), 0, None) * after / before
    return shares.astype(np.float32)  # products of float32 take half the time


class PictureLoss:
    """Frames of a posed Deformer beside pictures of one size: a loss, about the mean square of the object's pixels.
    Frames, differences and slopes by them stay on the device."""

    def __init__(
        self,
        targets: PoseTargets,
        size: int,
        blur: float,
        unit: float,
        device: wp.Device,
        behind: float = 0.0,  # of `depth_behind`
        *,
        field: Any = None,  # what targets without a background are around
        hull: np.ndarray | None = None,  # (v, 3) vertices of a cage that holds the object, about where it is
        exposure: bool = False,
    ):
        first = targets.cameras[0]
        share = min(size / targets.pixel_size, 1.0)
        width, height = self._sides = tuple(max(round(share * side), 1) for side in (first.width, first.height))
        self.cameras = [camera.resized(width, height) for camera in targets.cameras]
        self.size, self._unit = max(width, height), unit
        self._device, self._spare, self._count = device, SpareMemory(device), len(self.cameras) * height * width
        self.background, self._around = targets.background, None
        self._is_splats = isinstance(field, SplatField)
        self._drawn: SplatViews | None = None
        if self.background is None and field is not None:
            self.background = field.background
            if field.background_model is not None:
                self._around = Surroundings(field.background_model, field.bounds, self.cameras, device)
                self.background = np.zeros(3, np.float32)

        def smaller(values: Any) -> Any:
            return None if values is None else _averaged(values, height, width)

        self.images, self.alphas = smaller(targets.images), smaller(targets.alphas)
        ones = np.ones((len(self.cameras), height, width), np.float32)
        self.weights = ones if targets.weights is None else smaller(targets.weights)
        self.depths = None
        if targets.depths is not None:  # a pixel has one where all that it covers has
            known = np.isfinite(targets.depths) & (targets.depths > 0)
            mean = smaller(np.where(known, targets.depths, 0))
            self.depths = np.where(smaller(known.astype(np.float32)) > 0.999, mean, np.float32(np.nan))
        if exposure and self.images is not None and self.alphas is not None:  # what is cut out has one, white has none
            self.images = self.images - (1 - self.alphas[..., None]) * self.background
            self.background = np.zeros(3, np.float32)
        self._exposure, self._empty = exposure and self.images is not None, self.background
        if self._exposure:
            self._require_light()
        self._most = np.inf if hull is None else hull_pixels(self.cameras, hull)
        # what has a depth is covered: a pose may not leave it out
        alphas = ones if self.alphas is None and self.depths is not None else self.alphas
        parts = {"rgb": self.images, "alpha": alphas, "depth": self.depths}
        self._pictures = {name: self._uploaded(values, name) for name, values in parts.items() if values is not None}
        self._names, self._weights = list(self._pictures), self._uploaded(self.weights, "alpha")
        self._behind = behind
        self._begin(blur)

    def _begin(self, blur: float) -> None:
        """Blur differences from now on, pixels; the next frames say how many pixels the object covers."""
        self.blur, self._comparison = blur, Comparison()
        self._comparison.unit, self._comparison.behind = self._unit, self._behind
        self._comparison.depth_scale = min(DEPTH_SCALE * (1 + blur), MAX_DEPTH_SCALE)
        self._comparison.known_alone = int(self.alphas is None)
        self._comparison.view_pixels = self._sides[0] * self._sides[1]
        if self._exposure:
            ones = np.ones((len(self.cameras), 3), np.float32)
            self._comparison.exposures = wp.array(ones, dtype=wp.vec3, device=self._device)
        self._taps = wp.array(gaussian_taps(blur), dtype=wp.float32, device=self._device) if blur else None
        self._blurred_pictures = self._blurred(self._pictures)

    def _require_light(self) -> None:
        """Refuse pictures from which no exposure follows: one of 0 makes any frame like them."""
        counted = self.weights > 0 if self.alphas is None else (self.weights > 0) & (self.alphas > 0.5)
        brightest = np.where(counted, self.images.max(axis=-1), -np.inf).max(axis=(1, 2))
        for number in np.flatnonzero((brightest < BLACK) & counted.any(axis=(1, 2))):
            raise InputError(
                f"picture {number} is black, and says nothing where exposures are found: leave it "
                "out, or give its pixels weights of 0"
            )

    def blurred(self, blur: float) -> PictureLoss:
        """The same pictures with another blur of differences, pixels."""
        other = copy.copy(self)
        other._begin(blur)
        return other

    def _uploaded(self, values: np.ndarray, name: str) -> wp.array:
        """Pictures (n, h, w, ...) as (n * h * w,) on the device."""
        rows = np.ascontiguousarray(values, np.float32).reshape(self._count, *values.shape[3:])
        return wp.array(rows, dtype=part_type(name), device=self._device)

    def frames(self, deformer: Any) -> dict[str, wp.array]:
        """The parts of the last pose's frames, (n * h * w,) each."""
        self._spare.keep(FRAME_BYTES * self._count)  # the host waits once an evaluation
        if self._is_splats and not deformer.edits[0].remove:
            with deformer.lock:  # once, for the gradient as well
                self._drawn = SplatViews(deformer, self.cameras, self.background, with_depth=self.depths is not None)
            return self._drawn.frames
        arrays = deformer.render(self.cameras, background=self.background, supersampling=1).arrays
        found = {name: array_view(arrays[name], part_type(name), self._count) for name in PART_NAMES}
        if self._around is not None and self.images is not None:
            found["rgb"] = self._around.composed(pixels_of(found))
        return found

    def set_empty(self, deformer: Any) -> None:
        """Take what a Deformer shows without the object, by which `shift` knows it in whole pictures."""
        self._empty = self.frames(deformer)["rgb"].numpy().reshape(self.images.shape)

    def __call__(self, deformer: Any, *, with_gradient: bool = True) -> tuple[float, Any]:
        """The loss of the last pose of a Deformer, and its gradient (v, 3) by the posed cage's vertices, or 0."""
        losses, slopes = self.compared(self.frames(deformer), with_slopes=with_gradient)
        by_vertices = self._by_vertices(deformer, slopes) if with_gradient else None
        loss = float(losses.numpy().sum(dtype=np.float64))  # waits for the device, which has all its work by now
        return loss, 0.0 if by_vertices is None else by_vertices.numpy().astype(np.float64)

    def compared(
        self, frames: dict[str, wp.array], *, with_slopes: bool = True
    ) -> tuple[wp.array, dict[str, wp.array]]:
        """Numbers (m, 1) whose sum is the loss of frames, and slopes (n * h * w,) by their parts that count."""
        slopes = self._parts(self._names if with_slopes else ())
        losses = run_sums(self._weighed(frames, slopes, {}))
        slopes |= self._blurred(slopes)
        if "depth" in slopes:
            inputs = [pixels_of(frames), pixels_of(self._pictures), self._comparison]
            launch(share_depth_slopes, self._count, inputs, [pixels_of(slopes)], device=self._device)
        if self._around is not None and "rgb" in slopes:
            if "alpha" not in slopes:
                slopes["alpha"] = wp.zeros(self._count, dtype=wp.float32, device=self._device)
            self._around.pull(pixels_of(slopes))
        return losses, slopes

    def _by_vertices(self, deformer: Any, slopes: dict[str, wp.array]) -> wp.array | None:
        """Slopes (v,) by the posed cage's vertices, from those by the frames."""
        with deformer.lock:
            if self._drawn is not None:
                return self._drawn.gradient(slopes, by_vertices=True).vertices
            options = RenderOptions(background=self.background, supersampling=1)
            return voxel_gradient(deformer, self.cameras, slopes, options, by_vertices=True).vertices

    def _parts(self, names: Sequence[str]) -> dict[str, wp.array]:
        """New arrays (n * h * w,) by names of parts."""
        return picture_arrays(self._count, names, self._device)

    def _weighed(
        self, frames: dict[str, wp.array], slopes: dict[str, wp.array], roots: dict[str, wp.array]
    ) -> wp.array:
        """(n * h * w, 1) what each pixel adds to the loss. Sets what is given: slopes by blurred differences, and these
        times the roots of their weights."""
        if not self._comparison.scale:
            self._comparison.scale = 1.0 / self._covered(frames)
        blurred = self._blurred(frames)
        if self._exposure:
            width, height = self._sides
            exposures = self._comparison.exposures
            fit_exposures(blurred["rgb"], self._blurred_pictures["rgb"], width, height, self._weights, exposures)
        losses = empty_array((self._count, 1), wp.float32, self._device)
        compared = [pixels_of(parts) for parts in (frames, self._pictures, blurred, self._blurred_pictures)]
        inputs = [*compared, self._weights, self._comparison]
        outputs = [pixels_of(slopes), pixels_of(roots), losses.flatten()]
        launch(weigh_differences, self._count, inputs, outputs, device=self._device)
        return losses

    def _blurred(self, values: dict[str, wp.array]) -> dict[str, wp.array]:
        """Those colours and opacities of values that are compared, blurred."""
        names = [name for name in self._names if name != "depth" and name in values]
        values, taps, (width, height) = {name: values[name] for name in names}, self._taps, self._sides
        if taps is None or not names:
            return values
        for stride, side in ((1, width), (width, height)):
            found = self._parts(names)
            inputs = [pixels_of(values), stride, side, taps]
            launch(blur_lines, self._count, inputs, [pixels_of(found)], device=self._device, work=8 * taps.size)
            values = found
        return values

    def _covered(self, frames: dict[str, wp.array]) -> float:
        """How many pixels the object covers, of the first frames where pictures have no opacity."""
        if self.alphas is not None:
            return max(float(np.sum(self.alphas)), 1.0)
        covered = float(column_sums(frames["alpha"].reshape((self._count, 1)))[0])
        return max(min(covered, self._most), 1.0)  # a field may hold more than the object

    def differences(self, deformer: Any) -> np.ndarray:
        """(m,) all differences of the last pose by the roots of their weights: the sum of squares is about the loss."""
        roots = self._parts(self._names)
        self._weighed(self.frames(deformer), {}, roots)
        return np.concatenate([part.numpy().ravel() for part in roots.values()]).astype(np.float64)

    def depth_off(self, deformer: Any) -> float:
        """By how much depths of the last pose differ in the median, as a share of the size; 0 where there are none."""
        if self.depths is None:
            return 0.0
        frames = self.frames(deformer)
        alpha, depth = (frames[name].numpy().reshape(self.depths.shape) for name in ("alpha", "depth"))
        compared = np.isfinite(self.depths) & np.isfinite(depth) & (alpha > 0.5) & (self.weights > 0)
        off = np.abs(depth - self._behind - self.depths)[compared]
        return float(np.median(off)) / self._unit if off.size else 0.0

    def shift(self, deformer: Any, center: np.ndarray) -> np.ndarray:
        """(3,) by which the last pose must move, so that silhouettes lie where the pictures have them."""
        # Middles of silhouettes; the least squares of what the cameras see of a shift at the distance of the center.
        rows, right = [1e-3 * np.eye(3)], [np.zeros(3)]
        off = self._middles(self._shown()) - self._middles(self._shown(self.frames(deformer)))
        for camera, pixels in zip(self.cameras, off, strict=True):
            if np.isfinite(pixels).all():
                depth = max(float((center - camera.center) @ camera.rotation[:, 2]), 1e-6 * self._unit)
                rows.append(camera.rotation[:, :2].T)
                right.append(pixels * depth / [camera.fx, camera.fy])
        return np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]

    def _shown(self, frames: dict[str, wp.array] | None = None) -> np.ndarray:
        """(n, h, w) how much of each pixel the object covers, in the pictures or in frames of it."""

        def seen(name: str, pictures: np.ndarray) -> np.ndarray:
            return pictures if frames is None else frames[name].numpy().reshape(pictures.shape)

        if self.alphas is not None:
            return seen("alpha", self.alphas)
        if self.images is not None:
            images = self.images
            if self._exposure and frames is None:
                images = images / self._comparison.exposures.numpy()[:, None, None, :]
            return np.abs(seen("rgb", images) - self._empty).max(axis=-1) > SHOWN
        assert self.depths is not None
        return np.isfinite(seen("depth", self.depths))

    def _middles(self, shown: np.ndarray) -> np.ndarray:
        """(n, 2) the middle of what each picture shows, pixels; NaN where it shows nothing."""
        weights = shown * self.weights
        total = weights.sum(axis=(1, 2))
        total = np.where(total > 0.5, total, np.nan)
        return np.stack(
            [weights.sum(axis=across) @ (np.arange(shown.shape[3 - across]) + 0.5) / total for across in (1, 2)], axis=1
        )


def gaussian_taps(blur: float) -> np.ndarray:
    """(r + 1,) weights of a Gaussian of a standard deviation in pixels, from its middle on, up to four of them."""
    places = np.arange(int(4 * blur + 0.5) + 1)
    taps = np.exp(-0.5 * (places / blur) ** 2)
    return taps / (2 * taps.sum() - taps[0])
