"""Output folders of 3D Gaussian Splatting: the newest splats, their cameras and background, and the pictures behind."""

import dataclasses
import json
import shutil
import warnings

import numpy as np
import pytest
from dataset_writers import camera_rows, write_output
from refusals import refused
from runs import run, succeed
from scene_writers import Pictures, spiral_cameras, write_blender, write_colmap
from splat_scenes import some_splats

import warpcage
from warpcage import Camera, CameraFile, load_scene
from warpcage.view import read_image

ORDER = [0, 8, 1, 2, 3, 4, 5, 6, 7, 9]  # pictures that were held out come first


@pytest.fixture(scope="module")
def shown():
    """Splats before white, and pictures that they give, of 8 bits."""
    contents = some_splats(60, 1)
    large = dataclasses.replace(contents, log_scales=contents.log_scales + 2.0, centers=0.4 * contents.centers)
    field = warpcage.SplatField.from_contents(large, device="cpu", background="white")
    cameras = [
        dataclasses.replace(each, fx=55.0, fy=55.0) for each in spiral_cameras(10, width=48, height=36, centered=True)
    ]
    rgb = np.stack([np.asarray(field.render(camera).rgb) for camera in cameras])
    rgba = np.concatenate([rgb, np.ones_like(rgb[..., :1])], axis=-1)
    return field, Pictures(np.round(np.clip(rgba, 0, 1) * 255).astype(np.uint8), cameras)


@pytest.fixture
def output(tmp_path, shown):
    """Its folder, beside the scene of the pictures."""
    field, pictures = shown
    write_colmap(tmp_path / "truck", pictures, binary=True)
    chosen = pictures.pick(ORDER)
    names = [f"{pictures.names[index]}.png" for index in ORDER]
    write_output(tmp_path / "out", field, chosen.cameras, names, tmp_path / "truck", white_background=True)
    return tmp_path / "out"


def test_the_folder_is_a_field_with_views(output, shown, capsys):
    field, pictures = shown
    loaded = warpcage.SplatField.load(output, device="cpu")
    np.testing.assert_array_equal(loaded.centers, field.centers)  # of the newest iteration
    np.testing.assert_array_equal(loaded.background, 1.0)
    succeed(output.parent, "info", "@out")
    said = capsys.readouterr().out
    for text in (
        "7000, 30000: the newest",
        f"10 of 48x36: --camera {output}:0 to :9",
        "white",
        str(output.parent / "truck"),
    ):
        assert text in said
    for index, name in ((2, "2"), (2, "view_01.png"), (9, "9")):
        succeed(output.parent, "render", "@out", "--camera", f"@out:{name}", "-o", "@a.png", "--device", "cpu")
        expected = pictures.rgba[ORDER[index], ..., :3] / 255
        np.testing.assert_allclose(read_image(output.parent / "a.png")[..., :3], expected, atol=2.1 / 255)
    succeed(output.parent, "animate", "@out", "--cameras", "@out", "-o", "@a.gif", "--frames", "2", "--device", "cpu")
    assert run(output.parent, "render", "@out", "--camera", "@out:10", "-o", "@b.png") == 2
    assert "no camera '10'" in capsys.readouterr().err


def test_items_of_a_job_file_take_the_folder(output):
    lines = [{"format": "warpcage jobs", "version": 1, "defaults": {"camera": "out/cameras.json#2"}}]
    newest = "out/point_cloud/iteration_30000/point_cloud.ply"
    lines += [{"id": name, "field": field} for name, field in (("folder", "out"), ("file", newest))]
    (output.parent / "jobs.jsonl").write_text("\n".join(map(json.dumps, lines)))
    succeed(output.parent, "run", "@jobs.jsonl", "-o", "@made", "--device", "cpu")
    folder, file = ((output.parent / "made" / f"{name}.png").read_bytes() for name in ("folder", "file"))
    assert folder == file


def test_evaluate_takes_the_pictures_that_it_names(output, capsys):
    for arguments in ([], ["@out"], ["@truck"]):
        succeed(output.parent, "evaluate", "@out", *arguments, "--device", "cpu", "--json", "@report.json", "--quiet")
        report = json.loads((output.parent / "report.json").read_text())
        assert report["mean_psnr"] > 55.0 and [row["view"] for row in report["views"]] == ["view_00", "view_08"]
    (output.parent / "truck").rename(output.parent / "elsewhere")
    assert run(output.parent, "evaluate", "@out", "--device", "cpu") == 2
    assert "which is not a folder here, nor is 'truck' beside it" in capsys.readouterr().err
    succeed(output.parent, "render", "@out", "--camera", "@out:3", "-o", "@a.png", "--device", "cpu")
    (output.parent / "elsewhere").rename(output / "truck")
    assert len(load_scene(output)) == 8
    assert run(output.parent, "evaluate", "@out/point_cloud/iteration_30000/point_cloud.ply") == 2
    assert "give the folder of the scene" in capsys.readouterr().err


