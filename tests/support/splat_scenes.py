"""Splats that tests make, and their view in float64: every splat at every pixel, by the equations alone."""

import dataclasses
import os
import pathlib

import numpy as np
import pytest
from field_oracles import basis

import warpcage
from warpcage import Scene, SplatField, turntable
from warpcage.splats import SplatContents


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


def ball_of_splats(size=0.03):
    """400 round splats on a sphere of radius 0.5, red above and blue below."""
    places = np.random.default_rng(0).normal(size=(400, 3))
    places *= 0.5 / np.linalg.norm(places, axis=1, keepdims=True)
    colors = np.where(places[:, 2:] > 0, [1.5, -1.5, -1.5], [-1.5, -1.5, 1.5])[:, None]
    turns, sizes = np.tile([1.0, 0.0, 0.0, 0.0], (400, 1)), np.full((400, 3), np.log(size))
    return SplatField(places, sizes, turns, np.full(400, 3.0), colors, up=(0, 0, 1))


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


#: Files of other programs.
DATA = pathlib.Path(os.environ.get("WARPCAGE_DATA", "../shared/data")) / "splats"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"no data in {DATA} (set WARPCAGE_DATA)")

#: What a field holds of each splat, in the order that fields are made of.
VALUES = ("centers", "log_scales", "quaternions", "logits", "harmonics")


def joined(field, *others, **options):
    """A field with the splats of others after its own; others: fields, or each of their values."""
    parts = [[getattr(each.contents, name) for name in VALUES] if isinstance(each, SplatField) else each
             for each in (field, *others)]  # fmt: skip
    return SplatField(*map(np.concatenate, zip(*parts, strict=True)), up=field.up, device=field.device, **options)


def field_of(contents):
    """A field on the CPU."""
    return SplatField.from_contents(contents, device="cpu")


def loaded(path, **options):
    """A file's field on the CPU."""
    return SplatField.load(path, device="cpu", **options)


def zstd():
    """What packs by zstd: a library, or Python's own."""
    try:
        return pytest.importorskip("compression.zstd").compress
    except pytest.skip.Exception:
        return pytest.importorskip("zstandard").ZstdCompressor().compress


def require_usd():
    """Skip without a usd-core that has splats."""
    if not hasattr(pytest.importorskip("pxr.UsdVol"), "ParticleField3DGaussianSplat"):
        pytest.skip("usd-core has no splats before 26.3", allow_module_level=True)


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


#: What a splat of the place belongs to.
FLOOR, WALL, TABLE, CUP, BALL, FLOATER = range(6)

#: Where the place's table top and its floaters are, and the cup's middle, radius and height.
TABLE_TOP, FLOATERS, CUP_AT, CUP_RADIUS, CUP_HEIGHT = 0.7, ((-1.2, 1.0, 1.6), (1.1, -1.3, 1.2)), (0.2, 0.1), 0.09, 0.22


