"""Planes that objects stand on: floors, table tops and walls, found in a field's surface."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from ..core.checks import checked_number, checked_positive, checked_vector, checked_whole
from ..core.names import PLANES, checked_choice
from ..errors import InputError
from ..field.surface import DensityField, node_grid, surface_density

#: Points that a plane is guessed from and tried on at most; all of them take part in its final fit.
_TRIED_POINTS = 20_000

#: Guesses for each plane, and how many of the best are fitted to their points before one is taken.
_GUESSES, _FITTED_GUESSES = 400, 8

#: Rounds of fitting a plane to the points near it; the slab of the first is this many times as thick as the last.
_FIT_ROUNDS, _FIRST_SLAB = 6, 3.0

#: Points of a plane have normals within so many degrees of its own, and their mean within so many.
NORMAL_DEGREES, MEAN_DEGREES = 30.0, 10.0

#: A level plane is within so many degrees of what is up for the cameras, which are rarely held straight; an upright
#: one within so many of a right angle to it.
TILT_DEGREES = 25.0

#: Half the thickness of the slab of a plane's points, in voxels.
SLAB_VOXELS = 1.5

#: Planes are looked for in fields of at most so many voxels a side: a finer one is averaged over blocks first. A wall
#: that is fitted to pictures is rough by some thousandths of a scene, whatever the size of its voxels.
MAX_SIDE = 96

#: A plane holds at least this share of the surface, and so many points, of which this share hangs together: tops of
#: objects that happen to lie in one plane do not.
MIN_SHARE, MIN_POINTS, MIN_PATCH = 0.03, 30, 0.5

#: Where a cut goes above a plane: standard deviations of the heights of its points, and voxels on top, over which what
#: can be seen of a surface fades.
_CUT_DEVIATIONS, _CUT_VOXELS = 2.5, 1.0

#: Voxels over which opacity is smoothed for normals, and its least slope that gives one.
_SMOOTHING, _MIN_SLOPE = 1.0, 0.02

#: Directions around what stands on a plane, and the share of them in which the plane must go on.
_SECTORS, _SURROUNDED = 16, 0.6

#: Area of a plane, at least, over that of the shadow of what stands on it.
_MIN_AREA = 2.0

#: Share of what stands on a plane, from below, whose outline is looked at.
_FOOT_SHARE = 0.25

#: Share of the matter in a region that is above the plane that it stands on, and of the plane's points that the region
#: may hold: a table that is in it whole belongs to what was chosen.
_MIN_ABOVE, _MAX_INSIDE = 0.1, 0.9

#: Takes a plane and returns places (m, 3) of what is above it.
Grown = Callable[["Plane"], np.ndarray]


@dataclasses.dataclass(frozen=True, eq=False)
class Plane:
    """A plane in a field, with a side that is above it."""

    normal: np.ndarray  # (3,) unit vector, out of the matter
    offset: float  # signed distance from the origin along the normal, world units
    spread: float = 0.0  # standard deviation of the heights of its points, world units; 0 for a plane that was given
    share: float = 1.0  # of the surface that it was found in; 1 for a plane that was given
    # (n, 3) float64 on the surface, world units
    points: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)), repr=False)

    def __post_init__(self) -> None:
        normal = checked_vector(self.normal, "the normal of a plane")
        length = float(np.linalg.norm(normal))
        if not length > 0.0:
            raise InputError("the normal of a plane must not be zero")
        object.__setattr__(self, "normal", normal / length)
        object.__setattr__(self, "offset", checked_number(self.offset, "the offset of a plane"))

    def heights(self, points: ArrayLike) -> np.ndarray:
        """Signed distances (...) of points (..., 3) from the plane, world units, above 0 where the normal points to."""
        return np.asarray(points, np.float64) @ self.normal - self.offset

    def clearance(self, voxel_size: ArrayLike) -> float:
        """How far above the plane its own matter ends, world units; voxel_size (3,)."""
        return _CUT_DEVIATIONS * self.spread + _CUT_VOXELS * float(np.max(voxel_size))


def find_planes(
    field: DensityField, kind: str = "ground", *, up: ArrayLike | None = None, count: int = 6, seed: int = 0
) -> list[Plane]:
    """Planes in the surface of a field, such as the floor and the tables of a room, largest first.
    up: (3,); None is the field's own, or +z where it has none."""
    checked_choice(kind, "plane", PLANES)
    count = checked_whole(count, "count", 1)
    upward = checked_vector(getattr(field, "up", (0.0, 0.0, 1.0)) if up is None else up, "up")
    if not np.linalg.norm(upward) > 0.0:
        raise InputError("up must be a direction, not zero")
    upward = upward / np.linalg.norm(upward)
    nodes = np.ptp(np.asarray(field.bounds, np.float64), axis=0) / field.voxel_size
    block = max(1, math.ceil(round(float(nodes.max())) / MAX_SIDE))
    points, normals, weights = surface_points(field, block)  # by largest weights, so that fog counts little
    limit = np.sin(np.radians(TILT_DEGREES))
    allowed: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        "ground": lambda n: n @ upward >= np.cos(np.radians(TILT_DEGREES)),  # level, with its matter below
        "wall": lambda n: np.abs(n @ upward) <= limit,
        "any": lambda n: np.ones(n.shape[:-1], bool),
    }
    slab = SLAB_VOXELS * block * float(np.max(field.voxel_size))
    planes = fit_planes(points, normals, slab, weights=weights, allowed=allowed[kind], count=count, seed=seed)
    if block == 1 or not planes:
        return planes
    finer = surface_points(field)  # fitted to the field's own points at the end
    return [_on_finer_points(plane, slab, *finer) for plane in planes]


