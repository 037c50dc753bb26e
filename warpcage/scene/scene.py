"""Posed images of one scene."""

from __future__ import annotations

import dataclasses

import numpy as np

from ..core.checks import checked_bounds
from ..view.backgrounds import parse_background
from ..view.camera import Camera, common_up

#: Images may leave [0, 1] by this much, as renders of a field do; values further out are in other units.
IMAGE_ROOM = 1.0

#: Opacities may leave [0, 1] by this much.
ALPHA_ROOM = 1e-3


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """Images with their cameras.

    Args:
        images: (n, h, w, 3) float32 in [0, 1], composited on the background.
        alphas: (n, h, w) float32 in [0, 1]. None where the images carry no opacity.
        cameras: n cameras of that image size, in the scene's own world units.
        background: (3,) float32, the colour behind everything. The default is white.
        names: n image names, for reports. The default numbers them.
        bounds: (2, 3) float64, a box that holds the object where the data say so (bbox, points, unit sphere). None is
            not known.
        to_source: (4, 4) float64, takes the scene's coordinates to those that its data were made from (DTU's
            millimetres, a reconstruction before nerfstudio's applied_transform). None where they are the same or not
            known.
        surroundings: (n, h, w, 3) float32, what lies around the object in pictures that masks split: their colour times
            1 - alpha. None where nothing was split off.
        captured: Whether the opacity comes from mask files: such pictures were taken, not rendered, and `fit` smooths
            more.

    Raises:
        ValueError: If the parts do not fit together, or images or alphas hold values that are not finite or far from
            [0, 1].
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

    def __post_init__(self) -> None:
        images = _checked_images(self.images)
        count = len(images)
        if len(self.cameras) != count:
            raise ValueError(f"a scene needs one camera per image: {count} images, {len(self.cameras)} cameras")
        names = list(self.names) or [f"{i:04d}" for i in range(count)]
        if len(names) != count:
            raise ValueError(f"a scene needs one name per image: {count} images, {len(names)} names")
        for name, image, camera in zip(names, images, self.cameras, strict=True):
            _check_view(name, image, camera)
        alphas = None if self.alphas is None else _checked_alphas(self.alphas, images.shape[:3], names)
        surroundings = self.surroundings
        if surroundings is not None:
            surroundings = np.asarray(surroundings, dtype=np.float32)
            if alphas is None or surroundings.shape != images.shape:
                raise ValueError(f"scene surroundings must be {images.shape} beside alphas, got {surroundings.shape}")
        to_source = self.to_source
        if to_source is not None:
            to_source = np.array(to_source, dtype=np.float64)
            if to_source.shape != (4, 4) or not np.isfinite(to_source).all():
                raise ValueError(f"scene to_source must be a finite (4, 4) matrix, got shape {to_source.shape}")
        checked = {
            "images": images,
            "alphas": alphas,
            "background": parse_background(self.background),
            "names": names,
            "bounds": None if self.bounds is None else checked_bounds(self.bounds, "scene bounds"),
            "to_source": to_source,
            "surroundings": surroundings,
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        count, height, width = self.images.shape[:3]
        parts = "".join(f", {name}" for name in ("alphas", "surroundings") if getattr(self, name) is not None)
        return f"Scene({count} pictures of {width}x{height}{parts})"

    def __len__(self) -> int:
        return len(self.images)

    @property
    def whole(self) -> np.ndarray:
        """(n, h, w, 3) float32, the pictures as they were taken, with what the masks split off.

        `images` where nothing was split off.
        """
        if self.surroundings is None:
            return self.images
        assert self.alphas is not None
        return self.images - (1.0 - self.alphas[..., None]) * self.background + self.surroundings

    @property
    def up(self) -> np.ndarray:
        """(3,) unit vector, up in the world as the cameras were held.

        It is normal to the sideward axes of all cameras, as for level ones. Where that says too little or something
        else, it is the mean of their upward axes, and z where they have none.
        """
        return common_up(self.cameras)


def _checked_images(images: np.ndarray) -> np.ndarray:
    """(n, h, w, 3) float32, n at least 1."""
    if len(images) == 0:
        raise ValueError("a scene needs at least one image")
    sizes = [np.shape(image)[:2] for image in images]
    if len(set(sizes)) > 1:
        other = next(i for i, size in enumerate(sizes) if size != sizes[0])
        raise ValueError(f"scene images must be of one size: image 0 is {sizes[0]}, image {other} {sizes[other]}")
    images = np.asarray(images, dtype=np.float32)
    if images.ndim != 4 or images.shape[-1] != 3:
        raise ValueError(f"scene images must be (n, h, w, 3), got {images.shape}")
    return images


def _check_view(name: str, image: np.ndarray, camera: Camera) -> None:
    """Refuse an image (h, w, 3) of wrong values, or of another size than its camera's."""
    if not np.isfinite(image).all():
        raise ValueError(f"image {name} holds values that are not finite")
    if image.min() < -IMAGE_ROOM or image.max() > 1 + IMAGE_ROOM:
        raise ValueError(
            f"image {name} holds values from {image.min():g} to {image.max():g}: they must lie in "
            "[0, 1] (8-bit pictures divided by 255)"
        )
    height, width = image.shape[:2]
    if (camera.height, camera.width) != (height, width):
        raise ValueError(f"camera of image {name} is {camera.width}x{camera.height}, images are {width}x{height}")


def _checked_alphas(alphas: np.ndarray, shape: tuple[int, ...], names: list[str]) -> np.ndarray:
    """(n, h, w) float32 opacities of a shape."""
    alphas = np.asarray(alphas, dtype=np.float32)
    if alphas.shape != shape:
        raise ValueError(f"scene alphas must be {shape}, got {alphas.shape}")
    for name, alpha in zip(names, alphas, strict=True):
        if not (alpha.min() >= -ALPHA_ROOM and alpha.max() <= 1 + ALPHA_ROOM):  # false for NaN too
            raise ValueError(
                f"alpha of image {name} holds values from {alpha.min():g} to {alpha.max():g}: they must lie in [0, 1]"
            )
    return alphas
