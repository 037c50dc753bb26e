"""Gradients of JAX through points and weights, beside central differences and the package's own functions."""

import numpy as np
import pytest
from fields import BOX, rotation, shiny_field, surrounded_ball, view
from refusals import refused
from splat_scenes import splats_in_box

import warpcage
from warpcage import Cage, Deformer
from warpcage.gradients import frame_gradient

jax = pytest.importorskip("jax", reason="JAX is not installed: pip install 'warpcage[jax]'")
from warpcage import jax as passing

CAGE = Cage.icosphere((0.2, -0.1, 0.3), 1.3, 1)
POSE = CAGE.twist(40)
STEP = 3e-3


def given(*others):
    """Points in the cage, and other arrays, as JAX takes them."""
    points = 0.2 + np.random.default_rng(1).uniform(-0.4, 0.4, (6, 3))
    return [jax.numpy.asarray(each, dtype="float32") for each in (points, *others)]


def check_differences(loss, arrays, share=2e-3):
    """Whether gradients under jit say how a loss changes, as each of its arrays moves at random."""
    random = np.random.default_rng(2)
    gradients = jax.jit(jax.grad(loss, argnums=tuple(range(len(arrays)))))(*arrays)
    plain = jax.jit(loss)
    for number, gradient in enumerate(gradients):
        along = random.normal(size=gradient.shape).astype(np.float32)
        ends = []
        for side in (STEP, -STEP):
            moved = [each + side * along if n == number else each for n, each in enumerate(arrays)]
            ends.append(float(plain(*moved)))
        products = np.asarray(gradient, float) * along
        assert abs(products.sum() - (ends[0] - ends[1]) / (2 * STEP)) < share * np.sqrt((products**2).sum())


@pytest.mark.parametrize("kind", ["mean_value", "green"])
def test_moved_points_pass_gradients_to_points_pose_and_cage(kind):
    arrays = given(POSE.vertices, CAGE.vertices)
    slopes = np.random.default_rng(3).normal(size=(6, 3)).astype(np.float32)

    def loss(points, pose, rest):
        return (slopes * passing.deform_points(2.0 * points - points, CAGE, pose, kind, rest_vertices=rest)).sum()

    expected = warpcage.deform_points(np.asarray(arrays[0]), CAGE, np.asarray(arrays[1]), kind)
    for pose in (arrays[1], POSE):
        np.testing.assert_allclose(passing.deform_points(arrays[0], CAGE, pose, kind), expected, atol=1e-6)
    check_differences(loss, arrays)


def test_harmonic_points_pass_gradients_to_the_pose():
    """They are linear in it: the gradient is that by the weights."""
    cage = Cage.box([-0.9, -0.8, -0.7], [0.9, 1.0, 1.1])
    points, pose = given(cage.twist(20).vertices)
    slopes = np.random.default_rng(3).normal(size=(6, 3)).astype(np.float32)
    found = jax.grad(lambda pose: (slopes * passing.deform_points(points, cage, pose, "harmonic")).sum())(pose)
    expected = warpcage.harmonic_coordinates(np.asarray(points), cage).T @ slopes
    assert np.linalg.norm(found - expected) < 5e-3 * np.linalg.norm(expected)


@pytest.mark.parametrize("name", ["mean_value_coordinates", "green_coordinates"])
def test_weights_pass_gradients_to_points_and_cage(name):
    arrays = given(CAGE.vertices)

    def weights(points, vertices):
        found = getattr(passing, name)(points, CAGE, vertices=vertices)
        return found if isinstance(found, tuple) else (found,)

    expected = getattr(warpcage, name)(np.asarray(arrays[0]), CAGE)
    expected = expected if isinstance(expected, tuple) else (expected,)
    random = np.random.default_rng(4)
    for found, plain in zip(weights(*arrays), expected, strict=True):
        np.testing.assert_allclose(found, plain, atol=1e-6)
    slopes = [random.normal(size=each.shape).astype(np.float32) for each in expected]
    check_differences(lambda *each: sum((a * b).sum() for a, b in zip(slopes, weights(*each), strict=True)), arrays)


def test_a_traced_function_is_called_again():
    """One trace, other values: a chain of two calls, and a loop of XLA around it."""
    points, pose = given(POSE.vertices)
    traced = []

    @jax.jit
    def twice(points, pose):
        traced.append(1)
        return jax.lax.fori_loop(0, 2, lambda _, x: passing.deform_points(x, CAGE, pose), points)

    for factor in (1.0, 1.1):
        moved = np.asarray(points)
        for _ in range(2):
            moved = warpcage.deform_points(moved, CAGE, np.asarray(factor * pose))
        np.testing.assert_allclose(twice(points, factor * pose), moved, atol=1e-5)
    assert len(traced) == 1


