"""Small fits: what they find, what they refuse, and how they go on."""

import subprocess
import sys

import numpy as np
import pytest
import warp as wp
from fit_oracles import finished
from refusals import refused
from runs import SUPPORT
from scenes import blob_scene

import warpcage
from warpcage import FieldOptimizer, evaluate, mean_psnr, psnr
from warpcage.core import resolve_device
from warpcage.fitting import PictureRays, error_image, load_progress, object_bounds, save_progress, ssim
from warpcage.fitting.level import Level
from warpcage.view.camera import camera_array

SMALL = {"resolution": 32, "levels": 2, "epochs": 8, "batch_rays": 512}


@pytest.mark.parametrize(
    "scale, offset, with_alpha", [(1.0, (0, 0, 0), True), (10.0, (40, -30, 5), True), (1.0, (0, 0, 0), False)]
)
def test_fit_finds_what_was_rendered(request, device, scale, offset, with_alpha):
    if not with_alpha:
        request.getfixturevalue("two_threads")
    scene = blob_scene(count=24, size=32, scale=scale, offset=offset, with_alpha=with_alpha, device=device)
    held, rest = [4, 17], [i for i in range(24) if i not in (4, 17)]
    alphas = scene.alphas[rest] if with_alpha else None
    train = warpcage.Scene(scene.images[rest], alphas, [scene.cameras[i] for i in rest])
    test = warpcage.Scene(scene.images[held], None, [scene.cameras[i] for i in held])
    field = warpcage.fit(train, device=device, progress=False, **SMALL)
    assert mean_psnr(evaluate(field, test)) > 26
    # the box of the object, in world units: (-5/12 .. 5/12, -1/3 .. 1/3, -1/2 .. 1/2) * scale + offset
    solid = field.node_densities() > 5.0 / scale
    corners = np.argwhere(solid)
    low = field.bounds[0] + corners.min(axis=0) * field.voxel_size
    high = field.bounds[0] + (corners.max(axis=0) + 1) * field.voxel_size
    half = scale * np.array([5 / 12, 1 / 3, 1 / 2])
    if with_alpha:
        np.testing.assert_allclose(low, offset - half, atol=0.2 * scale)
        np.testing.assert_allclose(high, offset + half, atol=0.2 * scale)
    assert field.node_weights().max() > 0.05


def test_fit_is_deterministic_on_the_cpu(two_threads):
    scene = blob_scene(count=6, size=24, device="cpu")
    options = {"device": "cpu", "progress": False, "resolution": 24, "levels": 2, "epochs": 2, "batch_rays": 512}
    grids = [warpcage.fit(scene, seed=seed, **options).grid for seed in (3, 3, 4)]
    for name in ("density", "sh"):
        one, same, other = (getattr(grid, name).numpy() for grid in grids)
        np.testing.assert_array_equal(one, same)
        assert one.shape != other.shape or (one != other).any()


def test_bounds_hold_the_object():
    scene = blob_scene(count=10, offset=(1.0, 2.0, -0.5))
    box = object_bounds(scene, resolve_device())
    half = np.array([5 / 12, 1 / 3, 1 / 2])
    center = np.array([1.0, 2.0, -0.5])
    assert (box[0] <= center - half).all() and (box[1] >= center + half).all()
    assert (box[1] - box[0]).max() < 2.0  # a third of what the cameras see


def test_optimizer_counts_steps_and_refuses_more():
    scene = blob_scene(count=4, size=16)
    optimizer = finished(FieldOptimizer(scene, resolution=16, levels=1, epochs=1, batch_rays=256))
    assert np.isfinite(optimizer.measure_psnr())
    refused(optimizer.step, match="steps are done")


def test_psnr_by_hand():
    assert psnr(np.full((2, 2, 3), 0.5), np.full((2, 2, 3), 0.6)) == pytest.approx(20.0)
    assert psnr(np.full((1, 1, 3), 1.7), np.ones((1, 1, 3))) == float("inf")  # clamped
    assert psnr(np.full((1, 1, 3), 1.7), np.full((1, 1, 3), 1.2)) == float("inf")  # both: renders reach above one
    with pytest.raises(ValueError, match="one shape, got"):
        psnr(np.zeros((4, 4, 3)), np.zeros((4, 3)))  # would broadcast
    refused(lambda: psnr(np.zeros((2, 2, 3)), np.full((2, 2, 3), 200, np.uint8)), match="divide 8-bit pictures by 255")
    refused(lambda: mean_psnr([]), match="one view or more, got none")


