"""A cage drawn as a wireframe over a picture, in the cage's own depth order."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..core.checks import checked_positive
from ..errors import InputError
from ..mesh.mesh import ClosedMesh
from .camera import Camera

#: Screen distance in pixels between samples of a line.
SPACING = 0.5

#: Samples that share one test of what is in front of them.
SAMPLES_PER_TEST = 4

#: Ray-face pairs tested at once.
CHUNK = 1_000_000


def draw_cage(
    image: ArrayLike,
    camera: Camera,
    cage: ClosedMesh,
    *,
    color: ArrayLike = (1.0, 0.45, 0.0),
    width: float = 1.5,
    opacity: float = 1.0,
    back_opacity: float = 0.25,
    depth: ArrayLike | None = None,
) -> np.ndarray:
    """A picture (h, w, 3) with the edges of a cage over it: opaque in front of the cage's faces, faint behind them.
    `width` in pixels; edges behind `depth` (h, w), distance along the ray as in Frame.depth, are left out."""
    pixels = np.asarray(image)
    if pixels.shape != (camera.height, camera.width, 3):
        raise InputError(f"the picture must be ({camera.height}, {camera.width}, 3) as its camera, got {pixels.shape}")
    if depth is not None and np.shape(depth) != pixels.shape[:2]:
        raise InputError(f"depth must be {pixels.shape[:2]} as the picture, got {np.shape(depth)}")
    checked_positive(width, "the line width")
    paint = np.asarray(color, np.float64)
    if paint.shape != (3,) or not ((paint >= 0) & (paint <= 1)).all():
        raise InputError(f"color must be three numbers in [0, 1], got {paint.tolist()}")
    if not (0 <= opacity <= 1 and 0 <= back_opacity <= 1):
        raise InputError(f"opacities must be in [0, 1], got {opacity} and {back_opacity}")

    front, back = _line_coverage(camera, cage, width, depth)
    scale = 255.0 if pixels.dtype == np.uint8 else 1.0
    drawn = pixels.astype(np.float64) / scale
    for coverage, strength in ((back, back_opacity), (front, opacity)):
        share = strength * coverage[..., None]
        drawn = (1.0 - share) * drawn + share * paint
    drawn = drawn * scale
    return np.round(drawn).astype(np.uint8) if pixels.dtype == np.uint8 else drawn.astype(pixels.dtype)


def _line_coverage(camera: Camera, cage: ClosedMesh, width: float, depth) -> tuple[np.ndarray, np.ndarray]:
    """(h, w) coverage in [0, 1] by edges in front and by edges behind."""
    front = np.zeros((camera.height, camera.width))
    back = np.zeros_like(front)
    local = (cage.vertices - camera.center) @ camera.rotation
    edges = cage.edges
    start, end, kept = _clipped(camera, local[edges[:, 0]], local[edges[:, 1]], cage.size, margin=width + 1.0)
    if not len(kept):
        return front, back
    screen, points, along, owner = _line_samples(camera, start, end)

    tests = np.arange(0, len(points), SAMPLES_PER_TEST) + SAMPLES_PER_TEST // 2
    tests = np.minimum(tests, len(points) - 1)
    hidden = _is_behind_faces(points[tests], edges[kept][owner[tests]], local, cage.faces)
    # a group of samples may span the end of one line and the start of the next, and its test is of one of the two:
    # samples of the other line take the nearest test of their own line where there is one
    group = np.minimum(np.arange(len(points)) // SAMPLES_PER_TEST, len(tests) - 1)
    for shift in (1, -1):
        wrong = owner[tests[group]] != owner
        moved = np.clip(group + shift, 0, len(tests) - 1)
        group = np.where(wrong & (owner[tests[moved]] == owner), moved, group)
    hidden = hidden[group]

    visible = np.ones(len(points), bool)
    if depth is not None:
        row, column = _pixel_of(screen, camera)
        distance = np.linalg.norm(points, axis=1)
        visible = np.asarray(depth)[row, column] > distance - 1e-3 * cage.size
    _splat(front, screen, along, width, visible & ~hidden)
    _splat(back, screen, along, width, visible & hidden)
    return front, np.where(front > 0, np.minimum(back, 1.0 - front), back)


def _clipped(camera, start, end, size, margin):
    """The parts of segments (n, 3), camera axes, that lie before the image plane and within the picture, and the
    segments that they belong to."""
    near = 1e-3 * size
    # half-spaces a . p + b >= 0: the near plane, then the four sides of the picture, `margin` pixels wider
    left, right = camera.cx + margin, camera.width - camera.cx + margin
    top, bottom = camera.cy + margin, camera.height - camera.cy + margin
    planes = [
        ((0, 0, 1), -near),
        ((camera.fx, 0, left), 0.0),
        ((-camera.fx, 0, right), 0.0),
        ((0, camera.fy, top), 0.0),
        ((0, -camera.fy, bottom), 0.0),
    ]
    low, high = np.zeros(len(start)), np.ones(len(start))
    for normal, offset in planes:
        a, b = start @ np.array(normal, float) + offset, end @ np.array(normal, float) + offset
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = a / (a - b)
        low = np.where(a < 0, np.where(b < 0, np.inf, np.maximum(low, crossing)), low)
        high = np.where((b < 0) & (a >= 0), np.minimum(high, crossing), high)
    kept = np.flatnonzero(low < high)
    direction = (end - start)[kept]
    return start[kept] + low[kept, None] * direction, start[kept] + high[kept, None] * direction, kept


def _line_samples(camera, start, end):
    """Samples spaced evenly on screen: screen (m, 2), points (m, 3) in camera axes, unit screen directions (m, 2) and
    the line (m,) of each."""
    a, b = _projected(camera, start), _projected(camera, end)
    length = np.linalg.norm(b - a, axis=1)
    counts = np.maximum(2, np.ceil(length / SPACING).astype(int) + 1)
    owner = np.repeat(np.arange(len(start)), counts)
    first = np.cumsum(counts) - counts
    share = (np.arange(counts.sum()) - first[owner]) / (counts[owner] - 1)
    screen = a[owner] + share[:, None] * (b - a)[owner]
    # evenly on screen is not evenly in space: 1/z is linear on the screen
    inverse = (1 - share) / start[owner, 2] + share / end[owner, 2]
    share_in_space = (share / end[owner, 2]) / inverse
    points = start[owner] + share_in_space[:, None] * (end - start)[owner]
    along = (b - a) / np.maximum(length, 1e-12)[:, None]
    return screen, points, along[owner], owner


def _projected(camera, points):
    """Pixels (n, 2) of points (n, 3) in camera axes."""
    return points[:, :2] / points[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def _pixel_of(screen, camera):
    """Row and column (n,) each of places on screen (n, 2), the nearest in the picture."""
    column = np.clip(np.floor(screen[:, 0]).astype(int), 0, camera.width - 1)
    row = np.clip(np.floor(screen[:, 1]).astype(int), 0, camera.height - 1)
    return row, column


def _is_behind_faces(points, ends, vertices, faces):
    """Whether each point (m, 3) on the edge `ends` (m, 2) has a face, not one of its own, between it and the camera.
    Everything in camera axes, the camera at zero (Moeller and Trumbore 1997)."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    ab, ac = b - a, c - a
    normal = np.cross(ab, ac)
    behind = np.zeros(len(points), bool)
    rows = max(1, CHUNK // max(len(faces), 1))
    for i in range(0, len(points), rows):
        p, edge = points[i : i + rows], ends[i : i + rows]
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = 1.0 / (p @ normal.T)  # (m, f): ray 0 + t p meets the plane at t = a . n / p . n
            t = np.einsum("fi,fi->f", a, normal) * scale
            turned = np.cross(a, p[:, None])  # of the vector from a to the camera, -a, turned by the ray
            u = np.einsum("mfi,fi->mf", turned, ac) * scale
            v = -np.einsum("mfi,fi->mf", turned, ab) * scale
            # strictly before the point, so that faces that only touch it do not hide it
            hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < 1 - 1e-6)
        own = (faces[None] == edge[:, :1, None]).any(-1) & (faces[None] == edge[:, 1:, None]).any(-1)
        behind[i : i + rows] = (hit & ~own).any(axis=1)
    return behind


def _splat(coverage, screen, along, width, chosen):
    """Raise `coverage` (h, w) to that of a line of some width, pixels, around the chosen samples."""
    screen, along = screen[chosen], along[chosen]
    reach = int(np.ceil(0.5 * width + 0.5))
    base = np.floor(screen).astype(int)
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            pixel = base + (dx, dy)
            offset = pixel + 0.5 - screen
            beyond = np.maximum(np.abs((offset * along).sum(axis=1)) - 0.5 * SPACING, 0.0)
            across = offset[:, 0] * along[:, 1] - offset[:, 1] * along[:, 0]
            share = np.clip(0.5 * width + 0.5 - np.hypot(across, beyond), 0.0, 1.0) * min(1.0, width)
            inside = (pixel >= 0).all(axis=1) & (pixel[:, 0] < coverage.shape[1]) & (pixel[:, 1] < coverage.shape[0])
            inside &= share > 0
            np.maximum.at(coverage, (pixel[inside, 1], pixel[inside, 0]), share[inside])
