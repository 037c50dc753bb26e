"""Scenes made to be misread: memory is counted before pictures are read, and nothing outside the folder is."""

import json
import shutil
import threading

import numpy as np
import pytest
from hostile import SCENES, put, whole
from messages import MESSAGES
from refusals import peak_of, refused
from scene_writers import change_json, write_deep_png

from warpcage import load_scene
from warpcage.scene import pictures as views
from warpcage.scene import undistort
from warpcage.view import read_image, read_rows, shrink, write_png

# Memory


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
    [((768, 480), 12, False), ((763, 487), 12, False), ((320, 240), 2, True), ((350, 250), 1, False)],
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
    for strip in (1 << 15, 1 << 30):
        monkeypatch.setattr(views, "STRIP_BYTES", strip)
        scene = load_scene(folder, split="all", downscale=factor, background=background)
        np.testing.assert_array_equal(scene.alphas[0], whole[..., 3])
        np.testing.assert_array_equal(scene.images[0], whole[..., :3] + (1 - whole[..., 3:]) * background)


def test_pictures_are_shrunk_without_whole_ones_in_floats(tmp_path, monkeypatch):
    monkeypatch.setattr(views, "STRIP_BYTES", 1 << 18)
    side, count = 1200, 3
    folder = one_file_scene(tmp_path / "scene", np.zeros((side, side, 3), np.uint8), count)
    peak, scene = peak_of(lambda: load_scene(folder, split="all", downscale=20))
    assert scene.images.shape == (count, 60, 60, 3)
    # a whole picture in floats is 23 MB, and each reading thread had three to five of them
    assert peak < 0.5 * 16 * side * side


@pytest.mark.parametrize("factor, lens", [(1, False), (8, False), (7, False), (2, True)])
def test_a_picture_takes_no_more_than_is_counted(tmp_path, factor, lens):
    size = (400, 300)
    distortion = {"k1": -0.05} if lens else {}
    folder = one_file_scene(tmp_path / "scene", noise(*size, 4), 1, frame=distortion)
    view = views.View(folder / "images" / "0.png", np.eye(4), "", (1, 1, 1, 1), None, (-0.05,) if lens else ())
    load_scene(folder, split="all", downscale=factor)  # what is imported on the way
    peak, _ = peak_of(lambda: load_scene(folder, split="all", downscale=factor))
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
            changed.wait_for(lambda: most[0] > expected, timeout=0.02)  # one too many would, too
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
    refused(lambda: load_scene(folder, split="all"), match=MESSAGES["scene.picture_memory"])


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


LEADS_OUT = "leads out of the data folder"


def moved_for_link(path, to):
    """A link in place of a file or folder, which is elsewhere now."""
    path.symlink_to(path.rename(to))


@pytest.mark.parametrize("name", [name for name in SCENES if name != "3dgs"])  # whose pictures are another scene's
@pytest.mark.filterwarnings("ignore:.* its pictures smaller alone")
def test_links_may_lead_out_of_the_folder_as_a_whole_but_not_from_within(name, tmp_path):
    """A picture that is a link out is refused, and one in a folder that is a link as a whole, which may be."""
    folder = put(tmp_path / "scene", whole(name))
    split = "train" if name in ("blender", "nsvf", "nerfies", "nerfpp") else "all"
    seen = load_scene(folder, split=split).images
    pictures = [path for path in sorted(folder.rglob("*.png")) if "mask" not in path.parent.name]
    picture = pictures[2 if name == "arkitscenes" else 1]  # there, each second one is between poses
    moved_for_link(picture, tmp_path / "outside.png")
    refused(lambda: load_scene(folder, split=split), LEADS_OUT, picture.name)
    picture.unlink()
    (folder / "elsewhere").mkdir()
    picture.symlink_to((tmp_path / "outside.png").rename(folder / "elsewhere" / "inside.png"))  # stays in the folder
    np.testing.assert_array_equal(load_scene(folder, split=split).images, seen)
    (folder / "elsewhere" / "inside.png").replace(picture)
    (folder / "elsewhere").rmdir()
    first = folder / picture.relative_to(folder).parts[0]
    moved_for_link(first, tmp_path / "captures")
    np.testing.assert_array_equal(load_scene(folder, split=split).images, seen)
    (tmp_path / "by_link").symlink_to(folder)
    np.testing.assert_array_equal(load_scene(tmp_path / "by_link", split=split).images, seen)
    moved_for_link(picture, tmp_path / "outside.png")
    refused(lambda: load_scene(folder, split=split), LEADS_OUT, picture.name)


def test_masks_poses_and_points_may_not_be_links_out(tmp_path):
    for name, file in (
        ("nsvf", "pose/0_view_00.txt"),
        ("dtu", "mask/001.png"),
        ("transforms", "masks/view_01.png"),
        ("scannet", "pose/1.txt"),
        ("scannet", "intrinsic/intrinsic_color.txt"),
        ("replica", "traj.txt"),
        ("replica", "cam_params.json"),
        ("nerfies", "camera/view_01.json"),
        ("nerfies", "points.npy"),
        ("blendedmvs", "cams/00000001_cam.txt"),
        ("nerfpp", "train/pose/view_01.txt"),
        ("3dgs", "cfg_args"),
    ):
        folder = put(tmp_path / f"{name} {file.replace('/', ' ')}", whole(name))
        moved_for_link(folder / file, tmp_path / f"{folder.name} elsewhere")
        refused(lambda folder=folder: load_scene(folder), LEADS_OUT)
    load_scene(tmp_path / "dtu mask 001.png", masks=False)
    folder = put(tmp_path / "points", whole("transforms"))
    change_json(folder / "transforms.json", lambda content: content.update(ply_file_path="points.ply"))
    (folder / "points.ply").symlink_to(tmp_path / "elsewhere.ply")
    refused(lambda: load_scene(folder, split="all"), match=MESSAGES["scene.link_out"])


def test_names_of_pictures_are_paths_inside_the_folder(tmp_path):
    """With steps back and as whole paths, but not the folder itself."""
    folder = put(tmp_path / "scene", whole("transforms"))
    seen = load_scene(folder, split="all").images

    def rename(content):
        first, second = content["frames"][:2]
        first["file_path"] = f"images/../{first['file_path']}"
        second["file_path"] = str(folder / second["file_path"])

    change_json(folder / "transforms.json", rename)
    np.testing.assert_array_equal(load_scene(folder, split="all").images, seen)
    shutil.copy(folder / "images" / "view_00.png", tmp_path / "scene.png")  # beside the folder
    for name in (".", "./", "images/..", "images/../."):
        change_json(folder / "transforms.json", lambda content, name=name: content["frames"][0].update(file_path=name))
        refused(lambda: load_scene(folder, split="all"), "file_path: ", " is the data folder")