def place(device="cpu", spacing=1.0, seed=0, faint=50):
    """A room of 5 x 5 x 2.5 with a table, a cup on it, a ball on the floor, and floaters in the air; (field, labels).
    spacing: of the splats, as a share of the usual one; faint: splats that nobody sees, labelled FLOATER."""
    rng = np.random.default_rng(seed)
    parts = []

    def sheet(label, origin, along, across, step, color, bump=0.0):
        """Flat splats over a parallelogram."""
        origin, along, across = (np.asarray(each, float) for each in (origin, along, across))
        counts = [max(2, round(np.linalg.norm(each) / (spacing * step))) for each in (along, across)]
        u, v = (np.indices(counts).reshape(2, -1) + 0.5) / np.array(counts)[:, None]
        normal = np.cross(along, across)
        normal /= np.linalg.norm(normal)
        centers = origin + u[:, None] * along + v[:, None] * across
        add(label, centers, np.broadcast_to(normal, centers.shape), spacing * step, color, bump)

    def add(label, centers, normals, step, color, bump=0.0):
        """Splats as flat as paint, which turn towards normals."""
        centers = centers + bump * rng.normal(size=(len(centers), 1)) * normals
        half = normals + [0.0, 0.0, 1.0 + 1e-9]  # the turn that takes z to the normal: half way between both
        half = np.where(np.linalg.norm(half, axis=1, keepdims=True) < 1e-6, [1.0, 0.0, 0.0], half)
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        turn = np.concatenate([half[:, 2:], np.stack([-half[:, 1], half[:, 0], 0 * half[:, 0]], axis=1)], axis=1)
        scales = step * rng.uniform(0.6, 0.9, (len(centers), 3)) * [1.0, 1.0, 0.15]
        parts.append((np.full(len(centers), label), centers, scales, turn, np.tile(color, (len(centers), 1))))

    half, tall, t = 2.5, 2.5, TABLE_TOP
    sheet(FLOOR, (-half, -half, 0), (2 * half, 0, 0), (0, 2 * half, 0), 0.1, (0.4, 0.4, 0.5), 0.004)
    sheet(WALL, (-half, half, 0), (2 * half, 0, 0), (0, 0, tall), 0.12, (0.8, 0.8, 0.7), 0.004)
    sheet(WALL, (-half, -half, 0), (0, 2 * half, 0), (0, 0, tall), 0.12, (0.7, 0.8, 0.8), 0.004)
    sheet(TABLE, (-0.6, -0.4, t), (1.2, 0, 0), (0, 0.8, 0), 0.035, (0.6, 0.4, 0.2), 0.002)
    sheet(TABLE, (-0.6, -0.4, t - 0.06), (0, 0.8, 0), (1.2, 0, 0), 0.05, (0.6, 0.4, 0.2))
    for x, y in ((-0.55, -0.35), (0.5, -0.35), (-0.55, 0.3), (0.5, 0.3)):
        for dx, dy, *along in ((0, 0, 0.06, 0), (0, 0.06, 0.06, 0), (0, 0, 0, 0.06), (0.06, 0, 0, 0.06)):
            sheet(TABLE, (x + dx, y + dy, 0), (*along, 0), (0, 0, t - 0.06), 0.03, (0.5, 0.3, 0.1))
    angles = np.arange(0, 2 * np.pi, spacing * 0.016 / CUP_RADIUS)
    heights = np.arange(0.005, CUP_HEIGHT, spacing * 0.016)
    a, h = (each.ravel() for each in np.meshgrid(angles, heights))
    out = np.stack([np.cos(a), np.sin(a), 0 * a], axis=1)
    wall = out * CUP_RADIUS + np.stack([0 * a, 0 * a, t + h], axis=1) + [*CUP_AT, 0]
    add(CUP, wall, out, spacing * 0.016, (0.8, 0.1, 0.1))
    disc = rng.uniform(-1, 1, (int(400 / spacing**2), 2))
    disc = CUP_RADIUS * disc[np.hypot(*disc.T) < 1]
    top = np.concatenate([disc + CUP_AT, np.full((len(disc), 1), t + CUP_HEIGHT)], axis=1)
    add(CUP, top, np.tile([0.0, 0.0, 1.0], (len(top), 1)), spacing * 0.016, (0.9, 0.2, 0.1))
    around = rng.normal(size=(int(1500 / spacing**2), 3))
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    add(BALL, 0.3 * around + [1.5, 1.2, 0.3], around, 0.03 * spacing, (0.1, 0.2, 0.8))
    for middle in FLOATERS:
        cloud = np.array(middle) + 0.02 * rng.normal(size=(12, 3))
        add(FLOATER, cloud, np.tile([0.0, 0.0, 1.0], (12, 1)), 0.03, (0, 0, 0))
    label, centers, scales, turns, colors = (np.concatenate(each) for each in zip(*parts, strict=True))
    logits = rng.uniform(2.0, 4.0, len(centers))
    if faint:
        label = np.concatenate([label, np.full(faint, FLOATER)])
        centers = np.concatenate([centers, rng.uniform([-2, -2, 0.2], [2, 2, 2], (faint, 3))])
        scales = np.concatenate([scales, np.full((faint, 3), 0.02)])
        turns = np.concatenate([turns, np.eye(4)[[0] * faint]])
        colors, logits = np.concatenate([colors, np.zeros((faint, 3))]), np.concatenate([logits, np.full(faint, -7.0)])
    harmonics = ((colors - 0.5) / SH_0)[:, None]
    up = (0.0, 0.0, 1.0)
    return warpcage.SplatField(centers, np.log(scales), turns, logits, harmonics, up=up, device=device), label


