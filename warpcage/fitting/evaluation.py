"""How well renders match held-out views, and reports of that."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from ..core.checks import real_array, require_type, warn_caller
from ..core.reports import Progress, report_progress, reports_progress
from ..errors import InputError
from ..field.voxel_field import VoxelField
from ..render.belonging import SceneViews, likeness
from ..scene.scene import Scene
from ..splats.splat_field import SplatField
from ..view.camera import Camera
from ..view.camera_path import RefinedCameras
from ..view.frame import Frame

#: Side in pixels of the window of the structural similarity.
SSIM_WINDOW = 11

#: Absolute error from which on a pixel of an error image is all red, and that red.
RED_ERROR, RED = 0.1, (0.85, 0.0, 0.0)

#: Opacity above which a pixel belongs to the object.
OPAQUE = 0.5


class Renderer(Protocol):
    """What `evaluate` compares with pictures: a field or a Deformer."""

    def render(self, camera: Camera, *, background: Any = None) -> Frame: ...


def psnr(image: ArrayLike, reference: ArrayLike, *, weights: ArrayLike | None = None) -> float:
    """Peak signal-to-noise ratio of an image.

    Args:
        image: Values in [0, 1], of any shape. Others are clamped.
        reference: What it should be, of the same shape.
        weights: How much each pixel counts, at least 0: (h, w) for an image (h, w, 3). None counts all alike.

    Returns:
        dB; inf where they agree.

    Raises:
        ValueError: For different shapes, whole numbers beyond 1 (8-bit pictures have to be divided by 255), or weights
            of which none is above 0.
    """
    first, second = _clamped_pair(image, reference)
    squares = (first - second) ** 2
    error = float(np.mean(squares) if weights is None else _weighted_mean(squares, weights))
    return float("inf") if error == 0 else -10.0 * np.log10(error)


def _weighted_mean(values: np.ndarray, weights: ArrayLike) -> float:
    """Mean of values (h, w, ...) by the weights (h, w) of their pixels."""
    given = real_array(weights, "weights")
    if given.shape != values.shape[: given.ndim]:
        raise InputError(f"weights must be those of the pixels of {values.shape}, got {given.shape}")
    total = float(given.sum())
    if not (given.size and given.min() >= 0.0 and 0.0 < total < math.inf):
        raise InputError("weights must be finite, at least 0, and somewhere above: nothing counts otherwise")
    by_pixel = values.reshape(*given.shape, -1).mean(axis=-1)
    # where they are 0 nothing counts, whatever is there
    return float((by_pixel * given)[given > 0.0].sum()) / total


def ssim(image: ArrayLike, reference: ArrayLike, *, weights: ArrayLike | None = None) -> float:
    """Structural similarity of images (h, w, 3) in [0, 1], others clamped; at most 1, where they agree.
    weights: (h, w) how much each pixel counts, a window as much as the least of its pixels; None counts all alike."""
    from skimage.metrics import structural_similarity

    first, second = _clamped_pair(image, reference)
    if min(first.shape[:2]) < SSIM_WINDOW:
        raise InputError(
            f"structural similarity needs images of at least {SSIM_WINDOW}x{SSIM_WINDOW} pixels, got {first.shape[:2]}"
        )
    options = {"channel_axis": -1, "data_range": 1.0, "gaussian_weights": True, "sigma": 1.5}
    found: Any = structural_similarity(  # Wang et al. 2004, Gaussian window of 1.5 pixels
        first, second, use_sample_covariance=False, full=weights is not None, **options
    )
    return float(found) if weights is None else _weighted_mean(_inner(found[1]), window_weights(weights))


def window_weights(weights: ArrayLike) -> np.ndarray:
    """Weights (h - 10, w - 10) of the windows of the structural similarity: the least of the pixels (h, w) in each."""
    from scipy.ndimage import minimum_filter

    return _inner(minimum_filter(real_array(weights, "weights"), SSIM_WINDOW))


def _inner(values: np.ndarray) -> np.ndarray:
    """What is in the middle of windows that lie wholly in a picture (h, w, ...)."""
    edge = SSIM_WINDOW // 2
    return values[edge:-edge, edge:-edge]


def _clamped_pair(image: ArrayLike, reference: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    first, second = np.asarray(image), np.asarray(reference)
    if first.shape != second.shape:
        raise InputError(f"images to compare must be of one shape, got {first.shape} and {second.shape}")
    for values in (first, second):
        if values.dtype.kind in "iu" and values.size and values.max() > 1:
            raise InputError(
                f"images to compare must hold values in [0, 1], got {values.dtype} up to {values.max()}: "
                "divide 8-bit pictures by 255"
            )
    return np.clip(first.astype(np.float64), 0, 1), np.clip(second.astype(np.float64), 0, 1)


def error_image(image: ArrayLike, reference: ArrayLike) -> np.ndarray:
    """A render (h, w, 3) in [0, 1] in grey, with its errors in red; float32."""
    shown = np.clip(np.asarray(image, np.float32), 0, 1)
    error = np.clip(np.abs(shown - np.asarray(reference)).max(axis=-1, keepdims=True) / RED_ERROR, 0, 1)
    grey = 0.5 + 0.5 * shown.mean(axis=-1, keepdims=True)
    return (1 - error) * grey + error * np.array(RED, np.float32)


def masked_psnr(image: ArrayLike, reference: ArrayLike, mask: ArrayLike, *, weights: ArrayLike | None = None) -> float:
    """PSNR, dB, of (h, w, 3) over the pixels where a mask (h, w) is above 1/2; inf where they agree.
    weights: as for `psnr`."""
    inside = np.asarray(mask) > OPAQUE
    if not inside.any():
        raise InputError("the mask is empty: there is nothing to compare")
    weights = None if weights is None else np.asarray(weights)[inside]
    return psnr(np.asarray(image)[inside], np.asarray(reference)[inside], weights=weights)


@reports_progress
def evaluate(
    renderer: Renderer,
    scene: Scene,
    *,
    similarity: bool = False,
    moved_along: bool = False,
    progress: bool | Progress = False,
) -> list[dict[str, Any]]:
    """Render every view of a scene and compare, at the scene's image size and not quantised.

    A renderer with background layers is compared with whole pictures, where the scene has them (its pictures carry no
    opacity, or were split at their masks). Otherwise both are on the scene's background colour. Of pixels with weights
    (`Scene.weights`) each counts as much as they say; views of which nothing counts are left out.

    Args:
        renderer: A VoxelField, a SplatField, a Deformer, or anything with .render(camera, background=...) -> Frame.
        scene: The views. Those of a field that was straightened may be in the world of their files.
        similarity: Whether the structural similarity is measured too.
        moved_along: Whether each view's camera is moved as the fit moved the refined cameras near it (see
            `RefinedCameras.moved_along`), without a look at its picture. A field of refined cameras does not match the
            cameras as given.
        progress: True shows a bar on stderr. A function is called with (done, total, message) and cancels
            by returning False.

    Returns:
        For each view {"view": name, "psnr": dB}; with "ssim" if asked for; with "masked_psnr", over the pixels of the
        object alone, where the scene has opacity.

    Raises:
        ValueError: For anything but a Scene, one of which nothing counts, or `moved_along` and a field whose cameras
            were not refined.
        Cancelled: Where `progress` returned False.

    Warns:
        UserWarning: Where views of a field are unlike the pictures, as of one in another program's coordinates.
    """
    rows = view_figures(renderer, scene, similarity=similarity, moved_along=moved_along, progress=progress)
    warn_of_mismatch(renderer, scene)
    return rows


def warn_of_mismatch(renderer: Renderer, scene: Scene) -> None:
    """Warn of a field that shows something else than a scene's pictures do."""
    if not isinstance(renderer, (VoxelField, SplatField)):
        return  # a pose may be unlike them
    found = likeness(renderer, SceneViews.of(in_world_of(renderer, scene)).glimpses)
    if found.is_doubtful:
        warn_caller(
            f"the field and the cameras of the scene do not belong together: what it shows is unlike the pictures "
            f"(correlation {found.correlation:.2f}); `warpcage evaluate` looks for a turn or a scale that explains it"
        )


