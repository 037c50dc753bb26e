"""Scenes that were captured tilted: straightened on load, in a fit, and back."""

import json
import pathlib

import numpy as np
import pytest
import trimesh
from runs import run, succeed

from warpcage import Cage, Scene, VoxelField, evaluate, load_scene, mean_psnr, turntable
from warpcage.demo import write_brick_scene
from warpcage.view import axis_rotation, read_image

#: How the world lies: up is about that of the DTU pictures.
TILT = np.eye(4)
TILT[:3, :3] = axis_rotation(np.array([0.6, 0.0, 0.8]), 0.4) @ axis_rotation(np.array([1.0, 0.0, 0.0]), 2.5)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A small scene, and the same in a tilted world."""
    folder = tmp_path_factory.mktemp("straight")
    for name, motion in (("level", np.eye(4)), ("tilted", TILT)):
        write_brick_scene(folder / name, train_views=10, test_views=3, size=32)
        for path in (folder / name).glob("transforms_*.json"):
            content = json.loads(path.read_text())
            for frame in content["frames"]:
                frame["transform_matrix"] = (motion @ np.array(frame["transform_matrix"])).tolist()
            path.write_text(json.dumps(content))
    return folder


def test_the_world_is_turned_by_the_smallest_turn(files):
    tilted = load_scene(files / "tilted")
    np.testing.assert_allclose(tilted.up, TILT[:3, 2], atol=2e-3)
    straight = load_scene(files / "tilted", orient="up")
    np.testing.assert_allclose(straight.up, [0, 0, 1], atol=2e-3)
    turn = straight.straightening[:3, :3]
    np.testing.assert_allclose(turn @ tilted.up, [0, 0, 1], atol=1e-12)
    axis = np.cross(tilted.up, [0, 0, 1])
    np.testing.assert_allclose(turn @ axis, axis, atol=1e-12)  # about the axis across both: the smallest turn
    points = np.random.default_rng(0).normal(size=(20, 3)) * 0.3
    for before, after in zip(tilted.cameras, straight.cameras, strict=True):
        np.testing.assert_allclose(after.project(points @ turn.T)[0], before.project(points)[0], atol=1e-9)
    back = straight.to_source @ straight.straightening
    np.testing.assert_allclose(back, np.eye(4), atol=1e-12)
    np.testing.assert_array_equal(straight.images, tilted.images)
    level = load_scene(files / "level", orient="up")
    assert level.straightening is None  # it stands straight


def test_all_splits_are_of_one_world(files):
    train, test = (load_scene(files / "tilted", split=split, orient="up") for split in ("train", "test"))
    np.testing.assert_array_equal(train.straightening, test.straightening)
    given = load_scene(files / "tilted", split="test", orient=train.straightening)
    for one, two in zip(given.cameras, test.cameras, strict=True):
        np.testing.assert_array_equal(one.camera_to_world, two.camera_to_world)
    for orient, said in (("z", "orient must be 'up'"), (np.ones((4, 4)), "rotation"), (np.eye(3), r"\(4, 4\)")):
        with pytest.raises(ValueError, match=said):
            load_scene(files / "tilted", orient=orient)


def test_up_that_points_down_is_turned_over():
    cameras = turntable((0, 0, 0), 3.0, 20, 4, up=(0, 0, -1), width=4, height=4)
    scene = Scene(np.zeros((4, 4, 4, 3)), None, cameras, bounds=[[-1, -2, -3], [1, 2, 4]])
    straight = scene.straightened()
    np.testing.assert_allclose(straight.up, [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(straight.bounds[:, 2], [-4, 3], atol=1e-9)
    assert straight.straightened() is straight
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = axis_rotation(np.array([0, 0, 1.0]), np.pi / 4), (5, 0, 0)
    moved = straight.moved(motion)
    np.testing.assert_allclose(moved.straightening, motion @ straight.straightening)
    np.testing.assert_allclose(moved.bounds[:, 0], [5 - 3 / np.sqrt(2), 5 + 3 / np.sqrt(2)], atol=1e-9)
    ball = straight.moved(motion, round_bounds=True)
    np.testing.assert_allclose(np.ptp(ball.bounds, axis=0), np.ptp(straight.bounds, axis=0))


FIT = ("--epochs", 6, "--resolution", 24, "--quiet")


@pytest.fixture(scope="module")
def fields(files):
    succeed(files, "fit", "@tilted", "-o", "@straight.npz", "--straighten", *FIT)
    return files


def test_a_straightened_fit_stands_upright_and_meets_its_scene(fields, tmp_path, capsys):
    field = VoxelField.load(fields / "straight.npz")
    np.testing.assert_allclose(field.up, [0, 0, 1], atol=2e-3)
    train = load_scene(fields / "tilted")
    np.testing.assert_allclose(field.straightening[:3, :3] @ train.up, [0, 0, 1], atol=1e-9)
    rows = evaluate(field, load_scene(fields / "tilted", split="test"))  # in the world of its files
    same = evaluate(field, load_scene(fields / "tilted", split="test", orient="up"))
    assert [row["psnr"] for row in rows] == pytest.approx([row["psnr"] for row in same], abs=0.05)
    assert mean_psnr(rows) > 17.0
    capsys.readouterr()
    succeed(fields, "evaluate", "@straight.npz", "@tilted", "--quiet")
    printed = capsys.readouterr().out.splitlines()[-1].split()
    assert float(printed[1]) == pytest.approx(mean_psnr(same), abs=0.05)
    succeed(fields, "info", "@straight.npz")
    turned = np.degrees(np.arccos(train.up[2]))
    assert f" by {turned:.1f} degrees" in capsys.readouterr().out

    succeed(fields, "render", "@straight.npz", "-o", tmp_path / "x.png", "--camera", "@tilted:test:0")
    picture = load_scene(fields / "tilted", split="test").images[0]
    assert np.mean((read_image(tmp_path / "x.png") - picture) ** 2) < 10**-1.7
    view = ["--cameras", "given", "--scene", "@tilted:test"]
    succeed(fields, "render", "@straight.npz", "-o", tmp_path / "views", *view)
    given = read_image(tmp_path / "views" / "view_0000.png")
    np.testing.assert_array_equal(given, read_image(tmp_path / "x.png"))


def test_a_field_is_kept_with_its_turn_and_turned_back(fields, tmp_path):
    field = VoxelField.load(fields / "straight.npz")
    for format in ("warpcage", "compact"):
        field.save(tmp_path / "copy.npz", format=format)
        np.testing.assert_array_equal(VoxelField.load(tmp_path / "copy.npz").straightening, field.straightening)
    np.testing.assert_array_equal(field.view_options()["straightening"], field.straightening)
    meshes = []
    for arguments in ([], ["--as-captured"]):
        succeed(fields, "mesh", "@straight.npz", "-o", tmp_path / "mesh.ply", *arguments)
        meshes.append(trimesh.load(tmp_path / "mesh.ply", force="mesh", process=False).vertices)
    back = meshes[0] @ field.straightening[:3, :3]  # by the inverse
    np.testing.assert_allclose(meshes[1], back, atol=1e-5)
    with pytest.raises(ValueError, match="straightening must hold a rotation"):
        VoxelField(field.bounds, field.grid.links, field.grid.density, field.grid.sh, straightening=2 * TILT)


def test_presets_take_the_scenes_up(fields, tmp_path, capsys):
    """In a straightened field up is z; in another one it is a direction."""
    tilted = VoxelField.load(fields / "straight.npz")
    tilted.up = up = np.array([0.6, 0.0, 0.8])
    tilted.save(tmp_path / "leaning.npz")
    low, high = tilted.bounds
    cage = Cage.box(low - 0.05, high + [0.05, 0.05, 0.5], segments=2)
    cage.save(tmp_path / "cage.obj")
    at = ["--size", 24, "--coordinates", "mean_value", "--resolution", 16, "--eye", 0, -4, 0, "--target", 0, 0, 0]
    render = ["render", tmp_path / "leaning.npz", *at, "--cage", tmp_path / "cage.obj"]
    cage.twist(50, axis=up).save(tmp_path / "twisted.obj")
    cage.bend(40, axis=up, towards=(0, 1, 0)).save(tmp_path / "bent.obj")
    cage.stretch(1.3, axis="long").save(tmp_path / "long.obj")
    for preset, file in (
        ("twist:50:up", "twisted.obj"),
        ("bend:40:up:y", "bent.obj"),
        ("bend:40:0.6,0,0.8:0,1,0", "bent.obj"),
        ("stretch:1.3:long", "long.obj"),
    ):
        for name, pose in (("preset", preset), ("file", tmp_path / file)):
            succeed(fields, *render, "-o", tmp_path / f"{name}.png", "--posed", pose)
        one, two = (read_image(tmp_path / f"{name}.png") for name in ("preset", "file"))
        assert np.abs(one - two).max() < 0.02, preset
    for arguments, file in (
        (["--twist", 50, "--axis", "up", "--object", tmp_path / "leaning.npz"], "twisted.obj"),
        (["--bend", 40, "--axis", "up", "--up", 0.6, 0, 0.8, "--towards", "y"], "bent.obj"),
        (["--bend", 40, "--axis", "3,0,4", "--towards=-1e-9,1,0"], "bent.obj"),
        (["--stretch", 1.3, "--axis", "long"], "long.obj"),
    ):
        succeed(fields, "pose", tmp_path / "cage.obj", "-o", tmp_path / "posed.obj", *arguments)
        found, wanted = (Cage.load(tmp_path / name).vertices for name in ("posed.obj", file))
        np.testing.assert_allclose(found, wanted, atol=1e-8)
    capsys.readouterr()
    for arguments, said in (
        (["--twist", 50, "--axis", "up"], "needs --up or --object"),
        (["--twist", 50, "--axis", "1,2"], "x, y, z, -x, up, long, middle, short, or a direction such as 0,0.2,1"),
        (["--bend", 50, "--axis", "z", "--towards", "0,0,1"], "two different directions"),
    ):
        assert run(fields, "pose", tmp_path / "cage.obj", "-o", tmp_path / "no.obj", *arguments) == 2
        error = capsys.readouterr().err
        assert said in error and error.count("\n") == 1 and not pathlib.Path(tmp_path / "no.obj").exists()
