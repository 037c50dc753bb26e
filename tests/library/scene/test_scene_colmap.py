"""COLMAP models: where they lie, which of several is read, and that pycolmap reads and writes the same."""

import dataclasses
import shutil
import warnings

import numpy as np
import pytest
from messages import MESSAGES
from refusals import refused
from scene_readers import CLOUD, load, require_equal
from scene_writers import Pictures, write_colmap
from scipy.spatial.transform import Rotation

from warpcage import load_scene
from warpcage.view import write_png


@pytest.mark.parametrize("pictures", ["", "images"])
def test_a_model_beside_its_pictures(tmp_path, bricks, pictures):
    """As RealityScan exports it: cameras.txt, images.txt and points3D.txt in the scene's folder itself."""
    write_colmap(tmp_path, bricks, binary=False, where="model")
    for folder in ("model",) if pictures else ("model", "images"):
        for file in (tmp_path / folder).iterdir():
            file.rename(tmp_path / file.name)
    require_equal(load(tmp_path, split="all"), bricks)
    files = sorted((tmp_path / pictures).glob("*.png"))
    files[2].unlink()
    with pytest.warns(UserWarning, match=MESSAGES["scene.one_left_out"]):
        assert len(load(tmp_path, split="all")) == len(bricks.names) - 1
    for file in files[3:]:
        file.unlink()
    refused(lambda: load(tmp_path), match="more than half", error=FileNotFoundError)


@pytest.mark.parametrize("binary, base", [(False, "sparse"), (True, "sparse"), (True, "sparse/0/models")])
def test_of_several_models_the_one_with_most_pictures_is_read(tmp_path, bricks, binary, base):
    """As COLMAP's mapper writes them where pictures do not hang together; hloc has another folder."""
    write_colmap(tmp_path, bricks, binary=binary, where=f"{base}/1")
    write_colmap(tmp_path, bricks.pick([0, 1]), binary=binary, where=f"{base}/0")
    with pytest.warns(UserWarning, match=rf"{base}/1 is taken.*\({len(bricks.names)}\); others: {base}/0 \(2\)"):
        scene = load_scene(tmp_path, split="all")
    assert sorted(scene.names) == sorted(bricks.names)
    for model, count in (("0", 2), (f"{base}/1", len(bricks.names))):
        assert len(load_scene(tmp_path, split="all", model=model)) == count
    refused(lambda: load_scene(tmp_path, model="7"), match=f"no COLMAP model '7', only {base}/0, {base}/1")


UNDONE = {"dense": ("dense/sparse", "dense/images"), "undistorted": ("undistorted/sparse", "undistorted/images")}


@pytest.mark.parametrize("pictures", ["beside both", "beside their model", "in images"])
@pytest.mark.parametrize("kind", [*UNDONE, "numbered"])
@pytest.mark.filterwarnings("ignore:.*2 of them are not there")
def test_of_models_for_several_sizes_the_one_that_fits_the_pictures_is_read(tmp_path, bricks, kind, pictures):
    """As COLMAP's undistorter leaves them: sparse/0 of pictures as they were taken, dense/ of what it made of them."""
    model, home = UNDONE.get(kind, ("sparse/1", "other/images"))
    small = Pictures(bricks.rgba[:, 1:, :21], [dataclasses.replace(c, width=21, height=19) for c in bricks.cameras])
    write_colmap(tmp_path, bricks, binary=True)
    write_colmap(tmp_path / "small", small.pick(range(8)), binary=True)
    (tmp_path / model).parent.mkdir(exist_ok=True)
    (tmp_path / "small/sparse/0").rename(tmp_path / model)
    if pictures != "beside both":
        shutil.rmtree(tmp_path / "images")
    place = "images" if pictures == "in images" or kind == "numbered" else home
    if not (tmp_path / place).is_dir():
        (tmp_path / "small/images").rename(tmp_path / place)
    if pictures == "beside both":
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            require_equal(load(tmp_path, split="all"), bricks)
        assert len(caught) == (kind == "numbered")  # that sparse/1 is for others
    else:
        said = MESSAGES["scene.model_of_size"].format(model)
        with pytest.warns(UserWarning, match=said) as caught:
            require_equal(load(tmp_path, split="all"), small.pick(range(8)))
        assert len(caught) == 1
        refused(lambda: load(tmp_path, model="sparse/0"), match="sizes differ in 7 of 7|more than half")
    if kind != "numbered":
        require_equal(load(tmp_path, split="all", model=model), small.pick(range(8)))


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


@pytest.mark.parametrize("given, said", [("", "give its folder 'capture'"), ("capture/sparse", "capture': give that")])
def test_a_folder_around_a_scene_or_in_one_says_so(tmp_path, bricks, given, said):
    write_colmap(tmp_path / "capture", bricks, binary=True)
    refused(lambda: load_scene(tmp_path / given), match=said)


@pytest.mark.parametrize("binary", [False, True])
def test_colmap_reads_the_same_model(tmp_path, bricks, binary):
    pycolmap = pytest.importorskip("pycolmap")
    write_colmap(tmp_path, bricks, binary=binary, points=CLOUD)
    # keypoints and tracks of the writer are made up
    points = tmp_path / "sparse" / "0" / f"points3D.{'bin' if binary else 'txt'}"
    points.write_bytes(bytes(8) if binary else b"")
    require_same_as_colmap(load(tmp_path, split="all"), pycolmap.Reconstruction(tmp_path / "sparse" / "0"))


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
        write_png(path, bricks.rgba[index % 10])
    scene = load(tmp_path, split="all")
    assert len(scene) == len(theirs.images)
    require_same_as_colmap(scene, theirs)
    points = np.array([point.xyz for point in theirs.points3D.values()])
    assert (scene.bounds[0] < np.median(points, axis=0)).all() and (scene.bounds[1] > np.median(points, axis=0)).all()


