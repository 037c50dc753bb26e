"""Poses in whole pictures: what is around the object stays, and exposures differ."""

import numpy as np
import pytest
import warp as wp
from field_oracles import random_outer
from fields import BOX, ellipsoid, make_field, plain, surrounded_ball

from warpcage import Deformer, PoseTargets, Scene, VoxelField, fit_pose, turntable
from warpcage.field import harmonics_on_host
from warpcage.pose_fits.motions import smooth_basis
from warpcage.pose_fits.photographs import fit_exposures, hull_pixels
from warpcage.pose_fits.targets import PictureLoss


def cameras(count=3, size=24, distance=3.0):
    return turntable((0, 0, 0), distance, 25, count, width=size, height=size, fov_degrees=50)


def with_outer(device):
    """A field with matter around it, before it too."""
    field = surrounded_ball(device, None)
    outer, _ = random_outer(device, keep=0.5)
    harmonics = harmonics_on_host(field.grid.sh)
    return VoxelField(
        field.bounds, field.grid.links, field.grid.density, harmonics, background_model=outer, device=device
    )


FIELDS = {
    "layers": lambda device: surrounded_ball(device, "layers", fog=False),
    "sky": lambda device: surrounded_ball(device, "outer", fog=False),
    "matter": with_outer,
}


def whole_loss(field, seen, images=None, blur=0.0):
    images = np.zeros((len(seen), seen[0].height, seen[0].width, 3)) if images is None else images
    targets = PoseTargets(seen, images=images)
    return PictureLoss(targets, seen[0].width, blur, BOX.size, field.device, field=field, hull=BOX.vertices)


@pytest.mark.parametrize("around", FIELDS)
def test_what_is_compared_is_what_a_frame_shows(around, device):
    """Colours with the surroundings, which are drawn once, are those of the renderer, which draws them anew."""
    field, seen = FIELDS[around](device), cameras()
    deformer = Deformer(field, BOX, resolution=16).pose(BOX.rotate(30).translate([0.2, 0, 0.1]))
    frames = np.stack([deformer.render(camera).rgb for camera in seen])
    compared = whole_loss(field, seen).frames(deformer)["rgb"].numpy().reshape(frames.shape)
    assert np.ptp(frames) > 0.5
    np.testing.assert_allclose(compared, frames, atol=2e-3)


@pytest.mark.parametrize("around", ["layers", "matter"])
def test_gradients_before_surroundings_are_differences(around, device):
    field, seen = FIELDS[around](device), cameras(2, 32)
    deformer = Deformer(field, BOX, resolution=24)
    frames = [deformer.posed(BOX.rotate(8).translate([0.05, 0, 0.04])).render(camera).rgb for camera in seen]
    loss = whole_loss(field, seen, np.stack(frames), 1.0)
    gradient = loss(deformer.pose(BOX.vertices))[1]
    changes = np.einsum("vk,ki->kvi", smooth_basis(BOX, 4), np.random.default_rng(3).normal(size=(4, 3)))
    value = lambda vertices: loss(deformer.pose(vertices), with_gradient=False)[0]  # noqa: E731
    h = 1e-3  # pixels that the object enters or leaves make steps, which are many in a longer one
    expected = [(value(BOX.vertices + h * each) - value(BOX.vertices - h * each)) / (2 * h) for each in changes]
    found = [(gradient * change).sum() for change in changes]
    assert np.linalg.norm(np.subtract(found, expected)) < 0.05 * np.linalg.norm(expected)


def test_exposures_are_found_beside_what_moves(device):
    """Factors of each picture and channel, where a sixth of it shows something else, and noise is everywhere."""
    random = np.random.default_rng(0)
    frames = random.uniform(0.1, 0.9, (3, 24, 32, 3))
    truth = random.uniform(0.7, 1.3, (3, 1, 1, 3))
    images = truth * frames + 0.02 * random.normal(size=frames.shape)
    images[:, 4:16, 8:20] = random.uniform(0, 1, 3)

    def found(seen, weights, times):
        exposures = wp.array(np.ones((3, 3)), dtype=wp.vec3, device=device)
        parts = [wp.array(part.reshape(-1, 3), dtype=wp.vec3, device=device) for part in (seen, images)]
        counted = wp.array(weights.ravel(), dtype=wp.float32, device=device)
        for _ in range(times):
            fit_exposures(*parts, 32, 24, counted, exposures)
        return exposures.numpy()

    weights = np.ones((3, 24, 32))
    np.testing.assert_allclose(found(frames, weights, 3), truth[:, 0, 0], rtol=0.08)
    weights[:, 4:16, 8:20] = 0
    np.testing.assert_allclose(found(frames, weights, 1), truth[:, 0, 0], rtol=0.01)
    assert (found(0 * frames, weights, 1) == 1).all()


