"""Scenes written in each format come back: cameras, pictures, splits, masks, points, distortion undone. Pixels of known
points are compared with the formulas of each format's own documentation."""

import dataclasses
import functools
import json
import re
import shutil
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Callable

import dataset_writers as datasets
import numpy as np
import pytest
from messages import MESSAGES
from phone_writers import write_arkitscenes, write_json, write_polycam, write_record3d, write_stray
from PIL import Image
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
from scipy.spatial.transform import Rotation

from warpcage import Camera, load_scene
from warpcage.scene import COEFFICIENTS, distort, undistort, undistorted_intrinsics
from warpcage.scene.formats.transforms import TransformsCameras
from warpcage.view import write_png

BACKGROUND = (0.1, 0.5, 0.9)


@pytest.fixture(scope="module")
def centered():
    return brick_pictures(10, centered=True)


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


# What each format says of a scene, by its own documentation


def seen_by_llff(folder, _scene):
    for row in np.load(folder / "poses_bounds.npy"):
        matrix = row[:15].reshape(3, 5)
        down, right, back = ((SQUARE - matrix[:, 3]) @ matrix[:, :3]).T
        height, width, focal = matrix[:, 4]
        yield focal * right / -back + width / 2, focal * down / -back + height / 2


def seen_by_bundler(folder, _scene):
    words = (folder / "bundle" / "bundle.out").read_text().split("\n", 2)[2].split()
    for index in range(10):
        values = np.array(words[15 * index : 15 * index + 15], float)
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


def bounds_are_of_points(_folder, scene):
    low, high = scene.bounds
    assert (low > -0.8).all() and (low < -0.45).all() and (high > 0.75).all() and (high < 1.1).all()


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


#: Points of a reconstruction, with a few wild ones.
CLOUD = np.concatenate([np.full((4, 3), 1000.0), np.random.default_rng(0).uniform(-0.5, 0.8, (396, 3))])
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
    with pytest.raises((FileNotFoundError, ValueError)) as error:
        load(tmp_path, format=name)
    assert "\n" not in str(error.value)
    BY_FORMAT[name].write(tmp_path, centered)
    for file in tmp_path.rglob("*.png"):
        file.unlink()
    with pytest.raises(FileNotFoundError) as error:
        load(tmp_path, format=name)
    assert "\n" not in str(error.value)


# Lenses

LENSES = {
    "barrel": (-0.12, 0.02),
    "pincushion": (0.1, 0.01),
    "tangential": (0.0, 0.0, 0.01, -0.008),
    "all": (-0.1, 0.03, 0.004, -0.006),
    "rational": (0.05, 0.01, 0.002, 0.001, 0.01, 0.02, 0.01, 0.005),
    "one": (-0.12,),
}


def picture_of(camera, pixels):
    """A smooth picture on the sky, looked up along the rays through pixels (h, w, 2) of a pinhole camera."""
    local = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    world = np.concatenate([local, np.ones((*pixels.shape[:2], 1))], axis=-1) @ camera.rotation.T
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


@functools.cache
def lens_pictures(lens, focals, middle=False):
    """Four pictures of the sky through a lens; middle: whether its axis meets the middle of the picture."""
    cameras, place = spiral_cameras(4, width=64, height=48), (32.0, 24.0) if middle else (33.0, 23.0)
    cameras = [Camera(50.0, focals[-1], *place, 64, 48, c.camera_to_world) for c in cameras]
    images = np.stack([seen_through(camera, LENSES[lens]) for camera in cameras])
    rgba = np.concatenate([np.round(images * 255), np.full((4, 48, 64, 1), 255)], axis=-1).astype(np.uint8)
    return Pictures(rgba, cameras)


