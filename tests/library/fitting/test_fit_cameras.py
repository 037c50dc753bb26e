"""What refined cameras follow from: slopes of rays against finite differences, steps, exposures and alignments."""

import field_oracles as oracle
import numpy as np
import pytest
import warp as wp
from fit_oracles import moved_camera, photometric_gradient, poses_of, training_rays, two_cameras
from scipy.spatial.transform import Rotation

import warpcage
from warpcage.fitting import CameraSums
from warpcage.fitting import cameras as steps
from warpcage.kernels.fitting import cameras as camera_kernels
from warpcage.view import (
    Similarity,
    aligning_similarity,
    framing_orbit,
    moved_along,
    picture_shifts,
    picture_similarity,
    pose_errors,
)

STEP = 1e-5


def changed_camera(camera, number, change, reach):
    """The camera with one of its seven numbers larger: turns about its axes, shifts along them, log of focal length."""
    turn, shift, zoom = np.split(change * np.eye(7)[number], [3, 6])
    return moved_camera(camera, turn, reach * shift, zoom[0])


def rendered(field, density, sh, camera, behind):
    """(h, w, 3) float64 of the field in front of `behind`, a function of rays."""
    origins, directions = camera.rays()
    picture = np.zeros(origins.shape)
    for place in np.ndindex(*origins.shape[:2]):
        back = behind(origins[place], directions[place])
        ray = origins[place], directions[place], field.step, back
        picture[place] = oracle.render_ray(field, density, sh, *ray, length=6.0)[0]
    return picture


def slopes_of(field, rays, count, device, *, behind=None, front=None, reach=1.0, background=(0.3, 0.6, 0.1)):
    """Records (count, 11, 3) of a batch."""
    records = wp.zeros((count, 11), dtype=wp.vec3, device=device)
    around = [
        wp.zeros((0, 0), dtype=kind, device=device) if held is None else wp.array(held, dtype=kind, device=device)
        for held, kind in ((behind, wp.vec3), (front, wp.vec4))
    ]
    inputs = [0, field.grid, rays, wp.vec3(*background), 0, 5, field.step, 0.0, reach, *around, 1.0]
    wp.launch(camera_kernels.measure_camera_slopes, dim=count, device=device, inputs=inputs, outputs=[records])
    return records.numpy()