def place_camera(eye=(1.6, -1.5, 1.7), target=(0.2, 0.1, 0.8), size=160):
    """A camera in the place, which sees the cup on its table."""
    return warpcage.Camera.look_at(eye, target, up=(0, 0, 1), fov_degrees=50, width=size, height=size)


SH_0 = 0.28209479177387814
SH_1 = 0.4886025119029199


def reference_view(
    centers, covariances, opacities, harmonics, camera, background=(0, 0, 0), near=0.01, blur=0.3, antialias=False,
    turns=None,
):  # fmt: skip
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
    color = np.maximum(0, 0.5 + np.einsum("nb,nbc->nc", basis(direction, round(rows.shape[1] ** 0.5)), rows))

    pixels = np.stack(np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5), -1).reshape(-1, 2)
    center = np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=1)
    left = np.ones(len(pixels))
    total, depth = np.zeros((len(pixels), 3)), np.zeros(len(pixels))
    chunk = max(1, 4_000_000 // len(pixels))
    for begin in range(0, len(z), chunk):
        part = slice(begin, begin + chunk)
        (right, down), ((xx, xy), (yx, yy)) = (pixels[:, None] - center[part]).transpose(2, 0, 1), inverse[part].T
        power = -0.5 * (xx * right**2 + (xy + yx) * right * down + yy * down**2)
        alpha = np.minimum(0.999, strength[part] * np.exp(power))
        alpha[alpha < 1 / 255] = 0
        kept_light = np.cumprod(1 - alpha, axis=1)
        weight = alpha * left[:, None] * np.hstack([np.ones((len(pixels), 1)), kept_light[:, :-1]])
        total += weight @ color[part]
        depth += (weight * (distance[part] + right * slope[part, 0] + down * slope[part, 1])).sum(axis=1)
        left = left * kept_light[:, -1]
    opacity = 1 - left
    shape = (camera.height, camera.width)
    with np.errstate(divide="ignore", invalid="ignore"):
        far = np.where(opacity > 1e-3, depth / opacity, np.inf)
    color = total + left[:, None] * np.asarray(background)
    return color.reshape(*shape, 3), opacity.reshape(shape), far.reshape(shape)


def true_field(device, count=250, background="black"):
    """Splats about (3, 2, 1) that fits are to find again."""
    rng = np.random.default_rng(0)
    return SplatField(
        rng.uniform(-1, 1, (count, 3)) + (3, 2, 1),
        np.log(0.1) + 0.3 * rng.normal(size=(count, 3)),
        rng.normal(size=(count, 4)),
        2 + rng.normal(size=count),
        0.3 * rng.normal(size=(count, 4, 3)),
        background=background,
        device=device,
    )


def ring(count, elevation, size=(72, 60)):
    """Cameras around them."""
    return turntable((3, 2, 1), 4.0, elevation, count, width=size[0], height=size[1])


def scene_of(field, cameras, *, alphas=False, points=None):
    """A scene of a field's views."""
    frames = [field.render(camera) for camera in cameras]
    opacity = np.stack([frame.alpha for frame in frames]) if alphas else None
    images = np.stack([frame.rgb for frame in frames])
    scene = Scene(images, opacity, cameras, background=field.background)
    return scene if points is None else dataclasses.replace(scene, points=points)


def held_out_psnr(field, truth):
    """PSNR of a fit in views between the rings."""
    return float(np.mean([row["psnr"] for row in warpcage.evaluate(field, scene_of(truth, ring(6, 5)))]))


def some_splats(count=300, degree=3, seed=0, antialias=False):
    """Values of splats as files have them."""
    rng = np.random.default_rng(seed)
    return SplatContents(
        rng.uniform(-2.0, 2.0, (count, 3)).astype(np.float32),
        rng.uniform(-6.0, -2.0, (count, 3)).astype(np.float32),
        (rng.normal(size=(count, 4)) * rng.uniform(0.2, 5.0, (count, 1))).astype(np.float32),
        rng.uniform(-4.0, 4.0, count).astype(np.float32),
        rng.uniform(-0.5, 0.5, (count, (degree + 1) ** 2, 3)).astype(np.float32),
        antialias=antialias,
    )
