"""Generated cages of quads, with a focus, and symmetric where the object is: against NumPy and matchings by hand."""

import itertools

import numpy as np
import pytest
import scipy.spatial
import trimesh
from fields import GridField, ball_densities
from messages import MESSAGES
from polygon_cages import quad_box, triangulated
from refusals import refused
from test_cage_generation import winding

from warpcage import Cage, NodeSelection, PoseFile
from warpcage.cage import bending_of, nearest_mirror, paired, quad_weights

make = trimesh.creation


def tee():
    """Three boxes: symmetric about x, not about y or z."""
    parts = [make.box(bounds=b) for b in ([[-1, 0, 0], [1, 0.3, 0.3]], [[-0.2, 0, 0], [0.2, 0.3, 1]])]
    return trimesh.util.concatenate([*parts, make.box(bounds=[[-0.2, 0, 0.7], [0.2, 0.7, 1]])])


def bilinear_points(cage, count=7):
    """Points on the patches of a cage's quads, and on its triangles, by their own formulas."""
    u, v = (grid.reshape(-1, 1) for grid in np.meshgrid(*[np.linspace(0, 1, count)] * 2))
    points = []
    for face in cage.polygons:
        corners = cage.vertices[list(face)]
        a, b, c = corners[:3]
        if len(face) == 4:
            points.append((1 - u) * (1 - v) * a + u * (1 - v) * b + u * v * c + (1 - u) * v * corners[3])
        else:
            points.append(a + (1 - v) * u * (b - a) + v * (c - a))
    return np.concatenate(points)


SHAPES = {"tee": tee, "torus": lambda: make.torus(1.0, 0.3)}


@pytest.mark.parametrize("shape", [*SHAPES])
def test_cages_of_quads_enclose_by_their_patches(shape):
    mesh = SHAPES[shape]()
    cage = Cage.from_mesh(mesh, 50, method="shell", faces="quads")
    triangles = Cage.from_mesh(mesh, 50, method="shell")
    report = cage.check(mesh=mesh)
    assert report.usable and report.intersecting_faces == () and report.concave_faces == ()
    assert report.mesh_enclosed == 1.0 and report.genus == (1 if shape == "torus" else 0)
    sizes = np.array([len(face) for face in cage.polygons])
    assert set(sizes) <= {3, 4} and (sizes == 4).mean() > 0.85
    assert 2 * (sizes == 4).sum() + (sizes == 3).sum() == triangles.face_count  # each triangle once
    assert triangles.volume * 0.8 < cage.volume < 1.1 * triangles.volume
    points = np.concatenate([mesh.vertices[:200], mesh.sample(200, seed=0)])
    for fine in (cage.refined(1), cage.refined(2)):
        assert (winding(points, fine.vertices, fine.faces) > 0.99).all()
    off = trimesh.proximity.closest_point_naive(mesh, bilinear_points(cage))[1]
    assert off.min() > 0.005 * np.ptp(mesh.vertices, axis=0).max()  # patches differ from triangles of the surface


def test_triangles_in_place_of_quads_are_said(monkeypatch):
    from warpcage.cage import generate

    monkeypatch.setattr(generate, "quad_cage", lambda shell, cage, plane: cage)  # as where none holds
    with pytest.warns(UserWarning, match=MESSAGES["cage.no_quads"]):
        cage = Cage.from_mesh(make.icosphere(2), 30, method="shell", faces="quads")
    assert {len(face) for face in cage.polygons} == {3}


def test_the_matching_is_the_best_one_by_trial_of_all():
    box = triangulated(quad_box(1, 0.4, seed=3))
    vertices, faces = box.vertices, box.faces.astype(np.int64)
    possible = []
    for one, two in itertools.combinations(range(len(faces)), 2):
        common = set(faces[one]) & set(faces[two])
        if len(common) == 2:
            k = next(k for k in range(3) if faces[one][k] not in common)
            top = next(corner for corner in faces[two] if corner not in common)
            quad = [faces[one][(k + 1) % 3], top, faces[one][(k + 2) % 3], faces[one][k]]
            possible.append((quad_weights(vertices, np.array([quad]))[0], one, two))
    assert len(possible) == 18

    def best(left, rows):
        if not rows:
            return 0.0
        (weight, one, two), *others = rows
        without = best(left, others)
        free = weight > 0.0 and one in left and two in left
        return max(without, weight + best(left - {one, two}, others)) if free else without

    found = paired(vertices, faces)
    total = quad_weights(vertices, found).sum()
    assert total == pytest.approx(best(frozenset(range(12)), possible), rel=3e-3)


