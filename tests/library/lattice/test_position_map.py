"""PositionMap: the map from a deformed cage to its rest cage, for all kinds of coordinates and both stores."""

import functools
import itertools

import numpy as np
import oracles
import pytest
import trimesh
import warp as wp
from biharmonic_oracles import biharmonic_weights
from fields import slotted
from messages import MESSAGES
from oracles import look_up
from refusals import refused

from warpcage import Cage, PositionMap
from warpcage.coordinates import harmonic_weights, stretched_normals
from warpcage.core import memory
from warpcage.lattice import GreenSolver, PoseGraph, fit_affine
from warpcage.lattice import lattice as block_faces
from warpcage.lattice import lattice as lattices

KINDS = ("harmonic", "mean_value", "green", "maximum_likelihood", "biharmonic")
STORES = ("map", "weights")


def by_day(is_by_day, *values):
    """All combinations of values; those that are not by day run at night alone."""
    night = pytest.mark.nightly
    return [pytest.param(*each, marks=() if is_by_day(*each) else night) for each in itertools.product(*values)]


def cage_named(name):
    return Cage(*oracles.cage(name))


def inside_points(cage, count=300):
    center = cage.bounds.mean(axis=0)
    return oracles.inside_points(cage.vertices - center, cage.faces, count) + center


def points_up_to(cage, count=200):
    """Inside points, and points on the faces moved in by 1e-5 of the size."""
    share = np.random.default_rng(4).dirichlet([1, 1, 1], len(cage.faces))
    corners = cage.vertices[cage.faces]
    on_faces = np.einsum("fk,fkc->fc", share, corners)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return np.concatenate([inside_points(cage, count), on_faces - 1e-5 * cage.size * normal])


def pose_noisily(cage, amount=0.04):
    return cage.with_vertices(cage.vertices + amount * np.random.default_rng(2).uniform(-1, 1, cage.vertices.shape))


@pytest.mark.parametrize(
    ("name", "kind", "store"),
    by_day(
        lambda name, kind, store: name == "concave" or store == "map",
        ["icosphere", "concave", "two boxes"],
        KINDS,
        STORES,
    ),
)
def test_affine_poses_are_undone_up_to_the_cage(name, kind, store, device):
    rest = cage_named(name)
    matrix = np.array([[0.9, -0.5, 0.1], [0.4, 1.2, 0.3], [-0.2, 0.1, 0.8]])
    if kind in ("green", "biharmonic"):  # similarity
        matrix = 1.3 * np.linalg.qr(matrix)[0]
        matrix *= np.sign(np.linalg.det(matrix))
    deformed = rest.with_vertices(rest.vertices @ matrix.T + [3, -2, 1])
    position_map = PositionMap(rest, coordinates=kind, resolution=16, store=store, device=device).pose(deformed)
    points = points_up_to(deformed)
    positions, _ = look_up(position_map, points)
    expected = (points - [3, -2, 1]) @ np.linalg.inv(matrix).T
    assert np.abs(positions - expected).max() < 2e-6 * rest.size


def reference(kind, points, deformed, rest, device):
    if kind == "mean_value":
        return oracles.mean_value_weights(points, deformed.vertices, deformed.faces) @ rest.vertices
    if kind == "maximum_likelihood":
        return oracles.maximum_likelihood_weights(points, deformed.vertices, deformed.faces) @ rest.vertices
    if kind in ("green", "biharmonic"):
        weigh = oracles.green_weights if kind == "green" else biharmonic_weights
        phi, psi = weigh(points, deformed.vertices, deformed.faces)
        return phi @ rest.vertices + psi @ stretched_normals(deformed, rest)
    return harmonic_weights(points, deformed, 64, device) @ rest.vertices


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["icosphere", "concave"])
def test_map_follows_the_coordinates_to_second_order(name, kind, device):
    rest = cage_named(name)
    deformed = pose_noisily(rest)
    points = inside_points(deformed)
    expected = reference(kind, points, deformed, rest, device)
    errors = []
    for resolution in (16, 32):
        position_map = PositionMap(rest, coordinates=kind, resolution=resolution, device=device).pose(deformed)
        positions, distance = look_up(position_map, points)
        clear = distance < -1.5 * rest.size / 16
        errors.append(np.sqrt(((positions - expected)[clear] ** 2).mean()))
        assert np.abs(positions - expected).max() < 8e-3 * 16 / resolution
    assert clear.sum() > 20
    assert errors[1] < errors[0] / 2.2 and errors[1] < 1.5e-4


