"""Scenes at the edge of what can be fitted: a clear refusal, or a result that is pinned here."""

import dataclasses

import numpy as np
import pytest
from messages import MESSAGES
from refusals import refused
from scenes import room_scene

from warpcage import Camera, FieldOptimizer, Scene, VoxelField, evaluate, fit, mean_psnr, turntable
from warpcage.scene import find_box

SIZE = 16
QUICK = {"progress": False, "resolution": 16, "levels": 2, "epochs": 8, "batch_rays": 512}


def around(count=6, size=SIZE):
    return turntable((0, 0, 0), 3.0, 20.0, count, width=size, height=size)


def box_field():
    """A box, red above and blue below, in the middle third of (-1 .. 1)^3."""
    density, sh = np.zeros((24, 24, 24)), np.zeros((24, 24, 24, 9, 3))
    density[8:16, 8:16, 8:16] = 50.0
    sh[..., 0, :] = np.where(np.arange(24)[:, None] >= 12, [1.2, -1.5, -1.5], [-1.5, -1.5, 1.2])
    return VoxelField.from_dense(density, sh, [[-1, -1, -1], [1, 1, 1]])


def seen(cameras, *, alpha=True, field=None):
    frames = [(field or box_field()).render(camera) for camera in cameras]
    alphas = np.stack([frame.alpha for frame in frames]) if alpha else None
    return Scene(np.clip([frame.rgb for frame in frames], 0, 1), alphas, cameras)


def turned(camera):
    """The camera at the same place, looking the other way."""
    return dataclasses.replace(camera, camera_to_world=camera.camera_to_world @ np.diag([-1.0, 1.0, -1.0, 1.0]))


# What a scene refuses


def grey(count=2):
    return np.full((count, SIZE, SIZE, 3), 0.5, np.float32)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"images": grey()[:0], "cameras": []}, "at least one image"),
        ({"images": [], "cameras": []}, "at least one image"),
        ({"images": [grey()[0], grey()[1, :8]]}, MESSAGES["fitting.images_one_size"]),
        ({"images": np.where(np.arange(3) == 1, np.nan, grey())}, "image 0000 .* not finite"),
        ({"images": np.where(np.arange(3) == 1, np.inf, grey())}, "image 0000 .* not finite"),
        ({"images": (255 * grey()).astype(np.uint8)}, MESSAGES["fitting.images_of_bytes"]),
        ({"alphas": np.full((2, SIZE, SIZE), np.nan)}, "alphas of image 0000 .* from nan"),
        ({"alphas": np.full((2, SIZE, SIZE), 255.0)}, "alphas of image 0000 .* to 255"),
        ({"alphas": np.ones((2, 8, SIZE))}, "alphas must be"),
        ({"cameras": around(3)}, "2 images, 3 cameras"),
        ({"cameras": around(2, size=8)}, "is 8x8, images are 16x16"),
    ],
)
def test_scenes_that_are_refused(change, message):
    refused(lambda: Scene(**{"images": grey(), "alphas": None, "cameras": around(2)} | change), match=message)


@pytest.mark.parametrize("name", ["fx", "fy"])
@pytest.mark.parametrize(
    "focal, message",
    [(0.0, "positive"), (-3.0, "positive"), (np.nan, "finite"), (np.inf, "finite"), (None, "finite"), ("9", "finite")],
)
def test_focal_lengths_that_are_refused(name, focal, message):
    refused(lambda: dataclasses.replace(around(1)[0], **{name: focal}), match=message)


SHEAR = np.eye(4) + 0.2 * np.eye(4, k=1)


@pytest.mark.parametrize(
    "pose, message",
    [
        (np.zeros((4, 4)), "rotation"),
        (2 * np.eye(4), "rotation"),
        (SHEAR, "rotation"),
        (np.diag([-1.0, 1, 1, 1]), "rotation"),
        (np.full((4, 4), np.nan), "finite"),
        (np.eye(3), "shape"),
        (np.diag([1.0, 1, 1, 0]), "row 0 0 0 1"),
    ],
)
def test_poses_that_are_refused(pose, message):
    refused(lambda: Camera(20, 20, 8, 8, 16, 16, pose), match=message)