def lens_scenes():
    """Name, lens, writer, focal lengths, and whether the lens must meet the middle of the picture."""
    with_options, named = functools.partial, ("k1", "k2", "p1", "p2")
    one, two = (50.0,), (50.0, 52.0)
    for lens in ("barrel", "pincushion", "tangential", "all"):
        given = dict(zip(named, LENSES[lens], strict=False))
        yield "transforms", lens, with_options(write_transforms, shared=False, distortion=given), two, False
    for model, lens, binary in (
        ("SIMPLE_RADIAL", "one", False),
        ("RADIAL", "barrel", True),
        ("OPENCV", "all", False),
        ("OPENCV", "all", True),
        ("FULL_OPENCV", "rational", False),
        ("FULL_OPENCV", "rational", True),
    ):
        write = with_options(write_colmap, binary=binary, model=model, distortion=LENSES[lens])
        yield f"colmap {model} {binary}", lens, write, one if "RADIAL" in model else two, False
    yield "bundler", "barrel", with_options(write_bundler, distortion=LENSES["barrel"]), one, True
    for lens in ("barrel", "tangential", "all"):
        k1, k2, t1, t2 = (*LENSES[lens], 0.0, 0.0)[:4]
        yield "realityscan", lens, with_options(write_realityscan, lens=(k1, k2, 0.0, 0.0, t1, t2)), one, False
    for kind, lens in (("perspective", "barrel"), ("brown", "all")):
        given, single = dict(zip(named, LENSES[lens], strict=False)), kind == "perspective"
        yield f"opensfm {kind}", lens, with_options(write_opensfm, kind=kind, **given), one if single else two, single
    k1, k2, p1, p2 = LENSES["all"]
    given = {"k1": k1, "k2": k2, "p1": p2, "p2": p1}  # in the order of its manual
    yield "metashape", "all", with_options(write_metashape, lens=given), two, False
    yield "nerfies", "all", with_options(datasets.write_nerfies, lens=(k1, k2, 0.0, p1, p2), held=(0,)), two, False


LENS_SCENES = {f"{name} {lens}": (lens, *rest) for name, lens, *rest in lens_scenes()}


@pytest.mark.parametrize("name", LENS_SCENES)
def test_lenses_are_undone(tmp_path, name):
    lens, write, focals, middle = LENS_SCENES[name]
    pictures = lens_pictures(lens, focals, middle)
    write(tmp_path, pictures)
    scene = load_scene(tmp_path)
    assert scene.alphas is None and len(scene) == 3
    for image, read, written in zip(scene.images, scene.cameras, pictures.cameras[1:], strict=True):
        zoom = read.fx / written.fx
        assert 1.0 <= zoom < 1.1 and read.fy / written.fy == pytest.approx(zoom)
        assert (read.cx, read.cy) == (written.cx, written.cy)
        np.testing.assert_allclose(read.camera_to_world, written.camera_to_world, atol=1e-9)
        error = np.abs(image - picture_of(read, pixel_centers(read)))
        assert error[1:-1, 1:-1].max() < 0.008 and error.max() < 0.015  # half a pixel at the edge is repeated


@pytest.mark.parametrize("lens", ["barrel", "tangential", "all"])
def test_realityscan_lenses_of_four_radial_coefficients(tmp_path, lens):
    """They are resampled in another way; with next to nothing as the fourth, to the same pictures."""
    pictures = lens_pictures(lens, (50.0,))
    k1, k2, t1, t2 = (*LENSES[lens], 0.0, 0.0)[:4]
    write_realityscan(tmp_path, pictures, lens=(k1, k2, 0.0, 1e-9, t1, t2))
    scene = load_scene(tmp_path)
    for image, read, written in zip(scene.images, scene.cameras, pictures.cameras[1:], strict=True):
        np.testing.assert_allclose(read.camera_to_world, written.camera_to_world, atol=1e-9)
        error = np.abs(image - picture_of(read, pixel_centers(read)))[2:-2, 2:-2]
        assert read.width > 40 and error.max() < 0.01


