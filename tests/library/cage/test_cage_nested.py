"""Decimation that only moves outward."""

import numpy as np
import pytest
import trimesh
from test_cage_generation import winding

from warpcage import Cage
from warpcage.cage import progressive_hull
from warpcage.cage.generate import decimate as nested_module
from warpcage.mesh import intersecting_faces


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
        cage = Cage(*progressive_hull(before.vertices, before.faces, count))
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
    cage = Cage(*progressive_hull(box.vertices, box.faces, 60))
    assert cage.volume < 1.01 * box.volume and np.allclose(cage.bounds, box.bounds, atol=0.05)


def test_it_stops_where_no_collapse_is_left():
    tetrahedron = trimesh.creation.icosahedron()
    vertices, _ = progressive_hull(tetrahedron.vertices, tetrahedron.faces, 4)
    assert 4 <= len(vertices) <= 12
    again = progressive_hull(tetrahedron.vertices, tetrahedron.faces, 12)
    assert np.array_equal(again[0], tetrahedron.vertices)


def collapses_in_numpy(vertices, faces, edges, around, normals, offsets, double_area, mean, side, base, allowed):
    """What `EdgeCollapses.at` finds, by arrays over edges and the faces around them."""
    there, (u, v) = around >= 0, edges.T
    climb, below = (normals * mean[:, None]).sum(axis=2), offsets - (normals * base[:, None]).sum(axis=2)
    short = there & (below > 1e-9 * side)
    place = base + np.where(short, below / np.maximum(climb, 0.05), 0.0).max(axis=1)[:, None] * mean
    room = (double_area * ((normals * place[:, None]).sum(axis=2) - offsets)).sum(axis=1) / 6.0
    triangles = faces[around]
    moved = (triangles == u[:, None, None]) | (triangles == v[:, None, None])
    kept = there & (moved.sum(axis=2) == 1)
    corners = np.where(moved[..., None], place[:, None, None], vertices[triangles])
    sides = np.roll(corners, -1, axis=2) - corners
    cross = np.cross(sides[:, :, 0], sides[:, :, 1])
    area, squares = np.linalg.norm(cross, axis=2), (sides**2).sum(axis=3)
    even = 2.0 * np.sqrt(3.0) * area / np.maximum(squares.sum(axis=2), 1e-300)
    turn = (cross * normals).sum(axis=2) / np.maximum(area, 1e-300)
    folds = (kept & ~((turn > 0.2) & (even > 0.15))).any(axis=1)
    rows = np.flatnonzero(~(short & (climb < 0.05)).any(axis=1) & (room < allowed) & ~folds)
    longest = np.sqrt(np.where(kept, squares.max(axis=2), 0.0).max(axis=1)) / side
    uneven = np.where(kept, 1.0 / np.maximum(even, 1e-3) - 1.0, 0.0).sum(axis=1)
    return rows, place[rows], room[rows], (0.05 * longest**3 + 0.02 * uneven)[rows]


def test_collapses_are_measured_as_by_numpy(monkeypatch):
    counts = []

    class Watched(nested_module.EdgeCollapses):
        def __init__(self, *inputs):
            super().__init__(*inputs)
            self.inputs = inputs

        def at(self, base, room_allowed):
            found = super().at(base, room_allowed)
            rows, *expected = collapses_in_numpy(*self.inputs, base, room_allowed)
            assert np.array_equal(found[0], rows)
            assert all(np.allclose(*pair, rtol=1e-9, atol=1e-12) for pair in zip(found[1:], expected, strict=True))
            counts.append((len(rows), len(base)))
            return found

    monkeypatch.setattr(nested_module, "EdgeCollapses", Watched)
    fine = surfaces()["torus"]
    progressive_hull(fine.vertices, fine.faces, 300)
    some, every = np.array(counts).T
    assert len(counts) >= 20 and (some > 0).all() and (some < every).any()
