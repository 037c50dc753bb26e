"""Public coordinate functions and deform_points, on the host and on every device."""

import numpy as np
import oracles
import pytest
import trimesh
import warp as wp
from messages import MESSAGES

import warpcage as coordinates
from warpcage import Cage
from warpcage.coordinates import stretched_normals
from warpcage.core import COORDINATES

CLOSED_FORMS = ["mean_value", "green"]


class Foreign:
    """An array of another library: nothing but DLPack."""

    def __init__(self, array):
        self.array = array

    def __dlpack__(self, stream=None):
        return wp.to_dlpack(self.array)

    def __dlpack_device__(self):
        return (2, 0) if self.array.device.is_cuda else (1, 0)


def cage_and_points(name="icosphere", count=300, center=(0.0, 0.0, 0.0), scale=1.0):
    """A cage of oracles.CAGES and points inside it, scaled and then moved."""
    vertices, faces = oracles.cage(name)
    points = oracles.inside_points(vertices, faces, count)
    return Cage(vertices * scale + center, faces), points * scale + center


def rotation(degrees=50.0, axis=(1.0, 2.0, -0.5)):
    return trimesh.transformations.rotation_matrix(np.radians(degrees), axis)[:3, :3]


def wrapped(points, kind, device):
    array = wp.array(np.asarray(points, np.float32), dtype=wp.vec3 if kind == "vec3" else float, device=device)
    return Foreign(array) if kind == "dlpack" else array


@pytest.mark.parametrize("name", oracles.CAGES)
def test_weights_match_oracles(name, device):
    cage, points = cage_and_points(name)
    weights = coordinates.mean_value_coordinates(points, cage, device=device)
    assert weights.dtype == np.float32 and weights.shape == (len(points), len(cage.vertices))
    assert np.abs(weights - oracles.mean_value_weights(points, cage.vertices, cage.faces)).max() < 1e-5
    phi, psi = coordinates.green_coordinates(points, cage, device=device)
    assert phi.dtype == psi.dtype == np.float32 and psi.shape == (len(points), len(cage.faces))
    for ours, theirs in zip((phi, psi), oracles.green_weights(points, cage.vertices, cage.faces), strict=True):
        assert np.abs(ours - theirs).max() < 1e-5


@pytest.mark.parametrize(
    "center, scale",
    [((1e4, -2e4, 5e3), 1.0), ((0, 0, 0), 1e3), ((0, 0, 0), 1e-3), ((300.0, 0, -40.0), 1e-2), ((0, 0, 0), 1e12)],
)
def test_weights_do_not_depend_on_place_and_scale(center, scale, device):
    cage, points = cage_and_points(center=center, scale=scale)
    near, near_points = cage_and_points()
    weights = coordinates.mean_value_coordinates(points, cage, device=device)
    assert np.abs(weights - coordinates.mean_value_coordinates(near_points, near, device=device)).max() < 1e-5
    (phi, psi), (near_phi, near_psi) = (
        coordinates.green_coordinates(p, c, device=device) for p, c in ((points, cage), (near_points, near))
    )
    assert np.abs(phi - near_phi).max() < 1e-5
    assert np.abs(psi / scale - near_psi).max() < 1e-5  # lengths


@pytest.mark.parametrize("kind", ["vec3", "rows", "dlpack"])
def test_arrays_of_a_device_stay_there(kind, device):
    cage, points = cage_and_points()
    points = oracles.single(points)
    given = wrapped(points, kind, device)
    weights = coordinates.mean_value_coordinates(given, cage)
    phi, psi = coordinates.green_coordinates(given, cage)
    moved = coordinates.deform_points(given, cage, cage.translate((1, 2, 3)))
    for array in (weights, phi, psi, moved):
        assert isinstance(array, wp.array) and array.device == wp.get_device(device)
    assert np.array_equal(weights.numpy(), coordinates.mean_value_coordinates(points, cage, device=device))
    assert np.array_equal(phi.numpy(), coordinates.green_coordinates(points, cage, device=device)[0])
    assert np.abs(moved.numpy() - points - [1, 2, 3]).max() < 1e-5


def test_float64_arrays_of_a_device_are_taken(device):
    cage, points = cage_and_points()
    given = wp.array(points, dtype=wp.vec3d, device=device)
    weights = coordinates.mean_value_coordinates(given, cage).numpy()
    assert np.abs(weights - coordinates.mean_value_coordinates(points, cage, device=device)).max() < 1e-5


