"""Poses found again: from silhouettes and depths of ellipsoids by formula, from ray cast pictures, from landmarks."""

import dataclasses
import warnings

import numpy as np
import pytest
import warp as wp
from fields import BOX, ellipsoid, make_field, plain
from ground_truth import CarriedMesh, InverseMap, subdivided_model
from refusals import refused
from scipy.spatial.transform import Rotation

from warpcage import (
    Cage,
    CageEdit,
    Camera,
    Cancelled,
    Deformer,
    PoseTargets,
    Scene,
    deform_points,
    fit,
    fit_pose,
    fit_poses,
    mean_value_coordinates,
    turntable,
)
from warpcage.pose_fits.motions import LinearMotion, RigidMotion, smooth_basis
from warpcage.pose_fits.points import PULLED_RIGID, WEIGHT, PointLoss, PointPull, positions_of
from warpcage.pose_fits.priors import Priors
from warpcage.pose_fits.surface import depth_behind
from warpcage.pose_fits.targets import PictureLoss

RADII = np.array([0.55, 0.35, 0.25])
SEEN = RADII + 0.012  # about half a voxel of the field further out


def ball_field(device, resolution=40):
    """An ellipsoid with a sharp surface."""
    color = plain((0.8, 0.3, 0.2))
    inside = lambda x: 200.0 * (np.linalg.norm(x / RADII, axis=-1) < 1)  # noqa: E731
    return make_field(inside, color, device=device, resolution=resolution)


def cameras(count=4, size=32):
    return turntable((0, 0, 0), 2.6, 25, count, width=size, height=size)


def seen_ellipsoid(camera, linear, shift, finer=4):
    """Opacity and depth (h, w) of the ellipsoid after an affine map, by formula: shares of 16 rays a pixel that meet
    it, and the nearest place of that in the middle."""

    def roots(view):
        origins, directions = (
            part @ np.linalg.inv(linear).T / SEEN for part in (view.rays()[0] - shift, view.rays()[1])
        )
        a, b = (directions**2).sum(-1), (origins * directions).sum(-1)
        rest = b**2 - a * ((origins**2).sum(-1) - 1)
        return np.where(rest > 0, (-b - np.sqrt(np.maximum(rest, 0))) / a, np.inf)

    fine = np.isfinite(roots(camera.resized(finer * camera.width, finer * camera.height)))
    alpha = fine.reshape(camera.height, finer, camera.width, finer).mean(axis=(1, 3))
    return alpha.astype(np.float32), np.where(alpha == 1, roots(camera), np.inf)


def surface(count=2000):
    """Points on the ellipsoid at rest."""
    points = np.random.default_rng(0).normal(size=(count, 3))
    return RADII * points / np.linalg.norm(points, axis=1, keepdims=True)


def error(found, expected, coordinates="mean_value"):
    """RMS over the surface of where a pose takes it, as a share of the size."""
    moved = deform_points(surface(), BOX, found, coordinates)
    return np.sqrt(((moved - expected) ** 2).sum(axis=1).mean()) / BOX.size


AFFINE = Rotation.from_rotvec([0.1, -0.2, 0.25]).as_matrix() @ np.diag([1.2, 0.9, 1.05]), np.array([0.08, -0.05, 0.06])


def test_silhouettes_by_formula_give_a_shape(device):
    """Of an ellipsoid after an affine map; many such maps lead to the same shape, so that points are left open."""
    seen = cameras()
    alphas = np.stack([seen_ellipsoid(camera, *AFFINE)[0] for camera in seen])
    deformer = Deformer(ball_field(device, 72), BOX, resolution=16)
    found = fit_pose(deformer, PoseTargets(seen, alphas=alphas), parameters="affine", restarts=0)

    def off(pose):
        at_rest = (deform_points(surface(), BOX, pose, "mean_value") - AFFINE[1]) @ np.linalg.inv(AFFINE[0]).T
        return np.sqrt(((np.linalg.norm(at_rest / RADII, axis=1) - 1) ** 2).mean())

    assert off(BOX) > 0.2 and off(found.cage) < 0.05
    assert [step.parameters for step in found.history] == ["rigid", "affine", "affine", "affine"]
    assert [step.pixels for step in found.history] == [24, 24, 24, 32]