@pytest.mark.parametrize("kind", ["harmonic", "mean_value"])
def test_cage_itself_goes_to_the_rest_cage(kind, device):
    rest = cage_named("concave")
    deformed = pose_noisily(rest)
    share = np.random.default_rng(7).dirichlet([1, 1, 1], (len(rest.faces), 20))
    points = np.einsum("fnk,fkc->fnc", share, deformed.vertices[deformed.faces]).reshape(-1, 3)
    expected = np.einsum("fnk,fkc->fnc", share, rest.vertices[rest.faces]).reshape(-1, 3)
    position_map = PositionMap(rest, coordinates=kind, resolution=48, device=device).pose(deformed)
    positions, distance = look_up(position_map, points)
    assert np.abs(distance).max() < 0.6 * position_map.data.spacing
    assert np.abs(positions - expected).max() < 5e-3


@pytest.mark.parametrize(
    ("kind", "name", "resolution"),
    [
        ("harmonic", "concave", 20),
        ("mean_value", "icosphere", 40),
        ("green", "icosphere", 40),
        ("biharmonic", "icosphere", 32),
    ],
)
def test_stored_weights_give_the_same_map_and_rebind(kind, name, resolution, device):
    """Weights of closed forms are evaluated at all inside nodes, the map at every second one clear of the cage."""
    rest = cage_named(name)
    deformed, other = pose_noisily(rest, 0.1), rest.twist(40)
    options = {"coordinates": kind, "resolution": resolution, "device": device}
    points = points_up_to(deformed)
    weights = PositionMap(rest, store="weights", **options).pose(deformed)
    by_weights, _ = look_up(weights, points)
    position_map = PositionMap(rest, **options).pose(deformed)
    assert kind == "harmonic" or position_map.launches.solver.nodes.sections.interpolated > 1000
    inside = position_map.data.distance.numpy() < 0
    nodes = [each.data.positions.numpy()[inside] for each in (weights, position_map)]
    bound = 4e-5 if kind == "biharmonic" else 2e-5  # it bends more between the nodes
    assert np.abs(nodes[0] - nodes[1]).max() < bound
    assert np.abs(by_weights - look_up(position_map, points)[0]).max() < bound
    rebound, _ = look_up(weights.rebind(other), points)
    by_map, _ = look_up(PositionMap(other, origin=weights.origin, **options).pose(deformed), points)
    assert np.abs(rebound - by_map).max() < bound
    assert np.abs(rebound - by_weights).max() > 1e-2


@pytest.mark.parametrize(
    ("kind", "place"),
    by_day(
        lambda kind, place: kind == "harmonic" or place in ((1e3, -1e6), (1e-3, 0.0)),
        KINDS,
        [(1.0, 1e4), (1e3, -1e6), (1e3, 0.0), (1e-3, 0.0)],
    ),
)
def test_far_origin_and_scale(kind, place, device):
    scale, shift = place
    rest = cage_named("icosphere")
    deformed = pose_noisily(rest)
    points = inside_points(deformed)
    options = {"coordinates": kind, "resolution": 16, "device": device}
    positions, _ = look_up(PositionMap(rest, **options).pose(deformed), points)
    moved = [cage.with_vertices(cage.vertices * scale + shift) for cage in (rest, deformed)]
    far, _ = look_up(PositionMap(moved[0], **options).pose(moved[1]), points * scale + shift)
    assert np.abs((far - shift) / scale - positions).max() < 2e-5


def compare(position_map, poses, expected):
    """Maps of poses, one after the other, are those that new maps of other options gave: (points, look-up) of each."""
    for pose, (points, wanted) in zip(poses, expected, strict=True):
        found = look_up(position_map.pose(pose), points)
        assert all(np.array_equal(*pair) for pair in zip(found, wanted, strict=True))
        yield position_map


def fresh_maps(rest, poses, monkeypatch, **options):
    """Without graphs: (points, look-up) of a new map of each pose, and how many cycles each took."""
    set_graphs(monkeypatch, False)
    points = [inside_points(pose, 100) for pose in poses]
    maps = [PositionMap(rest, **options).pose(pose) for pose in poses]
    return [(x, look_up(each, x)) for x, each in zip(points, maps, strict=True)], [each.cycles for each in maps]


