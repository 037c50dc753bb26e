"""Scenes written in each format come back: cameras, pictures, splits, masks, points. Pixels of known points are
compared with the formulas of each format's own documentation."""

import dataclasses
import functools
import json
import shutil
import xml.etree.ElementTree as ET
from collections.abc import Callable

import dataset_writers as datasets
import numpy as np
import pytest
from messages import MESSAGES
from phone_writers import write_arkitscenes, write_polycam, write_record3d, write_stray
from program_writers import (
    SHADES,
    SQUARE,
    metashape_chunk,
    opensfm_reconstruction,
    write_bundler,
    write_llff,
    write_metashape,
    write_opensfm,
    write_realityscan,
)
from refusals import refused
from scene_readers import BACKGROUND, CLOUD, bounds_are_of_points, load, require_equal
from scene_writers import (
    Pictures,
    change_json,
    write_blender,
    write_colmap,
    write_dtu,
    write_image,
    write_nsvf,
    write_transforms,
)
from scipy.spatial.transform import Rotation

from warpcage import load_scene

# What each format says of a scene, by its own documentation


def seen_by_llff(folder, _scene):
    for row in np.load(folder / "poses_bounds.npy"):
        matrix = row[:15].reshape(3, 5)
        down, right, back = ((SQUARE - matrix[:, 3]) @ matrix[:, :3]).T
        height, width, focal = matrix[:, 4]
        yield focal * right / -back + width / 2, focal * down / -back + height / 2


def seen_by_bundler(folder, _scene):
    tokens = (folder / "bundle" / "bundle.out").read_text().split("\n", 2)[2].split()
    for index in range(10):
        values = np.array(tokens[15 * index : 15 * index + 15], float)
        seen = SQUARE @ values[3:12].reshape(3, 3).T + values[12:]
        right, up = (-seen[:, :2] / seen[:, 2:] * values[0]).T  # from the middle of the picture
        yield 12 + right, 10 - up


def seen_by_realityscan(folder, _scene):
    for line in (folder / "cameras.csv").read_text().splitlines()[1:]:
        x, y, alt, *angles, f, px, py = map(float, line.split(",")[1:10])
        (sh, sp, sr), (ch, cp, cr) = np.sin(np.radians(angles)), np.cos(np.radians(angles))
        heading = np.array([[ch, sh, 0], [-sh, ch, 0], [0, 0, 1]])  # clockwise, as a compass has it
        pitch, roll = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]]), np.array([[cr, 0, sr], [0, 1, 0], [-sr, 0, cr]])
        right, up, back = ((SQUARE - [x, y, alt]) @ (heading @ pitch @ roll)).T
        focal = f / 36 * 24
        yield 12 + 24 * px - focal * right / back, 10 + 24 * py + focal * up / back


def seen_by_opensfm(folder, _scene):
    (path,) = folder.rglob("reconstruction.json")
    content = json.loads(path.read_text())[0]
    for name in sorted(content["shots"]):
        shot = content["shots"][name]
        camera = content["cameras"][shot["camera"]]
        x, y, z = (Rotation.from_rotvec(shot["rotation"]).apply(SQUARE) + shot["translation"]).T
        longer = max(camera["width"], camera["height"])
        u = (camera["focal_x"] * x / z + camera["c_x"]) * longer + camera["width"] / 2
        yield u, (camera["focal_y"] * y / z + camera["c_y"]) * longer + camera["height"] / 2


def seen_by_metashape(folder, _scene):
    (path,) = folder.glob("*.xml")
    chunk = ET.parse(path).getroot().find("chunk")
    part = chunk.find("components/component")
    numbers = {
        each.tag: np.array(each.text.split(), float) for each in (chunk if part is None else part).find("transform")
    }
    local = (SQUARE - numbers["translation"]) @ numbers["rotation"].reshape(3, 3) / numbers["scale"]
    for camera in sorted(chunk.iter("camera"), key=lambda camera: camera.get("label")):
        pose = np.array(camera.find("transform").text.split(), float).reshape(4, 4)
        x, y, z = (np.concatenate([local, np.ones((30, 1))], axis=1) @ np.linalg.inv(pose).T)[:, :3].T
        given = chunk.find(f"sensors/sensor[@id='{camera.get('sensor_id')}']/calibration[@class='adjusted']")
        value = {each.tag: float(each.text) for each in given if each.tag != "resolution"}
        yield 24 / 2 + value["cx"] + x / z * (value["f"] + value["b1"]), 20 / 2 + value["cy"] + y / z * value["f"]


