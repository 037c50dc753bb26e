"""The pose of a cage that makes a deformed field look like pictures: coarse to fine, over pixels and over the cage."""

from __future__ import annotations

import dataclasses
import functools
import warnings
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ..cage.cage import Cage
from ..cage.pose_file import DEFAULT_RATE, PoseFile, posed_cage
from ..core.checks import checked_flag, checked_whole, real_array, require_type, warn_caller
from ..core.names import named_errors
from ..core.reports import Progress, report_progress, reports_progress
from ..deform.deformer import Deformer
from ..edits.edits import CageEdit
from ..errors import InputError
from ..fitting.evaluation import in_world_of
from ..scene.scene import Scene
from ..splats.splat_field import SplatField
from .motions import (
    HANDLES,
    PARAMETERS,
    LinearMotion,
    Motion,
    RigidMotion,
    affine_basis,
    checked_parameters,
    smooth_basis,
)
from .photographs import hull_pixels
from .points import PointLoss
from .priors import DEFAULT_WEIGHTS, Priors
from .surface import depth_behind
from .targets import PictureLoss, PoseTargets

#: Cells of the lattice of the map during a fit, at most: poses are smooth.
MAX_CELLS = 64

#: Fewest pixels along the longer side of the pictures of a step.
MIN_PIXELS = 24

#: Of the starts that are tried, how many a rigid fit continues from; and the largest turn of one, degrees.
CONTINUED, MAX_TURN = 6, 75.0

#: Evaluations of such a rigid fit.
TRIED = 10

#: A step ends where the loss falls by less than this share; how many steps the curvature is taken from.
ENOUGH, MEMORY = 1e-5, 20

#: Losses below which a pose matches, and above which it does not; between them the share of what the loss is without
#: the object.
GOOD, POOR, UNMATCHED = 0.01, 0.1, 0.9

#: Depths differ in the median by a share of the size that no pose has which matches.
POOR_DEPTH = 0.1

#: Vertices move by this share of the size for differences of frames.
DIFFERENCE = 2e-3


@dataclasses.dataclass(frozen=True)
class _Level:
    """A step from coarse to fine."""

    share: float  # of the pictures' pixels
    blur: float  # standard deviation, pixels of the smaller pictures, at least
    wide: float  # the same as a share of their longer side: parts of the object are far from where they are to be
    evaluations: int

    def blur_at(self, size: int) -> float:
        """Standard deviation, pixels, for a longer side of so many."""
        return max(self.blur, self.wide * size)


#: Steps of PARAMETERS up to those that are fitted, and what follows with these.
COARSE: dict[str, _Level] = {
    "rigid": _Level(1 / 8, 1.5, 0.06, 25),
    "affine": _Level(1 / 4, 1.5, 0.03, 20),
    "handles": _Level(1 / 4, 1.0, 0.02, 30),
}
FINE = (_Level(1 / 2, 0.7, 0.0, 30), _Level(1.0, 0.0, 0.0, 25))


@dataclasses.dataclass(frozen=True, eq=False)
class PoseStep:
    """What a step of a fit of a pose did."""

    parameters: str  # what moved: "start", "rigid", "affine", "handles", "vertices" or "basis"
    pixels: int  # along the longer side of the pictures, 0 without pictures
    losses: np.ndarray  # of each evaluation, with priors, in their order; those of other steps are of other pictures


@dataclasses.dataclass(frozen=True, eq=False)
class PoseFit:
    """A pose that was found.

    Attributes:
        cage: The posed cage.
        loss: What is left, without priors: about the mean square of the differences of colours over the object's
            pixels at the largest pictures that were compared, plus those of opacities, depths and points by their
            weights.
        history: The steps, from coarse to fine.
        uncertainty: (v,) standard deviation of each vertex, world units, or None where it was not asked for: how far
            smooth motions may move it while frames and pictures differ by no more than they do, as if differences
            were noise. What no smooth motion or no noise explains is not in it, such as another light.
    """

    cage: Cage
    loss: float
    history: tuple[PoseStep, ...]
    uncertainty: np.ndarray | None = None


