"""transforms.json: splits, camera matrices and angles, points, and what is refused."""

import numpy as np
import pytest
from messages import MESSAGES
from refusals import refused
from scene_readers import CLOUD, bounds_are_of_points, load, require_equal
from scene_writers import change_json, write_transforms

from warpcage.scene.formats.transforms import TransformsCameras

LISTING = "transforms.json"


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
    refused(lambda: load(tmp_path), match="view_", error=FileNotFoundError)


def test_transforms_splits_of_its_own(tmp_path, bricks):
    lists = {"train_filenames": ["images/view_03.png", "images/view_01.png"], "val_filenames": ["images/view_02.png"]}
    write_transforms(tmp_path / "lists", bricks, **lists)
    require_equal(load(tmp_path / "lists"), bricks.pick([3, 1]))
    require_equal(load(tmp_path / "lists", split="val"), bricks.pick([2]))
    refused(lambda: load(tmp_path / "lists", split="test"), match="splits: train, val", error=FileNotFoundError)
    write_transforms(tmp_path / "files", bricks.pick([0, 1, 2]), name="transforms_train.json")
    write_transforms(tmp_path / "files", bricks.pick([3, 4]), name="transforms_test.json")
    assert [len(load(tmp_path / "files", split=split)) for split in ("train", "test")] == [3, 2]


def test_transforms_with_angles_instead_of_focal_lengths(tmp_path, centered):
    write_transforms(tmp_path, centered)

    def into_angles(content):
        for name in ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_model"):
            del content[name]
        content["camera_angle_x"] = 2 * np.arctan(12 / 30.0)
        for frame in content["frames"]:
            frame["transform_matrix"] = frame["transform_matrix"][:3]

    change_json(tmp_path / LISTING, into_angles)
    require_equal(load(tmp_path, split="all"), centered)
    change_json(tmp_path / LISTING, lambda content: content.update(camera_angle_y=2 * np.arctan(10 / 25.0)))
    assert load(tmp_path).cameras[0].fy == pytest.approx(25.0)


def as_matrix(values, form):
    """A camera matrix as exporters write it."""
    k = [[values["fl_x"], 0.0, values["cx"]], [0.0, values["fl_y"], values["cy"]], [0.0, 0.0, 1.0]]
    if form == "rows":
        return k
    if form == "4x4":
        return [*([*row, 0.0] for row in k), [0.0, 0.0, 0.0, 1.0]]
    return np.ravel(k if form == "flat" else np.transpose(k)).tolist()


INTRINSICS = ("fl_x", "fl_y", "cx", "cy")


@pytest.mark.parametrize("file", ["transforms.json", "transforms_train.json"])
@pytest.mark.parametrize(
    "name, form, each",
    [("K", "rows", True), ("K", "flat", True), ("K", "columns", False), ("intrinsic_matrix", "4x4", True)]
    + [("camera_matrix", "rows", False), ("intrinsics", "4x4", True)],
)
def test_camera_matrices_of_transforms(tmp_path, bricks, name, form, each, file):
    """In place of fl_x and others, of the file or of each frame; a wrong angle of the file's does not count."""
    write_transforms(tmp_path, bricks, shared=not each, name=file, camera_angle_x=2.9)

    def into_matrices(content):
        for values in content["frames"] if each else [content]:
            values[name] = as_matrix(values, form)
            for word in INTRINSICS:
                del values[word]
        content["frames"].reverse()

    change_json(tmp_path / file, into_matrices)
    split = "all" if file == "transforms.json" else "train"
    require_equal(load(tmp_path, split=split), bricks)
    path = str(tmp_path / file)
    camera = TransformsCameras(path).camera("view_03")
    assert camera.fx == pytest.approx(bricks.cameras[3].fx) and camera.cy == pytest.approx(bricks.cameras[3].cy)


def test_a_matrix_of_a_frame_goes_before_what_the_file_says(tmp_path, bricks):
    write_transforms(tmp_path, bricks)
    other = {"fl_x": 40.0, "fl_y": 41.0, "cx": 11.0, "cy": 9.0}
    change_json(tmp_path / LISTING, lambda content: content["frames"][0].update(K=as_matrix(other, "rows")))
    cameras = load(tmp_path, split="all").cameras
    assert [cameras[9].fx, cameras[9].fy, cameras[9].cx, cameras[9].cy] == [40.0, 41.0, 11.0, 9.0]
    assert cameras[0].fx == bricks.cameras[0].fx
    change_json(tmp_path / LISTING, lambda content: content["frames"][0].update(camera_angle_x=0.9, K=None))
    assert load(tmp_path, split="all").cameras[9].fx == pytest.approx(12 / np.tan(0.45))


@pytest.mark.parametrize(
    "more, said",
    [
        ({"K": [[40.0, 1.0, 12.0], [0, 40.0, 10.0], [0, 0, 1.0]]}, MESSAGES["scene.matrix_skew"]),
        ({"K": [[40.0, 0, 12.0], [0, 40.0, 10.0], [0, 0.1, 1.0]]}, "K must be a camera matrix, fx 0 cx"),
        ({"K": [[40.0, 0], [0, 40.0], [0, 0]]}, "K must be a camera matrix, fx 0 cx"),
        ({"K": [[40.0, 0, "a"], [0, 40.0, 10.0], [0, 0, 1.0]]}, r"K\[0\]\[2\] must be one finite number"),
        ({"K": [[40.0, 0, 12.0], [0, 40.0, 10.0], [0, 0, 1.0]]}, MESSAGES["scene.matrix_beside"]),
        ({"K": [[0.9, 0, 0.5], [0, 0.9, 0.5], [0, 0, 1.0]]}, "K has fl_x 0.9, beside it"),
        ({"fl_x": 0.035, "fl_y": 0.035}, "a focal length of 0.035 pixels"),  # millimetres, or shares of the picture
    ],
)
def test_intrinsics_that_are_none_are_refused(tmp_path, bricks, more, said):
    write_transforms(tmp_path, bricks)
    change_json(tmp_path / LISTING, lambda content: content.update(more))
    refused(lambda: load(tmp_path), match=said)


def test_points_of_transforms_give_the_bounds(tmp_path, bricks):
    points = CLOUD[4:].astype("<f4")
    write_transforms(tmp_path, bricks, ply_file_path="sparse_pc.ply")
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{properties}end_header\n"
    (tmp_path / "sparse_pc.ply").write_bytes(header.encode() + points.tobytes())
    bounds_are_of_points(tmp_path, load(tmp_path))
    (tmp_path / "sparse_pc.ply").write_bytes(header.encode() + points.tobytes()[:-9])
    refused(lambda: load(tmp_path), match="sparse_pc.ply")
    (tmp_path / "sparse_pc.ply").unlink()
    refused(lambda: load(tmp_path), match="ply_file_path.*sparse_pc.ply", error=FileNotFoundError)


def test_applied_transform_leads_back(tmp_path, bricks):
    applied = [[0, 1, 0, 0.5], [0, 0, 2, 1.0], [2, 0, 0, -1.0]]
    write_transforms(tmp_path, bricks, applied_transform=applied)
    scene = load(tmp_path, split="all")
    require_equal(scene, bricks)  # poses are those of the file, as in nerfstudio
    point = np.array([0.3, -0.2, 0.7, 1.0])
    moved = np.array([*applied, [0, 0, 0, 1]]) @ point
    np.testing.assert_allclose(scene.to_source @ moved, point, atol=1e-12)