def test_depth_by_formula_gives_how_far_away_an_object_is(device):
    camera = cameras(1)[0]
    shift = 0.15 * (camera.center / np.linalg.norm(camera.center))
    depth = seen_ellipsoid(camera, np.eye(3), shift)[1]
    deformer = Deformer(ball_field(device, 72), BOX, resolution=16)
    found = fit_pose(deformer, PoseTargets([camera], depths=depth[None]), parameters="rigid", restarts=0)
    assert error(BOX, surface() + shift) > 0.09 and error(found.cage, surface() + shift) < 0.02


def test_depth_of_frames_lies_behind_the_surface_by_what_is_found(device):
    """Of an ellipsoid that absorbs 15 a unit, beside where rays meet it by formula."""
    inside = lambda x: 15.0 * (np.linalg.norm(x / RADII, axis=-1) < 1)  # noqa: E731
    field, off = make_field(inside, plain((0.8, 0.3, 0.2)), device=device, resolution=64), []
    for camera in cameras(3):
        origins, directions = (part / RADII for part in camera.rays())
        a, b = (directions**2).sum(-1), (origins * directions).sum(-1)
        root = b**2 - a * ((origins**2).sum(-1) - 1)
        frame = field.render(camera)
        seen = (root > 0) & (frame.alpha > 0.9)
        off.append(frame.depth[seen] - ((-b - np.sqrt(np.maximum(root, 0))) / a)[seen])
    middle = np.median(np.concatenate(off))
    assert middle == pytest.approx(1 / 15, rel=0.1) and depth_behind(field) == pytest.approx(middle, rel=0.12)


@pytest.fixture(scope="module")
def chair():
    """A chair as a mesh, a cage around it, and a field fitted to ray cast pictures of it."""
    mesh = CarriedMesh(*subdivided_model("chair", 0.25), device="cpu")
    low, high = mesh.vertices.min(axis=0) - 0.05, mesh.vertices.max(axis=0) + 0.05
    views = around(low, high, 24)
    field = fit(pictures(mesh, views), device="cpu", quality="fast", epochs=2.0, progress=False)
    return mesh, Cage.box(low, high, segments=2), field


def around(low, high, count, size=40):
    return turntable(
        (low + high) / 2, 1.9 * np.linalg.norm(high - low), 25, count, width=size, height=size, fov_degrees=36
    )


def pictures(mesh, views, **pose):
    """A Scene of a mesh before white, without opacity."""
    rgba, _ = mesh.render(views, samples=2, **pose)
    return Scene(rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:], None, views)


def test_a_bend_is_found_in_ray_cast_pictures(chair):
    """Of the model itself, whose vertices are posed in float64: from the cage at rest, by all of its vertices."""
    mesh, cage, field = chair
    truth = cage.bend(25, axis="z", towards="y").rotate(20, axis="z")
    posed = InverseMap(cage, truth, "mean_value", device="cpu").invert(mesh.vertices)
    views = around(*cage.bounds, 8)
    targets = pictures(mesh, views, posed=posed.points, view_matrices=posed.jacobians)
    deformer = Deformer(field, cage, coordinates="mean_value", resolution=20)
    found = fit_pose(deformer, targets, restarts=4)
    assert deformer.deformed is None  # the caller's keeps its pose

    def off(pose):
        points = InverseMap(cage, pose, "mean_value", device="cpu").invert(mesh.vertices).points
        return np.sqrt(((points - posed.points) ** 2).sum(axis=1).mean()) / cage.size

    assert off(cage) > 0.06 and off(found.cage) < 0.01
    assert {step.parameters for step in found.history} == {"start", "rigid", "affine", "handles", "vertices"}


def marks(pose, count=24, seed=1):
    """Places at rest, and where a pose takes them."""
    points = 0.8 * RADII * np.random.default_rng(seed).uniform(-1, 1, (count, 3))
    return points, deform_points(points, BOX, pose, "mean_value")