def tile_order(height, width, size=2):
    """Rows and columns of pixels, tile after tile."""
    rows, columns = np.mgrid[:height, :width]
    cells = (height // size, size, width // size, size)
    return tuple(part.reshape(cells).transpose(0, 2, 1, 3).ravel() for part in (rows, columns))


def sky(origin, direction):
    return 0.5 + 0.3 * np.sin(3 * direction + origin)


def mist(origin, direction):
    """Colour before the field, and the light that passes."""
    return np.append(0.1 + 0.1 * np.cos(2 * direction - origin), 0.7 + 0.1 * np.sin(direction @ [1, 2, 3]))


def seen_around(function, camera, reach, order):
    """(8, rays) of a function of rays: as it is, and what is larger with each of a camera's numbers larger by 1."""

    def at(view):
        return np.array([function(*ray) for ray in zip(*(part[order] for part in view.rays()), strict=True)])

    changes = [[at(changed_camera(camera, number, sign * STEP, reach)) for sign in (1, -1)] for number in range(7)]
    return np.stack([at(camera)] + [at(camera) + (more - less) / (2 * STEP) for more, less in changes])


@pytest.mark.parametrize("numbers", [(9, 3), (24,)], ids=["rgb", "luminance"])
@pytest.mark.parametrize("around", ["color", "behind", "front"])
def test_camera_slopes_match_finite_differences(device, numbers, around):
    """Of a float64 render, by turns, shifts and focal length, with colours around the field that change too."""
    field, density, sh = oracle.random_field(
        device, resolution=(5, 5, 5), keep=0.7, bounds=((-1,) * 3, (1,) * 3), density_scale=1.0, numbers=numbers
    )
    camera = warpcage.Camera.look_at([2.1, 0.9, 0.7], [0.1, 0, 0], fov_degrees=38, width=8, height=6)
    reach, order = 1.7, tile_order(6, 8)
    random = np.random.default_rng(0)
    image = random.random((1, 6, 8, 3)).astype(np.float16).astype(np.float64)
    rays = training_rays([camera], image, np.ones((1, 6, 8)), field, device)
    rays.order = -1
    has_behind, has_front = around != "color", around == "front"

    def behind(*ray):
        return sky(*ray) if has_behind else np.array([0.3, 0.6, 0.1])

    def render(view):
        picture = rendered(field, density, sh, view, behind)
        if not has_front:
            return picture
        before = np.array([[mist(*ray) for ray in zip(*rows, strict=True)] for rows in zip(*view.rays(), strict=True)])
        return before[..., :3] + before[..., 3:] * picture

    backs = seen_around(sky, camera, reach, order) if has_behind else None
    fronts = seen_around(mist, camera, reach, order) if has_front else None
    records = slopes_of(field, rays, 48, device, behind=backs, front=fronts, reach=reach)
    np.testing.assert_allclose(records[:, 0], (render(camera) - image[0])[order], atol=2e-5)
    for number in range(7):
        more, less = (render(changed_camera(camera, number, sign * STEP, reach)) for sign in (1, -1))
        expected = ((more - less) / (2 * STEP))[order]
        assert np.abs(expected).max() > 0.05
        # a sample that changes its cell within the step meets a crease of the trilinear field
        assert np.quantile(np.abs(records[:, 1 + number] - expected), 0.9) < 2e-3 * np.abs(expected).max()


def test_sums_are_the_gradient_of_the_fits_own_loss(device):
    """2 J^T e of each camera against finite differences of the photometric loss that the field is fitted by."""
    # nothing at the faces of its box, and no empty place within: its pictures change without jumps
    links = np.full((7, 7, 7), -1, np.int32)
    links[1:-1, 1:-1, 1:-1] = np.arange(125).reshape(5, 5, 5)
    random = np.random.default_rng(0)
    density, sh = random.uniform(0.5, 3.0, 125), random.normal(0, 0.1, (125, 24))
    field = warpcage.VoxelField([[-1] * 3, [1] * 3], links, density, sh, device=device)
    cameras = two_cameras()
    images, alphas = random.random((2, 6, 8, 3)), 0.5 + 0.5 * random.random((2, 6, 8))
    images = images * alphas[..., None] + (1 - alphas[..., None])
    gains, offsets = np.exp(0.2 * random.normal(size=(2, 3))), 0.1 * random.normal(size=(2, 3))

    def rays_of(views):
        rays = training_rays(views, images, alphas, field, device)
        rays.order = -1
        rays.exposures = wp.array(np.stack([gains, offsets], axis=1), dtype=wp.vec3, device=device)
        return rays

    records = slopes_of(field, rays_of(cameras), 96, device, background=(1.0, 1.0, 1.0))
    held, sums = wp.array(records, dtype=wp.vec3, device=device), wp.zeros((6, 51), dtype=wp.float32, device=device)
    wp.launch(camera_kernels.sum_camera_slopes, dim=sums.size, inputs=[0, held, 16, 1e6], outputs=[sums], device=device)
    found = CameraSums.unpacked(sums.numpy().astype(np.float64).reshape(2, 3, 51).sum(axis=1))

    def losses(views):
        error = photometric_gradient(field, rays_of(views), 96, by_warps=wp.get_device(device).is_cuda)[1]
        return error.astype(np.float64).reshape(2, 48).sum(axis=1)

    np.testing.assert_allclose(found.error, losses(cameras), rtol=1e-4)
    slopes = records[:, 1:8].reshape(2, 48, 7, 3).astype(np.float64)
    np.testing.assert_allclose(found.normal, np.einsum("nrac,nrbc->nab", slopes, slopes), rtol=1e-4, atol=1e-3)
    for number in range(7):  # small steps: few samples meet a crease of the trilinear field
        more, less = (losses([changed_camera(view, number, sign * 3e-4, 1.0) for view in cameras]) for sign in (1, -1))
        allowed = 0.01 * np.sqrt((slopes[:, :, number] ** 2).sum() * found.error.sum())
        np.testing.assert_allclose(2 * found.slope[:, number], (more - less) / 6e-4, atol=allowed)
    # exposures: y = gain x + offset a from the sums, against least squares
    x, y, a = (records[:, place].reshape(2, 48, 3).astype(np.float64) for place in (8, 9, 10))
    expected = np.stack([(x * x), (x * a), (a * a), (x * y), (a * y)], axis=-1).sum(axis=1)
    np.testing.assert_allclose(found.exposure, expected, rtol=1e-4)
    # What is missed is x + t - (gain y + offset a + 1 - a) before white, where the light t that passes has no color.
    passed = records[:, 0].reshape(2, 48, 3) - x + gains[:, None] * y + offsets[:, None] * a + 1 - a
    np.testing.assert_allclose(passed, passed[..., :1] + np.zeros(3), atol=1e-5)


def test_tiles_are_drawn_from_their_view(device):
    tiles = wp.array(np.array([1, 4, 5, 9, 25, 27], np.int32), device=device)
    starts = wp.array(np.array([0, 4, 4, 6], np.int32), device=device)
    drawn = wp.zeros(3 * 50, dtype=wp.int32, device=device)
    wp.launch(camera_kernels.draw_tiles, dim=150, inputs=[0, tiles, starts, 10, 50, 7], outputs=[drawn], device=device)
    first, none, last = drawn.numpy().reshape(3, 50)
    assert set(first) == {1, 4, 5, 9} and set(none) == {10} and set(last) == {25, 27}


def test_steps_solve_for_cameras_and_their_lenses_together(monkeypatch):
    """Against one large system in which two of three cameras share a lens."""
    monkeypatch.setattr(steps, "DAMPING", 0.0)
    monkeypatch.setattr(steps, "MIN_DAMPING", 0.0)
    random = np.random.default_rng(3)
    jacobians, errors = random.normal(size=(3, 40, 7)), random.normal(size=(3, 40))
    lenses = np.array([0, 1, 0])
    whole = np.zeros((3, 40, 20))
    for n in range(3):
        whole[n, :, 6 * n : 6 * n + 6], whole[n, :, 18 + lenses[n]] = jacobians[n, :, :6], jacobians[n, :, 6]
    expected = np.linalg.lstsq(whole.reshape(120, 20), -errors.ravel(), rcond=None)[0]
    normal, slope = np.einsum("nri,nrj->nij", jacobians, jacobians), np.einsum("nri,nr->ni", jacobians, errors)
    found = steps.camera_steps(normal, slope, lenses)
    np.testing.assert_allclose(found[:, :6].ravel(), expected[:18], rtol=1e-9)
    np.testing.assert_allclose(found[:, 6], expected[18 + lenses], rtol=1e-9)
    still = steps.camera_steps(normal, slope, lenses, lenses_move=False)  # each for itself: no lens makes up for it
    for n in range(3):
        np.testing.assert_allclose(still[n, :6], np.linalg.lstsq(jacobians[n, :, :6], -errors[n], rcond=None)[0])
    assert not still[:, 6].any()
    firm = steps.camera_steps(normal, slope, lenses, np.full((3, 7), 0.1), 1e6)
    np.testing.assert_allclose(firm, -0.1, rtol=1e-4)  # back to the given cameras


def test_exposures_are_found_and_even(monkeypatch):
    monkeypatch.setattr(steps, "EXPOSURE_PRIOR", 0.0)
    monkeypatch.setattr(steps, "OFFSET_PRIOR", 0.0)
    random = np.random.default_rng(4)
    x, a = random.random((5, 3, 60)), random.random((5, 1, 60)) * np.ones((1, 3, 1))
    gains, offsets = np.exp(random.normal(0, 0.3, (5, 3))), random.normal(0, 0.1, (5, 3))
    y = gains[..., None] * x + offsets[..., None] * a
    sums = np.stack([x * x, x * a, a * a, x * y, a * y], axis=-1).sum(axis=2)
    found = steps.fitted_exposures(sums)
    np.testing.assert_allclose(found[0], gains, rtol=1e-9)
    np.testing.assert_allclose(found[1], offsets, atol=1e-9)
    dark = steps.fitted_exposures(np.zeros((1, 3, 5)))  # a view of which nothing counts
    np.testing.assert_array_equal(dark, [np.ones((1, 3)), np.zeros((1, 3))])
    even, moved = steps.even_exposures(*found)
    np.testing.assert_allclose(np.log(even).mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose((moved / even).mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(even / even[0], gains / gains[0])


def orbit_poses(count=12):
    return poses_of(framing_orbit(np.random.default_rng(0).normal(size=(20, 3)), count))


def test_alignments_undo_a_similarity():
    poses, points = orbit_poses(), np.random.default_rng(1).normal(size=(27, 3))
    motion = Similarity(1.3, Rotation.from_rotvec([0.1, 0.2, -0.3]).as_matrix(), np.array([1.0, 2.0, 3.0]))
    moved = motion.moved_poses(poses)
    there = 1.3 * points @ motion.rotation.T + motion.shift
    for found in (aligning_similarity(poses, moved), picture_similarity(poses, moved, there)):
        assert found.scale == pytest.approx(1.3)
        np.testing.assert_allclose(found.rotation, motion.rotation, atol=1e-9)
        np.testing.assert_allclose(found.shift, motion.shift, atol=1e-9)
    assert max(map(np.max, pose_errors(poses, moved))) < 1e-6
    np.testing.assert_allclose(picture_shifts(found.moved_poses(poses), moved, there), 0, atol=1e-9)
    same_place = poses.copy()
    same_place[:, :3, 3] = 1.0  # all in one place: only their axes count
    assert aligning_similarity(same_place, motion.moved_poses(same_place)).scale == 1.0


def test_pictures_align_cameras_that_turns_and_shifts_made_inexact():
    """Cameras that turned and shifted so that the object stays in place are aligned by what they see, not by poses."""
    poses, points = orbit_poses(), 0.3 * np.random.default_rng(1).normal(size=(27, 3))
    inexact = poses.copy()
    for n, angle in enumerate(np.random.default_rng(2).normal(0, 0.05, 12)):  # about the object, not about themselves
        turn = Rotation.from_rotvec(angle * poses[n, :3, 1]).as_matrix()
        inexact[n, :3, :3] = turn @ poses[n, :3, :3]
    by_poses, by_pictures = (
        picture_shifts(found.moved_poses(inexact), poses, points)
        for found in (aligning_similarity(inexact, poses), picture_similarity(inexact, poses, points))
    )
    assert (by_pictures**2).sum() < 0.999 * (by_poses**2).sum()


def bent(camera, zoom=0.0):
    """A camera of a ring after what bends it smoothly: those on one side go ahead and turn right."""
    side = camera.center[0] / np.linalg.norm(camera.center)
    return moved_camera(camera, [0, 0.01 * side, 0], [0, 0, 0.02 * side], zoom)


def ring(count, width=40):
    angles = 2 * np.pi * np.arange(count) / count
    eyes = [[3 * np.cos(angle), 3 * np.sin(angle), 1] for angle in angles]
    return [warpcage.Camera.look_at(eye, [0, 0, 0], fov_degrees=40, width=width, height=30) for eye in eyes]


def test_held_out_cameras_move_along_with_those_near_them():
    """A bend of a ring and a zoom, seen at every camera but every fourth, against where those truly go."""
    every = ring(40)
    true = [bent(camera, zoom=0.01) for camera in every]
    kept, held = [n for n in range(40) if n % 4], range(0, 40, 4)
    given, refined = ([each[n] for n in kept] for each in (every, true))
    starts, ends = ([each[n] for n in held] for each in (every, true))
    found = moved_along(starts, given, refined)
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (30, 3))
    left, before = (picture_shifts(poses_of(each), poses_of(ends), points) for each in (found, starts))
    assert left.max() < 0.15 * before.max() and before.max() > 5e-3
    np.testing.assert_allclose([camera.fx for camera in found], [camera.fx for camera in ends])
    # those of the fit go where they went, and stay there; another size of the picture has the same lens
    np.testing.assert_allclose(poses_of(moved_along(given, given, refined)), poses_of(refined), atol=1e-12)
    assert moved_along(refined, given, refined) == refined
    halved = moved_along([every[0].resized(20, 15)], given, refined)[0]
    assert halved.fx / every[0].resized(20, 15).fx == pytest.approx(np.exp(0.01))


def test_cameras_do_not_go_along_with_what_is_no_ones_neighbors():
    """Cameras that were off each by itself predict nothing: held-out ones stay, nearly."""
    every, random = ring(40), np.random.default_rng(0)
    given, held = [every[n] for n in range(40) if n % 4], [every[n] for n in range(0, 40, 4)]
    refined = [moved_camera(camera, 0.01 * random.normal(size=3)) for camera in given]
    points = random.uniform(-0.5, 0.5, (30, 3))
    moved = picture_shifts(poses_of(moved_along(held, given, refined)), poses_of(held), points)
    assert np.median(moved) < 0.15 * np.median(picture_shifts(poses_of(given), poses_of(refined), points))
