import numpy as np
import pytest
from fields import GridField, ball_densities, nodes
from refusals import refused

from warpcage.field import extract_mesh, surface_density


def test_a_ball_comes_out_round_closed_and_outward():
    mesh = extract_mesh(GridField(ball_densities()), threshold=200.0)
    assert np.abs(np.linalg.norm(mesh.vertices - [0.1, 0, 0], axis=1) - 0.6).max() < 0.003
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 0.6**3, rel=0.01)
    outward = np.einsum("fi,fi->f", mesh.face_normals, mesh.triangles_center - [0.1, 0, 0])
    assert (outward > 0).all()


def test_world_units_on_a_grid_with_other_sides():
    lower, upper = (10.0, -4.0, 0.0), (12.0, -1.0, 5.0)
    x = nodes((20, 30, 50), (lower, upper))
    density = 500.0 * np.clip(1.0 - (np.abs((x - [11, -2.5, 2.5]) / [0.5, 1.0, 2.0]).max(axis=-1) - 1.0) * 5.0, 0, 2)
    mesh = extract_mesh(GridField(density, lower, upper), threshold=500.0)
    assert np.allclose(mesh.bounds, [[10.5, -3.5, 0.5], [11.5, -1.5, 4.5]], atol=0.02)


def test_the_surface_is_closed_where_the_object_leaves_the_grid():
    mesh = extract_mesh(GridField(np.full((8, 8, 8), 1000.0)))
    assert mesh.is_watertight
    assert 8.0 < mesh.volume < 8.0 * (1 + 1 / 8) ** 3 + 1e-9


@pytest.mark.parametrize("opacity", [200.0, 0.5])  # a dense object, and a fog below half opacity a voxel
def test_the_same_object_ten_times_larger_gives_the_same_mesh(opacity):
    small = GridField(ball_densities(24, density=opacity))
    large = GridField(small.densities / 10.0, lower=(-10, -10, -10), upper=(10, 10, 10))
    one, two = extract_mesh(small), extract_mesh(large)
    assert np.array_equal(one.faces, two.faces)
    assert np.allclose(one.vertices * 10.0, two.vertices, atol=1e-4)


def test_surface_density_is_half_opacity_or_between_two_fogs():
    voxel = np.full(3, 0.1)
    dense = np.array([0.0, 1.0, 50.0, 80.0, 90.0])
    assert surface_density(dense, voxel) == pytest.approx(np.log(2) / 0.2)
    fog = np.array([0.0] * 50 + [0.1] * 30 + [2.0] * 30)
    assert 0.1 < surface_density(fog, voxel) < 2.0
    assert surface_density(np.array([0.0, 1.0, 1.0]), voxel) == pytest.approx(0.5)


def test_largest_part_drops_floaters_and_cavities():
    density = ball_densities(center=(0, 0, 0))
    density[np.linalg.norm(nodes(40), axis=-1) < 0.3] = 0.0
    density[1:3, 1:3, 1:3] = 400.0
    field = GridField(density)
    everything, largest = extract_mesh(field, components="all"), extract_mesh(field)
    assert everything.body_count == 3 and largest.body_count == 1
    assert np.linalg.norm(largest.vertices, axis=1).min() > 0.55
    assert largest.is_watertight and largest.volume > everything.volume


@pytest.mark.parametrize(
    ("field", "options", "message"),
    [
        (GridField(np.zeros((4, 4, 4))), {}, "empty"),
        (GridField(np.full((4, 4, 4), -1.0)), {}, "empty"),
        (GridField(np.full((4, 4, 4), np.nan)), {}, "not finite"),
        (GridField(np.ones((4, 4, 4))), {"threshold": 2.0}, "above the threshold 2"),
        (GridField(np.ones((4, 4, 4))), {"threshold": -1.0}, "threshold, a density, must be positive"),
        (GridField(np.ones((4, 4, 4))), {"components": "some"}, "largest"),
    ],
)
def test_refusals(field, options, message):
    refused(lambda: extract_mesh(field, **options), message)
