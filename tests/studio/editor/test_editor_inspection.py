"""The live check of the editor, against the slower checks of cages and against what was built wrong on purpose."""

import numpy as np
import pytest
from fields import BOX, ellipsoid, make_field, plain

from warpcage import Cage
from warpcage.cage import check_pose
from warpcage.select import visible_nodes
from warpcage.studio.editor import (
    Document,
    Inspector,
    Selection,
    Settings,
    Timeline,
    View,
    inspect,
    inspection,
    inspector,
    new_edit,
)

VIEW = View((3.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 40.0)
ALL_IS_WELL = ["All is well: the cage holds all that is visible, and nothing is turned inside out."]


@pytest.fixture
def field(device):
    return make_field(ellipsoid, plain((0.6, 0.4, 0.2)), device=device)


def checked(field, rest, posed=None, kind="move", **settings):
    edit = new_edit(4, rest, "Cage", kind, None if posed is None else posed.vertices)
    return inspect(Document((edit,), Selection(), Settings(**settings), VIEW, Timeline()), 4, field)


def test_nothing_is_found_where_nothing_is_wrong(field):
    for posed in (None, BOX.bend(30), BOX.twist(40, axis="x")):
        found = checked(field, BOX, posed)
        assert found["lines"] == ALL_IS_WELL and found["inside_share"] == 1.0
        assert not (found["problem"] or found["crossing_faces"] or found["leaking_faces"])
        assert found["folded_share"] == found["outside_share"] == 0.0
        assert (found["edit"], found["pending"]) == (4, False)


def test_folds_and_crossings_are_those_of_the_slow_check(field):
    noise = np.random.default_rng(0).normal(scale=0.35, size=BOX.vertices.shape)
    posed = BOX.with_vertices(BOX.vertices + noise)
    found, slow = checked(field, BOX, posed), check_pose(BOX, posed)
    assert slow.inverted_share > 0.01
    assert found["folded_share"] == pytest.approx(slow.inverted_share, abs=0.05)
    assert found["outside_share"] == pytest.approx(slow.outside_share, abs=0.05)
    assert found["crossing_faces"] == np.unique(slow.intersecting_faces).tolist() != []
    assert any("turned inside out" in line for line in found["lines"])
    # the cage at rest has nothing of it, and it is what is looked at there
    rest = checked(field, BOX, posed, mode="rest")
    assert rest["lines"] == ALL_IS_WELL and not rest["crossing_faces"]
    assert checked(field, BOX, posed, kind="remove")["lines"] == ALL_IS_WELL


def test_faces_that_cut_through_matter_are_those_that_do(field):
    cut = BOX.with_vertices(np.minimum(BOX.vertices, [0.2, 9.0, 9.0]))  # its end in +x is within the ellipsoid
    found = checked(field, cut)
    nodes = visible_nodes(field)
    nodes = nodes[np.abs(nodes[:, 0] - 0.225) < 1e-6][:, 1:]  # those of the layer behind the end
    touched = []
    for face, corners in enumerate(cut.vertices[cut.faces]):
        if (corners[:, 0] == 0.2).all():
            a, b, c = corners[:, 1:]
            p, q = np.linalg.solve(np.stack([b - a, c - a], axis=1), (nodes - a).T)
            if ((p > 0) & (q > 0) & (p + q < 1)).any():
                touched.append(face)
    assert len(touched) >= 4 and found["leaking_faces"] == touched
    report = cut.check(field=field)
    assert found["inside_share"] == pytest.approx(report.field_enclosed, abs=0.05)
    assert any("cut through what is visible" in line for line in found["lines"])
    assert any("stays where it is" in line for line in found["lines"])
    away = checked(field, BOX.translate([5, 0, 0]))
    assert away["leaking_faces"] == [] and "Nothing visible is inside this cage: it moves nothing." in away["lines"]


def test_thin_matter_through_a_large_face_is_seen():
    field = make_field(
        lambda x: np.where((np.abs(x[..., 1]) < 0.03) & (np.abs(x[..., 2]) < 0.03), 60.0, 0.0), plain((1, 0, 0)),
        device="cpu",
    )  # fmt: skip
    cage = Cage.box([-0.5, -0.6, -0.6], [0.5, 0.6, 0.6])
    leaking = inspector(field).leaking_faces(cage)
    # the needle passes through the diagonals of both ends
    ends = np.flatnonzero(np.ptp(cage.vertices[cage.faces][..., 0], axis=1) == 0.0)
    assert leaking.tolist() == ends.tolist()


@pytest.mark.parametrize(
    ("rest", "posed", "problem"),
    [
        (Cage(BOX.vertices, BOX.faces[1:]), None, "The cage at rest is open"),
        (BOX, Cage(BOX.vertices * [1, 1, 0], BOX.faces), "The posed cage has"),
        (BOX, BOX.with_vertices(-BOX.vertices), "The posed cage looks inward"),
    ],
)
def test_cages_that_cannot_be_used(field, rest, posed, problem):
    found = checked(field, rest, posed)
    assert found["problem"].startswith(problem)
    assert found["lines"][0].startswith(problem) and "until this is fixed" in found["lines"][0]


def test_a_cage_at_rest_is_looked_at_once_while_it_is_posed(field, monkeypatch):
    looked = []
    monkeypatch.setattr(Inspector, "leaking_faces", lambda self, cage: looked.append(1) or np.zeros(0, int))
    cage = BOX.scale(1.01)
    for degrees in (10, 20, 30):
        checked(field, cage, cage.twist(degrees))
    assert len(looked) == 1
    monkeypatch.setattr(inspection, "KEPT", 2)
    for scale in (1.02, 1.03, 1.01):
        checked(field, BOX.scale(scale))
    assert len(looked) == 4 and len(inspector(field).findings) == 2


def test_an_empty_field_and_an_edit_that_is_not_there():
    empty = make_field(lambda x: 1e-9 * np.ones(x.shape[:-1]), plain((1, 0, 0)), device="cpu")
    assert checked(empty, BOX)["inside_share"] is None
    with pytest.raises(ValueError, match="there is no edit 9"):
        inspect(Document((), Selection(), Settings(), VIEW, Timeline()), 9, empty)
