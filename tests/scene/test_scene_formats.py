"""Scenes written in each format come back: cameras, pictures, splits, masks, distortion undone."""

import json

import numpy as np
import pytest
from messages import MESSAGES
from scene_writers import (
    MODEL_NUMBERS,
    Pictures,
    brick_pictures,
    spiral_cameras,
    write_blender,
    write_colmap,
    write_dtu,
    write_image,
    write_nsvf,
    write_transforms,
)

from warpcage import Camera, load_scene
from warpcage.scene import COEFFICIENTS, distort, undistort, undistorted_intrinsics

BACKGROUND = (0.1, 0.5, 0.9)


@pytest.fixture(scope="module")
def centered():
    return brick_pictures(6, centered=True)


def require_equal(scene, pictures, *, tolerance=1e-5, image_tolerance=1e-6):
    assert len(scene) == len(pictures.cameras)
    for read, written in zip(scene.cameras, pictures.cameras, strict=True):
        assert (read.width, read.height) == (written.width, written.height)
        for name in ("fx", "fy", "cx", "cy"):
            assert getattr(read, name) == pytest.approx(getattr(written, name), rel=tolerance)
        np.testing.assert_allclose(read.camera_to_world, written.camera_to_world, atol=tolerance)
    images, alphas = pictures.over(BACKGROUND)
    np.testing.assert_allclose(scene.images, images, atol=image_tolerance)
    np.testing.assert_allclose(scene.alphas, alphas, atol=1e-6)


def load(folder, **options):
    return load_scene(folder, background=BACKGROUND, **options)


HELD_OUT, KEPT = [0, 8], [1, 2, 3, 4, 5, 6, 7, 9]


def require_held_out_splits(folder, pictures, **options):
    require_equal(load(folder, **options), pictures.pick(KEPT))
    require_equal(load(folder, split="test", **options), pictures.pick(HELD_OUT))
    require_equal(load(folder, split="all", **options), pictures)
    with pytest.raises(FileNotFoundError, match="'val'.*splits: train, test, all"):
        load(folder, split="val", **options)


@pytest.mark.parametrize("format", [None, "blender"])
def test_blender(tmp_path, centered, format):
    write_blender(tmp_path, centered)
    require_equal(load(tmp_path, format=format), centered)


@pytest.mark.parametrize("style", ["4x4", "lines"])
def test_nsvf(tmp_path, centered, style):
    write_nsvf(tmp_path, centered, "001122", style=style)
    for split, indices in {"train": [0, 1], "val": [2, 3], "test": [4, 5]}.items():
        require_equal(load(tmp_path, split=split), centered.pick(indices))
    np.testing.assert_array_equal(load(tmp_path).bounds, [[-1.5] * 3, [1.5] * 3])
    require_equal(load(tmp_path, format="nsvf"), centered.pick([0, 1]))


def test_nsvf_matrix_keeps_both_focal_lengths_and_splits_say_what_there_is(tmp_path, bricks):
    write_nsvf(tmp_path, bricks, "0" * 10, bbox=None)
    scene = load(tmp_path)
    require_equal(scene, bricks)
    assert scene.bounds is None
    with pytest.raises(FileNotFoundError, match="splits: train"):
        load(tmp_path, split="test")


@pytest.mark.parametrize("name", ["cameras.npz", "cameras_sphere.npz"])
def test_dtu(tmp_path, bricks, name):
    scale = write_dtu(tmp_path, bricks, name=name)
    require_held_out_splits(tmp_path, bricks)
    scene = load(tmp_path, format="dtu")
    np.testing.assert_array_equal(scene.bounds, [[-1] * 3, [1] * 3])
    np.testing.assert_allclose(scene.to_source, scale)


def test_masks_can_be_left_alone(tmp_path, bricks):
    write_dtu(tmp_path, bricks)
    scene = load(tmp_path, split="all", masks=False)
    assert scene.alphas is None
    np.testing.assert_allclose(scene.images, bricks.rgba[..., :3] / 255, atol=1e-6)


def test_dtu_without_masks(tmp_path, bricks):
    write_dtu(tmp_path, bricks, masks=False)
    assert load(tmp_path).alphas is None


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"shared": False},
        {"masks": True},
        {"extension": False},
        {"masks": True, "extension": False, "shared": False},
    ],
)
def test_transforms(tmp_path, bricks, options):
    write_transforms(tmp_path, bricks, **options)
    require_held_out_splits(tmp_path, bricks)
    require_equal(load(tmp_path, format="transforms"), bricks.pick(KEPT))