def seen_by_arkitscenes(folder, _scene):
    (path,) = folder.rglob("lowres_wide.traj")
    files = sorted((path.parent / "lowres_wide_intrinsics").iterdir())[::2]
    for line, file in zip(path.read_text().splitlines(), files, strict=True):
        values = np.array(line.split(), float)
        x, y, z = (Rotation.from_rotvec(values[1:4]).apply(SQUARE) + values[4:]).T
        _, _, fx, fy, cx, cy = map(float, file.read_text().split())
        yield fx * x / z + cx, fy * y / z + cy


def seen_by_stray(folder, scene):
    matrix = np.loadtxt(folder / "camera_matrix.csv", delimiter=",")
    world = SQUARE @ scene.to_source[:3, :3].T
    for row in np.loadtxt(folder / "odometry.csv", delimiter=",", skiprows=1):
        x, y, z = (Rotation.from_quat(row[5:]).inv().apply(world - row[2:5]) @ matrix.T).T
        yield x / z, y / z


def has_box(half):
    """The scene's bounds are those of the file, None for none; there are no points."""

    def check(_folder, scene):
        assert scene.points is None and scene.point_colors is None
        if half is None:
            assert scene.bounds is None
        else:
            np.testing.assert_array_equal(scene.bounds, [[-half] * 3, [half] * 3])

    return check


def leads_out_of_the_sphere(folder, scene):
    (path,) = folder.glob("cameras*.npz")
    np.testing.assert_allclose(scene.to_source, np.load(path)["scale_mat_0"])


def has_square(_folder, scene):
    np.testing.assert_allclose(scene.points, SQUARE, atol=1e-6)
    np.testing.assert_allclose(scene.point_colors, SHADES / 255, atol=1e-6)


def has_points(_folder, scene):
    np.testing.assert_allclose(scene.points, SQUARE, atol=1e-12)


def has_y_up(_folder, scene):
    np.testing.assert_allclose(scene.to_source @ [0, 0, 1, 1], [0, 1, 0, 1], atol=1e-12)


HELD_OUT, KEPT, ALL = [0, 8], [1, 2, 3, 4, 5, 6, 7, 9], list(range(10))


@dataclasses.dataclass
class Kind:
    """How a scene is written, and what is read of it.

    write: Writes pictures. splits: Which of them each split has. centered: One focal length and a principal point in
    the middle is all that the format has. seen: Where SQUARE is in each picture. checks: Of a folder and its scene.
    """

    format: str
    write: Callable
    splits: dict = dataclasses.field(default_factory=lambda: {"train": KEPT, "test": HELD_OUT, "all": ALL})
    centered: bool = False
    seen: Callable | None = None
    checks: tuple = ()


TURN = np.eye(4)
TURN[:3, :3] = Rotation.from_euler("xyz", [0.3, -1.1, 2.0]).as_matrix()
TURN[:3, 3] = [3.5, -2.0, 11.0]
NSVF = {"train": ALL[:4], "val": ALL[4:6], "test": ALL[6:]}


