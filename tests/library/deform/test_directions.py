"""Poses along any direction, along a cage's own axes, and along what is up in a scene."""

import functools

import numpy as np
import pytest
from refusals import refused

from warpcage import Cage
from warpcage.cage import direction, poses
from warpcage.view import axis_rotation

TURN = axis_rotation(np.array([0.6, 0.0, 0.8]), 0.7) @ axis_rotation(np.array([0.0, 1.0, 0.0]), -1.1)
BOX = Cage.box((-0.5, -1.0, -2.0), (0.5, 1.0, 2.0), segments=2).translate((0.3, -0.2, 0.7))

#: A pose along world axes, and what it takes along the same directions of the turned world.
POSES = {
    "bend": lambda cage, a, b: cage.bend(50, axis=a, towards=b, limits=(0.2, 0.9)),
    "twist": lambda cage, a, b: cage.twist(70, axis=a, limits=(0.1, 1.0)),
    "taper": lambda cage, a, b: cage.taper(0.4, axis=a),
    "stretch": lambda cage, a, b: cage.stretch(1.8, axis=a, keep_volume=True),
    "rotate": lambda cage, a, b: cage.rotate(35, axis=a),
}


@pytest.mark.parametrize("name", POSES)
@pytest.mark.parametrize("axis, towards", [("z", "x"), ("x", "-y"), ("y", "z")])
def test_a_turned_world_poses_alike(name, axis, towards):
    turned = BOX.with_vertices(BOX.vertices @ TURN.T)
    world = {letter: TURN @ direction(letter) for letter in ("x", "y", "z", "-y")}
    here = POSES[name](BOX, axis, towards).vertices @ TURN.T
    there = POSES[name](turned, 7.0 * world[axis], 0.1 * world[towards]).vertices
    # the middle of the world's box is where it was, as the cage is as large on both sides of it
    np.testing.assert_allclose(there, here, atol=1e-12)


@pytest.mark.parametrize("name", POSES)
def test_a_direction_along_an_axis_is_that_axis(name):
    for axis, towards in (("z", "x"), ("x", "y"), ("y", "-z")):
        letters = POSES[name](BOX, axis, towards)
        vectors = POSES[name](BOX, direction(axis), list(direction(towards)))
        np.testing.assert_allclose(vectors.vertices, letters.vertices, atol=1e-14)


def test_towards_counts_across_the_axis():
    straight = BOX.bend(40, axis="z", towards="x")
    slanted = BOX.bend(40, axis=(0, 0, 2), towards=(1, 0, 5))
    np.testing.assert_allclose(slanted.vertices, straight.vertices, atol=1e-12)
    refused(lambda: BOX.bend(40, axis=(0, 0, 2), towards="z"), match="two different directions")
    for axis in ((0, 0, 0), (1, 2), (np.nan, 0, 1), "w", "up"):
        refused(functools.partial(BOX.twist, 40, axis=axis), match="axis")
    np.testing.assert_allclose(BOX.twist(30, axis=(0, 0, 1e-300)).vertices, BOX.twist(30).vertices, atol=1e-12)


def test_unused_vertices_and_bounds_do_not_count():
    loose = Cage(np.concatenate([BOX.vertices, [[50.0, 60, 70]]]), BOX.faces)
    axis = (1, 1, 1)
    np.testing.assert_allclose(loose.twist(60, axis=axis).vertices[:-1], BOX.twist(60, axis=axis).vertices, atol=1e-9)
    part = poses.bend(BOX.vertices[:5], 40, axis=axis, towards="x", bounds=BOX.vertices)
    np.testing.assert_allclose(part, BOX.bend(40, axis=axis, towards="x").vertices[:5], atol=1e-12)
    corners = poses.taper(BOX.vertices, 0.5, axis=axis, bounds=BOX.bounds)
    np.testing.assert_allclose(corners, BOX.taper(0.5, axis=axis).vertices, atol=1e-12)  # a box is its corners' hull


def test_own_axes_go_along_with_the_cage():
    np.testing.assert_allclose(BOX.principal_axes, [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], atol=1e-12)
    turned = BOX.with_vertices(BOX.vertices @ TURN.T)
    axes = turned.principal_axes
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) > 0
    np.testing.assert_allclose(np.abs(axes @ TURN), np.abs(BOX.principal_axes), atol=1e-12)
    finer = BOX.subdivide(1)  # many small faces on one side change nothing
    lopsided = Cage(*_half_divided(BOX))
    for cage in (finer, lopsided):
        np.testing.assert_allclose(cage.principal_axes, BOX.principal_axes, atol=1e-12)
    long = turned.bend(40, axis="long", towards="-short")
    np.testing.assert_array_equal(long.vertices, turned.bend(40, axis=axes[0], towards=-axes[2]).vertices)
    np.testing.assert_array_equal(turned.rotate(9, axis="middle").vertices, turned.rotate(9, axis=axes[1]).vertices)
    pole = Cage.cylinder((0, 0, 0), 0.3, 4.0, axis="y")
    np.testing.assert_allclose(pole.twist(90, axis="long").vertices, pole.twist(90, axis="y").vertices, atol=1e-12)
    for name in ("middle", "short"):
        refused(functools.partial(pole.twist, 90, axis=name), match=f"no '{name}' axis")
    refused(lambda: Cage.box((0, 0, 0), (1, 1, 1)).twist(90, axis="-long"), match="no 'long' axis")


def _half_divided(cage):
    """The cage with each face whose middle is above z = 0.7 cut in three."""
    vertices, faces = list(cage.vertices), []
    for face in cage.faces.tolist():
        middle = cage.vertices[face].mean(axis=0)
        if middle[2] <= 0.7:
            faces.append(face)
            continue
        a, b, c = face
        vertices.append(middle)
        faces += [[a, b, len(vertices) - 1], [b, c, len(vertices) - 1], [c, a, len(vertices) - 1]]
    return np.array(vertices), np.array(faces)
