"""Gaussian splats that look like a voxel field: one a voxel that can be seen."""

from __future__ import annotations

import itertools

import numpy as np

from ...core.checks import checked_whole, require_type
from ...errors import InputError
from ...field.io.field_file import rgb_harmonics
from ...field.sparse import harmonics_on_host, stored_harmonics
from ...field.voxel_field import VoxelField
from ...select.selection import visible_rows
from ...splats.io.contents import MIN_OPACITY
from ...splats.splat_field import SplatField

#: Standard deviation of a splat in sides of its voxel: that of trilinear weights is 1 / sqrt(6) = 0.41. Of 0.3 to 0.6
#: the best for fog and for fitted fields, both as they are drawn and antialiased.
SPREAD = 0.4

#: Where the density of a voxel is looked up, in sides from its centre along each axis: between nodes it may be less
#: than at them, where neighbours are negative (a fitted field gained 2 dB).
ASIDE = 0.25

#: Greatest opacity of a splat.
MAX_OPACITY = 0.995

#: Matter of at least this optical depth a voxel hides what is so many voxels and more inside it.
SOLID_DEPTH, HIDING_VOXELS = 1.0, 4


def to_splats(field: VoxelField, *, most: int = 200_000, seed: int = 0) -> SplatField:
    """Gaussian splats that look like a voxel field, without a fit.

    Each voxel that can be seen becomes a splat at its centre: with a standard deviation of 0.4 of its side, the optical
    depth of its matter, and its colour with all harmonics. Edges are somewhat softer than the field's: a fit
    (`fit_splats`) sharpens them. Layers and outer fields around a field are left out, and matter too faint to be drawn
    as splats, of opacities below 1 / 255. Where voxels are about as large as pixels, draw the splats with
    `antialias=True`: what is added to small ones otherwise makes them denser.

    Args:
        field: The voxels.
        most: Most splats, at least 1. Where more voxels can be seen, a random sample of that size becomes splats,
            enlarged to cover as much.
        seed: Seed of that sample, a whole number of at least 0.

    Returns:
        The splats, in the coordinates of the field, with its background, `up` and device; of degree 2, or 3 of a field
        with luminance and differences of colour.

    Raises:
        ValueError: For another kind of field, one without anything that can be seen, and options out of range.
    """
    require_type(field, VoxelField, "to_splats needs")
    most, random = checked_whole(most, "most", 1), np.random.default_rng(checked_whole(seed, "the seed", 0))
    links = field.host_links()
    side = float(np.prod(field.voxel_size) ** (1.0 / 3.0))
    seen = visible_rows(field)
    if field.weights is None:
        seen = seen & ~_hidden_rows(links, field.stored.density.numpy() * side)
    cells = np.argwhere(links >= 0)
    cells = cells[seen[links[tuple(cells.T)]]]
    centers = field.bounds[0] + (cells + 0.5) * field.voxel_size
    opacities = _opacities(_mean_densities(field, centers) * side)
    chosen = np.flatnonzero(opacities >= MIN_OPACITY)
    if not len(chosen):
        raise InputError("the field has nothing that can be seen: no splats can be made of it")
    larger = max(1.0, np.sqrt(len(chosen) / most))  # what is seen is a surface
    if len(chosen) > most:
        chosen = np.sort(random.choice(chosen, most, replace=False))
    opacities = np.minimum(opacities[chosen], MAX_OPACITY)
    quaternions = np.zeros((len(chosen), 4), np.float32)
    quaternions[:, 0] = 1.0
    return SplatField(
        centers[chosen],
        np.broadcast_to(np.log(SPREAD * larger * field.voxel_size), (len(chosen), 3)),
        quaternions,
        np.log(opacities) - np.log1p(-opacities),
        rgb_harmonics(harmonics_on_host(stored_harmonics(field.stored))[links[tuple(cells[chosen].T)]], 16),
        background=field.background,
        up=field.up,
        device=field.device,
    )


def _mean_densities(field: VoxelField, centers: np.ndarray) -> np.ndarray:
    """The mean density (n,) float64 in voxels with these centres (n, 3), per world unit."""
    total, along = np.zeros(len(centers)), np.broadcast_to(np.array([0.0, 0.0, 1.0], np.float32), centers.shape)
    for sign in itertools.product((-ASIDE, ASIDE), repeat=3):
        total += field.sample(centers + sign * field.voxel_size, along)[1]
    return total / 8.0


def _opacities(depths: np.ndarray) -> np.ndarray:
    """Opacities (n,) of splats on a lattice that together have an optical depth (n,) a spacing, in the mean."""
    # The integral of -ln(1 - o exp(-r^2 / (2 s^2))) over the plane is 2 pi s^2 Li2(o), by its series; SciPy calls
    # Li2(o) spence(1 - o).
    from scipy.special import spence

    table = np.linspace(0.0, 1.0, 4097)
    return np.interp(depths / (2.0 * np.pi * SPREAD**2), spence(1.0 - table), table)


def _hidden_rows(links: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """Which rows lie deep in solid matter; links (nx, ny, nz), optical depths (rows,) across a voxel."""
    from scipy.ndimage import binary_erosion

    solid = np.zeros(links.shape, bool)
    solid[links >= 0] = depths[links[links >= 0]] >= SOLID_DEPTH
    hidden = np.zeros(len(depths), bool)
    inner = np.asarray(binary_erosion(solid, iterations=HIDING_VOXELS), bool)
    hidden[links[np.nonzero(inner)]] = True
    return hidden