@pytest.mark.parametrize("coordinates", ["harmonic", "mean_value"])
def test_points_lie_where_frames_show_them(coordinates, device):
    """`positions_of` is the inverse of the map that frames are looked up by."""
    deformer = Deformer(ball_field(device), BOX, coordinates=coordinates, resolution=32)
    deformer.pose(BOX.bend(40, axis="x", towards="z"))
    points, guess = marks(deformer.deformed[0])
    places = positions_of(deformer, points, guess)
    canonical, _, region = deformer.to_canonical(places, np.broadcast_to([0.0, 0, 1], places.shape))
    assert (region == 2).all() and np.abs(canonical - points).max() < 1e-3
    assert np.abs(places - guess).max() > 2e-3  # which is another map


def test_points_in_space_give_an_affine_pose(device):
    points, _ = marks(BOX, 40)
    positions = points @ AFFINE[0].T + AFFINE[1]
    positions[3] = np.nan
    deformer = Deformer(ball_field(device), BOX, resolution=16)
    found = fit_pose(deformer, PoseTargets(points=points, positions=positions), regularize=0)
    assert error(found.cage, surface() @ AFFINE[0].T + AFFINE[1]) < 2e-3
    assert found.history[0].pixels == 0


def test_landmarks_in_pictures_give_a_rigid_pose(device):
    turn, shift = Rotation.from_rotvec([0.3, -0.4, 0.5]).as_matrix(), np.array([0.1, 0.05, -0.08])
    points, _ = marks(BOX, 12)
    seen = cameras(2)
    pixels = np.stack([camera.project(points @ turn.T + shift)[0] for camera in seen])
    pixels[0, 4] = np.nan
    found = fit_pose(
        Deformer(ball_field(device), BOX, resolution=16),
        PoseTargets(seen, points=points, pixels=pixels),
        parameters="rigid",
    )
    assert error(found.cage, surface() @ turn.T + shift) < 2e-3


def test_a_basis_moves_what_it_names(device):
    """Shares of two vectors, and displacements times a number, find the numbers that moved them."""
    ends = np.column_stack([BOX.vertices[:, 0] < 0, BOX.vertices[:, 0] > 0]).astype(float)
    shapes = np.stack(
        [BOX.bend(20, axis="x", towards="z").vertices - BOX.vertices, BOX.stretch(1.3).vertices - BOX.vertices]
    )
    for basis, truth in (
        (ends, BOX.vertices + ends @ [[0.1, 0, 0.05], [-0.1, 0.05, 0]]),
        (shapes, BOX.vertices + np.tensordot([0.8, -0.3], shapes, 1)),
    ):
        points, positions = marks(BOX.with_vertices(truth))
        deformer = Deformer(ball_field(device), BOX, coordinates="mean_value", resolution=32)
        settled = positions_of(deformer.pose(truth), points, positions)
        found = fit_pose(deformer, PoseTargets(points=points, positions=settled), parameters=basis, regularize=0)
        assert np.abs(found.cage.vertices - truth).max() < 4e-3 * BOX.size


def test_a_sequence_does_not_drift(device):
    """Poses of a swing from points, each begun with the one before; the last is no worse than the first."""
    deformer = Deformer(ball_field(device), BOX, coordinates="mean_value", resolution=16)
    poses = [BOX.rotate(degrees, axis="z") for degrees in (10, 20, 30, 40, 50)]
    moments = [PoseTargets(points=points, positions=places) for points, places in (marks(pose) for pose in poses)]
    times = [0.0, 0.1, 0.3, 0.4, 0.5]
    file = fit_poses(deformer, moments, times=times, parameters="affine")
    assert list(file.times.values()) == times and file.names[:2] == ("0000", "0001")
    off = [error(file[name], deform_points(surface(), BOX, pose)) for name, pose in zip(file, poses, strict=True)]
    assert max(off) < 3e-3
    assert fit_poses(deformer, moments[:2]).times["0001"] == pytest.approx(1 / 24)


def test_uncertainty_is_about_the_error_that_noise_makes(device):
    """And grows with distance from the points that are known."""
    deformer = Deformer(ball_field(device), BOX, coordinates="mean_value", resolution=16)
    points = np.random.default_rng(4).uniform(-0.98, 0.98, (600, 3))
    points[np.arange(600), np.arange(600) % 3] = 0.98 * np.sign(points[np.arange(600), np.arange(600) % 3])
    points *= BOX.bounds[1]  # near the walls, where they say most of the vertices
    noise = 0.01 * np.random.default_rng(5).normal(size=points.shape)
    options = {"parameters": "handles", "regularize": 1e-3, "uncertainty": True}
    found = fit_pose(deformer, PoseTargets(points=points, positions=points + noise), **options)
    off = np.linalg.norm(found.cage.vertices - BOX.vertices, axis=1)
    assert 0.5 < np.sqrt((off**2).mean() / (found.uncertainty**2).mean()) < 2
    half = points[points[:, 0] < 0]
    found = fit_pose(deformer, PoseTargets(points=half, positions=half + noise[: len(half)]), **options)
    left, right = (found.uncertainty[BOX.vertices[:, 0] * sign > 0.5].mean() for sign in (-1, 1))
    assert right > 2 * left


