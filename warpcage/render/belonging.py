"""Whether a field shows what a scene's pictures do, and if not, which turn, scale or frame would explain it."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator

import numpy as np

from ..cage.up_axis import object_points
from ..core.checks import listed
from ..errors import InputError
from ..scene.coverage import picture_counts
from ..scene.scene import Scene
from ..splats.io.axes import placed
from ..splats.splat_field import AnyField, SplatField
from ..view.alignment import Similarity
from ..view.camera import Camera
from ..view.pictures import shrink

#: Pictures that are compared, and their longer side, pixels; fewer while explanations are looked for.
PICTURES, SIDE, FEW = 6, 96, 3

#: Points of the field that are looked for in pictures, and the smallest share of them that a camera must see.
POINTS, MIN_SHARE = 2000, 0.005

#: A field does not belong to pictures where its correlation with them is below this, and its error above that of one
#: flat colour.
UNLIKE = 0.7

#: A motion explains pictures with at least this correlation, and at most these shares of the error of one flat colour:
#: where the field covers them, and over all pixels.
ALIKE, LEFT, LEFT_OF_ALL = 0.6, 0.8, 0.97

#: Most splats with which explanations are looked for.
MAX_SPLATS = 100_000

#: Scales that are tried: coarse ones, and then finer ones around the best of them.
SCALES, FINER = np.geomspace(1e-3, 1e3, 61), np.geomspace(0.9, 1.1, 9)

#: No motion.
STILL = Similarity(1.0, np.eye(3), np.zeros(3))


@dataclasses.dataclass(frozen=True)
class Glimpse:
    """A small picture of a scene."""

    camera: Camera
    image: np.ndarray  # (h, w, 3)
    counts: np.ndarray  # (h, w) bool, whether each pixel counts


@dataclasses.dataclass(frozen=True)
class SceneViews:
    """The cameras of a scene, and some of its pictures."""

    cameras: list[Camera]
    glimpses: list[Glimpse]
    to_source: np.ndarray | None  # as that of the scene

    @classmethod
    def of(cls, scene: Scene) -> SceneViews:
        """Those of a scene."""
        chosen = np.unique(np.linspace(0, len(scene) - 1, min(len(scene), PICTURES)).round().astype(int))
        return cls(scene.cameras, [_glimpse(scene, int(index)) for index in chosen], scene.to_source)

    def moved(self, motion: np.ndarray | None) -> SceneViews:
        """The same after a rigid motion (4, 4) of the world, if any."""
        if motion is None:
            return self
        glimpses = [dataclasses.replace(each, camera=each.camera.moved(motion)) for each in self.glimpses]
        source = np.eye(4) if self.to_source is None else self.to_source
        return SceneViews([each.moved(motion) for each in self.cameras], glimpses, source @ np.linalg.inv(motion))


@dataclasses.dataclass(frozen=True)
class Likeness:
    """How a field shows pictures, where it covers them."""

    correlation: float  # of the lightness, about its mean in each picture; 0 where nothing is covered
    error: float  # squared error over that of one flat colour a picture; inf where nothing is covered
    left: float  # the same over all pixels, those that are not covered counted as one flat colour

    @property
    def is_doubtful(self) -> bool:
        """Whether it shows something else, or nothing."""
        return self.correlation < UNLIKE and self.error > 1.0

    @property
    def explains(self) -> bool:
        """Whether it shows the pictures, and not by chance."""
        return self.correlation > ALIKE and self.error < LEFT and self.left < LEFT_OF_ALL


def likeness(field: AnyField, glimpses: list[Glimpse], motion: Similarity = STILL) -> Likeness:
    """The likeness to pictures of a field after a motion to their world."""
    back = inverse(motion)
    products, errors, whole = np.zeros(3), np.zeros(2), 0.0
    for glimpse in glimpses:
        whole += float(np.var(glimpse.image[glimpse.counts], axis=0, dtype=np.float64).sum() * glimpse.counts.sum())
        frame = field.render(back.moved([glimpse.camera])[0], supersampling=1)
        there = glimpse.counts & ((frame.alpha > 0.5) | (field.background_model is not None))
        if there.sum() < 2:
            continue
        shown, image = np.clip(frame.rgb[there], 0.0, 1.0).astype(np.float64), glimpse.image[there].astype(np.float64)
        errors += ((shown - image) ** 2).sum(), ((image - image.mean(axis=0)) ** 2).sum()
        one, other = (each.mean(axis=1) - each.mean() for each in (shown, image))
        products += one @ other, one @ one, other @ other
    if errors[1] <= 0.0 or products[2] <= 0.0:
        return Likeness(0.0, np.inf, 1.0)
    correlation = products[0] / max(np.sqrt(products[1] * products[2]), 1e-300)
    return Likeness(correlation, errors[0] / errors[1], 1.0 + (errors[0] - errors[1]) / whole)


@dataclasses.dataclass(frozen=True)
class Mismatch:
    """How a field differs from a scene's pictures."""

    text: str  # with what would explain it
    may_be_pose: bool  # cameras see something, which no turn or scale explains: pictures of another pose are like that