def set_graphs(monkeypatch, supported):
    """Whether launches of a pose are those that a CUDA graph has; on the CPU they run one by one."""
    monkeypatch.setattr(PoseGraph, "is_supported", staticmethod(lambda device: supported))


@pytest.mark.parametrize(
    ("kind", "graphs", "many_faces"),
    [*((kind, graphs, 1 << 30) for kind in KINDS for graphs in (False, True)), ("mean_value", True, 1)],
)
def test_posing_again_gives_what_a_new_map_gives(kind, graphs, many_faces, device, monkeypatch):
    """A graph has room for other poses. With many_faces = 1 faces are looked through for groups of blocks, as they are
    for large cages."""
    for limit in ("MANY_FACES", "MANY_FACES_CPU"):
        monkeypatch.setattr(block_faces, limit, many_faces)
    rest = cage_named("icosphere")
    options = {"coordinates": kind, "resolution": 16, "device": device}
    poses = [pose_noisily(rest), rest.scale((1, 1.02, 0.97)), rest.rotate(20), rest.scale((1, 0.5, 0.4)), rest]
    expected, cycles = fresh_maps(rest, poses, monkeypatch, **options)
    set_graphs(monkeypatch, graphs)
    finish, replays = PoseGraph.finish, []
    monkeypatch.setattr(PoseGraph, "finish", lambda self: replays.append(finish(self)) or replays[-1])
    assert [kept.cycles for kept in compare(PositionMap(rest, **options), poses, expected)] == cycles
    assert sum(replays) >= 2 if graphs else not replays


def test_poses_that_take_turns_share_a_graph(device, monkeypatch):
    """Whichever is larger: the first two are not captured with the room that both need."""
    set_graphs(monkeypatch, True)
    capture, captures = PoseGraph.capture, []
    monkeypatch.setattr(PoseGraph, "capture", lambda self: captures.append(self) or capture(self))
    rest = cage_named("icosphere")
    large, small = rest.scale((1, 1, 0.9)), rest.scale((1, 0.5, 0.6))
    for poses in ([large, small], [small, large]):
        position_map = PositionMap(rest, coordinates="mean_value", resolution=16, device=device)
        for pose in 2 * poses:
            position_map.pose(pose)
        captures.clear()
        for pose in 3 * poses:
            position_map.pose(pose)
        assert captures == []


def ball_poses():
    """Lines of the first pose cross the cage more often than they have room for without graphs."""
    rest = cage_named("icosphere")
    bent = rest.stretch(1.8, axis="x").bend(150, axis="x", towards="z")
    return rest, [bent, rest.scale((1, 1.3, 0.6)), rest.scale((1, 0.6, 0.7)), rest.twist(60), rest]


def rod_poses():
    """Once turned the rod has a lattice of twice the nodes and more, and four times as many at cells' corners alone."""
    rest = Cage.box((-0.3, -0.3, -1), (0.3, 0.3, 1), segments=3)
    turned = rest.rotate(45, axis="x")
    return rest, [turned, turned.bend(20), rest.rotate(45, axis="z"), rest.rotate(30, axis="y").twist(20), rest]


@pytest.mark.parametrize(
    ("kind", "scene"),
    by_day(lambda kind, scene: scene is ball_poses or kind in ("harmonic", "green"), KINDS, [ball_poses, rod_poses]),
)
def test_no_pose_waits_for_a_graph_once_maps_are_warm(kind, scene, device, monkeypatch):
    """From the first pose on, whatever its proportions, with the outcome of poses without graphs."""
    monkeypatch.setattr(lattices, "LINE_CAPACITY", 2)
    rest, poses = scene()
    options = {"coordinates": kind, "resolution": 24, "device": device}
    expected, _ = fresh_maps(rest, poses, monkeypatch, **options)
    assert PositionMap(rest, **options).warm().lattice is None  # nothing to be done without graphs
    set_graphs(monkeypatch, True)
    kept, captures = PositionMap(rest, **options).warm(), []
    monkeypatch.setattr(PoseGraph, "capture", lambda self: captures.append(self))
    # private, as users cannot ask which of the two ways a pose took
    monkeypatch.setattr(PositionMap, "_pose_step_by_step", lambda self, deformed: captures.append(self))
    assert len(list(compare(kept, poses, expected))) == len(poses) and captures == []


def require_refused(position_map, pose, cages, message):
    """The map of a pose is as it was after cages that are refused."""
    points = inside_points(pose, 50)
    before = look_up(position_map.pose(pose), points)
    for cage in cages:
        refused(functools.partial(position_map.pose, cage), match=message)
    assert all(np.array_equal(*pair) for pair in zip(before, look_up(position_map, points), strict=True))


