"""Splats that tests make, and their view in float64: every splat at every pixel, by the equations alone."""

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


SH_0 = 0.28209479177387814
SH_1 = 0.4886025119029199


def harmonics_basis(d):
    """(n, 16) real spherical harmonics of degree 0 to 3 at unit directions (n, 3), in the order and signs of 3DGS."""
    x, y, z = d.T
    ones = np.ones_like(x)
    return np.stack(
        [
            SH_0 * ones,
            -SH_1 * y,
            SH_1 * z,
            -SH_1 * x,
            np.sqrt(15 / np.pi) / 2 * x * y,
            -np.sqrt(15 / np.pi) / 2 * y * z,
            np.sqrt(5 / np.pi) / 4 * (3 * z * z - 1),
            -np.sqrt(15 / np.pi) / 2 * x * z,
            np.sqrt(15 / np.pi) / 4 * (x * x - y * y),
            -np.sqrt(35 / (2 * np.pi)) / 4 * y * (3 * x * x - y * y),
            np.sqrt(105 / np.pi) / 2 * x * y * z,
            -np.sqrt(21 / (2 * np.pi)) / 4 * y * (5 * z * z - 1),
            np.sqrt(7 / np.pi) / 4 * z * (5 * z * z - 3),
            -np.sqrt(21 / (2 * np.pi)) / 4 * x * (5 * z * z - 1),
            np.sqrt(105 / np.pi) / 4 * z * (x * x - y * y),
            -np.sqrt(35 / (2 * np.pi)) / 4 * x * (x * x - 3 * y * y),
        ],
        axis=1,
    )


def reference_view(
    centers,
    covariances,
    opacities,
    harmonics,
    camera,
    background=(0.0, 0.0, 0.0),
    near=0.01,
    blur=0.3,
    antialias=False,
    turns=None,
):
    """Colour (h, w, 3), opacity (h, w) and depth (h, w) of splats. centres (n, 3), covariances (n, 3, 3), opacities
    (n,), harmonics (n, (degree + 1)^2, 3), turns (n, 3, 3) rotations from rest or None."""
    offset = np.asarray(centers, np.float64) - camera.center
    local = offset @ camera.rotation
    kept = (local[:, 2] >= near) & (np.asarray(opacities) >= 1 / 255)
    index = np.flatnonzero(kept)
    index = index[np.argsort(local[index, 2], kind="stable")]
    offset, local = offset[index], local[index]
    x, y, z = local.T
    distance = np.linalg.norm(offset, axis=1)
    half = 0.5 * np.array([camera.width / camera.fx, camera.height / camera.fy])
    low = -np.array([camera.cx / camera.fx, camera.cy / camera.fy]) - 0.3 * half
    high = low + 2.6 * half
    rim_x, rim_y = np.clip(x / z, low[0], high[0]), np.clip(y / z, low[1], high[1])
    affine = np.zeros((len(z), 3, 3))
    affine[:, 0, 0], affine[:, 0, 2] = camera.fx / z, -camera.fx * rim_x / z
    affine[:, 1, 1], affine[:, 1, 2] = camera.fy / z, -camera.fy * rim_y / z
    affine = affine @ camera.rotation.T
    affine[:, 2] = offset / distance[:, None]
    seen = affine @ np.asarray(covariances, np.float64)[index] @ affine.transpose(0, 2, 1)
    image = seen[:, :2, :2] + blur * np.eye(2)
    strength = np.asarray(opacities, np.float64)[index].copy()
    if antialias:
        strength *= np.sqrt(np.maximum(0, np.linalg.det(seen[:, :2, :2])) / np.linalg.det(image))
    inverse = np.linalg.inv(image)
    slope = np.einsum("nij,nj->ni", inverse, seen[:, :2, 2])
    direction = offset / distance[:, None]
    if turns is not None:
        direction = np.einsum("nji,nj->ni", np.asarray(turns)[index], direction)
    rows = np.asarray(harmonics, np.float64)[index]
    color = np.maximum(0, 0.5 + np.einsum("nb,nbc->nc", harmonics_basis(direction)[:, : rows.shape[1]], rows))

    pixels = np.stack(np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5), -1).reshape(-1, 2)
    center = np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=1)
    left = np.ones(len(pixels))
    total, depth = np.zeros((len(pixels), 3)), np.zeros(len(pixels))
    chunk = max(1, 4_000_000 // len(pixels))
    for begin in range(0, len(z), chunk):
        part = slice(begin, begin + chunk)
        d = pixels[:, None] - center[None, part]
        power = -0.5 * np.einsum("pni,nij,pnj->pn", d, inverse[part], d)
        alpha = np.minimum(0.999, strength[part] * np.exp(power))
        alpha[alpha < 1 / 255] = 0
        kept_light = np.cumprod(1 - alpha, axis=1)
        weight = alpha * left[:, None] * np.hstack([np.ones((len(pixels), 1)), kept_light[:, :-1]])
        total += weight @ color[part]
        depth += (weight * (distance[part] + np.einsum("pni,ni->pn", d, slope[part]))).sum(axis=1)
        left = left * kept_light[:, -1]
    opacity = 1 - left
    shape = (camera.height, camera.width)
    with np.errstate(divide="ignore", invalid="ignore"):
        far = np.where(opacity > 1e-3, depth / opacity, np.inf)
    return (
        (total + left[:, None] * np.asarray(background)).reshape(*shape, 3),
        opacity.reshape(shape),
        far.reshape(shape),
    )
