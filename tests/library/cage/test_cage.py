import copy
import pickle

import numpy as np
import pytest
import trimesh
from messages import MESSAGES
from refusals import refused

from warpcage import Cage
from warpcage.mesh import intersecting_faces, queries, require_same_faces


def tetrahedron():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    return vertices, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


def test_holds_copies_that_cannot_be_changed():
    vertices, faces = tetrahedron()
    cage = Cage(vertices, faces)
    vertices[0] = 9.0
    faces[0] = 0
    assert cage.vertices[0].tolist() == [0, 0, 0] and cage.faces[0].tolist() == [0, 2, 1]
    assert cage.vertices.dtype == np.float64 and cage.faces.dtype == np.int32
    with pytest.raises(ValueError):
        cage.vertices[0] = 1.0
    with pytest.raises(AttributeError):
        cage.vertices = vertices


def test_measures_of_a_tetrahedron():
    cage = Cage(*tetrahedron())
    assert cage.volume == pytest.approx(1 / 6, rel=1e-12)
    assert cage.size == 1.0
    assert cage.bounds.tolist() == [[0, 0, 0], [1, 1, 1]]
    assert sorted(map(tuple, cage.edges.tolist())) == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v, f: (v[:, :2], f), "must be (n, 3)"),
        (lambda v, f: (np.where(v == 1, np.nan, v), f), "must be finite"),
        (lambda v, f: (v, f[:, :2]), "(f, 3)"),
        (lambda v, f: (v, f[:0]), "at least one"),
        (lambda v, f: (v, f + 1), "indices must be 0 to 3"),
        (lambda v, f: (v, f - 1), "indices must be 0 to 3"),
        (lambda v, f: (v, f.astype(float)), "whole numbers"),
    ],
)
def test_refuses_what_cannot_be_held(change, message):
    refused(lambda: Cage(*change(*tetrahedron())), message)


def broken_cages():
    vertices, faces = tetrahedron()
    flipped = faces.copy()
    flipped[2] = flipped[2][::-1]
    two = np.concatenate([vertices, vertices[1:] * -1])
    mirrored = np.where(faces == 0, 0, faces + 3)[:, ::-1]
    flat = vertices.copy()
    flat[3] = [0.5, 0.5, 1e-12]
    return {
        "open": (vertices, faces[:3]),
        "inward": (vertices, faces[:, ::-1]),
        "inconsistently": (vertices, flipped),
        "more than two faces": (vertices, np.concatenate([faces, faces[:1]])),
        "only touch": (two, np.concatenate([faces, mirrored])),
        "names a vertex twice": (vertices, np.concatenate([faces, [[1, 1, 2]]])),
        "without area": (flat, faces),
        "at the place of another": (np.concatenate([vertices, vertices]), np.concatenate([faces, faces + 4])),
    }


@pytest.mark.parametrize("what", list(broken_cages()))
def test_unusable_cages_are_refused_in_one_line(what):
    cage = Cage(*broken_cages()[what])
    for _ in range(2):  # the second time from what was remembered
        said = refused(lambda: cage.require_usable("rest cage"))
        assert said.startswith("rest cage ")
    expected = "names a vertex twice|more than two faces" if what == "names a vertex twice" else what
    assert any(part in said for part in expected.split("|"))
    report = cage.check()
    assert not report.usable
    assert said.removeprefix("rest cage ") in str(report)


def test_report_names_each_fault():
    reports = {what: Cage(*parts).check() for what, parts in broken_cages().items()}
    assert not reports["open"].closed and len(reports["open"].open_edges) == 3
    assert not reports["inward"].oriented and reports["inward"].inward_parts == (0,)
    assert len(reports["inconsistently"].clashing_edges) == 3
    assert reports["only touch"].pinched_vertices == (0,) and not reports["only touch"].manifold
    assert len(reports["without area"].degenerate_faces) >= 1
    assert len(reports["more than two faces"].crowded_edges) == 3
    assert len(reports["at the place of another"].coincident_vertices) == 4


