"""Broken scenes: one clear line that names file and field, and nothing allocated on a claim."""

import io

import numpy as np
import pytest
from hostile import cut, gone, instead, members, put, require_refused, rows, swap, tree, whole
from refusals import refused
from scene_writers import png_bytes

from warpcage import load_scene

KINDS = ("blender", "nsvf", "dtu", "transforms", "colmap text")
EVERY = pytest.mark.parametrize("name", KINDS)

# Pictures, in every format


def a_picture(name):
    """A picture of the training split, which is not the first."""
    return [file for file in whole(name) if file.endswith(".png") and "mask" not in file][1]


def png(width, height):
    return png_bytes(width, height, 8, 2, (b"\0" + bytes(3 * width)) * height)


@EVERY
def test_missing_picture(tmp_path, name):
    picture = a_picture(name)
    stem = picture.rpartition("/")[2]
    if name == "blender":
        require_refused(name, tmp_path, {picture: None}, f"{stem} | is not there")
    elif name == "dtu":  # pairs by order: it is the number that tells
        require_refused(name, tmp_path, {picture: None}, "2 images and 3 masks", error=ValueError)
    elif name == "nsvf":  # lists the folder itself
        assert len(load_scene(put(tmp_path, whole(name) | {picture: None}))) == 2
    else:  # lists name pictures that were thrown away
        with pytest.warns(UserWarning, match=f"1 of them are not there .* {stem}"):
            load_scene(put(tmp_path, whole(name) | {picture: None}))


@EVERY
def test_pictures_that_cannot_be_read_or_fit_no_camera(tmp_path, name):
    picture = a_picture(name)
    stem, data = picture.rpartition("/")[2], whole(name)[picture]
    for broken in (b"", *(cut(share)(data) for share in (0.05, 0.5, 0.9)), png_bytes(50000, 50000, 8, 2, bytes(100))):
        require_refused(name, tmp_path, {picture: broken}, f"{stem} | cannot be read")
    if name == "blender":  # an angle of view for all sizes: a smaller picture is one of fewer pixels there
        camera = load_scene(put(tmp_path, {picture: png(12, 10)})).cameras[1]
        assert (camera.width, camera.height) == (12, 10) and load_scene(tmp_path).has_sizes
    else:
        require_refused(name, tmp_path, {picture: png(12, 10)}, f"{stem} | 12x10 | 24x20")


@EVERY
def test_what_is_not_there_and_what_there_is_no_room_for(tmp_path, name, monkeypatch):
    put(tmp_path, whole(name))
    refused(lambda: load_scene(tmp_path, split="evaluation"), "'evaluation'", "splits: ", error=FileNotFoundError)
    monkeypatch.setattr("warpcage.scene.pictures.flight_bytes", lambda *view: 1000)
    monkeypatch.setattr("warpcage.scene.pictures.free_host_bytes", lambda: 14000)
    refused(lambda: load_scene(tmp_path), "pictures of 24x20 need", "give downscale=2 or more")
    assert load_scene(tmp_path, downscale=2).images.shape[1:] == (10, 12, 3)


# Cameras

OUT = "out of the data folder"


def edit(file, change, words):
    return file, tree(change), f"{file} | {words}"


def frames(file):
    """What is wrong in the frames of a file, of the two formats that have them."""

    def frame(change, words):
        return edit(file, lambda content: change(content["frames"][0]), f"frame 0{words}")

    return [
        frame(lambda f: f["transform_matrix"][1].__setitem__(2, float("nan")), ": transform_matrix[1][2] | finite"),
        frame(lambda f: f.update(transform_matrix=np.zeros((4, 4)).tolist()), " | rotation"),
        frame(lambda f: f.update(transform_matrix=(2 * np.eye(4)).tolist()), " | rotation"),
        frame(lambda f: f.update(transform_matrix=[[1, 2], [3, 4]]), ": transform_matrix | 4x4"),
        frame(lambda f: f.pop("transform_matrix"), ": transform_matrix | None"),
        frame(lambda f: f.pop("file_path"), ": file_path"),
        frame(lambda f: f.update(file_path=7), ": file_path | 7"),
        *(
            edit(file, lambda c, path=path: c["frames"][0].update(file_path=path), f"file_path | {OUT}")
            for path in ("../../outside.png", "/etc/passwd", "images\\..\\..\\outside")
        ),
        edit(file, lambda c: c["frames"].append(c["frames"][0]), "frame 3 | listed twice | frame 0"),
        edit(file, lambda c: c.update(frames=[]), "no frames"),
        edit(file, lambda c: c.update(frames=[1]), "frame 0 must be a JSON object"),
        *((file, cut(share), f"{file} is not a JSON file") for share in (0.0, 0.01, 0.5, 0.99)),
    ]


