"""Where the parts of an object are thin: relative lengths of a cage's edges, so that limbs get tubes of their own."""

from __future__ import annotations

import numpy as np
import warp as wp

from ...core.devices import launch
from ...kernels.mesh.shell import find_largest_balls
from .decimate import Sizing, relative_sizes
from .distance import ObjectShell, on_cpu
from .mirror import reflected

#: How far beyond a ball inside the object its surface still counts as that ball's, in radii and in voxels: a square rod
#: has edges at 1.41 radii.
_TOUCH, _TOUCH_VOXELS = 1.25, 1.5

#: Least edge as a share of the longest, and the power of the radius that edges follow.
_MIN_SHARE, _POWER = 0.35, 0.7

#: How fast edges may become longer along the surface.
_GRADING = 0.5


def part_sizing(shell: ObjectShell, level: float, sizing: Sizing = None) -> Sizing:
    """Relative lengths of edges about places: those of `sizing` times what follows from the thickness of the object."""
    import scipy.spatial

    x, faces = shell.surface(level, 2)
    radius = thickness(shell, x, level)
    size = radius**_POWER
    size = np.maximum(size, _MIN_SHARE * size.max())
    scale = size.max() / radius.max()
    # no faster than by a share of the way between: edges across a joint are those of the limb
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    edges = np.unique(edges, axis=0)
    rise = _GRADING * scale * np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1)
    for _ in range(40):
        np.minimum.at(size, edges[:, 0], size[edges[:, 1]] + rise)
        np.minimum.at(size, edges[:, 1], size[edges[:, 0]] + rise)
    tree = scipy.spatial.KDTree(x)
    return lambda places: size[tree.query(places)[1]] * relative_sizes(sizing, places)


def thickness(shell: ObjectShell, x: np.ndarray, level: float) -> np.ndarray:
    """(n,) radius of the largest ball, within the closed object's offset by `level`, that touches it near x (n, 3)."""
    import scipy.ndimage
    import scipy.spatial

    inside = np.asarray(scipy.ndimage.distance_transform_edt(shell.closed <= level))
    # middles of largest balls: no neighbor's ball holds theirs
    least = scipy.ndimage.maximum_filter(inside, size=3)
    middles = np.argwhere((inside > 0.5) & (inside >= least - 0.3))
    radii = inside[tuple(middles.T)]
    order = np.argsort(-radii, kind="stable")  # the largest first
    radii, middles = radii[order], middles[order]
    ball = np.empty(len(x), dtype=np.int32)
    inputs = [on_cpu((x - shell.lower) / shell.spacing, wp.vec3d), on_cpu(middles.astype(np.float64), wp.vec3d)]
    inputs += [on_cpu(_TOUCH * radii + _TOUCH_VOXELS, wp.float64)]
    launch(find_largest_balls, len(x), inputs, [on_cpu(ball, wp.int32)], device="cpu", work=len(radii) / 4)
    found = np.append(radii, 0.0)[ball]
    bare = found == 0.0
    if bare.any() and not bare.all():
        found[bare] = found[~bare][scipy.spatial.KDTree(x[~bare]).query(x[bare])[1]]
    return np.maximum(found, 1.0) * shell.spacing


def symmetric_sizing(sizing: Sizing, plane: tuple[int, float]) -> Sizing:
    """The shorter of the lengths of edges at places and at their mirror images."""
    return sizing and (lambda x: np.minimum(sizing(x), sizing(reflected(x, *plane))))
