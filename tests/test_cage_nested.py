"""Decimation that only moves outward."""

import numpy as np
import pytest
import trimesh
from test_cage_generation import winding

from warpcage.cage.cage import Cage
from warpcage.cage.generate.nested import nested
from warpcage.mesh.intersections import intersecting_faces


def surfaces():
    torus = trimesh.creation.torus(1.0, 0.3, major_sections=40, minor_sections=16)
    return {
        "ball": Cage.icosphere([1, 2, 3], 1.0, 3),
        "box": Cage.box([0, 0, 0], [1, 2, 3], segments=7),
        "torus": Cage(torus.vertices, torus.faces),
    }


@pytest.mark.parametrize(("name", "most"), [("ball", 1.2), ("box", 1.05), ("torus", 1.8)])
def test_every_surface_holds_the_one_before(name, most):
    fine = before = surfaces()[name]
    for count in (160, 80):
        cage = Cage(*nested(before.vertices, before.faces, count))
        cage.require_usable()
        assert len(cage.vertices) == count and not len(intersecting_faces(cage.vertices, cage.faces))
        assert cage.topology.genus == fine.topology.genus
        # middles of faces of the surface before, a hair below it, are inside this one
        corners = before.vertices[before.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        below = corners.mean(axis=1) - 1e-6 * normals / np.linalg.norm(normals, axis=1, keepdims=True)
        assert (winding(below, cage.vertices, cage.faces) > 0.99).all()
        assert cage.volume > before.volume * (1.0 - 1e-9)
        before = cage
    assert before.volume < most * fine.volume


def test_a_box_keeps_its_corners_and_edges():
    box = surfaces()["box"]
    cage = Cage(*nested(box.vertices, box.faces, 60))
    assert cage.volume < 1.01 * box.volume and np.allclose(cage.bounds, box.bounds, atol=0.05)


def test_it_stops_where_no_collapse_is_left():
    tetrahedron = trimesh.creation.icosahedron()
    vertices, _ = nested(tetrahedron.vertices, tetrahedron.faces, 4)
    assert 4 <= len(vertices) <= 12
    again = nested(tetrahedron.vertices, tetrahedron.faces, 12)
    assert np.array_equal(again[0], tetrahedron.vertices)
