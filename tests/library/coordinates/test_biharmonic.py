"""Biharmonic coordinates: layers, equations and weights against float64, what maps keep, and where they meet a cage."""

import functools

import numpy as np
import oracles
import pytest
import trimesh
import warp as wp
from biharmonic_oracles import biharmonic_equations, biharmonic_weights, layers, layers_by_quadrature, normals_of
from messages import MESSAGES
from polygon_cages import quad_box
from refusals import refused

from warpcage import Cage, PositionMap, biharmonic_coordinates, deform_points
from warpcage.coordinates import stretched_normals
from warpcage.core import launch
from warpcage.kernels.coordinates.biharmonic import fill_equations, map_biharmonic, weigh_biharmonic
from warpcage.mesh.mesh import prepared_fans

BAR = Cage.box((-0.2, -0.2, -0.5), (0.2, 0.2, 0.5), segments=2)


def cage_named(name):
    return BAR if name == "bar" else Cage(*oracles.cage(name))


def in_cage(cage, count=150, share=0.9):
    """Points in a convex cage, up to a share of the way to it."""
    rng = np.random.default_rng(3)
    middle, faces = cage.vertices.mean(axis=0), cage.vertices[cage.faces]
    on_faces = np.einsum("nk,nkc->nc", rng.dirichlet([1, 1, 1], count), faces[rng.integers(0, len(faces), count)])
    return middle + share * rng.uniform(0, 1, (count, 1)) ** (1 / 3) * (on_faces - middle)


def on_cage(cage, posed, count=400):
    """Points on the faces of a cage, and where a posed cage has them."""
    rng = np.random.default_rng(5)
    shares, which = rng.dirichlet([1, 1, 1], count), cage.faces[rng.integers(0, len(cage.faces), count)]
    return [np.einsum("nk,nkc->nc", shares, each.vertices[which]) for each in (cage, posed)]


def test_layers_of_the_oracle_are_their_integrals():
    rng = np.random.default_rng(0)
    corners, points = rng.uniform(-1, 1, (6, 3, 3)), rng.uniform(1.5, 2.0, (5, 3)) * rng.choice([-1, 1], (5, 3))
    for found, wanted in zip(layers(points, corners), layers_by_quadrature(points, corners), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-13)


@pytest.mark.parametrize("away", [1.1, 4.0])
def test_layers_of_kernels_are_integrals(away, device):
    """One face, near and far: values and, of D and S, the sums that maps take, to 1e-6 of the quadrature."""
    rng = np.random.default_rng(1)
    corners = oracles.single(rng.uniform(-0.5, 0.5, (3, 3)))
    points = rng.normal(size=(40, 3))
    points = oracles.single(away * points / np.linalg.norm(points, axis=1, keepdims=True))
    vertices = wp.array(corners, dtype=wp.vec3, device=device)
    faces = wp.array([[0, 1, 2]], dtype=wp.vec3i, device=device)
    places = wp.array(points, dtype=wp.vec3, device=device)
    rows = [wp.empty((40, count), dtype=wp.float64, device=device) for count in (3, 3)]
    launch(weigh_biharmonic, 40, [places, vertices, faces, 1.0], rows, device=device)
    phi, psi, second, third = layers_by_quadrature(points, corners[None].astype(np.float64))
    single = 5e-6 * away  # phi and psi are of float32
    np.testing.assert_allclose(rows[0].numpy(), phi[:, 0], atol=single)
    np.testing.assert_allclose(rows[1].numpy()[:, 0], psi[:, 0], rtol=single)
    np.testing.assert_allclose(rows[1].numpy()[:, 1:], np.concatenate([second, third], axis=1), rtol=1e-7, atol=1e-9)
    # a map of values that are zero but for one layer is that layer
    fans, zeros = prepared_fans(vertices, faces, 1.0), wp.zeros(3, dtype=wp.vec3, device=device)
    moved = wp.empty(40, dtype=wp.vec3, device=device)
    outside = wp.zeros(1, dtype=int, device=device)
    inputs = [places, vertices, faces, fans, zeros, wp.array(np.eye(3), dtype=wp.vec3, device=device), 1.0]
    launch(map_biharmonic, 40, inputs, [moved, outside], device=device)
    wanted = np.concatenate([psi, second, third], axis=1)
    assert (np.abs(moved.numpy() - wanted) / np.abs(wanted).max(axis=0)).max() < single
    assert outside.numpy()[0] == 1  # one face closes nothing


