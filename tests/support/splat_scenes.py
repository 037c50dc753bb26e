"""Splats that tests make."""

import numpy as np

import warpcage


def splats_in_box(device, count=200, half=0.7, scales=(-6.0, -4.0), degree=3, seed=0):
    """Small splats in a cube about the origin."""
    rng = np.random.default_rng(seed)
    return warpcage.SplatField(
        rng.uniform(-half, half, (count, 3)).astype(np.float32),
        rng.uniform(*scales, (count, 3)),
        rng.normal(size=(count, 4)),
        rng.normal(size=count),
        0.2 * rng.normal(size=(count, (degree + 1) ** 2, 3)),
        device=device,
    )


def one_splat(device, center=(0, 0, 0), scales=(0.1, 0.1, 0.1), opacity=0.5, degree=0, quaternion=(1, 0, 0, 0)):
    """One splat of a given opacity."""
    return warpcage.SplatField(
        [center],
        np.log([scales]),
        [quaternion],
        [np.log(opacity / (1 - opacity))],
        np.full((1, (degree + 1) ** 2, 3), 0.3),
        device=device,
    )


def covariances_of(splats):
    """(n, 3, 3) of a Splats."""
    return splats.covariances.numpy()[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3).astype(np.float64)


def drawn(deformer):
    """Row, world centre, covariance and opacity of what a posed Deformer draws."""
    splats = deformer.posed_splats()
    opacities = splats.opacities.numpy()
    seen = np.flatnonzero(opacities > 0.0)
    rows = splats.rows.numpy()[seen] if splats.rows.size else seen
    centers = splats.centers.numpy()[seen].astype(np.float64) + deformer.field.center
    return rows, centers, covariances_of(splats)[seen], opacities[seen]