def test_mapped_functions_are_called_for_each():
    """`jax.vmap` over poses, over points, and over a gradient, beside one call after another."""
    points, poses = given(np.stack([POSE.vertices, CAGE.vertices * 1.1]))
    both = jax.numpy.stack([points, points + 0.1])
    for function, mapped in (
        (lambda pose: passing.deform_points(points, CAGE, pose), poses),
        (lambda rows: passing.deform_points(rows, CAGE, POSE), both),
        (lambda rows: passing.mean_value_coordinates(rows, CAGE), both),
        (jax.grad(lambda pose: (passing.deform_points(points, CAGE, pose) ** 2).sum()), poses),
    ):
        np.testing.assert_array_equal(jax.vmap(function)(mapped), np.stack([function(each) for each in mapped]))


def test_what_is_wrong_is_told_in_its_line(capfd):
    points, pose = given(POSE.vertices)
    refused(lambda: passing.deform_points(points, CAGE, "pose"), "vertices of a cage must be real numbers (n, 3)")
    refused(lambda: passing.deform_points(points + 1j, CAGE, pose), "points must be real numbers (n, 3)")
    with pytest.raises(ValueError, match=r"points must be \(n, 3\), got \(6, 2\)"):
        passing.deform_points(points[:, :2], CAGE, pose)
    with pytest.raises(ValueError, match="outside must be one of"):
        passing.deform_points(points, CAGE, pose, outside="away")
    with pytest.raises((ValueError, jax.errors.JaxRuntimeError), match="6 of 6 points are outside the cage"):
        passing.deform_points(points + 10, CAGE, pose, "green").block_until_ready()
    slopes = jax.grad(lambda points: warpcage.deform_points(points, CAGE, POSE).sum())
    with pytest.raises(ValueError, match="functions of warpcage.jax"):
        slopes(points)


def test_a_rigid_pose_turns_gradients_of_canonical_points():
    """phi(x) = R^T (x - t), so that slopes come back turned; points that are not moved pass them on."""
    turn, shift = rotation(35, 20), np.array([0.1, -0.05, 0.2])
    deformer = Deformer(shiny_field("cpu"), BOX, coordinates="mean_value", resolution=32, device="cpu")
    random = np.random.default_rng(5)
    points, directions, vertices, by_points, by_directions = (
        jax.numpy.asarray(each, dtype="float32")
        for each in (
            random.uniform(-0.45, 0.45, (300, 3)),
            random.normal(size=(300, 3)),
            BOX.vertices @ turn.T + shift,
            *random.normal(size=(2, 300, 3)),
        )
    )

    def loss(points, directions, vertices):
        canonical, along, region = passing.to_canonical(deformer, points, directions, vertices)
        return (canonical * by_points + along * by_directions).sum(), (canonical, along, region)

    gradients, found = jax.jit(jax.grad(loss, argnums=(0, 1, 2), has_aux=True))(points, directions, vertices)
    plain = deformer.posed(np.asarray(vertices)).to_canonical(np.asarray(points), np.asarray(directions))
    for one, other in zip(found, plain, strict=True):
        np.testing.assert_allclose(one, other, atol=2e-6)
    mapped = (plain[2] == 2)[:, None]
    assert 100 < mapped.sum() < 300
    length = np.linalg.norm(directions, axis=1, keepdims=True)
    unit, turned = directions / length, by_directions @ turn.T
    turned = (turned - (turned * unit).sum(axis=1, keepdims=True) * unit) / length
    np.testing.assert_allclose(gradients[0], np.where(mapped, by_points @ turn.T, by_points), atol=2e-3)
    np.testing.assert_allclose(gradients[1], np.where(mapped, turned, by_directions), atol=2e-3)
    np.testing.assert_allclose(gradients[2].sum(axis=0), -(mapped * (by_points @ turn.T)).sum(axis=0), atol=5e-2)
    refused(lambda: passing.to_canonical(deformer, points, directions[:4], vertices), "as many directions")


BENT = BOX.bend(30, axis="x", towards="z")
BACKGROUND = (0.2, 0.3, 0.4)


