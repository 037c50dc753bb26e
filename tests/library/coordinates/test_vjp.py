"""Slopes by points and cages of moved points and of weights, beside central differences of float64 formulas."""

import numpy as np
import oracles
import pytest
import warp as wp
from polygon_cages import mixed_prism, quad_box

from warpcage import Cage, deform_points
from warpcage.coordinates import coordinates_vjp, deform_points_vjp, stretched_normals

CAGES = ("icosphere", "box", "concave")
COUNT = 40


def weights_of(kind, points, vertices, faces):
    if kind != "green":
        weights = getattr(oracles, f"{kind}_weights")
        return weights(points, vertices, faces), np.zeros((len(points), len(faces)))
    return oracles.green_weights_in_closed_form(points, vertices, faces)


def moved(kind, points, vertices, targets, faces):
    phi, psi = weights_of(kind, points, vertices, faces)
    normals = (
        stretched_normals(Cage(vertices, faces), Cage(targets, faces)) if kind == "green" else np.zeros(faces.shape)
    )
    return phi @ targets + psi @ normals


def problem(name, seed=3):
    """Points in a posed cage, and another pose of it that they move with; directions of each for differences."""
    random = np.random.default_rng(seed)
    vertices, faces = oracles.cage(name)
    vertices = 2.0 * vertices + 0.1 * random.uniform(-1, 1, vertices.shape) + [3, -1, 2]  # of another size, elsewhere
    center = vertices.mean(axis=0)
    points = oracles.inside_points(vertices - center, faces, COUNT) + center
    targets = vertices @ np.linalg.qr(random.normal(size=(3, 3)))[0].T
    targets = targets * np.sign(Cage(targets, faces).volume) + 0.2 * random.normal(size=vertices.shape)
    given = [points, vertices, targets]
    along = [random.normal(size=each.shape) for each in given]
    return given, along, faces, random


def difference(loss, given, along, number, step=1e-5):
    """Central difference of a number as one of its arguments moves."""
    ends = []
    for sign in (step, -step):
        ends.append(loss(*[each + (sign * along[n] if n == number else 0.0) for n, each in enumerate(given)]))
    return (ends[0] - ends[1]) / (2 * step)


def close(found, along, expected, share=1e-3):
    """Whether slopes say how a number changes: to a share of what they sum up to without signs."""
    found = found.numpy().astype(float) * along
    assert np.isfinite(found).all()
    assert abs(found.sum() - expected) < share * np.sqrt((found**2).sum())


@pytest.mark.parametrize("name", CAGES)
@pytest.mark.parametrize("kind", ["mean_value", "green", "maximum_likelihood"])
def test_slopes_of_moved_points_are_central_differences(kind, name, device):
    given, along, faces, random = problem(name)
    slopes = random.normal(size=given[0].shape)
    points, vertices, targets = given
    cage = Cage(vertices, faces)
    found = deform_points_vjp(points, cage, targets, slopes, kind, device=device)
    assert found.points.device == wp.get_device(device)

    def loss(*moving):
        return (slopes * moved(kind, *moving, faces)).sum()

    for number, slope in enumerate((found.points, found.cage, found.deformed)):
        close(slope, along[number], difference(loss, given, along, number))


@pytest.mark.parametrize("name", CAGES)
@pytest.mark.parametrize("kind", ["mean_value", "green", "maximum_likelihood"])
def test_slopes_of_weights_are_central_differences(kind, name, device):
    (points, vertices, _), along, faces, random = problem(name, seed=5)
    slopes = [random.normal(size=(COUNT, width)).astype(np.float32) for width in (len(vertices), len(faces))]
    arrays = tuple(wp.array(each, device=device) for each in slopes)
    found = coordinates_vjp(
        points, Cage(vertices, faces), arrays if kind == "green" else arrays[0], kind, device=device
    )

    def loss(*moving):
        return sum((a * b).sum() for a, b in zip(slopes, weights_of(kind, *moving, faces), strict=True))

    for number, slope in enumerate((found.points, found.cage)):
        close(slope, along[number], difference(loss, (points, vertices), along, number))
    assert found.deformed is None