@pytest.mark.parametrize("given", [[], np.zeros((0, 3)), "device"])
def test_no_points_give_no_rows(given, device):
    cage, _ = cage_and_points("box")
    given = wp.empty(0, dtype=wp.vec3, device=device) if isinstance(given, str) else given
    assert coordinates.mean_value_coordinates(given, cage, device=device).shape == (0, 8)
    assert [a.shape for a in coordinates.green_coordinates(given, cage, device=device)] == [(0, 8), (0, 12)]
    for kind in CLOSED_FORMS:
        assert len(coordinates.deform_points(given, cage, cage.scale(2.0), kind, device=device)) == 0


@pytest.mark.parametrize("name", ["icosphere", "concave", "two boxes"])
def test_mean_value_reproduces_affine_maps(name, device):
    rest, points = cage_and_points(name, center=(50.0, -20.0, 1e3), scale=3.0)
    points = np.concatenate([points, rest.vertices, rest.vertices[rest.faces].mean(axis=1), points + 2.0])
    matrix, offset = rotation() @ np.array([[1, 0.7, 0], [0, 2.0, 0.1], [0, 0, 0.4]]), [1e3, 0, 5]
    deformed = rest.with_vertices(rest.vertices @ matrix.T + offset)
    moved = coordinates.deform_points(points, rest, deformed, device=device)
    assert moved.dtype == np.float64
    assert np.abs(moved - points @ matrix.T - offset).max() < 1e-5 * rest.size


@pytest.mark.parametrize("name", ["icosphere", "concave", "two boxes"])
@pytest.mark.parametrize("factor", [1.0, 5.0, 0.2])
def test_green_reproduces_similarities(name, factor, device):
    rest, points = cage_and_points(name, center=(50.0, -20.0, 1e3), scale=3.0)
    points = np.concatenate([points, rest.vertices, rest.vertices[rest.faces].mean(axis=1)])
    matrix, offset = factor * rotation(), [1e3, 0, 5]
    deformed = rest.with_vertices(rest.vertices @ matrix.T + offset)
    moved = coordinates.deform_points(points, rest, deformed, "green", device=device)
    assert np.abs(moved - points @ matrix.T - offset).max() < 3e-5 * max(rest.size, deformed.size)


def test_deform_points_is_the_weighted_sum(device):
    rest, points = cage_and_points("concave")
    deformed = rest.with_vertices(rest.vertices + 0.2 * np.random.default_rng(4).normal(size=rest.vertices.shape))
    weights = coordinates.mean_value_coordinates(points, rest, device=device)
    moved = coordinates.deform_points(points, rest, deformed, device=device)
    assert np.abs(moved - weights @ deformed.vertices).max() < 1e-5
    phi, psi = coordinates.green_coordinates(points, rest, device=device)
    moved = coordinates.deform_points(points, rest, deformed, "green", device=device)
    wanted = phi @ deformed.vertices + psi @ stretched_normals(rest, deformed)
    assert np.abs(moved - wanted).max() < 1e-5


def test_deform_points_moves_meshes_and_keeps_precision(device):
    rest = Cage.icosphere((0, 0, 0), 2.0)
    mesh = trimesh.creation.icosphere(subdivisions=2)
    moved = coordinates.deform_points(mesh.vertices, rest, rest.scale(3.0), device=device)
    assert np.abs(moved - 3 * mesh.vertices).max() < 1e-5
    single = coordinates.deform_points(np.asarray(mesh.vertices, np.float32), rest, rest, device=device)
    assert single.dtype == np.float32


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


def test_points_outside_are_refused_by_green_and_taken_by_mean_value(device):
    cage, points = cage_and_points("box")
    points[[7, 9]] += 5.0
    for call in (
        lambda p: coordinates.green_coordinates(p, cage, device=device),
        lambda p: coordinates.deform_points(p, cage, cage, "green", device=device),
    ):
        for given in (points, wrapped(points, "vec3", device)):
            with pytest.raises(ValueError, match=MESSAGES["coordinates.points_outside"]):
                call(given)
    phi, psi = coordinates.green_coordinates(points, cage, device=device, outside="nan")
    lost = np.isin(np.arange(len(points)), [7, 9])
    assert np.isnan(phi[lost]).all() and np.isnan(psi[lost]).all()
    assert np.isfinite(phi[~lost]).all() and np.isfinite(psi[~lost]).all()
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
        with pytest.raises(ValueError, match="outside"):
            coordinates.green_coordinates(beyond, cage, device=device)


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
    for call in (
        lambda: coordinates.mean_value_coordinates(points, cage, device=device),
        lambda: coordinates.green_coordinates(points, cage, device=device),
        lambda: coordinates.deform_points(points, cage, cage, device=device),
    ):
        with pytest.raises(ValueError, match=message) as caught:
            call()
        assert "\n" not in str(caught.value)


