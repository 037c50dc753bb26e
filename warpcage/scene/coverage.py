"""What the cameras of a capture cover: from which sides, at which heights, in how many pictures; and a map of it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import box_corners
from ..view.camera import Camera
from .box_picture import TEXT, captioned

#: A direction around the object is covered where a camera looks from within this angle of it, degrees.
COVERED_DEGREES = 20.0

#: Directions that the sphere around the object is sampled by, and places along each side of its box.
DIRECTIONS, PLACES = 2000, 16

#: A gap between neighbouring cameras on the circle around the object that is larger was not seen, degrees.
LARGE_GAP = 60.0

#: A camera may go as far from the object as those within so many degrees of it stood.
NEARBY = 10

#: Cameras that a place needs: one shows no depth, and two agree on much that is not there.
ENOUGH = 3

#: Height of the map, pixels.
SIDE = 400

#: Colours of what no camera saw, fewer than ENOUGH, ENOUGH, and MANY or more; of cameras, and of the box.
NONE, FEW, PALE, FULL = (224, 224, 224), (246, 178, 107), (196, 228, 186), (26, 120, 66)
MANY, CAMERA, BOX = 12, (30, 60, 160), (200, 30, 30)


@dataclasses.dataclass(frozen=True)
class Coverage:
    """From where cameras see a place."""

    middle: np.ndarray  # (3,) the place, world units
    frame: np.ndarray  # (3, 3) columns: two directions across what is up, and up
    directions: np.ndarray  # (k, 3) unit vectors from the place to the cameras that see it, in that frame
    distances: np.ndarray  # (k,) to them, world units

    @property
    def azimuths(self) -> np.ndarray:
        """(k,) degrees of the cameras around the place, ascending, -180 to 180."""
        return np.sort(np.degrees(np.arctan2(self.directions[:, 1], self.directions[:, 0])))

    @property
    def around(self) -> float:
        """Largest gap between neighbouring cameras on the circle around the place, degrees; 360 for one."""
        return float(np.diff(self.azimuths, append=self.azimuths[0] + 360.0).max())

    @property
    def seam(self) -> float:
        """The middle of that gap, degrees."""
        turns = self.azimuths
        gaps = np.diff(turns, append=turns[0] + 360.0)
        return float(turns[np.argmax(gaps)] + gaps.max() / 2)

    @property
    def elevation(self) -> tuple[float, float]:
        """Lowest and highest camera, degrees above the horizon of the place."""
        rises = elevations(self.directions)
        return float(rises.min()), float(rises.max())

    def counts(self, directions: np.ndarray) -> np.ndarray:
        """(n,) numbers of cameras within COVERED_DEGREES of directions (n, 3) of the frame."""
        return (directions @ self.directions.T >= math.cos(math.radians(COVERED_DEGREES))).sum(axis=1)

    def shares(self, least: int = 1) -> tuple[float, float]:
        """Shares of all directions, and of those above the horizon, that so many cameras stand near."""
        k = np.arange(DIRECTIONS) + 0.5  # a Fibonacci sphere
        height, turn = 1 - 2 * k / DIRECTIONS, k * np.pi * (3 - np.sqrt(5))
        flat = np.sqrt(1 - height**2)
        covered = self.counts(np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)) >= least
        return float(covered.mean()), float(covered[height > 0].mean())

    def arc(self, eye: ArrayLike) -> tuple[float, float] | None:
        """How far a camera at eye (3,) may turn around the place, degrees to -180 and above, through what was seen.
        Both are of one sign where the eye itself is beyond; None where no gap is large: all the way round."""
        turns = self.azimuths
        gaps = np.diff(turns, append=turns[0] + 360.0)
        after = np.flatnonzero(gaps > LARGE_GAP)
        if not len(after):
            return None
        x, y, _ = (np.asarray(eye, np.float64) - self.middle) @ self.frame
        begins = turns[(after + 1) % len(turns)]
        spans = (turns[np.roll(after, -1)] - begins) % 360.0
        low = begins - math.degrees(math.atan2(y, x))
        arcs = np.concatenate([np.stack([low + whole, low + spans + whole], axis=1) for whole in (-360.0, 0.0, 360.0)])
        beyond = np.maximum(np.maximum(arcs[:, 0], -arcs[:, 1]), 0.0)
        nearest = arcs[np.argmin(beyond)].tolist()
        return nearest[0], nearest[1]

    def reach(self, eye: ArrayLike) -> np.ndarray:
        """(360,) shares, 1 at most, of its distance that a camera at eye (3,) may have, by degrees around from there:
        smoothly as far as the farthest cameras there, so that it stays on this side of walls."""
        offset = (np.asarray(eye, np.float64) - self.middle) @ self.frame
        begin = math.degrees(math.atan2(offset[1], offset[0]))
        degrees, turns = np.arange(360), np.degrees(np.arctan2(self.directions[:, 1], self.directions[:, 0])) - begin
        near = np.abs((degrees[:, None] - turns + 180.0) % 360.0 - 180.0) <= NEARBY
        farthest = np.where(near, self.distances / np.linalg.norm(offset), 0.0).max(axis=1)
        there = near.any(axis=1)
        farthest = np.interp(degrees, degrees[there], farthest[there], period=360)
        around = np.add.outer(degrees, np.arange(-NEARBY, NEARBY + 1)) % 360
        smooth = np.minimum(farthest[around].min(axis=1), 1.0)[around].mean(axis=1)
        return np.minimum(smooth / smooth[0], 1.0)

    def summary(self) -> str:
        """One line on what was seen."""
        low, high = self.elevation
        return (
            f"from {360 - self.around:.0f} of 360 degrees around it, at heights of {low:.0f} to {high:.0f}; "
            f"{100 * self.shares(ENOUGH)[0]:.0f} % of all directions by {ENOUGH} cameras or more"
        )


def find_coverage(cameras: Sequence[Camera], middle: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Coverage:
    """From where cameras see a place (3,), world units: those in whose pictures it lies, or all where it is in none.
    up: (3,) of any length but zero."""
    place, axis = np.asarray(middle, np.float64), np.asarray(up, np.float64) / np.linalg.norm(up)
    side = np.cross((0.0, 1.0, 0.0) if abs(axis[1]) < 0.9 else (0.0, 0.0, 1.0), axis)
    side /= np.linalg.norm(side)
    frame = np.stack([side, np.cross(axis, side), axis], axis=1)  # x and y of the world where z is up
    seeing = [camera for camera in cameras if _in_picture(camera, place[None])[0]]
    ways = np.stack([camera.center for camera in seeing or cameras]) - place
    distances = np.maximum(np.linalg.norm(ways, axis=1), 1e-12)
    return Coverage(place, frame, ways / distances[:, None] @ frame, distances)


def picture_counts(cameras: Sequence[Camera], points: np.ndarray) -> np.ndarray:
    """(n,) in how many pictures points (n, 3) lie, world units, whatever may occlude them."""
    return np.sum([_in_picture(camera, points) for camera in cameras], axis=0)


def little_seen(cameras: Sequence[Camera], bounds: np.ndarray) -> float:
    """The share of a box (2, 3) that lies in fewer pictures than ENOUGH."""
    shares = (np.arange(PLACES) + 0.5) / PLACES
    grid = np.stack(np.meshgrid(shares, shares, shares, indexing="ij"), axis=-1).reshape(-1, 3)
    return float((picture_counts(cameras, bounds[0] + grid * (bounds[1] - bounds[0])) < ENOUGH).mean())


def draw_coverage(coverage: Coverage, cameras: Sequence[Camera], bounds: np.ndarray) -> np.ndarray:
    """A map of what was seen, (h, w, 3) float32: directions from the middle by angles, and places on its level.
    Grey: by no camera, orange: by fewer than ENOUGH, green: by so many or more; dots are cameras, red is the box."""
    from PIL import Image, ImageDraw, ImageFont

    small = ImageFont.load_default(size=TEXT - 3)
    begin = coverage.seam
    turn, rise = np.meshgrid(_middles(2 * SIDE, begin, begin + 360), _middles(SIDE, 90, -90))
    flat = np.cos(np.radians(rise))
    ways = np.stack([flat * np.cos(np.radians(turn)), flat * np.sin(np.radians(turn)), np.sin(np.radians(rise))], -1)
    counts = np.concatenate([coverage.counts(row) for row in ways])
    angles = Image.fromarray(_count_colors(counts).reshape(SIDE, 2 * SIDE, 3))
    draw = ImageDraw.Draw(angles)
    for degrees in range(-180, 180, 45):
        x = (degrees - begin) % 360 / 360 * 2 * SIDE
        draw.line([x, 0, x, SIDE], fill=(255, 255, 255))
        draw.text((x + 3, SIDE - TEXT - 2), f"{degrees}", fill=(90, 90, 90), font=small)
    for degrees in (-45, 0, 45):
        y = (90 - degrees) / 180 * SIDE
        draw.line([0, y, 2 * SIDE, y], fill=(255, 255, 255))
        draw.text((3, y + 2), f"{degrees}", fill=(90, 90, 90), font=small)
    for x, y, z in coverage.directions:
        across = (math.degrees(math.atan2(y, x)) - begin) % 360 / 360
        _dot(draw, (across * 2 * SIDE, (0.5 - math.asin(min(max(z, -1.0), 1.0)) / math.pi) * SIDE))

    eyes = np.stack([camera.center for camera in cameras])
    local = [(points - coverage.middle) @ coverage.frame for points in (box_corners(bounds), eyes)]
    half = 1.1 * max(np.abs(local[0][:, :2]).max(), np.percentile(np.abs(local[1][:, :2]).max(axis=1), 98))
    x, y = np.meshgrid(_middles(SIDE, -half, half), _middles(SIDE, half, -half))
    level = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3) @ coverage.frame.T + coverage.middle
    plan = Image.fromarray(_count_colors(picture_counts(cameras, level)).reshape(SIDE, SIDE, 3))
    draw = ImageDraw.Draw(plan)
    pixels = [(points[:, :2] * (1, -1) / half + 1.0) * SIDE / 2 for points in local]
    for one in range(8):
        for other in (one ^ 1, one ^ 2, one ^ 4):
            draw.line([*pixels[0][one], *pixels[0][other]], fill=BOX)
    for eye in pixels[1]:
        _dot(draw, eye)

    lines = [
        (
            "left: where cameras stand, seen from the middle, degrees around and above; right: what lies in their "
            f"pictures on the middle's level, from above. Grey: none, orange: under {ENOUGH}, green: {ENOUGH} to "
            f"{MANY} or more"
        ),
        (
            f"seen {coverage.summary()}; {100 * little_seen(cameras, bounds):.0f} % of the box lies in fewer than "
            f"{ENOUGH} pictures"
        ),
    ]
    return captioned([angles, plan], lines, 245)


def _in_picture(camera: Camera, points: np.ndarray) -> np.ndarray:
    """(n,) bool, whether points (n, 3) lie in a camera's picture."""
    pixels, depths = camera.project(points)
    with np.errstate(invalid="ignore"):
        return (depths > 0.0) & ((pixels >= 0.0) & (pixels <= (camera.width, camera.height))).all(axis=1)


def elevations(ways: np.ndarray) -> np.ndarray:
    """(n,) degrees above the horizon of ways (n, 3) of any length, the last axis up."""
    return np.degrees(np.arcsin(np.clip(ways[:, 2] / np.linalg.norm(ways, axis=1), -1, 1)))


def _middles(count: int, begin: float, end: float) -> np.ndarray:
    return begin + (np.arange(count) + 0.5) * (end - begin) / count


def _count_colors(counts: np.ndarray) -> np.ndarray:
    """(n, 3) uint8 colours of numbers of cameras (n,)."""
    share = np.clip((counts - ENOUGH) / (MANY - ENOUGH), 0.0, 1.0)[:, None]
    green = (1.0 - share) * PALE + share * np.array(FULL)
    return np.where(counts[:, None] == 0, NONE, np.where(counts[:, None] < ENOUGH, FEW, green)).astype(np.uint8)


def _dot(draw: Any, place: Sequence[float]) -> None:
    x, y = place
    draw.ellipse([x - 2, y - 2, x + 2, y + 2], fill=CAMERA)
