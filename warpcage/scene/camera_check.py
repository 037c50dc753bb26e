"""Whether cameras fit their pictures: how far feature matches agree with them, for `capture` and for any scene."""

from __future__ import annotations

import dataclasses
import heapq
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from ..core.names import counted
from ..core.reports import Progress, report_progress, reports_progress
from ..core.threads import cpu_threads
from ..view.camera import Camera
from ..view.pictures import shrink
from .box import axes_meeting, find_looks
from .coverage import picture_counts
from .scene import Scene

#: Fewest pictures of a group.
MIN_GROUP = 3

#: Cameras lie at least so far apart, as a share of the distance to what they see.
MIN_PARALLAX = 0.1

#: Below this share of matches that agree cameras are wrong. Right ones have 0.97 (fox, 40 of bonsai).
MIN_AGREEING = 0.5

#: Groups of more than this share of the pictures that are torn off are refused; smaller ones are left out.
MAX_TORN = 0.1

#: Groups between which there are fewer matches than this share of those inside the smaller one show different objects.
MIN_ACROSS = 0.05

#: Pictures that a message names.
MAX_NAMED = 4


@dataclasses.dataclass(frozen=True)
class Agreement:
    """How far matches agree with cameras: a match does where the two rays meet in front of both cameras."""

    pairs: np.ndarray  # (p, 2) int64, pictures that have a camera and matches with each other
    counts: np.ndarray  # (p,) int64, matches of each pair
    agreeing: np.ndarray  # (p,) int64, how many of them agree
    groups: list[np.ndarray]  # pictures that have a camera, by what holds together; the largest first, each ascending

    @property
    def share(self) -> float:
        """The share of all matches that agree; 0 where there are none."""
        return float(self.agreeing.sum() / max(self.counts.sum(), 1))

    def inside(self, group: np.ndarray) -> int:
        """How many matches join the pictures of a group with each other."""
        return int(self.counts[np.isin(self.pairs, group).all(axis=1)].sum())

    def across(self, group: np.ndarray) -> tuple[int, int]:
        """How many matches join a group of pictures with others that have a camera, and how many of them agree."""
        cut = np.isin(self.pairs, group).sum(axis=1) == 1
        return int(self.counts[cut].sum()), int(self.agreeing[cut].sum())


def agreement_of(
    slopes: Sequence[np.ndarray],
    matches: Mapping[tuple[int, int], np.ndarray],
    poses: np.ndarray,
    tolerances: Sequence[float] | np.ndarray,
) -> Agreement:
    """Agreement of matches, (m, 2) features of each pair of pictures, with poses (n, 4, 4) camera to world, or NaN.
    slopes: of each picture (k, 2), x / z and y / z of its features; tolerances: (n,) slopes that a ray may miss by."""
    there, limits = np.isfinite(poses[:, 0, 0]), np.asarray(tolerances, np.float64)
    pairs, counts, agreeing = [], [], []
    for (a, b), rows in matches.items():
        if there[a] and there[b] and len(rows):
            meet = rays_meet(slopes[a][rows[:, 0]], slopes[b][rows[:, 1]], poses[[a, b]], limits[[a, b]])
            pairs.append((a, b))
            counts.append(len(rows))
            agreeing.append(int(meet.sum()))
    joined = np.array(pairs, np.int64).reshape(-1, 2)
    number, good = np.array(counts, np.int64), np.array(agreeing, np.int64)
    return Agreement(joined, number, good, held_groups(np.flatnonzero(there), joined, 2 * good - number))


def rays_meet(first: np.ndarray, second: np.ndarray, poses: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """Which matches, slopes (n, 2) in two cameras of poses (2, 4, 4), show a point in front of both: (n,) bool.
    limits: (2,) slopes by which each ray may miss it. Rays too parallel to give a depth pass."""
    u, v = (
        np.pad(part, ((0, 0), (0, 1)), constant_values=1.0) @ pose[:3, :3].T
        for part, pose in zip((first, second), poses, strict=True)
    )
    u, v = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (u, v))
    base, cosine, normal = poses[1, :3, 3] - poses[0, :3, 3], (u * v).sum(axis=1), np.cross(u, v)
    squared = np.maximum((normal**2).sum(axis=1), 1e-30)
    # depths at which the rays come nearest to each other: normal equations of |depth_u u - depth_v v - base|^2
    along_u, along_v = u @ base, v @ base
    depth_u, depth_v = (along_u - cosine * along_v) / squared, (cosine * along_u - along_v) / squared
    half = 0.5 * np.abs(normal @ base) / np.sqrt(squared)  # from each ray to the point between them
    near = (depth_u > 0) & (depth_v > 0) & (half <= limits[0] * depth_u) & (half <= limits[1] * depth_v)
    return near | ((cosine > 0) & (squared <= limits.sum() ** 2))


