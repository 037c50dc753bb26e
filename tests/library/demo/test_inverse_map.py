"""The float64 map and its inverse against the NumPy oracles."""

import numpy as np
import oracles
import pytest
from ground_truth import InverseMap
from refusals import refused

from warpcage import Cage, Deformer


def cages():
    vertices, faces = oracles.icosphere(1)
    rest = Cage(vertices, faces)
    return rest, rest.twist(40).bend(30).stretch(1.2)


def inner_points(cage, count=60):
    return 0.7 * oracles.inside_points(cage.vertices, cage.faces, count) + 0.3 * cage.vertices.mean(axis=0)


def oracle_map(kind, rest, deformed, points):
    if kind == "mean_value":
        return oracles.mean_value_weights(points, deformed.vertices, deformed.faces) @ rest.vertices
    if kind == "harmonic":
        return oracles.harmonic_oracle(deformed.vertices, deformed.faces, rest.vertices, points, graded=2)
    from warpcage.coordinates import stretched_normals

    phi, psi = oracles.green_weights_in_closed_form(points, deformed.vertices, deformed.faces)
    return phi @ rest.vertices + psi @ stretched_normals(deformed, rest)


@pytest.mark.parametrize("kind", ["mean_value", "green", "harmonic"])
def test_map_agrees_with_the_numpy_oracle_there_and_back(kind, device):
    rest, deformed = cages()
    points, goals = inner_points(deformed), inner_points(rest)
    inverse = InverseMap(rest, deformed, kind, device=device)
    back = inverse.invert(goals)
    assert back.residuals.max() < 1e-10
    expected = oracle_map(kind, rest, deformed, np.concatenate([points, back.points]))
    np.testing.assert_allclose(np.concatenate([inverse(points), goals]), expected, rtol=0, atol=1e-9)


def test_jacobian_is_that_of_the_oracle(device):
    rest, deformed = cages()
    found = InverseMap(rest, deformed, "green", device=device).invert(inner_points(rest, 5))
    h = 1e-5
    for axis in range(3):
        step = h * np.eye(3)[axis]
        ahead, behind = (oracle_map("green", rest, deformed, found.points + side * step) for side in (1, -1))
        np.testing.assert_allclose(found.jacobians[:, :, axis], (ahead - behind) / (2 * h), rtol=0, atol=1e-6)


def test_affine_pose_is_inverted_in_closed_form(device):
    rest, _ = cages()
    matrix = np.array([[1.2, 0.3, 0.0], [-0.2, 0.9, 0.1], [0.1, 0.0, 1.1]])
    points = inner_points(rest)
    deformed = rest.with_vertices(rest.vertices @ matrix.T + 5.0)
    # boundary elements reproduce constants and, up to their own error, linear data
    for kind, tolerance in (("mean_value", 1e-9), ("harmonic", 2e-4)):
        found = InverseMap(rest, deformed, kind, device=device).invert(points)
        np.testing.assert_allclose(found.points, points @ matrix.T + 5.0, rtol=0, atol=tolerance)


def test_is_the_inverse_of_what_a_deformer_renders(device):
    from fields import make_field, plain

    field = make_field(lambda x: np.zeros(x.shape[:3]), plain((1, 1, 1)), device=device, resolution=8)
    rest, deformed = cages()
    points = inner_points(rest)
    for kind in ("mean_value", "green", "harmonic"):
        posed = InverseMap(rest, deformed, kind, device=device).invert(points).points
        deformer = Deformer(field, rest, coordinates=kind, resolution=64).pose(deformed)
        back, _, region = deformer.to_canonical(posed, np.ones_like(posed))
        assert (region == 2).all()
        assert np.abs(back - points).max() < 5e-3 * rest.size


def test_refuses_other_faces_and_names():
    rest, deformed = cages()
    refused(lambda: InverseMap(rest, deformed, "bilinear"), match="coordinates")
    refused(lambda: InverseMap(rest, Cage.box([-1, -1, -1], [1, 1, 1]), "green"))