@reports_progress
def view_figures(
    renderer: Renderer,
    scene: Scene,
    *,
    similarity: bool = False,
    moved_along: bool = False,
    progress: bool | Progress = False,
) -> list[dict[str, Any]]:
    """As `evaluate`, without a look at whether the field and the scene belong together."""
    require_type(scene, Scene, "evaluate compares with")
    if not hasattr(renderer, "render"):
        raise InputError(f"evaluate needs a field or a Deformer, got {type(renderer).__name__}")
    scene = moved_scene(renderer, scene) if moved_along else in_world_of(renderer, scene)
    rows = []
    background, images = comparison(renderer, scene)
    for index in range(len(scene)):
        report_progress(progress, index, len(scene), "evaluate")
        alpha, weights = (
            None if each is None else scene.cut(index, each[index]) for each in (scene.alphas, scene.weights)
        )
        if weights is not None and not weights.any():
            continue
        image, camera = scene.cut(index, images[index]), scene.cameras[index]
        rgb = renderer.render(camera, background=background).rgb
        row = {"view": scene.names[index], "psnr": psnr(rgb, image, weights=weights)}
        if similarity and (weights is None or window_weights(weights).any()):
            row["ssim"] = ssim(rgb, image, weights=weights)
        shown = alpha if weights is None or alpha is None else np.where(weights > 0.0, alpha, 0.0)
        if shown is not None and (shown > OPAQUE).any():
            row["masked_psnr"] = masked_psnr(rgb, image, shown, weights=weights)
        rows.append(row)
    report_progress(progress, len(scene), len(scene), "evaluate")
    if not rows:
        raise InputError("no pixel of these views counts: all weights are 0, there is nothing to compare")
    return rows