def test_a_cavity_may_look_inward_but_a_part_beside_may_not():
    outer, inner = Cage.icosphere([0, 0, 0], 2.0), Cage.icosphere([0, 0, 0], 1.0)

    def joined(offset):
        vertices = np.concatenate([outer.vertices, inner.vertices + offset])
        return Cage(vertices, np.concatenate([outer.faces, inner.faces[:, ::-1] + len(outer.vertices)]))

    hollow = joined(0.0)
    hollow.require_usable()
    assert hollow.volume == pytest.approx(outer.volume - inner.volume)
    assert hollow.contains([[0, 0, 0], [1.5, 0, 0]]).tolist() == [False, True]
    refused(lambda: joined(5.0).require_usable(), match="looks inward")


def test_unused_vertices_are_kept_and_reported():
    vertices, faces = tetrahedron()
    cage = Cage(np.concatenate([[[7.0, 7, 7]], vertices]), faces + 1)
    cage.require_usable()
    assert cage.size == 1.0 and len(cage.vertices) == 5
    assert cage.check().unused_vertices == (0,)


@pytest.mark.parametrize(
    ("cage", "count", "volume"),
    [
        (Cage.box([0, 0, 0], [1, 2, 3]), 8, 6.0),
        (Cage.box([[0, 0, 0], [1, 2, 3]], segments=(1, 2, 3)), 26 - 2, 6.0),
        (Cage.cylinder([1, 2, 3], 2.0, 5.0, sides=8, rings=3), 34, 5 * 0.5 * 8 * 4 * np.sin(np.pi / 4)),
        (Cage.cylinder([1, 2, 3], 2.0, 5.0, axis="x", sides=3), 8, 5 * 0.5 * 3 * 4 * np.sin(2 * np.pi / 3)),
        (Cage.icosphere([5, 5, 5], 2.0, 0), 12, None),
        (Cage.icosphere([5, 5, 5], 2.0), 42, None),
    ],
)
def test_simple_shapes_are_usable(cage, count, volume):
    cage.require_usable()
    report = cage.check()
    assert len(cage.vertices) == count and report.genus == 0 and report.intersecting_faces == ()
    assert report.convexity == pytest.approx(1.0, abs=1e-6)
    if volume is not None:
        assert cage.volume == pytest.approx(volume, rel=1e-12)


def test_icosphere_vertices_are_on_the_sphere_and_cylinder_on_its_axis():
    assert np.allclose(np.linalg.norm(Cage.icosphere([1, 2, 3], 2.0, 2).vertices - [1, 2, 3], axis=1), 2.0)
    tube = Cage.cylinder([1, 2, 3], 0.5, 4.0, axis="y", sides=6)
    assert np.allclose(tube.bounds[:, 1], [0, 4])
    assert np.allclose(np.linalg.norm((tube.vertices - [1, 2, 3])[:-2, [0, 2]], axis=1), 0.5)


@pytest.mark.parametrize(
    "make",
    [
        lambda: Cage.box([0, 0, 0], [1, 0, 1]),
        lambda: Cage.box([0, 0, np.nan], [1, 1, 1]),
        lambda: Cage.box([0, 0], [1, 1]),
        lambda: Cage.box([0, 0, 0], [1, 1, 1], segments=0),
        lambda: Cage.cylinder([0, 0, 0], -1.0, 1.0),
        lambda: Cage.cylinder([0, 0, 0], 1.0, 1.0, axis="w"),
        lambda: Cage.cylinder([0, 0, 0], 1.0, 1.0, sides=2),
        lambda: Cage.icosphere([0, 0, 0], np.inf),
    ],
)
def test_simple_shapes_refuse_bad_measures(make):
    refused(make)


def test_with_vertices_keeps_faces_and_checks_count():
    cage = Cage.box([0, 0, 0], [1, 1, 1])
    moved = cage.with_vertices(cage.vertices + 1.0)
    assert moved.faces is cage.faces and np.array_equal(moved.vertices, cage.vertices + 1.0)
    refused(lambda: cage.with_vertices(cage.vertices[:7]), match="needs 8 vertices")
    refused(lambda: cage.with_vertices(cage.vertices * np.nan), match="finite")


class Named(Cage):
    """A subclass with something of its own."""

    def __init__(self, vertices, faces, name):
        super().__init__(vertices, faces)
        self.name = name