def npy(values):
    stream = io.BytesIO()
    np.save(stream, values)
    return instead(stream.getvalue())


ARKIT_POSES = "41069021_frames/lowres_wide.traj"
ARKIT_LENS = "41069021_frames/lowres_wide_intrinsics/41069021_3454.326.pincam"
MODEL = "sparse/0/"
POSE = "pose/0_view_01.txt"
SKEWED = np.eye(4) + np.eye(4, k=1) * [0, 0.5, 0, 0]

#: By formats: a file, what is done to it, and what is said.
CAMERAS = {
    "blender": [
        *frames("transforms_train.json"),
        edit("transforms_train.json", lambda c: c.update(camera_angle_x=0.0), "camera_angle_x"),
        edit("transforms_train.json", lambda c: c.update(fl_x=9.0, w=24, h=21), "24x21 pixels"),
        ("transforms_train.json", instead(b"\xff\xfe{"), "not a JSON file"),
        ("transforms_train.json", instead(b"[" * 100000), "not a JSON file"),
        ("transforms_train.json", instead(b"[1]"), "must hold a JSON object"),
        ("transforms_train.json", instead(b"{}"), "not a scene of a known format"),
    ],
    "transforms": [
        *frames("transforms.json"),
        *(
            edit("transforms.json", change, words)
            for change, words in [
                (lambda c: c.update(fl_x="wide"), "fl_x | finite number | 'wide'"),
                (lambda c: c.update(fl_x=-3), "fl_x must be positive"),
                (lambda c: (c.pop("fl_x"), c.pop("fl_y")), "no fl_x and no camera_angle_x"),
                (lambda c: c.update(w=48), "48x20 | has 24x20"),
                (lambda c: c.pop("h"), ": h must be one finite number"),
                (lambda c: c.update(camera_model="FISHEYE_OF_OURS"), "camera_model 'FISHEYE_OF_OURS' is not read"),
                (lambda c: c.update(k4=0.1), "k4"),
                (lambda c: c.update(k1=1e9), "lens distortion k1=1e+09"),
                (lambda c: c.update(k1=10**400), "k1 must be one finite number"),
                (lambda c: c["frames"][1].update(mask_path="../mask.png"), f"mask_path | {OUT}"),
                (lambda c: c.update(applied_transform=np.zeros((3, 4)).tolist()), "applied_transform is singular"),
                (lambda c: c.update(ply_file_path="../points.ply"), f"ply_file_path | {OUT}"),
                (lambda c: c.update(applied_transform=5), "applied_transform must be a 4x4 matrix"),
                (lambda c: c.update(train_filenames=["images/other.png"]), "train_filenames names 'other.png'"),
                (lambda c: c.update(train_filenames=[]), "train_filenames must list"),
                (lambda c: c.update(train_filenames=["images/view_01.png"] * 2), "listed twice"),
            ]
        ),
        ("masks/view_01.png", instead(png(4, 4)), "mask 'view_01.png' is 4x4"),
        ("masks/view_01.png", gone, "masks/view_01.png | is not there"),
    ],
    "nsvf": [
        (POSE, gone, "0_view_01.txt | is not there"),
        (POSE, instead("1 0 0"), "0_view_01.txt | 4x4 pose expected, got 3 numbers"),
        (POSE, instead("nan " * 16), "0_view_01.txt | not finite"),
        (POSE, instead("one " * 16), "0_view_01.txt | 'one'"),
        (POSE, instead("0 " * 16), "0_view_01.txt | rotation"),
        ("intrinsics.txt", instead(""), "intrinsics.txt | got 0 numbers"),
        ("intrinsics.txt", instead("-30 0 12 0 30 10 0 0 1"), "focal lengths must be positive"),
        ("intrinsics.txt", instead("30 1 12 0 30 10 0 0 1"), "intrinsics.txt | skew"),
        ("bbox.txt", instead("1 1 1 0 0 0"), "bbox.txt | lower below upper"),
        ("bbox.txt", instead("1 1"), "bbox.txt | got 2 numbers"),
    ],
    "dtu": [
        ("cameras_sphere.npz", members(arrays), f"cameras_sphere.npz | {words}")
        for arrays, words in [
            ({"world_mat_1": None}, "lacks world_mat_1"),
            ({"world_mat_1": np.full((4, 4), np.nan)}, "world_mat_1 must be a finite 4x4 matrix"),
            ({"world_mat_1": np.ones((4, 4))}, "world_mat_1 @ scale_mat_1 is singular"),
            ({"world_mat_1": np.ones((2, 2))}, "world_mat_1 must be a finite 4x4"),
            ({"scale_mat_1": np.zeros((4, 4))}, "is singular"),
            ({"scale_mat_1": np.array(["a"])}, "scale_mat_1 must be"),
            ({"scale_mat_1": SKEWED}, "skew"),
            ({"world_mat_9": np.array([{}], object)}, "'world_mat_9' holds pickled objects, which are never opened"),
        ]
    ],
    "colmap text": [
        (f"{MODEL}images.txt", swap("view_01.png", "../../outside.png"), f"images.txt | {OUT}"),
        (f"{MODEL}images.txt", swap("view_01.png", "view_02.png"), "view_02.png | listed twice"),
        (f"{MODEL}images.txt", instead("# none\n"), "images.txt holds no images"),
        (f"{MODEL}cameras.txt", swap("2 PINHOLE", "9 PINHOLE"), "camera 2, which | cameras.txt lacks"),
        (f"{MODEL}cameras.txt", swap("2 PINHOLE", "2 LENS"), "cameras.txt | 'LENS' is not read"),
        (f"{MODEL}cameras.txt", swap("2 PINHOLE", "2 OPENCV"), "camera 2 needs 8 parameters"),
        (f"{MODEL}cameras.txt", swap("2 PINHOLE", "two PINHOLE"), "cameras.txt:3 | 'two'"),
        (f"{MODEL}cameras.txt", swap("2 PINHOLE 24 20 31.0", "2 PINHOLE 24 20 nan"), "cameras.txt:3 | not finite"),
        (f"{MODEL}cameras.txt", swap("2 PINHOLE 24 20", "2 PINHOLE 48 40"), "camera is for 48x40 pixels"),
        (f"{MODEL}cameras.txt", swap("2 PINHOLE", "2"), "cameras.txt:3"),
        (f"{MODEL}cameras.txt", instead("1 PINHOLE 24\n"), "CAMERA_ID MODEL WIDTH HEIGHT PARAMS expected"),
        (f"{MODEL}images.txt", instead("1 1 0 0 0\n"), "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME expected"),
        (f"{MODEL}points3D.txt", instead("1 0 0\n"), "POINT3D_ID X Y Z expected"),
        (f"{MODEL}images.txt", instead(b"\xff\xfe{"), "images.txt is not a text file"),
    ],
    "colmap binary": [
        row
        for name in ("cameras.bin", "images.bin", "points3D.bin")
        for row in [
            *((MODEL + name, lambda data, size=size: data[:size], name) for size in (0, 5, 8, 40, -1)),
            (MODEL + name, cut(0.5), name),
            (MODEL + name, lambda data: b"\xff" * 8 + data[8:], f"{name} | announces 18446744073709551615 records"),
        ]
    ],
    "bundler": [
        ("bundle/bundle.out", swap("3 30\n", "99999999999 30\n"), "announces 99999999999 cameras"),
        ("bundle/bundle.out", swap("3 30\n", "-1 30\n"), "announces -1 cameras"),
        ("bundle/bundle.out", swap("\n2 0 7", "\n9999999999 0 7"), "a list of pictures expected"),
        ("bundle/bundle.out", swap("3 30\n31.0", "3 30\nnan"), "not finite"),
        ("list.txt", instead("images/view_00.png 0 31.0\n"), "has 3 cameras"),
        ("bundle/bundle.out", swap("v0.3", "v0.1"), "must begin with '# Bundle file v0.3'"),
    ],
    "realityscan": [
        ("cameras.csv", lambda data: data.splitlines()[0], "has no camera"),
        ("cameras.csv", swap(",f,", ",g,"), "lacks the columns f"),
        ("cameras.csv", swap("view_01.png,", "view_01.png;"), "16 values expected"),
    ],
    "record3d": [
        ("metadata.json", swap('"poses": [[', '"poses": [[NaN, '), "must hold 7 numbers"),
        ("metadata.json", swap('"poses": [[', '"poses": [[0,0,0,0,1,2,3], ['), "picture 0"),
    ],
    "arkitscenes": [
        (ARKIT_POSES, swap("3454.2254", "3454.2254 1"), "7 numbers, expected, got 8"),
        (ARKIT_POSES, swap("3454.325400 ", "3454.325400 nan "), "not finite"),
        (ARKIT_LENS, swap("24 20 31.0", "24 20 -31.0"), "the first four above zero"),
        (ARKIT_LENS, swap("24 20 31.0", "1e300 20 31.0"), "1e+300"),
    ],
    "stray": [
        ("odometry.csv", swap("qw", "w"), "lacks the columns qw"),
        ("odometry.csv", swap("0.0000, 000000", "000000"), "9 values expected"),
        ("camera_matrix.csv", swap("31.0", "31.0, 1"), "must hold 9 numbers, got 10"),
        ("camera_matrix.csv", swap("31.0", "0.0"), "focal"),
    ],
    "opensfm": [
        ("reconstruction.json", swap('"width": 24', '"width": 1e300'), "1e+300x20 pixels"),
        ("reconstruction.json", swap('"width": 24', '"width": null'), "width of its camera"),
        ("reconstruction.json", swap('"rotation": [', '"rotation": [NaN, '), "must hold 3 numbers"),
        ("reconstruction.json", swap('"focal_x": 1', '"focal_x": 1e999, "x": 1'), "focal_x"),
        ("reconstruction.json", swap('"brown"', '["brown"]'), "projection_type"),
        ("reconstruction.json", swap('[{"cameras"', '{"cameras": [], "x": [{"cameras"'), "JSON"),
    ],
    "metashape": [
        ("cameras.xml", swap("</chunk>", ""), "is not an XML file"),
        ("cameras.xml", swap('<scale locked="true">1.0', "<scale>-1.0"), "above zero"),
        ("cameras.xml", swap("<transform>", "<transform>nan "), "not finite"),
        ("cameras.xml", swap("<transform>", "<transform>1 "), "must hold 16 numbers, got 17"),
        ("cameras.xml", swap('<resolution width="24"', '<resolution width="1e9"'), "pixels"),
        ("cameras.xml", swap('sensor_id="1"', 'sensor_id="77"'), "sensor '77'"),
    ],
    "llff": [
        *(
            ("poses_bounds.npy", npy(values), words)
            for values, words in [
                (np.full((3, 17), np.nan), "not finite"),
                (np.zeros((3, 17)), "must be positive"),
                (np.zeros((3, 17), "M8[s]"), "neither numbers nor text"),
                (np.zeros((3, 17), complex), "must hold numbers"),
                (np.array([None] * 51).reshape(3, 17), "pickled"),
                (np.zeros(51), "must be (n, 17)"),
                (np.zeros((0, 17)), "must be (n, 17)"),
            ]
        ),
        ("poses_bounds.npy", swap("(3, 17), }", "(3999999999999, 17), }"), "poses_bounds.npy"),
    ],
}


