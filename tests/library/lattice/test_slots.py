"""Slots between two arms of a cage, a few cells of the lattice wide or less, that a pose opens."""

import itertools
import warnings

import numpy as np
import oracles
import pytest
import warp as wp
from messages import MESSAGES
from oracles import arms, look_up, points_beside_slot, slot_cages
from refusals import refused

from warpcage import Cage, PositionMap, deform_points
from warpcage.core import memory
from warpcage.lattice import PoseGraph, PoseLaunches

KINDS = ("harmonic", "mean_value", "green", "maximum_likelihood", "biharmonic")


def slots():
    """Kind of coordinates, width in cells, turn in degrees about an axis, and largest error in sizes of the cage."""
    bounds = {4: 1e-3, 2: 5e-3, 1: 2e-2}
    for kind, (row, (cells, bound)), (column, degrees) in itertools.product(
        KINDS, enumerate(bounds.items()), enumerate((0, 17, 33))
    ):
        is_slow = row != column  # each width is there by day, and each turn
        yield pytest.param(kind, cells, degrees, (0.3, 0.2, 1), bound, marks=[pytest.mark.nightly] if is_slow else [])
    # the formula sees the other wall and bends most there; at 40 degrees some cells have sides
    for degrees, axis in ((25, (1, 0.4, 0.2)), (70, (1, 0.2, -0.6))):
        yield "mean_value", 4, degrees, axis, 1e-3
    # a point in a cell with a corner of one arm alone errs by 0.02 to 0.07 if it takes the side of nearer corners,
    # or if the cell has the other arm's side only
    for degrees, axis in ((40, (-0.3, 1, 0.5)), (70, (1, 0.2, -0.6)), (20, (0.5, -1, 0.3))):
        for kind in ("mean_value", "green"):
            yield kind, 1, degrees, axis, 1.5e-2


@pytest.mark.parametrize(("kind", "cells", "degrees", "axis", "bound"), slots())
def test_slot_between_two_arms_that_a_pose_opens(kind, cells, degrees, axis, bound, device):
    """Points next to the slot, against the closed form, or the map on a lattice with three times as many cells."""
    resolution = 64
    narrow, wide, turn = slot_cages(cells / resolution, degrees, axis)
    points = points_beside_slot(cells / resolution, resolution, turn, 20_000)  # few cells at the mouth hold tips alone
    position_map = PositionMap(wide, coordinates=kind, resolution=resolution, device=device).pose(narrow)
    if kind == "harmonic":
        expected, _ = look_up(PositionMap(wide, resolution=3 * resolution, device=device).pose(narrow), points)
    else:
        expected = deform_points(points, narrow, wide, kind, device=device)
    assert np.abs(look_up(position_map, points)[0] - expected).max() < bound * narrow.size
    if cells == 1:
        assert position_map.thin_nodes > 100
        # what one value an outside node would give
        position_map.data.side_index = wp.empty(0, dtype=int, device=device)
        assert np.abs(look_up(position_map, points)[0] - expected).max() > 2e-2  # a fifth of what the pose opens


@pytest.mark.parametrize("kind", KINDS)
def test_gaps_narrower_than_a_cell_are_reported(kind, device):
    narrow, wide, _turn = slot_cages(0.6 / 32, 17)
    position_map = PositionMap(wide, coordinates=kind, resolution=32, device=device)
    with pytest.warns(UserWarning, match=MESSAGES["coordinates.gaps_open"]) as caught:
        position_map.pose(narrow)
    assert caught[0].filename == __file__  # the caller's line, not one of the package
    assert 0.05 < position_map.gap_jump < 0.15
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(UserWarning):
            position_map.pose(narrow)
        assert position_map.thin_nodes > 0  # reported, and there all the same
        position_map.pose(wide)
        assert position_map.gap_jump == 0.0
        PositionMap(narrow, coordinates=kind, resolution=32, device=device).pose(narrow.twist(5))  # nothing opens


@pytest.mark.parametrize("resolution", [16, 64])
def test_creases_of_a_twisted_box_are_no_gaps(resolution, device):
    """Its sides fold inward along their diagonals: links cross the cage twice there, over grooves as long as the box.
    What the map changes over them are so and so many cells, whatever the resolution; an opened slot keeps its width."""
    box = Cage.box((-0.7, -0.7, 0.0), (0.7, 0.7, 0.7))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        position_map = PositionMap(box, resolution=resolution, device=device).pose(box.twist(60))
    assert position_map.thin_nodes > 0 and position_map.gap_jump == 0.0