def kinds():
    with_options = functools.partial
    yield "blender", Kind("blender", write_blender, {"train": ALL}, True, checks=(has_box(None),))
    for style in ("4x4", "lines"):
        write = with_options(write_nsvf, splits="0000112222", style=style)
        yield f"nsvf {style}", Kind("nsvf", write, NSVF, style == "lines", checks=(has_box(1.5),))
    write = with_options(write_nsvf, splits="0" * 10, bbox=None)
    yield "nsvf of one split", Kind("nsvf", write, {"train": ALL}, checks=(has_box(None),))
    for name in ("cameras.npz", "cameras_sphere.npz"):
        checks = has_box(1.0), leads_out_of_the_sphere
        yield f"dtu {name}", Kind("dtu", with_options(write_dtu, name=name), checks=checks)
    for name, options in {
        "": {},
        " each": {"shared": False},
        " masks": {"masks": True},
        " stems": {"extension": False},
        " masks, stems, each": {"masks": True, "extension": False, "shared": False},
    }.items():
        yield f"transforms{name}", Kind("transforms", with_options(write_transforms, **options))
    for binary, where, masks in (
        (True, "sparse/0", False),
        (True, "sparse", True),
        (False, "sparse/0", True),
        (False, "sparse", False),
    ):
        write = with_options(write_colmap, binary=binary, where=where, masks=masks, points=CLOUD)
        name = f"colmap {'binary' if binary else 'text'} {where}"
        yield name, Kind("colmap", write, checks=(bounds_are_of_points,))
    yield "llff", Kind("llff", write_llff, centered=True, seen=seen_by_llff)
    for listing in ("list.txt", "bundle/list.txt", None):
        write = with_options(write_bundler, listing=listing)
        yield f"bundler {listing}", Kind("bundler", write, centered=True, seen=seen_by_bundler, checks=(has_square,))
    yield "realityscan", Kind("realityscan", write_realityscan, centered=True, seen=seen_by_realityscan)
    for place in ("", "opensfm"):
        write = with_options(write_opensfm, place=place)
        yield f"opensfm {place}", Kind("opensfm", write, seen=seen_by_opensfm, checks=(has_square,))
    for owner, ending, home, name in (
        ("component", "", "", "cameras.xml"),
        ("component", ".png", "C:/photos/", "my capture.xml"),
        ("chunk", "", "", "my capture.xml"),
        ("chunk", ".png", "C:/photos/", "cameras.xml"),
    ):
        options = {"owner": owner, "ending": ending, "home": home, "name": name, "world": TURN, "scale": 2.5}
        write = with_options(write_metashape, **options)
        yield f"metashape {owner} {home}{ending}", Kind("metashape", write, seen=seen_by_metashape)
    for name in ({}, {"kinds": ("", "corrected_"), "shift": 5.0}):
        write = with_options(write_polycam, **name)
        yield f"polycam{' corrected' if name else ''}", Kind("polycam", write, checks=(has_y_up,))
    for file, images, each in (("metadata", "rgbd", False), ("metadata.json", "rgb", True)):
        write = with_options(write_record3d, file=file, images=images, each=each)
        yield f"record3d {file}", Kind("record3d", write, checks=(has_y_up,))
    for place in ("", "41069021_frames"):
        write = with_options(write_arkitscenes, place=place)
        yield f"arkitscenes {place}", Kind("arkitscenes", write, seen=seen_by_arkitscenes, checks=(has_square,))
    yield "stray", Kind("stray", write_stray, seen=seen_by_stray, checks=(has_y_up,))
    one = {"centered": True, "seen": datasets.seen_by_scannet}
    for home, name in (("", "intrinsic/intrinsic_color.txt"), ("frames", "intrinsic_color.txt")):
        write = with_options(datasets.write_scannet, home=home, intrinsics=name)
        yield f"scannet {home}", Kind("scannet", write, **one)
    yield "replica", Kind("replica", datasets.write_replica, seen=datasets.seen_by_replica)
    parts = {"train": KEPT, "val": HELD_OUT, "all": ALL}
    write = with_options(datasets.write_nerfies, word="tangential_distortion")
    yield "nerfies", Kind("nerfies", write, parts, seen=datasets.seen_by_nerfies, checks=(has_points,))
    for images in ("images", "blended_images"):
        write = with_options(datasets.write_blendedmvs, images=images)
        yield f"blendedmvs {images}", Kind("blendedmvs", write, seen=datasets.seen_by_blendedmvs)
    parts = {"train": ALL[:7], "val": ALL[7:9], "test": ALL[9:]}
    yield "nerfpp", Kind("nerfpp", datasets.write_nerfpp, parts, seen=datasets.seen_by_nerfpp)