def test_pictures_that_are_not_there_are_left_out(tmp_path, bricks):
    """As captures are published: the list names blurred pictures too, which were thrown away."""
    write_transforms(tmp_path, bricks)
    for number in (1, 4):
        (tmp_path / "images" / f"view_{number:02d}.png").unlink()
    kept = [number for number in range(len(bricks.names)) if number not in (1, 4)]
    with pytest.warns(UserWarning, match=MESSAGES["scene.two_not_there"].format(count=len(bricks.names))) as caught:
        found = [load(tmp_path, split=split) for split in ("train", "test")]
    assert "\n" not in str(caught[0].message) and "view_0" in str(caught[0].message)
    names = sorted(name for scene in found for name in scene.names)
    assert [name[:7] for name in names] == [bricks.names[number] for number in kept]
    for number in kept[3:]:
        (tmp_path / "images" / f"{bricks.names[number]}.png").unlink()
    with pytest.raises(FileNotFoundError, match=f"{len(bricks.names) - 3} of them are not there, more than half"):
        load(tmp_path)
    for number in kept[:3]:
        (tmp_path / "images" / f"{bricks.names[number]}.png").unlink()
    with pytest.raises(FileNotFoundError, match="view_"):
        load(tmp_path)


def test_transforms_splits_of_its_own(tmp_path, bricks):
    lists = {"train_filenames": ["images/view_03.png", "images/view_01.png"], "val_filenames": ["images/view_02.png"]}
    write_transforms(tmp_path / "lists", bricks, **lists)
    require_equal(load(tmp_path / "lists"), bricks.pick([3, 1]))
    require_equal(load(tmp_path / "lists", split="val"), bricks.pick([2]))
    with pytest.raises(FileNotFoundError, match="splits: train, val"):
        load(tmp_path / "lists", split="test")
    write_transforms(tmp_path / "files", bricks.pick([0, 1, 2]), name="transforms_train.json")
    write_transforms(tmp_path / "files", bricks.pick([3, 4]), name="transforms_test.json")
    assert len(load(tmp_path / "files")) == 3
    assert len(load(tmp_path / "files", split="test")) == 2


def test_transforms_with_angles_instead_of_focal_lengths(tmp_path, centered):
    write_transforms(tmp_path, centered)
    content = json.loads((tmp_path / "transforms.json").read_text())
    for name in ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_model"):
        del content[name]
    content["camera_angle_x"] = 2 * np.arctan(12 / 30.0)
    for frame in content["frames"]:
        frame["transform_matrix"] = frame["transform_matrix"][:3]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    require_equal(load(tmp_path, split="all"), centered)
    content["camera_angle_y"] = 2 * np.arctan(10 / 25.0)
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    assert load(tmp_path).cameras[0].fy == pytest.approx(25.0)


def test_points_of_transforms_give_the_bounds(tmp_path, bricks):
    points = np.random.default_rng(0).uniform(-0.5, 0.8, (400, 3)).astype("<f4")
    write_transforms(tmp_path, bricks, ply_file_path="sparse_pc.ply")
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex 400\n{properties}end_header\n"
    (tmp_path / "sparse_pc.ply").write_bytes(header.encode() + points.tobytes())
    low, high = load(tmp_path).bounds
    assert (low > -0.8).all() and (low < -0.45).all() and (high > 0.75).all() and (high < 1.1).all()
    (tmp_path / "sparse_pc.ply").write_bytes(header.encode() + points.tobytes()[:-9])
    with pytest.raises(ValueError, match="sparse_pc.ply"):
        load(tmp_path)
    (tmp_path / "sparse_pc.ply").unlink()
    with pytest.raises(FileNotFoundError, match="ply_file_path.*sparse_pc.ply"):
        load(tmp_path)