def test_memory_for_the_sides_of_gaps_is_refused_before_it_is_taken(device, monkeypatch):
    narrow, wide, _ = slot_cages(1 / 32, 0)
    position_map = PositionMap(wide, resolution=32, device=device)
    least, most = position_map.memory_bytes(narrow), position_map.memory_bytes(narrow, gaps=True)
    free = [least]
    monkeypatch.setattr(memory, "free_bytes", lambda device: free.pop() if len(free) > 1 else free[0])
    free[:] = [1 << 12, least]  # enough for the map, not for the tables
    refused(lambda: position_map.pose(narrow), match=MESSAGES["coordinates.gaps_memory"])
    with pytest.raises(ValueError, match="no pose yet"):
        _ = position_map.data  # rather than a map without them
    free[:] = [most]
    position_map.pose(narrow)
    assert position_map.thin_nodes > 0
    tables = position_map.launches.sides.buffers.bytes
    assert 0 < tables < most - least
    assert position_map.lattice.buffers.bytes + tables < most


@pytest.mark.parametrize("kind", KINDS)
def test_sides_of_replayed_poses_are_the_same(kind, device, monkeypatch):
    """Tables in the launches of a graph, with room for other poses, against those found step by step."""
    narrow, wide, turn = slot_cages(1.2 / 32, 17)
    options = {"coordinates": kind, "resolution": 32, "device": device}
    points = points_beside_slot(1.2 / 32, 32, turn)
    # as it was, larger, with more cells at gaps as its lattice lies otherwise, without gaps, and again
    poses = [narrow, narrow.scale(1.01), narrow.rotate(30), narrow.scale((1, 0.7, 1)), wide, narrow.rotate(-10), narrow]
    monkeypatch.setattr(PoseGraph, "is_supported", staticmethod(lambda device: False))
    fresh = [PositionMap(wide, **options).pose(pose) for pose in poses]
    monkeypatch.setattr(PoseGraph, "is_supported", staticmethod(lambda device: True))
    found, replays = [], []
    find, find_sides = PoseLaunches.find_sides, PoseGraph.find_sides
    monkeypatch.setattr(PoseLaunches, "find_sides", lambda *both: found.append(both) or find(*both))
    monkeypatch.setattr(PoseGraph, "find_sides", lambda self: replays.append(find_sides(self)) or replays[-1])
    kept = PositionMap(wide, **options)
    for _turn in range(2):
        for pose, expected in zip(poses, fresh, strict=True):
            kept.pose(pose)
            assert (kept.thin_nodes, kept.gap_jump) == (expected.thin_nodes, expected.gap_jump)
            inside = points[pose.contains(points)]
            assert len(inside) > 1000
            assert np.array_equal(look_up(kept, inside)[0], look_up(expected, inside)[0])
    assert sum(replays) >= 6
    assert len(found) + sum(replays) == 2 * sum(expected.thin_nodes > 0 for expected in fresh)
    assert len({expected.thin_nodes for expected in fresh}) >= 4


def test_sides_of_a_slot_are_exact_for_affine_poses(device):
    vertices, faces = arms(1 / 32)
    narrow = Cage(vertices, faces)
    matrix = np.array([[0.9, -0.5, 0.1], [0.4, 1.2, 0.3], [-0.2, 0.1, 0.8]])
    for store in ("map", "weights"):
        position_map = PositionMap(narrow, resolution=32, store=store, device=device).pose(
            narrow.with_vertices(vertices @ matrix.T)
        )
        points = oracles.inside_points(vertices, faces, 500)
        assert np.abs(look_up(position_map, points @ matrix.T)[0] - points).max() < 5e-6


def test_weights_and_map_agree_at_a_slot(device):
    vertices, faces = arms(1 / 24)
    narrow = Cage(vertices, faces)
    wide = narrow.with_vertices(arms(0.2)[0])
    points = oracles.inside_points(vertices, faces, 500)
    maps = [PositionMap(wide, resolution=24, store=store, device=device).pose(narrow) for store in ("map", "weights")]
    assert maps[0].data.side_index.size > 0
    assert np.abs(look_up(maps[0], points)[0] - look_up(maps[1], points)[0]).max() < 1e-4