@pytest.mark.parametrize(
    ("kind", "graphs"),
    by_day(
        lambda kind, graphs: graphs == "with room" or kind in ("harmonic", "mean_value"),
        KINDS,
        ["none", "with room", "without room"],
    ),
)
def test_a_refused_pose_leaves_the_last_one(kind, graphs, device, monkeypatch):
    """Graphs start on a pose before its cage is checked."""
    set_graphs(monkeypatch, graphs != "none")
    if graphs == "without room":
        monkeypatch.setattr(PoseGraph, "fits", lambda self, sizes: False)
    rest = cage_named("icosphere")
    same_place = rest.bend(28).vertices.copy()
    same_place[1] = same_place[0]
    broken = (rest.vertices * [-1, 1, 1], same_place, 0 * rest.vertices, rest.vertices * [3, 1, 0])
    position_map = PositionMap(rest, coordinates=kind, resolution=16, device=device)
    for degrees in (30, 29, 31):
        require_refused(position_map, rest.bend(degrees), map(rest.with_vertices, broken), "^deformed cage ")


@pytest.mark.parametrize(
    ("kind", "graphs"), by_day(lambda kind, graphs: graphs or kind in ("harmonic", "mean_value"), KINDS, [False, True])
)
def test_a_cage_too_far_for_float32_is_refused(kind, graphs, device, monkeypatch):
    """Beyond, the rounded lattice would lie beside the cage."""
    set_graphs(monkeypatch, graphs)
    rest = cage_named("box")
    position_map = PositionMap(rest, coordinates=kind, resolution=64, device=device)
    refused(lambda: position_map.pose(rest.translate([1e6, -3e6, 0])), match=MESSAGES["lattice.lower_resolution"])
    for degrees in (30, 29):
        require_refused(position_map, rest.bend(degrees), [rest.translate([1e6, 0, 0])], "float32")
    # where rounding is a third of a cell, all of the cage is still on the lattice
    far = rest.translate(np.array([3e4, -2e4, 1e4]))
    lattice = position_map.pose(far).lattice
    low, high = (far.bounds - lattice.lower) / lattice.spacing
    assert low.min() >= 2 and (np.array(lattice.shape) - 1 - high).min() >= 2


@pytest.mark.parametrize(
    ("kind", "graphs"), by_day(lambda kind, graphs: graphs or kind in ("harmonic", "mean_value"), KINDS, [False, True])
)
def test_maps_that_are_begun(kind, graphs, device, monkeypatch):
    """The last one begun is the one that is finished. What `begin` returns is the map, but for the sides of gaps."""
    set_graphs(monkeypatch, graphs)
    rest = cage_named("icosphere")
    options = {"coordinates": kind, "resolution": 16, "device": device}
    kept = PositionMap(rest, **options).warm()
    for angle in (30, 10, 20):
        kept.begin(rest.bend(30 - angle))
        draft, expected = kept.begin(rest.bend(angle)), PositionMap(rest, **options).pose(rest.bend(angle)).data
        assert (draft is not None) == graphs
        found = kept.finish().data
        assert found is draft or not graphs
        for array in ("positions", "distance"):
            assert np.array_equal(getattr(found, array).numpy(), getattr(expected, array).numpy())


def test_harmonic_map_reports_its_solver(device):
    rest = cage_named("icosphere")
    position_map = PositionMap(rest, resolution=32, device=device)
    assert position_map.cycles == 0
    position_map.pose(pose_noisily(rest))
    assert 2 <= position_map.cycles <= 7 and 0 < position_map.residual <= 1e-5
    tight = PositionMap(rest, resolution=32, tolerance=2e-6, device=device).pose(pose_noisily(rest))
    assert tight.residual <= 2e-6 < 1e-5


def test_nodes_at_narrow_gaps_are_counted(device):
    """A slit between two boxes, half a cell wide, then five cells wide."""
    box = Cage.box((0, 0, 0), (1, 1, 1))

    def pair(gap):
        two = np.concatenate([box.vertices, box.vertices + [1 + gap, 0, 0]])
        return Cage(two, np.concatenate([box.faces, box.faces + 8]))

    wide, narrow = pair(5 * 2.1 / 32), pair(0.5 * 2.1 / 32)
    position_map = PositionMap(wide, resolution=32, device=device)
    assert position_map.pose(wide).thin_nodes == 0
    assert position_map.pose(narrow).thin_nodes > 100


