"""Public coordinate functions and deform_points, on the host and on every device."""

import functools

import numpy as np
import oracles
import pytest
import trimesh
import warp as wp
from fields import OnlyDLPack
from messages import MESSAGES
from refusals import refused

import warpcage as coordinates
from warpcage import Cage, PositionMap
from warpcage.coordinates import stretched_normals
from warpcage.core import COORDINATES, memory
from warpcage.demo import brick_model

CLOSED_FORMS = ["mean_value", "green", "maximum_likelihood", "biharmonic"]

WEIGHTS = {
    "mean_value": coordinates.mean_value_coordinates,
    "green": coordinates.green_coordinates,
    "maximum_likelihood": coordinates.maximum_likelihood_coordinates,
    "biharmonic": coordinates.biharmonic_coordinates,
    "harmonic": lambda points, cage, **options: coordinates.harmonic_coordinates(points, cage, 16, **options),
}


@functools.cache
def cage_named(name):
    """A cage of oracles.CAGES, or of a hundred vertices around bricks."""
    if name != "bricks":
        return Cage(*oracles.cage(name))
    pytest.importorskip("pymeshlab")
    found = Cage.from_mesh(trimesh.Trimesh(*brick_model()[:2], process=False), vertex_count=110)
    assert len(found.vertices) >= 100
    return found.with_vertices(oracles.single((found.vertices - found.bounds.mean(axis=0)) / found.size))


def cage_and_points(name="icosphere", count=300, center=(0.0, 0.0, 0.0), scale=1.0):
    """A cage and points inside it, scaled and then moved."""
    cage = cage_named(name)
    points = oracles.inside_points(cage.vertices, cage.faces, count)
    return cage.with_vertices(cage.vertices * scale + center), points * scale + center


def rotation(degrees=50.0, axis=(1.0, 2.0, -0.5)):
    return trimesh.transformations.rotation_matrix(np.radians(degrees), axis)[:3, :3]


def wrapped(points, kind, device):
    dtype = {"vec3": wp.vec3, "vec3d": wp.vec3d}.get(kind, float)
    array = wp.array(np.asarray(points, np.float32), dtype=dtype, device=device)
    return OnlyDLPack(array) if kind == "dlpack" else array


@pytest.mark.scaled
@pytest.mark.parametrize("name", [*oracles.CAGES, pytest.param("bricks", marks=pytest.mark.nightly)])
def test_weights_match_oracles(name, at_night, device):
    cage, points = cage_and_points(name, 10_000 if at_night else 600)
    points, bound = oracles.single(points), 1e-4 if at_night else 1e-5
    weights = coordinates.mean_value_coordinates(points, cage, device=device)
    assert weights.dtype == np.float32 and weights.shape == (len(points), len(cage.vertices))
    assert np.abs(weights - oracles.mean_value_weights(points, cage.vertices, cage.faces)).max() < bound
    phi, psi = coordinates.green_coordinates(points, cage, device=device)
    assert phi.dtype == psi.dtype == np.float32 and psi.shape == (len(points), len(cage.faces))
    expected = oracles.green_weights_in_closed_form(points, cage.vertices, cage.faces)
    for ours, theirs in zip((phi, psi), expected, strict=True):
        assert np.abs(ours - theirs).max() < bound
    moved = phi @ cage.vertices + psi @ oracles.unit_normals(cage.vertices, cage.faces)
    for each, back in ((weights, weights @ cage.vertices), (phi, moved)):
        assert np.abs(each.sum(axis=1) - 1).max() < 1e-5 and np.abs(back - points).max() < 1e-5


def weights_of(kind, points, cage, **options):
    found = WEIGHTS[kind](points, cage, **options)
    return [host(each) for each in (found if isinstance(found, tuple) else (found,))]


@pytest.mark.parametrize(
    ("center", "scale"),
    [((1e4, -2e4, 5e3), 1.0), ((300.0, 0, -40.0), 1e-2), (3 * (-3e5,), 2.0)]
    + [((0, 0, 0), 10.0**power) for power in (-30, -15, -3, 3, 12, 30)],
)
@pytest.mark.parametrize("kind", COORDINATES)
def test_weights_do_not_depend_on_place_and_scale(kind, center, scale, device):
    cage, points = cage_and_points("concave", center=center, scale=scale)
    near, near_points = cage_and_points("concave")
    bound = 1e-4 if kind == "harmonic" and any(center) else 1e-5
    found, expected = (weights_of(kind, *each, device=device) for each in ((points, cage), (near_points, near)))
    for ours, theirs, unit in zip(found, expected, (1.0, scale)[: len(found)], strict=True):  # face weights are lengths
        assert np.abs(ours / unit - theirs).max() < bound


