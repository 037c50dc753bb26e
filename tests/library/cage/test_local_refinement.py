"""Some faces of a cage cut finer: the surface stays, faces meet edge to edge, poses and films follow exactly."""

import numpy as np
import pytest
from polygon_cages import concave_prism, mixed_prism, quad_box
from refusals import refused

from warpcage import Cage, PoseFile, deform_points

CAGES = {
    "triangles": lambda: Cage.icosphere([0.1, 0.2, 0.3], 1.0, 2),
    "quads": lambda: quad_box(3, 0.15),
    "mixed": mixed_prism,
    "concave": concave_prism,
}


def shaken(cage, seed=1):
    return cage.with_vertices(
        cage.vertices + 0.1 * np.random.default_rng(seed).normal(size=cage.vertices.shape) * cage.size / 4
    )


def quality(cage):
    """The smallest angle of all faces, degrees."""
    least = 180.0
    for face in cage.polygons:
        corners = cage.vertices[list(face)]
        one, two = np.roll(corners, 1, axis=0) - corners, np.roll(corners, -1, axis=0) - corners
        cosines = (one * two).sum(axis=1) / np.linalg.norm(one, axis=1) / np.linalg.norm(two, axis=1)
        least = min(least, np.degrees(np.arccos(np.clip(cosines, -1, 1))).min())
    return least


@pytest.mark.parametrize("times", [1, 2])
@pytest.mark.parametrize("name", CAGES)
def test_faces_meet_edge_to_edge_and_old_vertices_keep_their_numbers(name, times):
    cage = CAGES[name]()
    for chosen in ({"faces": [0]}, {"faces": [1, 4, 5]}, {"vertices": [3]}, {"vertices": [0, 5]}):
        finer = cage.subdivide(times, **chosen)
        finer.require_usable()  # closed and manifold: a vertex on another face's edge would leave it open
        assert finer.topology.genus == cage.topology.genus and not len(finer.topology.unused_vertices)
        np.testing.assert_array_equal(finer.vertices[: len(cage.vertices)], cage.vertices)
        assert len(cage.vertices) < len(finer.vertices)
        if name != "concave":
            assert len(finer.vertices) <= len(cage.subdivide(times).vertices)
        if name == "triangles":
            assert {len(face) for face in finer.polygons} == {3} and quality(finer) > quality(cage) / 2.5**times
        assert finer.volume == pytest.approx(cage.volume, rel=1e-9 if name != "quads" else 5e-3)


def test_only_chosen_triangles_and_their_neighbours_are_cut():
    cage = CAGES["triangles"]()
    finer, old = cage.subdivide(faces=[7]), set(cage.polygons)
    kept = old & set(finer.polygons)
    beside = {face for face in old if len(set(face) & set(cage.polygons[7])) == 2}
    # one in four, its three neighbours in two
    assert old - kept == {cage.polygons[7], *beside} and finer.face_count == cage.face_count + 3 + 3
    assert len(finer.vertices) == len(cage.vertices) + 3


def test_quads_stay_quads_but_for_a_triangle_in_each_neighbour():
    cage = quad_box(3)
    face = next(k for k, corners in enumerate(cage.polygons) if (np.abs(cage.vertices[list(corners)]) == 1).sum() == 4)
    sizes = [len(corners) for corners in cage.subdivide(faces=[face]).polygons]
    # in the middle of a side: 4 quads, and of each of 4 neighbours 2 quads and a triangle
    assert sizes.count(3) == 4 and sizes.count(4) == cage.face_count - 5 + 4 + 4 * 2
    whole = cage.subdivide(faces=np.arange(cage.face_count))
    assert whole.polygons == cage.subdivide().polygons and set(map(len, whole.polygons)) == {4}
    np.testing.assert_array_equal(whole.vertices, cage.subdivide().vertices)


def barycentric(point, triangle):
    edges = np.stack([triangle[1] - triangle[0], triangle[2] - triangle[0]], axis=1)
    (b, c), *_ = np.linalg.lstsq(edges, point - triangle[0], rcond=None)
    off = np.linalg.norm(edges @ [b, c] - (point - triangle[0]))
    return np.array([1 - b - c, b, c]), off


def test_each_new_triangle_lies_in_one_of_the_old_ones_in_every_pose():
    cage = CAGES["triangles"]()
    for pose in (cage, cage.bend(70), shaken(cage)):
        finer = pose.subdivide(2, vertices=[5, 6])
        olds = pose.vertices[pose.faces]
        for face in finer.vertices[finer.faces]:
            middle = face.mean(axis=0)
            near = np.argsort(np.linalg.norm(olds.mean(axis=1) - middle, axis=1))[:12]
            found = [[barycentric(corner, olds[k]) for corner in face] for k in near]
            assert any(all(off < 1e-9 and share.min() > -1e-9 for share, off in each) for each in found)


