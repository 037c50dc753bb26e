"""Posed images of one scene."""

from __future__ import annotations

import dataclasses
import pathlib

import numpy as np

from .camera import Camera

BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "grey": (0.5, 0.5, 0.5), "gray": (0.5, 0.5, 0.5)}

#: Renders of a field may leave [0, 1] by this much; what is further out comes in other units.
IMAGE_ROOM = 1.0


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """Images with their cameras.

    images: (n, h, w, 3) float32 in [0, 1], composited on the background.
    alphas: (n, h, w) float32 in [0, 1], or None where the images carry no opacity.
    cameras: n cameras of that image size, in the scene's own world units.
    background: (3,) float32, the colour behind everything.
    names: n image names, for reports.
    bounds: (2, 3) float64, a box that holds the object where the data say so (bbox, points, unit sphere), or None.
    surroundings: (n, h, w, 3) float32 or None, what lies around the object in pictures that masks split: their colour
    times 1 - alpha.
    captured: whether the opacity comes from mask files: such pictures were taken, not rendered, and `fit` smooths more.
    to_source: (4, 4) float64, takes the scene's coordinates to those that its data were made from (DTU's millimetres,
    a reconstruction before nerfstudio's applied_transform), or None where they are the same or not known.

    Raises ValueError where the parts do not fit together, or images or alphas hold values that are not finite or far
    from [0, 1].
    """

    images: np.ndarray
    alphas: np.ndarray | None
    cameras: list[Camera]
    background: np.ndarray = dataclasses.field(default_factory=lambda: np.ones(3, np.float32))
    names: list[str] = dataclasses.field(default_factory=list)
    bounds: np.ndarray | None = None
    to_source: np.ndarray | None = None
    surroundings: np.ndarray | None = None
    captured: bool = False

    def __post_init__(self):
        if len(self.images) == 0:
            raise ValueError("a scene needs at least one image")
        sizes = [np.shape(image)[:2] for image in self.images]
        if len(set(sizes)) > 1:
            other = next(i for i, size in enumerate(sizes) if size != sizes[0])
            raise ValueError(f"scene images must be of one size: image 0 is {sizes[0]}, image {other} {sizes[other]}")
        images = np.asarray(self.images, dtype=np.float32)
        if images.ndim != 4 or images.shape[-1] != 3:
            raise ValueError(f"scene images must be (n, h, w, 3), got {images.shape}")
        count, height, width = images.shape[:3]
        if len(self.cameras) != count:
            raise ValueError(f"a scene needs one camera an image: {count} images, {len(self.cameras)} cameras")
        names = list(self.names) or [f"{i:04d}" for i in range(count)]
        if len(names) != count:
            raise ValueError(f"a scene needs one name an image: {count} images, {len(names)} names")
        for name, image, camera in zip(names, images, self.cameras, strict=True):
            if not np.isfinite(image).all():
                raise ValueError(f"image {name} holds values that are not finite")
            if image.min() < -IMAGE_ROOM or image.max() > 1 + IMAGE_ROOM:
                raise ValueError(f"image {name} holds values from {image.min():g} to {image.max():g}: they must lie in "
                                 "[0, 1] (8-bit pictures divided by 255)")
            if (camera.height, camera.width) != (height, width):
                raise ValueError(f"camera of image {name} is {camera.width}x{camera.height}, "
                                 f"images are {width}x{height}")
        alphas = self.alphas
        if alphas is not None:
            alphas = np.asarray(alphas, dtype=np.float32)
            if alphas.shape != images.shape[:3]:
                raise ValueError(f"scene alphas must be {images.shape[:3]}, got {alphas.shape}")
            for name, alpha in zip(names, alphas, strict=True):
                if not (alpha.min() >= -1e-3 and alpha.max() <= 1 + 1e-3):  # false for NaN too
                    raise ValueError(f"alpha of image {name} holds values from {alpha.min():g} to {alpha.max():g}: "
                                     "they must lie in [0, 1]")
        surroundings = self.surroundings
        if surroundings is not None:
            surroundings = np.asarray(surroundings, dtype=np.float32)
            if alphas is None or surroundings.shape != images.shape:
                raise ValueError(f"scene surroundings must be {images.shape} beside alphas, got {surroundings.shape}")
        for name, shape in (("bounds", (2, 3)), ("to_source", (4, 4))):
            given = getattr(self, name)
            if given is not None:
                given = np.array(given, dtype=np.float64)
                if given.shape != shape or not np.isfinite(given).all():
                    raise ValueError(f"scene {name} must be finite {shape}, got shape {given.shape}")
                object.__setattr__(self, name, given)
        if self.bounds is not None and not (self.bounds[1] > self.bounds[0]).all():
            raise ValueError(f"scene bounds must have their lower corner first, got {self.bounds.tolist()}")
        object.__setattr__(self, "images", images)
        object.__setattr__(self, "alphas", alphas)
        object.__setattr__(self, "surroundings", surroundings)
        object.__setattr__(self, "names", names)
        object.__setattr__(self, "background", parse_background(self.background))

    def __repr__(self) -> str:
        count, height, width = self.images.shape[:3]
        parts = "".join(f", {name}" for name in ("alphas", "surroundings") if getattr(self, name) is not None)
        return f"Scene({count} pictures of {width}x{height}{parts})"

    def __len__(self) -> int:
        return len(self.images)

    @property
    def whole(self) -> np.ndarray:
        """(n, h, w, 3) float32 the pictures with what the masks split off, as they were taken; `images` where nothing
        was."""
        if self.surroundings is None:
            return self.images
        return self.images - (1.0 - self.alphas[..., None]) * self.background + self.surroundings

    @property
    def up(self) -> np.ndarray:
        """(3,) unit vector, up in the world as the cameras were held.

        It is square to the sideward axes of all cameras, as level ones have it; where that says too little, or another
        thing, the mean of their upward axes, and z without one.
        """
        mean = -np.mean([camera.rotation[:, 1] for camera in self.cameras], axis=0)
        length = np.linalg.norm(mean)
        if length < 1e-3:
            return np.array([0.0, 0.0, 1.0])
        mean /= length
        sideward = np.stack([camera.rotation[:, 0] for camera in self.cameras])
        variances, axes = np.linalg.eigh(sideward.T @ sideward / len(sideward))  # ascending
        across = axes[:, 0] * np.sign(axes[:, 0] @ mean)
        nearest = np.round(across)  # a world axis, up to the digits of the file
        across = nearest if np.linalg.norm(across - nearest) < 2e-3 else across
        level = variances[1] > 0.02 and variances[0] < 0.2 * variances[1]
        return across if level and across @ mean > 0.7 else mean


