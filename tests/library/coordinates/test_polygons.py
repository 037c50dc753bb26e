"""Coordinates in cages of quads and other polygons: all corners of a face count alike, warped quads are bilinear."""

import numpy as np
import oracles
import pytest
from polygon_cages import concave_prism, mixed_prism, patch_rows, quad_box, quad_cube, triangulated
from refusals import refused

import warpcage
from warpcage import Cage, PositionMap, deform_points, green_coordinates, harmonic_coordinates, mean_value_coordinates
from warpcage.coordinate_kinds import COORDINATE_KINDS
from warpcage.coordinates import stretched_normals

KINDS = tuple(COORDINATE_KINDS)
CAGES = {"cube": quad_cube, "warped": lambda: quad_box(2, 0.2), "mixed": mixed_prism, "concave": concave_prism}


def points_in(cage: Cage, count: int = 60, seed: int = 1) -> np.ndarray:
    """Points inside a cage, clear of its faces."""
    low, high = cage.bounds
    points = np.random.default_rng(seed).uniform(low, high, (20 * count, 3))
    inside = points[cage.contains(points, device="cpu")]
    clear = oracles.reference_distance(inside, cage.surface.vertices, cage.surface.faces) > 0.03 * cage.size
    return inside[clear][:count]


def lifted(cage: Cage, corner: int) -> Cage:
    return cage.move((0.0, 0.0, 1.0), group=[corner])


@pytest.mark.parametrize("kind", KINDS)
def test_mirrored_lifts_move_a_point_in_the_middle_alike(kind, device):
    cage, point = quad_cube(), np.array([[0.0, 0.0, 0.9], [0.0, 0.0, 0.2]])
    rises = np.stack([deform_points(point, cage, lifted(cage, k), kind, device=device)[:, 2] for k in (4, 5, 6, 7)])
    assert np.ptp(rises, axis=0).max() < 1e-5
    # with triangles they differ by which corners the diagonal joins
    split = triangulated(cage)
    rises = np.stack([deform_points(point, split, lifted(split, k), kind, device=device)[:, 2] for k in (4, 5, 6, 7)])
    assert np.ptp(rises[:, 0]) > 0.05


@pytest.mark.parametrize("store", ["map", "weights"])
@pytest.mark.parametrize("kind", KINDS)
def test_mirrored_lifts_are_mirrored_on_lattices(kind, store, device):
    cage, found = quad_cube(), []
    for corner in (4, 5, 6, 7):
        posed = lifted(cage, corner)
        position_map = PositionMap(cage, coordinates=kind, resolution=24, store=store, device=device).pose(posed)
        found.append(oracles.look_up(position_map, np.array([[0.0, 0.0, 0.9]]))[0][0])
    # lattices are not symmetric: they lie aside of the cage by an irrational share of a cell
    assert np.ptp(found, axis=0)[2] < (2e-4 if kind == "harmonic" else 1e-3)


@pytest.mark.parametrize("name", CAGES)
def test_weights_are_those_of_the_cage_and_reproduce_points_and_poses(name, device):
    cage = CAGES[name]()
    points, posed = points_in(cage), cage.twist(20.0).scale((1.1, 1.0, 0.9))
    for kind, weights in (
        ("mean_value", mean_value_coordinates(points, cage, device=device)),
        ("harmonic", harmonic_coordinates(points, cage, 32, device=device)),
    ):
        assert weights.shape == (len(points), len(cage.vertices))
        np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=2e-5)
        np.testing.assert_allclose(weights @ cage.vertices, points, atol=3e-5 * cage.size)
        if kind == "mean_value":
            expected = deform_points(points, cage, posed, kind, device=device)
            np.testing.assert_allclose(weights @ posed.vertices, expected, atol=5e-6 * cage.size)
    by_vertex, by_face = green_coordinates(points, cage, device=device)
    assert by_vertex.shape == (len(points), len(cage.vertices)) and by_face.shape[1] == len(cage.refined(1).faces)
    np.testing.assert_allclose(by_vertex @ cage.vertices + by_face @ stretched_normals(cage, cage), points, atol=1e-5)
    expected = deform_points(points, cage, posed, "green", device=device)
    found = by_vertex @ posed.vertices + by_face @ stretched_normals(cage, posed)
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize("name", ["cube", "mixed", "concave"])
@pytest.mark.parametrize("kind", KINDS)
def test_poses_that_keep_faces_affine_are_those_of_triangles(name, kind, device):
    # on faces that are flat at rest and affine in the pose, any cut has the same values on the same surface
    cage = CAGES[name]()
    posed = cage.scale((1.3, 0.8, 1.1)).rotate(30.0, axis=(1.0, 1.0, 0.0))
    points, split = points_in(cage), triangulated(cage)
    posed = posed if not COORDINATE_KINDS[kind].has_face_weights else cage.scale(1.2).rotate(30.0, axis=(1.0, 1.0, 0.0))
    found = deform_points(points, cage, posed, kind, device=device)
    expected = deform_points(points, split, split.with_vertices(posed.vertices), kind, device=device)
    np.testing.assert_allclose(found, expected, atol=(3e-6 if kind != "harmonic" else 3e-5) * cage.size)


