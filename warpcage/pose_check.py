"""What a pose does to the inside of its cage: where it turns it inside out, how far it stretches it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .cage_intersections import intersecting_faces
from .cage_report import PoseReport

if TYPE_CHECKING:
    from .cage import Cage

#: Samples inside the posed cage, about.
_SAMPLES = 3000

#: Distance of the points of a finite difference, as a share of the size: float32 maps err by about 1e-6 of it.
_DIFFERENCE = 2e-3


def check_pose(rest: Cage, pose: Cage) -> PoseReport:
    """Examine a pose (in any order that `Cage.match` takes) of a usable cage. Raises ValueError where it does not fit.

    The map posed -> rest is sampled on a grid inside the posed cage; its Jacobian J by forward differences. A sample is
    inverted where det J <= 0; elsewhere the pose stretches by 1 / s for each singular value s of J.
    """
    from .cage_check import first_problem, tuples
    from .coordinates import deform_points

    pose = rest.match(pose)
    problem = first_problem(pose)
    folds = tuples(intersecting_faces(pose.vertices, pose.faces))
    ratio = pose.volume / rest.volume
    if problem:
        return PoseReport(0, ratio, 0.0, 0.0, 0.0, 0.0, folds, problem)

    points, step = _grid(pose), _DIFFERENCE * pose.size
    offsets = np.concatenate([np.zeros((1, 3)), step * np.eye(3)])
    stencil = points[:, None] + offsets
    stencil = stencil[np.asarray(pose.contains(stencil.reshape(-1, 3))).reshape(-1, 4).all(axis=1)]
    if not len(stencil):
        return PoseReport(0, ratio, 0.0, 0.0, 1.0, 1.0, folds, problem)
    mapped = deform_points(stencil.reshape(-1, 3), pose, rest, coordinates="mean_value").reshape(-1, 4, 3)
    jacobian = (mapped[:, 1:] - mapped[:, :1]) / step
    inverted = np.linalg.det(jacobian) <= 0.0
    singular = np.linalg.svd(jacobian[~inverted], compute_uv=False)
    stretch = 1.0 / np.clip(singular, 1e-6, 1e6) if len(singular) else np.zeros((1, 3))
    return PoseReport(
        sample_count=len(stencil), volume_ratio=ratio, inverted_share=float(inverted.mean()),
        outside_share=float(np.mean(~np.asarray(rest.contains(mapped[:, 0])))),
        least_stretch=float(stretch.min()), largest_stretch=float(stretch.max()),
        intersecting_faces=folds, problem=problem,
    )  # fmt: skip


def _grid(cage: Cage) -> np.ndarray:
    """Points (n, 3) of a grid over the cage's bounding box, off its planes of symmetry."""
    lower, upper = cage.bounds
    spacing = (cage.volume / _SAMPLES) ** (1.0 / 3.0)
    axes = [np.arange(low + 0.37 * min(spacing, high - low), high, spacing)
            for low, high in zip(lower, upper, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