@pytest.mark.parametrize("width", [0.02, 0.05])
def test_sides_of_green_maps_take_the_map_beside_gaps_alone(width, device, monkeypatch):
    """Whatever crossings elsewhere hold; they are not evaluated."""
    set_graphs(monkeypatch, False)
    launch_boundary, poison, filled = GreenSolver.launch_boundary, [0.0], []

    def poisoned(self, sizes, target, rows, marks, boundary):
        boundary.fill_(wp.vec3(poison[0], poison[0], poison[0]))
        launch_boundary(self, sizes, target, rows, marks, boundary)
        filled.append((boundary.numpy() != poison[0]).any(axis=-1).mean())

    monkeypatch.setattr(GreenSolver, "launch_boundary", poisoned)
    tables = []
    for poison[0] in (0.5, 1e6):
        posed = PositionMap(slotted(0.4), coordinates="green", resolution=24, device=device).pose(slotted(width))
        index, sides = posed.data.side_index.numpy(), posed.data.sides.numpy()
        used = np.concatenate([np.arange(entry // 8, entry // 8 + entry % 8) for entry in index[index > 0]])
        tables.append((index, sides[used], posed.gap_jump))
    assert np.array_equal(tables[0][0], tables[1][0]) and len(tables[0][1]) > 100
    assert np.array_equal(tables[0][1], tables[1][1]) and tables[0][2] == tables[1][2]
    assert 0 < max(filled) < 0.3


def test_memory_is_foreseen_and_refused(device, monkeypatch):
    rest = cage_named("icosphere")
    for kind in KINDS:
        for store in STORES:
            position_map = PositionMap(rest, coordinates=kind, resolution=40, store=store, device=device).pose(rest)
            held = position_map.lattice.buffers.bytes
            if store == "weights":
                held += sum(a.capacity for block in position_map.weights.blocks for a in block[1:] if a is not None)
            assert held <= position_map.memory_bytes(rest) < 2.5 * held
    sphere = trimesh.creation.icosphere(subdivisions=4)
    fine = PositionMap(Cage(sphere.vertices, sphere.faces), resolution=24, device=device)
    before = fine.memory_bytes()
    held = fine.pose(fine.rest).lattice.buffers.bytes
    assert held <= before < 2.5 * held
    assert PositionMap(rest, resolution=128, device="cpu").memory_bytes() < 100e6
    assert PositionMap(rest, resolution=256, device="cpu").memory_bytes() < 700e6
    monkeypatch.setattr(memory, "free_bytes", lambda device: 1 << 20)
    with pytest.raises(ValueError, match=MESSAGES["lattice.lower_or_map"]):
        PositionMap(rest, resolution=40, store="weights", device=device).pose(rest)


def test_bad_input_is_refused(device):
    rest = cage_named("box")
    for wrong in (
        {"coordinates": "bezier"},
        {"store": "disk"},
        {"resolution": 4},
        {"resolution": 5000},
        {"tolerance": 0},
    ):
        refused(functools.partial(PositionMap, rest, device=device, **wrong))
    position_map = PositionMap(rest, resolution=8, device=device)
    with pytest.raises(ValueError, match="no pose yet"):
        _ = position_map.data
    for cage, message in (
        (cage_named("icosphere"), "42 vertices"),
        (Cage(rest.vertices, rest.faces[::-1]), "another order"),
        (rest.with_vertices(rest.vertices * [-1, 1, 1]), "deformed cage"),
    ):
        refused(functools.partial(position_map.pose, cage), match=message)
    refused(lambda: position_map.pose(rest).rebind(rest), match="weights")
    with pytest.raises(ValueError, match="no weights are kept"):
        _ = position_map.weights
    refused(lambda: PositionMap(Cage(rest.vertices, rest.faces[1:]), device=device), match="rest cage")


def test_affine_fit_leaves_nothing_of_an_affine_pose():
    rest = cage_named("concave")
    matrix, offset = np.array([[1, 0.2, 0], [0, 2, 0], [0.1, 0, 0.5]]), np.array([1e4, 2, 3])
    fitted, shift = fit_affine(rest, rest.with_vertices(rest.vertices @ matrix.T + offset))
    assert np.allclose(fitted, matrix, atol=1e-9) and np.allclose(shift, offset, atol=1e-9)
