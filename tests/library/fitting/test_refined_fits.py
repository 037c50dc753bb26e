"""Fits that refine their cameras: noisy poses, wrong focal lengths, exposures, checkpoints, files and commands."""

import dataclasses
import functools
import json
import re

import numpy as np
import pytest
from fit_oracles import poses_of
from ground_truth import synthetic_scene
from messages import MESSAGES
from refusals import refused
from scenes import blob_scene
from scipy.spatial.transform import Rotation

import warpcage
from warpcage import CameraFile, FieldOptimizer, evaluate, mean_psnr
from warpcage.demo import write_brick_scene
from warpcage.fitting import CameraRefinement, load_progress, save_progress, tuned_scene
from warpcage.fitting import cameras as cameras_module
from warpcage.studio.cli import main
from warpcage.view import picture_similarity

#: Fits of a second or two.
QUICK = {"resolution": 28, "batch_rays": 2048, "least_steps": 250, "epochs": 11.0}


def turned_in_place(scene, degrees, seed=0):
    """Each camera turned about a random axis by a normal angle."""
    random = np.random.default_rng(seed)
    cameras = []
    for camera in scene.cameras:
        axis = random.normal(size=3)
        pose = camera.camera_to_world.copy()
        turn = np.radians(degrees) * random.normal() * axis / np.linalg.norm(axis)
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(turn).as_matrix()
        cameras.append(dataclasses.replace(camera, camera_to_world=pose))
    return dataclasses.replace(scene, cameras=cameras)


def optimized(scene, device, **options):
    """The fit and its field."""
    optimizer = FieldOptimizer(scene, device=device, seed=0, **{**QUICK, **options})
    while optimizer.step_count < optimizer.total_steps:
        optimizer.step()
    return optimizer, optimizer.finish()


def aligned_psnr(optimizer, field, exact, test):
    """PSNR in dB of test views after the similarity between exact and refined training cameras."""
    points = field.bounds.mean(axis=0) + 0.3 * np.diff(field.bounds, axis=0) * (
        np.indices((3, 3, 3)).reshape(3, 27).T - 1
    )
    motion = picture_similarity(poses_of(exact), poses_of(optimizer.cameras), points)
    return mean_psnr(evaluate(field, dataclasses.replace(test, cameras=motion.moved(test.cameras))))


@pytest.fixture(scope="module")
def bricks():
    return synthetic_scene("bricks", train_views=24, size=28, device="cpu")


@pytest.fixture(scope="module")
def unrefined(bricks):
    """Fits by exact cameras and by noisy ones as they are given, by kind and device; each is made once."""
    scenes = {"exact": bricks[0], "noisy": turned_in_place(bricks[0], 1.0)}
    return functools.cache(lambda kind, device: optimized(scenes[kind], device))


def test_noisy_poses_are_refined_and_exact_ones_stay(bricks, unrefined, device):
    train, test = bricks
    _, exact_field = unrefined("exact", device)
    exact = mean_psnr(evaluate(exact_field, test))
    assert exact_field.refined_cameras is None

    optimizer, field = optimized(train, device, refine_cameras=True)
    np.testing.assert_allclose(poses_of(optimizer.cameras), poses_of(train.cameras), atol=2e-4)
    assert mean_psnr(evaluate(field, test)) > exact - 0.25  # the spread of fits this small; see NOTES-cameras.md

    noisy, (_, blurred) = turned_in_place(train, 1.0), unrefined("noisy", device)
    optimizer, field = optimized(noisy, device, refine_cameras=True)
    refined = aligned_psnr(optimizer, field, train.cameras, test)
    assert mean_psnr(evaluate(blurred, test)) < exact - 3
    assert refined > exact - 1
    # which held-out views show too, each with its own pose fitted to the field
    assert mean_psnr(evaluate(field, tuned_scene(field, test))) > exact - 0.5


