"""What frames differ from pictures by: the loss and its slopes against float64 sums over windows of pixels."""

from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from warpcage import Camera, PoseTargets
from warpcage.pose_fits.targets import PictureLoss

UNIT, BEHIND, WIDTH, HEIGHT = 1.7, 0.02, 11, 7
CAMERAS = [Camera.look_at(eye, (0, 0, 0), width=WIDTH, height=HEIGHT) for eye in ((3, 0, 1), (0, 3, 1))]


def random_parts(seed, far):
    """Colours, opacities, and depths, of which some are not there."""
    random = np.random.default_rng(seed)
    depth = np.where(random.random((2, HEIGHT, WIDTH)) < 0.3, far, 2.5 + 0.3 * random.random((2, HEIGHT, WIDTH)))
    parts = random.random((2, HEIGHT, WIDTH, 3)), random.random((2, HEIGHT, WIDTH)), depth
    return dict(zip(("rgb", "alpha", "depth"), (part.astype(np.float32) for part in parts), strict=True))


def on_device(name, part, device):
    """A part of two frames, (2 * h * w,)."""
    rows = part.reshape(2 * HEIGHT * WIDTH, *part.shape[3:])
    return wp.array(rows, dtype=wp.vec3 if name == "rgb" else wp.float32, device=device)


def window_sums(values, blur):
    """Pictures (n, h, w, ...) blurred by a Gaussian of whole windows, nothing around them."""
    if not blur:
        return values
    reach = int(4 * blur + 0.5)
    k = np.arange(-reach, reach + 1)
    weights = np.exp(-(k[:, None] ** 2 + k**2) / (2 * blur**2))
    padded = np.pad(values, [(0, 0), (reach, reach), (reach, reach)] + [(0, 0)] * (values.ndim - 3))
    h, w = values.shape[1:3]
    windows = (weights[i, j] * padded[:, i : i + h, j : j + w] for i in range(len(k)) for j in range(len(k)))
    return sum(windows) / weights.sum()


def expected_loss(frames, targets, weights, names, blur):
    """The documented loss in float64; depths alone ask for an opaque pixel where they are known."""
    rho = lambda d, s: 2 * s**2 * (np.sqrt(1 + (d / s) ** 2) - 1)  # noqa: E731
    loss, known = 0.0, np.isfinite(targets["depth"])
    if "rgb" in names:
        loss += (weights[..., None] / 3 * rho(window_sums(frames["rgb"] - targets["rgb"], blur), 0.15)).sum()
    if "alpha" in names:
        loss += (0.5 * weights * rho(window_sums(frames["alpha"] - targets["alpha"], blur), 0.15)).sum()
    elif "depth" in names:
        loss += (0.5 * weights * known * rho(window_sums(frames["alpha"] - 1, blur), 0.15)).sum()
    if "depth" in names:
        both = known & np.isfinite(frames["depth"])
        off = np.where(both, frames["depth"] - BEHIND, 0) - np.where(both, targets["depth"], 0)
        off = frames["alpha"] * off / UNIT
        loss += (20 * weights * off**2 / (1 + (off / (0.03 * (1 + blur))) ** 2)).sum()
    return loss / (targets if "alpha" in names else frames)["alpha"].sum()


@pytest.mark.parametrize("blur", [0.0, 0.7, 1.5])
@pytest.mark.parametrize("names", ["rgb", "rgb alpha", "depth", "rgb alpha depth"])
def test_loss_and_slopes_are_those_of_float64(names, blur, device):
    frames, targets = random_parts(0, np.inf), random_parts(1, np.nan)
    weights = np.random.default_rng(2).random((2, HEIGHT, WIDTH)).astype(np.float32)
    given = {f"{'image' if name == 'rgb' else name}s": targets[name] for name in names.split()}
    loss = PictureLoss(PoseTargets(CAMERAS, weights=weights, **given), WIDTH, blur, UNIT, wp.get_device(device), BEHIND)
    losses, slopes = loss.compared({name: on_device(name, part, device) for name, part in frames.items()})
    wide = [{name: part.astype(float) for name, part in parts.items()} for parts in (frames, targets)]
    scale = wide[0]["alpha"].sum()

    def value(changed):
        sums = expected_loss({**wide[0], **changed}, wide[1], weights, names, blur)
        # the share of pixels that are covered is that of the first frames
        return sums if "alpha" in names else sums * {**wide[0], **changed}["alpha"].sum() / scale

    assert losses.numpy().sum() == pytest.approx(value({}), rel=1e-5)
    assert set(slopes) == set(names.split()) | ({"alpha"} if "depth" in names else set())
    for name, found in slopes.items():
        for seed in range(3):
            change = 1e-5 * np.random.default_rng(seed).normal(size=frames[name].shape)
            there, back = (value({name: wide[0][name] + sign * change}) for sign in (1, -1))
            slope = (found.numpy().reshape(change.shape) * change).sum()
            assert slope == pytest.approx((there - back) / 2, rel=1e-4, abs=1e-9)


def test_differences_are_roots_of_the_loss(device):
    """Of small differences, none of which counts linearly."""
    frames, targets = random_parts(0, np.inf), random_parts(0, np.inf)
    arrays = {"rgb": frames["rgb"] + np.float32(1e-3), "alpha": frames["alpha"], "depth": frames["depth"]}
    drawn = SimpleNamespace(arrays={name: on_device(name, part, device) for name, part in arrays.items()})
    deformer = SimpleNamespace(render=lambda cameras, **_: drawn)
    given = PoseTargets(CAMERAS, images=targets["rgb"], alphas=targets["alpha"])
    loss = PictureLoss(given, WIDTH, 0.7, UNIT, wp.get_device(device))
    off = loss.differences(deformer)
    assert (off**2).sum() == pytest.approx(loss(deformer, with_gradient=False)[0], rel=1e-3) and off.max() > 1e-5
    assert len(off) == 2 * HEIGHT * WIDTH * 4