FORMATS = {name.strip(): kind for name, kind in kinds()}
#: Formats with names of their own, or a last split that is not the first pictures.
NUMBERED = {"nsvf", "dtu", "record3d", "arkitscenes", "stray", "scannet", "replica", "nerfies", "blendedmvs", "nerfpp"}
BY_FORMAT = {kind.format: kind for kind in FORMATS.values()}


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.filterwarnings("ignore:.*by paths of another folder")
def test_a_scene_comes_back(tmp_path, bricks, centered, name):
    """All of its splits, what the format says of points, smaller pictures; a split that is not there is named."""
    kind = FORMATS[name]
    pictures = centered if kind.centered else bricks
    kind.write(tmp_path, pictures)
    for split, rows in kind.splits.items():
        require_equal(load(tmp_path, split=split), pictures.pick(rows))
    for split in {"val", "test"} - set(kind.splits):
        with pytest.raises(FileNotFoundError, match=f"'{split}'.*splits: {', '.join(kind.splits)}"):
            load(tmp_path, split=split)
    split, rows = list(kind.splits.items())[-1]
    scene, chosen = load(tmp_path, split=split, format=kind.format), pictures.pick(rows)
    require_equal(scene, chosen)
    assert scene.names == chosen.names or (kind.format in NUMBERED and len(set(scene.names)) == len(scene))
    if kind.seen:
        for camera, pixels in zip(scene.cameras, kind.seen(tmp_path, scene), strict=True):
            np.testing.assert_allclose(camera.project(SQUARE)[0], np.stack(pixels, axis=1), atol=1e-6)
    for check in kind.checks:
        check(tmp_path, scene)
    small = load(tmp_path, split=split, downscale=2)
    halves = [each.reshape(len(rows), 10, 2, 12, 2, -1).mean(axis=(2, 4)) for each in chosen.over(BACKGROUND)]
    np.testing.assert_allclose(small.images, halves[0], atol=1e-6)
    np.testing.assert_allclose(small.alphas, halves[1][..., 0], atol=1e-6)
    for half, whole in zip(small.cameras, scene.cameras, strict=True):
        np.testing.assert_allclose(2 * half.project(SQUARE)[0], whole.project(SQUARE)[0], atol=1e-9)


@pytest.mark.parametrize("name", BY_FORMAT)
def test_a_scene_that_is_not_there(tmp_path, bricks, centered, name):
    refused(lambda: load(tmp_path, format=name), error=(FileNotFoundError, ValueError))
    BY_FORMAT[name].write(tmp_path, centered)
    for file in tmp_path.rglob("*.png"):
        file.unlink()
    refused(lambda: load(tmp_path, format=name), error=FileNotFoundError)


# Of all formats


def test_formats_are_told_apart_and_named(tmp_path, bricks):
    write_colmap(tmp_path, bricks, binary=True)
    write_transforms(tmp_path, bricks, masks=True)  # nerfstudio keeps COLMAP's model beside its own file
    assert load(tmp_path, split="all").alphas is not None
    with pytest.raises(ValueError, match="'transforms' hold one"):
        load(tmp_path, model="0")  # models are those of COLMAP alone
    empty = tmp_path / "other"
    (empty / "photos").mkdir(parents=True)
    (empty / "notes.txt").write_text("")
    refused(lambda: load_scene(empty), match=MESSAGES["scene.no_known_format"])


def test_masks_can_be_left_alone_and_missing(tmp_path, bricks):
    write_dtu(tmp_path / "with", bricks)
    scene = load(tmp_path / "with", split="all", masks=False)
    assert scene.alphas is None
    np.testing.assert_allclose(scene.images, bricks.rgba[..., :3] / 255, atol=1e-6)
    write_dtu(tmp_path / "without", bricks, masks=False)
    assert load(tmp_path / "without").alphas is None


def test_masks_that_hide_everything_are_told(tmp_path, bricks):
    write_transforms(tmp_path, bricks, masks=True)
    for mask in (tmp_path / "masks").iterdir():
        write_image(mask, np.zeros((20, 24), np.uint8))
    with pytest.warns(UserWarning, match="masks hide all of 10 of 10 pictures"):
        assert load(tmp_path, split="all").alphas.max() == 0


def test_llff_poses_that_do_not_fit_its_pictures_are_refused(tmp_path, centered):
    write_llff(tmp_path, centered)
    rows = np.load(tmp_path / "poses_bounds.npy")
    other_shape = rows.copy()
    other_shape[:, 4] = 40.0
    for values, said in (
        (rows[:9], "has 9 poses, .*images 10 pictures"),
        (np.zeros((10, 16)), r"must be \(n, 17\)"),
        (other_shape, MESSAGES["scene.llff_shape"]),
    ):
        np.save(tmp_path / "poses_bounds.npy", values)
        refused(lambda: load(tmp_path), match=said)