def test_applied_transform_leads_back(tmp_path, bricks):
    applied = [[0, 1, 0, 0.5], [0, 0, 2, 1.0], [2, 0, 0, -1.0]]
    write_transforms(tmp_path, bricks, applied_transform=applied)
    scene = load(tmp_path, split="all")
    require_equal(scene, bricks)  # poses are those of the file, as in nerfstudio
    point = np.array([0.3, -0.2, 0.7, 1.0])
    moved = np.array([*applied, [0, 0, 0, 1]]) @ point
    np.testing.assert_allclose(scene.to_source @ moved, point, atol=1e-12)


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("where", ["sparse/0", "sparse"])
@pytest.mark.parametrize("masks", [False, True])
def test_colmap(tmp_path, bricks, binary, where, masks):
    points = np.random.default_rng(0).uniform(-0.5, 0.8, (400, 3))
    points[:4] = 1000.0  # a few wild ones
    write_colmap(tmp_path, bricks, binary=binary, where=where, masks=masks, points=points)
    require_held_out_splits(tmp_path, bricks)
    low, high = load(tmp_path, format="colmap").bounds
    assert (low > -0.8).all() and (low < -0.45).all() and (high > 0.75).all() and (high < 1.1).all()


@pytest.mark.parametrize("pictures", ["", "images"])
def test_a_model_beside_its_pictures(tmp_path, bricks, pictures):
    """As RealityScan exports it: cameras.txt, images.txt and points3D.txt in the scene's folder itself."""
    write_colmap(tmp_path, bricks, binary=False, where="model")
    for file in (tmp_path / "model").iterdir():
        file.rename(tmp_path / file.name)
    if not pictures:
        for file in (tmp_path / "images").iterdir():
            file.rename(tmp_path / file.name)
    require_equal(load(tmp_path, split="all"), bricks)
    files = sorted((tmp_path / pictures).glob("*.png"))
    files[2].unlink()
    with pytest.warns(UserWarning, match=MESSAGES["scene.one_left_out"]):
        assert len(load(tmp_path, split="all")) == len(bricks.names) - 1
    for file in files[3:]:
        file.unlink()
    with pytest.raises(FileNotFoundError, match="more than half"):
        load(tmp_path)


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("base", ["sparse", "sparse/0/models"])
def test_of_several_models_the_one_with_most_pictures_is_read(tmp_path, bricks, binary, base):
    """As COLMAP's mapper writes them where pictures do not hang together; hloc has another folder."""
    write_colmap(tmp_path, bricks, binary=binary, where=f"{base}/1")
    few = bricks.pick([0, 1])
    write_colmap(tmp_path, few, binary=binary, where=f"{base}/0")
    with pytest.warns(UserWarning, match=rf"{base}/1 is taken.*\({len(bricks.names)}\); others: {base}/0 \(2\)"):
        scene = load_scene(tmp_path, split="all")
    assert sorted(scene.names) == sorted(bricks.names)
    chosen = load_scene(tmp_path, split="all", model="0")
    assert len(chosen) == 2 and len(load_scene(tmp_path, split="all", model=f"{base}/1")) == len(bricks.names)
    with pytest.raises(ValueError, match=f"no COLMAP model '7', only {base}/0, {base}/1"):
        load_scene(tmp_path, model="7")


def test_models_are_those_of_colmap_alone(tmp_path, bricks):
    write_transforms(tmp_path, bricks)
    with pytest.raises(ValueError, match="'transforms' hold one"):
        load_scene(tmp_path, model="0")


@pytest.mark.parametrize("kept", ["none", "some"])
def test_images_without_a_line_of_keypoints_are_all_read(tmp_path, bricks, kept):
    """As tools write images.txt that have no features; a name of digits alone is no keypoint."""
    write_colmap(tmp_path, bricks, binary=False)
    file = tmp_path / "sparse/0/images.txt"
    head, *lines = file.read_text().splitlines()
    records = [line for line in lines if len(line.split()) > 3]
    rows = [row for i, record in enumerate(records) for row in ([record, ""] if kept == "some" and i % 3 else [record])]
    file.write_text("\n".join([head, *rows]) + "\n")
    assert sorted(load_scene(tmp_path, split="all").names) == sorted(bricks.names)


@pytest.mark.parametrize("binary", [False, True])
def test_colmap_without_points(tmp_path, bricks, binary):
    write_colmap(tmp_path, bricks, binary=binary)
    assert load(tmp_path).bounds is None
    (tmp_path / "sparse" / "0" / f"points3D.{'bin' if binary else 'txt'}").unlink()
    require_equal(load(tmp_path, split="all"), bricks)