def differences(loss, numbers, h=1e-5):
    """Gradient of a loss by central differences."""
    changes = h * np.eye(len(numbers))
    return np.array([(loss(numbers + change) - loss(numbers - change)) / (2 * h) for change in changes])


@pytest.mark.parametrize(
    "weights",
    [{"rigid": 1.0}, {"rigid": 0, "volume": 2.0}, {"rigid": 0, "symmetry": 2.0}, {"rigid": 0, "start": 3.0}],
    ids=str,
)
def test_gradients_of_priors_are_differences(weights):
    priors = Priors(BOX, BOX.rotate(10).vertices, weights)
    posed = BOX.bend(40, axis="x", towards="z").twist(15).vertices
    value, gradient = priors(posed)
    expected = differences(lambda numbers: priors(numbers.reshape(-1, 3))[0], posed.ravel())
    np.testing.assert_allclose(gradient.ravel(), expected, atol=1e-6 * max(1, np.abs(expected).max()))
    assert value > 1e-4 and priors(BOX.vertices)[0] < value


def test_what_is_symmetric_in_any_place_is_free_of_the_prior_of_symmetry():
    """One that bends in the mirror's plane is, one that bends out of it is not; nor has a skew cage a mirror."""
    cage = Cage.box([-0.5, -0.3, -0.8], [0.5, 0.3, 0.8], segments=3)
    free = cage.bend(40, axis="z", towards="y").rotate(30, axis="y").translate([1, 2, 3])  # x to -x
    prior = Priors(cage, cage.vertices, {"rigid": 0, "symmetry": 1.0})
    assert prior(free.vertices)[0] < 1e-12 < 1e-5 < prior(cage.bend(40, axis="z", towards="x").vertices)[0]
    skew = cage.with_vertices(cage.vertices + [[0.1, 0.2, 0.3]] * (cage.vertices[:, :1] > 0.4))
    refused(lambda: Priors(skew, skew.vertices, {"symmetry": 1.0}), "symmetry", "mirror image")


def test_symmetry_finds_what_one_side_does_not_show():
    """Points of one half of a symmetric pose give the other half."""
    cage = Cage.box([-0.5, -0.3, -0.8], [0.5, 0.3, 0.8], segments=3)
    pose = cage.bend(50, axis="z", towards="y")
    points = np.random.default_rng(0).uniform([0.1, -0.2, -0.6], [0.4, 0.2, 0.6], (60, 3))
    where = deform_points(points, cage, pose, "harmonic")
    deformer = Deformer(ball_field("cpu"), cage, resolution=24)
    off = {}
    for weight in (0.0, 10.0):
        targets = PoseTargets(points=points, positions=where)
        found = fit_pose(deformer, targets, regularize={"rigid": 0.05, "symmetry": weight}).cage
        other = cage.vertices[:, 0] < -0.1
        off[weight] = np.sqrt(((found.vertices - pose.vertices)[other] ** 2).sum(axis=1).mean()) / cage.size
    assert off[10.0] < 0.5 * off[0.0] and off[10.0] < 0.05


def test_rigid_poses_are_free_of_the_prior():
    value, gradient = Priors(BOX, BOX.vertices, 1.0)(BOX.rotate(70, axis="x").translate([1, 2, 3]).vertices)
    assert value < 1e-12 and np.abs(gradient).max() < 1e-6


