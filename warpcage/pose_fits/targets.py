"""What a pose is fitted to: pictures, masks and depth with their cameras, and points in space and in pictures."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.checks import real_array
from ..errors import InputError
from ..field.render import RenderOptions
from ..field.voxel_field import VoxelField
from ..gradients.frame import frame_gradient, voxel_gradient
from ..scene.scene import Scene
from ..view.camera import Camera
from ..view.frame import parse_background, part_type

#: Weights of squares of opacities, and of depths as shares of the cage's size, beside those of colours.
ALPHA, DEPTH = 0.5, 20.0

#: Pixels that differ by more from the background show the object, where pictures have no opacity.
SHOWN = 0.06

#: Differences of colours and opacities, and of depths as shares of the cage's size, above which they count linearly.
ROBUST, ROBUST_DEPTH = 0.15, 0.03


@dataclasses.dataclass(frozen=True, eq=False)
class PoseTargets:
    """What is known of an object in another pose.

    Args:
        cameras: n cameras of the pictures, in the field's world.
        images: (n, h, w, 3) in [0, 1], before `background`; (n, h, w, 4) with opacity, whose colours are their own
            (straight alpha). None: there are none.
        alphas: (n, h, w) opacities or masks in [0, 1]. None: those of images with four channels, or none.
        depths: (n, h, w) distances from the cameras' centres along the rays, world units, as those of a Frame; not
            finite or 0 where they are not known. None: there are none.
        weights: (n, h, w) how much each pixel counts, 0 for what is to be ignored. None counts all.
        background: Colour behind the object in pictures without opacity, a name or (3,). The field is drawn before it.
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
    background: Any = "white"
    points: ArrayLike | None = None
    positions: ArrayLike | None = None
    pixels: ArrayLike | None = None

    def __post_init__(self) -> None:
        count, color = len(self.cameras), parse_background(self.background)
        parts: dict[str, Any] = {"background": color, "cameras": list(self.cameras)}
        shape = None if self.images is None else np.shape(self.images)
        if shape is not None:
            if len(shape) != 4 or shape[-1] not in (3, 4):
                raise InputError(f"images of a pose must be (n, h, w, 3) or (n, h, w, 4), got {shape}")
            images = np.asarray(self.images)
            if images.dtype.kind in "iu":
                raise InputError(f"images of a pose must be in [0, 1], got {images.dtype}: divide 8-bit ones by 255")
            if shape[-1] == 4:
                if self.alphas is None:
                    parts["alphas"] = images[..., 3]
                images = images[..., :3] * images[..., 3:] + (1 - images[..., 3:]) * color
            parts["images"] = images.astype(np.float32)
        for name in ("alphas", "depths", "weights"):
            values = parts.get(name, getattr(self, name))
            if values is not None:
                values = parts[name] = np.asarray(values, np.float32)
                shape = shape or values.shape
                if values.shape != shape[:3]:
                    raise InputError(f"{name} of a pose must be {shape[:3]}, got {values.shape}")
        if shape is not None and shape[0] != count:
            raise InputError(f"a pose needs one camera per picture: {shape[0]} pictures, {count} cameras")
        for index, camera in enumerate(self.cameras if shape is not None else ()):
            if shape and (camera.height, camera.width) != shape[1:3]:
                raise InputError(
                    f"camera {index} is of {camera.width}x{camera.height} pixels, its picture of {shape[2]}x{shape[1]}"
                )
        for name in ("images", "alphas", "weights"):
            if name in parts and not (
                np.isfinite(parts[name]).all() and parts[name].min() >= -1 and parts[name].max() <= 2
            ):
                raise InputError(f"{name} of a pose must be finite, in [0, 1]")
        parts |= self._checked_points(count)
        if shape is None and "points" not in parts:
            raise InputError("a pose needs pictures, masks, depth or points to be fitted to")
        if shape is not None and not {"images", "alphas", "depths"} & set(parts):
            raise InputError("weights alone say nothing of a pose: give pictures, masks or depth")
        for name, value in parts.items():
            object.__setattr__(self, name, value)

    def _checked_points(self, count: int) -> dict[str, np.ndarray]:
        """Points, positions and pixels as float64."""
        if self.points is None:
            if self.positions is not None or self.pixels is not None:
                raise InputError("positions and pixels of a pose need points, the same places at rest")
            return {}
        found = {"points": real_array(self.points, "points of a pose")}
        number = len(found["points"])
        shapes = {"points": (number, 3), "positions": (number, 3), "pixels": (count, number, 2)}
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
            if targets.has_sizes:
                raise InputError("pictures of a pose must be of one size: load the scene with another downscale")
            scene = {"images": targets.images, "alphas": targets.alphas, "weights": targets.weights}
            return cls(targets.cameras, **scene, background=targets.background)
        if cameras is None:
            raise InputError("arrays of pictures need cameras, one each")
        return cls([cameras] if isinstance(cameras, Camera) else cameras, images=targets)

    @property
    def has_pictures(self) -> bool:
        """Whether there is anything to compare frames with."""
        return any(part is not None for part in (self.images, self.alphas, self.depths))

    @property
    def pixel_size(self) -> int:
        """Pixels along the longer side of the pictures."""
        return max(self.cameras[0].width, self.cameras[0].height) if self.has_pictures else 0


