"""Kernels of both closed forms, mean value and Green, against oracles: the half-angle form of Ju, Schaefer and Warren,
and the layer potentials, which the pseudo-code of Lipman et al. and quadrature confirm."""

import numpy as np
import oracles
import pytest
import trimesh
import warp as wp
from messages import MESSAGES
from refusals import refused

from warpcage import Cage, deform_points, green_coordinates, mean_value_coordinates
from warpcage.coordinates import stretched_normals
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
by_the_cage = pytest.mark.parametrize("kind", ["face", "edge", "vertex"])
some_cages = pytest.mark.parametrize("name", ["icosphere", "concave", "box"])


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
    return oracles.green_weights_in_closed_form(points, vertices, faces)


def error_to(weights, wanted):
    return max(np.abs(ours - theirs).max(initial=0.0) for ours, theirs in zip(weights, wanted, strict=True))


def reproduction_error(weights, points, vertices, faces):
    phi, psi = weights
    moved = phi @ vertices + (psi @ oracles.unit_normals(vertices, faces) if psi.size else 0.0)
    return max(np.abs(moved - points).max(), np.abs(phi.sum(axis=1) - 1).max())


def test_references_of_green_weights_are_each_other():
    vertices, faces = oracles.icosphere(1)
    wanted = oracles.green_weights_by_quadrature(0.4 * vertices, vertices, faces)
    for form in (oracles.green_weights, oracles.green_weights_in_closed_form):
        assert error_to(form(0.4 * vertices, vertices, faces), wanted) < 1e-10
    vertices, faces = oracles.cage("concave")
    points = oracles.inside_points(vertices, faces, 500)
    paper, ours = (
        form(points, vertices, faces) for form in (oracles.green_weights, oracles.green_weights_in_closed_form)
    )
    for a, b in zip(paper, ours, strict=True):
        assert np.quantile(np.abs(a - b), 0.999) < 1e-6


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


def test_points_in_the_plane_of_a_far_face_give_it_nothing(device):
    """On the L's notch: the planes of the two reflex faces run through the inside."""
    vertices, faces = oracles.cage("concave")
    for height in (0.0, 1e-12):
        point = np.array([[-0.1 + height, -0.3, 0.03125]])
        nudged = np.array([[-0.1 + 1e-5, -0.3, 0.03125]])
        exact, near = (weigh("mean_value", p, vertices, faces, device) for p in (point, nudged))
        wanted = expected("mean_value", oracles.single(nudged), vertices, faces)
        assert error_to(near, wanted) < 1e-5 and error_to(exact, wanted) < 1e-4


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
    weights = weigh(form, points, vertices, faces, device)
    assert error_to(weights, expected(form, points, vertices, faces)) < 2e-5


@both
def test_scale_does_not_matter(form, device):
    """Lengths from 1e-4 to 1e4 at the kernel: lattices use node units."""
    vertices, faces = oracles.cage("icosphere")
    points = oracles.points_near_planes(vertices, faces, 3e-4)
    wanted = expected(form, points, vertices, faces)
    for scale in (1e-4, 100.0, 1e4):
        phi, psi = weigh(form, points * scale, vertices * scale, faces, device)
        assert error_to((phi, psi / scale), wanted) < 1e-5


# -- At the cage


@pytest.mark.parametrize("distance", [0.0, 1e-7, 9e-7, 1.1e-6, 1e-5, 1e-4, 1e-3])
@by_the_cage
@some_cages
def test_mean_value_weights_tend_to_linear_interpolation(name, kind, distance, device):
    vertices, faces = oracles.cage(name)
    for side in (1, -1):
        points, wanted = oracles.points_by_the_cage(vertices, faces, kind, side * distance)
        weights, _ = weigh("mean_value", points, vertices, faces, device)
        assert np.abs(weights @ vertices - points).max() < 5e-6
        assert np.abs(weights - wanted).max() < 2e-5 + 60 * distance  # they leave at a bounded slope


@pytest.mark.parametrize("distance", [1e-6, 1e-5, 1e-4, 1e-3, 1e-2])
@by_the_cage
@pytest.mark.parametrize("name", ["icosphere", "box"])
def test_green_weights_up_to_the_cage(name, kind, distance, device):
    vertices, faces = oracles.cage(name)
    points = oracles.single(oracles.points_by_the_cage(vertices, faces, kind, distance)[0])
    weights = weigh("green", points, vertices, faces, device)
    assert error_to(weights, expected("green", points, vertices, faces)) < 1e-5
    assert reproduction_error(weights, points, vertices, faces) < 1e-5


@pytest.mark.parametrize("distance", [0.0, 1e-7, 1e-6, 9e-6])
@by_the_cage
@some_cages
def test_green_weights_on_the_cage_are_the_limit_from_inside(name, kind, distance, device):
    vertices, faces = oracles.cage(name)
    inside, _ = oracles.points_by_the_cage(vertices, faces, kind, 1e-6)
    wanted = expected("green", inside, vertices, faces)
    for side in (1, -1):
        points, _ = oracles.points_by_the_cage(vertices, faces, kind, side * distance)
        weights = weigh("green", points, vertices, faces, device)
        assert reproduction_error(weights, points, vertices, faces) < 3e-5
        # the weights leave the cage like d log d
        assert error_to(weights, wanted) < 4e-5 + 40 * distance


