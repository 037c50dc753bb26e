"""Points bound to a cage: packed rows, fits of poses and shared ways against float64 and plain NumPy."""

import functools

import numpy as np
import pytest
import warp as wp
from polygon_cages import quad_box
from splat_scenes import splats_in_box
from test_splat_pose import AFFINE, BOX, TURN, forward_map

from warpcage import Cage, CageEdit, Deformer, deform_points
from warpcage.coordinate_kinds import COORDINATE_KINDS
from warpcage.coordinates import stretched_normals
from warpcage.deform import shared_ways
from warpcage.kernels.splats.pose import CarriedSplats
from warpcage.lattice import fit_affine
from warpcage.splats import CageBinding, PoseFit, binding, fit_similarity, split_tree

KINDS = ("harmonic", "mean_value", "green", "maximum_likelihood", "biharmonic")
ORIGIN = np.array([0.3, -0.2, 0.1])


def carried(kind, points, cage, posed, device, packed, origin=ORIGIN):
    """Where a binding takes points, world units, and the Jacobians; float64 arrays."""
    bound = CageBinding(points, cage, kind, origin, wp.get_device(device), 32, packed)
    assert (bound.rows is None) == packed
    count = len(points)
    state = CarriedSplats()
    state.positions = wp.empty(count, dtype=wp.vec3, device=device)
    state.jacobians = wp.empty(count, dtype=wp.mat33, device=device)
    members = wp.array(np.arange(count), dtype=wp.int32, device=device)
    others = wp.full(count, -1, dtype=wp.int32, device=device)
    anchors = wp.array((points - origin).astype(np.float32), dtype=wp.vec3, device=device)
    vertices = bound.carry(posed, members, others, anchors, wp.zeros_like(anchors), state)
    np.testing.assert_allclose(vertices.numpy()[: len(cage.vertices)] + origin, posed.vertices, atol=1e-6)
    return state.positions.numpy().astype(np.float64) + origin, state.jacobians.numpy().astype(np.float64)


def places(count=200, half=0.9):
    """Points in BOX, as float32 has them relative to ORIGIN; some of them next to a wall."""
    rng = np.random.default_rng(6)
    points = rng.uniform(-half, half, (count, 3))
    points[:20, 0] = 1.0 - 10.0 ** rng.uniform(-4, -1, 20)
    return (points - ORIGIN).astype(np.float32).astype(np.float64) + ORIGIN


@functools.cache
def oracle_pose(kind):
    """A pose, where it takes places by float64, and its Jacobians there by central differences."""
    points, posed, h = places(), BOX.twist(70).bend(40).with_vertices(1.2 * BOX.twist(70).bend(40).vertices), 1e-6
    columns = [
        (forward_map(kind, points + h * e, BOX, posed) - forward_map(kind, points - h * e, BOX, posed)) / (2 * h)
        for e in np.eye(3)
    ]
    return posed, forward_map(kind, points, BOX, posed), np.stack(columns, axis=-1)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("kind", ["mean_value", "green", "maximum_likelihood", "biharmonic"])