@pytest.mark.parametrize("binary", [False, True])
def test_pictures_without_a_camera_are_counted(tmp_path, bricks, binary):
    """pycolmap leaves images without a pose out of what it writes, and says nothing."""
    pycolmap = pytest.importorskip("pycolmap", minversion="4")
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 1, 6, 20
    options.camera_width, options.camera_height, options.camera_model_id = 24, 20, pycolmap.CameraModelId.PINHOLE
    options.camera_params = [30.0, 28.0, 12.0, 10.0]
    theirs = pycolmap.synthesize_dataset(options)
    names = sorted(image.name for image in theirs.images.values())
    folder = tmp_path / "sparse" / "0"
    folder.mkdir(parents=True)
    theirs.deregister_frame(next(image.frame_id for image in theirs.images.values() if image.name == names[2]))
    theirs.write_binary(folder) if binary else theirs.write_text(folder)
    for name in (*names, "dynamic_mask_" + names[0], names[0] + ".png"):  # masks are no pictures
        path = tmp_path / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_png(path, bricks.rgba[0])
    with pytest.warns(UserWarning, match=f"1 of 6 pictures have no camera.*{names[2]}"):
        assert len(load(tmp_path, split="all")) == 5


def test_pictures_of_a_model_in_any_order_with_quaternions_of_any_length(tmp_path, bricks):
    """As pycolmap writes what it is given."""
    pycolmap = pytest.importorskip("pycolmap", minversion="4")
    theirs = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=24, height=20, params=[30, 28, 12, 10])
    theirs.add_camera_with_trivial_rig(camera)
    for number in (7, 2, 9, 4):
        turn = pycolmap.Rotation3d(number * np.array([0.1 * number, 0.2, 0.3, 1.0]))
        image = pycolmap.Image(name=f"{9 - number}.png" if number < 9 else "z.png", image_id=number, camera_id=1)
        theirs.add_image_with_trivial_frame(image, pycolmap.Rigid3d(turn, [number, 0.0, 1.0]))
    folder = tmp_path / "sparse" / "0"
    folder.mkdir(parents=True)
    (tmp_path / "images").mkdir()
    for image in theirs.images.values():
        write_png(tmp_path / "images" / image.name, bricks.rgba[0])
    theirs.write_text(folder)
    scene = load(tmp_path, split="all")
    assert scene.names == ["2", "5", "7", "z"]
    for camera, image in zip(scene.cameras, sorted(theirs.images.values(), key=lambda each: each.name), strict=True):
        turn = Rotation.from_quat(image.cam_from_world().rotation.quat)  # of length 1 by SciPy
        np.testing.assert_allclose(camera.rotation, turn.as_matrix().T, atol=1e-12)
        center = -turn.inv().apply(image.cam_from_world().translation)
        np.testing.assert_allclose(camera.center, center, atol=1e-12)


@pytest.mark.parametrize("edited", [False, True])
def test_text_beside_binary_files_that_says_something_else(tmp_path, bricks, recwarn, edited):
    """Which pycolmap 4.2 ignores without a word."""
    for name, binary in (("scene", True), ("text", False)):
        write_colmap(tmp_path / name, bricks, binary=binary)
    before = load(tmp_path / "scene", split="all")
    for path in (tmp_path / "text" / "sparse" / "0").iterdir():
        text = path.read_text()
        if edited and path.name == "cameras.txt":
            text = f"{text.rsplit(' ', 1)[0]} 7.25\n"
        (tmp_path / "scene" / "sparse" / "0" / path.name).write_text(text)
    scene = load(tmp_path / "scene", split="all")
    assert [camera.cy for camera in scene.cameras] == [camera.cy for camera in before.cameras]
    assert sum("beside them say something else" in str(each.message) for each in recwarn) == edited


def test_text_beside_binary_files_that_memory_is_short_for(tmp_path, bricks, monkeypatch):
    """Of many keypoints: it is not needed, and nothing is said of it."""
    write_colmap(tmp_path / "scene", bricks, binary=True)
    write_colmap(tmp_path / "text", bricks, binary=False)
    for path in (tmp_path / "text" / "sparse" / "0").iterdir():
        (tmp_path / "scene" / "sparse" / "0" / path.name).write_bytes(path.read_bytes() + b"#" * (1 << 22))
    monkeypatch.setattr("warpcage.core.memory.free_host_bytes", lambda: 1 << 26)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load(tmp_path / "scene", split="all")


def require_same_as_colmap(scene, theirs):
    by_name = sorted(theirs.images.values(), key=lambda image: image.name)
    for camera, image in zip(scene.cameras, by_name, strict=True):
        intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy]
        np.testing.assert_allclose(intrinsics, theirs.cameras[image.camera_id].params, rtol=1e-12)
        np.testing.assert_allclose(camera.center, image.projection_center(), atol=1e-9)
        point = camera.center + camera.rotation @ [0.3, -0.2, 2.0]
        pixel = image.camera.img_from_cam(image.cam_from_world() * point)
        np.testing.assert_allclose(camera.project(point[None])[0][0], np.ravel(pixel), atol=1e-6)