def mismatch(field: AnyField, views: SceneViews) -> Mismatch | None:
    """How a field differs from a scene's pictures; None where it does not."""
    found = likeness(field, views.glimpses)
    if not found.is_doubtful:
        return None
    points, few = object_points(field, POINTS), views.glimpses[:: max(1, len(views.glimpses) // FEW)]
    blind = sum((picture_counts([each], points) > 0).mean() < MIN_SHARE for each in views.cameras if len(points))
    message = f"what it shows is unlike the pictures (correlation {found.correlation:.2f})"
    is_blind = 2 * blind > len(views.cameras) or not np.isfinite(found.error)
    if is_blind:
        message = f"{blind} of {len(views.cameras)} cameras see nothing of it"
    fitting = [each for each in _explanations(_thinned(field), few) if each[1].explains]
    if fitting:
        what, best = min(fitting, key=lambda each: each[1].left)
        return Mismatch(f"{message}; {what} would explain it (correlation {best.correlation:.2f})", may_be_pose=False)
    return Mismatch(
        f"{message}; neither a turn by 90 degrees nor a scale explains it (splats of nerfstudio: --frame "
        "dataparser_transforms.json)",
        may_be_pose=not is_blind,
    )


def _explanations(field: AnyField, glimpses: list[Glimpse]) -> Iterator[tuple[str, Likeness]]:
    """Descriptions of turns and scales about the origin, and the likeness of the field after each."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.eye(3)[list(order)] * np.array(signs)[:, None]
            if np.linalg.det(turn) > 0.0 and not np.array_equal(turn, np.eye(3)):
                yield _turn_text(turn), likeness(field, glimpses, Similarity(1.0, turn, np.zeros(3)))
    tried = {scale: likeness(field, glimpses, Similarity(scale, np.eye(3), np.zeros(3))) for scale in SCALES.tolist()}
    around = min(tried, key=lambda scale: tried[scale].left)
    for scale in (around * FINER).tolist():
        found = likeness(field, glimpses, Similarity(scale, np.eye(3), np.zeros(3)))
        yield f"scaling it by about {scale:.2g}", found


def _turn_text(turn: np.ndarray) -> str:
    """What a turn (3, 3) that takes axes to axes does."""
    angle = round(np.degrees(np.arccos(np.clip(0.5 * (np.trace(turn) - 1.0), -1.0, 1.0))))
    still = np.flatnonzero(np.diag(turn) == 1.0)
    if not len(still):
        places = [f"{'-' * int(row.min() < 0)}{'xyz'[int(np.argmax(np.abs(row)))]}" for row in turn]
        return f"taking its axes in another order (x, y, z from {', '.join(places)})"
    axis = int(still[0])
    up = " (y up in place of z up, or the reverse)" if axis == 0 and angle == 90 else ""
    sign = "-" if angle == 90 and turn[(axis + 2) % 3, (axis + 1) % 3] < 0 else ""
    return f"turning it by {sign}{angle} degrees about {'xyz'[axis]}{up}"


def _thinned(field: AnyField) -> AnyField:
    """The field, or some of its splats where they are many."""
    if not isinstance(field, SplatField) or len(field) <= MAX_SPLATS:
        return field
    return field.chosen(np.sort(np.random.default_rng(0).permutation(len(field))[:MAX_SPLATS]))


def inverse(motion: Similarity) -> Similarity:
    """What undoes a similarity."""
    scale, turn = 1.0 / motion.scale, motion.rotation.T
    return Similarity(scale, turn, -scale * turn @ motion.shift)


def moved_field(field: AnyField, motion: Similarity) -> SplatField:
    """Splats in another world, with their scales, turns and harmonics; ValueError for voxels."""
    if not isinstance(field, SplatField):
        raise InputError("only splats are moved out of nerfstudio's coordinates: voxels are in those of their scene")
    contents = placed(field.contents, motion.rotation, motion.shift, motion.scale)
    return SplatField.from_contents(contents, **field.view_options(), device=field.device)


def out_of_frame(frame: Similarity, to_source: np.ndarray | None) -> Similarity:
    """What takes a field out of nerfstudio's frame, which is given from a reconstruction's coordinates, into those of a
    scene; to_source: (4, 4) from the latter to the reconstruction's, as a Scene has it."""
    back = inverse(frame)
    if to_source is None:
        return back
    matrix = np.linalg.inv(to_source)
    scale = float(np.cbrt(abs(np.linalg.det(matrix[:3, :3]))))
    turn = matrix[:3, :3] / scale
    if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-4) or np.linalg.det(turn) < 0.0:
        raise InputError(
            f"the scene's applied_transform must be a turn with a scale: {listed(matrix.round(4).tolist())}"
        )
    return Similarity(scale * back.scale, turn @ back.rotation, scale * turn @ back.shift + matrix[:3, 3])


def _glimpse(scene: Scene, index: int) -> Glimpse:
    """A picture of a scene, small."""
    image, camera = scene.cut(index, scene.images[index]), scene.cameras[index]
    small = shrink(image, max(1, -(-max(camera.width, camera.height) // SIDE)))
    counts = np.ones(image.shape[:2], bool)
    if scene.weights is not None:
        counts = scene.cut(index, scene.weights[index]) > 0.0
    height, width = small.shape[:2]
    rows, columns = (np.arange(n) * side // n for n, side in zip((height, width), image.shape, strict=False))
    return Glimpse(camera.resized(width, height), small, counts[np.ix_(rows, columns)])