def _averaged(pictures: np.ndarray, height: int, width: int) -> np.ndarray:
    """Pictures (n, h, w, ...) of another size, each pixel the mean of what it covers."""
    for axis, size in ((1, height), (2, width)):
        shares = _shares(pictures.shape[axis], size)
        pictures = np.moveaxis(np.tensordot(shares, pictures, (1, axis)), 0, axis)
    return pictures.astype(np.float32)


def _shares(before: int, after: int) -> np.ndarray:
    """(after, before) share of each pixel of a line in each pixel of a shorter one."""
    edges = np.arange(after + 1) * before / after
    low, high = edges[:-1, None], edges[1:, None]
    pixels = np.arange(before)[None, :]
    return np.clip(np.minimum(high, pixels + 1) - np.maximum(low, pixels), 0, None) * after / before


class PictureLoss:
    """Frames of a posed Deformer beside pictures of one size: a loss, about the mean square of the object's pixels."""

    def __init__(self, targets: PoseTargets, size: int, blur: float, unit: float):
        first = targets.cameras[0]
        share = min(size / targets.pixel_size, 1.0)
        width, height = (max(round(share * side), 1) for side in (first.width, first.height))
        self.cameras = [camera.resized(width, height) for camera in targets.cameras]
        self.background, self.size, self._blur, self._unit = targets.background, max(width, height), blur, unit
        count = np.ones((len(self.cameras), height, width), np.float32)

        def smaller(values: Any) -> Any:
            return None if values is None else _averaged(values, height, width)

        self.images, self.alphas = smaller(targets.images), smaller(targets.alphas)
        self.weights = count if targets.weights is None else smaller(targets.weights)
        self.depths = None
        if targets.depths is not None:  # a pixel has one where all that it covers has
            known = np.isfinite(targets.depths) & (targets.depths > 0)
            mean = _averaged(np.where(known, targets.depths, 0), height, width)
            self.depths = np.where(_averaged(known.astype(np.float32), height, width) > 0.999, mean, np.nan)
        self._covered: float | None = None

    def frames(self, deformer: Any) -> dict[str, np.ndarray]:
        """What is compared of the last pose's frames: "rgb" (n, h, w, 3), "alpha" and "depth" (n, h, w)."""
        wanted = {
            "rgb": self.images is not None,
            "alpha": self._covered is None or self.alphas is not None or self.depths is not None,
            "depth": self.depths is not None,
        }
        frames = deformer.render(self.cameras, background=self.background)
        return {name: np.stack([getattr(frame, name) for frame in frames]) for name in wanted if wanted[name]}

    def __call__(self, deformer: Any, *, with_gradient: bool = True) -> tuple[float, Any]:
        """The loss of the last pose of a Deformer, and its gradient (v, 3) by the posed cage's vertices, or 0."""
        frames = self.frames(deformer)
        covered = self._covered_pixels(frames)
        parts = self._parts(frames)
        loss = sum(value for value, _ in parts.values()) / covered
        if not with_gradient:
            return loss, 0.0
        slopes = {name: slope / covered for name, (_, slope) in parts.items()}
        if isinstance(deformer.field, VoxelField):
            given = {
                name: wp.array(slope.reshape(-1, *slope.shape[3:]), dtype=part_type(name), device=deformer.device)
                for name, slope in slopes.items()
            }
            options = RenderOptions(background=self.background)
            with deformer.lock:
                found = [voxel_gradient(deformer, self.cameras, given, options, by_vertices=True)]
        else:
            found = [
                frame_gradient(
                    deformer,
                    camera,
                    slopes["rgb"][view] if "rgb" in slopes else None,
                    **{f"{name}_gradient": slope[view] for name, slope in slopes.items() if name != "rgb"},
                    background=self.background,
                    by_vertices=True,
                )
                for view, camera in enumerate(self.cameras)
            ]
        by_vertices = [each.vertices.numpy() for each in found if each.vertices is not None]
        return loss, np.sum(by_vertices, axis=0, dtype=np.float64)

    def _covered_pixels(self, frames: dict[str, np.ndarray]) -> float:
        """How many pixels the object covers, of the first frames where pictures have no opacity."""
        if self._covered is None:
            self._covered = max(float(np.sum(frames["alpha"] if self.alphas is None else self.alphas)), 1.0)
        return self._covered

    def _compared(self, frames: dict[str, np.ndarray]) -> dict[str, tuple[np.ndarray, float, np.ndarray]]:
        """Differences of frames from the pictures by their parts, where they begin to count linearly, and weights."""
        parts, weights = {}, self.weights
        if self.images is not None:
            parts["rgb"] = self._smooth(frames["rgb"] - self.images), ROBUST, weights[..., None] / 3
        if self.alphas is not None:
            parts["alpha"] = self._smooth(frames["alpha"] - self.alphas), ROBUST, ALPHA * weights
        elif self.depths is not None:  # what has a depth is covered: a pose may not leave it out
            parts["alpha"] = self._smooth(frames["alpha"] - 1), ROBUST, ALPHA * weights * np.isfinite(self.depths)
        if self.depths is not None:
            known = np.isfinite(self.depths) & np.isfinite(frames["depth"])
            off = np.where(known, frames["depth"], 0) - np.where(known, self.depths, 0)
            parts["depth"] = off / self._unit, ROBUST_DEPTH, DEPTH * weights * known
        return parts

    def _parts(self, frames: dict[str, np.ndarray]) -> dict[str, tuple[float, np.ndarray]]:
        """Sums over all pixels, and their derivatives by the parts of the frames."""
        parts = {name: robust(*compared) for name, compared in self._compared(frames).items()}
        return {
            name: (value, slope / self._unit if name == "depth" else self._smooth(slope))
            for name, (value, slope) in parts.items()
        }

    def differences(self, deformer: Any) -> np.ndarray:
        """(m,) all differences of the last pose by the roots of their weights: the sum of squares is about the loss."""
        frames = self.frames(deformer)
        covered = self._covered_pixels(frames)
        parts = self._compared(frames).values()
        return np.concatenate([(np.sqrt(weights / covered) * off).ravel() for off, _, weights in parts])

    def shift(self, deformer: Any, center: np.ndarray) -> np.ndarray:
        """(3,) by which the last pose must move, so that silhouettes lie where the pictures have them."""
        # Middles of silhouettes; the least squares of what the cameras see of a shift at the distance of the center.
        rows, right = [1e-3 * np.eye(3)], [np.zeros(3)]
        shown, shown_now = self._shown(), self._shown(self.frames(deformer))
        for view, camera in enumerate(self.cameras):
            wanted, seen = (self._middle(pixels[view], view) for pixels in (shown, shown_now))
            if wanted is not None and seen is not None:
                depth = max(float((center - camera.center) @ camera.rotation[:, 2]), 1e-6 * self._unit)
                rows.append(camera.rotation[:, :2].T)
                right.append((wanted - seen) * depth / [camera.fx, camera.fy])
        return np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]

    def _shown(self, frames: dict[str, np.ndarray] | None = None) -> np.ndarray:
        """(n, h, w) how much of each pixel the object covers, in the pictures or in frames of it."""
        if self.alphas is not None:
            return self.alphas if frames is None else frames["alpha"]
        if self.images is not None:
            images = self.images if frames is None else frames["rgb"]
            return np.abs(images - self.background).max(axis=-1) > SHOWN
        assert self.depths is not None
        return np.isfinite(self.depths if frames is None else frames["depth"])

    def _middle(self, shown: np.ndarray, view: int) -> np.ndarray | None:
        """(2,) the middle of what a picture shows, pixels; None where it shows nothing."""
        weights = shown * self.weights[view]
        total = float(weights.sum())
        places = np.moveaxis(np.indices(shown.shape), 0, -1)[..., ::-1] + 0.5
        return np.einsum("hw,hwi->i", weights, places) / total if total > 0.5 else None

    def _smooth(self, values: np.ndarray) -> np.ndarray:
        """Blurred pictures (n, h, w, ...): its own adjoint, as what is around them counts as zero."""
        if not self._blur:
            return values
        from scipy.ndimage import gaussian_filter

        return gaussian_filter(values, (0, self._blur, self._blur, *[0] * (values.ndim - 3)), mode="constant")


def robust(difference: np.ndarray, scale: float, weights: np.ndarray) -> tuple[float, np.ndarray]:
    """Sum of squares that grow linearly above a scale (pseudo-Huber), and its derivatives."""
    root = np.sqrt(1 + (difference / scale) ** 2)
    return float((2 * scale**2 * weights * (root - 1)).sum(dtype=np.float64)), 2 * weights * difference / root
