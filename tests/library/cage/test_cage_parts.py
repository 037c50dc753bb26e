"""Cages by parts: limbs get tubes of their own, holes stay open, and what had to be closed is said."""

import warnings

import numpy as np
import pytest
import test_cage_robustness
import trimesh
from fields import GridField, nodes
from refusals import refused
from test_cage_robustness import SHAPES, assert_holds, coarsen

from warpcage import Cage, harmonic_coordinates
from warpcage.cage import progressive_hull
from warpcage.cage.generate.decimate import meeting_rings
from warpcage.cage.generate.mirror import Mirror
from warpcage.mesh import intersecting_faces


def capsule(start, end, radius):
    start, end = np.array(start, float), np.array(end, float)
    along = end - start
    place = trimesh.geometry.align_vectors([0, 0, 1], along / np.linalg.norm(along))
    place[:3, 3] = 0.5 * (start + end)
    return trimesh.creation.capsule(np.linalg.norm(along), radius, count=[16, 16]).apply_transform(place)


def near_arms():
    """A block with two upright arms of radius 0.1, the gap between them 0.12 wide."""
    arms = [capsule([x, 0, 0], [x, 0, 1.2], 0.1) for x in (-0.16, 0.16)]
    return trimesh.util.concatenate([trimesh.creation.box([0.5, 0.3, 0.3]), *arms])


def jointed_limb():
    limb = [capsule([0, 0, 0], [0.9, 0, 0], 0.12), capsule([0.9, 0, 0], [1.6, 0, 0.35], 0.1)]
    return trimesh.util.concatenate([trimesh.creation.box([0.5, 0.5, 0.5]), *limb])


def left_of(cage, points, moves):
    """RMS of what moves (n, 3) of points (n, 3) a cage cannot follow, by least squares, and its weights (n, v)."""
    weights = np.asarray(harmonic_coordinates(points, cage, 48), np.float64)
    held = np.concatenate([weights, 0.01 * np.eye(len(cage.vertices))])  # vertices that hardly count stay
    found = np.linalg.lstsq(held, np.concatenate([moves, 0.0 * cage.vertices]), rcond=None)[0]
    return np.sqrt(((weights @ found - moves) ** 2).sum(axis=1).mean()), weights


def test_near_arms_get_tubes_of_their_own():
    """With even vertices they share one; a bend of the outer half of one is followed, and the other one stays."""
    mesh = near_arms()
    points = np.asarray(mesh.sample(300, seed=1))
    outer, angle = (points[:, 0] > 0.0) & (points[:, 2] > 0.6), np.radians(40.0)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    moves = np.where(outer[:, None], (points - [0.16, 0, 0.6]) @ turn.T + [0.16, 0, 0.6] - points, 0.0)
    even, cage = (Cage.from_mesh(mesh, 60, method="shell", detail=detail) for detail in ("even", "parts"))
    assert_holds(cage, mesh, 60)
    between = np.stack([np.zeros(8), np.zeros(8), np.linspace(0.4, 1.1, 8)], axis=1)
    assert not cage.contains(between).any() and even.contains(between).any()
    left, weights = left_of(cage, points, moves)
    assert left < 0.6 * left_of(even, points, moves)[0]
    # vertices of one arm hardly move the points of the other
    arm = (cage.vertices[:, 0] > 0.0) & (cage.vertices[:, 2] > 0.4)
    other = (points[:, 0] < 0.0) & (points[:, 2] > 0.6)
    assert arm.sum() > 6 and weights[other][:, arm].sum(axis=1).max() < 0.03


def test_symmetric_arms_keep_their_gap_and_a_focus_counts_on_both_sides():
    mesh = near_arms()
    mesh.apply_translation([0.3, 0.0, 0.0])
    focus = np.array([[0.46, 0.0, 1.2]])
    cage = Cage.from_mesh(mesh, 61, detail="parts", symmetry="auto", focus=focus, finer=3.0)
    assert_holds(cage, mesh, 61)
    mirror = Mirror.of(cage.vertices, (0, 0.3))
    np.testing.assert_allclose(mirror(cage.vertices), cage.vertices, rtol=0, atol=1e-12)
    assert np.array_equal(mirror.partner[mirror.partner], np.arange(len(cage.vertices)))
    assert {frozenset(mirror.partner[face].tolist()) for face in cage.faces} == set(map(frozenset, cage.faces.tolist()))
    between = np.stack([np.full(8, 0.3), np.zeros(8), np.linspace(0.4, 1.1, 8)], axis=1)
    assert not cage.contains(between).any()
    even = Cage.from_mesh(mesh, 61, detail="parts", symmetry="x")
    ends = [each.vertices[each.edges] for each in (cage, even)]
    fine, plain = (np.linalg.norm(e[:, 0] - e[:, 1], axis=1)[e[:, :, 2].mean(axis=1) > 0.9].mean() for e in ends)
    assert fine < 0.85 * plain