def test_an_undistorted_picture_of_a_lens_without_distortion_is_itself():
    image = np.random.default_rng(0).random((7, 9, 4), dtype=np.float32)
    intrinsics = (10.0, 11.0, 4.0, 3.6)
    assert undistorted_intrinsics(intrinsics, (9, 7), (0.0,) * 4, "here") == intrinsics
    np.testing.assert_allclose(undistort(image, intrinsics, intrinsics, (0.0,) * 4), image, atol=1e-6)


@pytest.mark.parametrize("k1", [1e6, -50.0, 1e300])
def test_a_lens_that_folds_the_picture_is_refused(k1):
    with pytest.raises(ValueError, match="here: lens distortion k1="):
        undistorted_intrinsics((10.0, 10.0, 5.0, 5.0), (10, 10), (k1,), "here")


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
    with pytest.raises(ValueError, match=MESSAGES["scene.no_known_format"]):
        load_scene(empty)


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


# transforms.json


def rewrite(path, change):
    """Change the content of a JSON file."""
    content = json.loads(path.read_text())
    change(content)
    write_json(path, content)


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
    assert [len(load(tmp_path / "files", split=split)) for split in ("train", "test")] == [3, 2]


def test_transforms_with_angles_instead_of_focal_lengths(tmp_path, centered):
    write_transforms(tmp_path, centered)

    def change(content):
        for name in ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_model"):
            del content[name]
        content["camera_angle_x"] = 2 * np.arctan(12 / 30.0)
        for frame in content["frames"]:
            frame["transform_matrix"] = frame["transform_matrix"][:3]

    rewrite(tmp_path / "transforms.json", change)
    require_equal(load(tmp_path, split="all"), centered)
    rewrite(tmp_path / "transforms.json", lambda content: content.update(camera_angle_y=2 * np.arctan(10 / 25.0)))
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

    def change(content):
        for values in content["frames"] if each else [content]:
            values[name] = as_matrix(values, form)
            for word in INTRINSICS:
                del values[word]
        content["frames"].reverse()

    rewrite(tmp_path / file, change)
    split = "all" if file == "transforms.json" else "train"
    require_equal(load(tmp_path, split=split), bricks)
    path = str(tmp_path / file)
    camera = TransformsCameras(path).camera("view_03")
    assert camera.fx == pytest.approx(bricks.cameras[3].fx) and camera.cy == pytest.approx(bricks.cameras[3].cy)


def test_a_matrix_of_a_frame_goes_before_what_the_file_says(tmp_path, bricks):
    write_transforms(tmp_path, bricks)
    other = {"fl_x": 40.0, "fl_y": 41.0, "cx": 11.0, "cy": 9.0}
    rewrite(tmp_path / "transforms.json", lambda content: content["frames"][0].update(K=as_matrix(other, "rows")))
    cameras = load(tmp_path, split="all").cameras
    assert [cameras[9].fx, cameras[9].fy, cameras[9].cx, cameras[9].cy] == [40.0, 41.0, 11.0, 9.0]
    assert cameras[0].fx == bricks.cameras[0].fx
    rewrite(tmp_path / "transforms.json", lambda content: content["frames"][0].update(camera_angle_x=0.9, K=None))
    assert load(tmp_path, split="all").cameras[9].fx == pytest.approx(12 / np.tan(0.45))


@pytest.mark.parametrize(
    "matrix, said",
    [
        ([[40.0, 1.0, 12.0], [0, 40.0, 10.0], [0, 0, 1.0]], MESSAGES["scene.matrix_skew"]),
        ([[40.0, 0, 12.0], [0, 40.0, 10.0], [0, 0.1, 1.0]], "K must be a camera matrix, fx 0 cx"),
        ([[40.0, 0], [0, 40.0], [0, 0]], "K must be a camera matrix, fx 0 cx"),
        ([[40.0, 0, "a"], [0, 40.0, 10.0], [0, 0, 1.0]], r"K\[0\]\[2\] must be a finite number"),
        ([[40.0, 0, 12.0], [0, 40.0, 10.0], [0, 0, 1.0]], MESSAGES["scene.matrix_beside"]),
        ([[0.9, 0, 0.5], [0, 0.9, 0.5], [0, 0, 1.0]], "K has fl_x 0.9, beside it"),
    ],
)
def test_matrices_that_are_none_are_refused(tmp_path, bricks, matrix, said):
    write_transforms(tmp_path, bricks)
    rewrite(tmp_path / "transforms.json", lambda content: content.update(K=matrix))
    with pytest.raises(ValueError, match=said):
        load(tmp_path)