@pytest.mark.parametrize("kind", ["mean_value", "green"])
def test_parallel_sides_that_shear_are_those_of_triangles(kind, device):
    # each side of the cube stays a parallelogram, no two alike: a map that is not affine inside
    cage = quad_cube().twist(0.0)
    side = cage.vertices[:, 0] > 0
    posed = cage.with_vertices(cage.vertices + np.where(side[:, None], [0.4, 0.3, -0.2], 0.0))
    split, points = triangulated(cage, 1), points_in(cage)
    found = deform_points(points, cage, posed, kind, device=device)
    expected = deform_points(points, split, split.with_vertices(posed.vertices), kind, device=device)
    np.testing.assert_allclose(found, expected, atol=2e-6 * cage.size)


@pytest.mark.parametrize("kind", ["mean_value", "green"])
def test_closed_forms_are_those_of_the_surface(kind, device):
    cage = quad_box(2, 0.2)
    fine, points = cage.refined(COORDINATE_KINDS[kind].face_cells), points_in(cage)
    if kind == "mean_value":  # of the bilinear patches themselves
        expected = oracles.quad_mean_value_weights(points, cage.vertices, cage.polygons)
        found = mean_value_coordinates(points, cage, device=device)
        np.testing.assert_allclose(found, expected, atol=3e-6)
    else:
        expected, psi = oracles.green_weights(points, fine.vertices, fine.faces)
        found, lengths = green_coordinates(points, cage, device=device)
        np.testing.assert_allclose(found, expected @ fine.operator, atol=1e-5)
        np.testing.assert_allclose(lengths, psi, atol=1e-5)


def test_harmonic_maps_of_warped_quads_are_those_of_boundary_elements_over_bilinear_patches(device):
    cage = quad_box(1, 0.15, seed=3)
    posed = cage.vertices + 0.3 * np.random.default_rng(4).uniform(-1.0, 1.0, cage.vertices.shape)
    rows, triangles = patch_rows(cage, 10)
    vertices = rows @ cage.vertices
    points = points_in(cage, 120)
    moved = oracles.harmonic_oracle(vertices, triangles, rows @ posed, points, subdivisions=0)
    found = deform_points(points, cage, posed, "harmonic", device=device)
    error = np.linalg.norm(found - moved, axis=1) / cage.size
    clear = oracles.reference_distance(points, vertices, triangles) > 0.1 * cage.size
    assert np.sqrt(np.mean(error[clear] ** 2)) < 1e-3 and np.sqrt(np.mean(error**2)) < 1e-2
    split = triangulated(cage)
    off = deform_points(points, split, split.with_vertices(posed), "harmonic", device=device) - moved
    assert np.sqrt((off**2).sum(axis=1).mean()) / cage.size > 1e-2  # what triangles of any cut are off by


def test_surfaces_come_nearer_to_the_bilinear_patch_with_cells():
    cage = quad_box(1, 0.2, seed=5)
    rows, _ = patch_rows(cage, 24)
    patch = rows @ cage.vertices
    off = [oracles.reference_distance(patch, fine.vertices, fine.faces).max() for fine in map(cage.refined, (1, 2))]
    warp = max(abs(np.linalg.det(np.diff(cage.vertices[list(q)], axis=0))) for q in cage.polygons)
    assert off[1] < 0.3 * off[0] and off[0] < warp