def test_cameras_are_refined_where_they_are_off_alone(bricks, unrefined, device, capsys):
    """Exact ones stay as they are given, and so does the field to the bit; shaken ones are found and pay."""
    train, test = bricks
    plain, exact = unrefined("exact", device)
    looked, same = optimized(train, device, refine_cameras="auto")
    assert looked.camera_errors is not None and not looked.camera_errors and same.refined_cameras is None
    if device == "cpu":  # where fits are deterministic
        for name in ("links", "density", "sh"):
            np.testing.assert_array_equal(*(getattr(field.grid, name).numpy() for field in (exact, same)))

    noisy, (_, blurred) = turned_in_place(train, 1.0), unrefined("noisy", device)
    field = warpcage.fit(noisy, device=device, seed=0, refine_cameras="auto", **QUICK)
    assert re.search(r"cameras were off by 0\.\d pixels in the median: refined", capsys.readouterr().err)
    refined = aligned_psnr(field.refined_cameras, field, train.cameras, test)
    assert refined > mean_psnr(evaluate(blurred, test)) + 3
    assert plain.camera_errors is None


def test_held_out_views_move_along(bricks, device, tmp_path):
    """Cameras that are all off as their neighbors are: a path whose poses bend, held-out ones too."""
    _train, test = bricks
    off = [dataclasses.replace(scene, cameras=[bent(camera) for camera in scene.cameras]) for scene in bricks]
    _, field = optimized(off[0], device, refine_cameras=True)
    given, along = (mean_psnr(evaluate(field, off[1], moved_along=moved)) for moved in (False, True))
    assert along > given + 0.5
    # which a file keeps, but for those of others; and the fit's own views go to where it found them
    for kind in ("warpcage", "compact"):
        field.save(tmp_path / "field.npz", format=kind)
        loaded = warpcage.VoxelField.load(tmp_path / "field.npz", device=device).refined_cameras
        for camera, kept in zip(loaded.moved_along(off[0].cameras), field.refined_cameras.cameras, strict=True):
            np.testing.assert_allclose(camera.camera_to_world, kept.camera_to_world, atol=1e-12)
        np.testing.assert_array_equal(loaded.gains, field.refined_cameras.gains)
    scaled = warpcage.VoxelField.load(tmp_path / "field.npz", scene_scale=0.5, device=device).refined_cameras
    np.testing.assert_allclose(scaled.given[0].center, 2 * off[0].cameras[0].center)
    contents = dict(np.load(tmp_path / "field.npz"))
    contents["refined_cameras"] = contents["refined_cameras"][:-9]
    np.savez(tmp_path / "field.npz", **contents)
    with pytest.raises(ValueError, match="field.npz: its refined cameras"):
        warpcage.VoxelField.load(tmp_path / "field.npz", device=device)
    field.refined_cameras = None
    refused(lambda: evaluate(field, test, moved_along=True), match=MESSAGES["fitting.no_refined_cameras"])


def bent(camera):
    """A camera that turned aside, the more the farther it is along x."""
    pose = camera.camera_to_world.copy()
    turn = [0, np.radians(pose[0, 3]), 0]  # 4 units away at most
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(turn).as_matrix()
    return dataclasses.replace(camera, camera_to_world=pose)


def test_exposures_are_undone(bricks, device):
    train, test = bricks
    random = np.random.default_rng(0)
    gains = np.exp(0.2 * random.normal(size=(len(train), 1, 1, 1))) * np.ones(3)
    behind = (1 - train.alphas[..., None]) * train.background
    images = gains * (train.images - behind) + behind
    exposed = dataclasses.replace(train, images=images.astype(np.float32))
    _, uneven = optimized(exposed, device)
    _optimizer, field = optimized(exposed, device, refine_cameras=True)
    assert mean_psnr(evaluate(field, test)) > mean_psnr(evaluate(uneven, test)) + 0.3
    found, true = np.log(field.refined_cameras.gains).ravel(), np.log(gains).ravel()
    assert np.corrcoef(found, true)[0, 1] > 0.75
    np.testing.assert_allclose(np.log(field.refined_cameras.gains).mean(axis=0), 0, atol=1e-9)