def fit_planes(
    points: np.ndarray,
    normals: np.ndarray,
    slab: float,
    *,
    weights: np.ndarray | None = None,
    allowed: Callable[[np.ndarray], np.ndarray] | None = None,
    count: int = 6,
    seed: int = 0,
) -> list[Plane]:
    """Planes through points (n, 3) with unit normals (n, 3), largest first; slab: half its thickness, world units.
    weights: (n,), None counts all alike; allowed: which normals (k, 3) a plane may have, (k,) bool."""
    # RANSAC over points and normals (Fischler and Bolles 1981), the best guesses refitted (Chum et al. 2003).
    slab = checked_positive(slab, "slab")
    weights = np.ones(len(points)) if weights is None else np.asarray(weights, np.float64)
    random = np.random.default_rng(seed)
    left, total, planes = np.ones(len(points), bool), weights.sum(), []
    tries = 2 * count
    while len(planes) < count and tries:
        found = _best_plane(points, normals, weights, left, slab, allowed, random)
        if found is None:
            break
        normal, offset = found
        near = np.flatnonzero(_near(points, normals, normal, offset, slab))
        share = weights[near].sum() / total
        if len(near) < MIN_POINTS or share < MIN_SHARE:
            break
        lean = normals[near].T @ weights[near]
        level = lean @ normal >= np.cos(np.radians(MEAN_DEGREES)) * np.linalg.norm(lean)
        if level and _largest_patch(points[near], weights[near], slab) >= MIN_PATCH * share * total:
            spread = float(np.std(points[near] @ normal))
            planes.append(Plane(normal, offset, spread, float(share), points[near]))
        left &= ~_near(points, normals, normal, offset, 2.0 * slab, 1.5 * NORMAL_DEGREES)
        tries -= 1
    return sorted(planes, key=lambda plane: -plane.share)


def _on_finer_points(plane: Plane, slab: float, points: np.ndarray, normals: np.ndarray, weights: np.ndarray) -> Plane:
    """A plane fitted to those of finer points that lie in its slab, on its side of the matter."""
    # Their normals follow the roughness of the surface, and say no more than that.
    near = np.flatnonzero(_near(points, normals, plane.normal, plane.offset, slab, 90.0))
    if len(near) < MIN_POINTS or not weights[near].sum() > 0.0:
        return plane
    share = weights[near] / weights[near].sum()
    middle = share @ points[near]
    aside = points[near] - middle
    normal = np.linalg.eigh((aside * share[:, None]).T @ aside)[1][:, 0]
    normal = normal if normal @ plane.normal > 0.0 else -normal
    spread = float(np.std(points[near] @ normal))
    return Plane(normal, float(normal @ middle), spread, plane.share, points[near])


def _largest_patch(points: np.ndarray, weights: np.ndarray, slab: float) -> float:
    """The weight of the largest part of points that hangs together, in cells half as wide again as their slab."""
    import skimage.measure

    cells = np.floor((points - points.min(axis=0)) / (3.0 * slab)).astype(int)
    grid = np.zeros(cells.max(axis=0) + 1, bool)
    grid[tuple(cells.T)] = True
    labels = np.asarray(skimage.measure.label(grid, connectivity=3))
    return float(np.bincount(labels[tuple(cells.T)], weights).max())


