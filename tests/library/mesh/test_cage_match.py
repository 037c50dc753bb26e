import functools
import itertools

import numpy as np
import pytest
import trimesh
from oracles import shuffled_cage
from refusals import refused

from warpcage import Cage
from warpcage.mesh import require_same_faces


def cages():
    torus = trimesh.creation.torus(1.0, 0.3, 12, 8)
    ball, box = Cage.icosphere([0, 0, 0], 1.0, 2), Cage.box([0, 0, 0], [1, 2, 3], segments=(2, 2, 4))
    two = np.concatenate([ball.vertices, ball.vertices + [3, 0, 0]])
    return {
        "box": box,
        "ball": ball,
        "torus": Cage(torus.vertices, torus.faces),
        "two balls": Cage(two, np.concatenate([ball.faces, ball.faces + len(ball.vertices)])),
        "cylinder": Cage.cylinder([0, 0, 0], 0.5, 3.0, sides=9, rings=5),
        "open": Cage(box.vertices, box.faces[3:]),
    }


@pytest.mark.parametrize("shape", list(cages()))
@pytest.mark.parametrize("seed", [0, 1])
def test_a_permuted_pose_comes_back_to_the_bit(shape, seed):
    rest = cages()[shape]
    posed = rest.bend(35).twist(10)
    back = rest.match(shuffled_cage(posed, seed))
    assert np.array_equal(back.vertices, posed.vertices) and back.faces is rest.faces


def test_the_same_faces_are_taken_as_they_are_even_after_half_a_turn():
    rest = cages()["cylinder"]
    turned = rest.rotate(180)
    assert np.array_equal(rest.match(turned).vertices, turned.vertices)
    assert np.array_equal(rest.match(Cage(turned.vertices, turned.faces[::-1])).vertices, turned.vertices)


def test_unused_vertices_stay_and_split_vertices_are_joined():
    box = Cage.box([0, 0, 0], [1, 2, 3])
    rest = Cage(np.concatenate([box.vertices, [[9.0, 9, 9]]]), box.faces)
    posed = box.bend(20)
    soup = Cage(posed.vertices[posed.faces.reshape(-1)], np.arange(posed.faces.size).reshape(-1, 3))
    back = rest.match(soup)
    assert np.array_equal(back.vertices[:8], posed.vertices) and back.vertices[8].tolist() == [9, 9, 9]


def test_other_diagonals_of_the_same_quads_are_the_same_cage():
    rest = Cage.box([0, 0, 0], [1, 1, 1])
    a, b = rest.faces[0], rest.faces[1]  # two triangles of one side: (0 1 2), (0 2 3)
    assert a[0] == b[0] and a[2] == b[1]
    faces = rest.faces.copy()
    faces[0], faces[1] = (a[0], a[1], b[2]), (a[1], a[2], b[2])
    posed = rest.bend(30)
    assert np.array_equal(rest.match(Cage(posed.vertices, faces)).vertices, posed.vertices)


#: A cube, vertex x + 2 y + 4 z at (x, y, z), and its sides.
CUBE = np.stack([np.arange(8) & 1, np.arange(8) >> 1 & 1, np.arange(8) >> 2], axis=1).astype(float)
SIDES = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]


@pytest.mark.parametrize("cut", [False, True])
def test_what_fits_in_place_by_chance_does_not_hide_the_order(cut):
    """Of cubes whose vertices come in another order a few have, by their numbers, some sides at another place: what is
    between these looked like polygons that are cut otherwise."""
    for seed in range(60):
        rng = np.random.default_rng(seed)
        order, places = rng.permutation(8), CUBE + rng.normal(0.0, 0.06, (8, 3))
        rest = Cage(CUBE, SIDES)
        rest = Cage(CUBE, rest.faces) if cut else rest
        posed = Cage(places[order], [np.argsort(order)[list(face)] for face in rest.polygons])
        assert np.array_equal(rest.match(posed).vertices, places), seed


@pytest.mark.parametrize("sides", [1, 3, 6])
def test_polygons_that_are_cut_in_part_are_taken_in_place(sides):
    """From either end: a cage of quads, and the same with some of them cut."""
    quads, places = Cage(CUBE, SIDES), CUBE + np.random.default_rng(1).normal(0.0, 0.1, (8, 3))
    cut = [half for a, b, c, d in SIDES[:sides] for half in ((b, c, d), (d, a, b))]
    some = Cage(places, [*SIDES[sides:], *cut])
    assert np.array_equal(quads.match(some).vertices, places)
    assert np.array_equal(some.match(quads.with_vertices(places * 2.0)).vertices, places * 2.0)