@pytest.mark.parametrize("name", ["rigid", "smooth"])
def test_gradients_of_motions_are_differences(name):
    random = np.random.default_rng(0)
    start, slopes = BOX.twist(20).vertices, random.normal(size=BOX.vertices.shape)
    motion = RigidMotion(start, BOX.size) if name == "rigid" else LinearMotion(start, smooth_basis(BOX, 5))
    np.testing.assert_allclose(motion.vertices(np.zeros(motion.count)), start)
    for numbers in (np.zeros(motion.count), random.normal(size=motion.count)):
        expected = differences(lambda numbers: (motion.vertices(numbers) * slopes).sum(), numbers)
        np.testing.assert_allclose(motion.pulled(numbers, slopes), expected, atol=1e-6)


def test_gradients_of_points_are_differences():
    random, seen = np.random.default_rng(0), cameras(2)
    points, places = marks(BOX.bend(30, axis="x", towards="z"), 6)
    pixels = np.stack([camera.project(places)[0] for camera in seen]) + random.normal(size=(2, 6, 2))
    positions = places + 0.05 * random.normal(size=places.shape)
    positions[2], pixels[1, 3] = np.nan, np.nan
    loss = PointLoss(PoseTargets(seen, points=points, positions=positions, pixels=pixels), BOX, "cpu")
    expected = differences(lambda numbers: loss(numbers.reshape(-1, 3))[0], BOX.vertices.ravel())
    np.testing.assert_allclose(loss(BOX.vertices)[1].ravel(), expected, atol=1e-6 * np.abs(expected).max())


def pulled_points(count=4):
    """A cage, as it counts as rigid, and points of it with where they are to go."""
    rest = Cage.cylinder((0, 0, 0), 0.3, 2.0, rings=5)
    points = np.array([[0, 0.15, -0.8], [0.1, 0, -0.5], [0, 0.1, 0], [0, 0.1, 0.8]])[:count]
    places = points + np.array([[0, 0, 0], [0, 0, 0], [0, 0, 0], [0.3, 0, -0.1]])[:count]
    return rest, rest.twist(20).vertices, points, places


def test_pulled_vertices_are_a_minimum_of_points_and_the_rigid_prior():
    rest, before, points, _ = pulled_points()
    pull = PointPull(rest, before, points, "cpu")
    shares = np.asarray(mean_value_coordinates(points, rest, device="cpu"), np.float64)
    places = shares @ before + np.array([[0, 0, 0], [0, 0, 0], [0, 0, 0], [0.3, 0, -0.1]])
    found = pull(before, places, 3000)
    rigid = Priors(rest.with_vertices(before), before, PULLED_RIGID)

    def loss(vertices):
        off = (shares @ vertices - places) / rest.size
        return WEIGHT / len(points) * (off**2).sum() + rigid(vertices)[0]

    assert np.abs(shares @ found - places).max() < 2e-3 * rest.size
    rng, least, step = np.random.default_rng(0), loss(found), 1e-4 * rest.size
    ways = step * rng.normal(size=(30, *found.shape))
    slopes = [(loss(found + way) - loss(found - way)) / 2 for way in ways]
    bends = [loss(found + way) + loss(found - way) - 2 * least for way in ways]
    assert min(bends) > 0 and np.abs(slopes).max() < 0.02 * min(bends)  # flat there, and higher all around
    live = before
    for share in np.linspace(0, 1, 21)[1:]:  # in steps, as a pointer goes
        live = pull(live, (1 - share) * (shares @ before) + share * places, 5)
    assert loss(live) < 1.05 * least < loss(before)


def test_one_pulled_point_takes_all_along_and_three_turn_it():
    rest, before, points, _ = pulled_points(1)
    one = PointPull(rest, before, points, "cpu")
    away = np.array([0.4, -0.2, 0.1])
    shares = np.asarray(mean_value_coordinates(points, rest, device="cpu"), np.float64)
    np.testing.assert_allclose(one(before, shares @ before + away, 5), before + away, atol=1e-6)

    rest, _, points, _ = pulled_points(4)
    turn = Rotation.from_rotvec([0.2, 0.5, -0.3]).as_matrix().T
    moved = PointPull(rest, rest.vertices, points, "cpu")(rest.vertices, points @ turn + away, 2000)
    np.testing.assert_allclose(moved, rest.vertices @ turn + away, atol=1e-3 * rest.size)