def test_photographs_with_masks_are_cut_out():
    """Whole pictures beside masks; what was cut out before stays as it is."""
    random = np.random.default_rng(0)
    photographs, masks = random.random((2, 24, 24, 3)), np.zeros((2, 24, 24))
    masks[:, 6:14, 6:14] = random.random((2, 8, 8))
    cut = masks[..., None] * photographs + (1 - masks[..., None]) * (0.2, 0.3, 0.4)
    for images in (photographs, cut):
        targets = PoseTargets(cameras(2), images=images, alphas=masks, background=(0.2, 0.3, 0.4))
        np.testing.assert_allclose(targets.images, cut, atol=1e-6)


def test_pixels_of_a_hull():
    """Of a square before a camera by hand, cut off by the picture's side, behind the camera, and partly so."""
    camera = turntable((0, 0, 0), 2.0, 0, 1, width=40, height=40, fov_degrees=90)[0]
    across, up = camera.rotation[:, 0], camera.rotation[:, 1]
    square = np.array([a * across + b * up for a in (-0.5, 0.5) for b in (-0.5, 0.5)])
    assert hull_pixels([camera], square) == pytest.approx(10 * 10, rel=1e-3)
    assert hull_pixels([camera, camera], square + 2 * across) == pytest.approx(2 * 5 * 10, rel=1e-3)
    assert hull_pixels([camera], square + 5 * across) == 0
    assert hull_pixels([camera], square + 3 * camera.center) == 0
    assert hull_pixels([camera], np.concatenate([square, square + 3 * camera.center])) == 1600


def table_field(device):
    """An ellipsoid of colours that change along it above a slab with stripes, in a room of colours."""

    def slab(x):
        return 60.0 * (x[..., 2] < -0.5)

    def density(x):
        return ellipsoid(x, sigma=60.0) + slab(x)

    def color(x):
        stripes = 0.5 + 0.3 * np.sin(5 * x @ np.array([[1.0, 0.3, 0], [0.2, 1, 0.4], [0.5, 0, 1]]))
        return plain(np.where(slab(x)[..., None] > 0, stripes, 0.5 + x * [0.8, 1.0, 1.2]))(x)

    field = make_field(density, color, device=device, resolution=32)
    model = surrounded_ball(device, "layers", fog=False).background_model
    harmonics = harmonics_on_host(field.grid.sh)
    return VoxelField(
        field.bounds, field.grid.links, field.grid.density, harmonics, background_model=model, device=device
    )


@pytest.mark.parametrize("restarts", [0, 3])
def test_a_pose_is_found_in_photographs(restarts, device):
    """Whole pictures with a table and a room in them, each of an exposure and a white balance of its own."""
    field, seen = table_field(device), cameras(4, 32, 1.9)
    deformer = Deformer(field, BOX, coordinates="mean_value", resolution=16)
    truth = BOX.rotate(20, axis="z").translate([0.12, -0.08, 0.03])
    gains = np.random.default_rng(3).uniform(0.7, 1.2, (4, 1, 1, 3))
    images = gains * np.stack([deformer.posed(truth).render(camera).rgb for camera in seen])
    scene = Scene(images.astype(np.float32), None, seen)

    def off(**options):
        found = fit_pose(deformer, scene, parameters="rigid", restarts=restarts, **options).cage
        return np.sqrt(((found.vertices - truth.vertices) ** 2).sum(axis=1).mean()) / BOX.size

    assert off(exposure=True) < 0.008
    if not restarts:
        assert off() > 0.012