def test_ssim_and_error_image():
    random = np.random.default_rng(0)
    image = random.random((24, 20, 3))
    assert ssim(image, image) == pytest.approx(1.0)
    noisy = np.clip(image + random.normal(0, 0.2, image.shape), 0, 1)
    assert ssim(noisy, image) < 0.9
    assert ssim(2 * image, 2 * image - 0.5 * (image > 0.75)) == pytest.approx(1.0)  # both are clamped
    wrong = image.copy()
    wrong[3, 4] += 0.5
    errors = error_image(wrong, image)
    np.testing.assert_allclose(errors[3, 4], [0.85, 0, 0], atol=1e-6)
    assert np.ptp(errors[10, 10]) < 1e-6  # grey where it is right
    refused(lambda: ssim(image[:5], image[:5]), match="11x11")


def test_lego_at_a_tenth_of_the_effort(lego, real_data):
    test = warpcage.load_scene(real_data / "lego_800", split="test", downscale=16)
    assert mean_psnr(evaluate(lego, test)) > 25


RESUMED = {"resolution": 24, "levels": 2, "epochs": 12, "batch_rays": 512}

KILLED = f"""
import os, signal, sys
sys.path.insert(0, sys.argv[2])
import warpcage
from scenes import blob_scene
from warpcage.fitting import checkpoint as fits
saves = []
write = fits.save_progress
def save_then_die(fit, path):
    write(fit, path)
    saves.append(path)
    if len(saves) == 3:
        os.kill(os.getpid(), signal.SIGKILL)
fits.save_progress = save_then_die
warpcage.fit(blob_scene(count=12, size=24), progress=False, checkpoint=sys.argv[1],
             checkpoint_seconds=0.0, **{RESUMED})
"""


def test_a_killed_fit_goes_on_from_its_checkpoint(tmp_path):
    checkpoint = tmp_path / "progress.npz"
    killed = subprocess.run([sys.executable, "-c", KILLED, str(checkpoint), SUPPORT], capture_output=True, timeout=120)
    assert killed.returncode == -9, killed.stderr.decode()
    assert [p.name for p in tmp_path.iterdir()] == ["progress.npz"]
    scene = blob_scene(count=12, size=24)
    resumed = warpcage.fit(scene, progress=False, checkpoint=checkpoint, **RESUMED)
    assert not checkpoint.exists()
    through = warpcage.fit(scene, progress=False, **RESUMED)
    assert abs(mean_psnr(evaluate(resumed, scene)) - mean_psnr(evaluate(through, scene))) < 0.05


def test_checkpoints_of_other_fits_are_refused(tmp_path):
    scene, options = blob_scene(count=4, size=16), {"resolution": 16, "levels": 1, "batch_rays": 256}
    optimizer = FieldOptimizer(scene, **options)
    optimizer.step()
    save_progress(optimizer, tmp_path / "c.npz")
    load_progress(FieldOptimizer(scene, **options), tmp_path / "c.npz")
    refused(lambda: load_progress(FieldOptimizer(scene, seed=1, **options), tmp_path / "c.npz"), match="another fit")
    np.savez(tmp_path / "d.npz", a=1)
    refused(lambda: load_progress(optimizer, tmp_path / "d.npz"), match="not a fit checkpoint")
    refused(lambda: warpcage.fit(scene, progress=False, checkpoint=tmp_path / "c.pt"), match="ends in .npz")


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_thin_boxes_are_seen_voxel_by_voxel(device, axis):
    """What is seen of a box is found by a ray for each half voxel of its longest side, whichever side is thin."""
    shape = tuple(3 if k == axis else 41 for k in range(3))
    half = 0.025 * (np.array(shape) - 1.0)
    lens = {"width": 160, "height": 160, "fov_degrees": 22}
    camera = warpcage.Camera.look_at(6.0 * np.eye(3)[axis], (0, 0, 0), up=np.eye(3)[(axis + 1) % 3], **lens)
    level = Level(wp.full(shape, 1, dtype=wp.uint8, device=device), np.stack([-half, half]), np.ones(3, np.float32), 1)
    density = np.zeros(shape, np.float32)
    spots = tuple(1 if k == axis else slice(4, -4, 4) for k in range(3))
    density[spots] = 1e3
    level.field.grid.density.assign(density.reshape(-1))
    cameras = camera_array([camera], level.field.center, device)
    assert level.weighty_mask(PictureRays(cameras, camera.width, camera.height), 0.1).numpy()[spots].all()
