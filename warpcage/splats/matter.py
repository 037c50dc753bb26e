"""Where the matter of splats lies: which are in nodes of a grid, where a ray meets them, how fine a grid may be."""

from __future__ import annotations

import hashlib

import numpy as np

from .io.contents import LEAST_OPACITY
from .render import IMAGE_BLUR

#: Standard deviations from its centre, along its axes, at which a splat is looked at beside its centre.
PROBE = 1.0

#: Share of those places that must be in chosen nodes, where the centre itself is not.
MOST_OF_IT = 0.5

#: Standard deviations to which a ray meets a splat.
REACH = 3.0

#: The share of the light at which a ray's end is, and the opacity at which a splat counts as whole.
HALF, OPAQUE = 0.5, 0.999

#: Sides of nodes below this share of the median size of splats show their gaps.
FINEST_SHARE = 0.5


def in_nodes(centers: np.ndarray, factors: np.ndarray, mask: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Which splats have their centre, or most of what lies around it, in nodes of a mask (nx, ny, nz) bool; (n,) bool.
    centers (n, 3); factors (n, 3, 3): axes times standard deviations, a column each; bounds (2, 3) of the mask."""
    size = (bounds[1] - bounds[0]) / mask.shape
    middle = centers.astype(np.float64) - bounds[0]

    def inside(places: np.ndarray) -> np.ndarray:
        cells = np.floor(places / size)
        within = ((cells >= 0) & (cells < mask.shape)).all(axis=1)
        found = np.zeros(len(places), bool)
        found[within] = mask[tuple(cells[within].astype(np.int64).T)]
        return found

    centre = inside(middle)
    hits = centre.astype(np.int64)
    for axis in range(3):
        step = PROBE * factors[:, :, axis]
        hits += inside(middle + step).astype(np.int64) + inside(middle - step)
    return centre | (hits > 7 * MOST_OF_IT)


def half_light(
    centers: np.ndarray,
    covariances: np.ndarray,
    opacities: np.ndarray,
    origin: np.ndarray,
    direction: np.ndarray,
    spread: float,
    near: float,
) -> float:
    """Distance along a ray, unit direction (3,), at which half of its light is gone; infinite where it is not.
    spread: width of its pixel at distance 1; near: splats less than this ahead are not drawn."""
    offset = centers.astype(np.float64) - origin
    ahead = offset @ direction
    beside = np.linalg.norm(offset - ahead[:, None] * direction, axis=1)
    reach = REACH * (np.sqrt(np.einsum("nii->n", covariances)) + spread * np.abs(ahead))
    rows = np.flatnonzero((opacities >= LEAST_OPACITY) & (ahead > near) & (beside <= reach))
    blur = IMAGE_BLUR * (spread * ahead[rows]) ** 2
    least = 1e-12 * np.einsum("nii->n", covariances[rows])  # a flat splat has an inverse too
    wide = covariances[rows] + (blur + least)[:, None, None] * np.eye(3)
    turned = np.linalg.solve(wide, np.broadcast_to(direction[:, None], (len(rows), 3, 1)))[..., 0]
    across = turned @ direction
    distance = np.einsum("ni,ni->n", turned, offset[rows]) / across
    rest = offset[rows] - distance[:, None] * direction
    far = np.einsum("ni,ni->n", rest, np.linalg.solve(wide, rest[..., None])[..., 0])
    alpha = np.minimum(OPAQUE, opacities[rows] * np.exp(-0.5 * far))
    drawn = np.flatnonzero((alpha >= LEAST_OPACITY) & (distance > 0.0))
    order = drawn[np.argsort(distance[drawn], kind="stable")]
    gone = np.flatnonzero(np.cumprod(1.0 - alpha[order]) <= HALF)
    return float(distance[order[gone[0]]]) if len(gone) else np.inf


def finest_side(log_scales: np.ndarray) -> float:
    """The smallest side of a node at which splats, log_scales (n, 3), hang together, world units; 0 without splats."""
    if not len(log_scales):
        return 0.0
    return FINEST_SHARE * float(np.exp(np.median(log_scales.astype(np.float64).max(axis=1))))


def splat_digest(centers: np.ndarray, logits: np.ndarray) -> str:
    """32 hexadecimal digits of centers (n, 3) and opacities as logits (n,), which tell a field from others."""
    hashed = hashlib.blake2b(np.ascontiguousarray(centers, np.float32).tobytes(), digest_size=16)
    hashed.update(np.ascontiguousarray(logits, np.float32).tobytes())
    return hashed.hexdigest()