def test_points_of_transforms_give_the_bounds(tmp_path, bricks):
    points = CLOUD[4:].astype("<f4")
    write_transforms(tmp_path, bricks, ply_file_path="sparse_pc.ply")
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{properties}end_header\n"
    (tmp_path / "sparse_pc.ply").write_bytes(header.encode() + points.tobytes())
    bounds_are_of_points(tmp_path, load(tmp_path))
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


def test_focal_lengths_that_are_no_pixels_are_refused(tmp_path, bricks):
    """Millimetres, or shares of the picture, which other programs have."""
    write_transforms(tmp_path, bricks)
    rewrite(tmp_path / "transforms.json", lambda content: content.update(fl_x=0.035, fl_y=0.035))
    with pytest.raises(ValueError, match="a focal length of 0.035 pixels"):
        load(tmp_path)


# COLMAP


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
    with pytest.raises(FileNotFoundError, match="more than half"):
        load(tmp_path)


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
    with pytest.raises(ValueError, match=f"no COLMAP model '7', only {base}/0, {base}/1"):
        load_scene(tmp_path, model="7")


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
        with pytest.raises(ValueError, match="sizes differ in 7 of 7|more than half"):
            load(tmp_path, model="sparse/0")
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
    with pytest.raises(ValueError, match=said):
        load_scene(tmp_path / given)


# LLFF


@pytest.mark.parametrize("downscale, taken", [(1, 1), (2, 2), (4, 4), (5, 1)])
def test_llff_takes_the_pictures_of_the_size_that_is_asked_for(tmp_path, centered, downscale, taken):
    black = Pictures(np.zeros_like(centered.rgba) + np.uint8([0, 0, 0, 255]), centered.cameras)
    write_llff(tmp_path, black, (1, 2, 4))
    white = Pictures(np.full_like(centered.rgba, 255), centered.cameras)
    write_llff(tmp_path, white, (taken,))
    scene = load(tmp_path, split="all", downscale=downscale)
    assert scene.images.min() > 0.999
    for read, written in zip(scene.cameras, centered.cameras, strict=True):
        assert (read.width, read.height) == (round(written.width / downscale), round(written.height / downscale))
        assert read.fx / read.width == pytest.approx(written.fx / written.width, rel=1e-12)


COPIES = {
    "llff": (write_llff, lambda camera: camera.fx),
    "colmap": (functools.partial(write_colmap, binary=True), None),
    "transforms": (write_transforms, None),
    "transforms of no size": (functools.partial(write_transforms, sized=False), None),
}


