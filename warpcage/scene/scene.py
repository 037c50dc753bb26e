"""Images of one scene with their cameras: the class Scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import box_corners
from ..core.checks import checked_bounds, real_array
from ..core.files import PathLike
from ..errors import InputError
from ..view.camera import Camera, CameraFile, common_up, rigid_motion
from ..view.frame import parse_background
from ..view.motion import axis_rotation
from .box import FoundBox, are_found, find_box
from .save import save_scene

#: Images may leave [0, 1] by this much, as renders of a field do; values further out are in other units.
IMAGE_ROOM = 1.0

#: Degrees by which named cameras may be turned against those of a scene, in the median: refined ones are by about one.
OTHER_TURN = 15.0

#: Opacities may leave [0, 1] by this much.
ALPHA_ROOM = 1e-3


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """Images with their cameras.

    Args:
        images: (n, h, w, 3) float32 in [0, 1], composited on the background. Pictures of several sizes lie at the upper
            left of images as large as the largest: see `cut`.
        alphas: (n, h, w) float32 in [0, 1]. None where the images carry no opacity.
        cameras: n cameras of that image size, in the scene's own world units. A picture that is smaller than the images
            has a camera of its own size, and weights of 0 beyond it.
        background: (3,) float32, the colour behind everything. The default is white.
        names: n image names, for reports. The default numbers them.
        bounds: (2, 3) float64, a box that holds the object where the data say so (bbox, points, unit sphere). None is
            not known.
        to_source: (4, 4) float64, takes the scene's coordinates to those that its data were made from (DTU's
            millimetres, a reconstruction before nerfstudio's applied_transform). None where they are the same or not
            known.
        surroundings: (n, h, w, 3) float32, what lies around the object in pictures that masks split: their colour times
            1 - alpha. None where nothing was split off.
        straightening: (4, 4) float64, the rigid motion that took the coordinates of the scene's files to these; see
            `straightened`. None where they are the same.
        captured: Whether the opacity comes from mask files: such pictures were taken, not rendered, and `fit` smooths
            more.
        points: (m, 3) float64, points of the reconstruction that the cameras come from, world units. None where the
            data have none.
        point_colors: (m, 3) float32 in [0, 1], the colours of these points. None where there are no points, or they
            have no colours.
        weights: (n, h, w) float32 in [0, 1], how much each pixel counts: 0 for what is to be ignored, such as people
            who walk by. Fits and figures take nothing from pixels of 0. A pixel of a smaller picture has the least of
            those that it is made of, as its colour is made of them all. None counts all.
        found: How the bounds were found from the points; ignored where `bounds` are others.

    Raises:
        ValueError: If the parts do not fit together, or images, alphas, weights, points or their colours hold values
            that are not finite or, but for points, far from [0, 1].
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
    straightening: np.ndarray | None = None
    points: np.ndarray | None = None
    point_colors: np.ndarray | None = None
    weights: np.ndarray | None = None
    found: FoundBox | None = None

    def __post_init__(self) -> None:
        images = _checked_images(self.images)
        count = len(images)
        for name, given in (("cameras", self.cameras), ("names", self.names)):
            if isinstance(given, str) or not isinstance(given, Sequence):
                raise InputError(f"{name} of a scene must be a list, got {type(given).__name__}")
        if len(self.cameras) != count:
            raise InputError(f"a scene needs one camera per image: {count} images, {len(self.cameras)} cameras")
        names = list(self.names) or [f"{i:04d}" for i in range(count)]
        if len(names) != count:
            raise InputError(f"a scene needs one name per image: {count} images, {len(names)} names")
        weights = _checked_shares("weights", self.weights, images.shape[:3], names)
        for index, (name, image, camera) in enumerate(zip(names, images, self.cameras, strict=True)):
            _check_view(name, image, camera, None if weights is None else weights[index])
        alphas = _checked_shares("alphas", self.alphas, images.shape[:3], names, ALPHA_ROOM)
        surroundings = self.surroundings
        if surroundings is not None:
            surroundings = np.asarray(surroundings, dtype=np.float32)
            if alphas is None or surroundings.shape != images.shape:
                raise InputError(f"scene surroundings must be {images.shape} beside alphas, got {surroundings.shape}")
        to_source = _checked_matrix(self.to_source, "to_source")
        points, point_colors = _checked_points(self.points, self.point_colors)
        checked = {
            "images": images,
            "alphas": alphas,
            "background": parse_background(self.background),
            "names": names,
            "bounds": None if self.bounds is None else checked_bounds(self.bounds, "scene bounds"),
            "to_source": to_source,
            "straightening": _checked_matrix(self.straightening, "straightening"),
            "surroundings": surroundings,
            "points": points,
            "point_colors": point_colors,
            "weights": weights,
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        count, height, width = self.images.shape[:3]
        parts = "".join(
            f", {name}" for name in ("alphas", "surroundings", "weights") if getattr(self, name) is not None
        )
        return f"Scene({count} pictures of {'up to ' * self.has_sizes}{width}x{height}{parts})"

    def __len__(self) -> int:
        return len(self.images)

    @property
    def has_sizes(self) -> bool:
        """Whether some picture is smaller than the images are."""
        return any((camera.height, camera.width) != self.images.shape[1:3] for camera in self.cameras)

    def cut(self, index: int, image: np.ndarray) -> np.ndarray:
        """The part of an array as large as the images that belongs to a picture, such as of `images[index]`.

        Args:
            index: Number of the picture.
            image: (h, w, ...) of the images' size.

        Returns:
            Its upper left part of the size of the picture's camera, without a copy; all of it where pictures have one
            size.
        """
        camera = self.cameras[index]
        return image[: camera.height, : camera.width]

    def subset(self, numbers: Sequence[int] | slice) -> Scene:
        """A scene of some of the pictures.

        Args:
            numbers: Indices of the pictures, in the order of the new scene, or a slice.

        Returns:
            The scene; its arrays are views of this one's where `numbers` is a slice.

        Raises:
            ValueError: For no pictures.
        """
        numbers = numbers if isinstance(numbers, slice) else [int(number) for number in numbers]
        per_picture = {name: getattr(self, name) for name in ("images", "alphas", "surroundings", "weights")}
        chosen = {name: array[numbers] for name, array in per_picture.items() if array is not None}
        order = np.arange(len(self))[numbers]
        lists = {name: [getattr(self, name)[k] for k in order] for name in ("cameras", "names")}
        return dataclasses.replace(self, **chosen, **lists)

    def save(self, folder: PathLike) -> None:
        """Write the scene as nerfstudio has it (transforms.json), for other programs and `load_scene`.

        Pictures are written as they are here: without distortion, shrunk and turned as they were when they were read,
        as PNG with 8 bits. Opacity that was rendered is their alpha, masks of captures are files of their own
        (mask_path), pixels that do not count are dynamic_mask_NAME.png as instant-ngp has it, points are points.ply.
        `load_scene(folder, split="all")` reads all of it back; bounds that do not follow from points are not kept.

        Args:
            folder: A new or an empty folder.

        Raises:
            ValueError: For a folder that holds something.
        """
        save_scene(self, folder)

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

    def with_cameras(self, cameras: Sequence[Camera] | CameraFile) -> Scene:
        """The same pictures with other cameras, as a fit refined them.

        Args:
            cameras: One for each picture in their order, or a CameraFile that names the pictures and maybe others; in
                the world of this scene.

        Returns:
            The scene.

        Raises:
            ValueError: For too few cameras or pictures without one, cameras of another picture size, and named ones
                that look elsewhere: splits may have the same names.
        """
        if isinstance(cameras, CameraFile) and any(key.name for key in cameras):
            named = {key.name: key.camera for key in cameras}
            missing = [name for name in self.names if name not in named]
            if missing:
                raise InputError(
                    f"there is no camera for {len(missing)} of {len(self)} pictures, {missing[0]!r} among them: the "
                    "file must name all pictures of the split"
                )
            chosen = [named[name] for name in self.names]
            turn = float(np.median([turn_between(one, other) for one, other in zip(chosen, self.cameras, strict=True)]))
            if turn > OTHER_TURN:
                raise InputError(
                    f"its cameras look elsewhere than the scene's, {turn:.0f} degrees in the median: they may be those "
                    "of another split, or of another world"
                )
        else:
            chosen = [key.camera for key in cameras] if isinstance(cameras, CameraFile) else list(cameras)
        if len(chosen) != len(self):
            raise InputError(f"a scene needs one camera per image: {len(self)} images, {len(chosen)} cameras")
        pairs = zip(chosen, self.cameras, strict=True)
        return dataclasses.replace(self, cameras=[_at_size(camera, own.width, own.height) for camera, own in pairs])

    def straightened(self, *, round_bounds: bool = False) -> Scene:
        """The scene after the smallest rotation about the origin of its world that makes `up` +z.

        Args:
            round_bounds: As for `moved`.

        Returns:
            The scene; this one if `up` is +z already. `straightening` is the rotation.
        """
        turn = rotation_to(self.up, np.array([0.0, 0.0, 1.0]))
        return self if turn is None else self.moved(turn, round_bounds=round_bounds)

    def moved(self, motion: ArrayLike, *, round_bounds: bool = False) -> Scene:
        """The scene after a rigid motion of its world.

        Args:
            motion: (4, 4) from the coordinates of this scene to those of the new one.
            round_bounds: Whether the bounds enclose a ball, so that they keep their size. Otherwise they become the
                box around the moved box, or are found again where they were found from points.

        Returns:
            The scene. Its `straightening` is that of this one followed by the motion, `to_source` undoes it.

        Raises:
            ValueError: If the motion is not rigid.
        """
        motion = rigid_motion(motion)
        bounds, found = self.bounds, None
        cameras = [camera.moved(motion) for camera in self.cameras]
        points = None if self.points is None else self.points @ motion[:3, :3].T + motion[:3, 3]
        if bounds is not None and round_bounds:
            bounds = bounds - bounds.mean(axis=0) + motion[:3, :3] @ bounds.mean(axis=0) + motion[:3, 3]
        elif points is not None and are_found(self):
            found = find_box(cameras, points)
            bounds = found.bounds
        elif bounds is not None:
            corners = box_corners(bounds) @ motion[:3, :3].T + motion[:3, 3]
            bounds = np.stack([corners.min(axis=0), corners.max(axis=0)])
        before, source = (np.eye(4) if each is None else each for each in (self.straightening, self.to_source))
        return dataclasses.replace(
            self,
            cameras=cameras,
            points=points,
            bounds=bounds,
            found=found,
            to_source=source @ np.linalg.inv(motion),
            straightening=motion @ before,
        )


def rotation_to(direction: np.ndarray, goal: np.ndarray) -> np.ndarray | None:
    """The smallest turn (4, 4) about the origin that takes a unit vector (3,) to another; None where they are equal."""
    axis, cosine = np.cross(direction, goal), float(direction @ goal)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        if cosine > 0.0:
            return None
        axis = np.cross(direction, np.eye(3)[int(np.argmin(np.abs(direction)))])  # any axis across
    motion = np.eye(4)
    motion[:3, :3] = axis_rotation(axis / np.linalg.norm(axis), float(np.arctan2(sine, cosine)))
    return motion


def _checked_matrix(matrix: ArrayLike | None, name: str) -> np.ndarray | None:
    """A finite (4, 4) matrix, or None."""
    if matrix is None:
        return None
    matrix = np.array(matrix, dtype=np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InputError(f"scene {name} must be a finite (4, 4) matrix, got shape {matrix.shape}")
    return matrix


def _checked_points(points: ArrayLike | None, colors: ArrayLike | None) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Finite points (m, 3) float64 and colours (m, 3) float32 in [0, 1], or None."""
    if points is None:
        if colors is not None:
            raise InputError("scene point_colors need points")
        return None, None
    places = real_array(points, "scene points")
    if places.ndim != 2 or places.shape[1] != 3 or not np.isfinite(places).all():
        raise InputError(f"scene points must be finite and (m, 3), got shape {places.shape}")
    if colors is None:
        return places, None
    rgb = real_array(colors, "scene point_colors", np.float32)
    if rgb.shape != places.shape:
        raise InputError(f"scene point_colors must be {places.shape}, as the points, got {rgb.shape}")
    if rgb.size and not (rgb.min() >= 0.0 and rgb.max() <= 1.0):  # false for NaN too
        raise InputError(f"scene point_colors hold values from {rgb.min():g} to {rgb.max():g}: they must lie in [0, 1]")
    return places, rgb


def _checked_images(images: np.ndarray) -> np.ndarray:
    """(n, h, w, 3) float32, n at least 1."""
    if not isinstance(images, Sequence | np.ndarray) or isinstance(images, str | bytes):
        raise InputError(f"images of a scene must be an array (n, h, w, 3), got {type(images).__name__}")
    if len(images) == 0:
        raise InputError("a scene needs at least one image")
    sizes = [np.shape(image)[:2] for image in images]
    if len(set(sizes)) > 1:
        other = next(i for i, size in enumerate(sizes) if size != sizes[0])
        raise InputError(f"scene images must be of one size: image 0 is {sizes[0]}, image {other} {sizes[other]}")
    images = np.asarray(images, dtype=np.float32)
    if images.ndim != 4 or images.shape[-1] != 3:
        raise InputError(f"scene images must be (n, h, w, 3), got {images.shape}")
    return images


def _check_view(name: str, image: np.ndarray, camera: Camera, weights: np.ndarray | None) -> None:
    """Refuse an image (h, w, 3) of wrong values, or of another size than its camera's: weights (h, w) are 0 beyond."""
    if not np.isfinite(image).all():
        raise InputError(f"image {name} holds values that are not finite")
    if image.min() < -IMAGE_ROOM or image.max() > 1 + IMAGE_ROOM:
        raise InputError(
            f"image {name} holds values from {image.min():g} to {image.max():g}: they must lie in "
            "[0, 1] (8-bit pictures divided by 255)"
        )
    height, width = image.shape[:2]
    if (camera.height, camera.width) == (height, width):
        return
    if weights is None or camera.height > height or camera.width > width:
        raise InputError(f"camera of image {name} is {camera.width}x{camera.height}, images are {width}x{height}")
    if weights[camera.height :].any() or weights[:, camera.width :].any():
        raise InputError(
            f"camera of image {name} is {camera.width}x{camera.height}, images are {width}x{height}: weights must be 0 "
            "beyond the camera's picture"
        )


def _checked_shares(
    name: str, shares: ArrayLike | None, shape: tuple[int, ...], names: list[str], room: float = 0.0
) -> np.ndarray | None:
    """(n, h, w) float32 numbers of pixels in [0, 1], or outside by some room; or None."""
    if shares is None:
        return None
    shares = real_array(shares, f"scene {name}", np.float32)
    if shares.shape != shape:
        raise InputError(f"scene {name} must be {shape}, a number for each pixel of the pictures, got {shares.shape}")
    for image, share in zip(names, shares, strict=True):
        if not (share.min() >= -room and share.max() <= 1 + room):  # false for NaN too
            raise InputError(
                f"{name} of image {image} hold values from {share.min():g} to {share.max():g}: they must lie in [0, 1]"
            )
    return shares


def turn_between(one: Camera, other: Camera) -> float:
    """The angle, degrees, of the rotation from one camera to another."""
    cosine = 0.5 * (np.trace(one.rotation.T @ other.rotation) - 1.0)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _at_size(camera: Camera, width: int, height: int) -> Camera:
    """A camera for pictures of another size: that many times smaller or larger, but for a last part of a pixel."""
    if (camera.width, camera.height) == (width, height):
        return camera
    factor = max(round(camera.width / width), 1) / max(round(width / camera.width), 1)
    whole = [(camera.width, width), (camera.height, height)]
    if any(abs(held / factor - wanted) >= 1.0 for held, wanted in whole):
        raise InputError(
            f"a camera is for pictures of {camera.width}x{camera.height}, those of the scene have {width}x{height}: "
            "sizes must be the same but for a whole factor"
        )
    numbers = {name: getattr(camera, name) / factor for name in ("fx", "fy", "cx", "cy")}
    return dataclasses.replace(camera, **numbers, width=width, height=height)
