"""Scenes made to be misread: memory is counted before pictures are read, and nothing outside the folder is."""

import functools
import json
import shutil
import threading
import time
import tracemalloc

import numpy as np
import pytest
from messages import MESSAGES
from phone_writers import write_arkitscenes, write_polycam, write_record3d, write_stray
from program_writers import write_bundler, write_llff, write_metashape, write_opensfm, write_realityscan
from scene_writers import (
    brick_pictures,
    write_blender,
    write_colmap,
    write_deep_png,
    write_dtu,
    write_nsvf,
    write_transforms,
)

from warpcage import load_scene
from warpcage.scene import pictures as views
from warpcage.scene import undistort
from warpcage.view import read_image, read_rows, shrink, write_png

# Memory


@pytest.fixture(scope="module")
def pictures():
    return brick_pictures(3)


def noise(width, height, channels, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (height, width, channels), dtype=np.uint8)


def one_file_scene(folder, picture, count, *, frame=None):
    """A transforms.json of one picture, copied."""
    (folder / "images").mkdir(parents=True)
    write_png(folder / "images" / "0.png", picture)
    for k in range(1, count):
        shutil.copy(folder / "images" / "0.png", folder / "images" / f"{k}.png")
    pose = np.eye(4)
    frames = []
    for k in range(count):
        pose[0, 3] = k
        frames.append({"file_path": f"images/{k}.png", "transform_matrix": pose.tolist(), **(frame or {})})
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 100.0, "frames": frames}))
    return folder


@pytest.mark.parametrize(
    "size, factor, lens",
    [((1536, 960), 12, False), ((1531, 967), 12, False), ((640, 480), 2, True), ((700, 500), 1, False)],
)
def test_strips_are_the_whole_picture_to_the_bit(tmp_path, monkeypatch, size, factor, lens):
    picture = noise(*size, 4)
    distortion = {"k1": -0.05, "p1": 0.001} if lens else {}
    folder = one_file_scene(tmp_path / "scene", picture, 1, frame=distortion)
    rgba = picture / np.float32(255)
    rgba[..., :3] *= rgba[..., 3:]
    view = views.View(folder / "images" / "0.png", np.eye(4), "", (100.0, 100.0, size[0] / 2, size[1] / 2), None)
    if lens:
        view.distortion = (-0.05, 0.0, 0.001, 0.0, 0.0)
        given = view.intrinsics
        rgba = undistort(rgba, given, views.pinhole_intrinsics(view, given, size), view.distortion)
    whole = shrink(rgba, factor).astype(np.float32)
    background = np.float32([0.2, 0.4, 0.6])
    for strip in (1 << 16, 1 << 30):
        monkeypatch.setattr(views, "STRIP_BYTES", strip)
        scene = load_scene(folder, split="all", downscale=factor, background=background)
        np.testing.assert_array_equal(scene.alphas[0], whole[..., 3])
        np.testing.assert_array_equal(scene.images[0], whole[..., :3] + (1 - whole[..., 3:]) * background)


def test_pictures_are_shrunk_without_whole_ones_in_floats(tmp_path, monkeypatch):
    monkeypatch.setattr(views, "STRIP_BYTES", 1 << 18)
    side, count = 1200, 4
    folder = one_file_scene(tmp_path / "scene", np.zeros((side, side, 3), np.uint8), count)
    tracemalloc.start()
    scene = load_scene(folder, split="all", downscale=20)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert scene.images.shape == (count, 60, 60, 3)
    # a whole picture in floats is 23 MB, and each reading thread had three to five of them
    assert peak < 0.5 * 16 * side * side


@pytest.mark.parametrize("factor, lens", [(1, False), (8, False), (7, False), (2, True)])
def test_a_picture_takes_no_more_than_is_counted(tmp_path, factor, lens):
    size = (800, 600)
    distortion = {"k1": -0.05} if lens else {}
    folder = one_file_scene(tmp_path / "scene", noise(*size, 4), 1, frame=distortion)
    view = views.View(folder / "images" / "0.png", np.eye(4), "", (1, 1, 1, 1), None, (-0.05,) if lens else ())
    load_scene(folder, split="all", downscale=factor)  # what is imported on the way
    tracemalloc.start()
    load_scene(folder, split="all", downscale=factor)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    held = 17 * np.prod([side / factor for side in size])
    assert peak < held + views.flight_bytes(view, size, factor, False)


