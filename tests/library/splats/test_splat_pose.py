"""Splats under posed cages: weighted sums, Jacobians, covariances, turns and opacities against float64."""

import numpy as np
import pytest
import warp as wp
from biharmonic_oracles import biharmonic_weights
from field_oracles import random_field
from oracles import green_weights, maximum_likelihood_weights, mean_value_weights
from refusals import refused
from scipy.spatial.transform import Rotation
from splat_scenes import covariances_of, drawn, one_splat, splats_in_box

import warpcage
from warpcage import Cage, CageEdit, Deformer
from warpcage.coordinate_kinds import COORDINATE_KINDS
from warpcage.coordinates import stretched_normals
from warpcage.core import launch
from warpcage.kernels.splats import pose
from warpcage.splats import CageBinding, fit_similarity

KINDS = ("harmonic", "mean_value", "green", "maximum_likelihood", "biharmonic")
BOX = Cage.box((-1, -1, -1), (1, 1, 1), segments=2)
ROOM = Cage.box((-1.6, -1.6, -1.6), (1.6, 1.6, 1.6), segments=2)
TURN = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix()
AFFINE = np.array([[1.2, 0.3, 0.0], [-0.1, 0.8, 0.2], [0.05, 0.0, 1.4]])


def weights_of(kind, points, cage):
    """(n, j) rows in float64: of vertices, then of faces that have weights, in sizes of the cage."""
    if kind == "mean_value":
        return mean_value_weights(points, cage.vertices, cage.faces).astype(np.float64)
    if kind == "maximum_likelihood":
        return maximum_likelihood_weights(points, cage.vertices, cage.faces)
    weigh = green_weights if kind == "green" else biharmonic_weights
    vertex, face = weigh(points, cage.vertices, cage.faces)
    return np.concatenate([vertex, face / cage.size], axis=1)


def forward_map(kind, points, rest, posed):
    """Where a posed cage takes points, from float64 weights."""
    rows = weights_of(kind, points, rest)
    moved = rows[:, : len(rest.vertices)] @ posed.vertices
    if COORDINATE_KINDS[kind].has_face_weights:
        moved = moved + rows[:, len(rest.vertices) :] @ (rest.size * stretched_normals(rest, posed))
    return moved


def test_rows_of_harmonic_coordinates(device):
    points = np.random.default_rng(2).uniform(-0.8, 0.8, (30, 3))
    rows = CageBinding(points, BOX, "harmonic", np.zeros(3), wp.get_device(device), 32, False).rows.numpy()
    np.testing.assert_allclose(rows[..., 0].T, warpcage.harmonic_coordinates(points, BOX, 32, device=device), atol=2e-5)
    # linear precision of weights and gradients
    np.testing.assert_allclose(rows[..., 0].T @ BOX.vertices, points, atol=1e-5)
    slopes = np.einsum("jna,jk->nka", rows[..., 1:].astype(np.float64), BOX.vertices) / BOX.size
    np.testing.assert_allclose(slopes, np.broadcast_to(np.eye(3), slopes.shape), atol=2e-4)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("way", ["forward", "backward"])