# What a fit refuses


@pytest.mark.parametrize(
    "options, message",
    [
        ({"bounds": [1, 2]}, "bounds must be"),
        ({"bounds": [[0, 0, 0], [1, 1, 0]]}, "lower below upper"),
        ({"bounds": [[0, 0, 0], [1, 1, np.nan]]}, "finite"),
        ({"bounds": [[50] * 3, [51] * 3]}, "inside all silhouettes"),
        ({"epoch": 3}, "no option 'epoch'"),
        ({"quality": "best"}, "quality"),
        ({"seed": -1}, "seed"),
        ({"seed": 1.5}, "seed"),
        ({"epochs": 0}, "epochs"),
        ({"epochs": "3"}, "epochs"),
        ({"epochs": np.nan}, "epochs"),
        ({"resolution": 2}, "resolution"),
        ({"resolution": 16.5}, "resolution"),
        ({"levels": 0}, "levels"),
        ({"levels": 2.5}, "levels"),
        ({"batch_rays": -5}, "batch_rays"),
        ({"variation_share": 0}, "variation_share"),
        ({"keep_at": 2}, "keep_at"),
        ({"beta": 1}, "beta"),
        ({"tile_size": 0}, "tile_size"),
        ({"rate_sh": -1.0}, "rate_sh"),
        ({"max_resolution": 4}, "max_resolution"),
    ],
)
def test_options_that_are_refused(options, message):
    refused(lambda: FieldOptimizer(seen(around(2)), **options), match=message)


def test_nothing_but_background_is_refused():
    white = np.ones((4, SIZE, SIZE, 3), np.float32)
    with pytest.raises(ValueError, match="every pixel of the scene is transparent"):
        fit(Scene(white, np.zeros((4, SIZE, SIZE)), around(4)), **QUICK)
    refused(lambda: fit(Scene(white, None, around(4)), **QUICK), match=MESSAGES["fitting.background_alone"])


@pytest.mark.parametrize("alpha", [True, False])
def test_cameras_that_all_look_away_are_refused(alpha):
    scene = seen(around(6), alpha=alpha)
    away = dataclasses.replace(scene, cameras=[turned(camera) for camera in scene.cameras])
    if alpha:
        refused(lambda: fit(away, **QUICK), match="6 of 6 cameras look away")
    else:  # they may be pictures of a room, taken in its middle
        assert "cameras whose axes are wrong" in find_box(away.cameras).reason
    with pytest.raises(ValueError, match="inside all silhouettes" if alpha else "no camera sees the bounds"):
        fit(away, bounds=[[-0.5] * 3, [0.5] * 3], **QUICK)


def test_cameras_in_one_place_that_look_around_need_bounds():
    angles, lens = 2 * np.pi * np.arange(6) / 6, {"fov_degrees": 80, "width": SIZE, "height": SIZE}
    ahead = np.stack([np.cos(angles), np.sin(angles), 0.2 * np.sin(3 * angles)], axis=1)
    cameras = [Camera.look_at([0, 0, 0], each, **lens) for each in ahead]
    refused(lambda: fit(Scene(grey(6), None, cameras), **QUICK), match="do not determine .* give the bounds")
    with pytest.raises(ValueError, match="size of what they look at"):
        fit(Scene(grey(1), None, [dataclasses.replace(cameras[0], fx=1e30, fy=1e30)]), **QUICK)


# Results that are pinned


def test_one_camera_that_looks_away_does_no_harm():
    cameras = [*around(12), turned(around(12)[0])]
    scene = seen(cameras)
    assert not scene.alphas[-1].any()
    whole = FieldOptimizer(seen(cameras[:-1]), resolution=16)
    with_it = FieldOptimizer(scene, resolution=16)
    np.testing.assert_allclose(with_it.bounds, whole.bounds, rtol=1e-12)
    assert with_it.field.voxel_count == whole.field.voxel_count