def test_threads_read_as_many_pictures_as_there_is_memory_for(tmp_path, monkeypatch):
    folder, size = one_file_scene(tmp_path / "scene", noise(96, 64, 3), 8), (96, 64)
    view = views.View(folder, np.eye(4), "", (1, 1, 1, 1), None)
    flight, held = views.flight_bytes(view, size, 1, False), 8 * 96 * 64 * 17
    changed, now, most, expected = threading.Condition(), [0], [0], 0

    def counted(path, **options):
        with changed:
            now[0] += 1
            most[0] = max(most[0], now[0])
            changed.notify_all()
            changed.wait_for(lambda: most[0] >= expected, timeout=20)  # until all have come in that may
        time.sleep(0.02)  # so that one too many would, too
        with changed:
            now[0] -= 1
        return read_rows(path, **options)

    monkeypatch.setattr(views, "read_rows", counted)
    monkeypatch.setattr(views.os, "cpu_count", lambda: 8)
    for free, expected in ((held + flight + 1, 1), (held + 3 * flight, 3), (held + 100 * flight, 8)):
        monkeypatch.setattr(views, "free_host_bytes", lambda free=free: free)
        most[0] = 0
        load_scene(folder, split="all")
        assert most[0] == expected
    monkeypatch.setattr(views, "free_host_bytes", lambda: flight)
    with pytest.raises(ValueError, match=MESSAGES["scene.picture_memory"]):
        load_scene(folder, split="all")


def test_rows_are_those_of_the_whole_picture(tmp_path):
    from PIL import Image

    color = noise(33, 21, 3)
    Image.fromarray(color).convert("P").save(tmp_path / "palette.png")
    Image.fromarray(color).save(tmp_path / "colour.jpg")
    Image.fromarray(color[..., 0]).save(tmp_path / "grey.png")
    write_deep_png(tmp_path / "deep.png", color.astype(np.uint16) * 257)
    for name in ("palette.png", "colour.jpg", "grey.png", "deep.png"):
        whole, rows = read_image(tmp_path / name), read_rows(tmp_path / name)
        for first, last in ((0, 5), (5, 21), (20, 400), (0, None)):
            np.testing.assert_array_equal(rows(first, last), whole[first:last])


# Names


def test_names_that_look_like_addresses_are_files(tmp_path, monkeypatch):
    image = np.random.default_rng(0).integers(0, 65536, (6, 8, 3), dtype=np.uint16)
    monkeypatch.chdir(tmp_path)
    for name in ("a:b.png", "http:b.png", "imageio:chelsea.png", "concat:x|y.png"):
        write_deep_png(tmp_path / name, image)  # these were opened by name, as protocols
        np.testing.assert_array_equal(np.round(read_image(name) * 65535), image)
        write_png(name, image.astype(np.float64) / 65535)
        assert read_image(name).shape == (6, 8, 3)


FOLDERS = {
    "blender": (write_blender, "train"),
    "nsvf": (lambda folder, pictures: write_nsvf(folder, pictures, "000"), "rgb"),
    "dtu": (write_dtu, "image"),
    "transforms": (lambda folder, pictures: write_transforms(folder, pictures, masks=True), "images"),
    "colmap": (lambda folder, pictures: write_colmap(folder, pictures, binary=False), "images"),
    "polycam": (write_polycam, "keyframes/images"),
    "record3d": (write_record3d, "rgb"),
    "arkitscenes": (functools.partial(write_arkitscenes, place="", between=False), "lowres_wide"),
    "stray": (write_stray, "rgb"),
    "llff": (write_llff, "images"),
    "bundler": (write_bundler, "images"),
    "opensfm": (write_opensfm, "images"),
    "realityscan": (write_realityscan, "images"),
    "metashape": (write_metashape, "images"),
}


@pytest.fixture(params=FOLDERS)
def scene(tmp_path, pictures, request):
    """A scene's folder, the folder of its pictures, and its split of all pictures."""
    write, images = FOLDERS[request.param]
    write(tmp_path / "scene", pictures)
    split = "train" if request.param in ("blender", "nsvf") else "all"
    return tmp_path / "scene", tmp_path / "scene" / images, split


def test_a_picture_that_is_a_link_out_of_the_folder_is_refused(scene, tmp_path):
    folder, images, split = scene
    whole = load_scene(folder, split=split)
    picture = sorted(images.glob("*.png"))[1]
    outside = picture.rename(tmp_path / "outside.png")
    picture.symlink_to(outside)
    with pytest.raises(ValueError) as error:
        load_scene(folder, split=split)
    assert "leads out of the data folder" in str(error.value) and picture.name in str(error.value)
    assert "\n" not in str(error.value)
    picture.unlink()
    (folder / "elsewhere").mkdir()
    picture.symlink_to(outside.rename(folder / "elsewhere" / "inside.png"))  # a link that stays in the folder
    np.testing.assert_array_equal(load_scene(folder, split=split).images, whole.images)