def test_outside_points_extend_or_count_for_nothing(device):
    """Well outside all faces are for float64; where rows are NaN nothing comes back, and the others are as without."""
    (points, vertices, targets), along, faces, random = problem("icosphere")
    cage, center = Cage(vertices, faces), vertices.mean(axis=0)
    far = center + 3.0 * (points - center) / np.linalg.norm(points - center, axis=1, keepdims=True) * cage.size
    slopes = random.normal(size=points.shape)
    found = deform_points_vjp(far, cage, targets, slopes, device=device)

    def loss(*moving):
        return (slopes * moved("mean_value", *moving, faces)).sum()

    for number, slope in enumerate((found.points, found.cage, found.deformed)):
        close(slope, along[number], difference(loss, (far, vertices, targets), along, number), 3e-3)
    inside = deform_points_vjp(points, cage, targets, slopes, "green", device=device)
    both = deform_points_vjp(
        np.concatenate([far, points]), cage, targets, np.tile(slopes, (2, 1)), "green", outside="nan", device=device
    )
    assert not both.points.numpy()[:COUNT].any()
    for one, other in ((inside.points.numpy(), both.points.numpy()[COUNT:]), (inside.cage.numpy(), both.cage.numpy())):
        np.testing.assert_allclose(one, other, atol=1e-4 * np.abs(one).max())


def test_points_on_the_cage_have_slopes(device):
    (_, vertices, targets), _, faces, random = problem("icosphere")
    on = vertices[faces].mean(axis=1)
    for kind in ("mean_value", "green", "maximum_likelihood"):
        found = deform_points_vjp(on, Cage(vertices, faces), targets, random.normal(size=on.shape), kind, device=device)
        assert np.isfinite(np.concatenate([found.points.numpy(), found.cage.numpy(), found.deformed.numpy()])).all()


def test_harmonic_slopes_follow_what_moves(device):
    """Differences of the moved points themselves: in float32, over steps that are long next to a cell."""
    vertices, faces = oracles.cage("icosphere")
    random = np.random.default_rng(8)
    rest, targets = Cage(vertices, faces), vertices + 0.1 * random.uniform(-1, 1, vertices.shape)
    points = 0.8 * oracles.inside_points(vertices, faces, 200)
    slopes = 1.0 + 0.3 * random.normal(size=points.shape)
    found = deform_points_vjp(points, rest, targets, slopes, "harmonic", device=device)
    given = points, vertices, targets
    along = [np.sin(3 * each) for each in given]

    def loss(points, vertices, targets):
        return (slopes * deform_points(points, Cage(vertices, faces), targets, "harmonic", device=device)).sum()

    for number, slope in enumerate((found.points, found.cage, found.deformed)):
        close(slope, along[number], difference(loss, given, along, number, 1e-2), 2e-2)


def test_bad_slopes_are_refused(device):
    cage = Cage(*oracles.cage("box"))
    points = np.zeros((2, 3))
    for kind, slopes, words in (
        ("mean_value", np.zeros((3, 3)), "as many as the points, 2, got 3"),
        ("biharmonic", np.zeros((2, 3)), "biharmonic coordinates: take"),
    ):
        with pytest.raises(ValueError, match=words):
            deform_points_vjp(points, cage, cage, slopes, kind, device=device)
    with pytest.raises(ValueError, match=r"must be \(2, 8\), got \(2, 7\)"):
        coordinates_vjp(points, cage, wp.zeros((2, 7), device=device), device=device)
    for slopes in (None, np.zeros((2, 8)), wp.zeros((2, 8), dtype=wp.float64, device=device)):
        with pytest.raises(ValueError, match="Warp arrays of float32, got"):
            coordinates_vjp(points, cage, slopes, device=device)
    with pytest.raises(ValueError, match="through weights of harmonic"):
        coordinates_vjp(points, cage, wp.zeros((2, 8), device=device), "harmonic", device=device)
    box = quad_box(1)
    with pytest.raises(ValueError, match="through weights of green"):
        coordinates_vjp(points, box, wp.zeros((2, 8), device=device), "green", device=device)