def test_formats_are_told_apart_and_named(tmp_path, bricks):
    write_colmap(tmp_path, bricks, binary=True)
    write_transforms(tmp_path, bricks, masks=True)  # nerfstudio keeps COLMAP's model beside its own file
    assert load(tmp_path, split="all").alphas is not None
    empty = tmp_path / "other"
    (empty / "photos").mkdir(parents=True)
    (empty / "notes.txt").write_text("")
    with pytest.raises(ValueError, match=MESSAGES["scene.no_known_format"]):
        load_scene(empty)


@pytest.mark.parametrize("given, said", [("", "give its folder 'capture'"), ("capture/sparse", "capture': give that")])
def test_a_folder_around_a_scene_or_in_one_says_so(tmp_path, bricks, given, said):
    write_colmap(tmp_path / "capture", bricks, binary=True)
    with pytest.raises(ValueError, match=said):
        load_scene(tmp_path / given)


def test_focal_lengths_that_are_no_pixels_are_refused(tmp_path, bricks):
    """Millimetres, or shares of the picture, which other programs have."""
    write_transforms(tmp_path, bricks)
    path = tmp_path / "transforms.json"
    content = json.loads(path.read_text())
    for each in (content, *content["frames"]):
        each.update({name: 0.035 for name in ("fl_x", "fl_y") if name in each})
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match="a focal length of 0.035 pixels"):
        load(tmp_path)


def test_masks_that_hide_everything_are_told(tmp_path, bricks):
    write_transforms(tmp_path, bricks, masks=True)
    for mask in (tmp_path / "masks").iterdir():
        write_image(mask, np.zeros((20, 24), np.uint8))
    with pytest.warns(UserWarning, match="masks hide all of 10 of 10 pictures"):
        assert load(tmp_path, split="all").alphas.max() == 0


# Kinds of pictures


# Distortion

LENSES = {
    "barrel": (-0.12, 0.02),
    "pincushion": (0.1, 0.01),
    "tangential": (0.0, 0.0, 0.01, -0.008),
    "all": (-0.1, 0.03, 0.004, -0.006),
    "rational": (0.05, 0.01, 0.002, 0.001, 0.01, 0.02, 0.01, 0.005),
}


def picture_of(camera, pixels):
    """A smooth picture on the sky, looked up along the rays through pixels (h, w, 2) of a pinhole camera."""
    local = np.stack(
        [(pixels[..., 0] - camera.cx) / camera.fx, (pixels[..., 1] - camera.cy) / camera.fy, np.ones(pixels.shape[:2])],
        axis=-1,
    )
    world = local @ camera.rotation.T
    world /= np.linalg.norm(world, axis=-1, keepdims=True)
    return 0.5 + 0.4 * np.sin(world @ np.array([[3.0, 1, 2], [1, 4, -2], [2, -1, 3]]))


def pixel_centers(camera):
    return np.stack(np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5), axis=-1)


def seen_through(camera, coefficients):
    """The same sky through a lens: its pixels traced back to the pinhole by fixed-point iteration."""
    pixels = pixel_centers(camera)
    target = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    pinhole = target.copy()
    for _ in range(200):
        bent = np.stack(distort(pinhole[..., 0], pinhole[..., 1], coefficients), axis=-1)
        pinhole += target - bent
    assert np.abs(bent - target).max() < 1e-9
    return picture_of(camera, pinhole * [camera.fx, camera.fy] + [camera.cx, camera.cy])


def lens_pictures(coefficients, single_focal=False, middle=False):
    """Pictures of the sky through a lens; middle: whether its axis meets the middle of the picture."""
    cameras, place = spiral_cameras(9, width=64, height=48), (32.0, 24.0) if middle else (33.0, 23.0)
    cameras = [Camera(50.0, 50.0 if single_focal else 52.0, *place, 64, 48, c.camera_to_world) for c in cameras]
    images = np.stack([seen_through(camera, coefficients) for camera in cameras])
    rgba = np.concatenate([np.round(images * 255), np.full((9, 48, 64, 1), 255)], axis=-1).astype(np.uint8)
    return Pictures(rgba, cameras)


def require_undistorted(scene, pictures):
    assert scene.alphas is None
    for image, read, written in zip(scene.images, scene.cameras, pictures.cameras[1:], strict=False):
        zoom = read.fx / written.fx
        assert 1.0 <= zoom < 1.1 and read.fy / written.fy == pytest.approx(zoom)
        assert (read.cx, read.cy) == (written.cx, written.cy)
        np.testing.assert_allclose(read.camera_to_world, written.camera_to_world, atol=1e-9)
        error = np.abs(image - picture_of(read, pixel_centers(read)))
        assert error[1:-1, 1:-1].max() < 0.008 and error.max() < 0.015  # half a pixel at the edge is repeated