def parse_background(background) -> np.ndarray:
    """(3,) float32 of a colour name or three numbers in [0, 1]. Raises ValueError for anything else."""
    if isinstance(background, str):
        if background == "random":
            raise ValueError("random backgrounds are drawn anew for every ray of a fit, where pictures have opacity: "
                             "load with a colour and fit with background='random'")
        if background not in BACKGROUNDS:
            raise ValueError(f"background {background!r} is not known: {', '.join(BACKGROUNDS)} or 3 numbers in [0, 1]")
        background = BACKGROUNDS[background]
    colour = np.asarray(background, dtype=np.float32)
    if colour.shape != (3,) or not np.isfinite(colour).all() or colour.min() < 0 or colour.max() > 1:
        raise ValueError(f"background must be a colour name or three numbers in [0, 1], got {background}")
    return colour


def load_scene(path, *, split: str = "train", downscale: int = 1, format: str | None = None,
               background="white", masks: bool | str = True) -> Scene:
    """Read one split of a scene from disk.

    path: folder of the scene.
    split: as the format has them ("train", "val", "test"); where it has none, every eighth picture is "test", the
        others are "train", and "all" is both.
    downscale: whole factor by which width and height shrink, by area averaging of premultiplied colour.
    format: "blender" (NeRF-synthetic), "nsvf", "dtu" (IDR layout), "transforms" (nerfstudio, instant-ngp), "colmap";
        None detects it, the first of these that fits.
    background: colour name or three numbers, put behind transparent pixels.
    masks: mask files become alphas, and what they hide the background; "split" keeps what they hide as the scene's
        surroundings, which `fit` puts into layers behind the object; False leaves the pictures whole.

    Raises FileNotFoundError for a missing folder, split or image, ValueError for contents that cannot be used.
    """
    from .scenes import READERS

    folder = pathlib.Path(path)
    if not folder.is_dir():
        raise FileNotFoundError(f"scene folder {str(folder)!r} is not there")
    if int(downscale) != downscale or downscale < 1:
        raise ValueError(f"downscale must be a whole number of at least 1, got {downscale}")
    if format is None:
        format = detect_format(folder)
    if masks not in (True, False, "split"):
        raise ValueError(f"masks must be True, False or 'split', got {masks!r}")
    if format not in READERS:
        raise ValueError(f"scene format {format!r} is not known: {', '.join(READERS)}")
    return READERS[format].read(folder, split=split, downscale=int(downscale),
                                background=parse_background(background), masks=masks)


def detect_format(path) -> str:
    """The name of the format of a scene folder. Raises ValueError that says what was looked for and what is there."""
    from .scenes import READERS

    folder = pathlib.Path(path)
    for name, reader in READERS.items():
        if reader.is_scene(folder):
            return name
    looked = "; ".join(f"{name}: {reader.MARK}" for name, reader in READERS.items())
    seen = sorted(entry.name + "/" * entry.is_dir() for entry in folder.iterdir())
    there = ", ".join(seen[:8]) + (f" and {len(seen) - 8} more" if len(seen) > 8 else "")
    raise ValueError(f"{str(folder)!r} is no scene of a known format ({looked}); it holds {there or 'nothing'}")


def shrink(premultiplied: np.ndarray, factor: int) -> np.ndarray:
    """Area average of an (h, w, c) float image over factor x factor pixels (about, where that leaves a remainder)."""
    if factor == 1:
        return premultiplied
    height, width = premultiplied.shape[:2]
    if height % factor == 0 and width % factor == 0:
        blocks = premultiplied.reshape(height // factor, factor, width // factor, factor, -1)
        return blocks.mean(axis=(1, 3))
    from skimage.transform import resize_local_mean

    size = (max(1, round(height / factor)), max(1, round(width / factor)))
    return resize_local_mean(premultiplied, size, channel_axis=-1, preserve_range=True)