@pytest.mark.parametrize("name", ["icosphere", "concave", "bar"])
def test_equations_are_values_and_slopes_at_the_middles_of_faces(name):
    cage = cage_named(name)
    vertices = (cage.vertices - cage.bounds.mean(axis=0)) / cage.size
    corners, count = len(vertices), len(cage.faces)
    rows = [wp.empty((2 * count, width), dtype=wp.float64, device="cpu") for width in (corners + count, 2 * count)]
    places = wp.array(vertices, dtype=wp.vec3d, device="cpu")
    faces = wp.array(cage.faces, dtype=wp.vec3i, device="cpu")
    winding = wp.empty(count, dtype=wp.float64, device="cpu")
    launch(fill_equations, count, [places, faces], [*rows, winding], device="cpu")
    np.testing.assert_allclose(winding.numpy(), 1.0, atol=1e-12)
    for found, wanted in zip(rows, biharmonic_equations(vertices, cage.faces), strict=True):
        np.testing.assert_allclose(found.numpy(), wanted, atol=1e-8 * np.abs(wanted).max())


@pytest.mark.parametrize("name", ["icosphere", "concave", "bar"])
def test_weights_match_float64_and_reproduce_affine_maps(name, device):
    cage = cage_named(name)
    points = in_cage(cage) if name != "concave" else oracles.inside_points(cage.vertices, cage.faces, 150)
    phi, psi = biharmonic_coordinates(points, cage, device=device)
    assert phi.shape == (len(points), len(cage.vertices)) and psi.shape == (len(points), len(cage.faces))
    assert phi.dtype == psi.dtype == np.float32
    for found, wanted in zip(
        (phi, psi / cage.size), biharmonic_weights(points, cage.vertices, cage.faces), strict=True
    ):
        assert np.abs(found - wanted / (1.0 if wanted.shape == phi.shape else cage.size)).max() < 1e-5
    matrix, offset = np.array([[1.2, 0.3, 0.0], [-0.1, 0.8, 0.2], [0.05, 0.0, 1.4]]), np.array([3.0, -2.0, 1.0])
    normals = normals_of(cage.vertices[cage.faces])
    moved = phi.astype(np.float64) @ (cage.vertices @ matrix.T + offset) + psi.astype(np.float64) @ normals @ matrix.T
    assert np.abs(moved - points @ matrix.T - offset).max() < 2e-5 * cage.size
    # a pose by the weights is the pose of points
    posed = cage.twist(40)
    moved = phi.astype(np.float64) @ posed.vertices + psi.astype(np.float64) @ stretched_normals(cage, posed)
    assert np.abs(moved - deform_points(points, cage, posed, "biharmonic", device=device)).max() < 1e-5 * cage.size


@pytest.mark.parametrize("scale", [1.0, 0.2, 5.0])
@pytest.mark.parametrize("name", ["icosphere", "concave", "bar"])
def test_similarities_are_exact_up_to_the_cage(name, scale, device):
    cage = cage_named(name)
    turn = scale * trimesh.transformations.rotation_matrix(0.9, (1, 2, -0.5))[:3, :3]
    posed = cage.with_vertices(cage.vertices @ turn.T + [3, -2, 1])
    points = np.concatenate([oracles.inside_points(cage.vertices, cage.faces, 100), on_cage(cage, cage, 100)[0]])
    moved = deform_points(points, cage, posed, "biharmonic", device=device)
    assert np.abs(moved - points @ turn.T - [3, -2, 1]).max() < 1e-5 * posed.size


