"""Nouns agree with their number in messages; for a wrong name the nearest one is suggested."""

import numpy as np
import pytest
from refusals import refused

from warpcage import Cage, SplatField, deform_points, harmonic_coordinates
from warpcage.core import agreed, counted
from warpcage.mesh import MeshTopology
from warpcage.studio.cli import main

BOX = Cage.box((-1, -1, -1), (1, 1, 1))


def test_numbers_and_their_nouns():
    assert [counted(count, "frame") for count in (0, 1, 2)] == ["0 frames", "1 frame", "2 frames"]
    assert [counted(count, "vertex", "vertices") for count in (1, 2)] == ["1 vertex", "2 vertices"]
    assert [agreed(count, "is", "are") for count in (0, 1, 2)] == ["are", "is", "are"]


def test_messages_that_count_one():
    pinched = MeshTopology(7, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2],
                                        [0, 5, 4], [0, 4, 6], [4, 5, 6], [0, 6, 5]]))  # fmt: skip
    assert "only touch at 1 vertex, the first 0" in pinched.problem
    faces = BOX.faces.copy()
    faces[0][faces[0] == faces[0, 0]] = 8  # one corner of one face on a vertex of its own, at the same place
    doubled = Cage(np.vstack([BOX.vertices, BOX.vertices[BOX.faces[0, 0]]]), faces)
    assert "merged 1 vertex into others" in doubled.repair()[1][0]
    with pytest.raises(ValueError, match="1 of 2 points is outside the cage"):
        harmonic_coordinates([[0, 0, 0], [0, 0, 9]], BOX, 16, device="cpu")
    with pytest.raises(ValueError, match="2 of 2 points are outside the cage"):
        harmonic_coordinates([[0, 0, 8], [0, 0, 9]], BOX, 16, device="cpu")


def test_a_file_of_one_splat_is_counted(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    one = np.zeros((1, 3))
    SplatField(one, one - 2.0, [[1, 0, 0, 0]], [2.0], np.zeros((1, 1, 3)), device="cpu").save("one.ply")
    BOX.save("cage.obj")
    order = "bake one.ply --cage cage.obj --posed translate:0:0:1 -o moved.ply --device cpu"
    assert main(order.split()) == 0
    assert "moved.ply: 1 splat," in capsys.readouterr().out


@pytest.mark.parametrize(
    "given, end",
    [("harmonics", ", did you mean harmonic?"), ("mean-value", ", did you mean mean_value?"),
     ("Green", ", did you mean green?"), ("biharmonic weights of old", "weights of old'"), ("x" * 100_000, "xxx"),
     (3, "got 3")],
)  # fmt: skip
def test_the_name_that_is_near_is_said(given, end):
    said = refused(lambda: deform_points([[0.5, 0.5, 0.5]], BOX, BOX, coordinates=given))
    assert said.endswith(end) and said.startswith("coordinates must be one of harmonic") and len(said) < 200