def test_poses_of_a_subclass_are_of_it_with_all_that_it_holds():
    named = Named(*tetrahedron(), "bird")
    for posed in (named.with_vertices(named.vertices + 1.0), named.bend(20), named.move([1, 0, 0], group=[0])):
        assert type(posed) is Named and posed.name == "bird" and posed.topology is named.topology
    assert named.translate([1, 0, 0]).bounds[0].tolist() == [1, 0, 0] and named.bounds[0].tolist() == [0, 0, 0]
    assert repr(named).startswith("Named(4 vertices")


@pytest.mark.parametrize("again", [copy.copy, copy.deepcopy, lambda cage: pickle.loads(pickle.dumps(cage))])
def test_copies_are_whole(again):
    cage = Cage.box([0, 0, 0], [1, 2, 3])
    cage.require_usable()
    other = again(cage)
    other.require_usable()
    assert type(other) is Cage and other.bounds.tolist() == cage.bounds.tolist() and other.topology.closed
    assert np.array_equal(other.vertices, cage.vertices) and np.array_equal(other.faces, cage.faces)
    assert not hasattr(other, "__dict__")


def test_what_is_known_of_a_cage_is_not_taken_for_its_poses():
    cage = Cage.box([0, 0, 0], [1, 1, 1])
    cage.require_usable()
    flat = cage.with_vertices(cage.vertices * [1, 1, 0])
    for _ in range(2):
        refused(flat.require_usable, match=MESSAGES["cage.same_places"])
    cage.require_usable()


def test_require_same_faces_says_what_differs():
    rest = Cage.box([0, 0, 0], [1, 1, 1])
    require_same_faces(rest, rest.bend(20))
    require_same_faces(rest, Cage(rest.vertices, rest.faces))
    cases = {
        "in another order, from face 0": Cage(rest.vertices, rest.faces[::-1]),
        "11 faces": Cage(rest.vertices, rest.faces[:11]),
        "9 vertices": Cage(np.concatenate([rest.vertices, [[0, 0, 9]]]), rest.faces),
        "turned inside out": Cage(rest.vertices, rest.faces[:, ::-1]),
    }
    for message, other in cases.items():
        with pytest.raises(ValueError, match=message):
            require_same_faces(rest, other)


def test_contains_agrees_with_an_analytic_box_far_from_the_origin(device):
    far = np.array([1e5, -2e5, 3e5])
    cage = Cage.box(far, far + [1, 2, 3], segments=2)
    points = far + np.random.default_rng(0).uniform(-1, 4, (4000, 3))
    inside = ((points >= far) & (points <= far + [1, 2, 3])).all(axis=1)
    assert np.array_equal(cage.contains(points, device=device), inside) and inside.sum() > 100


def test_contains_takes_the_surface_as_inside_and_keeps_arrays_on_their_device(device):
    import warp as wp

    cage = Cage.icosphere([0, 0, 0], 1.0)
    middles = cage.vertices[cage.faces].mean(axis=1)
    points = np.concatenate([cage.vertices, middles, middles * (1 + 4e-5), [[0, 0, 9]]])
    expected = [True] * (len(cage.vertices) + len(middles)) + [False] * (len(middles) + 1)
    assert cage.contains(points, device=device).tolist() == expected
    on_device = cage.contains(wp.array(points.astype(np.float32), dtype=wp.vec3, device=device))
    assert isinstance(on_device, wp.array) and str(on_device.device) == device
    assert on_device.numpy().astype(bool).tolist() == expected
    assert cage.contains(np.zeros((0, 3)), device=device).shape == (0,)


def test_contains_refuses_bad_points_and_open_cages():
    cage = Cage.box([0, 0, 0], [1, 1, 1])
    refused(lambda: cage.contains([[0, 0, np.nan]]), match="finite")
    refused(lambda: Cage(cage.vertices, cage.faces[1:]).contains([[0, 0, 0]]), match="open")


def test_intersections_are_found_and_neighbors_are_not():
    box = Cage.box([0, 0, 0], [1, 1, 1])
    assert len(intersecting_faces(box.vertices, box.faces)) == 0
    other = Cage.box([0.5, 0.4, 0.3], [1.5, 1.4, 1.3])
    crossing = intersecting_faces(
        np.concatenate([box.vertices, other.vertices]), np.concatenate([box.faces, other.faces + 8])
    )
    assert len(crossing) > 0 and (crossing[:, 0] < 12).all() and (crossing[:, 1] >= 12).all()
    inside = Cage.box([0.2, 0.2, 0.2], [0.8, 0.8, 0.8])
    assert (
        len(
            intersecting_faces(
                np.concatenate([box.vertices, inside.vertices]), np.concatenate([box.faces, inside.faces + 8])
            )
        )
        == 0
    )