def held_groups(pictures: np.ndarray, pairs: np.ndarray, weights: np.ndarray) -> list[np.ndarray]:
    """Pictures (k,) by groups, across which as many matches of pairs (p, 2) disagree as agree, or none are.
    weights: (p,) matches that agree less those that do not. The largest group first, each ascending."""
    # Greedy joining of the two groups between which most agree, summed over all pairs across (Keuper et al. 2015): a
    # few pairs that agree across a cut, which hold a torn solution together, do not hide it.
    between: dict[int, dict[int, int]] = {int(picture): {} for picture in pictures}
    for (a, b), weight in zip(pairs.tolist(), weights.tolist(), strict=True):
        between[a][b] = between[b][a] = between[a].get(b, 0) + weight
    members = {picture: [picture] for picture in between}
    waiting = [(-weight, a, b) for a, others in between.items() for b, weight in others.items() if a < b]
    heapq.heapify(waiting)
    while waiting and waiting[0][0] < 0:
        weight, a, b = heapq.heappop(waiting)
        if between.get(a, {}).get(b) != -weight:
            continue  # one of the two was joined with another one since
        members[a] += members.pop(b)
        for other, more in between.pop(b).items():
            del between[other][b]
            if other != a:
                between[a][other] = between[other][a] = between[a].get(other, 0) + more
                heapq.heappush(waiting, (-between[a][other], min(a, other), max(a, other)))
    groups = [np.array(sorted(group), np.int64) for group in members.values()]
    return sorted(groups, key=lambda group: (-len(group), int(group[0])))


def ahead_share(cameras: Sequence[Camera]) -> float:
    """The share of cameras in front of which the point lies that is nearest to all their optical axes.
    1 where there is no such point: cameras that look one way."""
    middle = axes_meeting(cameras)
    if middle is None:
        return 1.0
    return float(np.mean([(middle - camera.center) @ camera.rotation[:, 2] > 0 for camera in cameras]))


def group_names(names: Sequence[str], group: np.ndarray) -> str:
    """The names of a group of pictures: a few of them all, of more the first and the last."""
    chosen = [names[int(picture)] for picture in group]
    return ", ".join(chosen) if len(chosen) <= MAX_NAMED else f"{chosen[0]} to {chosen[-1]}"


#: Pictures that are looked at, at most, and their longer side, pixels: seconds. Those below the last show nothing.
MAX_PICTURES, SIDE, MIN_SIDE = 40, 320, 96

#: Pictures that each one is compared with: those most alike by so many of their corners.
MAX_ALIKE, FEW = 8, 100

#: Fewest matches that a geometry of two pictures alone explains, by so many tries, each within so many pixels of it.
MIN_MATCHES, TRIES, PIXELS = 16, 200, 1.0

#: Pictures of which fewer of the matches fit one geometry show objects that only look alike; as descriptors do that are
#: not nearer than the next by this ratio (Lowe 2004).
MIN_INLIERS, RATIO = 0.5, 0.8

#: A match agrees where its rays miss each other by so many pixels of the shrunk pictures.
TOLERANCE = 1.5

#: Fewer matches than this say nothing of the cameras.
ENOUGH_MATCHES = 200

#: Corners of a picture, of half and of a quarter of it, at most, and the least strength that is one.
MAX_CORNERS, MIN_STRENGTH = (200, 80, 40), 1e-5

#: Samples along a side of the patch around a corner, pixels between two, and how far it reaches.
PATCH, SPACING, REACH = 8, 3.0, 18

#: Features nearer than this to what is cut out or does not count are of its edge, pixels.
EDGE = 5