@pytest.mark.parametrize("alpha", [True, False])
def test_one_image_is_matched(alpha):
    scene = seen(around(1), alpha=alpha)
    field = fit(scene, **{**QUICK, "epochs": 60})
    assert mean_psnr(evaluate(field, scene)) > 25


def test_an_opaque_scene_is_fitted_without_silhouettes():
    """Alphas of one everywhere say nothing: the box is what the cameras see, as without alphas."""
    images = seen(around(8)).images
    opaque = Scene(images, np.ones(images.shape[:3]), around(8))
    field = fit(opaque, **{**QUICK, "epochs": 20})
    plain = fit(Scene(images, None, around(8)), **{**QUICK, "epochs": 20})
    assert mean_psnr(evaluate(field, opaque)) > 22
    assert np.abs(field.bounds - plain.bounds).max() < 0.4 * np.ptp(plain.bounds, axis=0).max()


@pytest.mark.parametrize("bounds", [[[-1.2] * 3, [1.2] * 3], None])
def test_cameras_inside_what_they_see(bounds):
    """A hollow ball around all cameras; they look across its middle."""
    centers = np.stack(np.meshgrid(*[(np.arange(32) + 0.5) / 16 - 1] * 3, indexing="ij"), axis=-1)
    radius = np.linalg.norm(centers, axis=-1)
    sh = np.zeros((32, 32, 32, 9, 3))
    sh[..., 0, :] = centers
    shell = VoxelField.from_dense(np.where(radius > 0.8, 40.0, 0.0), sh, [[-1] * 3, [1] * 3])
    angles, lens = 2 * np.pi * np.arange(10) / 10, {"fov_degrees": 70, "width": SIZE, "height": SIZE}
    eyes = 0.4 * np.stack([np.cos(angles), np.sin(angles), 0.3 * np.cos(2 * angles)], axis=1)
    cameras = [Camera.look_at(eye, [0, 0, 0], **lens) for eye in eyes]
    scene = seen(cameras, alpha=False, field=shell)
    field = fit(scene, bounds=bounds, **{**QUICK, "epochs": 10})
    assert mean_psnr(evaluate(field, scene)) > 20
    assert np.isfinite(field.render(cameras[0]).rgb).all()


@pytest.mark.parametrize("masks", [False, "split"])
@pytest.mark.parametrize(
    "options, expected",
    [
        ({"resolution": 8, "levels": 6}, [(2, 2, 2), (4, 4, 4), (8, 8, 8)]),
        ({"resolution": 9, "levels": 6}, [(2, 2, 2), (4, 4, 4), (8, 8, 8), (16, 16, 16)]),
        ({"bounds": [[-2, -2, -0.02], [2, 2, 0.02]]}, [(8, 8, 2), (16, 16, 4)]),
    ],
)
def test_first_levels_have_two_voxels_along_each_axis(masks, options, expected):
    """As many as a field needs at least: with more levels than halvings, and where a box is thinner than a voxel."""
    scene, box = room_scene(6, SIZE, masks=masks), [[-2.0] * 3, [2.0] * 3]
    optimizer = FieldOptimizer(scene, **({"bounds": box, "resolution": 16, "levels": 2, "epochs": 1} | options))
    assert optimizer.shapes == expected and optimizer.options.levels == len(expected)
    assert (optimizer.bounds[0] <= np.array(options.get("bounds", box))[0]).all()


@pytest.mark.parametrize("alpha", [True, False])
def test_images_of_one_pixel(alpha):
    """Each step is a pass over them all, and the default has steps enough."""
    scene = seen(around(8, size=1), alpha=alpha)
    background = "auto" if alpha else "constant"  # layers behind would explain so few pixels alone
    field = fit(scene, resolution=16, progress=False, background=background)
    assert mean_psnr(evaluate(field, scene)) > 20