def test_a_link_to_a_whole_folder_may_lead_anywhere_but_not_links_in_it(scene, tmp_path):
    folder, images, split = scene
    whole = load_scene(folder, split=split)
    images = folder / images.relative_to(folder).parts[0]
    captures = images.rename(tmp_path / "captures")
    images.symlink_to(captures)
    np.testing.assert_array_equal(load_scene(folder, split=split).images, whole.images)
    np.testing.assert_array_equal(load_scene(_linked(folder, tmp_path), split=split).images, whole.images)
    picture = sorted(captures.rglob("*.png"))[1]
    picture.symlink_to(picture.rename(tmp_path / "outside.png"))
    with pytest.raises(ValueError, match="leads out of the data folder"):
        load_scene(folder, split=split)


def _linked(folder, tmp_path):
    """The scene's folder by another name."""
    (tmp_path / "by_link").symlink_to(folder)
    return tmp_path / "by_link"


def test_masks_poses_and_points_may_not_be_links_out(tmp_path, pictures):
    write_nsvf(tmp_path / "nsvf", pictures, "000")
    pose = min((tmp_path / "nsvf" / "pose").glob("*.txt"))
    pose.symlink_to(pose.rename(tmp_path / "pose.txt"))
    with pytest.raises(ValueError, match="leads out of the data folder"):
        load_scene(tmp_path / "nsvf")
    write_dtu(tmp_path / "dtu", pictures)
    mask = sorted((tmp_path / "dtu" / "mask").glob("*.png"))[1]
    mask.symlink_to(mask.rename(tmp_path / "mask.png"))
    with pytest.raises(ValueError, match="leads out of the data folder"):
        load_scene(tmp_path / "dtu")
    load_scene(tmp_path / "dtu", masks=False)
    write_transforms(tmp_path / "points", pictures)
    path = tmp_path / "points" / "transforms.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"ply_file_path": "points.ply"}))
    (tmp_path / "points" / "points.ply").symlink_to(tmp_path / "elsewhere.ply")
    with pytest.raises(ValueError, match=MESSAGES["scene.link_out"]):
        load_scene(tmp_path / "points", split="all")


@pytest.mark.parametrize("name", [".", "./", "images/..", "images/../."])
def test_a_picture_is_not_the_folder_itself(tmp_path, pictures, name):
    write_transforms(tmp_path / "scene", pictures)
    shutil.copy(next((tmp_path / "scene").rglob("*.png")), tmp_path / "scene.png")  # beside the folder
    path = tmp_path / "scene" / "transforms.json"
    content = json.loads(path.read_text())
    content["frames"][0]["file_path"] = name
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match="file_path: .* is the data folder"):
        load_scene(tmp_path / "scene", split="all")


def test_names_with_steps_back_and_whole_paths_inside_the_folder_are_read(tmp_path, pictures):
    write_transforms(tmp_path / "scene", pictures)
    whole = load_scene(tmp_path / "scene", split="all")
    path = tmp_path / "scene" / "transforms.json"
    content = json.loads(path.read_text())
    first, second = (frame["file_path"] for frame in content["frames"][:2])
    content["frames"][0]["file_path"] = f"images/../{first}"
    content["frames"][1]["file_path"] = str(tmp_path / "scene" / second)
    path.write_text(json.dumps(content))
    np.testing.assert_array_equal(load_scene(tmp_path / "scene", split="all").images, whole.images)


# Values of other programs' files


#: Files of ARKitScenes.
ARKIT_POSES = "41069021_frames/lowres_wide.traj"
ARKIT_LENS = "41069021_frames/lowres_wide_intrinsics/41069021_3454.326.pincam"