@pytest.mark.parametrize("name", CAGES)
def test_a_surface_is_closed_and_symmetric_in_the_corners_of_its_faces(name):
    cage = CAGES[name]()
    for fine in (cage.refined(1), cage.surface):
        assert not fine.topology.problem and fine.topology.genus == cage.topology.genus == 0
        np.testing.assert_array_equal(fine.vertices[: len(cage.vertices)], cage.vertices)
        np.testing.assert_allclose(fine.vertices, fine.operator @ cage.vertices, atol=1e-15)
        np.testing.assert_allclose(fine.operator.sum(axis=1), 1.0, atol=1e-15)
    turned = Cage(cage.vertices, [(*face[1:], face[0]) for face in cage.polygons])
    for cells in (1, 2) if name != "concave" else ():  # whose hexagons have diagonals
        one, two = (mesh.refined(cells) for mesh in (cage, turned))
        np.testing.assert_allclose(*(sorted(each.vertices.round(12).tolist()) for each in (one, two)), atol=1e-12)
        assert one.volume == pytest.approx(two.volume, rel=1e-12)


def test_triangle_cages_are_their_own_surface():
    cage = Cage.icosphere((0.0, 0.0, 0.0), 1.0)
    assert cage.surface is cage and cage.refined(1) is cage and cage.operator is None
    assert cage.polygon_faces is None and cage.face_array is cage.faces
    assert cage.polygons == tuple(map(tuple, cage.faces.tolist()))
    assert Cage(cage.vertices, [list(face) for face in cage.polygons]).polygon_faces is None


def test_a_pose_of_a_quad_cage_may_be_its_triangles_and_the_other_way_round(device):
    cage, points = quad_box(2, 0.1), np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3))
    posed = cage.bend(30.0)
    expected = deform_points(points, cage, posed, device=device)
    for turn in (0, 1):
        split = triangulated(posed, turn)
        np.testing.assert_array_equal(deform_points(points, cage, split, device=device), expected)
        rest = triangulated(cage, turn)
        of_triangles = deform_points(points, rest, split, device=device)
        np.testing.assert_array_equal(deform_points(points, rest, posed, device=device), of_triangles)
        assert np.abs(of_triangles - expected).max() > 1e-4


def test_rebinding_a_pose_gives_the_map_of_the_other_rest_cage(device):
    cage = quad_box(2, 0.1)
    posed, other = cage.twist(20.0), cage.scale((1.2, 1.0, 0.9))
    points = 0.8 * posed.surface.vertices
    for kind in KINDS:
        options = {"coordinates": kind, "resolution": 24, "device": device, "origin": (0.0, 0.0, 0.0)}
        held = PositionMap(cage, **options, store="weights").pose(posed)
        assert held.weights.blocks[0][1].shape[1] == len(cage.vertices)
        expected, _ = oracles.look_up(PositionMap(other, **options).pose(posed), points)
        np.testing.assert_allclose(oracles.look_up(held.rebind(other), points)[0], expected, atol=5e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_parts_within_parts_are_cavities_or_refused(kind, device):
    """Between two shells that both look outward mean value weights have poles, and within both Green's count twice."""
    cube = quad_cube()
    vertices = np.concatenate([cube.vertices, 0.5 * cube.vertices])
    faces = np.array(cube.polygons)
    cavity, doubled = (Cage(vertices, [*faces, *inner]) for inner in (faces[:, ::-1] + 8, faces + 8))
    posed, points = vertices + np.random.default_rng(5).normal(0.0, 0.01, vertices.shape), points_in(cavity)
    moved = deform_points(points, cavity, posed, kind, device=device)
    assert np.linalg.norm(moved - points, axis=1).max() < 0.1
    if kind in ("harmonic", "maximum_likelihood"):
        assert np.abs(deform_points(points, doubled, posed, kind, device=device) - points).max() < 0.1
        return
    for act in (
        lambda: deform_points(points, doubled, posed, kind, device=device),
        lambda: PositionMap(doubled, coordinates=kind, device=device),
        lambda: getattr(warpcage, f"{kind}_coordinates")(points, doubled, device=device),
    ):
        refused(act, "parts inside each other that both look outward, the first with face 6")