@reports_progress
def fit_pose(
    deformer: Deformer,
    targets: Any,
    *,
    cameras: Any = None,
    parameters: Any = "vertices",
    regularize: float | Mapping[str, float] = DEFAULT_WEIGHTS["rigid"],
    start: Any = None,
    restarts: int = 32,
    max_pixels: int = 400,
    exposure: bool = False,
    uncertainty: bool = False,
    seed: int = 0,
    progress: bool | Progress = False,
) -> PoseFit:
    """Find the pose of a cage from pictures of the object in that pose, or from points.

    A sum of robust squares of differences of colours, opacities, depths and points is minimized by L-BFGS, coarse to
    fine: first the whole cage moves, then an affine map of it, its smoothest shapes, all vertices; pictures begin at an
    eighth of their size, blurred. See docs/fit_pose.md for what works and what does not.

    Example::

        found = fit_pose(Deformer(field, cage), load_scene("bent"))
        found.cage.save("pose.obj")

    Args:
        deformer: A Deformer of one edit on a lattice. It is not changed: its pose stays.
        targets: A Scene, such as `load_scene` reads (in the world of its files where the field was straightened, too);
            a PoseTargets with masks, depth, points or landmarks; or pictures
            (n, h, w, 3) before white or (n, h, w, 4) with opacity, in [0, 1], with `cameras`.
        cameras: For arrays of pictures, a Camera each, in the field's world.
        parameters: What may move in the end: "rigid", "affine", "handles" (the 16 smoothest shapes of the cage),
            "vertices"; or a basis: (v, k) shares of k vectors in each vertex, such as weights of handles, or (k, v, 3)
            displacements, each times a number; their lengths do not count. A basis alone is fitted at all sizes,
            without what comes before.
        regularize: Weight of the prior that vertices move rigidly with their neighbours (Sorkine and Alexa 2007), at
            least 0; or weights by name: "rigid" (0.05 where it is not named), "volume" (of the square of the relative
            change of volume), "symmetry" (that the pose is its own mirror image, as the cage at rest is across the
            middle of x, y or z: of the mean square difference of squared distances between vertices and between their
            images, over the size's square), "start" (of the mean square distance from the start, as a share of the
            size).
        start: The pose to begin with, as `Deformer.pose` takes one. None is the cage at rest.
        restarts: How many turns of the start by up to 75 degrees are tried first, beside none, each shifted to where
            the pictures show the object. 0 begins with the start itself.
        max_pixels: Pixels along the longer side of the largest pictures that are compared; larger ones are averaged.
        exposure: Whether each picture has an exposure and a white balance of its own, three factors that each step of
            the fit finds anew: for photographs, which were not taken with those of the field's pictures.
        uncertainty: Whether the fit also finds how sure it is, which takes about as long as 50 evaluations.
        seed: Of the turns.
        progress: True shows a bar on stderr. A function is called with (done, total, message) after each evaluation,
            and cancels the fit by returning False or by raising.

    Returns:
        The pose, with the loss that is left, the history, and the uncertainty. A warning says where what was found
        does not match what it was fitted to.

    Raises:
        ValueError: For targets that do not fit together, a deformer of several edits or none on a lattice, unknown
            parameters, weights below 0, a start that is no pose of the cage or that no picture shows, points outside
            of the cage, or black pictures with `exposure`.
        Cancelled: Where `progress` returned False.
    """
    moved = deformer if isinstance(deformer, _Moved) else _Moved(deformer, "fit_pose")
    checked_whole(restarts, "restarts", 0)
    checked_whole(max_pixels, "max_pixels", 1)
    checked_flag(exposure, "exposure")
    checked_flag(uncertainty, "uncertainty")
    checked_whole(seed, "seed", 0)
    rest = moved.rest
    named = checked_parameters(parameters, rest)
    begin = rest.vertices if start is None else posed_cage(rest, start, "the start of a fit must be").vertices
    if isinstance(targets, Scene):
        targets = in_world_of(moved.deformer, targets)
    options = {"max_pixels": max_pixels, "exposure": exposure, "progress": progress}
    fit = _Fit(moved, PoseTargets.of(targets, cameras), Priors(rest, begin, regularize), begin, **options)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what poses on the way do
        if restarts and not (isinstance(named, np.ndarray) or fit.pictures is None):
            begin = fit.aligned(begin, restarts, seed)
        found = fit.run(named, begin, uncertainty)
    if fit.doubt:
        warn_caller(moved.label + fit.doubt)
    return found