@pytest.mark.parametrize("lens", ["barrel", "pincushion", "tangential", "all"])
def test_transforms_distortion_is_undone(tmp_path, lens):
    pictures = lens_pictures(LENSES[lens])
    write_transforms(
        tmp_path, pictures, shared=False, distortion=dict(zip(("k1", "k2", "p1", "p2"), LENSES[lens], strict=False))
    )
    require_undistorted(load_scene(tmp_path), pictures)


@pytest.mark.parametrize(
    "model, lens",
    [
        ("SIMPLE_RADIAL", (-0.12,)),
        ("RADIAL", LENSES["barrel"]),
        ("OPENCV", LENSES["all"]),
        ("FULL_OPENCV", LENSES["rational"]),
    ],
)
@pytest.mark.parametrize("binary", [False, True])
def test_colmap_distortion_is_undone(tmp_path, model, lens, binary):
    pictures = lens_pictures(lens, single_focal="RADIAL" in model)
    write_colmap(tmp_path, pictures, binary=binary, model=model, distortion=lens)
    require_undistorted(load_scene(tmp_path), pictures)


def test_an_undistorted_picture_of_a_lens_without_distortion_is_itself():
    image = np.random.default_rng(0).random((7, 9, 4), dtype=np.float32)
    intrinsics = (10.0, 11.0, 4.0, 3.6)
    assert undistorted_intrinsics(intrinsics, (9, 7), (0.0,) * 4, "here") == intrinsics
    np.testing.assert_allclose(undistort(image, intrinsics, intrinsics, (0.0,) * 4), image, atol=1e-6)


@pytest.mark.parametrize("k1", [1e6, -50.0, 1e300])
def test_a_lens_that_folds_the_picture_is_refused(k1):
    with pytest.raises(ValueError, match="here: lens distortion k1="):
        undistorted_intrinsics((10.0, 10.0, 5.0, 5.0), (10, 10), (k1,), "here")


# Readers of others


@pytest.mark.parametrize(
    "model, lens",
    [
        ("OPENCV", LENSES["all"]),
        ("FULL_OPENCV", LENSES["rational"]),
        ("RADIAL", LENSES["barrel"]),
        ("SIMPLE_RADIAL", (0.1,)),
    ],
)
def test_distortion_is_that_of_colmap(model, lens):
    pycolmap = pytest.importorskip("pycolmap")
    focal = [50.0] if "RADIAL" in model else [50.0, 52.0]
    camera = pycolmap.Camera(model=model, width=64, height=48, params=[*focal, 33.0, 23.0, *lens])
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2))
    pixels = np.array([camera.img_from_cam(np.array([x, y, 1.0])) for x, y in points]).reshape(-1, 2)
    expected = np.stack(distort(*points.T, lens), axis=-1) * [focal[0], focal[-1]] + [33.0, 23.0]
    np.testing.assert_allclose(pixels, expected, atol=1e-9)


@pytest.mark.parametrize("binary", [False, True])
def test_colmap_reads_the_same_model(tmp_path, bricks, binary):
    pycolmap = pytest.importorskip("pycolmap")
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3))
    write_colmap(tmp_path, bricks, binary=binary, points=points)
    for name in ("images.bin", "images.txt"):  # keypoints and tracks of the writer are made up
        if (tmp_path / "sparse" / "0" / name).is_file():
            (tmp_path / "sparse" / "0" / f"points3D{name[-4:]}").unlink()
            empty = {"bin": bytes(8), "txt": b""}[name[-3:]]
            (tmp_path / "sparse" / "0" / f"points3D{name[-4:]}").write_bytes(empty)
    theirs = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
    require_same_as_colmap(load(tmp_path, split="all"), theirs)