#: Cameras are doubtful where fewer of the matches agree; right ones have 0.9 and more.
GOOD_SHARE = 0.75

#: Groups fell apart where fewer of the matches between them agree, about as many as do by chance.
CHANCE = 0.15

#: Places belong together where more than this share of the cameras show two of them.
BOTH_SHARE = 0.25

#: The message of its progress.
MESSAGE = "compare pictures"

Matches = dict[tuple[int, int], np.ndarray]


@reports_progress
def camera_doubt(scene: Scene, *, progress: bool | Progress = False) -> str | None:
    """One line on what is doubtful about the cameras of a scene and what to do; None where nothing is.
    It takes some seconds, whatever the number of pictures; pictures of few pixels are judged by their cameras alone."""
    numbers = np.unique(np.linspace(0, len(scene) - 1, min(len(scene), MAX_PICTURES)).round().astype(int))
    found = matched_agreement(scene, numbers.tolist(), progress)
    lines = (
        _one_place(scene),
        None if found is None else _disagreement(scene, numbers, found),
        _several_places(scene, numbers, found),
    )
    return next((line for line in lines if line is not None), None)


def matched_agreement(scene: Scene, numbers: Sequence[int], progress: bool | Progress = False) -> Agreement | None:
    """How far matches of some of a scene's pictures agree with their cameras, counted as `numbers` has them; None where
    too few are found to say."""
    cameras = [scene.cameras[number] for number in numbers]
    if min(min(camera.width, camera.height) for camera in cameras) < MIN_SIDE:
        return None
    features = []
    # threads of its own: launches on the CPU would wait in the shared ones behind pictures
    with ThreadPoolExecutor(cpu_threads()) as pool:
        try:
            for each in pool.map(lambda number: _features(scene, number), numbers):
                features.append(each)
                report_progress(progress, len(features), len(numbers), MESSAGE)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    focals = np.array([factor * camera.fx for (_, _, factor), camera in zip(features, cameras, strict=True)])
    slopes = [
        (places / factor - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        for (places, _, factor), camera in zip(features, cameras, strict=True)
    ]
    matches = _verified(slopes, [each[1] for each in features], focals, progress)
    if sum(map(len, matches.values())) < ENOUGH_MATCHES:
        return None
    poses = np.stack([camera.camera_to_world for camera in cameras])
    return agreement_of(slopes, matches, poses, TOLERANCE / focals)


def _features(scene: Scene, view: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Places (k, 2) of a picture's corners, pixels of it shrunk; their descriptors (k, 64); by what it was shrunk."""
    from scipy.ndimage import minimum_filter

    image = scene.cut(view, scene.images[view])
    step = max(1, round(max(image.shape[:2]) / SIDE))
    height, width = (side // step * step for side in image.shape[:2])
    grey = shrink(image[:height, :width], step).mean(axis=-1, dtype=np.float32)
    clear = np.ones(grey.shape, bool)
    for part in (scene.weights, scene.alphas):
        if part is not None:
            counts = shrink(scene.cut(view, part[view])[:height, :width, None], step)[..., 0]
            clear &= minimum_filter(counts, 2 * EDGE + 1) > 0.5
    places, vectors, scale = [np.zeros((0, 2))], [np.zeros((0, PATCH**2), np.float32)], 1
    for most in MAX_CORNERS:
        if min(grey.shape) < 2 * REACH + 2:
            break
        found = corners(grey, most)
        places.append(scale * found)
        vectors.append(patches(grey, found))
        scale *= 2
        grey = shrink(grey[: grey.shape[0] // 2 * 2, : grey.shape[1] // 2 * 2, None], 2)[..., 0]
    where = np.concatenate(places)
    rows, columns = (np.minimum(where[:, k].astype(int), clear.shape[1 - k] - 1) for k in (1, 0))
    kept = clear[rows, columns]
    return where[kept], np.concatenate(vectors)[kept], 1.0 / step


def corners(grey: np.ndarray, most: int) -> np.ndarray:
    """(k, 2) places, pixels, of the strongest corners of a picture (h, w): Brown, Szeliski and Winder 2005."""
    from scipy.ndimage import gaussian_filter, maximum_filter

    down, right = np.gradient(gaussian_filter(grey, 1.0))
    yy, xy, xx = (gaussian_filter(product, 1.5) for product in (down * down, down * right, right * right))
    strength = (xx * yy - xy * xy) / np.maximum(xx + yy, 1e-12)  # harmonic mean of the eigenvalues
    peaks = (strength == maximum_filter(strength, 7)) & (strength > MIN_STRENGTH)
    peaks[:REACH], peaks[-REACH:], peaks[:, :REACH], peaks[:, -REACH:] = False, False, False, False
    y, x = np.nonzero(peaks)
    order = np.argsort(-strength[y, x], kind="stable")[:most]
    y, x = y[order], x[order]
    center = strength[y, x]
    shifts = []  # to the top of the parabola through three values along each axis
    for before, after in ((strength[y, x - 1], strength[y, x + 1]), (strength[y - 1, x], strength[y + 1, x])):
        bend = np.minimum(before + after - 2.0 * center, -1e-12)
        shifts.append(np.clip(0.5 * (before - after) / bend, -0.5, 0.5))
    return np.stack([x, y], axis=1) + np.stack(shifts, axis=1) + 0.5


def patches(grey: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(k, PATCH^2) what is around places, turned to the slope there, as unit vectors without their mean."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    x, y = places.T - 0.5
    slopes = [map_coordinates(part, [y, x], order=1) for part in np.gradient(gaussian_filter(grey, 4.5))]
    angle = np.arctan2(*slopes)
    across, down = (part.ravel() * SPACING for part in np.meshgrid(*2 * [np.arange(PATCH) - 0.5 * (PATCH - 1)]))
    cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
    points = [y[:, None] + sine * across + cosine * down, x[:, None] + cosine * across - sine * down]
    values = map_coordinates(gaussian_filter(grey, 0.5 * SPACING), points, order=1, mode="nearest")
    values -= values.mean(axis=1, keepdims=True)
    return values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-6)


def _verified(
    slopes: list[np.ndarray], descriptors: list[np.ndarray], focals: np.ndarray, progress: bool | Progress
) -> Matches:
    """The (m, 2) features that match in pairs of pictures, as a geometry of these two alone explains."""
    count = len(slopes)
    alike = np.zeros((count, count), np.int64)
    for b in range(count):
        report_progress(progress, b, count, MESSAGE)
        for a in range(b):
            alike[a, b] = alike[b, a] = len(_matches(descriptors[a][:FEW], descriptors[b][:FEW]))
    best = np.argsort(-alike, axis=1, kind="stable")[:, :MAX_ALIKE]
    chosen = {(min(a, int(b)), max(a, int(b))) for a in range(count) for b in best[a] if a != b}
    random, found = np.random.default_rng(0), {}
    for number, (a, b) in enumerate(sorted(chosen)):
        report_progress(progress, number, len(chosen), MESSAGE)
        rows = _matches(descriptors[a], descriptors[b])
        if len(rows) >= MIN_MATCHES:
            limit = PIXELS * 0.5 * (1.0 / focals[a] + 1.0 / focals[b])
            good = epipolar_inliers(slopes[a][rows[:, 0]], slopes[b][rows[:, 1]], limit, random)
            if good.sum() >= max(MIN_MATCHES, MIN_INLIERS * len(rows)):
                found[a, b] = rows[good]
    return found


def _matches(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(m, 2) features of two pictures, each the other's nearest and clearly nearer than the next, by unit vectors."""
    if min(len(first), len(second)) < 2:
        return np.zeros((0, 2), np.int64)
    cosines = first @ second.T
    nearest, back = cosines.argmax(axis=1), cosines.argmax(axis=0)
    mutual = np.flatnonzero(back[nearest] == np.arange(len(first)))
    two = np.partition(cosines[mutual], -2, axis=1)[:, -2:]
    near, following = (np.sqrt(np.maximum(2.0 - 2.0 * two[:, k], 0.0)) for k in (1, 0))
    kept = mutual[near < RATIO * following]
    return np.stack([kept, nearest[kept]], axis=1)


def epipolar_inliers(first: np.ndarray, second: np.ndarray, limit: float, random: np.random.Generator) -> np.ndarray:
    """(n,) bool, which pairs of slopes (n, 2) the best fundamental matrix explains within a limit (RANSAC)."""
    u, v = (np.pad(part, ((0, 0), (0, 1)), constant_values=1.0) for part in (first, second))
    rows = np.argsort(random.random((TRIES, len(u))), axis=1)[:, :8]
    system = (v[rows][..., :, None] * u[rows][..., None, :]).reshape(TRIES, 8, 9)
    matrices = np.linalg.svd(system)[2][:, -1].reshape(-1, 3, 3)  # Longuet-Higgins 1981
    across, back = u @ matrices.transpose(0, 2, 1), v @ matrices
    squared = (across * v).sum(axis=-1) ** 2
    slope = (across[..., :2] ** 2).sum(axis=-1) + (back[..., :2] ** 2).sum(axis=-1)
    good = squared < limit**2 * np.maximum(slope, 1e-300)  # Sampson's distance
    return good[np.argmax(good.sum(axis=1))]


def _disagreement(scene: Scene, numbers: np.ndarray, found: Agreement) -> str | None:
    """What matches say against cameras."""
    first, *others = found.groups
    for group in others:
        total, good = found.across(group)
        if len(group) < max(MIN_GROUP, MAX_TORN * len(numbers)):
            break  # they are ordered by size
        if total >= max(MIN_ACROSS * found.inside(group), 2 * MIN_MATCHES) and good < CHANCE * total:
            names = [f"{len(part)} ({group_names(scene.names, numbers[part])})" for part in (first, group)]
            return (
                f"the cameras fell apart: of {len(numbers)} pictures that were compared {names[0]} do not fit to "
                f"{names[1]}, of {total} matches between them {good} agree: find the cameras anew (warpcage capture), "
                "or fit the pictures of one of these groups alone"
            )
    if found.share >= GOOD_SHARE:
        return None
    inside_out = found.share < MIN_AGREEING and ahead_share(scene.cameras) <= 0.5
    wrong = "are inside out: what all look at lies behind them, and" if inside_out else "do not fit to the pictures:"
    return (
        f"the cameras {wrong} of {int(found.counts.sum())} matches between pictures {100 * found.share:.0f} % agree "
        "with them: look whether the format's axes and lens are right, and whether pictures and cameras belong "
        "together, or find the cameras anew (warpcage capture)"
    )


def _one_place(scene: Scene) -> str | None:
    """That all pictures were taken from about one place, which says nothing of depth."""
    if scene.points is None or not len(scene.points) or len(scene) < MIN_GROUP:
        return None
    places = np.stack([camera.center for camera in scene.cameras])
    spread = float(np.linalg.norm(np.ptp(places, axis=0)))
    away = float(np.median(np.linalg.norm(scene.points - places.mean(axis=0), axis=1)))
    if spread >= MIN_PARALLAX * away:
        return None
    return (
        f"the cameras stand at about one place, {100 * spread / max(away, 1e-300):.0f} % of the way to what they show "
        "apart, which says nothing about depth: add pictures from other places"
    )


def _several_places(scene: Scene, numbers: np.ndarray, found: Agreement | None) -> str | None:
    """That cameras look at several places, of which hardly a picture shows two and which no matches tie.
    found: of the pictures of these numbers."""
    looks = find_looks(scene.cameras)
    if len(looks) < 2:
        return None
    places = np.stack([look.point for look in looks])
    if np.mean([picture_counts([camera], places).sum() > 1 for camera in scene.cameras]) > BOTH_SHARE:
        return None
    look_of = np.full(len(scene), -1)
    for index, look in enumerate(looks):
        look_of[look.cameras] = index
    if found is not None:
        first, second = look_of[numbers[found.pairs]].T
        if (found.agreeing[(first != second) & (np.minimum(first, second) >= 0)] >= MIN_MATCHES).any():
            return None
    parts = [f"{len(look.cameras)} ({group_names(scene.names, look.cameras)})" for look in looks]
    return (
        f"{' and '.join(parts)} of {counted(len(scene), 'camera')} look at {len(looks)} places, of which hardly "
        f"a picture shows two: several objects, or cameras that fell apart: fit the pictures of one group "
        "alone, or find the cameras anew (warpcage capture)"
    )
