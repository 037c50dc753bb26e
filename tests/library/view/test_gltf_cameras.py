"""Cameras of glTF files: where they stand, what they see, and how they move."""

import json
import pathlib

import numpy as np
import pytest
from messages import MESSAGES
from refusals import refused
from runs import SMALL, run, succeed, write_files
from scene_writers import GltfWriter

from warpcage import Camera, CameraFile, camera_at
from warpcage.view import read_image

FIXTURES = pathlib.Path(__file__).parents[2] / "data" / "blender_cameras"
LENS = {"type": "perspective", "perspective": {"yfov": 0.6, "aspectRatio": 1.6, "znear": 0.1}}


def document(cameras=(LENS,), **node):
    """A file with a mesh and a camera."""
    writer = GltfWriter(np.eye(3), [[0, 1, 2]])
    writer.more["cameras"] = list(cameras)
    writer.nodes.append({"camera": 0, "name": "eye", **node})
    return writer


def test_a_camera_without_a_place_looks_along_y(tmp_path):
    """glTF: along -z, with y up. With z up that is along +y, and z is up in the picture."""
    camera = Camera.load(document().save(tmp_path / "a.gltf"))
    np.testing.assert_allclose(camera.rotation.T, [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-12)
    assert (camera.width, camera.height) == (400, 250)
    assert 2 * np.arctan(0.5 * camera.height / camera.fy) == pytest.approx(0.6)
    assert camera.fx == camera.fy and (camera.cx, camera.cy) == (200, 125)
    sized = Camera.load(tmp_path / "a.gltf", "eye", size=(64, 32))
    assert (sized.width, sized.height) == (64, 32) and 2 * np.arctan(16 / sized.fy) == pytest.approx(0.6)


def test_nodes_above_a_camera_place_it(tmp_path):
    writer = document(translation=[0, 0, 5])
    half = np.sqrt(0.5)
    writer.nodes.append({"children": [1], "rotation": [0, half, 0, half], "translation": [1, 2, 3], "scale": [2, 2, 2]})
    camera = Camera.load(writer.save(tmp_path / "a.gltf"))
    # turned by 90 degrees about y: (0, 0, 5) doubled lands on x
    np.testing.assert_allclose(camera.center, [11, -3, 2], atol=1e-9)
    np.testing.assert_allclose(camera.rotation[:, 2], [-1, 0, 0], atol=1e-9)


def test_a_camera_that_moves_comes_frame_for_frame(tmp_path):
    writer = document()
    times, places = np.arange(5) / 25, np.stack([np.arange(5), np.zeros(5), np.ones(5)], axis=1)
    writer.animate((1, "translation", times + 0.04, places, "LINEAR"))
    file = CameraFile.load(writer.save(tmp_path / "a.gltf"))
    np.testing.assert_allclose([key.time for key in file], times, atol=1e-6)
    np.testing.assert_allclose([key.camera.center for key in file], places[:, [0, 2, 1]] * [1, -1, 1], atol=1e-6)
    middle = camera_at(file.path("eye"), 0.5 / 25)
    np.testing.assert_allclose(middle.center, [0.5, -1, 0], atol=1e-5)
    refused(lambda: Camera.load(tmp_path / "a.gltf"), match=MESSAGES["view.keys_by_number"])
    np.testing.assert_allclose(Camera.load(tmp_path / "a.gltf", "2").center, [2, -1, 0], atol=1e-6)
    writer.nodes.append({"camera": 0, "name": "other"})
    writer.animate((2, "translation", times, places, "LINEAR"))
    two = CameraFile.load(writer.save(tmp_path / "two.gltf"))
    refused(two.path, match="name the one that moves, of eye, other")
    assert len(two.path("other")) == 5


def test_cameras_of_a_file_share_their_clock(tmp_path):
    """Times count from the first key of the file, also where a camera begins to move later, or a mesh before it."""
    writer = document()
    writer.nodes.append({"camera": 0, "name": "late"})
    times, places = np.arange(5) / 25, np.stack([np.arange(5), np.zeros(5), np.ones(5)], axis=1)
    writer.animate((1, "translation", times + 1.0, places, "LINEAR"), (2, "translation", times + 2.0, places, "LINEAR"))
    file = CameraFile.load(writer.save(tmp_path / "two.gltf"))
    np.testing.assert_allclose([key.time for key in file], [*times, *(times + 1.0)], atol=1e-6)
    writer.animate((0, "translation", [0.5, 1.0], [[0, 0, 0], [0, 0, 1]], "LINEAR"))
    file = CameraFile.load(writer.save(tmp_path / "mesh_first.gltf"))
    np.testing.assert_allclose([key.time for key in file], [*(times + 0.5), *(times + 1.5)], atol=1e-6)


@pytest.mark.parametrize(
    "changes, said",
    [
        ({"cameras": []}, "not a glTF file that can be read"),
        ({"cameras": [{"type": "orthographic"}]}, "is orthographic: only perspective ones are read"),
        ({"cameras": [{"type": "perspective", "perspective": {"yfov": 7}}]}, "a field of view of 7"),
        ({"cameras": [{"type": "perspective", "perspective": {}}]}, "not a glTF file that can be read"),
        ({"nodes": [{"mesh": 0}]}, "there is no camera in it: export with cameras"),
        ({"nodes": [{"camera": 0, "scale": [0, 1, 1]}]}, "scaled to nothing"),
        ({"nodes": [{"camera": 0, "scale": [-1, 1, 1]}]}, "must hold a rotation"),
    ],
)
def test_files_without_a_camera_to_use(tmp_path, changes, said):
    content = json.loads(document().save(tmp_path / "a.gltf").read_text())
    content |= changes
    content["scenes"] = [{"nodes": list(range(len(content["nodes"])))}]
    (tmp_path / "a.gltf").write_text(json.dumps(content))
    refused(lambda: CameraFile.load(tmp_path / "a.gltf"), said, "a.gltf")


def test_commands_take_them(tmp_path, capsys):
    files = write_files(tmp_path)
    writer = document(translation=[0, 0, 4])
    writer.save(tmp_path / "still.gltf")
    render = ["render", "@ball.npz", "-o", tmp_path / "x.png"]
    succeed(files, *render, "--camera", "@still.gltf", "--size", 40, 25)
    picture = read_image(tmp_path / "x.png")
    assert picture.shape == (25, 40, 3) and picture[12, 20].min() < 0.8 and (picture[:, 0] == 1.0).all()
    writer.animate((1, "translation", [0.0, 1.0], [[0, 0, 4], [1, 0, 4]], "LINEAR"))
    writer.save(tmp_path / "moving.gltf")
    film = ["animate", "@ball.npz", "-o", tmp_path / "film", "--quiet", "--size", 40, 25]
    arguments = ["--cameras", "@moving.gltf:eye", "--frames", 3, "--save-camera", tmp_path / "path.json"]
    succeed(files, *film, *arguments)
    places = [key.camera.center for key in CameraFile.load(tmp_path / "path.json")]
    np.testing.assert_allclose(places, [[0, -4, 0], [0.5, -4, 0], [1, -4, 0]], atol=1e-6)
    capsys.readouterr()
    assert run(files, *render, *SMALL, "--camera", "@cage.obj") == 2
    assert "--camera must be" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["still", "moving"])
def test_cameras_from_blender_see_what_blender_says(name):
    """`python benchmarks blender cameras` writes the files, and where Blender itself has points in the pictures."""
    truth = np.load(FIXTURES / f"{name}.npz")
    width, height = truth["size"].tolist()
    keys = CameraFile.load(FIXTURES / f"{name}.glb", size=(width, height))
    assert len(keys) == len(truth["pixels"])
    for key, pixels in zip(keys, truth["pixels"], strict=True):
        np.testing.assert_allclose(key.camera.project(truth["points"])[0], pixels, atol=0.02)
