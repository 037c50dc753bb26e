"""Mean value and green weights at 10,000 inside points of four cages; slots between two arms of a cage; bad input."""

import functools
import warnings

import numpy as np
import oracles
import pytest
import trimesh
import warp as wp
from messages import MESSAGES

from warpcage import Cage, PositionMap, deform_points, green_coordinates, harmonic_coordinates, mean_value_coordinates
from warpcage.core import launch, memory
from warpcage.kernels.lattice.cage_map import sample_map
from warpcage.lattice import PoseGraph, PoseLaunches
from warpcage.reference import brick_model

NAMES = ("icosphere", "box", "concave", "bricks")
COUNT = 10_000


@functools.cache
def cage_and_points(name):
    """A cage of float32 vertices and 10,000 float32 points inside it, local units (size 1, about the origin)."""
    if name == "bricks":
        pytest.importorskip("pymeshlab")
        found = Cage.from_mesh(trimesh.Trimesh(*brick_model()[:2], process=False), vertex_count=110)
        vertices = oracles.single((found.vertices - found.bounds.mean(axis=0)) / found.size)
        cage = Cage(vertices, found.faces)
        assert len(vertices) >= 100
    else:
        cage = Cage(*oracles.cage(name))
    random = np.random.default_rng(1)
    points = np.zeros((0, 3))
    while len(points) < COUNT:
        tried = oracles.single(random.uniform(*cage.bounds, (2 * COUNT, 3)))
        inside = [oracles.winding_numbers(part, cage.vertices, cage.faces) > 0.5 for part in np.split(tried, 10)]
        points = np.concatenate([points, tried[np.concatenate(inside)]])
    return cage, points[:COUNT]


@pytest.mark.parametrize("name", NAMES)
def test_mean_value_weights(name, device):
    cage, points = cage_and_points(name)
    expected = oracles.mean_value_weights(points, cage.vertices, cage.faces)
    weights = mean_value_coordinates(points, cage, device=device)
    assert np.abs(weights - expected).max() < 1e-4
    assert np.abs(weights.sum(axis=1) - 1).max() < 1e-5


@pytest.mark.parametrize("name", NAMES)
def test_green_weights(name, device):
    cage, points = cage_and_points(name)
    expected = oracles.green_weights_in_closed_form(points, cage.vertices, cage.faces)
    found = green_coordinates(points, cage, device=device)
    for ours, theirs in zip(found, expected, strict=True):
        assert np.abs(ours - theirs).max() < 1e-4
    assert np.abs(found[0].sum(axis=1) - 1).max() < 1e-5


def test_the_closed_form_of_green_weights_is_that_of_the_paper():
    cage, points = cage_and_points("bricks")
    ours = oracles.green_weights_in_closed_form(points[:500], cage.vertices, cage.faces)
    theirs = oracles.green_weights(points[:500], cage.vertices, cage.faces)
    for a, b in zip(ours, theirs, strict=True):
        assert np.quantile(np.abs(a - b), 0.999) < 1e-6


# -- Thin gaps


def arms(slot):
    """A prism 1 x 0.9 x 0.4 with a slot of this width between two arms: vertices, faces."""
    half = slot / 2
    outline = np.array([[-0.5, -0.45], [0.5, -0.45], [0.5, 0.45], [half, 0.45], [half, -0.1], [-half, -0.1],
                        [-half, 0.45], [-0.5, 0.45]])  # fmt: skip
    top = np.array([[0, 1, 5], [1, 4, 5], [1, 2, 4], [2, 3, 4], [0, 5, 7], [5, 6, 7]])
    sides = [face for i in range(8) for j in [(i + 1) % 8] for face in ([i, j, j + 8], [i, j + 8, i + 8])]
    vertices = np.concatenate([np.column_stack([outline, np.full(8, height)]) for height in (-0.2, 0.2)])
    return vertices, np.concatenate([top[:, ::-1], top + 8, sides])


def look_up(position_map, points):
    local = wp.array((points - position_map.origin).astype(np.float32), dtype=wp.vec3, device=position_map.device)
    positions = wp.empty(len(points), dtype=wp.vec3, device=position_map.device)
    distance = wp.empty(len(points), dtype=float, device=position_map.device)
    launch(sample_map, len(points), [position_map.data, local], [positions, distance], device=position_map.device)
    return positions.numpy() + position_map.origin