@pytest.mark.parametrize("binary", [False, True])
def test_a_model_that_colmap_wrote(tmp_path, bricks, binary):
    pycolmap = pytest.importorskip("pycolmap")
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 2, 1, 5, 60
    options.camera_width, options.camera_height, options.camera_model_id = 24, 20, pycolmap.CameraModelId.PINHOLE
    options.camera_params = [30.0, 28.0, 12.5, 9.5]
    theirs = pycolmap.synthesize_dataset(options)
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    theirs.write_binary(tmp_path / "sparse" / "0") if binary else theirs.write_text(tmp_path / "sparse" / "0")
    for index, image in enumerate(theirs.images.values()):
        path = tmp_path / "images" / image.name
        path.parent.mkdir(parents=True, exist_ok=True)
        from warpcage.view import write_png

        write_png(path, bricks.rgba[index % 10])
    scene = load(tmp_path, split="all")
    assert len(scene) == len(theirs.images)
    require_same_as_colmap(scene, theirs)
    points = np.array([point.xyz for point in theirs.points3D.values()])
    assert (scene.bounds[0] < np.median(points, axis=0)).all() and (scene.bounds[1] > np.median(points, axis=0)).all()


def require_same_as_colmap(scene, theirs):
    by_name = sorted(theirs.images.values(), key=lambda image: image.name)
    for camera, image in zip(scene.cameras, by_name, strict=True):
        np.testing.assert_allclose(
            [camera.fx, camera.fy, camera.cx, camera.cy], theirs.cameras[image.camera_id].params, rtol=1e-12
        )
        np.testing.assert_allclose(camera.center, image.projection_center(), atol=1e-9)
        point = camera.center + camera.rotation @ [0.3, -0.2, 2.0]
        pixel = image.camera.img_from_cam(image.cam_from_world() * point)
        np.testing.assert_allclose(camera.project(point[None])[0][0], np.ravel(pixel), atol=1e-6)


def test_projections_are_split_as_opencv_does(bricks, tmp_path):
    cv2 = pytest.importorskip("cv2")
    write_dtu(tmp_path, bricks)
    matrices = np.load(tmp_path / "cameras_sphere.npz")
    for i, camera in enumerate(load(tmp_path, split="all").cameras):
        projection = (matrices[f"world_mat_{i}"] @ matrices[f"scale_mat_{i}"])[:3]
        k, rotation, center = cv2.decomposeProjectionMatrix(projection * np.sign(np.linalg.det(projection[:, :3])))[:3]
        k = k / k[2, 2]
        np.testing.assert_allclose(
            [k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5], [camera.fx, camera.fy, camera.cx, camera.cy], rtol=1e-9
        )
        np.testing.assert_allclose(rotation.T, camera.rotation, atol=1e-9)
        np.testing.assert_allclose(center[:3, 0] / center[3, 0], camera.center, atol=1e-9)


def test_lens_is_that_of_opencv():
    cv2 = pytest.importorskip("cv2")
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3)) * [1, 1, 0] + [0, 0, 1]
    for lens in LENSES.values():
        pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), np.array((lens + (0.0,) * 8)[:8]))
        np.testing.assert_allclose(pixels[:, 0], np.stack(distort(*points.T[:2], lens), axis=-1), atol=1e-9)
    assert len(COEFFICIENTS) == 8 and len(MODEL_NUMBERS) == 8


# Real data


def test_dtu_scan(real_data):
    folder = real_data / "dtu_scan24_half"
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    train, test = (load_scene(folder, split=split, downscale=8) for split in ("train", "test"))
    assert (len(train), len(test)) == (42, 7) and train.images.shape[1:] == (75, 100, 3)
    centers = np.array([camera.center for camera in train.cameras])
    assert (np.linalg.norm(centers, axis=1) > 1.5).all()  # outside the unit sphere, which they look at
    for camera in train.cameras:
        assert 0 < camera.project(np.zeros((1, 3)))[0][0][0] < camera.width
    # silhouettes of cameras that fit meet in space: what lies in all training masks lies in the held-out ones
    points = (np.indices((48, 48, 48)).reshape(3, -1).T + 0.5) / 24 - 1
    for camera, alpha in zip(train.cameras, train.alphas, strict=True):
        points = points[covered(camera, alpha, points) != 0]
    assert len(points) > 1000
    for camera, alpha in zip(test.cameras, test.alphas, strict=True):
        state = covered(camera, alpha, points)
        assert (state == 1).sum() > 0.93 * (state >= 0).sum() > 0


def covered(camera, alpha, points):
    """Whether each point is seen where a mask is set: 1 or 0, and -1 outside the picture."""
    columns, rows = np.floor(camera.project(points)[0]).astype(int).T
    inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    state = np.full(len(points), -1)
    state[inside] = alpha[rows[inside], columns[inside]] > 0
    return state
