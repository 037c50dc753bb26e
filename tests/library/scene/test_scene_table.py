"""The table of scene formats: what is known, detected and listed, and what another package adds to it."""

import functools
import json

import numpy as np
import pytest
from entry_points import plug
from messages import MESSAGES
from refusals import refused
from runs import succeed
from scene_writers import brick_pictures, write_image

from warpcage import load_scene
from warpcage.scene import SceneFormat, View, held_out, make_scene, scene_formats


def read_toy(folder, *, split, **options):
    """Cameras in a JSON file of our own: a pose and a focal length a picture."""
    rows = json.loads((folder / "toy.json").read_text())
    views = []
    for name in sorted(rows):
        where, (focal, pose) = f"toy.json: {name}", rows[name]
        views.append(View(folder / name, np.array(pose), where, lambda size, f=focal: (f, f, size[0] / 2, size[1] / 2)))
    return make_scene(folder, [views[index] for index in held_out(len(views), split, folder)], **options)


TOY = SceneFormat("toy", "toy.json", lambda folder: (folder / "toy.json").is_file(), read_toy)


@pytest.fixture
def plugged(monkeypatch):
    """Entry points of other packages, by name."""
    from warpcage.scene.formats import table

    yield functools.partial(plug, monkeypatch, table.ENTRY_POINTS, table.other_formats)
    table.other_formats.cache_clear()


@pytest.fixture(scope="module")
def toy_scene(tmp_path_factory):
    """A folder of the toy format, and its pictures."""
    folder, pictures = tmp_path_factory.mktemp("toy"), brick_pictures(10, centered=True)
    files = [f"{name}.png" for name in pictures.names]
    rows = {file: (c.fx, c.camera_to_world.tolist()) for file, c in zip(files, pictures.cameras, strict=True)}
    for name, rgba in zip(rows, pictures.rgba, strict=True):
        write_image(folder / name, rgba)
    (folder / "toy.json").write_text(json.dumps(rows))
    return folder, pictures


@pytest.mark.parametrize("format", [None, "toy"])
def test_another_package_adds_a_format(plugged, toy_scene, format):
    folder, pictures = toy_scene
    plugged(toy=TOY)
    scene = load_scene(folder, split="all", format=format)
    for read, written in zip(scene.cameras, pictures.cameras, strict=True):
        np.testing.assert_array_equal(read.camera_to_world, written.camera_to_world)
        assert read.fx == written.fx
    assert len(load_scene(folder, split="test", format=format)) == 2


def test_what_is_known_is_listed_from_one_table(plugged, toy_scene, tmp_path, capsys):
    plugged(toy=TOY)
    names = [each.name for each in scene_formats()]
    assert names[-1] == "toy" and len(set(names)) == len(names)
    (tmp_path / "empty").mkdir()
    message = refused(lambda: load_scene(tmp_path / "empty", format="other"))
    assert all(name in message for name in names)
    succeed(toy_scene[0], "info")
    said = capsys.readouterr().out
    assert all(f"{each.name}: {each.mark}" in said for each in scene_formats())
    succeed(toy_scene[0].parent, "info", f"@{toy_scene[0].name}")
    assert "toy" in capsys.readouterr().out


@pytest.mark.parametrize(
    "files, form, has, missing",
    [
        ("images/1.png sparse/0/cameras.bin", "colmap", "images/, sparse/0/ and ", "sparse/0/images.bin or .* is"),
        ("images/1.png sparse/0/rigs.txt", "colmap", "images/ and sparse/0/,", "cameras.bin or .*images.txt are"),
        ("rgb/0.png pose/0.txt", "nsvf", "rgb/ and pose/", "intrinsics.txt is"),
        ("dataset.json rgb/1x/0.png", "nerfies", "dataset.json and rgb/", "camera/ is"),
        ("traj.txt", "replica", "traj.txt", "results/ or rgb/ is"),
        ("cfg_args cameras.json", "3dgs", "cameras.json and cfg_args", "point_cloud/ and .*cloud.ply are"),
    ],
)
def test_an_unknown_folder_says_what_is_nearest(tmp_path, files, form, has, missing):
    require_said(tmp_path, files, MESSAGES["scene.nearest"].format(form, has, missing))


@pytest.mark.parametrize(
    "files, said",
    [
        ("images/1.png", "in images/, but no cameras: `warpcage capture .*images -o"),
        ("1.png 2.jpg", "pictures, but no cameras: `warpcage capture .* -o"),
        ("scene0000_00.sens", "intrinsic/ with its SensReader"),
        ("images/1.png Barn_COLMAP_SfM.log", "its pictures with ns-process-data"),
        ("habitat/mesh_semantic.ply", "Replica's own download holds meshes"),
        ("config.yml nerfstudio_models/step.ckpt", "ns-export gaussian-splat"),
        ("walk.mp4", "warpcage capture VIDEO"),
        ("notes.txt", "that are known; it holds notes.txt"),
        ("", "that are known; it holds nothing"),
    ],
)
def test_a_folder_that_is_not_read_says_what_to_do(tmp_path, files, said):
    require_said(tmp_path, files, said)


def require_said(folder, files, said):
    for file in files.split():
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).touch()
    message = refused(lambda: load_scene(folder), match=said)
    assert len(message) < 500


@pytest.mark.parametrize("wrong", [None, ImportError("no module"), SceneFormat("colmap", "x", bool, read_toy)])
def test_a_format_that_cannot_be_used_is_told_and_left_out(plugged, toy_scene, wrong):
    plugged(broken=wrong, toy=TOY)
    with pytest.warns(UserWarning, match=MESSAGES["scene.format_unusable"]):
        assert len(load_scene(toy_scene[0], split="all")) == 10