def slot_cages(width, degrees, axis=(0.3, 0.2, 1)):
    """A narrow slot, the pose that opens it, and the turn of both."""
    vertices, faces = arms(width)
    turn = trimesh.transformations.rotation_matrix(np.radians(degrees), axis)[:3, :3]
    moved = vertices.copy()
    tips = vertices[:, 1] > 0.3
    moved[tips, 0] += np.where(vertices[tips, 0] > 0, 0.05, -0.05)
    return Cage(vertices @ turn.T, faces), Cage(moved @ turn.T, faces), turn


def points_beside_slot(width, cells, turn, count=3000):
    """Points within three cells of the walls of a slot."""
    random = np.random.default_rng(0)
    side = np.where(random.random(count) < 0.5, 1, -1)
    away = width / 2 + random.uniform(1e-4, 3 / cells, count)
    points = [side * away, random.uniform(-0.15, 0.449, count), random.uniform(-0.199, 0.199, count)]
    return np.column_stack(points) @ turn.T


@pytest.mark.parametrize("degrees", [0, 17, 33])
@pytest.mark.parametrize(("cells", "bound"), [(4, 1e-3), (2, 5e-3), (1, 2e-2)])
@pytest.mark.parametrize("kind", ["harmonic", "mean_value", "green"])
def test_slot_between_two_arms_that_a_pose_opens(kind, cells, bound, degrees, device):
    """Points next to the slot, against the closed form, or the map on a lattice with three times as many cells."""
    resolution = 64
    narrow, wide, turn = slot_cages(cells / resolution, degrees)
    points = points_beside_slot(cells / resolution, resolution, turn, 20_000)  # few cells at the mouth hold tips alone
    position_map = PositionMap(wide, coordinates=kind, resolution=resolution, device=device).pose(narrow)
    if kind == "harmonic":
        expected = look_up(PositionMap(wide, resolution=3 * resolution, device=device).pose(narrow), points)
    else:
        expected = deform_points(points, narrow, wide, kind, device=device)
    bound *= narrow.size
    assert np.abs(look_up(position_map, points) - expected).max() < bound
    if cells == 1:
        assert position_map.thin_nodes > 100
        # what one value an outside node would give
        position_map.data.side_index = wp.empty(0, dtype=int, device=device)
        assert np.abs(look_up(position_map, points) - expected).max() > 2e-2  # a fifth of what the pose opens


@pytest.mark.parametrize(("degrees", "axis"), [(25, (1, 0.4, 0.2)), (70, (1, 0.2, -0.6))])
def test_slot_of_a_mean_value_map_turned_about_other_axes(degrees, axis, device):
    """The formula sees the other wall and bends most there; at 40 degrees some cells have sides."""
    narrow, wide, turn = slot_cages(4 / 64, degrees, axis)
    points = points_beside_slot(4 / 64, 64, turn, 20_000)
    position_map = PositionMap(wide, coordinates="mean_value", resolution=64, device=device).pose(narrow)
    expected = deform_points(points, narrow, wide, "mean_value", device=device)
    assert np.abs(look_up(position_map, points) - expected).max() < 1e-3 * narrow.size


@pytest.mark.parametrize(("degrees", "axis"), [(40, (-0.3, 1, 0.5)), (70, (1, 0.2, -0.6)), (20, (0.5, -1, 0.3))])
@pytest.mark.parametrize("kind", ["mean_value", "green"])
def test_one_cell_slots_turned_so_that_cells_hold_tips_alone(kind, degrees, axis, device):
    """Each has a point of 20,000, in a cell with a corner of one arm, that errs by 0.02 to 0.07 if it takes the side
    whose corners are nearer inside, or if the cell has the other arm's side only."""
    narrow, wide, turn = slot_cages(1 / 64, degrees, axis)
    points = points_beside_slot(1 / 64, 64, turn, 20_000)
    position_map = PositionMap(wide, coordinates=kind, resolution=64, device=device).pose(narrow)
    expected = deform_points(points, narrow, wide, kind, device=device)
    assert np.abs(look_up(position_map, points) - expected).max() < 1.5e-2 * narrow.size


