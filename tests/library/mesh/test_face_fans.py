"""Faces in fans: the same faces, most of which begin with an edge of the one before."""

import numpy as np
import oracles
import pytest
import warp as wp

from warpcage import Cage
from warpcage.core import launch
from warpcage.kernels.coordinates import green, mean_value
from warpcage.mesh import face_fans, prepared_fans


def goes_on(faces):
    """Which faces go on with the fan of the one before."""
    return (faces[1:, 0] == faces[:-1, 0]) & (faces[1:, 1] == faces[:-1, 2])


@pytest.mark.parametrize("name", list(oracles.CAGES))
def test_fans_hold_each_face_once(name):
    vertices, faces = oracles.cage(name)
    fans = face_fans(faces)
    assert np.array_equal(np.sort(fans.order), np.arange(len(faces)))
    # each is the face that it says it is, turned
    turned = np.stack([np.roll(faces[fans.order], turn, axis=1) for turn in range(3)])
    assert np.array_equal((turned == fans.faces).all(axis=2).any(axis=0), np.ones(len(faces), dtype=bool))
    assert goes_on(fans.faces).mean() > 0.6
    posed = Cage(vertices, faces)
    assert posed.bend(10).topology.fans is posed.topology.fans


def test_prepared_fans_hold_what_faces_say(device):
    vertices, faces = oracles.cage("icosphere")
    fans = face_fans(faces).faces
    there = wp.array(vertices, dtype=wp.vec3, device=device), wp.array(fans, dtype=wp.vec3i, device=device)
    prepared = prepared_fans(*there, 1.0).numpy().reshape(-1, 2, 4)
    index = prepared[:, 0, 3].copy().view(np.int32)
    assert np.array_equal(np.where(index < 0, -1 - index, index), fans[:, 2])
    assert np.array_equal(index < 0, ~np.append(goes_on(fans), False))
    a, b, c = (vertices[fans[:, k]] for k in range(3))
    assert np.abs(prepared[:, 0, :3] - c).max() < 1e-6
    assert np.abs(prepared[:, 1, :3] - np.cross(b - a, c - a)).max() < 1e-6


@pytest.mark.parametrize("kind", ["mean_value", "green", "maximum_likelihood", "biharmonic"])
def test_maps_are_the_same_in_any_order(kind, device):
    """Fans, the faces as they were, and in a random order, where next to none goes on with another."""
    vertices, faces = oracles.cage("concave")
    random = np.random.default_rng(5)
    points = oracles.inside_points(vertices, faces, 300)
    points[:4] = vertices[:4]  # on the cage too
    targets, normals = random.normal(size=vertices.shape), random.normal(size=faces.shape)
    fans, found = face_fans(faces), []
    for order, turned in (
        (fans.order, fans.faces),
        (np.arange(len(faces)), faces),
        (mixed := random.permutation(len(faces)), faces[mixed]),
    ):
        there, cage, values, weights = (
            wp.array(np.asarray(a, np.float32), dtype=wp.vec3, device=device)
            for a in (points, vertices, targets, normals[order])
        )
        triangles = wp.array(np.asarray(turned, np.int32), dtype=wp.vec3i, device=device)
        inputs = [there, cage, triangles, prepared_fans(cage, triangles, 1.0), values]
        moved = wp.empty(len(points), dtype=wp.vec3, device=device)
        if kind == "green":
            launch(green.map_green, len(points), [*inputs, weights, 1.0], [moved], device=device)
        else:
            launch(mean_value.map_mean_value, len(points), [*inputs, 1.0], [moved], device=device)
        found.append(moved.numpy())
    assert np.abs(found[0]).max() > 0.5
    assert np.abs(found[1] - found[0]).max() < 1e-5 and np.abs(found[2] - found[0]).max() < 1e-5