def in_world_of(renderer: Renderer, scene: Scene) -> Scene:
    """A scene in the world of a field that was straightened, where it was read in that of its files."""
    motion = getattr(getattr(renderer, "field", renderer), "straightening", None)
    return scene if motion is None or scene.straightening is not None else scene.moved(motion)


def moved_scene(renderer: Renderer, scene: Scene) -> Scene:
    """A scene in the world of a field of refined cameras whose own cameras moved along with those."""
    refined = refined_cameras_of(renderer)
    if refined is None:
        raise InputError("cameras move along with a fit's refined ones, this field has none: fit with refine_cameras")
    scene = in_world_of(renderer, scene)
    return dataclasses.replace(scene, cameras=refined.moved_along(scene.cameras))


def refined_cameras_of(renderer: Renderer) -> RefinedCameras | None:
    """The cameras that the fit of a field refined, if it did."""
    return getattr(getattr(renderer, "field", renderer), "refined_cameras", None)


def comparison(renderer: Renderer, scene: Scene) -> tuple[np.ndarray | None, np.ndarray]:
    """The colour (3,) to render on, and the pictures (n, h, w, 3) to compare with.
    None for the colour is what the field has around it."""
    field = getattr(renderer, "field", renderer)
    has_surroundings = scene.alphas is None or scene.surroundings is not None
    shows_place = isinstance(field, SplatField) or getattr(field, "background_model", None) is not None
    if shows_place and has_surroundings:
        return None, scene.whole
    if scene.alphas is None:  # nothing of whole pictures is on a colour of the scene's
        return None, scene.images
    return scene.background, scene.images


def mean_psnr(rows: list[dict[str, Any]]) -> float:
    """Mean over the views of their PSNR, as papers report it.

    Args:
        rows: What `evaluate` returned.

    Returns:
        dB.

    Raises:
        ValueError: For no views.
    """
    if not rows:
        raise InputError("mean_psnr needs the rows of one view or more, got none")
    return float(np.mean([row["psnr"] for row in rows]))


@dataclasses.dataclass(frozen=True)
class Report:
    """The figures of every view, and their means."""

    rows: list[dict[str, Any]]  # as `evaluate` returns them, at least one
    given_psnr: float | None = None  # mean PSNR, dB, of cameras as given, where those of the rows moved along

    @property
    def mean_psnr(self) -> float:
        """Mean PSNR, dB."""
        return mean_psnr(self.rows)

    @property
    def mean_ssim(self) -> float | None:
        """Mean structural similarity; None where it was not measured."""
        return self._mean("ssim")

    @property
    def mean_masked_psnr(self) -> float | None:
        """Mean PSNR over the pixels of the object, dB; None where no view has any."""
        return self._mean("masked_psnr")

    @property
    def worst(self) -> int:
        """Number of the view with the lowest PSNR."""
        return min(range(len(self.rows)), key=lambda index: self.rows[index]["psnr"])

    def to_json(self) -> dict[str, Any]:
        """The figures as JSON takes them: None for the infinite PSNR of equal pictures."""
        return {
            "mean_psnr": finite(self.mean_psnr),
            "mean_ssim": self.mean_ssim,
            "mean_masked_psnr": finite(self.mean_masked_psnr),
            "moved_cameras": self.given_psnr is not None,
            "mean_psnr_given": finite(self.given_psnr),
            "worst_view": self.rows[self.worst]["view"],
            "views": [
                {name: finite(value) if name.endswith("psnr") else value for name, value in row.items()}
                for row in self.rows
            ],
        }

    def _mean(self, name: str) -> float | None:
        values = [row[name] for row in self.rows if name in row]
        return sum(values) / len(values) if values else None


def evaluation_report(
    field: Renderer, scene: Scene, *, given: Scene | None = None, progress: bool | Progress = False
) -> Report:
    """Compare a field with the pictures of a scene; the structural similarity too where they are large enough.
    given: the scene before its cameras moved along with refined ones, of which the mean is printed too."""
    sides = [min(camera.width, camera.height) for camera in scene.cameras]
    rows = view_figures(field, scene, similarity=min(sides) >= SSIM_WINDOW, progress=progress)
    return Report(rows, None if given is None else mean_psnr(view_figures(field, given)))


def finite(decibels: float | None) -> float | None:
    """A PSNR or None as JSON has it: None for infinity."""
    return decibels if decibels is not None and decibels < math.inf else None