# Pictures without a camera, and models beside each other


REST = [0, 1, 3, 4, 6, 7, 8, 9]


@pytest.mark.parametrize(
    "write, options, said",
    [
        (write_bundler, {"lost": (2, 5)}, MESSAGES["scene.without_camera"]),
        (write_metashape, {"disabled": (2, 5)}, "2 of 10 cameras .*: 2 disabled"),
        (write_metashape, {"lost": (2, 5)}, "2 of 10 cameras .*: 0 disabled"),
    ],
)
def test_cameras_that_are_lost_or_off_are_left_out(tmp_path, centered, write, options, said):
    write(tmp_path, centered, **options)
    with pytest.warns(UserWarning, match=said):
        require_equal(load(tmp_path, split="all"), centered.pick(REST))


def test_opensfm_takes_the_largest_of_several(tmp_path, bricks):
    few = opensfm_reconstruction(bricks.pick([0, 1]))
    write_opensfm(tmp_path, bricks, others=[few, {"cameras": {}, "shots": {}}])
    with pytest.warns(UserWarning, match=MESSAGES["scene.most_shots"]):
        require_equal(load(tmp_path, split="all"), bricks)
    require_equal(load(tmp_path, split="all", model="0"), bricks.pick([0, 1]))
    refused(lambda: load(tmp_path, model="3"), match="no reconstruction '3', only 0, 1, 2")


def test_metashape_takes_the_largest_chunk(tmp_path, bricks):
    write_metashape(tmp_path, bricks, others=[metashape_chunk(bricks.pick([0, 1]), label="few")])
    with pytest.warns(UserWarning, match=MESSAGES["scene.most_cameras"]):
        require_equal(load(tmp_path, split="all"), bricks)
    require_equal(load(tmp_path, split="all", model="few"), bricks.pick([0, 1]))


def test_metashape_components_that_nothing_connects(tmp_path, bricks):
    write_metashape(tmp_path, bricks)
    file = tmp_path / "cameras.xml"
    text = file.read_text()
    for index in (1, 3):
        text = text.replace(*(f'id="{index}" sensor_id="{index}" component_id="{part}"' for part in (0, 1)))
    file.write_text(text.replace("</components>", '<component id="1" label="Component 2"></component></components>'))
    with pytest.warns(UserWarning, match=MESSAGES["scene.cameras_left_out"]):
        require_equal(load(tmp_path, split="all"), bricks.pick([0, 2, 4, 5, 6, 7, 8, 9]))


def test_metashape_in_coordinates_of_the_earth(tmp_path, bricks):
    """Millions of metres from the origin, as georeferenced chunks are."""
    world = TURN.copy()
    world[:3, 3] = [-2499366.0, -4256836.0, 4029217.0]
    far = [c.moved(np.block([[np.eye(3), world[:3, 3:]], [np.zeros((1, 3)), 1.0]])) for c in bricks.cameras]
    write_metashape(tmp_path, Pictures(bricks.rgba, far), world=world, scale=12.25)
    for read, written in zip(load(tmp_path, split="all").cameras, far, strict=True):
        np.testing.assert_allclose(read.camera_to_world, written.camera_to_world, atol=1e-8)


def test_metashape_entities_are_refused(tmp_path, bricks):
    write_metashape(tmp_path, bricks)
    file = tmp_path / "cameras.xml"
    bomb = '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;">]>'
    file.write_text(file.read_text().replace("<document", f"{bomb}<document", 1))
    refused(lambda: load(tmp_path), match="cameras.xml defines entities")


# Programs of phones


@pytest.mark.parametrize("corrected", [False, True])
def test_polycam_that_is_damaged(tmp_path, bricks, corrected):
    kinds = ("", "corrected_") if corrected else ("",)
    write_polycam(tmp_path, bricks, kinds=kinds)
    (tmp_path / f"keyframes/{kinds[-1]}cameras/{bricks.names[2]}.json").write_text('{"fx": 3}')
    refused(lambda: load(tmp_path), match=MESSAGES["scene.pose_number"])
    for kind in kinds:
        (tmp_path / f"keyframes/{kind}images").rename(tmp_path / f"{kind}depth")
    refused(lambda: load(tmp_path), match="holds no cameras/ .* beside images/")