@pytest.mark.parametrize("downscale, read, total", [(1, 2, 2), (2, 2, 2), (3, 4, 4), (4, 4, 4), (6, 2, 6), (7, 4, 8)])
@pytest.mark.parametrize("name", COPIES)
def test_smaller_copies_alone_are_read(tmp_path, name, downscale, read, total):
    """images_2/, images_4/ beside cameras of images/, as mip-NeRF 360 scenes are handed on: cameras are scaled by the
    true sizes, and it is said where pictures become smaller than was asked for."""
    pictures = brick_pictures(10, centered=True, width=48, height=40)
    COPIES[name][0](tmp_path, pictures)
    shutil.rmtree(tmp_path / "images")
    white = Pictures(np.full_like(pictures.rgba, 255), pictures.cameras)
    write_llff(tmp_path / "more", white, (2, 4))
    for factor in (2, 4):
        (tmp_path / f"more/images_{factor}").rename(tmp_path / f"images_{factor}")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = load(tmp_path, split="all", downscale=downscale)
    said = [str(warning.message) for warning in caught]
    assert [bool(re.search(MESSAGES["scene.copies"].format(read, total), each)) for each in said] == (
        [True] if total != downscale else []
    )
    assert scene.images.min() > 0.999 and len(scene) == 10
    for camera, whole in zip(scene.cameras, pictures.cameras, strict=True):
        assert (camera.width, camera.height) == (round(48 / total), round(40 / total))
        np.testing.assert_allclose(
            camera.project(SQUARE)[0] / [camera.width, camera.height], whole.project(SQUARE)[0] / [48, 40], atol=1e-9
        )


def resized(folder, size, ending=None):
    """Make all pictures of a folder another size."""
    for file in sorted(folder.rglob("*.png")):
        image = Image.open(file).resize(size)
        file.unlink()
        image.save(file if ending is None else file.with_suffix(ending))


@pytest.mark.parametrize("write, bent", [(write_transforms, {"distortion": {"k1": -0.01}}), (write_colmap, None)])
@pytest.mark.parametrize(
    "size, share",
    [((12, 10), 0.5), ((8, 7), 1 / 3), ((48, 40), 2.0), ((14, 12), 0.59), ((36, 30), 1.5)]
    + [((23, 20), None), ((26, 22), None), ((25, 21), None), ((12, 20), None), ((23, 21), None)],
)
def test_pictures_of_another_size_by_one_factor(tmp_path, bricks, write, bent, size, share):
    """They were made smaller; of other sizes they were cropped, which a factor near one is too, and refused once."""
    options = {"binary": False} if write is write_colmap else {}
    write(tmp_path / "a", bricks, **options)
    resized(tmp_path / "a/images", size)
    if share is None:
        said = MESSAGES["scene.sizes_differ"].format(*size, 8, 8)
        with pytest.raises(ValueError, match=said):
            load(tmp_path / "a")
        return
    with pytest.warns(UserWarning, match=MESSAGES["scene.sizes_scaled"].format(*size)) as caught:
        scene = load(tmp_path / "a", split="all")
    assert len(caught) == 1
    for camera, whole in zip(scene.cameras, bricks.cameras, strict=True):
        assert (camera.width, camera.height) == size
        np.testing.assert_allclose(camera.project(SQUARE)[0] / size, whole.project(SQUARE)[0] / [24, 20], atol=1e-9)
    if bent:  # what undoes a lens may have made pictures of any size, but for half and double
        write(tmp_path / "b", bricks, **bent)
        resized(tmp_path / "b/images", size)
        if share in (0.5, 1 / 3, 2.0):
            with pytest.warns(UserWarning, match="cameras are scaled"):
                assert load(tmp_path / "b").cameras[0].fx > 0.9 * share * bricks.cameras[1].fx
        else:
            with pytest.raises(ValueError, match="before a lens was undone"):
                load(tmp_path / "b")


def test_one_picture_of_another_size_is_refused(tmp_path, bricks):
    write_transforms(tmp_path, bricks)
    image = Image.open(tmp_path / "images/view_03.png").resize((12, 10))
    image.save(tmp_path / "images/view_03.png")
    with pytest.raises(ValueError, match=MESSAGES["scene.sizes_differ"].format(12, 10, 1, 10)):
        load(tmp_path, split="all")


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
        with pytest.raises(ValueError, match=said):
            load(tmp_path)


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
    with pytest.raises(ValueError, match="no reconstruction '3', only 0, 1, 2"):
        load(tmp_path, model="3")


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
    with pytest.raises(ValueError, match="cameras.xml defines entities"):
        load(tmp_path)