@reports_progress
def fit_poses(
    deformer: Deformer,
    targets: Sequence[Any],
    *,
    times: Sequence[float] | None = None,
    cameras: Any = None,
    start: Any = None,
    restarts: int = 32,
    progress: bool | Progress = False,
    **options: Any,
) -> PoseFile:
    """Find the poses of a sequence, each from its own pictures, beginning with the pose before.

    Errors do not add up, as each pose is fitted to pictures. Give `regularize` with "start" to hold each pose near the
    one before.

    Args:
        deformer: As for `fit_pose`.
        targets: What `fit_pose` takes, one for each moment; None for a moment without, which gets no key.
        times: Seconds of the moments, increasing, such as numpy.arange(n) / 30. None is 24 a second.
        cameras: As for `fit_pose`, the same for all moments.
        start: The pose to begin the first fit with. None is the cage at rest.
        restarts: Turns that the first fit tries; later ones try none.
        progress: As for `fit_pose`; done and total count moments.
        options: More of `fit_pose`, but for `uncertainty`.

    Returns:
        A PoseFile with a key for each moment, "0000", "0001" and so on, in a straight line from each to the next.

    Raises:
        ValueError: As `fit_pose`, with the number of the moment; for no moments, or times that are not as many.
        Cancelled: Where `progress` returned False.
    """
    if not isinstance(targets, Iterable):
        raise InputError(f"targets of fit_poses must be a list, one for each moment, got {type(targets).__name__}")
    if "uncertainty" in options:
        raise InputError("a sequence has no uncertainty: ask fit_pose for that of a moment")
    moments = list(targets)
    if all(moment is None for moment in moments):
        raise InputError("a sequence needs targets of some moment, got none")
    when = np.arange(len(moments)) / DEFAULT_RATE if times is None else real_array(times, "times of poses")
    if when.shape != (len(moments),) or not (np.isfinite(when).all() and (np.diff(when) > 0).all()):
        raise InputError(f"times of poses must increase, one for each of {len(moments)} moments, in seconds")
    moved: Any = _Moved(deformer, "fit_poses")
    file, pose = PoseFile(moved.rest), start
    for number, moment in enumerate(moments):
        report_progress(progress, number, len(moments), "fit poses")
        if moment is None:
            continue
        moved.label = f"moment {number}: "
        with named_errors(f"moment {number}"):
            pose = fit_pose(
                moved, moment, cameras=cameras, start=pose, restarts=0 if len(file) else restarts, **options
            ).cage
        name = f"{number:04d}"
        file[name], file.times[name], file.easings[name] = pose, float(when[number]), "linear"
    report_progress(progress, len(moments), len(moments), "fit poses")
    return file