@pytest.mark.parametrize("name", CAGES)
def test_new_vertices_are_the_same_means_in_every_pose(name):
    cage = CAGES[name]()
    one, two = shaken(cage, 1), shaken(cage, 2).twist(40)
    for chosen in ({}, {"faces": [2, 3]}, {"vertices": [1]}):
        finer = [pose.subdivide(2, **chosen) for pose in (one, two)]
        assert finer[0].polygons == finer[1].polygons == cage.subdivide(2, **chosen).polygons
        between = one.with_vertices(0.3 * one.vertices + 0.7 * two.vertices).subdivide(2, **chosen)
        mixed = 0.3 * finer[0].vertices + 0.7 * finer[1].vertices
        np.testing.assert_allclose(between.vertices, mixed, atol=1e-12)


def bilinear(corners, u, v):
    a, b, c, d = corners
    return (
        (1 - u)[:, None] * ((1 - v)[:, None] * a + v[:, None] * d)
        + u[:, None] * ((1 - v)[:, None] * b + v[:, None] * c)
    )  # fmt: skip


def test_warped_quads_stay_and_those_beside_them_move_by_a_sixteenth_of_their_warp():
    corners = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 1), (0, 1, 0)], float)  # z = x y, warp 1
    u, v = (grid.reshape(-1) for grid in np.meshgrid(*[np.linspace(0, 1, 33)] * 2))
    square = quad_box(1)  # beside each face lie four others: of a face that is cut, each has one edge cut
    for face in range(6):
        for chosen in range(6):
            posed = square.with_vertices(square.vertices)
            rows = list(square.polygons[face])
            places = square.vertices.copy()
            places[rows] = corners + [0, 0, 5]  # the others go where they may
            finer = Cage(square.vertices, square.polygons).with_vertices(places).subdivide(faces=[chosen])
            worst = 0.0
            for each in finer.polygons:
                points = finer.vertices[list(each)]
                inside = (np.abs(points[:, 2] - 5 - points[:, 0] * points[:, 1]) < 1e-12) & (points[:, 2] >= 5)
                if not inside.all():
                    continue
                if len(each) == 4:
                    found = bilinear(points, u, v)
                else:
                    kept = u + v <= 1
                    found = (
                        points[0] + u[kept, None] * (points[1] - points[0]) + v[kept, None] * (points[2] - points[0])
                    )
                worst = max(worst, np.abs(found[:, 2] - 5 - found[:, 0] * found[:, 1]).max())
            assert posed.polygons == square.polygons
            assert worst < 1e-12 if face == chosen else worst <= 1 / 16 + 1e-12


def test_points_are_carried_as_by_the_coarse_cage():
    # mean value coordinates integrate what is linear on faces: they cannot tell a cut face from a whole one
    rest = CAGES["triangles"]()
    posed, points = shaken(rest).bend(30), np.random.default_rng(0).uniform(-0.4, 0.6, (50, 3))
    chosen = {"vertices": [0, 11]}
    coarse, fine = (
        deform_points(points, a, b, coordinates="mean_value", device="cpu")
        for a, b in ((rest, posed), (rest.subdivide(2, **chosen), posed.subdivide(2, **chosen)))
    )
    np.testing.assert_allclose(coarse, fine, atol=2e-5)


def test_films_follow_with_times_easings_and_loops(tmp_path):
    rest = quad_box(2, 0.1)
    film = PoseFile(rest, {"start": rest, "bent": rest.bend(40), "turned": rest.twist(30)})
    film.times, film.easings, film.fps, film.loop = {"start": 0.0, "bent": 1.0}, {"start": "linear"}, 12.0, "ping-pong"
    finer = film.subdivide(vertices=[0])
    assert finer.names == film.names and finer.rest.polygons == rest.subdivide(vertices=[0]).polygons
    kept = (finer.times, finer.easings, finer.fps, finer.loop)
    assert kept == (film.times, film.easings, film.fps, film.loop)
    for seconds in (0.0, 0.3, 0.9):
        expected = film.at_time(seconds).subdivide(vertices=[0]).vertices
        np.testing.assert_allclose(finer.at_time(seconds).vertices, expected, atol=1e-12)
    finer.save(tmp_path / "finer.json")
    np.testing.assert_array_equal(PoseFile.load(tmp_path / "finer.json")["bent"].vertices, finer["bent"].vertices)


def test_what_is_no_face_or_vertex_is_refused():
    cage = Cage.box([0, 0, 0], [1, 1, 1])
    for chosen in ({"faces": [12]}, {"faces": [-1]}, {"faces": []}, {"vertices": [0.5]}, {"vertices": [[0]]}):
        refused(lambda chosen=chosen: cage.subdivide(**chosen), match="must be whole numbers from 0 to")
    refused(lambda: cage.subdivide(faces=[0], vertices=[0]), match="not both")