@pytest.mark.parametrize("kind", ["vec3", "vec3d", "rows", "dlpack"])
def test_arrays_of_a_device_stay_there(kind, device):
    cage, points = cage_and_points()
    points = oracles.single(points)
    given = wrapped(points, kind, device)
    weights = coordinates.mean_value_coordinates(given, cage)
    phi, psi = coordinates.green_coordinates(given, cage)
    shares = coordinates.harmonic_coordinates(given, cage, 16)
    moved = coordinates.deform_points(given, cage, cage.translate((1, 2, 3)))
    for array in (weights, phi, psi, shares, moved):
        assert isinstance(array, wp.array) and array.device == wp.get_device(device)
    assert np.array_equal(weights.numpy(), coordinates.mean_value_coordinates(points, cage, device=device))
    assert np.array_equal(shares.numpy(), coordinates.harmonic_coordinates(points, cage, 16, device=device))
    assert np.array_equal(phi.numpy(), coordinates.green_coordinates(points, cage, device=device)[0])
    assert np.abs(moved.numpy() - points - [1, 2, 3]).max() < 1e-5


@pytest.mark.parametrize("given", [[], np.zeros((0, 3)), "device"])
def test_no_points_give_no_rows(given, device):
    cage, _ = cage_and_points("box")
    given = wp.empty(0, dtype=wp.vec3, device=device) if isinstance(given, str) else given
    assert [a.shape for a in coordinates.green_coordinates(given, cage, device=device)] == [(0, 8), (0, 12)]
    for kind in ("mean_value", "harmonic"):
        assert WEIGHTS[kind](given, cage, device=device).shape == (0, 8)
    for kind in CLOSED_FORMS:
        assert len(coordinates.deform_points(given, cage, cage.scale(2.0), kind, device=device)) == 0


def test_weights_too_large_for_the_device_are_refused(monkeypatch, device):
    cage, points = cage_and_points("box", 10_000)
    monkeypatch.setattr(memory, "free_bytes", lambda device: 1 << 10)
    for call in WEIGHTS.values():
        refused(functools.partial(call, points, cage, device=device), match=MESSAGES["coordinates.points_at_a_time"])


STRETCH = rotation() @ np.array([[1, 0.7, 0], [0, 2.0, 0.1], [0, 0, 0.4]])


@pytest.mark.parametrize(
    ("kind", "matrix", "bound"),
    [("mean_value", STRETCH, 1e-5), ("harmonic", STRETCH, 1e-4)]
    + [("green", factor * rotation(), 3e-5) for factor in (1.0, 5.0, 0.2)],
)
@pytest.mark.parametrize("name", ["icosphere", "concave", "two boxes"])
def test_affine_maps_are_reproduced_or_similarities(name, kind, matrix, bound, device, monkeypatch):
    monkeypatch.setattr("warpcage.coordinates.coordinates.HARMONIC_RESOLUTION", 32)
    rest, points = cage_and_points(name, center=(50.0, -20.0, 1e3), scale=3.0)
    points = np.concatenate([points, rest.vertices, rest.vertices[rest.faces].mean(axis=1)])
    points = np.concatenate([points, points[:99] + 2.0]) if kind == "mean_value" else points  # outside too
    deformed = rest.with_vertices(rest.vertices @ matrix.T + [1e3, 0, 5])
    moved = coordinates.deform_points(points, rest, deformed, kind, device=device)
    assert moved.dtype == np.float64
    assert np.abs(moved - points @ matrix.T - [1e3, 0, 5]).max() < bound * max(rest.size, deformed.size)
    single = coordinates.deform_points(points.astype(np.float32), rest, rest, kind, device=device)
    assert single.dtype == np.float32 and np.abs(single - points).max() < 1e-3


@pytest.mark.parametrize("kind", CLOSED_FORMS)
def test_deform_points_is_the_weighted_sum(kind, device):
    rest, points = cage_and_points("concave")
    deformed = rest.with_vertices(rest.vertices + 0.2 * np.random.default_rng(4).normal(size=rest.vertices.shape))
    found = WEIGHTS[kind](points, rest, device=device)
    phi, psi = found if isinstance(found, tuple) else (found, np.zeros((len(points), len(rest.faces))))
    wanted = phi @ deformed.vertices + psi @ stretched_normals(rest, deformed)
    moved = coordinates.deform_points(points, rest, deformed, kind, device=device)
    assert np.abs(moved - wanted).max() < 1e-5