def test_record3d_poses_are_seven_numbers(tmp_path, bricks):
    write_record3d(tmp_path, bricks)
    change_json(tmp_path / "metadata.json", lambda content: content["poses"][1].pop())
    refused(lambda: load(tmp_path), match=r"poses\[1\] must hold 7 numbers")


def test_arkitscenes_takes_the_largest_pictures(tmp_path, bricks):
    write_arkitscenes(tmp_path, bricks.pick([0, 1, 2]), images="wide", mesh=False)
    write_arkitscenes(tmp_path, bricks, mesh=False)
    require_equal(load(tmp_path, split="all"), bricks.pick([0, 1, 2]))
    require_equal(load(tmp_path, split="all", model="lowres_wide"), bricks)
    refused(lambda: load(tmp_path, model="vga_wide"), match="only wide, lowres_wide")
    path = tmp_path / "41069021_frames" / "lowres_wide.traj"
    path.write_text(path.read_text().replace("345", "745"))
    refused(lambda: load(tmp_path), match=MESSAGES["scene.no_pose_in_time"])


def test_stray_frames_must_be_pictures(tmp_path, bricks):
    write_stray(tmp_path, bricks)
    for index in (3, 4):
        (tmp_path / "rgb" / f"{index:06d}.png").unlink()
    assert len(load(tmp_path, split="all")) == 8
    (tmp_path / "rgb").rename(tmp_path / "depth")
    (tmp_path / "rgb.mp4").write_bytes(b"video")
    refused(lambda: load(tmp_path), match="rgb.mp4 .*ffmpeg -i rgb.mp4", error=FileNotFoundError)


def test_projections_are_split_as_opencv_does(bricks, tmp_path):
    cv2 = pytest.importorskip("cv2")
    write_dtu(tmp_path, bricks)
    matrices = np.load(tmp_path / "cameras_sphere.npz")
    for i, camera in enumerate(load(tmp_path, split="all").cameras):
        projection = (matrices[f"world_mat_{i}"] @ matrices[f"scale_mat_{i}"])[:3]
        k, rotation, center = cv2.decomposeProjectionMatrix(projection * np.sign(np.linalg.det(projection[:, :3])))[:3]
        k = k / k[2, 2]
        intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy]
        np.testing.assert_allclose([k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5], intrinsics, rtol=1e-9)
        np.testing.assert_allclose(rotation.T, camera.rotation, atol=1e-9)
        np.testing.assert_allclose(center[:3, 0] / center[3, 0], camera.center, atol=1e-9)


# Real data


@pytest.mark.scaled
def test_dtu_scan(real_data, tmp_path, at_night):
    """By day every third of its pictures."""
    folder = real_data / "dtu_scan24_half"
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    if not at_night:
        folder = every_third(folder, tmp_path)
    train, test = (load_scene(folder, split=split, downscale=8) for split in ("train", "test"))
    assert (len(train), len(test)) == ((42, 7) if at_night else (14, 3)) and train.images.shape[1:] == (75, 100, 3)
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
        assert (state == 1).sum() > (0.93 if at_night else 0.85) * (state >= 0).sum() > 0


def every_third(folder, copy):
    (cameras,) = folder.glob("cameras*.npz")
    matrices, kept = np.load(cameras), range(0, 49, 3)
    for kind in ("image", "mask"):
        (copy / kind).mkdir()
        files = sorted((folder / kind).iterdir())
        for row in kept:
            shutil.copy(files[row], copy / kind)
    rows = {
        f"{name}_mat_{k}": matrices[f"{name}_mat_{row}"] for k, row in enumerate(kept) for name in ("world", "scale")
    }
    np.savez(copy / cameras.name, **rows)
    return copy


def covered(camera, alpha, points):
    """Whether each point is seen where a mask is set: 1 or 0, and -1 outside the picture."""
    columns, rows = np.floor(camera.project(points)[0]).astype(int).T
    inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    state = np.full(len(points), -1)
    state[inside] = alpha[rows[inside], columns[inside]] > 0
    return state