def test_bad_cages_and_options_are_refused(device):
    cage, points = cage_and_points("box")
    opened, inward = Cage(cage.vertices, cage.faces[1:]), Cage(cage.vertices, cage.faces[:, ::-1])
    for bad, message in ((opened, "open"), (inward, "inward")):
        for call in (
            coordinates.mean_value_coordinates,
            coordinates.green_coordinates,
            coordinates.harmonic_coordinates,
        ):
            with pytest.raises(ValueError, match=message):
                call(points, bad, device=device)
        with pytest.raises(ValueError, match=message):
            coordinates.deform_points(points, bad, bad, device=device)
    other, _ = cage_and_points("concave")
    with pytest.raises(ValueError, match="vertices"):
        coordinates.deform_points(points, cage, other, device=device)
    with pytest.raises(ValueError, match="harmonic, mean_value, green"):
        coordinates.deform_points(points, cage, cage, "mvc", device=device)
    with pytest.raises(ValueError, match="one of extend, raise, nan"):
        coordinates.green_coordinates(points, cage, device=device, outside="zero")
    with pytest.raises(ValueError, match="cuda:77"):
        coordinates.mean_value_coordinates(points, cage, device="cuda:77")


def test_harmonic_matches_boundary_elements(device):
    cage, points = cage_and_points("icosphere", count=200)
    points *= 0.75  # clear of the cage
    weights = coordinates.harmonic_coordinates(points, cage, 48, device=device)
    wanted = oracles.harmonic_oracle(cage.vertices, cage.faces, np.eye(len(cage.vertices)), points, 2)
    assert np.abs(weights - wanted).max() < 5e-3
    assert np.abs(weights.sum(axis=1) - 1).max() < 1e-4


def test_harmonic_moves_points_and_refuses_those_outside(device, monkeypatch):
    monkeypatch.setattr("warpcage.coordinates.coordinates.HARMONIC_RESOLUTION", 32)
    rest, points = cage_and_points("concave", center=(1e3, 0, 0), scale=2.0)
    matrix = rotation() @ np.diag([1.0, 2.0, 0.5])
    deformed = rest.with_vertices(rest.vertices @ matrix.T)
    moved = coordinates.deform_points(points, rest, deformed, "harmonic", device=device)
    assert np.abs(moved - points @ matrix.T).max() < 1e-4 * rest.size
    with pytest.raises(ValueError, match="1 of 1 points is outside"):
        coordinates.deform_points(rest.vertices[:1] + 10.0, rest, deformed, "harmonic", device=device)
    with pytest.raises(ValueError, match="1 of 1 points is outside"):
        coordinates.harmonic_coordinates(rest.vertices[:1] + 10.0, rest, 32, device=device)


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
    with pytest.raises(ValueError, match="^deformed cage looks inward"):
        coordinates.deform_points(points, rest, mirrored, "harmonic", device=device)


WEIGHTS = {
    "mean_value": coordinates.mean_value_coordinates,
    "green": coordinates.green_coordinates,
    "harmonic": lambda points, cage, **options: coordinates.harmonic_coordinates(points, cage, 16, **options),
}


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

    def weights(which, **options):
        found = WEIGHTS[kind](which, cage, device=device, **options)
        return [host(each) for each in (found if isinstance(found, tuple) else (found,))]

    def move(which, **options):
        return host(coordinates.deform_points(which, cage, pose, kind, device=device, **options))

    for take in (weights, move):
        with pytest.raises(ValueError, match="2 of 13 points are outside .* point 4"):
            take(given, outside="raise")
        with pytest.raises(ValueError, match="one of extend, raise, nan"):
            take(given, outside="keep")
    for marked, plain in zip(weights(given, outside="nan"), weights(points[~lost]), strict=True):
        assert np.isnan(marked[lost]).all()
        np.testing.assert_allclose(marked[~lost], plain, atol=1e-6)
    moved = move(given, outside="nan")
    assert np.isnan(moved[lost]).all()
    np.testing.assert_allclose(moved[~lost], points[~lost] + [0.1, 0.2, 0.3], atol=2e-4 * cage.size)
    if kind == "mean_value":  # which alone is defined there, up to a thousand times the size away
        assert np.allclose(move(points[5:], outside="extend"), move(points[5:]), atol=0)
        with pytest.raises(ValueError, match="1 of 13 points is 1000 times"):
            move(given)
    else:
        for take in (weights, move):
            with pytest.raises(ValueError, match="not defined outside of a cage"):
                take(given, outside="extend")
        with pytest.raises(ValueError, match="2 of 13 points are outside"):
            move(given)


def host(array):
    return array.numpy() if isinstance(array, wp.array) else array