@pytest.mark.nightly
def test_an_outer_field_goes_with_refined_cameras(device):
    """What is before the box goes into the cameras' steps, and into views that are tuned."""
    scene = blob_scene(6, 16, with_alpha=False)
    options = {"background": "outer", "resolution": 16, "outer_resolution": 16, "epochs": 3, "least_steps": 40}
    optimizer, field = optimized(scene, device, refine_cameras=True, **options)
    assert np.isfinite(optimizer.refinement.poses).all() and optimizer.refinement.normal.any()
    assert len(tuned_scene(field, scene)) == 6


def test_what_is_around_the_field_refines_cameras_too(device, monkeypatch):
    """The sums of whole pictures against finite differences of their error, layers behind the field included."""
    monkeypatch.setattr(cameras_module, "OUTLIER", 1e6)  # each ray counts alike
    scene = blob_scene(6, 24, with_alpha=False)
    optimizer = FieldOptimizer(scene, device=device, refine_cameras=True, background="layers", resolution=24, epochs=4)
    while optimizer.step_count < optimizer.total_steps:
        optimizer.step()
    refinement, background = optimizer.refinement, optimizer.background
    values = background.layers.values.numpy()
    values[..., :3] = 0.5 + 0.4 * np.sin(np.arange(values.shape[1])[:, None] / 150)
    background.layers.values.assign(values)

    def look():
        refinement.attach(optimizer.rays)
        return refinement.measure(
            optimizer.field,
            optimizer.rays,
            optimizer.batches.view_tiles,
            64,
            seed=3,
            random_background=False,
            gather=background.gather,
        )

    found = look()
    poses, change = refinement.poses.copy(), 1e-3
    for number in (0, 1, 2):
        errors = []
        for sign in (1, -1):
            turn = sign * change * np.eye(3)[number]
            refinement.poses[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(turn).as_matrix()
            errors.append(look().error)
        refinement.poses[:] = poses
        expected = (errors[0] - errors[1]) / (2 * change)
        # a few rays meet a crease of the field or of the layers within the change
        assert np.linalg.norm(2 * found.slope[:, number] - expected) < 0.15 * np.linalg.norm(expected)


def test_pictures_of_one_camera_share_their_lens(bricks):
    cameras = list(bricks[0].cameras)
    bounds = np.array([[-1.0] * 3, [1.0] * 3])
    assert len(CameraRefinement(cameras, bounds, "cpu").zooms) == 1
    cameras[3] = dataclasses.replace(cameras[3], cx=cameras[3].cx + 0.25)
    assert CameraRefinement(cameras, bounds, "cpu").lenses.tolist() == [0, 0, 0, 1] + [0] * (len(cameras) - 4)


@pytest.mark.parametrize("chosen", [True, "auto"])
def test_checkpoints_hold_refined_cameras(tmp_path, monkeypatch, chosen):
    """A fit that goes on from its checkpoint ends where the whole one does, to the bit."""
    monkeypatch.setattr(cameras_module, "OFF_COSINE", 0.0)  # few and small pictures show little
    scene = turned_in_place(blob_scene(12, 24), 1.0)
    options = {
        "device": "cpu",
        "refine_cameras": chosen,
        "resolution": 24,
        "levels": 2,
        "epochs": 10,
        "batch_rays": 512,
    }
    whole, stopped = (FieldOptimizer(scene, **options) for _ in range(2))
    while whole.step_count < whole.total_steps:
        whole.step()
        if whole.step_count == 2 * whole.total_steps // 3:
            save_progress(whole, tmp_path / "fit.npz")
    assert np.abs(whole.refinement.poses - whole.refinement.given_poses).max() > 1e-3
    load_progress(stopped, tmp_path / "fit.npz")
    while stopped.step_count < stopped.total_steps:
        stopped.step()
    np.testing.assert_array_equal(stopped.refinement.poses, whole.refinement.poses)
    np.testing.assert_array_equal(stopped.refinement.gains, whole.refinement.gains)
    np.testing.assert_array_equal(stopped.finish().grid.density.numpy(), whole.finish().grid.density.numpy())

    contents = dict(np.load(tmp_path / "fit.npz"))
    for name, value in (("camera_poses", np.nan), ("camera_gains", -1.0), ("camera_zooms", 9.0)):
        changed = contents[name].copy()
        changed.flat[0] = value
        np.savez(tmp_path / "bad.npz", **{**contents, name: changed})
        with pytest.raises(ValueError, match="damaged fit checkpoint"):
            load_progress(FieldOptimizer(scene, **options), tmp_path / "bad.npz")


def test_the_option_is_yes_or_no():
    with pytest.raises(ValueError, match=MESSAGES["fitting.refine_cameras"]):
        warpcage.fit(blob_scene(count=2, size=8), progress=False, refine_cameras="yes")


def test_commands_write_read_and_tune_cameras(tmp_path, capsys):
    write_brick_scene(tmp_path / "scene", train_views=6, test_views=2, size=24)
    arguments = [
        "fit",
        tmp_path / "scene",
        "-o",
        tmp_path / "bricks.npz",
        "--refine-cameras",
        "--quiet",
        "--resolution",
        24,
    ]
    assert main([*(str(each).replace("refine-cam", "check-cam") for each in arguments), "--epochs", "2"]) == 0
    assert "refined camera" not in capsys.readouterr().out  # these are exact
    assert main([str(each) for each in [*arguments, "--epochs", 2]]) == 0
    assert "bricks.cameras.json: 6 refined cameras" in capsys.readouterr().out
    held = CameraFile.load(tmp_path / "bricks.cameras.json")
    scene = warpcage.load_scene(tmp_path / "scene")
    assert [key.name for key in held] == list(scene.names)
    entries = json.loads((tmp_path / "bricks.cameras.json").read_text())["cameras"]
    assert all(len(entry["exposure"]["gain"]) == len(entry["exposure"]["offset"]) == 3 for entry in entries)

    again = warpcage.load_scene(tmp_path / "scene", cameras=tmp_path / "bricks.cameras.json")
    np.testing.assert_array_equal(poses_of(again.cameras), poses_of(key.camera for key in held))
    halved = warpcage.load_scene(tmp_path / "scene", cameras=tmp_path / "bricks.cameras.json", downscale=2)
    assert halved.cameras[0].fx == pytest.approx(again.cameras[0].fx / 2)
    with pytest.raises(ValueError, match=MESSAGES["fitting.cameras_elsewhere"]):
        warpcage.load_scene(tmp_path / "scene", split="test", cameras=tmp_path / "bricks.cameras.json")
    held[0] = dataclasses.replace(held[0], name="another")
    refused(lambda: scene.with_cameras(held), match="there is no camera for 1 of 6 pictures")
    refused(lambda: scene.with_cameras(scene.cameras[:2]), match="one camera per image")
    with pytest.raises(ValueError, match=MESSAGES["fitting.whole_factor"]):
        scene.with_cameras([dataclasses.replace(camera, width=40, height=20) for camera in scene.cameras])

    arguments = ["evaluate", tmp_path / "bricks.npz", tmp_path / "scene", "--quiet"]
    for more, moved in ([], True), (["--given-cameras"], False):
        assert main([str(each) for each in [*arguments, *more, "--json", tmp_path / "report.json"]]) == 0
        said, report = capsys.readouterr().out, json.loads((tmp_path / "report.json").read_text())
        assert ("moved as the refined ones near them" in said) == report["moved_cameras"] == moved
        assert (report["mean_psnr_given"] is not None) == ("as they were given the mean is" in said) == moved

    arguments.append("--tune-cameras")
    assert main([str(each) for each in [*arguments, "--json", tmp_path / "tuned.json"]]) == 0
    assert "were fitted to the field" in capsys.readouterr().out
    assert json.loads((tmp_path / "tuned.json").read_text())["tuned_cameras"] is True
