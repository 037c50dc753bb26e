"""Kernels of both closed forms, mean value and Green, against their formulas: what holds of one holds of the other."""

import numpy as np
import oracles
import pytest
import warp as wp

from warpcage.core import launch
from warpcage.kernels.coordinates import green, mean_value
from warpcage.mesh import prepared_fans

#: Largest error of points that the weights give back, and of the sum of weights.
REPRODUCED = {"mean_value": 5e-6, "green": 1e-5}

#: Distances from planes of far faces: some are about those from where on the kernels take another way.
HEIGHTS = {
    "mean_value": [1e-7, 1.5e-6, 1e-5, 1e-4, 9e-4, 1.1e-3, 3e-3],
    "green": [1e-7, 1.5e-6, 1e-5, 1e-4, 1e-3, 1.9e-3, 2.1e-3, 1e-2],
}

both = pytest.mark.parametrize("form", REPRODUCED)


def on_device(points, vertices, faces, device):
    return [wp.array(np.asarray(a, np.float32), dtype=wp.vec3, device=device) for a in (points, vertices)] + [
        wp.array(np.asarray(faces, np.int32), dtype=wp.vec3i, device=device)
    ]


def weigh(form, points, vertices, faces, device):
    """Weights of vertices (n, v) and of faces (n, f), which mean value coordinates have none of: (n, 0)."""
    kernel, counts = mean_value.weigh_mean_value, [len(vertices)]
    if form == "green":
        kernel, counts = green.weigh_green, [len(vertices), len(faces)]
    weights = [wp.empty((len(points), count), dtype=float, device=device) for count in counts]
    for each in weights:
        each.fill_(float("nan"))  # rows must not depend on what was there
    inputs = [*on_device(points, vertices, faces, device), np.ptp(vertices, axis=0).max()]
    launch(kernel, len(points), inputs, weights, device=device)
    return [*(each.numpy().astype(np.float64) for each in weights), np.empty((len(points), 0))][:2]


def expected(form, points, vertices, faces):
    if form == "mean_value":
        return oracles.mean_value_weights(points, vertices, faces), np.empty((len(points), 0))
    return oracles.green_weights(points, vertices, faces)


def error_to(weights, wanted):
    return max(np.abs(ours - theirs).max(initial=0.0) for ours, theirs in zip(weights, wanted, strict=True))


def reproduction_error(weights, points, vertices, faces):
    phi, psi = weights
    moved = phi @ vertices + (psi @ oracles.unit_normals(vertices, faces) if psi.size else 0.0)
    return max(np.abs(moved - points).max(), np.abs(phi.sum(axis=1) - 1).max())


@both
@pytest.mark.parametrize("name", oracles.CAGES)
def test_weights_match_oracle_inside(name, form, device):
    vertices, faces = oracles.cage(name)
    points = oracles.single(oracles.inside_points(vertices, faces, 1500))
    weights = weigh(form, points, vertices, faces, device)
    assert error_to(weights, expected(form, points, vertices, faces)) < 1e-5
    assert reproduction_error(weights, points, vertices, faces) < REPRODUCED[form]


@pytest.mark.parametrize("form, height", [(form, height) for form in HEIGHTS for height in HEIGHTS[form]])
@pytest.mark.parametrize("name", ["icosphere", "concave"])
def test_weights_hold_near_planes_of_far_faces(name, form, height, device):
    vertices, faces = oracles.cage(name)
    points = oracles.points_near_planes(vertices, faces, height)
    assert len(points) > 100
    weights = weigh(form, points, vertices, faces, device)
    # within 1e-6 of the surface the kernel takes the surface's own weights
    assert error_to(weights, expected(form, points, vertices, faces)) < 2 * REPRODUCED[form]
    assert reproduction_error(weights, points, vertices, faces) < REPRODUCED[form]


@both
def test_map_is_the_weighted_sum(form, device):
    vertices, faces = oracles.cage("concave")
    points = oracles.inside_points(vertices, faces, 500)
    points[:4] = vertices[:4]  # on the cage too
    random = np.random.default_rng(3)
    targets, normals = random.normal(size=vertices.shape), random.normal(size=faces.shape)
    positions = wp.empty(len(points), dtype=wp.vec3, device=device)
    arrays = on_device(points, vertices, faces, device)
    moved = [wp.array(a, dtype=wp.vec3, device=device) for a in (targets, normals)][: 2 if form == "green" else 1]
    kernel = green.map_green if form == "green" else mean_value.map_mean_value
    inputs = [*arrays, prepared_fans(*arrays[1:], 1.0), *moved, 1.0]
    launch(kernel, len(points), inputs, [positions], device=device)
    phi, psi = weigh(form, points, vertices, faces, device)
    wanted = phi @ targets + (psi @ normals if psi.size else 0.0)
    assert np.abs(positions.numpy() - wanted).max() < 1e-5


@both
def test_degenerate_face_gives_nothing_and_no_nan(form, device):
    vertices, faces = oracles.cage("box")
    points = oracles.single(oracles.inside_points(vertices, faces, 200))
    phi, psi = weigh(form, points, vertices, np.concatenate([faces, [[0, 1, 1], [2, 2, 2]]]), device)
    wanted = weigh(form, points, vertices, faces, device)
    count = wanted[1].shape[1]
    assert np.array_equal(phi, wanted[0]) and np.array_equal(psi[:, :count], wanted[1]) and not psi[:, count:].any()


@both
@pytest.mark.parametrize("height", [1e-3, 1e-4, 1e-5])
def test_slivers_keep_their_weights(height, form, device):
    vertices, faces = oracles.cage_with_sliver(height)
    points = oracles.single(oracles.inside_points(vertices, faces, 500))
    wanted = expected(form, points, vertices, faces)
    if form == "green":
        wanted = oracles.green_weights_in_closed_form(points, vertices, faces)
    assert error_to(weigh(form, points, vertices, faces, device), wanted) < 2e-5


@both
def test_scale_does_not_matter(form, device):
    """Lengths from 1e-4 to 1e4 at the kernel: lattices use node units."""
    vertices, faces = oracles.cage("icosphere")
    points = oracles.points_near_planes(vertices, faces, 3e-4)
    wanted = expected(form, points, vertices, faces)
    for scale in (1e-4, 100.0, 1e4):
        phi, psi = weigh(form, points * scale, vertices * scale, faces, device)
        assert error_to((phi, psi / scale), wanted) < 1e-5