@pytest.mark.parametrize("name, file, damage, words", rows(CAMERAS))
def test_wrong_cameras(tmp_path, name, file, damage, words):
    require_refused(name, tmp_path, {file: damage(whole(name)[file])}, words)
    if file == "masks/view_01.png":
        assert load_scene(tmp_path, masks=False).alphas is None


def test_an_empty_split(tmp_path):
    pairs = {file: data for file, data in whole("dtu").items() if file.endswith((".npz", "000000.png", "000.png"))}
    dtu = put(tmp_path / "dtu", pairs)
    refused(lambda: load_scene(dtu), "split 'train'", "is empty")
    assert len(load_scene(dtu, split="test")) == 1
    nsvf = put(tmp_path / "nsvf", {"intrinsics.txt": b"30 12 10 0\n"})
    (nsvf / "rgb").mkdir()
    (nsvf / "pose").mkdir()
    refused(lambda: load_scene(nsvf), "rgb", "holds no pictures", error=FileNotFoundError)


def test_a_format_that_is_not_there(tmp_path):
    put(tmp_path, whole("blender"))
    for name, words in {"nsvf": "intrinsics.txt", "dtu": "cameras_sphere.npz", "colmap": "no COLMAP model"}.items():
        refused(lambda name=name: load_scene(tmp_path, format=name), words, error=FileNotFoundError)