def test_vertices_lie_on_both_sides_of_a_joint_of_a_limb():
    cage = Cage.from_mesh(jointed_limb(), 60, detail="parts")
    near = np.linalg.norm(cage.vertices - [0.9, 0, 0], axis=1) < 0.35
    assert (near & (cage.vertices[:, 0] < 0.9)).sum() >= 3 and (near & (cage.vertices[:, 0] > 0.9)).sum() >= 3
    even = Cage.from_mesh(jointed_limb(), 60, method="shell")
    assert (cage.vertices[:, 0] > 0.4).sum() > 1.1 * (even.vertices[:, 0] > 0.4).sum()


@pytest.mark.parametrize("count", [24, 60])
def test_a_ring_keeps_its_hole_and_nothing_is_said(count, monkeypatch):
    coarsen(monkeypatch)
    mesh = SHAPES["torus"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cage = Cage.from_mesh(mesh, count, detail="parts")
    assert_holds(cage, mesh, count)
    assert cage.topology.genus == 1


def test_what_had_to_be_closed_is_said_in_one_line(monkeypatch):
    monkeypatch.setattr(test_cage_robustness, "COARSER", 1.5)
    coarsen(monkeypatch)
    lines = []
    with pytest.warns(UserWarning, match="closes gaps .* and 1 of 1 holes"):
        cage = Cage.from_mesh(SHAPES["knot"], 30, detail="parts", progress=lambda done, total, line: lines.append(line))
    assert_holds(cage, SHAPES["knot"], 30)
    assert cage.topology.genus == 0 and sum("closes gaps" in line for line in lines) == 1


@pytest.mark.parametrize(
    ("shape", "count"),
    [("U", 30), ("star of 5", 30), ("two plates", 40), ("cross", 30), ("flat sheet", 20), ("far apart", 40)],
)
def test_shapes_of_all_kinds_hold(shape, count, monkeypatch):
    coarsen(monkeypatch)
    assert_holds(Cage.from_mesh(SHAPES[shape], count, detail="parts"), SHAPES[shape], count)


def test_a_field_keeps_its_gap():
    x, y, z = np.moveaxis(nodes(32), -1, 0)
    solid = (np.abs(y) < 0.2) & (np.abs(z) < 0.8) & (np.abs(np.abs(x) - 0.5) < 0.2)
    solid |= (np.abs(y) < 0.2) & (np.abs(x) < 0.7) & (z < -0.5) & (z > -0.8)
    field = GridField(np.where(solid, 20.0, 0.0).astype(np.float32))
    cage = Cage.from_field(field, 60, detail="parts")
    assert cage.check(field=field).field_enclosed == 1.0
    assert not cage.contains([[0.0, 0.0, 0.2], [0.0, 0.0, 0.6]]).any()


def test_parts_are_of_the_shell():
    refused(lambda: Cage.from_mesh(SHAPES["cube"], 30, detail="parts", method="voxel"), "needs method 'shell'")


def test_another_detail_is_refused():
    refused(lambda: Cage.from_mesh(SHAPES["cube"], 30, detail="fine"), "detail")


def test_meeting_rings_are_those_of_crossing_faces():
    """Of two balls that touch, cross or keep apart, and a torus with a vertex drawn through it."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    for off, some in ((1.7, True), (2.3, False)):
        two = trimesh.util.concatenate([ball, ball.copy().apply_translation([off, 0.013, 0.029])])
        pairs = intersecting_faces(two.vertices, two.faces)
        found = meeting_rings(np.asarray(two.vertices), np.asarray(two.faces), np.arange(len(two.vertices)))
        expected = np.isin(np.arange(len(two.vertices)), two.faces[pairs])
        assert np.array_equal(found, expected) and found.any() == some
    torus = trimesh.creation.torus(1.0, 0.3, major_sections=16, minor_sections=8)
    vertices = np.array(torus.vertices)
    vertices[3] = -1.01 * vertices[3]
    pairs = intersecting_faces(vertices, torus.faces)
    found = meeting_rings(vertices, np.asarray(torus.faces), np.arange(len(vertices)))
    assert found[3] and np.array_equal(found, np.isin(np.arange(len(vertices)), np.asarray(torus.faces)[pairs]))


def test_decimation_across_a_narrow_gap_passes_through_nothing():
    plates = [trimesh.creation.box([1, 1, 0.2]).apply_translation([0, 0, z]) for z in (-0.12, 0.12)]
    fine = trimesh.util.concatenate([plate.subdivide().subdivide().subdivide() for plate in plates])
    wave = np.array(fine.vertices)
    wave[:, 2] += 0.1 * np.sin(5.0 * wave[:, 0]) * np.cos(4.0 * wave[:, 1])
    free = progressive_hull(wave, fine.faces, 60)
    apart = progressive_hull(wave, fine.faces, 60, apart=True)
    assert len(intersecting_faces(*free)) and not len(intersecting_faces(*apart)) and len(apart[0]) < 100