def test_pulled_vertices_are_those_that_a_fit_finds(device):
    rest, _, points, places = pulled_points()
    field = make_field(lambda x: np.zeros(x.shape[:-1]), plain((1, 1, 1)), device=device, resolution=8)
    targets = PoseTargets(points=points, positions=places)
    deformer = Deformer(field, rest, coordinates="mean_value", resolution=None)
    loss = PointLoss(targets, rest, device)
    found = fit_pose(deformer, targets, regularize=PULLED_RIGID).cage.vertices
    live = PointPull(rest, rest.vertices, points, device)(rest.vertices, places, 200)
    prior = Priors(rest, rest.vertices, PULLED_RIGID)
    assert loss(live)[0] + prior(live)[0] < 1.02 * (loss(found)[0] + prior(found)[0])


def test_gradients_of_pictures_are_differences(device):
    """Of the whole loss of colours, opacities and depths in smaller, blurred pictures, along smooth motions."""
    deformer = Deformer(
        make_field(lambda x: ellipsoid(x, sigma=6.0), plain((0.8, 0.3, 0.2)), device=device), BOX, resolution=24
    )
    seen = cameras(2, 48)
    frames = [deformer.posed(BOX.rotate(8).translate([0.03, 0, 0.02])).render(camera) for camera in seen]
    parts = {name: np.stack([getattr(frame, name) for frame in frames]) for name in ("alpha", "depth")}
    targets = PoseTargets(seen, images=[frame.rgb for frame in frames], alphas=parts["alpha"], depths=parts["depth"])
    loss = PictureLoss(targets, 32, 1.0, BOX.size, deformer.device)

    def value(vertices):
        return loss(deformer.pose(vertices), with_gradient=False)[0]

    gradient = loss(deformer.pose(BOX.vertices))[1]
    changes = np.einsum("vk,ki->kvi", smooth_basis(BOX, 4), np.random.default_rng(1).normal(size=(4, 3)))
    found = [(gradient * change).sum() for change in changes]
    steps = (2.5e-4, 5e-4)  # depths come and go at rims: larger steps cross more of them
    expected = [
        np.mean([(value(BOX.vertices + h * change) - value(BOX.vertices - h * change)) / (2 * h) for h in steps])
        for change in changes
    ]
    assert np.linalg.norm(np.subtract(found, expected)) < 0.03 * np.linalg.norm(expected)


def test_smaller_pictures_are_means():
    images = np.random.default_rng(0).random((1, 6, 9, 3)).astype(np.float32)
    camera = Camera.look_at((3, 0, 0), (0, 0, 0), width=9, height=6, fov_degrees=40)
    loss = PictureLoss(PoseTargets([camera], images=images), 3, 0.0, 1.0, wp.get_device("cpu"))
    np.testing.assert_allclose(loss.images, images.reshape(1, 2, 3, 3, 3, 3).mean(axis=(2, 4)), atol=1e-6)
    assert (loss.cameras[0].width, loss.cameras[0].height) == (3, 2)


def test_a_fit_can_be_cancelled(device):
    seen = cameras(1, 8)
    targets = PoseTargets(seen, alphas=np.zeros((1, 8, 8)))
    refused(
        lambda: fit_pose(Deformer(ball_field(device), BOX, resolution=16), targets, progress=lambda *_: False),
        "fit pose was cancelled",
        error=Cancelled,
    )