def test_a_pose_against_float64(kind, packed, device):
    """Places to 1e-6 of the size, Jacobians by central differences: 3e-4 of the largest entry where they are packed."""
    posed, expected, wanted = oracle_pose(kind)
    found, jacobians = carried(kind, places(), BOX, posed, device, packed)
    assert np.abs(found - expected).max() < 1e-6 * BOX.size
    error = np.abs(jacobians - wanted).max(axis=(1, 2)) / np.abs(wanted).max(axis=(1, 2))
    assert error.max() < (3e-4 if packed else 2e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_packed_poses_are_those_of_whole_rows(kind, device):
    """Places are of the same weights; Jacobians are off by half floats."""
    points, posed = places(), BOX.twist(60)
    (whole, jacobians), (packed, near) = (carried(kind, points, BOX, posed, device, each) for each in (False, True))
    np.testing.assert_allclose(packed, whole, atol=1e-6)
    np.testing.assert_allclose(near, jacobians, atol=5e-4)
    assert (near != jacobians).any()


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_points_bound_to_quads_have_rows_of_the_cages_own_vertices(kind, packed, device, monkeypatch):
    monkeypatch.setattr(binding, "CHUNK", 64)
    cage, cells = quad_box(2, 0.1), COORDINATE_KINDS[kind].face_cells
    rest, posed = cage.refined(cells), cage.twist(40).refined(cells)
    points = np.random.default_rng(1).uniform(-0.7, 0.7, (150, 3))
    found, _ = carried(kind, points, rest, posed, device, packed)
    expected = deform_points(points, cage, cage.twist(40), kind, device=device)
    np.testing.assert_allclose(found, expected, atol=(1e-2 if kind == "harmonic" else 5e-6) * cage.size)
    rows = len(cage.vertices) + COORDINATE_KINDS[kind].has_face_weights * len(rest.faces)
    if not packed:
        assert CageBinding(points, rest, kind, ORIGIN, wp.get_device(device), 32, packed).rows.shape[0] == rows


@pytest.mark.parametrize("packed", [False, True])
def test_points_bound_in_several_launches(packed, device, monkeypatch):
    points, posed = places(), BOX.twist(60)
    once = carried("green", points, BOX, posed, device, packed)
    monkeypatch.setattr(binding, "CHUNK", 64)
    for found, wanted in zip(carried("green", points, BOX, posed, device, packed), once, strict=True):
        np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("kind", KINDS)
def test_packed_affine_poses_are_exact(kind, device):
    points = places()
    for matrix in (TURN, 1.3 * TURN if COORDINATE_KINDS[kind].has_face_weights else AFFINE):
        posed = BOX.with_vertices(BOX.vertices @ matrix.T + [0.2, -0.1, 3.0])
        found, jacobians = carried(kind, points, BOX, posed, device, True)
        np.testing.assert_allclose(found, points @ matrix.T + [0.2, -0.1, 3.0], atol=2e-6)
        np.testing.assert_allclose(jacobians, np.broadcast_to(matrix, jacobians.shape), atol=3e-7)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_packed_gradients_have_no_largest_number(scale, device):
    """Half floats end at 65,504: next to a tiny face gradients per size of the cage are larger. A cage with one corner
    cut off is as good as its float64 rows."""
    small = np.array([[1.0, 1.0, 1.0], [1.0, 1.0 - 5e-6, 1.0], [1.0 - 5e-6, 1.0, 1.0], [1.0, 1.0, 1.0 - 5e-6]])
    apex = np.array([[-1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]])
    vertices = scale * np.concatenate([small[1:], apex])
    faces = [[0, 1, 2], [3, 5, 4], [0, 4, 1], [4, 3, 1], [1, 3, 2], [3, 5, 2], [2, 5, 0], [5, 4, 0]]
    corners = vertices[np.array(faces)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("fi,fi->f", normals, corners[:, 0] - vertices.mean(axis=0)) < 0.0
    cage = Cage(vertices, np.where(inward[:, None], np.array(faces)[:, ::-1], faces))
    cage.require_usable()
    points = scale * (np.full((4, 3), 1.0 - 5e-6) + 2e-7 * np.arange(4)[:, None])
    rng = np.random.default_rng(7)
    posed = cage.with_vertices(vertices + 3e-7 * scale * rng.normal(size=vertices.shape))
    (_, whole), (_, packed) = (
        carried("mean_value", points, cage, posed, device, each, np.zeros(3)) for each in (False, True)
    )
    rows = CageBinding(points, cage, "mean_value", np.zeros(3), wp.get_device(device), packed=False).rows
    assert rows is not None and np.abs(rows.numpy()[..., 1:]).max() > 65_504
    assert np.isfinite(packed).all() and np.abs(packed - whole).max() < 1e-3 * np.abs(whole).max()


@pytest.mark.parametrize("kind", ["harmonic", "green"])
def test_fits_of_poses(kind):
    """The map that fits best, what it leaves of vertices and of stretched normals, and the posed vertices."""
    shift = np.array([2000.0, -300.0, 50.0])
    rest = BOX.translate(shift)
    posed = rest.twist(50).scale((1.1, 0.9, 1.3))
    origin = shift + ORIGIN
    fit = PoseFit(rest, kind, origin)
    count, faces = len(rest.vertices), len(rest.faces)
    assert fit.row_count == (count + faces if kind == "green" else count)
    out = np.zeros((count + fit.row_count, 3), np.float32)
    slope, offset = fit.targets(posed, out)
    matrix = slope + np.eye(3)
    local, moved = rest.vertices - origin, posed.vertices - origin
    if kind == "green":
        wanted, wanted_offset = fit_similarity(local, moved)
        tilts = stretched_normals(rest, posed) - stretched_normals(rest, rest) @ wanted.T
        np.testing.assert_allclose(out[2 * count :], rest.size * tilts, atol=1e-6)
    else:
        wanted, world = fit_affine(rest, posed)
        wanted_offset = world - origin + wanted @ origin
    np.testing.assert_allclose(matrix, wanted, atol=1e-12)
    np.testing.assert_allclose(offset, wanted_offset, atol=1e-9)
    np.testing.assert_allclose(out[:count], moved, atol=1e-6)
    np.testing.assert_allclose(out[count : 2 * count], moved - local @ wanted.T - wanted_offset, atol=1e-6)


def test_fits_leave_out_unused_vertices():
    """A vertex that no face uses lies anywhere and weighs nothing."""
    rest = Cage(np.concatenate([BOX.vertices, [[50.0, 0.0, 0.0]]]), BOX.faces)
    moved = np.concatenate([BOX.vertices @ AFFINE.T, [[0.0, 90.0, 0.0]]])
    out = np.zeros((2 * len(moved), 3), np.float32)
    slope, offset = PoseFit(rest, "mean_value", np.zeros(3)).targets(rest.with_vertices(moved), out)
    np.testing.assert_allclose(slope + np.eye(3), AFFINE, atol=1e-12)
    np.testing.assert_allclose(offset, 0.0, atol=1e-12)
    np.testing.assert_allclose(out[len(moved) : -1], 0.0, atol=1e-6)


def test_shared_ways():
    """A splat of three levels and a copy: middle pieces go with their wholes, unless their anchors differ."""
    factors = np.array([np.diag([1.0, 0.1, 0.1]), np.diag([0.1, 0.1, 0.1])])
    tree = split_tree(np.zeros((2, 3)), factors, np.full(2, 0.5), np.full(2, 0.5), cuts=2)
    assert len(tree.rows) == 2 + 3 + 9
    nodes = np.append(np.arange(14), 1)  # the last is a copy of the second splat
    bound = np.arange(15) + 3
    leaders, others = shared_ways(tree, nodes, bound, tree.centers, 20)
    ways = []
    for leader in leaders:
        way = [bound[leader]]
        while others[way[-1]] >= 0:
            way.append(others[way[-1]])
        ways.append(way)
    assert sorted(splat for way in ways for splat in way) == bound.tolist()
    for way in ways:
        assert len({tuple(tree.centers[nodes[splat - 3]]) for splat in way}) == 1
    # splat, its middle piece and that one's; the pieces at the sides and theirs; the other splat and its copy
    assert sorted(map(len, ways)) == [1] * 6 + [2] * 3 + [3]
    anchors = tree.centers.copy()
    anchors[tree.pieces[0]] += 1e-3
    leaders, others = shared_ways(tree, nodes, bound, anchors, 20)
    assert others[3] == -1 and len(leaders) == 12
    assert [len(each) for each in shared_ways(tree, nodes[:0], bound[:0], anchors, 20)] == [0, 20]


def test_an_edit_at_rest_after_one_that_moved(device):
    """Places that a pose does not write anew are those of rest, not of the pose before."""
    field = splats_in_box(device, count=60, scales=(-4.0, -2.0))
    left = Cage.box((-1, -1, -1), (0, 1, 1), segments=2)
    right = Cage.box((0, -1, -1), (1, 1, 1), segments=2)
    poses = [[left.twist(40), right], [left, right.twist(-30)], [left.twist(10), right.bend(20)]]
    for edits in ([left, right], [CageEdit(left), CageEdit(right, keep_source=True)]):
        used, *others = (Deformer(field, edits, coordinates="mean_value", resolution=24) for _ in range(4))
        for cages, other in zip(poses, others, strict=True):
            posed, fresh = (each.pose(cages).posed_splats() for each in (used, other))
            for name in ("centers", "covariances", "opacities", "turns"):
                np.testing.assert_array_equal(getattr(posed, name).numpy(), getattr(fresh, name).numpy())