@pytest.mark.parametrize(
    ("name", "bound", "most"), [("icosphere", 4e-3, 1.2e-2), ("bar", 1e-2, 3e-2)]
)  # shares of the size, root mean square and largest
def test_poses_end_at_the_cage_as_green_ones_do_not(name, bound, most, device):
    cage = cage_named(name)
    posed = cage.twist(60).bend(40)
    points, wanted = on_cage(cage, posed)
    away = {
        kind: np.linalg.norm(deform_points(points, cage, posed, kind, device=device) - wanted, axis=1) / cage.size
        for kind in ("green", "biharmonic")
    }
    rms = {kind: np.sqrt((each**2).mean()) for kind, each in away.items()}
    assert rms["biharmonic"] < bound and away["biharmonic"].max() < most
    assert rms["biharmonic"] < 0.4 * rms["green"]


def test_slopes_at_faces_are_those_that_are_asked_for(device):
    """Stretched normals, just inside the middles of faces: the map bends by a thousandth of it up to there."""
    cage = cage_named("icosphere")
    posed = cage.twist(60)
    corners = cage.vertices[cage.faces]
    middles, normal = corners.mean(axis=1), normals_of(corners)
    near, far = (
        deform_points(middles - step * cage.size * normal, cage, posed, "biharmonic", device=device)
        for step in (1e-3, 5e-3)
    )
    slopes = (near - far) / (4e-3 * cage.size)
    wanted = stretched_normals(cage, posed)
    assert np.linalg.norm(slopes - wanted, axis=1).max() < 0.02


def test_biharmonic_polynomials_are_reproduced_better_by_finer_cages(device):
    """|x|^2 x + yz and others, whose Laplacian is harmonic, from values at vertices and slopes at middles of faces."""

    def values(p):
        square = (p**2).sum(axis=1)
        return np.stack([square * p[:, 0] + p[:, 1] * p[:, 2], square, p[:, 0] ** 2 * p[:, 1]], axis=1)

    def slopes(p):
        x, y, z = p.T
        square, zero = (p**2).sum(axis=1), 0 * x
        first = [square + 2 * x * x, 2 * x * y + z, 2 * x * z + y]
        return np.stack(
            [np.stack(each, axis=1) for each in (first, (2 * x, 2 * y, 2 * z), (2 * x * y, x * x, zero))], 1
        )

    errors = []
    for subdivisions in (0, 1, 2):
        vertices, faces = oracles.icosphere(subdivisions)
        points = oracles.single(0.6 * in_cage(Cage(vertices, faces), 60))
        phi, psi = biharmonic_coordinates(points, Cage(vertices, faces), device=device)
        corners = vertices[faces]
        given = np.einsum("fkc,fc->fk", slopes(corners.mean(axis=1)), normals_of(corners))
        errors.append(np.abs(phi @ values(vertices) + psi @ given - values(points)).max())
    assert errors[1] < errors[0] / 2 and errors[2] < errors[1] / 2, errors


def test_a_cage_that_passes_through_itself_or_lies_on_itself_keeps_similarities(device):
    """The middle of a face in another part of the cage, or on another face, says nothing of the map."""
    vertices, faces = oracles.icosphere(1)
    two = Cage(
        np.concatenate([vertices, vertices + [0.6 * np.ptp(vertices), 0, 0]]),
        np.concatenate([faces, faces + len(vertices)]),
    )
    outline = np.array([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], np.float64)  # cut from its last corner, folded
    ends = [np.column_stack([outline, np.full(6, height)]) for height in (0.0, 1.0)]
    sides = [[(k, (k + 1) % 6, (k + 1) % 6 + 6), (k, (k + 1) % 6 + 6, k + 6)] for k in range(6)]
    caps = [[(5, k + 1, k), (11, 6 + k, 7 + k)] for k in range(4)]
    folded = Cage(np.concatenate(ends), [face for pair in sides + caps for face in pair])
    for cage, point in ((two, vertices.mean(axis=0) - 0.1), (folded, np.array([0.5, 0.5, 0.5]))):
        posed = cage.scale(1.2).rotate(30.0, axis=(1.0, 1.0, 0.0))
        found, wanted = (
            deform_points(point[None], cage, posed, kind, device=device) for kind in ("biharmonic", "mean_value")
        )
        assert np.abs(found - wanted).max() < 1e-5 * cage.size


