import numpy as np
import pytest
from polygon_cages import quad_box
from refusals import refused

from warpcage import Cage


def soup(cage):
    """Every face with corners of its own, as exporters write flat shading."""
    return Cage(cage.vertices[cage.faces.reshape(-1)], np.arange(cage.faces.size).reshape(-1, 3))


def broken():
    box, ball = Cage.box([0, 0, 0], [1, 2, 3], segments=2), Cage.icosphere([0, 0, 0], 1.0)
    some = ball.faces.copy()
    some[[3, 4, 40]] = some[[3, 4, 40], ::-1]
    around = np.flatnonzero((ball.faces == 5).any(axis=1))
    two = np.concatenate([ball.vertices, ball.vertices + 5])
    return {
        "merged": soup(box),
        "flipped 3 faces": Cage(ball.vertices, some),
        "looked inward": Cage(ball.vertices, ball.faces[:, ::-1]),
        "of 1 part that looked": Cage(two, np.concatenate([ball.faces, ball.faces[:, ::-1] + len(ball.vertices)])),
        "closed a hole of 3 edges": Cage(ball.vertices, ball.faces[1:]),
        f"closed a hole of {len(around)} edges": Cage(ball.vertices, np.delete(ball.faces, around, axis=0)),
        "1 face that names a vertex twice": Cage(ball.vertices, np.concatenate([ball.faces, [[1, 1, 2]]])),
        "on the vertices of another": Cage(ball.vertices, np.concatenate([ball.faces, ball.faces[:2]])),
    }


@pytest.mark.parametrize("what", list(broken()))
def test_what_can_be_mended_is_and_said(what):
    cage = broken()[what]
    refused(cage.require_usable)
    mended, notes = cage.repair()
    mended.require_usable()
    assert len(notes) == 1 and what in notes[0] and "\n" not in notes[0]
    assert np.array_equal(mended.vertices, cage.vertices)  # so poses of the broken file still match
    assert mended.check().intersecting_faces == ()
    whole = 6.0 if what == "merged" else Cage.icosphere([0, 0, 0], 1.0).volume * (2 if "1 part" in what else 1)
    assert mended.volume == pytest.approx(whole, rel=0.1)


def test_a_hole_beside_flipped_faces_and_repeated_vertices():
    ball = Cage.icosphere([0, 0, 0], 1.0)
    faces = ball.faces[2:].copy()
    faces[10:30] = faces[10:30, ::-1]
    mended, notes = soup(Cage(ball.vertices, faces[:, ::-1])).repair()
    mended.require_usable()
    assert len(notes) >= 3 and mended.volume == pytest.approx(ball.volume, rel=0.1)


def test_nothing_is_done_to_a_good_cage_and_its_cavity():
    outer, inner = Cage.icosphere([0, 0, 0], 2.0), Cage.icosphere([0, 0, 0], 1.0)
    hollow = Cage(
        np.concatenate([outer.vertices, inner.vertices]),
        np.concatenate([outer.faces, inner.faces[:, ::-1] + len(outer.vertices)]),
    )
    assert hollow.repair() == (hollow, ())
    turned = Cage(hollow.vertices, hollow.faces[:, ::-1])
    assert turned.repair()[0].volume == pytest.approx(hollow.volume)


def test_what_is_not_safe_is_left():
    tube = Cage.cylinder([0, 0, 0], 1.0, 2.0, sides=16)
    open_tube = Cage(tube.vertices, tube.faces[~(tube.faces == 32).any(axis=1)])
    assert open_tube.repair() == (open_tube, ())
    mended, notes = open_tube.repair(largest_hole=16)
    mended.require_usable()
    assert len(notes) == 1
    strip = np.array(
        [
            [np.cos(a) * (1 + s * np.cos(a / 2)), np.sin(a) * (1 + s * np.cos(a / 2)), s * np.sin(a / 2)]
            for a in np.linspace(0, 2 * np.pi, 12, endpoint=False)
            for s in (-0.3, 0.3)
        ]
    )
    faces = [f for k in range(0, 22, 2) for f in ((k, k + 2, k + 1), (k + 1, k + 2, k + 3))]
    moebius = Cage(strip, [*faces, (22, 1, 23), (23, 1, 0)])
    assert moebius.repair(largest_hole=3) == (moebius, ())
    refused(lambda: tube.repair(largest_hole=2), match="largest_hole")
    refused(lambda: Cage(tube.vertices, [[0, 0, 1]]).repair(), match="no face left")


def directed_sides(cage):
    return {pair for face in cage.polygons for pair in zip(face, (*face[1:], face[0]), strict=True)}


def test_holes_among_quads_are_closed_by_quads():
    whole = quad_box(2, 0.1, seed=1)
    for missing in range(0, whole.face_count, 5):
        left = [face for number, face in enumerate(whole.polygons) if number != missing]
        mended, notes = Cage(whole.vertices, left).repair()
        assert notes == (f"closed a hole of 4 edges at vertex {min(whole.polygons[missing])} with 1 face",)
        assert set(mended.polygons[-1]) == set(whole.polygons[missing])
        assert directed_sides(mended) == directed_sides(whole)  # the same surface, looking the same way
        assert mended.volume == pytest.approx(whole.volume)


def test_holes_that_no_quad_suits_are_closed_by_triangles():
    whole = quad_box(1)
    (a, b, c, d), *others = whole.polygons
    bent = whole.vertices.copy()
    bent[[a, c], 0] -= 1.5  # a saddle on the side x = -1
    opposite, (e, f, g, h), *rest = others
    beside = [opposite, (e, f, g), (e, g, h), *rest]  # a triangle at the hole
    spike = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
    through = whole.vertices[[a, b, c, d]].mean(axis=0) + spike - [0.03, 0.13, 0.32]
    more = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]) + len(whole.vertices)
    cases = {
        "warped": Cage(bent, others),
        "beside triangles": Cage(whole.vertices, beside),
        "crossed": Cage(np.concatenate([whole.vertices, through]), [*others, *more.tolist()]),
    }
    for name, cage in cases.items():
        mended, notes = cage.repair()
        added = [face for face in mended.polygons if face not in cage.polygons]
        assert [len(face) for face in added] == [3, 3] and "with 2 faces" in notes[0], name
        assert {*added[0], *added[1]} == {a, b, c, d}, name