def test_unused_vertices_get_no_weight(device):
    vertices, faces = oracles.cage("box")
    cage, points = cage_and_points("box")
    more = Cage(np.concatenate([vertices, [[100.0, 0, 0]]]), faces)
    weights = coordinates.mean_value_coordinates(points, more, device=device)
    assert not weights[:, -1].any()
    assert np.array_equal(weights[:, :-1], coordinates.mean_value_coordinates(points, cage, device=device))


def test_stretched_normals_of_known_faces():
    vertices, faces = oracles.cage("box")
    rest = Cage(vertices, faces)
    normals = oracles.unit_normals(vertices, faces)
    assert np.allclose(stretched_normals(rest, rest), normals)
    assert np.allclose(stretched_normals(rest, rest.scale(3.0)), 3 * normals)
    # a face stretched by 2 one way and not the other: sqrt((4 + 1) / 2), whatever its two edges are
    longer = stretched_normals(rest, rest.with_vertices(vertices * [2.0, 1.0, 1.0]))
    wanted = np.where(np.abs(normals[:, :1]) > 0.5, 1.0, np.sqrt(2.5)) * normals
    assert np.allclose(longer, wanted)
    flat = stretched_normals(rest, rest.with_vertices(vertices * [0.0, 1.0, 1.0]))
    assert np.isfinite(flat).all()


def test_the_points_outside_are_reported(device):
    cage, points = cage_and_points("box")
    points[[7, 9]] += 5.0
    for given in (points, wrapped(points, "vec3", device)):
        with pytest.raises(ValueError, match=MESSAGES["coordinates.points_outside"]):
            coordinates.green_coordinates(given, cage, device=device)
        with pytest.raises(ValueError, match=MESSAGES["coordinates.points_outside"]):
            coordinates.deform_points(given, cage, cage, "green", device=device)
    weights = coordinates.mean_value_coordinates(points, cage, device=device)
    assert np.abs(weights @ cage.vertices - points).max() < 2e-4  # ten sizes away


def test_points_just_outside_count_as_inside(device):
    vertices, faces = oracles.cage("box")
    cage = Cage(vertices, faces)
    for kind in ("face", "edge", "vertex"):
        points, _ = oracles.points_by_the_cage(vertices, faces, kind, -0.9e-5)
        phi, _ = coordinates.green_coordinates(points, cage, device=device)
        assert np.abs(phi.sum(axis=1) - 1).max() < 1e-5
        beyond, _ = oracles.points_by_the_cage(vertices, faces, kind, -2e-5)
        refused(functools.partial(coordinates.green_coordinates, beyond, cage, device=device), match="outside")


BAD_POINTS = [(np.zeros(shape), r"\(n, 3\)") for shape in ((4, 2), (5, 0), (0, 2), 3, (2, 2, 3))] + [
    ([[0, 0, np.nan]], "row 0"),
    ([[0, 0, 0], [np.inf, 0, 0]], "row 1"),
]


@pytest.mark.parametrize("points, message", BAD_POINTS)
@pytest.mark.parametrize("on_device", [False, True])
def test_bad_points_are_refused(points, message, on_device, device):
    cage, _ = cage_and_points("box")
    if on_device:
        points = wp.array(np.asarray(points, np.float32), dtype=float, device=device)
    calls = [functools.partial(WEIGHTS[kind], points, cage, device=device) for kind in CLOSED_FORMS]
    for call in (*calls, functools.partial(coordinates.deform_points, points, cage, cage, device=device)):
        refused(call, match=message)


def broken_cages():
    cage = Cage.box((0, 0, 0), (1, 1, 1))
    twice = cage.vertices.copy()
    twice[1] = twice[0]
    return {
        "open": Cage(cage.vertices, cage.faces[1:]),
        "inward": Cage(cage.vertices, cage.faces[:, ::-1]),
        "place of another": cage.with_vertices(twice),
        "place of another|degenerate": cage.with_vertices(cage.vertices * [1, 1, 0]),
    }


@pytest.mark.parametrize("problem", broken_cages())
def test_cages_that_cannot_be_used_are_refused_in_one_line(problem, device):
    cage, points = broken_cages()[problem], [[0.5, 0.5, 0.5]]
    calls = [functools.partial(weigh, points, cage, device=device) for weigh in WEIGHTS.values()]
    calls += [lambda: coordinates.deform_points(points, cage, cage, device=device), lambda: PositionMap(cage)]
    for call in calls:
        refused(call, match=problem)