@pytest.fixture
def placed(device):
    """A device, which JAX's arrays are on too."""
    try:
        theirs = jax.devices("cpu" if device == "cpu" else "gpu")[0]
    except RuntimeError:
        pytest.skip("this JAX has no CUDA")
    with jax.default_device(theirs):
        yield device


def deformers(device):
    """Of voxels and of splats."""
    for field, kind in ((shiny_field(device), "mean_value"), (splats_in_box(device, 60), "green")):
        yield Deformer(field, BOX, coordinates=kind, resolution=32, device=device)


def test_frames_and_their_gradients_are_those_of_the_package(placed):
    camera, pose = view(size=24), jax.numpy.asarray(BENT.vertices, dtype="float32")
    random = np.random.default_rng(6)
    slopes = [random.normal(size=shape).astype(np.float32) for shape in ((24, 24, 3), (24, 24), (24, 24))]
    for deformer in deformers(placed):
        before = deformer.deformed
        draw = jax.jit(lambda pose, deformer=deformer: passing.render(deformer, camera, pose))
        found, back = jax.vjp(draw, pose)
        gradient = back(tuple(map(jax.numpy.asarray, slopes)))[0]
        assert deformer.deformed is before
        deformer.pose(np.asarray(pose))
        frame = deformer.render(camera)
        for name, part in zip(("rgb", "alpha", "depth"), found, strict=True):
            np.testing.assert_array_equal(part, getattr(frame, name))
        others = dict(zip(("alpha_gradient", "depth_gradient"), slopes[1:], strict=True))
        expected = frame_gradient(deformer, camera, slopes[0], by_vertices=True, **others).vertices.numpy()
        assert np.linalg.norm(gradient - expected) < 1e-4 * np.linalg.norm(expected)


def test_frames_pass_gradients_to_pose_and_camera(placed):
    """A loss of a frame, as its pose grows and its camera moves: differences to a few hundredths."""
    deformer = Deformer(shiny_field(placed), BOX, coordinates="mean_value", resolution=48, device=placed)
    camera, random = view(size=32), np.random.default_rng(7)
    slopes = random.normal(size=(32, 32, 3)).cumsum(axis=0).cumsum(axis=1).astype(np.float32) / 100

    @jax.jit
    def loss(vertices, change):
        drawn = passing.render(deformer, camera, vertices, camera_change=change, background=BACKGROUND)
        return (drawn[0] * slopes).sum() + (drawn[1] ** 2).sum()

    vertices = jax.numpy.asarray(BENT.vertices, dtype="float32")
    change = jax.numpy.asarray([0.3, -0.2, 0.25, 0.1, 0.05, -0.1, 0.1])
    gradients = jax.grad(loss, argnums=(0, 1))(vertices, change)
    directions = [(vertices - vertices.mean(axis=0), jax.numpy.zeros(7))]
    directions += [(jax.numpy.zeros_like(vertices), each) for each in jax.numpy.eye(7)]
    pairs = []
    for one, other in directions:
        ends = [float(loss(vertices + side * one, change + side * other)) for side in (2e-3, -2e-3)]
        along = (gradients[0] * one).sum() + (gradients[1] * other).sum()
        pairs.append((float(along), (ends[0] - ends[1]) / 4e-3))
    found, expected = np.array(pairs).T
    assert np.linalg.norm(found - expected) < 0.05 * np.linalg.norm(expected), (found, expected)
    with pytest.raises(ValueError, match="cannot be differentiated"):
        jax.grad(lambda pose: jax.grad(loss)(pose, change).sum())(vertices)


def test_frames_that_have_no_gradient_are_refused():
    field, camera = shiny_field("cpu"), view(size=8)
    deformer = Deformer(field, BOX, coordinates="mean_value", resolution=16, device="cpu")
    refused(lambda: passing.render(deformer, camera, BENT.vertices, camera_change=np.zeros(6)), "(7,)")
    refused(lambda: passing.render(deformer, camera, BENT.vertices[:5]), "the pose must be (26, 3)", "(5, 3)")
    refused(lambda: passing.render(deformer, camera, BENT.vertices, background=(1, 2)), "background")
    refused(lambda: passing.render(deformer, field, BENT.vertices), "a Camera, got VoxelField")
    around = Deformer(surrounded_ball("cpu"), BOX, coordinates="mean_value", resolution=16)
    refused(lambda: passing.render(around, camera, BENT.vertices), "surroundings", "colour")
    exact = Deformer(field, BOX, coordinates="mean_value", resolution=None, device="cpu")
    refused(lambda: passing.render(exact, camera, BENT.vertices), "one edit")