def test_overlapping_parts_keep_the_limit_from_inside(device):
    """On a box that lies inside another one the sum of phi goes from one to two."""
    vertices, faces = oracles.cage("box")
    two, more = np.concatenate([2 * vertices, vertices]), np.concatenate([faces, faces + len(vertices)])
    on, within = (oracles.points_by_the_cage(vertices, faces, "edge", depth)[0] for depth in (0.0, 1e-4))
    weights, wanted = (weigh("green", points, two, more, device) for points in (on, within))
    assert np.abs(wanted[0].sum(axis=1) - 2).max() < 1e-5
    assert error_to(weights, wanted) < 1e-3


@pytest.mark.parametrize("gap", [0.0, 3e-6])
def test_parts_that_touch_do_not_know_of_each_other(gap, device):
    """A small box stands on a large one: points next to both belong to the one that they are in."""
    large, small = Cage.box((0, 0, 0), (1, 1, 1)), Cage.box((0.2, 0.2, 1 + gap), (0.7, 0.8, 1.6))
    cage = Cage(np.concatenate([large.vertices, small.vertices]), np.concatenate([large.faces, small.faces + 8]))
    lifted = cage.with_vertices(cage.vertices + np.repeat([[0, 0, 0], [0, 0, 5.0]], 8, axis=0))
    places = np.random.default_rng(0).uniform((0.21, 0.21), (0.69, 0.79), (20, 2))
    for depth in (1e-6, 5e-6, 1e-5, 1e-4):
        for height, offset in ((1 - depth, 0.0), (1 + gap + depth, 5.0)):
            points = np.column_stack([places, np.full(20, height)])
            phi, psi = green_coordinates(points, cage, device=device)
            assert np.abs(phi.sum(axis=1) - 1).max() < 1e-5
            assert np.abs(phi @ cage.vertices + psi @ stretched_normals(cage, cage) - points).max() < 2e-5
            moved = deform_points(points, cage, lifted, "green", device=device)
            assert np.abs(moved - points - [0, 0, offset]).max() < 2e-5


# -- Outside


def test_green_weights_sum_to_zero_outside(device):
    vertices, faces = oracles.cage("box")
    phi, psi = weigh("green", 1.5 * vertices, vertices, faces, device)
    assert np.abs(phi.sum(axis=1)).max() < 1e-5 and np.isfinite(psi).all()


@pytest.mark.parametrize("name", oracles.CAGES)
def test_mean_value_weights_match_the_oracle_outside(name, device):
    vertices, faces = oracles.cage(name)
    points = oracles.single(np.random.default_rng(2).uniform(-1, 1, (800, 3)))
    points = points[np.abs(oracles.winding_numbers(points, vertices, faces)) < 0.5]
    assert len(points) > 500
    weights = weigh("mean_value", points, vertices, faces, device)
    assert error_to(weights, expected("mean_value", points, vertices, faces)) < 3e-5


@pytest.mark.parametrize("distance", [0.7, 3.0, 30.0, 900.0])
@pytest.mark.parametrize("name", ["icosphere", "concave", "two boxes"])
def test_points_far_outside_follow_the_formula(name, distance, device):
    """Contributions of the near and the far side cancel there."""
    vertices, faces = oracles.cage(name)
    random = np.random.default_rng(0)
    points = random.normal(size=(200, 3))
    points = oracles.single(distance * points / np.linalg.norm(points, axis=1, keepdims=True))
    cage = Cage(vertices, faces)
    wanted = outside_weights(points, vertices, faces)
    weights = mean_value_coordinates(points, cage, device=device)
    assert np.abs(weights - wanted).max() < 3e-5 * np.abs(wanted).max()
    posed = cage.with_vertices(vertices + 0.1 * random.normal(size=vertices.shape))
    moved = deform_points(points, cage, posed, device=device)
    assert np.abs(moved - wanted @ posed.vertices).max() < 3e-5 * distance


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
    refused(lambda: mean_value_coordinates(points, cage, device=device), match=MESSAGES["coordinates.far_point"])
    refused(lambda: deform_points(points, cage, cage, device=device), match=MESSAGES["coordinates.far_point"])
    phi, _ = green_coordinates(points, cage, device=device, outside="nan")
    phi = np.asarray(phi.numpy() if on_device else phi)
    assert np.isfinite(phi[0]).all() and np.isnan(phi[1:]).all()


def test_boundary_elements_solve_laplace():
    """The oracle of harmonic coordinates. Linear data are exact; with those of 1 / |x - source|, linear on ever finer
    faces, it tends to that function."""
    vertices, faces = oracles.concave_l()
    points = oracles.inside_points(vertices, faces, 100)
    slope, source = np.array([1.0, 2.0, -1.0]), np.array([1.0, 1.0, 1.0])
    linear = oracles.harmonic_oracle(vertices, faces, (vertices @ slope + 3.0)[:, None], points, 1)
    assert np.abs(linear[:, 0] - points @ slope - 3.0).max() < 1e-10
    mesh, errors = trimesh.Trimesh(vertices, faces, process=False).subdivide(), []
    for _ in range(2):
        mesh = mesh.subdivide()
        data = 1 / np.linalg.norm(mesh.vertices - source, axis=1, keepdims=True)
        found = oracles.harmonic_oracle(mesh.vertices, mesh.faces, data, points, 0)[:, 0]
        errors.append(np.abs(found - 1 / np.linalg.norm(points - source, axis=1)).mean())
    assert errors[0] < 1e-3 and errors[1] < 0.4 * errors[0]