def test_what_is_no_target_is_refused():
    seen, points = cameras(1, 8), np.zeros((2, 3))
    image = np.zeros((1, 8, 8, 3))
    for arguments, message in (
        ({}, "a pose needs pictures, masks, depth or points"),
        ({"images": image}, "one camera per picture: 1 pictures, 0 cameras"),
        ({"cameras": seen, "images": image[..., :2]}, "images of a pose must be (n, h, w, 3) or (n, h, w, 4)"),
        ({"cameras": seen, "images": np.zeros((1, 8, 8, 3), np.uint8)}, "divide 8-bit ones by 255"),
        ({"cameras": seen, "images": image * np.nan}, "images of a pose must be finite"),
        ({"cameras": seen, "images": image[:, :7]}, "camera 0 is of 8x8 pixels, its picture of 8x7"),
        ({"cameras": seen, "images": image, "depths": np.ones((1, 7, 8))}, "depths of a pose must be (1, 8, 8)"),
        ({"cameras": seen, "weights": image[..., 0]}, "weights alone say nothing"),
        ({"cameras": seen, "images": image, "weights": image[..., 0]}, "weights of a pose are 0 in all pixels"),
        ({"positions": points}, "need points, the same places at rest"),
        ({"points": points}, "points of a pose need positions, or pixels"),
        ({"points": points, "positions": points[:1]}, "positions of a pose must be (2, 3), got (1, 3)"),
        ({"points": points * np.nan, "positions": points}, "points of a pose must be finite"),
        ({"points": points[0], "positions": points[0]}, "points of a pose must be (p, 3), got (3,)"),
        ({"points": points, "positions": points * np.nan}, "known for none of its points"),
        ({"points": points, "pixels": points[None, :, :2]}, "pixels of a pose need cameras"),
        ({"cameras": np.eye(4), "images": image}, "cameras of a pose must be a list, got ndarray"),
        ({"cameras": [np.eye(4)], "images": image}, "must each be a Camera, got ndarray"),
        ({"cameras": seen * 2, "images": [image[0], image[0, :7]]}, "images of a pose must be real numbers"),
        ({"images": image[:0]}, "hold no pixels"),
        ({"cameras": seen, "images": image + 255.0}, "in [0, 1], got 255 to 255: divide 8-bit ones by 255"),
        ({"cameras": seen, "images": image, "weights": image[..., 0] - 0.5}, "weights of a pose must be finite, in"),
        ({"cameras": seen, "depths": image[..., 0] - 2}, "depths of a pose must be distances"),
        ({"cameras": seen, "depths": image[..., 0] * np.nan}, "known nowhere"),
    ):
        refused(lambda arguments=arguments: PoseTargets(**arguments), message)


def test_what_cannot_be_fitted_is_refused():
    deformer = Deformer(ball_field("cpu"), BOX, resolution=16)
    targets = PoseTargets(points=np.zeros((1, 3)), positions=np.zeros((1, 3)))
    for arguments, message in (
        ({"parameters": "all"}, "parameters must be"),
        ({"parameters": np.zeros((3, 2))}, "must be a name or finite numbers (26, k) or (k, 26, 3), got (3, 2)"),
        ({"regularize": {"smooth": 1}}, "a prior of regularize"),
        ({"regularize": -1}, "regularize rigid"),
        ({"start": Cage.box([0, 0, 0], [1, 1, 1])}, "8 vertices, the cage 26"),
        ({"restarts": -1}, "restarts"),
        ({"cameras": cameras(1)}, "PoseTargets has its own"),
        ({"parameters": np.zeros((26, 2))}, "basis of zeros, which moves nothing"),
        ({"start": [BOX]}, "the start of a fit must be a Cage or"),
    ):
        refused(lambda arguments=arguments: fit_pose(deformer, targets, **arguments), message)
    refused(lambda: fit_pose(deformer, np.zeros((1, 8, 8, 3))), "need cameras, one each: got ndarray")
    refused(lambda: fit_pose(deformer, "bent"), "load_scene reads one", "got str")
    for edits, what in (([BOX, BOX], "is of 2 edits"), ([CageEdit(BOX, remove=True)], "is of an edit that removes")):
        refused(lambda edits=edits: fit_pose(Deformer(deformer.field, edits, resolution=16), targets), what)
    refused(lambda: fit_pose(BOX, targets), "fit_pose needs a Deformer, got", error=(TypeError, ValueError))
    refused(lambda: fit_poses(deformer, [targets], times=[0, 1]), "times of poses must increase")
    refused(lambda: fit_poses(deformer, [targets], times=[np.inf]), "times of poses must increase")
    refused(lambda: fit_poses(deformer, [targets, 3]), "moment 1")
    refused(lambda: fit_poses(deformer, targets), "must be a list, one for each moment, got PoseTargets")
    refused(lambda: fit_poses(deformer, [None]), "targets of some moment")
    refused(lambda: fit_poses(deformer, [targets], uncertainty=True), "a sequence has no uncertainty")