def test_cameras_are_those_of_the_fit(output, shown):
    """A principal point off the middle is not known to 3D Gaussian Splatting: its cameras are taken."""
    _, pictures = shown
    shutil.rmtree(output.parent / "truck")
    moved = [dataclasses.replace(camera, cx=camera.cx + 1.5) for camera in pictures.cameras]
    write_colmap(output.parent / "truck", dataclasses.replace(pictures, cameras=moved), binary=True)
    scene = load_scene(output, split="all")
    assert {camera.cx for camera in scene.cameras} == {24.0} and scene.names == pictures.names
    (output / "cfg_args").write_text((output / "cfg_args").read_text().replace("eval=True", "eval=False"))
    with pytest.warns(UserWarning, match="fitted to the pictures of 'test' too"):
        load_scene(output, split="test")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_scene(output, split="all")
    rows = json.loads((output / "cameras.json").read_text())
    rows[4]["position"][0] += 0.3
    (output / "cameras.json").write_text(json.dumps(rows))
    refused(lambda: load_scene(output), match="camera of picture 'view_03' is another")
    (output / "cameras.json").write_text(json.dumps(rows[:3]))
    refused(lambda: load_scene(output), match="has no camera for picture 'view_02' of")


def test_splats_in_the_folder_of_their_scene(tmp_path, shown, capsys):
    """The folder is the scene that it was, with a field in it."""
    field, pictures = shown
    write_colmap(tmp_path / "truck", pictures, binary=True)
    write_output(tmp_path / "truck", field, pictures.cameras, pictures.names, tmp_path / "truck", white_background=True)
    succeed(tmp_path, "info", "@truck")
    said = capsys.readouterr().out
    assert "colmap" in said and "7000, 30000: the newest" in said
    succeed(tmp_path, "evaluate", "@truck", "--device", "cpu", "--json", "@report.json", "--quiet")
    assert json.loads((tmp_path / "report.json").read_text())["mean_psnr"] > 55.0


def test_names_that_come_twice_are_message_apart_by_place(tmp_path, shown):
    field, pictures = shown
    halves = pictures.pick(range(5)), pictures.pick(range(5, 10))
    write_blender(tmp_path / "lego", halves[0], "train")
    write_blender(tmp_path / "lego", halves[1], "test")
    write_output(tmp_path / "out", field, halves[1].cameras + halves[0].cameras, halves[0].names * 2, tmp_path / "lego")
    for split, half in zip(("train", "test"), halves, strict=True):
        scene = load_scene(tmp_path / "out", split=split)
        for read, written in zip(scene.cameras, half.cameras, strict=True):
            np.testing.assert_allclose(read.camera_to_world, written.camera_to_world, atol=1e-12)


def test_pictures_of_the_size_of_the_fit(tmp_path, shown):
    field, pictures = shown
    write_colmap(tmp_path / "truck", pictures, binary=True)
    small = [camera.resized(24, 18) for camera in pictures.cameras]
    write_output(tmp_path / "out", field, small, pictures.names, tmp_path / "truck", images="images_2")
    scene = load_scene(tmp_path / "out", split="all")
    assert scene.images.shape[1:3] == (18, 24)
    assert [camera.fx for camera in scene.cameras] == pytest.approx([27.5] * 10)


@pytest.mark.parametrize(
    "text, said",
    [
        ("Namespace(source_path=open('x').read())", "names no source_path"),
        ("__import__('os').system('x')", r"must hold Namespace\(...\)"),
        ("Namespace(" + "(" * 5000, r"must hold Namespace\(...\)"),
        ("-" * 16000, r"must hold Namespace\(...\)"),
        ("x" * 20000, "must be of some hundred bytes"),
        ("Namespace(source_path='/no/where\\0')", "names no source_path|must hold"),
        ("", r"must hold Namespace\(...\)"),
        (None, "cfg_args is not there"),
        ("Namespace(source_path='/')", "is not a scene of a known format"),
    ],
)
def test_options_are_read_and_never_run(output, text, said):
    (output / "cfg_args").unlink()
    if text is not None:
        (output / "cfg_args").write_text(text)
    message = refused(lambda: load_scene(output), match=said, error=(ValueError, FileNotFoundError))
    assert len(message) < 600


def test_its_cameras_are_a_camera_file(tmp_path, shown):
    """Position and rotation as camera_to_JSON writes them, cx and cy where other versions write them too."""
    _, pictures = shown
    rows = camera_rows(pictures.cameras, pictures.names)
    rows[1] |= {"cx": 20.0, "cy": 11.0}
    (tmp_path / "cameras.json").write_text(json.dumps(rows))
    for index, (key, camera) in enumerate(
        zip(CameraFile.load(tmp_path / "cameras.json"), pictures.cameras, strict=True)
    ):
        np.testing.assert_array_equal(key.camera.camera_to_world, camera.camera_to_world)
        assert (key.camera.fx, key.camera.width, key.camera.height) == (55.0, 48, 36)
        assert (key.camera.cx, key.camera.cy) == ((20.0, 11.0) if index == 1 else (24.0, 18.0))
    for name in ("view_03", "view_03.JPG", "3"):
        assert Camera.load(tmp_path / "cameras.json", name).camera_to_world[0, 3] == pictures.cameras[3].center[0]
    (tmp_path / "cameras.json").write_text(json.dumps([row | {"img_name": f"{5 - row['id']:04}.jpg"} for row in rows]))
    for name in ("0005", "0005.png", "0005.jpg", "0"):
        assert Camera.load(tmp_path / "cameras.json", name).camera_to_world[0, 3] == pictures.cameras[0].center[0]
