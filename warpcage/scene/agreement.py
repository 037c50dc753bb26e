"""How far the matches of pictures agree with the cameras that were found of them, and groups that are torn apart."""

from __future__ import annotations

import dataclasses
import heapq
from collections.abc import Mapping, Sequence

import numpy as np

from ..view.camera import Camera
from .box import axes_meeting

#: Fewest pictures of a group that is told apart.
MIN_GROUP = 3

#: Cameras lie at least so far apart, as a share of the distance to what they see.
MIN_PARALLAX = 0.1

#: Below this share of matches that agree cameras are wrong. Right ones have 0.97 (fox, 40 of bonsai).
MIN_AGREEING = 0.5

#: Groups of more than this share of the pictures that are torn off are refused; smaller ones are left out.
MAX_TORN = 0.1

#: Groups between which there are fewer matches than this share of those inside the smaller one show different things.
MIN_ACROSS = 0.05

#: Pictures that a message names.
MAX_NAMED = 4


@dataclasses.dataclass(frozen=True)
class Agreement:
    """What matches say of cameras; a match agrees where the rays of its two features meet in front of both cameras."""

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
    limits: (2,) slopes by which each ray may miss it. Rays so nearly parallel that they do not tell a depth pass."""
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