class _Moved:
    """The Deformer that fits move in place of a caller's, whose pose stays."""

    def __init__(self, deformer: Deformer, name: str):
        require_type(deformer, Deformer, f"{name} needs")
        if len(deformer.edits) != 1 or deformer.edits[0].remove:
            edits = "an edit that removes" if len(deformer.edits) == 1 else f"{len(deformer.edits)} edits"
            raise InputError(
                f"{name} takes a Deformer of one edit that moves or copies, this one is of {edits}: fit the pose of "
                "each cage with a Deformer of its own"
            )
        resolution = None if deformer.resolution is None else min(deformer.resolution, MAX_CELLS)
        options: dict[str, Any] = {"density": deformer.density, "map": deformer.map, "device": deformer.device}
        self._options = options | {"coordinates": deformer.coordinates, "resolution": resolution}
        self.deformer = Deformer(deformer.field, deformer.edits, **self._options)
        self.rest = deformer.edits[0].cage
        self.label = ""  # of warnings

    def require_gradients(self) -> None:
        """Refuse edits whose frames have none."""
        edit, is_splats = self.deformer.edits[0], isinstance(self.deformer.field, SplatField)
        if edit.falloff or edit.fragments:
            raise InputError(
                "a pose is fitted to pictures for an edit without falloff and fragments: leave them out for the fit, "
                "the pose that is found may have them"
            )
        if self.deformer.resolution is None and not is_splats:
            raise InputError("a pose is fitted to pictures on a lattice: give the Deformer a resolution")

    @functools.cached_property
    def without_object(self) -> Deformer:
        """The field without what the cage moves."""
        return Deformer(self.deformer.field, [CageEdit(self.rest, remove=True)], **self._options).pose(self.rest)

    @functools.cached_property
    def depth_behind(self) -> float:
        """World units by which frames' depth lies behind the surface."""
        return depth_behind(self.deformer.field)

    @functools.cached_property
    def basis(self) -> np.ndarray:
        """(v, v) all shapes of the cage, the smoothest first."""
        return smooth_basis(self.rest)