def surface_points(field: DensityField, block: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (n, 3) of a field's surface, world units: visible nodes dense enough for it with a neighbour that is not.
    Then their unit normals (n, 3) out of the matter, and largest rendering weights (n,), 1 where none were recorded."""
    from scipy.ndimage import binary_erosion, gaussian_filter

    densities, voxel_size = node_grid(field)
    seen = getattr(field, "node_weights", lambda: None)()
    if block > 1:  # a block of nodes counts as one: its mean density, and its largest weight
        densities, voxel_size = blocks(densities, block).mean(axis=(1, 3, 5)), block * voxel_size
        seen = None if seen is None else blocks(np.asarray(seen), block).max(axis=(1, 3, 5))
    level = surface_density(densities, voxel_size)
    solid = densities >= level
    # one half at the surface, whatever the field's density there
    opacity = gaussian_filter(1.0 - np.exp2(-densities / np.float32(level)), _SMOOTHING)
    cells = np.argwhere(solid & ~np.asarray(binary_erosion(solid, np.ones((3, 3, 3), bool), border_value=1), bool))
    slope = np.empty((len(cells), 3))  # of the smoothed opacity; normals are against it
    for axis in range(3):
        ahead, behind = cells.copy(), cells.copy()
        ahead[:, axis] = np.minimum(ahead[:, axis] + 1, densities.shape[axis] - 1)
        behind[:, axis] = np.maximum(behind[:, axis] - 1, 0)
        step = ahead[:, axis] - behind[:, axis]
        slope[:, axis] = (opacity[tuple(ahead.T)] - opacity[tuple(behind.T)]) / np.maximum(step, 1)
    clear = np.linalg.norm(slope, axis=1) >= _MIN_SLOPE
    cells, slope = cells[clear], slope[clear] / voxel_size
    normals = -slope / np.linalg.norm(slope, axis=1, keepdims=True)
    points = np.asarray(field.bounds, np.float64)[0] + (cells + 0.5) * voxel_size
    weights = np.ones(len(cells)) if seen is None else np.asarray(seen, np.float64)[tuple(cells.T)]
    return points, normals, weights


def blocks(values: np.ndarray, side: int) -> np.ndarray:
    """Values (nx, ny, nz) cut into blocks (bx, side, by, side, bz, side), with 0 where the last ones reach beyond."""
    counts = [-(-n // side) for n in values.shape]
    whole = np.pad(values, [(0, side * count - n) for count, n in zip(counts, values.shape, strict=True)])
    return whole.reshape([n for count in counts for n in (count, side)])


def surrounds(plane: Plane, points: np.ndarray, spacing: float) -> bool:
    """Whether a plane goes on around points (n, 3) on it: a table does so around a cup, a seat not around its back.
    spacing: distance of neighbouring points, world units."""
    if not _is_wide(plane, points, spacing):  # the top of a foot has not twice the area of its shadow
        return False
    sideways = np.linalg.svd(plane.normal[None])[2][1:]
    heights = plane.heights(points)
    foot = points[heights <= heights.min() + _FOOT_SHARE * np.ptp(heights)]
    middle = foot.mean(axis=0)
    reach = []
    for each in (foot, plane.points):
        x, y = sideways @ (each - middle).T
        sector = ((np.arctan2(y, x) / (2.0 * np.pi) + 0.5) * _SECTORS).astype(int) % _SECTORS
        farthest = np.zeros(_SECTORS)
        np.maximum.at(farthest, sector, np.hypot(x, y))
        reach.append(farthest)
    return float(np.mean(reach[1] > reach[0])) >= _SURROUNDED  # farther out than the foot's in most directions


def _is_wide(plane: Plane, points: np.ndarray, spacing: float) -> bool:
    """Whether a plane has twice the area of the shadow of points (n, 3) on it; spacing: of neighbouring points."""
    sideways = np.linalg.svd(plane.normal[None])[2][1:]
    areas = [len(np.unique(np.floor(each @ sideways.T / (1.5 * spacing)), axis=0)) for each in (plane.points, points)]
    return areas[0] >= _MIN_AREA * areas[1]


def _near(points, normals, normal, offset, slab, degrees: float = NORMAL_DEGREES) -> np.ndarray:
    """Which oriented points belong to a plane, (n,) bool."""
    return (np.abs(points @ normal - offset) <= slab) & (normals @ normal >= np.cos(np.radians(degrees)))


def _best_plane(
    points: np.ndarray,
    normals: np.ndarray,
    weights: np.ndarray,
    left: np.ndarray,
    slab: float,
    allowed: Callable[[np.ndarray], np.ndarray] | None,
    random: np.random.Generator,
) -> tuple[np.ndarray, float] | None:
    """Normal and offset of the plane with the most weight among the points that are left; None where there is none."""
    rows = np.flatnonzero(left)
    if len(rows) < MIN_POINTS:
        return None
    tried = random.permutation(rows)[:_TRIED_POINTS]
    guesses = tried if allowed is None else tried[allowed(normals[tried])]
    guesses = guesses[:_GUESSES]
    p, n, w = points[tried], normals[tried], weights[tried]

    def score(normal: np.ndarray, offset: float, width: float) -> float:
        return float(w[_near(p, n, normal, offset, width)].sum())

    first = _FIRST_SLAB * slab  # normals of single points are off by degrees: a thick slab does not mind
    scored = sorted((-score(normals[i], float(normals[i] @ points[i]), first), i) for i in guesses)
    best: tuple[float, np.ndarray, float] | None = None
    for _, i in scored[:_FITTED_GUESSES]:
        fitted = _fitted(p, n, w, normals[i], float(normals[i] @ points[i]), slab)
        if fitted is None or (allowed is not None and not allowed(fitted[0][None])[0]):
            continue
        value = score(*fitted, slab)
        if best is None or value > best[0]:
            best = value, *fitted
    if best is None:
        return None
    q, m, u = points[rows], normals[rows], weights[rows]
    return _fitted(q, m, u, best[1], best[2], slab, first=1.0) or (best[1], best[2])


def _fitted(p, n, w, normal, offset, slab, *, first: float = _FIRST_SLAB) -> tuple[np.ndarray, float] | None:
    """A plane fitted to the points near it by weighted least squares, in slabs that become thinner."""
    for width in np.geomspace(first * slab, slab, _FIT_ROUNDS):
        near = _near(p, n, normal, offset, width)
        if near.sum() < 3 or not w[near].sum() > 0.0:
            return None
        share = w[near] / w[near].sum()
        middle = share @ p[near]
        aside = p[near] - middle
        fitted = np.linalg.eigh((aside * share[:, None]).T @ aside)[1][:, 0]
        normal = fitted if fitted @ normal > 0.0 else -fitted
        offset = float(normal @ middle)
    return normal, offset


def plane_below(planes: Sequence[Plane], clicks: np.ndarray, voxel_size: ArrayLike, grown: Grown) -> Plane | None:
    """The plane that something clicked at places (n, 3) stands on; None where the clicks are above none.
    grown: takes a plane and returns what of the object is above it, (m, 3) world units."""
    heights = [(float(np.min(plane.heights(clicks))), plane) for plane in planes]
    below = [(height, plane) for height, plane in heights if height > plane.clearance(voxel_size)]
    for _, plane in sorted(below, key=lambda each: each[0]):  # the nearest that goes on around it, else the largest
        left = grown(plane)
        if len(left) and surrounds(plane, left, float(np.max(voxel_size))):
            return plane
    return max((plane for _, plane in below), key=lambda plane: plane.share, default=None)


def plane_through(
    planes: Sequence[Plane], places: np.ndarray, voxel_size: ArrayLike, is_inside: Callable[[np.ndarray], np.ndarray]
) -> Plane | None:
    """The plane that the matter in a region, places (n, 3), stands on; None where none has enough of it above it.
    is_inside: which of the points (m, 3) of a plane are in the region, (m,) bool."""
    held = []
    for plane in planes:
        heights = plane.heights(places)
        above = heights > plane.clearance(voxel_size)
        if np.mean(above) >= _MIN_ABOVE:
            held.append((float(np.median(heights)), plane, places[above]))
    # the highest that is wide and goes on outside the region, as a table around a boxed cup; else the largest
    for _, plane, standing in sorted(held, key=lambda each: each[0]):
        wide = _is_wide(plane, standing, float(np.max(voxel_size)))
        if wide and np.mean(is_inside(plane.points)) <= _MAX_INSIDE:
            return plane
    return max((plane for _, plane, _ in held), key=lambda plane: plane.share, default=None)