def test_affine_poses_are_exact(kind, way, device):
    """Centres, covariances and turns of rigid poses and of affine ones (with weights of faces: similarities)."""
    field = splats_in_box(device)
    deformer = Deformer(field, BOX, coordinates=kind, resolution=24, map=way)
    for matrix in (TURN, 1.3 * TURN if COORDINATE_KINDS[kind].has_face_weights else AFFINE):
        posed = deformer.pose(BOX.with_vertices(BOX.vertices @ matrix.T + [0.2, -0.1, 3.0])).posed_splats()
        rows, centers, covariances, opacities = drawn(deformer)
        np.testing.assert_array_equal(rows, np.arange(field.splat_count))
        expected = field.contents.centers.astype(np.float64) @ matrix.T + [0.2, -0.1, 3.0]
        np.testing.assert_allclose(centers, expected, atol=2e-6)
        expected = matrix @ field.covariances @ matrix.T
        scale = np.abs(expected).max(axis=(1, 2), keepdims=True)
        assert (np.abs(covariances - expected) / scale).max() < (1e-6 if way == "forward" else 2e-4)
        np.testing.assert_array_equal(opacities, field.splats.opacities.numpy())
        u, _, vt = np.linalg.svd(matrix)
        turns = Rotation.from_quat(posed.turns.numpy()).as_matrix()
        np.testing.assert_allclose(turns, np.broadcast_to(u @ vt, turns.shape), atol=2e-6 if way == "forward" else 2e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_rest_is_rest_to_the_bit(kind, device):
    field = splats_in_box(device, scales=(-5.0, -1.5))  # large ones, over the walls too
    deformer = Deformer(field, BOX, coordinates=kind, resolution=16)
    assert deformer.posed_splats() is field.splats
    deformer.pose(BOX.twist(30))
    assert deformer.posed_splats() is not field.splats
    assert deformer.pose(Cage(BOX.vertices, BOX.faces)).posed_splats() is field.splats
    assert deformer.baked() is field


@pytest.mark.parametrize("kind", ["mean_value", "green", "maximum_likelihood", "biharmonic"])
def test_a_twist_against_float64(kind, device):
    """Centres, and covariances by a Jacobian of differences, turns by SciPy's polar decomposition."""
    from scipy.linalg import polar

    field = splats_in_box(device, count=60, scales=(-6.0, -5.0))
    twisted = BOX.twist(70).with_vertices(1.2 * BOX.twist(70).vertices)
    deformer = Deformer(field, BOX, coordinates=kind).pose(twisted)
    points = field.contents.centers.astype(np.float64)
    rows, centers, covariances, _ = drawn(deformer)
    np.testing.assert_array_equal(rows, np.arange(60))
    np.testing.assert_allclose(centers, forward_map(kind, points, BOX, twisted), atol=3e-6)
    h = 1e-5
    columns = [
        (forward_map(kind, points + h * e, BOX, twisted) - forward_map(kind, points - h * e, BOX, twisted)) / (2 * h)
        for e in np.eye(3)
    ]
    jacobians = np.stack(columns, axis=-1)
    expected = jacobians @ field.covariances @ jacobians.transpose(0, 2, 1)
    scale = np.abs(expected).max(axis=(1, 2), keepdims=True)
    packed = wp.get_device(device).is_cuda  # gradients are half floats there
    assert (np.abs(covariances - expected) / scale).max() < (8e-4 if packed else 1e-4)
    turns = Rotation.from_quat(deformer.posed_splats().turns.numpy()).as_matrix()
    np.testing.assert_allclose(turns, [polar(j)[0] for j in jacobians], atol=5e-4 if packed else 1e-4)


def test_rotations_of_any_jacobian(device):
    """Ordinary, turned over, flat, tiny and zero: a rotation, and the nearest where there is one."""
    rng = np.random.default_rng(3)
    ordinary = rng.normal(size=(200, 3, 3)) * 10.0 ** rng.uniform(-6, 6, (200, 1, 1))
    flat = rng.normal(size=(20, 3, 3)) * [1.0, 1.0, 0.0]
    line = rng.normal(size=(20, 3, 1)) * rng.normal(size=(20, 1, 3))
    matrices = np.concatenate([ordinary, flat, line, np.zeros((1, 3, 3)), -np.eye(3)[None]]).astype(np.float32)
    count = len(matrices)
    carried = pose.CarriedSplats()
    carried.positions = wp.zeros(count, dtype=wp.vec3, device=device)
    carried.jacobians = wp.array(matrices, dtype=wp.mat33, device=device)
    carried.shares = wp.ones(count, dtype=float, device=device)
    rest = [wp.zeros((count, 6), dtype=float, device=device), wp.zeros(count, dtype=float, device=device)]
    turns = wp.empty(count, dtype=wp.quat, device=device)
    outputs = [wp.empty(count, dtype=wp.vec3, device=device), wp.empty((count, 6), dtype=float, device=device)]
    outputs += [wp.empty(count, dtype=float, device=device), turns]
    nothing = wp.empty(0, dtype=wp.uint8, device=device)
    launch(pose.finish_splats, count, [pose.LAW_RAYS, *rest, nothing, carried], outputs, device=device)
    quaternions = turns.numpy()
    np.testing.assert_allclose(np.linalg.norm(quaternions, axis=1), 1.0, atol=1e-5)
    found = Rotation.from_quat(quaternions).as_matrix()
    u, s, vt = np.linalg.svd(matrices.astype(np.float64))
    sign = np.linalg.det(u) * np.linalg.det(vt)
    nearest = (u * np.stack([np.ones(count), np.ones(count), sign], axis=1)[:, None]) @ vt
    # how near a rotation is: tr(R^T J), which the nearest has largest
    reached, best = (np.einsum("nij,nij->n", each, matrices.astype(np.float64)) for each in (found, nearest))
    assert ((best - reached) <= 2e-5 * s.sum(axis=1) + 1e-30).all()
    clear = (s[:, 1] + sign * s[:, 2] > 0.05 * s[:, 0]) & (np.arange(count) < 220)
    np.testing.assert_allclose(found[clear], nearest[clear], atol=2e-3)


def alpha_of_ray(center, covariance, opacity, origin, direction):
    """Opacity of a splat to a ray, the largest along it: 3DGS' in the limit of a far camera."""
    inverse = np.linalg.inv(covariance)
    off = origin - center
    t = -(off @ inverse @ direction) / (direction @ inverse @ direction)
    nearest = off + t * direction
    return opacity * np.exp(-0.5 * nearest @ inverse @ nearest)


@pytest.mark.parametrize("matrix", [np.diag([3.0, 1.0, 1.0]), 2.0 * np.eye(3), AFFINE])
def test_the_law_of_opacity(matrix, device):
    """density="opacity": a ray that goes along with the stretch meets the same opacity, whatever its direction.
    density="paper": the optical depth grows with the root mean square of the stretch."""
    field = one_splat(device, (0.1, 0.0, -0.1), (0.02, 0.01, 0.005), 0.6, quaternion=(1, 0.4, 0.2, 0))
    posed = BOX.with_vertices(BOX.vertices @ matrix.T)
    _, [center], [covariance], [opacity] = drawn(Deformer(field, BOX, coordinates="mean_value").pose(posed))
    rng = np.random.default_rng(4)
    for _ in range(20):
        origin, direction = field.contents.centers[0] + 0.01 * rng.normal(size=3), rng.normal(size=3)
        at_rest = alpha_of_ray(field.contents.centers[0], field.covariances[0], 0.6, origin, direction)
        gone_along = alpha_of_ray(center, covariance, opacity, matrix @ origin, matrix @ direction)
        assert gone_along == pytest.approx(at_rest, abs=2e-5)
    paper = Deformer(field, BOX, coordinates="mean_value", density="paper").pose(posed)
    stretch = np.sqrt(np.trace(matrix.T @ matrix) / 3.0)
    assert drawn(paper)[3][0] == pytest.approx(1.0 - 0.4**stretch, rel=1e-5)


def test_far_origins_keep_their_digits(device):
    near, shift = splats_in_box(device, count=30), np.array([3000.0, -2000.0, 500.0])
    held = near.contents
    centers = held.centers.astype(np.float64) + shift
    values = (held.log_scales, held.quaternions, held.logits, held.harmonics)
    far = warpcage.SplatField(centers, *values, device=device)
    cage = BOX.translate(shift)
    for kind in KINDS:
        one = drawn(Deformer(near, BOX, coordinates=kind, resolution=16).pose(BOX.twist(40)))
        moved = cage.with_vertices(BOX.twist(40).vertices + shift)
        two = drawn(Deformer(far, cage, coordinates=kind, resolution=16).pose(moved))
        np.testing.assert_allclose(two[1] - shift, one[1], atol=2e-5)


def test_bounds_reach_around_splats_and_posed_cages(device):
    field = splats_in_box(device, count=20, half=0.5)
    deformer = Deformer(field, BOX, coordinates="mean_value")
    reached = deformer.pose(BOX.translate((0, 0, 3))).reached_bounds
    np.testing.assert_allclose(reached[1, 2], BOX.bounds[1, 2] + 3)
    np.testing.assert_allclose(reached[0], np.minimum(field.bounds[0], BOX.bounds[0] + [0, 0, 3]))


def test_fit_similarity():
    rng = np.random.default_rng(5)
    points = rng.normal(size=(20, 3))
    matrix, offset = fit_similarity(points, points @ (1.7 * TURN).T + [1, 2, 3])
    np.testing.assert_allclose(matrix, 1.7 * TURN, atol=1e-12)
    np.testing.assert_allclose(offset, [1, 2, 3], atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_backward_splats_lie_where_voxels_are(kind, device):
    """Voxels under the same cage look the splats' places up where the splats were at rest."""
    field = splats_in_box(device, count=80, half=0.85)
    twisted = BOX.bend(50)
    deformer = Deformer(field, BOX, coordinates=kind, resolution=32, map="backward").pose(twisted)
    rows, centers, _covariances, _ = drawn(deformer)
    found = deformer.posed_edits().missed_count
    assert found <= 4
    looking = Deformer(random_field(device)[0], BOX, coordinates=kind, resolution=32).pose(twisted)
    back, _, region = looking.to_canonical(centers, np.ones_like(centers))
    error = np.linalg.norm(back - field.contents.centers[rows], axis=1)
    assert (region == 2).sum() >= len(rows) - found
    assert np.sort(error)[: len(rows) - found].max() < 2e-4
    # the forward map is another one
    forward = drawn(Deformer(field, BOX, coordinates=kind, resolution=32).pose(twisted))[1]
    assert np.abs(forward - centers).max() > 1e-3


@pytest.mark.parametrize(
    "options, said",
    [
        ({"coordinates": "cubic"}, "coordinates"),
        ({"density": "thick"}, "density"),
        ({"map": "sideways"}, "map must be one of forward, backward"),
        ({"store": "weights"}, "keep no lattice"),
        ({"resolution": 4}, "resolution"),
    ],
)
def test_options_that_do_not_fit(options, said):
    refused(lambda: Deformer(splats_in_box("cpu", count=3), BOX, **options), match=said)


def test_calls_that_do_not_fit():
    field = splats_in_box("cpu", count=3)
    with pytest.raises(ValueError, match="fragments are for voxels"):
        Deformer(field, CageEdit(BOX, fragments=0.1), coordinates="mean_value")
    deformer = Deformer(field, BOX, coordinates="mean_value")
    refused(lambda: deformer.to_canonical(np.zeros((1, 3)), np.ones((1, 3))), match="splats move forward")
    refused(lambda: deformer.pose(Cage.box((-1, -1, -1), (1, 1, 1))), match="vertices, the cage 26")
    refused(lambda: warpcage.bake(deformer, resolution=8), match="leave resolution and bounds out")
    refused(lambda: deformer.render(None), match="render needs a Camera, got NoneType")
    assert isinstance(deformer, Deformer) and covariances_of(field.splats).shape == (3, 3, 3)


@pytest.mark.parametrize("kind", KINDS)
def test_a_rigid_pose_is_what_the_counter_moved_camera_sees(kind, device):
    """With harmonics of degree 3, which turn along: 45 dB at least; unturned they are far off."""
    field = splats_in_box(device, count=300, scales=(-4.5, -2.8))
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = TURN, [0.2, -0.1, 0.4]
    camera = warpcage.Camera.look_at((0.5, 1.0, 4.0), (0, 0, 0), width=96, height=96)
    deformer = Deformer(field, ROOM, coordinates=kind, resolution=16)
    posed = deformer.pose(ROOM.with_vertices(ROOM.vertices @ TURN.T + motion[:3, 3]))
    seen, weak = (posed.render(camera, antialias=antialias).rgb for antialias in (False, True))
    lens = camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height
    counter = warpcage.Camera(*lens, np.linalg.inv(motion) @ camera.camera_to_world)
    expected = field.render(counter).rgb
    assert np.abs(expected - field.background).max() > 0.3
    assert warpcage.psnr(seen, expected) > 45.0
    assert warpcage.psnr(weak, field.render(counter, antialias=True).rgb) > 45.0 > warpcage.psnr(weak, expected)
    splats = posed.posed_splats()
    splats.turns = wp.empty(0, dtype=wp.quat, device=device)
    unturned = field.renderer.render(splats, camera, origin=field.center, near=field.near)
    assert warpcage.psnr(unturned.rgb, expected) < 35.0