# Programs of phones


@pytest.mark.parametrize("corrected", [False, True])
def test_polycam_that_is_damaged(tmp_path, bricks, corrected):
    kinds = ("", "corrected_") if corrected else ("",)
    write_polycam(tmp_path, bricks, kinds=kinds)
    (tmp_path / f"keyframes/{kinds[-1]}cameras/{bricks.names[2]}.json").write_text('{"fx": 3}')
    with pytest.raises(ValueError, match=MESSAGES["scene.pose_number"]):
        load(tmp_path)
    for kind in kinds:
        (tmp_path / f"keyframes/{kind}images").rename(tmp_path / f"{kind}depth")
    with pytest.raises(ValueError, match="holds no cameras/ .* beside images/"):
        load(tmp_path)


def test_record3d_poses_are_seven_numbers(tmp_path, bricks):
    write_record3d(tmp_path, bricks)
    rewrite(tmp_path / "metadata.json", lambda content: content["poses"][1].pop())
    with pytest.raises(ValueError, match=r"poses\[1\] must hold 7 numbers"):
        load(tmp_path)


def test_arkitscenes_takes_the_largest_pictures(tmp_path, bricks):
    write_arkitscenes(tmp_path, bricks.pick([0, 1, 2]), images="wide", mesh=False)
    write_arkitscenes(tmp_path, bricks, mesh=False)
    require_equal(load(tmp_path, split="all"), bricks.pick([0, 1, 2]))
    require_equal(load(tmp_path, split="all", model="lowres_wide"), bricks)
    with pytest.raises(ValueError, match="only wide, lowres_wide"):
        load(tmp_path, model="vga_wide")
    path = tmp_path / "41069021_frames" / "lowres_wide.traj"
    path.write_text(path.read_text().replace("345", "745"))
    with pytest.raises(ValueError, match=MESSAGES["scene.no_pose_in_time"]):
        load(tmp_path)


def test_stray_frames_must_be_pictures(tmp_path, bricks):
    write_stray(tmp_path, bricks)
    for index in (3, 4):
        (tmp_path / "rgb" / f"{index:06d}.png").unlink()
    assert len(load(tmp_path, split="all")) == 8
    (tmp_path / "rgb").rename(tmp_path / "depth")
    (tmp_path / "rgb.mp4").write_bytes(b"video")
    with pytest.raises(FileNotFoundError, match="rgb.mp4 .*ffmpeg -i rgb.mp4"):
        load(tmp_path)


# Readers of others


@pytest.mark.parametrize(
    "model, lens", [("OPENCV", "all"), ("FULL_OPENCV", "rational"), ("RADIAL", "barrel"), ("SIMPLE_RADIAL", "one")]
)
def test_distortion_is_that_of_colmap(model, lens):
    pycolmap = pytest.importorskip("pycolmap")
    focal = [50.0] if "RADIAL" in model else [50.0, 52.0]
    camera = pycolmap.Camera(model=model, width=64, height=48, params=[*focal, 33.0, 23.0, *LENSES[lens]])
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2))
    pixels = np.array([camera.img_from_cam(np.array([x, y, 1.0])) for x, y in points]).reshape(-1, 2)
    expected = np.stack(distort(*points.T, LENSES[lens]), axis=-1) * [focal[0], focal[-1]] + [33.0, 23.0]
    np.testing.assert_allclose(pixels, expected, atol=1e-9)


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


def test_lens_is_that_of_opencv():
    cv2 = pytest.importorskip("cv2")
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3)) * [1, 1, 0] + [0, 0, 1]
    for lens in LENSES.values():
        pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), np.array((lens + (0.0,) * 8)[:8]))
        np.testing.assert_allclose(pixels[:, 0], np.stack(distort(*points.T[:2], lens), axis=-1), atol=1e-9)
    assert len(COEFFICIENTS) == 8 and len(MODEL_NUMBERS) == 8


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
