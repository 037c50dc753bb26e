"""Posed images of one scene."""

from __future__ import annotations

import dataclasses

import numpy as np

from ..view.camera import Camera
from ..view.frame import parse_background

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
                raise ValueError(
                    f"image {name} holds values from {image.min():g} to {image.max():g}: they must lie in "
                    "[0, 1] (8-bit pictures divided by 255)"
                )
            if (camera.height, camera.width) != (height, width):
                raise ValueError(
                    f"camera of image {name} is {camera.width}x{camera.height}, images are {width}x{height}"
                )
        alphas = self.alphas
        if alphas is not None:
            alphas = np.asarray(alphas, dtype=np.float32)
            if alphas.shape != images.shape[:3]:
                raise ValueError(f"scene alphas must be {images.shape[:3]}, got {alphas.shape}")
            for name, alpha in zip(names, alphas, strict=True):
                if not (alpha.min() >= -1e-3 and alpha.max() <= 1 + 1e-3):  # false for NaN too
                    raise ValueError(
                        f"alpha of image {name} holds values from {alpha.min():g} to {alpha.max():g}: "
                        "they must lie in [0, 1]"
                    )
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