class _Fit:
    """A fit: its losses by poses, and what it found so far."""

    def __init__(
        self,
        moved: _Moved,
        targets: PoseTargets,
        priors: Priors,
        begin: np.ndarray,
        *,
        max_pixels: int,
        exposure: bool,
        progress: bool | Progress,
    ):
        self._moved, self._deformer, self._rest = moved, moved.deformer, moved.rest
        self._targets, self._priors, self._exposure = targets, priors, exposure
        self._largest = min(targets.pixel_size, max_pixels)
        self._points = None if targets.points is None else PointLoss(targets, self._rest, self._deformer.device)
        self._history: list[PoseStep] = []
        self._progress, self._done = progress, 0
        self.pictures: PictureLoss | None = None
        self.doubt = ""
        if targets.has_pictures:
            moved.require_gradients()
            moved.deformer.pose(begin)  # refuses what is no pose
            if self._points is None and not hull_pixels(targets.cameras, begin):
                raise InputError(
                    "no picture shows the cage where the fit begins: cameras must be in the world of the field, with "
                    "its axes and its unit, and look along +z of their own axes"
                )
        self._at(COARSE["rigid"], begin)

    def _at(self, level: _Level, vertices: np.ndarray) -> None:
        """Take pictures of this size; vertices: of the cage, about where the object is."""
        if self._targets.has_pictures:
            size = max(round(level.share * self._largest), min(MIN_PIXELS, self._largest))
            if self.pictures is not None and self.pictures.size == size:
                self.pictures = self.pictures.blurred(level.blur_at(size))
            else:
                behind = 0.0 if self._targets.depths is None else self._moved.depth_behind
                self.pictures = PictureLoss(
                    self._targets,
                    size,
                    level.blur_at(size),
                    self._rest.size,
                    self._deformer.device,
                    behind,
                    field=self._deformer.field,
                    hull=vertices,
                    exposure=self._exposure,
                )

    def _loss(self, vertices: np.ndarray, *, with_gradient: bool = True) -> tuple[float, np.ndarray]:
        """Loss of a pose without priors, and its gradient (v, 3)."""
        loss, gradient = 0.0, np.zeros_like(vertices)
        if self._points is not None:
            loss, gradient = self._points(vertices)
        if self.pictures is not None:
            self._deformer.pose(vertices)
            seen, by_vertices = self.pictures(self._deformer, with_gradient=with_gradient)
            loss, gradient = loss + seen, gradient + by_vertices
        self._done += 1
        report_progress(self._progress, self._done, 0, f"fit pose: loss {loss:.5f}")
        return loss, gradient

    def aligned(self, start: np.ndarray, restarts: int, seed: int) -> np.ndarray:
        """The best of several turns of a start, shifted to where the pictures show the object, after a short fit."""
        assert self.pictures is not None
        random, size = np.random.default_rng(seed), self._rest.size
        if self._targets.is_whole:
            self.pictures.set_empty(self._moved.without_object)
        axes = random.normal(size=(restarts, 3))
        angles = np.radians(MAX_TURN) * random.random(restarts) ** (1 / 3)  # even in the ball of rotation vectors
        turns = np.concatenate([np.zeros((1, 3)), angles[:, None] * axes / np.linalg.norm(axes, axis=1, keepdims=True)])
        found = [(self._loss(start, with_gradient=False)[0], 0, start)]
        for number, turn in enumerate(turns, 1):
            turned = RigidMotion(start, size).vertices(np.concatenate([turn, np.zeros(3)]))
            self._deformer.pose(turned)
            shifted = turned + self.pictures.shift(self._deformer, turned.mean(axis=0))
            found.append((self._loss(shifted, with_gradient=False)[0], number, shifted))
        starts = [vertices for _, _, vertices in sorted(found, key=lambda each: each[:2])[:CONTINUED]]
        tried = [self._minimize(RigidMotion(vertices, size), vertices, TRIED) for vertices in starts]
        return min(tried, key=lambda each: each[0])[1]

    def run(self, parameters: str | np.ndarray, vertices: np.ndarray, uncertainty: bool) -> PoseFit:
        """All steps from a start."""
        if isinstance(parameters, str):
            names = [name for name in COARSE if PARAMETERS.index(name) <= PARAMETERS.index(parameters)]
            steps = [(name, COARSE[name]) for name in names] + [(parameters, level) for level in FINE]
        else:
            steps = [("basis", level) for level in (COARSE["rigid"], COARSE["affine"], *FINE)]
        for name, level in steps if self._targets.has_pictures else steps[:-1]:
            self._at(level, vertices)
            motion = self._motion(name, vertices, parameters)
            _, vertices = self._minimize(motion, vertices, level.evaluations, name)
        loss, _ = self._loss(vertices, with_gradient=False)
        self.doubt = self._doubt(vertices, loss)
        spread = self._uncertainty(vertices) if uncertainty else None
        return PoseFit(self._rest.with_vertices(vertices), loss, tuple(self._history), spread)

    def _doubt(self, vertices: np.ndarray, loss: float) -> str:
        """Why the last pose may be none of what it was fitted to, "" where it seems to be."""
        what = f"the pose that was found does not match what it was fitted to, with a loss of {loss:.2g}"
        world = "are the cameras, depths and points in the world of the field and in its unit"
        if self.pictures is not None:
            if not hull_pixels(self._targets.cameras, vertices):
                return f"the pose that was found lies in none of the pictures: do they show the object, and {world}?"
            off = self.pictures.depth_off(self._deformer)
            if off > POOR_DEPTH:
                return f"{what}: depths differ by {off:.2g} times the cage's size in the median: {world}?"
            without, _ = self.pictures(self._moved.without_object, with_gradient=False)
            if loss > max(UNMATCHED * without, GOOD):
                return f"{what}, for {without:.2g} without the object: do the pictures show it, and {world}?"
        if loss > POOR:
            color = "" if self.pictures is None else ", and is the background that of the pictures, or their exposure"
            return f"{what}, where less than 0.02 is usual: {world}{color}?"
        return ""

    def _motion(self, name: str, vertices: np.ndarray, parameters: Any) -> Motion:
        """What moves in a step."""
        if name == "rigid":
            return RigidMotion(vertices, self._rest.size)
        if name == "affine":
            return LinearMotion(vertices, affine_basis(vertices, self._rest.size))
        if name == "basis":
            return LinearMotion(vertices, parameters)
        return LinearMotion(vertices, self._moved.basis[:, : HANDLES if name == "handles" else None])

    def _minimize(
        self, motion: Motion, start: np.ndarray, evaluations: int, name: str = "start"
    ) -> tuple[float, np.ndarray]:
        """Loss and vertices of the best pose along a descent from a start, which is kept in the history."""
        from scipy.optimize import minimize

        best, losses = (np.inf, start), []
        self._deformer.pose(start)
        if self._points is not None:
            self._points.settle(self._deformer)

        def loss(numbers: np.ndarray) -> tuple[float, np.ndarray]:
            nonlocal best
            vertices = motion.vertices(numbers)
            try:
                value, gradient = self._loss(vertices)
            except InputError:
                if not losses:
                    raise
                return 10.0 * max(losses), np.zeros(motion.count)  # no pose: the step was too long
            prior, by_prior = self._priors(vertices)
            losses.append(value + prior)
            if value + prior < best[0]:
                best = value + prior, vertices
            return value + prior, motion.pulled(numbers, gradient + by_prior)

        options = {"maxfun": evaluations, "maxiter": evaluations, "ftol": ENOUGH, "maxcor": MEMORY}
        minimize(loss, np.zeros(motion.count), jac=True, method="L-BFGS-B", options=options)
        pixels = 0 if self.pictures is None else self.pictures.size
        self._history.append(PoseStep(name, pixels, np.array(losses)))
        return best

    def _uncertainty(self, vertices: np.ndarray) -> np.ndarray:
        """(v,) standard deviations of the vertices along smooth motions, world units."""
        # Laplace's approximation: the inverse of Gauss-Newton's matrix, from differences of frames, and of the priors'
        # curvature, times the variance of what is left; blurred pixels count as often as they are independent.
        level = COARSE["handles"]
        self._at(level, vertices)
        basis, step = self._moved.basis[:, :HANDLES], DIFFERENCE * self._rest.size
        basis = basis / np.abs(basis).max(axis=0)
        count = 3 * basis.shape[1]
        before, (_, prior_before) = self._differences(vertices), self._priors(vertices)
        columns, curvature = np.empty((len(before), count)), np.empty((count, count))
        for number in range(count):
            change = np.zeros((basis.shape[1], 3))
            change.flat[number] = step
            moved = vertices + basis @ change
            columns[:, number] = (self._differences(moved) - before) / step
            curvature[:, number] = (basis.T @ (self._priors(moved)[1] - prior_before)).ravel() / step
        informed = int((np.abs(columns).max(axis=1) > 1e-6 * np.abs(columns).max()).sum())
        variance = float(before @ before) / max(informed - count, 1)
        if self.pictures is not None:
            variance *= max(4 * np.pi * self.pictures.blur**2, 1.0)
        values, vectors = np.linalg.eigh(columns.T @ columns + 0.25 * (curvature + curvature.T))
        spread = vectors / np.sqrt(np.maximum(values, 1e-9 * values.max()) / variance)
        return np.linalg.norm(np.tensordot(basis, spread.reshape(-1, 3, count), 1), axis=(1, 2))

    def _differences(self, vertices: np.ndarray) -> np.ndarray:
        """(m,) what is compared for a pose: the sum of its squares is the loss, but for the robust part."""
        parts = [] if self._points is None else [self._points.differences(vertices)]
        if self.pictures is not None:
            self._deformer.pose(vertices)
            parts.append(self.pictures.differences(self._deformer))
        return np.concatenate(parts)