def test_weights_of_quads_are_those_of_the_cages_own_vertices(device):
    cage = quad_box(2, 0.1)
    points, posed = in_cage(cage, 60, 0.8), cage.twist(40)
    phi, psi = biharmonic_coordinates(points, cage, device=device)
    assert phi.shape == (60, len(cage.vertices)) and psi.shape == (60, len(cage.refined(1).faces))
    moved = phi @ posed.vertices + psi @ stretched_normals(cage, posed)
    assert np.abs(moved - deform_points(points, cage, posed, "biharmonic", device=device)).max() < 1e-5 * cage.size


def test_a_lattice_maps_as_points_do(device):
    """Rest from posed, against the weights in float64: an error of the look-up between nodes."""
    rest = cage_named("icosphere")
    posed = rest.twist(50)
    points = oracles.inside_points(posed.vertices, posed.faces, 300)
    phi, psi = biharmonic_weights(points, posed.vertices, posed.faces)
    wanted = phi @ rest.vertices + psi @ stretched_normals(posed, rest)
    found = PositionMap(rest, coordinates="biharmonic", resolution=32, device=device).pose(posed)
    positions, distance = oracles.look_up(found, points)
    away = np.abs(positions - wanted).max(axis=1) / rest.size
    assert away[distance < -3 * rest.size / 32].max() < 1e-3 and np.sqrt((away**2).mean()) < 4e-4


def test_cages_of_many_faces_are_refused():
    cage = Cage(*oracles.icosphere(4))
    act = functools.partial(deform_points, np.zeros((1, 3)), cage, cage, "biharmonic")
    refused(act, MESSAGES["coordinates.too_many_faces"].format(count=len(cage.faces)))


@pytest.mark.parametrize("corners", [12, 200])
def test_faces_too_thin_for_float32_are_refused(corners, device):
    """Lids cut into fans: of 200 corners they are needles, and layers of 1e13 that should cancel moved points by a
    million times the size. At rest nothing has to cancel."""
    turns = np.arange(corners) * 2.0 * np.pi / corners
    ring = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    lids = (
        [(0, k + 1, k) for k in range(1, corners - 1)],
        [(corners, corners + k, corners + k + 1) for k in range(1, corners - 1)],
    )
    after = np.roll(np.arange(corners), -1)
    sides = np.stack([np.arange(corners), after, after + corners, np.arange(corners) + corners], axis=1)
    faces = np.concatenate([*lids, sides[:, [0, 1, 2]], sides[:, [2, 3, 0]]])
    cage = Cage(np.concatenate([np.c_[ring, 0.0 * turns], np.c_[ring, 0.0 * turns + 1.0]]), faces)
    points, posed = [[0.1, 0.2, 0.5]], cage.vertices + np.random.default_rng(0).normal(0.0, 0.1, (2 * corners, 3))

    def act():
        return deform_points(points, cage, posed, "biharmonic", device=device)

    np.testing.assert_allclose(deform_points(points, cage, cage, "biharmonic", device=device), points, atol=2e-5)
    if corners > 12:
        refused(act, "lose their digits")
        refused(lambda: biharmonic_coordinates(points, cage, device=device), "lose their digits")
    else:
        vertex_weights, face_weights = biharmonic_coordinates(points, cage, device=device)
        stretched = stretched_normals(cage, cage.with_vertices(posed))
        np.testing.assert_allclose(act(), vertex_weights @ posed + face_weights @ stretched, atol=1e-4)