def test_diagonals_that_fit_another_order_by_chance_move_nothing():
    """Each of the 64 ways to cut a cube's sides: some of them are the cage itself turned, which no vertex has done."""
    rest = Cage(CUBE, Cage(CUBE, SIDES).faces)
    said = set()
    for turns in itertools.product((0, 1), repeat=6):
        pose = Cage(CUBE, Cage(CUBE, [np.roll(side, k) for side, k in zip(SIDES, turns, strict=True)]).faces)
        try:
            assert np.array_equal(rest.match(pose).vertices, CUBE), turns
        except ValueError as error:
            said.add("in their order, but other faces" in str(error))
    assert said == {False, True}
    refused(lambda: Cage(CUBE, SIDES).match(shuffled_cage(pose, 3)), "its quads cut otherwise")


@pytest.mark.parametrize(("scale", "away"), [(100.0, 0.0), (1e-3, 0.0), (1.0, 500.0), (30.0, 500.0)])
def test_poses_in_another_unit_or_far_away_are_matched(scale, away):
    """All ways to lay a box over itself move it as far then, but one of them is still like it."""
    rest = Cage.box([0, 0, 0], [1, 1, 1], segments=2)
    posed = rest.bend(20)
    posed = posed.with_vertices(posed.vertices * scale + away)
    assert np.array_equal(rest.match(shuffled_cage(posed, 2)).vertices, posed.vertices)


def test_quads_that_begin_elsewhere_are_called_that():
    quads = Cage(CUBE, SIDES)
    turned = Cage(CUBE, [SIDES[0], *(np.roll(side, 1) for side in SIDES[1:])])
    refused(lambda: require_same_faces(quads, turned), match="in another order, from face 1")
    assert np.array_equal(quads.match(turned).vertices, CUBE)


def test_a_tie_is_refused():
    rest = Cage.box([-1, -1, -1], [1, 1, 1])
    point = Cage(np.zeros((8, 3)) + [5.0, 0, 0], shuffled_cage(rest).faces)
    refused(lambda: rest.match(point), match="several ways")


def different():
    rest = cages()["ball"]
    faces = rest.faces.copy()
    # turn the edge between two faces
    a, b, c = faces[0]
    other = next(k for k in range(1, len(faces)) if {int(a), int(b)} <= set(faces[k].tolist()))
    d = (set(faces[other].tolist()) - {int(a), int(b)}).pop()
    faces[0], faces[other] = (c, a, d), (d, b, c)
    one_more = Cage(np.concatenate([rest.vertices, [[0, 0, 9]]]), np.concatenate([rest.faces, [[0, 1, 162]]]))
    cube = Cage.box([5, 5, 5], [6, 6, 6])
    two_objects = Cage(np.concatenate([cube.vertices, rest.vertices]), np.concatenate([cube.faces, rest.faces + 8]))
    return {
        "163 vertices, the cage 162": one_more,
        "170 vertices, the cage 162: it has 2 parts, the cage 1: save the cage alone": two_objects,
        "319 faces, the cage 320": Cage(rest.vertices, rest.faces[1:]),
        "turned inside out": Cage(rest.vertices, rest.faces[:, ::-1]),
        "it is another mesh": shuffled_cage(Cage(rest.vertices, faces)),
    }


@pytest.mark.parametrize("message", list(different()))
def test_what_differs_is_said_in_one_line(message):
    rest = cages()["ball"]
    for call, name in ((rest.match, "the pose "), (lambda pose: require_same_faces(rest, pose), "the deformed cage ")):
        assert refused(functools.partial(call, different()[message]), message).startswith(name)


def test_a_turned_edge_away_from_any_quad_is_named():
    rest = cages()["ball"]
    strange = rest.faces.copy()
    strange[[0, 5]] = strange[[5, 0]]
    strange[0] = np.roll(strange[0], 1)
    require_same = Cage(rest.vertices, strange)
    refused(lambda: require_same_faces(rest, require_same), match="in another order, from face 0")
    assert rest.match(require_same).faces is rest.faces


def test_large_regular_cages_are_matched():
    torus = trimesh.creation.torus(1.0, 0.3, 40, 20)
    rest = Cage(torus.vertices, torus.faces)
    posed = rest.taper(0.5, axis="x")
    assert np.array_equal(rest.match(shuffled_cage(posed)).vertices, posed.vertices)
