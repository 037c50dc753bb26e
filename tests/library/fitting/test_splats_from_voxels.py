"""Splats that are made of voxels look like them."""

import field_oracles as oracle
import numpy as np
import pytest
from fields import ellipsoid, make_field, plain, shiny, shiny_field
from refusals import refused

from warpcage import Camera, VoxelField, psnr, to_splats, turntable

VIEWS = turntable((0, 0, 0), 3.0, 25, 3, width=96, height=96)


def mean_psnr(splats, field):
    return np.mean([psnr(splats.render(camera, antialias=True).rgb, field.render(camera).rgb) for camera in VIEWS])


@pytest.mark.parametrize(
    "density, resolution, least",
    [
        (ellipsoid, 40, 40.0),
        (lambda x: ellipsoid(x, sigma=2.0), 40, 42.0),  # fog
        (lambda x: 40 * np.clip(1 - np.abs(np.linalg.norm(x, axis=-1) - 0.6) / 0.09, 0, 1), 48, 32.0),  # a shell
    ],
)
def test_splats_look_like_their_voxels(device, density, resolution, least):
    field = make_field(density, shiny, device=device, resolution=resolution)
    assert mean_psnr(to_splats(field), field) > least


def test_optical_depth_is_kept(device):
    """A slab, looked at straight: alpha is 1 - exp(-density * thickness)."""
    for sigma in (4.0, 8.0):  # of fainter ones more is cut off, where splats are below 1 / 255
        field = make_field(
            lambda x, sigma=sigma: np.where(np.abs(x[..., 2]) < 0.25, sigma, 0.0), plain((1, 0, 0)), device=device
        )
        camera = Camera.look_at((0, 0, 20), (0, 0, 0), up=(0, 1, 0), fov_degrees=2, width=32, height=32)
        alpha = to_splats(field).render(camera, antialias=True).alpha[8:24, 8:24]
        np.testing.assert_allclose(alpha.mean(), 1.0 - np.exp(-0.5 * sigma), rtol=0.03)
        assert alpha.std() < 0.03


def test_fewer_splats_are_larger(device):
    field = shiny_field(device)
    whole, half = to_splats(field), to_splats(field, most=1200)
    assert len(half) == 1200 < len(whole)
    np.testing.assert_allclose(half.scales / whole.scales[0], np.sqrt(len(whole) / 1200), rtol=1e-5)
    alphas = [np.mean([each.render(camera, antialias=True).alpha for camera in VIEWS]) for each in (whole, half)]
    assert alphas[1] == pytest.approx(alphas[0], rel=0.1) and mean_psnr(half, field) > 32
    assert np.array_equal(to_splats(field, most=1200).contents.centers, half.contents.centers)
    assert not np.array_equal(to_splats(field, most=1200, seed=1).contents.centers, half.contents.centers)


def test_what_solid_matter_hides_has_no_splats(device):
    solid = make_field(lambda x: np.where(np.linalg.norm(x, axis=-1) < 0.7, 80.0, 0.0), plain((0, 1, 0)), device=device)
    splats = to_splats(solid)
    assert len(splats) < 0.85 * (solid.node_densities() > 0).sum()
    away = np.linalg.norm(splats.contents.centers, axis=1)
    assert away.min() > 0.3 and away.max() < 0.7
    assert min(splats.render(camera, antialias=True).alpha[48, 48] for camera in VIEWS) > 0.98


LINKS = np.arange(64, dtype=np.int32).reshape(4, 4, 4)
VALUES = np.full(64, 2.0), np.zeros((64, 9, 3), np.float32)


def test_recorded_weights_say_what_is_seen(device):
    weights = np.where(np.arange(64) % 2, 0.5, 0.0)
    field = VoxelField([[-1] * 3, [1] * 3], LINKS, *VALUES, weights=weights, device=device)
    expected = np.argwhere(LINKS % 2 == 1) * 0.5 - 0.75
    np.testing.assert_allclose(to_splats(field).contents.centers, expected, atol=1e-6)


@oracle.both_kinds
def test_colors_are_those_of_the_rows(device, numbers):
    field, density, sh = oracle.random_field(device, numbers=numbers)
    splats = to_splats(field)
    assert splats.degree == (2 if len(numbers) == 2 else 3)
    cells = np.round((splats.contents.centers - field.bounds[0]) / field.voxel_size - 0.5).astype(int)
    directions = np.random.default_rng(1).normal(size=(len(cells), 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    seen = oracle.basis(directions, splats.degree + 1)
    colors = np.einsum("nbc,nb->nc", splats.contents.harmonics, seen) + 0.5
    np.testing.assert_allclose(colors, oracle.colors(sh[tuple(cells.T)], directions), atol=1e-5)
    assert (density[tuple(cells.T)] > 0).all()
    np.testing.assert_allclose(splats.scales, np.broadcast_to(0.4 * field.voxel_size, (len(cells), 3)), rtol=1e-5)


def test_what_else_a_field_says_is_kept(device):
    bounds = np.array([[-1.0] * 3, [1.0] * 3]) + (1e5, -2e5, 3e4)
    splats = to_splats(VoxelField(bounds, LINKS, *VALUES, background=(0, 1, 0), up=(0, 1, 0), device=device))
    assert np.array_equal(splats.background, [0, 1, 0]) and np.array_equal(splats.up, [0, 1, 0])
    assert splats.device == device
    np.testing.assert_allclose(splats.contents.centers.mean(axis=0), bounds.mean(axis=0), atol=1e-9)


def test_what_makes_no_splats_is_refused(device):
    field = shiny_field(device)
    for options, said in (({"most": 0}, "most"), ({"most": 2.5}, "most"), ({"seed": -1}, "seed")):
        with pytest.raises(ValueError, match=said):
            to_splats(field, **options)
    refused(lambda: to_splats(to_splats(field)), match="VoxelField")
    empty = make_field(lambda x: np.zeros(x.shape[:3]), plain((0, 0, 0)), device=device)
    refused(lambda: to_splats(empty), match="nothing that can be seen")