@pytest.mark.parametrize("resolution", [7, 0, -1, 5000, 10**9, 64.0, "64", None])
def test_resolutions_out_of_range_are_refused(resolution):
    with pytest.raises(ValueError, match="resolution must be"):
        coordinates.harmonic_coordinates([[0, 0, 0]], Cage(*oracles.cage("box")), resolution)


def test_other_cages_and_names_are_refused(device):
    (cage, points), (other, _) = cage_and_points("box"), cage_and_points("concave")
    for given, options, message in (
        ((cage, other), {}, "vertices"),
        ((cage, cage, "mvc"), {}, "harmonic, mean_value, green"),
        ((cage, cage, "green"), {"outside": "zero"}, "one of extend, raise, nan"),
        ((cage, cage), {"device": "cuda:77"}, "cuda:77"),
    ):
        with pytest.raises(ValueError, match=message):
            coordinates.deform_points(points, *given, **({"device": device} | options))


@pytest.mark.parametrize("kind", COORDINATES)
def test_points_follow_a_cage_that_goes_far(kind, device, monkeypatch):
    monkeypatch.setattr("warpcage.coordinates.coordinates.HARMONIC_RESOLUTION", 24)
    rest, points = cage_and_points("concave")
    deformed = rest.twist(30)
    offset = np.array([1e6, -1e6, 1e6])
    near = coordinates.deform_points(points, rest, deformed, kind, device=device)
    far = coordinates.deform_points(points, rest, deformed.translate(offset), kind, device=device)
    assert np.abs(far - offset - near).max() < 1e-6


def test_harmonic_names_the_cage_that_cannot_be_used(device, monkeypatch):
    monkeypatch.setattr("warpcage.coordinates.coordinates.HARMONIC_RESOLUTION", 16)
    rest, points = cage_and_points("box")
    mirrored = rest.with_vertices(rest.vertices * [-1, 1, 1])
    with pytest.raises(ValueError, match="^deformed cage looks inward.*mirror"):
        coordinates.deform_points(points, rest, mirrored, "harmonic", device=device)


@pytest.mark.parametrize("on_device", [False, True], ids=["numpy", "warp"])
@pytest.mark.parametrize("kind", WEIGHTS)
def test_outside_means_the_same_for_all_kinds(kind, on_device, device):
    cage, inner = cage_and_points("icosphere", count=9)
    # far, a little outside, on the skin, and 1e-6 of the size outside, which counts as inside
    corner = cage.vertices[0]
    skin = corner + 1e-6 * cage.size * corner / np.linalg.norm(corner)
    points = np.concatenate([inner[:4], [5000.0 * corner, 1.01 * corner, corner, skin], inner[4:]])
    given = wp.array(points, dtype=wp.vec3, device=device) if on_device else points
    lost = np.isin(np.arange(len(points)), [4, 5])
    pose = cage.translate((0.1, 0.2, 0.3))

    weights = functools.partial(weights_of, kind, cage=cage, device=device)

    def move(which, **options):
        return host(coordinates.deform_points(which, cage, pose, kind, device=device, **options))

    for take in (weights, move):
        refused(functools.partial(take, given, outside="raise"), match="2 of 13 points are outside .* point 4")
        refused(functools.partial(take, given, outside="keep"), match="one of extend, raise, nan")
    for marked, plain in zip(weights(given, outside="nan"), weights(points[~lost]), strict=True):
        assert np.isnan(marked[lost]).all()
        np.testing.assert_allclose(marked[~lost], plain, atol=1e-6)
    moved = move(given, outside="nan")
    assert np.isnan(moved[lost]).all()
    np.testing.assert_allclose(moved[~lost], points[~lost] + [0.1, 0.2, 0.3], atol=2e-4 * cage.size)
    if kind == "mean_value":  # which alone is defined there, up to a thousand times the size away
        assert np.allclose(move(points[5:], outside="extend"), move(points[5:]), atol=0)
        refused(lambda: move(given), match="1 of 13 points is 1000 times")
    else:
        for take in (weights, move):
            refused(functools.partial(take, given, outside="extend"), match="not defined outside of a cage")
        refused(lambda: move(given), match="2 of 13 points are outside")


def host(array):
    return array.numpy() if isinstance(array, wp.array) else array