@pytest.mark.parametrize("kind", ["harmonic", "mean_value", "green"])
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
    with pytest.raises(ValueError, match=MESSAGES["coordinates.gaps_memory"]):
        position_map.pose(narrow)
    with pytest.raises(ValueError, match="no pose yet"):
        _ = position_map.data  # rather than a map without them
    free[:] = [most]
    position_map.pose(narrow)
    assert position_map.thin_nodes > 0
    tables = position_map.launches.sides.buffers.bytes
    assert 0 < tables < most - least
    assert position_map.lattice.buffers.bytes + tables < most


@pytest.mark.parametrize("kind", ["harmonic", "mean_value", "green"])
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
            assert np.array_equal(look_up(kept, inside), look_up(expected, inside))
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
        assert np.abs(look_up(position_map, points @ matrix.T) - points).max() < 5e-6


def test_weights_and_map_agree_at_a_slot(device):
    vertices, faces = arms(1 / 24)
    narrow = Cage(vertices, faces)
    wide = narrow.with_vertices(arms(0.2)[0])
    points = oracles.inside_points(vertices, faces, 500)
    maps = [PositionMap(wide, resolution=24, store=store, device=device).pose(narrow) for store in ("map", "weights")]
    assert maps[0].data.side_index.size > 0
    assert np.abs(look_up(maps[0], points) - look_up(maps[1], points)).max() < 1e-4


# -- Bad input


@pytest.mark.parametrize("resolution", [7, 0, -1, 5000, 10**9, 64.0, "64", None])
def test_resolutions_out_of_range_are_refused(resolution):
    cage, points = cage_and_points("box")
    with pytest.raises(ValueError, match="resolution must be"):
        harmonic_coordinates(points[:3], cage, resolution)


def broken_cages():
    cage = Cage.box((0, 0, 0), (1, 1, 1))
    twice = cage.vertices.copy()
    twice[1] = twice[0]
    flat = cage.vertices * [1, 1, 0]
    return {
        "open": Cage(cage.vertices, cage.faces[1:]),
        "inward": Cage(cage.vertices, cage.faces[:, ::-1]),
        "place of another": cage.with_vertices(twice),
        "place of another|degenerate": cage.with_vertices(flat),
    }


@pytest.mark.parametrize("problem", ["open", "inward", "place of another", "place of another|degenerate"])
def test_cages_that_cannot_be_used_are_refused_in_one_line(problem):
    cage = broken_cages()[problem]
    calls = [lambda kind=kind: kind([[0.5, 0.5, 0.5]], cage)
             for kind in (mean_value_coordinates, green_coordinates, harmonic_coordinates)]  # fmt: skip
    calls.append(lambda: PositionMap(cage))
    for call in calls:
        with pytest.raises(ValueError, match=problem) as caught:
            call()
        assert "\n" not in str(caught.value)


def test_vertices_that_are_not_finite_are_refused():
    cage = Cage.box((0, 0, 0), (1, 1, 1))
    vertices = cage.vertices.copy()
    vertices[3, 1] = np.nan
    with pytest.raises(ValueError, match="finite"):
        cage.with_vertices(vertices)
    with pytest.raises(ValueError, match="finite"):
        Cage(vertices, cage.faces)


def test_no_points_are_no_error(device):
    cage, _ = cage_and_points("box")
    assert mean_value_coordinates(np.zeros((0, 3)), cage, device=device).shape == (0, 8)
    assert green_coordinates(np.zeros((0, 3)), cage, device=device)[1].shape == (0, 12)
    assert harmonic_coordinates(np.zeros((0, 3)), cage, 16, device=device).shape == (0, 8)


def test_weights_too_large_for_the_device_are_refused(monkeypatch, device):
    cage, points = cage_and_points("box")
    monkeypatch.setattr(memory, "free_bytes", lambda device: 1 << 10)
    harmonic = lambda points, cage, device: harmonic_coordinates(points, cage, 16, device=device)  # noqa: E731
    for call in (mean_value_coordinates, green_coordinates, harmonic):
        with pytest.raises(ValueError, match=MESSAGES["coordinates.points_at_a_time"]):
            call(points, cage, device=device)