#: A writer, its file, what is put in place of what, and what is said: counts, types and numbers that cannot be.
DAMAGED = {
    "bundler counts": (
        write_bundler,
        "bundle/bundle.out",
        "3 30\n",
        "99999999999 30\n",
        "announces 99999999999 cameras",
    ),
    "bundler negative": (write_bundler, "bundle/bundle.out", "3 30\n", "-1 30\n", "announces -1 cameras"),
    "bundler list": (write_bundler, "bundle/bundle.out", "\n2 0 7", "\n9999999999 0 7", "a list of pictures expected"),
    "bundler NaN": (write_bundler, "bundle/bundle.out", "3 30\n31.0", "3 30\nnan", "not finite"),
    "realityscan column": (write_realityscan, "cameras.csv", ",f,", ",g,", "lacks the columns f"),
    "realityscan row": (write_realityscan, "cameras.csv", "view_01.png,", "view_01.png;", "16 values expected"),
    "bundler version": (write_bundler, "bundle/bundle.out", "v0.3", "v0.1", "must begin with '# Bundle file v0.3'"),
    "record3d NaN": (write_record3d, "metadata.json", '"poses": [[', '"poses": [[NaN, ', "must hold 7 numbers"),
    "record3d no turn": (write_record3d, "metadata.json", '"poses": [[', '"poses": [[0,0,0,0,1,2,3], [', "picture 0"),
    "arkitscenes line": (write_arkitscenes, ARKIT_POSES, "3454.2254", "3454.2254 1", "7 numbers, expected, got 8"),
    "arkitscenes NaN": (write_arkitscenes, ARKIT_POSES, "3454.325400 ", "3454.325400 nan ", "not finite"),
    "arkitscenes lens": (write_arkitscenes, ARKIT_LENS, "24 20 31.0", "24 20 -31.0", "the first four above zero"),
    "arkitscenes size": (write_arkitscenes, ARKIT_LENS, "24 20 31.0", "1e300 20 31.0", "1e+300"),
    "stray columns": (write_stray, "odometry.csv", "qw", "w", "lacks the columns qw"),
    "stray row": (write_stray, "odometry.csv", "0.0000, 000000", "000000", "9 values expected"),
    "stray matrix": (write_stray, "camera_matrix.csv", "31.0", "31.0, 1", "must hold 9 numbers, got 10"),
    "stray focal": (write_stray, "camera_matrix.csv", "31.0", "0.0", "focal"),
    "opensfm size": (write_opensfm, "reconstruction.json", '"width": 24', '"width": 1e300', "1e+300x20 pixels"),
    "opensfm no size": (write_opensfm, "reconstruction.json", '"width": 24', '"width": null', "width of its camera"),
    "opensfm NaN": (write_opensfm, "reconstruction.json", '"rotation": [', '"rotation": [NaN, ', "must hold 3 numbers"),
    "opensfm infinite": (write_opensfm, "reconstruction.json", '"focal_x": 1', '"focal_x": 1e999, "x": 1', "focal_x"),
    "opensfm kind": (write_opensfm, "reconstruction.json", '"brown"', '["brown"]', "projection_type"),
    "opensfm object": (write_opensfm, "reconstruction.json", '[{"cameras"', '{"cameras": [], "x": [{"cameras"', "JSON"),
    "metashape cut": (write_metashape, "cameras.xml", "</chunk>", "", "is no XML file"),
    "metashape scale": (write_metashape, "cameras.xml", '<scale locked="true">1.0', "<scale>-1.0", "above zero"),
    "metashape NaN": (write_metashape, "cameras.xml", "<transform>", "<transform>nan ", "not finite"),
    "metashape matrix": (
        write_metashape,
        "cameras.xml",
        "<transform>",
        "<transform>1 ",
        "must hold 16 numbers, got 17",
    ),
    "metashape size": (write_metashape, "cameras.xml", '<resolution width="24"', '<resolution width="1e9"', "pixels"),
    "metashape sensor": (write_metashape, "cameras.xml", 'sensor_id="1"', 'sensor_id="77"', "sensor '77'"),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_values_that_cannot_be_are_refused(tmp_path, pictures, name):
    write, file, old, new, said = DAMAGED[name]
    write(tmp_path, pictures)
    text = (tmp_path / file).read_text()
    assert old in text
    (tmp_path / file).write_text(text.replace(old, new))
    with pytest.raises(ValueError) as error:
        load_scene(tmp_path)
    assert said in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    "values, said",
    [
        (np.full((3, 17), np.nan), "not finite"),
        (np.zeros((3, 17)), "must be positive"),
        (np.zeros((3, 17), "M8[s]"), "neither numbers nor text"),
        (np.zeros((3, 17), complex), "must hold numbers"),
        (np.array([None] * 51).reshape(3, 17), "pickled"),
        (np.zeros(51), r"must be (n, 17)"),
        (np.zeros((0, 17)), r"must be (n, 17)"),
    ],
)
def test_poses_that_cannot_be_are_refused(tmp_path, pictures, values, said):
    write_llff(tmp_path, pictures)
    np.save(tmp_path / "poses_bounds.npy", values)
    with pytest.raises(ValueError) as error:
        load_scene(tmp_path)
    assert said in str(error.value) and "\n" not in str(error.value)


def test_poses_that_claim_more_than_the_file_has(tmp_path, pictures):
    write_llff(tmp_path, pictures)
    path = tmp_path / "poses_bounds.npy"
    path.write_bytes(path.read_bytes().replace(b"(3, 17), }", b"(3999999999999, 17), }", 1))
    with pytest.raises(ValueError, match="poses_bounds.npy"):
        load_scene(tmp_path)