# -- Bilinear patches


def patch_weights(cage):
    """Mean value weights (n, v) in a cage of polygons, by quadrature, as a function of points and vertices."""
    surface = cage.refined(1)
    operator = surface.operator.toarray()
    return lambda points, vertices: (
        oracles.quad_mean_value_weights(points, operator @ vertices, surface.quads, 8) @ operator
    )


def moved_by_patches(cage):
    weights = patch_weights(cage)
    return lambda points, vertices, targets: weights(points, vertices) @ targets


def check_patches(cage, points, random, device, share=1e-3, step=1e-6):
    """Whether slopes of moved points are central differences, in a pose of the cage at random."""
    targets = cage.vertices @ np.linalg.qr(random.normal(size=(3, 3)))[0].T
    given = [points, cage.vertices, targets + 0.1 * random.normal(size=targets.shape)]
    along, slopes = [random.normal(size=each.shape) for each in given], random.normal(size=points.shape)
    found, move = deform_points_vjp(points, cage, given[2], slopes, device=device), moved_by_patches(cage)
    for number, slope in enumerate((found.points, found.cage, found.deformed)):
        expected = difference(lambda *moving: (slopes * move(*moving)).sum(), given, along, number, step)
        close(slope, along[number], expected, share)


@pytest.mark.parametrize("cage", [quad_box(1, 0.15), quad_box(3, 0.15), mixed_prism()], ids=["box", "many", "prism"])
def test_slopes_of_points_in_patches_are_central_differences(cage, device):
    random = np.random.default_rng(1)
    check_patches(cage, 0.45 * random.uniform(-1, 1, (8, 3)), random, device)


@pytest.mark.parametrize("height", [1e-1, 1e-3])
def test_slopes_hold_up_to_the_patches(height, device):
    random = np.random.default_rng(2)
    cage = quad_box(2, 0.15)
    places, normals, _ = oracles.on_quads(cage.vertices, np.array(cage.polygons), 8)
    check_patches(cage, oracles.single(places - height * normals), random, device, step=1e-3 * min(height, 1e-3))
    on = deform_points_vjp(places, cage, cage.vertices, normals, device=device)
    inside = deform_points_vjp(places - 2e-4 * normals, cage, cage.vertices, normals, device=device)
    # at rest nothing bends: all slopes are those of the point itself
    np.testing.assert_allclose(on.points.numpy(), normals, atol=1e-2)
    np.testing.assert_allclose(on.deformed.numpy(), inside.deformed.numpy(), atol=1e-2)


def test_slopes_of_points_around_patches(device):
    random = np.random.default_rng(3)
    points = random.normal(size=(10, 3))
    for distance in (2.5, 30.0):
        away = distance * points / np.linalg.norm(points, axis=1, keepdims=True)
        check_patches(quad_box(2, 0.15), away, random, device)


@pytest.mark.parametrize("cage", [quad_box(2, 0.15), mixed_prism()], ids=["box", "prism"])
def test_slopes_of_weights_of_polygons_are_central_differences(cage, device):
    random, weights = np.random.default_rng(4), patch_weights(cage)
    given = random.uniform(-0.4, 0.4, (8, 3)), cage.vertices
    rows = random.normal(size=(8, len(cage.vertices))).astype(np.float32)
    found = coordinates_vjp(given[0], cage, wp.array(rows, device=device), device=device)
    along = [random.normal(size=each.shape) for each in given]
    for number, slope in enumerate((found.points, found.cage)):
        expected = difference(lambda *moving: (rows * weights(*moving)).sum(), given, along, number, 1e-6)
        close(slope, along[number], expected)