def test_what_no_picture_shows_is_refused(device):
    """A cage behind the cameras, black pictures whose exposures are found, points beside the cage, and a falloff."""
    deformer, seen = Deformer(ball_field(device), BOX, resolution=16), cameras(2, 8)
    alphas, images = np.ones((2, 8, 8)), np.stack([np.full((8, 8, 3), 0.5), np.zeros((8, 8, 3))])
    away = [dataclasses.replace(camera, camera_to_world=camera.camera_to_world @ BACK) for camera in seen]
    refused(lambda: fit_pose(deformer, PoseTargets(away, alphas=alphas)), "no picture shows the cage where")
    refused(lambda: fit_pose(deformer, images, cameras=seen, exposure=True), "picture 1 is black")
    beside = PoseTargets(points=[[0, 0, 0], [9, 0, 0]], positions=np.zeros((2, 3)))
    refused(lambda: fit_pose(deformer, beside), "point 1 of a pose lies outside of the cage")
    half = CageEdit(Cage.box([-0.7, -0.5, -0.5], [0, 0.5, 0.5]), falloff=0.1)
    torn = Deformer(deformer.field, half, resolution=16)
    refused(lambda: fit_pose(torn, PoseTargets(seen, alphas=alphas)), "without falloff and fragments")


BACK = np.diag([-1.0, 1.0, -1.0, 1.0])


def test_what_does_not_match_is_said(device):
    """Of cameras ten times as far away, of depths in millimetres, and of pictures that show nothing; not of what is
    found."""
    deformer, seen = Deformer(ball_field(device), BOX, resolution=16), cameras(2, 16)
    shown = [seen_ellipsoid(camera, np.eye(3), 0) for camera in seen]
    alphas, depths = np.stack([alpha for alpha, _ in shown]), np.stack([depth for _, depth in shown])
    far = [dataclasses.replace(each, camera_to_world=each.camera_to_world * FURTHER) for each in seen]
    for targets, message in (
        (PoseTargets(far, alphas=alphas), "without the object"),
        (PoseTargets(seen, alphas=alphas, depths=1000 * depths), "depths differ by .* times"),
        (PoseTargets(seen, alphas=0 * alphas), "are the cameras, depths"),
        (PoseTargets(seen, alphas=0 * alphas + 1), "where less than 0.02 is usual"),
    ):
        with pytest.warns(UserWarning, match=message):
            fit_pose(deformer, targets, parameters="rigid", restarts=0)
    moments = [PoseTargets(seen, alphas=alphas), PoseTargets(far, alphas=alphas)]
    with pytest.warns(UserWarning, match="moment 1: the pose that was found"):
        fit_poses(deformer, moments, parameters="rigid", restarts=0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit_pose(deformer, PoseTargets(seen, alphas=alphas, depths=depths), parameters="rigid", restarts=0)


FURTHER = np.array([[1.0, 1.0, 1.0, 10.0]] * 3 + [[1.0] * 4])


def test_pictures_of_several_sizes_of_a_field_of_four_rays_in_another_world(device):
    """A scene whose second picture is smaller, in the world of its files; the field was turned, and takes four rays."""
    field, seen, turn = ball_field(device), cameras(3, 24), np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0.3, 0.2, -0.4]).as_matrix()
    field.straightening, field.supersampling, shift = turn, 2, np.array([0.08, -0.05, 0.06])
    alphas = np.stack([seen_ellipsoid(camera, np.eye(3), shift)[0] for camera in seen])
    weights = np.ones_like(alphas)
    weights[1, 17:], alphas[1, 17:] = 0, 1  # beyond the picture
    seen[1] = dataclasses.replace(seen[1], height=17)
    moved = [camera.moved(np.linalg.inv(turn)) for camera in seen]
    images = np.repeat(1 - alphas[..., None], 3, axis=3)
    scene = Scene(images, alphas, moved, weights=weights)
    assert scene.has_sizes
    found = fit_pose(Deformer(field, BOX, resolution=16), scene, parameters="rigid", restarts=0)
    assert error(found.cage, surface() + shift) < 0.02


def test_a_moment_without_targets_gets_no_key(device):
    deformer, points = Deformer(ball_field(device), BOX, resolution=16), surface(8)
    moments = [PoseTargets(points=points, positions=points + [0.01 * k, 0, 0]) for k in range(3)]
    poses = fit_poses(deformer, [moments[0], None, moments[2]], times=[0.0, 0.1, 0.3], parameters="rigid")
    assert poses.names == ("0000", "0002") and poses.times == {"0000": 0.0, "0002": 0.3}