def test_a_cube_cut_anyhow_becomes_its_six_squares():
    cube = quad_box(1)
    for turn in (0, 1):
        found = {frozenset(quad) for quad in paired(cube.vertices, triangulated(cube, turn).faces).tolist()}
        assert found == {frozenset(quad) for quad in cube.polygons}


def test_fields_get_cages_of_quads_with_other_numbers_of_corners_kept_in_files(tmp_path):
    field = GridField(ball_densities(24))
    cage = Cage.from_field(field, 40, faces="quads")
    assert cage.check(field=field).field_enclosed == 1.0 and max(map(len, cage.polygons)) == 4
    cage.save(tmp_path / "cage.obj")
    assert Cage.load(tmp_path / "cage.obj").polygons == cage.polygons
    refused(lambda: Cage.from_field(field, 40, faces="pentagons"), match="faces")


# -- Symmetric cages


@pytest.mark.parametrize("method", [pytest.param("voxel", marks=pytest.mark.nightly), "shell"])
def test_symmetric_quads_are_the_same_on_both_sides(method):
    mesh = tee()
    cage = Cage.from_mesh(mesh, 60, method=method, symmetry="auto", faces="quads")
    assert cage.check(mesh=mesh).mesh_enclosed == 1.0
    image = cage.vertices * [-1, 1, 1]
    distances = np.linalg.norm(image[:, None] - cage.vertices[None], axis=2)
    assert distances.min(axis=1).max() < 1e-9
    other = distances.argmin(axis=1)
    assert {frozenset(face) for face in cage.polygons} == {frozenset(other[list(face)]) for face in cage.polygons}
    assert sum(len(face) == 4 for face in cage.polygons) > 0.85 * cage.face_count


def test_the_plane_across_which_a_shape_is_nearly_the_same_is_found():
    points = tee().sample(4000, seed=1)
    for axis, name in enumerate("xyz"):
        turned = np.roll(points, axis, axis=1)
        assert nearest_mirror(turned + [3.0, -2.0, 7.0], 0.02) == name
        bumped = np.concatenate([turned, turned[:60] + 0.02])
        assert nearest_mirror(bumped, 0.02) == name
    skew = points @ np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    assert nearest_mirror(skew, 0.02) is None


def test_auto_takes_no_plane_where_there_is_none():
    mesh = tee().apply_transform(trimesh.transformations.rotation_matrix(0.6, [1, 2, 3]))
    plain, found = (Cage.from_mesh(mesh, 40, method="shell", symmetry=symmetry) for symmetry in (None, "auto"))
    np.testing.assert_array_equal(found.vertices, plain.vertices)
    refused(lambda: Cage.from_mesh(mesh, 40, symmetry="w"), match="symmetry must be")


# -- Focus


def halves(cage):
    """Of a cage about the origin: how many vertices are on each side of x = 0, and the mean length of edges there."""
    ends = cage.vertices[cage.edges]
    lengths, side = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1), ends[:, :, 0].mean(axis=1)
    return (
        [(cage.vertices[:, 0] < 0).sum(), (cage.vertices[:, 0] > 0).sum()],
        [lengths[side < -0.5].mean(), lengths[side > 0.5].mean()],
    )


def test_points_of_a_focus_get_more_vertices_at_the_same_count():
    rod = make.box([4.0, 0.6, 0.6])
    points = rod.sample(2000, seed=0)
    even, fine = Cage.from_mesh(rod, 80, method="shell"), Cage.from_mesh(
        rod, 80, focus=points[points[:, 0] > 0.5], finer=2.0
    )  # fmt: skip
    assert abs(len(fine.vertices) - 80) <= 8 and fine.check(mesh=rod).mesh_enclosed == 1.0
    counts, lengths = halves(fine)
    assert counts[1] > 1.6 * counts[0] and lengths[0] > 1.4 * lengths[1]
    counts, lengths = halves(even)
    assert 0.8 < counts[0] / counts[1] < 1.25
    for bad, line in (
        ({"focus": np.zeros((0, 3))}, "focus has no points"),
        ({"focus": points, "finer": 0.5}, "finer must be a number from 1 to 8"),
        ({"finer": 30}, "finer must be a number from 1 to 8"),
        ({"focus": "arm"}, "it takes points, a selection, a Pose"),
        ({"focus": fine}, "it takes points, a selection, a Pose"),
        ({"focus": 1e4 * points[:9] + 1e6}, "nowhere near the object"),
        ({"focus": points, "method": "voxel"}, "a focus needs method 'shell'"),
        ({"margin": 4.5}, "at most the mesh's size, 4, got 4.5"),
    ):
        refused(lambda bad=bad: Cage.from_mesh(rod, 80, **bad), line)