@pytest.mark.parametrize("candidates", [7, 1 << 20])
def test_faces_that_meet_are_those_whose_boxes_do_in_all_pairs(monkeypatch, candidates):
    monkeypatch.setattr(queries, "CANDIDATES", candidates)
    rng = np.random.default_rng(0)
    for scale in (1.0, 0.02, 1e-9):  # faces of one size, of two, and smaller than any grid's cells
        corners = rng.random((300, 1, 3)) * 0.5 + rng.random((300, 3, 3)) * rng.choice([0.5, 0.5 * scale], (300, 1, 1))
        corners[250:] = corners[rng.integers(0, 250, 50)]  # and some twice
        low, high = corners.min(axis=1), corners.max(axis=1)
        meet = ((low[:, None] <= high[None]) & (low[None] <= high[:, None])).all(axis=2)
        expected = np.argwhere(np.triu(meet, 1))
        found = np.concatenate(list(queries.overlapping_boxes(corners)))
        assert len(np.unique(found, axis=0)) == len(found)
        np.testing.assert_array_equal(found[np.lexsort((found[:, 1], found[:, 0]))], expected)


def test_a_large_cage_is_checked_without_looking_at_all_pairs_of_faces(monkeypatch):
    looked = []
    boxes = queries.meeting_boxes
    monkeypatch.setattr(
        queries,
        "meeting_boxes",
        lambda asking, held, begin, end, *rest: (
            looked.append((end - begin).sum()) or boxes(asking, held, begin, end, *rest)
        ),
    )
    sphere = trimesh.creation.icosphere(subdivisions=5)
    assert len(intersecting_faces(sphere.vertices, sphere.faces)) == 0
    assert len(sphere.faces) < sum(looked) < 200 * len(sphere.faces)  # all pairs: 10,000 for each face


def test_intersections_in_one_plane_and_between_neighbors():
    flat = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [0.3, 0.3, 0], [2.3, 0.3, 0], [0.3, 2.3, 0], [-1, 0, 0]], float)
    assert len(intersecting_faces(flat, [[0, 1, 2], [3, 4, 5]])) == 1
    assert len(intersecting_faces(flat, [[0, 1, 2], [0, 2, 6]])) == 0
    folded = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.4, 0.4, 0]], float)
    assert len(intersecting_faces(folded, [[0, 1, 2], [1, 0, 3]])) == 1  # one face folded onto the other
    speared = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0.2, -1], [0.2, 0.5, 1]], float)
    assert len(intersecting_faces(speared, [[0, 1, 2], [0, 3, 4]])) == 1  # they share a vertex and cross besides


def test_a_tangled_pose_is_reported_but_may_be_used():
    cage = Cage.box([0, 0, 0], [1, 1, 4], segments=(1, 1, 16))
    tangled = cage.bend(200, limits=(0.25, 0.5))
    assert len(tangled.check().intersecting_faces) > 0


def test_check_counts_what_is_enclosed_and_prints_a_table():
    cage = Cage.box([0, 0, 0], [1, 1, 1])
    mesh = trimesh.Trimesh([[0.5, 0.5, 0.5], [0.2, 0.5, 0.5], [0.5, 0.2, 0.5], [3, 3, 3]], [[0, 1, 2]], process=False)
    report = cage.check(mesh=mesh)
    assert report.mesh_enclosed == 0.75 and report.field_enclosed is None and report.usable
    assert "75.000 %" in str(report) and "25 % of what is visible is outside this cage" in str(report)
    assert report.as_dict()["mesh_enclosed"] == 0.75 and report.as_dict()["usable"] is True


def test_genus_and_parts():
    torus = trimesh.creation.torus(1.0, 0.3, 12, 8)
    ring = Cage(torus.vertices, torus.faces)
    assert ring.check().genus == 1
    second = torus.faces + len(torus.vertices)
    two = Cage(np.concatenate([torus.vertices, torus.vertices + 5]), np.concatenate([torus.faces, second]))
    assert two.topology.part_count == 2 and two.topology.genus == 2
