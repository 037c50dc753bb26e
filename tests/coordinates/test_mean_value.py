"""Mean value kernels against the half-angle form of Ju, Schaefer and Warren in extended precision."""

import numpy as np
import oracles
import pytest
import test_closed_forms
import warp as wp
from messages import MESSAGES

from warpcage import Cage, deform_points, green_coordinates, mean_value_coordinates

NAMES = list(oracles.CAGES)


def weigh(points, vertices, faces, device):
    return test_closed_forms.weigh("mean_value", points, vertices, faces, device)[0]


@pytest.mark.parametrize("name", NAMES)
def test_weights_match_oracle_outside(name, device):
    vertices, faces = oracles.cage(name)
    points = oracles.single(np.random.default_rng(2).uniform(-1, 1, (1500, 3)))
    points = points[np.abs(oracles.winding_numbers(points, vertices, faces)) < 0.5]
    assert len(points) > 1000
    weights = weigh(points, vertices, faces, device)
    assert np.abs(weights - oracles.mean_value_weights(points, vertices, faces)).max() < 3e-5


@pytest.mark.parametrize("distance", [0.0, 1e-7, 9e-7, 1.1e-6, 1e-5, 1e-4, 1e-3])
@pytest.mark.parametrize("kind", ["face", "edge", "vertex"])
@pytest.mark.parametrize("name", ["icosphere", "concave", "box"])
def test_weights_tend_to_linear_interpolation_at_the_cage(name, kind, distance, device):
    vertices, faces = oracles.cage(name)
    for side in (1, -1):
        points, wanted = oracles.points_by_the_cage(vertices, faces, kind, side * distance)
        weights = weigh(points, vertices, faces, device)
        assert np.isfinite(weights).all()
        assert np.abs(weights @ vertices - points).max() < 5e-6
        assert np.abs(weights - wanted).max() < 2e-5 + 60 * distance  # they leave at a bounded slope


def test_points_in_the_plane_of_a_far_face_give_it_nothing(device):
    """On the L's notch: the planes of the two reflex faces run through the inside."""
    vertices, faces = oracles.cage("concave")
    for height in (0.0, 1e-12):
        point = np.array([[-0.1 + height, -0.3, 0.03125]])
        nudged = np.array([[-0.1 + 1e-5, -0.3, 0.03125]])
        exact, near = (weigh(p, vertices, faces, device) for p in (point, nudged))
        wanted = oracles.mean_value_weights(oracles.single(nudged), vertices, faces)
        assert np.abs(near - wanted).max() < 1e-5
        assert np.abs(exact - wanted).max() < 1e-4


@pytest.mark.parametrize("distance", [0.7, 3.0, 30.0, 900.0])
@pytest.mark.parametrize("name", ["icosphere", "concave", "two boxes"])
def test_points_far_outside_follow_the_formula(name, distance, device):
    """Contributions of the near and the far side cancel there."""
    vertices, faces = oracles.cage(name)
    random = np.random.default_rng(0)
    points = random.normal(size=(200, 3))
    points = oracles.single(distance * points / np.linalg.norm(points, axis=1, keepdims=True))
    cage = Cage(vertices, faces)
    expected = outside_weights(points, vertices, faces)
    weights = mean_value_coordinates(points, cage, device=device)
    assert np.abs(weights - expected).max() < 3e-5 * np.abs(expected).max()
    posed = cage.with_vertices(vertices + 0.1 * random.normal(size=vertices.shape))
    moved = deform_points(points, cage, posed, device=device)
    assert np.abs(moved - expected @ posed.vertices).max() < 3e-5 * distance


def outside_weights(points, vertices, faces):
    """The vector form of Floater et al. with face normals, in extended precision: (n, v)."""
    points, vertices = np.asarray(points, np.longdouble), np.asarray(vertices, np.longdouble)
    weights = np.zeros((len(points), len(vertices)), np.longdouble)
    for face in faces:
        corners = [vertices[i] - points for i in face]
        across = [np.cross(corners[(k + 1) % 3], corners[(k + 2) % 3] - corners[(k + 1) % 3]) for k in range(3)]
        length = [np.sqrt((c**2).sum(axis=1)) for c in across]
        cosine = [(corners[(k + 1) % 3] * corners[(k + 2) % 3]).sum(axis=1) for k in range(3)]
        mean = sum((np.arctan2(length[k], cosine[k]) / length[k])[:, None] * across[k] for k in range(3)) / 2
        for k in range(3):
            weights[:, face[k]] += (across[k] * mean).sum(axis=1) / (across[k] * corners[k]).sum(axis=1)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True), np.float64)


@pytest.mark.parametrize("distance", [2e3, 1e20, 1e38])
@pytest.mark.parametrize("on_device", [False, True])
def test_points_too_far_for_the_formula_are_refused(distance, on_device, device):
    cage = Cage(*oracles.cage("box"))
    points = np.array([[0, 0, 0], [0, -distance, 1], [900, 0, 0]])
    if on_device:
        points = wp.array(points.astype(np.float32), dtype=wp.vec3, device=device)
    for call in (
        lambda: mean_value_coordinates(points, cage, device=device),
        lambda: deform_points(points, cage, cage, device=device),
    ):
        with pytest.raises(ValueError, match=MESSAGES["coordinates.far_point"]):
            call()
    phi, _ = green_coordinates(points, cage, device=device, outside="nan")
    phi = np.asarray(phi.numpy() if on_device else phi)
    assert np.isfinite(phi[0]).all() and np.isnan(phi[1:]).all()