def test_selected_nodes_are_a_focus():
    field = GridField(ball_densities(24))
    mask = np.zeros((24, 24, 24), dtype=bool)
    mask[14:] = True  # x above the middle
    cage = Cage.from_field(field, 60, focus=NodeSelection(field, mask))
    counts, _ = halves(cage)
    assert counts[1] > 1.3 * counts[0] and cage.check(field=field).field_enclosed == 1.0
    nothing = NodeSelection(field, np.zeros((24, 24, 24), dtype=bool))
    refused(lambda: Cage.from_field(field, 60, focus=nothing), match="focus has no points")
    refused(lambda: Cage.from_field(field, 60, margin=30), match="the object's size in voxels, 1")


def test_a_focus_has_an_effect_on_small_objects_or_it_is_said_that_it_has_none(recwarn):
    field = GridField(ball_densities(16))
    mask = np.zeros((16, 16, 16), dtype=bool)
    mask[9:] = True
    some = NodeSelection(field, mask)
    counts, _ = halves(Cage.from_field(field, 40, focus=some))
    assert counts[1] > 1.5 * counts[0] and not [each for each in recwarn if "focus" in str(each.message)]
    with pytest.warns(UserWarning, match=MESSAGES["cage.no_effect"]):
        cage = Cage.from_field(field, 20, focus=some, finer=4.0)
    middle = cage.vertices[cage.edges].mean(axis=1)[:, 0]
    lengths = np.linalg.norm(np.diff(cage.vertices[cage.edges], axis=1)[:, 0], axis=1)
    assert lengths[middle > 0.3].mean() > 0.9 * lengths[middle < -0.3].mean()  # as the warning says


def test_a_cage_is_finer_where_a_pose_file_bends_another_one():
    rod = make.box([4.0, 0.6, 0.6])
    rest = Cage.box([-2.2, -0.5, -0.5], [2.2, 0.5, 0.5], segments=(8, 1, 1))
    film = PoseFile(rest, {"up": rest.bend(60, axis="x", towards="z", limits=(0.6, 0.9)), "still": rest})
    bending = bending_of(rest, film["up"])
    assert bending[rest.vertices[:, 0] < -0.6].max() < 1e-9 < 0.02 < bending[rest.vertices[:, 0] > 0.6].min()
    one, two = (Cage.from_mesh(rod, 60, focus=focus, finer=2.5) for focus in (film, [rest, film["up"]]))
    counts, _ = halves(one)
    assert counts[1] > 1.4 * counts[0]
    np.testing.assert_array_equal(one.vertices, two.vertices)
    refused(lambda: Cage.from_mesh(rod, 80, focus=PoseFile(rest, {"turned": rest.rotate(30)})), match="bends nowhere")
    refused(lambda: Cage.from_mesh(rod, 80, focus=PoseFile(rest)), match="no pose")


def test_bending_is_what_is_left_of_the_best_turn():
    rest = Cage.icosphere([0, 0, 0], 1.0, 1)
    assert bending_of(rest, rest.rotate(70, axis="y").translate((1, 2, 3))).max() < 1e-12
    # a uniform scale leaves no turn anything to do: |1.2 e - e| / |e|
    np.testing.assert_allclose(bending_of(rest, rest.scale(1.2)), 0.2, atol=1e-12)
    posed = rest.random_pose(4)
    vertex = 3
    ring = sorted({*rest.edges[(rest.edges == vertex).any(axis=1)].reshape(-1).tolist()} - {vertex})
    before, after = (cage.vertices[ring] - cage.vertices[vertex] for cage in (rest, posed))
    _, off = scipy.spatial.transform.Rotation.align_vectors(after, before)
    assert bending_of(rest, posed)[vertex] == pytest.approx(off / np.linalg.norm(before), rel=1e-6)


@pytest.mark.parametrize("seed", [0, 1])
def test_specks_about_an_object_leave_it_its_quads(seed):
    """Drawn close, patches pass one of the specks; kept off alone they hold all."""
    random = np.random.default_rng(seed)
    places = random.normal(size=(5, 3))
    places *= 1.25 / np.linalg.norm(places, axis=1, keepdims=True)
    specks = [trimesh.creation.icosphere(0, radius=0.01) for _ in places]
    for speck, place in zip(specks, places, strict=True):
        speck.apply_translation(place * random.uniform(0.8, 1.1))
    mesh = trimesh.util.concatenate([trimesh.creation.icosphere(3), *specks])
    cage = Cage.from_mesh(mesh, 60, faces="quads", method="shell")
    assert sum(len(face) == 4 for face in cage.polygons) > 40 and cage.contains(np.asarray(mesh.vertices)).all()
