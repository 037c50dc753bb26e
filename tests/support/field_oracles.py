"""Float64 NumPy versions of the voxel field's formulas, written plainly."""

import numpy as np
import pytest

#: Harmonics of red, green and blue, and of luminance with differences of colour.
both_kinds = pytest.mark.parametrize("numbers", [(9, 3), (24,)], ids=["rgb", "luminance"])


def random_field(
    device,
    resolution=(7, 6, 8),
    seed=0,
    keep=0.5,
    bounds=((-1.0, -0.6, -0.8), (1.1, 1.2, 1.6)),
    density_scale=3.0,
    numbers=(9, 3),
):
    """A VoxelField with random values at a random share of its nodes, and its dense float64 arrays.

    numbers: (9, 3) harmonics of red, green and blue, or (24,) of luminance and differences of colour.
    """
    from warpcage import VoxelField

    random = np.random.default_rng(seed)
    mask = random.random(resolution) < keep
    links = np.full(resolution, -1, np.int32)
    links[mask] = np.arange(mask.sum())
    density = random.normal(0.5, 1.0, mask.sum()) * density_scale
    sh = random.normal(0, 0.4, (mask.sum(), *numbers))
    field = VoxelField(bounds, links, density, sh, device=device)
    dense_density, dense_sh = np.zeros(resolution), np.zeros((*resolution, *numbers))
    dense_density[mask], dense_sh[mask] = density.astype(np.float32), sh.astype(np.float32)
    return field, dense_density, dense_sh


def basis(directions, degrees=3):
    """(n, degrees^2) real spherical harmonics from their definition by associated Legendre functions, svox2's signs."""
    from scipy.special import sph_harm_y

    theta = np.arccos(np.clip(directions[:, 2], -1, 1))
    phi = np.arctan2(directions[:, 1], directions[:, 0])
    columns = []
    for degree in range(degrees):
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), theta, phi)
            # SciPy's complex harmonics carry the Condon-Shortley phase; svox2's real ones keep that sign
            if order < 0:
                columns.append(np.sqrt(2) * value.imag)
            elif order == 0:
                columns.append(value.real)
            else:
                columns.append(np.sqrt(2) * value.real)
    return np.stack(columns, axis=-1)


def colors(sh, directions):
    """(n, 3) colours before the clamp of rows (n, 9, 3), or (n, 24) of Y, O and G: Y + O - G/2, Y + G, Y - O - G/2."""
    if sh.ndim == 3:
        return np.einsum("nbc,nb->nc", sh, basis(directions)) + 0.5
    functions = basis(directions, 4)
    y = (sh[:, :16] * functions).sum(axis=1)
    orange, green = ((sh[:, first : first + 4] * functions[:, :4]).sum(axis=1) for first in (16, 20))
    return np.stack([y + orange - green / 2, y + green, y - orange - green / 2], axis=1) + 0.5


def interpolate(dense, node_coordinates):
    """Trilinear values (n, ...) of a dense array at node coordinates (n, 3), zero outside the nodes' box."""
    shape = np.array(dense.shape[:3])
    low = np.floor(node_coordinates).astype(int)
    inside = ((low >= 0) & (low < shape - 1)).all(axis=1)
    fraction = node_coordinates - low
    low = np.where(inside[:, None], low, 0)
    total = np.zeros((len(low), *dense.shape[3:]))
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(np.array(corner) == 1, fraction, 1 - fraction), axis=1)
        at = low + corner
        values = dense[at[:, 0], at[:, 1], at[:, 2]]
        total += (weight * inside).reshape(-1, *[1] * (values.ndim - 1)) * values
    return total


def sample(field, density, sh, points, directions):
    g = (points - field.bounds[0]) / field.voxel_size - 0.5
    color = colors(interpolate(sh, g), directions)
    return np.maximum(color, 0), np.maximum(interpolate(density, g), 0)


def render_ray(field, density, sh, origin, direction, step, background, length=20.0):
    """(rgb, alpha, depth) of one ray by brute force: every sample t_k = (k + 1/2) step up to `length`."""
    t = (np.arange(int(length / step)) + 0.5) * step
    points = origin + t[:, None] * direction
    color, sigma = sample(field, density, sh, points, np.broadcast_to(direction, points.shape))
    alpha = 1 - np.exp(-sigma * step)
    transmittance = np.concatenate([[1], np.cumprod(1 - alpha)])
    weight = transmittance[:-1] * alpha
    rgb = weight @ color + transmittance[-1] * np.asarray(background)
    opacity = 1 - transmittance[-1]
    return rgb, opacity, weight @ t / opacity if opacity > 1e-3 else np.inf
